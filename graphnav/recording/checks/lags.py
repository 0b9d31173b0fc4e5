"""How far two clocks are apart by two signals that are one, and how well that is known.

Of y = b x(lag) + misfit the misfit is no white noise: slopes of the road last for seconds, an overtaking of smoothed
fixes as long as the filter that smooths them. So everything is taken less its mean over ten seconds, and what is left
counts as many rows as its own correlation leaves independent. The sigma is of the likelihood of every lag within reach,
not of the curvature at the best one alone: where speed hardly changes, several lags explain it nearly as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array

Index = NDArray[Any]  # of row numbers
Regressors = Callable[[Index, float], Array]  # (rows, lag) -> (K, m)
REACH = 5.0  # s on either side of the first guess, which is all that a sigma can come to
_SLOW = 10.0  # s; what changes slower than this is the road (as in `graphnav.recording.draft.motion.band`)
_STEP, _FINE, _FINEST = 0.1, 0.02, 0.005  # s, of the grids of lags
_PARTS, _STUDENT = 4, 3.0  # parts, and the variance of Student's t with the degrees of freedom of their scatter
_FAR = 5.0  # robust sigmas beyond which a row is an error of the fix


@dataclass(frozen=True)
class _At:
    """The regression at one lag: rows, regressors and observations less their slow part, coefficients, misfit."""

    rows: Index
    x: Array
    y: Array
    b: Array
    e: Array

    @property
    def unexplained(self) -> float:
        """Logarithm of the share of the variance that is left."""
        return float(np.log(max(self.e @ self.e / max(self.y @ self.y, 1e-300), 1e-12)))


def refine_lag(
    t: Array, y: Array, x_at: Regressors, valid: Callable[[float], Array], rows: Index, guess: float, fewest: int
) -> tuple[float, float]:
    """The lag at which x explains y best, near a first guess, and its 1-sigma; both in s.

    Parameters
    ----------
    t : (N,) s, ascending, of the rows of y.
    y : (N,) what is observed.
    x_at : regressors of some rows at a lag.
    valid : mask (N,) of the rows that have regressors at a lag.
    rows : those of y that are used.
    fewest : rows that make a regression.
    """

    def at(lag: float, some: Index) -> _At | None:
        kept = some[valid(lag)[some]]
        if len(kept) < fewest:
            return None
        both = quick(t[kept], np.column_stack([x_at(kept, lag), y[kept]]))
        x, of = both[:, :-1], both[:, -1]
        b = np.linalg.lstsq(x, of, rcond=None)[0]
        return _At(kept, x, of, b, of - x @ b)

    for _ in range(2):  # spikes of a fix hide a good fit
        found = at(guess, rows)
        if found is None:
            return guess, REACH
        off = np.abs(found.e - np.median(found.e))
        rows = found.rows[off <= _FAR * np.median(off) / 0.6745]

    def profile(lags: Array) -> Array:
        every = (at(float(lag), rows) for lag in lags)
        return np.array([np.nan if one is None else one.unexplained for one in every])

    wide = guess + np.arange(-REACH, REACH + _STEP / 2, _STEP)
    seen = profile(wide)
    if not np.isfinite(seen).any():
        return guess, REACH
    near = wide[int(np.nanargmin(seen))] + np.arange(-_STEP, _STEP + _FINE / 2, _FINE)
    close = profile(near)
    lag = _lowest(near, close)
    best = at(lag, rows)
    scores = None if best is None else _scores(t, x_at, valid, best, lag)
    if best is None or scores is None:
        return lag, REACH
    variance, information = scores
    spread = np.sqrt(variance) / information  # by the curvature
    worth = len(best.e) * min(1.0, float(np.mean(best.e**2)) * information / variance)  # independent rows
    peak = lag + np.arange(-10, 11) * _FINEST
    lags, depth = np.concatenate([wide, near, peak]), np.concatenate([seen, close, profile(peak)])
    lags, order = np.unique(lags, return_index=True)
    depth = depth[order]
    lags, depth = lags[np.isfinite(depth)], depth[np.isfinite(depth)]
    # of a regression with an unknown variance, the two coefficients, mean and lag taken off the degrees of freedom
    likelihood = np.exp(-0.5 * max(worth - 4.0, 1.0) * (depth - depth.min())) * np.gradient(lags)
    by_likelihood = np.sqrt(np.sum(likelihood * (lags - lag) ** 2) / likelihood.sum())
    return lag, float(max(spread, by_likelihood))


def quick(t: Array, x: Array) -> Array:
    """Columns (N, m) at times t (N,) less their means over the ten seconds around each, and without a mean."""
    lo, hi = np.searchsorted(t, t - _SLOW / 2), np.searchsorted(t, t + _SLOW / 2, side="right")
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x - x.mean(0), axis=0)])
    out = x - x.mean(0) - (total[hi] - total[lo]) / (hi - lo)[:, None]
    return np.asarray(out - out.mean(0))


def _scores(
    t: Array, x_at: Regressors, valid: Callable[[float], Array], best: _At, lag: float
) -> tuple[float, float] | None:
    """Variance of the sum of scores at the best lag, and the information there.

    A row's score is its misfit times what a second of lag would change. Scores are correlated: the variance of their
    sum is by their autocorrelation until it first vanishes, or by the scatter of four equally informed parts if that
    says more, as it does where a clock wanders.
    """
    inside = valid(lag - _FINE)[best.rows] & valid(lag + _FINE)[best.rows]
    rows, x = best.rows[inside], best.x[inside]
    if len(rows) <= x.shape[1] + 2:
        return None
    change = (x_at(rows, lag + _FINE) - x_at(rows, lag - _FINE)) @ best.b / (2.0 * _FINE)
    slope = quick(t[rows], change[:, None])[:, 0]
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


def _lowest(lags: Array, values: Array) -> float:
    """Where evenly spaced values are lowest, by the parabola through the lowest and its neighbours."""
    k = int(np.nanargmin(values))
    if 0 < k < len(lags) - 1 and np.isfinite(values[k - 1 : k + 2]).all():
        bend = values[k - 1] - 2.0 * values[k] + values[k + 1]
        if bend > 0.0:
            return float(lags[k] + 0.5 * (values[k - 1] - values[k + 1]) / bend * (lags[1] - lags[0]))
    return float(lags[k])
