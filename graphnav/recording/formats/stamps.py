"""Stamps of a sensor's rows in the order of its file: what no clock that goes on tells."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import DAY
from graphnav.recording.formats.table import Selection, Table
from graphnav.sensors.tables import TIME_UNITS

_SPREADSHEET_DAYS = 20_000.0, 80_000.0  # since 1899-12-30: from 1954 to 2119
_LONGEST_STEP = 10.0  # s between rows of a sensor
_FAR = 10.0  # periods; rows that overtake each other are closer
_SET_BACK = 3.0  # periods, of a clock; times are then there twice, and not only out of order
_TWICE = 1.5  # rows to a period above which, between one and two, a time is there twice
_CLOSE = 0.3  # of the mean step, below which two rows were read at once
_PAUSE = 1.0  # s; longer steps of an IMU are gaps
_GAP = 2.0  # median times between packets, from which on rows are lost
_PACKETS = 1 / 3  # share of such steps from which on rows come in packets: of one and two in turn, or more
_ROUNDED_AWAY = 0.05  # share of the stamps that repeat the one before, where a rounding makes them
_REPEATED = 0.6  # share of rows with the stamp of the previous row above which the log is refused
_ROOM = 1.5, 3.0  # periods between two rows that leave room for one between them
RUN = 5  # steps on either side of one that show whether a clock goes on as it did
_UNEVEN = 0.25  # share of a step by which those of a run may differ from it
_ABOVE_NOISE = 4.0  # times by which moves of fixes differ from the mean of those around them, that they are to be


def tell_rounding(stamps: Array, repeated: NDArray[np.bool_]) -> str:
    """'; ...' where stamps (N,), in the file's unit, repeat because they went through single precision."""
    known = stamps[np.isfinite(stamps)]
    step = np.spacing(np.float32(np.abs(known).max())) if len(known) else 0.0
    if repeated.mean() < _ROUNDED_AWAY or not np.array_equal(known, known.astype(np.float32)):
        return ""
    return f": stamps are rounded to {step:g}, as single-precision numbers are; write them with double precision"


def find_repeated(where: str, t: Array) -> NDArray[np.bool_]:
    """(N,) mask of stamps, in order, that equal the previous one; `where` they are, in words.

    Raises
    ------
    RecordingError
        If most are.
    """
    repeated = np.r_[False, np.diff(t) == 0]
    if repeated.mean() > _REPEATED:
        raise RecordingError(
            f"{where}: {format_row_count(repeated, '')} of {len(t)} with the time of the row before: the fraction of "
            "the seconds was lost, or several rows are stamped at once; log the time of each, with milliseconds",
            key="table.times_repeated",
        )
    return repeated


def find_repeats(columns: Mapping[str, Array]) -> NDArray[np.bool_]:
    """(N-1,) whether a row of columns (N,) or (N, k) holds the same as the one before, apart from its time."""
    same = np.ones(max(len(columns["t"]) - 1, 0), dtype=bool)
    for name, column in columns.items():
        for x in column.reshape(len(column), -1).T if name != "t" else ():
            same &= (x[1:] == x[:-1]) | (np.isnan(x[1:]) & np.isnan(x[:-1]))
    return same


def spread_packets(t: Array, repeats: NDArray[np.bool_]) -> tuple[Array, float] | None:
    """Times (N,), s, of rows that a program has stamped in packets, as it read them, and how many a packet has in the
    mean; None where it has not, and for whole seconds, of which the fraction was lost.

    The last row of a packet keeps its stamp; the others are evenly between it and that of the packet before, or where
    rows are lost, by the mean step before it.

    Parameters
    ----------
    t : (N,) s, in order.
    repeats : (N-1,) whether a row holds what the one before does, which is then no measurement of its own.
    """
    n, step = len(t), np.diff(t)
    if not (step < _PAUSE).any() or np.array_equal(t, np.floor(t)):
        return None
    close = (step < _CLOSE * np.mean(step[step < _PAUSE])) & ~repeats
    if np.count_nonzero(close) < _PACKETS * n:
        return None
    last = np.append(np.flatnonzero(~close), n - 1)
    if len(last) < 2:
        return None
    first, count, takes = int(last[0]), np.diff(last), np.diff(t[last])
    whole = takes < _GAP * np.median(takes)
    usual = float(np.sum(takes[:-1], where=whole[:-1])) / max(int(np.sum(count[:-1], where=whole[:-1])), 1)
    if not usual > 0.0:  # of the last packet, there may be a part only
        usual = float(takes[-1]) / int(count[-1])
    out = np.interp(np.arange(n), last, t[last])
    out[:first] = t[first] - usual * np.arange(first, 0, -1)
    for k in np.flatnonzero(~whole & (takes > _GAP * usual * count)).tolist():
        at = np.arange(last[k] + 1, last[k + 1])
        out[at] = t[last[k + 1]] - usual * (last[k + 1] - at)
    return out, n / len(last)


def describe_packets(size: float) -> str:
    """A sentence on rows that come in packets, of a mean size."""
    return (
        f"{size:.3g} IMU rows in the mean have one stamp, or nearly, as a program reads them at once: taken to be "
        "evenly between these"
    )


def check_days(rows: Table, unit: str) -> None:
    """Refuse stamps that count days as spreadsheets do, from 1899-12-30 on, and are said to be in seconds."""
    t = rows["t"]
    step = _compute_period(t)
    low, high = _SPREADSHEET_DAYS
    if unit == "s" and low < t.min() and t.max() < high and 0.0 < step * DAY < _LONGEST_STEP:
        raise RecordingError(
            f"{rows.path}: column '{rows.file_names['t']}' counts days, from {t[0]:.9g} on, as spreadsheets do from "
            '1899-12-30: set units = { t = "d" }',
            key="table.days",
        )


def find_lone_stamps(t: Array) -> NDArray[np.bool_]:
    """(N,) mask of stamps far from those before and after, which have room for one row between them.

    A row that was written late leaves no such room where it stands.
    """
    out = np.zeros(len(t), dtype=bool)
    if len(t) > RUN:
        period = _compute_period(t)
        before, after, far = t[:-2], t[2:], _FAR * period
        room = (after - before > _ROOM[0] * period) & (after - before < _ROOM[1] * period)
        out[1:-1] = room & ((t[1:-1] < before - far) | (t[1:-1] > after + far))
    return out


def take_halfway(t: Array) -> Array:
    """(N,) means of the stamps before and after each; the first and the last as they are."""
    out = t.copy()
    out[1:-1] = 0.5 * (t[:-2] + t[2:])
    return out


def find_set_back(t: Array, p: Array) -> tuple[int, float] | None:
    """The last fix before the clock of a moving receiver is set back by less than rows overtake each other, and by
    how much, s; None where it is not.

    Before and after, stamps go on evenly; between them they repeat or step back, while the receiver moves as far as in
    any other step. A fix that was written late is back where it was.

    Parameters
    ----------
    t : (N,) s, in the order in which they were written.
    p : (N, k) positions, in any unit.
    """
    steps = np.diff(t)
    if len(t) < 2 * RUN + 2 or not (steps > 0.0).any():
        return None
    period = float(np.median(steps[steps > 0.0]))
    even = np.all(sliding_window_view(np.abs(steps - period) <= _UNEVEN * period, RUN), axis=1)
    inner = np.arange(RUN, len(steps) - RUN)
    broken = (steps[inner] < 0.5 * period) & even[inner - RUN] & even[inner + 1]
    for k in inner[broken].tolist():
        runs = slice(k - RUN, k + 1), slice(k + 1, k + 2 + RUN)
        before, after = (np.diff(p[run], axis=0) for run in runs)
        usual, jump = 0.5 * (before[-1] + after[0]), period - steps[k]
        bends = [some[1:-1] - 0.5 * (some[:-2] + some[2:]) for some in (before, after)]
        scatter, back = np.linalg.norm(np.concatenate(bends), axis=1).max(), np.linalg.norm(usual) * jump / period
        if back > _ABOVE_NOISE * scatter and np.linalg.norm(p[k + 1] - p[k] - usual) < 0.5 * back:
            return k, float(jump)
    return None


def check_fix_clock(rows: Table, label: str) -> None:
    """Refuse fixes whose clock is set back by about a second, in which a receiver learns of a leap second."""
    found = find_set_back(rows["t"], rows.stack("lat", "lon"))
    if found is not None:
        words = describe_set_back(label, float(rows["t"][found[0]]), found[1])
        raise RecordingError(f"{rows.path}: the {words}; write all stamps on one clock", key="table.clock_back")


def describe_set_back(label: str, t: float, jump: float) -> str:
    """In words, of a sensor, after a time and by how much, s."""
    leap = " (GPS time and UTC are 18 s apart)" if abs(jump - 18.0) < 0.5 else ""
    return (
        f"clock of the {label} is set back by {jump:.2f} s after t = {t:.3f} s{leap}: what lies between is there twice"
    )


def check_passes(rows: Table, label: str) -> None:
    """Refuse a clock that was set back: the times before it are then there twice, with other rows."""
    t = rows["t"]
    period = _compute_period(t)
    back = np.flatnonzero(np.diff(t) < -_SET_BACK * period)
    for k in back[:20]:
        again = float(t[k + 1])
        before = np.flatnonzero(t[: k + 1] >= again)
        after = k + 1 + np.flatnonzero(t[k + 1 :] <= t[k])
        # rows that were only written late fill the gap that they left
        begin, end = max(t[before].min(), t[after].min()), min(t[before].max(), t[after].max())
        shared = end - begin
        if shared < max(0.5 * (t[k] - again), _SET_BACK * period):
            continue
        both = np.concatenate([before, after])
        both = both[(t[both] >= begin) & (t[both] <= end)]
        different = len(np.unique(np.column_stack([x[both] for x in rows.columns.values()]), axis=0))
        if different > _TWICE * (shared / period + 1.0):
            jump = float(t[k] - again + period)
            words = describe_set_back(label, float(t[k]), jump)
            raise RecordingError(f"{rows.path}: the {words}; write all stamps on one clock", key="table.clock_back")


def _compute_period(t: Array) -> float:
    """The median step between stamps (N,) in any order."""
    steps = np.diff(np.unique(t))
    return float(np.median(steps)) if len(steps) else 0.0


def format_row_count(mask: Selection, label: str) -> str:
    """The number of rows in a mask (N,), with the sensor's label."""
    return format_count(mask.sum(), f"{label} row".strip())


def check_imu_steps(rows: Table, unit: str) -> None:
    if len(rows) < 2:
        raise RecordingError(
            f"{rows.path}: {len(rows)} usable row; an IMU recording needs at least 2", key="table.few_rows"
        )
    step = float(np.median(np.diff(rows["t"])))
    if 1e-5 < step < 0.5:
        return
    fitting = [u for u in TIME_UNITS if 2.5e-4 <= step / TIME_UNITS[unit] * TIME_UNITS[u] <= 0.1 and u != unit]
    hint = f'; if t is in {fitting[0]}, set units = {{ t = "{fitting[0]}" }}' if fitting else ""
    if step == 1.0:
        hint += "; if it counts rows, write times instead"
    raise RecordingError(
        f"{rows.path}: IMU rows are {step:g} s apart, which no usable IMU is{hint}", key="imu.time_unit"
    )
