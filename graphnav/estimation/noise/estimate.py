"""All noise figures of a recording at once, by the likelihood of its innovations.

Maximum a posteriori: with L the innovation log-likelihood of the filter and a log-normal prior on every variance
factor, the estimate maximises L plus the logarithm of the priors. From pass to pass, filter and smoother linearised at
the points that the pass before left, every factor f with redundancy B and the sum of squares A
(`graphnav.estimation.noise.moments`) goes to the maximum over x = ln(f_new / f) of

    -(B x + A e^-x) / 2 - (ln f + x - m)^2 / (2 s^2)

the likelihood of A / f as a chi-square variable of B degrees of freedom, and the prior. Without a prior that is the
fixed point f <- f A / B of Foerstner (1979), Koch (1999, section 3.6) and MacKay (1992). All sensors are estimated at
once, so none is favoured by the order. Squares of rows have the weights of their tails, whose index is estimated in the
same pass (`graphnav.estimation.noise.tails`); of the IMU and of processes, a square counts for no more than the value
that it exceeds once in a thousand times (`CHANCE`). The first passes of a long drive use its first `_FIRST_KEYFRAMES`
keyframes only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from graphnav.constraints.base import Constraint
from graphnav.core.rotation import Array
from graphnav.estimation.noise.apply import apply_noise, select_weights
from graphnav.estimation.noise.components import Components, begin_components
from graphnav.estimation.noise.information import compute_information
from graphnav.estimation.noise.initial_points import BREAKDOWN, find_initial_points
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, RowWeights
from graphnav.estimation.noise.moments import (
    ImuMoments,
    collect_imu_moments,
    collect_process_moments,
    collect_row_moments,
    lag_moments,
)
from graphnav.estimation.noise.outliers import compute_interval_cost, compute_row_costs, list_reduced
from graphnav.estimation.noise.priors import TIME_WITHIN
from graphnav.estimation.noise.tails import CHANCE, compute_bounded_mean, estimate_tail_index, weigh_scaled
from graphnav.estimation.problem import ParameterChain, Problem
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import LINEAR_ATTITUDE, ForwardRecord, MomentPass, are_near, reuse_points
from graphnav.estimation.solvers.rows import shorten_step
from graphnav.estimation.solvers.rts import smooth_moments
from graphnav.imu.preintegration import NOISE_FIGURES

_FIRST_KEYFRAMES = 1500  # keyframes: a variance estimated from a thousand numbers is good to a twentieth
_ROUNDS, _AGAIN = 8, 3  # passes to convergence, from the priors and from figures that were estimated before
_MAX_PASSES = 3 * _ROUNDS  # passes at most
_EXTRAPOLATION = 2.0  # longest step, in steps as computed (Aitken's extrapolation)
_TIME_RANGE = 30.0  # factor by which a correlation time may differ from its prior median either way
_MANOEUVRE = 1.0, 10.0  # rad/s, m/s^2, of a vehicle: uncertainty of an interval whose samples are lost
_TIME_GRID = np.linspace(-1.0, 1.0, 21)


@dataclass(frozen=True)
class NoiseEstimate:
    """A noise model, the smoothed points of its last pass, and how it was found."""

    noise: NoiseModel
    points: MomentPass
    log_prior: float
    log_evidence: float  # of the measurements, and prior: of the likelihood, rows of reduced weight have that of tails
    passes: Counter[str]  # over keyframes, of "filter" and "smoother"
    whole_evidence: float | None = None  # of all measurements, excluded ones included, where it was computed
    rival: NoiseEstimate | None = None  # by another decision on what is wrong, nearly as likely

    @property
    def gained_by_chance(self) -> float:
        """Log-likelihood that its figures gain by being estimated, in the mean."""
        return 0.5 * len(self.noise.figures)

    @property
    def excess(self) -> float:
        """By how many prior sigmas an aiding sensor is worse than its prior's median, the worst one."""
        figures = self.noise.figures.items()
        aiding = [x for name, x in figures if not name.startswith(("imu.", "prior."))]  # of offsets, no noise
        return max(((x.log_factor - x.prior) / x.prior_sigma for x in aiding), default=0.0)

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
    changed: bool = False,
    scales: bool = False,
) -> NoiseEstimate:
    """Estimate the noise model of a problem built with stated noise and with the parts of its intervals' noise.

    Parameters
    ----------
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.
    start : initial figures, weights of rows, and what is left out; prior medians when None.
    near : first linearisation points, of all keyframes, and the problem that they are of.
    intervals : whether single intervals of the IMU may have more noise than the others.
    changed : whether the initial figures were estimated with other measurements left out, and may have far to go.
    scales : whether the IMU's scale errors may be larger or smaller than stated.

    Raises
    ------
    EstimationError
        If the filter breaks down.
    """
    figures = begin_components(problem, start, changed, scales)
    if near is not None:
        return _iterate(
            problem, figures, reuse_points(*near, apply_noise(problem, figures.build_model())), progress, intervals
        )
    used = apply_noise(problem, figures.build_model())
    try:
        initials, passes = find_initial_points(used, opening)
    except BREAKDOWN:  # with the prior's medians; with stated noise it may not
        initials, passes = find_initial_points(problem, opening)
        initials = [replace(one, points=reuse_points(one.points, problem, used)) for one in initials]
    found: list[NoiseEstimate] = []
    for initial in initials:
        figures = begin_components(problem, start, changed, scales)
        figures.weights |= initial.weights
        for name, more in initial.log_factors.items():
            figures.log[name] += more
        if start is None:
            figures.doubt_wheels(problem)
        try:
            found.append(_iterate(problem, figures, initial.points, progress, intervals))
        except BREAKDOWN:  # from these points; others may succeed
            if initial is initials[-1] and not found:
                raise
    best = max(found, key=lambda one: one.log_evidence)
    total = sum((one.passes for one in found), Counter(filter=passes, smoother=passes))
    return replace(best, passes=total)


def _iterate(
    problem: Problem,
    figures: Components,
    about: Points,
    progress: Callable[[str, float], None] | None,
    intervals: bool,
) -> NoiseEstimate:
    """Iterate from initial figures and linearisation points to convergence."""
    done, total, converged = 0, len(problem.t), False  # keyframes
    long = total > 2 * _FIRST_KEYFRAMES and not figures.known
    latest: tuple[ForwardRecord, MomentPass] | None = None
    for end in (_FIRST_KEYFRAMES, total) if long else (total,):
        rounds = _AGAIN if figures.same_data or done else _ROUNDS
        before, converged, figures.extrapolation = -np.inf, False, 1.0
        here, likeliest, most, since = figures, figures, -np.inf, 0
        for k in range(_MAX_PASSES):
            used, latest = apply_noise(problem, figures.build_model()), None  # releases the memory of the previous pass
            latest = _smooth_about(used, about.take(slice(end)))
            done += end
            prior_then = figures.log_prior()
            now = float(np.sum(latest[0].log_likelihood)) + prior_then
            if progress is not None:
                progress("noise", min((k + 1) / rounds, 1.0))
            here, evidence = figures.copy(), now - _compute_weight_cost(used, figures)
            likeliest, most, since = (here, evidence, 0) if evidence > most else (likeliest, most, since + 1)
            ahead = _splice(about, latest[1])
            near = are_near(ahead, about, LINEAR_ATTITUDE)
            about = ahead if near else shorten_step(used, about, ahead)
            _improve(figures, used, *latest, end, intervals)
            # each figure gains a half by chance; while one sensor is far off, many passes gain little more than that
            converged = k > 1 and abs(evidence - before) < (0.05 if k + 1 < rounds else 0.5) * len(figures.log)
            # weights and figures may alternate between two states
            if converged or since == _ROUNDS // 2:
                break
            before, figures.extrapolation = evidence, _EXTRAPOLATION if k > 1 and evidence > before else 1.0
        if not converged:  # oscillating, or not yet converged
            figures = likeliest
        elif end == total:
            figures = here
    if not converged:
        latest = None
        used = apply_noise(problem, figures.build_model())
        latest = _smooth_about(used, about)
        done, prior_then = done + total, figures.log_prior()
        now = float(np.sum(latest[0].log_likelihood)) + prior_then
    assert latest is not None
    evidence, passes = now - _compute_weight_cost(used, figures), round(done / total)
    figures.sigmas = _compute_sigmas(figures, used, *latest)
    return NoiseEstimate(
        figures.build_model(), latest[1].drop_rows(), prior_then, evidence, Counter(filter=passes, smoother=passes)
    )


def _compute_sigmas(
    figures: Components, used: Problem, forward: ForwardRecord, smoothed: MomentPass
) -> dict[str, float]:
    """1-sigma of every logarithm, whatever the others are."""
    information = compute_information(used, forward, smoothed, tuple(figures.log))
    information += np.diag([figures.get_prior(name)[1] ** -2.0 for name in figures.log])
    return dict(zip(figures.log, np.sqrt(np.diag(np.linalg.inv(information))).tolist(), strict=True))


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


def _bound_squares(A: Array, B: Array, freedom: int) -> tuple[float, float]:
    """Sums of bounded squares and of redundancies; the bound's effect on the mean is compensated."""
    most, mean = float(chdtri(freedom, CHANCE)), compute_bounded_mean(freedom)
    return float(np.sum(np.minimum(A, most / freedom * B))) * freedom / mean, float(np.sum(B))


def _improve(
    figures: Components,
    problem: Problem,
    forward: ForwardRecord,
    smoothed: MomentPass,
    end: int,
    intervals: bool,
) -> None:
    """One step for all figures and weights."""
    imu = collect_imu_moments(problem, forward.about.states.R_nb[:-1], smoothed)
    for i, name in enumerate(NOISE_FIGURES):
        figures.update(f"imu.{name}", *_bound_squares(imu.A[:, i], imu.B[:, i], 3))
    if intervals:
        _weigh_intervals(figures, problem, imu)
    driven: dict[str, tuple[Array, Array, Array]] = {}
    for chain in problem.chains:
        if chain.parameter.noise_groups:
            driven[chain.parameter.name] = collect_process_moments(problem, chain, smoothed, end)
            _improve_process(figures, chain, driven[chain.parameter.name])
            observed = _is_observed(figures, chain)
            if chain.parameter.correlation_time is not None and observed.any():
                _improve_time(figures, chain, observed, lag_moments(problem, chain, smoothed, end))
    for rows in problem.constraints:
        names, index = rows.list_noise_groups()
        if not names:
            continue
        n = int(np.searchsorted(rows.keyframe, end))
        found, index = collect_row_moments(problem, rows, smoothed, n), index[:n]
        grown = np.ones(found.A.shape)
        for i, name in enumerate(names):
            own, before = index == i, figures.log[name]
            if own.any():
                figures.update(name, float(np.sum(found.A[own])), float(np.sum(found.B[own])))
            grown[own] = np.exp(figures.log[name] - before)
        # with the figures of the next pass: B is the share of the row's own variance in that of its prediction
        squared = found.left_out / np.mean(1.0 + found.B * (grown - 1.0), axis=1)
        _weigh_rows(figures, problem, rows, squared)


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


def _improve_process(figures: Components, chain: ParameterChain, moments: tuple[Array, Array, Array]) -> None:
    _, A, B = moments
    groups = np.array(chain.parameter.noise_groups)
    for group in dict.fromkeys(name for name in chain.parameter.noise_groups if name in figures.log):
        own = groups == group
        figures.update(group, *_bound_squares(A[:, own], B[:, own], 1))


def _is_observed(figures: Components, chain: ParameterChain) -> Array:
    """(k,) whether the data determine the variance of each number of a process."""
    return np.array([figures.freedom.get(group, 0.0) > 1.0 for group in chain.parameter.noise_groups])


def _improve_time(figures: Components, chain: ParameterChain, observed: Array, lags: tuple[Array, ...]) -> None:
    """One expectation-maximisation step of the correlation time, on a grid, with a log-normal prior.

    `observed` (k,) of its numbers are used.
    """
    dt, left, later, cross, before = lags
    p = chain.parameter
    assert p.correlation_time is not None
    if not len(dt):
        return
    pairs, first = np.unique(dt + 1j * left, return_inverse=True)  # few differ; by axis it takes fifteen times as long
    dt, left = pairs.real, pairs.imag
    later, cross, before, count = (
        np.stack([np.bincount(first, one, len(dt)) for one in some.T[observed]], axis=-1)
        for some in (later, cross, before, np.ones_like(before))
    )
    times = p.correlation_time * np.exp(_TIME_GRID)
    a = (np.exp(-dt[:, None] / times) * left[:, None])[..., None]
    q = (1.0 - a * a) * chain.sigma[0, observed] ** 2
    squares = later[:, None] - 2.0 * a * cross[:, None] + a * a * before[:, None]
    value = -0.5 * np.sum(count[:, None] * np.log(q) + squares / q, axis=(0, 2))
    median = figures.prior_times[p.name]
    value -= 0.5 * (np.log(times / median) / TIME_WITHIN) ** 2
    j = int(np.clip(np.argmax(value), 1, len(_TIME_GRID) - 2))
    low, here, high = value[j - 1 : j + 2]
    bend = low - 2.0 * here + high
    off = 0.5 * (low - high) / bend if bend < 0.0 else 0.0
    found = p.correlation_time * np.exp(_TIME_GRID[j] + (_TIME_GRID[1] - _TIME_GRID[0]) * np.clip(off, -1.0, 1.0))
    figures.times[p.name] = float(np.clip(found, median / _TIME_RANGE, median * _TIME_RANGE))


def _weigh_rows(figures: Components, problem: Problem, rows: Constraint, squared: Array) -> None:
    """The tail index of a constraint, and weights of its first n rows, by their squared errors (n,)."""
    n, m = len(squared), len(rows.axes)
    before = np.ones(len(rows)) if rows.weight is None else rows.weight
    used = before > 0.0
    figures.tails[rows.name] = index = estimate_tail_index(squared[used[:n]], m)
    weight = np.concatenate([weigh_scaled(squared, m, index, used[:n]), before[n:]])  # later ones as they were
    figures.weights[rows.name] = list_reduced(problem.t[rows.keyframe], weight, used)
