"""What is said where an estimate breaks down: a matrix has lost its digits, or rows determine nothing."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from graphnav.constraints.base import Constraint
from graphnav.core.errors import EstimationError


def explain_singular(error: np.linalg.LinAlgError) -> EstimationError:
    """Where a matrix has lost its digits on the way."""
    return EstimationError(f"the estimate broke down ({error}): check sigmas, units and axes", key="solver.breakdown")


def explain_rows(parts: Iterable[tuple[Constraint, int, int]]) -> EstimationError:
    """Where a filter's covariance cannot take in some rows, lo..hi of each constraint."""
    at = ", ".join(f"'{rows.name}' row {lo}" for rows, lo, _ in parts)
    return EstimationError(
        f"the filter's covariance broke down at {at}: check sigmas and units", key="solver.breakdown"
    )


def explain_smoother(at: float | None = None) -> EstimationError:
    """Where a smoother's covariance or information has no root, at a time (s) if one is known."""
    when = "" if at is None else f" at {at:.3f} s"
    return EstimationError(
        f"the smoother's information broke down{when}: check sigmas and units", key="solver.breakdown"
    )


def explain_undetermined(at: float | None = None) -> EstimationError:
    """Where rows leave a variable open, at a time (s) if one is known."""
    when = "" if at is None else f" at {at:.3f} s"
    return EstimationError(
        f"the data leave something undetermined{when}: there is no covariance", key="solver.undetermined"
    )
