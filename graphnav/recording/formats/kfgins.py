"""Data sets of KF-GINS and OB_GINS (i2Nav group, Wuhan University): text files and the YAML file that names them.

Columns, units and axes are those of the tables in the README files of KF-GINS (section 2.2) and of
awesome-gins-datasets (section 3), and of the comments in the projects' configuration files:

IMU text (or the same as little-endian doubles, .bin)
    seconds of week, angle increments x y z (rad), velocity increments x y z (m/s) in forward-right-down;
    OB_GINS adds the odometer's speed (m/s) as an eighth column
GNSS text
    seconds of week, lat, lon (deg), height (m), sigmas north, east, down (m); with 13 columns a velocity
    north, east, down (m/s) comes before the sigmas and its own sigmas after them
YAML
    `graphnav.recording.formats.kfgins_configuration`
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import check_inside, parse_number, read_bytes
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import WEEK
from graphnav.recording import Gnss, Imu, Odometer, Truth
from graphnav.recording.formats.axes import parse_axes_letters
from graphnav.recording.formats.increments import compute_periods, note_gaps
from graphnav.recording.formats.kfgins_configuration import (
    find_file,
    mention_unused,
    read_configuration,
    read_imu_noise,
    read_lever_arm,
)
from graphnav.recording.formats.places import is_on_earth
from graphnav.recording.formats.registry import Log, log_format, read_first_bytes
from graphnav.recording.formats.text import parse_table, split_lines
from graphnav.recording.formats.trajectories import read_trajectory

_LARGEST = 0.3  # rad or m/s: larger than any increment of a sample
_IMU_KEYS, _GNSS_KEYS = ("imupath", "imufile"), ("gnsspath", "gnssfile")


def recognises(path: Path) -> bool:
    """Whether this is a configuration of either program, a folder with one, or one of their data files."""
    if path.is_dir():
        return _find_config(path) is not None or any(_guess_kind(p) == "imu" for p in _list_data_files(path))
    if path.suffix.lower() in (".yaml", ".yml"):
        return _names_data(path)
    return path.is_file() and _guess_kind(path) is not None


def load(path: Path, allow_outside: bool = False) -> Log:
    """Read a data set by its configuration, a folder of its files, or a single IMU or GNSS file.

    Parameters
    ----------
    allow_outside : whether files outside the folder may be read.

    Raises
    ------
    RecordingError
        Naming the file and the line, column or key that cannot be used.
    """
    remarks = Notes()
    config: dict[str, Any] = {}
    config_file = path if path.suffix.lower() in (".yaml", ".yml") else _find_config(path) if path.is_dir() else None
    if config_file is not None:
        config = read_configuration(config_file)
        imu_file = find_file(config_file, config, _IMU_KEYS, allow_outside)
        gnss_file = find_file(config_file, config, _GNSS_KEYS, allow_outside)
    else:
        imu_file, gnss_file = _find_pair(path)
        remarks.add(
            "log.no_configuration",
            "no configuration (.yaml) of KF-GINS or OB_GINS beside it: the antenna's lever arm is taken as zero",
        )
    files = [f for f in (config_file, imu_file, gnss_file) if f is not None]
    if path.is_dir() and not allow_outside:
        check_inside(files, path)
    where = config_file or path
    imu = odometer = gnss = truth = zero = None
    if imu_file is not None:
        imu, speed = _read_imu(imu_file, remarks)
        if config:
            imu = replace(imu, noise=read_imu_noise(where, config, remarks), noise_assumed=False)
        if speed is not None:
            odometer = Odometer(imu.t, speed, read_lever_arm(where, config, "odolever"))
            remarks.add(
                "odometer.read_as", "the eighth column of the IMU file is taken as the odometer's forward speed in m/s"
            )
    if gnss_file is not None:
        gnss = _read_fixes(gnss_file, read_lever_arm(where, config, "antlever"), remarks)
    folder = where.parent if config else where
    if nav := _find_truth(folder, remarks) if folder.is_dir() else None:
        if not allow_outside:
            check_inside([nav], folder)
        track = read_trajectory(nav)
        truth = Truth(track.t, track.llh, v=track.v, rph=track.rph)
        first = next(
            (line.split()[0] for line in split_lines(nav) if line.strip() and line.strip()[0] not in "#%"), "0"
        )
        week = parse_number(first)
        zero = WEEK * week if 0 < week < 10_000 else None  # KF-GINS itself writes week 0
        files.append(nav)
        remarks.add(
            "truth.read_as",
            f"truth: {nav.name}, of the IMU, with north-east-down velocities and roll, pitch, yaw of an FRD body",
        )
    mention_unused(config, remarks)
    remarks.add("log.clock", "clock: seconds of the GPS week, as in the files")
    return Log(
        path.stem if path.is_file() else path.resolve().name, imu, gnss, odometer, truth, gps_zero=zero,
        files=tuple(files), remarks=tuple(remarks),
    )  # fmt: skip


# ---- files


def _find_config(folder: Path) -> Path | None:
    found = [p for p in sorted(folder.iterdir()) if p.suffix.lower() in (".yaml", ".yml") and _names_data(p)]
    return found[0] if found else None


def _names_data(path: Path) -> bool:
    head = read_first_bytes(path, 1 << 16).decode("utf-8", errors="replace")
    return any(f"\n{key}:" in f"\n{head}" for key in _IMU_KEYS)


def _list_data_files(folder: Path) -> list[Path]:
    return [p for p in sorted(folder.iterdir()) if p.suffix.lower() in (".txt", ".pos", ".bin") and p.is_file()]


def _guess_kind(path: Path) -> str | None:
    """'imu' or 'gnss' by the numbers of the first rows, None for anything else."""
    rows = _read_first_rows(path)
    if rows is None:
        return None
    t, rest = rows[:, 0], rows[:, 1:7]
    if not (np.all(t >= 0) and np.all(t < 2e6) and np.all(np.diff(t) > 0)):
        return None
    if rows.shape[1] in (7, 8) and np.all(np.abs(rest) < _LARGEST) and np.all(np.diff(t) < 0.5):
        return "imu"
    if rows.shape[1] in (7, 13) and np.all(np.abs(rest[:, 0]) <= 90) and np.all(np.abs(rest[:, 1]) <= 360):
        large = np.abs(rest[:, :2]).max() > 1.0
        return "gnss" if large and np.all(rows[:, -3:] >= 0) else None
    return None


def _read_first_rows(path: Path) -> Array | None:
    raw = read_first_bytes(path)
    if path.suffix.lower() == ".bin":
        return np.frombuffer(raw[: len(raw) // 56 * 56], "<f8").reshape(-1, 7)[:20] if len(raw) >= 112 else None
    if b"\0" in raw:
        return None
    lines = [line.split() for line in raw.decode("utf-8", errors="replace").splitlines()[:21]]
    lines = [line for line in lines if line and line[0][0] not in "#%"][:-1] or lines[:1]
    try:
        rows = np.array(lines, dtype=float)
    except ValueError:
        return None
    return rows if rows.ndim == 2 and len(rows) else None


def _find_pair(path: Path) -> tuple[Path | None, Path | None]:
    if path.is_file():
        kind = _guess_kind(path)
        if kind is None:
            raise RecordingError(
                f"{path}: neither an IMU text (seconds of week, three angle and three velocity increments) nor a GNSS "
                "text (seconds of week, lat, lon, height, three sigmas) of KF-GINS",
                key="file.kind",
            )
        return (path, None) if kind == "imu" else (None, path)
    kinds = {p: _guess_kind(p) for p in _list_data_files(path)}
    out = []
    for wanted in ("imu", "gnss"):
        found = [p for p, kind in kinds.items() if kind == wanted]
        if len(found) > 1:
            names = ", ".join(p.name for p in found)
            raise RecordingError(
                f"{path}: {len(found)} {wanted} files ({names}); name one, or the .yaml file", key="log.several_files"
            )
        out.append(found[0] if found else None)
    if out[0] is None and out[1] is None:
        raise RecordingError(
            f"{path}: no KF-GINS configuration (.yaml with imupath or imufile) and no data file in it",
            key="log.no_configuration",
        )
    return out[0], out[1]


def _find_truth(folder: Path, remarks: Notes) -> Path | None:
    """The truth, which no key names: the only .nav file, or the only one called truth."""
    found = [p for p in sorted(folder.iterdir()) if p.suffix.lower() == ".nav" and "navresult" not in p.name.lower()]
    named = [p for p in found if "truth" in p.name.lower()]
    if len(named or found) > 1:
        remarks.add(
            "truth.several", f"no truth is read: it could be any of {', '.join(p.name for p in named or found)}"
        )
        return None
    return next(iter(named or found), None)


def _read_imu(path: Path, remarks: Notes) -> tuple[Imu, Array | None]:
    if path.suffix.lower() == ".bin":
        data = read_bytes(path, text=False)
        if len(data) % 56:
            raise RecordingError(
                f"{path}: {len(data)} bytes are not a whole number of rows of seven doubles", key="file.size"
            )
        table = np.frombuffer(data, "<f8").reshape(-1, 7)
        at = [f"row {k + 1}" for k in (0, 1)]
    else:
        rows = [
            (n, line) for n, line in enumerate(split_lines(path), 1) if line.strip() and line.lstrip()[0] not in "#%"
        ]
        if len(rows) < 2:
            raise RecordingError(
                f"{path}: {format_count(len(rows), 'row')}; an IMU file needs at least 2", key="table.few_rows"
            )
        width = len(rows[0][1].split())
        if width < 7:
            raise RecordingError(
                f"{path}, line {rows[0][0]}: {width} columns where an IMU file has 7 or 8", key="table.fields"
            )
        names = ["t", "dtheta_x", "dtheta_y", "dtheta_z", "dvel_x", "dvel_y", "dvel_z", "odometer", *["other"] * width]
        table = parse_table(path, rows, names[:width], None)
        at = [f"line {n}" for n, _ in rows]
    t = table[:, 0]
    step = np.diff(t)
    if (step <= 0).any():
        k = int(np.flatnonzero(step <= 0)[0]) + 1
        where = at[k] if k < len(at) else f"row {k + 1}"
        raise RecordingError(
            f"{path}, {where}, t: {t[k]:.6f} does not come after {t[k - 1]:.6f}; sort the rows", key="table.time_order"
        )
    if np.abs(table[:, 1:4]).max() > 2.0 or not np.isfinite(table[:, :7]).all():
        raise RecordingError(
            f"{path}: increments of more than 2 rad a sample; are these rates, or not increments at all?",
            key="imu.increments_large",
        )
    dt, gap = compute_periods(t)
    note_gaps(gap, remarks)
    R_bs = parse_axes_letters("FRD")
    remarks.add(
        "imu.read_as",
        f"IMU: angle (rad) and velocity (m/s) increments in forward-right-down, divided by their sample period "
        f"({np.median(step):g} s)",
    )
    rates = table[:, 1:7] / dt[:, None]
    imu = Imu(t.copy(), rates[:, :3] @ R_bs.T, rates[:, 3:] @ R_bs.T, R_bs=R_bs, noise_assumed=True)
    return imu, table[:, 7].copy() if table.shape[1] == 8 else None


def _read_fixes(path: Path, lever_arm: Array, remarks: Notes) -> Gnss:
    rows = [(n, line) for n, line in enumerate(split_lines(path), 1) if line.strip() and line.lstrip()[0] not in "#%"]
    if not rows:
        raise RecordingError(f"{path}: no rows in it", key="file.no_rows")
    width = len(rows[0][1].split())
    names = ["t", "lat", "lon", "h", "sd_n", "sd_e", "sd_u"]
    if width == 13:
        names = ["t", "lat", "lon", "h", "vn", "ve", "vd", "sd_n", "sd_e", "sd_u", "sd_vn", "sd_ve", "sd_vd"]
    elif width != 7:
        raise RecordingError(
            f"{path}, line {rows[0][0]}: {width} columns where a GNSS file has 7 (or 13)", key="table.fields"
        )
    table = dict(zip(names, parse_table(path, rows, names, None).T, strict=True))
    for k in np.flatnonzero(~np.isfinite(table["t"]))[:1]:
        raise RecordingError(f"{path}, line {rows[k][0]}, t: must be a finite number", key="table.cell")
    beyond = np.flatnonzero(~is_on_earth(np.radians(table["lat"]), np.radians(table["lon"]), table["h"]))
    if len(beyond):
        raise RecordingError(
            f"{path}, line {rows[beyond[0]][0]}: lat and lon must be degrees, h a height in m", key="table.place"
        )
    sd = np.stack([table["sd_e"], table["sd_n"], table["sd_u"]], -1)
    bad = np.flatnonzero((sd <= 0).any(-1))
    if len(bad):
        raise RecordingError(f"{path}, line {rows[bad[0]][0]}: a sigma must be above zero", key="table.sigma")
    order = np.argsort(table["t"], kind="stable")
    keep = order[np.concatenate([[True], np.diff(table["t"][order]) > 0])]
    if len(keep) < len(order) or (np.diff(order) < 0).any():
        remarks.add("gnss.rows_sorted", "GNSS rows were sorted by time, repeated ones dropped")
    llh = np.stack([np.radians(table["lat"]), np.radians(table["lon"]), table["h"]], -1)
    remarks.add("gnss.read_as", "GNSS: the sigma columns are taken as north, east, down; heights above the ellipsoid")
    v = sd_v = None
    if width == 13:
        v = np.stack([table["ve"], table["vn"], -table["vd"]], -1)[keep]
        sd_v = np.stack([table["sd_ve"], table["sd_vn"], table["sd_vd"]], -1)[keep]
        remarks.add(
            "gnss.velocity_read_as",
            "GNSS: columns 5 to 7 are taken as the velocity north, east, down in m/s, 11 to 13 as its sigmas",
        )
    return Gnss(table["t"][keep], llh[keep], sd[keep], v, sd_v, lever_arm)


FORMAT = log_format(
    "kf-gins", "text files of KF-GINS or OB_GINS: the .yaml file, its folder, or one IMU or GNSS file", recognises, load
)
