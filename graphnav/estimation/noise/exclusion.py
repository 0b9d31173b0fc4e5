"""Which measurements are wrong for a while: each span decided once, by evidence.

The bank of likelihood-ratio tests (`graphnav.estimation.solvers.watch`) says in which spans fixes disagree with
everything else by something that lasts. Who is wrong there is another question. With the noise model as it is, each
span is put as several models, each with its own likelihood of the innovations from the span's beginning to that of the
next one:

    neither     all is as the noise model has it
    fixes       positions, velocities or both have one unknown error in common in the span, which grows steadily, or
                each has one of its own
    wheels      what is assumed of wheels, and the odometer, have one such error in common there
    IMU         the intervals there that the smoother needs more noise of have it
    rows        single rows there have the weights that were found

An unknown error has a Gaussian prior about zero, as wide as such errors get (`WIDE`), and so has its growth; what that
width costs in likelihood is the cost of the explanation (MacKay 1992, "Bayesian interpolation": the Occam factor). A
fault is also as rare beforehand as the tests take it to be, an outlier among intervals or rows as rare as `CHANCE`. The
best model decides what is left out.

Figures that are estimated with a fault in the data may have grown until they hide it. So the tests are made with the
prior medians of the figures as well; where they find something else, the figures are estimated without that, twice, as
the spans come to what is wrong; each span is decided with these, and of the two explanations of all measurements the
likelier one stands. Where these figures know of no span at all, the third is that all is right, by figures that set out
from them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtri

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint, Linearized
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter, States
from graphnav.estimation import faults
from graphnav.estimation.noise.apply import row_weights, with_noise
from graphnav.estimation.noise.estimate import CHANCE, NoiseEstimate, estimate_noise
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, RowWeights
from graphnav.estimation.noise.moments import row_moments
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ExcludedSpan
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import SmootherPass, points_of, values_of
from graphnav.estimation.solvers.watch import FALSE_ALARM, MINUTE, WIDE
from graphnav.recording import Recording

FIXES, WHEELS = ("gnss_position", "gnss_velocity"), ("nhc", "odometer")
ROWS = ("rows",)
_WRONG: tuple[tuple[str, ...], ...] = ((), FIXES[:1], FIXES[1:], FIXES, WHEELS, INTERVALS, ROWS)
_SINGLE = INTERVALS, ROWS  # outliers: nothing is left out for them
_ODDS = -float(np.log(FALSE_ALARM))  # by which a fault is less likely beforehand than none
_NONE = 1e-9  # sigma of an error that is not there
_OUTLIER = -float(np.log(CHANCE))  # the same of one row, and of one interval of the IMU


@dataclass(frozen=True)
class _Shifted(Constraint):
    """Rows of a constraint with an error in common within spans."""

    inner: Any = None
    error: str = ""
    since: Any = None  # (N,) s since the span began

    @property
    def name(self) -> str:  # type: ignore[override]
        return str(self.inner.name)

    @property
    def axes(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(self.inner.axes)

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)

    @classmethod
    def build(cls, scene: BuildContext) -> None:
        return None

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        unknown = parameters[self.error]  # (n, 2 m), at the beginning of the span and growth in a minute
        linear = self.inner.linearize(states, {k: v for k, v in parameters.items() if k != self.error}, rows)
        n, m = linear.residual.shape
        minutes = (self.since[rows] / MINUTE)[:, None]
        J = np.concatenate([np.broadcast_to(np.eye(m), (n, m, m)), minutes[..., None] * np.eye(m)], axis=-1)
        residual = linear.residual + unknown[:, :m] + minutes * unknown[:, m:]
        return Linearized(residual, linear.jacobians | {self.error: J}, linear.sigma)


def with_common_errors(problem: Problem, spans: list[tuple[float, float]], kinds: tuple[str, ...]) -> Problem:
    """The problem with one unknown error of each of some constraints in each span (s)."""
    begins, wide = [float(problem.t[0]) - 1.0], [0.0]
    for a, b in spans:
        begins += [a, b + 2.0 * SAME_TIME]  # a node holds from this much before it
        wide += [1.0, 0.0]

    def shifted(rows: Constraint) -> Constraint:
        if rows.name not in kinds:
            return rows
        name, m = f"{rows.name}_fault", len(rows.axes)
        sigma = np.maximum(np.outer(wide, np.full(2 * m, WIDE[rows.unit])), _NONE)
        own = Parameter(name, np.zeros(sigma.shape), sigma, rows.unit, begins=np.array(begins))
        t = problem.t[rows.keyframe]
        return _Shifted(
            keyframe=rows.keyframe,
            parameters=(*rows.parameters, own),
            weight=rows.weight,
            inner=rows,
            error=name,
            since=t - np.array(begins)[np.searchsorted(begins, t + SAME_TIME, side="right") - 1],
        )

    return replace(problem, constraints=tuple(shifted(rows) for rows in problem.constraints))


def with_own_errors(problem: Problem, spans: list[tuple[float, float]], kinds: tuple[str, ...]) -> Problem:
    """The problem with an unknown error of each row of some constraints in the spans (s), as a frozen receiver has."""

    def loose(rows: Constraint) -> Constraint:
        if rows.name not in kinds:
            return rows
        t = problem.t[rows.keyframe]
        within = np.any([(t >= a - SAME_TIME) & (t <= b + SAME_TIME) for a, b in spans], axis=0)
        sigma: Array = rows.sigma  # type: ignore[attr-defined]
        weight = np.ones(len(rows)) if rows.weight is None else rows.weight
        wide = np.min(sigma / np.hypot(sigma, WIDE[rows.unit]), axis=1) ** 2
        return replace(rows, weight=np.where(within, np.minimum(weight, wide), weight))

    return replace(problem, constraints=tuple(loose(rows) for rows in problem.constraints))


@dataclass(frozen=True)
class Explained:
    """What is left out where evidence says so, and how likely that makes all measurements."""

    noise: NoiseModel
    log_evidence: float
    passes: int  # of filter and smoother
    looks: int  # of the filter alone
    estimate: NoiseEstimate | None = None  # that the noise is of, where nothing is left out of another than was given


def estimate_without_faults(
    base: Problem, opening: float | None = None, progress: Callable[[str, float], None] | None = None
) -> NoiseEstimate:
    """The noise model, estimated again without the spans of wrong measurements that evidence leaves out.

    Parameters
    ----------
    base : posed with stated noise and the parts of its intervals' noise.
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.

    Raises
    ------
    EstimationError
        If the filter breaks down.
    """
    found = estimate_noise(base, opening, progress=progress)
    explained = exclude(base, found)
    passes = found.passes + explained.passes
    found = replace(explained.estimate or found, passes=passes, looks=explained.looks)
    if not explained.noise.excluded:
        return found
    # from the priors on: figures that were estimated with what is wrong in it are far from what they come to
    anew = NoiseModel(excluded=explained.noise.excluded)
    again = estimate_noise(base, opening, anew, (found.points, with_noise(base, found.noise)), progress)
    return replace(again, passes=found.passes + again.passes, looks=found.looks)


def with_disturbed_intervals(base: Problem, found: NoiseEstimate) -> NoiseEstimate:
    """A noise model in which single intervals of the IMU have more noise than the others.

    An IMU that loses samples for a moment makes fixes look wrong. So where some are left out, all measurements are
    explained anew with such intervals, and the likelier explanation stands.

    Parameters
    ----------
    base : posed with stated noise and the parts of its intervals' noise.
    found : with all intervals alike.
    """
    near = found.points, with_noise(base, found.noise)
    passes, looks = 0, 0
    if found.noise.excluded:
        free = estimate_noise(base, None, replace(found.noise, excluded={}), near, intervals=True)
        explained = decide(base, free, find_spans(base, free.noise, free))
        passes, looks = free.passes, explained.looks + 1
        if explained.noise.excluded:
            start = replace(free.noise, excluded=explained.noise.excluded)
            free = estimate_noise(base, None, start, (free.points, with_noise(base, free.noise)), intervals=True)
            passes += free.passes
        if _log_evidence(base, free) > _log_evidence(base, found):
            return replace(free, passes=passes, looks=looks)
    alike = estimate_noise(base, None, found.noise, near, intervals=True)
    return replace(alike, passes=passes + alike.passes, looks=looks)


def _log_evidence(base: Problem, found: NoiseEstimate) -> float:
    """Of all measurements, those that are left out too; each outlier among the others has its cost."""
    spans = _join(span for some in found.noise.excluded.values() for span in some)
    whole = decide(base, found, spans).log_evidence if spans else found.log_posterior
    outliers = sum(_count(_outside(some, spans)) for some in found.noise.weights.values())
    return whole - _OUTLIER * outliers


def exclude(base: Problem, found: NoiseEstimate) -> Explained:
    """A noise model that leaves out what is wrong in spans.

    Parameters
    ----------
    base : posed with stated noise.
    found : estimated with everything used.
    """
    spans = find_spans(base, found.noise, found)
    one = decide(base, found, spans)
    medians = {name: replace(figure, log_factor=figure.prior) for name, figure in found.noise.figures.items()}
    hidden = find_spans(base, NoiseModel(medians), found)
    without = NoiseModel(excluded=dict.fromkeys(FIXES, tuple(hidden)))
    if all(any(a <= begin and end <= b for a, b in spans) for begin, end in hidden):
        return replace(one, looks=one.looks + 2)
    other, spans, passes = found, hidden, 0
    for _ in range(2):  # by figures that nothing wrong is in, spans come to what is wrong of them
        other = estimate_noise(base, None, without, (other.points, with_noise(base, other.noise)))
        posed, passes = with_noise(base, other.noise), passes + other.passes
        spans = trim_spans(posed, other.points, spans)
        again = find_spans(base, replace(other.noise, excluded={}), other)
        if _length(again) > _length(hidden):  # faults shrink then; where more seems wrong, the filter is lost
            return replace(one, passes=passes, looks=one.looks + 3)
        refined = trim_spans(posed, other.points, again)
        if not refined:  # by figures that they have not led astray there are single outliers and no more
            free = estimate_noise(base, None, replace(other.noise, excluded={}), (other.points, posed))
            passes += free.passes
            likely = free.log_posterior - _OUTLIER * sum(map(_count, free.noise.weights.values()))
            if likely > one.log_evidence:
                return Explained(free.noise, likely, passes, one.looks + 3, free)
        if not refined or refined == spans:
            break
        spans, without = refined, replace(without, excluded=dict.fromkeys(FIXES, tuple(refined)))
    ways = [one, *([decide(base, weigh_left_out(posed, other, spans), spans)] if spans else [])]
    best = max(ways, key=lambda way: way.log_evidence)
    return replace(best, passes=passes, looks=sum(way.looks for way in ways) + 4)


def _length(spans: list[tuple[float, float]]) -> float:
    """s"""
    return sum(end - begin for begin, end in spans)


def trim_spans(problem: Problem, smoothed: SmootherPass, spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Spans (s) without what is right at their ends: fixes where a smoother that does not use them has them.

    Tests that go forward in time leave out too much: they date a fault from one of a few onsets, and what comes after
    it is met by a filter that has been led astray.
    """
    t = np.unique(np.concatenate([t[weight < 1.0] for t, weight in _weigh_alone(problem, smoothed).values()]))
    within = [t[np.searchsorted(t, a - SAME_TIME) : np.searchsorted(t, b + SAME_TIME)] for a, b in spans]
    return [(float(some[0]), float(some[-1])) for some in within if len(some)]


def weigh_left_out(problem: Problem, found: NoiseEstimate, spans: list[tuple[float, float]]) -> NoiseEstimate:
    """The estimate with weights for fixes in spans that it leaves out, so that each may be an outlier by itself."""
    weights = dict(found.noise.weights)
    for name, (t, weight) in _weigh_alone(problem, found.points).items():
        kept = _outside(weights.get(name, RowWeights(np.empty(0), np.empty(0))), spans)
        inside = np.any([(t >= a - SAME_TIME) & (t <= b + SAME_TIME) for a, b in spans], axis=0)
        inside &= np.isin(t, t[weight < 1.0])  # with all rows of their times
        both, of_both = np.concatenate([kept.t, t[inside]]), np.concatenate([kept.weight, weight[inside]])
        order = np.argsort(both, kind="stable")
        weights[name] = RowWeights(both[order], of_both[order])
    return replace(found, noise=replace(found.noise, weights=weights))


def _weigh_alone(problem: Problem, smoothed: SmootherPass) -> dict[str, tuple[Array, Array]]:
    """Times (N,) s of fixes, and weights (N,) by which each is as likely as chance allows where it is not used."""
    out = {}
    for rows in problem.constraints:
        if rows.name in FIXES:
            squared = row_moments(problem, rows, smoothed, len(rows)).left_out.sum(axis=1)
            most = chdtri(len(rows.axes), CHANCE)
            out[rows.name] = problem.t[rows.keyframe], np.minimum(1.0, most / np.maximum(squared, 1e-30))
    return out


def find_spans(base: Problem, noise: NoiseModel, found: NoiseEstimate) -> list[tuple[float, float]]:
    """Spans (s) in which fixes disagree with everything else, by figures that need not be those found."""
    # a fault that rows have lost their weight for, or the IMU its own, is to be seen by the tests
    kept = {name: some for name, some in noise.weights.items() if name not in (*FIXES, *INTERVALS)}
    open_ = with_noise(base, replace(noise, weights=kept))
    known = values_of(with_noise(base, found.noise), found.points)
    watched = refilter(open_, points_of(open_, found.points.states, known), watch=True)
    return join_spans(faults.fault_spans(faults.weigh_rows(open_, watched.weights)))


def decide(base: Problem, found: NoiseEstimate, spans: list[tuple[float, float]]) -> Explained:
    """Who is wrong in each span, by the figures found."""
    if not spans:
        return Explained(found.noise, found.log_posterior, 0, 0)
    noise = replace(found.noise, excluded={})
    reach = _with_next_fix(base, spans)
    outside = {name: _outside(some, reach if name in INTERVALS else spans) for name, some in noise.weights.items()}
    of_imu = {name: some for name, some in noise.weights.items() if name in INTERVALS}
    of_rows = {name: some for name, some in noise.weights.items() if name not in INTERVALS}
    used, disturbed, weighted = (
        with_noise(base, replace(noise, weights=outside | some)) for some in ({}, of_imu, of_rows)
    )
    known = values_of(with_noise(base, found.noise), found.points)
    about = points_of(used, found.points.states, known)
    before, likelihood, looks = evidence(used, about, spans, {INTERVALS: disturbed, ROWS: weighted})
    excluded: dict[str, tuple[tuple[float, float], ...]] = {}
    total = before + found.log_prior
    dropped: dict[tuple[str, ...], list[tuple[float, float]]] = {INTERVALS: [], ROWS: []}
    for k, span in enumerate(spans):
        cost = np.array([0.0 if not kinds else _ODDS for kinds in _WRONG])
        for kinds, some, within in ((INTERVALS, of_imu, reach[k]), (ROWS, of_rows, span)):
            outliers = sum(_count(one) - _count(_outside(one, [within])) for one in some.values())
            cost[_WRONG.index(kinds)] = _OUTLIER * outliers if outliers else np.inf
        one = likelihood[k] - cost
        best = int(np.argmax(one))
        total += float(one[best])
        if _WRONG[best] != INTERVALS:
            dropped[INTERVALS].append(reach[k])
        if _WRONG[best] != ROWS:
            dropped[ROWS].append(span)
        if _WRONG[best] not in _SINGLE:
            excluded |= {name: (*excluded.get(name, ()), span) for name in _WRONG[best]}
    present = {rows.name for rows in base.constraints}
    excluded = {name: some for name, some in excluded.items() if name in present}
    weights = {name: _outside(some, dropped[INTERVALS]) for name, some in of_imu.items()}
    weights |= {name: _outside(some, dropped[ROWS]) for name, some in of_rows.items()}
    return Explained(replace(noise, weights=weights, excluded=excluded), total, 0, looks)


def _count(some: RowWeights) -> int:
    """How many have less weight; rows of one time are listed together."""
    return int(np.sum(some.weight < 1.0))


def _with_next_fix(problem: Problem, spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Spans (s) that reach to the first keyframe with a fix behind each: what leads back from an error is there."""
    rows = [c.keyframe for c in problem.constraints if c.name in FIXES]
    t = np.append(np.unique(problem.t[np.concatenate(rows)]), problem.t[-1])
    return [(a, max(b, float(t[min(int(np.searchsorted(t, b + SAME_TIME)), len(t) - 1)]))) for a, b in spans]


def _outside(some: RowWeights, spans: list[tuple[float, float]]) -> RowWeights:
    """The weights of rows outside spans."""
    keep = np.ones(len(some.t), dtype=bool)
    for begin, end in spans:
        keep &= (some.t < begin - SAME_TIME) | (some.t > end + SAME_TIME)
    return RowWeights(some.t[keep], some.weight[keep])


def excluded_share(problem: Problem, noise: NoiseModel) -> float:
    """Share of the information of the positions that a noise model leaves out."""
    rows = next((c for c in problem.constraints if c.name == FIXES[0]), None)
    return 0.0 if rows is None else 1.0 - float(np.mean(row_weights(problem.t[rows.keyframe], noise, rows.name)))


def evidence(
    problem: Problem, about: Points, spans: list[tuple[float, float]], single: Mapping[tuple[str, ...], Problem]
) -> tuple[float, Array, int]:
    """Log-likelihood of innovations before all spans, (M, 7) from each span's beginning on, by `_WRONG`, and passes.

    Parameters
    ----------
    problem : with its noise model and no fix left out.
    about : points of all keyframes.
    spans : s, first and last wrong fix, in order and apart.
    single : the problem with more noise of single intervals of the IMU, and with less weight of single rows.
    """
    edges = np.append(np.searchsorted(problem.t, [a - SAME_TIME for a, _ in spans]), len(problem.t))
    known = values_of(problem, about)
    found: list[Array] = []
    before, passes = 0.0, 0
    present = {rows.name for rows in problem.constraints}
    for kinds in _WRONG:
        possible = present & set(kinds) if kinds == WHEELS else kinds in single or present.issuperset(kinds)
        if not possible:
            found.append(np.full(len(spans), -np.inf))
            continue
        ways = [single.get(kinds, problem)]
        if kinds and kinds not in single:
            ways = [with_common_errors(problem, spans, kinds)]
        if kinds and set(kinds) <= set(FIXES):
            ways.append(with_own_errors(problem, spans, kinds))
        each = []
        for one in ways:
            likelihood = refilter(one, points_of(one, about.states, known)).log_likelihood
            passes += 1
            before = float(np.sum(likelihood[: edges[0]])) if not kinds else before
            each.append([float(np.sum(likelihood[a:b])) for a, b in itertools.pairwise(edges)])
        found.append(np.max(each, axis=0))
    return before, np.array(found).T, passes


def join_spans(found: tuple[ExcludedSpan, ...]) -> list[tuple[float, float]]:
    """Spans (s) of some faults, those that touch in one; a single fix is no span, its weight says what it is worth."""
    return _join((fault.t_start, fault.t_end) for fault in found if fault.count > 1)


def _join(spans: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    out: list[tuple[float, float]] = []
    for a, b in sorted(spans):
        if out and a <= out[-1][1] + SAME_TIME:
            out[-1] = (out[-1][0], max(b, out[-1][1]))
        else:
            out.append((a, b))
    return out


def without_excluded(recording: Recording, noise: NoiseModel) -> Recording:
    """The recording without the fixes that a noise model leaves out."""
    gnss = recording.gnss
    assert gnss is not None
    p, v = (row_weights(gnss.t, noise, name)[:, None] for name in ("gnss_position", "gnss_velocity"))
    gnss = replace(
        gnss,
        llh=np.where(p > 0.0, gnss.llh, np.nan),
        v=None if gnss.v is None else np.where(v > 0.0, gnss.v, np.nan),
    )
    return replace(recording, gnss=gnss)
