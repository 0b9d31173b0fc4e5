"""Filter, smoother and batch against each other, against dense algebra and against GTSAM's own Bayes tree."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
import oracle
import pytest
from helpers import Array, Factor, at_rate, dense, errors, factors, truth_states
from replay import Play, play_isam2, play_window

from graphnav.config import Settings, parse_settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.lasting import ERRORS
from graphnav.constraints.standstill import PLACE
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import exp
from graphnav.core.state import BLOCKS, DIM
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.factor_graph.batch import batch, solve_rows
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import STATED, NoiseModel, VarianceComponent
from graphnav.estimation.pipeline import run
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.passes import make_points, move_points
from graphnav.estimation.solvers.recursion import move_columns
from graphnav.estimation.solvers.robust import weigh_squares
from graphnav.estimation.solvers.rows import Layout, compute_cost_at, descend, whiten
from graphnav.estimation.solvers.rts import rts, smooth_backward
from graphnav.imu.dynamics import SCALE
from graphnav.recording import Gnss, Recording
from graphnav.recording.formats import read
from graphnav.simulation import simulate

KERNELS = ("none", "huber", "cauchy", "geman-mcclure", "tukey", "welsch")
NO_WHEELS = {"nhc": False, "odometer": False}
WHITE = {
    "faults": False,
    "time_offset_sigma": 0.0,
}  # fixes are what they are simulated as


# errors of minutes and of hours beside the white ones, given, because a bad start would find others
LASTING = NoiseModel(
    {
        f"gnss_position.{time}.{axis}": VarianceComponent(float(np.log(0.5)))
        for time in ("minutes", "hours")
        for axis in ("horizontal", "up")
    }
)


# ----------------------------------------------------------------------------------------------- linear problems
@dataclass(frozen=True)
class Trio:
    problem: Problem
    rts: Solution
    batch: Solution
    truth: Trajectory


def nearly_linear(kind: str) -> Trio:
    """Setting off, with everything known so well that second-order terms are nothing.

    The steepest second-order term of a state is the specific force turned by half the squared attitude error, 2e-11
    m/s^2, against 1e-3 m/s of velocity noise; of a covariance it is the attitude error times what an update adds to the
    velocity.
    """
    estimated = kind == "constants"
    noise = replace(
        oracle.MEMS,
        gyro_noise_density=2e-7,
        gyro_bias_walk=2e-9,
        gyro_bias_sigma=2e-7,
        accel_bias_sigma=1e-3,
        gyro_scale_sigma=1e-5 * estimated,
        accel_scale_sigma=1e-4 * estimated,
    )
    path = oracle.straight_path(1500.0, speed=10.0, stand=5.0)
    recording, truth = oracle.drive(path, imu_noise=noise, seed=5)
    recording = recording.crop(0.0, 70.0 if kind == "slow" else 30.0)
    gnss = {**WHITE, "lever_arm_sigma": 0.005 if estimated else None}
    frame = LocalFrame(recording.gnss.llh[0])
    start = truth_states(truth, np.array([recording.start]), frame)
    start = replace(start, ba=np.zeros((1, 3)), bg=np.zeros((1, 3)))
    sigma = np.repeat([2e-6, 0.05, 1e-3, 1e-3, 2e-7], 3)
    settings = parse_settings({"gnss": gnss, "vehicle": NO_WHEELS})
    stops = np.array([[0.5, 2.0], [3.0, 4.5]]) if kind == "stops" else None
    problem = apply_noise(
        build_problem(recording, settings, frame, start, sigma, stops), LASTING if kind == "slow" else STATED
    )
    forward = ekf(problem)
    smoothed = rts(problem, forward)
    return Trio(problem, smoothed, batch(problem, smoothed.states), truth)


NODES = {
    "states": {},
    "constants": {SCALE: 1, LEVER_ARM: 1},
    "slow": dict.fromkeys(ERRORS[1:], 71),
    "stops": {PLACE: 2},
}


@pytest.fixture(scope="module", params=list(NODES))
def trio(request: pytest.FixtureRequest) -> Trio:
    made = nearly_linear(request.param)
    assert {c.parameter.name: len(c.t) for c in made.problem.chains} == NODES[request.param]
    return made


def sigmas(solution: Solution) -> Array:
    return np.sqrt(np.diagonal(solution.covariance, axis1=1, axis2=2))


def normalised(C: Array, by: Array) -> Array:
    d = np.sqrt(np.diagonal(by, axis1=-2, axis2=-1))
    return C / (d[..., :, None] * d[..., None, :])


def test_batch_is_rts_on_a_linear_problem(trio: Trio) -> None:
    assert "converged" in trio.batch.stopped
    difference = trio.batch.states.minus(trio.rts.states) / sigmas(trio.rts)
    np.testing.assert_allclose(difference, 0.0, atol=1e-3)
    mine, its = trio.batch.covariance, trio.rts.covariance
    np.testing.assert_allclose(normalised(mine, its), normalised(its, its), atol=1e-4)
    for name, p in trio.batch.parameters.items():
        np.testing.assert_allclose((p.value - trio.rts.parameters[name].value) / p.sigma, 0.0, atol=1e-3)
        np.testing.assert_allclose(p.sigma, trio.rts.parameters[name].sigma, rtol=1e-4)


def test_both_are_the_dense_least_squares_solution(trio: Trio) -> None:
    """One Gauss-Newton step from the truth, all rows in one matrix: nothing of the solvers in it."""
    problem = trio.problem
    x = truth_states(trio.truth, problem.t, problem.frame)
    values = {c.parameter.name: c.mean for c in problem.chains}
    parts, widths = factors(problem, x, values)
    step, covariance = dense(parts, widths)
    K = len(problem.t)
    expected = x.plus(step[: DIM * K].reshape(K, DIM))
    blocks = np.stack([covariance[DIM * k : DIM * k + DIM, DIM * k : DIM * k + DIM] for k in range(K)])
    for solution in (trio.rts, trio.batch):
        difference = solution.states.minus(expected) / np.sqrt(np.diagonal(blocks, axis1=1, axis2=2))
        np.testing.assert_allclose(difference, 0.0, atol=1e-3, err_msg=solution.solver)
        # linearised at the true accelerometer bias, 1e-4 of gravity away from the estimate
        np.testing.assert_allclose(normalised(solution.covariance, blocks), normalised(blocks, blocks), atol=1e-3)
    at = DIM * K
    for chain in problem.chains:
        shape = (len(chain.t), chain.parameter.size)
        part = slice(at, at + shape[0] * shape[1])
        sigma = np.sqrt(np.diag(covariance)[part]).reshape(shape)
        expected_value = chain.mean + step[part].reshape(shape)
        at = part.stop
        if chain.parameter.begins is not None:
            continue  # places of stops are no result
        for solution in (trio.rts, trio.batch):
            p = solution.parameters[chain.parameter.name]
            np.testing.assert_allclose((p.value - expected_value) / sigma, 0.0, atol=1e-3, err_msg=solution.solver)
            np.testing.assert_allclose(p.sigma, sigma, rtol=1e-3, err_msg=solution.solver)


@pytest.mark.parametrize("solve", [play_isam2, play_window], ids=["isam2", "window"])
def test_what_takes_keyframe_by_keyframe_is_batch_and_filter_on_a_linear_problem(trio: Trio, solve: Play) -> None:
    """What has settled is the elimination of everything; what was live, of everything so far: the filter's update."""
    found, filtered = solve(trio.problem), ekf(trio.problem).solution
    for mine, its in ((found.settled, trio.batch), (found.live, filtered)):
        np.testing.assert_allclose(mine.states.minus(its.states) / sigmas(its), 0.0, atol=2e-3, err_msg=its.solver)
        one, other = mine.covariance, its.covariance
        np.testing.assert_allclose(normalised(one, other), normalised(other, other), atol=2e-3, err_msg=its.solver)
    for name, p in trio.batch.parameters.items():
        own = found.settled.parameters[name]
        np.testing.assert_allclose((own.value - p.value) / p.sigma, 0.0, atol=2e-3, err_msg=name)
        np.testing.assert_allclose(own.sigma, p.sigma, rtol=2e-3, err_msg=name)


# --------------------------------------------------------------------------------------------------- covariances
@pytest.fixture(scope="module")
def lap() -> tuple[Recording, Trajectory]:
    return oracle.drive(oracle.vehicle_path(180.0, 50.0), seed=4)


@pytest.fixture(scope="module")
def solved_lap(lap: tuple[Recording, Trajectory]) -> tuple[Problem, Solution]:
    """Half a minute with turns, lever arm, time offset and scale estimated; from a start with ordinary doubt."""
    recording, truth = lap
    settings = parse_settings({"gnss": {"lever_arm_sigma": 0.3}, "vehicle": NO_WHEELS})
    part = recording.crop(30.0, 60.0)
    frame = LocalFrame(part.gnss.llh[0])
    start = truth_states(truth, np.round(np.array([part.start]), 6), frame)
    sigma = np.repeat([0.02, 1.0, 0.5, 0.03, 2e-3], 3)
    problem = build_problem(part, settings, frame, start, sigma)
    smoothed = rts(problem, ekf(problem))
    solution = batch(problem, smoothed.states, {n: p.value for n, p in smoothed.parameters.items()}, reintegrate=False)
    return problem, solution


def gtsam_graph(parts: list[Factor]) -> gtsam.GaussianFactorGraph:
    graph = gtsam.GaussianFactorGraph()
    for blocks, b in parts:
        flat = [x for key, A in blocks.items() for x in (key, A)]
        graph.push_back(gtsam.JacobianFactor(*flat, b, gtsam.noiseModel.Unit.Create(len(b))))
    return graph


def at_solution(problem: Problem, solution: Solution) -> tuple[list[Factor], list[int]]:
    return factors(problem, solution.states, {n: p.value for n, p in solution.parameters.items()})


def test_covariances_are_the_dense_inverse(solved_lap: tuple[Problem, Solution]) -> None:
    problem, solution = solved_lap
    assert {SCALE, LEVER_ARM} <= set(solution.parameters)
    parts, widths = at_solution(problem, solution)
    step, covariance = dense(parts, widths)
    K = len(problem.t)
    blocks = np.stack([covariance[DIM * k : DIM * k + DIM, DIM * k : DIM * k + DIM] for k in range(K)])
    # the last step of the iteration is taken after the covariance was made, so they differ by that step's size
    np.testing.assert_allclose(normalised(solution.covariance, blocks), normalised(blocks, blocks), atol=1e-4)
    sigma = np.sqrt(np.diag(covariance)[DIM * K :])
    mine = np.concatenate([solution.parameters[c.parameter.name].sigma[0] for c in problem.chains])
    np.testing.assert_allclose(mine, sigma, rtol=1e-4)
    # and it is the optimum: what is left to do is a small part of a sigma, in every direction
    np.testing.assert_allclose(step / np.sqrt(np.diag(covariance)), 0.0, atol=0.02)


def test_covariances_are_those_of_gtsams_bayes_tree(solved_lap: tuple[Problem, Solution]) -> None:
    """Each variable asked for is eliminated last: GTSAM's marginals away from the root lose digits, see the traps."""
    problem, solution = solved_lap
    parts, widths = at_solution(problem, solution)
    graph = gtsam_graph(parts)
    K = len(problem.t)
    own = {k: solution.covariance[k] for k in range(0, K, 5)}
    sigma = {K + i: solution.parameters[c.parameter.name].sigma[0] for i, c in enumerate(problem.chains)}
    for key in (*own, *sigma):
        ordering = gtsam.Ordering()
        for k in (*(k for k in range(len(widths)) if k != key), key):
            ordering.push_back(k)
        C = graph.eliminateMultifrontal(ordering, gtsam.EliminateQR).jointMarginalCovariance([key]).fullMatrix()
        if key in own:
            np.testing.assert_allclose(normalised(own[key], C), normalised(C, C), atol=1e-4)
        else:
            np.testing.assert_allclose(sigma[key], np.sqrt(np.diag(C)), rtol=1e-4)


def test_the_cost_is_half_the_squared_rows(solved_lap: tuple[Problem, Solution]) -> None:
    problem, solution = solved_lap
    parts, _ = at_solution(problem, solution)
    assert solution.cost == pytest.approx(0.5 * sum(float(b @ b) for _, b in parts), rel=1e-6)


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_the_gain_of_a_step_is_by_what_the_linear_rows_fall(
    solved_lap: tuple[Problem, Solution], damping: float
) -> None:
    """Damped or not, of the rows themselves; from a point that is not the optimum."""
    problem, solution = solved_lap
    rng, layout = np.random.default_rng(6), Layout(problem)
    point = make_points(problem, solution.states.plus(1e-2 * rng.standard_normal((len(problem.t), DIM))), {})
    rows, _ = whiten(problem, point, layout)
    _, step, gain = solve_rows(rows, layout, damping)
    by_key = [*step[:, :DIM], *(np.concatenate([step[np.argmax(g.node == j), problem.columns[n]] for n in g.columns])
                                for g in layout.groups for j in range(len(g.keys)))]  # fmt: skip
    fall = 0.0
    for blocks, b in rows:
        for i, own in enumerate(b):
            left = own - sum(A[i] @ by_key[keys[i]] for keys, A in blocks)
            fall += 0.5 * float(own @ own - left @ left)
    assert gain == pytest.approx(fall, rel=1e-6)


def test_covariances_of_some_keyframes_only(lap: tuple[Recording, Trajectory]) -> None:
    recording, truth = lap
    part = recording.crop(30.0, 40.0)
    frame = LocalFrame(part.gnss.llh[0])
    start = truth_states(truth, np.round(np.array([part.start]), 6), frame)
    problem = build_problem(part, Settings(), frame, start, np.repeat([0.02, 1.0, 0.5, 0.03, 2e-3], 3))
    smoothed = rts(problem, ekf(problem))
    whole = batch(problem, smoothed.states)
    some = batch(problem, smoothed.states, wanted=(0, 7))
    rest = np.setdiff1d(np.arange(len(problem.t)), [0, 7])
    np.testing.assert_array_equal(some.covariance[[0, 7]], whole.covariance[[0, 7]])
    assert np.isnan(some.covariance[rest]).all()


def test_steps_that_are_halved_reach_the_optimum_from_a_heading_that_is_far_off(
    lap: tuple[Recording, Trajectory],
) -> None:
    recording, truth = lap
    part = recording.crop(20.0, 60.0)
    frame = LocalFrame(part.gnss.llh[0])
    start = truth_states(truth, np.round(np.array([part.start]), 6), frame)
    problem = build_problem(part, Settings(), frame, start, np.repeat([2.0, 1.0, 0.5, 0.03, 2e-3], 3))
    optimum = smooth_backward(problem, ekf(problem))
    best, away = compute_cost_at(problem, optimum), np.zeros((len(problem.t), DIM + optimum.values.shape[1]))
    away[:, :3] = optimum.states.R_nb[:, 2] * 2.0  # rad about the vertical
    points = move_points(optimum, away)
    costs = [compute_cost_at(problem, points)]
    for _ in range(20):
        points = descend(problem, points, smooth_backward(problem, refilter(problem, points)))
        costs.append(compute_cost_at(problem, points))
    assert costs[0] > 100.0 * best
    assert np.all(np.diff(costs) <= 0.0)
    assert costs[-1] < 1.01 * best


# -------------------------------------------------------------------------------------------------------- robust
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("k", [0.5, 3.0])
def test_weight_is_the_slope_of_the_cost_over_s(kernel: str, k: float) -> None:
    s = np.concatenate([np.linspace(0.01, 10 * k, 400), [100.0 * k]])
    s = s[np.abs(s - k) > 1e-4]  # the second derivative of some jumps there
    h = 1e-6
    slope = (weigh_squares(kernel, s + h, k)[1] - weigh_squares(kernel, s - h, k)[1]) / (2 * h)
    weight, _ = weigh_squares(kernel, s, k)
    np.testing.assert_allclose(weight, slope / s, atol=1e-7)
    at_zero, cost = weigh_squares(kernel, np.zeros(1), k)
    assert at_zero[0] == 1.0
    assert cost[0] == 0.0


def test_unknown_kernel() -> None:
    with pytest.raises(ValueError, match="'geman'"):
        weigh_squares("geman", np.ones(1), 1.0)


def moved_fixes(recording: Recording, rows: Array, offset: Array) -> Recording:
    """Some fixes put elsewhere by metres (n, 3) east, north, up."""
    gnss = recording.gnss
    frame = LocalFrame(gnss.llh[0])
    p = frame.from_llh(gnss.llh)
    p[rows] += offset
    return replace(recording, gnss=replace(gnss, llh=frame.to_llh(p)))


def worst(a: Solution, truth: Trajectory) -> float:
    return float(np.linalg.norm(errors(a, truth)[0][:, :2], axis=1).max())


def solve(recording: Recording, kernel: str) -> Solution:
    return run(
        recording,
        parse_settings({"gnss": {**WHITE, "robust": kernel}, "vehicle": NO_WHEELS, "noise": {"mode": "stated"}}),
        solvers=("batch",),
    )["batch"]


def without(recording: Recording, rows: Array) -> Recording:
    """The recording without some fixes."""
    gnss = recording.gnss
    keep = np.delete(np.arange(len(gnss.t)), rows)
    return replace(recording, gnss=replace(gnss, t=gnss.t[keep], llh=gnss.llh[keep], sd=gnss.sd[keep]))


def apart(a: Solution, b: Solution) -> float:
    """Largest distance between two solutions where both have keyframes, m."""
    i = np.flatnonzero(np.isin(a.t, b.t))
    j = np.searchsorted(b.t, a.t[i])
    assert len(i) > 100
    difference = a.frame.to_llh(a.states.p[i]) - b.frame.to_llh(b.states.p[j])
    return float(np.abs(difference * [6.378e6, 6.378e6, 1.0]).max())


@pytest.fixture(scope="module")
def scattered(lap: tuple[Recording, Trajectory]) -> tuple[Recording, Array, Solution]:
    """Every tenth fix is 5 to 30 m off in a direction of its own: the recording, which, and the solution without."""
    recording, truth = lap
    rng = np.random.default_rng(6)
    rows = np.sort(rng.choice(len(recording.gnss.t), len(recording.gnss.t) // 10, replace=False))
    u = rng.standard_normal((len(rows), 3))
    offset = u / np.linalg.norm(u, axis=1, keepdims=True) * rng.uniform(5, 30, (len(rows), 1))
    bad = moved_fixes(recording, rows, offset)
    assert worst(solve(bad, "none"), truth) > 1.0  # or the tests would show nothing
    return bad, rows, solve(without(recording, rows), "none")


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman-mcclure", "tukey", "welsch"])
def test_scattered_outliers_hardly_matter(scattered: tuple[Recording, Array, Solution], kernel: str) -> None:
    bad, rows, reference = scattered
    solution = solve(bad, kernel)
    assert "converged" in solution.stopped
    assert apart(solution, reference) < 0.04  # twice the sigma of one fix
    weight = solution.records["gnss_position"].weight
    assert weight[rows].max() < 0.05
    assert np.median(np.delete(weight, rows)) > 0.5


def test_huber_is_pulled_by_a_burst_and_redescending_kernels_are_not(lap: tuple[Recording, Trajectory]) -> None:
    """Twenty seconds in a row of a moving vehicle, all 10 m to the east."""
    recording, truth = lap[0].crop(0.0, 100.0), lap[1]
    rows = np.arange(45, 65)
    bad = moved_fixes(recording, rows, np.array([10.0, 0.0, 0.0]))
    found = {kernel: solve(bad, kernel) for kernel in ("none", "huber", "cauchy", "tukey")}
    far = {kernel: worst(s, truth) for kernel, s in found.items()}
    assert min(far["none"], far["huber"]) > 3.0
    reference = worst(solve(without(recording, rows), "none"), truth)
    for kernel in ("cauchy", "tukey"):
        assert far[kernel] < reference + 0.04, kernel


# --------------------------------------------------------------------------------------------------- convergence
def test_states_between_keyframes_come_in_parts_just_the_same(
    solved_lap: tuple[Problem, Solution], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A part is integrated from the samples of its own intervals alone: a day's output takes a part's memory."""
    _, solution = solved_lap
    whole = solution.trajectory(50.0)
    assert len(whole) > 1000
    monkeypatch.setattr("graphnav.estimation.solution._BLOCK_ROWS", 37)
    parts = list(solution.blocks(50.0))
    assert max(len(part) for part in parts) == 37
    for name in ("t", "llh", "v", "rph", "sd_p", "sd_v", "sd_rph", "gyro_bias", "accel_bias"):
        joined, expected = np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name)
        if name == "llh":  # heights are differences of 6,400 km, of which the last digit is 1e-9 m
            np.testing.assert_allclose(joined[:, 2], expected[:, 2], rtol=0.0, atol=4e-9)
            joined, expected = joined[:, :2], expected[:, :2]
        np.testing.assert_allclose(joined, expected, rtol=1e-12, atol=1e-13, err_msg=name)


@pytest.fixture(scope="module")
def shipped(shared_data: Path) -> Recording:
    return at_rate(read(shared_data / "oracle_drive").crop(0.0, 200.0), 50.0)


@pytest.fixture(scope="module")
def reference(shipped: Recording) -> Solution:
    return run(shipped, solvers=("batch",), noise=LASTING)["batch"]


@pytest.mark.parametrize(("off", "sigma"), [(90.0, 180.0), (-90.0, 90.0), (45.0, 60.0)])
def test_a_wrong_start_heading_is_found_out(shipped: Recording, reference: Solution, off: float, sigma: float) -> None:
    """Batch ends in the same optimum: within the pull of a prior whose level axes are turned with its heading."""
    heading = np.degrees(reference.trajectory().rph[0, 2]) + off
    settings = parse_settings({"alignment": {"heading": (heading + 180) % 360 - 180, "heading_sigma": sigma}})
    solution = run(shipped, settings, solvers=("batch",), noise=LASTING)["batch"]
    assert "converged" in solution.stopped
    assert np.abs(solution.states.minus(reference.states) / sigmas(reference)).max() < 1.0


@pytest.mark.parametrize("off", [90.0, -90.0])
def test_batch_converges_from_a_wrong_heading(lap: tuple[Recording, Trajectory], off: float) -> None:
    """Filter, smoother and batch all set out with it; a prior of 180 deg lets the data decide."""
    recording, truth = lap
    frame = LocalFrame(recording.gnss.llh[0])
    true = truth_states(truth, np.zeros(1), frame)
    sigma = np.repeat([0.05, 1.0, 0.5, 0.1, 5e-3], 3)
    sigma[2] = np.pi
    found = []
    for heading in (0.0, off):
        start = replace(true, R_nb=exp(np.array([0.0, 0.0, np.radians(heading)])) @ true.R_nb, ba=0 * true.ba)
        problem = build_problem(recording, parse_settings({"gnss": WHITE}), frame, start, sigma)
        smoothed = rts(problem, ekf(problem))
        found.append(batch(problem, smoothed.states, {n: p.value for n, p in smoothed.parameters.items()}))
    assert "converged" in found[1].stopped
    assert worst(found[0], truth) < 0.15
    d = found[1].states.minus(found[0].states) / sigmas(found[0])
    # the two priors differ by `off` of a sigma of 180 deg, on a heading known to some hundredths of a degree
    assert np.abs(d).max() < 0.05


def test_a_wrong_lever_arm_is_found(shipped: Recording) -> None:
    gnss = shipped.gnss
    wrong = np.array([0.3, -0.3, 0.3])
    recording = replace(shipped, gnss=replace(gnss, lever_arm=gnss.lever_arm + wrong))
    for name, solution in run(recording, parse_settings({"gnss": {"lever_arm_sigma": 0.5}})).items():
        p = solution.parameters[LEVER_ARM]
        error = p.value[-1] - gnss.lever_arm
        assert np.all(np.abs(error) < 3.0 * p.sigma[-1]), name
        assert np.all(np.abs(error[:2]) < 0.03), name
        assert np.all(p.sigma[-1, :2] < 0.02), name


def test_fixes_outside_the_imu_do_not_matter(lap: tuple[Recording, Trajectory]) -> None:
    recording, _ = lap
    part = recording.crop(20.0, 80.0)
    more = replace(part, gnss=Gnss(**{f: getattr(recording.gnss, f) for f in ("t", "llh", "sd", "lever_arm")}))
    a, b = (run(r, solvers=("batch",))["batch"] for r in (part, more))
    np.testing.assert_allclose(a.frame.to_llh(a.states.p), b.frame.to_llh(b.states.p), atol=1e-6)


def test_smoothed_sigmas_before_the_first_fix_are_those_of_the_batch() -> None:
    recording = oracle.drive(oracle.vehicle_path(duration=120, seed=2), seed=3)[0].without("gnss", (-1.0, 3.5))
    found = run(recording, parse_settings({"noise": {"mode": "stated"}}), ("rts", "batch"))
    variances = [np.diagonal(found[name].covariance, axis1=1, axis2=2)[:, :9] for name in ("rts", "batch")]
    np.testing.assert_allclose(variances[0] / variances[1], 1.0, atol=0.01)  # a batch goes on linearising


def test_smoothed_covariances_about_a_stop_long_after_the_last_fix(shared_data: Path) -> None:
    """The filter is hundreds of metres off where rows hold the place to a millimetre: against the steps of Rauch, Tung
    and Striebel, in Joseph's form.
    """
    recording = read(shared_data / "tokyo_20201105").crop(0.0, 400.0).without("gnss", (60.0, 360.0))
    alone = {"zero_velocity": False, "zero_rate": False, "held_position": True}
    settings = parse_settings({"noise": {"mode": "stated"}, "vehicle": NO_WHEELS, "standstill": alone})
    problem = run(recording, settings, ("batch",))["batch"].graphs[0].problem
    forward = refilter(problem, smooth_backward(problem, ekf(problem)))
    assert np.diagonal(forward.P, axis1=1, axis2=2)[:, BLOCKS["p"]].max() > 500.0**2
    smoothed = smooth_backward(problem, forward).P
    expected, I = smoothed.copy(), np.eye(smoothed.shape[1])
    for k in range(len(expected) - 2, -1, -1):
        F, P, ahead = move_columns(forward.F[k], forward.decay[k], I), forward.P[k], forward.P_predicted[k + 1]
        C = np.linalg.solve(ahead, F @ P).T
        noise = ahead - F @ P @ F.T
        expected[k] = (I - C @ F) @ P @ (I - C @ F).T + C @ (expected[k + 1] + noise) @ C.T
    own, its = (P[:, :DIM, :DIM] for P in (smoothed, expected))
    np.testing.assert_allclose(normalised(own, its), normalised(its, its), atol=1e-3)


def test_a_scale_that_multiplies_what_is_known_later() -> None:
    """A barometer's scale times a height that the filter was metres off: smoothed where the batch solution is."""
    drive = simulate("urban", 3, duration=400.0, tunnels=0, gnss="single", barometer=True, rate=50.0).recording
    smoothed, best = run(drive, solvers=("rts", "batch")).values()
    assert np.abs((smoothed.states.p - best.states.p)[:, 2]).max() < 0.1
    np.testing.assert_allclose(sigmas(smoothed)[:, 5], sigmas(best)[:, 5], rtol=0.05)


def test_no_step_of_batch_raises_the_cost_about_the_biases_to_which_it_leads() -> None:
    """Fixes frozen for twelve seconds of driving bend the biases far beyond the first-order correction."""
    drive = read(Path(__file__).resolve().parents[2] / "data" / "tokyo").crop(0.0, 40.0)
    assert drive.gnss is not None
    llh = drive.gnss.llh.copy()
    frozen = (drive.gnss.t > drive.start + 10.0) & (drive.gnss.t < drive.start + 22.0)
    llh[frozen] = llh[np.flatnonzero(frozen)[0]]
    settings = {"noise": {"mode": "stated"}, "gnss": {"faults": "off"}, "solver": {"max_iterations": 8}}
    still = replace(drive, gnss=replace(drive.gnss, llh=llh))
    (one,) = run(still, parse_settings(settings), ("rts",))["rts"].graphs
    costs: list[float] = []
    found = batch(one.problem, one.states, one.values, watch=lambda states, cost, gain, slow: costs.append(cost))
    assert found.cost is not None
    assert len(costs) > 2
    assert np.all(np.diff([*costs, found.cost]) <= 0.0)
