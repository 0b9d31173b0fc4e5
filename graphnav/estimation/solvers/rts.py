"""Rauch-Tung-Striebel smoother: the filter's forward pass combined with all later measurements.

Backwards, with C = P_k F^T P^-_{k+1}^-1 (Rauch, Tung, Striebel 1965),

    x^s_k = x_k [+] C (x^s_{k+1} [-] x^-_{k+1})     P^s_k = P_k + C (P^s_{k+1} - P^-_{k+1}) C^T

Where all is linearised at given points the errors are from those, and the same comes without an inverse of P^- from
the disturbance smoother (Bryson and Frazier 1963; Koopman 1993), through every update and step

    r <- (I - K H)^T r + H^T S^-1 nu     N <- (I - K H)^T N (I - K H) + H^T S^-1 H     r <- F^T r     N <- F^T N F
    x^s_k = x^-_k + P^-_k r_k            P^s_k = P^-_k - P^-_k N_k P^-_k

and likewise from x_k, P_k and the r and N after the updates of k, which is numerically better after a first fix.
The noise model is estimated from r and N (`graphnav.estimation.noise.moments`).
"""

from __future__ import annotations

import time

import numpy as np
from scipy.linalg.lapack import dposv

from graphnav.core import rotation
from graphnav.core.progress import Progress
from graphnav.core.rotation import Array, mv
from graphnav.core.state import DIM
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.breakdown import explain_smoother
from graphnav.estimation.solvers.disturbance import smooth_rows
from graphnav.estimation.solvers.linearise import Points, find_stepping
from graphnav.estimation.solvers.passes import (
    FilterPass,
    ForwardRecord,
    MomentPass,
    SmootherPass,
    Updates,
    compute_sigmas,
    join_passes,
    make_solution,
    move_points,
    record_residuals,
)
from graphnav.estimation.solvers.recursion import STRETCH, move_columns, smooth_filtered

_EXACT = 1e-6  # relative error that a smoothed variance may have by rounding


def smooth_backward(problem: Problem, forward: ForwardRecord, progress: Progress | None = None) -> SmootherPass:
    """Smooth a forward pass: keyframes linearised at the filter's estimates, and before them those at given points."""
    P = np.empty(forward.P.shape)
    smoothed = _smooth(forward, P, problem.t, progress)
    return SmootherPass(smoothed.states, smoothed.values, P)


def smooth_points(forward: ForwardRecord) -> Points:
    """Smooth a forward pass without covariances; of one linearised at given points throughout, a step of Gauss and
    Newton from these points.
    """
    return _smooth(forward, np.empty((0, *forward.P.shape[1:])))


def _smooth(forward: ForwardRecord, P: Array, t: Array | None = None, progress: Progress | None = None) -> Points:
    """Smoothed points; covariances in P (K, D, D), unless it has no keyframes. Times t (K,) are for errors."""
    (K, D), about = forward.P.shape[:2], forward.about
    n = len(about.values)
    end = n if n == K else max(n - 1, 0)  # so many have errors about given points ahead
    parts = [_smooth_filtered(forward, end, P, t, progress)] if end < K else []
    r, N = np.zeros(D), np.zeros((D, D) if len(P) else (0, 0))
    if n == end + 1:  # what later keyframes add to the prediction of keyframe `end`
        ahead, own = forward.P_predicted[end], about.take(slice(end, n))
        later = np.append(parts[0].states[:1].minus(own.states)[0], parts[0].values[0] - own.values[0])
        later -= forward.errors_predicted[end]
        _, solved, info = dposv(ahead, np.eye(D) if len(P) else later[:, None])
        if info:
            raise explain_smoother(None if t is None else float(t[end]))
        r = solved @ later if len(P) else solved[:, 0]
        if len(P):
            N = solved @ (ahead - P[end]) @ solved
    if forward.updates is not None:
        errors, _, _, N_diagonal, *_ = _smooth_given(forward, forward.updates, end, r, N, P, progress=progress)
        if len(P):
            _restore_digits(forward, P, N_diagonal)
        parts = [move_points(about.take(slice(end)), errors), *parts]
    return join_passes(parts)


def smooth_moments(problem: Problem, forward: ForwardRecord) -> MomentPass:
    """Smooth a forward pass that was linearised at given points throughout, with covariances for a noise model only."""
    K, D = forward.P.shape[:2]
    assert forward.updates is not None
    one = forward.updates
    wanted = np.zeros((K, D), dtype=bool)  # at both ends of their steps
    for chain in problem.chains:
        if chain.parameter.correlation_time is not None:
            k, own = find_stepping(chain, K), problem.columns[chain.parameter.name]
            wanted[k, own] = wanted[k - 1, own] = True
    none = np.zeros(D), np.zeros((D, D)), np.empty((0, D, D))
    errors, r, N, N_diagonal, variance, of_rows = _smooth_given(forward, one, K, *none, wanted, one.H)
    smoothed, residual = move_points(forward.about, errors), one.residual + mv(one.H, errors)
    return MomentPass(
        smoothed.states, smoothed.values, r, N, N_diagonal, variance, residual, one.sigma, of_rows, one.places
    )


def _smooth_filtered(
    forward: ForwardRecord, end: int, all_P: Array, t: Array | None = None, progress: Progress | None = None
) -> Points:
    """Points from keyframe `end` on; covariances in their places of (K, D, D), unless there are none."""
    K, D = forward.P.shape[:2]
    own, before, some = forward.take(slice(end, K)), forward.predicted.take(slice(end, K)), slice(end, K)
    moved = np.concatenate([own.states.minus(before.states), own.values - before.values], axis=1)
    turned = rotation.to_quaternion(np.swapaxes(before.states.R_nb, -1, -2) @ own.states.R_nb)
    errors, at = np.zeros((K - end, D)), np.zeros(1, dtype=int)
    all_P[K - 1 :] = forward.P[K - 1]
    for hi in range(K - 1, end, -STRETCH):
        lo = max(hi - STRETCH, end)
        try:
            smooth_filtered(
                lo - end, hi - end, moved, turned, (forward.F[end:], forward.decay[end:]),
                forward.P_predicted[some], forward.P[some], all_P[some], errors, at,
            )  # fmt: skip
        except np.linalg.LinAlgError:
            raise explain_smoother(None if t is None else float(t[end + int(at[0])])) from None
        if progress is not None:
            progress("smoother", 1.0 - lo / K)
    return Points(own.states.plus(errors[:, :DIM]), own.values + errors[:, DIM:])


def _smooth_given(
    forward: ForwardRecord,
    one: Updates,
    end: int,
    r_k: Array,
    N_k: Array,
    P: Array,
    wanted: Array | None = None,
    asked: Array | None = None,
    progress: Progress | None = None,
) -> tuple[Array, ...]:
    """Errors, r, N and its diagonal of the first keyframes up to `end`, as `smooth_rows` has them, from r_k and N_k.

    Covariances in P; where it has no keyframes, also variances (end, D) of the columns `wanted` (K, D), and H P^s H^T
    (end, M, M) of rows `asked` (K, M, D).
    """
    wanted = np.zeros((0, 0), dtype=bool) if wanted is None else wanted
    asked = np.empty((0, 0, 0)) if asked is None else asked
    variance, of_rows = np.zeros(wanted.shape), np.zeros((len(asked), *asked.shape[1:2] * 2))
    D, n = len(r_k), end if len(N_k) else 0
    found = np.empty((end, D)), np.empty((end, D)), np.empty((n, DIM, DIM)), np.empty((n, D))
    # contiguous, like an empty one: another layout would compile `smooth_rows` a second time
    columns, first = np.ascontiguousarray(np.nonzero(wanted)[1]), np.append(0, np.cumsum(wanted.sum(axis=1)))
    for hi in range(end, 0, -STRETCH):
        lo = max(hi - STRETCH, 0)
        r_k, N_k = smooth_rows(
            lo, hi, r_k, N_k, (forward.F, forward.decay), one.arrays, one.blocks.arrays, forward.filtered,
            found, (P, variance, of_rows), asked, columns, first,
        )  # fmt: skip
        if progress is not None:
            progress("smoother", 1.0 - lo / len(forward.P))
    return *found, variance, of_rows


def _restore_digits(forward: ForwardRecord, P: Array, N_diagonal: Array) -> None:
    """Recompute covariances where P - P N P lost its digits, by stable steps.

    Rounded to eps, N of keyframe s changes P of keyframe k <= s by at most eps P_k,ii sum_j (P^-_s,jj N_s,jj), as its
    covariance with P^-_s is bounded by both. The sum is large where rows determine a difference of columns and nothing
    determines the columns, as at a stop without GNSS, and before a first fix. With C and P^s of the next keyframe, in
    Joseph's form: (I - C F) P_k (I - C F)^T + C (P^s + Q) C^T.
    """
    end = len(N_diagonal)
    after, before, predicted = (np.diagonal(x[:end], axis1=1, axis2=2) for x in (P, forward.P, forward.P_predicted))
    rounded = np.finfo(float).eps * np.sum(predicted * N_diagonal, axis=1)
    worst = np.maximum.accumulate(rounded[::-1])[::-1]  # of all keyframes from each on
    lost = np.flatnonzero(np.any(worst[:, None] * before > _EXACT * after, axis=1))
    I = np.eye(P.shape[1])
    for k in lost[lost < len(P) - 1][::-1]:
        F, Pp = move_columns(forward.F[k], forward.decay[k], I), forward.P_predicted[k + 1]
        FP = F @ forward.P[k]
        _, gain, info = dposv(Pp, FP)
        if info:
            continue
        C = gain.T
        M = I - C @ F
        smoothed = M @ forward.P[k] @ M.T + C @ (P[k + 1] + Pp - FP @ F.T) @ C.T
        P[k] = 0.5 * (smoothed + smoothed.T)


def rts(problem: Problem, forward: FilterPass, found: SmootherPass | None = None) -> Solution:
    """The smoothed solution; residuals are its own. `found` is the backward pass where it was done before."""
    began = time.perf_counter()
    found = found or smooth_backward(problem, forward)
    records = {rows.name: record_residuals(problem, rows, found) for rows in problem.constraints}
    covariance = found.P[:, :DIM, :DIM].copy()  # a copy: a view would keep the parameters' covariance in memory
    seconds = time.perf_counter() - began
    return make_solution(
        problem, "rts", found, covariance, compute_sigmas(found.P), records=records, iterations=1,
        stopped="one pass forward and one back",
        timings={**forward.solution.timings, "smoother": seconds},
    )  # fmt: skip
