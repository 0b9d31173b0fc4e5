"""Stops and wrong fixes of a running drive, decided by the evidence of a window before it settles.

The window is solved once more in a thread, from its oldest keyframe and with the noise model in use. Where that decides
otherwise than detectors and tests did, a second tracker processes the unsettled keyframes. Nothing settles before.

Stops are contradicted as `graphnav.estimation.noise.false_stops` has it: four seconds after a stop began, and whenever
it is twice as old, up to half of the lag. Spans of fixes that the filter's tests have left out since evidence decided
last are explained as `graphnav.estimation.noise.decision` has it, once they are half of the lag old and over for a
quarter, or three quarters old. Where they last, what was used before may be wrong instead, and the filter has nothing
but the IMU: that is asked as of stops, and what is decided may be asked again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.gnss import GnssPosition
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.detectors.base import NONE, subtract_spans
from graphnav.estimation.contradictions import free
from graphnav.estimation.faults.excluded import weigh_rows
from graphnav.estimation.faults.watch import FALSE_ALARM
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.decision import Decision, explain
from graphnav.estimation.noise.estimate import NoiseEstimate
from graphnav.estimation.noise.exclusion import add_outliers
from graphnav.estimation.noise.explanations import FIXES
from graphnav.estimation.noise.false_stops import find_false_stops, leave_out_false_stops, unite_stops
from graphnav.estimation.noise.model import NoiseModel, RowWeights
from graphnav.estimation.noise.moments import collect_row_moments
from graphnav.estimation.noise.outliers import compute_row_costs, list_reduced
from graphnav.estimation.noise.spans import Span, drop_within, join, join_faults, list_distinct, mask_times, trim
from graphnav.estimation.noise.suspects import find_suspects, predict_left_out
from graphnav.estimation.noise.tails import get_tail_index, weigh_outlying
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solution import ExcludedSpan
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.passes import SmootherPass, reuse_points
from graphnav.estimation.solvers.rts import smooth_backward, smooth_moments
from graphnav.online.around import ROWS_AFTER, compute_error_units, cut_around
from graphnav.online.noise_estimation import BackgroundEstimation, CatchUp, limit_thought
from graphnav.online.raw import drop_ambiguities
from graphnav.online.sensors import Sensors
from graphnav.online.tracker import Tracker
from graphnav.recording import Recording

_FIRST = 4.0  # s after its beginning at which a stop is judged first
_OLDEST = 0.5  # of the lag, the age at which a stop is judged last, and fixes that tests have left out at first
_OVER = 0.25  # of the lag, for which these should be in use again: of a fault too new, evidence knows too little
_THINKING = 0.25  # of the time that an estimation of the noise model may take: one filter and smoother


@dataclass(frozen=True)
class Judgement:
    """What evidence decides of a window."""

    false_stops: Array  # (n, 2) s, stops in which the platform moves
    decided: NoiseModel | None  # with what is wrong left out and the weights of what is right, if that was asked


@dataclass(frozen=True)
class WindowTask:
    """The rows of a window, what is known at its oldest keyframe, its stops, and fixes that are suspected."""

    recording: Recording
    settings: Settings
    frame: LocalFrame
    times: Array  # (K,) s, keyframes
    start: States  # at the first of them
    sigma: Array  # (15,)
    settled: bool  # whether the rows of the first are in that already
    units: Array | None  # (M, 3) m, of the errors of fixes that last for seconds
    unit: Array  # (3,) m, of those that last for minutes and hours
    noise: NoiseModel
    stationary: Array  # (M, 2) s
    suspects: list[Span]  # s
    lasting: list[Span]  # s, those of them that are not over
    wrong: Mapping[str, tuple[Span, ...]]  # s, that the tests have left out

    def run(self) -> Judgement:
        """Solve the window and judge it."""

        noise = replace(self.noise, excluded=join_excluded(self.noise.excluded, self.wrong))

        def judge(one: tuple[Problem, Problem, SmootherPass, Array]) -> Array:
            base, used, smoothed, stationary = one
            return find_false_stops(base, weigh_tails(noise, used, smoothed), (smoothed, used), stationary)[0]

        false = NONE
        if len(self.stationary):
            how = partial(self._solve, noise, False)
            false = leave_out_false_stops(how(None, NONE), judge, how)[1]
        return Judgement(false, self._explain(noise, false) if self.suspects else None)

    def _explain(self, noise: NoiseModel, false: Array) -> NoiseModel:
        """What is wrong in the suspected spans, or in the part of them that fixes disagree with, by the noise model.

        Where spans last, also about a solution that uses them, what the tests find by that: points that have drifted
        for want of fixes make right ones unlikely.
        """
        decisions = self._decide(noise, false, self.suspects)
        if self.lasting:
            kept = {
                name: tuple(span for span in some if not mask_times(np.array(span), self.lasting).any())
                for name, some in noise.excluded.items()
            }
            left = join(span for some in kept.values() for span in some if span[1] > self.times[0])
            decisions += self._decide(replace(noise, excluded=kept), false, left, tested=True)
        return max(decisions, key=lambda one: one.log_evidence).noise

    def _decide(self, noise: NoiseModel, false: Array, suspects: list[Span], tested: bool = False) -> list[Decision]:
        """Decisions on suspected spans, and parts of them, about the solution with a noise model; with `tested` also on
        those that the tests find by it.
        """
        base, used, smoothed, _ = self._solve(noise, True, None, false)
        noise = weigh_tails(noise, used, smoothed)
        weighed = apply_noise(base, noise)
        forward = refilter(weighed, reuse_points(smoothed, used, weighed), whole=False)
        evidence = float(np.sum(forward.log_likelihood)) - float(np.sum(compute_row_costs(weighed, noise.tails)))
        found = NoiseEstimate(noise, smooth_moments(weighed, forward), 0.0, evidence, Counter())
        errors = predict_left_out(weighed, found)
        # what is left out beside the suspects, such as single fixes, is an outlier
        found = add_outliers(found, errors, join(span for some in noise.excluded.values() for span in some))
        if tested:
            suspects = join([*suspects, *find_suspects(base, noise, found)])
        candidates = list_distinct(suspects, trim(suspects, errors), trim(suspects, errors, FALSE_ALARM))
        return [explain(base, found, some) for some in candidates]

    def _solve(
        self, noise: NoiseModel, standing: bool, _: object, false: Array
    ) -> tuple[Problem, Problem, SmootherPass, Array]:
        """The window without false stops, with stated noise; as it is solved, and its solution; and the stops.

        Unless `standing` it never stands: a false stop would lead the points astray at which true ones are judged.
        """
        stationary = subtract_spans(self.stationary, false)
        base = build_problem(
            self.recording, self.settings, self.frame, self.start, self.sigma, stationary, self.times,
            typical=self.units, parts_of_noise=True,
        )  # fmt: skip
        rows = (replace(c, drive_error=self.unit) if isinstance(c, GnssPosition) else c for c in base.constraints)
        base = replace(base, constraints=tuple(rows))
        if self.settled:
            base = weigh_rows(base, {c.name: (c.keyframe > 0).astype(float) for c in base.constraints})
        base = free(base, noise.freed)
        used = apply_noise(base, noise)
        if not standing:
            used = weigh_rows(used, {c.name: np.zeros(len(c)) for c in used.constraints if c.of_stops})
        return base, used, smooth_backward(used, ekf(used)), stationary


def weigh_tails(noise: NoiseModel, used: Problem, smoothed: SmootherPass) -> NoiseModel:
    """The noise model with weights for rows in the tails since it was estimated: one wrong fix outweighs a stop."""
    weights = dict(noise.weights)
    for rows in used.constraints:
        if rows.list_noise_groups()[0] and not rows.of_stops and len(rows):
            left_out, m = collect_row_moments(rows, smoothed.take_rows(rows, used.columns)).left_out, len(rows.axes)
            before = np.ones(len(rows)) if rows.weight is None else rows.weight
            weight = np.minimum(before, weigh_outlying(left_out, m, get_tail_index({}, rows.name, m)))
            weights[rows.name] = list_reduced(used.t[rows.keyframe], weight, before > 0.0)
    return replace(noise, weights=weights)


class WindowJudge:
    """Judges the stops in the window, each again when it is twice as old, and the fixes that tests have left out."""

    def __init__(self) -> None:
        self._begun = self._done = -np.inf  # s, the newest keyframe of the last judgement, and of the last result
        # s, up to where spans that tests have left out were judged, and will be once the running judgement is done
        self._explained = self._explains = -np.inf
        self._asked = -np.inf  # s, the newest keyframe when fixes were judged last
        self._lasting = False  # whether only because some last, and these can be judged again
        self._running: BackgroundEstimation | None = None

    def holds(self, tracker: Tracker) -> bool:
        """Whether a stop has not been judged yet, or a span of fixes, and nothing may settle that depends on it."""
        stops = bool(np.any(tracker.stops[:, 0] > self._done - _FIRST))
        return _can_judge(tracker) and (stops or bool(self._list_old(tracker, _OLDEST)))

    def _list_old(self, tracker: Tracker, age: float, over: float = np.inf) -> list[ExcludedSpan]:
        """Spans that tests have left out, of such an age in lags, which have not been judged: not at all, or not to
        their ends, which are before a time, s.
        """
        since, until = max(self._explained, tracker.judged), tracker.newest - age * tracker.settings.solver.lag
        return [
            f
            for f in _list_tested(tracker)
            if f.t_start <= until and (f.t_start > since if over == np.inf else since < f.t_end <= over)
        ]

    def look(self, sensors: Sensors, tracker: Tracker, last: bool = False) -> CatchUp | None:
        """Start to judge what is due of a tracker, or take the result; returns the tracker without what is wrong and
        with what is right, if that is something else than before, which has to catch up.

        Parameters
        ----------
        last : whether no more rows will come: nothing is waited for.
        """
        lag, now = tracker.settings.solver.lag, tracker.newest
        if self._running is None:
            age, before = now - tracker.stops[:, 0], np.maximum(self._begun - tracker.stops[:, 0], 0.0)
            due = (before < _OLDEST * lag) & ((age >= np.maximum(2.0 * before, _FIRST)) | (last and now > self._begun))
            youngest, until = (_OVER, now) if last else (_OLDEST, now - _OVER * lag)
            over = self._list_old(tracker, youngest, until) or self._list_old(tracker, _OLDEST + _OVER)
            shut = not over and any(_is_due(f, now, self._asked) for f in _list_tested(tracker, lasting=True))
            if not _can_judge(tracker) or not (due.any() or over or shut):
                return None
            task = _describe(sensors, tracker, bool(due.any()), bool(over) or shut)
            self._running = BackgroundEstimation(task, now + _THINKING * limit_thought(lag))
            self._begun = now
            if task.suspects:
                self._asked = now
            young = [f.t_start - SAME_TIME for f in _list_tested(tracker) if f.t_start > now - youngest * lag]
            self._explains = float(task.times[-1]) if shut else min([now - _OVER * lag, *young])
            self._lasting = shut
        if not last and now < self._running.due:
            return None
        running, self._running, self._done = self._running, None, self._begun
        until = self._explains
        known = running.task.noise.figures == tracker.noise.figures  # else by figures that are no longer in use
        if not known:
            self._asked = -np.inf
        elif running.task.suspects and not self._lasting:
            self._explained = until
        try:
            found = running.wait()
        except BREAKDOWN:
            return None
        noise, judged = tracker.noise, -np.inf
        if found.decided is not None and known and until > tracker.judged:
            excluded = {n: tuple(s for s in spans if s[0] <= until) for n, spans in found.decided.excluded.items()}
            excluded = join_excluded(noise.excluded, excluded)
            if not _are_alike(tracker, excluded, until):
                within = [(float(running.task.times[0]), until)]
                weights = {
                    n: _replace_within(noise.weights.get(n), found.decided.weights.get(n), within) for n in FIXES
                }
                noise, judged = replace(noise, excluded=excluded, weights={**noise.weights, **weights}), until
        if len(found.false_stops):
            noise = replace(noise, false_stops=unite_stops(noise.false_stops, found.false_stops))
        return None if noise is tracker.noise else CatchUp(tracker.restart_settled(noise, sensors.setup, judged))


def _are_alike(tracker: Tracker, excluded: Mapping[str, tuple[Span, ...]], until: float) -> bool:
    """Whether a tracker leaves out the same up to a time (s), but for single fixes."""
    before = join_excluded(tracker.noise.excluded, _list_spans(_list_tested(tracker)))
    if any(before.get(name) != spans for name, spans in excluded.items() if name not in FIXES):
        return False
    times = ((name, t[(t > tracker.head) & (t <= until)]) for name, t in tracker.verdicts.times.items())
    return all(
        np.array_equal(mask_times(t, before.get(name, ())), mask_times(t, excluded.get(name, ()))) for name, t in times
    )


def _list_tested(tracker: Tracker, lasting: bool = False) -> list[ExcludedSpan]:
    """Spans of fixes that tests have left out, or those that last; single ones make no difference."""
    newest = {name: t[-1] for name, t in tracker.verdicts.times.items() if len(t)}
    found = (f for f in tracker.verdicts.list_faults() if f.count > 1 and f.kind in FIXES)
    return [f for f in found if not lasting or f.t_end == newest[f.kind]]


def _is_due(fault: ExcludedSpan, now: float, asked: float) -> bool:
    """Whether a span is to be judged now, s, if spans were last at another time: early, and when it is twice as old."""
    return now - fault.t_start >= max(2.0 * (asked - fault.t_start), _FIRST)


def _list_spans(faults: Iterable[ExcludedSpan]) -> dict[str, tuple[Span, ...]]:
    out: dict[str, tuple[Span, ...]] = {}
    for fault in faults:
        out[fault.kind] = (*out.get(fault.kind, ()), (fault.t_start, fault.t_end))
    return out


def _replace_within(some: RowWeights | None, others: RowWeights | None, spans: list[Span]) -> RowWeights:
    """Weights with those in some spans replaced."""
    none = RowWeights(np.empty(0), np.empty(0))
    kept, others = drop_within(some or none, spans), others or none
    inside = mask_times(others.t, spans)
    t, weight = np.append(kept.t, others.t[inside]), np.append(kept.weight, others.weight[inside])
    order = np.argsort(t, kind="stable")
    return RowWeights(t[order], weight[order])


def join_excluded(
    some: Mapping[str, tuple[Span, ...]], others: Mapping[str, tuple[Span, ...]]
) -> dict[str, tuple[Span, ...]]:
    """What is left out by either, by constraint."""
    return {name: tuple(join([*some.get(name, ()), *others.get(name, ())])) for name in {**some, **others}}


def _can_judge(tracker: Tracker) -> bool:
    """Whether there is a noise model to judge by."""
    return not tracker.foot and bool(tracker.noise.figures)


def _describe(sensors: Sensors, tracker: Tracker, stops: bool, fixes: bool) -> WindowTask:
    times, head, noise = tracker.times, tracker.window.head, tracker.noise
    if stops:  # behind these a stop may go on: fixes there are no more to be believed than those in it
        times = times[times <= tracker.detected_until + SAME_TIME]
    recording = cut_around(sensors, float(times[0]), float(times[-1]) + ROWS_AFTER)
    head = head.move(head.estimate)
    left_out = tracker.excluded
    return WindowTask(
        recording,
        drop_ambiguities(tracker.settings, sensors.setup),
        tracker.frame,
        times,
        head.state,
        np.sqrt(np.diag(head.covariance)[:DIM]),
        tracker.opened,
        compute_error_units(sensors, recording),
        sensors.gnss.compute_unit(),
        noise,
        tracker.stops,
        join_faults(f for f in left_out if f.t_end > times[0] and f.kind in FIXES) if fixes else [],
        join_faults(_list_tested(tracker, lasting=True)) if fixes else [],
        _list_spans(left_out),
    )
