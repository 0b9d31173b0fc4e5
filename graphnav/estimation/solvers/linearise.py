"""Everything linearised at given points: the rows of constraints, the intervals of the IMU, the steps of parameters.

The one place where solvers ask constraints for residuals and Jacobians. Filter, RTS smoother, the graph for GTSAM's QR,
iSAM2 and the window take from here what they stack, eliminate or update with.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from graphnav.constraints.base import Constraint, Linearized, assemble, weigh_sigma
from graphnav.core.rotation import Array, mv
from graphnav.core.state import DIM, States
from graphnav.estimation.problem import ParameterChain, Problem
from graphnav.estimation.solvers.robust import weigh_squares
from graphnav.imu.dynamics import SCALE, ImuFactors

Columns = dict[str, slice]


@dataclass(frozen=True)
class Points:
    """Where rows are linearised: K states and the parameters' values there."""

    states: States
    values: Array  # (K, D-15)

    def take(self, index: slice | Array) -> Points:
        """Some of them."""
        return Points(self.states[index], self.values[index])

    def put(self, index: slice, points: Points) -> None:
        """Some of them, replaced."""
        for name in ("R_nb", "p", "v", "ba", "bg"):
            getattr(self.states, name)[index] = getattr(points.states, name)
        self.values[index] = points.values

    @classmethod
    def allocate(cls, n: int, width: int) -> Points:
        """None yet, of so many parameters' values."""
        return Points(States(np.empty((n, 3, 3)), *np.empty((4, n, 3))), np.empty((n, width)))

    def select_nodes(self, problem: Problem) -> dict[str, Array]:
        """(n, k) per parameter: the value of each node after the last keyframe that it governs, its mean if none."""
        out = {}
        for c in problem.chains:
            last, at = find_last_keyframes(c), shift(problem.columns[c.parameter.name])
            governs = c.node[last] == np.arange(len(c.t))
            out[c.parameter.name] = np.where(governs[:, None], self.values[last, at], c.mean)
        return out


@dataclass(frozen=True)
class Rows:
    """Some rows of a constraint at points: residual (n, m), its Jacobian over D error states, sigma."""

    constraint: Constraint
    which: slice | Array
    linear: Linearized
    columns: Columns  # of the parameters in H
    H: Array  # (n, m, D) derivative of the residual

    @property
    def residual(self) -> Array:
        """(n, m)"""
        return self.linear.residual

    @property
    def stated(self) -> Array:
        """(n, m) sigmas without the rows' weights."""
        return self.linear.sigma

    @cached_property
    def sigma(self) -> Array:
        """(n, m) sigmas with the rows' weights in them: infinite where a row is not used."""
        return weigh_sigma(self.constraint, self.linear.sigma, self.which)

    def weigh(self) -> tuple[Array, Array]:
        """Weight and cost (n,) of each row by its robust kernel."""
        c = self.constraint
        s = np.linalg.norm(self.residual / self.sigma, axis=-1)
        return weigh_squares(c.robust, s, c.scale_of(self.which), c.graduation)


@dataclass(frozen=True)
class Step:
    """A parameter that steps to its next node, or begins: value - mean = decay (before - mean_before) + noise."""

    name: str
    mean: Array  # (k,)
    sigma: Array  # (k,)
    decay: float = 0.0
    mean_before: Array | float = 0.0

    def predict(self, before: Array | float) -> Array:
        """(k,) the value that it is expected to have, by that before."""
        return self.mean + self.decay * (before - self.mean_before)


@dataclass(frozen=True)
class Advance:
    """All parameters, from each of n keyframes to the next: value <- mean + decay (value - before) + noise.

    Where none moves on to its next node it stays: 0, 0, 1, and no noise.
    """

    mean: Array  # (n-1, D-15)
    before: Array  # (n-1, D-15)
    decay: Array  # (n-1, D-15)
    added: Array  # (n-1, D-15) variance

    def predict(self, rows: int | slice, values: Array) -> Array:
        """The values that are expected after the steps `rows`."""
        return np.asarray(self.mean[rows] + self.decay[rows] * (values - self.before[rows]))


def advance(problem: Problem, n: int) -> Advance:
    """Of the first n keyframes."""
    width = sum(at.stop - at.start for at in problem.columns.values())
    out = Advance(*(np.full((n - 1, width), x) for x in (0.0, 0.0, 1.0, 0.0)))
    for chain in problem.chains:
        k, own = find_stepping(chain, n), shift(problem.columns[chain.parameter.name])
        j = chain.node[k]
        out.mean[k - 1, own], out.before[k - 1, own] = chain.mean[j], chain.mean[j - 1]
        out.decay[k - 1, own], out.added[k - 1, own] = chain.decay[j, None], chain.sigma[j] ** 2
    return out


def list_node_steps(problem: Problem) -> dict[int, tuple[Step, ...]]:
    """The parameters that begin or move on to their next node, by keyframe."""
    out: dict[int, list[Step]] = {}
    for chain in problem.chains:
        name = chain.parameter.name
        out.setdefault(0, []).append(Step(name, chain.mean[0], chain.sigma[0]))
        for k in find_stepping(chain).tolist():
            j = int(chain.node[k])
            step = Step(name, chain.mean[j], chain.sigma[j], float(chain.decay[j]), chain.mean[j - 1])
            out.setdefault(k, []).append(step)
    return {k: tuple(steps) for k, steps in out.items()}


def linearise(
    constraint: Constraint,
    points: Points,
    columns: Columns,
    which: slice | Array = slice(None),
    at: Array | None = None,
) -> Rows:
    """Rows `which` of a constraint at points.

    Parameters
    ----------
    columns : where each parameter stands in the error state; one that has not begun is at its first value.
    at : (n,) which point each row is at; its keyframe when None.
    """
    values, states = points.values, points.states
    at = constraint.keyframe[which] if at is None else at
    if len(at) != 1 or len(values) != 1:
        values, states = values.take(at, axis=0), states[at]
    given = {
        p.name: values[:, shift(columns[p.name])]
        if p.name in columns
        else np.broadcast_to(np.atleast_2d(p.initial)[0], (len(values), p.size))
        for p in constraint.parameters
    }
    linear = constraint.linearize(states, given, which)
    return Rows(constraint, which, linear, columns, assemble(linear, columns, DIM + values.shape[1]))


def linearise_links(
    motion: ImuFactors, states: States, scale: Array | None, which: slice = slice(None)
) -> tuple[Array, Array, Array, Array]:
    """Whitened rows of intervals `which` between K states: A (K-1, 15, 15) of both ends, S (K-1, 15, k) of the scale,
    and b.

    A_start d_start + A_end d_end + S d_scale = b
    """
    r, A_start, A_end, S = motion.linearize(states, scale, which)
    W = motion.whitener[which]
    return W @ A_start, W @ A_end, W @ S, -mv(W, r)


def scale_at(columns: Columns, values: Array) -> Array | None:
    """Scale errors of the IMU among parameters (..., D-15), where they are estimated."""
    return values[..., shift(columns[SCALE])] if SCALE in columns else None


def shift(columns: slice) -> slice:
    """Where columns of an error state stand among the parameters' values."""
    return slice(columns.start - DIM, columns.stop - DIM)


def find_last_keyframes(chain: ParameterChain) -> Array:
    """(n,) the last keyframe that each node governs."""
    return np.searchsorted(chain.node, np.arange(len(chain.t)), side="right") - 1


def find_stepping(chain: ParameterChain, n: int | None = None) -> Array:
    """Which of the first n keyframes a parameter steps to its next node at."""
    return chain.steps if n is None else chain.steps[: chain.steps.searchsorted(n)]
