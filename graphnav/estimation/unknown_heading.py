"""An unknown heading: a mixture of trajectories from headings all around.

Linearised at one heading with a sigma of half a turn, antenna, turn rates and wheels make a filter certain of a heading
that nothing measured, and of the place that the lever arm has there. So the prior is a sum of Gaussians, all around and
each narrow enough to be linear in, and so is what is known afterwards (Alspach and Sorenson 1972, "Nonlinear Bayesian
estimation using Gaussian sum approximations"), each as likely as the evidence says. The likeliest is the solution, and
the mean square of what all of them differ from it by is in its covariance.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.ekf import ekf, smooth_repeatedly
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import LINEAR_ATTITUDE, SmootherPass
from graphnav.estimation.solvers.rts import smooth_backward

_HEADINGS = int(np.ceil(np.pi / LINEAR_ATTITUDE))  # two sigmas apart, their sum is even to a part in a hundred


def choose_heading(problem: Problem, passes: Counter[str]) -> tuple[Problem, bool]:
    """The problem with the likeliest of all initial headings, and whether it is unknown.

    It is known to `LINEAR_ATTITUDE` there; or, where measurements tell it better than that, it is their mean, with a
    prior as much wider than their sigma as of any alignment.
    """
    first = _start_from(problem, 0.0)
    smoothed = smooth_backward(first, ekf(first))
    passes.update(filter=1, smoother=1)
    every = [
        (turn, evidence, *_measure_heading(one.states.R_nb[0], one.P[0, :3, :3]))
        for turn, evidence, one in _solve_each_heading(first, smoothed, passes)
    ]
    if not every:
        return first, True
    turn, evidence, heading, variance = np.array(every).T
    best = int(np.argmax(evidence))
    share, off = np.exp(evidence - evidence[best]), rotation.wrap(heading - heading[best])
    share /= share.sum()
    mean = float(share @ off)
    sigma = float(np.sqrt(share @ (variance + (off - mean) ** 2)))
    if sigma > LINEAR_ATTITUDE:
        return _start_from(problem, turn[best]), True
    start = problem.prior.mean
    assert start is not None
    # headings are clockwise
    ahead = _measure_heading(start.R_nb[0], np.eye(3))[0] - heading[best] - mean
    return _start_from(problem, ahead, problem.settings.alignment.prior_inflation * sigma), False


def compare_headings(problem: Problem, smoothed: SmootherPass, passes: Counter[str]) -> Array:
    """What other initial headings add to the covariances (K, 15, 15) of a problem whose heading was chosen."""
    known = smoothed.P[:, :DIM, :DIM]
    more, total = np.zeros_like(known), -np.inf  # the logarithm of the sum of all evidences so far
    for _, evidence, other in _solve_each_heading(problem, smoothed, passes):
        total = float(np.logaddexp(total, evidence))
        share, off = np.exp(evidence - total), other.states.minus(smoothed.states)
        more += share * (other.P[:, :DIM, :DIM] - known + off[:, :, None] * off[:, None, :] - more)
    return more


def _solve_each_heading(
    problem: Problem, first: SmootherPass, passes: Counter[str]
) -> Iterator[tuple[float, float, SmootherPass]]:
    """From starts turned all around: the turn (rad), the logarithm of the evidence, the solution.

    Those from which the filter breaks down are left out.
    """
    for turn in 2.0 * np.pi * np.arange(_HEADINGS) / _HEADINGS:
        other = _start_from(problem, float(turn))
        with contextlib.suppress(*BREAKDOWN):
            about = Points(_turn(first.states, problem, float(turn)), first.values)
            forward, smoothed, _ = smooth_repeatedly(other, about, passes)
            if np.isfinite(evidence := float(np.sum(forward.log_likelihood))):
                yield float(turn), evidence, smoothed


def _measure_heading(R_nb: Array, P: Array) -> tuple[float, float]:
    """Heading, rad, and its variance, by the covariance (3, 3) of an attitude."""
    up = R_nb[2]
    return float(rotation.to_rph(R_nb)[2]), float(up @ P @ up)


def _start_from(problem: Problem, turn: float, known: float = LINEAR_ATTITUDE) -> Problem:
    """The problem with its initial heading turned, and known to a sigma, rad."""
    mean, sigma = problem.prior.mean, problem.prior.sigma.copy()
    assert mean is not None
    sigma[0, 2] = known
    return replace(problem, prior=replace(problem.prior, mean=_turn(mean, problem, turn), sigma=sigma))


def _turn(states: States, problem: Problem, turn: float) -> States:
    """States turned by an angle (rad) about the vertical through the antenna at the start."""
    mean, gnss = problem.prior.mean, problem.recording.gnss
    assert mean is not None
    assert gnss is not None
    centre, Rz = mean.p[0] + mean.R_nb[0] @ gnss.lever_arm, rotation.exp(np.array([[0.0, 0.0, turn]]))[0]
    return replace(states, R_nb=Rz @ states.R_nb, p=centre + (states.p - centre) @ Rz.T, v=states.v @ Rz.T)
