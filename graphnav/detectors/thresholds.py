"""Thresholds from the recording itself: the valley between what is still and what is not.

The logarithm of a statistic of windows falls into two populations if a recording holds both (Kittler and
Illingworth 1986 look for such a split in images): standing windows close together at the sensors' own noise, moving
ones higher and wide. Between them there are few, because braking and pulling away take little time. No valley, no
split: nothing is made of a recording that only stands or never does.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.detectors.base import mask_within
from graphnav.detectors.scene import Scene

_TINY = 1e-300
FEWEST = 1.0  # s of a population that the data may tell of
MISLABELLED = 0.2  # of the moving windows that other sensors may be wrong about
_TELLS = 0.5  # of the shares of either kind called wrongly; 1 is a statistic that says nothing
MISTAKEN = 0.05  # of the moving windows that may be mislabelled
_BIN = 0.1  # decades
_SPREAD = np.array([0.05, 0.25, 0.4, 0.25, 0.05])  # smoothing, bins
_DEPTH = 4.0  # how many times lower than both sides a valley is
_FEW = 10.0  # times the fewest values: a population below that must stand apart by more than chance
_APART = 4  # bins that then must be empty


def valley(log_values: Array, low: float, high: float, fewest: int) -> float | None:
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
    density = np.convolve(np.histogram(x, edges)[0], _SPREAD, mode="same")
    middle = 0.5 * (edges[1:] + edges[:-1])
    inside = np.flatnonzero((middle >= low) & (middle <= high))
    if not len(inside):
        return None
    # the highest there is on the left and on the right of each bin
    left, right = np.maximum.accumulate(density), np.maximum.accumulate(density[::-1])[::-1]
    contrast = np.minimum(left, right)[inside] / np.maximum(density[inside], 0.5)
    lowest = np.flatnonzero(contrast >= contrast.max() * 0.99)
    # of a wide valley the middle
    bottom = inside[lowest[len(lowest) // 2]]
    below = x < middle[bottom]
    smaller = min(below.sum(), (~below).sum())
    if contrast.max() < _DEPTH or smaller < fewest:
        return None
    if smaller < _FEW * fewest and len(lowest) < _APART:
        return None
    return float(middle[bottom])


def log_statistic(statistic: Array) -> Array:
    """log10, where populations of a statistic are told apart; zero becomes very small, NaN stays."""
    return np.log10(np.maximum(statistic, _TINY))


def own_threshold(
    scene: Scene, name: str, t: Array, half: float, values: Array, least: float, most: float
) -> tuple[float, tuple[str, ...]]:
    """Threshold of a statistic that decides alone, and what there is to be said of it.

    The valley between standing and moving windows if there is one. Else, where odometer or GNSS tell what moves, what
    tells that best from the rest (which may move unseen, so it has to tell it well), or half of what the quietest
    twentieth of it has; and `most` where nothing moves. An IMU by itself leaves `least`: an engine that idles in all
    of the recording then hides the rest that it is.

    Parameters
    ----------
    t, values : (W,) centres of the windows, s, and the statistic; half : s of a window on either side.
    least : what noise alone may make of it.
    most : what an engine may make of it that idles as strongly as engines do.
    """
    x = log_statistic(values)
    step = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    moves = mask_within(t, scene.certain, half) & np.isfinite(x)
    split = valley(x, float(np.log10(least)), float(np.log10(most)), max(2, round(FEWEST / step)))
    if split is not None and not (moves.any() and np.mean(x[moves] < split) > MISLABELLED):
        return max(least, float(10.0**split)), ()
    rests = ~mask_within(t, scene.certain, -half) & np.isfinite(x)  # no part of them is certain to move
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
            f"{name}: nothing tells standing from moving windows, so only its sensors' noise counts as rest",
        ),
    )


def find_fewest_errors(still: Array, moving: Array, least: float) -> tuple[float, float]:
    """Threshold that calls the smallest share of still windows moving plus of moving windows still, at least `least`.

    Of several that do equally well, the middle one by their logarithm. The second number is that sum of shares.
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
