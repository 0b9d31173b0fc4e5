"""When the keyframes of a running drive are made: at fixes and between, and how long they wait for rows."""

from __future__ import annotations

import numpy as np

from graphnav.constraints.base import SAME_TIME
from graphnav.online.sensors import Sensors

AFTER = 0.05  # s of IMU rows after a keyframe that a fix may use
_ODOMETER = 0.3  # s that a keyframe waits for the odometer
_SILENT = 2.0  # s of silence after which an odometer is not waited for


def list_keyframes(T: float, limit: float, fixes: list[float], period: float, last: bool) -> list[float]:
    """Times of the keyframes after T up to `limit`, s: at fixes, and every `period` between.

    The last of a drive is at `limit`.
    """
    needs_keyframes = [t for t in fixes if T + SAME_TIME < t <= limit]
    if last and limit > T + SAME_TIME and (not needs_keyframes or limit > needs_keyframes[-1] + SAME_TIME):
        needs_keyframes.append(limit)
    times, at = [], T
    for anchor in [*needs_keyframes, np.inf]:
        while anchor - at > period * (1.0 + 1e-6) and at + period <= limit:
            at += period
            times.append(at)
        if np.isfinite(anchor):
            at = anchor
            times.append(at)
    return times


def find_limit(sensors: Sensors, last: bool) -> float:
    """Up to when (s) keyframes may be made; of the last ones nothing is waited for."""
    now, odometer = sensors.imu.newest, sensors.odometer.newest
    limit = now if last else now - AFTER
    return limit if last or now - odometer >= _SILENT else min(limit, max(odometer, now - _ODOMETER))


def expect_keyframe(T: float, fixes: list[float], period: float) -> float:
    """Expected time of the keyframe after T, s."""
    fix = min((t for t in fixes if t > T + SAME_TIME), default=np.inf)
    return fix if fix - T <= period * (1.0 + 1e-6) else T + period


def find_due(T: float, fixes: list[float], period: float) -> float:
    """The time of the IMU (s) at which the keyframe after T can be made."""
    return min([T + period, *(t for t in fixes if t > T)]) + AFTER
