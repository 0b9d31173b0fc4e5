"""Effective sample size: how many independent values a time-correlated series is worth."""

from __future__ import annotations

import numpy as np

from graphnav.rotation import Array

_NONE = 0.05  # autocorrelation that is not told from none


def effective_size(z: Array) -> float:
    """Of columns z (N, m), evenly spaced: N over the integrated autocorrelation, summed over the columns."""
    total = 0.0
    for x in z.T:
        power, length = float(np.mean(x * x)), 1.0
        for lag in range(1, len(x) // 4):
            r = float(np.mean(x[lag:] * x[:-lag])) / power
            if r < _NONE:
                break
            length += 2.0 * r
        total += len(x) / length
    return total
