"""Settings of motion constraints that need no receiver: stops, wheels, a foot."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from graphnav.config.outliers import Outliers
from graphnav.config.section import Section


class StandstillSettings(Section):
    """Constraints where the platform is stationary."""

    zero_velocity: bool = Field(True, description="no velocity")
    zero_rate: bool = Field(True, description="no turn rate (of a foot: not in its stances, but where it stands)")
    held_position: bool = Field(True, description="one place for a whole stop")


class VehicleSettings(Outliers):
    """Constraints from a vehicle's wheels."""

    nhc: bool = Field(True, description="no speed sideways and up where the wheels do not slip")
    odometer: bool = Field(True, description="use the odometer where there is one")
    nhc_density: tuple[float, float] = Field(
        (0.03, 0.03), description="m/s/sqrt(Hz), noise of sideways and upward speed"
    )
    odometer_density: float = Field(
        0.01, ge=0, description="m/s/sqrt(Hz), noise of the speed on top of what its readings show: slip of tyres"
    )
    mounting: tuple[float, float] = Field(
        (0.0, 0.0), description="deg, expected pitch and heading of the IMU against the vehicle"
    )
    mounting_sigma: float = Field(6.0, ge=0, description="deg, 1-sigma of those; 0 = exact, not estimated")
    mounting_walk: float = Field(0.05, ge=0, description="deg, 1-sigma change in a minute: load, wind, road crown")
    axle_sigma: float = Field(
        0.3, ge=0, description="m, 1-sigma of the forward position of the point that does not slip"
    )
    unstated_axle_sigma: float = Field(1.5, ge=0, description="m, the same where no odometer lever arm is given")
    body_sigma: float = Field(
        0.006, ge=0, description="rad per m/s^2, 1-sigma of side slip and squat; 0 = none, not estimated"
    )
    scale_walk: float = Field(
        1e-4, ge=0, description="1, 1-sigma change of the odometer's scale in a minute: tyres, load"
    )


class FootSettings(Outliers):
    """Constraints of a foot on the floor and in swing."""

    default_kernel: ClassVar[str] = "cauchy"

    rate: float = Field(20.0, gt=0, le=200, description="Hz, keyframes within a stance and within a swing")
    stance: bool = Field(True, description="where the shoe touches the floor it does not move")
    still: float = Field(0.005, gt=0, description="m/s, 1-sigma of a stance in which nothing turns")
    rolling: float = Field(0.01, ge=0, description="m, 1-sigma of where the pivot is; times the turn rate")
    correlation: float = Field(0.4, ge=0, description="s, over which the errors of a stance are one: about its length")
    pivot_sigma: float = Field(0.1, gt=0, description="m, 1-sigma of the pivot's place about the IMU, estimated")
    travel_sigma: float = Field(0.1, gt=0, description="m, 1-sigma of how far it travels either way, estimated")
    pattern: float = Field(
        0.02, ge=0, description="m/s, 1-sigma of a velocity pattern that repeats in every stance, estimated; 0: without"
    )
    half_stance: float = Field(0.2, gt=0, description="s after landing and before leaving in which the pivot travels")
    lateral: bool = Field(False, description="no sideways speed in swing")
    sideways: float = Field(0.1, gt=0, description="m/s, 1-sigma of the mean sideways speed of a swing")
    turn: float = Field(10.0, gt=0, description="deg by which a foot turns in a swing that double that")
    axis_sigma: float = Field(20.0, gt=0, description="deg, 1-sigma of the foot's sideways axis in the body's")
    closed_loop: float | None = Field(
        None, gt=0, description="m, 1-sigma; given, the end is the start (only without GNSS)"
    )
