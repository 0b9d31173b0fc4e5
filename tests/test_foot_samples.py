"""What the rows of a foot's IMU stand for: heel strikes, coning and sculling, peaks that were cut off."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from graphnav import rotation as ro
from graphnav.clipping import cut_peaks, with_whole_peaks
from graphnav.config import Settings, settings_from
from graphnav.detectors import detect
from graphnav.own_noise import quietest_density, with_own_noise
from graphnav.preintegration import preintegrate
from graphnav.recording import ImuNoise
from graphnav.samples import Samples, bridge_gaps
from graphnav.simulation import Simulated, simulate
from graphnav.unresolved import with_coning, with_unresolved_motion


@lru_cache(maxsize=8)
def made(pace: str, exact: bool = False) -> Simulated:
    return simulate("gait", 1, pace=pace, exact=exact)


# -------------------------------------------------------------------------------------------------------- heel strikes
def test_noise_of_what_happens_within_a_period() -> None:
    """A ramp of D in each period has the variance D^2 / 12 in it, of which a quarter is taken; without change, none."""
    t = 0.01 * np.arange(1, 101)
    ramp = np.zeros((100, 3))
    ramp[50:] = 0.6 * np.arange(50)[:, None]
    zero = np.zeros(100)
    samples = Samples(t, ramp, 2.0 * ramp, zero, zero, 0.0, np.empty((0, 2)))
    quiet = ImuNoise(gyro_noise_density=1e-9, accel_noise_density=1e-9)
    out = with_unresolved_motion(samples, quiet)
    np.testing.assert_allclose(out.extra_gyro[60:90], 0.6**2 / 48.0 * 0.01, rtol=1e-9)
    np.testing.assert_allclose(out.extra_accel[60:90], 1.2**2 / 48.0 * 0.01, rtol=1e-9)
    assert np.all(out.extra_gyro[:49] == 0.0)


def test_the_sensors_own_noise_is_not_counted_twice() -> None:
    """Of white noise as stated, less is added than the sensor's own density has already."""
    rng = np.random.default_rng(0)
    noise = ImuNoise(gyro_noise_density=1e-3, accel_noise_density=2e-3)
    t = 0.005 * np.arange(1, 4001)
    gyro, accel = (s / np.sqrt(0.005) * rng.standard_normal((4000, 3)) for s in (1e-3, 2e-3))
    zero = np.zeros(4000)
    out = with_unresolved_motion(Samples(t, gyro, accel, zero, zero, 0.0, np.empty((0, 2))), noise)
    assert out.extra_gyro.mean() < 0.1 * 1e-3**2
    assert out.extra_accel.mean() < 0.1 * 2e-3**2


# --------------------------------------------------------------------------------------------------- noise of its own
def test_a_bound_on_white_noise_from_the_quietest_stretch() -> None:
    """Not below the true figure but by chance, nor far above it; and what sways slowly under it does not count."""
    found = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        t = 0.005 * np.arange(1, 4001)
        x = 1e-3 / np.sqrt(0.005) * rng.standard_normal((4000, 3)) + 0.02 * np.sin(0.5 * t)[:, None]
        x[2000:] += rng.standard_normal((2000, 3))  # and then it walks
        found.append(quietest_density(t, x) / 1e-3)
    assert np.mean(np.array(found) < 1.0) <= 0.05  # the least of some ten stretches of which each is below in 0.1 %
    assert max(found) < 1.7


def test_what_is_too_short_for_a_bound_has_none() -> None:
    t = 0.005 * np.arange(1, 101)
    assert quietest_density(t, np.zeros((100, 3))) == np.inf
    assert quietest_density(t[:1], np.zeros((1, 3))) == np.inf


def test_figures_stated_too_large_are_lowered_for_a_walk_and_for_nothing_else() -> None:
    walk = made("normal").recording
    true = walk.imu.noise
    same, said = with_own_noise(walk, Settings())
    assert said == ()
    assert same.imu.noise == true
    tenfold = replace(true, gyro_noise_density=10.0 * true.gyro_noise_density)
    stated = replace(walk, imu=replace(walk.imu, noise=tenfold))
    found, (sentence,) = with_own_noise(stated, Settings())
    assert true.gyro_noise_density < found.imu.noise.gyro_noise_density < 2.0 * true.gyro_noise_density
    assert found.imu.noise.accel_noise_density == true.accel_noise_density
    assert "gyro" in sentence
    assert with_own_noise(stated, settings_from({"imu": {"as_stated": True}})) == (stated, ())
    drive = replace(stated, platform="vehicle")
    assert with_own_noise(drive, Settings()) == (drive, ())


# ------------------------------------------------------------------------------------------------ what rows stand for
@pytest.mark.parametrize("rate", [100.0, 200.0])
def test_coning_and_sculling_are_made_up_for(rate: float) -> None:
    """Plain means over a walk against a unit that integrates inside: attitude, velocity and place of each swing."""
    plain, whole = (
        simulate("ren2021", 0, walk=1, exact=True, rate=rate, compensated=c).recording for c in (False, True)
    )
    t = np.append(plain.start, detect(plain).stationary.mean(axis=1))
    of = {
        name: preintegrate(samples, plain.imu, t, np.zeros(3), np.zeros(3))
        for name, samples in {
            "true": bridge_gaps(whole.imu),
            "means": bridge_gaps(plain.imu),
            "made up": with_coning(bridge_gaps(plain.imu)),
        }.items()
    }
    left = {
        name: [
            np.linalg.norm(ro.log(np.swapaxes(of["true"].dR, -1, -2) @ iv.dR).sum(axis=0)),
            np.sqrt(np.mean((iv.dV - of["true"].dV) ** 2)),
            np.sqrt(np.mean((iv.dP - of["true"].dP) ** 2)),
        ]
        for name, iv in of.items()
    }
    assert left["means"][0] > 3e-4
    assert left["made up"][0] < 0.03 * left["means"][0]
    assert left["made up"][1] < 0.3 * left["means"][1]
    assert left["made up"][2] < 0.4 * left["means"][2]


@pytest.mark.parametrize("pace", ["slow", "normal", "fast"])
def test_whole_peaks_stay_as_they_are(pace: str) -> None:
    imu = made(pace).recording.imu
    for x, least in ((imu.gyro, 4.0), (imu.accel, 19.0)):
        for axis in range(3):
            assert not cut_peaks(imu.t, x[:, axis], least)
    samples = bridge_gaps(imu)
    assert with_whole_peaks(samples, np.eye(3)) == (samples, ())


def test_cut_peaks_are_put_back_and_doubted() -> None:
    """A gyro that ends at 85 % of the fastest swing, in axes turned against the body's: half the lost turn at least."""
    imu = made("normal", exact=True).recording.imu
    R_bs = ro.from_rph(np.array([0.3, -0.2, 0.5]))
    true = imu.gyro @ R_bs
    limit = 0.85 * np.abs(true[:, 0]).max()
    read_ = np.clip(true, -limit, limit)
    whole = bridge_gaps(replace(imu, gyro=true @ R_bs.T))
    cut = bridge_gaps(replace(imu, gyro=read_ @ R_bs.T))
    mended, notes = with_whole_peaks(cut, R_bs)
    lost, left = (np.sum(whole.gyro - x.gyro, axis=0) @ R_bs for x in (cut, mended))
    assert abs(lost[0]) > 1.0
    assert abs(left[0]) < 0.5 * abs(lost[0])
    doubted = mended.extra_gyro > 0.0
    assert np.all(np.any(np.abs(read_[doubted]) > 0.97 * limit, axis=1))
    assert any("gyro x" in note for note in notes)


def test_a_range_that_ends_softly_is_found_in_every_swing() -> None:
    """A gyro that gives way from 97 % of its range on: where one peak shows that, the others are looked at for it."""
    imu = made("normal", exact=True).recording.imu
    true, size = imu.gyro, np.abs(imu.gyro)
    limit = 0.78 * size[:, 0].max()
    bent = limit * (0.97 - 0.03 * np.expm1(-(size / limit - 0.97) / 0.05))
    read_ = np.where(size > 0.97 * limit, np.sign(true) * bent, true)
    mended, _ = with_whole_peaks(bridge_gaps(replace(imu, gyro=read_)), np.eye(3))
    cut = size[:, 0] > 1.05 * limit
    stride = np.cumsum(np.diff(cut.astype(int), prepend=0) > 0)[cut] - 1
    assert stride[-1] > 20
    lost, left = (np.bincount(stride, np.abs(true - x)[cut, 0]) for x in (read_, mended.gyro))
    assert np.median(left / lost) < 0.2  # of how much each peak lost
