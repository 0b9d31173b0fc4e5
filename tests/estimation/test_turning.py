"""Where nothing tells the heading, all of it may turn about the vertical, and no row has anything to say of that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import Array, random_states

from graphnav.constraints import list_constraints
from graphnav.constraints.base import Constraint
from graphnav.core.earth import EARTH_RATE
from graphnav.core.rotation import exp
from graphnav.core.state import DIM, States
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.linearise import Points, linearise
from graphnav.estimation.solvers.stages import Message
from graphnav.estimation.solvers.turning import (
    add_curvature,
    add_turning,
    change_of_point,
    split_turn,
    turn_covariance,
)
from graphnav.estimation.solvers.window import Window
from graphnav.online import Online, drop_rows, list_rows
from graphnav.simulation import simulate

Z = np.array([0.0, 0.0, 1.0])


def turned(states: States, psi: float) -> States:
    """All of it about the vertical at the origin."""
    Rz = exp(psi * Z)
    return States(Rz @ states.R_nb, states.p @ Rz.T, states.v @ Rz.T, states.ba, states.bg)


def along(states: States) -> Array:
    """(K, 15) the error states of a turn by 1 rad, to first order."""
    still = np.zeros((len(states), 6))
    return np.concatenate([states.R_nb[:, 2], np.cross(Z, states.p), np.cross(Z, states.v), still], axis=1)


@pytest.fixture(scope="module")
def moves() -> tuple[States, Array]:
    rng = np.random.default_rng(3)
    e = 0.3 * rng.standard_normal((6, DIM))
    return random_states(rng, 6, span=50.0), e


def test_a_common_turn_is_a_turn_however_large(moves: tuple[States, Array]) -> None:
    states, _ = moves
    np.testing.assert_allclose(add_turning(states, 2.0 * along(states)).minus(turned(states, 2.0)), 0.0, atol=1e-12)
    psi, left = split_turn(states, 2.0 * along(states))
    np.testing.assert_allclose(psi, 2.0, rtol=1e-14)
    np.testing.assert_allclose(left, 0.0, atol=1e-12)


def test_what_is_beside_a_turn_turns_with_it(moves: tuple[States, Array]) -> None:
    states, e = moves
    both = turned(add_turning(states, e), 0.7)
    np.testing.assert_allclose(add_turning(states, e + 0.7 * along(states)).minus(both), 0.0, atol=1e-12)


@pytest.mark.parametrize("sigma", [0.05, 0.3, 0.5])
def test_unknown_headings_move_positions_on_circles(moves: tuple[States, Array], sigma: float) -> None:
    """The mean square about the point, along the way to the origin and across, is that of turns drawn at random."""
    states, _ = moves
    x = along(states)
    P = sigma**2 * x[:, :, None] * x[:, None, :] + 1e-4 * np.eye(DIM)
    psi = sigma * np.random.default_rng(1).standard_normal(100_000)
    away = np.hypot(states.p[:, 0], states.p[:, 1])
    inward = -states.p[:, :2] / away[:, None]
    found = add_curvature(P, states)
    np.testing.assert_array_equal(found[:, [2, 9], [2, 9]], P[:, [2, 9], [2, 9]])
    square = np.einsum("ki,kij,kj->k", inward, found[:, 3:5, 3:5], inward) - 1e-4
    np.testing.assert_allclose(square, away**2 * np.mean((1.0 - np.cos(psi)) ** 2), rtol=0.5 * sigma + 0.03)
    first = np.einsum("ki,kij,kj->k", inward, P[:, 3:5, 3:5], inward) - 1e-4
    assert np.all(first < 1e-9 * away**2)


def test_near_the_point_it_is_the_usual_error_state(moves: tuple[States, Array]) -> None:
    states, e = moves
    found = add_turning(states, 1e-4 * e).minus(states)
    np.testing.assert_allclose(found, 1e-4 * e, atol=1e-6)


def test_the_change_of_point_is_the_derivative(moves: tuple[States, Array]) -> None:
    states, e = moves
    there, T, h = add_turning(states, e), np.tile(np.eye(DIM), (6, 1, 1)), 1e-6
    T[:, :9, :9] = change_of_point(states, e)
    for k in range(DIM):
        step = np.zeros((6, DIM))
        step[:, k] = h
        ways = [add_turning(there, s * step).minus(add_turning(states, e + s * h * T[:, :, k])) for s in (1.0, -1.0)]
        np.testing.assert_allclose(ways, 0.0, atol=1e-4 * h)
    rng = np.random.default_rng(1)
    root = rng.standard_normal((6, DIM, DIM))
    P = root @ np.swapaxes(root, -1, -2)
    back = T @ turn_covariance(P, states, e) @ np.swapaxes(T, -1, -2)
    np.testing.assert_allclose(back, P, atol=1e-9)


def test_a_message_that_knows_no_heading_learns_none_where_its_point_moves(moves: tuple[States, Array]) -> None:
    rng = np.random.default_rng(2)
    states, e = moves
    state, A = states[:1], rng.standard_normal((DIM, DIM))
    n = along(state)[0] / np.linalg.norm(along(state)[0])
    R = np.linalg.qr(A - np.outer(A @ n, n))[1]
    message = Message(state, np.zeros(0), {}, R, rng.standard_normal(DIM), turns=True)
    moved = message.move(e[0])
    np.testing.assert_allclose(moved.R @ along(moved.state)[0], 0.0, atol=1e-10)
    straight = replace(message, turns=False).move(e[0])
    assert np.linalg.norm(straight.R @ along(straight.state)[0]) > 1.0


@pytest.fixture(scope="module")
def walk() -> Online:
    """Three quarters of a minute of a walk without fixes, none of which has settled."""
    recording = simulate("gait", 1, duration=45.0, rate=100.0).recording
    online = Online(drop_rows(recording))
    for row in list_rows(recording)[1]:
        online.add(row)
    return online


def built(online: Online) -> Problem:
    """The keyframes of it as one problem."""
    tracker = online.tracker
    assert tracker is not None
    (place, *_) = tracker._build_again(online.sensors, 0, len(tracker.window))
    assert place.problem is not None
    return place.problem


def linearised_again(online: Online) -> Window:
    """Its window, about one trajectory."""
    tracker = online.tracker
    assert tracker is not None
    tracker.window.converge(always=True, renewed=lambda *which: tracker._build_again(online.sensors, *which))
    return tracker.window


def test_no_row_that_says_so_feels_a_turn_but_by_the_earths_rate(walk: Online) -> None:
    problem, rng = built(walk), np.random.default_rng(5)
    tried: set[str] = set()
    for rows in problem.constraints:
        states = random_states(rng, len(problem.t), span=500.0)
        values = np.zeros((len(problem.t), sum(at.stop - at.start for at in problem.columns.values())))
        residual, after = (
            linearise(rows, Points(x, values), problem.columns).residual for x in (states, turned(states, 2.0))
        )
        speed = np.linalg.norm(states.v, axis=1).max()
        # the Earth turned by 2 rad is another by twice sin(1) of it; so is what it adds to gravity, over less than 1 s
        most = 2.0 * EARTH_RATE * max(1.0, 2.0 * speed)
        assert rows.turns
        np.testing.assert_allclose(after, residual, atol=most)
        tried.add(rows.name)
    assert "stance" in tried


def test_fixes_and_places_do_not_say_so() -> None:
    kinds: dict[str, type[Constraint]] = {kind.name: kind for kind in list_constraints()}
    for name in ("gnss_position", "gnss_velocity", "held_position", "dual_antenna_heading"):
        assert not kinds[name].turns


def test_a_walk_learns_no_heading_but_what_the_whole_of_it_says(walk: Online) -> None:
    """The heading now is as uncertain as after all of it has been linearised about one trajectory."""

    def heading_sigma() -> float:
        assert walk.tracker is not None
        newest = walk.tracker.window.newest
        up = newest.state.R_nb[0, 2]
        return float(np.sqrt(up @ newest.covariance[:3, :3] @ up))

    now = heading_sigma()
    linearised_again(walk)
    assert now == pytest.approx(heading_sigma(), rel=5e-3)


def test_a_common_turn_is_no_reason_to_linearise_again_and_one_of_some_keyframes_is(walk: Online) -> None:
    window = linearised_again(walk)
    assert window.newest.turns
    found = window.compute_means()
    try:
        around = [window.head, *(stage.message for stage in window.stages)]
        ways = [np.concatenate([along(m.state)[0], np.zeros(len(m.values))]) for m in around]
        window._means, window._moved = [e + 0.3 * way for e, way in zip(found, ways, strict=True)], None
        assert window.find_first_moved() is None
        half = len(ways) // 2
        window._means = [
            *window._means[:half],
            *(e + 0.31 * way for e, way in zip(found[half:], ways[half:], strict=True)),
        ]
        window._moved = None
        assert window.find_first_moved() == half - 1
    finally:
        window._means, window._moved = found, None
