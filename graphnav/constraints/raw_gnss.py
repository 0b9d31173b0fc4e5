"""Codes and Doppler shifts of single satellites, for an antenna at a lever arm from the IMU.

With p_a = p + R_nb l the antenna, e the unit vector from it to the satellite s in the Earth-fixed frame of the
reception, and u = v + R_nb (omega_nb x l) its velocity (Groves 2013, sections 8.4.1, 9.4.1 and 14.1.2)::

    r_code    = |s - p_a| + b + b_s + m z + I + T - dt - e_l.c + g q - P
    r_doppler = e.(v_s - u) / k + b' - dt' - e_l.d - D

b and b' are receiver clock and drift, independent at every epoch; b_s is the inter-system (inter-signal) bias, z the
zenith error of the ionosphere model and m its mapping function; k accounts for the change of the flight time
(`gnss.single_point.compute_stretch`). Time-correlated errors are c, common to all satellites and expressed as a shift
of the antenna in east, north, up: over seconds and minutes multipath and the receiver's code smoothing, and a part
over hours; d, the same for velocities over seconds; and q, of one satellite over hours: orbit, clock and atmosphere
along its line of sight. The sizes of c and q over hours are stated, because a drive does not separate them from its
position; the noise model estimates the others.

Against a base station orbit, clock and atmosphere cancel, and little of q is left, of size g. With carriers it is the
multipath of a satellite's codes over minutes: taken as white it would determine ambiguities, which are constant, to
centimetres. It is stated too: estimated, a single satellite that is grossly wrong makes those of all too large. Without
carriers the white sigmas, estimated by the signals' power, hold it: in streets it changes within seconds. Ranges also
have the term - h sin(elevation): signals are received at the antennas' phase centres, and h is the height of the
rover's phase centre above the point given by its lever arm, less that of the base's above its stated position. A drive
does not separate it from its height.

Ranges are computed as differences against a nominal position of each epoch, which keeps their precision.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LEVER_ARM, average_around, compute_antenna_velocity
from graphnav.constraints.base import BuildContext, Constraint, Linearized
from graphnav.constraints.lasting import TIMES
from graphnav.constraints.raw_rows import CLOCK, GROSS, PreparedRows
from graphnav.constraints.raw_selection import select_observations
from graphnav.core import rotation
from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.core.state import SECONDS, Parameter, States
from graphnav.gnss.atmosphere import compute_obliquity
from graphnav.gnss.series import RawGnss
from graphnav.gnss.sigmas import compute_code_reflection_sigma, compute_code_sigma, compute_rate_sigma
from graphnav.gnss.signals import L1, SYSTEM_NAMES, C, name_satellite, name_signal
from graphnav.gnss.single_point import group_signals
from graphnav.recording import Recording

BIASES = "gnss_signal_biases"
IONOSPHERE = "gnss_ionosphere"
PHASE_CENTRES = "gnss_phase_centres"
CODE_ERRORS = tuple(f"gnss_code_error_of_{time}" for time in TIMES)
SATELLITES = "gnss_satellite_errors"
RATE_ERROR = "gnss_doppler_error"
_ZENITH = 1.5  # m, 1-sigma of the zenith error of the ionosphere model: half of the delay on an ordinary day
# unit/sqrt(s), random walks over hours. The lever arm has one as well, of a centimetre in three hours, so that all
# parameters of the rows except states and clocks share their nodes and form one variable of the graph
_ZENITH_WALK, _BIAS_WALK, _LEVER_WALK = 0.01, 0.003, 1e-4
AXES = ("horizontal", "horizontal", "up")
# m, 1-sigma of errors over hours, which a drive does not separate from its position: common to all satellites, as a
# shift of the position, and of one satellite. Horizontally it is the ionosphere's gradient, a metre. Vertically the
# ionosphere has its own parameter, and troposphere models leave decimetres (Remote Sensing 13, 2021, 1202)
_HOURS, ONE = np.array([1.0, 1.0, 0.5]), 0.7
_ERROR = np.array([1.0, 1.0, 2.0])  # m, unit of the errors over seconds and minutes
_DIFFERENCED = 0.1  # factor on the errors over hours against a base station
# m, 1-sigma of the difference of two antennas: calibrated models have their phase centres on L1 7 cm above their
# reference points, with a standard deviation of 2.5 cm (National Geodetic Survey, absolute calibrations)
_PHASE_CENTRES, _CENTRES_WALK = 0.035, 1e-5
_GRADIENT = 2e-6  # zenith delay difference per distance to a base station, on an ordinary day (Odijk 2002)
_RATE_ERROR = np.array([0.05, 0.05, 0.1])  # m/s
_LEVELS = (45.0, 40.0, 35.0)  # dB-Hz, limits of the classes of signals, each with its own variance factor
_CLASSES = ("strong", "fair", "weak", "faint")
# shared fields with one entry per row
PER_ROW = ("keyframe", "s_n", "R_ln", "satellite", "azimuth", "elevation", "level")


def list_common_fields(scene: BuildContext, found: PreparedRows) -> dict[str, Any]:
    settings, raw = scene.settings, found.raw
    parameters: tuple[Parameter, ...] = (found.clock,)
    if settings.gnss.lever_arm_sigma is not None:
        sigma = np.full(3, settings.gnss.lever_arm_sigma)
        parameters += (Parameter(LEVER_ARM, raw.lever_arm, sigma, "m", _LEVER_WALK, spacing=found.spacing),)
    if raw.differenced:
        centres = Parameter.centred(PHASE_CENTRES, 1, _PHASE_CENTRES, "m", _CENTRES_WALK, spacing=found.spacing)
        parameters += (centres,)
    return {
        "keyframe": found.keyframe,
        "s_n": found.s_n,
        "R_ln": found.R_ln,
        "lever_arm": raw.lever_arm,
        "satellite": raw.satellite,
        "azimuth": found.azimuth,
        "elevation": found.elevation,
        "level": np.searchsorted(-np.array(_LEVELS), -np.nan_to_num(raw.cn0, nan=_LEVELS[0]), side="left"),
        "parameters": parameters,
        **settings.raw_gnss.outliers,
    }


def make_ionosphere_parameter(raw: RawGnss, spacing: float) -> Parameter:
    """Zenith error of the ionosphere model; against a base station, its difference between the two."""
    sigma = max(_GRADIENT * raw.baseline, 1e-3) if raw.differenced else _ZENITH
    return Parameter.centred(IONOSPHERE, 1, sigma, "m", sigma / _ZENITH * _ZENITH_WALK, spacing=spacing)


def _tell_gross(count: int) -> tuple[Note, ...]:
    sentence = f"gnss_code: {format_count(count, 'row')} left out, {GROSS:.0f} m or more off the others of its epoch"
    return (Note("gnss_code.gross", sentence),) if count else ()


@dataclass(frozen=True)
class SatelliteConstraint(Constraint):
    """Rows of single satellites."""

    axes: ClassVar[tuple[str, ...]] = ("range",)
    words: ClassVar[Mapping[str, tuple[tuple[str, str, float], ...]]] = {
        CLOCK: (("receiver ahead of GPS time", "µs", 1e6 / C), ("drift of the receiver clock", "m/s", 1.0))
    }
    noise_axes: ClassVar[tuple[str, ...]] = (*_CLASSES, "horizontal", "up")  # of white parts, and of what lasts

    s_n: Array = field(default_factory=lambda: np.empty((0, 3)))  # m
    R_ln: Array = field(default_factory=lambda: np.empty((0, 3, 3)))
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))
    sigma: Array = field(default_factory=lambda: np.empty((0, 1)))
    satellite: Array = field(default_factory=lambda: np.empty(0, dtype=np.int16))  # (N,) graphnav.gnss.signals
    azimuth: Array = field(default_factory=lambda: np.empty(0))  # (N,) rad, from north to the east
    elevation: Array = field(default_factory=lambda: np.empty(0))  # (N,) rad
    level: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) of _CLASSES

    @property
    def labels(self) -> dict[str, Array]:
        known, which = np.unique(self.satellite, return_inverse=True)
        names = np.array([name_satellite(s) for s in known])[which]
        return {"satellite": names, "azimuth": self.azimuth, "elevation": self.elevation}

    def list_noise_groups(self) -> tuple[tuple[str, ...], Array]:
        there, which = np.unique(self.level, return_inverse=True)
        return tuple(f"{self.name}.{_CLASSES[int(k)]}" for k in there), which[:, None]

    def _place_antenna(self, states: States, parameters: dict[str, Array]) -> tuple[Array, Array]:
        """Antennas in n (N, 3), and lever arms (3,) or (N, 3)."""
        lever = parameters.get(LEVER_ARM, self.lever_arm)
        return states.p + rotation.mv(states.R_nb, lever), lever

    def _sum_lasting_errors(
        self, parameters: dict[str, Array], names: tuple[str, ...], rows: slice | Array, e: Array
    ) -> tuple[Array | float, dict[str, Array]]:
        """Effect on the rows (n,) of errors common to all satellites, as shifts in east, north, up, and its
        derivatives."""
        there = [name for name in names if name in parameters]
        if not there:
            return 0.0, {}
        towards = -rotation.mv(self.R_ln[rows], e)
        shift = np.sum(towards * sum(parameters[name] for name in there), axis=1)
        return shift, dict.fromkeys(there, towards[:, None])


def compute_range_change(s: Array, antenna: Array, nominal: Array) -> tuple[Array, Array]:
    """|s - antenna| - |s - nominal| (n,) without cancellation of digits, and unit vectors to the satellites."""
    away, from_nominal = s - antenna, s - nominal
    moved = antenna - nominal
    distance = np.linalg.norm(away, axis=1)
    change = np.sum(moved * (moved - 2.0 * from_nominal), axis=1) / (distance + np.linalg.norm(from_nominal, axis=1))
    return change, away / distance[:, None]


def select_columns(values: Array, which: Array) -> tuple[Array, Array]:
    """Select each row's column (n,) from values (n, k), 0 for column -1; and the derivatives (n, 1, k)."""
    own = which[:, None] == np.arange(values.shape[1])
    return np.sum(own * values, axis=1), own[:, None].astype(float)


@dataclass(frozen=True)
class RangeConstraint(SatelliteConstraint):
    """Rows of ranges to satellites."""

    offset: Array = field(default_factory=lambda: np.empty(0))  # (N,) m, the part that does not depend on the estimate
    nominal: Array = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) m

    def _linearize_ranges(
        self, states: States, parameters: dict[str, Array], rows: slice | Array, delay: str, factor: Array
    ) -> tuple[Array, dict[str, Array], Array]:
        """Residuals (n,), Jacobians, and directions (n, 3); a parameter delays each row by its factor (n,)."""
        antenna, lever = self._place_antenna(states, parameters)
        change, e = compute_range_change(self.s_n[rows], antenna, self.nominal[rows])
        residual = change + self.offset[rows] + parameters[CLOCK][:, 0] + factor * parameters[delay][:, 0]
        J = {
            "theta": (e[:, None] @ states.R_nb) @ rotation.skew(lever),
            "p": -e[:, None],
            CLOCK: np.broadcast_to(np.array([[1.0, 0.0]]), (len(e), 1, 2)),
            delay: factor[:, None, None],
        }
        if LEVER_ARM in parameters:
            J[LEVER_ARM] = -e[:, None] @ states.R_nb
        if PHASE_CENTRES in parameters:
            up = np.sin(self.elevation[rows])
            residual = residual - up * parameters[PHASE_CENTRES][:, 0]
            J[PHASE_CENTRES] = -up[:, None, None]
        return residual, J, e


@dataclass(frozen=True)
class GnssCode(RangeConstraint):
    """Code of one satellite at the antenna."""

    name: ClassVar[str] = "gnss_code"
    unit: ClassVar[str] = "m"

    group: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) group of the signal, 0 the reference
    which: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) satellite, index into their errors
    slant: Array = field(default_factory=lambda: np.empty(0))  # (N,) ionospheric mapping function
    lasting: Array = field(default_factory=lambda: np.empty(0))  # (N,) m, of a unit of the satellites' errors

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        raw = select_observations(recording, settings) if settings.raw_gnss.code else None
        return np.empty(0) if raw is None else np.unique(raw.t)

    @classmethod
    def build(cls, scene: BuildContext) -> GnssCode | None:
        found = scene.satellite_rows if scene.settings.raw_gnss.code else None
        if found is None:
            return None
        raw, settings = found.raw, scene.settings
        groups, group = group_signals(raw)
        common, spacing = list_common_fields(scene, found), found.spacing
        less = _DIFFERENCED if raw.differenced else 1.0
        common["parameters"] += (make_ionosphere_parameter(raw, spacing),)
        if len(groups) > 1:
            size, most = len(groups) - 1, settings.raw_gnss.bias_sigma
            common["parameters"] += (Parameter.centred(BIASES, size, most, "m", _BIAS_WALK, spacing=spacing),)
        satellites, which = raw.satellites
        minutes, hours = settings.gnss.slow_times
        lasts, lasting = hours, np.full(len(raw), less * ONE)
        if raw.differenced and settings.raw_gnss.carrier and np.isfinite(raw.carrier).any():
            lasts, lasting = minutes, compute_code_reflection_sigma(found.elevation)
        delay = np.zeros(len(raw)) if raw.differenced else found.ionosphere  # the base sees the same
        sigma, many = compute_code_sigma(raw.cn0, found.elevation, delay), len(satellites)
        common["parameters"] += (
            Parameter(CODE_ERRORS[2], np.zeros(3), less * _HOURS, "m", correlation_time=hours, spacing=spacing),
            Parameter.centred(SATELLITES, many, 1.0, "1", correlation_time=lasts, spacing=spacing),
        )
        processes = tuple(
            Parameter(
                error, np.zeros(3), _ERROR, "m", correlation_time=lasts, spacing=spacing,
                noise_groups=tuple(f"{cls.name}.{time}.{axis}" for axis in AXES),
            )
            for error, time, lasts in zip(CODE_ERRORS, TIMES, (SECONDS, minutes), strict=False)
        )  # fmt: skip
        words = [f"{SYSTEM_NAMES[system]} {name_signal(signal)}" for system, signal in groups]
        note = f"gnss_code: {words[0]}"
        note += f", with a bias each of {', '.join(words[1:])}" if words[1:] else ""
        return cls(
            offset=found.known - raw.code - raw.clock - (raw.difference if raw.differenced else 0.0),
            nominal=found.nominal,
            group=group,
            slant=compute_obliquity(found.elevation) * (L1 / raw.frequency) ** 2,
            sigma=sigma[:, None],
            which=which,
            lasting=lasting,
            processes=processes,
            notes=(Note("gnss_code.systems", note), *_tell_gross(found.gross)),
            **common,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        residual, J, e = self._linearize_ranges(states, parameters, rows, IONOSPHERE, self.slant[rows])
        if BIASES in parameters:
            own, J[BIASES] = select_columns(parameters[BIASES], self.group[rows] - 1)
            residual = residual + own
        own, chosen = select_columns(parameters[SATELLITES], self.which[rows])
        lasting = self.lasting[rows]
        residual, J[SATELLITES] = residual + lasting * own, lasting[:, None, None] * chosen
        shift, more = self._sum_lasting_errors(parameters, CODE_ERRORS, rows, e)
        return Linearized((residual + shift)[:, None], J | more, self.sigma[rows])


@dataclass(frozen=True)
class GnssDoppler(SatelliteConstraint):
    """Doppler shift of one satellite's signal at the antenna."""

    name: ClassVar[str] = "gnss_doppler"
    unit: ClassVar[str] = "m/s"

    offset: Array = field(default_factory=lambda: np.empty(0))  # (N,) m/s
    v_n: Array = field(default_factory=lambda: np.empty((0, 3)))  # m/s, of the satellites
    stretch: Array = field(default_factory=lambda: np.empty(0))  # (N,)
    gyro: Array = field(default_factory=lambda: np.empty((0, 3)))  # measured rate at the epoch
    omega_n: Array = field(default_factory=lambda: np.zeros(3))  # Earth rate

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        raw = select_observations(recording, settings) if settings.raw_gnss.doppler else None
        return np.empty(0) if raw is None else np.unique(raw.t[np.isfinite(raw.range_rate)])

    @classmethod
    def build(cls, scene: BuildContext) -> GnssDoppler | None:
        found = scene.satellite_rows if scene.settings.raw_gnss.doppler else None
        if found is None:
            return None
        raw, common = found.raw, list_common_fields(scene, found)
        some = np.isfinite(raw.range_rate) & np.isfinite(raw.drift)
        if not some.any():
            return None
        common |= {name: common[name][some] for name in PER_ROW}
        lasting = Parameter(
            RATE_ERROR, np.zeros(3), _RATE_ERROR, "m/s", correlation_time=SECONDS,
            spacing=found.spacing,
            noise_groups=tuple(f"{cls.name}.seconds.{axis}" for axis in AXES),
        )  # fmt: skip
        imu = scene.recording.imu
        return cls(
            offset=-(raw.range_rate + raw.drift)[some],
            v_n=found.v_n[some],
            stretch=found.stretch[some],
            gyro=average_around(imu, imu.gyro, raw.t[some]),
            omega_n=scene.frame.omega_n,
            sigma=compute_rate_sigma(raw.cn0, found.elevation)[some, None],
            processes=(lasting,),
            **common,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        antenna, lever = self._place_antenna(states, parameters)
        u, moved = compute_antenna_velocity(states, self.gyro[rows], self.omega_n, lever)
        away = self.s_n[rows] - antenna
        distance = np.linalg.norm(away, axis=1)[:, None]
        e, w = away / distance, self.v_n[rows] - u
        along = np.sum(e * w, axis=1)
        less = 1.0 / self.stretch[rows]
        residual = along * less + self.offset[rows] + parameters[CLOCK][:, 1]
        by_place = -((w - along[:, None] * e) / distance * less[:, None])[:, None]  # (n, 1, 3)
        by_velocity = -(e * less[:, None])[:, None]
        J = {name: by_velocity @ x for name, x in moved.items() if name != LEVER_ARM or LEVER_ARM in parameters}
        J["p"] = by_place
        J["theta"] = J["theta"] - by_place @ states.R_nb @ rotation.skew(lever)
        J[CLOCK] = np.broadcast_to(np.array([[0.0, 1.0]]), (len(e), 1, 2))
        if LEVER_ARM in parameters:
            J[LEVER_ARM] = J[LEVER_ARM] + by_place @ states.R_nb
        shift, more = self._sum_lasting_errors(parameters, (RATE_ERROR,), rows, e)
        return Linearized((residual + shift)[:, None], J | more, self.sigma[rows])
