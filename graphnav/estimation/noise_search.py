"""The search for a recording's noise model: figures, constants, false stops, spans that are left out, and a start that
rests on none of these.

In order of what it costs, so that what has one simple cause is not searched for twice: figures and constants of all
measurements; the stops that these contradict; and only then spans of wrong measurements. A fault of the fixes may be
what contradicts a stop. So where spans are left out although stops are, all is found anew with every stop, and these
are judged when the faults are known.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from graphnav.core.progress import Progress
from graphnav.core.rotation import Array
from graphnav.detectors.base import NONE
from graphnav.estimation.building import BuiltProblem, ProblemBuilder
from graphnav.estimation.joint_estimate import (
    JointEstimate,
    estimate_as_stated,
    estimate_moved,
    free_contradicted,
    leave_out_jointly,
    revise_jointly,
)
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.false_stops import find_false_stops, leave_out_false_stops, unite_stops
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.noise.rivals import find_rivals
from graphnav.estimation.noise.span_variances import weigh_excluded
from graphnav.estimation.noise.tails import widen_by_tails
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points

# whether the evidence of a noise model is wanted, by the problem and the points of its estimate
Weigh = Callable[[Problem, Points], bool]

Estimated = tuple[BuiltProblem, JointEstimate]  # a problem and the estimate on it


def begin_noise(builder: ProblemBuilder, built: BuiltProblem, progress: Progress | None) -> Estimated:
    """The problem and its noise model of all measurements.

    Parameters
    ----------
    built : without the false stops of the builder.

    Raises
    ------
    EstimationError
        If the filter breaks down.
    """
    return free_wrong_constants(builder, estimate_first(built, progress), progress)


def estimate_first(built: BuiltProblem, progress: Progress | None, before: JointEstimate | None = None) -> Estimated:
    """The same with all constants as stated; `before` is the estimate with other stamps, if any."""
    if before is not None:
        return built, estimate_moved(built.problem, before, progress)
    return built, estimate_as_stated(built.problem, built.aligned.opening, progress)


def free_wrong_constants(builder: ProblemBuilder, first: Estimated, progress: Progress | None) -> Estimated:
    """The same with the constants free that the drive contradicts."""
    built, found = first
    return built, free_contradicted(found, builder.settings.gnss, built.aligned.opening, progress)


def leave_out_contradicted_stops(
    builder: ProblemBuilder, begun: Estimated, progress: Progress | None, passes: Counter[str]
) -> tuple[Array, Estimated]:
    """The false stops (n, 2), s, by all other measurements, and the noise model of these, with nothing else left out.

    Parameters
    ----------
    begun : of `begin_noise`.
    passes : to which those made for stops are added; the others are with the estimate.
    """

    def begin_without(before: Estimated, false: Array) -> Estimated:
        moving = replace(builder, false_stops=false)
        return _count(begin_noise(moving, moving.build_moving(before[0]), progress), before)

    one, false = leave_out_false_stops(begun, partial(_judge, passes), begin_without, builder.false_stops)
    return false, one


def find_noise(
    builder: ProblemBuilder,
    begun: Estimated,
    progress: Progress | None,
    passes: Counter[str],
    weigh: Weigh | None,
) -> tuple[NoiseModel, BuiltProblem, float, tuple[Points, Problem]]:
    """The noise model, the problem with a start and stops that rest on no excluded fix, the logarithm of the evidence
    where it is wanted, and the points of the estimate with the problem that they are of.

    Where the other measurements contradict stops, all is found anew without these.

    Parameters
    ----------
    builder, begun : with the false stops of `leave_out_contradicted_stops`, and what it found.
    passes : to which those made are added.
    """

    def judge(one: Estimated) -> Array:
        return NONE if one[1].estimate.noise is begun[1].estimate.noise else _judge(passes, one)

    def find_without(before: Estimated, false: Array) -> Estimated:
        if np.array_equal(false, builder.false_stops):
            return _count(found, before)
        moving = replace(builder, false_stops=false)
        return _count(_find(moving, begin_noise(moving, moving.build_moving(before[0]), progress), progress), before)

    one = found = _find(builder, begun, progress)
    false = builder.false_stops
    if len(false) and found[1].noise.excluded:
        with contextlib.suppress(*BREAKDOWN):
            every = replace(builder, false_stops=NONE)
            one = _count(_find(every, begin_noise(every, every.build_every(found[0]), progress), progress), found)
            false = NONE
    (built, joint), false = leave_out_false_stops(one, judge, find_without, false)
    best, built = joint.estimate, replace(built, problem=joint.base)
    wanted = weigh is not None and weigh(apply_noise(built.problem, best.noise), best.points)
    joint = joint.weigh() if wanted else joint
    evidence = joint.compute_evidence() if wanted else np.inf
    passes.update(joint.estimate.passes + Counter(filter=1))
    plain = NoiseModel(excluded=best.noise.excluded, freed=joint.freed)
    likelier = _is_likelier(built.problem, plain, best)
    noise = plain if likelier else widen_by_tails(built.problem, joint.noise)
    near = best.get_linearisation(built.problem)
    rivals, spent = find_rivals(built.problem, best)
    passes.update(filter=spent)
    noise = replace(noise, rivals=rivals)
    if noise.excluded:
        with contextlib.suppress(*BREAKDOWN):
            noise, spent = weigh_excluded(built.problem, noise, near)
            passes.update(filter=spent, smoother=spent)
    return replace(noise, false_stops=unite_stops(false)), built, evidence, near


def _judge(passes: Counter[str], one: Estimated) -> Array:
    """The false stops (n, 2) of an estimate, s; the passes that it takes are added."""
    built, found = one
    near = found.estimate.get_linearisation(found.base)
    false, spent = find_false_stops(found.base, found.estimate.noise, near, built.detections.stationary)
    passes.update(filter=spent)
    return false


def _count(one: Estimated, before: Estimated) -> Estimated:
    """The estimate with the passes of one before it as well."""
    return one[0], one[1].count(before[1].estimate.passes + one[1].estimate.passes)


def _find(builder: ProblemBuilder, begun: Estimated, progress: Progress | None) -> Estimated:
    """The problem with a start and stops that rest on no excluded fix, and the estimate on it, from that of all
    measurements.
    """
    settings, built = builder.settings.gnss, begun[0]
    found = leave_out_jointly(begun[1], settings, built.aligned.opening, progress)
    if found.noise.excluded:
        built, found = _start_without(builder, built, found, progress)
    found = revise_jointly(found, settings, built.aligned.opening, progress)
    return _start_anew(builder, built, found) if found.freed else (built, found)


def _start_without(
    builder: ProblemBuilder, built: BuiltProblem, found: JointEstimate, progress: Progress | None
) -> tuple[BuiltProblem, JointEstimate]:
    """The same with a start and stops that rest on no excluded fix."""
    without = builder.build_without(built, found.noise, parts=True)
    if without is built:
        return built, found
    again = replace(found, stated=without.problem)

    def estimate(near: tuple[Points, Problem] | None = None, known: NoiseEstimate | None = None) -> NoiseEstimate:
        start, opening = found.estimate.noise, without.aligned.opening
        return estimate_noise(again.base, opening, start, near, progress, known=known)

    if not np.array_equal(without.problem.t, built.problem.t):
        best = estimate()
    else:
        # the points known rest on the start before, and a filter from the new one may diverge: the likelier
        best = near = estimate(found.estimate.get_linearisation(found.base))
        with contextlib.suppress(*BREAKDOWN):
            fresh = estimate(known=near)
            likelier = max(near, fresh, key=lambda one: one.log_evidence)
            best = replace(likelier, passes=near.passes + fresh.passes)
    return without, replace(again, estimate=best).count(found.estimate.passes + best.passes)


def _start_anew(
    builder: ProblemBuilder, built: BuiltProblem, found: JointEstimate
) -> tuple[BuiltProblem, JointEstimate]:
    """The same with a start that depends on no constant as stated that is free."""
    anew = builder.build_without(built, found.noise, parts=True, anew=True)
    again = replace(found, stated=anew.problem, estimate=replace(found.estimate, whole_evidence=None))
    if np.array_equal(anew.problem.t, built.problem.t):
        return anew, again
    best = estimate_noise(again.base, anew.aligned.opening, found.estimate.noise)
    return anew, replace(again, estimate=best).count(found.estimate.passes + best.passes)


def _is_likelier(base: Problem, plain: NoiseModel, found: NoiseEstimate) -> bool:
    """Whether the stated figures are more probable than the estimate, its prior included.

    Both leave the same measurements out, so that the likelihoods compare.
    """
    problem = apply_noise(base, plain)
    forward = refilter(problem, found.carry_points(base, problem), whole=False)
    return float(np.sum(forward.log_likelihood)) > found.log_evidence
