"""What a detector answers, and the arithmetic of time spans that all of them use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array, columns

Mask = NDArray[np.bool_]

NONE = np.zeros((0, 2))  # no span at all
NONE.flags.writeable = False


@dataclass(frozen=True)
class Detection:
    """The answer of one detector.

    `t` is the centre of each window; a window is stationary where `mask` is True, which is mostly where the
    statistic is below the threshold. `intervals` lie inside the recording, in order, and do not touch.
    """

    name: str
    t: Array  # (N,) s, centre of each window
    statistic: Array  # (N,) NaN where a window crosses a gap
    threshold: float | Array  # of the statistic
    mask: Mask  # (N,) True: stationary
    intervals: Array  # (M, 2) s
    notes: tuple[str, ...] = ()
    details: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Detections:
    """What all detectors say of a recording; `stationary` is the fused answer, (M, 2) s."""

    stationary: Array
    all: tuple[Detection, ...]
    notes: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> Detection:
        """One detector's answer by its name; KeyError if there is none."""
        for detection in self.all:
            if detection.name == name:
                return detection
        raise KeyError(name)


def spans_of(mask: Mask, t: Array, half: float = 0.0) -> Array:
    """(M, 2) spans covered by the runs of True, each row of t standing for `half` seconds on either side of it."""
    padded = np.zeros(len(mask) + 2, dtype=bool)
    padded[1:-1] = mask
    edges = np.flatnonzero(padded[1:] != padded[:-1])
    first, last = edges[::2], edges[1::2] - 1
    return merge_spans(columns(t[first] - half, t[last] + half)) if len(first) else NONE


def merge_spans(spans: Array, gap: float = 0.0) -> Array:
    """Spans in order, those that overlap or lie at most `gap` seconds apart as one."""
    if not len(spans):
        return NONE
    if len(spans) == 1:
        return spans.copy()
    spans = spans[np.argsort(spans[:, 0])]
    reach = np.maximum.accumulate(spans[:, 1])
    new = np.flatnonzero(spans[1:, 0] > reach[:-1] + gap) + 1
    out = np.empty((len(new) + 1, 2))
    out[0, 0], out[-1, 1] = spans[0, 0], reach[-1]
    out[1:, 0], out[:-1, 1] = spans[new, 0], reach[new - 1]
    return out


def subtract_spans(spans: Array, taken: Array) -> Array:
    """The spans less what lies in `taken`; both in order and without overlap."""
    if not len(spans) or not len(taken):
        return spans
    out = []
    for a, b in spans:
        for c, d in taken[(taken[:, 1] > a) & (taken[:, 0] < b)]:
            if c > a:
                out.append((a, c))
            a = max(a, d)
        if b > a:
            out.append((a, b))
    return np.array(out) if out else NONE


def longer_than(spans: Array, shortest: float) -> Array:
    """Those spans that last at least so many seconds."""
    return spans[spans[:, 1] - spans[:, 0] >= shortest] if len(spans) else NONE


def mask_inside(t: Array, spans: Array) -> Mask:
    """Which times lie in one of the spans (in order, without overlap); ends belong to them."""
    if not len(spans):
        return np.zeros(len(t), dtype=bool)
    k = np.searchsorted(spans[:, 0], t, side="right") - 1
    return np.asarray((k >= 0) & (t <= spans[np.maximum(k, 0), 1]))


def mask_within(t: Array, spans: Array, half: float) -> Mask:
    """Which windows of `half` s on either side of t lie wholly in one of the spans."""
    if not len(spans):
        return np.zeros(len(t), dtype=bool)
    k = np.searchsorted(spans[:, 0], t - half, side="right") - 1
    return np.asarray((k >= 0) & (t + half <= spans[np.maximum(k, 0), 1]))


def seconds_in(spans: Array, of: Array) -> Array:
    """(M,) s of each span of `of` (M, 2) that lie in `spans` (in order, without overlap)."""
    if not len(spans) or not len(of):
        return np.zeros(len(of))
    edge, total = spans.ravel(), np.cumsum(np.diff(spans).ravel())
    before = np.column_stack([np.r_[0.0, total[:-1]], total]).ravel()  # seconds in spans up to each edge
    upto = np.interp(of, edge, before)
    return np.asarray(upto[:, 1] - upto[:, 0])


def union(parts: Sequence[Array]) -> Array:
    """All spans of several sets, merged."""
    return merge_spans(np.concatenate(parts)) if parts else NONE
