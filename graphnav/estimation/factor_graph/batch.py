"""Batch smoother: the whole drive as one factor graph, solved by Gauss-Newton with Levenberg-Marquardt.

Minimises, over all keyframe states and parameter nodes,

    1/2 |prior|^2 + 1/2 sum |interval residual|^2_Q + sum rho(|constraint residual|_R)

Each iteration linearises everything at once in NumPy, hands the whitened rows to GTSAM as Gaussian factors, eliminates
with QR and moves the states on their manifold. A step that raises the cost is rejected and damped (Marquardt's scaling:
lambda times the column norms). Converged means that the quadratic model promises less than `tolerance` from another
step, in units of half squared sigmas: the optimum is then within sqrt(2 tolerance) sigma in every direction at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from graphnav.core.notes import Note, format_count
from graphnav.core.progress import Progress
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.factor_graph.gaussian import Eliminated, eliminate
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.linearise import Points, scale_at
from graphnav.estimation.solvers.passes import (
    integrate_again,
    make_points,
    make_solution,
    record_residuals,
    spread_nodes,
)
from graphnav.estimation.solvers.robust import REDESCENDING
from graphnav.estimation.solvers.rows import (
    Layout,
    WhitenedRows,
    compute_column_norms,
    whiten,
)

_GRADUATION = 1.4  # by which mu grows from step to step
_SHARP = 100.0  # mu from which on the kernel bends within half a per cent of its scale
_MIN_DAMPING, _MAX_DAMPING = 1e-4, 1e8
# of a step: the states it starts from, their cost, by how much it promises to lower that, and whether two before it had
# to be shortened or damped and did not halve it
Callback = Callable[[States, float, float, bool], None]


def batch(
    problem: Problem,
    start: States,
    values: Mapping[str, Array] | None = None,
    progress: Progress | None = None,
    wanted: tuple[int, ...] | None = None,
    reintegrate: bool = True,
    watch: Callback | None = None,
) -> Solution:
    """Solve a problem from any starting states (K rows) and values (nodes, k) of parameters, their means if not given.

    `wanted` are the keyframes whose covariance is wanted, all when None; others are NaN. `reintegrate`
    allows intervals to be integrated again when the gyro bias moves far. `watch` sees each undamped step
    before it is made, and what it raises ends the iterations.
    """
    began = time.perf_counter()
    points, notes = make_points(problem, start, spread_nodes(problem, values or {})), []
    if any(c.robust in REDESCENDING and c.robust != "gnc" for c in problem.constraints):
        # a redescending kernel ignores rows far from the start; Cauchy's keeps some of their influence and leads there
        rows = (replace(c, robust="cauchy") if c.robust in REDESCENDING else c for c in problem.constraints)
        points = _minimise(replace(problem, constraints=tuple(rows)), points, progress, reintegrate).points
    for gentle in _graduate(problem, points):
        points = _minimise(gentle, points, progress, reintegrate, 1).points
    found = _minimise(problem, points, progress, reintegrate, watch=watch)
    problem, points, layout = found.problem, found.points, found.layout
    solved = time.perf_counter()
    if progress is not None:
        progress("covariances", 0.0)
    keys = list(layout.keys) if wanted is None else [*wanted, *layout.keys[layout.K :]]
    assert found.eliminated is not None
    of_variables = found.eliminated.compute_covariances(set(layout.variable[keys].tolist()))
    marginal = dict(zip(keys, layout.split(of_variables, keys), strict=True))
    unknown = np.full((DIM, DIM), np.nan)
    covariance = np.stack([marginal.get(k, unknown) for k in range(layout.K)])
    sigma = layout.unpack([np.sqrt(np.diagonal(marginal.get(key, unknown))) for key in layout.keys])[:, DIM:]
    done, records = time.perf_counter(), {}
    for constraint in problem.constraints:
        record = records[constraint.name] = record_residuals(problem, constraint, points, robust=True)
        if constraint.robust != "none" and np.mean(record.weight < 0.1) > 0.5:
            notes.append(
                Note(
                    "solver.outliers",
                    f"most rows of {constraint.name} are down-weighted as outliers: do not trust this solution",
                )
            )
    return make_solution(
        problem, "batch", points, covariance, sigma, notes=(*found.notes, *notes), records=records,
        iterations=found.iterations, cost=found.cost, stopped=found.stopped,
        timings={"batch": solved - began, "covariances": done - solved},
    )  # fmt: skip


@dataclass(frozen=True)
class _Minimum:
    problem: Problem  # with intervals integrated about the final biases
    points: Points
    layout: Layout
    eliminated: Eliminated | None  # undamped, at the point; None where the iterations were limited
    cost: float
    iterations: int
    stopped: str
    notes: tuple[str, ...]


def _graduate(problem: Problem, points: Points) -> Iterator[Problem]:
    """The problem with its "gnc" kernels convex at first and then ever less so, for a step each."""
    mu: dict[str, float] = {}
    for c in problem.constraints:
        if c.robust == "gnc":
            s2 = record_residuals(problem, c, points).nis * (1.0 if c.weight is None else c.weight)
            if np.max(s2) > c.robust_scale**2:
                mu[c.name] = float(1.0 / (2.0 * float(np.max(s2)) / c.robust_scale**2 - 1.0))
    while mu and min(mu.values()) < _SHARP:
        rows = (replace(c, graduation=mu.get(c.name, np.inf)) for c in problem.constraints)
        yield replace(problem, constraints=tuple(rows))
        mu = {name: _GRADUATION * x for name, x in mu.items()}


@dataclass(frozen=True)
class _Candidate:
    points: Points
    rows: WhitenedRows
    cost: float


def _minimise(
    problem: Problem,
    points: Points,
    progress: Progress | None,
    reintegrate: bool,
    iterations: int | None = None,
    watch: Callback | None = None,
) -> _Minimum:
    settings = problem.settings.solver
    if iterations is not None:
        settings = settings.model_copy(update={"max_iterations": iterations})
    renewed = refused = 0
    if reintegrate:
        problem, renewed = integrate_again(problem, points.states, scale_at(problem.columns, points.values[0]))
    layout = Layout(problem)
    here = _evaluate(problem, points, layout)
    damping, gentlest, slow = 0.0, _MIN_DAMPING, 0
    stopped = f"stopped at the limit of {settings.max_iterations} iterations"
    eliminated: Eliminated | None = None
    iteration = 0
    while iteration < settings.max_iterations:
        iteration += 1
        if progress is not None:
            progress("batch", iteration / settings.max_iterations)
        shortened = False
        while True:
            eliminated, step, gain = solve_rows(here.rows, layout, damping)
            if watch is not None and damping == 0.0:
                watch(here.points.states, here.cost, gain, slow > 1)
            ahead = _evaluate(problem, _move(here.points, step), layout)
            if gain < settings.tolerance:
                break
            if damping == 0.0:
                ahead, shortened = _improve(problem, here, step, gain, ahead, layout)
            if reintegrate and ahead.cost < here.cost:
                # biases that move far are linear no longer: about these, the cost may be higher
                ahead, about, again = _integrate(problem, ahead, layout)
                if ahead.cost < here.cost:
                    (problem, layout), renewed = about, renewed + again
            if ahead.cost < here.cost:
                break
            refused += 1
            damping = max(gentlest, 10.0 * damping)
            if damping > _MAX_DAMPING:
                break
        if damping > _MAX_DAMPING:
            stopped, eliminated = "stopped: no step lowers the cost", None
            break
        if gain < settings.tolerance and damping == 0.0:
            if ahead.cost < here.cost:
                here = ahead  # the last small step is free
            stopped = f"converged: one more step would lower the cost by {gain:.1e}"
            break
        slow = slow + 1 if (shortened or damping > 0.0) and ahead.cost > 0.5 * here.cost else 0
        if ahead.cost < here.cost:
            here = ahead
        eliminated = None
        # a damped step promises little by construction: convergence is judged by an undamped one
        if damping == gentlest:
            gentlest /= 10.0  # a larger step would have been possible: less damping in a long valley
        damping = 0.0 if damping <= _MIN_DAMPING or gain < settings.tolerance else damping / 10.0
    if eliminated is None and iterations is None:
        eliminated = solve_rows(here.rows, layout)[0]
    notes = []
    if refused:
        stopped += f" ({refused} steps taken back and damped)"
    if renewed:
        notes.append(
            Note(
                "solver.integrated_again",
                f"{format_count(renewed, 'interval')} re-integrated because the gyro bias estimate had changed",
            )
        )
    return _Minimum(problem, here.points, layout, eliminated, here.cost, iteration, stopped, tuple(notes))


def _evaluate(problem: Problem, points: Points, layout: Layout) -> _Candidate:
    return _Candidate(points, *whiten(problem, points, layout))


def _integrate(problem: Problem, here: _Candidate, layout: Layout) -> tuple[_Candidate, tuple[Problem, Layout], int]:
    """A candidate with intervals integrated about its own biases where these have moved far, the problem and layout
    that it is then of, and how many intervals.
    """
    scale = scale_at(problem.columns, here.points.values[0])
    again, count = integrate_again(problem, here.points.states, scale)
    if not count:
        return here, (problem, layout), 0
    layout = Layout(again)
    return _evaluate(again, here.points, layout), (again, layout), count


def _improve(
    problem: Problem, here: _Candidate, step: Array, gain: float, ahead: _Candidate, layout: Layout
) -> tuple[_Candidate, bool]:
    """Where an undamped step (K, D) leads, or a better candidate if it lowers the cost by less than half of `gain`, its
    promise; and whether that is a part of a step that would raise the cost.
    """
    raises = not ahead.cost < here.cost
    if raises:
        # a correction of an early heading moves all later positions along tangents, off the track by the square of the
        # angle; the next step corrects that, so both are assessed together
        beyond = _evaluate(problem, _move(ahead.points, solve_rows(ahead.rows, layout)[1]), layout)
        if beyond.cost < here.cost:
            return beyond, False
    if not ahead.cost < here.cost - 0.5 * gain:
        # to the minimum of the parabola along the step by the cost here, its slope of -2 gain, and the cost ahead
        # (Nocedal and Wright 2006, eq. 3.58): kernels and turns may double the curvature, and full steps swing
        part = gain / (ahead.cost - here.cost + 2.0 * gain)
        nearer = _evaluate(problem, _move(here.points, part * step), layout)
        if nearer.cost < min(here.cost, ahead.cost):
            return nearer, raises
    return ahead, False


def _move(points: Points, step: Array) -> Points:
    """Points moved by a step (K, D)."""
    return Points(points.states.plus(step[:, :DIM]), points.values + step[:, DIM:])


def solve_rows(rows: WhitenedRows, layout: Layout, damping: float = 0.0) -> tuple[Eliminated, Array, float]:
    """Eliminate the rows; the step (K, D) to their optimum, and the decrease of their cost by it."""
    size = np.sqrt(damping) * compute_column_norms(rows, layout) if damping else None
    if size is not None:
        rows = list(rows)
        for width in sorted(set(layout.width)):
            keys = np.array([k for k in layout.keys if layout.width[k] == width])
            rows.append(([(keys, size[keys, :width, None] * np.eye(width))], np.zeros((len(keys), width))))
    eliminated = eliminate(layout.join(rows), layout.order)
    of_variables = dict(zip(layout.order, eliminated.solve(layout.order), strict=True))
    found, gain = layout.split(of_variables, layout.keys), eliminated.decrease()
    if size is not None:  # the damping rows are not part of the cost
        gain += 0.5 * sum(float(np.sum((s[: len(x)] * x) ** 2)) for s, x in zip(size, found, strict=True))
    return eliminated, layout.unpack(found), gain
