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
    rows        single rows there have the weights that were found, as those of the others where one sensor is wrong

An unknown error has a Gaussian prior about zero, as wide as such errors get (`watch.WIDE`), and so has its growth; what
that width costs in likelihood is the cost of the explanation (MacKay 1992, "Bayesian interpolation": the Occam factor).
A fault is also as rare beforehand as the tests take it to be, an outlier among intervals or rows as rare as `CHANCE`.
The best model decides what is left out.

Figures that are estimated with a fault in the data may have grown until they hide it. So the tests are made with the
prior medians of the figures as well. Where they find something else, the figures are estimated without it, from those
found on, twice, as the spans come to what is wrong; each span is decided with these, as the tests date it and as its
rows do, and of these explanations of all measurements the likeliest stands. Where these figures know of no span at all,
another is that all is right, by figures that set out from them. What is right at the ends of a span that is left out
shows once it is, and is taken back where that is likelier.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.estimation import faults
from graphnav.estimation.noise.apply import row_weights, with_noise
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.explanations import FIXES, ONE_SENSOR, ROWS, WHEELS, WRONG, Kinds, evidence, mask_within
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, RowWeights
from graphnav.estimation.noise.moments import row_moments
from graphnav.estimation.noise.outliers import CHANCE, limit_squares
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ExcludedSpan
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.passes import SmootherPass, points_of, values_of
from graphnav.estimation.solvers.watch import FALSE_ALARM
from graphnav.recording import Recording

_SINGLE = INTERVALS, ROWS  # outliers: nothing is left out for them
_ODDS = -float(np.log(FALSE_ALARM))  # by which a fault is less likely beforehand than none
_SHRINKS = 2  # estimates without a fault: by the first, the span comes to what is wrong; the second is without that
_OUTLIER = -float(np.log(CHANCE))  # the same of one row, and of one interval of the IMU


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
    anew = NoiseModel(weights=explained.noise.weights, excluded=explained.noise.excluded)
    again = estimate_noise(base, opening, anew, (found.points, with_noise(base, found.noise)), progress)
    return _readmit(base, replace(again, passes=found.passes + again.passes, looks=found.looks))


def _readmit(base: Problem, found: NoiseEstimate) -> NoiseEstimate:
    """Without what is right at the ends of spans left out, now that they are, if that is likelier."""
    used = with_noise(base, found.noise)
    spans = _join(span for some in found.noise.excluded.values() for span in some)
    surprise = _measure_surprise(used, found.points)
    narrow = trim_spans(spans, surprise, FALSE_ALARM)
    if not narrow or narrow == spans:
        return found
    among = _list_explanations(found.noise)
    with_all, without = (decide(base, with_weights(found, surprise, some), some, among) for some in (spans, narrow))
    looks = found.looks + with_all.looks + without.looks
    if without.log_evidence <= with_all.log_evidence:
        return replace(found, looks=looks)
    again = estimate_noise(base, None, without.noise, (found.points, used))
    return replace(again, passes=found.passes + again.passes, looks=looks)


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
    whole = decide(base, found, spans, _list_explanations(found.noise)).log_evidence if spans else found.log_posterior
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
    without = NoiseModel(found.noise.figures, found.noise.times, excluded=dict.fromkeys(FIXES, tuple(hidden)))
    left_out = _join(span for kind in FIXES for span in one.noise.excluded.get(kind, ()))
    if all(any(a <= begin and end <= b for a, b in left_out) for begin, end in hidden):
        return replace(one, looks=one.looks + 2)
    other, spans, passes, looks = found, hidden, 0, one.looks + 2
    best, leading = one, found
    for _ in range(_SHRINKS):
        other = estimate_noise(base, None, without, (other.points, with_noise(base, other.noise)), changed=True)
        alone = _measure_surprise(with_noise(base, other.noise), other.points)
        again = find_spans(base, replace(other.noise, excluded={}), other)
        passes, looks = passes + other.passes, looks + 1
        spans, refined = trim_spans(spans, alone), trim_spans(again, alone)
        # what begins slowly is dated better by the tests, what ends at once by the rows
        for some in _list_distinct(spans, trim_spans(spans, alone, FALSE_ALARM), again):
            candidate = decide(base, with_weights(other, alone, some), some)
            looks += candidate.looks
            if candidate.log_evidence > best.log_evidence:
                best, leading = candidate, other
        if _length(again) > 2.0 * _length(hidden):  # more seems wrong outside than inside: the filter is lost
            break
        if not refined:  # by figures that they have not led astray there are single outliers and no more
            near = other.points, with_noise(base, other.noise)
            free = estimate_noise(base, None, replace(other.noise, excluded={}), near)
            passes += free.passes
            if free.log_evidence > one.log_evidence:
                return Explained(free.noise, free.log_evidence, passes, looks, free)
        if not refined or refined == spans:
            break
        spans, without = refined, replace(without, excluded=dict.fromkeys(FIXES, tuple(refined)))
    if best is not one and not best.noise.excluded:  # outliers, each by itself: with the weights that say so
        near = leading.points, with_noise(base, leading.noise)
        free = estimate_noise(base, None, best.noise, near)
        return Explained(free.noise, best.log_evidence, passes + free.passes, looks, free)
    return replace(best, passes=passes, looks=looks)


def _list_distinct(*some: list[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    """Each list of spans once, and none that is empty."""
    return [list(spans) for spans in dict.fromkeys(tuple(spans) for spans in some) if spans]


def _length(spans: list[tuple[float, float]]) -> float:
    """s"""
    return sum(end - begin for begin, end in spans)


Surprise = Mapping[str, tuple[Array, Array, int]]  # by constraint, (N,) s, (N,) squared errors, degrees of freedom


def trim_spans(spans: list[tuple[float, float]], alone: Surprise, chance: float = CHANCE) -> list[tuple[float, float]]:
    """Spans (s) without what is right at their ends: fixes where a smoother that does not use them has them.

    Tests that go forward in time leave out too much: they date a fault from one of a few onsets, and what comes after
    it is met by a filter that has been led astray. Of each span that part is kept in which most more is wrong than
    right: a row adds half of what its squared error exceeds the limit by, at most what it costs to be an outlier by
    itself.

    Parameters
    ----------
    alone : the fixes as that smoother has them.
    chance : of a right one beyond the limit.
    """
    all_t = [t for t, _, _ in alone.values()]
    t, number = np.unique(np.concatenate(all_t), return_inverse=True)
    gain = np.full(len(t), -np.inf)
    each = [np.minimum(0.5 * (x - float(chdtri(m, chance))), _OUTLIER) for _, x, m in alone.values()]
    np.maximum.at(gain, number, np.concatenate(each))  # what one kind of fix says is wrong, is
    parts = ((t[within], gain[within]) for within in (mask_within(t, [span]) for span in spans))
    return [part for some, gained in parts if (part := _find_likeliest(some, gained)) is not None]


def _find_likeliest(t: Array, gain: Array) -> tuple[float, float] | None:
    """First and last time of the part with the largest sum of gains (N,), if that is above zero (Kadane)."""
    before = np.concatenate([[0.0], np.cumsum(gain)])
    least = np.minimum.accumulate(before)
    end = int(np.argmax(before - least))
    begin = int(np.argmin(before[: end + 1]))
    return (float(t[begin]), float(t[end - 1])) if end > begin else None


def with_weights(found: NoiseEstimate, alone: Surprise, spans: list[tuple[float, float]]) -> NoiseEstimate:
    """The estimate with weights for fixes in spans that it leaves out, so that each may be an outlier by itself."""
    weights = dict(found.noise.weights)
    for name, (t, squared, m) in alone.items():
        weight = limit_squares(squared, m)
        kept = _outside(weights.get(name, RowWeights(np.empty(0), np.empty(0))), spans)
        inside = mask_within(t, spans) & np.isin(t, t[weight < 1.0])  # with all rows of their times
        both, of_both = np.concatenate([kept.t, t[inside]]), np.concatenate([kept.weight, weight[inside]])
        order = np.argsort(both, kind="stable")
        weights[name] = RowWeights(both[order], of_both[order])
    return replace(found, noise=replace(found.noise, weights=weights))


def _measure_surprise(problem: Problem, smoothed: SmootherPass) -> Surprise:
    """Fixes, with their squared errors if they were not used."""
    fixes = (rows for rows in problem.constraints if rows.name in FIXES)
    return {
        c.name: (problem.t[c.keyframe], row_moments(problem, c, smoothed, len(c)).left_out, len(c.axes)) for c in fixes
    }


def find_spans(base: Problem, noise: NoiseModel, found: NoiseEstimate) -> list[tuple[float, float]]:
    """Spans (s) in which fixes disagree with everything else, by figures that need not be those found."""
    # a fault that rows have lost their weight for, or the IMU its own, is to be seen by the tests
    kept = {name: some for name, some in noise.weights.items() if name not in (*FIXES, *INTERVALS)}
    open_ = with_noise(base, replace(noise, weights=kept))
    known = values_of(with_noise(base, found.noise), found.points)
    watched = refilter(open_, points_of(open_, found.points.states, known), watch=True)
    return join_spans(faults.fault_spans(faults.weigh_rows(open_, watched.weights)))


def decide(
    base: Problem, found: NoiseEstimate, spans: list[tuple[float, float]], among: Collection[Kinds] = WRONG
) -> Explained:
    """Who is wrong in each span, by the figures found: nobody, or one of some explanations."""
    if not spans:
        return Explained(found.noise, found.log_posterior, 0, 0)
    noise = replace(found.noise, excluded={})
    reach = _with_next_fix(base, spans)
    outside = {name: _outside(some, reach if name in INTERVALS else spans) for name, some in noise.weights.items()}
    # outliers that an explanation has beside what it says is wrong
    beside: dict[tuple[str, ...], dict[str, RowWeights]] = {
        kinds: {name: some for name, some in noise.weights.items() if name not in (*kinds, *INTERVALS)}
        for kinds in (*ONE_SENSOR, ROWS)
    }
    beside[INTERVALS] = {name: some for name, some in noise.weights.items() if name in INTERVALS}
    used = with_noise(base, replace(noise, weights=outside))
    known = values_of(with_noise(base, found.noise), found.points)
    about = points_of(used, found.points.states, known)
    posed = {kinds: with_noise(base, replace(noise, weights=outside | some)) for kinds, some in beside.items()}
    before, likelihood, looks = evidence(used, about, spans, posed, among)
    excluded: dict[str, tuple[tuple[float, float], ...]] = {}
    total = before + found.log_prior
    dropped: dict[str, list[tuple[float, float]]] = {name: [] for name in noise.weights}
    for k, span in enumerate(spans):
        cost = np.array([0.0 if not kinds or kinds in _SINGLE else _ODDS for kinds in WRONG])
        for kinds, some in beside.items():
            within = reach[k] if kinds == INTERVALS else span
            outliers = sum(_count(one) - _count(_outside(one, [within])) for one in some.values())
            cost[WRONG.index(kinds)] += _OUTLIER * outliers if outliers or kinds not in _SINGLE else np.inf
        one = likelihood[k] - cost
        best = WRONG[int(np.argmax(one))]
        total += float(np.max(one))
        for name in noise.weights.keys() - beside.get(best, {}).keys():
            dropped[name].append(reach[k] if name in INTERVALS else span)
        if best not in _SINGLE:
            excluded |= {name: (*excluded.get(name, ()), span) for name in best}
    present = {rows.name for rows in base.constraints}
    excluded = {name: some for name, some in excluded.items() if name in present}
    weights = {name: _outside(some, dropped[name]) for name, some in noise.weights.items()}
    return Explained(replace(noise, weights=weights, excluded=excluded), total, 0, looks)


def _list_explanations(noise: NoiseModel) -> set[Kinds]:
    """Those by which a noise model leaves spans out."""
    found = set[Kinds]()
    for span in {span for some in noise.excluded.values() for span in some}:
        names = {name for name, some in noise.excluded.items() if span in some}
        found.add(WHEELS if names & set(WHEELS) else tuple(name for name in FIXES if name in names))
    return found


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
    keep = ~mask_within(some.t, spans)
    return RowWeights(some.t[keep], some.weight[keep])


def excluded_share(problem: Problem, noise: NoiseModel) -> float:
    """Share of the information of the positions that a noise model leaves out."""
    rows = next((c for c in problem.constraints if c.name == FIXES[0]), None)
    return 0.0 if rows is None else 1.0 - float(np.mean(row_weights(problem.t[rows.keyframe], noise, rows.name)))


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
