"""The heading of a vehicle by its direction of travel, in addition to its accelerations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.constraints.base import SAME_TIME
from graphnav.core import rotation
from graphnav.core.notes import Note
from graphnav.estimation.alignment.travel import average_across, measure_travel
from graphnav.estimation.solution import Solution
from graphnav.recording import Gnss

COURSE_SIGMA = np.radians(10.0)  # rad, 1-sigma of the stated forward axis against the course: mounting, side slip
_SIGNIFICANT_SIGMAS = 3.0  # significance at which accelerations show reverse, or contradict the course
_REVERSE_SIGMAS = 2.0  # sigmas in favour of reverse beyond which forwards is not assumed either


@dataclass(frozen=True)
class Heading:
    """A heading with its sigma."""

    turn: float  # rad clockwise, from that of the solution
    own: float  # rad, 1-sigma
    wide: float  # rad, that of the prior
    notes: tuple[str, ...] = ()


def use_course(tried: list[Solution], fixes: Gnss, own: float, wide: float) -> Heading:
    """Use that a vehicle's forward axis is its course, forwards or in reverse, to `COURSE_SIGMA`.

    Reverse if the accelerations show it at three sigmas; at two the course is not used; forwards otherwise. The
    assumption is a heading of density exp(cos(heading - found) / sigma^2) / const, which is Gaussian for a small sigma.

    Parameters
    ----------
    tried : solutions of the stretch of motion from several start headings; that of least cost counts.
    fixes : the fixes of that stretch.
    own, wide : rad, 1-sigma of its heading, and that of the prior it becomes.
    """
    least = int(np.argmin([one.cost for one in tried]))
    best, dt = tried[least], float(np.median(np.diff(fixes.t)))
    at = np.clip(np.searchsorted(best.t, fixes.t - SAME_TIME), 0, len(best.t) - 1)
    yaw = np.unwrap(np.arctan2(best.states.R_nb[:, 1, 1], best.states.R_nb[:, 0, 1]))
    way = measure_travel(best.states.p[at, :2], average_across(fixes.sd), yaw[at])
    gone = fixes.t - fixes.t[0]
    alike = _count_alike(float(way.turn[-1]), float(gone[-1]), dt)
    own = min(np.pi, float(np.hypot(np.sqrt(alike) * own, _spread(tried, least, alike))))
    wide = max(own, wide)
    # over a longer distance, fixes err less in its direction, and a biased gyro has turned further
    up, P = best.states.R_nb[0, 2], best.covariance[0][12:15, 12:15]
    drift = 0.5 * gone * np.sqrt(alike * (up @ P @ up))
    sigma = np.hypot(way.sigma / np.maximum(np.abs(way.D), 1e-9), drift)
    told = int(np.argmin(sigma))
    course = float(np.hypot(COURSE_SIGMA, sigma[told]))
    off, notes = -float(np.angle(way.D[told])), tuple[str, ...]()
    for_forwards = 2.0 * np.cos(off) / (own**2 + course**2)
    if for_forwards < -0.5 * _SIGNIFICANT_SIGMAS**2:
        off -= float(np.copysign(np.pi, off))
    elif for_forwards < 0.5 * _SIGNIFICANT_SIGMAS**2:
        notes = (
            Note(
                "alignment.reverse_open",
                "accelerations are too weak to distinguish forwards from reverse: "
                "the first motion is assumed to be forwards",
            ),
        )
    if (
        abs(off) > _SIGNIFICANT_SIGMAS * np.hypot(course, own)
        or -0.5 * _SIGNIFICANT_SIGMAS**2 < for_forwards < -0.5 * _REVERSE_SIGMAS**2
    ):
        # the axes may be wrong, the accelerations or the course: the sigma has to cover all of them
        notes = (
            Note(
                "alignment.axes",
                f"the body's forward axis is {abs(np.degrees(off)):.0f} deg from the course: check the IMU's axes",
            ),
        )
        return Heading(0.0, max(own, abs(off) / _SIGNIFICANT_SIGMAS), max(wide, abs(off) / _SIGNIFICANT_SIGMAS), notes)
    gain = wide**2 / (wide**2 + course**2)
    return Heading(gain * off, float(np.hypot((1.0 - gain) * own, gain * course)), float(np.sqrt(gain) * course), notes)


def _spread(tried: list[Solution], least: int, alike: float) -> float:
    """Spread (rad) of the headings of all solutions about the best one, each weighted by its likelihood."""
    weight = np.array([np.exp((tried[least].cost - one.cost) / alike) for one in tried])
    heading = np.array([rotation.to_rph(one.states.R_nb[0])[2] for one in tried])
    off = rotation.wrap(heading - heading[least])
    return float(np.sqrt(np.sum(weight * off**2) / np.sum(weight)))


def _count_alike(turn: float, length: float, dt: float) -> float:
    """Number of successive fixes that are worth one in the worst case, for changes as fast as a vehicle's motion.

    At a rate w (rad/s), errors of the variance s^2 that are white from fix to fix have the density s^2 dt; the worst
    correlated ones (`graphnav.estimation.alignment.travel`), s^2 / w. The rate is that of the turns (rad, in so many
    seconds), or one turn in the span.
    """
    return max(1.0, length / (max(turn, 2.0 * np.pi) * dt))
