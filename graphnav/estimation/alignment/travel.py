"""Displacement of a platform in its own axes, from fixes, and the part of it that their errors explain.

A displacement over ground shows little of a vehicle that circles or creeps. So steps from fix to fix are rotated back
into the axes of the platform, by the gyro, and only then summed,

    D = sum of (p_i - p_i-1) r_i,      r_i: the turn from the axes at i to those at the start,

which grows with the distance on any course. Summed by parts, the errors e_i of the fixes enter D at both ends, and in
between multiplied by the rotation of the axes, e_i (r_i - r_i+1). That contribution depends on how long errors last.
For a Gauss-Markov process of variance s^2 and correlation time T, rotating at the rate w, it has the variance 2 T w^2
s^2 / (1 + w^2 T^2) per second, with the maximum w s^2 at T = 1/w. As T is unknown, along each axis

    var D  <=  s^2 (2 + total turn in rad)

whatever T is. The direction of D in the body is that of travel, to sqrt(var D) / |D|.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Imu

# m, 1-sigma along an axis: motion of an antenna on a vehicle that does not travel; suspension, load, a mast
_ANTENNA_SWAY = 0.4


@dataclass(frozen=True)
class Travel:
    """Distance travelled since the first of N points."""

    D: NDArray[np.complex128]  # (N,) m, forward + i left where `yaw` is of forward from east
    sigma: Array  # (N,) m, along one axis
    turn: Array  # (N,) rad, all turns since the start, either way

    @property
    def times_sigma(self) -> Array:
        """(N,) distance in sigmas."""
        return np.abs(self.D) / self.sigma


def measure_travel(p: Array, sd: Array, yaw: Array, still: NDArray[np.bool_] | None = None) -> Travel:
    """Distance travelled along points.

    The path between two points is a chord up to a turn of a radian between them; beyond, it is unknown.

    Parameters
    ----------
    p : (N, 2) m, east and north.
    sd : (N,) m, 1-sigma of a point along one axis.
    yaw : (N,) rad, what a level axis of the body has turned counter-clockwise, whole circles included.
    still : (N,) points at which the platform stands; between two of them no distance is counted.
    """
    moves = np.ones(len(p) - 1) if still is None else 1.0 - (still[1:] & still[:-1])
    angle = moves * np.abs(np.diff(yaw))
    variance = sd**2 + _ANTENNA_SWAY**2
    seen = angle < 1.0
    step = seen * moves * np.diff(p[:, 0] + 1j * p[:, 1]) * np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
    angle = np.where(seen, angle, 2.0)  # the end of one path and the beginning of another
    within = np.concatenate([[0.0], np.cumsum(angle * variance[1:])])
    D, turn = (np.concatenate([[0.0], np.cumsum(x)]) for x in (step, angle))
    return Travel(D, np.sqrt(variance[0] + variance + within), turn)


def average_across(sd: Array) -> Array:
    """(N,) m, 1-sigma along one horizontal axis of fixes with `sd` (N, 3)."""
    return np.sqrt(np.mean(sd[:, :2] ** 2, axis=1))


def integrate_yaw(imu: Imu, t: Array, bias: Array) -> Array:
    """(N,) rad, rotation of the body about up since the first of the times `t`, counter-clockwise, by the gyro.

    Up is the mean specific force from each time to the next: acceleration tilts it by a few degrees, of which the turn
    rate keeps the cosine. `bias` (3,) rad/s.
    """
    samples = bridge_gaps(imu)
    edges = np.concatenate([[samples.start], samples.t])
    dt = np.diff(edges)[:, None]
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum((samples.gyro - bias) * dt, axis=0)])
    force = np.concatenate([np.zeros((1, 3)), np.cumsum(samples.accel * dt, axis=0)])
    angle, force = (np.stack([np.interp(t, edges, x[:, k]) for k in range(3)], -1) for x in (angle, force))
    up = np.diff(force, axis=0)
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    return np.concatenate([[0.0], np.cumsum(np.sum(np.diff(angle, axis=0) * up, axis=1))])
