"""Positions computed by RTKLIB (.pos) as GNSS fixes: lat, lon, height with sigmas, and velocities where there are any.

Times in UTC or JST are turned into GPS time; the rest of the form is in `graphnav.recording.formats.trajectories`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.notes import key_of
from graphnav.core.timescales import WEEK, of_week, unix_to_gps
from graphnav.recording import Gnss, fix_types
from graphnav.recording.formats.registry import Log, first_bytes, log_format
from graphnav.recording.formats.repair import Remarks
from graphnav.recording.formats.text import text_lines
from graphnav.recording.formats.trajectories import read_trajectory

_JST = 9 * 3600.0  # s ahead of UTC
# 1-sigma of a receiver's own single-point velocity where the file states none (see folder.DEFAULT_SD_V)
_SD_V = (0.2, 0.2, 0.4)


def recognises(path: Path) -> bool:
    """Whether the file begins with comments (%) that name RTKLIB's columns."""
    head = first_bytes(path, 16384)
    return head[:1] == b"%" and b"Q" in head and b"ns" in head and b"latitude" in head


def load(path: Path) -> Log:
    """The solution as fixes of the antenna.

    Raises
    ------
    RecordingError
        As `graphnav.recording.formats.trajectories.read_trajectory`.
    """
    track = read_trajectory(path)
    remarks = Remarks(track.notes)
    lines = text_lines(path)
    first = next(line.split() for line in lines if line.strip() and line.lstrip()[0] not in "#%")
    zero = _find_week(path, first)
    t = track.t
    titles = next(line for line in lines if line.startswith("%") and "latitude" in line and "=" not in line)
    scale = titles.strip("% ").split()[0].split(",")[0]
    if scale in ("UTC", "JST"):
        remarks[:] = [r for r in remarks if key_of(r) != "trajectory.time_scale"]
        utc = t + zero + 315964800.0 - (_JST if scale == "JST" else 0.0)
        t, zero = of_week(unix_to_gps(utc))
        remarks.add(
            "log.clock_leap", f"{path.name}: times were in {scale}; the leap seconds of their date make them GPS time"
        )
    sd = track.sd_p
    if sd is None:
        raise RecordingError(
            f"{path}: no sigma columns (sdn, sde, sdu); write it again with out-outsolstd or as llh",
            key="rtklib.no_sigmas",
        )
    good = np.flatnonzero((sd > 0).all(-1))
    if len(good) < len(t):
        remarks.add("gnss.rows_left_out", f"{len(t) - len(good)} fixes without a sigma above zero left out")
        track, t, sd = track.take(good), t[good], sd[good]
    v, sd_v = track.v, track.sd_v
    if v is not None and sd_v is None:
        sd_v = np.tile(_SD_V, (len(t), 1))
        remarks.add(
            "gnss.velocity_sigma_assumed", "velocity sigmas of 0.2, 0.2, 0.4 m/s are assumed: the file states none"
        )
    kinds = None if track.fix_type is None else fix_types(track.fix_type)
    remarks.add(
        "gnss.lever_arm_unknown", "GNSS: position of the antenna; its lever arm is not in the file and taken as zero"
    )
    remarks.add("log.clock", "clock: seconds of the GPS week of the first row")
    gnss = Gnss(t, track.llh, sd, v, sd_v, type=kinds, satellites=track.satellites)
    return Log(path.stem, gnss=gnss, gps_zero=zero, remarks=tuple(remarks))


def _find_week(path: Path, fields: list[str]) -> float:
    """Where the week of the first row begins, s since the GPS epoch in the file's own time scale."""
    try:
        if "/" in fields[0]:
            day = np.datetime64(fields[0].replace("/", "-"), "D") - np.datetime64("1980-01-06", "D")
            return float(WEEK * (day.astype(int) // 7))
        return WEEK * int(fields[0].split(",")[0])
    except ValueError:
        raise RecordingError(f"{path}: the first row has neither a date nor a GPS week", key="rtklib.no_date") from None


FORMAT = log_format("rtklib", "positions computed by RTKLIB, .pos", recognises, load)
