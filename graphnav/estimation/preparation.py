"""From a recording to the problem that every solver gets: aligned, built, its noise model estimated.

In order: align, build the problem, estimate the noise model, search for spans of wrong measurements and decide each by
evidence, estimate again without them. The filter then runs causally from the start, and its smoother gives the batch
solver its first linearisation point.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.foot import Stance
from graphnav.constraints.odometer import average_speed
from graphnav.core.beside import Beside, Later, begin_beside, may_begin
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.interpolation import pick_nearest
from graphnav.core.notes import Note
from graphnav.core.progress import Progress, tell
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.detectors import Detections
from graphnav.detectors.base import NONE
from graphnav.estimation.alignment import Alignment, use_known_heading
from graphnav.estimation.building import BuiltProblem, Clock, ProblemBuilder, has_diverged
from graphnav.estimation.contradictions import describe_freed, free
from graphnav.estimation.faults.excluded import weigh_rows
from graphnav.estimation.fixing import fix, split_carriers
from graphnav.estimation.joint_estimate import JointEstimate
from graphnav.estimation.noise.apply import apply_noise, are_of_others, drop_parts
from graphnav.estimation.noise.bias_walks import estimate_bias_walks
from graphnav.estimation.noise.chords import find_filled_gaps
from graphnav.estimation.noise.decision import weigh_rest
from graphnav.estimation.noise.initial_points import find_initial_points
from graphnav.estimation.noise.model import STATED, NoiseModel
from graphnav.estimation.noise.spans import Span
from graphnav.estimation.noise.tails import widen_by_tails, widen_unweighted
from graphnav.estimation.noise.unmeasured import UnmeasuredRows, drop_in_gaps, drop_unmeasured
from graphnav.estimation.noise.words import describe_noise
from graphnav.estimation.noise_search import (
    Weigh,
    estimate_first,
    find_noise,
    free_wrong_constants,
    leave_out_contradicted_stops,
)
from graphnav.estimation.offsets import is_offset_far
from graphnav.estimation.problem import Problem
from graphnav.estimation.relinearisation import is_clearly_worse, linearise_known, linearise_searched, relinearise
from graphnav.estimation.solution import CarrierArcs
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.linearise import Points, scale_at
from graphnav.estimation.solvers.passes import (
    FilterPass,
    SmootherPass,
    reuse_points,
)
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.estimation.spread import compare_rivals
from graphnav.estimation.unknown_heading import compare_headings
from graphnav.recording import Recording

_Passes = tuple[FilterPass, SmootherPass, dict[str, float]]  # and the seconds that they took, by stage


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
    spread: Array | None = None  # (K, 15, 15) of covariances, by what may be wrong instead

    @property
    def diverged(self) -> bool:
        """Whether the stated start is so far from the one found that a filter from there diverges for a while."""
        return has_diverged(self.aligned, self.start)

    def drop_covariances(self) -> Prepared:
        """The same without covariances and gains, which are nearly all of its memory."""
        return replace(self, forward=self.forward.drop_covariances(), smoothed=self.smoothed.drop_covariances())

    def estimate_parameters(self) -> tuple[Problem, Array, Array]:
        """The problem, its parameters (D-15,) at the start and their covariance."""
        return self.problem, self.smoothed.values[0], self.smoothed.P[0][DIM:, DIM:]


@dataclass(frozen=True)
class Foreseen:
    """The filter of a drive, begun beside the search for what is wrong in it: that of the noise model that stands
    where nothing is.
    """

    built: Problem
    noise: NoiseModel
    problem: Problem  # the same with this noise model
    passes: Beside[_Passes] | Later[_Passes]

    def is_of(self, built: Problem, noise: NoiseModel) -> bool:
        """Whether this noise model is the one that was found."""
        one = self.noise
        same = built is self.built and noise.weights is one.weights and noise.times is one.times
        return same and noise.figures == one.figures and not noise.excluded


@dataclass(frozen=True)
class Begun:
    """A recording aligned, its problem built, and a noise model of all measurements, before any is left out."""

    recording: Recording
    unmeasured: UnmeasuredRows
    builder: ProblemBuilder
    built: BuiltProblem
    noise: NoiseModel | None  # as given, or None where it is estimated
    found: JointEstimate | None  # the estimate so far, without the builder's false stops
    spacing: float  # s, between fixes
    larger: bool  # whether bias walks are to be estimated
    passes: Counter[str]
    foreseen: Foreseen | None = None

    @property
    def log_evidence(self) -> float:
        """Of all measurements by the noise model that is estimated."""
        return np.inf if self.found is None else self.found.compute_evidence()

    @property
    def all_passes(self) -> Counter[str]:
        """Those of the estimate as well."""
        return self.passes if self.found is None else self.passes + self.found.estimate.passes

    @property
    def gained_by_chance(self) -> float:
        """As of `NoiseEstimate`."""
        return 0.0 if self.found is None else self.found.estimate.gained_by_chance

    def weigh_measurements(self, some: Mapping[str, tuple[Span, ...]]) -> float:
        """By how much the logarithm of the evidence falls without rows at some times, by constraint."""
        assert self.found is not None
        self.passes.update(filter=1)
        return self.found.estimate.log_evidence - weigh_rest(self.found.base, self.found.estimate, some)

    def weigh_lacking(
        self,
        ours: Mapping[str, tuple[Array, Array]],
        theirs: Mapping[str, tuple[Array, Array]],
        within: float = SAME_TIME,
    ) -> float:
        """The same without the rows that others do not have; rows are (N,) s by constraint: what they are compared by,
        which may differ by `within`, and their times.
        """
        lacking = {}
        for name, (stamps, t) in ours.items():
            other = theirs[name][0] if name in theirs else np.empty(0)
            some = t[np.abs(other[pick_nearest(other, stamps)] - stamps) > within] if len(other) else t
            if len(some):
                lacking[name] = tuple((x, x) for x in some.tolist())
        return self.weigh_measurements(lacking) if lacking else 0.0

    def estimate_parameters(self, far: float) -> tuple[Problem, Array, Array] | None:
        """The problem, its parameters (D-15,) at the end and their covariance; None where no stamp is as far off, s."""
        if self.found is None:
            return None
        best = self.found.estimate
        problem = apply_noise(self.found.base, best.noise)
        if not is_offset_far(problem, best.points, far):
            return None
        self.passes.update(filter=1)
        forward = refilter(problem, best.points, whole=False)
        return problem, forward.values[-1], forward.P[-1][DIM:, DIM:]


def begin_preparation(
    recording: Recording,
    settings: Settings,
    frame: LocalFrame,
    detections: Detections,
    noise: NoiseModel | None = None,
    progress: Progress | None = None,
    before: Begun | None = None,
) -> Begun:
    """Align a recording, build its problem and begin to estimate its noise model.

    Parameters
    ----------
    detections : where the platform stands.
    noise : used as it is; when None it is estimated, or stated, according to the settings.
    before : what was begun with other stamps: its figures, points and false stops are initial ones.

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
    if noise is None:
        false_stops = NONE if before is None else before.builder.false_stops
    else:
        false_stops = np.array(noise.false_stops).reshape(-1, 2)
    every = ProblemBuilder(recording, recording, settings, frame, clock, averaging, false_stops)
    detections = detections.without(false_stops)
    aligned = every.align(recording, detections.stationary)
    unaided = not recording.placed or not settings.gnss.position
    stated = noise is None and (settings.noise.mode == "stated" or unaided)
    larger = stated and settings.noise.mode != "stated" and recording.platform == "foot"
    if stated:
        noise, spacing = STATED, STATED.spacing
    builder = every.use_spaced(recording, spacing)
    built = builder.build(aligned, detections, parts=larger or noise != STATED)
    if not as_stated:
        with contextlib.suppress(*BREAKDOWN):
            gaps, count = find_filled_gaps(apply_noise(built.problem, STATED), aligned.opening)
            passes.update(filter=count, smoother=count)
            if len(gaps):
                recording, unmeasured = drop_in_gaps(recording, gaps, unmeasured)
                builder = replace(every, recording=recording).use_spaced(recording, spacing)
                built = builder.build(aligned, detections, parts=larger or noise != STATED)
    if noise is not None:
        return Begun(recording, unmeasured, builder, built, noise, None, spacing, larger, passes)
    tell("noise")
    with clock.count_time("noise"):
        one = estimate_first(built, progress, None if before is None else before.found)
        if before is not None and before.foreseen is not None:
            before.foreseen.passes.end()  # for what takes its place
        foreseen = _foresee(*one)
        one = free_wrong_constants(builder, one, progress)
        if foreseen is not None and one[1].freed:
            foreseen.passes.end()
            foreseen = None
        false_stops, (built, found) = leave_out_contradicted_stops(builder, one, progress, passes)
    builder = replace(builder, false_stops=false_stops)
    return Begun(recording, unmeasured, builder, built, None, found, spacing, larger, passes, foreseen)


def prepare(begun: Begun, progress: Progress | None = None, weigh: Weigh | None = None) -> Prepared:
    """Find the noise model of a recording, and its first solution.

    Parameters
    ----------
    weigh : whether the evidence of a noise model that is estimated is wanted; never when None.

    Raises
    ------
    EstimationError
        If the recording does not determine a trajectory.
    """
    recording, builder, built, noise = begun.recording, begun.builder, begun.built, begun.noise
    settings, clock, passes, evidence = builder.settings, builder.clock, Counter(begun.passes), np.inf
    near: tuple[Points, Problem] | None = None
    if begun.found is not None:
        tell("noise")
        with clock.count_time("noise"):
            noise, built, evidence, near = find_noise(builder, (built, begun.found), progress, passes, weigh)
            noise = replace(noise, spacing=begun.spacing)
    elif noise is not None:
        if are_of_others(built.problem, noise):
            noise = widen_unweighted(built.problem, noise)
        built = builder.build_without(built, noise, parts=noise != STATED, anew=bool(noise.freed))
        built = replace(built, problem=free(built.problem, noise.freed))
    assert noise is not None
    aligned = built.aligned
    problem = drop_parts(apply_noise(built.problem, noise))
    try:
        if (foreseen := begun.foreseen) is not None and foreseen.is_of(built.problem, noise):
            problem = foreseen.problem
            forward, smoothed, seconds = foreseen.passes.get_result()
            clock.add(seconds)
        else:
            if foreseen is not None:
                foreseen.passes.end()
            forward, smoothed = _filter_and_smooth(problem, aligned.opening, None, clock, progress)
    except EstimationError:  # from a rough start its first pass may diverge
        initial = next(find_initial_points(problem, aligned.opening))
        passes.update(filter=initial.passes, smoother=initial.passes)
        forward, smoothed = _filter_and_smooth(problem, aligned.opening, initial.points, clock, progress)
    if begun.larger:
        with clock.count_time("noise"):
            noise, spent = estimate_bias_walks(built.problem, smoothed)
            passes.update(spent)
        if noise.figures:
            problem = drop_parts(apply_noise(built.problem, noise))
            forward, smoothed = _filter_and_smooth(problem, aligned.opening, None, clock, progress)
            passes.update(filter=1, smoother=1)
    with clock.count_time("smoother"):
        problem = _drop_refused(problem, forward)
        if any(rows.gate is not None for rows in problem.constraints):
            smoothed = smooth_backward(problem, refilter(problem, smoothed, progress), progress)
        problem = problem.with_input_noise(smoothed.states, scale_at(problem.columns, smoothed.values))
        found = relinearise(problem, aligned, forward, smoothed, progress, passes)
        known = None if near is None else reuse_points(*near, problem)
        if noise.searched or (known is not None and is_clearly_worse(problem, found[1], known)):
            with contextlib.suppress(*BREAKDOWN):  # searched for, so that a run with this noise model finds the same
                found, noise = linearise_searched(problem, aligned, progress, passes), replace(noise, searched=True)
            if known is not None and is_clearly_worse(problem, found[1], known):
                found = linearise_known(problem, aligned, known, progress, passes)
                noise = replace(noise, searched=False)
        forward, smoothed, ahead = found
    passes.update(filter=1, smoother=1)
    spread, doubts = compare_rivals(built.problem, noise, problem, smoothed)
    passes.update(filter=len(noise.rivals), smoother=len(noise.rivals))
    if aligned.heading_unknown and settings.alignment.heading is None:
        with clock.count_time("smoother"):
            around = compare_headings(problem, smoothed, passes)
        spread = around if spread is None else spread + around
    notes = (*describe_freed(noise.freed, recording), *describe_noise(noise, problem), *_describe_missing(problem))
    notes = (*doubts, *notes)
    epochs, arcs = dict[str, Array](), {"": CarrierArcs()}
    rest, carriers = (problem, built.carriers) if built.carriers is not None else split_carriers(problem)
    if carriers is not None:
        tell("ambiguities")
        with clock.count_time("ambiguities"):
            fixed = fix(rest, carriers, smoothed, aligned.opening, progress)
        problem, forward, smoothed, ahead = fixed.problem, fixed.forward, fixed.smoothed, None
        notes, epochs = (*notes, *fixed.notes), {"ekf": fixed.filtered_epochs, "": fixed.smoothed_epochs}
        arcs = {"ekf": fixed.filtered_arcs, "": fixed.smoothed_arcs}
    start = use_known_heading(aligned, settings)
    passes.update(clock.passes)
    return Prepared(
        problem, noise, start, aligned, built.detections, forward, smoothed, notes, clock.seconds, passes, epochs, arcs,
        evidence, ahead, begun.unmeasured, spread,
    )  # fmt: skip


def _foresee(built: BuiltProblem, found: JointEstimate) -> Foreseen | None:
    """Begin the filter with the noise model of all measurements, where another is not likely already."""
    if found.rival is not None or not may_begin():
        return None
    noise = widen_by_tails(found.base, found.noise)
    problem = drop_parts(apply_noise(found.base, noise))
    return Foreseen(found.base, noise, problem, begin_beside(partial(_count_filter, problem, built.aligned.opening)))


def _count_filter(problem: Problem, opening: float | None) -> _Passes:
    clock = Clock()
    return *_filter_and_smooth(problem, opening, None, clock, None), clock.seconds


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


def _drop_refused(problem: Problem, forward: FilterPass) -> Problem:
    """The problem without the rows that a gate refused in the filter: no solver uses them."""
    refused = {c.name: forward.records[c.name].decided for c in problem.constraints if c.gate is not None}
    return weigh_rows(problem, refused) if refused else problem
