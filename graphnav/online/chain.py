"""The chain of keyframes of a running drive: how they enter the window, and what is recorded of them.

A keyframe enters with the parameters that begin or change there, with the current noise model, and without the fixes
that tests have excluded. If a fix shows that fixes have been wrong for some time, the keyframes since then are removed
and enter again without them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.standstill import PLACE
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, Parameter
from graphnav.estimation.factor_graph.tree_window import TreeWindow
from graphnav.estimation.faults.verdicts import Verdicts
from graphnav.estimation.faults.watch import PATIENCE, Watch
from graphnav.estimation.fixing import (
    LOST_ERRORS,
    LOST_PLACE,
    LOST_SPEED,
    Held,
    add_integers,
    hold_on,
    may_fix,
    split_carriers,
)
from graphnav.estimation.known_arcs import Epochs
from graphnav.estimation.noise.apply import select_weights
from graphnav.estimation.noise.model import INTERVALS, STATED, NoiseModel
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ExcludedSpan
from graphnav.estimation.solvers.elimination import Predicted
from graphnav.estimation.solvers.linearise import Points, Step
from graphnav.estimation.solvers.stages import Message, Place
from graphnav.estimation.solvers.window import SettledStates, Window, compute_turn_limit
from graphnav.imu.dynamics import ImuFactors
from graphnav.imu.preintegration import NOISE_FIGURES
from graphnav.online.looks import SURE, Stops
from graphnav.online.sensors import Sensors
from graphnav.recording import Recording
from graphnav.recording.plausibility.fixes import GRIP

_PLACE_SIGMA = 1000.0  # m, prior 1-sigma of the position of a stop
_FEWEST_FOR_PERIOD = 5  # fixes from which their period is known
_FIXES_FOR_A_STATE = 3  # of place: the first tells of it, the second of velocity, the third of attitude
_ENGINES: dict[str, type[Window]] = {"window": Window, "isam2": TreeWindow}


@dataclass(frozen=True)
class BuiltKeyframes:
    """Keyframes that are to enter, in a problem from its keyframe `first` on."""

    problem: Problem
    first: int
    times: Array  # (K,) s
    redone: float  # s, the first of them that was in the window before
    ahead: Predicted | None  # prediction of the first


class Chain:
    """Keyframes in a window.

    Parameters
    ----------
    message, t0 : the prior and the time it is for.
    setup : of the sensors.
    noise : the noise model in use.
    """

    def __init__(
        self, settings: Settings, message: Message, t0: float, setup: Recording, noise: NoiseModel = STATED
    ) -> None:
        self.settings, self.noise = settings, noise
        self.window = _ENGINES[settings.solver.engine](message, find_turn(setup, noise))
        self.head = t0  # time of the message before the window, or of the first keyframe while it is in the window
        self.opened = False  # whether the first keyframe has left the window
        self.verdicts = Verdicts({}, {})  # mask of the fixes in use
        self.judged = -np.inf  # s, up to where the noise model tells which fixes are wrong, by evidence
        self._standing = Stops(noise.false_stops)
        self._nodes: list[dict[str, float]] = []  # per stage, when each parameter's node began
        self._head_nodes: dict[str, float] = {}
        self._held: list[Held] = []  # per stage, integers of ambiguities
        self._head_held = Held()
        self.epochs = self.fixed = 0  # settled keyframes with carriers, and those of them that are fixed
        self._parameters: dict[str, Parameter] = {}
        self._gaps = np.empty((0, 2))  # (M, 2) s, gaps of the IMU that are filled in
        # whether some state has moved so far from its linearisation point that it may have to be relinearised
        self._turned = False

    @property
    def busy(self) -> bool:
        """Whether keyframes are still entering, a few per row; here they enter at once."""
        return False

    def go_on(self, sensors: Sensors) -> None:
        """Let a few more keyframes enter."""

    def finish_entering(self, sensors: Sensors) -> None:
        """Let all remaining keyframes enter at once."""

    def note_missed_row(self, sensors: Sensors, sensor: str, t: float) -> bool:
        """Record a row that came late, at a time (s): whether keyframes exist that would have used it."""
        return True

    @property
    def newest(self) -> float:
        """Time of the newest keyframe, s."""
        return self.window.stages[-1].place.t if self.window.stages else self.head

    @property
    def stops(self) -> Array:
        """Spans (M, 2) between keyframes in which the vehicle, or the foot, is stationary, s."""
        return self._standing.spans

    @property
    def detected_until(self) -> float:
        """Time up to which it is known where stops are, s."""
        return self._standing.looked - SURE

    @property
    def times(self) -> Array:
        """Times of all keyframes at the ends of intervals in the window, s."""
        t = self.window.t
        return np.concatenate([[self.head], t]) if self.opened else t

    @property
    def excluded(self) -> tuple[ExcludedSpan, ...]:
        """Spans of excluded fixes, by whatever test."""
        times, used = self.verdicts.times, self.verdicts.used
        left = {name: used[name] * (select_weights(t, self.noise, name) > 0.0) for name, t in times.items()}
        return Verdicts(times, left).list_faults()

    @property
    def _estimates_imu(self) -> bool:
        """Whether some figure of the IMU differs from the stated one."""
        return any(self.noise.get_factor(f"imu.{name}", 1.0) != 1.0 for name in NOISE_FIGURES)

    @property
    def _noise_of_rows(self) -> NoiseModel:
        """The noise model for a problem whose intervals include it already."""
        rows = {name: one for name, one in self.noise.figures.items() if not name.startswith("imu.")}
        weights = {name: some for name, some in self.noise.weights.items() if name not in INTERVALS}
        return replace(self.noise, figures=rows, weights=weights)

    @property
    def _oldest(self) -> float:
        """Time of the oldest keyframe in the window, s."""
        return self.window.stages[0].place.t if self.window.stages else self.newest

    # ------------------------------------------------------------------------------------------ entering, leaving
    def _watch(self, problem: Problem, sensors: Sensors) -> None:
        """Start to watch the fixes for lasting errors, behind those judged by evidence, once their period is known."""
        tests = self.window.newest.tests
        if tests is not None and self.newest <= self.judged + SAME_TIME < problem.t[-1]:
            self.window.watch(tests.forget_onsets())  # the size of usual innovations stays known
        if (
            tests is not None
            or problem.t[-1] <= self.judged + SAME_TIME
            or self.settings.gnss.faults == "off"
            or len(sensors.gnss.used) < _FEWEST_FOR_PERIOD
        ):
            return
        watched = [c for c in problem.constraints if c.watched and c.fix_of]
        if watched:
            period = float(np.median(np.diff(sensors.gnss.used)))
            self.window.watch(Watch(watched, period, len(self.window.newest.z)))

    def _weigh(self, problem: Problem) -> Problem:
        """The problem without the fixes in which a fault was found."""
        rows = []
        for c in problem.constraints:
            if c.watched:
                weight = self.verdicts.weigh(c.name, problem.t[c.keyframe])
                if not (weight == 1.0).all():
                    c = replace(c, weight=weight if c.weight is None else c.weight * weight)
            rows.append(c)
        return self._hold(replace(problem, constraints=tuple(rows)))

    def _hold(self, problem: Problem) -> Problem:
        """The problem with the integers decided at its keyframes, except released ones."""
        if split_carriers(problem)[1] is None:
            return problem
        begin, end = np.searchsorted(self.window.t, problem.t[[0, -1]] + [-SAME_TIME, SAME_TIME])
        decided = {
            float(self.window.stages[i].place.t): held
            for i, held in enumerate(self._held[begin:end], begin)
            if held.found or held.let_go
        }
        return _add_decisions(problem, decided) if decided else problem

    def _add(
        self, built: Problem, first: int, ahead: Predicted | None = None, begin: int = 0, end: int | None = None
    ) -> float | None:
        """Add the keyframes of a problem from `first` on; returns the time before them to go back to, if a fault is
        found.

        `ahead` is the prediction of the first of them, if it is still valid; `begin` and `end` are of a portion.
        """
        problem, k, turn = self._weigh(built), max(first, begin), 0.0
        while k < (len(problem.t) if end is None else end):
            turn = max(turn, self._push(problem, k, ahead))
            ahead = None
            fault, tests = self.window.stages[-1].fault, self.window.newest.tests
            if tests is not None and self._may_be_gap(float(problem.t[k]), tests):
                self.window.watch(tests.forget_onsets())
                fault = None
            if fault is not None and problem.t[k] > self.judged + SAME_TIME:
                again = self.verdicts.settle(*fault, now=float(problem.t[k]))
                if again < problem.t[first] - SAME_TIME:
                    if again <= self.head + SAME_TIME:
                        self.window.forget_tests()
                    return again
                problem = self._weigh(built)
                back = int(problem.t.searchsorted(again - SAME_TIME))
                self._keep(len(self.window) - (k - back + 1))
                k = back
                continue
            k += 1
        self._turned |= turn > self.window.turn
        return None

    def _note_gaps(self, gaps: Array) -> None:
        """Remember the gaps (M, 2) of the IMU that are filled in, s."""
        gaps = np.concatenate([self._gaps[self._gaps[:, 1] > self.head], gaps])
        gaps = gaps[np.argsort(gaps[:, 1], kind="stable")]
        self._gaps = gaps[np.append(np.diff(gaps[:, 1]) > SAME_TIME, True)[: len(gaps)]]

    def _may_be_gap(self, t: float, tests: Watch) -> bool:
        """Whether a keyframe is behind gaps of the IMU with so few fixes since that what was filled in, as an error of
        place, velocity and attitude, explains them as well as a fault of theirs: in short ones nothing happens that is
        as large as a fault. Where fixes have told the place just before, a later one may be further off than the tyres
        can have moved a vehicle in them; behind an outage attitudes have led it astray besides.
        """
        begin, end = self._gaps[(self._gaps[:, 1] <= t + SAME_TIME) & (self._gaps[:, 1] > t - PATIENCE)].T
        speed, fault, may_be = float(np.linalg.norm(self.window.newest.state.v)), self.window.stages[-1].fault, False
        for name, times in self.verdicts.times.items():
            used, before = self.verdicts.used[name] > 0.0, times.searchsorted(end)
            here = int(times.searchsorted(t + SAME_TIME))
            new = (here - before <= _FIXES_FOR_A_STATE) & ((before == 0) | used[before - 1])
            if name not in tests:
                continue
            known = times[: here - 1][used[: here - 1]][-1:]  # the last that has told the place
            since = t - np.maximum(begin[new], known if len(known) else -np.inf)
            most = tests.compute_shift(name, GRIP * (end - begin)[new], since)
            may_be |= tests.would_seem_wrong(name, most, speed)
            near = len(known) and t - known[0] < (_FIXES_FOR_A_STATE + 0.5) * np.median(np.diff(times))
            if near and fault is not None and fault[0] == name and self._measure_innovation(name) > most:
                return False
        return may_be

    def _measure_innovation(self, name: str) -> float:
        """How far the newest keyframe's fixes of a kind are from their prediction, m or m/s."""
        rows = (one for one in self.window.stages[-1].measured if one.name == name)
        return max(float(np.linalg.norm(one.b * one.sigma, axis=1).max()) for one in rows)

    def _push(self, problem: Problem, k: int, ahead: Predicted | None) -> float:
        place, nodes = self._place(problem, k)
        turn = self.window.push(place, ahead if ahead is not None and ahead.before is self.window.newest else None)
        held = self._decide(problem, k)
        if held.found or held.let_go or held.anew:
            self.window.truncate(len(self.window) - 1)
            place = replace(place, problem=_add_decisions(problem, {place.t: held}))
            place = replace(place, steps=self._begin_anew(problem, place.steps, held))
            turn = max(turn, self.window.push(place))
        self._nodes.append(nodes)
        self._held.append(held)
        return turn

    def _decide(self, problem: Problem, k: int) -> Held:
        """Integers that can be decided up to keyframe `k` of a problem, the newest, and arcs that slipped there."""
        held = (self._held[-1] if self._held else self._head_held).go_on()
        phase, newest = split_carriers(problem)[1], self.window.newest
        if phase is None or k not in phase.keyframe:
            return held
        if any(name not in newest.columns for name in phase.slots):
            return held
        here = Points(newest.state, newest.values[None])
        epochs, search = Epochs(phase, newest.columns, problem.t), may_fix(problem, phase)
        return hold_on(held, epochs, k, here, lambda: newest.covariance, search)

    def _begin_anew(self, problem: Problem, steps: tuple[Step, ...], held: Held) -> tuple[Step, ...]:
        """Steps with ambiguities reset about their current estimates, except those that begin anew in any case, and
        errors that wrong integers left wrong."""
        phase, newest, started = split_carriers(problem)[1], self.window.newest, {step.name for step in steps}
        assert phase is not None
        lost = LOST_ERRORS if held.let_go else ()
        kept = tuple(step for step in steps if step.name not in lost)
        errors = ((name, self._parameters[name]) for name in lost if name in newest.columns)
        again = tuple(
            Step(p.name, newest.get_value(p.name), p.sigma[0])
            for p in phase.parameters
            if p.name in phase.slots and p.name in newest.columns and p.name not in started
            if held.let_go or any(name == p.name for name, _ in held.anew)
        )
        return (*kept, *again, *(Step(name, p.initial, p.sigma) for name, p in errors))

    def _place(self, problem: Problem, k: int) -> tuple[Place, dict[str, float]]:
        """Append keyframe `k` of a problem, with the times when each parameter's node began there."""
        t = float(problem.t[k])
        first = not self.window.stages and not self.opened
        nodes = dict(self._nodes[-1] if self._nodes else self._head_nodes)
        return Place(t, problem, k, self._moves(t, nodes), linked=not first), nodes

    def _moves(self, t: float, nodes: dict[str, float]) -> tuple[Step, ...]:
        """Parameters that begin or change at a keyframe; `nodes` is updated."""
        steps = []
        stop = self._stop_at(t) if PLACE in self._parameters else None
        for name, p in self._parameters.items():
            if name == PLACE:
                if stop is not None and nodes.get(name) != stop:
                    place = self.window.newest.state.p[0]
                    steps.append(Step(name, place, np.full(3, _PLACE_SIGMA)))
                    nodes[name] = stop
            elif p.begins is not None:
                j = int(np.searchsorted(p.begins, t + SAME_TIME, side="right")) - 1
                if (j >= 0 and nodes.get(name) != p.begins[j]) or name not in nodes:
                    steps.append(Step(name, p.initial[max(j, 0)], p.sigma[max(j, 0)]))
                    nodes[name] = float(p.begins[max(j, 0)])
            elif name not in nodes:
                steps.append(Step(name, np.atleast_2d(p.initial)[0], np.atleast_2d(p.sigma)[0]))
                nodes[name] = t
            elif t - nodes[name] >= p.spacing - SAME_TIME and not p.constant:
                ahead, added = p.step(np.array([nodes[name]]), np.array([t]))
                steps.append(Step(name, p.initial, added[0], float(ahead[0]), p.initial))
                nodes[name] = t
        return tuple(steps)

    def _stop_at(self, t: float) -> float | None:
        """When the stop that lasts at a time began."""
        inside = (self.stops[:, 0] <= t + SAME_TIME) & (self.stops[:, 1] >= t - SAME_TIME)
        return float(self.stops[inside][0, 0]) if inside.any() else None

    def _keep(self, count: int) -> None:
        self.window.truncate(count)
        del self._nodes[count:], self._held[count:]

    def _leave(self, count: int) -> SettledStates:
        """Settle the first keyframes (marginalise them out of the window)."""
        self.epochs += sum(held.epoch for held in self._held[:count])
        self.fixed += sum(held.epoch and held.fixed for held in self._held[:count])
        self._head_nodes, self._head_held = self._nodes[count - 1], self._held[count - 1].go_on()
        self.head, self.opened = float(self.window.t[count - 1]), True
        settled = self.window.settle(count)
        del self._nodes[:count], self._held[:count]
        return settled


def find_turn(setup: Recording, noise: NoiseModel) -> float:
    """Largest change of attitude (rad) without relinearisation, by the noise of the accelerometer."""
    stated = setup.imu.noise
    density = stated.accel_noise_density * float(np.sqrt(noise.get_factor("imu.accel_noise_density", 1.0)))
    return compute_turn_limit(replace(stated, accel_noise_density=density))


def _add_decisions(problem: Problem, decided: dict[float, Held]) -> Problem:
    """A problem with the integers decided at some of its keyframes, by time."""
    phase = split_carriers(problem)[1]
    if phase is None:
        return problem
    rows, lost = [], np.zeros(len(problem.t), dtype=bool)
    for k, t in enumerate(problem.t.tolist()):
        held = decided.get(t)
        if held is not None:
            rows += [(k, a, b, n) for (a, _), (b, _), n in held.found]
            lost[k] = held.let_go
    problem = add_integers(problem, phase, rows)
    if not lost[1:].any():
        return problem
    covariance = problem.intervals.covariance.copy()
    for block, sigma in (("p", LOST_PLACE), ("v", LOST_SPEED)):
        at = np.arange(15)[BLOCKS[block]]
        covariance[np.ix_(lost[1:], at, at)] += sigma**2 * np.eye(3)
    intervals = replace(problem.intervals, covariance=covariance)
    return replace(problem, intervals=intervals, motion=ImuFactors(intervals, problem.frame))
