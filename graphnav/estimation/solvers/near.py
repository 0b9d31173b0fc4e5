"""A drive smoothed again near what is known of it: only figures or weights have changed since."""

from __future__ import annotations

from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import ForwardRecord, Progress, SmootherPass, near_to
from graphnav.estimation.solvers.rts import backward

_PASSES = 4


def near(
    problem: Problem, about: Points, opening: float | None = None, progress: Progress | None = None
) -> tuple[ForwardRecord, SmootherPass]:
    """Filter and smooth about points, and again about where that leads, until attitudes stay (Bell 1994).

    Where they do not, from the start as a filter would, with `opening` as for `ekf`.
    """
    for _ in range(_PASSES):
        forward = refilter(problem, about, progress)
        smoothed = backward(problem, forward, progress)
        if near_to(smoothed, about):
            return forward, smoothed
        about = smoothed
    forward = ekf(problem, progress, opening)
    return forward, backward(problem, forward, progress)
