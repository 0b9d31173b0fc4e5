"""Building blocks of the tables in recording.toml: valid numbers, units, and the keys common to all sensors."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, field_validator
from pydantic.types import Strict

from graphnav.core.complaints import suggest_nearest

_SMALLEST, _LARGEST = 1e-15, 1e9  # of a number, so that its square can be represented
_MAX_COMPONENT = 1e7  # of the components of a vector: m from the Earth's centre, or a direction

LATEST = 1e11  # s, either sign: three thousand years

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Offset = Annotated[Number, Field(ge=-LATEST, le=LATEST)]


def check_magnitude(value: float) -> float:
    """Check a number whose square is to be inverted; ValueError otherwise."""
    if value and not _SMALLEST <= abs(value) <= _LARGEST:
        raise ValueError(f"{value:g} must lie between {_SMALLEST:g} and {_LARGEST:g}")
    return value


Positive = Annotated[float, Strict(), Field(allow_inf_nan=False, gt=0), AfterValidator(check_magnitude)]

NotNegative = Annotated[float, Strict(), Field(allow_inf_nan=False, ge=0), AfterValidator(check_magnitude)]


def check_three_numbers(value: Any) -> Any:
    """Check a vector of three numbers; ValueError otherwise."""
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError("must be three numbers in brackets")
    if any(isinstance(x, bool) or not isinstance(x, int | float) or not np.isfinite(x) for x in value):
        raise ValueError("must be three numbers in brackets")
    if any(abs(x) > _MAX_COMPONENT for x in value):
        raise ValueError(f"must be three numbers in brackets, none beyond {_MAX_COMPONENT:g}")
    return tuple(float(x) for x in value)


Vector = Annotated[tuple[float, float, float], BeforeValidator(check_three_numbers)]

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "d": 86400.0}
ANGLE = {"deg": np.pi / 180.0, "rad": 1.0}

TimeUnit = Literal["s", "ms", "us", "ns", "d"]


class TomlTable(BaseModel):
    """A table that refuses unknown keys and cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _check_one_or_more(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


Topics = Annotated[tuple[str, ...], BeforeValidator(_check_one_or_more)]


class Keep(TomlTable):
    """Selects rows whose column holds at least this value."""

    column: str
    at_least: Number


class SensorTable(TomlTable):
    """The keys common to all sensors' tables."""

    required: ClassVar[tuple[str, ...]] = ()
    optional: ClassVar[tuple[str, ...]] = ()

    file: str = Field(min_length=1)
    columns: dict[str, str] = Field({}, description="our name = the file's")
    time_offset: Offset = Field(0.0, description="s, added to the file's stamps")
    keep: Keep | None = None
    topic: Topics = Field((), description="of a ROS bag, or several: a fix's and a velocity's")

    @field_validator("columns")
    @classmethod
    def _check_columns(cls, columns: dict[str, str]) -> dict[str, str]:
        known = (*cls.required, *cls.optional)
        for name in columns:
            if name not in known:
                raise ValueError(f"'{name}' is not one of graphnav's columns; {suggest_nearest(name, known)}")
        return columns
