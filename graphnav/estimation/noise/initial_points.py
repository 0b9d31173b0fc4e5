"""Where the estimate of a noise model starts: linearisation points, and weights of gross outliers."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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

BREAKDOWN = EstimationError, np.linalg.LinAlgError  # what a filter raises that has lost its digits
_ROUNDS = 5  # searches for gross outliers at most; in most drives the second finds what the first found


@dataclass(frozen=True)
class Initial:
    """Linearisation points of all keyframes, and weights by constraint of the rows that they do not rest on."""

    points: Points
    weights: dict[str, RowWeights] = field(default_factory=dict)


def smooth_about(problem: Problem, about: Points) -> tuple[ForwardRecord, SmootherPass]:
    """One pass of filter and smoother over the first keyframes, linearised at points of them."""
    forward = refilter(problem, about)
    return forward, backward(problem, forward)


def find_initial_points(problem: Problem, opening: float | None) -> tuple[list[Initial], int]:
    """Points of a filter that uses all measurements, and of one without gross outliers if that leads elsewhere.

    Gross outliers take a filter that uses everything too far from the truth to be linearised there. So they are left
    out, and searched for again with the filter that does without them, until the same ones are found. Growing errors
    are not searched for: while the heading is still uncertain, the filter itself drifts against the fixes.

    Parameters
    ----------
    problem : with the figures to start from.
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.

    Returns
    -------
    list of Initial
        One, or two where both have to be tried.
    int
        Passes of filter and smoother.

    Raises
    ------
    EstimationError
        If the filter breaks down with everything used, with a robust kernel on the fixes as well.
    """
    try:
        plain = about = backward(problem, ekf(problem, opening=opening))
    except BREAKDOWN:  # outliers of hundreds of sigmas leave no digits in its covariance
        plain = about = _smooth_robustly(problem, opening)
    sound, passes = problem, 1
    try:
        for _ in range(_ROUNDS):
            found = weigh_rows(problem, refilter(problem, about, watch=True, drifts=False).weights)
            if _list_unused(found) == _list_unused(sound):
                break
            sound, (_, about) = found, near(found, about, opening)
            passes += 2
        if sound is problem:
            return [Initial(plain)], passes
        (_, one), (_, other) = (smooth_about(problem, points) for points in (plain, about))
    except BREAKDOWN:  # with figures or points that are far off, most rows seem wrong
        try:
            return [Initial(plain), Initial(_smooth_robustly(problem, opening))], passes + 2
        except BREAKDOWN:
            return [Initial(plain)], passes + 2
    weights = {}
    for rows in sound.constraints:
        if rows.weight is not None and np.any(rows.weight == 0.0):
            every = np.ones(len(rows), dtype=bool)
            weight = limit_scaled(row_moments(sound, rows, about, len(rows)).left_out, len(rows.axes), every)
            weights[rows.name] = list_reduced(sound.t[rows.keyframe], weight, every)
    same = near_to(other, one)
    return [Initial(one, weights)] if same else [Initial(plain), Initial(about, weights)], passes + 2


def _smooth_robustly(problem: Problem, opening: float | None) -> SmootherPass:
    """Filter and smoother with Cauchy's kernel on the fixes."""
    rows = (replace(c, robust="cauchy") if c.fix_of else c for c in problem.constraints)
    problem = replace(problem, constraints=tuple(rows))
    return backward(problem, ekf(problem, opening=opening))


def _list_unused(problem: Problem) -> dict[str, list[int]]:
    """Numbers of the rows that are not used, by constraint that has any."""
    unused = {c.name: np.flatnonzero(c.weight == 0.0).tolist() for c in problem.constraints if c.weight is not None}
    return {name: rows for name, rows in unused.items() if rows}
