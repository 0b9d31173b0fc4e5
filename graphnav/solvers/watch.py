"""Watches a filter's fixes for errors that last: a bank of generalised likelihood ratio tests.

A fault that grows slowly passes every test of one fix: the filter follows it. What it cannot do is follow without
having been pushed in the same direction again and again. If the fixes have had a common error b since fix s, the
innovations have the mean G b, where G is what a unit error does to them through the filter (Willsky and Jones 1976,
"A generalized likelihood ratio approach to the detection and estimation of jumps in linear systems"),

    X <- F X                       its effect on the predicted state
    G = I - H X    X <- X + K G    at a fix since s (without I at other measurements)

and with nu ~ N(0, S) white but for that, the error most likely and how much more likely it makes the innovations are

    score = sum G^T S^-1 nu    info = sum G^T S^-1 G    b = info^-1 score    T = score^T info^-1 score

Without a fault T is chi-square with as many degrees of freedom as a fix has components. Onsets are 1, 2, 4 ... fixes
old, more or less: slot l of the bank begins anew at every odd multiple of 2^l.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.special import chdtri, gammaincinv

from graphnav.constraints.base import Constraint
from graphnav.constraints.gnss import GnssPosition, GnssVelocity
from graphnav.rotation import Array

_PATIENCE = 60.0  # s
_EVERY = 8  # fixes between two looks at what is usual
LARGE = 3.0  # sigmas that are stated or that clocks can be off: less is no fault, however certain
_CLOCKS = 0.05  # s, by which the stamps of IMU and receiver may disagree
_BRAKING = 3.0  # m/s^2, of a usual manoeuvre
FALSE_ALARM = 1e-7  # per test: one drive in a hundred of an hour, if errors were Gaussian
LONGEST = 600.0  # s, about, of the oldest onset: what inertial sensors knew ten minutes ago says little


class _Slots:
    """The tests of one constraint: slot l has columns 3 l to 3 l + 2 of those it has in the bank."""

    def __init__(self, columns: slice, L: int, m: int, stated: Array, N: int, moves: bool) -> None:
        self.columns, self.L, self.m = columns, L, m
        self.threshold = float(chdtri(m, FALSE_ALARM))
        self.moves = moves  # a position, which is off by what the vehicle moves while clocks are
        self.stated = stated  # (m,) typical sigma of a whole error
        self.first = np.full(L, -1)  # row at which each slot began, -1 before
        self.inputs = np.zeros((m, L * m))  # what a unit error is to each column: the identity since its slot began
        self.score, self.info = np.zeros((L, m)), np.tile(np.eye(m), (L, 1, 1))
        self.seen = 0
        self.usual = _Usual(m, N)

    def copy(self) -> _Slots:
        other = object.__new__(_Slots)
        other.__dict__ |= self.__dict__
        other.first, other.inputs = self.first.copy(), self.inputs.copy()
        other.score, other.info = self.score.copy(), self.info.copy()
        return other

    def begin(self, row: int) -> slice:
        """Begin the slot whose turn it is; its columns in the bank."""
        self.seen += 1
        slot = min((self.seen & -self.seen).bit_length() - 1, self.L - 1)
        own = slice(slot * self.m, (slot + 1) * self.m)
        self.first[slot], self.score[slot], self.info[slot] = row, 0.0, 0.0
        self.inputs[:, own] = np.eye(self.m)
        return slice(self.columns.start + own.start, self.columns.start + own.stop)


class _Usual:
    """By how much the innovations of a kind are usually larger than the filter says; all copies of a bank share it.

    What half of all fixes do, those not used included, is no fault: the filter has lost its way.
    """

    def __init__(self, m: int, N: int) -> None:
        self.median = 2.0 * float(gammaincinv(0.5 * m, 0.5))
        self.nis, self.factor = np.zeros(N), 1.0

    def add(self, row: int, nis: float) -> None:
        self.nis[row] = nis
        if row % _EVERY == 0:
            self.factor = max(1.0, float(np.median(self.nis[: row + 1])) / self.median)


class Bank:
    """All tests of a filter.

    Parameters
    ----------
    constraints : those whose rows are tested.
    t : (K,) times of the keyframes, s.
    width : of the error state.
    """

    def __init__(self, constraints: Iterable[GnssPosition | GnssVelocity], t: Array, width: int) -> None:
        self._slots: dict[str, _Slots] = {}
        end = 0
        for rows in constraints:
            m = len(rows.axes)
            times = t[rows.keyframe]
            period = float(np.median(np.diff(times))) if len(times) > 1 else LONGEST
            L = 1 + int(np.clip(np.log2(LONGEST / max(period, 1e-3)), 0, 12))
            stated = rows.stated if isinstance(rows, GnssPosition) else rows.sigma
            columns = slice(end, end + L * m)
            moves = isinstance(rows, GnssPosition)
            self._slots[rows.name] = _Slots(columns, L, m, np.median(stated, axis=0), len(rows), moves)
            end += L * m
        self.X = np.zeros((width, end))

    def copy(self) -> Bank:
        """The same, on its own."""
        other = object.__new__(Bank)
        other.X, other._slots = self.X.copy(), {name: slots.copy() for name, slots in self._slots.items()}
        return other

    def forgetful(self) -> Bank:
        """The same without any onset."""
        other = self.copy()
        other.X[:] = 0.0
        for slots in other._slots.values():
            slots.first[:], slots.score[:], slots.info[:], slots.inputs[:] = -1, 0.0, np.eye(slots.m), 0.0
        return other

    def predicted(self, F: Array) -> None:
        """The filter has gone on to the next keyframe."""
        self.X = F @ self.X

    def signature(self, name: str, row: int, H: Array) -> Array:
        """(n m, C) mean of an innovation for unit errors since each onset; a fix of a watched kind is itself one."""
        slots = self._slots.get(name)
        if slots is None:
            return -(H @ self.X)
        self.X[:, slots.begin(row)] = 0.0
        G = -(H @ self.X)
        G.reshape(-1, slots.m, G.shape[1])[:, :, slots.columns] += slots.inputs
        return G

    def seen(self, name: str, row: int, nis: float) -> None:
        """The filter has seen an innovation of so many squared sigmas, used or not."""
        if slots := self._slots.get(name):
            slots.usual.add(row, nis)

    def updated(self, name: str, K: Array, G: Array, weighted: Array, r: Array, speed: float) -> int | None:
        """The filter has used an innovation; the first row of a fault, or None.

        Parameters
        ----------
        K : (D, n m) gain.
        G : (n m, C) its signature, and `weighted` S^-1 G.
        r : (n m,) residual, -nu.
        speed : m/s, of the vehicle.
        """
        self.X += K @ G
        slots = self._slots.get(name)
        if slots is None:
            return None
        L, m = slots.L, slots.m
        slots.score -= (r @ weighted[:, slots.columns]).reshape(L, m)
        G3, S3 = (x[:, slots.columns].reshape(-1, L, m).swapaxes(0, 1) for x in (G, weighted))
        slots.info += G3.swapaxes(1, 2) @ S3
        b = np.linalg.solve(slots.info, slots.score[..., None])[..., 0]
        T = np.sum(slots.score * b, axis=1)
        allowed = slots.stated**2 + (_CLOCKS * speed if slots.moves else _CLOCKS * _BRAKING) ** 2
        T = np.where(np.sum(b**2 / allowed, axis=1) > LARGE**2, T / slots.threshold, 0.0)
        worst = int(np.argmax(T))
        return int(slots.first[worst]) if T[worst] > slots.usual.factor else None


class Verdicts:
    """Which fixes to give up when a fault is found: those from its onset on.

    Unless that outlasts what was used since the fault before, and a minute. Then it is more likely the filter that has
    lost its way with those: it drifts while fixes are refused, and a fault that grows meets it again. So what it used
    since, of any kind, is given up instead, and the fixes are taken back; this in turn is undone if they are refused
    even so. After `LONGEST` of a fault the filter begins anew where the fixes are.
    """

    def __init__(self, watched: Sequence[Constraint], t: Array) -> None:
        self.used = {c.name: np.ones(len(c)) if c.weight is None else c.weight.copy() for c in watched}
        self.anew: set[tuple[str, int]] = set()  # rows at which the filter begins anew
        self._keyframe = {c.name: c.keyframe for c in watched}
        self._t = t
        self._tried: set[tuple[str, int]] = set()
        self._trial: tuple[str, int, int, dict[str, Array]] | None = None  # fixes taken back, and what was used before

    def settle(self, name: str, fault: int, end: int) -> int:
        """Take from use what a fault in rows `fault` to `end` gives reason to; the keyframe to go on from."""
        at, used = self._keyframe[name], self.used[name]
        used[fault:end] = 0.0
        if self._trial is not None and self._trial[0] == name:
            _, begin, until, were = self._trial
            if end > until:
                self._trial = None
            elif np.mean(used[begin:until] == 0.0) > 0.5:
                self._trial = None
                for other, was in were.items():
                    self.used[other][:] = was
                return int(at[_begin(used, _begin(used, begin, 1.0), 0.0)])
        begin = _begin(used, end, 0.0)
        before = _begin(used, begin, 1.0)  # of what was used between two faults
        lasted = self._t[at[end - 1]] - self._t[at[begin]]
        if lasted > LONGEST and (name, begin) not in self.anew:
            used[begin:end] = 1.0
            self.anew.add((name, begin))
            return int(at[begin])
        if (name, begin) not in self._tried and lasted > _PATIENCE and before > 0 and begin - before < end - begin:
            self._tried.add((name, begin))
            self._trial = name, begin, end, {other: u.copy() for other, u in self.used.items()}
            used[begin:end] = 1.0
            first = int(at[_begin(used, before, 0.0)])
            for other, keyframe in self._keyframe.items():
                self.used[other][(keyframe >= first) & (keyframe < at[begin])] = 0.0
            return first
        return int(at[fault])


def _begin(used: Array, end: int, value: float) -> int:
    """First of the rows before `end` that are all used, or all not."""
    other = np.flatnonzero((used[:end] > 0.0) != (value > 0.0))
    return int(other[-1]) + 1 if len(other) else 0
