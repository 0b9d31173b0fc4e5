"""Where an estimate of noise begins: points to linearise at, and weights of what is grossly wrong."""

from __future__ import annotations

import numpy as np

from graphnav.core.errors import EstimationError
from graphnav.estimation.faults import weigh_rows
from graphnav.estimation.noise.model import RowWeights
from graphnav.estimation.noise.moments import row_moments
from graphnav.estimation.noise.outliers import limit_scaled, list_reduced
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import ekf, near, refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import ForwardRecord, SmootherPass, near_to
from graphnav.estimation.solvers.rts import backward

_SOUGHT = 5  # times what is grossly wrong is sought: in most drives the second finds what the first found
Beginning = tuple[Points, dict[str, RowWeights]]


def smooth_about(problem: Problem, about: Points) -> tuple[ForwardRecord, SmootherPass]:
    """One pass of filter and smoother over the first keyframes, linearised at points of them."""
    forward = refilter(problem, about)
    return forward, backward(problem, forward)


def find_beginnings(problem: Problem, opening: float | None) -> tuple[list[Beginning], int]:
    """Points of a filter that nothing is known before, and of one without what seems grossly wrong, if they differ.

    What is grossly wrong takes a filter that uses everything too far away to be linearised there. So what seems wrong
    beside it is left out, and what is wrong is sought again beside the filter without that, until the same is found.
    Errors that grow are not sought: what seems to drift may as well be the filter, whose heading is not known yet.

    Parameters
    ----------
    problem : with the figures to set out from.
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.

    Returns
    -------
    list of (Points, dict)
        The dict has weights of the rows that the points do without, by constraint.
    int
        Passes of filter and smoother that it took.

    Raises
    ------
    EstimationError
        If the filter breaks down with everything used.
    """
    plain = about = backward(problem, ekf(problem, opening=opening))
    sound, passes = problem, 1
    try:
        for _ in range(_SOUGHT):
            found = weigh_rows(problem, refilter(problem, about, watch=True, drifts=False).weights)
            if _list_unused(found) == _list_unused(sound):
                break
            sound, (_, about) = found, near(found, about, opening)
            passes += 2
        if sound is problem:
            return [(plain, {})], passes
        (_, one), (_, other) = (smooth_about(problem, points) for points in (plain, about))
    except EstimationError:  # by figures that are far off, so much seems wrong that what is left leads nowhere
        return [(plain, {})], passes + 1
    weights = {}
    for rows in sound.constraints:
        if rows.weight is not None and np.any(rows.weight == 0.0):
            every = np.ones(len(rows), dtype=bool)
            weight = limit_scaled(row_moments(sound, rows, about, len(rows)).left_out, len(rows.axes), every)
            weights[rows.name] = list_reduced(sound.t[rows.keyframe], weight, every)
    return ([(one, weights)] if near_to(other, one) else [(plain, {}), (about, weights)]), passes + 2


def _list_unused(problem: Problem) -> dict[str, list[int]]:
    """Numbers of the rows that are not used, by constraint that has any."""
    unused = {c.name: np.flatnonzero(c.weight == 0.0).tolist() for c in problem.constraints if c.weight is not None}
    return {name: rows for name, rows in unused.items() if rows}
