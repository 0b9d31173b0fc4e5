"""A barometer and a second antenna with realistic errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.sensors import Series, barometer, dual_antenna
from graphnav.simulation.aiding import Span, Three
from graphnav.simulation.kinematics import TrueMotion
from graphnav.simulation.splines import make_random
from graphnav.simulation.vibration import draw_gauss_markov


def _list_whole_periods(motion: TrueMotion, rate: float) -> Array:
    """Whole periods from the start of a drive on, s."""
    t0, t1 = motion.t[0], motion.t[-1]
    return np.asarray(t0 + np.arange(int((t1 - t0) * rate + 1e-6) + 1) / rate)


@dataclass(frozen=True)
class BarometerModel:
    """Air pressure at the IMU: white noise, changing weather, and a non-standard atmosphere."""

    rate: float = 10.0  # Hz
    # chips resolve 0.012 hPa, 0.1 m (MS5611); the rest is due to wind and the vehicle's ventilation
    white: float = 0.5  # m
    weather: float = 85.0  # m, 1-sigma: pressures of a region differ by 10 hPa from day to day
    walk: float = 0.1  # m/sqrt(s): 1.5 hPa in three hours
    scale: float = 0.03  # 1-sigma: 9 K from the standard atmosphere's temperature

    def read(self, motion: TrueMotion, seed: int) -> tuple[Series, dict[str, float]]:
        """Simulate the readings of a drive; returns also their offset (m, at the start) and scale error."""
        t, rng = _list_whole_periods(motion, self.rate), make_random(seed, "barometer")
        offset, scale = self.weather * rng.standard_normal(), self.scale * rng.standard_normal()
        white, steps = rng.standard_normal((2, len(t)))
        steps[0] = 0.0
        h = motion.point(t, np.zeros(3))[0][:, 2]
        z = h + scale * (h - h[0]) + offset + self.walk / np.sqrt(self.rate) * np.cumsum(steps) + self.white * white
        columns = {"pressure": np.round(barometer.compute_standard_pressure(z), 2)}
        figures = {"sigma": self.white, "walk": self.walk}
        return barometer.SENSOR.make_series(np.round(t, 6), columns, **figures), {
            "offset_m": offset,
            "scale_error": scale,
        }


@dataclass(frozen=True)
class DualAntennaModel:
    """Heading and pitch from the first antenna to the second: white and slow (Gauss-Markov) errors, and a mounting.

    Carriers are good to 5 mm, 0.3 deg over a metre, and multipath makes more than half of that last for a while. Up is
    twice as bad as along the ground, as of any fix. The sigma stated is that of both errors together.
    """

    baseline: Three = (1.0, 0.0, 0.0)  # m, first to second antenna as stated, IMU's axes
    turned: float = 1.0  # deg, 1-sigma of the mounting against the stated baseline: 2 cm in a metre
    white: float = 0.2  # deg, of a baseline of a metre
    slow: float = 0.23  # deg, the same
    slow_time: float = 60.0  # s
    rate: float = 1.0  # Hz
    outages: tuple[Span, ...] = ()

    def read(self, motion: TrueMotion, seed: int) -> tuple[Series, dict[str, float]]:
        """Simulate the readings of a drive; returns also the error of the baseline in heading and pitch, deg."""
        t, rng = _list_whole_periods(motion, self.rate), make_random(seed, "second antenna")
        turned = np.radians(self.turned) * rng.standard_normal(2)
        white = rng.standard_normal((len(t), 2))
        slow = draw_gauss_markov(
            len(t), 1.0 / (self.rate * self.slow_time), make_random(seed, "second antenna slow"), 2
        )
        b = np.array(self.baseline)
        first, second = (motion.point(t, at)[0] for at in (np.zeros(3), b))
        frame = LocalFrame(first[0])
        p = frame.from_llh(first)
        d = rotation.mv(frame.R_ln(p), frame.from_llh(second) - p)
        true = np.stack([np.arctan2(d[:, 0], d[:, 1]), np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1]))], -1)
        worse = np.radians([1.0, 2.0]) / np.linalg.norm(b)
        angles = true + turned + worse * (self.white * white + self.slow * slow)
        sd = np.tile(worse * np.hypot(self.white, self.slow), (len(t), 1))
        kept = (
            ~np.any([(t >= a) & (t <= b) for a, b in self.outages], axis=0) if self.outages else np.full(len(t), True)
        )
        columns: dict[str, Any] = {
            "heading": np.mod(angles[:, 0], 2.0 * np.pi), "pitch": angles[:, 1], "sd_heading": sd[:, 0],
            "sd_pitch": sd[:, 1],
        }  # fmt: skip
        series = dual_antenna.SENSOR.make_series(
            np.round(t[kept], 6), {name: _round_angle(x[kept]) for name, x in columns.items()},
            baseline=self.baseline, baseline_sigma=self.turned,
        )  # fmt: skip
        return series, {"heading_deg": float(np.degrees(turned[0])), "pitch_deg": float(np.degrees(turned[1]))}


def _round_angle(angle: Array) -> Array:
    """Rounded to the digits of a file: a ten-thousandth of a degree."""
    return np.radians(np.round(np.degrees(angle), 4))
