"""Settings: validated, each with its unit and a sentence. Flag over file over profile over default."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from graphnav.complaints import complaint, read_toml
from graphnav.errors import ConfigError

SWITCH = ("off", "on", "automatic")
KERNELS = ("huber", "cauchy", "geman-mcclure", "tukey", "welsch", "gnc")
_BY_NAME = {"none": "off", None: "off", False: "off", True: "automatic"}  # as earlier versions wrote them
Profile = Literal["car", "car+odometer", "foot"]

# What is made of the platform, below whatever the settings say themselves.
PROFILES: dict[str, dict[str, dict[str, Any]]] = {
    "car": {"vehicle": {"nhc": True, "odometer": False}},
    "car+odometer": {"vehicle": {"nhc": True, "odometer": True}},
    "foot": {"vehicle": {"nhc": False, "odometer": False}, "foot": {"stance": True}},
}


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _switch(value: Any) -> Any:
    value = _BY_NAME.get(value, value) if isinstance(value, str | bool) else value
    if value not in SWITCH:
        raise ValueError(f'\'{value}\' must be "off", "on" or "automatic"')
    return value


def _kernel(value: Any) -> Any:
    value = _BY_NAME.get(value, value) if isinstance(value, str | bool) else value
    if value not in (*SWITCH, *KERNELS):
        raise ValueError(f"'{value}' must be one of {', '.join((*SWITCH, *KERNELS))}")
    return value


def _gate(value: Any) -> Any:
    if value is None or isinstance(value, str | bool):
        value = _BY_NAME.get(value, value)
    number = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < float("inf")
    if not number and value not in SWITCH:
        raise ValueError(f'\'{value}\' must be "off", "on", "automatic" or a number above 0')
    return float(value) if number else value


Switch = Annotated[Literal["off", "on", "automatic"], BeforeValidator(_switch)]
Kernel = Annotated[str, BeforeValidator(_kernel)]
Gate = Annotated[float | str, BeforeValidator(_gate)]


class _Outliers(_Section):
    """What every solver does with rows that are far off."""

    usual_kernel: ClassVar[str] = "none"  # "automatic"
    usual_gate: ClassVar[float | None] = None

    robust: Kernel = Field(
        "automatic", description=f"robust kernel in every solver: off, on (cauchy), automatic, {', '.join(KERNELS)}"
    )
    robust_scale: float = Field(3.0, gt=0, description="whitened norm of a whole measurement at which the kernel bends")
    gate: Gate = Field(
        "automatic",
        description="whitened norm of an innovation above which no solver uses it: off, on (6), automatic, a number",
    )

    @property
    def kernel(self) -> str:
        """The kernel to use, "none" for none."""
        return {"off": "none", "on": "cauchy", "automatic": self.usual_kernel}.get(self.robust, self.robust)

    @property
    def limit(self) -> float | None:
        """The gate to use."""
        if isinstance(self.gate, str):
            return {"off": None, "on": 6.0, "automatic": self.usual_gate}[self.gate]
        return self.gate

    @property
    def outliers(self) -> dict[str, Any]:
        """What a constraint is told of it."""
        return {"robust": self.kernel, "robust_scale": self.robust_scale, "gate": self.limit}


class KeyframeSettings(_Section):
    """Where states are placed."""

    rate: float = Field(1.0, gt=0, le=200, description="Hz, between the measurements; every fix has its own")
    bridge: float = Field(
        2.0, gt=0, description="s, the longest IMU gap that is bridged as an interval; a longer one cuts the graph"
    )


class AlignmentSettings(_Section):
    """The first attitude."""

    window: float = Field(30.0, gt=1, description="s of motion used to find the first attitude")
    prior_inflation: float = Field(
        5.0, ge=1, description="how many times wider than its own sigma the alignment enters as a prior"
    )
    heading: float | None = Field(None, ge=-360, le=360, description="deg, a start heading that is known")
    heading_sigma: float = Field(10.0, gt=0, description="deg, 1-sigma of the known start heading")
    gyro_bias: tuple[float, float, float] | None = Field(
        None,
        description="rad/s, body axes (right, forward, up): what an earlier recording found, where no fixes tell it",
    )
    gyro_bias_sigma: float = Field(5e-4, gt=0, description="rad/s, 1-sigma of that bias")


class ImuSettings(_Section):
    """How the IMU's figures are used."""

    as_stated: bool = Field(
        False, description="take the noise figures as stated, even where the drive shows them to be too small"
    )
    coning: bool = Field(
        True, description="of a foot: rows are plain means; false for a unit that makes up for coning and sculling"
    )


class GnssSettings(_Outliers):
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


class StandstillSettings(_Section):
    """What is used where the platform stands still."""

    zero_velocity: bool = Field(True, description="no velocity")
    zero_rate: bool = Field(True, description="no turn rate (of a foot: not in its stances, but where it stands)")
    held_position: bool = Field(True, description="one place for a whole stop")


class VehicleSettings(_Outliers):
    """What is used of a vehicle's wheels."""

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
    mounting_walk: float = Field(0.05, ge=0, description="deg in a minute, how they wander: load, wind, road crown")
    axle_sigma: float = Field(
        0.3, ge=0, description="m, 1-sigma of where along the vehicle the point lies that does not slip"
    )
    unstated_axle_sigma: float = Field(1.5, ge=0, description="m, the same where no odometer lever arm is given")
    body_sigma: float = Field(
        0.006, ge=0, description="rad per m/s^2, 1-sigma of side slip and squat; 0 = none, not estimated"
    )
    scale_walk: float = Field(1e-4, ge=0, description="1 in a minute, how the odometer's scale wanders: tyres, load")


class FootSettings(_Outliers):
    """What is used of a foot's way over the floor and through the air."""

    usual_kernel: ClassVar[str] = "cauchy"
    usual_gate: ClassVar[float | None] = 6.0

    rate: float = Field(20.0, gt=0, le=200, description="Hz, keyframes within a stance and within a swing")
    stance: bool = Field(True, description="where the shoe touches the floor it does not move")
    still: float = Field(0.01, gt=0, description="m/s, 1-sigma of a stance in which nothing turns")
    rolling: float = Field(0.02, ge=0, description="m, 1-sigma of where the pivot is; times the turn rate")
    correlation: float = Field(0.4, ge=0, description="s, over which the errors of a stance are one: about its length")
    pivot_sigma: float = Field(0.1, gt=0, description="m, 1-sigma of the pivot's place about the IMU, estimated")
    travel_sigma: float = Field(0.1, gt=0, description="m, 1-sigma of how far it travels either way, estimated")
    half_stance: float = Field(0.2, gt=0, description="s after landing and before leaving in which the pivot travels")
    lateral: bool = Field(False, description="no sideways speed in swing")
    sideways: float = Field(0.1, gt=0, description="m/s, 1-sigma of the mean sideways speed of a swing")
    turn: float = Field(10.0, gt=0, description="deg by which a foot turns in a swing that double that")
    axis_sigma: float = Field(20.0, gt=0, description="deg, 1-sigma of the foot's sideways axis in the body's")
    closed_loop: float | None = Field(
        None, gt=0, description="m, 1-sigma; given, the end is the start (only without GNSS)"
    )


class StanceSettings(_Section):
    """Where a foot is on the floor."""

    window: float = Field(0.05, gt=0, le=1, description="s, length of a window")
    threshold: float = Field(1.5, gt=0, description="rad/s, of the statistic, between stance and swing")
    force_per_rate: float = Field(5.7, gt=0, description="m/s^2 of force that weigh as much as 1 rad/s")
    shortest: float = Field(0.06, ge=0, description="s, the shortest stance")
    bridge: float = Field(0.03, ge=0, description="s, the longest disturbance within a stance")


class SwaySettings(_Section):
    """The stillness detector: the GLRT below the engine's frequencies."""

    window: float = Field(2.0, gt=0.3, le=30, description="s, length of a window")
    threshold: float = Field(3.0, gt=0, description="of the statistic; 1 is the sensor's noise and a body that sways")
    from_data: bool = Field(True, description="move the threshold into the valley between still and moving windows")
    force: float = Field(0.005, gt=0, description="m/s^2, 1-sigma per axis that a standing vehicle sways with")
    rate: float = Field(2.5e-4, gt=0, description="rad/s, 1-sigma per axis that a standing vehicle sways with")


class GlrtSettings(_Section):
    """The GLRT and its relatives."""

    window: float = Field(1.0, gt=0, le=30, description="s, length of a window")
    threshold: float | None = Field(None, gt=0, description="of the GLRT; found from the recording if unset")


class FftSettings(_Section):
    """The detector of an engine's idle line; the paper's values (Li 2024, section 4.2)."""

    window: float = Field(3.0, ge=1, le=30, description="s, length of a window")
    step: float = Field(1.0, ge=0.1, le=30, description="s between the starts of windows")
    bands: tuple[float, float, float] = Field(
        (10.0, 20.0, 30.0), description="Hz, upper ends of the bands of Peak-0, Peak-1 and Peak-2"
    )
    force_limit: float = Field(15.0, gt=0, description="mg, above which no peak of the force may rise")
    rate_limit: float = Field(0.7, gt=0, description="deg/s, above which no peak of the pitch rate may rise")
    force_ratio: float = Field(1.5, gt=0, description="that times Peak-1 and Peak-2 must exceed Peak-0 of the force")
    rate_ratio: float = Field(7.0, gt=0, description="times Peak-0 that Peak-1 of the pitch rate must reach")
    max_speed: float = Field(0.5, gt=0, description="m/s, of a known speed above which nothing is stationary")
    find_line: bool = Field(True, description="find the idle line from 8 to 50 Hz and move the bands with it")


class FusionSettings(_Section):
    """From the detectors' answers to stationary intervals."""

    min_duration: float = Field(1.0, gt=0, description="s, the shortest interval")
    margin: float = Field(0.1, ge=0, description="s, taken off both ends of every interval")
    bridge: float = Field(
        30.0, ge=0, description="s, the longest disturbance that is bridged where the force integrates to no motion"
    )
    bridge_speed: float = Field(0.1, gt=0, description="m/s, of that integral above which the vehicle did move")
    max_speed: float = Field(0.15, gt=0, description="m/s, of a measured speed that is not yet motion")
    odometer_delay: float = Field(0.7, ge=0, description="s, by which an odometer may be late")


class DetectorSettings(_Section):
    """Where the vehicle stands."""

    sway: SwaySettings = SwaySettings()
    glrt: GlrtSettings = GlrtSettings()
    fft: FftSettings = FftSettings()
    fusion: FusionSettings = FusionSettings()
    stance: StanceSettings = StanceSettings()


class SolverSettings(_Section):
    """The outer loop of the batch solver, and how long the incremental one waits."""

    lag: float = Field(
        120.0, ge=1, description="s of future that a state has seen when the incremental solver lets it settle"
    )
    max_iterations: int = Field(30, ge=1, description="Levenberg-Marquardt iterations")
    tolerance: float = Field(
        1e-3, gt=0, description="stop when the next step could lower the cost by less than this (cost is in sigma^2/2)"
    )


class Settings(_Section):
    """Everything that can be set; `Settings()` is the default, `Settings(profile="car")` one of `PROFILES`.

    Without a profile everything is used that the recording's platform and sensors allow.
    """

    profile: Profile | None = Field(None, description="what the recording is of: car, car+odometer or foot")
    keyframes: KeyframeSettings = KeyframeSettings()
    alignment: AlignmentSettings = AlignmentSettings()
    imu: ImuSettings = ImuSettings()
    gnss: GnssSettings = GnssSettings()
    detectors: DetectorSettings = DetectorSettings()
    standstill: StandstillSettings = StandstillSettings()
    vehicle: VehicleSettings = VehicleSettings()
    foot: FootSettings = FootSettings()
    solver: SolverSettings = SolverSettings()

    @model_validator(mode="before")
    @classmethod
    def _with_profile(cls, values: Any) -> Any:
        """The profile's values where none are given."""
        chosen = PROFILES.get(str(values.get("profile"))) if isinstance(values, Mapping) else None
        if chosen is None:
            return values
        merged = dict(values)
        for name, table in chosen.items():
            given = merged.get(name, {})
            merged[name] = {**table, **given} if isinstance(given, Mapping) else given
        return merged

    def without_wheels(self) -> Settings:
        """The same with nothing assumed of wheels."""
        return self.model_copy(update={"vehicle": self.vehicle.model_copy(update={"nhc": False, "odometer": False})})


def settings_from(values: Mapping[str, Any], source: str = "settings", text: str = "") -> Settings:
    """Validate a nested mapping, that of the file whose `text` is given.

    Raises
    ------
    ConfigError
        Naming the source, the line, the key, the value and its unit, and the nearest known key for an unknown one.
    """
    try:
        return Settings.model_validate(dict(values))
    except ValidationError as error:
        raise ConfigError(complaint(source, error, Settings, text)) from None


def read_settings(path: str | Path | None = None, profile: str | None = None) -> Settings:
    """Settings from a file over those of a profile over the defaults.

    Parameters
    ----------
    path
        TOML, or the summary.json of a run, whose settings are then used again; None: no file.
    profile
        One of `PROFILES`; it goes before the file's own.

    Raises
    ------
    ConfigError
        If the file cannot be read or holds something that is not a setting, or there is no such profile.
    """
    values: Mapping[str, Any] = {}
    text = ""
    if path is not None and Path(path).suffix == ".json":
        values = _settings_of_run(Path(path))
    elif path is not None:
        values, text = read_toml(Path(path), ConfigError)
    if profile is not None:
        if profile not in PROFILES:
            raise ConfigError(f"--profile {profile}: no such profile; known: {', '.join(get_args(Profile))}")
        values = {**values, "profile": profile}
    return settings_from(values, "settings" if path is None else str(path), text)


def _settings_of_run(path: Path) -> Mapping[str, Any]:
    """What a summary.json keeps."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))["settings"]
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError):
        raise ConfigError(f"{path}: holds no settings; name a settings file (TOML) or a summary.json") from None
    if not isinstance(values, Mapping):
        raise ConfigError(f"{path}: holds no settings; name a settings file (TOML) or a summary.json")
    return values


def settings_text(settings: Settings) -> str:
    """A file that `read_settings` reads: every key with its unit and sentence, those that are unset as comments."""
    lines: list[str] = []

    def table(section: BaseModel, at: str) -> None:
        nested = {}
        for name, field in type(section).model_fields.items():
            value = getattr(section, name)
            if isinstance(value, BaseModel):
                nested[name] = value
                continue
            # JSON's numbers, texts and lists are TOML's as well
            said = f"# {name} =" if value is None else f"{name} = {json.dumps(value)}"
            lines.append(f"{said:<30} # {field.description}")
        for name, inner in nested.items():
            place = f"{at}.{name}" if at else name
            if any(not isinstance(getattr(inner, key), BaseModel) for key in type(inner).model_fields):
                lines.extend(["", f"[{place}]"])
            table(inner, place)

    table(settings, "")
    return "\n".join(lines) + "\n"
