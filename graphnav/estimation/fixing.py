"""Ambiguities found as integers: in the filter as it goes, and on the smoother's joint covariance.

What is found is always the difference of two arcs of a system's signal. A set of differences is taken at once where

* rounding it would be right with a probability of 0.999 at least (Teunissen 1998),
* the second best vector is three times as far away as the best (ratio test: Euler and Schaffrin 1991),

and if not, that without the most uncertain of its arcs (partial fixing), down to four differences with those that are
known already: one more than a position needs, so that they check each other. The filter decides by what it has seen
when it comes to an epoch, and holds it from then on. The smoother looks at every epoch with all of the drive behind it,
holds what it finds over the whole of an arc, and looks again.

Integers that are right leave the carriers of an epoch consistent with one place and one clock for each signal, to
millimetres: by a chi-square test, without which nothing is held. Where two epochs in a row fail it later on, the filter
lets go of all that it holds, and of what it knew of the place by it, and finds integers again; the smoother of the arcs
that an epoch is consistent without (data snooping: Baarda 1968) for half of their time, which stay real numbers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import gammaincinv  # scipy.stats would take half a second to import

from graphnav.constraints.raw_phase import EXACT, GnssPhase, WholeCycles
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, DIM
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.decision import Decision
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.linearise import Points, linearise
from graphnav.estimation.solvers.passes import FilterPass, Progress, SmootherPass, points_of, values_of
from graphnav.estimation.solvers.rts import backward
from graphnav.gnss.integers import decorrelate, find_nearest

_SUCCESS, _RATIO, _FEWEST = 0.999, 3.0, 4
_ROUNDS = 4  # of the smoother: what one finds tells the next, and the last finds next to nothing
LOST_PLACE, LOST_SPEED = 10.0, 1.0  # m, m/s, 1-sigma of what is known where integers were wrong: less than codes tell
_ALARM = 0.001  # of epochs with right integers that fail the test of consistency
Arc = tuple[str, float]  # its ambiguity, and when it begins, s


@dataclass
class Known:
    """Differences that have been found: each arc with an integer against the first of those it hangs together with."""

    of: dict[Arc, tuple[Arc, int]] = field(default_factory=dict)  # N_arc - N_first
    let_go: set[Arc] = field(default_factory=set)

    def find(self, arc: Arc) -> tuple[Arc, int]:
        """The first arc of those that this one hangs together with, and the difference from it."""
        return self.of.get(arc, (arc, 0))

    def join(self, a: Arc, b: Arc, cycles: int) -> None:
        """N_a - N_b is so many cycles."""
        (first, of_a), (other, of_b) = self.find(a), self.find(b)
        if first == other:
            return
        moved = of_a - of_b - cycles
        self.of |= {arc: (first, n + moved) for arc, (root, n) in self.of.items() if root == other}
        self.of |= {first: (first, 0), other: (first, moved)}

    def forget(self, arc: Arc) -> None:
        """It is not known any more; what hangs together through it still does."""
        root, _ = self.of.pop(arc, (None, 0))
        if root == arc:
            rest = [(other, n) for other, (first, n) in self.of.items() if first == arc]
            for other, n in rest:
                self.of[other] = rest[0][0], n - rest[0][1]


@dataclass(frozen=True)
class Fixed:
    """A problem with carriers: filtered, smoothed, and which of its epochs have ambiguities that are integers."""

    problem: Problem
    forward: FilterPass
    smoothed: SmootherPass
    filtered_epochs: Array  # (E, 2) s, and 1 where fixed
    smoothed_epochs: Array  # (E, 2)
    notes: tuple[str, ...] = ()


def split_carriers(problem: Problem) -> tuple[Problem, GnssPhase | None]:
    """A problem without its carriers, and these."""
    phase = next((c for c in problem.constraints if isinstance(c, GnssPhase)), None)
    if phase is None:
        return problem, None
    return replace(problem, constraints=tuple(c for c in problem.constraints if c is not phase)), phase


def fix(
    problem: Problem,
    phase: GnssPhase,
    about: Points,
    opening: float | None = None,
    progress: Progress | None = None,
) -> Fixed:
    """Carriers added to a problem, their ambiguities found as far as they can be.

    Parameters
    ----------
    problem : with its noise model, without carriers.
    about : its smoothed states.
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.
    """
    own = tuple(problem.parameters.get(p.name, p) for p in phase.parameters)
    phase = replace(phase, parameters=own)
    whole = replace(problem, constraints=tuple(sorted((*problem.constraints, phase), key=lambda c: c.name)))
    epochs = Epochs(phase, whole.columns, whole.t)
    search = whole.settings.raw_gnss.integers
    causal = _Causal(epochs)
    forward = ekf(whole, progress, opening, decide=causal if search else None)
    points = points_of(whole, about.states, values_of(problem, about))
    smoothed = backward(whole, refilter(whole, points, progress), progress)
    known, found = Known(), whole
    for _ in range(_ROUNDS if search else 0):
        before = dict(known.of)
        _sweep(epochs, whole, smoothed, known)
        if known.of == before:
            break
        found = _hold_arcs(whole, phase, epochs, known)
        smoothed = backward(found, refilter(found, smoothed, progress), progress)
        if _let_go(epochs, found, smoothed, known):
            found = _hold_arcs(whole, phase, epochs, known)
            smoothed = backward(found, refilter(found, smoothed, progress), progress)
    filtered = causal.epochs if search else np.stack([epochs.t, np.zeros(len(epochs.t))], -1)
    fixed = np.array([epochs.differences(k, known) >= _FEWEST for k in epochs.keyframes], dtype=float)
    return Fixed(
        found, forward, smoothed, filtered, np.stack([epochs.t, fixed], -1), (_note(epochs, known),) if search else ()
    )


def _note(epochs: Epochs, known: Known) -> str:
    every = {arc for arcs in epochs.active.values() for arc in arcs}
    return (
        f"gnss_phase: {len(known.of)} of {len(every)} arcs of carriers have integer ambiguities; "
        f"{len(known.let_go)} were let go of"
    )


class Epochs:
    """Which arcs there are at each keyframe with carriers, and where their numbers stand."""

    def __init__(self, phase: GnssPhase, columns: dict[str, slice], t: Array) -> None:
        self.phase, self._all_columns = phase, columns
        self.columns = {name: columns[name].start for name in phase.slots}
        self.keyframes = np.unique(phase.keyframe).tolist()
        self.t, self.time = t[self.keyframes], t
        self.rows: dict[int, slice] = {}
        self.active: dict[int, list[Arc]] = {}
        arcs = [(phase.slots[slot], begin) for slot, begin in zip(phase.slot, phase.begin.tolist(), strict=True)]
        self._group = dict(zip(phase.slots, phase.group.tolist(), strict=True))
        self._whole = {arc for arc, whole in zip(arcs, phase.whole.tolist(), strict=True) if whole}
        edges = np.searchsorted(phase.keyframe, [*self.keyframes, len(t)])
        for k, lo, hi in zip(self.keyframes, edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            self.rows[k], self.active[k] = slice(lo, hi), arcs[lo:hi]

    def odd(self, k: int, here: Points, known: Known) -> list[Arc]:
        """Arcs with integers that an epoch is not consistent with, and is without them.

        Parameters
        ----------
        here : a point near enough for the directions to the satellites.
        """
        own = self.rows[k]
        rows = linearise(self.phase, here, self._all_columns, own, np.zeros(own.stop - own.start, dtype=int))
        arcs = self.active[k]
        used = np.array([i for i, arc in enumerate(arcs) if arc in known.of], dtype=int)
        if not len(used):
            return []
        sets = [known.find(arcs[i])[0] for i in used]
        clocks = (np.array([sets.index(one) for one in sets])[:, None] == np.arange(len(sets))).astype(float)
        A = np.concatenate([rows.linear.jacobians["p"][used, 0], clocks[:, clocks.any(axis=0)]], axis=1)
        # with the integers in place of the estimates; what they have in common is a clock's
        at = np.array([self.columns[arcs[i][0]] for i in used]) - DIM
        off = np.array([known.find(arcs[i])[1] for i in used]) - here.values[0, at]
        r = rows.residual[used, 0] + self.phase.wavelength[own][used] * off
        A, r = A / rows.stated[used], r / rows.stated[used, 0]
        kept = np.ones(len(used), dtype=bool)
        while True:
            Q, _ = np.linalg.qr(A[kept][:, A[kept].any(axis=0)])
            left = r[kept] - Q @ (Q.T @ r[kept])
            spare = int(kept.sum()) - Q.shape[1]
            if spare < 1 or left @ left <= 2.0 * gammaincinv(0.5 * spare, 1.0 - _ALARM):
                break
            share = np.maximum(1.0 - np.sum(Q * Q, axis=1), 1e-9)  # of its own error that is left in a residual
            kept[np.flatnonzero(kept)[np.argmax(left**2 / share)]] = False
        return [arcs[i] for i in used[~kept]]

    def can(self, arc: Arc) -> bool:
        """Whether it has integers."""
        return self._group[arc[0]] >= 0 and arc in self._whole

    def sets(self, k: int, known: Known) -> dict[int, list[list[Arc]]]:
        """By group, the arcs of an epoch, those together that hang together, the largest set first."""
        out: dict[int, dict[Arc, list[Arc]]] = {}
        for arc in self.active[k]:
            if self.can(arc) and arc not in known.let_go:
                out.setdefault(self._group[arc[0]], {}).setdefault(known.find(arc)[0], []).append(arc)
        return {group: sorted(sets.values(), key=len, reverse=True) for group, sets in out.items()}

    def differences(self, k: int, known: Known) -> int:
        """How many differences are known at an epoch."""
        return sum(len(one) - 1 for sets in self.sets(k, known).values() for one in sets)


def _decide(
    sets: dict[int, list[list[Arc]]], at: dict[str, int], values: Array, P: Array, known: Known, impose: bool
) -> list[tuple[Arc, Arc, int]]:
    """Differences that can be told at an epoch.

    Parameters
    ----------
    at : column of each ambiguity.
    values, P : parameters with as many zeros in front as there are states, and the joint covariance.
    impose : whether P is without what is known.
    """
    arcs = [arc for some in sets.values() for one in some for arc in one]
    place = {arc: i for i, arc in enumerate(arcs)}
    columns = np.array([at[name] for name, _ in arcs], dtype=int)
    x, Q = values[columns], P[np.ix_(columns, columns)]
    given = sum(len(one) - 1 for some in sets.values() for one in some)
    if impose and given:
        H, n = np.zeros((given, len(arcs))), np.zeros(given)
        pairs = [(one[0], arc) for some in sets.values() for one in some for arc in one[1:]]
        for i, (arc, other) in enumerate(pairs):
            H[i, place[other]], H[i, place[arc]] = 1.0, -1.0
            n[i] = known.find(other)[1] - known.find(arc)[1]
        K = np.linalg.solve(H @ Q @ H.T + EXACT**2 * np.eye(given), H @ Q).T
        x = x + K @ (n - H @ x)
        I = np.eye(len(arcs)) - K @ H
        Q = I @ Q @ I.T + EXACT**2 * K @ K.T
    pairs = []
    for some in sets.values():
        apart = [[place[arc] for arc in one] for one in some]
        spread = np.diagonal(Q)[:, None] + np.diagonal(Q)[None] - 2.0 * Q
        first = apart[0][0]
        if len(apart[0]) == 1:  # none is known: the one that the others are told best against
            ends = [one[0] for one in apart]
            first = ends[int(np.argmin(np.median(spread[np.ix_(ends, ends)], axis=1)))]
        pairs += [(arcs[first], arcs[one[0]]) for one in apart if first not in one]
    if not pairs:
        return []
    T = np.zeros((len(pairs), len(arcs)))
    for i, (one, other) in enumerate(pairs):
        T[i, place[other]], T[i, place[one]] = 1.0, -1.0
    a, C = T @ x, T @ Q @ T.T
    order = np.argsort(np.diagonal(C), kind="stable")
    while len(order) and given + len(order) >= _FEWEST:
        found = decorrelate(C[np.ix_(order, order)])
        if found.success >= _SUCCESS:
            nearest = find_nearest(a[order], found)
            if nearest.ratio >= _RATIO:
                return [(pairs[i][1], pairs[i][0], int(n)) for i, n in zip(order.tolist(), nearest.best, strict=True)]
        order = order[:-1]
    return []


@dataclass(frozen=True)
class Held:
    """What is held behind an epoch, and what was decided there; nothing of it changes."""

    known: Known = field(default_factory=Known)
    odd: bool = False  # the epoch is not consistent with what is known
    found: tuple[tuple[Arc, Arc, int], ...] = ()  # differences that were found there
    let_go: bool = False  # of all that was known
    fixed: bool = False
    epoch: bool = False  # there are carriers

    def go_on(self) -> Held:
        """The same behind a keyframe without carriers."""
        return replace(self, found=(), let_go=False, epoch=False) if self.epoch else self


def hold_on(before: Held, epochs: Epochs, k: int, here: Points, covariance: Callable[[], Array]) -> Held:
    """Find integers by what is known at a keyframe; let go of all where two epochs in a row contradict them."""
    known = before.known
    if odd := bool(epochs.odd(k, here, known)):
        known = Known() if before.odd else known
        fixed = epochs.differences(k, known) >= _FEWEST
        return Held(known, True, let_go=before.odd, fixed=fixed, epoch=True)
    sets, found = epochs.sets(k, known), []
    if any(len(some) > 1 for some in sets.values()):
        values = np.concatenate([np.zeros(DIM), here.values[0]])
        found = _decide(sets, epochs.columns, values, covariance(), known, impose=False)
    if found:
        held = replace(known, of=known.of.copy())
        for a, b, n in found:
            held.join(a, b, n)
        if epochs.odd(k, here, held):
            found = []
        else:
            known = held
    return Held(known, odd, tuple(found), fixed=epochs.differences(k, known) >= _FEWEST, epoch=True)


class _Causal:
    """What the filter does at a keyframe: find integers, hold them, let go of those that do not hold."""

    def __init__(self, epochs: Epochs) -> None:
        self._epochs, self._fixed = epochs, dict.fromkeys(epochs.keyframes, 0.0)
        self._unknown = {p.name: float(np.max(p.sigma)) for p in epochs.phase.parameters}
        self._held = Held()

    @property
    def epochs(self) -> Array:
        """(E, 2) s, and 1 where fixed."""
        return np.stack([self._epochs.t, list(self._fixed.values())], -1)

    def __call__(self, k: int, here: Points, P: Array) -> Decision | None:
        """Integers to hold from a keyframe on, and ambiguities that are not known any more."""
        epochs = self._epochs
        if k not in epochs.active:
            return None
        held = self._held = hold_on(self._held, epochs, k, here, lambda: P)
        self._fixed[k] = float(held.fixed)
        added, values = np.zeros(len(P)), here.values[0]
        if held.let_go:
            for name, at in epochs.columns.items():
                added[at] = self._unknown[name] ** 2
            added[BLOCKS["p"]], added[BLOCKS["v"]] = LOST_PLACE**2, LOST_SPEED**2
        H, r = np.zeros((len(held.found), len(P))), np.zeros(len(held.found))
        for i, (a, b, n) in enumerate(held.found):
            first, second = epochs.columns[a[0]], epochs.columns[b[0]]
            H[i, first], H[i, second] = 1.0, -1.0
            r[i] = values[first - DIM] - values[second - DIM] - n
        return Decision(H, r, np.full(len(r), EXACT), added) if len(r) or held.let_go else None


def _sweep(epochs: Epochs, problem: Problem, smoothed: SmootherPass, known: Known) -> None:
    """Look at all epochs, those with most arcs first."""
    tried: set[frozenset[frozenset[Arc]]] = set()
    values = np.concatenate([np.zeros((len(smoothed.values), DIM)), smoothed.values], axis=1)
    for k in sorted(epochs.keyframes, key=lambda k: -len(epochs.active[k])):
        sets = epochs.sets(k, known)
        key = frozenset(frozenset(one) for some in sets.values() for one in some)
        if key in tried or all(len(some) == 1 for some in sets.values()):
            continue
        tried.add(key)
        held = replace(known, of=known.of.copy())
        for a, b, n in _decide(sets, epochs.columns, values[k], smoothed.P[k], known, impose=True):
            held.join(a, b, n)
        if len(held.of) > len(known.of) and not epochs.odd(k, _one(smoothed, k), held):
            known.of = held.of


def _one(points: Points, k: int) -> Points:
    return Points(points.states[k : k + 1], points.values[k : k + 1])


def _hold_arcs(problem: Problem, phase: GnssPhase, epochs: Epochs, known: Known) -> Problem:
    """A problem with rows for what is known: each arc is held to the first other where both are there at once."""
    rows: list[tuple[int, str, str, int]] = []
    held = Known()
    for k in epochs.keyframes:
        for sets in epochs.sets(k, known).values():
            for one in sets:
                for arc in one[1:]:
                    if held.find(arc)[0] != held.find(one[0])[0]:
                        n = known.find(arc)[1] - known.find(one[0])[1]
                        held.join(arc, one[0], n)
                        rows.append((k, arc[0], one[0][0], n))
    return with_integers(problem, phase, rows)


def with_integers(problem: Problem, phase: GnssPhase, found: Sequence[tuple[int, str, str, int]]) -> Problem:
    """A problem with rows for differences: keyframe, in that order, two ambiguities, and cycles between them."""
    if not found:
        return problem
    index = {name: i for i, name in enumerate(phase.slots)}
    whole = WholeCycles(
        keyframe=np.array([k for k, *_ in found]), slots=phase.slots,
        pair=np.array([[index[a], index[b]] for _, a, b, _ in found]),
        cycles=np.array([float(n) for *_, n in found]),
        parameters=tuple(p for p in phase.parameters if p.name in index),
    )  # fmt: skip
    return replace(problem, constraints=tuple(sorted((*problem.constraints, whole), key=lambda c: c.name)))


def _let_go(epochs: Epochs, problem: Problem, smoothed: SmootherPass, known: Known) -> bool:
    """Give up arcs that most of their epochs are not consistent with."""
    seen: Counter[Arc] = Counter()
    odd: Counter[Arc] = Counter()
    for k in epochs.keyframes:
        seen.update(epochs.active[k])
        odd.update(epochs.odd(k, _one(smoothed, k), known))
    gone = {arc for arc, count in odd.items() if 2 * count > seen[arc]}
    for arc in gone:
        known.forget(arc)
    known.let_go |= gone
    return bool(gone)
