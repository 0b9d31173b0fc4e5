"""A problem linearised at a point: whitened rows over graph variables, and its cost there.

Variables are one fifteen-dimensional error state per keyframe, and one vector per node of all parameters with the
same nodes: one for the constants, one for slow parameters, one for those that are reset at stops.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.problem import ParameterChain, Problem
from graphnav.estimation.solvers.linearise import Points, find_last_keyframes, linearise, linearise_links, scale_at
from graphnav.estimation.solvers.passes import make_points, move_points, spread_nodes, subtract_points
from graphnav.imu.dynamics import SCALE

_SHORTENED = 3  # times that a step is quartered: to the 64th
_SHARED_BLOCKS = 6  # blocks of rows with the same variables
WhitenedRows = list[tuple[list[tuple[Array, Array]], Array]]  # blocks of (keys, A (N, m, k)), and b (N, m)


@dataclass(frozen=True)
class _Group:
    """Parameters with common nodes, side by side in one variable per node."""

    keys: Array  # (n,)
    node: Array  # (K,) the node in force at each keyframe
    columns: dict[str, slice]
    width: int
    chains: tuple[ParameterChain, ...]


class Layout:
    """Keys, their widths, and the order of elimination: along time, each node after its last keyframe.

    Attributes
    ----------
    variable : (n,) the key of the variable that each key is eliminated as a part of, and
    offset : (n,) where it stands there. A node that governs a single keyframe is eliminated with its state: of two
        small factorisations in place of one, each would pass through all that both touch.
    joined_width : (n,) of variables.
    """

    def __init__(self, problem: Problem) -> None:
        self.K, self._columns = len(problem.t), problem.columns
        K = self.K
        self.groups: list[_Group] = []
        after: dict[int, list[int]] = {}
        self.width, variable, offset = [DIM] * K, [np.arange(K)], [np.zeros(K, dtype=int)]
        joined_width = np.full(K, DIM)
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
            self.groups.append(_Group(keys, node, columns, at, tuple(chains)))
            self.width += [at] * n
            last = find_last_keyframes(chains[0])
            alone = np.diff(last, prepend=-1) == 1
            variable.append(np.where(alone, last, keys))
            offset.append(np.where(alone, joined_width[last], 0))
            joined_width[last[alone]] += at
            for key, k in zip(keys[~alone].tolist(), last[~alone].tolist(), strict=True):
                after.setdefault(k, []).append(key)
        self.variable, self.offset = np.concatenate(variable), np.concatenate(offset)
        self.joined_width = np.concatenate([joined_width, np.array(self.width[K:], dtype=int)])
        self.keys = range(len(self.width))
        self.order = [key for k in range(K) for key in (k, *after.get(k, ()))]

    def join(self, rows: WhitenedRows) -> WhitenedRows:
        """The same rows, of variables in place of keys."""
        out: WhitenedRows = []
        for blocks, b in rows:
            variables, offsets = (np.stack([x[keys] for keys, _ in blocks], -1) for x in (self.variable, self.offset))
            widths = self.joined_width[variables]
            # which of the blocks is the first of the same variable
            first = np.argmax(variables[:, :, None] == variables[:, None], axis=2)
            kind = np.zeros(len(b), dtype=np.int64)
            for x in np.concatenate([first, offsets, widths], axis=1).T:
                kind = np.unique(kind * (1 + x.max(initial=0)) + x, return_inverse=True)[1]
            for some in (np.flatnonzero(kind == j) for j in range(int(kind.max(initial=-1)) + 1)):
                place, alike = offsets[some[0]], first[some[0]]
                joined = []
                for i in dict.fromkeys(alike.tolist()):
                    A = np.zeros((len(some), b.shape[1], widths[some[0], i]))
                    for j in np.flatnonzero(alike == i):
                        of = blocks[j][1][some]
                        A[:, :, place[j] : place[j] + of.shape[2]] = of
                    joined.append((variables[some, i], A))
                out.append((joined, b[some]))
        return out

    def split(self, variables: dict[int, Array], keys: Iterable[int]) -> list[Array]:
        """The vectors or covariances of keys, by those of their variables."""
        out = []
        for key in keys:
            at = slice(self.offset[key], self.offset[key] + self.width[key])
            one = variables[self.variable[key]]
            out.append(one[(at,) * one.ndim])
        return out

    def unpack(self, vectors: list[Array]) -> Array:
        """(K, D) of states and of the nodes in force at each keyframe, from one vector per key."""
        out = np.empty((self.K, DIM + sum(group.width for group in self.groups)))
        out[:, :DIM] = vectors[: self.K]
        for group in self.groups:
            each = np.stack([vectors[k] for k in group.keys])[group.node]
            for name, at in group.columns.items():
                out[:, self._columns[name]] = each[:, at]
        return out

    def find_parameter_blocks(self, keyframe: Array, jacobians: dict[str, Array]) -> list[tuple[Array, Array]]:
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


def whiten(problem: Problem, points: Points, layout: Layout) -> tuple[WhitenedRows, float]:
    """All factors at points, and their cost: half the squared residuals, through the robust kernels."""
    first, scale = np.arange(layout.K - 1), scale_at(problem.columns, points.values[0])
    start, end, S, b = linearise_links(problem.motion, points.states, scale)
    links = [(first, start), (first + 1, end)]
    if scale is not None:
        links += layout.find_parameter_blocks(first, {SCALE: S})
    out: WhitenedRows = [(links, b)]
    total = 0.5 * float(np.sum(b * b))
    for rows in (problem.prior, *problem.constraints):
        linear = linearise(rows, points, problem.columns)
        weight, costs = linear.weigh()
        total += float(np.sum(costs))
        root = np.sqrt(weight)[:, None] / linear.sigma
        H = root[..., None] * linear.H
        weighted = {p.name: H[:, :, problem.columns[p.name]] for p in rows.parameters}
        blocks = [(rows.keyframe, H[:, :, :DIM])]
        out += _group_rows(blocks + layout.find_parameter_blocks(rows.keyframe, weighted), -root * linear.residual)
    nodes = points.select_nodes(problem)
    for group in layout.groups:
        own = linearise_nodes(group, nodes)
        total += sum(0.5 * float(np.sum(b * b)) for _, b in own)
        out += own
    return out, total


def _group_rows(blocks: list[tuple[Array, Array]], b: Array) -> WhitenedRows:
    """Rows of which each touches few of many variables: those of the same ones together, without blocks of zeros."""
    if len(blocks) <= _SHARED_BLOCKS:
        return [(blocks, b)]
    touched = np.stack([A.any(axis=(1, 2)) for _, A in blocks], -1)
    touched[~touched.any(axis=1), 0] = True  # a row of weight zero
    patterns, of = np.unique(touched, axis=0, return_inverse=True)
    rows = [np.flatnonzero(of.ravel() == j) for j in range(len(patterns))]
    return [
        ([(keys[own], A[own]) for (keys, A), there in zip(blocks, pattern, strict=True) if there], b[own])
        for own, pattern in zip(rows, patterns, strict=True)
    ]


def compute_cost_at(problem: Problem, points: Points) -> float:
    """The cost at points of all keyframes, with the values that nodes have at their last."""
    at = make_points(problem, points.states, spread_nodes(problem, points.select_nodes(problem)))
    return whiten(problem, at, Layout(problem))[1]


def shorten_step(problem: Problem, start: Points, ahead: Points, cost: float, lower: float) -> tuple[Points, float]:
    """The points on the way from a start to those ahead where the cost is least, by a parabola through its values at
    both and halfway, and the cost there; those ahead where it is no less.
    """
    step = subtract_points(ahead, start)
    halfway = compute_cost_at(problem, move_points(start, 0.5 * step))
    bend = cost - 2.0 * halfway + lower
    if not bend > 0.0:
        return ahead, lower
    nearer = move_points(start, (3.0 * cost - 4.0 * halfway + lower) / (4.0 * bend) * step)
    least = compute_cost_at(problem, nearer)
    return (nearer, least) if least < lower else (ahead, lower)


def descend(problem: Problem, about: Points, ahead: Points) -> Points:
    """The points ahead, or on the way there, that cost less than those before, or these where none do."""
    cost, step = compute_cost_at(problem, about), subtract_points(ahead, about)
    for share in 0.25 ** np.arange(_SHORTENED + 1.0):
        points = ahead if share == 1.0 else move_points(about, share * step)
        beyond = compute_cost_at(problem, points)
        if not beyond < cost:
            points, beyond = shorten_step(problem, about, points, cost, beyond)
        if beyond < cost:
            return points
    return about


def compute_column_norms(rows: WhitenedRows, layout: Layout) -> Array:
    """(keys, widest) root of the diagonal of A^T A."""
    total = np.zeros((len(layout.keys), max(layout.width)))
    for blocks, _ in rows:
        for keys, A in blocks:
            np.add.at(total[:, : A.shape[-1]], keys, np.sum(A * A, axis=1))
    return np.sqrt(total)


def linearise_nodes(group: _Group, nodes: Mapping[str, Array]) -> WhitenedRows:
    """Prior on the first node of a group's parameters, and their process model, at values (nodes, k)."""
    chains, keys = group.chains, group.keys
    sigma = np.concatenate([c.sigma for c in chains], axis=1)
    decay = np.concatenate([np.broadcast_to(c.decay[:, None], c.sigma.shape) for c in chains], axis=1)
    off = np.concatenate([nodes[c.parameter.name] - c.mean for c in chains], axis=1)
    A = np.eye(group.width) / sigma[..., None]
    out: WhitenedRows = [([(keys[:1], A[:1])], -off[:1] / sigma[:1])]
    if len(keys) > 1:
        before, driven = -decay[1:, :, None] * A[1:], (decay[1:] * off[:-1] - off[1:]) / sigma[1:]
        out.append(([(keys[:-1], before), (keys[1:], A[1:])], driven))
    return out
