"""One log of a draft: its sensors and its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import time

import numpy as np

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
from graphnav.recording.draft.motion import is_course_in_radians
from graphnav.recording.draft.plain import Plain, add_words, read_plain
from graphnav.recording.formats import columns as matching
from graphnav.recording.formats.courses import blank_unknown
from graphnav.recording.formats.folder import read_other_log
from graphnav.recording.formats.places import check_angles, find_places
from graphnav.recording.formats.registry import Log
from graphnav.recording.formats.repair import mask_new_fixes
from graphnav.recording.formats.schema import WHEELS
from graphnav.recording.formats.stamps import find_repeated, find_repeats, spread_packets
from graphnav.recording.formats.table import Table, read_column_names, read_first_rows, read_table
from graphnav.sensors.tables import ANGLE, TIME_UNITS

_PLACE = ["t", "lat", "lon", "h"]
_VELOCITY = ["ve", "vn", "vu", "vd", "sd_ve", "sd_vn", "sd_vu", "speed", "course"]
WANTED = {
    "imu": ("t", "gx", "gy", "gz", "ax", "ay", "az"),
    "gyro": ("t", "gx", "gy", "gz"),
    "accel": ("t", "ax", "ay", "az"),
    "gnss": (*_PLACE, "sd_e", "sd_n", "sd_u", *_VELOCITY, "type", "satellites", "resid_rms_m", "geoid"),
    "truth": (*_PLACE, *_VELOCITY[:4], *matching.ATTITUDE),
    "odometer": ("t", "speed", *WHEELS),
    "barometer": ("t", "pressure"),
    "gravity": ("t", "pull_x", "pull_y", "pull_z"),
}
CALLED = "t; gx gy gz ax ay az; lat lon h; speed"  # names that all sensors' columns can have
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


class NoSensorError(RecordingError):
    """A file without a known sensor."""


def read_log(path: Path, topics: Sequence[str] = ()) -> dict[str, Source]:
    """The sensors of one file."""
    if not path.exists():
        raise RecordingError(f"{path}: no such file", key="file.missing")
    log = read_other_log(path, topics)
    if log is not None:
        return {s: Source(path, log=log) for s in ("imu", "gnss", "odometer") if getattr(log, s) is not None}
    header, columns, plain, wheels = read_header(path)
    sensor = columns.sensor
    assert sensor is not None
    roles = [sensor]
    if sensor == "imu" and {"lat", "lon"} <= columns.names.keys():
        roles.append("gnss")
    elif sensor == "imu" and "speed" in columns.names:
        roles.append("odometer")
    of = dict.fromkeys(roles, columns)
    if wheels := [name for name in wheels if _read_numbers(path, name, plain)]:
        own = matching.match_columns([columns.names["t"], *wheels])
        clock = {"t": columns.units["t"]} if "t" in columns.units else {}
        of["odometer"] = matching.FileColumns({**own.names, "t": columns.names["t"]}, {**own.units, **clock})
    found: dict[str, Source] = {}
    for role, some in of.items():  # whose clock is that of the first, whose rows are the most
        found[role] = read_sensor(path, some, role, plain, found[sensor].t_unit if found else None)
    if sensor == "imu" and not has_gravity(found["imu"]):
        found["imu"], of["imu"] = _find_gravity(path, header, columns, plain, found["imu"])
    taken = {
        theirs
        for role, source in found.items()
        for ours, theirs in of[role].names.items()
        if ours in source.values or ours in "xyz"
    } | {columns.names.get("week")}
    found[sensor].unused = tuple(name for name in header if name and name not in taken)
    for role, source in found.items():
        source.second = _find_second(header, columns, WANTED[role][1:3] if role == "gnss" else WANTED[role][1:])
    return found


def read_header(path: Path) -> tuple[list[str], matching.FileColumns, Plain | None, list[str]]:
    """The names of a table, those of a sensor's columns, the table if it is no plain CSV file, and those of wheels.

    Raises
    ------
    NoSensorError
        If it holds no known sensor.
    """
    plain = read_plain(path) if path.is_file() else None
    try:
        header = read_column_names(path) if plain is None else list(plain.columns)
    except RecordingError as error:
        words = f"{path}: no table of a sensor is recognised in it" if error.key == "table.separator" else str(error)
        raise NoSensorError(words, key=error.key) from error
    wheels = matching.find_wheels(header)
    columns = matching.match_columns([name for name in header if name not in wheels], path.name.split(".")[0])
    sensor = columns.sensor
    if sensor is None and "t" not in columns.names and matching.FileColumns({**columns.names, "t": ""}).sensor:
        raise _make_times_error(path, header, {} if plain is None else plain.words_in)
    if sensor is None:
        raise NoSensorError(
            f"{path}, line 1: no sensor is recognised in the columns {', '.join(header[:12])}; rename them ({CALLED})",
            key="draft.no_columns",
        )
    if plain is None:
        columns = _add_clock(path, header, columns)
    elif stamps := plain.dated or (plain.daily if columns.names["t"] == plain.daily else None):
        units = {ours: unit for ours, unit in columns.units.items() if ours != "t"}
        columns = matching.FileColumns({**columns.names, "t": stamps}, units)
    return header, columns, plain, wheels


def has_gravity(source: Source) -> bool:
    """Whether the forces of a log are those of a raw accelerometer, in some unit."""
    try:
        guesses.guess_accel_unit(source.path, source.stack("ax", "ay", "az"), source.find_unit("ax", "accel"))
    except RecordingError:
        return False
    return True


def _find_gravity(
    path: Path, header: list[str], columns: matching.FileColumns, plain: Plain | None, bare: Source
) -> tuple[Source, matching.FileColumns]:
    """An IMU whose forces are without gravity: with the table's other forces, or plus its columns of gravity."""
    axes = ("ax", "ay", "az")
    rest = [name for name in header if name not in [columns.names[ours] for ours in axes]]
    other = matching.match_columns(rest)
    if set(axes) <= other.names.keys():
        both = matching.FileColumns(
            {**columns.names, **{ours: other.names[ours] for ours in axes}},
            {
                ours: unit
                for ours, unit in (columns.units | other.units).items()
                if ours not in axes or ours in other.units
            },
        )
        source = read_sensor(path, both, "imu", plain)
        if has_gravity(source):
            return source, both
    pull = matching.find_gravity(rest)
    if len(pull) == len(axes):
        sources = [
            read_sensor(path, matching.FileColumns({**columns.names, ours: theirs}, columns.units), "imu", plain)
            for ours, theirs in zip(axes, pull, strict=True)
        ]
        values = {ours: bare.values[ours] + one.values[ours] for ours, one in zip(axes, sources, strict=True)}
        names = {**bare.columns.names, **{ours: ours for ours in axes}}
        words = f"forces are the sum of '{columns.names['ax']}' and '{pull[0]}', and so on"
        whole = replace(
            bare,
            columns=replace(bare.columns, names=names),
            values={**bare.values, **values},
            plain=add_words(bare.plain, words),
        )
        if has_gravity(whole):
            return whole, matching.FileColumns({**columns.names, **dict(zip("xyz", pull, strict=True))}, columns.units)
    return bare, columns


def _are_gps_seconds(t: Array) -> bool:
    """Whether stamps of a receiver (s) may count from the GPS epoch: as such they are dates of this century, and not
    of the future. Of those that are dates in Unix time too `sources` decides by the other logs.
    """
    return float(t[0]) + GPS_TO_UNIX > UNIX and float(t[-1]) + GPS_TO_UNIX < time()


def _find_second(header: list[str], columns: matching.FileColumns, core: Sequence[str]) -> str:
    """Name the columns of a second sensor of the same kind, recognised by its `core`; '' if there is none."""
    rest = matching.match_columns([name for name in header if name not in columns.names.values()]).names
    names = [rest[ours] for ours in core if ours in rest]
    return f"{names[0]} to {names[-1]}" if len(names) == len(core) else ""


def _make_times_error(path: Path, header: list[str], words: dict[str, str]) -> NoSensorError:
    """The error of a sensor's table without times: none of its columns is called so, or its cells are no numbers."""
    clock = matching.match_columns(list(words)).names.get("t")
    if clock is not None:
        return NoSensorError(f"{path}, column '{clock}': '{words[clock][:40]}' is no time", key="draft.no_time")
    names = ", ".join(header[:12])
    return NoSensorError(
        f"{path}, line 1: no times are recognised in the columns {names}; call theirs t", key="draft.no_time"
    )


def _parse_stamps(cells: list[str]) -> Array | None:
    """Increasing stamps as numbers; None where these are none."""
    try:
        t = np.array([float(cell) for cell in cells])
    except ValueError:
        return None
    return t if len(t) > 1 and (np.diff(t) > 0.0).all() else None


def _add_clock(path: Path, header: list[str], columns: matching.FileColumns) -> matching.FileColumns:
    """The columns with the time column that dates the rows, if one of several does, else with a numerical one."""
    several = matching.find_clocks(header)
    if len(several) < 2:
        return columns
    best = columns.names["t"]
    rows = read_first_rows(path, 100)
    cells = {name: [row[header.index(name)] for row in rows if len(row) == len(header)] for name in several}
    stamps = {name: t for name in several if (t := _parse_stamps(cells[name])) is not None}
    if best not in stamps:  # dates in words
        best = next(iter(stamps), best)
    best = next((name for name, t in stamps.items() if guesses.is_date(t)), best)
    if best == columns.names["t"]:
        return columns
    columns.names.pop("week", None)
    units = {ours: unit for ours, unit in columns.units.items() if ours != "t"}
    if unit := matching.split_unit(best)[1]:
        units["t"] = unit
    return matching.FileColumns({**columns.names, "t": best}, units)


def _read_numbers(path: Path, name: str, plain: Plain | None) -> bool:
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
    wanted = WANTED[role]
    names = {ours: theirs for ours, theirs in columns.names.items() if ours in wanted}
    if role in ("imu", *PLACED) and "week" in columns.names:
        names["week"] = columns.names["week"]
    for extra in ("type", "satellites", "resid_rms_m", "geoid", "week"):
        if extra in names and not _read_numbers(path, names[extra], plain):
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
    needed = [n for n in wanted[: _NEEDED.get(role, len(wanted))] if n in names]
    whole = np.asarray(np.isfinite(table.stack(*needed)).all(-1))
    if role in PLACED:
        table, known = blank_unknown(table)  # as it will be read
        before = table
        whole &= known
        fixed = (table["lat"] != 0.0) | (table["lon"] != 0.0)
        if whole.any() and not (whole & fixed).any():
            raise RecordingError(
                f"{path}: every row is at 0, 0: the receiver had no fix, or its positions are in other columns",
                key="draft.no_fix",
            )
        table, plain = convert_whole_degrees(table, names, plain)
        counted = table is not before
        table, plain = convert_minutes(table, names, plain)
        table, plain = convert_variances(table, names, plain)
        whole[whole] = find_places(table["lat"][whole], table["lon"][whole], ANGLE["deg"])  # as it will be read
        check_angles(table.take(whole), ANGLE["deg"], "GNSS")
    if whole.sum() < 2:
        raise RecordingError(
            f"{path}: fewer than two rows hold all of {', '.join(names[n] for n in needed)}", key="table.few_rows"
        )
    values = {ours: table[ours][whole] for ours in names}
    names.pop("week", None)
    weeks = values.pop("week", np.empty(0))
    if (seconds := read_clock_seconds(values["t"])) is not None:
        words = f"times of day of '{names['t']}', hhmmss, as s since midnight"
        values["t"], plain = seconds, Plain({}, words, daily=names["t"])
    elif (seconds := read_serial_days(values["t"])) is not None:
        words = f"days of '{names['t']}', as a spreadsheet counts them, as Unix time in s; CHECK: taken as UTC"
        values["t"], plain = seconds, Plain({}, words)
    inertial = role not in (*PLACED, "odometer", "barometer")
    unit = clock or guesses.guess_time_unit(values["t"], matching.find_stated_unit(columns, "t", "t"), inertial)
    if (later := find_restarts(values["t"], scale := TIME_UNITS[str(unit.value)])) is not None:  # as it will be read
        values["t"] = values["t"] + later
    order = np.argsort(values["t"], kind="stable")
    values = {ours: v[order] for ours, v in values.items()}
    if inertial and (spread := spread_packets(scale * values["t"], find_repeats(values))) is not None:
        values["t"] = spread[0] / scale  # as it will be read
    repeated = find_repeated(f"{path}, column '{names['t']}'", values["t"])
    if np.count_nonzero(~repeated) < 2:
        raise RecordingError(
            f"{path}, column '{names['t']}': every row has the time {values['t'][0]:.10g}; log it with milliseconds",
            key="table.times_repeated",
        )
    values = {ours: v[~repeated] for ours, v in values.items()}
    if role == "gnss":
        new = mask_new_fixes(values)  # as it will be read
        values = {ours: v[new] for ours, v in values.items()}
        if "course" in values and is_course_in_radians(values["lat"], values["lon"], values["course"]):
            values["course"] = np.degrees(values["course"])
            words = f"'{names['course']}' is in rad, by the positions; made deg"
            plain = add_words(plain, words)
        if counted:
            plain = convert_whole_velocities(names, values, values["t"] * TIME_UNITS[str(unit.value)], plain)
    columns, names, plain = convert_small_units(columns, names, values, plain)
    if inertial:
        columns, names, plain = divide_increments(columns, names, values, TIME_UNITS[str(unit.value)], plain)
    step = np.diff(values["t"])
    if step.sum() > _PAUSES * len(step) * np.median(step):
        k = int(np.argmax(step))
        raise RecordingError(
            f"{path}, {names['t']}: the stamps jump from {values['t'][k]:.12g} to {values['t'][k + 1]:.12g}, which "
            "no log does; take out what lies beyond",
            key="table.time_jump",
        )
    if role == "odometer" and "speed" not in values:  # as it will be read
        rear = [w for w in WHEELS[2:] if w in values] or [w for w in WHEELS if w in values]
        values["speed"] = np.mean([values[w] for w in rear], axis=0)
        columns = matching.FileColumns(columns.names, {**columns.units, "speed": columns.units.get(rear[0], "")})
    week = int(weeks[0]) if len(weeks) and weeks[0] > 0 and np.isfinite(weeks[0]) else None
    if week is None and "gps" in names["t"].lower() and _are_gps_seconds(values["t"] * TIME_UNITS[str(unit.value)]):
        week, unit = 0, replace(unit, why=f"as s since the GPS epoch '{names['t']}' is then a date in the past")
    if plain is not None:  # what is written is whole, so nobody tells later
        for some, what in ((~whole, "without all of its numbers"), (repeated, "with the time of another")):
            if some.any():
                plain = add_words(plain, f"{some.sum()} of {len(some)} rows {what} left out")
    return Source(path, matching.FileColumns(names, columns.units), values, t_unit=unit, week=week, plain=plain)
