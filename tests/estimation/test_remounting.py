"""A device that is turned in its holder in mid-drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import graphnav
from graphnav.core import rotation
from graphnav.core.notes import get_key
from graphnav.core.rotation import Array
from graphnav.estimation.noise.files import read_noise, write_noise
from graphnav.estimation.noise.model import Remounting
from graphnav.estimation.remounting import undo_remountings
from graphnav.estimation.solution import Solution
from graphnav.evaluation.evaluate import evaluate_recording
from graphnav.evaluation.metrics import summarise
from graphnav.recording import Recording
from graphnav.simulation import simulate

TURN = np.radians([15.0, 10.0, 20.0])


def turn_device(recording: Recording, at: float, vector: Array, lasts: float, bg: Array, ba: Array) -> Recording:
    """A recording whose device is turned from `at` (s from the start) on, by a vector; its biases stay."""
    imu = recording.imu
    share = np.clip((imu.t - recording.start - at) / lasts, 0.0, 1.0)
    share = share**2 * (3.0 - 2.0 * share)
    R = np.swapaxes(rotation.exp(share[:, None] * vector), -1, -2)
    own = np.diff(share, prepend=0.0) / np.diff(imu.t, prepend=recording.start)
    gyro, accel = ((R @ x[..., None])[..., 0] for x in (imu.gyro - bg, imu.accel - ba))
    return replace(recording, imu=replace(imu, gyro=gyro + bg + own[:, None] * vector, accel=accel + ba))


def check_found(solved: Solution, recording: Recording, at: float, vector: Array, lasts: float) -> None:
    """One turn, told, around when it was and by what it was."""
    (one,) = solved.noise.remountings
    assert "imu.remounted" in map(get_key, solved.notes)
    assert one.begin - recording.start < at + 0.1 * lasts
    assert one.end - recording.start > at + 0.9 * lasts
    assert one.end - one.begin < 2.0 * lasts
    left = rotation.log(rotation.exp(np.array(one.rotation)) @ rotation.exp(vector).T)
    assert np.all(np.abs(left) < 3.0 * one.sigma), np.degrees([*left, one.sigma])


@pytest.fixture(scope="module")
def tokyo(shared_data: Path) -> Recording:
    return graphnav.load(shared_data / "tokyo_20201105" / "recording_spp.toml").crop(234.0, 434.0)


@pytest.fixture(scope="module")
def usual(tokyo: Recording) -> Solution:
    return graphnav.run(tokyo, solvers=("rts",))["rts"]


def test_in_a_drive_without_it_nothing_is_found(usual: Solution) -> None:
    assert usual.noise.remountings == ()
    assert "imu.remounted" not in map(get_key, usual.notes)


@pytest.fixture(scope="module")
def turned(tokyo: Recording, usual: Solution) -> tuple[Recording, Solution]:
    """The device is turned about all axes in 3 s, and what the drive is solved as."""
    bg, ba = (np.median(getattr(usual.states, name), axis=0) for name in ("bg", "ba"))
    recording = turn_device(tokyo, 90.0, TURN, 3.0, bg, ba)
    return recording, graphnav.run(recording, solvers=("rts",))["rts"]


def test_a_turn_is_found_and_undone(tokyo: Recording, usual: Solution, turned: tuple[Recording, Solution]) -> None:
    """In a real drive by single fixes: afterwards the attitude is that of the drive without it."""
    _, solved = turned
    check_found(solved, tokyo, 90.0, TURN, 3.0)
    sigma = solved.noise.remountings[0].sigma
    t = np.arange(tokyo.start + 100.0, tokyo.end)
    one, other = (x.at(t)[1].R_nb for x in (solved, usual))
    turn = rotation.log(np.swapaxes(one, -1, -2) @ other)
    assert np.all(np.abs(np.median(turn, axis=0)) < 3.0 * sigma)


def test_a_run_with_its_noise_model_gives_the_same(turned: tuple[Recording, Solution], tmp_path: Path) -> None:
    recording, first = turned
    kept = read_noise(write_noise(tmp_path / "noise.json", first.noise))
    again = graphnav.run(recording, solvers=("rts",), noise=kept)["rts"]
    assert again.noise.remountings == first.noise.remountings
    np.testing.assert_array_equal(again.states.p, first.states.p)
    np.testing.assert_array_equal(again.states.R_nb, first.states.R_nb)


def test_a_device_that_falls_over_at_a_light(shared_data: Path) -> None:
    """Simulated, so that the errors are known: they are within their sigmas."""
    drive = simulate("urban", seed=3, duration=240.0, tunnels=0, rate=50.0)
    begin, end = max(drive.stops[1:-1], key=lambda stop: stop[1] - stop[0])
    at, vector = 0.5 * (begin + end) - drive.recording.start, np.radians([50.0, 20.0, -15.0])
    biases = drive.truth.gyro_bias, drive.truth.accel_bias
    turned = turn_device(drive.recording, at, vector, 0.8, *(np.mean(x, axis=0) for x in biases)).crop(0.0, 120.0)
    solved = graphnav.run(turned, solvers=("ekf", "rts"))
    check_found(solved["rts"], turned, at, vector, 0.8)
    for one in solved.values():
        said = summarise(evaluate_recording(one.trajectory(), turned))
        assert said["nees_p"] < 2.0
        assert said["nees_rph"] < 2.0


def test_what_is_turned_back_is_as_before(tokyo: Recording) -> None:
    """Rows before the turn are as they are, those after it as of a device that was not turned, those within gone."""
    zero = np.zeros(3)
    turned = turn_device(tokyo, 90.0, TURN, 3.0, zero, zero)
    span = tokyo.start + 90.0, tokyo.start + 93.0
    back = undo_remountings(turned, (Remounting(*span, tuple(TURN.tolist()), 0.0),)).imu
    outside = (tokyo.imu.t <= span[0]) | (tokyo.imu.t > span[1])
    np.testing.assert_array_equal(back.t, tokyo.imu.t[outside])
    np.testing.assert_allclose(back.gyro, tokyo.imu.gyro[outside], atol=1e-12)
    np.testing.assert_allclose(back.accel, tokyo.imu.accel[outside], atol=1e-12)
    assert back.remounted == span[1:]
