"""The first state against the truth and its own sigma: standing, moving, backing out, with a large gyro bias."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import oracle
import pytest
from helpers import Array, truth_states

from graphnav.config import Settings, parse_settings
from graphnav.core import rotation as ro
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import get_key
from graphnav.core.trajectory import Trajectory
from graphnav.detectors import detect
from graphnav.estimation.alignment import Alignment, align, motion, use_known_heading
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.recording import Recording

DEG = np.pi / 180.0


def aligned(recording: Recording, settings: Settings | None = None) -> tuple[Alignment, LocalFrame]:
    frame, settings = LocalFrame(recording.gnss.llh[0]), settings or Settings()
    return align(recording, settings, frame, detect(recording, settings).stationary), frame


def judged(recording: Recording, truth: Trajectory, body: Array | None = None) -> tuple[Array, Array, Array]:
    """(error of roll, pitch, heading, own sigma, prior errors over prior sigmas) at the first sample.

    `body` re-mounts the truth.
    """
    found, frame = aligned(recording)
    t = np.array([np.round(recording.start, 6)])
    true = truth_states(truth, t, frame)
    if body is not None:
        turn = body.T
        true = replace(true, R_nb=true.R_nb @ turn, ba=true.ba @ turn, bg=true.bg @ turn)
    assert found.sigma.shape == (15,)
    error = found.state.minus(true)[0]
    rph = ro.wrap(found.rph - ro.to_rph(true.R_nb[0]))
    return rph, found.own_sigma, error / found.sigma


def assert_good(error: Array, own: Array, over: Array) -> None:
    assert np.all(np.abs(error) < 4.0 * own), f"{error / DEG} deg against {own / DEG}"
    # the prior that the solvers start from is wider than that, and must cover every block
    assert np.all(np.abs(over) < 4.0), over
    assert abs(error[2]) < 10.0 * DEG
    assert np.all(np.abs(error[:2]) < 2.0 * DEG)


@pytest.fixture(scope="module")
def path() -> oracle.ExactPath:
    return oracle.vehicle_path(240.0, 50.0, seed=1)


@pytest.mark.parametrize("seed", range(2))
def test_a_drive_that_stands_first(path: oracle.ExactPath, seed: int) -> None:
    recording, truth = oracle.drive(path, seed=seed)
    assert path.speed[: round(10 / path.dt)].max() == 0
    assert_good(*judged(recording, truth))


@pytest.mark.parametrize("begin", [35.0, 52.0, 75.0, 95.0])
@pytest.mark.parametrize("sd", [oracle.RTK_SD, oracle.SPP_SD], ids=["rtk", "spp"])
def test_a_drive_cut_in_motion(path: oracle.ExactPath, begin: float, sd: tuple[float, float, float]) -> None:
    recording, truth = oracle.drive(path, seed=2, gnss_sd=sd)
    assert path.speed[round(begin / path.dt)] > 3.0
    assert_good(*judged(recording.crop(begin), truth))


def test_a_steady_drive_before_its_first_fix_is_no_stand(path: oracle.ExactPath) -> None:
    """The IMU of a car at constant speed reads what it reads at rest."""
    recording, truth = oracle.drive(path, seed=2)
    speed, size = path.speed, round(10.0 / path.dt)  # of a window that starts at each time
    steady = np.lib.stride_tricks.sliding_window_view(speed, size)
    begin = float(path.dt * np.argmax((np.ptp(steady, axis=1) < 0.1) & (steady.min(axis=1) > 5.0)))
    assert begin > 0.0
    part = recording.crop(begin)
    assert_good(*judged(part.without("gnss", (0.0, 15.0)), truth))


@pytest.mark.parametrize("begin", [52.0, 75.0, 95.0])
def test_wheels_that_read_no_sign_turn_forwards_before_the_first_fix(path: oracle.ExactPath, begin: float) -> None:
    recording, truth = oracle.drive(path, seed=2, odometer_rate=10.0, gnss_sd=oracle.SPP_SD)
    odometer = recording.odometer
    assert odometer is not None
    unsigned = replace(recording, odometer=replace(odometer, signed=False)).crop(begin)
    assert unsigned.odometer.speed[0] > 3.0
    dark = unsigned.without("gnss", (0.0, 40.0))
    found, _ = aligned(dark)
    error, own, over = judged(dark, truth)
    assert np.all(np.abs(error) < 4.0 * own)
    assert np.all(np.abs(over) < 4.0)
    assert found.state.v[0] @ found.state.R_nb[0][:, 1] == pytest.approx(dark.odometer.speed[0], rel=0.1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("stated", [1.0, 0.01])
def test_sigmas_of_fixes_that_are_too_small(path: oracle.ExactPath, seed: int, stated: float) -> None:
    """A robust kernel with a scale a hundred times too small fits a few fixes exactly, and leaves the others."""
    recording, truth = oracle.drive(path, seed=seed, gnss_sd=oracle.SPP_SD)
    recording = recording.crop(52.0)
    gnss = recording.gnss
    assert gnss is not None
    error, own, over = judged(replace(recording, gnss=replace(gnss, sd=stated * gnss.sd)), truth)
    assert np.all(np.abs(error) < 4.0 * own), f"{error / DEG} deg against {own / DEG}"
    assert np.all(np.abs(over) < 4.0), over


def remounted(recording: Recording, R: Array) -> Recording:
    """The same drive with the IMU's axes turned: new = R old."""
    imu, gnss = recording.imu, recording.gnss
    return replace(
        recording,
        imu=replace(imu, gyro=imu.gyro @ R.T, accel=imu.accel @ R.T),
        gnss=replace(gnss, lever_arm=R @ gnss.lever_arm),
    )


@pytest.mark.parametrize("begin", [0.0, 52.0])
def test_a_drive_in_reverse(path: oracle.ExactPath, begin: float) -> None:
    """With the axes turned by half a circle about up the vehicle backs all the way."""
    recording, truth = oracle.drive(path, seed=3)
    R = np.diag([-1.0, -1.0, 1.0])
    assert_good(*judged(remounted(recording, R).crop(begin), truth, R))


@pytest.mark.parametrize("begin", [0.0, 52.0])
def test_a_gyro_bias_of_four_degrees_a_second(path: oracle.ExactPath, begin: float) -> None:
    noise = replace(oracle.MEMS, gyro_bias_sigma=0.05)
    recording, truth = oracle.drive(path, seed=4, imu_noise=replace(noise, gyro_bias_sigma=0.0))
    bias = np.array([0.7, -0.5, 1.0]) * 4.0 * DEG / np.linalg.norm([0.7, -0.5, 1.0])
    recording = replace(recording, imu=replace(recording.imu, gyro=recording.imu.gyro + bias, noise=noise))
    assert truth.gyro_bias is not None
    truth = replace(truth, gyro_bias=truth.gyro_bias + bias)
    assert_good(*judged(recording.crop(begin), truth))


@pytest.mark.parametrize("late", [2.4, 40.0])
def test_fixes_that_come_late(path: oracle.ExactPath, late: float) -> None:
    """The first sample is before the first fix, on the move: the answer is carried back to it, and says so."""
    recording, truth = oracle.drive(path, seed=5)
    part = recording.crop(52.0)
    part = part.without("gnss", (0.0, late))
    error, own, over = judged(part, truth)
    assert_good(error, own, over)
    found, _ = aligned(part)
    assert "alignment.carried_back" in map(get_key, found.notes)


def test_own_sigma_is_honest_over_many_drives(path: oracle.ExactPath) -> None:
    """Squared errors of roll, pitch and heading over their own variances average one, within chi-square's 99.9 %."""
    over = []
    for seed in range(12):
        recording, truth = oracle.drive(path, seed=100 + seed)
        error, own, _ = judged(recording.crop(30.0 + 5 * seed), truth)
        over.append((error / own) ** 2)
    # 12 draws of one axis: 99.9 % of chi-square with 12 degrees of freedom lies below 32.9, 0.1 % below 2.2
    assert np.all(np.sum(over, axis=0) < 32.9), np.mean(over, axis=0)
    assert np.all(np.sum(over, axis=0) > 2.2 / 10), np.mean(over, axis=0)


def test_a_second_search_starts_where_the_first_ended(path: oracle.ExactPath, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, _ = oracle.drive(path, seed=2)
    solved: list[int] = []
    batch = motion._solve_from

    def count(*arguments: Any) -> Any:
        solved.append(1)
        return batch(*arguments)

    monkeypatch.setattr(motion, "_solve_from", count)
    first, frame = aligned(recording)
    gnss = recording.gnss
    nearly = replace(recording, gnss=replace(gnss, lever_arm=gnss.lever_arm + 0.2))
    before, anew = len(solved), align(nearly, Settings(), frame)
    alone, near = len(solved) - before, align(nearly, Settings(), frame, before=first)
    assert len(solved) - before - alone < alone
    assert np.abs(near.state.minus(anew.state)[0] / anew.sigma).max() < 0.01
    assert near.own_sigma == pytest.approx(anew.own_sigma, rel=0.01)


@pytest.mark.parametrize("change", ["stamps", "span"])
def test_a_second_search_over_another_span_tries_the_headings_of_the_first(path: oracle.ExactPath, change: str) -> None:
    recording, _ = oracle.drive(path, seed=2)
    first, frame = aligned(recording)
    gnss = recording.gnss
    moved = replace(gnss, t=gnss.t - 0.32) if change == "stamps" else pick_fixes(gnss, gnss.t > first.until)
    nearly = replace(recording, gnss=moved)
    anew, near = align(nearly, Settings(), frame), align(nearly, Settings(), frame, before=first)
    assert near.motion == anew.motion
    assert near.motion != first.motion
    # each search ends where another step would move nothing by more than half as many sigmas
    apart = 2.0 * np.sqrt(2.0 * Settings().solver.tolerance)
    assert np.abs(ro.wrap(near.rph - anew.rph) / anew.own_sigma).max() < apart
    assert ro.wrap(near.headings[0] - anew.headings[0]) == pytest.approx(0.0, abs=apart * anew.own_sigma[2])


def test_what_is_no_minimum_is_not_tried_again(path: oracle.ExactPath) -> None:
    recording, _ = oracle.drive(path, seed=2)
    found, _ = aligned(recording, parse_settings({"solver": {"max_iterations": 1}}))
    assert not found.headings


def test_a_known_heading_is_taken(path: oracle.ExactPath) -> None:
    recording, _ = oracle.drive(path, seed=0)
    found, _ = aligned(recording)
    stated = use_known_heading(found, parse_settings({"alignment": {"heading": 123.0, "heading_sigma": 7.0}}))
    np.testing.assert_allclose(stated.rph / DEG, [*found.rph[:2] / DEG, 123.0], atol=1e-9)
    assert stated.sigma[2] / DEG == pytest.approx(7.0)
    assert use_known_heading(found, Settings()) is found


def test_a_recording_at_rest_is_levelled_and_its_heading_unknown(path: oracle.ExactPath) -> None:
    recording, truth = oracle.drive(path, seed=0)
    found, frame = aligned(recording.crop(0.0, 8.0))
    true = truth_states(truth, np.array([0.0]), frame)
    error = ro.wrap(found.rph - ro.to_rph(true.R_nb[0]))
    # accelerometer biases of 0.03 m/s^2 are 0.18 deg
    assert np.all(np.abs(error[:2]) < 4 * 0.18 * DEG)
    assert np.all(np.abs(error[:2]) < found.own_sigma[:2] * 4)
    assert np.all(np.abs((found.state.minus(true)[0] / found.sigma)[3:]) < 4.0)
    assert found.sigma[2] == pytest.approx(np.pi)


def test_without_gnss_heading_and_position_count_from_zero(path: oracle.ExactPath) -> None:
    recording, _ = oracle.drive(path, seed=0)
    blind = recording.without("gnss")
    found = align(blind, Settings(), LocalFrame(recording.gnss.llh[0]), detect(blind, Settings()).stationary)
    assert found.rph[2] == pytest.approx(0.0)
    assert found.sigma[2] < 1e-3
    np.testing.assert_array_equal(found.state.p, 0.0)
    assert "alignment.no_gnss" in map(get_key, found.notes)
