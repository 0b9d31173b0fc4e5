"""A recorded drive through GTSAM's iSAM2, keyframe by keyframe: its own answer, live and settled.

The rows are those of every solver; the tree is that of `graphnav.estimation.solvers.tree`. With a lag, keyframes older than it
are settled and marginalised; without one, the whole drive is relinearised until nothing moves any more.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from graphnav.core.state import DIM, States
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.incremental import Replay, begin_at, replay
from graphnav.estimation.solvers.linearise import node_steps
from graphnav.estimation.solvers.passes import Progress
from graphnav.estimation.solvers.stages import Place
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
    K, steps = len(problem.t), node_steps(problem)
    tree = Tree(begin_at(problem, start), turn_limit(problem.imu_noise))
    settled: list[SettledStates] = []
    live, P, values = [], np.empty((K, DIM, DIM)), []
    seconds = np.empty(K)
    for k in range(K):
        before = time.process_time()
        t = float(problem.t[k])
        turn = tree.add(Place(t, problem, k, steps.get(k, ()), linked=k > 0))
        if turn > tree.turn or k % _SKIP == 0:
            tree.relinearise()
        oldest = tree.keyframes[0].place.t
        if t - oldest > lag * (1.0 + 1.0 / _PORTIONS):
            count = int(np.searchsorted(problem.t[:k], t - lag)) - tree.keyframes[0].place.k
            problem, _ = tree.integrate_again(problem)
            settled.append(smooth_keyframes(tree, count))
            tree.marginalise(count)
        newest = tree.newest
        live.append(newest.state)
        P[k] = newest_covariance(tree)
        values.append(newest.values)
        seconds[k] = time.process_time() - before
        if progress is not None and k % 64 == 0:
            progress("isam2", k / K)
    for _ in range(_ROUNDS):
        problem, again = tree.integrate_again(problem)
        if not tree.relinearise(_FINE) and not again:
            break
    settled.append(smooth_keyframes(tree, len(tree)))
    spent = time.perf_counter() - began
    found = replay(problem, "isam2", settled, States.stack(live), P, np.array(values), seconds, spent, lag)
    notes = (*found.settled.notes, f"{tree.relinearised} keyframes were linearised again")
    return replace(found, settled=replace(found.settled, notes=notes))
