"""Elements of a `tree.Tree`: variables about anchors, keyframes, factors, and their serialisation."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.factor_graph.gaussian import make_jacobian_factor
from graphnav.estimation.solvers.breakdown import explain_smoother
from graphnav.estimation.solvers.linearise import Columns, shift
from graphnav.estimation.solvers.stages import Measured, Place, rotate_columns
from graphnav.estimation.solvers.window import find_parameter_limits

LINK, ROWS = "interval", "rows"  # factors of a keyframe: the interval before it, and all of its measurements together


@dataclass(eq=False)
class Variable:
    """A node of the tree: errors about an anchor."""

    key: int
    unit: Array  # (w,) of its numbers in the tree
    point: Array  # (w,) where its rows are linearised
    delta: Array  # (w,) as it is known now
    anchor: Array  # (w,) of parameters; 0 for a state's, which is its keyframe's
    first: int  # number of the first keyframe that touches it
    last: int  # and of the last
    t: float  # s, when it began
    limit: Array = field(default_factory=lambda: np.zeros(0))  # how far they may move; empty where nothing limits them


Nodes = dict[str, tuple[Variable, slice]]  # the node of each parameter in force


@dataclass(eq=False)
class Keyframe:
    number: int
    t: float  # s
    state: Variable  # its first numbers, before those of nodes that may be in it
    anchor: States  # one
    columns: Columns
    nodes: Nodes
    names: frozenset[str]  # of the constraints that it has rows of
    slots: dict[str, int] = field(default_factory=dict)  # index of each of its factors

    @property
    def estimate(self) -> States:
        """The state as it is known now."""
        return self.anchor.plus(self.state.delta[None, :DIM])

    @property
    def values(self) -> Array:
        """(D-15,) parameters as they are known now."""
        out = np.zeros(max((at.stop for at in self.columns.values()), default=DIM) - DIM)
        for name, at in self.columns.items():
            node, own = self.nodes[name]
            out[shift(at)] = node.anchor[own] + node.delta[own]
        return out

    def put(self, state: States, values: Array) -> None:
        """Set what is known now."""
        self.state.delta[:DIM] = state.minus(self.anchor)[0]
        for name, at in self.columns.items():
            node, own = self.nodes[name]
            node.delta[own] = values[shift(at)] - node.anchor[own]

    @property
    def variables(self) -> Collection[Variable]:
        """That its rows may touch, its state first."""
        return {x.key: x for x in (self.state, *(node for node, _ in self.nodes.values()))}.values()


@dataclass(eq=False)
class Block:
    """Keyframes between two others, and what they say of these and of the parameters in force there."""

    first: int  # numbers of the two
    last: int
    variables: list[Variable]  # that nothing else touches, in the order of their elimination
    slots: set[int]  # indices of all factors on them
    graph: gtsam.GaussianFactorGraph  # these, or what is left of them
    done: bool = False

    def eliminate(self) -> None:
        """Leave only what is said of others."""
        order = fill_keys(gtsam.Ordering(), self.variables)
        self.graph, self.done = self.graph.eliminatePartialSequential(order, gtsam.EliminateQR)[1], True


Made = tuple[Keyframe, str, Any]  # a factor of a keyframe, `LINK` or `ROWS`
VariablePart = tuple[Variable, slice, Array]  # some numbers of a variable, and columns (m, k) of rows over them


def make_isam() -> gtsam.ISAM2:
    """An empty tree."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.enableRelinearization = False  # by GTSAM: it has a linear problem
    parameters.findUnusedFactorSlots = True  # else GTSAM's list of factors would grow without bound
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))  # substitutes back through all that changed
    return gtsam.ISAM2(parameters)


def update_isam(
    isam: gtsam.ISAM2,
    t: float,
    made: Sequence[Made] = (),
    gone: Sequence[int] = (),
    fresh: Iterable[Variable] = (),
    known: Sequence[Any] = (),
    order: Iterable[tuple[Variable, int]] | None = None,
    anew: Iterable[Variable] | None = None,
) -> None:
    """Add factors to a tree and remove others.

    Parameters
    ----------
    t : s, of the newest keyframe.
    made : their keyframes note where they are.
    gone : indices.
    fresh : variables that begin.
    known : other factors, which stay.
    order : when variables are eliminated; None leaves it to GTSAM.
    anew : variables that are all eliminated again.

    Raises
    ------
    EstimationError
        For a variable that nothing determines.
    """
    graph, new, groups = gtsam.NonlinearFactorGraph(), gtsam.Values(), None
    for variable in fresh:
        new.insert(variable.key, np.zeros(len(variable.unit)))
    for one in (*known, *(one for _, _, one in made)):
        graph.push_back(one)
    if order is not None:
        groups = gtsam.KeyGroupMap()
        for variable, group in order:
            groups.insert2(variable.key, group)
    try:
        result = isam.update(
            graph, new, list(gone), groups, None, None if anew is None else fill_keys(gtsam.KeyList(), anew)
        )
    except RuntimeError as error:  # GTSAM's for a variable that nothing determines
        raise explain_smoother(t) from error
    for (keyframe, name, _), index in zip(made, list(result.getNewFactorsIndices())[len(known) :], strict=True):
        keyframe.slots[name] = index


def take_deltas(isam: gtsam.ISAM2, variables: Collection[Variable]) -> None:
    """Take over what a tree has computed of some variables."""
    flat = np.asarray(isam.getDelta().vector([x.key for x in variables])).ravel()
    begin = 0
    for x in variables:
        end = begin + len(x.unit)
        x.delta = x.unit * flat[begin:end]
        begin = end


def fill_keys(out: Any, variables: Iterable[Variable]) -> Any:
    """The keys of variables in a list of GTSAM's."""
    for x in variables:
        out.push_back(x.key)
    return out


def are_leaves(isam: gtsam.ISAM2, variables: Iterable[Variable], others: Iterable[Variable]) -> bool:
    """Whether variables are below all others in a tree: an update of all the others would eliminate none of them."""
    of_others = gtsam.ISAM2UpdateParams()
    of_others.extraReelimKeys = fill_keys(gtsam.KeyList(), others)
    affected, _ = isam.predictUpdateInfo(gtsam.NonlinearFactorGraph(), gtsam.Values(), of_others)
    return not any(affected.count(x.key) for x in variables)


def make_factor(parts: Iterable[VariablePart], b: Array, here: bool = False) -> Any:
    """Whitened rows A e = b as a factor of the tree, or A (e - d) = b of errors that are d `here`."""
    touched: dict[int, tuple[Variable, Array]] = {}
    for x, at, A in parts:
        if x.key not in touched:
            touched[x.key] = x, np.zeros((len(b), len(x.unit)), order="F")
        touched[x.key][1][:, at] += A
    if here:
        b = b + sum(A @ x.delta for x, A in touched.values())
    return gtsam.LinearContainerFactor(make_jacobian_factor([(x.key, A * x.unit) for x, A in touched.values()], b))


def compute_turns(keyframes: Sequence[Keyframe]) -> Array:
    """(n, 3, 3) J_r of attitudes about their anchors: rows over a state become rows over errors about its anchor."""
    return rotation.right_jacobian(np.array([k.state.delta[:3] for k in keyframes]))


def make_interval_factor(last: Keyframe, x: Variable, link: Array, turns: Array) -> Any:
    """A factor of an interval's whitened rows (15, 15 + D + 1), from the keyframe before to a state, J_r of both."""
    states = [
        (last.state, rotate_columns(link[:, :DIM], turns[0])),
        (x, rotate_columns(link[:, DIM : 2 * DIM], turns[1])),
    ]
    return _make_factor(last, states, link[:, DIM:-1], link[:, -1])


def make_row_factor(keyframe: Keyframe, measured: Sequence[Measured], turn: Array) -> Any:
    """A factor of measurements linearised where keyframe, of J_r (3, 3), and parameters are now."""
    D = measured[0].H.shape[-1]
    H, b = (np.concatenate(rows) for rows in zip(*((x.H.reshape(-1, D), x.b.ravel()) for x in measured), strict=True))
    return _make_factor(keyframe, [(keyframe.state, rotate_columns(H[:, :DIM], turn))], H, b)


def _make_factor(keyframe: Keyframe, states: Sequence[tuple[Variable, Array]], H: Array, b: Array) -> Any:
    """A factor of rows over states' errors about anchors and a keyframe's parameters, H (m, D), as they are now."""
    filled: list[bool] = np.any(H, axis=0).tolist()
    touched = ((*keyframe.nodes[name], H[:, at]) for name, at in keyframe.columns.items() if any(filled[at]))
    return make_factor([*((x, slice(0, DIM), A) for x, A in states), *touched], b, here=True)


def read_states(keyframes: Sequence[Keyframe]) -> States:
    """Their states as they are known now."""
    return States.stack([k.anchor for k in keyframes]).plus(np.array([k.state.delta[:DIM] for k in keyframes]))


def is_constant(place: Place, name: str) -> bool:
    assert place.problem is not None
    p = place.problem.parameters.get(name)
    return p is not None and p.constant


def find_node_limits(columns: Columns, place: Place, begin: int = 0) -> Array:
    """How far parameters may move behind others, up to `begin`, of a variable; empty where nothing limits any."""
    found = find_parameter_limits(columns, place)
    return np.append(np.full(begin, np.inf), found) if np.isfinite(found).any() else np.zeros(0)
