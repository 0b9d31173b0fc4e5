"""Settings of GNSS fixes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BeforeValidator, Field

from graphnav.config.outliers import Outliers, Switch

TYPES = ("unknown", "fixed", "float", "sbas", "differential", "single", "ppp")  # names in graphnav.recording.FIX_TYPES
T = TypeVar("T")


def _factor(value: Any) -> Any:
    of_types = isinstance(value, Mapping)
    for name, x in value.items() if of_types else [("", value)]:
        if of_types and name not in TYPES:
            raise ValueError(f"'{name}' is no type of fix; known: {', '.join(TYPES)}")
        if isinstance(x, bool) or not isinstance(x, int | float) or not 0.0 < x < float("inf"):
            raise ValueError("must be a number above 0, or one for each type of fix as in { float = 3.0 }")
    return {name: float(x) for name, x in value.items()} if of_types else float(value)


def of_type(value: T | Mapping[str, T] | None, name: str, default: T) -> T:
    """What a setting says of the fixes of one type."""
    if isinstance(value, Mapping):
        return value.get(name, default)
    return default if value is None else value


Factor = Annotated[float | dict[str, float] | None, BeforeValidator(lambda x: x if x is None else _factor(x))]


class GnssSettings(Outliers):
    """How fixes are used."""

    position: bool = Field(True, description="use the positions")
    velocity: bool = Field(True, description="use the velocities where there are any")
    faults: Switch = Field(
        "automatic",
        description="find fixes, and spans of fixes, that are wrong, and leave them out: off, on, automatic",
    )
    adaptive: Switch = Field(
        "automatic", description="raise the sigmas of fixes where they are noisier than stated: off, on, automatic"
    )
    lever_arm_sigma: float | None = Field(
        None, gt=0, description="m, 1-sigma of the stated lever arm; given, the lever arm is estimated"
    )
    slow_share: float | None = Field(
        None, ge=0, lt=1, description="share of a position's variance that changes slowly; found from the data if unset"
    )
    slow_times: tuple[float, float] = Field(
        (100.0, 3600.0), description="s, correlation times of the two halves of that slow part"
    )
    fast_time: float | None = Field(
        None,
        ge=0,
        description="s, for which the rest of its error stays alike (multipath); found from the data if unset",
    )
    sd_factor: Factor = Field(
        None,
        description="factor on the stated position sigmas, or one by type of fix; found from the data if unset, "
        "never below 1",
    )
    up_factor: float | None = Field(None, gt=0, description="the same for heights; as sd_factor if unset")
    time_offset_sigma: float = Field(
        0.02, ge=0, description="s, 1-sigma of what the stamps of the fixes may be off; 0 = exact, not estimated"
    )
