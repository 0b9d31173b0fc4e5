"""A problem linearised at a point: whitened rows over graph variables, and its cost there.

Variables are one fifteen-dimensional error state per keyframe, and one vector per node of all parameters with the
same nodes: one for the constants, one for the slow ones, one for what begins anew at stops.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.problem import ParameterChain, Problem
from graphnav.estimation.solvers.linearise import Points, find_last_keyframes, linearise, linearise_links
from graphnav.imu.dynamics import SCALE

_FEW = 6  # blocks of rows, which all of them touch
Values = dict[str, Array]  # parameter name -> (nodes, k)
Rows = list[tuple[list[tuple[Array, Array]], Array]]  # blocks of (keys, A (N, m, k)), and b (N, m)
Step = tuple[Array, Values]  # (K, 15) and per parameter


@dataclass(frozen=True)
class Iterate:
    """States of all keyframes and values of all parameter nodes."""

    states: States
    values: Values

    @property
    def scale(self) -> Array | None:
        """The scale errors of the IMU, (6,), where they are parameters."""
        return self.values[SCALE][0] if SCALE in self.values else None

    def moved(self, step: Step) -> Iterate:
        """Move by a step."""
        return Iterate(self.states.plus(step[0]), {name: v + step[1][name] for name, v in self.values.items()})

    def points(self, problem: Problem) -> Points:
        """The same with the parameters' values at every keyframe."""
        values = [self.values[c.parameter.name][c.node] for c in problem.chains]
        return Points(self.states, np.concatenate([np.empty((len(self.states), 0)), *values], axis=1))


@dataclass(frozen=True)
class _Group:
    """Parameters with common nodes, side by side in one variable per node."""

    keys: Array  # (n,)
    node: Array  # (K,) the node in force at each keyframe
    columns: dict[str, slice]
    width: int


class Layout:
    """Keys, their widths, and the order of elimination: along time, each node after its last keyframe."""

    def __init__(self, problem: Problem) -> None:
        self.K = K = len(problem.t)
        self.groups: list[_Group] = []
        self.group_of: dict[str, _Group] = {}
        after: dict[int, list[int]] = {}
        self.width = [DIM] * K
        alike: dict[bytes, list[ParameterChain]] = {}
        for chain in problem.chains:
            alike.setdefault(chain.t.tobytes(), []).append(chain)
        for chains in sorted(alike.values(), key=lambda some: len(some[0].t), reverse=True):
            columns, at = {}, 0
            for chain in chains:
                size = chain.parameter.size
                columns[chain.parameter.name] = slice(at, at + size)
                at += size
            node = chains[0].node
            n = len(chains[0].t)
            keys = np.arange(len(self.width), len(self.width) + n)
            group = _Group(keys, node, columns, at)
            self.groups.append(group)
            self.group_of |= dict.fromkeys(columns, group)
            self.width += [at] * n
            for j, last in enumerate(find_last_keyframes(chains[0])):
                after.setdefault(int(last), []).append(int(keys[j]))
        self.keys = range(len(self.width))
        self.order = [key for k in range(K) for key in (k, *after.get(k, ()))]

    def unpack(self, vectors: list[Array]) -> Step:
        """Steps per state and parameter from one vector per key."""
        nodes: Values = {}
        for group in self.groups:
            stacked = np.stack([vectors[k] for k in group.keys])
            nodes |= {name: stacked[:, at] for name, at in group.columns.items()}
        return np.stack(vectors[: self.K]), nodes

    def parameter_blocks(self, keyframe: Array, jacobians: dict[str, Array]) -> list[tuple[Array, Array]]:
        """Blocks of the parameter variables that rows at `keyframe` touch."""
        blocks = []
        for group in self.groups:
            names = [name for name in group.columns if name in jacobians]
            if names:
                n, m, _ = jacobians[names[0]].shape
                A = np.zeros((n, m, group.width))
                for name in names:
                    A[:, :, group.columns[name]] = jacobians[name]
                blocks.append((group.keys[group.node[keyframe]], A))
        return blocks


def whiten(problem: Problem, point: Iterate, layout: Layout) -> tuple[Rows, float]:
    """All factors at a point, and its cost: half their squared residuals, through the robust kernels."""
    first = np.arange(layout.K - 1)
    start, end, S, b = linearise_links(problem.motion, point.states, point.scale)
    links = [(first, start), (first + 1, end)]
    if point.scale is not None:
        links += layout.parameter_blocks(first, {SCALE: S})
    out: Rows = [(links, b)]
    total = 0.5 * float(np.sum(b * b))
    points = point.points(problem)
    for rows in (problem.prior, *problem.constraints):
        linear = linearise(rows, points, problem.columns)
        weight, costs = linear.kernel()
        total += float(np.sum(costs))
        scale = np.sqrt(weight)[:, None] / linear.sigma
        H = scale[..., None] * linear.H
        weighted = {p.name: H[:, :, problem.columns[p.name]] for p in rows.parameters}
        blocks = [(rows.keyframe, H[:, :, :DIM])]
        out += _touching(blocks + layout.parameter_blocks(rows.keyframe, weighted), -scale * linear.residual)
    for chain in problem.chains:
        own = linearise_chain(chain, layout.group_of[chain.parameter.name], point.values[chain.parameter.name])
        total += sum(0.5 * float(np.sum(b * b)) for _, b in own)
        out += own
    return out, total


def _touching(blocks: list[tuple[Array, Array]], b: Array) -> Rows:
    """Rows of which each touches few of many variables: those of the same ones together, without blocks of zeros."""
    if len(blocks) <= _FEW:
        return [(blocks, b)]
    touched = np.stack([A.any(axis=(1, 2)) for _, A in blocks], -1)
    touched[~touched.any(axis=1), 0] = True  # a row without weight
    patterns, of = np.unique(touched, axis=0, return_inverse=True)
    rows = [np.flatnonzero(of.ravel() == j) for j in range(len(patterns))]
    return [
        ([(keys[own], A[own]) for (keys, A), there in zip(blocks, pattern, strict=True) if there], b[own])
        for own, pattern in zip(rows, patterns, strict=True)
    ]


def compute_cost_at(problem: Problem, points: Points) -> float:
    """The cost at points of all keyframes."""
    return whiten(problem, Iterate(points.states, points.nodes(problem)), Layout(problem))[1]


def compute_column_norms(rows: Rows, layout: Layout) -> Array:
    """(keys, widest) root of the diagonal of A^T A."""
    total = np.zeros((len(layout.keys), max(layout.width)))
    for blocks, _ in rows:
        for keys, A in blocks:
            np.add.at(total[:, : A.shape[-1]], keys, np.sum(A * A, axis=1))
    return np.sqrt(total)


def linearise_chain(chain: ParameterChain, group: _Group, value: Array) -> Rows:
    """The prior on a parameter's first node and its way from node to node."""
    pick = np.eye(group.width)[group.columns[chain.parameter.name]]  # (k, width)
    keys, off = group.keys, value - chain.mean
    A = pick / chain.sigma[..., None]
    out: Rows = [([(keys[:1], A[:1])], -off[:1] / chain.sigma[:1])]
    if len(keys) > 1:
        decay = chain.decay[1:]
        out.append(([(keys[:-1], -decay[:, None, None] * A[1:]), (keys[1:], A[1:])],
                    (decay[:, None] * off[:-1] - off[1:]) / chain.sigma[1:]))  # fmt: skip
    return out
