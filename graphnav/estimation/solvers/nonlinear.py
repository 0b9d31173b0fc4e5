"""A solved problem as GTSAM's own: a `NonlinearFactorGraph` and `Values`, for whoever goes on with GTSAM.

Variables, with k the number of the keyframe and j that of a node:

    X(k)  Pose3                  R_nb and p_n, body (x right, y forward, z up) in the navigation frame
    V(k)  3 numbers              v_n, m/s
    B(k)  imuBias.ConstantBias   accelerometer m/s^2, gyro rad/s
    Q(j)  k numbers              a node of parameters; `Layout` puts parameters with the same nodes side by side

What GTSAM has itself is its own factor: priors of parameters and their way from node to node where nothing decays.
Everything else is a `CustomFactor` that asks the constraint, or the interval between keyframes, for residual and
Jacobians wherever GTSAM linearises: nonlinear, but slower than C++, and not to be serialised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphnav.constraints.base import Constraint, weigh_sigma
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, DIM, States
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.linearise import linearise, linearise_links
from graphnav.estimation.solvers.passes import points_of
from graphnav.estimation.solvers.rows import Layout
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


@dataclass(frozen=True)
class Exported:
    """A problem and where it was solved, which becomes a graph when it is asked for."""

    problem: Problem
    states: States
    values: dict[str, Array]  # (nodes, k) per parameter

    def __call__(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """The graph, and the solution as its values.

        Raises
        ------
        EstimationError
            For a robust kernel that GTSAM does not have as a factor.
        """
        layout = Layout(self.problem)
        known = _with_places(self.problem, self.states, self.values)
        values = gtsam.Values()
        states = self.states
        for k in range(len(states)):
            values.insert(_X(k), gtsam.Pose3(gtsam.Rot3(states.R_nb[k]), states.p[k]))
            values.insert(_V(k), states.v[k])
            values.insert(_B(k), gtsam.imuBias.ConstantBias(states.ba[k], states.bg[k]))
        for group in layout.groups:
            for j, key in enumerate(group.keys.tolist()):
                node = np.concatenate([known[name][j] for name in group.columns])
                values.insert(_Q(key - layout.K), node)
        graph = gtsam.NonlinearFactorGraph()
        _add_intervals(graph, self.problem, layout)
        for rows in (self.problem.prior, *self.problem.constraints):
            _add_rows(graph, rows, layout)
        for factor in _parameter_factors(self.problem, layout):
            graph.push_back(factor)
        return graph, values


def _with_places(problem: Problem, states: States, values: dict[str, Array]) -> dict[str, Array]:
    """The values with those that solutions do not list, such as the places of stops: the best there are given the rest.

    Rows are linear in them, or they are where one step of Gauss and Newton leads.
    """
    points = points_of(problem, states, {c.parameter.name: values[c.parameter.name][c.node] for c in problem.chains
                                         if c.parameter.name in values})  # fmt: skip
    out = dict(values)
    for chain in problem.chains:
        name = chain.parameter.name
        if name in values:
            continue
        normal = np.stack([np.diag(s**-2.0) for s in chain.sigma])
        right = np.zeros_like(chain.mean)
        for rows in problem.constraints:
            if name in {p.name for p in rows.parameters}:
                linear = linearise(rows, points, problem.columns)
                weight = linear.kernel()[0][:, None] / linear.sigma**2
                H, node = linear.H[:, :, problem.columns[name]], chain.node[rows.keyframe]
                np.add.at(normal, node, np.einsum("nmi,nm,nmj->nij", H, weight, H))
                np.add.at(right, node, -np.einsum("nmi,nm,nm->ni", H, weight, linear.residual))
        out[name] = chain.mean + np.linalg.solve(normal, right[..., None])[..., 0]
    return out


def state_at(values: gtsam.Values, k: int) -> States:
    """The state of keyframe k as one row."""
    pose, bias = values.atPose3(_X(k)), values.atConstantBias(_B(k))
    place = pose.rotation().matrix(), pose.translation(), values.atVector(_V(k))
    parts = (*place, bias.accelerometer(), bias.gyroscope())
    return States(*(np.asarray(part)[None] for part in parts))


def _state_keys(k: int) -> list[int]:
    return [_X(k), _V(k), _B(k)]


def _state_blocks(J: Array, R_nb: Array) -> list[Array]:
    """(m, 15) by our error state as the blocks of Pose3, velocity and bias; GTSAM moves positions in body axes."""
    turned = J[:, BLOCKS["p"]] @ R_nb
    blocks = (np.hstack([J[:, BLOCKS["theta"]], turned]), J[:, BLOCKS["v"]], J[:, BLOCKS["ba"].start :])
    return [np.asfortranarray(block) for block in blocks]


def _fill(H: Any, blocks: Sequence[Array]) -> None:
    if H is not None:
        for i, block in enumerate(blocks):
            H[i] = np.asfortranarray(block)


def _add_intervals(graph: gtsam.NonlinearFactorGraph, problem: Problem, layout: Layout) -> None:
    unit = gtsam.noiseModel.Unit.Create(DIM)
    group = layout.group_of.get(SCALE)
    for k in range(layout.K - 1):
        motion = type(problem.motion)(problem.intervals[k : k + 1], problem.frame)
        keys = [*_state_keys(k), *_state_keys(k + 1)]
        if group is not None:
            keys.append(_Q(int(group.keys[group.node[k]]) - layout.K))

        def error(this: Any, values: gtsam.Values, H: Any, k: int = k, motion: Any = motion) -> Array:
            pair = States.stack([state_at(values, k), state_at(values, k + 1)])
            scale = None if group is None else values.atVector(this.keys()[-1])[group.columns[SCALE]]
            start, end, S, b = linearise_links(motion, pair, scale)
            if H is not None:
                blocks = _state_blocks(start[0], pair.R_nb[0]) + _state_blocks(end[0], pair.R_nb[1])
                if group is not None:
                    by_node = np.zeros((DIM, group.width))
                    by_node[:, group.columns[SCALE]] = S[0]
                    blocks.append(by_node)
                _fill(H, blocks)
            return np.asarray(-b[0])

        graph.push_back(gtsam.CustomFactor(unit, keys, error))


def _add_rows(graph: gtsam.NonlinearFactorGraph, rows: Constraint, layout: Layout) -> None:
    for i, k in enumerate(rows.keyframe.tolist()):
        if rows.weight is not None and rows.weight[i] <= 0.0:
            continue
        groups = {id(g): g for p in rows.parameters for g in [layout.group_of[p.name]]}
        nodes = [(_Q(int(g.keys[g.node[k]]) - layout.K), g) for g in groups.values()]
        keys = [*_state_keys(k), *(key for key, _ in nodes)]
        graph.push_back(gtsam.CustomFactor(_noise(rows, i), keys, _error_of(rows, i, k, nodes)))


def _error_of(rows: Constraint, i: int, k: int, nodes: list[tuple[int, Any]]) -> Callable[..., Array]:
    """Whitened residual of one row, and its derivatives."""
    which = slice(i, i + 1)

    def error(this: Any, values: gtsam.Values, H: Any) -> Array:
        state = state_at(values, k)
        given: dict[str, Array] = {}
        own = {p.name for p in rows.parameters}
        for key, group in nodes:
            node = values.atVector(key)
            given |= {name: node[None, at] for name, at in group.columns.items() if name in own}
        linear = rows.linearize(state, given, which)
        sigma = weigh_sigma(rows, linear.sigma, which)[0]
        if H is not None:
            J = np.zeros((len(sigma), DIM))
            for block, at in BLOCKS.items():
                if block in linear.jacobians:
                    J[:, at] = linear.jacobians[block][0]
            blocks = _state_blocks(J / sigma[:, None], state.R_nb[0])
            for _, group in nodes:
                by_node = np.zeros((len(sigma), group.width))
                for name, at in group.columns.items():
                    if name in linear.jacobians:
                        by_node[:, at] = linear.jacobians[name][0] / sigma[:, None]
                blocks.append(by_node)
            _fill(H, blocks)
        return np.asarray(linear.residual[0] / sigma)

    return error


def _noise(rows: Constraint, i: int) -> Any:
    unit = gtsam.noiseModel.Unit.Create(len(rows.axes))
    if rows.robust == "none":
        return unit
    if rows.robust not in _ESTIMATORS:
        raise EstimationError(
            f"{rows.name}: GTSAM has no kernel '{rows.robust}'; known: {', '.join(_ESTIMATORS)}", key="solver.kernel"
        )
    scale = np.asarray(rows.scale_of(slice(i, i + 1))).ravel()[0]
    return gtsam.noiseModel.Robust.Create(_ESTIMATORS[rows.robust].Create(float(scale)), unit)


def _parameter_factors(problem: Problem, layout: Layout) -> list[Any]:
    """Priors of the first nodes, and the way from node to node, group by group."""
    chains = {chain.parameter.name: chain for chain in problem.chains}
    out: list[Any] = []
    for group in layout.groups:
        some = [chains[name] for name in group.columns]
        keys = [_Q(int(key) - layout.K) for key in group.keys]
        mean, sigma = (np.concatenate([getattr(c, name) for c in some], axis=1) for name in ("mean", "sigma"))
        decay = np.concatenate([np.repeat(c.decay[:, None], c.parameter.size, axis=1) for c in some], axis=1)
        diagonal = [gtsam.noiseModel.Diagonal.Sigmas(one) for one in sigma]
        out.append(gtsam.PriorFactorVector(keys[0], mean[0], diagonal[0]))
        for j in range(1, len(keys)):
            if not decay[j].any():
                out.append(gtsam.PriorFactorVector(keys[j], mean[j], diagonal[j]))
            elif (decay[j] == 1.0).all() and (mean[j] == mean[j - 1]).all():
                out.append(gtsam.BetweenFactorVector(keys[j - 1], keys[j], np.zeros(group.width), diagonal[j]))
            else:
                move = _move(mean[j - 1], mean[j], decay[j], sigma[j])
                unit = gtsam.noiseModel.Unit.Create(group.width)
                out.append(gtsam.CustomFactor(unit, keys[j - 1 : j + 1], move))
    return out


def _move(before: Array, mean: Array, decay: Array, sigma: Array) -> Callable[..., Array]:
    """Of a Gauss-Markov process from one node to the next."""

    def error(this: Any, values: gtsam.Values, H: Any) -> Array:
        keys = this.keys()
        first, second = values.atVector(keys[0]), values.atVector(keys[1])
        _fill(H, (np.diag(-decay / sigma), np.diag(1.0 / sigma)))
        return np.asarray((second - mean - decay * (first - before)) / sigma)

    return error
