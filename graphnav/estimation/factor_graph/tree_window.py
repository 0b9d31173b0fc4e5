"""A window on GTSAM's iSAM2: its keyframes are smoothed, relinearised and marginalised in a tree.

Keyframes are prepared as in `graphnav.estimation.solvers.window`: predicted from a message of the newest keyframe,
innovations tested, robust rows weighted. From then on the tree holds the rows. Settled estimates are its own, and so is
the message of the newest keyframe once the past has been linearised anew; until then that is the filter's, of the same
rows. The keyframe that settled last stays in the tree, so that all behind it can be taken back.

Of a recording, `isam2` smooths the whole drive in one tree, or as it would be online.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphnav.core.progress import Progress
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.factor_graph.tree import Tree
from graphnav.estimation.factor_graph.tree_marginals import Elimination, compute_newest_root, find_head
from graphnav.estimation.factor_graph.tree_nodes import read_states
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.elimination import Predicted
from graphnav.estimation.solvers.incremental import incremental
from graphnav.estimation.solvers.revision import Relaxation, Renewing
from graphnav.estimation.solvers.stages import Message, Place, Stage
from graphnav.estimation.solvers.window import Window

_MAX_STEPS = 5
_LATER = 0.4  # of the usual limits, within which keyframes may wait until they settle
_CONVERGED_SHARE = 0.02  # of the usual limits, within which the last window is converged


class TreeWindow(Window):
    """A window whose estimates are a `Tree`'s."""

    solver = "isam2"
    smoothed = 32

    def __init__(self, prior: Message, turn: float) -> None:
        super().__init__(prior, turn)
        self.tree = Tree(prior, turn)
        self._points: Sequence[Array] = ()  # where `revise` linearises first, error states of the stages

    def _append(self, ahead: Predicted, stage: Stage, e: Array) -> None:
        if not self.tree.keyframes:
            self.tree = Tree(self.head, self.turn)
        if self.stages:  # of those before, the tree knows
            self.stages[-1] = _forget_message(self.stages[-1])
        super()._append(ahead, stage, e)
        self.tree.add(ahead, stage.measured, self.newest)

    def _centre_newest(self) -> None:
        """As of `Window`, by what the tree makes of all of its rows now."""
        if not self.stages:
            super()._centre_newest()
            return
        self.tree.read()
        stage, newest, R = self.stages[-1], self.tree.keyframes[-1], compute_newest_root(self.tree)
        message = replace(stage.message, state=newest.estimate, values=newest.values, R=R, z=np.zeros(len(R)))
        self.stages[-1] = replace(stage, message=message)

    # ------------------------------------------------------------------------------------------- what the tree knows
    def read_states(self) -> States:
        """As of `Window`."""
        self.tree.read()
        return read_states(self.tree.keyframes[self.tree.held :])

    def needs_revision(self, share: float, count: int) -> bool:
        """As of `Window`; those that do not settle yet may have moved further: all since would be eliminated anew."""
        moves = self._find_moves()
        return bool(np.any(moves[:count] > share) or np.any(moves > max(share, _LATER)))

    def _find_moves(self) -> Array:
        if self.stages:
            self.tree.read()
        return self.tree.find_moves()[self.tree.held :]

    def linearise_at(self, means: Sequence[Array]) -> None:
        """As of `Window`."""
        self._points = means

    def revise(self, count: int, renewed: Renewing | None, always: bool = False, share: float = 1.0) -> bool:
        """As of `Window`, but all at once; False, as nothing is left to do."""

        def again(first: int, end: int) -> Sequence[Place]:
            if renewed is None:
                return [stage.place for stage in self.stages[first:end]]
            while (places := renewed(first, end)) is None:
                pass
            return places

        self.tree.read()
        for keyframe, stage, e in zip(self.tree.keyframes[self.tree.held :], self.stages, self._points, strict=False):
            keyframe.put(stage.message.state.plus(e[None, :DIM]), stage.message.values + e[DIM:])
        always, self._points = always or bool(len(self._points)), ()
        if always and self.stages:
            self.tree.linearise_again(range(self.tree.held, len(self.tree)), again)
            self._relinearise_keyframes(len(self))
            share = min(share, _CONVERGED_SHARE)
        relaxation = Relaxation()
        for _ in range(_MAX_STEPS - always if self.stages else 0):
            if not (done := self.tree.relinearise(share, again, relaxation)):
                break
            self._relinearise_keyframes(done)
        return False

    def _begin_leaving(self, count: int) -> Elimination:
        leaving = Elimination(self.tree, self.tree.held + count, self.tree.held)
        if count == len(self.stages):
            self.tree.release()
        return leaving

    def _relinearise_keyframes(self, count: int) -> None:
        self.relinearized += count
        self._centre_newest()

    def truncate(self, keep: int) -> None:
        """As of `Window`."""
        if keep < len(self.stages):
            if keep + self.tree.held:
                self.tree.truncate(keep + self.tree.held)
            else:  # it had only just begun
                self.tree = Tree(self.head, self.turn)
        super().truncate(keep)

    def _marginalise(self, count: int) -> None:
        if len(self.tree) > self.tree.held + count:
            self.tree.marginalise(self.tree.held + count - 1)
            self.tree.held = 1
            self.head = replace(find_head(self.tree), tests=self.head.tests)
        else:
            self.tree = Tree(self.head, self.turn)


def _forget_message(stage: Stage) -> Stage:
    """A stage without what only the newest one needs."""
    none = np.empty((0, 0))
    return replace(stage, message=replace(stage.message, R=none, z=none.ravel()), G=none, C=none, measured=())


def isam2(
    problem: Problem,
    lag: float = np.inf,
    progress: Progress | None = None,
    start: States | None = None,
) -> Solution:
    """Solve a problem keyframe by keyframe with iSAM2, as `incremental` does."""
    return incremental(problem, lag, progress, start, TreeWindow)
