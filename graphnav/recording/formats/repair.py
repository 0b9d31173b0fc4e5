"""Selection of the usable rows of a sensor's file; all changes are remarked on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import UNIX, find_restarts
from graphnav.recording import FIX_TYPES, convert_fix_types
from graphnav.recording.formats.stamps import (
    check_days,
    check_fix_clock,
    check_imu_steps,
    check_passes,
    describe_packets,
    find_lone_stamps,
    find_repeated,
    find_repeats,
    format_row_count,
    spread_packets,
    take_halfway,
    tell_rounding,
)
from graphnav.recording.formats.table import Selection, Table
from graphnav.sensors.tables import LATEST, TIME_UNITS, Keep

_SENSOR_LABELS = {"imu": "IMU", "gnss": "GNSS", "odometer": "odometer", "truth": "truth"}
VAGUEST, VAGUEST_V = 1e5, 1e4  # m, m/s; a fix with a larger sigma carries no information
_LEAST_SIGMA = 1e-9  # m, m/s; a smaller sigma is not meant as one

# 1-sigma where a recording states none, from the GPS Standard Positioning Service Performance Standard (5th ed.,
# 2020, section 3.8): 8 m horizontal (2.45 sigma in two dimensions) and 13 m vertical (1.96 sigma), both 95 %.
DEFAULT_SD = (3.3, 3.3, 6.6)  # m
# The same section's 0.2 m/s (95 %, one axis) is for the open sky; twice its sigma for a vehicle among buildings.
DEFAULT_SD_V = (0.2, 0.2, 0.4)  # m/s


# GGA's quality (NMEA 0183; 9 as NovAtel's OEM7 writes it) -> RTKLIB's number. 3, a military fix, is none of these; 6,
# 7 and 8 are no fixes, but estimated, told or simulated.
NMEA_TYPES = {0: 0, 1: 5, 2: 4, 3: 0, 4: 1, 5: 2, 9: 3}


@dataclass(frozen=True)
class _Sensor:
    """Whose rows are selected, and where it is remarked on."""

    name: str
    unit: str  # of its stamps in the file
    offset: float  # s, to be added to them
    remarks: Notes

    @property
    def label(self) -> str:
        """Its name in sentences."""
        return _SENSOR_LABELS.get(self.name, self.name)

    @property
    def scale(self) -> float:
        """s in a unit of its stamps."""
        return TIME_UNITS[self.unit]


def select_usable_rows(
    rows: Table, sensor: str, needed: tuple[str, ...], keep: Keep | None, unit: str, offset: float, remarks: Notes
) -> Table:
    """The rows complete in the needed values, ordered by time, without repeated times; t in seconds plus `offset`.

    Raises
    ------
    RecordingError
        For infinite values but in an odometer's log, if too few rows are left, if the time steps cannot be seconds, or
        if the stamps run over the same times twice.
    """
    of, stamps = _Sensor(sensor, unit, offset, remarks), rows["t"]
    if rows.cut:
        remarks.add(f"{sensor}.cut", f"{rows.path.name} ends within a line, as after a loss of power: it is left out")
    rows = _refuse_infinite(rows, of)
    if keep is not None:
        rows = _take_kept(rows, keep)
    rows = rows.with_column("t", rows["t"] * of.scale + offset)
    rows = _drop_blank(rows, needed, of)
    check_days(rows, unit)
    rows = _move_lone_stamps(rows, of)
    rows = _continue_clock(rows, of)
    if "lat" in rows and "lon" in rows:
        check_fix_clock(rows, of.label)
    rows = _sort_by_time(rows, of)
    if sensor == "imu":
        rows = _spread_packets(rows, stamps, of)
    rows = _drop_repeated(rows, stamps, of)
    if sensor == "imu":
        check_imu_steps(rows, unit)
    return _drop_held(rows, of) if sensor == "gnss" else rows


def _refuse_infinite(rows: Table, of: _Sensor) -> Table:
    """The rows, with infinite values blank in an odometer's log, of which single readings can be missing.

    A stamp of thousands of years is invalid, like an infinite one.
    """
    stamps = rows["t"]
    with np.errstate(over="ignore"):
        late = np.abs(stamps * of.scale + of.offset) > LATEST
    rows = rows.with_column("t", np.where(late, np.inf, stamps))
    for name in rows.columns:
        infinite = np.isinf(rows[name])
        if not infinite.any():
            continue
        if of.name == "odometer":
            rows = rows.with_column(name, np.where(infinite, np.nan, rows[name]))
            continue
        first = np.flatnonzero(infinite)[0]
        what, hint = "the value is infinite; leave it blank", ""
        if name == "t":
            what = f"{stamps[first]:.16g} is no time in {of.unit}"
            dates = [unit for unit, scale in TIME_UNITS.items() if UNIX < stamps[first] * scale < 3.0 * UNIX]
            hint = f'; say units = {{ t = "{dates[0]}" }}: it is then a date' if dates else ""
        raise RecordingError(f"{rows.describe_place(first, name)}: {what}{hint}", key="table.not_finite")
    return rows


def _take_kept(rows: Table, keep: Keep) -> Table:
    rows = rows.take(rows[Table.KEEP] >= keep.at_least)
    if not len(rows):
        raise RecordingError(
            f"{rows.path}: no row has {keep.column} of at least {keep.at_least:g} (keep)", key="table.keep"
        )
    return rows


def _drop_blank(rows: Table, needed: tuple[str, ...], of: _Sensor) -> Table:
    blank = np.zeros(len(rows), dtype=bool)
    for name in needed:
        blank |= np.isnan(rows[name])
    if blank.all():
        raise RecordingError(
            f"{rows.path}: no row holds all of {', '.join(needed)} (all blank or NaN)", key="table.all_blank"
        )
    if not blank.any():
        return rows
    first = rows["t"][np.flatnonzero(blank)[0]]
    at = f" (first at t = {first:.3f} s)" if np.isfinite(first) else ""
    what = "blank, NaN or infinite" if of.name == "odometer" else "blank or NaN"
    of.remarks.add(f"{of.name}.rows_blank", f"{format_row_count(blank, of.label)} with {what} values dropped{at}")
    return rows.take(~blank)


def _move_lone_stamps(rows: Table, of: _Sensor) -> Table:
    """Stamps far from those around them are put halfway between these."""
    t = rows["t"]
    lone = find_lone_stamps(t)
    if not lone.any():
        return rows
    k = int(np.flatnonzero(lone)[0])
    of.remarks.add(
        f"{of.name}.stamps_lone",
        f"{format_row_count(lone, of.label)} with a stamp far from those around it (first {t[k]:.10g} s, "
        f"after t = {t[k - 1]:.3f} s) taken to be halfway between them",
    )
    return rows.with_column("t", np.where(lone, take_halfway(t), t))


def _continue_clock(rows: Table, of: _Sensor) -> Table:
    """A clock that restarts at 0, as at midnight, goes on."""
    later = find_restarts((rows["t"] - of.offset) / of.scale, of.scale)
    if later is None:
        return rows
    of.remarks.add(
        f"{of.name}.clock_again",
        f"the clock of the {of.label} restarts at 0: {later.max() * of.scale:g} s are added after it",
    )
    return rows.with_column("t", rows["t"] + later * of.scale)


def _sort_by_time(rows: Table, of: _Sensor) -> Table:
    t = rows["t"]
    back = np.diff(t) < 0
    if not back.any():
        return rows
    check_passes(rows, of.label)
    of.remarks.add(
        f"{of.name}.rows_unordered",
        f"{of.label} rows out of order sorted by time ({format_count(back.sum(), 'step')} back, "
        f"the first after t = {t[np.flatnonzero(back)[0]]:.3f} s)",
    )
    return rows.take(np.argsort(t, kind="stable"))


def _spread_packets(rows: Table, stamps: Array, of: _Sensor) -> Table:
    """Rows of an IMU that were stamped in packets at the times of their own; `stamps` are the file's."""
    t = rows["t"]
    spread = spread_packets(t, find_repeats(rows.columns))
    if spread is None:
        return rows
    rounded = tell_rounding(stamps, np.r_[False, np.diff(t) == 0.0])
    of.remarks.add("imu.packets", f"{describe_packets(spread[1])}{rounded}")
    return rows.with_column("t", spread[0])


def _drop_repeated(rows: Table, stamps: Array, of: _Sensor) -> Table:
    """One row of each time; `stamps` are the file's."""
    t = rows["t"]
    repeated = find_repeated(f"{rows.path}, column '{rows.file_names['t']}'", t)
    if not repeated.any():
        return rows
    of.remarks.add(
        f"{of.name}.rows_repeated",
        f"{format_row_count(repeated, of.label)} with the time of the row before dropped "
        f"(first at t = {t[repeated][0]:.3f} s){tell_rounding(stamps, repeated)}",
    )
    return rows.take(~repeated)


def _drop_held(rows: Table, of: _Sensor) -> Table:
    """One row of each fix."""
    new = mask_new_fixes(rows.columns)
    if new.all():
        return rows
    held = format_row_count(~new, of.label)
    rows = rows.take(new)
    of.remarks.add("gnss.held", f"{held} with the fix of the row before left out, {len(rows)} kept")
    return rows


def mask_new_fixes(columns: Mapping[str, Array]) -> NDArray[np.bool_]:
    """(N,) which rows of fixes are new, for a log that repeats the last fix until there is another.

    In such a log most fixes, between two that differ, fill two rows or more, identical except for their time. A
    standing receiver that rounds repeats itself too, but not between two fixes in motion.
    """
    same = find_repeats(columns)
    changes = np.flatnonzero(~same) + 1
    held = len(changes) > 2 and float(np.median(np.diff(changes))) >= 2.0
    return np.r_[True, ~same] if held else np.ones(len(columns["t"]), dtype=bool)


def choose_sigmas(
    rows: Table,
    names: tuple[str, str, str],
    stated: tuple[float, float, float] | None,
    default: tuple[float, float, float],
    what: str,
    used: Selection,
    remarks: Notes,
) -> Array:
    """The 1-sigmas of `used` rows (N, 3): the file's, else the .toml's, else a default that is remarked on.

    Raises
    ------
    RecordingError
        If the file holds a sigma below zero, or only zeros and blanks.
    """
    of = what.lower().replace(" ", "_")  # gnss_position
    there = [name for name in names if name in rows]
    if there == ["sd_e", "sd_n"]:  # as of phones: heights are twice as uncertain
        up = np.hypot(rows["sd_e"], rows["sd_n"]) * np.sqrt(2.0)
        rows, there = rows.with_column("sd_u", up if stated is None else np.full(len(rows), stated[2])), list(names)
        taken = "twice the horizontal ones are" if stated is None else "that of sd in [gnss] is"
        remarks.add(f"{of}.sigma_partly", f"{what} sigmas of heights: no column sd_u: {taken} taken")
    fallback = np.array(stated or default)
    assumed = f"{what} sigmas of {default[0]:g}, {default[1]:g}, {default[2]:g} (east, north, up) are assumed"
    if len(there) < 3:
        if there:
            remarks.add(
                f"{of}.sigma_partly",
                f"{what} sigmas need {', '.join(names)}; only {', '.join(there)} is there, so it is not used",
            )
        if stated is None:
            remarks.add(f"{of}.sigma_assumed", f"{assumed}: neither the file nor the description states any")
        return np.tile(fallback, (len(rows), 1))
    sd = rows.stack(*names)
    for k, name in enumerate(names):
        zero = used & (sd[:, k] == 0)
        floor = _find_floor(sd[used & (sd[:, k] > 0), k])
        bad = np.flatnonzero(used & ((sd[:, k] < 0) | ((sd[:, k] < _LEAST_SIGMA) & ~zero) | (zero & (floor is None))))
        if len(bad):
            raise RecordingError(
                f"{rows.describe_place(bad[0], name)}: a 1-sigma must be above zero, not {sd[bad[0], k]:g}",
                key="table.sigma",
            )
        if zero.any():
            sd[zero, k] = floor
            remarks.add(
                f"{of}.sigma_zero",
                f"{what} sigma {name} is 0 in {zero.sum()} of {len(rows)} rows: rounded away, {floor:g} is taken there "
                "(half of the column's last digit, or its smallest above zero)",
            )
    blank = np.isnan(sd)
    if stated is None and (n := (blank.any(-1) & used).sum()):
        remarks.add(
            f"{of}.sigma_blank", f"{assumed} where the file's own are blank ({n} of {format_count(len(rows), 'row')})"
        )
    return np.where(blank, fallback, sd)


_DELIBERATE_DECIMALS = 5  # decimals in deliberate use; with more, a column is not rounded


def _find_floor(positive: Array) -> float | None:
    """The largest sigma that could have been printed as zero: half a unit of the last decimal of its column.

    In an unrounded column it is the smallest positive value; None where there is none.
    """
    if not len(positive):
        return None
    for digits in range(_DELIBERATE_DECIMALS + 1):
        scaled = positive * 10.0**digits
        if np.abs(scaled - np.round(scaled)).max() < 1e-6 * max(1.0, scaled.max()):
            return float(0.5 * 10.0**-digits)
    return float(positive.min())


def parse_fix_types(rows: Table, numbers: str) -> NDArray[np.intp] | None:
    """Types (N,) of the fixes of a table with such a column, in the numbers of "rtklib" or "nmea".

    Raises
    ------
    RecordingError
        For a number that is no type, naming the line and the numbers there are.
    """
    types, known = rows["type"], NMEA_TYPES if numbers == "nmea" else {k: k for k in FIX_TYPES}
    bad = np.flatnonzero(~np.isnan(types) & ~np.isin(types, list(known)))
    if len(bad):
        there = ", ".join(f"{k} {FIX_TYPES[ours]}" for k, ours in known.items() if ours)
        hint = "" if numbers == "nmea" else '; if they are GGA\'s, set units = { type = "nmea" }'
        where = rows.describe_place(bad[0], "type")
        raise RecordingError(
            f"{where}: {types[bad[0]]:g} is no type of fix: {there}, blank where unknown{hint}", key="gnss.type"
        )
    return convert_fix_types(types, known)


def check_residuals(rows: Table) -> Array:
    """The rms (N,) of the residuals of fixes, m, NaN where unknown.

    Raises
    ------
    RecordingError
        If one is below zero.
    """
    rms = rows["resid_rms_m"]
    bad = np.flatnonzero(rms < 0.0)
    if len(bad):
        raise RecordingError(
            f"{rows.describe_place(bad[0], 'resid_rms_m')}: an rms of residuals is no less than zero, not "
            f"{rms[bad[0]]:g}; leave it blank where it is unknown",
            key="gnss.residuals",
        )
    return rms
