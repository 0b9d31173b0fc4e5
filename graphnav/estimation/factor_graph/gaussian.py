"""The adapter between NumPy rows and GTSAM: linear factor graphs built, eliminated with QR, read back.

Variables are fifteen-dimensional error states, key k for keyframe k, and one key per parameter node.
Elimination goes along time, which for a chain is the ordering without fill, and is sequential, so a
long drive cannot exhaust the stack. QR, because GTSAM's Cholesky rejects the small pivots of tight bias
walks beside loose priors.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import gtsam
import numpy as np
from scipy.linalg.lapack import dgeqrf, dtrtri

from graphnav.core.rotation import Array
from graphnav.estimation.solvers.breakdown import explain_undetermined

FactorBlocks = Sequence[tuple[Array, Array]]  # (keys (N,), A (N, m, k)) per variable a factor touches


def make_jacobian_factor(blocks: Sequence[tuple[int, Array]], b: Array) -> gtsam.JacobianFactor:
    """Whitened rows: the sum of A d[key] over the blocks (key, A) is b.

    GTSAM's constructors know up to three variables. More are those of a nonlinear factor with these derivatives: sums
    of two variables as further ones, exact and eliminated at once, lose rows of which many entries are zero.
    """
    if len(blocks) <= 3:
        make: Any = gtsam.JacobianFactor
        parts = ((key, np.asfortranarray(A)) for key, A in blocks)
        return make(*(part for block in parts for part in block), b, _make_unit_noise(len(b)))
    keys, point = [key for key, _ in blocks], gtsam.Values()
    for key, A in blocks:
        point.insert(key, np.zeros(A.shape[1]))

    def differentiate(factor: gtsam.CustomFactor, at: gtsam.Values, derivatives: Any) -> Array:
        for i, (_, A) in enumerate(blocks):
            derivatives[i] = A
        return -b

    rows = gtsam.CustomFactor(_make_unit_noise(len(b)), keys, differentiate)
    return gtsam.JacobianFactor(rows.linearize(point))


@cache
def _make_unit_noise(m: int) -> gtsam.noiseModel.Unit:
    """The noise of m whitened rows."""
    return gtsam.noiseModel.Unit.Create(m)


def eliminate(rows: Iterable[tuple[FactorBlocks, Array]], order: Iterable[int]) -> Eliminated:
    """Eliminate variables in this order from whitened rows.

    Parameters
    ----------
    rows : blocks and b (N, m), for N factors of m rows: the sum over blocks of A[n] d[key[n]] is b[n].
    """
    graph, ordering = gtsam.GaussianFactorGraph(), gtsam.Ordering()
    make: Any = gtsam.JacobianFactor
    for blocks, b in rows:
        unit = _make_unit_noise(b.shape[1])
        # GTSAM keeps matrices by columns: handing them over that way saves it a strided copy
        columns = [np.ascontiguousarray(np.swapaxes(A, 1, 2)).swapaxes(1, 2) for _, A in blocks]
        keys = [k.tolist() for k, _ in blocks]
        if len(blocks) <= 3:
            parts: list[Any] = [part for pair in zip(keys, columns, strict=True) for part in pair]
            for row in zip(*parts, b, strict=True):
                graph.push_back(make(*row, unit))
            continue
        for i in range(len(b)):
            graph.push_back(make_jacobian_factor([(k[i], A[i]) for k, A in zip(keys, columns, strict=True)], b[i]))
    for key in order:
        ordering.push_back(int(key))
    return Eliminated(graph.eliminateSequential(ordering, gtsam.EliminateQR))


class Eliminated:
    """The graph as a Bayes net: solution and covariances by substitution."""

    def __init__(self, net: gtsam.GaussianBayesNet) -> None:
        self._net, self._optimum = net, net.optimize()

    def solve(self, keys: Sequence[int]) -> list[Array]:
        """The optimum, one vector per key."""
        return [self._optimum.at(int(k)) for k in keys]

    def decrease(self) -> float:
        """How much half the squared residuals fall from no variable moved to the optimum: |R x - d|^2 / 2 at x = 0."""
        return float(self._net.error(gtsam.VectorValues.Zero(self._optimum)))

    def compute_covariances(self, keys: set[int] | None = None) -> dict[int, Array]:
        """Marginal covariance of every variable (or of `keys`).

        Backwards through the net: a conditional |R x + S s - d|^2 gives, with U = -R^-1 S and the joint
        covariance P_s of its parents s,

            P_x = R^-1 R^-T + U P_s U^T        P_xs = U P_s

        Of the joint covariance only the block of variables that are parents of later ones is kept (Kaess and Dellaert
        2009, eq. 20-21): the order runs along a chain, so that is one keyframe and the parameters in force. It is kept
        as a root M, P = M^T M: at a stop, whose position is known to a millimetre relative to the held place and to a
        hundred metres on the Earth, P itself would lose all digits.

        Raises
        ------
        EstimationError
            If a variable is not determined.
        """
        out: dict[int, Array] = {}
        where: dict[int, range] = {}  # columns of the joint block, per variable in it
        root = np.zeros((0, 0))
        conditionals = [self._net.at(i) for i in range(self._net.size())]
        first: dict[int, int] = {}  # the first eliminated variable that has it as parent: the last one that needs it
        for i, conditional in enumerate(conditionals):
            for parent in conditional.keys()[1:]:
                first.setdefault(parent, i)
        for i in range(len(conditionals) - 1, -1, -1):
            conditional = conditionals[i]
            key, *parents = conditional.keys()
            R_inverse, singular = dtrtri(conditional.R())
            if singular:
                raise explain_undetermined()
            n = len(R_inverse)
            kept = [*parents, *(k for k in where if first.get(k, i) < i and k not in parents)]
            index = [column for p in kept for column in where[p]]
            below = root[:, index]
            root = np.zeros((n + len(below), n + len(index)), order="F")  # as LAPACK has it
            root[:n, :n] = R_inverse.T
            root[n:, n:] = below
            if parents:
                U = -R_inverse @ conditional.S()
                root[n:, :n] = below[:, : U.shape[1]] @ U.T
            if len(root) > 2 * root.shape[1]:
                root = np.triu(dgeqrf(root, overwrite_a=True)[0][: root.shape[1]])
            edges = list(itertools.accumulate([n, *(len(where[p]) for p in kept)], initial=0))
            where = {k: range(lo, hi) for k, lo, hi in zip([key, *kept], edges, edges[1:], strict=False)}
            if keys is None or key in keys:
                out[key] = root[:, :n].T @ root[:, :n]
        return out
