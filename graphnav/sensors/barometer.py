"""Barometer: air pressure, or the height that the unit derives from it.

Pressure p becomes the height of the standard atmosphere (ICAO Doc 7488, below 11 km)::

    z = T0 / L (1 - (p / p0)^(R L / g))       T0 = 288.15 K, L = 6.5 K/km, p0 = 101325 Pa, R = 287.05 J/(kg K)
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from graphnav.core.earth import STANDARD_GRAVITY
from graphnav.core.rotation import Array
from graphnav.sensors.base import Column, Sensor, Series
from graphnav.sensors.tables import NotNegative, Positive, TomlTable

ATMOSPHERE = 101325.0  # Pa
_SCALE_HEIGHT = 288.15 / 6.5e-3  # m
_POWER = 287.05287 * 6.5e-3 / STANDARD_GRAVITY


class BarometerKeys(TomlTable):
    """Keys of [barometer] beside its file."""

    sigma: Positive = Field(0.5, description="m, 1-sigma of one reading; wind and ventilation make most of it")
    # weather differs by 30 hPa over a region from day to day, 8 m each; the geoid is up to 100 m from the ellipsoid
    offset_sigma: Positive = Field(300.0, description="m, 1-sigma of what its heights are off by at first: the weather")
    # weather services call up to 1.5 hPa in three hours a slow change: 12 m over the root of 10800 s
    walk: NotNegative = Field(0.1, description="m/sqrt(s), how that wanders")
    # 15 K off the standard atmosphere's 288 K change all heights by that share
    scale_sigma: NotNegative = Field(0.05, description="1-sigma of the scale, by the temperature of the air; 0 = exact")


SENSOR = Sensor(
    name="barometer",
    about="height by air pressure",
    columns=(
        # highest roads to deepest mines, in any weather
        Column("pressure", {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1e3, "inHg": 3386.389}, 3e4, 1.2e5),
        Column("height", {"m": 1.0, "ft": 0.3048}, -1500.0, 10000.0),
    ),
    needs=(("pressure",), ("height",)),
    figures=BarometerKeys,
)


def compute_standard_height(series: Series) -> Array:
    """(N,) m in the standard atmosphere, from pressure, or the stated height where a row has no pressure."""
    of_pressure = _SCALE_HEIGHT * (1.0 - (series["pressure"] / ATMOSPHERE) ** _POWER)
    return np.where(np.isfinite(of_pressure), of_pressure, series["height"])


def compute_standard_pressure(height: Array) -> Array:
    """(N,) Pa at heights (N,) m of the standard atmosphere: the inverse of `compute_standard_height`."""
    return np.asarray(ATMOSPHERE * (1.0 - height / _SCALE_HEIGHT) ** (1.0 / _POWER))
