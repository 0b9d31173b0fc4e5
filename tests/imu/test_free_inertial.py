"""Inertial navigation alone, from error-free samples of another program: what is left is graphnav's own error."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import oracle
import pytest
from helpers import Array, truth_states

from graphnav.config import parse_settings
from graphnav.core import rotation as ro
from graphnav.core.earth import LocalFrame
from graphnav.core.state import States
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.pipeline import run
from graphnav.imu.dynamics import ImuFactors
from graphnav.imu.preintegration import integrate_prefix, preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Recording

LATITUDES = (30.0, -45.0, 70.0)
DEG = np.pi / 180.0


@lru_cache(maxsize=4)
def exact(lat: float) -> tuple[Recording, Trajectory]:
    return oracle.drive(oracle.vehicle_path(600.0, lat=lat), imu_noise=None, gnss_exact=True)


def propagated(recording: Recording, truth: Trajectory, t: Array, frame: LocalFrame) -> States:
    """From the exact first state through all intervals, one after the other."""
    zero = np.zeros(3)
    motion = ImuFactors(preintegrate(bridge_gaps(recording.imu), recording.imu, t, zero, zero), frame)
    chain = [truth_states(truth, t[:1], frame)]
    for k in range(len(t) - 1):
        chain.append(motion.propagate(slice(k, k + 1), chain[-1])[0])
    return States.stack(chain)


def missed(states: States, truth: Trajectory, t: Array, frame: LocalFrame) -> tuple[Array, Array]:
    """(position error in local ENU m, roll-pitch-heading error rad)."""
    true = truth_states(truth, t, frame)
    R_ln = frame.R_ln(true.p)
    rph = [ro.to_rph(R_ln @ x.R_nb) for x in (states, true)]
    return np.einsum("kij,kj->ki", R_ln, states.p - true.p), ro.wrap(rph[0] - rph[1])


@pytest.mark.parametrize(("lat", "rate"), [*((lat, 1.0) for lat in LATITUDES), (LATITUDES[0], 10.0)])
def test_ten_minutes(lat: float, rate: float) -> None:
    recording, truth = exact(lat)
    frame = LocalFrame(truth.llh[0])
    t = np.arange(int(600 * rate) + 1) / rate
    position, rph = missed(propagated(recording, truth, t, frame), truth, t, frame)
    assert np.linalg.norm(position[:, :2], axis=1).max() < 0.05
    # the vertical runs away as cosh(t sqrt(2g/r)), and python-ins takes gravity off with height by 2 h/A
    assert np.abs(position[:, 2]).max() < 0.15
    assert np.abs(rph).max() < 1e-4 * DEG


@pytest.mark.parametrize("lat", LATITUDES)
def test_the_frame_s_origin_does_not_matter(lat: float) -> None:
    """Fifty kilometres from the origin of its frame the drive comes out the same."""
    recording, truth = exact(lat)
    far = truth.llh[0] + [0.3 * DEG, 0.4 * DEG, -100.0]
    t = np.arange(601.0)
    ends = []
    for frame in (LocalFrame(truth.llh[0]), LocalFrame(far)):
        position, rph = missed(propagated(recording, truth, t, frame), truth, t, frame)
        ends.append(np.column_stack([position, rph / DEG]))
    np.testing.assert_allclose(ends[1][:, :2], ends[0][:, :2], atol=0.02)
    np.testing.assert_allclose(ends[1][:, 3:], ends[0][:, 3:], atol=2e-5)


def test_one_interval_of_ten_seconds_is_ten_of_one() -> None:
    """Gravity is taken to change evenly over an interval, so what is left is braking: 100 m at 1.5e-6 1/s^2."""
    recording, truth = exact(30.0)
    frame = LocalFrame(truth.llh[0])
    worst = np.zeros(15)
    for k in range(20, 580, 40):
        coarse = propagated(recording, truth, np.array([k, k + 10.0]), frame)
        fine = propagated(recording, truth, np.arange(k, k + 11.0), frame)
        worst = np.maximum(worst, np.abs(coarse.minus(fine[np.array([0, 10])])[1]))
    assert worst[:3].max() < 1e-9
    assert worst[3:6].max() < 3e-3
    assert worst[6:9].max() < 1e-3


def test_prefix_gives_the_states_in_between() -> None:
    """A state at any time by `integrate_prefix`, wrapped as an interval of its own, as `preintegrate` gives it."""
    recording, _ = exact(30.0)
    samples, zero = bridge_gaps(recording.imu), np.zeros(3)
    t = 100.0 + np.array([0.0, 0.005, 0.5, 1.0, 7.5])
    dR, dV, dP = integrate_prefix(samples, t[0], t[1:], zero, zero)
    for k in range(1, len(t)):
        iv = preintegrate(samples, recording.imu, t[[0, k]], zero, zero)
        np.testing.assert_allclose(dR[k - 1], iv.dR[0], atol=1e-12)
        np.testing.assert_allclose(np.r_[dV[k - 1], dP[k - 1]], np.r_[iv.dV[0], iv.dP[0]], atol=1e-10)


@pytest.fixture(scope="module")
def straight() -> tuple[Recording, Trajectory]:
    path = oracle.straight_path(100e3, rate=20.0)
    assert path.length == pytest.approx(100e3, abs=50.0)
    return oracle.drive(path, imu_noise=None, gnss_exact=True)


def test_a_hundred_kilometres_straight_keep_level(straight: tuple[Recording, Trajectory]) -> None:
    """Roll and pitch against the local level, which turns by 0.9 deg on the way."""
    recording, truth = straight
    frame = LocalFrame(truth.llh[0])
    t = np.arange(np.floor(truth.t[-1]) + 1.0)
    _, rph = missed(propagated(recording, truth, t, frame), truth, t, frame)
    assert np.linalg.norm(truth_states(truth, t[-1:], frame).p) > 99e3
    assert np.abs(rph[:, :2]).max() < 1e-4 * DEG
    assert np.abs(rph[:, 2]).max() < 1e-4 * DEG


def test_a_hundred_kilometres_with_gnss_keep_level(straight: tuple[Recording, Trajectory]) -> None:
    """Through the batch solver: no tilt that grows with the distance from the frame's origin."""
    recording, truth = straight
    settings = parse_settings({"gnss": {"time_offset_sigma": 0.0}, "noise": {"mode": "stated"}})
    solution = run(recording, settings, solvers=("batch",))["batch"]
    t = np.round(solution.t, 6)
    position, rph = missed(solution.states, truth, t, solution.frame)
    late = t > 600.0
    assert np.abs(position[late, :2]).max() < 0.002
    slope = np.polyfit(t[late], rph[late, :2] / DEG, 1)[0] * (t[-1] - 600.0)
    assert np.abs(slope).max() < 3e-4  # deg over 80 km, of the 0.75 deg that the level turns
    assert np.abs(rph[late, :2]).max() < 1e-3 * DEG
