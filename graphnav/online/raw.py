"""Epochs of raw observations received so far, and their settings online."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.config import Settings
from graphnav.config.raw_gnss import RawGnssSettings
from graphnav.constraints.raw_selection import EARLY, select_usable
from graphnav.core.rotation import Array
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.ppp import compute_series_wind_up
from graphnav.gnss.series import RawGnss, choose_primary
from graphnav.gnss.single_point import choose_coefficients, look, solve
from graphnav.online.raw_lines import WIDTH, build_raw_series, take_sane
from graphnav.recording import Recording

RAW = "raw_gnss"


@dataclass
class RawEpochs:
    """Epochs in order of time; epochs too close together to be used still show where carrier-phase arcs end.

    Parameters
    ----------
    setup : as `drop_epochs` makes it.
    """

    setup: RawGnss
    settings: RawGnssSettings
    _t: list[float] = field(default_factory=list)  # s, of the epochs in use
    _every: list[float] = field(default_factory=list)  # s
    _rows: dict[float, Array] = field(default_factory=dict)  # (n, WIDTH), by time
    # (n, 2) of the carrier phases: start of the arc, s, and phase wind-up, cycles
    _arcs: dict[float, Array] = field(default_factory=dict)
    _number: dict[float, int] = field(default_factory=dict)  # number among the epochs in use; -1 for one received late
    _last: dict[tuple[float, float], tuple[float, Array, Array]] = field(
        default_factory=dict
    )  # with a carrier, by slot

    def __len__(self) -> int:
        return len(self._t)

    @property
    def t(self) -> Array:
        """(N,) s"""
        return np.array(self._t)

    @property
    def newest(self) -> float:
        """Newest time, minus infinity without epochs."""
        return self._t[-1] if self._t else -np.inf

    def find_fault(self, values: tuple[float, ...]) -> str | None:
        """The fault of an epoch by itself; None if there is none."""
        assert self.setup.catalogue is not None
        if not values or len(values) % WIDTH:
            return "not a number"
        rows = np.reshape(values, (-1, WIDTH))
        if not np.isin(rows[:, 0], self.setup.catalogue.satellites).all():
            return "of satellites that the setup does not name"
        rows = take_sane(rows)
        usable = select_usable(build_raw_series([0.0], [rows], self.setup), self.settings)
        return None if usable.any() else "no usable satellite"

    def is_wanted(self, t: float) -> bool:
        """Whether an epoch at this time is wanted: none in use is too close to it."""
        k, least = bisect_left(self._t, t), self.settings.period - EARLY
        near = self._t[max(k - 1, 0) : k + 1]
        return t not in self._rows and all(abs(x - t) >= least and x != t for x in near)

    def add(self, t: float, values: tuple[float, ...], used: bool = True) -> bool:
        """Insert an epoch by its time; returns False if there already is one at that time, which stays."""
        if t in self._rows:
            return False
        k = bisect_left(self._every, t)
        self._every.insert(k, t)
        self._rows[t] = self._fill_place(t, take_sane(np.reshape(values, (-1, WIDTH))))
        if used:
            # numbers are final: a late epoch gets none, and carrier-phase changes bypass it
            self._number[t] = self._number.get(self.newest, -1) + 1 if t > self.newest else -1
            insort(self._t, t)
        later = self._every[k:]
        if len(later) > 1:  # earlier epochs must be recognisable
            self._last = {}
            for x in self._every[:k]:
                self._remember(x)
        for x in later:
            self._arcs[x] = self._find_arcs(x)
            self._remember(x)
        return True

    def list_after(self, t: float) -> list[tuple[float, tuple[float, ...]]]:
        """The epochs after a time."""
        return [(x, tuple(self._rows[x].ravel().tolist())) for x in self._every[bisect_right(self._every, t) :]]

    def drop_before(self, t: float) -> None:
        """Drop the epochs before a time."""
        k = bisect_left(self._every, t)
        for x in self._every[:k]:
            del self._rows[x], self._arcs[x]
            self._number.pop(x, None)
        del self._every[:k], self._t[: bisect_left(self._t, t)]

    def drop_after(self, t: float) -> None:
        """Drop the epochs after a time."""
        k, self._last = bisect_right(self._every, t), {}
        for x in self._every[k:]:
            del self._rows[x], self._arcs[x]
        del self._every[k:], self._t[bisect_right(self._t, t) :]
        for x in self._every:
            self._remember(x)

    def build_between(self, begin: float, end: float) -> RawGnss:
        """The epochs in use from `begin` to `end`, both included, and the one before, as a series."""
        t = self._t[max(bisect_left(self._t, begin) - 1, 0) : bisect_right(self._t, end)]
        rows = [self._rows[x] for x in t]
        series = build_raw_series(t, rows, self.setup)
        if not t:
            return series
        number = np.repeat([self._number[x] for x in t], [len(one) for one in rows])
        arcs = np.concatenate([self._arcs[x] for x in t])
        wound = arcs[:, 1] if self.settings.ppp else np.empty(0)
        return replace(series, arc_begin=arcs[:, 0], wound=wound, number=number)

    def _fill_place(self, t: float, rows: Array) -> Array:
        """Rows with an approximate antenna position and clock where they have none: of this epoch, or the last."""
        if np.isfinite(rows[:, -5:]).all():
            return rows
        rows = rows.copy()
        series = build_raw_series([t], [rows], self.setup)
        found = solve(series.take(choose_primary(series)))
        if np.isfinite(found.p).all():
            drift = found.drift[0] if np.isfinite(found.drift[0]) else 0.0
            rows[:, -5:] = [*found.p[0], found.clock[0], drift]
            return rows
        k = bisect_left(self._every, t)
        place = self._rows[self._every[k - 1]][0, -5:-2] if k else np.array(self.setup.place)
        geometry = look(series, np.broadcast_to(place, (len(rows), 3)), choose_coefficients(series))
        clock = np.nanmedian(series.code + series.clock - geometry.distance - geometry.troposphere)
        rows[:, -5:] = [*place, clock, 0.0]
        return rows

    def _find_arcs(self, t: float) -> Array:
        """(n, 2) of an epoch's carrier phases: start of the arc, s (NaN without one), and phase wind-up, cycles."""
        assert self.setup.catalogue is not None
        rows, last = self._rows[t], list(self._last.values())
        s = self.settings
        if not (s.carrier or s.differences or s.ppp):
            return np.full((len(rows), 2), np.nan)
        series = build_raw_series([*(x for x, _, _ in last), t], [*(row[None] for _, row, _ in last), rows], self.setup)
        order = np.argsort(series.t, kind="stable")
        series, based = series.take(order), self.setup.catalogue.differenced and s.carrier and not s.ppp
        if not based:
            series = replace(series, carrier_difference=np.empty(0))
        period = self.setup.catalogue.period
        found = find_arcs(series, base_arc=series.base_arc if based else None, period=period)
        here = np.empty((len(order), 2))
        here[order, 0], here[order, 1] = found.begin, compute_series_wind_up(series) if s.ppp else 0.0
        out = here[len(last) :]
        before = {(row[0], row[1]): (x, arc, now) for (x, row, arc), now in zip(last, here, strict=False)}
        for i, row in enumerate(rows):
            x, arc, now = before.get((row[0], row[1]), (np.nan, out[i], out[i]))
            if out[i, 0] == x:  # it goes on
                out[i, 0] = arc[0]
            out[i, 1] += arc[1] - now[1]
        return out

    def _remember(self, t: float) -> None:
        for row, arc in zip(self._rows[t], self._arcs[t], strict=True):
            if np.isfinite(arc[0]):
                self._last[row[0], row[1]] = t, row, arc


def use_codes_alone(settings: Settings) -> Settings:
    """The settings without carrier phases, for the alignment, which needs none."""
    s = settings.raw_gnss
    less = s.model_copy(update={"differences": False, "carrier": False, "ppp": False, "code": s.code or s.ppp})
    return settings.model_copy(update={RAW: less})


def drop_ambiguities(settings: Settings, setup: Recording) -> Settings:
    """The settings for noise estimation: carrier-phase changes have variance components, ambiguities have none."""
    s, raw = settings.raw_gnss, setup.raw_gnss
    if raw is None or not (s.carrier and raw.differenced):
        return settings
    return use_codes_alone(settings)
