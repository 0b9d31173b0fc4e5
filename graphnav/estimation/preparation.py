"""From a recording to the problem that every solver gets: aligned, posed, its noise model estimated.

A straight line: align, build the problem, estimate the noise model, look once for measurements that are wrong in spans
and decide each by evidence, estimate again without them. The filter then runs as a filter would, from the start on, and
its smoother is where the batch solver sets out.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.raw_phase import GnssPhase
from graphnav.constraints.vehicle import NonHolonomic, OdometerSpeed
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.progress import Progress, tell
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, States
from graphnav.detectors import Detections, detect
from graphnav.estimation import faults
from graphnav.estimation.alignment import Alignment, align, with_known_heading
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.estimation.fixing import fix, float_arcs, split_carriers
from graphnav.estimation.noise.apply import with_noise, without_parts
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.exclusion import (
    estimate_without_faults,
    excluded_share,
    with_disturbed_intervals,
    without_excluded,
)
from graphnav.estimation.noise.model import STATED, NoiseModel
from graphnav.estimation.noise.spacing import space_fixes
from graphnav.estimation.noise.words import describe
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solution import CarrierArcs, Solution
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

_FAR = 0.5  # rad between the stated and the found start attitude, beyond which a filter diverges for a while
_FAR_AWAY = 100.0  # m, by which single fixes in a city may be wrong
_LOST = 0.1  # rad by which a filter may be off for a smoother to rest on it
_MOST = 0.5  # share of the fixes that can be wrong; beyond it, it is the start that is
_WHEELS = (NonHolonomic, OdometerSpeed)


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
        return _has_diverged(self.aligned, self.start)


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
    timings: dict[str, float] = {}
    passes: Counter[str] = Counter()
    carriers: list[GnssPhase | None] = [None]

    # of carriers an alignment needs nothing, and solves dozens of problems
    codes_alone = settings.raw_gnss.model_copy(update={"differences": False})
    without_changes = settings.model_copy(update={"raw_gnss": codes_alone})

    def book(stage: str, since: float) -> float:
        now = time.perf_counter()
        timings[stage] = timings.get(stage, 0.0) + now - since
        return now

    def align_with(fixes: Recording, stationary: Array) -> Alignment:
        tell("alignment")
        since = time.perf_counter()
        found = align(fixes, without_changes, frame, _smooth, stationary)
        book("alignment", since)
        return found

    def build(at: Alignment, found: Detections, parts: bool) -> Problem:
        tell("preintegration")
        since, start = time.perf_counter(), _start(at, with_known_heading(at, settings))
        problem = build_problem(
            used, settings, frame, start.state, start_sigma(start), found.stationary, parts_of_noise=parts
        )
        book("preintegration", since)
        problem, carriers[0] = split_carriers(problem)  # the noise model rests on the codes
        return problem

    def without_wrong(noise: NoiseModel) -> tuple[Alignment, Detections, bool]:
        """Start and stops, which are not to rest on fixes that are wrong, and whether they are others then."""
        if not noise.excluded or recording.gnss is None:
            return aligned, detections, False
        fixes = without_excluded(recording, noise)
        stops = detect(fixes, settings)
        changed = _differ(stops.stationary, detections.stationary)
        stops = stops if changed else detections
        seen = recording.end if aligned.until is None else aligned.until
        if not any(begin <= seen for spans in noise.excluded.values() for begin, _ in spans):
            return aligned, stops, changed  # the start has seen none of them
        try:
            found = align_with(fixes, stops.stationary)
        except EstimationError:
            return aligned, stops, changed
        other = found.motion is not None and found.contradicts(aligned)
        return (found if other else aligned), stops, changed or other

    known: Points | None = None
    aligned = align_with(recording, detections.stationary)
    told = aligned.motion is not None and settings.gnss.position
    if noise is None and (settings.noise.mode == "stated" or not told):
        noise = STATED
    spacing = settings.noise.spacing if noise is None else noise.spacing
    used = space_fixes(recording, spacing) if spacing else recording
    base = build(aligned, detections, parts=noise != STATED)
    if noise is None:
        since = time.perf_counter()
        tell("noise")
        best = _estimate(base, aligned, settings, progress, passes)
        if excluded_share(base, best.noise) > _MOST:
            # most fixes contradict what came of the start: it is looked for in what follows
            try:
                later = align_with(_cut_aligned(recording, aligned), detections.stationary)
                other = build(later, detections, parts=True)
                again = _estimate(other, later, settings, progress, passes)
                if excluded_share(other, again.noise) < excluded_share(base, best.noise):
                    aligned, base, best = later, other, again
            except EstimationError:
                pass  # nothing moves later on
        aligned, detections, changed = without_wrong(best.noise)
        if changed:
            base = build(aligned, detections, parts=True)
            best = estimate_noise(base, aligned.until, best.noise, progress=progress)
            passes.update(filter=best.passes, smoother=best.passes)
        best = with_disturbed_intervals(base, best)
        passes.update(filter=best.passes + best.looks, smoother=best.passes)
        noise, known = best.noise, best.points
        passes.update(filter=1)
        plain = NoiseModel(excluded=noise.excluded)
        if _is_likelier(base, plain, best):
            noise, known = plain, None
        noise = replace(noise, spacing=spacing)
        # of what the estimation has left only its points are wanted any more: the rest is half of all memory
        known = known and Points(known.states, known.values)
        del best
        book("noise", since)
    else:
        aligned, detections, changed = without_wrong(noise)
        base = build(aligned, detections, parts=noise != STATED) if changed else base
    problem = without_parts(with_noise(base, noise))
    start = with_known_heading(aligned, settings)
    since = time.perf_counter()
    forward = ekf(problem, progress, aligned.until)
    filtered = book("filter", since)
    smoothed = backward(problem, forward, progress)
    problem = _without_refused(problem, forward)
    if any(rows.gate is not None for rows in problem.constraints):
        smoothed = backward(problem, refilter(problem, smoothed, progress), progress)
    forward, smoothed = _find_way(problem, aligned, known, forward, smoothed, progress, passes)
    since = book("smoother", filtered)
    passes.update(filter=1, smoother=1)
    del timings["filter"]  # the filter's own solution has it
    notes, epochs, arcs = describe(noise, problem), {}, {"": float_arcs(problem)}
    if carriers[0] is not None:
        tell("ambiguities")
        fixed = fix(problem, carriers[0], smoothed, aligned.until, progress)
        problem, forward, smoothed = fixed.problem, fixed.forward, fixed.smoothed
        notes, epochs = (*notes, *fixed.notes), {"ekf": fixed.filtered_epochs, "": fixed.smoothed_epochs}
        arcs = {"ekf": fixed.filtered_arcs, "": fixed.smoothed_arcs}
        book("ambiguities", since)
    return Prepared(problem, noise, start, aligned, detections, forward, smoothed, notes, timings, passes, epochs, arcs)


def _estimate(
    base: Problem, aligned: Alignment, settings: Settings, progress: Progress | None, passes: Counter[str]
) -> NoiseEstimate:
    """The noise model, with spans of wrong measurements left out if they are to be."""
    estimate = estimate_noise if settings.gnss.faults == "off" else estimate_without_faults
    found = estimate(base, aligned.until, progress=progress)
    passes.update(filter=found.passes + found.looks, smoother=found.passes)
    return found


def start_sigma(start: Alignment) -> Array:
    """(15,) 1-sigma of the start, with a place that the alignment does not claim to know.

    It has the place from fixes that the problem uses too, by sigmas that may be wrong; without fixes it is where the
    start is said to be.
    """
    sigma = start.sigma.copy()
    if start.motion is None:
        return sigma
    sigma[BLOCKS["p"]] = np.hypot(sigma[BLOCKS["p"]], _FAR_AWAY)
    return sigma


def _is_likelier(base: Problem, plain: NoiseModel, found: NoiseEstimate) -> bool:
    """Whether the figures as stated make the innovations likelier than the estimate, with its prior, does.

    Both without what is left out: likelihoods are compared of the same measurements.
    """
    known = values_of(with_noise(base, found.noise), found.points)
    problem = with_noise(base, plain)
    forward = refilter(problem, points_of(problem, found.points.states, known))
    return float(np.sum(forward.log_likelihood)) > found.log_posterior


def _start(found: Alignment, stated: Alignment) -> Alignment:
    """Where estimation starts: the stated start, unless a filter from there would diverge."""
    return found if _has_diverged(found, stated) else stated


def _has_diverged(found: Alignment, stated: Alignment) -> bool:
    turn = found.state.minus(stated.state)[0, :3]
    return found.motion is not None and bool(np.linalg.norm(turn) > _FAR)


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
    if any(isinstance(c, _WHEELS) for c in problem.constraints):
        free = replace(problem, constraints=tuple(c for c in problem.constraints if not isinstance(c, _WHEELS)))
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


def _differ(a: Array, b: Array) -> bool:
    """Whether one has a stop that the other has nothing of."""
    return any(
        not np.any((other[:, 0] < end) & (other[:, 1] > begin)) for one, other in ((a, b), (b, a)) for begin, end in one
    )


def _smooth(problem: Problem, start: States) -> Solution:
    from graphnav.estimation.solvers.batch import batch

    return batch(split_carriers(problem)[0], start, wanted=(0,), reintegrate=False)


def _cut_aligned(recording: Recording, aligned: Alignment) -> Recording:
    """Without the fixes that an alignment has seen."""
    assert recording.gnss is not None
    assert aligned.until is not None
    return replace(recording, gnss=pick_fixes(recording.gnss, recording.gnss.t > aligned.until))
