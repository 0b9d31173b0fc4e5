"""The logs that a draft is made of: which sensor each holds, and its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from graphnav.draft import columns as matching
from graphnav.draft import guesses, motion
from graphnav.draft.guesses import Guess
from graphnav.errors import RecordingError
from graphnav.formats.folder import other_log
from graphnav.formats.registry import Log
from graphnav.formats.schema import ANGLE, SPEED, TIME, WHEELS
from graphnav.formats.table import read_header, read_table
from graphnav.rotation import Array

_WANTED = {
    "imu": ("t", "gx", "gy", "gz", "ax", "ay", "az"),
    "gyro": ("t", "gx", "gy", "gz"),
    "accel": ("t", "ax", "ay", "az"),
    "gnss": ("t", "lat", "lon", "h", "sd_e", "sd_n", "sd_u", "ve", "vn", "vu", "vd", "speed", "course", "type"),
    "odometer": ("t", "speed", *WHEELS),
}
_PAUSES = 1000.0  # times as long as all of its rows together a log may last
_NEEDED = {"gnss": 4, "odometer": 2}  # of those, how many must be there in a row


@dataclass
class Source:
    """One sensor's log: columns by our names in the file's units, or the log of a program that is known."""

    path: Path
    columns: matching.Columns = field(default_factory=lambda: matching.Columns({}))
    values: dict[str, Array] = field(default_factory=dict)
    log: Log | None = None
    t_unit: Guess = field(default_factory=lambda: Guess("s", ""))
    joined_from: tuple[Path, Path] | None = None  # a gyro's and an accelerometer's file, whose rows are put together

    @property
    def t(self) -> Array:
        """Times of the rows of a CSV file, s."""
        return self.values["t"] * TIME[str(self.t_unit.value)]

    def stack(self, *names: str) -> Array:
        """Columns side by side, (N, len(names))."""
        return np.stack([self.values[n] for n in names], -1)

    def stated(self, ours: str, kind: str) -> str | None:
        """The unit that a column's name states."""
        return matching.unit_of(self.columns, ours, kind)

    @property
    def radians(self) -> bool:
        """Whether lat and lon are in radians."""
        if stated := self.stated("lat", "angle"):
            return stated == "rad"
        return bool(np.abs(self.values["lat"]).max() < 1.58 and np.abs(self.values["lon"]).max() < 3.15)

    @property
    def llh(self) -> Array:
        """Positions (N, 3) in rad, rad, m; height 0 where there is none."""
        scale = ANGLE["rad" if self.radians else "deg"]
        h = self.values.get("h", np.zeros(len(self.t)))
        return np.stack([self.values["lat"] * scale, self.values["lon"] * scale, h], -1)


def sources(paths: Sequence[Path]) -> dict[str, Source]:
    """What the logs hold, by sensor.

    Raises
    ------
    RecordingError
        If a file cannot be read or holds nothing that is known, if two hold the same, or none an IMU.
    """
    found: dict[str, Source] = {}
    for path in paths:
        for sensor, source in _look(path).items():
            if sensor not in found:
                found[sensor] = source
            elif sensor != "odometer":  # the speed of a receiver beside a wheel's
                raise RecordingError(f"{path}: a second {sensor}, after {found[sensor].path}; name only one of them")
    if "imu" not in found and {"gyro", "accel"} <= found.keys():
        found["imu"] = _joined(found.pop("gyro"), found.pop("accel"))
    if "imu" not in found:
        there = ", ".join(found) or "nothing"
        raise RecordingError(
            f"{paths[0]}: no IMU in these logs (found: {there}); three gyro and three force columns are one"
        )
    return found


def _joined(gyro: Source, accel: Source) -> Source:
    """One IMU of two files, as phones write them: the forces interpolated to the times of the rates, in s."""
    t, at = gyro.t, accel.t
    inside = (t >= at[0]) & (t <= at[-1])
    if inside.sum() < 2:
        raise RecordingError(f"{gyro.path} and {accel.path}: do not overlap in time")
    values = {"t": t[inside], **{f"g{x}": gyro.values[f"g{x}"][inside] for x in "xyz"}}
    values |= {f"a{x}": np.interp(t[inside], at, accel.values[f"a{x}"]) for x in "xyz"}
    units = {k: u for s in (gyro, accel) for k, u in s.columns.units.items() if k != "t"}
    joined = Source(gyro.path, matching.Columns({name: name for name in values}, units), values)
    joined.joined_from = (gyro.path, accel.path)
    return joined


def fixes(source: Source) -> tuple[Array, Array, Array | None]:
    """Times (N,), positions (N, 3) and horizontal velocities (N, 2), or None, of a GNSS log."""
    if source.log is not None:
        gnss = source.log.gnss
        assert gnss is not None
        return gnss.t, gnss.llh, None if gnss.v is None else gnss.v[:, :2]
    values = source.values
    if {"ve", "vn"} <= values.keys():
        return source.t, source.llh, source.stack("ve", "vn") * SPEED[source.stated("ve", "speed") or "m/s"]
    if {"speed", "course"} <= values.keys():
        speed = values["speed"] * SPEED[str(fix_speed_unit(source).value)]
        course = values["course"] * ANGLE["rad" if source.stated("course", "angle") == "rad" else "deg"]
        return source.t, source.llh, np.stack([speed * np.sin(course), speed * np.cos(course)], -1)
    return source.t, source.llh, None


def fix_speed_unit(source: Source) -> Guess:
    """The unit of a receiver's speed, by its positions."""
    course = motion.course_of(source.t, source.llh, None)
    return guesses.speed_unit(source.t, source.values["speed"], course, source.stated("speed", "speed"))


def _look(path: Path) -> dict[str, Source]:
    """The sensors of one file."""
    if not path.exists():
        raise RecordingError(f"{path}: no such file")
    log = other_log(path)
    if log is not None:
        return {s: Source(path, log=log) for s in ("imu", "gnss", "odometer") if getattr(log, s) is not None}
    header = read_header(path)
    columns = matching.match(header, path.name.split(".")[0])
    sensor = columns.sensor
    if sensor is None:
        raise RecordingError(
            f"{path}, line 1: no sensor is recognised in the columns {', '.join(header[:12])}; "
            "rename them (t; gx gy gz ax ay az; lat lon h; speed)"
        )
    roles = [sensor]
    if sensor == "imu" and {"lat", "lon"} <= columns.names.keys():
        roles.append("gnss")
    elif sensor == "imu" and "speed" in columns.names:
        roles.append("odometer")
    return {role: _read(path, columns, role) for role in roles}


def _numbers(path: Path, name: str) -> bool:
    """Whether a column holds numbers and blanks alone."""
    try:
        return len(read_table(path, (name,))) > 0
    except RecordingError:
        return False


def _read(path: Path, columns: matching.Columns, role: str) -> Source:
    """The columns of one sensor, rows that hold all it needs, in order of time."""
    wanted = _WANTED[role]
    names = {ours: theirs for ours, theirs in columns.names.items() if ours in wanted}
    if "type" in names and not _numbers(path, names["type"]):
        del names["type"]
    table = read_table(path, tuple(names), (), names)
    needed = [n for n in wanted[: _NEEDED.get(role, len(wanted))] if n in names]
    whole = np.isfinite(table.stack(*needed)).all(-1)
    if whole.sum() < 2:
        raise RecordingError(f"{path}: fewer than two rows hold all of {', '.join(names[n] for n in needed)}")
    values = {ours: table[ours][whole] for ours in names}
    order = np.argsort(values["t"], kind="stable")
    order = order[np.concatenate([[True], np.diff(values["t"][order]) > 0])]
    values = {ours: v[order] for ours, v in values.items()}
    step = np.diff(values["t"])
    if step.sum() > _PAUSES * len(step) * np.median(step):
        k = int(np.argmax(step))
        raise RecordingError(
            f"{path}, {names['t']}: the stamps jump from {values['t'][k]:g} to {values['t'][k + 1]:g}, which no log "
            "does; take out what lies beyond"
        )
    if role == "odometer" and "speed" not in values:  # as it will be read
        rear = [w for w in WHEELS[2:] if w in values] or [w for w in WHEELS if w in values]
        values["speed"] = np.mean([values[w] for w in rear], axis=0)
        columns = matching.Columns(columns.names, {**columns.units, "speed": columns.units.get(rear[0], "")})
    source = Source(path, matching.Columns(names, columns.units), values)
    source.t_unit = guesses.time_unit(source.values["t"], source.stated("t", "t"), role in ("imu", "gyro", "accel"))
    return source
