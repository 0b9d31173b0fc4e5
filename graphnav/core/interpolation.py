"""A trajectory at other times and at another point of the body, with its covariance.

Positions by the cubic Hermite polynomial through both ends and their velocities (off by at most dt^4 / 384 max |p''''|,
e.g. Stoer and Bulirsch, *Introduction to Numerical Analysis*, 2.1.5), velocity in body axes, rotated by the
interpolated attitude, and attitude along the shortest arc.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory

_SAME_TIME = 1e-6  # s; resolution of a time stamp in a text file


def interpolate(
    trajectory: Trajectory, t: Array, *, max_gap: float = 3.0, lever_arm: Array | None = None
) -> tuple[Trajectory, Array]:
    """Interpolate a trajectory to other times, never outside its span and never across a gap.

    Without a covariance one is made of the sigmas (NaN where there are none). Biases are dropped; the type of a fix and
    its satellites are those of the nearest row.

    Parameters
    ----------
    trajectory
        The trajectory.
    t
        (N,) s.
    max_gap
        s, longest gap between rows that is interpolated; a time that falls on a row needs no neighbour.
    lever_arm
        (3,) m, right, forward, up: position, velocity and covariance are those of the point at its end; (K, 3)
        where each row has its own, in force until the next. Rows without attitude are not moved, and without an
        attitude sigma the sigmas are unchanged.

    Returns
    -------
    trajectory : Trajectory
        At the M times that can be interpolated.
    mask : array of bool
        (N,), True for those times.
    """
    k, s, ok = _bracket(trajectory.t, np.asarray(t, dtype=float), max_gap)
    k, s, t = k[ok], s[ok, None], np.asarray(t, dtype=float)[ok]
    nxt = np.minimum(k + 1, len(trajectory) - 1)
    dt = (trajectory.t[nxt] - trajectory.t[k])[:, None]

    frame = LocalFrame(trajectory.llh[0]) if trajectory.frame == "geodetic" else None
    slope = differentiate(trajectory, max_gap) if trajectory.v is None else None
    if lever_arm is None and 4 * len(t) < len(trajectory):  # rates need the rows around
        rows = np.union1d(k, nxt)
        trajectory, k, nxt = trajectory.take(rows), np.searchsorted(rows, k), np.searchsorted(rows, nxt)
        slope = None if slope is None else slope[rows]
    p = trajectory.llh if frame is None else frame.from_llh(trajectory.llh)
    R_nl = None if frame is None else np.swapaxes(frame.R_ln(p), -1, -2)
    v = trajectory.v if R_nl is None or trajectory.v is None else np.einsum("kij,kj->ki", R_nl, trajectory.v)
    R_lb = trajectory.R_lb
    R = R_lb if R_nl is None or R_lb is None else R_nl @ R_lb

    omega = None
    R_at = None
    if R is not None:
        R_at = R[k] @ rotation.exp(s * rotation.log(np.swapaxes(R[k], -1, -2) @ R[nxt]))
        if lever_arm is not None:
            rate = _compute_rates(trajectory.t, R)
            omega = _blend(rate[k], rate[nxt], s)
    p_at = _blend(p[k], p[nxt], s)
    slope = v if slope is None else slope
    assert slope is not None
    hermite = p_at + s * (1 - s) * ((1 - 2 * s) * (p[k] - p[nxt]) + dt * ((1 - s) * slope[k] - s * slope[nxt]))
    p_at = np.where(np.isfinite(hermite), hermite, p_at)
    v_at = None
    if v is not None:
        v_at = _blend(v[k], v[nxt], s)
        if R is not None and R_at is not None:
            seen = _blend(_apply(np.swapaxes(R[k], -1, -2), v[k]), _apply(np.swapaxes(R[nxt], -1, -2), v[nxt]), s)
            turned = _apply(R_at, seen)
            v_at = np.where(np.isfinite(turned), turned, v_at)
    cov = fill_covariance(trajectory)
    cov_at = None if cov is None else _blend(cov[k], cov[nxt], s[:, :, None])

    swing, arm = None, np.zeros(3)
    if lever_arm is not None and R_at is not None and omega is not None:
        arm = np.broadcast_to(np.asarray(lever_arm, dtype=float), trajectory.llh.shape)[k]
        swing = _apply(rotation.skew(omega), arm)
        step = _apply(R_at, arm)
        p_at = p_at + np.where(np.isfinite(step), step, 0.0)
        v_at = None if v_at is None else v_at + _apply(R_at, swing)

    R_ln = None if frame is None else frame.R_ln(p_at)
    if R_ln is not None:
        v_at = None if v_at is None else _apply(R_ln, v_at)
        R_at = None if R_at is None else R_ln @ R_at
    rph = None if R_at is None else rotation.to_rph(R_at)
    known = cov_at is not None and bool(np.isfinite(cov_at[:, 6:9, 6:9]).all((1, 2)).any())
    if known and cov_at is not None and swing is not None and rph is not None and R_at is not None:
        cov_at = _move_to_point(cov_at, R_at, rph, arm, swing)
    near = np.where(s[:, 0] > 0.5, nxt, k)  # the nearest row, whose fix type is taken
    out = replace(
        trajectory, t=t, llh=p_at if frame is None else frame.to_llh(p_at), v=v_at, rph=rph,
        sd_p=_take_sigmas(cov_at, 0, None), sd_v=_take_sigmas(cov_at, 3, None), sd_rph=_take_sigmas(cov_at, 6, None),
        gyro_bias=None, accel_bias=None, covariance=cov_at,
        fix_type=None if trajectory.fix_type is None else trajectory.fix_type[near],
        satellites=None if trajectory.satellites is None else trajectory.satellites[near],
    )  # fmt: skip
    return out, ok


def pick_nearest(rows: Array, t: Array) -> NDArray[np.intp]:
    """The nearest of N > 0 rows, whose times (N,) are in order, to each time (M,); of two as near the later."""
    right = np.minimum(np.searchsorted(rows, t), len(rows) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(rows[left] - t) < np.abs(rows[right] - t), left, right)


def keep_apart(t: Array, least: float) -> Array:
    """The first of times (N,), in order, and each that is `least` or more after the one before; none needs later."""
    out = [float(t[0])]
    for x in t.tolist():
        if x - out[-1] >= least:
            out.append(x)
    return np.array(out)


def differentiate(trajectory: Trajectory, max_gap: float) -> Array:
    """Velocities (K, 3) in m/s of a trajectory's positions, in its local frame or that of its first row.

    By cubic splines that end at gaps of more than `max_gap` s; NaN for a single row.
    """
    from scipy.interpolate import CubicSpline

    p = trajectory.llh if trajectory.frame == "local" else LocalFrame(trajectory.llh[0]).from_llh(trajectory.llh)
    v = np.full(p.shape, np.nan)
    for axis in range(3):
        rows = np.flatnonzero(np.isfinite(p[:, axis]))
        for part in np.split(rows, np.flatnonzero(np.diff(trajectory.t[rows]) > max_gap) + 1):
            if len(part) > 1:
                v[part, axis] = CubicSpline(trajectory.t[part], p[part, axis])(trajectory.t[part], 1)
    return v


def fill_covariance(trajectory: Trajectory) -> Array | None:
    """The covariance (K, 9, 9), or a diagonal one made of the sigmas, NaN where they are missing."""
    if trajectory.covariance is not None:
        return trajectory.covariance
    parts = (trajectory.sd_p, trajectory.sd_v, trajectory.sd_rph)
    if all(part is None for part in parts):
        return None
    missing = np.full((len(trajectory), 3), np.nan)
    sd = np.concatenate([missing if part is None else part for part in parts], axis=1)
    cov = np.zeros((len(trajectory), 9, 9))
    cov[:, np.arange(9), np.arange(9)] = sd**2
    return cov


def fit_yaw(source: Array, target: Array) -> tuple[float, Array]:
    """Yaw (rad, anticlockwise) and offset (3,) that bring points `source` (N, 3) closest to `target` (N, 3).

    Least squares over the horizontal, in closed form (Umeyama, PAMI 13(4), 1991, with the rotation held
    to one axis); the vertical offset is the mean difference, NaN where the source has no height.
    """
    a, b = source[:, :2], target[:, :2]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    yaw = float(np.arctan2(np.sum(a0[:, 0] * b0[:, 1] - a0[:, 1] * b0[:, 0]), np.sum(a0 * b0)))
    offset = b.mean(0) - make_yaw_matrix(yaw)[:2, :2] @ a.mean(0)
    return yaw, np.append(offset, np.mean(target[:, 2] - source[:, 2]))


def make_yaw_matrix(yaw: float) -> Array:
    """Rotation about up by `yaw` rad, anticlockwise, (3, 3)."""
    return rotation.exp(np.array([0.0, 0.0, yaw]))


def place_on_earth(trajectory: Trajectory, frame: LocalFrame, yaw: float, offset: Array) -> Trajectory:
    """Place a trajectory of a local frame on the Earth: p_n = Rz(yaw) p + offset in `frame`."""
    R_nm = make_yaw_matrix(yaw)
    p_n = trajectory.llh @ R_nm.T + offset
    R_lm = frame.R_ln(p_n) @ R_nm
    cov = trajectory.covariance if trajectory.covariance is not None else fill_covariance(trajectory)
    if cov is not None:
        turn = np.zeros((9, 9))
        turn[0:3, 0:3] = turn[3:6, 3:6] = R_nm
        turn[6:9, 6:9] = np.eye(3)
        cov = _propagate(turn, cov)
    R_lb = trajectory.R_lb
    return replace(
        trajectory, llh=frame.to_llh(p_n), frame="geodetic", covariance=cov,
        v=None if trajectory.v is None else _apply(R_lm, trajectory.v),
        rph=None if R_lb is None else rotation.to_rph(R_lm @ R_lb),
        sd_p=_take_sigmas(cov, 0, trajectory.sd_p), sd_v=_take_sigmas(cov, 3, trajectory.sd_v),
    )  # fmt: skip


def _bracket(times: Array, t: Array, max_gap: float) -> tuple[Any, Array, Any]:
    """The row before each time, the fraction of the interval to the next, and whether both may be used."""
    k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, max(len(times) - 2, 0))
    dt = times[np.minimum(k + 1, len(times) - 1)] - times[k]
    s = np.clip((t - times[k]) / np.where(dt > 0, dt, 1.0), 0.0, 1.0)
    inside = (t >= times[0] - _SAME_TIME) & (t <= times[-1] + _SAME_TIME)
    on_row = np.minimum(s, 1 - s) * dt <= _SAME_TIME
    return k, s, inside & ((dt <= max_gap) | on_row)


def _compute_rates(t: Array, R: Array) -> Array:
    """Body rates (K, 3), rad/s, at the rows: central differences that weight the nearer neighbour more."""
    if len(t) < 2:
        return np.zeros((len(t), 3))
    dt = np.diff(t)[:, None]
    rate = rotation.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) / dt
    inner = (rate[:-1] * dt[1:] + rate[1:] * dt[:-1]) / (dt[1:] + dt[:-1])
    return np.concatenate([rate[:1], inner, rate[-1:]])


def _blend(a: Array, b: Array, s: Array) -> Array:
    # not a + s (b - a): a NaN neighbour must not affect a time that falls on a row
    return np.where(s == 0, a, np.where(s == 1, b, (1 - s) * a + s * b))


def _apply(R: Array, v: Array) -> Array:
    return np.einsum("...ij,...j->...i", R, v)


def _propagate(A: Array, cov: Array) -> Array:
    """A P A' in which a NaN in P affects only the variances it enters."""
    out = A @ np.nan_to_num(cov) @ np.swapaxes(A, -1, -2)
    missing = np.isnan(np.diagonal(cov, axis1=-2, axis2=-1)).astype(float)
    spoilt = np.einsum("...ij,...j->...i", np.abs(A) > 0, missing) > 0
    return np.where(spoilt[..., :, None] | spoilt[..., None, :], np.nan, out)


def _move_to_point(cov: Array, R_lb: Array, rph: Array, arm: Array, swing: Array) -> Array:
    """Covariance of the point at the end of a lever arm: d(R l) = -R [l]x theta, d(R (w x l)) alike."""
    to_theta = np.linalg.inv(rotation.rph_jacobian(rph))
    A = np.broadcast_to(np.eye(9), cov.shape).copy()
    A[:, 0:3, 6:9] = -R_lb @ rotation.skew(arm) @ to_theta
    A[:, 3:6, 6:9] = -R_lb @ rotation.skew(swing) @ to_theta
    return _propagate(A, cov)


def _take_sigmas(cov: Array | None, first: int, had: Array | None) -> Array | None:
    if cov is None:
        return had
    variance = np.diagonal(cov, axis1=-2, axis2=-1)[:, first : first + 3]
    return np.sqrt(np.maximum(variance, 0.0))
