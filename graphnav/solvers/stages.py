"""One stage of a time-ordered elimination: what a new keyframe adds, and what of the one before it can go.

With y = [x, theta] the error states of a keyframe and of the parameters in force there, all that earlier keyframes
have to say of y_{k-1} is a square-root message R y_{k-1} = z. A stage puts under it the rows of the interval from
k-1 to k, those of parameters that move on to their next node, and those of the measurements at k, and eliminates
with QR (Bierman 1977, ch. VI; Dellaert and Kaess 2006) what only they touch: x_{k-1} and the nodes left behind:

    [ R            0  ]           [ R_e  S   d ]     e   = R_e^-1 (d - S y_k)     what smooths back
    [ A_{k-1}     A_k ]   - QR ->  [      R'  z']     R' y_k = z'                  the next message
    [ 0           H_k ]

For a chain this is the elimination that GTSAM does in the same order, on matrices that are dense anyway.

A message may have tests beside it (`graphnav.solvers.watch`) that look for errors of fixes that last: more columns on
the right, which go through the same QR.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dgeqrf, dgesv, dtrtri, dtrtrs

from graphnav import rotation
from graphnav.constraints.base import assemble, weighted_sigma
from graphnav.dynamics import SCALE, Motion
from graphnav.errors import EstimationError
from graphnav.problem import Problem
from graphnav.rotation import Array, mv
from graphnav.solvers.robust import PASSES, softened, weight_and_cost
from graphnav.solvers.watch import Watch
from graphnav.state import DIM, States

Columns = dict[str, slice]
_I = np.eye(DIM)


@dataclass(frozen=True)
class Step:
    """A parameter that moves on to its next node, or begins: value - mean = decay (before - mean_before) + noise."""

    name: str
    mean: Array  # (k,)
    sigma: Array  # (k,)
    decay: float = 0.0
    mean_before: Array | float = 0.0


@dataclass(frozen=True)
class Place:
    """A keyframe: its time, the parameters that step there, and where its rows come from.

    These are keyframe `k` of a problem, and the interval that ends there; None once nobody will ask again.
    """

    t: float  # s
    problem: Problem | None
    k: int = 0
    steps: tuple[Step, ...] = ()
    linked: bool = True  # to the keyframe before; the first of all is not


@dataclass(frozen=True)
class Message:
    """R y = z about a point; `columns` says where the parameters stand behind the fifteen states."""

    state: States  # one
    values: Array  # (D-15,)
    columns: Columns
    R: Array  # (D, D)
    z: Array  # (D,)
    tests: Watch | None = None

    @property
    def estimate(self) -> Array:
        """(D,) the error state that it makes most likely."""
        found, info = dgesv(self.R, self.z)[2:]  # not triangular any more once its point has turned
        if info:
            raise EstimationError("the smoother's information broke down: check sigmas and units")
        return np.asarray(found)

    @property
    def covariance(self) -> Array:
        """(D, D)"""
        root = np.linalg.inv(self.R)
        return np.asarray(root @ root.T)

    def moved(self, e: Array, J: Array | None = None) -> Message:
        """The same about the point moved by the error state e (D,); J is Jr^-1 of its turn, if known."""
        J = rotation.right_jacobian_inverse(e[None, :3])[0] if J is None else J
        state, values = self.state.plus(e[None, :DIM]), self.values + e[DIM:]
        return Message(state, values, self.columns, turned(self.R, J), self.z - self.R @ e, self.tests)

    def value(self, name: str) -> Array:
        """A parameter at the point."""
        at = self.columns[name]
        return self.values[at.start - DIM : at.stop - DIM]


@dataclass(frozen=True)
class Measured:
    """Rows of one constraint at one keyframe, whitened: H y = b, with the kernel that weighs them and its scale."""

    name: str
    H: Array  # (n, m, D)
    b: Array  # (n, m)
    sigma: Array  # (n, m) that they were whitened with
    kernel: str
    scale: float | Array

    def weighted(self, y: Array, passes: int) -> tuple[Array, Array, Array]:
        """H, b and sigma, by the kernel's weights for the error state y once `passes` is not 0."""
        if self.kernel == "none" or not passes:
            return self.H, self.b, self.sigma
        left = self.b - mv(self.H, np.broadcast_to(y, (len(self.b), len(y))))
        weight = np.sqrt(weight_and_cost(self.kernel, np.linalg.norm(left, axis=-1), self.scale)[0])[:, None]
        with np.errstate(divide="ignore"):
            return self.H * weight[..., None], self.b * weight, self.sigma / weight


@dataclass(frozen=True)
class Stage:
    """A keyframe in the window. Smoothing back, y_before = g + G y + noise of covariance C in the rows `lost`."""

    place: Place
    message: Message
    G: Array  # (D before, D)
    g: Array  # (D before,)
    lost: Array  # rows that were eliminated
    C: Array  # (lost, lost)
    measured: tuple[Measured, ...] = ()  # about a point that the stage has moved from by `way`
    way: Array | float = 0.0
    fault: tuple[str, float] | None = None  # whose fixes are wrong, and since when (s)

    def moved(self, e: Array) -> Stage:
        """The same about the point moved by the error state e."""
        J = rotation.right_jacobian_inverse(e[None, :3])[0]
        message, G, g = self.message.moved(e, J), turned(self.G, J), self.g + self.G @ e
        return Stage(self.place, message, G, g, self.lost, self.C, self.measured, self.way + e, self.fault)

    @property
    def noise(self) -> Array:
        """(D before, D before), C in its place."""
        out = np.zeros((len(self.G), len(self.G)))
        out[self.lost[:, None], self.lost] = self.C
        return out

    def before(self, P: Array) -> Array:
        """The covariance before from that of y."""
        out = self.G @ P @ self.G.T
        out[self.lost[:, None], self.lost] += self.C
        return np.asarray(out)


def turned(A: Array, J: Array) -> Array:
    """Columns about a point turned by e, of which J is Jr^-1: log(Exp(e) Exp(d)) = e + Jr^-1(e) d."""
    out = A.copy()
    out[:, :3] = A[:, :3] @ J
    return out


@dataclass(frozen=True)
class Linear:
    """Whitened rows of one stage: link (15, 15 + D + 1) over [x_before, y, b], or None; measurements by constraint."""

    link: Array | None
    measured: tuple[Measured, ...]

    def stacked(self, y: Array, passes: int, tests: Watch | None = None) -> Array:
        """(rows, D + 1) of the measurements without tests, weighted for the error state y once `passes` is not 0."""
        parts = []
        for one in self.measured:
            if tests is None or one.name not in tests:
                H, b, _ = one.weighted(y, passes)
                parts.append(np.concatenate([H, b[..., None]], axis=-1).reshape(-1, H.shape[-1] + 1))
        return np.concatenate(parts) if parts else np.zeros((0, len(y) + 1))

    @property
    def robust(self) -> bool:
        """Whether any kernel bends."""
        return any(one.kernel != "none" for one in self.measured)


def extended(columns: Columns, steps: Sequence[Step]) -> Columns:
    """The columns with those of parameters that begin behind them."""
    out, at = dict(columns), max((s.stop for s in columns.values()), default=DIM)
    for step in steps:
        if step.name not in out:
            out[step.name] = slice(at, at + len(step.mean))
            at += len(step.mean)
    return out


def width(columns: Columns) -> int:
    """D"""
    return max((s.stop for s in columns.values()), default=DIM)


def predicted(before: Message, place: Place) -> tuple[States, Array, Columns, Array | None]:
    """State, parameter values, columns and whitened link rows at a new keyframe, from the point of a message."""
    columns = extended(before.columns, place.steps)
    D = width(columns)
    values = np.zeros(D - DIM)
    values[: len(before.values)] = before.values
    for step in place.steps:
        at = _shift(columns[step.name])
        old = before.value(step.name) if step.name in before.columns else step.mean_before
        values[at] = step.mean + step.decay * (old - step.mean_before)
    if not place.linked:
        return before.state, values, columns, None
    assert place.problem is not None
    motion, row = place.problem.motion, slice(place.k - 1, place.k)
    scale = before.value(SCALE) if SCALE in before.columns else None
    ahead, F = motion.propagate(row, before.state, scale)
    try:
        W = motion.whitener[row]
    except np.linalg.LinAlgError:
        raise EstimationError(f"the noise of the IMU before {place.t:.3f} s is none: check its figures") from None
    link = np.zeros((1, DIM, DIM + D + 1))
    link[:, :, :DIM] = -F
    link[:, :, DIM : 2 * DIM] = _I
    if scale is not None:
        at = columns[SCALE]
        link[:, :, DIM + at.start : DIM + at.stop] = -motion.scale_columns(row, F)
    return ahead, values, columns, (W @ motion.body_rows(link, before.state.R_nb, row))[0]


def measured(place: Place, state: States, values: Array, columns: Columns) -> Linear:
    """The rows of a keyframe's measurements at a point, without a link."""
    return at_points([place], state, values[None], columns, linked=False)[0]


def at_points(
    places: Sequence[Place], states: States, values: Array, columns: Columns, linked: bool = True
) -> list[Linear]:
    """The rows of consecutive keyframes of one problem at given points, all at once.

    `states` and `values` (n, D-15) are at the keyframes; with `linked` there is one more of them, the first, at the
    keyframe before.
    """
    problem, first, n = places[0].problem, places[0].k, len(places)
    assert problem is not None
    D, skip = width(columns), int(linked)
    links: list[Array | None] = [None] * n
    if linked:
        scale = values[0, _shift(columns[SCALE])] if SCALE in columns else None
        motion = Motion(problem.intervals[slice(first - 1, first - 1 + n)], problem.frame)
        r, Ji, Jj, Js = motion.linearize(states, scale)
        W = motion.whitener
        rows = np.zeros((n, DIM, DIM + D + 1))
        rows[:, :, :DIM], rows[:, :, DIM : 2 * DIM], rows[:, :, -1] = W @ Ji, W @ Jj, -mv(W, r)
        if scale is not None:
            here = columns[SCALE]
            rows[:, :, DIM + here.start : DIM + here.stop] = W @ Js
        links = list(rows)
    parts: list[list[Measured]] = [[] for _ in places]
    for constraint in problem.constraints:
        lo, hi = constraint.keyframe.searchsorted((first, first + n))
        if lo == hi or any(p.name not in columns for p in constraint.parameters):
            continue  # none here, or of parameters that have not begun
        at = constraint.keyframe[lo:hi] - first + skip
        given = {p.name: values[at, _shift(columns[p.name])] for p in constraint.parameters}
        where = states if len(at) == len(states) == 1 else states[at]
        linear = constraint.linearize(where, given, slice(lo, hi))
        sigma = weighted_sigma(constraint, linear.sigma, slice(lo, hi))
        H = assemble(linear, columns, D) / sigma[..., None]
        b = -linear.residual / sigma
        edge = np.searchsorted(at, np.arange(n + 1) + skip)
        for i in np.flatnonzero(np.diff(edge)):
            own = slice(edge[i], edge[i + 1])
            c = constraint
            kernel = softened(c.robust) if c.robust == "gnc" else c.robust
            parts[i].append(
                Measured(c.name, H[own], b[own], sigma[own], kernel, c.scale_of(slice(lo + own.start, lo + own.stop)))
            )
    return [Linear(link, tuple(part)) for link, part in zip(links, parts, strict=True)]


def eliminate(
    before: Message,
    place: Place,
    linear: Linear,
    state: States,
    values: Array,
    columns: Columns,
    weighted: bool = False,
) -> Stage:
    """Add the rows of a keyframe, linearised at a point of its own, and eliminate what only the past touches.

    Robust rows get the weights they deserve at the point if that is an estimate of all data already (`weighted`);
    else none at first, then those of what comes of it, a few times over.

    Raises
    ------
    EstimationError
        If the rows do not determine what is eliminated: sigmas or units are wrong.
    """
    D0, D = len(before.z), width(columns)
    gone = [before.columns[s.name] for s in place.steps if s.name in before.columns]
    lost = np.arange(DIM if place.linked else 0)
    if gone:
        lost = np.concatenate([lost, *(np.arange(at.start, at.stop) for at in gone)])
    E = len(lost)
    # where each column of the message goes: to the eliminated ones in front, or to its own place behind them
    to = np.arange(E, E + D0)
    to[lost] = np.arange(E)
    steps, tests = sum(len(s.mean) for s in place.steps), before.tests
    C = 0 if tests is None else tests.X.shape[1]
    wide = np.zeros((D0 + steps + (0 if linear.link is None else DIM), E + D + 1 + C))
    head = wide[:, : E + D + 1]
    head[:D0, to], head[:D0, -1] = before.R, before.z
    if tests is not None:
        wide[:D0, E + D + 1 :] = before.R @ tests.X
    if not place.linked:  # one and the same state, but about its new point
        shift = state.minus(before.state)[0]
        if np.any(shift):
            head[:D0, -1] -= before.R[:, :DIM] @ shift
            head[:D0, E : E + 3] = head[:D0, E : E + 3] @ rotation.right_jacobian_inverse(shift[None, :3])[0]
    moved = values[: D0 - DIM] - before.values
    for at in gone:
        moved[_shift(at)] = 0.0
    if np.any(moved):  # parameters that stay are about the new point's values
        head[:D0, -1] -= before.R[:, DIM:] @ moved
    row = D0
    for step in place.steps:
        at = columns[step.name]
        k = len(step.mean)
        rows, diagonal, value = np.arange(row, row + k), 1.0 / step.sigma, values[_shift(at)]
        head[rows, E + np.arange(at.start, at.stop)] = diagonal
        off = value - step.mean
        if step.name in before.columns and step.decay:
            old = before.columns[step.name]
            head[rows, to[old.start : old.stop]] = -step.decay * diagonal
            off = off - step.decay * (before.value(step.name) - step.mean_before)
        head[rows, -1] = -off * diagonal
        row += k
    if linear.link is not None:
        head[row:, :DIM], head[row:, E:] = linear.link[:, :DIM], linear.link[:, DIM:]
    y, first, fault = np.zeros(D), 1 if weighted else 0, None
    for passes in range(first, first + 1 if weighted or not linear.robust else PASSES):
        tail = linear.stacked(y, passes, tests)
        A = np.zeros((len(head) + len(tail), E + D + 1 + C), order="F")
        A[: len(head)], A[len(head) :, E : E + D + 1] = wide, tail
        R = np.triu(dgeqrf(A, overwrite_a=1)[0][: E + D])
        top, beside = R[E:, E:], None
        if tests is not None:
            top, beside, fault = _tested(top, tests.copy(), linear.measured, y, passes, place.t, state)
        message = Message(state, values, columns, top[:, :D], top[:, D], beside)
        if linear.robust:
            y = message.estimate
    root, info = dtrtri(R[:E, :E]) if E else (np.zeros((0, 0)), 0)
    if info:
        raise EstimationError(f"the smoother's information broke down at {place.t:.3f} s: check sigmas and units")
    G, g = np.zeros((D0, D)), np.zeros(D0)
    kept = np.arange(D0)
    G[kept, kept] = 1.0
    g[DIM:] = values[: D0 - DIM] - before.values
    G[lost], g[lost] = -root @ R[:E, E : E + D], root @ R[:E, E + D]
    if not place.linked and np.any(state.minus(before.state)):
        shift = state.minus(before.state)[0]
        G[:DIM] = turned(G[:DIM], rotation.right_jacobian_inverse(shift[None, :3])[0])
        g[:DIM] += shift
    return Stage(place, message, G, g, lost, root @ root.T, linear.measured, fault=fault)


def _tested(
    top: Array, tests: Watch, rows: Sequence[Measured], y: Array, passes: int, t: float, state: States
) -> tuple[Array, Watch, tuple[str, float] | None]:
    """Add the measurements that have tests to the rows [R z Z] of a message, Z = R X (D, C)."""
    fault, D, speed = None, len(top), float(np.linalg.norm(state.v))
    for one in rows:
        if one.name not in tests or not one.H.any():  # none of those that are left out
            continue
        H, b, sigma = one.weighted(y, passes)
        own, columns, errors = tests.begin(one.name, t, sigma)
        A = np.zeros((D + errors.shape[0], top.shape[1]), order="F")
        A[:D], A[D:, :D], A[D:, D] = top, H.reshape(-1, D), b.ravel()
        with_tests = A[:, D + 1 :]
        with_tests[:D, own], with_tests[D:, columns] = 0.0, errors
        R = np.triu(dgeqrf(A, overwrite_a=1)[0])
        top, left = R[:D], R[D:, D:]
        since = tests.found(one.name, t, left[:, 0], left[:, 1:][:, columns], speed)
        if since is not None and fault is None:
            fault = one.name, since
    tests.X = dtrtrs(top[:, :D], top[:, D + 1 :])[0]
    return top, tests, fault


def _shift(columns: slice) -> slice:
    return slice(columns.start - DIM, columns.stop - DIM)
