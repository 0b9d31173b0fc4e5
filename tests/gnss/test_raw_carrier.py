"""Changes of carriers as measurements: on simulated drives, against GTSAM's factors, and where satellites are few."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import oracle
import pytest
import raw_drive
from helpers import errors, truth_states
from test_raw_rows import scene

from graphnav.config import parse_settings
from graphnav.constraints.raw_carrier import CHANGE, CLONES, RATES, GnssAntennaClone, GnssCarrier
from graphnav.constraints.raw_gnss import IONOSPHERE
from graphnav.core import earth
from graphnav.core.state import States
from graphnav.estimation.pipeline import run
from graphnav.gnss.carrier import find_rows, pair_consecutive
from graphnav.gnss.load import Sources, load_raw
from graphnav.gnss.signals import L1, C
from graphnav.recording import Gnss, Imu, Recording

NOISE = 0.003  # m, of a carrier


@pytest.fixture(scope="module")
def exact():
    path = oracle.vehicle_path(120.0, lat=-45.0)
    made, truth = oracle.drive(path, imu_noise=None, gnss_exact=True, gnss_velocity_sd=(0.1, 0.1, 0.1))
    return raw_drive.with_observations(made, path, carrier=0.0).crop(0.0, 60.0), truth


def at_the_truth(rows, where, truth):
    """States at the rows, and the values that their parameters truly have."""
    t = where.t[rows.keyframe]
    states = truth_states(truth, t, where.frame)
    given = {p.name: np.zeros((len(rows), p.size)) for p in rows.parameters}
    all_states = truth_states(truth, where.t, where.frame)
    antenna = all_states.p + all_states.R_nb @ rows.lever_arm
    for p in rows.parameters:
        if p.name in CLONES:
            node = np.searchsorted(p.begins, t + 1e-6, side="right") - 1
            given[p.name] = antenna[np.searchsorted(where.t, p.begins[np.maximum(node, 0)] - 1e-6)]
        if p.name == CHANGE:
            clock = 150.0 + 1.0 * p.begins - 40.0 * np.cos(0.05 * p.begins)
            change = np.concatenate([[0.0], np.diff(clock)])
            given[p.name] = change[np.searchsorted(p.begins, t - 1e-6), None]
    return states, given


@pytest.mark.parametrize(("cls", "limit"), [(GnssCarrier, 1e-4), (GnssAntennaClone, 1e-9)])
def test_rows_are_zero_at_the_truth(exact, cls, limit):
    """With exact carriers, made in space, and the true places of the antenna, attitudes and clocks."""
    recording, truth = exact
    where = scene(recording, settings(True), GnssCarrier)
    rows = cls.build(where)
    assert len(rows) > 50
    linear = rows.linearize(*at_the_truth(rows, where, truth), slice(None))
    assert np.abs(linear.residual).max() < limit


def test_a_change_is_the_difference_of_gtsams_carrier_factors(exact):
    """Two CarrierPhaseFactorArm with one ambiguity: their errors' difference, ionosphere taken off."""
    recording, truth = exact
    where = scene(recording, settings(True), GnssCarrier)
    rows = GnssCarrier.build(where)
    states, given = at_the_truth(rows, where, truth)
    moved = {name: value + (0.7 if name in CLONES else 0.0) for name, value in given.items()}
    raw, frame = recording.raw_gnss, where.frame
    model = gtsam.noiseModel.Isotropic.Sigma(1, 1.0)
    before, after = pair_consecutive(raw, raw)

    def error(k, place, attitude, lever):
        pose = gtsam.Pose3(gtsam.Rot3(frame.R_ne.T @ attitude), frame.r_e + frame.R_ne.T @ place)
        measured = raw.carrier[k] * C / L1
        factor = gtsam.CarrierPhaseFactorArm(0, 1, 2, float(measured), raw.p[k], lever, 0.0, model)
        values = gtsam.Values()
        values.insert(0, pose)
        values.insert(1, 0.0)
        values.insert(2, 0.0)
        return factor.unwhitenedError(values)[0]

    for k in range(5, len(rows), 61):
        linear = rows.linearize(states[np.array([k])], {n: v[k : k + 1] for n, v in moved.items()}, np.array([k]))
        own = [(j, i) for j, i in zip(before, after, strict=True) if raw.satellite[i] == rows.satellite[k]]
        j, i = next(x for x in own if abs(raw.t[x[1]] - where.t[rows.keyframe[k]]) < 1e-6)
        clone = moved[CLONES[rows.odd[k]]][k]
        now = error(i, states.p[k], states.R_nb[k], rows.lever_arm)
        then = error(j, clone, states.R_nb[k], np.zeros(3))
        change = now - then + moved[CHANGE][k, 0]
        # the ionosphere is no part of GTSAM's; over a second its change is that of the elevation
        assert linear.residual[0, 0] == pytest.approx(change, abs=2e-3)


PATH = oracle.vehicle_path(120.0, 50.0)
FEW = (45.0, 70.0)  # s


@pytest.fixture(scope="module")
def street():
    """Three satellites for 25 s, one of which slips by a cycle that no flag tells."""
    made, truth = oracle.drive(PATH, seed=5, gnss_velocity_sd=(0.1, 0.1, 0.1))
    made = raw_drive.with_observations(made, PATH, noise=1.0, seed=2, carrier=NOISE).crop(15.0, 72.0)
    raw = made.raw_gnss
    inside = (raw.t > FEW[0]) & (raw.t < FEW[1])
    left = np.unique(raw.satellite[inside])[[0, 3, 7]]
    raw = raw.take(~inside | np.isin(raw.satellite, left))
    slipped = replace(raw, carrier=raw.carrier + ((raw.satellite == left[0]) & (raw.t > 62.0)))
    return replace(made, raw_gnss=raw), replace(made, raw_gnss=slipped), truth


def drift(solution, truth):
    """By how much the error of the place changes while satellites are few, m."""
    off = errors(solution, truth)[0][(solution.t > FEW[0]) & (solution.t < FEW[1]), :2]
    return float(np.linalg.norm(off - off[0], axis=1).max())


def settings(differences):
    chosen = {"differences": differences, "coupling": "tight", "doppler": False}
    return parse_settings({"raw_gnss": chosen, "noise": {"mode": "stated"}})


def test_three_satellites_hold_the_place_in_every_solver(street):
    clean, slipped, truth = street
    found = run(clean, settings(True), ("ekf", "rts", "batch"))
    without = run(clean, settings(False), ("ekf", "rts"))
    for name, other in (("ekf", "ekf"), ("rts", "rts"), ("batch", "rts")):
        assert drift(found[name], truth) < 0.5 * drift(without[other], truth), name
    # the slip is a cycle, 0.19 m, between two epochs: a displacement of a decimetre where nothing is held against it
    despite = run(slipped, settings(True), ("batch",))["batch"]
    inside = (despite.t > FEW[0]) & (despite.t < FEW[1])
    assert np.abs(despite.states.p - found["batch"].states.p)[inside].max() < 0.05


def test_nothing_is_counted_across_slips_half_cycles_other_ephemerides_and_gaps(exact):
    raw = exact[0].raw_gnss
    one = raw.satellite == raw.satellite[0]
    t = np.unique(raw.t)

    def across(changed, k):
        before, after = pair_consecutive(changed, changed)
        own = changed.satellite[after] == raw.satellite[0]
        return bool(np.any(own & (changed.t[before] < t[k] - 0.1) & (changed.t[after] > t[k] - 0.1)))

    at = one & (raw.t == t[10])
    assert across(raw, 10)
    assert not across(replace(raw, slip=raw.slip | at), 10)
    assert not across(replace(raw, half=raw.half | at), 10)
    assert not across(replace(raw, clock=raw.clock + 0.5 * (one & (raw.t >= t[10]))), 10)
    assert not across(raw.take((raw.t < t[10]) | (raw.t > t[12])), 13)
    # a slip at an epoch that is left out
    flagged = replace(raw, slip=raw.slip | at)
    thin = flagged.take(np.isin(raw.t, t[1::2]))
    after = pair_consecutive(thin, flagged)[1]
    own = (thin.satellite[after] == raw.satellite[0]) & (np.abs(thin.t[after] - t[11]) < 0.1)
    assert not own.any()
    np.testing.assert_array_equal(raw.t[find_rows(thin, raw)], thin.t)


UCR, UCR_ZERO = "ucr_riverside_20200712", 2114 * 604800.0 + 5784.0


@pytest.fixture(scope="module")
def riverside(shared_data):
    """Codes and carriers of a real drive, and its true places (2400, 3), m in e, one a second."""
    folder = shared_data / UCR
    raw, fixes, _ = load_raw(Sources((folder / "rover.obs.gz",), (folder / "nav.gz",)), UCR_ZERO)
    table = np.genfromtxt(folder / "truth.csv.gz", delimiter=",", names=True)
    return raw, fixes, np.stack([table["x"], table["y"], table["z"]], -1)


def displacement(riverside, begin):
    """What five minutes of real carriers say of one displacement of all places, m, and its covariance."""
    raw, fixes, truth = riverside
    raw = raw.take((raw.t > begin) & (raw.t < begin + 300.0))
    inside = (fixes.t > begin) & (fixes.t < begin + 300.0)
    t = np.linspace(begin, begin + 300.0, 601)
    still = Imu(t[1:], np.zeros((600, 3)), np.tile([0.0, 0.0, 9.8], (600, 1)))
    gnss = Gnss(fixes.t[inside], earth.ecef_to_llh(fixes.p[inside]), np.ones((int(inside.sum()), 3)), derived=True)
    recording = Recording("riverside", "vehicle", still, gnss, gps_zero=UCR_ZERO, raw_gnss=raw)
    where = scene(recording, settings(True), GnssCarrier)
    rows, frame = GnssCarrier.build(where), where.frame
    place = (truth[np.clip(np.round(where.t).astype(int), 0, len(truth) - 1)] - frame.r_e) @ frame.R_ne.T
    k, n = rows.keyframe, len(rows)
    before = np.searchsorted(where.t, where.t[k] - rows.time - 1e-3)
    turns, zero = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    given = {p.name: np.zeros((n, p.size)) for p in rows.parameters} | dict.fromkeys(CLONES, place[before])
    linear = rows.linearize(States(turns, place[k], zero, zero, zero), given, slice(None))
    epoch = np.unique(k, return_inverse=True)[1][:, None] == np.arange(len(np.unique(k)))
    J = linear.jacobians
    prior = {p.name: p.sigma for p in rows.parameters}
    shift = J["p"] + J[CLONES[0]] + J[CLONES[1]]  # of all places together
    A = np.concatenate([shift[:, 0], J[RATES][:, 0], J[IONOSPHERE][:, 0], epoch], axis=1) / linear.sigma
    off = linear.residual[:, 0]
    kept = np.abs(off - np.array([np.median(off[k == one]) for one in k])) < 0.05  # m: no slip
    r = off / linear.sigma[:, 0]
    few = np.concatenate([np.zeros(3), prior[RATES] ** -2.0, prior[IONOSPHERE] ** -2.0, np.zeros(epoch.shape[1])])
    C = np.linalg.inv(A[kept].T @ A[kept] + np.diag(few))
    found = -(C @ A[kept].T @ r[kept])[:3]
    return found, C[:3, :3]


def test_sums_of_changes_do_not_claim_more_of_the_place_than_they_know(riverside):
    """Directions to satellites turn by 0.04 rad in five minutes: what lasts of their errors looks like a metre."""
    total = 0.0
    for begin in range(0, 2400, 300):
        found, C = displacement(riverside, begin)
        total += found @ np.linalg.solve(C, found)
    assert total < 51.2  # chi-square of 24, 99.9 %; 62 without rates of satellites and the ionosphere
