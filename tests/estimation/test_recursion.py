"""The compiled recursions: against the definitions written out, and against their own text without a compiler."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.solvers import disturbance, recursion
from graphnav.estimation.solvers.robust import weigh_squares

SCALE, PARAMETERS, KEYFRAMES, ROWS = 6, 5, 7, 8  # D = 26
D = DIM + SCALE + PARAMETERS


class Drive:
    """A linear drive with rows in blocks: two at each keyframe, one of three numbers and one of five."""

    def __init__(self) -> None:
        rng = np.random.default_rng(4)
        n, w = KEYFRAMES, DIM + SCALE
        self.F = np.zeros((n - 1, DIM, w))
        self.F[:, :, :DIM] = np.eye(DIM)
        self.F[:, : recursion.MOVING] += 0.1 * rng.standard_normal((n - 1, recursion.MOVING, w))
        self.decay, self.added = np.ones((n - 1, D - DIM)), np.zeros((n - 1, D - DIM))
        self.decay[::2, SCALE:], self.added[::2, SCALE:] = 0.8, 0.3
        half = rng.standard_normal((n - 1, DIM, DIM))
        self.Q = half @ np.swapaxes(half, 1, 2)
        self.gap = rng.standard_normal((n - 1, D))
        self.H, self.r = rng.standard_normal((n, ROWS, D)), rng.standard_normal((n, ROWS))
        self.variance = rng.uniform(0.5, 2.0, (n, ROWS))
        self.used = np.arange(2 * n) != 4
        self.scale = np.ones((n, ROWS))
        self.blocks = recursion.RowBlocks(
            first=2 * np.arange(n + 1), begin=np.tile([0, 3], n), end=np.tile([3, ROWS], n), used=self.used,
            gate=np.full(2 * n, np.inf), kernel=np.zeros(2 * n, dtype=int), size=np.tile([3, 5], n),
            part=np.arange(2 * n + 1), k=np.repeat(np.arange(n), 2), kind=np.tile([0, 1], n),
        )  # fmt: skip
        self.e, self.P = rng.standard_normal(D), np.diag(rng.uniform(1.0, 4.0, D))

    def whole(self, k: int) -> Array:
        """(D, D) of the step to keyframe k."""
        out = np.diag(np.concatenate([np.zeros(DIM), self.decay[k - 1]]))
        out[:DIM, : DIM + SCALE] = self.F[k - 1]
        return out

    def solved(self) -> dict[str, Array]:
        """Filter and smoother by the recursions."""
        n = KEYFRAMES
        out = {name: np.zeros((n, D)) for name in ("ahead", "errors", "r", "smoothed", "N_diagonal", "variance")}
        out |= {name: np.zeros((n, D, D)) for name in ("P_ahead", "P", "P_smoothed")}
        out |= {name: np.zeros((n, ROWS, ROWS)) for name in ("root", "inverse", "of_rows")}
        out |= {name: np.zeros((n, ROWS)) for name in ("solved", "bent", "w")}
        out |= {"Kt": np.zeros((n, ROWS, D)), "N": np.zeros((n, DIM, DIM))}
        (taken, lossy), blocks = np.zeros((2, 2 * n), dtype=bool), self.blocks
        steps, updates = (self.F, self.decay), (out["Kt"], self.H, out["w"], out["inverse"], taken, lossy)
        filtered = out["ahead"], out["P_ahead"], out["errors"], out["P"]
        recursion.filter_rows(
            0, n, self.e, self.P, (*steps, self.gap, self.Q, self.added), (self.r, self.H, self.variance, self.scale),
            blocks.arrays, self.used, filtered, (out["root"], out["solved"], out["bent"]), updates,
            np.zeros(1, dtype=int),
        )  # fmt: skip
        out |= {"taken": taken, "lossy": lossy, "errors_alone": np.zeros((n, D))}
        none = np.empty((0, D, D))
        for P_smoothed, N, errors in (
            (out["P_smoothed"], np.zeros((D, D)), out["smoothed"]),
            (none, np.zeros((D, D)), out["smoothed"]),
            (none, np.zeros((0, 0)), out["errors_alone"]),
        ):
            disturbance.smooth_rows(
                0, n, np.zeros(D), N, steps, updates, blocks.arrays, filtered,
                (errors, out["r"], out["N"], out["N_diagonal"]), (P_smoothed, out["variance"], out["of_rows"]),
                2.0 * self.H, np.tile(np.arange(D), n), D * np.arange(n + 1),
            )  # fmt: skip
        # small, so that turns add up
        moved = 1e-6 * (out["errors"] - out["ahead"])
        half = np.concatenate([np.ones((n, 1)), 0.5 * moved[:, :3]], axis=1)
        turned = half / np.linalg.norm(half, axis=1, keepdims=True)
        out |= {"away": np.zeros((n, D)), "P_back": out["P"].copy(), "away_alone": np.zeros((n, D))}
        for P_smoothed, away in ((out["P_back"], out["away"]), (np.empty((0, D, D)), out["away_alone"])):
            recursion.smooth_filtered(
                0, n - 1, moved, turned, steps, out["P_ahead"], out["P"], P_smoothed, away, np.zeros(1, dtype=int)
            )
        return out


def test_filter_and_smoother_are_one_update_of_the_whole_drive() -> None:
    """All keyframes as one Gaussian vector, and all rows as one measurement of it."""
    drive, n = Drive(), KEYFRAMES
    mean, covariance = np.zeros((n, D)), np.zeros((n, D, n, D))
    mean[0], covariance[0, :, 0] = drive.e, drive.P
    for k in range(1, n):
        step = drive.whole(k)
        mean[k] = drive.gap[k - 1] + step @ mean[k - 1]
        covariance[k, :, :k] = np.einsum("ij,jkl->ikl", step, covariance[k - 1, :, :k])
        covariance[:k, :, k] = np.einsum("ikl->kli", covariance[k, :, :k])
        covariance[k, :, k] = step @ covariance[k - 1, :, k - 1] @ step.T
        covariance[k, :DIM, k, :DIM] += drive.Q[k - 1]
        covariance[k, DIM:, k, DIM:] += np.diag(drive.added[k - 1])
    taken = np.concatenate(
        [np.arange(drive.blocks.begin[b], drive.blocks.end[b]) + ROWS * (b // 2) for b in np.flatnonzero(drive.used)]
    )
    H = np.zeros((n, ROWS, n, D))
    for k in range(n):
        H[k, :, k] = drive.H[k]
    H = H.reshape(n * ROWS, n * D)[taken]
    P = covariance.reshape(n * D, n * D)
    K = np.linalg.solve(H @ P @ H.T + np.diag(drive.variance.ravel()[taken]), H @ P).T
    mean = mean - (K @ (drive.r.ravel()[taken] + H @ mean.ravel())).reshape(n, D)
    blocks = (P - K @ H @ P).reshape(n, D, n, D)
    found = drive.solved()
    np.testing.assert_allclose(found["smoothed"], mean, atol=1e-8)
    np.testing.assert_allclose(found["errors"][-1], mean[-1], atol=1e-8)
    np.testing.assert_allclose(found["errors"] + 1e6 * found["away"], mean, atol=1e-4)
    np.testing.assert_allclose(found["away_alone"], found["away"], atol=1e-12)
    np.testing.assert_allclose(found["P_back"], found["P_smoothed"], atol=1e-8)
    for k in range(n):
        np.testing.assert_allclose(found["P_smoothed"][k], blocks[k, :, k], atol=1e-8)
        np.testing.assert_allclose(found["variance"][k], np.diag(blocks[k, :, k]), atol=1e-8)
        own = 2.0 * drive.H[k]
        np.testing.assert_allclose(found["of_rows"][k], own @ blocks[k, :, k] @ own.T, atol=1e-8)
    np.testing.assert_allclose(found["errors_alone"], found["smoothed"], atol=1e-12)


@pytest.mark.parametrize("prior", [1.0, 1e8])
def test_both_forms_of_an_update_are_the_same_where_no_digits_are_lost(prior: float) -> None:
    """Beside H P H^T = R - R S^-1 R of what is left, which loses none."""
    drive = Drive()
    drive.P *= prior
    H, R = drive.H[0, :3], drive.variance[0, :3]
    HP = H @ drive.P
    S = HP @ H.T + np.diag(R)
    _, inverse = recursion.invert_sum(HP @ H.T, R)
    joseph = recursion.update_covariance(drive.P, HP, H, inverse.T @ (inverse @ HP), R)
    exact = np.diag(R) - R[:, None] * np.linalg.inv(S) * R
    np.testing.assert_allclose(H @ joseph @ H.T, exact, atol=1e-6)
    assert drive.solved()["lossy"][0] == (prior > 1.0)
    if prior == 1.0:
        np.testing.assert_allclose(recursion.reduce(drive.P, inverse @ HP), joseph, atol=1e-12)


def test_errors_behind_each_block_of_a_joint_update() -> None:
    """Beside updates with the rows up to there alone."""
    drive = Drive()
    H, left, ends = drive.H[0], drive.r[0] + drive.H[0] @ drive.e, (3, ROWS)
    S = H @ drive.P @ H.T + np.diag(drive.variance[0])
    root, solved, Kt = np.linalg.cholesky(S), np.linalg.solve(S, left), np.linalg.solve(S, H @ drive.P)
    y = np.tile(drive.e, (3, 1))
    recursion.follow_blocks(np.array([0, 2]), np.array(ends), root[None], solved[None], Kt[None], y)
    for n, found in zip((0, *ends), y, strict=True):
        expected = drive.e - drive.P @ H[:n].T @ np.linalg.solve(S[:n, :n], left[:n])
        np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("kernel", ["huber", "cauchy"])
def test_a_kernel_weighs_rows_by_what_their_update_leaves(kernel: str) -> None:
    """Of weights that are found by the last update the next finds the same, but for what is left to converge."""
    drive = Drive()
    code = {"huber": recursion.HUBER, "cauchy": recursion.CAUCHY}[kernel]
    drive.r *= 5.0
    drive.scale[:] = 1.5
    drive.blocks = replace(drive.blocks, kernel=np.full(2 * KEYFRAMES, code))
    found = drive.solved()
    for b in np.flatnonzero(drive.used):
        k, lo, hi = b // 2, drive.blocks.begin[b], drive.blocks.end[b]
        L = found["root"][k, lo:hi, lo:hi]
        R = np.diag(drive.variance[k, lo:hi])
        HPH, r = L @ L.T - R, L @ (L.T @ found["solved"][k, lo:hi])
        weight, left = np.ones(1), r - HPH @ found["solved"][k, lo:hi]
        for _ in range(recursion.PASSES - 1):
            s = np.array([np.sqrt(np.sum(left**2 / np.diag(R)))])
            weight = weigh_squares(kernel, s, 1.5)[0]
            left = r - HPH @ np.linalg.solve(HPH + R / weight, r)
        np.testing.assert_allclose(found["bent"][k, lo:hi], weight[0], rtol=1e-9)
        np.testing.assert_allclose(found["w"][k, lo:hi], -np.linalg.solve(HPH + R / weight, r), rtol=1e-7)
        np.testing.assert_allclose(found["inverse"][k, lo:hi, lo:hi], np.linalg.inv(HPH + R / weight), rtol=1e-7)


def test_a_gate_refuses_what_its_innovation_says() -> None:
    drive = Drive()
    nis = [
        found["solved"][b // 2, lo:hi] @ found["root"][b // 2, lo:hi, lo:hi] @ found["root"][b // 2, lo:hi, lo:hi].T
        @ found["solved"][b // 2, lo:hi]
        for found in (drive.solved(),)
        for b, (lo, hi) in enumerate(zip(drive.blocks.begin, drive.blocks.end, strict=True))
    ]  # fmt: skip
    first = int(np.argmax(np.where(drive.used, nis, 0.0)))
    gate = np.full(2 * KEYFRAMES, np.inf)
    gate[first] = 0.99 * nis[first]
    drive.blocks = replace(drive.blocks, gate=gate)
    found = drive.solved()
    assert np.array_equal(found["taken"], drive.used & (np.arange(2 * KEYFRAMES) != first))
    without = Drive()
    without.used = drive.used & (np.arange(2 * KEYFRAMES) != first)
    assert np.array_equal(found["smoothed"], without.solved()["smoothed"])


def test_a_covariance_that_is_none_is_found_out() -> None:
    drive = Drive()
    drive.P[3, 3] = -100.0
    with pytest.raises(np.linalg.LinAlgError):
        drive.solved()


def test_without_a_compiler_the_numbers_are_the_same(tmp_path: Path) -> None:
    file = tmp_path / "plain.npz"
    code = (
        "import sys, numpy as np; from test_recursion import Drive; "
        "assert 'numba' not in sys.modules; np.savez(sys.argv[1], **Drive().solved())"
    )
    here = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = {**os.environ, "GRAPHNAV_COMPILE": "0", "PYTHONPATH": here}
    subprocess.run([sys.executable, "-c", code, str(file)], check=True, env=environment)
    plain, found = np.load(file), Drive().solved()
    assert set(plain) == set(found)
    for name, value in found.items():
        np.testing.assert_allclose(plain[name], value, rtol=1e-9, atol=1e-12, err_msg=name)


def test_turns_one_behind_the_other() -> None:
    rng = np.random.default_rng(2)
    for size in (0.0, 1e-9, 1e-3, 1.0, 3.0):
        first, then = rng.standard_normal((2, 3))
        then *= size / np.linalg.norm(then)
        both = rotation.exp(first) @ rotation.exp(then)
        found = recursion.compose_turns(rotation.to_quaternion(rotation.exp(first)), then)
        np.testing.assert_allclose(found, rotation.log(both), atol=1e-12)


@pytest.mark.parametrize("size", range(1, 10))  # with every number of rows that fours leave
def test_a_covariance_times_what_was_divided_by_it(size: int) -> None:
    rng = np.random.default_rng(size)
    half = rng.standard_normal((size, size))
    P, X = half @ half.T + np.eye(size), rng.standard_normal((size, 3))
    found = X.copy()
    recursion.divide_covariance(P, found)
    np.testing.assert_allclose(P @ found, X, rtol=0.0, atol=1e-12)
