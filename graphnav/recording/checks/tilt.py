"""Turns and tilts of a vehicle second by second: the accelerometer's beside those of the gyro."""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array
from graphnav.recording import Imu
from graphnav.recording.checks.crosschecks import MIN_PAIRS, MIN_SPEED, regress_inliers
from graphnav.recording.checks.tracks import Track

CORRELATED = 0.7  # threshold of a correlation, or of a unit vector's component, for a decision
SIGMAS = 4.0  # significance of a slope, in sigmas
NEAR_ONE = 0.5, 1.5  # slopes nearer to 1 than to 0 and 2
# A factor of two is the smallest by which a scale is mistaken (the ranges of a sensor are that far apart): the middle.
NEAR_FACTOR = float(np.sqrt(0.5)), float(np.sqrt(2.0))


def _average_seconds(imu: Imu, track: Track) -> tuple[Array, Array, Array, Array]:
    """Starts of the seconds of IMU and track with readings of both (K,), speed at their starts and ends (K,), (K,),
    and the means of the IMU's six axes in them (K, 6): specific force and turn rate.
    """
    edges = np.arange(max(track.t[0], imu.t[0]), min(track.t[-1], imu.t[-1]))
    if len(edges) < 2:
        return np.empty(0), np.empty(0), np.empty(0), np.empty((0, 6))
    rows = np.searchsorted(imu.t, edges)
    count = np.diff(rows)
    axes = [np.diff(np.r_[0.0, np.cumsum(x)][rows]) / np.maximum(count, 1) for x in (*imu.accel.T, *imu.gyro.T)]
    after = np.clip(np.searchsorted(track.t, edges), 1, len(track.t) - 1)
    near = track.t[after] - track.t[after - 1] < 1.5 * max(1.0, track.period)
    used = (count > 0) & near[1:] & near[:-1]
    speed = np.interp(edges, track.t, track.speed)
    return edges[:-1][used], speed[:-1][used], speed[1:][used], np.stack(axes, axis=-1)[used]


def measure_sideways(imu: Imu, track: Track) -> float:
    """The force to the right over that which turn rate and speed require: 1, and -1 where an axis is reversed.

    0 where undetermined: without curves, where the bank of the road dominates, or for a vehicle that leans into curves.
    """
    _, before, after, mean = _average_seconds(imu, track)
    moving = np.minimum(before, after) > MIN_SPEED
    if moving.sum() < MIN_PAIRS:
        return 0.0
    wanted = (-0.5 * (before + after) * mean[:, 5])[moving]  # to the left in a left curve
    r, (slope,) = regress_inliers(wanted[:, None], mean[moving, 0])
    return float(slope) if r > CORRELATED and NEAR_ONE[0] < abs(slope) < NEAR_ONE[1] else 0.0


def fit_tilt(imu: Imu, track: Track) -> list[tuple[float, float]]:
    """Regress changes of the tilt by the accelerometer on those by the gyro, of pitch and of roll.

    The force forward less the change of speed is gravity times the pitch; the force to the right less that of the
    curve is, with the other sign, gravity times the roll.

    Returns
    -------
    list of tuple of float
        Slope and its 1-sigma for pitch (about x, right) and roll (about y, forward): about 1, more or less where the
        IMU is above or below the axis that the body turns about. Empty where there are too few seconds.
    """
    start, before, after, mean = _average_seconds(imu, track)
    if len(start) < MIN_PAIRS + 1:
        return []
    g = float(np.linalg.norm(mean[:, :3].mean(axis=0)))
    pitch = (mean[:, 1] - (after - before)) / g
    roll = -(mean[:, 0] + 0.5 * (before + after) * mean[:, 5]) / g
    pairs = np.diff(start) < 1.5
    found = []
    for tilt, rate in ((pitch, mean[:, 3]), (roll, mean[:, 4])):
        turned, seen = 0.5 * (rate[1:] + rate[:-1])[pairs], np.diff(tilt)[pairs]
        if len(seen) < MIN_PAIRS:
            return []
        r, (slope,) = regress_inliers(turned[:, None], seen)
        spread = np.sqrt((1.0 / r**2 - 1.0) / (len(seen) - 2)) if r else np.inf
        found.append((float(slope), float(abs(slope) * spread) if r else np.inf))
    return found
