"""Delays in the atmosphere and directions of satellites.

Ionosphere: Klobuchar's model (IS-GPS-200N, 20.3.3.5.2.5). Troposphere: Saastamoinen's zenith delays in a standard
atmosphere over the sine of the elevation, as in RTKLIB (manual 2.4.2, E.5); good to decimetres at 10 degrees.
"""

from __future__ import annotations

import numpy as np

from graphnav.core import earth
from graphnav.core.rotation import Array
from graphnav.gnss.signals import C

# where no coefficients are broadcast: Klobuchar's constant part, 5 ns at the zenith, which is all there is at night
NIGHT = np.zeros((2, 4))
_HUMIDITY = 0.7
_CIRCLE = np.pi  # rad of a semicircle


def directions(antenna: Array, satellite: Array) -> tuple[Array, Array]:
    """Azimuth and elevation (N,), rad, of satellites (N, 3) seen from points (N, 3), both in the same e."""
    away = satellite - antenna
    enu = np.einsum("nij,nj->ni", earth.enu_axes(earth.ecef_to_llh(antenna)), away)
    flat = np.hypot(enu[:, 0], enu[:, 1])
    return np.arctan2(enu[:, 0], enu[:, 1]), np.arctan2(enu[:, 2], flat)


def klobuchar(coefficients: Array, gps: Array, llh: Array, azimuth: Array, elevation: Array) -> Array:
    """(N,) delay of the code on L1, m.

    Parameters
    ----------
    coefficients : (2, 4) alpha and beta.
    gps : (N,) s of the GPS week.
    llh : (N, 3) of the antenna.
    """
    el = np.maximum(elevation, 0.0) / _CIRCLE
    angle = 0.0137 / (el + 0.11) - 0.022
    lat = np.clip(llh[:, 0] / _CIRCLE + angle * np.cos(azimuth), -0.416, 0.416)
    lon = llh[:, 1] / _CIRCLE + angle * np.sin(azimuth) / np.cos(lat * _CIRCLE)
    magnetic = lat + 0.064 * np.cos((lon - 1.617) * _CIRCLE)
    local = np.mod(43200.0 * lon + gps, 86400.0)
    slant = obliquity(elevation)
    powers = magnetic[:, None] ** np.arange(4)
    amplitude = np.maximum(powers @ coefficients[0], 0.0)
    period = np.maximum(powers @ coefficients[1], 72000.0)
    x = 2.0 * np.pi * (local - 50400.0) / period
    day = 5e-9 + amplitude * (1.0 + x * x * (-0.5 + x * x / 24.0))
    return np.asarray(C * slant * np.where(np.abs(x) < 1.57, day, 5e-9))


def obliquity(elevation: Array) -> Array:
    """(N,) delay of the ionosphere at elevations (N,), rad, over that at the zenith."""
    return np.asarray(1.0 + 16.0 * (0.53 - np.maximum(elevation, 0.0) / _CIRCLE) ** 3)


def saastamoinen(llh: Array, elevation: Array) -> Array:
    """(N,) delay of the troposphere, m, at elevations (N,), rad; 0 below the horizon and outside the troposphere."""
    height = np.clip(llh[:, 2], 0.0, 10000.0)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * height) ** 5.2568  # hPa
    kelvin = 15.0 - 6.5e-3 * height + 273.16
    vapour = 6.108 * _HUMIDITY * np.exp((17.15 * kelvin - 4684.0) / (kelvin - 38.45))
    down = np.pi / 2.0 - np.maximum(elevation, 0.0)
    shape = 1.0 - 0.00266 * np.cos(2.0 * llh[:, 0]) - 0.00028 * height / 1e3
    with np.errstate(divide="ignore"):
        dry = 0.0022768 * pressure / shape / np.cos(down)
        wet = 0.002277 * (1255.0 / kelvin + 0.05) * vapour / np.cos(down)
    inside = (elevation > 0.0) & (llh[:, 2] > -100.0) & (llh[:, 2] < 10000.0)
    return np.asarray(np.where(inside, dry + wet, 0.0))
