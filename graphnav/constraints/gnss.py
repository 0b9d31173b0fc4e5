"""GNSS position and velocity of an antenna at a lever arm from the IMU.

Groves (2013), eq. 14.103 and 14.104, without its small-angle approximations. Residuals are in the local
ENU at the fix, where receivers state their sigmas::

    r_p = R_ln (p + R_nb l - p_meas)
    r_v = R_ln (v + R_nb (omega_nb x l)) - v_meas,     omega_nb = omega_b - b_g - R_nb^T omega_ie
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from graphnav import earth, rotation
from graphnav.config import Settings
from graphnav.constraints.base import Constraint, Linearized, Scene
from graphnav.recording import Imu, Recording
from graphnav.rotation import Array, mv
from graphnav.state import Parameter, States

LEVER_ARM = "gnss_lever_arm"
_RATE_WINDOW = 0.05  # s each side over which the turn rate at a fix is averaged


def _empty(*shape: int) -> Array:
    return np.empty(shape)


def _usable(recording: Recording) -> Array:
    """Mask of the fixes the IMU covers."""
    assert recording.gnss is not None
    t = recording.gnss.t
    return (t >= recording.start) & (t <= recording.end)


def _lever_arm(scene: Scene) -> tuple[Parameter, ...]:
    sigma, gnss = scene.settings.gnss.lever_arm_sigma, scene.recording.gnss
    if sigma is None or gnss is None:
        return ()
    return (Parameter(LEVER_ARM, gnss.lever_arm, np.full(3, sigma), "m"),)


def _common(scene: Scene) -> dict[str, object]:
    s = scene.settings.gnss
    return {
        "parameters": _lever_arm(scene),
        "robust": s.robust,
        "robust_scale": s.robust_scale,
        "gate": s.gate,
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

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings) -> Array:
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
        llh = gnss.llh[used]
        return cls(
            keyframe=keyframe[used],
            p_n=scene.frame.from_llh(llh),
            R_ln=earth.enu_axes(llh) @ scene.frame.R_ne.T,
            sigma=gnss.sd[used],
            lever_arm=gnss.lever_arm,
            **_common(scene),
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        C = self.R_ln[rows]
        CR = C @ states.R_nb
        lever = parameters.get(LEVER_ARM, np.broadcast_to(self.lever_arm, states.p.shape))
        residual = mv(C, states.p - self.p_n[rows]) + mv(CR, lever)
        jacobians = {"theta": -CR @ rotation.skew(lever), "p": C}
        if LEVER_ARM in parameters:
            jacobians[LEVER_ARM] = CR
        return Linearized(residual, jacobians, self.sigma[rows])


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
    omega_n: Array = field(default_factory=lambda: np.zeros(3))  # Earth rate
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings) -> Array:
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
            gyro=mean_rate(scene.recording.imu, gnss.t[used]),
            omega_n=scene.frame.omega_n,
            lever_arm=gnss.lever_arm,
            **_common(scene),
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        C, R = self.R_ln[rows], states.R_nb
        CR = C @ R
        lever = parameters.get(LEVER_ARM, np.broadcast_to(self.lever_arm, states.p.shape))
        omega_ie_b = self.omega_n @ R
        omega = self.gyro[rows] - states.bg - omega_ie_b
        L = rotation.skew(lever)
        swing = -mv(L, omega)  # omega x lever
        residual = mv(C, states.v) + mv(CR, swing) - self.v_l[rows]
        jacobians = {
            "theta": CR @ (L @ rotation.skew(omega_ie_b) - rotation.skew(swing)),
            "v": C,
            "bg": CR @ L,
        }
        if LEVER_ARM in parameters:
            jacobians[LEVER_ARM] = CR @ rotation.skew(omega)
        return Linearized(residual, jacobians, self.sigma[rows])


def mean_rate(imu: Imu, t: Array) -> Array:
    """(N, 3) mean measured rate around times t: one sample's vibration would be noise times lever arm."""
    lo = np.searchsorted(imu.t, t - _RATE_WINDOW)
    hi = np.maximum(np.searchsorted(imu.t, t + _RATE_WINDOW), lo + 1)
    lo, hi = np.minimum(lo, len(imu.t) - 1), np.minimum(hi, len(imu.t))
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.gyro, axis=0)])
    return (total[hi] - total[lo]) / (hi - lo)[:, None]
