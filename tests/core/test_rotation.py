"""SO(3): against SciPy, against numerical differences and quadrature, and in cases worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import difference, random_rotations
from scipy.spatial.transform import Rotation

from graphnav.core import rotation as ro

MAGNITUDES = (0.0, 1e-12, 1e-9, 1e-6, 1e-4, 0.0099, 0.0101, 0.0999, 0.1001, 0.5, 1.5, 2.5, 3.1, np.pi - 1e-5)
DEG = np.pi / 180.0


@pytest.fixture(params=MAGNITUDES)
def vectors(request: pytest.FixtureRequest) -> np.ndarray:
    """Fifty rotation vectors of one length, in all directions and along the axes."""
    u = np.random.default_rng(7).standard_normal((44, 3))
    u = np.concatenate([u / np.linalg.norm(u, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    return request.param * u


def test_exp_and_log_agree_with_scipy(vectors: np.ndarray) -> None:
    R = ro.exp(vectors)
    np.testing.assert_allclose(R, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=2e-15)
    np.testing.assert_allclose(ro.log(R), vectors, atol=2e-15 + 1e-13 * np.abs(vectors).max())


def test_a_single_logarithm_is_as_in_a_batch(vectors: np.ndarray) -> None:
    R = ro.exp(vectors)
    np.testing.assert_allclose([ro.log(one) for one in R], ro.log(R), rtol=1e-15)


def test_small_angles_keep_their_digits() -> None:
    v = np.array([[3e-9, -1e-9, 2e-9], [1e-7, 2e-7, -3e-7]])
    np.testing.assert_allclose(ro.log(ro.exp(v)), v, rtol=1e-8)


@pytest.mark.parametrize("below", [0.0, 1e-12, 1e-9, 1e-7, 1e-3])
def test_log_at_and_near_half_a_turn(below: float) -> None:
    u = np.random.default_rng(3).standard_normal((200, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    u = np.concatenate([u, np.eye(3), [[0.6, 0.8, 0.0]]])
    R = Rotation.from_rotvec((np.pi - below) * u).as_matrix()
    v = ro.log(R)
    assert np.linalg.norm(v, axis=1).max() <= np.pi + 1e-12
    # at half a turn both signs are right, so compare what they stand for
    np.testing.assert_allclose(ro.exp(v), R, atol=1e-14)
    np.testing.assert_allclose(np.abs(v), np.abs((np.pi - below) * u), atol=1e-8)


def test_log_of_a_mixed_batch_and_without_leading_axes() -> None:
    v = np.array([[0.0, 0.0, 0.0], [0.0, 3.1415, 0.0], [1.0, 2.0, 0.5], [1e-10, 0, 0]])
    np.testing.assert_allclose(ro.log(ro.exp(v)), v, atol=1e-13)
    np.testing.assert_allclose(ro.log(ro.exp(v[2])), v[2], atol=1e-14)
    np.testing.assert_allclose(ro.log(ro.exp(v.reshape(2, 2, 3))), v.reshape(2, 2, 3), atol=1e-13)


def test_right_jacobian_is_the_derivative_of_exp(vectors: np.ndarray) -> None:
    R_t = np.swapaxes(ro.exp(vectors), -1, -2)
    numerical = difference(lambda d: ro.log(R_t @ ro.exp(vectors + d)), np.full(3, 1e-5))
    np.testing.assert_allclose(ro.right_jacobian(vectors), numerical, atol=2e-10)


@pytest.mark.parametrize("vectors", MAGNITUDES[:-1], indirect=True)  # at the last, log jumps within a step
def test_right_jacobian_inverse_is_the_derivative_of_log(vectors: np.ndarray) -> None:
    R = ro.exp(vectors)
    numerical = difference(lambda d: ro.log(R @ ro.exp(d)), np.full(3, 1e-5))
    np.testing.assert_allclose(ro.right_jacobian_inverse(vectors), numerical, atol=1e-9)


def test_jacobian_and_its_inverse_are_inverses(vectors: np.ndarray) -> None:
    product = ro.right_jacobian(vectors) @ ro.right_jacobian_inverse(vectors)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-12)


def test_skew_and_mv() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 5, 4, 3))
    np.testing.assert_allclose(ro.mv(ro.skew(a), b), np.cross(a, b), atol=1e-15)


def test_quaternions_against_scipy() -> None:
    R = random_rotations(np.random.default_rng(4), 500)
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    R = np.concatenate([R, half_turns, np.eye(3)[None]])
    q = ro.to_quaternion(R)
    assert np.all(q[:, 0] >= 0)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix(), R, atol=5e-15)
    np.testing.assert_allclose(ro.from_quaternion(3.0 * q), R, atol=5e-15)


@pytest.mark.parametrize(
    ("rph", "right", "forward", "up"),
    [
        # (roll, pitch, heading) deg -> where the body's right, forward and up axes point in east, north, up
        ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 0, 90), (0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ((0, 0, 180), (-1, 0, 0), (0, -1, 0), (0, 0, 1)),
        ((0, 0, 270), (0, 1, 0), (-1, 0, 0), (0, 0, 1)),
        ((0, 90, 0), (1, 0, 0), (0, 0, 1), (0, -1, 0)),  # nose up
        ((90, 0, 0), (0, 0, -1), (0, 1, 0), (1, 0, 0)),  # right side down
        ((90, 0, 90), (0, 0, -1), (1, 0, 0), (0, -1, 0)),
        ((180, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ],
)
def test_roll_pitch_heading_by_hand(rph: tuple, right: tuple, forward: tuple, up: tuple) -> None:
    R = ro.from_rph(DEG * np.array(rph, dtype=float))
    np.testing.assert_allclose(R, np.column_stack([right, forward, up]), atol=1e-15)


def test_roll_pitch_heading_is_heading_then_pitch_then_roll() -> None:
    """SciPy's intrinsic rotations about -up, right, forward; then back."""
    rng = np.random.default_rng(5)
    rph = np.column_stack([rng.uniform(-180, 180, 300), rng.uniform(-89, 89, 300), rng.uniform(0, 360, 300)]) * DEG
    expected = Rotation.from_euler("ZXY", np.column_stack([-rph[:, 2], rph[:, 1], rph[:, 0]])).as_matrix()
    R = ro.from_rph(rph)
    np.testing.assert_allclose(R, expected, atol=1e-15)
    back = ro.to_rph(R)
    np.testing.assert_allclose(ro.wrap(back - rph), 0.0, atol=1e-12)
    assert np.all((back[:, 2] >= 0) & (back[:, 2] < 2 * np.pi))


def test_rph_jacobian_numerically() -> None:
    rng = np.random.default_rng(6)
    rph = np.column_stack([rng.uniform(-170, 170, 200), rng.uniform(-75, 75, 200), rng.uniform(0, 360, 200)]) * DEG
    R = ro.from_rph(rph)
    numerical = difference(lambda d: ro.wrap(ro.to_rph(R @ ro.exp(d)) - rph), np.full(3, 1e-6))
    np.testing.assert_allclose(ro.rph_jacobian(rph), numerical, atol=2e-8)


def test_of_components_roll_pitch_heading_are_those_of_the_product() -> None:
    R_nb, R_ln = np.split(random_rotations(np.random.default_rng(3), 100), 2)
    rph, J = ro.find_rph(ro.move_components_first(R_nb), ro.move_components_first(R_ln))
    np.testing.assert_allclose(rph, ro.to_rph(R_ln @ R_nb), atol=1e-13)
    np.testing.assert_allclose(np.moveaxis(J, -1, 0), ro.rph_jacobian(rph), rtol=1e-9, atol=1e-9)


def test_wrap() -> None:
    np.testing.assert_allclose(ro.wrap(DEG * np.array([-180.0, 180.0, 190.0, 540.0, -10.0, 359.0])) / DEG,
                               [-180.0, -180.0, -170.0, -180.0, -10.0, -1.0], atol=1e-12)  # fmt: skip


def test_a_single_vector_is_as_one_of_many() -> None:
    """What filters ask for one at a time has code of its own."""
    for size in (1e-7, 1e-3, 0.3, 3.0):
        v = size * np.random.default_rng(3).standard_normal((2, 3)) / np.sqrt(3.0)
        for function in (ro.exp, ro.right_jacobian_inverse, ro.skew):
            np.testing.assert_allclose(function(v[0]), function(v)[0], atol=1e-14)
