"""Columns of a log in other units than those of a recording, made m, m/s and deg."""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array
from graphnav.recording.draft import guesses, motion
from graphnav.recording.draft.log_columns import LogColumns
from graphnav.recording.formats import columns as matching
from graphnav.recording.formats.increments import compute_periods
from graphnav.recording.formats.places import is_in_degrees_and_minutes, is_in_whole_degrees

_SMALL_UNITS = {"mm": 1e-3, "cm": 1e-2, "mm/s": 1e-3, "cm/s": 1e-2}  # m, m/s
_SIGMAS = ("sd_e", "sd_n", "sd_u")
_VELOCITIES, _OF_VELOCITIES = ("ve", "vn", "vu", "vd"), ("sd_ve", "sd_vn", "sd_vu")
_WHOLE_UNITS = {"mm/s": 1e-3, "cm/s": 1e-2, "m/s": 1.0}  # of velocities in whole numbers: u-blox, MAVLink, rounded


def convert_small_units(of: LogColumns) -> None:
    """Columns whose names state mm, cm, or these per second, made m and m/s, which are the units of a recording."""
    stated = {ours: matching.NAMED_UNITS.get(of.units.get(ours, ""), ("", ""))[1] for ours in of.values}
    small = {ours: unit for ours, unit in stated.items() if unit in _SMALL_UNITS}
    if not small:
        return
    pairs = dict.fromkeys(f"'{of.names[ours]}' in {unit}" for ours, unit in small.items())
    for ours, unit in small.items():
        of.convert(ours, of.values[ours] * _SMALL_UNITS[unit])
    of.forget_units(small)
    of.say(f"{', '.join(pairs)}, made m or m/s")


def divide_increments(of: LogColumns, second: float) -> None:
    """Increments of angle and velocity, known by their names, divided by their sample period; `second` is t's unit."""
    some = [ours for ours in ("gx", "gy", "gz", "ax", "ay", "az") if matching.is_increment(of.names.get(ours, ""))]
    if not some:
        return
    words = f"'{of.names[some[0]]}' to '{of.names[some[-1]]}' are increments, divided by their sample period"
    dt, _ = compute_periods(of.values["t"] * second)
    for ours in some:
        of.convert(ours, of.values[ours] / dt)
    rates = {"rad": "rad_s", "deg": "deg_s", "m_s": "m_s2", "mps": "m_s2"}
    of.units = {ours: rates.get(unit, unit) if ours in some else unit for ours, unit in of.units.items()}
    of.say(words)


def convert_variances(of: LogColumns) -> None:
    """Sigmas of variances, which are what columns of a covariance hold."""
    squared = [ours for ours in _SIGMAS if "cov" in of.names.get(ours, "").lower()]
    if not squared:
        return
    words = f"{', '.join(repr(of.names[ours]) for ours in squared)} are variances, made sigmas"
    for ours in squared:
        of.convert(ours, np.sqrt(np.maximum(of.values[ours], 0.0)))
    of.say(words)


def convert_whole_degrees(of: LogColumns) -> bool:
    """Places in whole numbers of 1e-7 deg, as u-blox and MAVLink have them, in deg, heights and accuracies in m.

    Both write accuracies in mm (h_acc, v_acc); MAVLink's eph and epv, and whole numbers of speed and course, are in
    units that these do not share, so they are left alone; for velocities see below.

    Returns
    -------
    bool
        Whether the places are such numbers.
    """
    at = {ours: x[np.isfinite(x)] for ours, x in of.values.items() if ours != "t"}
    if not (is_in_whole_degrees(at["lat"], at["lon"]) and all(map(_are_whole, (at["lat"], at["lon"])))):
        return False
    whole = [ours for ours in at if ours not in ("lat", "lon") and _are_whole(at[ours])]
    lengths = [ours for ours in whole if ours == "h" or (ours in _SIGMAS and "acc" in of.names[ours].lower())]
    if "h" not in lengths:
        lengths = []
    of.drop(*(set(whole) & {"speed", "course", *_SIGMAS} - {*lengths}))
    words = f"'{of.names['lat']}', '{of.names['lon']}' in 1e-7 deg, made deg"
    if lengths:
        of.drop("geoid")  # whose unit is another or not known
        words += f", {', '.join(dict.fromkeys(repr(of.names[ours]) for ours in lengths))} in mm, made m"
    for ours in ("lat", "lon", *lengths):
        of.convert(ours, of.values[ours] * (1e-3 if ours in lengths else 1e-7))
    of.forget_units(lengths)
    of.say(words)
    return True


def convert_minutes(of: LogColumns) -> None:
    """Places as receivers' sentences have them, degrees and minutes together, in deg.

    They are no degrees, as latitudes are beyond 90.
    """
    at = [of.values[ours][np.isfinite(of.values[ours])] for ours in ("lat", "lon")]
    if not (all(map(len, at)) and np.abs(at[0]).max() > 90.0 and is_in_degrees_and_minutes(*at)):
        return
    words = f"'{of.names['lat']}', '{of.names['lon']}' are degrees and minutes together, made deg"
    for ours in ("lat", "lon"):
        whole, minutes = np.divmod(np.abs(of.values[ours]), 100.0)
        of.convert(ours, np.sign(of.values[ours]) * (whole + minutes / 60.0))
    of.say(words)


def convert_whole_velocities(of: LogColumns, second: float) -> None:
    """Velocities beside places in whole numbers, where they are whole too: mm/s or cm/s, as the places move, made m/s.

    They are left alone where the places do not tell; `second` is t's unit.
    """
    values, t = of.values, of.values["t"] * second
    there = [ours for ours in _VELOCITIES if ours in values and _are_whole(values[ours])]
    if not {"ve", "vn"} <= set(there):
        return
    place = np.column_stack([np.radians([values["lat"], values["lon"]]).T, np.zeros(len(t))])
    course = motion.compute_course(t, place, None)
    found = guesses.find_speed_unit(t, np.hypot(values["ve"], values["vn"]), course, _WHOLE_UNITS)
    if found is not None and found.value == "m/s":
        return
    words = ", ".join(repr(of.names[ours]) for ours in there)
    sigmas = [ours for ours in _OF_VELOCITIES if ours in values]
    if found is None:
        of.drop(*there, *sigmas)
        return
    if found.value == "mm/s":  # accuracies are in mm/s beside velocities in either
        there += [ours for ours in sigmas if _are_whole(values[ours])]
    of.drop(*(ours for ours in sigmas if ours not in there))
    for ours in there:
        of.convert(ours, values[ours] * _WHOLE_UNITS[str(found.value)])
    of.forget_units(there)
    of.say(f"{words} in {found.value}, as {found.why}, made m/s")


def _are_whole(x: Array) -> bool:
    x = x[np.isfinite(x)]
    return np.array_equal(x, np.round(x))
