"""Error of an odometer's readings (resolution, noise), and the mean speed over any window.

A window's mean is the distance covered in it over its length, so every reading of a fast odometer counts; the distance
is the counted one, or the integral of the speed with linear interpolation between readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphnav.core.findings import compute_period
from graphnav.core.rotation import Array
from graphnav.recording import Odometer

Spans = Array  # (M, 2) s, [first bad reading, next good one)

_FINEST_STEP = 1e-7  # m/s; smaller differences are rounding of floating point
_MAD = 1.4826  # sigma over the median magnitude of a normal variable
_ROUNDING_SIGMA = np.sqrt(1.0 / 12.0)  # 1-sigma of a rounding error, in steps


def find_quantum(speed: Array) -> float:
    """Resolution of readings that differ by whole multiples of it, m/s; 0 where there is none.

    Differences of adjacent readings are tested, not the readings: a resolution with an error of 1 % of a per cent is
    still found, and an offset does not matter.
    """
    size = np.abs(np.diff(speed))
    size = size[np.isfinite(size) & (size > _FINEST_STEP)]
    if len(size) < 10:
        return 0.0
    # the coarsest that explains them: finer ones may be digits of a file, or a converted unit
    for share in (50.0, 25.0, 10.0, 5.0, 1.0):
        for parts in (1, 2, 3):  # the smallest difference may be two or three steps
            step = float(np.percentile(size, share)) / parts
            few = size[size < 20.5 * step]
            for _ in range(3):  # sums over many steps determine one more precisely
                count = np.round(few / step)
                if not count.any():
                    break
                step = float(count @ few / (count @ count))
            # without a resolution the remainders are uniform, three in ten below 0.15
            if (np.abs(few / step - np.round(few / step)) < 0.15).mean() > 0.95 and len(few) >= 10:
                return step
    return 0.0


def estimate_reading_sigma(odometer: Odometer, step: float | None = None) -> float:
    """1-sigma of one reading, m/s: as stated, else its scatter, at least that of its resolution.

    The scatter is that of third differences in motion, which remove any motion that is smooth over four readings: the
    variance of a third difference is 20 times that of a reading. `step` is the quantum, if known.
    """
    if odometer.speed_sigma is not None:
        return odometer.speed_sigma
    t, speed = odometer.t, odometer.speed
    rounding = _ROUNDING_SIGMA * (find_quantum(speed) if step is None else step)
    if len(t) < 10:
        return rounding
    steps = np.diff(t)
    even = np.lib.stride_tricks.sliding_window_view(steps < 2.5 * compute_period(t), 3).all(axis=1)
    moving = (np.lib.stride_tricks.sliding_window_view(speed, 4) != 0.0).all(axis=1)
    third = np.abs(np.diff(speed, 3))[even & moving]
    scatter = _MAD * float(np.median(third)) / np.sqrt(20.0) if len(third) >= 10 else 0.0
    return max(scatter, rounding)


def find_pulse_length(odometer: Odometer, step: float | None = None) -> float:
    """Metres per pulse where the speeds are pulses counted from row to row, else 0.

    Rounding errors of such readings telescope: the error of the mean of n of them is 1/n of that of one, and 1/sqrt(n)
    if they were independent. Third differences show which, as in `estimate_reading_sigma`.
    """
    t, speed = odometer.t, odometer.speed
    step = find_quantum(speed) if step is None else step
    if odometer.counted is not None or step == 0.0:
        return odometer.pulse
    even = np.r_[True, np.diff(t) < 1.5 * compute_period(t)] & (speed != 0.0)

    def measure_scatter(n: int) -> float:
        rows = len(t) // n * n
        whole = np.lib.stride_tricks.sliding_window_view(even[:rows].reshape(-1, n).all(axis=1), 4).all(axis=1)
        third = np.abs(np.diff(speed[:rows].reshape(-1, n).mean(axis=1), 3))[whole]
        return float(third.mean()) if len(third) >= 50 else np.inf

    if len(t) < 800:
        return 0.0
    one = measure_scatter(1)
    # counts alternate by their step from row to row; those over many periods hardly change
    if not step < one < np.inf:
        return 0.0
    telescopes = any(measure_scatter(n) < one * n**-0.75 for n in (2, 4))  # half-way between
    return step * compute_period(t) if telescopes else 0.0


def find_longest_step(t: Array) -> float:
    """The longest step between stamps that is not a gap, s: jitter and a dropped row or two are common."""
    return 3.5 * max(compute_period(t), float(np.percentile(np.diff(t), 95.0))) if len(t) > 1 else 0.0


def find_gaps(t: Array, longest: float | None = None) -> Spans:
    """Spans without readings, from where the first one is missing; `longest` as by `find_longest_step`, if known."""
    k = np.flatnonzero(np.diff(t) > (find_longest_step(t) if longest is None else longest))
    return np.stack([t[k] + compute_period(t), t[k + 1]], -1).reshape(-1, 2)


@dataclass(frozen=True)
class ReadingStatistics:
    """Statistics of a single reading, estimated from many."""

    step: float  # m/s, `quantum`
    sigma: float  # m/s, `estimate_reading_sigma`
    pulse: float  # m, `counts`
    longest: float  # s, `longest_step`

    @classmethod
    def of(cls, odometer: Odometer) -> ReadingStatistics:
        """Estimate them from these readings."""
        step = find_quantum(odometer.speed)
        return cls(
            step,
            estimate_reading_sigma(odometer, step),
            find_pulse_length(odometer, step),
            find_longest_step(odometer.t),
        )

    def list_sigmas(self, odometer: Odometer) -> tuple[float, float, float]:
        """`white`, `rounding` and `ends` of a `MeanSpeed`."""
        if odometer.speed_sigma is not None:
            return float(odometer.speed_sigma), 0.0, 0.0
        if self.pulse:  # each end of a count has an error of up to one pulse, uniform: a difference of two
            return 0.0, 0.0, float(np.sqrt(2.0) * _ROUNDING_SIGMA * self.pulse)
        rounding = _ROUNDING_SIGMA * self.step
        return float(np.sqrt(max(self.sigma**2 - rounding**2, 0.0))), rounding, 0.0


def _sum_from_zero(steps: NDArray[Any]) -> NDArray[Any]:
    """Running sums, from zero."""
    out = np.zeros(len(steps) + 1, dtype=steps.dtype)
    np.cumsum(steps, out=out[1:])
    return out


@dataclass(frozen=True)
class MeanSpeed:
    """Mean speed over windows, from sums computed once: a call costs two searches per window. Built by `of`.

    NaN where a window is not covered by good readings throughout.
    """

    t: Array  # (M,) s
    speed: Array  # (M,) m/s
    distance: Array  # (M,) m up to t
    straight: bool  # whether `distance` is counted, and so interpolated linearly between readings
    bad: NDArray[np.intp]  # (M,) number of bad segments between readings up to t
    changes: NDArray[np.intp]  # (M,) number of changes of the reading up to t
    white: float  # m/s, the part of a reading's error that is independent of the others
    rounding: float  # m/s, the part that persists while the reading does not change
    ends: float  # m, error of a counted distance

    @classmethod
    def of(cls, odometer: Odometer, spans: Spans | None = None, figures: ReadingStatistics | None = None) -> MeanSpeed:
        """Build without the readings in `spans` (see `faults`) and not across gaps; `figures` if they are known
        already.
        """
        figures = figures or ReadingStatistics.of(odometer)
        t, speed = odometer.t, odometer.speed
        step = t[1:] - t[:-1]
        good = np.ones(len(t), dtype=bool)
        across = step > figures.longest
        for begin, end in np.empty((0, 2)) if spans is None else spans:
            good &= (t < begin) | (t >= end)
            across |= (t[:-1] < end) & (t[1:] > begin)
        bad = across | ~good[1:] | ~good[:-1]
        counted = odometer.counted is not None
        distance = (
            odometer.counted if odometer.counted is not None else _sum_from_zero(0.5 * (speed[1:] + speed[:-1]) * step)
        )
        white, rounding, ends = figures.list_sigmas(odometer)
        return cls(
            t,
            speed,
            np.asarray(distance),
            counted,
            _sum_from_zero(bad.astype(np.intp)),
            _sum_from_zero((speed[1:] != speed[:-1]).astype(np.intp)),
            white=white,
            rounding=rounding,
            ends=ends,
        )

    def _find_segment(self, x: Array) -> NDArray[np.intp]:
        """The segment k between t[k] and t[k+1] in which x lies."""
        return np.minimum(np.maximum(np.searchsorted(self.t, x, side="right") - 1, 0), len(self.t) - 2)

    def _interpolate(self, k: NDArray[np.intp], x: Array) -> tuple[Array, Array]:
        """Distance and speed at x in the segments k."""
        s, step = x - self.t[k], self.t[k + 1] - self.t[k]
        slope = (self.speed[k + 1] - self.speed[k]) / step
        speed = self.speed[k] + slope * s
        if self.straight:
            return self.distance[k] + (self.distance[k + 1] - self.distance[k]) / step * s, speed
        return self.distance[k] + 0.5 * (self.speed[k] + speed) * s, speed

    def __call__(self, a: Array, b: Array, delay: float | Array = 0.0) -> tuple[Array, Array]:
        """Means over [a + delay, b + delay] and their derivative by the delay, (N,) each: m/s, m/s^2.

        The derivative is that of the speeds read; where pulses are counted, of their slope over two periods, as the
        exact one would be a staircase.
        """
        a, b = np.asarray(a, dtype=float) + delay, np.asarray(b, dtype=float) + delay
        if len(self.t) < 2:
            return np.full(np.shape(a), np.nan), np.full(np.shape(a), np.nan)
        ka, kb = self._find_segment(a), self._find_segment(b)
        kb = np.where((b == self.t[kb]) & (kb > ka), kb - 1, kb)
        (distance_a, v_a), (distance_b, v_b) = self._interpolate(ka, a), self._interpolate(kb, b)
        mean, slope = (distance_b - distance_a) / (b - a), (v_b - v_a) / (b - a)
        covered = (a >= self.t[0]) & (b <= self.t[-1]) & (self.bad[kb + 1] == self.bad[ka])
        return np.where(covered, mean, np.nan), np.where(covered, slope, np.nan)

    def compute_sigma(self, a: Array, b: Array, delay: float | Array = 0.0) -> Array:
        """1-sigma of those means, (N,) m/s.

        Noise is independent for every reading. A rounding error persists while the reading does not change: a counter
        at constant speed alternates between two values, a speed rounded by the sensor persists. A count has errors at
        its ends only.
        """
        a, b = np.asarray(a, dtype=float) + delay, np.asarray(b, dtype=float) + delay
        if len(self.t) < 2:
            return np.full(np.shape(a), np.nan)
        ka, kb = (np.maximum(np.searchsorted(self.t, x, side="right") - 1, 0) for x in (a, b))
        readings = np.maximum(kb - ka, 1)
        different = 1 + self.changes[kb] - self.changes[ka]
        return np.sqrt(self.white**2 / readings + self.rounding**2 / different + (self.ends / (b - a)) ** 2)
