"""A receiver that reports fast: online uses the best fix of every second, as a whole drive does. One that is slow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from test_online import joined

from graphnav import load
from graphnav.config import parse_settings
from graphnav.constraints.gnss import STAMP_ERROR, STAMPS
from graphnav.constraints.lasting import MULTIPATH_ERROR
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.estimation.noise.model import NoiseModel, VarianceComponent
from graphnav.estimation.noise.spacing import space_fixes
from graphnav.estimation.noise.unmeasured import drop_unmeasured
from graphnav.gnss.residuals import compute_multipath_sigma
from graphnav.online import Online, drop_rows, list_rows
from graphnav.online.noise_estimation import CatchUp
from graphnav.online.sensors import Sensors
from graphnav.recording import Gnss, Imu, Recording, take_rows

QUICK = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 60.0}})
NAN = float("nan")


def test_a_drive_with_rare_fixes_begins_before_ten_have_come(shared_data: Path) -> None:
    """Every eight seconds: what it begins with is as true as its sigmas say."""
    drive = load(shared_data / "oracle_drive").crop(253.4, 310.4)
    assert drive.gnss is not None
    assert drive.truth is not None
    rare = replace(drive, gnss=take_rows(drive.gnss, np.arange(len(drive.gnss.t)) % 8 == 0))
    online = Online(drop_rows(rare), QUICK)
    for row in list_rows(rare)[1]:
        online.add(row)
    assert online.tracker is not None
    message, truth = online.tracker.window.newest, drive.truth
    k = int(np.argmin(np.abs(truth.t - online.tracker.newest)))
    assert abs(truth.t[k] - online.tracker.newest) < 1e-3
    off = message.state.p[0] - online.tracker.frame.from_llh(truth.llh[k][None])[0]
    assert off @ np.linalg.solve(message.covariance[3:6, 3:6], off) < 21.1  # once in ten thousand times


@pytest.mark.parametrize("late", [0, 7])
def test_the_same_fixes_are_used_as_of_the_whole_recording(late: int) -> None:
    """By their sigmas, with the velocities that come less often, without copies, and where some come late."""
    rng = np.random.default_rng(1)
    t = 100.0 + 0.2 * np.arange(300) + rng.uniform(-0.02, 0.02, 300)
    t[1:] = np.maximum(t[1:], t[:-1] + 0.1)
    sd = rng.choice([0.5, 0.7, 1.0], (300, 3))
    v, sd_v = np.zeros((300, 3)), rng.uniform(0.1, 0.2, (300, 3))
    v[rng.random(300) < 0.7] = NAN
    llh = np.array([0.6, 0.2, 100.0]) + 1e-7 * rng.standard_normal((300, 3))
    llh[[*range(41, 47), *range(148, 151), *range(199, 230)]] = llh[[40] * 6 + [147] * 3 + [198] * 31]  # held
    imu = Imu(t, np.zeros((300, 3)), np.tile([0.0, 0.0, 9.8], (300, 1)))
    recording = Recording("fast", "vehicle", imu, Gnss(t, llh, sd, v=v, sd_v=sd_v))
    sensors, order = Sensors(drop_rows(recording)), np.argsort(np.arange(300) + late * (np.arange(300) % 50 == 49))
    for n, k in enumerate(order):
        moves = np.isfinite(v[k, 0])
        sensors.add("gnss", t[k], (*llh[k], *sd[k], *v[k], *(sd_v[k] if moves else [NAN] * 3)))
        if n == 100:
            sensors.gnss.space(1.0)
            assert len(sensors.gnss.used) < 40
    expected = space_fixes(drop_unmeasured(recording)[0], 1.0).gnss
    assert expected is not None
    np.testing.assert_array_equal(sensors.gnss.used, expected.t)
    assert sensors.make_recording().gnss.t.tolist() == expected.t.tolist()
    assert len(sensors.make_recording(every=True).gnss.t) == 300


def test_a_fix_that_gives_way_to_a_better_one_leaves_no_trace() -> None:
    recording, _ = oracle.drive(oracle.vehicle_path(130.0, 25.0), seed=3)
    recording = recording.crop(20.0, 63.5)  # the last fix is a better one
    rows = list_rows(recording)[1]
    fixes = [row for row in rows if row[0] == "gnss"]
    worse = {row[1] for row in fixes[::2]}
    rows = [(s, t, (*x[:3], *np.multiply(x[3:6], 1.5), *x[6:])) if s == "gnss" and t in worse else (s, t, x)
            for s, t, x in rows]  # fmt: skip

    def smoothed(spaced: bool, sent: bool) -> Trajectory:
        """Two fixes of two seconds, of which the second is better, from when it runs."""
        online, since = Online(drop_rows(recording), QUICK), np.inf
        for row in rows:
            if row[0] == "gnss" and row[1] > since and row[1] in worse and not sent:
                continue
            online.add(row)
            if online.tracker is not None and since == np.inf:
                since = next(t for t in sorted(worse) if t > row[1]) - 0.5
            if spaced and row[1] >= since:
                online.sensors.gnss._grid = since, 2.0
        online.finish()
        return joined(online.settled())

    def apart(one: Trajectory, other: Trajectory) -> float:
        np.testing.assert_array_equal(one.t, other.t)
        return float(np.abs((one.llh - other.llh) * [6.4e6, 6.4e6, 1.0]).max())

    never = smoothed(False, sent=False)
    assert apart(smoothed(True, sent=True), never) < 1e-4  # m, of linearising elsewhere
    assert apart(smoothed(False, sent=True), never) > 1e-2


def test_fixes_of_different_quality_have_no_error_in_common() -> None:
    """Some are closer than usual, some behind a gap: what they share is by their residuals, and no stamp's error."""
    recording, _ = oracle.drive(oracle.vehicle_path(130.0, 25.0), seed=3)
    gnss, lasts = recording.crop(0.0, 100.0).gnss, 30.0
    assert gnss is not None
    k = np.flatnonzero((np.arange(len(gnss.t)) % 5 < 2) | (np.arange(len(gnss.t)) % 10 == 8))
    k = k[(k < 70) | (k > 76)]
    rms = np.random.default_rng(2).choice([0.3, 3.0, 30.0], len(k))
    fixes = replace(pick_fixes(gnss, k), residual_rms=rms, satellites=np.full(len(k), 9.0))
    recording = replace(recording.crop(0.0, 100.0), gnss=fixes)
    online = Online(drop_rows(recording), parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 1000.0}}))
    for row in list_rows(recording)[1]:
        online.add(row)
    names = STAMPS, *(f"gnss_position.multipath.{axis}" for axis in ("horizontal", "up"))
    noise = NoiseModel({name: VarianceComponent(0.0) for name in names}, times={MULTIPATH_ERROR: lasts})
    assert online.tracker is not None
    other = CatchUp(online.tracker.restart_settled(noise, drop_rows(recording)))
    while not other.step(online.sensors, online.tracker):
        pass

    def find_left(name: str, a: float, b: float) -> float:
        """The share of an error at one time (s) that is left at another."""
        places = (stage.place for stage in other.tracker.window.stages if a + 1e-6 < stage.place.t < b + 1e-6)
        return float(np.prod([step.decay for place in places for step in place.steps if step.name == name]))

    size = compute_multipath_sigma(rms, fixes.satellites)
    for i in range(len(k) - 1):
        a, b = fixes.t[i : i + 2]
        expected = np.exp((a - b) / lasts) * size[i : i + 2].min() / size[i : i + 2].max()
        assert find_left(MULTIPATH_ERROR, a, b) == pytest.approx(expected, rel=1e-9)
        assert find_left(STAMP_ERROR, a, b) < 1e-9
