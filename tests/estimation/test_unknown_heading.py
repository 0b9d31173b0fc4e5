"""Recordings whose fixes show no motion: the heading is unknown, and every sigma has to say so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import Array, at_rate
from numpy.random import default_rng

from graphnav import load, run
from graphnav.app.scores import score
from graphnav.config import Settings
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import get_key
from graphnav.core.state import BLOCKS
from graphnav.estimation.solution import Solution
from graphnav.evaluation.metrics import summarise
from graphnav.recording import Gnss, Imu, ImuNoise, Recording

SOLVERS = "ekf", "rts", "batch", "isam2"


@pytest.fixture(scope="module")
def parked(shared_data: Path) -> Recording:
    """Simulated: a car stands, its antenna .6 m away from the IMU in the level."""
    return at_rate(load(shared_data / "oracle_drive").crop(3.0, 25.0), 25.0)


@pytest.mark.parametrize("noise", ["stated", "estimated"])
def test_sigmas_hold_every_heading(parked: Recording, noise: str) -> None:
    """Nothing that is measured depends on the heading, so the truth may be turned about the antenna by any angle."""
    truth, gnss = parked.truth, parked.gnss
    assert truth is not None
    assert truth.rph is not None
    assert gnss is not None
    solved = run(parked, None, SOLVERS, noise=noise)
    told = [get_key(note) for one in score(parked, parked, solved, ())[0].values() for note in one.notes]
    assert "against.attitude" not in told  # which a heading is off by that nobody knows is no sign of other axes
    for solver, solution in solved.items():
        k = len(solution.t) // 2
        R = rotation.from_rph(truth.rph[[np.searchsorted(truth.t, solution.t[k])]])[0]
        antenna = solution.states.p[k] + solution.states.R_nb[k] @ gnss.lever_arm
        squares = []
        for turn in np.linspace(-np.pi, np.pi, 48, endpoint=False):
            R_true = rotation.exp(np.array([[0.0, 0.0, turn]]))[0] @ R
            off = solution.states.p[k] - (antenna - R_true @ gnss.lever_arm)
            of_heading = rotation.log((solution.states.R_nb[k].T @ R_true)[None])[0] @ solution.states.R_nb[k].T[:, 2]
            squares.append([*_square(solution, k, off), of_heading**2 / _variance_of_heading(solution, k)])
        level, heading = np.mean(squares, axis=0)
        # the mean square of a mixture is its covariance: one, but for the heading that chance makes a little likelier
        assert 0.7 < level < 1.8, solver
        assert 0.7 < heading < 1.8, solver


def test_standing_in_tokyo(shared_data: Path) -> None:
    """Real: the heights' sigmas of a standing car count all of its fixes as independent; estimated noise does not."""
    drive = at_rate(load(shared_data / "tokyo_20201105").crop(20.0, 90.0), 50.0)
    found = score(drive, drive, run(drive, solvers=("ekf", "rts")), ())[0]
    for solver, one in found.items():
        assert 0.3 < summarise(one)["nees_p"] < 3.0, solver


def test_wheels_lead_on_in_circles(shared_data: Path) -> None:
    """Simulated: fixes until a car starts, then none. Wheels and IMU tell its path, but for its heading."""
    drive = at_rate(load(shared_data / "oracle_drive").crop(40.0, 125.0), 25.0)
    used = drive.without("gnss", (36.0, np.inf))
    solved = run(used, solvers=("ekf", "rts", "batch"))
    for solver, one in score(drive, used, solved, ())[0].items():
        assert np.sqrt(_variance_of_heading(solved[solver], -1)) > np.radians(10.0), solver
        assert summarise(one)["nees_p"] < 4.0, solver
        assert "nhc" in solved[solver].records, solver


def test_a_walk_of_three_metres_tells_its_heading(shared_data: Path) -> None:
    """Real, with simulated fixes of 0.3 m, whose motion may be chance: with all steps they tell where it leads."""
    walk, rng, sd = load(shared_data / "pyshoe_vicon" / "2017-11-27-11-11-24.toml"), default_rng(4), 0.3
    truth, frame = walk.truth, LocalFrame(np.array([0.84, 0.19, 500.0]))
    assert truth is not None
    assert truth.xyz is not None
    t = np.arange(np.ceil(truth.t[0]), truth.t[-1])
    fixes = np.stack([np.interp(t, truth.t, x) for x in truth.xyz.T], axis=1) + rng.normal(0.0, sd, (len(t), 3))
    gnss = Gnss(t=t, llh=frame.to_llh(fixes), sd=np.full((len(t), 3), sd), lever_arm=np.zeros(3))
    solution = run(replace(walk, gnss=gnss, truth=None), solvers=("rts",), noise="stated")["rts"]
    assert "alignment.no_motion" in map(get_key, solution.notes)
    assert np.sqrt(_variance_of_heading(solution, 0)) < np.radians(6.0)
    t = truth.t[(truth.t > solution.t[0]) & (truth.t < solution.t[-1])][::50]
    _, states, P = solution.at(t)
    off = frame.from_llh(solution.frame.to_llh(states.p)) - np.stack([np.interp(t, truth.t, x) for x in truth.xyz.T], 1)
    nees = np.mean(np.einsum("ki,ki->k", off[:, :2], np.linalg.solve(P[:, 3:5, 3:5], off[:, :2, None])[..., 0])) / 2.0
    assert 0.1 < nees < 3.0


def test_noise_of_an_imu_at_rest_is_no_scale_error() -> None:
    """Simulated: the noise that a scale error would multiply draws it to where it explains the noise."""
    rate, seconds, rng = 10.0, 1500.0, default_rng(3)
    n = int(rate * seconds)
    noise = ImuNoise(gyro_noise_density=2e-4, accel_noise_density=2e-3, gyro_bias_walk=1e-7, accel_bias_walk=1e-6)
    gravity = np.array([-0.22, 0.6, 9.77])
    imu = Imu(
        t=np.arange(1, n + 1) / rate,
        gyro=rng.normal(0.0, 2e-4 * np.sqrt(rate), (n, 3)),
        accel=gravity + rng.normal(0.0, 2e-3 * np.sqrt(rate), (n, 3)),
        noise=noise,
    )
    m, sd = int(seconds), 0.02
    llh = np.radians([48.0, 11.0, 0.0]) + [0.0, 0.0, 500.0] + rng.normal(0.0, sd, (m, 3)) * [1.57e-7, 2.3e-7, 1.0]
    gnss = Gnss(t=np.arange(m) + 0.5, llh=llh, sd=np.full((m, 3), sd), lever_arm=np.array([0.3, 0.5, 1.2]))
    settings = Settings.model_validate({"alignment": {"heading": 20.0}})
    solution = run(Recording(name="parked", imu=imu, gnss=gnss, platform="vehicle"), settings, ("rts",))["rts"]
    assert solution.noise is not None
    figures = solution.noise.figures
    assert not {"prior.gyro_scale", "prior.accel_scale"} & set(figures)
    for name in ("imu.gyro_noise_density", "imu.accel_noise_density"):
        assert abs(figures[name].log_factor) < 0.3, name


def _square(solution: Solution, k: int, off: Array) -> list[float]:
    at = BLOCKS["p"]
    return [float(off[:2] @ np.linalg.solve(solution.covariance[k][at, at][:2, :2], off[:2])) / 2.0]


def _variance_of_heading(solution: Solution, k: int) -> float:
    up, at = solution.states.R_nb[k].T[:, 2], BLOCKS["theta"]
    return float(up @ solution.covariance[k][at, at] @ up)
