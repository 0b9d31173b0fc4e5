"""Settings of the detectors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal

from pydantic import Field, ModelWrapValidatorHandler, PrivateAttr, field_validator, model_validator

from graphnav.config.section import Section
from graphnav.core.notes import Note


class StanceSettings(Section):
    """Detection of when a foot is on the floor."""

    window: float = Field(0.05, gt=0, le=1, description="s, length of a window")
    threshold: float = Field(1.5, gt=0, description="rad/s, of the statistic, between stance and swing")
    force_per_rate: float = Field(5.7, gt=0, description="m/s^2 of force that weigh as much as 1 rad/s")
    shortest: float = Field(0.06, ge=0, description="s, the shortest stance")
    bridge: float = Field(0.03, ge=0, description="s, the longest disturbance within a stance")


class LowBandSettings(Section):
    """The GLRT with unknown means, below the engine's frequency band."""

    window: float = Field(2.0, gt=0.3, le=30, description="s, length of a window")
    threshold: float = Field(3.0, gt=0, description="of the statistic; 1 is the sensor's noise and a body that sways")
    from_data: bool = Field(True, description="move the threshold into the valley between still and moving windows")
    force: float = Field(0.005, gt=0, description="m/s^2, 1-sigma per axis that a standing vehicle sways with")
    rate: float = Field(2.5e-4, gt=0, description="rad/s, 1-sigma per axis that a standing vehicle sways with")


class GlrtSettings(Section):
    """The GLRT and related detectors."""

    window: float = Field(1.0, gt=0, le=30, description="s, length of a window")
    threshold: float | None = Field(None, gt=0, description="of the GLRT; found from the recording if unset")


class FftSettings(Section):
    """The detector of an engine's idle line; defaults from the paper (Li 2024, section 4.2)."""

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


class FusionSettings(Section):
    """Fusion of the detectors' answers to stationary intervals."""

    min_duration: float = Field(1.0, gt=0, description="s, the shortest interval")
    margin: float = Field(0.1, ge=0, description="s, taken off both ends of every interval")
    bridge: float = Field(
        30.0, ge=0, description="s, the longest disturbance that is bridged where the force integrates to no motion"
    )
    bridge_speed: float = Field(0.1, gt=0, description="m/s, of that integral, above which the vehicle has moved")
    max_speed: float = Field(0.15, gt=0, description="m/s, of a measured speed that is not yet motion")
    odometer_delay: float = Field(0.7, ge=0, description="s, by which an odometer may be late")


FUSED: Final = "fused"
DetectorName = Literal[
    "fused", "fft", "glrt", "acceleration_variance", "acceleration_magnitude", "angular_rate_energy", "low_band_glrt"
]
_OLD = {"sway": "low_band_glrt"}  # former names of tables


class DetectorSettings(Section):
    """Detection of when the vehicle is stationary."""

    fire: tuple[DetectorName, ...] = Field(
        (FUSED,), min_length=1, description="detectors that decide: fused, or names, any one of which then suffices"
    )
    low_band_glrt: LowBandSettings = LowBandSettings()
    glrt: GlrtSettings = GlrtSettings()
    fft: FftSettings = FftSettings()
    fusion: FusionSettings = FusionSettings()
    stance: StanceSettings = StanceSettings()

    _notes: tuple[str, ...] = PrivateAttr(())

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on how the settings were given."""
        return self._notes

    @field_validator("fire")
    @classmethod
    def _check_fused_is_alone(cls, fire: tuple[str, ...]) -> tuple[str, ...]:
        if FUSED in fire and len(fire) > 1:
            raise ValueError("'fused' has rules of its own: name it alone, or name detectors")
        return tuple(dict.fromkeys(fire))

    @model_validator(mode="wrap")
    @classmethod
    def _rename_old(cls, values: Any, handler: ModelWrapValidatorHandler[DetectorSettings]) -> DetectorSettings:
        """Accept tables under their former names."""
        old = [name for name in _OLD if isinstance(values, Mapping) and name in values]
        for name in old:
            if _OLD[name] in values:
                raise ValueError(f"[detectors.{name}] is [detectors.{_OLD[name]}] now: give one of them")
            values = {_OLD.get(key, key): value for key, value in values.items()}
        found = handler(values)
        found._notes = tuple(
            Note("settings.renamed", f"settings: [detectors.{name}] is called [detectors.{_OLD[name]}] now")
            for name in old
        )
        return found
