"""Judging the sensors again by more rows, beside the drive: no keyframe waits for it.

The judgement itself, which filters some minutes twice or more, is made in a thread. Its answer is used at the first
row after a fixed time of the drive, so that what comes out does not depend on how long it took. A second tracker
then goes through what has not settled with the new figures, some keyframes at a row, and takes the first one's place
when it has caught up.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from graphnav.alignment import Alignment
from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.detectors import detect
from graphnav.earth import LocalFrame
from graphnav.errors import EstimationError
from graphnav.judgement import judged
from graphnav.online.sensors import Sensors
from graphnav.online.tracker import Tracker
from graphnav.recording import Recording
from graphnav.rotation import Array

_PORTION = 4  # keyframes gone through again at a row

Answer = tuple[Recording, Settings, tuple[str, ...], Array]  # recording, settings, notes, stops


class Judgement:
    """What the sensors are worth by the rows of a recording.

    Parameters
    ----------
    due : s, when the answer is to be used.
    overruled : most fixes contradict the smoother.
    """

    def __init__(
        self,
        recording: Recording,
        settings: Settings,
        frame: LocalFrame,
        found: Alignment,
        due: float,
        overruled: bool = False,
    ) -> None:
        self.found, self.due, self.until = found, due, recording.end
        self._asked = recording, settings, frame, overruled
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
        recording, settings, frame, overruled = self._asked
        try:
            stationary = detect(recording, settings).stationary
            how = judged(recording, settings, frame, self.found, stationary, witnesses=overruled)
            self._answer = *how, stationary
        except (EstimationError, np.linalg.LinAlgError) as error:
            self._answer = EstimationError(str(error))
        except BaseException as error:  # said by whoever asks
            self._answer = error

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_thread", "_answer")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()


class Again:
    """A tracker that goes through the keyframes of another, which goes on meanwhile.

    Parameters
    ----------
    tracker : without keyframes.
    setup : of the sensors, as it sees them.
    """

    def __init__(self, tracker: Tracker, setup: Recording) -> None:
        self.tracker, self.setup = tracker, setup

    def step(self, sensors: Sensors, other: Tracker) -> bool:
        """Go through a few more keyframes of the other; True once it has caught up."""
        t, done = other.window.t, len(self.tracker.window)
        end = min(done + _PORTION, len(t))
        while end < len(t) and np.any(np.abs(other.stops[:, 0] - t[end - 1]) < SAME_TIME):
            end += 1  # where a stop begins shows only in what follows
        used, sensors.setup = sensors.setup, self.setup
        try:
            self.tracker.update(sensors, t[done:end])
        finally:
            sensors.setup = used
        return len(self.tracker.window) >= len(t)
