"""The filter linearised at points that are given, those of an earlier pass, all at once.

Its estimate at keyframe k is X_k [+] e_k, with X_k the point and e_k the error state that the filter finds (Bell 1994:
one step of the iterated smoother):

    e_{k+1} <- f(X_k) [-] X_{k+1} + F e_k     nu = -(r(X) + H e)

A pass at given points takes a fraction of the time of one linearised at its own estimates
(`graphnav.estimation.solvers.stretches`), and is more accurate wherever the filter diverged.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from graphnav.core import rotation
from graphnav.core.progress import Progress
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import explain_rows
from graphnav.estimation.solvers.invariant import turn
from graphnav.estimation.solvers.linearise import Advance, Columns, Points, Rows, linearise, scale_at
from graphnav.estimation.solvers.passes import Updates
from graphnav.estimation.solvers.recursion import STRETCH, Arrays, filter_rows
from graphnav.estimation.solvers.stack import RowBlock, Stack

_STRETCH_AFTER_FAULT = 4  # keyframes that are filtered at once, behind one at which something was found
Follow = Callable[[int, int], int]  # checks the filtered keyframes from one to another, and returns where to continue


@dataclass(frozen=True)
class Linearisation:
    """Steps and rows of a problem at points of its first n keyframes."""

    columns: Columns
    F: Array  # (n-1, 15, w)
    gap: Array  # (n-1, D) where a step leads from a point, less the next point
    turned: Array  # (n-1, 3, 3): Exp(gap) Exp(F e) = Exp(gap + turned F e)
    r: Array  # (n, M)
    sigma: Array  # (n, M) as stated
    H: Array  # (n, M, D)

    @classmethod
    def of(cls, problem: Problem, points: Points, stack: Stack, steps: Advance) -> Linearisation:
        """At points that stand in the order of the problem's keyframes."""
        n = len(points.values)
        at, begin, end = slice(0, n - 1), points.states[: n - 1], points.states[1:n]
        ahead, F = problem.motion.propagate(at, begin, scale_at(problem.columns, points.values[: n - 1]))
        values = steps.predict(at, points.values[: n - 1])
        gap = np.concatenate([ahead.minus(end), values - points.values[1:]], axis=1)
        turned = rotation.right_jacobian_inverse(gap[:, :3])
        F[:, :3] = turned @ F[:, :3]
        r, sigma, H = allocate_rows(n, stack.M, points)
        for rows in problem.constraints:
            linear = linearise(rows, points, problem.columns, slice(0, int(rows.keyframe.searchsorted(n))))
            _put_rows(linear, stack, r, sigma, H)
        return cls(problem.columns, F, gap, turned, r, sigma, H)

    def lift(self, problem: Problem, points: Points, stack: Stack, anew: Collection[str]) -> Linearisation:
        """Of a problem that differs from this one by the rows of some constraints, and has all of its parameters."""
        if not anew and problem.columns == self.columns:
            return self
        n, M, _ = self.H.shape
        gap, H = np.zeros((n - 1, DIM + points.values.shape[1])), np.zeros((n, M, DIM + points.values.shape[1]))
        states = slice(0, DIM)
        for to, own in ((states, states), *((problem.columns[name], own) for name, own in self.columns.items())):
            gap[:, to], H[:, :, to] = self.gap[:, own], self.H[:, :, own]
        r, sigma = self.r.copy(), self.sigma.copy()
        for rows in problem.constraints:
            if rows.name in anew:
                _put_rows(linearise(rows, points, problem.columns), stack, r, sigma, H)
        return Linearisation(problem.columns, self.F, gap, self.turned, r, sigma, H)

    def compute_noise(self, problem: Problem, points: Points) -> Array:
        """Q (n-1, 15, 15) of the steps."""
        Q = problem.motion.compute_noise(slice(0, len(self.gap)), points.states.R_nb[: len(self.gap)])
        Q[:, :3] = self.turned @ Q[:, :3]
        Q[:, :, :3] = Q[:, :, :3] @ np.swapaxes(self.turned, -1, -2)
        return Q


class PointFilter:
    """Filter the first keyframes linearised at given points.

    Parameters
    ----------
    one : the problem there.
    filtered : as of `graphnav.estimation.solvers.recursion.filter_rows`.
    whole : False for the innovations in the stack only, without gains.
    Q : of the steps, where it is known.
    """

    def __init__(
        self, problem: Problem, points: Points, stack: Stack, steps: Advance, one: Linearisation, filtered: Arrays,
        whole: bool = True, Q: Array | None = None,
    ) -> None:  # fmt: skip
        n = len(points.values)
        self._stack, self._steps, self._filtered = stack, steps, filtered
        self.F, self.gap = one.F, one.gap
        self.Q = one.compute_noise(problem, points) if Q is None else Q
        self.speeds = np.linalg.norm(points.states.v, axis=1)
        self.r, self._sigma, self.H = one.r, one.sigma, one.H
        self.variance = (self._sigma / stack.root_weight[:n]) ** 2
        self.used = stack.joint.used.copy()
        self.updates = Updates.allocate(stack.joint, (one.r, one.sigma, one.H), stack.places, whole)
        self._at = np.zeros(1, dtype=int)

    def weigh(self, some: RowBlock, used: bool, root_weight: float | Array) -> None:
        """Weigh some rows anew: the root of the weight of all, or of each number."""
        self.used[some.number] = used
        self.variance[some.at] = (self._sigma[some.at] / root_weight) ** 2

    def run(self, begin: Callable[[], tuple[Array, Array]], follow: Follow | None, progress: Progress | None) -> None:
        """Filter all keyframes, from `begin`: errors (D,) and P before the first.

        The filter runs ahead by a stretch of keyframes, and `follow` checks it afterwards; at a detection both continue
        from there.
        """
        n, k, length = len(self.H), 0, STRETCH
        while k < n:
            end = min(k + length, n)
            self._filter(k, end, begin)
            on = end if follow is None else follow(k, end)
            # after a fault the next one is likely near, so shorter stretches waste less
            k, length = on, min(2 * length, STRETCH) if on == end else _STRETCH_AFTER_FAULT
            if progress is not None:
                progress("filter", k / self._stack.K)

    def _filter(self, k0: int, k1: int, begin: Callable[[], tuple[Array, Array]]) -> None:
        stack, n = self._stack, len(self.H)
        e, P = (x[(k0 - 1) % len(x)] for x in self._filtered[2:]) if k0 else begin()
        try:
            filter_rows(
                k0, k1, e, P, (self.F, self._steps.decay, self.gap, self.Q, self._steps.added),
                (self.r, self.H, self.variance, stack.scale[:n]), stack.joint.arrays, self.used,
                self._filtered, (stack.root, stack.solved, stack.bent), self.updates.arrays, self._at,
            )  # fmt: skip
        except np.linalg.LinAlgError:
            raise explain_rows(stack.get_block(int(self._at[0])).parts) from None


def allocate_rows(n: int, M: int, points: Points) -> tuple[Array, Array, Array]:
    """Residuals (n, M), sigmas (n, M) and Jacobians (n, M, D) of no rows yet."""
    return np.zeros((n, M)), np.ones((n, M)), np.zeros((n, M, DIM + points.values.shape[1]))


def _put_rows(linear: Rows, stack: Stack, r: Array, sigma: Array, H: Array) -> None:
    """The first rows of a constraint, in their places."""
    k, place = (x[: len(linear.residual)] for x in stack.places[linear.constraint.name])
    r[k, place], sigma[k, place], H[k, place] = linear.residual, linear.stated, linear.H


def move_covariance(P: Array, e: Array) -> Array:
    """Covariances (K, D, D) of errors about points turned into those about states e (K, D) away from them.

    Exp(e + x) = Exp(e) Exp(J_r(e) x) to first order in x.
    """
    return np.asarray(turn(np.array(P, order="C"), rotation.right_jacobian(e[:, :3])))
