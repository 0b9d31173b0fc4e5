"""What a filter gives up, and takes back, when the tests of `graphnav.estimation.solvers.watch` find a fault."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphnav.core.rotation import Array
from graphnav.estimation.solution import ExcludedSpan
from graphnav.estimation.solvers.watch import OLDEST, PATIENCE

_FEWEST_AGREEING = 3  # fixes that agree after a fault, below which the next that does not says that they did by chance


class Verdicts:
    """Which fixes to give up when a fault is found: those from its onset on.

    Unless that outlasts what was used since the fault before, and a minute. Then it is more likely the filter that has
    lost its way with those: it drifts while fixes are refused, and a fault that grows meets it again; or it began with
    wrong ones. So what it used since, of any kind, is given up instead, and the fixes are taken back; this in turn is
    undone if they are refused even so. After `OLDEST` of a fault the filter begins anew where the fixes are.

    The first fix that is used after a long fault meets a filter that knows little, and agrees easily; from then on the
    filter is sure of it. If one of the next does not agree, it was chance, and the fault goes on.
    """

    def __init__(self, times: Mapping[str, Array], used: Mapping[str, Array]) -> None:
        self.times, self.used = dict(times), dict(used)  # (N,) each; `used` is changed in place
        self.anew: set[tuple[str, float]] = set()  # kinds and times at which the filter begins anew
        self._tried: set[tuple[str, float]] = set()
        self._trial: tuple[str, int, int, dict[str, Array]] | None = None  # fixes taken back, and what was used before

    def list_faults(self) -> tuple[ExcludedSpan, ...]:
        """Spans of fixes that are not used."""
        out = []
        for name, t in self.times.items():
            lost = np.flatnonzero(self.used[name] == 0.0)
            for run in np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1) if len(lost) else []:
                out.append(ExcludedSpan(name, float(t[run[0]]), float(t[run[-1]]), len(run)))
        return tuple(sorted(out, key=lambda fault: fault.t_start))

    def weigh(self, name: str, t: Array) -> Array:
        """(n,) of fixes at the times t: 0 for what is not used. Fixes that were not known yet are."""
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
        """Take from use what a fault of fixes `since` (s) up to `now` gives reason to; the time to go on from."""
        t, used = self.times[name], self.used[name]
        fault, end = int(np.searchsorted(t, since)), int(np.searchsorted(t, now, side="right"))
        used[fault:end] = 0.0
        begin = _find_run_begin(used, end, 0.0)
        before = _find_run_begin(used, begin, 1.0)  # of what was used between two faults
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
        before = _find_run_begin(used, begin, 1.0)  # of what was used between two faults
        lasted = t[end - 1] - t[begin]
        if lasted > OLDEST and (name, t[begin]) not in self.anew:
            used[begin:end] = 1.0
            self.anew.add((name, float(t[begin])))
            return float(t[begin])
        if lasted > PATIENCE and self._outlasts(name, before, begin, end):
            return self._take_fixes_back(name, before, begin, end)
        return float(t[fault])

    def set_ended(self) -> float | None:
        """The time to go on from once no more fixes come: no more patience is needed then."""
        for name, used in self.used.items():
            end = len(used)
            if end and used[-1] == 0.0:
                begin = _find_run_begin(used, end, 0.0)
                before = _find_run_begin(used, begin, 1.0)
                if self._outlasts(name, before, begin, end):
                    return self._take_fixes_back(name, before, begin, end)
        return None

    def _outlasts(self, name: str, before: int, begin: int, end: int) -> bool:
        """Whether fixes begin..end, refused, are more than before..begin, which were used, and were not tried yet."""
        return 0 < begin - before < end - begin and (name, self.times[name][begin]) not in self._tried

    def _take_fixes_back(self, name: str, before: int, begin: int, end: int) -> float:
        """Take fixes back, without what of any kind was used since the fault before; the time to go on from."""
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
