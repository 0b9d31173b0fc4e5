"""The sensors of a log's table: their columns, as they will be read."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from time import time

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.timescales import GPS_TO_UNIX, UNIX, WEEK, find_restarts
from graphnav.recording import Gnss, Imu, Odometer
from graphnav.recording.draft import guesses
from graphnav.recording.draft.clocks import read_clock_seconds, read_serial_days
from graphnav.recording.draft.conversion import (
    convert_minutes,
    convert_small_units,
    convert_variances,
    convert_whole_degrees,
    convert_whole_velocities,
    divide_increments,
)
from graphnav.recording.draft.guesses import Guess
from graphnav.recording.draft.log_columns import LogColumns
from graphnav.recording.draft.motion import is_course_in_radians
from graphnav.recording.draft.plain import Plain, add_words
from graphnav.recording.formats import columns as matching
from graphnav.recording.formats.courses import blank_unknown
from graphnav.recording.formats.places import check_angles, find_places
from graphnav.recording.formats.registry import Log
from graphnav.recording.formats.repair import mask_new_fixes
from graphnav.recording.formats.schema import WHEELS
from graphnav.recording.formats.stamps import find_repeated, find_repeats, spread_packets
from graphnav.recording.formats.table import Table, read_table
from graphnav.sensors.tables import ANGLE, TIME_UNITS

_PLACE = ["t", "lat", "lon", "h"]
VELOCITIES = ("ve", "vn", "vu", "vd", "sd_ve", "sd_vn", "sd_vu", "speed", "course")
WANTED = {
    "imu": ("t", "gx", "gy", "gz", "ax", "ay", "az"),
    "gyro": ("t", "gx", "gy", "gz"),
    "accel": ("t", "ax", "ay", "az"),
    "gnss": (*_PLACE, "sd_e", "sd_n", "sd_u", *VELOCITIES, "type", "satellites", "resid_rms_m", "geoid"),
    "truth": (*_PLACE, *VELOCITIES[:4], *matching.ATTITUDE),
    "odometer": ("t", "speed", *WHEELS),
    "barometer": ("t", "pressure"),
    "gravity": ("t", "pull_x", "pull_y", "pull_z"),
}
PLACED = ("gnss", "truth")  # sensors with positions
_PAUSES = 1000.0  # ratio of a log's duration to that of all its rows together, at most
_NEEDED = {"gnss": 4, "truth": 4, "odometer": 2}  # number of these that a row must have


@dataclass(eq=False)
class Source:
    """One sensor's log: columns by our names in the file's units, or the log of a known program."""

    path: Path
    columns: matching.FileColumns = field(default_factory=lambda: matching.FileColumns({}))
    values: dict[str, Array] = field(default_factory=dict)
    log: Log | None = None
    t_unit: Guess = field(default_factory=lambda: Guess("s", ""))
    joined_from: tuple[Path, Path] | None = None  # files of a gyro and an accelerometer, whose rows are combined
    week: int | None = None  # the GPS week of the first row, where a column has it beside the seconds
    unused: tuple[str, ...] = ()  # columns of the file that no sensor is read from
    second: str = ""  # columns of the file that might be this sensor's too, in words
    plain: Plain | None = None  # a table that is not a CSV file of numbers, which is converted into one

    def __len__(self) -> int:
        return len(self.values["t"]) if self.log is None else len(next(s.t for s in self.held))

    @property
    def held(self) -> list[Imu | Gnss | Odometer]:
        """The sensors in the log of a known program."""
        log = self.log
        return [] if log is None else [s for s in (log.gnss, log.imu, log.odometer) if s is not None]

    @property
    def gps_zero(self) -> float | None:
        """Where the clock begins, s since the GPS epoch, if that is known; Unix time is known by its size."""
        if self.log is None:
            return None if self.week is None else WEEK * self.week
        return self.log.gps_zero

    @property
    def t(self) -> Array:
        """Times of the rows of a CSV file, s."""
        return self.values["t"] * TIME_UNITS[str(self.t_unit.value)]

    def stack(self, *names: str) -> Array:
        """Columns side by side, (N, len(names))."""
        return np.stack([self.values[n] for n in names], -1)

    def find_unit(self, ours: str, kind: str) -> str | None:
        """The unit that a column's name states."""
        return matching.find_stated_unit(self.columns, ours, kind)

    @property
    def radians(self) -> bool:
        """Whether lat and lon are in radians."""
        if stated := self.find_unit("lat", "angle"):
            return stated == "rad"
        return bool(np.abs(self.values["lat"]).max() < 1.58 and np.abs(self.values["lon"]).max() < 3.15)

    @property
    def llh(self) -> Array:
        """Positions (N, 3) in rad, rad, m; height 0 where there is none."""
        scale = ANGLE["rad" if self.radians else "deg"]
        h = self.values.get("h", np.zeros(len(self.t)))
        return np.stack([self.values["lat"] * scale, self.values["lon"] * scale, h], -1)


def is_numerical(path: Path, name: str, plain: Plain | None) -> bool:
    """Whether a column holds only numbers and blanks."""
    if plain is not None:
        return name in plain.columns
    try:
        return len(read_table(path, (name,))) > 0
    except RecordingError:
        return False


def read_sensor(
    path: Path, columns: matching.FileColumns, role: str, plain: Plain | None, clock: Guess | None = None
) -> Source:
    """The columns of one sensor: rows complete in what it needs, in order of time; `clock` is their unit, if known."""
    inertial = role not in (*PLACED, "odometer", "barometer")
    of = _read_columns(path, columns, role, plain)
    needed = [name for name in WANTED[role][: _NEEDED.get(role, len(WANTED[role]))] if name in of.names]
    whole: NDArray[np.bool_] = np.asarray(np.isfinite(of.table.stack(*needed)).all(-1))
    counted = False
    if role in PLACED:
        whole = _blank_unknown(of, whole)
        counted = convert_whole_degrees(of)
        convert_minutes(of)
        convert_variances(of)
        whole = _mask_places(of, whole)
    if whole.sum() < 2:
        raise RecordingError(
            f"{path}: fewer than two rows hold all of {', '.join(of.names[n] for n in needed)}", key="table.few_rows"
        )
    of.take(whole)
    weeks = of.values.get("week", np.empty(0))
    of.drop("week")
    _convert_clock(of)
    stated = matching.find_stated_unit(columns, "t", "t")
    unit = clock or guesses.guess_time_unit(of.values["t"], stated, inertial)
    second = TIME_UNITS[str(unit.value)]
    _sort_by_time(of, second, inertial)
    repeated = _drop_repeated(of)
    if role == "gnss":
        _convert_fixes(of, second, counted)
    convert_small_units(of)
    if inertial:
        divide_increments(of, second)
    _refuse_pauses(of)
    if role == "odometer" and "speed" not in of.values:
        _average_wheels(of)
    week, unit = _find_week(of, weeks, unit)
    if of.plain is not None:  # what is written is whole, so nobody tells later
        for some, what in ((~whole, "without all of its numbers"), (repeated, "with the time of another")):
            if some.any():
                of.say(f"{some.sum()} of {len(some)} rows {what} left out")
    found = matching.FileColumns(of.names, of.units)
    return Source(path, found, of.values, t_unit=unit, week=week, plain=of.plain)


def _read_columns(path: Path, columns: matching.FileColumns, role: str, plain: Plain | None) -> LogColumns:
    """What a sensor can have of a table's columns, as they are in the file."""
    names = {ours: theirs for ours, theirs in columns.names.items() if ours in WANTED[role]}
    if role in ("imu", *PLACED) and "week" in columns.names:
        names["week"] = columns.names["week"]
    for extra in ("type", "satellites", "resid_rms_m", "geoid", "week"):
        if extra in names and not is_numerical(path, names[extra], plain):
            del names[extra]
    if plain is None:
        table = read_table(path, tuple(names), (), names)
    else:
        own = {ours: plain.columns[theirs] for ours, theirs in names.items()}
        table = Table(path, own, names, np.arange(len(own["t"])))
    for ours in names:
        if role != "odometer" and len(bad := np.flatnonzero(np.isinf(table[ours]))):
            raise RecordingError(
                f"{table.describe_place(bad[0], ours)}: the value is infinite; leave it blank", key="table.not_finite"
            )
    return LogColumns(table, dict(names), columns.units, plain)


def _blank_unknown(of: LogColumns, whole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Blank what a phone does not know; which of the `whole` rows (N,) have a known position.

    Raises
    ------
    RecordingError
        If all of these are at 0, 0.
    """
    of.table, known = blank_unknown(of.table)
    whole = whole & known
    fixed = (of.values["lat"] != 0.0) | (of.values["lon"] != 0.0)
    if whole.any() and not (whole & fixed).any():
        raise RecordingError(
            f"{of.table.path}: every row is at 0, 0: the receiver had no fix, or its positions are in other columns",
            key="draft.no_fix",
        )
    return whole


def _mask_places(of: LogColumns, whole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the `whole` rows (N,) are on the Earth."""
    lat, lon = of.values["lat"], of.values["lon"]
    placed = whole.copy()
    placed[whole] = find_places(lat[whole], lon[whole], ANGLE["deg"])
    check_angles(of.table.take(placed), ANGLE["deg"], "GNSS")
    return placed


def _convert_clock(of: LogColumns) -> None:
    """Times of day in digits, and days of a spreadsheet, in s."""
    t, name = of.values["t"], of.names["t"]
    if (seconds := read_clock_seconds(t)) is not None:
        words = f"times of day of '{name}', hhmmss, as s since midnight"
        of.plain = replace(add_words(of.plain, words), daily=name)
    elif (seconds := read_serial_days(t)) is not None:
        of.say(f"days of '{name}', as a spreadsheet counts them, as Unix time in s; CHECK: taken as UTC")
    if seconds is not None:
        of.change("t", seconds)


def _sort_by_time(of: LogColumns, second: float, inertial: bool) -> None:
    """Rows in order on a clock that goes on, those of an IMU's packets at the times of their own."""
    if (later := find_restarts(of.values["t"], second)) is not None:
        of.change("t", of.values["t"] + later)
    of.take(np.argsort(of.values["t"], kind="stable"))
    if inertial and (spread := spread_packets(second * of.values["t"], find_repeats(of.values))) is not None:
        of.change("t", spread[0] / second)


def _drop_repeated(of: LogColumns) -> NDArray[np.bool_]:
    """Keep one row of each time; which rows (N,) were left out."""
    where, t = f"{of.table.path}, column '{of.names['t']}'", of.values["t"]
    repeated = find_repeated(where, t)
    if np.count_nonzero(~repeated) < 2:
        raise RecordingError(
            f"{where}: every row has the time {t[0]:.10g}; log it with milliseconds", key="table.times_repeated"
        )
    of.take(~repeated)
    return repeated


def _convert_fixes(of: LogColumns, second: float, counted: bool) -> None:
    """One row of each fix, courses in deg, and velocities in m/s if places are `counted` in whole numbers."""
    of.take(mask_new_fixes(of.values))
    values = of.values
    if "course" in values and is_course_in_radians(values["lat"], values["lon"], values["course"]):
        of.change("course", np.degrees(values["course"]))
        of.say(f"'{of.names['course']}' is in rad, by the positions; made deg")
    if counted:
        convert_whole_velocities(of, second)


def _refuse_pauses(of: LogColumns) -> None:
    t = of.values["t"]
    step = np.diff(t)
    if step.sum() > _PAUSES * len(step) * np.median(step):
        k = int(np.argmax(step))
        raise RecordingError(
            f"{of.table.path}, {of.names['t']}: the stamps jump from {t[k]:.12g} to {t[k + 1]:.12g}, which "
            "no log does; take out what lies beyond",
            key="table.time_jump",
        )


def _average_wheels(of: LogColumns) -> None:
    """The speed, the mean of the rear wheels, else of those there are."""
    rear = [w for w in WHEELS[2:] if w in of.values] or [w for w in WHEELS if w in of.values]
    of.change("speed", np.mean([of.values[w] for w in rear], axis=0))
    of.units = {**of.units, "speed": of.units.get(rear[0], "")}


def _find_week(of: LogColumns, weeks: Array, unit: Guess) -> tuple[int | None, Guess]:
    """The GPS week of the first row, 0 where stamps count from the GPS epoch, and the unit of these."""
    if len(weeks) and weeks[0] > 0 and np.isfinite(weeks[0]):
        return int(weeks[0]), unit
    name = of.names["t"]
    if "gps" in name.lower() and _are_gps_seconds(of.values["t"] * TIME_UNITS[str(unit.value)]):
        return 0, replace(unit, why=f"as s since the GPS epoch '{name}' is then a date in the past")
    return None, unit


def _are_gps_seconds(t: Array) -> bool:
    """Whether stamps of a receiver (s) may count from the GPS epoch: as such they are dates of this century, and not
    of the future. Of those that are dates in Unix time too `sources` decides by the other logs.
    """
    return float(t[0]) + GPS_TO_UNIX > UNIX and float(t[-1]) + GPS_TO_UNIX < time()
