"""Arcs of carriers: the stretches over which a receiver counts the cycles of a signal without losing one.

Within an arc a carrier is a range but for one unknown number of cycles, its ambiguity. A new arc begins where

* the receiver flags a loss of lock, or says otherwise that half a cycle is open or is no more (RINEX 3.05, table A2),
* the signal is absent for an epoch, or all are, unless its counter of lock time covers the gap,
* the base station's arc of that signal ends,
* the change since the epoch before is off by more than a quarter of a cycle from what those of all satellites agree
  upon, a displacement and the clock: a slip is half a cycle at least, so beyond a quarter it is nearer than none,
* there is such a change, and too few others agree, less than half, or not to within their sigmas: any may have slipped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from graphnav.core.rotation import Array
from graphnav.gnss.series import RawGnss
from graphnav.gnss.sigmas import compute_carrier_difference_sigma
from graphnav.gnss.signals import C, Ids, name_satellite, name_signal
from graphnav.gnss.single_point import choose_coefficients, look

_REWEIGHTINGS = 20  # of reweighting towards the least sum of absolute residuals
_SPARE = 2  # rows beyond the unknowns that have to agree before others are held against them
_ALARM = 0.001  # of epochs in which those without a slip do not agree within their sigmas
_NOISE = 0.01  # m, of a difference of carriers: below it residuals weigh the same


@dataclass(frozen=True)
class Arcs:
    """Which arc each of N rows is of; a slot is a signal of a satellite."""

    slot: NDArray[np.intp]  # (N,)
    arc: NDArray[np.intp]  # (N,) counted from 0 within its slot; -1 where there is no carrier
    names: tuple[str, ...]  # (S,) of the slots: "G05.1C"
    satellite: Ids  # (S,)
    signal: Ids  # (S,)
    begins: tuple[Array, ...]  # (S,) of (n,) s: first times of the arcs
    slips: int  # that no flag tells

    @property
    def begin(self) -> Array:
        """(N,) s, of each row's arc; NaN where there is no carrier."""
        out = np.full(len(self.arc), np.nan)
        for slot, begins in enumerate(self.begins):
            own = (self.slot == slot) & (self.arc >= 0)
            out[own] = begins[self.arc[own]]
        return out


def find_arcs(
    raw: RawGnss, still: bool = False, base_arc: NDArray[np.intp] | None = None, period: float | None = None
) -> Arcs:
    """The arcs of a receiver's carriers.

    Parameters
    ----------
    raw : all epochs and signals that the receiver has, with nominal antennas; rows that are left out later keep theirs.
    still : the antenna stands at its nominal place, as that of a base station does.
    base_arc : (N,) a number that changes for a slot where the base station's arc does.
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
    """The arcs of rows (N,) of which is known when their arc begins (s; NaN where there is no carrier)."""
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
    """Which of the changes from rows `before` to rows `now` hold a slip."""
    if not len(now):
        return np.zeros(0, dtype=bool)
    geometry = look(raw, raw.antenna, choose_coefficients(raw))
    wavelength = C / raw.frequency
    known = geometry.distance + geometry.troposphere - geometry.ionosphere - raw.clock
    off = wavelength * raw.carrier - known
    if len(raw.carrier_difference):
        off = off + raw.carrier_difference
    change = off[now] - off[before]
    # rows of an epoch side by side; a receiver's clock and the displacement are what they have in common
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
    # the clock's change may be 1e5 m, which would leave the weights without digits
    middle = np.array([np.median(one[some]) if some.any() else 0.0 for one, some in zip(y, w > 0.0, strict=True)])
    y = y - middle[:, None]
    r = y
    for _ in range(_REWEIGHTINGS):
        weight = w / np.maximum(np.abs(r), _NOISE)
        N = np.einsum("esi,es,esj->eij", A, weight, A, optimize=True) + 1e-9 * np.eye(unknowns)
        x = np.linalg.solve(N, np.einsum("esi,es->ei", A, weight * y)[..., None])[..., 0]
        r = y - np.einsum("esi,ei->es", A, x)
    limit = np.zeros(shape)
    limit[of, place] = 0.25 * wavelength[now[order]]
    far = (np.abs(r) > limit) & (w > 0.0)
    near = (w > 0.0) & ~far
    sigma = np.ones(shape)
    sigma[of, place] = _compute_change_sigma(raw, geometry.elevation, wavelength)[now[order]]
    freedom = near.sum(axis=1) - unknowns
    # of the rows that agree with each other by least squares, which are no further off than by the sum of absolutes
    weight = np.where(near, sigma**-2.0, 0.0)
    N = np.einsum("esi,es,esj->eij", A, weight, A, optimize=True) + 1e-9 * np.eye(unknowns)
    x = np.linalg.solve(N, np.einsum("esi,es->ei", A, weight * y)[..., None])[..., 0]
    left = np.sum(weight * (y - np.einsum("esi,ei->es", A, x)) ** 2, axis=1)
    told = (freedom >= _SPARE) & (left <= 2.0 * gammaincinv(0.5 * np.maximum(freedom, 1), 1.0 - _ALARM))
    told &= near.sum(axis=1) > far.sum(axis=1)  # half wrong is what a sum of absolute residuals stands at most
    every = far.any(axis=1) & ~told
    out = np.zeros(len(now), dtype=bool)
    out[order] = (far | (every[:, None] & (w > 0.0)))[of, place]
    return out


def _compute_change_sigma(raw: RawGnss, elevation: Array, wavelength: Array) -> Array:
    """(N,) m, 1-sigma of what a carrier, or its difference from the base's, changes by without a slip."""
    receivers = 2.0 if len(raw.carrier_difference) else 1.0
    return np.asarray(np.sqrt(receivers) * compute_carrier_difference_sigma(raw.cn0, elevation, wavelength))
