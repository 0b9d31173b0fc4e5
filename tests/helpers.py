"""Small tools of the core's tests: numerical derivatives, random states, dense least squares."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from graphnav import rotation
from graphnav.earth import LocalFrame
from graphnav.problem import Problem
from graphnav.recording import Imu, ImuNoise
from graphnav.solution import Solution
from graphnav.state import DIM, States
from graphnav.trajectory import Trajectory

Array = NDArray[np.float64]

FRAME = LocalFrame(np.array([np.radians(48.1), np.radians(11.6), 500.0]))
# central-difference steps per error-state entry: rad, m, m/s, m/s^2, rad/s
STEPS = np.repeat([1e-5, 1e-1, 1e-1, 1e-3, 1e-5], 3)


def difference(f: Callable[[Array], Array], steps: Array, width: int | None = None) -> Array:
    """Central differences of ``f(delta)`` about zero: an array shaped like f with one more axis, last."""
    width = len(steps) if width is None else width
    columns = []
    for k in range(width):
        d = np.zeros(width)
        d[k] = steps[k]
        columns.append((f(d) - f(-d)) / (2.0 * steps[k]))
    return np.stack(columns, -1)


def random_rotations(rng: np.random.Generator, n: int) -> Array:
    """(n, 3, 3), spread over all of SO(3)."""
    return rotation.from_quaternion(rng.standard_normal((n, 4)))


def random_states(rng: np.random.Generator, n: int, span: float = 2e4) -> States:
    """n states anywhere within `span` m, up to highway speed, with biases."""
    p = rng.uniform(-span, span, (n, 3)) * [1.0, 1.0, 0.01]
    return States(
        random_rotations(rng, n),
        p,
        15.0 * rng.standard_normal((n, 3)),
        0.1 * rng.standard_normal((n, 3)),
        0.01 * rng.standard_normal((n, 3)),
    )


def random_imu(rng: np.random.Generator, seconds: float, rate: float = 100.0, noise: ImuNoise | None = None) -> Imu:
    """Violent motion: every sample turns and pushes anew."""
    count = round(seconds * rate)
    gyro = 0.7 * rng.standard_normal((count, 3))
    accel = 3.0 * rng.standard_normal((count, 3)) + [0.5, -0.3, 9.8]
    return Imu(np.arange(1, count + 1) / rate, gyro, accel, noise or ImuNoise())


def truth_states(truth: Trajectory, t: Array, frame: LocalFrame) -> States:
    """The truth at times that are its own, as states in a navigation frame."""
    i = np.searchsorted(truth.t, t - 1e-6)
    assert np.abs(truth.t[i] - t).max() < 1e-6, "the truth has no row at these times"
    p = frame.from_llh(truth.llh[i])
    R_nl = np.swapaxes(frame.R_ln(p), -1, -2)
    zero = np.zeros((len(t), 3))
    ba = zero if truth.accel_bias is None else truth.accel_bias[i]
    bg = zero if truth.gyro_bias is None else truth.gyro_bias[i]
    v = np.einsum("kij,kj->ki", R_nl, truth.v[i])
    return States(R_nl @ rotation.from_rph(truth.rph[i]), p, v, ba, bg)


def errors(solution: Solution, truth: Trajectory) -> tuple[Array, Array, Array, Array]:
    """(position error e n u, its sigma, roll-pitch-heading error, its sigma) at every keyframe; m and rad."""
    mine = solution.trajectory()
    i = np.searchsorted(truth.t, mine.t - 1e-6)
    assert np.abs(truth.t[i] - mine.t).max() < 1e-6, "the truth has no row at these times"
    true = truth_states(truth, mine.t, solution.frame)
    R_ln = solution.frame.R_ln(true.p)
    position = np.einsum("kij,kj->ki", R_ln, solution.states.p - true.p)
    assert mine.sd_p is not None
    assert mine.sd_rph is not None
    return position, mine.sd_p, rotation.wrap(mine.rph - truth.rph[i]), mine.sd_rph


def dense_rows(problem: Problem, states: States, values: dict[str, Array]) -> tuple[Array, Array]:
    """All rows of a problem, whitened, as one dense system A d = b, assembled on its own in NumPy.

    Columns: 15 per keyframe, then each parameter (constants only). Written from `Constraint.linearize` and
    `Motion.linearize`, with none of the solvers' code.
    """
    K = len(problem.t)
    at, columns = DIM * K, {}
    for chain in problem.chains:
        assert len(chain.t) == 1
        k = len(chain.parameter.initial)
        columns[chain.parameter.name] = slice(at, at + k)
        at += k
    rows, right = [], []
    scale = values.get("imu_scale")
    r, Ji, Jj, Js = problem.motion.linearize(states, scale)
    for k in range(K - 1):
        W = np.linalg.inv(np.linalg.cholesky(problem.intervals.covariance[k]))
        A = np.zeros((DIM, at))
        A[:, DIM * k : DIM * k + DIM] = W @ Ji[k]
        A[:, DIM * k + DIM : DIM * k + 2 * DIM] = W @ Jj[k]
        if "imu_scale" in columns:
            A[:, columns["imu_scale"]] = W @ Js[k]
        rows.append(A)
        right.append(-W @ r[k])
    for constraint in (problem.prior, *problem.constraints):
        n = len(constraint)
        given = {p.name: np.tile(values[p.name], (n, 1)) for p in constraint.parameters}
        linear = constraint.linearize(states[constraint.keyframe], given, slice(None))
        for i in range(n):
            A = np.zeros((linear.residual.shape[1], at))
            for name, J in linear.jacobians.items():
                block = {"theta": 0, "p": 3, "v": 6, "ba": 9, "bg": 12}.get(name)
                where = columns.get(name) if block is None else slice(0, 3)
                if block is not None:
                    first = DIM * constraint.keyframe[i] + block
                    where = slice(first, first + 3)
                A[:, where] = J[i]
            rows.append(A / linear.sigma[i][:, None])
            right.append(-linear.residual[i] / linear.sigma[i])
    for chain in problem.chains:
        name, sigma = chain.parameter.name, chain.parameter.sigma
        A = np.zeros((len(sigma), at))
        A[:, columns[name]] = np.diag(1.0 / sigma)
        rows.append(A)
        right.append((chain.parameter.initial - values[name]) / sigma)
    return np.concatenate(rows), np.concatenate(right)
