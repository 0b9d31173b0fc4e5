"""A recorded drive through GTSAM's iSAM2, keyframe by keyframe: its own answer, live and settled.

The rows are those of every solver; the tree is that of `graphnav.estimation.solvers.tree`. With a lag, keyframes older
than it are settled and marginalised; without one, the whole drive is relinearised until nothing moves any more.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.incremental import Replay, assemble_replay, begin_at, replay
from graphnav.estimation.solvers.passes import Progress
from graphnav.estimation.solvers.stages import Message, Place
from graphnav.estimation.solvers.tree import Tree
from graphnav.estimation.solvers.tree_marginals import newest_covariance, smooth_keyframes
from graphnav.estimation.solvers.window import SettledStates, turn_limit

_SKIP = 10  # keyframes between two looks at what has moved, as GTSAM's relinearizeSkip
_PORTIONS = 8  # of the lag: keyframes settle in groups this long, as in the window
_FINE = 0.02  # of the usual limits, within which the whole drive is converged
_ROUNDS = 30


def isam2(
    problem: Problem,
    lag: float = np.inf,
    progress: Progress | None = None,
    start: States | None = None,
) -> Replay:
    """Solve a problem keyframe by keyframe with iSAM2.

    Parameters
    ----------
    lag : s of future that every settled state has seen; infinite smooths the whole drive.
    start : one state to begin at, where that is not the prior's mean.
    """
    began = time.perf_counter()
    tree = Tree(begin_at(problem, start), turn_limit(problem.imu_noise))
    settled: list[SettledStates] = []
    posed = problem

    def add(place: Place) -> tuple[Message, Array]:
        nonlocal problem
        turn = tree.add(replace(place, problem=problem))
        if turn > tree.turn or place.k % _SKIP == 0:
            tree.relinearise()
        oldest = tree.keyframes[0].place
        if place.t - oldest.t > lag * (1.0 + 1.0 / _PORTIONS):
            count = int(np.searchsorted(problem.t[: place.k], place.t - lag)) - oldest.k
            problem, _ = tree.integrate_again(problem)
            settled.append(smooth_keyframes(tree, count))
            tree.marginalise(count)
        return tree.newest, newest_covariance(tree)

    live = replay(posed, "isam2", add, progress)
    for _ in range(_ROUNDS):
        problem, again = tree.integrate_again(problem)
        if not tree.relinearise(_FINE) and not again:
            break
    settled.append(smooth_keyframes(tree, len(tree)))
    return assemble_replay(problem, "isam2", settled, live, tree.relinearised, time.perf_counter() - began, lag)
