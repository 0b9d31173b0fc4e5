"""Covariances of a `graphnav.estimation.solvers.tree.Tree`, all of errors about the estimates.

The newest keyframe stands in the root of GTSAM's Bayes tree, where a marginal costs next to nothing. One deep in the
tree it finds clique by clique from the root, and anew after each update. So those of the oldest are found by
eliminating the tree's factors from the other end, the newest first: what is left is all that is known of the oldest.
"""

from __future__ import annotations

import gtsam
import numpy as np

from graphnav.core import rotation
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.solvers.graph import Eliminated
from graphnav.estimation.solvers.linearise import Columns, shift
from graphnav.estimation.solvers.points import move_covariance
from graphnav.estimation.solvers.tree import Tree
from graphnav.estimation.solvers.tree_nodes import fill_keys, states_of
from graphnav.estimation.solvers.window import SettledStates

_AT_ONCE = 45  # variables: GTSAM's bookkeeping of one elimination grows faster than what it eliminates


def compute_newest_covariance(tree: Tree) -> Array:
    """(15, 15) of the newest state."""
    last = tree.keyframes[-1]
    x = last.state
    try:
        found = tree.isam.marginalCovariance(x.key)
    except RuntimeError:
        raise _explain_undetermined(last.place.t) from None
    return move_covariance((x.unit[:, None] * found * x.unit)[None], x.delta[None])[0]


def compute_newest_root(tree: Tree, columns: Columns) -> Array:
    """(D, D) R, a triangle: R e are the whitened errors of the newest keyframe and its parameters."""
    last = tree.keyframes[-1]
    D = DIM + len(last.values)
    variables = list({x.key: x for x in (last.state, *(n for n, _ in last.nodes.values()))}.values())
    joint = tree.isam.jointMarginalCovariance([x.key for x in variables])
    into = {x.key: np.zeros((D, len(x.unit))) for x in variables}
    into[last.state.key][:DIM] = np.eye(DIM)
    into[last.state.key][:3, :3] = rotation.right_jacobian(last.state.delta[None, :3])[0]
    for name, at in columns.items():
        node, own = last.nodes[name]
        into[node.key][at, own] = np.eye(at.stop - at.start)
    P = np.zeros((D, D))
    for a in variables:
        for b in variables:
            A, B = into[a.key] * a.unit, into[b.key] * b.unit
            P += A @ joint.at(a.key, b.key) @ B.T
    # of the correlations, so that a gyro's bias and a place have the same digits
    sd = np.sqrt(np.diag(P))
    w, V = np.linalg.eigh(P / sd[:, None] / sd)
    return np.asarray(np.linalg.qr((V / np.sqrt(np.maximum(w, np.finfo(float).eps))).T, "r") / sd)


class Leaving:
    """Keyframes of a tree as they are known when it begins, with covariances that are found a portion at a time.

    What comes meanwhile does not count; where rows have been linearised anew, it begins anew.

    Parameters
    ----------
    count, first : the first `count` keyframes, or those of them from `first` on.
    """

    def __init__(self, tree: Tree, count: int, first: int = 0) -> None:
        self.count, self.first, self._tree = count, first, tree
        self._begin()

    def _begin(self) -> None:
        tree = self._tree
        tree.changed, self._newest = np.inf, tree.keyframes[-1].number
        self._keyframes = tree.keyframes[self.first : self.count]
        behind = tree.keyframes[self.count].number if self.count < len(tree) else np.inf
        variables = tree.variables.values()
        self._left = sorted((x for x in variables if x.first >= behind), key=lambda x: x.first)
        self._own = sorted((x for x in variables if x.first < behind), key=lambda x: x.last)
        self._net: gtsam.GaussianBayesNet | None = None
        self._graph = tree.isam.getFactorsUnsafe().linearize(tree.isam.getLinearizationPoint())
        self.read()

    @property
    def left(self) -> int:
        """Variables that are behind."""
        return len(self._left)

    def read(self) -> None:
        """Take the estimates as they are now."""
        self._tree.read()
        self._delta = np.array([k.state.delta for k in self._keyframes])
        self._states, self._values = states_of(self._keyframes), tuple(k.values for k in self._keyframes)

    def step(self, most: int) -> bool:
        """Eliminate at most so many variables of the keyframes behind, and at last those that leave; True once done."""
        if self._tree.changed <= self._newest:
            self._begin()
        if self._left:
            last, self._left = self._left[-most:], self._left[:-most]
            order = fill_keys(gtsam.Ordering(), reversed(last))
            self._graph = self._graph.eliminatePartialSequential(order, gtsam.EliminateQR)[1]
        elif self._net is None:
            self._net = self._graph.eliminateSequential(fill_keys(gtsam.Ordering(), self._own), gtsam.EliminateQR)
        else:
            return True
        return False

    def settled(self) -> SettledStates:
        """States, parameters and covariances, all at once of what is left to be done."""
        own, marginal = self._keyframes, self._covariances()
        sigma = []
        for k, values in zip(own, self._values, strict=True):
            out = np.zeros(len(values))
            for name, at in k.columns.items():
                node, part = k.nodes[name]
                out[shift(at)] = np.sqrt(np.maximum(np.diag(marginal[node.key])[part], 0.0))
            sigma.append(out)
        return SettledStates(
            t=np.array([k.place.t for k in own]),
            states=self._states,
            covariance=move_covariance(np.stack([marginal[k.state.key] for k in own]), self._delta),
            columns=tuple(k.columns for k in own),
            values=self._values,
            sigma=tuple(sigma),
        )

    def _covariances(self) -> dict[int, Array]:
        try:
            while not self.step(_AT_ONCE):
                pass
        except RuntimeError:  # GTSAM's for a variable that nothing determines
            raise _explain_undetermined(self._keyframes[0].place.t) from None
        assert self._net is not None
        found = Eliminated(self._net).covariances()
        return {x.key: x.unit[:, None] * found[x.key] * x.unit for x in self._own}


def _explain_undetermined(t: float) -> EstimationError:
    return EstimationError(
        f"the data leave something undetermined at {t:.3f} s: there is no covariance", key="solver.undetermined"
    )
