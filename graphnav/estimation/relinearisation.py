"""Linearisation points near the smoothed solution, where the filter's own are too far from it."""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import replace

import numpy as np

from graphnav.core.progress import Progress
from graphnav.core.state import States
from graphnav.estimation.alignment import Alignment
from graphnav.estimation.noise.initial_points import find_initial_points
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import (
    LINEAR_ATTITUDE,
    FilterPass,
    SmootherPass,
    are_near,
    reuse_points,
    subtract_points,
    take_solution_points,
)
from graphnav.estimation.solvers.rows import compute_cost_at, shorten_step
from graphnav.estimation.solvers.rts import smooth_backward, smooth_points

CLEARLY_BETTER = 10.0  # half chi-square; a likelihood ratio of 22,000
_LINEAR = 0.5  # sigmas of what a step still moves: a mean square of errors over sigmas is a quarter larger
_SMOOTHINGS = 5  # passes of filter and smoother about their previous points; without convergence a batch is solved


class _Worse(Exception):
    """Raised to end a batch solution that leads to a worse optimum."""


def relinearise(
    problem: Problem,
    aligned: Alignment,
    forward: FilterPass,
    smoothed: SmootherPass,
    progress: Progress | None,
    passes: Counter[str],
) -> tuple[FilterPass, SmootherPass, Points | None]:
    """Filter and smooth about better points where the filter was linearised too far from the smoothed solution.

    Attitudes first (`_linearise_far`); where these stay, all else does if a step of Gauss and Newton from there moves
    nothing by a good part of its sigma: a barometer's scale times a height that was not known yet, a lever arm, a place
    that few fixes tell of. Returns also the points behind that step.
    """
    if not are_near(smoothed, forward.linearised, LINEAR_ATTITUDE):
        forward, smoothed, ahead = _linearise_far(problem, aligned, smoothed, progress, passes)
        if ahead is not None:
            return forward, smoothed, ahead
    for _ in range(_SMOOTHINGS):
        ahead = _step(problem, smoothed)
        passes.update(filter=1, smoother=1)
        if ahead is None:
            break
        if np.all(subtract_points(ahead, smoothed) ** 2 <= _LINEAR**2 * smoothed.variance):
            return forward, smoothed, ahead
        smoothed = smooth_backward(problem, refilter(problem, ahead, progress), progress)
        passes.update(filter=1, smoother=1)
    with contextlib.suppress(*BREAKDOWN):
        return _linearise_at(problem, aligned, _solve_batch(problem, smoothed), progress, passes)
    return forward, smoothed, None


def linearise_searched(
    problem: Problem, aligned: Alignment, progress: Progress | None, passes: Counter[str]
) -> tuple[FilterPass, SmootherPass, Points]:
    """The same about the best optimum that initial points lead to which rest on few outliers.

    For a filter that diverges from an uncertain heading, where the noise model's own estimate did not.

    Raises
    ------
    EstimationError
        If the filter breaks down.
    """
    initials = list(find_initial_points(problem, aligned.opening))
    spent = sum(one.passes for one in initials)
    passes.update(filter=spent, smoother=spent)
    starts = [one.points for one in initials]
    near = [_descend(problem, start, passes) for start in starts]
    optima = {compute_cost_at(problem, points): points for points in near if points is not None}
    for start in (start for start, points in zip(starts, near, strict=True) if points is None):
        with contextlib.suppress(_Worse):
            points = _solve_batch(problem, start, min(optima, default=np.inf))
            optima[compute_cost_at(problem, points)] = points
    return _linearise_at(problem, aligned, optima[min(optima)], progress, passes)


def linearise_known(
    problem: Problem, aligned: Alignment, known: Points, progress: Progress | None, passes: Counter[str]
) -> tuple[FilterPass, SmootherPass, Points]:
    """The same about the optimum near points of another estimate, as that of the noise model."""
    return _linearise_at(problem, aligned, _minimise(problem, known, passes), progress, passes)


def is_clearly_worse(problem: Problem, found: Points, known: Points) -> bool:
    """Whether the cost at some points is so much higher that they are near another, worse optimum."""
    return not compute_cost_at(problem, found) < compute_cost_at(problem, known) + CLEARLY_BETTER  # NaN is worse


def _linearise_far(
    problem: Problem,
    aligned: Alignment,
    smoothed: SmootherPass,
    progress: Progress | None,
    passes: Counter[str],
) -> tuple[FilterPass, SmootherPass, Points | None]:
    """Filter and smooth where attitudes were linearised too far off; and the points of a batch solution, if any.

    Each pass about the points of the pass before is a step of Gauss and Newton. If that does not settle the points are
    those of a batch solution.

    If the heading is uncertain and fixes weigh little beside wheels, a filter may turn the mounting by half a turn
    instead of the velocity, a local minimum. So the minimum is then sought at once, from that without wheels.
    """
    if aligned.motion is not None and any(c.of_wheels for c in problem.constraints):
        start: Points = smoothed
        free = replace(problem, constraints=tuple(c for c in problem.constraints if not c.of_wheels))
        with contextlib.suppress(*BREAKDOWN):
            first = smooth_backward(free, ekf(free, progress, aligned.opening))
            start = reuse_points(_minimise(free, first, passes), free, problem)
        passes.update(filter=1, smoother=1)
        return _linearise_at(problem, aligned, _minimise(problem, start, passes), progress, passes)
    for _ in range(_SMOOTHINGS):
        about = smoothed
        passes.update(filter=1, smoother=1)
        smoothed = smooth_backward(problem, refilter(problem, about, progress), progress)
        if are_near(smoothed, about, LINEAR_ATTITUDE):
            passes.update(filter=1)
            return ekf(problem, progress, aligned.opening, known=smoothed), smoothed, None
    return _linearise_at(problem, aligned, _solve_batch(problem, smoothed), progress, passes)


def _minimise(problem: Problem, start: Points, passes: Counter[str]) -> Points:
    """The points of least cost, by steps of filter and smoother, or else by a batch solution, which takes longer."""
    found = _descend(problem, start, passes)
    return _solve_batch(problem, start) if found is None else found


def _descend(problem: Problem, start: Points, passes: Counter[str]) -> Points | None:
    """The points of least cost by steps of filter and smoother; None where one raises it."""
    points, cost, fall = start, compute_cost_at(problem, start), np.inf
    with contextlib.suppress(*BREAKDOWN):
        for _ in range(problem.settings.solver.max_iterations):
            ahead = smooth_points(refilter(problem, points, whole=False))
            passes.update(filter=1, smoother=1)
            lower = compute_cost_at(problem, ahead)
            if abs(cost - lower) < problem.settings.solver.tolerance:
                return ahead
            if not 0.0 < cost - lower < 0.5 * fall:  # not the convergence of Gauss and Newton
                ahead, lower = shorten_step(problem, points, ahead, cost, lower)
            if not lower < cost:
                break
            points, cost, fall = ahead, lower, cost - lower
    return None


def _solve_batch(problem: Problem, start: Points, least: float = np.inf) -> Points:
    """The points of the batch solution that is found from some states.

    Raises
    ------
    _Worse
        If it moves slowly where it costs clearly more than the least of other points, `least`.
    """
    from graphnav.estimation.factor_graph.batch import batch  # imports GTSAM, which few filter runs need

    def watch(states: States, cost: float, gain: float, slow: bool) -> None:
        if slow and cost - gain > least + CLEARLY_BETTER:
            raise _Worse

    found = batch(problem, start.states, wanted=(), reintegrate=False, watch=watch)
    return take_solution_points(problem, found, start)


def _linearise_at(
    problem: Problem, aligned: Alignment, found: Points, progress: Progress | None, passes: Counter[str]
) -> tuple[FilterPass, SmootherPass, Points]:
    """Filter and smooth about points, and these."""
    smoothed = smooth_backward(problem, refilter(problem, found, progress), progress)
    passes.update(filter=2, smoother=1)
    return ekf(problem, progress, aligned.opening, known=smoothed), smoothed, found


def _step(problem: Problem, start: Points) -> Points | None:
    """The points after a step of Gauss and Newton, if it leads to any and attitudes are near the start's."""
    try:
        ahead = smooth_points(refilter(problem, start, whole=False))
    except BREAKDOWN:
        return None
    return ahead if are_near(ahead, start, LINEAR_ATTITUDE) else None


def step_ahead(problem: Problem, start: Points) -> Points:
    """The points after a step of Gauss and Newton, a fraction of the time by filter and smoother, where it is short."""
    return _step(problem, start) or start
