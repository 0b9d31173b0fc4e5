"""Results of forward and backward passes over all keyframes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from graphnav.constraints.base import Constraint
from graphnav.core.interpolation import pick_nearest
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.dense import make_dense
from graphnav.estimation.problem import Problem, SolvedProblem
from graphnav.estimation.solution import ConstraintRecord, ParameterEstimate, Solution
from graphnav.estimation.solvers.invariant import add_invariant, subtract_invariant
from graphnav.estimation.solvers.linearise import Columns, Points, find_last_keyframes, linearise, scale_at, shift
from graphnav.estimation.solvers.recursion import Arrays, RowBlocks
from graphnav.estimation.solvers.stack import Innovations
from graphnav.imu.dynamics import convert_to_biases

LINEAR_ATTITUDE = 0.1  # rad between linearisation point and smoothed attitude, up to which the smoother is used
_TURN = 0.02  # rad; what is linear in an error of attitude is wrong by half its square


@dataclass(frozen=True)
class SmoothedRows:
    """The first n rows of a constraint as a smoothed solution has them."""

    residual: Array  # (n, m)
    sigma: Array  # (n, m) without the rows' weights
    covariance: Array  # (n, m, m) H P^s H^T of the residuals

    @property
    def variance(self) -> Array:
        """(n, m)"""
        return np.diagonal(self.covariance, axis1=1, axis2=2)


@dataclass(frozen=True)
class SmootherPass(Points):
    """A backward pass with the joint covariance of states and parameters at every keyframe."""

    P: Array  # (K, D, D)

    @property
    def variance(self) -> Array:
        """(K, D) of the errors."""
        return np.diagonal(self.P, axis1=1, axis2=2)

    def drop_covariances(self) -> SmootherPass:
        """The same without covariances, which are nearly all of its memory."""
        return replace(self, P=self.P[:0].copy())

    def take_rows(self, rows: Constraint, columns: Columns) -> SmoothedRows:
        """Rows of a constraint, linearised at the smoothed points."""
        linear = linearise(rows, self, columns)
        covariance = linear.H @ self.P[rows.keyframe] @ np.swapaxes(linear.H, 1, 2)
        return SmoothedRows(linear.residual, linear.stated, covariance)


@dataclass(frozen=True)
class MomentPass(Points):
    """A backward pass with what it says of the disturbances before each of n keyframes, linearised at given points.

    P^s = P- - P- N P-. Of covariances it has only those that noise estimation needs, at half the cost. Residuals are
    linear, so that squares are those of the likelihood that the forward pass has found.
    """

    r: Array  # (n, D)
    N: Array  # (n, 15, 15) of the states
    N_diagonal: Array  # (n, D)
    variance: Array  # (n, D) of the errors, of parameters with a correlation time
    residual: Array  # (n, M) of rows
    sigma: Array  # (n, M) as stated
    of_rows: Array  # (n, M, M) H P^s H^T
    places: dict[str, tuple[Array, Array]]  # of each constraint's rows, as of `Updates`

    def take_rows(self, rows: Constraint) -> SmoothedRows:
        """Those of a constraint of the problem that was smoothed."""
        k, place = self.places[rows.name]
        covariance = self.of_rows[k[:, :, None], place[:, :, None], place[:, None]]
        return SmoothedRows(self.residual[k, place], self.sigma[k, place], covariance)


@dataclass(frozen=True)
class Updates:
    """The updates of n keyframes, block by block as `graphnav.estimation.solvers.recursion.RowBlocks` has them.

    Of blocks that were not taken in there is nothing.
    """

    blocks: RowBlocks
    Kt: Array  # (n, M, D) gains transposed
    residual: Array  # (n, M) at the points
    sigma: Array  # (n, M) as stated
    H: Array  # (n, M, D)
    w: Array  # (n, M) S^-1 nu
    inverse: Array  # (n, M, M) S^-1
    taken: Array  # (B,) whether a block was taken in
    lossy: Array  # (B,) whether with a loss of digits, but for Joseph's form
    places: dict[str, tuple[Array, Array]]  # of each constraint's rows, as `graphnav.estimation.solvers.stack` has them

    @property
    def arrays(self) -> Arrays:
        """Arguments of `graphnav.estimation.solvers.disturbance.smooth_rows`."""
        return self.Kt, self.H, self.w, self.inverse, self.taken, self.lossy

    @classmethod
    def allocate(
        cls, blocks: RowBlocks, rows: Arrays, places: dict[str, tuple[Array, Array]], whole: bool = True
    ) -> Updates:
        """None yet, of rows with residuals, sigmas (n, M) and H (n, M, D); without gains if not `whole`."""
        residual, sigma, H = rows
        n, M, D = H.shape
        n *= whole
        taken, lossy = np.zeros((2, len(blocks.begin)), dtype=bool)
        gains, w, inverse = np.empty((n, M, D)), np.empty((n, M)), np.empty((n, M, M))
        return cls(blocks, gains, residual, sigma, H, w, inverse, taken, lossy, places)


@dataclass(frozen=True)
class ForwardRecord(Points):
    """A forward pass over the first K keyframes, with what the backward pass needs."""

    P: Array  # (K, D, D) filtered
    predicted: Points
    P_predicted: Array  # (K, D, D), or (2, D, D) of the last two keyframes, in their order or the other
    F: Array  # (K-1, 15, w) and
    decay: Array  # (K-1, D-15) of the steps, as `graphnav.estimation.solvers.recursion` has them
    records: dict[str, Innovations]
    weights: dict[str, Array]  # (N,) of fixes: 0 where a fault was found, less than 1 where noisy
    about: Points  # where the first n keyframes were linearised, maybe none; up to the last P is of errors about
    errors: Array  # (n, D) these points, and the filtered
    errors_predicted: Array  # (n, D) and the predicted state is these errors away from them
    updates: Updates | None  # of the keyframes there
    log_likelihood: Array  # (K,) of the innovations at each keyframe, up to a constant

    @property
    def filtered(self) -> Arrays:
        """Of the keyframes at given points, as `graphnav.estimation.solvers.recursion.filter_rows` fills them."""
        return self.errors_predicted, self.P_predicted, self.errors, self.P

    def drop_covariances(self) -> Self:
        """The same without covariances and gains, which are nearly all of its memory."""
        none = self.P[:0].copy()
        return replace(self, P=none, P_predicted=none, updates=None)

    @property
    def linearised(self) -> Points:
        """Where its rows were linearised: at points given, then where it was."""
        return join_passes([self.about, self.predicted.take(slice(len(self.about.values), None))])


@dataclass(frozen=True)
class FilterPass(ForwardRecord):
    """A forward pass over the whole problem."""

    solution: Solution


def move_points(points: Points, errors: Array) -> Points:
    """Points moved by error states (K, D)."""
    return Points(add_invariant(points.states, errors[:, :DIM]), points.values + errors[:, DIM:])


def subtract_points(points: Points, other: Points) -> Array:
    """The error states (K, D) with ``move_points(other, errors) == points``."""
    return np.concatenate([subtract_invariant(points.states, other.states), points.values - other.values], axis=1)


def join_passes(parts: list[Points]) -> Points:
    """One after the other."""
    return Points(States.stack([part.states for part in parts]), np.concatenate([part.values for part in parts]))


def are_near(points: Points, about: Points, turn: float = _TURN) -> bool:
    """Whether attitudes are near enough (rad) for what lies between to be linear."""
    turned = points.states.minus(about.states)[:, :3]
    return float(np.max(np.sum(turned * turned, axis=1))) < turn**2


def take_solution_points(problem: Problem, solved: Solution, before: Points) -> Points:
    """Points of a solution; unlisted parameters, such as places of stops, keep their values: rows are linear in
    them."""
    told = spread_nodes(problem, {name: p.value for name, p in solved.parameters.items()})
    return make_points(problem, solved.states, split_values(problem, before) | told)


def make_points(problem: Problem, states: States, known: dict[str, Array]) -> Points:
    """Points of all keyframes: states, and values (K, k) of parameters, expected ones where they are not known."""
    values = [known.get(c.parameter.name, c.mean[c.node]) for c in problem.chains]
    return Points(states, np.concatenate([np.empty((len(states), 0)), *values], axis=1))


def spread_nodes(problem: Problem, nodes: Mapping[str, Array]) -> dict[str, Array]:
    """Values (K, k) at all keyframes of parameters of which those of the nodes are given."""
    return {c.parameter.name: nodes[c.parameter.name][c.node] for c in problem.chains if c.parameter.name in nodes}


def reuse_points(points: Points, before: Problem, after: Problem) -> Points:
    """Points for another problem with the same keyframes."""
    return make_points(after, points.states, split_values(before, points))


def carry_points(points: Points, before: Problem, after: Problem, anew: Collection[str] = ()) -> Points:
    """Points for a problem of the same drive with other keyframes; beyond the first and the last, velocities stay.

    `anew` are the parameters that begin with their expected values.
    """
    none = np.zeros((len(before.t), DIM, DIM))  # covariances, which are not wanted between keyframes either
    between = make_dense(before, points.states, none, scale_at(before.columns, points.values))
    t = np.clip(after.t, before.t[0], before.t[-1])
    states, nearest = between(t)[0], pick_nearest(before.t, after.t)
    states = replace(states, p=states.p + (after.t - t)[:, None] * states.v)
    known = {name: x[nearest] for name, x in split_values(before, points).items() if name not in anew}
    return make_points(after, states, known)


def record_residuals(problem: Problem, rows: Constraint, points: Points, robust: bool = False) -> ConstraintRecord:
    """Residuals of a constraint at the solution; with `robust`, weights include the kernel's."""
    linear = linearise(rows, points, problem.columns)
    nis = np.sum((linear.residual / linear.stated) ** 2, axis=-1)
    weight = np.ones(len(rows)) if rows.weight is None else rows.weight
    if robust:
        weight = weight * linear.weigh()[0]
    t = problem.t[rows.keyframe]
    return ConstraintRecord(
        "residual", t, linear.residual, linear.stated, nis, weight, rows.axes, rows.unit, **rows.labels
    )


def make_solution(
    problem: Problem,
    solver: str,
    points: Points,
    covariance: Array,
    sigma: Array,
    ahead: Array | None = None,
    notes: tuple[str, ...] = (),
    **found: Any,
) -> Solution:
    """The solution of a solver, by its estimates at all keyframes and covariances (K, 15, 15) of their states.

    Parameters
    ----------
    sigma : (K, D-15) of parameters.
    ahead : (K-1, 15, 15) of a filter, whose states between them do not know the future: covariances of the predictions.
    found : other fields of the solution.
    """
    scale = scale_at(problem.columns, points.values)
    return Solution(
        solver, problem.frame, problem.t, points.states, covariance, estimate_parameters(problem, points.values, sigma),
        counts={"initial_prior": 1, "imu": len(problem.t) - 1, **{c.name: len(c) for c in problem.constraints}},
        notes=(*problem.notes, *notes),
        graphs=(SolvedProblem(problem, points.states, points.select_nodes(problem)),),
        between=(make_dense(problem, points.states, covariance, scale, ahead),),
        **found,
    )  # fmt: skip


def integrate_again(problem: Problem, states: States, scale: Array | None, first: int = 0) -> tuple[Problem, int]:
    """The problem integrated about the present biases where the first-order correction no longer holds, and how often.

    Parameters
    ----------
    states : of keyframes from `first` on; intervals before stay as they are, of those behind the last is the guess.
    scale : (k,) scale errors of the IMU, where they are parameters.
    """
    intervals = problem.intervals
    rows = slice(first, len(intervals.bg))
    near = slice(first, min(first + 2 * len(states), rows.stop))  # of a long drive: what is further ahead can wait
    if not intervals.is_out_of_range(_guess_biases(problem, states, scale, near)[1], near).any():
        return problem, 0
    ba, bg = intervals.ba.copy(), intervals.bg.copy()
    ba[rows], bg[rows] = _guess_biases(problem, states, scale, rows)
    return problem.reintegrate(ba, bg), int(intervals.is_out_of_range(bg).sum())


def _guess_biases(problem: Problem, states: States, scale: Array | None, rows: slice) -> tuple[Array, Array]:
    """Biases (n, 3) of intervals `rows`, the first of which begins at the first of some states."""
    at = np.minimum(np.arange(rows.stop - rows.start), max(len(states) - 2, 0))
    ba, bg = states.ba[at], states.bg[at]
    if scale is None:
        return ba, bg
    of_accel, of_gyro = convert_to_biases(scale, *(x[rows] for x in problem.intervals.inputs))
    return ba + of_accel, bg + of_gyro


def split_values(problem: Problem, points: Points) -> dict[str, Array]:
    """(K, k) per parameter."""
    return {name: points.values[:, shift(at)] for name, at in problem.columns.items()}


def estimate_parameters(problem: Problem, values: Array, sigma: Array) -> dict[str, ParameterEstimate]:
    """At each node: the value after the last keyframe that it governs, by those at keyframes (K, D-15)."""
    out = {}
    for chain in problem.chains:
        if not chain.parameter.listed:
            continue
        p, at, last = chain.parameter, shift(problem.columns[chain.parameter.name]), find_last_keyframes(chain)
        out[p.name] = ParameterEstimate(chain.t, values[last, at], sigma[last, at], p.prior_sigma, p.unit)
    return out


def compute_sigmas(P: Array) -> Array:
    """(K, D-15) 1-sigma of parameters by covariances (K, D, D)."""
    return np.sqrt(np.maximum(np.diagonal(P, axis1=-2, axis2=-1)[:, DIM:], 0.0))
