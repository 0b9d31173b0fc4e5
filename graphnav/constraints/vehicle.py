"""Constraints of wheels: no sideways or upward velocity; and what the forward speed (`constraints.odometer`) shares.

Zhu 2020, eq. 10-19, with two differences. First, the constraint is on the mean velocity over the whole interval
that ends at a keyframe, not on the velocity at one moment. Expressed by the state at the end, s seconds later, with
C(s) the rotation from the axes at the end to those at s, which the gyro gives::

    v_b(s) = C(s) R_nb^T (v - (g - omega_n x v) s) - C(s) dV(s)       dV(s): force integrated from s to the end
    u      = mean of v_b + omega_nb x l                               at the lever arm l

So every reading of a fast odometer is used, and motion on the springs within a second averages out. Second, a car is
not a rigid cart: with the mounting angles pitch alpha and heading beta of the IMU against the vehicle,
R_vb = Rz(-beta) Rx(alpha), and u_v = R_vb u = (right, forward, up)::

    right:    u_v,x - slip  u_v,y (u_v,y omega_z)     tyres need a slip angle for lateral acceleration
    up:       u_v,z - squat u_v,y a_y                 springs pitch the body under forward acceleration a_y
    forward:  u_v,y / (1 + k) - s                     s: mean of the odometer, k: its scale error

Both coefficients, the mounting angles (which wander: load, wind, the crown of the road), the forward place of the
axle that does not slip, and the scale are estimated.

The sigma of a mean over T seconds is a density over sqrt(T), and larger where the constraints hold less well: beyond 3
m/s^2 of lateral force tyres leave their linear range; in quick yaw the axle's place matters; where pitch changes
quickly (ramps, bumps) front and rear axle are on different slopes, half a wheelbase apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint, Linearized
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array, mv, stack_columns
from graphnav.core.state import SECONDS, Parameter, States
from graphnav.imu.dynamics import SCALE, convert_to_biases, differentiate_by_scale, make_scale_parameter
from graphnav.imu.preintegration import Intervals
from graphnav.recording import Recording

MOUNTING = "mounting"
AXLE = "axle"
BODY = "slip_squat"
NHC_ERROR = "nhc_error"
_SHORTEST_MEAN = 0.02  # s; the mean over a shorter interval carries no information
_LINEAR_TYRES = 3.0  # m/s^2, lateral force up to which tyres behave linearly
_BEYOND = 0.1  # m/s of sideways speed per m/s^2 beyond that
_AXLE_LEFT = 0.2  # m, uncertainty of the axle's place in a turn: front wheels steer, tyres have width
_HALF_WHEELBASE = 1.3  # m
_I2, _I3 = np.eye(2), np.eye(3)
_E_Y = np.array([[0.0, 1.0, 0.0]])
_SIDE_UP, _UP = _I3[None, ::2], _I3[2]
_BY_HEADING = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # u @ this = (u_y, -u_x, 0)
_BY_AXLE = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])  # omega @ this = omega x e_y


@dataclass(frozen=True)
class IntervalMotion:
    """Mean velocity and force over the intervals that end at some keyframes, as a function of the state there.

    Six numbers and their derivatives, velocity first.
    """

    frame: LocalFrame
    by_seen: Array  # (N, 6, 9) of `Intervals.past_*`: by v, g - omega_n x v and omega_n, in body axes
    by_ba: Array  # (N, 6, 3)
    felt: Array  # (N, 6) minus the velocity gained, and the mean force
    ba: Array  # (N, 3) the biases used for them
    bg: Array
    rate: Array  # (N, 3) mean rate and force, minus those biases
    force: Array

    @classmethod
    def of(cls, intervals: Intervals, rows: Array, frame: LocalFrame) -> IntervalMotion:
        """Select the intervals `rows`."""
        iv, n = intervals, len(rows)
        by_seen, by_ba = np.zeros((n, 6, 9)), np.empty((n, 6, 3))
        by_seen[:, :3, :3], by_seen[:, :3, 3:6], by_seen[:, 3:, 3:6] = iv.past_turn[rows], -iv.past_late[rows], _I3
        by_ba[:, :3], by_ba[:, 3:] = -iv.past_ba[rows], -_I3
        felt = np.concatenate([-iv.past_dV[rows], iv.force[rows]], axis=1)
        return cls(frame, by_seen, by_ba, felt, *(x[rows] for x in (iv.ba, iv.bg, iv.rate, iv.force)))

    def compute_velocity(
        self, states: States, parameters: dict[str, Array], rows: slice | Array, lever: Array
    ) -> tuple[Array, Array, dict[str, Array]]:
        """u (N, 3) at a lever arm and the mean acceleration, (N, 6), turn rate, and the derivatives of the first. All
        in body axes.

        The acceleration excludes centripetal and tangential terms, as springs sense it: accelerometer minus gravity.
        """
        by_seen, by_ba, rate, force = self.by_seen[rows].copy(), self.by_ba[rows], self.rate[rows], self.force[rows]
        W, n = self.frame.W, len(states)
        da, dg = states.ba - self.ba[rows], states.bg - self.bg[rows]
        if SCALE in parameters:
            scale = parameters[SCALE]
            of_accel, of_gyro = convert_to_biases(scale, force, rate)
            da, dg = da + of_accel, dg + of_gyro
        seen = np.empty((n, 3, 3))
        seen[:, 0], seen[:, 1] = states.v, self.frame.gravity_n(states.p) - states.v @ W.T
        seen[:, 2] = self.frame.omega_n
        seen = seen @ states.R_nb
        cross, L = rotation.skew(seen), rotation.skew(lever)
        by_seen[:, :3, :3] += by_seen[:, :3, 3:6] @ rotation.skew(dg)
        by_seen[:, :3, 6:] = L
        seen[:, 2] -= rate - dg  # minus the turn rate
        found = mv(by_seen, seen.reshape(n, 9)) + mv(by_ba, da) + self.felt[rows]
        by_bg = np.zeros((n, 6, 3))
        by_bg[:, :3] = L - by_seen[:, :3, 3:6] @ cross[:, 0]
        in_n = (by_seen.reshape(n, 18, 3) @ np.swapaxes(states.R_nb, -1, -2)).reshape(n, 6, 3, 3)
        J = {
            "theta": by_seen @ cross.reshape(n, 9, 3),
            "v": in_n[:, :, 0] - in_n[:, :, 1] @ W,
            "ba": by_ba,
            "bg": by_bg,
        }
        if SCALE in parameters:
            J[SCALE] = differentiate_by_scale(by_bg, by_ba, force, rate, scale.shape[-1])
        return found, -seen[:, 2], J


def _rotate_to_vehicle(u: Array, mounting: Array) -> tuple[Array, Array, Array]:
    """R_vb u (N, 3), R_vb (N, 3, 3), and the derivative of R_vb u by the mounting angles (N, 3, 2)."""
    (ca, cb), (sa, sb) = np.cos(mounting).T, np.sin(mounting).T
    zero = np.zeros_like(ca)
    R = stack_columns(cb, sb * ca, -sb * sa, -sb, cb * ca, -cb * sa, zero, sa, ca).reshape(-1, 3, 3)
    out = mv(R, u)
    by_pitch = R[:, :, 2] * u[:, 1:2] - R[:, :, 1] * u[:, 2:]
    return out, R, stack_columns(by_pitch, out @ _BY_HEADING)


@dataclass(frozen=True)
class Wheels(Constraint):
    """The part common to both constraints: the keyframes, and u_v with its derivatives."""

    looks_ahead: ClassVar[bool] = False
    of_wheels: ClassVar[bool] = True

    past: IntervalMotion | None = None
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)  # any keyframe is suitable

    def _compute_velocity(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> _Velocity:
        assert self.past is not None
        lever = self.lever_arm + (parameters[AXLE] * _E_Y if AXLE in parameters else np.zeros((len(states), 3)))
        y, omega, J = self.past.compute_velocity(states, parameters, rows, lever)
        u, R, by_mounting = _rotate_to_vehicle(y[:, :3], parameters.get(MOUNTING, np.zeros((len(states), 2))))
        return _Velocity(u, omega, y[:, 4], R, by_mounting, J)


@dataclass(frozen=True)
class _Velocity:
    """Mean velocity in the vehicle's axes."""

    u: Array  # (N, 3)
    omega: Array  # (N, 3) body axes
    forward: Array  # (N,) m/s^2, acceleration
    R_vb: Array
    by_mounting: Array  # (N, 3, 2)
    J: dict[str, Array]  # (N, 6, k) `IntervalMotion.velocity`

    def differentiate(
        self, A: Array, parameters: dict[str, Array], by_forward: Array | None = None
    ) -> dict[str, Array]:
        """Derivatives of A u (N, m) for A (N, m, 3), plus `by_forward` (N, m) times the forward acceleration."""
        B = A @ self.R_vb
        if by_forward is None:
            out = {name: B @ x[:, :3] for name, x in self.J.items()}
        else:
            both = np.zeros((*B.shape[:2], 6))
            both[:, :, :3], both[:, :, 4] = B, by_forward
            out = {name: both @ x for name, x in self.J.items()}
        if MOUNTING in parameters:
            out[MOUNTING] = A @ self.by_mounting
        if AXLE in parameters:
            out[AXLE] = B @ (self.omega @ _BY_AXLE)[..., None]
        return out


def find_moving_rows(scene: BuildContext) -> Array:
    """Indices of the intervals in which the vehicle moves, long enough to carry information."""
    t0, t1 = scene.intervals.t0, scene.intervals.t1
    usable = t1 - t0 >= _SHORTEST_MEAN
    for begin, end in scene.stationary:
        usable &= (t1 <= begin + SAME_TIME) | (t0 >= end - SAME_TIME)
    return np.flatnonzero(usable)


def make_wheel_parameters(scene: BuildContext) -> tuple[Array, list[Parameter]]:
    """Lever arm (3,) of the point that does not slip, m, and the parameters of both constraints."""
    s, odometer = scene.settings.vehicle, scene.recording.odometer
    parameters = list(make_scale_parameter(scene.recording.imu.noise, scene.recording.platform))
    lever = np.zeros(3) if odometer is None else odometer.lever_arm
    if s.mounting_sigma > 0:
        sigma, walk = np.radians(s.mounting_sigma), np.radians(s.mounting_walk) / 60.0
        initial = np.radians(np.asarray(s.mounting))
        parameters.append(Parameter(MOUNTING, initial, np.full(2, sigma), "rad", walk=walk))
    stated = bool(np.any(lever))
    sigma_axle = s.axle_sigma if stated else s.unstated_axle_sigma
    if sigma_axle > 0:
        parameters.append(Parameter.centred(AXLE, 1, sigma_axle, "m"))
    return lever, parameters


def make_slow_error_parameter(name: str, density: Array, kind: type[Wheels]) -> Parameter:
    """Gauss-Markov process (k,) of wheel errors that last for seconds: camber, wind, load, slip.

    Over long times it is equivalent to white noise of the density given (m/s/sqrt(Hz)), whose variance is 2 T sigma^2
    for a process of correlation time T.
    """
    groups = tuple(f"{kind.name}.seconds.{axis}" for axis in kind.noise_axes)
    sigma = density / np.sqrt(2.0 * SECONDS)
    return Parameter(
        name, np.zeros(len(sigma)), sigma, "m/s", correlation_time=SECONDS, spacing=0.2 * SECONDS, noise_groups=groups
    )


@dataclass(frozen=True)
class NonHolonomic(Wheels):
    """The vehicle has no sideways or upward velocity (NHC)."""

    name: ClassVar[str] = "nhc"
    axes: ClassVar[tuple[str, ...]] = ("right", "up")
    noise_axes: ClassVar[tuple[str, ...]] = ("right", "up")
    unit: ClassVar[str] = "m/s"

    sigma: Array = field(default_factory=lambda: np.empty((0, 2)))

    @classmethod
    def build(cls, scene: BuildContext) -> NonHolonomic | None:
        s = scene.settings.vehicle
        if scene.recording.platform != "vehicle" or not s.nhc:
            return None
        rows, past = scene.moving_rows, scene.interval_motion
        lever_arm, parameters = make_wheel_parameters(scene)
        if s.body_sigma > 0:
            parameters.append(
                Parameter.centred(BODY, 2, s.body_sigma, "rad s^2/m, of lateral and forward acceleration")
            )
        density = np.asarray(s.nhc_density) / np.sqrt(scene.intervals.T[rows])[:, None]
        beyond = np.maximum(np.abs(past.force[:, 0]) - _LINEAR_TYRES, 0.0)
        right = np.hypot(_BEYOND * beyond, _AXLE_LEFT * past.rate[:, 2])
        up = _HALF_WHEELBASE * past.rate[:, 0]
        return cls(
            keyframe=rows + 1,
            past=past,
            sigma=np.hypot(density, stack_columns(right, up)),
            unscaled=stack_columns(right, up),
            lever_arm=lever_arm,
            parameters=tuple(parameters),
            processes=(make_slow_error_parameter(NHC_ERROR, np.asarray(s.nhc_density), cls),),
            **s.outliers,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        assert self.past is not None
        found = self._compute_velocity(states, parameters, rows)
        residual, u, omega = found.u[:, ::2], found.u, found.omega
        lasting = {}
        if NHC_ERROR in parameters:
            residual = residual + parameters[NHC_ERROR]
            lasting = {NHC_ERROR: np.broadcast_to(_I2, (len(u), 2, 2))}
        if BODY not in parameters:
            return Linearized(residual, found.differentiate(_SIDE_UP, parameters) | lasting, self.sigma[rows])
        slip, squat = parameters[BODY].T
        v, w, a = u[:, 1], omega[:, 2], found.forward
        effect = stack_columns(v * v * w, v * a)
        A, by_forward = np.repeat(_SIDE_UP, len(v), axis=0), np.zeros((len(v), 2))
        A[:, 0, 1], A[:, 1, 1], by_forward[:, 1] = -2.0 * slip * v * w, -squat * a, -squat * v
        jacobians = found.differentiate(A, parameters, by_forward)
        jacobians[BODY] = -effect[:, :, None] * _I2
        # contribution of the turn rate itself, v v d(omega_z)
        by_w = (slip * v * v)[:, None]
        jacobians["bg"][:, 0, 2] += by_w[:, 0]
        Rt = np.swapaxes(states.R_nb, -1, -2)
        jacobians["theta"][:, 0] += by_w * rotation.skew(mv(Rt, self.past.frame.omega_n))[:, 2]
        if SCALE in parameters:
            by_bg = by_w[:, None] * _UP
            of_turn = (by_bg, np.zeros_like(by_bg), self.past.force[rows], self.past.rate[rows])
            jacobians[SCALE][:, :1] += differentiate_by_scale(*of_turn, parameters[SCALE].shape[-1])
        return Linearized(residual - parameters[BODY] * effect, jacobians | lasting, self.sigma[rows])
