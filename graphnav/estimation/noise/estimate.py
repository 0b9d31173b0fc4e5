"""All noise figures of a recording at once, by the likelihood of its innovations.

Maximum a posteriori: with L the innovation log-likelihood of the filter and a log-normal prior on every variance
factor, the estimate maximises L plus the logarithm of the priors. From pass to pass, filter and smoother linearised at
the points that the pass before left, every factor f with redundancy B and the sum of squares A
(`graphnav.estimation.noise.moments`) goes to the maximum over x = ln(f_new / f) of

    -(B x + A e^-x) / 2 - (ln f + x - m)^2 / (2 s^2)

the likelihood of A / f as a chi-square variable of B degrees of freedom, and the prior. Without a prior that is the
fixed point f <- f A / B of Foerstner (1979), Koch (1999, section 3.6) and MacKay (1992); no sensor is estimated before
another, so none is believed for having come first. What few rows say is bounded: squares that chance would leave once
in a thousand times have no more say than that (`CHANCE`), and a row, or what is wrong with wheels for seconds, has a
weight by which it would be that large.

The first passes see the first `_FIRST` keyframes only; the last ones see all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtrc, chdtri

from graphnav.constraints.base import Constraint
from graphnav.constraints.gnss import TIMES
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.estimation.noise.apply import row_weights, with_noise
from graphnav.estimation.noise.beginning import find_beginnings, smooth_about
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, RowWeights, VarianceComponent
from graphnav.estimation.noise.moments import ImuMoments, imu_moments, lag_moments, process_moments, row_moments
from graphnav.estimation.noise.outliers import CHANCE, cost_of_outliers, limit_scaled, list_reduced
from graphnav.estimation.noise.priors import TIME_WITHIN, prior
from graphnav.estimation.problem import ParameterChain, Problem
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import ForwardRecord, SmootherPass, points_of, values_of
from graphnav.imu.preintegration import NOISE_FIGURES

_USUAL = 0.05  # of the squares of an aiding sensor, that count for no more: nearly two in five may be wrong
_FIRST = 1500  # keyframes: figures told by a thousand numbers are good to a twentieth
_ROUNDS, _AGAIN = 8, 3  # passes, from priors and from figures that were estimated before
_MOST = 3 * _ROUNDS  # passes at most, as long as each gains what chance does not
_AHEAD = 2.0  # times its own length that a step is taken at most (Aitken's extrapolation)
_TIMES = 30.0  # by which a correlation time may be shorter or longer than usual
_LOST = 1.0, 10.0  # rad/s, m/s^2: what a vehicle turns and accelerates by, which is lost with an interval's samples
_GRID = np.linspace(-1.0, 1.0, 21)


@dataclass(frozen=True)
class NoiseEstimate:
    """A noise model, the points its last pass left, and how it came about."""

    noise: NoiseModel
    points: SmootherPass
    log_posterior: float
    log_prior: float
    passes: int  # of filter and smoother
    looks: int = 0  # passes of the filter alone, for measurements that are wrong

    @property
    def log_evidence(self) -> float:
        """Of the measurements, where each row and interval that has less weight than others is an outlier by chance."""
        return self.log_posterior + cost_of_outliers(self.noise.weights)


@dataclass
class _Components:
    """The figures as they are so far."""

    log: dict[str, float]
    usual_times: dict[str, float]  # s, correlation times to look about
    freedom: dict[str, float] = field(default_factory=dict)
    times: dict[str, float] = field(default_factory=dict)
    weights: dict[str, RowWeights] = field(default_factory=dict)
    excluded: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    steps: dict[str, float] = field(default_factory=dict)  # the latest of each, as it was found
    ahead: float = 1.0  # times its own length that a step is taken at most
    known: bool = False  # whether they were estimated before
    same_data: bool = False  # and of the same measurements

    def copy(self) -> _Components:
        """The same, on its own."""
        times, weights, steps = dict(self.times), dict(self.weights), dict(self.steps)
        return replace(self, log=dict(self.log), freedom=dict(self.freedom), times=times, weights=weights, steps=steps)

    def model(self) -> NoiseModel:
        figures = {}
        for name, x in self.log.items():
            m, s = self.prior(name)
            B = self.freedom.get(name, 0.0)
            figures[name] = VarianceComponent(x, float((0.5 * B + s**-2.0) ** -0.5), m, s, B)
        return NoiseModel(figures, dict(self.times), dict(self.weights), self.excluded)

    def prior(self, name: str) -> tuple[float, float]:
        """Median and 1-sigma of a log factor; fixes that scatter more than stated are worse in what lasts as well."""
        m, s = prior(name)
        sensor, *kind, axis = name.split(".")
        if sensor == "gnss_position" and kind and kind[-1] in TIMES:
            m += max(0.0, self.log.get(".".join([sensor, *kind[:-1], axis]), 0.0))
        return m, s

    def log_prior(self) -> float:
        return -0.5 * sum(((x - m) / s) ** 2 for name, x in self.log.items() for m, s in [self.prior(name)])

    def update(self, name: str, A: float, B: float) -> None:
        """One component, by its squares and its redundancy."""
        m, s = self.prior(name)
        x, before = 0.0, self.log[name]
        for _ in range(50):
            slope = 0.5 * (A * np.exp(-x) - B) - (before + x - m) / s**2
            step = float(np.clip(slope / (0.5 * A * np.exp(-x) + s**-2.0), -1.0, 1.0))
            x += step
            if abs(step) < 1e-6:
                break
        x = float(np.clip(x, -3.0, 3.0))
        # components that trade with each other creep: what the steps, each a share of the one before, will add up to
        ratio = x / self.steps[name] if self.steps.get(name) else 0.0
        self.steps[name] = x
        if 0.0 < ratio < 1.0 and self.ahead > 1.0:
            x = float(np.clip(x * min(1.0 / (1.0 - ratio), self.ahead), -3.0, 3.0))
        self.log[name], self.freedom[name] = before + x, B


def estimate_noise(
    problem: Problem,
    opening: float | None = None,
    start: NoiseModel | None = None,
    near: tuple[Points, Problem] | None = None,
    progress: Callable[[str, float], None] | None = None,
    intervals: bool = False,
    changed: bool = False,
) -> NoiseEstimate:
    """Estimate the noise model of a problem posed with stated noise and with the parts of its intervals' noise.

    Parameters
    ----------
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.
    start : figures to set out from, weights of rows, and what is left out; prior medians when None.
    near : points of all keyframes to linearise at first, and the problem that they are of.
    intervals : single intervals of the IMU may have more noise than the others.
    changed : the figures to set out from were estimated with other measurements left out, and may have far to go.

    Raises
    ------
    EstimationError
        If the filter breaks down.
    """
    figures = _begin(problem, start, changed)
    if near is not None:
        return _iterate(problem, figures, _carry(*near, with_noise(problem, figures.model())), progress, intervals)
    (tried, passes), found = find_beginnings(with_noise(problem, figures.model()), opening), list[NoiseEstimate]()
    for about, weights in tried:
        figures = _begin(problem, start)
        figures.weights |= weights
        try:
            found.append(_iterate(problem, figures, about, progress, intervals))
        except EstimationError:  # from there nothing leads anywhere
            if about is tried[-1][0] and not found:
                raise
    best = max(found, key=lambda one: one.log_evidence)
    return replace(best, passes=passes + sum(one.passes for one in found))


def _iterate(
    problem: Problem,
    figures: _Components,
    about: Points,
    progress: Callable[[str, float], None] | None,
    intervals: bool,
) -> NoiseEstimate:
    """The estimate from figures, and points to linearise at, on."""
    passes, total, converged = 0, len(problem.t), False
    ends = [total] if total <= 2 * _FIRST or figures.known else [_FIRST, total]
    latest: tuple[ForwardRecord, SmootherPass] | None = None
    for end in ends:
        before, converged, figures.ahead = -np.inf, False, 1.0
        rounds = _AGAIN if figures.same_data or end != ends[0] else _ROUNDS
        likeliest, most = figures, -np.inf
        for k in range(_MOST):
            used, latest = with_noise(problem, figures.model()), None  # the pass before takes as much memory as this
            latest = smooth_about(used, about.first(end))
            passes += 1
            prior_then = figures.log_prior()
            now = float(np.sum(latest[0].log_likelihood)) + prior_then
            if progress is not None:
                progress("noise", min((k + 1) / rounds, 1.0))
            if (evidence := now + cost_of_outliers(figures.weights)) > most:
                likeliest, most = figures.copy(), evidence
            _improve(figures, used, *latest, end, intervals)
            about = _splice(about, latest[1])
            # chance makes each figure gain a half; with one sensor far off it takes many passes to see which
            converged = k > 1 and abs(now - before) < (0.05 if k + 1 < rounds else 0.5) * len(figures.log)
            if converged:
                break
            before, figures.ahead = now, _AHEAD if k > 1 and now > before else 1.0
        if not converged:  # figures that go to and fro, or are still on their way: the likeliest of them
            figures = likeliest
    if not converged:
        latest = None
        latest = smooth_about(with_noise(problem, figures.model()), about)
        passes, prior_then = passes + 1, figures.log_prior()
        now = float(np.sum(latest[0].log_likelihood)) + prior_then
    assert latest is not None
    return NoiseEstimate(figures.model(), latest[1], now, prior_then, passes)


def _begin(problem: Problem, start: NoiseModel | None, changed: bool = False) -> _Components:
    names = [f"imu.{name}" for name in NOISE_FIGURES]
    for rows in problem.constraints:
        names += [*rows.noise_groups()[0], *(g for p in (*rows.parameters, *rows.processes) for g in p.noise_groups)]
    names += [group for p in problem.parameters.values() for group in p.noise_groups]
    log = {name: prior(name)[0] for name in dict.fromkeys(names)}
    processes = [p for rows in problem.constraints for p in (*rows.parameters, *rows.processes)]
    times = {p.name: p.correlation_time for p in processes if p.correlation_time is not None}
    if start is None:
        return _Components(log, times)
    log |= {name: start.figures[name].log_factor for name in log if name in start.figures}
    return _Components(
        log,
        times,
        times=dict(start.times),
        weights=dict(start.weights),
        excluded=start.excluded,
        known=bool(start.figures),
        same_data=bool(start.figures) and not changed,
    )


def _carry(points: Points, before: Problem, after: Problem) -> Points:
    return points_of(after, points.states, values_of(before, points))


def _splice(about: Points, part: Points) -> Points:
    """Points with the first of them replaced."""
    n = len(part.values)
    if n == len(about.values):
        return Points(part.states, part.values)
    states = type(part.states).stack([part.states, about.states[n:]])
    return Points(states, np.concatenate([part.values, about.values[n:]]))


def _cap(A: Array, B: Array, freedom: int, chance: float) -> tuple[float, float]:
    """Sums of squares and of redundancies; no square counts for more than chance allows, made up for in the mean.

    For z^2 chi-square with m degrees of freedom and the limit q, E[min(z^2, q)] = m P(chi2_m+2 < q) + q P(chi2_m > q).
    """
    most = float(chdtri(freedom, chance))
    mean = freedom * (1.0 - float(chdtrc(freedom + 2, most))) + most * chance
    return float(np.sum(np.minimum(A, most / freedom * B))) * freedom / mean, float(np.sum(B))


def _improve(
    figures: _Components, problem: Problem, forward: ForwardRecord, smoothed: SmootherPass, end: int, intervals: bool
) -> None:
    """One step for all figures and weights."""
    imu = imu_moments(problem, forward, smoothed)
    for i, name in enumerate(NOISE_FIGURES):
        figures.update(f"imu.{name}", *_cap(imu.A[:, i], imu.B[:, i], 3, CHANCE))
    if intervals:
        _weigh_intervals(figures, problem, imu)
    driven: dict[str, tuple[Array, Array, Array]] = {}
    for chain in problem.chains:
        if chain.parameter.noise_groups:
            driven[chain.parameter.name] = process_moments(problem, chain, smoothed, end)
            _improve_process(figures, chain, driven[chain.parameter.name])
            told = _is_observed(figures, chain)
            if chain.parameter.correlation_time is not None and told.any():
                _improve_time(figures, chain, told, lag_moments(problem, chain, forward, smoothed, end))
    for rows in problem.constraints:
        names, index = rows.noise_groups()
        if not names:
            continue
        n = int(np.searchsorted(rows.keyframe, end))
        found = row_moments(problem, rows, smoothed, n)
        for i, name in enumerate(names):
            own = index[:n] == i
            if own.any():
                figures.update(name, *_cap(found.A[own], found.B[own], 1, _USUAL))
        _weigh(figures, problem, rows, np.maximum(found.left_out, found.whole), n)


def _weigh_intervals(figures: _Components, problem: Problem, imu: ImuMoments) -> None:
    """More noise for the intervals whose disturbance is larger than chance allows: until it is as likely as that."""
    t, n = problem.t[1:], len(imu.A)
    densities = problem.imu_noise.gyro_noise_density, problem.imu_noise.accel_noise_density
    for i, (name, density, lost) in enumerate(zip(INTERVALS, densities, _LOST, strict=True)):
        freedom = imu.freedom[:, i]
        ratio = imu.A[:, i] / np.maximum(imu.B[:, i], 1e-30) * freedom
        # what half of the intervals do is no outlier: the figures have not come to what they are yet
        usual = max(float(np.median(ratio / chdtri(freedom, 0.5))), 1.0)
        more = 1.0 / row_weights(t, figures.model(), name)
        most = np.maximum(lost**2 * problem.intervals.T[:n] / density**2, 1.0)
        more[:n] = np.clip(more[:n] * ratio / chdtri(freedom, CHANCE) / usual, 1.0, most)
        some = more > 1.0
        figures.weights[name] = RowWeights(t[some], 1.0 / more[some])


def _improve_process(figures: _Components, chain: ParameterChain, moments: tuple[Array, Array, Array]) -> None:
    _, A, B = moments
    groups = np.array(chain.parameter.noise_groups)
    for group in dict.fromkeys(chain.parameter.noise_groups):
        own = groups == group
        figures.update(group, *_cap(A[:, own], B[:, own], 1, _USUAL))


def _is_observed(figures: _Components, chain: ParameterChain) -> Array:
    """(k,) whether the data say anything of each number of a process."""
    return np.array([figures.freedom.get(group, 0.0) > 1.0 for group in chain.parameter.noise_groups])


def _improve_time(figures: _Components, chain: ParameterChain, told: Array, lags: tuple[Array, ...]) -> None:
    """The correlation time by expectation and maximisation, on a grid, with a log-normal prior about what it was.

    `told` (k,) of its numbers are used.
    """
    dt, later, cross, before = lags
    p = chain.parameter
    assert p.correlation_time is not None
    if not len(dt):
        return
    times = p.correlation_time * np.exp(_GRID)
    a = np.exp(-dt[:, None] / times)[..., None]
    q = (1.0 - a * a) * chain.sigma[0] ** 2
    squares = later[:, None] - 2.0 * a * cross[:, None] + a * a * before[:, None]
    value = -0.5 * np.sum((np.log(q) + squares / q)[..., told], axis=(0, 2))
    usual = figures.usual_times[p.name]
    value -= 0.5 * (np.log(times / usual) / TIME_WITHIN) ** 2
    j = int(np.clip(np.argmax(value), 1, len(_GRID) - 2))
    low, here, high = value[j - 1 : j + 2]
    bend = low - 2.0 * here + high
    off = 0.5 * (low - high) / bend if bend < 0.0 else 0.0
    found = p.correlation_time * np.exp(_GRID[j] + (_GRID[1] - _GRID[0]) * np.clip(off, -1.0, 1.0))
    figures.times[p.name] = float(np.clip(found, usual / _TIMES, usual * _TIMES))


def _weigh(figures: _Components, problem: Problem, rows: Constraint, squared: Array, n: int) -> None:
    """Weights of the first n rows by their squared errors (n,): of their own, and of the whole with what lasts."""
    before = np.ones(len(rows)) if rows.weight is None else rows.weight
    used = before > 0.0
    weight = np.concatenate([limit_scaled(squared, len(rows.axes), used[:n]), before[n:]])  # later ones as they were
    figures.weights[rows.name] = list_reduced(problem.t[rows.keyframe], weight, used)
