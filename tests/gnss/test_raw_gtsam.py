"""Rows of codes and carriers against a base station, values and derivatives, beside GTSAM's own factors."""

from __future__ import annotations

import itertools

import gtsam
import numpy as np
import oracle
import pytest
import raw_drive
from helpers import truth_states
from test_raw_rows import scene
from test_raw_rtk import STATED, WAVELENGTH, delay_of, true_values, with_carriers

from graphnav.constraints.raw_gnss import BIASES, CLOCK, IONOSPHERE, GnssCode
from graphnav.constraints.raw_phase import GnssPhase
from graphnav.gnss.ephemeris import OMEGA_WGS84
from graphnav.gnss.signals import C

UNIT = gtsam.noiseModel.Unit.Create(1)
POSE, RECEIVER, WET, DELAY, CYCLES = range(5)


@pytest.fixture(scope="module")
def off_the_truth():
    """Rows of both kinds with their series, linearised off the truth in everything that they depend on."""
    path = oracle.vehicle_path(120.0, lat=-45.0)
    made, truth = oracle.drive(path, imu_noise=None, gnss_exact=True, gnss_velocity_sd=(0.1, 0.1, 0.1))
    recording = raw_drive.with_observations(made, path).crop(0.0, 40.0)
    recording, position = with_carriers(recording, path, 0.0)
    found = {}
    for cls in (GnssCode, GnssPhase):
        where = scene(recording, STATED)
        rows = cls.build(where)
        states = truth_states(truth, where.t[rows.keyframe], where.frame)
        step = np.tile([0.2, -0.1, 0.3, 0.4, -0.7, 0.2, *np.zeros(9)], (len(rows), 1))
        states = states.plus(step)
        if cls is GnssPhase:
            values = true_values(rows, where, recording.raw_gnss, rows.keyframe)
            values[rows.slots[1]] = values[rows.slots[1]] + 3.0
        else:
            values = {p.name: np.zeros((len(rows), p.size)) for p in rows.parameters}
        values[CLOCK] = values[CLOCK] + [25.0, 0.0]
        values[IONOSPHERE] = values[IONOSPHERE] + 0.4
        found[cls] = rows, where, states, values, rows.linearize(states, values, slice(None))
    return found, recording.raw_gnss, position


def chosen(rows, where, raw, every=23):
    """Some of the rows of the reference's system, and where they are in the series."""
    for k in np.flatnonzero(rows.satellite < 200)[::every]:
        here = (np.abs(raw.t - where.t[rows.keyframe[k]]) < 1e-6) & (raw.satellite == rows.satellite[k])
        yield int(k), int(np.flatnonzero(here)[0])


def pose_of(states, frame, k):
    R_en = frame.R_ne.T
    return gtsam.Pose3(gtsam.Rot3(R_en @ states.R_nb[k]), frame.r_e + R_en @ states.p[k])


def measured(rows, raw, k, here):
    """m, a code or carrier with what is taken off it and GTSAM's factors have no part of."""
    if isinstance(rows, GnssPhase):
        return WAVELENGTH * raw.carrier[here] + raw.carrier_difference[here] + delay_of(rows, raw, here, k)
    return raw.code[here] + raw.difference[here] - delay_of(rows, raw, here, k)


def test_rows_are_gtsams_undifferenced_factors_and_so_are_their_derivatives(off_the_truth):
    """Distance by the Earth's turn in the flight, clock, slant delay and cycles, antenna off the body."""
    found, raw, _ = off_the_truth
    for rows, where, states, values, linear in found.values():
        carrier = isinstance(rows, GnssPhase)
        for k, here in chosen(rows, where, raw):
            given, J = gtsam.Values(), {name: x[k, 0] for name, x in linear.jacobians.items() if name != BIASES}
            given.insert(POSE, pose_of(states, where.frame, k))
            given.insert(RECEIVER, values[CLOCK][k, 0] / C)
            given.insert(WET, 0.0)
            given.insert(DELAY, values[IONOSPHERE][k, 0])
            slant, known = float(rows.slant[k]), float(measured(rows, raw, k, here))
            if carrier:
                slot = rows.slots[rows.slot[k]]
                given.insert(CYCLES, values[slot][k, 0])
                factor = gtsam.UndifferencedCarrierPhaseFactorArm(
                    POSE, RECEIVER, WET, DELAY, CYCLES, known, raw.p[here], rows.lever_arm, 1.0, -slant, WAVELENGTH,
                    0.0, UNIT,
                )  # fmt: skip
            else:
                factor = gtsam.UndifferencedPseudorangeFactorArm(
                    POSE, RECEIVER, WET, DELAY, known, raw.p[here], rows.lever_arm, 1.0, slant, 0.0, UNIT
                )
            assert factor.unwhitenedError(given)[0] == pytest.approx(linear.residual[k, 0], abs=1e-3)
            theirs = np.split(factor.linearize(given).jacobian()[0][0], [6, 7, 8, 9])
            np.testing.assert_allclose(theirs[0], [*J["theta"], *(J["p"] @ states.R_nb[k])], atol=1e-5)
            assert theirs[1] / C == pytest.approx(J[CLOCK][:1])
            assert theirs[3] == pytest.approx(J[IONOSPHERE])
            if carrier:
                assert theirs[4] == pytest.approx(J[slot])


def test_code_rows_are_gtsams_differential_factors_of_the_bases_correction(off_the_truth):
    """The base's correction, and the delay by the model, are taken off the code by a variable of its own."""
    found, raw, _ = off_the_truth
    rows, where, states, values, linear = found[GnssCode]
    for k, here in chosen(rows, where, raw):
        given, J = gtsam.Values(), linear.jacobians
        correction = raw.difference[here] - delay_of(rows, raw, here, k) - rows.slant[k] * values[IONOSPHERE][k, 0]
        for key, value in ((RECEIVER, values[CLOCK][k, 0] / C), (DELAY, correction)):
            given.insert(key, value)
        given.insert(POSE, pose_of(states, where.frame, k))
        factor = gtsam.DifferentialPseudorangeFactorArm(
            POSE, RECEIVER, DELAY, raw.code[here], raw.p[here], rows.lever_arm, 0.0, UNIT
        )
        assert factor.unwhitenedError(given)[0] == pytest.approx(linear.residual[k, 0], abs=1e-3)
        theirs = np.split(factor.linearize(given).jacobian()[0][0], [6, 7])
        np.testing.assert_allclose(theirs[0], [*J["theta"][k, 0], *(J["p"][k, 0] @ states.R_nb[k])], atol=1e-5)
        assert theirs[1] / C == pytest.approx(J[CLOCK][k, 0, :1])
        assert theirs[2] == pytest.approx([-1.0])  # added to the code, as a correction is


def test_differences_of_code_rows_are_gtsams_double_differences(off_the_truth):
    found, raw, position = off_the_truth
    rows, where, states, _, linear = found[GnssCode]
    seen = 0
    for (i, a), (j, b) in itertools.pairwise(chosen(rows, where, raw, every=1)):
        if rows.keyframe[i] != rows.keyframe[j] or rows.keyframe[i] % 9:
            continue
        # the base's codes are its distances, which GTSAM turns; what they are off by is in the rover's
        p = raw.p[[a, b]]
        turned = OMEGA_WGS84 / C * (p[:, 0] * position[1] - p[:, 1] * position[0])
        away = np.linalg.norm(p - position, axis=1) + turned
        own = [measured(rows, raw, row, here) for row, here in ((i, a), (j, b))]
        factor = gtsam.DoubleDifferencePseudorangeFactorArm(
            POSE, own[0], away[0], own[1], away[1], p[0], p[1], p[0], p[1], position, rows.lever_arm, UNIT
        )
        given = gtsam.Values()
        given.insert(POSE, pose_of(states, where.frame, i))
        # of the first less the second, as GTSAM has it, without the delay that was added, which is no part of its
        ours = linear.residual[i, 0] - linear.residual[j, 0] - 0.4 * (rows.slant[i] - rows.slant[j])
        assert factor.unwhitenedError(given)[0] == pytest.approx(ours, abs=1e-3)
        theta, p_n = (linear.jacobians[name][i, 0] - linear.jacobians[name][j, 0] for name in ("theta", "p"))
        derivative = [*theta, *(p_n @ states.R_nb[i])]
        np.testing.assert_allclose(factor.linearize(given).jacobian()[0][0], derivative, atol=1e-5)
        seen += 1
    assert seen > 10
