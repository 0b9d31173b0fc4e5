"""Single IMU readings that contradict the readings before and after.

The excess of a reading over both of its neighbours is small where a signal is smooth, and as large as the bumps where
there are bumps. The largest excesses are assumed to follow a power law (B. M. Hill, A simple general approach to
inference about the tail of a distribution, Annals of Statistics 3, 1975), which decays more slowly than those of any
recording. A reading so far beyond all others that only one in a thousand recordings would contain it is not due to
motion.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from graphnav.core.findings import compute_period
from graphnav.core.rotation import Array

TAIL = 100  # excesses from which the decay is estimated: to a tenth
RARE = 1e-3  # expected number of such readings in a recording by chance, below which a reading is rejected
ALONE = 1.0  # s around a single reading without another; several are a real event
_ISOLATED = 0.01  # share of the rows; above it the cause is not in single rows
_TELL = 5  # multiple of `TAIL`, rows in motion of which these are the largest fifth
NOISY = 0.05  # share of the steps that reverse the one before; for noise up to a band B and a rate f it is 1.5 B / f
HOLE = 1.5  # periods between two rows that are not adjacent


def measure_excess(x: Array) -> Array:
    """Excess of each of the values (N, ...) except the first and the last over both its neighbours, (N-2, ...)."""
    low, high = np.minimum(x[:-2], x[2:]), np.maximum(x[:-2], x[2:])
    middle = x[1:-1]
    return np.asarray(np.maximum(middle - high, low - middle).clip(min=0.0))


def count_expected(excess: Array, others: Array, resolution: float) -> Array:
    """Expected number of excesses at least as large, given others.

    Parameters
    ----------
    excess : (M,) above zero.
    others : (M, TAIL + 1) the next smaller ones of each, the largest first.
    resolution : of the readings, in their unit: differences below half of it carry no information on the tail.

    Returns
    -------
    (M,)
    """
    fall, last = _measure_fall(others, resolution)
    return np.asarray(TAIL * (excess / last) ** (-1.0 / fall))


def _measure_fall(others: Array, resolution: float | Array) -> tuple[Array, Array]:
    """Hill estimate (reciprocal of the tail exponent) of excesses (M, TAIL + 1), and the smallest of each row."""
    last = others[:, -1]
    return np.log(others[:, :-1] / last[:, None]).mean(axis=1) + 0.5 * resolution / last, last


def find_contradicted(t: Array, readings: Iterable[Array]) -> NDArray[np.bool_]:
    """Which rows hold a reading that the rows before and after contradict.

    Parameters
    ----------
    t : (N,) s.
    readings : (N,) along each axis of the sensors.

    Returns
    -------
    (N,) True where one does, and none of the rows within a second of it.
    """
    bad = np.zeros(len(t), dtype=bool)
    if len(t) < TAIL + 3:
        return bad
    near = np.diff(t) < HOLE * compute_period(t)
    between = near[:-1] & near[1:]
    for x in readings:
        excess = measure_excess(x) * between
        bad[1:-1] |= excess > _find_limit(excess)
    rows = np.flatnonzero(bad)
    apart = np.diff(t[rows], prepend=-np.inf, append=np.inf) > ALONE
    bad[rows[~(apart[:-1] & apart[1:])]] = False
    return bad


def _find_limit(excess: Array) -> float:
    """The largest excess (of N) due to motion; sought from the smallest upwards, so that no outlier hides another."""
    found = excess[excess > 0.0]
    most = min(int(_ISOLATED * len(excess)), len(found) - TAIL - 1)
    if most < 1:
        return np.inf
    resolution = float(found.min())
    largest = -np.sort(-np.partition(found, -(most + TAIL + 1))[-(most + TAIL + 1) :])
    others = np.lib.stride_tricks.sliding_window_view(largest[1:], TAIL + 1)
    rare = np.flatnonzero(count_expected(largest[:most], others[:most], resolution) < RARE)
    return float(largest[rare[-1] + 1]) if len(rare) else np.inf


class Excesses:
    """The largest excesses of a session so far, axis by axis, and those that are not due to motion.

    Parameters
    ----------
    axes : how many there are.
    """

    def __init__(self, axes: int) -> None:
        self.limits = (np.inf,) * axes
        self._largest = np.zeros((TAIL + 1, axes))
        self._least = np.full(axes, np.inf)  # above zero: the resolution
        self._count = 0

    def add(self, excess: Array) -> None:
        """Add those (N, axes) of rows in motion: a stop shows nothing about the next bump."""
        self._count += len(excess)
        self._least = np.minimum(self._least, np.where(excess > 0.0, excess, np.inf).min(axis=0, initial=np.inf))
        both = np.concatenate([self._largest, excess])
        self._largest = -np.sort(-both, axis=0)[: TAIL + 1]
        if self._count < _TELL * TAIL:
            return
        limits = np.full(len(self._least), np.inf)
        told = np.flatnonzero(self._largest[-1] > 0.0)
        fall, last = _measure_fall(self._largest.T[told], self._least[told])
        limits[told] = last * (TAIL / RARE) ** fall
        self.limits = tuple(limits.tolist())
