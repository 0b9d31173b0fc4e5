"""Batch smoother: the whole drive as one factor graph, solved by Gauss-Newton with Levenberg-Marquardt.

Minimises, over all keyframe states and parameter nodes,

    1/2 |prior|^2 + 1/2 sum |interval residual|^2_Q + sum rho(|constraint residual|_R)

Each iteration linearises everything at once in NumPy, hands the whitened rows to GTSAM as Gaussian
factors, eliminates with QR and moves the states on their manifold. A step that raises the cost is taken
back and damped (Marquardt's scaling: lambda times the column norms). Converged means that the quadratic
model promises less than `tolerance` from another step, in units of half squared sigmas: the optimum is
then within sqrt(2 tolerance) sigma in every direction at once.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from graphnav.constraints.base import Constraint, assemble
from graphnav.dynamics import SCALE
from graphnav.problem import ParameterChain, Problem
from graphnav.rotation import Array, mv
from graphnav.solution import ParameterEstimate, Solution
from graphnav.solvers.ekf import Progress, residual_record
from graphnav.solvers.graph import Eliminated, LinearGraph
from graphnav.solvers.robust import weight_and_cost
from graphnav.state import DIM, States

Values = dict[str, Array]  # parameter name -> (nodes, k)
_MAX_DAMPING = 1e8


@dataclass(frozen=True)
class _Point:
    states: States
    values: Values

    @property
    def scale(self) -> Array | None:
        return self.values[SCALE][0] if SCALE in self.values else None

    def at_rows(self, problem: Problem, rows: Constraint) -> Values:
        chains = {c.parameter.name: c for c in problem.chains}
        return {p.name: self.values[p.name][chains[p.name].node[rows.keyframe]] for p in rows.parameters}


def batch(
    problem: Problem,
    start: States,
    values: Values | None = None,
    progress: Progress | None = None,
    covariances: tuple[int, ...] | None = None,
    reintegrate: bool = True,
) -> Solution:
    """Solve a problem from any starting states (K rows) and parameter values.

    `covariances` are the keyframes whose covariance is wanted, all when None; others are NaN. `reintegrate`
    allows intervals to be integrated again when the gyro bias moves far.
    """
    began = time.perf_counter()
    settings = problem.settings.solver
    values = values or {c.parameter.name: np.tile(c.parameter.initial, (len(c.t), 1)) for c in problem.chains}
    point = _Point(start, values)
    problem, renewed = _renew(problem, point) if reintegrate else (problem, 0)
    layout = _Layout(problem)
    cost = _cost(problem, point, layout)
    damping, tries, stopped = 0.0, 0, f"stopped at the limit of {settings.max_iterations} iterations"
    iteration = 0
    eliminated: Eliminated | None = None
    while iteration < settings.max_iterations:
        iteration += 1
        rows = _whitened(problem, point, layout)
        while True:
            eliminated = _graph(rows, layout, damping).eliminate(layout.order)
            step = layout.unpack(eliminated.solve(layout.keys))
            promised = _promised(rows, layout, step)
            if promised < settings.tolerance:
                break
            candidate = _moved(point, step, layout)
            new_cost = _cost(problem, candidate, layout)
            if new_cost < cost:
                break
            tries += 1
            damping = max(1e-4, damping * 10.0)
            if damping > _MAX_DAMPING:
                break
        if progress is not None:
            progress("batch", iteration / settings.max_iterations)
        if promised < settings.tolerance:
            if damping == 0.0:
                point = _moved(point, step, layout)  # the last small step is free
                cost = _cost(problem, point, layout)
                stopped = f"converged: one more step would lower the cost by {promised:.1e}"
                break
            damping = 0.0  # a damped step promises little by construction: judge by an undamped one
            continue
        if damping > _MAX_DAMPING:
            stopped = "stopped: no step lowers the cost"
            break
        point, cost = candidate, new_cost
        damping = 0.0 if damping <= 1e-4 else damping / 10.0
        if reintegrate:
            problem, again = _renew(problem, point)
            if again:
                layout = _Layout(problem)
                cost = _cost(problem, point, layout)
                renewed += again
    solved = time.perf_counter()
    if progress is not None:
        progress("covariances", 0.0)
    if damping or eliminated is None:
        eliminated = _graph(_whitened(problem, point, layout), layout, 0.0).eliminate(layout.order)
    wanted = set(layout.keys) if covariances is None else {*covariances, *layout.keys[layout.K :]}
    marginal = eliminated.covariances(wanted)
    unknown = np.full((DIM, DIM), np.nan)
    done = time.perf_counter()
    per_keyframe = {c.parameter.name: point.values[c.parameter.name][c.node] for c in problem.chains}
    records = {}
    for constraint in problem.constraints:
        s = np.sqrt(residual_record(problem, constraint, point.states, per_keyframe).nis)
        weight, _ = weight_and_cost(constraint.robust, s, constraint.robust_scale)
        records[constraint.name] = residual_record(problem, constraint, point.states, per_keyframe, weight)
    notes = problem.notes
    if renewed:
        notes = (*notes, f"{renewed} intervals integrated again because the gyro bias had moved")
    return Solution(
        solver="batch",
        frame=problem.frame,
        t=problem.t,
        states=point.states,
        covariance=np.stack([marginal.get(k, unknown) for k in range(len(problem.t))]),
        parameters=_estimates(problem, layout, point, marginal),
        records=records,
        counts={"initial_prior": 1, "imu": len(problem.t) - 1, **{c.name: len(c) for c in problem.constraints}},
        iterations=iteration,
        cost=cost,
        stopped=stopped + (f" ({tries} steps damped)" if tries else ""),
        timings={"batch": solved - began, "covariances": done - solved},
        notes=notes,
        intervals=problem.intervals,
    )


class _Layout:
    """Keys, their widths, and the order of elimination: along time, each node after its last keyframe."""

    def __init__(self, problem: Problem) -> None:
        self.K = K = len(problem.t)
        self.node_key: dict[str, Array] = {}
        after: dict[int, list[int]] = {}
        self.width = [DIM] * K
        at = K
        for chain in problem.chains:
            n = len(chain.t)
            self.node_key[chain.parameter.name] = np.arange(at, at + n)
            self.width += [len(chain.parameter.initial)] * n
            last = np.searchsorted(chain.node, np.arange(n), side="right") - 1
            for j in range(n):
                after.setdefault(K - 1 if n == 1 else int(last[j]), []).append(at + j)
            at += n
        self.keys = range(at)
        self.order = [key for k in range(K) for key in (k, *after.get(k, ()))]
        # the information root of each interval does not depend on the states: whiten with it throughout
        root = np.linalg.cholesky(problem.intervals.covariance)
        self.whitener = np.linalg.inv(root)
        self.from_key, self.to_key = np.arange(K - 1), np.arange(1, K)

    def unpack(self, vectors: list[Array]) -> tuple[Array, dict[str, Array]]:
        """(K, 15) state steps and (n, k) steps per parameter."""
        nodes = {name: np.stack([vectors[k] for k in keys]) for name, keys in self.node_key.items()}
        return np.stack(vectors[: self.K]), nodes


Rows = list[tuple[list[tuple[Array, Array]], Array]]


def _whitened(problem: Problem, point: _Point, layout: _Layout) -> Rows:
    """All factors at a point: blocks of (keys, A) and right-hand sides."""
    x = point.states
    r, Ji, Jj, Js = problem.motion.linearize(x, point.scale)
    W = layout.whitener
    links = [(layout.from_key, W @ Ji), (layout.to_key, W @ Jj)]
    if SCALE in layout.node_key:
        links.append((np.broadcast_to(layout.node_key[SCALE], layout.from_key.shape), W @ Js))
    out: Rows = [(links, -mv(W, r))]
    chains = {c.parameter.name: c for c in problem.chains}
    for rows in (problem.prior, *problem.constraints):
        linear = rows.linearize(x[rows.keyframe], point.at_rows(problem, rows), slice(None))
        scale = _scale(rows, linear.residual, linear.sigma)
        blocks = [(rows.keyframe, scale[..., None] * assemble(linear))]
        for p in rows.parameters:
            keys = layout.node_key[p.name][chains[p.name].node[rows.keyframe]]
            blocks.append((keys, scale[..., None] * linear.jacobians[p.name]))
        out.append((blocks, -scale * linear.residual))
    for chain in problem.chains:
        out.extend(_chain_rows(chain, layout.node_key[chain.parameter.name], point.values[chain.parameter.name]))
    return out


def _chain_rows(chain: ParameterChain, keys: Array, value: Array) -> Rows:
    """The prior on a parameter's first node and the walk from node to node."""
    eye = np.eye(value.shape[1])
    sigma = chain.parameter.sigma
    out: Rows = [([(keys[:1], (eye / sigma[:, None])[None])], ((chain.parameter.initial - value[0]) / sigma)[None])]
    if len(keys) > 1:
        w = 1.0 / chain.step_sigma
        A = w[..., None] * eye
        out.append(([(keys[:-1], -A), (keys[1:], A)], -w * np.diff(value, axis=0)))
    return out


def _scale(rows: Constraint, residual: Array, sigma: Array) -> Array:
    """1/sigma times the root of the robust weight, (N, m)."""
    s = np.linalg.norm(residual / sigma, axis=-1)
    weight, _ = weight_and_cost(rows.robust, s, rows.robust_scale)
    return np.sqrt(weight)[:, None] / sigma


def _graph(rows: Rows, layout: _Layout, damping: float) -> LinearGraph:
    graph = LinearGraph()
    for blocks, b in rows:
        graph.add(blocks, b)
    if damping:
        for width in set(layout.width):
            keys = np.array([k for k in layout.keys if layout.width[k] == width])
            norms = _column_norms(rows, len(layout.keys), width)[keys]
            graph.add([(keys, np.sqrt(damping) * norms[..., None] * np.eye(width))], np.zeros((len(keys), width)))
    return graph


def _column_norms(rows: Rows, count: int, width: int) -> Array:
    """(keys, width) root of the diagonal of A^T A, for the keys of one width."""
    total = np.zeros((count, width))
    for blocks, _ in rows:
        for keys, A in blocks:
            if A.shape[-1] == width:
                np.add.at(total, keys, np.sum(A * A, axis=1))
    return np.sqrt(total)


def _promised(rows: Rows, layout: _Layout, step: tuple[Array, dict[str, Array]]) -> float:
    """How much the quadratic model falls by the step."""
    width = max(layout.width)
    flat = np.zeros((len(layout.keys), width))
    flat[: layout.K, :DIM] = step[0]
    for name, keys in layout.node_key.items():
        flat[keys, : step[1][name].shape[1]] = step[1][name]
    gain = 0.0
    for blocks, b in rows:
        moved = b - sum(mv(A, flat[keys, : A.shape[-1]]) for keys, A in blocks)
        gain += 0.5 * float(np.sum(b * b) - np.sum(moved * moved))
    return gain


def _cost(problem: Problem, point: _Point, layout: _Layout) -> float:
    x = point.states
    r = problem.motion.residual(x, point.scale)
    total = 0.5 * float(np.sum(mv(layout.whitener, r) ** 2))
    for rows in (problem.prior, *problem.constraints):
        linear = rows.linearize(x[rows.keyframe], point.at_rows(problem, rows), slice(None))
        s = np.linalg.norm(linear.residual / linear.sigma, axis=-1)
        total += float(np.sum(weight_and_cost(rows.robust, s, rows.robust_scale)[1]))
    for chain in problem.chains:
        for _, b in _chain_rows(chain, np.arange(len(chain.t)), point.values[chain.parameter.name]):
            total += 0.5 * float(np.sum(b * b))
    return total


def _moved(point: _Point, step: tuple[Array, dict[str, Array]], layout: _Layout) -> _Point:
    return _Point(point.states.plus(step[0]), {name: v + step[1][name] for name, v in point.values.items()})


def _renew(problem: Problem, point: _Point) -> tuple[Problem, int]:
    """Integrate again about the present biases where the first-order correction no longer holds."""
    ba, bg = point.states.ba[:-1], point.states.bg[:-1]
    if point.scale is not None:
        bg = bg + point.scale[:3] * problem.intervals.rate
        ba = ba + point.scale[3:] * problem.intervals.force
    far = problem.intervals.out_of_range(bg)
    if not far.any():
        return problem, 0
    return problem.reintegrated(ba, bg), int(far.sum())


def _estimates(
    problem: Problem, layout: _Layout, point: _Point, covariances: dict[int, Array]
) -> dict[str, ParameterEstimate]:
    out = {}
    for chain in problem.chains:
        name = chain.parameter.name
        sigma = np.sqrt(np.stack([np.diag(covariances[int(k)]) for k in layout.node_key[name]]))
        out[name] = ParameterEstimate(chain.t, point.values[name], sigma, chain.parameter.sigma, chain.parameter.unit)
    return out
