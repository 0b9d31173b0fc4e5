"""Stillness below the engine's frequencies: what a standing body with a running engine still does not do.

Whatever the engine, it shakes the body above 8 Hz. Motion shows below: a road tilts, turns and heaves a vehicle at
0 to 3 Hz. So the IMU is low-passed there and the GLRT taken of what is left, with the biases unknown (the window's
own mean takes the place of g f_bar/|f_bar| and of zero rate; Skog et al. 2010, section III, with the mean rate
estimated too):

    S = 1/2 [ var(f)/(3 s_f^2) + var(omega)/(3 s_w^2) ],     s^2 = noise density^2 / s * gain^2 + sway^2

S is 1 where sensor noise and the sway of a vehicle with people in it are all there is. On roads it is 10 to 1000.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.config import SwaySettings
from graphnav.detectors.base import Detection, inside, longer_than, spans_of
from graphnav.detectors.glrt import log_statistic
from graphnav.detectors.thresholds import valley
from graphnav.detectors.windows import LowPassed, running, unbroken, window_times
from graphnav.recording import ImuNoise
from graphnav.rotation import Array

_DOWN, _UP = 1.5, 0.7  # decades that the data may move the threshold down and up
_FEWEST = 3.0  # s of a population that the data may tell of
_MOVING = 30.0  # s of certain motion that say where the threshold must not be


@dataclass(frozen=True)
class Scale:
    """1-sigma per axis of a low-passed row at rest: m/s^2 and rad/s."""

    force: float
    rate: float


def scale(low: LowPassed, noise: ImuNoise, settings: SwaySettings) -> Scale:
    """What sensor noise and sway make of a low-passed row of a standing vehicle."""
    return Scale(
        float(np.hypot(low.gain * noise.accel_noise_density, settings.force)),
        float(np.hypot(low.gain * noise.gyro_noise_density, settings.rate)),
    )


def statistic(low: LowPassed, window: int, s: Scale) -> Array:
    """S of every window of low-passed rows, (W,); NaN where a gap lies in it."""
    rows = low.rows
    sums = running(np.concatenate([rows, (rows - rows.mean(axis=0)) ** 2], axis=1)).means(window)
    spread = sums[:, 6:] - (sums[:, :6] - rows.mean(axis=0)) ** 2
    found = spread[:, :3].sum(axis=1) / (6.0 * s.force**2) + spread[:, 3:].sum(axis=1) / (6.0 * s.rate**2)
    return np.where(unbroken(low.whole, window), np.maximum(found, 0.0), np.nan)


def detect_sway(low: LowPassed, noise: ImuNoise, settings: SwaySettings, moving: Array) -> Detection:
    """Windows in which nothing but noise and sway is left below the engine's frequencies.

    Parameters
    ----------
    moving : (M, 2) s, spans of certain motion from other sensors: the threshold is kept below what they hold.
    """
    window = max(3, round(settings.window / low.period))
    if len(low.t) < window:
        empty = np.zeros(0)
        return Detection("sway", empty, empty, settings.threshold, empty > 0, np.zeros((0, 2)))
    t = window_times(low.t, window)
    found = statistic(low, window, scale(low, noise, settings))
    threshold, notes = _threshold(t, found, settings, moving, low.period)
    mask = found < threshold
    # a window says nothing of where in it motion began: only what all windows over it call still is
    half = 0.5 * settings.window
    spans = spans_of(mask, t, half)
    return Detection("sway", t, found, threshold, mask, longer_than(spans, settings.window), notes)


def _threshold(
    t: Array, found: Array, settings: SwaySettings, moving: Array, period: float
) -> tuple[float, tuple[str, ...]]:
    if not settings.from_data:
        return settings.threshold, ()
    x, start = log_statistic(found), float(np.log10(settings.threshold))
    fewest = round(_FEWEST / period)
    split = valley(x, start - _DOWN, start + _UP, fewest)
    chosen = start if split is None else split
    label = inside(t, np.stack([moving[:, 0] + settings.window, moving[:, 1] - settings.window], -1)[
        moving[:, 1] - moving[:, 0] > 2.0 * settings.window]) & np.isfinite(x)  # fmt: skip
    if label.sum() * period >= _MOVING:
        # 1 of 100 moving windows may be mislabelled; half of what the next reach keeps clear of them
        chosen = min(chosen, max(float(np.quantile(x[label], 0.01)) - np.log10(2.0), start - _DOWN))
    return float(10.0**chosen), ()
