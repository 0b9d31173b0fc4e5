"""The IMU factor: relation of the states at both ends of a preintegrated interval, on the rotating, curved Earth.

In the fixed local frame n the vehicle obeys (Groves 2013, eq. 5.18-5.29, with n Earth-fixed)::

    dR/dt = R [omega_b - R^T omega]x    dv/dt = R f + g(p) - 2 omega x v    dp/dt = v

with gravity g and Earth rate omega. Let E(s) = Exp(omega s) and y = E(s) p, the position seen from axes
that stand still in inertial space and coincide with n at the interval's start. Then y'' = E(s) (R f + G)
with G = g(p) + omega x (omega x p), and the Coriolis force does not appear. Over an interval of length T::

    R_j = E^T R_i dR
    p_j = E^T (p_i + (v_i + omega x p_i) T + iint E G + R_i dP)
    v_j = E^T ((v_i + omega x p_i) + int E G + R_i dV) - omega x p_j

E is integrated in closed form and G, which changes only with position, linearly: exact to a millimetre
in ten minutes of free inertial. Scale errors of the sensors and axes that are not quite square, a constant matrix M
each, act like biases b + M * mean rate (or force) of the interval, which is how they are estimated
(`Intervals.inputs`).

A foot turns and is shaken about all axes. A vehicle turns about its vertical only, and gravity always pulls along it:
what M makes of gravity is one with the accelerometer's bias, and of pitch and roll, which return to zero, the gyro's
scale errors and its share in the heading are a ten thousandth of a radian. So it has the other eleven numbers. They
matter: a gyro that is a milliradian askew tilts by one and a half in every corner.

The residual of an interval is the end state minus this prediction. Its covariance is known in the frames
of `Intervals.covariance`; there it does not depend on the states. Filter and smoothers use the one
transition matrix F = d(end)/d(start) below.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array, mv
from graphnav.core.running import sum_running
from graphnav.core.state import DIM, Parameter, States
from graphnav.imu.preintegration import Intervals, multiply_up
from graphnav.recording import ACROSS, ImuNoise

SCALE = "imu_scale"
PRIORS = {"prior.gyro_scale": "gyro_scale_sigma", "prior.accel_scale": "accel_scale_sigma"}  # variance components
_I3 = np.eye(3)
# M_ij as (i, j): scale errors, then cross-axis terms
TERMS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
VEHICLE_TERMS = (TERMS[2:7], (TERMS[0], TERMS[1], TERMS[3], TERMS[5], TERMS[7], TERMS[8]))  # of gyro, accelerometer


@dataclass(frozen=True)
class _Terms:
    """Which terms of a triad's matrix are estimated."""

    into: Array  # (k,) i
    of: Array  # (k,) j
    select: Array  # (k, 3) one in column i

    @classmethod
    def make(cls, terms: Sequence[tuple[int, int]]) -> _Terms:
        into, of = np.array(terms, dtype=int).reshape(-1, 2).T
        return cls(into, of, _I3[into])

    def act(self, scale: Array, mean: Array) -> Array:
        """The bias (n, 3) that they amount to at means (n, 3)."""
        return np.asarray((scale * mean[:, self.of]) @ self.select)

    def differentiate(self, by_bias: Array, mean: Array) -> Array:
        """(n, r, k), from the derivative by the bias (n, r, 3)."""
        return np.asarray(by_bias[..., self.into] * mean[:, None, self.of])


_SETS = {
    sum(map(len, both)): (_Terms.make(both[0]), _Terms.make(both[1]))
    for both in (((), ()), VEHICLE_TERMS, (TERMS, TERMS))
}


def make_scale_parameter(noise: ImuNoise, platform: str) -> tuple[Parameter, ...]:
    """The terms of gyro and accelerometer that a platform shows, where the noise figures leave them open."""
    return _scale_parameter(noise, platform == "foot")


@lru_cache(maxsize=16)
def _scale_parameter(noise: ImuNoise, every: bool) -> tuple[Parameter, ...]:
    if noise.gyro_scale_sigma <= 0 and noise.accel_scale_sigma <= 0:
        return ()
    stated, sets = (noise.gyro_scale_sigma, noise.accel_scale_sigma), (TERMS, TERMS) if every else VEHICLE_TERMS
    sigma = [
        max(scale * (1.0 if i == j else ACROSS), 1e-9)
        for scale, terms in zip(stated, sets, strict=True)
        for i, j in terms
    ]
    groups = tuple(group for group, terms in zip(PRIORS, sets, strict=True) for _ in terms)
    return (Parameter(SCALE, np.zeros(len(sigma)), np.array(sigma), "1", noise_groups=groups),)


def convert_to_biases(scale: Array, force: Array, rate: Array) -> tuple[Array, Array]:
    """The biases of accelerometer and gyro, (n, 3) each, that scale errors (k,) or (n, k) amount to at means (n, 3)."""
    gyro, accel = _SETS[scale.shape[-1]]
    k = len(gyro.of)
    return accel.act(scale[..., k:], force), gyro.act(scale[..., :k], rate)


def differentiate_by_scale(by_bg: Array, by_ba: Array, force: Array, rate: Array, k: int) -> Array:
    """(n, r, k): derivative by k scale errors, from those by the biases (n, r, 3)."""
    gyro, accel = _SETS[k]
    return np.concatenate([gyro.differentiate(by_bg, rate), accel.differentiate(by_ba, force)], axis=-1)


class EarthMotion:
    """Motion of states in a local frame over times T (n,), given the integrated force; the formulas of this module.

    E turns about one axis, so that it and its integrals are I, W and W^2 of the frame times numbers of T alone.
    """

    def __init__(self, T: Array, frame: LocalFrame) -> None:
        self._frame, self._h = frame, T[:, None]
        h = self._h
        a, b, c, d = rotation.compute_coefficients(float(frame.omega_n @ frame.omega_n) * h * h)
        I, W, W2 = (x.ravel() for x in (_I3, frame.W, frame.W2))
        self.back = (I - (a * h) * W + (b * h * h) * W2).reshape(-1, 3, 3)  # E^T
        # of I, W and W^2 in int E and in iint E
        self._once, self._twice = (h, b * h * h, c * h**3), (0.5 * h * h, c * h**3, d * h**4)

    def reach(self, rows: slice, start: States, dR: Array, dP: Array, dV: Array, of: Array | None = None) -> States:
        """The states after times `rows`, by dR (n, 3, 3), dP and dV (n, 3) in the axes of their starts.

        `of` (n,) tells the start of each, where several have the same.
        """
        frame, h, back = self._frame, self._h[rows], self.back[rows]
        G = frame.gravity_n(start.p) + start.p @ frame.W2.T
        fall = np.concatenate([G, G @ frame.W.T, G @ frame.W2.T], axis=1)
        # gravity changes over the interval
        bent, u = start.v @ frame.gravity_gradient.T, start.v + start.p @ frame.W.T
        if of is not None:
            start, fall, bent, u = start[of], *(x.take(of, axis=0) for x in (fall, bent, u))
        moved = np.empty((len(dR), 3, 5))  # attitude, position, velocity
        moved[:, :, :3], moved[:, :, 3], moved[:, :, 4] = dR, dP, dV
        moved = start.R_nb @ moved
        moved[:, :, 3] += start.p + h * (u + h * h / 6.0 * bent)
        moved[:, :, 4] += u + 0.5 * h * h * bent
        for k, (once, twice) in enumerate(zip(self._once, self._twice, strict=True)):
            of_gravity = fall[:, 3 * k : 3 * k + 3]
            moved[:, :, 3] += twice[rows] * of_gravity
            moved[:, :, 4] += once[rows] * of_gravity
        moved = back @ moved
        R, p = moved[:, :, :3].copy(), moved[:, :, 3].copy()
        return States(R, p, moved[:, :, 4] - p @ frame.W.T, start.ba, start.bg)


class ImuFactors:
    """Prediction over preintegrated intervals in a local frame; everything independent of the states is computed
    once.
    """

    def __init__(self, intervals: Intervals, frame: LocalFrame) -> None:
        self.intervals, self.frame = intervals, frame
        self._earth = EarthMotion(intervals.T, frame)
        n, W = len(intervals), frame.W
        back = self.back = self._earth.back
        self.post = np.zeros((n, 6, 6))  # from (E p, E u) to (p, v)
        self.post[:, :3, :3] = self.post[:, 3:, 3:] = back
        self.post[:, 3:, :3] = -W @ back
        # d(theta, dP, dV) / d(ba, bg), (n, 9, 6)
        self.bias = np.zeros((n, 9, 6))
        self.bias[:, :3, 3:] = intervals.theta_bg
        self.bias[:, 3:6, :3], self.bias[:, 3:6, 3:] = intervals.p_ba, intervals.p_bg
        self.bias[:, 6:, :3], self.bias[:, 6:, 3:] = intervals.v_ba, intervals.v_bg
        self.step = np.concatenate([intervals.dP, intervals.dV], axis=-1)
        self.expected, self.inputs = np.concatenate([intervals.ba, intervals.bg], axis=-1), intervals.inputs

    def prepare(self) -> ImuFactors:
        """Compute everything that would otherwise be computed at first use; returns itself."""
        _ = self.whitener, self.inner
        return self

    def replace_noise(self, intervals: Intervals) -> ImuFactors:
        """The same of intervals that differ in covariances only."""
        _, other = self.inner, copy(self)  # computed once for all of them
        other.intervals = intervals
        other.__dict__.pop("whitener", None)
        return other

    @cached_property
    def inner(self) -> Array:
        """(n, 6, 6) derivative of the end's (p, v) by the start's, the gravity gradient included."""
        frame, h = self.frame, self.intervals.T[:, None, None]
        gradient, by_place = frame.gravity_gradient, frame.gravity_gradient + frame.W2
        ahead = np.empty((len(h), 6, 6))  # of (E p, E u)
        ahead[:, :3, :3] = _I3 + h * frame.W + 0.5 * h * h * by_place
        ahead[:, :3, 3:] = h * (_I3 + h * h / 6.0 * gradient)
        ahead[:, 3:, :3] = frame.W + h * by_place
        ahead[:, 3:, 3:] = _I3 + 0.5 * h * h * gradient
        return np.asarray(self.post @ ahead)

    @cached_property
    def whitener(self) -> Array:
        """(n, 15, 15) W with W^T W the inverse of `Intervals.covariance`.

        Raises
        ------
        numpy.linalg.LinAlgError
            If a covariance is singular.
        """
        return np.linalg.inv(np.linalg.cholesky(self.intervals.covariance))

    def propagate(self, rows: slice, start: States, scale: Array | None = None) -> tuple[States, Array]:
        """Propagate states to the ends of intervals `rows`, with F (n, 15, 15 + k): by the states and by scale errors.

        `scale` is (k,), (n, k) or None.
        """
        iv, R = self.intervals, start.R_nb
        n = len(R)
        turn, dR, moved = self._correct(rows, start, scale)
        end = self._earth.reach(rows, start, dR, moved[:, :3], moved[:, 3:])
        turned = self._turn(rows, R)
        F = np.zeros((n, DIM, DIM))
        F[:, 0:3, 0:3] = np.swapaxes(dR, -1, -2)
        # right_jacobian(turn) is I - [turn]x/2 for the small turns this is used for
        F[:, 0:3, 12:15] = (_I3 - 0.5 * rotation.skew(turn)) @ iv.theta_bg[rows]
        F[:, 3:9, 0:3] = turned @ -rotation.skew(moved.reshape(n, 2, 3)).reshape(n, 6, 3)
        F[:, 3:9, 3:9] = self.inner[rows]
        F[:, 3:9, 9:15] = turned @ self.bias[rows, 3:]
        F[:, 9:15, 9:15] = _I6
        if scale is None:
            return end, F
        # the bias columns, times what the scale errors multiply
        S, (force, rate) = np.zeros((n, DIM, scale.shape[-1])), self.inputs
        S[:, :9] = differentiate_by_scale(F[:, :9, 12:15], F[:, :9, 9:12], force[rows], rate[rows], S.shape[2])
        return end, np.concatenate([F, S], axis=2)

    def advance(self, rows: slice, start: States, scale: Array | None = None) -> States:
        """The states of `propagate` alone."""
        _, dR, moved = self._correct(rows, start, scale)
        return self._earth.reach(rows, start, dR, moved[:, :3], moved[:, 3:])

    def advance_through(self, rows: slice, start: States, scale: Array | None = None) -> States:
        """The states (n) at the ends of successive intervals, from one at the start of the first.

        Over all of them gravity changes linearly.
        """
        _, dR, moved = self._correct(rows, start, scale)
        T = self.intervals.T[rows]
        R = multiply_up(dR[:, None])[:, 0]
        V = sum_running(mv(R[:-1], moved[:, 3:]))
        P = sum_running(V[:-1] * T[:, None] + mv(R[:-1], moved[:, :3]))
        one = np.zeros(len(T), dtype=int)
        return EarthMotion(np.cumsum(T), self.frame).reach(slice(None), start, R[1:], P[1:], V[1:], one)

    def _correct(self, rows: slice, start: States, scale: Array | None) -> tuple[Array, Array, Array]:
        """Rotation (n, 3) by bias and scale errors, and dR, (dP, dV) (n, 6) corrected for them."""
        iv = self.intervals
        delta = np.concatenate([start.ba, start.bg], -1) - self.expected[rows]
        if scale is not None:
            delta += np.concatenate(convert_to_biases(scale, *(x[rows] for x in self.inputs)), -1)
        bent = mv(self.bias[rows], delta)
        turn = bent[:, :3]
        return turn, iv.dR[rows] @ rotation.exp(turn), self.step[rows] + bent[:, 3:]

    def _turn(self, rows: slice, R_nb: Array) -> Array:
        """(n, 6, 6) from (dP, dV) in the start's body axes to (p, v) at the end."""
        return (self.post[rows].reshape(-1, 6, 2, 3) @ R_nb[:, None]).reshape(-1, 6, 6)

    def compute_frames(self, rows: slice, R_nb: Array) -> Array:
        """(n, 15, 15) from the frames of `Intervals.covariance` to the error state at the end."""
        n = len(R_nb)
        L = np.zeros((n, DIM, DIM))
        L[:, 0:3, 0:3] = _I3
        L[:, 3:9, 3:9] = self._turn(rows, R_nb)
        L[:, 9:15, 9:15] = _I6
        return L

    def compute_noise(self, rows: slice, R_nb: Array) -> Array:
        """Q (n, 15, 15), covariance of the end's error state, for starts with attitudes R_nb."""
        Q, turned = self.intervals.covariance[rows].copy(), self._turn(rows, R_nb)
        Q[:, 3:9] = turned @ Q[:, 3:9]
        Q[:, :, 3:9] = Q[:, :, 3:9] @ np.swapaxes(turned, -1, -2)
        return np.asarray(Q)

    def compute_residual(self, states: States, scale: Array | None = None) -> Array:
        """(n, 15) end minus prediction for all intervals, in the frames of `Intervals.covariance`."""
        ahead = self.advance(slice(None), states[:-1], scale)
        return self._rotate(states[1:].minus(ahead), states.R_nb[:-1])

    def linearize(
        self, states: States, scale: Array | None = None, rows: slice = slice(None)
    ) -> tuple[Array, Array, Array, Array]:
        """Residuals (n, 15) of intervals `rows` between n + 1 states, as of `compute_residual`, Jacobians by both ends
        (n, 15, 15) and by the scale (n, 15, k).
        """
        start = states[:-1]
        ahead, F = self.propagate(rows, start, scale)
        r = states[1:].minus(ahead)
        r_theta = r[:, :3]
        inverse = rotation.right_jacobian_inverse(r_theta)
        both = -F
        both[:, :3] = inverse @ rotation.exp(-r_theta) @ both[:, :3]
        Jj = np.tile(np.eye(DIM), (len(F), 1, 1))
        Jj[:, :3, :3] = inverse
        value, both, Jj = (self.rotate_to_body(x, start.R_nb, rows) for x in (r[..., None], both, Jj))
        value = value[..., 0]
        # the frame of p and v rotates with the start's attitude
        both[:, 3:6, :3] += rotation.skew(value[:, 3:6])
        both[:, 6:9, :3] += rotation.skew(value[:, 6:9])
        return value, both[:, :, :DIM], Jj, both[:, :, DIM:]

    def rotate_to_body(self, J: Array, R_nb: Array, rows: slice = slice(None)) -> Array:
        """Turn the p and v rows of (n, 15, k) back into the start's body axes: inverse of `frames`."""
        Et = np.swapaxes(self.back[rows], -1, -2)
        Rt = np.swapaxes(R_nb, -1, -2) @ Et
        out = J.copy()
        out[:, 3:6] = Rt @ J[:, 3:6]
        out[:, 6:9] = Rt @ (J[:, 6:9] + self.frame.W @ J[:, 3:6])
        return out

    def _rotate(self, r: Array, R_nb: Array) -> Array:
        return self.rotate_to_body(r[..., None], R_nb)[..., 0]


_I6 = np.eye(6)
