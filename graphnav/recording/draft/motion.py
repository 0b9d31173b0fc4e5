"""Two sensors of the same motion: clock offset, unit, and forward direction.

The turn rate about up, of the gyro and of the course over ground, is the same signal whatever the mount: the ratio of
the two is the gyro's unit and, for unrelated clocks, the best agreement gives a rough offset. It is not precise: the
course of a point ahead of the rear axle leads the heading by the distance over the speed.

The accelerations along and across the course are those that the accelerometer measured in its own horizontal plane,
rotated by the angle of the mount: planar vectors as complex numbers, least squares, at the clock offset of best
agreement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array

GRID = 0.1  # s, of the common grid
_MEAN_OVER = 1.0  # s, of the moving mean over everything
_LEAST_SPEED = 3.0  # m/s; below, a course is undefined
_FEWEST_SAMPLES, _TRIMS = 50, 3
_ROUNDED = 0.01  # rad, of a whole turn
_SAME_WAY = 0.2  # rad, of a course from that of the positions
SEARCHED = 3.0  # s, range of the offset of clocks that overlap already


@dataclass(frozen=True)
class Course:
    """Motion over ground on an even grid; turn rate and acceleration are NaN at speeds too low for a course."""

    t: Array  # (K,) s
    speed: Array  # (K,) m/s
    turn: Array  # (K,) rad/s, anticlockwise
    forward: Array  # (K,) m/s^2 along the course
    left: Array  # (K,) m/s^2 across it


@dataclass(frozen=True)
class Lag:
    """Delay of the second signal (s), the correlation there, and the slope of the first over the second."""

    seconds: float
    correlation: float  # its magnitude, for planar vectors
    slope: complex


def compute_course(t: Array, llh: Array, v: Array | None) -> Course:
    """Course and accelerations of fixes: from velocities (N, 2 or 3) where they are known, else from positions."""
    p = LocalFrame(llh[0]).from_llh(llh)
    if v is None or (~np.isnan(v[:, :2]).any(-1)).sum() < 2:
        keep = np.concatenate([[True], np.diff(t) > 0])
        t, p = t[keep], p[keep]
        grid = np.arange(t[0], t[-1], GRID)
        east, north = (
            compute_moving_mean(_differentiate(compute_moving_mean(np.interp(grid, t, p[:, k])))) for k in (0, 1)
        )
    else:
        known = ~np.isnan(v[:, :2]).any(-1)
        t, v = t[known], v[known]
        grid = np.arange(t[0], t[-1], GRID)
        east, north = (compute_moving_mean(np.interp(grid, t, v[:, k])) for k in (0, 1))
    # unknown inside gaps, and where the means extend into them or beyond an end
    gap = compute_moving_mean(_mask_gaps(grid, t).astype(float), 4.0 * _MEAN_OVER) > 0.0
    gap |= (grid < grid[0] + 2.0 * _MEAN_OVER) | (grid > grid[-1] - 2.0 * _MEAN_OVER)
    speed = np.hypot(east, north)
    ae, an = _differentiate(east), _differentiate(north)
    slow = (speed < _LEAST_SPEED) | gap
    safe = np.where(slow, np.inf, speed)
    forward, left = (east * ae + north * an) / safe, (east * an - north * ae) / safe
    turn = left / safe
    for x in (forward, left, turn):
        x[slow] = np.nan
    return Course(grid, np.where(gap, np.nan, speed), turn, forward, left)


def is_course_in_radians(lat: Array, lon: Array, course: Array) -> bool:
    """Whether courses (N,) are in rad where places (N,), deg, move as they do then, and not as they do in deg."""
    known = np.isfinite(course)
    if not known.any() or np.abs(course[known]).max() > 2.0 * np.pi + _ROUNDED:
        return False
    north, east = np.diff(lat), np.diff(lon) * np.cos(np.radians(lat[1:]))
    step = np.hypot(north, east)
    moving = known[1:] & (step > 0.5 * step.max())
    along = np.arctan2(east, north)[moving]
    in_rad, in_deg = (
        float(np.median(np.abs((c[1:][moving] - along + np.pi) % (2.0 * np.pi) - np.pi)))
        for c in (course, np.radians(course))
    )
    return in_rad < _SAME_WAY < in_deg


def resample_on_grid(t: Array, x: Array) -> tuple[Array, Array]:
    """Samples (N, k) as means over a second on an even grid; NaN inside gaps."""
    cumulative = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x[1:] * np.diff(t)[:, None], axis=0)])
    grid = np.arange(t[0] + _MEAN_OVER / 2, t[-1] - _MEAN_OVER / 2, GRID)
    if not len(grid):
        return grid, np.empty((0, x.shape[1]))
    both = [np.stack([np.interp(grid + side * _MEAN_OVER / 2, t, c) for c in cumulative.T], -1) for side in (-1, 1)]
    out = (both[1] - both[0]) / _MEAN_OVER
    out[_mask_gaps(grid, t)] = np.nan
    return grid, out


def _differentiate(x: Array) -> Array:
    """Derivative of values on the grid; NaN of a single one."""
    return np.gradient(x, GRID) if len(x) > 1 else np.full(len(x), np.nan)


def compute_moving_mean(x: Array, window: float = _MEAN_OVER) -> Array:
    """Moving mean over some seconds, of the grid."""
    if not len(x):
        return x
    n = 2 * round(window / GRID / 2)
    kernel = np.ones(n + 1)
    kernel[[0, -1]] = 0.5
    within = slice(n // 2, n // 2 + len(x))  # "same" has the length of the longer, which may be the kernel
    return np.convolve(x, kernel)[within] / np.convolve(np.ones(len(x)), kernel)[within]


def find_lag(t: Array, x: Array, u: Array, y: Array, weight: Array | None = None, anywhere: bool = False) -> Lag | None:
    """Delay of `y` at `u` behind `x` at `t` (both on grids of `GRID`) at the best agreement; None without one.

    Real signals, or planar vectors as complex numbers, whose `Lag.slope` then gives the rotation of `x` against `y`.
    Outlying samples of `y` at the best lag are left out, and the search is repeated.

    Parameters
    ----------
    weight
        Of the samples of `y`: one over their variance.
    anywhere
        Look over the whole length instead of a few seconds: the clocks have nothing to do with each other. Only for
        real signals.
    """
    if len(t) < 50 or len(u) < 50:
        return None
    apart = float(u[0] - t[0])
    a, b = _resample_evenly(t, x), _resample_evenly(u, y)
    w = np.ones(len(b)) if weight is None else np.nan_to_num(_resample_evenly(u, weight))
    if anywhere:
        shifts, r, slope = _list_all_lags(a, b, w)
    else:
        shifts = np.arange(np.ceil((-SEARCHED - apart) / GRID), np.floor((SEARCHED - apart) / GRID) + 1).astype(int)
        r, slope = _list_lags(a, b, w, shifts)
        for _ in range(_TRIMS):
            if not np.isfinite(r).any():
                return None
            best = int(np.nanargmax(np.abs(r)))
            b = _trim(a, b, w, int(shifts[best]))
            r, slope = _list_lags(a, b, w, shifts)
    if not np.isfinite(r).any():
        return None
    best = int(np.nanargmax(np.abs(r)))
    peak = 0.0  # of the parabola through the best and its neighbours, in steps
    if 0 < best < len(r) - 1 and np.isfinite(r[best - 1 : best + 2]).all():
        left, top, right = np.abs(r[best - 1 : best + 2])
        bend = left - 2 * top + right
        peak = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return Lag(float(apart + (shifts[best] + peak) * GRID), float(r[best]), complex(slope[best]))


def filter_band(x: Array) -> Array:
    """Smoothed over a second, without changes slower than ten seconds, which slopes of the road would enter."""
    known = np.isfinite(x)
    filled = np.where(known, x, 0.0)
    weight = compute_moving_mean(known.astype(float), 10.0)
    slow = compute_moving_mean(filled, 10.0) / np.maximum(weight, 1e-9)
    out = compute_moving_mean(np.where(known, x - slow, 0.0)) / np.maximum(
        compute_moving_mean(known.astype(float)), 1e-9
    )
    return np.where(known, out, np.nan)


def _resample_evenly(t: Array, x: Array) -> Array:
    grid = t[0] + GRID * np.arange(round((t[-1] - t[0]) / GRID) + 1)
    known = np.isfinite(x)
    if not known.any():
        return np.full(len(grid), np.nan)
    out = np.interp(grid, t[known], x[known])
    k = np.clip(np.round((grid - t[0]) / GRID).astype(int), 0, len(x) - 1)
    out[~np.isfinite(x[k])] = np.nan
    return out


def _pair_samples(a: Array, b: Array, w: Array, shift: int) -> tuple[Array, Array, Array, Array]:
    """a[k], b[k + shift] and its weight where all are known, minus their weighted means; and which of b they are."""
    lo, hi = max(0, -shift), min(len(a), len(b) - shift)
    if hi - lo < _FEWEST_SAMPLES:
        return np.empty(0), np.empty(0), np.empty(0), np.empty(0, int)
    x, y, v = a[lo:hi], b[lo + shift : hi + shift], w[lo + shift : hi + shift]
    ok = np.flatnonzero(np.isfinite(x) & np.isfinite(y) & (v > 0))
    if len(ok) < _FEWEST_SAMPLES:
        return np.empty(0), np.empty(0), np.empty(0), np.empty(0, int)
    x, y, v = x[ok], y[ok], v[ok] / v[ok].sum()
    return x - v @ x, y - v @ y, v, ok + lo + shift


def _list_lags(a: Array, b: Array, w: Array, shifts: Array) -> tuple[Array, Array]:
    """Correlation, and slope of a over b, at every shift."""
    r, slope = np.full(len(shifts), np.nan), np.full(len(shifts), np.nan, dtype=complex)
    for k, shift in enumerate(shifts):
        x, y, v, _ = _pair_samples(a, b, w, int(shift))
        if not len(v):
            continue
        xx, yy, xy = float(v @ np.abs(x) ** 2), float(v @ np.abs(y) ** 2), v @ (x * np.conj(y))
        if xx > 0 and yy > 0:
            r[k] = (np.abs(xy) if np.iscomplexobj(xy) else xy) / np.sqrt(xx * yy)
            slope[k] = xy / yy
    return r, slope


def _trim(a: Array, b: Array, w: Array, shift: int) -> Array:
    """b without the outlying samples at a shift: those beyond four robust sigmas of the weighted residuals.

    The residuals are those of `b` as a multiple of `a`, whose sensor is an IMU's: outliers of `b` then hardly move it.
    """
    x, y, v, at = _pair_samples(a, b, w, shift)
    factor = v @ (y * np.conj(x)) / (v @ np.abs(x) ** 2)
    residual = np.abs((y - factor * x) * np.sqrt(v))
    out = b.copy()
    out[at[residual > 4.0 * 1.4826 * np.median(residual)]] = np.nan
    return out


def _list_all_lags(a: Array, b: Array, w: Array) -> tuple[Array, Array, Array]:
    """Correlations at every shift, by FFT, unknown samples as zero; only where half of the shorter signal overlaps."""
    wa, wb = np.isfinite(a).astype(float), np.where(np.isfinite(b), w, 0.0)
    a, b = np.nan_to_num(a), np.nan_to_num(b)
    n = 1 << int(np.ceil(np.log2(len(a) + len(b))))

    def correlate(x: Array, y: Array) -> Array:
        c = np.fft.irfft(np.conj(np.fft.rfft(x, n)) * np.fft.rfft(y, n), n)
        return np.concatenate([c[-(len(a) - 1) :], c[: len(b)]])

    shifts = np.arange(-(len(a) - 1), len(b))
    xy, xx, yy, seen = correlate(a, b * wb), correlate(a * a, wb), correlate(wa, b * b * wb), correlate(wa, wb)
    good = (seen > 0.5 * min(wb.sum(), wb.max() * wa.sum())) & (xx > 1e-12) & (yy > 1e-12)
    with np.errstate(divide="ignore", invalid="ignore"):
        return shifts, np.where(good, xy / np.sqrt(np.abs(xx * yy)), np.nan), np.where(good, xy / yy, np.nan)


def _mask_gaps(grid: Array, t: Array) -> Array:
    """Grid times inside or adjacent to a gap of more than two seconds."""
    k = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    return np.asarray(t[k] - t[k - 1] > 2.0)


def find_odometer_lag(t: Array, speed: Array, felt: tuple[Array, Array]) -> Lag | None:
    """Delay of the wheel speed, by its accelerations against the forward ones of the IMU."""
    if len(t) < 50:
        return None
    grid, forward = resample_on_grid(felt[0], felt[1][:, None])
    even = np.arange(t[0], t[-1], GRID)
    pull = np.gradient(compute_moving_mean(np.interp(even, t, speed)), GRID)
    return find_lag(grid, filter_band(forward[:, 0]), even, filter_band(pull))
