"""Keyframes of a running walk, step by step, and changes of earlier ones that a step brings."""

from __future__ import annotations

import numpy as np

from graphnav.config import Settings
from graphnav.constraints import list_kinds
from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.detectors import detect
from graphnav.estimation.problem import choose_keyframes, limit_to_samples
from graphnav.imu.clipping import find_first_whole_peak, find_highest
from graphnav.imu.samples import bridge_gaps
from graphnav.online.looks import SURE, Stops, clip_spans
from graphnav.online.sensors import Sensors

_WALK, _WALK_LEAST = 30.0, 4.0  # s of a walk that its detector uses, and the least
_DETECTION_INTERVAL = 0.05  # s between detections of steps that are worth keyframes
_EDGE_TOLERANCE = 0.1  # s by which the end of a stance may move once later rows are known: several periods
_LONGEST_STANCE = 3.0  # s; a longer stance is standing, and need not be over


class StepCutter:
    """Progress of cutting a walk into steps, and the highest readings of its IMU."""

    def __init__(self) -> None:
        self.highest: Array | None = None  # as returned by `graphnav.imu.clipping.find_highest`
        self._seen = -np.inf  # s, up to where that is known
        self.pieces: float | None = None  # s, beginning of a standing that continues, of which keyframes were made
        self.over: float | None = None  # s, beginning of one that is over: its keyframes are to be made again

    def list_until(
        self, sensors: Sensors, settings: Settings, standing: Stops, T: float, limit: float, last: bool
    ) -> Array:
        """Keyframes after T, starting with T: up to the newest stance that has begun or ended, whose spans are kept.

        The phase of a moment is known only in complete stances and swings.
        """
        none, self.over = np.empty(0), None
        whole = not np.isfinite(standing.looked)
        recording = sensors.make_recording(-np.inf if whole else min(T, limit) - _WALK, limit + SURE)
        if recording.duration < _WALK_LEAST:
            return none
        rows = recording.imu.t  # keyframes are placed where the stances will begin and end
        limit = float(rows[max(int(np.searchsorted(rows, limit + SAME_TIME)) - 1, 0)])
        spans = clip_spans(
            limit_to_samples(detect(recording, settings, T - _EDGE_TOLERANCE).stationary, recording), T, limit
        )
        ongoing = bool(len(spans)) and spans[-1, 1] >= limit - SAME_TIME
        if not last and len(spans):
            if ongoing and limit - spans[-1, 0] < _LONGEST_STANCE:
                limit, spans, ongoing = float(spans[-1, 0]), spans[:-1], False
            elif not ongoing:
                limit = float(spans[-1, 1])
        elif not last and limit - T < _LONGEST_STANCE:
            return none
        if limit - T <= _DETECTION_INTERVAL:
            return none
        standing.looked = limit
        standing.add(spans)
        # a swing is defined by the stance before it
        before = standing.spans[standing.spans[:, 0] <= T]
        begin = max([T - _WALK, *before[:, 0].tolist()]) if len(before) else T
        pieces, self.pieces = self.pieces, float(standing.spans[-1, 0]) if ongoing and not last else None
        self.over = pieces if pieces != self.pieces else None
        part = sensors.make_recording(min(begin, T), limit)
        around = clip_spans(standing.spans, part.start, limit)
        epochs = [cls.epochs(part, settings, around) for cls in list_kinds(part)]
        return choose_keyframes(T, limit, np.concatenate([*epochs, none]), settings.keyframes.rate)

    def read_again(self, t: float) -> None:
        """A row arrived late, at a time (s): its readings count too."""
        self._seen = min(self._seen, float(np.nextafter(t, -np.inf)))

    def find_change(self, sensors: Sensors, head: float) -> float:
        """From when on intervals after `head` would now be integrated differently, s.

        A peak is clipped at the end of the IMU's range, which is known only from later readings.
        """
        now, fresh = self.highest, sensors.make_recording(np.nextafter(self._seen, np.inf)).imu
        if len(fresh.t):
            read, self._seen = find_highest(fresh), float(fresh.t[-1])
            now = read if now is None else np.maximum(now, read)
        before, self.highest = self.highest, now
        if before is None or now is None or not np.any(now > before):
            return np.inf
        imu = sensors.make_recording(head).imu
        return find_first_whole_peak(bridge_gaps(imu), imu.R_bs, before, now) if len(imu.t) > 2 else np.inf
