"""GNSS position and velocity of an antenna at a lever arm from the IMU.

Groves (2013), eq. 14.103 and 14.104, without its small-angle approximations. Residuals are in the local
ENU at the fix, where receivers state their sigmas::

    r_p = R_ln (p + R_nb l + u d + a(d/3) d^2 / 2 - p_meas) + e       u = v + R_nb (omega_nb x l)
    r_v = R_ln (u + a(d/2) d) - v_meas                                omega_nb = omega_b - b_g - R_nb^T omega_ie

d is added to the stamps of the fixes, and a(h) is the acceleration a time h after the stamp, linear in h
(`graphnav.constraints.antenna_motion`). d is a constant, one for positions and one for velocities, as a receiver's
filters delay them differently (boulder's differ by 0.1 s, dresden's by 0.7 s), and what the clocks of IMU and receiver
drift apart: the rate of one beside the other, by the time since the drive began. Crystals keep it within some 1e-4
(boulder's 3e-4): 0.2 s in half an hour. Where fixes are stamped on arrival, each stamp has an error of its own as
well: white, and common to the position and velocity of a fix.

e is the time-correlated part of a position's error (`graphnav.constraints.lasting`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.antenna_motion import (
    LEVER_ARM,
    average_around,
    compute_acceleration,
    compute_antenna_velocity,
    fit_force_line,
)
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint, Linearized, TypicalSigmas
from graphnav.constraints.lasting import (
    ERRORS,
    MULTIPATH_ERROR,
    compute_running_median,
    find_fix_period,
    find_least_period,
    find_node_spacing,
    list_processes,
    make_multipath,
)
from graphnav.core import earth, rotation
from graphnav.core.rotation import Array, mv
from graphnav.core.state import SECONDS, Parameter, States
from graphnav.gnss.residuals import compute_multipath_sigma
from graphnav.recording import FIX_TYPES, Recording

TIME_OFFSET = "gnss_time_offset"
VELOCITY_TIME_OFFSET = "gnss_velocity_time_offset"
CLOCK_RATE = "gnss_clock_rate"
_UNITS = {LEVER_ARM: "m", TIME_OFFSET: "s", VELOCITY_TIME_OFFSET: "s", CLOCK_RATE: "s/s"}
VELOCITY_ERROR = "gnss_velocity_error"
STAMP_ERROR = "gnss_stamp_error"
STAMPS = "gnss_position.stamps"  # variance component of the stamp errors
# variance components of the offsets' priors
OFFSETS = {f"prior.{name}": name for name in (TIME_OFFSET, VELOCITY_TIME_OFFSET, CLOCK_RATE)}
_I3 = np.eye(3)
_WHITE = 1e-3  # s, a correlation time at which nothing is left from one fix to the next


def count_repeats(values: Array) -> Array:
    """(N, m) how many rows in succession have the same number: these share one rounding error, which is as if each of n
    independent ones had n times the variance.
    """
    new = np.ones(values.shape, dtype=bool)
    new[1:] = values[1:] != values[:-1]
    return np.stack([np.bincount(run)[run] for run in np.cumsum(new, axis=0).T], axis=-1)


def _make_empty(*shape: int) -> Array:
    return np.empty(shape)


def _mask_covered(recording: Recording, t: Array) -> Array:
    """Mask of the times (M,) within the IMU's time span."""
    return np.asarray((t >= recording.start - SAME_TIME) & (t <= recording.end + SAME_TIME))


def _build_common(scene: BuildContext, offset: str) -> dict[str, Any]:
    """The parameters of both constraints and their treatment of outliers, from the settings."""
    settings, gnss = scene.settings.gnss, scene.recording.gnss
    assert gnss is not None
    parameters: list[Parameter] = []
    if settings.lever_arm_sigma is not None:
        parameters.append(Parameter(LEVER_ARM, gnss.lever_arm, np.full(3, settings.lever_arm_sigma), _UNITS[LEVER_ARM]))
    if settings.time_offset_sigma > 0:
        sigma = settings.time_offset_sigma
        parameters.append(Parameter.centred(offset, 1, sigma, "s", noise_groups=(f"prior.{offset}",)))
        if settings.clock_rate_sigma:
            sigma, group = settings.clock_rate_sigma, (f"prior.{CLOCK_RATE}",)
            parameters.append(Parameter.centred(CLOCK_RATE, 1, sigma, "s/s", noise_groups=group))
    return {"parameters": tuple(parameters), "watched": settings.faults != "off", **settings.outliers}


def _build_stamp_error(settings: Settings, t: Array) -> tuple[Parameter, ...]:
    """Error of the stamps of single fixes, in units of the 1-sigma of their common offset."""
    sigma = np.full(1, settings.gnss.time_offset_sigma)
    if not sigma[0] > 0.0:
        return ()
    own, spacing = (STAMPS,), find_least_period(t)
    return (
        Parameter(STAMP_ERROR, np.zeros(1), sigma, "s", correlation_time=_WHITE, spacing=spacing, noise_groups=own),
    )


def _space_nodes(processes: tuple[Parameter, ...], spacing: float) -> tuple[Parameter, ...]:
    """Processes of a part of a drive, with nodes so far apart (s): it may not show how close fixes come. An error of a
    single fix, or in units of each fix, has one at every keyframe.
    """
    each = STAMP_ERROR, MULTIPATH_ERROR
    return tuple(replace(p, spacing=0.0 if p.name in each else spacing) for p in processes)


def _split_time_offset(
    parameters: dict[str, Array], constant: str, elapsed: Array
) -> tuple[Array | None, dict[str, Array | float]]:
    """(n, 1) s to be added to stamps `elapsed` (n,) s after the drive began, and its derivatives by its parts; None
    where no part of it is estimated.
    """
    by: dict[str, Array | float] = {constant: 1.0, CLOCK_RATE: elapsed[:, None], STAMP_ERROR: 1.0}
    by = {name: one for name, one in by.items() if name in parameters}
    return (np.asarray(sum(one * parameters[name] for name, one in by.items())) if by else None), by


@dataclass(frozen=True)
class _Fixes(Constraint):
    """What both constraints have: the motion of the antenna around the stamps, and the stated sigmas."""

    R_ln: Array = field(default_factory=lambda: _make_empty(0, 3, 3))
    sigma: Array = field(default_factory=lambda: _make_empty(0, 3))
    unit_error: Array = field(default_factory=lambda: _make_empty(0, 3))  # the same, smoothed: unit of lasting errors
    elapsed: Array = field(default_factory=lambda: _make_empty(0))  # s since the epoch of the navigation frame
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))
    gyro: Array = field(default_factory=lambda: _make_empty(0, 3))  # measured rate at the fix
    force: Array = field(default_factory=lambda: _make_empty(0, 3))  # measured specific force at the fix
    force_slope: Array = field(default_factory=lambda: _make_empty(0, 3))  # m/s^3, its rate of change
    g_n: Array = field(default_factory=lambda: _make_empty(0, 3))  # gravity there
    omega_n: Array = field(default_factory=lambda: np.zeros(3))  # Earth rate

    def compute_typical_error(self) -> Array:
        """At least the stated sigma: a fix within it is not wrong, however good the others are."""
        whole = np.sqrt(self.sigma**2 + self._compute_lasting_variance())
        return np.asarray(np.median(np.maximum(whole, self.unit_error), axis=0))

    def _compute_lasting_variance(self) -> Array:
        """(N, 3) of the time-correlated errors."""
        lasting = sum(
            (p.sigma**2 for p in self.parameters if p.name.startswith((*ERRORS, VELOCITY_ERROR))), np.zeros(3)
        )
        return np.asarray(lasting * self.unit_error**2)

    def _compute_acceleration(
        self, states: States, rows: slice | Array, ahead: Array
    ) -> tuple[Array, Array, dict[str, Array]]:
        """Acceleration in n (n, 3) at `ahead` (n, 1) s after the stamps, its derivatives by that and the state."""
        measured = self.force[rows], self.force_slope[rows], self.gyro[rows]
        return compute_acceleration(states, *measured, self.g_n[rows], ahead)


def _build_motion(scene: BuildContext, t: Array, p_n: Array) -> dict[str, Any]:
    """The fields of the antenna's motion around times t (N,) at places p_n (N, 3)."""
    imu, gnss = scene.recording.imu, scene.recording.gnss
    assert gnss is not None
    force, slope = fit_force_line(imu, t)
    return {
        "elapsed": t - scene.frame.epoch,
        "lever_arm": gnss.lever_arm,
        "gyro": average_around(imu, imu.gyro, t),
        "force": force,
        "force_slope": slope,
        "g_n": scene.frame.gravity_n(p_n),
        "omega_n": scene.frame.omega_n,
    }


@dataclass(frozen=True)
class GnssPosition(_Fixes):
    """The position of the antenna at a fix."""

    name: ClassVar[str] = "gnss_position"
    axes: ClassVar[tuple[str, ...]] = ("east", "north", "up")
    noise_axes: ClassVar[tuple[str, ...]] = ("horizontal", "horizontal", "up")
    unit: ClassVar[str] = "m"
    fix_of: ClassVar[str] = "p"

    p_n: Array = field(default_factory=lambda: _make_empty(0, 3))  # fixes in the navigation frame
    drive_error: Array = field(
        default_factory=lambda: np.zeros(3)
    )  # median of these: unit of the errors of minutes and hours
    type: Array | None = None  # (N,) index into graphnav.recording.FIX_TYPES, where there are several types
    multipath_sigma: Array | None = None  # (N, 3) m, unit of what the residuals tell of, where fixes state these

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        if recording.gnss is None or not settings.gnss.position or recording.is_tight(settings.raw_gnss.coupling):
            return _make_empty(0)
        t = recording.gnss.t
        return t[_mask_covered(recording, t)]

    @classmethod
    def build(cls, scene: BuildContext) -> GnssPosition | None:
        gnss = scene.recording.gnss
        tight = scene.recording.is_tight(scene.settings.raw_gnss.coupling)
        if gnss is None or not scene.settings.gnss.position or tight:
            return None
        keyframe = scene.find_keyframes(gnss.t)
        used = keyframe >= 0
        if not used.any():
            return None
        llh, sd = gnss.llh[used], gnss.sd[used]
        p_n = scene.frame.from_llh(llh)
        kinds = None if gnss.type is None or len(np.unique(gnss.type)) < 2 else gnss.type[used]
        common = _build_common(scene, TIME_OFFSET)
        types = [] if kinds is None else [FIX_TYPES[int(kind)] for kind in np.unique(kinds)]
        spacing = find_node_spacing(scene.settings.gnss.slow_times, find_fix_period(gnss.t[used]))
        processes = (
            *list_processes(types, scene.settings.gnss.slow_times, spacing),
            *_build_stamp_error(scene.settings, gnss.t[used]),
        )
        reflected = None
        if gnss.residual_rms is not None:
            reflected = compute_multipath_sigma(gnss.residual_rms, gnss.satellites)
            processes += (make_multipath(gnss.t, reflected, find_least_period(gnss.t[used])),)
        rounding = np.array(gnss.rounding) * np.sqrt(count_repeats(gnss.llh[:, [1, 0, 2]]))[used]
        return cls(
            keyframe=keyframe[used],
            p_n=p_n,
            R_ln=earth.enu_axes(llh) @ scene.frame.R_ne.T,
            sigma=np.hypot(sd, rounding),
            unscaled=rounding,
            unit_error=compute_running_median(gnss.t[used], sd)
            if scene.typical_sigmas is None
            else scene.typical_sigmas[used],
            drive_error=np.median(sd if scene.typical_sigmas is None else scene.typical_sigmas, axis=0),
            type=kinds,
            multipath_sigma=None if reflected is None else sd * reflected[used, None],
            **_build_motion(scene, gnss.t[used], p_n),
            processes=processes,
            **common,
        )

    def list_noise_groups(self) -> tuple[tuple[str, ...], Array]:
        if self.type is None:
            return super().list_noise_groups()
        kinds, which = np.unique(self.type, return_inverse=True)
        names = tuple(
            f"{self.name}.{FIX_TYPES[int(kind)]}.{axis}" for kind in kinds for axis in dict.fromkeys(self.noise_axes)
        )
        return names, 2 * which[:, None] + np.array([0, 0, 1])

    def convert_units(self, typical: TypicalSigmas) -> Self:
        processes = _space_nodes(self.processes, typical.spacing)
        return replace(self, drive_error=typical.overall(), processes=processes)

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        C, R = self.R_ln[rows], states.R_nb
        lever = parameters.get(LEVER_ARM, self.lever_arm)
        away = states.p - self.p_n[rows] + mv(R, lever)
        J = {"theta": -R @ rotation.skew(lever), "p": _I3[None]}
        if LEVER_ARM in parameters:
            J[LEVER_ARM] = R
        offset, by = _split_time_offset(parameters, TIME_OFFSET, self.elapsed[rows])
        if offset is not None:
            velocity, moved = compute_antenna_velocity(states, self.gyro[rows], self.omega_n, lever)
            change, jerk, bent = self._compute_acceleration(states, rows, offset / 3.0)
            away = away + velocity * offset + change * (0.5 * offset**2)
            for block in ("theta", "v", "bg", LEVER_ARM):
                if block != LEVER_ARM or LEVER_ARM in parameters:
                    J[block] = J.get(block, 0.0) + moved[block] * offset[..., None]
            for block, x in bent.items():
                J[block] = J.get(block, 0.0) + x * (0.5 * offset**2)[..., None]
            later = velocity + (change + jerk * offset / 6.0) * offset
            J |= {name: (later * one)[..., None] for name, one in by.items()}
        residual, jacobians = mv(C, away), {block: C @ x for block, x in J.items()}
        for name in parameters:
            if name.startswith((*ERRORS, MULTIPATH_ERROR)):
                size = np.broadcast_to(self._select_unit(name, rows), residual.shape)
                residual = residual + size * parameters[name]
                jacobians[name] = size[..., None] * _I3
        return Linearized(residual, jacobians, self.sigma[rows])

    def _compute_lasting_variance(self) -> Array:
        variance = super()._compute_lasting_variance()
        for p in self.parameters:
            if p.name == MULTIPATH_ERROR:
                assert self.multipath_sigma is not None
                variance = variance + p.sigma**2 * self.multipath_sigma**2
        return variance

    def _select_unit(self, name: str, rows: slice | Array) -> Array:
        """What a process of lasting errors is in units of, m; 0 where it is that of fixes of another type."""
        if name == MULTIPATH_ERROR:
            assert self.multipath_sigma is not None
            return self.multipath_sigma[rows]
        unit = self.drive_error if name.startswith(ERRORS[1:]) else self.unit_error[rows]
        if self.type is None:
            return unit
        kind = next(k for k, kind in FIX_TYPES.items() if name.endswith(kind))
        return np.asarray(unit * (self.type[rows] == kind)[..., None])


@dataclass(frozen=True)
class GnssVelocity(_Fixes):
    """The velocity of the antenna at a fix."""

    name: ClassVar[str] = "gnss_velocity"
    axes: ClassVar[tuple[str, ...]] = ("east", "north", "up")
    noise_axes: ClassVar[tuple[str, ...]] = ("horizontal", "horizontal", "up")
    unit: ClassVar[str] = "m/s"
    fix_of: ClassVar[str] = "v"

    v_l: Array = field(default_factory=lambda: _make_empty(0, 3))

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        gnss = recording.gnss
        tight = recording.is_tight(settings.raw_gnss.coupling)
        if gnss is None or gnss.v is None or not settings.gnss.velocity or tight:
            return _make_empty(0)
        t = gnss.velocity_t
        return t[_mask_covered(recording, t) & np.isfinite(gnss.v).all(axis=1)]

    @classmethod
    def build(cls, scene: BuildContext) -> GnssVelocity | None:
        gnss = scene.recording.gnss
        tight = scene.recording.is_tight(scene.settings.raw_gnss.coupling)
        if gnss is None or gnss.v is None or gnss.sd_v is None or not scene.settings.gnss.velocity or tight:
            return None
        t = gnss.velocity_t
        keyframe = scene.find_keyframes(t)
        used = (keyframe >= 0) & np.isfinite(gnss.v).all(axis=1)
        if not used.any():
            return None
        t = t[used]
        lasting = Parameter.centred(
            VELOCITY_ERROR, 3, 1.0, "sd", correlation_time=SECONDS,
            spacing=find_node_spacing((), find_fix_period(t)),
            noise_groups=tuple(f"{cls.name}.seconds.{axis}" for axis in cls.noise_axes),
        )  # fmt: skip
        return cls(
            keyframe=keyframe[used],
            v_l=gnss.v[used],
            R_ln=earth.enu_axes(gnss.llh[used]) @ scene.frame.R_ne.T,
            sigma=gnss.sd_v[used],
            **_build_motion(scene, t, scene.frame.from_llh(gnss.llh[used])),
            unit_error=compute_running_median(t, gnss.sd_v[used]),
            processes=(lasting, *_build_stamp_error(scene.settings, t)),
            **_build_common(scene, VELOCITY_TIME_OFFSET),
        )

    def convert_units(self, typical: TypicalSigmas) -> Self:
        processes = _space_nodes(self.processes, typical.spacing)
        return replace(self, unit_error=typical.around(self.keyframe)[:, 3:], processes=processes)

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        C = self.R_ln[rows]
        lever = parameters.get(LEVER_ARM, self.lever_arm)
        velocity, moved = compute_antenna_velocity(states, self.gyro[rows], self.omega_n, lever)
        residual = mv(C, velocity) - self.v_l[rows]
        jacobians = {block: C @ J for block, J in moved.items() if block != LEVER_ARM or LEVER_ARM in parameters}
        offset, by = _split_time_offset(parameters, VELOCITY_TIME_OFFSET, self.elapsed[rows])
        if offset is not None:
            change, jerk, bent = self._compute_acceleration(states, rows, offset / 2.0)
            residual = residual + mv(C, change) * offset
            for block, x in bent.items():
                jacobians[block] = jacobians.get(block, 0.0) + C @ x * offset[..., None]
            then = mv(C, change + jerk * offset / 2.0)
            jacobians |= {name: (then * one)[..., None] for name, one in by.items()}
        if VELOCITY_ERROR in parameters:
            size = self.unit_error[rows]
            residual = residual + size * parameters[VELOCITY_ERROR]
            jacobians[VELOCITY_ERROR] = size[..., None] * _I3
        return Linearized(residual, jacobians, self.sigma[rows])


def free_constants(rows: Constraint, priors: Mapping[str, tuple[Array, Array]]) -> Constraint:
    """Rows of fixes with constants as parameters: the lever arm (m), offsets of stamps (s), the rate of clocks (s/s).

    Parameters
    ----------
    priors : value and 1-sigma (k,), by the parameter's name; of offsets only those of the rows are taken.
    """
    there = {LEVER_ARM, CLOCK_RATE, *(p.name for p in rows.parameters)}
    own = [Parameter(name, value, sigma, _UNITS[name]) for name, (value, sigma) in priors.items() if name in there]
    others = [p for p in rows.parameters if p.name not in priors]
    changed: dict[str, Any] = {"parameters": (*own, *others)}
    if LEVER_ARM in priors:
        changed["lever_arm"] = priors[LEVER_ARM][0]
    return replace(rows, **changed)
