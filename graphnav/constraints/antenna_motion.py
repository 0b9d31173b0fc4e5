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
_FEWEST = 4  # samples that a line is fitted to
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
    jerk = slope + np.cross(gyro - states.bg, force)
    then = force - states.ba + jerk * h
    by_bg = R @ rotation.skew(force) * h[..., None]
    by_time = np.where(h == ahead, mv(R, jerk), 0.0)
    return mv(R, then) + g_n, by_time, {"theta": -R @ rotation.skew(then), "ba": -R, "bg": by_bg}


def average_around(imu: Imu, x: Array, t: Array) -> Array:
    """(N, 3) mean of an IMU signal around times t: vibration in a single sample, times the lever arm, would be
    noise.
    """
    lo, hi = _find_samples(imu, t, _HALF_WINDOW)
    return (_sum_before(x)[hi] - _sum_before(x)[lo]) / (hi - lo)[:, None]


def fit_force_line(imu: Imu, t: Array) -> tuple[Array, Array]:
    """Measured specific force (N, 3) at times t, m/s^2, and its rate of change (N, 3), m/s^3.

    The line that fits the samples within `LINEAR_OFFSET` best. In a regression on a force with vibration in it, an
    offset of stamps is estimated too small (Fuller 1987, "Measurement Error Models", eq. 1.1.7): by a quarter with a
    tenth of a second of samples of 100 Hz in a car.
    """
    lo, hi = _find_samples(imu, t, LINEAR_OFFSET)
    since, n = imu.t - imu.t[0], (hi - lo)[:, None]
    mean = (_sum_before(imu.accel)[hi] - _sum_before(imu.accel)[lo]) / n
    moments = _sum_before(np.stack([since, since**2], axis=-1))
    middle, square = ((moments[hi] - moments[lo]) / n).T
    spread = square - middle**2
    product = _sum_before(since[:, None] * imu.accel)
    slope = (product[hi] - product[lo]) / n - middle[:, None] * mean
    some = (n >= _FEWEST) & (spread[:, None] > 0.0)
    slope = np.where(some, slope / np.where(some, spread[:, None], 1.0), 0.0)
    return mean + slope * (t - imu.t[0] - middle)[:, None], slope


def _find_samples(imu: Imu, t: Array, half: float) -> tuple[Array, Array]:
    """First and last index, exclusive, of the samples around times t (N,): at least one."""
    lo = np.searchsorted(imu.t, t - half)
    hi = np.maximum(np.searchsorted(imu.t, t + half), lo + 1)
    return np.minimum(lo, len(imu.t) - 1), np.minimum(hi, len(imu.t))


def _sum_before(x: Array) -> Array:
    """(N+1, k) sums of the rows of x (N, k) before each."""
    return np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
