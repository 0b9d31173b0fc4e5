"""Exclusion and readmission of fixes when the tests of `graphnav.estimation.faults.watch` detect a fault."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphnav.core.rotation import Array
from graphnav.estimation.faults.watch import OLDEST, PATIENCE
from graphnav.estimation.solution import ExcludedSpan

# least number of fixes that agree after a fault; with fewer, a further disagreement continues the fault
_FEWEST_AGREEING = 3


class Verdicts:
    """Fixes to exclude when a fault is detected: those from its onset on.

    Unless the fault lasts longer than the span used since the previous fault, and a minute. Then the filter itself is
    more likely wrong: it drifts while fixes are excluded, and the drift appears as another growing fault; or it started
    with wrong fixes. So all measurements used since are excluded instead, and the fixes readmitted; this is undone if
    they are rejected again. After `OLDEST` of a fault the filter is reset to the fixes.

    The first fix used after a long fault agrees easily, because the filter's covariance is large; afterwards the filter
    is certain of it. If one of the next fixes disagrees, the agreement was chance, and the fault continues.
    """

    def __init__(self, times: Mapping[str, Array], used: Mapping[str, Array]) -> None:
        self.times, self.used = dict(times), dict(used)  # (N,) each; `used` is changed in place
        self.anew: set[tuple[str, float]] = set()  # kinds and times at which the filter is reset
        self._tried: set[tuple[str, float]] = set()
        self._trial: tuple[str, int, int, dict[str, Array]] | None = None  # readmitted fixes, and the rows used before

    def list_faults(self) -> tuple[ExcludedSpan, ...]:
        """Spans of fixes that are not used."""
        out = []
        for name, t in self.times.items():
            lost = np.flatnonzero(self.used[name] == 0.0)
            for run in np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1) if len(lost) else []:
                out.append(ExcludedSpan(name, float(t[run[0]]), float(t[run[-1]]), len(run)))
        return tuple(sorted(out, key=lambda fault: fault.t_start))

    def weigh(self, name: str, t: Array) -> Array:
        """(n,) weights of fixes at the times t: 0 for unused ones, 1 for fixes not seen before."""
        known, used = self.times.get(name, np.empty(0)), self.used.get(name, np.empty(0))
        at = known.searchsorted(t)
        new = at == len(known)
        new[~new] = known[at[~new]] != t[~new]
        if new.any():
            if at[new][0] < len(known):
                self._trial = None  # its rows have moved
            self.times[name] = known = np.insert(known, at[new], t[new])
            self.used[name] = used = np.insert(used, at[new], 1.0)
            at = known.searchsorted(t)
        return np.asarray(used[at])

    def settle(self, name: str, since: float, now: float) -> float:
        """Exclude measurements for a fault of fixes from `since` (s) to `now`; returns the time to continue from."""
        t, used = self.times[name], self.used[name]
        fault, end = int(np.searchsorted(t, since)), int(np.searchsorted(t, now, side="right"))
        used[fault:end] = 0.0
        begin = _find_run_begin(used, end, 0.0)
        before = _find_run_begin(used, begin, 1.0)  # of the rows used between two faults
        if begin - before < min(_FEWEST_AGREEING, before - _find_run_begin(used, before, 0.0)):
            used[before:begin] = 0.0
            fault = min(fault, before)
        if self._trial is not None and self._trial[0] == name:
            _, begin, until, were = self._trial
            if end > until:
                self._trial = None
            elif np.mean(used[begin:until] == 0.0) > 0.5:
                self._trial = None
                for other, was in were.items():
                    self.used[other][: len(was)] = was
                return float(t[_find_run_begin(used, _find_run_begin(used, begin, 1.0), 0.0)])
        begin = _find_run_begin(used, end, 0.0)
        before = _find_run_begin(used, begin, 1.0)  # of the rows used between two faults
        lasted = t[end - 1] - t[begin]
        if lasted > OLDEST and (name, t[begin]) not in self.anew:
            used[begin:end] = 1.0
            self.anew.add((name, float(t[begin])))
            return float(t[begin])
        if lasted > PATIENCE and self._outlasts(name, before, begin, end):
            return self._take_fixes_back(name, before, begin, end)
        return float(t[fault])

    def readmit(self, since: float) -> None:
        """Use the fixes from a time (s) on again: what they disagreed with has been taken back."""
        for name, t in self.times.items():
            self.used[name][t >= since] = 1.0
        self._trial = None

    def set_ended(self) -> float | None:
        """The time to continue from at the end of the fixes, where no later ones can confirm a fault."""
        for name, used in self.used.items():
            end = len(used)
            if end and used[-1] == 0.0:
                begin = _find_run_begin(used, end, 0.0)
                before = _find_run_begin(used, begin, 1.0)
                if self._outlasts(name, before, begin, end):
                    return self._take_fixes_back(name, before, begin, end)
        return None

    def _outlasts(self, name: str, before: int, begin: int, end: int) -> bool:
        """Whether the excluded fixes begin..end outnumber the used ones before..begin, and were not readmitted yet."""
        return 0 < begin - before < end - begin and (name, self.times[name][begin]) not in self._tried

    def _take_fixes_back(self, name: str, before: int, begin: int, end: int) -> float:
        """Readmit fixes, and exclude all rows used since the previous fault; returns the time to continue from."""
        t, used = self.times[name], self.used[name]
        self._tried.add((name, float(t[begin])))
        self._trial = name, begin, end, {other: u.copy() for other, u in self.used.items()}
        used[begin:end] = 1.0
        first = float(t[_find_run_begin(used, before, 0.0)])
        for other, at in self.times.items():
            self.used[other][(at >= first) & (at < t[begin])] = 0.0
        return first


def _find_run_begin(used: Array, end: int, value: float) -> int:
    """First of the rows before `end` that are all used, or all not."""
    other = np.flatnonzero((used[:end] > 0.0) != (value > 0.0))
    return int(other[-1]) + 1 if len(other) else 0
