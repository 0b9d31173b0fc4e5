"""IMU stamps about a regular clock: used where the signals are smoother at its times, and only there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphnav.config import Settings, parse_settings
from graphnav.core.notes import get_key
from graphnav.core.rotation import Array
from graphnav.estimation.pipeline import run
from graphnav.evaluation.strides import compute_walk_errors
from graphnav.imu.regular_stamps import find_regular_times, use_regular_stamps
from graphnav.recording import Imu, Recording
from graphnav.recording.formats import read

PERIOD = 0.01


def make_walk(sampled: Array, stamped: Array, seed: int) -> Recording:
    """Rows of smooth motion, up to 8 Hz, with the noise of a sensor."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 8.0, (6, 12)), rng.uniform(0.0, 2.0 * np.pi, (6, 12))
    rows = np.sin(2.0 * np.pi * frequency * sampled[:, None, None] + phase).sum(axis=2)
    rows += 0.02 * rng.standard_normal(rows.shape)
    return Recording("walk", "foot", Imu(stamped, rows[:, :3], rows[:, 3:]))


def delay(t: Array, scatter: float, seed: int) -> Array:
    """Stamps on arrival: each row late by a time of its own, in order."""
    return np.maximum.accumulate(t + np.random.default_rng(seed).exponential(scatter, len(t))) + 1e-9 * np.arange(
        len(t)
    )


@pytest.mark.parametrize("scatter", [0.002, 0.008])
def test_times_of_a_regular_clock_are_found(scatter: float) -> None:
    """Within what the mean of a second of stamps tells, of a clock that is 200 ppm fast."""
    for seed in range(5):
        t = 1.0002 * PERIOD * np.arange(6000)
        stamped = delay(t, scatter, seed)
        used, (note,) = use_regular_stamps(make_walk(t, stamped, seed), Settings())
        assert get_key(note) == "imu.regular_stamps"
        off = used.imu.t - t
        assert off.std() < 0.3 * (stamped - t).std()
        assert off[100:-100].std() < 3.0 * scatter / np.sqrt(1.0 / PERIOD)


def test_times_that_scatter_themselves_are_left() -> None:
    """A program that asks the sensor late, and stamps that: the signals are smoother at the stamps."""
    for seed in range(10):
        sampled = delay(PERIOD * np.arange(6000), 0.003, seed)
        walk = make_walk(sampled, sampled, seed)
        assert use_regular_stamps(walk, Settings()) == (walk, ())


def test_noise_does_not_tell() -> None:
    """At rest neither times are better: the stamps stay."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        rows = rng.standard_normal((6000, 6))
        still = Recording("rest", "foot", Imu(delay(PERIOD * np.arange(6000), 0.003, seed), rows[:, :3], rows[:, 3:]))
        assert use_regular_stamps(still, Settings()) == (still, ())


def test_stamps_without_scatter_are_not_looked_at() -> None:
    t = PERIOD * np.arange(2000)
    assert find_regular_times(np.delete(t, [500, 501, 1200])) is None
    assert find_regular_times(t[:3]) is None
    walk = make_walk(t, delay(t, 1e-5, 0), 0)
    assert use_regular_stamps(walk, Settings()) == (walk, ())  # less than the noise makes of its integrals
    walk = make_walk(t, delay(t, 0.003, 0), 0)
    assert use_regular_stamps(walk, parse_settings({"imu": {"regular_stamps": False}})) == (walk, ())


def test_gaps_stay_as_long_as_they_were() -> None:
    """The clock is not continued over lost rows."""
    t = PERIOD * np.arange(6000)
    t = np.delete(t, np.arange(3000, 3137))
    used, _ = use_regular_stamps(make_walk(t, delay(t, 0.003, 1), 1), Settings())
    assert used.imu.t[3000] - used.imu.t[2999] == pytest.approx(1.38, abs=0.003)
    assert np.abs(np.diff(used.imu.t)[:2999] - PERIOD).max() < 0.001


@pytest.mark.parametrize("name", ["openshoe_loops/run30", "gcp_walks/walk36"])
def test_a_walk_stamped_on_arrival_is_as_good_as_with_its_own_stamps(shared_data: Path, name: str) -> None:
    walk = read(shared_data / f"{name}.toml")
    rng = np.random.default_rng(5)
    stamped = np.sort(walk.imu.t + 0.003 * rng.standard_normal(len(walk.imu.t))) + 1e-9 * np.arange(len(walk.imu.t))
    late = replace(walk, imu=replace(walk.imu, t=stamped))
    settings = [Settings(), Settings(), parse_settings({"imu": {"regular_stamps": False}})]
    found = [run(one, own, "rts")["rts"] for one, own in zip((walk, late, late), settings, strict=True)]
    own, regular, as_stamped = (compute_walk_errors(walk, one, 0.0).horizontal for one in found)
    assert regular < 1.5 * own
    assert as_stamped > 2.0 * own
