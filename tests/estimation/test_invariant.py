"""An error of attitude and velocity that rows in the body's axes do not see is one they do not see anywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import Array, random_states

from graphnav.core.state import BLOCKS, DIM, States
from graphnav.estimation.solvers.invariant import add_invariant, subtract_invariant, transport_covariance

Z = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def moves() -> tuple[States, Array]:
    rng = np.random.default_rng(5)
    return random_states(rng, 6, span=50.0), 0.3 * rng.standard_normal((6, DIM))


def along(states: States) -> Array:
    """(K, 15) the error states of a turn of attitude and velocity by 1 rad about the vertical, to first order."""
    out = np.zeros((len(states), DIM))
    out[:, BLOCKS["theta"]], out[:, BLOCKS["v"]] = states.R_nb[:, 2], np.cross(Z, states.v)
    return out


def test_one_undoes_the_other(moves: tuple[States, Array]) -> None:
    states, e = moves
    np.testing.assert_allclose(subtract_invariant(add_invariant(states, e), states), e, atol=1e-12)


def test_to_first_order_it_is_the_usual_error_state(moves: tuple[States, Array]) -> None:
    states, e = moves
    small = 1e-6 * e
    np.testing.assert_allclose(add_invariant(states, small).minus(states.plus(small)), 0.0, atol=1e-10)


def test_a_turn_leaves_the_velocity_in_the_body_however_large(moves: tuple[States, Array]) -> None:
    states, _ = moves
    turned = add_invariant(states, 2.0 * along(states))
    np.testing.assert_allclose(turned.R_nb[:, 2], states.R_nb[:, 2], atol=1e-12)  # the vertical in the body
    in_body = [np.einsum("kji,kj->ki", one.R_nb, one.v) for one in (turned, states)]
    np.testing.assert_allclose(*in_body, atol=1e-11)
    np.testing.assert_allclose(turned.p, states.p)


def test_what_is_not_known_of_the_heading_stays_that(moves: tuple[States, Array]) -> None:
    states, e = moves
    moved = add_invariant(states, e)
    before, after = along(states), along(moved)
    P = before[:, :, None] * before[:, None]
    np.testing.assert_allclose(
        transport_covariance(P, states, moved), after[:, :, None] * after[:, None], rtol=1e-9, atol=1e-9
    )


def test_back_again_is_the_same_covariance(moves: tuple[States, Array]) -> None:
    states, e = moves
    moved = add_invariant(states, e)
    root = np.random.default_rng(6).standard_normal((6, DIM + 2, DIM + 2))
    P = root @ np.swapaxes(root, 1, 2)
    there = transport_covariance(P, states, moved)
    np.testing.assert_allclose(there, np.swapaxes(there, 1, 2), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(transport_covariance(there, moved, states), P, rtol=1e-9, atol=1e-9)


def test_numbers_beside_attitude_and_velocity_stay(moves: tuple[States, Array]) -> None:
    states, e = moves
    e = e.copy()
    e[:, BLOCKS["theta"]] = e[:, BLOCKS["v"]] = 0.0
    moved = add_invariant(states, e)
    np.testing.assert_allclose(moved.minus(states), e, atol=1e-12)
    P = np.broadcast_to(np.eye(DIM), (6, DIM, DIM))
    np.testing.assert_allclose(transport_covariance(P, states, replace(moved)), P, atol=1e-12)
