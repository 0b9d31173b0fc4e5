"""TUM trajectory: ``t x y z qx qy qz qw``, the format of the TUM RGB-D benchmark (Sturm et al., IROS 2012)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from graphnav.core import rotation
from graphnav.core.earth import LocalFrame, enu_axes
from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.recording.exporters import Add
from graphnav.recording.exporters.digits import encode_rows


@contextmanager
def open_writer(path: Path, name: str = "") -> Iterator[Add]:
    """A TUM file in metres of the fixed ENU frame at the first point, and the quaternion from body (RFU) to that
    frame.
    """
    frame: LocalFrame | None = None
    with path.open("wb") as file:

        def add(block: Trajectory, utc: Array | None = None) -> None:
            nonlocal frame
            R_lb = block.R_lb
            if R_lb is None:
                raise RecordingError(
                    f"{path}: a TUM file needs an attitude and this trajectory has none", key="export.no_attitude"
                )
            if frame is None:
                frame = LocalFrame(block.llh[0])
                file.write(_write_head(block).encode())
            p_n, R_nb = block.llh, R_lb
            if block.frame == "geodetic":
                p_n = frame.from_llh(block.llh)
                # attitudes refer to the local level of each point; the file has one frame for all of them
                R_ln = (enu_axes(block.llh).reshape(-1, 3) @ frame.R_ne.T).reshape(-1, 3, 3)
                R_nb = np.swapaxes(R_ln, -1, -2) @ R_lb
            q = rotation.to_quaternion(R_nb)
            table = np.column_stack([block.t, p_n, q[:, 1:], q[:, 0]])
            file.write(encode_rows(table, " ".join(["%.6f"] + ["%.5f"] * 3 + ["%.10f"] * 4)))

        yield add


def _write_head(block: Trajectory) -> str:
    about = "a local frame"
    if block.frame == "geodetic":
        lat, lon, h = block.llh[0] * np.array([np.rad2deg(1.0), np.rad2deg(1.0), 1.0])
        about = f"ENU about lat {lat:.11f} lon {lon:.11f} h {h:.5f} (deg, m)"
    return f"# t x y z qx qy qz qw; s, m; {about}; body right-forward-up\n"
