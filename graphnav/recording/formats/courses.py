"""Speeds and courses over ground: those that a phone does not know made blank, and velocities of them."""

from __future__ import annotations

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.recording.formats.table import Selection, Table

# 1-sigma of a vertical velocity that is taken as zero because a receiver gives only speed and course: a slope of 10 %
_STEEPEST = 0.1


def compute_horizontal_velocity(speed: Array, course: Array, sd: Array) -> tuple[Array, Array, str]:
    """East-north-up velocities from speed (N,) m/s over ground and course (N,) rad, their sigmas, and notes.

    A stationary receiver may leave the course blank; a blank speed gives no velocity.

    Parameters
    ----------
    sd : (N, 3) or (3,), 1-sigma east, north, up, m/s.
    """
    sd_v = np.array(np.broadcast_to(sd, (len(speed), 3)), dtype=float)
    course = np.where(np.isnan(course) & (speed < sd_v[:, 0]), 0.0, course)
    v = np.stack([speed * np.sin(course), speed * np.cos(course), np.zeros_like(speed)], -1)
    absent = np.isnan(v).any(-1)
    typical = np.median(sd_v[~absent] if not absent.all() else sd_v, axis=0)
    sd_v[:, 2] = np.maximum(sd_v[:, 2], _STEEPEST * np.abs(np.nan_to_num(speed)))
    v[absent] = sd_v[absent] = np.nan
    return (
        v,
        sd_v,
        (
            f"velocity: from speed and course over ground, 1-sigma {typical[0]:g} m/s a horizontal axis; the vertical "
            f"one is taken as 0 with {typical[2]:g} m/s or a tenth of the speed"
        ),
    )


_MARKED = ("sd_e", "sd_n", "sd_u", "sd_ve", "sd_vn", "sd_vu", "speed", "course")


def blank_unknown(rows: Table) -> tuple[Table, Selection]:
    """Speeds and courses that a phone does not know made blank, and which rows (N,) have a known position.

    A phone marks an unknown value, or the accuracy of one, by -1 (`CLLocation` of Apple's Core Location); where a
    column holds other negative values, -1 is one of them.

    Raises
    ------
    RecordingError
        If no position is known.
    """
    marks = {name: rows[name] == -1.0 for name in _MARKED if name in rows and (rows[name] < 0.0).any()}
    marks = {name: some for name, some in marks.items() if not (some ^ (rows[name] < 0.0)).any()}
    none = np.zeros(len(rows), dtype=bool)
    unknown = (marks.get("sd_e", none) & marks.get("sd_n", none)) | marks.get("sd_u", none)
    if len(rows) and unknown.all():
        raise RecordingError(
            f"{rows.path}: the accuracy of every fix is -1, a phone's mark of one that it does not have",
            key="gnss.sigma_all_unknown",
        )
    for name in ("sd_ve", "sd_vn", "sd_vu", "speed", "course"):
        if name in marks:
            rows = rows.with_column(name, np.where(marks[name], np.nan, rows[name]))
    if "speed" in rows and "sd_ve" in marks:
        rows = rows.with_column("speed", np.where(marks["sd_ve"], np.nan, rows["speed"]))
    return rows, ~unknown
