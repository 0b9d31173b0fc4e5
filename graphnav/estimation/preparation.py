"""From a recording to the problem that every solver gets: aligned, built, its noise model estimated.

In order: align, build the problem, estimate the noise model, search for spans of wrong measurements and decide each by
evidence, estimate again without them. The filter then runs causally from the start, and its smoother gives the batch
solver its first linearisation point.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.foot import Stance
from graphnav.constraints.vehicle import average_speed
from graphnav.core.beside import begin_beside
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.notes import Note
from graphnav.core.progress import Progress, tell
from graphnav.core.rotation import Array
from graphnav.detectors import Detections
from graphnav.estimation.alignment import Alignment, use_known_heading
from graphnav.estimation.building import BuiltProblem, Clock, ProblemBuilder, has_diverged
from graphnav.estimation.contradictions import describe_freed, free
from graphnav.estimation.faults.excluded import weigh_rows
from graphnav.estimation.fixing import fix, split_carriers
from graphnav.estimation.joint_estimate import JointEstimate, estimate_jointly, revise_jointly
from graphnav.estimation.noise.apply import apply_noise, are_of_others, drop_parts
from graphnav.estimation.noise.bias_walks import estimate_bias_walks
from graphnav.estimation.noise.chords import find_filled_gaps
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.false_stops import find_false_stops, leave_out_false_stops, unite_stops
from graphnav.estimation.noise.initial_points import BREAKDOWN, find_initial_points
from graphnav.estimation.noise.model import STATED, NoiseModel
from graphnav.estimation.noise.span_variances import weigh_excluded
from graphnav.estimation.noise.tails import widen_by_tails, widen_unweighted
from graphnav.estimation.noise.unmeasured import UnmeasuredRows, drop_in_gaps, drop_unmeasured
from graphnav.estimation.noise.words import describe_noise
from graphnav.estimation.problem import Problem
from graphnav.estimation.relinearisation import relinearise
from graphnav.estimation.solution import CarrierArcs
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.linearise import Points, scale_at
from graphnav.estimation.solvers.passes import (
    FilterPass,
    SmootherPass,
    reuse_points,
)
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.recording import Recording

# whether the evidence of a noise model is wanted, by the problem and the points of its estimate
Weigh = Callable[[Problem, Points], bool]

_Estimated = tuple[BuiltProblem, JointEstimate]  # a problem and the estimate on it

_MOST_WRONG = 0.5  # share of excluded fixes, beyond which the start is wrong rather than the fixes


@dataclass(frozen=True)
class Prepared:
    """What all solvers of a recording share."""

    problem: Problem  # with its noise model
    noise: NoiseModel
    start: Alignment  # of the prior: with the heading that the user states
    aligned: Alignment  # as found
    detections: Detections
    forward: FilterPass
    smoothed: SmootherPass
    notes: tuple[str, ...]
    timings: dict[str, float]
    passes: Counter[str] = field(default_factory=Counter)
    fixed: dict[str, Array] = field(default_factory=dict)  # `Solution.fixed` of the filter, and of the others ("")
    arcs: dict[str, CarrierArcs] = field(default_factory=dict)  # `Solution.arcs`, the same way
    log_evidence: float = np.inf  # of all measurements by the estimated noise model, where that is wanted
    ahead: Points | None = None  # a step of Gauss and Newton behind `smoothed`, where it is known
    unmeasured: UnmeasuredRows = field(default_factory=UnmeasuredRows)  # no part of the problem

    @property
    def diverged(self) -> bool:
        """Whether the stated start is so far from the one found that a filter from there diverges for a while."""
        return has_diverged(self.aligned, self.start)


def prepare(
    recording: Recording,
    settings: Settings,
    frame: LocalFrame,
    detections: Detections,
    noise: NoiseModel | None = None,
    progress: Progress | None = None,
    weigh: Weigh | None = None,
) -> Prepared:
    """Align a recording, build its problem and find its noise model.

    Parameters
    ----------
    detections : where the platform stands.
    noise : used as it is; when None it is estimated, or stated, according to the settings.
    weigh : whether the evidence of a noise model that is estimated is wanted; never when None.

    Raises
    ------
    EstimationError
        If the recording does not determine a trajectory.
    """
    clock, passes = Clock(), Counter[str]()
    as_stated = settings.noise.mode == "stated" if noise is None else noise == STATED
    recording, unmeasured = (recording, UnmeasuredRows()) if as_stated else drop_unmeasured(recording)
    spacing = settings.noise.spacing if noise is None else noise.spacing
    averaging = begin_beside(partial(average_speed, recording, settings))
    false_stops = np.array(() if noise is None else noise.false_stops).reshape(-1, 2)
    detections = detections.without(false_stops)
    every = ProblemBuilder(recording, recording, settings, frame, clock, averaging, false_stops)
    aligned = every.align(recording, detections.stationary)
    unaided = aligned.motion is None or not settings.gnss.position
    stated = noise is None and (settings.noise.mode == "stated" or unaided)
    larger = stated and settings.noise.mode != "stated" and recording.platform == "foot"
    if stated:
        noise, spacing = STATED, STATED.spacing
    builder, near = every.use_spaced(recording, spacing), None
    built, evidence = builder.build(aligned, detections, parts=larger or noise != STATED), np.inf
    if not as_stated:
        with contextlib.suppress(*BREAKDOWN):
            gaps, count = find_filled_gaps(apply_noise(built.problem, STATED), aligned.until)
            passes.update(filter=count, smoother=count)
            if len(gaps):
                recording, unmeasured = drop_in_gaps(recording, gaps, unmeasured)
                builder = replace(every, recording=recording).use_spaced(recording, spacing)
                built = builder.build(aligned, detections, parts=larger or noise != STATED)
    if noise is None:
        tell("noise")
        with clock.count_time("noise"):
            noise, built, evidence, near = _find_noise(builder, built, progress, passes, weigh)
            noise = replace(noise, spacing=spacing)
    else:
        if are_of_others(built.problem, noise):
            noise = widen_unweighted(built.problem, noise)
        built = builder.build_without(built, noise, parts=noise != STATED, anew=bool(noise.freed))
        built = replace(built, problem=free(built.problem, noise.freed))
    aligned = built.aligned
    problem = drop_parts(apply_noise(built.problem, noise))
    try:
        forward, smoothed = _filter_and_smooth(problem, aligned.until, None, clock, progress)
    except EstimationError:  # from a rough start its first pass may diverge
        (initial, *_), more = find_initial_points(problem, aligned.until)
        passes.update(filter=more, smoother=more)
        forward, smoothed = _filter_and_smooth(problem, aligned.until, initial.points, clock, progress)
    if larger:
        with clock.count_time("noise"):
            noise, spent = estimate_bias_walks(built.problem, smoothed)
            passes.update(spent)
        if noise.figures:
            problem = drop_parts(apply_noise(built.problem, noise))
            forward, smoothed = _filter_and_smooth(problem, aligned.until, None, clock, progress)
            passes.update(filter=1, smoother=1)
    with clock.count_time("smoother"):
        problem = _drop_refused(problem, forward)
        if any(rows.gate is not None for rows in problem.constraints):
            smoothed = smooth_backward(problem, refilter(problem, smoothed, progress), progress)
        problem = problem.with_input_noise(smoothed.states, scale_at(problem.columns, smoothed.values))
        known = None if near is None else reuse_points(*near, problem)
        forward, smoothed, ahead = relinearise(problem, aligned, forward, smoothed, progress, passes, known)
    passes.update(filter=1, smoother=1)
    notes = (*describe_freed(noise.freed, recording), *describe_noise(noise, problem), *_describe_missing(problem))
    epochs, arcs = dict[str, Array](), {"": CarrierArcs()}
    rest, carriers = (problem, built.carriers) if built.carriers is not None else split_carriers(problem)
    if carriers is not None:
        tell("ambiguities")
        with clock.count_time("ambiguities"):
            fixed = fix(rest, carriers, smoothed, aligned.until, progress)
        problem, forward, smoothed, ahead = fixed.problem, fixed.forward, fixed.smoothed, None
        notes, epochs = (*notes, *fixed.notes), {"ekf": fixed.filtered_epochs, "": fixed.smoothed_epochs}
        arcs = {"ekf": fixed.filtered_arcs, "": fixed.smoothed_arcs}
    start = use_known_heading(aligned, settings)
    return Prepared(
        problem, noise, start, aligned, built.detections, forward, smoothed, notes, clock.seconds, passes, epochs, arcs,
        evidence, ahead, unmeasured,
    )  # fmt: skip


def _describe_missing(problem: Problem) -> tuple[str, ...]:
    """A doubt on a walk that nothing but the IMU tells of."""
    recording = problem.recording
    if recording.platform != "foot" or recording.placed or any(c.name == Stance.name for c in problem.constraints):
        return ()
    words = "no stance was found, and without one errors grow as the square of time: is the IMU on a foot?"
    return (Note("doubt.stances", f"This result cannot be trusted: {words}"),)


def _filter_and_smooth(
    problem: Problem, opening: float | None, known: Points | None, clock: Clock, progress: Progress | None
) -> tuple[FilterPass, SmootherPass]:
    """Filter, with its opening linearised at known points if there are any, and smooth."""
    forward = ekf(problem, progress, opening, known)  # its own solution has the time it takes
    with clock.count_time("smoother"):
        smoothed = smooth_backward(problem, forward, progress)
    return forward.drop_covariances(), smoothed


def _find_noise(
    builder: ProblemBuilder,
    built: BuiltProblem,
    progress: Progress | None,
    passes: Counter[str],
    weigh: Weigh | None,
) -> tuple[NoiseModel, BuiltProblem, float, tuple[Points, Problem]]:
    """The noise model, the problem with a start and stops that rest on no excluded fix, the logarithm of the evidence
    where it is wanted, and the points of the estimate with the problem that they are of.

    Where the other measurements contradict stops, all is found anew without these.
    """

    def judge(one: _Estimated) -> Array:
        built, found = one
        near = found.estimate.get_linearisation(found.base)
        false, spent = find_false_stops(found.base, found.estimate.noise, near, built.detections.stationary)
        passes.update(filter=spent)
        return false

    def estimate_without(before: _Estimated, false: Array) -> _Estimated:
        moving = replace(builder, false_stops=false)
        built, found = _estimate_with_start(moving, moving.build_moving(before[0]), progress)
        return built, found.count(before[1].estimate.passes + found.estimate.passes)

    one = _estimate_with_start(builder, built, progress)
    (built, found), false = leave_out_false_stops(one, judge, estimate_without)
    best, built = found.estimate, replace(built, problem=found.base)
    wanted = weigh is not None and weigh(apply_noise(built.problem, best.noise), best.points)
    found = found.weigh() if wanted else found
    evidence = found.compute_evidence() if wanted else np.inf
    passes.update(found.estimate.passes + Counter(filter=1))
    plain = NoiseModel(excluded=best.noise.excluded, freed=found.freed)
    likelier = _is_likelier(built.problem, plain, best)
    noise = plain if likelier else widen_by_tails(built.problem, found.noise)
    near = best.get_linearisation(built.problem)
    if noise.excluded:
        with contextlib.suppress(*BREAKDOWN):
            noise, spent = weigh_excluded(built.problem, noise, near)
            passes.update(filter=spent, smoother=spent)
    return replace(noise, false_stops=unite_stops(false)), built, evidence, near


def _estimate_with_start(builder: ProblemBuilder, built: BuiltProblem, progress: Progress | None) -> _Estimated:
    """The problem with a start and stops that rest on no excluded fix, and the estimate on it."""
    settings = builder.settings.gnss
    found = estimate_jointly(built.problem, settings, built.aligned.until, progress)
    if found.excluded_share > _MOST_WRONG:
        # most fixes contradict the start: align again with the fixes behind those that the alignment used
        try:
            later = builder.build_later(built)
            other = estimate_jointly(later.problem, settings, later.aligned.until, progress)
            total = found.estimate.passes + other.estimate.passes
            if other.excluded_share < found.excluded_share:
                built, found = later, other
            found = found.count(total)
        except EstimationError:
            pass  # no motion later on
    if found.noise.excluded:
        built, found = _start_without(builder, built, found, progress)
    found = revise_jointly(found, settings, built.aligned.until, progress)
    return _start_anew(builder, built, found) if found.freed else (built, found)


def _start_without(
    builder: ProblemBuilder, built: BuiltProblem, found: JointEstimate, progress: Progress | None
) -> tuple[BuiltProblem, JointEstimate]:
    """The same with a start and stops that rest on no excluded fix."""
    without = builder.build_without(built, found.noise, parts=True)
    if without is built:
        return built, found
    again = replace(found, stated=without.problem)
    same = np.array_equal(without.problem.t, built.problem.t)

    def estimate(before: NoiseEstimate, near: tuple[Points, Problem] | None = None) -> NoiseEstimate:
        return estimate_noise(again.base, without.aligned.until, before.noise, near, progress)

    def go_on(before: NoiseEstimate) -> NoiseEstimate:
        if not same:
            return estimate(before)
        # the points known rest on the start before, and a filter from the new one may diverge: the likelier
        near = estimate(before, before.get_linearisation(found.base))
        try:
            fresh = estimate(before)
        except BREAKDOWN:
            return near
        best = max(near, fresh, key=lambda one: one.log_evidence)
        return replace(best, passes=near.passes + fresh.passes)

    best, rival = go_on(found.estimate), found.estimate.rival
    total = found.estimate.passes + best.passes
    if rival is not None:
        rival = go_on(rival)
        total = total + rival.passes
    return without, replace(again, estimate=replace(best, rival=rival)).count(total)


def _start_anew(
    builder: ProblemBuilder, built: BuiltProblem, found: JointEstimate
) -> tuple[BuiltProblem, JointEstimate]:
    """The same with a start that depends on no constant as stated that is free."""
    anew = builder.build_without(built, found.noise, parts=True, anew=True)
    again = replace(found, stated=anew.problem, estimate=replace(found.estimate, whole_evidence=None))
    if np.array_equal(anew.problem.t, built.problem.t):
        return anew, again
    best = estimate_noise(again.base, anew.aligned.until, found.estimate.noise)
    return anew, replace(again, estimate=best).count(found.estimate.passes + best.passes)


def _is_likelier(base: Problem, plain: NoiseModel, found: NoiseEstimate) -> bool:
    """Whether the stated figures are more probable than the estimate, its prior included.

    Both leave the same measurements out, so that the likelihoods compare.
    """
    problem = apply_noise(base, plain)
    forward = refilter(problem, found.carry_points(base, problem), whole=False)
    return float(np.sum(forward.log_likelihood)) > found.log_evidence


def _drop_refused(problem: Problem, forward: FilterPass) -> Problem:
    """The problem without the rows that a gate refused in the filter: no solver uses them."""
    refused = {c.name: forward.records[c.name].decided for c in problem.constraints if c.gate is not None}
    return weigh_rows(problem, refused) if refused else problem
