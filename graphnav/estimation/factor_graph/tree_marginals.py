"""Covariances of a `graphnav.estimation.factor_graph.tree.Tree`, all of errors about the estimates.

The newest keyframe is in the root of GTSAM's Bayes tree, where a marginal costs next to nothing. Deep in the tree a
marginal is computed clique by clique from the root, again after each update. So covariances of the oldest keyframes are
found by eliminating the tree's factors from the other end, the newest first, which leaves the marginal of the oldest.
The next elimination goes through most of the same keyframes: what blocks of them say of those around them is kept.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.factor_graph.gaussian import Eliminated
from graphnav.estimation.factor_graph.tree import Tree
from graphnav.estimation.factor_graph.tree_nodes import Block, Keyframe, fill_keys, read_states
from graphnav.estimation.solvers.breakdown import explain_undetermined
from graphnav.estimation.solvers.linearise import shift
from graphnav.estimation.solvers.points import move_covariance
from graphnav.estimation.solvers.stages import Message
from graphnav.estimation.solvers.window import SettledStates

_BLOCK = 12  # keyframes between two that stay
_AT_ONCE = 48  # variables: GTSAM's bookkeeping of one elimination grows faster than what it eliminates


def _map_errors(keyframe: Keyframe, J: Array) -> dict[int, Array]:
    """(D, w) by key: errors about a keyframe's estimate by those about anchors, of which J (3, 3) turns attitudes."""
    D = DIM + len(keyframe.values)
    out = {x.key: np.zeros((D, len(x.unit))) for x in keyframe.variables}
    out[keyframe.state.key][:DIM, :DIM] = np.eye(DIM)
    out[keyframe.state.key][:3, :3] = J
    for name, at in keyframe.columns.items():
        node, own = keyframe.nodes[name]
        out[node.key][at, own] = np.eye(at.stop - at.start)
    return out


def compute_newest_root(tree: Tree) -> Array:
    """(D, D) R, a triangle: R e are the whitened errors of the newest keyframe and its parameters."""
    last = tree.keyframes[-1]
    into = _map_errors(last, rotation.right_jacobian(last.state.delta[None, :3])[0])
    joint, unit = tree.isam.jointMarginalCovariance(list(into)), {key: tree.variables[key].unit for key in into}
    P = sum((A * unit[a]) @ joint.at(a, b) @ (B * unit[b]).T for a, A in into.items() for b, B in into.items())
    # of correlations, so that gyro bias and position have the same number of digits
    sd = np.sqrt(np.diag(P))
    w, V = np.linalg.eigh(P / sd[:, None] / sd)
    return np.asarray(np.linalg.qr((V / np.sqrt(np.maximum(w, np.finfo(float).eps))).T, "r") / sd)


def find_head(tree: Tree) -> Message:
    """What the first keyframe and all before it say of its state and parameters, about where these are now.

    From the factors themselves: a covariance of ambiguities and clocks, known to kilometres each and to millimetres
    together, loses what tells them apart.
    """
    first = tree.keyframes[0]
    into = _map_errors(first, rotation.right_jacobian_inverse(first.state.delta[None, :3])[0].T)
    own = {x.key: x for x in tree.variables.values() if x.first <= first.number}
    edge = dict(zip(own, np.cumsum([0, *(len(x.unit) for x in own.values())]).tolist(), strict=False))
    unit, delta = (np.concatenate([getattr(x, name) for x in own.values()]) for name in ("unit", "delta"))
    later, index = {i for k in tree.keyframes[1:] for i in k.slots.values()}, tree.isam.getVariableIndex()
    factors, point, rows = tree.isam.getFactorsUnsafe(), tree.isam.getLinearizationPoint(), []
    for i in sorted({i for key in own for i in index.at(key)} - later):
        if own.keys() >= set(factors.at(i).keys()):
            linear = gtsam.JacobianFactor(factors.at(i).linearize(point))
            A, b = linear.jacobian()
            row = np.zeros((len(b), len(unit) + 1))
            row[:, np.concatenate([edge[k] + np.arange(len(own[k].unit)) for k in list(linear.keys())])] = A
            row[:, -1] = b
            rows.append(row)
    table = np.concatenate(rows)
    A, b = table[:, :-1] / unit, table[:, -1:]
    known = np.concatenate([into[key].T for key in own])
    gone = ~known.any(axis=1)  # parameters that began anew
    R = np.asarray(np.linalg.qr(np.hstack([A[:, gone], A @ known, b - A @ delta[:, None]]), "r"))
    own_rows = slice(gone.sum(), gone.sum() + known.shape[1])
    return Message(first.estimate, first.values, first.columns, R[own_rows, own_rows], R[own_rows, -1])


def _find_blocks(tree: Tree, edge: float) -> list[Block]:
    """Blocks of a tree's keyframes behind number `edge`, those that it has and new ones."""
    newest, begin, out = tree.keyframes[-1].number, edge, list[Block]()
    known = sorted((block for block in tree.blocks if block.first >= edge), key=lambda block: block.first)
    index, variables = tree.isam.getVariableIndex(), list(tree.variables.values())
    for block in (*known, None):
        until = newest if block is None else block.first
        while until - begin >= _BLOCK:
            end = int(begin) + _BLOCK
            own = [x for x in reversed(variables) if x.first > begin and x.last < end]
            slots = {i for x in own for i in index.at(x.key)}
            out.append(Block(int(begin), end, own, slots, tree.linearise(slots)))
            begin = end
        if block is not None:
            out.append(block)
            begin = block.last
    return out


class Elimination:
    """Elimination of all keyframes of a tree behind some of the oldest, in portions, for the marginal of these.

    It is of the tree as it was when it began: keyframes added since, and rows linearised again, do not count.

    Parameters
    ----------
    count, first : the keyframes are the first `count`, or those of them from `first` on.
    """

    def __init__(self, tree: Tree, count: int, first: int = 0) -> None:
        tree.read()
        self.count, self._keyframes = count - first, tree.keyframes[first:count]
        self._states, self._values = read_states(self._keyframes), tuple(k.values for k in self._keyframes)
        self._moved = np.array([k.state.delta[:DIM] for k in self._keyframes])
        edge = tree.keyframes[count].number if count < len(tree) else np.inf
        variables = sorted(tree.variables.values(), key=lambda x: x.first)
        self._own = sorted((x for x in variables if x.first < edge), key=lambda x: x.last)
        tree.blocks = _find_blocks(tree, edge)
        inside = {x.key for block in tree.blocks for x in block.variables}
        self._behind = [x for x in variables if x.first >= edge and x.key not in inside]
        slots = set[int]().union(*(block.slots for block in tree.blocks))
        self._graph = tree.linearise(i for i in range(tree.isam.getFactorsUnsafe().size()) if i not in slots)
        self._waiting = [block for block in tree.blocks if not block.done]
        for block in tree.blocks:
            if block.done:
                self._graph.push_back(block.graph)
        self._net: gtsam.GaussianBayesNet | None = None  # of those that leave
        self._found: dict[int, Array] = {}  # covariances by variable, in its units

    def step(self, most: int = _AT_ONCE) -> bool:
        """Eliminate a block, or at most so many variables of the keyframes behind, and at last those that leave; True
        once all is done.
        """
        if self._waiting:
            block = self._waiting.pop()
            block.eliminate()
            self._graph.push_back(block.graph)
        elif self._behind:
            portion = slice(-min(most, _AT_ONCE), None)
            order = fill_keys(gtsam.Ordering(), reversed(self._behind[portion]))
            self._graph = self._graph.eliminatePartialSequential(order, gtsam.EliminateQR)[1]
            del self._behind[portion]
        elif self._found:
            return True
        elif self._net is None:
            self._net = self._graph.eliminateSequential(fill_keys(gtsam.Ordering(), self._own), gtsam.EliminateQR)
        else:
            self._found = Eliminated(self._net).compute_covariances()
        return False

    def __getstate__(self) -> dict[str, Any]:
        """With all done, for which the graph is no longer needed."""
        done = object.__new__(Elimination)
        done.__dict__.update(self.__dict__, _behind=list(self._behind), _waiting=list(self._waiting))
        if not self._found:
            done._graph = self._graph.clone()  # blocks are added to it
        while not done.step():
            pass
        return {**done.__dict__, "_graph": None, "_net": None}

    def settle(self) -> SettledStates:
        """States, parameters and covariances, all at once of what is left to be done."""
        own = self._keyframes
        try:
            while not self.step():
                pass
        except RuntimeError:  # GTSAM's for a variable that nothing determines
            raise explain_undetermined(own[0].t) from None
        marginal, sigma = {x.key: x.unit[:, None] * self._found[x.key] * x.unit for x in self._own}, []
        sd = {key: np.sqrt(np.maximum(np.diagonal(P), 0.0)) for key, P in marginal.items()}
        for k, known in zip(own, self._values, strict=True):
            out = np.zeros(len(known))
            for name, at in k.columns.items():
                node, part = k.nodes[name]
                out[shift(at)] = sd[node.key][part]
            sigma.append(out)
        return SettledStates(
            t=np.array([k.t for k in own]),
            states=self._states,
            covariance=move_covariance(np.stack([marginal[k.state.key][:DIM, :DIM] for k in own]), self._moved),
            columns=tuple(k.columns for k in own),
            values=self._values,
            sigma=tuple(sigma),
        )
