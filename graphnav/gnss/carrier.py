"""Carriers from epoch to epoch: which pairs of observations are of one count, and slips that the others tell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array
from graphnav.gnss.series import RawGnss
from graphnav.gnss.signals import C

_APART = 2.5  # periods, at most: beyond it is a gap
# m and m/s^3, of a satellite's way between epochs against the mean of its velocities: rounding, and a third derivative
# of 1e-4 m/s^3 over 12; more is another ephemeris, whose orbit and clock are apart from those before
_JUMP, _THIRD = 2e-3, 1e-5
_REDUNDANT = 2  # rows beyond a displacement and a clock that it takes to tell which one of them is off
_LEAST = 1e-3  # of a residual's cofactor: less, and no other row checks it


def consecutive(raw: RawGnss, whole: RawGnss) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows (N,) and (N,) of a satellite and signal at one epoch and the next, of one count and one ephemeris.

    Parameters
    ----------
    raw : some of the rows of `whole`, with epochs left out or all.
    whole : with the flags of all epochs: a slip at one that was left out counts.
    """
    slips = _slips_so_far(raw, whole)
    _, of = raw.epochs
    order = np.lexsort((raw.t, raw.signal, raw.satellite))
    j, k = order[:-1], order[1:]
    t, good = raw.t, np.isfinite(raw.carrier) & np.isfinite(raw.p[:, 0]) & np.isfinite(raw.clock) & ~raw.half
    epochs = np.unique(t)
    usual = float(np.median(np.diff(epochs))) if len(epochs) > 1 else 1.0
    dt = t[k] - t[j]
    kept = (raw.satellite[j] == raw.satellite[k]) & (raw.signal[j] == raw.signal[k]) & (of[k] - of[j] == 1)
    kept &= good[j] & good[k] & (slips[j] == slips[k]) & (dt <= _APART * usual)
    j, k, dt = j[kept], k[kept], dt[kept]
    sent = dt - (raw.code[k] - raw.code[j]) / C + (raw.receiver_clock[k, 0] - raw.receiver_clock[j, 0]) / C
    off = raw.p[k] - raw.p[j] - 0.5 * (raw.v[j] + raw.v[k]) * sent[:, None]
    clock = raw.clock[k] - raw.clock[j] - 0.5 * (raw.drift[j] + raw.drift[k]) * sent
    limit = _JUMP + _THIRD * dt**3
    same = (np.linalg.norm(off, axis=1) < limit) & (np.abs(clock) < limit)
    order = np.lexsort((j[same], k[same]))
    return j[same][order], k[same][order]


def _slips_so_far(raw: RawGnss, whole: RawGnss) -> NDArray[np.intp]:
    """(N,) slips that each row's carrier has had since the beginning."""
    order = np.lexsort((whole.t, whole.signal, whole.satellite))
    count = np.empty(len(whole), dtype=np.intp)
    count[order] = np.cumsum(whole.slip[order])
    at = _keys(whole, whole.t)
    sort = np.argsort(at)
    return np.asarray(count[sort[np.searchsorted(at[sort], _keys(raw, whole.t))]])


def _keys(raw: RawGnss, t: Array) -> NDArray[np.int64]:
    """(N,) one number for each time, satellite and signal."""
    epoch = np.searchsorted(np.unique(t), raw.t).astype(np.int64)
    return (epoch << 32) + (raw.satellite.astype(np.int64) << 16) + raw.signal


def half_cycle_errors(epoch: NDArray[np.intp], e: Array, change: Array, wavelength: Array) -> NDArray[np.bool_]:
    """(N,) carriers that the others of their epoch put nearer to a slip of half a cycle than to none.

    The change of each is a displacement along its direction and a clock's; the row farthest off by its own
    uncertainty is taken out until none is off by a quarter of a wavelength (RAIM, with rows enough to say which).

    Parameters
    ----------
    epoch : (N,) number of the epoch of each row.
    e : (N, 3) unit vectors to the satellites.
    change : (N,) m, of ranges at a fixed place.
    """
    rows, of = np.unique(epoch, return_inverse=True)
    order = np.argsort(of, kind="stable")
    place = np.empty(len(of), dtype=np.intp)
    place[order] = np.arange(len(of)) - np.searchsorted(of[order], of[order])
    shape = len(rows), int(place.max(initial=0)) + 1
    H, y, used, limit = np.zeros((*shape, 4)), np.zeros(shape), np.zeros(shape, dtype=bool), np.full(shape, np.inf)
    H[of, place], y[of, place], used[of, place] = np.column_stack([-e, np.ones(len(of))]), -change, True
    limit[of, place] = 0.25 * wavelength
    y -= np.nanmedian(np.where(used, y, np.nan), axis=1, keepdims=True)  # the clock's, roughly, to keep digits
    active = np.arange(shape[0])
    for _ in range(shape[1]):
        active = active[used[active].sum(axis=1) >= 4 + _REDUNDANT]
        if not len(active):
            break
        Hw = H[active] * used[active][..., None]
        N = np.swapaxes(Hw, -1, -2) @ Hw
        Q = np.linalg.inv(N + 1e-9 * np.eye(4))
        x = np.einsum("eij,esj,es->ei", Q, Hw, y[active], optimize=True)
        r = y[active] - np.einsum("esi,ei->es", H[active], x)
        own = 1.0 - np.einsum("esi,eij,esj->es", H[active], Q, H[active], optimize=True)
        # what the row itself would be off by to leave this residual, and the largest by its own uncertainty
        told = used[active] & (own > _LEAST)
        off = np.abs(r) / np.maximum(own, _LEAST)
        score = np.where(told, np.abs(r) / np.sqrt(np.maximum(own, _LEAST)), -1.0)
        worst = score.argmax(axis=1)
        at = np.arange(len(active))
        bad = told[at, worst] & (off[at, worst] > limit[active, worst])
        active, worst = active[bad], worst[bad]
        used[active, worst] = False
    return ~used[of, place]
