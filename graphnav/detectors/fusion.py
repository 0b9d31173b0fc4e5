"""From the detectors' answers to stationary intervals: candidates, vetoes, bridges and honest edges.

1. Stretches that the sway detector calls still are candidates; their ends are moved to where the low-passed force
   and rate leave what they are inside (never outwards past a disturbance).
2. Nothing changed in a candidate, so neither did its speed: if the speeds known inside say motion, all of it moves.
3. Two candidates are one stop if the force between them, integrated with the tilt the gyro saw, leads from rest to
   rest without reaching a speed in between: a passenger moved, not the vehicle.
"""

from __future__ import annotations

import numpy as np

from graphnav.config import FusionSettings
from graphnav.detectors.base import NONE, Detection, inside, longer_than, merged, without
from graphnav.detectors.motion import Speeds
from graphnav.detectors.sway import Scale
from graphnav.detectors.windows import Blocks, kernel, smooth
from graphnav.rotation import Array, exp

_LOOK = 3.0  # s about an end in which the edge is sought
_INNER = 1.5  # s inside a candidate that say what is normal in it
_SHARE = 0.5  # of the speeds inside a candidate that must exceed their limits to reject it as a whole
_G = 9.81


def edges(b: Blocks, spans: Array, s: Scale, threshold: float) -> Array:
    """The spans with their ends where the low-passed rows leave the mean that they have just inside."""
    h = kernel(b.period)
    out = []
    white = np.r_[np.full(3, 1.0 / s.force), np.full(3, 1.0 / s.rate)]
    for start, end in spans:
        middle = 0.5 * (start + end)
        first = _leave(b, h, white, middle, start, -1, threshold)
        last = _leave(b, h, white, middle, end, 1, threshold)
        if last > first:
            out.append((first, last))
    return np.array(out) if out else NONE


def _leave(b: Blocks, h: Array, white: Array, middle: float, end: float, way: int, threshold: float) -> float:
    """Last time, going from the middle towards one end, at which a row is still like those before it."""
    inner = min(_INNER, abs(end - middle))
    lo, hi = sorted((end + way * _LOOK, end - way * (inner + 1.0)))
    i, j = np.searchsorted(b.t, [lo, hi])
    i, j = max(i - len(h), 0), min(j + len(h), len(b.t))
    if j - i <= len(h) + 2:
        return middle
    rows = smooth(b.mean[i:j, :6], h) * white
    t = 0.5 * (b.t[i : j - len(h) + 1] + b.t[i + len(h) - 1 : j])
    rows, t = (rows, t) if way > 0 else (rows[::-1], t[::-1])
    normal = way * (t - end) < -0.5
    normal &= way * (t - end) > -0.5 - inner
    if normal.sum() < 5:
        normal = np.abs(t - middle) <= max(0.25, 2.0 * b.period)
        if not normal.any():
            return middle
    off = ((rows - np.median(rows[normal], axis=0)) ** 2).sum(axis=1) / 6.0
    # what is normal inside must not end the stop: twice its upper quantile, at least the detector's own limit
    limit = max(threshold, 2.0 * float(np.quantile(off[normal], 0.95)))
    begin = int(np.argmax(normal))
    beyond = np.flatnonzero(off[begin:] > limit)
    # a gap in the recording ends every interval
    torn = np.flatnonzero(np.abs(np.diff(t[begin:])) > 3.0 * b.period)
    stop = min([begin + int(x[0]) for x in (beyond, torn + 1) if len(x)], default=len(t))
    return float(t[max(stop - 1, begin)])


def veto(spans: Array, found: list[Speeds], certain: Array) -> tuple[Array, int]:
    """The spans without those, and without the parts, that odometer or GNSS say are motion; and how many went."""
    keep = []
    for span in spans:
        keep.append(not any(_moves(s, span) for s in found))
    kept = spans[np.array(keep, dtype=bool)] if len(spans) else NONE
    return without(kept, certain), len(spans) - len(kept)


def _moves(s: Speeds, span: Array) -> bool:
    """Whether the speeds of one sensor inside say motion: nothing changed in the span, so their median is its speed."""
    there = (s.t >= span[0]) & (s.t <= span[1] + s.late)
    if s.late:
        there &= s.t >= min(span[0] + s.late, 0.5 * (span[0] + span[1]) + s.late)
    if there.sum() < 3:
        return False
    return bool(np.median(s.speed[there] - s.limit[there]) > 0.0)


def bridged(b: Blocks, spans: Array, certain: Array, settings: FusionSettings) -> tuple[Array, Array]:
    """The spans with the disturbances between them filled where the vehicle did not move, and what was filled."""
    if len(spans) < 2:
        return spans, NONE
    out, filled = [spans[0]], []
    for span in spans[1:]:
        before = out[-1]
        gap = span[0] - before[1]
        moved = inside(np.array([0.5 * (before[1] + span[0])]), certain)[0] or (
            len(certain) and bool(((certain[:, 0] < span[0]) & (certain[:, 1] > before[1])).any())
        )
        if gap <= settings.bridge and not moved and _speed_between(b, before, span) < settings.bridge_speed:
            filled.append((before[1], span[0]))
            out[-1] = np.array([before[0], span[1]])
        else:
            out.append(span)
    return np.array(out), np.array(filled) if filled else NONE


def _speed_between(b: Blocks, before: Array, after: Array) -> float:
    """Largest horizontal speed, m/s, reached between two standstills; infinite where a gap lies between them.

    The tilt comes from the gyro, whose bias the standstills tell; what is left of the force after taking gravity
    away is made to lead from rest to rest, which takes off what the biases and a tilt could do.
    """
    i = int(np.searchsorted(b.t, max(before[0], before[1] - _INNER)))
    j = int(np.searchsorted(b.t, min(after[1], after[0] + _INNER)))
    first, last = (int(k) for k in np.searchsorted(b.t, [before[1], after[0]]))
    if first - i < 3 or j - last < 3 or not b.whole[i + 1 : j].all():
        return float("inf")
    force, rate = b.force[i:j], b.rate[i:j]
    n0, n1 = first - i, last - i
    level0, level1 = force[:n0].mean(axis=0), force[n1:].mean(axis=0)
    w0, w1 = rate[:n0].mean(axis=0), rate[n1:].mean(axis=0)
    # the mean of both: its error of a fraction of the noise matters less than a bias
    turn = np.cumsum(rate - 0.5 * (w0 + w1), axis=0) * b.period
    R = exp(turn)  # small: the order of turns does not matter
    level = np.einsum("kij,kj->ki", R, force)
    up = level0 / np.linalg.norm(level0)
    end = np.einsum("ij,j->i", R[-1], level1)
    # from the mean force of one standstill to that of the other, in proportion to time
    share = np.clip((np.arange(len(level)) - n0) / max(1, n1 - n0), 0.0, 1.0)[:, None]
    left = level - ((1.0 - share) * level0 + share * end)
    left = left[n0:n1] - np.outer(left[n0:n1] @ up, up)
    v = np.cumsum(left, axis=0) * b.period
    v -= np.linspace(0.0, 1.0, len(v))[:, None] * v[-1]
    return float(np.sqrt((v**2).sum(axis=1).max())) if len(v) else 0.0


def fuse(
    b: Blocks, sway: Detection, s: Scale, found: list[Speeds], certain: Array, settings: FusionSettings
) -> tuple[Array, Array, tuple[str, ...]]:
    """Stationary intervals, the disturbances bridged in them, and sentences about what was rejected."""
    spans = edges(b, sway.intervals, s, float(np.max(sway.threshold)))
    spans = merged(longer_than(spans, 3.0 * b.period))
    spans, rejected = veto(spans, found, certain)
    spans, filled = bridged(b, spans, certain, settings)
    if len(spans):
        spans = np.stack([spans[:, 0] + settings.margin, spans[:, 1] - settings.margin], -1)
    spans = longer_than(spans, settings.min_duration)
    notes = ()
    if rejected:
        notes = (f"{rejected} smooth stretches are no stops: odometer or GNSS say that the vehicle moved",)
    return spans, filled, notes
