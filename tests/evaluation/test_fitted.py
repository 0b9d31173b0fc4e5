"""What is left of the errors of a walk when yaw and offset are fitted has the covariance that is stated of it."""

from __future__ import annotations

import numpy as np
import pytest

from graphnav.core.interpolation import fit_yaw
from graphnav.core.trajectory import Trajectory
from graphnav.evaluation.fitted import propagate_fit
from graphnav.evaluation.scoring import compute_errors

N, RUNS = 60, 1500
POSITION, HEADING, SPEED = 0.02, 0.004, 0.05  # m and rad a step, m/s: 1-sigma of what is added


def walk() -> tuple[np.ndarray, np.ndarray]:
    """True places and velocities of a walk round two corners."""
    heading = np.repeat([0.3, 1.6, 2.9], N // 3)
    v = 1.2 * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(N)])
    return np.cumsum(v, axis=0) - v[0], v


def dead_reckoned(rng: np.random.Generator, p: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (RUNS, N, ...) of place, velocity and yaw."""
    yaw = np.cumsum(HEADING * rng.normal(size=(RUNS, N)), axis=1)
    yaw -= yaw[:, :1]
    step = np.diff(p, axis=0, prepend=p[:1])
    across = np.column_stack([-step[:, 1], step[:, 0], np.zeros(N)])
    noise = POSITION * rng.normal(size=(RUNS, N, 3))
    noise[:, 0] = 0.0
    before = np.concatenate([np.zeros((RUNS, 1)), yaw[:, :-1]], axis=1)
    e = np.cumsum(before[..., None] * across + noise, axis=1)
    ev = SPEED * rng.normal(size=(RUNS, N, 3)) + yaw[..., None] * np.column_stack([-v[:, 1], v[:, 0], np.zeros(N)])
    return e, ev, yaw


def stated(p: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(N, 9, 9) of these errors."""
    step = np.diff(p, axis=0, prepend=p[:1])
    X, out = np.zeros((4, 4)), np.zeros((N, 9, 9))
    for k in range(N):
        F = np.eye(4)
        F[:2, 3] = -step[k, 1], step[k, 0]
        X = F @ X @ F.T + (np.diag([POSITION**2] * 3 + [HEADING**2]) if k else 0.0)
        to = np.zeros((9, 4))
        to[:3, :3], to[3:5, 3], to[8, 3] = np.eye(3), (-v[k, 1], v[k, 0]), -1.0
        out[k] = to @ X @ to.T + np.diag([1e-12] * 3 + [SPEED**2] * 3 + [1e-4] * 2 + [1e-12])
    return out


def test_the_covariance_of_what_a_fit_leaves() -> None:
    p, v = walk()
    e, ev, yaw = dead_reckoned(np.random.default_rng(1), p, v)
    cov, larger = propagate_fit(stated(p, v), p, v)
    assert larger == pytest.approx(1.0, abs=1e-6)
    rest, rest_v, rest_yaw = np.empty_like(e), np.empty_like(ev), np.empty_like(yaw)
    for k in range(RUNS):
        turn, offset = fit_yaw(p, p + e[k])
        c, s = np.cos(turn), np.sin(turn)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        rest[k] = p + e[k] - (p @ R.T + offset)
        rest_v[k], rest_yaw[k] = v + ev[k] - v @ R.T, yaw[k] - turn
    # variances of 1500 runs are known to 4 % (1-sigma)
    for found, at in ((rest, slice(0, 3)), (rest_v, slice(3, 6))):
        true = np.mean(found**2, axis=0)
        np.testing.assert_allclose(np.diagonal(cov[:, at, at], axis1=1, axis2=2), true, rtol=0.2, atol=1e-6)
    np.testing.assert_allclose(cov[:, 8, 8], np.mean(rest_yaw**2, axis=0), rtol=0.2)
    nees = np.einsum("rni,nij,rnj->rn", rest, np.linalg.inv(cov[:, :3, :3]), rest) / 3.0
    np.testing.assert_allclose(nees.mean(axis=0), 1.0, atol=0.15)


@pytest.mark.parametrize("height", [True, False])
def test_nees_of_a_walk_against_a_truth_of_its_own_frame_is_one(height: bool) -> None:
    p, v = walk()
    e, ev, yaw = dead_reckoned(np.random.default_rng(2), p, v)
    t = np.arange(N) * 1.0
    c, s = np.cos(0.7), np.sin(0.7)
    elsewhere = p @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + [5.0, -3.0, 1.0]
    if not height:
        elsewhere[:, 2] = np.nan
    truth = Trajectory(t, elsewhere, frame="local", name="truth")
    found = []
    for k in range(100):
        cov = stated(p + e[k], v + ev[k])  # as estimated
        sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        rph = np.column_stack([np.zeros((N, 2)), np.pi / 2 - np.arctan2(v[:, 1], v[:, 0]) - yaw[k]])
        estimate = Trajectory(
            t, p + e[k], v=v + ev[k], rph=rph, sd_p=sd[:, :3], sd_v=sd[:, 3:6], sd_rph=sd[:, 6:], covariance=cov,
            frame="local", name="walk",
        )  # fmt: skip
        scored = compute_errors(estimate, truth)
        found.append(scored.nees_p / scored.dof_p)
        assert np.isfinite(scored.nees_p).all()
    assert np.mean(found) == pytest.approx(1.0, abs=0.15)
    assert np.max(np.mean(found, axis=0)) < 2.0  # at the start as elsewhere
