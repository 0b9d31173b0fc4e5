"""Guesses of units, axes, clock offsets and noise from magnitude and time course; each with its confidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphnav.core.earth import STANDARD_GRAVITY
from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.recording.draft import motion
from graphnav.recording.formats.axes import parse_axes_letters
from graphnav.recording.formats.schema import FORCE, RATE_UNITS, SPEED
from graphnav.sensors import barometer
from graphnav.sensors.barometer import ATMOSPHERE
from graphnav.sensors.tables import TIME_UNITS

_MEAN_SHARE = 0.5  # share of the typical force that is in its mean, even for a swinging foot
_LIKELY, _CLEAR = 0.5, 0.9  # correlation
_STRAIGHT_COSINE = np.cos(np.radians(12.0))  # cosine of the angle to a file axis below which the axis is meant
_CALM_ROWS = 11  # rows, a stance of 0.1 s at 100 Hz
_BACKWARD = 0.01  # share of steps backward from which rows are in no order
_LARGEST_STEP = 100.0  # s; larger steps between stamps mean a smaller unit
_FIXED = 0.15  # m; only fixed carrier phases state less


@dataclass(frozen=True)
class Guess:
    """A value for recording.toml and the reason, in words."""

    value: object
    why: str


def guess_time_unit(t: Array, stated: str | None, imu: bool) -> Guess:
    """s, ms, us, ns or d: by the name, by the magnitude of an epoch, by the step."""
    step = _compute_step(t)
    if stated is not None and step * TIME_UNITS[stated] < _LARGEST_STEP:
        return Guess(stated, "as the column's name says")
    if (unit := _guess_unix_unit(t)) is not None:
        return Guess(unit, f"{t[0]:.0f} is then a date of this century in Unix time")
    low, high = (5e-4, 0.11) if imu else (0.02, 11.0)
    fits = [unit for unit, scale in TIME_UNITS.items() if low <= step * scale <= high]
    if not fits:
        return Guess("s", f"rows are {step:g} apart, which fits no unit: a guess")
    return Guess(fits[0], f"rows are then {step * TIME_UNITS[fits[0]]:.4g} s apart")


def _compute_step(t: Array) -> float:
    """The median step between stamps, of rows in any order; 1 of a single row."""
    step = np.diff(t)
    if len(step) and (step < 0.0).mean() > _BACKWARD:  # no clock restarts as often
        step = np.diff(np.sort(t))
    return float(np.median(step)) if len(step) else 1.0


def is_date(t: Array) -> bool:
    """Whether stamps are dates of this century in Unix time, in some unit."""
    return _guess_unix_unit(t) is not None


def _guess_unix_unit(t: Array) -> str | None:
    step = _compute_step(t) if len(t) > 1 else 0.0
    return next(
        (u for u, scale in TIME_UNITS.items() if 1e9 <= float(t[0]) * scale < 3e9 and step * scale < _LARGEST_STEP),
        None,
    )


def guess_accel_unit(path: Path, accel: Array, stated: str | None) -> Guess:
    """m/s2, g or mg, by the magnitude of gravity.

    Raises
    ------
    RecordingError
        If gravity has been taken out, or the numbers are raw counts.
    """
    force = np.linalg.norm(accel, axis=-1)
    size, calm = float(np.median(force)), float(np.median(force[_find_calm(accel)]))
    lasting = float(np.linalg.norm(np.mean(accel, axis=0))) > _MEAN_SHARE * size  # more than motion alone causes
    for typical, words in ((size, "median force"), (calm, "force where it is calm")):  # a foot may rarely stand
        for unit, scale in FORCE.items():
            if lasting and 0.8 * STANDARD_GRAVITY < typical * scale < 1.25 * STANDARD_GRAVITY:
                return Guess(unit, f"the {words}, {typical:.4g}, is then that of gravity")
    if stated is not None and lasting and size * FORCE[stated] > 0.8 * STANDARD_GRAVITY:
        return Guess(stated, f"as the column's name says, though the median force is {size:.4g}")
    if size < 0.5 * STANDARD_GRAVITY or not lasting:
        raise RecordingError(
            f"{path}: the accelerations are {size:.3g} in size at the median and not lasting: they are without "
            "gravity; log the raw accelerometer (on iOS 'TotalAcceleration')",
            key="draft.no_gravity",
        )
    raise RecordingError(
        f"{path}: the accelerations are {size:.3g} in size at the median, which is gravity in no unit: raw counts?",
        key="draft.raw_counts",
    )


def _find_calm(accel: Array) -> Array:
    """(N,) bool, the tenth of rows about which the force changes least."""
    step = np.linalg.norm(np.diff(accel, axis=0, prepend=accel[:1]), axis=1)
    width = min(_CALM_ROWS, len(step))
    around = np.convolve(step, np.ones(width), "same")
    return np.asarray(around <= np.percentile(around, 10.0))


def guess_gyro_unit(path: Path, gyro: Array, stated: str | None, lag: motion.Lag | None, vehicle: bool) -> Guess:
    """rad/s or deg/s: by the turns of the course if there are any, by the name, by the magnitude.

    Raises
    ------
    RecordingError
        If the turns are clearly those of the course, but whole numbers in no unit: raw counts.
    """
    if lag is not None and abs(lag.correlation) > _LIKELY:
        for unit, scale in RATE_UNITS.items():
            if 0.6 < abs(lag.slope) * scale < 1.6:
                words = f"the turns are then those of the course (correlation {lag.correlation:.2f})"
                if lag.correlation < 0.0:
                    words = f"CHECK: {words}: the other way round; the sign of positions, rates or forces is wrong"
                return Guess(unit, words)
        if abs(lag.correlation) > _CLEAR and np.array_equal(gyro, np.round(gyro)):
            raise RecordingError(
                f"{path}: the rates are {abs(lag.slope):.3g} times the turns of the fixes in rad/s, which is no "
                "unit: raw counts?",
                key="draft.raw_counts",
            )
    if stated is not None:
        return Guess(stated, "as the column's name says")
    large = float(np.percentile(np.abs(gyro), 99.5))
    limit = 2.5 if vehicle else 15.0
    turns = "no turns to check it"
    if lag is not None:
        turns = f"{abs(lag.slope):.3g} times the turns of the fixes in rad/s (correlation {lag.correlation:.2f})"
    return Guess("deg/s" if large > limit else "rad/s", f"99.5 % of the rates are below {large:.3g}; a guess, {turns}")


def find_speed_unit(t: Array, speed: Array, course: motion.Course, units: Mapping[str, float]) -> Guess | None:
    """The unit, of those with their scales to m/s, in which speeds (N,) are those of the fixes; None if in none."""
    mine = np.interp(course.t, t, speed, np.nan, np.nan)
    ok = np.isfinite(mine) & (course.speed > 3.0)
    if ok.sum() <= 50 or not (ratio := float(np.median(np.abs(mine[ok]) / course.speed[ok]))) > 0.0:
        return None
    unit = min(units, key=lambda u: abs(np.log(ratio * units[u])))
    if abs(np.log(ratio * units[unit])) > 0.08:
        return None
    return Guess(unit, f"the fixes move {1 / ratio / units[unit]:.3f} times as fast")


def guess_speed_unit(t: Array, speed: Array, course: motion.Course | None, stated: str | None) -> Guess:
    """m/s, km/h, mph or knots: by the fixes if there are any, by the name, by the magnitude."""
    if course is not None and (found := find_speed_unit(t, speed, course, SPEED)) is not None:
        return found
    if stated is not None:
        return Guess(stated, "as the column's name says")
    large = float(np.percentile(np.abs(speed), 95))
    return Guess("km/h" if large > 45 else "m/s", f"95 % of the speeds are below {large:.3g}; a guess")


def guess_fix_numbers(types: Array, sd: Array | None) -> Guess:
    """The convention of fix types (N,), "rtklib", "nmea" or None, by the horizontal sigmas (N,) m of the fixes.

    A fixed solution is 1 or 4, and nothing else is that precise; the other numbers must be consistent with it.
    """
    if sd is None:
        return Guess(None, "there are no sigmas to identify the convention")
    typical = {int(k): float(np.median(sd[types == k])) for k in np.unique(types[np.isfinite(types)])}
    precise = {k for k, s in typical.items() if s < _FIXED}
    for whose, fixed, known in (("rtklib", 1, range(7)), ("nmea", 4, (0, 1, 2, 4, 5, 9))):
        floats = {2} if whose == "rtklib" else {5}  # converged ones may state as little
        if fixed in precise and precise <= {fixed} | floats and set(typical) <= set(known):
            return Guess(
                whose, f"fixes of type {fixed} have a median sigma of {typical[fixed]:.2g} m, as fixed solutions do"
            )
    return Guess(None, "neither its numbers nor the sigmas identify the convention")


def guess_up(accel: Array) -> tuple[Array, str]:
    """The up axis (3,) in file axes, and how constant gravity was."""
    mean = np.mean(accel, axis=0)
    up = mean / np.linalg.norm(mean)
    tilt = np.degrees(np.arccos(np.clip(np.abs(up).max(), 0, 1)))
    axis = int(np.abs(up).argmax())
    return (
        up,
        f"gravity is measured along {'+' if up[axis] > 0 else '-'}{'xyz'[axis]}, {tilt:.0f} deg off it on average",
    )


def guess_axes(up: Array, forward: Array) -> tuple[str | None, tuple[Array, Array]]:
    """Three letters if both vectors are close to file axes, and in any case the two vectors."""
    square = forward - (forward @ up) * up
    square /= np.linalg.norm(square)
    if np.abs(up).max() > _STRAIGHT_COSINE and np.abs(square).max() > _STRAIGHT_COSINE:
        letters = ["", "", ""]
        for vector, positive, negative in ((up, "U", "D"), (square, "F", "B")):
            k = int(np.abs(vector).argmax())
            letters[k] = positive if vector[k] > 0 else negative
        for side in "RL":
            word = "".join(letter or side for letter in letters)
            try:
                parse_axes_letters(word)
            except ValueError:
                continue
            return word, (square, up)
    return None, (square, up)


def choose_forward(up: Array) -> Array:
    """A forward axis where nothing determines it: x if it is level, else y."""
    return np.asarray(np.eye(3)[0 if abs(up[0]) < 0.7 else 1])


def guess_pressure_unit(pressure: Array, stated: str | None) -> Guess | None:
    """The unit of air pressures (N,): as stated, or that in which they are nearest to one atmosphere."""
    column = barometer.SENSOR.columns[0]
    middle = float(np.median(pressure))
    if not middle > 0.0:
        return None
    unit = stated or min(column.units, key=lambda one: abs(np.log(middle * column.units[one] / ATMOSPHERE)))
    if not column.lowest <= middle * column.units[unit] <= column.highest:
        return None
    why = "as the column's name says" if stated else f"their median is {middle:.5g}"
    return Guess(unit, why)
