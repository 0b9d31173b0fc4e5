"""Covariances from the Bayes tree of a `graphnav.estimation.solvers.tree.Tree`, all of errors about the estimates."""

from __future__ import annotations

import numpy as np

from graphnav.core import rotation
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.solvers.linearise import Columns, shift
from graphnav.estimation.solvers.points import move_covariance
from graphnav.estimation.solvers.tree import Tree
from graphnav.estimation.solvers.tree_nodes import Variable, states_of
from graphnav.estimation.solvers.window import SettledStates


def newest_covariance(tree: Tree) -> Array:
    """(15, 15) of the newest state."""
    last = tree.keyframes[-1]
    return move_covariance(_marginal(tree, last.state, last.place.t), last.state.delta)


def newest_root(tree: Tree, columns: Columns) -> Array:
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


def smooth_keyframes(tree: Tree, count: int, first: int = 0) -> SettledStates:
    """The first `count` keyframes of a tree as they are known now, or those of them from `first` on."""
    own = tree.keyframes[first:count]
    marginal: dict[int, Array] = {}
    for k in own:
        for x in (k.state, *(node for node, _ in k.nodes.values())):
            if x.key not in marginal:
                marginal[x.key] = _marginal(tree, x, k.place.t)
    delta = np.array([k.state.delta for k in own])
    covariance = move_covariance(np.stack([marginal[k.state.key] for k in own]), delta)
    sigma = []
    for k in own:
        out = np.zeros(len(k.values))
        for name, at in k.columns.items():
            node, part = k.nodes[name]
            out[shift(at)] = np.sqrt(np.maximum(np.diag(marginal[node.key])[part], 0.0))
        sigma.append(out)
    return SettledStates(
        t=np.array([k.place.t for k in own]),
        states=states_of(own),
        covariance=covariance,
        columns=tuple(k.columns for k in own),
        values=tuple(k.values for k in own),
        sigma=tuple(sigma),
    )


def _marginal(tree: Tree, x: Variable, t: float) -> Array:
    try:
        found = tree.isam.marginalCovariance(x.key)
    except RuntimeError:
        raise EstimationError(
            f"the data leave something undetermined at {t:.3f} s: there is no covariance", key="solver.undetermined"
        ) from None
    return np.asarray(x.unit[:, None] * found * x.unit)
