"""What wheels allow: no sideways or upward speed where they do not slip, and forward speed as the odometer has it.

Zhu 2020, eq. 10-19, with two differences. First, the constraint is on the mean velocity over the whole interval
that ends at a keyframe, not on the velocity of one moment. Seen from the state at the end, s seconds later, with
C(s) the rotation from the axes then to those at s, which the gyro gives::

    v_b(s) = C(s) R_nb^T (v - (g - omega_n x v) s) - C(s) dV(s)       dV(s): force integrated from s to the end
    u      = mean of v_b + omega_nb x l                               at the lever arm l

So every reading of a fast odometer counts, and what the springs do within a second averages out. Second, a car is
not a cart: with the mounting angles pitch alpha and heading beta of the IMU against the vehicle,
R_vb = Rz(-beta) Rx(alpha), and u_v = R_vb u = (right, forward, up)::

    right:    u_v,x - slip  u_v,y (u_v,y omega_z)     tyres need a slip angle for lateral acceleration
    up:       u_v,z - squat u_v,y a_y                 springs pitch the body under forward acceleration a_y
    forward:  u_v,y - (1 + k) s                       s: mean of the odometer, k: its scale error

Both coefficients, the mounting angles (which wander: load, wind, the crown of the road), the forward place of the
axle that does not slip, and the scale are estimated.

The sigma of a mean over T seconds is a density over sqrt(T), and more where the rules hold less: beyond 3 m/s^2 of
lateral force tyres leave their linear range; in quick yaw the axle's place matters; where pitch changes quickly
(ramps, bumps) front and rear axle are on different slopes, half a wheelbase apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from graphnav import rotation
from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME, Constraint, Linearized, Scene
from graphnav.dynamics import SCALE, as_biases, by_scale, scale_parameter
from graphnav.earth import LocalFrame
from graphnav.preintegration import Intervals
from graphnav.recording import Imu, Odometer, Recording
from graphnav.rotation import Array, columns, mv
from graphnav.state import Parameter, States
from graphnav.wheels import Figures, MeanSpeed, faults

MOUNTING = "mounting"
AXLE = "axle"
BODY = "slip_squat"
ODOMETER_SCALE = "odometer_scale"
ODOMETER_DELAY = "odometer_delay"
REACH = 4.0  # sigmas of the delay that rows are prepared for
_SHORTEST = 0.02  # s; a mean over less says nothing
_LINEAR = 3.0  # m/s^2, lateral force up to which tyres behave linearly
_BEYOND = 0.1  # m/s of sideways speed per m/s^2 beyond that
_AXLE_LEFT = 0.2  # m, what is not known of the axle's place in a turn: front wheels steer, tyres have width
_HALF_WHEELBASE = 1.3  # m
_I3 = np.eye(3)
_E_Y = np.array([[0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class Past:
    """Mean velocity over the intervals that end at some keyframes, as a function of the state there."""

    frame: LocalFrame
    turn: Array  # (N, 3, 3) `Intervals.past_*`
    late: Array
    dV: Array
    by_ba: Array
    ba: Array  # (N, 3) the biases they were computed with
    bg: Array
    rate: Array  # (N, 3) mean rate and force, less those biases
    force: Array

    @cached_property
    def asked(self) -> dict[str, Any]:
        """What was asked for one state last, and the answer."""
        return {}

    @classmethod
    def of(cls, intervals: Intervals, rows: Array, frame: LocalFrame) -> Past:
        """Of the intervals `rows`."""
        iv = intervals
        parts = (iv.past_turn, iv.past_late, iv.past_dV, iv.past_ba, iv.ba, iv.bg, iv.rate, iv.force)
        return cls(frame, *(x[rows] for x in parts))

    def velocity(
        self, states: States, parameters: dict[str, Array], rows: slice | Array, lever: Array
    ) -> tuple[Array, Array, Array, dict[str, Array], dict[str, Array]]:
        """u (N, 3) at a lever arm, body axes; turn rate; acceleration; and the derivatives of u and acceleration."""
        turn, late, rate, force = self.turn[rows], self.late[rows], self.rate[rows], self.force[rows]
        omega_n = self.frame.omega_n
        W = self.frame.W
        Rt = np.swapaxes(states.R_nb, -1, -2)
        da, dg = states.ba - self.ba[rows], states.bg - self.bg[rows]
        if SCALE in parameters:
            scale = parameters[SCALE]
            of_accel, of_gyro = as_biases(scale, force, rate)
            da, dg = da + of_accel, dg + of_gyro
        v, g = mv(Rt, states.v), mv(Rt, self.frame.gravity_n(states.p) - states.v @ W.T)
        earth = mv(Rt, omega_n)
        omega = rate - dg - earth
        L = rotation.skew(lever)
        turned = turn - late @ rotation.skew(dg)
        u = mv(turned, v) - mv(late, g) - self.dV[rows] - mv(self.by_ba[rows], da) - mv(L, omega)
        by_ba, by_bg = -self.by_ba[rows], late @ rotation.skew(v) + L
        J = {
            "theta": turned @ rotation.skew(v) - late @ rotation.skew(g) + L @ rotation.skew(earth),
            "v": turned @ Rt + late @ Rt @ W,
            "ba": by_ba,
            "bg": by_bg,
        }
        # without turning, as springs feel it: what the accelerometer reads less gravity
        acceleration = force - da + g
        Ja = {"theta": rotation.skew(g), "v": -Rt @ W, "ba": -_I3[None]}
        if SCALE in parameters:
            half = scale.shape[-1] // 2
            J[SCALE] = np.concatenate([by_scale(by_bg, rate, half), by_scale(by_ba, force, half)], axis=-1)
            Ja[SCALE] = np.zeros_like(J[SCALE])
            Ja[SCALE][..., half:] = by_scale(-_I3[None], force, half)
        return u, omega, acceleration, J, Ja


def _turned(u: Array, mounting: Array) -> tuple[Array, Array, Array]:
    """R_vb u (N, 3), R_vb (N, 3, 3), and the derivative of R_vb u by the mounting angles (N, 3, 2)."""
    (ca, cb), (sa, sb) = np.cos(mounting).T, np.sin(mounting).T
    zero = np.zeros_like(ca)
    R = columns(cb, sb * ca, -sb * sa, -sb, cb * ca, -cb * sa, zero, sa, ca).reshape(-1, 3, 3)
    out = mv(R, u)
    by_pitch = mv(R, columns(zero, -u[:, 2], u[:, 1]))
    by_heading = columns(out[:, 1], -out[:, 0], zero)
    return out, R, columns(by_pitch, by_heading)


@dataclass(frozen=True)
class Wheels(Constraint):
    """What both constraints share: where rows are, and u_v with its derivatives."""

    looks_ahead: ClassVar[bool] = False

    past: Past | None = None
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)  # any keyframe will do

    def _velocity(
        self, states: States, parameters: dict[str, Array], rows: slice | Array
    ) -> tuple[Array, dict[str, Array], Array, Array, dict[str, Array]]:
        """u_v, its derivatives, turn rate and acceleration (body axes), and the latter's derivatives."""
        assert self.past is not None
        # both constraints on one keyframe ask the same, one after the other
        asked = self.past.asked
        values = [parameters[name] for name in (SCALE, MOUNTING, AXLE) if name in parameters]
        known = isinstance(rows, slice) and asked.get("states") is states and asked["rows"] == rows
        if (
            known
            and len(values) == len(asked["values"])
            and all(map(np.array_equal, values, asked["values"]))
            and asked["lever"] is self.lever_arm
        ):
            return asked["found"]  # type: ignore[no-any-return]
        found = self._found(states, parameters, rows)
        if len(states) == 1 and isinstance(rows, slice):
            asked |= {"states": states, "rows": rows, "values": values, "lever": self.lever_arm, "found": found}
        return found

    def _found(
        self, states: States, parameters: dict[str, Array], rows: slice | Array
    ) -> tuple[Array, dict[str, Array], Array, Array, dict[str, Array]]:
        assert self.past is not None
        lever = self.lever_arm + (parameters[AXLE] * _E_Y if AXLE in parameters else np.zeros((len(states), 3)))
        u, omega, acceleration, J, Ja = self.past.velocity(states, parameters, rows, lever)
        mounting = parameters.get(MOUNTING, np.zeros((len(states), 2)))
        out, R, by_mounting = _turned(u, mounting)
        jacobians = {name: R @ x for name, x in J.items()}
        if MOUNTING in parameters:
            jacobians[MOUNTING] = by_mounting
        if AXLE in parameters:
            jacobians[AXLE] = R @ columns(-omega[:, 2], np.zeros(len(omega)), omega[:, 0])[..., None]
        return out, jacobians, omega, acceleration, Ja


def moving_rows(scene: Scene) -> Array:
    """Indices of the intervals in which the vehicle does not stand, long enough to mean something."""
    if "moving" not in scene.made:
        scene.made["moving"] = _moving_rows(scene)
    return np.asarray(scene.made["moving"])


def shared_past(scene: Scene) -> Past:
    """Of the intervals `moving_rows`."""
    if "past" not in scene.made:
        scene.made["past"] = Past.of(scene.intervals, moving_rows(scene), scene.frame)
    past = scene.made["past"]
    assert isinstance(past, Past)
    return past


def _moving_rows(scene: Scene) -> Array:
    t0, t1 = scene.intervals.t0, scene.intervals.t1
    usable = t1 - t0 >= _SHORTEST
    for begin, end in scene.stationary:
        usable &= (t1 <= begin + SAME_TIME) | (t0 >= end - SAME_TIME)
    return np.flatnonzero(usable)


def shared_parameters(scene: Scene) -> dict[str, Any]:
    """Lever arm of the point that does not slip, and the parameters both constraints depend on."""
    if "wheels" not in scene.made:
        scene.made["wheels"] = _shared_parameters(scene)
    lever, parameters = scene.made["wheels"]
    return {"lever_arm": lever, "parameters": list(parameters)}


def _shared_parameters(scene: Scene) -> tuple[Array, list[Parameter]]:
    s, odometer = scene.settings.vehicle, scene.recording.odometer
    parameters = list(scale_parameter(scene.recording))
    lever = np.zeros(3) if odometer is None else odometer.lever_arm
    if s.mounting_sigma > 0:
        sigma, walk = np.radians(s.mounting_sigma), np.radians(s.mounting_walk) / 60.0
        initial = np.radians(np.asarray(s.mounting))
        parameters.append(Parameter(MOUNTING, initial, np.full(2, sigma), "rad", walk=walk))
    stated = bool(np.any(lever))
    sigma_axle = s.axle_sigma if stated else s.unstated_axle_sigma
    if sigma_axle > 0:
        parameters.append(Parameter(AXLE, np.zeros(1), np.full(1, sigma_axle), "m"))
    return lever, parameters


@dataclass(frozen=True)
class NonHolonomic(Wheels):
    """The vehicle moves neither sideways nor up (NHC)."""

    name: ClassVar[str] = "nhc"
    axes: ClassVar[tuple[str, ...]] = ("right", "up")
    unit: ClassVar[str] = "m/s"

    sigma: Array = field(default_factory=lambda: np.empty((0, 2)))

    @classmethod
    def build(cls, scene: Scene) -> NonHolonomic | None:
        s = scene.settings.vehicle
        if scene.recording.platform != "vehicle" or not s.nhc:
            return None
        rows = moving_rows(scene)
        shared = shared_parameters(scene)
        if s.body_sigma > 0:
            shared["parameters"].append(
                Parameter(BODY, np.zeros(2), np.full(2, s.body_sigma), "rad s^2/m, of lateral and forward acceleration")
            )
        shared["parameters"] = tuple(shared["parameters"])
        past = shared_past(scene)
        density = np.asarray(s.nhc_density) / np.sqrt(scene.intervals.T[rows])[:, None]
        beyond = np.maximum(np.abs(past.force[:, 0]) - _LINEAR, 0.0)
        right = np.hypot(_BEYOND * beyond, _AXLE_LEFT * past.rate[:, 2])
        up = _HALF_WHEELBASE * past.rate[:, 0]
        return cls(
            keyframe=rows + 1,
            past=past,
            sigma=np.hypot(density, columns(right, up)),
            **s.outliers,
            **shared,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        assert self.past is not None
        u, J, omega, acceleration, Ja = self._velocity(states, parameters, rows)
        residual = u[:, ::2]
        jacobians = {name: x[:, ::2] for name, x in J.items()}
        if BODY in parameters:
            slip, squat = parameters[BODY].T
            v, w, a = u[:, 1], omega[:, 2], acceleration[:, 1]
            effect = columns(v * v * w, v * a)
            residual = residual - parameters[BODY] * effect
            by_v = columns(2.0 * slip * v * w, squat * a)[..., None]
            by_a = columns(np.zeros_like(v), squat * v)[..., None]
            for name in J:
                jacobians[name] = jacobians[name] - by_v * J[name][:, 1:2]
                if name in Ja:
                    jacobians[name] = jacobians[name] - by_a * Ja[name][:, 1:2]
            jacobians[BODY] = -effect[:, :, None] * np.eye(2)
            # the turn rate's own share, v v d(omega_z)
            by_w = (slip * v * v)[:, None]
            jacobians["bg"][:, 0, 2] += by_w[:, 0]
            Rt = np.swapaxes(states.R_nb, -1, -2)
            jacobians["theta"][:, 0] += by_w * rotation.skew(mv(Rt, self.past.frame.omega_n))[:, 2]
            if SCALE in parameters:
                jacobians[SCALE][:, 0, 2] += by_w[:, 0] * self.past.rate[rows][:, 2]
        return Linearized(residual, jacobians, self.sigma[rows])


def _speed_of(odometer: Odometer, imu: Imu) -> MeanSpeed:
    figures = Figures.of(odometer)
    return MeanSpeed.of(odometer, faults(odometer, imu, figures).spans, figures)


@dataclass(frozen=True)
class OdometerSpeed(Wheels):
    """The vehicle moved as fast as its odometer read."""

    name: ClassVar[str] = "odometer"
    axes: ClassVar[tuple[str, ...]] = ("forward",)
    unit: ClassVar[str] = "m/s"

    begin: Array = field(default_factory=lambda: np.empty(0))  # the interval of each row, s
    end: Array = field(default_factory=lambda: np.empty(0))
    speed: MeanSpeed | None = None
    signed: bool = True  # False: it cannot tell forwards from backwards
    reach: float = 0.0  # s, the longest delay for which the readings of all rows are there
    sigma: Array = field(default_factory=lambda: np.empty((0, 1)))

    @classmethod
    def build(cls, scene: Scene) -> OdometerSpeed | None:
        s, odometer = scene.settings.vehicle, scene.recording.odometer
        if scene.recording.platform != "vehicle" or odometer is None or not s.odometer:
            return None
        speed = scene.speed or _speed_of(odometer, scene.recording.imu)
        rows, past = moving_rows(scene), shared_past(scene)
        begin, end = scene.intervals.t0[rows], scene.intervals.t1[rows]
        reach = REACH * odometer.delay_sigma
        good = np.all([np.isfinite(speed(begin, end, d)[0]) for d in {-reach, 0.0, reach}], axis=0)
        if not good.all():
            rows, begin, end = rows[good], begin[good], end[good]
            past = Past.of(scene.intervals, rows, scene.frame)
        shared = shared_parameters(scene)
        walk = s.scale_walk / np.sqrt(60.0)
        shared["parameters"].append(
            Parameter(ODOMETER_SCALE, np.zeros(1), np.full(1, odometer.scale_sigma), "1", walk=walk)
        )
        if odometer.delay_sigma > 0:
            shared["parameters"].append(Parameter(ODOMETER_DELAY, np.zeros(1), np.full(1, odometer.delay_sigma), "s"))
        shared["parameters"] = tuple(shared["parameters"])
        sigma = np.hypot(speed.sigma(begin, end), s.odometer_density / np.sqrt(end - begin))
        return cls(
            keyframe=rows + 1,
            past=past,
            begin=begin,
            end=end,
            speed=speed,
            signed=odometer.signed,
            sigma=sigma[:, None],
            reach=reach,
            **s.outliers,
            **shared,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        assert self.speed is not None
        u, J, *_ = self._velocity(states, parameters, rows)
        delay = parameters[ODOMETER_DELAY][:, 0] if ODOMETER_DELAY in parameters else np.zeros(len(states))
        # what is true now is read `delay` later
        read, by_delay = self.speed(
            self.begin[rows], self.end[rows], np.minimum(np.maximum(delay, -self.reach), self.reach)
        )
        scale = 1.0 + parameters[ODOMETER_SCALE][:, 0]
        sign = np.ones(len(states)) if self.signed else np.where(u[:, 1] < 0.0, -1.0, 1.0)
        residual = (sign * u[:, 1] - scale * read)[:, None]
        jacobians = {name: sign[:, None, None] * x[:, 1:2] for name, x in J.items()}
        jacobians[ODOMETER_SCALE] = -read[:, None, None]
        if ODOMETER_DELAY in parameters:
            jacobians[ODOMETER_DELAY] = -(scale * by_delay)[:, None, None]
        return Linearized(residual, jacobians, self.sigma[rows])
