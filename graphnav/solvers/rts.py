"""Rauch-Tung-Striebel smoother: what a filter's pass forward is worth with all that came later.

Backwards, with C = P_k F^T P^-_{k+1}^-1 (Rauch, Tung, Striebel 1965),

    x^s_k = x_k [+] C (x^s_{k+1} [-] x^-_{k+1})     P^s_k = P_k + C (P^s_{k+1} - P^-_{k+1}) C^T
"""

from __future__ import annotations

import time

import numpy as np
from scipy.linalg.lapack import dposv

from graphnav.dense import dense
from graphnav.errors import EstimationError
from graphnav.problem import Problem
from graphnav.solution import Solution
from graphnav.solvers.passes import (
    Filtered,
    Forward,
    Points,
    Progress,
    Smoothed,
    moved,
    parameters_of,
    residual_record,
    scale_of,
    shift,
)
from graphnav.state import DIM, States


def backward(problem: Problem, forward: Forward, progress: Progress | None = None) -> Smoothed:
    """Smooth a forward pass."""
    K, D = forward.P.shape[:2]
    about, before = forward.about, forward.predicted
    n = 0 if about is None else len(about.values)
    states: list[States] = []
    all_P, all_values, errors = np.empty((K, D, D)), np.empty((K, D - DIM)), np.zeros((n, D))
    state, values, P = forward.states[K - 1 : K], forward.values[-1], forward.P[-1]
    for k in range(K - 1, -1, -1):
        if k < K - 1:
            Pp, at = forward.P_predicted[k + 1], slice(k, k + 1)
            _, gain, info = dposv(Pp, forward.F[k] @ forward.P[k])
            if info:
                raise EstimationError(f"the smoother's covariance broke down at {problem.t[k]:.3f} s: check the sigmas")
            C = gain.T
            if k + 1 < n:  # both ends are steps from points, and only such steps add up
                errors[k] = forward.errors[k] + C @ (errors[k + 1] - forward.errors_predicted[k + 1])
            else:
                ahead = slice(k + 1, k + 2)
                d = C @ np.concatenate([state.minus(before.states[ahead])[0], values - before.values[k + 1]])
                state, values = forward.states[at].plus(d[None, :DIM]), forward.values[k] + d[DIM:]
            P = forward.P[k] + C @ (P - Pp) @ C.T
            P = 0.5 * (P + P.T)
        if k >= n - 1:
            states.append(state)
            all_values[k] = values
        if about is not None and k == n - 1:
            errors[k] = np.concatenate([state.minus(about.states[k : k + 1])[0], values - about.values[k]])
        all_P[k] = P
        if progress is not None and k % 256 == 0:
            progress("smoother", 1.0 - k / K)
    if about is not None and n > 1:
        first = moved(Points(about.states[: n - 1], about.values[: n - 1]), errors[:-1])
        states.append(first.states)
        all_values[: n - 1] = first.values
    return Smoothed(States.stack(states[::-1]), all_values, all_P)


def rts(problem: Problem, forward: Filtered, found: Smoothed | None = None) -> Solution:
    """The smoothed solution; residuals are its own. `found` is the backward pass where it was done before."""
    began = time.perf_counter()
    found = found or backward(problem, forward)
    smoothed, all_values, all_P = found.states, found.values, found.P
    chains = {c.parameter.name: all_values[:, shift(problem.columns[c.parameter.name])] for c in problem.chains}
    records = {rows.name: residual_record(problem, rows, smoothed, chains) for rows in problem.constraints}
    seconds = time.perf_counter() - began
    return Solution(
        solver="rts",
        frame=problem.frame,
        t=problem.t,
        states=smoothed,
        covariance=all_P[:, :DIM, :DIM],
        parameters=parameters_of(problem, all_values, all_P),
        records=records,
        counts=forward.solution.counts,
        iterations=1,
        stopped="one pass forward and one back",
        timings={**forward.solution.timings, "smoother": seconds},
        notes=problem.notes,
        between=(dense(problem, smoothed, all_P[:, :DIM, :DIM], scale_of(problem, all_values), smooth=True),),
    )
