"""Bias walks of an IMU that no fixes correct, by the likelihood of the filter's innovations.

Of a walk without fixes nothing but the bias walks is estimated: the rows of its stances have correlated errors, which
their variances are widened for, so that their squares tell no white noise. A walk of the accelerometer's bias that is
stated too small is another matter: between the rests before and behind a walk a consumer accelerometer changes by
20 mm/s^2, and a filter that may not follow bends scale errors and attitude instead.

The steps of expectation-maximisation (`graphnav.estimation.noise.estimate`) do not leave a variance that is too small
to show in the states. So the likelihood, with the log-normal prior of all figures, is climbed by factors of three and
nine in sigma, as it is flat where a figure is far too small; the maximum is that of the parabola through the highest
point and its neighbours. What is stated stays where no larger figure is more probable.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import STATED, NoiseModel, VarianceComponent
from graphnav.estimation.noise.priors import get_prior
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points

_FIGURES = "imu.gyro_bias_walk", "imu.accel_bias_walk"
_STEP = 2.0 * np.log(3.0)  # of a log variance
_MOST = 6  # steps: a factor of 700 in sigma


def estimate_bias_walks(problem: Problem, about: Points) -> tuple[NoiseModel, Counter[str]]:
    """The bias walks that are larger than stated, and the passes that it took.

    Parameters
    ----------
    problem : built with stated noise and the parts of its intervals' noise.
    about : points of all keyframes that the filter is linearised at.
    """
    known: dict[tuple[int, ...], float] = {}

    def climb(steps: tuple[int, ...]) -> float:
        if steps not in known:
            one = apply_noise(problem, _make_model(dict(zip(_FIGURES, _STEP * np.array(steps), strict=True))))
            prior = sum((_STEP * k / get_prior(name)[1]) ** 2 for name, k in zip(_FIGURES, steps, strict=True))
            known[steps] = float(np.sum(refilter(one, about, whole=False).log_likelihood)) - 0.5 * prior
        return known[steps]

    axes = np.eye(len(_FIGURES), dtype=int)
    at = (0,) * len(_FIGURES)
    while True:
        ahead = [tuple((np.array(at) + d * axis).tolist()) for axis in axes for d in (-1, 1, 2)]
        best = max((one for one in ahead if min(one) >= 0 and max(one) <= _MOST), key=climb)
        if climb(best) <= climb(at):
            break
        at = best
    figures, sigmas = {}, {}
    for name, steps, axis in zip(_FIGURES, at, axes, strict=True):
        if steps:
            low, high = (climb(tuple((np.array(at) + d * axis).tolist())) for d in (-1, 1))
            bend = min(low - 2.0 * climb(at) + high, -1e-9)
            figures[name] = _STEP * (steps + float(np.clip(0.5 * (low - high) / bend, -0.5, 0.5)))
            sigmas[name] = _STEP / float(np.sqrt(-bend))
    return _make_model(figures, sigmas), Counter(filter=len(known))


def _make_model(log_factors: dict[str, float], sigmas: dict[str, float] | None = None) -> NoiseModel:
    figures = {}
    for name, x in log_factors.items():
        m, s = get_prior(name)
        sigma = min((sigmas or {}).get(name, s), s)
        figures[name] = VarianceComponent(x, sigma, m, s, 2.0 * (sigma**-2.0 - s**-2.0))
    return NoiseModel(figures) if figures else STATED
