"""Amplitude spectra of short windows, and the line of an idling engine in them.

Leakage is reduced in two steps. The mean and trend of a window are removed, and a Hann window attenuates a strong line
5 bins off to 1/500 instead of 1/16, so that changes of force below 10 Hz do not fill the bands above. The price is a
main lobe four bins wide (1.3 Hz for a 3-s window), which is narrow against the bands. A line between two bins would
read up to 15 % low; the ratio of the two highest bins gives its place between them, exactly for a pure line (Grandke
1983, "Interpolation Algorithms for Discrete Fourier Transforms of Weighted Signals", IEEE Trans. Instrum. Meas. 32, eq.
16, 17), and with it frequency and amplitude.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.lib.stride_tricks import sliding_window_view

from graphnav.core.rotation import Array

_WINDOWS_AT_ONCE = 256  # windows at a time: a few MB whatever the length of the recording
LOWEST, _HIGHEST = 8.0, 50.0  # Hz, where idle lines are looked for
_BACKGROUND_WIDTH = 3.0  # Hz on either side of a bin over which the background is taken
_LINE_HEIGHT = 2.0  # natural logarithm of power over background at which there is a line
FEWEST_WINDOWS = 3
_LOOKED_AT = 200  # windows at most


@dataclass(frozen=True)
class Windows:
    """Windows of `length` rows every `step` rows of three columns, in chunks."""

    columns: tuple[Array, ...]  # (N,) each
    length: int
    step: int
    rate: float  # Hz

    @property
    def count(self) -> int:
        """Number of windows."""
        return max(0, (len(self.columns[0]) - self.length) // self.step + 1)

    @property
    def frequencies(self) -> Array:
        """(F,) Hz"""
        return np.arange(self.length // 2 + 1) * (self.rate / self.length)

    def compute_amplitudes(self, which: Array | None = None) -> Iterator[tuple[slice, Array]]:
        """Single-sided amplitudes (w, 3, F) of all windows or of some, chunk by chunk, in the columns' units."""
        if self.count <= _WINDOWS_AT_ONCE:  # small enough to be kept
            yield (
                slice(0, self.count if which is None else len(which)),
                self._all if which is None else self._all[which],
            )
            return
        yield from self._make(np.arange(self.count) if which is None else which)

    @cached_property
    def _all(self) -> Array:
        return next(self._make(np.arange(self.count)))[1]

    def _make(self, number: Array) -> Iterator[tuple[slice, Array]]:
        n = self.length
        ramp = np.linspace(-1.0, 1.0, n)
        hann = np.hanning(n + 1)[:-1]
        # removes mean and trend and applies the weights, afterwards: w (x - a - b ramp)
        for begin in range(0, len(number), _WINDOWS_AT_ONCE):
            some = number[begin : begin + _WINDOWS_AT_ONCE]
            x = np.empty((len(some), len(self.columns), n), dtype=np.float32)
            for c, column in enumerate(self.columns):
                view = sliding_window_view(column, n)[some * self.step]
                # single precision holds a spectrum's five digits once the window's mean is removed
                x[:, c] = view - view.mean(axis=1, keepdims=True)
            slope = (x @ ramp.astype(np.float32)) / np.float32(ramp @ ramp)
            x -= slope[..., None] * ramp.astype(np.float32)
            x *= hann.astype(np.float32)
            out = np.abs(scipy.fft.rfft(x, axis=-1, overwrite_x=True))
            out *= np.float32(2.0 / hann.sum())
            yield slice(begin, begin + len(some)), out


def find_peaks(amplitude: Array, frequencies: Array, low: float, high: float) -> tuple[Array, Array]:
    """Highest peak of each spectrum (..., F) with low <= f < high: frequency (Hz) and amplitude, Grandke's."""
    i, j = np.searchsorted(frequencies, [low - 1e-9, high - 1e-9])
    i = max(int(i), 1)
    j = min(int(j), len(frequencies))
    if j <= i:
        shape = amplitude.shape[:-1]
        return np.full(shape, np.nan), np.full(shape, np.nan)
    k = i + amplitude[..., i:j].argmax(axis=-1)
    last = len(frequencies) - 1
    flat, row = amplitude.reshape(-1, amplitude.shape[-1]), np.arange(k.size)
    at = [flat[row, np.minimum(k.ravel() + d, last)].reshape(k.shape) for d in (-1, 0, 1)]  # k > 0
    # a value at the edge of a band may belong to a line of the next band: only a peak is interpolated
    peak = (at[1] >= at[0]) & (at[1] >= at[2]) & (k < last)
    up = at[2] >= at[0]
    ratio = np.where(up, at[2], at[0]) / np.maximum(at[1], 1e-30)
    off = np.where(peak, np.clip((2.0 * ratio - 1.0) / (ratio + 1.0), 0.0, 0.5), 0.0)
    gain = np.where(off > 1e-6, np.pi * off * (1.0 - off**2) / np.sin(np.pi * np.maximum(off, 1e-6)), 1.0)
    bin_width = frequencies[1]
    return (k + np.where(up, off, -off)) * bin_width, at[1] * gain


@dataclass(frozen=True)
class IdleLine:
    """The line of an idling engine."""

    frequency: float  # Hz, median over the windows that show it
    lowest: float  # Hz, 5 % quantile over these windows
    highest: float  # Hz, 95 % quantile over these windows
    harmonic: float  # natural logarithm of the second harmonic's power over the spectrum around it; NaN above Nyquist
    share: float  # share of the examined windows that show it


def find_idle_line(windows: Windows, still: Array) -> IdleLine | None:
    """The line that stands out in the windows numbered `still`, with its second harmonic; None without one.

    A quarter of the windows is enough: the engine may be switched off in the others.
    """
    if len(still) < FEWEST_WINDOWS:
        return None
    some = still[np.unique(np.linspace(0, len(still) - 1, _LOOKED_AT).astype(int))]
    f = windows.frequencies
    reach = max(2, round(_BACKGROUND_WIDTH / f[1]))
    spectra = np.concatenate([a for _, a in windows.compute_amplitudes(some)])
    power = 2.0 * np.log(np.maximum(spectra, 1e-12))
    clear = np.asarray((power - _take_local_median(power, reach)).max(axis=1))  # (w, F), the clearest channel
    quarter = max(1, len(some) // 4)
    line = np.sort(clear, axis=0)[-quarter:].mean(axis=0)
    # noise alone reaches some level; a line lies above half of the bins
    line = np.maximum(line - np.median(line), 0.0)
    inside = np.flatnonzero((f > LOWEST - f[1]) & (f <= min(_HIGHEST, f[-1] - 2.0 * f[1])))
    peak = [int(k) for k in inside if line[k] >= line[k - 1] and line[k] >= line[k + 1] and line[k] > _LINE_HEIGHT]
    if not peak:
        return None

    def find_second(k: int) -> float:
        return float(line[2 * k - 1 : 2 * k + 2].max()) if 2 * k + 1 < len(f) else float("nan")

    # a strong second harmonic is a line too, but has no line at half its frequency
    best = max(peak, key=lambda k: line[k] + np.nan_to_num(find_second(k)))
    where, height = find_peaks(spectra, f, 0.88 * f[best], 1.12 * f[best] + f[1])
    shown = clear[:, best - 1 : best + 2].max(axis=1) > _LINE_HEIGHT
    shown = shown if shown.any() else np.ones(len(some), dtype=bool)
    # in the channel in which it stands out most
    floor = np.exp(0.5 * _take_local_median(power, reach)[..., best])
    strongest = int(np.median(height[shown] / floor[shown], axis=0).argmax())
    low, middle, high = np.quantile(where[shown, strongest], [0.05, 0.5, 0.95])
    return IdleLine(float(middle), float(low), float(high), find_second(best), float(shown.mean()))


def _take_local_median(power: Array, reach: int) -> Array:
    """Median of the spectrum around each bin, over blocks of `reach` bins."""
    n = power.shape[-1] // reach
    if n < 2:
        return np.median(power, axis=-1, keepdims=True)
    block = np.median(power[..., : n * reach].reshape(*power.shape[:-1], n, reach), axis=-1)
    # a block and its neighbours: the lower half of three medians never contains the line itself
    padded = np.concatenate([block[..., :1], block, block[..., -1:]], axis=-1)
    middle = np.median(np.stack([padded[..., :-2], padded[..., 1:-1], padded[..., 2:]]), axis=0)
    k = np.minimum(np.arange(power.shape[-1]) // reach, n - 1)
    return np.asarray(middle[..., k])
