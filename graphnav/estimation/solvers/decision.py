"""What somebody decides by a filter's estimate, and the filter then holds to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphnav.core.rotation import Array
from graphnav.estimation.solvers.linearise import Points


@dataclass(frozen=True)
class Decision:
    """What was decided at a keyframe by the estimate there: rows to hold from now on, and what is not to be trusted."""

    H: Array  # (m, D)
    residual: Array  # (m,)
    sigma: Array  # (m,)
    added: Array  # (D,) variance


Decide = Callable[[int, Points, Array], Decision | None]  # of a keyframe, the point there and P (D, D)


def hold(one: Decision | None, x: Any, P: Array, where: Any) -> tuple[Any, Array]:
    """An update with what was decided."""
    if one is None:
        return x, P
    P = P + np.diag(one.added)
    if not len(one.residual):
        return x, P
    PHt, R = P @ one.H.T, np.diag(one.sigma**2)
    K = np.linalg.solve(one.H @ PHt + R, PHt.T).T
    M = np.eye(len(P)) - K @ one.H
    P = M @ P @ M.T + K @ R @ K.T
    P, d = 0.5 * (P + P.T), -(K @ one.residual)
    if isinstance(x, np.ndarray):
        return x + d, P
    to = where.plus(x, d)
    return to, where.carry(P, x, to)
