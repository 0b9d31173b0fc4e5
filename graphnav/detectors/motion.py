"""Certain motion by odometer and GNSS: spans in which a speed exceeds its own error.

A zero of an odometer is no evidence (unplugged, or slower than its first pulse), a fix can be wrong for a few epochs,
and both may be late. So single epochs never count, and only motion is concluded from them, never rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from graphnav.config.detectors import FusionSettings
from graphnav.core.rotation import Array
from graphnav.detectors.base import NONE, find_spans, merge_spans, unite
from graphnav.detectors.windows import compute_share
from graphnav.recording import Gnss, Odometer, Recording
from graphnav.recording.checks.tracks import compute_local_positions

_SIGMAS = 3.0
_SIGMAS_APART = 6.0  # for differences of positions: their errors wander by more than receivers state
_MEDIAN = 3  # epochs of the running median
_LONGEST_EPOCH_GAP = 2.0  # s, longest gap between epochs within a span of motion
_DIFFERENCE_SPAN = 4.0  # s between the positions that are differenced


@dataclass(frozen=True)
class Speeds:
    """Speeds from one sensor, with the limit above which they mean motion."""

    t: Array  # (K,) s
    v: Array  # (K, 1) m/s forward, or (K, 2) horizontal
    limit: Array  # (K,) m/s
    late: float = 0.0  # s, by which the stamps may be late
    half: float = 0.0  # s on either side of t over which v is the mean
    silent_at_rest: bool = False  # whether it reads zero when it is unplugged

    @cached_property
    def speed(self) -> Array:
        """(K,) m/s, magnitude."""
        return np.sqrt(np.einsum("kj,kj->k", self.v, self.v))

    def measure_speed(self, span: Array) -> float:
        """Speed in a span in which nothing changes, m/s: 0 if it is within the error, NaN without epochs.

        The velocity is constant in such a span, so the median over the epochs counts, and a wander within the stated
        error is not motion.
        """
        # the first readings of a late sensor belong to the time before
        first = min(span[0] + self.late, 0.5 * (span[0] + span[1]) + self.late)
        there = (self.t - self.half >= first) & (self.t + self.half <= span[1] + self.late)
        if there.sum() < _MEDIAN:
            return float("nan")
        v = self.v[there]
        middle = compute_share(v, 0.5)
        wander = float(np.linalg.norm(compute_share(np.abs(v - middle), 0.5))) / 0.6745
        speed = float(np.linalg.norm(middle))
        if speed > max(float(compute_share(self.limit[there], 0.5)), 2.0 * wander):
            return speed
        return float("nan") if self.silent_at_rest else 0.0


def collect_speeds(recording: Recording, settings: FusionSettings) -> list[Speeds]:
    """Speeds of every sensor that measures one."""
    found = []
    if recording.odometer is not None and len(recording.odometer.t) > 2:
        found.append(_read_odometer(recording.odometer, settings))
    if recording.gnss is not None and len(recording.gnss.t) > 2:
        found += _list_fix_speeds(recording.gnss, settings)
    return [s for s in found if len(s.t) >= _MEDIAN]


def find_moving(found: list[Speeds]) -> Array:
    """(M, 2) s, spans of certain motion, shortened at the ends by possible delays and averaging times."""
    parts = []
    for s in found:
        excess = s.speed - s.limit
        k = np.arange(len(excess))
        fast = take_median(excess[np.maximum(k - 1, 0)], excess, excess[np.minimum(k + 1, len(k) - 1)]) > 0.0
        breaks = np.diff(s.t) > _LONGEST_EPOCH_GAP
        spans = [find_spans(fast[a:b], s.t[a:b]) for a, b in _split_pieces(breaks)]
        one = unite([p for p in spans if len(p)]) if any(len(p) for p in spans) else NONE
        if len(one):
            one = one + np.array([s.half, -s.half - s.late])
            parts.append(one[one[:, 1] > one[:, 0]])
    return merge_spans(np.concatenate(parts)) if parts else NONE


def take_median(a: Array, b: Array, c: Array) -> Array:
    """Median of three, element by element."""
    return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))


def _split_pieces(breaks: np.ndarray) -> list[tuple[int, int]]:
    """[start, end) between the breaks."""
    ends = (np.flatnonzero(breaks) + 1).tolist()
    return list(zip([0, *ends], [*ends, len(breaks) + 1], strict=True))


def find_smallest_step(values: Array) -> float:
    """Smallest step between the values of a quantised sensor; a tiny number where there is none."""
    steps = np.diff(np.unique(np.abs(values)))
    steps = steps[steps > 1e-6]
    return float(np.quantile(steps, 0.05)) if len(steps) else 0.0


def _read_odometer(o: Odometer, settings: FusionSettings) -> Speeds:
    # one pulse per period may be jitter of a wheel that stands on a tooth
    limit = max(settings.max_speed, 1.5 * find_smallest_step(o.speed))
    return Speeds(o.t, o.speed[:, None], np.full(len(o.t), limit), settings.odometer_delay)


def _list_fix_speeds(gnss: Gnss, settings: FusionSettings) -> list[Speeds]:
    found = []
    if gnss.v is not None:
        there = np.isfinite(gnss.v[:, :2]).all(axis=1)
        v = gnss.v[there]
        sigma = np.full(len(v), 0.3)
        if gnss.sd_v is not None:
            stated = gnss.sd_v[there, :2].max(axis=1)
            sigma = np.where(np.isfinite(stated), stated, sigma)
        found.append(Speeds(gnss.velocity_t[there], v[:, :2], np.maximum(settings.max_speed, _SIGMAS * sigma)))
    there = np.isfinite(gnss.llh).all(axis=1)
    if there.sum() > _MEDIAN and not (found and len(found[0].t) > 0.5 * there.sum()):
        t, p, sd = gnss.t[there], compute_local_positions(gnss)[there, :2], gnss.sd[there, :2].max(axis=1)
        later = np.searchsorted(t, t + _DIFFERENCE_SPAN)
        k = np.flatnonzero(later < len(t))
        later = later[k]
        k, later = k[t[later] - t[k] < 2.0 * _DIFFERENCE_SPAN], later[t[later] - t[k] < 2.0 * _DIFFERENCE_SPAN]
        if len(k):
            apart = t[later] - t[k]
            v = (p[later] - p[k]) / apart[:, None]
            limit = _SIGMAS_APART * np.hypot(sd[later], sd[k]) / apart
            middle = 0.5 * (t[later] + t[k])
            found.append(Speeds(middle, v, np.maximum(settings.max_speed, limit), half=0.5 * _DIFFERENCE_SPAN))
    return found
