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
    Progress,
    Smoothed,
    parameters_of,
    residual_record,
    scale_of,
    shift,
)
from graphnav.state import DIM, States


def backward(problem: Problem, forward: Forward, progress: Progress | None = None) -> Smoothed:
    """Smooth a forward pass."""
    K, D = forward.P.shape[:2]
    about = forward.about
    n = 0 if about is None else len(about.values)
    state, values, P = forward.states[-1], forward.values[-1], forward.P[-1]
    states: list[States] = [state]
    all_P, all_values = np.empty((K, D, D)), np.empty((K, D - DIM))
    all_P[-1], all_values[-1] = P, values
    for k in range(K - 2, -1, -1):
        Pp = forward.P_predicted[k + 1]
        _, gain, info = dposv(Pp, forward.F[k] @ forward.P[k])
        if info:
            raise EstimationError(f"the smoother's covariance broke down at {problem.t[k]:.3f} s: check the sigmas")
        C = gain.T
        moved = np.concatenate([state.minus(forward.predicted[k + 1])[0], values - forward.values_predicted[k + 1]])
        at, at_values, e = forward.states[k], forward.values[k], np.zeros(D)
        if about is not None and k + 1 < n:
            # both ends are steps from points, and only such steps add up
            before = about.offset(k + 1, forward.predicted[k + 1], forward.values_predicted[k + 1])
            moved, e = about.offset(k + 1, state, values) - before, about.offset(k, at, at_values)
            at, at_values = about.at(k)
        d = e + C @ moved
        state, values = at.plus(d[None, :DIM]), at_values + d[DIM:]
        P = forward.P[k] + C @ (P - Pp) @ C.T
        P = 0.5 * (P + P.T)
        states.append(state)
        all_P[k], all_values[k] = P, values
        if progress is not None and k % 256 == 0:
            progress("smoother", 1.0 - k / K)
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
