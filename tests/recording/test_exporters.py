"""What is written is read back; what other programs write is read as their documentation says."""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from helpers import refused

from graphnav.core import rotation
from graphnav.core.errors import RecordingError
from graphnav.core.notes import get_key
from graphnav.core.timescales import gps_to_utc
from graphnav.core.trajectory import Trajectory
from graphnav.recording import exporters
from graphnav.recording.exporters import digits, write_as
from graphnav.recording.exporters.digits import format_rows
from graphnav.recording.formats.trajectories import read_trajectory

DEG = np.pi / 180


def made(n: int = 200, seed: int = 0) -> Trajectory:
    """A path across the southern and western hemispheres' signs, every column filled with its own numbers."""
    rng = np.random.default_rng(seed)
    t = 86400.0 * 5 + np.arange(n) * 0.005
    llh = np.array([-33.9, -70.7, 512.0]) * [DEG, DEG, 1] + np.cumsum(rng.normal(size=(n, 3)) * [1e-8, 1e-8, 0.01], 0)
    return Trajectory(
        t, llh, v=rng.normal(size=(n, 3)) * 10, rph=rng.uniform([-3, -1.5, 0], [3, 1.5, 6.28], size=(n, 3)),
        sd_p=rng.uniform(1e-4, 10, (n, 3)), sd_v=rng.uniform(1e-4, 1, (n, 3)), sd_rph=rng.uniform(1e-6, 0.1, (n, 3)),
        gyro_bias=rng.normal(size=(n, 3)) * 1e-5, accel_bias=rng.normal(size=(n, 3)) * 1e-3, name="made",
    )  # fmt: skip


def test_csv_has_the_fixed_header_and_reads_back(tmp_path: Path) -> None:
    source = made()
    write_as("csv", source, tmp_path / "trajectory.csv")
    head = (tmp_path / "trajectory.csv").read_text().splitlines()[0]
    assert head == (
        "t,lat,lon,h,ve,vn,vu,roll,pitch,heading,sd_e,sd_n,sd_u,sd_ve,sd_vn,sd_vu,sd_roll,sd_pitch,sd_heading,"
        "bgx,bgy,bgz,bax,bay,baz"
    )
    back = read_trajectory(tmp_path / "trajectory.csv")
    # Half a unit of the last digit written.
    np.testing.assert_allclose(back.t, source.t, atol=0.51e-6)
    np.testing.assert_allclose(back.llh[:, :2] / DEG, source.llh[:, :2] / DEG, atol=0.51e-11)
    np.testing.assert_allclose(back.llh[:, 2], source.llh[:, 2], atol=0.51e-5)
    np.testing.assert_allclose(back.v, source.v, atol=0.51e-5)
    np.testing.assert_allclose(back.rph / DEG, source.rph / DEG, atol=0.51e-7)
    for key in ("sd_p", "sd_v", "sd_rph", "gyro_bias", "accel_bias"):
        np.testing.assert_allclose(getattr(back, key), getattr(source, key), rtol=5.1e-6, err_msg=key)


def test_csv_units_are_those_of_the_page(tmp_path: Path) -> None:
    one = Trajectory(
        np.array([1.5]), np.array([[0.5, -1.0, 7.0]]), v=np.array([[1.0, 2.0, 3.0]]), rph=np.array([[0.1, -0.2, 3.0]]),
        sd_rph=np.array([[0.01, 0.02, 0.03]]), gyro_bias=np.array([[1e-6, -2e-6, 0.0]]),
    )  # fmt: skip
    write_as("csv", one, tmp_path / "a.csv")
    head, row = (line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines())
    value = dict(zip(head, row, strict=True))
    assert float(value["lat"]) == pytest.approx(28.64788975654)
    assert float(value["lon"]) == pytest.approx(-57.29577951308)
    assert (float(value["ve"]), float(value["vn"]), float(value["vu"])) == (1.0, 2.0, 3.0)
    assert float(value["pitch"]) == pytest.approx(-11.4591559)
    assert float(value["sd_heading"]) == pytest.approx(1.71887, rel=1e-5)
    assert float(value["bgy"]) == -2e-6
    assert value["sd_e"] == value["baz"] == ""  # not known is blank, not zero


def test_a_missing_value_is_blank_and_comes_back_as_missing(tmp_path: Path) -> None:
    v = np.array([[1.0, 2.0, 3.0], [np.nan, np.nan, np.nan]])
    pair = Trajectory(np.array([0.0, 1.0]), np.zeros((2, 3)), v=v)
    write_as("csv", pair, tmp_path / "a.csv")
    assert "nan" not in (tmp_path / "a.csv").read_text()
    np.testing.assert_array_equal(read_trajectory(tmp_path / "a.csv").v, v)


def test_tum_is_enu_about_the_first_point_with_the_body_quaternion(tmp_path: Path) -> None:
    source = made()
    write_as("tum", source, tmp_path / "a.tum")
    table = np.loadtxt(tmp_path / "a.tum")
    lat, lon, h = source.llh[:, 0] / DEG, source.llh[:, 1] / DEG, source.llh[:, 2]
    expected = np.column_stack(pymap3d.geodetic2enu(lat, lon, h, lat[0], lon[0], h[0]))
    np.testing.assert_allclose(table[:, 1:4], expected, atol=6e-6)
    # Forward is +y of the body: heading 90 deg points it east, and the quaternion is about up by -90 deg.
    east = Trajectory(np.array([0.0]), source.llh[:1], rph=np.array([[0.0, 0.0, np.pi / 2]]))
    write_as("tum", east, tmp_path / "b.tum")
    q = np.loadtxt(tmp_path / "b.tum")[4:]
    np.testing.assert_allclose(q, [0, 0, -np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)

    back = read_trajectory(tmp_path / "a.tum")
    assert back.frame == "local"
    np.testing.assert_allclose(back.llh, table[:, 1:4])
    np.testing.assert_allclose(
        rotation.from_rph(back.rph)[0], rotation.from_rph(source.rph)[0], atol=1e-9
    )  # the first point's level is the frame


def test_tum_without_attitude_is_refused(tmp_path: Path) -> None:
    with refused("export.no_attitude", RecordingError):
        write_as("tum", replace(made(), rph=None), tmp_path / "a.tum")


def test_kml_is_a_thinned_path_with_both_ends(tmp_path: Path) -> None:
    n = 60000
    x = np.concatenate([np.zeros(n // 2), np.linspace(0.0, 0.01, n // 2)])  # stands, then drives 1.1 km north
    source = Trajectory(
        np.arange(n) * 0.01, np.column_stack([0.8 + x * DEG, np.full(n, 0.2), np.full(n, 100.0)]), name="a<b"
    )
    write_as("kml", source, tmp_path / "a.kml")
    root = ET.parse(tmp_path / "a.kml").getroot()
    ns = {"k": "http://www.opengis.net/kml/2.2"}
    names = [e.text for e in root.findall(".//k:Placemark/k:name", ns)]
    assert names == ["a<b", "start", "end"]
    line = root.find(".//k:LineString/k:coordinates", ns)
    points = np.array([[float(x) for x in row.split(",")] for row in line.text.split()])
    lonlat = source.llh[:, [1, 0]] / DEG
    np.testing.assert_allclose(points[[0, -1], :2], lonlat[[0, -1]], atol=1e-8)
    assert len(points) < 20100
    gaps = np.diff(points[:, 1]) * 111e3
    assert gaps.max() < 0.2  # m: evenly spread over the drive
    assert (points[:, 1] == points[0, 1]).sum() < 5  # the half that stands costs nothing


@pytest.mark.parametrize("form", ["%.6f", "%.11f", "%.5f", "%.0f", "%.2f", "%d", "%.6g"])
def test_digits_are_those_of_c(form: str) -> None:
    rng = np.random.default_rng(3)
    half = (rng.integers(0, 10**6, 400) + 0.5) * 10.0 ** rng.integers(-12, 1, 400)  # a digit's rounding decides
    decimals = rng.integers(-(10**6), 10**6, 400) * 10.0 ** rng.integers(-12, 3, 400)
    edges = [0.0, 9.9999949e-5, 9.999995e-5, 1e-4, 0.9999995, 99999.95, 999999.5, 1e-17, 5e-324, 1e300, np.nan, np.inf]
    spread = rng.normal(size=400) * 10.0 ** rng.uniform(-20, 14, 400)
    for x in (half, decimals, spread, 1.7e9 + rng.uniform(size=400), *([e] for e in edges), *([-e] for e in edges)):
        x = np.array(x)[np.isfinite(x)] if form == "%d" else np.array(x)
        wanted = ["" if np.isnan(one) else form % one for one in x]
        assert format_rows(x[:, None], form).split("\n")[:-1] == wanted
        assert digits._write_compiled(x[:, None], form + "\n", None).decode().split("\n")[:-1] == wanted


def test_words_end_a_row_of_numbers() -> None:
    table, words = np.array([[0.5, 2.0], [np.nan, -3.25]]), np.array([b"a", b"bcd"])
    wanted = b"<0.5;2>a.\n<;-3.25>bcd.\n"
    assert digits.encode_rows(table, "<%.1f;%.6g>%s.", words) == wanted
    assert digits._write_compiled(table, "<%.1f;%.6g>%s.\n", words) == wanted


def test_parts_of_a_trajectory_make_the_files_of_the_whole(tmp_path: Path) -> None:
    whole = made()
    rows = [slice(0, 1), slice(1, 90), slice(90, 200)]
    names = [name for name in exporters.FORMATS if name != "parquet"]
    for folder, parts in (("whole", [whole]), ("parts", [whole.take(k) for k in rows])):
        targets = {name: tmp_path / folder / f"a.{name}" for name in names}
        (tmp_path / folder).mkdir()
        exporters.write_parts(parts, targets, "a", lambda t: gps_to_utc(t + 1.3e9))
    for name in names:
        assert (tmp_path / "whole" / f"a.{name}").read_bytes() == (tmp_path / "parts" / f"a.{name}").read_bytes(), name


def test_what_a_format_cannot_hold_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("before")
    with refused("export.local_frame", RecordingError, f"{path}: "):
        write_as("csv", replace(made(), frame="local"), path)
    with refused("export.no_attitude", RecordingError, f"{path}: "):  # of several, one
        exporters.write_parts([replace(made(), rph=None)], {"csv": tmp_path / "b.csv", "tum": path})
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"a.csv": "before"}


def test_parquet_holds_the_columns_of_the_csv_with_all_digits(tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    track = replace(made(), sd_v=None)
    write_as("parquet", track, tmp_path / "a.parquet")
    write_as("csv", track, tmp_path / "a.csv")
    table = pq.read_table(tmp_path / "a.parquet")
    assert ",".join(table.column_names) == (tmp_path / "a.csv").read_text().splitlines()[0]
    np.testing.assert_array_equal(table["lat"].to_numpy(), np.rad2deg(track.llh[:, 0]))
    np.testing.assert_array_equal(table["sd_heading"].to_numpy(), np.rad2deg(track.sd_rph[:, 2]))
    assert table["sd_ve"].null_count == len(track)


def test_all_formats_are_written_in_one_pass(tmp_path: Path) -> None:
    targets = {one: tmp_path / f"all.{one}" for one in ("csv", "kml", "tum")}
    exporters.write_parts([made()], targets, made().name)
    for one, path in targets.items():
        exporters.write_as(one, made(), tmp_path / f"alone.{one}")
        assert path.read_bytes() == (tmp_path / f"alone.{one}").read_bytes(), one
    with refused("export.local_frame", RecordingError):
        exporters.write_parts([replace(made(), frame="local")], {"kml": tmp_path / "local.kml"})


KF_GINS = """\
0 456300.000 30.4447873622 114.4718632047 20.9117 0.0001 -3.0000 -0.5000 0.8541 -2.0375 185.7001
0 456300.005 30.4447873623 114.4718632048 20.9118 0.0002 -3.1000 -0.6000 0.8542 -2.0376 185.7002
"""


def test_kf_gins(tmp_path: Path) -> None:
    file = tmp_path / "KF_GINS_Navresult.nav"
    file.write_text(KF_GINS)
    found = read_trajectory(file)
    np.testing.assert_allclose(found.t, [456300.0, 456300.005])
    np.testing.assert_allclose(found.llh[0], [30.4447873622 * DEG, 114.4718632047 * DEG, 20.9117])
    np.testing.assert_allclose(found.v[0], [-3.0, 0.0001, 0.5])  # north, east, down in the file
    np.testing.assert_allclose(found.rph[0] / DEG, [0.8541, -2.0375, 185.7001])


def test_kf_gins_angles_are_ours() -> None:
    """ZYX yaw, pitch, roll of forward-right-down to north-east-down, built axis by axis, is our R_nb."""
    roll, pitch, yaw = 0.3, -0.4, 2.5

    def about(axis: int, angle: float) -> np.ndarray:
        return rotation.exp(angle * np.eye(3)[axis])

    R_ned_frd = about(2, yaw) @ about(1, pitch) @ about(0, roll)
    swap = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # north-east-down <-> east-north-up
    np.testing.assert_allclose(swap @ R_ned_frd @ swap, rotation.from_rph(np.array([roll, pitch, yaw])), atol=1e-12)


def test_kf_gins_runs_on_over_the_end_of_a_week(tmp_path: Path) -> None:
    file = tmp_path / "a.nav"
    file.write_text("2017 604799.5 30 114 20 0 0 0 0 0 0\n2018 0.5 30 114 20 0 0 0 0 0 0\n")
    np.testing.assert_allclose(read_trajectory(file).t, [604799.5, 604800.5])


def test_names_with_units_and_down_velocity(tmp_path: Path) -> None:
    file = tmp_path / "truth.csv.gz"
    rows = "t_s,lat_deg,lon_deg,h_m,vn_mps,ve_mps,vd_mps,heading_deg,quality\n1,30,114,20,1,2,3,90,fixed\n"
    file.write_bytes(gzip.compress(rows.encode()))
    found = read_trajectory(file)
    np.testing.assert_allclose(found.v, [[2.0, 1.0, -3.0]])
    assert found.rph[0, 2] == pytest.approx(np.pi / 2)
    assert np.isnan(found.rph[0, :2]).all()


def test_local_truth_in_two_dimensions(tmp_path: Path) -> None:
    file = tmp_path / "truth.csv"
    file.write_text("t_s,imu_row,x_m,y_m\n2.1,427,0.0,0.5\n3.0,615,0.6,0.2\n")
    found = read_trajectory(file)
    assert found.frame == "local"
    np.testing.assert_array_equal(found.llh, [[0.0, 0.5, np.nan], [0.6, 0.2, np.nan]])


@pytest.mark.parametrize("rows", ["t,lat,lon,h\n0,30,114,20\n1,30,114,20\n", "0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n"])
def test_comments_of_other_programs_are_no_header_of_rtklib(tmp_path: Path, rows: str) -> None:
    file = tmp_path / "track.txt"
    file.write_text(f"% of MATLAB\n%\n{rows}")
    np.testing.assert_array_equal(read_trajectory(file).t, [0.0, 1.0])


@pytest.mark.parametrize(
    ("content", "key", "names"),
    [
        ("", "file.no_rows", ()),
        ("t,lat,lon,h\n", "file.no_rows", ()),
        ("t,lat,lon\n0,1,2\n", "table.column", ("'h'",)),
        ("t,lat,lon,h\n0,30,114,20\n1,30,abc,20\n", "table.cell", ("line 3, lon", "'abc'")),
        ("t,lat,lon,h,word\n0,30,114,20,a\n1,30,114,20,b,5\n", "table.fields", ("line 3", "6", "5")),
        ("t,lat,lon,h\n0,30,114,20\n1,30,114\n", "table.fields", ("line 3", "3", "4")),
        ("t,lat,lon,h\n5,30,114,20\n4,30,114,20\n", "table.time_order", ("line 3, t",)),
        ("t,lat,lon,h\n0,114,30,20\n", "table.place", ("line 2, lat", "114")),
        ("t,lat,lon,h\n,30,114,20\n", "table.cell", ("line 2, t",)),
        ("t,lat,lon,h\n1,,114,20\n", "table.all_blank", ()),
        ("# comment\n0 1 2 3\n", "table.no_header", ("line 2",)),
        ("0 1 2 3 0 0 0 2\n", "table.quaternion", ("line 1, qx qy qz qw",)),
        ("0 456300.0 30 114 20 0 0 0 0 0 0\n0 456300.5 30 114 20 0 0 x 0 0 0\n", "table.cell", ("line 2, vd", "'x'")),
        ("2020/11/05 23:59:58.000 35 139 50 1 12\n", "rtklib.no_header", ()),
        ("t,lat,lon,h\n\x00\x01\x02", "file.binary", ()),
    ],
)
def test_bad_files_are_named_with_line_and_field(
    tmp_path: Path, content: str, key: str, names: tuple[str, ...]
) -> None:
    file = tmp_path / "bad.txt"
    file.write_text(content)
    with refused(key, RecordingError, str(file), *names):
        read_trajectory(file)


def test_a_file_that_is_not_there_or_cut_short(tmp_path: Path) -> None:
    with refused("file.unreadable", RecordingError, "none.csv"):
        read_trajectory(tmp_path / "none.csv")
    (tmp_path / "cut.csv.gz").write_bytes(gzip.compress(b"t,lat,lon,h\n0,30,114,20\n" * 50)[:-12])
    with refused("file.damaged", RecordingError, "cut.csv.gz"):
        read_trajectory(tmp_path / "cut.csv.gz")


def test_repeated_stamps_and_rows_without_position_are_left_out_and_counted(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("t,lat,lon,h\n0,30,114,20\n0,30,114,21\n1,,,\n2,30,114,23\n")
    found = read_trajectory(file)
    np.testing.assert_allclose(found.llh[:, 2], [20, 23])
    assert {"trajectory.no_position", "trajectory.repeated"} <= set(map(get_key, found.notes))


def test_tum_attitude_is_in_the_frame_of_the_positions(tmp_path: Path) -> None:
    """A level body 100 km east of the start is not level in the start's frame; its up axis must say so."""
    llh = np.array([[0.0, 0.0, 0.0], [0.0, 100e3 / 6378137.0, 0.0]])
    write_as("tum", Trajectory(np.array([0.0, 1.0]), llh, rph=np.zeros((2, 3))), tmp_path / "a.tum")
    q = np.loadtxt(tmp_path / "a.tum")[1, 4:]
    up = rotation.from_quaternion(q[[3, 0, 1, 2]])[:, 2]
    angle = 100e3 / 6378137.0  # along the equator
    np.testing.assert_allclose(up, [np.sin(angle), 0.0, np.cos(angle)], atol=1e-9)
