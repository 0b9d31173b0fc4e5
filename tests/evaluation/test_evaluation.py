"""Errors that are known beforehand come out as they were put in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from helpers import refused
from pymap3d.vincenty import vdist
from scipy.stats import chi2

import graphnav
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import RecordingError
from graphnav.core.interpolation import fit_yaw, interpolate
from graphnav.core.notes import get_key
from graphnav.core.trajectory import Trajectory
from graphnav.evaluation import evaluate as evaluation
from graphnav.recording import Gnss, Imu, Recording, Truth
from graphnav.recording.exporters import write_as

ORIGIN = np.array([0.62, 2.44, 30.0])
FRAME = LocalFrame(ORIGIN)
RADIUS, SPEED = 50.0, 10.0
OMEGA = SPEED / RADIUS


def circle(t: np.ndarray, origin: np.ndarray = ORIGIN) -> Trajectory:
    """Clockwise on a level circle that starts at the origin heading north: heading = OMEGA t."""
    frame = LocalFrame(origin)
    angle = OMEGA * t
    zero = np.zeros_like(t)
    p = RADIUS * np.column_stack([1.0 - np.cos(angle), np.sin(angle), zero])
    v = SPEED * np.column_stack([np.sin(angle), np.cos(angle), zero])
    R_ln = frame.R_ln(p)
    R_nb = rotation.from_rph(np.column_stack([zero, zero, angle]))
    return Trajectory(
        t, frame.to_llh(p), v=np.einsum("kij,kj->ki", R_ln, v), rph=rotation.to_rph(R_ln @ R_nb), name="circle"
    )


def moved(trajectory: Trajectory, d: np.ndarray) -> Trajectory:
    """Shifted by `d` (3,) or (K, 3) in the local ENU at each point, with an independent geodesy."""
    lat, lon, h = np.rad2deg(trajectory.llh[:, 0]), np.rad2deg(trajectory.llh[:, 1]), trajectory.llh[:, 2]
    d = np.broadcast_to(d, trajectory.llh.shape)
    out = pymap3d.enu2geodetic(d[:, 0], d[:, 1], d[:, 2], lat, lon, h)
    return replace(trajectory, llh=np.column_stack([np.deg2rad(out[0]), np.deg2rad(out[1]), out[2]]))


TIMES = np.arange(0.0, 60.0, 0.1)


def test_a_known_offset_is_the_error_and_every_number_made_of_it() -> None:
    truth = circle(TIMES)
    found = evaluation.compute_errors(moved(truth, np.array([3.0, -4.0, 12.0])), truth)
    np.testing.assert_allclose(found.p, np.tile([3.0, -4.0, 12.0], (len(truth), 1)), atol=1e-6)
    np.testing.assert_allclose(found.v, 0.0, atol=1e-12)

    numbers = evaluation.summarise(evaluation.measure(found))
    assert numbers["h_rms_m"] == numbers["h_p95_m"] == numbers["h_max_m"] == pytest.approx(5.0, abs=1e-4)
    assert numbers["3d_max_m"] == pytest.approx(13.0, abs=1e-4)
    assert numbers["n_mean_m"] == pytest.approx(-4.0, abs=1e-4)
    assert numbers["n_max_m"] == pytest.approx(4.0, abs=1e-4)  # of its size
    assert numbers["heading_rms_deg"] < 1e-9
    assert "nees_p" not in numbers  # without sigmas there is none


def test_compared_at_given_times_only_and_never_between_rows_of_the_estimate() -> None:
    truth = circle(TIMES)
    rows = np.arange(0, len(truth), 10)
    estimate = moved(truth.take(rows), np.column_stack([TIMES[rows], *np.zeros((2, len(rows)))]))
    at = np.append(estimate.t[5:20], 7.25)  # the last is no row of the estimate
    found = evaluation.compute_errors(estimate, truth, at=np.sort(at))
    np.testing.assert_array_equal(found.t, estimate.t[5:20])
    np.testing.assert_allclose(found.p[:, 0], found.t, atol=1e-6)
    assert found.epochs == 16
    assert not found.notes  # every time is a row of the truth


def test_rms_and_percentile_of_a_ramp() -> None:
    s = evaluation.measure(_errors_with(east=np.arange(101.0) - 100.0)).components["e"]
    assert s.rms == pytest.approx(np.sqrt(100 * 101 * 201 / 6 / 101))  # sum of squares of 0..100
    assert (s.p95, s.max, s.mean, s.n) == (95.0, 100.0, -50.0, 101)


def _errors_with(east: np.ndarray, nees: np.ndarray | None = None) -> evaluation.Errors:
    n = len(east)
    missing = np.full((n, 3), np.nan)
    p = np.column_stack([east, np.zeros(n), np.zeros(n)])
    return evaluation.Errors(
        np.arange(float(n)), p, missing[:, :2], missing, missing, missing, missing, missing,
        missing[:, 0] if nees is None else nees, missing, missing[:, 0], missing[:, 0], np.arange(n) * 2.0,
    )  # fmt: skip


def test_along_and_across_on_a_circle() -> None:
    truth = circle(TIMES)
    heading = OMEGA * TIMES
    ahead = np.column_stack([np.sin(heading), np.cos(heading), 0 * heading])
    right = np.column_stack([np.cos(heading), -np.sin(heading), 0 * heading])
    found = evaluation.compute_errors(moved(truth, 2.0 * ahead - 0.5 * right), truth)
    # The circle's plane is level at its start only: 100 m away the axes have turned by 2e-5 rad.
    np.testing.assert_allclose(found.track, np.tile([2.0, -0.5], (len(truth), 1)), atol=1e-4)


def test_direction_of_travel_is_undefined_when_slow_and_comes_from_positions_without_velocity() -> None:
    truth = circle(TIMES)
    crawling = replace(truth, v=truth.v * 0.04)  # 0.4 m/s
    assert np.isnan(evaluation.compute_errors(truth, crawling).track).all()

    bare = replace(truth, v=None, rph=None)
    found = evaluation.compute_errors(moved(truth, np.array([1.0, 0.0, 0.0])), bare)
    inner = slice(1, -1)  # central differences: exact in direction on a circle, not at the ends
    expected = np.column_stack([np.sin(OMEGA * TIMES), np.cos(OMEGA * TIMES)])
    np.testing.assert_allclose(found.track[inner], expected[inner], atol=1e-4)
    assert "truth.no_velocity" in map(get_key, found.notes)


def test_heading_wraps_at_north() -> None:
    truth = circle(TIMES)
    a = replace(truth, rph=np.tile(np.deg2rad([0.0, 0.0, 359.0]), (len(truth), 1)))
    b = replace(truth, rph=np.tile(np.deg2rad([0.0, 0.0, 2.0]), (len(truth), 1)))
    np.testing.assert_allclose(np.rad2deg(evaluation.compute_errors(a, b).rph[:, 2]), -3.0, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(evaluation.compute_errors(b, a).rph[:, 2]), 3.0, atol=1e-9)


def test_attitude_between_359_and_1_degree_is_north() -> None:
    rph = np.deg2rad([[0.0, 0.0, 359.0], [0.0, 0.0, 1.0]])
    pair = Trajectory(np.array([0.0, 1.0]), np.tile(ORIGIN, (2, 1)), rph=rph)
    out, ok = interpolate(pair, np.array([0.25]))
    assert ok.all()
    assert np.rad2deg(out.rph[0, 2]) == pytest.approx(359.5)


@pytest.mark.parametrize("step", [0.5, 1.0, 2.0])
def test_interpolation_on_a_circle_keeps_to_its_bound(step: float) -> None:
    dense = circle(np.arange(0.0, 60.0, 0.05))
    coarse = circle(np.arange(0.0, 60.0 + step, step))
    out, ok = interpolate(coarse, dense.t)
    assert ok.all()
    p, expected = FRAME.from_llh(out.llh), FRAME.from_llh(dense.llh)
    bound = step**4 / 384 * RADIUS * OMEGA**4  # cubic Hermite, per axis
    off = np.abs(p - expected).max()
    assert 0.5 * bound < off < 1.0001 * bound + 1e-8  # attained: the cubic is no better than its theory either
    # Steady turn: what the body sees is constant, so velocity and attitude are exact.
    np.testing.assert_allclose(out.v, dense.v, atol=1e-9)
    np.testing.assert_allclose(rotation.wrap(out.rph - dense.rph), 0.0, atol=1e-9)


@pytest.mark.parametrize("step", [0.5, 1.0, 2.0])
def test_without_velocity_a_spline_leads_through_the_rows(step: float) -> None:
    t = np.arange(20.0, 40.0, 0.05)  # its ends are less smooth
    out, _ = interpolate(replace(circle(np.arange(0.0, 60.0 + step, step)), v=None, rph=None), t)
    off = np.abs(FRAME.from_llh(out.llh) - FRAME.from_llh(circle(t).llh)).max()
    bound = step**4 / 384 * RADIUS * OMEGA**4
    assert 0.5 * bound < off < 5.0 * bound + 1e-8
    assert out.v is None


def test_nothing_is_extrapolated_and_no_gap_is_bridged() -> None:
    t = np.concatenate([np.arange(0.0, 10.0, 0.1), np.arange(20.0, 30.0, 0.1)])
    estimate = circle(t)
    wanted = np.array([-0.5, 0.0, 5.05, 9.9, 12.0, 20.0, 29.9, 30.5])
    _, ok = interpolate(estimate, wanted)
    assert ok.tolist() == [False, True, True, True, False, True, True, False]
    # The rows beside the gap are exact; only what lies inside it is out.
    found = evaluation.compute_errors(estimate, circle(np.arange(-5.0, 35.0, 0.1)))
    assert found.t.min() == pytest.approx(0.0, abs=1e-6)
    assert found.t.max() == pytest.approx(29.9, abs=1e-6)
    assert not ((found.t > 9.91) & (found.t < 19.99)).any()
    assert (len(found), found.epochs) == (200, 400)


def test_sparse_keyframes_are_compared_where_they_are() -> None:
    truth = circle(TIMES)
    keyframes = circle(np.arange(0.0, 59.0))

    # Attitude a wobble that no straight line between keyframes follows, in both.
    def wobble(x: Trajectory) -> Trajectory:
        return replace(x, rph=x.rph + np.column_stack([0.05 * np.sin(3.0 * x.t), 0 * x.t, 0 * x.t]))

    found = evaluation.compute_errors(wobble(keyframes), wobble(truth))
    assert len(found) == len(keyframes)
    np.testing.assert_allclose(found.rph, 0.0, atol=1e-9)
    assert "truth.interpolated" in map(get_key, found.notes)


def test_lever_arm_moves_position_velocity_and_covariance() -> None:
    arm = np.array([2.0, 1.0, 0.5])  # right, forward, up
    t = np.arange(0.0, 60.0, 0.1)
    imu = circle(t)
    # The antenna runs on a smaller circle, ahead in phase; the centre is on the right.
    p = FRAME.from_llh(imu.llh)
    R_nb = rotation.from_rph(np.column_stack([0 * t, 0 * t, OMEGA * t]))
    spin = np.array([0.0, 0.0, -OMEGA])  # clockwise
    p_antenna = p + R_nb @ arm
    v_n = SPEED * np.column_stack([np.sin(OMEGA * t), np.cos(OMEGA * t), 0 * t]) + R_nb @ np.cross(spin, arm)
    R_ln = FRAME.R_ln(p_antenna)
    antenna = Trajectory(t, FRAME.to_llh(p_antenna), v=np.einsum("kij,kj->ki", R_ln, v_n))
    sd = np.deg2rad([0.1, 0.2, 3.0])
    cov = np.zeros((len(t), 9, 9))
    cov[:, range(9), range(9)] = np.concatenate([[0.01, 0.02, 0.03, 0.1, 0.1, 0.1], sd]) ** 2
    found = evaluation.compute_errors(replace(imu, covariance=cov), antenna, lever_arm=arm)
    np.testing.assert_allclose(found.p, 0.0, atol=1e-7)
    np.testing.assert_allclose(found.v, 0.0, atol=1e-5)
    # At t = 0 right, forward, up are east, north, up, and the arm (2, 1, 0.5) in them. Rolling turns about
    # north: (0.5, 0, -2) m/rad; pitching about east: (0, -0.5, 1); heading about down: (1, -2, 0).
    roll, pitch, heading = sd
    expected = [
        np.sqrt(0.01**2 + (0.5 * roll) ** 2 + heading**2),
        np.sqrt(0.02**2 + (0.5 * pitch) ** 2 + (2.0 * heading) ** 2),
        np.sqrt(0.03**2 + (2.0 * roll) ** 2 + pitch**2),
    ]
    np.testing.assert_allclose(found.sd_p[0], expected, rtol=1e-4)


def test_missing_attitude_with_a_lever_arm_is_said() -> None:
    truth = circle(TIMES)
    found = evaluation.compute_errors(replace(truth, rph=None), truth, lever_arm=np.array([0.0, 3.0, 4.0]))
    assert "truth.lever_arm" in map(get_key, found.notes)


def test_nees_of_draws_from_a_known_covariance_is_in_its_band() -> None:
    rng = np.random.default_rng(11)
    n = 4000
    truth = circle(np.arange(n) * 0.1)
    root = rng.normal(size=(9, 9)) * np.array([1.0] * 3 + [0.1] * 3 + [0.003] * 3)[:, None]
    cov = root @ root.T
    draw = rng.normal(size=(n, 9)) @ root.T
    estimate = moved(truth, draw[:, :3])
    estimate = replace(
        estimate, v=truth.v + draw[:, 3:6], rph=truth.rph + draw[:, 6:], covariance=np.tile(cov, (n, 1, 1))
    )
    metrics = evaluation.measure(evaluation.compute_errors(estimate, truth))
    for key in ("p", "e", "n", "up", "v", "rph"):
        nees = metrics.nees[key]
        assert nees.n == n
        assert nees.low < nees.mean < nees.high, key
        assert abs(nees.inside - 0.95) < 4 * np.sqrt(0.95 * 0.05 / n), key
    # Correlations matter here: the sigmas alone, as a file has them, give another number.
    sd = np.sqrt(np.diag(cov))
    alone = replace(estimate, covariance=None, sd_p=np.tile(sd[:3], (n, 1)))
    found = evaluation.compute_errors(alone, truth)
    e = found.p
    np.testing.assert_allclose(found.nees_p, np.sum((e / sd[:3]) ** 2, axis=1), rtol=1e-9)
    assert "nees.no_correlations" in map(get_key, found.notes)


def test_an_overconfident_estimate_is_outside_the_band() -> None:
    rng = np.random.default_rng(12)
    truth = circle(TIMES)
    sd = np.full((len(truth), 3), 1.0)
    estimate = replace(moved(truth, 1.3 * rng.normal(size=sd.shape)), sd_p=sd)
    nees = evaluation.measure(evaluation.compute_errors(estimate, truth)).nees["p"]
    assert nees.mean > nees.high
    # A truth that is itself uncertain by as much as is missing makes up for it.
    honest = evaluation.measure(evaluation.compute_errors(estimate, replace(truth, sd_p=np.sqrt(0.69) * sd))).nees["p"]
    assert honest.low < honest.mean < honest.high


def test_ensemble_nees_averages_runs_not_time() -> None:
    rng = np.random.default_rng(5)
    n, runs = 50, 40
    # One draw per run held through the run: as correlated in time as can be.
    draws = chi2.rvs(3, size=runs, random_state=rng)
    found = [_errors_with(np.zeros(n), np.full(n, x)) for x in draws]
    t, mean, low, high = evaluation.average_ensemble_nees(found)
    assert len(t) == n
    np.testing.assert_allclose(mean, draws.mean() / 3)
    assert low == pytest.approx(chi2.ppf(0.025, 3 * runs) / (3 * runs))
    assert low < mean[0] < high


def test_singular_or_missing_covariance_gives_no_nees() -> None:
    truth = circle(TIMES)
    cov = np.zeros((len(truth), 9, 9))
    cov[:, :3, :3] = 1.0  # rank one
    found = evaluation.compute_errors(replace(truth, covariance=cov), truth)
    assert np.isnan(found.nees_p).all()
    assert np.isnan(found.nees_v).all()


def test_yaw_fit_recovers_a_rotation_exactly() -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(size=(20, 3)) * 30
    yaw, offset = 2.1, np.array([100.0, -50.0, 7.0])
    b = a @ rotation.exp(np.array([0.0, 0.0, yaw])).T + offset
    found_yaw, found_offset = fit_yaw(a, b)
    assert found_yaw == pytest.approx(yaw, abs=1e-12)
    np.testing.assert_allclose(found_offset, offset, atol=1e-11)


@pytest.mark.parametrize("flat", [False, True])
def test_truth_in_a_local_frame_is_fitted_first(flat: bool) -> None:
    estimate = circle(np.arange(0.0, 40.0, 0.1))
    estimate = replace(estimate, sd_p=np.ones((len(estimate), 3)))
    p = FRAME.from_llh(estimate.llh)[::10]
    yaw = -0.7
    xyz = (p - [5.0, 6.0, 1.0]) @ rotation.exp(np.array([0.0, 0.0, yaw]))  # rotated by -yaw
    heading = OMEGA * estimate.t[::10] + yaw
    if flat:
        xyz[:, 2] = np.nan
    truth = Trajectory(
        estimate.t[::10], xyz, rph=np.column_stack([0 * heading, 0 * heading, heading]), frame="local", name="room"
    )
    found = evaluation.compute_errors(estimate, truth)
    np.testing.assert_allclose(found.p[:, :2], 0.0, atol=1e-6)
    np.testing.assert_allclose(found.rph[:, 2], 0.0, atol=1e-4)  # the axes of the local level turn with place
    assert found.dof_p == (2 if flat else 3)
    assert np.isnan(found.p[:, 2]).all() == flat
    assert any(get_key(note) == "truth.fitted" and "-40.11" in note for note in found.notes)
    # What the fit cannot absorb stays an error: a truth half as large.
    assert (
        evaluation.measure(evaluation.compute_errors(estimate, replace(truth, llh=truth.llh / 2))).components["h"].rms
        > 10
    )
    assert ("up" in evaluation.measure(found).components) != flat


def test_both_in_local_frames() -> None:
    source = circle(np.arange(0.0, 40.0, 0.1))
    p = FRAME.from_llh(source.llh)
    a = Trajectory(source.t, p, frame="local")
    b = Trajectory(source.t, p @ rotation.exp(np.array([0.0, 0.0, 1.0])).T + 3.0, frame="local")
    found = evaluation.compute_errors(a, b)
    np.testing.assert_allclose(found.p, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.distance[-1], SPEED * 39.9, rtol=1e-3)


def test_a_local_truth_that_does_not_move_cannot_be_fitted() -> None:
    estimate = circle(TIMES)
    truth = Trajectory(TIMES, np.zeros((len(TIMES), 3)), frame="local")
    with refused("truth.too_little", RecordingError):
        evaluation.compute_errors(estimate, truth)


def test_distance_does_not_count_the_noise_of_standing_nor_the_curve_of_the_earth() -> None:
    t = np.arange(0.0, 1000.0, 0.1)
    # 100 km due north along a meridian at constant height, against an independent geodesic.
    lat = np.deg2rad(45.0) + np.linspace(0.0, 0.9, len(t)) * np.pi / 180
    path = np.column_stack([lat, np.full_like(t, 0.1), np.full_like(t, 0.0)])
    expected = float(np.squeeze(vdist(45.0, 5.0, 45.9, 5.0)[0]))
    assert evaluation_distance(t, path) == pytest.approx(expected, rel=1e-6)

    noise = np.random.default_rng(0).normal(size=(len(t), 3)) * 0.005
    still = moved(Trajectory(t, np.tile(ORIGIN, (len(t), 1))), noise).llh
    # Steps of sqrt(2) 5 mm Rayleigh, twice a second; each row counted, it would be five times that.
    assert evaluation_distance(t, still) == pytest.approx(2000 * 0.005 * np.sqrt(np.pi), rel=0.05)


def evaluation_distance(t: np.ndarray, llh: np.ndarray) -> float:
    trajectory = Trajectory(t, llh)
    return float(evaluation.compute_errors(trajectory, trajectory).distance[-1])


def test_a_span_reports_end_maximum_and_drift() -> None:
    truth = circle(TIMES)
    growing = np.where((TIMES >= 20) & (TIMES <= 40), 0.1 * (TIMES - 20), 0.0)
    up = np.where((TIMES >= 20) & (TIMES <= 40), -1.0, 0.0)
    estimate = moved(truth, np.column_stack([growing, 0 * up, up]))
    estimate = replace(estimate, sd_p=np.full((len(truth), 3), 0.5))
    metrics = evaluation.measure(evaluation.compute_errors(estimate, truth), spans=[(20.0, 40.0), (100.0, 110.0)])
    span, empty = metrics.spans
    assert span.end_h == span.max_h == pytest.approx(2.0, abs=1e-6)
    assert span.end_3d == pytest.approx(np.sqrt(5.0), abs=1e-6)
    assert span.max_up == pytest.approx(1.0, abs=1e-6)
    assert span.drift == pytest.approx(0.1, abs=1e-7)
    assert span.distance == pytest.approx(200.0, rel=1e-3)
    assert span.drift_percent == pytest.approx(1.0, rel=1e-3)
    # Mean over the span of (0.1 s)^2 and 1 in units of 0.25, over three degrees of freedom.
    s = np.arange(201) * 0.1
    assert span.nees == pytest.approx((np.mean((0.1 * s) ** 2) + 1.0) / 0.25 / 3, rel=1e-5)
    assert empty.n == 0
    assert evaluation.summarise(metrics)["spans"][1]["max_h_m"] is None


def test_closure_of_a_loop() -> None:
    t = np.linspace(0.0, 2 * np.pi / OMEGA, 1001)
    loop = circle(t)
    shift = np.linspace(0.0, 1.0, len(t))[:, None] * np.array([0.3, 0.4, -2.0])
    found = evaluation.measure_closure(moved(loop, shift))
    assert found.horizontal == pytest.approx(0.5, abs=1e-4)
    assert found.vertical == pytest.approx(-2.0, abs=1e-4)
    assert found.percent == pytest.approx(100 * 0.5 / (2 * np.pi * RADIUS), rel=2e-3)


def _recording(t: np.ndarray, gnss: Gnss | None = None, truth: Truth | None = None) -> Recording:
    imu = Imu(t, np.zeros((len(t), 3)), np.zeros((len(t), 3)))
    return Recording("made", "vehicle", imu, gnss=gnss, truth=truth)


def test_withheld_fixes_are_the_truth_of_their_span() -> None:
    t = 1000.0 + np.arange(0.0, 60.0, 0.1)
    arm = np.array([0.0, 0.0, 1.5])
    source = circle(t - 1000.0)
    fixes = moved(source, arm).take(slice(None, None, 10))
    gnss = Gnss(t[::10], fixes.llh, np.full((60, 3), 0.02), lever_arm=arm)
    recording = _recording(t, gnss)
    estimate = replace(moved(source, np.array([0.6, 0.8, 0.0])), t=t, sd_p=np.full((len(t), 3), 0.1))
    metrics = evaluation.evaluate_recording(estimate, recording, withheld=[("gnss", (20.05, 30.05))])
    assert metrics is not None
    assert metrics.n == 10
    span = metrics.spans[0]
    assert (span.start, span.end, span.n) == (20.05, 30.05, 10)  # in seconds from the start, as given
    assert span.max_h == pytest.approx(1.0, abs=1e-5)
    assert metrics.components["up"].max < 1e-5  # the lever arm was used
    assert "truth.lever_arm_sigma" in map(get_key, metrics.notes)
    assert metrics.nees["p"].mean == pytest.approx(1.0 / (0.1**2 + 0.02**2) / 3, rel=1e-4)
    assert evaluation.evaluate_recording(estimate, recording) is None
    with refused("truth.no_withheld_fix", RecordingError):
        evaluation.make_withheld_truth(recording, "gnss", [(500.0, 600.0)])


@pytest.mark.parametrize("rate", [0.0, 1e-3])
def test_withheld_fixes_are_met_on_the_receivers_clock_and_at_the_antenna_as_estimated(rate: float) -> None:
    t = 1000.0 + np.arange(0.0, 60.0, 0.1)
    arm, late = np.array([0.0, 0.0, 1.5]), 0.3
    fixes = moved(circle(t - 1000.0), arm).take(slice(None, None, 10))
    begin = t[0] - 0.1  # of the first sample
    stamps = begin + (fixes.t + 1000.0 + late - begin) / (1.0 + rate)
    recording = _recording(t, Gnss(stamps, fixes.llh, np.full((60, 3), 0.02)))
    estimate = replace(circle(t - 1000.0), t=t)
    antenna = evaluation.AntennaCalibration(np.array([-late]), arm[None], np.array([rate]))
    metrics = evaluation.evaluate_recording(
        estimate, recording, withheld=[("gnss", (20.05 + late, 30.05 + late))], antenna=antenna
    )
    assert metrics is not None
    assert metrics.spans[0].n == 10  # the span is on the clock of the fixes that were withheld
    assert metrics.spans[0].max_h < 1e-4
    assert metrics.components["up"].max < 1e-4
    assert "truth.clock_offset" in map(get_key, metrics.notes)
    stated = evaluation.evaluate_recording(estimate, recording, withheld=[("gnss", (20.05, 30.05))])
    assert stated is not None
    assert stated.spans[0].max_h > 0.9 * SPEED * late


def test_a_truth_of_the_antenna_is_met_at_the_antenna_as_estimated() -> None:
    t = np.arange(0.0, 60.0, 0.1)
    arm = np.array([0.0, 0.0, 1.5])
    antenna = moved(circle(t), arm)
    gnss = Gnss(t, antenna.llh, np.full((len(t), 3), 0.02), lever_arm=np.array([0.4, 0.0, 1.2]))
    recording = _recording(t, gnss, Truth(t, llh=antenna.llh, of="gnss"))
    for lever_arm, right, up in ((arm[None], 0.0, 0.0), (None, 0.4, 0.3)):
        metrics = evaluation.evaluate_recording(
            circle(t), recording, antenna=evaluation.AntennaCalibration(lever_arm=lever_arm)
        )
        assert metrics is not None
        assert metrics.components["h"].rms == pytest.approx(right, abs=1e-4)
        assert metrics.components["up"].rms == pytest.approx(up, abs=1e-4)


def test_a_solution_is_scored_against_the_truth_of_its_recording_by_the_public_name() -> None:
    t = np.arange(0.0, 60.0, 0.1)
    source = circle(t)
    recording = _recording(t, None, Truth(t, llh=source.llh, v=source.v, rph=source.rph))
    estimate = replace(moved(source, np.array([3.0, -4.0, 12.0])), sd_p=np.tile([3.0, 4.0, 6.0], (len(t), 1)))
    metrics = graphnav.evaluate_recording(estimate, recording)
    assert metrics is not None
    assert metrics.n == len(t)
    assert metrics.components["h"].rms == pytest.approx(5.0, abs=1e-4)
    assert metrics.components["up"].rms == pytest.approx(12.0, abs=1e-4)
    assert metrics.nees["p"].mean == pytest.approx((1.0 + 1.0 + 4.0) / 3.0, rel=1e-4)
    assert graphnav.evaluate_recording(estimate, recording, at=t[5:15]).n == 10
    assert graphnav.evaluate_recording(estimate, replace(recording, truth=None)) is None


def test_truth_of_a_recording() -> None:
    t = np.arange(0.0, 10.0, 0.1)
    source = circle(t)
    arm = np.array([0.1, 0.2, 0.3])
    gnss = Gnss(t, source.llh, np.ones((len(t), 3)), lever_arm=arm)
    found = evaluation.find_truth(_recording(t, gnss, Truth(t, llh=source.llh, of="gnss")))
    assert found is not None
    np.testing.assert_array_equal(found[1], arm)
    with refused("truth.no_lever_arm", RecordingError, "[gnss]"):
        evaluation.find_truth(_recording(t, None, Truth(t, llh=source.llh, of="gnss")))
    local = evaluation.find_truth(_recording(t, None, Truth(t, xyz=np.zeros((len(t), 2)))))
    assert local is not None
    assert local[0].frame == "local"
    assert np.isnan(local[0].llh[:, 2]).all()
    loop = _recording(t, None, Truth(t[:0], closed_loop_sigma=0.01))
    assert evaluation.find_truth(loop) is None
    metrics = evaluation.evaluate_recording(source, loop)
    assert metrics is not None
    assert metrics.closure is not None
    assert "closure_h_m" in evaluation.summarise(metrics)
    assert "closure" in evaluation.format_metrics(metrics)


def test_files_in_numbers_out(tmp_path: Path) -> None:
    truth = circle(TIMES)
    write_as("csv", truth, tmp_path / "truth.csv")
    write_as("csv", moved(truth, np.array([3.0, 4.0, 0.0])), tmp_path / "a.csv")
    write_as("tum", truth, tmp_path / "b.tum")
    metrics = evaluation.evaluate(tmp_path / "a.csv", tmp_path / "truth.csv", spans=[(10.0, 20.0)])
    assert metrics.components["h"].rms == pytest.approx(5.0, abs=2e-5)
    assert metrics.name == "a"
    table = evaluation.format_metrics(metrics)
    assert "horizontal           5.000" in table
    assert "10.0-20.0" in table
    local = evaluation.evaluate(tmp_path / "b.tum", tmp_path / "truth.csv")
    assert local.components["3d"].max < 1e-4

    rows = evaluation.tabulate({"ekf": metrics, "batch": local})
    evaluation.write_comparison_csv(tmp_path / "comparison.csv", rows)
    head, first, second = (tmp_path / "comparison.csv").read_text().splitlines()
    assert head.startswith("solver,n,epochs,")
    assert first.split(",")[head.split(",").index("h_rms_m")] == "5.0"
    assert second.split(",")[head.split(",").index("span1_max_h_m")] == ""


@pytest.mark.parametrize(
    ("shift", "hint"),
    [
        (604800.0 * 3, "seconds of the week"),
        (86400.0, "seconds of the day"),
        (315964782.0, "Unix time"),
        (5000.0, "own start"),
    ],
)
def test_times_that_do_not_overlap_are_said_with_the_likely_reason(tmp_path: Path, shift: float, hint: str) -> None:
    truth = circle(TIMES)
    write_as("csv", truth, tmp_path / "a.csv")
    write_as("csv", replace(truth, t=truth.t + shift), tmp_path / "truth.csv")
    with refused("truth.no_overlap", RecordingError, hint, f"{shift:.3f} to {shift + 59.9:.3f}"):
        evaluation.evaluate(tmp_path / "a.csv", tmp_path / "truth.csv")


def test_eighteen_seconds_of_utc_are_recognised(tmp_path: Path) -> None:
    t = np.arange(0.0, 100.0, 0.1)
    write_as("csv", circle(t), tmp_path / "truth.csv")
    write_as("csv", replace(circle(t), t=t - 18.0), tmp_path / "a.csv")
    notes = evaluation.evaluate(tmp_path / "a.csv", tmp_path / "truth.csv").notes
    assert "truth.leap_seconds" in map(get_key, notes)
    write_as("csv", circle(t[:100]), tmp_path / "short.csv")
    write_as("csv", replace(circle(t[:100]), t=t[:100] + 18.0), tmp_path / "far.csv")
    with refused("truth.no_overlap", RecordingError, "UTC", "18 s"):
        evaluation.evaluate(tmp_path / "short.csv", tmp_path / "far.csv")


def test_clocks_that_are_known_are_put_on_one(tmp_path: Path) -> None:
    """A trajectory in seconds of the GPS week, a truth whose zero is a date."""
    t = np.arange(0.0, 100.0, 0.5)
    known = circle(t)
    nav = replace(known, t=t + 364500.0, gps_zero=2130 * 604800.0, v=known.v, rph=np.zeros((len(t), 3)))
    write_as("nav", nav, tmp_path / "a.nav")
    recording = "\n".join(
        [
            'format = "graphnav-recording/1"', 'platform = "vehicle"', 'clock = "2020-11-05T05:14:42Z"',
            '[imu]', 'file = "imu.csv"', '[truth]', 'file = "truth.csv"',
        ]
    )  # fmt: skip
    (tmp_path / "recording.toml").write_text(recording)
    rows = "".join(f"{x:.2f},0,0,0,0,0,9.81\n" for x in np.arange(0.0, 100.0, 0.1))
    (tmp_path / "imu.csv").write_text("t,gx,gy,gz,ax,ay,az\n" + rows)
    write_as("csv", known, tmp_path / "truth.csv")
    found = evaluation.evaluate(tmp_path / "a.nav", tmp_path)
    assert "against.clock" in map(get_key, found.notes)
    assert found.errors is not None
    assert len(found.errors) == len(t)
    assert found.errors.horizontal.max() < 1e-3


def test_a_denser_truth_may_be_of_fixes_with_types_and_satellites() -> None:
    dense = circle(np.arange(0.0, 60.0, 0.1))
    fixes = replace(dense, v=None, fix_type=np.ones(len(dense)), satellites=np.full(len(dense), 17.0))
    found = evaluation.compute_errors(circle(np.arange(1.0, 58.0, 1.0)), fixes)
    assert len(found) == 57
    assert found.horizontal.max() < 1e-3


def test_the_oracle_drive_against_a_perturbed_copy(shared_data: Path, tmp_path: Path) -> None:
    file = shared_data / "oracle_drive" / "truth.csv.gz"
    truth = evaluation.read_trajectory(file)
    rng = np.random.default_rng(1)
    sd = np.tile([0.5, 1.0, 2.0], (len(truth), 1))
    estimate = replace(moved(truth, rng.normal(size=sd.shape) * sd), sd_p=sd)
    write_as("csv", estimate, tmp_path / "a.csv")
    metrics = evaluation.evaluate(tmp_path / "a.csv", file)
    assert metrics.n == len(truth)
    assert metrics.nees["p"].low < metrics.nees["p"].mean < metrics.nees["p"].high
    assert metrics.components["up"].rms == pytest.approx(2.0, rel=4 / np.sqrt(2 * metrics.n))
    assert metrics.components["heading"].max < 1e-4  # written with 1e-7 deg, read back the same


def test_a_recording_is_a_truth_with_its_lever_arm(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "oracle_drive"
    write_as("csv", evaluation.read_trajectory(folder / "truth.csv.gz"), tmp_path / "a.csv")
    assert evaluation.evaluate(tmp_path / "a.csv", folder).components["3d"].max < 2e-5
    metrics = evaluation.evaluate(tmp_path / "a.csv", shared_data / "openshoe_loops" / "run02.toml")
    assert metrics.closure is not None
    assert metrics.n == 0


def test_covariance_at_the_end_of_a_lever_arm_follows_small_changes_of_the_state() -> None:
    t = np.array([9.9, 10.0, 10.1])
    base = circle(t)
    base = replace(base, rph=base.rph + np.array([0.2, -0.3, 0.0]))
    arm = np.array([2.0, 1.0, 0.5])
    R = rotation.from_rph(base.rph)

    def at_point(d: np.ndarray) -> np.ndarray:
        """(p, v, rph) of the arm's end with the state changed by d; an attitude error keeps its axis in space."""
        turned = rotation.from_rph(base.rph[1] + d[6:]) @ R[1].T @ R
        llh = FRAME.to_llh(FRAME.from_llh(base.llh) + d[:3])
        out, _ = interpolate(
            replace(base, llh=llh, v=base.v + d[3:6], rph=rotation.to_rph(turned)), t[1:2], lever_arm=arm
        )
        return np.concatenate([FRAME.from_llh(out.llh[0]), out.v[0], out.rph[0]])

    step = 1e-4
    A = np.column_stack([(at_point(step * e) - at_point(-step * e)) / (2 * step) for e in np.eye(9)])
    root = np.random.default_rng(8).normal(size=(9, 9)) * np.array([0.1] * 3 + [0.02] * 3 + [0.01] * 3)[:, None]
    cov = root @ root.T
    at, _ = interpolate(replace(base, covariance=np.tile(cov, (3, 1, 1))), t[1:2], lever_arm=arm)
    expected = A @ cov @ A.T
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(at.covariance[0] / np.outer(sd, sd), expected / np.outer(sd, sd), atol=2e-4)


def test_an_estimate_in_a_local_frame_brings_velocity_and_covariance_along() -> None:
    truth = circle(np.arange(0.0, 40.0, 0.1))
    yaw = 2.0
    R_nm = rotation.exp(np.array([0.0, 0.0, yaw]))
    p, v = FRAME.from_llh(truth.llh), truth.v
    cov = np.tile(np.diag([4.0, 1.0, 9.0, 0.4, 0.1, 0.9, 1e-4, 1e-4, 1e-4]), (len(truth), 1, 1))
    local = Trajectory(truth.t, p @ R_nm, v=v @ R_nm, covariance=cov, frame="local", name="room")
    found = evaluation.compute_errors(local, truth)
    np.testing.assert_allclose(found.v, 0.0, atol=2e-4)  # 100 m turn the local level by 2e-5 rad
    c, s = np.cos(yaw) ** 2, np.sin(yaw) ** 2
    np.testing.assert_allclose(found.sd_p[0], np.sqrt([4 * c + s, 4 * s + c, 9.0]), rtol=1e-4)
    np.testing.assert_allclose(found.sd_v[0], np.sqrt([0.4 * c + 0.1 * s, 0.4 * s + 0.1 * c, 0.9]), rtol=1e-4)


def test_no_direction_of_travel_is_taken_across_a_gap() -> None:
    t = np.concatenate([np.arange(0.0, 10.0, 0.1), np.arange(20.0, 30.0, 0.1)])
    estimate = moved(circle(t), np.array([1.0, 0.0, 0.0]))
    bare, known = (
        evaluation.compute_errors(estimate, x).track for x in (replace(circle(t), v=None, rph=None), circle(t))
    )
    np.testing.assert_allclose(bare, known, atol=1e-3)
