"""Single-point positions and velocities: least squares on the codes and Doppler shifts of each epoch.

With rho the distance from the antenna at reception to the satellite at transmission, in the Earth-fixed frame of the
reception,

    P = rho + b + b_s - dt + I + T            b: receiver clock, b_s: of another system's signal, dt: satellite clock
    rho' (1 + e.(v_s + omega x s) / c) = e.(v_s - v)          e: unit vector from the antenna to the satellite s
    D = rho' + b' - dt'

(Groves 2013, sections 8.4.1, 9.4.1; the denominator accounts for the change of the flight time). All epochs are solved
at once. Outlying rows of an epoch are down-weighted by Cauchy's kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from graphnav.core import earth
from graphnav.core.rotation import Array
from graphnav.gnss.atmosphere import NIGHT, compute_directions, compute_klobuchar_delay, compute_tropospheric_delay
from graphnav.gnss.ephemeris import OMEGA_WGS84, rotate_earth
from graphnav.gnss.series import RawGnss
from graphnav.gnss.sigmas import compute_code_sigma, compute_rate_sigma
from graphnav.gnss.signals import L1, C

_ITERATIONS, _ATMOSPHERE = 10, 3  # iterations, and the first in which the atmosphere is modelled
_KERNEL_SCALE = 3.0  # sigmas, scale of Cauchy's kernel
_WEAK = 1e6  # m, prior 1-sigma of an unknown
_LOST_RMS = 100.0  # m, rms of residuals beyond which an epoch has no position
_WORST_PDOP = 60.0  # PDOP beyond which a position carries no information
_OMEGA_E = np.array([0.0, 0.0, OMEGA_WGS84])


@dataclass(frozen=True)
class Geometry:
    """Line-of-sight geometry of rows, from antenna positions (N, 3), m in e."""

    s: Array  # (N, 3) m, satellites in the Earth-fixed frame of the reception
    e: Array  # (N, 3) unit vectors to them
    distance: Array  # (N,) m
    azimuth: Array  # (N,) rad, from north to the east
    elevation: Array  # (N,) rad
    ionosphere: Array  # (N,) m
    troposphere: Array  # (N,) m

    def take(self, which: NDArray[np.bool_]) -> Geometry:
        """Some of the rows."""
        return Geometry(**{f.name: getattr(self, f.name)[which] for f in fields(self)})


@dataclass(frozen=True)
class SinglePoint:
    """Solutions of E epochs; NaN where there is none."""

    t: Array  # (E,) s, stamps of the rows
    p: Array  # (E, 3) m in e
    clock: Array  # (E,) m
    covariance: Array  # (E, 3, 3) m^2 in east, north, up, by the stated sigmas
    v: Array  # (E, 3) m/s in e
    drift: Array  # (E,) m/s
    covariance_v: Array  # (E, 3, 3)
    satellites: NDArray[np.intp]  # (E,) number of rows with a weight above one half
    rms: Array  # (E,) of whitened, weighted residuals
    groups: tuple[tuple[int, int], ...]  # system and signal, the reference first
    group: NDArray[np.intp]  # (N,) of each row
    residual: Array  # (N,) m
    weight: Array  # (N,)


def _plan_padding(epoch: NDArray[np.intp], place: NDArray[np.intp], shape: tuple[int, int]) -> Callable[[Array], Array]:
    """Return a function that pads rows (N, ...) to (epochs, rows per epoch, ...) with zeros."""

    def pad(rows: Array) -> Array:
        out = np.zeros((*shape, *rows.shape[1:]))
        out[epoch, place] = rows
        return out

    return pad


def look(raw: RawGnss, antenna: Array, ionosphere: Array | None) -> Geometry:
    """Compute directions, distances and delays of all rows from antenna positions (N, 3), m in e.

    Parameters
    ----------
    ionosphere : (2, 4) Klobuchar's coefficients; no delay without them.
    """
    flight = np.linalg.norm(raw.p - antenna, axis=1) / C
    s = rotate_earth(raw.p, flight)
    away = s - antenna
    distance = np.linalg.norm(away, axis=1)
    azimuth, elevation = compute_directions(antenna, s)
    llh = earth.ecef_to_llh(antenna)
    delay = np.zeros(len(raw))
    if ionosphere is not None:
        on_l1 = compute_klobuchar_delay(ionosphere, raw.seconds_of_week, llh, azimuth, elevation)
        delay = on_l1 * (L1 / raw.frequency) ** 2
    wet = np.zeros(len(raw)) if raw.troposphere else compute_tropospheric_delay(llh, elevation, raw.t + raw.zero)
    return Geometry(s, away / distance[:, None], distance, azimuth, elevation, delay, wet)


def compute_stretch(raw: RawGnss, geometry: Geometry) -> Array:
    """(N,) 1 + e.(v_s + omega x s) / c: ratio of the relative velocity along the line of sight to the range rate."""
    moving = rotate_earth(raw.v, geometry.distance / C) + np.cross(_OMEGA_E, geometry.s)
    return np.asarray(1.0 + np.sum(geometry.e * moving, axis=1) / C)


def choose_coefficients(raw: RawGnss) -> Array:
    """Klobuchar's coefficients: those broadcast, else those of the night-time delay."""
    return NIGHT if raw.klobuchar is None else np.array(raw.klobuchar)


def group_signals(raw: RawGnss) -> tuple[tuple[tuple[int, int], ...], NDArray[np.intp]]:
    """Groups of system and signal, the one with most rows first, and the group of each row (N,)."""
    key = (raw.satellite // 100).astype(np.int64) * 1000 + raw.signal
    if raw.catalogue is not None:
        known = np.array([1000 * system + signal for system, signal in raw.catalogue.groups])
        return raw.catalogue.groups, np.argmax(key[:, None] == known, axis=1)
    found, of, many = np.unique(key, return_inverse=True, return_counts=True)
    order = np.argsort(-many, kind="stable")
    rank = np.empty(len(found), dtype=np.intp)
    rank[order] = np.arange(len(found))
    return tuple((int(found[k]) // 1000, int(found[k]) % 1000) for k in order), rank[of]


def solve(raw: RawGnss, mask: float = np.radians(10.0), robust: bool = True, differential: bool = False) -> SinglePoint:
    """Positions and velocities of all epochs.

    Parameters
    ----------
    raw : one row for each satellite and epoch (`graphnav.gnss.series.choose_primary`).
    mask : rad, elevation below which satellites are not used.
    robust : down-weight outlying rows.
    differential : the codes are corrected by a base, which sees the same ionosphere.
    """
    t, of = raw.epochs
    groups, group = group_signals(raw)
    E, G, n = len(t), len(groups), 3 + len(groups)
    order = np.argsort(of, kind="stable")
    place = np.empty(len(raw), dtype=np.intp)
    place[order] = np.arange(len(raw)) - np.searchsorted(of[order], of[order])
    S = int(place.max(initial=0)) + 1
    klobuchar_of = choose_coefficients(raw)
    usable = np.isfinite(raw.p).all(axis=1) & np.isfinite(raw.code) & np.isfinite(raw.clock)

    pad = _plan_padding(of, place, (E, S))
    H = np.zeros((len(raw), n))
    H[:, 3] = 1.0
    other = group > 0
    H[np.flatnonzero(other), 3 + group[other]] = 1.0
    x = np.zeros((E, n))
    x[:, :3] = raw.place
    weight = np.ones(len(raw))
    information = np.zeros((E, n, n))
    measured = raw.code + np.nan_to_num(raw.clock)
    for k in range(_ITERATIONS):
        geometry = look(raw, x[of, :3], klobuchar_of if k >= _ATMOSPHERE else None)
        above = geometry.elevation >= mask if k >= _ATMOSPHERE else np.ones(len(raw), dtype=bool)
        predicted = geometry.distance + np.sum(H[:, 3:] * x[of, 3:], axis=1)
        if k >= _ATMOSPHERE:
            predicted = predicted + geometry.ionosphere + geometry.troposphere
        r = measured - predicted
        delay = np.zeros(len(raw)) if differential else geometry.ionosphere
        sigma = compute_code_sigma(raw.cn0, np.maximum(geometry.elevation, 0.05), delay)
        good = usable & above
        if robust and k > _ATMOSPHERE:
            weight = 1.0 / (1.0 + (np.nan_to_num(r) / (_KERNEL_SCALE * sigma)) ** 2)
        w = np.where(good, weight / sigma**2, 0.0)
        H[:, :3] = np.nan_to_num(-geometry.e)
        Hp, wp = pad(H), pad(w)
        information = np.einsum("esi,es,esj->eij", Hp, wp, Hp, optimize=True)
        right = np.einsum("esi,es->ei", Hp, wp * pad(np.where(good, np.nan_to_num(r), 0.0)), optimize=True)
        x = x + np.linalg.solve(information + np.eye(n) / _WEAK**2, right[..., None])[..., 0]
    P = np.linalg.inv(information + np.eye(n) / _WEAK**2)
    used = w > 0.0
    counted = np.bincount(of, weights=used & (weight > 0.5), minlength=E)
    total = np.bincount(of, weights=np.where(used, weight * np.nan_to_num(r / sigma) ** 2, 0.0), minlength=E)
    present = np.stack([np.bincount(of, weights=used & (group == g), minlength=E) for g in range(G)], -1) > 0
    needed = 3 + present.sum(axis=1)
    rms = np.sqrt(total / np.maximum(np.bincount(of, weights=used, minlength=E), 1.0))
    found = np.bincount(of, weights=used, minlength=E) >= needed
    R = earth.enu_axes(earth.ecef_to_llh(x[:, :3]))
    cofactor = R @ P[:, :3, :3] @ np.swapaxes(R, -1, -2)
    found &= (rms < _LOST_RMS) & (np.trace(cofactor, axis1=-2, axis2=-1) < _WORST_PDOP**2)
    x[~found] = np.nan
    cofactor[~found] = np.nan
    v, drift, covariance_v = _solve_velocities(raw, of, place, (E, S), x, mask, robust)
    return SinglePoint(
        t, x[:, :3], x[:, 3], cofactor, v, drift, covariance_v, counted.astype(np.intp), rms, groups, group,
        np.where(used, r, np.nan), np.where(used, weight, 0.0),
    )  # fmt: skip


def _solve_velocities(
    raw: RawGnss, of: NDArray[np.intp], place: NDArray[np.intp], shape: tuple[int, int], x: Array, mask: float,
    robust: bool,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Velocities (E, 3) in e, clock drifts (E,) and covariances of the velocities in east, north, up."""
    E, S = shape
    antenna = x[of, :3]
    geometry = look(raw, antenna, None)
    scale = compute_stretch(raw, geometry)
    moving = rotate_earth(raw.v, geometry.distance / C)
    sigma = compute_rate_sigma(raw.cn0, np.maximum(geometry.elevation, 0.05))
    H = np.concatenate([-geometry.e / scale[:, None], np.ones((len(raw), 1))], axis=1)
    measured = raw.range_rate + np.nan_to_num(raw.drift) - np.sum(geometry.e * moving, axis=1) / scale
    good = np.isfinite(measured) & np.isfinite(H).all(axis=1) & (geometry.elevation >= mask)
    y, weight = np.zeros((E, 4)), np.ones(len(raw))

    pad = _plan_padding(of, place, (E, S))
    Hp = pad(np.where(good[:, None], H, 0.0))
    information = np.zeros((E, 4, 4))
    for k in range(6 if robust else 1):
        r = np.where(good, measured - np.sum(np.where(good[:, None], H, 0.0) * y[of], axis=1), 0.0)
        if k:
            weight = 1.0 / (1.0 + (r / (_KERNEL_SCALE * sigma)) ** 2)
        wp = pad(np.where(good, weight / sigma**2, 0.0))
        information = np.einsum("esi,es,esj->eij", Hp, wp, Hp, optimize=True)
        right = np.einsum("esi,es->ei", Hp, wp * pad(r), optimize=True)
        y = y + np.linalg.solve(information + np.eye(4) / _WEAK**2, right[..., None])[..., 0]
    P = np.linalg.inv(information + np.eye(4) / _WEAK**2)
    known = (np.bincount(of, weights=good, minlength=E) >= 4) & np.isfinite(x[:, 0])
    y[~known] = np.nan
    R = earth.enu_axes(earth.ecef_to_llh(np.where(known[:, None], x[:, :3], raw.place)))
    covariance = R @ P[:, :3, :3] @ np.swapaxes(R, -1, -2)
    covariance[~known | (np.trace(covariance, axis1=-2, axis2=-1) > 100.0)] = np.nan
    y[np.isnan(covariance[:, 0, 0])] = np.nan
    return y[:, :3], y[:, 3], covariance
