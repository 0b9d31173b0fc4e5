"""What the codes of a base station at a known place are wrong by, for the rover's codes of the same satellites.

Orbits, clocks and the atmosphere do nearly the same to both; models are applied to both first, so that what differs
between the two, height above all, is taken care of. The base's clock is taken off by a median over its satellites of
each epoch; what is left of it is the same for all of them and goes into the rover's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.core.rotation import Array
from graphnav.gnss.series import RawGnss, median_of_epochs
from graphnav.gnss.single_point import coefficients, look

_OLDEST = 15.0  # s between a base's epochs that a line is drawn through
_LEAST = np.radians(5.0)  # elevation of a base's satellites


def with_differences(rover: RawGnss, base: RawGnss, position: Array) -> tuple[RawGnss, tuple[str, ...]]:
    """The rover's series with what is to be added to its codes, and remarks.

    Parameters
    ----------
    base : placed like the rover's, its times GPS time to a millisecond.
    position : (3,) m in e, of the base's antenna.
    """
    base = base.take(np.isfinite(base.code) & np.isfinite(base.clock) & np.isfinite(base.p[:, 0]))
    geometry = look(base, np.tile(position, (len(base), 1)), coefficients(replace(base, klobuchar=rover.klobuchar)))
    high = geometry.elevation > _LEAST
    error = geometry.distance + geometry.ionosphere + geometry.troposphere - base.code - base.clock
    base, error = base.take(high), error[high]
    error = error - median_of_epochs(base.t, error)
    difference = np.full(len(rover), np.nan)
    alike = {(int(s), int(g)) for s, g in zip(base.satellite, base.signal, strict=True)}
    for satellite, signal in sorted({(int(s), int(g)) for s, g in zip(rover.satellite, rover.signal, strict=True)}):
        own = (rover.satellite == satellite) & (rover.signal == signal)
        there = base.satellite == satellite
        if (satellite, signal) in alike:
            there &= base.signal == signal
        else:  # another code on the same carrier: apart by a constant, which is of all satellites of the system
            some = base.signal[there & (base.signal // 100 == signal // 100)]
            there &= base.signal == (some[0] if len(some) else -1)
        if there.sum() < 2:
            continue
        difference[own] = _interpolate(rover.t[own], base.t[there], error[there])
    missing = np.isnan(difference) & np.isfinite(rover.code) & np.isfinite(rover.p[:, 0])
    said: tuple[str, ...] = ()
    if missing.any():
        said = (f"{int(missing.sum())} of {len(rover)} codes have no counterpart at the base and are not used",)
    return replace(rover, difference=difference), said


def _interpolate(t: Array, at: Array, value: Array) -> Array:
    """(N,) values on lines between times that are near enough, NaN elsewhere."""
    k = np.clip(np.searchsorted(at, t), 1, len(at) - 1)
    out = np.interp(t, at, value)
    near = (at[k] - at[k - 1] <= _OLDEST) & (t >= at[0] - _OLDEST) & (t <= at[-1] + _OLDEST)
    return np.asarray(np.where(near, out, np.nan))
