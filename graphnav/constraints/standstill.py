"""Constraints of a stationary platform: zero velocity, zero turn rate, and the place where it stopped.

Skog et al. 2010 (zero velocity), Li 2024 (the same, detected by the idling engine). While the wheels do not turn::

    zero velocity:   R_nb^T v
    zero rate:       omega_b - b_g - R_nb^T omega_n        mean over the interval that ends at the keyframe
    held position:   p - a                                 a: one unknown place for each stop

The velocity is taken in body axes, where it does not depend on an unknown heading. In n, a filter that stops with a
residual velocity error would take its update for an observation of the heading. A displacement since the beginning of
the stop would have the same effect, so the place is held from the end of the first interval on, when the velocity is
known.

For a foot, `graphnav.constraints.foot` replaces the first and the last; zero rate is used where the foot stands still.

A body on springs is not perfectly still: passengers move it, the engine shakes it. The recording shows how much: the
sigmas follow from the scatter of the one-interval means of force and rate around their median over a few intervals, in
addition to sensor noise. A body that sways at 1 Hz or more and whose force scatters by s moves by at most s / (2 pi) in
velocity and s / (2 pi)^2 in position.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint, Linearized
from graphnav.core import rotation
from graphnav.core.interpolation import pick_nearest
from graphnav.core.rotation import Array, mv
from graphnav.core.running import run_maximum
from graphnav.core.state import Parameter, States
from graphnav.recording import Recording

PLACE = "stop_position"
_NEIGHBOURS = 5  # intervals over which residual motion is measured
_SWAY_RATE = 2.0 * np.pi  # rad/s, the slowest sway of a body on springs
_STILL_V, _STILL_P = 1e-3, 1e-3  # m/s, m: lower limits for any body
_FASTEST_VEHICLE = 60.0  # m/s; times the seconds without a fix: bound on the distance of a stop from the last one
_ROLLING_RATE = 0.1  # rad/s; a foot that rolls over its stance turns faster
_LIFTING = 0.15  # s at either end of standing, in which the heel may have begun to lift
_STANDING_SPAN = 0.6  # s; no stance of a walk is that quiet for so long
_I3 = np.eye(3)


def find_standing(scene: BuildContext) -> tuple[Array, Array]:
    """Indices of the intervals inside stationary spans, and of the span of each."""
    iv, spans = scene.intervals, scene.stationary
    if not len(spans):
        return np.empty(0, dtype=int), np.empty(0, dtype=int)
    stop = np.searchsorted(spans[:, 0], iv.t0 + SAME_TIME, side="right") - 1
    inside = (stop >= 0) & (iv.t1 <= spans[np.maximum(stop, 0), 1] + SAME_TIME)
    rows = np.flatnonzero(inside)
    return rows, stop[rows]


def _find_standing(scene: BuildContext, rows: Array, stop: Array) -> tuple[Array, Array]:
    """The intervals in which a foot stands rather than rolls over its stance, and the stop of each.

    Together they last longer than any stance of a walk is that quiet, at less than the rate of the slowest rolling.
    """
    iv = scene.intervals
    rate = iv.rate[rows]
    typical = np.empty((len(rows), 3))
    for one in np.unique(stop):
        typical[stop == one] = np.median(rate[stop == one], axis=0)
    still = np.linalg.norm(rate - typical, axis=1) < _ROLLING_RATE
    run = np.cumsum(np.r_[True, (np.diff(stop) != 0) | (np.diff(still) != 0)][: len(rows)]) - 1
    lasts = np.bincount(run, weights=iv.T[rows])
    keep = still & (lasts[run] >= _STANDING_SPAN)
    begins, ends = np.full(len(lasts), np.inf), np.full(len(lasts), -np.inf)
    np.minimum.at(begins, run, iv.t0[rows])
    np.maximum.at(ends, run, iv.t1[rows])
    keep &= (iv.t0[rows] >= begins[run] + _LIFTING) | (begins[run] <= scene.t[0] + SAME_TIME)
    keep &= (iv.t1[rows] <= ends[run] - _LIFTING) | (ends[run] >= scene.t[-1] - SAME_TIME)
    return rows[keep], run[keep]


def _estimate_swaying(rate: Array, T: Array, run: Array) -> Array:
    """1-sigma (N, 3), rad/s, of the mean rates (N, 3) of intervals in which a foot stands, from the wander of its
    angle.

    A standing body sways slowly: it is not still where its rate crosses zero, and rates of successive intervals are
    correlated. So they are modelled as white with the density q by which the angle over a run of intervals departs from
    a straight line. For a random walk of length T that departure has the variance q T / 15 (regression of a Wiener
    process on time); a body that sways about an equilibrium departs no less for its q.
    """
    out = np.zeros_like(rate)
    for one in np.unique(run):
        here = run == one
        edge = np.concatenate([[0.0], np.cumsum(T[here])])
        angle = np.concatenate([np.zeros((1, 3)), np.cumsum(rate[here] * T[here, None], axis=0)])
        line = np.column_stack([np.ones(len(edge)), edge])
        departs = angle - line @ np.linalg.lstsq(line, angle, rcond=None)[0]
        q = 15.0 * np.mean(departs**2, axis=0) / edge[-1]
        out[here] = np.sqrt(q / T[here, None])
    return out


def measure_unrest(scene: BuildContext, rows: Array, stop: Array) -> tuple[Array, Array]:
    """Scatter (N, 3) of force (m/s^2) and rate (rad/s) around each interval, without sensor noise."""
    iv, noise = scene.intervals, scene.recording.imu.noise
    T = iv.T[rows][:, None]
    out = []
    for means, density in ((iv.force, noise.accel_noise_density), (iv.rate, noise.gyro_noise_density)):
        off = np.zeros((len(rows), 3))
        for one in np.unique(stop):
            here = stop == one
            x = means[rows[here]]
            change = np.abs(x - np.median(x, axis=0))
            off[here] = run_maximum(change, min(_NEIGHBOURS, len(x)))
        out.append(np.sqrt(np.maximum(off**2 - density**2 / T, 0.0)))
    return out[0], out[1]


class _Standing(Constraint):
    """Rows at the ends of the intervals in which the platform is stationary."""

    looks_ahead: ClassVar[bool] = False
    of_stops: ClassVar[bool] = True
    # estimated like all others: as bounds they would be wider than the truth, and the IMU's figures pay for that
    noise_axes: ClassVar[tuple[str, ...]] = ("still",) * 3

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return stationary.ravel()


@dataclass(frozen=True)
class ZeroVelocity(_Standing):
    """The platform does not move (zero-velocity update, ZUPT)."""

    name: ClassVar[str] = "zero_velocity"
    turns: ClassVar[bool] = True
    axes: ClassVar[tuple[str, ...]] = ("right", "forward", "up")
    unit: ClassVar[str] = "m/s"

    sigma: Array = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def build(cls, scene: BuildContext) -> ZeroVelocity | None:
        rows, stop = find_standing(scene)
        if not len(rows) or not scene.settings.standstill.zero_velocity or scene.recording.platform == "foot":
            return None
        force, _ = measure_unrest(scene, rows, stop)
        # how a body sways cannot be observed per axis: the largest is used for all
        sigma = np.hypot(_STILL_V, force.max(axis=1, keepdims=True) / _SWAY_RATE)
        return cls(keyframe=rows + 1, sigma=np.broadcast_to(sigma, (len(rows), 3)))

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        R_bn = np.swapaxes(states.R_nb, -1, -2)
        v_b = mv(R_bn, states.v)
        return Linearized(v_b, {"theta": rotation.skew(v_b), "v": R_bn}, self.sigma[rows])


@dataclass(frozen=True)
class ZeroRate(_Standing):
    """The platform does not turn: the gyro reads its bias and the Earth's rate (ZARU)."""

    name: ClassVar[str] = "zero_rate"
    turns: ClassVar[bool] = True
    axes: ClassVar[tuple[str, ...]] = ("right", "forward", "up")
    unit: ClassVar[str] = "rad/s"

    rate: Array = field(default_factory=lambda: np.empty((0, 3)))  # measured mean
    omega_n: Array = field(default_factory=lambda: np.zeros(3))  # Earth rate
    sigma: Array = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def build(cls, scene: BuildContext) -> ZeroRate | None:
        rows, stop = find_standing(scene)
        if scene.recording.platform == "foot":
            rows, stop = _find_standing(scene, rows, stop)
        if not len(rows) or not scene.settings.standstill.zero_rate:
            return None
        _, rate = measure_unrest(scene, rows, stop)
        own = scene.recording.imu.noise.gyro_noise_density / np.sqrt(scene.intervals.T[rows])
        if scene.recording.platform == "foot":
            rate = np.hypot(rate, _estimate_swaying(scene.intervals.rate[rows], scene.intervals.T[rows], stop))
        return cls(
            keyframe=rows + 1,
            rate=scene.intervals.rate[rows] + scene.intervals.bg[rows],
            omega_n=scene.frame.omega_n,
            sigma=np.hypot(own[:, None], rate),
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        earth = mv(np.swapaxes(states.R_nb, -1, -2), self.omega_n)
        residual = states.bg + earth - self.rate[rows]
        J = {"theta": rotation.skew(earth), "bg": np.broadcast_to(_I3, (len(states), 3, 3))}
        return Linearized(residual, J, self.sigma[rows])


@dataclass(frozen=True)
class HeldPosition(_Standing):
    """The platform stays where it stopped."""

    name: ClassVar[str] = "held_position"
    axes: ClassVar[tuple[str, ...]] = ("east", "north", "up")
    unit: ClassVar[str] = "m"

    sigma: Array = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def build(cls, scene: BuildContext) -> HeldPosition | None:
        rows, stop = find_standing(scene)
        if not len(rows) or not scene.settings.standstill.held_position or scene.recording.platform == "foot":
            return None
        force, _ = measure_unrest(scene, rows, stop)
        sigma = np.hypot(_STILL_P, force.max(axis=1, keepdims=True) / _SWAY_RATE**2)
        return cls(
            keyframe=rows + 1,
            sigma=np.repeat(sigma, 3, axis=1),
            parameters=(_guess_places(scene, np.unique(stop)),),
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        one = np.broadcast_to(_I3, (len(states), 3, 3))
        return Linearized(states.p - parameters[PLACE], {"p": one, PLACE: -one}, self.sigma[rows])


def _guess_places(scene: BuildContext, stops: Array) -> Parameter:
    """One unknown place per stop: initially that of the fixes around it, with the range of a vehicle since then as
    sigma.
    """
    begins = scene.stationary[stops, 0]
    gnss = scene.recording.gnss
    if gnss is None or len(gnss.t) < 2:
        away, place = begins - scene.t[0], np.zeros((len(begins), 3))
    else:
        p = scene.frame.from_llh(gnss.llh)
        place = np.stack([np.interp(begins, gnss.t, axis) for axis in p.T], -1)
        away = np.abs(gnss.t[pick_nearest(gnss.t, begins)] - begins)
    sigma = np.repeat((100.0 + _FASTEST_VEHICLE * away)[:, None], 3, axis=1)
    return Parameter(PLACE, place, sigma, "m", begins=begins)
