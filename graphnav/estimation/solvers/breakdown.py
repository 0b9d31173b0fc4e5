"""Errors for numerical breakdowns: singular matrices, or variables that are not determined."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from graphnav.constraints.base import Constraint
from graphnav.core.errors import EstimationError

BREAKDOWN = EstimationError, np.linalg.LinAlgError  # errors of a filter with a numerically singular covariance


def explain_singular(error: np.linalg.LinAlgError) -> EstimationError:
    """Error for a matrix that became singular."""
    return EstimationError(f"the estimate broke down ({error}): check sigmas, units and axes", key="solver.breakdown")


def explain_rows(parts: Iterable[tuple[Constraint, int, int]]) -> EstimationError:
    """Error for a filter update that failed with some rows, lo..hi of each constraint."""
    at = ", ".join(f"'{rows.name}' row {lo}" for rows, lo, _ in parts)
    return EstimationError(
        f"the filter's covariance broke down at {at}: check sigmas and units", key="solver.breakdown"
    )


def explain_smoother(at: float | None = None) -> EstimationError:
    """Error for a smoother's covariance or information without a root, at a time (s) if known."""
    when = "" if at is None else f" at {at:.3f} s"
    return EstimationError(
        f"the smoother's information broke down{when}: check sigmas and units", key="solver.breakdown"
    )


def explain_undetermined(at: float | None = None) -> EstimationError:
    """Error for an undetermined variable, at a time (s) if known."""
    when = "" if at is None else f" at {at:.3f} s"
    return EstimationError(
        f"the data leave something undetermined{when}: there is no covariance", key="solver.undetermined"
    )
