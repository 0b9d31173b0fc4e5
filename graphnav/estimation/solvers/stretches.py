"""The filter linearised at its own estimates, for a stretch of keyframes at once.

A filter linearised at its own estimates needs the estimate before it can linearise the next rows: one keyframe at a
time, one kind of rows after the other. For few rows the calls cost far more than the arithmetic. So the estimates are
guessed, by the IMU alone, for a stretch of keyframes: X_0 at the prediction of a keyframe, and X_i after the i-th kind
of its rows. All rows and steps are linearised at the guess together, and filtered as rows at given points are, by
errors y about X_0. An error about X_i is

    e_i = T_i (y - m_i)      m_i = sum over j <= i of T_(j-1)^-1 (X_j [-] X_(j-1))

with T_i the transformation of errors from X_0 to X_i (`graphnav.estimation.solvers.invariant`), so that rows and steps
linearised at X_i have r - H T_i m_i and H T_i. The guess is corrected by the e_i until it converges. At convergence
they are zero: each row is linearised at the filter's estimate, and the result is that of a sequential filter (Picard's
iteration; Lelarasmee, Ruehli and Sangiovanni-Vincentelli 1982, "The waveform relaxation method for time-domain analysis
of large scale integrated circuits"). The first keyframes do not depend on later ones: they are final once they have
converged. A single keyframe always converges, one kind of rows after the other.

Rows that are strongly nonlinear over the filter's uncertainty are linearised at X_i after their own update: the
iterated Kalman filter (Jazwinski 1970, theorem 8.2), which is Gauss and Newton's method on the update.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array, mv
from graphnav.core.state import DIM, MOVING, States
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import explain_rows
from graphnav.estimation.solvers.invariant import compute_transport, subtract_invariant, turn
from graphnav.estimation.solvers.linearise import Advance, Points, linearise, scale_at
from graphnav.estimation.solvers.passes import join_passes, move_points
from graphnav.estimation.solvers.points import allocate_rows
from graphnav.estimation.solvers.recursion import filter_rows, follow_blocks
from graphnav.estimation.solvers.stack import Stack

_SHORTEST, _LONGEST = 16, 256  # keyframes of a stretch
_MAX_LINEARISATIONS = 10  # iterations of a stretch: each gains two digits or more
# sigmas, convergence threshold of the error that is left: the correction, reduced once more as it was from the last one
STAYS = 1e-6
_REDUCED = 0.1  # at least, in an iteration


class StretchFilter:
    """Filter keyframes linearised where the filter is.

    Parameters
    ----------
    P_predicted, P : (K, D, D) and
    F : (K-1, 15, w), to be filled.
    stays : error of the estimates by which the iteration ends, sigmas.
    """

    def __init__(
        self, problem: Problem, steps: Advance, stack: Stack, P_predicted: Array, P: Array, F: Array,
        stays: float = STAYS,
    ) -> None:  # fmt: skip
        self._problem, self._steps, self._stack = problem, steps, stack
        self._P_predicted, self._P, self._F = P_predicted, P, F
        self._length, self._stays, blocks = 2 * _SHORTEST, stays, stack.single
        k = np.repeat(np.arange(stack.K), np.diff(blocks.first))
        # points of all keyframes in order: the prediction, and the estimate after each block
        self._start = np.arange(stack.K) + blocks.first[:-1]
        self._end = np.arange(stack.K) + blocks.first[1:]
        self._before = np.arange(len(k)) + k  # of each block: behind it is the next
        self._of_rows = {}
        for rows in problem.constraints:
            at_k, place = stack.places[rows.name]
            block = np.searchsorted(k * (stack.M + 1) + blocks.begin, (at_k * (stack.M + 1) + place)[:, 0], "right") - 1
            self._of_rows[rows.name] = self._before[block] + rows.iterated
        self._taken, self._lossy = np.zeros((2, len(stack.joint.begin)), dtype=bool)
        self._at = np.zeros(1, dtype=int)

    def run(self, k: int, x: Points, P: Array, predicted: Points, filtered: Points) -> int:
        """Filter a stretch from keyframe k on.

        Parameters
        ----------
        x, P : at the keyframe before; predicted, where k is the first of all.
        predicted, filtered : of all keyframes, to be filled.

        Returns
        -------
        int
            The keyframe to go on from.

        Raises
        ------
        EstimationError
            If the covariance of an innovation is not positive definite.
        """
        if (on := self._run_stretch(k, min(k + self._length, self._stack.K), x, P, predicted, filtered)) > k:
            return on
        # where the iteration diverges, a single keyframe converges, block after block
        return self._run_stretch(k, k + 1, x, P, predicted, filtered, alone=True)

    def shorten(self, length: int) -> None:
        """The next stretch is about as long as the converged part of the last one."""
        self._length = max(min(self._length, length), _SHORTEST)

    def _run_stretch(
        self, k: int, k1: int, x: Points, P: Array, predicted: Points, filtered: Points, alone: bool = False
    ) -> int:
        before = np.full(k1 - k, np.nan)
        points = self._guess_points(k, k1, x)
        most = _MAX_LINEARISATIONS + int(self._end[k] - self._start[k]) * alone
        for left in range(most - 1, -1, -1):
            try:
                size, points = self._filter_about(k, k1, x, P, points)
            except np.linalg.LinAlgError:
                if alone:
                    raise explain_rows(self._stack.get_block(int(self._at[0])).parts) from None
                break  # because the guess is far off; otherwise a single keyframe will raise the error
            error = size * np.fmin(size / before, _REDUCED)
            stay = k1 if alone and not left else k + int(np.argmax(np.append(~(error <= self._stays), True)))
            before = size[stay - k :]
            if stay > k:
                own = slice(k, stay)
                predicted.put(own, points.take(self._start[own] - self._start[k]))
                filtered.put(own, points.take(self._end[own] - self._start[k]))
                last = int(self._end[stay - 1] - self._start[k])
                x, P = points.take(slice(last, last + 1)), self._P[stay - 1]
                k, points = stay, points.take(slice(last + 1, None))
            if k == k1:
                if not alone:
                    self._length = min(2 * self._length, _LONGEST)
                return k
        self._length = max(self._length // 2, _SHORTEST)
        return k

    def _guess_points(self, k: int, k1: int, x: Points) -> Points:
        """Prediction by the IMU alone."""
        first, values, scale = max(k, 1), [x.values[0]], scale_at(self._problem.columns, x.values[0])
        states = [x.states] if not k else []
        if first < k1:
            states.append(self._problem.motion.advance_through(slice(first - 1, k1 - 1), x.states, scale))
        for j in range(first, k1):
            values.append(self._steps.predict(j - 1, values[-1]))
        each = self._end[k:k1] - self._start[k:k1] + 1
        return Points(States.stack(states), np.array(values[-(k1 - k) :])).take(np.repeat(np.arange(k1 - k), each))

    def _filter_about(self, k: int, k1: int, x: Points, P: Array, points: Points) -> tuple[Array, Points]:
        """Filter keyframes k to k1 about points; returns the largest correction, sigmas, up to each keyframe, and the
        new points."""
        stack, blocks, own = self._stack, self._stack.joint, slice(max(k - 1, 0), k1)
        start, end = self._start[k:k1] - self._start[k], self._end[k:k1] - self._start[k]
        counts = end - start + 1
        of_first = np.repeat(start, counts)
        T, m = _move_errors(points, of_first)
        gap, Q, F = self._step(k, k1, x, points, start, end, T, m)
        r, sigma, H = self._linearise(own, k, points, T, m)
        n, D = r.shape[0], H.shape[2]
        predicted, errors, Kt, w = np.empty((n, D)), np.empty((n, D)), np.zeros_like(H), r.copy()
        steps = slice(own.start, k1 - 1)
        filter_rows(
            k - own.start, n, np.zeros(D), P, (F, self._steps.decay[steps], gap, Q, self._steps.added[steps]),
            (r, H, (sigma / stack.root_weight[own]) ** 2, stack.scale[own]),
            (blocks.first[own.start : k1 + 1], *blocks.arrays[1:]), blocks.used,
            (predicted, self._P_predicted[own], errors, self._P[own]),
            (stack.root[own], stack.solved[own], stack.bent[own]),
            (Kt, H, w, np.empty((0, 0, 0)), self._taken, self._lossy), self._at,
        )  # fmt: skip
        turn(self._P[k:k1], np.ascontiguousarray(T[end]))
        y, some = np.repeat(predicted[k - own.start :], counts, axis=0), slice(k, k1)
        single = self._stack.single
        follow_blocks(
            single.first[k : k1 + 1], single.end, stack.root[some], stack.solved[some], Kt[k - own.start :], y
        )
        e = _turn_errors(T, y - m)
        sigma = np.sqrt(np.diagonal(self._P[k:k1], axis1=1, axis2=2))
        size = np.max(np.abs(e) / np.maximum(np.repeat(sigma, counts, axis=0), 1e-300), axis=1)
        return np.maximum.accumulate(np.maximum.reduceat(size, start)), move_points(points, e)

    def _linearise(self, own: slice, k: int, points: Points, T: Array, m: Array) -> tuple[Array, Array, Array]:
        """Residuals, sigmas (n, M) and Jacobians (n, M, D) of the rows of keyframes `own`, from keyframe k on."""
        r, sigma, H = allocate_rows(own.stop - own.start, self._stack.M, points)
        for rows in self._problem.constraints:
            which = slice(*rows.keyframe.searchsorted((k, own.stop)))
            if which.start == which.stop:
                continue
            at = self._of_rows[rows.name][which] - self._start[k]
            linear = linearise(rows, points, self._problem.columns, which, at)
            J = linear.H
            J[:, :, :MOVING] = J[:, :, :MOVING] @ T[at]
            place = rows.keyframe[which, None] - own.start, self._stack.places[rows.name][1][which]
            r[place], sigma[place], H[place] = linear.residual - mv(J, m[at]), linear.stated, J
        return r, sigma, H

    def _step(
        self, k: int, k1: int, x: Points, points: Points, start: Array, end: Array, T: Array, m: Array
    ) -> tuple[Array, Array, Array]:
        """Where steps between the keyframes lead from points, (n, D) from the next of them, Q and F (n, 15, w)."""
        before, ahead, steps = (
            points.take(end[:-1]),
            points.take(start if k else start[1:]),
            slice(max(k - 1, 0), k1 - 1),
        )
        if k:
            before = join_passes([x, before])
        scale = scale_at(self._problem.columns, before.values)
        reached, F = self._problem.motion.propagate(steps, before.states, scale)
        values = self._steps.predict(steps, before.values)
        gap = np.concatenate([reached.minus(ahead.states), values - ahead.values], axis=1)
        self._F[steps] = F
        if len(end) > 1:
            on, last = slice(len(F) - len(end) + 1, None), end[:-1]
            F[on, :, :MOVING] = F[on, :, :MOVING] @ T[last]
            gap[on, :DIM] -= mv(F[on], m[last, : F.shape[2]])
            gap[on, DIM:] -= self._steps.decay[steps][on] * m[last, DIM:]
        return gap, self._problem.motion.compute_noise(steps, before.states.R_nb), F


def _move_errors(points: Points, first: Array) -> tuple[Array, Array]:
    """T (n, 9, 9) and m (n, D) of points, by errors about the `first` (n,) of each keyframe's."""
    of_first = points.states[first]
    moved = np.zeros((len(first), DIM + points.values.shape[1]))
    moved[1:, :DIM] = subtract_invariant(points.states[1:], points.states[:-1])
    moved[1:, DIM:] = np.diff(points.values, axis=0)
    moved[np.unique(first)] = 0.0
    moved[1:] = _turn_errors(compute_transport(points.states[:-1], of_first[:-1]), moved[1:])
    m = np.cumsum(moved, axis=0)
    return compute_transport(of_first, points.states), m - m[first]


def _turn_errors(T: Array, e: Array) -> Array:
    """Errors (n, D) of which the first are turned by T (n, 9, 9)."""
    return np.concatenate([mv(T, e[:, :MOVING]), e[:, MOVING:]], axis=1)
