"""Sigmas of fixes that residuals exceed: the scale of a robust fit, by its residuals."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from scipy.special import bdtrc, chdtri

from graphnav.core.rotation import Array
from graphnav.estimation.noise.model import NoiseModel, VarianceComponent
from graphnav.estimation.noise.tails import CHANCE
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution

_MEDIAN = float(chdtri(1, 0.5))  # of the square of a standard normal number


def measure_scale(problem: Problem, solved: Solution) -> dict[str, float]:
    """Log variance factors at which half of the residuals of fixes are within the median of a normal distribution.

    By group, of those with more residuals beyond the median of their sigma than by chance (a binomial test). A robust
    kernel bounds the influence of outliers only if its scale is right: with one far too small it fits a few fixes
    exactly, whichever these are. So the scale is estimated with the fit, by the median of absolute residuals (Huber
    1981, "Robust Statistics", section 7.7).

    Parameters
    ----------
    problem : with the sigmas that `solved`, its solution by a batch, was found with.
    """
    squares: dict[str, list[Array]] = defaultdict(list)
    for rows in problem.constraints:
        if rows.fix_of:
            record, (names, index) = solved.records[rows.name], rows.list_noise_groups()
            z2 = (record.residual / record.sigma) ** 2
            for i, name in enumerate(names):
                squares[name].append(z2[index == i])
    found = {}
    for name, parts in squares.items():
        z2 = np.concatenate(parts)
        if len(z2) and bdtrc(np.count_nonzero(z2 > _MEDIAN) - 1, len(z2), 0.5) < CHANCE:
            found[name] = float(np.log(np.median(z2) / _MEDIAN))
    return found


def widen_sigmas(noise: NoiseModel, more: dict[str, float]) -> NoiseModel:
    """A noise model with these logarithms added to its variance factors."""
    log = {name: figure.log_factor for name, figure in noise.figures.items()}
    return NoiseModel({name: VarianceComponent(log.get(name, 0.0) + more.get(name, 0.0)) for name in {**log, **more}})
