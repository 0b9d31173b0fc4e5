"""References: trajectories of better systems beside a log's fixes, and files of trajectories with other columns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.recording.draft.logs import read_header
from graphnav.recording.draft.motion import is_course_in_radians
from graphnav.recording.draft.plain import add_words
from graphnav.recording.draft.tables import Source, read_sensor
from graphnav.recording.formats.columns import ATTITUDE, FileColumns, match_attitude, split_unit

# heights by the names of their columns; others are taken as above the ellipsoid
_ABOVE_SEA = re.compile(r"msl|alt|elev|orth|sea", re.IGNORECASE)
_ABOVE_ELLIPSOID = re.compile(r"ell|hae|wgs", re.IGNORECASE)
_NAMED = re.compile(r"(?:^|[^a-z])(?:(?:ground_?)?truth|ref(?:erence)?|gt)(?:$|[^a-z])", re.IGNORECASE)


def has_attitude(source: Source) -> bool:
    """Whether a log of positions has columns of roll and pitch, which no receiver measures."""
    names = match_attitude([*source.unused, source.columns.names.get("course", "")]).names
    return {"roll", "pitch"} <= names.keys()


def separate_reference(some: Sequence[Source]) -> tuple[list[Source], Source | None]:
    """The receivers among logs of positions, and a reference beside them, known by its attitude or its file's name."""
    tables = [source for source in some if source.log is None]
    found = [s for s in tables if has_attitude(s)] or [s for s in tables if _NAMED.search(s.path.name.split(".")[0])]
    rest = [source for source in some if source not in found]
    if not rest or not found:
        return list(some), None
    return rest, read_reference(max(found, key=len).path)


def is_above_sea(height: str) -> bool:
    """Whether a column of heights is called as those above the sea are."""
    return bool(_ABOVE_SEA.search(height)) and not _ABOVE_ELLIPSOID.search(height)


def read_reference(path: Path) -> Source:
    """Times, positions, and velocities and angles where it has them, of a table with columns of any names.

    Raises
    ------
    RecordingError
        If it is no table, or has no columns of these.
    """
    header, columns, plain, _ = read_header(path)
    if missing := [name for name in ("lat", "lon", "h") if name not in columns.names]:
        raise RecordingError(
            f"{path}, line 1: no column '{missing[0]}', nor one of a name like it; found {', '.join(header)[:300]}; "
            "rename those it has: t, lat, lon, h, and ve, vn, vu, roll, pitch, heading",
            key="table.column",
        )
    angles = match_attitude(header if plain is None else list(plain.columns))
    names = {ours: theirs for ours, theirs in columns.names.items() if ours not in ("course", "speed", *ATTITUDE)}
    source = read_sensor(
        path, FileColumns({**names, **angles.names}, {**columns.units, **angles.units}), "truth", plain
    )
    values, names, plain = dict(source.values), dict(source.columns.names), source.plain
    for ours in ATTITUDE:
        if ours not in values:
            continue
        stated = source.find_unit(ours, "angle")
        turning = ours == "heading" and is_course_in_radians(values["lat"], values["lon"], values[ours])
        if stated == "rad" or (stated is None and turning):
            values[ours] = np.degrees(values[ours])
            plain = add_words(plain, f"'{names[ours]}' in rad, made deg")
            names[ours] = ours
    unused = tuple(name for name in header if name and name not in source.columns.names.values())
    return replace(source, values=values, columns=replace(source.columns, names=names), plain=plain, unused=unused)


def describe(source: Source) -> str:
    """Which columns of a reference are read as what, in words."""
    names = [
        f"{ours} = '{theirs}'"
        for ours, theirs in source.columns.names.items()
        if ours != theirs and ours in source.values
    ]
    words = [f"columns {', '.join(names)}"] if names else []
    words += [source.plain.words] if source.plain is not None else []
    words += [f"t in {source.t_unit.value}: {source.t_unit.why}"] if source.t_unit.value != "s" else []
    if is_above_sea(height := source.columns.names.get("h", "")):
        words.append(f"'{height}' may be above mean sea level and is used as it is")
    if split_unit(source.columns.names.get("heading", ""))[0].endswith("yaw"):
        words.append("yaw as heading, clockwise from north")
    return "; ".join(words)
