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
from graphnav.core.state import States
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.factor_graph.batch import batch
from graphnav.estimation.factor_graph.isam import isam2
from graphnav.estimation.factor_graph.tree import Tree
from graphnav.estimation.factor_graph.tree_marginals import (
    begin_elimination,
    compute_newest_root,
    eliminate,
    find_head,
    read_keyframes,
    settle,
)
from graphnav.estimation.factor_graph.tree_nodes import update_isam
from graphnav.estimation.factor_graph.tree_whole import WholeTree
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import NoiseModel, VarianceComponent
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.linearise import list_node_steps
from graphnav.estimation.solvers.points import move_covariance
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.estimation.solvers.stages import Place
from graphnav.estimation.solvers.window import compute_turn_limit, make_first_message
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


@pytest.fixture(scope="module")
def long(shared_data: Path) -> Problem:
    """Ten minutes in which parameters are not measured for a minute, and stops begin and end between fixes."""
    recording, settings = load(shared_data / "oracle_drive"), Settings()
    frame, still = LocalFrame(recording.gnss.llh[0]), detect(recording, settings).stationary
    found = align(recording, settings, frame, still)
    return apply_noise(build_problem(recording, settings, frame, found.state, found.sigma, still), LASTING)


@pytest.mark.parametrize(("which", "kernel"), [("built", "none"), ("built", "huber"), ("long", "none")])
def test_a_tree_of_the_newest_keyframes_knows_what_that_of_all_does(
    which: str, kernel: str, request: pytest.FixtureRequest
) -> None:
    """Live estimates and covariances, before and after relinearisations that reach behind it or do not."""
    built: Problem = request.getfixturevalue(which)
    rows = (replace(c, robust=kernel) if c.name == "gnss_position" else c for c in built.constraints)
    problem, mean = replace(built, constraints=tuple(rows)), built.prior.mean
    assert mean is not None
    prior, steps = make_first_message(mean, built.prior.sigma[0]), list_node_steps(built)
    one, other = (kind(prior, compute_turn_limit(built.imu_noise)) for kind in (Tree, WholeTree))
    for k in range(len(built.t)):
        for tree in (one, other):
            tree.add(Place(float(built.t[k]), problem, k, steps.get(k, ()), linked=k > 0))
            if k in (60, 135):
                assert tree.relinearise(0.02)
        if k == 140:
            for tree in (one, other):
                tree.read()
                tree.linearise_again(range(136, 141))
        a, b = one.newest, other.newest
        root = compute_newest_root(one)
        moved = root @ np.r_[a.state.minus(b.state)[0], a.values - b.values]
        if which == "built":  # else what no row has touched for a while is brought up to date when it is read
            np.testing.assert_allclose(moved, 0.0, atol=1e-5, err_msg=f"{k}")
        mine, its = (np.linalg.inv(R.T @ R) for R in (compute_newest_root(other), root))
        sd = np.sqrt(np.diag(its))
        np.testing.assert_allclose(mine / sd / sd[:, None], its / sd / sd[:, None], atol=1e-6, err_msg=f"{k}")


def test_within_a_lag_it_is_the_window(built: Problem, solved: Solution) -> None:
    # about the right biases: the window does not integrate again
    problem = built.reintegrate(solved.states.ba[:-1], solved.states.bg[:-1])
    tree, window = play_isam2(problem, lag=30.0), play_window(problem, lag=30.0)
    assert apart(tree.settled, window.settled).max() < 0.05
    np.testing.assert_allclose(sigmas(tree.settled), sigmas(window.settled), rtol=0.01)
    late = (
        problem.t > problem.t[0] + 20.0
    )  # before, the first fixes turn the state by degrees, each about its own point
    assert apart(tree.live, window.live)[late].max() < 0.05
    np.testing.assert_allclose(sigmas(tree.live)[late], sigmas(window.live)[late], rtol=0.01)


def _played(problem: Problem, until: int, lag: float = np.inf, every: int = 5) -> tuple[Tree, list[int]]:
    mean = problem.prior.mean
    assert mean is not None
    tree, steps = (
        Tree(make_first_message(mean, problem.prior.sigma[0]), compute_turn_limit(problem.imu_noise)),
        list_node_steps(problem),
    )
    slots = []
    for k in range(until):
        tree.add(Place(float(problem.t[k]), problem, k, steps.get(k, ()), linked=k > 0))
        if k % every == every - 1:
            tree.relinearise(0.02)
        while problem.t[k] - tree.keyframes[0].place.t > lag:
            tree.marginalise(1)
        slots.append(tree.isam.getFactorsUnsafe().size())
    return tree, slots


def test_marginalised_keyframes_leave_nothing_behind(built: Problem) -> None:
    """Factors and variables of a fixed lag stay as many as they were, however long it goes on."""
    tree, slots = _played(built, len(built.t), lag=20.0)
    assert max(slots[-40:]) <= 1.2 * max(slots[30:70])
    assert tree.isam.getLinearizationPoint().size() == len(tree.variables)


def test_what_leaves_takes_no_parameter_along_that_is_in_force(built: Problem) -> None:
    """The place of a stop, of which all rows leave, stands below their states where GTSAM's order has it first."""
    tree, _ = _played(built, 40)
    stop, _ = tree.keyframes[-1].nodes["stop_position"]
    count = int(np.searchsorted(built.t, 12.0))
    order = [(x, 0 if x is stop else 1 + x.last) for x in tree.variables.values()]
    update_isam(tree.isam, float(built.t[39]), order=order, anew=tree.variables.values())
    before = settle(tree, begin_elimination(tree, len(tree), count))
    tree.marginalise(count)
    after = settle(tree, begin_elimination(tree, len(tree)))
    sd = np.sqrt(np.diagonal(before.covariance, axis1=1, axis2=2))
    scale = sd[:, :, None] * sd[:, None]
    np.testing.assert_allclose(after.covariance / scale, before.covariance / scale, atol=1e-6)
    for own, known in zip(after.sigma, before.sigma, strict=True):
        np.testing.assert_allclose(own, known, rtol=1e-6)


def test_what_is_left_of_the_past_is_what_the_last_to_leave_knew(built: Problem) -> None:
    """As a message, from which a smoother with other noise begins: that of the newest keyframe without later ones."""
    (tree, _), (other, _), count = _played(built, 60), _played(built, 60), 45
    tree.marginalise(count)
    other.truncate(count + 1)
    found, newest = find_head(tree), other.newest
    root = compute_newest_root(other)
    assert found.columns == newest.columns
    moved, P = found.move(found.estimate), np.linalg.inv(root.T @ root)
    sd = np.sqrt(np.diag(P))
    np.testing.assert_allclose(moved.covariance / sd / sd[:, None], P / sd / sd[:, None], atol=1e-4)
    assert np.abs(np.r_[moved.state.minus(newest.state)[0], moved.values - newest.values] / sd).max() < 1e-3
    assert np.abs(found.estimate / sd).max() > 0.1  # it is about what is known by later keyframes


def test_relinearised_rows_take_the_place_of_the_old(built: Problem) -> None:
    """Whatever was linearised again, the tree holds each row once: as many as if nothing had been."""
    tree, _ = _played(built, 40)
    assert tree.relinearised > 0
    never, _ = _played(built, 40, every=1000)
    assert never.relinearised == 0
    factors = tree.isam.getFactorsUnsafe()
    alive = [i for i in range(factors.size()) if factors.at(i) is not None]
    filed = [i for k in tree.keyframes for i in k.slots.values()]
    assert len(filed) == len(set(filed))
    assert set(filed) <= set(alive)
    assert len(alive) == sum(
        never.isam.getFactorsUnsafe().at(i) is not None for i in range(never.isam.getFactorsUnsafe().size())
    )


def test_taken_back_keyframes_are_as_if_they_had_never_come(built: Problem) -> None:
    tree, _ = _played(built, 60)
    other, _ = _played(built, 50)
    tree.truncate(50)
    tree.read(), other.read()
    a, b = tree.newest, other.newest
    mine, its = (np.sum(np.linalg.inv(compute_newest_root(one)) ** 2, axis=1) for one in (tree, other))
    np.testing.assert_allclose(a.state.minus(b.state)[0] / np.sqrt(its[:15]), 0.0, atol=0.02)
    np.testing.assert_allclose(mine, its, rtol=0.03)
    assert tree.isam.getLinearizationPoint().size() == other.isam.getLinearizationPoint().size()


def test_keyframes_come_again_after_others_were_taken_back(drive: Drive) -> None:
    """Constants alone beside the states: next to nothing is left to be ordered when the newest leave."""
    recording, start, still = drive
    sigma = np.repeat([0.1, 1.0, 0.5, 0.05, 5e-3], 3)
    frame = LocalFrame(recording.gnss.llh[0])
    settings = parse_settings({"keyframes": {"rate": 10.0}})
    stated = build_problem(recording.crop(0.0, 4.0), settings, frame, start, sigma, still)
    never, _ = _played(stated, 36)
    tree, _ = _played(stated, 26, every=1000)
    steps = list_node_steps(stated)
    for back, until in ((24, 30), (29, 36)):
        tree.truncate(back)
        for k in range(back, until):
            tree.add(Place(float(stated.t[k]), stated, k, steps.get(k, ()), linked=k > 0))
    for one in (tree, never):
        while one.relinearise(0.02):
            pass
    a, b = (settle(one, begin_elimination(one, len(one))) for one in (tree, never))
    assert np.abs(a.states.minus(b.states) / np.sqrt(np.diagonal(b.covariance, axis1=1, axis2=2))).max() < 0.01
    np.testing.assert_allclose(a.covariance[:, range(15), range(15)], b.covariance[:, range(15), range(15)], rtol=0.01)


def test_a_tree_made_again_from_its_rows_goes_on_as_before(built: Problem) -> None:
    """What a checkpoint keeps of it, in the middle of a lag, with keyframes already marginalised."""
    import pickle

    tree, _ = _played(built, 60, lag=20.0)
    again = pickle.loads(pickle.dumps(tree))
    steps = list_node_steps(built)
    for k in range(60, 80):
        for one in (tree, again):
            one.add(Place(float(built.t[k]), built, k, steps.get(k, ()), linked=True))
            one.relinearise()
    a, b = (settle(one, begin_elimination(one, len(one))) for one in (tree, again))
    np.testing.assert_allclose(a.states.p, b.states.p, atol=1e-6)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-4, atol=1e-14)
    assert isinstance(a.states, States)


def test_covariances_from_the_other_end_are_the_marginals_of_the_tree(built: Problem) -> None:
    """Of keyframes that are to leave a lag, in portions with others coming meanwhile, and after a relinearisation."""
    tree, _ = _played(built, 60, lag=40.0)
    steps = list_node_steps(built)
    for again in (False, True):
        leaving, count = eliminate(tree, begin_elimination(tree, 6), 20), 6
        if again:
            tree.linearise_again(range(3, len(tree)))
        expected = [tree.isam.marginalCovariance(k.state.key) for k in tree.keyframes[:count]]
        unit = tree.keyframes[0].state.unit
        if not again:
            k = tree.keyframes[-1].place.k + 1
            tree.add(Place(float(built.t[k]), built, k, steps.get(k, ()), linked=True))
        delta = read_keyframes(tree, 0, count).delta if again else leaving.estimates.delta
        found = settle(tree, leaving)
        own = move_covariance(unit[:, None] * np.array(expected) * unit, delta)
        for a, b in zip(found.covariance, own, strict=True):
            sd = np.sqrt(np.diag(b))
            np.testing.assert_allclose(a / sd / sd[:, None], b / sd / sd[:, None], atol=1e-8)
