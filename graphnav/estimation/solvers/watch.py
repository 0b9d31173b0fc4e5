"""Watches a filter's fixes for errors that last: a bank of generalised likelihood ratio tests.

A fault that grows slowly passes every test of one fix: the filter follows it. What it cannot do is follow without
having been pushed in the same direction again and again. If the fixes have had an error U b since fix s, of which b are
a part that stays and one that grows, U = [I, I (t - s)], the innovations have the mean G b, where G is what that does
to them through the filter (Willsky and Jones 1976, "A generalized likelihood ratio approach to the detection and
estimation of jumps in linear systems"; Willsky 1976, "A survey of design methods for failure detection", of ramps),

    X <- F X                       its effect on the predicted state
    G = U - H X    X <- X + K G    at a fix since s (without U at other measurements)

and with nu ~ N(0, S) white but for that, the error most likely and how much more likely it makes the innovations are

    score = sum G^T S^-1 nu    info = W^-2 + sum G^T S^-1 G    b = info^-1 score    T = score^T info^-1 score

with W, how large such errors get, for what one fix cannot tell. Without a fault T is chi-square with twice as many
degrees of freedom as a fix has components, or less. Onsets are 1, 2, 4 ... fixes old, more or less: slot l of the bank
begins anew at every odd multiple of 2^l.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Iterable, Mapping
from typing import Self

import numpy as np
from scipy.linalg.lapack import dtrtrs
from scipy.special import chdtri, gammaincinv

from graphnav.constraints.base import Constraint
from graphnav.core.rotation import Array
from graphnav.estimation.solvers.recursion import move, solve

PATIENCE = 60.0  # s, after which fixes that are refused may be the ones that are right
_EVERY = 8  # fixes between two looks at what is usual
LARGE = 3.0  # sigmas that are stated or that clocks can be off: less is no fault, however certain
_CLOCKS = 0.05  # s, by which the stamps of IMU and receiver may disagree
_BRAKING = 3.0  # m/s^2, of a usual manoeuvre
_ONSET = float(chdtri(1, 0.05))  # of T, by which an onset may be less likely than the likeliest: 95 %
FALSE_ALARM = 1e-7  # per test: one drive in a hundred of an hour, if errors were Gaussian
WIDE = {"m": 100.0, "m/s": 10.0}  # reflections in a city are off by up to a hundred metres; wheels by their speed
MINUTE = 60.0  # s, in which an error may grow by as much as it can be
LONGEST = 600.0  # s, about, of the oldest onset: what inertial sensors knew ten minutes ago says little


def matters(rows: Constraint, error: Array, speed: Array | float) -> Array:
    """(...) whether errors (..., m) of fixes at speeds (...), m/s, are large enough to be faults, however certain."""
    # a position is off by what the vehicle moves while clocks are
    clocks = _CLOCKS * np.asarray(speed) if rows.fix_of == "p" else np.asarray(_CLOCKS * _BRAKING)
    return np.asarray(np.sum(error**2 / (rows.typical_error() ** 2 + clocks[..., None] ** 2), axis=-1) > LARGE**2)


class _Slots:
    """The tests of one constraint: slot l has columns c l to c (l + 1) of those it has in the bank.

    The first m of them are of the part of an error that stays, the others of what it grows by in a minute: c is 2 m
    where errors may grow, else m.
    """

    def __init__(self, begin: int, L: int, rows: Constraint, drifts: bool) -> None:
        m = len(rows.axes)
        c = 2 * m if drifts else m
        self.columns, self.L, self.m, self.drifts = slice(begin, begin + L * c), L, m, drifts
        self.threshold = float(chdtri(c, FALSE_ALARM))
        self.rows = rows
        self.first = np.full(L, np.nan)  # when each slot began, NaN before
        self.inputs = np.zeros((m, L, c // m, m))  # U of each slot
        self.one, self.prior = np.eye(m), np.eye(c) / WIDE[rows.unit] ** 2
        self.score, self.info = np.zeros((L, c)), np.tile(self.prior, (L, 1, 1))
        self.seen = 0
        self.typical_sigmas = _InnovationLevel(m)

    def copy(self) -> _Slots:
        other = object.__new__(_Slots)
        other.__dict__ |= self.__dict__
        other.first, other.inputs = self.first.copy(), self.inputs.copy()
        other.score, other.info = self.score.copy(), self.info.copy()
        return other

    def forget(self) -> None:
        """Begin none again until its turn."""
        self.first[:], self.score[:], self.info[:], self.inputs[:] = np.nan, 0.0, self.prior, 0.0

    def begin(self, t: float) -> slice:
        """Begin the slot whose turn it is at a fix, and let the others grow; its columns in the bank."""
        self.seen += 1
        slot = min((self.seen & -self.seen).bit_length() - 1, self.L - 1)
        self.first[slot], self.score[slot], self.info[slot] = t, 0.0, self.prior
        self.inputs[:, slot, 0] = self.one
        if self.drifts:
            minutes = np.where(np.isnan(self.first), 0.0, (t - self.first) / MINUTE)
            self.inputs[:, :, 1] = minutes[:, None] * self.one[:, None]
        c = len(self.prior)
        return slice(self.columns.start + c * slot, self.columns.start + c * (slot + 1))

    def found(self, score: Array, G: Array, weighted: Array, speed: float) -> float | None:
        """When a fault began that a fix adds enough to be sure of, or None.

        Parameters
        ----------
        score : (L c,) G^T S^-1 nu.
        G : (n m, L c) signature, and `weighted` S^-1 G.
        """
        self.score += score.reshape(self.score.shape)
        G3, S3 = (x.reshape(-1, *self.score.shape).swapaxes(0, 1) for x in (G, weighted))
        self.info += G3.swapaxes(1, 2) @ S3
        b = np.linalg.solve(self.info, self.score[..., None])[..., 0]
        T = np.einsum("lm,lm->l", self.score, b) / self.threshold
        if T.max() <= self.typical_sigmas.factor:
            return None
        now = np.einsum("mlk,lk->lm", self.inputs.reshape(self.m, *b.shape), b)
        T = np.where(matters(self.rows, now, speed), T, 0.0)
        if T.max() <= self.typical_sigmas.factor:
            return None
        # of the onsets that are about as likely the latest: it takes least
        return float(np.max(self.first[T.max() - _ONSET / self.threshold <= T]))


def _slots(constraints: Iterable[Constraint], t: Array | None, period: float, drifts: bool = True) -> dict[str, _Slots]:
    """Slots of each constraint, their columns behind each other; t (K,) of the keyframes, s, tells the period."""
    out: dict[str, _Slots] = {}
    end = 0
    for rows in constraints:
        if t is not None and len(rows) > 1:
            period = float(np.median(np.diff(t[rows.keyframe])))
        L = 1 + int(np.clip(np.log2(LONGEST / max(period, 1e-3)), 0, 12))
        out[rows.name] = _Slots(end, L, rows, drifts)
        end = out[rows.name].columns.stop
    return out


def _width(some: Mapping[str, _Slots]) -> int:
    """How many columns a bank has."""
    return max((slots.columns.stop for slots in some.values()), default=0)


class _InnovationLevel:
    """By how much the innovations of a kind are usually larger than the filter says; all copies of a bank share it.

    What half of all fixes do, those not used included, is no fault: the filter has lost its way. But for those of a
    fault that goes on and has not lasted for long: soon after the start they are half of all by themselves.
    """

    def __init__(self, m: int) -> None:
        self.median = 2.0 * float(gammaincinv(0.5 * m, 0.5))
        self.t, self.nis, self.used, self.factor = array("d"), array("d"), array("b"), 1.0

    def add(self, t: float, nis: float, used: bool = True) -> None:
        k = bisect_left(self.t, t)
        if k < len(self.t) and self.t[k] == t:
            self.nis[k], self.used[k] = nis, used
        else:
            self.t.insert(k, t)
            self.nis.insert(k, nis)
            self.used.insert(k, used)
        if k % _EVERY == 0:
            before = np.flatnonzero(np.frombuffer(self.used, dtype=np.int8)[:k])
            begin = int(before[-1]) + 1 if len(before) else 0
            known = begin if begin < k and self.t[k - 1] - self.t[begin] <= PATIENCE else k + 1
            if known:
                self.factor = max(1.0, float(np.median(np.frombuffer(self.nis)[:known])) / self.median)


class _Tests:
    """The tests of some constraints, and what unit errors since their onsets do to an estimate: X (D, C)."""

    _slots: dict[str, _Slots]
    X: Array

    def __contains__(self, name: str) -> bool:
        return name in self._slots

    def copy(self) -> Self:
        """The same, on its own."""
        other = object.__new__(type(self))
        other.__dict__ |= self.__dict__
        other._slots = {name: slots.copy() for name, slots in self._slots.items()}
        return other

    def forgetful(self) -> Self:
        """The same without any onset."""
        other = self.copy()
        other.X = np.zeros_like(self.X)
        for slots in other._slots.values():
            slots.forget()
        return other


class Bank(_Tests):
    """All tests of a filter.

    Parameters
    ----------
    constraints : those whose rows are tested.
    t : (K,) times of the keyframes, s.
    width : of the error state.
    drifts : whether errors may grow, too.
    """

    def __init__(self, constraints: Iterable[Constraint], t: Array, width: int, drifts: bool = True) -> None:
        self._slots, self._t = _slots(constraints, t, LONGEST, drifts), t
        self.X = np.zeros((width, _width(self._slots)))

    def copy(self) -> Bank:
        """The same, on its own."""
        other = super().copy()
        other.X = self.X.copy()
        return other

    def predicted(self, F: Array, decay: Array) -> None:
        """The filter has gone on to the next keyframe, by a step as `graphnav.estimation.solvers.recursion` has it."""
        self.X = move(F, decay, self.X)

    def seen(self, name: str, k: int, nis: float, used: bool) -> None:
        """The filter has seen an innovation of so many squared sigmas, used or not."""
        if slots := self._slots.get(name):
            slots.typical_sigmas.add(float(self._t[k]), nis, used)

    def updated(self, name: str, k: int, H: Array, K: Array, r: Array, root: Array, speed: float) -> float | None:
        """The filter has used rows at keyframe k; when a fault began that they are enough to be sure of, or None.

        Parameters
        ----------
        H, K : (n m, D) and the gain (D, n m).
        r : (n m,) residual, -nu, and the lower root of its covariance S.
        speed : m/s, of the vehicle.
        """
        if name not in self:
            self.X -= K @ (H @ self.X)
            return None
        slots = self._slots[name]
        self.X[:, slots.begin(float(self._t[k]))] = 0.0
        G = -(H @ self.X)
        own = G[:, slots.columns]
        own[:] = (own.reshape(-1, *slots.inputs.shape) + slots.inputs).reshape(own.shape)  # a fix itself has the error
        weighted = own.copy()
        solve(root, weighted)
        self.X += K @ G
        return slots.found(-(r @ weighted), own, weighted, speed)


class Watch(_Tests):
    """The same tests beside a square-root message R y = z, which is then R y = z - R X b for errors b since each onset.

    Of errors that stay alone: one that grows may as well be the IMU's, and no evidence decides as it drives. With
    columns B = U / sigma for them at a fix, the QR that takes in its rows leaves behind, below those of the message,
    rho - Gamma b ~ N(0, 1): rho^T rho is its NIS, and Gamma^T rho and Gamma^T Gamma add to score and info.

    Parameters
    ----------
    constraints : those whose rows are tested.
    period : s, between fixes.
    width : of the error state.
    """

    def __init__(self, constraints: Iterable[Constraint], period: float, width: int) -> None:
        self._slots = _slots(constraints, None, period, drifts=False)
        self._X: Array | None = np.zeros((width, _width(self._slots)))
        self._stands: tuple[Array, Array] | None = None  # R and R X

    @property
    def X(self) -> Array:  # type: ignore[override]
        """(D, C) what a unit error since each onset does to the estimate."""
        if self._X is None:
            assert self._stands is not None
            self._X, self._stands = dtrtrs(*self._stands)[0], None
        return self._X

    @X.setter
    def X(self, X: Array) -> None:
        self._X, self._stands = X, None

    def stands(self, R: Array, Z: Array) -> None:
        """The message has come to a triangular R (D, D), with Z = R X (D, C) beside it."""
        self._X, self._stands = None, (R, Z)

    def begin(self, name: str, t: float, sigma: Array) -> tuple[slice, slice, Array]:
        """Begin an onset with fixes of these sigmas (n, m): its columns, those of the kind, and B (n m, L c)."""
        slots = self._slots[name]
        own = slots.begin(t)
        inputs = slots.inputs.reshape(slots.m, -1)
        return own, slots.columns, (inputs / sigma[..., None]).reshape(sigma.size, -1)

    def found(self, name: str, t: float, rho: Array, Gamma: Array, speed: float) -> float | None:
        """When a fault began, or None, by what a fix has left behind: rho (n m,) and Gamma (n m, L c) of its kind."""
        slots = self._slots[name]
        slots.typical_sigmas.add(t, float(rho @ rho))
        return slots.found(rho @ Gamma, Gamma, Gamma, speed)
