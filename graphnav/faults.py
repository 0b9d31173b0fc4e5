"""Spans of measurements that were found to be wrong, and the problem without them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from graphnav.constraints.base import SAME_TIME, Constraint
from graphnav.problem import Problem
from graphnav.rotation import Array


@dataclass(frozen=True)
class Fault:
    """Consecutive rows of one constraint that no solver uses."""

    kind: str  # name of the constraint
    t_start: float  # s, of the first row
    t_end: float  # s, of the last
    count: int
    reason: str = ""

    def widened(self) -> Fault:
        """With as much again on either side: a fault that grows is found late, and its end may have been believed."""
        length = self.t_end - self.t_start
        return replace(self, t_start=self.t_start - length, t_end=self.t_end + length)


def spans(problem: Problem, weights: dict[str, Array]) -> tuple[Fault, ...]:
    """The rows of weight 0, by constraint and in order of time."""
    out = []
    for rows in problem.constraints:
        lost = np.flatnonzero(weights.get(rows.name, np.ones(len(rows))) == 0.0)
        t = problem.t[rows.keyframe]
        out += [
            Fault(rows.name, float(t[run[0]]), float(t[run[-1]]), len(run))
            for run in np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1)
            if len(run)
        ]
    return tuple(out)


def without(problem: Problem, faults: Iterable[Fault]) -> Problem:
    """The problem with the rows inside faults given no weight."""
    by_kind: dict[str, list[Fault]] = {}
    for fault in faults:
        by_kind.setdefault(fault.kind, []).append(fault)
    return replace(problem, constraints=tuple(_without(problem.t, c, by_kind.get(c.name, [])) for c in problem.constraints))


def _without(t: Array, rows: Constraint, faults: list[Fault]) -> Constraint:
    if not faults:
        return rows
    at = t[rows.keyframe]
    weight = np.ones(len(rows)) if rows.weight is None else rows.weight.copy()
    for fault in faults:
        weight[(at >= fault.t_start - SAME_TIME) & (at <= fault.t_end + SAME_TIME)] = 0.0
    return replace(rows, weight=weight)
