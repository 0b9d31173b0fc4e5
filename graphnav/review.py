"""From a recording to the problem that every solver gets: judged, posed, wrong fixes found and looked at again.

The filter finds wrong fixes as it goes (`graphnav.solvers.watch`), a smoothed solution without them says which were
right after all (`graphnav.faults`), and so again until nothing changes. The drive is filtered as a filter would only
at first and at last; in between it is linearised at what is known of it by then.
"""

from __future__ import annotations

import time

import numpy as np

from graphnav import faults
from graphnav.alignment import Alignment
from graphnav.config import Settings
from graphnav.constraints.gnss import GnssPosition, GnssVelocity
from graphnav.detectors import Detections, detect
from graphnav.earth import LocalFrame
from graphnav.judgement import calmer, judge_speeds, judged
from graphnav.problem import Problem, pose
from graphnav.progress import Progress, tell
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solvers.ekf import ekf, refilter
from graphnav.solvers.near import near
from graphnav.solvers.passes import Filtered, Forward, Points, Smoothed, points_of, values_of
from graphnav.solvers.rts import backward

_REVIEWS = 2  # of where faults begin and end
_MOST = 0.5  # share of the fixes of a kind that can be wrong


class Review:
    """A recording's problem, its filter and smoother, and what is to be said of them.

    Parameters
    ----------
    aligned : what was found of the start.
    begin : what the problem begins with; the same, but for a heading that is stated.
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
        begin: Alignment,
        detections: Detections,
        progress: Progress | None,
    ) -> None:
        self._recording, self._settings, self._frame, self.detections = recording, settings, frame, detections
        self._aligned, self._begin, self._progress = aligned, begin, progress
        self.timings = {"judgement": 0.0, "preintegration": 0.0, "smoother": 0.0}
        # most fixes contradict the filter, or nobody asks whether they do
        self._overruled = asked = settings.gnss.faults == "off"
        began = time.perf_counter()
        self.problem, self.notes = self._posed()
        self._forward: Forward
        self._review()
        if self._overruled and not asked:
            # when most are wrong it is their sigmas that are
            other, says = self._posed()
            if says != self.notes:
                self.problem, self.notes = other, says
                self._review()
        if faults.count(self.problem):
            self._calm()
            self._stand()
        if not isinstance(self._forward, Filtered):
            self._forward = ekf(self.problem, progress, aligned.until)
            self.smoothed = self._smoothed(self.problem, self._forward)
        self.forward = self._forward
        self.notes = (*self.notes, *self._raised)
        spent = sum(self.timings.values()) + self.forward.solution.timings["filter"]
        self.timings["smoother"] = time.perf_counter() - began - spent

    def _posed(self, wrong: tuple[faults.Fault, ...] = ()) -> tuple[Problem, tuple[str, ...]]:
        """The problem with its figures judged, without spans of wrong fixes, and what is to be said of it."""
        frame, aligned, stationary, began = self._frame, self._aligned, self.detections.stationary, time.perf_counter()
        tell("judgement")
        recording, how, said = judged(
            self._recording, self._settings, frame, aligned, stationary, wrong, self._overruled
        )
        then = time.perf_counter()
        tell("preintegration")
        problem = pose(recording, how, frame, self._begin.state, self._begin.sigma, stationary)
        self.timings["judgement"] += then - began
        self.timings["preintegration"] += time.perf_counter() - then
        return problem, said

    def _review(self) -> None:
        """Find wrong fixes, and look at them again."""
        self._as_judged = self.problem  # by the judgement: no sigma raised yet
        self._raised: tuple[str, ...] = ()
        self._watch(None)
        for _ in range(_REVIEWS):
            before = faults.count(self.problem)
            if not before:
                break
            apart = faults.widened(self.problem)
            _, self.smoothed = near(apart, self._forward, self._aligned.until, self._progress)
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
        _, smoothed = near(other, about, self._aligned.until, self._progress)
        self.problem, self._raised = judge_speeds(other, smoothed)
        self.notes, self._forward = says, self._filtered(self.problem)
        self.smoothed = self._smoothed(self.problem, self._forward)

    def _filtered(self, problem: Problem, about: Points | None = None, watch: bool = False) -> Forward:
        if about is not None:
            return refilter(problem, about, self._progress, watch)
        return ekf(problem, self._progress, self._aligned.until, watch)

    def _smoothed(self, problem: Problem, forward: Forward) -> Smoothed:
        return backward(problem, forward, self._progress)


def _differ(a: Array, b: Array) -> bool:
    """Whether one has a stop that the other has nothing of."""
    return any(
        not np.any((other[:, 0] < end) & (other[:, 1] > begin)) for one, other in ((a, b), (b, a)) for begin, end in one
    )
