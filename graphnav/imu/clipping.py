"""Clipped peaks of IMU signals: found by their shape, partly restored, and given a larger variance.

A foot turns faster than the usual 300 deg/s range of inertial units, and not all units clip at a round number that
repeats: after temperature compensation a clipped peak is flat to one per cent only. But it is wider than an unclipped
one. A parabolic peak, x = p - c t^2, is within a share b of its height for 2 tau with c tau^2 = b p, and outside of
that, tau' from its middle, it has the slope s = 2 c tau'. So

    q = s tau^2 / (2 tau' b p)

is 1 for a peak, and several where the sides would meet far above. Counted in whole rows, q of a parabola is at most
2.25 (three rows). Ranges may also end softly: a peak that bends over the last few per cent is within 1 % of its height
for only a row or two. So once one peak shows that an axis clips, all its peaks are tested again with b = 3 %.

Within a clipped peak the signal is the cubic that continues both sides with their slopes. The amount added is
uncertain; half of it is taken as 1-sigma: white noise of that effect over the peak.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.imu.samples import Samples
from graphnav.recording import Imu

_RANGE_END = 0.95  # share of the highest reading: a limit that some peaks exceed by more is not the end of the range
_BAND = 0.01  # b
_SOFT_BAND = 0.03  # b of an axis that is known to clip: it may do so softly
_TOO_FLAT = 2.5  # q
_FEWEST_FLAT = 3  # rows of a flat top at least
_LEAST_RANGE = {"gyro": 4.0, "accel": 19.0}  # rad/s, m/s^2: no range ends lower (250 deg/s, 2 g)
_RESTORED_SIGMA = 0.5  # 1-sigma as a share of what is added


@dataclass(frozen=True)
class Peak:
    """A clipped peak: rows `first` to `last` (exclusive) of one axis, and their restored values."""

    first: int
    last: int
    values: Array


def find_cut_peaks(t: Array, x: Array, least: float, highest: Array | None = None) -> list[Peak]:
    """The clipped peaks above `least` of one axis (N,), sampled at times (N,) s.

    `highest` (2,) are the highest readings of the sensor at other times, up and down.
    """
    most = np.zeros(2) if highest is None else highest
    if not (sure := _find_flat(t, x, least, _BAND, most)):
        return []
    soft = _find_flat(t, x, least, _SOFT_BAND, most)
    return soft + [p for p in sure if all(p.last <= q.first or q.last <= p.first for q in soft)]


def _find_flat(t: Array, x: Array, least: float, band: float, highest: Array) -> list[Peak]:
    """The peaks that are within `band` of their height for longer than their slopes explain."""
    found = []
    for sign, most in zip((1.0, -1.0), highest, strict=True):
        y = sign * x
        limit = max(_RANGE_END * max(float(y.max(initial=0.0)), float(most)), least)
        high = np.flatnonzero(np.diff(np.r_[False, y >= limit, False].astype(int)))
        for begin, end in zip(high[::2], high[1::2], strict=True):
            top = y[begin:end].max()
            rows = begin + np.flatnonzero(y[begin:end] >= (1.0 - band) * top)
            first, last = int(rows[0]), int(rows[-1]) + 1
            if last - first < _FEWEST_FLAT or first < 2 or last + 2 > len(y):
                continue
            up = (y[first - 1] - y[first - 2]) / (t[first - 1] - t[first - 2])
            down = (y[last] - y[last + 1]) / (t[last + 1] - t[last])
            step = (t[last] - t[first - 1]) / (last + 1 - first)
            half = 0.5 * (last - first) * step
            if min(up, down) * half**2 < _TOO_FLAT * 2.0 * (half + 1.5 * step) * band * top:
                continue
            from scipy.interpolate import CubicHermiteSpline  # few recordings need it, and the import takes long

            curve = CubicHermiteSpline(t[[first - 1, last]], y[[first - 1, last]], [up, -down])
            found.append(Peak(first, last, sign * np.maximum(curve(t[first:last]), y[first:last])))
    return found


def find_highest(imu: Imu) -> Array:
    """(2, 3, 2) highest readings of gyro and accelerometer in the sensors' own axes, up and down."""
    both = (imu.gyro @ imu.R_bs, imu.accel @ imu.R_bs)
    return np.array([np.stack([x.max(axis=0, initial=0.0), (-x).max(axis=0, initial=0.0)], -1) for x in both])


def find_first_whole_peak(samples: Samples, R_bs: Array, before: Array, now: Array) -> float:
    """Time (s) of the first peak that seemed clipped by the readings `before`, but is not by those of `now`.

    Infinite if there is none; both are as `highest` returns them.
    """
    first = np.inf
    for k, name in enumerate(_LEAST_RANGE):
        x = getattr(samples, name) @ R_bs
        for axis in range(3):
            old, new = (
                find_cut_peaks(samples.t, x[:, axis], _LEAST_RANGE[name], most[k, axis]) for most in (before, now)
            )
            still = {p.first for p in new}
            first = min([first, *(float(samples.t[p.first]) for p in old if p.first not in still)])
    return first


def restore_peaks(samples: Samples, R_bs: Array, known: Array | None = None) -> tuple[Samples, tuple[str, ...]]:
    """The samples with clipped peaks restored, and notes on them.

    Parameters
    ----------
    R_bs : body from the sensors' own axes.
    known : as `highest` says, what they have read at other times.
    """
    notes = Notes()
    out = samples
    for k, (name, what, unit) in enumerate((("gyro", "gyro", "rad/s"), ("accel", "accelerometer", "m/s^2"))):
        x, cut = getattr(samples, name) @ R_bs, False
        extra = getattr(samples, f"extra_{name}").copy()
        for axis in range(3):
            peaks = find_cut_peaks(samples.t, x[:, axis], _LEAST_RANGE[name], None if known is None else known[k, axis])
            if not peaks:
                continue
            cut = True
            limit = max(float(np.max(np.abs(x[p.first : p.last, axis]))) for p in peaks)
            for p in peaks:
                rows = slice(p.first, p.last)
                T = samples.t[rows] - samples.t[p.first - 1 : p.last - 1]
                added = float(np.sum((p.values - x[rows, axis]) * T))
                extra[rows] += (_RESTORED_SIGMA * added) ** 2 / T.sum()
                x[rows, axis] = p.values
            notes.add(
                "imu.clipped",
                f"{what} {'xyz'[axis]} (file axes) is clipped at {limit:.3g} {unit}: "
                f"{format_count(len(peaks), 'peak')} restored from the flanks",
            )
        if cut:
            x = x @ R_bs.T
            out = replace(out, gyro=x, extra_gyro=extra) if name == "gyro" else replace(out, accel=x, extra_accel=extra)
    return out, tuple(notes)
