"""The incremental solver: equal to batch where both see the same, honest where it sees less, bounded in size."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from helpers import Array, at_rate, dense, errors, factors, random_states, truth_states
from replay import play_window

from graphnav.config import parse_settings
from graphnav.constraints.odometer import OdometerSpeed
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import get_key
from graphnav.core.rotation import exp, right_jacobian_inverse
from graphnav.core.state import DIM, States
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.factor_graph.batch import batch
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import STATED, NoiseModel, VarianceComponent
from graphnav.estimation.pipeline import run
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.incremental import Incremental, incremental
from graphnav.estimation.solvers.linearise import Step, list_node_steps
from graphnav.estimation.solvers.revision import Relaxation
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.estimation.solvers.stages import Message, Place, rotate_columns
from graphnav.estimation.solvers.window import Window, make_first_message
from graphnav.recording import Recording
from graphnav.recording.formats import read

EVERYTHING = 1e9  # s, a lag longer than any drive
# errors of the fixes that last, for two fifths of the stated variance, and of wheels
LASTING = NoiseModel(
    {f"gnss_position.{axis}": VarianceComponent(float(np.log(0.6))) for axis in ("horizontal", "up")}
    | {
        f"gnss_position.{t}.{axis}": VarianceComponent(float(np.log(0.2)))
        for t in ("minutes", "hours")
        for axis in ("horizontal", "up")
    }
    | {f"nhc.seconds.{axis}": VarianceComponent(0.0) for axis in ("right", "up")}
)


def sigmas(solution: Solution) -> Array:
    return np.sqrt(np.diagonal(solution.covariance, axis1=1, axis2=2))


def apart(a: Solution, b: Solution) -> Array:
    """(K, 15) in sigmas of b."""
    return a.states.minus(b.states) / sigmas(b)


@pytest.fixture(scope="module")
def drive() -> tuple[Recording, Trajectory]:
    path = oracle.vehicle_path(240.0)
    return oracle.drive(path, seed=7, outages=[(110.0, 150.0)], odometer_rate=20.0)


@pytest.fixture(scope="module")
def built(drive: tuple[Recording, Trajectory]) -> Problem:
    """All constraints, slow errors of the fixes, a stop; from a start a few degrees wrong."""
    recording, truth = drive
    frame = LocalFrame(recording.gnss.llh[0])
    start = truth_states(truth, np.zeros(1), frame)
    start = replace(start, R_nb=start.R_nb @ exp(np.array([[0.01, -0.01, 0.06]])), ba=0 * start.ba, bg=0 * start.bg)
    settings = parse_settings({"gnss": {"lever_arm_sigma": 0.2}})
    still = np.array([[0.0, 8.0]]) if np.linalg.norm(truth.v[truth.t <= 8.0], axis=1).max() < 1e-3 else None
    return apply_noise(
        build_problem(recording, settings, frame, start, np.repeat([0.1, 1.0, 0.5, 0.05, 5e-3], 3), still), LASTING
    )


# ------------------------------------------------------------------------------------------------------- exactness
def test_with_all_the_future_it_is_the_batch_solution(built: Problem) -> None:
    found = incremental(built, lag=EVERYTHING)
    problem = found.graphs[0].problem  # with intervals about the same biases
    smoothed = smooth_backward(problem, ekf(problem))
    solved = batch(problem, smoothed.states, smoothed.select_nodes(problem), reintegrate=False)
    assert np.abs(apart(found, solved)).max() < 2e-3
    np.testing.assert_allclose(sigmas(found), sigmas(solved), rtol=1e-3)
    for name, p in solved.parameters.items():
        own = found.parameters[name]
        np.testing.assert_allclose((own.value - p.value) / p.sigma, 0.0, atol=2e-3, err_msg=name)
        np.testing.assert_allclose(own.sigma, p.sigma, rtol=1e-3, err_msg=name)


def test_a_window_is_the_dense_least_squares_solution(drive: tuple[Recording, Trajectory], built: Problem) -> None:
    """Ten seconds against one QR of all rows as `helpers.factors` makes them, with none of the solver's code."""
    part = built.recording.crop(40.0, 50.0)
    start = truth_states(drive[1], np.round(np.array([part.start]), 6), built.frame)
    problem = apply_noise(build_problem(part, built.settings, built.frame, start, built.prior.sigma[0]), LASTING)
    found = incremental(problem, lag=EVERYTHING)
    parts, widths = factors(problem, found.states, {n: p.value for n, p in found.parameters.items()})
    step, covariance = dense(parts, widths)
    K = len(problem.t)
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(step / sd, 0.0, atol=0.01)
    np.testing.assert_allclose(sigmas(found).ravel(), sd[: DIM * K], rtol=2e-3)


def test_the_live_estimate_is_the_end_of_a_batch_solution_so_far(built: Problem) -> None:
    live = play_window(built, lag=EVERYTHING).live
    speed = next(rows.speed for rows in built.constraints if isinstance(rows, OdometerSpeed))
    for end in (60.0, 130.0, 200.0):  # the second in the outage
        # what the odometer is worth is told from its readings: the same ones
        part = build_problem(built.recording.crop(0.0, end), built.settings, built.frame, built.prior.mean,
                    built.prior.sigma[0], np.array([[0.0, 8.0]]), speed=speed)  # fmt: skip
        part = apply_noise(part, LASTING)
        smoothed = smooth_backward(part, ekf(part))
        so_far = batch(part, smoothed.states, smoothed.select_nodes(part), reintegrate=False)
        k = int(np.searchsorted(built.t, part.t[-1] - 1e-6))
        assert built.t[k] == pytest.approx(part.t[-1], abs=1e-6)
        assert np.abs((live.states[k : k + 1].minus(so_far.states[-1:])) / sigmas(so_far)[-1]).max() < 0.1
        np.testing.assert_allclose(sigmas(live)[k], sigmas(so_far)[-1], rtol=0.01)


def test_a_lag_over_the_outage_gives_the_batch_solution_to_centimetres(drive: tuple[Recording, Trajectory]) -> None:
    best = run(drive[0], solvers=("batch",), noise=LASTING)["batch"]

    def far(lag: float) -> float:
        """m"""
        settings = parse_settings({"solver": {"lag": lag}})
        found = run(drive[0], settings, solvers=("incremental",), noise=LASTING)["incremental"]
        return float(np.abs(found.states.p - best.states.p).max())

    assert far(60.0) < 0.02
    assert far(5.0) > 0.03  # a lag shorter than the outage does not know where it ends


# -------------------------------------------------------------------------------------------------------- messages
def some_message(rng: np.random.Generator) -> Message:
    return Message(random_states(rng, 1), rng.standard_normal(4), {"a": slice(15, 19)}, np.triu(
        rng.standard_normal((19, 19)) + 5 * np.eye(19)), rng.standard_normal(19))  # fmt: skip


def test_a_moved_message_says_the_same() -> None:
    """Its residual at any state is what it was, to first order in the distance from the new point."""
    rng = np.random.default_rng(1)
    message = some_message(rng)
    e = 0.2 * rng.standard_normal(19)
    moved = message.move(e)
    for _ in range(5):
        d = 1e-5 * rng.standard_normal(19)
        there = moved.state.plus(d[None, :DIM])
        before = np.concatenate([there.minus(message.state)[0], moved.values + d[DIM:] - message.values])
        np.testing.assert_allclose(moved.R @ d - moved.z, message.R @ before - message.z, atol=1e-7)
    back = moved.move(-e)
    np.testing.assert_allclose(back.state.p, message.state.p, atol=1e-12)


def test_turned_columns_are_the_derivative_of_the_chart() -> None:
    rng = np.random.default_rng(2)
    e = np.concatenate([rng.standard_normal(3), np.zeros(12)])
    A = rotate_columns(np.eye(15), right_jacobian_inverse(e[None, :3])[0])
    h = 1e-6
    start = random_states(rng, 1)
    for k in range(3):
        d = np.zeros((1, 15))
        d[0, k] = h
        there = start.plus(e[None]).plus(d)
        np.testing.assert_allclose((there.minus(start)[0, :3] - e[:3]) / h, A[:3, k], atol=1e-5)


# ---------------------------------------------------------------------------------------------------------- window
def fill(window: Window, problem: Problem, first: int, last: int, steps: dict[int, tuple[Step, ...]]) -> None:
    for k in range(first, last):
        window.push(Place(float(problem.t[k]), problem, k, steps.get(k, ()), linked=k > 0))


def test_taking_keyframes_back_and_adding_them_again_changes_nothing(built: Problem) -> None:
    steps = list_node_steps(built)
    one, two = (Window(make_first_message(built.prior.mean, built.prior.sigma[0]), 1e-3) for _ in range(2))
    fill(one, built, 0, 60, steps)
    fill(two, built, 0, 60, steps)
    two.truncate(35)
    assert len(two) == 35
    fill(two, built, 35, 60, steps)
    np.testing.assert_allclose(two.newest.state.minus(one.newest.state), 0.0, atol=1e-12)
    np.testing.assert_allclose(two.newest.covariance, one.newest.covariance, rtol=1e-6, atol=1e-15)


def test_size_does_not_grow_with_the_drive(built: Problem) -> None:
    """Keyframes in the window and numbers in a stage, over the drive run through three times."""
    solver = Incremental(Window(make_first_message(built.prior.mean, built.prior.sigma[0]), 1e-3), built, lag=20.0)
    steps, sizes = list_node_steps(built), []
    for k in range(len(built.t)):
        solver.add(Place(float(built.t[k]), built, k, steps.get(k, ()), linked=k > 0))
        sizes.append((len(solver.window), solver.window.newest.R.size))
    most = 20 * 1.2 + 3
    assert max(size for size, _ in sizes[40:]) <= most + 3
    assert len({cells for _, cells in sizes}) == 1
    assert sum(len(part) for part in solver.settled) + len(solver.window) == len(built.t)
    t = np.concatenate([part.t for part in solver.settled])
    assert np.all(np.diff(t) > 0)


# ---------------------------------------------------------------------------------------------- robust, honest, real
def test_outliers_are_given_up_as_by_the_batch_solver(drive: tuple[Recording, Trajectory]) -> None:
    recording, _ = drive
    gnss = recording.gnss
    frame = LocalFrame(gnss.llh[0])
    p = frame.from_llh(gnss.llh)
    rows = np.arange(10, len(p), 12)
    p[rows] += [15.0, -10.0, 5.0]
    bad = replace(recording, gnss=replace(gnss, llh=frame.to_llh(p)))
    settings = parse_settings({"gnss": {"robust": "cauchy"}})
    found = run(bad, settings, solvers=("incremental", "batch"), noise=STATED)
    a, b = found["incremental"], found["batch"]
    far = np.abs(a.states.p - b.states.p)[a.t > a.t[0] + 20.0]
    assert far.max() < 0.05
    assert a.records["gnss_position"].weight[rows].max() < 0.05


def test_sigmas_are_true(drive: tuple[Recording, Trajectory]) -> None:
    """NEES of settled positions over drives with other noise: as in test_consistency, of far fewer drives."""
    ratio = []
    for seed in range(4):
        recording, truth = oracle.drive(oracle.vehicle_path(240.0, 50.0), seed=20 + seed, outages=[(110.0, 150.0)])
        settings = parse_settings({"solver": {"lag": 30.0}})
        solution = run(at_rate(recording, 25.0), settings, solvers=("incremental",), noise=STATED)["incremental"]
        i = np.clip(np.searchsorted(truth.t, solution.t - 1e-6), 0, len(truth.t) - 1)
        met = np.abs(truth.t[i] - solution.t) < 1e-6  # not where a stop begins or ends
        at_rows = replace(solution, t=solution.t[met], states=solution.states[met], covariance=solution.covariance[met])
        position, sd, *_ = errors(at_rows, truth)
        ratio.append(np.mean((position / sd) ** 2))
    assert 0.5 < np.mean(ratio) < 1.6


@pytest.mark.parametrize("name", ["oracle_drive"])
def test_real_program_run(shared_data: Path, name: str) -> None:
    found = run(at_rate(read(shared_data / name).crop(50.0, 250.0), 50.0), solvers=("incremental", "batch"))
    a, b = found["incremental"], found["batch"]
    # what comes after the lag still tells of errors that last for minutes and hours: as much as variances say
    var = [np.diagonal(one.covariance, axis1=1, axis2=2)[:, 3:6] for one in (a, b)]
    assert np.all(np.abs(a.states.p - b.states.p) < 3.0 * np.sqrt(np.maximum(var[0] - var[1], 0.0)) + 0.001)
    assert "solver.step_times" in map(get_key, a.notes)


def test_what_smooths_back_is_the_whole_matrix(built: Problem) -> None:
    """Of which a stage keeps the rows that are not those of the identity."""
    window, steps = Window(make_first_message(built.prior.mean, built.prior.sigma[0]), 1e-3), list_node_steps(built)
    fill(window, built, 0, 90, steps)
    P = window.newest.covariance
    for stage in reversed(window.stages[1:]):
        G, noise = stage.smooth_back(np.eye(len(P))), np.zeros((len(stage.g), len(stage.g)))
        noise[stage.lost[:, None], stage.lost] = stage.C
        expected = G @ P @ G.T + noise
        P = stage.predict_before(P)
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(P / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-12)


def test_covariances_come_in_portions_as_at_once(built: Problem) -> None:
    """Of what was known when the first was asked for; and of what is known now once keyframes were taken back."""
    steps = list_node_steps(built)
    one, two = (Window(make_first_message(built.prior.mean, built.prior.sigma[0]), 1e-3) for _ in range(2))
    for window in (one, two):
        fill(window, built, 0, 90, steps)
    fill(two, built, 90, 100, steps)
    two.truncate(90)
    assert not two.smooth_back(20, 7)
    two.truncate(80)
    fill(two, built, 80, 90, steps)
    assert not two.leaving
    while not two.smooth_back(20, 7):
        if len(two) < 95:
            fill(two, built, len(two), len(two) + 1, steps)
    assert two.leaving == 20
    found, expected = two.settle(20).covariance, one.settle(20).covariance
    sd = np.sqrt(np.einsum("kii->ki", expected))  # about states that differ by what came meanwhile
    np.testing.assert_allclose((found - expected) / sd[:, None] / sd[..., None], 0.0, atol=1e-3)


def test_linearised_again_in_portions_it_is_the_same(built: Problem) -> None:
    """At once and in portions; and while keyframes come and some are taken back and made again."""
    steps = list_node_steps(built)
    whole, parts, moving = (Window(make_first_message(built.prior.mean, built.prior.sigma[0]), 1e-3) for _ in range(3))

    def revise(window: Window) -> bool:
        # built anew, as a running drive does: what has been linearised again keeps no rows
        def places(begin: int, end: int) -> list[Place]:
            return [Place(float(built.t[k]), built, k, steps.get(k, ()), linked=k > 0) for k in range(begin, end)]

        return window.revise(16, places, always=True)

    def smoothed(window: Window) -> tuple[Array, Array]:
        settled = window.settle(len(window))
        return settled.states.minus(reference), np.sqrt(np.diagonal(settled.covariance, axis1=1, axis2=2))

    for window in (whole, parts):
        fill(window, built, 0, 90, steps)
    fill(moving, built, 0, 60, steps)
    whole.converge(always=True)
    assert whole.relinearized > 0
    while revise(parts):
        assert parts.revising
    for first, last in ((60, 70), (70, 75)):
        assert revise(moving)
        fill(moving, built, first, last, steps)
    assert revise(moving)
    moving.truncate(40)  # within what has been made
    fill(moving, built, 40, 90, steps)
    assert moving.relinearized == 0
    while revise(moving):
        pass
    assert not moving.revising
    assert parts.relinearized == whole.relinearized
    reference = States.stack([stage.message.state for stage in whole.stages])
    (off, sd), at_once, changed = smoothed(whole), smoothed(parts), smoothed(moving)
    np.testing.assert_allclose(at_once[0] / sd, off / sd, atol=1e-6)
    np.testing.assert_allclose(at_once[1], sd, rtol=1e-7)
    np.testing.assert_allclose(changed[0] / sd, off / sd, atol=0.02)
    np.testing.assert_allclose(changed[1], sd, rtol=1e-3)


@pytest.mark.parametrize("slope", [1.0, 1.6, 2.0, 3.5])
def test_relaxed_steps_end_at_the_optimum_where_whole_ones_swing_around_it(slope: float) -> None:
    """Steps -slope x to an optimum at 0: from slope 2 on whole ones never come closer."""
    x, relaxation = np.tile([0.03, -0.01, 0.02], (7, 1)), Relaxation()
    for _ in range(4):
        step = -slope * x
        x = x + relaxation.find_share(step) * step
    assert np.abs(x).max() < 1e-12
