"""Stamps of the rows of a sensor's file: stray ones, clocks that restart or are set back, rows out of order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import find_restarts
from graphnav.recording.formats.table import Selection, Table
from graphnav.sensors.tables import TIME_UNITS

_OVERTAKING = 3.0  # periods, by which rows are late that others overtake on their way
_FAR = 10.0  # periods; rows that are written later are closer to the others
_TWICE = 1.5  # rows to a period above which, between one and two, a time is there twice
_PAUSE = 1.0  # s; longer steps of an IMU are gaps
_BURST = 0.3  # ratio of median to mean step below which rows come in bursts
_ROUNDED_AWAY = 0.05  # share of the stamps that repeat the one before, where a rounding makes them
_REPEATED = 0.6  # share of rows with the stamp of the previous row above which the log is refused


def format_row_count(mask: Selection, label: str) -> str:
    """The number of rows in a mask (N,), with the sensor's label."""
    return format_count(mask.sum(), f"{label} row".strip())


def order_rows(rows: Table, sensor: str, label: str, unit: str, offset: float, stamps: Array, remarks: Notes) -> Table:
    """The rows ordered by time, without stray stamps and repeated times.

    Parameters
    ----------
    rows : complete ones, their t in seconds plus `offset`.
    label : the sensor's name, in words.
    stamps : of all rows as the file has them, in `unit`.

    Raises
    ------
    RecordingError
        If the stamps run over the same times twice, or most of an IMU's cannot be right.
    """
    scale = TIME_UNITS[unit]
    if (later := find_restarts((rows["t"] - offset) / scale, scale)) is not None:
        remarks.add(
            f"{sensor}.clock_again",
            f"the clock of the {label} restarts at 0: {later.max() * scale:g} s are added after it",
        )
        rows = rows.with_column("t", rows["t"] + later * scale)
    if (stray := find_stray(rows["t"])).any():
        remarks.add(
            f"{sensor}.rows_stray",
            f"{format_row_count(stray, label)} dropped with a stamp before that of the file's first row or after that "
            f"of its last (first {rows['t'][stray][0]:.3f} s)",
        )
        rows = rows.take(~stray)
    t = rows["t"]
    step = np.diff(t)
    if (step < 0).any():
        first = np.flatnonzero(step < 0)[0]
        _check_passes(rows, label)
        remarks.add(
            f"{sensor}.rows_unordered",
            f"{label} rows out of order sorted by time ({format_count((step < 0).sum(), 'step')} back, "
            f"the first after t = {t[first]:.3f} s)",
        )
        rows = rows.take(np.argsort(t, kind="stable"))
        t = rows["t"]
    repeated = find_repeated(f"{rows.path}, column '{rows.file_names['t']}'", t)
    if repeated.any():
        remarks.add(
            f"{sensor}.rows_repeated",
            f"{format_row_count(repeated, label)} with the time of the row before dropped "
            f"(first at t = {t[repeated][0]:.3f} s){_tell_rounding(stamps, repeated)}",
        )
        rows = rows.take(~repeated)
    if sensor == "imu":
        _check_imu_time(rows, unit)
    return rows


def find_stray(t: Array) -> NDArray[np.bool_]:
    """(N,) which stamps, in the order of the file, cannot be right: far before the first or far behind the last.

    None where so many are that these two may be the wrong ones, or where the others are in no order either.
    """
    if len(t) < 3 or t[-1] < t[0]:
        return np.zeros(len(t), dtype=bool)
    far = _FAR * _compute_period(t)
    stray = (t < t[0] - far) | (t > t[-1] + far)
    return stray & (stray.mean() < 0.5 and float(np.min(np.diff(t[~stray]))) > -far)


def _compute_period(t: Array) -> float:
    """The median step between stamps (N,) in any order."""
    steps = np.diff(np.unique(t))
    return float(np.median(steps)) if len(steps) else 0.0


def _check_passes(rows: Table, label: str) -> None:
    """Refuse a clock that was set back: the times before it are then there twice, with other rows."""
    t = rows["t"]
    period = _compute_period(t)
    back = np.flatnonzero(np.diff(t) < -_OVERTAKING * period)
    for k in back[:20]:
        again = float(t[k + 1])
        before = np.flatnonzero(t[: k + 1] >= again)
        after = k + 1 + np.flatnonzero(t[k + 1 :] <= t[k])
        # rows that were only written late fill the gap that they left
        begin, end = max(t[before].min(), t[after].min()), min(t[before].max(), t[after].max())
        shared = end - begin
        if shared < max(0.5 * (t[k] - again), _OVERTAKING * period):
            continue
        both = np.concatenate([before, after])
        both = both[(t[both] >= begin) & (t[both] <= end)]
        different = len(np.unique(np.column_stack([x[both] for x in rows.columns.values()]), axis=0))
        if different > _TWICE * (shared / period + 1.0):
            jump = float(t[k] - again + period)
            leap = " (GPS time and UTC are 18 s apart)" if abs(jump - 18.0) < 0.5 else ""
            raise RecordingError(
                f"{rows.path}: the clock of the {label} is set back by {jump:.2f} s after t = {t[k]:.3f} s{leap}: what "
                "lies between is there twice; write all stamps on one clock",
                key="table.clock_back",
            )


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


def _tell_rounding(stamps: Array, repeated: NDArray[np.bool_]) -> str:
    """'; ...' where stamps (N,), in the file's unit, repeat because they went through single precision."""
    known = stamps[np.isfinite(stamps)]
    step = np.spacing(np.float32(np.abs(known).max())) if len(known) else 0.0
    if repeated.mean() < _ROUNDED_AWAY or not np.array_equal(known, known.astype(np.float32)):
        return ""
    return f": stamps are rounded to {step:g}, as single-precision numbers are; write them with double precision"


def _check_imu_time(rows: Table, unit: str) -> None:
    if len(rows) < 2:
        raise RecordingError(
            f"{rows.path}: {len(rows)} usable row; an IMU recording needs at least 2", key="table.few_rows"
        )
    every = np.diff(rows["t"])
    step = float(np.median(every))
    usual = float(np.mean(every[every < _PAUSE])) if (every < _PAUSE).any() else step
    if step < _BURST * usual:
        raise RecordingError(
            f"{rows.path}: most IMU rows are {step:.2g} s apart, but {usual:.2g} s in the mean: they come in "
            "bursts, with the times of their arrival; write the times at which they were measured",
            key="imu.bursts",
        )
    if 1e-5 < step < 0.5:
        return
    fitting = [u for u in TIME_UNITS if 2.5e-4 <= step / TIME_UNITS[unit] * TIME_UNITS[u] <= 0.1 and u != unit]
    hint = f'; if t is in {fitting[0]}, set units = {{ t = "{fitting[0]}" }}' if fitting else ""
    if step == 1.0:
        hint += "; if it counts rows, write times instead"
    raise RecordingError(
        f"{rows.path}: IMU rows are {step:g} s apart, which no usable IMU is{hint}", key="imu.time_unit"
    )
