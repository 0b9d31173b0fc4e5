"""A barometer, simulated on the truth of a drive, through every solver and as the drive happens."""

from __future__ import annotations

import numpy as np
import pytest
from series_drive import SETTINGS, along_truth, errors, rms, shared_drive, smoothed_online, with_series

from graphnav.estimation.pipeline import run
from graphnav.recording import Recording
from graphnav.sensors.barometer import SENSOR, compute_standard_height

OFFSET, SCALE, SIGMA = 40.0, 0.03, 0.2


@pytest.fixture(scope="module")
def drive(shared_data) -> Recording:
    recording = shared_drive(shared_data)
    t, truth = along_truth(recording, 10.0)
    h = truth.llh[:, 2]
    z = h + SCALE * (h - h[0]) - OFFSET + SIGMA * np.random.default_rng(2).standard_normal(len(t))
    pressure = 101325.0 * (1.0 - 6.5e-3 * z / 288.15) ** 5.25588
    return with_series(recording, SENSOR.make_series(t, {"pressure": pressure}, sigma=SIGMA, walk=0.01))


def test_the_standard_atmosphere():
    # ICAO Doc 7488: 89874.6 Pa at 1000 m
    series = SENSOR.make_series(np.arange(3.0), {"pressure": [101325.0, 89874.6, np.nan], "height": [np.nan, 5.0, 7.0]})
    np.testing.assert_allclose(compute_standard_height(series), [0.0, 1000.0, 7.0], atol=0.01)


def test_heights_hold_without_fixes(drive):
    solvers = ("ekf", "rts", "batch", "isam2")
    found = run(drive, SETTINGS, solvers)
    without = run(drive.without(SENSOR.name), SETTINGS, ("ekf", "rts"))
    for name in solvers:
        solution, other = found[name], without["ekf" if name == "ekf" else "rts"]
        assert solution.counts["barometer"] >= len(solution.t) - 3, name  # intervals shorter than its period have none
        up, loose = (errors(one.trajectory(), drive)[0] for one in (solution, other))
        assert rms(up) < min(0.5 * rms(loose), SIGMA), name
        offset = solution.parameters["barometer_offset"]
        assert abs(offset.value[-1, 0] - OFFSET) < 4.0 * offset.sigma[-1, 0], name


def test_heights_hold_as_the_drive_happens(drive):
    assert rms(np.concatenate([errors(track, drive)[0] for track in smoothed_online(drive)])) < SIGMA
