"""recording.toml: all keys with their units, and validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    BeforeValidator,
    Field,
    ValidationError,
    create_model,
    field_validator,
    model_validator,
)
from pydantic.types import Strict

from graphnav.core.complaints import describe_invalid, describe_place, read_toml, shorten, suggest_nearest
from graphnav.core.earth import MG, STANDARD_GRAVITY
from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.timescales import parse_clock
from graphnav.recording import ImuNoise
from graphnav.recording.formats.axes import parse_axes_letters, parse_axes_vectors
from graphnav.recording.formats.figures import parse_figure
from graphnav.recording.formats.imu_models import MODELS, find_model
from graphnav.sensors import list_sensors
from graphnav.sensors.tables import (
    NotNegative,
    Number,
    Offset,
    Positive,
    SensorTable,
    TimeUnit,
    TomlTable,
    Vector,
    check_three_numbers,
)


def _three_positive(value: Any) -> Any:
    value = check_three_numbers(value)
    if min(value) <= 0:
        raise ValueError("must be three numbers above zero: a 1-sigma each for east, north, up")
    return value


Sigmas = Annotated[tuple[float, float, float], BeforeValidator(_three_positive)]

FOOT = 0.3048  # m
RATE_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "mdeg/s": np.pi / 180e3}
# negative: of accelerometers that point down at rest, as in phones by Apple
FORCE = {"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": MG, "ft/s2": FOOT, "-m/s2": -1.0, "-g": -STANDARD_GRAVITY}
REVERSED = 'units = { accel = "-g" }, or "-m/s2"'
HEIGHT = {"m": 1.0, "ft": FOOT}
SPEED = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "knots": 1852 / 3600}

AngleUnit = Literal["deg", "rad"]
SpeedUnit = Literal["m/s", "km/h", "mph", "knots"]


class ImuUnits(TomlTable):
    """Units of an IMU's rates and forces."""

    t: TimeUnit = "s"
    gyro: Literal["rad/s", "deg/s", "mdeg/s"] = "rad/s"
    accel: Literal["m/s2", "g", "mg", "ft/s2", "-m/s2", "-g"] = "m/s2"


# of increments over a sample, in files
ANGLE_STEPS, VELOCITY_STEPS = {"rad": 1.0, "deg": np.pi / 180.0}, {"m/s": 1.0}


class ImuFileUnits(ImuUnits):
    """Units of imu.csv, which may hold increments of angle and velocity over each sample."""

    gyro: Literal["rad/s", "deg/s", "mdeg/s", "rad", "deg"] = "rad/s"  # type: ignore[assignment]
    accel: Literal["m/s2", "g", "mg", "ft/s2", "-m/s2", "-g", "m/s"] = "m/s2"  # type: ignore[assignment]


class GnssUnits(TomlTable):
    """Units of gnss.csv; `angle` is that of lat and lon, None: degrees unless they look like radians."""

    t: TimeUnit = "s"
    angle: AngleUnit | None = None
    height: Literal["m", "ft"] = "m"
    speed: SpeedUnit = "m/s"


class FixUnits(GnssUnits):
    """Units of gnss.csv; `type` is the convention of the fix types."""

    type: Literal["rtklib", "nmea"] = "rtklib"


class OdometerUnits(TomlTable):
    """Units of odometer.csv."""

    t: TimeUnit = "s"
    speed: SpeedUnit = "m/s"


# [imu.noise]: the fields of ImuNoise, None where the file says nothing; only a scale error may be stated as none.
# A figure is a number in SI, or text with a unit.
STATED_FIGURES = tuple(f.name for f in fields(ImuNoise) if not f.name.endswith("_scale_sigma"))


def _figure(key: str) -> Any:
    number = Positive if key in STATED_FIGURES else NotNegative
    return Annotated[number | None, BeforeValidator(partial(parse_figure, key))]


NOISE_UNITS = {
    "gyro_noise_density": "rad/s/sqrt(Hz)", "accel_noise_density": "m/s2/sqrt(Hz)", "gyro_bias_walk": "rad/s/sqrt(s)",
    "accel_bias_walk": "m/s2/sqrt(s)", "gyro_bias_sigma": "rad/s, at turn-on", "accel_bias_sigma": "m/s2, at turn-on",
    "gyro_scale_sigma": "1", "accel_scale_sigma": "1",
}  # fmt: skip
Noise = create_model(  # type: ignore[call-overload]
    "Noise",
    __base__=TomlTable,
    **{f.name: (_figure(f.name), Field(None, description=NOISE_UNITS[f.name])) for f in fields(ImuNoise)},
)


class ImuDescription(TomlTable):
    """What the readings of an IMU are, wherever they come from: axes, units and noise."""

    axes: str | None = None
    forward: Vector | None = None
    up: Vector | None = None
    units: ImuUnits = ImuUnits()
    noise: Noise | None = None  # type: ignore[valid-type]
    model: str | None = None  # of graphnav.recording.formats.imu_models; [imu.noise] overrides it

    @field_validator("model")
    @classmethod
    def _check_model(cls, model: str | None) -> str | None:
        if model is not None and find_model(model) is None:
            raise ValueError(
                f"no figures of an IMU called '{model}' are known; {suggest_nearest(model, tuple(MODELS))}"
            )
        return model

    @model_validator(mode="after")
    def _one_mount(self) -> ImuDescription:
        if self.axes is not None and (self.forward is not None or self.up is not None):
            raise ValueError("give either axes or forward and up, not both")
        if (self.forward is None) != (self.up is None):
            raise ValueError("forward and up belong together: give both")
        return self

    @property
    def figures(self) -> dict[str, float]:
        """The stated noise figures: those of the model, overridden by those of [imu.noise]."""
        model = find_model(self.model) if self.model else None
        stated: dict[str, float] = self.noise.model_dump(exclude_none=True) if self.noise else {}
        return {**(model.noise if model else {}), **stated}

    @property
    def R_bs(self) -> Array:
        """Body (RFU) from the file's axes, (3, 3); ValueError if they are invalid."""
        if self.forward is not None and self.up is not None:
            return parse_axes_vectors(self.forward, self.up)
        return parse_axes_letters(self.axes or "RFU")


class ImuTable(ImuDescription, SensorTable):
    """[imu]"""

    required = ("t", "gx", "gy", "gz", "ax", "ay", "az")

    units: ImuFileUnits = ImuFileUnits()


GEOID = "geoid"  # added to h, only where `columns` names it: in other files h may be above the ellipsoid already


class GnssTable(SensorTable):
    """[gnss]"""

    required = ("t", "lat", "lon", "h")
    optional = (
        "sd_e", "sd_n", "sd_u", "ve", "vn", "vu", "sd_ve", "sd_vn", "sd_vu", "vd", "speed", "course", "type",
        "satellites", "nsat", "resid_rms_m", GEOID,
    )  # fmt: skip

    units: FixUnits = FixUnits()
    lever_arm: Vector = Field((0.0, 0.0, 0.0), description="m from the IMU: right, forward, up")
    sd: Sigmas | None = Field(None, description="m: east, north, up")
    sd_v: Sigmas | None = Field(None, description="m/s: east, north, up")
    velocity_offset: Number = Field(0.0, description="s from the stamps to the times of the velocities")


def _names(value: Any) -> Any:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not names or not all(isinstance(x, str) and x for x in names):
        raise ValueError("must be the name of a file, or names in brackets")
    return tuple(names)


Files = Annotated[tuple[str, ...], BeforeValidator(_names)]


class RawGnssTable(TomlTable):
    """[raw_gnss]: observations of a receiver, and the data that place its satellites"""

    columns_known: ClassVar[tuple[str, ...]] = (
        "t", "prn", "qzss", "code", "carrier", "doppler", "range_rate", "cn0",
    )  # fmt: skip

    rover: Files = Field(description="RINEX or UBX files, or one CSV file")
    nav: Files | None = Field(None, description="RINEX navigation files; UBX files may hold the ephemerides themselves")
    sp3: Files | None = Field(None, description="precise orbits")
    clk: Files | None = Field(None, description="precise clocks")
    antex: Files | None = Field(None, description="antennas of the satellites, for precise orbits")
    base: Files | None = Field(None, description="RINEX observations of a base station")
    base_position: Vector | None = Field(None, description="m, Earth-centred, of its antenna")
    lever_arm: Vector = Field((0.0, 0.0, 0.0), description="m from the IMU: right, forward, up")
    time_offset: Offset = Field(0.0, description="s, added to the receiver's stamps on the recording's clock")
    columns: dict[str, str] = Field({}, description="of a CSV file: our name = the file's")
    corrected: tuple[Literal["clock", "troposphere"], ...] = Field(
        (), description="corrections already applied to the codes"
    )
    stamps: Literal["receiver", "nominal"] = Field(
        "receiver", description="nominal: rounded to the epoch, while codes are of the receiver's own clock"
    )

    @field_validator("columns")
    @classmethod
    def _check_columns(cls, columns: dict[str, str]) -> dict[str, str]:
        for name in columns:
            if name not in cls.columns_known:
                raise ValueError(
                    f"'{name}' is not one of graphnav's columns; {suggest_nearest(name, cls.columns_known)}"
                )
        return columns

    @model_validator(mode="after")
    def _check_place(self) -> RawGnssTable:
        if self.clk is not None and self.sp3 is None:
            raise ValueError("clk has no effect without sp3")
        if self.antex is not None and self.sp3 is None:
            raise ValueError("antex has no effect without sp3")
        return self


WHEELS = ("speed_fl", "speed_fr", "speed_rl", "speed_rr")


class OdometerTable(SensorTable):
    """[odometer]: a speed, or pulses counted, or the speeds of the wheels"""

    required = ("t",)
    optional = ("speed", "pulses", *WHEELS)

    units: OdometerUnits = OdometerUnits()
    lever_arm: Vector = Field((0.0, 0.0, 0.0), description="m from the IMU: right, forward, up")
    scale_sigma: Positive = Field(0.02, description="1-sigma of the scale, 0.02 = 2 %")
    metres_per_pulse: Positive | None = Field(None, description="m; given, the pulses are used")
    pulses: Literal["cumulative", "per_row"] | None = None  # None: decided from the counts
    use: Literal["rear", "front", "all"] | None = None  # wheels; None: the rear ones if there is no `speed`
    speed_sigma: Positive | None = Field(None, description="m/s, of one reading")
    signed: Annotated[bool, Strict()] | None = None  # None: estimated from the readings
    delay_sigma: NotNegative = Field(0.0, description="s, of the stamps")

    @model_validator(mode="after")
    def _one_source(self) -> OdometerTable:
        if self.metres_per_pulse is not None and self.use is not None:
            raise ValueError("give either metres_per_pulse (pulses are used) or use (the speeds of wheels are)")
        for key, needs in (("pulses", self.pulses is not None), ("columns.pulses", "pulses" in self.columns)):
            if needs and self.metres_per_pulse is None:
                raise ValueError(f"{key} has no effect without metres_per_pulse, the way of one pulse in m")
        return self

    def list_readings(self, there: Sequence[str]) -> tuple[str, ...]:
        """The columns that the speed comes from, of those present; missing columns that are required are named too."""
        if self.metres_per_pulse is not None:
            return ("pulses",)
        wanted = {"front": WHEELS[:2], "rear": WHEELS[2:], "all": WHEELS}[self.use or "rear"]
        if self.use is not None or ("speed" not in there and any(name in there for name in WHEELS)):
            return wanted
        return ("speed",)


def _point(value: Any) -> Any:
    if value in ("imu", "gnss", "odometer"):
        return value
    try:
        return check_three_numbers(value)
    except ValueError:
        words = 'must be "imu", "gnss", "odometer" or three numbers in brackets'
        raise ValueError(f"{words}, not {shorten(value)}") from None


class TruthTable(SensorTable):
    """[truth]"""

    required = ("t",)
    optional = ("lat", "lon", "h", "x", "y", "z", "ve", "vn", "vu", "vd", "roll", "pitch", "heading")

    file: str | None = Field(None, min_length=1)  # type: ignore[assignment]
    units: GnssUnits = GnssUnits()
    of: Annotated[str | tuple[float, float, float], BeforeValidator(_point)] = Field(
        "imu", description="its point: that of a sensor, or m right, forward, up of the IMU"
    )
    frame: Literal["geodetic", "local"] = "geodetic"
    closed_loop_sigma: Positive | None = Field(None, description="m, from the start to the end")

    @model_validator(mode="after")
    def _one_kind(self) -> TruthTable:
        if (self.file is None) == (self.closed_loop_sigma is None):
            raise ValueError("give either file or closed_loop_sigma")
        if self.topic:
            raise ValueError("topic is for imu, gnss and odometer: a bag holds no truth")
        return self


class RecordingFile(TomlTable):
    """The whole of recording.toml."""

    format: Literal["graphnav-recording/1"] = Field(
        description='format = "graphnav-recording/1" is its first line; graphnav init drafts all of it'
    )
    name: str | None = None
    platform: Literal["vehicle", "foot"]
    clock: str | None = None  # meaning of t = 0, see graphnav.core.timescales.parse_clock; only for output
    imu: ImuTable
    gnss: GnssTable | None = None
    raw_gnss: RawGnssTable | None = None
    odometer: OdometerTable | None = None
    truth: TruthTable | None = None

    @field_validator("clock")
    @classmethod
    def _check_clock(cls, clock: str | None) -> str | None:
        if clock is not None:
            parse_clock(clock, 0.0)
        return clock

    @model_validator(mode="after")
    def _truth_of_a_sensor(self) -> RecordingFile:
        of = self.truth.of if self.truth else "imu"
        if isinstance(of, str) and getattr(self, of) is None and not (of == "gnss" and self.raw_gnss is not None):
            raise ValueError(f"truth.of = '{of}', but there is no [{of}] table whose lever arm would apply")
        return self


def build_model() -> type[RecordingFile]:
    """The model of recording.toml, with the tables of all known sensors."""
    tables: dict[str, Any] = {name: (sensor.table | None, None) for name, sensor in list_sensors().items()}
    return create_model("RecordingFile", __base__=RecordingFile, **tables)


def read_description(path: Path) -> RecordingFile:
    """Read and validate a recording's .toml.

    Raises
    ------
    RecordingError
        Naming the file and the key, and the nearest known key for an unknown one.
    """
    values, text = read_toml(path, RecordingError)
    model = build_model()
    try:
        description = model.model_validate(values)
    except ValidationError as error:
        raise RecordingError(describe_invalid(path, error, model, text)) from None
    try:
        _ = description.imu.R_bs
    except ValueError as error:
        axes = description.imu.axes
        which = "'imu': " if axes is None else f"'imu.axes' = '{axes}' "
        where = describe_place(path, text, ("imu",) if axes is None else ("imu", "axes"))
        raise RecordingError(f"{where}{which}{error}", key="key.value") from None
    return description
