"""A trajectory in the form that files hold: time, geodetic position, velocity, attitude, and their sigmas."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array


@dataclass(frozen=True)
class Trajectory:
    """A trajectory as output formats write and evaluations read it, in radians and metres.

    Optional parts are None where a source does not have them. `sd_p` and `sd_v` are along the local
    east, north and up; `sd_rph` are of roll, pitch, heading. `covariance`, where known, is of
    (position, velocity, roll-pitch-heading) in those same axes, (K, 9, 9).
    """

    t: Array  # (K,) s, strictly increasing
    llh: Array  # (K, 3) latitude, longitude (rad), ellipsoidal height (m)
    v: Array | None = None  # (K, 3) m/s in the local ENU at the point
    rph: Array | None = None  # (K, 3) roll, pitch, heading, rad
    sd_p: Array | None = None  # (K, 3) m
    sd_v: Array | None = None  # (K, 3) m/s
    sd_rph: Array | None = None  # (K, 3) rad
    gyro_bias: Array | None = None  # (K, 3) rad/s, RFU
    accel_bias: Array | None = None  # (K, 3) m/s^2, RFU
    covariance: Array | None = None  # (K, 9, 9)
    fix_type: Array | None = None  # (K,) of a receiver's trajectory: type of each fix, NaN where unknown
    satellites: Array | None = None  # (K,) of the same: how many it used, NaN where unknown
    gps_zero: float | None = None  # s since the GPS epoch at t = 0, where it is known
    frame: str = "geodetic"  # "local": llh then holds metres x, y, z of unknown origin and yaw
    name: str = ""
    notes: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Trajectory({self.name!r}, {len(self)} rows)"

    @property
    def R_lb(self) -> Array | None:
        """Rotation from body to local ENU, (K, 3, 3)."""
        return None if self.rph is None else rotation.from_rph(self.rph)

    def take(self, index: Array | slice) -> Trajectory:
        """Select rows.

        Parameters
        ----------
        index
            A mask (K,), an index array or a slice.

        Returns
        -------
        Trajectory
            With the same parts.
        """
        values: dict[str, Any] = {
            key: (value[index] if isinstance(value, np.ndarray) else value) for key, value in self.__dict__.items()
        }
        return Trajectory(**values)
