"""Rows that an IMU's log lost, by the parts of the same log that look alike.

A signal's past tells what lies between two moments of it: a step is like those before and after, a road's vibration
goes on. So a gap of n rows is filled with the mean of what lay in the `_ALIKE` other places of the log at which the
rows before and after n rows are most like its own (nearest neighbours, each in a stretch of its own; Lorenz 1969,
"Atmospheric predictability as revealed by naturally occurring analogues"). The variance of the error is

    a (V + b d V')

with the scatter V of these places and their mean squared distance d from the gap, by the rows beside it: a turn among
straight steps has none that are like it. a, b and V' are those of the largest likelihood of the errors of `_TRIALS`
gaps that are none, filled in the same way: b of a few values, V' the mean of their errors' squares over d.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array
from graphnav.core.running import sum_running

_BESIDE = 4  # rows before and after a gap that are compared
_ALIKE = 10  # places: their mean is as wrong as the scatter about it to a twentieth
_TRIALS = 200  # determine a variance to a tenth
_PLACES, _LEAST = 100_000, 2_000  # looked at for all lengths of gaps, and for one; of longer logs every second, ...
_AT_ONCE = 16  # gaps
_SHARES = np.r_[0.0, np.logspace(-4.0, 1.0, 11)]  # values of b
_SAME = 1e-12  # variances of the log: numbers as alike are the same

Index = NDArray[np.intp]


def fill_gaps(x: Array, gap: Index, lost: Index, every: Index) -> tuple[list[Array], Array]:
    """Rows lost in gaps, and the variance of the errors of their means.

    Parameters
    ----------
    x : (N, k) rows.
    gap : (g,) the row before each gap.
    lost : (g,) how many rows are missing after it, 1 or more.
    every : (G,) the row before any gap, filled or not.

    Returns
    -------
    list of array, array
        (lost, k) for each gap, and (g, k); where the log is too short, the mean of the neighbours, with the variance of
        a bridge by it.
    """
    size = np.std(x, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    x = x / size
    rows: list[Array] = [np.empty(0)] * len(gap)
    variance = np.empty((len(gap), x.shape[1]))
    lengths = np.unique(lost)
    most = max(_LEAST, _PLACES // len(lengths))
    for n in lengths:
        here = np.flatnonzero(lost == n)
        found, variance[here] = _fill_alike(x, gap[here], int(n), every, most)
        for k, filled in zip(here.tolist(), found, strict=True):
            rows[k] = filled * size
    return rows, variance * size**2


def _fill_alike(x: Array, gap: Index, n: int, every: Index, most: int) -> tuple[Array, Array]:
    """Rows (g, n, k) and variances (g, k) of gaps of n rows; at `most` so many places are looked at."""
    ends = 0.5 * (x[gap] + x[gap + 1])
    places = np.arange(_BESIDE - 1, len(x) - n - _BESIDE)
    before = np.zeros(len(x) + 1, dtype=int)
    np.add.at(before, every + 1, 1)
    crossed = np.cumsum(before)  # gaps before each row
    places = places[crossed[places + n + _BESIDE] == crossed[places - _BESIDE + 1]]
    step = max(1, -(-len(places) // most))
    length = max(1, (n + _BESIDE) // step)  # of a stretch, in places
    count = len(places[::step]) // length
    places = places[::step][: count * length]
    sums = sum_running(x)
    mean = (sums[places + n + 1] - sums[places + 1]) / n - 0.5 * (x[places] + x[places + n + 1])  # about their ends
    if count < 2 * _ALIKE:
        change = 0.5 * (x[gap + 1] - x[gap]) ** 2
        usual = (mean**2).mean(axis=0) if count else 0.0
        return np.repeat(ends[:, None], n, axis=1), np.maximum(usual, change)
    at = np.arange(1 - _BESIDE, 1)
    sides = np.concatenate([at, n + 1 - at[::-1]])
    known = x[places[:, None] + sides].reshape(len(places), -1)
    stretches = places.reshape(count, length)
    trials = np.linspace(0, len(places) - 1, min(_TRIALS, len(places))).astype(int)
    near = _find_alike(known, stretches, known[trials], places[trials], n)
    error, apart = mean[trials] - mean[near].mean(axis=1), _measure_distance(known[trials], known[near])
    common = (error**2 / apart).mean(axis=0)
    a, b = _rate_scatter(error, _measure_scatter(mean[near]), apart * common)
    own = x[np.clip(gap[:, None] + np.where(sides > 0, sides - n, sides), 0, len(x) - 1)].reshape(len(gap), -1)
    near = _find_alike(known, stretches, own, gap, n)
    common = _measure_distance(own, known[near]) * common
    between = x[places[near][..., None] + np.arange(1, n + 1)]
    about = 0.5 * (x[places[near]] + x[places[near] + n + 1])
    filled = ends[:, None] + (between - about[:, :, None]).mean(axis=1)
    return filled, a * (_measure_scatter(mean[near]) + b * common)


def _measure_scatter(x: Array) -> Array:
    """Variance (g, k) of an error of the mean of places (g, K, k), as one more of them would have."""
    return np.asarray(x.var(axis=1, ddof=1) * (1.0 + 1.0 / x.shape[1]))


def _measure_distance(own: Array, near: Array) -> Array:
    """Mean square (g, 1) of how the rows beside g gaps (g, m) differ from those beside places (g, K, m)."""
    return np.asarray(((near - own[:, None]) ** 2).mean(axis=(1, 2))[:, None] + _SAME)


def _find_alike(known: Array, places: Index, own: Array, at: Index, n: int) -> Index:
    """Which places (g, K) are most like each of g gaps, every one of another stretch.

    Parameters
    ----------
    known : (P, m) rows beside the places.
    places : (S, L) the rows before these, in S stretches.
    own : (g, m) rows beside the gaps.
    at : (g,) the rows before them.
    n : rows in a gap.
    """
    out = np.empty((len(at), _ALIKE), dtype=np.intp)
    squares = (known**2).sum(axis=1)
    for k in range(0, len(at), _AT_ONCE):
        some = slice(k, k + _AT_ONCE)
        distance = (squares - 2.0 * own[some] @ known.T).reshape(-1, *places.shape)
        distance[np.abs(places - at[some, None, None]) < n + 2 * _BESIDE] = np.inf
        best = distance.argmin(axis=2)
        least = np.take_along_axis(distance, best[..., None], axis=2)[..., 0]
        nearest = np.argpartition(least, _ALIKE - 1, axis=1)[:, :_ALIKE]
        out[some] = nearest * places.shape[1] + np.take_along_axis(best, nearest, axis=1)
    return out


def _rate_scatter(error: Array, scatter: Array, common: Array) -> tuple[float, float]:
    """a, b of the most likely variance a (scatter + b common) of errors (J, k); for each b, a has a closed form."""
    live = np.flatnonzero((common > 0.0).all(axis=0))
    if not len(live):
        return 1.0, 1.0
    error, scatter, common = error[:, live], scatter[:, live], common[:, live]
    best = (np.inf, 1.0, 1.0)
    for b in _SHARES:
        variance = np.maximum(scatter, 1e-9 * common) + b * common
        a = float((error**2 / variance).mean())
        best = min(best, (float(np.log(a * variance).mean()), a, float(b)))
    return best[1:]
