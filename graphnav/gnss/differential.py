"""Differential corrections for the rover's observations, from a base station at a known position.

Errors of orbits, satellite clocks and atmosphere are nearly common to both. The atmospheric models are applied to both
first, because of the difference in height. The base's receiver clock is removed as the median over the satellites of an
epoch; its residual is common to all codes and carrier phases and is absorbed by the rover's clock.

The base's carrier phases are interpolated like its codes, but only within an arc: a differenced carrier phase has the
difference of both ambiguities, and its arc ends with that of either receiver.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from graphnav.core.interpolation import pick_nearest
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.series import RawGnss, compute_medians
from graphnav.gnss.signals import C
from graphnav.gnss.single_point import choose_coefficients, look

_LONGEST_BASE_GAP = 15.0  # s between base epochs, largest over which its carrier phases are interpolated linearly
_LONGEST_CODE_GAP = 60.0  # s, the same of its codes: satellite clocks depart from a line by less than code noise
_SAME_EPOCH = 2e-3  # s: both receivers keep their clocks within a millisecond of the nominal epoch
_LEAST_ELEVATION = np.radians(5.0)  # elevation mask of the base


def add_differences(rover: RawGnss, base: RawGnss, position: Array) -> tuple[RawGnss, tuple[str, ...]]:
    """The rover's series with the corrections to its codes and carrier phases, and remarks.

    Parameters
    ----------
    base : placed like the rover's, its times GPS time to a millisecond.
    position : (3,) m in e, of the base's antenna.
    """
    base = base.take(np.isfinite(base.code) & np.isfinite(base.clock) & np.isfinite(base.p[:, 0]))
    base = replace(base, klobuchar=rover.klobuchar, antenna=np.tile(position, (len(base), 1)))
    geometry = look(base, base.antenna, choose_coefficients(base))
    arcs = find_arcs(base, still=True)
    high = geometry.elevation > _LEAST_ELEVATION
    known = geometry.distance + geometry.troposphere - base.clock
    error = known + geometry.ionosphere - base.code
    of_carrier = known - geometry.ionosphere - C / base.frequency * base.carrier
    base, error, of_carrier, arc = base.take(high), error[high], of_carrier[high], arcs.arc[high]
    common = compute_medians(base.t, error)
    error, of_carrier = error - common, of_carrier - common
    difference, carrier_difference = np.full(len(rover), np.nan), np.full(len(rover), np.nan)
    base_arc = np.full(len(rover), -1)
    alike = {(int(s), int(g)) for s, g in zip(base.satellite, base.signal, strict=True)}
    for satellite, signal in sorted({(int(s), int(g)) for s, g in zip(rover.satellite, rover.signal, strict=True)}):
        own = (rover.satellite == satellite) & (rover.signal == signal)
        there = base.satellite == satellite
        counted = there & (arc >= 0) & (base.signal == _find_partner(base, arc, satellite // 100, signal))
        if counted.sum() > 1:
            carrier_difference[own], base_arc[own] = _draw_within_arcs(
                rover.t[own], base.t[counted], of_carrier[counted], arc[counted]
            )
        if (satellite, signal) in alike:
            there &= base.signal == signal
        else:  # another code on the same carrier: its bias is common to all satellites of the system
            some = base.signal[there & (base.signal // 100 == signal // 100)]
            there &= base.signal == (some[0] if len(some) else -1)
        if there.sum() < 2:
            continue
        difference[own] = _interpolate(rover.t[own], base.t[there], error[there])
    missing = np.isnan(difference) & np.isfinite(rover.code) & np.isfinite(rover.p[:, 0])
    notes: tuple[str, ...] = ()
    if missing.any():
        sentence = f"codes without a counterpart at the base, not used: {int(missing.sum())} of {len(rover)}"
        notes = (Note("raw.without_base", sentence),)
    away = float(np.linalg.norm(np.median(rover.antenna, axis=0) - position))
    return replace(
        rover, difference=difference, carrier_difference=carrier_difference, base_arc=base_arc, baseline=away
    ), notes


def _find_partner(base: RawGnss, arc: NDArray[np.intp], system: int, signal: int) -> int:
    """Choose the base's signal to difference a rover's signal with, one for all satellites of a system.

    The same signal, else the most frequent one of the base on the same frequency: the fractional phase bias between the
    two is then common to all satellites and cancels in differences between satellites.
    """
    own = base.signal[(base.satellite // 100 == system) & (base.signal // 100 == signal // 100) & (arc >= 0)]
    if not len(own) or np.any(own == signal):
        return signal
    found, many = np.unique(own, return_counts=True)
    return int(found[np.argmax(many)])


def _draw_within_arcs(t: Array, at: Array, value: Array, arc: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
    """Linear interpolation of values (N,) within arcs, and the arc; NaN and -1 between arcs and far from any epoch.

    At an epoch of the base, to within the milliseconds between the clocks, its value is taken as it is.
    """
    right = np.clip(np.searchsorted(at, t), 1, len(at) - 1)
    nearest = pick_nearest(at, t)
    here = np.abs(at[nearest] - t) < _SAME_EPOCH
    between = (arc[right] == arc[right - 1]) & (at[right] - at[right - 1] <= _LONGEST_BASE_GAP)
    between &= (t >= at[right - 1]) & (t <= at[right])
    line = np.where(between, np.interp(t, at, value), value[nearest])
    good = between | here
    return np.where(good, line, np.nan), np.where(good, arc[np.where(between, right, nearest)], -1)


def _interpolate(t: Array, at: Array, value: Array) -> Array:
    """(N,) values, interpolated linearly across short steps, NaN elsewhere."""
    k = np.clip(np.searchsorted(at, t), 1, len(at) - 1)
    out = np.interp(t, at, value)
    near = (
        (at[k] - at[k - 1] <= _LONGEST_CODE_GAP) & (t >= at[0] - _LONGEST_CODE_GAP) & (t <= at[-1] + _LONGEST_CODE_GAP)
    )
    return np.asarray(np.where(near, out, np.nan))
