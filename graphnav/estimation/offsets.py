"""Stamp offsets at the start and the end of a drive, and whether they are close enough to the linearisation point of
the fixes' rows."""

from __future__ import annotations

import numpy as np

from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET, VELOCITY_TIME_OFFSET
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.linearise import Points

LINEAR_OFFSET = 0.3  # s from the linearisation point (`graphnav.estimation.stamps`)


def is_offset_far(problem: Problem, points: Points) -> bool:
    """Whether an offset is far from the linearisation point of its rows, by points of all keyframes."""
    ends = list_end_rows(problem).values()
    return any(float(np.abs(row @ points.values[0]).max()) > LINEAR_OFFSET for row in ends)


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
