"""The algebra of one step and of one update of a filter: covariance ahead, gain, and covariance after it."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dposv

from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.solvers.robust import PASSES, soften, weight_and_cost
from graphnav.estimation.solvers.stack import Innovations, RowBlock

_NONE = 1e-12  # weight of a row that is not used beside others of its keyframe


def predict_covariance(P: Array, F: Array, Q: Array, added: Array | None, out: Array) -> Array:
    """F P F^T + Q, in `out`: F turns and moves the states alone, and shrinks each parameter by itself."""
    top = F[:DIM] @ P
    np.matmul(top, F[:DIM].T, out=out[:DIM, :DIM])
    out[:DIM, :DIM] += Q
    out[:DIM, DIM:] = top[:, DIM:]
    out[DIM:, DIM:] = P[DIM:, DIM:]
    if added is not None:
        decay = np.diagonal(F)[DIM:]
        out[:, DIM:] *= decay
        out[DIM:, DIM:] *= decay[:, None]
        out.flat[:: len(out) + 1] += added
    out[DIM:, :DIM] = out[:DIM, DIM:].T
    return out


def weights_of(record: Innovations, lo: int, hi: int) -> tuple[float, float | Array]:
    """The largest weight of some rows, and the root of each number's; ones where none is used."""
    used = record.used[lo:hi]
    weight = float(max(used))
    if hi - lo == 1 or weight == 0.0:
        return weight, math.sqrt(weight) or 1.0
    return weight, np.repeat(np.sqrt(np.maximum(used, _NONE)), len(record.rows.axes))


def update_covariance(P: Array, PHt: Array, H: Array, K: Array, variance: Array) -> Array:
    """The covariance after an update, by Joseph's form: (I - KH) P first, then that (I - KH)^T + K R K^T."""
    out = K @ PHt.T
    np.subtract(P, out, out=out)
    out -= (out @ H.T - K * variance) @ K.T
    out = out + out.T  # rounding's asymmetry would grow, past what a stop leaves between its place and the state
    out *= 0.5
    return out


def solve_innovation(HPHt: Array, variance: Array, right: Array, some: RowBlock) -> tuple[Array, Array]:
    """The upper root of S = H P H^T + R, and S^-1 times the right sides."""
    S = HPHt.copy()
    S.flat[:: len(S) + 1] += variance
    # LAPACK called directly: for matrices this small the checks around it would cost more than the work
    root, solved, info = dposv(S.T, right, overwrite_a=1)
    if info:
        at = ", ".join(f"'{rows.name}' row {lo}" for rows, lo, _ in some.parts)
        raise EstimationError(
            f"the filter's covariance broke down at {at}: check sigmas and units", key="solver.breakdown"
        )
    return root, solved


def solve_robust(HPHt: Array, sigma: Array, right: Array, solved: Array, some: RowBlock) -> tuple[Array, Array, float]:
    """Sigmas with a kernel's weights in them, S^-1 times the right sides with these, and the least weight.

    As the incremental smoother does with a new keyframe: none at first, then by what the update leaves, a few times.
    """
    rows, lo, hi = some.parts[0]
    stated, weight = sigma, np.ones(hi - lo)
    for _ in range(PASSES - 1):
        left = (right[:, 0] - HPHt @ solved[:, 0]) / stated
        s = np.linalg.norm(left.reshape(hi - lo, -1), axis=1)
        weight = np.maximum(weight_and_cost(soften(rows.robust), s, rows.scale_of(slice(lo, hi)))[0], 1e-12)
        sigma = stated / np.repeat(np.sqrt(weight), len(stated) // (hi - lo))
        _, solved = solve_innovation(HPHt, sigma * sigma, right, some)
    return sigma, solved, float(np.min(weight))
