"""GTSAM's iSAM2 with fluid relinearisation: the batch solution over the whole drive, the window's within a lag."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from helpers import Array, truth_states
from replay import play_isam2, play_window

from graphnav import load
from graphnav.config import Settings, parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import exp
from graphnav.core.state import DIM, States
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.factor_graph.batch import batch
from graphnav.estimation.factor_graph.tree_marginals import Elimination, compute_newest_root, find_head
from graphnav.estimation.factor_graph.tree_nodes import update_isam
from graphnav.estimation.factor_graph.tree_window import TreeWindow, isam2
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import NoiseModel, VarianceComponent
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.incremental import begin_at
from graphnav.estimation.solvers.linearise import Step, list_node_steps
from graphnav.estimation.solvers.points import move_covariance
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.estimation.solvers.stages import Place
from graphnav.estimation.solvers.window import Window, compute_turn_limit, make_first_message
from graphnav.recording import Recording

Drive = tuple[Recording, States, Array]
LASTING = NoiseModel(
    {f"gnss_position.{axis}": VarianceComponent(float(np.log(0.6))) for axis in ("horizontal", "up")}
    | {f"gnss_position.minutes.{axis}": VarianceComponent(float(np.log(0.2))) for axis in ("horizontal", "up")}
    | {f"nhc.seconds.{axis}": VarianceComponent(0.0) for axis in ("right", "up")}
)


def sigmas(solution: Solution) -> Array:
    return np.sqrt(np.diagonal(solution.covariance, axis1=1, axis2=2))


def apart(a: Solution, b: Solution) -> Array:
    """(K, 15) in sigmas of b."""
    return np.abs(a.states.minus(b.states)) / sigmas(b)


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Two and a half minutes, a start that is a few degrees wrong, and a stop."""
    recording, truth = oracle.drive(
        oracle.vehicle_path(150.0, 100.0), seed=7, outages=[(80.0, 100.0)], odometer_rate=20.0
    )
    start = truth_states(truth, np.zeros(1), LocalFrame(recording.gnss.llh[0]))
    start = replace(start, R_nb=start.R_nb @ exp(np.array([[0.01, -0.01, 0.06]])), ba=0 * start.ba, bg=0 * start.bg)
    return recording, start, np.array([[0.0, 8.0]])


@pytest.fixture(scope="module")
def built(drive: Drive) -> Problem:
    """With all constraints and errors that last."""
    recording, start, still = drive
    settings = parse_settings({"gnss": {"lever_arm_sigma": 0.2}})
    sigma = np.repeat([0.1, 1.0, 0.5, 0.05, 5e-3], 3)
    return apply_noise(
        build_problem(recording, settings, LocalFrame(recording.gnss.llh[0]), start, sigma, still), LASTING
    )


@pytest.fixture(scope="module")
def solved(built: Problem) -> Solution:
    smoothed = smooth_backward(built, ekf(built))
    return batch(built, smoothed.states, smoothed.select_nodes(built))


def test_over_the_whole_drive_it_is_the_batch_solution(built: Problem, solved: Solution) -> None:
    found = isam2(built)
    assert apart(found, solved).max() < 1e-2
    np.testing.assert_allclose(sigmas(found), sigmas(solved), rtol=1e-2)
    for name, p in solved.parameters.items():
        own, last = found.parameters[name], -1
        np.testing.assert_allclose((own.value - p.value)[last] / p.sigma[last], 0.0, atol=1e-2, err_msg=name)
        np.testing.assert_allclose(own.sigma[last], p.sigma[last], rtol=2e-3, err_msg=name)


def test_a_start_that_is_off_by_sixty_degrees_is_mended_by_relinearisation(built: Problem, solved: Solution) -> None:
    mean, sigma = built.prior.mean, built.prior.sigma.copy()
    assert mean is not None
    wrong = replace(mean, R_nb=exp(np.array([[0.0, 0.0, np.pi / 3.0]])) @ mean.R_nb)
    sigma[0, 2] = 1.0
    problem = replace(built, prior=replace(built.prior, mean=wrong, sigma=sigma))
    best = batch(problem, solved.states)
    found = isam2(problem)
    assert apart(found, best).max() < 0.02
    assert np.abs(found.states.p - best.states.p).max() < 1e-3


@pytest.mark.parametrize("engine", [Window, TreeWindow])
def test_a_window_that_has_gone_astray_goes_on_from_states_that_it_is_given(
    built: Problem, solved: Solution, engine: type[Window]
) -> None:
    mean, sigma = built.prior.mean, built.prior.sigma.copy()
    assert mean is not None
    wrong = replace(mean, R_nb=exp(np.array([[0.0, 0.0, 2.8]])) @ mean.R_nb)
    sigma[0, 2] = 2.0
    problem = replace(built, prior=replace(built.prior, mean=wrong, sigma=sigma))
    best = batch(problem, solved.states, reintegrate=False)
    window, steps = engine(begin_at(problem, None), compute_turn_limit(problem.imu_noise)), list_node_steps(problem)
    for k in range(len(built.t)):
        window.push(place(problem, k, steps))
    assert np.abs(window.read_states().minus(best.states)[:, 2]).max() > 0.3
    means = []
    for k, stage in enumerate(window.stages):
        e = np.zeros(DIM + len(stage.message.values))
        e[:DIM] = solved.states[k : k + 1].minus(stage.message.state)[0]
        for name, own in solved.parameters.items():
            at = stage.message.columns[name]
            node = np.searchsorted(own.t, stage.place.t + 1e-6, side="right") - 1
            e[at] = own.value[node] - stage.message.get_value(name)
        means.append(e)
    window.linearise_at(means)
    window.revise(len(window), lambda first, end: [place(problem, k, steps) for k in range(first, end)])
    assert (np.abs(window.read_states().minus(best.states)) / sigmas(best)).max() < 0.02


@pytest.fixture(scope="module")
def long(shared_data: Path) -> Problem:
    """Five minutes in which parameters are not measured for one, and stops begin and end between fixes."""
    recording, settings = load(shared_data / "oracle_drive").crop(300.0, 600.0), Settings()
    frame, still = LocalFrame(recording.gnss.llh[0]), detect(recording, settings).stationary
    found = align(recording, settings, frame, still)
    return apply_noise(build_problem(recording, settings, frame, found.state, found.sigma, still), LASTING)


@pytest.mark.parametrize(("which", "kernel"), [("built", "none"), ("built", "huber"), ("long", "none")])
def test_the_newest_message_is_what_a_tree_knows_that_keyframes_enter_in_turn(
    which: str, kernel: str, request: pytest.FixtureRequest
) -> None:
    """Live estimates and covariances, before and after relinearisations."""
    built: Problem = request.getfixturevalue(which)
    rows = (replace(c, robust=kernel) if c.name == "gnss_position" else c for c in built.constraints)
    problem, steps = replace(built, constraints=tuple(rows)), list_node_steps(built)
    one, other = make_window(built), make_window(built)
    for k in range(len(built.t)):
        for window in (other, one):
            window.push(place(problem, k, steps))
            if k in (60, 135, 140):
                window.converge(0.02, always=k == 140)
        one.read_states()
        its, b = inverse_root(compute_newest_root(one.tree)), other.newest
        newest, mine = one.tree.keyframes[-1], b.covariance
        sd = np.sqrt(np.diag(its))
        moved = np.r_[newest.estimate.minus(b.state)[0], newest.values - b.values] / sd
        np.testing.assert_allclose(moved, 0.0, atol=1e-3, err_msg=f"{k}")
        np.testing.assert_allclose(mine / sd / sd[:, None], its / sd / sd[:, None], atol=0.01, err_msg=f"{k}")
    found, expected = other.settle(len(other)), one.settle(len(one))
    sd = np.sqrt(np.diagonal(expected.covariance, axis1=1, axis2=2))
    assert np.abs(found.states.minus(expected.states) / sd).max() < 0.01


def test_within_a_lag_it_is_the_window(built: Problem, solved: Solution) -> None:
    # about the right biases: each would integrate again about its own
    problem = built.reintegrate(solved.states.ba[:-1], solved.states.bg[:-1])
    tree, window = play_isam2(problem, lag=30.0), play_window(problem, lag=30.0)
    assert apart(tree.settled, window.settled).max() < 0.05
    np.testing.assert_allclose(sigmas(tree.settled), sigmas(window.settled), rtol=0.01)
    late = built.t > built.t[0] + 20.0  # before, the first fixes turn the state by degrees, each about its own point
    assert apart(tree.live, window.live)[late].max() < 0.05
    np.testing.assert_allclose(sigmas(tree.live)[late], sigmas(window.live)[late], rtol=0.01)


def inverse_root(R: Array) -> Array:
    root = np.linalg.inv(R)
    return root @ root.T


def make_window(problem: Problem) -> TreeWindow:
    mean = problem.prior.mean
    assert mean is not None
    prior = make_first_message(mean, problem.prior.sigma[0])
    return TreeWindow(prior, compute_turn_limit(problem.imu_noise))


def place(problem: Problem, k: int, steps: dict[int, tuple[Step, ...]]) -> Place:
    return Place(float(problem.t[k]), problem, k, steps.get(k, ()), linked=k > 0)


def fill(window: TreeWindow, problem: Problem, first: int, until: int, every: int = 5) -> None:
    """Keyframes enter, and every so many are relinearised."""
    steps = list_node_steps(problem)
    for k in range(first, until):
        window.push(place(problem, k, steps))
        if k % every == every - 1:
            window.converge(0.02)


def play(problem: Problem, until: int, every: int = 5) -> TreeWindow:
    window = make_window(problem)
    fill(window, problem, 0, until, every)
    return window


def test_marginalised_keyframes_leave_nothing_behind(built: Problem) -> None:
    """Factors and variables of a fixed lag stay as many as they were, however long it goes on."""
    window, slots = make_window(built), []
    for k in range(len(built.t)):
        fill(window, built, k, k + 1)
        if built.t[k] - window.stages[0].place.t > 20.0:
            window.settle(1)
        slots.append(window.tree.isam.getFactorsUnsafe().size())
    tree = window.tree
    assert max(slots[-40:]) <= 1.2 * max(slots[30:70])
    assert tree.isam.getLinearizationPoint().size() == len(tree.variables)


def test_what_leaves_takes_no_parameter_along_that_is_in_force(built: Problem) -> None:
    """The place of a stop, of which all rows leave, stands below their states where GTSAM's order has it first."""
    tree = play(built, 40).tree
    stop, _ = tree.keyframes[-1].nodes["stop_position"]
    count = int(np.searchsorted(built.t, 12.0))
    order = [(x, 0 if x is stop else 1 + x.last) for x in tree.variables.values()]
    update_isam(tree.isam, float(built.t[39]), order=order, anew=tree.variables.values())
    before = Elimination(tree, len(tree), count).settle()
    tree.marginalise(count)
    after = Elimination(tree, len(tree)).settle()
    sd = np.sqrt(np.diagonal(before.covariance, axis1=1, axis2=2))
    scale = sd[:, :, None] * sd[:, None]
    np.testing.assert_allclose(after.covariance / scale, before.covariance / scale, atol=1e-6)
    for own, known in zip(after.sigma, before.sigma, strict=True):
        np.testing.assert_allclose(own, known, rtol=1e-6)


def test_what_is_left_of_the_past_is_what_the_last_to_leave_knew(built: Problem) -> None:
    """As a message, from which a smoother with other noise begins: that of the newest keyframe without later ones."""
    tree, other, count = play(built, 60).tree, play(built, 60), 45
    tree.marginalise(count)
    other.truncate(count + 1)
    found, newest = find_head(tree), other.newest
    assert found.columns == newest.columns
    moved, P = found.move(found.estimate), newest.covariance
    sd = np.sqrt(np.diag(P))
    np.testing.assert_allclose(moved.covariance / sd / sd[:, None], P / sd / sd[:, None], atol=1e-4)
    assert np.abs(np.r_[moved.state.minus(newest.state)[0], moved.values - newest.values] / sd).max() < 1e-3
    assert np.abs(found.estimate / sd).max() > 0.1  # it is about what is known by later keyframes


def test_relinearised_rows_take_the_place_of_the_old(built: Problem) -> None:
    """Whatever was linearised again, the tree holds each row once: as many as if nothing had been."""
    window, untouched = play(built, 40), play(built, 40, every=1000)
    assert window.relinearized > untouched.relinearized == 0
    tree, never = window.tree, untouched.tree
    never.read()
    factors = tree.isam.getFactorsUnsafe()
    alive = [i for i in range(factors.size()) if factors.at(i) is not None]
    filed = [i for k in tree.keyframes for i in k.slots.values()]
    assert len(filed) == len(set(filed))
    assert set(filed) <= set(alive)
    assert len(alive) == sum(
        never.isam.getFactorsUnsafe().at(i) is not None for i in range(never.isam.getFactorsUnsafe().size())
    )


def test_taken_back_keyframes_are_as_if_they_had_never_come(built: Problem) -> None:
    window, other = play(built, 60), play(built, 50)
    window.truncate(50)
    a, b = window.newest, other.newest
    mine, its = np.diag(a.covariance), np.diag(b.covariance)
    np.testing.assert_allclose(a.state.minus(b.state)[0] / np.sqrt(its[:15]), 0.0, atol=0.02)
    np.testing.assert_allclose(mine, its, rtol=0.03)
    sizes = [one.tree.isam.getLinearizationPoint().size() for one in (window, other)]
    assert sizes[0] == sizes[1]


def test_keyframes_come_again_after_others_were_taken_back(drive: Drive) -> None:
    """Constants alone beside the states: next to nothing is left to be ordered when the newest leave."""
    recording, start, still = drive
    sigma = np.repeat([0.1, 1.0, 0.5, 0.05, 5e-3], 3)
    frame = LocalFrame(recording.gnss.llh[0])
    settings = parse_settings({"keyframes": {"rate": 10.0}})
    stated = build_problem(recording.crop(0.0, 4.0), settings, frame, start, sigma, still)
    never, window = play(stated, 36), play(stated, 26, every=1000)
    for back, until in ((24, 30), (29, 36)):
        window.truncate(back)
        fill(window, stated, back, until, every=1000)
    for one in (window, never):
        one.converge(0.02)
    a, b = (one.settle(len(one)) for one in (window, never))
    assert np.abs(a.states.minus(b.states) / np.sqrt(np.diagonal(b.covariance, axis1=1, axis2=2))).max() < 0.01
    np.testing.assert_allclose(a.covariance[:, range(15), range(15)], b.covariance[:, range(15), range(15)], rtol=0.01)


def test_a_tree_made_again_from_its_rows_goes_on_as_before(built: Problem) -> None:
    """What a checkpoint keeps in the middle of a lag: keyframes have been marginalised, and others are to leave."""
    import pickle

    window = play(built, 60)
    window.settle(40)
    assert not window.smooth_back(5, 10)
    assert not window.smooth_back(5, 10)
    fill(window, built, 60, 62, every=1000)
    again = pickle.loads(pickle.dumps(window))
    a, b = (one.settle(5) for one in (window, again))
    np.testing.assert_array_equal(a.states.p, b.states.p)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6, atol=1e-14)
    for one in (window, again):
        fill(one, built, 62, 80, every=2)
    a, b = (one.settle(len(one)) for one in (window, again))
    np.testing.assert_allclose(a.states.p, b.states.p, atol=1e-6)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-4, atol=1e-14)
    assert isinstance(a.states, States)


def test_covariances_from_the_other_end_are_the_marginals_of_the_tree_as_it_was(built: Problem) -> None:
    """Of keyframes that are to leave a lag, in portions with others coming meanwhile, a relinearisation, or keyframes
    taken back; what is known of blocks of them is of those that have not changed.
    """
    window = play(built, 70)
    window.settle(10)
    tree = window.tree
    kept = []
    for change in ("more", "again", "back", "none"):
        leaving, count = Elimination(tree, 6), 6
        kept.append(sum(block.done for block in tree.blocks))
        keyframes = tree.keyframes[:count]
        expected = [tree.isam.marginalCovariance(k.state.key)[:DIM, :DIM] for k in keyframes]
        delta, states = np.array([k.state.delta[:DIM] for k in keyframes]), [k.estimate for k in keyframes]
        unit = tree.keyframes[0].state.unit[:DIM]
        assert not leaving.step(20)
        if change == "again":
            tree.linearise_again(range(33, len(tree)), lambda a, b: [stage.place for stage in window.stages[a:b]])
        elif change == "back":
            window.truncate(len(window) - 8)
        elif change == "more":
            fill(window, built, 70, 71)
        tree.read()
        found = leaving.settle()
        assert np.abs(found.states.minus(States.stack(states))).max() < 1e-12
        own = move_covariance(unit[:, None] * np.array(expected) * unit, delta)
        for a, b in zip(found.covariance, own, strict=True):
            sd = np.sqrt(np.diag(b))
            np.testing.assert_allclose(a / sd / sd[:, None], b / sd / sd[:, None], atol=1e-8)
    assert 0 < kept[2] < kept[1]
    assert kept[3] > 0
