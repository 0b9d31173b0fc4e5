"""Fusion of the detectors' answers to stationary intervals: candidates, vetoes, bridges and edges.

1. Candidates are the spans of one detector: in the fusion the low-band GLRT, a likelihood ratio test, else the one
   that decides alone. Their ends are moved to where the low-passed force and rate depart from their means inside
   (never outwards past a disturbance).
2. Nothing changes in a candidate, so neither does its speed: if the speeds measured inside show motion, all of it
   moves, and so do the spans that the force links to it (`graphnav.detectors.chain`). Where no speed was measured
   inside, the one measured last before it, and first after it, must be one that the force leads to from rest.
   Nor does its rate of turn: one that differs from that of the other candidates by more than a bias changes is a
   turn on the spot, of a tracked robot or of what the vehicle stands on.
3. Two candidates are one stop if the force between them, integrated, leads from rest to rest without reaching a
   speed in between: a passenger moved, not the vehicle. In the fusion, what the FFT detector calls stationary next
   to a stop is added under the same condition.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from graphnav.config.detectors import FusionSettings
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.detectors.base import (
    NONE,
    Detection,
    drop_short,
    find_spans,
    mask_within,
    merge_spans,
    subtract_spans,
    unite,
)
from graphnav.detectors.chain import (
    LONGEST_LINK,
    Link,
    Outwards,
    find_end_of_rest,
    find_moving_by_chain,
    find_speed_beside,
    link,
)
from graphnav.detectors.low_band import Scale, compute_low_band
from graphnav.detectors.motion import Speeds, take_median
from graphnav.detectors.scene import Detector, Labels, Scene
from graphnav.detectors.windows import BlockMeans, compute_share, low_pass_rows, make_kernel

LOW_BAND, FFT = "low_band_glrt", "fft"
_EDGE_REGION = 3.0  # s about an end in which the edge is sought
_INNER = 1.5  # s inside a candidate that define its mean force and rate
_EDGE_STATISTIC = 3.0  # the statistic S of a single row at an edge
_WORTH = 1.0  # s, the least by which the FFT detector may extend a span
_FURTHEST = 10.0  # s, the most
_AWAY = 0.3  # ratio of mean to largest speed of a disturbance above which it moves the vehicle away
_BLIND = 0.2  # share of moving windows that look stationary above which stillness is no evidence
_AROUND = 60.0  # s about a span in which an odometer must have moved for its zero to count
_ENOUGH_MOTION = 20.0  # s of certain motion needed to estimate that share
_CLEAR_MOTION = 10.0  # multiple of the low-band GLRT's threshold at which the vehicle clearly moves
_BIAS_CHANGE = np.radians(1.0)  # rad/s: 0.05 deg/s/K of a consumer gyro (BMI160, data sheet) over 20 K
_FILTER_REACH = 0.3  # s, of the low-pass filter: closer to the recording's ends no edge can be found


def trim_edges(b: BlockMeans, spans: Array, s: Scale, threshold: float) -> Array:
    """The spans with ends where the low-passed rows depart from their mean just inside."""
    h = make_kernel(b.period)
    out = []
    white = np.r_[np.full(3, 1.0 / s.force), np.full(3, 1.0 / s.rate)]
    for start, end in spans:
        middle = 0.5 * (start + end)
        first = _leave(b, h, white, middle, start, -1, threshold)
        last = _leave(b, h, white, middle, end, 1, threshold)
        if last > first:
            out.append((first, last))
    return np.array(out) if out else NONE


def _leave(b: BlockMeans, h: Array, white: Array, middle: float, end: float, way: int, threshold: float) -> float:
    """Last time, from the middle towards one end, at which a row still agrees with those before it."""
    inner = min(_INNER, abs(end - middle))
    lo, hi = sorted((end + way * _EDGE_REGION, end - way * (inner + 1.0)))
    i, j = np.searchsorted(b.t, [lo, hi])
    i, j = max(i - len(h), 0), min(j + len(h), len(b.t))
    if j - i <= len(h) + 2:
        return middle
    rows = low_pass_rows(b.mean[i:j, :6], h) * white
    t = 0.5 * (b.t[i : j - len(h) + 1] + b.t[i + len(h) - 1 : j])
    rows, t = (rows, t) if way > 0 else (rows[::-1], t[::-1])
    normal = way * (t - end) < -0.5
    normal &= way * (t - end) > -0.5 - inner
    if normal.sum() < 5:
        normal = np.abs(t - middle) <= max(0.25, 2.0 * b.period)
        if not normal.any():
            return middle
    off = ((rows - compute_share(rows[normal], 0.5)) ** 2).sum(axis=1) / 6.0
    # normal scatter must not end the stop: twice its upper quantile, at least the detector's own limit
    limit = max(threshold, 2.0 * float(compute_share(off[normal], 0.95)))
    begin = int(np.argmax(normal))
    beyond = np.flatnonzero(off[begin:] > limit)
    # a gap in the recording ends every interval
    torn = np.flatnonzero(np.abs(np.diff(t[begin:])) > 0.2 + 2.0 * b.period)
    stop = min([begin + int(x[0]) for x in (beyond, torn + 1) if len(x)], default=len(t))
    return float(t[max(stop - 1, begin)])


def _cut_at_speed(b: BlockMeans, spans: Array, settings: FusionSettings) -> Array:
    """The spans cut where the force, integrated from `_EDGE_REGION` s inside, leads to a speed: braking that looked
    stationary.
    """
    limit = 0.5 * settings.bridge_speed
    out = spans.copy()
    for k, (start, end) in enumerate(spans):
        inside = min(_EDGE_REGION, 0.5 * (end - start - _INNER))
        if inside <= 0.0:
            continue
        first, last = (
            find_end_of_rest(b, np.array([start + inside, end]), -1, inside, limit),
            find_end_of_rest(b, np.array([start, end - inside]), 1, inside, limit),
        )
        out[k] = max(start, first), min(end, last)
    return out[out[:, 1] > out[:, 0]]


def find_candidates(scene: Scene, found: Detection, row: Scale) -> tuple[Array, Array, tuple[str, ...]]:
    """Candidates of a detector, with edges, where `row` is that at rest, and without those that move; spans of certain
    motion; notes.
    """
    b, speeds, certain = scene.blocks, scene.known, scene.certain
    by_rows = found.name == LOW_BAND  # its windows are of the rows in which edges are sought
    # a threshold raised by the data applies to windows; an edge is where the noise and sway of single rows end
    limit = min(float(np.max(found.threshold)), _EDGE_STATISTIC) if by_rows else _EDGE_STATISTIC
    spans = trim_edges(b, found.intervals, row, limit)
    if not by_rows:
        spans = _cut_at_speed(b, spans, scene.settings.fusion)
    spans = merge_spans(drop_short(spans, 3.0 * b.period))
    if not len(spans):
        return NONE, certain, ()
    certain = _screen_motion(b, spans, speeds, certain)
    known = np.array([_find_speed(speeds, span) for span in spans])
    moves = np.array([_contradicts_speed(b, span, speeds, scene.settings.fusion) for span in spans]) & np.isnan(known)
    rest = np.flatnonzero(~moves)  # a moving vehicle may brake steadily: the integral of its force counts, not the mean
    moves[rest] = find_moving_by_chain([link(b, *pair) for pair in pairwise(spans[rest])], known[rest])
    turns = ~moves & _find_turning(b, spans)
    notes = Notes()
    measured = int((np.nan_to_num(known) > 0.0).sum())
    if measured:
        notes.add("detectors.speed_known", f"{_count(measured)} not taken as a stop: odometer or GNSS show motion")
    if moves.sum() > measured:
        notes.add(
            "detectors.speed_felt",
            f"{_count(int(moves.sum()) - measured)} not taken as a stop: the force before or after shows motion",
        )
    if turns.any():
        moves |= turns
        notes.add(
            "detectors.turning", f"{_count(int(turns.sum()))} not taken as a stop: the platform turns on the spot"
        )
    share = _share_still_in_motion(found, certain)
    if share > _BLIND:
        unseen = ~moves & np.isnan(known) & np.array([not _reads_zero(speeds, span) for span in spans])
        moves |= unseen
        notes.add(
            "detectors.still_in_motion",
            f"{100.0 * share:.0f} % of the seconds in certain motion are as quiet as a stop (a simulation without "
            "a road?): a stop needs a measured speed as well, which leaves out "
            f"{format_count(int(unseen.sum()), 'stretch', 'stretches')}",
        )
    spans = subtract_spans(spans[~moves], certain)
    if not by_rows and len(certain):  # ends set by certain motion are as uncertain as its timing
        spans = _cut_at_speed(b, spans, scene.settings.fusion)
    return spans, certain, tuple(notes)


def _screen_motion(b: BlockMeans, spans: Array, speeds: list[Speeds], certain: Array) -> Array:
    """Spans of certain motion, without those inside a stationary-looking span whose speed the force does not explain.

    Nothing changes at their ends, so the fixes or the odometer are wrong there.
    """
    keep = np.ones(len(certain), dtype=bool)
    for k, (begin, end) in enumerate(certain):
        for start, last in spans[(spans[:, 0] < begin) & (spans[:, 1] > end)]:
            one = link(b, np.array([start, begin]), np.array([end, last]))
            fastest = max(float(s.speed[there].max()) for s in speeds if (there := (s.t >= begin) & (s.t <= end)).any())
            keep[k] = one.peak + one.tolerance >= fastest
    return certain[keep]


def _find_turning(b: BlockMeans, spans: Array) -> NDArray[np.bool_]:
    """Which of M spans (M, 2) turn steadily: whose mean rate is not the median of the rates in all of them."""
    rates = [b.rate[first:end] for first, end in np.searchsorted(b.t, spans).tolist()]
    every = np.concatenate(rates)
    if not len(every):
        return np.zeros(len(spans), dtype=bool)
    usual = compute_share(every, 0.5)
    return np.array([len(x) > 0 and bool((np.abs(x.mean(axis=0) - usual) > _BIAS_CHANGE).any()) for x in rates])


def _share_still_in_motion(found: Detection, certain: Array) -> float:
    """Share of the windows in certain motion that look stationary; 0 where there are too few to tell."""
    step = float(found.t[1] - found.t[0]) if len(found.t) > 1 else 0.0
    moving = mask_within(found.t, certain, _INNER) & np.isfinite(found.statistic)
    return float(found.mask[moving].mean()) if moving.sum() * step > _ENOUGH_MOTION else 0.0


def _contradicts_speed(b: BlockMeans, span: Array, speeds: list[Speeds], settings: FusionSettings) -> bool:
    """Whether the speeds last measured before a span, or first after it, contradict a stop there.

    Single epochs do not count, as elsewhere, and every speed may be as late as an odometer's.
    """
    for way in (-1, 1):
        beside: Outwards | None = None
        for s in speeds:
            edge = span[0] if way < 0 else span[1]
            at = np.flatnonzero(way * (s.t - edge) > s.half)
            at = at[np.argsort(np.abs(s.t[at] - edge), kind="stable")[:3]]
            if len(at) < 3 or np.abs(s.t[at] - edge).max() > LONGEST_LINK:
                continue
            beside = beside or find_speed_beside(b, span, way)
            if beside is None:
                break
            excess = [_find_excess(beside, s, k, max(s.late, settings.odometer_delay)) for k in at.tolist()]
            if take_median(*np.array(excess)) > 0.0:
                return True
    return False


def _find_excess(beside: Outwards, s: Speeds, k: int, late: float) -> float:
    """m/s by which a measured speed exceeds every speed that a stop permits while it was measured; -inf if unknown."""
    there = beside.find_between(s.t[k] - s.half - late, s.t[k] + s.half)
    if there is None:
        return -np.inf
    return float(s.speed[k] - np.max(beside.speed[there] + np.hypot(beside.tolerance[there], s.limit[k])))


def _reads_zero(speeds: list[Speeds], span: Array) -> bool:
    """Whether a working odometer reads zero throughout a span."""
    for s in speeds:
        near = (s.t >= span[0] - _AROUND) & (s.t <= span[1] + _AROUND)
        inner = (s.t >= span[0] + s.late) & (s.t <= span[1])
        if s.silent_at_rest and inner.sum() and near.any() and s.speed[near].max() > s.speed[inner].max() == 0.0:
            return True
    return False


def _count(n: int) -> str:
    return format_count(n, "smooth stretch", "smooth stretches")


def _find_speed(speeds: list[Speeds], span: Array) -> float:
    """Speed in a span in which nothing changes, by the sensor with the most epochs; NaN if there are none."""
    found = [s.measure_speed(span) for s in speeds]
    return float(np.nanmax(found)) if not np.isnan(found).all() else float("nan")


def bridge_disturbances(b: BlockMeans, spans: Array, certain: Array, settings: FusionSettings) -> Array:
    """The spans, joined across disturbances in which the vehicle did not move."""
    out = list(spans[:1])
    for span in spans[1:]:
        before = out[-1]
        moved = bool(((certain[:, 0] < span[0]) & (certain[:, 1] > before[1])).any())
        near = span[0] - before[1] <= settings.bridge
        one = link(b, before, span) if near and not moved else None
        if one is not None and _is_only_shaken(one, settings):
            out[-1] = np.array([before[0], span[1]])
        else:
            out.append(span)
    return np.array(out) if out else NONE


def _is_only_shaken(one: Link, settings: FusionSettings) -> bool:
    """Whether the vehicle was only shaken between two stops: it moved back and forth, but not away."""
    away = one.mean > _AWAY * settings.bridge_speed
    return one.peak < settings.bridge_speed and not away and abs(one.change) < one.tolerance


def join_idling(b: BlockMeans, spans: Array, idling: Array, settings: FusionSettings) -> Array:
    """The spans extended by what the FFT detector calls stationary at their ends, as far as the force agrees."""
    out = spans.copy()
    limit = 0.5 * settings.bridge_speed
    for k, span in enumerate(spans):
        for side, way in ((0, -1), (1, 1)):
            over = idling[(idling[:, 0] <= span[side]) & (idling[:, 1] >= span[side])]
            further = way * (over[0, side] - span[side]) if len(over) else 0.0
            if further < _WORTH:
                continue
            until = find_end_of_rest(b, span, way, min(further, _FURTHEST), limit)
            # one second is left for an acceleration that the integral has only begun to show
            if way * (until - span[side]) > _WORTH:
                out[k, side] = until - way * _WORTH
    return merge_spans(out)


def fuse(b: BlockMeans, spans: Array, idling: Array, certain: Array, settings: FusionSettings) -> tuple[Array, Array]:
    """Stationary intervals from candidates and the FFT detector's answer, and the disturbances within them."""
    still = spans
    if len(spans) and len(idling):
        spans = subtract_spans(join_idling(b, spans, idling, settings), certain)
    spans = bridge_disturbances(b, spans, certain, settings)
    if len(spans):
        # a recording that begins or ends in a stop has no edge there
        first = np.where(spans[:, 0] - b.t[0] < _FILTER_REACH, b.t[0], spans[:, 0] + settings.margin)
        last = np.where(b.end[-1] - spans[:, 1] < _FILTER_REACH, b.end[-1], spans[:, 1] - settings.margin)
        spans = np.stack([first, last], -1)
    spans = drop_short(spans, settings.min_duration)
    return spans, drop_short(subtract_spans(spans, still), settings.margin + _FILTER_REACH)


@dataclass(frozen=True)
class StopDecision:
    """A decision on stationary intervals."""

    spans: Array  # (M, 2) s, stationary
    disturbed: Array  # (L, 2) s, disturbances bridged within them
    notes: tuple[str, ...]
    found: tuple[Detection, ...]  # the answer of each detector


def check_intervals(scene: Scene, detector: type[Detector], shown: bool) -> StopDecision:
    """The decision of a single detector: its intervals, checked against measured speeds and the force between them."""
    found = detector.detect(scene, None, shown)
    still, certain, notes = find_candidates(scene, found, compute_low_band(scene)[1])
    spans, disturbed = fuse(scene.blocks, still, NONE, certain, scene.settings.fusion)
    return StopDecision(spans, disturbed, (*found.notes, *notes), (found,))


def merge_decisions(parts: Sequence[StopDecision]) -> StopDecision:
    """Merge the decisions of several detectors: stationary where any of them says so."""
    notes = dict.fromkeys(note for part in parts for note in part.notes)
    return StopDecision(
        unite([part.spans for part in parts]),
        unite([part.disturbed for part in parts]),
        tuple(notes),
        tuple(one for part in parts for one in part.found),
    )


def decide_fused(scene: Scene, detectors: Mapping[str, type[Detector]], shown: bool) -> StopDecision:
    """The fusion: the low-band GLRT proposes, speeds and forces veto, the FFT detector extends the ends of stops.

    Parameters
    ----------
    detectors : all, by their names; the others learn from these what standing looks like here.
    shown : whether the answers of those that decide nothing are wanted.
    """
    low, row = compute_low_band(scene)
    still, certain, notes = find_candidates(scene, low, row)
    half = 0.5 * scene.settings.low_band_glrt.window
    labels = Labels(still, find_spans(low.statistic > _CLEAR_MOTION * low.threshold, low.t, half))
    notes = (*low.notes, *notes)
    found, idling = [low], NONE
    if shown:
        found += [d.detect(scene, labels) for name, d in detectors.items() if name not in (LOW_BAND, FFT)]
    if scene.recording.platform == "vehicle" and (shown or len(still)):
        found.append(detectors[FFT].detect(scene, labels, shown))
        notes += found[-1].notes
        idling = found[-1].intervals
    spans, disturbed = fuse(scene.blocks, still, idling, certain, scene.settings.fusion)
    return StopDecision(spans, disturbed, notes, tuple(found))
