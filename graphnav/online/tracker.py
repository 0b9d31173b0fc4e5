"""The graph of a running drive: keyframes posed as they come, stops classified, the window kept and settled.

New keyframes are posed like a recording (`graphnav.problem.pose`), from the rows around them: the same code builds
the same rows as offline. Whatever changes the past inside the window (a fix that comes late, a stop that is
recognised a second or two after it began) takes back the keyframes from there on and poses them again.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from graphnav.config import Settings
from graphnav.constraints import registered
from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.standstill import PLACE
from graphnav.constraints.vehicle import NonHolonomic, OdometerSpeed
from graphnav.dense import Dense
from graphnav.detectors import detect, stops
from graphnav.detectors.base import merged
from graphnav.dynamics import SCALE, Motion
from graphnav.earth import LocalFrame
from graphnav.online.evidence import Evidence
from graphnav.online.sensors import Sensors
from graphnav.preintegration import GAP, Intervals, bridge_gaps, preintegrate
from graphnav.problem import NODE_SPACING, Problem, keyframe_times, pose, to_samples
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solvers.stages import Place, Step
from graphnav.solvers.window import Message, Smoothed, Window, turn_limit
from graphnav.state import DIM, Parameter, States
from graphnav.wheels import Figures, MeanSpeed, faults

CONTEXT = 30.0  # s of rows before a keyframe that its constraints may look at
_NEAR = 2.0  # s of the same, where the IMU has no gap
_BEFORE = 6  # keyframes posed again with a new one in a stop, so that it is seen for what it is
_EVERY = 2.0  # s between looks of the detectors
_WALK, _WALK_LEAST = 30.0, 4.0  # s of a walk that its detector sees, and the least
_SHORTEST = 0.05  # s between looks at a walk that are worth keyframes
_STANDS = 3.0  # s, a stance as long as that is standing, and need not be over
_WHEELS, _WHEELS_LOOK = 10.0, 40.0  # s between looks at the odometer, and what they see
_LOOK = 30.0  # s that the detectors see
_SEEN = 25.0  # s of these that they answer for; the first few lack what was before
_REVIEW = 10.0  # s between looks at what was answered before, while nothing stands
SURE = 1.0  # s before now that they answer for: the end of a stop shows only when it is over
_PLACE_SIGMA = 1000.0  # m, of where a stop may be
_PORTIONS = 8  # of the lag: keyframes settle in groups this long
_LATEST = 0.5  # of the lag by which they may be late for it, where states still move


@dataclass(frozen=True)
class Live:
    """The state now: one state, the covariance of its error state, and the newest keyframe it is predicted from."""

    t: float
    state: States
    covariance: Array  # (15, 15)
    keyframe: float  # s


class Tracker:
    """Keyframes of a running drive.

    Parameters
    ----------
    message, t0 : the prior and the time it is for.
    setup : of the sensors.
    """

    def __init__(self, settings: Settings, frame: LocalFrame, message: Message, t0: float, setup: Recording) -> None:
        self.settings, self.frame = settings, frame
        self.foot = setup.platform == "foot"
        self.window = Window(message, turn_limit(setup.imu.noise))
        self._begun = t0  # s
        self.head = t0  # time of the message before the window, or of the first keyframe as long as it is in it
        self.opened = False  # whether the first keyframe has left the window
        self.stops: Array = np.empty((0, 2))  # s, between keyframes
        self.settled: list[Smoothed] = []
        self.evidence = Evidence()
        self.in_force: dict[str, int] = {}  # rows of each constraint at the newest keyframe
        self.seconds: dict[str, float] = {}  # of process time, by what the newest update did
        self._nodes: list[dict[str, float]] = []  # per stage, when each parameter's node began
        self._head_nodes: dict[str, float] = {}
        self._parameters: dict[str, Parameter] = {}
        self._detected = self._judged = self._reviewed = -np.inf
        self._intervals: dict[float, Intervals] = {}  # integrated already, by the time they end at
        self._figures: Figures | None = None  # of the odometer's readings
        self._told = -np.inf  # s, when these were told
        self._lag: float | None = None  # s by which it is late, as far as the IMU can tell
        self._wrong: Array = np.empty((0, 2))  # s, where its readings are wrong

    @property
    def newest(self) -> float:
        """Time of the newest keyframe, s."""
        return self.window.stages[-1].place.t if self.window.stages else self.head

    @property
    def times(self) -> Array:
        """Times of all keyframes that an interval in the window touches, s."""
        t = self.window.t
        return np.concatenate([[self.head], t]) if self.opened else t

    def update(self, sensors: Sensors, new: Array, dirty: float = np.inf) -> None:
        """Add keyframes at the times `new`, after the newest, and redo those from `dirty` on."""
        clock = [time.process_time()]
        if dirty < np.inf:
            self._intervals = {t: iv for t, iv in self._intervals.items() if t < dirty}
        now = max(self.newest, float(new[-1]) if len(new) else -np.inf)
        looked = not self.foot and now - self._detected >= _EVERY - SAME_TIME
        if looked:
            dirty = min(dirty, self._classify(sensors, new, now))
        # what can wait for the next keyframe does, so that no update does everything
        if now - self._judged >= _WHEELS - SAME_TIME and not (looked and now - self._judged < _WHEELS + _EVERY):
            dirty, looked = min(dirty, self._judge_odometer(sensors, now)), True
        clock.append(time.process_time())
        again = [stage.place.t for stage in self.window.since(dirty - SAME_TIME)]
        times = np.unique(np.concatenate([again, new]))
        times = times[np.concatenate([[True], np.diff(times) > SAME_TIME])]
        if not len(times):
            return
        keep = len(self.window) - len(again)
        look = _BEFORE if len(self.stops) and self.stops[-1, 1] > times[0] - _BEFORE else 1
        before = [stage.place.t for stage in self.window.stages[max(0, keep - look) : keep]]
        if self.opened and len(before) < look:
            before.insert(0, self.head)
        self.window.truncate(keep)
        del self._nodes[keep:]
        problem = self._pose(sensors, np.concatenate([before, times]))
        clock.append(time.process_time())
        turn = 0.0
        for k in range(len(before), len(problem.t)):
            turn = max(turn, self._push(problem, k))
        if turn > self.window.turn:
            self.window.converge(renewed=lambda first: self._renewed(sensors, first))
        self.in_force = {
            c.name: n for c in problem.constraints if (n := int(np.sum(c.keyframe == len(problem.t) - 1)))
        }  # fmt: skip
        lag = self.settings.solver.lag
        over = self.newest - self.window.stages[0].place.t - lag * (1.0 + 1.0 / _PORTIONS)
        if over > (_EVERY if looked else 0.0):
            self.settle(sensors, self.newest - lag)
        self._forget()
        clock.append(time.process_time())
        self.seconds = dict(zip(("detectors", "posing", "solving"), np.diff(clock).tolist(), strict=True))

    def settle(self, sensors: Sensors, until: float = np.inf) -> None:
        """Settle the keyframes before a time."""
        count = int(np.searchsorted(self.window.t, until))
        if not count:
            return
        last = count == len(self.window)
        robust = {self.settings.gnss.robust, self.settings.vehicle.robust} != {"none"}
        self.window.converge(always=last or robust, renewed=lambda first: self._renewed(sensors, first))
        overdue = self.newest - float(self.window.stages[0].place.t) - self.settings.solver.lag
        if not last and overdue < _LATEST * self.settings.solver.lag and self.window.first_moved() is not None:
            return  # still being linearised again: the next keyframe will do
        self._head_nodes = self._nodes[count - 1]
        self.head, self.opened = float(self.window.t[count - 1]), True
        self.settled.append(self.window.settle(count))
        self.evidence.add(self.settled[-1])
        self._intervals = {t: iv for t, iv in self._intervals.items() if t > self.head - CONTEXT}
        del self._nodes[:count]
        self._forget()

    def judged(self, settings: Settings, sensors: Sensors) -> None:
        """Go on with other figures of the sensors, and go through what has not settled again."""
        self.settings, self.window.turn = settings, turn_limit(sensors.setup.imu.noise)
        self.update(sensors, np.empty(0), -np.inf)

    def live(self, sensors: Sensors) -> Live:
        """The state at the newest IMU row, by prediction from the newest keyframe."""
        newest, T, now = self.window.newest, self.newest, sensors.imu.newest
        state, P = newest.state, newest.covariance
        if now > T + SAME_TIME:
            imu = sensors.recording(T - 1.0, now).imu
            intervals = preintegrate(bridge_gaps(imu), imu, np.array([T, now]), state.ba[0], state.bg[0])
            motion, one = Motion(intervals, self.frame), slice(0, 1)
            scale = newest.value(SCALE) if SCALE in newest.columns else None
            ahead, F15 = motion.propagate(one, state, scale)
            F = np.zeros((DIM, len(P)))
            F[:, :DIM] = F15[0]
            if scale is not None:
                F[:, newest.columns[SCALE]] = motion.scale_columns(one, F15)[0]
            P = F @ P @ F.T + motion.noise(one, state.R_nb)[0]
            state = ahead
        return Live(float(max(now, T)), state, P[:DIM, :DIM], T)

    def since(self, sensors: Sensors) -> tuple[Array, States, Array]:
        """Times (M,), states and covariances (M, 15, 15) at every IMU row since the newest keyframe.

        Predicted through each row; covariances lie on the straight line between those at both ends.
        """
        message, T = self.window.newest, self.newest
        t = sensors.imu.t[sensors.imu.t > T + SAME_TIME].copy()
        if not len(t):
            return t, message.state[:0], np.empty((0, DIM, DIM))
        now = self.live(sensors)
        imu, start = sensors.recording(T - 1.0, now.t).imu, message.state
        ba, bg = start.ba, start.bg
        if SCALE in message.columns:
            scale, rows = message.value(SCALE), imu.t > T
            bg = bg + scale[:3] * (imu.gyro[rows].mean(axis=0) - bg)
            ba = ba + scale[3:] * (imu.accel[rows].mean(axis=0) - ba)
        ends, both = np.array([T, now.t]), np.stack([message.covariance[:DIM, :DIM], now.covariance])
        between = Dense(
            bridge_gaps(imu), self.frame, ends, States.stack([start, now.state]), both, ba, bg, smooth=False
        )  # fmt: skip
        return t, *between(t)

    # ------------------------------------------------------------------------------------------------- keyframes
    def _pose(self, sensors: Sensors, times: Array) -> Problem:
        begin = float(times[0])
        if len(self.stops):  # a stop is posed whole, so that its place begins where it began
            here = self.stops[(self.stops[:, 0] < begin) & (self.stops[:, 1] > begin)]
            begin = min([begin, *here[:, 0].tolist()])
        recording = self._around(sensors, begin, float(times[-1]) + 0.1)
        start, speed = self.window.newest.state, None
        if recording.odometer is not None:
            speed = MeanSpeed.of(recording.odometer, self._wrong, self._figures)
        usual = None
        if recording.gnss is not None:
            usual = (self.settings.gnss.sd_factor or 1.0) * sensors.usual(recording.gnss.t)
        found = ((t, self._intervals.get(t)) for t in times[1:].tolist())
        known = {t: iv for t, iv in found if iv is not None and not iv.out_of_range(start.bg)[0]}
        problem = pose(
            recording, self.settings, self.frame, start, np.ones(DIM), self.stops, times, speed, usual, known
        )  # fmt: skip
        self._intervals |= {t: problem.intervals[k : k + 1] for k, t in enumerate(times[1:].tolist())}
        return self._weighed(problem)

    def _weighed(self, problem: Problem) -> Problem:
        """The problem with what is decided of each row before it enters the window: its sigma, its robust kernel.

        Decided here once, with what is known when a keyframe is posed; the window then weighs the rows by their
        kernels. Wheels: by what settled so far says of them. A fix that is suspect would be given its weight here.
        """
        factors = self.evidence.factors
        if not factors:
            return problem
        rows = (
            replace(c, sigma=c.sigma * factors[c.name])
            if isinstance(c, NonHolonomic | OdometerSpeed) and c.name in factors
            else c
            for c in problem.constraints
        )
        return replace(problem, constraints=tuple(rows))

    def _around(self, sensors: Sensors, begin: float, end: float) -> Recording:
        """The rows that keyframes between two times look at.

        Only what gaps in the IMU hide is told by the signal of the last half minute.
        """
        near = sensors.recording(begin - _NEAR, end)
        step = np.diff(near.imu.t)
        whole = len(step) > 1 and float(step.max()) < GAP * float(np.median(step))
        return near if whole else sensors.recording(begin - CONTEXT, end)

    def _push(self, problem: Problem, k: int) -> float:
        t = float(problem.t[k])
        first = not self.window.stages and not self.opened
        nodes = dict(self._nodes[-1] if self._nodes else self._head_nodes)
        turn = self.window.push(Place(t, problem, k, self._steps(problem, t, nodes), linked=not first))
        self._nodes.append(nodes)
        return turn

    def _steps(self, problem: Problem, t: float, nodes: dict[str, float]) -> tuple[Step, ...]:
        """Parameters that begin or move on at a keyframe; `nodes` is brought up to date."""
        self._parameters |= problem.parameters
        steps = []
        stop = self._stop_at(t)
        for name, p in self._parameters.items():
            if name == PLACE:
                if stop is not None and nodes.get(name) != stop:
                    place = self.window.newest.state.p[0]
                    steps.append(Step(name, place, np.full(3, _PLACE_SIGMA)))
                    nodes[name] = stop
            elif name not in nodes:
                steps.append(Step(name, np.atleast_2d(p.initial)[0], np.atleast_2d(p.sigma)[0]))
                nodes[name] = t
            elif not p.constant and t - nodes[name] >= NODE_SPACING - SAME_TIME:
                ahead, added = p.step(np.array([t - nodes[name]]))
                steps.append(Step(name, p.initial, added[0], float(ahead[0]), p.initial))
                nodes[name] = t
        return tuple(steps)

    def _stop_at(self, t: float) -> float | None:
        """When the stop began that lasts at a time."""
        inside = (self.stops[:, 0] <= t + SAME_TIME) & (self.stops[:, 1] >= t - SAME_TIME)
        return float(self.stops[inside][0, 0]) if inside.any() else None

    def _renewed(self, sensors: Sensors, first: int) -> list[Place]:
        """The places of the stages from `first` on, posed again."""
        skip = len(self.times) - len(self.window)  # 1 once there is a keyframe before the first stage
        begin = max(0, first + skip - _BEFORE)
        problem = self._pose(sensors, self.times[begin:])
        return [
            replace(stage.place, problem=problem, k=first + skip - begin + i)
            for i, stage in enumerate(self.window.stages[first:])
        ]

    def _forget(self) -> None:
        """Stages need not know where their rows came from: that is posed again when it is asked for."""
        stages = self.window.stages
        for k in range(len(stages) - 1, -1, -1):
            if stages[k].place.problem is None:
                break  # nor do those before it
            stages[k] = replace(stages[k], place=replace(stages[k].place, problem=None))

    # ----------------------------------------------------------------------------------------- stops, bad readings
    def steps_until(self, sensors: Sensors, limit: float, last: bool) -> Array:
        """Keyframes of a walk, step by step: up to the newest stance that has begun or ended, whose spans are kept.

        Only whole stances and swings say what phase a moment of them is in.
        """
        T = self.newest
        whole = not np.isfinite(self._detected)
        recording = sensors.recording(-np.inf if whole else min(T, limit) - _WALK, limit + SURE)
        if recording.duration < _WALK_LEAST:
            return np.empty(0)
        rows = recording.imu.t  # keyframes stand where the stances will be said to begin and end
        limit = float(rows[max(int(np.searchsorted(rows, limit + SAME_TIME)) - 1, 0)])
        spans = _clipped(to_samples(detect(recording, self.settings).stationary, recording), T, limit)
        if not last and len(spans):
            ongoing = spans[-1, 1] >= limit - SAME_TIME
            if ongoing and limit - spans[-1, 0] < _STANDS:
                limit, spans = float(spans[-1, 0]), spans[:-1]
            elif not ongoing:
                limit = float(spans[-1, 1])
        elif not last and limit - T < _STANDS:
            return np.empty(0)
        if limit - T <= _SHORTEST:
            return np.empty(0)
        self._detected = limit
        self.stops = merged(np.concatenate([self.stops, spans]), gap=SAME_TIME)
        self.stops = self.stops[self.stops[:, 1] > self.head - CONTEXT]
        # a swing is one because of the stance before it
        begin = max([T - _WALK, *self.stops[self.stops[:, 0] <= T, 0].tolist()]) if len(self.stops) else T
        part = sensors.recording(min(begin, T), limit)
        around = _clipped(self.stops, part.start, limit)
        epochs = [cls.epochs(part, self.settings, around) for cls in registered()]
        times = keyframe_times(T, limit, np.concatenate([*epochs, np.empty(0)]), self.settings.keyframes.rate)
        return times if not len(self.window) and not self.opened else times[1:]

    def _judge_odometer(self, sensors: Sensors, now: float) -> float:
        """Look for wrong readings of the odometer; returns the start of the first that was not known."""
        whole, self._judged = not np.isfinite(self._judged), now
        recording = sensors.recording(-np.inf if whole else now - _WHEELS_LOOK, now)
        if recording.odometer is None:
            return np.inf
        lag = self._lag
        if now - self._begun >= 2.0 * (self._told - self._begun):  # ever more seldom, as more readings tell little new
            every = sensors.recording().odometer
            assert every is not None
            self._figures, self._told, lag = Figures.of(every), now, None
        seen, known = faults(recording.odometer, recording.imu, self._figures, lag), self._wrong
        found, self._lag = seen.spans, seen.lag
        since = float(recording.odometer.t[0]) + (0.0 if whole else 5.0)
        old = known[(known[:, 0] < since) & (known[:, 1] > since - CONTEXT - _WHEELS_LOOK)]
        self._wrong = np.concatenate([old, found[found[:, 0] >= since]])
        new = self._wrong[~np.isin(self._wrong[:, 0], known[:, 0])]
        return float(new[0, 0]) if len(new) and len(self.window) else np.inf

    def _classify(self, sensors: Sensors, new: Array, now: float) -> float:
        """Ask the detectors; returns the start of the first interval between keyframes that they see otherwise."""
        whole = not np.isfinite(self._detected)
        since, answered = (min(self.head, *new.tolist()), -np.inf) if whole else (now - _SEEN, self._detected - SURE)
        if now - self._reviewed >= _REVIEW - SAME_TIME:
            self._reviewed, answered = now, since
        self._detected = now
        recording = sensors.recording(-np.inf if whole else now - _LOOK, now)
        found = stops(recording, self.settings, since, now - SURE, self.stops, answered)
        if found is None or (not len(found) and not len(self.stops)):
            return np.inf
        parts = [_clipped(self.stops, -np.inf, since), found]
        edges = np.unique(np.concatenate([self.times, new]))
        spans = merged(np.concatenate(parts), gap=SAME_TIME)
        spans = spans[spans[:, 1] >= edges[0] - SAME_TIME] if len(spans) else spans
        aligned = []
        for begin, end in spans:
            inside = edges[(edges >= begin - SAME_TIME) & (edges <= end + SAME_TIME)]
            if len(inside):
                first = begin if begin < edges[0] else float(inside[0])
                if inside[-1] > first:
                    aligned.append((first, float(inside[-1])))
        before, self.stops = self.stops, np.array(aligned).reshape(-1, 2)
        middle = 0.5 * (edges[1:] + edges[:-1])
        changed = np.flatnonzero(_within(middle, before) != _within(middle, self.stops))
        return float(edges[changed[0]]) if len(changed) else np.inf


def _clipped(spans: Array, begin: float, end: float) -> Array:
    cut = np.clip(spans, begin, end)
    return cut[cut[:, 1] > cut[:, 0]]


def _within(t: Array, spans: Array) -> Array:
    """Which times lie in the spans (M, 2)."""
    return np.asarray(((t[:, None] >= spans[:, 0]) & (t[:, None] <= spans[:, 1])).any(axis=1))
