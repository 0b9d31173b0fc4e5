"""Velocities of the vehicle by a sensor, each a mean over an averaging time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.recording import Gnss, Odometer


@dataclass(frozen=True)
class Track:
    """Velocity from GNSS, each the mean over `width` seconds around t (0: of the instant)."""

    t: Array  # (K,) s
    v: Array  # (K, 3) m/s, ENU
    width: Array  # (K,) s
    period: float  # s between fixes

    @property
    def speed(self) -> Array:
        """Horizontal speed, m/s."""
        return np.hypot(self.v[:, 0], self.v[:, 1])

    @property
    def instant(self) -> bool:
        """Whether these are velocities of the receiver."""
        return not self.width.any()


def compute_local_positions(gnss: Gnss) -> Array:
    """Positions in ENU metres around the first fix, (M, 3)."""
    return LocalFrame(gnss.llh[0]).from_llh(gnss.llh)


def compute_track(gnss: Gnss) -> Track | None:
    """Velocities of the receiver, or differences of positions about a second apart; None if too few."""
    if len(gnss.t) < 5:
        return None
    period = float(np.median(np.diff(gnss.t)))
    if gnss.v is not None:
        there = ~np.isnan(gnss.v[:, 0])
        if there.mean() > 0.3 and there.sum() >= 5:
            return Track(gnss.t[there], gnss.v[there], np.zeros(there.sum()), period)
    m = max(1, round(1.0 / period))
    if len(gnss.t) <= m + 2:
        return None
    p = compute_local_positions(gnss)
    width = gnss.t[m:] - gnss.t[:-m]
    near = width < 1.5 * m * period
    t, v = 0.5 * (gnss.t[m:] + gnss.t[:-m]), (p[m:] - p[:-m]) / width[:, None]
    return Track(t[near], v[near], width[near], period) if near.sum() >= 5 else None


def compute_odometer_track(odometer: Odometer) -> Track:
    """The odometer's speeds ten times a second, as if the drive were straight."""
    thin = slice(None, None, max(1, round(0.1 / float(np.median(np.diff(odometer.t))))))
    t, speed = odometer.t[thin], odometer.speed[thin]
    return Track(t, speed[:, None] * np.array([1.0, 0.0, 0.0]), np.zeros(len(t)), float(np.median(np.diff(t))))
