"""Sensors from the CSV files of recording.toml, whose tables describe the columns held in `rows`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.recording import Gnss, Imu, ImuNoise, Odometer, Truth
from graphnav.recording.formats import schema
from graphnav.recording.formats.courses import blank_unknown, compute_horizontal_velocity
from graphnav.recording.formats.increments import compute_periods, note_gaps
from graphnav.recording.formats.places import convert_geodetic
from graphnav.recording.formats.pulses import count_pulses
from graphnav.recording.formats.repair import (
    DEFAULT_SD,
    DEFAULT_SD_V,
    VAGUEST,
    VAGUEST_V,
    check_residuals,
    choose_sigmas,
    parse_fix_types,
)
from graphnav.recording.formats.table import Table
from graphnav.recording.plausibility.fixes import FASTEST
from graphnav.sensors import Sensor, Series
from graphnav.sensors.tables import ANGLE

_ROWS_AT_ONCE = 1 << 16  # rows at once
_SD_V = ("sd_ve", "sd_vn", "sd_vu")


def build_imu(d: schema.ImuTable, rows: Table, remarks: Notes) -> Imu:
    """Samples in body axes RFU, rad/s and m/s^2, with the stated noise figures, else a consumer IMU's."""
    R_bs = d.R_bs
    turned, pushed = d.units.gyro in schema.ANGLE_STEPS, d.units.accel in schema.VELOCITY_STEPS
    gyro = _take_in_body(rows, ("gx", "gy", "gz"), (schema.RATE_UNITS | schema.ANGLE_STEPS)[d.units.gyro], R_bs)
    accel = _take_in_body(rows, ("ax", "ay", "az"), (schema.FORCE | schema.VELOCITY_STEPS)[d.units.accel], R_bs)
    if turned or pushed:
        dt, gap = compute_periods(rows["t"])
        note_gaps(gap, remarks)
        for steps, some in ((turned, gyro), (pushed, accel)):
            if steps:
                some /= dt[:, None]
    stated = d.figures
    noise = replace(ImuNoise(), **stated)
    missing = [key for key in schema.STATED_FIGURES if key not in stated]
    if 0 < len(missing) < len(schema.STATED_FIGURES):
        remarks.add(
            "imu.noise_partly", f"[imu.noise] does not state {', '.join(missing)}: defaults of a consumer IMU are used"
        )
    elif missing:
        remarks.add(
            "imu.noise_assumed",
            "no [imu.noise]: figures of a consumer IMU are assumed "
            f"(gyro {noise.gyro_noise_density:g} rad/s/sqrt(Hz), "
            f"accelerometer {noise.accel_noise_density:g} m/s2/sqrt(Hz))",
        )
    return Imu(rows["t"], gyro, accel, noise, R_bs, noise_assumed=len(missing) == len(schema.STATED_FIGURES))


def _take_in_body(rows: Table, names: tuple[str, ...], unit: float, R_bs: Array) -> Array:
    """Columns (N, 3) in body axes, removed from the table: for a day of rows nothing is held twice."""
    out = np.empty((len(rows), 3))
    for k in range(0, len(out), _ROWS_AT_ONCE):
        some = slice(k, k + _ROWS_AT_ONCE)
        np.matmul(np.stack([rows[name][some] for name in names], -1) * unit, R_bs.T, out=out[some])
    rows.release(*names)
    return out


def build_gnss(d: schema.GnssTable, rows: Table, remarks: Notes) -> Gnss:
    """Fixes (rad, m) with their sigmas, without those of useless precision; velocities where all axes are given."""
    rows, known = blank_unknown(rows)
    if not known.all():
        remarks.add(
            "gnss.sigma_unknown", f"{format_count((~known).sum(), 'fix', 'fixes')} of accuracy -1 (unknown) left out"
        )
        rows = rows.take(known)
    if schema.GEOID in d.columns and schema.GEOID in rows:
        rows = rows.with_column("h", rows["h"] + _fill(rows[schema.GEOID], rows))
    llh, rows = convert_geodetic(rows, d.units.angle, schema.HEIGHT[d.units.height], "GNSS", remarks)
    every = np.ones(len(rows), dtype=bool)
    sd = choose_sigmas(rows, ("sd_e", "sd_n", "sd_u"), d.sd, DEFAULT_SD, "GNSS position", every, remarks)
    vague = (sd > VAGUEST).any(axis=1)
    if vague.any():
        if vague.all():
            raise RecordingError(
                f"{rows.path}: every fix has a sigma of more than {VAGUEST:g} m and carries no information",
                key="gnss.sigma_all_vague",
            )
        remarks.add(
            "gnss.sigma_vague",
            f"{format_count(vague.sum(), 'fix', 'fixes')} with a sigma of more than {VAGUEST:g} m left out",
        )
        llh, sd, rows = llh[~vague], sd[~vague], rows.take(~vague)
    v, sd_v = _build_velocities(d, rows, remarks)
    kinds = parse_fix_types(rows, d.units.type) if "type" in rows else None
    gnss = Gnss(
        rows["t"], llh, sd, v, sd_v, np.array(d.lever_arm), kinds, kinds is not None and d.units.type == "rtklib",
        velocity_offset=d.velocity_offset,
    )  # fmt: skip
    if (count := next((name for name in ("satellites", "nsat") if name in rows), None)) is not None:
        gnss = replace(gnss, satellites=rows[count])
    return replace(gnss, residual_rms=check_residuals(rows)) if "resid_rms_m" in rows else gnss


def _build_velocities(d: schema.GnssTable, rows: Table, remarks: Notes) -> tuple[Array | None, Array | None]:
    """Velocities (N, 3) m/s, of three axes or of speed and course, and their 1-sigmas; None where there are none."""
    scale = schema.SPEED[d.units.speed]
    for name in _SD_V:  # the file's sigmas have the file's unit, those of the .toml m/s
        rows = rows.with_column(name, rows[name] * scale) if name in rows else rows
    if "vd" in rows and "vu" not in rows:
        rows = rows.with_column("vu", -rows["vd"])
    there = [c for c in ("ve", "vn", "vu") if c in rows]
    if len(there) == 3:
        return _take_velocities(d, rows, rows.stack("ve", "vn", "vu") * scale, remarks)
    if "speed" in rows and "course" in rows:
        course = rows["course"] * ANGLE[d.units.angle or "deg"]
        stated = np.array(d.sd_v or DEFAULT_SD_V)
        if any(name in rows for name in _SD_V):
            known = np.isfinite(rows["speed"])
            stated = choose_sigmas(rows, _SD_V, d.sd_v, DEFAULT_SD_V, "GNSS velocity", known, remarks)
        v, sd_v, sentence = compute_horizontal_velocity(rows["speed"] * scale, course, stated)
        remarks.add("gnss.velocity_of_course", sentence)
        return v, sd_v
    if there:
        remarks.add(
            "gnss.velocity_partly",
            f"GNSS velocities need ve, vn and vu; only {', '.join(there)} is there, so none are used",
        )
    return None, None


def _take_velocities(d: schema.GnssTable, rows: Table, v: Array, remarks: Notes) -> tuple[Array | None, Array | None]:
    """The velocities (N, 3) m/s of a file, and their 1-sigmas, without impossible and vague ones; None without any."""
    absent = np.isnan(v).any(-1)
    beyond = ~absent & (np.linalg.norm(v, axis=1) > FASTEST)
    if 0 < beyond.sum() < 0.5 * len(v):  # else in another unit
        remarks.add(
            "gnss.velocity_beyond",
            f"{format_count(beyond.sum(), 'GNSS velocity', 'GNSS velocities')} of more than {FASTEST:g} m/s, "
            f"which no land vehicle reaches, left out (first at t = {rows['t'][beyond][0]:.3f} s)",
        )
        absent |= beyond
    v[absent] = np.nan
    sd_v = choose_sigmas(rows, _SD_V, d.sd_v, DEFAULT_SD_V, "GNSS velocity", ~absent, remarks)
    absent |= (sd_v > VAGUEST_V).any(-1)
    v[absent] = sd_v[absent] = np.nan
    if absent.all():
        remarks.add("gnss.velocity_blank", "the GNSS velocity columns are blank throughout: no velocities")
        return None, None
    return v, sd_v


def _fill(values: Array, rows: Table) -> Array:
    """A column that changes slowly, without blanks.

    Raises
    ------
    RecordingError
        If all of it is blank.
    """
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        raise RecordingError(
            f"{rows.path}: the column of columns.geoid is blank; leave it out, or fill it in", key="table.column"
        )
    return np.asarray(np.interp(np.arange(len(values)), known, values[known]))


def build_odometer(d: schema.OdometerTable, rows: Table, remarks: Notes) -> Odometer:
    """Speeds, m/s, from a speed, from several wheels, or from counted pulses."""
    t, scale = rows["t"], schema.SPEED[d.units.speed]
    used = d.list_readings(tuple(rows.columns))
    wheels = distance = None
    if any(name in rows for name in schema.WHEELS):
        wheels = np.stack([rows.get(name, np.full(len(t), np.nan)) for name in schema.WHEELS], -1) * scale
    if d.metres_per_pulse is not None:
        if len(t) < 2:
            raise RecordingError(
                f"{rows.path}: {len(t)} usable row; pulses need at least 2 to make a speed", key="table.few_rows"
            )
        distance = d.metres_per_pulse * count_pulses(rows["pulses"], d.pulses, d.signed, remarks)
        # over both adjacent periods, so that it is the speed at t and not half a period earlier
        ahead, behind = np.minimum(np.arange(len(t)) + 1, len(t) - 1), np.maximum(np.arange(len(t)) - 1, 0)
        speed = (distance[ahead] - distance[behind]) / (t[ahead] - t[behind])
    else:
        speed = rows.stack(*used).mean(axis=-1) * scale
    signed = bool((speed < 0.0).any()) if d.signed is None else d.signed
    return Odometer(
        t,
        speed,
        np.array(d.lever_arm),
        d.scale_sigma,
        counted=distance,
        pulse=d.metres_per_pulse or 0.0,
        wheels=wheels,
        signed=signed,
        speed_sigma=d.speed_sigma,
        delay_sigma=d.delay_sigma,
    )


def list_needed(sensor: Sensor, rows: Table) -> tuple[str, ...]:
    """The columns that every row must have: the first of the sets that the file contains.

    Raises
    ------
    RecordingError
        If it has none of them.
    """
    for some in sensor.needs:
        if all(name in rows for name in some):
            # of several sets a row may have any, which `Sensor.mask_usable` checks
            return some if len([s for s in sensor.needs if all(name in rows for name in s)]) == 1 else ()
    sets = " or ".join(" and ".join(some) for some in sensor.needs)
    raise RecordingError(
        f'{rows.path}: no column {sets}; if it has another name, set columns = {{ name = "..." }}', key="table.column"
    )


def build_series(sensor: Sensor, d: Any, rows: Table, remarks: Notes) -> Series:
    """Rows of a sensor of `graphnav.sensors` in SI units, without those that measure nothing."""
    absent = np.full(len(rows), np.nan)
    sizes = [column.units[getattr(d.units, column.name)] for column in sensor.columns]
    values = np.stack([rows.get(name, absent) * size for name, size in zip(sensor.names, sizes, strict=True)], -1)
    figures = sensor.figures(**{name: getattr(d, name) for name in sensor.figures.model_fields})
    whole = sensor.mask_usable(values)
    if not whole.all():
        remarks.add(
            f"{sensor.name}.rows_blank",
            f"{format_count((~whole).sum(), sensor.name + ' row')} without a measurement dropped",
        )
    return Series(sensor, rows["t"][whole], values[whole], figures)


def build_truth(d: schema.TruthTable, rows: Table, remarks: Notes) -> Truth:
    """Reference positions, and velocities (m/s) and angles (rad) where the file has them."""
    llh = xyz = None
    if d.frame == "local":
        xyz = rows.stack("x", "y", "z") if "z" in rows else rows.stack("x", "y")
    else:
        llh, rows = convert_geodetic(rows, d.units.angle, schema.HEIGHT[d.units.height], "truth", remarks)
    if "vd" in rows and "vu" not in rows:
        rows = rows.with_column("vu", -rows["vd"])
    v = _read_part(rows, ("ve", "vn", "vu"), schema.SPEED[d.units.speed])
    rph = _read_part(rows, ("roll", "pitch", "heading"), ANGLE[d.units.angle or "deg"])
    return Truth(rows["t"], llh, xyz, v, rph, d.of)


def _read_part(rows: Table, names: tuple[str, ...], scale: float) -> Array | None:
    """Columns of which some may be missing (NaN then); None if all are."""
    if not any(name in rows for name in names):
        return None
    absent = np.full(len(rows), np.nan)
    return np.stack([rows.get(name, absent) for name in names], -1) * scale
