"""A problem solved keyframe by keyframe, with what was live after each of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from graphnav.core.progress import Progress
from graphnav.core.state import DIM, States
from graphnav.estimation.factor_graph.tree_window import TreeWindow
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.incremental import Incremental, begin_at, solve_in_turn
from graphnav.estimation.solvers.stages import Place
from graphnav.estimation.solvers.window import Window, compute_turn_limit


@dataclass(frozen=True)
class Replay:
    """Settled states, live states, and the processor time of the thread for each keyframe (s)."""

    settled: Solution
    live: Solution
    seconds: np.ndarray


class _Recorded(Incremental):
    """A smoother that keeps its live estimates, with the covariances (15, 15) of their states."""

    def __init__(self, window: Window, problem: Problem, lag: float) -> None:
        super().__init__(window, problem, lag)
        self.states: list[States] = []
        self.covariance: list[np.ndarray] = []
        self.seconds: list[float] = []

    def add(self, place: Place) -> None:
        began = time.thread_time()
        super().add(place)
        newest = self.window.newest
        root = np.linalg.inv(newest.R)[:DIM]
        self.seconds.append(time.thread_time() - began)
        self.states.append(newest.state)
        self.covariance.append(root @ root.T)


def play_window(problem: Problem, lag: float = np.inf, progress: Progress | None = None) -> Replay:
    """By the window."""
    return _play(problem, Window, lag, progress)


def play_isam2(problem: Problem, lag: float = np.inf, progress: Progress | None = None) -> Replay:
    """By GTSAM's iSAM2."""
    return _play(problem, TreeWindow, lag, progress)


def _play(problem: Problem, engine: type[Window], lag: float, progress: Progress | None) -> Replay:
    window = engine(begin_at(problem, None), compute_turn_limit(problem.imu_noise))
    recorded = _Recorded(window, problem, lag)
    settled = solve_in_turn(recorded, progress)
    live = replace(
        settled, solver="live", states=States.stack(recorded.states), covariance=np.array(recorded.covariance)
    )
    return Replay(settled, live, np.array(recorded.seconds))


Play = Callable[[Problem], Replay]
