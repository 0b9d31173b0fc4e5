"""A verdict on sigmas holds: errors that last are few, and no block of the state is left out of it."""

from __future__ import annotations

import numpy as np
import pytest

from graphnav.core.sample_size import count_effective_epochs
from graphnav.evaluation.metrics import Errors
from graphnav.evaluation.sigmas import judge_sigmas, select_verdict
from graphnav.report.sentences import describe_sigma

N = 600


def lasting(rng: np.random.Generator, steps: float, k: int = 9) -> np.ndarray:
    """(N, k) of a first-order Gauss-Markov process of unit variance."""
    decay = np.exp(-1.0 / steps) if steps else 0.0
    x = np.empty((N, k))
    x[0] = rng.normal(size=k)
    for i in range(1, N):
        x[i] = decay * x[i - 1] + np.sqrt(1.0 - decay**2) * rng.normal(size=k)
    return x


def errors_of(over_sigma: np.ndarray) -> Errors:
    """Of errors (N, 9) in units of their sigma: position, velocity, roll, pitch, heading."""
    sd = np.concatenate([np.full(3, 0.1), np.full(3, 0.02), np.radians([0.1, 0.1, 2.0])]) * np.ones((N, 9))
    e, z = over_sigma * sd, over_sigma**2
    return Errors(
        np.arange(N) * 1.0, e[:, :3], e[:, :2], e[:, 3:6], e[:, 6:], sd[:, :3], sd[:, 3:6], sd[:, 6:],
        z[:, :3].sum(1), z[:, :3], z[:, 3:6].sum(1), z[:, 6:].sum(1), np.arange(N) * 5.0, nees_heading=z[:, 8],
    )  # fmt: skip


@pytest.mark.parametrize("steps", [0.0, 10.0, 100.0, 1000.0])
def test_true_sigmas_are_not_found_too_small(steps: float) -> None:
    rng = np.random.default_rng(3)
    found = [judged.verdict for _ in range(40) for judged in judge_sigmas(errors_of(lasting(rng, steps)))]
    assert found.count("too small") <= 0.02 * len(found)
    if steps <= 10.0:
        assert found.count("fits") >= 0.95 * len(found)


@pytest.mark.parametrize("steps", [0.0, 10.0])
@pytest.mark.parametrize("block", [0, 3, 6])
def test_sigmas_half_as_large_as_errors_are_found_too_small(steps: float, block: int) -> None:
    rng = np.random.default_rng(4)
    for _ in range(10):
        x = lasting(rng, steps)
        x[:, block : block + 3] *= 2.0
        name = ("position", "velocity", "attitude")[block // 3]
        assert {j.block: j.verdict for j in judge_sigmas(errors_of(x))}[name] == "too small"
        assert "verdict bad" in describe_sigma("batch", errors_of(x))


def test_a_heading_that_is_lost_is_not_believed() -> None:
    x = lasting(np.random.default_rng(5), 10.0)
    x[:, 8] = 71.0 / 2.0  # deg over its sigma, all the time
    said = describe_sigma("batch", errors_of(x))
    assert "verdict bad" in said
    assert "heading" in said
    assert "position" not in said


@pytest.mark.parametrize(("axis", "part", "whole"), [(2, "height", "position"), (8, "heading", "attitude")])
def test_an_axis_that_alone_is_wrong_is_named(axis: int, part: str, whole: str) -> None:
    x = lasting(np.random.default_rng(8), 0.0)
    x[:, axis] *= 2.0
    judged = judge_sigmas(errors_of(x))
    assert {j.block: j.verdict for j in judged}[whole] == "fits"  # the mean over three axes hides it
    assert [j.block for j in select_verdict(judged, "too small")] == [part]
    x[:, axis] *= 2.0
    judged = judge_sigmas(errors_of(x))
    assert {j.block: j.verdict for j in judged}[whole] == "too small"
    assert [j.block for j in select_verdict(judged, "too small")] == [part]
    x[:, axis - 2 : axis] *= 4.0  # the others as well
    assert [j.block for j in select_verdict(judge_sigmas(errors_of(x)), "too small")] == [whole, part]


def test_an_error_that_does_not_change_is_one() -> None:
    assert count_effective_epochs(np.full((N, 3), 1.8)) == pytest.approx(1.0)
    assert count_effective_epochs(np.random.default_rng(6).normal(size=(N, 3))) > 0.9 * N
    x = lasting(np.random.default_rng(7), 0.0)
    x[:, 8] = 1.8
    judged = {j.block: j for j in judge_sigmas(errors_of(x))}
    assert judged["heading"].verdict == "unclear"
    said = describe_sigma("batch", errors_of(x))
    assert "verdict bad" not in said
    assert "verdict good" not in said


def test_how_many_epochs_correlated_errors_are_worth() -> None:
    # of a Gauss-Markov process r = exp(-k/T), so that squares are worth n / coth(1/T)
    worth = [count_effective_epochs(lasting(np.random.default_rng(seed), 5.0, 3)) for seed in range(20)]
    assert np.median(worth) == pytest.approx(N * np.tanh(0.2), rel=0.25)
