"""Application of a noise model to a problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from graphnav.constraints.base import SAME_TIME, Constraint
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, RowWeights
from graphnav.estimation.noise.spans import mask_times
from graphnav.estimation.problem import Problem
from graphnav.imu.dynamics import PRIORS
from graphnav.imu.preintegration import NOISE_FIGURES


def apply_noise(problem: Problem, noise: NoiseModel) -> Problem:
    """A problem built with stated noise, with a noise model's figures instead.

    Parameters
    ----------
    problem : as built; its intervals keep the parts of their covariances if a figure of the IMU differs.
    """
    factors = np.array([noise.get_factor(f"imu.{name}", 1.0) for name in NOISE_FIGURES])
    each = _compute_interval_factors(problem, noise)
    if each is not None or np.any(factors != 1.0):
        intervals = problem.intervals.with_noise(factors if each is None else factors * each)
        figures = {
            name: float(np.sqrt(f)) * getattr(problem.imu_noise, name)
            for name, f in zip(NOISE_FIGURES, factors, strict=True)
        }
        problem = replace(
            problem,
            intervals=intervals,
            motion=problem.motion.replace_noise(intervals),
            imu_noise=replace(problem.imu_noise, **figures),
            interval_factors=each,
        )
    scales = {
        figure: float(np.sqrt(noise.get_factor(group, 1.0))) * getattr(problem.imu_noise, figure)
        for group, figure in PRIORS.items()
    }
    return replace(
        problem,
        imu_noise=replace(problem.imu_noise, **scales),
        constraints=_share_nodes([_scale_rows(problem, rows, noise) for rows in problem.constraints]),
    )


def apply_weights(problem: Problem, weights: Mapping[str, RowWeights]) -> Problem:
    """A problem as a noise model has it, with other weights for the rows of some constraints."""
    noise = NoiseModel(weights=weights)
    return replace(
        problem,
        constraints=tuple(
            replace(c, weight=select_weights(problem.t[c.keyframe], noise, c.name)) if c.name in weights else c
            for c in problem.constraints
        ),
    )


def _compute_interval_factors(problem: Problem, noise: NoiseModel) -> Array | None:
    """(K-1, 4) on the variances of `NOISE_FIGURES`, where single intervals have more noise than usual."""
    if not any(name in noise.weights for name in INTERVALS):
        return None
    factors = np.ones((len(problem.t) - 1, len(NOISE_FIGURES)))
    for i, name in enumerate(INTERVALS):
        factors[:, i] = 1.0 / select_weights(problem.t[1:], noise, name)
    return factors if np.any(factors != 1.0) else None


def _share_nodes(constraints: list[Constraint]) -> tuple[Constraint, ...]:
    """The same, with nodes at the same times for all processes that rows depend on: one variable of the graph."""
    closest: dict[str, float] = {}
    for _ in range(2):  # through what two constraints share
        for rows in constraints:
            some = [p for p in rows.parameters if p.begins is None and not p.constant]
            least = min((closest.get(p.name, p.spacing) for p in some), default=np.inf)
            closest |= {p.name: least for p in some}

    def share(rows: Constraint) -> Constraint:
        if all(closest.get(p.name, p.spacing) == p.spacing for p in rows.parameters):
            return rows  # as the rows of a keyframe mostly are, of which a copy takes as long as all else here
        return replace(
            rows, parameters=tuple(replace(p, spacing=closest.get(p.name, p.spacing)) for p in rows.parameters)
        )

    return tuple(share(rows) for rows in constraints)


def _scale_rows(problem: Problem, rows: Constraint, noise: NoiseModel) -> Constraint:
    own = tuple(_scale_process(p, noise, 1.0) for p in rows.parameters)
    errors = tuple(_scale_process(p, noise, 0.0) for p in rows.processes)
    changed: dict[str, Any] = {"parameters": tuple(p for p in (*own, *errors) if p is not None)}
    names, index = rows.list_noise_groups()
    if names:
        root = np.sqrt([noise.get_factor(name, 1.0) for name in names])
        changed["sigma"] = _scale_sigma(rows, np.where(index >= 0, root[index], 1.0))
    if rows.name in noise.weights or rows.name in noise.excluded:
        changed["weight"] = select_weights(problem.t[rows.keyframe], noise, rows.name)
    return replace(rows, **changed)


def _scale_sigma(rows: Constraint, root: Array) -> Array:
    """(N, m) sigmas times the roots of variance factors, but for the part that has none."""
    sigma: Array = rows.sigma  # type: ignore[attr-defined]
    if rows.unscaled is None:
        return sigma * root
    return np.sqrt((sigma**2 - rows.unscaled**2) * root**2 + rows.unscaled**2)


def _scale_process(p: Parameter, noise: NoiseModel, missing: float) -> Parameter | None:
    """A parameter with its factors; None for a process that does not exist."""
    if not p.noise_groups:
        return p
    factors = np.array([noise.get_factor(group, missing) for group in p.noise_groups])
    if not factors.any():
        return None
    sigma = p.sigma * np.sqrt(np.maximum(factors, 1e-12))
    return replace(p, sigma=sigma, correlation_time=noise.times.get(p.name, p.correlation_time))


def select_weights(t: Array, noise: NoiseModel, name: str) -> Array:
    """(N,) weights of a constraint's rows at times t (N,), s; rows of one time, as of satellites, keep their order."""
    out = np.ones(len(t))
    some = noise.weights.get(name)
    if some is not None and len(some.t):
        number = np.arange(len(t)) - np.searchsorted(t, t - SAME_TIME)  # index among the rows of its time
        at = np.clip(np.searchsorted(some.t, t - SAME_TIME) + number, 0, len(some.t) - 1)
        same = np.abs(some.t[at] - t) <= SAME_TIME
        out[same] = some.weight[at[same]]
    out[mask_times(t, noise.excluded.get(name, ()))] = 0.0
    for begin, end, weight in noise.span_weights.get(name, ()):
        out[mask_times(t, [(begin, end)])] = weight
    return out


def are_of_others(problem: Problem, noise: NoiseModel) -> bool:
    """Whether a noise model has weights, and none of them at a row of this problem: those of another recording."""
    weights = {name: some for name, some in noise.weights.items() if name in noise.tails and len(some.t)}
    alone = NoiseModel(weights=weights)
    rows = [(c.name, problem.t[c.keyframe]) for c in problem.constraints if c.name in weights]
    return bool(weights) and not any(np.any(select_weights(t, alone, name) < 1.0) for name, t in rows)


def drop_parts(problem: Problem) -> Problem:
    """The same without the contributions of each noise figure, which take memory and are no longer needed."""
    intervals = problem.intervals.without_parts()
    return replace(problem, intervals=intervals, motion=problem.motion.replace_noise(intervals))
