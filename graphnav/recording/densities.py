"""White noise of an IMU from a recording that moves.

Heel strikes are noisier than any data sheet, and figures stated for shoe-mounted IMUs are often generous for that. But
heel strikes are modelled separately (`graphnav.imu.unresolved`), and a gyro noise stated ten times too large leaves the
gyro bias ten times less known from the rests at both ends of a walk. So the noise of a walk is bounded by its quietest
stretch: means over a cluster, and of them second differences, in which a slow sway cancels. White noise of density q
gives each squared second difference the expectation 6 q^2 / cluster (the Allan variance has first differences, 2 q^2 /
cluster). The sway of a standing person adds to that, so the result is an upper bound; but the quietest of many
stretches is also quiet by chance, and the bound is one that true noise would undercut in less than `_CHANCE` of them.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv  # scipy.stats would take half a second to import

from graphnav.core.findings import compute_period
from graphnav.core.rotation import Array
from graphnav.core.running import sum_rows

_QUIET_SPAN = 5.0  # s
_REST, _STANCE = (2.0, 0.1), (0.3, 0.05)  # s, a stretch and its clusters
_CHANCE = 1e-3
_INDEPENDENT = 1.0 / (1.0 + 2.0 * ((4.0 / 6.0) ** 2 + (1.0 / 6.0) ** 2))  # of second differences: (1, -2, 1) overlap


def measure_densities(t: Array, gyro: Array, accel: Array, walks: bool) -> dict[str, float]:
    """Noise densities for a recording.toml, to two digits; none that cannot be measured.

    Parameters
    ----------
    t, gyro, accel : (N,) s, (N, 3) rad/s, (N, 3) m/s^2
    walks : whether the IMU is on a foot: then the quietest rest or stance bounds them.
    """
    found = {}
    for sensor, x in (("gyro", gyro), ("accel", accel)):
        value = min(bound_density(t, x), bound_density(t, x, *_STANCE)) if walks else estimate_density_in_motion(t, x)
        if 0.0 < value < np.inf:
            found[f"{sensor}_noise_density"] = float(f"{value:.2g}")
    return found


def estimate_density_in_motion(t: Array, x: Array) -> float:
    """Noise density of samples (N, 3), taken as white: between the quietest tenth of the log and its typical state.

    The Allan deviation times the root of its averaging time, which is constant for white noise; its minimum over times
    up to half a second, as vibration raises it at short ones and motion at long ones. That of the quietest tenth is the
    sensor's own; that of the median includes the vibration of the drive and, undesirably, its motion; the geometric
    mean of both is returned.
    """
    period = float(np.median(np.diff(t)))
    least = np.full(2, np.inf)
    m = 1
    while m * period <= 0.5 and len(x) // m > 4:
        means = x[: len(x) // m * m].reshape(-1, m, x.shape[1]).mean(1)
        squares = 0.5 * np.diff(means, axis=0) ** 2
        n = max(round(_QUIET_SPAN / (m * period)), 4)
        windows = squares[: len(squares) // n * n].reshape(-1, n, x.shape[1])
        if len(windows):
            variance = np.percentile(windows.mean(1), (10, 50), axis=0).mean(1)
            least = np.minimum(least, np.sqrt(variance * m * period))
        m *= 2
    return float(np.sqrt(least[0] * least[1])) if np.isfinite(least).all() else 0.0


def bound_density(t: Array, x: Array, length: float = _REST[0], cluster: float = _REST[1]) -> float:
    """Bound from above of the white noise density of rows x (N, 3) at times t (N,), per axis; infinite if too short.

    The quietest stretch of `length` s shows it, in means over `cluster` s.
    """
    period = compute_period(t)
    size = max(1, round(cluster / period)) if period < cluster else 1
    count, stretch = len(t) // size, round(length / (size * period)) if np.isfinite(period) else 1
    if stretch < 3 or count < stretch:
        return float("inf")
    n = count * size
    mean = x[:n].reshape(count, size, 3).mean(axis=1)
    bend = np.sum((mean[2:] - 2.0 * mean[1:-1] + mean[:-2]) ** 2, axis=1) / (3.0 * 6.0) * (size * period)
    degrees = 3.0 * (stretch - 2) * _INDEPENDENT
    quietest = float(sum_rows(bend[:, None]).compute_means(stretch - 2).min())
    return float(np.sqrt(quietest * degrees / (2.0 * gammaincinv(0.5 * degrees, _CHANCE))))
