"""Full smoothing with GTSAM's iSAM2 (Kaess et al. 2012), beside the window of `graphnav.solvers.incremental`.

The same rows of the same keyframes, linearised at the prediction, in one Bayes tree that keeps the whole drive. Every
variable is a vector of errors about a fixed point, so the tree has nothing to linearise again; the batch solver does
that at the end, from where the tree arrived. Live estimates are the tree's.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from graphnav import rotation
from graphnav.dense import dense
from graphnav.problem import Problem
from graphnav.rotation import Array
from graphnav.solvers.batch import batch
from graphnav.solvers.incremental import Replayed, node_steps, said
from graphnav.solvers.passes import Progress
from graphnav.solvers.rows import Layout
from graphnav.solvers.stages import Message, Place, Step, measured, predicted
from graphnav.state import DIM, States


class _Tree:
    """iSAM2 over the variables of a `Layout`."""

    def __init__(self, problem: Problem) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("QR")
        parameters.enableRelinearization = False
        parameters.findUnusedFactorSlots = True
        self.tree = gtsam.ISAM2(parameters)
        self.problem, self.layout = problem, Layout(problem)
        self.points: list[States] = []
        self.mean = {c.parameter.name: c.mean for c in problem.chains}
        self._factors, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def delta(self, key: int) -> Array:
        """The error state of a variable."""
        return np.asarray(self.tree.calculateEstimateVector(key))

    def node(self, name: str, k: int) -> int:
        """The node of a parameter in force at keyframe k."""
        return int(self.layout.group_of[name].node[k])

    def newest(self, k: int) -> Message:
        """State and parameter values at keyframe k as they are known now; without what is known of their errors."""
        columns, values, at = {}, [], DIM
        for name in self.mean:
            value = self.value(name, self.node(name, k))
            columns[name] = slice(at, at + len(value))
            values.append(value)
            at += len(value)
        state = self.points[k].plus(self.delta(k)[None])
        none = np.empty((0, 0))
        return Message(state, np.concatenate([np.empty(0), *values]), columns, none, none)

    def value(self, name: str, j: int) -> Array:
        """A parameter's node as it is known now."""
        group = self.layout.group_of[name]
        return np.asarray(self.mean[name][j] + self.delta(int(group.keys[j]))[group.columns[name]])

    def open(self, key: int) -> None:
        """Begin a variable at no error."""
        self._values.insert(key, np.zeros(self.layout.width[key]))

    def push(self, blocks: dict[int, Array], b: Array) -> None:
        """Add whitened rows."""
        flat: list[Any] = [x for key, A in blocks.items() for x in (key, np.asfortranarray(A))]
        make: Any = gtsam.JacobianFactor
        factor = make(*flat, b, gtsam.noiseModel.Unit.Create(len(b)))
        self._factors.push_back(gtsam.LinearContainerFactor(factor))

    def push_about(self, H: Array, b: Array, k: int, now: Message, state: dict[int, Array]) -> None:
        """Add rows H (m, D) on the parameters at keyframe k, about their values now, and blocks on states."""
        blocks = dict(state)
        for name, at in now.columns.items():
            if not np.any(H[:, at]):
                continue
            group, j = self.layout.group_of[name], self.node(name, k)
            key = int(group.keys[j])
            block = blocks.setdefault(key, np.zeros((len(b), group.width)))
            block[:, group.columns[name]] = H[:, at]
            b = b + H[:, at] @ (now.value(name) - self.mean[name][j])
        self.push(blocks, b)

    def begin(self, steps: tuple[Step, ...], k: int) -> None:
        """Open the nodes that begin at keyframe k, with what is known of them."""
        for step in steps:
            group, j = self.layout.group_of[step.name], self.node(step.name, k)
            key = int(group.keys[j])
            if not self._values.exists(key):
                self.open(key)
            A = np.eye(group.width)[group.columns[step.name]] / step.sigma[:, None]
            before = {int(group.keys[j - 1]): -step.decay * A} if step.decay else {}
            self.push({**before, key: A}, np.zeros(len(A)))

    def update(self) -> None:
        """Hand over what was added."""
        self.tree.update(self._factors, self._values)
        self._factors, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()


def isam2(problem: Problem, progress: Progress | None = None) -> Replayed:
    """Solve a problem keyframe by keyframe with iSAM2, and to the end with the batch solver."""
    began = time.perf_counter()
    K, steps, tree = len(problem.t), node_steps(problem), _Tree(problem)
    mean = problem.prior.mean
    assert mean is not None
    live, P, seconds = [], np.empty((K, DIM, DIM)), np.empty(K)
    for k in range(K):
        start = time.process_time()
        place = Place(float(problem.t[k]), problem, k, steps.get(k, ()), linked=k > 0)
        tree.begin(place.steps, k)
        tree.open(k)
        if k == 0:
            tree.points.append(mean)
            tree.push({0: np.diag(1.0 / problem.prior.sigma[0])}, np.zeros(DIM))
            now = Message(mean, np.concatenate([np.empty(0), *(m[0] for m in tree.mean.values())]),
                          _columns(tree.mean), np.empty(0), np.empty(0))  # fmt: skip
        else:
            before = tree.newest(k - 1)
            state, values, columns, link = predicted(before, place)
            assert link is not None
            tree.points.append(state)
            # the rows are about the estimate before, the variable about its point: log(Exp(d) Exp(e)) again
            d = tree.delta(k - 1)
            A = link[:, :DIM].copy()
            A[:, :3] = A[:, :3] @ rotation.right_jacobian(d[None, :3])[0]
            b = link[:, -1] + A @ d
            tree.push_about(link[:, DIM:-1], b, k, before, {k - 1: A, k: link[:, DIM : 2 * DIM]})
            now = Message(state, values, columns, np.empty(0), np.empty(0))
        for one in measured(place, now.state, now.values, now.columns).measured:
            for row, right in zip(one.H, one.b, strict=True):
                tree.push_about(row, right, k, now, {k: row[:, :DIM]})
        tree.update()
        live.append(tree.points[k].plus(tree.delta(k)[None]))
        P[k] = tree.tree.marginalCovariance(k)
        seconds[k] = time.process_time() - start
        if progress is not None and k % 64 == 0:
            progress("isam2", k / K)
    states = States.stack([tree.points[k].plus(tree.delta(k)[None]) for k in range(K)])
    nodes = {n: np.stack([tree.value(n, j) for j in range(len(m))]) for n, m in tree.mean.items()}
    spent = time.perf_counter() - began
    end = batch(problem, states, nodes, progress)
    settled = replace(end, solver="isam2", timings={"isam2": spent, **end.timings}, notes=(*end.notes, said(seconds)))
    known = States.stack(live)
    between = (dense(problem, known, P, None, smooth=False),)
    return Replayed(settled, replace(settled, solver="live", states=known, covariance=P, between=between), seconds)


def _columns(mean: dict[str, Array]) -> dict[str, slice]:
    out, at = {}, DIM
    for name, value in mean.items():
        out[name] = slice(at, at + value.shape[1])
        at += value.shape[1]
    return out
