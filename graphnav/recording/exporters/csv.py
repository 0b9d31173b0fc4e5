"""trajectory.csv: graphnav's own columns, degrees for angles, SI for the rest; a missing value is blank."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.recording.exporters import Add, require_geodetic
from graphnav.recording.exporters.digits import encode_rows

HEADER = (
    "t,lat,lon,h,ve,vn,vu,roll,pitch,heading,sd_e,sd_n,sd_u,sd_ve,sd_vn,sd_vu,sd_roll,sd_pitch,sd_heading,"
    "bgx,bgy,bgz,bax,bay,baz"
)


@contextmanager
def open_writer(path: Path, name: str = "") -> Iterator[Add]:
    """A file to which successive trajectories are added; digits as in `format_trajectory`."""
    with path.open("wb") as file:
        file.write(HEADER.encode() + b"\n")

        def add(block: Trajectory, utc: Array | None = None) -> None:
            require_geodetic(block, path)
            file.write(_write_rows(block))

        yield add


def format_trajectory(trajectory: Trajectory) -> str:
    """The lines of `trajectory`.

    Digits: a microsecond, a micrometre on the ground (1e-11 deg), 0.01 mm in height, 0.01 mm/s, 1e-7 deg; sigmas and
    biases six significant.
    """
    return _write_rows(trajectory).decode("ascii")


def convert_columns(trajectory: Trajectory) -> list[tuple[Array | None, str]]:
    """The columns in the file's units, (K, n) each or None for three blanks, and their number formats."""
    deg = np.rad2deg(1.0)

    def apply_scale(values: Array | None, scale: float = 1.0) -> Array | None:
        return None if values is None else values * scale

    return [
        (trajectory.t[:, None], "%.6f"),
        (trajectory.llh[:, :2] * deg, "%.11f"),
        (trajectory.llh[:, 2:], "%.5f"),
        (trajectory.v, "%.5f"),
        (apply_scale(trajectory.rph, deg), "%.7f"),
        (trajectory.sd_p, "%.6g"),
        (trajectory.sd_v, "%.6g"),
        (apply_scale(trajectory.sd_rph, deg), "%.6g"),
        (trajectory.gyro_bias, "%.6g"),
        (trajectory.accel_bias, "%.6g"),
    ]


def _write_rows(trajectory: Trajectory) -> bytes:
    parts = convert_columns(trajectory)
    table = np.concatenate([values for values, _ in parts if values is not None], axis=1)
    forms = [form for values, one in parts for form in ([one] * values.shape[1] if values is not None else [""] * 3)]
    return encode_rows(table, ",".join(forms))
