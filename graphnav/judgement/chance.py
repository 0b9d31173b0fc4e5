"""What chance would do: when a variance factor is clear, and estimates of one that outliers do not decide."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtr, chdtri, gammaincinv

from graphnav.rotation import Array

SIGNIFICANT = 3.0  # standard deviations of the estimate of a factor that it must differ from 1
FEWEST = 30  # fixes or intervals that say anything
CLEARLY = 1.3  # ratio of two figures of noise that makes a difference
MOST_RAISED = 10.0  # an IMU ten times worse than stated is not the explanation: the fixes are, and are judged next
_TRIMMED = 0.01


def median(degrees: int) -> float:
    """Median of a chi-square variable."""
    return 2.0 * float(gammaincinv(0.5 * degrees, 0.5))


def trimmed(squared: Array) -> float:
    """Mean of squared standard normals without the largest hundredth, over what it would be for a true sigma.

    Not the median: what noise adds up to over a minute is its mean square, bumps in the road included.
    """
    most = np.quantile(squared, 1.0 - _TRIMMED)
    kept = float(chdtr(3.0, chdtri(1.0, _TRIMMED))) / (
        1.0 - _TRIMMED
    )  # E[z^2 | z^2 < q] = P(chi2_3 < q) / P(chi2_1 < q)
    return float(np.mean(squared[squared <= most])) / kept


def scatter(count: float) -> float:
    """Standard deviation of the logarithm of a median chi-square of `count` independent values.

    That of a mean, sqrt(2/n), times about 1.25 for a median; a trimmed mean lies between.
    """
    return 1.25 * float(np.sqrt(2.0 / max(count, 2.0)))


def independent(z: Array) -> float:
    """How many independent values (N, m) time-correlated columns are worth."""
    total = 0.0
    for x in z.T:
        power, length = float(np.mean(x * x)), 1.0
        for lag in range(1, len(x) // 4):
            r = float(np.mean(x[lag:] * x[:-lag])) / power
            if r < 0.05:
                break
            length += 2.0 * r
        total += len(x) / length
    return total
