"""From sensors' rows, as they arrive, to a live state and a settled trajectory.

Rows may arrive in any order and with gaps: each is used at its own time while that lies in the window. The output
depends on the rows and their order only, never on when or in what portions they arrive.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.findings import Finding
from graphnav.core.notes import Note
from graphnav.core.trajectory import Trajectory
from graphnav.detectors.base import describe_false_stops
from graphnav.estimation.alignment import Alignment
from graphnav.estimation.faults.watch import OLDEST, PATIENCE
from graphnav.estimation.noise.explanations import FIXES
from graphnav.estimation.noise.model import STATED, NoiseModel
from graphnav.estimation.pipeline import choose_origin
from graphnav.estimation.solution import ExcludedSpan
from graphnav.online.ahead import Live, export
from graphnav.online.checks import add_stream, check_rows
from graphnav.online.judgement import WindowJudge
from graphnav.online.looks import CONTEXT, SURE
from graphnav.online.noise_estimation import BackgroundEstimation, CatchUp, are_enough, start_estimation
from graphnav.online.sanity import find_period
from graphnav.online.schedule import AFTER, expect_keyframe, find_due, find_limit, list_keyframes
from graphnav.online.sensors import Row, Sensors
from graphnav.online.start import choose_settings, find_start, make_tracker, take_start_rows
from graphnav.online.tracker import Tracker
from graphnav.online.walker import Walker
from graphnav.recording import Recording
from graphnav.recording.plausibility.readings import HOLE

_STEP_DETECTION = 0.5  # s between detections of steps in a walk
_FINAL_STOPS = 4.0  # s before the newest keyframe up to which the stops are final
_TRY = 2.0  # s between attempts at an alignment
_LEVELLING_SPAN = 5.0  # s of rest that determine the level of a vehicle without GNSS
_PATIENCE = 300.0  # s of rows kept while there is no motion to align with


class Smoother:
    """Online smoother; `graphnav.online.Online` wraps one so that nothing ends it.

    Parameters
    ----------
    setup : a recording without rows (`graphnav.online.without_rows`): platform, noise figures, lever arms.
    settings : as for a recording; `solver.lag` is the span of later measurements that a settled state includes.
    """

    def __init__(self, setup: Recording, settings: Settings | None = None) -> None:
        self._setup = setup
        self.settings = choose_settings(setup, settings)
        self.sensors = Sensors(setup, self.settings.keyframes.bridge, self.settings.raw_gnss)
        self.frame: LocalFrame | None = None
        self.tracker: Tracker | None = None
        self.notes: list[str] = []
        self.findings: tuple[Finding, ...] = ()  # on the rows so far, the most severe first; they are notes too
        self.late: Counter[str] = Counter()  # used rows that arrived after the keyframe they should have entered
        self._estimation: BackgroundEstimation | None = None  # estimation of the noise model in progress
        self._catch_up: CatchUp | None = None  # tracker that processes the unsettled keyframes with the new model
        self._judge = WindowJudge()
        self._tentative = False  # nothing may settle before the noise model has been estimated once
        self._found: Alignment | None = None  # whether the noise model is to be estimated again
        self._notes_on: dict[str, tuple[str, ...]] = {}  # notes that further rows may change, by subject
        self._estimated_from = 0.0  # s of rows that it was estimated from
        self._times: list[float] = []  # s, of keyframes that have settled meanwhile
        self._left_out: tuple[ExcludedSpan, ...] = ()  # of other measurements than fixes
        self._fixes: list[float] = []  # s, rows that need a keyframe and are not yet in the graph
        self._began = -np.inf  # s, of what is being smoothed
        self._due = -np.inf  # s of IMU time at which the next keyframes can be made
        self._awake = -np.inf  # s, at which the next work is due
        self._period = self._dirty = np.inf  # s, of the IMU's rows; from where on keyframes are to be redone
        self._settled: list[Trajectory] = []
        self._last_settled = -np.inf
        self._faults: tuple[ExcludedSpan, ...] = ()  # found before the newest alignment

    @property
    def excluded(self) -> tuple[ExcludedSpan, ...]:
        """Spans of measurements that were found wrong and are not used."""
        return self._faults + (self.tracker.excluded + self._left_out if self.tracker is not None else ())

    @property
    def status(self) -> str:
        """ "aligning" or "running"."""
        return "aligning" if self.tracker is None else "running"

    def add(self, row: Row, released: bool = False) -> None:
        """Process one row: sensor, time, values and whether it was held, as in
        `graphnav.online.sensors.Sensors.add`.
        """
        sensor, t, values = row
        sensors, before = self.sensors, self.sensors.imu.newest
        if sensor == "imu" and sensors.add_next(t, values, before):  # the common case
            self._take_newest(t, before)
            return
        previous = sensors.find_newest(sensor)
        if not sensors.add(sensor, t, values, released):
            return
        if sensor == "imu" and (newest := sensors.imu.newest) > before:
            # an earlier row that was rejected leaves no trace: the schedule of work stays the same
            if newest - before > self.settings.keyframes.bridge and len(sensors.imu) > 1 and np.isfinite(before):
                after = float(sensors.imu.t[np.searchsorted(sensors.imu.t, before, side="right")])
                self._restart(before, f"the IMU was silent from {before:.3f} to {after:.3f} s")
            self._take_newest(newest, before)
            return
        tracker = self.tracker
        if tracker is not None:
            if not tracker.note_missed_row(sensors, sensor, t):
                return  # as if it had arrived in order
            self._awake = -np.inf
            if sensor != "gnss" and t < previous:
                tracker.note_late_row(sensor, t)
            if sensors.gnss.left:
                self._fixes = [x for x in self._fixes if x not in sensors.gnss.left]
                self._dirty, sensors.gnss.left = min([self._dirty, *sensors.gnss.left]), []
            if sensors.needs_keyframes(sensor) and t > tracker.newest + SAME_TIME:
                self._fixes = sorted([*self._fixes, t])
                self._due = min(self._due, t + AFTER)
            elif t <= tracker.newest + SAME_TIME:
                self.late[sensor] += 1
                if sensors.needs_keyframes(sensor):
                    self._fixes = sorted([*self._fixes, t])
                self._dirty = min(self._dirty, t)
            elif sensor == "odometer" and previous < tracker.newest - SAME_TIME:
                self._dirty = min(self._dirty, previous + 2.0 * SAME_TIME)
        if sensors.imu.newest >= self._due:
            self._look(sensors.imu.newest)

    def _take_newest(self, now: float, before: float) -> None:
        """Process the newest row of the IMU, at a time (s), and that of the row before."""
        void = self.sensors.compare_newest()
        if void is not None and self.tracker is not None:
            self._redo(void, self.tracker)
        if now < self._awake:
            return
        if now - before > HOLE * self._period and self.tracker is not None and self.tracker.at_every_row:
            # the schedule stays the same where some rows are missing, which may still arrive
            for k in range(1, round((now - before) / self._period)):
                if before + k * self._period >= self._awake - SAME_TIME:
                    self._look(before + k * self._period)
        self._look(now)

    def _redo(self, t: float, tracker: Tracker) -> None:
        """A row of the IMU was removed: redo everything that used it, from a time (s) on."""
        tracker.finish_entering(self.sensors)
        self._awake = -np.inf
        tracker.note_late_row("imu", t)
        if t <= tracker.newest + SAME_TIME:
            self._dirty = min(self._dirty, t)

    def _look(self, now: float) -> None:
        """Do the work that is due; without keyframes to make, one task per row, so that no row waits for long."""
        tracker = self.tracker
        if tracker is None:
            self._align()
            self._awake = self._due if self.tracker is None else now
        elif tracker.busy:
            tracker.go_on(self.sensors)
            self._awake = now
        elif now >= self._due - SAME_TIME:
            self._advance(tracker, now)
            self._awake = now
        elif self._catch_up is not None:
            self._step_catch_up(self._catch_up, tracker)
        elif self._estimation is not None and tracker.newest >= self._estimation.due:
            self._use(self._estimation, tracker)
        elif tracker.work_ahead(self.sensors, expected := self._expect(tracker.newest), not self._holds(tracker)):
            self._collect(tracker)
        elif tracker.stale and not self._tentative:
            self._catch_up = CatchUp(tracker.restart_settled(tracker.noise, self._setup))
        else:
            if self._estimation is None and not self._tentative:
                if self._found is not None:
                    self._estimate_again(self._found, tracker)
                self._catch_up = self._judge.look(self.sensors, tracker)
            self._awake = expected if now < expected else self._due

    def _expect(self, T: float) -> float:
        return expect_keyframe(T, self._fixes, 1.0 / self.settings.keyframes.rate)

    def _holds(self, tracker: Tracker) -> bool:
        return self._tentative or self._judge.holds(tracker)

    def live(self) -> Live | None:
        """The state at the newest IMU row; None while aligning."""
        return None if self.tracker is None else self.tracker.live(self.sensors)

    def settled(self) -> list[Trajectory]:
        """The trajectory settled since the last call."""
        out, self._settled = self._settled, []
        return out

    def finish(self) -> None:
        """End of the input: settle everything."""
        if self.tracker is None:
            try:
                self._align(last=True)
            except EstimationError as error:
                self.notes.append(Note("online.not_aligned", str(error)))
            if "units" not in self._notes_on:
                self._take_findings(check_rows(self.sensors.make_recording(every=True)))
        if self.tracker is not None:
            self._finish_estimation()
            self._advance(self.tracker, self.sensors.imu.newest, last=True)
            self.tracker.settle(self.sensors)
            self._collect(self.tracker)

    def _align(self, last: bool = False) -> None:
        sensors = self.sensors
        if len(sensors.imu) < 2:
            return
        first, now = float(sensors.imu.t[0]), sensors.imu.newest
        if not last:  # at whole multiples, so that a missing row changes nothing
            now = _TRY * float(np.floor(now / _TRY))
            self._due = now + _TRY
        if now - first < _LEVELLING_SPAN:
            return
        rows = take_start_rows(sensors, self.settings, now, last)
        if rows is None:
            self._wait(now)
            return
        recording, stationary = rows
        origin = choose_origin(recording) if self.frame is None else self.frame.origin
        self.frame = LocalFrame(origin, recording.start)  # a clock that was set drifts from that time on
        try:
            found = find_start(recording, stationary, self.settings, self.frame)
        except EstimationError as error:
            if last:
                raise
            self.notes.append(Note("online.not_aligned", f"not aligned at {now:.1f} s: {error}"))
            self._wait(now)
            return
        tracker = self.tracker = self._track(found, recording.start, STATED)
        self._take_findings(check_rows(sensors.make_recording(-np.inf, now, every=True)))
        told = found.motion is not None and self.settings.gnss.position and recording.platform != "foot"
        if told and self.settings.noise.mode == "estimated":
            self._found, self._tentative = found, True
            sensors.gnss.space(self.settings.noise.spacing)
        self._fixes = [t for t in sensors.list_keyframe_times().tolist() if t >= recording.start - SAME_TIME]
        self._began, self._estimated_from = recording.start, recording.duration
        sensors.oldest = recording.start
        self._advance(tracker, sensors.imu.newest)
        if self._found is not None and self.tracker is tracker:
            self._begin_estimation(self._found, tracker)

    def _track(self, found: Alignment, start: float, noise: NoiseModel) -> Tracker:
        """Start tracking at the first row that an alignment has used, s."""
        assert self.frame is not None
        tracker, notes = make_tracker(found, start, noise, self.settings, self.frame, self._setup)
        self.notes += [note for note in notes if note not in self.notes]
        return tracker

    def _take_findings(self, found: tuple[Finding, ...]) -> None:
        self.findings = found = add_stream(found, self.sensors)
        self._replace_notes("units", tuple(Note(f.key, f.sentence) for f in found))

    def _replace_notes(self, matter: str, words: tuple[str, ...]) -> None:
        """Note what is known about the noise, the units, ..., replacing the earlier note on the same subject."""
        self.notes = [note for note in self.notes if note not in self._notes_on.get(matter, ())] + list(words)
        self._notes_on[matter] = words

    def _estimate_again(self, found: Alignment, tracker: Tracker) -> None:
        """Estimate the noise model again from ever more rows until they suffice."""
        span = tracker.newest - self._began
        enough = are_enough(self.sensors, found, span)
        if not enough and span < 2.0 * self._estimated_from:
            return
        self._estimated_from = span
        self._found = None if enough else found
        self._begin_estimation(found, tracker)

    def _begin_estimation(self, found: Alignment, tracker: Tracker) -> None:
        times, last = np.concatenate([self._times, tracker.window.t]), self._found is None
        self._estimation = start_estimation(
            self.sensors, self.settings, tracker.frame, found, times, tracker.newest + AFTER, tracker.noise, last
        )

    def _use(self, estimation: BackgroundEstimation, tracker: Tracker) -> None:
        """Start to process the unsettled keyframes with the new noise model."""
        self._estimation = None
        try:
            found = estimation.wait()
        except Exception as error:
            self.notes.append(Note("online.not_judged", f"noise and faults not re-estimated: {error}"))
            self._tentative = False
            return
        self._replace_notes("noise", found.notes)
        self._take_findings(found.doubts)
        self._left_out = tuple(fault for fault in found.excluded if fault.kind not in FIXES)
        noise, until = found.keep_false_stops(tracker.noise), float(estimation.task.times[-1])
        judged = until - PATIENCE  # of a fault that has just begun, evidence may still know too little
        if tracker.opened and not found.anew:
            self._catch_up = CatchUp(tracker.restart_settled(noise, self._setup, judged), points=found.points)
        else:
            again = self._track(found.start, self._began, noise)
            again.adopt(tracker, found.stationary, until, self._times, judged)
            self._catch_up = CatchUp(again, self._times, found.points)
            if self._found is not None:
                self._found = found.start

    def _step_catch_up(self, catch_up: CatchUp, tracker: Tracker) -> None:
        """Process some of them; the new tracker takes over once it has caught up."""
        if catch_up.step(self.sensors, tracker):
            if not catch_up.tracker.opened:
                self._times = []  # they are in its window
            self.tracker, self._catch_up, self._tentative = catch_up.tracker, None, False
            self._replace_notes("stops", describe_false_stops(len(catch_up.tracker.noise.false_stops)))

    def _finish_estimation(self) -> None:
        """End of the input: do not wait for an estimation in progress, and judge stops by what there is."""
        if self._estimation is not None and self.tracker is not None:
            self._use(self._estimation, self.tracker)
        while self.tracker is not None:
            if self._catch_up is None and not self._tentative:
                self._catch_up = self._judge.look(self.sensors, self.tracker, last=True)
            if self._catch_up is None:
                return
            self._step_catch_up(self._catch_up, self.tracker)

    def _wait(self, now: float) -> None:
        """Keep the rows that the next attempt at an alignment may need."""
        if now - float(self.sensors.imu.t[0]) > _PATIENCE:
            self._take_findings(check_rows(self.sensors.make_recording(every=True)))
            self.sensors.drop_before(now - 0.5 * _PATIENCE)

    def _restart(self, before: float, why: str) -> None:
        """Settle the states up to a time (s) as they are, and start a new alignment."""
        sensors = self.sensors
        self.notes.append(Note("online.anew", f"{why}: aligning anew"))
        later = sensors.cut_after(before)
        Smoother.finish(self)
        self._faults = self.excluded
        self._begin_anew(before)
        sensors.put_back(later)
        sensors.gnss.space(None)  # all of them, until the next alignment

    def _begin_anew(self, oldest: float) -> None:
        """Drop all rows and states; rows up to a time (s) are too late from now on."""
        self.tracker = self._found = self._estimation = self._catch_up = None
        self._judge, self._tentative, self._times, self._left_out = WindowJudge(), False, [], ()
        self.sensors.drop_before(np.inf)
        self.sensors.gnss.space(None)
        self.sensors.oldest = oldest
        self._fixes, self._dirty, self._due, self._awake = [], np.inf, -np.inf, -np.inf

    def _advance(self, tracker: Tracker, now: float, last: bool = False) -> None:
        """Make the keyframes that are due at a time, s."""
        sensors = self.sensors
        sensors.learn(tracker.newest - _FINAL_STOPS, tracker.stops)
        if isinstance(tracker, Walker):
            self._advance_walk(tracker, now, last)
            return
        period, limit, T = 1.0 / self.settings.keyframes.rate, find_limit(sensors, last), tracker.newest
        started = bool(len(tracker.window)) or tracker.opened
        times = ([] if started else [T]) + list_keyframes(T, limit, self._fixes, period, last)
        late = [t for t in self._fixes if t <= T + SAME_TIME]
        if late and started:  # a keyframe of its own, and those after it again
            self._dirty = min(self._dirty, *late)
            times = sorted({*times, *late})
        if (times and (len(times) > 1 or started)) or (last and self._dirty < np.inf):
            dirty, self._dirty = self._dirty, np.inf
            self._fixes = [t for t in self._fixes if t > limit and t > T + SAME_TIME]
            redone = tracker.update(sensors, np.array(times), dirty)
            if self._catch_up is not None and redone < np.inf:
                self._catch_up.tracker.rewind(redone, tracker)
            self._collect(tracker)
            if tracker.verdicts.anew and not last:
                words = f"for {OLDEST:.0f} s fixes contradicted all else, until {tracker.newest:.3f} s"
                self._restart(tracker.newest, words)
                return
        self._due = find_due(tracker.newest, self._fixes, period)

    def _advance_walk(self, walker: Walker, now: float, last: bool) -> None:
        self._period = find_period(self.sensors.imu.t)
        at = _STEP_DETECTION * float(np.floor((now + SAME_TIME) / _STEP_DETECTION))
        newest = walker.take_steps(self.sensors, now if last else at - SURE, last, self._fixes, self._dirty)
        if newest > -np.inf:
            self._dirty, self._fixes = np.inf, [t for t in self._fixes if t > newest + SAME_TIME]
        self._due = at + _STEP_DETECTION

    def _collect(self, tracker: Tracker) -> None:
        for part in tracker.settled:
            if self._found is not None or self._estimation is not None:
                self._times += part.t.tolist()
            rows = part.t > self._last_settled
            if rows.any():
                self._settled.append(export(part, rows, tracker.frame))
                self._last_settled = float(part.t[-1])
        tracker.settled.clear()
        self.sensors.oldest = max(self.sensors.oldest, tracker.head)
        begin = min([tracker.head, *(max(t, tracker.head - 10.0 * CONTEXT) for t in tracker.stops[:1, 0].tolist())])
        if self._found is None and self._estimation is None and self._catch_up is None:  # which still need them
            self.sensors.drop_before(begin - CONTEXT - 5.0)
