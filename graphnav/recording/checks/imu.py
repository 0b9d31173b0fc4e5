"""Checks of the IMU by itself: stamps, repeats, saturation, units, gravity and noise at rest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from graphnav.core.earth import STANDARD_GRAVITY, gravity
from graphnav.core.findings import Finding, compute_period, describe_gaps, find_gap_limit, find_runs
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array
from graphnav.recording import Imu, Recording
from graphnav.recording.checks.tracks import Track

_LEAST_FOOT_RATE = 80.0  # Hz; the impact of a step lasts for 20 to 50 ms
_LONG_GAP = 0.2  # s; over longer ones the motion changes
_SHAKEN_OVER = 0.02  # s
_OFTEN = 10  # times that no signal comes to its largest value by itself
_CHANGED = 3.0  # m/s, of the speed: more than errors of velocities


def check_imu_time(imu: Imu) -> Iterator[Finding]:
    step, period = np.diff(imu.t), compute_period(imu.t)
    gaps = np.flatnonzero(step > find_gap_limit(imu.t))
    lost = step[gaps] - period
    if len(gaps) and lost.max() > _LONG_GAP:  # shorter ones are counted, and told where they are filled in
        yield Finding("warning", describe_gaps("the IMU", lost, imu.t[gaps] - imu.t[0]), "imu.gap")
    uneven = float((np.abs(step - period) > 0.25 * period).mean())
    if uneven > 0.05:
        yield Finding(
            "note",
            f"IMU stamps are uneven: {100 * uneven:.0f} % of the steps differ by over 25 % from {1e3 * period:.4g} ms",
            "imu.uneven",
        )


def check_foot_rate(recording: Recording) -> Iterator[Finding]:
    rate = 1.0 / compute_period(recording.imu.t)
    if recording.platform == "foot" and rate < _LEAST_FOOT_RATE:
        yield Finding(
            "warning",
            f"the IMU on the foot is sampled at {rate:.0f} Hz: what impacts do between the rows is lost, and errors "
            "are several times as large; record at 100 Hz or more",
            "imu.slow",
        )


def is_shaken_as_a_foot(t: Array, accel: Array) -> bool:
    """Whether forces (N, 3) m/s^2 are those of a shoe, thrown and stopped by more than gravity.

    So is more than a hundredth of its time; a vehicle would leave the road: of those measured a motorbike comes next,
    with 7 m/s^2, before a slow walk with 10. Means over 20 ms leave a chassis's vibrations out.
    """
    n = max(round(_SHAKEN_OVER / compute_period(t)), 1)
    means = accel[: len(accel) // n * n].reshape(-1, n, 3).mean(axis=1)
    if not len(means):
        return False
    return float(np.percentile(np.abs(np.linalg.norm(means, axis=1) - STANDARD_GRAVITY), 99.0)) > STANDARD_GRAVITY


def check_repeats(imu: Imu, track: Track | None) -> Iterator[Finding]:
    """Rows that repeat the one before; all of them, in a drive that by its fixes goes faster and slower."""
    gyro, accel = imu.gyro[1:] == imu.gyro[:-1], imu.accel[1:] == imu.accel[:-1]
    same = np.logical_and.reduce([*gyro.T, *accel.T])
    if same.all() and track is not None:
        speed = track.speed
        falls = np.maximum.accumulate(speed) - speed
        rises = speed - np.minimum.accumulate(speed)
        if min(falls.max(), rises.max()) > _CHANGED:
            yield Finding(
                "refused",
                f"the IMU reads the same in all of its {len(imu.t)} rows while the fixes speed up and slow down: they "
                "are no measurements",
                "imu.frozen",
            )
            return
    if same.mean() > 0.002:
        yield Finding(
            "note",
            f"{format_count(same.sum(), 'IMU row')} ({100 * same.mean():.1f} %) with the values of the row before",
            "imu.repeats",
        )


def check_saturation(imu: Imu) -> Iterator[Finding]:
    # in the file's axes: a tilted mount would spread a clipped axis over three
    for what, values, smallest, unit in (("gyro", imu.gyro, 0.5, "rad/s"), ("accelerometer", imu.accel, 5.0, "m/s2")):
        for axis in range(3):
            x = values @ imu.R_bs[:, axis]
            for sign in (1.0, -1.0):
                signed = sign * x
                top = signed.max()
                if top < smallest or top == np.median(signed):
                    continue
                runs = [b - a for a, b in find_runs(signed > top - 1e-6 * top) if b - a >= 3]
                seldom = (
                    top > 3.0 * signed.std()
                )  # else of a swing; where it ends there again and again, so does the range
                if (seldom and (len(runs) >= 2 or max(runs, default=0) >= 5)) or len(runs) >= _OFTEN:
                    yield Finding(
                        "warning",
                        f"{what} {'xyz'[axis]} (file axes) is saturated: "
                        f"{sum(runs)} rows stay at {sign * top:.4g} {unit}",
                        "imu.saturated",
                    )


def check_gyro_unit(recording: Recording) -> Iterator[Finding]:
    """Turn rates that a sensor can read, but a vehicle or foot does not reach."""
    x, y, z = np.abs(recording.imu.gyro).T
    rate = float(np.percentile(np.maximum(np.maximum(x, y), z), 99.0))
    if rate > (4.0 if recording.platform == "vehicle" else 35.0):  # 35 rad/s = 2000 deg/s, the usual full scale
        yield Finding(
            "warning",
            f"the gyro reaches {rate:.3g} rad/s, too fast for a {recording.platform}: if it is deg/s, "
            'set units = { gyro = "deg/s" }' + ('; if it is on a foot, platform = "foot"' if rate < 35.0 else ""),
            "imu.gyro_fast",
        )


def check_force_at_rest(recording: Recording, rest: Array, facts: dict[str, Any]) -> Iterator[Finding]:
    f = float(np.linalg.norm(recording.imu.accel[rest].mean(axis=0)))
    if recording.platform == "foot":  # every stance has another attitude
        f = float(np.linalg.norm(recording.imu.accel[rest], axis=1).mean())
    place, g = "standard", STANDARD_GRAVITY
    if recording.gnss is not None:
        place, g = "local", float(gravity(*recording.gnss.llh[0, [0, 2]]))
    facts["force_at_rest_mps2"] = round(f, 4)
    facts[f"{place}_gravity_mps2"] = round(g, 4)
    off = f / g - 1.0
    if 0.006 < abs(off) < 0.15:  # normal gravity differs by 0.3 % at most from the standard value
        sigma = recording.imu.noise.accel_bias_sigma
        covered = "" if abs(f - g) < 3 * sigma else f"; accel_bias_sigma = {sigma:g} does not cover that"
        yield Finding(
            "note" if not covered else "warning",
            f"at rest the force is {f:.3f} m/s2 where gravity is {g:.3f} ({100 * off:+.1f} %){covered}",
            "imu.gravity",
        )


def check_noise_at_rest(imu: Imu, rest: Array) -> Iterator[Finding]:
    """Allan deviation at 1 s, which for white noise is its density (IEEE Std 952-1997, annex C)."""
    n = max(5, round(1.0 / compute_period(imu.t)))
    for what, x, stated in (
        ("gyro_noise_density", imu.gyro, imu.noise.gyro_noise_density),
        ("accel_noise_density", imu.accel, imu.noise.accel_noise_density),
    ):
        pairs: list[Array] = []
        for a, b in find_runs(rest):
            seconds = x[a : a + (b - a) // n * n].reshape(-1, n, 3).mean(axis=1)
            pairs.append(np.diff(seconds, axis=0))
        steps = np.concatenate(pairs)
        if len(steps) < 10:
            continue
        # the median, not the mean: a start or a door between two seconds must not count
        allan = float(np.max(np.median(np.abs(steps), axis=0))) / 0.6745 / np.sqrt(2.0)
        if allan > 4.0 * stated:
            yield Finding(
                "warning",
                f"{what} = {stated:.2g} is small: at rest the noise is {allan:.2g} (Allan deviation at 1 s)",
                "imu.noise_small",
            )
