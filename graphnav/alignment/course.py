"""What the direction of travel says of the heading of a vehicle, beside what its accelerations say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav import rotation
from graphnav.alignment.travel import Travel, travel
from graphnav.rotation import Array
from graphnav.solution import Solution

COURSE_SIGMA = np.radians(10.0)  # rad, a stated forward axis against the course: mounting, side slip
_SIGMAS = 3.0


@dataclass(frozen=True)
class Heading:
    """What is known of a heading, and how well."""

    turn: float  # rad clockwise, from that of the solution
    own: float  # rad, 1-sigma
    wide: float  # rad, that of the prior
    notes: tuple[str, ...] = ()


def with_course(solution: Solution, sd: Array, dt: float, own: float, wide: float) -> Heading:
    """Bring in that a vehicle's forward axis is its course, forwards or in reverse, to `COURSE_SIGMA`.

    Forwards, unless the accelerations speak against that at three sigmas; they mean a heading of density
    exp(cos(heading - found) / sigma^2) / const, which for a small sigma is that of Gauss.

    Parameters
    ----------
    solution : of the stretch of motion, from accelerations alone.
    sd : (K,) m, 1-sigma along one axis of a fix at each of its keyframes.
    dt : s between fixes.
    own, wide : rad, 1-sigma of its heading, and that of the prior it becomes.
    """
    facing = solution.states.R_nb[:, 0, 1] + 1j * solution.states.R_nb[:, 1, 1]
    way = travel(solution.states.p[:, :2], sd, facing / np.maximum(np.abs(facing), 1e-9))
    length = float(solution.t[-1] - solution.t[0])
    own *= np.sqrt(_alike(way, length, dt))
    wide = max(own, wide)
    up, P = solution.states.R_nb[0, 2], solution.covariance[0][12:15, 12:15]
    drift = 0.5 * length * float(np.sqrt(up @ P @ up))
    of_way = float(way.sigma[-1] / max(abs(way.D[-1]), 1e-9))
    course = float(np.sqrt(COURSE_SIGMA**2 + of_way**2 + drift**2))
    off, notes = -float(np.angle(way.D[-1])), ()
    for_forwards = 2.0 * np.cos(off) / (own**2 + course**2)
    if for_forwards < -0.5 * _SIGMAS**2:
        off = float(rotation.wrap(off + np.pi))
    elif for_forwards < 0.5 * _SIGMAS**2:
        notes = ("accelerations are too weak to tell forwards from reverse: the first motion is taken to be forwards",)
    if abs(off) > _SIGMAS * np.hypot(course, own):
        # one of them is wrong; a sigma has to cover both
        notes = (f"the body's forward axis is {abs(np.degrees(off)):.0f} deg from the course: check the IMU's axes",)
        return Heading(0.0, max(own, abs(off) / _SIGMAS), max(wide, abs(off) / _SIGMAS), notes)
    gain = wide**2 / (wide**2 + course**2)
    return Heading(gain * off, float(np.hypot((1.0 - gain) * own, gain * course)), float(np.sqrt(gain) * course), notes)


def _alike(way: Travel, length: float, dt: float) -> float:
    """How many fixes in a row are worth one at worst, for what changes as quickly as a vehicle's motion.

    At a rate w (rad/s), errors of the variance s^2 that are white from fix to fix have the density s^2 dt; the worst
    that last (`graphnav.alignment.travel`), s^2 / w. The rate is that of the turns, or once in the stretch.
    """
    return max(1.0, length / (max(float(way.turn[-1]), 2.0 * np.pi) * dt))
