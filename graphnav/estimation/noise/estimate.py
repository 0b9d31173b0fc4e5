"""All noise figures of a recording at once, by the likelihood of its innovations.

Maximum a posteriori: with L the innovation log-likelihood of the filter and a log-normal prior on every variance
factor, the estimate maximises L plus the logarithm of the priors. In each pass, filter and smoother linearised at the
points that the pass before left give every factor's redundancy B and sum of squares A
(`graphnav.estimation.noise.moments`), the gradient (A - B) / 2, and the average information of all
(`graphnav.estimation.noise.information`): a Newton step of all of them together
(`graphnav.estimation.noise.components`), so that no sensor is favoured by the order. Without a prior, the step of one
factor by itself is the fixed point f <- f A / B of Foerstner (1979), Koch (1999, section 3.6) and MacKay (1992).
Squares of rows have the weights of their tails, whose index is estimated in the same pass
(`graphnav.estimation.noise.tails`); of the IMU and of processes, a square counts for no more than the value that it
exceeds once in a thousand times (`CHANCE`). The correlation time of a process is a step of expectation-maximisation
apart, at the driving noise that the data determine best. Where a pass has less evidence than one before, the next step
is half as long: weights and figures may alternate between two states. The first passes of a long drive use its first
`_FIRST_KEYFRAMES` keyframes only.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from graphnav.constraints.base import Constraint
from graphnav.core.rotation import Array
from graphnav.estimation.noise.apply import apply_noise, select_weights
from graphnav.estimation.noise.components import Components, Squares, begin_components
from graphnav.estimation.noise.information import compute_information, compute_tail_information
from graphnav.estimation.noise.initial_points import Initial, find_initial_points
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, RowWeights
from graphnav.estimation.noise.moments import ImuMoments, Moments, collect_moments, lag_moments
from graphnav.estimation.noise.outliers import compute_interval_cost, compute_row_costs, list_reduced
from graphnav.estimation.noise.priors import TIME_WITHIN
from graphnav.estimation.noise.tails import CHANCE, compute_bounded_mean, estimate_tail_index, find_peak, weigh_scaled
from graphnav.estimation.problem import ParameterChain, Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import LINEAR_ATTITUDE, ForwardRecord, MomentPass, are_near, reuse_points
from graphnav.estimation.solvers.rows import descend
from graphnav.estimation.solvers.rts import smooth_moments
from graphnav.imu.preintegration import NOISE_FIGURES

_FIRST_KEYFRAMES = 1500  # keyframes: a variance estimated from a thousand numbers is good to a twentieth
_MAX_PASSES = 24  # passes at most
_CHANCE_GAIN = 0.5  # log-likelihood that a figure gains by being estimated, in the mean
_SETTLED = 0.1  # gain of a pass below which estimates have converged, in what they gain by chance
_UNSETTLED = 3  # passes without a gain at most
_TIME_RANGE = 30.0  # factor by which a correlation time may differ from its prior median either way
_MANOEUVRE = 1.0, 10.0  # rad/s, m/s^2, of a vehicle: uncertainty of an interval whose samples are lost
_TIME_GRID = np.linspace(-1.0, 1.0, 21)
_RELAXATION = 1.5  # steps of times, in steps of expectation-maximisation; below 2, they converge as surely


@dataclass(frozen=True)
class NoiseEstimate:
    """A noise model, the smoothed points of its last pass, and how it was found."""

    noise: NoiseModel
    points: MomentPass
    log_prior: float
    log_evidence: float  # of the measurements, and prior: of the likelihood, rows of reduced weight have that of tails
    passes: Counter[str]  # over keyframes, of "filter" and "smoother"
    whole_evidence: float | None = None  # of all measurements, excluded ones included, where it was computed

    @property
    def gained_by_chance(self) -> float:
        """Log-likelihood that its figures gain by being estimated, in the mean."""
        return _CHANCE_GAIN * len(self.noise.figures)

    @property
    def excess(self) -> float:
        """By how many prior sigmas an aiding sensor is worse than its prior's median, the worst one."""
        figures = self.noise.figures.items()
        aiding = [x for name, x in figures if not name.startswith(("imu.", "prior."))]  # of offsets, no noise
        return max(((x.log_factor - x.prior) / x.prior_sigma for x in aiding), default=0.0)

    def attracts(self, log_factors: Mapping[str, float], points: Points, log_evidence: float) -> bool:
        """Whether figures with no more evidence are within a sigma of its own, and points near its own."""
        own = self.noise.figures
        within = all(abs(x - own[name].log_factor) <= own[name].sigma for name, x in log_factors.items())
        return within and log_evidence <= self.log_evidence and are_near(points, self.points, LINEAR_ATTITUDE)

    def get_linearisation(self, base: Problem) -> tuple[Points, Problem]:
        """Its points and the problem that they are of, to start another estimate from."""
        return self.points, apply_noise(base, self.noise)

    def carry_points(self, base: Problem, problem: Problem) -> Points:
        """Its points for a problem with the same keyframes and another noise model."""
        return reuse_points(*self.get_linearisation(base), problem)


def estimate_noise(
    problem: Problem,
    opening: float | None = None,
    start: NoiseModel | None = None,
    near: tuple[Points, Problem] | None = None,
    progress: Callable[[str, float], None] | None = None,
    intervals: bool = False,
    scales: bool = False,
    known: NoiseEstimate | None = None,
) -> NoiseEstimate:
    """Estimate the noise model of a problem built with stated noise and with the parts of its intervals' noise.

    Parameters
    ----------
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.
    start : initial figures, weights of rows, and what is left out; prior medians when None.
    near : first linearisation points, of all keyframes, and the problem that they are of.
    intervals : whether single intervals of the IMU may have more noise than the others.
    scales : whether the IMU's scale errors may be larger or smaller than stated.
    known : an estimate by the same figures of the same measurements; where this one comes to it, that is returned.

    Raises
    ------
    EstimationError
        If the filter breaks down.
    """
    figures = begin_components(problem, start, scales)
    if near is not None:
        about = reuse_points(*near, apply_noise(problem, figures.build_model()))
        return _iterate(problem, figures, about, progress, intervals, known)
    found, passes, failure = list[NoiseEstimate](), Counter[str](), None
    for initial in _list_initial_points(problem, apply_noise(problem, figures.build_model()), opening):
        passes.update(filter=initial.passes, smoother=initial.passes)
        best = max(found, key=lambda one: one.log_evidence, default=None)
        figures = begin_components(problem, start, scales)
        figures.weights |= initial.weights
        for name, more in initial.log_factors.items():
            figures.log[name] += more
        if start is None:
            figures.doubt_wheels(problem)
        try:
            found.append(_iterate(problem, figures, initial.points, progress, intervals, best))
        except BREAKDOWN as error:  # from these points; others may succeed
            failure = error
            continue
        if best is not None and _are_same(best, found[-1]):
            break
    if failure is not None and not found:
        raise failure
    best = max(found, key=lambda one: one.log_evidence)
    return replace(best, passes=sum((one.passes for one in found), passes))


def _list_initial_points(problem: Problem, used: Problem, opening: float | None) -> Iterator[Initial]:
    """Those of a problem with the figures to start from, or where its filter breaks down, with stated noise."""
    try:
        yield from find_initial_points(used, opening)
    except BREAKDOWN:
        for one in find_initial_points(problem, opening):
            yield replace(one, points=reuse_points(one.points, problem, used))


def _are_same(one: NoiseEstimate, other: NoiseEstimate) -> bool:
    """Whether two estimates have come to the same maximum."""
    worse, better = sorted((one, other), key=lambda each: each.log_evidence)
    log_factors = {name: figure.log_factor for name, figure in worse.noise.figures.items()}
    return better.attracts(log_factors, worse.points, worse.log_evidence)


def _iterate(
    problem: Problem,
    figures: Components,
    about: Points,
    progress: Callable[[str, float], None] | None,
    intervals: bool,
    known: NoiseEstimate | None,
) -> NoiseEstimate:
    """Iterate from initial figures and linearisation points to convergence, or to a known estimate."""
    done, total = 0, len(problem.t)  # keyframes
    long = total > 2 * _FIRST_KEYFRAMES and not figures.known
    latest: tuple[ForwardRecord, MomentPass] | None = None
    for end in (_FIRST_KEYFRAMES, total) if long else (total,):
        likeliest, most, since, most_expected = figures.copy(), -np.inf, 0, 1.0
        for _ in range(_MAX_PASSES):
            used, latest = apply_noise(problem, figures.build_model()), None  # releases the memory of the previous pass
            latest = _smooth_about(used, about.take(slice(end)))
            done += end
            prior_then = figures.log_prior()
            evidence = float(np.sum(latest[0].log_likelihood)) + prior_then - _compute_weight_cost(used, figures)
            ahead = _splice(about, latest[1])
            near, here = are_near(ahead, about, LINEAR_ATTITUDE), figures.copy()
            about = ahead if near else descend(used, about, ahead)
            gained = evidence - most
            if intervals and INTERVALS[0] not in here.weights:
                pass  # another model than is asked for
            elif gained > 0.0:
                likeliest, most, since = here, evidence, 0
            else:
                since += 1
            moments, information = _collect(figures, used, *latest)
            expected = _improve(figures, used, latest[1], moments, information, intervals)
            if gained < 0.0:
                _average(problem, figures, here)
            most_expected = max(most_expected, expected)
            if progress is not None:
                progress("noise", 1.0 - np.log1p(expected) / np.log1p(most_expected))
            if known is not None and end == total and known.attracts(figures.log, ahead, evidence):
                return replace(known, passes=_count(done, total))
            converged = near and abs(gained) < _SETTLED * _CHANCE_GAIN * len(figures.log)
            if converged or since == _UNSETTLED:
                break
        figures = here if converged and end == total else figures if converged else likeliest
    if not converged:  # the last pass is not that of the likeliest figures
        latest = None
        used = apply_noise(problem, figures.build_model())
        latest = _smooth_about(used, about)
        done, prior_then = done + total, figures.log_prior()
        evidence = float(np.sum(latest[0].log_likelihood)) + prior_then - _compute_weight_cost(used, figures)
        information = _collect(figures, used, *latest)[1]
    assert latest is not None
    figures.sigmas = figures.compute_sigmas(information)
    return NoiseEstimate(figures.build_model(), latest[1], prior_then, evidence, _count(done, total))


def _count(done: int, total: int) -> Counter[str]:
    """Passes, of so many keyframes in all and in each."""
    return Counter(filter=round(done / total), smoother=round(done / total))


def _average(problem: Problem, figures: Components, before: Components) -> None:
    """Take the figures, and the weights of rows, half way back to others."""
    for name, x in before.log.items():
        figures.log[name] = 0.5 * (figures.log[name] + x)
    for now, then in ((figures.times, before.times), (figures.tails, before.tails)):
        now.update({name: float(np.sqrt(x * then[name])) for name, x in now.items() if name in then})
    both = figures.build_model(), before.build_model()
    for rows in problem.constraints:
        if rows.name in before.weights and rows.name in figures.weights:
            t = problem.t[rows.keyframe]
            one, other = (select_weights(t, noise, rows.name) for noise in both)
            figures.weights[rows.name] = list_reduced(t, np.sqrt(one * other), one > 0.0)


def _collect(figures: Components, used: Problem, forward: ForwardRecord, smoothed: MomentPass) -> tuple[Moments, Array]:
    """The moments of a pass, and its information on all figures."""
    moments = collect_moments(used, forward.about.states.R_nb, smoothed)
    return moments, compute_information(used, forward, smoothed, moments, tuple(figures.log))


def _compute_weight_cost(used: Problem, figures: Components) -> float:
    """By which the log-likelihood of a problem with the weights of these figures is above the evidence."""
    intervals = compute_interval_cost(figures.weights, len(used.t) - 1)
    return float(np.sum(compute_row_costs(used, figures.tails))) + intervals


def _smooth_about(problem: Problem, about: Points) -> tuple[ForwardRecord, MomentPass]:
    forward = refilter(problem, about, whole=False)
    return forward, smooth_moments(problem, forward)


def _splice(about: Points, part: Points) -> Points:
    """Points with the first ones replaced."""
    n = len(part.values)
    states = type(part.states).stack([part.states, about.states[n:]])
    return Points(states, np.concatenate([part.values, about.values[n:]]))


def _sum(A: Array, B: Array) -> Squares:
    """Sums of squares A and redundancies B of the same shape, each of one degree of freedom."""
    return Squares(float(np.sum(A)), float(np.sum(B)), float(np.sum(B * B)))


def _sum_bounded(A: Array, B: Array, freedom: int, each: Array | float = 1.0) -> Squares:
    """Sums of squares A (n,) and redundancies B (n,), of `each` degrees of freedom in the data, `freedom` by nature.

    Squares are bounded, if that makes their sum smaller: the bound's effect on the mean is compensated.
    """
    most, mean = float(chdtri(freedom, CHANCE)), compute_bounded_mean(freedom)
    bounded = float(np.sum(np.minimum(A, most / freedom * B))) * freedom / mean
    return Squares(min(float(np.sum(A)), bounded), float(np.sum(B)), float(np.sum(B * B / each)))


def _sum_squares(problem: Problem, moments: Moments) -> dict[str, Squares]:
    """Of every component."""
    squares = defaultdict[str, Squares](Squares)
    for i, name in enumerate(NOISE_FIGURES):
        squares[f"imu.{name}"] = _sum_bounded(moments.imu.A[:, i], moments.imu.B[:, i], 3, moments.imu.freedom[:, i])
    for chain in problem.chains:
        if chain.parameter.name in moments.processes:
            _, A, B = moments.processes[chain.parameter.name]
            for i, name in enumerate(chain.parameter.noise_groups):
                squares[name] += _sum_bounded(A[:, i], B[:, i], 1)
    for rows in problem.constraints:
        if rows.name in moments.rows:
            found, (names, index) = moments.rows[rows.name], rows.list_noise_groups()
            for i, name in enumerate(names):
                own = index[: len(found.A)] == i
                squares[name] += _sum(found.A[own], found.B[own])
    return squares


def _improve(
    figures: Components,
    problem: Problem,
    smoothed: MomentPass,
    moments: Moments,
    information: Array,
    intervals: bool,
) -> float:
    """One step for all figures and weights; the gain that is expected of it."""
    before = dict(figures.log)
    tails = compute_tail_information(problem, moments, tuple(figures.log))
    gain = figures.improve(_sum_squares(problem, moments), information, tails)
    if intervals:
        _weigh_intervals(figures, problem, moments.imu)
    for chain in problem.chains:
        if chain.parameter.name in moments.processes and chain.parameter.correlation_time is not None:
            observed = _is_observed(figures, chain)
            if observed.any():
                lags = lag_moments(problem, chain, smoothed, moments.processes[chain.parameter.name])
                _improve_time(figures, chain, observed, lags)
    for rows in problem.constraints:
        if rows.name in moments.rows:
            found, (names, index) = moments.rows[rows.name], rows.list_noise_groups()
            factors = np.array([*(np.exp(figures.log[name] - before[name]) for name in names), 1.0])
            grown = factors[index[: len(found.A)]]
            # with the figures of the next pass: B is the share of the row's own variance in that of its prediction
            _weigh_rows(figures, problem, rows, found.left_out / np.mean(1.0 + found.B * (grown - 1.0), axis=1))
    return gain


def _weigh_intervals(figures: Components, problem: Problem, imu: ImuMoments) -> None:
    """Give outlying intervals the noise by which their disturbance is as large as the limit of `CHANCE`."""
    t, n = problem.t[1:], len(imu.A)
    densities = problem.imu_noise.gyro_noise_density, problem.imu_noise.accel_noise_density
    for i, (name, density, lost) in enumerate(zip(INTERVALS, densities, _MANOEUVRE, strict=True)):
        freedom, ratio = imu.freedom[:, i], imu.squared[:, i]
        # if half of the intervals are off, it is the variance that has not converged yet
        scale = max(float(np.median(ratio / chdtri(freedom, 0.5))), 1.0)
        more = 1.0 / select_weights(t, figures.build_model(), name)
        most = np.maximum(lost**2 * problem.intervals.T[:n] / density**2, 1.0)
        more[:n] = np.clip(more[:n] * ratio / chdtri(freedom, CHANCE) / scale, 1.0, most)
        some = more > 1.0
        figures.weights[name] = RowWeights(t[some], 1.0 / more[some])


def _is_observed(figures: Components, chain: ParameterChain) -> Array:
    """(k,) whether the data determine the variance of each number of a process."""
    return np.array([figures.freedom.get(group, 0.0) > 1.0 for group in chain.parameter.noise_groups])


def _improve_time(figures: Components, chain: ParameterChain, observed: Array, lags: tuple[Array, ...]) -> None:
    """One expectation-maximisation step of the correlation time, on a grid, with a log-normal prior.

    Steady variances follow, so that the driving noise stays: data much shorter than a correlation time determine that
    alone, and at a given variance the two would go up and down together, in many passes. `observed` (k,) of the
    process's numbers are used.
    """
    dt, left, later, cross, before = lags
    p = chain.parameter
    assert p.correlation_time is not None
    if not len(dt):
        return
    first, usual = before[0, observed], float(np.median(dt))
    pairs, inverse = np.unique(dt + 1j * left, return_inverse=True)  # few differ; by axis 15 times as long
    dt, left = pairs.real, pairs.imag
    later, cross, before, count = (
        np.stack([np.bincount(inverse, one, len(dt)) for one in some.T[observed]], axis=-1)
        for some in (later, cross, before, np.ones_like(before))
    )
    times = p.correlation_time * np.exp(_TIME_GRID)
    grown = np.expm1(-2.0 * usual / p.correlation_time) / np.expm1(-2.0 * usual / times)  # steady variance
    steady = grown[:, None] * chain.sigma[0, observed] ** 2
    a = (np.exp(-dt[:, None] / times) * left[:, None])[..., None]
    q = (1.0 - a * a) * steady
    squares = later[:, None] - 2.0 * a * cross[:, None] + a * a * before[:, None]
    value = -0.5 * np.sum(count[:, None] * np.log(q) + squares / q, axis=(0, 2))
    value -= 0.5 * np.sum(np.log(steady) + first / steady, axis=1)
    median = figures.prior_times[p.name]
    value -= 0.5 * (np.log(times / median) / TIME_WITHIN) ** 2
    # in their order: a sum of floats in that of a set is another in every process
    groups = dict.fromkeys(group for group, known in zip(p.noise_groups, observed, strict=True) if known)
    for group in groups:
        m, s = figures.get_prior(group)
        value -= 0.5 * ((figures.log[group] + np.log(grown) - m) / s) ** 2
    off, most = np.log(p.correlation_time / median), np.log(_TIME_RANGE)
    low, high = max(_TIME_GRID[0], -most - off), min(_TIME_GRID[-1], most - off)
    x = float(np.clip(_RELAXATION * find_peak(_TIME_GRID, value), low, high))
    figures.times[p.name] = p.correlation_time * float(np.exp(x))
    for group in groups:
        grew = float(np.interp(x, _TIME_GRID, np.log(grown)))
        figures.log[group] = min(figures.log[group] + grew, figures.get_largest(group))


def _weigh_rows(figures: Components, problem: Problem, rows: Constraint, squared: Array) -> None:
    """The tail index of a constraint, and weights of its first n rows, by their squared errors (n,)."""
    n, m = len(squared), len(rows.axes)
    before = np.ones(len(rows)) if rows.weight is None else rows.weight
    used = before > 0.0
    figures.tails[rows.name] = index = estimate_tail_index(squared[used[:n]], m)
    weight = np.concatenate([weigh_scaled(squared, m, index, used[:n]), before[n:]])  # later ones as they were
    figures.weights[rows.name] = list_reduced(problem.t[rows.keyframe], weight, used)
