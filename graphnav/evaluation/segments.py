"""Relative errors: errors of the displacement over segments of the trajectory, by their length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array
from graphnav.evaluation.metrics import Errors

_FEWEST_SEGMENTS = 10  # segments, at least
_LENGTH_STEPS = (1.0, 2.0, 5.0)


@dataclass(frozen=True)
class Relative:
    """Relative errors of all segments of one length. An initial error, and one that stays constant, do not enter."""

    length: float  # m, horizontal
    count: int
    rms: float  # m, of the horizontal error of the displacement
    p95: float  # m
    largest: float  # m
    heading_rms: float  # deg, of the error of the change of heading; NaN where unknown

    @property
    def percent(self) -> float:
        """Rms error over the segment's length, %."""
        return 100.0 * self.rms / self.length


def compute_relative_errors(errors: Errors) -> tuple[Relative, ...]:
    """Relative errors of segments of 10, 20, 50, 100 ... m that begin at every scored epoch.

    The displacement is compared in east and north, so that a heading error counts by its effect on the position.
    Lengths with fewer than ten segments that do not overlap are left out. The idea is that of the relative pose error
    (Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012) and of KITTI's odometry benchmark
    (Geiger et al., 2012).
    """
    known = np.isfinite(errors.horizontal) & np.isfinite(errors.distance)
    if known.sum() < 2:
        return ()
    travelled, e, heading = errors.distance[known], errors.p[known, :2], errors.rph[known, 2]
    out = []
    for length in (step * 10.0**k for k in range(1, 6) for step in _LENGTH_STEPS):
        if (travelled[-1] - travelled[0]) / length < _FEWEST_SEGMENTS:
            break
        first, last = _find_segments(travelled, length)
        if len(first) >= _FEWEST_SEGMENTS:
            off = np.hypot(*(e[last] - e[first]).T)
            turned = np.degrees(np.angle(np.exp(1j * (heading[last] - heading[first]))))
            p95, largest = np.quantile(off, 0.95), off.max()
            out.append(Relative(length, len(first), compute_rms(off), float(p95), float(largest), compute_rms(turned)))
    return tuple(out)


def _find_segments(travelled: Array, length: float) -> tuple[np.ndarray, np.ndarray]:
    """First and last rows of segments of that length, to a tenth."""
    last = np.searchsorted(travelled, travelled + length)
    first = np.flatnonzero(last < len(travelled))
    first = first[travelled[last[first]] - travelled[first] <= 1.1 * length]
    first = first[np.diff(travelled[first], prepend=-np.inf) > 0.0]  # a stationary vehicle begins one segment
    return first, last[first]


def compute_rms(x: Array) -> float:
    """Root mean square of the finite values."""
    x = x[np.isfinite(x)]
    return float(np.sqrt(np.mean(x * x))) if len(x) else float("nan")
