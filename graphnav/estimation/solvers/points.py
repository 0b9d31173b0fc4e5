"""Where a filter takes its Jacobians: at its own estimate, or at points that are given.

A filter goes from keyframe to keyframe with an estimate x and the covariance of its error, and asks one of these for
the step to a keyframe and for the rows there. `AtEstimate` linearises where the filter is: x is a state and parameter
values. `AtPoints` has linearised everything at once, at the points X of an earlier pass: x is the error state e with
X_k [+] e_k the estimate, and (Bell 1994: one step of the iterated smoother)

    e_{k+1} <- f(X_k) [-] X_{k+1} + F e_k     nu = -(r(X) + H e)

A pass at given points takes a ninth of the time, and is the better one wherever the filter has gone astray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.invariant import minus_invariant, plus_invariant, transport_covariance
from graphnav.estimation.solvers.linearise import Advance, Points, linearise, shift
from graphnav.estimation.solvers.recursion import turn
from graphnav.estimation.solvers.stack import RowBlock, Stack
from graphnav.imu.dynamics import SCALE

Rows = tuple[Array, Array, Array]  # residuals (m,), Jacobian (m, D) and sigmas (m,)


@dataclass(frozen=True)
class Estimate:
    """A state of one row and parameter values (D-15,)."""

    state: States
    values: Array


class AtEstimate:
    """Steps and rows linearised where the filter is."""

    def __init__(self, problem: Problem, steps: Advance) -> None:
        self._problem, self._columns, self._scale = problem, problem.columns, problem.columns.get(SCALE)
        self._steps, self._width = steps, DIM + steps.decay.shape[1]

    def step(self, k: int, x: Estimate) -> tuple[Estimate, Array, Array]:
        """The estimate at keyframe k from that at the one before, and F (15, w) and Q (15, 15) of the states."""
        at = slice(k - 1, k)
        ahead, F = predict_states(self._problem, at, x.state, x.values[None])
        return (
            Estimate(ahead, self._steps.ahead(k - 1, x.values)),
            F[0],
            self._problem.motion.noise(at, x.state.R_nb)[0],
        )

    def rows(self, some: RowBlock, at: Estimate) -> Rows:
        """Rows of one constraint linearised at an estimate."""
        ((rows, lo, hi),) = some.parts
        here = Points(at.state, at.values[None])
        linear = linearise(rows, here, self._columns, slice(lo, hi), np.zeros(hi - lo, dtype=int))
        return linear.residual.ravel(), linear.H.reshape(-1, self._width), linear.stated.ravel()

    @staticmethod
    def about(x: Estimate) -> tuple[Estimate, None]:
        """What the rows of an update are linearised about, and the error state (D,) from there to x if there is one."""
        return x, None

    @staticmethod
    def passes(some: RowBlock) -> int:
        """How often the rows of an update are linearised."""
        return some.parts[0][0].passes

    @staticmethod
    def plus(at: Estimate, d: Array) -> Estimate:
        """`at` moved by an error state."""
        return Estimate(plus_invariant(at.state, d[None, :DIM]), at.values + d[DIM:])

    @staticmethod
    def minus(x: Estimate, at: Estimate) -> Array:
        """The error state (D,) that leads from `at` to x."""
        return np.concatenate([minus_invariant(x.state, at.state)[0], x.values - at.values])

    @staticmethod
    def carry(P: Array, x: Estimate, to: Estimate) -> Array:
        """The covariance P (D, D) of errors about x as one of errors about an estimate that x has moved to."""
        return transport_covariance(P[None], x.state, to.state)[0]


class AtPoints:
    """Steps and rows of the first n keyframes, all linearised at n points.

    Parameters
    ----------
    F : (n-1, 15, w) or more, for the transition matrices.
    """

    def __init__(self, problem: Problem, points: Points, stack: Stack, steps: Advance, F: Array) -> None:
        n, columns, self._steps = len(points.values), problem.columns, steps
        D = DIM + points.values.shape[1]
        begin, end, at = points.states[: n - 1], points.states[1:n], slice(0, n - 1)
        ahead, F[: n - 1] = predict_states(problem, at, begin, points.values[: n - 1])
        self.F, self.Q = F[: n - 1], problem.motion.noise(at, begin.R_nb)
        values = steps.ahead(at, points.values[: n - 1])
        self.gap = np.concatenate([ahead.minus(end), values - points.values[1:]], axis=1)
        # Exp(gap) Exp(F e) = Exp(gap + J_r^-1(gap) F e)
        turned = rotation.right_jacobian_inverse(self.gap[:, :3])
        self.F[:, :3] = turned @ self.F[:, :3]
        self.Q[:, :3] = turned @ self.Q[:, :3]
        self.Q[:, :, :3] = self.Q[:, :, :3] @ np.swapaxes(turned, -1, -2)
        self.speeds = np.linalg.norm(points.states.v, axis=1)
        self.r, self._sigma = np.zeros((n, stack.M)), np.ones((n, stack.M))
        self.H = np.zeros((n, stack.M, D))
        for rows in problem.constraints:
            at_k = rows.keyframe[: int(np.searchsorted(rows.keyframe, n))]
            if len(at_k):
                linear = linearise(rows, points, columns, slice(0, len(at_k)))
                place = at_k[:, None], stack.places[rows.name][1][: len(at_k)]
                self.r[place], self._sigma[place] = linear.residual, linear.stated
                self.H[place] = linear.H
        self.variance = (self._sigma / stack.root_weight[:n]) ** 2

    def weigh(self, some: RowBlock, root_weight: float | Array) -> None:
        """Weigh some rows anew: the root of the weight of all, or of each number."""
        self.variance[some.at] = (self._sigma[some.at] / root_weight) ** 2

    def step(self, k: int, x: Array) -> tuple[Array, Array, Array]:
        """As `AtEstimate.step`, of error states (D,)."""
        F, ahead = self.F[k - 1], self.gap[k - 1].copy()
        ahead[:DIM] += F @ x[: F.shape[1]]
        ahead[DIM:] += self._steps.decay[k - 1] * x[DIM:]
        return ahead, F, self.Q[k - 1]

    def rows(self, some: RowBlock, at: None) -> Rows:
        """As `AtEstimate.rows`, linearised at the points."""
        at_k = some.at
        return self.r[at_k], self.H[at_k], self._sigma[at_k]

    @staticmethod
    def about(x: Array) -> tuple[None, Array]:
        """The points, which all error states are from."""
        return None, x

    @staticmethod
    def passes(some: RowBlock) -> int:
        """The points stay."""
        return 1

    @staticmethod
    def plus(at: None, d: Array) -> Array:
        """The points moved by an error state."""
        return d

    @staticmethod
    def carry(P: Array, x: Array, to: Array) -> Array:
        """The points stay."""
        return P


def predict_states(problem: Problem, at: slice, states: States, values: Array) -> tuple[States, Array]:
    """The states at the ends of intervals `at`, and F (n, 15, w) there, by the states and by the scale errors."""
    scale, motion = problem.columns.get(SCALE), problem.motion
    if scale is None:
        return motion.propagate(at, states)
    ahead, F = motion.propagate(at, states, values[:, shift(scale)])
    return ahead, np.concatenate([F, motion.scale_columns(at, F, scale.stop - scale.start)], axis=2)


def move_covariance(P: Array, e: Array) -> Array:
    """Covariances (K, D, D) of errors about points turned into those about states e (K, D) away from them.

    Exp(e + x) = Exp(e) Exp(J_r(e) x) to first order in x.
    """
    return np.asarray(turn(np.ascontiguousarray(P), rotation.right_jacobian(e[:, :3])))
