"""Residuals of a problem's rows at a smoothed solution."""

from __future__ import annotations

from graphnav.constraints.base import Constraint
from graphnav.problem import Problem
from graphnav.rotation import Array
from graphnav.solution import ConstraintRecord
from graphnav.solvers.passes import Smoothed, residual_record
from graphnav.state import DIM


def record(problem: Problem, rows: Constraint, smoothed: Smoothed) -> ConstraintRecord:
    return residual_record(problem, rows, smoothed.states, values(problem, smoothed))


def values(problem: Problem, smoothed: Smoothed) -> dict[str, Array]:
    """(K, k) per parameter."""
    return {name: smoothed.values[:, at.start - DIM : at.stop - DIM] for name, at in problem.columns.items()}


def values_at(problem: Problem, smoothed: Smoothed, rows: Constraint) -> dict[str, Array]:
    """(N, k) per parameter of some rows."""
    everywhere = values(problem, smoothed)
    return {p.name: everywhere[p.name][rows.keyframe] for p in rows.parameters}
