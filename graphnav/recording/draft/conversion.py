"""Columns of a log in other units than those of a recording, made m, m/s and deg."""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array
from graphnav.recording.draft import guesses, motion
from graphnav.recording.draft.plain import Plain, add_words
from graphnav.recording.formats import columns as matching
from graphnav.recording.formats.increments import compute_periods
from graphnav.recording.formats.places import is_in_degrees_and_minutes, is_in_whole_degrees
from graphnav.recording.formats.table import Table

_SMALL_UNITS = {"mm": 1e-3, "cm": 1e-2, "mm/s": 1e-3, "cm/s": 1e-2}  # m, m/s
_SIGMAS = ("sd_e", "sd_n", "sd_u")
_VELOCITIES, _OF_VELOCITIES = ("ve", "vn", "vu", "vd"), ("sd_ve", "sd_vn", "sd_vu")
_WHOLE_UNITS = {"mm/s": 1e-3, "cm/s": 1e-2, "m/s": 1.0}  # of velocities in whole numbers: u-blox, MAVLink, rounded


def convert_small_units(
    columns: matching.FileColumns, names: dict[str, str], values: dict[str, Array], plain: Plain | None
) -> tuple[matching.FileColumns, dict[str, str], Plain | None]:
    """Columns whose names state mm, cm, or these per second, made m and m/s, which are the units of a recording.

    `values` are changed.
    """
    stated = {ours: matching.NAMED_UNITS.get(columns.units.get(ours, ""), ("", ""))[1] for ours in values}
    small = {ours: unit for ours, unit in stated.items() if unit in _SMALL_UNITS}
    if not small:
        return columns, names, plain
    for ours, unit in small.items():
        values[ours] = values[ours] * _SMALL_UNITS[unit]
    pairs = dict.fromkeys(f"'{names[ours]}' in {unit}" for ours, unit in small.items())
    words = f"{', '.join(pairs)}, made m or m/s"
    units = {ours: unit for ours, unit in columns.units.items() if ours not in small}
    names = {**names, **{ours: ours for ours in small}}
    return matching.FileColumns(columns.names, units), names, add_words(plain, words)


def divide_increments(
    columns: matching.FileColumns, names: dict[str, str], values: dict[str, Array], second: float, plain: Plain | None
) -> tuple[matching.FileColumns, dict[str, str], Plain | None]:
    """Increments of angle and velocity, known by their names, divided by their sample period; `second` is t's unit.

    `values` are changed.
    """
    some = [ours for ours in ("gx", "gy", "gz", "ax", "ay", "az") if matching.is_increment(names.get(ours, ""))]
    if not some:
        return columns, names, plain
    dt, _ = compute_periods(values["t"] * second)
    for ours in some:
        values[ours] = values[ours] / dt
    rates = {"rad": "rad_s", "deg": "deg_s", "m_s": "m_s2", "mps": "m_s2"}
    units = {ours: rates.get(unit, unit) if ours in some else unit for ours, unit in columns.units.items()}
    words = f"'{names[some[0]]}' to '{names[some[-1]]}' are increments, divided by their sample period"
    names = {**names, **{ours: ours for ours in some}}
    return matching.FileColumns(columns.names, units), names, add_words(plain, words)


def convert_variances(table: Table, names: dict[str, str], plain: Plain | None) -> tuple[Table, Plain | None]:
    """Sigmas of variances, which are what columns of a covariance hold; `names` are changed."""
    squared = [ours for ours in _SIGMAS if "cov" in names.get(ours, "").lower()]
    if not squared:
        return table, plain
    words = f"{', '.join(repr(names[ours]) for ours in squared)} are variances, made sigmas"
    for ours in squared:
        table = table.with_column(ours, np.sqrt(np.maximum(table[ours], 0.0)))
        names[ours] = ours
    return table, add_words(plain, words)


def convert_whole_degrees(table: Table, names: dict[str, str], plain: Plain | None) -> tuple[Table, Plain | None]:
    """Places in whole numbers of 1e-7 deg, as u-blox and MAVLink have them, in deg, heights and accuracies in m.

    Both write accuracies in mm (h_acc, v_acc); MAVLink's eph and epv, and whole numbers of speed and course, are in
    units that these do not share, so they are left alone; for velocities see below. `names` are changed.
    """
    at = {ours: x[np.isfinite(x)] for ours, x in table.columns.items() if ours != "t"}
    if not (is_in_whole_degrees(at["lat"], at["lon"]) and all(map(_are_whole, (at["lat"], at["lon"])))):
        return table, plain
    whole = [ours for ours in at if ours not in ("lat", "lon") and _are_whole(at[ours])]
    lengths = [ours for ours in whole if ours == "h" or (ours in _SIGMAS and "acc" in names[ours].lower())]
    if "h" not in lengths:
        lengths = []
    for ours in set(whole) & {"speed", "course", *_SIGMAS} - {*lengths}:
        del names[ours]
    for ours in ("lat", "lon", *lengths):
        table = table.with_column(ours, table[ours] * (1e-3 if ours in lengths else 1e-7))
    words = f"'{names['lat']}', '{names['lon']}' in 1e-7 deg, made deg"
    if lengths:
        names.pop("geoid", None)  # whose unit is another or not known
        words += f", {', '.join(dict.fromkeys(repr(names[ours]) for ours in lengths))} in mm, made m"
    for ours in ("lat", "lon", *lengths):
        names[ours] = ours
    return table, add_words(plain, words)


def convert_minutes(table: Table, names: dict[str, str], plain: Plain | None) -> tuple[Table, Plain | None]:
    """Places as receivers' sentences have them, degrees and minutes together, in deg.

    They are no degrees, as latitudes are beyond 90. `names` are changed.
    """
    at = [table[ours][np.isfinite(table[ours])] for ours in ("lat", "lon")]
    if not (all(map(len, at)) and np.abs(at[0]).max() > 90.0 and is_in_degrees_and_minutes(*at)):
        return table, plain
    words = f"'{names['lat']}', '{names['lon']}' are degrees and minutes together, made deg"
    for ours in ("lat", "lon"):
        whole, minutes = np.divmod(np.abs(table[ours]), 100.0)
        table = table.with_column(ours, np.sign(table[ours]) * (whole + minutes / 60.0))
        names[ours] = ours
    return table, add_words(plain, words)


def convert_whole_velocities(
    names: dict[str, str], values: dict[str, Array], t: Array, plain: Plain | None
) -> Plain | None:
    """Velocities beside places in whole numbers, where they are whole too: mm/s or cm/s, as the places move, made m/s.

    They are left alone where the places do not tell. `t` (N,) is in s; `names` and `values` are changed.
    """
    there = [ours for ours in _VELOCITIES if ours in values and _are_whole(values[ours])]
    if not {"ve", "vn"} <= set(there):
        return plain
    place = np.column_stack([np.radians([values["lat"], values["lon"]]).T, np.zeros(len(t))])
    course = motion.compute_course(t, place, None)
    found = guesses.find_speed_unit(t, np.hypot(values["ve"], values["vn"]), course, _WHOLE_UNITS)
    if found is not None and found.value == "m/s":
        return plain
    words = ", ".join(repr(names[ours]) for ours in there)
    if found is not None and found.value == "mm/s":  # accuracies are in mm/s beside velocities in either
        there += [ours for ours in _OF_VELOCITIES if ours in values and _are_whole(values[ours])]
    for ours in {*there, *(name for name in _OF_VELOCITIES if name in values)}:
        if found is None or ours not in there:
            del names[ours], values[ours]
        else:
            values[ours] = values[ours] * _WHOLE_UNITS[str(found.value)]
            names[ours] = ours
    if found is None:
        return plain
    return add_words(plain, f"{words} in {found.value}, as {found.why}, made m/s")


def _are_whole(x: Array) -> bool:
    x = x[np.isfinite(x)]
    return np.array_equal(x, np.round(x))
