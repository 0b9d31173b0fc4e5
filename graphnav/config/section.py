"""The base class of all tables of settings."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator

from graphnav.core.complaints import describe_invalid
from graphnav.core.errors import ConfigError
from graphnav.sensors.tables import check_magnitude


class Section(BaseModel):
    """A table that refuses unknown keys and infinities and cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ConfigError(describe_invalid(type(self).__name__, error, type(self))) from None

    # tables in tables are validated with the outermost, which knows their place; an `__init__` of a model's own would
    # be called for each
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_no_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        """True and false are no numbers, and numbers have a square that can be inverted."""
        if isinstance(value, bool) and cls.model_fields[str(info.field_name)].annotation in (int, float):
            raise ValueError(f"must be a number, not {str(value).lower()}")
        for number in value if isinstance(value, list | tuple) else (value,):
            if isinstance(number, int | float) and np.isfinite(number):  # what is not has words of its own
                check_magnitude(number)
        return value
