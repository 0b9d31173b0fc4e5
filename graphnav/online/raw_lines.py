"""Epochs of raw observations as rows of a stream, and as text.

An epoch is one row: the numbers of its satellites one after the other, each placed by the ephemerides that were known
when the source began. The setup states the possible satellites and signals, and what all epochs have in common.

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

from dataclasses import fields, replace
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from graphnav.constraints.lasting import find_fix_period
from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_number
from graphnav.core.rotation import Array
from graphnav.gnss.antex import Antennas, SatelliteAntenna
from graphnav.gnss.ppp import choose_second_signals
from graphnav.gnss.series import Catalogue, RawGnss, choose_primary
from graphnav.gnss.signals import (
    SYSTEM_NAMES,
    SYSTEMS,
    is_known_signal,
    name_satellite,
    name_signal,
    number_satellite,
    number_signal,
)
from graphnav.gnss.single_point import group_signals
from graphnav.sensors.tables import NotNegative, Positive, Vector

_NUMBERS = (
    "satellite", "signal", "code", "carrier", "range_rate", "cn0", "slip", "half", "frequency", "p", "v", "clock",
    "drift", "difference", "carrier_difference", "base_arc", "lock", "antenna", "receiver_clock",
)  # fmt: skip
_WIDTHS = {"p": 3, "v": 3, "antenna": 3, "receiver_clock": 2}
# smallest and largest valid value, SI, and whether a row needs it
_BOUNDS = {
    "code": (-1e9, 1e9, False), "carrier": (-1e11, 1e11, False), "range_rate": (-1e6, 1e6, False),
    "cn0": (0.0, 100.0, False), "frequency": (1e9, 3e9, True), "p": (1e7, 1e8, True), "v": (0.0, 2e4, True),
    "clock": (-1e7, 1e7, True), "drift": (-1e3, 1e3, False), "slip": (0.0, 1.0, True), "half": (0.0, 1.0, True),
    "base_arc": (-1.0, 1e9, True), "antenna": (6.3e6, 7e6, False), "receiver_clock": (0.0, 1e9, False),
    "difference": (-1e9, 1e9, False), "carrier_difference": (-1e9, 1e9, False), "lock": (0.0, 1e9, False),
}  # fmt: skip
WIDTH = sum(_WIDTHS.get(name, 1) for name in _NUMBERS)


def drop_epochs(raw: RawGnss) -> RawGnss:
    """The series without epochs: what all of them have in common."""
    placed = raw.take(np.isfinite(raw.p[:, 0]))
    satellites, _ = placed.satellites
    groups, _ = group_signals(placed.take(choose_primary(placed)))
    second = tuple(choose_second_signals(placed).items())
    catalogue = Catalogue(tuple(satellites.tolist()), groups, raw.differenced, find_fix_period(raw.epochs[0]), second)
    return replace(_make_empty(_fill_columns(raw)), catalogue=catalogue)


def list_epochs(raw: RawGnss) -> list[tuple[float, tuple[float, ...]]]:
    """Times (s) and numbers of the epochs of a series, for satellites with a position."""
    raw = _fill_columns(raw.take(np.isfinite(raw.p[:, 0])))
    columns = np.column_stack([np.asarray(getattr(raw, name), dtype=float) for name in _NUMBERS])
    t, first = np.unique(raw.t, return_index=True)
    return [
        (at, tuple(rows.ravel().tolist())) for at, rows in zip(t.tolist(), np.split(columns, first[1:]), strict=True)
    ]


def format_epoch(values: tuple[float, ...]) -> str:
    """An epoch as a part of a line: place and clock, then its satellites, each after a semicolon."""
    rows = np.reshape(values, (-1, WIDTH))
    parts = [_format_cells(rows[0, -5:].tolist())]
    for satellite, signal, *numbers in rows[:, :-5].tolist():
        parts.append(f"{name_satellite(int(satellite))},{name_signal(int(signal))},{_format_cells(numbers)}")
    return ";".join(parts)


def parse_epoch(text: str) -> tuple[float, ...]:
    """Parse the text of `format_epoch`.

    Raises
    ------
    ValueError
        With a short reason, if the text is invalid.
    """
    first, *satellites = text.split(";")
    own = _parse_cells(first, 5, "place and clock")
    out: list[float] = []
    for one in satellites:
        name, signal, *rest = one.split(",", 2)
        try:
            ids = [number_satellite(name), _check_signal(name[0], signal)]
        except (ValueError, IndexError):
            raise ValueError(f"'{one[:12]}' begins with no satellite and signal") from None
        out += [*ids, *_parse_cells("".join(rest), WIDTH - 7, name), *own]
    return tuple(out)


def take_sane(rows: Array) -> Array:
    """Keep plausible rows, the first of each satellite and signal."""
    good = np.ones(len(rows), dtype=bool)
    at = 0
    for name in _NUMBERS:
        some = rows[:, at : at + _WIDTHS.get(name, 1)]
        low, high, needed = _BOUNDS.get(name, (-np.inf, np.inf, False))
        with np.errstate(invalid="ignore", over="ignore"):
            size = np.linalg.norm(some, axis=1) if name in _WIDTHS else some[:, 0]
            good &= ((size >= low) & (size <= high)) | (np.isnan(size) & (not needed))
        at += some.shape[1]
    _, first = np.unique(rows[:, :2], axis=0, return_index=True)
    good &= np.isin(np.arange(len(rows)), first)
    return rows if good.all() else rows[good]


def _check_signal(system: str, name: str) -> int:
    """The number of a signal that satellites of a system send.

    Raises
    ------
    ValueError
        If they send none of that name.
    """
    if not is_known_signal(SYSTEMS.index(system), name):
        raise ValueError(f"{SYSTEM_NAMES[SYSTEMS.index(system)]} has no signal '{name}'")
    return number_signal(name)


def _format_cells(numbers: list[float]) -> str:
    return ",".join("" if np.isnan(x) else repr(x) for x in numbers)


def _parse_cells(text: str, count: int, what: str) -> list[float]:
    cells = text.split(",")
    if len(cells) != count:
        raise ValueError(f"{what}: needs {count} numbers, not {len(cells)}")
    try:
        return [parse_number(cell) if cell.strip() else float("nan") for cell in cells]
    except ValueError:
        raise ValueError(f"{what}: '{text[:40]}' holds something that is no number") from None


def build_raw_series(t: list[float], rows: list[Array], setup: RawGnss) -> RawGnss:
    """The series of epochs at times (s) with numbers (n, WIDTH) each, of a setup."""
    if not t:
        return setup
    numbers = np.concatenate(rows)
    columns: dict[str, Array] = {"t": np.repeat(t, [len(one) for one in rows])}
    at = 0
    for name in _NUMBERS:
        wide = _WIDTHS.get(name)
        own = numbers[:, at] if wide is None else numbers[:, at : at + wide]
        columns[name] = own.astype(getattr(setup, name).dtype)
        at += wide or 1
    return replace(setup, **columns)  # type: ignore[arg-type]


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


_Way = Annotated[float, Field(ge=-100.0, le=100.0)]  # m, of an antenna's phase centre


class LiveRaw(BaseModel):
    """The raw observations' part of a live source's first line."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    lever_arm: Vector = (0.0, 0.0, 0.0)
    place: Vector  # m in e, within kilometres of the rover
    zero: float = 0.0  # s since the GPS epoch at t = 0: the ionosphere depends on the time of day
    satellites: tuple[str, ...]  # that there may be
    signals: tuple[tuple[str, str], ...]  # systems and signals whose codes are used, the reference first
    period: Positive = 1.0  # s between epochs
    base: bool = False  # rows have differences against a base station
    baseline: NotNegative = 0.0  # m, to it
    klobuchar: tuple[tuple[float, float, float, float], tuple[float, float, float, float]] | None = None
    troposphere: bool = False  # corrections already applied to the codes
    precise: bool = False  # placed by precise orbits and clocks
    second: dict[str, str] = {}  # of precise point positioning: the second signal of each satellite
    # m, by band: in the satellite's axes, and then `SatelliteAntenna.variation`
    antennas: dict[str, dict[int, Annotated[tuple[_Way, ...], Field(min_length=3, max_length=94)]]] = {}
    clock_noise: dict[str, tuple[NotNegative, Positive]] = {}  # m off a line between nodes, s apart

    def make_setup(self) -> RawGnss:
        """A series without rows.

        Raises
        ------
        RecordingError
            If it names an unknown satellite or signal.
        """
        try:
            satellites = tuple(sorted({number_satellite(name) for name in self.satellites}))
            groups = tuple((SYSTEMS.index(system), _check_signal(system, name)) for system, name in self.signals)
            second = tuple(
                (number_satellite(name), _check_signal(name[0], signal)) for name, signal in self.second.items()
            )
            offsets = {number_satellite(name): one for name, one in self.antennas.items()}
            noise = {number_satellite(name): one for name, one in self.clock_noise.items()}
        except (ValueError, IndexError) as error:
            raise RecordingError(
                f'line 1: setup: raw_gnss: {error}; satellites are named as G05, signals as ["G", "1C"]',
                key="online.raw_names",
            ) from None
        antennas: Antennas = {}
        for satellite, one in offsets.items():
            by_band = {band: np.array(x[:3]) for band, x in one.items()}
            varied = {band: np.array(x[3:]) for band, x in one.items() if len(x) > 3}
            antennas[satellite] = (SatelliteAntenna(-np.inf, np.inf, by_band, varied),)
        none, rows, ids = np.empty(0), np.empty((0, 3)), np.empty(0, dtype=np.int16)
        flags = np.empty(0, dtype=bool)
        return RawGnss(
            t=none, satellite=ids, signal=ids, code=none, carrier=none, range_rate=none, cn0=none, slip=flags,
            half=flags, frequency=none, p=rows, v=rows, clock=none, drift=none, difference=none, zero=self.zero,
            place=self.place, klobuchar=self.klobuchar, troposphere=self.troposphere, lock=none,
            carrier_difference=none, base_arc=np.empty(0, dtype=np.intp), baseline=self.baseline, antenna=rows,
            receiver_clock=np.empty((0, 2)), lever_arm=np.array(self.lever_arm), precise=self.precise,
            antennas=antennas, clock_noise=noise,
            catalogue=Catalogue(satellites, groups, self.base, self.period, second),
        )  # fmt: skip


def describe_live_raw(raw: RawGnss) -> dict[str, object]:
    """The part of a live source's first line for a series, or for its setup."""
    setup = raw if raw.catalogue is not None else drop_epochs(raw)
    known = setup.catalogue
    assert known is not None
    antennas = {
        name_satellite(s): {band: [*x.tolist(), *one.variation.get(band, ())] for band, x in one.offset.items()}
        for s in known.satellites
        for one in setup.antennas.get(s, ())
        if one.begin <= setup.zero <= one.end
    }
    return {
        "lever_arm": setup.lever_arm.tolist(), "place": list(setup.place), "zero": setup.zero,
        "satellites": [name_satellite(s) for s in known.satellites],
        "signals": [(SYSTEMS[system], name_signal(signal)) for system, signal in known.groups],
        "period": known.period, "base": known.differenced, "baseline": setup.baseline, "klobuchar": setup.klobuchar,
        "troposphere": setup.troposphere, "precise": setup.precise,
        "second": {name_satellite(s): name_signal(g) for s, g in known.second}, "antennas": antennas,
        "clock_noise": {name_satellite(s): one for s, one in setup.clock_noise.items() if s in known.satellites},
    }  # fmt: skip
