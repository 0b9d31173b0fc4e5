"""Variance components while they are estimated: their factors, priors and steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.constraints.lasting import LASTING
from graphnav.estimation.noise.model import NoiseModel, RowWeights, VarianceComponent
from graphnav.estimation.noise.priors import get_prior, list_largest
from graphnav.estimation.problem import Problem
from graphnav.imu.dynamics import PRIORS
from graphnav.imu.preintegration import NOISE_FIGURES


@dataclass
class Components:
    """The figures of one pass of an estimate, which the next one changes."""

    log: dict[str, float]
    prior_times: dict[str, float]  # s, prior medians of correlation times
    largest: dict[str, float]  # log factors at which an error is as large as such errors get
    freedom: dict[str, float] = field(default_factory=dict)  # redundancy B of each
    sigmas: dict[str, float] = field(default_factory=dict)  # of their logarithms, once they have converged
    times: dict[str, float] = field(default_factory=dict)
    weights: dict[str, RowWeights] = field(default_factory=dict)
    excluded: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    tails: dict[str, float] = field(default_factory=dict)
    steps: dict[str, float] = field(default_factory=dict)  # the latest of each, before extrapolation
    extrapolation: float = 1.0  # longest step allowed, in steps as computed
    known: bool = False  # whether they were estimated before
    same_data: bool = False  # and from the same measurements

    def copy(self) -> Components:
        """An independent copy."""
        times, weights, tails, steps = dict(self.times), dict(self.weights), dict(self.tails), dict(self.steps)
        log, freedom = dict(self.log), dict(self.freedom)
        return replace(self, log=log, freedom=freedom, times=times, weights=weights, tails=tails, steps=steps)

    def build_model(self) -> NoiseModel:
        """The noise model with these figures."""
        figures = {}
        for name, x in self.log.items():
            m, s = self.get_prior(name)
            sigma = self.sigmas.get(name, s)
            figures[name] = VarianceComponent(x, sigma, m, s, max(2.0 * (sigma**-2.0 - s**-2.0), 0.0))
        return NoiseModel(figures, dict(self.times), dict(self.weights), self.excluded, tails=dict(self.tails))

    def get_prior(self, name: str) -> tuple[float, float]:
        """Median and 1-sigma of a log factor; where the white part of fixes exceeds the stated, so do the others."""
        m, s = get_prior(name)
        sensor, *kind, axis = name.split(".")
        if sensor == "gnss_position" and kind and kind[-1] in LASTING:
            m += max(0.0, self.log.get(".".join([sensor, *kind[:-1], axis]), 0.0))
        return m, s

    def get_largest(self, name: str) -> float:
        """The largest log factor; of the time-correlated parts of fixes, that of the white part."""
        sensor, *kind, axis = name.split(".")
        white = ".".join([sensor, *(part for part in kind if part not in LASTING), axis])
        return self.largest.get(white, np.inf)

    def log_prior(self) -> float:
        """The logarithm of their prior, up to a constant."""
        return -0.5 * sum(((x - m) / s) ** 2 for name, x in self.log.items() for m, s in [self.get_prior(name)])

    def doubt_wheels(self, problem: Problem) -> None:
        """Begin with what rests on wheels that do not slip as bad as its prior's 1-sigma makes it.

        A constraint that is too tight bends the trajectory, and other sensors come out too noisy, from where no step
        leads back; one that is too loose shows how well it holds.
        """
        for rows in problem.constraints:
            if rows.of_wheels:
                own = rows.list_noise_groups()[0], *(p.noise_groups for p in rows.processes)
                for name in {name for groups in own for name in groups}:
                    self.log[name] += get_prior(name)[1]

    def update(self, name: str, A: float, B: float) -> None:
        """One step of a component with sum of squares A and redundancy B."""
        m, s = self.get_prior(name)
        x, before = 0.0, self.log[name]
        for _ in range(50):
            slope = 0.5 * (A * np.exp(-x) - B) - (before + x - m) / s**2
            step = float(np.clip(slope / (0.5 * A * np.exp(-x) + s**-2.0), -1.0, 1.0))
            x += step
            if abs(step) < 1e-6:
                break
        x = float(np.clip(x, -3.0, 3.0))
        # correlated components converge slowly, by steps in geometric progression: go to the limit of their sum
        ratio = x / self.steps[name] if self.steps.get(name) else 0.0
        self.steps[name] = x
        if 0.0 < ratio < 1.0 and self.extrapolation > 1.0:
            x = float(np.clip(x * min(1.0 / (1.0 - ratio), self.extrapolation), -3.0, 3.0))
        self.log[name], self.freedom[name] = min(before + x, self.get_largest(name)), B


def begin_components(
    problem: Problem, start: NoiseModel | None, changed: bool = False, scales: bool = False
) -> Components:
    """The figures that an estimate begins with: prior medians, or those of another estimate.

    Parameters
    ----------
    problem : with stated noise.
    start, changed, scales : as for `graphnav.estimation.noise.estimate.estimate_noise`.
    """
    names = [f"imu.{name}" for name in NOISE_FIGURES]
    for rows in problem.constraints:
        names += [
            *rows.list_noise_groups()[0],
            *(g for p in (*rows.parameters, *rows.processes) for g in p.noise_groups),
        ]
    names += [group for p in problem.parameters.values() for group in p.noise_groups]
    known = {} if start is None else start.figures
    log = {name: get_prior(name)[0] for name in dict.fromkeys(names) if scales or name not in PRIORS or name in known}
    processes = [p for rows in problem.constraints for p in (*rows.parameters, *rows.processes)]
    times = {p.name: p.correlation_time for p in processes if p.correlation_time is not None}
    largest = {group: x for rows in problem.constraints if rows.fix_of for group, x in list_largest(rows).items()}
    if start is None:
        return Components(log, times, largest)
    log |= {name: start.figures[name].log_factor for name in log if name in start.figures}
    return Components(
        log,
        times,
        largest,
        times=dict(start.times),
        weights=dict(start.weights),
        tails=dict(start.tails),
        excluded=start.excluded,
        known=bool(start.figures),
        same_data=bool(start.figures) and not changed,
    )
