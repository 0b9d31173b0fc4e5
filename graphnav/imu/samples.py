"""IMU rows as pieces of constant rate and force: gaps bridged, periods split at keyframe times."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from graphnav.core.findings import compute_period, find_gap_limit
from graphnav.core.rotation import Array
from graphnav.imu.bridging import fill_gaps
from graphnav.recording import Imu

MANY = 64  # pieces above which an interval is processed apart from shorter ones
_PIECES_AT_ONCE = 40_000  # pieces processed at once: keeps the working arrays in the processor's cache
# the last result with gaps, as long as its IMU lives: an alignment and the problem after it ask for the same
_last: list[tuple[weakref.ref[Imu], int, Samples]] = []


@dataclass(frozen=True)
class Samples:
    """IMU samples as pieces of constant rate and force, with gaps made explicit.

    `extra_gyro`, `extra_accel` are white densities squared ((rad/s)^2/Hz, (m/s^2)^2/Hz) along the body's axes, in
    addition to the sensor's own: where a gap is bridged, and from `graphnav.imu.unresolved` for a foot.
    """

    t: Array  # (N,) end of each sample's period
    gyro: Array  # (N, 3)
    accel: Array  # (N, 3)
    extra_gyro: Array  # (N, 3)
    extra_accel: Array  # (N, 3)
    start: float  # start of the first period
    bridged: Array  # (g, 2) start and end of every bridged gap, s

    def select_between(self, begin: float, end: float) -> Samples:
        """The samples whose periods overlap the span between two times (s), as views."""
        k = slice(np.searchsorted(self.t, begin, side="left"), np.searchsorted(self.t, end, side="left") + 1)
        rows = {name: getattr(self, name)[k] for name in ("t", "gyro", "accel", "extra_gyro", "extra_accel")}
        return replace(self, **rows)


def bridge_gaps(imu: Imu, begin: float = -np.inf) -> Samples:
    """Fill every gap with the rows that `graphnav.imu.bridging` expects there, with the appropriate noise.

    A row covers only one sample period before its stamp. The error of the mean signal in a gap of length g lasts for
    the whole gap, so the equivalent white density is its variance times g. Gaps that end before `begin` (s) are left as
    they are, for what is integrated from there.
    """
    dt = imu.t[1:] - imu.t[:-1]
    period = compute_period(imu.t)
    every = np.flatnonzero(dt > find_gap_limit(imu.t))
    gap = every[imu.t[every + 1] >= begin]
    zero = np.broadcast_to(np.zeros(3), (len(imu.t), 3))
    if not len(gap):
        return Samples(imu.t, imu.gyro, imu.accel, zero, zero, float(imu.t[0] - period), np.empty((0, 2)))
    for known, first, samples in _last:
        if known() is imu and first == gap[0]:
            return samples
    t_fill = imu.t[gap + 1] - period
    length = t_fill - imu.t[gap]
    lost = np.maximum(1, np.rint(length / period)).astype(int)
    rows, variance = fill_gaps(np.hstack([imu.gyro, imu.accel]), gap, lost, every)
    filled, extra = np.concatenate(rows), np.repeat(variance * length[:, None], lost, axis=0)
    at = np.repeat(gap + 1, lost)  # added samples precede the row that ends the gap
    part = np.concatenate([np.arange(1, n + 1) / n for n in lost])
    samples = Samples(
        t=np.insert(imu.t, at, np.repeat(imu.t[gap], lost) + part * np.repeat(length, lost)),
        gyro=np.insert(imu.gyro, at, filled[:, :3], axis=0),
        accel=np.insert(imu.accel, at, filled[:, 3:], axis=0),
        extra_gyro=np.insert(zero, at, extra[:, :3], axis=0),
        extra_accel=np.insert(zero, at, extra[:, 3:], axis=0),
        start=float(imu.t[0] - period),
        bridged=np.stack([imu.t[gap], t_fill], -1),
    )
    _last[:] = [(weakref.ref(imu, lambda _: _last.clear()), int(gap[0]), samples)]
    return samples


@dataclass(frozen=True)
class Pieces:
    """Sample periods split at keyframes: interval i has the pieces first[i] .. first[i] + count[i]."""

    edges: Array  # (pieces + 1,) s
    dt: Array
    index: Array  # the sample each piece belongs to
    first: Array
    count: Array

    def pad(self, rows: Array) -> tuple[Array, Array]:
        """(L, n) durations and sample indices of some intervals, padded with pieces of no duration."""
        piece = np.arange(int(self.count[rows].max()))[:, None]
        inside = piece < self.count[rows]
        at = np.minimum(self.first[rows] + piece, len(self.dt) - 1)
        return np.where(inside, self.dt[at], 0.0), self.index[at]


def cut_pieces(samples: Samples, t: Array, extra: Array | None = None) -> Pieces:
    """Pieces between keyframes t, also split at the `extra` times."""
    inner = samples.t[(samples.t > t[0]) & (samples.t < t[-1])]
    # nearly sorted already, which a stable sort exploits
    edges = np.sort(np.concatenate([inner, t] if extra is None else [inner, t, extra]), kind="stable")
    dt = edges[1:] - edges[:-1]
    if dt.size and dt.min() <= 0.0:
        edges = edges[np.append(True, dt > 0)]
        dt = edges[1:] - edges[:-1]
    index = np.minimum(np.searchsorted(samples.t, edges[1:], side="left"), len(samples.t) - 1)
    starts = np.searchsorted(edges, t)
    return Pieces(edges, dt, index, starts[:-1], starts[1:] - starts[:-1])


def group_intervals(count: Array) -> Iterator[Array]:
    """Group intervals of similar length, so that little is padded."""
    order = np.argsort(count, kind="stable")
    start = 0
    while start < len(order):
        # the longest of the group sets its width; lengths ascend, so the end is found by bisection
        lo, hi = start + 1, len(order)
        while lo < hi:
            mid = (lo + hi + 1) // 2
            fits = (mid - start) * count[order[mid - 1]] <= _PIECES_AT_ONCE
            alike = count[order[mid - 1]] <= 2 * count[order[start]] + 16
            alike &= (count[order[mid - 1]] >= MANY) == (count[order[start]] >= MANY)
            lo, hi = (mid, hi) if fits and alike else (lo, mid - 1)
        yield order[start:lo]
        start = lo
