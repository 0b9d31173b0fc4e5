"""Start of a noise estimate: linearisation points, and weights of gross outliers."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri

from graphnav.estimation.faults.excluded import weigh_rows
from graphnav.estimation.faults.watch import SIZES
from graphnav.estimation.noise.model import RowWeights
from graphnav.estimation.noise.moments import collect_row_moments
from graphnav.estimation.noise.outliers import list_reduced
from graphnav.estimation.noise.tails import get_tail_index, weigh_outlying, weigh_scaled
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.ekf import ekf, refilter, smooth_near
from graphnav.estimation.solvers.linearise import Points, linearise
from graphnav.estimation.solvers.passes import SmootherPass, are_near
from graphnav.estimation.solvers.robust import weigh_squares
from graphnav.estimation.solvers.rts import smooth_points

_COOLING = 3.0  # factor by which the sigmas of an annealing fall in each round
_STEPS = 20  # of Gauss and Newton in a round at most; residuals of a heading that is still wrong tell nothing
_SETTLED = 1e-2  # sigmas by which linearisation points may be off without effect
_SEARCHES = 5  # searches for gross outliers at most


@dataclass(frozen=True)
class Initial:
    """Linearisation points of all keyframes, and what goes with them."""

    points: Points
    passes: int  # of filter and smoother, to find them
    weights: dict[str, RowWeights] = field(default_factory=dict)  # by constraint, of the rows they do not rest on
    log_factors: dict[str, float] = field(default_factory=dict)  # of figures, beyond those of the problem


def find_initial_points(problem: Problem, opening: float | None) -> Iterator[Initial]:
    """Find points of a filter that uses all measurements, and others if leaving gross outliers out leads elsewhere.

    Gross outliers lead a filter that uses all measurements too far from the truth for linearisation. So they are left
    out, and searched again with the filter without them, until that is near the one before. Growing errors are not
    searched for: while the heading is still uncertain, the filter itself drifts against the fixes. If that leads
    elsewhere, or the filter breaks down, points that rest on few outliers are found by annealing, once they are asked
    for.

    Parameters
    ----------
    problem : with the figures to start from.
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.

    Yields
    ------
    Initial
        Several until two of them lead to the same.

    Raises
    ------
    EstimationError
        If the filter breaks down with large sigmas of all fixes, too.
    """
    try:
        plain = smooth_points(ekf(problem, opening=opening, stays=_SETTLED))
    except BREAKDOWN:  # outliers of hundreds of sigmas make its covariance numerically singular
        yield anneal(problem, opening)
        return
    initials, sure = _leave_out_gross(problem, opening, plain)
    yield from initials
    if not sure:
        with contextlib.suppress(*BREAKDOWN):
            yield anneal(problem, opening)


def _leave_out_gross(problem: Problem, opening: float | None, plain: Points) -> tuple[list[Initial], bool]:
    """The points of a filter that uses all measurements, those that leaving gross outliers out leads to if they differ,
    and whether nothing else has to be tried.
    """
    sound, about, passes = problem, plain, 1
    seen, near = [_list_unused(problem)], False
    smoothed: SmootherPass | None = None
    try:
        while not near and len(seen) <= _SEARCHES:  # about near points, a search finds the same
            found = weigh_rows(problem, refilter(problem, about, watch=True, drifts=False, whole=False).weights)
            if (unused := _list_unused(found)) in seen:
                break
            seen.append(unused)
            sound, smoothed = found, smooth_near(found, about, opening)
            near = are_near(smoothed, about)
            about, passes = smoothed, passes + 2
        if smoothed is None:
            return [Initial(plain, passes)], True
        one, other = (smooth_points(refilter(problem, points, whole=False)) for points in (plain, about))
    except BREAKDOWN:  # with figures or points that are far off, most rows seem wrong
        return [Initial(plain, passes)], False
    weights = {}
    for rows in sound.constraints:
        if rows.weight is not None and np.any(rows.weight == 0.0):
            m, own = len(rows.axes), smoothed.take_rows(rows, sound.columns)
            left_out = collect_row_moments(rows, own).left_out
            every = np.ones(len(rows), dtype=bool)
            weight = weigh_scaled(left_out, m, get_tail_index({}, rows.name, m), every)
            weights[rows.name] = list_reduced(sound.t[rows.keyframe], weight, every)
    if are_near(other, one):
        return [Initial(one, passes + 2, weights)], True
    return [Initial(plain, 1), Initial(smoothed.drop_covariances(), passes + 1, weights)], False


def anneal(problem: Problem, opening: float | None) -> Initial:
    """Find points and figures that are robust against outliers, by deterministic annealing.

    The errors of fixes are assumed to be as large as they get, then a third of that in each round, with weights by the
    residuals of the round before; until half of them are no smaller than assumed, or the stated sigmas are reached.
    (Yang, Antonante, Tzoumas and Carlone 2020, "Graduated non-convexity for robust spatial perception", eq. 12, with
    the sigma in place of mu.)
    """
    fixes = [rows for rows in problem.constraints if rows.fix_of]
    weights, wider, passes = {rows.name: np.ones(len(rows)) for rows in fixes}, 1.0, 0
    about: Points | None = None
    stated = {rows.name: np.min(rows.sigma, axis=1) for rows in fixes}  # type: ignore[attr-defined]
    outliers: dict[str, RowWeights] = {}
    while True:
        share = {c.name: 1.0 / (1.0 + (SIZES[c.unit] * wider / stated[c.name]) ** 2) for c in fixes}
        eased = weigh_rows(problem, {name: x * weights[name] for name, x in share.items()})
        if about is None:
            about, passes = smooth_points(ekf(eased, opening=opening, stays=_SETTLED)), 1
        for _ in range(_STEPS):
            before, about, passes = about, smooth_points(refilter(eased, about, whole=False)), passes + 1
            if are_near(about, before):
                break
        settled = not share or min(np.median(x) for x in share.values()) > 0.5
        for rows in fixes:
            error = linearise(rows, about, problem.columns)
            m = len(rows.axes)
            squared = share[rows.name] * np.sum((error.residual / error.stated) ** 2, axis=1)
            weights[rows.name] = weigh_squares("geman-mcclure", np.sqrt(squared), np.sqrt(m))[0]
            settled |= bool(np.median(squared) > chdtri(m, 0.5))
            every = np.ones(len(rows), dtype=bool)
            weight = weigh_outlying(squared, m, get_tail_index({}, rows.name, m))
            outliers[rows.name] = list_reduced(problem.t[rows.keyframe], weight, every)
        if settled:
            break
        wider /= _COOLING
    larger = {
        group: -float(np.median(np.log(share[rows.name]))) for rows in fixes for group in rows.list_noise_groups()[0]
    }
    return Initial(about, passes, outliers, larger)


def _list_unused(problem: Problem) -> dict[str, list[int]]:
    """Numbers of the rows that are not used, by constraint that has any."""
    unused = {c.name: np.flatnonzero(c.weight == 0.0).tolist() for c in problem.constraints if c.weight is not None}
    return {name: rows for name, rows in unused.items() if rows}
