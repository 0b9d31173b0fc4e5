"""A receiver that reports fast: online uses the best fix of every second, as a whole drive does."""

from __future__ import annotations

import numpy as np
import oracle
import pytest
from test_online import joined

from graphnav.config import parse_settings
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.noise.spacing import space_fixes
from graphnav.estimation.noise.unmeasured import drop_unmeasured
from graphnav.online import Online, drop_rows, list_rows
from graphnav.online.sensors import Sensors
from graphnav.recording import Gnss, Imu, Recording

QUICK = parse_settings({"noise": {"mode": "stated"}, "solver": {"lag": 60.0}})
NAN = float("nan")


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
