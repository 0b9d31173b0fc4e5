"""Whether offsets of stamps are estimated near enough to where the rows of fixes are linearised in them."""

from __future__ import annotations

from graphnav.constraints.gnss import OFFSETS
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import split_values

LINEAR_OFFSET = 0.3  # s from the linearisation point (`graphnav.estimation.stamps`)


def is_offset_far(problem: Problem, points: Points) -> bool:
    """Whether an offset is far from where its rows are linearised, by points of all keyframes."""
    values = split_values(problem, points)
    return any(abs(float(values[name][0, 0])) > LINEAR_OFFSET for name in OFFSETS.values() if name in values)
