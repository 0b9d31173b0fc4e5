"""Which rows of a live source cannot be right: beyond any sensor, out of reach, or of a clock that was set back.

The judgements are those of a recording (`graphnav.recording.plausibility.screening`,
`graphnav.recording.formats.repair`), made row by row: a row is left out as if it had never come, and counted. Rows that
every sensor can have sent pass untouched.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from graphnav.core.earth import llh_to_ecef
from graphnav.core.rotation import Array
from graphnav.recording.formats.repair import VAGUEST, VAGUEST_V, is_on_earth
from graphnav.recording.plausibility.fixes import FASTEST, MISLED
from graphnav.recording.plausibility.screening import ACCEL_RANGE, GYRO_RANGE

Row = tuple[str, float, tuple[float, ...]]  # sensor, time (s), values

_BLANK = (math.nan,) * 6
_SUREST = 1e-4  # m, m/s; a tenth of what the phase of a carrier can be measured to
_MOST_FIXES = 600  # fixes: what contradicts so many that agreed is believed when there are more of it
_SET_BACK = 20  # IMU rows one after the other at times that have passed: not some that came late, but another clock
LASTING = 1.2  # s, that these last: more than a second, so that one stands at a second that is remembered
_REMEMBERED = 36_000  # s, ten hours
_SLOWEST = 0.5  # s between rows of an IMU (as in `graphnav.recording.formats.repair`)
_HELD = 200  # rows of other sensors
_OVERTAKING = (
    10.0  # periods; rows that merely overtake each other are closer (as in `graphnav.recording.formats.repair`)
)
_TELLING = 400  # rows of the IMU that tell how often they come
_HOLE = 1.5  # periods between two rows in which another may have been
_STRANDS = 3  # clocks that rows far ahead may be of at a time: one, and two that come of wrong stamps


def find_period(t: Array) -> float:
    """Median time between the newest rows of an IMU at times (N,), s; infinity for a single one."""
    near = np.diff(t[-_TELLING:])
    return float(np.median(near)) if len(near) else math.inf


def imu_reads(values: tuple[float, ...]) -> bool:
    """Whether a sensor can have read this: rates (rad/s) and forces (m/s^2)."""
    gx, gy, gz, ax, ay, az = values
    return (
        -GYRO_RANGE <= gx <= GYRO_RANGE
        and -GYRO_RANGE <= gy <= GYRO_RANGE
        and -GYRO_RANGE <= gz <= GYRO_RANGE
        and -ACCEL_RANGE <= ax <= ACCEL_RANGE
        and -ACCEL_RANGE <= ay <= ACCEL_RANGE
        and -ACCEL_RANGE <= az <= ACCEL_RANGE
    )


def odometer_reads(values: tuple[float, ...]) -> bool:
    """Whether a vehicle can be as fast (m/s)."""
    return -FASTEST <= values[0] <= FASTEST


def fix_odds(values: tuple[float, ...]) -> str | None:
    """What is wrong with a fix by itself, as it is counted; None if nothing is."""
    lat, lon, h = (np.array([x]) for x in values[:3])
    if not is_on_earth(lat, lon, h)[0] or values[0] == values[1] == 0.0:  # as receivers without a fix send
        return "nowhere on Earth"
    if not all(_SUREST <= sd <= VAGUEST for sd in values[3:6]):
        return "a sigma that says nothing"
    return None


def with_sane_velocity(values: tuple[float, ...]) -> tuple[tuple[float, ...], bool]:
    """A fix without a velocity that no vehicle has, and whether it had one."""
    v, sd = values[6:9], values[9:12]
    if not math.isfinite(sum(v) + sum(sd)):
        return values, False
    if math.hypot(*v) <= FASTEST and all(_SUREST <= one <= VAGUEST_V for one in sd):
        return values, False
    return (*values[:6], *_BLANK), True


@dataclass
class Reach:
    """Which fixes can be reached from those before; where many agree that cannot, they are the ones to go on from."""

    _t: float = -math.inf
    _p: Array | None = None  # (3,) m, Earth-fixed, of the newest that was taken
    _count: int = 0  # in a row, up to `_MOST_FIXES`
    _others: list[Row] = field(default_factory=list)  # out of reach of these, one after the other within reach
    _last: tuple[float, Array] | None = None  # the newest of the others

    def take(self, t: float, values: tuple[float, ...]) -> list[Row] | None:
        """Whether a fix is taken: [] if so, None if not, and the others in its place if they outnumber all before."""
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
    """Notices that the clock of the IMU was set back, or ahead.

    Rows at times that have passed are late, or sent again, or of a clock that was set back. Late ones fill a hole,
    those sent again are as they were (a row of every second is remembered), and neither goes on and on. A sender that
    begins again before such a step sends rows of the clock before, too, which need not lie in the past of the new one.
    Rows far ahead are wrong stamps, or of a clock that was set ahead or of an IMU that was silent, if they last, too.
    Meanwhile some rows of the clock before may come late: those are held until rows that go on outnumber them. Fixes
    and readings far from the newest IMU row wait for those that tell whether the clock was set.
    """

    _seconds: dict[int, tuple[float, ...]] = field(default_factory=dict)  # the first row of each second
    _second: int = -(2**62)
    behind: list[Row] = field(default_factory=list)  # rows at times that have passed, held until it shows what they are
    ahead: list[Row] = field(default_factory=list)  # fixes and readings far ahead of the IMU, held likewise
    released: list[Row] = field(default_factory=list)  # that were held and turned out to be of the clock as it is
    known: list[Row] = field(default_factory=list)  # that were held and turned out to be of a clock before
    _again: Literal["", "this", "before"] = ""  # of which clock the rows behind are known, if they are
    _before: dict[int, tuple[float, ...]] = field(default_factory=dict)  # as `_seconds`, of the clocks before
    _ahead: list[Row] = field(default_factory=list)  # rows far ahead at times of a clock before, held likewise
    _sent_again: bool = False  # whether these are known
    _new: bool = False  # whether they are known to be none of it
    _strands: list[list[Row]] = field(default_factory=list)  # rows of the IMU far ahead, those near each other together
    _onward: int = 0  # rows of the IMU that have gone on since some are held

    @property
    def undecided(self) -> bool:
        """Whether rows are held."""
        return bool(self.behind or self.ahead or self._strands)

    def remember(self, t: float, values: tuple[float, ...]) -> None:
        """Note a row that was taken, the newest so far."""
        second = int(t)
        if second != self._second:
            self._second = second
            self._seconds[second] = (t, *values)
            self._ahead, self._sent_again, self._new = [], False, False
            if len(self._seconds) > _REMEMBERED:
                del self._seconds[next(iter(self._seconds))]

    def fits(self, t: float, times: Array) -> bool:
        """Whether a row at a time that has passed may have been missed there; `times` (N,) are those of the rows."""
        period = find_period(times)
        if period > _SLOWEST:
            return False  # one of these two is no time of an IMU
        if t > times[-1] - _OVERTAKING * period or times[0] - _OVERTAKING * period < t < times[0]:
            return True
        k = int(np.searchsorted(times, t))
        return 0 < k < len(times) and bool(times[k] - times[k - 1] > _HOLE * period)

    def hold(self, row: Row) -> bool:
        """Hold a row at a time that has passed; True once these are of a clock that was set back."""
        sensor, t, values = row
        times = [one[1] for one in self.behind if one[0] == "imu"]
        if sensor == "imu":
            if t in times:
                return False  # sent twice
            if times and t < max(times) - LASTING:  # behind these, too
                self.behind, self._again, times = [one for one in self.behind if one[0] != "imu"], "", []
            second = int(t)
            if (t, *values) == self._seconds.get(second):
                self._again = "this"
            elif (t, *values) == self._before.get(second):
                self._again = "before"
            times.append(t)
        self.behind.append(row)
        if self._again:
            others = [one for one in self.behind if one[0] != "imu"]
            self.behind = [row] if sensor == "imu" else []
            (self.released if self._again == "this" else self.known).extend(others)
            return False
        if len(self.behind) - len(times) > _HELD:  # the IMU says nothing
            self.released.append(self.behind.pop(next(k for k, one in enumerate(self.behind) if one[0] != "imu")))
        return len(times) >= _SET_BACK and max(times) - min(times) >= LASTING

    def hold_early(self, row: Row) -> None:
        """Hold a fix or reading far ahead of the IMU: the clock may have been set ahead, which IMU rows will tell."""
        self.ahead.append(row)
        if len(self.ahead) > _HELD:
            self.released.append(self.ahead.pop(0))

    def hold_ahead(self, t: float, values: tuple[float, ...]) -> list[Row] | None:
        """Hold an IMU row far ahead, if it may be one of a clock before that is sent again; None if not.

        Returns those that were held, to be taken in, once they are shown to be new.
        """
        if self._new or int(t) not in self._before:
            return None
        self._sent_again |= self._before[int(t)] == (t, *values)
        self._ahead = [] if self._sent_again else [*self._ahead, ("imu", t, values)]
        if not self._ahead or t - self._ahead[0][1] < LASTING:
            return []
        rows, self._ahead, self._new = self._ahead, [], True
        return rows

    def leap(self, t: float, values: tuple[float, ...], gap: float) -> list[Row]:
        """Hold an IMU row far ahead; returns those that go on from there, in order, once they last.

        `gap` (s) is that between rows of one clock at most.
        """
        for strand in self._strands:
            if strand[0][1] - gap < t < strand[-1][1] + gap:
                break
        else:
            strand = []
            self._strands = [*self._strands[1 - _STRANDS :], strand]
        if t not in [row[1] for row in strand]:
            bisect.insort(strand, ("imu", t, values), key=lambda row: row[1])
        if strand[-1][1] - strand[0][1] < LASTING:
            return []
        self.release()
        return strand

    def go_on(self) -> None:
        """Another row goes on: once these outnumber the rows held, the clock was not set."""
        self._onward += 1
        held = sum(row[0] == "imu" for row in self.behind) + sum(map(len, self._strands))
        if self._again or self._onward >= held:
            self.release()

    def release(self) -> None:
        """The fixes and readings that were held are of this clock, or of none."""
        self.released += [row for row in self.behind if row[0] != "imu"] + self.ahead
        self.behind, self.ahead, self._strands, self._again, self._onward = [], [], [], "", 0

    def set_back(self) -> list[Row]:
        """The rows of the new clock in order; what is remembered is of the old one from now on."""
        held = sorted(self.behind, key=lambda row: row[1])
        self.behind, self._strands, self._again, self._onward = [], [], "", 0
        self._before |= self._seconds
        for second in list(self._before)[:-_REMEMBERED]:
            del self._before[second]
        self._seconds, self._second = {}, -(2**62)
        return held
