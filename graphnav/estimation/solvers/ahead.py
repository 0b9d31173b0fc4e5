"""A filter's next keyframes, linearised all at once where it expects to be without measurements.

An extended Kalman filter linearises at its estimate, keyframe by keyframe, and nearly all of its time goes into asking
for so few rows. What comes of it hardly differs where the estimate stays near its prediction: so a span of keyframes is
predicted from the latest estimate, without measurements, and linearised at these points X; the recursion in between is
linear, in the error e with X [+] e the estimate. Then it is looked at how well that was linear, at the estimates that
came of it,

    |r(X [+] e) - r(X) - H e| / sigma      of the rows
    |f(X [+] e) [-] (X' [+] e')| / sigma   of the step to the next keyframe, by the sigmas of the prediction

and the span ends before the first keyframe where either is more than `LINEAR`. As for the iterated filter (Jazwinski
1970, section 8.3), nothing depends on measurements later than the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.linearise import Points, scale_at, shift
from graphnav.estimation.solvers.passes import move_points
from graphnav.estimation.solvers.points import AtPoints, Estimate, rows_within
from graphnav.estimation.solvers.stack import Stack

LINEAR = 0.01  # sigmas: a hundred rows that are all off by so much one way move what they tell by a tenth of its sigma
_LONGEST = 64  # keyframes: what is asked once a span is then a tenth of what they take one by one
_WORTH = 4  # keyframes: to linearise a span takes as long as that many one by one


@dataclass
class Spans:
    """How many keyframes are tried at a time, by how it went before.

    Only a filter whose latest innovations were all as it expects them is near enough to where it should be: one that is
    thrown about by wrong fixes comes to somewhere else by a thousandth of a sigma.
    """

    length: int = 2 * _WORTH
    pause: int = _WORTH  # keyframes to go on one by one where it did not
    wait: int = 0  # until which keyframe none is tried
    quiet: int = 0  # keyframes since an innovation was larger than chance makes it

    def due(self, k: int) -> bool:
        """Whether to try from keyframe k on."""
        return k >= self.wait and self.quiet >= _LONGEST

    def seen(self, surprising: bool) -> None:
        """A keyframe was taken in by itself."""
        self.quiet = 0 if surprising else self.quiet + 1

    def went(self, k: int, tried: int, kept: int) -> None:
        """Of some keyframes from k on, how many were tried and how many were linear enough."""
        self.length = min(2 * tried, _LONGEST) if kept == tried else max(kept, 2 * _WORTH)
        if kept >= _WORTH:
            self.pause, self.wait = _WORTH, k + kept + (kept < tried)
            return
        self.wait = k + kept + self.pause
        self.pause = min(2 * self.pause, _LONGEST)


def predict_points(problem: Problem, k: int, n: int, x: Estimate) -> Points:
    """An estimate at keyframe k, and what it leads to at the n after it.

    Between them only what Coriolis' and gravity's changes do to velocities on the way is left out, millimetres per
    second in a minute: errors about the points begin with it.
    """
    motion, rows, columns = problem.motion, slice(k, k + n), problem.columns
    values = np.tile(x.values, (n + 1, 1))
    for chain in problem.chains:
        own, node = shift(columns[chain.parameter.name]), chain.node[k : k + n + 1]
        left = np.cumprod(np.concatenate([[1.0], chain.decay[node[0] + 1 : node[-1] + 1]]))[node - node[0], None]
        values[:, own] = chain.mean[node] + left * (x.values[own] - chain.mean[node[0]])
    scale = scale_at(columns, values[:-1])
    same: Array = np.zeros(n, dtype=int)
    still = x.state[same]
    level = replace(still, R_nb=np.broadcast_to(np.eye(3), (n, 3, 3)))
    turned, _ = motion.propagate(rows, level, scale, linear=False)
    R = np.empty((n + 1, 3, 3))
    R[0] = x.state.R_nb[0]
    ahead = motion.back[rows]
    by = np.swapaxes(ahead, -1, -2) @ turned.R_nb  # in the body's axes
    for j in range(n):
        R[j + 1] = ahead[j] @ R[j] @ by[j]
    pushed, _ = motion.propagate(rows, replace(still, R_nb=R[:-1]), scale, linear=False)
    change = pushed.v - still.v
    v = x.state.v + np.concatenate([np.zeros((1, 3)), np.cumsum(change, axis=0)])
    moved = pushed.p - still.p + (v[:-1] - still.v) * motion.intervals.T[rows, None]
    p = x.state.p + np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    every: Array = np.zeros(n + 1, dtype=int)
    return Points(States(R, p, v, x.state.ba[every], x.state.bg[every]), values)


def linear_for(problem: Problem, given: AtPoints, stack: Stack, e: Array, ahead: Array, P: Array) -> int:
    """How many of the keyframes after the first of a span were linear enough.

    Parameters
    ----------
    given : the span, linearised.
    e : (n, D) errors at its keyframes, after their updates.
    ahead : (n, D) before them.
    P : (n, D, D) covariances before them; neither of the first is looked at.
    """
    n, first = len(e), given.first
    at = move_points(given.points, e)
    off = np.zeros(n)
    for (k, own), linear in rows_within(problem, at, stack, first):
        expected = given.predicted(k, own, e)
        root = stack.root_weight[first + k, own]
        np.maximum.at(off, k[:, 0], np.max(np.abs(linear.residual - expected) * root / linear.stated, axis=1))
    scale = scale_at(problem.columns, at.values[:-1])
    led, _ = problem.motion.propagate(slice(first, first + n - 1), at.states[:-1], scale, linear=False)
    there = given.points.states[1:].plus(ahead[1:, :DIM])
    sigma = np.sqrt(np.maximum(np.diagonal(P[1:, :DIM, :DIM], axis1=1, axis2=2), 1e-300))
    step = np.max(np.abs(there.minus(led)) / sigma, axis=1)
    wrong = np.flatnonzero(~((off[1:] <= LINEAR) & (step <= LINEAR)))
    return int(wrong[0]) if len(wrong) else n - 1


def about_estimates(P: Array, Pp: Array, F: Array, e: Array, ahead: Array) -> None:
    """Turn a span's covariances and transitions about points into those about the estimates, in place.

    Exp(e + x) = Exp(e) Exp(J_r(e) x) to first order in x.

    Parameters
    ----------
    P, Pp : (n, D, D) after the updates and before them, of errors e and `ahead` (n, D).
    F : (n, D, D) to each keyframe, from the one before; the first of them begins at an estimate already.
    """
    J, Jp = rotation.right_jacobian(e[:, :3]), rotation.right_jacobian(ahead[:, :3])
    for M, turn in ((P, J), (Pp, Jp)):
        M[:, :3] = turn @ M[:, :3]
        M[:, :, :3] = M[:, :, :3] @ np.swapaxes(turn, -1, -2)
    F[:, :3] = Jp @ F[:, :3]
    F[1:, :, :3] = F[1:, :, :3] @ np.linalg.inv(J[:-1])
