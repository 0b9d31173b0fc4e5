"""Incremental smoother: the graph of the batch solver, solved while the drive happens.

`Incremental` takes the keyframes of a problem one by one. After each it has a live estimate, which knows only what
came before, and keyframes older than the lag settle, each with at least the lag's future in it. See
`graphnav.estimation.solvers.window` for how; `graphnav.online` feeds it from sensors instead of a recording.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.dense import dense
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.linearise import Points, node_steps, scale_at, shift
from graphnav.estimation.solvers.passes import Progress, parameters_of, residual_record
from graphnav.estimation.solvers.rows import cost_at
from graphnav.estimation.solvers.stages import Message, Place
from graphnav.estimation.solvers.window import SettledStates, Window, first_message, turn_limit

_PORTIONS = 8  # of the lag: keyframes settle in groups this long
_FINE = 0.02  # of the usual limits, within which the last window is converged


@dataclass
class Incremental:
    """Fixed-lag smoothing of keyframes as they come.

    Parameters
    ----------
    window : with its prior.
    lag : s of future that every settled state has seen; infinite smooths everything, and settles at the end.
    """

    window: Window
    lag: float = 120.0
    settled: list[SettledStates] = field(default_factory=list)  # whoever reads them may clear them

    def add(self, place: Place) -> None:
        """Take in one more keyframe."""
        turn = self.window.push(place)
        if turn > self.window.turn:
            self.window.converge()
        t = self.window.stages[-1].place.t
        if t - self.window.stages[0].place.t > self.lag * (1.0 + 1.0 / _PORTIONS):
            self.settle_until(t - self.lag)

    def settle_until(self, t: float) -> None:
        """Let go of the keyframes before a time."""
        count = int(np.searchsorted(self.window.t, t))
        if count:
            self.window.converge(always=_robust(self.window))
            self.settled.append(self.window.settle(count))

    def finish(self) -> None:
        """Nothing more will come: settle all."""
        if len(self.window):
            self.window.converge(_FINE, always=True)
            self.settled.append(self.window.settle(len(self.window)))


@dataclass(frozen=True)
class Replay:
    """A whole problem solved incrementally: what settled, what was known live, and what each keyframe took."""

    settled: Solution
    live: Solution
    seconds: Array  # (K,) processor time of the thread per keyframe


def incremental(
    problem: Problem,
    lag: float = 120.0,
    progress: Progress | None = None,
    start: States | None = None,
) -> Replay:
    """Solve a problem keyframe by keyframe.

    Parameters
    ----------
    lag : s, see `Incremental`.
    start : one state to begin at, where that is not the prior's mean.
    """
    began = time.perf_counter()
    solver = Incremental(Window(begin_at(problem, start), turn_limit(problem.imu_noise)), lag)

    def add(place: Place) -> tuple[Message, Array]:
        solver.add(place)
        newest = solver.window.newest
        return newest, newest.covariance[:DIM, :DIM]

    live = replay(problem, "incremental", add, progress)
    solver.finish()
    spent = time.perf_counter() - began
    return assemble_replay(problem, "incremental", solver.settled, live, solver.window.relinearized, spent, lag)


def begin_at(problem: Problem, start: States | None) -> Message:
    """The prior of a problem, about its mean or one state to begin at."""
    assert problem.prior.mean is not None
    message = first_message(problem.prior.mean, problem.prior.sigma[0])
    return message if start is None else message.moved(start.minus(problem.prior.mean)[0])


@dataclass(frozen=True)
class Live:
    """Each keyframe as it was known when it had come, and the processor time that it took."""

    states: States
    P: Array  # (K, 15, 15)
    values: Array  # (K, D-15)
    seconds: Array  # (K,)


def replay(
    problem: Problem, solver: str, add: Callable[[Place], tuple[Message, Array]], progress: Progress | None
) -> Live:
    """Have all keyframes of a problem added in turn.

    `add` gives the newest keyframe as it is known then, and the covariance (15, 15) of its state.
    """
    K, steps = len(problem.t), node_steps(problem)
    states, values, P, seconds = [], [], np.empty((K, DIM, DIM)), np.empty(K)
    for k in range(K):
        before = time.thread_time()
        newest, P[k] = add(Place(float(problem.t[k]), problem, k, steps.get(k, ()), linked=k > 0))
        states.append(newest.state)
        values.append(newest.values)
        seconds[k] = time.thread_time() - before
        if progress is not None and k % 64 == 0:
            progress(solver, k / K)
    return Live(States.stack(states), P, np.array(values), seconds)


def assemble_replay(
    problem: Problem, solver: str, parts: list[SettledStates], live: Live, again: int, spent: float, lag: float
) -> Replay:
    """What an incremental solver has found, as solutions.

    Parameters
    ----------
    parts : what settled, in turn.
    again : how many keyframes were linearised again.
    spent, lag : s
    """
    columns, K = parts[-1].columns[-1], len(problem.t)
    states = States.stack([part.states for part in parts])
    # in the order that the problem has its parameters in
    order = np.concatenate([np.empty(0, dtype=int), *(np.r_[shift(columns[name])] for name in problem.columns)])
    values = np.array([row for part in parts for row in part.values])[:, order]
    sigma = np.array([row for part in parts for row in part.sigma])[:, order]
    covariance = np.concatenate([part.covariance for part in parts])
    points = Points(states, values)
    records = {rows.name: residual_record(problem, rows, points, robust=True) for rows in problem.constraints}
    whole = "all there was" if np.isinf(lag) else f"{lag:g} s of the future, or all there was"
    settled = Solution(
        solver=solver,
        frame=problem.frame,
        t=problem.t,
        states=states,
        covariance=covariance,
        parameters=parameters_of(problem, values, sigma),
        records=records,
        counts={"initial_prior": 1, "imu": K - 1, **{c.name: len(c) for c in problem.constraints}},
        iterations=1,
        cost=cost_at(problem, points),
        stopped=f"every keyframe settled with {whole}",
        timings={solver: spent},
        notes=(
            *problem.notes,
            Note("solver.step_times", ("" if np.isinf(lag) else f"lag {lag:g} s: ") + describe(live.seconds)),
            Note("solver.relinearised", f"{again} keyframes were linearised again"),
        ),
        between=(dense(problem, states, covariance, scale_at(problem.columns, values), smooth=True),),
    )
    now = replace(
        settled,
        solver="live",
        states=live.states,
        covariance=live.P,
        parameters={},
        records={},
        stopped="each keyframe as it was known when it came",
        between=(dense(problem, live.states, live.P, scale_at(problem.columns, live.values[:, order]), smooth=False),),
    )
    return Replay(settled, now, live.seconds)


def _robust(window: Window) -> bool:
    problem = window.stages[-1].place.problem
    return problem is not None and any(c.robust != "none" for c in problem.constraints)


def describe(seconds: Array) -> str:
    """What a keyframe took, in words."""
    middle, high, most = 1e3 * np.quantile(seconds, [0.5, 0.99, 1.0])
    return f"a keyframe took {middle:.1f} ms (median), {high:.1f} ms (99 %), {most:.0f} ms (most)"
