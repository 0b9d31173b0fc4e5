"""KF-GINS navigation result, .nav: 11 columns of text, as in section 2.2 of the project's README.

GNSS week, seconds of week, lat, lon (deg), height (m), velocity north, east, down (m/s), roll, pitch, yaw (deg) of a
forward-right-down body in north-east-down axes, which are graphnav's roll, pitch and heading.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphnav.errors import RecordingError
from graphnav.exporters import require_geodetic
from graphnav.exporters.csv import rows_text
from graphnav.rotation import Array
from graphnav.timescales import WEEK, utc_to_gps
from graphnav.trajectory import Trajectory


def write(trajectory: Trajectory, path: Path, utc: Array | None = None) -> None:
    """Write `trajectory`; without `utc` its own times are the seconds and the week is 0, as KF-GINS itself writes.

    Raises
    ------
    RecordingError
        If the trajectory has no velocity or no attitude: the format cannot say so.
    """
    require_geodetic(trajectory, path)
    if trajectory.v is None or trajectory.rph is None:
        raise RecordingError(f"{path}: a .nav file needs velocity and attitude, and this trajectory lacks one of them")
    week, t = np.zeros(len(trajectory)), trajectory.t
    if utc is not None:
        gps = utc_to_gps(utc)
        week = np.floor(gps / WEEK)
        t = gps - WEEK * week
    deg = np.rad2deg(1.0)
    v, llh = trajectory.v, trajectory.llh
    table = np.column_stack([week, t, llh[:, :2] * deg, llh[:, 2], v[:, 1], v[:, 0], -v[:, 2], trajectory.rph * deg])
    Path(path).write_text(rows_text(table, "%d %.6f %.11f %.11f %.5f" + 3 * " %.5f" + 3 * " %.7f"), "utf-8")
