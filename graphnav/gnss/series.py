"""Raw observations of one receiver, a row for each epoch, satellite and signal."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.gnss.antex import Antennas
from graphnav.gnss.signals import C, Ids, find_frequencies

_LARGEST_CODE = 1e9  # m, of a code: satellites are 4.3e7 m away at most, and receiver clocks are not seconds off
_LARGEST_DOPPLER = 1e6  # Hz, of a Doppler shift: satellite motion causes 1e4, an oscillator off by 1e-4 2e5
_MOST_CYCLES = 1e11  # of a carrier: more than F14.3 holds
_LONGEST_SPAN = 3.15e7  # s, a year


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
    """Sort by time, satellite and signal; of repeated rows the first is kept.

    Raises
    ------
    RecordingError
        If their times are years apart.
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
    _, first = np.unique(key, return_index=True)
    twice = len(obs) - len(first)
    out = obs.take(first)
    if not twice:
        return out
    return replace(
        out,
        remarks=(
            *out.remarks,
            Note("raw.twice", f"{format_count(twice, 'repeated observation')} left out; the first of each is used"),
        ),
    )


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


def compute_epoch_medians(t: Array, value: Array) -> Array:
    """(N,) the median of the values of each row's epoch; NaN where an epoch has none."""
    epochs, of = np.unique(t, return_inverse=True)
    order = np.lexsort((value, of))  # NaN last
    edge = np.searchsorted(of[order], np.arange(len(epochs) + 1))
    many = np.bincount(of, weights=np.isfinite(value), minlength=len(epochs)).astype(np.intp)
    low, high = edge[:-1] + np.maximum(many - 1, 0) // 2, edge[:-1] + np.minimum(many // 2, np.diff(edge) - 1)
    return np.asarray((0.5 * (value[order[low]] + value[order[high]]))[of])
