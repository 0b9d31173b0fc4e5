"""What odometer and GNSS say about motion: spans in which a speed exceeds what its own error can explain.

An odometer that reads zero proves nothing (unplugged, or slower than its first pulse), a fix can lie for a few
epochs, and both may be late. So single epochs never count, and only motion is concluded from them, never rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.config import FusionSettings
from graphnav.crosschecks import local_positions
from graphnav.detectors.base import NONE, merged, spans_of, union
from graphnav.recording import Gnss, Odometer, Recording
from graphnav.rotation import Array

_SIGMAS = 3.0
_MEDIAN = 3  # epochs over which the median is taken
_LONGEST = 2.0  # s between epochs that a span of motion leads across
_BASE = 4.0  # s over which positions are compared


@dataclass(frozen=True)
class Speeds:
    """Speeds with what they must exceed to mean motion, from one sensor."""

    t: Array  # (K,) s
    speed: Array  # (K,) m/s
    limit: Array  # (K,) m/s
    late: float = 0.0  # s, by which the stamps may be late


def speeds(recording: Recording, settings: FusionSettings) -> list[Speeds]:
    """Speeds of every sensor that knows any."""
    found = []
    if recording.odometer is not None and len(recording.odometer.t) > 2:
        found.append(_odometer(recording.odometer, settings))
    if recording.gnss is not None and len(recording.gnss.t) > 2:
        found += _gnss(recording.gnss, settings)
    return [s for s in found if len(s.t) >= _MEDIAN]


def moving(found: list[Speeds]) -> Array:
    """(M, 2) s, spans of certain motion; at their late ends only what is left after the stamps' possible delay."""
    parts = []
    for s in found:
        excess = s.speed - s.limit
        k = np.arange(len(excess))
        three = excess[np.clip(k[:, None] + [-1, 0, 1], 0, len(k) - 1)]
        fast = np.median(three, axis=1) > 0.0
        breaks = np.diff(s.t) > _LONGEST
        spans = [spans_of(fast[a:b], s.t[a:b]) for a, b in _pieces(breaks)]
        one = union([p for p in spans if len(p)]) if any(len(p) for p in spans) else NONE
        if len(one):
            one = np.stack([one[:, 0], one[:, 1] - s.late], -1)
            parts.append(one[one[:, 1] > one[:, 0]])
    return merged(np.concatenate(parts)) if parts else NONE


def _pieces(breaks: np.ndarray) -> list[tuple[int, int]]:
    """[start, end) between the breaks."""
    ends = np.flatnonzero(breaks) + 1
    return list(zip(np.r_[0, ends].tolist(), np.r_[ends, len(breaks) + 1].tolist(), strict=True))


def quantum(values: Array) -> float:
    """Smallest step between the values of a quantised sensor; tiny where it is none."""
    steps = np.diff(np.unique(np.abs(values)))
    steps = steps[steps > 1e-6]
    return float(np.quantile(steps, 0.05)) if len(steps) else 0.0


def _odometer(o: Odometer, settings: FusionSettings) -> Speeds:
    # one pulse in a period may be the jitter of a wheel that stands on a tooth
    limit = max(settings.max_speed, 1.5 * quantum(o.speed))
    return Speeds(o.t, np.abs(o.speed), np.full(len(o.t), limit), settings.odometer_delay)


def _gnss(gnss: Gnss, settings: FusionSettings) -> list[Speeds]:
    found = []
    if gnss.v is not None:
        there = np.isfinite(gnss.v[:, :2]).all(axis=1)
        v = gnss.v[there]
        sigma = np.full(len(v), 0.3)
        if gnss.sd_v is not None:
            stated = gnss.sd_v[there, :2].max(axis=1)
            sigma = np.where(np.isfinite(stated), stated, sigma)
        speed = np.hypot(v[:, 0], v[:, 1])
        found.append(Speeds(gnss.t[there], speed, np.maximum(settings.max_speed, _SIGMAS * sigma)))
    there = np.isfinite(gnss.llh).all(axis=1)
    if there.sum() > _MEDIAN and not (found and len(found[0].t) > 0.5 * there.sum()):
        t, p, sd = gnss.t[there], local_positions(gnss)[there, :2], gnss.sd[there, :2].max(axis=1)
        later = np.searchsorted(t, t + _BASE)
        k = np.flatnonzero(later < len(t))
        later = later[k]
        k, later = k[t[later] - t[k] < 2.0 * _BASE], later[t[later] - t[k] < 2.0 * _BASE]
        if len(k):
            apart = t[later] - t[k]
            speed = np.linalg.norm(p[later] - p[k], axis=1) / apart
            limit = _SIGMAS * np.hypot(sd[later], sd[k]) / apart
            middle = 0.5 * (t[later] + t[k])
            found.append(Speeds(middle, speed, np.maximum(settings.max_speed, limit)))
    return found
