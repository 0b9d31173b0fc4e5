"""Ionosphere-free combinations of codes and carrier phases, with corrections for precise point positioning.

The ionosphere delays codes, and advances carriers, by the inverse square of the frequency, so the combination f1^2 /
(f1^2 - f2^2) times the first less f2^2 / (f1^2 - f2^2) times the second is free of it. Modelled beside range and clocks
are the satellites' phase centres (ANTEX), phase wind-up, the solid Earth tide, the Shapiro delay, and the dry and wet
troposphere of a standard atmosphere (Kouba and Heroux 2001, "Precise point positioning using IGS orbit and clock
products").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphnav.core import earth
from graphnav.core.rotation import Array
from graphnav.gnss.antex import compute_antenna_paths, compute_satellite_axes, compute_shapiro_delay, compute_wind_up
from graphnav.gnss.arcs import Arcs, build_arcs, find_arcs
from graphnav.gnss.atmosphere import compute_day_of_year, compute_niell_mapping, compute_zenith_delays
from graphnav.gnss.carrier import find_rows
from graphnav.gnss.series import RawGnss
from graphnav.gnss.signals import GALILEO, GLONASS, GPS, QZSS, C, name_signal, number_signal
from graphnav.gnss.single_point import Geometry, look
from graphnav.gnss.tides import compute_solid_tide, locate_sun_and_moon

# the second band of the combination that precise clocks refer to; for BeiDou it differs between products
SECOND = {GPS: 2, GLONASS: 2, GALILEO: 5, QZSS: 2}
# whose antennas are two metres or more off the centre of mass: without an antenna file a station was 15 cm off by them
_NEEDS_ANTENNA = (GLONASS,)
# the code on the first band that these clocks refer to, where receivers may also have another: the differential code
# bias is up to a nanosecond for each satellite, and two and a half times that in the combination
_OF_CLOCKS = {GPS: number_signal("1W")}


@dataclass(frozen=True)
class IonosphereFree:
    """N rows: those of a first signal for which the satellite also has a second one."""

    which: NDArray[np.intp]  # (N,) indices into the given rows
    geometry: Geometry
    known: Array  # (N,) m, range from the nominal antenna plus all modelled corrections
    code: Array  # (N,) m, with the satellite's clock
    carrier: Array  # (N,) m, with the satellite's clock; NaN where one of the two carrier phases is missing
    wet: Array  # (N,) wet mapping function
    lane: Array  # (N,) m, change of the carrier by a cycle of both signals: the least of slips of two cycles at most
    growth: Array  # (N,) amplification of white noise of equal size on both signals
    arcs: Arcs  # arcs in which neither carrier phase has slipped; a slot is a pair of signals of a satellite


def combine_ionosphere_free(raw: RawGnss, whole: RawGnss) -> IonosphereFree | None:
    """Combine the rows of a first band with those of the second signal.

    Parameters
    ----------
    raw : a row for each satellite and epoch, of its first signal.
    whole : all rows of the receiver, second signals included.
    """
    second = _find_rows_beside(raw, whole, choose_second_signals(whole), np.isfinite(whole.carrier))
    which = np.flatnonzero(second >= 0)
    if not len(which):
        return None
    one, other = raw.take(which), whole.take(second[which])
    signals = {int(s): _OF_CLOCKS[int(s) // 100] for s in np.unique(one.satellite) if int(s) // 100 in _OF_CLOCKS}
    better = _find_rows_beside(one, whole, signals, np.ones(len(whole), dtype=bool))
    code = np.where(better >= 0, whole.code[better], one.code)
    arcs, first_rows = find_arcs(whole), find_rows(one, whole)
    f1, f2 = one.frequency, other.frequency
    alpha = f1**2 / (f1**2 - f2**2)
    beta = alpha - 1.0

    def free(a: Array, b: Array) -> Array:
        return np.asarray(alpha * a - beta * b)

    geometry = look(one, one.antenna, None)
    gps = one.t + one.zero
    sun, moon = locate_sun_and_moon(gps)
    place = earth.ecef_to_llh(one.antenna)
    wound = one.wound if len(one.wound) else compute_series_wind_up(one)
    extra = compute_shapiro_delay(geometry.s, one.antenna) - np.sum(
        geometry.e * compute_solid_tide(one.antenna, sun, moon), axis=1
    )
    if raw.antennas:
        bands, both = np.stack([one.signal // 100, other.signal // 100], -1), np.stack([f1, f2], -1)
        axes = compute_satellite_axes(geometry.s, sun)
        told = compute_antenna_paths(raw.antennas, one.satellite, both, bands, gps, axes, geometry.e)
        extra = extra + np.nan_to_num(told)
    dry, wet = compute_zenith_delays(place)
    if raw.troposphere:  # has been subtracted already
        dry, wet = np.zeros(len(one)), np.zeros(len(one))
    by_dry, by_wet = compute_niell_mapping(place, geometry.elevation, compute_day_of_year(gps))
    carrier = free(one.carrier * C / f1, other.carrier * C / f2) + one.clock
    carrier -= wound * C / (f1 + f2)
    good = (arcs.arc[first_rows] >= 0) & (arcs.arc[second[which]] >= 0) & ~one.half & ~other.half
    return IonosphereFree(
        which=which,
        geometry=geometry,
        known=geometry.distance + extra + dry * by_dry + wet * by_wet,
        code=free(code, other.code) + free(one.clock, other.clock),
        carrier=np.where(good, carrier, np.nan),
        wet=by_wet,
        lane=C / (f1 + f2),
        growth=np.hypot(alpha, beta),
        arcs=_join_arcs(arcs, first_rows, second[which], good),
    )


def choose_second_signals(raw: RawGnss) -> dict[int, int]:
    """The second signal of each satellite that has one; of several of a band the one with most carrier phases."""
    if raw.catalogue is not None:
        return dict(raw.catalogue.second)
    useful, out = np.isfinite(raw.carrier) & np.isfinite(raw.code) & np.isfinite(raw.clock), {}
    for one in np.unique(raw.satellite[useful]).tolist():
        own = useful & (raw.satellite == one) & (raw.signal // 100 == SECOND.get(one // 100, -1))
        if own.any() and (one in raw.antennas or one // 100 not in _NEEDS_ANTENNA):
            signals, many = np.unique(raw.signal[own], return_counts=True)
            out[one] = int(signals[np.argmax(many)])
    return out


def compute_series_wind_up(raw: RawGnss) -> Array:
    """(N,) cycles of phase wind-up of a series, continuous for each satellite."""
    geometry = look(raw, raw.antenna, None)
    axes = compute_satellite_axes(geometry.s, locate_sun_and_moon(raw.t + raw.zero)[0])
    return compute_wind_up(raw.satellite, raw.t, axes, geometry.e, earth.enu_axes(earth.ecef_to_llh(raw.antenna)))


def _find_rows_beside(
    raw: RawGnss, whole: RawGnss, signals: Mapping[int, int], usable: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """(N,) the usable row of `whole` with the second signal of the same satellite and epoch; -1: none."""
    out = np.full(len(raw), -1, dtype=np.intp)
    epochs = np.unique(whole.t)
    useful = usable & np.isfinite(whole.code) & np.isfinite(whole.clock)
    for one, signal in signals.items():
        own = np.flatnonzero((whole.satellite == one) & useful & (whole.signal == signal))
        at = np.full(len(epochs), -1, dtype=np.intp)
        at[np.searchsorted(epochs, whole.t[own])] = own
        rows = np.flatnonzero((raw.satellite == one) & (raw.signal // 100 == 1))
        out[rows] = at[np.searchsorted(epochs, raw.t[rows])]
    return out


def _join_arcs(arcs: Arcs, first: NDArray[np.intp], second: NDArray[np.intp], good: NDArray[np.bool_]) -> Arcs:
    """Arcs of pairs of rows: each begins where the later of its two arcs does."""
    pairs, slot = np.unique(np.stack([arcs.slot[first], arcs.slot[second]], -1), axis=0, return_inverse=True)
    names = tuple(f"{arcs.names[a]}+{name_signal(arcs.signal[b])}" for a, b in pairs.tolist())
    begin = np.where(good, np.maximum(arcs.begin[first], arcs.begin[second]), np.nan)
    return build_arcs(begin, slot.reshape(-1), names, arcs.satellite[pairs[:, 0]], arcs.signal[pairs[:, 0]])
