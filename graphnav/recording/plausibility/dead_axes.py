"""Axes of an IMU that are defective or were not logged: they repeat one value while the others vary."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from graphnav.core.earth import STANDARD_GRAVITY
from graphnav.core.findings import Finding, compute_period, find_runs
from graphnav.core.rotation import Array
from graphnav.recording import Recording
from graphnav.recording.plausibility.readings import NOISY

_DEAD = 10.0  # s; the longest repetition of an axis in thirty real recordings while others move is 0.08 s
_MOVING_STEPS = 20.0  # steps of its own resolution by which an axis has moved and not only flickered
# Levels that a moving carrier exceeds by far: a thousandth of g, and the Earth's rate
_STIRS = {"accelerometer": 1e-3 * STANDARD_GRAVITY, "gyro": 7.3e-5}  # m/s^2, rad/s
_AXIS = "xyz"


def check_dead_axes(recording: Recording) -> Iterator[Finding]:
    """An axis that repeats one value while the others of its sensor change, or all of them while the other drives."""
    imu = recording.imu
    pair = {"gyro": (imu.gyro, imu.accel, 0.1), "accelerometer": (imu.accel, imu.gyro, 0.01)}  # m/s^2, rad/s
    for name, (values, other, least) in pair.items():
        if (np.ptp(values, axis=0) == 0.0).all() and _measure_swing(imu.t, other) > least:
            words = "reads the same throughout while the IMU moves: it is defective or was not logged"
            yield Finding("refused", f"the {name} {words}", "imu.dead_axis")
            return
    period = compute_period(imu.t)
    whole = recording.duration
    for name, values in (("gyro", imu.gyro), ("accelerometer", imu.accel)):
        for axis in range(3):
            x, same = _compare_repeats(values @ imu.R_bs[:, axis])
            a, b = max(find_runs(same), key=lambda run: run[1] - run[0], default=(0, 0))
            lasts = float(imu.t[b] - imu.t[a])
            if lasts < min(_DEAD, 0.9 * whole) or b - a < _DEAD:
                continue
            others = [k for k in range(3) if k != axis]
            turned = (_compare_repeats(values @ imu.R_bs[:, k]) for k in others)
            if not any(_is_moving(y[a : b + 1], stays[a:b], _STIRS[name]) for y, stays in turned):
                continue
            value = x[a]
            when = (
                "throughout"
                if lasts > whole - 2.0 * period - 0.01 * whole
                else f"from {imu.t[a] - recording.start:.1f} to {imu.t[b] - recording.start:.1f} s"
            )
            unit = "rad/s" if name == "gyro" else "m/s2"
            yield Finding(
                "refused",
                f"{name} {_AXIS[axis]} (file axes) reads {value:.4g} {unit} {when} while the others vary: it is "
                "defective or its column was not logged"
                + ("" if when == "throughout" else "; use what lies before or after (--start, --end)"),
                "imu.dead_axis",
            )


def _measure_swing(t: Array, x: Array) -> float:
    """The largest standard deviation of means of readings (N, 3) over a second, which no vibration moves."""
    n = max(round(1.0 / compute_period(t)), 1)
    return float(x[: len(x) // n * n].reshape(-1, n, 3).mean(axis=1).std(axis=0).max(initial=0.0))


def _compare_repeats(x: Array) -> tuple[Array, Array]:
    """An axis (N,) of the file, and which values (N-1,) equal the previous one: rotated and back, these differ by
    rounding.
    """
    step = np.diff(x)
    return x, np.abs(step, out=step) <= 1e-12 * max(float(x.max()), -float(x.min()))


def _is_moving(x: Array, same: Array, least: float) -> bool:
    """Whether an axis moves by many steps of its resolution, continually, and with a sensor's noise.

    Its standard deviation is then above `least`. Without noise an axis of a simulation may well be constant.
    """
    steps = np.diff(x)
    steps = steps[np.abs(steps) > 1e-12 * np.abs(x).max()]
    if len(steps) < 2 or float(np.std(x)) < least or float(same.mean()) >= 0.5:
        return False
    if float(np.ptp(x)) <= _MOVING_STEPS * float(np.abs(steps).min()):
        return False
    return float((steps[1:] * steps[:-1] < 0.0).mean()) > NOISY
