"""What IMU and fixes say of each other: the gyro's unit, the shift of the clocks, the forward axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.draft import motion
from graphnav.rotation import Array

CLEAR, FAIR = 0.8, 0.5  # correlations: sure, likely
_FAR = 0.75  # the least for a shift of clocks that have nothing in common
_TWO_CLOCKS = 0.15  # s; velocities further from the positions than this have a latency of their own


@dataclass(frozen=True)
class Agreement:
    """`turn` of the turn rates; `position` and `velocity` of the accelerations, as `motion.Lag`, None where unknown."""

    turn: motion.Lag | None = None
    position: motion.Lag | None = None
    velocity: motion.Lag | None = None
    forward: Array | None = None  # (3,) in file axes

    @property
    def best(self) -> motion.Lag | None:
        """The shift of the clocks: of the positions where they say it well, else of the velocities."""
        if self.position is not None and (self.velocity is None or self.position.correlation > FAIR):
            return self.position
        return self.velocity

    @property
    def clearest(self) -> motion.Lag | None:
        """The one with the highest coherence."""
        both = [lag for lag in (self.position, self.velocity) if lag is not None]
        return max(both, key=lambda lag: lag.correlation, default=None)

    @property
    def late_velocity(self) -> bool:
        """Whether the velocities have another latency than the positions."""
        if self.position is None or self.velocity is None:
            return False
        apart = abs(self.position.seconds - self.velocity.seconds)
        return min(self.position.correlation, self.velocity.correlation) > FAIR and apart > _TWO_CLOCKS


def level_axes(up: Array) -> tuple[Array, Array]:
    """Two axes square to `up` and each other, so that the first, the second and up are right-handed."""
    start = np.eye(3)[int(np.abs(up).argmin())]
    first = start - (start @ up) * up
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def compare(t: Array, gyro: Array, accel: Array, up: Array, fixes: tuple[Array, Array, Array | None]) -> Agreement:
    """IMU (N, 3 each, file axes; gyro in any unit) against fixes (times, positions, velocities or None)."""
    courses = [motion.course_of(fixes[0], fixes[1], v) for v in (None, fixes[2])]
    courses = courses if fixes[2] is not None else courses[:1]
    if any(len(course.t) < 10 for course in courses):
        return Agreement()
    grid, rate = motion.on_grid(t, gyro @ up[:, None])
    turns = [lag for course in courses if (lag := _turn_lag(grid, rate[:, 0], course)) is not None]
    turn = max(turns, key=lambda lag: lag.correlation, default=None)
    shift = turn.seconds if turn is not None and abs(turn.seconds) > motion.NEAR else 0.0
    axes = level_axes(up)
    grid, felt = motion.on_grid(t, accel @ np.stack(axes, -1))
    s = motion.band(felt[:, 0]) + 1j * motion.band(felt[:, 1])
    lags: list[motion.Lag | None] = []
    for one in courses:
        z = motion.band(one.forward) + 1j * motion.band(one.left)
        found = motion.lag(grid, s, one.t - shift, z)
        if found is None:
            lags.append(None)
            continue
        # An antenna ahead of the IMU feels sideways what the IMU will feel; along the course they feel the same.
        ahead = motion.lag(grid, (s * np.exp(-1j * np.angle(found.slope))).real, one.t - shift, z.real)
        seconds = ahead.seconds if ahead is not None and ahead.correlation > FAIR else found.seconds
        lags.append(motion.Lag(seconds + shift, found.correlation, found.slope))
    position, velocity = (*lags, None)[:2]
    out = Agreement(turn, position, velocity)
    if out.clearest is None:
        return out
    angle = np.angle(out.clearest.slope)
    return Agreement(turn, position, velocity, np.cos(angle) * axes[0] + np.sin(angle) * axes[1])


def _turn_lag(grid: Array, rate: Array, course: motion.Course) -> motion.Lag | None:
    """The shift of clocks that overlap, unless only another one, any, makes the turns agree."""
    overlap = course.t[0] < grid[-1] and course.t[-1] > grid[0] if len(grid) else False
    near = motion.lag(grid, rate, course.t, course.turn, course.speed**2) if overlap else None
    if near is not None and near.correlation > FAIR:
        return near
    far = motion.lag(grid, rate, course.t, course.turn, course.speed**2, anywhere=True)
    return far if far is not None and far.correlation > _FAR else near
