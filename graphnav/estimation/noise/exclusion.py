"""Fault detection and exclusion: which measurements are wrong for a span of time, decided by evidence.

Detection. A bank of likelihood-ratio tests (`graphnav.estimation.faults.watch`) gives the spans in which fixes
disagree with all other measurements by an error that persists. It does not tell which sensor is wrong.

Decision. With the noise model as it is, each span is explained by several models, each with its own likelihood of the
innovations from the start of the span to the start of the next one:

    none        nothing is wrong: errors have the tails that they have elsewhere
    fixes       positions, velocities or both have one unknown error in common, which may grow linearly, beside which
                single ones may be outliers, or an unknown error each
    wheels      the non-holonomic constraint and the odometer have one such error in common
    IMU         single intervals have more noise, those that the smoother needs it for

An unknown error has a zero-mean Gaussian prior, as wide as such errors get (`watch.SIZES`), and so has its growth; the
likelihood that this width costs is the Occam factor of the model (MacKay 1992, "Bayesian interpolation"). Where errors
are correlated from fix to fix, as those of reflections, that of each has the size that the fixes show, at a cost for
not knowing it beforehand. A fault is beforehand as improbable as a false alarm of the tests. The most probable model
decides what is left out.

Masking. Figures that are estimated with a fault among the data may have grown until they hide it, so the tests are made
with the figures at their prior medians as well. If they find more, the figures are estimated again without these spans.
Unless these explain the rest better than the figures found, beyond chance, nothing was masked. Each set of spans that
comes up on the way is decided by these figures, and the decision with the largest evidence stands. All that is done
once more, as the spans shrink to what is wrong, unless the figures lose more evidence inside them than they
gain outside. If no fault is left, the estimate that uses all measurements and starts from these figures is a candidate.

Segments. A filter follows an error that lasts, so the tests find its beginning, and its end as the beginning of
another. So with the figures estimated without them the ends of all suspected spans divide the drive into segments, and
those that are wrong together by the evidence (`graphnav.estimation.faults.segments`) are one more set of spans, if one
of them was not suspected.

Before or after. The tests run forward in time, so where fixes step from one place to another those behind the step are
suspected, though those before it may be the wrong ones. So the fixes before each span that is left out, for as long,
are suspected instead, the same way, and the likeliest stands, of both and of the estimate with all measurements. Where
that leaves other spans out, so are the fixes before these. An estimate without the fixes before that explains the rest
no better than what stands has lost: those fixes agree with the latter, and would have to be explained as wrong.
Which part of a drive is right is decided at the end (`graphnav.estimation.noise.rivals`).
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from graphnav.core.beside import begin_beside
from graphnav.estimation.faults.watch import FALSE_ALARM
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.decision import (
    Decision,
    add_outliers,
    explain,
    list_explanations,
    log_evidence,
    weigh_evidence,
    weigh_rest,
)
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.explanations import FIXES
from graphnav.estimation.noise.model import INTERVALS, NoiseModel
from graphnav.estimation.noise.moments import collect_imu_moments
from graphnav.estimation.noise.outliers import may_pay
from graphnav.estimation.noise.readmission import readmit
from graphnav.estimation.noise.rivals import choose_likeliest
from graphnav.estimation.noise.spans import (
    Span,
    are_covered,
    join,
    list_before,
    list_distinct,
    sum_lengths,
    trim,
)
from graphnav.estimation.noise.suspects import (
    cut_at_steps,
    find_segments,
    find_suspects,
    list_fix_times,
    predict_left_out,
)
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN

_REFINEMENTS = 2  # estimates without masked spans: the first trims the spans, the second is free of what is wrong


def estimate_without_faults(
    base: Problem,
    found: NoiseEstimate,
    opening: float | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> NoiseEstimate:
    """Estimate the noise model without the spans of wrong measurements that the evidence leaves out.

    Parameters
    ----------
    base : built with stated noise and the parts of its intervals' noise.
    found : with all measurements.
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.

    Raises
    ------
    EstimationError
        If the filter breaks down.
    """
    decision = decide_faults(base, found)
    passes = found.passes + decision.passes
    if not decision.noise.excluded:
        # estimated anew, the figures of the decision may lead to a worse optimum than before
        best = max(found, decision.estimate or found, key=lambda one: one.log_evidence)
        return replace(best, passes=passes)
    best = _estimate_without(base, opening, decision, found, progress)
    passes = passes + best.passes
    candidates = [weigh_evidence(base, replace(one, passes=Counter())) for one in (found, best)]
    passes = sum((one.passes for one in candidates), passes)
    leading, suspected = candidates[-1], list[Span]()
    while excluded := _list_spans(leading):
        before, suspected = suspected, list_before(excluded, list_fix_times(base))
        if not suspected or suspected == before:
            break
        other = None
        with contextlib.suppress(*BREAKDOWN):  # from a filter that follows the wrong fixes
            other, more = _estimate_other(base, opening, found, leading, suspected, progress)
            passes = passes + more
        if other is None:
            break
        other = weigh_evidence(base, replace(other, passes=Counter()))
        passes = passes + other.passes
        candidates.append(other)
        if log_evidence(base, other) <= log_evidence(base, leading):
            break
        leading = other
    return replace(max(candidates, key=lambda one: log_evidence(base, one)), passes=passes)


def _estimate_other(
    base: Problem,
    opening: float | None,
    found: NoiseEstimate,
    best: NoiseEstimate,
    suspected: list[Span],
    progress: Callable[[str, float], None] | None,
) -> tuple[NoiseEstimate | None, Counter[str]]:
    """Estimate without other suspected spans, None if the result is the same as before; and passes.

    Parameters
    ----------
    found : with all measurements.
    best : without the spans that were suspected before.
    """
    excluded = _list_spans(best)
    apart = len(join([*excluded, *suspected])) == len(excluded) + len(suspected)
    decision = _unmask(base, found, Decision(best.noise, -np.inf), suspected, best if apart else None)
    if decision.noise.excluded == best.noise.excluded:
        return None, decision.passes
    if not decision.noise.excluded:
        return decision.estimate, decision.passes
    other = _estimate_without(base, opening, decision, found, progress)
    return other, decision.passes + other.passes


def _estimate_without(
    base: Problem,
    opening: float | None,
    decision: Decision,
    found: NoiseEstimate,
    progress: Callable[[str, float], None] | None,
) -> NoiseEstimate:
    """Estimate without the spans of a decision, and decide again at their ends."""
    # figures estimated with the fault among the data are far from their final values, and the priors are nearer
    starts = [NoiseModel(weights=decision.noise.weights, excluded=decision.noise.excluded), decision.noise]
    if decision.estimate is not None:
        starts.reverse()
    near = (decision.estimate or found).get_linearisation(base)
    estimate = weigh_evidence(base, estimate_noise(base, opening, starts[0], near, progress))
    if log_evidence(base, estimate) + estimate.gained_by_chance < decision.log_evidence:
        # a worse optimum than the one that the decision is near
        other = weigh_evidence(base, estimate_noise(base, opening, starts[1], near, progress))
        best = max(estimate, other, key=lambda one: log_evidence(base, one))
        estimate = replace(best, passes=estimate.passes + other.passes)
    return readmit(base, estimate)


def _list_spans(found: NoiseEstimate | Decision) -> list[Span]:
    """Spans of fixes that are left out."""
    return join(span for kind in FIXES for span in found.noise.excluded.get(kind, ()))


def decide_faults(base: Problem, found: NoiseEstimate) -> Decision:
    """Decide which spans of measurements are wrong.

    Parameters
    ----------
    base : built with stated noise.
    found : estimated with all measurements.
    """
    medians = {name: replace(figure, log_factor=figure.prior) for name, figure in found.noise.figures.items()}
    masking = begin_beside(partial(find_suspects, base, NoiseModel(medians), found))
    suspects = find_suspects(base, found.noise, found)
    first = explain(base, found, suspects)
    masked = masking.get_result()
    first = replace(first, passes=first.passes + Counter(filter=2))
    return first if are_covered(masked, _list_spans(first)) else _unmask(base, found, first, masked)


def _unmask(
    base: Problem, found: NoiseEstimate, first: Decision, masked: list[Span], known: NoiseEstimate | None = None
) -> Decision:
    """Decide by figures that are estimated without spans which the figures found may mask.

    Parameters
    ----------
    first : by the figures found; it stands unless another has more evidence.
    masked : spans of fixes that are suspected besides those of the first.
    known : an estimate that uses these; it stands where it explains the rest better, too.
    """
    best, estimate, spans, passes, gain = first, found, masked, first.passes, np.inf
    start = NoiseModel(found.noise.figures, found.noise.times, excluded=dict.fromkeys(FIXES, tuple(masked)))
    for _ in range(_REFINEMENTS):
        estimate = estimate_noise(base, None, start, estimate.get_linearisation(base))
        if spans is masked and known is not None:
            passes = passes + Counter(filter=1)
            if estimate.log_evidence <= _weigh_beside(base, known, masked):
                return replace(first, passes=passes + estimate.passes)
        elif spans is masked and np.isfinite(first.log_evidence):
            gain = estimate.log_evidence - weigh_rest(base, found, estimate.noise.excluded)
            passes = passes + Counter(filter=1)
            if gain <= estimate.gained_by_chance:
                return _use_all(base, first, estimate, passes + estimate.passes)
        used = apply_noise(base, estimate.noise)
        errors = predict_left_out(used, estimate)
        detected = find_suspects(base, replace(estimate.noise, excluded={}), estimate)
        passes = passes + estimate.passes + Counter(filter=1)
        spans, refined = trim(spans, errors), trim(detected, errors)
        # a slow onset is dated better by the tests, an abrupt end by the errors of single fixes
        segments, spent = find_segments(base, estimate, [*detected, *refined])
        passes = passes + Counter(filter=spent)
        most = -np.inf
        for some in [*list_distinct(spans, trim(spans, errors, FALSE_ALARM), detected), segments]:
            if not some:
                continue
            candidate = explain(base, add_outliers(estimate, errors, some), some, least=best.log_evidence)
            candidate, passes = replace(candidate, estimate=estimate), passes + candidate.passes
            cut = cut_at_steps(some, candidate.noise, used, estimate)
            if cut != some:
                among = list_explanations(candidate.noise)  # its pieces are wrong the same way, or not at all
                finer = explain(base, add_outliers(estimate, errors, cut), cut, among, best.log_evidence)
                finer, passes = replace(finer, estimate=estimate), passes + finer.passes
                candidate = max(candidate, finer, key=lambda one: one.log_evidence)
            most = max(most, candidate.log_evidence)
            if candidate.log_evidence > best.log_evidence:
                best = candidate
        if sum_lengths(detected) > 2.0 * sum_lengths(masked):  # more fixes seem wrong outside the span than inside
            break
        if not refined:  # single outliers and no fault
            kept = _use_all(base, first, estimate, passes)
            passes = kept.passes
            if kept.log_evidence > first.log_evidence:
                return kept
        # figures that lose more inside the spans than they gain outside: these are of good measurements
        if not refined or refined == spans or first.log_evidence - most > gain:
            break
        spans, start = refined, replace(start, excluded=dict.fromkeys(FIXES, tuple(refined)))
    if best.estimate is not None and not best.noise.excluded:  # the figures that go with these outliers
        free = estimate_noise(base, None, best.noise, best.estimate.get_linearisation(base))
        return Decision(free.noise, best.log_evidence, passes + free.passes, free)
    return replace(best, passes=passes)


def _weigh_beside(base: Problem, known: NoiseEstimate, spans: list[Span]) -> float:
    """The logarithm of the evidence that an estimate has of the measurements outside of some spans that it uses."""
    excluded = dict(known.noise.excluded)
    rest = weigh_rest(base, known, excluded | {name: (*excluded.get(name, ()), *spans) for name in FIXES})
    return rest + log_evidence(base, known) - known.log_evidence


def _use_all(base: Problem, first: Decision, estimate: NoiseEstimate, passes: Counter[str]) -> Decision:
    """The first decision, or the estimate with all measurements that starts from one without some, if likelier."""
    free = estimate_noise(base, None, replace(estimate.noise, excluded={}), estimate.get_linearisation(base))
    passes = passes + free.passes
    if free.log_evidence > first.log_evidence:
        return Decision(free.noise, free.log_evidence, passes, free)
    return replace(first, passes=passes)


def estimate_disturbed_intervals(base: Problem, found: NoiseEstimate) -> NoiseEstimate:
    """Estimate the noise model with more noise for single intervals of the IMU.

    An IMU that loses samples for a moment makes fixes look wrong. So where spans are left out, all measurements are
    explained again with such intervals instead, and the explanation with the larger evidence stands.

    Parameters
    ----------
    base : built with stated noise and the parts of its intervals' noise.
    found : with all intervals alike.
    """
    return choose_likeliest(base, _disturb_intervals(base, found))


def _disturb_intervals(base: Problem, found: NoiseEstimate) -> NoiseEstimate:
    """The same before it is decided which part of a drive is right."""
    found = weigh_evidence(base, found)
    start, near, passes = found.noise, found.get_linearisation(base), found.passes
    if not found.noise.excluded and not _may_be_disturbed(base, found):
        return found
    if found.noise.excluded:
        free = estimate_noise(base, None, replace(found.noise, excluded={}), near, intervals=True)
        decision = explain(base, free, find_suspects(base, free.noise, free))
        passes = passes + free.passes + decision.passes + Counter(filter=1)
        if decision.noise.excluded or decision.log_evidence > free.log_evidence + free.gained_by_chance:
            # without an exclusion, figures that go with the outliers of the decision
            again = replace(free.noise, excluded=decision.noise.excluded) if decision.noise.excluded else decision.noise
            free = estimate_noise(base, None, again, free.get_linearisation(base), intervals=True)
            free = weigh_evidence(base, free)
            passes = passes + free.passes
        if log_evidence(base, free) > log_evidence(base, found):
            return replace(free, passes=passes)
        if free.noise.excluded == found.noise.excluded:  # the same model, already converging
            start, near = free.noise, free.get_linearisation(base)
        elif not _may_be_disturbed(base, found):
            return replace(found, passes=passes)
    disturbed = weigh_evidence(base, estimate_noise(base, None, start, near, intervals=True))
    passes = passes + disturbed.passes
    if log_evidence(base, disturbed) <= log_evidence(base, found):
        return replace(found, passes=passes)
    # from the priors: figures estimated with all intervals alike may be far from their final values
    anew = NoiseModel(weights=disturbed.noise.weights, excluded=disturbed.noise.excluded)
    other = estimate_noise(base, None, anew, disturbed.get_linearisation(base), intervals=True)
    other = weigh_evidence(base, other)
    best = max(disturbed, other, key=lambda one: log_evidence(base, one))
    return replace(best, passes=passes + other.passes)


def _may_be_disturbed(base: Problem, found: NoiseEstimate) -> bool:
    """Whether more noise for single intervals may gain more than it costs; seldom, and estimating it takes passes."""
    points, problem = found.points, apply_noise(base, found.noise)
    imu = collect_imu_moments(problem, points.states.R_nb[:-1], points)
    return any(may_pay(imu.squared[:, i], imu.freedom[:, i]) for i in range(len(INTERVALS)))
