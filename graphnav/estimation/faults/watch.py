"""Tests of a filter's fixes for persistent errors: a bank of generalised likelihood ratio tests.

A slowly growing fault passes every test of a single fix, because the filter follows it; but its innovations then have a
consistent sign. If the fixes have had an error U b since fix s, of which b are a part that stays and one that grows, U
= [I, I (t - s)], the innovations have the mean G b, with G the response of the innovations through the filter (Willsky
and Jones 1976, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear systems";
Willsky 1976, "A survey of design methods for failure detection", of ramps),

    X <- F X                       its effect on the predicted state
    G = U - H X    X <- X + K G    at a fix since s (without U at other measurements)

and with nu ~ N(0, S) otherwise white, the most likely error and its log-likelihood ratio (times two) are

    score = sum G^T S^-1 nu    info = W^-2 + sum G^T S^-1 G    b = info^-1 score    T = score^T info^-1 score

with W the prior size of such errors. Without a fault T is chi-square with twice as many degrees of freedom as a fix has
components, or less. Onsets are 1, 2, 4 ... fixes old, more or less: slot l of the bank restarts at every odd multiple
of 2^l.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dtrtrs
from scipy.special import chdtri, gammaincinv

from graphnav.constraints.base import Constraint
from graphnav.core.rotation import Array
from graphnav.estimation.faults.likelihood_ratio import (
    add_row,
    begin_slot,
    count_remembered,
    follow_filter,
)

if TYPE_CHECKING:
    from graphnav.estimation.solvers.passes import Updates
    from graphnav.estimation.solvers.stack import Stack

PATIENCE = 60.0  # s, after which rejected fixes may be the correct ones
_EVERY = 8  # fixes between updates of the innovation level
LARGE = 3.0  # in sigmas of stated and clock errors: smaller errors are no fault, however significant
_CLOCKS = 0.05  # s, by which the stamps of IMU and receiver may disagree
_BRAKING = 3.0  # m/s^2, of a usual manoeuvre
_ONSET = float(chdtri(1, 0.05))  # of T, by which an onset may be less likely than the most likely one: 95 %
FALSE_ALARM = 1e-7  # per test: one drive in a hundred of an hour, if errors were Gaussian
FAULT_COST = -float(np.log(FALSE_ALARM))  # negative prior log-odds of a fault
SIZES = {"m": 100.0, "m/s": 10.0}  # multipath errors in a city reach a hundred metres; wheel errors their speed
MINUTE = 60.0  # s, in which an error may grow to its prior size
_MEMORY = 64  # keyframes with fixes for which the state of the tests is kept
OLDEST = 600.0  # s, about, of the oldest onset: inertial information from ten minutes ago is negligible


class _Slots:
    """The tests of one constraint: slot l has columns c l to c (l + 1) of those it has in the bank.

    The first m of them are of the part of an error that stays, the others of what it grows by in a minute: c is 2 m
    where errors may grow, else m. What they know is `memory`, as `likelihood_ratio` has it.
    """

    def __init__(self, begin: int, L: int, rows: Constraint, drifts: bool) -> None:
        self.m = len(rows.axes)
        self.L, self.c = L, 2 * self.m if drifts else self.m
        self.columns = slice(begin, begin + L * self.c)
        self.threshold = float(chdtri(self.c, FALSE_ALARM))
        self.fix_of, self.typical_error, self.prior = (
            rows.fix_of,
            rows.compute_typical_error(),
            SIZES[rows.unit] ** -2.0,
        )
        self.memory = np.zeros(count_remembered(L, self.c))
        self.typical_sigmas = _InnovationLevel(self.m)
        self.forget()

    @property
    def first(self) -> Array:
        """(L,) s, when each slot began, NaN before."""
        return self.memory[: self.L]

    @property
    def score(self) -> Array:
        """(L, c) sum G^T S^-1 nu."""
        return self.memory[self.L : self.L * (1 + self.c)].reshape(self.L, self.c)

    @property
    def info(self) -> Array:
        """(L, c, c) W^-2 + sum G^T S^-1 G."""
        return self.memory[self.L * (1 + self.c) : -1].reshape(self.L, self.c, self.c)

    def copy(self) -> _Slots:
        """The same, on its own."""
        other = copy(self)
        other.memory = self.memory.copy()
        return other

    def forget(self) -> None:
        """Clear all slots until they restart in turn."""
        self.first[:], self.score[:], self.info[:] = np.nan, 0.0, self.prior * np.eye(self.c)

    def begin(self, t: float) -> slice:
        """Begin the slot whose turn it is at a fix; its columns in the bank."""
        slot = begin_slot(self.memory, t, self.L, self.c, self.prior)
        return slice(self.columns.start + self.c * slot, self.columns.start + self.c * (slot + 1))

    def find(self, t: float, errors: Array, T: Array, factor: float, speed: float) -> float | None:
        """Onset of a fault that is significant with the fix at t, s, or None.

        Parameters
        ----------
        errors, T : (L, c) and (L,), the errors most likely, and how much more likely they make the innovations.
        factor : typical ratio of the innovations to the filter's prediction.
        """
        T = T / self.threshold
        if T.max() <= factor:
            return None
        now = errors[:, : self.m]
        if self.c > self.m:
            minutes = np.where(np.isnan(self.first), 0.0, (t - self.first) / MINUTE)
            now = now + minutes[:, None] * errors[:, self.m :]
        T = np.where(_are_large(now, self.typical_error, self.fix_of, speed), T, 0.0)
        if T.max() <= factor:
            return None
        # of about equally likely onsets the latest: it excludes least
        return float(np.max(self.first[T.max() - _ONSET / self.threshold <= T]))


def is_large(error: Array, rows: Constraint, speed: float) -> bool:
    """Whether an error (m,) of fixes is large at a speed (m/s) of the vehicle; otherwise it is no fault."""
    return bool(_are_large(error, rows.compute_typical_error(), rows.fix_of, speed))


def _are_large(errors: Array, typical: Array, fix_of: str, speed: float) -> Array:
    """(...) of errors (..., m)."""
    # clock errors shift a position by the distance travelled in them
    clocks = _CLOCKS * (speed if fix_of == "p" else _BRAKING)
    return np.asarray(np.sum(errors**2 / (typical**2 + clocks**2), axis=-1) > LARGE**2)


def _list_slots(
    constraints: Iterable[Constraint], t: Array | None, period: float, drifts: bool = True
) -> dict[str, _Slots]:
    """Slots of each constraint, their columns behind each other; t (K,) of the keyframes, s, tells the period."""
    out: dict[str, _Slots] = {}
    end = 0
    for rows in constraints:
        if t is not None and len(rows) > 1:
            period = float(np.median(np.diff(t[rows.keyframe])))
        L = 1 + int(np.clip(np.log2(OLDEST / max(period, 1e-3)), 0, 12))
        out[rows.name] = _Slots(end, L, rows, drifts)
        end = out[rows.name].columns.stop
    return out


def _count_columns(some: Mapping[str, _Slots]) -> int:
    """How many columns a bank has."""
    return max((slots.columns.stop for slots in some.values()), default=0)


class _InnovationLevel:
    """Typical ratio of a kind's innovations to the filter's prediction; shared by all copies of a bank.

    A level that half of all fixes reach, unused ones included, is no fault but a divergence of the filter. Fixes of a
    recent, continuing fault are excepted: soon after the start they alone are half of all.
    """

    def __init__(self, m: int) -> None:
        self.median = 2.0 * float(gammaincinv(0.5 * m, 0.5))
        self.t, self.nis, self.used, self.factor = array("d"), array("d"), array("b"), 1.0

    def add(self, t: float, nis: float, used: bool = True) -> None:
        k = bisect_left(self.t, t) if len(self.t) and t <= self.t[-1] else len(self.t)
        if k < len(self.t) and self.t[k] == t:
            self.nis[k], self.used[k] = nis, used
        else:
            self.t.insert(k, t)
            self.nis.insert(k, nis)
            self.used.insert(k, used)
        if k % _EVERY == 0:
            begin = k
            while begin and not self.used[begin - 1]:
                begin -= 1
            known = begin if begin < k and self.t[k - 1] - self.t[begin] <= PATIENCE else k + 1
            if known:
                self.factor = max(1.0, _find_median(np.frombuffer(self.nis)[:known]) / self.median)


def _find_median(x: Array) -> float:
    """Of some numbers (n,), as of many small samples: without what `numpy.median` does before."""
    half = len(x) // 2
    if len(x) % 2:
        return float(np.partition(x, half)[half])
    both = np.partition(x, (half - 1, half))
    return 0.5 * float(both[half - 1] + both[half])


class Bank:
    """All tests of a filter, and their states before the latest keyframes with fixes.

    Parameters
    ----------
    constraints : those whose rows are tested.
    t : (K,) times of the keyframes, s.
    width : of the error state.
    drifts : whether errors may grow, too.
    """

    def __init__(self, constraints: Sequence[Constraint], t: Array, width: int, drifts: bool = True) -> None:
        self._slots, self._t = _list_slots(constraints, t, OLDEST, drifts), t
        some, columns = self._slots.values(), _count_columns(self._slots)
        ends = np.cumsum([width * columns, *(len(slots.memory) for slots in some)])
        self._state = np.concatenate([np.zeros(ends[0]), *(slots.memory for slots in some)])
        self.X = self._state[: ends[0]].reshape(width, columns)
        for slots, begin, end in zip(some, ends[:-1], ends[1:], strict=True):
            slots.memory = self._state[begin:end]
        self._layouts = np.array(
            [(begin, s.columns.start, s.L, s.m, s.c) for s, begin in zip(some, ends[:-1], strict=True)]
        )
        self._scales = np.array([(slots.prior, MINUTE) for slots in some])
        most = self._layouts.max(axis=0)
        self._errors, self._T = np.zeros((len(some), most[2], most[4])), np.zeros((len(some), most[2]))
        self._met = np.isin(np.arange(len(t)), np.concatenate([c.keyframe for c in constraints]))
        self._before, self._keys = np.empty((_MEMORY, ends[-1])), np.zeros(_MEMORY, dtype=int)
        self._ends = np.zeros(2, dtype=int)
        self._kind: Array | None = None  # (B,) of each block of the filter, as it is met, and
        self._limit = np.empty(0)  # (B,) of its T

    def go_back(self, k: int) -> None:
        """Restore the state before keyframe k; without any onset where that is no longer kept."""
        begin, end = self._ends
        while end > begin and self._keys[(end - 1) % _MEMORY] > k:
            end -= 1
        if end > begin and self._keys[(end - 1) % _MEMORY] == k:
            end -= 1
            self._state[:] = self._before[end % _MEMORY]
        else:
            self.X[:] = 0.0
            for slots in self._slots.values():
                slots.forget()
        self._ends[1] = end

    def follow(
        self,
        k0: int,
        k1: int,
        F: Array,
        decay: Array,
        stack: Stack,
        updates: Updates,
        root: Array,
        speeds: Array,
    ) -> tuple[str, int, float] | None:
        """Follow a filter from keyframe k0 to k1; returns kind, keyframe and onset of a detected fault, if any.

        Parameters
        ----------
        F, decay : of its steps, as `graphnav.estimation.solvers.recursion` has them.
        updates : of the filter, as in `stack`, with roots and innovations of all blocks.
        root : (K, M, M) of those, with the weights by which they were taken in.
        speeds : (n,) m/s, of the vehicle.
        """
        blocks, names = updates.blocks, list(self._slots)
        if self._kind is None:
            self._kind, self._limit = stack.find_kinds(names), np.full(len(blocks.begin), np.inf)
        kind, limit = self._kind, self._limit
        white = (stack.solved[k0:k1, None] @ stack.root[k0:k1])[:, 0]
        levels = []
        some = slice(blocks.first[k0], blocks.first[k1])
        first = some.start
        for i, k, begin, end, taken in zip(
            *(x[some].tolist() for x in (kind, blocks.k, blocks.begin, blocks.end, updates.taken)), strict=True
        ):
            if i >= 0:
                slots = self._slots[names[i]]
                own, level = white[k - k0, begin:end], slots.typical_sigmas
                level.add(float(self._t[k]), float(own @ own), taken)
                levels.append((first, level, level.factor))
                limit[first] = level.factor * slots.threshold
            first += 1
        k, b = k0, int(blocks.first[k0])
        while True:
            k, b = follow_filter(
                k, k1, b, self._t, (F, decay), updates.arrays, root, blocks.arrays,
                (kind, limit, self._met, self._layouts, self._scales),
                (self._state, self._before, self._keys, self._ends), (self._errors, self._T),
            )  # fmt: skip
            if k == k1:
                return None
            i, slots = kind[b], self._slots[names[kind[b]]]
            errors, T = self._errors[i, : slots.L, : slots.c], self._T[i, : slots.L]
            since = slots.find(float(self._t[k]), errors, T, limit[b] / slots.threshold, float(speeds[k]))
            if since is not None:
                for at, level, factor in levels:  # later blocks are not known yet
                    if at <= b:
                        level.factor = factor
                return names[i], k, since
            b += 1


class Watch:
    """The same tests beside a square-root message R y = z, which is then R y = z - R X b for errors b since each onset.

    Only for constant errors: a growing one may as well be the IMU's, and no evidence decides that online. With
    columns B = U / sigma for them at a fix, the QR that takes in its rows leaves behind, below those of the message,
    rho - Gamma b ~ N(0, 1): rho^T rho is its NIS, and Gamma^T rho and Gamma^T Gamma add to score and info.

    Parameters
    ----------
    constraints : those whose rows are tested.
    period : s, between fixes.
    width : of the error state.
    """

    def __init__(self, constraints: Iterable[Constraint], period: float, width: int) -> None:
        self._slots = _list_slots(constraints, None, period, drifts=False)
        self._X: Array | None = np.zeros((width, _count_columns(self._slots)))
        self._stands: tuple[Array, Array] | None = None  # R and R X

    @property
    def X(self) -> Array:
        """(D, C) what a unit error since each onset does to the estimate."""
        if self._X is None:
            assert self._stands is not None
            self._X, self._stands = dtrtrs(*self._stands)[0], None
        return self._X

    @X.setter
    def X(self, X: Array) -> None:
        self._X, self._stands = X, None

    def take_message(self, R: Array, Z: Array) -> None:
        """Take over the new message, a triangular R (D, D), with Z = R X (D, C) beside it."""
        self._X, self._stands = None, (R, Z)

    def copy(self) -> Watch:
        """The same, on its own."""
        other = copy(self)
        other._slots = {name: slots.copy() for name, slots in self._slots.items()}
        return other

    def forget_onsets(self) -> Watch:
        """The same without any onset."""
        other = self.copy()
        other.X = np.zeros_like(self.X)
        for slots in other._slots.values():
            slots.forget()
        return other

    def begin(self, name: str, t: float, sigma: Array) -> tuple[slice, slice, Array]:
        """Begin an onset with fixes of these sigmas (n, m): its columns, those of the kind, and B (n m, L m)."""
        slots = self._slots[name]
        own = slots.begin(t)
        inputs = np.eye(slots.m)[:, None] * np.isfinite(slots.first)[:, None]
        return own, slots.columns, (inputs.reshape(slots.m, -1) / sigma[..., None]).reshape(sigma.size, -1)

    def find_onset(self, name: str, t: float, rho: Array, Gamma: Array, speed: float) -> float | None:
        """Onset of a fault, or None, by the residual rows of a fix: rho (n m,) and Gamma (n m, L m) of its kind."""
        slots, rho, Gamma = self._slots[name], np.ascontiguousarray(rho), np.ascontiguousarray(Gamma)
        slots.typical_sigmas.add(t, float(rho @ rho))
        errors, T = np.empty((slots.L, slots.c)), np.empty(slots.L)
        add_row(slots.memory, rho, Gamma, slots.L, slots.c, errors, T)
        return slots.find(t, errors, T, slots.typical_sigmas.factor, speed)

    def compute_shift(self, name: str, dv: Array, since: Array) -> float:
        """By how much fixes seem off, m or m/s, where the velocity has changed by dv (n,) m/s since (n,) s, each time
        in a direction of its own.
        """
        return float(np.linalg.norm(dv * since if self._slots[name].fix_of == "p" else dv))

    def would_seem_wrong(self, name: str, away: float, speed: float) -> bool:
        """Whether fixes that are off by so much, m or m/s, would seem wrong."""
        slots = self._slots[name]
        return bool(_are_large(np.full(slots.m, away), slots.typical_error, slots.fix_of, speed))

    def __contains__(self, name: str) -> bool:
        return name in self._slots
