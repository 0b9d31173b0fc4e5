"""Error-state extended Kalman filter.

The filter holds one state and the covariance P of its error state, widened by the parameters that the
constraints ask for. From keyframe to keyframe it predicts with a whole preintegrated interval,

    x <- f(x)      P <- F P F^T + Q

and updates with the rows of every constraint there, nu = -r,

    S = H P H^T + R     K = P H^T S^-1     d = K nu     x <- x [+] d     P <- (I-KH) P (I-KH)^T + K R K^T

(closed loop: the error state is moved into x at once; Joseph's form keeps P symmetric and positive).

The opening, the part that the alignment has seen, is run through twice. Before a vehicle moves nothing tells its
heading, the filter's wanders by degrees until the first motion puts it right, and Jacobians taken along the way
contradict those taken afterwards: heading, tilt and accelerometer bias get correlations that were never measured.
So the opening is filtered and smoothed, and filtered again from the same prior, linearised at points X that the first
pass left (Bell 1994: one step of the iterated smoother, over these keyframes only),

    x_k = X_k [+] e_k     e_{k+1} <- f(X_k) [-] X_{k+1} + F e_k     nu = -(r(X) + H e)

Later keyframes are linearised where the filter is.
"""

from __future__ import annotations

import time

import numpy as np
from scipy.linalg.lapack import dposv

from graphnav import rotation
from graphnav.constraints.base import Constraint, assemble
from graphnav.constraints.gnss import GnssPosition, GnssVelocity
from graphnav.dense import dense
from graphnav.dynamics import SCALE
from graphnav.errors import EstimationError
from graphnav.problem import ParameterChain, Problem
from graphnav.rotation import Array
from graphnav.solution import Solution
from graphnav.solvers.adaptive import Noise
from graphnav.solvers.passes import (
    Filtered,
    Forward,
    Innovations,
    Progress,
    Smoothed,
    parameters_of,
    scale_of,
    shift,
)
from graphnav.solvers.robust import PASSES, softened, weight_and_cost
from graphnav.solvers.rts import backward
from graphnav.solvers.watch import Bank, Verdicts
from graphnav.state import BLOCKS, DIM, States

_NOTHING = np.empty((1, 0))
_REMEMBERED = 64  # keyframes back to which the tests can be taken as they were


def ekf(
    problem: Problem, progress: Progress | None = None, opening: float | None = None, watch: bool = False
) -> Filtered:
    """Run the filter over all keyframes.

    Parameters
    ----------
    opening : s, the end of what the alignment has seen of the recording; up to there the filter runs twice. Estimates
        after it depend on nothing later than themselves.
    watch : look for errors that last in the rows that are to be watched, and go back to before them; and for noise
        in those whose sigmas are to be adapted.
    """
    began = time.perf_counter()
    K, about = len(problem.t), None
    if opening is not None and (n := int(np.searchsorted(problem.t, opening, side="right"))) > 1:
        first = _forward(problem, n, watch=watch)
        about = backward(problem, first)
    one = _forward(problem, K, about, progress, watch)
    seconds = time.perf_counter() - began
    filtered, P = States.stack(one.states), one.P[:, :DIM, :DIM]
    if about is not None:
        n = len(about.values) - 1
        P = P.copy()
        P[:n] = _about_own(P[:n], filtered[:n].minus(about.states[:n]))
    solution = Solution(
        solver="ekf",
        frame=problem.frame,
        t=problem.t,
        states=filtered,
        covariance=P,
        parameters=parameters_of(problem, one.values, one.P),
        records={name: r.record(problem) for name, r in one.records.items()},
        counts={"imu": K - 1, **{rows.name: len(rows) for rows in problem.constraints}},
        iterations=1,
        stopped="one pass forward over all keyframes",
        timings={"filter": seconds},
        notes=problem.notes,
        between=(dense(problem, filtered, P, scale_of(problem, one.values), smooth=False),),
    )
    return Filtered(**vars(one), solution=solution)


def _forward(
    problem: Problem,
    K: int,
    about: Smoothed | None = None,
    progress: Progress | None = None,
    watch: bool = False,
) -> Forward:
    """Filter the first K keyframes, of which the first few are linearised at given points."""
    columns, n = problem.columns, 0 if about is None else len(about.values)
    D = DIM + sum(s.stop - s.start for s in columns.values())
    state = problem.prior.mean
    assert state is not None
    values = np.concatenate([np.empty(0), *(c.mean[0] for c in problem.chains)])
    P = np.diag(np.concatenate([problem.prior.sigma[0], *(c.sigma[0] for c in problem.chains)]) ** 2)
    records = {rows.name: Innovations(rows) for rows in problem.constraints}
    first = {rows.name: np.searchsorted(rows.keyframe, np.arange(K + 1)) for rows in problem.constraints}
    fixes = [c for c in problem.constraints if watch and isinstance(c, GnssPosition | GnssVelocity)]
    watched = [c for c in fixes if c.watched]
    noise = Noise([c for c in fixes if c.adaptive != "off" and c.weight is None])  # weights know what follows as well
    bank = Bank(watched, problem.t, D) if watched else None
    banks: dict[int, Bank] = {}  # as they were before the latest keyframes with fixes
    verdicts = Verdicts(
        {c.name: problem.t[c.keyframe] for c in watched}, {c.name: records[c.name].used for c in watched}
    )
    begun = (state, values, P)

    all_P, all_Pp, all_F = np.empty((K, D, D)), np.empty((K, D, D)), np.empty((K - 1, D, D))
    all_values, all_vp = np.empty((K, D - DIM)), np.empty((K, D - DIM))
    states, predicted = [state] * K, [state] * K
    identity = np.eye(D)
    scale_at = columns.get(SCALE)
    steps, added = _node_steps(problem), np.zeros(D)
    k = 0
    while k < K:
        if bank is not None and any(first[rows.name][k] < first[rows.name][k + 1] for rows in watched):
            banks[k] = bank.copy()
            if len(banks) > _REMEMBERED:
                del banks[next(iter(banks))]
        if k:
            step = slice(k - 1, k)
            at, at_values = (state, values) if about is None or k >= n else about.at(k - 1)
            scale = None if scale_at is None else at_values[shift(scale_at)]
            ahead, F15 = problem.motion.propagate(step, at, scale)
            F = all_F[k - 1]
            F[:] = identity
            F[:DIM, :DIM] = F15[0]
            if scale_at is not None:
                F[:DIM, scale_at] = problem.motion.scale_columns(step, F15)[0]
            at_values = at_values.copy()
            for column, chain, j in steps.get(k, ()):
                F[column, column] *= chain.decay[j]
                at_values[shift(column)] -= chain.mean[j - 1]
                at_values[shift(column)] = chain.mean[j] + chain.decay[j] * at_values[shift(column)]
                added[column] = chain.sigma[j] ** 2
            P = F @ P @ F.T
            P[:DIM, :DIM] += problem.motion.noise(step, at.R_nb)[0]
            if bank is not None:
                bank.predicted(F)
            if k in steps:
                P.flat[:: D + 1] += added
                added[:] = 0.0
            if about is not None and k < n:
                e = F @ about.offset(k - 1, state, values)
                ahead, at_values = ahead.plus(e[None, :DIM]), at_values + e[DIM:]
            state, values = ahead, at_values
        for kind in watched:
            if (kind.name, problem.t[k]) in verdicts.anew:
                block = BLOCKS["p" if isinstance(kind, GnssPosition) else "v"]
                P[block, block] += 1e6 * np.eye(3)
        predicted[k] = state
        all_vp[k] = values
        all_Pp[k] = P
        back: int | None = None
        for rows in problem.constraints:
            lo, hi = first[rows.name][k], first[rows.name][k + 1]
            if hi > lo:
                x, record = (state, values, P), records[rows.name]
                at_point = about if k < n else None
                state, values, P, fault = _update(rows, lo, hi, *x, columns, record, at_point, k, bank, noise)
                if fault is not None:
                    again = verdicts.settle(rows.name, fault, float(problem.t[k]))
                    back = int(np.searchsorted(problem.t, again))
                    break
        if back is not None:  # once more from before the fault, without it
            bank = banks.get(back) or bank.forgetful() if bank else None
            banks = {key: old for key, old in banks.items() if key < back}
            state, values, P = (states[back - 1], all_values[back - 1], all_P[back - 1]) if back else begun
            k = back
            continue
        if about is not None and k == n - 1:
            P = _about_own(P, about.offset(k, state, values)[:3])  # from here on linearised where the filter is
        states[k] = state
        all_P[k], all_values[k] = P, values
        if progress is not None and k % 256 == 0:
            progress("filter", k / K)
        k += 1
    weights = {c.name: records[c.name].decided * noise.weight(c.name) for c in fixes}
    anew = bool(verdicts.anew)
    return Forward(states, all_values, all_vp, all_P, predicted, all_Pp, all_F, records, weights, anew, about)


def _update(
    rows: Constraint,
    lo: int,
    hi: int,
    state: States,
    values: Array,
    P: Array,
    columns: dict[str, slice],
    record: Innovations,
    about: Smoothed | None,
    k: int,
    bank: Bank | None,
    noise: Noise,
) -> tuple[States, Array, Array, float | None]:
    """One measurement update with rows lo..hi of a constraint at keyframe k; when a fault began comes last."""
    n = hi - lo
    at, at_values = (state, values) if about is None else about.at(k)
    D = len(P)
    e = np.zeros(D) if about is None else about.offset(k, state, values)
    weight, G = float(np.min(record.used[lo:hi])), _NOTHING
    for left in range(rows.passes - 1 if about is None else 0, -1, -1):
        here = at if n == 1 else at[np.zeros(n, dtype=int)]
        given = {p.name: at_values[None, shift(columns[p.name])] for p in rows.parameters}
        if n > 1:
            given = {name: np.repeat(value, n, axis=0) for name, value in given.items()}
        linear = rows.linearize(here, given, slice(lo, hi))
        H = assemble(linear, columns, D).reshape(-1, D)
        r, sigma = linear.residual.ravel() + H @ e, linear.sigma.ravel()
        if 0.0 < weight < 1.0:
            sigma = sigma / np.sqrt(weight)
        PHt = P @ H.T
        HPHt = H @ PHt
        if not left:
            sigma = noise.raised(rows.name, lo, r, HPHt.diagonal(), sigma)
        if bank is not None and weight > 0.0 and not left:
            G = bank.signature(rows.name, k, H)
        # LAPACK called directly: for matrices this small the checks around it would cost more than the work
        right = np.empty((len(r), D + 1 + G.shape[1]))
        right[:, 0], right[:, 1 : D + 1], right[:, D + 1 :] = r, PHt.T, G
        S, solved = _solve(HPHt, sigma, right, rows, lo)
        nis, bent = float(r @ solved[:, 0]), 1.0
        if rows.robust != "none" and rows.gate is None and not left:  # a gate stands in place of a kernel
            sigma, solved, bent = _robust(HPHt, sigma, right, solved, rows, lo, hi)
        K = solved[:, 1 : D + 1].T
        d = e - K @ r
        if left:  # again about where this leads (Jazwinski 1970, theorem 8.2)
            at, at_values = at.plus(d[None, :DIM]), at_values + d[DIM:]
            e = np.concatenate([state.minus(at)[0], values - at_values])
    refused = rows.gate is not None and nis > rows.gate**2
    weight = 0.0 if refused else weight * bent
    spread = np.sqrt(S.flat[:: len(r) + 1]).reshape(n, -1)
    record.set(slice(lo, hi), r.reshape(n, -1), spread, nis / n, weight, refused)
    if bank is not None:
        bank.seen(rows.name, k, nis)
    if weight == 0.0:
        return state, values, P, None
    IKH = -K @ H
    IKH.flat[:: len(P) + 1] += 1.0
    P = IKH @ P @ IKH.T + (K * (sigma * sigma)) @ K.T
    P = 0.5 * (P + P.T)  # rounding's asymmetry would grow, past what a stop leaves between its place and the state
    fault = None
    if bank is not None:
        fault = bank.updated(rows.name, K, G, solved[:, D + 1 :], r, float(np.linalg.norm(state.v)))
    return at.plus(d[None, :DIM]), at_values + d[DIM:], P, fault


def _solve(HPHt: Array, sigma: Array, right: Array, rows: Constraint, lo: int) -> tuple[Array, Array]:
    """S = H P H^T + R and S^-1 times the right sides."""
    S = HPHt.copy()
    S.flat[:: len(S) + 1] += sigma * sigma
    _, solved, info = dposv(S, right)
    if info:
        raise EstimationError(f"the filter's covariance broke down at '{rows.name}' row {lo}: check sigmas and units")
    return S, solved


def _robust(
    HPHt: Array, sigma: Array, right: Array, solved: Array, rows: Constraint, lo: int, hi: int
) -> tuple[Array, Array, float]:
    """Sigmas with a kernel's weights in them, S^-1 times the right sides with these, and the least weight.

    As the incremental smoother does with a new keyframe: none at first, then by what the update leaves, a few times.
    """
    stated, weight = sigma, np.ones(hi - lo)
    for _ in range(PASSES - 1):
        left = (right[:, 0] - HPHt @ solved[:, 0]) / stated
        s = np.linalg.norm(left.reshape(hi - lo, -1), axis=1)
        weight = np.maximum(weight_and_cost(softened(rows.robust), s, rows.robust_scale)[0], 1e-12)
        sigma = stated / np.repeat(np.sqrt(weight), len(stated) // (hi - lo))
        _, solved = _solve(HPHt, sigma, right, rows, lo)
    return sigma, solved, float(np.min(weight))


def _about_own(P: Array, e: Array) -> Array:
    """Covariances (..., D, D) of errors about points turned into those about states e away from them.

    Exp(e + x) = Exp(e) Exp(J_r(e) x) to first order in x.
    """
    J = rotation.right_jacobian(e[..., :3])
    P = P.copy()
    P[..., :3, :] = J @ P[..., :3, :]
    P[..., :3] = P[..., :3] @ np.swapaxes(J, -1, -2)
    return P


def _node_steps(problem: Problem) -> dict[int, list[tuple[slice, ParameterChain, int]]]:
    """At keyframes where a parameter moves on to its next node: its columns, its chain and that node."""
    out: dict[int, list[tuple[slice, ParameterChain, int]]] = {}
    for chain in problem.chains:
        for k in np.flatnonzero(np.diff(chain.node)) + 1:
            out.setdefault(int(k), []).append((problem.columns[chain.parameter.name], chain, int(chain.node[k])))
    return out
