"""How noisy fixes really are: a factor on their stated variance, from the innovations.

Sage and Husa (1969, "Adaptive filtering with unknown prior statistics") take the measurement noise from what a window
of innovations has more than the state's uncertainty explains, R = mean(nu nu^T) - H P H^T. As it stands that loses
positivity, follows every outlier, and takes a fault that pushes all fixes one way for noise. Here

- one number f multiplies the stated R of a kind of fix, f >= 1, with the median in place of the mean;
- fixes count as loud only where they also differ from both fixes before them, which those with a common error do not;
- f = 1 exactly unless most of a window is loud, which without noise happens once in ten million windows.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d
from scipy.special import bdtrc, chdtri, gammaincinv

from graphnav.constraints.base import Constraint
from graphnav.rotation import Array

WINDOW = 32  # fixes, most of which are loud where there is noise
_NEAR = 17  # fixes whose median is the factor
_FALSE_ALARM = 1e-7  # per window
_UNUSUAL = 1e-3  # chance of an excess that is not the usual
_APART = 4.0  # ratio of medians of nine that is no chance: three of its standard deviations
_ROWS = ("r", "sigma", "predicted", "loud", "factor")


def _loud_above(m: int) -> float:
    """Squared norm of m components above which a fix is loud: so that half a window is by chance is a false alarm.

    Neighbours are compared, so a window is worth half as many independent fixes.
    """
    n = WINDOW // 2
    lo, hi = 0.0, 0.5
    for _ in range(60):
        p = 0.5 * (lo + hi)
        lo, hi = (p, hi) if bdtrc(n // 2 - 1, n, p) < _FALSE_ALARM else (lo, p)
    return float(chdtri(m, lo))


def _median(m: int) -> float:
    """Median of chi-square."""
    return 2.0 * float(gammaincinv(0.5 * m, 0.5))


def _loud(r: Array, variance: Array, limit: float) -> Array:
    """(N,) whether each of N residuals (N, m) is large, and far from both before it; the first two never are."""
    out = np.zeros(len(r), dtype=bool)
    if len(r) > 2:
        now, v = r[2:], variance[2:]
        least = np.sum(now**2 / v, axis=1)
        for lag in (1, 2):
            other = slice(2 - lag, -lag)
            least = np.minimum(least, np.sum((now - r[other]) ** 2 / (v + variance[other]), axis=1))
        out[2:] = least > limit
    return out


def _excess(r: Array, sigma: Array, predicted: Array) -> Array:
    """(N,) of each fix: what its residual (N, m) has more than the state's variance explains, in stated variances."""
    m = r.shape[1]
    return np.asarray(np.sum((r / sigma) ** 2, axis=1) / _median(m) - np.mean(predicted / sigma**2, axis=1))


def _usual(excess: Array, m: int) -> Array:
    """(N,) what is usual around each fix: by those on both sides, or where these clearly differ by its own side.

    That is the calmer side, unless its own excess is more than that side explains.
    """
    side, off = _NEAR // 2 + 1, _NEAR // 4
    both = median_filter(excess, _NEAR, mode="nearest")
    before, after = (np.maximum(1.0, median_filter(excess, side, mode="nearest", origin=at)) for at in (off, -off))
    calm, loud = np.minimum(before, after), np.maximum(before, after)
    own = np.where(excess <= calm * float(chdtri(m, _UNUSUAL)) / _median(m), calm, loud)
    return np.where(loud > _APART * calm, own, both)


def factors(r: Array, sigma: Array, predicted: Array, always: bool = False) -> Array:
    """(N,) factors on the variances of fixes, seen from both sides.

    Parameters
    ----------
    r, sigma, predicted : (N, m) residuals, stated sigmas, and variances of the state's part in the residuals.
    always : wherever the residuals ask for it, not only where that is certain.
    """
    if len(r) < WINDOW:
        return np.ones(len(r))
    f = np.maximum(1.0, _usual(_excess(r, sigma, predicted), r.shape[1]))
    if always:
        return f
    loud = _loud(r, sigma**2 + predicted, _loud_above(r.shape[1])).astype(float)
    full = uniform_filter1d(loud, WINDOW, mode="constant") > 0.5 + 1e-9
    return np.where(maximum_filter1d(full, WINDOW, origin=-1), f, 1.0)


class Kind:
    """The fixes of one kind as they are met, row by row; a row that comes again makes those behind it void.

    Parameters
    ----------
    rows : of that kind.
    count : how many there will be, if known.
    """

    def __init__(self, rows: Constraint, count: int = 0) -> None:
        N, m = count or 2 * WINDOW, len(rows.axes)
        self.always = rows.adaptive == "on"
        self.limit = _loud_above(m)
        self.r, self.sigma, self.predicted = np.zeros((N, m)), np.ones((N, m)), np.zeros((N, m))
        self.loud = np.zeros(N, dtype=bool)
        self.factor = np.ones(N)

    def forget(self, count: int) -> None:
        """The first `count` rows: those behind them move there."""
        for name in _ROWS:
            setattr(self, name, getattr(self, name)[count:].copy())

    def add(self, row: int, r: Array, predicted: Array, sigma: Array) -> float:
        """The factor on a fix's variance; looks at no later one. As for `Noise.raised`."""
        if row >= len(self.r):
            for name in _ROWS:
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.ones((row + WINDOW, *old.shape[1:]), dtype=old.dtype)]))
        self.r[row], self.predicted[row], self.sigma[row] = r, predicted, sigma
        variance = sigma * sigma + predicted
        first = max(row - 2, 0)
        self.loud[row] = float(r @ (r / variance)) > self.limit and bool(
            _loud(self.r[first : row + 1], self.sigma[first : row + 1] ** 2 + self.predicted[first : row + 1],
                  self.limit)[-1]
        )  # fmt: skip
        f = 1.0
        if self.always or np.count_nonzero(self.loud[max(row + 1 - WINDOW, 0) : row + 1]) > WINDOW // 2:
            near = slice(max(row + 1 - _NEAR, 0), row + 1)
            if row + 1 >= _NEAR:
                f = max(1.0, float(np.median(_excess(self.r[near], self.sigma[near], self.predicted[near]))))
        self.factor[row] = f
        return f


class Noise:
    """The factors of all kinds of fixes that a filter adapts to."""

    def __init__(self, constraints: Iterable[Constraint]) -> None:
        self._kinds = {rows.name: Kind(rows, len(rows)) for rows in constraints}

    def raised(self, name: str, row: int, r: Array, predicted: Array, sigma: Array) -> Array:
        """The sigmas (m,) to use for an innovation; looks at no later one.

        Parameters
        ----------
        r, sigma : (m,) innovation and stated sigmas.
        predicted : (m,) variance of the state's part in it.
        """
        kind = self._kinds.get(name)
        if kind is None or len(r) != kind.r.shape[1]:
            return sigma
        f = kind.add(row, r, predicted, sigma)
        return sigma if f == 1.0 else sigma * float(np.sqrt(f))

    def weight(self, name: str) -> Array | float:
        """(N,) weights that do the same."""
        kind = self._kinds.get(name)
        return 1.0 if kind is None else 1.0 / kind.factor
