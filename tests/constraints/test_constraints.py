"""The contract of every constraint, driven over all that are registered; and the GNSS rows against GTSAM's own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import oracle
import pytest
import raw_drive
from helpers import STEPS, Array, difference, random_states, truth_states

from graphnav.config import Settings, parse_settings
from graphnav.constraints import list_constraints
from graphnav.constraints.antenna_motion import LEVER_ARM, fit_force_line
from graphnav.constraints.base import BuildContext, Constraint, assemble
from graphnav.constraints.gnss import GnssPosition
from graphnav.constraints.odometer import ODOMETER_SCALE
from graphnav.constraints.prior import InitialPrior
from graphnav.core import rotation as ro
from graphnav.core.earth import LocalFrame
from graphnav.core.state import BLOCKS, DIM, States
from graphnav.estimation.factor_graph.gaussian import eliminate
from graphnav.estimation.problem import Problem, build_problem, choose_keyframes
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.invariant import add_invariant, transport_covariance
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Imu, ImuNoise, Recording
from graphnav.sensors import Sensor, Series
from graphnav.sensors import list_sensors as sensors

STANDING = np.array([[3.0, 14.0], [88.0, 104.0]])  # parts of two stops of the path below, s
ON_FOOT = {"stance", "foot_lateral", "closed_loop"}  # constraints that only a foot has
RAW = {"gnss_code", "gnss_doppler", "gnss_carrier", "gnss_antenna_clone"}  # of single satellites
PPP = {"gnss_ppp_code", "gnss_ppp_carrier"}
CARRIERS = parse_settings({"raw_gnss": {"differences": True}})
SIGMA = np.repeat([0.05, 1.0, 0.5, 0.05, 1e-3], 3)


@dataclass(frozen=True)
class Case:
    rows: Constraint
    states: States  # one per row
    values: dict[str, Array]  # (N, k) per parameter


@pytest.fixture(scope="module")
def recording() -> Recording:
    path = oracle.vehicle_path(180.0)
    made, _ = oracle.drive(path, seed=3, gnss_rate=2.0, gnss_velocity_sd=(0.05, 0.06, 0.1), odometer_rate=10.0)
    return replace(made, sensors={name: readings(sensor, made) for name, sensor in sensors().items()})


def readings(sensor: Sensor, recording: Recording) -> Series:
    """Numbers that a sensor can read, one row in 0.7 s."""
    rng, t = np.random.default_rng(4), np.arange(recording.start + 0.3, recording.end, 0.7)
    inside = {c.name: c.lowest + (c.highest - c.lowest) * rng.uniform(0.1, 0.9, len(t)) for c in sensor.columns}
    return sensor.make_series(t, inside)


def with_parameters(name: str) -> Settings:
    """Everything that can be estimated is estimated."""
    chosen = {
        "gnss": {"lever_arm_sigma": 0.5, "clock_rate_sigma": 1e-4},
        "foot": {"lateral": True, "closed_loop": 0.01},
    }
    return parse_settings({**chosen, "raw_gnss": {"ppp": True} if name in PPP else {"differences": True}})


def seen_by(name: str, recording: Recording) -> Recording:
    """The drive as the constraint sees it: for those of a foot it is a foot's."""
    if name in RAW | PPP:
        return raw_drive.with_observations(recording, oracle.vehicle_path(180.0), carrier=0.003, second=name in PPP)
    return replace(recording, platform="foot", gnss=None, odometer=None) if name in ON_FOOT else recording


def scene_of(
    cls: type[Constraint], recording: Recording, settings: Settings, frame: LocalFrame, stops: Array = STANDING
) -> BuildContext:
    """A scene with the keyframes one constraint asks for."""
    inside = stops[(stops[:, 0] >= recording.start) & (stops[:, 1] <= recording.end)]
    t = choose_keyframes(recording.start, recording.end, cls.epochs(recording, settings, inside), 1.0)
    imu = recording.imu
    intervals = preintegrate(bridge_gaps(imu), imu, t, np.full(3, 0.02), np.full(3, 1e-3))
    return BuildContext(recording, settings, frame, t, inside, intervals)


def prior_row(rng: np.random.Generator) -> InitialPrior:
    return InitialPrior(keyframe=np.zeros(1, dtype=int), mean=random_states(rng, 1), sigma=SIGMA[None])


def build(name: str, recording: Recording, settings: Settings) -> Case:
    rng = np.random.default_rng(1)
    if name == InitialPrior.name:
        rows: Constraint | None = prior_row(rng)
    else:
        cls = next(c for c in list_constraints() if c.name == name)
        frame = LocalFrame(recording.gnss.llh[0])
        rows = cls.build(scene_of(cls, seen_by(name, recording), settings, frame))
    assert rows is not None, f"the drive holds nothing for '{name}': extend it"
    n = len(rows)
    values = {}
    for p in rows.parameters:
        initial, sigma = (x if p.begins is None else x[0] for x in (p.initial, p.sigma))
        values[p.name] = initial + sigma * rng.standard_normal((n, p.size))
    return Case(rows, random_states(rng, n, span=500.0), values)


# against a base station: test_raw_rtk.py holds these to the same
NAMES = tuple(cls.name for cls in list_constraints() if cls.name not in {"gnss_phase", "gnss_integers"})


# those that are off by default have no plain case
CASES = [(n, p) for n in NAMES for p in (False, True) if p or n not in {"foot_lateral", "closed_loop", *PPP}]


@pytest.fixture(scope="module", params=CASES, ids=lambda x: f"{x[0]}-{x[1]}")
def case(request: pytest.FixtureRequest, recording: Recording) -> Case:
    name, estimated = request.param
    return build(name, recording, with_parameters(name) if estimated else CARRIERS)


def test_the_prior_and_both_gnss_constraints_are_registered() -> None:
    assert {"initial_prior", "gnss_position", "gnss_velocity"} <= set(NAMES)
    assert len(set(NAMES)) == len(NAMES)


def test_shapes_and_units(case: Case) -> None:
    rows = case.rows
    linear = rows.linearize(case.states, case.values, slice(None))
    n, m = len(rows), len(rows.axes)
    assert linear.residual.shape == linear.sigma.shape == (n, m)
    assert np.all(linear.sigma > 0)
    assert np.all(np.diff(rows.keyframe) >= 0)
    assert rows.unit
    for key, J in linear.jacobians.items():
        width = 3 if key in BLOCKS else next(p for p in rows.parameters if p.name == key).size
        assert J.shape == (n, m, width), key
    assert {p.name for p in rows.parameters} <= set(linear.jacobians), "a parameter that no row depends on"


def test_jacobians_numerically(case: Case) -> None:
    linear = case.rows.linearize(case.states, case.values, slice(None))

    def at(delta: Array) -> Array:
        moved = case.states.plus(np.tile(delta, (len(case.rows), 1)))
        return case.rows.linearize(moved, case.values, slice(None)).residual

    numerical = difference(at, STEPS)
    np.testing.assert_allclose(assemble(linear), numerical, atol=1e-6 * max(1.0, np.abs(numerical).max()))
    for p in case.rows.parameters:
        if p.name == ODOMETER_SCALE:  # exact near the reading only: test_vehicle.py
            continue

        def along(delta: Array, name: str = p.name) -> Array:
            values = {**case.values, name: case.values[name] + delta}
            return case.rows.linearize(case.states, values, slice(None)).residual

        numerical = difference(along, 1e-3 * p.sigma.reshape(-1, p.size)[0])
        scale = max(1.0, np.abs(numerical).max())
        np.testing.assert_allclose(linear.jacobians[p.name], numerical, atol=1e-6 * scale, err_msg=p.name)


def test_n_rows_are_n_single_rows(case: Case) -> None:
    whole = case.rows.linearize(case.states, case.values, slice(None))
    for k in range(0, len(case.rows), 17):
        for rows in (slice(k, k + 1), np.array([k])):
            one = case.rows.linearize(case.states[rows], {n: v[rows] for n, v in case.values.items()}, rows)
            np.testing.assert_allclose(one.residual, whole.residual[rows], rtol=1e-12, atol=1e-9)
            np.testing.assert_array_equal(one.sigma, whole.sigma[rows])
            assert set(one.jacobians) == set(whole.jacobians)
            for key, J in one.jacobians.items():
                np.testing.assert_allclose(J, whole.jacobians[key][rows], rtol=1e-12, atol=1e-12)


def test_filter_update_is_one_linear_graph_step(case: Case) -> None:
    """Mean and covariance after one update: Kalman's formula against prior and row as a Gaussian factor graph."""
    rng = np.random.default_rng(2)
    k = len(case.rows) // 2
    here = {n: v[k : k + 1] for n, v in case.values.items()}
    linear = case.rows.linearize(case.states[k : k + 1], here, slice(k, k + 1))
    parameters = {p.name: p for p in case.rows.parameters}
    columns, at = {}, DIM
    for name, p in parameters.items():
        columns[name] = slice(at, at + p.size)
        at += p.size
    sigma_p = [p.sigma.reshape(-1, p.size)[0] for p in parameters.values()]
    root = rng.standard_normal((at, at)) * np.concatenate([SIGMA, *sigma_p])[:, None]
    P = root @ root.T / at
    # Kalman
    H, r, sigma = assemble(linear, columns, at)[0], linear.residual[0], linear.sigma[0]
    S = H @ P @ H.T + np.diag(sigma**2)
    gain = np.linalg.solve(S, H @ P).T
    mean, covariance = -gain @ r, P - gain @ S @ gain.T
    # graph: the state and its parameters are two variables, joined by the prior
    W = np.linalg.inv(np.linalg.cholesky(P))
    parts = [slice(0, DIM), slice(DIM, at)][: 1 + bool(columns)]
    both = (W, np.zeros(at)), (H / sigma[:, None], -r / sigma)
    graph = [([(np.array([i]), A[None, :, part]) for i, part in enumerate(parts)], b[None]) for A, b in both]
    solved = eliminate(graph, range(len(parts)))
    np.testing.assert_allclose(np.concatenate(solved.solve(range(len(parts)))), mean, rtol=1e-7, atol=1e-9)
    for i, C in solved.compute_covariances().items():
        d = np.sqrt(np.diag(covariance)[parts[i]])
        np.testing.assert_allclose(C / np.outer(d, d), covariance[parts[i], parts[i]] / np.outer(d, d), atol=1e-7)


@pytest.mark.parametrize("copies", [1, 2])
def test_the_filter_itself_does_that_update(recording: Recording, copies: int) -> None:
    """The filter's update at its first fix against the formula, lever arm included; several rows are stacked."""
    problem = tiny_problem(recording, with_parameters(""))
    rows = next(c for c in problem.constraints if isinstance(c, GnssPosition))
    k = int(rows.keyframe[1])
    pick = np.array([1, 2][:copies])
    names = "p_n", "R_ln", "sigma", "unit_error", "elapsed", "gyro", "force", "force_slope", "g_n"
    rows = replace(
        rows,
        keyframe=np.full(copies, k),
        **{name: getattr(rows, name)[pick] for name in names},
    )
    problem = replace(problem, constraints=(rows,))
    forward = ekf(problem)
    (lever,) = (c.parameter for c in problem.chains if c.parameter.name == LEVER_ARM)
    at = problem.columns[LEVER_ARM]
    P, state = forward.P_predicted[k], forward.predicted.states[k : k + 1]
    given = {p.name: np.tile(p.initial, (copies, 1)) for p in rows.parameters}
    linear = rows.linearize(state[np.zeros(copies, int)], given, slice(None))
    H = np.concatenate(assemble(linear, problem.columns, len(P)))
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(linear.sigma.ravel() ** 2))
    d = -gain @ linear.residual.ravel()
    moved = add_invariant(state, d[None, :DIM])
    np.testing.assert_allclose(forward.states[k : k + 1].minus(moved), 0.0, atol=1e-9)
    np.testing.assert_allclose(forward.values[k][at.start - DIM : at.stop - DIM], lever.initial + d[at], atol=1e-9)
    expected = transport_covariance((P - gain @ H @ P)[None], state, moved)[0]
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(forward.P[k] / np.outer(sd, sd), expected / np.outer(sd, sd), atol=1e-6)


def tiny_problem(recording: Recording, settings: Settings) -> Problem:
    frame = LocalFrame(recording.gnss.llh[0])
    start = States(ro.exp(np.array([[0.1, 0.05, 0.8]])), *(np.full((1, 3), x) for x in (0.3, 0.1, 0.01, 1e-4)))
    return build_problem(recording.crop(0.0, 4.0), settings, frame, start, SIGMA)


@pytest.mark.parametrize("phase", [0.0, 0.0021], ids=["at samples", "between samples"])
def test_a_stop_between_keyframes_has_rows_at_the_ends_of_all_its_intervals(recording: Recording, phase: float) -> None:
    """Online keyframes are where fixes are, and a stop is cut to these."""
    frame, start = LocalFrame(recording.gnss.llh[0]), random_states(np.random.default_rng(2), 1)
    part = recording.crop(0.0, 8.0)
    times = part.start + phase + np.arange(0.0, 7.0)
    for stop, standing in (((2, 5), [3, 4, 5]), ((3, 4), [4])):
        problem = build_problem(part, Settings(), frame, start, SIGMA, times[None, stop], times)
        rows = {c.name: c.keyframe.tolist() for c in problem.constraints}
        assert rows["zero_velocity"] == rows["zero_rate"] == rows["held_position"] == standing
        assert not set(standing) & set(rows["nhc"])


@pytest.mark.parametrize("name", NAMES)
def test_epochs_lie_within_the_imu(name: str, recording: Recording) -> None:
    """Measurements before the first and after the last IMU sample ask for no keyframes and make no rows.

    Fixes have a keyframe each, stops at both ends, stances often; the others have rows at keyframes of any kind.
    """
    cls = next(c for c in list_constraints() if c.name == name)
    settings = with_parameters(name) if name in ON_FOOT | PPP else CARRIERS
    recording = seen_by(name, recording)
    imu = recording.imu
    inside = (imu.t > recording.start + 50.3) & (imu.t < recording.start + 81.7)
    short = replace(recording, imu=replace(imu, t=imu.t[inside], gyro=imu.gyro[inside], accel=imu.accel[inside]))
    stops = short.start + np.array([[4.7, 9.9], [19.7, 24.8]])
    epochs = cls.epochs(short, settings, stops)
    anywhere = {"initial_prior", "nhc", "odometer", "foot_lateral", "closed_loop", "barometer", "gnss_ppp_carrier"}
    assert (len(epochs) == 0) == (name in anywhere)  # rows at keyframes of any kind, or at those of other rows
    assert np.all((epochs >= short.start) & (epochs <= short.end))
    if name in {InitialPrior.name, "gnss_ppp_carrier"}:
        return  # it is no measurement; and there are none without the keyframes of the codes
    scene = scene_of(cls, short, settings, LocalFrame(np.array([0.8, 0.2, 100.0])), stops)
    times = np.unique(scene.t[cls.build(scene).keyframe])
    assert len(times)
    assert np.all((times >= short.start) & (times <= short.end))
    if name.startswith("gnss") and len(epochs):
        assert len(epochs) < len(cls.epochs(recording, settings, stops))
        without = int(name == "gnss_carrier")  # of the first epoch there is no change
        np.testing.assert_allclose(times, epochs[without:], atol=1e-6)
    elif name in {"zero_velocity", "zero_rate", "held_position"}:
        assert np.all(np.any((times[:, None] >= stops[:, 0]) & (times[:, None] <= stops[:, 1] + 1e-6), axis=1))


@pytest.mark.parametrize("name", NAMES)
def test_a_recording_without_the_sensor_has_no_rows(name: str, recording: Recording) -> None:
    cls = next(c for c in list_constraints() if c.name == name)
    bare = replace(recording, gnss=None, odometer=None, sensors={}, platform="foot")
    assert len(cls.epochs(bare, Settings(), np.empty((0, 2)))) == 0
    scene = scene_of(cls, bare, Settings(), LocalFrame(recording.gnss.llh[0]))
    assert cls.build(replace(scene, stationary=np.empty((0, 2)))) is None


@pytest.mark.parametrize("kind", ["position", "velocity"])
def test_a_switched_off_measurement_has_no_rows(kind: str, recording: Recording) -> None:
    cls = next(c for c in list_constraints() if c.name == f"gnss_{kind}")
    off = parse_settings({"gnss": {kind: False}})
    assert len(cls.epochs(recording, off, STANDING)) == 0
    assert cls.build(scene_of(cls, recording, off, LocalFrame(recording.gnss.llh[0]))) is None


def test_gnss_rows_are_the_measurement_of_the_truth(recording: Recording) -> None:
    """With exact fixes and the true states the rows are zero, so frames, signs and lever arm are the simulator's."""
    path = oracle.vehicle_path(180.0, lat=-45.0)
    # no turn rate of the IMU enters where it is exact, but the mean over 0.1 s does
    made, truth = oracle.drive(path, imu_noise=None, gnss_exact=True, gnss_velocity_sd=(0.1, 0.1, 0.1))
    frame = LocalFrame(made.gnss.llh[40])
    for cls in list_constraints():
        if cls.name not in {"gnss_position", "gnss_velocity"}:
            continue
        scene = scene_of(cls, made, Settings(), frame)
        rows = cls.build(scene)
        residual = rows.linearize(truth_states(truth, scene.t[rows.keyframe], frame), {}, slice(None)).residual
        assert np.abs(residual).max() < (2e-6 if cls is GnssPosition else 2e-3), cls.name


def test_gnss_position_is_gtsams_gps_factor_with_a_lever_arm(recording: Recording) -> None:
    """GPSFactorArm linearised: the same error and Jacobian, where Pose3's tangent is [rotation, position in body]."""
    case = build("gnss_position", recording, Settings())
    rows = case.rows
    assert isinstance(rows, GnssPosition)
    # GTSAM measures in the navigation frame itself; take rows there
    rows = replace(rows, R_ln=np.broadcast_to(np.eye(3), rows.R_ln.shape))
    linear = rows.linearize(case.states, {}, slice(None))
    for k in range(0, len(rows), 40):
        R, p = case.states.R_nb[k], case.states.p[k]
        model = gtsam.noiseModel.Diagonal.Sigmas(rows.sigma[k])
        factor = gtsam.GPSFactorArm(0, rows.p_n[k], rows.lever_arm, model)
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3(gtsam.Rot3(R), p))
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(factor)
        A, b = graph.linearize(values).jacobian()
        white = 1.0 / rows.sigma[k]
        np.testing.assert_allclose(b, -linear.residual[k] * white, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(A[:, :3], linear.jacobians["theta"][k] * white[:, None], atol=1e-8)
        np.testing.assert_allclose(A[:, 3:], linear.jacobians["p"][k] @ R * white[:, None], atol=1e-8)


def test_the_line_through_the_force_is_exact_for_a_linear_force() -> None:
    """With uneven stamps, beyond both ends of the samples, through two samples (their mean), and after half an hour."""
    rng = np.random.default_rng(0)
    t = np.append(1e6 + np.cumsum(rng.uniform(0.005, 0.015, 180_000)), [1.1e6, 1.1e6 + 0.1])
    value, slope = np.array([0.5, -1.0, 9.8]), np.array([0.7, -0.2, 0.0])
    imu = Imu(
        t, np.zeros((len(t), 3)), value + slope * (t - t[-3])[:, None], ImuNoise(1e-4, 1e-3, 1e-6, 1e-5, 1e-3, 0.1)
    )
    at = np.array([t[0] - 0.1, t[0], t[1000] + 0.003, t[-3], t[-3] + 0.1])
    force, found = fit_force_line(imu, at)
    np.testing.assert_allclose(found, np.tile(slope, (5, 1)), atol=1e-7)
    np.testing.assert_allclose(force, value + slope * (at - t[-3])[:, None], atol=1e-7)
    alone = fit_force_line(imu, t[-1:])
    np.testing.assert_allclose(alone[0], imu.accel[-2:].mean(axis=0, keepdims=True))
    np.testing.assert_array_equal(alone[1], 0.0)
