"""Settings of raw GNSS observations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, model_validator

from graphnav.config.outliers import Outliers


class RawGnssSettings(Outliers):
    """Use of raw GNSS observations: codes, Doppler shifts and carrier phases."""

    coupling: Literal["automatic", "tight", "loose"] = Field(
        "automatic",
        description="tight: the observations are used; loose: fixes are; automatic: tight where the recording has no "
        "fixes of a receiver",
    )
    code: bool = Field(True, description="use the codes")
    doppler: bool = Field(True, description="use the Doppler shifts")
    differences: bool = Field(
        True, description="use time-differenced carrier phases, where their ambiguities are not estimated"
    )
    ppp: bool = Field(
        False,
        description="precise point positioning: codes and carriers of two signals, by precise orbits and clocks, in "
        "place of single codes and changes of carriers",
    )
    carrier: bool = Field(
        True, description="use carrier phases with ambiguities, where the recording has a base station"
    )
    integers: bool = Field(True, description="fix ambiguities to integers; without, they remain float")
    elevation: float = Field(10.0, ge=0, lt=90, description="deg, below which satellites are not used")
    cn0: float = Field(30.0, ge=0, description="dB-Hz, below which signals are not used: most are multipath")
    period: float = Field(1.0, ge=0, description="s between the epochs that are used, at least; 0 = all")
    bias_sigma: float = Field(
        30.0, gt=0, description="m, 1-sigma of the bias of another system's signals against the first's"
    )

    @model_validator(mode="before")
    @classmethod
    def _with_ppp(cls, values: Any) -> Any:
        """Precise point positioning uses codes and carriers itself: they are not used a second time."""
        if isinstance(values, Mapping) and values.get("ppp") is True:
            return {"code": False, "differences": False, **values}
        return values
