"""Reading recordings: axes, units, columns and clocks come out as formats say."""

from __future__ import annotations

import gzip
import itertools
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_told, refused
from test_bad_input import TOML, write_small

from graphnav.core.earth import LocalFrame
from graphnav.core.errors import RecordingError
from graphnav.core.notes import get_key
from graphnav.recording import ImuNoise
from graphnav.recording.formats import list_formats, read
from graphnav.recording.formats.axes import parse_axes_letters, parse_axes_vectors
from graphnav.recording.formats.repair import DEFAULT_SD

IMU_ROWS = "t,gx,gy,gz,ax,ay,az\n0.01,1,2,3,4,5,6\n0.02,1,2,3,4,5,6\n"


def describe(folder: Path, imu: str = "", rest: str = "", rows: str = IMU_ROWS) -> Path:
    """A recording of two IMU rows with these lines in [imu] and after it."""
    (folder / "imu.csv").write_text(rows)
    head = 'format = "graphnav-recording/1"\nplatform = "vehicle"\n'
    (folder / "recording.toml").write_text(f'{head}[imu]\nfile = "imu.csv"\n{imu}\n{rest}\n')
    return folder


# ---- axes


@pytest.mark.parametrize(
    ("axes", "force"),  # what file (4, 5, 6) is as right, forward, up
    [("RFU", (4, 5, 6)), ("FLU", (-5, 4, 6)), ("FRD", (5, 4, -6)), ("BRU", (5, -4, 6)), ("DFR", (6, 5, -4))],
)
def test_three_letters_turn_rate_and_force(tmp_path: Path, axes: str, force: tuple[float, ...]) -> None:
    imu = read(describe(tmp_path, f'axes = "{axes}"')).imu
    assert np.array_equal(imu.accel, [force] * 2)
    assert np.array_equal(imu.gyro, np.array([[1.0, 2.0, 3.0]] * 2) @ imu.R_bs.T)


def test_half_of_all_letter_triples_are_right_handed_and_those_are_rotations() -> None:
    triples = ["".join(x) for pick in itertools.permutations(["RL", "FB", "UD"]) for x in itertools.product(*pick)]
    good, refused = [], 0
    for axes in triples:
        try:
            good.append(parse_axes_letters(axes))
        except ValueError:
            refused += 1
    assert (len(good), refused) == (24, 24)
    assert np.allclose(np.linalg.det(good), 1.0)


def test_forward_and_up_vectors_keep_up_and_square_forward() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        forward, up = rng.normal(size=(2, 3))
        if abs(forward @ up) > 0.9 * np.linalg.norm(forward) * np.linalg.norm(up):
            continue
        R = parse_axes_vectors(forward, up)
        assert np.allclose(R @ R.T, np.eye(3))
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert np.allclose(R @ up / np.linalg.norm(up), [0, 0, 1])
        turned = R @ forward
        assert turned[1] > 0
        assert turned[0] == pytest.approx(0.0, abs=1e-12)


def test_vectors_along_the_axes_are_the_letters() -> None:
    # FLU: forward is x, up is z
    assert np.allclose(parse_axes_vectors((2, 0, 0), (0, 0, 3)), parse_axes_letters("FLU"))


# ---- units, clocks, columns


def test_units_become_si(tmp_path: Path) -> None:
    imu = read(
        describe(tmp_path, 'units = { t = "ms", gyro = "deg/s", accel = "g" }', rows=IMU_ROWS.replace("0.0", ""))
    ).imu
    assert np.allclose(imu.t, [0.001, 0.002])
    assert np.allclose(imu.gyro[0], np.radians([1, 2, 3]))
    assert np.allclose(imu.accel[0], np.array([4, 5, 6]) * 9.80665)
    days = read(describe(tmp_path, 'units = { t = "d" }', rows=IMU_ROWS.replace("0.0", "45966.000000"))).imu
    assert np.diff(days.t) == pytest.approx(0.00864, abs=1e-6)  # what numbers of 64 bits resolve


@pytest.mark.parametrize(("unit", "mps"), [("m/s", 36.0), ("km/h", 10.0), ("mph", 16.09344), ("knots", 18.52)])
def test_speed_units(tmp_path: Path, unit: str, mps: float) -> None:
    (tmp_path / "odo.csv").write_text("t,speed\n0,36\n1,36\n")
    rest = f'[odometer]\nfile = "odo.csv"\nunits = {{ speed = "{unit}" }}\ntime_offset = -0.65'
    odometer = read(describe(tmp_path, rest=rest)).odometer
    assert np.allclose(odometer.speed, mps)
    assert np.allclose(odometer.t, [-0.65, 0.35])


def test_gnss_velocities_and_their_sigmas_share_the_unit(tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text(
        "t,lat,lon,h,sd_e,sd_n,sd_u,ve,vn,vu,sd_ve,sd_vn,sd_vu\n"
        "0,50,8,100,1,2,3,36,72,0,3.6,3.6,3.6\n1,50,8,100,1,2,3,36,#N/A,0,3.6,3.6,3.6\n2,50,8,100,,2,3,0,0,0,3.6,,3.6\n"
    )
    rest = '[gnss]\nfile = "g.csv"\nunits = { speed = "km/h" }\nsd = [9.0, 9.0, 9.0]\nsd_v = [0.5, 0.6, 0.7]'
    gnss = read(describe(tmp_path, rest=rest)).gnss
    assert np.allclose(gnss.v[0], [10, 20, 0])
    assert np.isnan(gnss.v[1]).all()  # an epoch without one component has no velocity
    assert np.isnan(gnss.sd_v[1]).all()
    assert np.allclose(gnss.sd_v[2], [1.0, 0.6, 1.0])  # the blank one is the description's, in m/s
    assert np.allclose(gnss.sd, [[1, 2, 3], [1, 2, 3], [9, 2, 3]])
    assert np.allclose(gnss.llh[0], [np.radians(50), np.radians(8), 100])


def test_speeds_over_ground_have_the_sigmas_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text(
        "t,lat,lon,h,sd_e,sd_n,sd_u,speed,course,sd_ve,sd_vn,sd_vu\n0,50,8,100,2,2,3,10,90,0.5,0.5,0.5\n"
        "1,50,8,100,2,2,3,0.1,,0.3,0.3,0.3\n2,50,8,100,2,2,3,10,0,,,\n3,50,8,100,2,2,3,,,0.5,0.5,0.5\n"
    )
    gnss = read(describe(tmp_path, rest='[gnss]\nfile = "g.csv"')).gnss
    assert gnss.v[:3] == pytest.approx(np.array([[10, 0, 0], [0, 0.1, 0], [0, 10, 0]]), abs=1e-12)
    # upward it is not measured: a slope of one in ten
    assert gnss.sd_v[:3] == pytest.approx(np.array([[0.5, 0.5, 1.0], [0.3, 0.3, 0.3], [0.2, 0.2, 1.0]]))
    assert np.isnan(gnss.v[3]).all()
    assert np.isnan(gnss.sd_v[3]).all()


def test_what_a_phone_marks_as_unknown_is_not_used(tmp_path: Path) -> None:
    """-1, beside which there are no other negative values: courses from -180 to 180 are all known."""
    head = "t,lat,lon,h,sd_e,sd_n,sd_u,speed,course,sd_ve,sd_vn,sd_vu\n"
    rows = ["0,50,8,100,2,2,3,-1,-1,-1,-1,-1", "1,50,8,100,-1,-1,3,5,0,1,1,1", "2,50,8,0,2,2,-1,5,0,1,1,1"]
    rows += ["3,50,8,100,2,2,3,5,0,-1,-1,-1", "4,50,8,100,2,2,3,5,90,1,1,1", "5,50,8,100,2,2,3,0,-1,1,1,1"]
    (tmp_path / "g.csv").write_text(head + "\n".join(rows) + "\n")
    recording = read(describe(tmp_path, rest='[gnss]\nfile = "g.csv"'))
    assert_told(recording.remarks, "gnss.sigma_unknown")
    assert recording.gnss.t == pytest.approx([0, 3, 4, 5])
    assert np.isnan(recording.gnss.v[:2]).all()
    assert recording.gnss.v[2:] == pytest.approx(np.array([[5, 0, 0], [0, 0, 0]]), abs=1e-12)
    (tmp_path / "g.csv").write_text("t,lat,lon,h,speed,course\n0,50,8,100,5,-1\n1,50,8,100,5,-90\n")
    signed = read(describe(tmp_path, rest='[gnss]\nfile = "g.csv"')).gnss
    assert signed.v[1] == pytest.approx([-5, 0, 0], abs=1e-12)
    assert signed.v[0] == pytest.approx([-5 * np.sin(np.radians(1)), 5 * np.cos(np.radians(1)), 0])
    (tmp_path / "g.csv").write_text(head + "\n".join(["1,50,8,100,-1,-1,3,5,0,1,1,1"] * 2) + "\n")
    with refused("gnss.sigma_all_unknown", RecordingError, "g.csv"):
        read(describe(tmp_path, rest='[gnss]\nfile = "g.csv"'))


def test_positions_in_radians_and_longitudes_beyond_180(tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text("t,lat,lon,h\n0,0.5,-1.5,100\n")
    gnss = read(describe(tmp_path, rest='[gnss]\nfile = "g.csv"\nunits = { angle = "rad" }')).gnss
    assert np.array_equal(gnss.llh, [[0.5, -1.5, 100]])
    assert np.array_equal(gnss.sd, [DEFAULT_SD])
    (tmp_path / "g.csv").write_text("t,lat,lon,h\n0,40,254.5,100\n")
    gnss = read(describe(tmp_path, rest='[gnss]\nfile = "g.csv"')).gnss
    assert np.degrees(gnss.llh[0, 1]) == pytest.approx(-105.5)


@pytest.mark.parametrize(
    "rows",
    [
        IMU_ROWS,
        "\ufeff" + IMU_ROWS,
        IMU_ROWS.replace("\n", "\r\n"),
        IMU_ROWS.rstrip("\n"),
        "# a comment\n\n" + IMU_ROWS + "\n# the end\n",
        IMU_ROWS.replace("\n", " # more, and more\n"),
        "% a comment, of MATLAB\n%\n" + IMU_ROWS.replace("\n0.02", "\n  % pause, 2\n0.02") + "% the end",
        "az,load (%),ay,ax,gz,gy,gx,t\n6,5%,5,4,3,2,1,0.01\n6,%,5,4,3,2,1,0.02\n",
        "az,note,ay,ax,gz,gy,gx,t\n6,#N/A,5,4,3,2,1,0.01\n6,# 7,5,4,3,2,1,0.02#\n",
        " t , gx,gy ,gz,ax,ay, az\n 0.01, 1,2,3,4,5,6\n0.02 ,1,2,3,4,5,6 \n",
        "az,note,ay,ax,gz,gy,gx,t\n6,first,5,4,3,2,1,0.01\n6,,5,4,3,2,1,0.02\n",
        '"t","gx","gy","gz","ax","ay","az"\n0.01,1,2,3,4,5,6\n0.02,1,2,3,4,5,6\n',
    ],
    ids=[
        "plain",
        "bom",
        "crlf",
        "no-last-newline",
        "comments",
        "comments-in-lines",
        "comments-of-matlab",
        "percents-in-cells",
        "hashes-in-cells",
        "spaces",
        "any-order-and-text",
        "quoted-header",
    ],
)
def test_ways_to_write_the_same_table(tmp_path: Path, rows: str) -> None:
    describe(tmp_path)
    (tmp_path / "imu.csv").write_bytes(rows.encode())
    imu = read(tmp_path).imu
    assert np.array_equal(imu.t, [0.01, 0.02])
    assert np.array_equal(imu.gyro, [[1, 2, 3]] * 2)
    assert np.array_equal(imu.accel, [[4, 5, 6]] * 2)


def test_gzip_and_plain_are_the_same(tmp_path: Path) -> None:
    plain = read(write_small(tmp_path))
    (tmp_path / "imu.csv.gz").write_bytes(gzip.compress((tmp_path / "imu.csv").read_bytes()))
    (tmp_path / "zipped.toml").write_text(TOML.replace('"imu.csv"', '"imu.csv.gz"'))
    zipped = read(tmp_path / "zipped.toml")
    assert np.array_equal(plain.imu.accel, zipped.imu.accel)
    assert [p.name for p in zipped.files] == ["zipped.toml", "imu.csv.gz", "gnss.csv", "odometer.csv", "truth.csv"]


def test_keep_is_applied_before_anything_else(tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text(
        "t,lat,lon,h,q\n0,91,8,100,0\n1,50,8,100,1\n2,51,8,inf,0\n3,52,8,100,2\n4,53,8,1,\n"
    )
    rest = '[gnss]\nfile = "g.csv"\nsd = [1.0, 1.0, 1.0]\nkeep = { column = "q", at_least = 1 }'
    with refused("table.not_finite", RecordingError, "line 4"):  # infinite values are refused wherever they are
        read(describe(tmp_path, rest=rest))
    (tmp_path / "g.csv").write_text((tmp_path / "g.csv").read_text().replace("inf", "1"))
    assert np.array_equal(read(describe(tmp_path, rest=rest)).gnss.t, [1, 3])


def test_defaults_are_those_stated(tmp_path: Path) -> None:
    recording = read(describe(tmp_path))
    assert recording.name == tmp_path.name
    assert (recording.gnss, recording.odometer, recording.truth) == (None, None, None)
    assert np.array_equal(recording.imu.R_bs, np.eye(3))
    assert recording.imu.noise == ImuNoise()
    assert recording.imu.noise_assumed
    assert len(recording.remarks) == 1


# ---- truth


def test_truths(tmp_path: Path) -> None:
    closed = read(describe(tmp_path, rest="[truth]\nclosed_loop_sigma = 0.01")).truth
    assert closed.closed_loop_sigma == 0.01
    assert np.array_equal(closed.t, [0.01, 0.02])
    (tmp_path / "t.csv").write_text("t,x,y,roll\n0,1,2,90\n1,3,4,\n")
    local = read(describe(tmp_path, rest='[truth]\nfile = "t.csv"\nframe = "local"')).truth
    assert np.array_equal(local.xyz, [[1, 2], [3, 4]])
    assert np.allclose(local.rph, [[np.pi / 2, np.nan, np.nan], [np.nan] * 3], equal_nan=True)
    assert local.llh is None


# ---- real recordings


def test_every_real_recording_loads_and_gravity_is_up(shared_data: Path) -> None:
    files = sorted(shared_data.glob("*/*.toml"))
    assert len(files) >= 25
    for file in files:
        recording = read(file)
        # a vehicle's mean force is up; a foot's is only while it stands, as all do in the first second
        first = recording.imu.t < recording.imu.t[0] + 1.0
        up = recording.imu.accel[first if recording.platform == "foot" else slice(None)].mean(axis=0)
        # a car's accelerometer reads 3.9 % high (its README)
        assert 9.5 < np.linalg.norm(up) < (10.25 if "circles_boston_20241021" in str(file) else 10.1), file
        assert up[2] / np.linalg.norm(up) > 0.97, file
        odd = {
            f"{sensor}.rows_{what}"
            for sensor in ("imu", "gnss")
            for what in ("blank", "repeated", "unordered", "sorted")
        }
        assert not odd & set(map(get_key, recording.remarks)), file


def test_boulder_is_turned_shifted_and_keeps_its_own_sigmas(shared_data: Path) -> None:
    recording = read(shared_data / "boulder_drive_20250708")
    # first row of the file: 21.8540,-0.006266,0.016511,0.002932,1.13757,0.30401,9.65955 with x back, y right
    assert recording.imu.t[0] == pytest.approx(21.754)
    assert np.allclose(recording.imu.gyro[0], [0.016511, 0.006266, 0.002932])
    assert np.allclose(recording.imu.accel[0], [0.30401, -1.13757, 9.65955])
    assert np.allclose(recording.gnss.sd[0], [0.0099, 0.0099, 0.0100])
    assert np.allclose(recording.gnss.sd_v[0], 0.06)  # the file's scalar sd_v is not ours
    assert np.allclose(recording.gnss.lever_arm, [-0.05, 0, 0])


def test_tokyo_keeps_trusted_truth_and_epochs_without_velocity(shared_data: Path) -> None:
    recording = read(shared_data / "tokyo_20201105")
    assert len(recording.truth.t) == 5082 + 1000  # trust 2 and trust 1, as its README counts
    assert recording.truth.of == "gnss"
    assert np.isnan(recording.gnss.v[0]).all()
    assert np.allclose(recording.gnss.v[1], [-0.0010, 0.0109, -0.0219])
    assert recording.odometer.t[0] == pytest.approx(32.00 - 0.65)


def test_kitti_is_built_in() -> None:
    recording = read("kitti")
    assert list_formats()["kitti"].builtin
    assert (len(recording.imu.t), len(recording.gnss.t)) == (46968 - 1, 470 - 1)
    assert np.diff(recording.imu.t).max() < 0.05  # the 1.92-s gap is gone
    assert recording.gnss.t[0] > recording.imu.t[0]
    # a frame around the nominal origin gives back the file's metres: row 1 is 3.897, 7.545, 0.025
    p = LocalFrame(np.array([np.radians(49.0), np.radians(8.4), 115.0])).from_llh(recording.gnss.llh)
    assert np.allclose(p[0], [3.8971155, 7.5450739, 0.0247879], atol=1e-6)
    assert_told(recording.remarks, "log.origin")
