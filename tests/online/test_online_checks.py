"""Sessions whose rows are in wrong units, axes or clocks from the first to the last: they go on, and say so."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from helpers import run_here

from graphnav.config import parse_settings
from graphnav.core.errors import RecordingError
from graphnav.core.notes import get_key
from graphnav.online import Online, Row, drop_rows, list_rows
from graphnav.online.lines import format_line, format_lines, parse_row
from graphnav.online.session import Session
from graphnav.online.view import view
from graphnav.recording import Recording
from graphnav.recording.checks.overview import inspect

QUICK = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 10.0}})
TOLD = {"imu.force_scale", "imu.gyro_unit", "gnss.lat_lon", "imu.left_out", "gnss.left_out"}


@pytest.fixture(scope="module")
def drive() -> Recording:
    return oracle.drive(oracle.vehicle_path(130.0, 25.0), seed=3)[0].crop(20.0, 64.0)


def spoil(row: Row, how: str) -> Row:
    sensor, t, values = row
    x = np.array(values)
    match sensor, how:
        case "imu", "g":
            x[3:] /= 9.80665
        case "imu", "deg/s":
            x[:3] *= 180.0 / np.pi
        case ("imu", "IMU in ms") | ("gnss", "fixes in ms"):
            t *= 1e3
        case "gnss", "lon, lat":
            x[:2] = x[1::-1]
        case "gnss", "lon, lat in Europe":  # where both are below 90 deg
            x[:2] = x[1] - np.radians(100.0), x[0]
        case "gnss", "degrees":
            x[:2] *= 180.0 / np.pi
        case "gnss", "no place":
            x[:2] = 0.0
    return sensor, t, tuple(x.tolist())


@pytest.mark.parametrize(
    ("how", "keys"),
    [
        ("as it is", set()),
        ("lon, lat", {"gnss.left_out"}),
        ("lon, lat in Europe", {"gnss.lat_lon"}),
        ("degrees", {"gnss.left_out"}),
        ("no place", {"gnss.left_out"}),
        ("fixes in ms", {"gnss.left_out"}),
        ("IMU in ms", {"imu.left_out"}),
    ],
)
def test_a_session_with_wrong_numbers_says_so(drive: Recording, how: str, keys: set[str]) -> None:
    online = Online(drop_rows(drive), QUICK)
    for row in list_rows(drive)[1]:
        online.add(spoil(row, how))
    early = {get_key(note) for note in online.notes} & TOLD
    online.finish()
    found = {get_key(note) for note in online.notes} & TOLD
    assert found == keys
    assert early == found  # while it runs, not only at the end
    assert not online.failures


def test_an_imu_that_is_stuck_is_told_of_as_offline_and_is_a_gap() -> None:
    recording = oracle.drive(oracle.vehicle_path(130.0, 25.0), seed=3)[0].crop(20.0, 120.0)
    imu, stuck = recording.imu, (recording.imu.t >= 70.0) & (recording.imu.t <= 95.0)
    gyro, accel = imu.gyro.copy(), imu.accel.copy()
    gyro[stuck], accel[stuck] = gyro[stuck][0], accel[stuck][0]
    recording = replace(recording, imu=replace(imu, gyro=gyro, accel=accel))
    online = Online(drop_rows(recording), QUICK)
    for row in list_rows(recording)[1]:
        online.add(row)
    (told,) = (f for f in online.findings if f.key == "imu.filled")  # while it runs
    online.finish()
    (offline,) = (f for f in inspect(recording).findings if f.key == "imu.filled")
    assert told.severity == offline.severity
    assert abs(online.sensors.filled.count - (stuck.sum() - 1)) <= 1
    assert f"{stuck.sum() - 1} IMU rows" in offline.sentence
    assert "imu.filled" in {get_key(note) for note in online.notes}
    assert not online.failures
    t = np.concatenate([track.t for track in online.settled()])
    assert not ((t > 70.5) & (t < 94.5)).any()
    assert t[-1] == pytest.approx(recording.end)


@pytest.mark.parametrize(("unit", "key"), [("g", "imu.force_scale"), ("deg/s", "imu.gyro_unit")])
def test_what_is_refused_of_a_recording_is_so_while_it_is_driven_and_at_the_end(
    drive: Recording, unit: str, key: str
) -> None:
    """And nothing else is said of it."""

    def find_told() -> set[str]:
        assert session.online is not None
        return {get_key(note) for note in session.online.notes} & TOLD

    session = Session(QUICK, "-", None)
    *lines, end = (line for _, line in format_lines(drive))
    session.add_lines([lines[0], *(format_line(spoil(row, unit)) for row in map(parse_row, lines[1:]) if row)])
    assert [label for label, _ in view(session)[:2]] == ["status", "refused"]
    assert find_told() == {key}
    session.add_lines([end])
    session.finish()
    with pytest.raises(RecordingError) as error:
        session.require_result()
    assert error.value.key == key
    assert find_told() == {key}
    assert session.online is not None
    assert not session.online.failures
    assert session.rows_settled


def test_a_result_that_is_unreliable_is_told_quiet_or_not(drive: Recording, tmp_path: Path) -> None:
    """The fixes a second late: solved, and wrong whatever its sigmas say."""
    first, *lines, end = (line for _, line in format_lines(drive))
    late = [(row[0], row[1] + (row[0] == "gnss"), row[2]) for row in map(parse_row, lines) if row]
    (tmp_path / "lines.txt").write_text("\n".join([first, *map(format_line, late), end]) + "\n")
    (tmp_path / "quick.toml").write_text('[noise]\nmode = "stated"\n[solver]\nlag = 10.0\n')
    run = run_here(
        "online", tmp_path / "lines.txt", "--config", tmp_path / "quick.toml", "-o", tmp_path / "out", "--quiet"
    )
    assert (run.returncode, run.stdout) == (0, "")
    found = json.loads((tmp_path / "out" / "summary.json").read_text())["findings"]
    assert [one["key"] for one in found if one["severity"] == "unreliable"] == ["imu.clock"]
    assert run.stderr.count("\n") == 1
