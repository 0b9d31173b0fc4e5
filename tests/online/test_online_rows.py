"""Rows that a driver makes: the same as those of a recording, and one plain line for what cannot be."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import oracle
import pytest
from helpers import refused

from graphnav.config import Settings
from graphnav.core.earth import STANDARD_GRAVITY as G
from graphnav.core.errors import RecordingError
from graphnav.online import (
    Fix,
    ImuSample,
    Online,
    Reading,
    WheelSpeed,
    drop_rows,
    list_rows,
    live_setup,
    live_trajectory,
    make_setup,
)
from graphnav.online.lines import PROTOCOL, format_head, parse_row, read_setup
from graphnav.sensors.barometer import SENSOR as BAROMETER

SD = (0.02, 0.02, 0.04)


def test_they_are_the_rows_of_a_recording() -> None:
    recording, _ = oracle.drive(oracle.vehicle_path(120.0, 25.0), odometer_rate=10.0, gnss_velocity_sd=(0.1, 0.1, 0.2))
    recording = recording.crop(0.0, 10.0)
    made = {
        "imu": lambda t, v: ImuSample(t, v[:3], v[3:]),
        "gnss": lambda t, v: Fix(t, *np.degrees(v[:2]), v[2], v[3:6], v[6:9], v[9:12]),
        "odometer": lambda t, v: WheelSpeed(t, v[0]),
    }
    seen = set()
    for row in list_rows(recording)[1]:
        sensor, t, values = row
        mine = made[sensor](t, values)
        assert mine[:2] == (sensor, t)
        assert mine[2] == pytest.approx(values, abs=1e-12, nan_ok=True)
        seen.add(sensor)
    assert seen == set(made)


def test_they_are_taken_in_and_kept_as_plain_rows() -> None:
    online = Online(live_setup(antenna=SD, axle=(0.0, -1.0, 0.0)), Settings())
    assert live_trajectory(online) is None
    rows = [ImuSample(0.01, (0, 0, 0), (0, 0, 9.8)), Fix(0.02, 48.0, 11.0, 500.0, SD), WheelSpeed(0.02, 1.0)]
    for row in rows:
        online.add(row)
        again = pickle.loads(pickle.dumps(row))
        assert type(again) is tuple
        assert again[:2] == row[:2]
    assert [online.sensors.counts[name] for name in ("imu", "gnss", "odometer")] == [1, 1, 1]
    assert online.sensors.setup.gnss.lever_arm == pytest.approx(SD)


@pytest.mark.parametrize(
    "row",
    [
        ("gnss", 0.02, (0.8, 0.2, 500.0, 0.02, 0.02, 0.04)),  # without velocity, which is NaN where there is none
        ("imu", 0.02, (0.0, 0.0, 0.0, 0.0, 9.8)),
        ("imu", "now", (0.0, 0.0, 0.0, 0.0, 0.0, 9.8)),
        ("imu", 0.02, (0.0, 0.0, 0.0, 0.0, 0.0, None)),
        ("imu", 0.02, (0.0, 0.0, 0.0, 0.0, 0.0, 10**400)),
        ("lidar", 0.02, (1.0,)),
        ([], 0.02, (1.0,)),
        (0.02, 48.0, 11.0, 500.0, 1.0, 1.0),
        "imu",
        None,
    ],
)
def test_what_is_no_row_is_refused_and_changes_nothing(row: object) -> None:
    online = Online(live_setup(antenna=SD), Settings())
    online.add(ImuSample(0.01, (0, 0, 0), (0, 0, 9.8)))
    with pytest.raises(RecordingError) as found:
        online.add(row)
    assert found.value.key.startswith("row.")
    assert "\n" not in str(found.value)
    assert not online.failures
    assert online.sensors.counts.total() == 1


@pytest.mark.parametrize(
    ("make", "key", "name"),
    [
        (lambda: Fix(1.0, 48.0, 11.0, 500.0, (1.0, 1.0)), "row.three", "sd"),
        (lambda: Fix(1.0, 48.0, 11.0, 500.0, 1.0), "row.three", "sd"),
        (lambda: Fix(1.0, 48.0, 11.0, 500.0, (1.0, 0.0, 1.0)), "row.sigma", "sd"),
        (lambda: Fix(1.0, 4807.038, 1131.0, 500.0, SD), "row.place", "4807.038"),
        (lambda: Fix(1.0, 48.0, 11.0, 500_000.0, SD), "row.height", "h 500000"),
        (lambda: Fix(1.0, 48.0, 11.0, 500.0, SD, v=(1.0, 2.0, 3.0)), "row.velocity", "sd_v"),
        (lambda: Fix(1.0, 48.0, 11.0, 500.0, SD, v=(1e3, 2e3, 0.0), sd_v=SD), "row.bounds", "mm/s"),
        (lambda: Fix(float("nan"), 48.0, 11.0, 500.0, SD), "row.number", "nan"),
        (lambda: ImuSample(1.0, (0.0, 0.0), (0.0, 0.0, 9.8)), "row.three", "gyro"),
        (lambda: ImuSample(1.0, (100.0, 0.0, 0.0), (0.0, 0.0, 9.8)), "row.bounds", "deg/s"),
        (lambda: ImuSample(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, "g")), "row.number", "accel"),
        (lambda: WheelSpeed(1.0, 5000.0), "row.speed", "mm/s"),
        (lambda: live_setup(antenna=(1.0, 2.0)), "row.three", "antenna"),
        (lambda: live_setup(platform="boat"), "row.platform", "boat"),
    ],
)
def test_what_cannot_be_is_one_plain_line(make: Callable[[], object], key: str, name: str) -> None:
    with refused(key, RecordingError, name):
        make()


def test_the_setup_of_a_recording_holds_no_row() -> None:
    """Whatever a sensor has for each of its rows is left out, so that it cannot be taken for that of another row."""
    made, _ = oracle.drive(oracle.vehicle_path(120.0, 25.0), odometer_rate=10.0)
    recording = made.crop(0.0, 20.0)
    assert recording.gnss is not None
    assert recording.odometer is not None
    n, m = len(recording.gnss.t), len(recording.odometer.t)
    gnss = replace(recording.gnss, type=np.ones(n, dtype=int), satellites=np.full(n, 9.0))
    odometer = replace(recording.odometer, counted=np.zeros(m), wheels=np.zeros((m, 4)))
    setup = drop_rows(replace(recording, gnss=gnss, odometer=odometer))
    for sensor, count in ((setup.gnss, n), (setup.odometer, m), (setup.imu, len(recording.imu.t))):
        kept = [name for name, x in vars(sensor).items() if isinstance(x, np.ndarray) and len(x) == count]
        assert kept == []


def test_rows_in_the_units_and_axes_of_a_source_are_those_of_its_lines() -> None:
    keys = {
        "imu": {"axes": "FRD", "units": {"t": "ms", "gyro": "deg/s", "accel": "g"}, "time_offset": 0.25},
        "gnss": {"units": {"t": "ms", "angle": "rad", "height": "ft", "speed": "km/h"}, "lever_arm": [0.1, 0.2, 0.3]},
        "odometer": {"units": {"speed": "km/h"}},
        "barometer": {"units": {"pressure": "hPa"}},
    }
    setup, units = make_setup(keys)
    gyro, accel, sd, v, sd_v = (
        (1.0, -2.0, 300.0),
        (0.1, 0.02, -1.0),
        (1.0, 1.5, 2.0),
        (30.0, -40.0, 1.0),
        (3.0, 2.0, 1.0),
    )
    llh = (0.84, 0.19, 1600.0)
    rows = [
        (ImuSample(1000.0, gyro, accel, units), ("I", 1000.0, *gyro, *accel)),
        (Fix(1000.0, *llh, sd, v, sd_v, units), ("G", 1000.0, *llh, *sd, *v, *sd_v)),
        (Fix(2000.0, *llh, sd, units=units), ("G", 2000.0, *llh, *sd)),
        (WheelSpeed(1.5, 36.0, units), ("O", 1.5, 36.0)),
        (Reading(1.5, BAROMETER, units, pressure=950.0), ("S", "barometer", 1.5, 950.0, "")),
    ]
    line = f"{PROTOCOL} {json.dumps(keys)}"
    assert format_head(read_setup(line)[0]) == format_head(setup)
    for row, cells in rows:
        other = parse_row(",".join(map(str, cells)), read_setup(line)[1])
        assert other is not None
        assert row[0] == other[0]
        np.testing.assert_allclose(row[1], other[1], rtol=1e-15)
        np.testing.assert_allclose(row[2], other[2], rtol=1e-14)
    np.testing.assert_allclose(
        rows[0][0][2], [np.radians(-2.0), np.radians(1.0), np.radians(-300.0), 0.02 * G, 0.1 * G, G]
    )
    assert rows[0][0][1] == 1.25
    with refused("row.bounds", RecordingError, "gyro"):
        ImuSample(1.0, (5000.0, 0.0, 0.0), accel, units)
    with refused("key.unknown", RecordingError, "axis"):
        make_setup({"imu": {"axis": "FRD"}})
