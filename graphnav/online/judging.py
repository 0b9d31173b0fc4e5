"""Estimating the noise model again by more rows, beside the drive: no keyframe waits for it.

The estimate itself (`graphnav.noise`), which filters and smooths some minutes a dozen times, is made in a thread. Its
answer is used at the first row after a fixed time of the drive, so that what comes out does not depend on how long it
took. A second tracker then goes through what has not settled with the new model, some keyframes at a row, and takes the
first one's place when it has caught up.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphnav import faults
from graphnav.alignment import Alignment
from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.detectors import detect
from graphnav.earth import LocalFrame
from graphnav.errors import EstimationError
from graphnav.noise.apply import with_noise
from graphnav.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.noise.exclusion import exclude
from graphnav.noise.model import NoiseModel
from graphnav.noise.words import describe
from graphnav.online.sensors import Sensors
from graphnav.online.tracker import Tracker
from graphnav.problem import Problem, pose
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solution import Fault

_PORTION = 4  # keyframes gone through again at a row


@dataclass(frozen=True)
class Answer:
    """What some rows say of the sensors."""

    noise: NoiseModel
    notes: tuple[str, ...]
    stationary: Array  # (M, 2) s
    excluded: tuple[Fault, ...]  # spans that the noise model leaves out


class Judgement:
    """The noise model that the rows of a recording tell.

    Parameters
    ----------
    times : (K,) s, keyframes, the first at the start of the recording: weights of rows hold at these.
    due : s, when the answer is to be used.
    """

    def __init__(
        self, recording: Recording, settings: Settings, frame: LocalFrame, found: Alignment, times: Array, due: float
    ) -> None:
        self.found, self.due, self.until = found, due, float(times[-1])
        self._asked = recording, settings, frame, times
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
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        recording, settings, frame, times = self._asked
        start = self.found
        try:
            stationary = detect(recording, settings).stationary
            base = pose(
                recording, settings, frame, start.state, start.sigma, stationary, times, parts_of_noise=True
            )  # fmt: skip
            noise = _estimated(base, start.until, settings).noise
            used = with_noise(base, noise)
            self._answer = Answer(noise, describe(noise, used), stationary, faults.spans(used))
        except (EstimationError, np.linalg.LinAlgError) as error:
            self._answer = EstimationError(str(error))
        except BaseException as error:  # said by whoever asks
            self._answer = error

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_thread", "_answer")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()


def _estimated(base: Problem, opening: float | None, settings: Settings) -> NoiseEstimate:
    """The noise model, with spans of wrong measurements left out where evidence says so: as for a recording."""
    found = estimate_noise(base, opening)
    if settings.gnss.faults == "off":
        return found
    noise, _ = exclude(base, found)
    if not noise.excluded:
        return found
    return estimate_noise(base, opening, noise, (found.points, with_noise(base, found.noise)))


class Again:
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
