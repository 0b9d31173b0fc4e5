"""One stage of a time-ordered elimination: the rows of a new keyframe, and elimination of the previous one.

With y = [x, theta] the error states of a keyframe and of the parameters in force there, the information of all earlier
keyframes on y_{k-1} is a square-root message R y_{k-1} = z. A stage stacks under it the rows of the interval from k-1
to k, those of parameters that step to their next node, and those of the measurements at k, and eliminates by QR
(Bierman 1977, ch. VI; Dellaert and Kaess 2006) the variables that only they touch, x_{k-1} and past nodes:

    [ R            0  ]           [ R_e  S   d ]     e   = R_e^-1 (d - S y_k)     what smooths back
    [ A_{k-1}     A_k ]   - QR ->  [      R'  z']     R' y_k = z'                  the next message
    [ 0           H_k ]

For a chain this is GTSAM's elimination in the same order, on matrices that are dense anyway. This module has the rows
and the results; `graphnav.estimation.solvers.elimination` performs it.

A message may carry tests (`graphnav.estimation.faults.watch`) for persistent errors of fixes: additional columns on
the right, which go through the same QR.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dgesv

from graphnav.constraints.base import Linearized
from graphnav.core import rotation
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array, mv
from graphnav.core.state import DIM, States
from graphnav.estimation.faults.watch import Watch
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import explain_smoother
from graphnav.estimation.solvers.linearise import Columns, Points, Step, linearise, linearise_links, scale_at, shift
from graphnav.estimation.solvers.robust import soften, weigh_squares
from graphnav.estimation.solvers.turning import add_turning, change_of_point, split_turn
from graphnav.imu.dynamics import SCALE

_I = np.eye(DIM)


@dataclass(frozen=True)
class Place:
    """A keyframe: its time, the parameters that step there, and the origin of its rows.

    The origin is keyframe `k` of a problem, and the interval that ends there; None once it is no longer needed.
    """

    t: float  # s
    problem: Problem | None
    k: int = 0
    steps: tuple[Step, ...] = ()
    linked: bool = True  # linked to the previous keyframe; the first is not


@dataclass(frozen=True)
class Message:
    """R y = z about a point; `columns` says where the parameters stand behind the fifteen states.

    R is a triangle whose first nine columns may be full because its point has moved.
    """

    state: States  # one
    values: Array  # (D-15,)
    columns: Columns
    R: Array  # (D, D)
    z: Array  # (D,)
    tests: Watch | None = None
    # whether all rows in it, except the prior, are invariant to a rotation about the vertical
    turns: bool = False

    @property
    def estimate(self) -> Array:
        """(D,) the error state that it makes most likely."""
        found, info = dgesv(self.R, self.z)[2:]  # no longer triangular once its point has turned
        if info:
            raise explain_smoother()
        return np.asarray(found)

    @property
    def covariance(self) -> Array:
        """(D, D)"""
        root = np.linalg.inv(self.R)
        return np.asarray(root @ root.T)

    def change_of_point(self, e: Array) -> Array:
        """(k, k) of the first k columns, 3 or 9: errors about the point moved by e (D,) as those about this one."""
        if self.turns:
            return change_of_point(self.state, e[None, :DIM])[0]
        return np.asarray(rotation.right_jacobian_inverse(e[None, :3])[0])

    def move(self, e: Array, J: Array | None = None) -> Message:
        """The same about the point moved by the error state e (D,); J is `change_of_point`, if known."""
        J = self.change_of_point(e) if J is None else J
        state = add_error(self.state, e[None, :DIM], self.turns)
        R, z = rotate_columns(self.R, J), self.z - self.R @ e
        return replace(self, state=state, values=self.values + e[DIM:], R=R, z=z)

    def get_value(self, name: str) -> Array:
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
    turns: bool = False  # whether they are invariant to a rotation about the vertical

    def weigh(self, y: Array) -> Measured:
        """The same with the kernel's weights for the error state y (D,), and no kernel any more."""
        if self.kernel == "none":
            return self
        left = self.b - mv(self.H, np.broadcast_to(y, (len(self.b), len(y))))
        weight = np.sqrt(weigh_squares(self.kernel, np.linalg.norm(left, axis=-1), self.scale)[0])[:, None]
        with np.errstate(divide="ignore"):
            H, b, sigma = self.H * weight[..., None], self.b * weight, self.sigma / weight
        return replace(self, H=H, b=b, sigma=sigma, kernel="none")


@dataclass(frozen=True)
class Stage:
    """A keyframe in the window. Backward smoothing: y_before = g + y, in rows `lost` g + G y + noise of covariance C.

    Variables that were not eliminated are the same at both.
    """

    place: Place
    message: Message
    G: Array  # (lost, D)
    g: Array  # (D before,)
    lost: Array  # rows that were eliminated, or are about another point
    C: Array  # (lost, lost)
    measured: tuple[Measured, ...] = ()  # with the weights of kernels
    fault: tuple[str, float] | None = None  # constraint with a detected fault, and its onset (s)
    psi: float = 0.0  # rad, how far its point has turned about the vertical since its rows were linearised

    def move(self, e: Array) -> Stage:
        """The same about the point moved by the error state e."""
        J = self.message.change_of_point(e)
        message, G, g = self.message.move(e, J), rotate_columns(self.G, J), self.g + self.smooth_back(e)
        psi = self.psi + float(split_turn(self.message.state, e[None])[0][0]) if message.turns else 0.0
        return Stage(self.place, message, G, g, self.lost, self.C, self.measured, self.fault, psi)

    def smooth_back(self, A: Array) -> Array:
        """Backward smoothing, without g, of A (D, ...)."""
        out = A[: len(self.g)].copy()
        out[self.lost] = self.G @ A
        return out

    def predict_before(self, P: Array) -> Array:
        """The covariance before from that of y."""
        n, lost = len(self.g), self.lost
        cross = self.G @ P
        out = P[:n, :n].copy()
        out[lost] = cross[:, :n]
        out[:, lost] = cross[:, :n].T
        out[lost[:, None], lost] = cross @ self.G.T + self.C
        return out


def add_error(states: States, e: Array, turns: bool) -> States:
    """States moved by error states (K, 15), along rotations about the vertical where these are unobservable."""
    return add_turning(states, e) if turns else states.plus(e)


def rotate_columns(A: Array, J: Array) -> Array:
    """Columns about another point, of which J is `Message.change_of_point`.

    With three columns it is Jr^-1(e): log(Exp(e) Exp(d)) = e + Jr^-1(e) d.
    """
    out, k = A.copy(), len(J)
    out[:, :k] = A[:, :k] @ J
    return out


@dataclass(frozen=True)
class Linear:
    """Whitened rows of one stage: link (15, 15 + D + 1) over [x_before, y, b], or None; measurements by constraint."""

    link: Array | None
    measured: tuple[Measured, ...]


def append_columns(columns: Columns, steps: Sequence[Step]) -> Columns:
    """The columns followed by those of new parameters."""
    out, at = dict(columns), max((s.stop for s in columns.values()), default=DIM)
    for step in steps:
        if step.name not in out:
            out[step.name] = slice(at, at + len(step.mean))
            at += len(step.mean)
    return out


def count_columns(columns: Columns) -> int:
    """D"""
    return max((s.stop for s in columns.values()), default=DIM)


def predict_stage(before: Message, place: Place) -> tuple[States, Array, Columns, Array | None]:
    """State, parameter values, columns and whitened link rows at a new keyframe, from the point of a message."""
    columns = append_columns(before.columns, place.steps)
    D = count_columns(columns)
    values = np.zeros(D - DIM)
    values[: len(before.values)] = before.values
    for step in place.steps:
        at = shift(columns[step.name])
        values[at] = step.predict(before.get_value(step.name) if step.name in before.columns else step.mean_before)
    if not place.linked:
        return before.state, values, columns, None
    assert place.problem is not None
    motion, row = place.problem.motion, slice(place.k - 1, place.k)
    scale = before.get_value(SCALE) if SCALE in before.columns else None
    ahead, F = motion.propagate(row, before.state, scale)
    try:
        W = motion.whitener[row]
    except np.linalg.LinAlgError:
        raise EstimationError(
            f"the noise of the IMU before {place.t:.3f} s is zero: check its figures", key="solver.no_imu_noise"
        ) from None
    link = np.zeros((1, DIM, DIM + D + 1))
    link[:, :, :DIM], link[:, :, DIM : 2 * DIM] = -F[:, :, :DIM], _I
    if scale is not None:
        link[:, :, DIM:][:, :, columns[SCALE]] = -F[:, :, DIM:]
    return ahead, values, columns, (W @ motion.rotate_to_body(link, before.state.R_nb, row))[0]


def pad(rows: Sequence[Array], width: int) -> Array:
    """(n, width) of rows that may be shorter, zero behind their ends: parameters that had not begun."""
    out = np.zeros((len(rows), width))
    for whole, row in zip(out, rows, strict=True):
        whole[: len(row)] = row
    return out


def forget_rows(stages: list[Stage]) -> None:
    """Drop the problems that the rows of the last stages come from: each would keep the rows around it in memory."""
    for k in range(len(stages) - 1, -1, -1):
        if stages[k].place.problem is None:
            break  # nor have those before it
        stages[k] = replace(stages[k], place=replace(stages[k].place, problem=None))


def linearise_keyframes(
    places: Sequence[Place],
    states: States,
    values: Sequence[Array],
    columns: Columns,
    linked: bool = True,
    late: bool | None = None,
) -> list[Linear]:
    """The rows of consecutive keyframes of one problem at given points, all at once.

    Parameters
    ----------
    states, values : (n, up to D-15) at the keyframes; with `linked` another, the first, at the keyframe before.
    late : only rows that enter last, as they depend on later ones, or have a kernel whose weights need an estimate; or
        only the others.
    """
    problem, first, n = places[0].problem, places[0].k, len(places)
    assert problem is not None
    D, skip = count_columns(columns), int(linked)
    points = Points(states, pad(values, D - DIM))
    links: list[Array | None] = [None] * n
    if linked:
        scale = scale_at(columns, points.values[0])
        link = np.zeros((n, DIM, DIM + D + 1))
        found = linearise_links(problem.motion, states, scale, slice(first - 1, first - 1 + n))
        link[:, :, :DIM], link[:, :, DIM : 2 * DIM], S, link[:, :, -1] = found
        if scale is not None:
            link[:, :, DIM:][:, :, columns[SCALE]] = S
        links = list(link)
    parts: list[list[Measured]] = [[] for _ in places]
    for constraint in problem.constraints:
        lo, hi = constraint.keyframe.searchsorted((first, first + n))
        if lo == hi or late not in (None, constraint.looks_ahead or constraint.robust != "none"):
            continue
        at = constraint.keyframe[lo:hi] - first + skip
        linear = linearise(constraint, points, columns, slice(lo, hi), at)
        sigma, which = linear.sigma, np.arange(lo, hi)
        H, b = linear.H / sigma[..., None], -linear.residual / sigma
        later = [p.name for p in constraint.parameters if p.name not in columns]
        if later:  # rows of satellites that were in view already do not depend on ambiguities that begin later
            begun = ~_depend_on(linear.linear, later)
            at, sigma, H, b, which = (x[begun] for x in (at, sigma, H, b, which))
        edge, c = np.searchsorted(at, np.arange(n + 1) + skip), constraint
        kernel = soften(c.robust) if c.robust == "gnc" else c.robust
        for i in np.flatnonzero(np.diff(edge)):
            own = slice(edge[i], edge[i + 1])
            parts[i].append(Measured(c.name, H[own], b[own], sigma[own], kernel, c.scale_of(which[own]), c.turns))
    return [Linear(link, tuple(part)) for link, part in zip(links, parts, strict=True)]


def _depend_on(linear: Linearized, names: Sequence[str]) -> Array:
    """(n,) mask of the rows that depend on any of some parameters."""
    out = np.zeros(len(linear.residual), dtype=bool)
    for name in names:
        if name in linear.jacobians:
            out |= linear.jacobians[name].any(axis=(1, 2))
    return out
