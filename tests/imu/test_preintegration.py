"""Preintegrated intervals: against GTSAM's own Galilean ones, Monte Carlo, and themselves split and joined."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from helpers import Array, difference, random_imu
from scipy.signal import lfilter

from graphnav.core import rotation as ro
from graphnav.imu.preintegration import Intervals, integrate_prefix, preintegrate, preintegrate_unknown
from graphnav.imu.samples import Samples, bridge_gaps
from graphnav.recording import Imu, ImuNoise

BA, BG = np.array([0.08, -0.05, 0.03]), np.array([0.012, -0.02, 0.007])
FIELDS = tuple(Intervals.__dataclass_fields__)


def gtsam_preintegrated(samples: Samples, t0: float, t1: float, ba: Array, bg: Array) -> tuple[Array, Array, Array]:
    """dR, dV, dP by PreintegratedCombinedMeasurementsG, fed piece by piece."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.8)
    pim = gtsam.PreintegratedCombinedMeasurementsG(params, gtsam.imuBias.ConstantBias(ba, bg))
    begin = np.concatenate([[samples.start], samples.t[:-1]])
    for k in range(len(samples.t)):
        dt = min(samples.t[k], t1) - max(begin[k], t0)
        if dt > 1e-12:
            pim.integrateMeasurement(samples.accel[k], samples.gyro[k], dt)
    return pim.deltaRij().matrix(), pim.deltaVij(), pim.deltaPij()


@pytest.fixture(scope="module")
def imu() -> Imu:
    return random_imu(np.random.default_rng(1), 6.0, 100.0)


@pytest.fixture(scope="module")
def samples(imu: Imu) -> Samples:
    return bridge_gaps(imu)


TIMES = np.array([0.0, 0.0173, 0.02, 0.5, 1.7771, 3.0, 6.0])


def test_means_as_gtsam(imu: Imu, samples: Samples) -> None:
    iv = preintegrate(samples, imu, TIMES, BA, BG)
    for k in range(len(iv)):
        dR, dV, dP = gtsam_preintegrated(samples, TIMES[k], TIMES[k + 1], BA, BG)
        np.testing.assert_allclose(iv.dR[k], dR, atol=1e-12)
        np.testing.assert_allclose(iv.dV[k], dV, atol=1e-12 * max(1.0, np.abs(dV).max()))
        np.testing.assert_allclose(iv.dP[k], dP, atol=1e-12 * max(1.0, np.abs(dP).max()))


def test_bias_jacobians_as_differences_of_gtsam() -> None:
    """Summed over cells of four pieces, where GTSAM takes every sample: 2e-4 of a first-order correction."""
    t = np.arange(1, 401) / 200.0
    gyro = np.column_stack([0.1 * np.sin(3 * t), 0.2 * np.cos(2 * t), 0.5 + 0.1 * t])
    accel = np.column_stack([np.sin(t), 2 * np.cos(2 * t), 9.8 + 0.5 * np.sin(5 * t)])
    imu = Imu(t, gyro, accel)
    samples = bridge_gaps(imu)
    times = np.array([0.0, 0.4987, 2.0])
    iv = preintegrate(samples, imu, times, BA, BG)
    for k in range(2):
        R0 = iv.dR[k]

        def moved(d: Array, k: int = k, R0: Array = R0) -> Array:
            dR, dV, dP = gtsam_preintegrated(samples, times[k], times[k + 1], BA + d[:3], BG + d[3:])
            return np.concatenate([ro.log(R0.T @ dR), dV, dP])

        J = difference(moved, np.repeat([1e-3, 1e-4], 3))
        T = iv.T[k]
        np.testing.assert_allclose(J[:3, :3], 0.0, atol=1e-9)
        for mine, numerical, size in (
            (iv.theta_bg[k], J[:3, 3:], T),
            (iv.v_ba[k], J[3:6, :3], T),
            (iv.v_bg[k], J[3:6, 3:], 10 * T**2 / 2),
            (iv.p_ba[k], J[6:, :3], T**2 / 2),
            (iv.p_bg[k], J[6:, 3:], 10 * T**3 / 6),
        ):
            np.testing.assert_allclose(mine, numerical, atol=2e-4 * size)


def test_first_order_correction_holds_as_stated(imu: Imu, samples: Samples) -> None:
    far = preintegrate(samples, imu, TIMES, BA, BG)
    ba, bg = BA + 0.02, BG + np.array([3e-4, -2e-4, 1e-4])
    near = preintegrate(samples, imu, TIMES, ba, bg)
    da, dg = ba - BA, bg - BG
    dR = far.dR @ ro.exp(far.theta_bg @ dg)
    dV = far.dV + far.v_ba @ da + far.v_bg @ dg
    dP = far.dP + far.p_ba @ da + far.p_bg @ dg
    one = far.T <= 1.3  # what is neglected grows with the angle squared
    assert one.sum() >= 4
    np.testing.assert_allclose(ro.log(np.swapaxes(near.dR, -1, -2) @ dR)[one], 0.0, atol=2e-6)
    np.testing.assert_allclose((dV - near.dV)[one], 0.0, atol=2e-5)
    np.testing.assert_allclose((dP - near.dP)[one], 0.0, atol=2e-5)
    assert not far.is_out_of_range(np.tile(BG, (len(far), 1))).any()
    moved = np.tile(BG + np.array([0.0, 0.0, 0.01]), (len(far), 1))
    assert far.is_out_of_range(moved).tolist() == (0.01 * far.T > 1e-3).tolist()


def test_intervals_compose_exactly_wherever_they_are_split(imu: Imu, samples: Samples) -> None:
    """Galilean composition of the means; the same of Jacobians and covariance to the midpoint rule's order."""
    whole = preintegrate(samples, imu, np.array([0.0, 6.0]), BA, BG)
    parts = preintegrate(samples, imu, np.sort(np.r_[0.0, np.random.default_rng(2).uniform(0, 6, 40), 6.0]), BA, BG)
    R, V, P = np.eye(3), np.zeros(3), np.zeros(3)
    for k in range(len(parts)):
        P = P + V * parts.T[k] + R @ parts.dP[k]
        V = V + R @ parts.dV[k]
        R = R @ parts.dR[k]
    np.testing.assert_allclose(whole.dR[0], R, atol=1e-12)
    np.testing.assert_allclose(whole.dV[0], V, atol=1e-11)
    np.testing.assert_allclose(whole.dP[0], P, atol=1e-10)


def composed_covariance(parts: Intervals) -> Array:
    """Covariance of joined intervals by the textbook recursion, in the frames of `Intervals.covariance`."""
    S = np.zeros((15, 15))  # of (theta, p, v, ba, bg): p, v in axes of the very first start
    R = np.eye(3)
    for k in range(len(parts)):
        F, G = np.eye(15), np.eye(15)
        F[:3, :3] = parts.dR[k].T
        F[:3, 12:] = parts.theta_bg[k]
        F[3:6, :3], F[6:9, :3] = -R @ ro.skew(parts.dP[k]), -R @ ro.skew(parts.dV[k])
        F[3:6, 6:9] = parts.T[k] * np.eye(3)
        F[3:6, 9:12], F[3:6, 12:] = R @ parts.p_ba[k], R @ parts.p_bg[k]
        F[6:9, 9:12], F[6:9, 12:] = R @ parts.v_ba[k], R @ parts.v_bg[k]
        G[3:6, 3:6] = G[6:9, 6:9] = R
        S = F @ S @ F.T + G @ parts.covariance[k] @ G.T
        R = R @ parts.dR[k]
    return S


@pytest.mark.parametrize("walks", [False, True])
def test_covariance_composes(walks: bool) -> None:
    noise = ImuNoise(1e-4, 1e-3, 2e-6 * walks, 5e-5 * walks)
    imu = random_imu(np.random.default_rng(3), 4.0, 200.0, noise)
    samples = bridge_gaps(imu)
    whole = preintegrate(samples, imu, np.array([0.0, 4.0]), BA, BG).covariance[0]
    parts = preintegrate(samples, imu, np.linspace(0, 4, 41), BA, BG)
    joined = composed_covariance(parts)
    use = slice(0, 15 if walks else 9)
    d = np.sqrt(np.diag(joined)[use])
    # six-point quadrature of the walk inside an interval is good to some per cent of the walk's small part
    np.testing.assert_allclose(whole[use, use] / np.outer(d, d), joined[use, use] / np.outer(d, d), atol=5e-3)


def monte_carlo(noise: ImuNoise, runs: int, seconds: float, rate: float) -> tuple[Array, Array]:
    """Whitened errors (runs, 15) of noisy samples' intervals, and the stated covariance."""
    rng = np.random.default_rng(5)
    clean = random_imu(rng, seconds, rate, noise)
    t, n, dt = np.array([0.0, seconds]), len(clean.t), 1.0 / rate
    exact = preintegrate(bridge_gaps(clean), clean, t, np.zeros(3), np.zeros(3))
    out = np.empty((runs, 15))
    for r in range(runs):
        step = np.sqrt(dt) * rng.standard_normal((2, n, 3))
        bg, ba = noise.gyro_bias_walk * np.cumsum(step[0], axis=0), noise.accel_bias_walk * np.cumsum(step[1], axis=0)
        white = rng.standard_normal((2, n, 3)) / np.sqrt(dt)
        # the recording is truth + bias + white noise: what it integrates to, less the truth, with the sign turned,
        # is the error of the end state that the interval predicts
        imu = Imu(
            clean.t,
            clean.gyro + bg + noise.gyro_noise_density * white[0],
            clean.accel + ba + noise.accel_noise_density * white[1],
            noise,
        )
        one = preintegrate(bridge_gaps(imu), imu, t, np.zeros(3), np.zeros(3))
        out[r] = np.concatenate(
            [ro.log(one.dR[0].T @ exact.dR[0]), (exact.dP - one.dP)[0], (exact.dV - one.dV)[0], ba[-1], bg[-1]]
        )
    return out, exact.covariance[0]


@pytest.mark.parametrize("walks", [False, True])
def test_covariance_by_monte_carlo(walks: bool) -> None:
    """With walks of a size that shows, so that the signs of the cross-covariances with the biases are tested too."""
    noise = ImuNoise(1e-3, 1e-2, 1e-3 if walks else 0.0, 2e-2 if walks else 0.0)
    runs = 1500
    samples, stated = monte_carlo(noise, runs, 1.0, 50.0)
    use = slice(0, 15 if walks else 9)
    samples, stated = samples[:, use], stated[use, use]
    white = samples @ np.linalg.inv(np.linalg.cholesky(stated)).T
    values = np.linalg.eigvalsh(white.T @ white / runs)
    # Marchenko and Pastur (1967): (1 +- sqrt(k/n))^2 holds the eigenvalues of a right covariance; 3 % for the edge
    # and for the end of the walk's sums
    ratio = np.sqrt(len(values) / runs)
    assert values.min() > (1 - ratio) ** 2 * 0.97
    assert values.max() < (1 + ratio) ** 2 * 1.03


def test_intervals_of_very_different_lengths_as_one_by_one(imu: Imu, samples: Samples) -> None:
    t = np.concatenate([[0.0, 1e-4, 2e-4, 0.0101, 0.3], np.linspace(0.4, 1.0, 50), [5.9, 5.95, 6.0]])
    together = preintegrate(samples, imu, t, BA, BG)
    assert np.all(np.diff(together.t0) > 0)
    for k in range(len(t) - 1):
        alone = preintegrate(samples, imu, t[k : k + 2], BA, BG)
        for name in FIELDS:
            np.testing.assert_allclose(
                getattr(together, name)[k], getattr(alone, name)[0], rtol=1e-9, atol=1e-14, err_msg=name
            )


def test_biases_per_interval(imu: Imu, samples: Samples) -> None:
    t = np.array([0.0, 1.0, 2.5, 6.0])
    ba, bg = 0.1 * np.random.default_rng(8).standard_normal((2, 3, 3))
    together = preintegrate(samples, imu, t, ba, bg)
    for k in range(3):
        alone = preintegrate(samples, imu, t[k : k + 2], ba[k], bg[k])
        for name in FIELDS:
            np.testing.assert_allclose(getattr(together, name)[k], getattr(alone, name)[0], rtol=1e-9, atol=1e-14)


def test_prefix_is_preintegrate(samples: Samples, imu: Imu) -> None:
    t = np.array([1.0, 1.013, 2.0, 4.4444, 6.0])
    dR, dV, dP = integrate_prefix(samples, 0.997, t, BA, BG)
    for k in range(len(t)):
        alone = preintegrate(samples, imu, np.array([0.997, t[k]]), BA, BG)
        np.testing.assert_allclose(dR[k], alone.dR[0], atol=1e-12)
        np.testing.assert_allclose(dV[k], alone.dV[0], atol=1e-11)
        np.testing.assert_allclose(dP[k], alone.dP[0], atol=1e-11)


def test_covariances_are_symmetric_and_positive_even_when_tiny(samples: Samples, imu: Imu) -> None:
    iv = preintegrate(samples, imu, np.array([0.0, 1e-5, 2e-3, 0.01, 0.5, 6.0]), BA, BG)
    d = np.sqrt(np.diagonal(iv.covariance, axis1=1, axis2=2))
    correlation = iv.covariance / (d[:, :, None] * d[:, None, :])
    np.testing.assert_allclose(correlation, np.swapaxes(correlation, -1, -2), atol=1e-12)
    np.linalg.cholesky(iv.covariance)  # raises when it is not


def gap_in(imu: Imu, start: float, end: float) -> Imu:
    keep = (imu.t <= start + 1e-9) | (imu.t > end + 1e-9)
    return Imu(imu.t[keep], imu.gyro[keep], imu.accel[keep], imu.noise)


def test_a_gap_gets_rows_at_the_sensors_rate() -> None:
    imu = random_imu(np.random.default_rng(9), 10.0, 100.0)
    cut = gap_in(imu, 4.0, 4.5)
    bridged = bridge_gaps(cut)
    np.testing.assert_allclose(bridged.bridged, [[4.0, 4.5]], atol=1e-9)
    np.testing.assert_allclose(bridged.t, imu.t, atol=1e-9)  # the row behind it still speaks for its own period
    there = np.isin(imu.t, cut.t)
    for name in ("gyro", "accel"):
        np.testing.assert_array_equal(getattr(bridged, name)[there], getattr(cut, name))
        np.testing.assert_array_equal((getattr(bridged, f"extra_{name}") > 0.0).all(axis=1), ~there)


def test_of_gaps_only_those_behind_the_beginning_are_filled_each_time() -> None:
    cut = gap_in(gap_in(random_imu(np.random.default_rng(9), 10.0, 100.0), 2.0, 2.5), 6.0, 6.5)
    for begin, first in ((-np.inf, 0), (4.0, 1), (-np.inf, 0), (8.0, 2)):
        bridged = bridge_gaps(cut, begin).bridged
        np.testing.assert_allclose(bridged, [[2.0, 2.5], [6.0, 6.5]][first:] or np.empty((0, 2)), atol=1e-9)


def test_an_axis_that_never_changes_goes_on_as_it_is() -> None:
    imu = random_imu(np.random.default_rng(9), 10.0, 100.0)
    imu.gyro[:, 1], imu.accel[:, 2] = 0.25, 9.8
    bridged = bridge_gaps(gap_in(imu, 4.0, 4.5))
    np.testing.assert_allclose(bridged.gyro[:, 1], 0.25)
    np.testing.assert_allclose(bridged.accel[:, 2], 9.8)
    assert np.isfinite(bridged.extra_gyro).all()
    assert bridged.extra_gyro[:, 1].max() < 1e-12 * bridged.extra_gyro[:, 0].max()


def test_a_gap_in_a_short_log_gets_the_mean_of_its_neighbours() -> None:
    imu = random_imu(np.random.default_rng(9), 1.0, 100.0)
    bridged = bridge_gaps(gap_in(imu, 0.4, 0.7))
    before, after = np.searchsorted(imu.t, [0.4 - 1e-6, 0.71 - 1e-6])
    for name in ("gyro", "accel"):
        x = getattr(imu, name)
        np.testing.assert_allclose(
            getattr(bridged, name)[before + 1 : after], np.tile((x[before] + x[after]) / 2, (30, 1))
        )
        assert (getattr(bridged, f"extra_{name}")[before + 1 : after] > 0.0).all()


def test_a_gap_in_a_step_is_filled_as_the_other_steps_are() -> None:
    """A minute of steps that rest and swing, each a little different, with fifty gaps of 0.15 s."""
    rng = np.random.default_rng(11)
    t = np.arange(1, 6001) / 100.0
    phase = t + np.interp(t, np.arange(62), 0.03 * rng.standard_normal(62))
    size = np.interp(t, np.arange(62), 1.0 + 0.05 * rng.standard_normal(62))[:, None]
    swing = np.maximum(np.sin(2.0 * np.pi * phase), 0.0)[:, None] ** 2 * np.sin(6.0 * np.pi * phase)[:, None] * size
    gyro = swing * [1.0, 6.0, 2.0] + 0.005 * rng.standard_normal((6000, 3))
    accel = swing * [10.0, 4.0, 20.0] + [0.0, 0.0, 9.8] + 0.02 * rng.standard_normal((6000, 3))
    first = 300 + 105 * np.arange(50) + rng.integers(0, 30, 50)
    lost = np.zeros(6000, dtype=bool)
    lost[first[:, None] + np.arange(15)] = True
    bridged = bridge_gaps(Imu(t[~lost], gyro[~lost], accel[~lost]))
    for name, x in (("gyro", gyro), ("accel", accel)):
        there = x[first[:, None] + np.arange(15)]
        error = (getattr(bridged, name)[first[:, None] + np.arange(15)] - there).mean(axis=1)
        of_ends = 0.5 * (x[first - 1] + x[first + 15]) - there.mean(axis=1)
        assert np.sqrt((error**2).mean()) < 0.25 * np.sqrt((of_ends**2).mean())
        z = error / np.sqrt(getattr(bridged, f"extra_{name}")[first] / 0.15)
        assert 0.4 < (z**2).mean() < 2.0  # fifty gaps, each of one common cause: 3 sigmas
        resting = np.abs(swing[first[:, None] + np.arange(-4, 19)]).max(axis=(1, 2)) < 0.01
        sigma = np.sqrt(getattr(bridged, f"extra_{name}")[first, 1])
        assert 0 < resting.sum() < 50
        assert np.median(sigma[resting]) < 0.3 * np.median(sigma[~resting])


def test_the_sigma_of_a_bridge_is_that_of_its_error() -> None:
    """Two hundred gaps in a turn rate and a force that change within seconds, and more in the second half."""
    rng = np.random.default_rng(10)
    imu = random_imu(rng, 800.0, 50.0)
    larger = np.where(imu.t < 400.0, 1.0, 5.0)[:, None] * [1.0, 2.0, 4.0]
    smooth = [lfilter([0.02], [1.0, -0.98], x, axis=0) * larger for x in (imu.gyro, imu.accel - [0.5, -0.3, 9.8])]
    imu = replace(imu, gyro=smooth[0], accel=smooth[1])
    lost = np.mod(imu.t, 4.0) > 3.2
    bridged = bridge_gaps(Imu(imu.t[~lost], imu.gyro[~lost], imu.accel[~lost]))
    rows = np.searchsorted(bridged.t, bridged.bridged[:, 1] - 1e-9)
    length = np.diff(bridged.bridged, axis=1)
    first = np.flatnonzero(np.diff(lost.astype(int)) == 1)[: len(rows)] + 1
    for name in ("gyro", "accel"):
        true = np.stack([getattr(imu, name)[k : k + round(length[0, 0] * 50)].mean(axis=0) for k in first])
        filled = np.stack([getattr(bridged, name)[k : k + round(length[0, 0] * 50)].mean(axis=0) for k in first])
        error = (true - filled) * length
        variance = getattr(bridged, f"extra_{name}")[rows] * length
        for half in (slice(0, 100), slice(100, 200)):
            for axis in range(3):
                ratio = np.sum(error[half, axis] ** 2) / np.sum(variance[half, axis])
                assert 0.4 < ratio < 1.7  # a hundred errors, variances of ten places each, both halves tried as one


def test_noise_along_one_axis_turns_with_the_body() -> None:
    """Against differences: every sample moved along every axis of the body by its own sigma."""
    imu = random_imu(np.random.default_rng(11), 0.5, 100.0)
    t, none = np.array([0.0, 0.5]), np.zeros((50, 3))
    along = np.linspace(1.0, 2.0, 50)[:, None] * [0.1, 0.0, 0.4]
    plain = bridge_gaps(imu)
    quiet = preintegrate(plain, imu, t, BA, BG)
    for name, of_gyro, of_accel in (("gyro", along, none), ("accel", none, along)):
        noisy = preintegrate(replace(plain, extra_gyro=of_gyro, extra_accel=of_accel), imu, t, BA, BG)
        expected = np.zeros((9, 9))
        for k in range(50):
            for axis in (0, 2):
                moved = getattr(imu, name).copy()
                moved[k, axis] += 1e-4
                other = preintegrate(replace(plain, **{name: moved}), imu, t, BA, BG)
                effect = [ro.log(quiet.dR[0].T @ other.dR[0]), (other.dP - quiet.dP)[0], (other.dV - quiet.dV)[0]]
                effect = np.concatenate(effect) / 1e-4
                expected += np.outer(effect, effect) * along[k, axis] / 0.01
        d = np.sqrt(np.diagonal(expected))
        added = (noisy.covariance - quiet.covariance)[0, :9, :9]
        for block in (slice(0, 3), slice(3, 9)) if name == "gyro" else (slice(3, 9),):
            difference_ = (added - expected)[:, block][block] / np.outer(d[block], d[block])
            np.testing.assert_allclose(difference_, 0.0, atol=0.03)  # the trapezoidal rule


def test_uncertainty_grows_across_a_gap_and_only_there() -> None:
    imu = random_imu(np.random.default_rng(9), 10.0, 100.0)
    t = np.arange(0.0, 11.0)
    whole = preintegrate(bridge_gaps(imu), imu, t, BA, BG)
    cut = gap_in(imu, 4.2, 4.7)
    bridged = preintegrate(bridge_gaps(cut), cut, t, BA, BG)
    sd = [np.sqrt(np.diagonal(iv.covariance, axis1=1, axis2=2)[:, :9]) for iv in (whole, bridged)]
    others = np.arange(10) != 4
    np.testing.assert_allclose(sd[1][others], sd[0][others], rtol=1e-9)
    assert np.all(sd[1][4] > 100.0 * sd[0][4])
    # and it covers what is really lost
    lost = np.concatenate(
        [ro.log(bridged.dR[4].T @ whole.dR[4]), (whole.dP - bridged.dP)[4], (whole.dV - bridged.dV)[4]]
    )
    assert np.all(np.abs(lost) < 3.0 * sd[1][4])


def test_without_a_gap_nothing_is_made_up(imu: Imu, samples: Samples) -> None:
    assert len(samples.bridged) == 0
    assert samples.t is imu.t
    assert samples.start == pytest.approx(0.0, abs=1e-12)
    assert not samples.extra_gyro.any()
    assert not samples.extra_accel.any()


def test_what_is_known_is_not_integrated_again(samples: Samples, imu: Imu) -> None:
    """Intervals known already are taken as they are; the rest is as if all had been integrated."""
    whole = preintegrate(samples, imu, TIMES, BA, BG)
    marked = replace(whole[2:3], dP=whole.dP[2:3] + 1.0)
    known = {float(TIMES[3]): marked, float(TIMES[5]): whole[3:4]}  # the second began elsewhere: not this interval
    found = preintegrate_unknown(samples, imu, TIMES, BA, BG, known)
    for name in Intervals.__dataclass_fields__:
        expected = getattr(whole, name).copy()
        if name == "dP":
            expected[2] += 1.0
        np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-9, atol=1e-14, err_msg=name)


def test_a_few_intervals_are_integrated_as_many_are() -> None:
    """Running products over runs of pieces side by side, and one after the other."""
    imu = random_imu(np.random.default_rng(5), 30.0, 200.0)
    samples = bridge_gaps(imu)
    t = np.linspace(0.0, 30.0, 31)
    many = preintegrate(samples, imu, t, BA, BG)
    for k in (0, 17, 29):
        one = preintegrate(samples, imu, t[k : k + 2], BA, BG)
        for name in Intervals.__dataclass_fields__:
            np.testing.assert_allclose(getattr(one, name)[0], getattr(many, name)[k], rtol=1e-9, atol=1e-13)
