"""IMU rows that a logger filled in, or that a stuck sensor repeats.

They lie, on all axes and to the last digit, on straight lines between two others. A digit's step of q makes a measured
value fit the line through its neighbours with a probability of at most 2 q / (sqrt(2 pi) sigma), where sigma is that of
the deviations in the quietest tenth of the seconds, but for those in which nothing changes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphnav.core.findings import Finding, compute_period, find_runs
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array
from graphnav.recording.plausibility.readings import NOISY, RARE


@dataclass(frozen=True)
class StraightLines:
    """Test for rows on straight lines, as opposed to measured ones."""

    steps: tuple[float, ...]  # resolution of each axis
    log_chance: float  # probability of a measured row to lie on a line on all axes

    def hold(self, first: tuple[float, ...], middle: tuple[float, ...], last: tuple[float, ...]) -> bool:
        """Whether a row lies on the line between two others, each its time and its reading of every axis."""
        share = (middle[0] - first[0]) / (last[0] - first[0])
        for step, a, b, c in zip(self.steps, first[1:], middle[1:], last[1:], strict=True):
            if abs(b - a - share * (c - a)) > step:
                return False
        return True


def find_filled(t: Array, readings: Iterable[Array]) -> tuple[NDArray[np.bool_], StraightLines | None]:
    """Find rows that were not measured: stretches that one in a thousand recordings (`RARE`) would contain by chance.

    An axis without noise, as of a simulation, whose deviations seldom change their sign, does not count.

    Parameters
    ----------
    t : (N,) s.
    readings : (N,) along each axis of the sensors.

    Returns
    -------
    filled : (N,)
        True for rows within such stretches. None where most seconds have some: those of a slower sensor, resampled.
    lines : StraightLines or None
        For further rows; None for less than ten seconds, or rows of a slower sensor.
    """
    filled = np.zeros(len(t), dtype=bool)
    n = max(5, round(1.0 / compute_period(t))) if len(t) > 1 else 5
    if len(t) < 10 * n:
        return filled, None
    share = np.diff(t)[:-1] / (t[2:] - t[:-2])  # fraction of the interval from one neighbour to the other
    on_line, repeats = np.ones(len(share), dtype=bool), np.ones(len(share), dtype=bool)
    steps, noise = [], []
    for x in readings:  # one by one: for a day each temporary array takes a hundred megabytes
        step = np.abs(np.diff(x))
        repeats &= step[1:] == 0.0
        q = float(step.min(where=step > 1e-9 * np.abs(x).max(), initial=np.inf))
        off = x[1:-1] - (x[:-2] + share * (x[2:] - x[:-2]))
        if (off[1:] * off[:-1] < 0.0).mean() > NOISY:
            noise.append((q, np.median(_split_seconds(np.abs(off), n), axis=1)))
        on_line &= np.abs(off) <= q
        steps.append(q)
    log_chance, changing = 0.0, ~_split_seconds(repeats, n).all(axis=1)
    for q, off in noise if changing.any() else ():
        if (sigma := np.percentile(off[changing], 10.0) / 0.6745) > 0.0:
            log_chance += float(np.log(min(2.0 * q / (np.sqrt(2.0 * np.pi) * sigma), 1.0)))
    if np.median(_split_seconds(on_line, n).sum(axis=1)) > 0.0:
        return filled, None
    for a, b in find_runs(on_line):
        if (b - a) * log_chance < np.log(RARE / len(t)):
            # the end of a line is measured, a repetition is not
            filled[a + 1 : b + 1 + repeats[a:b].all()] = True
    return filled, StraightLines(tuple(steps), log_chance)


def _split_seconds(x: NDArray[Any], n: int) -> NDArray[Any]:
    """(seconds, n) of a series."""
    return x[: len(x) // n * n].reshape(-1, n)


def describe_filled(count: int, stretches: int, longest: float, where: str) -> Finding:
    """The finding on so many rows, in stretches of which the `longest` (s) is said to be `where`."""
    return Finding(
        "warning",
        f"{format_count(count, 'IMU row')} in {format_count(stretches, 'stretch', 'stretches')} lie on straight lines "
        f"or repeat one row (the longest, of {longest:.2f} s, at {where}): not measured",
        "imu.filled",
    )
