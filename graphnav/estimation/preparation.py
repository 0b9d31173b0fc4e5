"""From a recording to the problem that every solver gets: aligned, built, its noise model estimated.

In order: align, build the problem, estimate the noise model, search for spans of wrong measurements and decide each by
evidence, estimate again without them. The filter then runs causally from the start, and its smoother gives the batch
solver its first linearisation point.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET, VELOCITY_TIME_OFFSET
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.progress import Progress, tell
from graphnav.core.rotation import Array
from graphnav.detectors import Detections
from graphnav.estimation import faults
from graphnav.estimation.alignment import Alignment, use_known_heading
from graphnav.estimation.building import BuiltProblem, Clock, ProblemBuilder, has_diverged
from graphnav.estimation.contradictions import (
    Freed,
    are_same,
    compute_prior_cost,
    describe_freed,
    find_contradicted_constants,
    free,
    update_freed,
)
from graphnav.estimation.fixing import fix, split_carriers
from graphnav.estimation.noise.apply import apply_noise, drop_parts
from graphnav.estimation.noise.decision import log_evidence
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.exclusion import (
    compute_excluded_share,
    estimate_disturbed_intervals,
    estimate_without_faults,
)
from graphnav.estimation.noise.initial_points import BREAKDOWN
from graphnav.estimation.noise.model import STATED, NoiseModel
from graphnav.estimation.noise.spacing import space_fixes
from graphnav.estimation.noise.words import describe_noise
from graphnav.estimation.offsets import is_offset_far
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import CarrierArcs
from graphnav.estimation.solvers.ekf import ekf, refilter, smooth_near
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import (
    FilterPass,
    SmootherPass,
    are_near,
    take_solution_points,
)
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.recording import Recording

# whether the evidence of a noise model is wanted, by the problem and the points of its estimate
Weigh = Callable[[Problem, Points], bool]

_LINEAR_ATTITUDE = 0.1  # rad between linearisation point and smoothed attitude, up to which the smoother is used
_SMOOTHINGS = 5  # passes of filter and smoother about their previous points; without convergence a batch is solved
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
    spacing = settings.noise.spacing if noise is None else noise.spacing
    every = ProblemBuilder(recording, recording, settings, frame, clock)
    aligned = every.align(recording, detections.stationary)
    if noise is None and (settings.noise.mode == "stated" or aligned.motion is None or not settings.gnss.position):
        noise, spacing = STATED, STATED.spacing
    builder = replace(every, used=space_fixes(recording, spacing)) if spacing else every
    built, known, evidence = builder.build(aligned, detections, parts=noise != STATED), None, np.inf
    if noise is None:
        tell("noise")
        with clock.count_time("noise"):
            noise, known, built, evidence = _find_noise(builder, built, progress, passes, weigh)
            noise = replace(noise, spacing=spacing)
    else:
        built = builder.build_without(built, noise, parts=noise != STATED, anew=bool(noise.freed))
        built = replace(built, problem=free(built.problem, noise.freed))
    aligned = built.aligned
    problem = drop_parts(apply_noise(built.problem, noise))
    try:
        forward, smoothed = _filter_and_smooth(problem, aligned.until, None, clock, progress)
    except EstimationError:  # from a rough start its first pass may diverge, where that of the noise model did not
        if known is None:
            raise
        forward, smoothed = _filter_and_smooth(problem, aligned.until, known, clock, progress)
    with clock.count_time("smoother"):
        problem = _drop_refused(problem, forward)
        if any(rows.gate is not None for rows in problem.constraints):
            smoothed = smooth_backward(problem, refilter(problem, smoothed, progress), progress)
        forward, smoothed = _relinearise(problem, aligned, known, forward, smoothed, progress, passes)
    passes.update(filter=1, smoother=1)
    notes = (*describe_freed(noise.freed, recording), *describe_noise(noise, problem))
    epochs, arcs = dict[str, Array](), {"": CarrierArcs()}
    rest, carriers = (problem, built.carriers) if built.carriers is not None else split_carriers(problem)
    if carriers is not None:
        tell("ambiguities")
        with clock.count_time("ambiguities"):
            fixed = fix(rest, carriers, smoothed, aligned.until, progress)
        problem, forward, smoothed = fixed.problem, fixed.forward, fixed.smoothed
        notes, epochs = (*notes, *fixed.notes), {"ekf": fixed.filtered_epochs, "": fixed.smoothed_epochs}
        arcs = {"ekf": fixed.filtered_arcs, "": fixed.smoothed_arcs}
    start = use_known_heading(aligned, settings)
    return Prepared(
        problem, noise, start, aligned, built.detections, forward, smoothed, notes, clock.seconds, passes, epochs, arcs,
        evidence,
    )  # fmt: skip


def _filter_and_smooth(
    problem: Problem, opening: float | None, known: Points | None, clock: Clock, progress: Progress | None
) -> tuple[FilterPass, SmootherPass]:
    """Filter, with its opening linearised at known points if there are any, and smooth."""
    forward = ekf(problem, progress, opening, known)  # its own solution has the time it takes
    with clock.count_time("smoother"):
        return forward, smooth_backward(problem, forward, progress)


@dataclass(frozen=True)
class _Found:
    """A noise model, and the constants that are parameters in it instead of as stated."""

    built: BuiltProblem  # all constants as stated
    freed: Freed
    estimate: NoiseEstimate

    @property
    def base(self) -> Problem:
        """The problem with stated noise that the noise model is of."""
        return free(self.built.problem, self.freed)

    @property
    def noise(self) -> NoiseModel:
        return replace(self.estimate.noise, freed=self.freed)

    @property
    def excluded_share(self) -> float:
        return compute_excluded_share(self.built.problem, self.estimate.noise)

    def compute_evidence(self) -> float:
        """The logarithm of the evidence of the measurements."""
        return log_evidence(self.base, self.estimate) - compute_prior_cost(self.built.problem, self.freed)

    def count(self, passes: Counter[str]) -> _Found:
        """The same after this many passes."""
        return replace(self, estimate=replace(self.estimate, passes=passes))


# a problem with stated noise, first points and the problem that they are of -> its noise model
Estimate = Callable[[Problem, tuple[Points, Problem] | None], NoiseEstimate]


def _find_noise(
    builder: ProblemBuilder, built: BuiltProblem, progress: Progress | None, passes: Counter[str], weigh: Weigh | None
) -> tuple[NoiseModel, Points | None, BuiltProblem, float]:
    """The noise model, linearisation points, the problem with a start and stops that rest on no excluded fix, and the
    logarithm of the evidence where it is wanted.
    """
    leave_out = _keep_all if builder.settings.gnss.faults == "off" else estimate_without_faults
    found = _estimate_noise(builder.settings, built, leave_out, progress)
    if found.excluded_share > _MOST_WRONG:
        # most fixes contradict the start: align again with the fixes behind those that the alignment used
        try:
            later = _estimate_noise(builder.settings, builder.build_later(built), leave_out, progress)
            total = found.estimate.passes + later.estimate.passes
            found = min(found, later, key=lambda one: one.excluded_share).count(total)
        except EstimationError:
            pass  # no motion later on
    if found.noise.excluded:
        without = builder.build_without(found.built, found.noise, parts=True)
        if without is not found.built:
            total = found.estimate.passes
            found = replace(found, built=without)
            again = estimate_noise(found.base, without.aligned.until, found.estimate.noise, progress=progress)
            found = replace(found, estimate=again).count(total + again.passes)
    found = replace(found, estimate=estimate_disturbed_intervals(found.base, found.estimate))
    until = found.built.aligned.until

    def estimate(base: Problem, near: tuple[Points, Problem] | None) -> NoiseEstimate:
        one = estimate_noise(base, until, near=near, progress=progress)
        return estimate_disturbed_intervals(base, leave_out(base, one, until, progress))

    found = _free_contradicted(builder.settings, found, estimate)
    if found.freed:
        found = _start_anew(builder, found)
    passes.update(found.estimate.passes + Counter(filter=1))
    best, built = found.estimate, replace(found.built, problem=found.base)
    wanted = weigh is not None and weigh(apply_noise(built.problem, best.noise), best.points)
    evidence = found.compute_evidence() if wanted else np.inf
    plain = NoiseModel(excluded=best.noise.excluded, freed=found.freed)
    if _is_likelier(built.problem, plain, best):
        return plain, None, built, evidence
    # the points alone: the covariances of the last pass are half of all memory
    return found.noise, Points(best.points.states, best.points.values), built, evidence


def _keep_all(base: Problem, found: NoiseEstimate, *_: object) -> NoiseEstimate:
    return found


def _estimate_noise(
    settings: Settings,
    built: BuiltProblem,
    leave_out: Callable[[Problem, NoiseEstimate, float | None, Progress | None], NoiseEstimate],
    progress: Progress | None,
) -> _Found:
    """The noise model, with constants free that the drive contradicts, and without spans of wrong measurements.

    Constants are tested first: their errors are in all measurements, and would be taken for faults of some of them.
    """

    def estimate(base: Problem, near: tuple[Points, Problem] | None) -> NoiseEstimate:
        return estimate_noise(base, built.aligned.until, near=near, progress=progress)

    found = _free_contradicted(settings, _Found(built, {}, estimate(built.problem, None)), estimate)
    return replace(found, estimate=leave_out(found.base, found.estimate, built.aligned.until, progress))


def _free_contradicted(settings: Settings, found: _Found, estimate: Estimate) -> _Found:
    """Free the constants that the drive contradicts as stated, and no others, and estimate the noise model anew.

    Where these are free already, the estimate stays. Tested again once all other faults are known: a gyro that misses a
    turn looks like a wrong lever arm, and so do wrong fixes and stamps that are still to be moved.
    """
    base, before = found.built.problem, found.freed
    near = found.estimate.get_linearisation(found.base)
    names = set[str]() if settings.gnss.clock_rate_sigma == 0.0 else {CLOCK_RATE}
    if not is_offset_far(near[1], found.estimate.points):
        names |= {LEVER_ARM, TIME_OFFSET, VELOCITY_TIME_OFFSET}
    passes = found.estimate.passes + Counter(filter=1)
    try:
        freed = find_contradicted_constants(base, found.estimate, before, names)
        if not are_same(freed, before, base):
            other = replace(found, freed=freed, estimate=estimate(free(base, freed), near))
            passes = passes + other.estimate.passes + Counter(filter=1)
            # with other figures, freed constants may lead to a worse optimum than with all as stated
            found = max(found, other, key=lambda one: one.compute_evidence())
            freed = update_freed(base, found.estimate, found.freed)
    except BREAKDOWN:
        return found.count(passes)
    return replace(found, freed=freed).count(passes)


def _start_anew(builder: ProblemBuilder, found: _Found) -> _Found:
    """The same with a start that depends on no constant as stated that is free."""
    built = builder.build_without(found.built, found.noise, parts=True, anew=True)
    again = replace(found, built=built)
    if np.array_equal(built.problem.t, found.built.problem.t):
        return again
    best = estimate_noise(again.base, built.aligned.until, found.estimate.noise)
    return replace(again, estimate=best).count(found.estimate.passes + best.passes)


def _is_likelier(base: Problem, plain: NoiseModel, found: NoiseEstimate) -> bool:
    """Whether the stated figures are more probable than the estimate, its prior included.

    Both leave the same measurements out, so that the likelihoods compare.
    """
    problem = apply_noise(base, plain)
    forward = refilter(problem, found.carry_points(base, problem))
    return float(np.sum(forward.log_likelihood)) > found.log_posterior


def _relinearise(
    problem: Problem,
    aligned: Alignment,
    known: Points | None,
    forward: FilterPass,
    smoothed: SmootherPass,
    progress: Progress | None,
    passes: Counter[str],
) -> tuple[FilterPass, SmootherPass]:
    """Filter and smooth about better points where the filter was linearised too far from the smoothed solution.

    The points are `known`, those of the noise estimate, if there are any, else the smoother's own; each pass about
    those of the pass before is a Gauss-Newton step. If that does not settle they are those of a batch solution.

    If the heading is uncertain and fixes weigh little beside wheels, a filter may turn the mounting by half a turn
    instead of the velocity, a local minimum. So the batch is then solved at once, without wheels first.
    """
    if are_near(smoothed, forward.linearised, _LINEAR_ATTITUDE):
        return forward, smoothed
    wheels = aligned.motion is not None and any(c.of_wheels for c in problem.constraints)
    about: Points = smoothed if known is None or len(known.states) != len(problem.t) else known
    for _ in range(int(about is known) if wheels else _SMOOTHINGS):
        passes.update(filter=1, smoother=1)
        smoothed = smooth_backward(problem, refilter(problem, about, progress), progress)
        if are_near(smoothed, about, _LINEAR_ATTITUDE):
            passes.update(filter=1)
            return ekf(problem, progress, aligned.until, known=smoothed), smoothed
        about = smoothed
    from graphnav.estimation.factor_graph.batch import batch  # imports GTSAM, which few filter runs need

    states = smoothed.states
    if wheels:
        free = replace(problem, constraints=tuple(c for c in problem.constraints if not c.of_wheels))
        states = smooth_backward(free, ekf(free, progress, aligned.until)).states
        states = batch(free, states, wanted=(), reintegrate=False).states
    solved = batch(problem, states, wanted=(), reintegrate=False)
    about = take_solution_points(problem, solved, smoothed)
    _, smoothed = smooth_near(problem, about, aligned.until, progress)
    passes.update(filter=3, smoother=2)
    return ekf(problem, progress, aligned.until, known=smoothed), smoothed


def _drop_refused(problem: Problem, forward: FilterPass) -> Problem:
    """The problem without the rows that a gate refused in the filter: no solver uses them."""
    refused = {c.name: forward.records[c.name].decided for c in problem.constraints if c.gate is not None}
    return faults.weigh_rows(problem, refused) if refused else problem
