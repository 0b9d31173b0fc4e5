"""Two antennas on one receiver: heading, and pitch if given, of the line from the first to the second."""

from __future__ import annotations

import numpy as np
from pydantic import Field, field_validator

from graphnav.sensors.base import Column, Sensor
from graphnav.sensors.tables import ANGLE, NotNegative, Positive, TomlTable, Vector


class DualAntennaKeys(TomlTable):
    """Keys of [dual_antenna] beside its file."""

    baseline: Vector = Field(
        (0.0, 1.0, 0.0), description="from the first to the second antenna: right, forward, up; any length"
    )
    # carrier phases are good to 5 mm: 0.3 deg over a metre
    sigma: Positive = Field(0.3, description="deg, 1-sigma of a heading that states none, and of a pitch")
    # antennas are mounted by hand: 2 cm in a metre
    baseline_sigma: NotNegative = Field(1.0, description="deg, 1-sigma of the baseline's direction; 0 = exact")

    @field_validator("baseline")
    @classmethod
    def _level(cls, baseline: tuple[float, float, float]) -> tuple[float, float, float]:
        if np.hypot(*baseline[:2]) < 0.1 * np.linalg.norm(baseline) or not np.linalg.norm(baseline):
            raise ValueError("stands upright: it has no heading")
        return baseline


_SIGMA_RANGE = (np.radians(1e-3), np.radians(90.0))  # a receiver states no less, and more is no information
SENSOR = Sensor(
    name="dual_antenna",
    about="heading, and pitch, of the line from one antenna to another",
    columns=(
        Column("heading", ANGLE, -2.0 * np.pi, 2.0 * np.pi),
        Column("pitch", ANGLE, -0.5 * np.pi, 0.5 * np.pi),
        Column("sd_heading", ANGLE, *_SIGMA_RANGE),
        Column("sd_pitch", ANGLE, *_SIGMA_RANGE),
    ),
    needs=(("heading",),),
    figures=DualAntennaKeys,
    keyframes=True,
)
