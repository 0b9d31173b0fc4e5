"""Odometers: error of a reading, wrong readings, and the mean speed over any window."""

from __future__ import annotations

from graphnav.recording.odometer.faults import Faults, faults
from graphnav.recording.odometer.mean import (
    MeanSpeed,
    ReadingStatistics,
    find_gaps,
    find_longest_step,
    find_pulse_length,
    find_quantum,
    reading_sigma,
)

__all__ = [
    "Faults",
    "MeanSpeed",
    "ReadingStatistics",
    "faults",
    "find_gaps",
    "find_longest_step",
    "find_pulse_length",
    "find_quantum",
    "reading_sigma",
]
