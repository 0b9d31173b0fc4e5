"""Variance components while they are estimated: their factors, priors and steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.constraints.lasting import LASTING
from graphnav.core.rotation import Array
from graphnav.estimation.noise.model import NoiseModel, RowWeights, VarianceComponent
from graphnav.estimation.noise.priors import get_prior, list_largest
from graphnav.estimation.problem import Problem
from graphnav.imu.dynamics import PRIORS
from graphnav.imu.preintegration import NOISE_FIGURES

_LONGEST = 3.0  # longest step of a logarithm


@dataclass(frozen=True)
class Squares:
    """Sums over all that a component scales."""

    A: float = 0.0  # of squares
    B: float = 0.0  # of redundancies
    T: float = 0.0  # of their squares: tr (P V)^2 of disturbances that are independent

    def __add__(self, other: Squares) -> Squares:
        return Squares(self.A + other.A, self.B + other.B, self.T + other.T)


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
    known: bool = False  # whether they were estimated before

    def copy(self) -> Components:
        """An independent copy."""
        times, weights, tails = dict(self.times), dict(self.weights), dict(self.tails)
        return replace(self, log=dict(self.log), freedom=dict(self.freedom), times=times, weights=weights, tails=tails)

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
        white = _get_white(name) if name.startswith("gnss_position.") else name
        return (m if white == name else m + max(0.0, self.log.get(white, 0.0))), s

    def get_largest(self, name: str) -> float:
        """The largest log factor; of the time-correlated parts of fixes, that of the white part."""
        return self.largest.get(_get_white(name), np.inf)

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

    def improve(self, squares: Mapping[str, Squares], information: Array, tails: Array) -> float:
        """One step of all components, and the gain in log posterior that is expected of it.

        Parameters
        ----------
        squares : by component.
        information : (J, J) of the measurements, in the order of the components.
        tails : (J, J) by which it is less, as the weights of rows follow.

        Notes
        -----
        A Newton step. Where a component is all of the noise of its rows, the average information AI is -d2L / dx2;
        where it is a small part, AI is nearly 0 and -d2L / dx2 is -dL / dx. With T for tr (P V)^2, either is
        2 AI - dL / dx - T / 2. Far from the optimum the step of a component by itself is the longer one.
        """
        x = np.array(list(self.log.values()))
        A, B, T = np.array([(one.A, one.B, one.T) for one in (squares.get(name, Squares()) for name in self.log)]).T
        slope, (pull, prior) = 0.5 * (A - B), self._differentiate_prior()
        known = np.diagonal(information)
        curved = information + prior + np.diag(np.maximum(known - slope - 0.5 * T, 0.0))
        if np.linalg.eigvalsh(curved - tails)[0] > 0.0:
            curved -= tails
        step = np.linalg.solve(curved, slope + pull)
        gain = 0.5 * float((slope + pull) @ step)
        step = np.where(step > 0.0, np.log1p(np.maximum(step, 0.0)), step)  # linear in the factor
        own = _step_each(A, B, pull, np.diagonal(prior))
        step = np.where((own * step > 0.0) & (np.abs(own) > np.abs(step)), own, step)
        for name, new, freedom in zip(self.log, x + np.clip(step, -_LONGEST, _LONGEST), B, strict=True):
            self.log[name], self.freedom[name] = min(float(new), self.get_largest(name)), float(freedom)
        return gain

    def _differentiate_prior(self) -> tuple[Array, Array]:
        """Gradient (J,) and minus the Hessian (J, J) of the logarithm of the prior."""
        place = {name: j for j, name in enumerate(self.log)}
        off, weight, L = np.empty(len(place)), np.empty(len(place)), np.eye(len(place))
        for name, j in place.items():
            m, s = self.get_prior(name)
            off[j], weight[j] = self.log[name] - m, s**-2.0
            if m != get_prior(name)[0]:  # it goes with the white part
                L[j, place[_get_white(name)]] = -1.0
        return -L.T @ (weight * off), L.T @ (weight[:, None] * L)

    def compute_sigmas(self, information: Array) -> dict[str, float]:
        """1-sigma of every logarithm, whatever the others are, by the information (J, J) of the measurements."""
        covariance = np.linalg.inv(information + self._differentiate_prior()[1])
        return dict(zip(self.log, np.sqrt(np.diagonal(covariance)).tolist(), strict=True))


def _get_white(name: str) -> str:
    """The white part of the fixes that a component is a lasting part of; the component itself if it is none."""
    sensor, *kind, axis = name.split(".")
    return ".".join([sensor, *(part for part in kind if part not in LASTING), axis])


def _step_each(A: Array, B: Array, pull: Array, stiffness: Array) -> Array:
    """Steps x (J,) to the maximum of -(B x + A e^-x) / 2 and the prior, each with the other components as they are."""
    x = np.zeros(len(A))
    for _ in range(50):
        scaled = 0.5 * A * np.exp(-x)
        step = np.clip((scaled - 0.5 * B + pull - stiffness * x) / (scaled + stiffness), -1.0, 1.0)
        x += step
        if np.max(np.abs(step), initial=0.0) < 1e-6:
            break
    return x


def begin_components(problem: Problem, start: NoiseModel | None, scales: bool = False) -> Components:
    """The figures that an estimate begins with: prior medians, or those of another estimate.

    Parameters
    ----------
    problem : with stated noise.
    start, scales : as for `graphnav.estimation.noise.estimate.estimate_noise`.
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
    )
