"""Trajectory files, ours and other programs', read into a `Trajectory`; the kind is seen from the content.

=================  ====================================================================================
graphnav CSV       a header line with t, lat, lon, h (deg, m) or x, y[, z] (m, a local frame), and any of
                   ve vn vu, roll pitch heading, sd_e ... sd_heading, bgx ... baz; a unit may be part of a
                   name (t_s, lat_deg, h_m, ve_mps); vd is turned into vu
other CSV          the same under other names, units and separators (`graphnav.recording.draft.references`)
KF-GINS .nav       11 columns: GNSS week, seconds of week, lat, lon (deg), height (m), velocity north, east,
                   down (m/s), roll, pitch, yaw (deg) of a forward-right-down body to north-east-down in ZYX
                   order (the project's README, section 2), which are our roll, pitch and heading
TUM                8 columns: t x y z qx qy qz qw, a local frame
RTKLIB .pos        header lines with %, then date and time (or week and seconds) and any of RTKLIB's forms of a
                   position (`graphnav.recording.formats.rtklib_solution`)
=================  ====================================================================================

Files with a GNSS week give t in seconds of the week of their first row, running on past its end.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from graphnav.core import rotation
from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import WEEK
from graphnav.core.trajectory import Trajectory
from graphnav.recording.formats.columns import match_attitude, match_columns
from graphnav.recording.formats.rtklib_solution import parse_solution
from graphnav.recording.formats.schema import HEIGHT, SPEED
from graphnav.recording.formats.text import parse_table, split_lines
from graphnav.sensors.tables import LATEST

_RTKLIB = re.compile(r"program\s*:|\bQ\b.*\bns\b")  # of its header, other programs have comments from % as well
_MAX_COORDINATE = 1e8  # m, twice around the Earth, whatever the coordinates' origin
_DEG = np.pi / 180.0
_COLUMN_UNITS = {"t": "s", "lat": "deg", "lon": "deg", "h": "m", "x": "m", "y": "m", "z": "m"} | dict.fromkeys(
    ("ve", "vn", "vu", "vd"), "mps"
)
_COLUMN_UNITS |= dict.fromkeys(("roll", "pitch", "heading"), "deg")
_SIGMA_COLUMNS = "sd_e sd_n sd_u sd_ve sd_vn sd_vu sd_roll sd_pitch sd_heading"
_MOTION = {"ve", "vn", "vu", "vd", "roll", "pitch", "heading"}
# columns that are read; others may hold anything
_KNOWN_COLUMNS = {*_COLUMN_UNITS, *_SIGMA_COLUMNS.split(), *["bgx", "bgy", "bgz", "bax", "bay", "baz"]}


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory file of any kind in the table above, gzipped or not.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    Trajectory
        Latitude and longitude in rad, height above the ellipsoid in m, or metres of a local frame (`frame`);
        velocities in the local east, north, up, m/s; angles in rad.

    Raises
    ------
    RecordingError
        If it cannot be read; the message names the file and, if there is one, the line and field.
    """
    path = Path(path)
    lines = split_lines(path)
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    rows = [(number, line) for number, line in numbered if line.lstrip()[0] not in "#%"]
    if not rows:
        raise RecordingError(f"{path}: no rows in it; a trajectory file needs at least one", key="file.no_rows")
    first = rows[0][1]
    head = [line.strip() for _, line in numbered if line.lstrip()[0] == "%"]
    if any(_RTKLIB.search(line) for line in head):
        solution = parse_solution(path, head, rows)
        parts = vars(solution).copy()
        return _build(path, rows, parts.pop("t"), parts.pop("llh"), parts.pop("notes"), **parts)
    if re.match(r"\s*\d{4}/\d\d/\d\d[\s,]", first):
        raise RecordingError(
            f"{path}: an RTKLIB solution without its header; write it again with out-outhead=on", key="rtklib.no_header"
        )
    if re.search(r"[A-Za-z_]{1,}", re.sub(r"(?i)\bnan\b|\d[eE][-+]?\d", "", first)):
        return _read_csv(path, rows)
    width = len(first.split())
    if width == 11:
        return _read_kf_gins(path, rows)
    if width == 8:
        return _read_tum(path, rows)
    raise RecordingError(
        f"{path}, line {rows[0][0]}: {width} columns without a header; expected a CSV header with t, lat, lon, h, "
        "11 columns (KF-GINS .nav), 8 columns (TUM) or an RTKLIB .pos",
        key="table.no_header",
    )


def _build(
    path: Path,
    rows: list[tuple[int, str]],
    t: Array,
    position: Array,
    notes: Notes,
    local: bool = False,
    gps_zero: float | None = None,
    **optional: Array | None,
) -> Trajectory:
    """Check time and position and drop unusable rows, with notes."""
    numbers = np.array([number for number, _ in rows])
    if (bad := ~(np.abs(t) <= LATEST)).any():
        raise RecordingError(f"{path}, line {numbers[bad][0]}, t: {t[bad][0]:g} is no time in s", key="table.cell")
    if (bad := np.diff(t) < 0).any():
        k = int(np.flatnonzero(bad)[0])
        raise RecordingError(
            f"{path}, line {numbers[k + 1]}, t: {t[k + 1]:.6f} comes after {t[k]:.6f}; sort the rows by time",
            key="table.time_order",
        )
    if not local:
        limits = np.array([90.0 * _DEG, 360.0 * _DEG])
        if (bad := np.abs(position[:, :2]) > limits * (1 + 1e-12)).any():
            k, axis = (int(i) for i in np.argwhere(bad)[0])
            name = ("lat", "lon")[axis]
            raise RecordingError(
                f"{path}, line {numbers[k]}, {name}: {position[k, axis] / _DEG:.6f} deg is out of range",
                key="table.place",
            )
    metres = position if local else position[:, 2:]
    if (bad := np.abs(metres) > _MAX_COORDINATE).any():
        k, axis = (int(i) for i in np.argwhere(bad)[0])
        raise RecordingError(
            f"{path}, line {numbers[k]}: {metres[k, axis]:g} m is no place of a drive", key="table.place"
        )
    usable = np.isfinite(position[:, :2]).all(1) if local else np.isfinite(position).all(1)
    fresh = np.concatenate([[True], np.diff(t) > 0])
    if not usable.all():
        notes.add(
            "trajectory.no_position",
            f"{path.name}: {format_count(int(np.sum(~usable)), 'row')} without a position left out",
        )
    if not fresh.all():
        notes.add(
            "trajectory.repeated",
            f"{path.name}: left out {format_count(int(np.sum(~fresh)), 'row')} with the time of the row before",
        )
    keep = usable & fresh
    if not keep.any():
        raise RecordingError(f"{path}: no row has a position", key="table.all_blank")
    present = {
        key: value[keep] for key, value in optional.items() if value is not None and not np.isnan(value[keep]).all()
    }
    return Trajectory(
        t=t[keep],
        llh=position[keep],
        gps_zero=gps_zero,
        frame="local" if local else "geodetic",
        name=path.stem,
        notes=tuple(notes),
        **present,
    )


def _read_csv(path: Path, rows: list[tuple[int, str]]) -> Trajectory:
    names = [field.strip().strip('"') for field in rows[0][1].split(",")]
    rows = rows[1:]
    if not rows:
        raise RecordingError(f"{path}: a header and no rows", key="file.no_rows")
    # a unit of ours may be part of the name; any other is left in the name, which is then not found
    columns = {(base if _COLUMN_UNITS.get(base := name.rpartition("_")[0]) == name.rpartition("_")[2] else name): k
               for k, name in enumerate(names)}  # fmt: skip
    local = "lat" not in columns and {"x", "y"} <= columns.keys()
    needed = ("t", "x", "y") if local else ("t", "lat", "lon", "h")
    theirs = match_columns(names).names | match_attitude(names).names
    other = theirs.keys() & _MOTION - columns.keys() and not columns.keys() & set(_SIGMA_COLUMNS.split())
    if any(name not in columns for name in needed) or (other and not local):
        return _read_reference(path)
    wanted = {names[k] for name, k in columns.items() if name in _KNOWN_COLUMNS}
    table = parse_table(path, rows, names, ",", wanted)

    def take(*wanted: str, scale: float = 1.0) -> Array | None:
        if not any(name in columns for name in wanted):
            return None
        missing = np.full(len(table), np.nan)
        return scale * np.column_stack([table[:, columns[n]] if n in columns else missing for n in wanted])

    v = take("ve", "vn", "vu")
    if v is not None and "vu" not in columns and "vd" in columns:
        v[:, 2] = -table[:, columns["vd"]]
    position = take("x", "y", "z") if local else take("lat", "lon", "h")
    assert position is not None
    if not local:
        position[:, :2] *= _DEG
    return _build(
        path, rows, table[:, columns["t"]], position, Notes(),
        v=v, rph=take("roll", "pitch", "heading", scale=_DEG), sd_p=take("sd_e", "sd_n", "sd_u"),
        sd_v=take("sd_ve", "sd_vn", "sd_vu"), sd_rph=take("sd_roll", "sd_pitch", "sd_heading", scale=_DEG),
        gyro_bias=take("bgx", "bgy", "bgz"), accel_bias=take("bax", "bay", "baz"),
        local=local,
    )  # fmt: skip


def _read_reference(path: Path) -> Trajectory:
    """A table with other columns, as `graphnav init` reads it."""
    from graphnav.recording.draft.references import describe, read_reference

    source = read_reference(path)
    missing = np.full(len(source), np.nan)

    def take(*wanted: str, scale: float) -> Array | None:
        there = [name for name in wanted if name in source.values]
        return np.column_stack([source.values.get(name, missing) * scale for name in wanted]) if there else None

    height = HEIGHT[source.find_unit("h", "length") or "m"]
    v = take("ve", "vn", "vu", scale=SPEED[source.find_unit("ve", "speed") or "m/s"])
    if v is not None and "vd" in source.values and "vu" not in source.values:
        v[:, 2] = -source.values["vd"] * SPEED[source.find_unit("vd", "speed") or "m/s"]
    notes = Notes()
    notes.add("trajectory.columns", f"{path.name}: {describe(source)}")
    rows = [(0, "")] * len(source)  # in order, and whole
    return _build(
        path, rows, source.t, source.llh * [1.0, 1.0, height], notes, v=v,
        rph=take("roll", "pitch", "heading", scale=_DEG), gps_zero=source.gps_zero,
    )  # fmt: skip


def _read_kf_gins(path: Path, rows: list[tuple[int, str]]) -> Trajectory:
    names = ["week", "sow", "lat", "lon", "h", "vn", "ve", "vd", "roll", "pitch", "yaw"]
    table = parse_table(path, rows, names, None)
    t = table[:, 1] + WEEK * (table[:, 0] - table[0, 0])  # KF-GINS itself writes week 0
    position = np.column_stack([table[:, 2:4] * _DEG, table[:, 4]])
    v = np.column_stack([table[:, 6], table[:, 5], -table[:, 7]])
    zero = WEEK * table[0, 0] if table[0, 0] > 0.0 else None
    return _build(path, rows, t, position, Notes(), gps_zero=zero, v=v, rph=table[:, 8:11] * _DEG)


def _read_tum(path: Path, rows: list[tuple[int, str]]) -> Trajectory:
    names = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
    table = parse_table(path, rows, names, None)
    norm = np.linalg.norm(table[:, 4:8], axis=1)
    if (bad := ~(np.abs(norm - 1.0) <= 1e-2)).any():
        k = int(np.flatnonzero(bad)[0])
        raise RecordingError(
            f"{path}, line {rows[k][0]}, qx qy qz qw: a norm of {norm[k]:.4f}; expected a unit quaternion",
            key="table.quaternion",
        )
    rph = rotation.to_rph(rotation.from_quaternion(table[:, [7, 4, 5, 6]]))
    return _build(path, rows, table[:, 0], table[:, 1:4], Notes(), rph=rph, local=True)
