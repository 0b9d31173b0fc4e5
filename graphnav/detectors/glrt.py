"""Zero-velocity statistics over short windows: the generalised likelihood ratio test and related detectors.

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

from graphnav.core.earth import MG
from graphnav.core.rotation import Array
from graphnav.core.running import sum_rows
from graphnav.detectors.base import NONE, Detection, find_spans, mask_within
from graphnav.detectors.scene import Detector, Labels, Scene
from graphnav.detectors.thresholds import choose_threshold, find_fewest_errors
from graphnav.detectors.windows import WINDOW_STEP, WindowMeans

_TINY = 1e-300
_GRAVITY_ERROR = 0.05  # share of g that an accelerometer's scale and bias may be off
# twice the expectation under noise alone: three axes of each sensor, one direction of the magnitude
_AT_NOISE = {
    "glrt": 12.0, "acceleration_variance": 6.0, "acceleration_magnitude": 2.0, "angular_rate_energy": 6.0,
}  # fmt: skip
StatisticFunction = Callable[[Array, float, float, float], Array]


def collect_rows(accel: Array, gyro: Array) -> Array:
    """[force, rate, |force|, |force|^2, |rate|^2], (N, 9): the rows whose window means the statistics need."""
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
    """Mean square deviation of the force's magnitude from gravity over sigma_a^2; eq. 15."""
    off = means[:, 7] - 2.0 * g * means[:, 6] + g * g
    return np.asarray(np.maximum(off, 0.0) / sigma_a**2)


def angular_rate_energy(means: Array, sigma_a: float, sigma_w: float, g: float) -> Array:
    """Mean square turn rate over sigma_w^2; eq. 18."""
    return np.asarray(means[:, 8] / sigma_w**2)


STATISTICS: dict[str, StatisticFunction] = {
    "glrt": glrt,
    "acceleration_variance": acceleration_variance,
    "acceleration_magnitude": acceleration_magnitude,
    "angular_rate_energy": angular_rate_energy,
}


def compute_glrt(
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
    return STATISTICS[name](sum_rows(collect_rows(accel, gyro)).compute_means(window), sigma_a, sigma_w, g)


class _Windowed(Detector):
    """One statistic of the recording with its own threshold.

    The threshold minimises wrong decisions between the windows that another detector calls stationary and those it
    calls moving: an idling engine may raise the statistic far above sensor noise. Without stationary windows it is
    twice the statistic's expectation under sensor noise. A detector that decides alone seeks the valley between two
    populations of its own (`choose_threshold`).
    """

    edge = 0.3  # s: three steps between windows

    @classmethod
    def detect(cls, scene: Scene, labels: Labels | None = None, shown: bool = True) -> Detection:
        name, settings, noise = cls.name, scene.settings.glrt, scene.recording.imu.noise
        m = scene.means
        least = _AT_NOISE[name]
        if m is None:
            none = np.zeros(0)
            return Detection(name, none, none, least, none > 0, NONE, (f"{name}: shorter than a window",))
        per_row = 1.0 / np.sqrt(scene.blocks.row_period)
        sigma_a, sigma_w = noise.accel_noise_density * per_row, noise.gyro_noise_density * per_row
        reference = _find_quietest(m) if labels is None else mask_within(m.t, labels.still, m.half)
        at_rest = bool(reference.any())
        means, g = _subtract_mean_rate(
            m.rows, reference if at_rest else np.ones(len(m.t), dtype=bool), scene.gravity, at_rest
        )
        values = np.where(m.whole, STATISTICS[name](means, sigma_a, sigma_w, g), np.nan)
        threshold = least
        notes: tuple[str, ...] = ()
        if name == "glrt" and settings.threshold is not None:
            threshold = settings.threshold
        elif labels is None:
            most = least + float(STATISTICS[name](_average_idling(scene, g), sigma_a, sigma_w, g)[0])
            threshold, notes = choose_threshold(scene, name, m.t, m.half, values, least, most)
        elif at_rest:
            in_motion = mask_within(m.t, labels.moving, m.half)
            threshold, _ = find_fewest_errors(values[reference & m.whole], values[in_motion & m.whole], least)
        mask = values < threshold
        return Detection(name, m.t, values, threshold, mask, find_spans(mask, m.t, m.half), notes)


class Glrt(_Windowed):
    """Skog et al. 2010, eq. 9."""

    name = "glrt"


class AccelerationVariance(_Windowed):
    """Skog et al. 2010, eq. 13."""

    name = "acceleration_variance"


class AccelerationMagnitude(_Windowed):
    """Skog et al. 2010, eq. 15."""

    name = "acceleration_magnitude"


class AngularRateEnergy(_Windowed):
    """Skog et al. 2010, eq. 18."""

    name = "angular_rate_energy"


def _subtract_mean_rate(rows: Array, reference: Array, g: float, at_rest: bool) -> tuple[Array, float]:
    """The means without the mean rate of the `reference` windows, and gravity as these read it if they are at rest."""
    means = rows.copy()
    bias = np.median(means[reference, 3:6], axis=0)
    means[:, 8] += bias @ bias - 2.0 * means[:, 3:6] @ bias
    measured = float(np.median(np.linalg.norm(means[reference, :3], axis=1)))
    return means, measured if at_rest and abs(measured / g - 1.0) < _GRAVITY_ERROR else g


def _find_quietest(m: WindowMeans) -> Array:
    """(W,) bool, the second of windows in which force and rate scatter least: the likeliest rest.

    Each is divided by its own typical scatter, so that neither unit dominates.
    """
    force = m.rows[:, 7] - np.einsum("wj,wj->w", m.rows[:, :3], m.rows[:, :3])
    rate = m.rows[:, 8] - np.einsum("wj,wj->w", m.rows[:, 3:6], m.rows[:, 3:6])
    scatter = force / max(float(np.median(force)), _TINY) + rate / max(float(np.median(rate)), _TINY)
    scatter = np.where(m.whole, scatter, np.inf)
    few = min(round(1.0 / WINDOW_STEP), len(scatter)) - 1
    return np.asarray(scatter <= np.partition(scatter, few)[few])


def _average_idling(scene: Scene, g: float) -> Array:
    """(1, 9) means of a window with an idling engine at the limits of Li 2024 for Peak-1 and Peak-2 of every axis.

    A line of amplitude A has the mean square A^2 / 2, so every axis has the mean square A^2.
    """
    fft = scene.settings.fft
    force, rate = fft.force_limit * MG, np.radians(fft.rate_limit)
    # along gravity the lines change the magnitude of the force: its mean is g + A^2/g with scatter A
    size = g + force**2 / g
    return np.array([[0.0, 0.0, g, 0.0, 0.0, 0.0, size, g**2 + 3.0 * force**2, 3.0 * rate**2]])
