"""What the codes of a base station at a known place are wrong by, for the rover's codes of the same satellites.

Orbits, clocks and the atmosphere do nearly the same to both; models are applied to both first, so that what differs
between the two, height above all, is taken care of. The base's clock is taken off by a median over its satellites of
each epoch; what is left of it is the same for all of them, codes and carriers, and goes into the rover's.

Carriers of the base are drawn through in the same way, but only within an arc: what a rover's carrier is then off by
is the difference of two ambiguities, and ends with the arc of either.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.series import RawGnss, compute_epoch_medians
from graphnav.gnss.signals import C
from graphnav.gnss.single_point import choose_coefficients, look

_LONGEST_BASE_GAP = 15.0  # s between a base's epochs that a line is drawn through its carriers
_LONGEST_CODE_GAP = 60.0  # s, through its codes: the clocks of satellites leave it by less than codes are good to
_SAME_EPOCH = 2e-3  # s: two receivers that keep their clocks within a millisecond of the nominal epoch
_LEAST_ELEVATION = np.radians(5.0)  # elevation of a base's satellites


def add_differences(rover: RawGnss, base: RawGnss, position: Array) -> tuple[RawGnss, tuple[str, ...]]:
    """The rover's series with what is to be added to its codes, and remarks.

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
    common = compute_epoch_medians(base.t, error)
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
        else:  # another code on the same carrier: apart by a constant, which is of all satellites of the system
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
    """The base's signal whose carriers stand against those of a rover's signal, the same for all of a system.

    The same one, else that of the same frequency that the base has most of: by how much of a cycle they are apart is
    then the same for all satellites, and in none of the differences between these.
    """
    own = base.signal[(base.satellite // 100 == system) & (base.signal // 100 == signal // 100) & (arc >= 0)]
    if not len(own) or np.any(own == signal):
        return signal
    found, many = np.unique(own, return_counts=True)
    return int(found[np.argmax(many)])


def _draw_within_arcs(t: Array, at: Array, value: Array, arc: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
    """Values (N,) on lines between times of one arc, and that arc; NaN and -1 between two arcs and far from any time.

    At a base's own epoch, but for the milliseconds that clocks are apart by, its value holds without a line.
    """
    right = np.clip(np.searchsorted(at, t), 1, len(at) - 1)
    nearest = np.where(np.abs(at[right - 1] - t) < np.abs(at[right] - t), right - 1, right)
    here = np.abs(at[nearest] - t) < _SAME_EPOCH
    between = (arc[right] == arc[right - 1]) & (at[right] - at[right - 1] <= _LONGEST_BASE_GAP)
    between &= (t >= at[right - 1]) & (t <= at[right])
    line = np.where(between, np.interp(t, at, value), value[nearest])
    good = between | here
    return np.where(good, line, np.nan), np.where(good, arc[np.where(between, right, nearest)], -1)


def _interpolate(t: Array, at: Array, value: Array) -> Array:
    """(N,) values on lines between times that are near enough, NaN elsewhere."""
    k = np.clip(np.searchsorted(at, t), 1, len(at) - 1)
    out = np.interp(t, at, value)
    near = (
        (at[k] - at[k - 1] <= _LONGEST_CODE_GAP) & (t >= at[0] - _LONGEST_CODE_GAP) & (t <= at[-1] + _LONGEST_CODE_GAP)
    )
    return np.asarray(np.where(near, out, np.nan))
