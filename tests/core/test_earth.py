"""The Earth: against pymap3d and python-ins, which share no code with graphnav, and published figures."""

from __future__ import annotations

import numpy as np
import pymap3d
import pytest
from pyins import earth as pyins_earth

from graphnav.core import earth

LAT, LON, H = (
    a.ravel()
    for a in np.meshgrid(
        [-90.0, -89.999, -45.0, -0.001, 0.0, 12.3, 30.5, 60.0, 89.9, 90.0],
        [-180.0, -74.0, 0.0, 11.6, 179.9],
        [-400.0, 0.0, 35.0, 1500.0, 9000.0],
    )
)
LLH = np.column_stack([np.radians(LAT), np.radians(LON), H])


def test_to_ecef_as_pymap3d() -> None:
    expected = np.column_stack(pymap3d.geodetic2ecef(LAT, LON, H))
    np.testing.assert_allclose(earth.llh_to_ecef(LLH), expected, atol=2e-9)


def test_from_ecef_as_pymap3d_and_back() -> None:
    r = np.column_stack(pymap3d.geodetic2ecef(LAT, LON, H))
    llh = earth.ecef_to_llh(r)
    lat, lon, h = pymap3d.ecef2geodetic(*r.T)
    np.testing.assert_allclose(llh[:, 0] * earth.A, np.radians(lat) * earth.A, atol=2e-6)
    away = np.abs(LAT) < 89.99  # at a pole the longitude is anything
    np.testing.assert_allclose(
        np.sin(llh[away, 1] - np.radians(lon[away])) * np.cos(llh[away, 0]) * earth.A, 0.0, atol=1e-6
    )
    np.testing.assert_allclose(llh[:, 2], h, atol=2e-6)
    np.testing.assert_allclose(earth.llh_to_ecef(llh), r, atol=2e-6)


def test_local_frame_as_pymap3d() -> None:
    origin = np.array([np.radians(48.1), np.radians(11.6), 500.0])
    frame = earth.LocalFrame(origin)
    rng = np.random.default_rng(1)
    llh = origin + rng.uniform(-1, 1, (100, 3)) * [0.02, 0.03, 400.0]
    e, n, u = pymap3d.geodetic2enu(
        np.degrees(llh[:, 0]), np.degrees(llh[:, 1]), llh[:, 2], 48.1, 11.6, 500.0
    )  # fmt: skip
    p = frame.from_llh(llh)
    np.testing.assert_allclose(p, np.column_stack([e, n, u]), atol=1e-8)
    np.testing.assert_allclose((frame.to_llh(p) - llh) * [earth.A, earth.A, 1.0], 0.0, atol=2e-6)
    np.testing.assert_allclose(frame.from_llh(origin), 0.0, atol=1e-9)


def test_local_axes_elsewhere() -> None:
    """R_ln turns n into the ENU at the point: check east, north and up by walking along them on the ellipsoid."""
    frame = earth.LocalFrame(np.array([np.radians(48.1), np.radians(11.6), 500.0]))
    p = np.array([[5e4, -3e4, 100.0], [0.0, 0.0, 0.0], [-1e5, 8e4, -50.0]])
    R_ln = frame.R_ln(p)
    for axis, step in enumerate(([0.0, 1e-7, 0.0], [1e-7, 0.0, 0.0], [0.0, 0.0, 1.0])):
        llh = frame.to_llh(p)
        moved = frame.from_llh(llh + step) - frame.from_llh(llh - np.array(step))
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        np.testing.assert_allclose(R_ln[:, axis], moved, atol=2e-8)
    np.testing.assert_allclose(R_ln[1], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R_ln @ np.swapaxes(R_ln, -1, -2), np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-14)


def test_places_and_axes_at_once_are_those_one_by_one() -> None:
    frame = earth.LocalFrame(np.array([0.6, 2.4, 50.0]))
    p_n = np.random.default_rng(1).normal(0.0, [3e4, 3e4, 1e3], (40, 3))
    llh, R_ln = frame.level(p_n)
    np.testing.assert_allclose(llh, frame.to_llh(p_n), rtol=1e-15)
    np.testing.assert_allclose(np.moveaxis(R_ln, -1, 0), frame.R_ln(p_n), atol=1e-14)


@pytest.mark.parametrize(
    ("lat", "value"),
    # NIMA TR8350.2, table 3.4: normal gravity at the equator and at the pole; GRS 80 at 45 deg (Moritz 1980) is
    # 9.806 199 203, from which WGS-84 differs by less than 1e-7 relative
    [(0.0, 9.7803253359), (90.0, 9.8321849378), (45.0, 9.8061992)],
)
def test_published_gravity(lat: float, value: float) -> None:
    assert earth.gravity(np.radians(lat), 0.0) == pytest.approx(value, abs=2e-6 if lat == 45.0 else 1e-9)


def test_gravity_as_python_ins_and_with_height() -> None:
    lat = np.linspace(-90, 90, 37)
    np.testing.assert_allclose(earth.gravity(np.radians(lat), 0.0), pyins_earth.gravity(lat, 0.0), rtol=1e-9)
    # free-air gradient, 3.086e-6 1/s^2 at 45 deg (Torge, "Geodesy", 3rd ed., sec. 4.2.2)
    drop = earth.gravity(np.radians(45.0), 0.0) - earth.gravity(np.radians(45.0), 1000.0)
    assert drop == pytest.approx(3.086e-3, rel=2e-3)


def test_gravity_vector_points_down_where_the_vehicle_is() -> None:
    frame = earth.LocalFrame(np.array([np.radians(30.5), np.radians(114.3), 20.0]))
    np.testing.assert_allclose(frame.gravity_n(np.zeros(3)), [0, 0, -earth.gravity(np.radians(30.5), 20.0)], atol=1e-12)
    p = np.random.default_rng(2).uniform(-1e5, 1e5, (50, 3)) * [1, 1, 0.01]
    local = np.einsum("kij,kj->ki", frame.R_ln(p), frame.gravity_n(p))
    llh = frame.to_llh(p)
    np.testing.assert_allclose(local[:, :2], 0.0, atol=1e-11)
    np.testing.assert_allclose(local[:, 2], -earth.gravity(llh[:, 0], llh[:, 2]), atol=1e-11)
    # 100 km east of the origin, down leans back to the west by the Earth's curvature
    assert frame.gravity_n(np.array([1e5, 0.0, 0.0]))[0] == pytest.approx(-9.79 * 1e5 / 6.386e6, rel=1e-3)


def test_earth_rate_in_the_local_frame() -> None:
    lat = np.radians(60.0)
    frame = earth.LocalFrame(np.array([lat, 1.0, 0.0]))
    np.testing.assert_allclose(frame.omega_n, 7.292115e-5 * np.array([0.0, 0.5, np.sqrt(0.75)]), atol=1e-18)
    assert pytest.approx(earth.EARTH_RATE, rel=1e-9) == pyins_earth.RATE
