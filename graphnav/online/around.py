"""The rows around the keyframes that are built of them."""

from __future__ import annotations

from dataclasses import replace

from graphnav.core.findings import find_gap_limit
from graphnav.core.rotation import Array
from graphnav.online.looks import CONTEXT
from graphnav.online.sensors import Sensors
from graphnav.recording import Recording

ROWS_AFTER = 0.1  # s of rows that keyframes use after the last of them
ROWS_BEFORE = 2.0  # s of rows before a keyframe that its constraints use where the IMU has no gap; else `CONTEXT`


def cut_around(sensors: Sensors, begin: float, end: float) -> Recording:
    """The rows that keyframes between two times (s) use.

    A gap of the IMU is filled by all of its rows that are kept: half a minute may have no turn like the one it is in.
    """
    near = sensors.make_recording(begin - ROWS_BEFORE, end)
    near = replace(near, gnss=sensors.gnss.select_as_gnss(sensors.gnss.find_fix_before(begin - ROWS_BEFORE), end))
    t = near.imu.t
    whole = len(t) > 2 and float((t[1:] - t[:-1]).max()) < find_gap_limit(t)
    if whole:
        return near
    return replace(sensors.make_recording(begin - CONTEXT, end), imu=sensors.make_imu(end=end), gnss=near.gnss)


def compute_error_units(sensors: Sensors, recording: Recording) -> Array | None:
    """(M, 3) m, the unit of time-correlated errors of a recording's fixes."""
    return None if recording.gnss is None else sensors.gnss.compute_typical_sigmas(recording.gnss.t)[:, :3]
