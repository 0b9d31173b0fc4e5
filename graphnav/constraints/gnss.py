"""GNSS position and velocity of an antenna at a lever arm from the IMU.

Groves (2013), eq. 14.103 and 14.104, without its small-angle approximations. Residuals are in the local
ENU at the fix, where receivers state their sigmas::

    r_p = R_ln (p + R_nb l + u d - p_meas) + e       u = v + R_nb (omega_nb x l)
    r_v = R_ln (u + a d) - v_meas                    a = R_nb (f_b - b_a) + g
    omega_nb = omega_b - b_g - R_nb^T omega_ie

d is what must be added to the stamps of the fixes, one constant for positions and one for velocities: a
receiver's filters delay them differently (boulder's differ by 0.1 s, dresden's by 0.7 s).

e is the slow part of a position's error: fixes of one receiver seconds apart are wrong alike, and a thousand of
them are not worth a thousand. It is the sum of two Gauss-Markov processes in units of the stated sigma, one that
changes over minutes (multipath, satellites coming and going) and one over hours (orbits, atmosphere, the base's
coordinates). Together they have the share `slow_share` of the variance, half each, since nothing in a drive tells
them apart; the rest is white.

Or it is not: reflections from houses last for seconds, and are often far larger than any sigma says. Where the data
show that (`fast_time`), n fixes in a row have an error in common. Over times longer than that such noise is worth
white noise of n times the variance, n = coth(dt / 2 T) for a Gauss-Markov process of correlation time T sampled every
dt: the ratio of their spectra at zero frequency. A kernel then weighs the fix by what its own sigma says, and n fixes
as one,

    cost = rho_k(s) / n,    which is rho of s / sqrt(n) with the scale k / sqrt(n).

Where fixes are of several types and the data tell them apart, all this is of each type: sigmas, shares, how long errors
last, and slow processes, for what fixed and single-point fixes are wrong by has nothing to do with each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from scipy.ndimage import median_filter

from graphnav import earth, rotation
from graphnav.config import Settings
from graphnav.config.gnss import GnssSettings, of_type
from graphnav.constraints.base import SAME_TIME, Constraint, Linearized, Scene
from graphnav.recording import FIX_TYPES, Gnss, Imu, Recording
from graphnav.rotation import Array, mv
from graphnav.state import NODE_SPACING, Parameter, States

LEVER_ARM = "gnss_lever_arm"
TIME_OFFSET = "gnss_time_offset"
SLOW_ERRORS = ("gnss_error_of_minutes", "gnss_error_of_hours")
_NO_KERNEL = 1e6  # a scale beyond which no fix is
VELOCITY_TIME_OFFSET = "gnss_velocity_time_offset"
_I3 = np.eye(3)
_MINUTE = 60.0  # s
_WINDOW = 0.05  # s each side over which turn rate and force at a fix are averaged


def _empty(*shape: int) -> Array:
    return np.empty(shape)


def _usable(recording: Recording) -> Array:
    """Mask of the fixes the IMU covers."""
    assert recording.gnss is not None
    t = recording.gnss.t
    return (t >= recording.start - SAME_TIME) & (t <= recording.end + SAME_TIME)


def _common(scene: Scene, offset: str) -> dict[str, Any]:
    """Parameters and what the solvers want to know, from the settings."""
    settings, gnss = scene.settings.gnss, scene.recording.gnss
    assert gnss is not None
    parameters: list[Parameter] = []
    if settings.lever_arm_sigma is not None:
        parameters.append(Parameter(LEVER_ARM, gnss.lever_arm, np.full(3, settings.lever_arm_sigma), "m"))
    if settings.time_offset_sigma > 0:
        parameters.append(Parameter(offset, np.zeros(1), np.full(1, settings.time_offset_sigma), "s"))
    said = settings.outliers
    if isinstance(said["robust_scale"], Mapping):  # of positions, by type
        said["robust_scale"] = GnssSettings().robust_scale
    return {
        "parameters": tuple(parameters),
        "watched": settings.faults != "off",
        "adaptive": settings.adaptive,
        **said,
    }


@dataclass(frozen=True)
class GnssPosition(Constraint):
    """The antenna was at a fix."""

    name: ClassVar[str] = "gnss_position"
    axes: ClassVar[tuple[str, ...]] = ("east", "north", "up")
    unit: ClassVar[str] = "m"

    p_n: Array = field(default_factory=lambda: _empty(0, 3))  # fixes in the navigation frame
    R_ln: Array = field(default_factory=lambda: _empty(0, 3, 3))
    sigma: Array = field(default_factory=lambda: _empty(0, 3))
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))
    gyro: Array = field(default_factory=lambda: _empty(0, 3))  # measured rate at the fix
    omega_n: Array = field(default_factory=lambda: np.zeros(3))  # Earth rate
    stated: Array = field(default_factory=lambda: _empty(0, 3))  # sigma of the whole error
    usual: Array = field(default_factory=lambda: _empty(0, 3))  # the same, smoothed: the unit of slow errors
    type: Array | None = None  # (N,) of graphnav.recording.FIX_TYPES

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        if recording.gnss is None or not settings.gnss.position:
            return _empty(0)
        return recording.gnss.t[_usable(recording)]

    @classmethod
    def build(cls, scene: Scene) -> GnssPosition | None:
        gnss = scene.recording.gnss
        if gnss is None or not scene.settings.gnss.position:
            return None
        keyframe = scene.keyframe_at(gnss.t)
        used = keyframe >= 0
        if not used.any():
            return None
        llh = gnss.llh[used]
        s = scene.settings.gnss
        common = _common(scene, TIME_OFFSET)
        rows: dict[str, Any] = {}
        processes: list[Parameter] = []
        spacings: list[float] = []
        kinds = _groups(s, gnss)
        for kind, own in kinds:
            name = FIX_TYPES[kind or 0]
            factor, share = of_type(s.sd_factor, name, 1.0), of_type(s.slow_share, name, 0.0)
            every = np.array([factor, factor, of_type(s.up_factor, name, factor)]) * gnss.sd[own]
            alike = as_one(of_type(s.fast_time, name, 0.0), gnss.t[own])
            scale = of_type(s.robust_scale, name, _NO_KERNEL) / np.sqrt(alike)
            parts = {
                "sigma": np.sqrt((1.0 - share) * alike) * every,
                "stated": every,
                "usual": _usual(gnss.t[own], every) if scene.usual is None else scene.usual,
                "scale": np.full(len(every), scale),
            }
            for key, part in parts.items():
                rows.setdefault(key, np.empty((len(gnss.t), *part.shape[1:])))[own] = part
            if alike > 1.0:
                common["robust_scale"] = scale
                if s.robust == "automatic":
                    common["robust"] = "cauchy"
            if share > 0:
                sigma = np.full(3, np.sqrt(0.5 * share))
                spacings.append(node_spacing(share, s.slow_times, (1.0 - share) * alike, period(gnss.t[own])))
                for slow, time in zip(SLOW_ERRORS, s.slow_times, strict=True):
                    slow = slow if kind is None else f"{slow}_{name}"
                    processes.append(Parameter(slow, np.zeros(3), sigma, "sd", correlation_time=time))
        # nodes at the same times for all: a batch solution has them in one variable
        common["parameters"] += tuple(replace(one, spacing=min(spacings)) for one in processes)
        if len(kinds) > 1 and common["robust"] not in ("none", "gnc"):
            common["robust_scale"] = rows["scale"][used]
        return cls(
            keyframe=keyframe[used],
            p_n=scene.frame.from_llh(llh),
            R_ln=earth.enu_axes(llh) @ scene.frame.R_ne.T,
            sigma=rows["sigma"][used],
            stated=rows["stated"][used],
            usual=rows["usual"][used],
            type=None if gnss.type is None else gnss.type[used],
            lever_arm=gnss.lever_arm,
            gyro=around(scene.recording.imu, scene.recording.imu.gyro, gnss.t[used]),
            omega_n=scene.frame.omega_n,
            **common,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        C, R = self.R_ln[rows], states.R_nb
        lever = parameters.get(LEVER_ARM, self.lever_arm)
        away = states.p - self.p_n[rows] + mv(R, lever)
        J = {"theta": -R @ rotation.skew(lever), "p": _I3[None]}
        if LEVER_ARM in parameters:
            J[LEVER_ARM] = R
        if TIME_OFFSET in parameters:
            offset = parameters[TIME_OFFSET]
            velocity, moved = _antenna_velocity(states, self.gyro[rows], self.omega_n, lever)
            away = away + velocity * offset
            for block in ("theta", "v", "bg", LEVER_ARM):
                if block != LEVER_ARM or LEVER_ARM in parameters:
                    J[block] = J.get(block, 0.0) + moved[block] * offset[..., None]
            J[TIME_OFFSET] = velocity[..., None]
        residual, jacobians = mv(C, away), {block: C @ x for block, x in J.items()}
        for name in parameters:
            if name.startswith(SLOW_ERRORS):
                size = self.usual[rows] * self._of(name, rows)
                residual = residual + size * parameters[name]
                jacobians[name] = size[..., None] * _I3
        return Linearized(residual, jacobians, self.sigma[rows])

    def _of(self, name: str, rows: slice | Array) -> float | Array:
        """Whose a slow process is: 1 where it is the error of a fix, 0 where the fix is of another type."""
        if self.type is None or name in SLOW_ERRORS:
            return 1.0
        kind = next(k for k, kind in FIX_TYPES.items() if name.endswith(kind))
        return np.asarray(self.type[rows] == kind, dtype=float)[..., None]


@dataclass(frozen=True)
class GnssVelocity(Constraint):
    """The antenna moved with a velocity."""

    name: ClassVar[str] = "gnss_velocity"
    axes: ClassVar[tuple[str, ...]] = ("east", "north", "up")
    unit: ClassVar[str] = "m/s"

    v_l: Array = field(default_factory=lambda: _empty(0, 3))
    R_ln: Array = field(default_factory=lambda: _empty(0, 3, 3))
    sigma: Array = field(default_factory=lambda: _empty(0, 3))
    gyro: Array = field(default_factory=lambda: _empty(0, 3))  # measured rate at the fix
    accel: Array = field(default_factory=lambda: _empty(0, 3))  # measured force at the fix
    g_n: Array = field(default_factory=lambda: _empty(0, 3))  # gravity there
    omega_n: Array = field(default_factory=lambda: np.zeros(3))  # Earth rate
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        gnss = recording.gnss
        if gnss is None or gnss.v is None or not settings.gnss.velocity:
            return _empty(0)
        return gnss.t[_usable(recording) & np.isfinite(gnss.v).all(axis=1)]

    @classmethod
    def build(cls, scene: Scene) -> GnssVelocity | None:
        gnss = scene.recording.gnss
        if gnss is None or gnss.v is None or gnss.sd_v is None or not scene.settings.gnss.velocity:
            return None
        keyframe = scene.keyframe_at(gnss.t)
        used = (keyframe >= 0) & np.isfinite(gnss.v).all(axis=1)
        if not used.any():
            return None
        return cls(
            keyframe=keyframe[used],
            v_l=gnss.v[used],
            R_ln=earth.enu_axes(gnss.llh[used]) @ scene.frame.R_ne.T,
            sigma=gnss.sd_v[used],
            gyro=around(scene.recording.imu, scene.recording.imu.gyro, gnss.t[used]),
            accel=around(scene.recording.imu, scene.recording.imu.accel, gnss.t[used]),
            g_n=scene.frame.gravity_n(scene.frame.from_llh(gnss.llh[used])),
            omega_n=scene.frame.omega_n,
            lever_arm=gnss.lever_arm,
            **_common(scene, VELOCITY_TIME_OFFSET),
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        C = self.R_ln[rows]
        lever = parameters.get(LEVER_ARM, self.lever_arm)
        velocity, moved = _antenna_velocity(states, self.gyro[rows], self.omega_n, lever)
        residual = mv(C, velocity) - self.v_l[rows]
        jacobians = {block: C @ J for block, J in moved.items() if block != LEVER_ARM or LEVER_ARM in parameters}
        if VELOCITY_TIME_OFFSET in parameters:
            offset = parameters[VELOCITY_TIME_OFFSET]
            CR, force = C @ states.R_nb, self.accel[rows] - states.ba
            change = mv(CR, force) + mv(C, self.g_n[rows])
            residual = residual + change * offset
            jacobians["theta"] = jacobians["theta"] - CR @ rotation.skew(force) * offset[..., None]
            jacobians |= {"ba": -CR * offset[..., None], VELOCITY_TIME_OFFSET: change[..., None]}
        return Linearized(residual, jacobians, self.sigma[rows])


def _groups(settings: GnssSettings, gnss: Gnss) -> list[tuple[int | None, Array | slice]]:
    """Fixes that are treated alike: a type and its rows, or None and all rows where settings know no types."""
    tables = (settings.sd_factor, settings.slow_share, settings.fast_time, settings.up_factor, settings.robust_scale)
    if not any(isinstance(value, Mapping) for value in tables):
        return [(None, slice(None))]
    kinds = np.zeros(len(gnss.t), dtype=int) if gnss.type is None else gnss.type
    return [(int(kind), kinds == kind) for kind in np.unique(kinds)]


def period(t: Array) -> float:
    """Usual time between fixes, s."""
    return max(float(np.median(np.diff(t))), 1e-3) if len(t) > 1 else 1.0


def as_one(correlation_time: float, t: Array) -> float:
    """How many fixes at times t are worth one, of errors with that correlation time (s)."""
    return 1.0 / float(np.tanh(0.5 * period(t) / correlation_time)) if correlation_time > 0.0 else 1.0


def node_spacing(share: float, times: tuple[float, ...], white: float, dt: float) -> float:
    """How far apart (s) nodes of slow errors may be, whose value stays from one to the next.

    Errors of the variance share/2 each and of these correlation times wander with the density q = sum share / times.
    Over a spacing D that is a variance of q D/6 about the mean, where the fixes in it, every dt seconds with a white
    variance, tell that mean to white dt/D. With D = sqrt(white dt / q) / 2 the one is a 24th of the other.
    """
    q = share * float(np.sum(1.0 / np.asarray(times)))
    return min(NODE_SPACING, 0.5 * float(np.sqrt(white * dt / q)))


def _usual(t: Array, sigma: Array) -> Array:
    """Running median of sigmas over a minute.

    A slow error times a sigma that jumps from fix to fix would jump with it, and so give itself away.
    """
    size = 2 * int(np.clip(_MINUTE / period(t) / 2, 0, (len(t) - 1) // 2)) + 1
    return median_filter(sigma, size=(size, 1), mode="nearest")


def _antenna_velocity(states: States, gyro: Array, omega_n: Array, lever: Array) -> tuple[Array, dict[str, Array]]:
    """v + R_nb (omega_nb x l) in n, (N, 3), and its derivatives by theta, v, bg and the lever arm."""
    R = states.R_nb
    omega_ie_b = omega_n @ R
    omega = gyro - states.bg - omega_ie_b
    RL = R @ rotation.skew(lever)
    swing = -mv(RL, omega)  # omega x lever, in n
    return states.v + swing, {
        "theta": RL @ rotation.skew(omega_ie_b) - rotation.skew(swing) @ R,
        "v": _I3[None],
        "bg": RL,
        LEVER_ARM: R @ rotation.skew(omega),
    }


def around(imu: Imu, x: Array, t: Array) -> Array:
    """(N, 3) mean of an IMU signal around times t: one sample's vibration would be noise times lever arm."""
    lo = np.searchsorted(imu.t, t - _WINDOW)
    hi = np.maximum(np.searchsorted(imu.t, t + _WINDOW), lo + 1)
    lo, hi = np.minimum(lo, len(imu.t) - 1), np.minimum(hi, len(imu.t))
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(x, axis=0)])
    return (total[hi] - total[lo]) / (hi - lo)[:, None]
