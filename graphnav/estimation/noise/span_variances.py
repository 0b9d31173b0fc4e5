"""Variances of the measurements in excluded spans.

Which spans are faulty is decided by evidence (`graphnav.estimation.noise.exclusion`), with nothing in them in use. But
fixes that are wrong by 30 m still tell within 30 m where a vehicle is; the IMU alone, after a minute, does not. So in
the end each constraint has in each span a variance of its own: the mean square of its errors, each predicted by a
smoother without it, in units of the noise model's variance, of the axis in which it is largest, and at least 1,

    f = sum e^2 / R / n

in a few passes, of which the first uses nothing in the spans. What n numbers in succession tell is less if their errors
are alike: with a correlation r from one to the next, their mean has

    c = 1 + 2 sum_k (1 - k / n) r^k

times the variance of the mean of independent ones (Bayley and Hammersley 1946, "The effective number of independent
observations in an autocorrelated time series"), so each has the weight 1 / (f c).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.core.rotation import Array
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.noise.moments import predict_errors
from graphnav.estimation.noise.spans import Span, mask_times
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import MomentPass, reuse_points
from graphnav.estimation.solvers.rts import smooth_moments

_ROUNDS = 8  # passes at most
_Factors = dict[tuple[str, Span], float]  # on the variance of a constraint's rows in a span


def weigh_excluded(base: Problem, noise: NoiseModel, near: tuple[Points, Problem]) -> tuple[NoiseModel, int]:
    """Give the measurements of excluded spans weights by which they can be used.

    Parameters
    ----------
    base : built with stated noise.
    noise : with spans that nothing is used of.
    near : points to linearise at, and the problem that they are of.

    Returns
    -------
    NoiseModel
        With a weight for each row of the spans.
    int
        Passes of filter and smoother.
    """
    factors: _Factors = {}
    passes, settled = 0, False
    while not settled and passes < _ROUNDS:
        used = apply_noise(base, noise)
        smoothed = smooth_moments(used, refilter(used, reuse_points(*near, used), whole=False))
        factors, settled = _measure_factors(used, noise, smoothed, factors)
        noise = replace(noise, span_weights=_list_weights(factors))
        passes += 1
    return noise, passes


def _measure_factors(
    problem: Problem, noise: NoiseModel, smoothed: MomentPass, before: _Factors
) -> tuple[_Factors, bool]:
    """Factors on the variances of the rows of each span, and whether they differ from those before by chance only."""
    factors, settled = {}, True
    for rows in problem.constraints:
        spans = noise.excluded.get(rows.name, ())
        if not spans:
            continue
        t = problem.t[rows.keyframe]
        error, sigma = predict_errors(rows, smoothed)
        for span in spans:
            own = mask_times(t, [span])
            e = error[own]
            if not e.size:
                continue
            c = count_repetition(e)
            factor = max(float(np.max(np.mean((e / sigma[own]) ** 2, axis=0))), 1.0) * c
            factors[rows.name, span] = factor
            chance = np.sqrt(2.0 * c / e.size)
            settled &= abs(np.log(factor / before.get((rows.name, span), np.inf))) < chance
    return factors, settled


def count_repetition(error: Array) -> float:
    """How many errors (n, m) in succession count as one independent error."""
    n, square = len(error), float(np.mean(error**2))
    r = float(np.clip(np.mean(error[1:] * error[:-1]) / square, 0.0, 1.0)) if n > 1 and square else 0.0
    k = np.arange(1, n)
    return float(1.0 + 2.0 * np.sum((1.0 - k / n) * r**k))


def _list_weights(factors: _Factors) -> dict[str, tuple[tuple[float, float, float], ...]]:
    """`NoiseModel.span_weights` by the factors on variances."""
    names = dict.fromkeys(name for name, _ in factors)
    return {name: tuple((*span, 1.0 / f) for (of, span), f in factors.items() if of == name) for name in names}
