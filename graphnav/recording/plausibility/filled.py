"""IMU rows that a logger filled in, or that a stuck sensor repeats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphnav.core.findings import period_of, runs_of
from graphnav.recording import Imu
from graphnav.recording.plausibility.readings import NOISY, RARE


def find_filled(imu: Imu) -> NDArray[np.bool_]:
    """Which rows lie, on all axes and to the last digit, on straight lines between two others, or repeat one row.

    A digit's step of q makes a measured value fit the line through its neighbours with a probability of at most
    2 q / (sqrt(2 pi) sigma), where sigma is that of the deviations in the quietest tenth of the seconds. Stretches are
    taken that one in a thousand recordings (`RARE`) would contain by chance. An axis without noise, as of a simulation,
    whose deviations seldom change their sign, does not count.

    Parameters
    ----------
    imu
        N rows.

    Returns
    -------
    (N,) True for rows within such stretches. None where most seconds have some: those of a slower sensor, resampled.
    """
    filled = np.zeros(len(imu.t), dtype=bool)
    n = max(5, round(1.0 / period_of(imu.t))) if len(imu.t) > 1 else 5
    if len(imu.t) < 10 * n:
        return filled
    share = np.diff(imu.t)[:-1] / (imu.t[2:] - imu.t[:-2])  # of the way from one neighbour to the other
    on_line, log_chance = np.ones(len(share), dtype=bool), 0.0
    for axis in range(6):  # one by one: for a day each temporary array takes a hundred megabytes
        x = (imu.gyro, imu.accel)[axis // 3] @ imu.R_bs[:, axis % 3]
        step = np.abs(np.diff(x))
        q = float(step.min(where=step > 1e-9 * np.abs(x).max(), initial=np.inf))
        off = x[1:-1] - (x[:-2] + share * (x[2:] - x[:-2]))
        noisy = float((off[1:] * off[:-1] < 0.0).mean()) > NOISY
        np.abs(off, out=off)
        sigma = np.percentile(np.median(off[: len(off) // n * n].reshape(-1, n), axis=1), 10.0) / 0.6745
        on_line &= off <= q
        if noisy and sigma > 0.0:
            log_chance += float(np.log(min(2.0 * q / (np.sqrt(2.0 * np.pi) * sigma), 1.0)))
    if np.median(on_line[: len(on_line) // n * n].reshape(-1, n).sum(axis=1)) > 0.0:
        return filled
    for a, b in runs_of(on_line):
        if (b - a) * log_chance < np.log(RARE / len(imu.t)):
            repeats = all((x[a] == x[b + 1]).all() for x in (imu.gyro, imu.accel))
            filled[a + 1 : b + 1 + repeats] = True  # the end of a line is measured, a repetition is not
    return filled
