"""Detection beside the keyframes of a running drive: of stops, and of odometer faults.

Detection runs at intervals (the rows it uses overlap), between keyframes when there is time, and takes effect at the
next keyframe.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.detectors import find_stops
from graphnav.detectors.base import merge_spans, subtract_spans
from graphnav.online.sensors import Sensors
from graphnav.recording.odometer import ReadingStatistics, find_wrong_readings

CONTEXT = 30.0  # s of rows before a keyframe that its constraints may use
SURE = 1.0  # s before now up to which detection is reliable: the end of a stop is known only afterwards
_DETECTOR_INTERVAL = 2.0  # s between runs of the detectors
_DETECTOR_SPAN = 30.0  # s of rows that they use
_ANSWERED_SPAN = 25.0  # s of these for which they answer; the first few lack the rows before
_REVIEW = 10.0  # s between reviews of earlier answers, while nothing is stationary
_CLEAR_CHANGE = 0.1  # relative change of a figure
_WHEELS, _WHEELS_LOOK = 10.0, 40.0  # s between checks of the odometer, and s of rows that they use


class Stops:
    """Stops of the vehicle as far as the detectors have found them."""

    def __init__(self, false: Sequence[tuple[float, float]] = ()) -> None:
        self.spans: Array = np.empty((0, 2))  # s, between keyframes
        # s, in order, spans in which the platform moves, whatever the detectors say
        self._false = np.array(false).reshape(-1, 2)
        self.looked = -np.inf  # s, up to where
        self._reviewed = -np.inf
        self._seen: tuple[float, Array | None] | None = None  # since when, and which; not yet in `spans`

    @property
    def news(self) -> bool:
        """Whether stops were found that have not been taken over yet."""
        return self._seen is not None

    def is_due(self, now: float) -> bool:
        """Whether the next run is due."""
        return self._seen is None and now - self.looked >= _DETECTOR_INTERVAL - SAME_TIME

    def look(self, sensors: Sensors, settings: Settings, now: float, head: float) -> None:
        """Run the detectors; the first time over everything since `head`."""
        whole = not np.isfinite(self.looked)
        since, answered = (head, -np.inf) if whole else (now - _ANSWERED_SPAN, self.looked - SURE)
        if now - self._reviewed >= _REVIEW - SAME_TIME:
            self._reviewed, answered = now, since
        self.looked = now
        recording = sensors.make_recording(-np.inf if whole else now - _DETECTOR_SPAN, now, every=True)
        self._seen = since, find_stops(recording, settings, since, now - SURE, self.spans, answered)

    def without(self, false: Sequence[tuple[float, float]]) -> Stops:
        """The same with other false stops, in order and apart."""
        other = copy.copy(self)
        other._false = np.array(false).reshape(-1, 2)
        other.spans = subtract_spans(self.spans, other._false)
        return other

    def replace(self, spans: Array, edges: Array) -> None:
        """Replace the spans, cut to keyframes `edges`."""
        self.spans, self._seen = np.empty((0, 2)), (-np.inf, spans)
        self.take(edges)

    def add(self, spans: Array) -> None:
        """Add spans that lie between keyframes already."""
        self.spans = merge_spans(np.concatenate([self.spans, spans]), gap=SAME_TIME)

    def forget(self, t: float) -> None:
        """Drop the stops that ended before a time."""
        self.spans = self.spans[self.spans[:, 1] > t]

    def take(self, edges: Array) -> float:
        """Take over the stops found, cut to keyframes; returns the start of the first interval between `edges` that
        changes.

        `edges` are the keyframes, in any order.
        """
        assert self._seen is not None
        (since, found), self._seen = self._seen, None
        if found is None or (not len(found) and not len(self.spans)):
            return np.inf
        edges, found = np.unique(edges), subtract_spans(found, self._false)
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
        changed = np.flatnonzero(_mask_within(middle, before) != _mask_within(middle, self.spans))
        return float(edges[changed[0]]) if len(changed) else np.inf


class Readings:
    """Quality of an odometer's readings, and spans in which they are wrong, as known so far."""

    def __init__(self) -> None:
        self.wrong: Array = np.empty((0, 2))  # s
        self.figures: ReadingStatistics | None = None
        self.revised = False  # whether the figures have changed clearly
        self._looked = -np.inf  # s
        self._moving, self._told, self._counted = 0, 0, -np.inf  # readings in motion, at the last check, and up to when
        self._lag: float | None = None  # s, delay of the readings as measured with the IMU

    @property
    def looked(self) -> bool:
        """Whether a check has been made."""
        return bool(np.isfinite(self._looked))

    def is_due(self, now: float) -> bool:
        """Whether the next check is due."""
        return now - self._looked >= _WHEELS - SAME_TIME

    def look(self, sensors: Sensors, now: float) -> float:
        """Check the readings; returns the start of the first wrong span that was not known before."""
        whole, self._looked = not self.looked, now
        recording = sensors.make_recording(-np.inf if whole else now - _WHEELS_LOOK, now)
        if recording.odometer is None:
            return np.inf
        lag, o = self._lag, recording.odometer
        self._moving += int(np.count_nonzero(o.speed[o.t > self._counted]))
        self._counted = float(o.t[-1])
        # at increasing intervals, as more readings add little; readings at rest add nothing
        if self.figures is None or self._moving >= 2 * max(self._told, 1):
            every = sensors.make_recording().odometer
            assert every is not None
            before, self.figures, self._told, lag = self.figures, ReadingStatistics.of(every), self._moving, None
            self.revised |= before is not None and _sigmas_differ(before.list_sigmas(o), self.figures.list_sigmas(o))
        seen, known = find_wrong_readings(recording.odometer, recording.imu, self.figures, lag), self.wrong
        found, self._lag = seen.spans, seen.lag
        since = float(recording.odometer.t[0]) + (0.0 if whole else 5.0)
        old = known[(known[:, 0] < since) & (known[:, 1] > since - CONTEXT - _WHEELS_LOOK)]
        self.wrong = np.concatenate([old, found[found[:, 0] >= since]])
        new = self.wrong[~np.isin(self.wrong[:, 0], known[:, 0])]
        return float(new[0, 0]) if len(new) else np.inf


def _sigmas_differ(before: tuple[float, ...], now: tuple[float, ...]) -> bool:
    """Whether sigmas differ clearly."""
    return any(abs(a - b) > _CLEAR_CHANGE * max(a, b) for a, b in zip(before, now, strict=True))


def clip_spans(spans: Array, begin: float, end: float) -> Array:
    """The parts of spans between two times."""
    cut = np.clip(spans, begin, end)
    return np.asarray(cut[cut[:, 1] > cut[:, 0]])


def _mask_within(t: Array, spans: Array) -> Array:
    """Which times lie in the spans (M, 2)."""
    return np.asarray(((t[:, None] >= spans[:, 0]) & (t[:, None] <= spans[:, 1])).any(axis=1))
