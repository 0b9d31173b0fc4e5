"""A drive smoothed again near what is known of it: only figures or weights have changed since."""

from __future__ import annotations

import numpy as np

from graphnav.problem import Problem
from graphnav.solvers.ekf import ekf, refilter
from graphnav.solvers.passes import Forward, Points, Progress, Smoothed
from graphnav.solvers.rts import backward

_PASSES = 4
_TURN = 0.02  # rad; what is linear in an error of attitude is wrong by half its square


def near(
    problem: Problem, about: Points, opening: float | None = None, progress: Progress | None = None
) -> tuple[Forward, Smoothed]:
    """Filter and smooth about points, and again about where that leads, until attitudes stay (Bell 1994).

    Where they do not, from the start as a filter would, with `opening` as for `ekf`.
    """
    for _ in range(_PASSES):
        forward = refilter(problem, about, progress)
        smoothed = backward(problem, forward, progress)
        turned = smoothed.states.minus(about.states)[:, :3]
        if float(np.max(np.sum(turned * turned, axis=1))) < _TURN**2:
            return forward, smoothed
        about = smoothed
    forward = ekf(problem, progress, opening)
    return forward, backward(problem, forward, progress)
