"""Delays in the atmosphere and directions of satellites.

Ionosphere: Klobuchar's model (IS-GPS-200N, 20.3.3.5.2.5). Troposphere: Saastamoinen's zenith delays in a standard
atmosphere (RTKLIB manual 2.4.2, E.5) with Niell's mapping functions. One over the sine of the elevation is half a metre
more at 10 degrees, 4 m at 5, and changes there by decimetres in 30 s, as a cycle slip does.
"""

from __future__ import annotations

import numpy as np

from graphnav.core import earth
from graphnav.core.rotation import Array
from graphnav.core.timescales import gps_to_utc
from graphnav.gnss.signals import C

# without broadcast coefficients: Klobuchar's constant night-time delay, 5 ns at the zenith
NIGHT = np.zeros((2, 4))
_HUMIDITY = 0.7
_CIRCLE = np.pi  # rad of a semicircle


def compute_directions(antenna: Array, satellite: Array) -> tuple[Array, Array]:
    """Azimuth and elevation (N,), rad, of satellites (N, 3) seen from points (N, 3), both in the same e."""
    away = satellite - antenna
    enu = np.einsum("nij,nj->ni", earth.enu_axes(earth.ecef_to_llh(antenna)), away)
    flat = np.hypot(enu[:, 0], enu[:, 1])
    return np.arctan2(enu[:, 0], enu[:, 1]), np.arctan2(enu[:, 2], flat)


def compute_klobuchar_delay(coefficients: Array, gps: Array, llh: Array, azimuth: Array, elevation: Array) -> Array:
    """Ionospheric delay of the code on L1, (N,) m, by Klobuchar's model.

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
    slant = compute_obliquity(elevation)
    powers = magnetic[:, None] ** np.arange(4)
    amplitude = np.maximum(powers @ coefficients[0], 0.0)
    period = np.maximum(powers @ coefficients[1], 72000.0)
    x = 2.0 * np.pi * (local - 50400.0) / period
    day = 5e-9 + amplitude * (1.0 + x * x * (-0.5 + x * x / 24.0))
    return np.asarray(C * slant * np.where(np.abs(x) < 1.57, day, 5e-9))


def compute_obliquity(elevation: Array) -> Array:
    """Ionospheric mapping function at elevations (N,), rad: slant delay over zenith delay."""
    return np.asarray(1.0 + 16.0 * (0.53 - np.maximum(elevation, 0.0) / _CIRCLE) ** 3)


def compute_tropospheric_delay(llh: Array, elevation: Array, gps: Array) -> Array:
    """Tropospheric delay, (N,) m, at elevations (N,), rad, and GPS times (N,), s; 0 below the horizon."""
    delays, mapping = compute_zenith_delays(llh), compute_niell_mapping(llh, elevation, compute_day_of_year(gps))
    return np.asarray(np.where(elevation > 0.0, delays[0] * mapping[0] + delays[1] * mapping[1], 0.0))


def compute_zenith_delays(llh: Array) -> tuple[Array, Array]:
    """Saastamoinen's delays (N,) of the dry and the wet troposphere at the zenith, m; 0 above it."""
    height = np.clip(llh[:, 2], 0.0, 10000.0)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * height) ** 5.2568  # hPa
    kelvin = 15.0 - 6.5e-3 * height + 273.16
    vapour = 6.108 * _HUMIDITY * np.exp((17.15 * kelvin - 4684.0) / (kelvin - 38.45))
    shape = 1.0 - 0.00266 * np.cos(2.0 * llh[:, 0]) - 0.00028 * height / 1e3
    inside = (llh[:, 2] > -100.0) & (llh[:, 2] < 10000.0)
    dry, wet = 0.0022768 * pressure / shape, 0.002277 * (1255.0 / kelvin + 0.05) * vapour
    return np.where(inside, dry, 0.0), np.where(inside, wet, 0.0)


# Niell (1996), "Global mapping functions for the atmosphere delay at radio wavelengths", tables 3 and 4: a, b, c by
# latitude 15, 30, 45, 60, 75 degrees; mean and seasonal amplitude of the dry part, and the wet
_LATITUDES = np.array([15.0, 30.0, 45.0, 60.0, 75.0])
_DRY_MEAN = np.array([
    [1.2769934e-3, 1.2683230e-3, 1.2465397e-3, 1.2196049e-3, 1.2045996e-3],
    [2.9153695e-3, 2.9152299e-3, 2.9288445e-3, 2.9022565e-3, 2.9024912e-3],
    [62.610505e-3, 62.837393e-3, 63.721774e-3, 63.824265e-3, 64.258455e-3],
])  # fmt: skip
_DRY_SEASON = np.array([
    [0.0, 1.2709626e-5, 2.6523662e-5, 3.4000452e-5, 4.1202191e-5],
    [0.0, 2.1414979e-5, 3.0160779e-5, 7.2562722e-5, 11.723375e-5],
    [0.0, 9.0128400e-5, 4.3497037e-5, 84.795348e-5, 170.37206e-5],
])  # fmt: skip
_WET = np.array([
    [5.8021897e-4, 5.6794847e-4, 5.8118019e-4, 5.9727542e-4, 6.1641693e-4],
    [1.4275268e-3, 1.5138625e-3, 1.4572752e-3, 1.5007428e-3, 1.7599082e-3],
    [4.3472961e-2, 4.6729510e-2, 4.3908931e-2, 4.4626982e-2, 5.4736038e-2],
])  # fmt: skip
_NIELL_HEIGHT = np.array([2.53e-5, 5.49e-3, 1.14e-3])
_YEAR, _COLDEST = 365.25, 28.0  # days of a year; day of minimum temperature, northern hemisphere


def compute_day_of_year(gps: Array) -> Array:
    """(N,) days since the year began, of GPS times (N,), s."""
    utc = gps_to_utc(gps)
    return np.asarray((utc - utc.astype("datetime64[Y]")) / np.timedelta64(1, "D"))


def compute_niell_mapping(llh: Array, elevation: Array, day: Array) -> tuple[Array, Array]:
    """Dry and wet mapping functions (N,) of Niell at elevations (N,), rad; `day` (N,) of the year."""
    lat = np.degrees(np.abs(llh[:, 0]))
    season = np.cos(2.0 * np.pi * ((day - _COLDEST) / _YEAR + np.where(llh[:, 0] < 0.0, 0.5, 0.0)))
    sin = np.sin(np.maximum(elevation, np.radians(1.0)))

    def interpolate_at(table: Array) -> Array:
        return np.stack([np.interp(lat, _LATITUDES, row) for row in table])

    dry = _evaluate_fraction(sin, interpolate_at(_DRY_MEAN) - interpolate_at(_DRY_SEASON) * season)
    higher = (1.0 / sin - _evaluate_fraction(sin, _NIELL_HEIGHT[:, None])) * llh[:, 2] / 1e3
    return dry + higher, _evaluate_fraction(sin, interpolate_at(_WET))


def _evaluate_fraction(sin: Array, coefficients: Array) -> Array:
    """Marini's continued fraction, 1 at the zenith."""
    a, b, c = coefficients
    return np.asarray((1.0 + a / (1.0 + b / (1.0 + c))) / (sin + a / (sin + b / (sin + c))))
