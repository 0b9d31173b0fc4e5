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


def explain_time(t: float, what: str = "information") -> EstimationError:
    """Where a smoother's information or covariance is not positive definite at a time, s."""
    return EstimationError(
        f"the smoother's {what} broke down at {t:.3f} s: check the sigmas and units", key="solver.breakdown"
    )
