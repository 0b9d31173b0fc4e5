"""Time-differenced carrier phases: pairs of observations of one arc and one ephemeris."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.series import RawGnss
from graphnav.gnss.signals import C

_APART = 2.5  # periods between the two epochs at most
# m and m/s^3: largest departure of a satellite's displacement from the trapezoidal rule on its velocities, from
# rounding and from a third derivative of 1e-4 m/s^3 (over 12). A larger one is the step from one ephemeris to the next
_JUMP, _THIRD = 2e-3, 1e-5


def pair_consecutive(
    raw: RawGnss, whole: RawGnss, period: float | None = None
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows (N,) and (N,) of one arc at successive epochs.

    Parameters
    ----------
    raw : some of the rows of `whole`, with epochs left out or all.
    whole : all rows of the receiver: a slip at an epoch that is left out counts, too.
    period : s between epochs, where the series is too short to tell.
    """
    arcs, at = find_arcs(whole), find_rows(raw, whole)
    of, arc, slot = number_epochs(raw), arcs.arc[at], arcs.slot[at]
    typical = period or (float(np.median(np.diff(raw.epochs[0]))) if len(raw.epochs[0]) > 1 else 1.0)
    good = (
        (of >= 0)
        & np.isfinite(raw.carrier)
        & np.isfinite(raw.p[:, 0])
        & np.isfinite(raw.clock)
        & ~raw.half
        & (arc >= 0)
    )
    order = np.flatnonzero(good)
    order = order[np.lexsort((of[order], slot[order]))]
    j, k = order[:-1], order[1:]
    kept = (slot[j] == slot[k]) & (arc[j] == arc[k]) & (of[k] - of[j] == 1) & (raw.t[k] - raw.t[j] <= _APART * typical)
    j, k = j[kept], k[kept]
    dt = raw.t[k] - raw.t[j]
    sent = dt - (raw.code[k] - raw.code[j]) / C + (raw.receiver_clock[k, 0] - raw.receiver_clock[j, 0]) / C
    off = raw.p[k] - raw.p[j] - 0.5 * (raw.v[j] + raw.v[k]) * sent[:, None]
    clock = raw.clock[k] - raw.clock[j] - 0.5 * (raw.drift[j] + raw.drift[k]) * sent
    limit = _JUMP + _THIRD * dt**3
    same = (np.linalg.norm(off, axis=1) < limit) & (np.abs(clock) < limit)
    j, k = j[same], k[same]
    sort = np.lexsort((j, k))
    return j[sort], k[sort]


def number_epochs(raw: RawGnss) -> NDArray[np.intp]:
    """(N,) number of each row's epoch among those in use; -1 for epochs that are not differenced."""
    return raw.number if len(raw.number) else raw.epochs[1]


def find_rows(raw: RawGnss, whole: RawGnss) -> NDArray[np.intp]:
    """(N,) indices in a series of the rows of a part of it."""
    epochs = np.unique(whole.t)

    def make_keys(one: RawGnss) -> NDArray[np.int64]:
        epoch = np.searchsorted(epochs, one.t).astype(np.int64)
        return np.asarray((epoch << 32) + (one.satellite.astype(np.int64) << 16) + one.signal, dtype=np.int64)

    all_keys = make_keys(whole)
    order: NDArray[np.intp] = np.argsort(all_keys)
    return order[np.searchsorted(all_keys[order], make_keys(raw))]
