"""What graphnav relies on in GTSAM, and what made it avoid the rest; a new GTSAM that differs shows here."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from helpers import Array

from graphnav.estimation.factor_graph.gaussian import Eliminated, eliminate, make_jacobian_factor

N = 40


def ordering(keys: range | list[int]) -> gtsam.Ordering:
    out = gtsam.Ordering()
    for key in keys:
        out.push_back(key)
    return out


def chain(n: int = N, width: int = 3, seed: int = 0, tight: float = 1.0) -> list[tuple[dict[int, Array], Array]]:
    """A chain of variables with a prior and a measurement each; `tight` scales how stiff the links are."""
    rng = np.random.default_rng(seed)
    out: list[tuple[dict[int, Array], Array]] = [({0: np.eye(width)}, rng.standard_normal(width))]
    for k in range(n - 1):
        F = np.eye(width) + 0.1 * rng.standard_normal((width, width))
        out.append(({k: -tight * F, k + 1: tight * np.eye(width)}, rng.standard_normal(width)))
    out += [({k: rng.standard_normal((2, width))}, rng.standard_normal(2)) for k in range(n)]
    return out


def native(parts: list[tuple[dict[int, Array], Array]]) -> gtsam.GaussianFactorGraph:
    graph = gtsam.GaussianFactorGraph()
    for blocks, b in parts:
        flat = [x for key, A in blocks.items() for x in (key, A)]
        graph.push_back(gtsam.JacobianFactor(*flat, b, gtsam.noiseModel.Unit.Create(len(b))))
    return graph


def ours(parts: list[tuple[dict[int, Array], Array]], order: range | list[int]) -> Eliminated:
    graph = []
    for blocks, b in parts:
        graph.append(([(np.array([key]), A[None]) for key, A in blocks.items()], b[None]))
    return eliminate(graph, order)


def dense(parts: list[tuple[dict[int, Array], Array]], n: int = N, width: int = 3) -> tuple[Array, Array]:
    """Solution and covariance by QR of one matrix."""
    rows = []
    for blocks, b in parts:
        row = np.zeros((len(b), n * width))
        for key, A in blocks.items():
            row[:, key * width : (key + 1) * width] = A
        rows.append(row)
    Q, R = np.linalg.qr(np.concatenate(rows))
    root = np.linalg.inv(R)
    return root @ (Q.T @ np.concatenate([b for _, b in parts])), root @ root.T


def test_linear_graph_is_dense_least_squares() -> None:
    parts = chain()
    x, C = dense(parts)
    solved = ours(parts, range(N))
    np.testing.assert_allclose(np.concatenate(solved.solve(range(N))), x, atol=1e-10)
    for key, block in solved.compute_covariances().items():
        np.testing.assert_allclose(block, C[3 * key : 3 * key + 3, 3 * key : 3 * key + 3], atol=1e-10)


def test_covariances_with_a_variable_that_everything_touches() -> None:
    """A constant parameter, eliminated last: it stays among the parents all along the chain."""
    rng = np.random.default_rng(3)
    parts = chain()
    parts = [({**blocks, N: rng.standard_normal((len(b), 3))}, b) for blocks, b in parts]
    x, C = dense(parts, N + 1)
    solved = ours(parts, range(N + 1))
    np.testing.assert_allclose(np.concatenate(solved.solve(range(N + 1))), x, atol=1e-9)
    found = solved.compute_covariances()
    assert set(found) == set(range(N + 1))
    for key, block in found.items():
        np.testing.assert_allclose(block, C[3 * key : 3 * key + 3, 3 * key : 3 * key + 3], atol=1e-9)
    assert set(solved.compute_covariances({0, 7, N})) == {0, 7, N}


def test_the_bayes_net_comes_in_the_order_of_elimination() -> None:
    """`Eliminated.covariances` walks it backwards and meets every parent before its child."""
    for order in (list(range(N)), [1, 0, *range(2, N)]):
        net = native(chain()).eliminateSequential(ordering(order), gtsam.EliminateQR)
        assert [net.at(i).keys()[0] for i in range(net.size())] == order
        seen: set[int] = set()
        for i in range(net.size() - 1, -1, -1):
            key, *parents = net.at(i).keys()
            assert set(parents) <= seen
            seen.add(key)


def test_a_conditional_is_r_x_plus_s_parents_is_d() -> None:
    parts = chain(2)
    net = native(parts).eliminateSequential(ordering([0, 1]), gtsam.EliminateQR)
    x, _ = dense(parts, 2)
    conditional = net.at(0)
    assert list(conditional.keys()) == [0, 1]
    np.testing.assert_allclose(conditional.R() @ x[:3] + conditional.S() @ x[3:], conditional.d(), atol=1e-12)
    np.testing.assert_allclose(conditional.R(), np.triu(conditional.R()))


def test_cholesky_rejects_what_qr_solves() -> None:
    """Two entries tied stiffly, their common value known loosely: GTSAM 4.3 wants R_ii^2 >= 2^-24 A_ii of a pivot.

    Biases tied by their walk in one clique, under a prior that is loose beside it, are like that.
    """
    tie, prior = np.array([[-1e4, 1e4], [0.0, 0.0]]), np.array([[0.1, 0.0], [0.0, 0.0]])
    parts: list[tuple[dict[int, Array], Array]] = [
        ({0: tie}, np.zeros(2)),
        ({0: prior}, np.array([0.2, 0.0])),
        ({0: tie[:, ::-1], 1: np.eye(2)}, np.ones(2)),
    ]
    with pytest.raises(RuntimeError, match="linear system"):
        native(parts).eliminateSequential(ordering([0, 1]))  # Cholesky is the default
    x, C = dense(parts, 2, 2)
    solved = ours(parts, [0, 1])
    np.testing.assert_allclose(np.concatenate(solved.solve([0, 1])), x, atol=1e-6)
    np.testing.assert_allclose(solved.compute_covariances()[0], C[:2, :2], rtol=1e-6)


def test_tree_marginals_away_from_the_root_lose_digits() -> None:
    """Why `Eliminated.covariances` exists: BayesTree's marginals go through Cholesky, whatever eliminated the tree."""
    parts = chain(tight=1e3)
    _, C = dense(parts)
    tree = native(parts).eliminateMultifrontal(ordering(range(N)), gtsam.EliminateQR)
    mine = ours(parts, range(N)).compute_covariances()

    def off(block: Array, key: int) -> float:
        true = C[3 * key : 3 * key + 3, 3 * key : 3 * key + 3]
        return float(np.abs(block - true).max() / np.abs(true).max())

    at_root, far = off(tree.marginalCovariance(N - 1), N - 1), off(tree.marginalCovariance(0), 0)
    assert off(mine[0], 0) < 1e-8
    assert at_root < 1e-8
    assert far > 100.0 * off(mine[0], 0)


def test_a_long_chain_does_not_exhaust_the_stack() -> None:
    n = 50_000
    keys = np.arange(n)
    one = np.ones((n, 1, 1))
    links = [(keys[:-1], -one[1:]), (keys[1:], one[1:])]
    rows = [([(keys, one)], np.zeros((n, 1))), (links, np.ones((n - 1, 1)))]
    x = np.concatenate(eliminate(rows, range(n)).solve(range(n)))
    # inside, the second difference of x equals x: it dies out from both ends, where the links pull one way
    assert np.abs(x[n // 2]) < 1e-9
    assert x[0] == pytest.approx(-x[-1])
    assert x[0] < -0.5


@pytest.mark.parametrize("share", [0.0, 0.9, 0.97])
@pytest.mark.parametrize("size", [1.0, 1e5])
def test_rows_may_touch_more_variables_than_the_constructors_know(share: float, size: float) -> None:
    """Rows of satellites, each of which touches few of many parameters: a `share` of their entries is zero."""
    rng = np.random.default_rng(4)
    for n, m in ((1, 3), (3, 18), (4, 18), (7, 1), (7, 18)):
        blocks = [(key, size * rng.standard_normal((m, w))) for key, w in enumerate(rng.integers(1, 40, n))]
        blocks = [(key, A * (rng.random(A.shape) >= share)) for key, A in blocks]
        b = rng.standard_normal(m)
        factor = make_jacobian_factor(blocks, b)
        np.testing.assert_array_equal(factor.getA(), np.concatenate([A for _, A in blocks], axis=1))
        np.testing.assert_array_equal(factor.getb(), b)


def test_a_sum_of_five_variables_is_solved() -> None:
    rows = [([(np.array([key]), np.eye(2)[None]) for key in range(5)], np.array([[1.0, -1.0]]))]
    rows += [([(np.array([key]), 1e-3 * np.eye(2)[None])], np.zeros((1, 2))) for key in range(5)]
    np.testing.assert_allclose(sum(eliminate(rows, range(5)).solve(range(5))), [1.0, -1.0], atol=1e-6)


def test_keys_may_stand_in_any_order_and_matrices_in_any_layout() -> None:
    """Blocks are handed over by columns; rows given in either memory order must come out alike."""
    rng = np.random.default_rng(5)
    A, b = rng.standard_normal((4, 3, 3)), rng.standard_normal((4, 3))
    found = []
    for layout in (np.ascontiguousarray(A), np.asfortranarray(A), A[:, ::-1][:, ::-1]):
        solved = eliminate([([(np.array([3, 1, 2, 0]), layout)], b)], [2, 0, 3, 1])
        found.append(np.stack(solved.solve([3, 1, 2, 0])))
    np.testing.assert_allclose(found[0], np.linalg.solve(A, b[..., None])[..., 0], atol=1e-10)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
