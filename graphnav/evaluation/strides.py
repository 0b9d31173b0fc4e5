"""Scores of a walk without a place on the Earth: shape, strides, height and closure.

Position and heading of a solution count from zero at its start, a truth in a local frame from anywhere. For the shape,
yaw and offset are fitted over all epochs, as in `graphnav.evaluation.scoring`. For consistency that would be wrong: the
solution is certain at its start and states everything else relative to it. So the truth is moved to the start of the
solution, and only the yaw is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.interpolation import fit_yaw
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.solution import Solution
from graphnav.evaluation.scoring import measure_closure
from graphnav.recording import Recording

_EPOCH_SPACING = 0.1  # s between the epochs compared with a dense truth
_INITIAL_STANCE = 1.0  # s at the start over which a dense truth is averaged to place it
_FIT_ITERATIONS = 10  # iterations of fitting a point on the foot; and epochs needed for a shape
_A_STRIDE = 0.3  # m; the smallest distance between footprints that counts as a stride


@dataclass(frozen=True)
class WalkErrors:
    """Errors of one solution; NaN where the truth lacks the quantity. Lengths in m, NEES per degree of freedom."""

    horizontal: float  # rms after the fit; for a loop, distance of the end from the start
    in_stance: float  # the same over the epochs in a stance only
    of_steps: float  # the same over the means of stances, so that a rest counts like a step
    of_point: float  # the same with the truth's point on the foot fitted
    up: float  # rms relative to the height at the start; for a loop, end minus start
    stride: float  # median of stride length over its truth; 1 where there is no bias
    nees_h: float
    nees_up: float


def estimate_floor_sigma(recording: Recording, solution: Solution) -> float:
    """1-sigma of a coordinate of a dense truth, m: scatter of its heights between stances on a flat floor.

    The first and the last are left out, in which the foot stands differently.
    """
    truth = recording.truth
    assert truth is not None
    assert truth.xyz is not None
    middle = [(a + 0.3 * (b - a), b - 0.3 * (b - a)) for a, b in solution.stationary[1:-1]]
    inside = [(truth.t >= a) & (truth.t <= b) & np.isfinite(truth.xyz[:, 2]) for a, b in middle]
    return float(np.std([truth.xyz[rows, 2].mean() for rows in inside if rows.any()]))


def compute_walk_errors(recording: Recording, solution: Solution, truth_sigma: float = 0.0) -> WalkErrors:
    """Errors of a walk against the recording's truth.

    Of a dense truth the NEES is of the point that it is of: with a lever arm fitted.

    Parameters
    ----------
    truth_sigma : m, of a coordinate of the truth, added to the solution's own in the NEES: its noise, and how far its
        points lie from the IMU where that is not fitted.

    Raises
    ------
    ValueError
        If the recording has no truth in a local frame and is no loop.
    """
    truth = recording.truth
    if truth is not None and truth.closed_loop_sigma is not None:
        return _evaluate_loop(solution, truth.closed_loop_sigma)
    if truth is None or truth.xyz is None:
        raise ValueError(f"'{recording.name}' has neither a truth in a local frame nor a closed loop")
    t, X = truth.t, truth.xyz
    inside = (t >= solution.t[0]) & (t <= solution.t[-1]) & np.isfinite(X).all(axis=1)
    t, X = t[inside], X[inside]
    first = X[t <= t[0] + _INITIAL_STANCE].mean(axis=0) if X.shape[1] == 3 else X[0]
    if X.shape[1] == 3:
        _, rows = np.unique(np.floor((t - t[0]) / _EPOCH_SPACING), return_index=True)
        t, X = t[rows], X[rows]
    _, states, covariance = solution.at(t)
    p, P = states.p, covariance[:, 3:6, 3:6]
    flat = np.column_stack([X[:, :2], np.zeros(len(X))])
    of_point, arm = fit_point(states, flat)
    # about the start
    q = p if X.shape[1] == 2 else p + states.R_nb @ arm
    at_start = q[0] if X.shape[1] == 2 else q[t <= t[0] + _INITIAL_STANCE].mean(axis=0)
    a, b = X[:, :2] - first[:2], (q - at_start)[:, :2]
    R = truth_sigma**2
    # by the sigmas, lest a heading that was lost midway turns what came before, which is known to centimetres
    weight = 1.0 / (0.5 * (P[:, 0, 0] + P[:, 1, 1]) + R)
    across, along = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.sum(a * b, axis=1)
    e = b - _rotate_by_yaw(a, float(np.arctan2(weight @ across, weight @ along)))
    nees_h = 0.5 * np.einsum("ni,nij,nj->n", e, np.linalg.inv(P[:, :2, :2] + R * np.eye(2)), e)
    up = nees_up = stride = np.nan
    if X.shape[1] == 3:
        height = p[:, 2] - X[:, 2] - np.mean((p[:, 2] - X[:, 2])[t <= t[0] + _INITIAL_STANCE])
        up, e_up = float(np.sqrt(np.mean(height**2))), (q - at_start)[:, 2] - (X[:, 2] - first[2])
        nees_up = float(np.mean(e_up**2 / (P[:, 2, 2] + R)))
    else:
        true, mine = (np.linalg.norm(np.diff(x[:, :2], axis=0), axis=1) for x in (X, p))
        stride = float(np.median((mine / true)[true > _A_STRIDE]))
    # surveyed points are measured where a foot stands; a dense truth also covers the swing
    stances = _find_stances(solution) if X.shape[1] == 3 else np.empty((0, 2))
    horizontal, in_stance, of_steps = compare_shapes(t, p, flat, stances)
    return WalkErrors(horizontal, in_stance, of_steps, of_point, up, stride, float(np.mean(nees_h)), nees_up)


def compare_shapes(t: Array, p: Array, truth: Array, stances: Array) -> tuple[float, float, float]:
    """Horizontal rms, m, after fitting yaw and offset: over all epochs, over those in a stance, over means of stances.

    Parameters
    ----------
    t, p, truth : (N,) s; (N, 3), (N, 3) m, places and true places.
    stances : (S, 2) s; where they hold fewer than ten epochs, all epochs are meant.
    """
    rows = [(t >= a) & (t <= b) for a, b in stances]
    inside = np.any(rows, axis=0) if rows else np.zeros(len(t), dtype=bool)
    everywhere = _compare_shape(p, truth)
    if np.count_nonzero(inside) <= _FIT_ITERATIONS:
        return everywhere, everywhere, everywhere
    means = [np.array([x[one].mean(axis=0) for one in rows if one.any()]) for x in (p, truth)]
    return everywhere, _compare_shape(p[inside], truth[inside]), _compare_shape(*means)


def _evaluate_loop(solution: Solution, sigma: float) -> WalkErrors:
    p, P = solution.states.p, solution.covariance[-1][3:6, 3:6] + sigma**2 * np.eye(3)
    found = measure_closure(Trajectory(solution.t, p, frame="local"))
    off = p[-1] - p[0]
    nees_h = 0.5 * float(off[:2] @ np.linalg.solve(P[:2, :2], off[:2]))
    h, up = found.horizontal, found.vertical
    return WalkErrors(h, h, h, h, up, np.nan, nees_h, float(off[2] ** 2 / P[2, 2]))


def _find_stances(solution: Solution) -> Array:
    """(S, 2) s, the stances; none where they were not detected."""
    return next((d.intervals for d in solution.detections if d.name == "fused"), np.empty((0, 2)))


def _compare_shape(p: Array, truth: Array) -> float:
    flat = truth * [1.0, 1.0, 0.0]
    yaw, offset = fit_yaw(flat, p * [1.0, 1.0, 0.0])
    return float(np.sqrt(np.mean(np.sum((p[:, :2] - _rotate_by_yaw(flat[:, :2], yaw) - offset[:2]) ** 2, axis=1))))


def fit_point(states: States, flat: Array) -> tuple[float, Array]:
    """Horizontal rms after fitting yaw, offset and, alternately, a lever arm in the body; and that arm (3,), m."""
    arm = np.zeros(3)
    level = states.R_nb[:, :2]
    for _ in range(_FIT_ITERATIONS):
        p = np.column_stack([states.p[:, :2] + level @ arm, np.zeros(len(flat))])
        yaw, offset = fit_yaw(flat, p)
        e = p[:, :2] - (_rotate_by_yaw(flat[:, :2], yaw) + offset[:2])
        arm = arm - np.linalg.lstsq((level - level.mean(axis=0)).reshape(-1, 3), e.ravel(), rcond=1e-3)[0]
    return float(np.sqrt(np.mean(np.sum(e**2, axis=1)))), arm


def _rotate_by_yaw(x: Array, yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return x @ np.array([[c, s], [-s, c]])
