"""Rounding errors of the positions in a log.

A value rounded to a step is off by an error that is uniform over the step, of a standard deviation of step / sqrt(12)
(Widrow, Kollar and Liu 1996, "Statistical theory of quantization"). No variance factor scales it.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.earth import A
from graphnav.core.rotation import Array

_MEANT_DIGITS = 10  # decimals of degrees in double precision
_CHANCE = 1e-3  # that values which were rounded to another step are multiples of one
_FEWEST = 2  # values that determine a step: with finer ones a pair in a hundred has it by chance


def measure_rounding(llh: Array) -> tuple[float, ...]:
    """Standard deviation of the rounding error of positions, east, north and up, m; 0 where no step is found.

    For a spherical Earth: accurate to half a per cent.

    Parameters
    ----------
    llh : (N, 3) rad, rad, m; NaN where there is none.
    """
    llh = llh[np.isfinite(llh).all(axis=1)]
    if not len(llh):
        return (0.0, 0.0, 0.0)
    lat, lon = (A * np.radians(_find_step_of_degrees(np.degrees(column))) for column in llh[:, :2].T)
    return tuple(float(step) / np.sqrt(12.0) for step in (lon * np.cos(llh[0, 0]), lat, find_step(llh[:, 2])))


def _find_step_of_degrees(x: Array) -> float:
    """The step of degrees (N,): one of its own, or of the minutes that they were converted from and rounded again."""
    step = find_step(x)
    return max(step, find_step(60.0 * x, 30.0 * step) / 60.0)


def find_step(x: Array, off: float = 0.0) -> float:
    """The power of ten of which values (N,) are whole multiples; 0 without one, or with too few distinct values.

    Parameters
    ----------
    off : by which each value may be off; then there have to be so many that none is a multiple by chance.
    """
    x = np.unique(x)
    for digits in range(_MEANT_DIGITS + 1):
        steps = x * 10.0**digits
        allowed, distance = off * 10.0**digits, np.abs(steps - np.round(steps))
        if np.all(distance <= 1e-9 + 1e-15 * np.abs(steps) + 1.01 * allowed):
            enough = len(np.unique(np.round(steps))) >= _FEWEST and min(2.02 * allowed, 1.0) ** len(x) < _CHANCE
            return 10.0**-digits if enough else 0.0
    return 0.0
