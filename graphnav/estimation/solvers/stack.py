"""Rows of all constraints keyframe by keyframe: joint updates of a filter, and their innovations.

Rows linearised at given points that need no decision are processed jointly, several kinds of a keyframe with one gain.
The sequential innovations of each kind follow from the root of their joint covariance S = L L^T: with w = L^-1 r, and
L_jj the diagonal block of kind j,

    r_j = L_jj w_j      S_jj = L_jj L_jj^T      NIS_j = w_j^T w_j      all of them given the kinds before

(block elimination: Golub and Van Loan, Matrix Computations, section 4.2.9).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from graphnav.constraints.base import Constraint
from graphnav.core.rotation import Array, mv
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ConstraintRecord
from graphnav.estimation.solvers.recursion import CAUCHY, HUBER, UNUSED, RowBlocks
from graphnav.estimation.solvers.robust import soften, weigh_squares

_KERNELS = {"none": 0, "huber": HUBER, "cauchy": CAUCHY}


class Innovations:
    """One constraint's innovations, with the weights used by the filter."""

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
        """All of them; a kernel's weight is in the normalised squares, as the noise model's is."""
        t = problem.t[self.rows.keyframe]
        kept = (self.weight > 0.0) & (self.used > 0.0)
        nis = self.nis * np.divide(self.weight, self.used, out=np.ones_like(self.nis), where=kept)
        return ConstraintRecord(
            "innovation",
            t,
            self.residual,
            self.sigma,
            nis,
            self.weight,
            self.rows.axes,
            self.rows.unit,
            **self.rows.labels,
        )


@dataclass(slots=True)
class RowBlock:
    """Rows of a keyframe in one joint update, numbers `begin` to `end` of the keyframe's."""

    k: int
    number: int  # of the block among all
    begin: int
    end: int
    parts: list[tuple[Constraint, int, int]]  # each with its rows lo..hi

    @property
    def at(self) -> tuple[int, slice]:
        """Where they stand in a `Stack`."""
        return self.k, slice(self.begin, self.end)


class Stack:
    """The rows of the first K keyframes, at most M numbers each.

    `alone` are the names of constraints whose rows are processed separately, as are rows of weight 0 and rows that need
    a decision.
    """

    def __init__(self, problem: Problem, K: int, alone: Collection[str] = ()) -> None:
        self.K, self._constraints = K, problem.constraints
        self.records = {c.name: Innovations(c) for c in self._constraints}
        self.places: dict[str, tuple[Array, Array]] = {}  # per constraint: keyframe (n, 1) and place there (n, m)
        weights, scales, filled = [], [], np.zeros(K, dtype=int)
        parts = []  # of each kind at each keyframe: keyframe, kind, rows lo..hi, numbers begin..end, apart, used
        for i, c in enumerate(self._constraints):
            first, m = np.searchsorted(c.keyframe, np.arange(K + 1)), len(c.axes)
            k = c.keyframe[: first[-1]]
            begin = filled[k] + m * (np.arange(len(k)) - first[k])
            self.places[c.name] = k[:, None], begin[:, None] + np.arange(m)
            here = np.flatnonzero(np.diff(first))
            lo, hi = first[here], first[here + 1]
            weight = np.ones(len(k)) if c.weight is None else c.weight[: len(k)]
            used = np.maximum.reduceat(weight, lo) > 0.0 if len(lo) else np.ones(0, dtype=bool)
            apart = np.minimum.reduceat(weight, lo) == 0.0 if len(lo) else used
            numbers = filled[here], filled[here] + m * (hi - lo)
            apart |= c.name in alone or c.gate is not None or c.robust != "none"
            parts.append(np.stack([here, np.full(len(here), i), lo, hi, *numbers, apart, used]))
            filled += m * np.diff(first)
            # an unused row among others of its kind gets a negligible weight; alone it only has an innovation
            weight = np.where(np.repeat(used, hi - lo), np.maximum(weight, UNUSED), 1.0)
            weights.append(np.sqrt(weight)[:, None])
            scales.append(np.broadcast_to(c.scale_of(slice(0, len(k))), len(k))[:, None])
        self.M = int(np.max(filled, initial=0))
        self.root_weight, self.scale = np.ones((2, K, self.M))
        for place, weight, scale in zip(self.places.values(), weights, scales, strict=True):
            self.root_weight[place], self.scale[place] = weight, scale
        table = np.concatenate(parts, axis=1) if parts else np.empty((8, 0), dtype=int)
        table = table[:, np.argsort(table[0], kind="stable")]
        self._parts = table[:6].T
        self.single = self._split_blocks(table, np.ones(table.shape[1], dtype=bool))
        k, apart = table[0], table[6].astype(bool)
        self.joint = self._split_blocks(table, np.diff(k, prepend=-1).astype(bool) | apart | np.roll(apart, 1))
        # of each update: the lower root of S, S^-1 r, and the kernel's weights of rows
        self.root, self.solved, self.bent = np.zeros((K, self.M, self.M)), np.zeros((K, self.M)), np.ones((K, self.M))

    def _split_blocks(self, table: Array, new: Array) -> RowBlocks:
        """Parts (8, n) in blocks, where `new` (n,) each begins one."""
        part = np.append(np.flatnonzero(new), table.shape[1])
        head, last = part[:-1], part[1:] - 1
        first = np.searchsorted(table[0, head], np.arange(self.K + 1))
        kinds = np.array([_describe(c) for c in self._constraints]).reshape(-1, 3)[table[1, head]]
        kernel, size = np.ascontiguousarray(kinds[:, 1:].T, dtype=int)  # other layouts would be compiled separately
        used = table[7, head].astype(bool)
        return RowBlocks(
            first, table[4, head], table[5, last], used, kinds[:, 0].copy(), kernel, size, part, *table[:2, head].copy()
        )

    def stack_keyframe(self, k: int) -> Iterator[RowBlock]:
        """All rows of a keyframe, in the order of the constraints."""
        for b in range(self.joint.first[k], self.joint.first[k + 1]):
            yield self.get_block(b)

    def find_kinds(self, names: Sequence[str]) -> Array:
        """(B,) which of some constraints each joint block is of, -1 for none."""
        number = [names.index(c.name) if c.name in names else -1 for c in self._constraints]
        return np.array(number)[self.joint.kind]

    def get_block(self, b: int) -> RowBlock:
        """Block number b."""
        some = self._parts[self.joint.part[b] : self.joint.part[b + 1]].tolist()
        parts = [(self._constraints[i], lo, hi) for _, i, lo, hi, _, _ in some]
        return RowBlock(some[0][0], b, some[0][4], some[-1][5], parts)

    def log_likelihood(self) -> Array:
        """(K,) of the innovations, up to a constant; of rows with a robust kernel what the kernel makes of them."""
        return self._compute_likelihood(self._whiten())

    def sum_squares(self) -> tuple[Array, Array]:
        """Squared innovations (K,) of a keyframe over their covariances, and how many numbers (K,) they are of."""
        weighs = self._mask_used()
        return np.sum(np.where(weighs, self._whiten() ** 2, 0.0), axis=1), np.sum(weighs, axis=1)

    def _whiten(self) -> Array:
        """(K, M) innovations, whitened."""
        return np.asarray((self.solved[:, None] @ self.root)[:, 0])

    def _mask_used(self) -> Array:
        """(K, M) mask of the numbers of rows with a weight."""
        used = np.zeros((self.K, self.M), dtype=bool)
        for c in self._constraints:
            place = self.places[c.name]
            used[place] = True if c.weight is None else c.weight[: len(place[0]), None] > 0.0
        return used

    def _compute_likelihood(self, white: Array) -> Array:
        """Log-likelihood (K,) of whitened innovations (K, M)."""
        weighs, squares = self._mask_used(), white**2
        for c in self._constraints:
            place = self.places[c.name]
            if c.gate is None and c.robust != "none":
                total = np.sum(squares[place], axis=1)
                bent = 2.0 * weigh_squares(soften(c.robust), np.sqrt(total), self.scale[place][:, 0])[1]
                squares[place] *= (bent / np.maximum(total, 1e-300))[:, None]
        spread = np.where(weighs, np.abs(np.diagonal(self.root, axis1=1, axis2=2)), 1.0)
        log_determinant = np.sum(np.log(np.where(spread > 0.0, spread, 1.0)), axis=1)
        return np.asarray(-log_determinant - 0.5 * np.sum(np.where(weighs, squares, 0.0), axis=1))

    def finish(self) -> Array:
        """Compute the innovations of each kind; returns their log-likelihood (K,), up to a constant."""
        kind = np.full((self.K, self.M), -1)
        for i, c in enumerate(self._constraints):
            kind[self.places[c.name]] = i
        L = self.root
        white = self._whiten()
        log_likelihood = self._compute_likelihood(white)
        L *= kind[:, :, None] == kind[:, None]
        residual, sigma = mv(L, white), np.sqrt(np.einsum("kij,kij->ki", L, L))
        for c in self._constraints:
            record, place = self.records[c.name], self.places[c.name]
            n, k = len(place[0]), place[0][:, 0]
            record.residual[:n], record.sigma[:n] = residual[place], sigma[place]
            total = np.bincount(k, np.sum(white[place] ** 2, axis=1), self.K)
            record.nis[:n] = total[k] / np.bincount(k, minlength=self.K)[k]
            bent = self.bent[k, place[1][:, 0]]
            record.weight[:n], record.refused[:n] = record.used[:n] * bent, bent == 0.0
        return log_likelihood


def _describe(rows: Constraint) -> tuple[float, int, int]:
    """Gate, kernel and numbers of one row of a constraint; a gate stands in place of a kernel."""
    gate = np.inf if rows.gate is None else rows.gate**2
    return gate, _KERNELS[soften(rows.robust)] if rows.gate is None else 0, len(rows.axes)
