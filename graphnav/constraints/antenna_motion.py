"""Motion of an antenna at a fix and shortly before or after it, by the IMU."""

from __future__ import annotations

import numpy as np

from graphnav.core import rotation
from graphnav.core.rotation import Array, mv
from graphnav.core.state import States
from graphnav.recording import Imu

LEVER_ARM = "gnss_lever_arm"
LINEAR_OFFSET = 0.3  # s each side of a fix over which its motion is predicted (`graphnav.estimation.stamps`)
_HALF_WINDOW = 0.05  # s each side over which the turn rate at a fix is averaged
_OF_A_LINE = 2  # parameters; as many samples leave no residual
_ROWS_AT_ONCE = 4096
_I3 = np.eye(3)


def compute_antenna_velocity(
    states: States, gyro: Array, omega_n: Array, lever: Array
) -> tuple[Array, dict[str, Array]]:
    """v + R_nb (omega_nb x l) in n, (N, 3), and its derivatives by theta, v, bg and the lever arm."""
    R = states.R_nb
    omega_ie_b = omega_n @ R
    omega = gyro - states.bg - omega_ie_b
    RL = R @ rotation.skew(lever)
    swing = -mv(RL, omega)  # omega x lever, in n
    return states.v + swing, {
        "theta": RL @ rotation.skew(omega_ie_b) - rotation.skew(swing) @ R,
        "v": _I3[None],
        "bg": RL,
        LEVER_ARM: R @ rotation.skew(omega),
    }


def compute_acceleration(
    states: States, force: Array, slope: Array, gyro: Array, g_n: Array, ahead: Array
) -> tuple[Array, Array, dict[str, Array]]:
    """Acceleration in n (N, 3), m/s^2, its derivative by the time h after the states, and those by theta, ba and bg.

    R_nb (f_b - b_a + (df_b/dt + (omega_b - b_g) x f_b) h) + g, for h up to `LINEAR_OFFSET` either way.

    Parameters
    ----------
    force, slope : (N, 3) m/s^2 and m/s^3, measured specific force and its rate of change in body axes.
    gyro : (N, 3) rad/s, measured.
    g_n : (N, 3) m/s^2, gravity.
    ahead : (N, 1) s, h.
    """
    R, h = states.R_nb, np.clip(ahead, -LINEAR_OFFSET, LINEAR_OFFSET)
    jerk = slope + mv(rotation.skew(gyro - states.bg), force)
    then = force - states.ba + jerk * h
    by_bg = R @ rotation.skew(force) * h[..., None]
    by_time = np.where(h == ahead, mv(R, jerk), 0.0)
    return mv(R, then) + g_n, by_time, {"theta": -R @ rotation.skew(then), "ba": -R, "bg": by_bg}


def average_around(imu: Imu, x: Array, t: Array) -> Array:
    """(N, 3) mean of an IMU signal around times t: vibration in a single sample, times the lever arm, would be
    noise.
    """
    lo, hi = _find_samples(imu, t, _HALF_WINDOW)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(x, axis=0)])
    return (total[hi] - total[lo]) / (hi - lo)[:, None]


def fit_force_line(imu: Imu, t: Array) -> tuple[Array, Array]:
    """Measured specific force (N, 3) at times t, m/s^2, and its rate of change (N, 3), m/s^3.

    The line that fits the samples within `LINEAR_OFFSET` best. In a regression on a force with vibration in it, an
    offset of stamps is estimated too small (Fuller 1987, "Measurement Error Models", eq. 1.1.7): by a quarter with a
    tenth of a second of samples of 100 Hz in a car.
    """
    lo, hi = _find_samples(imu, t, LINEAR_OFFSET)
    force, slope = np.empty((len(t), 3)), np.empty((len(t), 3))
    for begin in range(0, len(t), _ROWS_AT_ONCE):
        rows = slice(begin, begin + _ROWS_AT_ONCE)
        at = lo[rows, None] + np.arange((hi - lo)[rows].max())
        inside = at < hi[rows, None]
        at = np.minimum(at, len(imu.t) - 1)
        # times from the row's: sums over hours would cancel
        u, n = np.where(inside, imu.t[at] - t[rows, None], 0.0), inside.sum(axis=1)
        f = np.where(inside[..., None], imu.accel[at], 0.0)
        middle, mean = u.sum(axis=1) / n, f.sum(axis=1) / n[:, None]
        spread = (u * u).sum(axis=1) / n - middle**2
        known = (n > _OF_A_LINE) & (spread > 0.0)
        covariance = np.einsum("ij,ijk->ik", u, f) / n[:, None] - middle[:, None] * mean
        slope[rows] = np.where(known[:, None], covariance / np.where(known, spread, 1.0)[:, None], 0.0)
        force[rows] = mean - slope[rows] * middle[:, None]
    return force, slope


def _find_samples(imu: Imu, t: Array, half: float) -> tuple[Array, Array]:
    """First and last index, exclusive, of the samples around times t (N,): at least one."""
    lo = np.searchsorted(imu.t, t - half)
    hi = np.maximum(np.searchsorted(imu.t, t + half), lo + 1)
    return np.minimum(lo, len(imu.t) - 1), np.minimum(hi, len(imu.t))
