"""The gain of one update of a filter: weights of its rows, robust ones with it."""

from __future__ import annotations

import math

import numpy as np

from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.estimation.solvers.recursion import compute_gain
from graphnav.estimation.solvers.robust import PASSES, soften, weight_and_cost
from graphnav.estimation.solvers.stack import NONE, Innovations, RowBlock


def weights_of(record: Innovations, lo: int, hi: int) -> tuple[float, float | Array]:
    """The largest weight of some rows, and the root of each number's; ones where none is used."""
    used = record.used[lo:hi]
    weight = float(max(used))
    if hi - lo == 1 or weight == 0.0:
        return weight, math.sqrt(weight) or 1.0
    return weight, np.repeat(np.sqrt(np.maximum(used, NONE)), len(record.rows.axes))


def solve_innovation(HP: Array, HPHt: Array, variance: Array, r: Array, some: RowBlock) -> tuple[Array, Array, Array]:
    """The lower root of S = H P H^T + R, S^-1 r and the gain transposed (m, D).

    Raises
    ------
    EstimationError
        If S is not positive definite.
    """
    try:
        return compute_gain(HP, HPHt, variance, r)
    except np.linalg.LinAlgError:
        raise describe_breakdown(some) from None


def describe_singular(error: np.linalg.LinAlgError) -> EstimationError:
    """What is said where a matrix has lost its digits on the way."""
    return EstimationError(f"the estimate broke down ({error}): check sigmas, units and axes", key="solver.breakdown")


def describe_breakdown(some: RowBlock) -> EstimationError:
    """What is said where a filter's covariance cannot take in some rows."""
    at = ", ".join(f"'{rows.name}' row {lo}" for rows, lo, _ in some.parts)
    return EstimationError(
        f"the filter's covariance broke down at {at}: check sigmas and units", key="solver.breakdown"
    )


def solve_robust(HP: Array, HPHt: Array, sigma: Array, r: Array, solved: Array, some: RowBlock) -> tuple[Array, Array]:
    """Sigmas with a kernel's weights in them, and these (n,), one a row.

    As the incremental smoother does with a new keyframe: none at first, then by what the update leaves, a few times.
    """
    rows, lo, hi = some.parts[0]
    stated, weight = sigma, np.ones(hi - lo)
    for left_over in range(PASSES - 2, -1, -1):
        left = (r - HPHt @ solved) / stated
        s = np.linalg.norm(left.reshape(hi - lo, -1), axis=1)
        weight = np.maximum(weight_and_cost(soften(rows.robust), s, rows.scale_of(slice(lo, hi)))[0], NONE)
        sigma = stated / np.repeat(np.sqrt(weight), len(stated) // (hi - lo))
        if left_over:
            solved = solve_innovation(HP, HPHt, sigma * sigma, r, some)[1]
    return sigma, weight
