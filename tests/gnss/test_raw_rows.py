"""Codes and Doppler shifts as measurements: on simulated drives, against GTSAM's factors, and on a real drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import oracle
import pytest
import raw_drive
from helpers import errors, truth_states

from graphnav.config import parse_settings
from graphnav.constraints.base import BuildContext
from graphnav.constraints.gnss import GnssPosition
from graphnav.constraints.raw_gnss import BIASES, CLOCK, GnssCode, GnssDoppler
from graphnav.core.earth import LocalFrame
from graphnav.estimation.pipeline import run
from graphnav.gnss.signals import C
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.recording.formats import read

DATA = Path(__file__).resolve().parents[2] / "data"
TIGHT = parse_settings({"raw_gnss": {"coupling": "tight"}})


def scene(recording, settings=TIGHT, cls=GnssCode):
    t = np.unique(
        np.concatenate([[recording.start], cls.epochs(recording, settings, np.empty((0, 2))), [recording.end]])
    )
    t = t[np.concatenate([[True], np.diff(t) > 1e-6])]
    intervals = preintegrate(bridge_gaps(recording.imu), recording.imu, t, np.zeros(3), np.zeros(3))
    frame = LocalFrame(recording.gnss.llh[0])
    return BuildContext(recording, settings, frame, t, np.empty((0, 2)), intervals)


@pytest.fixture(scope="module")
def exact():
    path = oracle.vehicle_path(120.0, lat=-45.0)
    made, truth = oracle.drive(path, imu_noise=None, gnss_exact=True, gnss_velocity_sd=(0.1, 0.1, 0.1))
    return raw_drive.with_observations(made, path), truth


@pytest.mark.parametrize(("cls", "limit"), [(GnssCode, 2e-4), (GnssDoppler, 4e-3)])
def test_rows_are_the_measurement_of_the_truth(exact, cls, limit):
    """With exact observations, made in space, and the true states, clocks and bias the rows are zero."""
    recording, truth = exact
    where = scene(recording, cls=cls)
    rows = cls.build(where)
    t = where.t[rows.keyframe]
    clock = 150.0 + 1.0 * t - 40.0 * np.cos(0.05 * t)
    rate = 1.0 + 2.0 * np.sin(0.05 * t)
    given = {p.name: np.tile(p.initial, (len(rows), 1)) for p in rows.parameters if p.begins is None}
    given[CLOCK] = np.stack([clock, rate], -1)
    if BIASES in given:
        given[BIASES][:] = raw_drive.BIAS
    linear = rows.linearize(truth_states(truth, t, where.frame), given, slice(None))
    inside = (t > t[0] + 0.1) & (t < t[-1] - 0.1)  # where the rate of the simulation is a central difference
    assert np.abs(linear.residual[inside]).max() < limit


def test_code_rows_are_gtsams_pseudorange_factor_with_a_lever_arm(exact):
    """Distance by the Earth's turn in the flight, clocks, antenna off the body."""
    for rows, k, own, raw, _, pose, _, residual in picked(exact, GnssCode):
        # the ionosphere is no part of GTSAM's: taken off the code; its clocks are in seconds
        delay = rows.slant[k] * 5e-9 * C
        factor = gtsam.PseudorangeFactorArm(
            0, 1, float(raw.code[own]) - delay, raw.p[own], rows.lever_arm, 0.0, gtsam.noiseModel.Unit.Create(1)
        )
        values = gtsam.Values()
        values.insert(0, pose)
        values.insert(1, 0.0)
        assert factor.unwhitenedError(values)[0] == pytest.approx(residual, abs=1e-3)


def test_doppler_rows_are_gtsams_doppler_factor_with_a_lever_arm(exact):
    """But for what time is stretched by on the way, 1e-5 of the range rate, which GTSAM leaves out."""
    for rows, k, own, raw, state, pose, R_en, residual in picked(exact, GnssDoppler):
        length = C / raw.frequency[own]
        turning = rows.gyro[k] - state.bg[0] - state.R_nb[0].T @ rows.omega_n
        factor = gtsam.DopplerFactorArm(
            0, 1, 2, 3, -raw.range_rate[own] / length, length, raw.p[own], raw.v[own], pose.translation(),
            rows.lever_arm, turning, 1.0, 0.0, gtsam.noiseModel.Unit.Create(1),
        )  # fmt: skip
        values = gtsam.Values()
        values.insert(0, pose)
        values.insert(1, R_en @ state.v[0])
        values.insert(2, 0.0)
        values.insert(3, 0.0)
        limit = 2e-5 * abs(raw.range_rate[own]) + 5e-5
        assert factor.unwhitenedError(values)[0] == pytest.approx(residual, abs=limit)


def picked(exact, cls):
    """Some of the rows, where they are in the series, states and poses of the truth, and residuals without clocks."""
    recording, truth = exact
    where = scene(recording, cls=cls)
    rows, raw, frame = cls.build(where), recording.raw_gnss, where.frame
    states = truth_states(truth, where.t[rows.keyframe], frame)
    R_en = frame.R_ne.T
    none = {p.name: np.zeros((1, p.size)) for p in rows.parameters}
    for k in np.arange(3, len(rows), 97):
        here = (np.abs(raw.t - where.t[rows.keyframe[k]]) < 1e-6) & (raw.satellite == rows.satellite[k])
        state = states[np.array([k])]
        pose = gtsam.Pose3(gtsam.Rot3(R_en @ state.R_nb[0]), frame.r_e + R_en @ state.p[0])
        residual = rows.linearize(state, none, np.array([k])).residual[0, 0]
        yield rows, k, np.flatnonzero(here)[0], raw, state, pose, R_en, residual


PATH = oracle.vehicle_path(120.0, 50.0)


@pytest.fixture(scope="module")
def drive():
    made, truth = oracle.drive(PATH, seed=5, gnss_velocity_sd=(0.1, 0.1, 0.1))
    return raw_drive.with_observations(made, PATH, noise=1.0, seed=2).crop(0.0, 90.0), truth


def test_every_solver_gets_them(drive):
    recording, truth = drive
    settings = parse_settings({"noise": {"mode": "stated"}})
    solutions = run(recording, settings, ("ekf", "rts", "batch"))
    for name, one in solutions.items():
        assert {"gnss_code", "gnss_doppler"} <= set(one.records), name
        assert not {"gnss_position", "gnss_velocity"} & set(one.records)
        off, sd, _, _ = errors(one, truth)
        late = one.t > one.t[0] + 45.0
        assert np.sqrt(np.mean(off[late, :2] ** 2)) < 1.0, name
        # the stated sigmas of what lasts are not in the simulation: careful, and not beyond reason
        assert 0.01 < np.mean((off[late] / sd[late]) ** 2) < 1.5, name
    smoothed, batch = solutions["rts"], solutions["batch"]
    np.testing.assert_allclose(smoothed.states.p, batch.states.p, atol=0.02)
    assert batch.parameters[BIASES].value[-1, 0] == pytest.approx(raw_drive.BIAS, abs=1.5)


def test_a_satellite_that_is_late_is_let_go_of_by_evidence(drive):
    """One satellite's codes are 40 m late for a while: the estimated weights leave it, and the place stays."""
    recording, truth = drive
    raw = recording.raw_gnss
    late = (raw.satellite == raw.satellite[0]) & (raw.t > 60.0) & (raw.t < 75.0)
    assert late.sum() > 10
    spoiled = replace(recording, raw_gnss=replace(raw, code=raw.code + 40.0 * late))
    off = {
        mode: errors(run(spoiled, parse_settings({"noise": {"mode": mode}}), ("batch",))["batch"], truth)[0]
        for mode in ("stated", "estimated")
    }
    worst = {mode: np.linalg.norm(x[:, :2], axis=1).max() for mode, x in off.items()}
    assert worst["estimated"] < 0.5 * worst["stated"]
    assert worst["estimated"] < 3.0


def test_loose_and_tight_are_one_option_apart():
    recording = read(DATA / "tokyo_raw" / "recording.toml")
    none = np.empty((0, 2))
    for coupling, used, unused in (("loose", GnssPosition, GnssCode), ("tight", GnssCode, GnssPosition)):
        settings = parse_settings({"raw_gnss": {"coupling": coupling}})
        assert len(used.epochs(recording, settings, none)) > 100
        assert not len(unused.epochs(recording, settings, none))
    assert recording.is_tight("automatic")
    own = replace(recording, gnss=replace(recording.gnss, derived=False))
    assert not own.is_tight("automatic")
    assert recording.without("gnss").raw_gnss is None
    left = recording.without("gnss", (20.0, 40.0)).raw_gnss
    inside = (left.t - recording.start > 20.0) & (left.t - recording.start < 40.0)
    assert len(left)
    assert not inside.any()
