"""How noisy fixes really are, as a drive goes on: the factors of `graphnav.solvers.adaptive`, told from the window.

A keyframe's message has its fix in it already, so its innovation is had from what the fix has left: with the rows
H y = b whitened, P what is known with the fix and e = H y - b its residual,

    S = (I - H P H^T)^-1     nu = -S e     S - I    the state's part in it

A fix that is not used has left nothing: its rows are made for this alone.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace

import numpy as np

from graphnav.constraints.base import SAME_TIME, Constraint
from graphnav.problem import Problem
from graphnav.rotation import Array
from graphnav.solvers.adaptive import WINDOW, Kind
from graphnav.solvers.stages import Place, Stage, measured

_SAME = 0.05  # of a factor


class Noise:
    """Factors on the variances of fixes, by their times; those of fixes taken back are decided again."""

    def __init__(self) -> None:
        self._kinds: dict[str, Kind] = {}
        self._times: dict[str, list[float]] = {}

    def weights(self, rows: Constraint, t: Array) -> Array:
        """(n,) of fixes at times t, ascending; of one that is new, that of the one before it."""
        kind, times = self._kinds.get(rows.name), self._times.get(rows.name, [])
        if kind is None or not times:
            return np.ones(len(t))
        at = np.minimum(np.searchsorted(times, t - SAME_TIME), len(times) - 1)
        return 1.0 / kind.factor[at]

    def hear(self, problem: Problem, stage: Stage) -> bool:
        """Take in the fixes of a stage; True if it should be made again with other weights.

        `problem` has the stage's rows as they entered it.
        """
        again, k, t = False, stage.place.k, stage.place.t
        for rows in problem.constraints:
            if rows.adaptive == "off":
                continue
            lo, hi = rows.keyframe.searchsorted((k, k + 1))
            if hi - lo != 1:
                continue
            weight = 1.0 if rows.weight is None else float(rows.weight[lo])
            found = _unused(problem, rows, stage) if weight == 0.0 else _innovation(rows.name, stage)
            if found is None:
                continue
            r, predicted, sigma = found
            f = self._add(rows, t, r, predicted, sigma * np.sqrt(weight or 1.0), weight)
            again |= weight > 0.0 and abs(f * weight - 1.0) > _SAME
        return again

    def forget(self, t: float) -> None:
        """What is so long before a time that no later fix asks for it."""
        for name, times in self._times.items():
            count = bisect_left(times, t) - WINDOW - 2
            if count > WINDOW:
                self._kinds[name].forget(count)
                del times[:count]

    def _add(self, rows: Constraint, t: float, r: Array, predicted: Array, sigma: Array, weight: float) -> float:
        if rows.name not in self._kinds:
            self._kinds[rows.name], self._times[rows.name] = Kind(rows), []
        kind, times = self._kinds[rows.name], self._times[rows.name]
        row = bisect_left(times, t - SAME_TIME)
        times[row:] = [t]
        f = kind.add(row, r, predicted, sigma)
        if weight > 0.0 and abs(f * weight - 1.0) <= _SAME:
            f = kind.factor[row] = 1.0 / weight
        return f


def _innovation(name: str, stage: Stage) -> tuple[Array, Array, Array] | None:
    """Innovation (m,), the variance of the state's part in it, and the sigma it was used with; None without rows."""
    one = next((one for one in stage.measured if one.name == name), None)
    if one is None:
        return None
    H, b, sigma = (x[0] for x in one.weighted(np.asarray(stage.way), 1))
    left = H @ stage.way - b
    S = np.linalg.inv(np.eye(len(b)) - _known(H, stage))
    return -(S @ left) * sigma, np.maximum(np.diagonal(S) - 1.0, 0.0) * sigma**2, one.sigma[0]


def _unused(problem: Problem, rows: Constraint, stage: Stage) -> tuple[Array, Array, Array] | None:
    """The same of a fix that is not used."""
    alone = replace(problem, constraints=(replace(rows, weight=None),))
    message = stage.message
    place = Place(stage.place.t, alone, stage.place.k)
    found = measured(place, message.state, message.values, message.columns).measured
    if not found:
        return None
    one = found[0]
    return one.b[0] * one.sigma[0], np.diagonal(_known(one.H[0], stage)) * one.sigma[0] ** 2, one.sigma[0]


def _known(H: Array, stage: Stage) -> Array:
    """H P H^T"""
    root = np.linalg.solve(stage.message.R.T, H.T)
    return np.asarray(root.T @ root)
