"""Positions computed by RTKLIB (.pos) as GNSS fixes: lat, lon, height with sigmas, and velocities if present.

The format is described in `graphnav.recording.formats.rtklib_solution`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes, format_count
from graphnav.recording import Gnss, convert_fix_types
from graphnav.recording.formats.registry import Log, log_format, read_first_bytes
from graphnav.recording.formats.trajectories import read_trajectory

# 1-sigma of a receiver's own single-point velocity where the file states none (see folder.DEFAULT_SD_V)
_SD_V = (0.2, 0.2, 0.4)


def recognises(path: Path) -> bool:
    """Whether the file begins with comments (%) that name RTKLIB's columns."""
    head = read_first_bytes(path, 16384)
    place = any(name in head for name in (b"latitude(", b"x-ecef(", b"e-baseline("))
    return head[:1] == b"%" and b"Q" in head and b"ns" in head and place


def load(path: Path) -> Log:
    """Read the solution as fixes of the antenna.

    Raises
    ------
    RecordingError
        As `graphnav.recording.formats.trajectories.read_trajectory`.
    """
    track = read_trajectory(path)
    remarks = Notes(track.notes)
    t = track.t
    sd = track.sd_p
    if sd is None:
        raise RecordingError(
            f"{path}: no sigma columns (sdn, sde, sdu); write it again with out-outsolstd or as llh",
            key="rtklib.no_sigmas",
        )
    good = np.flatnonzero((sd > 0).all(-1))
    if len(good) < len(t):
        remarks.add(
            "gnss.rows_left_out",
            f"{format_count(len(t) - len(good), 'fix', 'fixes')} without a sigma above zero left out",
        )
        track, t, sd = track.take(good), t[good], sd[good]
    v, sd_v = track.v, track.sd_v
    if v is not None and sd_v is None:
        sd_v = np.tile(_SD_V, (len(t), 1))
        remarks.add(
            "gnss.velocity_sigma_assumed", "velocity sigmas of 0.2, 0.2, 0.4 m/s are assumed: the file states none"
        )
    kinds = None if track.fix_type is None else convert_fix_types(track.fix_type)
    remarks.add(
        "gnss.lever_arm_unknown", "GNSS: position of the antenna; its lever arm is not in the file and taken as zero"
    )
    remarks.add("log.clock", "clock: seconds of the GPS week of the first row")
    gnss = Gnss(t, track.llh, sd, v, sd_v, type=kinds, satellites=track.satellites)
    return Log(path.stem, gnss=gnss, gps_zero=track.gps_zero, remarks=tuple(remarks))


FORMAT = log_format("rtklib", "positions computed by RTKLIB, .pos", recognises, lambda path, _: load(path))
