"""Smoothing while the drive happens: order, delay and loss of rows, ends of every kind, and the line protocol."""

from __future__ import annotations

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import oracle
import pytest
from helpers import Array, at_rate, refuse_command, refused, truth_states
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import graphnav
from graphnav.app import cli, cli_online
from graphnav.config import Settings, parse_settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.odometer import ODOMETER_DELAY
from graphnav.core.errors import ConfigError, GraphnavError, RecordingError
from graphnav.core.notes import get_key
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import make_trajectory
from graphnav.estimation.solvers.window import compute_turn_limit
from graphnav.evaluation.scoring import compute_errors
from graphnav.online import Fix, Online, Row, Session, drop_rows, list_rows, noise_estimation, smoother
from graphnav.online.buffers import Buffer
from graphnav.online.lines import END, PROTOCOL, format_head, format_line, format_lines, parse_row, parse_setup
from graphnav.online.tracker import Tracker
from graphnav.online.view import view
from graphnav.recording import Recording
from graphnav.recording.formats import read

ROOT = Path(__file__).resolve().parents[2]
QUICK = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 20.0}})
LONG = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 1000.0}})


@pytest.fixture(scope="module")
def drive() -> tuple[Recording, Trajectory]:
    """A hundred seconds at 25 Hz, so that the tests are quick."""
    path = oracle.vehicle_path(130.0, 25.0)
    recording, truth = oracle.drive(path, seed=3, outages=[(70.0, 80.0)], odometer_rate=10.0)
    return recording.crop(0.0, 100.0), truth


@pytest.fixture(scope="module")
def rows(drive: tuple[Recording, Trajectory]) -> list[Row]:
    return list_rows(drive[0])[1]


def played(recording: Recording, rows: Iterable[Row], how: Settings = QUICK) -> tuple[Online, Trajectory]:
    """All rows in, all that settled out."""
    online, parts = Online(drop_rows(recording), how), []
    for row in rows:
        online.add(row)
        parts += online.settled()
    online.finish()
    return online, joined([*parts, *online.settled()])


def test_isam2_smooths_online_as_the_window_does(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    """With fixes half a second late, which take keyframes back."""
    recording, _ = drive
    rows = [row for row in rows if row[1] < 60.0]
    late = [row for row in rows if row[0] != "gnss" or round(row[1]) % 7 != 3]
    for row in (row for row in rows if row[0] == "gnss" and round(row[1]) % 7 == 3):
        late.insert(next((k for k, other in enumerate(late) if other[1] > row[1] + 0.5), len(late)), row)
    tracks = []
    for engine in ("window", "isam2"):
        online = Online(drop_rows(recording), LONG, engine)
        for row in late:
            online.add(row)
        online.finish()
        assert not online.failures
        tracks.append(joined(online.settled()))
    window, tree = tracks
    np.testing.assert_array_equal(tree.t, window.t)
    apart = (tree.llh - window.llh) * np.array([6.37e6, 6.37e6 * np.cos(tree.llh[0, 0]), 1.0])
    assert np.abs(apart[:, [1, 0, 2]] / window.sd_p).max() < 0.02
    np.testing.assert_allclose(tree.sd_p, window.sd_p, rtol=0.01)


def test_isam2_goes_on_from_its_checkpoint(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    rows, tracks = [row for row in rows if row[1] < 60.0], []
    for every in (len(rows), 600):  # twenty times
        online, parts = Online(drop_rows(drive[0]), QUICK, "isam2"), []
        for k, row in enumerate(rows):
            online.add(row)
            parts += online.settled()
            if k % every == every - 1:
                online = pickle.loads(pickle.dumps(online))
        online.finish()
        tracks.append(joined([*parts, *online.settled()]))
    np.testing.assert_allclose(tracks[1].llh, tracks[0].llh, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(tracks[1].sd_p, tracks[0].sd_p, rtol=1e-6)


def joined(parts: list[Trajectory]) -> Trajectory:
    def column(name: str) -> Array:
        return np.concatenate([getattr(part, name) for part in parts])

    return Trajectory(**{n: column(n) for n in ("t", "llh", "v", "rph", "sd_p", "sd_v", "sd_rph")}, name="settled")


def off(track: Trajectory, truth: Trajectory, recording: Recording) -> tuple[Array, Array]:
    """Position errors (K, 3) m, e n u, and the sigmas stated, at the rows that the truth has too."""
    i = np.clip(np.searchsorted(truth.t, track.t - 1e-6), 0, len(truth.t) - 1)
    met = np.abs(truth.t[i] - track.t) < 1e-6
    scale = np.array([6.378e6, 6.378e6 * np.cos(truth.llh[0, 0]), 1.0])
    error = (track.llh[met] - truth.llh[i[met]]) * scale
    return error[:, [1, 0, 2]], track.sd_p[met]


@pytest.fixture(scope="module")
def plain(drive: tuple[Recording, Trajectory], rows: list[Row]) -> tuple[Online, Trajectory]:
    return played(drive[0], rows)


# ----------------------------------------------------------------------------------------------------- trajectories
def test_it_aligns_then_runs_and_is_as_good_as_batch(
    drive: tuple[Recording, Trajectory], plain: tuple[Online, Trajectory]
) -> None:
    recording, truth = drive
    online, track = plain
    assert "alignment.motion" in map(get_key, online.notes)
    assert np.all(np.diff(track.t) > 0)
    assert track.t[0] == pytest.approx(recording.start, abs=1e-9)
    assert track.t[-1] == pytest.approx(recording.end, abs=1e-9)
    error, sd = off(track, truth, recording)
    best = run(recording, QUICK, solvers=("batch",))["batch"].trajectory()
    reference, reference_sd = off(best, truth, recording)
    assert np.sqrt(np.mean(error**2)) < 1.2 * np.sqrt(np.mean(reference**2)) + 0.002
    # one drive is one sample of errors that hardly change within it: as true as batch's on the same one
    assert 0.5 < np.mean((error / sd) ** 2) / np.mean((reference / reference_sd) ** 2) < 1.5


def test_live_states_at_imu_rate_hold_to_their_sigmas(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    recording, truth = drive
    online, ratio = Online(drop_rows(recording), QUICK), []
    for k, row in enumerate(rows):
        online.add(row)
        if online.tracker is not None and k % 301 == 0:
            t, states, P = online.tracker.predict_since(online.sensors)
            now = online.live()
            assert now is not None
            if not len(t):
                continue
            assert t[-1] == now.t == online.sensors.imu.newest
            np.testing.assert_allclose(states.p[-1], now.state.p[0], atol=1e-6)
            true = truth_states(truth, np.round(t, 6), online.frame)
            sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
            ratio.append(np.mean((states.minus(true)[-1, :9] / sd[-1, :9]) ** 2))
    assert len(ratio) >= 5
    assert np.mean(ratio) < 3.0


def test_portions_do_not_matter(drive: tuple[Recording, Trajectory], rows: list[Row], tmp_path: Path) -> None:
    """The same lines in pieces of any size, and all at once."""
    lines = [line for _, line in format_lines(drive[0].crop(0.0, 60.0))]
    files = []
    for name, size in (("one", 1), ("many", 977), ("all", len(lines))):
        session = Session(QUICK, "-", tmp_path / name)
        for k in range(0, len(lines), size):
            session.add_lines(lines[k : k + size])
        session.close()
        assert session.done
        files.append((tmp_path / name / "trajectory.csv").read_bytes())
    assert files[0] == files[1] == files[2]
    assert files[0].count(b"\n") > 55


def test_late_rows_are_used_at_their_own_time(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    """Every fix 2.3 s late, the odometer 0.7 s: where nothing settles before, all is as with rows in time."""
    delay = {"imu": 0.0, "gnss": 2.3, "odometer": 0.7}
    some = [row for row in rows if row[1] < 70.0]
    (online, track), (_, other) = (
        played(drive[0], order, LONG) for order in (sorted(some, key=lambda row: row[1] + delay[row[0]]), some)
    )
    assert online.late["gnss"] > 20
    assert not [key for key in online.sensors.counts if "too late" in key]
    np.testing.assert_allclose(track.t, other.t, atol=1e-6)
    away = (track.llh - other.llh) * [6.378e6, 5.5e6, 1.0]
    assert np.abs(away).max() < 1e-3
    np.testing.assert_allclose(track.sd_p, other.sd_p, rtol=0.01)


def test_clocks_that_drift_apart_are_followed(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    """The receiver's stamps gain 3e-4: what its clock is late in the end is no more than 0.03 s."""
    recording, truth = drive
    late = [(name, t + 3e-4 * (t - recording.start), x) if name == "gnss" else (name, t, x) for name, t, x in rows]
    late.sort(key=lambda row: row[1])
    one_clock = QUICK.model_copy(update={"gnss": QUICK.gnss.model_copy(update={"clock_rate_sigma": 0.0})})
    found, held = (compute_errors(played(recording, late, how)[1], truth) for how in (QUICK, one_clock))
    second_half = found.t > recording.start + 0.5 * recording.duration
    found, held = (np.sqrt(np.mean(e.horizontal[second_half] ** 2)) for e in (found, held))
    assert found < 0.5 * held


def same(track: Trajectory, other: Trajectory) -> None:
    """To the rounding of a metre of a circle of 40,000 km."""
    np.testing.assert_array_equal(track.t, other.t)
    np.testing.assert_allclose((track.llh - other.llh) * [6.4e6, 6.4e6, 1.0], 0.0, atol=1e-7)
    np.testing.assert_allclose(track.sd_p, other.sd_p, rtol=1e-7)


def test_what_is_prepared_beside_the_drive_changes_nothing(
    drive: tuple[Recording, Trajectory],
    rows: list[Row],
    plain: tuple[Online, Trajectory],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Keyframes are built and predicted before their fix counts: as if they were made at once."""
    monkeypatch.setattr(Tracker, "_is_covered", lambda *_: False)
    same(played(drive[0], rows)[1], plain[1])


def test_keyframes_are_prepared() -> None:
    """In the outage, too; only while another tracker goes through the window is there no time for it.

    Between a reading and the next row of an IMU of 50 Hz there is none either.
    """
    path = oracle.vehicle_path(130.0, 100.0)
    recording = oracle.drive(path, seed=3, outages=[(70.0, 80.0)], odometer_rate=10.0)[0].crop(0.0, 100.0)
    online, ready = Online(drop_rows(recording), QUICK), []
    for row in list_rows(recording)[1]:
        before = online.tracker
        known = before is not None and (before.newest, before._ahead is not None)
        online.add(row)
        if known and online.tracker is before and before.newest > known[0] and online._catch_up is None:
            ready.append(known[1])
    assert len(ready) > 40
    assert np.mean(ready) > 0.9


def test_a_reading_that_comes_when_its_keyframe_is_prepared_counts(
    drive: tuple[Recording, Trajectory], rows: list[Row], plain: tuple[Online, Trajectory]
) -> None:
    late = [k for k, (sensor, t, _) in enumerate(rows) if sensor == "odometer" and abs(t % 5.0 - 3.9) < 1e-6]
    later = [next(i for i in range(k, len(rows)) if rows[i][1] > rows[k][1] + 0.135) for k in late]
    order = sorted(range(len(rows)), key=lambda k: later[late.index(k)] - 0.5 if k in late else k)
    assert len(late) >= 5
    assert order != list(range(len(rows)))
    same(played(drive[0], [rows[k] for k in order])[1], plain[1])


def test_noise_estimation_beside_the_drive_works_on_copies(
    drive: tuple[Recording, Trajectory], rows: list[Row], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint is written meanwhile: nothing that stands in it may change under the pen."""
    used: list[noise_estimation.EstimationTask] = []
    kept: list[noise_estimation.EstimationTask] = []
    run, start = noise_estimation.run_estimation, noise_estimation.start_estimation

    def run_seen(task: noise_estimation.EstimationTask) -> noise_estimation.EstimationResult:
        used.append(task)
        return run(task)

    def start_seen(*given: Any) -> noise_estimation.BackgroundEstimation:
        kept.append((out := start(*given)).task)
        return out

    monkeypatch.setattr(noise_estimation, "run_estimation", run_seen)
    monkeypatch.setattr(smoother, "start_estimation", start_seen)
    online = Online(drop_rows(drive[0]), parse_settings({"solver": {"lag": 20.0}}))
    for row in rows:
        online.add(row)
    online.finish()
    assert len(used) == len(kept) > 0
    for one, other in zip(used, kept, strict=True):
        pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(one)]
        assert all(a is not b for a, b in pairs if not isinstance(a, bool))  # of which there are only two


def test_rows_older_than_the_window_are_counted(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    fix = next(row for row in rows if row[0] == "gnss" and row[1] > 40.0)
    moved = [row for row in rows if row is not fix]
    at = next(k for k, row in enumerate(moved) if row[1] > 90.0)
    online, _ = played(drive[0], [*moved[:at], fix, *moved[at:]])
    assert online.sensors.counts["gnss: too late"] == 1


def test_a_silent_imu_ends_one_piece_and_begins_another(drive: tuple[Recording, Trajectory]) -> None:
    whole, truth = oracle.drive(oracle.vehicle_path(200.0, 50.0), seed=5, odometer_rate=None)
    rows = [row for row in list_rows(whole)[1] if row[0] != "imu" or not 90.0 < row[1] < 96.0]
    online, track = played(whole, rows)
    assert "online.anew" in map(get_key, online.notes)
    assert not np.any((track.t > 90.5) & (track.t < 95.5))
    assert track.t[-1] == pytest.approx(200.0)
    error, sd = off(track, truth, whole)
    assert np.mean((error / sd) ** 2) < 2.5


def test_a_keyframe_while_the_imu_is_silent_knows_that_it_is(drive: tuple[Recording, Trajectory]) -> None:
    """Only the row that ends the silence tells; the state in it is as uncertain as in the batch solution.

    About so: that one's keyframe is not at quite the same time, and a tenth of a second changes it by a third.
    """
    recording, truth = drive
    imu = recording.imu
    keep = (imu.t < 72.0 + 1e-6) | (imu.t > 73.6)  # in the outage
    part = replace(recording, imu=replace(imu, t=imu.t[keep], gyro=imu.gyro[keep], accel=imu.accel[keep]))
    _, track = played(part, list_rows(part)[1])
    error, sd = off(track, truth, part)
    k = int(np.flatnonzero(np.abs(track.t - 73.0) < 1e-6)[0])
    best = run(part, QUICK, solvers=("batch",))["batch"].trajectory()
    reference = best.sd_p[np.argmin(np.abs(best.t - 73.0))]
    assert (sd[k, :2] > 0.5 * reference[:2]).all()
    assert (sd[k, :2] < 2.0 * reference[:2]).all()
    assert np.abs(error[k] / sd[k]).max() < 4.0


def test_a_stamp_far_ahead_is_dropped(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    """One of the IMU, one of the receiver; the rest is as if they had not come."""
    k = next(k for k, row in enumerate(rows) if row[1] > 50.0)
    wild: list[Row] = [("imu", 9e5, rows[k][2][:6]), ("gnss", 9e5, (0.5, 2.0, 30.0, 1.0, 1.0, 1.0, *([np.nan] * 6)))]
    part = [row for row in rows if row[1] < 60.0]
    online, track = played(drive[0], [*part[:k], *wild, *part[k:]])
    assert online.sensors.counts["imu: stamp in the future"] == 1
    assert online.sensors.counts["gnss: stamp in the future"] == 1
    same = played(drive[0], part)[1]
    np.testing.assert_array_equal(track.llh, same.llh)


@settings(max_examples=2, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 10**6),
    jitter=st.floats(0.0, 4.0),
    lost=st.floats(0.0, 0.3),
    hole=st.floats(20.0, 80.0),
    length=st.floats(0.0, 6.0),
)
@example(seed=101263, jitter=0.0, lost=0.0, hole=79.0, length=1.71)
def test_any_order_and_any_loss(
    drive: tuple[Recording, Trajectory],
    rows: list[Row],
    seed: int,
    jitter: float,
    lost: float,
    hole: float,
    length: float,
) -> None:
    """Rows shuffled by seconds, lost, repeated, spoilt, and the IMU away: no exception, time goes on, sigma holds."""
    rng = np.random.default_rng(seed)
    delay = {"imu": 0.05 * jitter, "gnss": jitter, "odometer": jitter}
    come: list[tuple[float, Row]] = []
    for row in rows:
        sensor, t, values = row
        away = sensor == "imu" and hole < t < hole + length
        if away or rng.random() < (lost if sensor != "imu" else 0.05 * lost):
            continue
        if rng.random() < 0.002:
            values = tuple(float("nan") for _ in values)
        for _ in range(1 + (rng.random() < 0.01)):
            come.append((t + delay[sensor] * rng.random(), (sensor, t, values)))
    come.sort(key=lambda one: one[0])
    recording, truth = drive
    online, parts = Online(drop_rows(recording), QUICK), []
    for _, row in come:
        online.add(row)
        parts += online.settled()
    online.finish()
    parts += online.settled()
    if not parts:
        assert online.status == "aligning"  # too little of it in one piece
        return
    track = joined(parts)
    assert np.all(np.diff(track.t) > 0)
    assert np.isfinite(track.llh).all()
    assert np.all(track.sd_p > 0)
    error, sd = off(track, truth, recording)
    if len(error) > 30:
        assert np.median((error / sd) ** 2) < 3.0
        assert np.abs(error / sd).max() < 12.0


# ------------------------------------------------------------------------------------------------------- buffers
@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 2000), max_size=600), st.integers(0, 500))
def test_a_buffer_is_a_sorted_set(numbers: list[int], begin: int) -> None:
    buffer = Buffer(1)
    for n in numbers:
        new = n not in buffer.t
        assert buffer.add(float(n), (2.0 * n,)) == new
    kept = sorted(set(numbers))
    np.testing.assert_array_equal(buffer.t, kept)
    np.testing.assert_array_equal(buffer.rows[:, 1], [2.0 * n for n in kept])
    buffer.drop_before(begin)
    np.testing.assert_array_equal(buffer.t, [n for n in kept if n >= begin])


# ----------------------------------------------------------------------------------------------------------- lines
def test_lines_read_back_as_they_were(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    recording = drive[0]
    found = parse_setup(format_head(recording))
    assert found.imu.noise == recording.imu.noise
    np.testing.assert_array_equal(found.gnss.lever_arm, recording.gnss.lever_arm)
    np.testing.assert_array_equal(found.odometer.lever_arm, recording.odometer.lever_arm)
    for row in rows[::500]:
        sensor, t, values = parse_row(format_line(row))
        assert (sensor, t) == row[:2]
        np.testing.assert_allclose(values, row[2], rtol=1e-15)


def test_residuals_of_fixes_come_in_lines_and_rows(drive: tuple[Recording, Trajectory]) -> None:
    """With and without velocities; what one fix does not state is unknown in the noise model's rows."""
    recording = drive[0].crop(0.0, 6.0)
    gnss = recording.gnss
    rms, many = np.linspace(0.0, 9.0, len(gnss.t)), np.full(len(gnss.t), 8.0)
    rms[2] = np.nan
    stating = replace(recording, gnss=replace(gnss, residual_rms=rms, satellites=many))
    online = Online(drop_rows(stating), QUICK)
    for row in list_rows(stating)[1]:
        again = parse_row(format_line(row))
        assert again[:2] == row[:2]
        np.testing.assert_allclose(again[2], row[2], rtol=1e-15)
        online.add(again)
    kept = online.sensors.gnss.select_as_gnss(-np.inf, np.inf)
    np.testing.assert_array_equal(kept.residual_rms, rms)
    np.testing.assert_array_equal(kept.satellites, many)
    plain = next(row for row in list_rows(recording)[1] if row[0] == "gnss")
    given = np.degrees(plain[2][0]), np.degrees(plain[2][1]), plain[2][2], plain[2][3:6]
    fix = Fix(plain[1], *given, resid_rms_m=0.5, nsat=9)
    assert fix[2][12:] == (0.5, 9.0)
    assert Fix(plain[1], *given)[2] == pytest.approx(plain[2], rel=1e-12, nan_ok=True)
    with refused("row.residuals", RecordingError, "-0.5"):
        Fix(plain[1], *given, resid_rms_m=-0.5)


def test_lines_in_other_units_and_axes_are_the_same_rows(
    drive: tuple[Recording, Trajectory], rows: list[Row], tmp_path: Path
) -> None:
    """As the keys of recording.toml state them, also after a run is resumed, whose lines have no first one."""
    recording, deg = drive[0], 180.0 / np.pi
    setup = json.loads(format_head(recording).partition(" ")[2])
    setup["imu"] |= {"axes": "FRD", "units": {"t": "ms", "gyro": "deg/s", "accel": "g"}}
    setup["gnss"] |= {"units": {"angle": "rad", "height": "ft", "speed": "knots"}, "time_offset": -18.0}
    setup["odometer"]["units"] = {"speed": "km/h"}
    knot = 1852.0 / 3600.0

    def write(row: Row) -> str:
        sensor, t, x = row
        if sensor == "imu":
            turned = [deg * x[1], deg * x[0], -deg * x[2], x[4] / 9.80665, x[3] / 9.80665, -x[5] / 9.80665]
            return "I," + ",".join(map(repr, [1e3 * t, *turned]))
        if sensor == "odometer":
            return f"O,{t!r},{3.6 * x[0]!r}"
        speeds = [] if np.isnan(x[6]) else [one / knot for one in x[6:]]
        return "G," + ",".join(map(repr, [t + 18.0, *x[:2], x[2] / 0.3048, *x[3:6], *speeds]))

    one = Session(QUICK, "-", tmp_path)
    one.add_lines([f"{PROTOCOL} {json.dumps(setup)}", *map(write, rows[:200])])
    one.stop()
    one.close()
    other = Session(QUICK, "-", tmp_path, resume=True)
    other.close()
    for session in (one, other):
        for row in rows[::500]:
            sensor, t, values = parse_row(write(row), session.units)
            assert (sensor, t) == (row[0], pytest.approx(row[1], abs=1e-9))
            np.testing.assert_allclose(values, row[2], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("I,1,2,3", "'I'.* 7 .* 3$"),
        ("G,1,2,3,4", "'G'.* 7, 13 .* 15 .* 4$"),
        ("X,1", "'X'"),
        ("O,1,fast", "'O,1,fast'"),
        ("\x00\xff", "'\x00\xff'"),
    ],
)
def test_bad_lines_are_named_with_what_they_lack(line: str, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        parse_row(line)


@pytest.mark.parametrize(
    ("line", "key", "name"),
    [
        ("I,1,2,3,4,5,6,7", "online.first_line", "'graphnav-online/1'"),
        ("graphnav-online/1 {", "online.setup_json", "line 1"),
        ('graphnav-online/1 {"platfrom": "vehicle"}', "key.unknown", "'platform'"),
        ('graphnav-online/1 {"imu": {"noise": {"gyro": 1}}}', "key.unknown", "'imu.noise.gyro'"),
        ('graphnav-online/1 {"imu": {"axes": "XYZ"}}', "key.value", "'imu.axes'"),
        ('graphnav-online/1 {"imu": {"units": {"gyro": "dps"}}}', "key.value", "'imu.units.gyro'"),
    ],
)
def test_bad_setups_say_why(line: str, key: str, name: str) -> None:
    with refused(key, RecordingError, name):
        parse_setup(line)


# ------------------------------------------------------------------------------------------------------ nothing lost
def program(*arguments: str | Path, **more: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "graphnav", "online", *map(str, arguments)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)}, **more
    )


@pytest.fixture(scope="module")
def folder(drive: tuple[Recording, Trajectory], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive as lines in a file."""
    path = tmp_path_factory.mktemp("lines") / "drive.txt"
    path.write_text("".join(line + "\n" for _, line in format_lines(drive[0])), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "quick.toml"
    path.write_text('[noise]\nmode = "stated"\n[solver]\nlag = 20.0\n', encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def uninterrupted(folder: Path, config: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    out = tmp_path_factory.mktemp("whole") / "out"
    with folder.open("rb") as lines:
        process = program("-", "-o", out, "--config", config, "--quiet", stdin=lines)
        assert process.wait() == 0, process.stderr.read()
    return (out / "trajectory.csv").read_bytes()


def test_a_file_of_lines_is_a_source(folder: Path, config: Path, uninterrupted: bytes, tmp_path: Path) -> None:
    process = program(folder, "-o", tmp_path / "out", "--config", config, "--quiet")
    assert process.wait(60) == 0, process.stderr.read()
    assert (tmp_path / "out" / "trajectory.csv").read_bytes() == uninterrupted


def test_killed_and_resumed_it_ends_with_the_same(
    folder: Path, config: Path, uninterrupted: bytes, tmp_path: Path
) -> None:
    """Killed, and then interrupted; the source is cut off in the middle of a line, the rest comes after --resume."""
    data = folder.read_bytes()
    out = tmp_path / "out"
    cuts = [0, int(0.75 * len(data)), int(0.9 * len(data)), len(data)]
    for k, (begin, end) in enumerate(pairwise(cuts)):
        last = end == len(data)
        process = program("-", "-o", out, "--config", config, "--quiet", *["--resume"] * (k > 0), stdin=subprocess.PIPE)
        # a sender that begins a little before where it was cut off
        start = data.rfind(b"\n", 0, max(begin - 3000, 0)) + 1
        process.stdin.write(data[start:end])
        process.stdin.flush()
        if last:
            assert process.wait(60) == 0, process.stderr.read()
            break
        want = data[: data.rfind(b"\n", 0, end)].count(b"\nI")
        wait_for(lambda want=want: consumed(out) >= want)
        wait_for(lambda: (out / "trajectory.csv").read_bytes().count(b"\n") > 5)
        process.send_signal((signal.SIGKILL, signal.SIGINT)[k])
        assert process.wait(60) == (-9, 130)[k]
        so_far = (out / "trajectory.csv").read_bytes()
        assert so_far.endswith(b"\n")
        assert uninterrupted.startswith(so_far)
    assert (out / "trajectory.csv").read_bytes() == uninterrupted


def consumed(out: Path) -> int:
    """IMU rows in the checkpoint and the journal after it, roughly: enough to know that all came."""
    from graphnav.online.store import CHECKPOINT, _read_checkpoint

    try:
        found = _read_checkpoint(out / CHECKPOINT)
        journal = out / f"journal-{found.journal:06d}"
        more = journal.read_bytes().count(b"I,") if journal.exists() else 0
    except (OSError, ConfigError):
        return 0
    return found.online.sensors.counts["imu"] + more


def wait_for(condition: object, seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < until, "it took too long"
        time.sleep(0.2)  # to ask takes a good part of a core


def test_a_full_disk_leaves_what_had_settled(
    drive: tuple[Recording, Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = drive[0]
    session = Session(QUICK, "drive", tmp_path / "out", recording=recording)
    real, written = os.fsync, [0]

    def full(handle: int) -> None:
        written[0] += 1
        if written[0] > 12:
            raise OSError(28, "No space left on device")
        real(handle)

    monkeypatch.setattr(os, "fsync", full)

    def add_all() -> None:
        for row in session.rows:
            session.add(row)

    with refused("output.cannot_write", GraphnavError, "No space left", "--resume"):
        add_all()
    session.close()
    monkeypatch.undo()
    so_far = (tmp_path / "out" / "trajectory.csv").read_bytes()
    assert so_far.endswith(b"\n")
    again = Session(QUICK, "drive", tmp_path / "out", resume=True, recording=recording)
    for row in again.rows[again.taken :]:
        again.add(row)
    again.finish()
    again.close()
    whole = Session(QUICK, "drive", tmp_path / "whole", recording=recording)
    for row in whole.rows:
        whole.add(row)
    whole.finish()
    whole.close()
    assert (tmp_path / "out" / "trajectory.csv").read_bytes() == (tmp_path / "whole" / "trajectory.csv").read_bytes()
    assert again.summarise()["settled"] == whole.summarise()["settled"]


def test_folders_and_checkpoints_are_not_mixed_up(drive: tuple[Recording, Trajectory], tmp_path: Path) -> None:
    recording, out = drive[0], tmp_path / "out"
    with refused("checkpoint.none", ConfigError):
        Session(QUICK, "drive", out, resume=True, recording=recording)
    Session(QUICK, "drive", out, recording=recording).close()
    with refused("output.holds_run", ConfigError):
        Session(QUICK, "drive", out, recording=recording)
    with refused("checkpoint.other_source", ConfigError, "'drive'", "'other'"):
        Session(QUICK, "other", out, resume=True, recording=recording)
    with refused("checkpoint.other_settings", ConfigError, "[solver]"):
        Session(LONG, "drive", out, resume=True, recording=recording)
    again = Session(Settings(), "drive", out, resume=True, recording=recording)  # as the advice of an end has it
    assert again.settings.solver.lag == QUICK.solver.lag
    again.close()
    body = bytearray((out / "checkpoint").read_bytes())
    body[-5] ^= 1
    (out / "checkpoint").write_bytes(body)
    with refused("checkpoint.damaged", ConfigError):
        Session(QUICK, "drive", out, resume=True, recording=recording)


def test_a_socket_whose_sender_comes_back(folder: Path, config: Path, uninterrupted: bytes, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    out = tmp_path / "out"
    process = program(f"tcp:{port}", "-o", out, "--config", config)
    data = folder.read_bytes()
    begin = data.index(b"\nI,", len(data) // 2) + 1
    cut = data.rindex(b",", 0, data.index(b"\n", begin)) + 2  # in its last number: what is left would be a row, too
    for part in (data[:cut], data[data.rfind(b"\n", 0, cut - 5000) + 1 :]):
        wait_for(lambda: listening(port))
        with socket.create_connection(("127.0.0.1", port)) as sender:
            sender.sendall(part)
    assert process.wait(60) == 0, process.stderr.read()
    assert (out / "trajectory.csv").read_bytes() == uninterrupted
    assert b"status: " in process.stdout.read()


def listening(port: int) -> bool:
    """Whether a server is there, without troubling it."""
    state = Path("/proc/net/tcp")
    if not state.exists():
        time.sleep(2.0)
        return True
    return any(f":{port:04X} " in line and " 0A " in line for line in state.read_text().splitlines())


def test_the_view_says_what_is_going_on(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    session = Session(QUICK, "drive", recording=drive[0])
    assert dict(view(session))["status"] == "aligning"
    for row in rows[: len(rows) * 6 // 10]:
        session.add(row)
    said = dict(view(session, silent=7.0))
    assert said["status"] == "running, the source is silent for 7 s"
    assert {"position", "speed", "attitude", "in force", "update", "settled", "window"} <= set(said)
    assert "nhc" in said["in force"]


def test_bad_usage_is_one_line_and_code_two(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the handlers of the tests stay
    for arguments, key, name in (
        (["no-such-thing"], "file.missing", "no-such-thing"),
        (["-", "--resume"], "option.missing", "--resume"),
        (["-", "--lag", "0"], "option.value", "--lag 0"),
        (["-", "--speed", "-1"], "option.value", "--speed -1"),
        (["-", "--detectors", "no-such-thing"], "option.unknown_name", "no-such-thing"),
        (["-", "--detectors", "fused,fft"], "detectors.fused_alone", "fused"),
        (["-", "--format", "ubx"], "option.not_here", "--format"),
        (["-", "--topic", "/imu"], "option.not_here", "--topic"),
        (["-", "--speed", "2"], "option.not_here", "--speed"),
        (["-", "--send"], "option.not_here", "--send"),
        (["tcp:x"], "online.cannot_listen", "tcp:x"),
        (["tcp:70000"], "online.cannot_listen", "tcp:70000"),
    ):
        assert name in refuse_command(capsys, key, "online", "--quiet", *arguments)


def test_the_detectors_that_decide_can_be_named(monkeypatch: pytest.MonkeyPatch) -> None:
    fired = []
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(cli_online, "follow", lambda session, *_: fired.append(session.settings.detectors.fire))
    monkeypatch.setattr(Session, "require_result", lambda _: None)
    for more in ([], ["--detectors", "fft,glrt"]):
        assert cli.run(["online", "-", "--quiet", *more]) == 0
    assert fired == [("fused",), ("fft", "glrt")]


def test_a_source_without_its_first_line_is_refused() -> None:
    process = program("-", stdin=subprocess.PIPE)
    _, error = process.communicate(b"I,1,2,3,4,5,6,7\n", timeout=60)
    assert process.returncode == 2
    assert b"line 1: a live source begins with" in error


def test_real_recording_settles_on_the_batch_solution(shared_data: Path) -> None:
    recording = at_rate(read(shared_data / "oracle_drive").crop(80.0, 160.0), 25.0)
    online, track = played(recording, list_rows(recording)[1], Settings())
    best = run(recording, solvers=("batch",))["batch"]
    t, states, P = best.at(track.t[(track.t >= best.t[0]) & (track.t <= best.t[-1])])
    mine = track.llh[np.isin(track.t, t)]
    other = make_trajectory("batch", best.frame, t, states, P)
    away = (mine - other.llh) * [6.378e6, 5.5e6, 1.0]
    assert np.abs(away).max() < 0.03
    assert replace(recording).start == pytest.approx(track.t[0])
    assert online.status == "running"
    assert END == "E"


def test_a_real_walk_settles_step_by_step(shared_data: Path) -> None:
    """Shoe with nothing but its IMU: stances are found a second after they are over, and it is batch again."""
    walk = read(shared_data / "pyshoe_vicon" / "2017-11-22-11-23-25.toml")
    online, parts = Online(drop_rows(walk), parse_settings({"solver": {"lag": 40.0}})), []
    behind = []
    for row in list_rows(walk)[1]:
        online.add(row)
        parts += online.settled()
        if online.tracker is not None:
            behind.append(online.sensors.imu.newest - online.tracker.newest)
    online.finish()
    track = joined([*parts, *online.settled()])
    best = run(walk, solvers=("batch",))["batch"]
    t, states, P = best.at(track.t)
    assert online.frame is not None
    away = online.frame.from_llh(track.llh[np.isin(track.t, t)]) - states.p
    assert np.abs(away).max() < 0.003
    np.testing.assert_allclose(track.sd_p[-1], np.sqrt(np.diag(P[-1]))[3:6], rtol=0.15)
    assert np.quantile(behind, 0.9) < 2.5


def test_a_walk_with_lost_packets_settles_on_the_batch_solution(shared_data: Path) -> None:
    """Fifteen seconds of standing in pieces, a first step that has the highest readings so far, and gaps.

    What is left is the noise of bridged gaps, told from half a minute here and from the whole walk there; most of it in
    height, where little is known but by what comes back in every stance.
    """
    walk = read(shared_data / "xio_loops" / "short.toml").crop(0.0, 30.0)
    # as a walk that goes on has to take it
    settings = parse_settings({"noise": {"mode": "stated"}, "imu": {"onboard_offset": False}})
    _, track = played(walk, list_rows(walk)[1], settings)
    best = run(walk, settings, ("batch",))["batch"]
    t, states, P = best.at(track.t)
    away = best.frame.from_llh(track.llh[np.isin(track.t, t)]) - states.p
    assert np.abs(away[:, :2]).max() < 0.02
    assert np.abs(away[:, 2]).max() < np.sqrt(P[-1, 5, 5])
    np.testing.assert_allclose(track.sd_p[-1], np.sqrt(np.diag(P[-1]))[3:6], rtol=0.15)


# ----------------------------------------------------------------------------------------------- judged as it goes
def test_wheels_are_judged_with_all_else(drive: tuple[Recording, Trajectory]) -> None:
    """An odometer that reads off by a tenth of a metre a second for seconds at a time weighs as much as that."""
    path = oracle.vehicle_path(180.0, 25.0, seed=6)
    recording, truth = oracle.drive(path, seed=4, odometer_rate=10.0)
    o = recording.odometer
    rng, lasting = np.random.default_rng(8), np.zeros(len(o.t))
    for k in range(1, len(lasting)):
        lasting[k] = np.exp(-0.1 / 3.0) * lasting[k - 1] + 0.1 * np.sqrt(1 - np.exp(-0.2 / 3.0)) * rng.standard_normal()
    wrong = replace(recording, odometer=replace(o, speed=np.where(o.speed > 0.5, o.speed + lasting, o.speed)))
    how = parse_settings({"solver": {"lag": 60.0}})
    online, track = played(wrong, list_rows(wrong)[1], how)
    wheels = online.tracker._parameters["odometer_error"]
    assert wheels.sigma[0] == pytest.approx(0.1, rel=0.5)
    error, sd = off(track, truth, wrong)
    assert np.mean((error / sd) ** 2) < 2.0


def test_an_imu_is_judged_by_ever_more_rows(drive: tuple[Recording, Trajectory]) -> None:
    """A third of the noise is stated; the last word is that of all rows so far, as a recording of them has it.

    Of the accelerometer's little is found: rows of wheels that never slip share its noise.
    """
    path = oracle.vehicle_path(240.0, 25.0, seed=11)
    recording, _ = oracle.drive(path, seed=2, odometer_rate=None)
    noise = recording.imu.noise
    figures = ("gyro_noise_density", "accel_noise_density")
    quiet = replace(noise, **{name: getattr(noise, name) / 3.0 for name in figures})
    recording = replace(recording, imu=replace(recording.imu, noise=quiet))
    rows, how = list_rows(recording)[1], parse_settings({"solver": {"lag": 60.0}})
    online, _ = played(recording, rows, how)
    used, whole = online.tracker.noise, run(recording.crop(0.0, online._estimated_from), how, ("ekf",))["ekf"].noise
    assert used.get_factor("imu.gyro_noise_density", 1.0) > 2.0
    told = [name for name, one in whole.figures.items() if one.freedom > 10.0]
    assert len(told) > 5
    for name in told:  # a recording has keyframes where stops begin and end, and so other intervals and rows there
        one, other = used.figures[name], whole.figures[name]
        assert abs(one.log_factor - other.log_factor) < 3.0 * np.hypot(one.sigma, other.sigma), name
    assert sum(get_key(note) == "noise.imu" for note in online.notes) == 1
    assert online.tracker.window.turn > compute_turn_limit(quiet)


def test_resumed_while_it_is_judged_it_ends_with_the_same(drive: tuple[Recording, Trajectory], rows: list[Row]) -> None:
    """While the sensors are being judged, and while what has not settled is gone through again."""
    how, rows = parse_settings({"solver": {"lag": 20.0}}), [row for row in rows if row[1] < 60.0]
    other, parts, resumed = Online(drop_rows(drive[0]), how), [], {"judged": 0, "again": 0}
    for k, row in enumerate(rows):
        other.add(row)
        doing = "again" if other._catch_up is not None else "judged" if other._estimation is not None else ""
        if doing and k % (4 if doing == "again" else 20) == 0:
            resumed[doing] += 1
            other = pickle.loads(pickle.dumps(other))
        parts += other.settled()
    other.finish()
    assert min(resumed.values()) > 2, resumed
    track = played(drive[0], rows, how)[1]
    np.testing.assert_array_equal(joined([*parts, *other.settled()]).llh, track.llh)


def test_smooth_driving_with_positions_alone_is_no_stop() -> None:
    """KITTI cruises where no odometer says so: never held while its fixes move by metres a second."""
    recording = graphnav.load("kitti").crop(0.0, 170.0)
    gnss = recording.gnss
    speed = np.linalg.norm(np.diff(gnss.llh, axis=0) * [6.37e6, 4.2e6, 0.0], axis=1) / np.diff(gnss.t)
    # what the IMU is judged to be here makes smooth roads look still
    online, held = Online(drop_rows(recording), Settings()), []
    for row in list_rows(recording)[1]:
        online.add(row)
        if row[0] == "gnss" and online.tracker is not None:
            held += online.tracker.stops.tolist()
    for begin, end in held:
        inside = (gnss.t[:-1] >= begin - 0.5) & (gnss.t[1:] <= end + 0.5)
        assert np.all(speed[inside] < 2.0)
    error = online.frame.from_llh(gnss.llh[-1]) - online.live().state.p[0]
    assert np.linalg.norm(error[:2]) < 3.0


@pytest.mark.parametrize("engine", ["window", "isam2"])
def test_a_lever_arm_that_the_drive_contradicts_is_found_while_it_lasts(engine: str) -> None:
    """States since the start are solved again with the arm that is found, those that have settled included."""
    path = oracle.vehicle_path(150.0, 25.0)
    recording, truth = oracle.drive(path, seed=6)
    assert recording.gnss is not None
    wrong = replace(
        recording, gnss=replace(recording.gnss, lever_arm=recording.gnss.lever_arm + np.array([0.6, 1.0, 0.0]))
    )
    how = parse_settings({"solver": {"lag": 20.0, "engine": engine}})
    online, parts = Online(drop_rows(wrong), how), []
    for k, row in enumerate(list_rows(wrong)[1]):
        online.add(row)
        parts += online.settled()
        if k % 300 == 299 and online._catch_up is not None:
            online = pickle.loads(pickle.dumps(online))
    online.finish()
    track = joined([*parts, *online.settled()])
    assert np.all(np.diff(track.t) > 0)
    error, sd = (x[track.t > 120.0] for x in off(track, truth, recording))
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 0.05  # of more than a metre
    assert np.mean((error / sd) ** 2) < 2.0
    assert online.tracker is not None
    assert list(online.tracker.noise.freed) == [LEVER_ARM]
    assert "gnss.lever_arm_used" in map(get_key, online.notes)


def test_an_odometer_whose_readings_are_late_is_waited_for() -> None:
    """A keyframe is solved with the readings that came later than it by as much as they are late."""
    late, path = 0.3, oracle.vehicle_path(150.0, 25.0)
    recording, truth = oracle.drive(path, seed=6, odometer_rate=20.0)
    assert recording.odometer is not None
    wrong = replace(recording, odometer=replace(recording.odometer, t=recording.odometer.t + late))
    online, parts = Online(drop_rows(wrong), parse_settings({"solver": {"lag": 20.0}})), []
    for row in list_rows(wrong)[1]:
        online.add(row)
        parts += online.settled()
    online.finish()
    track = joined([*parts, *online.settled()])
    assert np.all(np.diff(track.t) > 0)
    error, sd = (x[track.t > 120.0] for x in off(track, truth, recording))
    assert np.mean((error / sd) ** 2) < 2.0
    assert online.tracker is not None
    freed = online.tracker.noise.freed
    assert list(freed) == [ODOMETER_DELAY]
    assert freed[ODOMETER_DELAY].value[0] == pytest.approx(late, abs=0.02)
    assert "odometer.delay_used" in map(get_key, online.notes)
