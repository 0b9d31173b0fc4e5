"""Offset between two clocks from two recordings of one signal, and its sigma.

In y = b x(lag) + misfit the misfit is not white noise: slopes of the road last for seconds, the overshoot of smoothed
fixes as long as their filter. So means over ten seconds are subtracted from everything, and the remaining rows count by
their effective number (by autocorrelation). The sigma follows from the likelihood of every lag within reach, not only
from the curvature at the best one: where speed hardly changes, several lags explain it nearly as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array

Index = NDArray[Any]  # of row numbers
Lags = Array | float  # s, (L,) or one
Regressors = Callable[[Index, Lags], Array]  # (rows, lags) -> (L, K, m), of one lag (K, m)
LAG_REACH = 5.0  # s on either side of the first guess: the largest sigma that can result
_SLOW_CHANGES = 10.0  # s; slower changes are those of the road (as in `graphnav.recording.draft.motion.filter_band`)
# s, of the grids of lags; changes over a second are alike for a second
_COARSE, _FINE, _FINEST = 0.2, 0.02, 0.005
_NUMBERS_AT_ONCE = 1 << 16  # rows times lags, to bound the memory in use
# number of parts, and the variance of Student's t with the degrees of freedom of their scatter
_PARTS, _STUDENT = 4, 3.0
_OUTLYING = 5.0  # robust sigmas beyond which a row is an error of the fix


@dataclass(frozen=True)
class _At:
    """The regression at one lag: rows, regressors and observations minus their slow part, coefficients, misfit."""

    rows: Index
    x: Array
    y: Array
    b: Array
    e: Array

    @property
    def unexplained(self) -> float:
        """Logarithm of the unexplained share of the variance."""
        return float(np.log(max(self.e @ self.e / max(self.y @ self.y, 1e-300), 1e-12)))


def refine_lag(
    t: Array, y: Array, x_at: Regressors, valid: Callable[[float], Array], rows: Index, guess: float, fewest: int
) -> tuple[float, float]:
    """The lag at which x explains y best, near a first guess, and its 1-sigma; both in s.

    Parameters
    ----------
    t : (N,) s, ascending, of the rows of y.
    y : (N,) what is observed.
    x_at : regressors of some rows at a lag, or at several.
    valid : mask (N,) of the rows that have regressors at a lag.
    rows : those of y that are used.
    fewest : rows that make a regression.
    """

    def interpolate_each(lags: Array, some: Index) -> list[_At | None]:
        every: list[_At | None] = []
        for kept, x in sample_shared(lags, some, x_at, valid):
            L, K, m = x.shape
            if len(kept) < fewest:
                every += [None] * L
                continue
            both = remove_slow(t[kept], np.column_stack([x.transpose(1, 0, 2).reshape(K, L * m), y[kept]]))
            x, left = both[:, :-1].reshape(K, L, m).transpose(1, 0, 2), both[:, -1]
            b = regress_each(x, left)
            e = left - (x @ b[..., None])[..., 0]
            every += [_At(kept, x[k], left, b[k], e[k]) for k in range(L)]
        return every

    def interpolate_at(lag: float, some: Index) -> _At | None:
        return interpolate_each(np.array([lag]), some)[0]

    for _ in range(2):  # spikes of fixes hide a good fit
        found = interpolate_at(guess, rows)
        if found is None:
            return guess, LAG_REACH
        off = np.abs(found.e - np.median(found.e))
        rows = found.rows[off <= _OUTLYING * np.median(off) / 0.6745]

    def compute_profile(lags: Array) -> Array:
        return np.array([np.nan if one is None else one.unexplained for one in interpolate_each(lags, rows)])

    wide = guess + np.arange(-LAG_REACH, LAG_REACH + _COARSE / 2, _COARSE)
    seen = compute_profile(wide)
    if not np.isfinite(seen).any():
        return guess, LAG_REACH
    near = wide[int(np.nanargmin(seen))] + np.arange(-_COARSE, _COARSE + _FINE / 2, _FINE)
    close = compute_profile(near)
    lag = find_lowest(near, close)
    best = interpolate_at(lag, rows)
    scores = None if best is None else _score_lags(t, x_at, valid, best, lag)
    if best is None or scores is None:
        return lag, LAG_REACH
    variance, information = scores
    spread = np.sqrt(variance) / information  # by the curvature
    worth = len(best.e) * min(1.0, float(np.mean(best.e**2)) * information / variance)  # independent rows
    peak = lag + np.arange(-10, 11) * _FINEST
    lags, depth = np.concatenate([wide, near, peak]), np.concatenate([seen, close, compute_profile(peak)])
    lags, order = np.unique(lags, return_index=True)
    depth = depth[order]
    lags, depth = lags[np.isfinite(depth)], depth[np.isfinite(depth)]
    # for a regression with unknown variance: the two coefficients, mean and lag reduce the degrees of freedom
    likelihood = np.exp(-0.5 * max(worth - 4.0, 1.0) * (depth - depth.min())) * np.gradient(lags)
    by_likelihood = np.sqrt(np.sum(likelihood * (lags - lag) ** 2) / likelihood.sum())
    return lag, float(max(spread, by_likelihood))


def sample_shared(
    lags: Array, rows: Index, x_at: Regressors, valid: Callable[[float], Array]
) -> Iterator[tuple[Index, Array]]:
    """Group successive lags (L,) at which the same rows are valid: these rows (K,), and their regressors (l, K, m).

    A row more or less at the ends makes a group, so regressors of many groups are sampled at once.
    """
    inside = np.array([valid(float(lag))[rows] for lag in lags])
    most = max(1, _NUMBERS_AT_ONCE // max(1, len(rows)))
    for first in range(0, len(lags), most):
        some = inside[first : first + most]
        kept = np.flatnonzero(some.any(axis=0))
        x = x_at(rows[kept], lags[first : first + most]) if len(kept) else np.empty((len(some), 0, 1))
        begins = [0, *(1 + np.flatnonzero((some[1:] != some[:-1]).any(axis=1))).tolist(), len(some)]
        for k, end in itertools.pairwise(begins):
            own = np.flatnonzero(some[k][kept])
            yield rows[kept[own]], x[k:end] if len(own) == len(kept) else x[k:end].take(own, axis=1)


def regress_each(x: Array, y: Array) -> Array:
    """Least-squares coefficients (L, m) of y (K,) on each of several sets of regressors (L, K, m)."""
    if x.shape[2] == 1:
        power = np.einsum("lki,lki->li", x, x)
        return np.asarray(np.einsum("lki,k->li", x, y) / np.where(power > 0.0, power, 1.0))
    normal = np.linalg.pinv(x.transpose(0, 2, 1) @ x, rcond=np.finfo(float).eps * x.shape[1], hermitian=True)
    return np.asarray((normal @ (y @ x)[..., None])[..., 0])


def remove_slow(t: Array, x: Array) -> Array:
    """Columns (N, m) at times t (N,) minus their means over the ten seconds around each, with zero mean."""
    lo, hi = np.searchsorted(t, t - _SLOW_CHANGES / 2), np.searchsorted(t, t + _SLOW_CHANGES / 2, side="right")
    x = x - x.mean(0)
    total = np.zeros((len(x) + 1, x.shape[1]))
    np.cumsum(x, axis=0, out=total[1:])
    slow = total[hi]
    slow -= total[lo]
    slow /= (hi - lo)[:, None]
    x -= slow
    x -= x.mean(0)
    return x


def _score_lags(
    t: Array, x_at: Regressors, valid: Callable[[float], Array], best: _At, lag: float
) -> tuple[float, float] | None:
    """Variance of the sum of scores at the best lag, and the information there.

    A row's score is its misfit times its derivative by the lag. Scores are correlated: the variance of their sum is
    computed with their autocorrelation until it first vanishes, or from the scatter of four equally informed parts if
    that is larger, as it is where a clock wanders.
    """
    inside = valid(lag - _FINE)[best.rows] & valid(lag + _FINE)[best.rows]
    rows, x = best.rows[inside], best.x[inside]
    if len(rows) <= x.shape[1] + 2:
        return None
    change = (x_at(rows, lag + _FINE) - x_at(rows, lag - _FINE)) @ best.b / (2.0 * _FINE)
    slope = remove_slow(t[rows], change[:, None])[:, 0]
    slope = slope - x @ np.linalg.lstsq(x, slope, rcond=None)[0]
    score, information = best.e[inside] * slope, float(slope @ slope)
    if information <= 0.0:
        return None
    n = len(score)
    power = np.fft.irfft(np.abs(np.fft.rfft(score, 2 * n)) ** 2)[:n]
    over = np.flatnonzero(power <= 0.0)
    lasting = power[0] + 2.0 * float(power[1 : over[0] if len(over) else n].sum())
    part = np.minimum(_PARTS * np.cumsum(slope**2) / information, _PARTS - 1e-9).astype(int)
    sums = np.bincount(part, score, minlength=_PARTS)
    scatter = _STUDENT * _PARTS * float(np.var(sums, ddof=1))
    return max(lasting, scatter, 1e-300), information


def find_lowest(lags: Array, values: Array) -> float:
    """Position of the minimum of evenly spaced values, by the parabola through it and its neighbours."""
    k = int(np.nanargmin(values))
    if 0 < k < len(lags) - 1 and np.isfinite(values[k - 1 : k + 2]).all():
        bend = values[k - 1] - 2.0 * values[k] + values[k + 1]
        if bend > 0.0:
            return float(lags[k] + 0.5 * (values[k - 1] - values[k + 1]) / bend * (lags[1] - lags[0]))
    return float(lags[k])
