"""One log of a draft: its sensors and its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.recording.draft import guesses
from graphnav.recording.draft.plain import Plain, add_words, read_plain
from graphnav.recording.draft.tables import WANTED, Source, is_numerical, read_sensor
from graphnav.recording.formats import columns as matching
from graphnav.recording.formats.folder import read_other_log
from graphnav.recording.formats.table import read_column_names, read_first_rows

CALLED = "t; gx gy gz ax ay az; lat lon h; speed"  # names that all sensors' columns can have


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
    if wheels := [name for name in wheels if is_numerical(path, name, plain)]:
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
