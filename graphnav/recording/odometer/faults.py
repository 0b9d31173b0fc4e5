"""Spans in which odometer readings are wrong: unplugged, stuck at zero, frozen, erratic.

The speed read, minus the integral of the forward force, is almost constant while an odometer works: what remains is due
to the slope of the road and biases, which change slowly, and the gyro measures changes of the slope::

    x(t) = v(t) - integral of (f_y - g pitch - c) dt       pitch: integral of the pitch rate
                                                           c: median of the remainder, within half a minute

So x may not change within a short time by more than the error of two readings and the uncertainty of the force. Where
it does, something is wrong (a *break*); the readings before and after show which side of it: readings that stay the
same are stuck, and a short span between others that agree is erratic. Without a usable IMU the limit is the grip of
tyres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphnav.core.findings import compute_period, find_runs
from graphnav.core.rotation import Array
from graphnav.core.running import run_median
from graphnav.recording import Imu, Odometer
from graphnav.recording.odometer.mean import ReadingStatistics, find_gaps

GAP, STUCK, FROZEN, WILD = "no readings", "stuck at zero", "frozen", "against the motion"

_G = 9.81  # m/s^2
_GRIP = 1.2 * _G  # m/s^2, above the grip of tyres on any road
_FORCE_ERROR = 0.05 * _G  # m/s^2, uncertainty of the force: 3 degrees of pitch
_LAG_ERROR = 0.5  # s; shorter windows are no more certain, as the delay is known to some hundredths only
_SCALING = 0.05  # of the speed: scale, and tyres on bumps
_DEAF = 1.0  # m/s, below which passive sensors do not detect a turning wheel (ABS: about 3 km/h)
_BACKWARD = 6.0  # m/s, fastest speed in reverse
_WINDOWS = (0.0, 0.5, 1.0, 2.0, 4.0)  # s over which x is compared; 0: adjacent readings
_TIMES_TYPICAL = 6.0  # multiple of the 90th percentile of the drive itself: an IMU or axes that are worse than assumed
_LARGEST_DELAY = 1.5  # s, largest delay of an odometer (or a third of it early)
_UNCHANGING = 0.05  # m/s per second, on average: no significant change
_STUCK_SPAN = 0.5  # s of equal readings (five at least) that may be stuck
_LONGER = 5.0  # multiple of the duration that 99 % of repetitions stay below
_SPIKE = 1.0  # s
_ISLAND = 10.0  # s that the IMU can bridge
_MOVING_RATE = 0.05  # rad/s for a second: above that of any stationary vehicle
_SHAKEN = 5  # consecutive seconds with vibration as in motion


@dataclass(frozen=True)
class Faults:
    """Spans that are not to be used, ordered, with reasons."""

    spans: Array  # (M, 2) s, [first bad reading, next good one)
    reasons: tuple[str, ...]
    lag: float | None = None  # s, delay of the odometer as far as the IMU shows it


def find_wrong_readings(
    odometer: Odometer, imu: Imu | None = None, figures: ReadingStatistics | None = None, lag: float | None = None
) -> Faults:
    """Spans of missing or wrong readings, by the method above, in the odometer's own time.

    `figures` and `lag` (s) are what is known of the odometer already.
    """
    figures = figures or ReadingStatistics.of(odometer)
    found = [(a, b, GAP) for a, b in find_gaps(odometer.t, figures.longest)]
    if len(odometer.t) >= 10:
        motion = _compute_motion(odometer, imu, lag) if imu is not None and len(imu.t) > 10 else None
        found += _find_wrong(odometer, imu, motion, figures)
        lag = lag if motion is None else motion.lag
    found.sort()
    return Faults(np.array([f[:2] for f in found], dtype=float).reshape(-1, 2), tuple(f[2] for f in found), lag)


@dataclass(frozen=True)
class _InertialMotion:
    """The motion by the IMU at the odometer's times."""

    force: Array  # (M,) m/s, forward force integrated, without slope and bias
    known: NDArray[np.bool_]  # (M,)
    lag: float  # s, delay of the odometer
    up: Array  # (3,) by gravity, body axes


def _find_axes(imu: Imu) -> tuple[Array, Array]:
    """Forward, perpendicular to up, and up by gravity, in body axes."""
    up = np.median(imu.accel, axis=0)
    size = np.linalg.norm(up)
    up = up / size if size > 0.5 * _G else np.array([0.0, 0.0, 1.0])
    ahead = np.array([0.0, 1.0, 0.0]) - up[1] * up
    return ahead / max(float(np.linalg.norm(ahead)), 1e-9), up


def _compute_motion(odometer: Odometer, imu: Imu, known: float | None) -> _InertialMotion | None:
    t, speed = odometer.t, odometer.speed
    dt = np.diff(imu.t, prepend=2 * imu.t[0] - imu.t[1])
    ahead, up = _find_axes(imu)
    right = np.cross(ahead, up)
    pitch = np.cumsum((imu.gyro @ right - np.median(imu.gyro @ right)) * dt)
    force = imu.accel @ ahead - _G * pitch
    gained = np.cumsum(force * dt)
    begin, end = max(t[0], imu.t[0] + _LARGEST_DELAY), min(t[-1], imu.t[-1] - _LARGEST_DELAY)
    seconds = np.arange(begin, end - 1.0)
    if len(seconds) < 10:
        return None
    change = np.interp(seconds + 1.0, t, speed) - np.interp(seconds, t, speed)

    def count_missing(lag: float) -> tuple[Array, Array]:
        gain = np.interp(seconds + 1.0 - lag, imu.t, gained) - np.interp(seconds - lag, imu.t, gained)
        off = change - gain
        return off, run_median(off, min(31, len(off) // 2 * 2 - 1))

    def measure_size(off: Array) -> float:
        return float(np.mean(np.minimum(np.abs(off), 1.0)))  # outliers count no more than 1 m/s

    lags = np.arange(-_LARGEST_DELAY / 3.0, _LARGEST_DELAY + 0.01, 0.05) if known is None else np.array([known])
    misfits = [measure_size(np.subtract(*count_missing(lag))) for lag in lags]
    lag, left = float(lags[int(np.argmin(misfits))]), min(misfits)
    # unrelated clocks or wrong axes: the force does not explain the changes of speed
    if left > max(0.5 * measure_size(change), _UNCHANGING) and measure_size(change) > _UNCHANGING:
        return None
    slow = count_missing(lag)[1]
    # the sum of c, at the middles of the seconds; extrapolated beyond them
    at = t - lag
    ends = np.r_[min(at[0], seconds[0]) - 1.0 - lag, seconds + 0.5 - lag, max(at[-1], seconds[-1]) + 2.0]
    c = np.r_[slow[0], slow, slow[-1]]
    drift = np.r_[0.0, np.cumsum(0.5 * (c[1:] + c[:-1]) * np.diff(ends))]
    holes = np.r_[0, np.cumsum(dt > 5.0 * np.median(dt))]
    hole = holes[np.clip(np.searchsorted(imu.t, at), 0, len(imu.t))]
    inside = (at >= imu.t[0]) & (at <= imu.t[-1])
    # a different number of holes before two readings: the force between them is not known. A step no speed makes
    return _InertialMotion(np.interp(at, imu.t, gained) + np.interp(at, ends, drift) + 1e6 * hole, inside, lag, up)


def _find_breaks(
    odometer: Odometer, motion: _InertialMotion | None, figures: ReadingStatistics
) -> list[tuple[int, int]]:
    """Pairs of readings between which x changes by more than is possible, the closest ones that show it, ordered."""
    t, v = odometer.t, odometer.speed
    error = figures.step + 6.0 * figures.sigma
    period = compute_period(t)
    part = np.r_[0, np.cumsum(np.diff(t) > figures.longest)]
    found: list[tuple[int, int]] = []
    for window in _WINDOWS:
        i = np.arange(len(t) - 1)
        j = np.maximum(np.searchsorted(t, t[i] + window - 1e-9), i + 1)
        i, j = i[j < len(t)], j[j < len(t)]
        i, j = i[part[i] == part[j]], j[part[i] == part[j]]
        dt = t[j] - t[i]
        fast = np.maximum(np.abs(v[i]), np.abs(v[j]))
        allowed = error + _SCALING * fast + np.where((v[i] == 0.0) | (v[j] == 0.0), _DEAF, 0.0)
        off = np.abs(v[j] - v[i])
        bad = off > allowed + _GRIP * (dt + period)
        if motion is not None:
            gained = motion.force[j] - motion.force[i]
            known = motion.known[i] & motion.known[j] & (np.abs(gained) < 1e5)
            off = np.abs(v[j] - v[i] - gained)
            if not odometer.signed:  # what is read may be backward before or after
                other = [np.abs(a * v[j] - b * v[i] - gained) for a, b in ((-1, -1), (1, -1), (-1, 1))]
                off = np.where(fast < _BACKWARD, np.minimum(off, np.min(other, axis=0)), off)
            if known.any():
                moved = known & (fast > 0.0)
                typical = _TIMES_TYPICAL * float(np.percentile(off[moved], 90.0)) if moved.any() else 0.0
                limit = np.maximum(allowed + _FORCE_ERROR * np.maximum(dt, _LAG_ERROR), typical)
                bad |= known & (off > limit)
        found += _intersect(i[bad], j[bad], found)
    return sorted(found)


def _intersect(i: NDArray[np.intp], j: NDArray[np.intp], found: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The intersection of overlapping windows [i, j] (or their union), without those that show a break found
    already.
    """
    out: list[tuple[int, int]] = []
    if found:
        begins, ends = np.array(found).T
        new = ~((i[:, None] < ends) & (j[:, None] > begins)).any(axis=1)
        i, j = i[new], j[new]
    if not len(i):
        return out
    for part in np.split(np.arange(len(i)), np.flatnonzero(i[1:] >= j[:-1]) + 1):
        first, last = (int(i[part].max()), int(j[part].min()))
        out.append((first, last) if first < last else (int(i[part].min()), int(j[part].max())))
    return out


def _find_wrong(
    odometer: Odometer, imu: Imu | None, motion: _InertialMotion | None, figures: ReadingStatistics
) -> list[tuple[float, float, str]]:
    t, v = odometer.t, odometer.speed
    breaks = _find_breaks(odometer, motion, figures)
    equal = [(a - 1, b - 1) for a, b in find_runs(np.r_[False, v[1:] == v[:-1]])]  # first and last of equal readings
    stays = [(a, b) for a, b in equal if b - a >= 4 and t[b] - t[a] >= _STUCK_SPAN]
    bad: list[tuple[int, int, str]] = []  # first wrong reading, first right one
    bad += _find_islands(t, v, motion, breaks, stays, _SPIKE)
    bad += _find_stuck(t, v, motion, breaks, stays)
    bad += _find_noiseless(v, figures, equal, stays)
    if motion is not None and imu is not None:
        bad += _find_moving_zeros(odometer, imu, motion, stays)
    bad += _find_islands(t, v, motion, breaks, stays, _ISLAND)
    bad += [(k + 1, max(m, k + 2), WILD) for k, m in breaks]  # it is unknown which side is right
    return _merge(t, bad)


def _can_follow(t: Array, v: Array, motion: _InertialMotion | None, i: int, j: int) -> bool:
    """Whether the motion can have led from one reading to another."""
    apart = t[j] - t[i]
    gained = 0.0 if motion is None else motion.force[j] - motion.force[i]
    if motion is None or abs(gained) > 1e5:
        return bool(abs(v[j] - v[i]) <= _GRIP * apart)
    return bool(abs(v[j] - v[i] - gained) <= _FORCE_ERROR * max(apart, _LAG_ERROR) + _SCALING * max(v[i], v[j]) + 1e-9)


def _find_islands(
    t: Array,
    v: Array,
    motion: _InertialMotion | None,
    breaks: list[tuple[int, int]],
    stays: list[tuple[int, int]],
    longest: float,
) -> list[tuple[int, int, str]]:
    """Spans between two breaks whose surroundings agree; their breaks are removed from the list."""
    out, k = [], 0
    while k + 1 < len(breaks):
        (before, begin), (end, after) = breaks[k], breaks[k + 1]
        if t[after] - t[before] <= longest and _can_follow(t, v, motion, before, after):
            still = any(a <= begin and end <= b for a, b in stays)
            out.append((before + 1, after, WILD if not still else STUCK if v[begin] == 0.0 else FROZEN))
            del breaks[k : k + 2]
        else:
            k += 1
    return out


def _find_stuck(
    t: Array, v: Array, motion: _InertialMotion | None, breaks: list[tuple[int, int]], stays: list[tuple[int, int]]
) -> list[tuple[int, int, str]]:
    """Equal readings with a break at either end or within; their breaks are removed from the list."""
    out = []
    for a, b in stays:
        mine = [(i, j) for i, j in breaks if i <= b and j >= a]
        # a break at the end only: the readings after it are erratic, if the motion cannot have led there
        if not mine or (mine[0][0] >= b and not _can_follow(t, v, motion, a, mine[-1][1])):
            continue
        for one in mine:
            breaks.remove(one)
        first, last = mine[0][0], max(j for _, j in mine)
        begin = a + (v[a] != 0.0)
        if first < a:
            begin = first + 1
        elif v[a] == 0.0 and mine[0][1] <= b:  # zeros before the vehicle started to move were right
            begin = 1 + (first if motion is None else _find_departure(t, motion.force, a, first))
        out.append((begin, max(last, b + 1), STUCK if v[a] == 0.0 else FROZEN))
    return out


def _find_noiseless(
    v: Array, figures: ReadingStatistics, equal: list[tuple[int, int]], stays: list[tuple[int, int]]
) -> list[tuple[int, int, str]]:
    """Readings that stay the same in motion, of a sensor whose noise exceeds its resolution and so never repeats for
    long.
    """
    if figures.sigma < 2.0 * figures.step:
        return []
    repeats = np.array([b - a for a, b in equal if v[a] != 0.0])
    single: int = max(int((v != 0.0).sum()) - int(np.sum(repeats + 1)), 0)
    typical = np.percentile(np.r_[repeats, np.zeros(single)], 99.0) if len(repeats) + single > 0 else 0.0
    return [(a + 1, b + 1, FROZEN) for a, b in stays if v[a] != 0.0 and b - a > _LONGER * (typical + 1.0)]


def _find_departure(t: Array, force: Array, earliest: int, k: int) -> int:
    """The reading at which the motion at k began: back as long as the force of the preceding second shows it."""
    while k > earliest:
        before = max(int(np.searchsorted(t, t[k] - 1.0)), earliest)
        if abs(force[k] - force[before]) <= _FORCE_ERROR * (t[k] - t[before]):
            break
        k -= 1
    return k


def _find_moving_zeros(
    odometer: Odometer, imu: Imu, motion: _InertialMotion, stays: list[tuple[int, int]]
) -> list[tuple[int, int, str]]:
    """Zeros while the vehicle turns, or vibrates as in motion."""
    t, v, lag, up = odometer.t, odometer.speed, motion.lag, motion.up
    n = max(2, round(1.0 / compute_period(imu.t)))
    count = len(imu.t) // n
    gyro, accel = (x[: count * n].reshape(count, n, 3) for x in (imu.gyro, imu.accel))
    second = imu.t[: count * n].reshape(count, n)[:, [0, -1]]
    read = np.interp(second.mean(axis=1) + lag, t, np.abs(v))
    rest, fast = read == 0.0, read > 3.0
    if not rest.any():
        return []
    turn = np.abs((gyro.mean(axis=1) - np.median(gyro[rest].mean(axis=1), axis=0)) @ up) > _MOVING_RATE
    shaken = np.zeros(count, dtype=bool)
    if fast.sum() >= 20:
        # each axis in a row: half of the time
        shakes = [np.linalg.norm(np.ascontiguousarray(x.transpose(2, 0, 1)).std(axis=2), axis=0) for x in (gyro, accel)]
        like = np.all([x > np.median(x[fast]) for x in shakes], axis=0) & rest
        for a, b in find_runs(like):
            shaken[a:b] = b - a >= _SHAKEN
    out = []
    for a, b in stays:
        if v[a] != 0.0:
            continue
        # the second before or after a stop is ambiguous for a sensor that does not detect slow wheels
        inside = (second[:, 0] + lag > t[a] + 1.0) & (second[:, 1] + lag < t[b] - 1.0)
        shows = np.flatnonzero(inside & (turn | shaken))
        if len(shows):
            out.append((int(np.searchsorted(t, second[shows[0], 0] + lag)), b + 1, STUCK))
    return out


def _merge(t: Array, bad: list[tuple[int, int, str]]) -> list[tuple[float, float, str]]:
    """As times, with overlapping ones merged; the reason is that of the longest part."""
    out: list[tuple[int, int, str, int]] = []
    for begin, end, reason in sorted(bad):
        if out and begin < out[-1][1]:
            first, last, why, size = out[-1]
            out[-1] = (first, max(last, end), *((reason, end - begin) if end - begin > size else (why, size)))
        else:
            out.append((begin, end, reason, end - begin))
    beyond = t[-1] + compute_period(t)
    return [(float(t[a]), float(t[b]) if b < len(t) else beyond, why) for a, b, why, _ in out]
