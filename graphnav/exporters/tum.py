"""TUM trajectory: ``t x y z qx qy qz qw``, the format of the TUM RGB-D benchmark (Sturm et al., IROS 2012)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphnav import rotation
from graphnav.earth import LocalFrame
from graphnav.errors import RecordingError
from graphnav.exporters.csv import rows_text
from graphnav.trajectory import Trajectory


def write(trajectory: Trajectory, path: Path) -> None:
    """Write metres in the fixed ENU frame at the first point and the quaternion from body (RFU) to that frame.

    Raises
    ------
    RecordingError
        If the trajectory has no attitude: the format has no way to say so.
    """
    R_lb = trajectory.R_lb
    if R_lb is None:
        raise RecordingError(f"{path}: a TUM file needs an attitude and this trajectory has none")
    if trajectory.frame == "local":
        p_n, R_nb, about = trajectory.llh, R_lb, "a local frame"
    else:
        frame = LocalFrame(trajectory.llh[0])
        p_n = frame.from_llh(trajectory.llh)
        # Attitudes are kept in the local level of each point; the file has one frame for everything.
        R_nb = np.swapaxes(frame.R_ln(p_n), -1, -2) @ R_lb
        lat, lon, h = trajectory.llh[0] * np.array([np.rad2deg(1.0), np.rad2deg(1.0), 1.0])
        about = f"ENU about lat {lat:.11f} lon {lon:.11f} h {h:.5f} (deg, m)"
    q = rotation.to_quaternion(R_nb)
    table = np.column_stack([trajectory.t, p_n, q[:, 1:], q[:, 0]])
    head = f"# t x y z qx qy qz qw; s, m; {about}; body right-forward-up\n"
    body = rows_text(table, " ".join(["%.6f"] + ["%.5f"] * 3 + ["%.10f"] * 4))
    Path(path).write_text(head + body, "utf-8")
