"""Integer ambiguity resolution: causally in the filter, and on the smoother's joint covariance.

Ambiguities are fixed as differences of two arcs of a system's signal. A set of differences is fixed at once where

* its bootstrapped success rate is at least 0.999 (Teunissen 1998),
* the second best vector is three times as far away as the best (ratio test: Euler and Schaffrin 1991),

otherwise the set without its most uncertain arc is tried (partial fixing), down to four differences together with those
fixed before: one more than a position needs, so that they check each other. The filter decides with the measurements up
to an epoch and holds the integers from then on. The smoother tests every epoch with the whole drive, holds what it
fixes over the whole of an arc, and tests again.

Correct integers leave the carrier phases of an epoch consistent with one position and one clock per signal, to
millimetres; sets that fail this chi-square test are not held. Where two successive epochs fail it later, the filter
releases all integers together with the position information that they gave, and searches again; the smoother releases
the arcs without which most of their epochs are consistent (data snooping: Baarda 1968), which stay float.

Cycle slips that `graphnav.gnss.arcs` does not find, as of four satellites that nothing checks, are found by the filter:
its robust update follows the IMU, and leaves slipped carrier phases a cycle off. These begin new arcs, whether integers
are looked for or not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.constraints.ambiguities import CarrierRows
from graphnav.constraints.raw_gnss import SATELLITES
from graphnav.constraints.raw_phase import EXACT, REFLECTIONS, WholeCycles
from graphnav.core.progress import Progress
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, DIM
from graphnav.estimation.known_arcs import ENOUGH, Arc, Epochs, Known
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import CarrierArcs
from graphnav.estimation.solvers.decision import DecidedRows
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import FilterPass, SmootherPass, make_points, split_values
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.gnss.integers import decorrelate, find_nearest

_SUCCESS, _RATIO = 0.999, 3.0
_FIXING_ROUNDS = 4  # of the smoother: each sweep uses the integers of the one before; the last finds hardly any
# m, m/s, 1-sigma of position and velocity after wrong integers: wider than from the codes
LOST_PLACE, LOST_SPEED = 10.0, 1.0
LOST_ERRORS = (REFLECTIONS, SATELLITES)  # errors that last, of unit variance, which wrong integers leave wrong
_ANYTHING = 1e6  # variance of one of these before it is reset


@dataclass(frozen=True)
class Fixed:
    """A problem with carrier phases: filtered, smoothed, and the epochs with integer ambiguities."""

    problem: Problem
    forward: FilterPass
    smoothed: SmootherPass
    filtered_epochs: Array  # (E, 2) s, and 1 where fixed
    smoothed_epochs: Array  # (E, 2)
    filtered_arcs: CarrierArcs
    smoothed_arcs: CarrierArcs
    notes: tuple[str, ...] = ()


def split_carriers(problem: Problem, kind: type[CarrierRows] = CarrierRows) -> tuple[Problem, CarrierRows | None]:
    """Split a problem into one without carrier phases that have ambiguities, and these."""
    phase = next((c for c in problem.constraints if isinstance(c, kind)), None)
    if phase is None:
        return problem, None
    return replace(problem, constraints=tuple(c for c in problem.constraints if c is not phase)), phase


def may_fix(problem: Problem, phase: CarrierRows) -> bool:
    """Whether integers are looked for."""
    return problem.settings.raw_gnss.integers and bool(np.any(phase.family >= 0))


def fix(
    problem: Problem,
    phase: CarrierRows,
    about: Points,
    opening: float | None = None,
    progress: Progress | None = None,
) -> Fixed:
    """Add carrier phases to a problem, begin new arcs where they slip, and fix ambiguities as far as possible.

    Parameters
    ----------
    problem : with its noise model, without carriers.
    about : its smoothed states.
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.
    """
    own = tuple(problem.parameters.get(p.name, p) for p in phase.parameters)
    phase = replace(phase, parameters=own)
    whole = _add_phase(problem, phase)
    epochs = Epochs(phase, whole.columns, whole.t)
    search = may_fix(whole, phase)
    causal = _Causal(epochs, search)
    forward = ekf(whole, progress, opening, decide=causal)
    filtered = epochs.mark_fixed(causal.known), epochs.list_arcs(causal.known)
    if causal.anew:
        phase = _split_arcs(phase, problem.t, causal.anew)
        whole = _add_phase(problem, phase)
        epochs = Epochs(phase, whole.columns, whole.t)
    points = make_points(whole, about.states, split_values(problem, about))
    smoothed = smooth_backward(whole, refilter(whole, points, progress), progress)
    known, found = Known(), whole
    for _ in range(_FIXING_ROUNDS if search else 0):
        before = dict(known.of)
        _sweep(epochs, smoothed, known)
        if known.of == before:
            break
        found = _hold_arcs(whole, phase, epochs, known)
        smoothed = smooth_backward(found, refilter(found, smoothed, progress), progress)
        if _let_go(epochs, smoothed, known):
            found = _hold_arcs(whole, phase, epochs, known)
            smoothed = smooth_backward(found, refilter(found, smoothed, progress), progress)
    always = dict.fromkeys(epochs.keyframes, known)
    arcs = epochs.list_arcs(always)
    return Fixed(
        found,
        forward,
        smoothed,
        filtered_epochs=filtered[0],
        smoothed_epochs=epochs.mark_fixed(always),
        filtered_arcs=filtered[1] if search else arcs,
        smoothed_arcs=arcs,
        notes=(_note(epochs, known),) if search else (),
    )


def _add_phase(problem: Problem, phase: CarrierRows) -> Problem:
    return replace(problem, constraints=tuple(sorted((*problem.constraints, phase), key=lambda c: c.name)))


def _split_arcs(phase: CarrierRows, t: Array, anew: Sequence[tuple[Arc, int]]) -> CarrierRows:
    """Split arcs of the carrier phases at keyframes."""
    begin, own = phase.begin.copy(), {p.name: p for p in phase.parameters}
    for (name, since), k in sorted(anew, key=lambda one: one[1]):
        rows = (phase.slot == phase.slots.index(name)) & (phase.begin == since) & (phase.keyframe >= k)
        p = own[name]
        assert p.begins is not None
        if t[k] in p.begins:
            continue
        begin[rows] = t[k]
        at = int(np.searchsorted(p.begins, t[k]))
        initial, sigma = (np.insert(x, at, x[at - 1], axis=0) for x in (p.initial, p.sigma))
        own[name] = replace(p, begins=np.insert(p.begins, at, t[k]), initial=initial, sigma=sigma)
    return replace(phase, begin=begin, parameters=tuple(own.values()))


def _note(epochs: Epochs, known: Known) -> str:
    every = {arc for arcs in epochs.active.values() for arc in arcs}
    return (
        f"gnss_phase: integer ambiguities for {len(known.of)} of {len(every)} carrier-phase arcs, "
        f"{len(known.let_go)} released"
    )


def _decide(
    sets: dict[int, list[list[Arc]]],
    at: dict[str, int],
    values: Array,
    P: Array,
    known: Known,
    lasting: dict[Arc, float],
    impose: bool,
) -> list[tuple[Arc, Arc, int]]:
    """Decide the differences that can be fixed at an epoch.

    Parameters
    ----------
    at : column of each ambiguity.
    values, P : parameters with as many zeros in front as there are states, and the joint covariance.
    lasting : cycles^2, variance of time-correlated errors that P lacks, for arcs without integers.
    impose : whether P does not include the known integers.
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
    alone = [one[0] for some in sets.values() for one in some if len(one) == 1]
    Q[[place[arc] for arc in alone], [place[arc] for arc in alone]] += [lasting[arc] for arc in alone]
    pairs = []
    for some in sets.values():
        apart = [[place[arc] for arc in one] for one in some]
        spread = np.diagonal(Q)[:, None] + np.diagonal(Q)[None] - 2.0 * Q
        first = apart[0][0]
        if len(apart[0]) == 1:  # none is known: the reference against which the others are best determined
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
    while len(order) and given + len(order) >= ENOUGH:
        found = decorrelate(C[np.ix_(order, order)])
        if found.success >= _SUCCESS:
            nearest = find_nearest(a[order], found)
            if nearest.ratio >= _RATIO:
                return [(pairs[i][1], pairs[i][0], int(n)) for i, n in zip(order.tolist(), nearest.best, strict=True)]
        order = order[:-1]
    return []


@dataclass(frozen=True)
class Held:
    """Integers held after an epoch, and the decisions there; immutable."""

    known: Known = field(default_factory=Known)
    odd: bool = False  # the epoch is not consistent with the known integers
    found: tuple[tuple[Arc, Arc, int], ...] = ()  # differences that were found there
    let_go: bool = False  # of all that was known
    anew: tuple[Arc, ...] = ()  # slipped arcs, whose ambiguities are reset
    since: Mapping[Arc, float] = field(default_factory=dict)  # s, start of the arcs that were reset
    fixed: bool = False
    epoch: bool = False  # whether there are carrier phases whose integers are looked for

    def go_on(self) -> Held:
        """The same after a keyframe without carrier phases."""
        return replace(self, found=(), let_go=False, anew=(), epoch=False) if self.epoch else self


def hold_on(before: Held, epochs: Epochs, k: int, here: Points, covariance: Callable[[], Array], search: bool) -> Held:
    """Fix integers with the estimate at a keyframe; release all where two successive epochs contradict them.

    Where carrier phases are off by more than half of the least slip, undetected cycle slips occurred: their ambiguities
    are reset.

    Parameters
    ----------
    search : whether integers are looked for.
    """
    known, anew = before.known.copy(), epochs.find_slipped(k, here)
    for arc in anew:
        known.forget(arc)
    since = {**before.since, **dict.fromkeys(anew, float(epochs.time[k]))}
    if not search:
        return Held(anew=anew, since=since)
    if epochs.find_inconsistent(k, here, known):
        known = Known() if before.odd else known
        fixed = epochs.count_differences(k, known) >= ENOUGH
        return Held(known, True, let_go=before.odd, anew=anew, since=since, fixed=fixed, epoch=True)
    sets, found = epochs.group_arcs(k, known), []
    if not anew and any(len(some) > 1 for some in sets.values()):
        values = np.concatenate([np.zeros(DIM), here.values[0]])
        lasting = epochs.compute_lasting(k, lambda arc: float(epochs.time[k]), since)
        found = _decide(sets, epochs.columns, values, covariance(), known, lasting, impose=False)
    held = known.copy()
    for a, b, n in found:
        held.join(a, b, n)
    if found and epochs.find_inconsistent(k, here, held):
        held, found = known, []
    fixed = epochs.count_differences(k, held) >= ENOUGH
    return Held(held, False, tuple(found), anew=anew, since=since, fixed=fixed, epoch=True)


class _Causal:
    """Actions of the filter at a keyframe: fix integers, hold them, release contradicted ones."""

    def __init__(self, epochs: Epochs, search: bool) -> None:
        self._epochs, self._search = epochs, search
        self.known = {k: Known() for k in epochs.keyframes}  # after each epoch
        self._unknown = {p.name: float(np.max(p.sigma)) for p in epochs.phase.parameters}
        self._held = Held()
        self.anew: list[tuple[Arc, int]] = []  # arcs that are reset, and the keyframes from which on
        self._before = -1  # keyframe of the previous epoch

    def __call__(self, k: int, here: Points, P: Array) -> DecidedRows | None:
        """Integers to hold from a keyframe on, and ambiguities to reset."""
        epochs = self._epochs
        if k not in epochs.active:
            return None
        held = self._held = hold_on(self._held, epochs, k, here, lambda: P, self._search)
        self.known[k] = held.known
        self.anew += [(arc, k) for arc in held.anew]
        if held.let_go:
            self.anew += [(arc, self._before) for arc in epochs.active[self._before]]
        self._before = k
        added, values = np.zeros(len(P)), here.values[0]
        if held.let_go:
            for name, at in epochs.columns.items():
                added[at] = self._unknown[name] ** 2
            added[BLOCKS["p"]], added[BLOCKS["v"]] = LOST_PLACE**2, LOST_SPEED**2
        for name, _ in held.anew:
            added[epochs.columns[name]] = self._unknown[name] ** 2
        lost = [c for name in LOST_ERRORS for c in epochs.list_columns(name)] if held.let_go else []
        added[lost] = _ANYTHING
        count = len(held.found)
        H, r = np.zeros((count + len(lost), len(P))), np.zeros(count + len(lost))
        H[count + np.arange(len(lost)), lost], r[count:] = 1.0, values[np.array(lost, dtype=int) - DIM]
        sigma = np.concatenate([np.full(count, EXACT), np.ones(len(lost))])
        for i, (a, b, n) in enumerate(held.found):
            first, second = epochs.columns[a[0]], epochs.columns[b[0]]
            H[i, first], H[i, second] = 1.0, -1.0
            r[i] = values[first - DIM] - values[second - DIM] - n
        return DecidedRows(H, r, sigma, added) if len(r) or added.any() else None


def _sweep(epochs: Epochs, smoothed: SmootherPass, known: Known) -> None:
    """Test all epochs, those with most arcs first."""
    tried: set[frozenset[frozenset[Arc]]] = set()
    values = np.concatenate([np.zeros((len(smoothed.values), DIM)), smoothed.values], axis=1)
    for k in sorted(epochs.keyframes, key=lambda k: -len(epochs.active[k])):
        sets = epochs.group_arcs(k, known)
        key = frozenset(frozenset(one) for some in sets.values() for one in some)
        if key in tried or all(len(some) == 1 for some in sets.values()):
            continue
        tried.add(key)
        held = known.copy()
        lasting = epochs.compute_lasting(k, epochs.last.__getitem__)
        for a, b, n in _decide(sets, epochs.columns, values[k], smoothed.P[k], known, lasting, impose=True):
            held.join(a, b, n)
        if len(held.of) > len(known.of) and not epochs.find_inconsistent(k, _fix_one(smoothed, k), held):
            known.of = held.of


def _fix_one(points: Points, k: int) -> Points:
    return Points(points.states[k : k + 1], points.values[k : k + 1])


def _hold_arcs(problem: Problem, phase: CarrierRows, epochs: Epochs, known: Known) -> Problem:
    """A problem with rows for the known integers: each arc is held to the first other one at a common epoch."""
    rows: list[tuple[int, str, str, int]] = []
    held = Known()
    for k in epochs.keyframes:
        for sets in epochs.group_arcs(k, known).values():
            for one in sets:
                for arc in one[1:]:
                    if held.find(arc)[0] != held.find(one[0])[0]:
                        n = known.find(arc)[1] - known.find(one[0])[1]
                        held.join(arc, one[0], n)
                        rows.append((k, arc[0], one[0][0], n))
    return add_integers(problem, phase, rows)


def add_integers(problem: Problem, phase: CarrierRows, found: Sequence[tuple[int, str, str, int]]) -> Problem:
    """A problem with rows for differences: keyframe, in that order, two ambiguities, and cycles between them."""
    if not found:
        return problem
    index = {name: i for i, name in enumerate(phase.slots)}
    whole = WholeCycles(
        keyframe=np.array([k for k, *_ in found]), slots=phase.slots,
        pair=np.array([[index[a], index[b]] for _, a, b, _ in found]),
        cycles=np.array([float(n) for *_, n in found]),
        parameters=phase.parameters,  # all, in that order: the columns of ambiguities stay where the carriers' are
    )  # fmt: skip
    return replace(problem, constraints=tuple(sorted((*problem.constraints, whole), key=lambda c: c.name)))


def _let_go(epochs: Epochs, smoothed: SmootherPass, known: Known) -> bool:
    """Release arcs that most of their epochs contradict."""
    seen: Counter[Arc] = Counter()
    odd: Counter[Arc] = Counter()
    for k in epochs.keyframes:
        seen.update(epochs.active[k])
        odd.update(epochs.find_inconsistent(k, _fix_one(smoothed, k), known))
    gone = {arc for arc, count in odd.items() if 2 * count > seen[arc]}
    for arc in gone:
        known.forget(arc)
    known.let_go |= gone
    return bool(gone)
