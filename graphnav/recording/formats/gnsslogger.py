"""Text logs of Android's GnssLogger, and of apps that write its form: the fixes and inertial sensors of a phone.

A line begins with its kind; header lines (# Fix,Provider,...) name the fields. What they mean is from GnssLogger's
LOGGING.md (github.com/google/gps-measurement-tools) and Android's Location and SensorEvent: altitude above the
ellipsoid; accuracies at 68 %, of the horizontal one as a radius; elapsedRealtimeNanos since boot, one clock for all.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_number, read_bytes
from graphnav.core.findings import compute_period
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import UNIX, date_week_times, unix_to_gps
from graphnav.recording import Gnss, Imu
from graphnav.recording.formats.courses import compute_horizontal_velocity
from graphnav.recording.formats.registry import Log, log_format, read_first_bytes
from graphnav.recording.formats.repair import DEFAULT_SD, DEFAULT_SD_V, LATEST

_BEGIN = re.compile(
    rb"^(?:#\s*)?(?:Raw,(?:utcTime|Elapsed)|Fix,(?:Provider|GPS|gps|FLP),|(?:Uncal)?(?:Gyro|Accel),\w)", re.M
)
_RADIUS = float(np.sqrt(-2.0 * np.log(1.0 - 0.68)))  # of 68 % in two dimensions, in 1-sigmas of an axis
_HOLE = 3.0  # periods; between forces farther apart none is interpolated
# kinds of the gyro and the accelerometer; those of which the phone subtracts no changing bias come first
_GYRO, _ACCEL = ("UncalGyro", "Gyro"), ("UncalAccel", "Accel")
# our names -> beginnings of the header's, in lower case; and the fields of logs without a header
_FIX: dict[str, tuple[str, ...]] = {
    "lat": ("latitude",), "lon": ("longitude",), "h": ("altitude",), "speed": ("speed",), "course": ("bearing",),
    "accuracy": ("accuracy",), "unix": ("unixtime", "(utc)time"), "boot": ("elapsedrealtime",),
    "vertical": ("verticalaccuracy",), "of_speed": ("speedaccuracy",),
}  # fmt: skip
_FIELDS = (
    "Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,BearingDegrees,UnixTimeMillis"
    ",SpeedAccuracyMps,BearingAccuracyDegrees,elapsedRealtimeNanos,VerticalAccuracyMeters"
)


def recognises(path: Path) -> bool:
    """Whether one of the first lines is of such a log, or of its header."""
    return _BEGIN.search(read_first_bytes(path, 1 << 15)) is not None


def load(path: Path) -> Log:
    """Read the fixes of the GNSS provider, and the IMU in the axes of the phone.

    Raises
    ------
    RecordingError
        If neither is in it.
    """
    remarks = Notes()
    fixes, sensors, unix = _collect_rows(path, remarks)
    chosen = next((some for some in ("gps", "flp", "fused") if some in fixes), None)
    table = np.array(fixes[chosen]) if chosen else np.empty((0, len(_FIX)))
    if others := {name: rows for name, rows in fixes.items() if name != chosen}:
        many = ", ".join(f"{len(rows)} {name}" for name, rows in others.items())
        remarks.add("gnss.providers", f"GNSS: fixes of other providers left out: {many}")
    if chosen not in (None, "gps"):
        remarks.add(
            "gnss.dead_reckoning", "the fixes are a phone's fused ones: they may already have its sensors in them"
        )
    stamps = dict(zip(_FIX, table.T, strict=True))
    both = np.isfinite(stamps["boot"])
    if both.any():  # the receiver's UTC at a time since boot
        ahead = float(np.median(stamps["unix"][both] * 1e-3 - stamps["boot"][both] * 1e-9))
    else:
        ahead = float(np.median(unix)) if unix else 0.0
        if unix and len(table):
            remarks.add("log.sensor_clock", "clock of the sensors: the phone's UTC, not the receiver's")
    imu = _join_imu(sensors, ahead, remarks)
    gnss = _make_gnss(stamps, remarks) if len(table) else None
    if imu is None and gnss is None:
        raise RecordingError(
            f"{path}: no fixes, and not both a gyro and an accelerometer{''.join(f'; {remark}' for remark in remarks)}",
            key="log.no_messages",
        )
    first = min(float(one.t[0]) for one in (imu, gnss) if one is not None)
    zero = date_week_times(unix_to_gps(np.array([first])))[1]
    if imu is not None:
        imu = Imu(unix_to_gps(imu.t) - zero, imu.gyro, imu.accel, noise_assumed=True)
    if gnss is not None:
        gnss = Gnss(unix_to_gps(gnss.t) - zero, gnss.llh, gnss.sd, gnss.v, gnss.sd_v)
    remarks.add("log.clock", "clock: UTC turned into GPS time, seconds of the GPS week")
    return Log(path.stem, imu, gnss, gps_zero=zero, mount_known=False, remarks=tuple(remarks))


_Rows = dict[str, list[list[float]]]


def _collect_rows(path: Path, remarks: Notes) -> tuple[_Rows, _Rows, list[float]]:
    """Fixes by provider, in the order of `_FIX`; sensors by kind, s since boot, values and biases; and what is to be
    added to these s for the phone's UTC.
    """
    fixes: _Rows = {}
    sensors: _Rows = {}
    unix: list[float] = []
    broken: list[int] = []
    unused = Counter[str]()
    at = _find_fields(_FIELDS)
    lines = read_bytes(path).split(b"\n")
    cut = lines.pop() != b""  # after the last line that is whole
    for number, raw in enumerate(lines, 1):
        kind, _, rest = raw.partition(b",")
        name = kind.decode("ascii", "replace")
        if raw[:1] == b"#":
            if name[1:].strip() == "Fix":
                at = _find_fields(raw.decode("ascii", "replace")[1:])
            continue
        try:
            if name in (*_GYRO, *_ACCEL):
                utc, boot, *values = [parse_number(x) for x in rest.decode("ascii").split(",")[:8]]
                if len(values) < 3 or not _is_date(utc * 1e-3) or not abs(boot * 1e-9) < LATEST:
                    raise ValueError("fields")
                sensors.setdefault(name, []).append([boot * 1e-9, *values, *[0.0] * (6 - len(values))])
                unix.append(utc * 1e-3 - boot * 1e-9)
            elif name == "Fix":
                cells = ["", *rest.decode("ascii").strip().split(",")]
                row = [parse_number(cells[k] or "nan") if k is not None and k < len(cells) else np.nan for k in at]
                if not _is_date(row[list(_FIX).index("unix")] * 1e-3):
                    raise ValueError("time")
                fixes.setdefault(cells[1].lower(), []).append(row)
            elif name.strip():
                unused[name] += 1
        except (ValueError, IndexError):
            broken.append(number)
    if broken or cut:
        where = f"line {broken[0]}" if broken else "last line"
        remarks.add(
            "log.broken_lines", f"{path.name}, {where}: not whole; skipped {len(broken) + cut} of {len(lines) + cut}"
        )
    if unused:
        many = ", ".join(f"{n} {name}" for name, n in unused.most_common(8))
        hint = "; of Raw, RINEX can be made for [raw_gnss]" if "Raw" in unused else ""
        remarks.add("log.unused", f"{path.name}: lines not used: {many}{hint}")
    return fixes, sensors, unix


def _is_date(t: float) -> bool:
    return UNIX < t < LATEST


def _find_fields(header: str) -> list[int | None]:
    """Where the values of `_FIX` are among the fields of a fix."""
    names = [name.strip().lower() for name in header.split(",")]
    return [next((k for k, name in enumerate(names) if name.startswith(begin)), None) for begin in _FIX.values()]


def _join_imu(sensors: _Rows, ahead: float, remarks: Notes) -> Imu | None:
    """Forces interpolated to the times of the rates, s of Unix time."""
    found = [max(kinds, key=lambda kind: len(sensors.get(kind, ()))) for kinds in (_GYRO, _ACCEL)]
    if not all(len(sensors.get(kind, ())) > 1 for kind in found):
        if sensors:
            remarks.add("imu.axes_missing", f"IMU: only {', '.join(sensors)} is in the log, so it is not used")
        return None
    gyro, accel = (np.array(sensors[kind]) for kind in found)
    gyro, accel = (rows[np.unique(rows[:, 0], return_index=True)[1]] for rows in (gyro, accel))
    t, at = gyro[:, 0], accel[:, 0]
    after = np.clip(np.searchsorted(at, t), 1, len(at) - 1)
    there = (t >= at[0]) & (t <= at[-1]) & (at[after] - at[after - 1] < _HOLE * compute_period(at))
    if there.sum() < 2:
        remarks.add("imu.axes_missing", f"IMU: {' and '.join(found)} are not of the same times, so it is not used")
        return None
    # the phone's own estimate of a bias, which it changes in steps, at its median
    rates, forces = (rows[:, 1:4] - np.median(rows[:, 4:7], axis=0) for rows in (gyro, accel))
    forces = np.stack([np.interp(t[there], at, forces[:, k]) for k in range(3)], -1)
    remarks.add(
        "imu.read_as",
        f"IMU: {found[0]} with {found[1]} interpolated to its times, less the medians of their biases; no noise "
        "figures in the log",
    )
    remarks.add("imu.axes_assumed", "IMU: the phone's axes taken as right-forward-up")
    return Imu(t[there] + ahead, rates[there], forces)


def _make_gnss(fix: dict[str, Array], remarks: Notes) -> Gnss | None:
    """Fixes with the phone's accuracies, s of Unix time."""
    t, first = np.unique(fix["unix"] * 1e-3, return_index=True)
    fix = {name: values[first] for name, values in fix.items()}
    known = np.isfinite(fix["lat"]) & np.isfinite(fix["lon"]) & np.isfinite(fix["h"])
    if not known.all():
        remarks.add(
            "gnss.rows_blank", f"GNSS: {format_count((~known).sum(), 'fix', 'fixes')} without a height left out"
        )
    if not known.any():
        return None
    t, fix = t[known], {name: values[known] for name, values in fix.items()}
    llh = np.stack([np.radians(fix["lat"]), np.radians(fix["lon"]), fix["h"]], -1)
    axis = np.where(fix["accuracy"] > 0.0, fix["accuracy"] / _RADIUS, DEFAULT_SD[0])
    up = np.where(fix["vertical"] > 0.0, fix["vertical"], 2.0 * axis)
    v = sd_v = None
    if np.isfinite(fix["speed"]).any():
        of_speed = np.where(fix["of_speed"] > 0.0, fix["of_speed"], DEFAULT_SD_V[0])
        sd_v = np.stack([of_speed, of_speed, np.maximum(of_speed, DEFAULT_SD_V[2])], -1)
        v, sd_v, sentence = compute_horizontal_velocity(fix["speed"], np.radians(fix["course"]), sd_v)
        remarks.add("gnss.velocity_of_course", sentence)
    remarks.add(
        "gnss.sigma_read_as",
        f"position sigmas: accuracy / {_RADIUS:.2f} east and north, vertical accuracy up, or twice that east",
    )
    return Gnss(t, llh, np.stack([axis, axis, up], -1), v, sd_v)


FORMAT = log_format(
    "gnsslogger", "Android's GnssLogger: Fix, UncalGyro and UncalAccel", recognises, lambda path, _: load(path)
)
