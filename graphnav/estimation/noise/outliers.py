"""What rows and intervals of reduced weight cost, of the logarithm of the evidence."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from scipy.special import betaln

from graphnav.core.rotation import Array
from graphnav.estimation.noise.model import INTERVALS, RowWeights
from graphnav.estimation.noise.tails import CHANCE, compute_log_normaliser, get_tail_index
from graphnav.estimation.problem import Problem

OUTLIER_COST = -float(np.log(CHANCE))  # negative prior log-probability of one outlier


def list_reduced(t: Array, weight: Array, used: Array) -> RowWeights:
    """Those of the weights (N,) of used rows at times t (N,), s, that are less than 1."""
    less = (weight < 1.0) & used
    less |= np.isin(t, t[less])  # with all rows of their times, so that each is known by its number among them
    return RowWeights(t[less], weight[less])


def count_reduced(some: RowWeights) -> int:
    """How many have a weight below 1."""
    return int(np.sum(some.weight < 1.0))


def compute_row_costs(problem: Problem, tails: Mapping[str, float], without: Collection[str] = ()) -> Array:
    """(K,) by keyframe, what the log-likelihood of rows that are Gaussian with their weights is above that of their
    density with `tails`.

    Parameters
    ----------
    problem : with a noise model.
    without : names of constraints that are Gaussian.
    """
    cost = np.zeros(len(problem.t))
    for rows in problem.constraints:
        if rows.list_noise_groups()[0] and rows.name not in without:
            m = len(rows.axes)
            index = get_tail_index(tails, rows.name, m)
            weight = np.ones(len(rows)) if rows.weight is None else rows.weight
            used = weight > 0.0
            each = compute_log_normaliser(index, m) - 0.5 * index * np.log(weight[used])
            np.add.at(cost, rows.keyframe[used], each)
    return cost


def compute_interval_cost(weights: Mapping[str, RowWeights], total: int) -> float:
    """Negative prior log-probability of as many disturbed intervals as there are, less that of none.

    How often intervals are disturbed is unknown. With a Beta prior of 1 and 1 / `CHANCE`, its mean `CHANCE`, k given
    ones of n have a probability of B(k + 1, n - k + 1 / `CHANCE`) / B(1, 1 / `CHANCE`).
    """
    some = [count_reduced(weights[name]) for name in INTERVALS if name in weights]
    return sum(float(_compute_cost(np.array(k), total)) for k in some)


def _compute_cost(k: Array, total: int) -> Array:
    """That of k disturbed ones among all intervals."""
    n = total + 1.0 / CHANCE
    return np.asarray(betaln(1.0, n) - betaln(k + 1.0, n - k))


def may_pay(squared: Array, freedom: Array) -> bool:
    """Whether any number of disturbed intervals may gain more log-likelihood than it costs, and than by chance.

    Parameters
    ----------
    squared : (N,) errors, as stated chi-square variables of m = `freedom` (N,); with the variance that fits it best,
        each that exceeds m gains (squared - m - m ln(squared / m)) / 2, of which a half is by chance, in the mean.
    """
    ratio = np.maximum(squared / freedom, 1.0)
    gain = np.sort(0.5 * freedom * (ratio - 1.0 - np.log(ratio)) - 0.5)[::-1]
    return bool((np.cumsum(gain) > _compute_cost(np.arange(1, len(gain) + 1), len(gain))).any())


def compute_latest_cost(some: RowWeights, total: int) -> float:
    """The cost of the latest of some disturbed intervals among all."""
    k = max(count_reduced(some), 1)
    return float(np.log((total - k + 1.0 / CHANCE) / k))
