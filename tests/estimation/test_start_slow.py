"""The start of what is slow, only circles, or does not move at all, and of what fixes alone tell of the direction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from helpers import Array, at_rate
from scipy.stats import chi2

from graphnav import load
from graphnav.config import Settings
from graphnav.core import rotation as ro
from graphnav.core.earth import LocalFrame
from graphnav.detectors import detect
from graphnav.detectors.base import NONE
from graphnav.estimation.alignment import Alignment, align
from graphnav.estimation.alignment.travel import measure_travel
from graphnav.estimation.pipeline import choose_origin
from graphnav.recording import Recording, Truth
from graphnav.recording.formats import read

DEG = np.pi / 180.0
SURE = 0.999  # of a chi-square that an honest sigma stays below


def aligned(recording: Recording, stationary: Array | None = None) -> Alignment:
    settings, frame = Settings(), LocalFrame(choose_origin(recording))
    stationary = detect(recording, settings).stationary if stationary is None else stationary
    return align(recording, settings, frame, stationary)


def off(found: Alignment, recording: Recording, truth: Truth) -> float:
    """Error of the start heading, rad."""
    assert truth.rph is not None
    return float(ro.wrap(found.rph[2] - np.interp(recording.start, truth.t, np.unwrap(truth.rph[:, 2]))))


def lasting(t: Array, size: float, time: float, rng: np.random.Generator) -> Array:
    """(N, 2) errors of a correlation time (s)."""
    e = rng.standard_normal((len(t), 2))
    for k, keep in enumerate(np.exp(-np.diff(t) / time)):
        e[k + 1] = keep * e[k] + np.sqrt(1.0 - keep**2) * e[k + 1]
    return size * e


def drive(path: oracle.ExactPath, seed: int, sd: float, time: float) -> Recording:
    """A recording of a path by fixes that are wrong by `sd` m for `time` s."""
    recording, _ = oracle.drive(path, seed=seed, gnss_sd=(sd, sd, 2.0 * sd), gnss_exact=True)
    gnss = recording.gnss
    assert gnss is not None
    e = lasting(gnss.t, sd, time, np.random.default_rng([seed, 3]))
    llh = gnss.llh + oracle.llh_rate(gnss.llh, np.column_stack([e, np.zeros(len(e))]))
    return replace(recording, gnss=replace(gnss, llh=llh))


def assert_honest(errors: list[float], sigmas: list[float]) -> None:
    over = np.array(errors) / np.array(sigmas)
    said = f"{np.round(np.array(errors) / DEG, 1)} deg against {np.round(np.array(sigmas) / DEG, 1)}"
    assert np.all(np.abs(over) < 3.0), said
    assert np.sum(over**2) < chi2.ppf(SURE, len(over)), said


# the slower, the longer a drive of 40 m
@pytest.mark.parametrize(("speed", "seeds", "time"), [(0.15, 2, 10.0), (0.4, 2, 1.0), (0.4, 3, 100.0)])
def test_a_slow_rover_knows_its_heading_as_well_as_it_says(speed: float, seeds: int, time: float) -> None:
    errors, own, prior = [], [], []
    for seed in range(seeds):
        path = oracle.winding_path(20.0 + 40.0 / speed, speed, seed)
        recording = drive(path, seed, 0.7, time)
        found = aligned(recording)
        assert found.motion is not None
        assert recording.truth is not None
        errors.append(off(found, recording, recording.truth))
        own.append(found.own_sigma[2])
        prior.append(found.sigma[2])
    assert_honest(errors, own)
    assert_honest(errors, prior)
    assert max(prior) < 30.0 * DEG  # of 40 m by fixes of 0.7 m there is more to know than nothing


def test_a_real_rover_knows_its_heading_as_well_as_it_says(shared_data: Path, tmp_path: Path) -> None:
    """0.35 m/s on gravel. Axes of its IMU are as slopes and the reference's pitch and roll show them."""
    folder = shared_data / "canada_rover"
    text = (folder / "recording.toml").read_text().replace('axes = "FRD"', 'axes = "RBD"')
    for name in ("imu", "gnss", "truth"):
        text = text.replace(f'"{name}.csv.gz"', f'"{folder / name}.csv.gz"')
    (tmp_path / "recording.toml").write_text(text)
    whole = read(tmp_path, allow_outside=True)
    assert whole.truth is not None
    errors, own = [], []
    for begin in (30.0, 200.0):
        part = whole.crop(begin, begin + 100.0)
        found = aligned(part)
        errors.append(off(found, part, whole.truth))
        own.append(found.own_sigma[2])
        assert found.sigma[2] < 30.0 * DEG
    assert_honest(errors, own)


def test_circles_are_motion(shared_data: Path) -> None:
    """A circle of 22 m across by fixes of 3 m is no great distance, three of them are a long way."""
    found = aligned(load(shared_data / "car_circles_boston_20251119"))
    assert found.motion is not None
    assert found.own_sigma[2] < 60.0 * DEG


@pytest.mark.parametrize("time", [1.0, 10.0, 100.0])
def test_whoever_circles_knows_its_heading_as_well_as_it_says(time: float) -> None:
    errors, own = [], []
    for seed in range(3):
        recording = drive(oracle.winding_path(70.0, 3.7, seed, turn=0.33), seed, 3.0, time).crop(8.0)
        found = aligned(recording, NONE)  # without a shake a steady turn passes for a stop
        assert found.motion is not None
        assert recording.truth is not None
        errors.append(off(found, recording, recording.truth))
        own.append(found.own_sigma[2])
    assert_honest(errors, own)
    assert np.median(own) < 30.0 * DEG


@pytest.mark.parametrize("time", [1.0, 10.0, 100.0])
def test_whoever_stands_throughout_is_said_not_to_move(time: float) -> None:
    """By the fixes alone: where a detector tells of the stop they are not asked."""
    for seed in range(5):
        recording = drive(oracle.winding_path(300.0, 0.0, seed, turn=0.0), seed, 3.0, time)
        found = aligned(recording, NONE)
        assert found.motion is None
        assert found.sigma[2] == pytest.approx(np.pi)


def test_a_stop_in_a_town_is_no_motion(shared_data: Path) -> None:
    found = aligned(load(shared_data / "tokyo_20201105").crop(34.0, 94.0))
    assert found.motion is None
    assert found.sigma[2] == pytest.approx(np.pi)


def test_where_accelerations_say_nothing_a_vehicle_goes_forwards(shared_data: Path) -> None:
    """A minute without fixes at first, and then a straight way by fixes of metres."""
    part = load(shared_data / "oracle_drive" / "recording_spp.toml").crop(400.0, 600.0)
    found = aligned(part)
    assert part.truth is not None
    assert abs(off(found, part, part.truth)) < 3.0 * found.sigma[2]
    assert abs(off(found, part, part.truth)) < 90.0 * DEG


@pytest.mark.parametrize("time", [0.3, 3.0, 30.0, 3000.0])
@pytest.mark.parametrize("rate", [0.0, 0.05, 0.3])
def test_errors_of_fixes_leave_no_more_of_a_way_than_stated(rate: float, time: float) -> None:
    """Of what stands, or turns on the spot: for whatever time errors last."""
    t = np.arange(0.0, 120.0, 1.0)
    rng = np.random.default_rng(5)
    over = []
    for _ in range(200):
        way = measure_travel(lasting(t, 2.0, time, rng), np.full(len(t), 2.0), rate * t)
        over.append(way.D[-1] / way.sigma[-1])
    # two axes each
    assert np.sum(np.abs(over) ** 2) < chi2.ppf(SURE, 2 * len(over))


def test_a_way_on_a_circle_is_its_length() -> None:
    t = np.arange(0.0, 60.0, 1.0)
    p = 11.0 * np.column_stack([np.cos(0.3 * t), np.sin(0.3 * t)])
    way = measure_travel(p, np.full(len(t), 3.0), 0.3 * t + 0.5 * np.pi)
    # chords, and along the axis that points forwards
    assert way.D[-1].real == pytest.approx(59 * 2.0 * 11.0 * np.sin(0.15), rel=1e-9)
    assert abs(way.D[-1].imag) < 1e-9
    ground = measure_travel(p, np.full(len(t), 3.0), np.zeros(len(t)))
    assert way.times_sigma[-1] > 2.0 * ground.times_sigma.max()


@pytest.mark.parametrize("every", [5, 20, 40])
def test_fixes_far_apart_are_enough_for_a_start(every: int) -> None:
    recording = drive(oracle.winding_path(150.0, 3.0, 1), 1, 1.0, 1.0)
    gnss = recording.gnss
    assert gnss is not None
    few = slice(None, None, every)
    recording = replace(recording, gnss=replace(gnss, t=gnss.t[few], llh=gnss.llh[few], sd=gnss.sd[few]))
    found = aligned(recording, NONE)
    assert found.motion is not None
    assert recording.truth is not None
    assert abs(off(found, recording, recording.truth)) < 3.0 * found.sigma[2]


@pytest.mark.parametrize("begin", [426.0, 440.0])
def test_wheels_tell_the_start_of_a_drive_that_begins_without_fixes(shared_data: Path, begin: float) -> None:
    """No fix before 476 s; the oracle moves off at 426 s, and drives at a steady 9 m/s from 436 s on."""
    drive = at_rate(load(shared_data / "oracle_drive").crop(begin, 540.0), 25.0)
    assert drive.truth is not None
    assert drive.truth.llh is not None
    assert drive.truth.v is not None
    found, frame = aligned(drive), LocalFrame(choose_origin(drive))
    p, v = (
        np.array([np.interp(drive.start, drive.truth.t, column) for column in rows.T])
        for rows in (frame.from_llh(drive.truth.llh), drive.truth.v)
    )
    assert np.all(np.abs(found.state.v[0] - v) < found.sigma[6:9])
    assert np.all(np.abs(found.state.p[0] - p) < found.sigma[3:6])
    assert np.max(found.sigma[6:9]) < 0.5 + 9.0  # as fast as the wheels say, wherever to
