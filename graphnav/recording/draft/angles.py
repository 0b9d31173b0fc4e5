"""Latitudes and longitudes as text: with degree signs, minutes and seconds, or a hemisphere in place of a sign."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from graphnav.core.rotation import Array
from graphnav.recording.formats.columns import match_columns

_MARKS = re.compile("[\\s:°º'\u2032\u2019\"\u2033\u201d]+")  # of degrees, minutes and seconds
_MARKED = re.compile(r"[NSEW°º]", re.IGNORECASE)  # characters that no time of day has
_SIDES = {"lat": ("N", "S"), "lon": ("E", "W")}  # positive, negative


def read_angles(cells: Mapping[str, Sequence[str]], columns: dict[str, Array]) -> list[str]:
    """Parse columns of angles with degree signs, and apply the signs of hemisphere columns.

    Parameters
    ----------
    cells : the text of every column.
    columns : those that are numbers; changed in place, deg.

    Returns
    -------
    list of str
        Notes on what was changed.
    """
    notes = []
    for name, some in cells.items():
        if name not in columns and (angles := _parse_angles(some)) is not None:
            columns[name] = angles
            notes.append(f"'{name}' as decimal degrees")
    names = match_columns(list(columns)).names
    for ours, (positive, negative) in _SIDES.items():
        side = next((n for n, some in cells.items() if n not in columns and _hold_only(some, positive, negative)), None)
        if side is None or ours not in names:
            continue
        below = np.array([cell.upper() == negative for cell in cells[side]])
        signed = np.where(below, -1.0, 1.0) * np.abs(columns[names[ours]])
        if not np.array_equal(signed, columns[names[ours]], equal_nan=True):
            columns[names[ours]] = signed
            notes.append(f"signs of '{names[ours]}' by '{side}'")
    return notes


def _hold_only(cells: Sequence[str], positive: str, negative: str) -> bool:
    """Whether all cells that are not blank are one of two letters, and some are."""
    return {cell.upper() for cell in cells if cell} in ({positive}, {negative}, {positive, negative})


def _parse_angles(cells: Sequence[str]) -> Array | None:
    """Parse a column of angles (N,) in deg, NaN where blank; None if a cell is no angle, or none has marks."""
    if not any(_MARKED.search(cell) for cell in cells):
        return None
    found = [_parse_angle(cell) if cell else np.nan for cell in cells]
    return None if any(x is None for x in found) else np.array(found, dtype=float)


def _parse_angle(cell: str) -> float | None:
    """Parse degrees, with optional minutes and seconds; None where the cell is no angle."""
    side = next((letter for letter in (cell[0].upper(), cell[-1].upper()) if letter in "NSEW"), "")
    parts = [part for part in _MARKS.split(cell.upper().strip(side) if side else cell) if part]
    if not 1 <= len(parts) <= 3 or any(re.fullmatch(r"\d+(?:\.\d*)?", part.lstrip("+-")) is None for part in parts):
        return None
    size = [float(part.lstrip("+-")) for part in parts]
    if any(x >= 60.0 for x in size[1:]):
        return None
    angle = sum(x / 60.0**k for k, x in enumerate(size))
    return -angle if side in ("S", "W") or parts[0].startswith("-") else angle
