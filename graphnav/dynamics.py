"""What a preintegrated interval says of the states at its ends, on the rotating, curved Earth.

In the fixed local frame n the vehicle obeys (Groves 2013, eq. 5.18-5.29, with n Earth-fixed)::

    dR/dt = R [omega_b - R^T omega]x    dv/dt = R f + g(p) - 2 omega x v    dp/dt = v

with gravity g and Earth rate omega. Let E(s) = Exp(omega s) and y = E(s) p, the position seen from axes
that stand still in inertial space and coincide with n at the interval's start. Then y'' = E(s) (R f + G)
with G = g(p) + omega x (omega x p), and the Coriolis force is gone. Over an interval of length T::

    R_j = E^T R_i dR
    p_j = E^T (p_i + (v_i + omega x p_i) T + iint E G + R_i dP)
    v_j = E^T ((v_i + omega x p_i) + int E G + R_i dV) - omega x p_j

E is integrated in closed form and G, which changes only with position, linearly: exact to a millimetre
in ten minutes of free inertial. The residual is

    r_theta = Log(dR^T R_i^T E R_j)          r_ba = ba_j - ba_i
    r_p = R_i^T (E p_j - ...) - dP           r_bg = bg_j - bg_i
    r_v = R_i^T (E (v_j + omega x p_j) - ...) - dV

in the frames of `Intervals.covariance`, so that its weight does not depend on the states. The filter
predicts with, and the smoothers linearise, this one function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav import earth, rotation
from graphnav.earth import LocalFrame
from graphnav.preintegration import Intervals
from graphnav.rotation import Array, mv
from graphnav.state import DIM, States


@dataclass(frozen=True)
class _EarthTerms:
    """E, the integrals of E G and their derivatives, per interval."""

    E: Array  # (n, 3, 3)
    gv: Array  # (n, 3) m/s
    gp: Array  # (n, 3) m
    gradient: Array  # (n, 3, 3) dG/dp, 1/s^2
    omega: Array  # (3,)


class EarthMotion:
    """The Earth's part for fixed interval lengths: rotations are computed once, gravity where asked."""

    def __init__(self, frame: LocalFrame, T: Array) -> None:
        self.frame = frame
        self.omega = frame.omega_n
        self.T = T
        self.E = rotation.exp(self.omega * T[:, None])
        self.gamma1, self.gamma2 = rotation.integrals(self.omega * T[:, None])
        self.W = rotation.skew(self.omega)
        self.W2 = self.W @ self.W

    def terms(self, rows: slice, states: States) -> _EarthTerms:
        """For intervals `rows` that start at `states`."""
        T = self.T[rows, None]
        g = self.frame.gravity_n(states.p)
        # Newtonian gradient, -(g/r)(I - 3 u u^T): a small term that makes long outages honest (Schuler)
        size = np.linalg.norm(g, axis=-1)[:, None, None]
        up = -g[..., None] / size
        gradient = -size / earth.A * (np.eye(3) - 3.0 * up @ np.swapaxes(up, -1, -2))
        G = g + states.p @ self.W2.T
        change = mv(gradient, states.v * T)
        gv = mv(self.gamma1[rows], G) * T + 0.5 * change * T
        gp = mv(self.gamma2[rows], G) * T * T + change * T * T / 6.0
        return _EarthTerms(self.E[rows], gv, gp, gradient, self.omega)


def predict(intervals: Intervals, rows: slice, start: States, motion: EarthMotion) -> States:
    """The states at the ends of intervals from those at their starts."""
    iv, e = intervals[rows], motion.terms(rows, start)
    T = iv.T[:, None]
    dR, dV, dP, _ = iv.corrected(start.ba, start.bg)
    back = np.swapaxes(e.E, -1, -2)
    rate = start.v + start.p @ motion.W.T
    p = mv(back, start.p + rate * T + e.gp + mv(start.R_nb, dP))
    v = mv(back, rate + e.gv + mv(start.R_nb, dV)) - p @ motion.W.T
    return States(back @ start.R_nb @ dR, p, v, start.ba, start.bg)


def linearize(
    intervals: Intervals, rows: slice, start: States, end: States, motion: EarthMotion
) -> tuple[Array, Array, Array]:
    """Residual (n, 15) and its Jacobians (n, 15, 15) with respect to the states at both ends."""
    iv, e = intervals[rows], motion.terms(rows, start)
    n, T = len(iv), iv.T[:, None]
    Rt = np.swapaxes(start.R_nb, -1, -2)
    RtE = Rt @ e.E
    seen = RtE @ end.R_nb  # R_i^T E R_j
    value, a, b, turn = _residual(iv, e, start, end, motion, seen)
    r_theta = value[:, :3]
    Ji, Jj = np.zeros((n, DIM, DIM)), np.zeros((n, DIM, DIM))
    th, p, v, ba, bg = (slice(3 * k, 3 * k + 3) for k in range(5))
    inverse = rotation.right_jacobian_inverse(r_theta)
    h = T[..., None]
    Ji[:, th, th] = -inverse @ np.swapaxes(seen, -1, -2)
    Ji[:, th, bg] = -inverse @ rotation.exp(-r_theta) @ rotation.right_jacobian(turn) @ iv.theta_bg
    Jj[:, th, th] = inverse
    Ji[:, p, th] = rotation.skew(b)
    Ji[:, p, p] = -Rt @ (np.eye(3) + h * motion.W + 0.5 * h * h * (e.gradient + motion.W2))
    Ji[:, p, v] = -h * Rt @ (np.eye(3) + h * h / 6.0 * e.gradient)
    Ji[:, p, ba], Ji[:, p, bg] = -iv.p_ba, -iv.p_bg
    Jj[:, p, p] = RtE
    Ji[:, v, th] = rotation.skew(a)
    Ji[:, v, p] = -Rt @ (motion.W + h * (e.gradient + motion.W2))
    Ji[:, v, v] = -Rt @ (np.eye(3) + 0.5 * h * h * e.gradient)
    Ji[:, v, ba], Ji[:, v, bg] = -iv.v_ba, -iv.v_bg
    Jj[:, v, p], Jj[:, v, v] = RtE @ motion.W, RtE
    for k in (ba, bg):
        Ji[:, k, k], Jj[:, k, k] = -np.eye(3), np.eye(3)
    return value, Ji, Jj


def residual(intervals: Intervals, start: States, end: States, motion: EarthMotion) -> Array:
    """Only the residual (n, 15) of `linearize`, for all intervals."""
    e = motion.terms(slice(None), start)
    seen = np.swapaxes(start.R_nb, -1, -2) @ e.E @ end.R_nb
    return _residual(intervals, e, start, end, motion, seen)[0]


def _residual(
    iv: Intervals, e: _EarthTerms, start: States, end: States, motion: EarthMotion, seen: Array
) -> tuple[Array, Array, Array, Array]:
    """The residual, the measured-like velocity and position steps in it, and the bias turn of dR."""
    T = iv.T[:, None]
    dR, dV, dP, turn = iv.corrected(start.ba, start.bg)
    Rt = np.swapaxes(start.R_nb, -1, -2)
    rate = start.v + start.p @ motion.W.T
    a = mv(Rt, mv(e.E, end.v + end.p @ motion.W.T) - rate - e.gv)
    b = mv(Rt, mv(e.E, end.p) - start.p - rate * T - e.gp)
    r_theta = rotation.log(np.swapaxes(dR, -1, -2) @ seen)
    value = np.concatenate([r_theta, b - dP, a - dV, end.ba - start.ba, end.bg - start.bg], -1)
    return value, a, b, turn


def transition(
    intervals: Intervals, rows: slice, start: States, end: States, motion: EarthMotion
) -> tuple[Array, Array]:
    """F and Q (n, 15, 15) with d_j = F d_i + noise, from the same linearisation."""
    _, Ji, Jj = linearize(intervals, rows, start, end, motion)
    inverse = np.linalg.inv(Jj)
    return -inverse @ Ji, inverse @ intervals.covariance[rows] @ np.swapaxes(inverse, -1, -2)
