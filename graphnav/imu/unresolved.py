"""Noise of motion within a sample period, such as heel strikes.

A row holds the mean rate and force of its period, and they are integrated as if constant over it. A signal that changes
linearly by D within a period deviates from its mean by D / sqrt(12) (1-sigma). In a drive that is far below sensor
noise. When a heel meets the floor, force changes by 10 m/s^2 and rate by 1 rad/s from row to row, and so do errors that
no data sheet states: mismatched filters, misaligned axes, sensitivity of the gyro to force. So each row gets additional
white noise,

    sigma_k = D_k / sqrt(48),    D_k = (|x_k - x_k-1| + |x_k+1 - x_k|) / (2 sqrt(3))    per axis

a density of sigma_k^2 dt. Sensor noise changes rows too; its contribution is subtracted first. Half of D / sqrt(12) is
used because that is a bound: a sensor that averages before it is sampled loses less, and residuals of real walks show 3
to 20 % of its variance, of the fastest 40 %.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.core.rotation import Array
from graphnav.imu.samples import Samples
from graphnav.recording import ImuNoise

_VARIANCE_SHARE = 0.25  # share of the variance of a linearly changing signal


def add_unresolved_motion(samples: Samples, noise: ImuNoise) -> Samples:
    """The samples with the noise of motion within their periods."""
    period = float(np.median(np.diff(samples.t)))
    return replace(
        samples,
        extra_gyro=samples.extra_gyro + _estimate_density(samples.gyro, noise.gyro_noise_density, period),
        extra_accel=samples.extra_accel + _estimate_density(samples.accel, noise.accel_noise_density, period),
    )


def _estimate_density(x: Array, white: float, period: float) -> Array:
    """White density squared (N, 1), alike along all axes, of rows (N, 3); `white` is the sensor's own density."""
    change = np.sum(np.diff(x, axis=0) ** 2, axis=1) / 3.0
    change = np.maximum(change - 2.0 * white**2 / period, 0.0)
    both = 0.5 * (np.sqrt(np.r_[change[:1], change]) + np.sqrt(np.r_[change, change[-1:]]))
    return np.asarray(_VARIANCE_SHARE * both**2 / 12.0 * period)[:, None]


def add_coning(samples: Samples) -> Samples:
    """Samples whose rate and force, constant over a period, have the same effect as ones that change linearly over it.

    For a rate w and a force f that change evenly, w', f' per second, in a period T (Savage 1998, part 1, eq. 36-49 and
    part 2, eq. 44-55, with slopes by central instead of backward differences, because all rows are there)::

        coning      w + T^2/12 w x w'
        sculling    f + T^2/12 (w x f' + f x w')
    """
    if len(samples.t) < 3:
        return samples
    T = np.diff(samples.t, prepend=samples.start)
    middle = samples.t - 0.5 * T
    w, f = samples.gyro, samples.accel
    dw, df = np.zeros_like(w), np.zeros_like(f)
    across = (middle[2:] - middle[:-2])[:, None]
    dw[1:-1], df[1:-1] = (w[2:] - w[:-2]) / across, (f[2:] - f[:-2]) / across
    part = (T * T / 12.0)[:, None]
    return replace(samples, gyro=w + part * np.cross(w, dw), accel=f + part * (np.cross(w, df) + np.cross(f, dw)))
