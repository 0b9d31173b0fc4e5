"""Residuals of a problem's rows at a smoothed solution."""

from __future__ import annotations

from graphnav.constraints.base import Constraint
from graphnav.problem import Problem
from graphnav.rotation import Array
from graphnav.solution import ConstraintRecord
from graphnav.solvers.passes import Smoothed, residual_record, values_of


def record(problem: Problem, rows: Constraint, smoothed: Smoothed) -> ConstraintRecord:
    return residual_record(problem, rows, smoothed.states, values_of(problem, smoothed))


def values_at(problem: Problem, smoothed: Smoothed, rows: Constraint) -> dict[str, Array]:
    """(N, k) per parameter of some rows."""
    everywhere = values_of(problem, smoothed)
    return {p.name: everywhere[p.name][rows.keyframe] for p in rows.parameters}
