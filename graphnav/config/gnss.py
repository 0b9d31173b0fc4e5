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
        description="fault detection and exclusion of fixes and spans of fixes: off, on, automatic",
    )
    lever_arm_sigma: float | None = Field(
        None,
        gt=0,
        description="m, 1-sigma of the stated lever arm; given, it is estimated by this prior; otherwise it is used as "
        "stated unless the drive contradicts it",
    )
    slow_times: tuple[float, float] = Field(
        (100.0, 3600.0),
        description="s, correlation times of what changes over minutes and over hours in a position's error",
    )
    time_offset_sigma: float = Field(
        0.02, ge=0, description="s, 1-sigma of the offset of the fixes' stamps; 0 = exact, not estimated"
    )
    clock_rate_sigma: float | None = Field(
        None,
        ge=0,
        description="s/s, 1-sigma of the rate of the IMU's clock beside the receiver's, 1e-4 for crystals; given, it "
        "is estimated by this prior unless the drive contradicts it, with 0 never; otherwise only where the drive "
        "shows that they drift apart",
    )
