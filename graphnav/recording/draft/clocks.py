"""Numerical stamps that are not a count of seconds: times of day (hhmmss), and a spreadsheet's days."""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.timescales import DAY

_EPOCH = 25569.0  # 1 January 1970 as a spreadsheet counts days
_DAYS = 30000.0, 80000.0  # of the years 1982 to 2119
_LARGEST_STEP = 10.0 / DAY  # days, longest step between rows of a log; stamps in s have longer ones


def read_clock_seconds(t: Array) -> Array | None:
    """Seconds since midnight from times of day as one number, hhmmss.ss; None if they are not.

    They are times of day where minutes and seconds never exceed 59, steps over a full minute are 40 s too long, and are
    regular once read as hhmmss: a pause may also be of 40 s or more.
    """
    hours, minutes, seconds = t // 10_000, t // 100 % 100, t % 100
    if not ((t >= 0.0) & (t < 240_000.0) & (minutes < 60.0) & (seconds < 60.0)).all():
        return None
    over = np.flatnonzero(np.diff(minutes))
    if not 0 < 2 * len(over) < len(t) or np.abs(np.diff(t)[over]).min() < 40.0:
        return None
    out = np.asarray(3600.0 * hours + 60.0 * minutes + seconds)
    out += DAY * np.cumsum(np.diff(out, prepend=out[:1]) < -0.5 * DAY)
    step = np.diff(out)
    return out if float(np.median(step[over])) < 2.0 * float(np.median(step)) + 1e-3 else None


def read_serial_days(t: Array) -> Array | None:
    """Unix time (s) from a spreadsheet's dates, days since 1900; None if they are not."""
    if len(t) < 2 or not ((t > _DAYS[0]) & (t < _DAYS[1])).all():
        return None
    return DAY * (t - _EPOCH) if 0.0 < float(np.median(np.abs(np.diff(t)))) < _LARGEST_STEP else None
