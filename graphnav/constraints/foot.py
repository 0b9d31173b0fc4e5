"""Constraints of a foot: a shoe does not slide on the floor, and moves where it points in the air.

Ren 2021 takes the IMU's velocity as zero in stance and its sideways velocity as zero in swing (eq. 6-9, 16-19). Both
hold only approximately, and the deviation is not noise. A shoe rolls over the floor, from the heel at landing to the
toes at take-off, while the IMU on top of it, 5 to 15 cm above the sole, moves forward: at 0.2 rad/s in the middle of a
stance by 2 cm/s, 1.5 % of the distance walked. The point at rest is where shoe and floor touch. So the rows of `Stance`
are, for the mean over each interval within a stance (see `constraints.vehicle.IntervalMotion`),

    mean of  v_b + omega_nb x (l + c d)  =  0          l: pivot,  d = (d_x, d_y, 0): its travel,  c: -1 ... 1

with the lever arm l from the IMU to the middle of the rolling and its travel d along the sole both estimated. c goes
from -1 at landing to 0 within `half_stance`, and from 0 to 1 over the same time before take-off; in between, in a long
stance or in standing, nothing rolls.

The remaining error is a share of the turn rate (the pivot is not a point, the sole is compliant) plus a small constant:

    sigma^2 = (still^2 + (rolling |omega|)^2) max(1, tau / T)

The second factor accounts for correlation: over a time tau errors are one error, not one per interval of length T. What
the pivot does not explain lasts for a stance, so tau is the length of one: its rows together weigh as one.

A foot deforms under load in every step: arch and sole sink by some millimetres after landing, and recover once the heel
has risen. That error repeats in every stance; treated as noise it would average out over a walk, which it does not. So
a repeating velocity, `pattern`, is estimated as well, in body axes and linear in c between five nodes from -1 to 1, for
tau after landing and before take-off.

In swing the foot hardly moves sideways. The rows of `FootLateral` are, for the mean over each interval,

    u_x + a u_y + b u_z  =  0                          a, b: the foot's own sideways axis in the body's, estimated

with a density such that a whole swing counts as one row of `sideways`, wider the more the foot turns in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint, Linearized
from graphnav.constraints.standstill import find_standing
from graphnav.constraints.vehicle import IntervalMotion
from graphnav.core import rotation
from graphnav.core.rotation import Array, mv
from graphnav.core.state import Parameter, States
from graphnav.imu.dynamics import make_scale_parameter
from graphnav.recording import Recording

PIVOT = "pivot"
TRAVEL = "pivot_travel"
PATTERN = "stance_pattern"
FOOT_AXIS = "foot_axis"
_PATTERN_NODES = np.linspace(-1.0, 1.0, 5)  # nodes of the pattern, in c
_WIDE = 3 * len(_PATTERN_NODES)
_SHORTEST_MEAN = 0.01  # s; the mean over a shorter interval carries no information


@dataclass(frozen=True)
class Stance(Constraint):
    """The shoe does not slide where it touches the floor."""

    name: ClassVar[str] = "stance"
    turns: ClassVar[bool] = True
    of_stops: ClassVar[bool] = True
    axes: ClassVar[tuple[str, ...]] = ("right", "forward", "up")
    unit: ClassVar[str] = "m/s"
    # the velocity in body axes turns with the attitude, and at a landing a filter predicts a decimetre per second that
    # the foot does not have: linearised there, its updates would seem to observe the heading
    iterated: ClassVar[bool] = True

    past: IntervalMotion | None = None
    phase: Array = field(default_factory=lambda: np.empty(0))  # (N,) c
    share: Array = field(
        default_factory=lambda: np.empty((0, len(_PATTERN_NODES)))
    )  # weight of each node of the pattern
    sigma: Array = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        """Both ends of every stance, and keyframes between them at `foot.rate`, in stance and in swing."""
        if recording.platform != "foot" or not len(stationary):
            return np.empty(0)
        edges = np.unique(np.concatenate([[recording.start], stationary.ravel(), [recording.end]]))
        parts = np.maximum(1, np.rint(np.diff(edges) * settings.foot.rate).astype(int))
        step = np.repeat(np.diff(edges) / parts, parts)
        within = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
        return np.asarray((np.repeat(edges[:-1], parts) + within * step)[1:])

    @classmethod
    def build(cls, scene: BuildContext) -> Stance | None:
        s, iv = scene.settings.foot, scene.intervals
        rows, stop = find_standing(scene)
        if scene.recording.platform != "foot" or not len(rows) or not s.stance:
            return None
        span, t = scene.stationary[stop], 0.5 * (iv.t0 + iv.t1)[rows]
        half = np.minimum(0.5 * (span[:, 1] - span[:, 0]), s.half_stance)
        landed, leaves = np.minimum(t - span[:, 0], half) / half, np.minimum(span[:, 1] - t, half) / half
        past = IntervalMotion.of(iv, rows, scene.frame)
        turning = np.linalg.norm(past.rate - np.median(past.rate, axis=0), axis=1)
        sigma = np.hypot(s.still, s.rolling * turning) * np.sqrt(np.maximum(1.0, s.correlation / iv.T[rows]))
        return cls(
            keyframe=rows + 1,
            past=past,
            phase=landed - leaves,
            share=_interpolate_phase(landed - leaves) * _mark_rolling(t, span, scene, s.correlation)[:, None],
            sigma=np.repeat(sigma[:, None], 3, axis=1),
            parameters=(
                *make_scale_parameter(scene.recording.imu.noise, scene.recording.platform),
                Parameter.centred(PIVOT, 3, s.pivot_sigma, "m"),
                Parameter.centred(TRAVEL, 2, s.travel_sigma, "m"),
                *((Parameter.centred(PATTERN, _WIDE, s.pattern, "m/s"),) if s.pattern else ()),
            ),
            **s.outliers,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        assert self.past is not None
        phase = self.phase[rows][:, None]
        lever = parameters[PIVOT].copy()
        lever[:, :2] += phase * parameters[TRAVEL]
        found, omega, J = self.past.compute_velocity(states, parameters, rows, lever)
        by_lever = rotation.skew(omega)
        u = found[:, :3]
        J = {name: x[:, :3] for name, x in J.items()} | {PIVOT: by_lever, TRAVEL: phase[..., None] * by_lever[..., :2]}
        if PATTERN in parameters:
            share = self.share[rows]
            u = u + np.einsum("nk,nki->ni", share, parameters[PATTERN].reshape(-1, len(_PATTERN_NODES), 3))
            J[PATTERN] = np.kron(share[:, None], np.eye(3))
        return Linearized(u, J, self.sigma[rows])


def _interpolate_phase(phase: Array) -> Array:
    """(N, 5) weights of the nodes for linear interpolation at phases (N,)."""
    return np.maximum(0.0, 1.0 - np.abs(phase[:, None] - _PATTERN_NODES) / (_PATTERN_NODES[1] - _PATTERN_NODES[0]))


def _mark_rolling(t: Array, span: Array, scene: BuildContext, lasts: float) -> Array:
    """(N,) 1 at times t (N,) within `lasts` s after landing and before take-off of their stances (N, 2), else 0.

    The beginning of a recording is no landing, and its end no take-off.
    """
    landed = (t - span[:, 0] < lasts) & (span[:, 0] > scene.recording.start + SAME_TIME)
    leaves = (span[:, 1] - t < lasts) & (span[:, 1] < scene.recording.end - SAME_TIME)
    return np.asarray((landed | leaves).astype(float))


@dataclass(frozen=True)
class FootLateral(Constraint):
    """The foot has no sideways velocity in swing."""

    name: ClassVar[str] = "foot_lateral"
    turns: ClassVar[bool] = True
    axes: ClassVar[tuple[str, ...]] = ("sideways",)
    unit: ClassVar[str] = "m/s"

    past: IntervalMotion | None = None
    sigma: Array = field(default_factory=lambda: np.empty((0, 1)))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)  # the keyframes of the stances suffice

    @classmethod
    def build(cls, scene: BuildContext) -> FootLateral | None:
        s, iv = scene.settings.foot, scene.intervals
        if scene.recording.platform != "foot" or not len(scene.stationary) or not s.lateral:
            return None
        moving = iv.T > _SHORTEST_MEAN
        moving[find_standing(scene)[0]] = False
        rows = np.flatnonzero(moving)
        past = IntervalMotion.of(iv, rows, scene.frame)
        # a swing lies between two stances; its heading change is the integral of the turn rate about the vertical, the
        # direction of the mean force of a swing
        swing = np.searchsorted(scene.stationary[:, 0], iv.t0[rows])
        lasts = np.bincount(swing, weights=iv.T[rows])[swing]
        turned = np.abs(_compute_swing_turn(past, iv.T[rows], swing))[swing]
        sigma = s.sideways * (1.0 + turned / np.radians(s.turn)) * np.sqrt(np.maximum(1.0, lasts / iv.T[rows]))
        return cls(
            keyframe=rows + 1,
            past=past,
            sigma=sigma[:, None],
            parameters=(
                *make_scale_parameter(scene.recording.imu.noise, scene.recording.platform),
                Parameter.centred(FOOT_AXIS, 2, np.radians(s.axis_sigma), "rad"),
            ),
            **s.outliers,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        assert self.past is not None
        found, _, J = self.past.compute_velocity(states, parameters, rows, np.zeros((len(states), 3)))
        u = found[:, :3]
        axis = np.concatenate([np.ones((len(states), 1)), parameters[FOOT_AXIS]], axis=1)[:, None]
        J = {name: axis @ x[:, :3] for name, x in J.items()} | {FOOT_AXIS: u[:, None, 1:]}
        return Linearized(mv(axis, u), J, self.sigma[rows])


def _compute_swing_turn(past: IntervalMotion, T: Array, swing: Array) -> Array:
    """Angle (M,) by which the foot's heading changes in each swing, rad, from the rates of its intervals (N,)."""
    count = int(swing.max()) + 1 if len(swing) else 0
    total = np.zeros((count, 2, 3))
    np.add.at(total, swing, np.stack([past.rate, past.force], 1) * T[:, None, None])
    up = total[:, 1] / np.maximum(np.linalg.norm(total[:, 1], axis=1, keepdims=True), 1e-12)
    return np.asarray(np.einsum("mi,mi->m", total[:, 0], up))
