"""The graph of a running drive: keyframes posed as they come, stops classified, the window kept and settled.

New keyframes are posed like a recording (`graphnav.problem.pose`), from the rows around them: the same code builds
the same rows as offline. Whatever changes the past inside the window (a fix that comes late, a stop that is
recognised a second or two after it began) takes back the keyframes from there on and poses them again.
"""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass, replace

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.gnss import GnssPosition, GnssVelocity
from graphnav.constraints.standstill import PLACE
from graphnav.dense import Dense
from graphnav.detectors.base import merged
from graphnav.dynamics import SCALE, Motion
from graphnav.earth import LocalFrame
from graphnav.findings import period_of
from graphnav.online.evidence import SPEEDS, Evidence
from graphnav.online.looks import CONTEXT, SURE, Readings, Stops, clipped
from graphnav.online.noise import Noise
from graphnav.online.sensors import Sensors
from graphnav.online.steps import Steps
from graphnav.preintegration import preintegrate
from graphnav.problem import Problem, pose
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.samples import GAP, bridge_gaps
from graphnav.solvers.stages import Place, Step
from graphnav.solvers.watch import Verdicts, Watch
from graphnav.solvers.window import Message, Smoothed, Window, turn_limit
from graphnav.state import DIM, Parameter, States
from graphnav.wheels import MeanSpeed

_NEAR = 2.0  # s of rows before a keyframe that its constraints look at where the IMU has no gap; else `CONTEXT`
_BEFORE = 6  # keyframes posed again with a new one in a stop, so that it is seen for what it is
_PLACE_SIGMA = 1000.0  # m, of where a stop may be
_PORTIONS = 8  # of the lag: keyframes settle in groups this long
_LATEST = 0.5  # of the lag by which they may be late for it, where states still move
_FIXES = 5  # that tell how often they come


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
        self.head = t0  # time of the message before the window, or of the first keyframe as long as it is in it
        self.opened = False  # whether the first keyframe has left the window
        self._standing = Stops()
        self._readings = Readings()
        self._steps = Steps()
        self.settled: list[Smoothed] = []
        self.evidence = Evidence()
        self.verdicts = Verdicts({}, {})  # which fixes are used
        self.noise = Noise()  # of those
        self.in_force: dict[str, int] = {}  # rows of each constraint at the newest keyframe
        self.seconds: dict[str, float] = {}  # of its thread, by what the newest update did
        self._nodes: list[dict[str, float]] = []  # per stage, when each parameter's node began
        self._head_nodes: dict[str, float] = {}
        self._parameters: dict[str, Parameter] = {}
        self._motions: dict[float, Motion] = {}  # of intervals integrated already, by the time they end at
        self._dirty = np.inf  # s, from where on keyframes are to be redone with the next
        self._tried = -np.inf  # s, the newest keyframe when some were to settle last
        self._turned = False  # whether something has moved so far that it may have to be linearised again

    @property
    def newest(self) -> float:
        """Time of the newest keyframe, s."""
        return self.window.stages[-1].place.t if self.window.stages else self.head

    @property
    def stops(self) -> Array:
        """Spans (M, 2) between keyframes in which the vehicle stands, or the foot, s."""
        return self._standing.spans

    @property
    def times(self) -> Array:
        """Times of all keyframes that an interval in the window touches, s."""
        t = self.window.t
        return np.concatenate([[self.head], t]) if self.opened else t

    @property
    def _oldest(self) -> float:
        """Time of the oldest keyframe in the window, s."""
        return self.window.stages[0].place.t if self.window.stages else self.newest

    def came_late(self, t: float) -> None:
        """A row of the IMU came after newer ones: what was integrated beyond it is void."""
        self._motions = {end: one for end, one in self._motions.items() if end < t}

    def update(self, sensors: Sensors, new: Array, dirty: float = np.inf) -> float:
        """Add keyframes at the times `new`, after the newest, and redo those from `dirty` on.

        Returns the first that was redone, s.
        """
        clock = [time.thread_time()]
        if dirty < np.inf:
            self._motions = {t: one for t, one in self._motions.items() if t < dirty}
        if self._turned:
            self._converge(sensors)
        now = max(self.newest, float(new[-1]) if len(new) else -np.inf)
        if not self.foot:
            if self._standing.due(now):
                self._standing.look(sensors, self.settings, now, min([self.head, *new.tolist()]))
            if self._standing.news:
                dirty = min(dirty, self._standing.take(np.concatenate([self.times, new])))
            if not self._readings.looked:
                self._readings.look(sensors, now)
        dirty, self._dirty = min(dirty, self._dirty), np.inf
        clock.append(time.thread_time())
        again = [stage.place.t for stage in self.window.since(dirty - SAME_TIME)]
        if not again and not len(new):
            return np.inf
        times = np.unique(np.concatenate([again, new]))
        times = times[np.concatenate([[True], np.diff(times) > SAME_TIME])]
        keep = len(self.window) - len(again)
        look = _BEFORE if len(self.stops) and self.stops[-1, 1] > times[0] - _BEFORE else 1
        before = [stage.place.t for stage in self.window.stages[max(0, keep - look) : keep]]
        if self.opened and len(before) < look:
            before.insert(0, self.head)
        self._keep(keep)
        problem = self._pose(sensors, np.concatenate([before, times]))
        clock.append(time.thread_time())
        self._parameters |= problem.parameters
        self._watch(problem, sensors)
        back = self._add(problem, len(before))
        self.in_force = {rows.name: len(rows.b) for rows in self.window.stages[-1].measured if rows.H.any()}
        self._forget()
        clock.append(time.thread_time())
        if len(new):
            self.seconds = dict(zip(("looking", "posing", "solving"), np.diff(clock).tolist(), strict=True))
        redone = again[0] if again else np.inf
        if back is None:
            return redone
        rest = times[times > self.newest + SAME_TIME]
        return min(redone, back, self.update(sensors, rest, back))

    def _add(self, posed: Problem, first: int) -> float | None:
        """Add the keyframes of a problem from one on; the time before them to go on from, if a fault is found."""
        problem, k, turn = self._weighed(posed), first, 0.0
        while k < len(problem.t):
            turn = max(turn, self._push(problem, k))
            if self.noise.hear(problem, self.window.stages[-1]):
                self._keep(len(self.window) - 1)
                problem = self._weighed(posed)
                turn = max(turn, self._push(problem, k))
            fault = self.window.stages[-1].fault
            if fault is not None:
                again = self.verdicts.settle(*fault, now=float(problem.t[k]))
                if again < problem.t[first] - SAME_TIME:
                    if again <= self.head + SAME_TIME:
                        self.window.forget_tests()
                    return again
                problem = self._weighed(posed)
                back = int(problem.t.searchsorted(again - SAME_TIME))
                self._keep(len(self.window) - (k - back + 1))
                k = back
                continue
            k += 1
        self._turned = turn > self.window.turn
        return None

    def steps_until(self, sensors: Sensors, limit: float, last: bool) -> Array:
        """Keyframes of a walk that can be made by now, and what they change of those before."""
        times = self._steps.until(sensors, self.settings, self._standing, self.newest, limit, last)
        if (stood := self._steps.over) is not None:  # how much a foot sways is told from all of its standing
            self._keep(len(self.window) - len(self.window.since(stood + SAME_TIME)))
            times = self._steps.until(sensors, self.settings, self._standing, self.newest, limit, last)
        self._standing.forget(self.head - CONTEXT)
        dirty = self._steps.changed(sensors, self.head)
        self.came_late(dirty)
        self._dirty = min(self._dirty, dirty)
        return times[1:] if len(self.window) or self.opened else times

    def spare(self, sensors: Sensors, expected: float = np.inf) -> bool:
        """Do one thing that need not wait for the next keyframe, or should not delay it; False if there is none.

        What comes out depends on the rows that have come when it is called, so it is called at certain rows.

        Parameters
        ----------
        expected : s, when the next keyframe should be: once the IMU is there, its interval can be integrated.
        """
        lag, now = self.settings.solver.lag, sensors.imu.newest
        if self._turned:
            self._converge(sensors)
        elif self._tried < self.newest and self.newest - self._oldest > lag * (1.0 + 1.0 / _PORTIONS):
            self._tried = self.newest
            self.settle(sensors, self.newest - lag)
        elif self.foot:
            return False
        elif self._readings.due(self.newest):
            self._dirty = min(self._dirty, self._readings.look(sensors, self.newest))
        elif now < expected or expected <= self.newest:
            return False
        elif expected not in self._motions:
            self._integrate(sensors, expected)
        elif self._standing.due(expected):
            self._standing.look(sensors, self.settings, expected, self.head)
        elif self._standing.news or self._dirty < np.inf:
            self.update(sensors, np.empty(0))
        else:
            return False
        return True

    def _integrate(self, sensors: Sensors, expected: float) -> None:
        """The interval up to a keyframe that is expected."""
        T, start = self.newest, self.window.newest.state
        imu = self._around(sensors, T, sensors.imu.newest).imu
        ends = np.array([T, expected])
        motion = Motion(preintegrate(bridge_gaps(imu), imu, ends, start.ba[0], start.bg[0]), self.frame)
        self._motions[expected] = motion.prepared()

    def _converge(self, sensors: Sensors) -> None:
        self._turned = False
        self.window.converge(renewed=lambda first: self._renewed(sensors, first))
        self._forget()

    def settle(self, sensors: Sensors, until: float = np.inf) -> None:
        """Settle the keyframes before a time."""
        count = int(np.searchsorted(self.window.t, until))
        if not count:
            return
        last = count == len(self.window)
        robust = {self.settings.gnss.kernel, self.settings.vehicle.kernel} != {"none"}
        self.window.converge(always=last or robust, renewed=lambda first: self._renewed(sensors, first))
        overdue = self.newest - float(self.window.stages[0].place.t) - self.settings.solver.lag
        if not last and overdue < _LATEST * self.settings.solver.lag and self.window.first_moved() is not None:
            return  # still being linearised again: the next keyframe will do
        self._head_nodes = self._nodes[count - 1]
        self.head, self.opened = float(self.window.t[count - 1]), True
        self.settled.append(self.window.settle(count))
        self.evidence.add(self.settled[-1])
        self.noise.forget(self.head)
        self._motions = {t: one for t, one in self._motions.items() if t > self.head - CONTEXT}
        del self._nodes[:count]
        self._forget()

    def afresh(self, settings: Settings, setup: Recording) -> Tracker:
        """One with other figures of the sensors that has settled what this one has, and has no keyframes since."""
        other, head = copy.copy(self), self.window.head
        other.settings, other._parameters, other.verdicts = settings, {}, copy.deepcopy(self.verdicts)
        other.noise = copy.deepcopy(self.noise)
        other.window = Window(head.moved(head.estimate), turn_limit(setup.imu.noise))
        other._nodes, other._motions, other.settled = [], {}, []
        other._standing, other._readings = copy.copy(self._standing), copy.copy(self._readings)
        other._readings.revised = other.evidence.revised = False
        return other

    @property
    def stale(self) -> bool:
        """Whether what has not settled was posed with figures of the wheels that are known better by now."""
        return self._readings.revised or self.evidence.revised

    def knows(self, other: Tracker, stationary: Array, until: float) -> None:
        """Take over what another has seen, but for the stops up to a time, which have been looked for anew."""
        self._standing, self._readings = copy.copy(other._standing), copy.copy(other._readings)
        before, after = clipped(stationary, self.head, until - SURE), clipped(other.stops, until - SURE, np.inf)
        self._standing.replace(merged(np.concatenate([before, after]), gap=SAME_TIME), other.times)

    def back_to(self, t: float, other: Tracker) -> None:
        """Forget the keyframes from a time on, where another has redone them and sees stops otherwise."""
        self._keep(len(self.window) - len(self.window.since(t - SAME_TIME)))
        self._motions = {end: one for end, one in self._motions.items() if end < t}
        self._standing = copy.copy(other._standing)

    def _keep(self, count: int) -> None:
        self.window.truncate(count)
        del self._nodes[count:]

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
        begin, stops = float(times[0]), self.stops
        if len(stops):  # a stop is posed whole, so that its place begins where it began
            stops = stops if self.foot else stops[stops[:, 1] > begin]
            here = stops[(stops[:, 0] < begin) & (stops[:, 1] > begin)]
            begin = min([begin, *here[:, 0].tolist()])
        recording = self._around(sensors, begin, float(times[-1]) + 0.1)
        start, speed = self.window.newest.state, None
        if recording.odometer is not None:
            speed = MeanSpeed.of(recording.odometer, self._readings.wrong, self._readings.figures)
        usual = None
        if recording.gnss is not None:
            usual = (self.settings.gnss.sd_factor or 1.0) * sensors.usual(recording.gnss.t)
        found = ((t, self._motions.get(t)) for t in times[1:].tolist())
        known = {t: one for t, one in found if one is not None and not one.intervals.out_of_range(start.bg)[0]}
        problem = pose(
            recording, self.settings, self.frame, start, np.ones(DIM), stops, times, speed, usual, known,
            self._steps.highest,
        )  # fmt: skip
        for k, t in enumerate(times[1:].tolist()):
            if t not in known:
                self._motions[t] = Motion(problem.intervals[k : k + 1], self.frame)
        return problem

    def _watch(self, problem: Problem, sensors: Sensors) -> None:
        """Have the fixes watched for errors that last, as soon as some tell how often they come."""
        if self.window.newest.tests is not None or self.settings.gnss.faults == "off" or len(sensors.gnss) < _FIXES:
            return
        watched = [c for c in problem.constraints if c.watched and isinstance(c, GnssPosition | GnssVelocity)]
        if watched:
            period = float(np.median(np.diff(sensors.gnss.t)))
            self.window.watch(Watch(watched, period, len(self.window.newest.z)))

    def _weighed(self, problem: Problem) -> Problem:
        """The problem with what is decided of each row before it enters the window.

        Fixes: not used where a fault was found, and by how noisy they are. Speeds: their sigma by what settled so far
        says of them.
        """
        factors, rows = self.evidence.factors, []
        for c in problem.constraints:
            if isinstance(c, SPEEDS) and c.name in factors:
                c = replace(c, sigma=c.sigma * factors[c.name])
            if c.watched or c.adaptive != "off":
                t = problem.t[c.keyframe]
                weight = self.noise.weights(c, t)
                if c.watched:
                    weight = weight * self.verdicts.weights(c.name, t)
                if np.any(weight != 1.0):
                    c = replace(c, weight=weight)
            rows.append(c)
        return replace(problem, constraints=tuple(rows))

    def _around(self, sensors: Sensors, begin: float, end: float) -> Recording:
        """The rows that keyframes between two times look at.

        Only what gaps in the IMU hide is told by the signal of the last half minute.
        """
        near = sensors.recording(begin - _NEAR, end)
        t = near.imu.t
        whole = len(t) > 2 and float((t[1:] - t[:-1]).max()) < GAP * period_of(t)
        return near if whole else sensors.recording(begin - CONTEXT, end)

    def _push(self, problem: Problem, k: int) -> float:
        t = float(problem.t[k])
        first = not self.window.stages and not self.opened
        nodes = dict(self._nodes[-1] if self._nodes else self._head_nodes)
        turn = self.window.push(Place(t, problem, k, self._moves(problem, t, nodes), linked=not first))
        self._nodes.append(nodes)
        return turn

    def _moves(self, problem: Problem, t: float, nodes: dict[str, float]) -> tuple[Step, ...]:
        """Parameters that begin or move on at a keyframe; `nodes` is brought up to date."""
        steps = []
        stop = self._stop_at(t) if PLACE in self._parameters else None
        for name, p in self._parameters.items():
            if name == PLACE:
                if stop is not None and nodes.get(name) != stop:
                    place = self.window.newest.state.p[0]
                    steps.append(Step(name, place, np.full(3, _PLACE_SIGMA)))
                    nodes[name] = stop
            elif name not in nodes:
                steps.append(Step(name, np.atleast_2d(p.initial)[0], np.atleast_2d(p.sigma)[0]))
                nodes[name] = t
            elif t - nodes[name] >= p.spacing - SAME_TIME and not p.constant:
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
        problem = self._weighed(self._pose(sensors, self.times[begin:]))
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
