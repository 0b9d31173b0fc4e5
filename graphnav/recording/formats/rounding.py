"""Rounding errors of the positions in a log.

A value rounded to a step is off by an error that is uniform over the step, of a standard deviation of step / sqrt(12)
(Widrow, Kollar and Liu 1996, "Statistical theory of quantization"). No variance factor scales it.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.earth import A
from graphnav.core.rotation import Array

_MEANT_DIGITS = 10  # decimals of degrees in double precision
_DEGREE_PARTS = 1.0, 60.0  # units of logs, as a share of a degree: degrees, and minutes as in NMEA
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
    lat, lon = (
        A * max(np.radians(find_step(np.degrees(column) * parts) / parts) for parts in _DEGREE_PARTS)
        for column in llh[:, :2].T
    )
    return tuple(float(step) / np.sqrt(12.0) for step in (lon * np.cos(llh[0, 0]), lat, find_step(llh[:, 2])))


def find_step(x: Array) -> float:
    """The power of ten of which values (N,) are whole multiples; 0 without one, or with too few distinct values."""
    x = np.unique(x)
    for digits in range(_MEANT_DIGITS + 1):
        steps = x * 10.0**digits
        off = np.abs(steps - np.round(steps))
        if np.all(off <= 1e-9 + 1e-15 * np.abs(steps)):
            return 10.0**-digits if len(np.unique(np.round(steps))) >= _FEWEST else 0.0
    return 0.0
