"""Consistency of IMU readings with those before and after them in a running drive.

The tests are those of a recording (`graphnav.recording.plausibility`), on the rows so far.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array
from graphnav.online.buffers import Buffer
from graphnav.online.sanity import find_period
from graphnav.recording.plausibility.filled import StraightLines, find_filled
from graphnav.recording.plausibility.readings import ALONE, HOLE, RARE, Excesses, find_contradicted, measure_excess

CONTRADICTED = "contradicted by those around"
FILLED = "on a straight line between those around"
_ROWS = 36_000_000  # of a drive, in which one may lie on a line by chance: ten hours at 1000 Hz


@dataclass
class FilledRows:
    """Rows that lie on straight lines or repeat one row, in stretches."""

    count: int = 0
    stretches: int = 0
    longest: tuple[float, float] = (0.0, 0.0)  # s, its duration and its beginning
    _begin: float = -np.inf
    _end: float = -np.inf

    def add(self, t: float) -> None:
        """Add a row, s; rows that follow each other by less than a second are of one stretch."""
        if not 0.0 <= t - self._end < 1.0:
            self.stretches, self._begin = self.stretches + 1, t
        self.count, self._end = self.count + 1, t
        self.longest = max(self.longest, (t - self._begin, self._begin))


class Neighbours:
    """Typical deviations of readings from their neighbours, and readings that deviate too far.

    Parameters
    ----------
    columns : of the IMU's rows that are compared.
    """

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._excesses = Excesses(columns)
        self._learnt = -np.inf  # s, up to where rows are in these
        self._lines: StraightLines | None = None  # statistics of rows on straight lines, where they can be determined
        self._last: tuple[tuple[float, ...], tuple[float, ...]] | None = None  # the newest two rows with their times
        self._frozen: tuple[float, ...] | None = None  # the readings that a stuck sensor repeats
        self.filled = FilledRows()

    def forget_newest(self) -> None:
        """Forget the newest rows: what follows is not adjacent to them."""
        self._last = None

    def forget_time(self) -> None:
        """Forget all times: the clock has changed."""
        self._last, self._learnt = None, -np.inf

    @property
    def frozen(self) -> bool:
        """Whether the sensor is stuck, by the newest rows."""
        return self._frozen is not None

    def skip_frozen(self, t: float, values: tuple[float, ...]) -> bool:
        """Count a new row, and return True, if it repeats once more what a stuck sensor has repeated before."""
        if self._frozen is None:
            return False
        if values != self._frozen:
            self._frozen = None
            return False
        self.filled.add(t)
        return True

    def compare(self, t: float, values: tuple[float, ...], imu: Buffer) -> tuple[float, float, str] | None:
        """Times of the two rows before the newest, if no sensor measured the second of them, and why."""
        before, now = self._last, (t, *values)
        self._last = now if before is None else before[1], now
        if before is None:
            return None
        why = ""
        if self._lines is not None and self._lines.hold(before[0], before[1], now):
            why = FILLED
            if before[0][1:] == before[1][1:] == values:
                self._frozen = values
        else:
            for a, b, c, limit in zip(before[0][1:], before[1][1:], values, self._excesses.limits, strict=False):
                if b - max(a, c) > limit or min(a, c) - b > limit:
                    why = CONTRADICTED
                    break
        if not why:
            return None
        near = imu.t[-3:]
        if len(imu) < 4 or near[0] != before[0][0] or near[1] != before[1][0]:
            return None  # there is a late row between them
        if why == CONTRADICTED and np.diff(near).max() >= HOLE * find_period(imu.t):
            return None
        self._last = before[0], now
        if why == FILLED:
            self.filled.add(before[1][0])
        return before[0][0], before[1][0], why

    def learn(self, imu: Buffer, until: float, stops: Array) -> None:
        """Learn typical deviations from the rows up to a time (s), except those in stops (M, 2)."""
        rows = imu.copy_between(self._learnt, until)
        if len(rows) < 3:
            return
        self._learnt = float(rows[-2, 0])
        t = rows[1:-1, 0, None]
        moving = ~((t >= stops[:, 0]) & (t <= stops[:, 1])).any(axis=1)
        self._excesses.add(measure_excess(rows[:, 1 : 1 + self._columns])[moving])

    def find(self, imu: Buffer) -> list[tuple[float, str]]:
        """Times of the rows that no sensor measured, and why, except the newest, which has no successor yet."""
        rows = imu.rows
        t, known = rows[:, 0], rows[:, 0] < imu.newest - ALONE
        filled, lines = find_filled(t, rows[:, 1:7].T)
        self._lines = lines if lines is not None and lines.log_chance < np.log(RARE / _ROWS) else None
        left = ~(filled & known)
        bad = find_contradicted(t[left], rows[left, 1 : 1 + self._columns].T) & known[left]
        for x in t[~left].tolist():
            self.filled.add(x)
        return [(float(x), FILLED) for x in t[~left]] + [(float(x), CONTRADICTED) for x in t[left][bad]]
