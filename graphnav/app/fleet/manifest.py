"""The drives of a fleet and the settings of each: from a folder, or from a manifest in CSV or TOML."""

from __future__ import annotations

import csv
import io
import math
import os
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from graphnav.app.withholding import parse_withheld
from graphnav.app.workflow import parse_noise
from graphnav.config import read_settings
from graphnav.config.files import parse_settings
from graphnav.core.complaints import read_toml, suggest_nearest
from graphnav.core.errors import ConfigError
from graphnav.core.files import exists, is_inside, read_text
from graphnav.estimation.noise.files import MODES
from graphnav.estimation.solution import KNOWN
from graphnav.recording.formats import is_description, list_formats


@dataclass(frozen=True)
class DriveOptions:
    """The options of a drive; the same for all, except where a manifest overrides them."""

    solver: str = "batch"
    profile: str | None = None
    config: str | None = None  # path of a settings file
    settings: str | None = None  # overrides of that file, TOML
    noise: str | None = None
    without: str | None = None  # several, separated by blanks
    start: float | None = None  # s from the recording's start
    end: float | None = None


@dataclass(frozen=True)
class Task:
    """One drive as plain values that can be sent to another process or machine."""

    name: str  # name of the drive and of its folder
    source: str
    folder: str  # folder to write into
    solver: str
    settings: dict[str, Any]
    noise: str | None = None  # a file, if one is given
    without: tuple[str, ...] = ()
    withhold: float | None = None  # s, duration of the withheld GNSS spans that are scored
    start: float | None = None
    end: float | None = None
    rate: float | None = None
    pages: bool = True
    again: bool = False  # solve again even if it is done
    allow_outside: bool = False  # whether recordings may name files outside their folders
    place: str = ""  # where a manifest names it


_KNOWN_COLUMNS = ("recording", "name", *(f.name for f in fields(DriveOptions)))


def read_drives(
    source: Path, asked: DriveOptions, allow_outside: bool = False
) -> list[tuple[str, str, DriveOptions, str]]:
    """Name, recording, options, and the source of these, of every drive.

    Parameters
    ----------
    source : a folder, in which recordings are looked for at any depth; or a manifest, .csv or .toml.
    asked : values for what the manifest does not set.
    allow_outside : whether files that a manifest names may lie outside its folder.

    Raises
    ------
    ConfigError
        If there are none, or the manifest is invalid: naming the file, the line and the field.
    """
    if not exists(source, ConfigError):
        raise ConfigError(f"{source}: no such folder or manifest", key="file.missing")
    if source.is_dir():
        found = [(_name_drive(path, source), str(path), asked, str(path)) for path in _find_recordings(source)]
        if not found:
            raise ConfigError(
                f'{source}: holds no recording; each is a .toml that says format = "graphnav-recording/1"',
                key="recording.none",
            )
        return _number_clones(found)
    rows = _parse_csv(source) if source.suffix == ".csv" else _parse_toml(source)
    drives = [_build_drive(source, where, row, asked, allow_outside) for where, row in rows]
    if not drives:
        raise ConfigError(f"{source}: names no recording", key="manifest.no_recording")
    twice = [name for name, count in Counter(name for name, *_ in drives).items() if count > 1]
    named = [(where, name) for where, row in rows if (name := str(row.get("name") or "")) in twice]
    if named:
        where, name = named[-1]
        raise ConfigError(
            f"{where}: an earlier drive is named '{name}' as well; each is a folder of its own",
            key="manifest.name_twice",
        )
    return _number_clones(drives)


def build_task(
    drive: tuple[str, str, DriveOptions, str], out: Path, known: dict[Any, dict[str, Any]], **common: Any
) -> Task:
    """Build a task with its settings read and checked; `known` caches settings that drives share.

    Raises
    ------
    ConfigError
        Naming the place of the invalid setting.
    """
    name, source, asked, where = drive
    try:
        without, settings = resolve_options(asked, known)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}", key=error.key) from None
    given = asked.noise if asked.noise is not None and Path(asked.noise).is_file() else None
    return Task(
        name, source, str(out / "drives" / name), asked.solver, settings, given, without,
        start=asked.start, end=asked.end, place="" if where == source else where, **common,
    )  # fmt: skip


def resolve_options(asked: DriveOptions, known: dict[Any, dict[str, Any]]) -> tuple[tuple[str, ...], dict[str, Any]]:
    """What is withheld and the settings of a drive, checked; `known` caches settings that drives share.

    Raises
    ------
    ConfigError
        Naming the option.
    """
    if asked.solver not in KNOWN:
        raise ConfigError(f"no solver '{asked.solver}'; {suggest_nearest(asked.solver, KNOWN)}", key="manifest.solver")
    without = tuple((asked.without or "").split())
    for one in without:
        parse_withheld(one)
    for name, value in (("start", asked.start), ("end", asked.end)):
        if value is not None and not math.isfinite(value):
            raise ConfigError(f"{name} {value:g} is not a number of seconds", key="manifest.value")
    if asked.start is not None and asked.end is not None and not asked.start < asked.end:
        raise ConfigError(f"end {asked.end:g} must be later than start {asked.start:g}", key="manifest.span")
    key = (asked.config, asked.profile, asked.settings, asked.noise)
    if key not in known:
        settings = read_settings(asked.config, asked.profile)
        if asked.settings:
            settings = parse_settings(
                _overlay(settings.model_dump(exclude_unset=True), _parse_settings(asked.settings))
            )
        known[key] = parse_noise(asked.noise, settings)[0].model_dump(mode="json")
    return without, known[key]


def _find_recordings(folder: Path) -> list[Path]:
    """Recordings of known form in a folder, at any depth."""
    found = []
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for file in sorted(files):
            path = Path(place) / file
            # an unreadable file gets a row that states so, under its name
            if file == "recording.toml" or (file.endswith(".toml") and is_description(path)):
                found.append(path)
    return found


def _name_drive(path: Path, folder: Path) -> str:
    parts = path.relative_to(folder).with_suffix("").parts
    parts = parts[:-1] if parts[-1] == "recording" and len(parts) > 1 else parts
    return _clean_name("_".join(parts))


def _clean_name(text: str) -> str:
    """A name that every file system accepts."""
    return re.sub(r"[^\w.+-]+", "_", text).strip("._")[:120] or "drive"


def _number_clones(drives: list[tuple[str, str, DriveOptions, str]]) -> list[tuple[str, str, DriveOptions, str]]:
    """Make names unique: repeated ones get a number appended."""
    taken: set[str] = set()
    out = []
    for name, *rest in drives:
        distinct, k = name, 1
        while distinct in taken:
            k += 1
            distinct = f"{name}-{k}"
        taken.add(distinct)
        out.append((distinct, *rest))
    return out  # type: ignore[return-value]


def _parse_csv(path: Path) -> list[tuple[str, Mapping[str, Any]]]:
    text = read_text(path, ConfigError)
    head = text.partition("\n")[0]
    mark = ";" if ";" in head and "," not in head else ","  # spreadsheets write either
    reader = csv.DictReader(io.StringIO(text), delimiter=mark, strict=True)
    rows: list[tuple[str, Mapping[str, Any]]] = []
    try:
        _check_columns(reader.fieldnames or (), f"{path}, line 1")
        for row in reader:
            where = f"{path}, line {reader.line_num}"
            if None in row or None in row.values():
                raise ConfigError(
                    f"{where}: {len(reader.fieldnames or ())} cells are needed, as the header has", key="table.fields"
                )
            rows.append((where, {key: value.strip() for key, value in row.items()}))
    except csv.Error as error:
        raise ConfigError(f"{path}, line {reader.line_num}: {error}", key="table.unreadable") from None
    return rows


def _parse_toml(path: Path) -> list[tuple[str, Mapping[str, Any]]]:
    values, text = read_toml(path, ConfigError)
    drives = values.get("drive")
    if set(values) != {"drive"} or not isinstance(drives, list) or not all(isinstance(one, dict) for one in drives):
        raise ConfigError(
            f'{path}: must be a list of tables [[drive]], each with recording = "...", and nothing else',
            key="manifest.tables",
        )
    lines = [n for n, line in enumerate(text.splitlines(), 1) if re.match(r"\s*\[\[\s*drive\s*\]\]", line)]
    places = (
        [f"line {n}" for n in lines] if len(lines) == len(drives) else [f"drive {k + 1}" for k in range(len(drives))]
    )
    rows: list[tuple[str, Mapping[str, Any]]] = [(f"{path}, {at}", one) for at, one in zip(places, drives, strict=True)]
    for where, row in rows:
        _check_columns(row, where)
    return rows


def _check_columns(names: Iterable[str], where: str) -> None:
    unknown = [name for name in names if name not in _KNOWN_COLUMNS]
    if unknown:
        raise ConfigError(
            f"{where}: no such column '{unknown[0]}'; {suggest_nearest(unknown[0], _KNOWN_COLUMNS)}",
            key="table.column_unknown",
        )
    if "recording" not in names:
        raise ConfigError(f"{where}: 'recording' is missing", key="manifest.no_recording")


def _build_drive(
    source: Path, where: str, row: Mapping[str, Any], asked: DriveOptions, allow_outside: bool
) -> tuple[str, str, DriveOptions, str]:
    """One row of a manifest; a blank field takes the common value."""
    values: dict[str, Any] = {}
    for key in (f.name for f in fields(DriveOptions)):
        value = row.get(key)
        if value is None or value == "":
            continue
        if key in ("start", "end"):
            try:
                values[key] = float(value)
            except (TypeError, ValueError):
                raise ConfigError(
                    f"{where}, '{key}': {value!r} is not a number of seconds", key="manifest.value"
                ) from None
        elif key == "settings" and isinstance(value, Mapping):
            values[key] = _format_settings(value)
        elif key == "without" and isinstance(value, list):
            values[key] = " ".join(map(str, value))
        elif isinstance(value, str):
            values[key] = value
        else:
            raise ConfigError(f"{where}, '{key}': {value!r} is not a text", key="manifest.value")
    recording = row.get("recording")
    if not isinstance(recording, str) or not recording:
        raise ConfigError(f"{where}, 'recording': names no recording", key="manifest.no_recording")
    noise = values.get("noise")
    if noise is not None and noise not in MODES:
        values["noise"] = str(_find_beside(source, noise, where, "noise", allow_outside))
    if "config" in values:
        values["config"] = str(_find_beside(source, values["config"], where, "config", allow_outside))
    builtin = recording in list_formats() and list_formats()[recording].builtin
    path = recording if builtin else str(_find_beside(source, recording, where, "recording", allow_outside))
    name = row.get("name") or Path(recording.removesuffix("/recording.toml")).name.removesuffix(".toml")
    if not isinstance(name, str):
        raise ConfigError(f"{where}, 'name': {name!r} is not a text", key="manifest.value")
    return _clean_name(name), path, replace(asked, **values), where


def _find_beside(source: Path, name: str, where: str, key: str, allow_outside: bool) -> Path:
    """A file named by a manifest; it must be in the manifest's folder or below unless `allow_outside`."""
    path = source.parent / name
    if not is_inside(path, source.parent, ConfigError) and not allow_outside:
        raise ConfigError(
            f"{where}, '{key}': {name} lies outside its folder; use --allow-outside if you trust who wrote it",
            key="file.outside",
        )
    return path


def _parse_settings(text: str) -> dict[str, Any]:
    """Parse settings in one cell, with semicolons as line ends."""
    try:
        return tomllib.loads(text if "\n" in text else text.replace(";", "\n"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(
            f"settings {text!r}: {error}; write key = value, with semicolons between", key="manifest.settings"
        ) from None


def _format_settings(values: Mapping[str, Any], at: str = "") -> str:
    """A table of settings as lines of dotted keys."""
    from graphnav.config.files import format_toml_value

    lines = []
    for key, value in values.items():
        lines.append(
            _format_settings(value, f"{at}{key}.")
            if isinstance(value, Mapping)
            else f"{at}{key} = {format_toml_value(value)}"
        )
    return "\n".join(lines)


def _overlay(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested values; `above` takes precedence."""
    out = dict(below)
    for key, value in above.items():
        inner = out.get(key)
        out[key] = _overlay(inner, value) if isinstance(value, Mapping) and isinstance(inner, Mapping) else value
    return out
