"""RTKLIB's solutions in each of the forms that it writes, by RTKLIB itself where it is installed."""

from __future__ import annotations

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest
from helpers import refused

from graphnav.app import cli
from graphnav.core.earth import LocalFrame, llh_to_ecef
from graphnav.core.errors import RecordingError
from graphnav.core.notes import get_key
from graphnav.core.trajectory import Trajectory
from graphnav.recording.formats import load, read
from graphnav.recording.formats.trajectories import read_trajectory

DEG = np.pi / 180
DRIVE = Path(__file__).resolve().parents[2] / "data" / "kamakura_rtk"
BASE = (-3959400.631, 3385704.533, 3667523.111)  # m, of recording.toml
SECONDS = 282600.0  # of the week at t = 0
LLH, XYZ, ENU = "SOLF_LLH", "SOLF_XYZ", "SOLF_ENU"

POS = """\
% program   : RTKLIB ver.2.4.3 b34
% inp file  : rover.obs
% obs start : 2020/11/05 23:59:58.0 GPST (week2130 431998.0s)
%
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio
2020/11/05 23:59:58.000   35.666800000  -139.792200000    59.7500   1  12   0.0100   0.0200   0.0300   0.0010  -0.0010   0.0020   0.00   12.3
2020/11/05 23:59:58.200   35.666800100  -139.792200100    59.7600   2  12   0.1100   0.1200   0.1300   0.0010  -0.0010   0.0020   0.00    1.3
2020/11/06 00:00:00.400   35.666800200  -139.792200200    59.7700   5   9   1.1100   1.1200   1.1300   0.0010  -0.0010   0.0020   0.00    0.0
"""  # noqa: E501


def test_rtklib(tmp_path: Path) -> None:
    file = tmp_path / "rover.pos"
    file.write_text(POS)
    found = read_trajectory(file)
    # 2020-11-05 is a Thursday: four days into the week that starts on Sunday; the header says so too.
    np.testing.assert_allclose(found.t, [431998.0, 431998.2, 432000.4], atol=1e-6)
    np.testing.assert_allclose(found.llh[0], [35.6668 * DEG, -139.7922 * DEG, 59.75])
    np.testing.assert_allclose(found.sd_p[0], [0.02, 0.01, 0.03])  # north first in the file
    assert found.v is None
    assert found.notes == ()


def test_rtklib_with_week_and_seconds_velocity_and_utc(tmp_path: Path) -> None:
    file = tmp_path / "rover.pos"
    titles = "%  UTC   latitude(deg) longitude(deg)  height(m)   Q  ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m)"
    titles += " sdun(m) age(s) ratio vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun"
    row = "2130 {} 35.0 139.0 50.0 1 12 0.01 0.02 0.03 0 0 0 0 9.9 1.5 -2.5 0.5 0.1 0.2 0.3 0 0 0"
    file.write_text("\n".join([titles, row.format("604799.000"), row.format("604799.200")]) + "\n")
    found = read_trajectory(file)
    np.testing.assert_allclose(found.t, [17.0, 17.2])  # of the next week, in GPS time
    assert found.gps_zero == 2131 * 604800.0
    np.testing.assert_allclose(found.v[0], [-2.5, 1.5, 0.5])
    np.testing.assert_allclose(found.sd_v[0], [0.2, 0.1, 0.3])
    assert "trajectory.time_scale" in map(get_key, found.notes)


def test_rtklib_with_commas_is_the_same(tmp_path: Path) -> None:
    (tmp_path / "a.pos").write_text(POS)
    # RTKLIB leaves the space between date and time whatever separates the columns.
    lines = [
        ",".join(line.split()).replace(",", " ", 1) if line[0] != "%" else line.replace(" latitude", ",latitude")
        for line in POS.splitlines()
    ]
    (tmp_path / "b.pos").write_text("\n".join(lines).replace("(deg) ", "(deg),").replace("(m) ", "(m),"))
    a, b = read_trajectory(tmp_path / "a.pos"), read_trajectory(tmp_path / "b.pos")
    np.testing.assert_array_equal(a.t, b.t)
    np.testing.assert_array_equal(a.llh, b.llh)
    np.testing.assert_array_equal(a.sd_p, b.sd_p)


def test_rtklib_heights_above_the_sea_are_said_and_another_datum_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.pos"
    file.write_text(POS.replace("WGS84/ellipsoidal", "WGS84/geodetic"))
    assert "trajectory.height" in map(get_key, read_trajectory(file).notes)
    file.write_text(POS.replace("WGS84/ellipsoidal", "Tokyo/ellipsoidal"))
    with refused("rtklib.datum", RecordingError, "out-datum=wgs84"):
        read_trajectory(file)


HEADERS = {
    "% GPST e-baseline(m) n-baseline(m) u-baseline(m) Q ns sde(m) sdn(m) sdu(m)": "rtklib.baseline",  # no "ref pos"
    "% GPST x-ecef(m) y-ecef(m) Q ns sdx(m) sdy(m) sdz(m)": "rtklib.columns",
    "% program : RTKLIB": "rtklib.no_header",
}


@pytest.mark.parametrize("titles", HEADERS)
def test_other_solutions_are_refused(tmp_path: Path, titles: str) -> None:
    file = tmp_path / "rover.pos"
    file.write_text(titles + "\n2020/11/05 23:59:58.000 1 2 3 1 12 0.01 0.02 0.03\n")
    with refused(HEADERS[titles], RecordingError, str(file)):
        read_trajectory(file)


def test_a_time_that_is_none_is_named(tmp_path: Path) -> None:
    file = tmp_path / "rover.pos"
    file.write_text(POS.replace("00:00:00.400", "00:00:61.400"))
    with refused("table.date", RecordingError, "line 9", "'2020-11-06 00:00:61.400'"):
        read_trajectory(file)


@pytest.mark.parametrize(
    ("place", "meant"),
    [
        ("40.086179918-105.206044414 1575.6355", (40.086179918, -105.206044414)),  # as demo5 puts it, without a blank
        (" -0 05 10.24770 -105 12 21.75989  1575.6355", (-0.08617991666, -105.206044414)),
    ],
)
def test_a_baseline_begins_at_the_place_of_the_base(tmp_path: Path, place: str, meant: tuple[float, float]) -> None:
    """Fifty kilometres to the east a plane is 200 m above the ellipsoid, and its axes are turned by half a degree."""
    file = tmp_path / "rover.pos"
    titles = "e-baseline(m) n-baseline(m) u-baseline(m) Q ns sde(m) sdn(m) sdu(m) sden(m) sdnu(m) sdue(m) ve vn vu"
    titles += " sdve sdvn sdvu sdven sdvnu sdvue"
    row = "2015/12/14 17:24:57.000 50000.0 0.0 -2.5 2 14 1.0 2.0 3.0 0.5 -0.4 -0.8 20.0 0.0 0.0 .1 .1 .1 0 0 0"
    file.write_text(f"% ref pos   :{place}\n%  GPST {titles}\n{row}\n")
    found = read_trajectory(file)
    base = np.array([*np.radians(meant), 1575.6355])
    frame = LocalFrame(base)
    np.testing.assert_allclose(frame.from_llh(found.llh)[0], [50000.0, 0.0, -2.5], atol=1e-3)
    ahead = frame.from_llh(found.llh)[0] + np.array([20.0, 0.0, 0.0])
    climb = frame.to_llh(ahead)[2] - found.llh[0, 2]
    assert found.v[0, 2] == pytest.approx(climb, abs=1e-4)
    assert 0.1 < climb < 0.2
    # what is known is the same in all axes
    assert np.square(found.sd_p).sum() == pytest.approx(14.0)
    np.testing.assert_allclose(found.sd_v, 0.1)


def solve(rt, folder: Path, name: str, **options: object) -> Path:
    """Forty seconds of a real drive by RTKLIB, with a base, as `options` of its solution say."""
    for file in ("rover.obs", "base.obs", "nav"):
        (folder / file).write_bytes(gzip.decompress((DRIVE / f"{file}.gz").read_bytes()))
    processing, solution = rt.prcopt_default, rt.solopt_default
    processing.mode, processing.nf, processing.navsys = rt.PMODE_KINEMA, 2, rt.SYS_GPS | rt.SYS_GAL
    processing.refpos, processing.elmin = 0, 0.26
    for k, metres in enumerate(BASE):
        processing.rb[k] = metres
    chosen = {
        "posf": LLH,
        "times": "TIMES_GPST",
        "timef": 1,
        "degf": 0,
        "outvel": 1,
        "timeu": 3,
        "outhead": 1,
        **options,
    }
    for key, value in chosen.items():
        setattr(solution, key, getattr(rt, value) if isinstance(value, str) else value)
    path = folder / name
    text = rt.Arr1Dchar(len(str(path)) + 1)
    for k, letter in enumerate(f"{path}\0"):
        text[k] = letter
    inputs = [str(folder / file) for file in ("rover.obs", "base.obs", "nav")]
    rt.postpos(rt.gtime_t(), rt.gtime_t(), 0.0, 0.0, processing, solution, rt.filopt_t(), inputs, 3, text, "", "")
    return path


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Trajectory:
    rt = pytest.importorskip("pyrtklib")
    return read_trajectory(solve(rt, tmp_path_factory.mktemp("rtklib"), "llh.pos"))


@pytest.mark.parametrize(
    "options",
    [
        {"degf": 1},
        {"posf": XYZ},
        {"posf": ENU},
        {"posf": ENU, "degf": 1, "times": "TIMES_UTC", "outvel": 0},
        {"posf": XYZ, "times": "TIMES_UTC", "timef": 0},
        {"times": "TIMES_JST"},
    ],
    ids=lambda options: "-".join(f"{key}={value}" for key, value in options.items()),
)
def test_whatever_form_rtklib_writes_it_is_the_same_solution(plain, tmp_path, options):
    path = solve(pytest.importorskip("pyrtklib"), tmp_path, "other.pos", **options)
    other = read_trajectory(path)
    np.testing.assert_allclose(other.t, plain.t, atol=1e-6)
    assert other.gps_zero == plain.gps_zero
    assert np.linalg.norm(llh_to_ecef(other.llh) - llh_to_ecef(plain.llh), axis=1).max() < 5e-4  # of digits written
    np.testing.assert_allclose(other.sd_p, plain.sd_p, atol=2e-3)
    np.testing.assert_array_equal(other.fix_type, plain.fix_type)
    assert other.v is None  # RTKLIB writes zeros where it does not estimate velocities
    log = load(path)
    assert (log.gps_zero, len(log.gnss.t)) == (plain.gps_zero, len(plain))
    assert log.gnss.v is None


def test_rtklibs_own_solution_stands_beside_ours(tmp_path):
    """In UTC, as a baseline, of the antenna: its epochs are ours after 18 s."""
    path = solve(pytest.importorskip("pyrtklib"), tmp_path, "theirs.pos", posf=ENU, times="TIMES_UTC")
    command = ["compare", DRIVE, "-o", tmp_path / "out", "--solvers", "ekf", "--noise", "stated", "--quiet"]
    assert cli.run([str(x) for x in [*command, "--against", path, "--against-point", "antenna"]]) == 0
    with (tmp_path / "out" / "comparison.csv").open(encoding="utf-8", newline="") as file:
        ours, theirs = csv.DictReader(file)
    assert (ours["solver"], theirs["solver"]) == ("ekf", "theirs")
    truth, track = read(DRIVE).truth, read_trajectory(path)
    frame, t = LocalFrame(truth.llh[0]), track.t - SECONDS
    true = np.stack([np.interp(t, truth.t, axis) for axis in frame.from_llh(truth.llh).T], -1)
    off = np.linalg.norm((frame.from_llh(track.llh) - true)[:, :2], axis=1)
    assert off[track.fix_type == 1.0].max() < 0.01  # fixed; the truth is another program's of the same files
    assert float(theirs["h_max_m"]) == pytest.approx(off.max(), abs=0.01)


def test_a_solution_that_ends_within_a_line_is_read_to_there(tmp_path):
    for name, text in (("whole", POS), ("cut", POS[:-60])):
        (tmp_path / f"{name}.pos").write_text(text)
    want, found = (read_trajectory(tmp_path / f"{name}.pos") for name in ("whole", "cut"))
    assert np.array_equal(found.llh, want.llh[:-1])
    assert [get_key(note) for note in found.notes] == ["trajectory.cut"]
