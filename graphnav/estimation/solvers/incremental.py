"""Incremental fixed-lag smoother: the batch problem, solved keyframe by keyframe.

`Incremental` takes the keyframes of a problem one by one. After each, keyframes older than the lag
settle, each with at least the lag's future measurements. The algorithm is that of
`graphnav.estimation.solvers.window`; `graphnav.online` feeds it from sensors instead of a recording.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.core.notes import Note, format_count
from graphnav.core.progress import Progress
from graphnav.core.state import States
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.linearise import Points, list_node_steps, scale_at, shift
from graphnav.estimation.solvers.passes import integrate_again, make_solution, record_residuals
from graphnav.estimation.solvers.rows import compute_cost_at
from graphnav.estimation.solvers.stages import Message, Place
from graphnav.estimation.solvers.window import SettledStates, Window, compute_turn_limit, make_first_message

_PORTIONS = 8  # of the lag: keyframes settle in groups this long
# a look at what has moved of a whole drive costs as much as there are keyframes: the next one follows when there are a
# part in this many more, and at least so many
_GROWN, _LEAST = 8, 10
_SHORT = 2  # portions of a window over which covariances are smoothed all at once
_MAX_INTEGRATIONS = 5  # computing: rounds of integrating about the present biases and relinearising
# shares of the usual limits within which keyframes have converged that settle, as they are not linearised again
_SETTLING, _FINE = 0.25, 0.02  # and all that remain at the end


def are_due(first: float, last: float, lag: float) -> bool:
    """Whether of keyframes between two times (s) a group is older than a lag, which then settles."""
    return last - first > lag * (1.0 + 1.0 / _PORTIONS)


@dataclass
class Incremental:
    """Fixed-lag smoothing of keyframes as they come.

    Parameters
    ----------
    window : with its prior.
    problem : that all keyframes are of; where biases have moved too far, its intervals are integrated again.
    lag : s of future that every settled state has seen; infinite smooths everything, and settles at the end.
    """

    window: Window
    problem: Problem
    lag: float = 120.0
    settled: list[SettledStates] = field(default_factory=list)  # in order; readers may clear them
    due: int = 0  # keyframes that settle next
    look: float = _LEAST  # keyframes at which what has moved of a whole drive is looked at next

    def add(self, place: Place) -> None:
        """Add a keyframe, and settle those that are older than the lag by then: those of a large window in portions,
        as they were known then, ahead of the following keyframes.
        """
        window = self.window
        if self.due and window.smooth_back(self.due, window.smoothed):
            self._settle()
        grown = np.isinf(self.lag) and len(window) >= self.look
        if window.push(replace(place, problem=self.problem)) > window.turn or grown:
            window.converge(renewed=self._renew)
            self.look = len(window) + max(_LEAST, len(window) // _GROWN)
        if not self.due and are_due(window.stages[0].place.t, place.t, self.lag):
            self.due = int(np.searchsorted(window.t, place.t - self.lag))
            self._converge(self.due, _SETTLING, any(c.robust != "none" for c in self.problem.constraints))
            if len(window) <= _SHORT * window.smoothed:
                self._settle()

    def _settle(self) -> None:
        self.settled.append(self.window.settle(self.due))
        self.due = 0

    def finish(self) -> None:
        """End of input: settle all."""
        if len(self.window):
            self.due = len(self.window)
            self._converge(self.due, _FINE, always=True)
            self._settle()

    def _converge(self, count: int, share: float, always: bool = False) -> None:
        """Relinearise until nothing has moved, about intervals integrated at the present biases, for the first stages
        to settle.
        """
        window, newest = self.window, self.window.newest
        for _ in range(_MAX_INTEGRATIONS):
            states, scale = window.read_states(), scale_at(newest.columns, newest.values)
            self.problem, again = integrate_again(self.problem, states, scale, window.stages[0].place.k)
            if always or again > 0 or window.needs_revision(share, count):
                window.converge(share, always or again > 0, self._renew)
            if not again:
                return

    def _renew(self, first: int, end: int) -> list[Place]:
        return [replace(stage.place, problem=self.problem) for stage in self.window.stages[first:end]]


def incremental(
    problem: Problem,
    lag: float = 120.0,
    progress: Progress | None = None,
    start: States | None = None,
    engine: type[Window] = Window,
) -> Solution:
    """Solve a problem keyframe by keyframe.

    Parameters
    ----------
    lag : s, see `Incremental`.
    start : one state to begin at, where that is not the prior's mean.
    """
    window = engine(begin_at(problem, start), compute_turn_limit(problem.imu_noise))
    return solve_in_turn(Incremental(window, problem, lag), progress)


def begin_at(problem: Problem, start: States | None) -> Message:
    """The prior of a problem, about its mean or one state to begin at."""
    assert problem.prior.mean is not None
    message = make_first_message(problem.prior.mean, problem.prior.sigma[0])
    return message if start is None else message.move(start.minus(problem.prior.mean)[0])


def solve_in_turn(engine: Incremental, progress: Progress | None) -> Solution:
    """Add all keyframes of a problem in order, and return what settles as a solution."""
    began, problem, solver = time.perf_counter(), engine.problem, engine.window.solver
    K, steps = len(problem.t), list_node_steps(problem)
    seconds = np.empty(K)  # processor time of the thread
    for k in range(K):
        before = time.thread_time()
        engine.add(Place(float(problem.t[k]), problem, k, steps.get(k, ()), linked=k > 0))
        seconds[k] = time.thread_time() - before
        if progress is not None and k % 64 == 0:
            progress(solver, k / K)
    engine.finish()
    problem, lag, again = engine.problem, engine.lag, engine.window.relinearized
    elapsed = time.perf_counter() - began
    # in the order that the problem has its parameters in
    parts, columns = engine.settled, engine.settled[-1].columns[-1]
    order = np.concatenate([np.empty(0, dtype=int), *(np.r_[shift(columns[name])] for name in problem.columns)])
    values = np.array([row for part in parts for row in part.values])[:, order]
    sigma = np.array([row for part in parts for row in part.sigma])[:, order]
    states = States.stack([part.states for part in parts])
    covariance = np.concatenate([part.covariance for part in parts])
    at = Points(states, values)
    records = {rows.name: record_residuals(problem, rows, at, robust=True) for rows in problem.constraints}
    whole = "all there was" if np.isinf(lag) else f"{lag:g} s of the future, or all there was"
    middle, high, most = 1e3 * np.quantile(seconds, [0.5, 0.99, 1.0])
    took = f"a keyframe took {middle:.1f} ms (median), {high:.1f} ms (99 %), {most:.0f} ms (most)"
    notes = (
        Note("solver.step_times", ("" if np.isinf(lag) else f"lag {lag:g} s: ") + took),
        Note("solver.relinearised", f"{format_count(again, 'keyframe')} relinearised"),
    )
    return make_solution(
        problem, solver, at, covariance, sigma, notes=notes, records=records,
        iterations=1, cost=compute_cost_at(problem, at), stopped=f"every keyframe settled with {whole}",
        timings={solver: elapsed},
    )  # fmt: skip
