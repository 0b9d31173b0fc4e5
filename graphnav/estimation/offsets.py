"""Stamp offsets: a recording with its stamps moved by them, and whether they are close enough to the linearisation
point of the fixes' rows, at the start and the end of a drive.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from graphnav.constraints.antenna_motion import LINEAR_OFFSET
from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET, VELOCITY_TIME_OFFSET
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.core.timescales import shift_stamps
from graphnav.estimation.noise.model import StampOffsets
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.linearise import Points
from graphnav.recording import Recording

AS_STATED = StampOffsets()


def is_offset_far(problem: Problem, points: Points, far: float = LINEAR_OFFSET) -> bool:
    """Whether an offset is as far (s) from the linearisation point of its rows, by points of all keyframes."""
    ends = list_end_rows(problem).values()
    return any(float(np.abs(row @ points.values[0]).max()) > far for row in ends)


def list_end_rows(problem: Problem) -> dict[str, Array]:
    """Rows (2, D-15) that map parameters to stamp offsets at the start and the end of the drive, by the parameter of
    the constant offset.
    """
    columns, out = problem.columns, {}
    for name in (TIME_OFFSET, VELOCITY_TIME_OFFSET):
        if name in columns:
            rows = np.zeros((2, sum(at.stop - at.start for at in columns.values())))
            rows[:, columns[name].start - DIM] = 1.0
            if CLOCK_RATE in columns:
                rows[1, columns[CLOCK_RATE].start - DIM] = problem.t[-1] - problem.frame.epoch
            out[name] = rows
    return out


def move_stamps(recording: Recording, offsets: StampOffsets) -> Recording:
    """The recording with its stamps moved to the clock of the IMU."""
    if offsets == AS_STATED:
        return recording
    changed: dict[str, Any] = {}
    if recording.gnss is not None:
        changed["gnss"] = replace(
            recording.gnss,
            t=shift_stamps(recording.gnss.t, offsets.positions, offsets.rate, offsets.since),
            velocity_offset=recording.gnss.velocity_offset + offsets.velocities - offsets.positions,
        )
    if recording.odometer is not None and offsets.odometer:
        changed["odometer"] = replace(recording.odometer, t=recording.odometer.t + offsets.odometer)
    return replace(recording, **changed)
