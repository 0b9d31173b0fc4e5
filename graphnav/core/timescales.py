"""GPS time, UTC and the leap seconds between them.

GPS time has no leap seconds since 6 January 1980 UTC; each later leap second of UTC increases GPS - UTC by one second
(IERS Bulletin C; the table of IS-GPS-200 applications). No leap second has been added since 2017, and none will be
before 2027.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphnav.core.rotation import Array

DAY, WEEK = 86400.0, 604800.0  # s
_COUNTS = 2.0**32  # of a counter of 32 bits
_WHOLE = 0.99  # share of the period; a restarting clock steps back by at least that
NEAR = 3600.0  # s; logs of one drive begin within this of each other
UNIX = 1e9  # s; larger stamps are Unix time of this century
GPS_TO_UNIX = 315964800.0  # s from the Unix to the GPS epoch, leap seconds excluded
GPS_EPOCH = np.datetime64("1980-01-06T00:00:00", "us")
# days on which GPS - UTC grew by one second, to 1 s at the first
_LEAPS = np.array(
    [
        "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01", "1992-07-01",
        "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01",
        "2015-07-01", "2017-01-01",
    ],
    dtype="datetime64[us]",
)  # fmt: skip


LEAP = float(len(_LEAPS))  # s, GPS time minus UTC since the last of them


def shift_stamps(t: Any, offset: Any, rate: Any, since: float) -> Any:
    """Stamps (s) on another clock, ahead by `offset` (s) at the stamp `since` and drifting by `rate` (s/s); each of
    the three a number or an array.
    """
    return t + offset + rate * (t - since)


def shift_stamps_back(t: Any, offset: Any, rate: Any, since: float) -> Any:
    """The inverse of `shift_stamps`."""
    return since + (t - offset - since) / (1.0 + rate)


def count_leap_seconds(utc: Array) -> Array:
    """GPS minus UTC (s) at dates of type datetime64."""
    return np.searchsorted(_LEAPS, utc, side="right").astype(float)


def utc_to_gps(utc: Array) -> Array:
    """Seconds since the GPS epoch of UTC dates (datetime64[us])."""
    return (utc - GPS_EPOCH) / np.timedelta64(1, "us") * 1e-6 + count_leap_seconds(utc)


def unix_to_gps(t: Array) -> Array:
    """Seconds since the GPS epoch of Unix time."""
    utc = (np.asarray(t) * 1e6).astype("int64").astype("datetime64[us]")
    return np.asarray(t) - GPS_TO_UNIX + count_leap_seconds(utc)


def gps_to_utc(t: Array) -> Array:
    """UTC (datetime64[us]) of seconds since the GPS epoch; exact except within the second before a leap."""
    gps = GPS_EPOCH + np.round(np.asarray(t, dtype=float) * 1e6).astype("timedelta64[us]")
    leap = count_leap_seconds(gps)
    leap = count_leap_seconds(gps - (leap * 1e6).astype("timedelta64[us]"))
    return np.asarray(gps - (leap * 1e6).astype("timedelta64[us]"))


def date_week_times(gps: Array) -> tuple[Array, float]:
    """Times in seconds of the GPS week of the first, and where that week begins (s since the GPS epoch)."""
    zero = WEEK * np.floor(gps[0] / WEEK)
    return gps - zero, float(zero)


def parse_clock(text: str, t: float) -> float:
    """Seconds since the GPS epoch at t = 0 of a clock given in words; `t` (s) is a time of the log, for the leap
    seconds.

    ``unix``: seconds since 1970 UTC. ``gps week 2313``: seconds of that week. ``2024-05-01T12:00:00Z``: seconds since
    then, UTC.

    Raises
    ------
    ValueError
        If it is none of these.
    """
    if text == "unix":
        return float(unix_to_gps(np.array([t]))[0]) - t
    if found := re.fullmatch(r"gps week (\d{1,4})", text):
        return WEEK * int(found[1])
    try:
        return float(utc_to_gps(np.array([text.removesuffix("Z")], dtype="datetime64[us]"))[0])
    except ValueError:
        raise ValueError('must be "unix", "gps week 2313" or a UTC date such as "2024-05-01T12:00:00Z"') from None


def find_restarts(t: Array, unit: float = 1.0) -> Array | None:
    """Increments that make the stamps of a clock continuous that restarts at 0 after a day, a GPS week or 2^32 counts.

    Parameters
    ----------
    t : (N,) in the order of the file, in its unit.
    unit : s of one count.

    Returns
    -------
    (N,) in the unit of `t`, None where the clock does not restart.
    """
    step = np.diff(t)
    for period in (DAY / unit, WEEK / unit, _COUNTS):
        back = step < -_WHOLE * period
        if back.any() and t.min() >= 0.0 and t.max() < period:
            # a row that was written late belongs to the period before
            turns = np.cumsum(back.astype(float) - (step > _WHOLE * period))
            return np.asarray(period * np.concatenate([[0.0], turns]))
    return None


@dataclass(frozen=True)
class ClockOffset:
    """Offset between two known clocks: s to be added to the second's stamps, and the reason in words."""

    offset: float
    words: str


def compute_clock_offset(t: float, zero: float | None, u: float, other: float | None) -> ClockOffset | None:
    """The offset from a clock that reads `u` to one that reads `t`, s; their zeros (s since the GPS epoch) may be
    known.

    Stamps above 1e9 of an unknown clock are Unix time; those below a week are seconds of the GPS week of the others,
    where these are known. None where this does not determine it, or the clocks are the same.
    """
    unix = [x > UNIX and clock is None for x, clock in ((t, zero), (u, other))]
    first = parse_clock("unix", t) if unix[0] else zero
    second = parse_clock("unix", u) if unix[1] else other
    if first is None and second is not None and 0.0 <= t < WEEK:
        first = WEEK * float(np.floor((u + second) / WEEK))
    if second is None and first is not None and 0.0 <= u < WEEK:
        second = WEEK * float(np.floor((t + first) / WEEK))
    if first is None or second is None or abs(second - first) < 1.0:
        return None
    offset = second - first
    week = second if unix[0] else first
    if unix[0] == unix[1] or week % WEEK or not week:
        return ClockOffset(offset, f"the clocks count from {format_clock(first)} and {format_clock(second)}")
    leap = float(count_leap_seconds(gps_to_utc(np.array([week])))[0])
    begins = week + GPS_TO_UNIX - leap
    return ClockOffset(
        offset,
        f"GPS week {round(week / WEEK)} begins at Unix time {begins:.0f} ({GPS_TO_UNIX:.0f} + {round(week / WEEK)} x "
        f"{WEEK:.0f} - {leap:.0f} leap seconds)",
    )


def format_clock(gps_zero: float) -> str:
    """The words for a clock that `parse_clock` reads: a GPS week, Unix time, or the UTC date of its zero."""
    if -GPS_TO_UNIX <= gps_zero < -GPS_TO_UNIX + 60.0:
        return "unix"
    if gps_zero % WEEK == 0.0:
        return f"gps week {round(gps_zero / WEEK)}"
    return f"{gps_to_utc(np.array([gps_zero]))[0]}Z"
