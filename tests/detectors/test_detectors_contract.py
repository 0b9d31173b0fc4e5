"""The contract of every detector, driven over all that are registered, each by itself, and over their fusion."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from helpers import random_states
from road import made, with_gnss

from graphnav.config import Settings, parse_settings
from graphnav.config.detectors import FUSED, DetectorName
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import get_key
from graphnav.detectors import base, detect, find_stops, list_detectors
from graphnav.estimation.pipeline import run
from graphnav.estimation.problem import build_problem
from graphnav.estimation.stops import list_solution_stops
from graphnav.recording import Imu, Recording

NAMES = (FUSED, *list_detectors())
LEGS = [(40, 0), (6, 12), (30, 12), (6, 0), (40, 0), (5, 10), (20, 10)]
STOPS = np.array([[0.0, 40.0], [82.0, 122.0]])
ENGINE = 18.0  # Hz: below half of the slowest rate
FREE = 0.5  # s about an end, in which neither rest nor motion is asked for: jerks are smoothed over that


def firing(name: str) -> Settings:
    return parse_settings({"detectors": {"fire": [name]}})


@functools.cache
def drive(rate: float = 100.0) -> Recording:
    return with_gnss(*made(31, LEGS, rate=rate, engine=ENGINE))


def shares(found: np.ndarray, recording: Recording) -> tuple[float, float]:
    """Shares of the stops' seconds and of the other seconds that are called stationary."""
    t = np.arange(recording.start, recording.end, 0.02)
    far = np.abs(t[:, None] - STOPS.ravel()).min(axis=1) > FREE
    still, called = base.mask_inside(t, STOPS), base.mask_inside(t, found)
    return float(called[still & far].mean()), float(called[~still & far].mean())


def test_settings_name_every_detector() -> None:
    assert set(get_args(DetectorName)) == set(NAMES)
    assert Settings().detectors.fire == (FUSED,)


@pytest.mark.parametrize("rate", [50.0, 100.0, 200.0, 400.0])
@pytest.mark.parametrize("name", NAMES)
def test_each_fires_on_a_stop_with_the_engine_idling(name: str, rate: float) -> None:
    recording = drive(rate)
    found = detect(recording, firing(name))
    right, wrong = shares(found.stationary, recording)
    assert right > 0.9
    assert wrong < 0.01
    one = found[name]
    assert one.t.shape == one.statistic.shape == one.mask.shape
    # whoever decides is said to have fired on every stop
    if name != FUSED:
        assert (base.measure_overlap(one.intervals, found.stationary) > 0.5 * np.diff(found.stationary).ravel()).all()


@pytest.mark.parametrize("name", NAMES)
def test_none_fires_while_driving(name: str) -> None:
    rough, _, _ = made(12, [(1, 30), (60, 30), (5, 33), (60, 33)], rate=100.0, engine=ENGINE)
    assert len(detect(rough, firing(name)).stationary) == 0
    # a road so smooth that the IMU alone may be wrong about it: fixes overrule it
    smooth = with_gnss(*made(12, [(1, 30), (60, 30), (5, 33), (60, 33)], rate=100.0, engine=ENGINE, road=0.02))
    assert len(detect(smooth, firing(name)).stationary) == 0


@pytest.mark.parametrize("name", NAMES)
def test_a_window_while_the_drive_goes_on_says_what_the_recording_says(name: str) -> None:
    recording, settings = drive(), firing(name)
    whole = detect(recording, settings).stationary
    edge = list_detectors()[name].edge if name != FUSED else max(d.edge for d in list_detectors().values())
    looked = 0
    for now in np.arange(35.0, recording.end, 4.0):
        look = recording.crop(now - 30.0, now)
        since, until = look.end - 25.0, look.end - 1.0
        found = find_stops(look, settings, since, until, base.NONE, since)
        t = np.arange(since, until, 0.02)
        there = base.mask_inside(t, whole)
        if found is None:
            assert not there.any()
            continue
        # an end, of the recording's answer or of what the window can see, is where they may differ
        ends = np.append(np.clip(whole, since, until), [since, until])
        far = np.abs(t[:, None] - ends).min(axis=1) > edge
        np.testing.assert_array_equal(base.mask_inside(t, found)[far], there[far])
        looked += bool(there.any())
    assert looked > 10


@pytest.mark.parametrize("name", NAMES)
def test_a_gap_is_not_bridged(name: str) -> None:
    recording = drive()
    keep = (recording.imu.t < 20.0) | (recording.imu.t > 25.0)
    imu = replace(recording.imu, **{k: getattr(recording.imu, k)[keep] for k in ("t", "gyro", "accel")})
    found = detect(replace(recording, imu=imu), firing(name))
    assert not ((found.stationary[:, 0] < 24.0) & (found.stationary[:, 1] > 21.0)).any()
    assert base.measure_overlap(found.stationary, np.array([[0.0, 20.0], [25.0, 40.0]])).min() > 10.0
    for one in found.all:
        assert np.isfinite(one.intervals).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("platform", ["vehicle", "foot"])
def test_what_is_too_short_is_said_and_no_error(name: str, platform: str) -> None:
    rng = np.random.default_rng(5)
    for rows, rate in ((2, 100.0), (4, 400.0), (100, 400.0), (310, 100.0), (40, 10.0), (500, 1.0)):
        x = rng.standard_normal((rows, 6))
        recording = Recording("odd", platform, Imu(np.arange(1, rows + 1) / rate, x[:, 3:], x[:, :3]))
        found = detect(recording, firing(name))
        assert found.stationary.shape == (len(found.stationary), 2)
        if not found.all or not len(found.all[0].t):
            assert found.notes
            assert not len(found.stationary)


def test_several_stand_where_one_of_them_says_so() -> None:
    recording = drive()
    each = [detect(recording, firing(name)).stationary for name in ("fft", "glrt")]
    found = detect(recording, parse_settings({"detectors": {"fire": ["fft", "glrt"]}}))
    np.testing.assert_array_equal(found.stationary, base.unite(each))
    assert [d.name for d in found.all] == ["fft", "glrt", FUSED]


def test_the_old_name_of_a_table_is_read_and_said() -> None:
    old = parse_settings({"detectors": {"sway": {"threshold": 4.5}}})
    assert old.detectors.low_band_glrt.threshold == 4.5
    assert "settings.renamed" in map(get_key, detect(drive(), old).notes)
    assert Settings.model_validate(old.model_dump()).detectors.low_band_glrt.threshold == 4.5


@pytest.mark.parametrize("name", sorted(list_detectors()))
def test_each_alone_puts_rows_into_the_problem_of_all_solvers(name: str) -> None:
    recording, settings = drive().crop(70.0, 130.0), firing(name)
    assert recording.gnss is not None
    frame = LocalFrame(recording.gnss.llh[0])
    spans = detect(recording, settings).stationary
    built = build_problem(recording, settings, frame, random_states(np.random.default_rng(0), 1), np.ones(15), spans)
    rows = {c.name: built.t[c.keyframe] for c in built.constraints if c.of_stops}
    assert set(rows) == {"zero_velocity", "zero_rate", "held_position"}
    for t in rows.values():
        assert ((t > spans[0, 0] - 0.02) & (t < spans[0, 1] + 0.02)).all()
        assert len(t) >= np.sum((built.t > spans[0, 0] + 0.02) & (built.t < spans[0, 1] - 0.02))


def test_filter_isam2_and_batch_use_the_rows_of_one_detector() -> None:
    recording = drive().crop(70.0, 130.0)
    assert recording.gnss is not None
    every = {k: getattr(recording.gnss, k)[::5] for k in ("t", "llh", "sd", "v", "sd_v")}
    settings = firing("fft").model_copy(update={"noise": Settings().noise.model_copy(update={"mode": "stated"})})
    used = replace(recording, gnss=replace(recording.gnss, **every))
    for solution in run(used, settings, ("ekf", "isam2", "batch")).values():
        (stop,) = list_solution_stops(solution)
        assert set(stop.fired) == {"fft"}
        assert set(stop.rows) == {"zero_velocity", "zero_rate", "held_position"}
        still = (solution.t > stop.start) & (solution.t < stop.end)
        assert np.sum(still) <= stop.rows["zero_velocity"] <= np.sum(still) + 1
        assert np.abs(solution.states.v[still]).max() < 0.02
