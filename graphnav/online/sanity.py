"""Rejection of impossible rows of a live source: beyond any sensor, out of reach, or of a clock that was set back.

The tests are those of a recording (`graphnav.recording.plausibility.screening`, `graphnav.recording.formats.repair`),
made row by row: a rejected row is treated as if it had never arrived, and counted. Possible rows pass unchanged.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from graphnav.core.earth import llh_to_ecef
from graphnav.core.rotation import Array
from graphnav.recording.formats.places import is_on_earth
from graphnav.recording.formats.repair import VAGUEST, VAGUEST_V
from graphnav.recording.plausibility.fixes import FASTEST, MISLED
from graphnav.recording.plausibility.screening import ACCEL_RANGE, GYRO_RANGE

Row = tuple[str, float, tuple[float, ...]]  # sensor, time (s), values

_BLANK = (math.nan,) * 6
_LEAST_SIGMA_LIVE = 1e-4  # m, m/s; a tenth of the resolution of a carrier's phase
# fixes: consistent ones that contradict earlier ones are accepted once they are more than these, up to so many
_MOST_FIXES = 600
_SET_BACK_ROWS = 20  # consecutive IMU rows at times that have passed: not late rows, but another clock
CERTAIN_SPAN = 1.2  # s, duration of these: more than a second, so that one falls on a remembered second
_REMEMBERED_SPAN = 36_000  # s, ten hours
_LONGEST_PERIOD = 0.5  # s between rows of an IMU (as in `graphnav.recording.formats.stamps`)
_HELD = 200  # rows of other sensors held at most
_OVERTAKING = 10.0  # periods; rows that overtake each other are closer (as in `graphnav.recording.formats.stamps`)
_PERIOD_ROWS = 400  # rows of the IMU that determine its period
_HOLE = 1.5  # periods between two rows between which another may be missing
_STRANDS = 3  # clocks tracked at a time for rows far ahead: one real, and two from wrong stamps


def find_period(t: Array) -> float:
    """Median time between the newest rows of an IMU at times (N,), s; infinity for a single one."""
    near = np.diff(t[-_PERIOD_ROWS:])
    return float(np.median(near)) if len(near) else math.inf


def can_imu_read(values: tuple[float, ...]) -> bool:
    """Whether an IMU can read these rates (rad/s) and forces (m/s^2)."""
    gx, gy, gz, ax, ay, az = values
    return (
        -GYRO_RANGE <= gx <= GYRO_RANGE
        and -GYRO_RANGE <= gy <= GYRO_RANGE
        and -GYRO_RANGE <= gz <= GYRO_RANGE
        and -ACCEL_RANGE <= ax <= ACCEL_RANGE
        and -ACCEL_RANGE <= ay <= ACCEL_RANGE
        and -ACCEL_RANGE <= az <= ACCEL_RANGE
    )


def can_odometer_read(values: tuple[float, ...]) -> bool:
    """Whether a vehicle can be that fast (m/s)."""
    return -FASTEST <= values[0] <= FASTEST


def find_fix_fault(values: tuple[float, ...]) -> str | None:
    """The fault of a fix by itself, under the name it is counted by; None if there is none."""
    lat, lon, h = (np.array([x]) for x in values[:3])
    if not is_on_earth(lat, lon, h)[0] or values[0] == values[1] == 0.0:  # sent by receivers without a fix
        return "nowhere on Earth"
    if not all(_LEAST_SIGMA_LIVE <= sd <= VAGUEST for sd in values[3:6]):
        return "a sigma too large to carry information"
    return None


def drop_insane_velocity(values: tuple[float, ...]) -> tuple[tuple[float, ...], bool]:
    """A fix without an impossible velocity, and whether it had one."""
    v, sd = values[6:9], values[9:12]
    if not math.isfinite(sum(v) + sum(sd)):
        return values, False
    if math.hypot(*v) <= FASTEST and all(_LEAST_SIGMA_LIVE <= one <= VAGUEST_V for one in sd):
        return values, False
    return (*values[:6], *_BLANK, *values[12:]), True


@dataclass
class Reach:
    """Whether fixes can be reached from the previous ones; once consistent unreachable fixes outnumber the earlier
    ones, they replace them.
    """

    _t: float = -math.inf
    _p: Array | None = None  # (3,) m, Earth-fixed, of the newest accepted fix
    _count: int = 0  # consecutive ones, up to `_MOST_FIXES`
    _others: list[Row] = field(default_factory=list)  # out of reach of these, but each within reach of the one before
    _last: tuple[float, Array] | None = None  # the newest of the others

    def take(self, t: float, values: tuple[float, ...]) -> list[Row] | None:
        """Whether a fix is accepted: [] if so, None if not, and the alternative fixes if they outnumber all before."""
        p = llh_to_ecef(np.array(values[:3]))
        if self._p is None or _is_near(t - self._t, p - self._p):
            if t > self._t:
                self._t, self._p = t, p
            self._count = min(self._count + 1, _MOST_FIXES)
            self._others.clear()
            return []
        if self._last is None or not self._others or not _is_near(t - self._last[0], p - self._last[1]):
            self._others.clear()
        self._others.append(("gnss", t, values))
        self._last = t, p
        if len(self._others) <= self._count:
            return None
        rows, self._others = self._others, []
        self._t, self._p, self._count = t, p, min(len(rows), _MOST_FIXES)
        return rows


def _is_near(dt: float, dp: Array) -> bool:
    return float(np.linalg.norm(dp)) <= FASTEST * abs(dt) + MISLED


@dataclass
class ClockGuard:
    """Detects that the clock of the IMU was set back, or ahead.

    Rows at times that have passed are late, repeated, or of a clock that was set back. Late rows fill a gap, repeated
    ones are identical (one row of every second is remembered), and neither continue for long. A sender that restarts
    before such a step also sends rows of the earlier clock, which need not lie in the past of the new one. Rows far
    ahead have wrong stamps, unless they continue: then the clock was set ahead, or the IMU was silent.
    """

    _seconds: dict[int, tuple[float, ...]] = field(default_factory=dict)  # the first row of each second
    _second: int = -(2**62)
    behind: list[Row] = field(default_factory=list)  # rows at times that have passed, held until they can be classified
    ahead: list[Row] = field(default_factory=list)  # fixes and readings far ahead of the IMU, held likewise
    released: list[Row] = field(default_factory=list)  # held rows that proved to be of the current clock
    known: list[Row] = field(default_factory=list)  # held rows that proved to be of an earlier clock
    _behind_clock: Literal["", "this", "before"] = ""  # the clock that the rows behind are known to be of, if any
    _before: dict[int, tuple[float, ...]] = field(default_factory=dict)  # as `_seconds`, of earlier clocks
    _ahead: list[Row] = field(default_factory=list)  # rows far ahead at times of an earlier clock, held likewise
    _sent_again: bool = False  # whether these are known to be of that clock
    _new: bool = False  # whether they are known not to be
    _strands: list[list[Row]] = field(default_factory=list)  # rows of the IMU far ahead, grouped by closeness
    _onward: int = 0  # number of regular IMU rows since some are held

    @property
    def undecided(self) -> bool:
        """Whether rows are held."""
        return bool(self.behind or self.ahead or self._strands)

    def remember(self, t: float, values: tuple[float, ...]) -> None:
        """Remember a row that was accepted, the newest so far."""
        second = int(t)
        if second != self._second:
            self._second = second
            self._seconds[second] = (t, *values)
            self._ahead, self._sent_again, self._new = [], False, False
            if len(self._seconds) > _REMEMBERED_SPAN:
                del self._seconds[next(iter(self._seconds))]

    def fits(self, t: float, times: Array) -> bool:
        """Whether a row at a time that has passed may have been missing there; `times` (N,) are those of the rows."""
        period = find_period(times)
        if period > _LONGEST_PERIOD:
            return False  # one of these two stamps is wrong
        if t > times[-1] - _OVERTAKING * period or times[0] - _OVERTAKING * period < t < times[0]:
            return True
        k = int(np.searchsorted(times, t))
        return 0 < k < len(times) and bool(times[k] - times[k - 1] > _HOLE * period)

    def hold(self, row: Row) -> bool:
        """Hold a row at a time that has passed; True once such rows show that the clock was set back."""
        sensor, t, values = row
        times = [one[1] for one in self.behind if one[0] == "imu"]
        if sensor == "imu":
            if t in times:
                return False  # repeated
            if times and t < max(times) - CERTAIN_SPAN:  # behind these as well
                self.behind, self._behind_clock, times = [one for one in self.behind if one[0] != "imu"], "", []
            second = int(t)
            if (t, *values) == self._seconds.get(second):
                self._behind_clock = "this"
            elif (t, *values) == self._before.get(second):
                self._behind_clock = "before"
            times.append(t)
        self.behind.append(row)
        if self._behind_clock:
            others = [one for one in self.behind if one[0] != "imu"]
            self.behind = [row] if sensor == "imu" else []
            (self.released if self._behind_clock == "this" else self.known).extend(others)
            return False
        if len(self.behind) - len(times) > _HELD:  # the IMU is silent
            self.released.append(self.behind.pop(next(k for k, one in enumerate(self.behind) if one[0] != "imu")))
        return len(times) >= _SET_BACK_ROWS and max(times) - min(times) >= CERTAIN_SPAN

    def hold_early(self, row: Row) -> None:
        """Hold a fix or reading far ahead of the IMU: the clock may have been set ahead, which IMU rows will show."""
        self.ahead.append(row)
        if len(self.ahead) > _HELD:
            self.released.append(self.ahead.pop(0))

    def hold_ahead(self, t: float, values: tuple[float, ...]) -> list[Row] | None:
        """Hold an IMU row far ahead, if it may be a repeated row of an earlier clock; None if it is not.

        Returns the held rows, to be processed, once they are known to be new.
        """
        if self._new or int(t) not in self._before:
            return None
        self._sent_again |= self._before[int(t)] == (t, *values)
        self._ahead = [] if self._sent_again else [*self._ahead, ("imu", t, values)]
        if not self._ahead or t - self._ahead[0][1] < CERTAIN_SPAN:
            return []
        rows, self._ahead, self._new = self._ahead, [], True
        return rows

    def hold_leap(self, t: float, values: tuple[float, ...], gap: float) -> list[Row]:
        """Hold an IMU row far ahead; returns the rows that continue from there, in order, once there are enough.

        `gap` (s) is the longest between rows of one clock.
        """
        for strand in self._strands:
            if strand[0][1] - gap < t < strand[-1][1] + gap:
                break
        else:
            strand = []
            self._strands = [*self._strands[1 - _STRANDS :], strand]
        if t not in [row[1] for row in strand]:
            bisect.insort(strand, ("imu", t, values), key=lambda row: row[1])
        if strand[-1][1] - strand[0][1] < CERTAIN_SPAN:
            return []
        self.release()
        return strand

    def go_on(self) -> None:
        """Count a regular row: once these outnumber the held rows, the clock was not set."""
        self._onward += 1
        held = sum(row[0] == "imu" for row in self.behind) + sum(map(len, self._strands))
        if self._behind_clock or self._onward >= held:
            self.release()

    def release(self) -> None:
        """The held fixes and readings are of this clock, or of none."""
        self.released += [row for row in self.behind if row[0] != "imu"] + self.ahead
        self.behind, self.ahead, self._strands, self._behind_clock, self._onward = [], [], [], "", 0

    def set_back(self) -> list[Row]:
        """The rows of the new clock in order; what is remembered is of the old one from now on."""
        held = sorted(self.behind, key=lambda row: row[1])
        self.behind, self._strands, self._behind_clock, self._onward = [], [], "", 0
        self._before |= self._seconds
        for second in list(self._before)[:-_REMEMBERED_SPAN]:
            del self._before[second]
        self._seconds, self._second = {}, -(2**62)
        return held
