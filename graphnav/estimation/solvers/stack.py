"""Rows of all constraints keyframe by keyframe: which a filter takes in at once, and the innovations it finds.

Rows linearised at given points about which nothing is to be decided are taken in together, several kinds of a keyframe
with one gain. What each would have shown after those before it comes from the root of their common covariance
S = L L^T all the same: with w = L^-1 r, and L_jj what the kind j has on the diagonal,

    r_j = L_jj w_j      S_jj = L_jj L_jj^T      NIS_j = w_j^T w_j      all of them given the kinds before

(block elimination: Golub and Van Loan, Matrix Computations, section 4.2.9).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import chdtri

from graphnav.constraints.base import Constraint
from graphnav.core.rotation import Array, mv
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ConstraintRecord


@cache
def _largest(m: int) -> float:
    return float(chdtri(m, 1e-3))


class Innovations:
    """One constraint's innovations, and what the filter has made of them."""

    def __init__(self, rows: Constraint) -> None:
        self.rows = rows
        shape = (len(rows), len(rows.axes))
        self.residual, self.sigma = np.zeros(shape), np.ones(shape)
        self.nis, self.weight = np.zeros(len(rows)), np.ones(len(rows))
        self.used = np.ones(len(rows)) if rows.weight is None else rows.weight.copy()
        self.refused = np.zeros(len(rows), dtype=bool)

    @property
    def decided(self) -> Array:
        """(N,) weights without what a gate refused."""
        return np.where(self.refused, 0.0, self.used)

    def record(self, problem: Problem) -> ConstraintRecord:
        """All of them."""
        t = problem.t[self.rows.keyframe]
        return ConstraintRecord(
            "innovation", t, self.residual, self.sigma, self.nis, self.weight, self.rows.axes, self.rows.unit
        )


@dataclass(slots=True)
class RowBlock:
    """Rows of a keyframe that are taken in at once, numbers `begin` to `end` of those it has."""

    k: int
    begin: int
    end: int
    parts: list[tuple[Constraint, int, int]]  # each with its rows lo..hi
    alone: bool  # one kind, about which something is to be decided

    @property
    def at(self) -> tuple[int, slice]:
        """Where they stand in a `Stack`."""
        return self.k, slice(self.begin, self.end)


class Stack:
    """The rows of the first K keyframes, at most M numbers each.

    `alone` are the names of constraints whose rows are taken in without others; those of weight 0 are anyway.
    """

    def __init__(self, problem: Problem, K: int, alone: Collection[str] = ()) -> None:
        self.K, self._constraints = K, problem.constraints
        self._alone = [c.name in alone for c in problem.constraints]
        self._weights = [None if c.weight is None else c.weight.tolist() for c in self._constraints]
        self.records = {c.name: Innovations(c) for c in self._constraints}
        self.places: dict[str, tuple[Array, Array]] = {}  # per constraint: keyframe (n, 1) and place there (n, m)
        self._first: list[list[int]] = []
        filled, apart = np.zeros(K, dtype=int), np.zeros(K, dtype=bool)
        for c, one in zip(self._constraints, self._alone, strict=True):
            first, m = np.searchsorted(c.keyframe, np.arange(K + 1)), len(c.axes)
            self._first.append(first.tolist())
            k = c.keyframe[: first[-1]]
            begin = filled[k] + m * (np.arange(len(k)) - first[k])
            self.places[c.name] = k[:, None], begin[:, None] + np.arange(m)
            filled += m * np.diff(first)
            apart[k if one else k[c.weight[: len(k)] == 0.0] if c.weight is not None else k[:0]] = True
        self.M = int(np.max(filled, initial=0))
        self._filled, self._apart = filled.tolist(), apart.tolist()
        self.root_weight = np.ones((K, self.M))
        for c in self._constraints:
            if c.weight is not None:
                n = len(self.places[c.name][0])
                self.root_weight[self.places[c.name]] = np.sqrt(c.weight[:n, None])
                self.records[c.name].weight[:n] = c.weight[:n]
        self._root, self._solved = np.zeros((K, self.M, self.M)), np.zeros((K, self.M))

    def together(self, k: int, one_by_one: bool = False) -> Iterator[RowBlock]:
        """All rows of a keyframe, in the order of the constraints; each kind by itself if wanted so."""
        here = zip(self._constraints, self._first, range(len(self._first)), strict=True)
        parts = [(c, first[k], first[k + 1], i) for c, first, i in here if first[k] < first[k + 1]]
        if not one_by_one and not self._apart[k]:
            if parts:
                yield RowBlock(k, 0, self._filled[k], [part[:3] for part in parts], False)
            return
        some: RowBlock | None = None
        end = 0
        for c, lo, hi, i in parts:
            begin, end = end, end + (hi - lo) * len(c.axes)
            weights = self._weights[i]
            apart = one_by_one or self._alone[i] or (weights is not None and 0.0 in weights[lo:hi])
            if some is not None and not apart:
                some.parts.append((c, lo, hi))
                some.end = end
                continue
            if some is not None:
                yield some
            some = RowBlock(k, begin, end, [(c, lo, hi)], apart)
            if apart:
                yield some
                some = None
        if some is not None:
            yield some

    def seen(self, rows: RowBlock, root: Array, solved: Array) -> None:
        """Rows have had an innovation r: the upper root of its covariance S, below it anything, and S^-1 r."""
        k, at = rows.at
        self._root[k, at] = 0.0  # they may have been taken in with others before
        self._root[k, at, at], self._solved[k, at] = root, solved

    def surprising(self, rows: RowBlock) -> bool:
        """Whether rows that were seen had an innovation larger than chance makes it once in a thousand times."""
        k, at = rows.at
        if not self.root_weight[k, at].any():
            return False
        white = np.triu(self._root[k, at, at]) @ self._solved[k, at]
        return float(white @ white) > _largest(len(white))

    def finish(self) -> None:
        """Work out the innovations of each kind."""
        kind = np.full((self.K, self.M), -1)
        for i, place in enumerate(self.places.values()):
            kind[place] = i
        L = np.swapaxes(np.triu(self._root), -1, -2)
        white = (self._solved[:, None] @ L)[:, 0]
        L *= kind[:, :, None] == kind[:, None]
        residual, sigma = mv(L, white), np.sqrt(np.einsum("kij,kij->ki", L, L))
        for c in self._constraints:
            record, place = self.records[c.name], self.places[c.name]
            n, k = len(place[0]), place[0][:, 0]
            record.residual[:n], record.sigma[:n] = residual[place], sigma[place]
            total = np.bincount(k, np.sum(white[place] ** 2, axis=1), self.K)
            record.nis[:n] = total[k] / np.bincount(k, minlength=self.K)[k]
        used = (kind >= 0) & (self.root_weight > 0.0)
        spread = np.where(used, np.abs(np.diagonal(self._root, axis1=1, axis2=2)), 1.0)
        self.log_likelihood = -np.sum(np.log(np.where(spread > 0.0, spread, 1.0)), axis=1)
        self.log_likelihood -= 0.5 * np.sum(np.where(used, white, 0.0) ** 2, axis=1)
