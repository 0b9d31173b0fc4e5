"""Positions of a file: usable rows, and their latitude, longitude and height in rad and m."""

from __future__ import annotations

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes
from graphnav.core.rotation import Array
from graphnav.recording.formats.stamps import format_row_count
from graphnav.recording.formats.table import Selection, Table

_HIGHEST = 9000.0  # m, highest drive on Earth
_LOWEST, _SKY = -1000.0, 50000.0  # m, range of valid heights
_RADIANS = (1.58, 3.15)  # |lat|, |lon| that angles in radians cannot exceed


def find_places(lat: Array, lon: Array, scale: float) -> Selection:
    """Which rows (N,), with angles in units of `scale` rad, are a place: neither 0, 0 nor beyond the poles.

    All rows, where fewer than half are: then the unit is wrong, not the rows.
    """
    with np.errstate(invalid="ignore"):
        possible = np.abs(lat) * scale <= np.pi / 2
    if possible.mean() < 0.5:
        possible = np.ones(len(lat), dtype=bool)
    there = (lat != 0) | (lon != 0)
    return np.asarray(possible & (there | ~there.any()))


def is_on_earth(lat: Array, lon: Array, h: Array) -> Selection:
    """Which of the places (N,) in rad and m are possible on a drive."""
    with np.errstate(invalid="ignore"):
        near = (np.abs(lat) <= np.pi / 2) & (np.abs(lon) <= 2 * np.pi) & (h >= _LOWEST) & (h <= _SKY)
    return np.asarray(near)


def convert_geodetic(rows: Table, unit: str | None, height: float, label: str, remarks: Notes) -> tuple[Array, Table]:
    """(lat, lon, h) in rad, rad, m of rows with usable position, and those rows.

    `unit` is that of the angles; None means degrees, and angles that are all small enough to be radians are refused.
    `height` is the unit of the heights, in m.

    Raises
    ------
    RecordingError
        For positions that are nowhere on Earth, naming the line and the likely mistake.
    """
    scale = 1.0 if unit == "rad" else np.pi / 180.0
    nowhere = ~find_places(rows["lat"], rows["lon"], scale)
    if nowhere.any():
        k = np.flatnonzero(nowhere)[0]
        where = f"{rows['lat'][k]:g}, {rows['lon'][k]:g}"
        remarks.add(
            f"{label.lower()}.nowhere",
            f"{format_row_count(nowhere, label)} at {where} (no fix) dropped (first at t = {rows['t'][k]:.3f} s)",
        )
        rows = rows.take(~nowhere)
    lat, lon, h = rows["lat"], rows["lon"], height * rows["h"]
    if unit is None and np.abs(lat).max() < _RADIANS[0] and np.abs(lon).max() < _RADIANS[1]:
        raise RecordingError(
            f"{rows.path}: lat and lon look like radians (first {lat[0]:g}, {lon[0]:g}); set "
            'units = { angle = "rad" } if they are, { angle = "deg" } if the drive really is there',
            key="table.radians",
        )
    check_angles(rows, scale, label)
    beyond = np.flatnonzero((h < _LOWEST) | (h > _SKY))
    if not len(beyond) and np.median(h) > _HIGHEST:
        beyond = np.flatnonzero(h > _HIGHEST)
    if len(beyond):
        k = beyond[0]
        hint = "; is it in millimetres?" if abs(h[k]) > _HIGHEST else ""
        if 2 * len(beyond) < len(h):  # the others are sound
            hint = "; leave the height blank where there is none"
        raise RecordingError(
            f"{rows.describe_place(k, 'h')}: {h[k]:g} m is not the height of a drive{hint}", key="table.height"
        )
    lon = np.where(lon * scale > np.pi, lon * scale - 2 * np.pi, lon * scale)
    return np.stack([lat * scale, lon, h], -1), rows


def check_angles(rows: Table, scale: float, label: str) -> None:
    """Refuse latitudes and longitudes, in units of `scale` rad, that are none.

    Raises
    ------
    RecordingError
        Naming the line and the likely mistake.
    """
    lat, lon = rows["lat"], rows["lon"]
    beyond = np.flatnonzero(np.abs(lat) * scale > np.pi / 2)
    if len(beyond):
        k = beyond[0]
        swapped = np.abs(lon * scale).max() <= np.pi / 2
        hint = "; are lat and lon swapped?" if swapped else _guess_other_form(lat, lon, label)
        raise RecordingError(f"{rows.describe_place(k, 'lat')}: {lat[k]:g} is not a latitude{hint}", key="table.place")
    beyond = np.flatnonzero((lon * scale < -np.pi - 1e-9) | (lon * scale > 2 * np.pi))
    if len(beyond):
        turned = lon.min() * scale >= -2 * np.pi and lon.max() * scale <= 2 * np.pi
        hint = "; is it a whole turn off? Add 360 deg" if turned else _guess_other_form(lat, lon, label)
        raise RecordingError(
            f"{rows.describe_place(beyond[0], 'lon')}: {lon[beyond[0]]:g} is not a longitude{hint}", key="table.place"
        )


def is_in_whole_degrees(lat: Array, lon: Array) -> bool:
    """Whether latitudes and longitudes (N,) may be in units of 1e-7 deg: they are none in degrees."""
    return bool((np.abs(lat) <= 90e7).all() and np.median(np.abs(lat)) > 1e5 and (np.abs(lon) <= 360e7).all())


def is_in_degrees_and_minutes(lat: Array, lon: Array) -> bool:
    """Whether latitudes and longitudes (N,) may be degrees and minutes together: 3539.55 is 35 deg 39.55'."""
    return all((np.abs(x) % 100.0 < 60.0).all() and np.abs(x).max() < 100.0 * top for x, top in ((lat, 91), (lon, 181)))


def _guess_other_form(lat: Array, lon: Array, label: str) -> str:
    """The likely mistake behind latitudes and longitudes out of range."""
    if is_in_whole_degrees(lat, lon):
        return "; in units of 1e-7 deg, as u-blox and MAVLink have them? Write degrees"
    if is_in_degrees_and_minutes(lat, lon):
        whole, minutes = divmod(abs(lat[0]), 100.0)
        return f"; degrees and minutes together, as in NMEA? {lat[0]:g} is then {whole:g} deg {minutes:g} min"
    return '; if they are metres, name them x and y and set frame = "local"' if label == "truth" else ""
