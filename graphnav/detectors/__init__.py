"""Where the vehicle stands. `detect` runs every detector on a recording and fuses their answers."""

from __future__ import annotations

import numpy as np

from graphnav.config import Settings
from graphnav.detectors.base import NONE, Detection, Detections
from graphnav.detectors.fusion import fuse
from graphnav.detectors.glrt import glrt_statistic
from graphnav.detectors.motion import moving, speeds
from graphnav.detectors.sway import detect_sway, scale
from graphnav.detectors.windows import blocks, low_pass
from graphnav.findings import period_of
from graphnav.recording import Recording

__all__ = ["Detection", "Detections", "detect", "glrt_statistic"]

_SHORTEST = 3.0  # s, of a recording in which anything can be told


def detect(recording: Recording, settings: Settings | None = None) -> Detections:
    """Stationary intervals and the statistics they come from; never fails, and says what could not be done."""
    d = (settings or Settings()).detectors
    period = period_of(recording.imu.t)
    if not recording.duration >= _SHORTEST or not period > 0.0:
        return Detections(NONE, (), (f"no detection: the recording is shorter than {_SHORTEST:g} s",))
    b = blocks(recording.imu, period)
    low = low_pass(b)
    if not len(low.t):
        return Detections(NONE, (), ("no detection: the IMU has too few rows",))
    found = speeds(recording, d.fusion)
    certain = moving(found)
    sway = detect_sway(low, recording.imu.noise, d.sway, certain)
    s = scale(low, recording.imu.noise, d.sway)
    spans, filled, notes = fuse(b, sway, s, found, certain, d.fusion)
    mask = np.zeros(len(sway.t), dtype=bool)
    for start, end in spans:
        mask |= (sway.t >= start) & (sway.t <= end)
    fused = Detection("fused", sway.t, sway.statistic, sway.threshold, mask, spans, notes, {"bridged": filled})
    return Detections(spans, (sway, fused), notes)
