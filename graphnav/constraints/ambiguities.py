"""Carrier-phase ambiguities as parameters: one per satellite signal, reset at the start of every arc."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from graphnav.constraints.raw_gnss import RangeConstraint
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter
from graphnav.gnss.arcs import Arcs

_PREFIX = "ambiguity."
_SIGMA = 30.0  # m, prior 1-sigma about the value from the codes: uninformative


@dataclass(frozen=True)
class CarrierRows(RangeConstraint):
    """Rows of carrier phases with an ambiguity for each arc."""

    slots: tuple[str, ...] = ()  # names of the ambiguities
    slot: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) index of `slots`
    begin: Array = field(default_factory=lambda: np.empty(0))  # (N,) s, start of the arc
    wavelength: Array = field(default_factory=lambda: np.empty(0))  # (N,) m, unit of the ambiguities
    # (N,) m, half of the least cycle slip: a residual beyond it is nearer to a slip than to none
    half_slip: Array = field(default_factory=lambda: np.empty(0))
    # (slots,) system and signal, within which differences are integers; -1: none are
    family: Array = field(default_factory=lambda: np.empty(0, dtype=int))
    whole: Array = field(default_factory=lambda: np.empty(0, dtype=bool))  # (N,) no unresolved half cycle in the arc
    reflection: Array = field(default_factory=lambda: np.empty(0))  # (N,) cycles, 1-sigma of an arc's mean multipath
    period: float = 1.0  # s between epochs


def make_ambiguities(arcs: Arcs, guess: Array, wavelength: Array, unit: str = "cycles") -> dict[int, Parameter]:
    """Make a parameter for each slot that has arcs.

    Parameters
    ----------
    guess : (N,) ambiguities by the codes; an arc takes that of its first row.
    wavelength : (N,) m, of the unit.
    """
    out = {}
    for slot, begins in enumerate(arcs.begins):
        if len(begins):
            own = np.flatnonzero((arcs.slot == slot) & (arcs.arc >= 0))
            first = own[np.unique(arcs.arc[own], return_index=True)[1], None]
            sigma = _SIGMA / wavelength[first]
            out[slot] = Parameter(name_ambiguity(arcs.names[slot]), guess[first], sigma, unit, begins=begins)
    return out


def name_ambiguity(slot: str) -> str:
    """The name of the parameter of a slot, "G05.1C"."""
    return f"{_PREFIX}{slot}"


def list_slots(parameters: Sequence[str]) -> tuple[str, ...]:
    """Slots of parameter names: the inverse of `name_ambiguity`."""
    return tuple(name.removeprefix(_PREFIX) for name in parameters)
