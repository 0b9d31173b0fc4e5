"""Stationary intervals where the engine's idle line dominates the spectrum: Li 2024, section 4.2, for any engine.

In windows of 3 s every second, of forward force, up force and pitch rate, Peak-0, Peak-1 and Peak-2 are the highest
amplitudes from 0 to 10, 10 to 20 and 20 to 30 Hz. A window is stationary if

    speed < 0.5 m/s, where a speed is known;
    no peak exceeds 15 mg or 0.7 deg/s;
    1.5 Peak-1 > Peak-0 and 1.5 Peak-2 > Peak-0 of both forces, and Peak-1 >= 7 Peak-0 of the pitch rate.

The statistic is the largest of these quotients, so that it is below 1 where all conditions hold. The paper's bands
belong to an idle line at 12.5 Hz. Here the line is found in windows that other detectors call stationary or, without
them, in windows that are calm below any idle line; the bands are scaled with it. A ratio that this engine does not meet
while idling (no second harmonic, no pitch) is not required. When the detector decides alone, every window must meet the
limits of calm windows, because an engine also idles while a vehicle rolls.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from graphnav.config.detectors import FftSettings
from graphnav.core.earth import MG
from graphnav.core.interpolation import pick_nearest
from graphnav.core.notes import Note, Notes
from graphnav.core.rotation import Array
from graphnav.detectors.base import NONE, Detection, Mask, find_spans, mask_within
from graphnav.detectors.motion import Speeds
from graphnav.detectors.scene import Detector, Labels, Scene
from graphnav.detectors.spectrum import FEWEST_WINDOWS, LOWEST, IdleLine, Windows, find_idle_line, find_peaks
from graphnav.detectors.thresholds import find_valley, log_statistic

LINE_OF_THE_PAPER = 12.495  # Hz, the idle line that the paper's bands belong to
_MET = 0.7  # share of stationary windows that must meet a ratio for it to be required
_LONGEST_WINDOW = 0.05  # relative excess of a window's duration at which its frequencies are wrong
_STRAY = 0.05  # relative deviation of an idle line from those observed
_SPECTROGRAM_COLUMNS = 600  # columns of the spectrogram that is kept for the figure
_SPECTROGRAM_END = 60.0  # Hz, upper end of that spectrogram
_LOWEST_RATE = 49.0  # Hz, lowest sampling rate at which the detector works
CONDITIONS = (
    "forward limit", "up limit", "pitch limit",
    "forward Peak-1", "forward Peak-2", "up Peak-1", "up Peak-2", "pitch Peak-1",
)  # fmt: skip
_REQUIRED = ("forward limit", "up limit")  # always required: vibration above these limits occurs only while driving


class IdleFft(Detector):
    """The detector of windows dominated by the idle line."""

    name = "fft"
    edge = 4.0  # s: the grid of 3-s windows in a part of a recording is shifted against that of the whole

    @classmethod
    def detect(cls, scene: Scene, labels: Labels | None = None, shown: bool = True) -> Detection:
        return _detect(scene, labels, shown)


def _detect(scene: Scene, labels: Labels | None, shown: bool) -> Detection:
    imu, period, settings = scene.recording.imu, scene.period, scene.settings.fft
    rate = 1.0 / period
    length, step = round(settings.window * rate), max(1, round(settings.step * rate))
    columns = (imu.accel[:, 1], imu.accel[:, 2], imu.gyro[:, 0])
    w = Windows(columns, length, step, rate)
    begin = np.arange(w.count) * step
    t_first, t_last = imu.t[begin], imu.t[begin + length - 1] if w.count else imu.t[:0]
    t = 0.5 * (t_first + t_last) - 0.5 * period
    if not w.count or rate < _LOWEST_RATE:
        reason = "the recording is shorter than a window" if rate >= _LOWEST_RATE else f"{rate:.3g} Hz are too few"
        return Detection(
            "fft",
            t,
            np.full(len(t), np.nan),
            1.0,
            t < t,
            NONE,
            (Note("detectors.fft.not_possible", f"no FFT detection: {reason}"),),
        )
    whole = t_last - t_first < (1.0 + _LONGEST_WINDOW) * length * period
    half = 0.5 * length * period
    quiet = _weigh_idling(w, settings) if labels is None and settings.find_line else np.zeros(w.count)
    inner = whole & (
        mask_within(t, labels.still, half) if labels else (quiet < 1.0) & ~mask_within(t, scene.certain, half)
    )
    line = find_idle_line(w, np.flatnonzero(inner)) if settings.find_line else None
    notes = Notes()
    if settings.find_line and line is None:
        notes.add("detectors.fft.no_line", _note_no_line(int(inner.sum()), settings, labels is None))
        if not shown:
            return Detection("fft", t, np.full(w.count, np.nan), 1.0, t < t, NONE, tuple(notes))
    factor = 1.0 if line is None else line.frequency / LINE_OF_THE_PAPER
    bands, clipped = _select_bands(settings, factor, w.frequencies)
    if clipped:
        notes.add("detectors.fft.bands_cut", clipped)
    height, where, kept, spectrogram = _measure(w, bands)
    quotient = _compute_quotients(height, settings)
    asked: Mask = np.asarray(np.isfinite(quotient).any(axis=0))
    if line is not None:
        notes.add("detectors.fft.line", _describe_idling(line))
        idling = inner & _detect_line(height, where, line)
        met = np.asarray((quotient[idling] < 1.0).mean(axis=0) >= _MET) if idling.any() else asked
        if labels is None:
            met = met | np.isin(CONDITIONS, _REQUIRED)
        left_out = [name for name, ok, seen in zip(CONDITIONS, met, asked, strict=True) if seen and not ok]
        asked = asked & met
        quotient = np.column_stack([quotient, _measure_off_line(where, asked, line)])
        asked = np.append(asked, True)
        if left_out:
            notes.add(
                "detectors.fft.conditions",
                f"FFT detector: without the conditions that the idling engine does not meet: {', '.join(left_out)}",
            )
    usable = asked[3:8].any() and (line is not None or not settings.find_line)
    found = np.full(w.count, np.nan)
    if usable:
        found = np.where(whole, np.nanmax(np.where(asked, quotient, np.nan), axis=1), np.nan)
        found = np.maximum(np.maximum(found, quiet), _divide_speed(t, settings, scene.known))
    mask = found < 1.0
    details = {
        "peak_frequency": where,
        "peak_amplitude": height,
        "bands": np.array(bands),
        "spectrogram": spectrogram,
        "spectrogram_t": t[kept],
        "spectrogram_frequency": w.frequencies[: spectrogram.shape[1]],
    }
    if line is not None:
        details["idle_line"] = np.array([line.frequency, line.lowest, line.highest])
    spans = find_spans(mask, t, half)
    return Detection("fft", t, found, 1.0, mask, spans, tuple(notes), details)


def _weigh_idling(w: Windows, settings: FftSettings) -> Array:
    """(W,) below 1 where the engine may idle, for use without labels of stationary windows.

    Below the lowest idle line no peak may exceed the paper's limits nor, where the windows fall into two populations by
    their amplitude there, the lower one.
    """
    height = _measure(w, [(0.0, LOWEST)])[0][:, :, 0]
    x = log_statistic((height / _list_peak_limits(settings)).max(axis=1))
    split = find_valley(x, float(np.nanmin(x)), 0.0, FEWEST_WINDOWS)
    return np.asarray(10.0 ** (x - (0.0 if split is None else split)))


def _detect_line(height: Array, where: Array, line: IdleLine) -> Mask:
    """Windows in which the line dominates the band of Peak-1 or Peak-2 of at least one channel."""
    near = np.zeros(len(height), dtype=bool)
    for k in (1, 2):
        at = np.abs(where[:, :, k] / (k * line.frequency) - 1.0) < 0.1
        near |= (at & (height[:, :, k] > height[:, :, 0])).any(axis=1)
    return near


def _measure_off_line(where: Array, asked: Mask, line: IdleLine) -> Array:
    """Deviation of each window's line from those observed while idling; above 1 it is another line.

    While driving, an engine's lines move with its speed. Of the channels whose Peak-1 is required, the nearest counts.
    """
    channels = [c for c, k in ((0, 3), (1, 5), (2, 7)) if asked[k]] or [0, 1, 2]
    middle = 0.5 * (line.lowest + line.highest)
    reach = 0.5 * (line.highest - line.lowest) + _STRAY * middle
    return np.asarray(np.nanmin(np.abs(where[:, channels, 1] - middle), axis=1) / reach)


def _select_bands(settings: FftSettings, factor: float, frequencies: Array) -> tuple[list[tuple[float, float]], str]:
    ends = [0.0, *(factor * end for end in settings.bands)]
    top = float(frequencies[-1])
    bands = [(min(a, top), min(b, top)) for a, b in pairwise(ends)]
    note = ""
    if ends[-1] > top + frequencies[1]:
        lost = [f"Peak-{k}" for k, (a, b) in enumerate(bands) if b - a < 2.0 * frequencies[1]]
        note = f"FFT detector: its bands up to {ends[-1]:.3g} Hz are cut at {top:.3g} Hz, half the IMU's rate" + (
            f": {' and '.join(lost)} cannot be seen" if lost else ""
        )
    return bands, note


def _measure(w: Windows, bands: Sequence[tuple[float, float]]) -> tuple[Array, Array, Array, Array]:
    """Amplitude and frequency of the peaks (W, 3 channels, 3 bands), and some windows with the spectrogram of the up
    force in them.
    """
    height, where = np.full((w.count, 3, 3), np.nan), np.full((w.count, 3, 3), np.nan)
    f = w.frequencies
    shown = int(np.searchsorted(f, _SPECTROGRAM_END))
    keep = np.unique(np.linspace(0, w.count - 1, _SPECTROGRAM_COLUMNS).astype(int))
    rows = []
    for part, a in w.compute_amplitudes():
        for k, (low, high) in enumerate(bands):
            where[part, :, k], height[part, :, k] = find_peaks(a, f, low, high)
        inside = keep[(keep >= part.start) & (keep < part.stop)] - part.start
        rows.append(a[inside, 1, :shown])
    return height, where, keep, np.concatenate(rows)


def _compute_quotients(height: Array, settings: FftSettings) -> Array:
    """(W, 8) in the order of `CONDITIONS`: all below 1 means stationary, NaN where a peak cannot be observed."""
    limit = _list_peak_limits(settings)
    # fmax ignores a peak that cannot be observed
    size = np.fmax(np.fmax(height[..., 0], height[..., 1]), height[..., 2]) / limit
    peak0 = height[:, :, 0]
    ratios = [peak0[:, c] / (settings.force_ratio * np.maximum(height[:, c, k], 1e-12)) for c in (0, 1) for k in (1, 2)]
    ratios.append(settings.rate_ratio * peak0[:, 2] / np.maximum(height[:, 2, 1], 1e-12))
    return np.column_stack([size, *ratios])


def _list_peak_limits(settings: FftSettings) -> Array:
    """(3,) m/s^2, m/s^2, rad/s: upper limits for the peaks of forward force, up force and pitch rate."""
    return np.array([settings.force_limit * MG, settings.force_limit * MG, np.radians(settings.rate_limit)])


def _divide_speed(t: Array, settings: FftSettings, speeds: Sequence[Speeds]) -> Array:
    """Speed over its limit, the largest of all sensors; 0 where none is known."""
    out = np.zeros(len(t))
    half = 0.5 * settings.window
    for s in speeds:
        k = pick_nearest(s.t, t)
        near = np.abs(s.t[k] - t) < half
        three = np.clip(k[:, None] + [-1, 0, 1], 0, len(s.t) - 1)
        excess = np.median(s.speed[three] / np.maximum(settings.max_speed, s.limit[three]), axis=1)
        out = np.where(near, np.maximum(out, excess), out)
    return out


def _describe_idling(line: IdleLine) -> str:
    drift = "" if line.highest - line.lowest < 0.5 else f" (from {line.lowest:.1f} to {line.highest:.1f})"
    if np.isnan(line.harmonic):
        second = "its second harmonic lies above half the IMU's rate"
    else:
        second = "with its second harmonic" if line.harmonic > 1.0 else "without a second harmonic"
    rest = "" if line.share > 0.9 else f", in {100.0 * line.share:.0f} % of the still windows"
    return f"idle line at {line.frequency:.2f} Hz{drift}, {second}{rest}"


def _note_no_line(windows: int, settings: FftSettings, alone: bool) -> str:
    if windows < FEWEST_WINDOWS:
        return f"no idle line: no {settings.window + 2 * settings.step:.3g} s are still enough to look for one"
    return "no idle line from 8 to 50 Hz where the vehicle stands: engine off, electric, or too faint for the IMU; " + (
        "so no stop is found by it" if alone else "the other detectors do without"
    )
