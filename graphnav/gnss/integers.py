"""Integer least squares: the integer vectors nearest to a float estimate in the metric of its covariance.

The LAMBDA method (Teunissen 1995): a unimodular Z makes the ambiguities nearly uncorrelated, from Q = L^T D L with L
unit lower triangular, by integer Gauss transformations and permutations that sort D (de Jonge and Tiberius 1996; Chang,
Yang and Zhou 2005); then a search through an ellipsoid, nearest first, which shrinks with every candidate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from graphnav.core.compiled import compile_once
from graphnav.core.rotation import Array

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Nearest:
    """The two best vectors of integers, with their squared distances in units of the covariance."""

    best: Integers  # (n,)
    second: Integers  # (n,)
    distance: float
    distance_second: float

    @property
    def ratio(self) -> float:
        """Ratio of the squared distances of second best and best."""
        return self.distance_second / max(self.distance, 1e-12)


@dataclass(frozen=True)
class Decorrelated:
    """z = Z^T a with covariance L^T D L."""

    Z: Integers  # (n, n)
    L: Array  # (n, n) unit lower triangular
    D: Array  # (n,)

    @property
    def success(self) -> float:
        """Success rate of integer bootstrapping, a lower bound for integer least squares (Teunissen 1998)."""
        return float(np.prod(2.0 * ndtr(0.5 / np.sqrt(self.D)) - 1.0))


def decorrelate(Q: Array) -> Decorrelated:
    """Decorrelate ambiguities of covariance Q (n, n) by the LAMBDA transformation.

    Raises
    ------
    numpy.linalg.LinAlgError
        If Q is not positive definite.
    """
    n = len(Q)
    # Q = L^T D L is a Cholesky factorisation from the last row up
    root = np.linalg.cholesky(Q[::-1, ::-1])[::-1, ::-1].T
    diagonal = np.diagonal(root).copy()
    L, D, Z = np.ascontiguousarray(root / diagonal[:, None]), diagonal**2, np.eye(n, dtype=np.int64)
    _reduce(L, D, Z)
    return Decorrelated(Z, L, D)


@compile_once
def _reduce(L: Array, D: Array, Z: Integers) -> None:
    """Transform L, D and Z in place until D is sorted as far as possible."""
    n = len(D)
    j = untouched = n - 2
    while j >= 0:
        if j <= untouched:
            for i in range(j + 1, n):
                mu = int(np.rint(L[i, j]))
                if mu:
                    L[i:, j] -= mu * L[i:, i]
                    Z[:, j] -= mu * Z[:, i]
        after = D[j] + L[j + 1, j] ** 2 * D[j + 1]
        if after < D[j + 1] * (1.0 - 1e-9):
            eta, lam = D[j] / after, D[j + 1] * L[j + 1, j] / after
            D[j], D[j + 1] = eta * D[j + 1], after
            upper, lower = L[j, :j].copy(), L[j + 1, :j].copy()
            L[j, :j], L[j + 1, :j] = lower - L[j + 1, j] * upper, eta * upper + lam * lower
            L[j + 1, j] = lam
            left, column = L[j + 2 :, j].copy(), Z[:, j].copy()
            L[j + 2 :, j], L[j + 2 :, j + 1] = L[j + 2 :, j + 1], left
            Z[:, j], Z[:, j + 1] = Z[:, j + 1], column
            untouched, j = j, n - 2
        else:
            j -= 1


def find_nearest(a: Array, found: Decorrelated) -> Nearest:
    """Find the two integer vectors nearest to a float estimate a (n,) whose covariance was decorrelated."""
    whole = np.floor(a)  # only the fractional part is searched: ambiguities may be millions of cycles
    z = (a - whole) @ found.Z
    first, second = _search(z, found.L, found.D)
    back = np.linalg.inv(found.Z.astype(float)).T

    def transform_back(x: list[int]) -> Integers:
        return np.rint(back @ np.array(x, dtype=float) + whole).astype(np.int64)

    return Nearest(transform_back(first[1]), transform_back(second[1]), first[0], second[0])


def _search(z: Array, L: Array, D: Array) -> tuple[tuple[float, list[int]], tuple[float, list[int]]]:
    """The two best (distance, integers), depth first from the last number, each level nearest first."""
    n = len(z)
    weight, own = (1.0 / D).tolist(), z.tolist()
    centre, given = own.copy(), [0] * n
    step, reached = [0] * n, [0.0] * (n + 1)  # reached[k]: squared distance accumulated over levels k and above
    best: list[tuple[float, list[int]]] = []
    columns = [L[k + 1 :, k].tolist() for k in range(n)]

    def enter(k: int) -> None:
        # conditional estimate of z_k given those above it
        centre[k] = own[k] + sum(l * (given[i] - centre[i]) for l, i in zip(columns[k], range(k + 1, n), strict=True))
        given[k] = round(centre[k])
        step[k] = 1 if centre[k] >= given[k] else -1

    k = n - 1
    enter(k)
    while True:
        off = given[k] - centre[k]
        distance = reached[k + 1] + off * off * weight[k]
        if len(best) < 2 or distance < best[1][0]:
            if k:
                reached[k] = distance
                k -= 1
                enter(k)
                continue
            best = sorted([*best, (distance, given.copy())])[:2]
        else:
            k += 1
            if k == n:
                return best[0], best[1]
        given[k] += step[k]
        step[k] = -step[k] - (1 if step[k] > 0 else -1)
