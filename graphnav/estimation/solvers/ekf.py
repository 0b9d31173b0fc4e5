"""Error-state extended Kalman filter.

The filter holds one state and the covariance P of its error state, widened by the parameters that the
constraints ask for. From keyframe to keyframe it predicts with a whole preintegrated interval,

    x <- f(x)      P <- F P F^T + Q

and updates with the rows of every constraint there, nu = -r,

    S = H P H^T + R     K = P H^T S^-1     d = K nu     x <- x [+] d     P <- (I-KH) P (I-KH)^T + K R K^T

(closed loop: the error state is moved into x at once; Joseph's form keeps P symmetric and positive).

The opening is the part that the alignment has seen. Before a vehicle moves nothing tells its
heading, the filter's wanders by degrees until the first motion puts it right, and Jacobians taken along the way
contradict those taken afterwards: heading, tilt and accelerometer bias get correlations that were never measured.
So the opening is filtered and smoothed until attitudes stay, and filtered again from the same prior, linearised at the
points that are left (`graphnav.estimation.solvers.points`). So are the first steps of a walk, which tell tilt and
accelerometer bias apart. Later keyframes are linearised where the filter is, and their covariances move along with it
(`graphnav.estimation.solvers.invariant`).

Where only figures or weights have changed since the drive was filtered, `refilter` is linearised at given points
throughout.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, DIM
from graphnav.estimation.dense import dense
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.decision import Decide, hold
from graphnav.estimation.solvers.gain import solve_innovation, solve_robust, weights_of
from graphnav.estimation.solvers.invariant import transport_covariance
from graphnav.estimation.solvers.linearise import Points, advance, scale_at
from graphnav.estimation.solvers.passes import (
    FilterPass,
    ForwardRecord,
    Progress,
    SmootherPass,
    Updates,
    join_passes,
    move_points,
    near_to,
    parameters_of,
    sigmas_of,
)
from graphnav.estimation.solvers.point_filter import Errors, PointFilter
from graphnav.estimation.solvers.points import AtEstimate, AtPoints, Estimate
from graphnav.estimation.solvers.recursion import predict, update
from graphnav.estimation.solvers.rts import backward
from graphnav.estimation.solvers.stack import Innovations, RowBlock, Stack
from graphnav.estimation.solvers.stretches import StretchFilter
from graphnav.estimation.solvers.verdicts import Verdicts
from graphnav.estimation.solvers.watch import Bank
from graphnav.imu.dynamics import SCALE

_PASSES = 4  # about where the pass before led


def ekf(
    problem: Problem,
    progress: Progress | None = None,
    opening: float | None = None,
    known: Points | None = None,
    decide: Decide | None = None,
) -> FilterPass:
    """Run the filter over all keyframes.

    Parameters
    ----------
    opening : s, the end of what the alignment has seen of the recording; up to there the filter runs twice. Estimates
        after it depend on nothing later than themselves.
    known : where the opening is linearised, from its first keyframe on, if that is known better than by a first pass.
    decide : asked after the updates of each keyframe; a smoother is not to rest on what comes of it.
    """
    began = time.perf_counter()
    K, about = len(problem.t), None
    if opening is not None and (n := int(np.searchsorted(problem.t, opening, side="right"))) > 1:
        about = _smooth_about(problem, backward(problem, _forward(problem, n)))[1] if known is None else known.first(n)
    one = _forward(problem, K, about, progress, decide=decide)
    seconds = time.perf_counter() - began
    filtered, P = one.states, one.P[:, :DIM, :DIM].copy()  # a view would hold what is known of the parameters too
    if about is not None:
        n = len(about.values) - 1
        P[:n] = transport_covariance(P[:n], about.states[:n], filtered[:n])
    solution = Solution(
        solver="ekf",
        frame=problem.frame,
        t=problem.t,
        states=filtered,
        covariance=P,
        parameters=parameters_of(problem, one.values, sigmas_of(one.P)),
        records={name: r.record(problem) for name, r in one.records.items()},
        counts={"imu": K - 1, **{rows.name: len(rows) for rows in problem.constraints}},
        iterations=1,
        stopped="one pass forward over all keyframes",
        timings={"filter": seconds},
        notes=problem.notes,
        between=(dense(problem, filtered, P, scale_at(problem.columns, one.values), smooth=False),),
    )
    return FilterPass(**vars(one), solution=solution)


def refilter(
    problem: Problem, about: Points, progress: Progress | None = None, watch: bool = False, drifts: bool = True
) -> ForwardRecord:
    """Run the filter over the first keyframes, linearised at given points; several times as fast as `ekf`.

    Parameters
    ----------
    about : of these keyframes, near enough for what is left to be linear: an earlier pass.
    watch : look for errors that last in the rows that are to be watched, and go back to before them.
    drifts : of such errors those that grow as well.
    """
    return _forward(problem, len(about.values), about, progress, watch, drifts)


def near(
    problem: Problem, about: Points, opening: float | None = None, progress: Progress | None = None
) -> tuple[ForwardRecord, SmootherPass]:
    """A drive smoothed again near what is known of it: only figures or weights have changed since.

    Where attitudes do not stay, it is smoothed from the start as a filter would be, with `opening` as for `ekf`.
    """
    forward, smoothed, stays = _smooth_about(problem, about, progress)
    if stays:
        return forward, smoothed
    forward = ekf(problem, progress, opening)
    return forward, backward(problem, forward, progress)


def _smooth_about(
    problem: Problem, about: Points, progress: Progress | None = None
) -> tuple[ForwardRecord, SmootherPass, bool]:
    """The first keyframes smoothed about points, and about where that leads until attitudes stay, if they do."""
    for _ in range(_PASSES):
        forward = refilter(problem, about, progress)
        smoothed = backward(problem, forward, progress)
        if near_to(smoothed, about):
            return forward, smoothed, True
        about = smoothed
    return forward, smoothed, False


class _Kept:
    """Of K keyframes errors about given points, of the first n, and the estimates of those behind them."""

    def __init__(self, n: int, K: int, D: int) -> None:
        self.errors, self.own = np.empty((n, D)), Points.allocate(K, D - DIM)

    def __setitem__(self, k: int, x: Any) -> None:
        if k < len(self.errors):
            self.errors[k] = x
        else:
            self.own.put(slice(k, k + 1), Points(x.state, x.values[None]))

    def __getitem__(self, k: int) -> Any:
        return self.errors[k] if k < len(self.errors) else _step(self.own, k)

    def points(self, about: Points | None) -> Points:
        """All as points."""
        n = len(self.errors)
        parts = [] if about is None else [move_points(about, self.errors)]
        return join_passes([*parts, self.own.at(slice(n, None))] if n < len(self.own.values) else parts)


def _forward(
    problem: Problem,
    K: int,
    about: Points | None = None,
    progress: Progress | None = None,
    watch: bool = False,
    drifts: bool = True,
    decide: Decide | None = None,
) -> ForwardRecord:
    """Filter the first K keyframes, of which the first n are linearised at given points."""
    n = 0 if about is None else len(about.values)
    scale, steps = problem.columns.get(SCALE), advance(problem, K)
    D = DIM + steps.decay.shape[1]
    all_P, all_Pp = np.empty((K, D, D)), np.empty((K, D, D))
    all_F = np.empty((K - 1, DIM, DIM if scale is None else scale.stop))
    fixes = [c for c in problem.constraints if watch and c.fix_of]
    decided = {c.name for c in problem.constraints if c.gate is not None or c.robust != "none"}
    stack, own = Stack(problem, K, decided.union(c.name for c in fixes)), AtEstimate(problem, steps)
    given, updates = None, None
    if about is not None:
        given = AtPoints(problem, about, stack, steps, all_F)
        updates = Updates.none(stack.joint, given.H)
    state = problem.prior.mean
    assert state is not None
    x: Any = Estimate(state, np.concatenate([np.empty(0), *(c.mean[0] for c in problem.chains)]))
    if about is not None:
        x = own.minus(x, _step(about, 0))
    P = np.diag(np.concatenate([problem.prior.sigma[0], *(c.sigma[0] for c in problem.chains)]) ** 2)
    records = stack.records
    watched = [c for c in fixes if c.watched]
    tests = None
    if watched:
        tests = Bank(watched, problem.t, D, drifts)
    verdicts = Verdicts(
        {c.name: problem.t[c.keyframe] for c in watched}, {c.name: records[c.name].used for c in watched}
    )
    begin = partial(_begin, x, P, records)
    x, P = begin()
    found, ahead = _Kept(n, K, D), _Kept(n, K, D)
    stretches = None
    if tests is None and decide is None and not decided and all(c.passes == 1 for c in problem.constraints):
        stretches = StretchFilter(problem, steps, stack, all_Pp, all_P, all_F)
    k = 0
    if given is not None and updates is not None and not decided and decide is None:
        out = Errors(ahead.errors, all_Pp, found.errors, all_P)
        compiled = PointFilter(given, steps, stack, updates, out, begin)
        k = compiled.run_all(progress) if tests is None else compiled.run_tested(tests, verdicts, problem.t, progress)
        x, P = (out.filtered[k - 1], all_P[k - 1]) if k else begin()
        if about is not None and k == n:
            x, P = _leave_points(about, own, all_P, k, x)
    while k < K:
        where: AtEstimate | AtPoints = given if given is not None and k < n else own
        if stretches is not None and where is own and (on := stretches.run(k, x, P, ahead.own, found.own)) > k:
            k, x, P = on, found[on - 1], all_P[on - 1]
            if progress is not None:
                progress("filter", k / K)
            continue
        if tests is not None:
            tests.arrive(k)
        if k:
            x, F, Q = where.step(k, x)
            if where is own:
                all_F[k - 1] = F
            predict(P, all_F[k - 1], steps.decay[k - 1], Q, steps.added[k - 1], all_Pp[k])
            P = all_Pp[k]
            if tests is not None:
                tests.predicted(all_F[k - 1], steps.decay[k - 1])
        for kind in watched if verdicts.anew else ():
            if (kind.name, problem.t[k]) in verdicts.anew:
                P = _anywhere(P, kind.fix_of)
        ahead[k], all_Pp[k] = x, P
        back: int | None = None
        taken = updates if k < n else None
        if taken is not None:
            taken.forget(k)
        # at its own estimate, each kind is linearised where those before it have led
        for some in stack.together(k, one_by_one=where is own):
            x, P, fault = _update(some, x, P, where, stack, tests, taken)
            if fault is not None:
                again = verdicts.settle(some.parts[0][0].name, fault, float(problem.t[k]))
                back = int(np.searchsorted(problem.t, again))
                break
        if back is None and k == len(problem.t) - 1 and (trial := verdicts.ended()) is not None:
            back = int(np.searchsorted(problem.t, trial))
        if decide is not None and back is None:
            x, P = hold(decide(k, _here(None if where is own else about, k, x), P), x, P, where)
        if back is not None:  # once more from before the fault, without it
            if tests is not None:
                tests.go_back(back)
            k = back
            x, P = (found[k - 1], all_P[k - 1]) if k else begin()
            continue
        found[k], all_P[k] = x, P
        if progress is not None and k % 256 == 0:
            progress("filter", k / K)
        k += 1
        if about is not None and k == n:  # from here on linearised where the filter is
            x, P = _leave_points(about, own, all_P, k, x)
    log_likelihood = stack.finish()
    weights = {c.name: records[c.name].decided for c in fixes}
    filtered, predicted = found.points(about), ahead.points(about)
    return ForwardRecord(
        filtered.states,
        filtered.values,
        all_P,
        predicted,
        all_Pp,
        all_F,
        steps.decay,
        records,
        weights,
        bool(verdicts.anew),
        about,
        found.errors,
        ahead.errors,
        updates,
        log_likelihood,
    )


def _begin(x: Any, P: Array, records: dict[str, Innovations]) -> tuple[Any, Array]:
    """What is known at the start, but for the place where the first fix, which tells it, is not used."""
    first = [one.used[0] for one in records.values() if one.rows.fix_of == "p" and len(one.used)]
    return x, _anywhere(P, "p") if first and first[0] == 0.0 else P


def _anywhere(P: Array, block: str) -> Array:
    """A covariance with nothing known of a block, but for what moves with it."""
    P = P.copy()
    P[BLOCKS[block], BLOCKS[block]] += 1e6 * np.eye(3)
    return P


def _step(points: Points, k: int) -> Estimate:
    return Estimate(points.states[k : k + 1], points.values[k])


def _leave_points(about: Points, own: AtEstimate, all_P: Array, n: int, e: Array) -> tuple[Estimate, Array]:
    """The estimate after the last of n given points, and its covariance, also in its place, by the error e there."""
    at = _step(about, n - 1)
    x = own.plus(at, e)
    all_P[n - 1] = own.carry(all_P[n - 1], at, x)
    return x, all_P[n - 1]


def _update(
    some: RowBlock, x: Any, P: Array, where: Any, stack: Stack, bank: Bank | None, taken: Updates | None
) -> tuple[Any, Array, float | None]:
    """One update with rows of a keyframe, added to what that has taken in; when a fault began comes last."""
    rows, lo, hi = some.parts[0]
    record = stack.records[rows.name]
    weight, root_weight = weights_of(record, lo, hi) if some.alone else (1.0, stack.root_weight[some.at])
    at, e = where.about(x)
    for left in range(where.passes(some) - 1, -1, -1):
        r, H, sigma = where.rows(some, at)
        r, sigma = r if e is None else r + H @ e, sigma / root_weight
        HP = H @ P
        HPHt = HP @ H.T
        root, solved, Kt = solve_innovation(HP, HPHt, sigma * sigma, r, some)
        if not left:
            stack.seen(some, root, solved)
            nis, bent = float(r @ solved), np.ones(hi - lo)
            if rows.robust != "none" and rows.gate is None:  # a gate stands in place of a kernel
                sigma, bent = solve_robust(HP, HPHt, sigma, r, solved, some)
                root, solved, Kt = solve_innovation(HP, HPHt, sigma * sigma, r, some)
        d = -(r @ Kt) if e is None else e - r @ Kt
        if left:  # again about where this leads (Jazwinski 1970, theorem 8.2)
            P, at = where.carry(P, at, ahead := where.plus(at, d)), ahead
            e = where.minus(x, at)
    if some.alone:
        refused = rows.gate is not None and nis > rows.gate**2
        weight = 0.0 if refused else weight
        record.weight[lo:hi] = 0.0 if refused else record.used[lo:hi] * bent
        record.refused[lo:hi] = refused
    if bank is not None:
        bank.seen(rows.name, some.k, nis, weight > 0.0)
    if weight == 0.0:
        return x, P, None
    if taken is not None:
        taken.add(some, Kt, -solved, root)
    P = update(P, HP, H, Kt, sigma * sigma)
    fault = None if bank is None else bank.updated(rows.name, some.k, H, Kt, solved, root, float(where.speeds[some.k]))
    to = where.plus(at, d)
    return to, where.carry(P, at, to), fault


def _here(about: Points | None, k: int, x: Any) -> Points:
    """An estimate at a keyframe, or an error state about given points, as a point."""
    if about is None:
        return Points(x.state, x.values[None])
    return move_points(Points(about.states[k : k + 1], about.values[k : k + 1]), x[None])
