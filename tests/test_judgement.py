"""What the sensors are judged to be, on drives whose true figures are known."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from graphnav.judgement import judged
from graphnav.judgement.chance import trimmed
from graphnav.judgement.imu import imu_notes

from graphnav import load
from graphnav.alignment import align
from graphnav.config import Settings, settings_from
from graphnav.detectors import detect
from graphnav.earth import LocalFrame
from graphnav.evaluation import evaluate_recording
from graphnav.pipeline import origin, run
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.scoring import errors
from graphnav.solvers.batch import batch
from graphnav.trajectory import Trajectory


@pytest.fixture(scope="module")
def path() -> oracle.ExactPath:
    return oracle.vehicle_path(duration=420, seed=11)


def notes(recording: Recording, settings: Settings | None = None) -> tuple[str, ...]:
    return run(recording, settings, ("ekf",))["ekf"].notes


def stating(recording: Recording, imu: float = 1.0, fixes: float = 1.0) -> Recording:
    """The same measurements with noise figures or sigmas divided by a factor."""
    noise = recording.imu.noise
    figures = ("gyro_noise_density", "accel_noise_density")
    noise = replace(noise, **{name: getattr(noise, name) / imu for name in figures})
    return replace(
        recording, imu=replace(recording.imu, noise=noise), gnss=replace(recording.gnss, sd=recording.gnss.sd / fixes)
    )


def wandering(recording: Recording, share: float, seed: int, time: float = 100.0, size: float = 1.0) -> Recording:
    """Fixes with an error of `size` times the stated one, a share of its variance in a Gauss-Markov process."""
    gnss, rng = recording.gnss, np.random.default_rng(seed)
    decay = np.exp(-np.diff(gnss.t) / time)
    slow = np.empty((len(gnss.t), 3))
    slow[0] = rng.normal(size=3)
    for k, d in enumerate(decay):
        slow[k + 1] = d * slow[k] + np.sqrt(1 - d * d) * rng.normal(size=3)
    moved = gnss.llh.copy()
    east, north, up = (size * np.sqrt(share) * gnss.sd * slow).T
    moved[:, 0] += north / 6.36e6
    moved[:, 1] += east / (6.378e6 * np.cos(gnss.llh[:, 0]))
    moved[:, 2] += up
    return replace(recording, gnss=replace(gnss, llh=moved))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_true_figures_are_left_alone(path: oracle.ExactPath, seed: int) -> None:
    recording, _ = oracle.drive(path, seed=seed)
    said = notes(recording)
    assert not any("noisier" in note or "stated variance" in note or "scatter" in note for note in said), said


def test_fixes_that_scatter_more_than_they_state(path: oracle.ExactPath) -> None:
    recording, _ = oracle.drive(path, seed=3)
    (said,) = (note for note in notes(stating(recording, fixes=3.0)) if "scatter" in note)
    assert 2.4 < float(said.split("scatter ")[1].split()[0]) < 4.0


@pytest.mark.parametrize(("times", "seed"), [(1.0, 0), (1.0, 1), (1.0, 2), (3.0, 0), (3.0, 1)])
def test_velocities_have_a_factor_of_their_own(path: oracle.ExactPath, times: float, seed: int) -> None:
    recording, _ = oracle.drive(path, seed=seed, gnss_velocity_sd=(0.1 * times,) * 3)
    assert recording.gnss is not None
    assert recording.gnss.sd_v is not None
    stated = replace(recording, gnss=replace(recording.gnss, sd_v=recording.gnss.sd_v / times))
    said = " ".join(notes(stated, settings_from({"gnss": {"adaptive": "off"}})))
    found = [float(x) for x in re.findall(r"gnss_velocity, \w+: its sigma was multiplied by ([\d.]+)", said)]
    assert len(found) == (0 if times == 1.0 else 3)
    assert all(0.8 * times < factor < 1.2 * times for factor in found)
    # where the filter has met the noise already it is not met twice
    assert "gnss_velocity, " not in " ".join(notes(stated))


def test_an_imu_noisier_than_stated(path: oracle.ExactPath) -> None:
    """Both noise densities four times what is stated: at least half of that is seen, part goes to the bias walks."""
    recording, _ = oracle.drive(path, seed=4, gnss_rate=4.0, gnss_velocity_sd=(0.02, 0.02, 0.03))
    (said,) = (note for note in notes(stating(recording, imu=4.0)) if "noisier" in note)
    factors = dict(part.rsplit(" ", 1) for part in said.split(": ")[1].split(", "))
    for name in ("gyro noise", "accelerometer noise"):
        assert 2.0 < float(factors[name]) < 5.0, said
    as_stated = settings_from({"imu": {"as_stated": True}})
    assert not any("noisier" in note for note in notes(stating(recording, imu=4.0), as_stated))


def nees(recording: Recording, truth: Trajectory, settings: Settings | None = None) -> Array:
    """Position NEES per degree of freedom, averaged over the drive."""
    solution = run(recording, settings, ("rts",))["rts"]
    found = errors(solution.trajectory(), truth)
    assert found.nees_p is not None
    return np.nanmean(found.nees_p) / 3.0


def test_sigma_holds_when_fixes_are_wrong_alike(path: oracle.ExactPath) -> None:
    """Seven tenths of the variance wander: taken as white, the sigma is several times too small; judged, it holds."""
    plain = settings_from({"gnss": {"slow_share": 0.0, "sd_factor": 1.0}})
    judged, white = [], []
    for seed in range(6):
        recording, truth = oracle.drive(path, seed=20 + seed, gnss_sd=tuple(np.sqrt(0.3) * np.array(oracle.RTK_SD)))
        recording = replace(recording, gnss=replace(recording.gnss, sd=recording.gnss.sd / np.sqrt(0.3)))
        recording = wandering(recording, 0.7, seed)
        judged.append(nees(recording, truth))
        white.append(nees(recording, truth, plain))
    assert np.mean(white) > 3.0
    assert 0.5 < np.mean(judged) < 1.6


def test_trimmed_mean_is_one_for_a_normal_and_sees_bursts() -> None:
    z = np.random.default_rng(0).normal(size=(100_000, 3))
    assert abs(trimmed(z * z) - 1.0) < 0.01
    z[::20] *= 5.0  # a twentieth of the time five times noisier: variance 2.2
    assert 1.5 < trimmed(z * z) < 2.2


def test_notes_say_only_what_was_raised() -> None:
    noise = oracle.MEMS
    assert imu_notes(noise, noise) == ()
    (said,) = imu_notes(noise, replace(noise, gyro_noise_density=2 * noise.gyro_noise_density))
    assert "gyro noise 2.0" in said
    assert "accelerometer" not in said


def test_errors_that_last_for_seconds(path: oracle.ExactPath) -> None:
    """Fixes that state 2 m (up 4 m): what they are wrong by is found from residuals, and every solver's sigma holds.

    White noise beside it makes it seem to last for less.
    """
    size, time, ratio = 5.0, 10.0, []
    for seed in range(2):
        recording, truth = oracle.drive(path, seed=seed, gnss_sd=(2.0, 2.0, 4.0))
        recording = wandering(recording, 1.0, 100 + seed, time, size / 2.0)
        solutions = run(recording, None, ("ekf", "rts", "batch"))
        (said,) = (note for note in solutions["rts"].notes if "multipath" in note)
        found = float(said.split(" s")[0].split(", ")[1]), float(said.split(", and ")[1].split()[0])
        assert 0.3 * time < found[0] < 1.5 * time, said
        assert 0.7 < found[1] / np.hypot(1.0, size / 2.0) < 1.4, said
        ratio.append([np.nanmean(errors(s.trajectory(), truth).nees_p) / 3.0 for s in solutions.values()])
    mean = np.mean(ratio, axis=0)
    assert np.all((mean > 0.3) & (mean < 2.0)), mean


def test_single_point_fixes_among_high_houses(shared_data: Path) -> None:
    """A quarter of the fixes is tens of metres off for seconds to half a minute, stated as 3 m."""
    whole = load(shared_data / "tokyo_20201105" / "recording_spp.toml").crop(0.0, 620.0)
    every = {key: x[::5] for key, x in vars(whole.gnss).items() if isinstance(x, np.ndarray) and key != "lever_arm"}
    recording = replace(whole, gnss=replace(whole.gnss, **every))
    for name, solution in run(recording, None, ("ekf", "batch")).items():
        found = evaluate_recording(solution.trajectory(), recording)
        assert found is not None
        assert found.errors is not None
        rms = float(np.sqrt(np.mean(found.errors.horizontal**2)))
        assert rms < 5.0, name
        assert 0.25 < float(np.nanmean(found.errors.nees_p)) / 3.0 < 2.0, name


@pytest.mark.parametrize(("begin", "wheels"), [(150.0, True), (300.0, False)])
def test_five_minutes_of_single_point_fixes_among_high_houses(shared_data: Path, begin: float, wheels: bool) -> None:
    """One begins while it moves, one at a stop; no IMU ten times as bad explains such fixes (NEES 8000 and 120).

    At the stop, without wheels, the heading is unknown to 14 deg and a filter goes astray; a smoother that notices
    does not.
    """
    recording = load(shared_data / "tokyo_20201105" / "recording_spp.toml").crop(begin, begin + 300.0)
    recording = recording if wheels else replace(recording, odometer=None)
    solutions = run(recording)
    assert any("multipath" in note for note in solutions["batch"].notes)
    for name in ("ekf", "rts", "batch") if wheels else ("rts", "batch"):
        found = evaluate_recording(solutions[name].trajectory(), recording)
        assert found is not None
        assert found.errors is not None
        assert float(np.sqrt(np.mean(found.errors.horizontal**2))) < 10.0, name
        assert 0.3 < float(np.nanmean(found.errors.nees_p)) / 3.0 < 4.5, name


def test_an_imu_far_worse_than_stated_is_not_taken_for_bad_fixes(shared_data: Path) -> None:
    """Noise twenty times what is stated, twice as much as is believed: errors of the fixes do not explain it either."""
    recording = load(shared_data / "oracle_drive")
    figures = ("gyro_noise_density", "accel_noise_density", "gyro_bias_walk", "accel_bias_walk")
    noise = replace(recording.imu.noise, **{name: getattr(recording.imu.noise, name) / 20.0 for name in figures})
    recording = replace(recording, imu=replace(recording.imu, noise=noise))
    solution = run(recording, None, ("batch",))["batch"]
    assert not any("multipath" in note for note in solution.notes)
    assert any("noisier" in note for note in solution.notes)
    found = evaluate_recording(solution.trajectory(), recording)
    assert found is not None
    assert found.errors is not None
    assert float(np.sqrt(np.mean(found.errors.horizontal**2))) < 0.03


def test_wheels_tell_errors_that_last_from_a_bad_imu(shared_data: Path) -> None:
    """At their full rate, most fixes contradicting the filter; the other explanation is an IMU ten times as bad.

    Of a fifth of the fixes, as above, either choice gives the same result; smoothing all of the drive takes minutes.
    """
    recording, settings = load(shared_data / "tokyo_20201105" / "recording_spp.toml"), Settings()
    frame, stationary = LocalFrame(origin(recording)), detect(recording, settings).stationary
    smooth = lambda p, s: batch(p, s, wanted=(0,), reintegrate=False)  # noqa: E731
    found = align(recording, settings, frame, smooth, stationary)
    judged_to_be, how, _ = judged(recording, settings, frame, found, stationary, witnesses=True)
    assert 2.0 < how.gnss.fast_time < 8.0  # type: ignore[operator]
    noise, stated = judged_to_be.imu.noise, recording.imu.noise
    assert noise.gyro_noise_density < 2.0 * stated.gyro_noise_density
    assert noise.accel_noise_density < 7.0 * stated.accel_noise_density
