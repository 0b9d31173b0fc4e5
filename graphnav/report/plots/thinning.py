"""Selection of the rows of long series to draw."""

from __future__ import annotations

from typing import Any

import numpy as np

from graphnav.core.rotation import Array

BINS = 600  # columns that a line is thinned to: half a wide panel's pixels, so that zooming shows more
_ROWS_AT_ONCE = 1_000_000  # compared with their column's limits: 8 MB beside a day's 140


def thin(t: Array, y: Array, bins: int = BINS) -> np.ndarray:
    """Indices (sorted) of the rows to draw: per pixel column the first, last, lowest and highest.

    A line through them covers the same pixels as the line through all rows (Jugel et al., "M4: A
    Visualization-Oriented Time Series Data Aggregation", VLDB 2014). Rows where y is not finite break
    a line, so the first of each such run stays too.

    Parameters
    ----------
    t : (N,) not decreasing.
    y : (N,)
    """
    n = len(t)
    if n <= 4 * bins:
        return np.arange(n)
    finite = np.isfinite(y)
    span = float(t[-1] - t[0])
    starts = np.unique(np.searchsorted(t, t[0] + span / bins * np.arange(bins))) if span > 0 else np.zeros(1, dtype=int)
    lengths = np.diff(starts, append=n)
    # the first row that is as low, or as high, as its column gets; none where a column has no number
    extremes = []
    for limits in (np.fmin.reduceat(y, starts), np.fmax.reduceat(y, starts)):
        for some in np.array_split(np.arange(len(starts)), min(-(-n // _ROWS_AT_ONCE), len(starts))):
            own = slice(starts[some[0]], starts[some[-1]] + lengths[some[-1]])
            rows = own.start + np.flatnonzero(y[own] == np.repeat(limits[some], lengths[some]))
            extremes.append(rows[np.diff(np.searchsorted(starts, rows, side="right"), prepend=0) > 0])
    breaks = np.flatnonzero(~finite & np.concatenate([[True], finite[:-1]]))
    kept = np.zeros(n, dtype=bool)
    for rows in (starts, starts + lengths - 1, *extremes, breaks):
        kept[rows] = True
    return np.flatnonzero(kept)


def insert_breaks(t: Array, rows: np.ndarray, *columns: Array) -> Any:
    """t and columns at the kept rows, with a NaN row in every long gap of t, which a line must not cross.

    Long is more than 20 median steps and more than one hundredth of the whole.
    """
    steps = np.diff(t)
    long = np.flatnonzero(steps > max(20.0 * np.median(steps), (t[-1] - t[0]) / 100.0)) if len(t) > 2 else steps[:0]
    if not len(long):
        return tuple(c[rows] for c in (t, *columns))
    rows = np.union1d(rows, np.concatenate([long, long + 1]).astype(int))
    at = np.searchsorted(rows, long) + 1
    return (np.insert(t[rows], at, t[long.astype(int)]), *(np.insert(c[rows], at, np.nan) for c in columns))


def choose_rows(x: Array, y: Array, bins: int = BINS) -> np.ndarray:
    """Indices (sorted) of the rows to draw of a track (x, y) with `bins` columns: extremes of both are kept."""
    k = np.arange(len(x), dtype=float)
    return np.union1d(thin(k, x, bins), thin(k, y, bins))
