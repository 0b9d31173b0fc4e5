"""The answer of a detector, and arithmetic of time spans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from graphnav.config.detectors import FUSED
from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array, stack_columns

Mask = NDArray[np.bool_]

NONE = np.zeros((0, 2))  # no span
NONE.flags.writeable = False


@dataclass(frozen=True)
class Detection:
    """The answer of one detector.

    `t` is the centre of each window; a window is stationary where `mask` is True, usually where the statistic is below
    the threshold. `intervals` lie within the recording, ordered and disjoint.
    """

    name: str
    t: Array  # (N,) s, centre of each window
    statistic: Array  # (N,) NaN where a window crosses a gap
    threshold: float | Array  # of the statistic
    mask: Mask  # (N,) True where stationary
    intervals: Array  # (M, 2) s
    notes: tuple[str, ...] = ()
    details: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Detections:
    """The answers of all detectors; `stationary` is the fused one, (M, 2) s."""

    stationary: Array
    all: tuple[Detection, ...]
    notes: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> Detection:
        """The answer of one detector by name; KeyError if there is none."""
        for detection in self.all:
            if detection.name == name:
                return detection
        raise KeyError(name)

    def without(self, spans: Array) -> Detections:
        """The same if the platform moves in some of the stationary spans.

        Parameters
        ----------
        spans
            (n, 2) s.

        Returns
        -------
        Detections
            The fused answer without these.
        """
        if not len(spans):
            return self
        kept = subtract_spans(self.stationary, spans)
        notes = describe_false_stops(len(self.stationary) - len(kept))
        answers = (replace(d, intervals=kept, mask=mask_inside(d.t, kept)) if d.name == FUSED else d for d in self.all)
        return Detections(kept, tuple(answers), (*self.notes, *notes))


def describe_false_stops(count: int) -> tuple[Note, ...]:
    """A note on stationary spans in which the platform moves, if there are any."""
    many = format_count(count, "smooth stretch", "smooth stretches")
    words = f"{many} not taken as a stop: the other measurements show motion"
    return (Note("detectors.contradicted", words),) if count else ()


def find_spans(mask: Mask, t: Array, half: float = 0.0) -> Array:
    """(M, 2) spans covered by runs of True, where each row of t stands for `half` seconds on either side."""
    padded = np.zeros(len(mask) + 2, dtype=bool)
    padded[1:-1] = mask
    edges = np.flatnonzero(padded[1:] != padded[:-1])
    first, last = edges[::2], edges[1::2] - 1
    return merge_spans(stack_columns(t[first] - half, t[last] + half)) if len(first) else NONE


def merge_spans(spans: Array, gap: float = 0.0) -> Array:
    """Ordered spans; those that overlap or lie at most `gap` seconds apart are merged."""
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
    """The spans without the parts that lie in `taken`; both ordered and disjoint."""
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


def drop_short(spans: Array, shortest: float) -> Array:
    """The spans that last at least `shortest` seconds."""
    return spans[spans[:, 1] - spans[:, 0] >= shortest] if len(spans) else NONE


def mask_inside(t: Array, spans: Array) -> Mask:
    """Which times lie in one of the spans (ordered, disjoint), ends included."""
    if not len(spans):
        return np.zeros(len(t), dtype=bool)
    k = np.searchsorted(spans[:, 0], t, side="right") - 1
    return np.asarray((k >= 0) & (t <= spans[np.maximum(k, 0), 1]))


def mask_within(t: Array, spans: Array, half: float) -> Mask:
    """Which windows of `half` s on either side of t lie entirely within one of the spans."""
    if not len(spans):
        return np.zeros(len(t), dtype=bool)
    k = np.searchsorted(spans[:, 0], t - half, side="right") - 1
    return np.asarray((k >= 0) & (t + half <= spans[np.maximum(k, 0), 1]))


def measure_overlap(spans: Array, of: Array) -> Array:
    """(M,) s of each span of `of` (M, 2) that is covered by `spans` (ordered, disjoint)."""
    if not len(spans) or not len(of):
        return np.zeros(len(of))
    edge, total = spans.ravel(), np.cumsum(np.diff(spans).ravel())
    before = np.column_stack([np.r_[0.0, total[:-1]], total]).ravel()  # seconds covered up to each edge
    upto = np.interp(of, edge, before)
    return np.asarray(upto[:, 1] - upto[:, 0])


def unite(parts: Sequence[Array]) -> Array:
    """The union of several sets of spans."""
    return merge_spans(np.concatenate(parts)) if parts else NONE
