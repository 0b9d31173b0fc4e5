"""Errors of an IMU by the figures of a data sheet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphnav.core.earth import MG
from graphnav.core.rotation import Array
from graphnav.recording import ACROSS, ImuNoise
from graphnav.simulation.splines import make_random
from graphnav.simulation.vibration import draw_gauss_markov

_DEG = np.pi / 180.0
DEG_H = _DEG / 3600.0  # rad/s
DEG_SQRT_H = _DEG / 60.0  # rad/s/sqrt(Hz)


@dataclass(frozen=True)
class Triad:
    """Three equal sensors at right angles, SI (rad/s or m/s^2).

    All figures are 1-sigma, drawn for each seed. The in-run instability is a Gauss-Markov process of this sigma: its
    Allan deviation has its maximum, 0.62 sigma, at 1.9 correlation times, where a flicker floor of the same name has
    0.66.
    """

    noise: float  # per sqrt(Hz)
    bias: float  # at turn-on
    instability: float = 0.0
    correlation_time: float = 300.0  # s, of the instability
    walk: float = 0.0  # per sqrt(s), random walk of the bias
    scale: float = 0.0  # 1
    misalignment: float = 0.0  # rad, of each axis towards each other one
    limit: float = np.inf  # readings beyond it are clipped
    step: float = 0.0  # resolution

    @property
    def bias_walk(self) -> float:
        """The random walk that is equivalent to the bias over times short against the correlation time."""
        return float(np.hypot(self.walk, self.instability * np.sqrt(2.0 / self.correlation_time)))

    def read(self, true: Array, rate: float, rng: np.random.Generator) -> tuple[Array, Array]:
        """(readings, bias in each), (N, 3), of true means (N, 3) over the sample periods."""
        n, dt = len(true), 1.0 / rate
        bias = self.bias * rng.standard_normal(3) + np.zeros((n, 3))
        scale = self.scale * rng.standard_normal(3)
        across = self.misalignment * rng.standard_normal((3, 3)) * (1.0 - np.eye(3))
        white = rng.standard_normal((n, 3))
        drift = draw_gauss_markov(n, dt / self.correlation_time, rng, 3)
        steps = rng.standard_normal((n, 3))
        bias = bias + self.instability * drift + self.walk * np.sqrt(dt) * np.cumsum(steps, axis=0)
        M = np.eye(3) + np.diag(scale) + across
        out = true @ M.T + bias + self.noise / np.sqrt(dt) * white
        out = np.clip(out, -self.limit, self.limit)
        return (np.round(out / self.step) * self.step if self.step else out), bias


def make_gyroscope(
    arw_deg_sqrt_h: float, bias_deg_h: float, *, instability_deg_h: float = 0.0, rrw_deg_h_sqrt_h: float = 0.0,
    scale_ppm: float = 0.0, misalignment_mrad: float = 0.0, range_deg_s: float = np.inf, step_deg_s: float = 0.0,
    correlation_time: float = 300.0,
) -> Triad:  # fmt: skip
    """A triad from a gyroscope's data sheet: angle random walk, turn-on bias, rate random walk, ..."""
    return Triad(
        arw_deg_sqrt_h * DEG_SQRT_H, bias_deg_h * DEG_H, instability_deg_h * DEG_H, correlation_time,
        rrw_deg_h_sqrt_h * DEG_H / 60.0, scale_ppm * 1e-6, misalignment_mrad * 1e-3, range_deg_s * _DEG,
        step_deg_s * _DEG,
    )  # fmt: skip


def make_accelerometer(
    vrw_ug_sqrt_hz: float, bias_mg: float, *, instability_mg: float = 0.0, walk_mg_sqrt_h: float = 0.0,
    scale_ppm: float = 0.0, misalignment_mrad: float = 0.0, range_g: float = np.inf, step_mg: float = 0.0,
    correlation_time: float = 300.0,
) -> Triad:  # fmt: skip
    """A triad from an accelerometer's data sheet; 1 g is 9.80665 m/s^2."""
    return Triad(
        vrw_ug_sqrt_hz * 1e-3 * MG, bias_mg * MG, instability_mg * MG, correlation_time,
        walk_mg_sqrt_h * MG / 60.0, scale_ppm * 1e-6, misalignment_mrad * 1e-3, range_g * 1e3 * MG, step_mg * MG,
    )  # fmt: skip


@dataclass(frozen=True)
class SimulatedImu:
    """An IMU: two triads and a rate, Hz."""

    name: str
    rate: float
    gyro: Triad
    accel: Triad

    @property
    def noise(self) -> ImuNoise:
        """The figures that a recording states for it; the scale's covers a misalignment."""
        return ImuNoise(
            gyro_noise_density=self.gyro.noise,
            accel_noise_density=self.accel.noise,
            # a filter needs some random walk; at least a change of 1 % of the bias in an hour
            gyro_bias_walk=max(self.gyro.bias_walk, 1e-2 * self.gyro.bias / 60.0),
            accel_bias_walk=max(self.accel.bias_walk, 1e-2 * self.accel.bias / 60.0),
            gyro_bias_sigma=self.gyro.bias,
            accel_bias_sigma=self.accel.bias,
            gyro_scale_sigma=max(self.gyro.scale, self.gyro.misalignment / ACROSS),
            accel_scale_sigma=max(self.accel.scale, self.accel.misalignment / ACROSS),
        )

    def read(self, gyro: Array, accel: Array, seed: int) -> tuple[Array, Array, Array, Array]:
        """(gyro, accel, gyro bias, accel bias), (N, 3) each, of true samples."""
        g, b_g = self.gyro.read(gyro, self.rate, make_random(seed, "gyro"))
        a, b_a = self.accel.read(accel, self.rate, make_random(seed, "accel"))
        return g, a, b_g, b_a

    def change_rate(self, rate: float) -> SimulatedImu:
        """The same sensors sampled at another rate."""
        return replace(self, rate=float(rate))


# Consumer-grade, the PwrPak7-E2's EG370N of Li 2024 (table 1), the MIMU of Zhu 2020 (table 1), navigation-grade.
MEMS = SimulatedImu(
    "MEMS", 100.0,
    make_gyroscope(0.3, 700.0, instability_deg_h=8.0, scale_ppm=2000.0, misalignment_mrad=1.0, range_deg_s=250.0,
              step_deg_s=250.0 / 32768),
    make_accelerometer(150.0, 15.0, instability_mg=0.05, scale_ppm=2000.0, misalignment_mrad=1.0, range_g=4.0,
                  step_mg=4000.0 / 32768),
)  # fmt: skip
EG370N = SimulatedImu(
    "MEMS of Li 2024, table 1", 200.0,
    make_gyroscope(0.06, 360.0, instability_deg_h=0.8),
    make_accelerometer(60.0, 2.0, instability_mg=0.012),
)  # fmt: skip
# "White noise 0.1 degree/h" and "0.05 mg" are taken as 0.1 deg/sqrt(h) and 50 ug/sqrt(Hz), as data sheets of such
# sensors state them.
MIMU = SimulatedImu(
    "MIMU of Zhu 2020, table 1", 400.0,
    make_gyroscope(0.1, 3.0, instability_deg_h=1.0, scale_ppm=200.0),
    make_accelerometer(50.0, 0.1, instability_mg=0.03, scale_ppm=150.0),
)  # fmt: skip
