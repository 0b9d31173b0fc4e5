"""What a `tree.Tree` is made of: variables about anchors, keyframes, factors, and their text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from graphnav.core import rotation
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.solvers.graph import jacobian_factor
from graphnav.estimation.solvers.linearise import Columns, shift
from graphnav.estimation.solvers.stages import Place
from graphnav.estimation.solvers.stages import rotate_columns as turned_by

LINK = "imu"  # among the constraints of a keyframe: the interval before it
_WILDFIRE = 1e-3  # of the variables' units: less is not passed on to older ones


@dataclass(eq=False)
class Variable:
    """A node of the tree: errors about an anchor."""

    key: int
    unit: Array  # (w,) of its numbers in the tree
    point: Array  # (w,) where its rows are linearised
    delta: Array  # (w,) as it is known now
    first: int  # number of the first keyframe that touches it
    last: int  # and of the last
    t: float  # s, when it began
    anchor: Array = field(default_factory=lambda: np.zeros(0))  # of parameters
    limit: Array = field(default_factory=lambda: np.zeros(0))  # how far they may move

    @property
    def value(self) -> Array:
        """Parameters as they are known now."""
        return self.anchor + self.delta


@dataclass(eq=False)
class Keyframe:
    number: int
    place: Place
    state: Variable
    anchor: States  # one
    columns: Columns
    nodes: dict[str, tuple[Variable, slice]]  # the node of each parameter in force
    slots: dict[str, list[int]]  # indices of its factors, by constraint

    @property
    def estimate(self) -> States:
        """The state as it is known now."""
        return self.anchor.plus(self.state.delta[None])

    @property
    def values(self) -> Array:
        """(D-15,) parameters as they are known now."""
        out = np.zeros(max((at.stop for at in self.columns.values()), default=DIM) - DIM)
        for name, at in self.columns.items():
            node, own = self.nodes[name]
            out[shift(at)] = node.anchor[own] + node.delta[own]
        return out


def file(keyframe: Keyframe, made: Sequence[tuple[str, Any]], indices: Sequence[int]) -> None:
    """Note where a keyframe's factors are."""
    for (name, _), index in zip(made, indices, strict=True):
        keyframe.slots.setdefault(name, []).append(index)


def fresh_isam() -> gtsam.ISAM2:
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.enableRelinearization = False  # by GTSAM: it has a linear problem
    parameters.findUnusedFactorSlots = True
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(_WILDFIRE))
    return gtsam.ISAM2(parameters)


def update_isam(isam: gtsam.ISAM2, t: float, *change: Any) -> Any:
    try:
        return isam.update(*change)
    except RuntimeError as error:  # GTSAM's for a variable that nothing determines
        raise EstimationError(
            f"the smoother's information broke down at {t:.3f} s: check sigmas and units", key="solver.breakdown"
        ) from error


def factor(blocks: Sequence[tuple[Variable, Array]], b: Array) -> Any:
    """Whitened rows A e = b as a factor of the tree."""
    return gtsam.LinearContainerFactor(jacobian_factor([(x.key, A * x.unit) for x, A in blocks], b))


def rotate_columns(A: Array, d: Array) -> Array:
    """Columns of rows about the anchor moved by d, as columns of the errors about the anchor itself."""
    return turned_by(A, rotation.right_jacobian(d[None, :3])[0]) if d[:3].any() else A


def is_constant(place: Place, name: str) -> bool:
    assert place.problem is not None
    p = place.problem.parameters.get(name)
    return p is not None and p.constant


def units_of(place: Place) -> dict[str, str]:
    assert place.problem is not None
    return {name: p.unit for name, p in place.problem.parameters.items()}


def write_factors(isam: gtsam.ISAM2, variables: Iterable[Variable]) -> list[tuple[int, str]]:
    """The factors of a tree by their indices, as text with all digits."""
    factors, none = isam.getFactorsUnsafe(), gtsam.Values()
    for x in variables:
        none.insert(x.key, np.zeros(len(x.unit)))
    alive = [i for i in range(factors.size()) if factors.at(i) is not None]
    return [(i, gtsam.JacobianFactor(factors.at(i).linearize(none)).serialize()) for i in alive]


def read_factors(rows: Sequence[tuple[int, str]], order: Mapping[Variable, int]) -> tuple[gtsam.ISAM2, dict[int, int]]:
    """A tree made from what was written, and where each factor is now.

    Parameters
    ----------
    order : when each variable is eliminated.
    """
    isam, graph = fresh_isam(), gtsam.NonlinearFactorGraph()
    new, groups = gtsam.Values(), gtsam.KeyGroupMap()
    first = min(order.values(), default=0)
    for x, number in order.items():
        new.insert(x.key, np.zeros(len(x.unit)))
        groups.insert2(x.key, number - first)
    for _, text in rows:
        one = gtsam.JacobianFactor()
        one.deserialize(text)
        graph.push_back(gtsam.LinearContainerFactor(one))
    if not rows:
        return isam, {}
    indices = isam.update(graph, new, [], groups).getNewFactorsIndices()
    return isam, dict(zip((i for i, _ in rows), indices, strict=True))
