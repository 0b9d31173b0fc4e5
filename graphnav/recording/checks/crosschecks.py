"""Comparison of the sensors of one drive: clock, axes and units by regressions.

Changes of GNSS speed are regressed on the integrated force, changes of course on the integrated rate, both on all three
axes. The correlation as a function of a time shift gives the clock error whatever the axes; the coefficients at the
best shift give the axes and the scale whatever was assumed of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array, wrap
from graphnav.recording import Imu, Odometer
from graphnav.recording.checks import lags as lags_of_clocks
from graphnav.recording.checks.lags import Lags
from graphnav.recording.checks.tracks import Track
from graphnav.recording.plausibility.readings import RARE

Index = NDArray[Any]  # of row numbers

MIN_PAIRS = 20
MIN_SPEED = 3.0  # m/s, below which a course is undefined
_FASTEST_CHANGE = 8.0  # m/s^2; a larger acceleration is an error of the fix
_CHANGES = 0.25  # m/s, rms change of speed, below which a regression on it determines nothing
_NEAR_CLOCKS = 5.0  # s, clock error up to which is searched first
LARGEST_SHIFT = 30.0  # s, largest clock error searched for


@dataclass(frozen=True)
class Fit:
    """One regression: y = coefficients @ x, with x taken `lag` seconds later than y."""

    lag: float  # s
    spread: float  # s, 1-sigma of the lag (`graphnav.recording.checks.lags`)
    correlation: float
    coefficients: Array  # (m,)
    seconds: int = 0  # in which it has rows: changes over a second that do not overlap

    @property
    def relative_sigma(self) -> float:
        """1-sigma of the size of the coefficients, as a share of it."""
        freedom = self.seconds - len(self.coefficients) - 1
        return (
            float(np.sqrt((1.0 / self.correlation**2 - 1.0) / freedom)) if self.correlation and freedom > 0 else np.inf
        )


def _compute_mean(x: Array) -> Array:
    """Mean row of a long array, ten times faster than `x.mean(axis=0)`."""
    return np.asarray(np.full(len(x), 1.0 / len(x)) @ x)


def _integrate_means(t: Array, rate: Array, twice: bool) -> Array:
    """Integral, at the ends of the periods, of rows that are means over them, minus their mean; or its own integral.

    Axis by axis and in place: for a day each temporary array takes a hundred megabytes.
    """
    dt = np.diff(t, prepend=2 * t[0] - t[1])
    out = np.empty(rate.shape)
    for k, mean in enumerate(_compute_mean(rate)):  # only changes matter; keeps the second integral small
        change = rate[:, k] - mean
        change *= dt
        first = np.cumsum(change)
        if twice:
            change *= -0.5
            change += first
            change *= dt
            np.cumsum(change, out=first)
        out[:, k] = first
    return out


def _make_sampler(t: Array, rate: Array) -> Callable[[Array, Array], Array]:
    """Sampler mean(at, width) of the integral of `rate`; width 0 gives the value at that time."""
    integral = cache(lambda twice: _integrate_means(t, rate, twice))
    period = (t[-1] - t[0]) / (len(t) - 1)

    def take_columns(at: Array, values: Array) -> Array:
        # rows are evenly spaced except after gaps
        k = np.clip(np.ceil((at - t[0]) / period).astype(int), 1, len(t) - 1)
        off = (t[k - 1] > at) | (t[k] < at)
        if off.any():
            k[off] = np.clip(np.searchsorted(t, at[off]), 1, len(t) - 1)
        s = np.clip((at - t[k - 1]) / (t[k] - t[k - 1]), 0.0, 1.0)[:, None]
        return np.asarray((1.0 - s) * values.take(k - 1, axis=0) + s * values.take(k, axis=0))

    def take_means(at: Array, width: Array) -> Array:
        if not width.any():
            return take_columns(at, integral(False))
        second = integral(True)
        return (take_columns(at + width / 2, second) - take_columns(at - width / 2, second)) / width[:, None]

    return take_means


def _pair_times(track: Track) -> tuple[Index, Index]:
    """Rows about a second apart."""
    m = max(1, round(1.0 / track.period))
    i = np.arange(len(track.t) - m)
    near = track.t[i + m] - track.t[i] < 1.5 * max(1.0, m * track.period)
    return i[near], i[near] + m


def _pair_possible(track: Track) -> tuple[Index, Index, Array]:
    """Rows a second apart without fixes that jump (back and forth leaves speeds alike), and changes of speed, m/s."""
    i, j = _pair_times(track)
    change, most = np.hypot(*(track.v[j] - track.v[i])[:, :2].T), _FASTEST_CHANGE * (track.t[j] - track.t[i])
    y = track.speed[j] - track.speed[i]
    real = (np.abs(y) < most) & (change < np.maximum(most, 5.0 * np.median(change) if len(change) else 0.0))
    return i[real], j[real], y[real]


def _regress(x: Array, y: Array) -> tuple[float, Array]:
    x, y = x - x.mean(0), y - y.mean()
    b = np.asarray(np.linalg.lstsq(x, y, rcond=None)[0], dtype=float)
    prediction, norm = x @ b, np.linalg.norm(y)  # the sign is in b: a reversed axis has the same correlation
    scale = np.linalg.norm(prediction) * norm
    return (float(prediction @ y / scale) if scale > 0 else 0.0), b


def _correlate_each(x: Array, y: Array) -> Array:
    """The correlation of a regression of y (K,) on each of several sets of regressors (L, K, m)."""
    x, y = x - x.mean(1, keepdims=True), y - y.mean()
    prediction = (x @ lags_of_clocks.regress_each(x, y)[..., None])[..., 0]
    scale = np.linalg.norm(prediction, axis=1) * np.linalg.norm(y)
    return np.asarray(np.where(scale > 0.0, prediction @ y / np.where(scale > 0.0, scale, 1.0), 0.0))


def regress_inliers(x: Array, y: Array) -> tuple[float, Array]:
    """`_regress` without rows beyond 5 sigma (by the median), repeated twice: spikes of fixes hide a good fit."""
    x, y = x - np.median(x, axis=0), y - np.median(y)
    keep = np.ones(len(y), dtype=bool)
    for _ in range(2):
        _, b = _regress(x[keep], y[keep])
        off = np.abs(y - x @ b)
        keep = off <= 5.0 * np.median(off) / 0.6745
    return _regress(x[keep], y[keep]) if keep.sum() >= MIN_PAIRS else (0.0, b)


def _search_shift(
    t: Array, y: Array, x_at: lags_of_clocks.Regressors, span: Array, valid: Callable[[float], Array]
) -> Fit:
    """The time shift at which x explains y best; `x_at(rows, lags)`, and `valid(lag)` a mask of the rows."""
    every = np.arange(len(y))

    def correlate_all(rows: Index, lags: Array) -> Array:
        found = []
        for r, x in lags_of_clocks.sample_shared(lags, rows, x_at, valid):
            found.append(np.zeros(len(x)) if len(r) < MIN_PAIRS else _correlate_each(x, y[r]))
        return np.concatenate(found)

    def correlate(lag: float, rows: Index) -> float:
        return float(correlate_all(rows, np.array([lag]))[0])

    few = every[:: max(1, len(y) // 800)]
    many = every[:: max(1, len(y) // 4000)]
    # changes over a second are correlated for about as long: every fourth shift shows where the best fit may be
    lags = np.arange(-_NEAR_CLOCKS, _NEAR_CLOCKS + 0.01, 0.1)
    rough = np.argsort(correlate_all(few, lags[::4]))[-3:] * 4
    close = np.unique(np.clip(rough[:, None] + np.arange(-4, 5), 0, len(lags) - 1))
    c = np.full(len(lags), -np.inf)
    c[close] = correlate_all(few, lags[close])
    near = lags_of_clocks.find_lowest(lags, -c)
    coarse, reached = near, correlate(near, few)
    # larger shifts only if no small one explains y, and only for a clearly better fit, for there are many of them
    reach = min(LARGEST_SHIFT, 0.3 * (span[-1] - span[0]))
    if reached < 0.6 and reach > _NEAR_CLOCKS:
        wide = np.arange(-reach, reach + 0.1, 0.2)
        far = lags_of_clocks.find_lowest(wide, -correlate_all(few, wide))
        if abs(far) > _NEAR_CLOCKS and correlate(far, few) > reached + 0.15:
            coarse = far
    lag, spread = lags_of_clocks.refine_lag(t, y, x_at, valid, many, coarse, MIN_PAIRS)

    def regress(lag: float) -> tuple[float, Array]:
        rows = every[valid(lag)]
        return regress_inliers(x_at(rows, lag), y[rows]) if len(rows) >= MIN_PAIRS else (0.0, np.zeros(1))

    r, b = regress(lag)
    if abs(lag) < 2.0 * spread:  # the data do not determine it
        unshifted, of_it = regress(0.0)
        if unshifted > r:
            lag, r, b = 0.0, unshifted, of_it
    seconds = len(np.unique(np.floor(t[valid(lag)])))
    # a correlation that white rows would reach at one of so many lags is none
    trials = 2.0 * (_NEAR_CLOCKS if abs(lag) <= _NEAR_CLOCKS else reach)
    freedom = seconds - len(b) - 1
    from scipy.special import betainc  # which takes a fifth of a second to import

    chance = betainc(0.5 * freedom, 0.5 * len(b), 1.0 - r * r) if freedom > 0 else 1.0
    return Fit(lag, spread, r if trials * chance < RARE else 0.0, b, seconds)


def _fit_imu(imu: Imu, rate: Array, track: Track, i: Index, j: Index, y: Array) -> Fit | None:
    if len(y) < MIN_PAIRS:
        return None
    mean = _make_sampler(imu.t, rate)
    ti, tj, wi, wj = track.t[i], track.t[j], track.width[i], track.width[j]

    def sample_x(rows: Index, lag: Lags) -> Array:
        used = np.zeros(len(track.t), dtype=bool)  # most ends of one pair begin another
        used[i[rows]] = used[j[rows]] = True
        place = np.cumsum(used) - 1
        at = np.add.outer(lag, track.t[used])
        values = mean(at.ravel(), np.broadcast_to(track.width[used], at.shape).ravel()).reshape(*at.shape, -1)
        return np.asarray(values.take(place[j[rows]], axis=-2) - values.take(place[i[rows]], axis=-2))

    def mask_valid(lag: float) -> Array:
        return (ti + lag - wi / 2 > imu.t[0]) & (tj + lag + wj / 2 < imu.t[-1])

    return _search_shift(0.5 * (ti + tj), y, sample_x, track.t, mask_valid)


def find_up(imu: Imu) -> Array:
    """Unit vector of the mean force: up, in body axes as loaded, (3,)."""
    f = _compute_mean(imu.accel)
    return f / np.linalg.norm(f) if f.any() else np.array([0.0, 0.0, 1.0])


def fit_forward(imu: Imu, track: Track) -> Fit | None:
    """Regression of changes of GNSS speed on integrated level force; coefficients are the forward direction in body
    axes.

    Level is perpendicular to the mean force, so no axes need be known. None where speed changes too little.
    """
    i, j, y = _pair_possible(track)
    if len(y) < MIN_PAIRS or y.std() < _CHANGES:
        return None
    level = np.linalg.svd(find_up(imu)[None, :])[2][1:]  # (2, 3)
    fit = _fit_imu(imu, imu.accel @ level.T, track, i, j, y)
    if fit is None or len(fit.coefficients) != len(level):  # no common time
        return None
    return replace(fit, coefficients=fit.coefficients @ level)


def fit_force(imu: Imu, track: Track) -> Fit | None:
    """Regression of the same on the whole force, from which gravity may have been removed. Coefficients (3,)."""
    i, j, y = _pair_possible(track)
    fit = _fit_imu(imu, imu.accel, track, i, j, y) if len(y) and y.std() >= _CHANGES else None
    return fit if fit is not None and len(fit.coefficients) == 3 else None


def fit_along(imu: Imu, track: Track) -> Fit | None:
    """Regression on the force along the stated forward axis alone, (1,): whether the stated axes explain the speed."""
    i, j, y = _pair_possible(track)
    return _fit_imu(imu, imu.accel[:, 1:2], track, i, j, y)


def fit_yaw_rate(imu: Imu, track: Track) -> Fit | None:
    """Regression of changes of course, counter-clockwise, on the integrated rate about the mean force, (1,).

    The coefficient is true over recorded. None without turns.
    """
    i, j = _pair_times(track)
    course = np.arctan2(track.v[:, 1], track.v[:, 0])
    y = wrap(course[j] - course[i])
    speed = np.minimum(track.speed[i], track.speed[j])
    real = (speed > MIN_SPEED) & (np.abs(y) < 1.5 * (track.t[j] - track.t[i]))
    i, j, y = i[real], j[real], y[real]
    if len(y) < MIN_PAIRS or y.std() < 0.04:
        return None
    return _fit_imu(imu, imu.gyro @ find_up(imu)[:, None], track, i, j, y)


def fit_velocity(track: Track, places: Track) -> Fit | None:
    """Regression of changes of speed by positions on those by velocities: delay of velocities; None without changes."""
    i, j, y = _pair_possible(places)
    if len(y) < MIN_PAIRS or y.std() < _CHANGES:
        return None
    t, travelled = track.t, np.zeros((len(track.t), 2))
    travelled[1:] = np.cumsum(0.5 * (track.v[1:, :2] + track.v[:-1, :2]) * np.diff(t)[:, None], axis=0)

    def interpolate_speed(of: Index, lag: Lags) -> Array:
        a, b = (np.add.outer(lag, places.t[of] + side * places.width[of] / 2) for side in (-1.0, 1.0))
        gone = [np.interp(b, t, axis) - np.interp(a, t, axis) for axis in travelled.T]
        return np.asarray(np.hypot(*gone) / places.width[of])

    def sample_x(rows: Index, lag: Lags) -> Array:
        return (interpolate_speed(j[rows], lag) - interpolate_speed(i[rows], lag))[..., None]

    def mask_valid(lag: float) -> Array:
        first, last = places.t[i] - places.width[i] / 2 + lag, places.t[j] + places.width[j] / 2 + lag
        return np.asarray((first > t[0]) & (last < t[-1]))

    return _search_shift(0.5 * (places.t[i] + places.t[j]), y, sample_x, places.t, mask_valid)


def fit_odometer(odometer: Odometer, track: Track) -> tuple[Fit, float] | None:
    """GNSS speed on odometer speed, and the scale (true over recorded, median); None without movement."""
    if len(odometer.t) < 5 or track.speed.std() < 0.5:
        return None
    t = odometer.t
    distance = np.r_[0.0, np.cumsum(0.5 * (odometer.speed[1:] + odometer.speed[:-1]) * np.diff(t))]
    width = np.maximum(track.width, 4.0 * float(np.median(np.diff(t))))

    def sample_x(rows: Index, lag: Lags) -> Array:
        at, w = np.add.outer(lag, track.t[rows]), width[rows]
        return np.asarray((np.interp(at + w / 2, t, distance) - np.interp(at - w / 2, t, distance)) / w)[..., None]

    def mask_valid(lag: float) -> Array:
        inside = (track.t + lag - width / 2 > t[0]) & (track.t + lag + width / 2 < t[-1])
        return inside & usable

    usable = np.ones(len(track.t), dtype=bool)
    every = np.arange(len(track.t))
    inside = mask_valid(0.0)
    if inside.sum() < MIN_PAIRS:
        return None
    # spikes of fixes would bias the fit: leave out what lies far from a first line
    x = sample_x(every, 0.0)[:, 0]
    slope = _regress(x[inside, None], track.speed[inside])[1][0]
    off = track.speed - slope * x
    off = np.abs(off - np.median(off[inside]))
    usable = off < 6.0 * np.median(off[inside]) + 0.5
    fit = _search_shift(track.t, track.speed, sample_x, track.t, mask_valid)
    rows = every[mask_valid(fit.lag)]
    x = sample_x(rows, fit.lag)[:, 0]
    moving = (np.abs(x) > 0.3 * np.abs(x).max()) & (track.speed[rows] > MIN_SPEED)
    if moving.sum() < MIN_PAIRS:
        return None
    return fit, float(np.median(track.speed[rows][moving] / x[moving]))
