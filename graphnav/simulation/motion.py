"""The driver: successive manoeuvres as smooth functions of time.

The motion is that of the point that does not slip sideways (the middle of the rear axle), and of the road under it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from graphnav.core.errors import ConfigError
from graphnav.core.findings import find_runs
from graphnav.core.rotation import Array
from graphnav.simulation.splines import list_centres, make_spline

PATH_STEP = 0.1  # s between coefficients: a driver does not act faster
CUBIC = 3  # the acceleration is smooth, the jerk continuous
SETTLE = (CUBIC - 1) / 2 * PATH_STEP  # s by which the spline of a speed that ends on the grid extends beyond its end

SPEED, HEADING, SLOPE, BANK, SLIP = range(5)  # channels of Path.spline


@dataclass(frozen=True)
class Manoeuvre:
    """One manoeuvre. The speed changes linearly through it; turn and slope change with the distance covered.

    `speed` is the speed at its end, m/s, negative in reverse; `turn` the change of heading, deg, to the right positive;
    `grade` the slope at its end, rise over run; `bank` the road's fall to the right at its end, deg. None keeps the
    previous value.
    """

    duration: float  # s
    speed: float
    turn: float = 0.0
    grade: float | None = None
    bank: float | None = None


@dataclass(frozen=True)
class Path:
    """Speed (m/s, signed), heading, slope, bank and side-slip (rad) as one spline of five channels."""

    spline: BSpline
    start: float  # s
    end: float

    def sample(self, channel: int, t: Array) -> Array:
        """One channel at times within the path (the nearest end beyond it)."""
        return self.spline(np.clip(t, self.start, self.end))[..., channel]

    def compute_speed(self, t: Array) -> Array:
        """Signed speed of the rear axle, m/s."""
        return self.sample(SPEED, t)

    def compute_distance(self, t: Array) -> Array:
        """Distance along the path from the start, m, backward motion counted negative."""
        whole = self.spline.antiderivative()
        return whole(np.clip(t, self.start, self.end))[..., SPEED] - whole(self.start)[SPEED]

    def find_stops(self) -> Array:
        """(M, 2) s: the spans in which the wheels do not turn at all."""
        zero = np.asarray(self.spline.c[:, SPEED] == 0.0)
        whole = np.asarray(np.lib.stride_tricks.sliding_window_view(zero, CUBIC + 1).all(axis=1))
        spans = [(self.start + a * PATH_STEP, min(self.start + b * PATH_STEP, self.end)) for a, b in find_runs(whole)]
        return np.array(spans, dtype=float).reshape(-1, 2)


def make_path(
    manoeuvres: Sequence[Manoeuvre], *, start: float = 0.0, heading: float = 0.0, slip_per_accel: float = 0.0
) -> Path:
    """The path of `manoeuvres` from a standstill at `start` s, facing `heading` deg from north.

    `slip_per_accel`, rad/(m/s^2): side slip of the rear axle, outward, per lateral acceleration.

    Raises
    ------
    ConfigError
        If a manoeuvre turns on the spot, changes between forward and reverse, or has no duration.
    """
    durations = np.array([m.duration for m in manoeuvres], dtype=float)
    if len(durations) == 0 or durations.min() <= 0:
        raise ConfigError("a drive needs manoeuvres that each take some time", key="manoeuvre.time")
    edges = start + np.r_[0.0, np.cumsum(durations)]
    v1 = np.array([m.speed for m in manoeuvres], dtype=float)
    v0 = np.r_[0.0, v1[:-1]]
    length = 0.5 * (v0 + v1) * durations
    for k, m in enumerate(manoeuvres):
        if v0[k] * v1[k] < 0:
            raise ConfigError(
                f"manoeuvre {k}: stop before changing between forward and reverse", key="manoeuvre.direction"
            )
        if m.turn and length[k] == 0:
            raise ConfigError(f"manoeuvre {k}: cannot turn on the spot", key="manoeuvre.on_the_spot")

    t = list_centres(start, float(edges[-1]), PATH_STEP, CUBIC)
    i = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(durations) - 1)
    u = np.clip((t - edges[i]) / durations[i], 0.0, 1.0)
    gain = v1[i] - v0[i]
    speed = v0[i] + gain * u * u * (3.0 - 2.0 * u)
    speed[np.abs(speed) < 1e-9] = 0.0  # of a manoeuvre whose end rounding puts beside the grid
    covered = (v0[i] * u + gain * (u**3 - 0.5 * u**4)) * durations[i]
    share = np.divide(covered, length[i], out=np.zeros_like(t), where=length[i] != 0)
    share = share * share * (3.0 - 2.0 * share)

    def place_along(ends: Sequence[float], first: float) -> Array:
        last, before = np.array(ends, dtype=float), np.r_[first, ends[:-1]]
        # where no distance is covered, nothing can change
        last = np.where(length == 0, before, last)
        return before[i] + (last - before)[i] * share

    turned = heading + np.cumsum([m.turn for m in manoeuvres])
    psi = np.deg2rad(place_along(list(turned), heading))
    slope = np.arctan(place_along(_hold_last([m.grade for m in manoeuvres]), 0.0))
    bank = np.deg2rad(place_along(_hold_last([m.bank for m in manoeuvres]), 0.0))
    slip = slip_per_accel * speed * np.gradient(psi, PATH_STEP)
    return Path(
        make_spline(start, PATH_STEP, np.column_stack([speed, psi, slope, bank, slip]), CUBIC), start, float(edges[-1])
    )


def _hold_last(values: Sequence[float | None]) -> list[float]:
    """Values with None replaced by the one before, 0 at first."""
    out, last = [], 0.0
    for value in values:
        last = last if value is None else float(value)
        out.append(last)
    return out
