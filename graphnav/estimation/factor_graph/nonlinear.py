"""A solved problem as GTSAM's own: a `NonlinearFactorGraph` and `Values`, for further use in GTSAM.

Variables, with k the number of the keyframe and j that of a node:

    X(k)  Pose3                  R_nb and p_n, body (x right, y forward, z up) in the navigation frame
    V(k)  3 numbers              v_n, m/s
    B(k)  imuBias.ConstantBias   accelerometer m/s^2, gyro rad/s
    Q(j)  k numbers              a node of parameters; `Layout` puts parameters with the same nodes side by side

Priors of parameters and their way from node to node are linear, a `LinearContainerFactor` each. Everything else is a
`CustomFactor` that asks the constraint, or the interval between keyframes, for residual and Jacobians wherever GTSAM
linearises: nonlinear, but slower than C++, and not to be serialised.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gtsam
import numpy as np

from graphnav.constraints.base import Constraint
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, DIM, States
from graphnav.estimation.factor_graph.gaussian import make_jacobian_factor
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.linearise import Points, linearise, linearise_links, shift
from graphnav.estimation.solvers.rows import Layout, linearise_nodes
from graphnav.imu.dynamics import SCALE

_ESTIMATORS: dict[str, Any] = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    "tukey": gtsam.noiseModel.mEstimator.Tukey,
    "welsch": gtsam.noiseModel.mEstimator.Welsch,
}
_X, _V, _B, _Q = (gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V, gtsam.symbol_shorthand.B,
                  gtsam.symbol_shorthand.Q)  # fmt: skip


def make_graph(
    problem: Problem, states: States, nodes: dict[str, Array]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The graph of a problem, and a solution of it as its values.

    Parameters
    ----------
    states : of all K keyframes.
    nodes : (nodes, k) values of every parameter.

    Raises
    ------
    EstimationError
        For a robust kernel that GTSAM does not have as a factor.
    """
    layout = Layout(problem)
    values = gtsam.Values()
    for k in range(len(states)):
        values.insert(_X(k), gtsam.Pose3(gtsam.Rot3(states.R_nb[k]), states.p[k]))
        values.insert(_V(k), states.v[k])
        values.insert(_B(k), gtsam.imuBias.ConstantBias(states.ba[k], states.bg[k]))
    for group in layout.groups:
        for j, key in enumerate(group.keys.tolist()):
            node = np.concatenate([nodes[name][j] for name in group.columns])
            values.insert(_Q(key - layout.K), node)
    graph = gtsam.NonlinearFactorGraph()
    for one in _make_factors(problem, layout):
        graph.push_back(one)
    return graph, values


def get_state(values: gtsam.Values, k: int) -> States:
    """The state of keyframe k as one row."""
    pose, bias = values.atPose3(_X(k)), values.atConstantBias(_B(k))
    place = pose.rotation().matrix(), pose.translation(), values.atVector(_V(k))
    parts = (*place, bias.accelerometer(), bias.gyroscope())
    return States(*(np.asarray(part)[None] for part in parts))


def _make_factors(problem: Problem, layout: Layout) -> Iterator[Any]:
    """Intervals, rows, and the priors and process models of parameters."""
    unit = gtsam.noiseModel.Unit.Create(DIM)
    scale = (SCALE,) if SCALE in problem.columns else ()
    for k in range(layout.K - 1):
        yield _make_custom(unit, layout, (k, k + 1), scale, _evaluate_interval(problem, k))
    for rows in (problem.prior, *problem.constraints):
        names = tuple(p.name for p in rows.parameters)
        for i, k in enumerate(rows.keyframe.tolist()):
            if rows.weight is None or rows.weight[i] > 0.0:
                yield _make_custom(_make_noise(rows, i), layout, (k,), names, _evaluate_row(rows, i, problem))
    for group in layout.groups:
        own, means = group.chains, gtsam.Values()
        for key, mean in zip(group.keys.tolist(), np.concatenate([c.mean for c in own], axis=1), strict=True):
            means.insert(_Q(key - layout.K), mean)
        for blocks, b in linearise_nodes(group, {c.parameter.name: c.mean for c in own}):
            for n in range(len(b)):
                touched = [(_Q(int(keys[n]) - layout.K), A[n]) for keys, A in blocks]
                yield gtsam.LinearContainerFactor(make_jacobian_factor(touched, b[n]), means)


# whitened residual (m,) at states and parameter values, and its derivatives by the states (m, 15 each) and parameters
Evaluated = Callable[[States, dict[str, Array]], tuple[Array, Array, dict[str, Array]]]


def _evaluate_interval(problem: Problem, k: int) -> Evaluated:
    def evaluate(states: States, given: dict[str, Array]) -> tuple[Array, Array, dict[str, Array]]:
        scale = given[SCALE][0] if SCALE in given else None
        start, end, S, b = linearise_links(problem.motion, states, scale, slice(k, k + 1))
        return -b[0], np.hstack([start[0], end[0]]), {SCALE: S} if given else {}

    return evaluate


def _evaluate_row(rows: Constraint, i: int, problem: Problem) -> Evaluated:
    columns, which, at = problem.columns, slice(i, i + 1), np.zeros(1, dtype=int)
    width = max((column.stop for column in columns.values()), default=DIM) - DIM

    def evaluate(states: States, given: dict[str, Array]) -> tuple[Array, Array, dict[str, Array]]:
        values = np.zeros((1, width))
        for name, value in given.items():
            values[:, shift(columns[name])] = value
        linear = linearise(rows, Points(states, values), columns, which, at)
        H = linear.H / linear.sigma[..., None]
        by_parameter = {name: H[:, :, columns[name]] for name in given}
        return (linear.residual / linear.sigma)[0], H[0, :, :DIM], by_parameter

    return evaluate


def _make_custom(
    noise: Any, layout: Layout, keyframes: tuple[int, ...], names: tuple[str, ...], evaluate: Evaluated
) -> Any:
    """A factor over keyframes and the nodes of parameters valid at the first of them."""
    first = np.array(keyframes[:1])
    nodes = [
        (g, _Q(int(g.keys[g.node[first[0]]]) - layout.K))
        for g in layout.groups
        if not g.columns.keys().isdisjoint(names)
    ]
    keys = [key(k) for k in keyframes for key in (_X, _V, _B)] + [key for _, key in nodes]

    def compute_error(this: Any, values: gtsam.Values, H: Any) -> Array:
        states = States.stack([get_state(values, k) for k in keyframes])
        given = {
            name: values.atVector(key)[None, at] for g, key in nodes for name, at in g.columns.items() if name in names
        }
        residual, J, by_parameter = evaluate(states, given)
        if H is not None:
            parts = zip(np.split(J, len(keyframes), axis=1), states.R_nb, strict=True)
            blocks = [block for part, R_nb in parts for block in _split_jacobian(part, R_nb)]
            for k, block in enumerate([*blocks, *(A[0] for _, A in layout.find_parameter_blocks(first, by_parameter))]):
                H[k] = np.asfortranarray(block)
        return residual

    return gtsam.CustomFactor(noise, keys, compute_error)


def _split_jacobian(J: Array, R_nb: Array) -> tuple[Array, Array, Array]:
    """(m, 15) by our error state as the blocks of Pose3, velocity and bias; GTSAM moves positions in body axes."""
    turned = J[:, BLOCKS["p"]] @ R_nb
    return np.hstack([J[:, BLOCKS["theta"]], turned]), J[:, BLOCKS["v"]], J[:, BLOCKS["ba"].start :]


def _make_noise(rows: Constraint, i: int) -> Any:
    unit = gtsam.noiseModel.Unit.Create(len(rows.axes))
    if rows.robust == "none":
        return unit
    if rows.robust not in _ESTIMATORS:
        raise EstimationError(
            f"{rows.name}: GTSAM has no kernel '{rows.robust}'; known: {', '.join(_ESTIMATORS)}", key="solver.kernel"
        )
    scale = np.asarray(rows.scale_of(slice(i, i + 1))).ravel()[0]
    return gtsam.noiseModel.Robust.Create(_ESTIMATORS[rows.robust].Create(float(scale)), unit)
