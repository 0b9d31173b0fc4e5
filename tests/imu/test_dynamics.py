"""What an interval says of its ends: every Jacobian against differences, and the noise against its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers import FRAME, STEPS, Array, difference, random_imu, random_states

from graphnav.core import rotation as ro
from graphnav.core.state import DIM, Parameter, States
from graphnav.imu.dynamics import SCALE, ImuFactors, convert_to_biases, make_scale_parameter
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Imu, ImuNoise

N = 6


def near(x: States, ba: float, bg: float) -> States:
    """With biases where the intervals' first-order correction holds (`Intervals.is_out_of_range`)."""
    return replace(x, ba=ba + 0.05 * x.ba, bg=bg + 0.01 * x.bg)


@pytest.fixture(scope="module")
def motion() -> ImuFactors:
    imu = random_imu(np.random.default_rng(1), 8.0, 200.0)
    t = np.array([0.0, 0.01, 0.5, 1.503, 2.5, 4.0, 8.0])
    return ImuFactors(preintegrate(bridge_gaps(imu), imu, t, np.full(3, 0.05), np.full(3, 0.01)), FRAME)


@pytest.fixture(scope="module")
def start() -> States:
    return near(random_states(np.random.default_rng(2), N), 0.05, 0.01)


SCALES = 2e-3 * np.random.default_rng(7).normal(size=11)  # of a vehicle
SQUARE = 2e-3 * np.random.default_rng(9).normal(size=18)  # of a foot


def sizes(J: Array, begins: Sequence[int] | None = None) -> Array:
    """Largest entry per block of three rows and of the columns that begin at some, spread back: the yardstick of a
    comparison."""
    n, m, k = J.shape
    at = list(range(0, k, 3) if begins is None else begins)
    rows = np.abs(J).reshape(n, m // 3, 3, k).max(axis=2)
    return np.repeat(np.repeat(np.maximum.reduceat(rows, at, axis=2), 3, axis=1), np.diff([*at, k]), axis=2)


def triads(scale: Array) -> list[int]:
    """Where the scale errors of gyro and accelerometer begin."""
    return [0, 9 if len(scale) == 18 else 5]


@pytest.mark.parametrize("scale", [None, SCALES])
def test_transition_numerically(motion: ImuFactors, start: States, scale: Array | None) -> None:
    end, F = motion.propagate(slice(None), start, scale)

    def moved(d: Array) -> Array:
        return motion.propagate(slice(None), start.plus(np.tile(d, (N, 1))), scale)[0].minus(end)

    numerical = difference(moved, STEPS)
    # gravity's gradient is that at the origin, on a sphere: 1e-7 1/s^2, and the intervals last up to 4 s
    assert np.all(np.abs(F[:, :, :DIM] - numerical) < 1e-6 * sizes(numerical) + 2e-7)


@pytest.mark.parametrize("scale", [SCALES, SQUARE], ids=["scales", "square"])
def test_scale_columns_numerically(motion: ImuFactors, start: States, scale: Array) -> None:
    end, F = motion.propagate(slice(None), start, scale)
    numerical = difference(
        lambda d: motion.propagate(slice(None), start, scale + d)[0].minus(end), np.full(len(scale), 1e-4)
    )
    assert np.all(np.abs(F[:, :, DIM:] - numerical) < 3e-6 * sizes(numerical, triads(scale)) + 2e-7)


def test_slices_are_rows_of_the_whole(motion: ImuFactors, start: States) -> None:
    end, F = motion.propagate(slice(None), start, SCALES)
    for k in range(N):
        rows = slice(k, k + 1)
        one, F1 = motion.propagate(rows, start[rows], SCALES)
        np.testing.assert_allclose(one.minus(end[rows]), 0.0, atol=1e-9)
        np.testing.assert_allclose(F1[0], F[k], rtol=1e-12, atol=1e-12)


@pytest.fixture(scope="module")
def torn() -> tuple[ImuFactors, States]:
    """A chain whose states do not fit together at all: residuals of radians and hundreds of metres."""
    imu = random_imu(np.random.default_rng(4), 4.0, 200.0)
    t = np.array([0.0, 1.0, 1.7, 3.0, 4.0])
    motion = ImuFactors(preintegrate(bridge_gaps(imu), imu, t, np.zeros(3), np.zeros(3)), FRAME)
    return motion, near(random_states(np.random.default_rng(5), 5, span=300.0), 0.0, 0.0)


def test_linearize_numerically_at_large_residuals(torn: tuple[ImuFactors, States]) -> None:
    motion, x = torn
    value, Ji, Jj, _ = motion.linearize(x, SCALES)
    assert np.linalg.norm(value[:, :3], axis=1).max() > 1.5
    assert np.abs(value[:, 3:6]).max() > 100.0
    np.testing.assert_allclose(value, motion.compute_residual(x, SCALES), atol=1e-9)

    def at(which: int, d: Array) -> Array:
        # only even or only odd states move, so that every interval has one end still
        moved = np.zeros((5, DIM))
        moved[which::2] = d
        return motion.compute_residual(x.plus(moved), SCALES)

    even, odd = (difference(lambda d, w=w: at(w, d), STEPS) for w in (0, 1))
    first = np.arange(4) % 2 == 0
    for J, numerical in (
        (Ji, np.where(first[:, None, None], even, odd)),
        (Jj, np.where(first[:, None, None], odd, even)),
    ):
        assert np.all(np.abs(J - numerical) < 1e-6 * sizes(numerical) + 1e-6)
    for scale in (SCALES, SQUARE):
        Js = motion.linearize(x, scale)[3]
        numerical = difference(lambda d, s=scale: motion.compute_residual(x, s + d), np.full(len(scale), 1e-4))
        assert np.all(np.abs(Js - numerical) < 1e-6 * sizes(numerical, triads(scale)) + 1e-6)


def test_residual_of_propagated_states_is_zero(motion: ImuFactors) -> None:
    state = random_states(np.random.default_rng(6), 1)
    chain = [state]
    for k in range(N):
        chain.append(motion.propagate(slice(k, k + 1), chain[-1], SCALES)[0])
    x = States.stack(chain)
    np.testing.assert_allclose(motion.compute_residual(x, SCALES), 0.0, atol=1e-9)
    np.testing.assert_allclose(motion.linearize(x, SCALES)[0], 0.0, atol=1e-9)
    assert np.abs(motion.compute_residual(x)).max() > 1e-4  # and the scale matters


def test_transition_is_the_linearization_where_the_residual_is_zero(motion: ImuFactors, start: States) -> None:
    """The filter's F and Q against the graph's Ji and Jj: at zero residual they say the same of every interval."""
    end, F = motion.propagate(slice(None), start)
    Q = motion.compute_noise(slice(None), start.R_nb)
    for k in range(N):
        one = ImuFactors(motion.intervals[k : k + 1], FRAME)
        _, Ji, Jj, _ = one.linearize(States.stack([start[k : k + 1], end[k : k + 1]]))
        Jinv = np.linalg.inv(Jj[0])
        np.testing.assert_allclose(-Jinv @ Ji[0], F[k], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            Jinv @ motion.intervals.covariance[k] @ Jinv.T, Q[k], rtol=1e-9, atol=1e-9 * np.abs(Q[k]).max()
        )


@pytest.mark.parametrize("scale", [None, SCALES])
def test_successive_intervals_are_one_after_the_other(motion: ImuFactors, start: States, scale: Array | None) -> None:
    x, ends = start[:1], []
    for k in range(2, N):
        x = motion.advance(slice(k, k + 1), x, scale)
        ends.append(x)
    off = np.abs(motion.advance_through(slice(2, N), start[:1], scale).minus(States.stack(ends)))
    # over all of them gravity changes with the velocity at the start only, and the acceleration moves it by `bend`
    T = float(motion.intervals.T[2:].sum())
    bend = float(np.linalg.norm(x.p - start.p[0] - T * start.v[0]))
    missed = float(np.linalg.norm(FRAME.gravity_gradient, 2)) * bend
    assert off[:, :3].max() < 1e-12
    assert off[:, 3:6].max() < missed * T**2 / 2.0
    assert off[:, 6:9].max() < missed * T
    assert np.all(off[:, 9:] == 0.0)


def test_noise_by_monte_carlo(motion: ImuFactors, start: States) -> None:
    """Perturb the interval's dR, dV, dP and see where the end goes: the frames and the signs of Q."""
    k, runs = 3, 4000
    row = motion.intervals[k : k + 1]
    C = row.covariance[0]
    d = np.random.default_rng(7).multivariate_normal(np.zeros(15), C, runs, method="cholesky")
    many = row[np.zeros(runs, dtype=int)]
    # an interval that says too little by d predicts an end from which the true one differs by +d
    disturbed = replace(many, dR=many.dR @ ro.exp(d[:, :3]), dP=many.dP + d[:, 3:6], dV=many.dV + d[:, 6:9])
    x = start[np.full(runs, k)]
    exact = motion.propagate(slice(k, k + 1), start[k : k + 1])[0]
    end = ImuFactors(disturbed, FRAME).propagate(slice(None), x)[0]
    e = end.minus(exact[np.zeros(runs, dtype=int)])
    e[:, 9:] += d[:, 9:]  # the biases walk by themselves
    Q = motion.compute_noise(slice(k, k + 1), start.R_nb[k : k + 1])[0]
    white = np.linalg.solve(np.linalg.cholesky(Q), e.T)
    values = np.linalg.eigvalsh(white @ white.T / runs)
    ratio = np.sqrt(15 / runs)
    assert values.min() > (1 - ratio) ** 2 * 0.98
    assert values.max() < (1 + ratio) ** 2 * 1.02


def test_scale_parameter() -> None:
    def of(noise: ImuNoise, platform: str = "vehicle") -> tuple[Parameter, ...]:
        imu = Imu(np.empty(0), np.empty((0, 3)), np.empty((0, 3)), noise)
        return make_scale_parameter(imu.noise, platform)

    noise = ImuNoise(gyro_scale_sigma=1e-3, accel_scale_sigma=2e-3)
    assert of(ImuNoise(gyro_scale_sigma=0.0, accel_scale_sigma=0.0)) == ()
    (p,) = of(noise)
    assert p.name == SCALE
    assert p.walk == 0.0
    np.testing.assert_allclose(p.sigma, [1e-3, *[1e-3 / 3] * 4, 2e-3, 2e-3, *[2e-3 / 3] * 4])
    (p,) = of(noise, "foot")
    np.testing.assert_allclose(p.sigma, [*[1e-3] * 3, *[1e-3 / 3] * 6, *[2e-3] * 3, *[2e-3 / 3] * 6])


def test_scale_errors_are_like_biases_of_a_matrix() -> None:
    """Against M x with the matrix written out; a vehicle's terms are those of a matrix that is zero elsewhere."""
    rng = np.random.default_rng(8)
    force, rate, scale = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=18)

    def matrix(s: Array) -> Array:
        return np.array([[s[0], s[3], s[4]], [s[5], s[1], s[6]], [s[7], s[8], s[2]]])

    of_accel, of_gyro = convert_to_biases(scale, force, rate)
    np.testing.assert_allclose(of_gyro, rate @ matrix(scale[:9]).T, rtol=1e-12)
    np.testing.assert_allclose(of_accel, force @ matrix(scale[9:]).T, rtol=1e-12)
    whole = np.zeros(18)
    whole[[2, 3, 4, 5, 6]], whole[[9, 10, 12, 14, 16, 17]] = scale[:5], scale[5:11]
    for few, all_of_them in zip(
        convert_to_biases(scale[:11], force, rate), convert_to_biases(whole, force, rate), strict=True
    ):
        np.testing.assert_allclose(few, all_of_them, rtol=1e-12)
