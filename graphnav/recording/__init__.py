"""A recording: the rows of all sensors, in SI units, body axes RFU and on one clock, as frozen arrays.

`graphnav.recording.formats.read` makes one from any source that graphnav can read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.gnss.series import RawGnss
from graphnav.sensors import Series, list_sensors

# 1-sigma of cross-axis terms over that of scale errors: data sheets have 0.05 deg beside 0.3 % (ADIS16465)
ACROSS = 1.0 / 3.0


@dataclass(frozen=True)
class ImuNoise:
    """1-sigma noise figures of an IMU, SI, continuous time (field names as in recording.toml)."""

    gyro_noise_density: float = 1.0e-4  # rad/s/sqrt(Hz)
    accel_noise_density: float = 1.0e-3  # m/s^2/sqrt(Hz)
    gyro_bias_walk: float = 2.0e-6  # rad/s/sqrt(s)
    accel_bias_walk: float = 5.0e-5  # m/s^2/sqrt(s)
    gyro_bias_sigma: float = 5.0e-3  # rad/s at turn-on
    accel_bias_sigma: float = 1.0e-1  # m/s^2 at turn-on
    gyro_scale_sigma: float = 3.0e-3  # 1, constant scale error per axis; 0 = none, not estimated
    accel_scale_sigma: float = 3.0e-3


@dataclass(frozen=True)
class Imu:
    """Row k is the mean rate and specific force over the period that ends at t[k]."""

    t: Array  # (N,) s, strictly increasing
    gyro: Array  # (N, 3) rad/s with respect to inertial space, RFU
    accel: Array  # (N, 3) m/s^2, specific force, RFU
    noise: ImuNoise = ImuNoise()
    R_bs: Array = field(default_factory=lambda: np.eye(3))  # body (RFU) from the file's axes
    noise_assumed: bool = False  # True when the recording states no noise figures
    remounted: tuple[float, ...] = ()  # s, when it was turned in its holder, which is undone but for its biases

    @property
    def period(self) -> float:
        """Typical time between rows at the beginning, s."""
        return float(np.median(np.diff(self.t[:1000])))


# Types of fixes by RTKLIB's quality numbers (SOLQ_FIX to SOLQ_PPP of rtklib.h); 0 where a fix states none
FIX_TYPES = {0: "unknown", 1: "fixed", 2: "float", 3: "sbas", 4: "differential", 5: "single", 6: "ppp"}


@dataclass(frozen=True)
class Gnss:
    """Position and optional velocity of the antenna; NaN where an epoch has none."""

    t: Array  # (M,) s
    llh: Array  # (M, 3) rad, rad, m
    sd: Array  # (M, 3) m, east, north, up
    v: Array | None = None  # (M, 3) m/s, local ENU
    sd_v: Array | None = None  # (M, 3) m/s
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))  # m, RFU, from the IMU
    type: NDArray[np.intp] | None = None  # (M,) of FIX_TYPES; None: no fix states its type
    type_assumed: bool = False  # True when they are numbers of a CSV file, which were taken for RTKLIB's
    derived: bool = False  # whether these are single-point positions computed from the recording's raw observations
    satellites: Array | None = None  # (M,) number used in each fix, NaN where unknown
    residual_rms: Array | None = None  # (M,) m, of the pseudoranges used in each fix, NaN where unknown
    rounding: tuple[float, ...] = (0.0, 0.0, 0.0)  # m, east, north, up: standard deviation of the log's last digits
    velocity_offset: float = 0.0  # s; velocities are of `t` plus this

    @property
    def velocity_t(self) -> Array:
        """(M,) s, the times that the velocities are of."""
        return self.t + self.velocity_offset if self.velocity_offset else self.t

    @property
    def types(self) -> dict[str, int]:
        """Number of fixes of each type, by its name; empty where none states it."""
        if self.type is None:
            return {}
        return {name: n for k, name in FIX_TYPES.items() if (n := int(np.count_nonzero(self.type == k)))}


def convert_fix_types(types: Array, numbers: dict[int, int] | None = None) -> NDArray[np.intp] | None:
    """Types of fixes by the numbers of `FIX_TYPES`.

    Parameters
    ----------
    types
        (N,) numbers in the log, NaN where blank.
    numbers
        Map of the log's numbers to those of `FIX_TYPES`; None if they are the same.

    Returns
    -------
    array of int or None
        (N,), 0 where a number is blank or not a type; None if no fix states its type.
    """
    numbers = {k: k for k in FIX_TYPES} if numbers is None else numbers
    found = np.zeros(len(types), dtype=np.intp)
    for theirs, ours in numbers.items():
        found[types == theirs] = ours
    return found if found.any() else None


@dataclass(frozen=True)
class Odometer:
    """Forward speed of the point that does not slip sideways.

    Where pulses were counted, `counted` is the measured quantity and `speed` its slope at t.
    """

    t: Array  # (M,) s
    speed: Array  # (M,) m/s
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))  # m, RFU, from the IMU
    scale_sigma: float = 0.02
    counted: Array | None = None  # (M,) m counted up to t
    pulse: float = 0.0  # m per count
    wheels: Array | None = None  # (M, 4) m/s, front left, front right, rear left, rear right; NaN where unknown
    signed: bool = True  # False: backward reads positive
    speed_sigma: float | None = None  # m/s, of one reading; None: estimated from the readings
    delay_sigma: float = 0.0  # s, of the stamps; 0: they are exact


@dataclass(frozen=True)
class Truth:
    """A reference, used only for evaluation. Exactly one of `llh`, `xyz`, `closed_loop_sigma` is given."""

    t: Array  # (M,) s
    llh: Array | None = None  # (M, 3) rad, rad, m
    xyz: Array | None = None  # (M, 2 or 3) m in a local frame of unknown origin and yaw
    v: Array | None = None  # (M, 3) m/s, local ENU, NaN where absent
    rph: Array | None = None  # (M, 3) rad, NaN where absent
    # the point it refers to: "imu", "gnss", "odometer", or that many m right, forward, up of the IMU
    of: str | tuple[float, float, float] = "imu"
    closed_loop_sigma: float | None = None  # m; the end is the start


@dataclass(frozen=True)
class Own:
    """Constraints and detectors that a script adds to graphnav's own, sorted by name."""

    constraints: tuple[type[Any], ...] = ()
    detectors: tuple[type[Any], ...] = ()


@dataclass(frozen=True)
class Recording:
    """One drive or walk. `remarks` are notes on what loading changed or found unusual."""

    name: str
    platform: str  # "vehicle" | "foot"
    imu: Imu
    gnss: Gnss | None = None
    odometer: Odometer | None = None
    truth: Truth | None = None
    source: Path | None = None
    files: tuple[Path, ...] = ()  # files that were read, for provenance
    gps_zero: float | None = None  # s since the GPS epoch (1980-01-06) at t = 0, where it is known
    remarks: tuple[str, ...] = ()
    screened: bool = False  # whether `graphnav.recording.plausibility.screening.screen` has been applied
    raw_gnss: RawGnss | None = None  # observations of the antenna that the fixes of `gnss` are of
    sensors: Mapping[str, Series] = field(default_factory=dict)  # other sensors (`graphnav.sensors`), by name
    own: Own = Own()  # as passed to `graphnav.run`

    def __repr__(self) -> str:
        rows = "".join(f", {name} {len(one.t)}" for name, one in {"imu": self.imu, **self.aiding}.items())
        return f"Recording({self.name!r}, {self.platform}, {self.duration:.1f} s{rows} rows)"

    @cached_property
    def start(self) -> float:
        """Start of the first IMU period: zero of the recording's own clock, s."""
        return float(self.imu.t[0] - self.imu.period)

    @property
    def end(self) -> float:
        """End of the last IMU period, s."""
        return float(self.imu.t[-1])

    @property
    def duration(self) -> float:
        """Seconds covered by the IMU."""
        return self.end - self.start

    @property
    def has_keys(self) -> bool:
        """Whether keys of a recording.toml can be set: there is one, or nothing was read from files."""
        return self.source is None or self.source.suffix == ".toml" or not self.files

    @property
    def placed(self) -> bool:
        """Whether it has fixes, which place it on the Earth."""
        return self.gnss is not None and len(self.gnss.t) > 0

    @property
    def aiding(self) -> dict[str, Any]:
        """GNSS, odometer and the other sensors present, by name."""
        own = {"gnss": self.gnss, "odometer": self.odometer, **self.sensors}
        return {name: sensor for name, sensor in own.items() if sensor is not None}

    def is_tight(self, coupling: str) -> bool:
        """Whether raw observations are used in place of the fixes.

        Parameters
        ----------
        coupling
            `raw_gnss.coupling` of the settings.

        Returns
        -------
        bool
            True for tight coupling.
        """
        if self.raw_gnss is None or coupling == "loose":
            return False
        return coupling == "tight" or self.gnss is None or self.gnss.derived

    def without(self, source: str, span: tuple[float, float] | None = None) -> Recording:
        """The recording with one source withheld.

        Parameters
        ----------
        source
            "gnss" or "odometer".
        span
            s from the start; all of it when None.

        Returns
        -------
        Recording
            Without those rows; without the sensor where `span` is None.

        Raises
        ------
        RecordingError
            If the recording has no such source.
        """
        if source not in list_sources():
            raise RecordingError(
                f"cannot withhold '{source}': only {', '.join(list_sources())} can be withheld", key="withhold.unknown"
            )
        sensor = self.aiding.get(source)
        if sensor is None:
            raise RecordingError(
                f"cannot withhold '{source}': the recording '{self.name}' has none", key="withhold.none"
            )
        left = None
        if span is not None:
            t = sensor.t - self.start
            left = take_rows(sensor, ~((t >= span[0]) & (t <= span[1])))
        if source in self.sensors:
            rest = {name: series for name, series in self.sensors.items() if name != source}
            return replace(self, sensors=rest if left is None else {**self.sensors, source: left})
        changed: dict[str, Any] = {source: left}
        if source == "gnss" and self.raw_gnss is not None:  # the origin of the fixes
            raw = self.raw_gnss.t - self.start
            out = np.zeros(len(raw), dtype=bool) if span is None else (raw < span[0]) | (raw > span[1])
            changed["raw_gnss"] = take_rows(self.raw_gnss, out) if out.any() else None
        return replace(self, **changed)

    def crop(self, start: float | None = None, end: float | None = None) -> Recording:
        """A part of the recording; the clock keeps its epoch.

        Parameters
        ----------
        start, end
            s from the start of the recording; its own start or end when None.

        Returns
        -------
        Recording
            The rows between; the truth of a closed loop is dropped, as a part is not closed.

        Raises
        ------
        RecordingError
            If fewer than two rows of the IMU are left.
        """
        if start is None and end is None:
            return self
        lo = -np.inf if start is None else self.start + start
        hi = np.inf if end is None else self.start + end
        parts: dict[str, Any] = {
            name: take_rows(sensor, (sensor.t >= lo) & (sensor.t <= hi))
            for name in ("imu", "gnss", "odometer", "raw_gnss")
            if (sensor := getattr(self, name)) is not None
        }
        parts["sensors"] = {
            name: take_rows(series, (series.t >= lo) & (series.t <= hi)) for name, series in self.sensors.items()
        }
        if len(parts["imu"].t) < 2:
            raise RecordingError(
                f"nothing is left of '{self.name}' between {start} and {end} s", key="recording.nothing_left"
            )
        if (
            self.truth is not None
            and self.truth.closed_loop_sigma is not None
            and len(parts["imu"].t) < len(self.imu.t)
        ):
            parts["truth"] = None  # a part of a loop is not a loop
        return replace(self, **parts)


def list_sources() -> tuple[str, ...]:
    """Names of the sources that can be withheld.

    Returns
    -------
    tuple of str
        "gnss", "odometer" and those of `graphnav.sensors`.
    """
    return ("gnss", "odometer", *list_sensors())


def take_rows(sensor: Any, mask: NDArray[np.bool_] | slice) -> Any:
    """Select rows of a sensor.

    Parameters
    ----------
    sensor
        An `Imu`, `Gnss`, `Odometer` or the like.
    mask
        (N,) bool, or a slice, for which the arrays are views.

    Returns
    -------
    The same kind of sensor
        With all arrays by row selected; lever arms and axes are unchanged.
    """
    parts = {
        key: value[mask]
        for key, value in sensor.__dict__.items()
        if isinstance(value, np.ndarray) and len(value) and key not in ("lever_arm", "R_bs")
    }
    return replace(sensor, **parts)
