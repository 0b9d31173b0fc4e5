"""Zero-velocity statistics over short windows: generalised likelihood ratio test and its relatives.

For a window of N rows of specific force f_k and turn rate omega_k, with window mean f_bar (Skog et al. 2010, "Zero-
Velocity Detection - An Algorithm Evaluation", IEEE Trans. Biomed. Eng. 57(11), eq. 9, 13, 15, 18; Ren 2021, eq. 3-5):

    glrt                         1/N sum |f_k - g f_bar/|f_bar||^2 / sigma_a^2 + |omega_k|^2 / sigma_w^2
    acceleration_variance        1/N sum |f_k - f_bar|^2 / sigma_a^2
    acceleration_magnitude       1/N sum (|f_k| - g)^2 / sigma_a^2
    angular_rate_energy          1/N sum |omega_k|^2 / sigma_w^2

Multiplied out, all of them need no more than the window's means of f, |f|, |f|^2 and |omega|^2:
|f_k - g u|^2 = |f_k|^2 - 2 g f_k.u + g^2 with u = f_bar/|f_bar|, hence mean |f|^2 - 2 g |f_bar| + g^2.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graphnav.config.detectors import GlrtSettings
from graphnav.detectors.base import Detection, spans_of, within
from graphnav.detectors.windows import Blocks, running, unbroken, window_times
from graphnav.recording import ImuNoise
from graphnav.rotation import Array

_TINY = 1e-300
_STEP = 0.1  # s between windows
_SCALE = 0.05  # of g that a sensor's scale and bias may be off
# twice the expectation under noise alone: three axes of each sensor, one direction of the magnitude
_AT_NOISE = {
    "glrt": 12.0, "acceleration_variance": 6.0, "acceleration_magnitude": 2.0, "angular_rate_energy": 6.0,
}  # fmt: skip
Statistic = Callable[[Array, float, float, float], Array]


def rows_for(accel: Array, gyro: Array) -> Array:
    """[force, rate, |force|, |force|^2, |rate|^2], (N, 9): what the statistics need the means of."""
    squares = np.einsum("nj,nj->n", accel, accel)
    turning = np.einsum("nj,nj->n", gyro, gyro)
    return np.column_stack([accel, gyro, np.sqrt(squares), squares, turning])


def glrt(means: Array, sigma_a: float, sigma_w: float, g: float) -> Array:
    """Generalised likelihood ratio of windows with these means, (W, 9) -> (W,); Skog et al. 2010, eq. 9."""
    along = np.linalg.norm(means[:, :3], axis=1)
    force = means[:, 7] - 2.0 * g * along + g * g
    return np.asarray(np.maximum(force, 0.0) / sigma_a**2 + means[:, 8] / sigma_w**2)


def acceleration_variance(means: Array, sigma_a: float, sigma_w: float, g: float) -> Array:
    """Variance of the force in each window over sigma_a^2; eq. 13."""
    spread = means[:, 7] - np.einsum("wj,wj->w", means[:, :3], means[:, :3])
    return np.asarray(np.maximum(spread, 0.0) / sigma_a**2)


def acceleration_magnitude(means: Array, sigma_a: float, sigma_w: float, g: float) -> Array:
    """How far the size of the force is from gravity, over sigma_a^2; eq. 15."""
    off = means[:, 7] - 2.0 * g * means[:, 6] + g * g
    return np.asarray(np.maximum(off, 0.0) / sigma_a**2)


def angular_rate_energy(means: Array, sigma_a: float, sigma_w: float, g: float) -> Array:
    """Mean square turn rate over sigma_w^2; eq. 18."""
    return np.asarray(means[:, 8] / sigma_w**2)


STATISTICS: dict[str, Statistic] = {
    "glrt": glrt,
    "acceleration_variance": acceleration_variance,
    "acceleration_magnitude": acceleration_magnitude,
    "angular_rate_energy": angular_rate_energy,
}


def glrt_statistic(
    accel: Array, gyro: Array, window: int, sigma_a: float, sigma_w: float, g: float, name: str = "glrt"
) -> Array:
    """The statistic of every window of `window` rows: entry k covers rows k ... k + window - 1, (N - window + 1,).

    Parameters
    ----------
    accel, gyro : (N, 3) m/s^2, rad/s.
    window : N of the equations, rows, at least 1.
    sigma_a, sigma_w : m/s^2, rad/s, 1-sigma noise of a row.
    g : m/s^2, size of gravity.
    name : one of `STATISTICS`.
    """
    if len(accel) < window:
        return np.zeros(0)
    return STATISTICS[name](running(rows_for(accel, gyro)).means(window), sigma_a, sigma_w, g)


def stance_mask(statistic: Array, threshold: float, window: int) -> np.ndarray:
    """Rows that lie in a window below the threshold (Ren 2021, eq. 5), (N,) bool for N - window + 1 statistics."""
    n = len(statistic) + window - 1
    below = np.r_[0, np.cumsum(statistic < threshold), 0]
    row = np.arange(n)
    first, last = np.maximum(row - window + 1, 0), np.minimum(row + 1, len(statistic))
    return np.asarray(below[last] > below[first])


def detect_windows(
    b: Blocks, noise: ImuNoise, settings: GlrtSettings, still: Array, moving: Array, g: float
) -> list[Detection]:
    """Every statistic of the recording with a threshold of its own.

    The threshold lies where the fewest windows are called wrongly, of those that another detector finds still and
    those that it finds moving: an idling engine may lift the statistic far above the sensors' noise. Without any
    still ones it is twice what the sensors' noise makes of the statistic.

    Parameters
    ----------
    still, moving : (M, 2) s, spans that are clearly one or the other.
    g : m/s^2, gravity at the place; replaced by the mean force of what is still, which holds the sensor's scale.
    """
    # windows begin a tenth of a second apart: the blocks between are summed once, for all of them
    group = max(1, min(round(_STEP / b.period), round(0.5 * settings.window / b.period)))
    count = len(b.t) // group
    rows = b.mean[: count * group].reshape(count, group, -1).mean(axis=1)
    middle = b.t[: count * group].reshape(count, group).mean(axis=1)
    unbroken_rows = np.asarray(b.whole[: count * group].reshape(count, group).all(axis=1))
    window = max(2, round(settings.window / (group * b.period)))
    if count < window:
        return []
    t = window_times(middle, window)
    means = running(rows).means(window)
    half = 0.5 * settings.window
    at_rest, in_motion = within(t, still, half), within(t, moving, half)
    reference = at_rest if at_rest.any() else np.ones(len(t), dtype=bool)
    bias = np.median(means[reference, 3:6], axis=0)
    means[:, 8] += bias @ bias - 2.0 * means[:, 3:6] @ bias
    measured = float(np.median(np.linalg.norm(means[reference, :3], axis=1)))
    if at_rest.any() and abs(measured / g - 1.0) < _SCALE:
        g = measured
    per_row = 1.0 / np.sqrt(b.row_period)
    sigma_a, sigma_w = noise.accel_noise_density * per_row, noise.gyro_noise_density * per_row
    whole = unbroken(unbroken_rows, window)
    out = []
    for name, statistic in STATISTICS.items():
        values = np.where(whole, statistic(means, sigma_a, sigma_w, g), np.nan)
        threshold = _AT_NOISE[name]
        if name == "glrt" and settings.threshold is not None:
            threshold = settings.threshold
        elif at_rest.any():
            threshold = fewest_errors(values[at_rest & whole], values[in_motion & whole], threshold)
        mask = values < threshold
        out.append(Detection(name, t, values, threshold, mask, spans_of(mask, t, half)))
    return out


def fewest_errors(still: Array, moving: Array, least: float) -> float:
    """Threshold that calls the smallest share of still windows moving plus of moving windows still, at least `least`.

    Of several that do equally well, the middle one by their logarithm.
    """
    if not len(still):
        return least
    x, y = np.sort(log_statistic(still)), np.sort(log_statistic(moving))
    if not len(y):
        return max(least, float(10.0 ** x[-1]) * 2.0)
    grid = np.linspace(min(x[0], y[0]), max(x[-1], y[-1]), 400)
    wrong = 1.0 - np.searchsorted(x, grid) / len(x) + np.searchsorted(y, grid) / len(y)
    best = np.flatnonzero(wrong <= wrong.min() + 1e-12)
    return max(least, float(10.0 ** grid[best[len(best) // 2]]))


def log_statistic(statistic: Array) -> Array:
    """log10, where populations of a statistic are told apart; zero becomes very small, NaN stays."""
    return np.log10(np.maximum(statistic, _TINY))
