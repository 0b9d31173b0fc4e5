"""Epochs of raw observations as rows of a stream, and those that have come.

An epoch is one row: the numbers of its satellites one after the other, each placed by the ephemerides that were known
when the source began. Which satellites and signals there may be, and what all epochs have in common, says the setup.

In the line protocol (`graphnav.online.lines`) each satellite and signal of an epoch is, with commas between:

    satellite, signal              as G05, 1C
    code, carrier, range rate      m, cycles, m/s; blank where absent, as is
    C/N0                           dB-Hz
    slip, half                     1 after a loss of lock; 1 where half a cycle is open
    frequency                      Hz
    x, y, z, vx, vy, vz            of the satellite in the Earth-fixed frame of the transmission, m, m/s
    clock, drift                   of the satellite, group delay taken off, m, m/s
    code and carrier of the base   m to add to those of the rover; blank without a base
    arc of the base, lock          a number that changes with the base's arc, -1 without; s in lock, blank if unknown
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass, field, fields, replace

import numpy as np
from pydantic import BaseModel, ConfigDict

from graphnav.config import Settings
from graphnav.config.raw_gnss import RawGnssSettings
from graphnav.constraints.gnss import period
from graphnav.constraints.raw_selection import EARLY, select_usable
from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_number
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.series import Catalogue, RawGnss, primary
from graphnav.gnss.signals import SYSTEMS, satellite_id, satellite_name, signal_id, signal_name
from graphnav.gnss.single_point import choose_coefficients, look, signal_groups, solve
from graphnav.recording import Recording
from graphnav.sensors.tables import NotNegative, Positive, Vector

RAW = "raw_gnss"
_NUMBERS = (
    "satellite", "signal", "code", "carrier", "range_rate", "cn0", "slip", "half", "frequency", "p", "v", "clock",
    "drift", "difference", "carrier_difference", "base_arc", "lock", "antenna", "receiver_clock",
)  # fmt: skip
_WIDTHS = {"p": 3, "v": 3, "antenna": 3, "receiver_clock": 2}
# least and most that can be, in SI, and whether a row needs it
_BOUNDS = {
    "code": (-1e9, 1e9, False), "carrier": (-1e11, 1e11, False), "range_rate": (-1e6, 1e6, False),
    "cn0": (0.0, 100.0, False), "frequency": (1e9, 3e9, True), "p": (1e7, 1e8, True), "v": (0.0, 2e4, True),
    "clock": (-1e7, 1e7, True), "drift": (-1e3, 1e3, False), "slip": (0.0, 1.0, True), "half": (0.0, 1.0, True),
    "base_arc": (-1.0, 1e9, True), "antenna": (6.3e6, 7e6, False), "receiver_clock": (0.0, 1e9, False),
    "difference": (-1e9, 1e9, False), "carrier_difference": (-1e9, 1e9, False), "lock": (0.0, 1e9, False),
}  # fmt: skip
_WIDTH = sum(_WIDTHS.get(name, 1) for name in _NUMBERS)


def without_epochs(raw: RawGnss) -> RawGnss:
    """What all epochs of a series have in common."""
    placed = raw.take(np.isfinite(raw.p[:, 0]))
    satellites, _ = placed.satellites
    groups, _ = signal_groups(placed.take(primary(placed)))
    catalogue = Catalogue(tuple(satellites.tolist()), groups, raw.differenced, period(raw.epochs[0]))
    return replace(_make_empty(_fill_columns(raw)), catalogue=catalogue)


def epochs_of(raw: RawGnss) -> list[tuple[float, tuple[float, ...]]]:
    """Times (s) and numbers of the epochs of a series, those of its satellites that are placed."""
    raw = _fill_columns(raw.take(np.isfinite(raw.p[:, 0])))
    columns = np.column_stack([np.asarray(getattr(raw, name), dtype=float) for name in _NUMBERS])
    t, first = np.unique(raw.t, return_index=True)
    return [
        (at, tuple(rows.ravel().tolist())) for at, rows in zip(t.tolist(), np.split(columns, first[1:]), strict=True)
    ]


def text_of(values: tuple[float, ...]) -> str:
    """An epoch as a part of a line: place and clock, then its satellites, each after a semicolon."""
    rows = np.reshape(values, (-1, _WIDTH))
    parts = [_cells(rows[0, -5:].tolist())]
    for satellite, signal, *numbers in rows[:, :-5].tolist():
        parts.append(f"{satellite_name(int(satellite))},{signal_name(int(signal))},{_cells(numbers)}")
    return ";".join(parts)


def values_of(text: str) -> tuple[float, ...]:
    """What `text_of` made a text of.

    Raises
    ------
    ValueError
        In a few words, if it is none.
    """
    first, *satellites = text.split(";")
    own = _numbers(first, 5, "place and clock")
    out: list[float] = []
    for one in satellites:
        name, signal, *rest = one.split(",", 2)
        try:
            ids = [satellite_id(name), signal_id(signal)]
        except (ValueError, IndexError):
            raise ValueError(f"'{one[:12]}' begins with no satellite and signal") from None
        out += [*ids, *_numbers("".join(rest), _WIDTH - 7, name), *own]
    return tuple(out)


def _sane(rows: Array) -> Array:
    """Rows that a receiver can have sent, of each satellite and signal the first."""
    good = np.ones(len(rows), dtype=bool)
    at = 0
    for name in _NUMBERS:
        some = rows[:, at : at + _WIDTHS.get(name, 1)]
        low, high, needed = _BOUNDS.get(name, (-np.inf, np.inf, False))
        size = np.linalg.norm(some, axis=1) if name in _WIDTHS else some[:, 0]
        with np.errstate(invalid="ignore"):
            good &= ((size >= low) & (size <= high)) | (np.isnan(size) & (not needed))
        at += some.shape[1]
    _, first = np.unique(rows[:, :2], axis=0, return_index=True)
    good &= np.isin(np.arange(len(rows)), first)
    return rows if good.all() else rows[good]


def _cells(numbers: list[float]) -> str:
    return ",".join("" if np.isnan(x) else repr(x) for x in numbers)


def _numbers(text: str, count: int, what: str) -> list[float]:
    cells = text.split(",")
    if len(cells) != count:
        raise ValueError(f"{what}: needs {count} numbers, not {len(cells)}")
    try:
        return [parse_number(cell) if cell.strip() else float("nan") for cell in cells]
    except ValueError:
        raise ValueError(f"{what}: '{text[:40]}' holds something that is no number") from None


@dataclass
class RawEpochs:
    """Epochs in order of time; those closer than they are used tell where arcs of carriers end.

    Parameters
    ----------
    setup : as `without_epochs` makes it.
    """

    setup: RawGnss
    settings: RawGnssSettings
    _t: list[float] = field(default_factory=list)  # s, of the epochs that are used
    _every: list[float] = field(default_factory=list)  # s
    _rows: dict[float, Array] = field(default_factory=dict)  # (n, _WIDTH), by time
    _arcs: dict[float, Array] = field(default_factory=dict)  # (n,) s, begins of the arcs of their carriers
    _number: dict[float, int] = field(default_factory=dict)  # of those that are used; -1 of one that came late
    _last: dict[tuple[float, float], tuple[float, Array, float]] = field(
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
        rows = _sane(rows)
        return (
            None if select_usable(self._series([0.0], [rows]), self.settings).any() else "no satellite that is of use"
        )

    def wanted(self, t: float) -> bool:
        """Whether no epoch is there that is so near to a time that one of the two suffices."""
        k, least = bisect_left(self._t, t), self.settings.period - EARLY
        near = self._t[max(k - 1, 0) : k + 1]
        return t not in self._rows and all(abs(x - t) >= least and x != t for x in near)

    def add(self, t: float, values: tuple[float, ...], used: bool = True) -> bool:
        """Put an epoch in its place; False if there is one at that time already, which stays."""
        if t in self._rows:
            return False
        k = bisect_left(self._every, t)
        self._every.insert(k, t)
        self._rows[t] = self._with_place(t, _sane(np.reshape(values, (-1, _WIDTH))))
        if used:
            # what is counted already stays: an epoch that comes late has no number, and changes pass it by
            self._number[t] = self._number.get(self.newest, -1) + 1 if t > self.newest else -1
            insort(self._t, t)
        later = self._every[k:]
        if len(later) > 1:  # what came before is to be known again
            self._last = {}
            for x in self._every[:k]:
                self._remember(x)
        for x in later:
            self._arcs[x] = self._find_arcs(x)
            self._remember(x)
        return True

    def after(self, t: float) -> list[tuple[float, tuple[float, ...]]]:
        """The epochs after a time."""
        return [(x, tuple(self._rows[x].ravel().tolist())) for x in self._every[bisect_right(self._every, t) :]]

    def drop_before(self, t: float) -> None:
        """Forget the epochs before a time."""
        k = bisect_left(self._every, t)
        for x in self._every[:k]:
            del self._rows[x], self._arcs[x]
            self._number.pop(x, None)
        del self._every[:k], self._t[: bisect_left(self._t, t)]

    def drop_after(self, t: float) -> None:
        """Forget the epochs after a time."""
        k, self._last = bisect_right(self._every, t), {}
        for x in self._every[k:]:
            del self._rows[x], self._arcs[x]
        del self._every[k:], self._t[bisect_right(self._t, t) :]
        for x in self._every:
            self._remember(x)

    def between(self, begin: float, end: float) -> RawGnss:
        """Those that are used from `begin` to `end`, both included, and the one before, as a series."""
        t = self._t[max(bisect_left(self._t, begin) - 1, 0) : bisect_right(self._t, end)]
        rows = [self._rows[x] for x in t]
        series = self._series(t, rows)
        if not t:
            return series
        number = np.repeat([self._number[x] for x in t], [len(one) for one in rows])
        return replace(series, arc_begin=np.concatenate([self._arcs[x] for x in t]), number=number)

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

    def _with_place(self, t: float, rows: Array) -> Array:
        """Rows with a rough place of the antenna and its clock, where they have none: of this epoch, or the last."""
        if np.isfinite(rows[:, -5:]).all():
            return rows
        rows = rows.copy()
        series = self._series([t], [rows])
        found = solve(series.take(primary(series)))
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
        """(n,) s, when the arcs of an epoch's carriers begin; NaN where there is no carrier."""
        assert self.setup.catalogue is not None
        rows, last = self._rows[t], list(self._last.values())
        if not (self.settings.carrier or self.settings.differences):
            return np.full(len(rows), np.nan)
        series = self._series([*(x for x, _, _ in last), t], [*(row[None] for _, row, _ in last), rows])
        order = np.argsort(series.t, kind="stable")
        series, based = series.take(order), self.setup.catalogue.differenced and self.settings.carrier
        if not based:
            series = replace(series, carrier_difference=np.empty(0))
        period = self.setup.catalogue.period
        found = find_arcs(series, base_arc=series.base_arc if based else None, period=period)
        begin = np.empty(len(order))
        begin[order] = found.begin
        out = begin[len(last) :]
        before = {(row[0], row[1]): (x, arc) for x, row, arc in last}
        for i, row in enumerate(rows):
            x, arc = before.get((row[0], row[1]), (np.nan, np.nan))
            if out[i] == x:  # it goes on
                out[i] = arc
        return out

    def _remember(self, t: float) -> None:
        for row, arc in zip(self._rows[t], self._arcs[t].tolist(), strict=True):
            if np.isfinite(arc):
                self._last[row[0], row[1]] = t, row, arc


def settings_online(settings: Settings, setup: Recording) -> tuple[Settings, tuple[Note, ...]]:
    """The settings as far as raw observations are used online, and what is to be said of that."""
    s = settings.raw_gnss
    if not setup.tight(s.coupling):
        return settings, ()
    less = {"ppp": False, "code": s.code or s.ppp}
    note = Note("online.raw", "precise point positioning is not done online: codes are used, and changes of carriers")
    return settings.model_copy(update={RAW: s.model_copy(update=less)}), (note,) if s.ppp else ()


def codes_alone(settings: Settings) -> Settings:
    """The settings without carriers: a start needs nothing of them."""
    less = settings.raw_gnss.model_copy(update={"differences": False, "carrier": False})
    return settings.model_copy(update={RAW: less})


def without_ambiguities(settings: Settings, setup: Recording) -> Settings:
    """The settings for a noise model: changes of carriers have figures of their own, ambiguities have none."""
    s, raw = settings.raw_gnss, setup.raw_gnss
    if raw is None or not (s.carrier and raw.differenced):
        return settings
    return codes_alone(settings)


def _fill_columns(raw: RawGnss) -> RawGnss:
    """A series with all columns, with nothing in those that it lacks."""
    n, none = len(raw), np.full(len(raw), np.nan)
    return replace(
        raw,
        carrier_difference=raw.carrier_difference if len(raw.carrier_difference) == n else none,
        base_arc=raw.base_arc if len(raw.base_arc) == n else np.full(n, -1),
        lock=raw.lock if len(raw.lock) == n else none,
    )


def _make_empty(raw: RawGnss) -> RawGnss:
    """A series without rows."""
    none = {
        f.name: getattr(raw, f.name)[:0]
        for f in fields(raw)
        if f.name != "lever_arm" and isinstance(getattr(raw, f.name), np.ndarray)
    }
    return replace(raw, **none)


class LiveRaw(BaseModel):
    """What the first line of a live source says of raw observations."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    lever_arm: Vector = (0.0, 0.0, 0.0)
    place: Vector  # m in e, within kilometres of the rover
    zero: float = 0.0  # s since the GPS epoch at t = 0: of the ionosphere's hour
    satellites: tuple[str, ...]  # that there may be
    signals: tuple[tuple[str, str], ...]  # system and signal that codes are used of, the reference first
    period: Positive = 1.0  # s between epochs
    base: bool = False  # rows have differences against a base station
    baseline: NotNegative = 0.0  # m, to it
    klobuchar: tuple[tuple[float, float, float, float], tuple[float, float, float, float]] | None = None
    troposphere: bool = False  # taken off the codes already
    precise: bool = False  # placed by precise orbits and clocks

    def setup(self) -> RawGnss:
        """A series without rows.

        Raises
        ------
        RecordingError
            If it names a satellite or signal that there is not.
        """
        try:
            satellites = tuple(sorted({satellite_id(name) for name in self.satellites}))
            groups = tuple((SYSTEMS.index(system), signal_id(signal)) for system, signal in self.signals)
        except (ValueError, IndexError):
            raise RecordingError(
                'line 1: setup: raw_gnss: satellites are named as G05, signals as ["G", "1C"]', key="online.raw_names"
            ) from None
        none, rows, ids = np.empty(0), np.empty((0, 3)), np.empty(0, dtype=np.int16)
        flags = np.empty(0, dtype=bool)
        return RawGnss(
            t=none, satellite=ids, signal=ids, code=none, carrier=none, range_rate=none, cn0=none, slip=flags,
            half=flags, frequency=none, p=rows, v=rows, clock=none, drift=none, difference=none, zero=self.zero,
            place=self.place, klobuchar=self.klobuchar, troposphere=self.troposphere, lock=none,
            carrier_difference=none, base_arc=np.empty(0, dtype=np.intp), baseline=self.baseline, antenna=rows,
            receiver_clock=np.empty((0, 2)), lever_arm=np.array(self.lever_arm), precise=self.precise,
            catalogue=Catalogue(satellites, groups, self.base, self.period),
        )  # fmt: skip


def live_raw(raw: RawGnss) -> dict[str, object]:
    """What the first line of a live source says of a series, or of its setup."""
    setup = raw if raw.catalogue is not None else without_epochs(raw)
    known = setup.catalogue
    assert known is not None
    return {
        "lever_arm": setup.lever_arm.tolist(), "place": list(setup.place), "zero": setup.zero,
        "satellites": [satellite_name(s) for s in known.satellites],
        "signals": [(SYSTEMS[system], signal_name(signal)) for system, signal in known.groups],
        "period": known.period, "base": known.differenced, "baseline": setup.baseline, "klobuchar": setup.klobuchar,
        "troposphere": setup.troposphere, "precise": setup.precise,
    }  # fmt: skip
