"""`compare --against`: another program's trajectory is in all tables and figures, on our clock, at our point."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import logs
import numpy as np
import pytest
from helpers import refuse_command, refused

from graphnav.app import cli
from graphnav.app.scores import score
from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import RecordingError
from graphnav.core.interpolation import interpolate, place_on_earth
from graphnav.core.notes import get_key
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import ParameterEstimate, Solution
from graphnav.evaluation.against import Against, find_antenna_lever_arm, read_against
from graphnav.evaluation.scoring import compute_errors
from graphnav.recording import Truth
from graphnav.recording.exporters import write_as
from graphnav.recording.formats.writer import write_folder

RECORDING, TRUTH = logs.simulated(60.0)
ZERO = logs.WEEK * 604800.0 + logs.TOW


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    """A recording with the truth of its IMU and a date."""
    part = TRUTH.take((TRUTH.t >= RECORDING.start) & (TRUTH.t <= RECORDING.end))
    truth = Truth(part.t, part.llh, None, part.v, part.rph)
    folder = tmp_path_factory.mktemp("drive")
    write_folder(replace(RECORDING, truth=truth, gps_zero=ZERO), folder)
    return folder


def moved(east: float, shift: float = 0.0) -> Trajectory:
    """The truth somewhat to the east, s later, with the rows of the drive alone."""
    part = TRUTH.take((TRUTH.t >= RECORDING.start - 1e-6) & (TRUTH.t <= RECORDING.end))
    frame = LocalFrame(part.llh[0])
    return replace(part, t=part.t + shift, llh=frame.to_llh(frame.from_llh(part.llh) + np.array([east, 0.0, 0.0])))


def every(period: float, track: Trajectory, offset: float = 0.0) -> Trajectory:
    """Its rows at multiples of a period, s, from an offset."""
    k = (track.t - offset) / period
    return track.take(np.abs(k - np.round(k)) < 1e-6)


@pytest.fixture(scope="module")
def ekf() -> Solution:
    """The filter's, with noise as stated."""
    return run(RECORDING, Settings.model_validate({"noise": {"mode": "stated"}}), ("ekf",))["ekf"]


def compare(drive: Path, out: Path, *more: object) -> dict[str, dict[str, str]]:
    """Rows of comparison.csv by their names."""
    arguments = ["compare", drive, "-o", out, "--solvers", "ekf", "--noise", "stated", "--quiet", *more]
    assert cli.run([str(a) for a in arguments]) == 0
    with (out / "comparison.csv").open(encoding="utf-8", newline="") as file:
        return {row["solver"]: row for row in csv.DictReader(file)}


def test_three_kinds_of_files_stand_beside_ours(drive, tmp_path):
    utc = np.datetime64("2022-03-09T23:59:42", "us") + (moved(2.0).t * 1e6).astype("timedelta64[us]")
    write_as("nav", moved(2.0), tmp_path / "filter.nav", utc)  # in seconds of the GPS week
    logs.write_rtklib(tmp_path / "rover.pos", RECORDING, "UTC")  # exact, of the antenna, 18 s behind
    local = replace(moved(0.0), t=moved(0.0).t - RECORDING.start, frame="local")
    frame = LocalFrame(local.llh[0])
    local = replace(local, llh=frame.from_llh(local.llh))
    turned = place_on_earth(local, frame, 0.7, np.array([5.0, 6.0, 7.0]))
    turned = replace(turned, llh=frame.from_llh(turned.llh), frame="local", v=None)
    write_as("tum", turned, tmp_path / "slam.tum", None)
    write_as("csv", moved(0.0, 0.2), tmp_path / "late.csv", None)
    names = {"filter.nav": "imu", "rover.pos": "antenna", "slam.tum": "0,0,0", "late.csv": "imu"}
    files = [x for name in names for x in ("--against", tmp_path / name)]
    points = [x for point in names.values() for x in ("--against-point", point)]
    rows = compare(drive, tmp_path / "out", *files, *points, "--require", "h_rms<2", "--export", "tum")
    assert list(rows) == ["ekf", "filter", "rover", "slam", "late"]
    assert float(rows["filter"]["e_mean_m"]) == pytest.approx(2.0, abs=1e-3)
    assert float(rows["filter"]["heading_rms_deg"]) < 0.01
    assert float(rows["rover"]["h_rms_m"]) < 0.02  # by the attitude of ours, which is not its own
    assert rows["rover"]["heading_rms_deg"] == ""
    assert float(rows["slam"]["h_rms_m"]) < 0.3  # laid on ours
    assert float(rows["late"]["h_rms_m"]) > 1.0  # 0.2 s of the speed, which are its own
    page = (tmp_path / "out" / "comparison.html").read_text(encoding="utf-8")
    assert all(name in page for name in rows)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"comparison.csv", "comparison.html", "run.npz", "ekf"}


FLU = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # columns: its axes in RFU


@pytest.mark.parametrize(
    ("change", "keys", "number"),
    [
        (lambda rph: rph, [], ""),
        (lambda rph: rph + np.radians([0.0, 0.0, 10.0]), [], ""),  # an error, and no convention
        (lambda rph: rotation.to_rph(rotation.from_rph(rph) @ FLU), ["against.attitude"], r" 90 deg .* FLU,"),
        (lambda rph: rph * [1.0, 1.0, 0.0], ["against.attitude"], r"\d deg"),
    ],
    ids=["same", "wrong", "FLU", "no-heading"],
)
def test_other_axes_of_the_body_are_told(ekf, tmp_path, change, keys, number):
    own = moved(0.0)
    write_as("csv", replace(own, rph=change(own.rph)), tmp_path / "other.csv", None)
    notes = read_against(Against(tmp_path / "other.csv"), "other", replace(RECORDING, truth=None), ekf).notes
    found = [note for note in notes if get_key(note) == "against.attitude"]
    assert [get_key(note) for note in found] == keys
    assert all(re.search(number, note) for note in found)


def test_heights_above_the_sea_are_told(tmp_path):
    for up, keys in ((-40.0, ["against.heights"]), (-2.0, [])):
        lower = replace(moved(0.0), llh=moved(0.0).llh + np.array([0.0, 0.0, up]))
        notes = compute_errors(lower, TRUTH).notes
        assert [get_key(note) for note in notes if get_key(note) == "against.heights"] == keys


def test_north_before_east_is_refused(drive, tmp_path, capsys):
    """A frame of north, east and down is another way, not another yaw."""
    part = moved(0.0)
    frame = LocalFrame(part.llh[0])
    ned = replace(part, llh=frame.from_llh(part.llh)[:, [1, 0, 2]] * [1.0, 1.0, -1.0], frame="local", v=None)
    write_as("tum", ned, tmp_path / "ned.tum", None)
    where = ["--solvers", "ekf", "--noise", "stated", "-o", tmp_path / "out", "--against", tmp_path / "ned.tum"]
    refuse_command(capsys, "against.left_handed", "compare", drive, *where)
    refuse_command(capsys, "against.left_handed", "evaluate", tmp_path / "ned.tum", drive)


def test_a_file_with_few_rows_is_compared_at_these(drive, tmp_path):
    """Not between them, where a line cuts the corners of the way and hides what a filter drifts by."""
    part = moved(0.0)
    rare = every(2.0, part)
    assert 20 < len(rare) < len(part) / 50
    write_as("csv", rare, tmp_path / "rare.csv", None)
    rows = compare(drive, tmp_path / "out", "--against", tmp_path / "rare.csv")
    assert float(rows["rare"]["h_max_m"]) < 1e-4
    assert float(rows["rare"]["heading_max_deg"]) < 1e-4


def test_a_shift_that_is_asked_for_is_made(drive, tmp_path):
    write_as("csv", moved(0.0, 0.2), tmp_path / "late.csv", None)
    rows = compare(drive, tmp_path / "b", "--against", tmp_path / "late.csv", "--against-shift", "-0.2")
    assert float(rows["late"]["h_rms_m"]) < 0.01


@pytest.mark.parametrize("kind", ["nav", "tum"])
@pytest.mark.parametrize(("period", "offset"), [(1.0, 0.5), (0.2, 0.1), (0.02, 0.0)])
def test_epochs_of_its_own_cost_a_file_nothing(ekf, tmp_path, kind, period, offset):
    """An exact file, once a second to fifty times, beside a truth of five rows a second, none of them together."""
    truth, track = every(0.2, moved(0.0)), every(period, moved(0.0), offset)
    drive = replace(RECORDING, truth=Truth(truth.t, truth.llh, None, truth.v, truth.rph), gps_zero=ZERO)
    if kind == "tum":  # neither its place nor its velocity
        track = replace(track, llh=LocalFrame(track.llh[0]).from_llh(track.llh), frame="local", v=None)
    utc = np.datetime64("2022-03-09T23:59:42", "us") + np.round(track.t * 1e6).astype("timedelta64[us]")
    write_as(kind, track, tmp_path / f"its.{kind}", utc)
    beside = read_against(Against(tmp_path / f"its.{kind}"), "its", drive, ekf)
    errors = score(drive, drive, {"ekf": ekf, "its": beside}, ())[0]["its"].errors
    assert errors is not None
    assert len(errors) >= 60
    assert errors.horizontal.max() < 1e-3
    assert np.degrees(np.abs(errors.rph[:, 2])).max() < 0.05  # what 0.2 s of a turn are off the shortest arc


@pytest.mark.parametrize(("period", "late"), [(0.02, 0.0), (0.02, 0.2), (1.0, 0.0), (1.0, 0.2), (2.0, 0.0)])
def test_a_delay_is_told_where_there_is_one(ekf, tmp_path, period, late):
    write_as("csv", every(period, moved(0.0, late), late), tmp_path / "its.csv", None)
    found = read_against(Against(tmp_path / "its.csv"), "its", RECORDING, ekf)
    assert ("against.late" in [get_key(note) for note in found.notes]) == (late > 0.0)


def test_a_delay_is_left_where_the_file_begins_with_the_recording(ekf, tmp_path):
    """Which is no sign that it counts from its own start."""
    early = moved(0.0, -0.2)
    t = RECORDING.start + 0.02 * np.arange(round((RECORDING.end - RECORDING.start) / 0.02) - 20)
    write_as("csv", interpolate(early, t)[0], tmp_path / "its.csv", None)
    found = read_against(Against(tmp_path / "its.csv"), "its", RECORDING, ekf)
    assert found.track.t[0] == pytest.approx(RECORDING.start)
    assert "against.late" in [get_key(note) for note in found.notes]


@pytest.mark.parametrize(
    ("more", "key", "name"),
    [
        (["--against", "none.nav"], "file.missing", "none.nav"),
        (["--against-point", "antenna"], "option.count", "--against-point antenna"),
        (["--against", "FAR"], "against.no_overlap", "--against-shift"),
        (["--against", "FAR", "--against-point", "roof"], "option.point", "--against-point roof"),
    ],
)
def test_what_cannot_stand_beside_ours_is_one_line(drive, tmp_path, capsys, more, key, name):
    write_as("csv", moved(0.0, 1e6), tmp_path / "far.csv", None)
    more = [str(tmp_path / "far.csv") if x == "FAR" else x for x in more]
    arguments = ["compare", str(drive), "-o", str(tmp_path / "out"), "--solvers", "ekf", "--noise", "stated", *more]
    assert name in refuse_command(capsys, key, *arguments)
    assert not (tmp_path / "out").exists()


def spoil(track: Trajectory, how: str) -> Trajectory:
    """Another drive, or a poor trajectory of this one."""
    llh, frame = track.llh.copy(), LocalFrame(track.llh[0])
    if how == "another town":
        llh[:, 0] += np.radians(1.0)
    elif how == "another way":
        llh = llh[::-1]
    elif how == "noisy":
        llh = frame.to_llh(frame.from_llh(llh) + np.random.default_rng(1).normal(0.0, 4.0, llh.shape))
    elif how == "another datum":
        llh = frame.to_llh(frame.from_llh(llh) + np.array([900.0, -400.0, 45.0]))
    return replace(track, llh=llh, v=None)


@pytest.mark.parametrize(
    ("how", "key"),
    [
        ("another town", "against.elsewhere"),
        ("another way", "against.other_drive"),
        ("noisy", None),
        ("another datum", None),
    ],
)
@pytest.mark.parametrize("period", [0.1, 1.0])
def test_a_file_of_another_drive_is_refused_and_a_poor_one_is_not(ekf, tmp_path, how, key, period):
    write_as("csv", spoil(every(period, moved(0.0)), how), tmp_path / "its.csv", None)
    asked = Against(tmp_path / "its.csv")
    if key is None:
        assert len(read_against(asked, "its", RECORDING, ekf).t) > 30
    else:
        with refused(key, RecordingError, "its.csv"):
            read_against(asked, "its", RECORDING, ekf)


@pytest.mark.parametrize(
    ("point", "told"),
    [
        ("antenna", False),
        (-np.array(logs.LEVER_ARM), True),
        ("imu", True),
        (np.array([0.0, 0.0, logs.LEVER_ARM[2]]), True),
    ],
)
def test_a_point_that_the_file_is_not_of_is_told(ekf, tmp_path, point, told):
    antenna = interpolate(moved(0.0), every(0.1, moved(0.0)).t, lever_arm=logs.LEVER_ARM)[0]
    write_as("csv", antenna, tmp_path / "its.csv", None)
    found = read_against(Against(tmp_path / "its.csv", point), "its", RECORDING, ekf)
    assert ("against.other_point" in [get_key(note) for note in found.notes]) == told


@pytest.mark.parametrize("point", ["imu", "antenna"])
@pytest.mark.parametrize("of", ["imu", "gnss", None])
def test_a_file_of_the_antenna_is_met_there_whatever_arm_ours_has_found(ekf, tmp_path, point, of):
    """With a truth of the antenna, or withheld fixes, the arm is of no consequence to it; a file of the IMU has its own
    program's, which is told.
    """
    found = np.array([[0.6, 0.1, 1.0]])
    estimate = ParameterEstimate(np.zeros(1), found, np.full((1, 3), 0.01), np.ones(3), "m")
    ours = replace(ekf, parameters={LEVER_ARM: estimate})
    antenna = interpolate(moved(0.0), every(0.1, moved(0.0)).t, lever_arm=logs.LEVER_ARM)[0]
    path = tmp_path / "its.csv"
    write_as("csv", antenna if point == "antenna" else every(0.1, moved(0.0)), path, None)
    at = antenna if of == "gnss" else TRUTH
    whole = replace(RECORDING, truth=None if of is None else Truth(at.t, at.llh, None, at.v, at.rph, of=of))
    its = read_against(Against(path, point), "its", whole, ours)
    metrics, _, _ = score(whole, whole, {"ekf": ours, "its": its}, () if of else (("gnss", None),))
    assert ("against.lever_arm" in {get_key(note) for note in metrics["its"].notes}) == (of != "imu" and point == "imu")
    if of != "imu" or point == "imu":
        assert metrics["its"].components["3d"].max < 0.02
    else:  # moved to the IMU by the arm found
        np.testing.assert_allclose(
            metrics["its"].components["3d"].max, np.linalg.norm(found - logs.LEVER_ARM), atol=0.02
        )  # fmt: skip


def test_parts_of_a_long_drive_have_one_antenna(ekf):
    parts = ParameterEstimate(
        np.array([0.0, 30.0]), np.array([[0.1, 1.0, 1.0], [0.4, 1.0, 2.0]]), np.array([[0.1] * 3, [0.2] * 3]),
        np.ones(3), "m",
    )  # fmt: skip
    found = find_antenna_lever_arm(RECORDING, replace(ekf, parameters={LEVER_ARM: parts}))
    np.testing.assert_allclose(found, [0.16, 1.0, 1.2])
