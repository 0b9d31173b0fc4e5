"""Recordings too long to be solved at once: solved in overlapping parts, each of which contributes its own span.

A pass of the filter keeps some twenty matrices of the error state for every keyframe until the smoother has used them,
nearly a gigabyte an hour. So a recording of more than a few hours is cut into equal parts. Each is solved together with
what precedes and follows it for as long as that has an influence, from an alignment and with noise figures of its own;
its solution is used for its own span. No cut is made where the fixes before it do not determine position and heading of
a filter that starts there: in outages, at long stops, and without a receiver.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphnav.config import Settings
from graphnav.core.earth import A
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.detectors.base import Detection
from graphnav.estimation.dense import Dense
from graphnav.estimation.noise.model import NoiseModel, RowWeights
from graphnav.estimation.solution import CarrierArcs, ConstraintRecord, ParameterEstimate, Solution
from graphnav.recording import Recording, take_rows

STRAIGHT, _STATES = 10_800.0, 44  # s solved at once at most: 3 GB at a keyframe a second and 44 error states
PART = 3_600.0  # s of a part at most: twice the keyframes that the estimation of noise needs
OVERLAP = (
    # s: inertial information from ten minutes ago is negligible (`graphnav.estimation.faults.watch.OLDEST`)
    600.0
)

_SILENCE = 60.0  # s between fixes, after which inertial sensors of any grade have started to drift
_COURSE = 0.01  # rad, of a known heading: half its square is negligible against sensor errors


@dataclass(frozen=True)
class Share:
    """A part of a recording with its overlaps, and the span (s, end exclusive) that it contributes."""

    recording: Recording
    start: float
    end: float


def split_drive(recording: Recording, settings: Settings) -> list[Share]:
    """The recording in one part, or in parts of equal length that overlap."""
    begin, length = recording.start, recording.end - recording.start
    if length <= _limit_length(recording, settings):
        return [Share(recording, -np.inf, np.inf)]
    edges = np.linspace(0.0, length, int(np.ceil(length / PART)) + 1)
    edges = np.array([0.0, *(edge for edge in edges[1:-1] if _is_told(recording, begin + edge)), length])
    out = []
    for k, (lo, hi) in enumerate(itertools.pairwise(edges)):
        first, last = max(lo - OVERLAP, 0.0), min(hi + OVERLAP, length)
        part = recording.crop(first - 1e-9, last + 1e-9)
        lo_row, hi_row = np.searchsorted(recording.imu.t, part.imu.t[[0, -1]])
        own = slice(int(lo_row), int(hi_row) + 1)
        part = replace(part, imu=take_rows(recording.imu, own))  # no copy of the largest arrays
        start = -np.inf if k == 0 else begin + lo
        out.append(Share(part, start, np.inf if k == len(edges) - 2 else begin + hi))
    return out


def _limit_length(recording: Recording, settings: Settings) -> float:
    """s solved at once at most: memory grows with the square of the error states, of which satellites have their
    own.
    """
    raw, chosen = recording.raw_gnss, settings.raw_gnss
    if raw is None or not recording.is_tight(chosen.coupling):
        return STRAIGHT
    against_base = (
        np.isfinite(raw.carrier_difference) if len(raw.carrier_difference) else np.zeros(len(raw), dtype=bool)
    )
    more = len(np.unique(raw.satellite))
    if chosen.carrier and against_base.any():
        more += len(np.unique(1000 * raw.satellite[against_base].astype(int) + raw.signal[against_base]))
    elif chosen.differences and np.isfinite(raw.carrier).any():
        more *= 2
    return max(PART, STRAIGHT * (_STATES / (_STATES + more)) ** 2)


def _is_told(recording: Recording, t: float) -> bool:
    """Whether fixes cover the overlap before a time (s), and their course determines the heading."""
    gnss = recording.gnss
    if gnss is None:
        return False
    some = (gnss.t >= t - OVERLAP) & (gnss.t <= t) & np.isfinite(gnss.llh).all(axis=1)
    if np.max(np.diff([t - OVERLAP, *gnss.t[some], t])) > _SILENCE:
        return False
    llh = gnss.llh[some]
    way = A * np.ptp(llh[:, :2] * [1.0, np.cos(llh[0, 0])], axis=0)
    return bool(np.hypot(*way) * _COURSE > np.median(np.hypot(*gnss.sd[some, :2].T)))


@dataclass(frozen=True)
class _Span:
    """`Solution.between` of a part, restricted to its own span.

    Covariances are half of the result: those of the keyframes within are the solution's own, not a copy.
    """

    bare: Dense  # from the keyframe before the span to the one behind it, without covariances
    before: Array  # (0 or 1, 15, 15)
    own: Array  # (n, 15, 15)
    behind: Array  # (0 or 1, 15, 15)
    start: float
    end: float

    @classmethod
    def of(cls, whole: Dense, inside: slice, own: Array, start: float, end: float) -> _Span:
        """A part's, of whose keyframes those `inside`, with covariances `own`, are in the span."""
        every = slice(max(inside.start - 1, 0), min(inside.stop + 1, len(whole.t)))
        steps = slice(every.start, every.stop - 1)
        before, behind = slice(every.start, inside.start), slice(inside.stop, every.stop)
        bare = replace(
            whole, t=whole.t[every].copy(), states=States.stack([whole.states[every]]), ba=whole.ba[steps].copy(),
            bg=whole.bg[steps].copy(), covariance=np.empty((0, DIM, DIM)), white=whole.white[:, steps].copy(),
            ahead=None if whole.ahead is None else whole.ahead[steps].copy(),
        )  # fmt: skip
        P, start, end = whole.covariance, max(whole.start, start), min(whole.end, end)
        return cls(bare, P[before].copy(), own, P[behind].copy(), start, end)

    def list_times(self, rate: float) -> Array:
        """Times at a rate inside the span."""
        t = self.bare.list_times(rate)
        return t[(t >= self.start) & (t <= self.end)]

    def __call__(self, t: Array) -> tuple[States, Array]:
        """As for the part."""
        return self._cover()(t)

    def interpolate_blocks(self, t: Array) -> tuple[States, dict[str, Array]]:
        """As for the part."""
        return self._cover().interpolate_blocks(t)

    def _cover(self) -> Dense:
        return replace(self.bare, covariance=np.concatenate([self.before, self.own, self.behind]))


def share_covariances(joined: Solution) -> Solution:
    """A solution joined of parts, whose parts hold no covariances of their own."""
    between, first = [], 0
    for one in joined.between:
        if isinstance(one, _Span):
            one = replace(one, own=joined.covariance[first : first + len(one.own)])
            first += len(one.own)
        between.append(one)
    return replace(joined, between=tuple(between))


def crop_solutions(solutions: dict[str, Solution], share: Share) -> dict[str, Solution]:
    """The solutions of a part restricted to its own span; shared objects stay shared."""
    out: dict[str, Solution] = {}
    for name, one in solutions.items():
        out[name] = crop_solution(one, share, next((other.detections for other in out.values()), None))
    return out


def crop_solution(solution: Solution, share: Share, detections: tuple[Detection, ...] | None = None) -> Solution:
    """The solution of a part restricted to its own span, without the graph that it was solved with.

    `detections` are those of another solution of the part, restricted likewise.
    """
    start, end = share.start, share.end
    if np.isneginf(start) and np.isposinf(end):
        return solution

    def find_inside(t: Array) -> Array:
        return np.flatnonzero((t >= start) & (t < end))

    def crop_parameter(p: ParameterEstimate) -> ParameterEstimate:
        in_force = np.searchsorted(p.t, start, side="right") - 1  # applies from before the span on
        some = np.flatnonzero((p.t < end) & (np.arange(len(p.t)) >= in_force))
        return replace(p, t=np.maximum(p.t[some], start), value=p.value[some], sigma=p.sigma[some])

    def crop_record(r: ConstraintRecord) -> ConstraintRecord:
        some = find_inside(r.t)
        return replace(
            r,
            t=r.t[some],
            residual=r.residual[some],
            sigma=r.sigma[some],
            nis=r.nis[some],
            weight=r.weight[some],
            satellite=r.satellite[some[: len(r.satellite)]],
            azimuth=r.azimuth[some[: len(r.azimuth)]],
            elevation=r.elevation[some[: len(r.elevation)]],
        )

    def crop_detection(d: Detection) -> Detection:
        some, n = find_inside(d.t), len(d.t)
        spans = np.clip(d.intervals, start, end)
        threshold = d.threshold[some] if isinstance(d.threshold, np.ndarray) and len(d.threshold) == n else d.threshold
        details = {name: x[some] if len(x) == n else x for name, x in d.details.items()}
        if "spectrogram" in details:
            shown = find_inside(d.details["spectrogram_t"])
            details |= {name: d.details[name][shown] for name in ("spectrogram", "spectrogram_t")}
        return replace(
            d, t=d.t[some], statistic=d.statistic[some], threshold=threshold, mask=d.mask[some],
            intervals=spans[spans[:, 1] > spans[:, 0]], details=details,
        )  # fmt: skip

    def crop_noise(model: NoiseModel) -> NoiseModel:
        def crop_spans(spans: tuple[tuple[float, ...], ...]) -> tuple[Any, ...]:
            return tuple((max(a, start), min(b, end), *more) for a, b, *more in spans if a < end and b >= start)

        weights = {
            name: RowWeights(w.t[find_inside(w.t)], w.weight[find_inside(w.t)]) for name, w in model.weights.items()
        }
        excluded = {name: crop_spans(spans) for name, spans in model.excluded.items()}
        used = {name: crop_spans(spans) for name, spans in model.span_weights.items()}
        stops = crop_spans(model.false_stops)
        turned = tuple(one for one in model.remountings if start <= one.end < end)
        changed = replace(model, weights=weights, excluded=excluded, span_weights=used, false_stops=stops)
        return replace(changed, remountings=turned)

    def crop_arcs(arcs: CarrierArcs) -> CarrierArcs:
        some = (arcs.begin < end) & (arcs.end >= start)
        begin, last = np.maximum(arcs.begin[some], start), np.minimum(arcs.end[some], end)
        return replace(arcs, name=arcs.name[some], begin=begin, end=last, integer=arcs.integer[some])

    some, last = find_inside(solution.t), float(np.nextafter(end, -np.inf))
    own = slice(int(some[0]), int(some[-1]) + 1)
    covariance = solution.covariance[own].copy()
    return replace(
        solution,
        t=solution.t[some],
        states=solution.states[some],
        covariance=covariance,
        parameters={name: crop_parameter(p) for name, p in solution.parameters.items()},
        records={name: crop_record(r) for name, r in solution.records.items()},
        detections=detections or tuple(crop_detection(d) for d in solution.detections),
        excluded=tuple(fault for fault in solution.excluded if start <= fault.t_start < end),
        noise=crop_noise(solution.noise),
        arcs=crop_arcs(solution.arcs),
        fixed=solution.fixed[find_inside(solution.fixed[:, 0])] if len(solution.fixed) else solution.fixed,
        graphs=(),  # which hold everything built for the part, ten times the size of the result
        between=tuple(_Span.of(b, own, covariance, start, last) for b in solution.between if isinstance(b, Dense)),
    )
