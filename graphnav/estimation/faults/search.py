"""Tests for persistent errors alongside a filter at given points, from its gains and innovations.

After a detection, filter and tests go back to before the onset and continue without the faulty rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphnav.constraints.base import Constraint
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, DIM
from graphnav.estimation.faults.verdicts import Verdicts
from graphnav.estimation.faults.watch import Bank
from graphnav.estimation.solvers.linearise import Advance
from graphnav.estimation.solvers.points import PointFilter
from graphnav.estimation.solvers.recursion import UNUSED
from graphnav.estimation.solvers.stack import RowBlock, Stack


class FaultSearch:
    """Find faulty fixes, and set their weights in a filter.

    Parameters
    ----------
    watched : the constraints that are tested.
    given : the filter.
    t : (K,) s, of all keyframes of the problem.
    """

    def __init__(
        self,
        watched: Sequence[Constraint],
        given: PointFilter,
        steps: Advance,
        stack: Stack,
        bank: Bank,
        t: Array,
    ) -> None:
        self._watched, self._filter, self._steps, self._stack, self._t = watched, given, steps, stack, t
        records = stack.records
        self.verdicts = Verdicts(
            {c.name: t[c.keyframe] for c in watched}, {c.name: records[c.name].used for c in watched}
        )
        self._used = {c.name: records[c.name].used.copy() for c in watched}
        self._bank = bank
        self._free: set[tuple[str, float]] = set()  # where the filter is reset
        self.at_start = np.zeros(given.H.shape[2])  # (D,) variance added at the start

    def follow(self, k0: int, k1: int) -> int:
        """Test the filtered keyframes from one to another; returns the keyframe to continue from."""
        since = self._find_onset(k0, k1)
        if since is None and k1 == len(self._t):
            since = self.verdicts.set_ended()
        if since is None:
            return k1
        back = int(np.searchsorted(self._t, since))
        self._bank.go_back(back)
        self._reweigh()
        self._begin_anew()
        return back

    def _find_onset(self, k0: int, k1: int) -> float | None:
        """Onset of a fault detected between keyframes k0 and k1."""
        given = self._filter
        root = self._weigh_roots(k0, k1)
        fault = self._bank.follow(k0, k1, given.F, self._steps.decay, self._stack, given.updates, root, given.speeds)
        if fault is None:
            return None
        name, at, since = fault
        return self.verdicts.settle(name, since, float(self._t[at]))

    def _weigh_roots(self, k0: int, k1: int) -> Array:
        """(K, M, M) roots of S, with the weights that kernels have left at keyframes k0 to k1."""
        stack = self._stack
        bent = k0 + np.flatnonzero(np.any(stack.bent[k0:k1] < 1.0, axis=1))
        if not len(bent):
            return stack.root
        out = stack.root.copy()
        for some in (block for k in bent.tolist() for block in stack.stack_keyframe(k)):
            own, weight = (some.k, some.at[1], some.at[1]), stack.bent[some.at]
            if np.any((weight > 0.0) & (weight < 1.0)):
                root = stack.root[own]
                more = self._filter.variance[some.at] * (1.0 / weight - 1.0)
                out[own] = np.linalg.cholesky(root @ root.T + np.diag(more))
        return out

    def _reweigh(self) -> None:
        """Update which blocks are used, by the fixes in use now."""
        for name, was in self._used.items():
            record = self._stack.records[name]
            for k in np.unique(record.rows.keyframe[np.flatnonzero(record.used != was)]).tolist():
                for some in self._stack.stack_keyframe(k):
                    if some.parts[0][0] is record.rows:
                        self._weigh(some)
            was[:] = record.used

    def _weigh(self, some: RowBlock) -> None:
        rows, lo, hi = some.parts[0]
        used = self._stack.records[rows.name].used[lo:hi]
        weight = np.maximum(used, UNUSED) if used.any() else np.ones(hi - lo)
        self._filter.weigh(some, bool(used.any()), np.repeat(np.sqrt(weight), len(rows.axes)))

    def _begin_anew(self) -> None:
        """Where fixes of a persistent fault are used again, the states that they measure are reset."""
        for rows in self._watched:
            for name, t in self.verdicts.anew - self._free:
                k = int(np.searchsorted(self._t, t))
                if name == rows.name and k:
                    self._filter.Q[k - 1] += np.diag(free(DIM, rows.fix_of))
                elif name == rows.name:
                    self.at_start += free(len(self.at_start), rows.fix_of)
        self._free |= self.verdicts.anew


def free(D: int, block: str) -> Array:
    """(D,) variance that resets a block of the error state, coupled parameters included."""
    out = np.zeros(D)
    out[BLOCKS[block]] = 1e6
    return out
