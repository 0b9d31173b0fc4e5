"""Running sums, medians, means and maxima of rows: a window of `size` about each, the first and last repeated beyond.

SciPy's filters do the same, and are quicker in long windows; importing them takes as long as a short run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from graphnav.core.rotation import Array

_MANY_NUMBERS = 4_000_000  # number of values in all windows above which SciPy is imported


def run_median(x: Array, size: int) -> Array:
    """Of rows x (K,) or (K, n); of an even `size` the upper of the two in the middle."""
    if x.size * size > _MANY_NUMBERS:
        from scipy.ndimage import median_filter

        return np.asarray(median_filter(x, size=(size, *(1,) * (x.ndim - 1)), mode="nearest"))
    return np.asarray(np.partition(_view_windows(x, size), size // 2, axis=-1)[..., size // 2])


def run_mean(x: Array, size: int) -> Array:
    """Of rows x (K,) or (K, n)."""
    return np.asarray(_view_windows(x, size).mean(axis=-1))


def run_maximum(x: Array, size: int) -> Array:
    """Of rows x (K,) or (K, n)."""
    return np.asarray(_view_windows(x, size).max(axis=-1))


def sum_running(terms: Array) -> Array:
    """Running sums along the first axis, from zero: one more than there are terms."""
    out = np.zeros((len(terms) + 1, *terms.shape[1:]))
    if out[0].size < 100:
        np.cumsum(terms, axis=0, out=out[1:])
    else:  # several times faster than NumPy's sums, which run down one column after the other
        for k, term in enumerate(terms):
            np.add(out[k], term, out=out[k + 1])
    return out


@dataclass(frozen=True)
class Sums:
    """Running sums of rows: means over any window by one subtraction."""

    total: Array  # (K + 1, c)
    offset: Array  # (c,) subtracted before summing, so that sums over many hours keep their precision

    def compute_means(self, length: int, step: int = 1) -> Array:
        """(W, c) means over windows of `length` rows that begin every `step` rows."""
        last = self.total[length::step]
        return np.asarray((last - self.total[: -length or None : step][: len(last)]) / length + self.offset)


def sum_rows(rows: Array) -> Sums:
    """Running sums down the rows, (K, c)."""
    offset = rows.mean(axis=0) if len(rows) else np.zeros(rows.shape[1])
    total = np.zeros((len(rows) + 1, rows.shape[1]))
    np.cumsum(rows - offset, axis=0, out=total[1:])
    return Sums(total, offset)


def _view_windows(x: Array, size: int) -> Array:
    """(K, ..., size) views of rows."""
    before = size // 2
    padded = np.pad(x, ((before, size - 1 - before), *((0, 0),) * (x.ndim - 1)), mode="edge")
    return sliding_window_view(padded, size, axis=0)
