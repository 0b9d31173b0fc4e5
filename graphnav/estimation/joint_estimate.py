"""The noise model and the stated constants that the drive contradicts, estimated together.

Constants are tested before the search for faults, because their errors are in all measurements and would be taken for
faults of some of them; and again once all faults are known, because a gyro that misses a turn looks like a wrong lever
arm, and so do wrong fixes and stamps that are still to be moved.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from graphnav.config.gnss import GnssSettings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET, VELOCITY_TIME_OFFSET
from graphnav.constraints.odometer import ODOMETER_DELAY
from graphnav.core.progress import Progress
from graphnav.estimation.contradictions import (
    Freed,
    are_same,
    compute_prior_cost,
    find_contradicted_constants,
    free,
    update_freed,
)
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.decision import log_evidence, weigh_evidence
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.exclusion import estimate_disturbed_intervals, estimate_without_faults
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, VarianceComponent
from graphnav.estimation.noise.priors import get_prior
from graphnav.estimation.noise.scales import are_scales_contradicted
from graphnav.estimation.offsets import is_offset_far
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.passes import carry_points
from graphnav.imu.dynamics import PRIORS


@dataclass(frozen=True)
class JointEstimate:
    """A noise model, and the constants that are parameters in it instead of as stated."""

    stated: Problem  # with stated noise, and all constants as stated
    freed: Freed
    estimate: NoiseEstimate
    tested: NoiseModel | None = None  # with which the constants were tested last, and stayed as they are
    rival: JointEstimate | None = None  # less likely with all measurements, from the initial figures as stated

    @property
    def base(self) -> Problem:
        """The problem with stated noise that the noise model is of."""
        return free(self.stated, self.freed)

    @property
    def noise(self) -> NoiseModel:
        """The noise model with the freed constants."""
        return replace(self.estimate.noise, freed=self.freed)

    def compute_evidence(self) -> float:
        """The logarithm of the evidence of the measurements."""
        return log_evidence(self.base, self.estimate) - compute_prior_cost(self.stated, self.freed)

    def weigh(self) -> JointEstimate:
        """The same with the evidence of all measurements, and the passes that this takes."""
        return replace(self, estimate=weigh_evidence(self.base, self.estimate))

    def count(self, passes: Counter[str]) -> JointEstimate:
        """The same after this many passes."""
        return replace(self, estimate=replace(self.estimate, passes=passes))


# a problem with stated noise, and the estimate with other constants free -> its noise model
_Estimate = Callable[[Problem, JointEstimate], NoiseEstimate]


def estimate_jointly(
    stated: Problem, settings: GnssSettings, opening: float | None = None, progress: Progress | None = None
) -> JointEstimate:
    """The noise model, with constants free that the drive contradicts, and without spans of wrong measurements.

    Parameters
    ----------
    stated : built with stated noise and the parts of its intervals' noise.
    settings : which constants are exact, and whether spans of wrong measurements are left out.
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.

    Raises
    ------
    EstimationError
        If the filter breaks down.
    """
    found = free_contradicted(estimate_as_stated(stated, opening, progress), settings, opening, progress)
    return leave_out_jointly(found, settings, opening, progress)


def estimate_as_stated(
    stated: Problem, opening: float | None = None, progress: Progress | None = None
) -> JointEstimate:
    """The same with all constants as stated."""
    first = estimate_noise(stated, opening, progress=progress)
    other = _estimate_with_worse_imu(stated, first, opening, progress)
    if other is None:
        return JointEstimate(stated, {}, first)
    if other.log_evidence <= first.log_evidence + first.gained_by_chance:
        return JointEstimate(stated, {}, replace(first, passes=first.passes + other.passes))
    return JointEstimate(stated, {}, other, rival=JointEstimate(stated, {}, first))


def estimate_moved(stated: Problem, found: JointEstimate, progress: Progress | None = None) -> JointEstimate:
    """The same of a drive with its stamps moved, from figures and points of the estimate before: all but offsets.

    Parameters
    ----------
    found : with other stamps. Where no worse IMU was likelier, none is with better ones.
    """
    best, before = found.estimate, found.base
    start = NoiseModel(best.noise.figures, best.noise.times, tails=best.noise.tails)
    moved = apply_noise(stated, start)
    offsets = TIME_OFFSET, VELOCITY_TIME_OFFSET, CLOCK_RATE
    near = carry_points(best.points, apply_noise(before, best.noise), moved, offsets)
    return JointEstimate(stated, {}, estimate_noise(stated, None, start, (near, moved), progress))


def free_contradicted(
    found: JointEstimate, settings: GnssSettings, opening: float | None = None, progress: Progress | None = None
) -> JointEstimate:
    """The same with the constants free that the drive contradicts."""

    def estimate(base: Problem, before: JointEstimate, start: NoiseModel | None = None) -> NoiseEstimate:
        near = before.estimate.get_linearisation(before.base)
        return estimate_noise(base, opening, start, near, progress)

    def go_on(base: Problem, before: JointEstimate) -> NoiseEstimate:
        return estimate(base, before, before.estimate.noise)

    one, rival = (
        None if one is None else _free_constants(replace(one, rival=None), settings, go_on, estimate)
        for one in (found, found.rival)
    )
    assert one is not None
    return replace(one, rival=rival)


def _estimate_with_worse_imu(
    stated: Problem, found: NoiseEstimate, opening: float | None, progress: Progress | None
) -> NoiseEstimate | None:
    """Where by an estimate an aiding sensor is worse than its prior's sigma, one that begins with the IMU as many
    sigmas worse instead.

    A bias walk that is small beside all other noise changes nothing, so that no step leads from there to an optimum at
    which it explains everything.
    """
    if found.excess <= 1.0:
        return None
    worse = {}
    for name in found.noise.figures:
        median, sigma = get_prior(name)
        worse[name] = VarianceComponent(median + name.startswith("imu.") * found.excess * sigma)
    with contextlib.suppress(*BREAKDOWN):
        near = found.get_linearisation(stated)
        return estimate_noise(stated, opening, NoiseModel(worse), near, progress, known=found)
    return None


def leave_out_jointly(
    found: JointEstimate, settings: GnssSettings, opening: float | None = None, progress: Progress | None = None
) -> JointEstimate:
    """The same without spans of wrong measurements; what is given is as for `estimate_jointly`.

    With these among the measurements, an IMU that is worse may be the likelier explanation, so rivals are compared now,
    unless all figures are estimated without some measurements.
    """
    best = replace(
        found, rival=None, estimate=_leave_out_faults(found.base, found.estimate, settings, opening, progress)
    )
    if found.rival is None or best.noise.excluded:  # without what may have made the IMU look worse
        return best
    best, plain = best.weigh(), leave_out_jointly(found.rival, settings, opening, progress).weigh()
    likelier = best.compute_evidence() > plain.compute_evidence() + plain.estimate.gained_by_chance
    return (best if likelier else plain).count(best.estimate.passes + plain.estimate.passes)


def revise_jointly(
    found: JointEstimate, settings: GnssSettings, opening: float | None = None, progress: Progress | None = None
) -> JointEstimate:
    """The same with single intervals of the IMU disturbed where they are, and the constants tested again.

    Parameters
    ----------
    found : by `estimate_jointly`; the others are as there.
    """

    def estimate(base: Problem, before: JointEstimate) -> NoiseEstimate:
        near = before.estimate.get_linearisation(before.base)
        one = estimate_noise(base, opening, near=near, progress=progress)
        return estimate_disturbed_intervals(base, _leave_out_faults(base, one, settings, opening, progress))

    def go_on(base: Problem, before: JointEstimate) -> NoiseEstimate:
        noise, near = before.estimate.noise, before.estimate.get_linearisation(before.base)
        return estimate_noise(base, opening, noise, near, progress, any(name in noise.weights for name in INTERVALS))

    found = replace(found, estimate=estimate_disturbed_intervals(found.base, found.estimate))
    return _estimate_scales(_free_constants(found, settings, go_on, estimate), progress)


def _estimate_scales(found: JointEstimate, progress: Progress | None) -> JointEstimate:
    """The same with the sizes of the IMU's scale errors, if these are significantly other than stated.

    Last of all, because a turn that the gyro misses and fixes that are wrong look like scale errors too.
    """
    base, best = found.base, found.estimate
    if not are_scales_contradicted(base, best):
        return found
    intervals = any(name in best.noise.weights for name in INTERVALS)
    near, found = best.get_linearisation(base), found.weigh()
    passes, limit = found.estimate.passes, found.compute_evidence() + 0.5 * len(PRIORS)  # half of each figure by chance
    # the figures found lead to the nearest optimum soonest; with other scale errors behind them it may be a bad one
    for start in (best.noise, NoiseModel(weights=best.noise.weights, excluded=best.noise.excluded)):
        with contextlib.suppress(*BREAKDOWN):
            one = estimate_noise(base, None, start, near, progress, intervals, scales=True)
            other = replace(found, estimate=one).weigh()
            passes = passes + other.estimate.passes
            if other.compute_evidence() > limit:
                return other.count(passes)
    return found.count(passes)


def _leave_out_faults(
    base: Problem, found: NoiseEstimate, settings: GnssSettings, opening: float | None, progress: Progress | None
) -> NoiseEstimate:
    return found if settings.faults == "off" else estimate_without_faults(base, found, opening, progress)


def _free_constants(found: JointEstimate, settings: GnssSettings, *ways: _Estimate) -> JointEstimate:
    """Free the constants that the drive contradicts as stated, and no others, and estimate the noise model anew, in the
    first of some ways by which the evidence is no smaller: the figures found lead to the nearest optimum soonest, and
    where a wrong constant or a fault is behind them, that is a bad one. Where it is as likely as before but for what
    is gained by chance, nothing is behind them, and what is free stays.

    Where these are free already, the estimate stays; where it is the one that they were tested with last, so do they.
    """
    if found.estimate.noise is found.tested:
        return found
    base, before = found.stated, found.freed
    passes, tested = found.estimate.passes + Counter(filter=1), found.estimate.noise
    names = set[str]() if settings.clock_rate_sigma == 0.0 else {CLOCK_RATE}
    if not is_offset_far(apply_noise(found.base, tested), found.estimate.points):
        names |= {LEVER_ARM, TIME_OFFSET, VELOCITY_TIME_OFFSET, ODOMETER_DELAY}
    try:
        freed = find_contradicted_constants(base, found.estimate, before, names)
        if not are_same(freed, before, base):
            found = found.weigh()
            passes = found.estimate.passes + Counter(filter=1)
            for estimate in ways:
                other = replace(found, freed=freed, estimate=estimate(free(base, freed), found)).weigh()
                passes = passes + other.estimate.passes + Counter(filter=1)
                gained, by_chance = other.compute_evidence() - found.compute_evidence(), other.estimate.gained_by_chance
                # from the priors, figures may lead to a worse optimum than before; of fewer constants less is expected
                if gained >= (-by_chance if estimate is ways[-1] or freed.keys() < before.keys() else 0.0):
                    found = other
                    break
                if gained > -by_chance:  # in the same optimum, where they are worth nothing
                    break
            freed = update_freed(base, found.estimate, found.freed)
    except BREAKDOWN:
        return found.count(passes)
    return replace(found, freed=freed, tested=tested).count(passes)
