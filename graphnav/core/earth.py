"""WGS-84: geodetic and Earth-centred coordinates, gravity, Earth rate, and the local ENU frame.

Constants and normal gravity from NIMA TR8350.2 (WGS-84, 3rd ed.), table 3.1-3.4 and eq. 4-1, 4-3;
frames as in Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*
(2nd ed.), section 2.4.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array, stack_columns

A = 6378137.0  # semi-major axis, m
FLATTENING = 1.0 / 298.257223563  # flattening
B = A * (1.0 - FLATTENING)  # semi-minor axis, m
E2 = FLATTENING * (2.0 - FLATTENING)  # first eccentricity squared
_EP2 = E2 / (1.0 - E2)  # second eccentricity squared
GM = 3.986004418e14  # m^3/s^2
STANDARD_GRAVITY, MG = 9.80665, 9.80665e-3  # m/s^2, by definition; of a thousandth of it
EARTH_RATE = 7.292115e-5  # rad/s
_GAMMA_E, _K_SOMIGLIANA = 9.7803253359, 0.00193185265241
_M = EARTH_RATE**2 * A**2 * B / GM


def llh_to_ecef(llh: Array) -> Array:
    """(lat, lon, h) in rad, rad, m -> Earth-centred Earth-fixed metres; (..., 3) -> (..., 3)."""
    llh = np.asarray(llh, dtype=float)
    lat, lon, h = llh[..., 0], llh[..., 1], llh[..., 2]
    s, c = np.sin(lat), np.cos(lat)
    n = A / np.sqrt(1.0 - E2 * s * s)
    return stack_columns((n + h) * c * np.cos(lon), (n + h) * c * np.sin(lon), (n * (1 - E2) + h) * s)


def _find_normal(x: Any, y: Any, z: Any, sqrt: Callable[[Any], Any] = np.sqrt) -> tuple[Any, Any, Any, Any]:
    """Sine and cosine of geodetic latitude, the distance from the axis, and the height, of points in ECEF (Bowring
    1976, closed form).

    In error by less than 1e-12 rad below 10 km of height.
    """
    p = sqrt(x * x + y * y)
    za, pb = z * A, p * B
    size = sqrt(za * za + pb * pb)
    up, out = z + _EP2 * B * (za / size) ** 3, p - E2 * A * (pb / size) ** 3
    size = sqrt(up * up + out * out)
    s, c = up / size, out / size
    return s, c, p, p * c + z * s - A * sqrt(1.0 - E2 * s * s)


def ecef_to_llh(r: Array) -> Array:
    """Inverse of `llh_to_ecef`, exact to a micrometre below 10 km of height."""
    r = np.asarray(r, dtype=float)
    x, y, z = r[..., 0], r[..., 1], r[..., 2]
    s, c, _, h = _find_normal(x, y, z)
    return np.stack([np.arctan2(s, c), np.arctan2(y, x), h], -1)


def enu_axes(llh: Array) -> Array:
    """R_ne: rows are the east, north and up axes in ECEF; (..., 3) -> (..., 3, 3)."""
    lat, lon = np.asarray(llh, dtype=float)[..., 0], np.asarray(llh, dtype=float)[..., 1]
    return stack_columns(*_list_enu_axes(np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon))).reshape(*lat.shape, 3, 3)


def _list_enu_axes(sl: Array, cl: Array, so: Array, co: Array) -> tuple[Array, ...]:
    """The nine components of `enu_axes`, row by row, by sines and cosines of latitude and longitude."""
    return -so, co, 0.0 * sl, -sl * co, -sl * so, cl, cl * co, cl * so, sl


def gravity(lat: Array, h: Array) -> Array:
    """Magnitude of normal gravity, m/s^2, at geodetic latitude (rad) and height (m)."""
    return _compute_gravity(np.sin(lat) ** 2, h)


def _compute_gravity(s2: Any, h: Any, sqrt: Callable[[Any], Any] = np.sqrt) -> Any:
    surface = _GAMMA_E * (1.0 + _K_SOMIGLIANA * s2) / sqrt(1.0 - E2 * s2)
    return surface * (1.0 - 2.0 / A * (1.0 + FLATTENING + _M - 2.0 * FLATTENING * s2) * h + 3.0 * (h / A) ** 2)


def _list_gravity(x: Any, y: Any, z: Any, sqrt: Callable[[Any], Any] = np.sqrt) -> tuple[Any, Any, Any]:
    """The components of gravity (m/s^2) at points, all in ECEF."""
    s, c, p, h = _find_normal(x, y, z, sqrt)
    g = -_compute_gravity(s * s, h, sqrt)
    return g * c / p * x, g * c / p * y, g * s


@dataclass(frozen=True)
class LocalFrame:
    """One fixed ENU tangent frame (n) with its origin at `origin` = (lat, lon, h) in rad, rad, m."""

    origin: Array
    epoch: float = 0.0  # s, reference time of clock drifts

    @cached_property
    def R_ne(self) -> Array:
        """Navigation from ECEF coordinates."""
        return enu_axes(self.origin)

    @cached_property
    def r_e(self) -> Array:
        """The origin in ECEF, m."""
        return llh_to_ecef(self.origin)

    @cached_property
    def omega_n(self) -> Array:
        """Earth's rotation rate in n, rad/s."""
        return self.R_ne @ np.array([0.0, 0.0, EARTH_RATE])

    @cached_property
    def W(self) -> Array:
        """[omega_n]x, rad/s."""
        return rotation.skew(self.omega_n)

    @cached_property
    def W2(self) -> Array:
        """Its square: minus the gradient of the centrifugal term, 1/s^2."""
        return self.W @ self.W

    @cached_property
    def gravity_gradient(self) -> Array:
        """Gradient of Newtonian gravity, -(g/r)(I - 3 u u^T), 1/s^2: small, but its omission causes drift in long
        outages."""
        g = self.gravity_n(np.zeros(3))
        size = float(np.linalg.norm(g))
        up = -g / size
        return np.asarray(-size / A * (np.eye(3) - 3.0 * np.outer(up, up)))

    def to_llh(self, p_n: Array) -> Array:
        """Positions in n (..., 3) -> (lat, lon, h)."""
        return ecef_to_llh(self.r_e + np.asarray(p_n, dtype=float) @ self.R_ne)

    def from_llh(self, llh: Array) -> Array:
        """(lat, lon, h) (..., 3) -> positions in n."""
        return (llh_to_ecef(llh) - self.r_e) @ self.R_ne.T

    def R_ln(self, p_n: Array) -> Array:
        """The local ENU axes at a point, from n: v_local = R_ln @ v_n; (..., 3) -> (..., 3, 3)."""
        return enu_axes(self.to_llh(p_n)) @ self.R_ne.T

    def level(self, p_n: Array) -> tuple[Array, Array]:
        """(lat, lon, h) (n, 3) of positions in n, and `R_ln` there by `rotation.move_components_first`, (3, 3, n)."""
        r = self.r_e + p_n @ self.R_ne
        x, y, z = r.T
        s, c, p, h = _find_normal(x, y, z)
        llh = stack_columns(np.arctan2(s, c), np.arctan2(y, x), h)
        axes = np.array(_list_enu_axes(s, c, y / p, x / p)).reshape(3, 3, -1)
        return llh, self.R_ne @ axes

    def gravity_n(self, p_n: Array) -> Array:
        """Gravity (gravitation and the centrifugal term) at points, m/s^2 in n; (..., 3) -> (..., 3).

        Normal gravity is taken along the ellipsoid's normal; its tilt with height (1.5e-9 rad/m at
        most) is left out.
        """
        r = self.r_e + np.asarray(p_n, dtype=float) @ self.R_ne
        if r.size == 3:  # fast path for the single points of a filter
            x, y, z = r.ravel().tolist()
            return (np.array(_list_gravity(x, y, z, math.sqrt)) @ self.R_ne.T).reshape(r.shape)
        return np.stack(_list_gravity(r[..., 0], r[..., 1], r[..., 2]), -1) @ self.R_ne.T
