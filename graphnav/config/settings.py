"""All settings, each with its unit and a description."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from graphnav.config.detectors import DetectorSettings
from graphnav.config.gnss import GnssSettings
from graphnav.config.motion import FootSettings, StandstillSettings, VehicleSettings
from graphnav.config.outliers import Outliers
from graphnav.config.raw_gnss import RawGnssSettings
from graphnav.config.section import Section
from graphnav.core.complaints import suggest_nearest
from graphnav.sensors import list_sensors

Profile = Literal["car", "car+odometer", "foot"]

# Defaults of each platform; any setting that is given overrides them.
PROFILES: dict[str, dict[str, dict[str, Any]]] = {
    "car": {"vehicle": {"nhc": True, "odometer": False}},
    "car+odometer": {"vehicle": {"nhc": True, "odometer": True}},
    "foot": {"vehicle": {"nhc": False, "odometer": False}, "foot": {"stance": True}},
}


class KeyframeSettings(Section):
    """Where states are placed."""

    rate: float = Field(1.0, gt=0, le=200, description="Hz, between the measurements; every fix has its own")
    bridge: float = Field(
        2.0, gt=0, description="s, the longest IMU gap that is bridged as an interval; a longer one cuts the graph"
    )


class AlignmentSettings(Section):
    """Initial attitude."""

    window: float = Field(30.0, gt=1, description="s of motion used for the initial attitude")
    prior_inflation: float = Field(
        5.0, ge=1, description="factor on the alignment's own sigma for the prior of the first state"
    )
    heading: float | None = Field(None, ge=-360, le=360, description="deg, a start heading that is known")
    heading_sigma: float = Field(10.0, gt=0, description="deg, 1-sigma of the known start heading")
    gyro_bias: tuple[float, float, float] | None = Field(
        None,
        description="rad/s, body axes (right, forward, up): what an earlier recording found, where no fixes tell it",
    )
    gyro_bias_sigma: float = Field(5e-4, gt=0, description="rad/s, 1-sigma of that bias")


class ImuSettings(Section):
    """Use of the IMU."""

    coning: bool = Field(
        True, description="of a foot: rows are plain means; false for a unit that compensates coning and sculling"
    )
    onboard_offset: bool = Field(
        True, description="of a foot: undo the unit's own gyro offset correction where the rests show one"
    )
    regular_stamps: bool = Field(
        True, description="use the times of a regular clock where the signals show that stamps scatter about one"
    )


class NoiseSettings(Section):
    """Noise model of the sensors."""

    mode: Literal["estimated", "stated"] = Field(
        "estimated", description="estimated from the recording by likelihood, or as the recording states it"
    )
    spacing: float = Field(
        1.0,
        ge=0,
        le=60,
        description="s between the fixes that are used where noise is estimated: a receiver that reports faster"
        " repeats its errors; 0 uses all",
    )


class SolverSettings(Section):
    """Iterations of the batch solver, and lags of the incremental solvers."""

    lag: float = Field(
        120.0, ge=1, description="s of later measurements that a state includes when the incremental solver settles it"
    )
    isam2_lag: float = Field(0.0, ge=0, description="s as `lag`, of the solver isam2; 0 smooths the whole drive")
    engine: Literal["window", "isam2"] = Field(
        "window", description="online smoother: graphnav's own fixed-lag window, or GTSAM's iSAM2 with the same lag"
    )
    max_iterations: int = Field(30, ge=1, description="Levenberg-Marquardt iterations")
    tolerance: float = Field(
        1e-3, gt=0, description="stop when the next step could lower the cost by less than this (cost is in sigma^2/2)"
    )


class SensorSettings(Outliers):
    """Use of a sensor beside IMU, GNSS and odometer."""

    use: bool = Field(True, description="use its rows")


class Settings(Section):
    """All settings; `Settings()` are the defaults, `Settings(profile="car")` those of one of `PROFILES`.

    Without a profile, everything that the recording's platform and sensors permit is used.
    """

    profile: Profile | None = Field(None, description="what the recording is of: car, car+odometer or foot")
    keyframes: KeyframeSettings = KeyframeSettings()
    alignment: AlignmentSettings = AlignmentSettings()
    imu: ImuSettings = ImuSettings()
    noise: NoiseSettings = NoiseSettings()
    gnss: GnssSettings = GnssSettings()
    raw_gnss: RawGnssSettings = RawGnssSettings()
    detectors: DetectorSettings = DetectorSettings()
    standstill: StandstillSettings = StandstillSettings()
    vehicle: VehicleSettings = VehicleSettings()
    foot: FootSettings = FootSettings()
    solver: SolverSettings = SolverSettings()
    sensors: dict[str, SensorSettings] = Field({}, description="of other sensors by their names: [sensors.barometer]")

    @field_validator("sensors")
    @classmethod
    def _check_sensors(cls, sensors: dict[str, SensorSettings]) -> dict[str, SensorSettings]:
        for name in sensors:
            if name not in list_sensors():
                raise ValueError(f"no sensor '{name}' is known; {suggest_nearest(name, tuple(list_sensors()))}")
        default = SensorSettings()  # not kept, so that settings with and without it are equal
        return {name: one for name, one in sensors.items() if one != default}

    def get_sensor(self, name: str) -> SensorSettings:
        """How a sensor is used.

        Parameters
        ----------
        name
            Of the sensor.

        Returns
        -------
        SensorSettings
            Defaults where nothing is set.
        """
        return self.sensors.get(name, SensorSettings())

    @model_validator(mode="before")
    @classmethod
    def _with_profile(cls, values: Any) -> Any:
        """Fill in the profile's values where none are given."""
        chosen = PROFILES.get(str(values.get("profile"))) if isinstance(values, Mapping) else None
        if chosen is None:
            return values
        merged = dict(values)
        for name, table in chosen.items():
            given = merged.get(name, {})
            merged[name] = {**table, **given} if isinstance(given, Mapping) else given
        return merged

    def without_wheels(self) -> Settings:
        """The settings without any assumption about wheels.

        Returns
        -------
        Settings
            Neither odometer nor NHC.
        """
        return self.model_copy(update={"vehicle": self.vehicle.model_copy(update={"nhc": False, "odometer": False})})
