"""KF-GINS navigation result, .nav: 11 columns of text, as in section 2.2 of the project's README.

GNSS week, seconds of week, lat, lon (deg), height (m), velocity north, east, down (m/s), roll, pitch, yaw (deg) of a
forward-right-down body in north-east-down axes, which are graphnav's roll, pitch and heading.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.timescales import WEEK, utc_to_gps
from graphnav.core.trajectory import Trajectory
from graphnav.recording.exporters import Add, require_geodetic
from graphnav.recording.exporters.digits import encode_rows


@contextmanager
def open_writer(path: Path, name: str = "") -> Iterator[Add]:
    """A .nav file; without UTC the trajectory's own times are the seconds and the week is 0, as KF-GINS itself
    writes.
    """
    with path.open("wb") as file:

        def add(block: Trajectory, utc: Array | None = None) -> None:
            require_geodetic(block, path)
            if block.v is None or block.rph is None:
                raise RecordingError(
                    f"{path}: a .nav file needs velocity and attitude, and this trajectory lacks one of them",
                    key="export.no_attitude",
                )
            week, t = np.zeros(len(block)), block.t
            if utc is not None:
                gps = utc_to_gps(utc)
                week = np.floor(gps / WEEK)
                t = gps - WEEK * week
            deg = np.rad2deg(1.0)
            v, llh = block.v, block.llh
            table = np.column_stack([week, t, llh[:, :2] * deg, llh[:, 2], v[:, 1], v[:, 0], -v[:, 2], block.rph * deg])
            file.write(encode_rows(table, "%d %.6f %.11f %.11f %.5f" + 3 * " %.5f" + 3 * " %.7f"))

        yield add
