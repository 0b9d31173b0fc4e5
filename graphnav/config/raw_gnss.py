"""Settings of raw GNSS observations."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from graphnav.config.outliers import Outliers


class RawGnssSettings(Outliers):
    """How codes and Doppler shifts are used."""

    coupling: Literal["automatic", "tight", "loose"] = Field(
        "automatic",
        description="tight: the observations are used; loose: fixes are; automatic: tight where the recording has no "
        "fixes of a receiver",
    )
    code: bool = Field(True, description="use the codes")
    doppler: bool = Field(True, description="use the Doppler shifts")
    carrier: bool = Field(
        True, description="use the carriers, with their ambiguities, where the recording has a base station"
    )
    integers: bool = Field(True, description="find the ambiguities as integers; without, they stay real numbers")
    elevation: float = Field(10.0, ge=0, lt=90, description="deg, below which satellites are not used")
    cn0: float = Field(30.0, ge=0, description="dB-Hz, below which signals are not used: most are reflections")
    period: float = Field(1.0, ge=0, description="s between the epochs that are used, at least; 0 = all")
    bias_sigma: float = Field(
        30.0, gt=0, description="m, 1-sigma of the bias of another system's signals against the first's"
    )
