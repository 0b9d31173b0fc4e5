"""Estimating the noise model again by more rows, beside the drive: no keyframe waits for it.

The estimate itself (`graphnav.estimation.noise`), which filters and smooths some minutes a dozen times, is made in a
thread. Its answer is used at the first row after a fixed time of the drive, so that what comes out does not depend on
how long it took. A second tracker then goes through what has not settled with the new model, some keyframes at a row,
and takes the first one's place when it has caught up.
"""

from __future__ import annotations

import copy
import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.gnss import TIMES, GnssPosition
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.detectors import detect
from graphnav.estimation import faults
from graphnav.estimation.alignment import Alignment
from graphnav.estimation.building import start_sigma
from graphnav.estimation.noise.apply import with_noise
from graphnav.estimation.noise.estimate import estimate_noise
from graphnav.estimation.noise.exclusion import estimate_without_faults
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.noise.words import describe
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solution import ExcludedSpan
from graphnav.online.checks import check_rows
from graphnav.online.fixes import unit_of
from graphnav.online.raw import without_ambiguities
from graphnav.online.sensors import Sensors
from graphnav.online.tracker import Tracker
from graphnav.recording import Recording

_PORTION = 4  # keyframes gone through again at a row
_FIXES = 600  # in motion, that tell variances to 6 %
_LONGEST = 900.0  # s of rows, where fixes are so rare that these are still too few
_THINKING, _LONGEST_THOUGHT = 1.0 / 8.0, 20.0  # of the lag, and s: what judging may take, 11 s for 1100 keyframes


@dataclass(frozen=True)
class Answer:
    """What some rows say of the sensors."""

    noise: NoiseModel
    notes: tuple[str, ...]
    stationary: Array  # (M, 2) s
    excluded: tuple[ExcludedSpan, ...]  # spans that the noise model leaves out
    doubts: tuple[str, ...]  # what the rows show of their units, axes and clocks


class Judgement:
    """The noise model that the rows of a recording tell.

    Parameters
    ----------
    every : that with the fixes, too, that are not used.
    times : (K,) s, keyframes, the first at the start of the recording: weights of rows hold at these.
    unit : (3,) m, in which the answer is to tell errors of the fixes that last for minutes and hours.
    due : s, when the answer is to be used.
    """

    def __init__(
        self,
        recording: Recording,
        every: Recording,
        settings: Settings,
        frame: LocalFrame,
        found: Alignment,
        times: Array,
        unit: Array,
        due: float,
    ) -> None:
        self.found, self.due, self.until = found, due, float(times[-1])
        self._asked = recording, every, settings, frame, times, unit
        self._begin()

    def answer(self) -> Answer:
        """Wait for it.

        Raises
        ------
        EstimationError
            If the rows do not tell.
        """
        self._thread.join()
        if isinstance(self._answer, BaseException):
            raise self._answer
        assert self._answer is not None
        return self._answer

    def _begin(self) -> None:
        self._answer: Answer | BaseException | None = None
        # its own copies: what objects work out at their first use must not appear while a checkpoint is written
        self._thread = threading.Thread(target=self._work, args=copy.deepcopy((self._asked, self.found)), daemon=True)
        self._thread.start()

    def _work(self, asked: tuple[Recording, Recording, Settings, LocalFrame, Array, Array], start: Alignment) -> None:
        recording, every, settings, frame, times, unit = asked
        try:
            stationary = detect(every, settings).stationary
            base = build_problem(
                recording, settings, frame, start.state, start_sigma(start), stationary, times, parts_of_noise=True
            )  # fmt: skip
            base = _level(base)
            estimate = estimate_noise if settings.gnss.faults == "off" else estimate_without_faults
            noise = estimate(base, start.until).noise
            used = with_noise(base, noise)
            said, wrong = describe(noise, used), faults.fault_spans(used)
            self._answer = Answer(_in_unit(noise, base, unit), said, stationary, wrong, check_rows(every))
        except (EstimationError, np.linalg.LinAlgError) as error:
            self._answer = EstimationError(str(error), key=getattr(error, "key", "solver.undetermined"))
        except BaseException as error:  # said by whoever asks
            self._answer = error

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_thread", "_answer")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()


def _level(base: Problem) -> Problem:
    """The problem with one unit for both horizontal axes of what lasts for minutes and hours."""
    rows = (replace(c, usual_error=unit_of(c.sigma)) if isinstance(c, GnssPosition) else c for c in base.constraints)
    return replace(base, constraints=tuple(rows))


def _in_unit(noise: NoiseModel, base: Problem, unit: Array) -> NoiseModel:
    """The model that says the same of errors that last for minutes and hours in another unit (3,), m.

    An estimate has what the fixes state by then for its unit; the parameters of a drive keep theirs.
    """
    own = next((c.usual_error for c in base.constraints if isinstance(c, GnssPosition)), unit)
    level, up = (2.0 * np.log(own / unit)[1:]).tolist()
    figures = dict(noise.figures)
    for name, one in noise.figures.items():
        if name.startswith(GnssPosition.name) and any(f".{time}." in name for time in TIMES[1:]):
            more = up if name.endswith(".up") else level
            figures[name] = replace(one, log_factor=one.log_factor + more, prior=one.prior + more)
    return replace(noise, figures=figures)


def judge(
    sensors: Sensors, settings: Settings, frame: LocalFrame, found: Alignment, times: Array, until: float
) -> Judgement:
    """Have the sensors judged by their rows up to a time (s); `times` (K,) are the keyframes so far, s."""
    recording, every = (sensors.recording(-np.inf, until, all_of_them) for all_of_them in (False, True))
    due = float(times[-1]) + min(_THINKING * settings.solver.lag, _LONGEST_THOUGHT)
    settings = without_ambiguities(settings, sensors.setup)
    return Judgement(recording, every, settings, frame, found, times, sensors.gnss.unit(), due)


def are_enough(sensors: Sensors, found: Alignment, span: float) -> bool:
    """Whether the rows of a span (s) tell the sensors so well that more would say little new."""
    assert found.motion is not None
    return bool(np.count_nonzero(sensors.gnss.used > found.motion) >= _FIXES or span > _LONGEST)


class CatchUp:
    """A tracker that goes through the keyframes of another, which goes on meanwhile.

    Parameters
    ----------
    tracker : without keyframes.
    """

    def __init__(self, tracker: Tracker) -> None:
        self.tracker = tracker

    def step(self, sensors: Sensors, other: Tracker) -> bool:
        """Go through a few more keyframes of the other; True once it has caught up."""
        t, done = other.window.t, len(self.tracker.window)
        end = min(done + _PORTION, len(t))
        while end < len(t) and np.any(np.abs(other.stops[:, 0] - t[end - 1]) < SAME_TIME):
            end += 1  # where a stop begins shows only in what follows
        self.tracker.update(sensors, t[done:end])
        return len(self.tracker.window) >= len(t)
