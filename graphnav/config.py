"""Settings: validated, each with its unit and a sentence. Flag over file over profile over default."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from graphnav.errors import ConfigError

Kernel = Literal["none", "huber", "cauchy", "geman-mcclure", "tukey", "welsch"]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


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


class ImuSettings(_Section):
    """How the IMU's figures are used."""

    as_stated: bool = Field(
        False, description="take the noise figures as stated, even where the drive shows them to be too small"
    )


class GnssSettings(_Section):
    """How fixes are used."""

    position: bool = Field(True, description="use the positions")
    velocity: bool = Field(True, description="use the velocities where there are any")
    robust: Kernel = Field("none", description="robust kernel of the smoother")
    robust_scale: float = Field(3.0, gt=0, description="whitened norm of a whole fix at which the kernel bends")
    gate: float | None = Field(None, gt=0, description="whitened norm above which the filter rejects a fix")
    lever_arm_sigma: float | None = Field(
        None, gt=0, description="m, 1-sigma of the stated lever arm; given, the lever arm is estimated"
    )
    slow_share: float | None = Field(
        None, ge=0, lt=1, description="share of a position's variance that changes slowly; found from the data if unset"
    )
    slow_times: tuple[float, float] = Field(
        (100.0, 3600.0), description="s, correlation times of the two halves of that slow part"
    )
    sd_factor: float | None = Field(
        None, gt=0, description="factor on the stated position sigmas; found from the data if unset, never below 1"
    )
    time_offset_sigma: float = Field(
        0.02, ge=0, description="s, 1-sigma of what the stamps of the fixes may be off; 0 = exact, not estimated"
    )


class SolverSettings(_Section):
    """The batch solver's outer loop."""

    max_iterations: int = Field(30, ge=1, description="Levenberg-Marquardt iterations")
    tolerance: float = Field(
        1e-3, gt=0, description="stop when the next step could lower the cost by less than this (cost is in sigma^2/2)"
    )


class Settings(_Section):
    """Everything that can be set; `Settings()` is the default."""

    keyframes: KeyframeSettings = KeyframeSettings()
    alignment: AlignmentSettings = AlignmentSettings()
    imu: ImuSettings = ImuSettings()
    gnss: GnssSettings = GnssSettings()
    solver: SolverSettings = SolverSettings()


def settings_from(values: Mapping[str, Any], source: str = "settings") -> Settings:
    """Validate a nested mapping.

    Raises
    ------
    ConfigError
        Naming the source, the key, the value, and the nearest known key for an unknown one.
    """
    try:
        return Settings.model_validate(dict(values))
    except ValidationError as error:
        raise ConfigError(f"{source}: {explain(error, Settings)}") from None


def read_settings(path: str | Path) -> Settings:
    """Read a settings file (TOML).

    Raises
    ------
    ConfigError
        If the file cannot be read or holds something that is not a setting.
    """
    path = Path(path)
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML ({error})") from None
    return settings_from(values, str(path))


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """The first complaint of pydantic as one plain sentence."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"unknown key '{where}'{suggestion(first['loc'], model)}"
    if first["type"] == "missing":
        return f"'{where}' is missing"
    return f"'{where}' = {first['input']!r}: {first['msg'][0].lower()}{first['msg'][1:]}"


def suggestion(loc: tuple[Any, ...], model: type[BaseModel]) -> str:
    """'; did you mean ...' with the nearest known key of the table `loc` lies in."""
    table: type[BaseModel] = model
    for part in loc[:-1]:
        annotation = table.model_fields[part].annotation if part in table.model_fields else None
        options = [annotation, *getattr(annotation, "__args__", ())]
        inner = [o for o in options if isinstance(o, type) and issubclass(o, BaseModel)]
        if not inner:
            break
        table = inner[0]
    known = [field.alias or name for name, field in table.model_fields.items()]
    close = difflib.get_close_matches(str(loc[-1]), known, n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}'?" if close else f"; known keys: {', '.join(known)}"
