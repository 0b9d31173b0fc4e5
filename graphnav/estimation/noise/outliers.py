"""Which rows are outliers, by their squared errors, and what weight they have."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import betaln, chdtri

from graphnav.core.rotation import Array
from graphnav.estimation.noise.model import INTERVALS, RowWeights
from graphnav.estimation.problem import Problem

CHANCE = 1e-3  # probability of a larger squared error, below which a row is an outlier
OUTLIER_COST = -float(np.log(CHANCE))  # negative prior log-probability of one outlier


def limit_squares(squared: Array, m: int) -> Array:
    """(N,) weights that bring squared errors (N,) of m degrees of freedom down to the limit of `CHANCE`."""
    return np.asarray(np.minimum(1.0, float(chdtri(m, CHANCE)) / np.maximum(squared, 1e-30)))


def limit_scaled(squared: Array, m: int, used: Array) -> Array:
    """The same weights, with the squared errors scaled to the expected median where the median is larger than that.

    If half of the rows in use (N,) are off, the variance has not converged yet.
    """
    some = squared[used]
    scale = float(np.median(some)) / float(chdtri(m, 0.5)) if len(some) else 1.0
    return limit_squares(squared / max(scale, 1.0), m)


def list_reduced(t: Array, weight: Array, used: Array) -> RowWeights:
    """Those of the weights (N,) of used rows at times t (N,), s, that are less than 1."""
    less = (weight < 1.0) & used
    less |= np.isin(t, t[less])  # with all rows of their times, so that each is known by its number among them
    return RowWeights(t[less], weight[less])


def count_reduced(some: RowWeights) -> int:
    """How many rows have a weight below 1; they are listed with all rows of their times."""
    return int(np.sum(some.weight < 1.0))


def count_rows(problem: Problem) -> dict[str, int]:
    """How many rows may be outliers, by constraint and by `INTERVALS`."""
    return {c.name: len(c) for c in problem.constraints} | dict.fromkeys(INTERVALS, len(problem.t) - 1)


def compute_outlier_cost(weights: Mapping[str, RowWeights], totals: Mapping[str, int]) -> float:
    """Negative prior log-probability of as many outliers as there are reduced weights, less that of none.

    How often a sensor has outliers is unknown. With a Beta prior of 1 and 1 / `CHANCE`, its mean `CHANCE`, k given ones
    of n rows are outliers with a probability of B(k + 1, n - k + 1 / `CHANCE`) / B(1, 1 / `CHANCE`).
    """
    some = [(count_reduced(one), totals[name]) for name, one in weights.items() if name in totals]
    return sum((float(_compute_cost(np.array(k), n)) for k, n in some), 0.0)


def _compute_cost(k: Array, total: int) -> Array:
    """The same of k outliers among all rows of one sensor."""
    n = total + 1.0 / CHANCE
    return np.asarray(betaln(1.0, n) - betaln(k + 1.0, n - k))


def may_pay(squared: Array, freedom: Array) -> bool:
    """Whether any number of outliers may gain more log-likelihood than it costs.

    Parameters
    ----------
    squared : (N,) errors, as stated chi-square variables of m = `freedom` (N,); with the variance that fits it best,
        each that exceeds m gains (squared - m - m ln(squared / m)) / 2.
    """
    ratio = np.maximum(squared / freedom, 1.0)
    gain = np.sort(0.5 * freedom * (ratio - 1.0 - np.log(ratio)))[::-1]
    return bool((np.cumsum(gain) > _compute_cost(np.arange(1, len(gain) + 1), len(gain))).any())


def compute_latest_cost(some: RowWeights, total: int) -> float:
    """The cost of the latest of some outliers among all rows of a sensor."""
    k = max(count_reduced(some), 1)
    return float(np.log((total - k + 1.0 / CHANCE) / k))
