"""Stances of a foot: the GLRT (Skog et al. 2010, eq. 9; Ren 2021, eq. 3-5) in units of turn rate.

A foot in stance does not read like one at rest because the shoe rolls over the floor, rather than because of sensor
noise. So the sigmas of the test are those of rolling, and it becomes

    e^2 = mean |omega_k - b|^2 + mean |f_k - g f_bar/|f_bar||^2 / c^2            over `window`

with b and g the mean rate and the magnitude of the mean force of the quietest second of the recording, which contain
the biases. e is the turn rate of a foot that moves that much. c, m/s^2 per rad/s, is the deviation of the force that
weighs as much as a turn rate of 1; it follows from Skog's sigmas, 0.01 m/s^2 and 0.1 deg/s.

In swing e is several rad/s, in the middle of a stance some tenths. The threshold lies between them, at 1.5 rad/s, where
an IMU 10 cm above the floor moves at 0.15 m/s, a twentieth of its speed in swing. It need not be exact, because the
rows of `graphnav.constraints.foot` model the rolling and are weighted down the stronger it is. But no part of a swing
may be taken for a stance: in the slow first step of a walk force and rate are low for a moment, but less low than in
stances. So spans whose lowest e is an outlier among those of all spans, by three of their spreads (median absolute
deviation, in log e), are discarded.

e does not show a lasting force: a foot that is carried level to its last footprint and slows down there turns little,
and the deceleration tilts the mean force more than it lengthens it. But over the whole span it adds up. So from the
quietest moment near either end the gyro carries the axes outward, and the excess force is integrated; the span ends
where that velocity exceeds the threshold times `_SOLE_REACH`, the most that rolling permits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphnav.config.detectors import FUSED, StanceSettings
from graphnav.core import rotation
from graphnav.core.notes import Note, Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.running import sum_rows
from graphnav.detectors.base import NONE, Detection, Detections, drop_short, find_spans, mask_inside, merge_spans, unite
from graphnav.detectors.glrt import compute_glrt
from graphnav.detectors.windows import find_unbroken
from graphnav.recording import Imu

_QUIET_SPAN = 1.0  # s; the quietest second of the recording defines bias and gravity
_FEWEST_SPANS = 5  # spans needed for the statistics of their depth
_LEAST_SPREAD = 0.3  # of log e: least spread between stances
_SPREADS = 3.0
_EDGE_SEARCH = 0.8  # s from an end of a span within which its quietest moment is sought: twice the duration of a slide
_SOLE_REACH = 0.2  # m, largest distance from an IMU on a shoe to the point of contact with the floor


def detect_stances(
    imu: Imu, period: float, settings: StanceSettings, which: Sequence[str] = ("glrt",), since: float = -np.inf
) -> Detections:
    """Stances of a foot, and the statistic e with its threshold.

    Parameters
    ----------
    period : s between rows.
    which : of Skog's four statistics, all in the units of e; a stance is one if any of them says so.
    since : s; stances that are over by then are not cut where the foot slides.
    """
    window = max(3, round(settings.window / period))
    if len(imu.t) < window:
        return Detections(
            NONE, (), (Note("detectors.too_short", "no detection: the recording is shorter than a window"),)
        )
    bias, g = _average_quietest(imu, period)
    found: list[Detection] = []
    kept, notes = [], Notes()
    for name in which:
        e = np.sqrt(compute_glrt(imu.accel, imu.gyro - bias, window, settings.force_per_rate, 1.0, g, name))
        found.append(_find_below(name, e, imu, period, window, settings))
        one = found[-1]
        deep = one.intervals[_mask_deep(one.intervals, one.t, one.statistic, settings.threshold)]
        if len(deep) < len(one.intervals):
            short = format_count(len(one.intervals) - len(deep), "interval")
            notes.add("detectors.stance.lulls", f"{short} left out: less quiet than the stances")
        begin = int(np.searchsorted(deep[:, 1], since)) if len(deep) else 0
        cut = _cut_sliding(deep[begin:], imu, one.t, one.statistic, bias, settings.threshold * _SOLE_REACH)
        kept.append(np.concatenate([deep[:begin], cut]))
    if not found:
        return Detections(NONE, (), ())
    spans = unite(kept) if len(kept) > 1 else kept[0]
    first = found[0]
    mask = mask_inside(first.t, spans)
    found.append(Detection(FUSED, first.t, first.statistic, settings.threshold, mask, spans, tuple(notes)))
    return Detections(spans, tuple(found), tuple(notes))


def _find_below(name: str, e: Array, imu: Imu, period: float, window: int, settings: StanceSettings) -> Detection:
    """Spans in which e is below its threshold."""
    t = 0.5 * (imu.t[: len(e)] + imu.t[window - 1 :]) - 0.5 * period  # a row covers the period before it
    whole = find_unbroken(np.r_[True, np.diff(imu.t) < period + settings.bridge], window)
    e = np.where(whole, e, np.nan)
    below = e < settings.threshold
    spans = drop_short(merge_spans(find_spans(below, t, 0.5 * period), settings.bridge), settings.shortest)
    # windows lie within the recording: the first and the last stance reach to its ends
    half = 0.5 * window * period
    if len(spans) and spans[0, 0] < imu.t[0] + half:
        spans[0, 0] = imu.t[0] - period
    if len(spans) and spans[-1, 1] > imu.t[-1] - half - period:
        spans[-1, 1] = imu.t[-1]
    return Detection(name, t, e, settings.threshold, below, spans)


def _average_quietest(imu: Imu, period: float) -> tuple[Array, float]:
    """Mean rate (3,) and magnitude of the mean force of the second in which both scatter least."""
    n = min(len(imu.t), max(2, round(_QUIET_SPAN / period)))
    rows = np.column_stack([imu.gyro, imu.accel])
    means, squares = sum_rows(rows).compute_means(n), sum_rows(rows**2).compute_means(n)
    scatter = squares - means**2
    # each divided by its own typical scatter, so that neither unit dominates
    total = np.sum(scatter / np.maximum(np.median(scatter, axis=0), 1e-12), axis=1)
    k = int(np.argmin(total))
    return means[k, :3], float(np.linalg.norm(means[k, 3:]))


def _mask_deep(spans: Array, t: Array, e: Array, threshold: float) -> Array:
    """(M,) bool, which spans reach about as low as the others.

    Missing rows do not split a stance: the parts would be many, and the stances of the walk the outliers.
    """
    if len(spans) < _FEWEST_SPANS:
        return np.ones(len(spans), dtype=bool)
    first, last = np.searchsorted(t, spans[:, 0]), np.searchsorted(t, spans[:, 1], side="right")
    moved = np.concatenate([[0], np.cumsum(np.nan_to_num(e) >= threshold)])
    # the stance that each is part of
    one = np.cumsum(np.concatenate([[False], moved[first[1:]] > moved[last[:-1] - 1]]))
    lowest = np.array([np.log(np.nanmin(e[a:b])) for a, b in zip(first, last, strict=True)])
    depth = np.full(one[-1] + 1, np.inf)
    np.minimum.at(depth, one, lowest)
    if len(depth) < _FEWEST_SPANS:
        return np.ones(len(spans), dtype=bool)
    middle = float(np.median(depth))
    spread = max(1.4826 * float(np.median(np.abs(depth - middle))), _LEAST_SPREAD)
    return np.asarray(depth < middle + _SPREADS * spread)[one]


def _cut_sliding(spans: Array, imu: Imu, t: Array, e: Array, bias: Array, fastest: float) -> Array:
    """The spans (M, 2), cut where the foot moves at more than `fastest` m/s relative to their quietest moments.

    t, e (W,) are of the windows that begin with each row.
    """
    out = spans.copy()
    window = len(imu.t) - len(t) + 1
    force = sum_rows(imu.accel).compute_means(window)
    T = np.diff(imu.t, prepend=2.0 * imu.t[0] - imu.t[1])
    ways = []  # from a quiet moment outward: the span, its end, the window, the first row and the number of rows
    for side, way in ((0, -1), (1, 1)):
        for n, (begin, end) in enumerate(spans):
            lo, hi = (begin, min(begin + _EDGE_SEARCH, end)) if side == 0 else (max(end - _EDGE_SEARCH, begin), end)
            first, last = np.searchsorted(t, [lo, hi])
            if not np.isfinite(e[first:last]).any():
                continue
            k = int(first + np.nanargmin(e[first:last]))
            row, edge = (int(x) + side for x in np.searchsorted(imu.t, [t[k], (begin, end)[side]]))
            count = way * (min(edge, len(imu.t)) - row)
            if count > 0:
                ways.append((n, side, k, row, count))
    if not ways:
        return out
    which, sides, windows, rows, counts = np.array(ways).T
    longest = int(counts.max())
    sign = 2 * sides[:, None] - 1
    rows = rows[:, None] + sign * np.minimum(np.arange(longest), counts[:, None] - 1)  # (W, L), the last repeated
    dt = sign * T[rows]  # a row covers the period before its time
    R = rotation.exp(0.5 * dt[:, :, None] * (imu.gyro[rows] - bias))  # over half a period; products of these follow
    R[:, 1:] = R[:, :-1] @ R[:, 1:]
    step = 1
    while step < longest:
        R[:, step:] = R[:, :-step] @ R[:, step:]
        step *= 2
    beyond = (R @ imu.accel[rows][..., None])[..., 0] - force[windows, None]
    v = np.cumsum(T[rows][:, :, None] * beyond, axis=1)
    over = np.einsum("wli,wli->wl", v, v) > fastest**2
    for w in np.flatnonzero(over.any(axis=1)):
        if over[w, : counts[w]].any():
            row = rows[w, over[w].argmax()]
            out[which[w], sides[w]] = imu.t[row] - (0.0 if sides[w] == 0 else T[row])
    return out
