"""Increments of angle and velocity, as inertial navigators write them, divided by their sample period."""

from __future__ import annotations

import numpy as np

from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array

_GAP_PERIODS = 1.5  # a step of this many periods is a gap: the increments after it are still of one period


def compute_periods(t: Array) -> tuple[Array, Array]:
    """The periods (N,), s, that the increments of rows at times t (N,) are of, and which rows (N,) are after a gap."""
    step = np.diff(t)
    period = float(np.median(step)) if len(step) else 1.0
    gap = np.concatenate([[False], step > _GAP_PERIODS * period])
    return np.where(gap, period, np.concatenate([[period], step])), gap


def note_gaps(gap: Array, remarks: Notes) -> None:
    if gap.any():
        remarks.add(
            "imu.increments_after_gap",
            f"{format_count(gap.sum(), 'gap')} in the IMU: the increments after each are taken as those of one period",
        )
