"""What is looked for beside the keyframes as a drive goes on: where the vehicle stands, where its odometer is wrong.

Looks are made now and then (the rows they see overlap), between one keyframe and the next where there is time, and
take effect at the next keyframe.
"""

from __future__ import annotations

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.detectors import stops
from graphnav.detectors.base import merge_spans
from graphnav.online.sensors import Sensors
from graphnav.recording.odometer import ReadingStatistics, faults

CONTEXT = 30.0  # s of rows before a keyframe that its constraints may look at
SURE = 1.0  # s before now that the detectors answer for: the end of a stop shows only when it is over
_EVERY = 2.0  # s between looks of the detectors
_LOOK = 30.0  # s that they see
_SEEN = 25.0  # s of these that they answer for; the first few lack what was before
_REVIEW = 10.0  # s between looks at what was answered before, while nothing stands
_CLEARLY = 0.1  # of a figure
_WHEELS, _WHEELS_LOOK = 10.0, 40.0  # s between looks at the odometer, and what they see


class Stops:
    """Where the vehicle stands, as far as the detectors can tell by now."""

    def __init__(self) -> None:
        self.spans: Array = np.empty((0, 2))  # s, between keyframes
        self.looked = -np.inf  # s, up to where
        self._reviewed = -np.inf
        self._seen: tuple[float, Array | None] | None = None  # since when, and what; not yet in `spans`

    @property
    def news(self) -> bool:
        """Whether something was seen that is not taken over yet."""
        return self._seen is not None

    def due(self, now: float) -> bool:
        """Whether it is time to look again."""
        return self._seen is None and now - self.looked >= _EVERY - SAME_TIME

    def look(self, sensors: Sensors, settings: Settings, now: float, head: float) -> None:
        """Ask the detectors; the first time about everything since `head`."""
        whole = not np.isfinite(self.looked)
        since, answered = (head, -np.inf) if whole else (now - _SEEN, self.looked - SURE)
        if now - self._reviewed >= _REVIEW - SAME_TIME:
            self._reviewed, answered = now, since
        self.looked = now
        recording = sensors.recording(-np.inf if whole else now - _LOOK, now, every=True)
        self._seen = since, stops(recording, settings, since, now - SURE, self.spans, answered)

    def replace(self, spans: Array, edges: Array) -> None:
        """Know other spans, cut to keyframes `edges`."""
        self.spans, self._seen = np.empty((0, 2)), (-np.inf, spans)
        self.take(edges)

    def add(self, spans: Array) -> None:
        """Know more spans, between keyframes already."""
        self.spans = merge_spans(np.concatenate([self.spans, spans]), gap=SAME_TIME)

    def forget(self, t: float) -> None:
        """Those that ended before a time do not matter any more."""
        self.spans = self.spans[self.spans[:, 1] > t]

    def take(self, edges: Array) -> float:
        """Take over what was seen, cut to keyframes; the start of the first interval between `edges` that changes.

        `edges` are the keyframes, in any order.
        """
        assert self._seen is not None
        (since, found), self._seen = self._seen, None
        if found is None or (not len(found) and not len(self.spans)):
            return np.inf
        edges = np.unique(edges)
        spans = merge_spans(np.concatenate([clip_spans(self.spans, -np.inf, since), found]), gap=SAME_TIME)
        spans = spans[spans[:, 1] >= edges[0] - SAME_TIME] if len(spans) else spans
        aligned = []
        for begin, end in spans:
            inside = edges[(edges >= begin - SAME_TIME) & (edges <= end + SAME_TIME)]
            if len(inside):
                first = begin if begin < edges[0] else float(inside[0])
                if inside[-1] > first:
                    aligned.append((first, float(inside[-1])))
        before, self.spans = self.spans, np.array(aligned).reshape(-1, 2)
        middle = 0.5 * (edges[1:] + edges[:-1])
        changed = np.flatnonzero(_within(middle, before) != _within(middle, self.spans))
        return float(edges[changed[0]]) if len(changed) else np.inf


class Readings:
    """What an odometer's readings are worth, and where they are wrong, as far as can be told by now."""

    def __init__(self) -> None:
        self.wrong: Array = np.empty((0, 2))  # s
        self.figures: ReadingStatistics | None = None
        self.revised = False  # whether the figures have become clearly others
        self._looked = -np.inf  # s
        self._moving, self._told, self._counted = 0, 0, -np.inf  # readings in motion, by when told, and up to when
        self._lag: float | None = None  # s by which it is late, as far as the IMU can tell

    @property
    def looked(self) -> bool:
        """Whether ever."""
        return bool(np.isfinite(self._looked))

    def due(self, now: float) -> bool:
        """Whether it is time to look again."""
        return now - self._looked >= _WHEELS - SAME_TIME

    def look(self, sensors: Sensors, now: float) -> float:
        """Look for wrong readings; returns the start of the first that was not known."""
        whole, self._looked = not self.looked, now
        recording = sensors.recording(-np.inf if whole else now - _WHEELS_LOOK, now)
        if recording.odometer is None:
            return np.inf
        lag, o = self._lag, recording.odometer
        self._moving += int(np.count_nonzero(o.speed[o.t > self._counted]))
        self._counted = float(o.t[-1])
        # ever more seldom, as more readings tell little new; while it stands they tell nothing
        if self.figures is None or self._moving >= 2 * max(self._told, 1):
            every = sensors.recording().odometer
            assert every is not None
            before, self.figures, self._told, lag = self.figures, ReadingStatistics.of(every), self._moving, None
            self.revised |= before is not None and _other(before.sigmas(o), self.figures.sigmas(o))
        seen, known = faults(recording.odometer, recording.imu, self.figures, lag), self.wrong
        found, self._lag = seen.spans, seen.lag
        since = float(recording.odometer.t[0]) + (0.0 if whole else 5.0)
        old = known[(known[:, 0] < since) & (known[:, 1] > since - CONTEXT - _WHEELS_LOOK)]
        self.wrong = np.concatenate([old, found[found[:, 0] >= since]])
        new = self.wrong[~np.isin(self.wrong[:, 0], known[:, 0])]
        return float(new[0, 0]) if len(new) else np.inf


def _other(before: tuple[float, ...], now: tuple[float, ...]) -> bool:
    """Whether sigmas are clearly others."""
    return any(abs(a - b) > _CLEARLY * max(a, b) for a, b in zip(before, now, strict=True))


def clip_spans(spans: Array, begin: float, end: float) -> Array:
    """The parts of spans between two times."""
    cut = np.clip(spans, begin, end)
    return np.asarray(cut[cut[:, 1] > cut[:, 0]])


def _within(t: Array, spans: Array) -> Array:
    """Which times lie in the spans (M, 2)."""
    return np.asarray(((t[:, None] >= spans[:, 0]) & (t[:, None] <= spans[:, 1])).any(axis=1))
