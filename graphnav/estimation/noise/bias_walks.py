"""Bias walks of an IMU that no fixes correct, by the likelihood of the filter's innovations.

Of a walk without fixes only bias walks that are stated too small are estimated: the rows of its stances have correlated
errors, which their variances are widened for, so that their squares tell no white noise, and white noise of the IMU
would explain any motion. Between the rests before and behind a walk a consumer accelerometer changes by 20 mm/s^2; a
filter that may not follow bends scale errors and attitude instead.

The steps of expectation-maximisation (`graphnav.estimation.noise.estimate`) do not leave a variance that is too small
to show in the states. So the likelihood, with the log-normal prior of all figures, is climbed by one and two of the
prior's sigmas, as it is flat where a figure is far too small; the maximum is that of the parabola through the highest
point and its neighbours. What is stated stays where no larger figure is more probable, and where the likelihood would
have one that no IMU has: then something else is wrong.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import STATED, NoiseModel, VarianceComponent
from graphnav.estimation.noise.priors import WITHIN
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points

_FIGURES = "imu.gyro_bias_walk", "imu.accel_bias_walk"
_MOST = 5  # sigmas of the prior, beyond chance


def estimate_bias_walks(problem: Problem, about: Points) -> tuple[NoiseModel, Counter[str]]:
    """The bias walks that are larger than stated, and the passes that it took.

    Parameters
    ----------
    problem : built with stated noise and the parts of its intervals' noise.
    about : points of all keyframes that the filter is linearised at.
    """
    known: dict[tuple[int, ...], float] = {}

    def climb(sigmas: tuple[int, ...]) -> float:
        if sigmas not in known:
            figures = {name: _make_component(k, 1.0) for name, k in zip(_FIGURES, sigmas, strict=True)}
            one = apply_noise(problem, NoiseModel(figures))
            likelihood = refilter(one, about, whole=False).log_likelihood.sum()
            known[sigmas] = float(likelihood) - 0.5 * float(np.sum(np.square(sigmas)))
        return known[sigmas]

    def list_steps(*sizes: int) -> list[tuple[int, ...]]:
        axes = np.eye(len(_FIGURES), dtype=int)
        return [tuple((np.array(at) + d * axis).tolist()) for axis in axes for d in sizes]

    at = (0,) * len(_FIGURES)
    while climb(best := max((one for one in list_steps(-1, 1, 2) if min(one) >= 0), key=climb)) > climb(at):
        at = best
        if max(at) >= _MOST:
            return STATED, Counter(filter=len(known))
    figures = {}
    for name, k, low, high in zip(_FIGURES, at, list_steps(-1), list_steps(1), strict=True):
        if k:
            bend = min(climb(low) - 2.0 * climb(at) + climb(high), -1.0)  # the prior alone has as much
            off = 0.5 * (climb(low) - climb(high)) / bend
            figures[name] = _make_component(k + float(np.clip(off, -0.5, 0.5)), float((-bend) ** -0.5))
    return NoiseModel(figures) if figures else STATED, Counter(filter=len(known))


def _make_component(x: float, sigma: float) -> VarianceComponent:
    """A component at x of the prior's sigmas, known to `sigma` of them."""
    return VarianceComponent(WITHIN * x, WITHIN * sigma, 0.0, WITHIN, 2.0 * (sigma**-2.0 - 1.0) / WITHIN**2)
