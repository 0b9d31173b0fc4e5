"""Covariances of a `graphnav.estimation.factor_graph.tree.Tree`, all of errors about the estimates.

The newest keyframe is in the root of GTSAM's Bayes tree, where a marginal costs next to nothing. Deep in the tree a
marginal is computed clique by clique from the root, again after each update. So covariances of the oldest keyframes are
found by eliminating the tree's factors from the other end, the newest first, which leaves the marginal of the oldest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.factor_graph.gaussian import Eliminated
from graphnav.estimation.factor_graph.tree import Tree
from graphnav.estimation.factor_graph.tree_nodes import Keyframe, Variable, fill_keys, read_states
from graphnav.estimation.solvers.breakdown import explain_undetermined
from graphnav.estimation.solvers.linearise import shift
from graphnav.estimation.solvers.points import move_covariance
from graphnav.estimation.solvers.stages import Message
from graphnav.estimation.solvers.window import SettledStates

_AT_ONCE = 45  # variables: GTSAM's bookkeeping of one elimination grows faster than what it eliminates


def _map_errors(keyframe: Keyframe, J: Array) -> dict[int, Array]:
    """(D, w) by key: errors about a keyframe's estimate by those about anchors, of which J (3, 3) turns attitudes."""
    D = DIM + len(keyframe.values)
    out = {x.key: np.zeros((D, len(x.unit))) for x in keyframe.variables}
    out[keyframe.state.key][:DIM] = np.eye(DIM)
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
    later = {i for k in tree.keyframes[1:] for i in k.slots.values()}
    factors, point, rows = tree.isam.getFactorsUnsafe(), tree.isam.getLinearizationPoint(), []
    for i in range(factors.size()):
        one = factors.at(i)
        if i not in later and one is not None and own.keys() >= set(one.keys()):
            linear = gtsam.JacobianFactor(one.linearize(point))
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


@dataclass(frozen=True)
class Elimination:
    """Elimination of all later keyframes of a tree, in progress or complete, for the marginal of the oldest."""

    first: int  # keyframes from here
    count: int  # to here
    version: int  # of the tree when it began
    behind: tuple[Variable, ...]  # still to be eliminated
    own: tuple[Variable, ...]  # those of the keyframes
    graph: gtsam.GaussianFactorGraph
    net: gtsam.GaussianBayesNet | None = None  # of the keyframes' own, at the end


def begin_elimination(tree: Tree, count: int, first: int = 0) -> Elimination:
    """Nothing eliminated yet, of the first `count` keyframes, or those of them from `first` on."""
    tree.read()
    behind = tree.keyframes[count].number if count < len(tree) else np.inf
    variables = tree.variables.values()
    return Elimination(
        first,
        count,
        tree.version,
        tuple(sorted((x for x in variables if x.first >= behind), key=lambda x: x.first)),
        tuple(sorted((x for x in variables if x.first < behind), key=lambda x: x.last)),
        tree.isam.getFactorsUnsafe().linearize(tree.isam.getLinearizationPoint()),
    )


def eliminate(tree: Tree, so_far: Elimination, most: int) -> Elimination:
    """At most so many variables of the keyframes behind eliminated, and at last those that leave; then it is the same.

    Keyframes added since it began do not count; after a relinearisation it starts again.
    """
    if tree.version != so_far.version:
        so_far = begin_elimination(tree, so_far.count, so_far.first)
    if so_far.behind:
        order = fill_keys(gtsam.Ordering(), reversed(so_far.behind[-most:]))
        graph = so_far.graph.eliminatePartialSequential(order, gtsam.EliminateQR)[1]
        return replace(so_far, behind=so_far.behind[:-most], graph=graph)
    if so_far.net is None:
        order = fill_keys(gtsam.Ordering(), so_far.own)
        return replace(so_far, net=so_far.graph.eliminateSequential(order, gtsam.EliminateQR))
    return so_far


def settle(tree: Tree, so_far: Elimination) -> SettledStates:
    """States and parameters as they are known now, and covariances, all at once of what is left to be done."""
    own = tree.keyframes[so_far.first : so_far.count]
    try:
        while (further := eliminate(tree, so_far, _AT_ONCE)) is not so_far:
            so_far = further
    except RuntimeError:  # GTSAM's for a variable that nothing determines
        raise explain_undetermined(own[0].place.t) from None
    assert so_far.net is not None
    tree.read()
    found = Eliminated(so_far.net).compute_covariances()
    marginal = {x.key: x.unit[:, None] * found[x.key] * x.unit for x in so_far.own}
    values, sigma = tuple(k.values for k in own), []
    for k, known in zip(own, values, strict=True):
        out = np.zeros(len(known))
        for name, at in k.columns.items():
            node, part = k.nodes[name]
            out[shift(at)] = np.sqrt(np.maximum(np.diag(marginal[node.key])[part], 0.0))
        sigma.append(out)
    about = np.stack([marginal[k.state.key] for k in own])
    return SettledStates(
        t=np.array([k.place.t for k in own]),
        states=read_states(own),
        covariance=move_covariance(about, np.array([k.state.delta for k in own])),
        columns=tuple(k.columns for k in own),
        values=values,
        sigma=tuple(sigma),
    )
