"""Raw observations of one receiver, a row for each epoch, satellite and signal."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Note, Notes, format_count
from graphnav.core.rotation import Array
from graphnav.gnss.antex import Antennas
from graphnav.gnss.signals import SYSTEM_NAMES, C, Ids, find_frequencies, name_signal

_LARGEST_CODE = 1e9  # m, of a code: satellites are 4.3e7 m away at most, and receiver clocks are not seconds off
_LARGEST_DOPPLER = 1e6  # Hz, of a Doppler shift: satellite motion causes 1e4, an oscillator off by 1e-4 2e5
_MOST_CYCLES = 1e11  # of a carrier: more than F14.3 holds
_LONGEST_SPAN = 3.15e7  # s, a year
_LEAST_TRACKED = 10.0  # dB-Hz, below which nothing is tracked; strengths in nine classes are below it (RINEX 3.05)
_TELLING = 50.0  # m, change of a code from epoch to epoch beside which its noise is small
_FEWEST_CHANGES = 20  # of these, from which a median is taken
_UNLIKE = 0.3  # of the ratio of changes to those of the codes: another sign or unit is further off, noise is not


@dataclass(frozen=True)
class Observations:
    """N rows in order of time; NaN where a number is absent."""

    zero: float  # s since the GPS epoch at t = 0
    t: Array  # (N,) s, the receiver's stamp
    satellite: Ids  # (N,)
    signal: Ids  # (N,)
    code: Array  # (N,) m
    carrier: Array  # (N,) cycles
    doppler: Array  # (N,) Hz, positive for an approaching satellite
    cn0: Array  # (N,) dB-Hz
    slip: NDArray[np.bool_]  # (N,) loss of lock since the previous epoch
    half: NDArray[np.bool_]  # (N,) unresolved half cycle
    lock: Array  # (N,) s, lock time of the carrier phase, where the receiver reports it
    channels: dict[int, int] = field(default_factory=dict)  # of GLONASS satellites
    marker: Array | None = None  # (3,) m in e, rough position of the antenna as the file states it
    files: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.t)

    def take(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Some of the rows."""
        own = {
            f.name: getattr(self, f.name)[which]
            for f in fields(self)
            if f.name != "marker" and isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, **own)

    def move_to_clock(self, zero: float) -> Observations:
        """The same on a clock with another zero (s since the GPS epoch)."""
        return replace(self, t=self.t + (self.zero - zero), zero=zero)

    @property
    def frequency(self) -> Array:
        """(N,) Hz."""
        return find_frequencies(self.satellite, self.signal, self.channels)

    @property
    def range_rate(self) -> Array:
        """(N,) m/s, from the Doppler shift."""
        return np.asarray(-self.doppler * C / self.frequency)


def join_files(parts: list[Observations]) -> Observations:
    """Join files of one receiver in order of time; rows contained in two files are taken once."""
    if len(parts) == 1:
        return parts[0]
    zero = parts[0].zero
    parts = [part.move_to_clock(zero) for part in parts]
    arrays = {
        f.name: np.concatenate([getattr(part, f.name) for part in parts])
        for f in fields(Observations)
        if f.name != "marker" and isinstance(getattr(parts[0], f.name), np.ndarray)
    }
    channels = {key: value for part in parts for key, value in part.channels.items()}
    marker = next((part.marker for part in parts if part.marker is not None), None)
    whole = Observations(
        zero=zero, channels=channels, marker=marker, files=tuple(f for p in parts for f in p.files),
        remarks=tuple(r for p in parts for r in p.remarks), **arrays,
    )  # fmt: skip
    return drop_repeated(whole)


def drop_repeated(obs: Observations) -> Observations:
    """Sort by time, satellite and signal; of repeated rows the first is kept, and none of those that differ.

    Raises
    ------
    RecordingError
        If their times are years apart, or files have two receivers' observations of the same time.
    """
    obs = _drop_impossible(obs)
    span = float(np.ptp(obs.t)) if len(obs) else 0.0
    if not span <= _LONGEST_SPAN:
        raise RecordingError(
            f"{obs.files[0]}: its observations span {span / 86400.0:.3g} days; is a date wrong?", key="raw.span"
        )
    tick = np.round(obs.t * 1e4).astype(np.int64)
    key = (tick - tick.min(initial=0)) * 10**7 + obs.satellite.astype(np.int64) * 10**4 + obs.signal
    if np.all(np.diff(key) > 0):
        return obs
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    again = np.delete(np.arange(len(obs)), first)
    if not len(again):
        return obs.take(first)
    of_first = first[of[again]]
    other = ~np.all(
        [np.isclose(x[again], x[of_first], 0.0, 1e-3, equal_nan=True) for x in (obs.code, obs.carrier)], axis=0
    )
    differ, several = np.unique(of[again[other]]), np.unique(of[again])
    if len(obs.files) > 1 and 2 * len(differ) > len(several):
        raise RecordingError(
            f"{' and '.join(obs.files)}: {len(differ)} of {len(several)} observations that two of them have differ: "
            "they are of two receivers; name the files of one in rover, that of a base station in base",
            key="raw.two_receivers",
        )
    remarks = Notes(obs.remarks)
    if same := int(np.sum(~other)):
        sentence = f"{format_count(same, 'repeated observation')} left out; the first of each is used"
        remarks.add("raw.twice", sentence)
    if len(differ):
        sentence = f"{format_count(len(differ), 'observation')} left out: there twice, with other values"
        remarks.add("raw.twice_unlike", sentence)
    return replace(obs.take(np.delete(first, differ)), remarks=tuple(remarks))


def drop_contradictory(raw: RawGnss) -> tuple[RawGnss, tuple[str, ...]]:
    """Drop signal strengths, carrier phases and Doppler shifts that are in another unit, or have another sign.

    From epoch to epoch a carrier phase changes as the code does, and so does the integral of the range rate; the
    receiver's clock is in all of them. Remarks say what was dropped.
    """
    name, notes = PurePath(raw.files[0]).name if raw.files else "rover", Notes()
    if 0.0 <= (strongest := float(np.max(raw.cn0, initial=-np.inf, where=np.isfinite(raw.cn0)))) < _LEAST_TRACKED:
        sentence = f"{name}: signal strengths are no C/N0 in dB-Hz, the largest is {strongest:g}: they are not used"
        raw = replace(raw, cn0=np.full(len(raw), np.nan))
        notes.add("raw.strength_unit", sentence)
    order = np.lexsort((raw.t, raw.signal, raw.satellite))
    now, before = order[1:], order[:-1]
    dt = raw.t[now] - raw.t[before]
    same = (raw.satellite[now] == raw.satellite[before]) & (raw.signal[now] == raw.signal[before]) & (dt > 0.0)
    now, before, dt = now[same], before[same], dt[same]
    change = raw.code[now] - raw.code[before]
    told = np.abs(change) > _TELLING
    group = raw.satellite // 100 * 1000 + raw.signal
    with np.errstate(invalid="ignore"):
        by_carrier = C / raw.frequency[now] * (raw.carrier[now] - raw.carrier[before])
        by_doppler = 0.5 * (raw.range_rate[now] + raw.range_rate[before]) * dt
    for what, column, other in (("carriers", "carrier", by_carrier), ("Doppler shifts", "range_rate", by_doppler)):
        value, wrong = getattr(raw, column).copy(), []
        for one in np.unique(group).tolist():
            rows = told & (group[now] == one) & np.isfinite(other)
            if rows.sum() < _FEWEST_CHANGES:
                continue
            if abs((ratio := float(np.median(other[rows] / change[rows]))) - 1.0) > _UNLIKE:
                value[group == one] = np.nan
                wrong.append(f"{SYSTEM_NAMES[one // 1000]} {name_signal(one % 1000)} ({ratio:.2f})")
        if wrong:
            sentence = (
                f"{name}: {what} change otherwise than the codes, as by another unit or sign (times what codes do): "
                f"{', '.join(wrong)}; they are not used"
            )
            raw = replace(raw, **{column: value})
            notes.add("raw.unlike_codes", sentence)
    return raw, tuple(notes)


def _drop_impossible(obs: Observations) -> Observations:
    """Drop values beyond what a receiver can measure."""
    with np.errstate(invalid="ignore"):
        bad = (
            (np.abs(obs.code) > _LARGEST_CODE)
            | (np.abs(obs.doppler) > _LARGEST_DOPPLER)
            | (np.abs(obs.carrier) > _MOST_CYCLES)
        )
    if not bad.any():
        return obs
    code, carrier, doppler = (np.where(bad, np.nan, x) for x in (obs.code, obs.carrier, obs.doppler))
    sentence = f"{format_count(bad.sum(), 'observation')} beyond what a receiver can measure, left out"
    remark = Note("raw.impossible", sentence)
    return replace(obs, code=code, carrier=carrier, doppler=doppler, remarks=(*obs.remarks, remark))


@dataclass(frozen=True)
class Catalogue:
    """Satellites and signals of a series, so that pieces of it number them identically."""

    satellites: tuple[int, ...]  # ascending
    groups: tuple[tuple[int, int], ...]  # systems with their signals, the reference first
    differenced: bool  # against a base station
    period: float  # s between epochs
    second: tuple[tuple[int, int], ...] = ()  # satellites with their second signals (`graphnav.gnss.ppp`)


@dataclass(frozen=True)
class RawGnss:
    """Observations of a rover with their satellites placed: N rows on the recording's clock, in order of time."""

    t: Array  # (N,) s at which the antenna received: the receiver's stamp less its clock error
    satellite: Ids  # (N,)
    signal: Ids  # (N,)
    code: Array  # (N,) m, by the receiver's stamp
    carrier: Array  # (N,) cycles
    range_rate: Array  # (N,) m/s, from the Doppler shift
    cn0: Array  # (N,) dB-Hz
    slip: NDArray[np.bool_]  # (N,)
    half: NDArray[np.bool_]  # (N,)
    frequency: Array  # (N,) Hz
    p: Array  # (N, 3) m, satellite in the Earth-fixed frame of the time of transmission; NaN where unknown
    v: Array  # (N, 3) m/s
    clock: Array  # (N,) m, satellite clock ahead of GPS time, less group delay; 0 where the code is already corrected
    drift: Array  # (N,) m/s of it
    difference: Array  # (N,) m, differential correction of the code; NaN without a counterpart at the base
    zero: float  # s since the GPS epoch at t = 0
    place: tuple[float, float, float]  # m in e, within kilometres of the rover
    klobuchar: tuple[tuple[float, ...], ...] | None = None  # broadcast Klobuchar coefficients
    troposphere: bool = False  # corrections already applied to the codes
    lock: Array = field(default_factory=lambda: np.empty(0))  # (N,) s, lock time of the carrier phase
    # (N,) m, differential correction of the carrier phase, and the base's arc; NaN and -1 without one
    carrier_difference: Array = field(default_factory=lambda: np.empty(0))
    base_arc: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=int))
    baseline: float = 0.0  # m, to the base station
    # m, east, north, up: its own single-point position less the stated one, and 1-sigma; none without a base
    base_off: tuple[tuple[float, ...], ...] = ()
    arc_begin: Array = field(default_factory=lambda: np.empty(0))  # (N,) s, start of the carrier-phase arc, where known
    wound: Array = field(default_factory=lambda: np.empty(0))  # (N,) cycles of phase wind-up, where known
    # (N,) number of the epoch among all in use, for a piece of a series; -1 for one received late
    number: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=int))
    antenna: Array = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) m in e, single-point, of each epoch
    receiver_clock: Array = field(default_factory=lambda: np.empty((0, 2)))  # (N, 2) m and m/s, single-point
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))  # m, RFU, from the IMU
    files: tuple[str, ...] = ()
    precise: bool = False  # placed by precise orbits and clocks
    antennas: Antennas = field(default_factory=dict)  # satellite antennas, where an ANTEX file is given
    # by satellite, as `graphnav.gnss.precise.Orbits.clock_noise` says
    clock_noise: dict[int, tuple[float, float]] = field(default_factory=dict)
    catalogue: Catalogue | None = None  # of the whole series, for a piece of it

    def __len__(self) -> int:
        return len(self.t)

    def take(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> RawGnss:
        """Some of the rows."""
        own = {
            f.name: getattr(self, f.name)[which]
            for f in fields(self)
            if f.name != "lever_arm" and isinstance(getattr(self, f.name), np.ndarray) and len(getattr(self, f.name))
        }
        return replace(self, **own)

    @property
    def differenced(self) -> bool:
        """Whether a base station is there."""
        return bool(np.isfinite(self.difference).any()) if self.catalogue is None else self.catalogue.differenced

    @property
    def satellites(self) -> tuple[Ids, NDArray[np.intp]]:
        """Satellites (S,), ascending, and the index of each row's."""
        if self.catalogue is None:
            return np.unique(self.satellite, return_inverse=True)
        every = np.array(self.catalogue.satellites, dtype=self.satellite.dtype)
        return every, np.searchsorted(every, self.satellite)

    @property
    def seconds_of_week(self) -> Array:
        """(N,) GPS seconds of the week."""
        return np.mod(self.t + np.mod(self.zero, 604800.0), 604800.0)

    @property
    def epochs(self) -> tuple[Array, NDArray[np.intp]]:
        """Times (E,) of the epochs, and the index of each row's."""
        return np.unique(self.t, return_inverse=True)


def choose_primary(raw: RawGnss) -> NDArray[np.bool_]:
    """(N,) mask of one row per satellite and epoch: the signal with the best-known group delay, L1 or B1 first."""
    order = np.where(raw.signal // 100 == 1, 0, raw.signal // 100) + np.where(raw.signal % 100 == 2, 0.0, 0.5)
    order = np.where(np.isfinite(raw.code), order, 100.0)
    sorted_rows = np.lexsort((order, raw.satellite, raw.t))
    t, satellite = raw.t[sorted_rows], raw.satellite[sorted_rows]
    first = np.concatenate([[True], (np.diff(t) > 0) | (np.diff(satellite) != 0)])[: len(t)]
    out = np.zeros(len(raw), dtype=bool)
    out[sorted_rows[first]] = True
    return out & np.isfinite(raw.code)


def compute_medians(of: Array | Ids, value: Array) -> Array:
    """(N,) the median of the values of each row's epoch, or other group; NaN where a group has none."""
    epochs, of = np.unique(of, return_inverse=True)
    order = np.lexsort((value, of))  # NaN last
    edge = np.searchsorted(of[order], np.arange(len(epochs) + 1))
    many = np.bincount(of, weights=np.isfinite(value), minlength=len(epochs)).astype(np.intp)
    low, high = edge[:-1] + np.maximum(many - 1, 0) // 2, edge[:-1] + np.minimum(many // 2, np.diff(edge) - 1)
    return np.asarray((0.5 * (value[order[low]] + value[order[high]]))[of])
