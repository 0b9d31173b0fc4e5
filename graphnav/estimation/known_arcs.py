"""Carrier-phase arcs at each epoch, and the integers known of their ambiguities.

`graphnav.estimation.fixing` finds the integers; here they are stored, combined, and tested against the carrier phases
of an epoch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.special import gammaincinv  # scipy.stats would take half a second to import

from graphnav.constraints.ambiguities import CarrierRows, list_slots
from graphnav.constraints.raw_phase import REFLECTIONS, compute_variance_left
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.solution import CarrierArcs
from graphnav.estimation.solvers.linearise import Points, Rows, linearise, shift

ENOUGH = 4  # differences of a fixed epoch: one more than a position needs, so that they check each other
_ALARM = 0.001  # share of epochs with correct integers that fail the consistency test
Arc = tuple[str, float]  # its ambiguity, and its start, s


@dataclass
class Known:
    """Known differences: each arc with an integer relative to the first of its connected set."""

    of: dict[Arc, tuple[Arc, int]] = field(default_factory=dict)  # N_arc - N_first
    let_go: set[Arc] = field(default_factory=set)

    def copy(self) -> Known:
        """The same, to be changed."""
        return Known(self.of.copy(), self.let_go.copy())

    def find(self, arc: Arc) -> tuple[Arc, int]:
        """The first arc of the connected set of an arc, and the difference from it."""
        return self.of.get(arc, (arc, 0))

    def join(self, a: Arc, b: Arc, cycles: int) -> None:
        """Record that N_a - N_b is an integer."""
        (first, of_a), (other, of_b) = self.find(a), self.find(b)
        if first == other:
            return
        moved = of_a - of_b - cycles
        self.of |= {arc: (first, n + moved) for arc, (root, n) in self.of.items() if root == other}
        self.of |= {first: (first, 0), other: (first, moved)}

    def forget(self, arc: Arc) -> None:
        """Forget an arc; arcs connected through it stay connected."""
        root, _ = self.of.pop(arc, (None, 0))
        if root == arc:
            rest = [(other, n) for other, (first, n) in self.of.items() if first == arc]
            for other, n in rest:
                self.of[other] = rest[0][0], n - rest[0][1]


class Epochs:
    """Arcs at each keyframe with carrier phases, and the positions of their rows."""

    def __init__(self, phase: CarrierRows, columns: dict[str, slice], t: Array) -> None:
        self.phase, self._all_columns = phase, columns
        self.columns = {name: columns[name].start for name in phase.slots}
        self.keyframes = np.unique(phase.keyframe).tolist()
        self.t, self.time = t[self.keyframes], t
        self.rows: dict[int, slice] = {}
        self.active: dict[int, list[Arc]] = {}
        arcs = [(phase.slots[slot], begin) for slot, begin in zip(phase.slot, phase.begin.tolist(), strict=True)]
        self._family = dict(zip(phase.slots, phase.family.tolist(), strict=True))
        self._whole = {arc for arc, whole in zip(arcs, phase.whole.tolist(), strict=True) if whole}
        edges = np.searchsorted(phase.keyframe, [*self.keyframes, len(t)])
        for k, lo, hi in zip(self.keyframes, edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            self.rows[k], self.active[k] = slice(lo, hi), arcs[lo:hi]
        self.last = {arc: float(t[k]) for arc, k in zip(arcs, phase.keyframe.tolist(), strict=True)}  # s

    def list_columns(self, name: str) -> list[int]:
        """Columns of a parameter in the error state."""
        own = self._all_columns[name]
        return list(range(own.start, own.stop))

    def find_inconsistent(self, k: int, here: Points, known: Known) -> list[Arc]:
        """Arcs with integers without which an inconsistent epoch is consistent.

        Parameters
        ----------
        here : a point near enough for the directions to the satellites.
        """
        own, rows = self.rows[k], self._linearise(k, here)
        arcs = self.active[k]
        used = np.array([i for i, arc in enumerate(arcs) if arc in known.of], dtype=int)
        if not len(used):
            return []
        sets = [known.find(arcs[i])[0] for i in used]
        clocks = (np.array([sets.index(one) for one in sets])[:, None] == np.arange(len(sets))).astype(float)
        A = np.concatenate([rows.linear.jacobians["p"][used, 0], clocks[:, clocks.any(axis=0)]], axis=1)
        # with the integers in place of the estimates; a common offset belongs to the clock
        at = np.array([self.columns[arcs[i][0]] for i in used]) - DIM
        off = np.array([known.find(arcs[i])[1] for i in used]) - here.values[0, at]
        # nor are reflections what a float ambiguity left them: they are a part of the noise here
        reflected, of_all = rows.linear.jacobians[REFLECTIONS][used, 0], self._all_columns[REFLECTIONS]
        r = rows.residual[used, 0] + self.phase.wavelength[own][used] * off
        r = r - reflected @ here.values[0, shift(of_all)]
        sigma = np.hypot(rows.stated[used, 0], np.linalg.norm(reflected, axis=1))
        A, r = A / sigma[:, None], r / sigma
        kept = np.ones(len(used), dtype=bool)
        while True:
            Q, _ = np.linalg.qr(A[kept][:, A[kept].any(axis=0)])
            left = r[kept] - Q @ (Q.T @ r[kept])
            freedom = int(kept.sum()) - Q.shape[1]
            if freedom < 1 or left @ left <= 2.0 * gammaincinv(0.5 * freedom, 1.0 - _ALARM):
                break
            share = np.maximum(1.0 - np.sum(Q * Q, axis=1), 1e-9)  # share of its own error that remains in a residual
            kept[np.flatnonzero(kept)[np.argmax(left**2 / share)]] = False
        return [arcs[i] for i in used[~kept]]

    def find_slipped(self, k: int, here: Points) -> tuple[Arc, ...]:
        """Arcs whose carrier phases are off an estimate by more than half of the least slip."""
        off = np.abs(self._linearise(k, here).residual[:, 0]) > self.phase.half_slip[self.rows[k]]
        return tuple(self.active[k][i] for i in np.flatnonzero(off).tolist())

    def _linearise(self, k: int, here: Points) -> Rows:
        own = self.rows[k]
        return linearise(self.phase, here, self._all_columns, own, np.zeros(own.stop - own.start, dtype=int))

    def compute_lasting(
        self, k: int, until: Callable[[Arc], float], since: Mapping[Arc, float] | None = None
    ) -> dict[Arc, float]:
        """Variance, cycles^2, that time-correlated multipath adds to ambiguities at an epoch beyond white noise.

        An ambiguity absorbs errors that last as long as its arc, so a smoother does not observe them.

        Parameters
        ----------
        until : s, the last carrier phase of an arc in use.
        since : s, the first, where that is not the start of the arc.
        """
        own, arcs = self.rows[k], self.active[k]
        duration = np.array([until(arc) - (since or {}).get(arc, arc[1]) for arc in arcs])
        more = self.phase.reflection[own] ** 2 * compute_variance_left(np.maximum(duration, 0.0), self.phase.period)
        return dict(zip(arcs, more.tolist(), strict=True))

    def mark_fixed(self, known: Mapping[int, Known]) -> Array:
        """(E, 2) s, and 1 where enough differences are known, by keyframe; empty where none are integers."""
        some = self.keyframes if np.any(self.phase.family >= 0) else []
        out = [[self.time[k], self.count_differences(k, known[k]) >= ENOUGH] for k in some]
        return np.array(out, dtype=float).reshape(-1, 2)

    def list_arcs(self, known: Mapping[int, Known]) -> CarrierArcs:
        """The arcs, and the epochs at which their ambiguities are held as integers."""
        phase = self.phase
        integer = [arc in known[k].of for k in self.keyframes for arc in self.active[k]]
        return CarrierArcs.from_rows(
            self.time[phase.keyframe], phase.slot, phase.begin, np.array(integer, dtype=bool), list_slots(phase.slots)
        )

    def can(self, arc: Arc) -> bool:
        """Whether it has integers."""
        return self._family[arc[0]] >= 0 and arc in self._whole

    def group_arcs(self, k: int, known: Known) -> dict[int, list[list[Arc]]]:
        """By group, the arcs of an epoch in connected sets, the largest first."""
        out: dict[int, dict[Arc, list[Arc]]] = {}
        for arc in self.active[k]:
            if self.can(arc) and arc not in known.let_go:
                out.setdefault(self._family[arc[0]], {}).setdefault(known.find(arc)[0], []).append(arc)
        return {group: sorted(sets.values(), key=len, reverse=True) for group, sets in out.items()}

    def count_differences(self, k: int, known: Known) -> int:
        """How many differences are known at an epoch."""
        return sum(len(one) - 1 for sets in self.group_arcs(k, known).values() for one in sets)
