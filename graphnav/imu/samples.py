"""IMU rows as pieces of constant rate and force: gaps bridged, periods split at keyframe times."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from graphnav.core.findings import compute_period
from graphnav.core.rotation import Array
from graphnav.core.running import sum_running
from graphnav.recording import Imu

GAP = 1.5  # sample periods between rows above which there is a gap
MANY = 64  # pieces above which an interval is processed apart from shorter ones
_SPANS = 10  # times a gap's length on either side of it: twenty spans determine a variance to a third
_PIECES_AT_ONCE = 40_000  # pieces processed at once: keeps the working arrays in the processor's cache


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


def bridge_gaps(imu: Imu, factor: float = GAP) -> Samples:
    """Fill every gap with one sample: the mean of its neighbours, with the appropriate noise.

    A row covers only one sample period before its stamp. The variance of the mean signal in a gap about that of its
    neighbours is `_measure_bridge_error`. That error lasts for the whole gap of length g, so the equivalent white
    density is the variance times g.
    """
    dt = imu.t[1:] - imu.t[:-1]
    period = compute_period(imu.t)
    gap = np.flatnonzero(dt > factor * period)
    zero = np.broadcast_to(np.zeros(3), (len(imu.t), 3))
    if not len(gap):
        return Samples(imu.t, imu.gyro, imu.accel, zero, zero, float(imu.t[0] - period), np.empty((0, 2)))
    t_fill = imu.t[gap + 1] - period
    length = t_fill - imu.t[gap]
    at = gap + 1  # the added sample precedes the row that ends the gap
    fill = {name: 0.5 * (getattr(imu, name)[gap] + getattr(imu, name)[gap + 1]) for name in ("gyro", "accel")}
    lost = np.maximum(1, np.rint(length / period)).astype(int)
    extra = {name: _measure_bridge_error(getattr(imu, name), gap, lost) * length[:, None] for name in ("gyro", "accel")}
    return Samples(
        t=np.insert(imu.t, at, t_fill),
        gyro=np.insert(imu.gyro, at, fill["gyro"], axis=0),
        accel=np.insert(imu.accel, at, fill["accel"], axis=0),
        extra_gyro=np.insert(zero, at, extra["gyro"], axis=0),
        extra_accel=np.insert(zero, at, extra["accel"], axis=0),
        start=float(imu.t[0] - period),
        bridged=np.stack([imu.t[gap], t_fill], -1),
    )


def _measure_bridge_error(x: Array, gap: Array, lost: Array) -> Array:
    """Error variance of bridging gaps by the mean of their neighbours, axis by axis.

    It is measured where there are rows, as the mean squared error of bridging as many as were lost, and predicted in
    three ways: by that near the gap, for a straight road differs from a curve; by the change across the gap, to whose
    square the error is on average in proportion; and by the level of the neighbours about the mean, in the same way,
    for a signal changes most where it is large. The mean of the three is returned.

    Parameters
    ----------
    x : (N, 3) rows.
    gap : (g,) the row before each gap.
    lost : (g,) rows lost in each.

    Returns
    -------
    (g, 3)
    """
    out = 0.5 * (x[gap + 1] - x[gap]) ** 2
    if len(x) < 3:
        return np.asarray(out)
    sums, mean = sum_running(x), x.mean(axis=0)
    for n in np.unique(lost):
        here = np.flatnonzero(lost == n)
        k = gap[here]
        n = max(1, min(n, len(x) - 2))
        before, after = x[: -n - 1], x[n + 1 :]
        error = ((sums[n + 1 : -1] - sums[1 : -n - 1]) / n - 0.5 * (before + after)) ** 2
        change, level = ((after - before) ** 2).mean(axis=0), ((0.5 * (before + after) - mean) ** 2).mean(axis=0)
        average, total = error.mean(axis=0), sum_running(error)
        first = np.clip([k - (_SPANS + 1) * n, k + 1], 0, len(error))
        last = np.clip([k - n, k + 1 + _SPANS * n], 0, len(error))
        count = (last - first).sum(axis=0)[:, None]
        near = np.where(count > 0, (total[last] - total[first]).sum(axis=0) / np.maximum(count, 1), average)
        for_change, for_level = (np.divide(average, of, out=np.zeros(3), where=of > 0.0) for of in (change, level))
        by_change = (x[k + 1] - x[k]) ** 2 * for_change
        by_level = (0.5 * (x[k + 1] + x[k]) - mean) ** 2 * for_level
        out[here] = (near + by_change + by_level) / 3.0
    return np.asarray(out)


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
