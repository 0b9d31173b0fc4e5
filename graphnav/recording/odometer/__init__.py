"""Odometers: error of a reading, wrong readings, and the mean speed over any window."""

from __future__ import annotations

from graphnav.recording.odometer.faults import Faults, faults
from graphnav.recording.odometer.mean import (
    MeanSpeed,
    ReadingStatistics,
    counts,
    find_longest_step,
    gaps,
    quantum,
    reading_sigma,
)

__all__ = [
    "Faults",
    "MeanSpeed",
    "ReadingStatistics",
    "counts",
    "faults",
    "find_longest_step",
    "gaps",
    "quantum",
    "reading_sigma",
]
