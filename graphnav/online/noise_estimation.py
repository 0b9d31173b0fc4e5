"""Repeated estimation of the noise model during the drive; no keyframe waits for it.

The estimation (`graphnav.estimation.noise`), which filters and smooths some minutes of rows a dozen times, runs in a
thread. Its result is used at the first row after a fixed time of the drive, so that the output does not depend on how
long it took. A second tracker then processes the unsettled keyframes with the new model, some keyframes per row, and
replaces the first when it has caught up.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.gnss import GnssPosition
from graphnav.constraints.lasting import TIMES
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.findings import Finding
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.detectors import detect
from graphnav.detectors.base import subtract_spans
from graphnav.estimation.alignment import Alignment
from graphnav.estimation.building import start_sigma
from graphnav.estimation.contradictions import are_same, describe_freed, use_freed
from graphnav.estimation.faults.excluded import find_fault_spans
from graphnav.estimation.joint_estimate import JointEstimate, estimate_jointly
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.false_stops import find_false_stops, leave_out_false_stops, unite_stops
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.noise.tails import widen_unweighted
from graphnav.estimation.noise.words import describe_noise
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solution import ExcludedSpan
from graphnav.estimation.solvers.linearise import shift
from graphnav.estimation.solvers.passes import LINEAR_ATTITUDE
from graphnav.online.checks import check_rows
from graphnav.online.fixes import compute_unit
from graphnav.online.raw import drop_ambiguities
from graphnav.online.sensors import Sensors
from graphnav.online.start import find_start
from graphnav.online.tracker import Tracker
from graphnav.recording import Recording

_REPLAYED_PORTION = 4  # keyframes processed again per row
_ENOUGH_FIXES = 600  # fixes in motion, which determine variances to 6 %
_LONGEST_SPAN = 900.0  # s of rows after which estimation ends where fixes are rare
# of the lag, and s: time allowed for the estimation at most
_THINKING, _LONGEST_THOUGHT = 1.0 / 8.0, 20.0
_FIRST_THOUGHT, _THOUGHT = 2.0, 0.02  # s, and s a keyframe: three times what loading its code takes, and twice the work


@dataclass(frozen=True)
class EstimationResult:
    """Result of a noise estimation."""

    noise: NoiseModel
    notes: tuple[str, ...]
    stationary: Array  # (M, 2) s
    excluded: tuple[ExcludedSpan, ...]  # spans that the noise model excludes
    doubts: tuple[Finding, ...]  # findings on units, axes and clocks
    start: Alignment
    points: SmoothedPoints  # of the keyframes that it was estimated from
    anew: bool  # whether constants are free, or no longer, or the start is another: all states so far are concerned

    def keep_false_stops(self, before: NoiseModel) -> NoiseModel:
        """The noise model with the false stops of the one in use as well."""
        return replace(self.noise, false_stops=unite_stops(before.false_stops, self.noise.false_stops))


@dataclass(frozen=True)
class SmoothedPoints:
    """Smoothed states and parameters of keyframes."""

    t: Array  # (K,) s
    states: States  # (K,)
    values: dict[str, Array]  # (K, k) by parameter


@dataclass(frozen=True)
class EstimationTask:
    """Input of a noise estimation."""

    recording: Recording
    every: Recording  # including fixes that are not used
    settings: Settings
    frame: LocalFrame
    found: Alignment
    times: Array  # (K,) s, keyframes, the first at the start of the recording: weights of rows hold at these
    unit: Array  # (3,) m, unit of the result for errors of the fixes over minutes and hours
    before: NoiseModel  # in use so far
    last: bool  # whether its rows are as many as are wanted

    def run(self) -> EstimationResult:
        """As `run_estimation`."""
        return run_estimation(self)


_Estimated = tuple[Alignment, Array, JointEstimate]  # a start, stops (M, 2) s, and what is estimated with them


def run_estimation(task: EstimationTask) -> EstimationResult:
    """Estimate the noise model.

    Raises
    ------
    EstimationError
        If the rows do not determine it.
    """
    settings, before = task.settings, task.before

    def estimate(start: Alignment, stationary: Array) -> JointEstimate:
        base = build_problem(
            task.recording, settings, task.frame, start.state, start_sigma(start), stationary, task.times,
            parts_of_noise=True,
        )  # fmt: skip
        return estimate_jointly(_share_horizontal_unit(base), settings.gnss, start.until)

    def judge(one: _Estimated) -> Array:
        _, stationary, found = one
        near = found.estimate.get_linearisation(found.base)
        return find_false_stops(found.base, found.estimate.noise, near, stationary)[0]

    def estimate_without(one: _Estimated, false: Array) -> _Estimated:
        start, stationary = one[0], subtract_spans(every, false)
        if start.until is None or false[0, 0] < start.until:
            start = _align_again(task, stationary, before)
        return start, stationary, estimate(start, stationary)

    try:
        every = subtract_spans(detect(task.every, settings).stationary, np.array(before.false_stops).reshape(-1, 2))
        one = task.found, every, estimate(task.found, every)
        (start, stationary, found), false = leave_out_false_stops(one, judge, estimate_without)
        noise, base = found.noise, found.stated
        freed_anew = not are_same(noise.freed, before.freed, base)
        if freed_anew:
            start = _align_again(task, stationary, noise)
        else:  # they are states already, and need no other prior
            noise = replace(noise, freed=before.freed)
        anew = freed_anew or start is not task.found
        used, smoothed = apply_noise(found.base, noise), found.estimate.points
        values = {name: smoothed.values[:, shift(at)] for name, at in used.columns.items()}
        points = SmoothedPoints(task.times, smoothed.states, values)
        words = (*describe_freed(noise.freed, task.recording), *describe_noise(noise, used))
        wrong = find_fault_spans(used)
        noise = widen_unweighted(used, _convert_unit(noise, base, task.unit))
        noise = replace(noise, false_stops=unite_stops(before.false_stops, false))
        noise = noise if task.last else _expect_variances(noise)
        return EstimationResult(noise, words, stationary, wrong, check_rows(task.every), start, points, anew)
    except np.linalg.LinAlgError as error:
        raise EstimationError(str(error), key="solver.undetermined") from error


def _expect_variances(noise: NoiseModel) -> NoiseModel:
    """The noise model with the means of variances in place of their most likely values, until there are enough rows.

    Where variances are uncertain, the best of all linear filters is the one with their means; that of a log-normal
    distribution of median m is m exp(s^2 / 2). Errors that last for hours stay as they are: no later row will tell.
    """
    figures = {
        name: one if f".{TIMES[-1]}." in name else replace(one, log_factor=one.log_factor + 0.5 * one.sigma**2)
        for name, one in noise.figures.items()
    }
    return replace(noise, figures=figures)


def _align_again(task: EstimationTask, stationary: Array, noise: NoiseModel) -> Alignment:
    """The start without the constants as stated that are free."""
    rows = use_freed(task.recording, noise.freed, task.frame.epoch)
    try:
        found = find_start(rows, stationary, task.settings, task.frame)
    except EstimationError:
        return task.found
    return found if found.motion is not None else task.found


class BackgroundTask(Protocol):
    """Input of something that is estimated beside the drive."""

    def run(self) -> Any:
        """Estimate it."""


class BackgroundEstimation:
    """An estimation in a thread of its own, from a copy of its input.

    The copy keeps values computed at first use out of the input while a checkpoint is written.
    A checkpoint keeps the input; the estimation runs again on resuming.

    Parameters
    ----------
    due : s, when the result is to be used.
    """

    def __init__(self, task: BackgroundTask, due: float) -> None:
        self.task: Any = task
        self.due = due
        self._result: Future[Any] = _start(copy.deepcopy(task))

    def wait(self) -> Any:
        """Wait for the result, with the errors of the estimation."""
        return self._result.result()

    def __reduce__(self) -> tuple[type[BackgroundEstimation], tuple[BackgroundTask, float]]:
        return BackgroundEstimation, (self.task, self.due)


def _start(task: BackgroundTask) -> Future[Any]:
    """Run a task in a thread that nothing waits for at the end of the program."""
    out: Future[Any] = Future()

    def do() -> None:
        try:
            out.set_result(task.run())
        except BaseException as error:  # reported by whoever asks for the result
            out.set_exception(error)

    threading.Thread(target=do, daemon=True).start()
    return out


def _share_horizontal_unit(base: Problem) -> Problem:
    """The problem with a common unit of both horizontal axes for errors that last for minutes and hours."""
    rows = (
        replace(c, drive_error=compute_unit(c.sigma)) if isinstance(c, GnssPosition) else c for c in base.constraints
    )
    return replace(base, constraints=tuple(rows))


def _convert_unit(noise: NoiseModel, base: Problem, unit: Array) -> NoiseModel:
    """The same model with errors that last for minutes and hours in another unit (3,), m.

    An estimate uses the typical stated sigma so far as its unit; the parameters of a drive keep theirs.
    """
    own = next((c.drive_error for c in base.constraints if isinstance(c, GnssPosition)), unit)
    level, up = (2.0 * np.log(own / unit)[1:]).tolist()
    figures = dict(noise.figures)
    for name, one in noise.figures.items():
        if name.startswith(GnssPosition.name) and any(f".{time}." in name for time in TIMES[1:]):
            more = up if name.endswith(".up") else level
            figures[name] = replace(one, log_factor=one.log_factor + more, prior=one.prior + more)
    return replace(noise, figures=figures)


def start_estimation(
    sensors: Sensors,
    settings: Settings,
    frame: LocalFrame,
    found: Alignment,
    times: Array,
    until: float,
    before: NoiseModel,
    last: bool,
) -> BackgroundEstimation:
    """Start a noise estimation from the rows up to a time (s); `times` (K,) are the keyframes so far, s.

    Parameters
    ----------
    last : whether none follows, so that what these rows leave open stays so, as offline.
    """
    recording, every = (sensors.make_recording(-np.inf, until, all_of_them) for all_of_them in (False, True))
    # until then rows are smoothed with noise that is known less well
    due = float(times[-1]) + min(_FIRST_THOUGHT + _THOUGHT * len(times), limit_thought(settings.solver.lag))
    settings = drop_ambiguities(settings, sensors.setup)
    return BackgroundEstimation(
        EstimationTask(recording, every, settings, frame, found, times, sensors.gnss.compute_unit(), before, last), due
    )


def limit_thought(lag: float) -> float:
    """Time (s of the drive) that an estimation may take."""
    return min(_THINKING * lag, _LONGEST_THOUGHT)


def are_enough(sensors: Sensors, found: Alignment, span: float) -> bool:
    """Whether the rows of a span (s) determine the noise model so well that more rows would change little."""
    assert found.motion is not None
    return bool(np.count_nonzero(sensors.gnss.used > found.motion) >= _ENOUGH_FIXES or span > _LONGEST_SPAN)


class CatchUp:
    """A tracker that processes the keyframes of another one, which continues meanwhile.

    Parameters
    ----------
    tracker : without keyframes.
    settled : (K,) s, keyframes that it is to process and that the other no longer has.
    points : of an estimate with its noise model; where the tracker is far from them, it goes on from there.
    """

    def __init__(self, tracker: Tracker, settled: Sequence[float] = (), points: SmoothedPoints | None = None) -> None:
        self.tracker, self.settled, self._points = tracker, np.array(settled), points
        self._revises = False

    def step(self, sensors: Sensors, other: Tracker) -> bool:
        """Process a few more keyframes of the other; True once it has caught up."""
        t, done = np.concatenate([self.settled, other.window.t]), len(self.tracker.window)
        if self._revises:
            self._revises = self.tracker.revise(sensors)
            return False
        known = len(t) if self._points is None else int(np.searchsorted(t, self._points.t[-1] + SAME_TIME))
        if self._points is not None and done >= known:
            self._revises, self._points = self._go_to(self._points), None
            return False
        end = min(done + _REPLAYED_PORTION, known)
        while end < known and np.any(np.abs(self.tracker.stops[:, 0] - t[end - 1]) < SAME_TIME):
            end += 1  # the beginning of a stop is known only from later rows
        self.tracker.update(sensors, t[done:end])
        return self._points is None and len(self.tracker.window) >= len(t)

    def _go_to(self, points: SmoothedPoints) -> bool:
        """Have all keyframes linearised at known points if one is far from them: a filter that begins with an unknown
        heading may lead its smoother to another minimum.
        """
        window = self.tracker.window
        at = np.searchsorted(points.t, window.t - SAME_TIME)
        if not len(at) or at[-1] == len(points.t) or np.any(np.abs(points.t[at] - window.t) > SAME_TIME):
            return False  # it has other keyframes
        away = points.states[at].minus(window.read_states())
        if np.linalg.norm(away[:, :3], axis=1).max() <= LINEAR_ATTITUDE:
            return False
        means = []
        for stage, k in zip(window.stages, at.tolist(), strict=True):
            message = stage.message
            e = np.zeros(DIM + len(message.values))
            e[:DIM] = points.states[k : k + 1].minus(message.state)[0]
            for name in message.columns.keys() & points.values.keys():
                e[message.columns[name]] = points.values[name][k] - message.get_value(name)
            means.append(e)
        window.linearise_at(means)
        return True
