"""Scale errors of an IMU at rest, where its noise alone is what they could multiply."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphnav import run
from graphnav.config import parse_settings
from graphnav.core.earth import EARTH_RATE, LocalFrame, gravity
from graphnav.imu.dynamics import SCALE
from graphnav.recording import Gnss, Imu, ImuNoise, Recording

SECONDS, RATE = 300, 20.0
PLACE = np.array([0.65, -2.1, 60.0])
WIDE = 0.03  # 1-sigma of the prior of scale errors; N intervals of pure noise shift them by N / (WIDE^-2 + N)
SIGMA = 0.001  # m and m/s of fixes: good enough to show the IMU's noise in every interval
AT_REST = {
    "alignment": {"heading": 0.0},
    "noise": {"mode": "stated"},
    "vehicle": {"nhc": False},
    "standstill": {"zero_velocity": False, "zero_rate": False, "held_position": False},
}


@pytest.fixture(scope="module", params=range(2))
def at_rest(request: pytest.FixtureRequest) -> Recording:
    rng, noise = np.random.default_rng(request.param), replace(ImuNoise(), accel_scale_sigma=WIDE)
    t = np.arange(1, round(SECONDS * RATE) + 1) / RATE
    gyro = EARTH_RATE * np.array([0.0, np.cos(PLACE[0]), np.sin(PLACE[0])])
    accel = np.array([0.0, 0.0, float(gravity(PLACE[0], PLACE[2]))])
    noisy = [
        x + density * np.sqrt(RATE) * rng.standard_normal((len(t), 3))
        for x, density in ((gyro, noise.gyro_noise_density), (accel, noise.accel_noise_density))
    ]
    fixes = np.arange(1.0, SECONDS)
    off, v = SIGMA * rng.standard_normal((2, len(fixes), 3))
    sd = np.full((len(fixes), 3), SIGMA)
    gnss = Gnss(fixes, LocalFrame(PLACE, 0.0).to_llh(off), sd, v, sd)
    return Recording("at rest", "vehicle", Imu(t, noisy[0], noisy[1], noise), gnss)


def test_noise_is_no_scale_error(at_rest: Recording) -> None:
    """With what was measured as the regressor, those of the level axes are 2 of their sigmas off."""
    for solution in run(at_rest, settings=parse_settings(AT_REST), solvers=("rts", "batch")).values():
        scale = solution.parameters[SCALE]
        # vehicles: five of the gyro, then accelerometer right and forward
        assert np.all(np.abs(scale.value[-1, 5:7]) < scale.sigma[-1, 5:7])
