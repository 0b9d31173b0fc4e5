"""Wheel pulses as a running count: per row or cumulative, with 8-, 16- or 32-bit counters unwrapped."""

from __future__ import annotations

from typing import Literal

import numpy as np

from graphnav.core.notes import Notes
from graphnav.core.rotation import Array

_MODULI = (2.0**8, 2.0**16, 2.0**32)


def count_pulses(
    pulses: Array, kind: Literal["cumulative", "per_row"] | None, signed: bool | None, remarks: Notes
) -> Array:
    """(M,) pulses since the first row.

    A counter of unstated kind is taken as cumulative if it hardly ever decreases: counts per row rise and fall with the
    speed.
    """
    step = np.diff(pulses)
    if kind is None:
        changes = step[step != 0.0]
        kind = "cumulative" if len(changes) and (changes > 0.0).mean() > 0.9 else "per_row"
        remarks.add(
            "odometer.pulses_read_as",
            f"the odometer's pulses are taken as {'a running count' if kind == 'cumulative' else 'counts per row'}; "
            f'if they are not, set pulses = "{"per_row" if kind == "cumulative" else "cumulative"}"',
        )
    if kind == "per_row":  # those of row k were counted between rows k-1 and k
        return np.cumsum(pulses) - pulses[0]
    return np.r_[0.0, np.cumsum(_count_steps(pulses, step, signed, remarks))]


def _count_steps(pulses: Array, step: Array, signed: bool | None, remarks: Notes) -> Array:
    """Steps between rows without the jumps of a counter that overflowed or restarted."""
    back = step < 0.0
    if not back.any() or pulses.min() < 0.0:
        return step
    modulus = next((m for m in _MODULI if pulses.max() < m), None)
    if modulus is None:
        return step
    if signed is None:  # a counter that counts backward does so by single pulses too
        signed = bool((step[back] > -0.5 * modulus).any())
    # a step of less than half the range either way; of less than the whole range forward if there is no backward
    whole = np.mod(step + 0.5 * modulus, modulus) - 0.5 * modulus if signed else np.mod(step, modulus)
    ran_over = whole != step
    # a restart at zero is no overflow: no value near the end of the range, and an unusual step
    typical = np.abs(step[~ran_over]).max(initial=0.0)
    anew = ran_over & (np.abs(whole) > 4.0 * typical + 4.0)
    whole[anew] = 0.0
    for mask, what in ((ran_over & ~anew, f"ran over ({modulus:.0f})"), (anew, "began anew")):
        if mask.any():
            times = "once" if mask.sum() == 1 else f"{mask.sum()} times"
            remarks.add("odometer.counter_mended", f"the odometer's counter {what} {times}: corrected")
    return whole
