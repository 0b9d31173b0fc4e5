"""The filter at given points: compiled, with the tests for errors that last beside it.

Tests change nothing about a filter until one of them finds something. So the compiled filter goes ahead a stretch of
keyframes, and the tests follow by the gains and innovations that it leaves. Where they find a fault, both go back to
before it, and on without what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array
from graphnav.estimation.solvers.gain import describe_breakdown, weights_of
from graphnav.estimation.solvers.linearise import Advance
from graphnav.estimation.solvers.passes import Progress, Updates
from graphnav.estimation.solvers.points import AtPoints
from graphnav.estimation.solvers.recursion import STRETCH, filter_rows
from graphnav.estimation.solvers.stack import RowBlock, Stack
from graphnav.estimation.solvers.verdicts import Verdicts
from graphnav.estimation.solvers.watch import Bank

_SHORTEST = 4  # keyframes that are filtered at once, behind a fault


@dataclass(frozen=True)
class Errors:
    """Error states (n, D) about given points and their covariances, predicted and filtered."""

    predicted: Array
    P_predicted: Array
    filtered: Array
    P: Array


class PointFilter:
    """Filter keyframes linearised at given points, from what `begin` says of the errors (D,) and P before the first."""

    def __init__(
        self,
        given: AtPoints,
        steps: Advance,
        stack: Stack,
        updates: Updates,
        out: Errors,
        begin: Callable[[], tuple[Array, Array]],
    ) -> None:
        self._given, self._steps, self._stack, self._updates = given, steps, stack, updates
        self._begin, self.out = begin, out
        self._at = np.zeros(1, dtype=int)
        updates.taken[:] = stack.joint.used

    def run(self, k0: int, k1: int) -> None:
        """Filter keyframes k0 to k1 with the blocks that are taken.

        Raises
        ------
        EstimationError
            If the covariance of an innovation is not positive definite.
        """
        given, out, updates, stack, blocks = self._given, self.out, self._updates, self._stack, self._stack.joint
        e, P = (out.filtered[k0 - 1], out.P[k0 - 1]) if k0 else self._begin()
        try:
            filter_rows(
                k0, k1, e, P, given.F, self._steps.decay, given.gap, given.Q, self._steps.added,
                given.r, given.H, given.variance, blocks.first, blocks.begin, blocks.end, updates.taken,
                out.predicted, out.P_predicted, out.filtered, out.P,
                stack.root, stack.solved, updates.Kt, updates.SH, self._at,
            )  # fmt: skip
        except np.linalg.LinAlgError:
            raise describe_breakdown(stack.block(int(self._at[0]))) from None
        np.negative(stack.solved[k0:k1], out=updates.w[k0:k1])

    def run_all(self, progress: Progress | None) -> int:
        """Filter all keyframes; how many these are."""
        n = len(self.out.filtered)
        for k in range(0, n, STRETCH):
            self.run(k, min(k + STRETCH, n))
            if progress is not None:
                progress("filter", k / self._stack.K)
        return n

    def run_tested(self, tests: Bank, verdicts: Verdicts, t: Array, progress: Progress | None) -> int:
        """Filter all keyframes without the fixes that tests find wrong.

        Parameters
        ----------
        t : (K,) s, of all keyframes of the problem.

        Returns
        -------
        int
            The keyframe to go on from: behind the last, or where the filter begins anew.
        """
        n, k, length = len(self.out.filtered), 0, STRETCH
        used = {name: one.used.copy() for name, one in self._stack.records.items() if name in verdicts.times}
        while k < n:
            end = min(k + length, n)
            self.run(k, end)
            given, back = self._given, None
            fault = tests.follow(k, end, given.F, self._steps.decay, self._stack, self._updates, given.speeds)
            if fault is not None:
                name, at, since = fault
                back = int(np.searchsorted(t, verdicts.settle(name, since, float(t[at]))))
            if back is None and end == len(t) and (trial := verdicts.ended()) is not None:
                back = int(np.searchsorted(t, trial))
            if back is not None:
                tests.go_back(back)
                self._reweigh(used)
                if verdicts.anew:
                    return back
            # where one fault has been found the next is near, and what was filtered beyond it was in vain
            k, length = (end, min(2 * length, STRETCH)) if back is None else (back, _SHORTEST)
            if progress is not None:
                progress("filter", k / self._stack.K)
        for name in used:  # of what no update has seen since it was given up
            self._stack.records[name].weight[:] = used[name]
        return n

    def _reweigh(self, before: dict[str, Array]) -> None:
        """Take the blocks in, or not, as fixes are used now."""
        for name, was in before.items():
            record = self._stack.records[name]
            for k in np.unique(record.rows.keyframe[np.flatnonzero(record.used != was)]).tolist():
                for some in self._stack.together(k):
                    if some.parts[0][0] is record.rows:
                        self._weigh(some)
            was[:] = record.used

    def _weigh(self, some: RowBlock) -> None:
        rows, lo, hi = some.parts[0]
        weight, root_weight = weights_of(self._stack.records[rows.name], lo, hi)
        self._updates.taken[some.number] = weight > 0.0
        self._given.weigh(some, root_weight)
