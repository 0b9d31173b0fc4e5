"""Where the vehicle stands, or a foot is on the floor.

`detect` runs every detector on a recording and fuses their answers.
"""

from __future__ import annotations

import numpy as np

from graphnav.config import Settings
from graphnav.detectors.base import NONE, Detection, Detections, inside, longer_than, spans_of, without
from graphnav.detectors.fft import detect_fft
from graphnav.detectors.fusion import candidates, fuse
from graphnav.detectors.glrt import detect_windows, glrt_statistic
from graphnav.detectors.motion import moving, speeds
from graphnav.detectors.stance import detect_stances
from graphnav.detectors.sway import detect_sway
from graphnav.detectors.windows import blocks, low_pass
from graphnav.earth import gravity
from graphnav.findings import period_of
from graphnav.recording import Recording
from graphnav.rotation import Array

__all__ = ["Detection", "Detections", "detect", "glrt_statistic", "stops"]

_SHORTEST = 3.0  # s, of a recording in which anything can be told
_CLEARLY = 10.0  # times its threshold a statistic is where the vehicle clearly moves
_STANDARD_GRAVITY = 9.80665


def detect(recording: Recording, settings: Settings | None = None) -> Detections:
    """Stationary intervals and the statistics they come from; never fails, and says what could not be done."""
    d = (settings or Settings()).detectors
    imu, period = recording.imu, period_of(recording.imu.t)
    if recording.platform == "foot" and period > 0.0:
        return detect_stances(imu, period, d.stance)
    if not recording.duration >= _SHORTEST or not period > 0.0:
        return Detections(NONE, (), (f"no detection: the recording is shorter than {_SHORTEST:g} s",))
    b = blocks(imu, period)
    low = low_pass(b)
    if not len(low.t):
        return Detections(NONE, (), (f"no detection: an IMU at {1.0 / period:.3g} Hz is too slow",))
    known = speeds(recording, d.fusion)
    certain = moving(known)
    sway, s = detect_sway(low, imu.noise, d.sway, certain)
    still, certain, notes = candidates(b, sway, s, known, certain)
    in_motion = spans_of(sway.statistic > _CLEARLY * sway.threshold, sway.t, 0.5 * d.sway.window)
    notes = (*sway.notes, *notes)
    found = [sway, *detect_windows(b, imu.noise, d.glrt, still, in_motion, _gravity(recording))]
    idling = NONE
    if recording.platform == "vehicle":
        found.append(detect_fft(imu, period, d.fft, still, known))
        notes += found[-1].notes
        idling = found[-1].intervals
    spans, disturbed = fuse(b, still, idling, certain, d.fusion)
    mask = inside(sway.t, spans)
    found.append(
        Detection("fused", sway.t, sway.statistic, sway.threshold, mask, spans, notes, {"disturbed": disturbed})
    )
    return Detections(spans, tuple(found), notes)


def stops(
    recording: Recording, settings: Settings, since: float, until: float, before: Array, new: float
) -> Array | None:
    """What `detect` calls stationary of a vehicle between two times, (M, 2) s, and nothing else.

    So it need not look at spectra where nothing is still. None where odometer or GNSS are certain of motion from
    the time `new` on, and not certain of any in the stops (K, 2) found `before`: then there is nothing to be said that
    was not said then. Where positions alone tell speeds, nothing is said of the seconds over which they were last
    compared, if they show motion: a smooth drive would pass for a stop there.
    """
    d, imu = settings.detectors, recording.imu
    period = period_of(imu.t)
    if not recording.duration >= _SHORTEST or not period > 0.0:
        return NONE
    known = speeds(recording, d.fusion)
    certain = moving(known)
    left = longer_than(without(np.array([[recording.start, recording.end]]), certain), d.fusion.min_duration)
    before = np.clip(before, since, until)
    doubted = any(((certain[:, 0] < b) & (certain[:, 1] > a)).any() for a, b in before if b > a)
    if not doubted and not ((left[:, 0] < until) & (left[:, 1] > new)).any():
        return None
    for one in known:
        if one.half > 0.0 and one.speed[-1] > one.limit[-1]:
            until = max(min(until, float(one.t[-1]) - one.half), since)
    b = blocks(imu, period)
    low = low_pass(b)
    if not len(low.t):
        return NONE
    sway, s = detect_sway(low, imu.noise, d.sway, certain)
    still, certain, _ = candidates(b, sway, s, known, certain)
    if not len(still):
        return NONE
    idling = NONE
    if recording.platform == "vehicle":
        idling = detect_fft(imu, period, d.fft, still, known, shown=False).intervals
    spans = np.clip(fuse(b, still, idling, certain, d.fusion)[0], since, until)
    return np.asarray(spans[spans[:, 1] > spans[:, 0]])


def _gravity(recording: Recording) -> float:
    """Gravity at the first fix, m/s^2."""
    if recording.gnss is not None:
        there = np.flatnonzero(np.isfinite(recording.gnss.llh).all(axis=1))
        if len(there):
            return float(gravity(*recording.gnss.llh[there[0], [0, 2]]))
    return _STANDARD_GRAVITY
