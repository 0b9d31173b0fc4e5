"""Walks: stances found, the pivot they turn about, standing, heel strikes, loops; simulated feet and two real walks."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from helpers import Array, assert_told

from graphnav.app.workflow import Request, run_request
from graphnav.config import Settings, parse_settings
from graphnav.constraints.base import BuildContext
from graphnav.constraints.foot import FOOT_AXIS, PATTERN, PIVOT, TRAVEL, FootLateral, Stance
from graphnav.constraints.standstill import ZeroRate, _estimate_swaying
from graphnav.core import rotation as ro
from graphnav.core.earth import LocalFrame
from graphnav.core.interpolation import interpolate
from graphnav.core.notes import get_key
from graphnav.core.state import States, split_covariance
from graphnav.detectors import detect
from graphnav.detectors.base import Detection
from graphnav.estimation.pipeline import run
from graphnav.estimation.problem import choose_keyframes
from graphnav.estimation.solution import Solution
from graphnav.evaluation.strides import compare_shapes, compute_walk_errors, estimate_floor_sigma
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Imu, Recording, Truth, take_rows
from graphnav.recording.checks.overview import inspect
from graphnav.recording.formats import read
from graphnav.report.doubts import list_doubts
from graphnav.simulation import Simulated, simulate

PACES = ("slow", "normal", "fast")


@lru_cache(maxsize=8)
def made(pace: str, exact: bool = False, course: str = "laps") -> Simulated:
    return simulate("gait", 1, pace=pace, exact=exact, course=course)


@lru_cache(maxsize=1)
def solved() -> dict[str, Solution]:
    """What every solver makes of the walk at a normal pace; nothing changes a solution."""
    return run(made("normal").recording)


def true_states(walk: Simulated, t: Array, frame: LocalFrame) -> States:
    """The truth between its rows, 5 ms apart, in the navigation frame."""
    at, inside = interpolate(walk.truth, t)
    assert inside.all()
    assert at.rph is not None
    assert at.v is not None
    p = frame.from_llh(at.llh)
    R_nl = np.swapaxes(frame.R_ln(p), -1, -2)
    zero = np.zeros((len(t), 3))
    v = np.einsum("kij,kj->ki", R_nl, at.v)
    return States(R_nl @ ro.from_rph(at.rph), p, v, zero, zero)


def scene_of(walk: Simulated, settings: Settings) -> BuildContext:
    recording = walk.recording
    frame = LocalFrame(walk.truth.llh[0])
    spans = detect(recording, settings).stationary
    t = choose_keyframes(recording.start, recording.end, Stance.epochs(recording, settings, spans), 1.0)
    intervals = preintegrate(bridge_gaps(recording.imu), recording.imu, t, np.zeros(3), np.zeros(3))
    return BuildContext(recording, settings, frame, t, spans, intervals)


# ------------------------------------------------------------------------------------------------------------ stances
@pytest.mark.parametrize("pace", PACES)
def test_every_stance_is_found_and_no_swing(pace: str) -> None:
    """One span for each stance, and none while the foot is a fifth as fast as in swing."""
    walk = made(pace)
    true = np.array(walk.facts["stances"])
    spans = detect(walk.recording).stationary
    hit = [int(np.sum((spans[:, 0] < b) & (spans[:, 1] > a))) for a, b in true]
    assert hit == [1] * len(true)
    assert len(spans) == len(true)
    assert walk.truth.v is not None
    speed = np.linalg.norm(walk.truth.v, axis=1)
    flat = np.any((walk.truth.t[:, None] > spans[:, 0]) & (walk.truth.t[:, None] < spans[:, 1]), axis=1)
    assert speed[flat].max() < 0.2 * speed.max()


def test_the_threshold_belongs_to_the_foot_and_not_to_the_sensor() -> None:
    """Noise ten times larger leaves the stances where they are."""
    walk = made("normal").recording
    rng = np.random.default_rng(4)
    noisy = replace(
        walk,
        imu=replace(
            walk.imu,
            gyro=walk.imu.gyro + 0.02 * rng.standard_normal(walk.imu.gyro.shape),
            accel=walk.imu.accel + 0.1 * rng.standard_normal(walk.imu.accel.shape),
        ),
    )
    a, b = detect(walk).stationary, detect(noisy).stationary
    assert len(a) == len(b)
    assert np.abs(a - b).max() < 0.05


def test_a_lull_in_a_swing_is_left_out() -> None:
    """A moment of little force and rate that does not reach as deep as the stances do is none, and that is said."""
    walk = made("normal").recording
    spans = detect(walk).stationary
    k = len(spans) // 2
    middle = 0.5 * (spans[k, 1] + spans[k + 1, 0])
    inside = np.abs(walk.imu.t - middle) < 0.06
    gyro, accel = walk.imu.gyro.copy(), walk.imu.accel.copy()
    gyro[inside] = [1.2, 0.0, 0.0]
    accel[inside] = [0.0, 0.0, 9.8]
    lull = detect(replace(walk, imu=replace(walk.imu, gyro=gyro, accel=accel)))
    raw = lull["glrt"].intervals
    assert np.any((raw[:, 0] < middle) & (raw[:, 1] > middle))
    assert not np.any((lull.stationary[:, 0] < middle) & (lull.stationary[:, 1] > middle))
    assert_told(lull.notes, "detectors.stance.lulls", "1 ")


def test_a_foot_that_slides_level_is_not_in_stance() -> None:
    """Carried level to its last footprint and slowing down evenly there, it turns little and its force is even."""
    walk = made("normal").recording
    spans = detect(walk).stationary
    k = len(spans) // 2
    begin = spans[k, 0]
    slides = (walk.imu.t > begin - 0.3) & (walk.imu.t <= begin)
    gyro, accel = walk.imu.gyro.copy(), walk.imu.accel.copy()
    gyro[slides] = [0.5, 0.0, 0.0]
    accel[slides] = [0.0, -3.0, 9.8]  # from 0.9 m/s
    found = detect(replace(walk, imu=replace(walk.imu, gyro=gyro, accel=accel)))
    raw = found["glrt"].intervals
    of_raw = raw[np.argmin(np.abs(raw[:, 1] - spans[k, 1]))]
    of_answer = found.stationary[np.argmin(np.abs(found.stationary[:, 1] - spans[k, 1]))]
    assert of_raw[0] < begin - 0.2  # what force and rate alone say
    assert begin - 0.13 < of_answer[0] < begin + 0.03  # 3 m/s^2 for 0.13 s are 0.4 m/s


def test_a_lost_packet_does_not_end_a_stance() -> None:
    walk = made("normal").recording
    spans = detect(walk).stationary
    kept = np.ones(len(walk.imu.t), dtype=bool)
    for a, b in spans:
        at = int(np.searchsorted(walk.imu.t, 0.5 * (a + b)))
        kept[at : at + 4] = False
    imu = replace(walk.imu, t=walk.imu.t[kept], gyro=walk.imu.gyro[kept], accel=walk.imu.accel[kept])
    found = detect(replace(walk, imu=imu)).stationary
    assert len(found) == len(spans)
    assert np.abs(found - spans).max() < 0.03


# -------------------------------------------------------------------------------------------------------------- pivot
def stances_at_truth(pace: str) -> tuple[Stance, States]:
    """The rows of an exact walk's stances, and its true states there."""
    walk = made(pace, exact=True)
    scene = scene_of(walk, Settings())
    rows = Stance.build(scene)
    assert rows is not None
    return rows, true_states(walk, scene.t[rows.keyframe], scene.frame)


@pytest.mark.parametrize("pace", PACES)
def test_the_pivot_explains_what_zero_velocity_leaves(pace: str) -> None:
    """At the true states of an exact walk, the best pivot and travel leave no forward velocity and little upward."""
    rows, states = stances_at_truth(pace)
    n = len(rows)
    values = {p.name: np.zeros((n, p.size)) for p in rows.parameters}
    at_zero = rows.linearize(states, values, slice(None))
    A = np.concatenate([at_zero.jacobians[PIVOT], at_zero.jacobians[TRAVEL]], -1) / at_zero.sigma[..., None]
    x, *_ = np.linalg.lstsq(A.reshape(-1, 5), -(at_zero.residual / at_zero.sigma).ravel(), rcond=None)
    values[PIVOT] += x[:3]
    values[TRAVEL] += x[3:]
    left = rows.linearize(states, values, slice(None)).residual
    before, after = at_zero.residual, left
    # walking, the IMU on top of a rolling shoe goes forward in stance; the floor lies below it, the way is forward
    assert before[:, 1].mean() > 0.01
    assert abs(after[:, 1].mean()) < 0.15 * before[:, 1].mean()
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    assert -0.15 < x[2] < -0.04
    assert x[4] > 0.03


@pytest.mark.parametrize("pace", PACES)
def test_what_comes_back_in_every_stance_is_what_the_pivot_leaves(pace: str) -> None:
    """At the true states of an exact walk, within the sigma that the pattern has; upward most, where it adds up."""
    rows, states = stances_at_truth(pace)
    of = {p.name: p for p in rows.parameters}
    zero = rows.linearize(states, {name: np.zeros((len(rows), p.size)) for name, p in of.items()}, slice(None))
    left = {}
    for names in ((PIVOT, TRAVEL), (PIVOT, TRAVEL, PATTERN)):
        A = np.concatenate([zero.jacobians[name] for name in names], -1)
        prior = np.concatenate([of[name].sigma for name in names])
        white = (A / zero.sigma[..., None]).reshape(-1, A.shape[-1])
        wanted = np.concatenate([-(zero.residual / zero.sigma).ravel(), np.zeros(len(prior))])
        x, *_ = np.linalg.lstsq(np.concatenate([white, np.diag(1.0 / prior)]), wanted, rcond=None)
        left[names[-1]] = zero.residual + A @ x
    assert np.all(np.abs(x[5:]) < 2.0 * of[PATTERN].sigma)
    assert np.abs(x[5:].reshape(-1, 3)[:, 2]).max() > 0.003
    assert np.sum(left[PATTERN] ** 2) < 0.75 * np.sum(left[TRAVEL] ** 2)
    assert abs(left[PATTERN][:, 2].mean()) < 0.7 * abs(left[TRAVEL][:, 2].mean())


def test_the_pattern_is_of_landing_and_leaving_and_not_of_standing() -> None:
    scene = scene_of(made("normal"), Settings())
    rows = Stance.build(scene)
    assert rows is not None
    total = rows.share.sum(axis=1)
    assert np.all((total == 0.0) | (np.abs(total - 1.0) < 1e-12))
    t = scene.t[rows.keyframe]
    first, last = scene.stationary[0], scene.stationary[-1]
    assert np.all(total[t < first[1] - 0.45] == 0.0)  # the recording does not begin with a landing
    assert np.all(total[t > last[0] + 0.5] == 0.0)
    walking = (t > scene.stationary[1, 0]) & (t <= scene.stationary[-2, 1])
    assert np.all(total[walking] == 1.0)


def test_zero_velocity_alone_makes_strides_too_short() -> None:
    """The known bias of foot-mounted navigation, and that the pivot takes it away."""
    walk = made("normal")
    truth = walk.truth
    way = {}
    spans = detect(walk.recording).stationary.mean(axis=1)
    for name, sigma, pattern in (("zero velocity", 1e-6, 0.0), ("pivot", 0.1, 0.02)):
        foot = {"pivot_sigma": sigma, "travel_sigma": sigma, "pattern": pattern}
        solution = run(walk.recording, parse_settings({"foot": foot}), ("rts",))
        p = solution["rts"].at(spans)[1].p
        way[name] = np.sum(np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1))
    at, _ = interpolate(truth, spans)
    p = LocalFrame(truth.llh[0]).from_llh(at.llh)
    true = np.sum(np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1))
    assert way["zero velocity"] < 0.99 * true
    assert abs(way["pivot"] / true - 1.0) < 0.005


# ------------------------------------------------------------------------------------------------------------ lateral
def lateral_rows(course: str) -> tuple[Simulated, BuildContext, FootLateral]:
    walk = made("normal", exact=True, course=course)
    scene = scene_of(walk, parse_settings({"foot": {"lateral": True}}))
    rows = FootLateral.build(scene)
    assert rows is not None
    return walk, scene, rows


def test_a_foot_that_goes_straight_on_hardly_goes_sideways() -> None:
    """At true states, the best sideways axis leaves less than a fifth of the speed, half of what the body's does."""
    walk, scene, rows = lateral_rows("straight")
    states = true_states(walk, scene.t[rows.keyframe], scene.frame)
    values = {p.name: np.zeros((len(rows), p.size)) for p in rows.parameters}
    at_zero = rows.linearize(states, values, slice(None))
    A, b = at_zero.jacobians[FOOT_AXIS] / at_zero.sigma[..., None], at_zero.residual / at_zero.sigma
    x, *_ = np.linalg.lstsq(A[:, 0], -b[:, 0], rcond=None)
    values[FOOT_AXIS] += x
    left = rows.linearize(states, values, slice(None)).residual
    speed = np.sqrt(np.mean(states.v**2))
    assert np.sqrt(np.mean(left**2)) < 0.2 * speed
    assert np.sqrt(np.mean(left**2)) < 0.5 * np.sqrt(np.mean(at_zero.residual**2))


def test_a_turning_foot_may_go_sideways() -> None:
    """Straight on, a whole swing counts as one row of `sideways` or a little more; at corners as much less."""
    sideways = Settings().foot.sideways
    of_one = {}
    for course in ("straight", "laps"):
        _, scene, rows = lateral_rows(course)
        swing = np.searchsorted(scene.stationary[:, 0], scene.t[rows.keyframe])
        information = np.bincount(swing, weights=1.0 / rows.sigma[:, 0] ** 2)
        of_one[course] = np.sqrt(1.0 / information[information > 0]) / sideways
    assert of_one["straight"].min() > 1.0
    assert np.median(of_one["straight"]) < 2.5
    assert of_one["laps"].max() > 3.0 * np.median(of_one["straight"])


# ----------------------------------------------------------------------------------------------------------- standing
def test_zero_rate_holds_where_a_foot_stands_and_not_in_its_stances() -> None:
    walk = made("normal")
    scene = scene_of(walk, Settings())
    rows = ZeroRate.build(scene)
    assert rows is not None
    still = np.array(walk.facts["stances"])
    first, last = still[0, 1], still[-1, 0]
    t = scene.t[rows.keyframe]
    assert np.all((t <= first) | (t >= last))
    assert np.any(t <= first)
    assert np.any(t >= last)


# ------------------------------------------------------------------------------------------------------------ honesty
def test_a_filter_does_not_believe_to_learn_the_heading() -> None:
    """Nothing in a walk tells it. Linearised where a landing is expected, stances would seem to; 0.7 of this sigma."""
    of_filter, of_batch = (np.sqrt(solved()[name].covariance[-1, 2, 2]) for name in ("ekf", "batch"))
    assert of_filter > 0.88 * of_batch


def test_a_swaying_body_in_units_of_white_rate() -> None:
    """An angle that walks at random with density q departs from a line by q T / 15: q is found again on average."""
    rng = np.random.default_rng(2)
    q, T, n, runs = 3e-6, 0.05, 60, 400
    rate = np.sqrt(q / T) * rng.standard_normal((runs * n, 3))
    sigma = _estimate_swaying(rate, np.full(runs * n, T), np.repeat(np.arange(runs), n))
    assert np.mean(sigma**2) * T == pytest.approx(q, rel=0.08)


def test_a_gyro_bias_known_from_before() -> None:
    """As sure of the heading as one knows of the bias, and by as much nearer to the truth as it was wrong."""
    walk = made("normal")
    assert walk.truth.gyro_bias is not None
    known = {"gyro_bias": walk.truth.gyro_bias[-1].tolist(), "gyro_bias_sigma": 1e-4}
    plain = solved()["batch"]
    helped = run(walk.recording, parse_settings({"alignment": known}), ("batch",))["batch"]
    assert helped.covariance[-1, 14, 14] < 0.5 * plain.covariance[-1, 14, 14]
    assert np.abs(helped.states.bg[-1] - walk.truth.gyro_bias[-1]).max() < 2e-4


# ------------------------------------------------------------------------------------------------------- start and end
def test_a_walk_that_starts_in_the_air_is_levelled_in_its_first_stance() -> None:
    walk = made("normal").recording
    spans = detect(walk).stationary
    k = len(spans) // 4
    begin = 0.5 * (spans[k, 1] + spans[k + 1, 0]) - walk.start
    whole = solved()["rts"]
    part = run(walk.crop(begin), None, ("rts",))["rts"]
    _, states, _ = whole.at(part.t)
    turn = ro.wrap(ro.to_rph(part.states.R_nb)[:, 2] - ro.to_rph(states.R_nb)[:, 2])
    later = part.t > part.t[0] + 3.0
    tilt = np.arccos(np.clip(np.sum(part.states.R_nb[:, 2] * states.R_nb[:, 2], axis=1), -1.0, 1.0))
    assert np.degrees(tilt[later]).max() < 1.0
    assert np.degrees(np.ptp(np.unwrap(turn[later]))) < 12.0


def test_a_loop_is_closed_only_when_asked() -> None:
    walk = made("normal").recording
    open_ = solved()
    closed = run(walk, parse_settings({"foot": {"closed_loop": 0.01}}), ("rts", "batch"))
    for solver in ("rts", "batch"):
        assert "closed_loop" not in open_[solver].records
        assert np.linalg.norm(open_[solver].states.p[-1]) > 0.1
        assert np.linalg.norm(closed[solver].states.p[-1]) < 0.05
        assert "closed_loop.set" in map(get_key, closed[solver].notes)


def test_a_loop_that_was_put_in_is_not_scored(shared_data: Path) -> None:
    source = str(shared_data / "openshoe_loops" / "run34.toml")
    stated = {"noise": {"mode": "stated"}}
    plain, asked = parse_settings(stated), parse_settings(stated | {"foot": {"closed_loop": 0.01}})
    assert not run_request(Request(source, ("ekf",), asked)).metrics
    assert run_request(Request(source, ("ekf",), plain)).metrics["ekf"].closure is not None
    assert not run_request(Request(source, ("ekf",), plain, end=15.0)).metrics  # a part of a loop is none


# --------------------------------------------------------------------------------------------------------- evaluation
def line_walk(bias: float) -> tuple[Recording, Solution]:
    """Points every metre along an L, and a solution that is `bias` longer, turned by 40 deg and moved."""
    xy = np.array([[x, 0.0] for x in range(10)] + [[9.0, y] for y in range(1, 10)])
    t = 1.0 + np.arange(len(xy), dtype=float)
    imu = Imu(np.arange(0.0, 25.0, 0.01), np.zeros((2500, 3)), np.zeros((2500, 3)))
    recording = Recording("line", "foot", imu, truth=Truth(t, xyz=xy))
    c, s = np.cos(0.7), np.sin(0.7)
    p = np.column_stack([(1.0 + bias) * xy @ np.array([[c, s], [-s, c]]), np.zeros(len(xy))]) + np.array(
        [5.0, -3.0, 1.0]
    )
    n = len(t)
    states = States(np.tile(np.eye(3), (n, 1, 1)), p, np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3)))
    P = np.tile(0.01 * np.eye(15), (n, 1, 1))
    solution = Solution("made", LocalFrame(np.zeros(3)), t, states, P)
    return recording, replace(solution, between=(_Rows(t, states, P),))


class _Rows:
    def __init__(self, t: Array, states: States, P: Array) -> None:
        self.t, self.states, self.P = t, states, P
        self.start, self.end = float(t[0]), float(t[-1])

    def times(self, rate: float) -> Array:
        return self.t

    def apart(self, t: Array) -> tuple[States, dict[str, Array]]:
        states, P = self(t)
        return states, split_covariance(P)

    def __call__(self, t: Array) -> tuple[States, Array]:
        k = np.searchsorted(self.t, t)
        return self.states[k], self.P[k]


def test_strides_and_shape_of_a_walk() -> None:
    exact = compute_walk_errors(*line_walk(0.0))
    assert exact.horizontal == pytest.approx(0.0, abs=1e-9)
    assert exact.nees_h == pytest.approx(0.0, abs=1e-9)
    assert exact.of_point == pytest.approx(0.0, abs=1e-6)
    long = compute_walk_errors(*line_walk(0.02))
    assert long.stride == pytest.approx(1.02, rel=1e-6)
    # 2 % of the distance from the centre; and, against a sigma of 0.1 m, of that from the start
    recording, _ = line_walk(0.0)
    assert recording.truth is not None
    xy = recording.truth.xyz
    assert xy is not None
    assert long.horizontal == pytest.approx(0.02 * np.sqrt(np.mean(np.sum((xy - xy.mean(0)) ** 2, axis=1))), rel=1e-6)
    assert long.nees_h == pytest.approx(0.5 * np.mean(np.sum((0.02 * xy) ** 2, axis=1)) / 0.01, rel=1e-6)


def test_what_is_known_well_is_not_turned_by_what_is_not() -> None:
    """A walk whose second half is turned by 0.5 rad about where it begins, and known to metres there: one sigma."""
    recording, solution = line_walk(0.0)
    p, half = solution.states.p.copy(), len(solution.t) // 2
    known = np.arange(len(p)) <= half
    c, s = np.cos(0.5), np.sin(0.5)
    at = p[half, :2].copy()
    p[half:, :2] = at + (p[half:, :2] - at) @ np.array([[c, s], [-s, c]])
    off = np.linalg.norm(p - solution.states.p, axis=1)
    P = solution.covariance.copy()
    P[:, 3:6, 3:6] = np.where(known, 1e-4, np.maximum(0.5 * off**2, 1e-4))[:, None, None] * np.eye(3)
    states = replace(solution.states, p=p)
    found = compute_walk_errors(recording, replace(solution, states=states, between=(_Rows(solution.t, states, P),)))
    assert found.nees_h == pytest.approx(np.mean(~known & (off > 1e-9)), rel=0.2)


def test_a_dense_truth_of_another_point_on_the_foot() -> None:
    """Its lever arm is fitted, and what it says of its own noise is how high it finds a flat floor."""
    t = np.arange(0.0, 40.0, 0.05)
    p = np.column_stack([3.0 * np.sin(0.2 * t), 2.0 * np.sin(0.31 * t), np.zeros(len(t))])
    pitch = 0.6 * np.sin(2.0 * np.pi * t)
    R = ro.from_rph(np.column_stack([0.2 * np.sin(3.0 * t), pitch, 0.7 * t]))
    spans = np.column_stack([np.arange(0.0, 40.0), np.arange(0.0, 40.0) + 0.5])
    off = np.random.default_rng(3).normal(0.0, 0.01, len(spans))
    xyz = p + R @ np.array([0.02, 0.03, 0.05])
    xyz[:, 2] = off[np.floor(t).astype(int)]
    n = len(t)
    states = States(R, p, np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3)))
    P = np.tile(1e-4 * np.eye(15), (n, 1, 1))
    standing = Detection("fused", t, np.zeros(n), 1.0, np.ones(n, dtype=bool), spans)
    solution = Solution("made", LocalFrame(np.zeros(3)), t, states, P, detections=(standing,))
    solution = replace(solution, between=(_Rows(t, states, P),))
    recording = replace(line_walk(0.0)[0], truth=Truth(t, xyz=xyz))
    assert estimate_floor_sigma(recording, solution) == pytest.approx(np.std(off[1:-1]), rel=1e-6)
    found = compute_walk_errors(recording, solution)
    assert found.horizontal > 0.01
    assert found.of_point < 1e-3
    assert found.nees_h < 0.01


def apart(p: Array, truth: Array) -> float:
    """Rms after the best yaw and offset, in complex numbers."""
    z, w = (x[:, 0] + 1j * x[:, 1] - np.mean(x[:, 0] + 1j * x[:, 1]) for x in (p, truth))
    return float(np.sqrt(np.mean(np.abs(z - w * np.exp(1j * np.angle(np.vdot(w, z)))) ** 2)))


def test_shape_by_epochs_and_by_stances() -> None:
    """A rest of ten seconds counts like a step where each stance counts once, and by its epochs where epochs do."""
    t = np.arange(0.0, 30.0, 0.1)
    stances = np.array([[0.0, 10.0], *[[10.5 + k, 11.0 + k] for k in range(19)]])
    truth = np.column_stack([np.cos(0.3 * t), np.sin(0.3 * t), np.zeros(300)])
    p = truth @ ro.from_rph(np.array([0.0, 0.0, 0.7])).T + [[4.0, 5.0, 6.0]]
    p[t > 10.2, 0] += 0.1  # all but the rest
    inside = [(t >= a) & (t <= b) for a, b in stances]
    means = [np.array([x[one].mean(axis=0) for one in inside]) for x in (p, truth)]
    standing = np.any(inside, axis=0)
    everywhere, in_stance, of_steps = compare_shapes(t, p, truth, stances)
    assert everywhere == pytest.approx(apart(p, truth), rel=1e-6)
    assert in_stance == pytest.approx(apart(p[standing], truth[standing]), rel=1e-6)
    assert of_steps == pytest.approx(apart(*means), rel=1e-6)
    assert of_steps < 0.7 * in_stance  # one place of twenty is off, but half of the epochs
    assert compare_shapes(t, p, truth, np.empty((0, 2))) == (everywhere, everywhere, everywhere)


def test_an_accelerometer_that_drifts_more_than_stated_is_seen() -> None:
    """Its bias walk is estimated, and the heights are no surprise; of an IMU that is as stated nothing is."""
    assert not solved()["rts"].noise.figures
    walk = made("normal")
    imu = walk.recording.imu
    drift = np.linspace(0.0, 0.03, len(imu.t))[:, None] * [0.0, 0.0, 1.0]  # m/s^2, as 20 in a minute on real walks
    drifting = replace(walk.recording, imu=replace(imu, accel=imu.accel + drift))
    found, taken = (run(drifting, noise=mode, solvers=("rts",))["rts"] for mode in ("estimated", "stated"))
    figures = found.noise.figures
    assert list(figures) == ["imu.accel_bias_walk"]
    assert figures["imu.accel_bias_walk"].log_factor > 3.0 * figures["imu.accel_bias_walk"].sigma
    height = interpolate(walk.truth, found.t)[0].llh[:, 2]
    up = [one.states.p[:, 2] - (height - height[0]) for one in (found, taken)]
    later = found.t > found.t[0] + 5.0  # steps have been made
    nees = [np.mean(e[later] ** 2 / one.covariance[later, 5, 5]) for e, one in zip(up, (found, taken), strict=True)]
    assert nees[0] < 1.0 < 3.0 < nees[1]
    assert np.abs(up[0]).max() < 0.3 * np.abs(up[1]).max()


def make_thigh() -> Imu:
    """Half a minute of an IMU in a pocket: a pendulum that never stands, after three seconds at rest."""
    rng, t = np.random.default_rng(3), 0.01 * np.arange(1, 3001)
    phase = 6.0 * t
    gyro = np.stack(
        [2.2 * np.sin(phase) + 0.5 * np.sin(2 * phase + 0.3), 0.5 * np.sin(phase + 1), 0.4 * np.cos(phase)], 1
    )
    pitch = 0.01 * np.cumsum(gyro[:, 0])
    pitch -= pitch.mean()
    bounce = 2.5 * np.sin(2 * phase), 3.5 * np.sin(2 * phase + 0.7)
    accel = np.stack([0.8 * np.sin(phase), 9.81 * np.sin(pitch) + bounce[0], 9.81 * np.cos(pitch) + bounce[1]], 1)
    gyro[t < 3.0], accel[t < 3.0] = 0.0, [0.0, 0.0, 9.81]
    return Imu(t, gyro + 4e-3 * rng.standard_normal(gyro.shape), accel + 0.03 * rng.standard_normal(accel.shape))


def test_an_imu_that_is_on_no_foot_is_doubted() -> None:
    """What was taken for its stances moves; figures of noise do not explain that away."""
    found = run(Recording("pocket", "foot", make_thigh()), solvers=("ekf",))
    assert "doubt.stances" in map(get_key, list_doubts(found, {}))
    assert not found["ekf"].noise.figures
    imu = make_thigh()
    shaken = replace(imu, gyro=imu.gyro + 5.0 * np.sin(np.outer(imu.t, [7.0, 5.0, 6.0])))  # nothing is taken for one
    found = run(Recording("pocket", "foot", take_rows(shaken, imu.t > 3.0)), solvers=("rts",))
    assert next(map(get_key, list_doubts(found, {}))) == "doubt.stances"
    for one in ("ekf", "batch"):
        assert "doubt.stances" not in map(get_key, list_doubts({one: solved()[one]}, {}))


def test_parts_between_gaps_are_no_single_walk() -> None:
    walk = made("normal").recording
    t = walk.imu.t - walk.start
    parts = replace(walk, imu=take_rows(walk.imu, (t < 25.0) | (t > 28.0)))
    assert "doubt.pieces" in map(get_key, list_doubts(run(parts, solvers=("rts",)), {}))
    assert "doubt.pieces" not in map(get_key, list_doubts({"rts": solved()["rts"]}, {}))


def test_a_rate_that_misses_the_impacts_of_steps_is_warned_of() -> None:
    walk = made("normal").recording
    found = {
        n: [one.key for one in inspect(replace(walk, imu=take_rows(walk.imu, slice(0, None, n)))).findings]
        for n in (1, 2, 5)
    }
    assert {n: "imu.slow" in keys for n, keys in found.items()} == {1: False, 2: False, 5: True}


# --------------------------------------------------------------------------------------------------------- real walks
def test_real_walks(shared_data: Path) -> None:
    """Twice as good as a plain zero-velocity filter in the mean of four walks, and none worse, by each solver."""
    plain = {  # m of such a filter, horizontally, and bounds of what is left up
        "gcp_walks/walk36": (0.65, np.inf),
        "openshoe_loops/run34": (0.43, 0.25),
        "openshoe_loops/run31": (0.40, 0.25),
        "xio_loops/long": (0.32, 0.25),
    }
    ratios: dict[str, list[float]] = defaultdict(list)
    for walk, (horizontal, up) in plain.items():
        recording = read(shared_data / f"{walk}.toml")
        solutions = run(recording)
        for solver, solution in solutions.items():
            found = compute_walk_errors(recording, solution, 0.03)
            ratios[solver].append(found.horizontal / horizontal)
            assert not abs(found.up) > up, (walk, solver)
            if recording.truth is not None and recording.truth.xyz is not None:
                assert found.stride == pytest.approx(1.0, abs=0.005), (walk, solver)  # of zero velocity alone 0.975
        assert solutions["batch"].stopped.startswith("converged")
        # nothing tells the heading, so what is known of it is the same whatever a solver was linearised at
        heading = {solver: solution.covariance[-1, 2, 2] ** 0.5 for solver, solution in solutions.items()}
        assert heading == pytest.approx(dict.fromkeys(heading, heading["batch"]), rel=0.02)
    for solver, of_walks in ratios.items():
        assert max(of_walks) < 1.0, solver
        assert np.exp(np.mean(np.log(of_walks))) < 0.5, solver


def test_walks_that_begin_in_stride_are_within_their_sigma(shared_data: Path) -> None:
    """Without a rest headings are open by 12 to 28 deg: positions err on circles, and not on tangents."""
    nees = []
    for path in sorted((shared_data / "gcp_walks").glob("*.toml")):
        whole = read(path)
        walk = whole.crop(10.0, whole.duration)
        nees.append(compute_walk_errors(walk, run(walk, solvers=("rts",))["rts"], 0.03).nees_h)
    assert 0.3 < np.median(nees) < 2.0
    assert max(nees) < 5.0


def test_missing_rows_do_not_make_two_stances_of_one() -> None:
    """Standing in many pieces, between lost packets, is one deep lull and no reason to leave out the walk's."""
    walk = made("normal")
    imu = walk.recording.imu
    true = np.array(walk.facts["stances"])
    short = true[(true[:, 1] - true[:, 0]) < 2.0]
    stand = 30.0  # s of standing before it, as the first rows are
    n, rate = int(stand * 200.0), 200.0
    still = slice(0, 100)
    rng = np.random.default_rng(2)
    gyro = imu.gyro[still].mean(axis=0) + 1e-3 * rng.standard_normal((n, 3))
    accel = imu.accel[still].mean(axis=0) + 1e-2 * rng.standard_normal((n, 3))
    t = imu.t[0] - (n - np.arange(n)) / rate
    kept = np.arange(n) % 60 > 11  # twelve rows of sixty are lost: more than a stance bridges
    longer = replace(
        imu,
        t=np.concatenate([t[kept], imu.t]),
        gyro=np.concatenate([gyro[kept], imu.gyro]),
        accel=np.concatenate([accel[kept], imu.accel]),
    )
    spans = detect(replace(walk.recording, imu=longer)).stationary
    hit = [bool(np.any((spans[:, 0] < b) & (spans[:, 1] > a))) for a, b in short]
    assert len(spans) > 60  # the pieces
    assert all(hit)
