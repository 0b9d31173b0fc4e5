"""Frequency channels of GLONASS satellites, from the wavelength by which codes change with carrier phases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array
from graphnav.gnss.series import Observations
from graphnav.gnss.signals import GLONASS, C, find_frequencies

_CHANNELS = range(-7, 7)
_JUMP = 30.0  # m, of a code beside its carrier phase, beyond which an arc ends
_LONGEST_GAP = 60.0  # s within an arc
_CLEARLY = 2.0  # factor on the rms of what the best channel leaves, that the next one leaves at least


def find_channels(obs: Observations) -> dict[int, int]:
    """The channels of satellites that have none stated, as far as their observations tell them.

    Within an arc a code is the wavelength times the carrier phase plus a constant, but for the ionosphere and noise.
    From channel to channel the wavelength differs by 0.35 per mille: 2 m in the code while the range changes by 5 km.
    """
    out = {}
    unknown = np.unique(obs.satellite[(obs.satellite // 100 == GLONASS) & np.isnan(obs.frequency)])
    for one in unknown.tolist():
        own = np.flatnonzero((obs.satellite == one) & np.isfinite(obs.code) & np.isfinite(obs.carrier))
        cost = np.zeros(len(_CHANNELS))
        for signal in np.unique(obs.signal[own]).tolist():
            rows = own[obs.signal[own] == signal]
            pair = obs.satellite[rows[:1]], obs.signal[rows[:1]]
            hertz = np.array([find_frequencies(*pair, {one: channel})[0] for channel in _CHANNELS])
            if np.isfinite(hertz).all():
                cost += np.sum(_find_residuals(obs, rows, C / hertz) ** 2, axis=0)
        best, second = np.argsort(cost)[:2]
        if cost[second] > _CLEARLY**2 * cost[best]:
            out[one] = _CHANNELS[int(best)]
    return out


def _find_residuals(obs: Observations, rows: NDArray[np.intp], wavelengths: Array) -> Array:
    """(n, channels) m, codes less carrier phases by each wavelength, about their mean in each arc."""
    t, code, carrier = obs.t[rows], obs.code[rows], obs.carrier[rows]
    typical = float(np.mean(wavelengths))
    apart = np.abs(np.diff(code) - typical * np.diff(carrier))
    moved = np.abs(np.diff(code)) * (np.ptp(wavelengths) / typical)  # by another wavelength at most
    ends = (np.diff(t) > _LONGEST_GAP) | obs.slip[rows][1:] | (apart > _JUMP + moved)
    arc = np.concatenate([[0], np.cumsum(ends)])
    off = code[:, None] - carrier[:, None] * wavelengths
    count = np.bincount(arc)
    mean = np.stack([np.bincount(arc, x) for x in off.T], -1) / count[:, None]
    return np.asarray((off - mean[arc])[count[arc] > 1])
