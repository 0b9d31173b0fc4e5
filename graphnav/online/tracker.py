"""The graph of a running drive: keyframes built as they come, stops classified, the window maintained and settled.

New keyframes are built like a recording (`graphnav.estimation.problem.build_problem`), from the rows around them: the
same code builds the same rows as offline. Whatever changes the past inside the window (a fix that arrives late, a stop
that is recognised a second or two after it began) removes the keyframes from there on and builds them again.

`update` is on the critical path; `work_ahead` does one task at a time that nothing waits for. This includes all of the
next keyframe but its fix: as soon as its interval is available it is built and predicted. Prepared work is used if
nothing it depends on has changed; otherwise `update` redoes it, from the same rows by the same code.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME, TypicalSigmas
from graphnav.constraints.lasting import find_fix_period, find_node_spacing
from graphnav.constraints.odometer import DELAY_SIGMAS, ODOMETER_DELAY
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.detectors.base import merge_spans
from graphnav.estimation.contradictions import free
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import STATED, NoiseModel
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solvers.elimination import Predicted
from graphnav.estimation.solvers.incremental import are_due
from graphnav.estimation.solvers.stages import Message, Place, forget_rows
from graphnav.estimation.solvers.window import SettledStates
from graphnav.imu.dynamics import ImuFactors
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.online.ahead import Live, live, predict_since
from graphnav.online.around import ROWS_AFTER, ROWS_BEFORE, compute_error_units, cut_around
from graphnav.online.chain import BuiltKeyframes, Chain, find_turn
from graphnav.online.looks import CONTEXT, SURE, Readings, clip_spans
from graphnav.online.sensors import Sensors
from graphnav.online.steps import StepCutter
from graphnav.recording import Recording
from graphnav.recording.odometer import MeanSpeed

_REBUILT_BEFORE = 6  # keyframes built again with a new one in a stop, so that the stop is recognised
_SMOOTHED = 8  # covariances smoothed in the time of one relinearisation
_LATEST_SETTLING = 0.5  # of the lag by which settling may be delayed while states still move


@dataclass(frozen=True)
class _Ahead:
    """The next keyframe, built and predicted except for its fix, and what that depends on."""

    problem: Problem
    keyframe: Predicted
    stops: Array
    wrong: Array  # spans of the odometer


class Tracker(Chain):
    """Keyframes of a running drive.

    Parameters
    ----------
    message, t0 : the prior and the time it is for.
    setup : of the sensors.
    noise : the noise model in use.
    """

    at_a_row = 64  # keyframes relinearised per row of the IMU
    at_every_row = False  # whether missing rows would change the schedule of work

    def __init__(
        self,
        settings: Settings,
        frame: LocalFrame,
        message: Message,
        t0: float,
        setup: Recording,
        noise: NoiseModel = STATED,
    ) -> None:
        super().__init__(settings, message, t0, setup, noise)
        self.frame, self.foot = frame, setup.platform == "foot"
        self._readings = Readings()
        self._steps = StepCutter()
        self.settled: list[SettledStates] = []
        self.in_force: dict[str, int] = {}  # rows of each constraint at the newest keyframe
        self.seconds: dict[str, float] = {}  # CPU seconds of its thread, by task of the newest update
        self._motions: dict[float, ImuFactors] = {}  # integrated intervals, by their end times
        self._dirty = np.inf  # s, from where on keyframes are to be redone with the next
        self._ahead: _Ahead | None = None
        self._tried = -np.inf  # s, the newest keyframe when settling was last due
        self._settling = False  # whether some are to settle once they have been relinearised

    def note_late_row(self, sensor: str, t: float) -> None:
        """A row arrived after newer ones of its sensor: discard what was prepared from those beyond it."""
        self._ahead = None
        if sensor == "imu":
            self._motions = {end: one for end, one in self._motions.items() if end < t}

    def update(self, sensors: Sensors, new: Array, dirty: float = np.inf) -> float:
        """Add keyframes at the times `new`, after the newest, and redo those from `dirty` on.

        Returns the first that was redone, s.
        """
        clock = [time.thread_time()]
        if dirty < np.inf:
            self._motions = {t: one for t, one in self._motions.items() if t < dirty}
        now = max(self.newest, float(new[-1]) if len(new) else -np.inf)
        if not self.foot:
            if self._standing.is_due(now):
                self._standing.look(sensors, self.settings, now, min([self.head, *new.tolist()]))
            if self._standing.news:
                dirty = min(dirty, self._standing.take(np.concatenate([self.times, new])))
            if not self._readings.looked:
                self._readings.look(sensors, now)
        dirty, self._dirty = min(dirty, self._dirty), np.inf
        clock.append(time.thread_time())
        built = self._begin(sensors, new, dirty)
        if built is None:
            return np.inf
        clock.append(time.thread_time())
        back = self._add(built.problem, built.first, built.ahead)
        self._finish_keyframes()
        clock.append(time.thread_time())
        if len(new):
            self.seconds = dict(zip(("detecting", "building", "solving"), np.diff(clock).tolist(), strict=True))
        return built.redone if back is None else min(built.redone, self._go_back(sensors, built, back))

    def _begin(self, sensors: Sensors, new: Array, dirty: float) -> BuiltKeyframes | None:
        """Build the keyframes at the times `new` and those from `dirty` (s) on, which are removed; None if there are
        none.
        """
        again = [stage.place.t for stage in self.window.select_since(dirty - SAME_TIME)]
        if not again and not len(new):
            return None
        times = new
        if again or len(new) > 1:
            times = np.unique(np.concatenate([again, new]))
            times = times[np.concatenate([[True], np.diff(times) > SAME_TIME])]
        keep = len(self.window) - len(again)
        before = self._list_before(keep, float(times[0]))
        self._keep(keep)
        ahead, self._ahead = self._ahead if self._is_prepared(float(times[0])) else None, None
        problem = self._complete(ahead, sensors, before, times)
        if problem is None:
            problem, ahead = self._apply_noise(self._build(sensors, np.concatenate([before, times])), sensors), None
        self._parameters |= problem.parameters
        self._watch(problem, sensors)
        prepared = None if ahead is None else ahead.keyframe
        return BuiltKeyframes(problem, len(before), times, again[0] if again else np.inf, prepared)

    def _finish_keyframes(self) -> None:
        """Called when keyframes have entered."""
        self.in_force = {rows.name: len(rows.b) for rows in self.window.stages[-1].measured if rows.H.any()}
        forget_rows(self.window.stages)

    def _go_back(self, sensors: Sensors, built: BuiltKeyframes, back: float) -> float:
        """Redo keyframes from a time on, in which a fault was found; returns the first that was redone, s."""
        rest = built.times[built.times > self.newest + SAME_TIME]
        return min(back, self.update(sensors, rest, back))

    def work_ahead(self, sensors: Sensors, expected: float = np.inf, settling: bool = True) -> bool:
        """Do one task that need not wait for the next keyframe, or should not delay it; False if there is none.

        The result depends on the rows that have arrived, so it is called at fixed rows.

        Parameters
        ----------
        expected : s, when the next keyframe should be: once the IMU is there, it can be prepared.
        settling : whether keyframes may settle.
        """
        lag, now = self.settings.solver.lag, sensors.imu.newest
        if self._turned or self.window.revising:
            if not self.revise(sensors) and self._settling:
                self._settle(self.newest - lag)
        elif settling and self.window.leaving:
            self._settle(self.newest - lag)
        elif settling and self._tried < self.newest and are_due(self._oldest, self.newest, lag):
            self._tried, self._settling = self.newest, True
            if not self.revise(sensors, always={self.settings.gnss.kernel, self.settings.vehicle.kernel} != {"none"}):
                self._settle(self.newest - lag)
        elif self.foot:
            return False
        elif self._readings.is_due(self.newest):
            self._dirty = min(self._dirty, self._readings.look(sensors, self.newest))
        elif now < expected or expected <= self.newest:
            return False
        elif expected not in self._motions:
            self._integrate(sensors, expected)
        elif self._standing.is_due(expected):
            self._standing.look(sensors, self.settings, expected, self.head)
        elif self._standing.news or self._dirty < np.inf:
            self.update(sensors, np.empty(0))
        elif sensors.raw is None and not self._is_prepared(expected) and self._is_covered(sensors, expected):
            self._prepare(sensors, expected)  # with raw observations a clock is reset, which only the epoch determines
        else:
            return False
        return True

    def _integrate(self, sensors: Sensors, expected: float) -> None:
        """Integrate the interval up to the expected keyframe."""
        T, start = self.newest, self.window.newest.state
        imu = cut_around(sensors, T, sensors.imu.newest).imu
        samples, ends = bridge_gaps(imu, T), np.array([T, expected])
        self._note_gaps(samples.bridged)
        interval = preintegrate(samples, imu, ends, start.ba[0], start.bg[0], self._estimates_imu)
        self._motions[expected] = ImuFactors(interval, self.frame).prepare()

    def _is_covered(self, sensors: Sensors, t: float) -> bool:
        """Whether the odometer's rows reach as far as a keyframe needs them."""
        o, freed = sensors.setup.odometer, self.noise.freed.get(ODOMETER_DELAY)
        if o is None:
            return True
        reach = DELAY_SIGMAS * o.delay_sigma if freed is None else freed.value[0] + DELAY_SIGMAS * freed.sigma[0]
        return sensors.odometer.newest >= t + max(reach, 0.0)

    def _prepare(self, sensors: Sensors, expected: float) -> None:
        """Build and predict the expected keyframe, except for the fix."""
        before = self._list_before(len(self.window), expected)
        problem = self._apply_noise(self._build(sensors, np.array([*before, expected]), complete=False), sensors)
        self._parameters |= problem.parameters
        place, _ = self._place(self._weigh(problem), len(before))
        self._ahead = _Ahead(problem, self.window.expect(place), self.stops, self._readings.wrong)

    def _is_prepared(self, t: float) -> bool:
        """Whether what was prepared for a keyframe is still valid."""
        one = self._ahead
        return (
            one is not None
            and one.keyframe.stage.place.t == t
            and one.keyframe.before is self.window.newest
            and one.stops is self.stops
            and one.wrong is self._readings.wrong
        )

    def _complete(self, ahead: _Ahead | None, sensors: Sensors, before: list[float], times: Array) -> Problem | None:
        """The prepared keyframe with its fix, if one was prepared."""
        if ahead is None or len(times) > 1 or len(ahead.problem.t) != len(before) + 1:
            return None
        recording = sensors.make_recording(float(ahead.problem.t[0]) - ROWS_BEFORE, float(times[-1]) + ROWS_AFTER)
        problem = ahead.problem.complete(recording, compute_error_units(sensors, recording))
        known = {c.name for c in ahead.problem.constraints}
        late = replace(problem, constraints=tuple(c for c in problem.constraints if c.name not in known))
        added = {c.name: c for c in self._apply_noise(late, sensors, self._noise_of_rows).constraints}
        problem = replace(problem, constraints=tuple(added.get(c.name, c) for c in problem.constraints))
        return problem if problem.parameters.keys() <= self._parameters.keys() else None

    def revise(self, sensors: Sensors, always: bool = False) -> bool:
        """Relinearise as much as one row permits; False once nothing is left to do."""
        self._turned = False
        more = self.window.revise(self.at_a_row, lambda *which: self._renew(sensors, *which), always)
        forget_rows(self.window.stages)
        return more

    def settle(self, sensors: Sensors) -> None:
        """Settle all keyframes: no more will come."""
        if len(self.window):
            self.window.converge(always=True, renewed=lambda *which: self._build_again(sensors, *which))
            self._settle(np.inf)

    def _settle(self, until: float) -> None:
        """Settle the keyframes before a time, after relinearising those that moved."""
        self._settling = False
        count = self.window.leaving or int(np.searchsorted(self.window.t, until))
        if not count:
            return
        last = until == np.inf
        overdue = self.newest - float(self.window.stages[0].place.t) - self.settings.solver.lag
        if (
            not last
            and overdue < _LATEST_SETTLING * self.settings.solver.lag
            and self.window.find_first_moved() is not None
        ):
            return  # relinearisation is in progress: the next keyframe will do
        if last:
            count = len(self.window)
        elif not self.window.smooth_back(count, _SMOOTHED * self.at_a_row) and overdue < self.settings.solver.lag:
            return  # some more rows
        self.settled.append(self._leave(count))
        self._ahead = None  # settled states may show that sigmas have changed
        self._motions = {t: one for t, one in self._motions.items() if t > self.head - CONTEXT}
        forget_rows(self.window.stages)

    def restart_settled(self, noise: NoiseModel, setup: Recording, judged: float = -np.inf) -> Tracker:
        """A tracker with this one's settled states, and a noise model that may tell of fixes until `judged` (s)."""
        other, head = copy.copy(self), self.window.head
        other.noise, other._parameters, other.verdicts = noise, {}, copy.deepcopy(self.verdicts)
        since = [begin for begin, _ in set(noise.false_stops) - set(self.noise.false_stops)]
        if judged > -np.inf:
            other.judged, since = max(judged, self.judged), [self.head + SAME_TIME]
        if since:
            other.verdicts.readmit(min(since))
        other.window = type(self.window)(head.move(head.estimate), find_turn(setup, noise))
        other._nodes, other._held, other._motions, other.settled = [], [], {}, []
        other._ahead, other._settling = None, False
        other._standing, other._readings = self._standing.without(noise.false_stops), copy.copy(self._readings)
        other._readings.revised = False
        return other

    @property
    def stale(self) -> bool:
        """Whether the unsettled keyframes were built with figures of the odometer that are better known by now."""
        return self._readings.revised

    def adopt(
        self, other: Tracker, stationary: Array, until: float, settled: Sequence[float], judged: float = -np.inf
    ) -> None:
        """Take over detections and counts of another tracker, except the stops up to a time, which were detected
        anew, as was until `judged` (s) which fixes are wrong; `settled` are its keyframes before its window, s.
        """
        self._standing = other._standing.without(self.noise.false_stops)
        self._readings = copy.copy(other._readings)
        before, after = clip_spans(stationary, self.head, until - SURE), clip_spans(other.stops, until - SURE, np.inf)
        spans = merge_spans(np.concatenate([before, after]), gap=SAME_TIME)
        self._standing.replace(spans, np.concatenate([settled, other.times]))
        self.judged = judged

    def rewind(self, t: float, other: Tracker) -> None:
        """Remove the keyframes from a time on, where another tracker has redone them with different stops."""
        self._keep(len(self.window) - len(self.window.select_since(t - SAME_TIME)))
        self._motions = {end: one for end, one in self._motions.items() if end < t}
        before = clip_spans(self.stops, -np.inf, other.head)
        self._standing = other._standing.without(self.noise.false_stops)
        self._standing.add(before)

    def live(self, sensors: Sensors) -> Live:
        """The state at the newest IMU row, predicted from the newest keyframe."""
        return live(self.window.newest, self.newest, self.frame, sensors, self.noise)

    def predict_since(self, sensors: Sensors) -> tuple[Array, States, Array]:
        """Times (M,), states and covariances (M, 15, 15) at every IMU row since the newest keyframe."""
        return predict_since(self.window.newest, self.newest, self.frame, sensors, self.noise)

    # ------------------------------------------------------------------------------------------------- keyframes
    def _list_before(self, keep: int, t: float) -> list[float]:
        """Times of the keyframes that are built again with those from t on, of the first `keep` in the window."""
        look = _REBUILT_BEFORE if len(self.stops) and self.stops[-1, 1] > t - _REBUILT_BEFORE else 1
        before = [stage.place.t for stage in self.window.stages[max(0, keep - look) : keep]]
        if self.opened and len(before) < look:
            before.insert(0, self.head)
        return before

    def _build(self, sensors: Sensors, times: Array, complete: bool = True) -> Problem:
        begin, stops = float(times[0]), self.stops
        if len(stops):  # a stop is built as a whole, so that its place begins where it began
            stops = stops if self.foot else stops[stops[:, 1] > begin]
            here = stops[(stops[:, 0] < begin) & (stops[:, 1] > begin)]
            begin = min([begin, *here[:, 0].tolist()])
        recording = cut_around(
            sensors, begin, max(float(times[-1]) + ROWS_AFTER, sensors.find_imu_until(float(times[-1])))
        )
        start, speed = self.window.newest.state, None
        if recording.odometer is not None:
            speed = MeanSpeed.of(recording.odometer, self._readings.wrong, self._readings.figures)
        usual = compute_error_units(sensors, recording)
        found = ((t, self._motions.get(t)) for t in times[1:].tolist())
        known = {t: one for t, one in found if one is not None and not one.intervals.is_out_of_range(start.bg)[0]}
        problem = build_problem(
            recording, self.settings, self.frame, start, np.ones(DIM), stops, times, speed, usual, known,
            self._steps.highest, complete, self._estimates_imu,
        )  # fmt: skip
        self._note_gaps(problem.samples.bridged)
        for k, t in enumerate(times[1:].tolist()):
            if t not in known:
                self._motions[t] = ImuFactors(problem.intervals[k : k + 1], self.frame)
        return problem

    def _apply_noise(self, problem: Problem, sensors: Sensors, noise: NoiseModel | None = None) -> Problem:
        """Apply the noise model to a problem built with stated noise.

        A few keyframes do not show the period of the fixes, nor their typical sigmas.
        """
        fixes = sensors.gnss
        spacing = find_node_spacing(self.settings.gnss.slow_times, find_fix_period(fixes.used))
        usual = TypicalSigmas(fixes.compute_unit, lambda k: fixes.compute_typical_sigmas(problem.t[k]), spacing)
        rows = tuple(c.convert_units(usual) for c in problem.constraints)
        noise = noise or self.noise
        return apply_noise(free(replace(problem, constraints=rows), noise.freed), noise)

    def _renew(self, sensors: Sensors, first: int, end: int) -> list[Place] | None:
        """As `_build_again`; None if the work for this row is done, and it is to be called again at the next."""
        return self._build_again(sensors, first, end)

    def _build_again(self, sensors: Sensors, first: int, end: int) -> list[Place]:
        """The stages from `first` to `end`, built again with those around them, and stops as a whole."""
        times, skip = self.times, len(self.times) - len(self.window)  # 1 if there is one before the first stage
        begin, until = max(0, first + skip - _REBUILT_BEFORE), min(end + skip + _REBUILT_BEFORE, len(times))
        for stop in self.stops if end < len(self.window) else ():
            if stop[0] < times[until - 1] < stop[1]:
                until = int(np.searchsorted(times, stop[1] + SAME_TIME))
        problem = self._weigh(self._apply_noise(self._build(sensors, times[begin:until]), sensors))
        return [
            replace(stage.place, problem=problem, k=first + skip - begin + i)
            for i, stage in enumerate(self.window.stages[first:end])
        ]
