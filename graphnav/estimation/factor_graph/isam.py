"""A recorded drive solved by GTSAM's iSAM2, keyframe by keyframe: its own settled estimates.

The rows are those of every solver; the tree is that of `graphnav.estimation.factor_graph.tree`. With a lag, keyframes
older than it are settled and marginalised; without one, the whole drive is relinearised until nothing moves any more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.core.progress import Progress
from graphnav.core.state import States
from graphnav.estimation.factor_graph.tree import Tree
from graphnav.estimation.factor_graph.tree_marginals import (
    Elimination,
    begin_elimination,
    eliminate,
    settle,
)
from graphnav.estimation.factor_graph.tree_whole import WholeTree
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.incremental import FINE, are_due, begin_at, solve_in_turn
from graphnav.estimation.solvers.stages import Message, Place
from graphnav.estimation.solvers.window import SettledStates, compute_turn_limit

_SKIP = 10  # least number of keyframes between relinearisation checks, as GTSAM's relinearizeSkip
# the cost of a check is proportional to the keyframes in the tree: one follows when there are a part in this many more
_GROWN = 8
_SHARE_OF_TIME = 4  # covariances are eliminated in one part in this many of the time between settlings
_MAX_UPDATES = 30


class TreeSmoother:
    """Keyframes in a `Tree`, as a `LagSmoother`.

    Parameters
    ----------
    prior : message on the first keyframe.
    problem : that all keyframes are of; its intervals are integrated again where biases have moved too far.
    lag : s of future that every settled state has seen; infinite smooths the whole drive.
    """

    def __init__(self, prior: Message, problem: Problem, lag: float) -> None:
        self.tree = (WholeTree if np.isinf(lag) else Tree)(prior, compute_turn_limit(problem.imu_noise))
        self.lag = lag
        self.settled: list[SettledStates] = []
        self._problem = problem
        self._look = _SKIP  # the keyframe of the next relinearisation check
        self._leaving: Elimination | None = None  # elimination for the keyframes to settle
        self._portion = 0  # variables eliminated for that per keyframe

    def add(self, place: Place) -> None:
        """As of `LagSmoother`."""
        tree = self.tree
        turn = tree.add(replace(place, problem=self._problem))
        look = turn > tree.turn or (place.k >= self._look and self._leaving is None)
        if self._leaving is not None:
            before, self._leaving = self._leaving, eliminate(tree, self._leaving, self._portion)
            if look or self._leaving is before:
                self._drop_leaving(self._leaving)
        if look:
            tree.relinearise()
            self._look = place.k + max(_SKIP, len(tree) // _GROWN)
        oldest = tree.keyframes[0].place
        if self._leaving is None and are_due(oldest.t, place.t, self.lag):
            self._problem, _ = tree.integrate_again(self._problem)
            count = int(np.searchsorted(self._problem.t[: place.k], place.t - self.lag)) - oldest.k
            self._leaving = begin_elimination(tree, count)
            self._portion = 1 + _SHARE_OF_TIME * len(self._leaving.behind) // count

    def _drop_leaving(self, leaving: Elimination) -> None:
        """Let its keyframes go."""
        self.settled.append(settle(self.tree, leaving))
        self.tree.marginalise(leaving.count)
        self._leaving = None

    def finish(self, problem: Problem) -> tuple[Problem, int]:
        """As of `LagSmoother`."""
        if self._leaving is not None:
            self._drop_leaving(self._leaving)
        for _ in range(_MAX_UPDATES):
            self._problem, again = self.tree.integrate_again(self._problem)
            if not self.tree.relinearise(FINE) and not again:
                break
        self.settled.append(settle(self.tree, begin_elimination(self.tree, len(self.tree))))
        return self._problem, self.tree.relinearised


def isam2(
    problem: Problem,
    lag: float = np.inf,
    progress: Progress | None = None,
    start: States | None = None,
) -> Solution:
    """Solve a problem keyframe by keyframe with iSAM2.

    Parameters
    ----------
    lag : s of future that every settled state has seen; infinite smooths the whole drive.
    start : one state to begin at, where that is not the prior's mean.
    """
    return solve_in_turn(problem, "isam2", TreeSmoother(begin_at(problem, start), problem, lag), lag, progress)
