"""Odometers: error of a reading, wrong readings, and the mean speed over any window."""

from __future__ import annotations

from graphnav.recording.odometer.faults import Faults, find_wrong_readings
from graphnav.recording.odometer.mean import (
    MeanSpeed,
    ReadingStatistics,
    estimate_reading_sigma,
    find_gaps,
    find_longest_step,
    find_pulse_length,
    find_quantum,
)

__all__ = [
    "Faults",
    "MeanSpeed",
    "ReadingStatistics",
    "estimate_reading_sigma",
    "find_gaps",
    "find_longest_step",
    "find_pulse_length",
    "find_quantum",
    "find_wrong_readings",
]
