"""The low-band GLRT: likelihood ratio with unknown means, of force and rate below the engine's band.

Whatever the engine, it shakes the body above 8 Hz. Motion shows below: a road tilts, turns and heaves a vehicle at
0 to 3 Hz. So the IMU is low-passed there, and of what is left the hypothesis "constant force and rate, both unknown,
in white noise" is tested against "anything else" (Skog et al. 2010, section III, with the mean force and the mean rate
as the nuisance parameters: their maximum likelihood estimates are the window's means, which take the place of
g f_bar/|f_bar| and of zero rate):

    S = 1/2 [ var(f)/(3 s_f^2) + var(omega)/(3 s_w^2) ],     s^2 = noise density^2 / s * gain^2 + sway^2

S is 1 where sensor noise and the sway of a vehicle with people in it are all there is. On roads it is 10 to 1000.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.config.detectors import LowBandSettings
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.running import sum_rows
from graphnav.detectors.base import NONE, Detection, drop_short, find_spans, mask_within
from graphnav.detectors.scene import Detector, Labels, Scene
from graphnav.detectors.thresholds import MISLABELLED, MISTAKEN, SHORTEST_POPULATION, find_valley, log_statistic
from graphnav.detectors.windows import LowPassed, compute_window_times, find_unbroken
from graphnav.recording import ImuNoise

NAME = "low_band_glrt"
_DOWN, _UP = 1.5, 0.7  # decades by which the data may lower or raise the threshold
_LEAST_MOTION = 30.0  # s of certain motion needed to bound the threshold
_QUIETEST = 1.0  # s of the quietest windows, which bound the noise from above
_TRUSTED = 0.05  # least share of the stated noise that is accepted
_OVERSTATED = 2.0  # ratio to the noise of the quietest windows above which stated noise is too large


class LowBandGlrt(Detector):
    """The low-band GLRT; it needs no labels."""

    name = NAME
    edge = 0.3  # the grid of windows changes the quantiles that edges are set by

    @classmethod
    def detect(cls, scene: Scene, labels: Labels | None = None, shown: bool = True) -> Detection:
        return compute_low_band(scene)[0]


def compute_low_band(scene: Scene) -> tuple[Detection, Scale]:
    """The answer of the low-band GLRT, and the scale of a low-passed row at rest, by which edges are found."""
    return detect_low_band(scene.low, scene.recording.imu.noise, scene.settings.low_band_glrt, scene.certain)


@dataclass(frozen=True)
class Scale:
    """1-sigma per axis of a low-passed row at rest: m/s^2 and rad/s."""

    force: float
    rate: float
    stated: float = 1.0  # S of a row at rest under the stated noise
    overstated: bool = False  # whether the recording has windows far below that


def measure_spreads(low: LowPassed, window: int) -> Array:
    """Variance per axis of force and of rate in every window of low-passed rows, (W, 2); NaN across a gap."""
    rows = low.rows - low.rows.mean(axis=0)
    sums = sum_rows(np.concatenate([rows, rows**2], axis=1)).compute_means(window)
    spread = np.maximum(sums[:, 6:] - sums[:, :6] ** 2, 0.0)
    each = np.stack([spread[:, :3].mean(axis=1), spread[:, 3:].mean(axis=1)], -1)
    return np.where(find_unbroken(low.whole, window)[:, None], each, np.nan)


def scale(low: LowPassed, noise: ImuNoise, settings: LowBandSettings, spread: Array) -> Scale:
    """Scale of a low-passed row of a stationary vehicle from sensor noise and sway.

    Every window contains the noise, so the quietest windows bound it from above: figures stated too large must not hide
    motion.
    """
    stated = low.gain * np.array([noise.accel_noise_density, noise.gyro_noise_density])
    there = spread[np.isfinite(spread).all(axis=1)]
    floor = stated
    if len(there):
        few = min(round(_QUIETEST / low.period), len(there) - 1)
        floor = np.sqrt(np.partition(there, few, axis=0)[few])
    used = np.clip(floor, _TRUSTED * stated, stated)
    sway = np.array([settings.force, settings.rate])
    force, rate = np.hypot(used, sway)
    expected = float(np.mean((stated**2 + sway**2) / (used**2 + sway**2)))
    return Scale(float(force), float(rate), expected, bool((stated > _OVERSTATED * np.hypot(floor, sway)).any()))


def compute_low_band_statistic(spread: Array, s: Scale) -> Array:
    """S of windows with these variances per axis, (W,)."""
    return np.asarray(0.5 * (spread[:, 0] / s.force**2 + spread[:, 1] / s.rate**2))


def detect_low_band(
    low: LowPassed, noise: ImuNoise, settings: LowBandSettings, moving: Array
) -> tuple[Detection, Scale]:
    """Windows with nothing but noise and sway below the engine's frequencies, and the scale used.

    Parameters
    ----------
    moving : (M, 2) s, spans of certain motion from other sensors: the threshold is kept below what they hold.
    """
    window = max(3, round(settings.window / low.period))
    if len(low.t) < window:
        empty = np.zeros(0)
        nothing = Detection(NAME, empty, empty, settings.threshold, empty > 0, NONE)
        return nothing, scale(low, noise, settings, np.zeros((0, 2)))
    t = compute_window_times(low.t, window)
    spread = measure_spreads(low, window)
    s = scale(low, noise, settings, spread)
    found = compute_low_band_statistic(spread, s)
    threshold, notes = _find_threshold(t, found, settings, moving, low.period, s)
    mask = found < threshold
    # a window does not show where in it motion began: stationary is only what all windows over it agree on
    spans = find_spans(mask, t, 0.5 * settings.window)
    return Detection(NAME, t, found, threshold, mask, drop_short(spans, settings.window), notes), s


def _find_threshold(
    t: Array, found: Array, settings: LowBandSettings, moving: Array, period: float, s: Scale
) -> tuple[float, tuple[str, ...]]:
    if not settings.from_data:
        return settings.threshold, ()
    x, start = log_statistic(found), float(np.log10(settings.threshold))
    swaying = 0.5 * ((settings.force / s.force) ** 2 + (settings.rate / s.rate) ** 2)
    label = mask_within(t, moving, settings.window) & np.isfinite(x)
    split = find_valley(x, start - _DOWN, start + _UP + float(np.log10(s.stated)), round(SHORTEST_POPULATION / period))
    if split is not None and not (label.any() and np.mean(x[label] < split) > MISLABELLED):
        return float(10.0**split), ()
    notes: tuple[str, ...] = ()
    if s.overstated and np.mean(found < settings.threshold) < 0.5:
        # stated noise that would hide so much is not used, and no population stands out: 3 sigma of the sway remains
        start = min(start, float(np.log10(9.0 * swaying)))
        notes = (
            Note(
                "detectors.low_band.noise",
                "the IMU's stated noise is too large to detect stops: only the quietest spans count",
            ),
        )
    if label.sum() * period >= _LEAST_MOTION:
        # some of these windows may be mislabelled; the threshold keeps a distance from the others
        start = min(start, max(float(np.quantile(x[label], MISTAKEN)) - np.log10(2.0), start - _DOWN))
    return float(10.0**start), notes
