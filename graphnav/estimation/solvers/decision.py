"""Decisions from a filter's estimate, such as integers, and their constraints on the filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.recursion import invert_sum, update_covariance


@dataclass(frozen=True)
class DecidedRows:
    """A decision at a keyframe: rows to hold from now on, and variance to add."""

    H: Array  # (m, D)
    residual: Array  # (m,)
    sigma: Array  # (m,)
    added: Array  # (D,) variance


Decide = Callable[[int, Points, Array], DecidedRows | None]  # of a keyframe, the point there and P (D, D)


def hold(one: DecidedRows, P: Array) -> tuple[Array, Array]:
    """Update with decided rows: the correction (D,) of the estimate, and the covariance about its old point."""
    P = P + np.diag(one.added)
    if not len(one.residual):
        return np.zeros(len(P)), P
    HP, variance = one.H @ P, one.sigma**2
    _, inverse = invert_sum(HP @ one.H.T, variance)
    Kt = inverse.T @ (inverse @ HP)
    return -(one.residual @ Kt), update_covariance(P, HP, one.H, Kt, variance)
