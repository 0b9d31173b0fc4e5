"""Barometer: air pressure, or the height that a unit makes of it.

Pressure p becomes the height of the standard atmosphere (ICAO Doc 7488, below 11 km)::

    z = T0 / L (1 - (p / p0)^(R L / g))       T0 = 288.15 K, L = 6.5 K/km, p0 = 101325 Pa, R = 287.05 J/(kg K)
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from graphnav.core.rotation import Array
from graphnav.sensors.base import Column, Sensor, Series
from graphnav.sensors.tables import NotNegative, Positive, TomlTable

_SCALE, _PRESSURE = 288.15 / 6.5e-3, 101325.0  # m, Pa
_POWER = 287.05287 * 6.5e-3 / 9.80665


class Figures(TomlTable):
    """What [barometer] says beside its file."""

    sigma: Positive = Field(0.5, description="m, 1-sigma of one reading; wind and ventilation make most of it")
    # weather maps of a region differ by 30 hPa from day to day, 8 m each, and the geoid by 100 m from the ellipsoid
    offset_sigma: Positive = Field(300.0, description="m, 1-sigma of what its heights are off by at first: the weather")
    # 1.5 hPa in three hours bounds what weather services call slow: 12 m over the root of 10800 s
    walk: NotNegative = Field(0.1, description="m/sqrt(s), how that wanders")
    # 15 K from the standard atmosphere's temperature stretch all heights by as much as that is of 288 K
    scale_sigma: NotNegative = Field(0.05, description="1-sigma of the scale, by the temperature of the air; 0 = exact")


SENSOR = Sensor(
    name="barometer",
    about="height by air pressure",
    columns=(
        # from the highest road to the lowest mine, with the weather
        Column("pressure", {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1e3, "inHg": 3386.389}, 3e4, 1.2e5),
        Column("height", {"m": 1.0, "ft": 0.3048}, -1500.0, 10000.0),
    ),
    needs=(("pressure",), ("height",)),
    figures=Figures,
)


def standard_height(series: Series) -> Array:
    """(N,) m in the standard atmosphere, of readings of pressure, or of height where a row has that alone."""
    of_pressure = _SCALE * (1.0 - (series["pressure"] / _PRESSURE) ** _POWER)
    return np.where(np.isfinite(of_pressure), of_pressure, series["height"])


def standard_pressure(height: Array) -> Array:
    """(N,) Pa at heights (N,) m of the standard atmosphere: the inverse of `standard_height`."""
    return np.asarray(_PRESSURE * (1.0 - height / _SCALE) ** (1.0 / _POWER))
