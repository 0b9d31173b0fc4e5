"""The logs that a draft is made of: which sensor each holds, and its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.timescales import GPS_TO_UNIX
from graphnav.recording import Gnss, Imu, Odometer
from graphnav.recording.draft import columns as matching
from graphnav.recording.draft import guesses, motion
from graphnav.recording.draft.guesses import Guess
from graphnav.recording.draft.plain import DAY, Plain, read_plain, seconds_of_clock
from graphnav.recording.formats import formats
from graphnav.recording.formats.folder import other_log
from graphnav.recording.formats.registry import Log
from graphnav.recording.formats.repair import new_fixes
from graphnav.recording.formats.schema import SPEED, WHEELS
from graphnav.recording.formats.table import Table, first_rows, read_header, read_table
from graphnav.sensors.tables import ANGLE, TIME

JOINED = "imu.csv.gz"  # the file that is made of a gyro's and an accelerometer's

_WANTED = {
    "imu": ("t", "gx", "gy", "gz", "ax", "ay", "az"),
    "gyro": ("t", "gx", "gy", "gz"),
    "accel": ("t", "ax", "ay", "az"),
    "gnss": (
        "t",
        "lat",
        "lon",
        "h",
        "sd_e",
        "sd_n",
        "sd_u",
        "ve",
        "vn",
        "vu",
        "vd",
        "speed",
        "course",
        "type",
        "satellites",
    ),
    "odometer": ("t", "speed", *WHEELS),
    "gravity": ("t", "pull_x", "pull_y", "pull_z"),
}
_TABLES = (".csv", ".csv.gz", ".txt", ".tsv", ".dat", ".asc", ".log")  # of a folder these are looked at
_PAUSES = 1000.0  # times as long as all of its rows together a log may last
_NEEDED = {"gnss": 4, "odometer": 2}  # of those, how many must be there in a row


@dataclass(eq=False)
class Source:
    """One sensor's log: columns by our names in the file's units, or the log of a program that is known."""

    path: Path
    columns: matching.Columns = field(default_factory=lambda: matching.Columns({}))
    values: dict[str, Array] = field(default_factory=dict)
    log: Log | None = None
    t_unit: Guess = field(default_factory=lambda: Guess("s", ""))
    joined_from: tuple[Path, Path] | None = None  # a gyro's and an accelerometer's file, whose rows are put together
    plain: Plain | None = None  # a table that is no CSV file of numbers, of which one is made

    def __len__(self) -> int:
        return len(self.values["t"]) if self.log is None else len(next(s.t for s in self._sensors))

    @property
    def _sensors(self) -> list[Imu | Gnss | Odometer]:
        log = self.log
        return [] if log is None else [s for s in (log.gnss, log.imu, log.odometer) if s is not None]

    @property
    def t(self) -> Array:
        """Times of the rows of a CSV file, s."""
        return self.values["t"] * TIME[str(self.t_unit.value)]

    def stack(self, *names: str) -> Array:
        """Columns side by side, (N, len(names))."""
        return np.stack([self.values[n] for n in names], -1)

    def find_unit(self, ours: str, kind: str) -> str | None:
        """The unit that a column's name states."""
        return matching.unit_of(self.columns, ours, kind)

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


@dataclass
class LogsFound:
    """What logs hold, by sensor, and in words which of them are left out."""

    sensors: dict[str, Source]
    left_out: list[str]


def sources(paths: Sequence[Path], topics: Sequence[str] = ()) -> LogsFound:
    """What the logs hold, by sensor; of a folder all that is in it. What is no sensor's log is left out.

    Raises
    ------
    RecordingError
        If the only file holds nothing that is known, if one of a sensor cannot be read, if two hold the same, or none
        an IMU.
    """
    files = [file for path in paths for file in _files(path)]
    every: dict[str, list[Source]] = {}
    left: list[str] = []
    nothing: list[str] = []
    refused: list[str] = []  # why some are no tables
    for path in files:
        try:
            found = _look(path, topics)
        except _NoSensor as error:
            if len(files) == 1:
                raise
            nothing.append(path.name if path.exists() else str(error))
            refused += [str(error)] if isinstance(error.__cause__, RecordingError) else []
            continue
        for sensor, source in found.items():
            every.setdefault(sensor, []).append(source)
    if nothing:
        left.append(f"{', '.join(nothing)}: no sensor is recognised in the columns")
    sensors = {sensor: chosen for sensor, some in every.items() if (chosen := _choose(sensor, some, left)) is not None}
    if "imu" not in sensors and "gyro" in sensors:
        if "accel" not in sensors and "accel" in every and "gravity" in sensors:
            sensors["accel"] = _with_gravity(every["accel"][0], sensors["gravity"], left)
        if "accel" in sensors:
            sensors["imu"] = _join_imu(sensors["gyro"], sensors["accel"])
            if (pull := every.get("gravity")) and sensors["accel"] in every["accel"]:
                left.append(f"{pull[0].path.name}: {sensors['accel'].path.name} has gravity in it")
        elif "accel" in every:
            worst = every["accel"][0]
            guesses.accel_unit(worst.path, worst.stack("ax", "ay", "az"), worst.find_unit("ax", "accel"))
    if "imu" not in sensors:
        there = ", ".join(sensors) or "nothing"
        unread = f" ({refused[0]})" if refused else ""
        raise RecordingError(
            f"{paths[0]}: no IMU in these logs (found: {there}); three gyro and three force columns are one{unread}",
            key="draft.no_imu",
        )
    _date_times_of_day(sensors)
    parts = [s.path.name for name in ("gyro", "accel", "gravity") for s in every.get(name, ())]
    if "imu" in every and parts:
        left.append(f"{', '.join(parts)}: {sensors['imu'].path.name} holds both")
    return LogsFound({name: sensors[name] for name in ("imu", "gnss", "odometer") if name in sensors}, left)


def _date_times_of_day(sensors: dict[str, Source]) -> None:
    """Times of day become those of the date of another log, if one has dates."""
    dates = {s.path: unix for s in sensors.values() if (unix := _unix_start(s)) is not None}
    for source in sensors.values():
        if dates and source.plain is not None and source.plain.daily == source.columns.names["t"]:
            path, begin = next(iter(dates.items()))
            days = round((begin - float(source.t[0])) / DAY)
            source.values["t"] = source.values["t"] + DAY * days
            words = f"{source.plain.words}; CHECK: taken as UTC, of the date of {path.name}"
            source.plain = replace(source.plain, words=words)


def _unix_start(source: Source) -> float | None:
    """Unix time of the first row of a log that knows its date, s."""
    if source.log is None:
        return float(source.t[0]) if guesses.is_date(source.t) else None
    begin = next(sensor.t[0] for sensor in source._sensors)
    return None if source.log.gps_zero is None else float(source.log.gps_zero + begin + GPS_TO_UNIX)


def _files(path: Path) -> list[Path]:
    """A log by itself, or those in a folder that is none."""
    if not path.is_dir() or any(known.load is not None and known.recognises(path) for known in formats().values()):
        return [path]
    every = [p for p in path.iterdir() if not p.name.startswith(".")]
    made = {JOINED, "recording.toml"}  # by an earlier draft
    made |= {plain_name(p, sensor) for p in every for sensor in _WANTED}
    inside = sorted(p for p in every if p.name not in made)
    logs = [p for p in inside if p.name.lower().endswith(_TABLES) or _is_known(p)]
    if not logs:
        raise RecordingError(
            f"{path}: no log in this folder: no CSV file, and none of a kind that is known", key="draft.no_log"
        )
    return logs


def plain_name(path: Path, sensor: str) -> str:
    """The CSV file that is made of a sensor's part of a table that is none."""
    return f"{path.stem}-{sensor}.csv.gz"


def _is_known(path: Path) -> bool:
    return path.suffix != ".toml" and any(
        known.load is not None and known.recognises(path) for known in formats().values()
    )


def _choose(sensor: str, some: list[Source], left: list[str]) -> Source | None:
    """The log to use of several of one sensor; what is left out, and why, is put into words."""
    if sensor == "accel":
        with_gravity = [s for s in some if _has_gravity(s)]
        if len(with_gravity) < len(some) and with_gravity:
            names = ", ".join(s.path.name for s in some if s not in with_gravity)
            left.append(f"{names}: accelerations without gravity")
        some = with_gravity
    if not some:
        return None
    if sensor == "imu" and len(some) > 1:
        raise RecordingError(
            f"{some[1].path}: a second imu, after {some[0].path}; name only one of them", key="draft.two_imus"
        )
    # what the system has not corrected yet comes second: it is the same, in other units on some phones
    best = min(some, key=lambda s: ("uncalibrated" in s.path.name.lower(), -len(s)))
    if sensor == "odometer":
        best = some[0]  # the speed of a receiver beside a wheel's
    others = [s.path.name for s in some if s is not best and s.path != best.path]
    if others:
        left.append(f"{', '.join(others)}: a second {sensor}, beside {best.path.name}")
    return best


def _has_gravity(source: Source) -> bool:
    try:
        guesses.accel_unit(source.path, source.stack("ax", "ay", "az"), source.find_unit("ax", "accel"))
    except RecordingError:
        return False
    return True


def _with_gravity(accel: Source, gravity: Source, left: list[str]) -> Source:
    """Accelerations without gravity and the gravity that a phone took out of them, put together again."""
    values = {"t": accel.values["t"]}
    for x in "xyz":
        pull = np.interp(accel.t, gravity.t, gravity.values[f"pull_{x}"])
        values[f"a{x}"] = accel.values[f"a{x}"] + pull
    left.append(f"{accel.path.name} is without gravity: the forces are the sum of it and {gravity.path.name}")
    whole = Source(accel.path, accel.columns, values, t_unit=accel.t_unit)
    guesses.accel_unit(accel.path, whole.stack("ax", "ay", "az"), None)
    return whole


def _join_imu(gyro: Source, accel: Source) -> Source:
    """One IMU of two files, as phones write them: the forces interpolated to the times of the rates, in s."""
    t, at = gyro.t, accel.t
    inside = (t >= at[0]) & (t <= at[-1])
    if inside.sum() < 2:
        raise RecordingError(f"{gyro.path} and {accel.path}: do not overlap in time", key="draft.no_overlap")
    values = {"t": t[inside], **{f"g{x}": gyro.values[f"g{x}"][inside] for x in "xyz"}}
    values |= {f"a{x}": np.interp(t[inside], at, accel.values[f"a{x}"]) for x in "xyz"}
    units = {k: u for s in (gyro, accel) for k, u in s.columns.units.items() if k != "t"}
    joined = Source(gyro.path, matching.Columns({name: name for name in values}, units), values)
    joined.joined_from = (gyro.path, accel.path)
    joined.t_unit = Guess("s", f"made of {gyro.columns.names['t']} in {gyro.t_unit.value}: {gyro.t_unit.why}")
    return joined


def fixes(source: Source) -> tuple[Array, Array, Array | None]:
    """Times (N,), positions (N, 3) and horizontal velocities (N, 2), or None, of a GNSS log."""
    if source.log is not None:
        gnss = source.log.gnss
        assert gnss is not None
        return gnss.t, gnss.llh, None if gnss.v is None else gnss.v[:, :2]
    values = source.values
    if {"ve", "vn"} <= values.keys():
        return source.t, source.llh, source.stack("ve", "vn") * SPEED[source.find_unit("ve", "speed") or "m/s"]
    if {"speed", "course"} <= values.keys():
        speed = values["speed"] * SPEED[str(fix_speed_unit(source).value)]
        course = values["course"] * ANGLE["rad" if source.find_unit("course", "angle") == "rad" else "deg"]
        return source.t, source.llh, np.stack([speed * np.sin(course), speed * np.cos(course)], -1)
    return source.t, source.llh, None


def fix_speed_unit(source: Source) -> Guess:
    """The unit of a receiver's speed, by its positions."""
    course = motion.course_of(source.t, source.llh, None)
    return guesses.speed_unit(source.t, source.values["speed"], course, source.find_unit("speed", "speed"))


class _NoSensor(RecordingError):
    """A file that holds no sensor that is known."""


def _look(path: Path, topics: Sequence[str] = ()) -> dict[str, Source]:
    """The sensors of one file."""
    if not path.exists():
        raise RecordingError(f"{path}: no such file", key="file.missing")
    log = other_log(path, topics)
    if log is not None:
        return {s: Source(path, log=log) for s in ("imu", "gnss", "odometer") if getattr(log, s) is not None}
    plain = read_plain(path) if path.is_file() else None
    try:
        header = read_header(path) if plain is None else list(plain.columns)
    except RecordingError as error:
        raise _NoSensor(str(error), key=error.key) from error
    columns = matching.match(header, path.name.split(".")[0])
    sensor = columns.sensor
    if sensor is None:
        raise _NoSensor(
            f"{path}, line 1: no sensor is recognised in the columns {', '.join(header[:12])}; "
            "rename them (t; gx gy gz ax ay az; lat lon h; speed)",
            key="draft.no_columns",
        )
    if plain is None:
        columns = _with_clock(path, header, columns)
    elif stamps := plain.dated or (plain.daily if columns.names["t"] == plain.daily else None):
        units = {ours: unit for ours, unit in columns.units.items() if ours != "t"}
        columns = matching.Columns({**columns.names, "t": stamps}, units)
    roles = [sensor]
    if sensor == "imu" and {"lat", "lon"} <= columns.names.keys():
        roles.append("gnss")
    elif sensor == "imu" and "speed" in columns.names:
        roles.append("odometer")
    return {role: _read(path, columns, role, plain) for role in roles}


def _stamps(cells: list[str]) -> Array | None:
    """Stamps that rise with every row, as numbers; None where these are none."""
    try:
        t = np.array([float(cell) for cell in cells])
    except ValueError:
        return None
    return t if len(t) > 1 and (np.diff(t) > 0.0).all() else None


def _with_clock(path: Path, header: list[str], columns: matching.Columns) -> matching.Columns:
    """The columns with the one of times that dates the rows, if one of several does, else with one of numbers."""
    several = matching.clocks(header)
    if len(several) < 2:
        return columns
    best = columns.names["t"]
    rows = first_rows(path, 100)
    cells = {name: [row[header.index(name)] for row in rows if len(row) == len(header)] for name in several}
    stamps = {name: t for name in several if (t := _stamps(cells[name])) is not None}
    if best not in stamps:  # dates in words
        best = next(iter(stamps), best)
    best = next((name for name, t in stamps.items() if guesses.is_date(t)), best)
    if best == columns.names["t"]:
        return columns
    units = {ours: unit for ours, unit in columns.units.items() if ours != "t"}
    if unit := matching.split_unit(best)[1]:
        units["t"] = unit
    return matching.Columns({**columns.names, "t": best}, units)


def _numbers(path: Path, name: str, plain: Plain | None) -> bool:
    """Whether a column holds numbers and blanks alone."""
    if plain is not None:
        return name in plain.columns
    try:
        return len(read_table(path, (name,))) > 0
    except RecordingError:
        return False


def _read(path: Path, columns: matching.Columns, role: str, plain: Plain | None) -> Source:
    """The columns of one sensor, rows that hold all it needs, in order of time."""
    wanted = _WANTED[role]
    names = {ours: theirs for ours, theirs in columns.names.items() if ours in wanted}
    for extra in ("type", "satellites"):
        if extra in names and not _numbers(path, names[extra], plain):
            del names[extra]
    if plain is None:
        table = read_table(path, tuple(names), (), names)
    else:
        own = {ours: plain.columns[theirs] for ours, theirs in names.items()}
        table = Table(path, own, names, np.arange(len(own["t"])))
    needed = [n for n in wanted[: _NEEDED.get(role, len(wanted))] if n in names]
    whole = np.isfinite(table.stack(*needed)).all(-1)
    if role == "gnss":
        whole &= (table["lat"] != 0.0) | (table["lon"] != 0.0)  # as it will be read: no fix
    if whole.sum() < 2:
        raise RecordingError(
            f"{path}: fewer than two rows hold all of {', '.join(names[n] for n in needed)}", key="table.few_rows"
        )
    values = {ours: table[ours][whole] for ours in names}
    if (seconds := seconds_of_clock(values["t"])) is not None:
        words = f"times of day of '{names['t']}', hhmmss, as s since midnight"
        values["t"], plain = seconds, Plain({}, words, daily=names["t"])
    order = np.argsort(values["t"], kind="stable")
    order = order[np.concatenate([[True], np.diff(values["t"][order]) > 0])]
    values = {ours: v[order] for ours, v in values.items()}
    if role == "gnss":
        new = new_fixes(values)  # as it will be read
        values = {ours: v[new] for ours, v in values.items()}
    step = np.diff(values["t"])
    if step.sum() > _PAUSES * len(step) * np.median(step):
        k = int(np.argmax(step))
        raise RecordingError(
            f"{path}, {names['t']}: the stamps jump from {values['t'][k]:g} to {values['t'][k + 1]:g}, which no log "
            "does; take out what lies beyond",
            key="table.time_jump",
        )
    if role == "odometer" and "speed" not in values:  # as it will be read
        rear = [w for w in WHEELS[2:] if w in values] or [w for w in WHEELS if w in values]
        values["speed"] = np.mean([values[w] for w in rear], axis=0)
        columns = matching.Columns(columns.names, {**columns.units, "speed": columns.units.get(rear[0], "")})
    source = Source(path, matching.Columns(names, columns.units), values, plain=plain)
    inertial = role not in ("gnss", "odometer")
    source.t_unit = guesses.time_unit(source.values["t"], source.find_unit("t", "t"), inertial)
    return source
