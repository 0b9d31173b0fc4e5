"""Tails of the errors of rows.

The errors of a sensor are seldom Gaussian: of a row's m whitened numbers e, with s = |e|^2, the density is

    p(e) = exp(-rho(s)) / C      rho = s / 2                            s <= nu + m
                                 rho = (nu + m) (1 + ln(s / (nu + m))) / 2   beyond

a Gaussian with the tails of a Student t distribution of nu degrees of freedom, the tail index; it is Gaussian for
nu -> infinity. Beyond the limit nu + m a row has the weight (nu + m) / s, and the maximum-likelihood variance is that
at which the squares with these weights have the mean m. The index is estimated for each constraint, with a log-normal
prior about the one by which a Gaussian row is beyond the limit once in a thousand times (`CHANCE`).

Lange, Little and Taylor, "Robust statistical modeling using the t distribution", JASA 84 (1989); Barron, "A general and
adaptive robust loss function", CVPR (2019).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.special import chdtrc, chdtri, gammaln

from graphnav.core.rotation import Array
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.problem import Problem

CHANCE = 1e-3  # probability of a larger squared error, below which a row is an outlier
_WITHIN = float(np.log(3.0))  # 1-sigma of the logarithm of a tail index
_GRID = np.linspace(np.log(0.3), np.log(100.0), 60)


def get_tail_index(tails: Mapping[str, float], name: str, m: int) -> float:
    """That of a constraint with rows of m numbers; the prior's median where none is known."""
    return tails.get(name, float(chdtri(m, CHANCE)) - m)


def weigh_outlying(squared: Array, m: int, index: float) -> Array:
    """(N,) weights by squared errors (N,) of m whitened numbers."""
    return np.asarray(np.minimum(1.0, (index + m) / np.maximum(squared, 1e-30)))


def weigh_scaled(squared: Array, m: int, index: float, used: Array) -> Array:
    """The same, with the squared errors scaled to the expected median where the median is larger than that.

    If half of the rows in use (N,) are off, the variance has not converged yet.
    """
    some = squared[used]
    scale = float(np.median(some)) / float(chdtri(m, 0.5)) if len(some) else 1.0
    return weigh_outlying(squared / max(scale, 1.0), m, index)


def relate_to_gaussian(weight: Array, m: int, index: float | None) -> Array:
    """Weights (N,) below 1 only of rows that exceed what a Gaussian does once in a thousand times (`CHANCE`)."""
    return weight if index is None else np.minimum(weight * float(chdtri(m, CHANCE)) / (index + m), 1.0)


def compute_log_normaliser(index: float | Array, m: int) -> Array:
    """The logarithm of C, relative to that of a Gaussian."""
    limit = np.asarray(index) + m
    beyond = -0.5 * limit + 0.5 * m * np.log(0.5 * limit) - gammaln(0.5 * m) + np.log(2.0 / np.asarray(index))
    return np.asarray(np.log1p(np.exp(beyond) - chdtrc(m, limit)))


def estimate_tail_index(squared: Array, m: int) -> float:
    """The tail index, maximum a posteriori, of squared errors (N,) of m whitened numbers."""
    index, log_normaliser, log_prior = _compute_grid(m)
    over = np.maximum(squared[:, None] / (index + m), 1.0)
    cost = 0.5 * (np.minimum(squared[:, None], index + m) + (index + m) * np.log(over)).sum(axis=0)
    return float(np.exp(find_peak(_GRID, log_prior - cost - len(squared) * log_normaliser)))


@cache
def _compute_grid(m: int) -> tuple[Array, Array, Array]:
    """Tail indices of rows of m numbers, and the logarithms of their normaliser and prior."""
    index = np.exp(_GRID)
    log_prior = -0.5 * ((_GRID - np.log(get_tail_index({}, "", m))) / _WITHIN) ** 2
    return index, compute_log_normaliser(index, m), log_prior


def find_peak(grid: Array, value: Array) -> float:
    """Where values (n,) on an even grid (n,) are largest, by the parabola through the largest and its neighbours."""
    j = int(np.clip(np.argmax(value), 1, len(grid) - 2))
    low, here, high = value[j - 1 : j + 2]
    bend = low - 2.0 * here + high
    off = 0.5 * (low - high) / bend if bend < 0.0 else 0.0
    return float(grid[j] + (grid[1] - grid[0]) * np.clip(off, -1.0, 1.0))


def compute_information_share(index: float, m: int) -> float:
    """Information on a row's mean, in units of what its weights state in the mean.

    A row tells as much as the Fisher information, E[|d rho / d e|^2] / m; weights taken as those of a Gaussian state
    E[w], which is more.
    """
    limit = index + m
    beyond = float(np.exp(-0.5 * limit + 0.5 * m * np.log(0.5 * limit) - gammaln(0.5 * m))) * 2.0 / (index + 2.0)
    fisher = float(1.0 - chdtrc(m + 2, limit)) + limit / m * beyond
    return fisher / (float(1.0 - chdtrc(m, limit)) + beyond)


def compute_unweighted_factor(index: float, m: int) -> float:
    """Variance factor of a Gaussian that stands for rows whose weights are not known.

    It is the robust one: of squares that count for no more than the value that a Gaussian exceeds once in a thousand
    times (`CHANCE`), the mean is that of a Gaussian.
    """
    limit, most = index + m, float(chdtri(m, CHANCE))
    log_s = np.linspace(-15.0, 60.0, 7501)
    s = np.exp(log_s)
    density = np.exp(0.5 * m * log_s - 0.5 * np.minimum(s, limit) * (1.0 + np.log(np.maximum(s / limit, 1.0))))
    density /= np.sum(density)
    factors = np.linspace(0.0, 7.0, 141)
    means = np.minimum(s / np.exp(factors[:, None]), most) @ density
    return float(np.exp(np.interp(-compute_bounded_mean(m), -means, factors)))


@cache
def compute_bounded_mean(m: int) -> float:
    """E[min(s, q)] of a chi-square variable s of m degrees of freedom that exceeds q with a probability of `CHANCE`:
    m P(chi2_m+2 < q) + q P(chi2_m > q).
    """
    most = float(chdtri(m, CHANCE))
    return m * (1.0 - float(chdtrc(m + 2, most))) + most * CHANCE


def widen_by_tails(problem: Problem, noise: NoiseModel) -> NoiseModel:
    """The noise model with which weighted rows, taken as Gaussian by a solver, tell no more than their information."""
    return _widen(problem, noise, lambda index, m: 1.0 / compute_information_share(index, m))


def widen_unweighted(problem: Problem, noise: NoiseModel) -> NoiseModel:
    """The noise model for rows to come, whose weights are not known; the others keep their variances at least."""
    wider = _widen(problem, noise, compute_unweighted_factor)
    weights = dict(noise.weights)
    for rows in problem.constraints:
        if rows.name in noise.tails and rows.name in weights:
            factor, some = compute_unweighted_factor(noise.tails[rows.name], len(rows.axes)), weights[rows.name]
            weights[rows.name] = replace(some, weight=np.minimum(factor * some.weight, 1.0))
    return replace(wider, weights=weights, tails={})


def _widen(problem: Problem, noise: NoiseModel, compute_factor: Callable[[float, int], float]) -> NoiseModel:
    figures = dict(noise.figures)
    for rows in problem.constraints:
        if rows.name in noise.tails:
            more = float(np.log(compute_factor(noise.tails[rows.name], len(rows.axes))))
            for group in rows.list_noise_groups()[0]:
                if group in figures:
                    figures[group] = replace(figures[group], log_factor=figures[group].log_factor + more)
    return replace(noise, figures=figures)
