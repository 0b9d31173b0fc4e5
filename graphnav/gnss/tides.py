"""Sun, Moon and the solid Earth tide, to half a centimetre.

Sun and Moon by the low-precision series of Montenbruck and Gill (2000, section 3.3.2: one and some minutes of arc), the
tide by the in-phase terms of degree two with the Love numbers of IERS Conventions 2010 (section 7.1.1, equation 7.5);
the terms left out are 5 mm at most.
"""

from __future__ import annotations

import numpy as np

from graphnav.core import earth
from graphnav.core.rotation import Array
from graphnav.core.timescales import gps_to_utc

_AU, _DAY = 149597870700.0, 86400.0  # m, s
_J2000 = np.datetime64("2000-01-01T12:00:00", "us")
_DYNAMIC_OFFSET = 69.2  # s, terrestrial time minus UTC since 2017: 37 leap seconds and 32.184 s
_SUN, _MOON = 332946.05, 0.01230002  # masses over that of the Earth
_H2, _L2, _H2_LAT, _L2_LAT = 0.6078, 0.0847, -0.0006, 0.0002  # Love and Shida numbers, and their dependence on latitude


def locate_sun_and_moon(gps: Array) -> tuple[Array, Array]:
    """Places (N, 3) of Sun and Moon, m in e, at times (N,), s since the GPS epoch."""
    utc = (gps_to_utc(gps) - _J2000) / np.timedelta64(1, "us") * 1e-6
    T = (utc + _DYNAMIC_OFFSET) / _DAY / 36525.0
    tilt = np.radians(23.43929111 - 0.0130042 * T)
    anomaly = np.radians(357.5256 + 35999.049 * T)
    sun_lon = np.radians(282.94 + 1.3972 * T) + anomaly + np.radians(
        (6892.0 * np.sin(anomaly) + 72.0 * np.sin(2.0 * anomaly)) / 3600.0
    )  # fmt: skip
    sun_range = (149.619 - 2.499 * np.cos(anomaly) - 0.021 * np.cos(2.0 * anomaly)) * 1e9
    L0 = np.radians(218.31617 + (481267.88088 + 1.3972) * T)
    m = np.radians(134.96292 + 477198.86753 * T)  # anomaly of the Moon
    s = np.radians(357.52543 + 35999.04944 * T)  # of the Sun
    F = np.radians(93.27283 + 483202.01873 * T)
    D = np.radians(297.85027 + 445267.11135 * T)
    second = np.radians(1.0 / 3600.0)
    moon_lon = L0 + second * (
        22640.0 * np.sin(m) + 769.0 * np.sin(2 * m) - 4586.0 * np.sin(m - 2 * D) + 2370.0 * np.sin(2 * D)
        - 668.0 * np.sin(s) - 412.0 * np.sin(2 * F) - 212.0 * np.sin(2 * m - 2 * D) - 206.0 * np.sin(m + s - 2 * D)
        + 192.0 * np.sin(m + 2 * D) - 165.0 * np.sin(s - 2 * D) + 148.0 * np.sin(m - s) - 125.0 * np.sin(D)
        - 110.0 * np.sin(m + s) - 55.0 * np.sin(2 * F - 2 * D)
    )  # fmt: skip
    moon_lat = second * (
        18520.0 * np.sin(F + moon_lon - L0 + second * (412.0 * np.sin(2 * F) + 541.0 * np.sin(s)))
        - 526.0 * np.sin(F - 2 * D) + 44.0 * np.sin(m + F - 2 * D) - 31.0 * np.sin(-m + F - 2 * D)
        - 25.0 * np.sin(-2 * m + F) - 23.0 * np.sin(s + F - 2 * D) + 21.0 * np.sin(-m + F)
        + 11.0 * np.sin(-s + F - 2 * D)
    )  # fmt: skip
    moon_range = 1e3 * (
        385000.0 - 20905.0 * np.cos(m) - 3699.0 * np.cos(2 * D - m) - 2956.0 * np.cos(2 * D) - 570.0 * np.cos(2 * m)
        + 246.0 * np.cos(2 * m - 2 * D) - 205.0 * np.cos(s - 2 * D) - 171.0 * np.cos(m + 2 * D)
        - 152.0 * np.cos(m + s - 2 * D)
    )  # fmt: skip
    sidereal = np.radians(np.mod(280.46061837 + 360.98564736629 * utc / _DAY, 360.0))
    # longitudes are of the equinox of date, as the sidereal time is
    sun = _rotate_to_earth_fixed(sun_lon, np.zeros_like(sun_lon), sun_range, tilt, sidereal)
    return sun, _rotate_to_earth_fixed(moon_lon, moon_lat, moon_range, tilt, sidereal)


def _rotate_to_earth_fixed(lon: Array, lat: Array, distance: Array, tilt: Array, sidereal: Array) -> Array:
    """From the ecliptic of date to the Earth-fixed frame."""
    x, y, z = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
    y, z = np.cos(tilt) * y - np.sin(tilt) * z, np.sin(tilt) * y + np.cos(tilt) * z
    c, s = np.cos(sidereal), np.sin(sidereal)
    return np.asarray(distance[:, None] * np.stack([c * x + s * y, -s * x + c * y, z], -1))


def compute_solid_tide(place: Array, sun: Array, moon: Array) -> Array:
    """(N, 3) m in e, tidal displacement of points (N, 3), m in e, permanent part included."""
    r = np.linalg.norm(place, axis=1)[:, None]
    up = place / r
    flat = 1.5 * up[:, 2:] ** 2 - 0.5
    h, l = _H2 + _H2_LAT * flat, _L2 + _L2_LAT * flat
    out = np.zeros_like(place)
    for body, mass in ((sun, _SUN), (moon, _MOON)):
        away = np.linalg.norm(body, axis=1)[:, None]
        to = body / away
        high = np.sum(to * up, axis=1)[:, None]
        size = mass * earth.A**4 / away**3
        out += size * (h * up * (1.5 * high**2 - 0.5) + 3.0 * l * high * (to - high * up))
    return out
