"""Upper bound of a shoe-mounted IMU's white noise from the quietest stretch of a walk, where stated figures are larger.

Figures stated for foot-mounted IMUs are often generous because heel strikes are noisier than any data sheet. But heel
strikes are modelled separately (`graphnav.imu.unresolved`), and a gyro noise stated ten times too large leaves the gyro
bias ten times less known from the rests at both ends of a walk. So the noise is measured in the quietest stretch of the
recording: means over `_CLUSTER`, and of them second differences, in which a slow sway cancels. White noise of density q
gives each squared second difference the expectation 6 q^2 / `_CLUSTER` (the Allan variance has first differences, 2 q^2
/ `_CLUSTER`). The sway of a standing person adds to that, so the result is an upper bound; but the quietest of many
stretches is also quiet by chance, and the bound is one that true noise would undercut in less than `_CHANCE` of them.

Drives are excluded: with a running engine a vehicle vibrates differently than at rest. So are walks in progress, whose
longest rest may be yet to come.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import gammaincinv  # scipy.stats would take half a second to import

from graphnav.config import Settings
from graphnav.core.findings import compute_period
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.detectors.windows import sum_rows
from graphnav.recording import ImuNoise, Recording

_CLUSTER = 0.1  # s
_STRETCH_LENGTH = 2.0  # s
_CHANCE = 1e-3
_INDEPENDENT = 1.0 / (1.0 + 2.0 * ((4.0 / 6.0) ** 2 + (1.0 / 6.0) ** 2))  # of second differences: (1, -2, 1) overlap
_WORDS = {"gyro_noise_density": "gyro", "accel_noise_density": "accelerometer"}
_DENSITY_UNITS = {"gyro_noise_density": "rad/s/sqrt(Hz)", "accel_noise_density": "m/s^2/sqrt(Hz)"}


def apply_measured_floor(recording: Recording, settings: Settings) -> tuple[Recording, tuple[str, ...]]:
    """A walk with noise densities no larger than its quietest stretch shows, and a sentence on those lowered.

    Other recordings, and figures to be taken as stated, are as they were.
    """
    imu = recording.imu
    if recording.platform != "foot" or settings.noise.mode == "stated":
        return recording, ()
    shown = {
        "gyro_noise_density": bound_density(imu.t, imu.gyro),
        "accel_noise_density": bound_density(imu.t, imu.accel),
    }
    lower = {name: density for name, density in shown.items() if density < getattr(imu.noise, name)}
    if not lower:
        return recording, ()
    figures = ", ".join(
        f"{_WORDS[name]} {density:.2g} instead of {getattr(imu.noise, name):.2g} {_DENSITY_UNITS[name]}"
        for name, density in lower.items()
    )
    noise: ImuNoise = replace(imu.noise, **lower)
    return replace(recording, imu=replace(imu, noise=noise)), (
        Note("noise.imu.quieter", f"at rest the IMU is quieter than stated: {figures}"),
    )


def bound_density(t: Array, x: Array) -> float:
    """Bound from above of the white noise density of rows x (N, 3) at times t (N,), per axis; infinite if too short."""
    period = compute_period(t)
    size = max(1, round(_CLUSTER / period)) if period < _CLUSTER else 1
    count, stretch = len(t) // size, round(_STRETCH_LENGTH / (size * period)) if np.isfinite(period) else 1
    if stretch < 3 or count < stretch:
        return float("inf")
    n = count * size
    mean = x[:n].reshape(count, size, 3).mean(axis=1)
    bend = np.sum((mean[2:] - 2.0 * mean[1:-1] + mean[:-2]) ** 2, axis=1) / (3.0 * 6.0) * (size * period)
    degrees = 3.0 * (stretch - 2) * _INDEPENDENT
    quietest = float(sum_rows(bend[:, None]).compute_means(stretch - 2).min())
    return float(np.sqrt(quietest * degrees / (2.0 * gammaincinv(0.5 * degrees, _CHANCE))))
