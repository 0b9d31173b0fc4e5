"""trajectory.csv: graphnav's own columns, degrees for angles, SI for the rest; a missing value is blank."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphnav.exporters import require_geodetic
from graphnav.rotation import Array
from graphnav.trajectory import Trajectory

HEADER = (
    "t,lat,lon,h,ve,vn,vu,roll,pitch,heading,sd_e,sd_n,sd_u,sd_ve,sd_vn,sd_vu,sd_roll,sd_pitch,sd_heading,"
    "bgx,bgy,bgz,bax,bay,baz"
)
_CHUNK = 2000  # rows formatted by one %: long enough to be fast, short enough to stay in cache


def write(trajectory: Trajectory, path: Path) -> None:
    """Write `trajectory` to `path`; digits as in `rows`."""
    require_geodetic(trajectory, path)
    Path(path).write_text(HEADER + "\n" + rows(trajectory), "utf-8")


def rows(trajectory: Trajectory) -> str:
    """The rows of `trajectory`, a line each.

    Digits: a microsecond, a micrometre on the ground (1e-11 deg), 0.01 mm in height, 0.01 mm/s, 1e-7 deg;
    sigmas and biases six significant.
    """
    deg = np.rad2deg(1.0)
    columns: list[Array] = [trajectory.t[:, None]]
    formats = ["%.6f"]

    def add(values: Array | None, scale: Array | float, form: str) -> None:
        """Three columns, or three blanks."""
        if values is None:
            formats.extend([""] * 3)
            return
        columns.append(values * scale)
        formats.extend([form] * 3)

    columns.append(trajectory.llh * np.array([deg, deg, 1.0]))
    formats.extend(["%.11f", "%.11f", "%.5f"])
    add(trajectory.v, 1.0, "%.5f")
    add(trajectory.rph, deg, "%.7f")
    add(trajectory.sd_p, 1.0, "%.6g")
    add(trajectory.sd_v, 1.0, "%.6g")
    add(trajectory.sd_rph, deg, "%.6g")
    add(trajectory.gyro_bias, 1.0, "%.6g")
    add(trajectory.accel_bias, 1.0, "%.6g")
    return rows_text(np.concatenate(columns, axis=1), ",".join(formats))


def rows_text(table: Array, row_format: str) -> str:
    """The rows of `table` (K, n) through one ``%`` format with n places; NaN becomes blank."""
    parts = []
    for start in range(0, len(table), _CHUNK):
        rows = table[start : start + _CHUNK]
        parts.append((row_format + "\n") * len(rows) % tuple(rows.ravel().tolist()))
    text = "".join(parts)
    return text.replace("nan", "") if np.isnan(table).any() else text
