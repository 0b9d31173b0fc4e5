"""The base class of all tables of settings."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

from graphnav.sensors.tables import check_magnitude


class Section(BaseModel):
    """A table that refuses unknown keys and infinities and cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

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
