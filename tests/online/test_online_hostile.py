"""Live sessions that nothing ends: absurd rows, clocks that are set back, setups that cannot be, failures within."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import oracle
import pytest
from helpers import assert_told, refused
from test_online import off, played, same

import graphnav
from graphnav.app.cli_online import StopRequest, follow
from graphnav.config import Settings, parse_settings
from graphnav.core.errors import ConfigError, GraphnavError, RecordingError
from graphnav.core.notes import get_key
from graphnav.core.trajectory import Trajectory
from graphnav.online import ImuSample, Online, Row, Session, ahead, drop_rows, list_rows, live_setup
from graphnav.online.lines import PROTOCOL, format_line, format_lines, parse_setup
from graphnav.online.store import _MAGIC, Store
from graphnav.online.tracker import Tracker
from graphnav.recording import Recording
from graphnav.recording.formats.trajectories import read_trajectory

QUICK = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 10.0}})
NAN = (float("nan"),) * 6


@pytest.fixture(scope="module")
def drive() -> tuple[Recording, Trajectory]:
    recording, truth = oracle.drive(oracle.vehicle_path(130.0, 25.0), seed=3, odometer_rate=5.0)
    return recording.crop(20.0, 64.0), truth


@pytest.fixture(scope="module")
def rows(drive: tuple[Recording, Trajectory]) -> list[Row]:
    return list_rows(drive[0])[1]


@pytest.fixture(scope="module")
def plain(drive: tuple[Recording, Trajectory], rows: list[Row]) -> Trajectory:
    return played(drive[0], rows, QUICK)[1]


Stepped = tuple[list[Row], list[Row], Online, Trajectory]


@pytest.fixture(scope="module")
def stepped(drive: tuple[Recording, Trajectory], rows: list[Row]) -> Callable[[float], Stepped]:
    """Rows before a step of the clock (s), all of them with those behind it, and what becomes of them."""

    @cache
    def step(by: float) -> Stepped:
        old = [row for row in rows if row[1] <= 41.9]
        sent = [*old, *((name, t + by, values) for name, t, values in rows if t > 41.9)]
        return old, sent, *played(drive[0], sent, QUICK)

    return step


def between(rows: list[Row], more: list[Row]) -> list[Row]:
    """Rows in order of time, those of `more` where they belong."""
    return sorted([*rows, *more], key=lambda row: row[1])


# ------------------------------------------------------------------------------------------------- absurd rows
def test_rows_that_nothing_can_have_sent_change_nothing(
    drive: tuple[Recording, Trajectory], rows: list[Row], plain: Trajectory
) -> None:
    fix = next(values for sensor, t, values in rows if sensor == "gnss" and t > 40.0)
    wild: list[Row] = []
    for k in range(36):  # every second, from before there is any state
        t = 22.513 + k
        imu = (1e6, 1e300, -1e300, 71.0)[k % 4]
        wild += [("imu", t, (0.0, 0.0, imu, 0.0, 0.0, 9.8)), ("imu", t + 1e-3, (0.0, 0.0, 0.0, 0.0, 1e3 * imu, 9.8))]
        wild.append(("odometer", t, ((1e300, -1e300, 151.0)[k % 3], *NAN[:5])))
        sd = ((1e-9, 1.0, 1.0), (1e300, 1.0, 1.0), (1e-320, 1e-320, 1e-320))[k % 3]
        wild.append(("gnss", t, (*fix[:3], *sd, *NAN)))
        far = ((fix[0] + 0.01, fix[1], fix[2]), (9.0, fix[1], fix[2]), (fix[0], fix[1], 1e300), (0.0, 0.0, 0.0))[k % 4]
        wild.append(("gnss", t, (*far, 1.0, 1.0, 1.0, *NAN)))
    online, track = played(drive[0], between(rows, wild), QUICK)
    same(track, plain)
    counts = online.sensors.counts
    assert counts["imu: beyond any sensor"] + counts["imu: not a number"] == 72
    assert counts["odometer: beyond any sensor"] == 36
    assert sum(n for key, n in counts.items() if key.startswith("gnss: ")) == 72
    assert online.failures == []


def test_a_velocity_that_no_vehicle_has_leaves_its_fix(
    drive: tuple[Recording, Trajectory], rows: list[Row], plain: Trajectory
) -> None:
    bad = (1e300, 0.0, 0.0, 0.1, 0.1, 0.1)
    wild = [(s, t, v if s != "gnss" else (*v[:6], *bad)) for s, t, v in rows]
    online, track = played(drive[0], wild, QUICK)
    same(track, plain)
    assert online.sensors.counts["gnss"] == sum(row[0] == "gnss" for row in rows)


@pytest.mark.parametrize("at", [36.28, 56.52])
def test_a_reading_that_those_around_contradict_costs_its_interval(
    drive: tuple[Recording, Trajectory], rows: list[Row], at: float
) -> None:
    """One of -1 rad/s, by which the drive leans by two degrees: before there is a state, and when there is one."""
    alone = [row for row in rows if row[0] != "odometer"]
    wild = [(s, t, (-1.0, *v[1:])) if s == "imu" and abs(t - at) < 0.01 else (s, t, v) for s, t, v in alone]
    assert sum(a != b for a, b in zip(alone, wild, strict=True)) == 1
    online, track = played(drive[0].without("odometer"), wild, QUICK)
    assert online.sensors.counts["imu: contradicted by those around"] == 1
    assert online.excluded == ()
    error, sd = off(track, drive[1], drive[0])
    assert np.abs(error).max() < 0.1
    assert np.abs(error / sd).max() < 6.0


@pytest.mark.parametrize("late", [0.0, 0.3])
@pytest.mark.parametrize("at", [35.72, 56.52])
def test_rows_filled_in_on_straight_lines_count_as_missing(
    drive: tuple[Recording, Trajectory], rows: list[Row], at: float, late: float
) -> None:
    """Half a second, before there is a state, and when there is one, with the digits of all other rows.

    The fix in it is filled in as well, half a metre off, and comes at once or later.
    """
    written = [(s, t, tuple(round(x, 6) for x in v) if s == "imu" else v) for s, t, v in rows]
    imu = [row for row in written if row[0] == "imu"]
    inside = [t for _, t, _ in imu if at < t < at + 0.5]
    times = np.array([t for _, t, _ in imu if t <= at or t >= at + 0.5])
    values = np.array([v for _, t, v in imu if t <= at or t >= at + 0.5])
    line = {t: tuple(round(float(np.interp(t, times, x)), 6) for x in values.T) for t in inside}
    (fix,) = (row for row in written if row[0] == "gnss" and at < row[1] < at + 0.5)
    filled = [(s, t, line[t] if s == "imu" and t in line else v) for s, t, v in written if (s, t, v) != fix]
    behind = next(k for k, row in enumerate(filled) if row[1] >= fix[1] + late)
    filled.insert(behind, ("gnss", fix[1], (fix[2][0] + 0.5 / 6.4e6, *fix[2][1:])))
    missing = [row for row in written if row != fix and (row[0] != "imu" or row[1] not in line)]
    online, track = played(drive[0], filled, QUICK)
    assert online.sensors.counts["imu: on a straight line between those around"] == len(inside)
    same(track, played(drive[0], missing, QUICK)[1])


@pytest.mark.parametrize("k", [0, 30])
def test_a_fix_far_off_is_left_out_wherever_it_comes(
    drive: tuple[Recording, Trajectory], rows: list[Row], k: int
) -> None:
    number = [n for n, row in enumerate(rows) if row[0] == "gnss"][k]
    sensor, t, values = rows[number]
    far = (sensor, t, (values[0] + 0.1, *values[1:]))
    missed = [*rows[:number], *rows[number + 1 :]]
    online, track = played(drive[0], [*rows[:number], far, *rows[number + 1 :]], QUICK)
    same(track, played(drive[0], missed, QUICK)[1])
    assert online.sensors.counts["gnss: out of reach"] == 1
    assert online.sensors.counts["gnss"] == sum(row[0] == "gnss" for row in missed)


# ------------------------------------------------------------------------------------------------------- clocks
def test_a_receiver_whose_clock_is_set_back_is_told_at_the_end(
    drive: tuple[Recording, Trajectory], rows: list[Row]
) -> None:
    """By a second, which stamps of its fixes alone show, and their places: late ones show nothing."""
    middle = 0.5 * (rows[0][1] + rows[-1][1])
    back = [(s, t - 1.0 * (s == "gnss" and t > middle), values) for s, t, values in rows]
    late = sorted(rows, key=lambda row: row[1] + 3.0 * (row[0] == "gnss" and middle < row[1] < middle + 2.5))
    for some, keys in ((back, ["gnss.clock_back"]), (late, []), (rows, [])):
        online, track = played(drive[0], some, QUICK)
        found = [one for one in online.findings if one.key == "gnss.clock_back"]
        assert [one.key for one in found] == keys
        assert all(one.severity == "refused" and "1.00 s" in one.sentence for one in found)
        assert len(track.t) > 30


def test_a_clock_that_is_set_back_begins_a_piece(
    drive: tuple[Recording, Trajectory], rows: list[Row], plain: Trajectory, tmp_path: Path
) -> None:
    """By an hour in the middle, and the drive from its start follows: both are as they would be alone."""
    lines = [line for _, line in format_lines(drive[0])]
    assert rows[0][0] != "imu"  # what the first instant of the new clock shows waits for the IMU to tell that it is one
    back = [(sensor, t - 3600.0, values) for sensor, t, values in rows]
    later = [format_line(row) for row in [*back[:3], back[2], *back[3:]]]  # one of them comes twice
    session = Session(QUICK, "-", tmp_path / "out")
    session.add_lines([*lines[:-1], *later])
    session.finish()
    session.close()
    assert session.online.clocks == 2
    assert "online.clock_back" in map(get_key, session.online.notes)
    one, two = (read_trajectory(tmp_path / "out" / name) for name in ("trajectory.csv", "trajectory-2.csv"))
    alone = played(drive[0], back, QUICK)[1]
    for track, other in ((one, plain), (two, alone)):
        np.testing.assert_allclose(track.t, other.t, atol=1e-6)
        np.testing.assert_allclose((track.llh - other.llh) * [6.4e6, 6.4e6, 1.0], 0.0, atol=1e-3)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["clocks"] == 2


@pytest.mark.parametrize("step", [-3600.0, 3600.0])
def test_a_fix_before_the_first_imu_row_of_another_clock_counts(
    drive: tuple[Recording, Trajectory], rows: list[Row], step: float
) -> None:
    """Whether it comes once or is sent again after that row: set back or set ahead, a clock loses nothing."""
    old = [row for row in rows if row[1] <= 24.0]
    first = next(k for k, row in enumerate(rows) if row[0] == "gnss" and row[1] > 24.0)
    assert rows[first + 1][0] == "imu"
    new = [(sensor, t + step, values) for sensor, t, values in rows[first:]]
    once = Online(drop_rows(drive[0]), QUICK)
    twice = Online(drop_rows(drive[0]), QUICK)
    for online, sent in ((once, [*old, *new[:300]]), (twice, [*old, *new[:2], new[0], *new[2:300]])):
        for row in sent:
            online.add(row)
        assert online.sensors.gnss.t[0 if step < 0 else -1] >= new[0][1]
        assert new[0][1] in online.sensors.gnss.t
        assert online.sensors.counts["gnss: stamp in the future"] == 0
        assert online.sensors.counts["gnss: too late"] == 0
    assert twice.sensors.gnss.t.tolist() == once.sensors.gnss.t.tolist()
    assert twice.sensors.counts["gnss: repeated"] == 1


@pytest.mark.parametrize(
    ("step", "sensor", "which"),
    [
        (-1000.0, "imu", -1),
        (-1000.0, "imu", 0),
        (-1000.0, "gnss", -1),
        (3600.0, "imu", -3),
        (3600.0, "gnss", 0),
    ],
)
def test_a_row_that_comes_late_over_a_step_of_the_clock_counts(
    drive: tuple[Recording, Trajectory],
    stepped: Callable[[float], Stepped],
    step: float,
    sensor: str,
    which: int,
) -> None:
    """By a second, from before the step or from behind it: each piece is as if it had come in its turn."""
    old, sent, plain, other = stepped(step)
    numbers = range(len(old)) if which < 0 else range(len(old), len(sent))
    k = [n for n in numbers if sent[n][0] == sensor][which]
    late = [*sent[:k], *sent[k + 1 : k + 25], sent[k], *sent[k + 25 :]]
    online, track = played(drive[0], late, QUICK)
    assert sorted(late) == sorted(sent)
    assert +online.sensors.counts == +plain.sensors.counts
    assert set(+plain.sensors.counts) == {"imu", "gnss", "odometer"}
    same(track, other)


def test_a_piece_that_an_idle_imu_ends_is_smoothed(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    """Though nothing was aligned when it ended: as at the end of a drive."""
    some = [row for row in rows if row[1] <= 41.9]
    alone = played(drive[0], some, QUICK)[1]
    assert len(alone) > 20
    track = played(drive[0], [*some, *((s, t, v) for s, t, v in rows if t > 60.0)], QUICK)[1]
    same(track.take(np.flatnonzero(track.t < 50.0)), alone)


def test_a_late_fix_that_is_the_last_row_is_used(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    """No IMU row follows that could tell of which clock it is."""
    some = [row for row in rows if row[1] <= 26.0]
    late = [row for row in some if row[0] == "gnss"][-4]
    online = Online(drop_rows(drive[0]), QUICK)
    for row in (*(row for row in some if row is not late), late):
        online.add(row)
    online.finish()
    assert late[1] in online.sensors.gnss.t


def test_a_clock_set_back_before_there_is_any_state(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    """What had come by then is smoothed as if nothing had followed."""
    short = [row for row in rows if row[1] <= rows[0][1] + 14.0]
    back = [(sensor, t - 3600.0, values) for sensor, t, values in rows if sensor == "imu" and t > 40.0]
    online = Online(drop_rows(drive[0]), QUICK)
    for row in short:
        online.add(row)
    assert online.status == "aligning"
    for row in back:
        online.add(row)
    assert online.clocks == 2
    same(online.settled()[0], played(drive[0], short, QUICK)[1])


def test_a_clock_set_back_by_seconds_is_noticed_before_it_spoils_anything(
    drive: tuple[Recording, Trajectory], rows: list[Row]
) -> None:
    """Rows of another moment between those that are there would be read as one motion."""
    back = [(sensor, t - 20.0, values) for sensor, t, values in rows if t > 55.0]
    online, track = played(drive[0], [*(row for row in rows if row[1] <= 55.0), *back], QUICK)
    assert online.clocks == 2
    assert online.failures == []
    old = track.t[: int(np.argmax(np.diff(track.t) < 0)) + 1] if np.any(np.diff(track.t) < 0) else track.t
    error, sd = off(track.take(np.arange(len(old))), drive[1], drive[0])
    assert old[-1] == pytest.approx(55.0, abs=0.05)
    assert np.abs(error / sd).max() < 6.0


def test_a_source_that_begins_again_is_no_other_clock(
    drive: tuple[Recording, Trajectory], rows: list[Row], plain: Trajectory
) -> None:
    """A sender that was cut off sends all from its start, or from ten seconds before."""
    half, more = len(rows) // 2, len(rows) * 3 // 4
    online, track = played(drive[0], [*rows[:half], *rows[:more], *rows[more - 300 :]], QUICK)
    assert online.clocks == 1
    same(track, plain)


def test_a_source_that_begins_again_before_its_clock_was_set_back(
    drive: tuple[Recording, Trajectory], rows: list[Row]
) -> None:
    """Rows of the old clock, sent again, neither lie in the future of the new one nor in its past."""
    old, again = [row for row in rows if row[1] <= 36.0], [row for row in rows if 33.3 < row[1] <= 36.0]
    # sent again before the new clock reaches the times of the old one, and when it has passed them
    for step, until in ((3600.0, 39.0), (5.25, 42.5)):
        new = [(sensor, t - step, values) for sensor, t, values in rows if 36.0 < t <= 48.0]
        seen = [row for row in new if row[1] <= until - step]
        online, track = played(drive[0], [*old, *seen, *again, *new], QUICK)
        plain, other = played(drive[0], [*old, *new], QUICK)
        assert online.clocks == plain.clocks == 2
        assert online.sensors.counts["imu"] == plain.sensors.counts["imu"]
        same(track, other)


def test_a_clock_that_goes_on_from_where_it_was_before(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    """Set back by an hour and ahead again by less: its times come twice, its rows do not."""
    one = [row for row in rows if row[1] <= 46.0]
    two = [(sensor, t - 3600.0, values) for sensor, t, values in rows if 46.0 < t <= 50.0]
    three = [(sensor, t - 10.0, values) for sensor, t, values in rows if t > 50.0]
    online, _ = played(drive[0], [*one, *two, *three], QUICK)
    assert online.clocks == 2
    assert online.sensors.counts["imu"] == sum(row[0] == "imu" for row in rows)
    assert set(+online.sensors.counts) == {"imu", "gnss", "odometer"}  # each row once, those held meanwhile, too
    assert online.sensors.imu.newest == pytest.approx(drive[0].end - 10.0)


def test_a_first_stamp_far_ahead_does_not_stop_the_clock(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    wild: Row = ("imu", 1e9, rows[0][2][:6])
    online, track = played(drive[0], [wild, *rows], QUICK)
    assert track.t[-1] == pytest.approx(drive[0].end)
    assert online.failures == []


# ----------------------------------------------------------------------------------------------------- failures
def failing(monkeypatch: pytest.MonkeyPatch, at: float) -> None:
    """A smoother whose algebra fails in the first keyframe after a time."""
    real = Tracker.update

    def update(self: Tracker, sensors: object, new: np.ndarray, dirty: float = np.inf) -> float:
        if len(new) and new[0] > at and self.head < at:
            raise np.linalg.LinAlgError("Singular matrix")
        return real(self, sensors, new, dirty)

    monkeypatch.setattr(Tracker, "update", update)


def test_a_failure_within_costs_a_piece_and_not_the_session(
    drive: tuple[Recording, Trajectory], rows: list[Row], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what was killed after it is resumed as if nothing had been."""
    failing(monkeypatch, 52.0)
    recording, truth = drive
    lines = [line for _, line in format_lines(recording)]
    texts = []
    for name, cuts in (("whole", []), ("parts", [len(lines) // 2 + 20, len(lines) * 3 // 4])):
        session = Session(QUICK, "-", tmp_path / name)
        for begin, end in zip([0, *cuts], [*cuts, len(lines)], strict=True):
            if begin:
                session.close()  # as a kill would: no checkpoint of its own
                session = Session(QUICK, "-", tmp_path / name, resume=True)
            session.add_lines(lines[begin:end])
        session.close()
        assert len(session.online.failures) == 1
        assert "LinAlgError" in session.online.failures[0]
        texts.append((tmp_path / name / "trajectory.csv").read_text())
    assert texts[0] == texts[1]
    track = read_trajectory(tmp_path / "whole" / "trajectory.csv")
    assert track.t[-1] == pytest.approx(recording.end, abs=1e-3)
    error, sd = off(track, truth, recording)
    assert np.abs(error / sd).max() < 6.0


def test_states_that_are_no_numbers_are_never_written(
    drive: tuple[Recording, Trajectory], rows: list[Row], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = ahead.make_trajectory

    def blank(name: str, frame: object, t: np.ndarray, *more: object) -> Trajectory:
        track = real(name, frame, t, *more)
        return replace(track, llh=np.full_like(track.llh, np.nan)) if t[0] < 42.0 else track

    monkeypatch.setattr(ahead, "make_trajectory", blank)
    online, parts = Online(drop_rows(drive[0]), QUICK), []
    for row in rows:
        online.add(row)
        parts += online.settled()
    online.finish()
    parts += online.settled()
    assert online.failures
    assert all(np.isfinite(part.llh).all() for part in parts)
    assert pickle.loads(pickle.dumps(online)).failures == online.failures


# -------------------------------------------------------------------------------------------------------- setups
@pytest.mark.parametrize(
    ("setup", "field"),
    [
        ('{"imu": {"noise": {"gyro_noise_density": NaN}}}', "gyro_noise_density"),
        ('{"imu": {"noise": {"gyro_noise_density": -1e-4}}}', "gyro_noise_density"),
        ('{"imu": {"noise": {"accel_bias_walk": 0.0}}}', "accel_bias_walk"),
        ('{"imu": {"noise": {"accel_bias_walk": 1e-320}}}', "accel_bias_walk"),
        ('{"imu": {"noise": {"accel_bias_walk": 1e300}}}', "accel_bias_walk"),
        ('{"gnss": {"lever_arm": [0.0, NaN, 0.0]}}', "lever_arm"),
        ('{"gnss": {"lever_arm": [0.0, 1e300, 0.0]}}', "lever_arm"),
        ('{"gnss": {"lever_arm": [0.0]}}', "lever_arm"),
        ('{"odometer": {"scale_sigma": Infinity}}', "scale_sigma"),
        ('{"odometer": {"delay_sigma": -1.0}}', "delay_sigma"),
        ('{"odometer": {"speed_sigma": ' + "1" * 400 + "}}", "JSON"),
        ("[" * 100_000, "JSON"),
        ('{"name": ' * 5000 + "1" + "}" * 5000, "JSON"),
        ("1" * 10_000, "JSON"),
        ("[1]", "setup"),
        ('{"name": "' + "x" * 2_000_000 + '", "more": 1}', "more"),
    ],
)
def test_a_setup_is_checked_as_a_recording_is(setup: str, field: str) -> None:
    with pytest.raises(RecordingError, match=field) as caught:
        parse_setup(f"{PROTOCOL} {setup}")
    assert len(str(caught.value)) < 1000


def test_rows_are_numbers_in_ascii_digits(drive: tuple[Recording, Trajectory]) -> None:
    session = Session(QUICK, "-")
    session.add_lines([next(format_lines(drive[0]))[1], "I,1_0,0,0,0,0,0,9.8", "O,1,\uff11", "I,1,0,0,0,0,0,9.8"])
    assert session.bad == 2


SETUP = f'{PROTOCOL} {{"gnss": {{}}}}'
NOTHING = {
    "no line": ([], "online.no_setup"),
    "setup alone": ([SETUP], "online.nothing"),
    "no IMU": ([SETUP, *(f"G,{k},30,114,20,1,1,1" for k in range(9))], "online.nothing"),
    "no row of an IMU": ([SETUP, "I,1,0,0", "I,2,0,0,0,0,0,1e300"], "online.nothing"),
    "too few": ([SETUP, "I,0.00,0,0,0,0,0,9.8", "I,0.01,0,0,0,0,0,9.8"], "online.nothing"),
}


@pytest.mark.parametrize("case", NOTHING)
def test_a_session_with_nothing_to_show_says_why(tmp_path: Path, case: str) -> None:
    lines, key = NOTHING[case]
    session = Session(QUICK, "-", tmp_path / "out")
    session.add_lines(lines)
    session.finish()
    session.close()
    with refused(key, RecordingError):
        session.require_result()


# --------------------------------------------------------------------------------------------------------- disks
def test_a_disk_that_is_full_from_the_start(
    drive: tuple[Recording, Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is nothing to go on from: it says so, and what lies there does no harm to another run."""
    lines, real = [line for _, line in format_lines(drive[0])][:400], os.replace

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    session = Session(QUICK, "-", tmp_path)
    with refused("output.cannot_write", GraphnavError, "No space left"):
        session.add_lines(lines)
    session.close()
    monkeypatch.setattr(os, "replace", real)
    for number in range(3):
        (tmp_path / f"journal-{number:06d}").write_text("\n".join(lines[1:]) + "\n")
    Session(QUICK, "-", tmp_path).close()
    session = Session(QUICK, "-", tmp_path)
    session.add_lines(lines)
    session.close()  # as a kill would
    assert Session(QUICK, "-", tmp_path, resume=True).taken == len(lines) - 1


def test_a_summary_that_could_not_be_written_is_written_when_resumed(
    drive: tuple[Recording, Trajectory], tmp_path: Path
) -> None:
    session = Session(QUICK, "-", tmp_path)
    session.add_lines([line for _, line in format_lines(drive[0])][:50])
    (tmp_path / "summary.json").mkdir()
    with refused("output.cannot_write", GraphnavError, "--resume"):
        session.finish()
    session.close()
    (tmp_path / "summary.json").rmdir()
    again = Session(QUICK, "-", tmp_path, resume=True)
    again.finish()
    again.close()
    assert json.loads((tmp_path / "summary.json").read_text())["settled"] == again.rows_settled


class _Call:
    """What a pickle of a stranger calls when it is read."""

    def __init__(self, what: object, *arguments: object) -> None:
        self.what, self.arguments = what, arguments

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self.what, self.arguments


def test_a_checkpoint_of_a_stranger_runs_nothing(drive: tuple[Recording, Trajectory], tmp_path: Path) -> None:
    """With the right digest, calling what is not graphnav's own data."""
    lines = [line for _, line in format_lines(drive[0])]
    session = Session(QUICK, "-", tmp_path / "out")
    session.add_lines(lines[: len(lines) * 9 // 10])
    session.stop()
    session.close()
    Session(QUICK, "-", tmp_path / "out", resume=True).close()  # as it was written it can be read
    for call in (
        _Call(os.system, f"touch {tmp_path / 'owned'}"),
        _Call(Path.touch, tmp_path / "owned"),
        _Call(Store, tmp_path / "owned", "-", False, True),
        _Call(eval, f"open({str(tmp_path / 'owned')!r}, 'w')"),
        _Call(graphnav.__getattr__, "run"),
    ):
        body = pickle.dumps(call)
        (tmp_path / "out" / "checkpoint").write_bytes(_MAGIC + hashlib.sha256(body).digest() + body)
        with refused("checkpoint.damaged", ConfigError):
            Session(QUICK, "-", tmp_path / "out", resume=True)
        assert not (tmp_path / "owned").exists()


def test_a_line_that_never_ends_is_one_bad_line(drive: tuple[Recording, Trajectory]) -> None:
    """Sixteen megabytes of it, and then the drive."""
    session, held = Session(QUICK, "-"), []

    class Quiet:
        def update_if_due(self, silent: float = 0.0) -> None:
            held.append(tracemalloc.get_traced_memory()[1])

    head, *lines = [line.encode() + b"\n" for _, line in format_lines(drive[0])][:200]
    tracemalloc.start()
    follow(session, iter([head, *[b"1" * (1 << 20)] * 16, b"\n", b"".join(lines)]), Quiet(), StopRequest())
    tracemalloc.stop()
    assert session.bad == 1
    assert session.taken == len(lines)
    assert max(held) < 8 << 20


def test_a_drive_whose_fixes_never_came_is_nowhere():
    """Not where the local frame of a drive without GNSS begins, with a sigma of millimetres."""
    rng = np.random.default_rng(3)
    online = Online(live_setup(antenna=(0.0, 0.0, 0.6)), Settings(noise={"mode": "stated"}))
    for k, w in enumerate(rng.normal(0.0, 1e-3, (500, 3))):
        online.add(ImuSample(0.02 * k, w, [0.0, 0.0, 9.8] + 10.0 * w))
    online.finish()
    assert [len(track) for track in online.settled()] == []
    assert_told(online.notes, "online.not_aligned", "10 s")
