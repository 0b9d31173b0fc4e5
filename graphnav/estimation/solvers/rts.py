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
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from graphnav.core import rotation
from graphnav.core.progress import Progress
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.breakdown import explain_smoother
from graphnav.estimation.solvers.disturbance import smooth_errors, smooth_rows
from graphnav.estimation.solvers.linearise import Points, find_stepping, linearise
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

# largest ratio of filtered to smoothed sigma: P - P N P has a relative error of eps times its square, a millionth
_CANCELLED = 7e4


def smooth_backward(problem: Problem, forward: ForwardRecord, progress: Progress | None = None) -> SmootherPass:
    """Smooth a forward pass: keyframes linearised at the filter's estimates, and before them those at given points."""
    K, D = forward.P.shape[:2]
    n, end = _count_given(forward)
    P, found, behind = np.empty((K, D, D)), _Disturbances.allocate(n, D), (np.zeros(D), np.zeros((D, D)))
    parts = [_smooth_filtered(forward, end, P, problem.t, progress)] if end < K else []
    if forward.about is not None:
        if n == end + 1:
            ahead, away = forward.P_predicted[end], _find_later(forward, parts[0], end)
            _, inverse, info = dposv(ahead, np.eye(D))
            if info:
                raise explain_smoother(float(problem.t[end]))
            behind = inverse @ away, inverse @ (ahead - P[end]) @ inverse
            found.put(end, *behind)
        if forward.updates is not None:
            _smooth_points(forward, forward.updates, behind, end, found, P, progress=progress)
            _restore_digits(forward, P, end)
        parts = [move_points(forward.about.take_first(end), found.errors[:end]), *parts]
    smoothed = join_passes(parts)
    return SmootherPass(smoothed.states, smoothed.values, found.r, found.N, found.N_diagonal, P)


def smooth_points(forward: ForwardRecord) -> Points:
    """Smooth a forward pass without covariances; of one linearised at given points throughout, a step of Gauss and
    Newton from these points.
    """
    (K, D), one = forward.P.shape[:2], forward.updates
    n, end = _count_given(forward)
    r, errors = np.zeros(D), np.empty(forward.errors.shape)
    parts = [_smooth_filtered(forward, end, np.empty((0, D, D)))] if end < K else []
    if forward.about is not None:
        if n == end + 1:
            _, r, info = dposv(forward.P_predicted[end], _find_later(forward, parts[0], end))
            if info:
                raise explain_smoother()
        if one is not None:
            steps = forward.F, forward.decay
            smooth_errors(end, r, steps, one.arrays, one.blocks.arrays, forward.filtered, errors)
        parts = [move_points(forward.about.take_first(end), errors[:end]), *parts]
    return join_passes(parts)


def _count_given(forward: ForwardRecord) -> tuple[int, int]:
    """How many keyframes were linearised at given points, and how many of them have errors about these points ahead."""
    n = 0 if forward.about is None else len(forward.about.values)
    return n, max(n - 1, 0) if n < len(forward.P) else n


def _find_later(forward: ForwardRecord, smoothed: Points, end: int) -> Array:
    """(D,) what later keyframes add to the prediction of keyframe `end`, of which `smoothed` is the first."""
    assert forward.about is not None
    point = forward.about.take(slice(end, end + 1))
    away = np.concatenate([smoothed.states[:1].minus(point.states)[0], (smoothed.values[:1] - point.values)[0]])
    return away - forward.errors_predicted[end]


def smooth_moments(problem: Problem, forward: ForwardRecord) -> MomentPass:
    """Smooth a forward pass that was linearised at given points throughout, with covariances for a noise model only."""
    K, D = forward.P.shape[:2]
    assert forward.updates is not None
    one, smoothed = forward.updates, smooth_points(forward)
    found, behind = _Disturbances.allocate(K, D), (np.zeros(D), np.zeros((D, D)))
    linear, asked = {}, np.zeros_like(one.H)
    for rows in problem.constraints:
        if rows.list_noise_groups()[0]:
            which = slice(0, int(np.searchsorted(rows.keyframe, K)))
            linear[rows.name] = linearise(rows, smoothed, problem.columns, which)
            asked[one.places[rows.name]] = linear[rows.name].H
    wanted = np.zeros((K, D), dtype=bool)  # at both ends of their steps
    for chain in problem.chains:
        if chain.parameter.correlation_time is not None:
            k, own = find_stepping(chain, K), problem.columns[chain.parameter.name]
            wanted[k, own] = wanted[k - 1, own] = True
    variance, of_rows = _smooth_points(forward, one, behind, K, found, np.empty((0, D, D)), wanted, asked)
    return MomentPass(
        smoothed.states, smoothed.values, found.r, found.N, found.N_diagonal, variance, linear, of_rows, one.places
    )


@dataclass(frozen=True)
class _Disturbances:
    """Results of the disturbance smoother's recursion for n keyframes."""

    errors: Array  # (n, D)
    r: Array  # (n, D)
    N: Array  # (n, 15, 15)
    N_diagonal: Array  # (n, D)

    @classmethod
    def allocate(cls, n: int, D: int) -> _Disturbances:
        return cls(np.empty((n, D)), np.empty((n, D)), np.empty((n, DIM, DIM)), np.empty((n, D)))

    def put(self, k: int, r: Array, N: Array) -> None:
        self.r[k], self.N[k], self.N_diagonal[k] = r, N[:DIM, :DIM], np.diagonal(N)


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


def _smooth_points(
    forward: ForwardRecord,
    one: Updates,
    behind: tuple[Array, Array],
    end: int,
    out: _Disturbances,
    P: Array,
    wanted: Array | None = None,
    asked: Array | None = None,
    progress: Progress | None = None,
) -> tuple[Array, Array]:
    """Smoothed errors, covariances, r and N of the first keyframes up to `end`, from r and N behind them.

    Where P has no keyframes, variances (end, D) of the columns `wanted` (K, D), and H P^s H^T (end, M, M) of rows
    `asked` (K, M, D).
    """
    r_k, N_k = behind
    wanted = np.zeros((0, 0), dtype=bool) if wanted is None else wanted
    asked = np.empty((0, 0, 0)) if asked is None else asked
    variance, of_rows = np.zeros(wanted.shape), np.zeros((len(asked), *asked.shape[1:2] * 2))
    # contiguous, like an empty one: another layout would compile `smooth_rows` a second time
    columns, first = np.ascontiguousarray(np.nonzero(wanted)[1]), np.append(0, np.cumsum(wanted.sum(axis=1)))
    for hi in range(end, 0, -STRETCH):
        lo = max(hi - STRETCH, 0)
        r_k, N_k = smooth_rows(
            lo, hi, r_k, N_k, (forward.F, forward.decay), one.arrays, one.blocks.arrays, forward.filtered,
            (out.errors, out.r, out.N, out.N_diagonal), (P, variance, of_rows), asked, columns, first,
        )  # fmt: skip
        if progress is not None:
            progress("smoother", 1.0 - lo / len(forward.P))
    return variance, of_rows


def _restore_digits(forward: ForwardRecord, P: Array, end: int) -> None:
    """Recompute covariances where P - P N P lost its digits, as before a first fix, by stable steps.

    With C and P^s of the next keyframe, in Joseph's form: (I - C F) P_k (I - C F)^T + C (P^s + Q) C^T.
    """
    after, before = (np.diagonal(x[:end], axis1=1, axis2=2) for x in (P, forward.P))
    lost = np.flatnonzero(np.any(after * _CANCELLED < before, axis=1))
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
        problem, "rts", found, covariance, compute_sigmas(found.P), smooth=True, records=records, iterations=1,
        stopped="one pass forward and one back",
        timings={**forward.solution.timings, "smoother": seconds},
    )  # fmt: skip
