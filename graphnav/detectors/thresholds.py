"""Thresholds from the recording itself: the valley between stationary and moving windows.

The logarithm of a statistic falls into two populations if a recording contains both (Kittler and Illingworth 1986 split
images in this way): stationary windows close together at the level of sensor noise, moving ones higher and spread
widely. Few lie between, because braking and starting take little time. Without a valley, as in a recording that only
stands or never does, there is no split.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.detectors.base import mask_within
from graphnav.detectors.scene import Scene

_TINY = 1e-300
SHORTEST_POPULATION = 1.0  # s, smallest population that counts
MISLABELLED = 0.2  # share of the moving windows that other sensors may mislabel
_TELLS = 0.5  # sum of the shares of wrong decisions of either kind; 1 is a statistic without information
MISTAKEN = 0.05  # share of the moving windows that may be mislabelled
_BIN = 0.1  # decades
_SMOOTHING = np.array([0.05, 0.25, 0.4, 0.25, 0.05])  # smoothing, bins
_DEPTH = 4.0  # ratio of both sides to a valley
_SMALL_POPULATION = 10.0  # times the fewest values: a smaller population must be separated by more than chance
_EMPTY_BINS = 4  # empty bins that this takes


def find_valley(log_values: Array, low: float, high: float, fewest: int) -> float | None:
    """Middle of the lowest part of the density of `log_values` between low and high; None without a clear valley.

    Parameters
    ----------
    log_values : (N,) decimal logarithms; what is not finite is left out.
    low, high : where the valley may lie.
    fewest : values on either side for a population to count.
    """
    x = log_values[np.isfinite(log_values)]
    if len(x) < 2 * fewest or not low < high:
        return None
    edges = np.arange(np.floor(min(low, x.min()) / _BIN) - 3, np.ceil(max(high, x.max()) / _BIN) + 4) * _BIN
    density = np.convolve(np.histogram(x, edges)[0], _SMOOTHING, mode="same")
    middle = 0.5 * (edges[1:] + edges[:-1])
    inside = np.flatnonzero((middle >= low) & (middle <= high))
    if not len(inside):
        return None
    # the maximum on the left and on the right of each bin
    left, right = np.maximum.accumulate(density), np.maximum.accumulate(density[::-1])[::-1]
    contrast = np.minimum(left, right)[inside] / np.maximum(density[inside], 0.5)
    lowest = np.flatnonzero(contrast >= contrast.max() * 0.99)
    # the middle of a wide valley
    bottom = inside[lowest[len(lowest) // 2]]
    below = x < middle[bottom]
    smaller = min(below.sum(), (~below).sum())
    if contrast.max() < _DEPTH or smaller < fewest:
        return None
    if smaller < _SMALL_POPULATION * fewest and len(lowest) < _EMPTY_BINS:
        return None
    return float(middle[bottom])


def log_statistic(statistic: Array) -> Array:
    """log10 of a statistic; zero becomes very small, NaN stays."""
    return np.log10(np.maximum(statistic, _TINY))


def choose_threshold(
    scene: Scene, name: str, t: Array, half: float, values: Array, least: float, most: float
) -> tuple[float, tuple[str, ...]]:
    """Threshold of a statistic that decides alone, and notes on it.

    The valley between stationary and moving windows if there is one. Otherwise, where odometer or GNSS show motion, the
    threshold that best separates it from the rest (which may contain unseen motion, so the separation must be good), or
    half of the quietest twentieth of it; and `most` where nothing moves. With an IMU alone it is `least`: an engine
    that idles throughout then hides rest.

    Parameters
    ----------
    t, values : (W,) centres of the windows, s, and the statistic; half : s of a window on either side.
    least : what noise alone may make of it.
    most : what an engine may make of it that idles as strongly as engines do.
    """
    x = log_statistic(values)
    step = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    moves = mask_within(t, scene.certain, half) & np.isfinite(x)
    split = find_valley(x, float(np.log10(least)), float(np.log10(most)), max(2, round(SHORTEST_POPULATION / step)))
    if split is not None and not (moves.any() and np.mean(x[moves] < split) > MISLABELLED):
        return max(least, float(10.0**split)), ()
    rests = ~mask_within(t, scene.certain, -half) & np.isfinite(x)  # no part of it is certain to move
    if moves.any() and rests.any():
        found, wrong = find_fewest_errors(values[rests], values[moves], least)
        if wrong < _TELLS:
            return min(found, most), ()
    if moves.any():
        return float(np.clip(0.5 * 10.0 ** np.quantile(x[moves], MISTAKEN), least, most)), ()
    if scene.known:
        return most, ()
    return least, (
        Note(
            "detectors.threshold",
            f"{name}: standing and moving windows cannot be separated, so only sensor noise counts as rest",
        ),
    )


def find_fewest_errors(still: Array, moving: Array, least: float) -> tuple[float, float]:
    """Threshold, at least `least`, with the smallest sum of the shares of stationary windows called moving and the
    reverse.

    Among equals the middle one by logarithm. The second number returned is that sum.
    """
    if not len(still):
        return least, 1.0
    x, y = np.sort(log_statistic(still)), np.sort(log_statistic(moving))
    if not len(y):
        return max(least, float(10.0 ** x[-1]) * 2.0), 0.0
    grid = np.linspace(min(x[0], y[0]), max(x[-1], y[-1]), 400)
    wrong = 1.0 - np.searchsorted(x, grid) / len(x) + np.searchsorted(y, grid) / len(y)
    best = np.flatnonzero(wrong <= wrong.min() + 1e-12)
    return max(least, float(10.0 ** grid[best[len(best) // 2]])), float(wrong.min())
