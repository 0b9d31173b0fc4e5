"""Covariances of preintegrated intervals: white noise of the samples, and bias random walks within an interval.

The sums are derived in `graphnav.imu.preintegration`. Arrays of pieces run along the first axis, intervals along the
last: (L, ..., n).
"""

from __future__ import annotations

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.running import sum_running

_WALK_POINTS = 6  # quadrature points for the effect of bias random walks within an interval


def take_last(x: Array) -> Array:
    """The last element of (L, ..., n) along the first axis, as (n, ...)."""
    x = x[-1]
    return np.ascontiguousarray(x.transpose(x.ndim - 1, *range(x.ndim - 1)))


def compute_white_variances(
    density: float, extra: Array, dt: Array, index: Array, edge: Array, cut: Array
) -> tuple[Array, Array]:
    """Variances of the integral of white noise over each cell between the edges.

    Parameters
    ----------
    density : of the sensor, alike along all axes.
    extra : (N, 3) densities squared in addition, along the body's axes, of each sample.
    dt, index : (pieces, n) of each piece, s, and its sample.
    edge, cut : (L + 1, n) s and (L + 1,) pieces where cells begin and end.

    Returns
    -------
    alike : (L, n)
        Along all axes.
    along : (L, 3, n)
        In addition along each axis of the body; (0, 3, n) where there is none.
    """
    alike, n = density**2 * (edge[1:] - edge[:-1]), edge.shape[1]
    own = extra[index]  # one for all samples is not copied whole
    if not own.any():
        return alike, np.empty((0, 3, n))
    along = np.diff(sum_running(np.swapaxes(own, 1, 2) * dt[:, None])[cut], axis=0)
    least = along.min(axis=1)
    along -= least[:, None]
    return alike + least, along if along.any() else np.empty((0, 3, n))


def compute_white_covariance(qg: Array, qa: Array, left: Array, a_edge: Array, b_edge: Array) -> Array:
    """Covariance (n, 15, 15), start frame, of white noise with variances qg, qa (L, n) in each cell."""
    ab = np.concatenate([a_edge, b_edge], axis=1)
    ab = 0.5 * (ab[:-1] + ab[1:])
    s, dt = 0.5 * (left[:-1] + left[1:]), left[:-1] - left[1:]
    weighted = qg[:, None] * ab
    moment = weighted.sum(0).T
    products = np.einsum("lin,ljn->nij", weighted, ab)  # sum q [a; b] [a; b]^T
    eye = np.eye(3)
    Q = np.zeros((qg.shape[1], 15, 15))
    theta, p, v = slice(0, 3), slice(3, 6), slice(6, 9)
    a, b = slice(0, 3), slice(3, 6)

    def sum_outer(x: slice, y: slice, own: Array) -> Array:
        """sum qg ([x]x [y]x^T) = sum qg (x.y I - y x^T), and a variance on the diagonal"""
        yx = products[:, y, x]
        return (np.trace(yx, axis1=-2, axis2=-1) + own)[:, None, None] * eye - yx

    Q[:, theta, theta] = qg.sum(0)[:, None, None] * eye
    Q[:, theta, v], Q[:, theta, p] = rotation.skew(moment[:, a]), rotation.skew(moment[:, b])
    Q[:, v, v] = sum_outer(a, a, qa.sum(0))
    Q[:, v, p] = sum_outer(a, b, (qa * s).sum(0))
    # force noise inside a cell also moves the position: dt^2/12 keeps one-cell intervals regular
    Q[:, p, p] = sum_outer(b, b, (qa * (s * s + dt * dt / 12.0)).sum(0))
    for x, y in ((theta, v), (theta, p), (v, p)):
        Q[:, y, x] = np.swapaxes(Q[:, x, y], -1, -2)
    return Q


def compute_directed_covariance(of_gyro: Array, of_accel: Array, R: Array, left: Array, a: Array, b: Array) -> Array:
    """Covariance (n, 15, 15), start frame, of white noise with other variances along each axis of the body.

    By the trapezoidal rule: an error by u of the angle at a time moves the velocity at the end by u x a and the
    position by u x b, one of the velocity the position by that times what is `left`.

    Parameters
    ----------
    of_gyro, of_accel : (L, 3, n) variances of the integrals over each cell along the body's axes; L is 0 where there
        are none.
    R, left, a, b : (L + 1, 3, 3, n), (L + 1, n) and (L + 1, 3, n) at the edges.
    """
    Q = np.zeros((R.shape[-1], 15, 15))
    effects = np.zeros((2, *R.shape[:1], 9, *R.shape[2:]))
    effects[0, :, 0:3], effects[1, :, 6:9] = R, R
    effects[0, :, 3:6], effects[0, :, 6:9] = (np.cross(R, x[:, :, None], axis=1) for x in (b, a))
    effects[1, :, 3:6] = R * left[:, None, None]
    for along, effect in zip((of_gyro, of_accel), effects, strict=True):
        if len(along):
            weight = np.zeros((len(R), *along.shape[1:]))
            weight[:-1] += 0.5 * along
            weight[1:] += 0.5 * along
            flat = (effect * np.sqrt(weight)[:, None]).transpose(3, 1, 0, 2).reshape(len(Q), 9, -1)
            Q[:, :9, :9] += flat @ np.swapaxes(flat, -1, -2)
    return Q


def compute_walk_covariances(
    edge: Array, left: Array, A: Array, B: Array, PA: Array, PB: Array, a: Array, b: Array
) -> tuple[Array, Array]:
    """Covariances (n, 15, 15), start frame, of bias random walks of unit density within the interval, by midpoint
    quadrature.

    First that of the gyro's bias, then that of the accelerometer's.
    """
    n = edge.shape[1]
    T = edge[-1]
    target = T * ((np.arange(_WALK_POINTS) + 0.5) / _WALK_POINTS)[:, None]
    at = np.abs(edge[:, None] - target).argmin(axis=0).T  # the edge nearest to each quadrature point
    row = np.arange(n)[:, None]
    s = left[at, row][..., None, None]
    # effect of a change of the gyro's bias, and of one of the accelerometer's
    M = np.zeros((n, _WALK_POINTS, 15, 6))
    eye = np.eye(3)
    A_t, B_t, PA_t, PB_t = (x[at, :, :, row] for x in (A, B, PA, PB))
    A_T, B_T, PA_T, PB_T = (take_last(x)[:, None] for x in (A, B, PA, PB))
    turned = A_T - A_t
    M[..., 0:3, :3] = turned
    M[..., 3:6, :3] = PB_T - PB_t - B_t * s + rotation.skew(b[at, :, row]) @ A_t
    M[..., 6:9, :3] = B_T - B_t + rotation.skew(a[at, :, row]) @ A_t
    M[..., 12:15, :3] = eye
    M[..., 3:6, 3:] = PA_T - PA_t - A_t * s
    M[..., 6:9, 3:] = turned
    M[..., 9:12, 3:] = eye
    out = []
    for triad in (slice(0, 3), slice(3, 6)):
        flat = np.swapaxes(M[..., triad], 1, 2).reshape(n, 15, -1)
        out.append(np.asarray((T / _WALK_POINTS)[:, None, None] * (flat @ np.swapaxes(flat, -1, -2))))
    return out[0], out[1]
