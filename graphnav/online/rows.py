"""Rows for `Online.add` made from a driver's values, each checked for length, unit and range; and the live output.

Each is a plain row (sensor, time, values) as in `graphnav.online.sensors.Row`, so that both kinds may be mixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from graphnav.core.complaints import suggest_nearest
from graphnav.core.errors import RecordingError
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.solution import make_trajectory
from graphnav.online.lines import LineUnits, tell_scale
from graphnav.online.steady import Online
from graphnav.recording import Gnss, Imu, ImuNoise, Odometer, Recording
from graphnav.recording.plausibility.fixes import FASTEST
from graphnav.recording.plausibility.screening import ACCEL_RANGE, GYRO_RANGE
from graphnav.sensors import Sensor, Series

_NONE, _ROWS = np.empty(0), np.empty((0, 3))
_UNKNOWN = (float("nan"),) * 3
_SI = LineUnits()
_HEIGHTS = (-1000.0, 50000.0)  # m, as in files


class _Row(tuple[str, float, tuple[float, ...]]):
    """A checked row."""

    __slots__ = ()

    def __reduce__(self) -> Any:
        return tuple, (tuple(self),)


class ImuSample(_Row):
    """The mean rate and specific force of the sample period that ends at `t` (s).

    `gyro` (3,) in rad/s with respect to inertial space, about right, forward, up of the body; `accel` (3,) in m/s^2,
    specific force along them, +9.8 upward at rest; in the units and axes of `units`, by `make_setup`, where given.

    Raises
    ------
    RecordingError
        If a value has the wrong length or an impossible magnitude, as one in deg/s or g.
    """

    __slots__ = ()

    def __new__(cls, t: float, gyro: Sequence[float], accel: Sequence[float], units: LineUnits = _SI) -> ImuSample:
        given = (*_check_vector(cls, t, "gyro", "rad/s", gyro), *_check_vector(cls, t, "accel", "m/s2", accel))
        row = units.convert(("imu", _check_number(cls, t, "t", t), given))
        rate = _check_vector(cls, t, "gyro", "rad/s", row[2][:3], GYRO_RANGE, "is it in deg/s?")
        force = _check_vector(cls, t, "accel", "m/s2", row[2][3:], ACCEL_RANGE, "is it in mg?")
        return super().__new__(cls, ("imu", row[1], (*rate, *force)))


class Fix(_Row):
    """A position of the antenna at `t` (s, on the IMU's clock), and its velocity if there is one.

    `lat`, `lon` in deg, `h` in m above the ellipsoid, `sd` (3,) in m, 1-sigma east, north, up; `v` and `sd_v` (3,) in
    m/s, east, north, up, and its 1-sigmas; in those of `units`, by `make_setup`, where given. `resid_rms_m` in m is the
    rms of the residuals of its pseudoranges, and `nsat` how many satellites it used.

    Raises
    ------
    RecordingError
        If a value has the wrong length or an impossible magnitude.
    """

    __slots__ = ()

    def __new__(
        cls,
        t: float,
        lat: float,
        lon: float,
        h: float,
        sd: Sequence[float],
        v: Sequence[float] | None = None,
        sd_v: Sequence[float] | None = None,
        units: LineUnits = _SI,
        resid_rms_m: float | None = None,
        nsat: float | None = None,
    ) -> Fix:
        place = [_check_number(cls, t, name, x) for name, x in (("lat", lat), ("lon", lon), ("h", h))]
        place[:2] = np.radians(place[:2]).tolist()
        sigma = _check_vector(cls, t, "sd", "m", sd)
        speeds, of_speeds = _UNKNOWN, _UNKNOWN
        if (v is None) != (sd_v is None):
            raise RecordingError(f"Fix at t = {t}: v and sd_v go together, m/s east, north, up", key="row.velocity")
        if v is not None and sd_v is not None:
            speeds, of_speeds = (_check_vector(cls, t, name, "m/s", x) for name, x in (("v", v), ("sd_v", sd_v)))
        given: tuple[float, ...] = (*place, *sigma, *speeds, *of_speeds)
        if resid_rms_m is not None:
            rms = _check_number(cls, t, "resid_rms_m", resid_rms_m)
            if rms < 0.0:
                raise RecordingError(f"Fix at t = {t}: resid_rms_m {rms} is below zero", key="row.residuals")
            given = (*given, rms, np.nan if nsat is None else _check_number(cls, t, "nsat", nsat))
        row = units.convert(("gnss", _check_number(cls, t, "t", t), given))
        lat_rad, lon_rad, height = row[2][:3]
        if not abs(lat_rad) <= 0.5 * np.pi or not -np.pi <= lon_rad <= 2.0 * np.pi:
            raise RecordingError(f"Fix at t = {t}: lat {lat}, lon {lon} is no place in degrees", key="row.place")
        if not _HEIGHTS[0] <= height <= _HEIGHTS[1]:
            raise RecordingError(f"Fix at t = {t}: h {h} is no height of a drive in m", key="row.height")
        if v is not None:
            _check_vector(cls, t, "v", "m/s", row[2][6:9], FASTEST, "is it in km/h or mm/s?")
        for name, values in (("sd", row[2][3:6]), ("sd_v", row[2][9:12])):
            if min(values) <= 0.0:
                raise RecordingError(f"Fix at t = {t}: {name} {values}: 1-sigmas must be above zero", key="row.sigma")
        return super().__new__(cls, row)


class WheelSpeed(_Row):
    """The forward speed of the point that does not slip, m/s, forward positive, at `t` (s); in those of `units`, by
    `make_setup`, where given.

    Raises
    ------
    RecordingError
        If it is not a number, or a speed that no vehicle reaches.
    """

    __slots__ = ()

    def __new__(cls, t: float, speed: float, units: LineUnits = _SI) -> WheelSpeed:
        given = (_check_number(cls, t, "speed", speed), *_UNKNOWN, *_UNKNOWN[:2])
        row = units.convert(("odometer", _check_number(cls, t, "t", t), given))
        if not abs(row[2][0]) <= FASTEST:
            raise RecordingError(
                f"WheelSpeed at t = {t}: {row[2][0]:g} m/s, which no vehicle reaches: is it in km/h or mm/s?",
                key="row.speed",
            )
        return super().__new__(cls, row)


class Reading(_Row):
    """A row of another sensor (`graphnav.sensors`) at `t` (s): its columns by name, in SI; in those of `units`, by
    `make_setup`, where given.

    Raises
    ------
    RecordingError
        If the sensor has no such column, a needed column is missing, or a value is outside its bounds.
    """

    __slots__ = ()

    def __new__(cls, t: float, sensor: Sensor, units: LineUnits | None = None, **columns: float) -> Reading:
        for name in columns:
            if name not in sensor.names:
                raise RecordingError(
                    f"Reading of {sensor.name} at t = {t}: {suggest_nearest(name, sensor.names)}", key="row.name"
                )
        given = [_check_number(cls, t, n, columns[n]) if n in columns else np.nan for n in sensor.names]
        time = _check_number(cls, t, "t", t)
        if units is not None:
            as_in_files = tuple(x * tell_scale(c) for x, c in zip(given, sensor.columns, strict=True))
            _, time, given[:] = units.convert((sensor.name, time, as_in_files))
        values = np.array(given)
        if not sensor.mask_usable(sensor.mask_outside_bounds(values)[None])[0]:
            wanted = " or ".join(" and ".join(some) for some in sensor.needs)
            raise RecordingError(
                f"Reading of {sensor.name} at t = {t}: needs {wanted}, in SI and within its bounds", key="row.bounds"
            )
        return super().__new__(cls, (sensor.name, time, tuple(values.tolist())))


def live_setup(
    noise: ImuNoise | None = None,
    antenna: Sequence[float] | None = (0.0, 0.0, 0.0),
    axle: Sequence[float] | None = None,
    platform: str = "vehicle",
    name: str = "live",
    sensors: Sequence[Series] = (),
) -> Recording:
    """What `Online` needs before the first row: a recording without rows.

    Parameters
    ----------
    noise : figures of the IMU; None: those of a consumer IMU are assumed.
    antenna, axle : (3,) m from the IMU to the antenna and to the point that does not slip, right, forward, up; None
        where there is no GNSS, no odometer.
    platform : "vehicle" or "foot".
    name : name of the recording.
    sensors : other sensors, without rows: ``SENSOR.make_series([], {}, sigma=0.3)``.

    Returns
    -------
    Recording
        Without rows.

    Raises
    ------
    RecordingError
        If a lever arm has another length.
    """
    if platform not in ("vehicle", "foot"):
        raise RecordingError(f"live_setup: platform '{platform}': vehicle or foot", key="row.platform")
    imu = Imu(_NONE, _ROWS, _ROWS, noise or ImuNoise(), noise_assumed=noise is None)
    arms = [None if arm is None else np.array(_check_vector(None, 0.0, what, "m", arm))
            for what, arm in (("antenna", antenna), ("axle", axle))]  # fmt: skip
    gnss = None if arms[0] is None else Gnss(_NONE, _ROWS, _ROWS, lever_arm=arms[0])
    odometer = None if arms[1] is None else Odometer(_NONE, _NONE, arms[1])
    return Recording(name, platform, imu, gnss, odometer, sensors={s.sensor.name: s for s in sensors})


def live_trajectory(online: Online) -> Trajectory | None:
    """The state at the newest IMU row.

    Parameters
    ----------
    online
        The smoother.

    Returns
    -------
    Trajectory or None
        Of one row, in geodetic coordinates and local axes with its covariance; None while aligning.
    """
    now = online.live()
    if now is None or online.frame is None:
        return None
    return make_trajectory("live", online.frame, np.array([now.t]), now.state, now.covariance[None])


def _describe_place(kind: type | None, t: float) -> str:
    return "live_setup" if kind is None else f"{kind.__name__} at t = {t}"


def _check_number(kind: type | None, t: float, name: str, value: float) -> float:
    try:
        found = float(value)
    except (TypeError, ValueError):
        raise RecordingError(f"{_describe_place(kind, t)}: {name} is no number: {value!r}", key="row.number") from None
    if not np.isfinite(found):
        raise RecordingError(f"{_describe_place(kind, t)}: {name} is {found}", key="row.number")
    return found


def _check_vector(
    kind: type | None, t: float, name: str, unit: str, values: Sequence[float], most: float = np.inf, hint: str = ""
) -> tuple[float, float, float]:
    """Check three finite numbers of limited size."""
    try:
        count = len(values)
    except TypeError:
        count = 1
    if count != 3:
        raise RecordingError(
            f"{_describe_place(kind, t)}: {name} needs three numbers in {unit}, not {count}", key="row.three"
        )
    x, y, z = (_check_number(kind, t, name, value) for value in values)
    if not max(abs(x), abs(y), abs(z)) <= most:
        raise RecordingError(
            f"{_describe_place(kind, t)}: {name} of {max(x, y, z, key=abs):g} {unit} is beyond any sensor: {hint}",
            key="row.bounds",
        )
    return x, y, z
