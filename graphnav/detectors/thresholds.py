"""Thresholds from the recording itself: the valley between what is still and what is not.

The logarithm of a statistic of windows falls into two populations if a recording holds both (Kittler and
Illingworth 1986 look for such a split in images): standing windows close together at the sensors' own noise, moving
ones higher and wide. Between them there are few, because braking and pulling away take little time. No valley, no
split: nothing is made of a recording that only stands or never does.
"""

from __future__ import annotations

import numpy as np

from graphnav.rotation import Array

_BIN = 0.1  # decades
_SPREAD = np.array([0.05, 0.25, 0.4, 0.25, 0.05])  # smoothing, bins
_DEPTH = 4.0  # how many times lower than both sides a valley is


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
    if contrast.max() < _DEPTH or min(below.sum(), (~below).sum()) < fewest:
        return None
    return float(middle[bottom])
