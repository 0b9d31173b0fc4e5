"""Is the stated uncertainty true? Squared errors over their own variances, averaged over drives made anew."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import oracle
import pytest
from helpers import Array, at_rate, errors
from scipy.special import chdtri

from graphnav.app.scores import score
from graphnav.config import parse_settings
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.pipeline import SOLVERS, run
from graphnav.estimation.solution import Solution
from graphnav.recording import Recording
from graphnav.simulation import Simulated, simulate

SEEDS, TOWNS = 6, 10
RATE = 100.0  # Hz, of the truth; the IMU has a quarter of it, keyframes are a second apart
# Wheels and stops hold exactly on these drives, which no sigma is made for; simulated ones that slip and sway are in
# `tests/constraints/test_vehicle.py`.
INERTIAL = {
    "vehicle": {"nhc": False, "odometer": False},
    "standstill": {"zero_velocity": False, "zero_rate": False, "held_position": False},
}
# Errors of the fixes are white and as stated, which is what stated noise says; estimated, the noise has to be found
STATED = INERTIAL | {"noise": {"mode": "stated"}}
CAUSAL_AND_NOT = ("ekf", "rts")  # a batch solution has the same rows
AXES = ("east", "north", "up", "ve", "vn", "vu", "roll", "pitch", "heading")
# Errors of smoothers stay alike for a minute, of attitude and biases for the whole drive: a drive of ten minutes is
# taken for four independent samples. 3 % tails of chi-square
LOW, HIGH = (float(chdtri(4 * SEEDS, p)) / (4 * SEEDS) for p in (0.97, 0.03))
WHOLE = [float(chdtri(12 * SEEDS, p)) / (12 * SEEDS) for p in (0.97, 0.03)]  # of three axes together
# one outage a drive, two axes: 99 % of chi-square
DARK = [float(chdtri(2 * SEEDS, p)) / (2 * SEEDS) for p in (0.995, 0.005)]
# s from which a solver is judged. The filter starts where the alignment ended up, with a sigma several times wider, so
# its first seconds are better than it says; it must not be worse at any time
SETTLED = {"ekf": 30.0, "rts": 0.0, "batch": 0.0}


@dataclass(frozen=True)
class Score:
    nees: Array  # (9,) per axis
    unsettled: Array  # (9,) the same from the first keyframe
    whole: float  # of position, e n u together, over 3
    outage: float  # of horizontal position inside the outage, over 2


def scored(
    drives: list[tuple[Recording, Trajectory]], settings: dict[str, dict[str, Any]], solvers: tuple[str, ...] = SOLVERS
) -> dict[str, Score]:
    early: dict[str, list[Array]] = {name: [] for name in solvers}
    per_axis: dict[str, list[Array]] = {name: [] for name in solvers}
    whole: dict[str, list[float]] = {name: [] for name in solvers}
    dark: dict[str, list[float]] = {name: [] for name in solvers}
    for recording, truth in drives:
        exact = replace(recording.imu.noise, gyro_scale_sigma=0.0, accel_scale_sigma=0.0)  # as these axes are
        known = at_rate(replace(recording, imu=replace(recording.imu, noise=exact)), RATE / 4.0)
        for name, solution in run(known, parse_settings(settings), solvers).items():
            position, sd_p, rph, sd_rph = errors(solution, truth)
            velocity, sd_v = velocity_errors(solution, truth)
            ratio = np.concatenate([position / sd_p, velocity / sd_v, rph / sd_rph], axis=1) ** 2
            late = solution.t > solution.t[0] + SETTLED[name]
            per_axis[name].append(ratio[late].mean(axis=0))
            early[name].append(ratio.mean(axis=0))
            C = solution.trajectory().covariance
            assert C is not None
            full = np.einsum("ki,kij,kj->k", position, np.linalg.inv(C[:, :3, :3]), position)
            whole[name].append(float(full[late].mean() / 3))
            inside = (solution.t > 425.0) & (solution.t < 465.0)
            dark[name].append(float(ratio[inside, :2].mean()))
    return {
        n: Score(*(np.mean(x[n], axis=0) for x in (per_axis, early)), float(np.mean(whole[n])), float(np.mean(dark[n])))
        for n in solvers
    }


def velocity_errors(solution: Solution, truth: Trajectory) -> tuple[Array, Array]:
    """(velocity error e n u, its sigma) at every keyframe, m/s."""
    mine = solution.trajectory()
    assert mine.sd_v is not None
    return mine.v - truth.v[np.searchsorted(truth.t, mine.t - 1e-6)], mine.sd_v


@pytest.fixture(scope="module")
def drives(shared_data: Path) -> list[tuple[Recording, Trajectory]]:
    return [oracle.oracle_drive(shared_data, seed, odometer=False, rate=RATE) for seed in range(SEEDS)]


@pytest.fixture(scope="module")
def estimated(drives: list[tuple[Recording, Trajectory]]) -> dict[str, Score]:
    return scored(drives, INERTIAL)


@pytest.fixture(scope="module")
def velocities(shared_data: Path) -> dict[str, Score]:
    path = oracle.oracle_truth_path(shared_data, RATE)
    drives = [
        oracle.drive(path, seed=50 + seed, gnss_velocity_sd=(0.05, 0.05, 0.08), outages=((415.0, 475.0),))
        for seed in range(SEEDS)
    ]
    return scored(drives, STATED, CAUSAL_AND_NOT)


def assert_consistent(score: Score) -> None:
    assert np.all((score.nees > LOW) & (score.nees < HIGH)), dict(zip(AXES, score.nees.round(2), strict=True))
    assert np.all(score.unsettled < HIGH), dict(zip(AXES, score.unsettled.round(2), strict=True))
    assert WHOLE[0] < score.whole < WHOLE[1]
    assert DARK[0] < score.outage < DARK[1]


@pytest.mark.parametrize("solver", SOLVERS)
def test_with_estimated_noise(estimated: dict[str, Score], solver: str) -> None:
    assert_consistent(estimated[solver])


@pytest.mark.parametrize("solver", CAUSAL_AND_NOT)
def test_with_positions_and_velocities(velocities: dict[str, Score], solver: str) -> None:
    assert_consistent(velocities[solver])


@pytest.fixture(scope="module")
def towns() -> list[tuple[Simulated, dict[str, Solution]]]:
    """Simulated drives through a town, and the smoother's solutions."""
    drives = [simulate("electric", seed, duration=300.0, tunnels=0, rate=50.0) for seed in range(TOWNS)]
    return [(one, run(one.recording, solvers="rts")) for one in drives]


def test_simulated_towns(towns: list[tuple[Simulated, dict[str, Solution]]]) -> None:
    """Errors of attitudes last for the whole of a drive: three numbers each."""
    found = []
    for one, solutions in towns:
        solution = solutions["rts"]
        position, sd_p, rph, sd_rph = errors(solution, one.truth)
        velocity, sd_v = velocity_errors(solution, one.truth)
        found.append([np.mean((e / sd) ** 2) for e, sd in ((position, sd_p), (velocity, sd_v), (rph, sd_rph))])
    low, high = (float(chdtri(3 * TOWNS, p)) / (3 * TOWNS) for p in (0.995, 0.005))
    nees = np.mean(found, axis=0)
    assert nees.max() < high, nees.round(2)
    assert nees[1:].min() > low, nees.round(2)  # fixes are better than stated, so positions are


def test_between_keyframes(towns: list[tuple[Simulated, dict[str, Solution]]]) -> None:
    """At stops the velocity is known to a tenth of a millimetre a second where a row says so, and not between rows."""
    one, solutions = towns[4]
    found = score(one.recording, one.recording, solutions, ())[0]["rts"].errors
    assert np.nanmean(found.nees_v) / 3.0 < 1.5
