"""Effective sample size: how many independent values a time-correlated series is worth."""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array

_NEGLIGIBLE_CORRELATION = 0.05  # autocorrelation below which it is indistinguishable from zero


def compute_effective_size(z: Array) -> float:
    """Effective size of evenly spaced columns z (N, m): N over the integrated autocorrelation, summed over the
    columns.
    """
    total = 0.0
    for x in z.T:
        power, length = float(np.mean(x * x)), 1.0
        for lag in range(1, len(x) // 4):
            r = float(np.mean(x[lag:] * x[:-lag])) / power
            if r < _NEGLIGIBLE_CORRELATION:
                break
            length += 2.0 * r
        total += len(x) / length
    return total


def count_effective_epochs(x: Array) -> float:
    """How many independent epochs errors over their sigmas (N, k), in the order of time, are worth; at least one.

    In their mean square, that is: n over 1 + 2 sum r^2 of their autocorrelations r, as squares of Gaussians correlate
    by r^2 where these do by r, summed until r first vanishes (the initial positive sequence, Geyer, Statistical
    Science 7(4), 1992). No mean is taken off: an error that does not change at all is one epoch.
    """
    x = np.where(np.isfinite(x), x, 0.0)
    n, total = len(x), float(np.sum(x * x))
    if n < 2 or total == 0.0:
        return 1.0
    r = np.fft.irfft(np.sum(np.abs(np.fft.rfft(x, 2 * n, axis=0)) ** 2, axis=1))[:n] / total
    over = np.flatnonzero(r <= 0.0)
    r = r[1 : over[0] if len(over) else n]
    share = 1.0 - np.arange(1, len(r) + 1) / n  # over the pairs: r is counted once, its square twice
    return float(n / (1.0 + 2.0 * float(np.sum(r**2 / share))))


def chi_square_band(dof: int, n: float, outside: float = 0.05) -> tuple[float, float]:
    """The two-sided band (95 % by default) of the mean of n independent chi-square values, per degree of freedom."""
    low, high = (chi_square_quantile(p, dof * n) / (dof * n) for p in (0.5 * outside, 1.0 - 0.5 * outside))
    return low, high


def chi_square_quantile(probability: float, dof: float) -> float:
    """The quantile of the chi-square distribution (inverse of the regularised incomplete gamma function)."""
    from scipy.special import gammaincinv  # which takes a fifth of a second to import, and scipy.stats a second

    return 2.0 * float(gammaincinv(0.5 * dof, probability))
