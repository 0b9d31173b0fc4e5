"""From a recording to the problem that every solver gets: aligned, posed, its noise model estimated.

A straight line: align, build the problem, estimate the noise model, look once for measurements that are wrong in spans
and decide each by evidence, estimate again without them. The filter then runs as a filter would, from the start on, and
its smoother is where the batch solver sets out.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.config import Settings
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.progress import Progress, tell
from graphnav.core.rotation import Array
from graphnav.detectors import Detections
from graphnav.estimation import faults
from graphnav.estimation.alignment import Alignment, with_known_heading
from graphnav.estimation.building import BuiltProblem, Clock, ProblemBuilder, has_diverged
from graphnav.estimation.fixing import fix, float_arcs
from graphnav.estimation.noise.apply import with_noise, without_parts
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.exclusion import (
    estimate_without_faults,
    excluded_share,
    with_disturbed_intervals,
)
from graphnav.estimation.noise.model import STATED, NoiseModel
from graphnav.estimation.noise.spacing import space_fixes
from graphnav.estimation.noise.words import describe
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import CarrierArcs
from graphnav.estimation.solvers.ekf import ekf, near, refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import (
    FilterPass,
    SmootherPass,
    near_to,
    points_of,
    points_of_solution,
    values_of,
)
from graphnav.estimation.solvers.rts import backward
from graphnav.recording import Recording

_LOST = 0.1  # rad by which a filter may be off for a smoother to rest on it
_MOST_WRONG = 0.5  # share of the fixes that can be wrong; beyond it, it is the start that is


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
) -> Prepared:
    """Align a recording, build its problem and find its noise model.

    Parameters
    ----------
    detections : where the platform stands.
    noise : to be used as it is; estimated, or as stated if the settings say so, when None.

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
    built, known = builder.build(aligned, detections, parts=noise != STATED), None
    if noise is None:
        tell("noise")
        with clock.book("noise"):
            noise, known, built = _find_noise(builder, built, progress, passes)
            noise = replace(noise, spacing=spacing)
    else:
        built = builder.build_without(built, noise, parts=noise != STATED)
    aligned = built.aligned
    problem = without_parts(with_noise(built.problem, noise))
    forward = ekf(problem, progress, aligned.until)  # its own solution has the time it takes
    with clock.book("smoother"):
        smoothed = backward(problem, forward, progress)
        problem = _without_refused(problem, forward)
        if any(rows.gate is not None for rows in problem.constraints):
            smoothed = backward(problem, refilter(problem, smoothed, progress), progress)
        forward, smoothed = _find_way(problem, aligned, known, forward, smoothed, progress, passes)
    passes.update(filter=1, smoother=1)
    notes, epochs, arcs = describe(noise, problem), {}, {"": float_arcs(problem)}
    if built.carriers is not None:
        tell("ambiguities")
        with clock.book("ambiguities"):
            fixed = fix(problem, built.carriers, smoothed, aligned.until, progress)
        problem, forward, smoothed = fixed.problem, fixed.forward, fixed.smoothed
        notes, epochs = (*notes, *fixed.notes), {"ekf": fixed.filtered_epochs, "": fixed.smoothed_epochs}
        arcs = {"ekf": fixed.filtered_arcs, "": fixed.smoothed_arcs}
    start = with_known_heading(aligned, settings)
    return Prepared(
        problem, noise, start, aligned, built.detections, forward, smoothed, notes, clock.seconds, passes, epochs, arcs
    )


def _find_noise(
    builder: ProblemBuilder, built: BuiltProblem, progress: Progress | None, passes: Counter[str]
) -> tuple[NoiseModel, Points | None, BuiltProblem]:
    """The noise model, points to linearise at, and the problem: with start and stops that rest on nothing wrong."""
    best = _estimate(built, builder.settings, progress, passes)
    if excluded_share(built.problem, best.noise) > _MOST_WRONG:
        # most fixes contradict what came of the start: it is looked for in what follows
        try:
            later = builder.build_later(built)
            again = _estimate(later, builder.settings, progress, passes)
            if excluded_share(later.problem, again.noise) < excluded_share(built.problem, best.noise):
                built, best = later, again
        except EstimationError:
            pass  # nothing moves later on
    without = builder.build_without(built, best.noise, parts=True)
    if without is not built:
        built = without
        best = estimate_noise(built.problem, built.aligned.until, best.noise, progress=progress)
        passes.update(filter=best.passes, smoother=best.passes)
    best = with_disturbed_intervals(built.problem, best)
    passes.update(filter=best.passes + best.looks + 1, smoother=best.passes)
    plain = NoiseModel(excluded=best.noise.excluded)
    if _is_likelier(built.problem, plain, best):
        return plain, None, built
    # of what the estimation has left only its points are wanted any more: the rest is half of all memory
    return best.noise, Points(best.points.states, best.points.values), built


def _estimate(
    built: BuiltProblem, settings: Settings, progress: Progress | None, passes: Counter[str]
) -> NoiseEstimate:
    """The noise model, with spans of wrong measurements left out if they are to be."""
    estimate = estimate_noise if settings.gnss.faults == "off" else estimate_without_faults
    found = estimate(built.problem, built.aligned.until, progress=progress)
    passes.update(filter=found.passes + found.looks, smoother=found.passes)
    return found


def _is_likelier(base: Problem, plain: NoiseModel, found: NoiseEstimate) -> bool:
    """Whether the figures as stated make the innovations likelier than the estimate, with its prior, does.

    Both without what is left out: likelihoods are compared of the same measurements.
    """
    known = values_of(with_noise(base, found.noise), found.points)
    problem = with_noise(base, plain)
    forward = refilter(problem, points_of(problem, found.points.states, known))
    return float(np.sum(forward.log_likelihood)) > found.log_posterior


def _find_way(
    problem: Problem,
    aligned: Alignment,
    known: Points | None,
    forward: FilterPass,
    smoothed: SmootherPass,
    progress: Progress | None,
    passes: Counter[str],
) -> tuple[FilterPass, SmootherPass]:
    """Filter and smooth about better points where the filter was too far off for a smoother to rest on it.

    These are `known`, from the estimation of the noise, where it came about; else those of a batch solution.

    Fixes that weigh little beside wheels let a filter that is not sure of its heading turn the mounting round
    rather than the velocity, and no step finds back from there. So wheels come second.
    """
    if near_to(smoothed, forward.linearised, _LOST):
        return forward, smoothed
    if known is not None and len(known.states) == len(problem.t):
        passes.update(filter=2, smoother=1)
        smoothed = backward(problem, refilter(problem, known, progress), progress)
        if near_to(smoothed, known, _LOST):
            return ekf(problem, progress, aligned.until, known=smoothed), smoothed
    from graphnav.estimation.solvers.batch import batch  # and GTSAM with it, which few runs of a filter need

    states = smoothed.states
    if any(c.of_wheels for c in problem.constraints):
        free = replace(problem, constraints=tuple(c for c in problem.constraints if not c.of_wheels))
        states = backward(free, ekf(free, progress, aligned.until)).states
        states = batch(free, states, wanted=(), reintegrate=False).states
    solved = batch(problem, states, wanted=(), reintegrate=False)
    about = points_of_solution(problem, solved, smoothed)
    _, smoothed = near(problem, about, aligned.until, progress)
    passes.update(filter=3, smoother=2)
    return ekf(problem, progress, aligned.until, known=smoothed), smoothed


def _without_refused(problem: Problem, forward: FilterPass) -> Problem:
    """The problem without the rows that a gate refused in the filter: no solver uses them."""
    refused = {c.name: forward.records[c.name].decided for c in problem.constraints if c.gate is not None}
    return faults.weigh_rows(problem, refused) if refused else problem
