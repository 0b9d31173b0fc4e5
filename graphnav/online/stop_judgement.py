"""Stops of a running drive that the other measurements contradict, as `graphnav.estimation.noise.false_stops` has it.

Four seconds after a stop began, and whenever it is twice as old, up to half of the lag, the window is solved once more
in a thread, from its oldest keyframe and with the noise model in use. If the platform moves in some of the stops, a
second tracker processes the unsettled keyframes without these. Nothing settles before a stop has been judged once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.false_stops import find_false_stops, leave_out_false_stops, unite_stops
from graphnav.estimation.noise.initial_points import BREAKDOWN
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.noise.moments import collect_row_moments
from graphnav.estimation.noise.outliers import list_reduced
from graphnav.estimation.noise.tails import get_tail_index, weigh_outlying
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.passes import SmootherPass
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.online.around import ROWS_AFTER, compute_error_units, cut_around
from graphnav.online.noise_estimation import BackgroundEstimation, CatchUp, limit_thought
from graphnav.online.raw import drop_ambiguities
from graphnav.online.sensors import Sensors
from graphnav.online.tracker import Tracker
from graphnav.recording import Recording

_FIRST = 4.0  # s after its beginning at which a stop is judged first
_OLDEST = 0.5  # of the lag, the age at which a stop is judged last
_THINKING = 0.25  # of the time that an estimation of the noise model may take: one filter and smoother


@dataclass(frozen=True)
class StopTask:
    """The rows of a window, what is known at its oldest keyframe, and its stops."""

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

    def run(self) -> Array:
        """(n, 2) s, the stops in which the platform moves."""

        def judge(one: tuple[Problem, Problem, SmootherPass, Array]) -> Array:
            base, used, smoothed, stationary = one
            return find_false_stops(base, self._weigh(used, smoothed), (smoothed, used), stationary)[0]

        return leave_out_false_stops(self._solve(None, NONE), judge, self._solve)[1]

    def _weigh(self, used: Problem, smoothed: SmootherPass) -> NoiseModel:
        """The noise model with weights for rows in the tails since it was estimated: one wrong fix outweighs a stop."""
        weights = dict(self.noise.weights)
        for rows in used.constraints:
            if rows.list_noise_groups()[0] and not rows.of_stops and len(rows):
                left_out, m = collect_row_moments(used, rows, smoothed, len(rows)).left_out, len(rows.axes)
                before = np.ones(len(rows)) if rows.weight is None else rows.weight
                weight = np.minimum(before, weigh_outlying(left_out, m, get_tail_index({}, rows.name, m)))
                weights[rows.name] = list_reduced(used.t[rows.keyframe], weight, before > 0.0)
        return replace(self.noise, weights=weights)

    def _solve(self, _: object, false: Array) -> tuple[Problem, Problem, SmootherPass, Array]:
        """The window without false stops, with stated noise; as it is solved, and its solution; and the stops."""
        stationary = subtract_spans(self.stationary, false)
        base = build_problem(
            self.recording, self.settings, self.frame, self.start, self.sigma, stationary, self.times,
            typical=self.units, parts_of_noise=True,
        )  # fmt: skip
        rows = (replace(c, drive_error=self.unit) if isinstance(c, GnssPosition) else c for c in base.constraints)
        base = replace(base, constraints=tuple(rows))
        if self.settled:
            base = weigh_rows(base, {c.name: (c.keyframe > 0).astype(float) for c in base.constraints})
        base = free(base, self.noise.freed)
        used = apply_noise(base, self.noise)
        # as if it never stood: a false stop would lead the points astray at which true ones are judged
        used = weigh_rows(used, {c.name: np.zeros(len(c)) for c in used.constraints if c.of_stops})
        return base, used, smooth_backward(used, ekf(used)), stationary


class StopJudge:
    """Judges the stops in the window, each again when it is twice as old."""

    def __init__(self) -> None:
        self._begun = self._done = -np.inf  # s, the newest keyframe of the last judgement, and of the last result
        self._running: BackgroundEstimation | None = None

    def holds(self, tracker: Tracker) -> bool:
        """Whether a stop has not been judged yet, and nothing may settle that depends on it."""
        return _can_judge(tracker) and bool(np.any(tracker.stops[:, 0] > self._done - _FIRST))

    def look(self, sensors: Sensors, tracker: Tracker, last: bool = False) -> CatchUp | None:
        """Start to judge the stops of a tracker where that is due, or take the result; returns the tracker without
        false stops, if there are any, which has to catch up.

        Parameters
        ----------
        last : whether no more rows will come: nothing is waited for.
        """
        lag, now = tracker.settings.solver.lag, tracker.newest
        if self._running is None:
            age, before = now - tracker.stops[:, 0], np.maximum(self._begun - tracker.stops[:, 0], 0.0)
            due = (before < _OLDEST * lag) & ((age >= np.maximum(2.0 * before, _FIRST)) | (last and now > self._begun))
            if not _can_judge(tracker) or not due.any():
                return None
            task = BackgroundEstimation(_describe(sensors, tracker), now + _THINKING * limit_thought(lag))
            self._begun, self._running = now, task
        if not last and now < self._running.due:
            return None
        running, self._running, self._done = self._running, None, self._begun
        try:
            false = running.wait()
        except BREAKDOWN:
            return None
        if not len(false):
            return None
        noise = replace(tracker.noise, false_stops=unite_stops(tracker.noise.false_stops, false))
        return CatchUp(tracker.restart_settled(noise, sensors.setup))


def _can_judge(tracker: Tracker) -> bool:
    """Whether there are stops, and a noise model to judge them by."""
    return not tracker.foot and bool(tracker.noise.figures) and len(tracker.stops) > 0


def _describe(sensors: Sensors, tracker: Tracker) -> StopTask:
    times, head, noise = tracker.times, tracker.window.head, tracker.noise
    # behind these a stop may go on: fixes there are no more to be believed than those in it
    times = times[times <= tracker.detected_until + SAME_TIME]
    recording = cut_around(sensors, float(times[0]), float(times[-1]) + ROWS_AFTER)
    excluded = {name: list(spans) for name, spans in noise.excluded.items()}
    for fault in tracker.excluded:
        excluded.setdefault(fault.kind, []).append((fault.t_start, fault.t_end))
    head = head.move(head.estimate)
    return StopTask(
        recording,
        drop_ambiguities(tracker.settings, sensors.setup),
        tracker.frame,
        times,
        head.state,
        np.sqrt(np.diag(head.covariance)[:DIM]),
        tracker.opened,
        compute_error_units(sensors, recording),
        sensors.gnss.compute_unit(),
        replace(noise, excluded={name: tuple(spans) for name, spans in excluded.items()}),
        tracker.stops,
    )
