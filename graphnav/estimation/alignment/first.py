"""The result of an alignment, and helpers of all its methods."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.recording import Gnss, Recording

STANDING = 0.5  # m/s, of a vehicle that is taken to stand
LEVELLING = 1.0  # s at the start over which the specific force is averaged
_SIGMAS = 3.0


@dataclass(frozen=True)
class Alignment:
    """The prior of the first keyframe: one state, 15 sigmas, and notes."""

    state: States
    sigma: Array  # (15,) of the prior
    own_sigma: Array  # (3,) rad, of roll, pitch, heading, the alignment's own
    notes: tuple[str, ...]
    motion: float | None = None  # s, from when on the heading is known: the first motion, or two antennas; None: never
    until: float | None = None  # s, end of the span of motion, or of first steps
    headings: tuple[float, ...] = ()  # rad, at `motion`, of all minima of the problem over the span of motion
    heading_unknown: bool = False  # nothing tells it: one of all around (`graphnav.estimation.unknown_heading`)

    @property
    def rph(self) -> Array:
        """Roll, pitch, heading, rad."""
        return rotation.to_rph(self.state.R_nb[0])

    @property
    def opening(self) -> float | None:
        """End of what a filter processes twice, s, if anything: all of it where the heading is unknown.

        Where it stands with its tilt and the bias of its accelerometer unknown as well, linearisation at the filter's
        own points, which change by noise, tells these apart.
        """
        return np.inf if self.heading_unknown else self.until

    def contradicts(self, other: Alignment) -> bool:
        """Whether another contradicts this one: by its own sigma of attitude, by the prior's of the rest."""
        sigma = np.concatenate([self.own_sigma, self.sigma[3:]])
        off = np.concatenate([rotation.wrap(self.rph - other.rph), self.state.minus(other.state)[0, 3:]])
        return bool(np.any(np.abs(off) > _SIGMAS * sigma))


def level(recording: Recording, begin: float, seconds: float = LEVELLING) -> Array:
    """(roll, pitch) from the mean specific force after `begin`, rad."""
    imu = recording.imu
    f = imu.accel[(imu.t > begin) & (imu.t <= begin + seconds)]
    f = (f if len(f) else imu.accel[:1]).mean(axis=0)
    return np.array([np.arctan2(-f[0], f[2]), np.arctan2(f[1], np.hypot(f[0], f[2]))])


def pick_fixes(gnss: Gnss, rows: Array) -> Gnss:
    """Select fixes by index or mask."""
    pick: dict[str, Any] = {"t": gnss.t[rows], "llh": gnss.llh[rows], "sd": gnss.sd[rows]}
    if gnss.v is not None and gnss.sd_v is not None:
        pick |= {"v": gnss.v[rows], "sd_v": gnss.sd_v[rows]}
    pick |= {name: x[rows] for name in ("type", "satellites", "residual_rms") if (x := getattr(gnss, name)) is not None}
    return replace(gnss, **pick)
