"""Wheels and the receiver's velocities against a smoothed trajectory, by what their errors add up to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from graphnav.constraints.base import assemble, weighted_sigma
from graphnav.constraints.gnss import GnssVelocity
from graphnav.constraints.vehicle import NonHolonomic, OdometerSpeed
from graphnav.judgement.chance import FEWEST, MOST_RAISED, SIGNIFICANT, scatter, trimmed
from graphnav.judgement.residuals import values_at
from graphnav.problem import Problem
from graphnav.rotation import Array
from graphnav.solvers.passes import Smoothed

Speed = NonHolonomic | OdometerSpeed | GnssVelocity
BLOCK = 10.0  # s
_WHEELS = (NonHolonomic, OdometerSpeed)


def judge_speeds(problem: Problem, smoothed: Smoothed) -> tuple[Problem, tuple[str, ...]]:
    """The problem with the sigmas of wheels and of the receiver's velocities raised as residuals ask, and sentences.

    What matters is what errors add up to: camber, wind and load push a vehicle aside for many seconds, and reflections
    last. So the sums of whitened residuals over `BLOCK` s are judged, against what white noise of the sigmas used would
    sum up to.
    """
    raised: dict[str, Speed] = {}
    notes = []
    for rows, axis, squared in _sums(problem, smoothed, (*_WHEELS, GnssVelocity)):
        factor = np.ones(len(rows.axes))
        factor[axis] = raised_by(squared)
        if factor[axis] > 1.0:
            name = rows.axes[axis]
            notes.append(f"{rows.name}, {name}: its sigma was multiplied by {factor[axis]:.1f}, as residuals ask")
            before = raised.get(rows.name, rows)
            raised[rows.name] = replace(before, sigma=before.sigma * factor)
    return replace(problem, constraints=tuple(raised.get(c.name, c) for c in problem.constraints)), tuple(notes)


def raised_by(squared: Array) -> float:
    """Factor on a sigma that squared sums over blocks, against their variances, ask for; 1 where none is clear."""
    if len(squared) < FEWEST:
        return 1.0
    f = trimmed(squared)
    return min(float(np.sqrt(f)), MOST_RAISED) if np.log(f) > SIGNIFICANT * scatter(len(squared)) else 1.0


def contradiction(problem: Problem, smoothed: Smoothed) -> tuple[float, float]:
    """How much wheels contradict a smoothed solution, and how much of that may be chance.

    Logarithms of the variance factors that their sums of residuals ask for, added up.
    """
    seen = [x for *_, x in _sums(problem, smoothed, _WHEELS) if len(x) >= FEWEST]
    asked = sum(max(0.0, float(np.log(trimmed(x)))) for x in seen)
    return asked, sum(SIGNIFICANT * scatter(len(x)) for x in seen)


def _sums(problem: Problem, smoothed: Smoothed, kinds: tuple[type[Any], ...]) -> Iterator[tuple[Speed, int, Array]]:
    """Constraint, axis and squared sums over blocks against their variances."""
    for rows in problem.constraints:
        if not isinstance(rows, kinds) or len(rows) < FEWEST:
            continue
        at = rows.keyframe
        linear = rows.linearize(smoothed.states[at], values_at(problem, smoothed, rows), slice(None))
        H = assemble(linear, problem.columns, smoothed.P.shape[-1])
        used = np.ones(len(rows), dtype=bool) if rows.weight is None else rows.weight > 0.0
        sigma = weighted_sigma(rows, linear.sigma)
        left = sigma**2 - np.einsum("nij,njk,nik->ni", H, smoothed.P[at], H, optimize=True)
        usable = used & np.all(left > 0.2 * sigma**2, axis=1)
        block = np.unique(np.floor(problem.t[at[usable]] / BLOCK), return_inverse=True)[1]
        for axis in range(len(rows.axes)):
            weight = 1.0 / sigma[usable, axis] ** 2
            total = np.bincount(block, weight * linear.residual[usable, axis])
            variance = np.bincount(block, weight**2 * left[usable, axis])
            yield rows, axis, total**2 / variance
