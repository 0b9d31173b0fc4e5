"""Linearisation points near the smoothed solution, where the filter's own are too far from it."""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import replace

import numpy as np

from graphnav.core.progress import Progress
from graphnav.core.state import States
from graphnav.estimation.alignment import Alignment
from graphnav.estimation.noise.initial_points import BREAKDOWN
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import (
    LINEAR_ATTITUDE,
    FilterPass,
    SmootherPass,
    are_near,
    subtract_points,
    take_solution_points,
)
from graphnav.estimation.solvers.rts import smooth_backward, smooth_points

_LINEAR = 0.5  # sigmas of what a step still moves: a mean square of errors over sigmas is a quarter larger
_SMOOTHINGS = 5  # passes of filter and smoother about their previous points; without convergence a batch is solved


def relinearise(
    problem: Problem,
    aligned: Alignment,
    known: Points | None,
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
        forward, smoothed, ahead = _linearise_far(problem, aligned, known, smoothed, progress, passes)
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
        return _linearise_at_batch(problem, aligned, smoothed, smoothed.states, progress, passes)
    return forward, smoothed, None


def _linearise_far(
    problem: Problem,
    aligned: Alignment,
    known: Points | None,
    smoothed: SmootherPass,
    progress: Progress | None,
    passes: Counter[str],
) -> tuple[FilterPass, SmootherPass, Points | None]:
    """Filter and smooth where attitudes were linearised too far off; and the points of a batch solution, if any.

    The points are `known`, those of the noise estimate, if there are any, else the smoother's own; each pass about
    those of the pass before is a step of Gauss and Newton. If that does not settle they are those of a batch solution.

    If the heading is uncertain and fixes weigh little beside wheels, a filter may turn the mounting by half a turn
    instead of the velocity, a local minimum. So the batch is then solved at once, without wheels first.
    """
    wheels = aligned.motion is not None and any(c.of_wheels for c in problem.constraints)
    about: Points = smoothed if known is None or len(known.states) != len(problem.t) else known
    for _ in range(int(about is known) if wheels else _SMOOTHINGS):
        passes.update(filter=1, smoother=1)
        smoothed = smooth_backward(problem, refilter(problem, about, progress), progress)
        if are_near(smoothed, about, LINEAR_ATTITUDE):
            passes.update(filter=1)
            return ekf(problem, progress, aligned.until, known=smoothed), smoothed, None
        about = smoothed
    states = smoothed.states
    if wheels:
        from graphnav.estimation.factor_graph.batch import batch  # imports GTSAM, which few filter runs need

        free = replace(problem, constraints=tuple(c for c in problem.constraints if not c.of_wheels))
        with contextlib.suppress(*BREAKDOWN):
            states = smooth_backward(free, ekf(free, progress, aligned.until)).states
            states = batch(free, states, wanted=(), reintegrate=False).states
        passes.update(filter=1, smoother=1)
    return _linearise_at_batch(problem, aligned, smoothed, states, progress, passes)


def _linearise_at_batch(
    problem: Problem,
    aligned: Alignment,
    smoothed: SmootherPass,
    states: States,
    progress: Progress | None,
    passes: Counter[str],
) -> tuple[FilterPass, SmootherPass, Points]:
    """Filter and smooth about the batch solution that is found from some states, and its points."""
    from graphnav.estimation.factor_graph.batch import batch

    found = take_solution_points(problem, batch(problem, states, wanted=(), reintegrate=False), smoothed)
    smoothed = smooth_backward(problem, refilter(problem, found, progress), progress)
    passes.update(filter=2, smoother=1)
    return ekf(problem, progress, aligned.until, known=smoothed), smoothed, found


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
