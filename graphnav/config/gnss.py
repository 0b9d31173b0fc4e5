"""Settings of GNSS fixes."""

from __future__ import annotations

from pydantic import Field

from graphnav.config.outliers import Outliers, Switch


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
    sd_factor: float | None = Field(
        None, gt=0, description="factor on the stated position sigmas; found from the data if unset, never below 1"
    )
    up_factor: float | None = Field(None, gt=0, description="the same for heights; as sd_factor if unset")
    time_offset_sigma: float = Field(
        0.02, ge=0, description="s, 1-sigma of what the stamps of the fixes may be off; 0 = exact, not estimated"
    )
