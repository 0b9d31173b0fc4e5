"""Comparison of IMU and fixes: the gyro's unit, the clock offset, the forward axis."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphnav.core.rotation import Array
from graphnav.recording import Gnss, Imu
from graphnav.recording.checks.clock import ClockOffsets, measure_clock_offsets
from graphnav.recording.draft import motion
from graphnav.recording.formats.schema import RATE_UNITS

CLEAR, LIKELY = 0.8, 0.5  # correlations: certain, likely
_LEAST_CORRELATION = 0.75  # least correlation for the offset of unrelated clocks
_SAME_SIZE = 0.3  # of the logarithm of a ratio of turns
_TWO_CLOCKS = 0.15  # s; velocities with a larger offset from the positions have a latency of their own


@dataclass(frozen=True)
class Agreement:
    """`turn` of the turn rates; `position` and `velocity` of the accelerations, as `motion.Lag`, None where unknown.

    These determine the offset of unrelated clocks and the forward direction. The offset of overlapping clocks is
    `clock`, as in `graphnav info`, for fixes `far` seconds earlier than they are stamped.
    """

    turn: motion.Lag | None = None
    position: motion.Lag | None = None
    velocity: motion.Lag | None = None
    forward: Array | None = None  # (3,) in file axes
    far: float = 0.0  # s
    clock: ClockOffsets | None = None
    known: float = 0.0  # s, to be added to the stamps of the fixes beforehand; the rest is found in addition

    @property
    def clearest(self) -> motion.Lag | None:
        """The one with the highest correlation."""
        both = [lag for lag in (self.position, self.velocity) if lag is not None]
        return max(both, key=lambda lag: lag.correlation, default=None)

    @property
    def late_velocity(self) -> float | None:
        """Delay of the velocities against the positions, s, where it is certain."""
        between = self.clock.between if self.clock is not None else None
        if between is None or self.clock is None or self.clock.apart is None or abs(between.lag) < _TWO_CLOCKS:
            return None
        return between.lag

    @property
    def offset(self) -> tuple[float, float] | None:
        """s to add to the stamps of the fixes, and its 1-sigma; None where nothing shows an offset."""
        found = self._found_offset
        if not self.known:
            return found
        return (self.known + found[0], found[1]) if found is not None else (self.known, 0.0)

    @property
    def _found_offset(self) -> tuple[float, float] | None:
        """The offset of the fixes after the known offset has been added to their stamps."""
        if self.clock is None:
            return None
        clock = self.clock if self.late_velocity is None else ClockOffsets(None, self.clock.by_places, None)
        if clock.late is not None:
            return clock.late.lag - self.far, clock.late.spread
        if not self.far:
            return None
        known = clock.by_velocity or clock.by_places
        sure = known is not None and known.correlation > LIKELY and known.spread < motion.GRID
        return (known.lag - self.far, known.spread) if sure and known is not None else (-self.far, motion.GRID)


def find_level_axes(up: Array) -> tuple[Array, Array]:
    """Two axes perpendicular to `up` and each other, such that the first, the second and up are right-handed."""
    start = np.eye(3)[int(np.abs(up).argmin())]
    first = start - (start @ up) * up
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def compare_with_fixes(
    t: Array, gyro: Array, accel: Array, up: Array, fixes: tuple[Array, Array, Array | None], known: float = 0.0
) -> Agreement:
    """IMU (N, 3 each, file axes; gyro in any unit) against fixes (times, positions, velocities or None).

    `known` (s) is to be added to the stamps of the fixes before anything else.
    """
    near = _compare(t, gyro, accel, up, (fixes[0] + known, *fixes[1:]))
    return replace(near, known=known)


def _compare(t: Array, gyro: Array, accel: Array, up: Array, fixes: tuple[Array, Array, Array | None]) -> Agreement:
    courses = [motion.compute_course(fixes[0], fixes[1], v) for v in (None, fixes[2])]
    courses = courses if fixes[2] is not None else courses[:1]
    if any(len(course.t) < 10 for course in courses):
        return Agreement()
    grid, rate = motion.resample_on_grid(t, gyro @ up[:, None])
    turns = [lag for course in courses if (lag := _find_turn_lag(grid, rate[:, 0], course)) is not None]
    turn = max(turns, key=lambda lag: lag.correlation, default=None)
    mirrored = turn is not None and turn.correlation < -LIKELY  # as by a reversed accelerometer: then so are curves
    shift = turn.seconds if turn is not None and abs(turn.seconds) > motion.SEARCHED else 0.0
    axes = find_level_axes(up)
    grid, felt = motion.resample_on_grid(t, accel @ np.stack(axes, -1))
    s = motion.filter_band(felt[:, 0]) + 1j * motion.filter_band(felt[:, 1])
    lags: list[motion.Lag | None] = []
    for one in courses:
        z = motion.filter_band(one.forward) + (-1j if mirrored else 1j) * motion.filter_band(one.left)
        found = motion.find_lag(grid, s, one.t - shift, z)
        if found is None:
            lags.append(None)
            continue
        # an antenna ahead of the IMU senses sideways what the IMU will sense later; along the course both sense the
        # same
        ahead = motion.find_lag(grid, (s * np.exp(-1j * np.angle(found.slope))).real, one.t - shift, z.real)
        seconds = ahead.seconds if ahead is not None and ahead.correlation > LIKELY else found.seconds
        lags.append(motion.Lag(seconds + shift, found.correlation, found.slope))
    position, velocity = (*lags, None)[:2]
    out = Agreement(turn, position, velocity, None, shift, _compare_clocks(t, gyro, accel, fixes, shift))
    if out.clearest is None:
        return out
    angle = np.angle(out.clearest.slope)
    return replace(out, forward=np.cos(angle) * axes[0] + np.sin(angle) * axes[1])


def _compare_clocks(
    t: Array, gyro: Array, accel: Array, fixes: tuple[Array, Array, Array | None], shift: float
) -> ClockOffsets:
    """Compare with the fixes `shift` seconds earlier, as the recording will hold them."""
    rows = np.concatenate([[True], np.diff(fixes[0]) > 0.0]) & np.isfinite(fixes[1]).all(axis=1)
    v = None if fixes[2] is None else fixes[2][rows]
    if v is not None and v.shape[1] == 2:
        v = np.column_stack([v, np.zeros(len(v))])
    gnss = Gnss(fixes[0][rows] - shift, fixes[1][rows], np.ones((int(rows.sum()), 3)), v)
    return measure_clock_offsets(Imu(t, gyro, accel), gnss)


def _find_turn_lag(grid: Array, rate: Array, course: motion.Course) -> motion.Lag | None:
    """The offset of overlapping clocks, unless only an arbitrary one makes the turns agree.

    Single turns agree at many offsets, but not in size: there the gyro must measure them in a unit that there is.
    """
    overlap = course.t[0] < grid[-1] and course.t[-1] > grid[0] if len(grid) else False
    near = motion.find_lag(grid, rate, course.t, course.turn, course.speed**2) if overlap else None
    if near is not None and near.correlation > LIKELY:
        return near
    far = motion.find_lag(grid, rate, course.t, course.turn, course.speed**2, anywhere=True)
    if far is None or far.correlation < _LEAST_CORRELATION:
        return near
    if overlap:
        # one over the slope of the course, which has the noise, over the gyro
        size = far.slope.real / far.correlation**2
        if all(abs(np.log(size * unit)) > _SAME_SIZE for unit in RATE_UNITS.values()):
            return near
    return far
