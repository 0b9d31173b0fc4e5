"""From a recording to the problem that every solver gets: judged, posed, wrong fixes found and looked at again.

The filter finds wrong fixes as it goes (`graphnav.solvers.watch`), a smoothed solution without them says which were
right after all (`graphnav.faults`), and so again until nothing changes. The drive is filtered as a filter would only
at first and at last; in between it is linearised at what is known of it by then.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graphnav import faults
from graphnav.alignment import Alignment, align, with_known_heading
from graphnav.alignment.first import some
from graphnav.config import Settings
from graphnav.constraints.gnss import GnssPosition, GnssVelocity
from graphnav.constraints.vehicle import NonHolonomic, OdometerSpeed
from graphnav.detectors import Detections, detect
from graphnav.earth import LocalFrame
from graphnav.errors import EstimationError
from graphnav.judgement import MOST_RAISED, calmer, exhausted, judge_speeds, judged
from graphnav.judgement.residuals import record
from graphnav.problem import Problem, pose
from graphnav.progress import Progress, tell
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solution import Solution
from graphnav.solvers.batch import batch
from graphnav.solvers.ekf import ekf, refilter
from graphnav.solvers.near import near
from graphnav.solvers.passes import Filtered, Forward, Points, Smoothed, about_solved, near_to, points_of, values_of
from graphnav.solvers.robust import weight_and_cost
from graphnav.solvers.rts import backward
from graphnav.state import States

_FAR = 0.5  # rad between the stated and the found start attitude
_LOST = 0.1  # rad by which a filter may be off for a smoother to rest on it
_WHEELS = (NonHolonomic, OdometerSpeed)
_NOTHING = 0.1  # weight by a kernel that is next to none
_AGAIN = 2  # times that a start is looked for again without wrong fixes
_REVIEWS = 2  # of where faults begin and end
_MOST = 0.5  # share of the fixes of a kind that can be wrong


class Review:
    """A recording's problem, its filter and smoother, and what is to be said of them.

    Filtered once when made, so that starts can be compared; `finish` looks at what was found and smooths.

    Parameters
    ----------
    aligned : what was found of the start.
    detections : where the platform stands, by all fixes.

    Raises
    ------
    EstimationError
        If the recording does not determine a trajectory.
    """

    def __init__(
        self,
        recording: Recording,
        settings: Settings,
        frame: LocalFrame,
        aligned: Alignment,
        detections: Detections,
        progress: Progress | None,
    ) -> None:
        self._recording, self._settings, self._frame, self._progress = recording, settings, frame, progress
        self.aligned, self.detections = aligned, detections
        self.stated = with_known_heading(aligned, settings)
        # A stated heading far from the one found sends the filter, and its linearisation with it, astray for a while.
        # It stays in the problem as its prior, but all else is judged, and the smoother sets out, from what was found.
        found_heading = aligned.motion is not None  # without motion heading zero is only a convention
        turn = aligned.state.minus(self.stated.state)[0, :3]
        self.astray = found_heading and bool(np.linalg.norm(turn) > _FAR)
        self._begin = aligned if self.astray else self.stated
        self.timings = {"judgement": 0.0, "preintegration": 0.0, "smoother": 0.0}
        self._began = time.perf_counter()
        # most fixes contradict the filter, or nobody asks whether they do
        self._overruled = settings.gnss.faults == "off"
        self.finished = False
        self.explained = 0.0  # how many fixes had a say when they were last tested
        self.problem, self.notes = self._posed()
        self._forward: Forward
        self._filter()

    @property
    def refuted(self) -> bool:
        """Whether most fixes contradicted the filter."""
        return self._overruled and self._settings.gnss.faults != "off"

    @property
    def doubtful(self) -> bool:
        """Whether the start may be wrong: most fixes contradict it, or are far worse than any receiver states."""
        factor = self.problem.settings.gnss.sd_factor if self._settings.gnss.sd_factor is None else None
        factors = factor.values() if isinstance(factor, Mapping) else [factor or 1.0]
        return self.refuted or max(factors, default=1.0) > MOST_RAISED

    def finish(self) -> None:
        """Find wrong fixes from both sides, judge again where they misled the judgement, and smooth."""
        self._review()
        if self.refuted:
            # when most are wrong, and no other start finds them right, it is their sigmas that are
            other, says = self._posed()
            if says != self.notes:
                self.problem, self.notes = other, says
                self._filter()
                self._review()
        if faults.count(self.problem):
            self._calm()
            self._stand()
        lasts = self.problem.settings.gnss.fast_time
        if not lasts and exhausted(self.problem.recording.imu.noise, self._recording.imu.noise):
            # no wrong fixes explain it, and no IMU is as bad as that: most of the fixes may be wrong, for seconds each
            other, says = self._posed(faults.spans(self.problem, noisy=True), doubted=True)
            if says != self.notes:
                self.problem, self.notes = other, says
                self._filter()
                self._review()
        if not isinstance(self._forward, Filtered):
            self._forward = ekf(self.problem, self._progress, self.aligned.until)
            self.smoothed = self._smoothed(self.problem, self._forward)
        self.forward, self.finished = self._forward, True
        self._found_again()
        self.notes = (*self.notes, *self._raised)
        spent = sum(self.timings.values()) + self.forward.solution.timings["filter"]
        self.seconds = time.perf_counter() - self._began
        self.timings["smoother"] = self.seconds - spent

    def _posed(self, wrong: tuple[faults.Fault, ...] = (), doubted: bool = False) -> tuple[Problem, tuple[str, ...]]:
        """The problem with its figures judged, without spans of wrong fixes, and what is to be said of it."""
        frame, aligned, stationary, began = self._frame, self.aligned, self.detections.stationary, time.perf_counter()
        tell("judgement")
        recording, how, said = judged(
            self._recording, self._settings, frame, aligned, stationary, wrong, self._overruled, doubted
        )
        then = time.perf_counter()
        tell("preintegration")
        problem = pose(recording, how, frame, self._begin.state, self._begin.sigma, stationary)
        self.timings["judgement"] += then - began
        self.timings["preintegration"] += time.perf_counter() - then
        return problem, said

    def _filter(self) -> None:
        """Filter what was posed, with an eye on its fixes."""
        self._as_judged = self.problem  # by the judgement: no sigma raised yet
        self._raised: tuple[str, ...] = ()
        self._watch(None)

    def _review(self) -> None:
        """Look at what was found from both sides."""
        for _ in range(_REVIEWS):
            before = faults.count(self.problem)
            if not before:
                break
            apart = faults.widened(self.problem)
            _, self.smoothed = near(apart, self._forward, self.aligned.until, self._progress)
            self.problem = faults.readmitted(self.problem, self.smoothed)
            self._raise()
            self._watch(self.smoothed)
            if faults.count(self.problem) == before:
                break
        self._smooth()

    def _smooth(self) -> None:
        """Smooth the drive, again if that asks for other sigmas of wheels and velocities."""
        self.smoothed = self._smoothed(self.problem, self._forward)
        if self._raise():
            self._forward = self._filtered(self.problem)
            self.smoothed = self._smoothed(self.problem, self._forward)

    def _raise(self) -> bool:
        """Raise the sigmas of wheels and velocities as the smoothed solution asks for, once."""
        if not self._raised:
            self.problem, self._raised = judge_speeds(self.problem, self.smoothed)
            return bool(self._raised)
        return False

    def _watch(self, about: Points | None) -> None:
        """Filter the drive and give up the fixes that are found wrong; linearised at points where there are any."""
        forward = self._filtered(self.problem, about, watch=True)
        self.problem = faults.weighted(self.problem, forward.weights)
        self.explained = faults.said(self.problem)
        if self._settings.gnss.faults != "on" and faults.share(self.problem) > _MOST:
            self._overruled, self._raised = True, ()
            self.problem = faults.all_used(faults.weighted(self._as_judged, forward.weights))
            forward = self._filtered(self.problem, about)
        elif forward.anew:
            forward = self._filtered(self.problem, about)
        self._forward = forward

    def _stand(self) -> None:
        """Look for stops again without the wrong fixes: they may have spoken of motion where there was none."""
        found = detect(faults.doubted(self._recording, self.problem), self._settings)
        if not _differ(found.stationary, self.detections.stationary):
            return
        self.detections = found
        old, begin = self.problem, self._begin
        weights = {
            c.name: c.weight
            for c in old.constraints
            if isinstance(c, GnssPosition | GnssVelocity) and c.weight is not None
        }
        self.problem = faults.weighted(
            pose(old.recording, old.settings, self._frame, begin.state, begin.sigma, found.stationary), weights
        )
        self._forward, self._raised = self._filtered(self.problem), ()
        self._smooth()

    def _calm(self) -> None:
        """Judge the IMU once more: what faults did to the states around them may have passed for its noise."""
        weights = {c.name: c.weight for c in self.problem.constraints if c.weight is not None}
        other, says = self._posed(faults.spans(self.problem, noisy=True))
        if not calmer(other.recording.imu.noise, self.problem.recording.imu.noise):
            return
        other = faults.weighted(other, weights)
        about = points_of(other, self.smoothed.states, values_of(self.problem, self.smoothed))
        _, smoothed = near(other, about, self.aligned.until, self._progress)
        self.problem, self._raised = judge_speeds(other, smoothed)
        self.notes, self._forward = says, self._filtered(self.problem)
        self.smoothed = self._smoothed(self.problem, self._forward)

    def _filtered(self, problem: Problem, about: Points | None = None, watch: bool = False) -> Forward:
        if about is not None:
            return refilter(problem, about, self._progress, watch)
        return ekf(problem, self._progress, self.aligned.until, watch)

    def _smoothed(self, problem: Problem, forward: Forward) -> Smoothed:
        return backward(problem, forward, self._progress)

    def _found_again(self) -> None:
        """Filter and smooth about the batch solution where the filter was too far off for a smoother to rest on it.

        Fixes that weigh little beside wheels let a filter that is not sure of its heading turn the mounting round
        rather than the velocity, and no step finds back from there. So wheels come second.
        """
        problem, smoothed = self.problem, self.smoothed
        if near_to(smoothed, self.forward.linearised, _LOST) and not _refused(problem, smoothed):
            return
        states = smoothed.states
        if any(isinstance(c, _WHEELS) for c in problem.constraints):
            free = replace(problem, constraints=tuple(c for c in problem.constraints if not isinstance(c, _WHEELS)))
            states = backward(free, ekf(free, self._progress, self.aligned.until)).states
            states = batch(free, states, wanted=(), reintegrate=False).states
        solved = batch(problem, states, wanted=(), reintegrate=False)
        about = about_solved(problem, solved, smoothed)
        _, self.smoothed = near(problem, about, self.aligned.until, self._progress)
        self.forward = ekf(problem, self._progress, self.aligned.until, known=self.smoothed)


def _refused(problem: Problem, smoothed: Smoothed) -> bool:
    """Whether most of the fixes have next to no weight in a smoothed solution: it has lost its way, not they."""
    rows = next((c for c in problem.constraints if isinstance(c, GnssPosition)), None)
    if rows is None or rows.robust == "none":
        return False
    s = np.sqrt(record(problem, rows, smoothed).nis)
    return bool(np.mean(weight_and_cost(rows.robust, s, rows.robust_scale)[0] < _NOTHING) > _MOST)


def _differ(a: Array, b: Array) -> bool:
    """Whether one has a stop that the other has nothing of."""
    return any(
        not np.any((other[:, 0] < end) & (other[:, 1] > begin)) for one, other in ((a, b), (b, a)) for begin, end in one
    )


def reviewed(
    recording: Recording, settings: Settings, frame: LocalFrame, detections: Detections, progress: Progress | None
) -> Review:
    """Align a recording and review it; from another start where the fixes contradict the first.

    Most fixes contradict a filter that begins wrong. So where they do, what comes after the stretch of the alignment is
    aligned, and kept if most fixes agree with it. And no start is to rest on fixes that are wrong: once it is known
    which, it is looked for again without them, and where it is another, the drive is filtered again from there.

    Raises
    ------
    EstimationError
        If the recording does not determine a trajectory.
    """
    began = time.perf_counter()

    def aligned(fixes: Recording, stationary: Array) -> Alignment:
        tell("alignment")
        return align(fixes, settings, frame, _smooth, stationary)

    def begun(at: Alignment, detections: Detections) -> Review:
        return Review(recording, settings, frame, at, detections, progress)

    best = begun(aligned(recording, detections.stationary), detections)
    if not best.doubtful:
        best.finish()
    if best.doubtful and best.aligned.motion is not None and settings.gnss.faults != "off":
        try:
            other = begun(aligned(_later(recording, best.aligned), detections.stationary), detections)
            if not other.doubtful:
                other.finish()
            if not other.doubtful:
                best = other
        except EstimationError:
            pass  # nothing moves later on
    if not best.finished:
        best.finish()
    for _ in range(_AGAIN):
        if best.doubtful or best.aligned.motion is None or not faults.count(best.problem):
            break
        try:
            found = aligned(faults.doubted(recording, best.problem), best.detections.stationary)
            if found.motion is None or not found.contradicts(best.aligned):
                break
            other = begun(found, best.detections)
            other.finish()
        except EstimationError:
            break
        if other.doubtful or other.explained < best.explained:
            break
        best = other
    best.timings["alignment"] = time.perf_counter() - began - best.seconds
    return best


def _smooth(problem: Problem, start: States) -> Solution:
    return batch(problem, start, wanted=(0,), reintegrate=False)


def _later(recording: Recording, aligned: Alignment) -> Recording:
    """Without the fixes that an alignment has seen."""
    assert recording.gnss is not None
    assert aligned.until is not None
    return replace(recording, gnss=some(recording.gnss, recording.gnss.t > aligned.until))
