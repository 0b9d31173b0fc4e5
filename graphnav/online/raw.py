"""Epochs of raw observations as rows of a stream, and those that have come.

An epoch is one row: the numbers of its satellites one after the other, each placed by the ephemerides that were known
when the source began. Which satellites and signals there may be, and what all epochs have in common, says the setup.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass, field, fields, replace

import numpy as np

from graphnav.config import Settings
from graphnav.config.raw_gnss import RawGnssSettings
from graphnav.constraints.gnss import period
from graphnav.constraints.raw_selection import EARLY, usable
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.gnss.series import Catalogue, RawGnss, primary
from graphnav.gnss.single_point import signal_groups
from graphnav.recording import Recording

RAW = "raw_gnss"
_NUMBERS = (
    "satellite", "signal", "code", "carrier", "range_rate", "cn0", "slip", "half", "frequency", "p", "v", "clock",
    "drift", "difference", "antenna", "receiver_clock",
)  # fmt: skip
_WIDTHS = {"p": 3, "v": 3, "antenna": 3, "receiver_clock": 2}
_WIDTH = sum(_WIDTHS.get(name, 1) for name in _NUMBERS)


def without_epochs(raw: RawGnss) -> RawGnss:
    """What all epochs of a series have in common."""
    placed = raw.take(np.isfinite(raw.p[:, 0]))
    satellites, _ = placed.satellites
    groups, _ = signal_groups(placed.take(primary(placed)))
    catalogue = Catalogue(tuple(satellites.tolist()), groups, raw.differenced, period(raw.epochs[0]))
    return replace(_empty(raw), catalogue=catalogue)


def epochs_of(raw: RawGnss) -> list[tuple[float, tuple[float, ...]]]:
    """Times (s) and numbers of the epochs of a series, those of its satellites that are placed."""
    raw = raw.take(np.isfinite(raw.p[:, 0]))
    columns = np.column_stack([np.asarray(getattr(raw, name), dtype=float) for name in _NUMBERS])
    t, first = np.unique(raw.t, return_index=True)
    return [
        (at, tuple(rows.ravel().tolist())) for at, rows in zip(t.tolist(), np.split(columns, first[1:]), strict=True)
    ]


@dataclass
class RawEpochs:
    """Epochs in order of time, no closer than they are used.

    Parameters
    ----------
    setup : as `without_epochs` makes it.
    """

    setup: RawGnss
    settings: RawGnssSettings
    _t: list[float] = field(default_factory=list)  # s
    _rows: dict[float, Array] = field(default_factory=dict)  # (n, _WIDTH), by time

    def __len__(self) -> int:
        return len(self._t)

    @property
    def t(self) -> Array:
        """(N,) s"""
        return np.array(self._t)

    @property
    def newest(self) -> float:
        """Newest time, minus infinity without any."""
        return self._t[-1] if self._t else -np.inf

    def odds(self, values: tuple[float, ...]) -> str | None:
        """What is wrong with an epoch by itself; None if nothing is."""
        assert self.setup.catalogue is not None
        if not values or len(values) % _WIDTH:
            return "not a number"
        rows = np.reshape(values, (-1, _WIDTH))
        if not np.isin(rows[:, 0], self.setup.catalogue.satellites).all():
            return "of satellites that the setup does not name"
        return None if usable(self._series([0.0], [rows]), self.settings).any() else "no satellite that is of use"

    def wanted(self, t: float) -> bool:
        """Whether no epoch is there that is so near to a time that one of the two suffices."""
        k, least = bisect_left(self._t, t), self.settings.period - EARLY
        near = self._t[max(k - 1, 0) : k + 1]
        return all(abs(x - t) >= least and x != t for x in near)

    def add(self, t: float, values: tuple[float, ...]) -> bool:
        """Put an epoch in its place; False if there is one at that time already, which stays."""
        if t in self._rows:
            return False
        insort(self._t, t)
        self._rows[t] = np.reshape(values, (-1, _WIDTH))
        return True

    def after(self, t: float) -> list[tuple[float, tuple[float, ...]]]:
        """The epochs after a time."""
        return [(x, tuple(self._rows[x].ravel().tolist())) for x in self._t[bisect_right(self._t, t) :]]

    def drop_before(self, t: float) -> None:
        """Forget the epochs before a time."""
        k = bisect_left(self._t, t)
        for x in self._t[:k]:
            del self._rows[x]
        del self._t[:k]

    def between(self, begin: float, end: float) -> RawGnss:
        """Those from `begin` to `end`, both included, as a series."""
        t = self._t[bisect_left(self._t, begin) : bisect_right(self._t, end)]
        return self._series(t, [self._rows[x] for x in t])

    def _series(self, t: list[float], rows: list[Array]) -> RawGnss:
        if not t:
            return self.setup
        numbers = np.concatenate(rows)
        columns: dict[str, Array] = {"t": np.repeat(t, [len(one) for one in rows])}
        at = 0
        for name in _NUMBERS:
            wide = _WIDTHS.get(name)
            own = numbers[:, at] if wide is None else numbers[:, at : at + wide]
            columns[name] = own.astype(getattr(self.setup, name).dtype)
            at += wide or 1
        return replace(self.setup, **columns)  # type: ignore[arg-type]


def settings_online(settings: Settings, setup: Recording) -> tuple[Settings, tuple[Note, ...]]:
    """The settings as far as raw observations are used online, and what is to be said of that."""
    s = settings.raw_gnss
    if not setup.tight(s.coupling):
        return settings, ()
    less = {"differences": False, "carrier": False, "integers": False, "ppp": False, "code": s.code or s.ppp}
    note = Note("online.raw", "of the raw observations codes and Doppler shifts are used online, the carriers are not")
    return settings.model_copy(update={RAW: s.model_copy(update=less)}), (note,)


def _empty(raw: RawGnss) -> RawGnss:
    """A series without rows."""
    none = {
        f.name: getattr(raw, f.name)[:0]
        for f in fields(raw)
        if f.name != "lever_arm" and isinstance(getattr(raw, f.name), np.ndarray)
    }
    return replace(raw, **none)
