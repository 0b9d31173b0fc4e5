"""Carrier-phase arcs: spans in which a receiver tracks a signal without a cycle slip.

Within an arc the carrier phase is a range plus one constant, the ambiguity. A new arc begins where

* the receiver flags a loss of lock, or its half-cycle flag changes (RINEX 3.05, table A2),
* the signal, or every signal, is absent for an epoch, unless the lock time counter covers the gap,
* the base station's arc of that signal ends,
* the change since the previous epoch deviates by more than a quarter of a cycle from the displacement and clock change
  common to all satellites: a slip is at least half a cycle, so beyond a quarter a slip is the nearer explanation,
  unless a change of the ionospheric delay explains all signals of the satellite,
* there is such a change, and fewer than half of the others agree to within their sigmas: any may have slipped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from graphnav.core.rotation import Array
from graphnav.gnss.atmosphere import compute_obliquity
from graphnav.gnss.series import RawGnss
from graphnav.gnss.sigmas import compute_carrier_difference_sigma
from graphnav.gnss.signals import L1, C, Ids, name_satellite, name_signal
from graphnav.gnss.single_point import choose_coefficients, look

_REWEIGHTINGS = 20  # iterations of reweighting, for the least sum of absolute residuals
_SPARE = 2  # least redundancy of the rows that others are tested against
_ALARM = 0.001  # false alarm probability of the test whether the other rows agree
# m/sqrt(s), random walk of a satellite's clock about its broadcast line: cesium's, whose Allan deviation at 1 s is
# 1e-11; with the ionosphere it is 2 mm/sqrt(s) on a drive measured (`graphnav.constraints.raw_carrier`)
_CLOCK_WALK = 1e-11 * C
_LEAST_DRIFT = 1e-6  # m, of an ionosphere that does not change
_NOISE = 0.01  # m, of a carrier-phase difference: smaller residuals have equal weight
# m/sqrt(s) at the zenith, random walk of the ionospheric delay on L1, and m, the length of a baseline whose ends differ
# by as much (RTKLIB 2.4.3, prniono in ppp.c, udiono_ppp, and in rtkpos.c, udion)
_IONOSPHERE_WALK, _APART = 1e-3, 1e4


@dataclass(frozen=True)
class Arcs:
    """The arc of each of N rows; a slot is one signal of one satellite."""

    slot: NDArray[np.intp]  # (N,)
    arc: NDArray[np.intp]  # (N,) counted from 0 within its slot; -1 without carrier phase
    names: tuple[str, ...]  # (S,) of the slots: "G05.1C"
    satellite: Ids  # (S,)
    signal: Ids  # (S,)
    begins: tuple[Array, ...]  # (S,) of (n,) s: first times of the arcs
    slips: int  # slips without a flag

    @property
    def begin(self) -> Array:
        """(N,) s, start of each row's arc; NaN without carrier phase."""
        out = np.full(len(self.arc), np.nan)
        for slot, begins in enumerate(self.begins):
            own = (self.slot == slot) & (self.arc >= 0)
            out[own] = begins[self.arc[own]]
        return out


def find_arcs(
    raw: RawGnss, still: bool = False, base_arc: NDArray[np.intp] | None = None, period: float | None = None
) -> Arcs:
    """Find the arcs of a receiver's carrier phases.

    Parameters
    ----------
    raw : all epochs and signals of the receiver, with nominal antenna positions, before any rows are left out.
    still : the antenna is fixed at its nominal position, as a base station's is.
    base_arc : (N,) number of the base station's arc of the slot.
    period : s between epochs, where the series is too short to tell.
    """
    key = raw.satellite.astype(np.int64) * 1000 + raw.signal
    slots, slot = np.unique(key, return_inverse=True)
    if len(raw.arc_begin):
        return build_arcs(raw.arc_begin, slot, *_name_slots(slots))  # of a piece of a series
    epochs, epoch = raw.epochs
    typical = period or (float(np.median(np.diff(epochs))) if len(epochs) > 1 else np.inf)
    there = np.isfinite(raw.carrier) & np.isfinite(raw.p[:, 0]) & np.isfinite(raw.clock)
    if base_arc is not None:
        there &= base_arc >= 0
    order = np.flatnonzero(there)
    order = order[np.lexsort((epoch[order], slot[order]))]
    now, before = order[1:], order[:-1]
    same = slot[now] == slot[before]
    since = raw.t[now] - raw.t[before]
    held = np.nan_to_num(raw.lock[now], nan=-1.0) > since if len(raw.lock) else np.zeros_like(same)
    held |= (epoch[now] - epoch[before] == 1) & (since < 1.5 * typical)
    kept = same & held & ~raw.slip[now] & (raw.half[now] == raw.half[before])
    if base_arc is not None:
        kept &= base_arc[now] == base_arc[before]
    slipped = _find_slips(raw, now[kept], before[kept], epoch, still)
    kept[np.flatnonzero(kept)[slipped]] = False
    begins_here = np.concatenate([[True], ~kept])[: len(order)]
    count = np.cumsum(begins_here) - 1
    first_of_slot = np.searchsorted(slot[order], np.arange(len(slots)))
    arc = np.full(len(raw), -1)
    base = count[np.minimum(first_of_slot, max(len(count) - 1, 0))] if len(count) else np.zeros(len(slots), dtype=int)
    arc[order] = count - base[slot[order]]
    firsts = [order[begins_here & (slot[order] == k)] for k in range(len(slots))]
    return Arcs(slot, arc, *_name_slots(slots), tuple(raw.t[k] for k in firsts), int(slipped.sum()))


def build_arcs(begin: Array, slot: NDArray[np.intp], names: tuple[str, ...], satellite: Ids, signal: Ids) -> Arcs:
    """Number the arcs of rows (N,) from the start time of each row's arc (s; NaN without carrier phase)."""
    arc, begins = np.full(len(begin), -1), []
    for k in range(len(names)):
        own = np.flatnonzero((slot == k) & np.isfinite(begin))
        t, arc[own] = np.unique(begin[own], return_inverse=True)
        begins.append(t)
    return Arcs(slot, arc, names, satellite, signal, tuple(begins), 0)


def _name_slots(slots: NDArray[np.int64]) -> tuple[tuple[str, ...], Ids, Ids]:
    """Names, satellites and signals of slots."""
    satellites, signals = (slots // 1000).astype(np.int16), (slots % 1000).astype(np.int16)
    return (
        tuple(f"{name_satellite(s)}.{name_signal(g)}" for s, g in zip(satellites, signals, strict=True)),
        satellites,
        signals,
    )


def _find_slips(
    raw: RawGnss, now: NDArray[np.intp], before: NDArray[np.intp], epoch: NDArray[np.intp], still: bool
) -> NDArray[np.bool_]:
    """Mask of the changes from rows `before` to rows `now` that contain a cycle slip."""
    if not len(now):
        return np.zeros(0, dtype=bool)
    geometry = look(raw, raw.antenna, choose_coefficients(raw))
    wavelength = C / raw.frequency
    known = geometry.distance + geometry.troposphere - geometry.ionosphere - raw.clock
    off = wavelength * raw.carrier - known
    if len(raw.carrier_difference):
        off = off + raw.carrier_difference
    change = off[now] - off[before]
    # rows grouped by epoch; receiver clock and displacement are their common unknowns
    order = np.lexsort((raw.satellite[now], epoch[now]))
    epochs, of = np.unique(epoch[now[order]], return_inverse=True)
    place = np.arange(len(order)) - np.searchsorted(of, of)
    unknowns = 1 if still else 4
    shape = len(epochs), int(place.max()) + 1
    A, y, w = np.zeros((*shape, unknowns)), np.zeros(shape), np.zeros(shape)
    row = np.ones((len(order), unknowns))
    if not still:
        row[:, 1:] = -geometry.e[now[order]]
    usable = np.isfinite(change[order])
    A[of, place], y[of, place], w[of, place] = row, np.where(usable, change[order], 0.0), usable
    # the clock may change by 1e5 m, at which the weights would lose all digits
    middle = np.array([np.median(one[some]) if some.any() else 0.0 for one, some in zip(y, w > 0.0, strict=True)])
    y = y - middle[:, None]

    def fit(weight: Array) -> Array:
        """Residuals of the least squares of each epoch."""
        N = np.einsum("esi,es,esj->eij", A, weight, A, optimize=True) + 1e-9 * np.eye(unknowns)
        x = np.linalg.solve(N, np.einsum("esi,es->ei", A, weight * y)[..., None])[..., 0]
        return np.asarray(y - np.einsum("esi,ei->es", A, x))

    r = y
    for _ in range(_REWEIGHTINGS):
        r = fit(w / np.maximum(np.abs(r), _NOISE))
    limit = np.zeros(shape)
    limit[of, place] = 0.25 * wavelength[now[order]]
    far = (np.abs(r) > limit) & (w > 0.0)
    near = (w > 0.0) & ~far
    sigma = np.ones(shape)
    sigma[of, place] = _compute_change_sigma(raw, geometry.elevation, wavelength)[now[order]]
    rows, since = now[order], (raw.t[now] - raw.t[before])[order]
    walk = _IONOSPHERE_WALK * (raw.baseline / _APART if len(raw.carrier_difference) else 1.0)
    precise = raw.precise or len(raw.carrier_difference)  # nothing is left of the satellites' clocks
    drift = np.maximum(walk * compute_obliquity(geometry.elevation[rows]) * np.sqrt(since), _LEAST_DRIFT)
    group = np.unique(1000 * of + raw.satellite[rows], return_inverse=True)[1]
    far[of, place] &= ~_find_ionospheric(
        np.where(usable, r[of, place], 0.0), np.where(usable, sigma[of, place], np.inf), limit[of, place],
        (L1 / raw.frequency[rows]) ** 2, drift, group,
    )  # fmt: skip
    lasting = np.hypot((L1 / raw.frequency[rows]) ** 2 * drift, 0.0 if precise else _CLOCK_WALK * np.sqrt(since))
    sigma[of, place] = np.hypot(sigma[of, place], lasting)
    freedom = near.sum(axis=1) - unknowns
    # least squares over the rows that agree, whose residuals are no larger than those of the L1 solution
    weight = np.where(near, sigma**-2.0, 0.0)
    left = np.sum(weight * fit(weight) ** 2, axis=1)
    told = (freedom >= _SPARE) & (left <= 2.0 * gammaincinv(0.5 * np.maximum(freedom, 1), 1.0 - _ALARM))
    told &= near.sum(axis=1) > far.sum(axis=1)  # L1 estimation has a breakdown point of one half
    every = far.any(axis=1) & ~told
    out = np.zeros(len(now), dtype=bool)
    out[order] = (far | (every[:, None] & (w > 0.0)))[of, place]
    return out


def _find_ionospheric(
    change: Array, sigma: Array, limit: Array, delay: Array, drift: Array, group: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Mask of changes (N,), m, that a change of the ionospheric delay explains, with the others of their group.

    Parameters
    ----------
    sigma : (N,) m, 1-sigma without the ionosphere.
    limit : (N,) m, largest magnitude of what the ionosphere leaves.
    delay : (N,) of each frequency, over that on L1.
    drift : (N,) m, 1-sigma of the change of the delay on L1.
    group : (N,) the satellite and epoch; two frequencies at least distinguish the ionosphere from a slip.
    """
    weight = sigma**-2.0

    def add(x: Array) -> Array:
        return np.bincount(group, x)

    by_delay = add(weight * delay**2)
    ionosphere = add(weight * delay * change) / (add(drift**-2.0) / np.bincount(group) + by_delay)
    square = add(weight * change**2) - ionosphere * add(weight * delay * change)
    explained = by_delay * add(weight) - add(weight * delay) ** 2 > 1e-3 * by_delay * add(weight)
    explained &= square <= 2.0 * gammaincinv(0.5 * np.maximum(add(weight > 0.0), 1.0), 1.0 - _ALARM)
    explained &= add(np.abs(change - delay * ionosphere[group]) > limit) == 0.0
    return np.asarray(explained[group])


def _compute_change_sigma(raw: RawGnss, elevation: Array, wavelength: Array) -> Array:
    """(N,) m, 1-sigma of the change of a carrier phase, or of its difference from the base's, without a slip."""
    receivers = 2.0 if len(raw.carrier_difference) else 1.0
    return np.asarray(np.sqrt(receivers) * compute_carrier_difference_sigma(raw.cn0, elevation, wavelength))
