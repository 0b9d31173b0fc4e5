"""Error-state extended Kalman filter.

The filter holds one state and the covariance P of its error state, widened by the parameters that the
constraints ask for. From keyframe to keyframe it predicts with a whole preintegrated interval,

    x <- f(x)      P <- F P F^T + Q

and updates with the rows of every constraint there, nu = -r,

    S = H P H^T + R     K = P H^T S^-1     d = K nu     x <- x [+] d     P <- (I-KH) P (I-KH)^T + K R K^T

(closed loop: the error state is moved into x at once; Joseph's form keeps P symmetric and positive).

The opening is the part that the alignment used. Before the first motion the heading is not observable and drifts by
degrees; Jacobians evaluated there contradict later ones, and create correlations between heading, tilt and
accelerometer bias that were never measured. So the opening is filtered and smoothed until attitudes converge, and
filtered again from the same prior, linearised at these points (`graphnav.estimation.solvers.points`). So are the first
steps of a walk, which separate tilt from accelerometer bias. Later keyframes are linearised at the filter's estimate,
and their covariances are transported with it (`graphnav.estimation.solvers.invariant`).

Where only figures or weights have changed since the drive was filtered, `refilter` is linearised at given points
throughout.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Collection
from functools import partial
from typing import Any

import numpy as np

from graphnav.core.progress import Progress
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.faults.search import FaultSearch, free
from graphnav.estimation.faults.watch import Bank
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.decision import Decide, hold
from graphnav.estimation.solvers.invariant import transport_covariance
from graphnav.estimation.solvers.linearise import Points, advance
from graphnav.estimation.solvers.passes import (
    LINEAR_ATTITUDE,
    FilterPass,
    ForwardRecord,
    SmootherPass,
    are_near,
    compute_sigmas,
    join_passes,
    make_solution,
    move_points,
    subtract_points,
)
from graphnav.estimation.solvers.points import Linearisation, PointFilter
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.estimation.solvers.stack import Innovations, Stack
from graphnav.estimation.solvers.stretches import STAYS, StretchFilter
from graphnav.imu.dynamics import SCALE

_PASSES = 4  # each about the points of the one before


def ekf(
    problem: Problem,
    progress: Progress | None = None,
    opening: float | None = None,
    known: Points | None = None,
    decide: Decide | None = None,
    stays: float = STAYS,
) -> FilterPass:
    """Run the filter over all keyframes.

    Parameters
    ----------
    opening : s, end of the span used by the alignment; up to there, and on until the attitude is known well enough
        for the filter's own points, it is linearised at smoothed ones. Estimates after that depend on nothing later
        than themselves.
    known : linearisation points of the opening, from its first keyframe on, if better ones than a first pass's are
        known.
    decide : called after the updates of each keyframe; a smoother must not use the result.
    stays : sigmas, as for `graphnav.estimation.solvers.stretches.StretchFilter`.
    """
    began = time.perf_counter()
    K, about = len(problem.t), None
    if opening is not None and (n := int(np.searchsorted(problem.t, opening, side="right"))) > 1:
        about = _linearise_opening(problem, n, known)
    one = _run_forward(problem, K, about, progress, decide=decide, stays=stays)
    seconds = time.perf_counter() - began
    # a copy: a view would keep the parameters' covariance in memory
    P, ahead = (every[:, :DIM, :DIM].copy() for every in (one.P, one.P_predicted[1:]))
    if about is not None:
        n = len(about.values) - 1
        P[:n] = transport_covariance(P[:n], about.states[:n], one.states[:n])
        ahead[: n - 1] = transport_covariance(ahead[: n - 1], about.states[1:n], one.predicted.states[1:n])
    solution = make_solution(
        problem, "ekf", one, P, compute_sigmas(one.P), ahead,
        records={name: r.record(problem) for name, r in one.records.items()},
        iterations=1, stopped="one pass forward over all keyframes", timings={"filter": seconds},
    )  # fmt: skip
    return FilterPass(**vars(one), solution=solution)


def refilter(
    problem: Problem,
    about: Points,
    progress: Progress | None = None,
    watch: bool = False,
    drifts: bool = True,
    whole: bool = True,
) -> ForwardRecord:
    """Run the filter over the first keyframes, linearised at given points; several times as fast as `ekf`.

    Parameters
    ----------
    about : points of these keyframes from an earlier pass, close enough for the rest to be linear.
    watch : test watched rows for persistent errors, and go back to before their onset.
    drifts : test for growing errors as well.
    whole : False keeps what `smooth_moments` needs, predicted covariances of two keyframes, and no innovations.
    """
    return _run_forward(problem, len(about.values), about, progress, watch, drifts, whole=whole)


class Comparison:
    """Innovation likelihoods of a problem and of variants that differ by weights or by few rows.

    Parameters
    ----------
    about : points of all keyframes that all of them are linearised at.
    """

    def __init__(self, problem: Problem, about: Points) -> None:
        self._K = len(about.values)
        self._one = Linearisation.of(problem, about, Stack(problem, self._K), advance(problem, self._K))
        self._motion, self._Q = problem.motion, self._one.compute_noise(problem, about)

    def filter(self, problem: Problem, about: Points, anew: Collection[str] = ()) -> Stack:
        """The innovations by a problem with the same points of what both have.

        `anew` are the constraints whose rows differ.
        """
        stack, steps = Stack(problem, self._K), advance(problem, self._K)
        one = self._one.lift(problem, about, stack, anew)
        x, P = _start_from_prior(problem)
        start = _get_start(subtract_points(x, about.take(slice(1)))[0], P, stack.records)
        filtered = tuple(np.empty((2, *x.shape)) for x in (P[0], P, P[0], P))
        Q = self._Q if problem.motion is self._motion else None
        PointFilter(problem, about, stack, steps, one, filtered, whole=False, Q=Q).run(lambda: start, None, None)
        return stack


def smooth_repeatedly(
    problem: Problem, about: Points, passes: Counter[str] | None = None
) -> tuple[ForwardRecord, SmootherPass, bool]:
    """Filter and smooth the first keyframes about points, and about what comes out, until attitudes converge.

    Parameters
    ----------
    passes : counts those made.

    Returns
    -------
    tuple[ForwardRecord, SmootherPass, bool]
        The last passes, and whether attitudes converged.
    """
    for _ in range(_PASSES):
        forward = refilter(problem, about)
        smoothed, before = smooth_backward(problem, forward), about
        if passes is not None:
            passes.update(filter=1, smoother=1)
        if are_near(smoothed, before):
            return forward, smoothed, True
        about = smoothed
    return forward, smoothed, False


def smooth_near(problem: Problem, about: Points, opening: float | None = None) -> SmootherPass:
    """Smooth a drive again near a known solution, after a change of figures or weights only.

    Where attitudes do not converge, it is smoothed from the start as a filter would be, with `opening` as for `ekf`.
    """
    _, smoothed, converged = smooth_repeatedly(problem, about)
    return smoothed if converged else smooth_backward(problem, ekf(problem, opening=opening))


def _linearise_opening(problem: Problem, n: int, known: Points | None) -> Points:
    """Smoothed points of the first n keyframes, and of more until two sigmas of the attitude are linear.

    Of n only where those of more do not converge.
    """
    first = about = _smooth_opening(problem, n)[1] if known is None else known.take(slice(n))
    K, size = len(problem.t), n
    with contextlib.suppress(*BREAKDOWN):
        while size < K:
            variance = np.diagonal(refilter(problem, about, whole=False).P[n - 1 :], axis1=1, axis2=2)
            linear = np.flatnonzero(2.0 * np.sqrt(variance[:, :3].max(axis=1)) <= LINEAR_ATTITUDE)
            if len(linear):
                points = about.take(slice(n + linear[0]))
                if known is None and size > n:
                    _, points, converged = smooth_repeatedly(problem, points)
                    return points if converged else first
                return points
            size = min(2 * size, K)
            if known is not None:
                about = known.take(slice(size))
            else:
                _, about, converged = _smooth_opening(problem, size, about)
                if not converged:
                    return first
        return about
    return first


def _smooth_opening(problem: Problem, n: int, about: Points | None = None) -> tuple[ForwardRecord, SmootherPass, bool]:
    """As `smooth_repeatedly` of the first n keyframes, with points for some of these."""
    return smooth_repeatedly(problem, smooth_backward(problem, _run_forward(problem, n, about)))


def _run_forward(
    problem: Problem,
    K: int,
    about: Points | None = None,
    progress: Progress | None = None,
    watch: bool = False,
    drifts: bool = True,
    decide: Decide | None = None,
    whole: bool = True,
    stays: float = STAYS,
) -> ForwardRecord:
    """Filter the first K keyframes, of which the first n are linearised at given points."""
    scale, steps = problem.columns.get(SCALE), advance(problem, K)
    D = DIM + steps.decay.shape[1]
    about = Points.allocate(0, D - DIM) if about is None else about
    n = len(about.values)
    all_P, all_Pp = np.empty((K, D, D)), np.empty((K if whole else 2, D, D))
    all_F = np.empty((K - 1, DIM, DIM if scale is None else scale.stop))
    fixes = [c for c in problem.constraints if watch and c.fix_of]
    watched = [c for c in fixes if c.watched]
    stack = Stack(problem, K, {c.name for c in fixes})
    ahead, found = Points.allocate(K, D - DIM), Points.allocate(K, D - DIM)
    errors_predicted, errors = np.empty((2, n, D))
    x, P = _start_from_prior(problem)
    updates = None
    if n:
        one = Linearisation.of(problem, about, stack, steps)
        all_F[: n - 1] = one.F
        given = PointFilter(problem, about, stack, steps, one, (errors_predicted, all_Pp, errors, all_P))
        search = None
        if watched:
            bank = Bank(watched, problem.t, D, drifts)
            search = FaultSearch(watched, given, steps, stack, bank, problem.t)
        follow = search.follow if search is not None else None
        if decide is not None:
            follow = partial(_hold_errors, decide, about, errors, all_P)
        start = subtract_points(x, about.take(slice(1)))[0]
        given.run(partial(_get_start, start, P, stack.records, search), follow, progress)
        updates = given.updates
        # from there on it is linearised at the filter's estimate
        last = about.take(slice(n - 1, n))
        x = move_points(last, errors[n - 1 :])
        all_P[n - 1] = transport_covariance(all_P[n - 1 : n], last.states, x.states)[0]
        P = all_P[n - 1]
    else:
        x, P = _get_start(x, P, stack.records)
    stretches, k = StretchFilter(problem, steps, stack, all_Pp, all_P, all_F, stays), n
    while k < K:
        before, k = k, stretches.run(k, x, P, ahead, found)
        if decide is not None and (on := _hold(decide, before, k, found, all_P)) < k:
            stretches.shorten(on - before)
            k = on
        x, P = found.take(slice(k - 1, k)), all_P[k - 1]
        if progress is not None:
            progress("filter", k / K)
    log_likelihood = stack.finish() if whole or watch else stack.log_likelihood()
    filtered = join_passes([move_points(about, errors), found.take(slice(n, None))])
    predicted = join_passes([move_points(about, errors_predicted), ahead.take(slice(n, None))])
    return ForwardRecord(
        filtered.states,
        filtered.values,
        all_P,
        predicted,
        all_Pp,
        all_F,
        steps.decay,
        stack.records,
        {c.name: stack.records[c.name].decided for c in fixes},
        about,
        errors,
        errors_predicted,
        updates,
        log_likelihood,
    )


def _start_from_prior(problem: Problem) -> tuple[Points, Array]:
    """Point and covariance before the first keyframe."""
    assert problem.prior.mean is not None
    sigma = np.concatenate([problem.prior.sigma[0], *(c.sigma[0] for c in problem.chains)])
    values = np.concatenate([np.empty(0), *(c.mean[0] for c in problem.chains)])
    return Points(problem.prior.mean, values[None]), np.diag(sigma**2)


def _get_start(
    x: Any, P: Array, records: dict[str, Innovations], search: FaultSearch | None = None
) -> tuple[Any, Array]:
    """State and covariance at the start, with an unknown position where the first fix is not used."""
    first = [one.used[0] for one in records.values() if one.rows.fix_of == "p" and len(one.used)]
    less = np.zeros(len(P)) if search is None else search.at_start
    return x, P + np.diag(less + free(len(P), "p") if first and first[0] == 0.0 else less)


def _hold(decide: Decide, k0: int, k1: int, found: Points, all_P: Array) -> int:
    """Decide at keyframes k0 to k1, and apply the first decision; returns the keyframe to continue from."""
    for k in range(k0, k1):
        here = found.take(slice(k, k + 1))
        if (one := decide(k, here, all_P[k])) is not None:
            d, P = hold(one, all_P[k])
            to = move_points(here, d[None])
            found.put(slice(k, k + 1), to)
            all_P[k] = transport_covariance(P[None], here.states, to.states)[0]
            return k + 1
    return k1


def _hold_errors(decide: Decide, about: Points, errors: Array, all_P: Array, k0: int, k1: int) -> int:
    """As `_hold`, for errors about given points, which stay fixed."""
    for k in range(k0, k1):
        here = move_points(about.take(slice(k, k + 1)), errors[k : k + 1])
        if (one := decide(k, here, all_P[k])) is not None:
            d, all_P[k] = hold(one, all_P[k])
            errors[k] += d
            return k + 1
    return k1
