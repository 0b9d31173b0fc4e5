"""A second antenna, simulated on the truth of a drive, through every solver and as the drive happens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import refused
from pydantic import ValidationError
from scipy.stats import chi2
from series_drive import SETTINGS, along_truth, errors, rms, shared_drive, smoothed_online, with_series

from graphnav.app.scores import score
from graphnav.core import rotation
from graphnav.core.errors import RecordingError
from graphnav.core.notes import get_key
from graphnav.detectors import detect
from graphnav.estimation.alignment.antennas import measure_baseline_heading
from graphnav.estimation.pipeline import run
from graphnav.evaluation.metrics import summarise
from graphnav.online import Online, drop_rows, list_rows
from graphnav.recording import Recording
from graphnav.sensors.dual_antenna import SENSOR, DualAntennaKeys
from graphnav.simulation import simulate
from graphnav.simulation.series import DualAntennaModel

SIGMA, TURNED = np.radians(0.2), np.radians(0.6)
BASELINE = (1.0, 0.0, 0.05)  # across the roof


@pytest.fixture(scope="module")
def drive(shared_data) -> Recording:
    recording = shared_drive(shared_data)
    t, truth = along_truth(recording, 1.0)
    d = rotation.from_rph(truth.rph) @ np.array(BASELINE)
    white = np.random.default_rng(3).standard_normal((2, len(t)))
    heading = np.arctan2(d[:, 0], d[:, 1]) + TURNED + SIGMA * white[0]
    pitch = np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1])) + SIGMA * white[1]
    pitch[::3] = np.nan  # as of a receiver that does not always tell it
    columns = {"heading": heading % (2.0 * np.pi), "pitch": pitch, "sd_heading": np.full(len(t), SIGMA)}
    return with_series(recording, SENSOR.make_series(t, columns, baseline=BASELINE, sigma=0.2))


def test_heading_holds_without_fixes(drive):
    solvers = ("ekf", "rts", "batch", "isam2")
    found = run(drive, SETTINGS, solvers)
    without = run(drive.without(SENSOR.name), SETTINGS, ("ekf", "rts"))
    rows = len(drive.sensors[SENSOR.name])
    for name in solvers:
        solution, other = found[name], without["ekf" if name == "ekf" else "rts"]
        assert solution.counts["dual_antenna_heading"] == rows, name
        assert solution.counts["dual_antenna_pitch"] == rows - len(range(0, rows, 3)), name
        heading, loose = (errors(one.trajectory(), drive)[1] for one in (solution, other))
        assert rms(heading) < 0.5 * rms(loose), name
        offset = solution.parameters["dual_antenna_heading_offset"]
        assert abs(offset.value[-1, 0] - TURNED) < 4.0 * offset.sigma[-1, 0], name
        assert offset.sigma[-1, 0] < offset.prior_sigma[0], name


def test_heading_holds_as_the_drive_happens(drive):
    # what is not known of the mounting comes on top of the receiver's noise
    assert rms(np.concatenate([errors(track, drive)[1] for track in smoothed_online(drive)])) < np.radians(1.0)


@pytest.fixture(scope="module")
def standing() -> Recording:
    """The first twelve seconds of a simulated town, in which the car does not move."""
    made = simulate("urban", 1, duration=240.0, tunnels=0, antennas=True, rate=50.0)
    assert made.stops[0, 1] > 15.0
    recording = made.recording.crop(0.0, 12.0)
    series = recording.sensors[SENSOR.name]
    values = series.values.copy()
    values[1, 0] += np.pi  # one that is wrong must not decide
    return replace(recording, sensors={SENSOR.name: replace(series, values=values)})


def test_a_vehicle_that_stands_knows_its_heading(standing):
    found = measure_baseline_heading(standing, SETTINGS, detect(standing).stationary)
    true = standing.truth.rph[0, 2]
    assert abs(rotation.wrap(found.heading - true)) < 4.0 * found.sigma
    assert found.sigma < np.radians(1.5)
    solution = run(standing, SETTINGS, ("batch",))["batch"]
    track = solution.trajectory()
    assert "alignment.antennas" in map(get_key, solution.notes)
    assert np.all(np.abs(rotation.wrap(track.rph[:, 2] - true)) < 4.0 * track.sd_rph[:, 2])
    assert np.all(track.sd_rph[:, 2] < np.radians(1.5))
    blind = run(standing.without(SENSOR.name), SETTINGS, ("batch",))["batch"]
    assert "alignment.no_motion" in map(get_key, blind.notes)


def test_its_heading_is_known_live_before_it_moves(standing):
    online = Online(drop_rows(standing), SETTINGS)
    for row in list_rows(standing)[1]:
        online.add(row)
    now = online.live()
    assert now is not None
    heading = rotation.to_rph(now.state.R_nb[0])[2]
    assert abs(rotation.wrap(heading - standing.truth.rph[0, 2])) < 4.0 * np.radians(1.1)


def test_on_the_move_readings_tell_no_start(drive):
    assert measure_baseline_heading(drive, SETTINGS, np.empty((0, 2))) is None
    assert measure_baseline_heading(drive, SETTINGS, None) is not None  # as long as nobody has looked for stops
    far = drive.crop(10.0, 30.0)
    assert measure_baseline_heading(far, SETTINGS, np.array([[drive.start + 15.0, drive.start + 20.0]])) is None


def test_a_baseline_that_stands_upright_is_refused():
    with pytest.raises(ValidationError) as caught:
        DualAntennaKeys(baseline=(0.0, 0.0, 1.0))
    assert [error["loc"] for error in caught.value.errors()] == [("baseline",)]
    with refused("sensor.column", RecordingError, "roll"):
        SENSOR.make_series(np.arange(2.0), {"roll": np.zeros(2)})


def test_errors_that_last_are_not_taken_for_white() -> None:
    """A simulated receiver's reflections last for a minute: taken for white, its headings led a filter astray."""
    made = simulate("urban", 11, duration=300.0, tunnels=0, antennas=True, rate=50.0)
    used = made.recording.without("gnss", (100.0, 200.0))
    solution = run(used, solvers=("ekf",))["ekf"]
    model = DualAntennaModel()
    for name, size in ((".heading", model.white), (".minutes.heading", model.slow)):
        figure = solution.noise.figures[f"dual_antenna_heading{name}"]
        true = 2.0 * np.log(size / np.hypot(model.white, model.slow))
        assert abs(figure.log_factor - true) < 3.0 * figure.sigma, name
    found = score(made.recording, used, {"ekf": solution}, (("gnss", (100.0, 200.0)),))[0]["ekf"]
    assert summarise(found)["nees_p"] < chi2.isf(1e-3, 3) / 3.0  # errors of one outage are one draw of three numbers
