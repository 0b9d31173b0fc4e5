"""What the rivals of what is left out (`graphnav.estimation.noise.rivals`) mean for the solutions.

If another set of fixes is wrong, with a probability p, the trajectory is off by d, and d is known with a covariance Q.
The mean square of the error is then, about the likeliest part of this mixture, of which the covariance is P,

    (1 - p) P + p (Q + d d^T)

All solvers have what that is more than P, by the smoother.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import chdtri

from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, DIM
from graphnav.estimation.names import name_rows
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.explanations import FIXES
from graphnav.estimation.noise.model import NoiseModel, Rival
from graphnav.estimation.noise.rivals import exclude
from graphnav.estimation.noise.spans import Span
from graphnav.estimation.noise.suspects import list_fix_times
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.passes import SmootherPass, reuse_points
from graphnav.estimation.solvers.rts import smooth_backward

_CHANCE = 0.0027  # by which positions differ by more than three sigmas of a Gaussian


def compare_rivals(
    base: Problem, noise: NoiseModel, problem: Problem, smoothed: SmootherPass
) -> tuple[Array | None, tuple[Note, ...]]:
    """What the rivals of a noise model add to the covariances of the states (K, 15, 15), as of `graphnav.core.state`,
    and a doubt for each; only of those by which positions differ beyond chance.

    Parameters
    ----------
    base : built with stated noise and the parts of its intervals' noise.
    problem, smoothed : with the noise model.
    """
    more, doubts = None, list[Note]()
    known, p = smoothed.P[:, :DIM, :DIM], BLOCKS["p"]
    for rival in noise.rivals:
        used = apply_noise(base, exclude(noise, rival.excluded, list_fix_times(base)))
        try:
            other = smooth_backward(used, refilter(used, reuse_points(smoothed, problem, used)))
        except BREAKDOWN:  # from points that are of other fixes
            continue
        off, Q = other.states.minus(smoothed.states), other.P[:, :DIM, :DIM]
        both = known[:, p, p] + Q[:, p, p]
        squared = np.einsum("ki,ki->k", off[:, p], np.linalg.solve(both, off[:, p, None])[..., 0])
        k = int(np.argmax(squared))
        if squared[k] > float(chdtri(3, _CHANCE)):
            each = rival.probability * (Q - known + off[:, :, None] * off[:, None, :])
            more = each if more is None else more + each
            doubts.append(_describe(rival, noise, problem, k, float(np.linalg.norm(off[k, p]))))
    return more, tuple(doubts)


def _describe(rival: Rival, noise: NoiseModel, problem: Problem, k: int, far: float) -> Note:
    """A doubt: which fixes may be wrong instead, and how far off the solution is at keyframe k in that case."""
    start = problem.recording.start
    others, used = _list_fixes(rival.excluded, start), _list_fixes(noise.excluded, start)
    instead = f"instead of {used}, which are left out" if used else "although none are left out"
    words = (
        f"with a probability of {100 * rival.probability:.0f} % {others} are wrong, {instead}, and it is {far:.2g} m "
        f"off at {problem.t[k] - start:.0f} s, as its sigmas allow for"
    )
    return Note("doubt.rival", f"This result cannot be trusted: {words}")


def _list_fixes(excluded: Mapping[str, tuple[Span, ...]], start: float) -> str:
    """Fixes in spans, in words."""
    out = []
    for name in FIXES:
        each = [f"{a - start:.1f} to {b - start:.1f} s" for a, b in excluded.get(name, ())]
        out += [f"{name_rows(name)} from {', '.join(each)}"] if each else []
    return " and ".join(out)
