"""What the rows of a foot's IMU stand for: heel strikes, coning and sculling, peaks that were cut off."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from graphnav.config import Settings, parse_settings
from graphnav.core import rotation as ro
from graphnav.core.notes import get_key
from graphnav.core.rotation import Array
from graphnav.detectors import detect
from graphnav.estimation.noise.imu_floor import apply_measured_floor
from graphnav.imu.clipping import find_cut_peaks, restore_peaks
from graphnav.imu.onboard_offset import compare_offsets, estimate_learnt_offset, remove_onboard_offset
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import Samples, bridge_gaps
from graphnav.imu.unresolved import add_coning, add_unresolved_motion
from graphnav.recording import Imu, ImuNoise
from graphnav.recording.densities import bound_density
from graphnav.recording.formats import read
from graphnav.simulation import Simulated, simulate


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
    out = add_unresolved_motion(samples, quiet)
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
    out = add_unresolved_motion(Samples(t, gyro, accel, zero, zero, 0.0, np.empty((0, 2))), noise)
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
        found.append(bound_density(t, x) / 1e-3)
    assert np.mean(np.array(found) < 1.0) <= 0.05  # the least of some ten stretches of which each is below in 0.1 %
    assert max(found) < 1.7


def test_what_is_too_short_for_a_bound_has_none() -> None:
    t = 0.005 * np.arange(1, 101)
    assert bound_density(t, np.zeros((100, 3))) == np.inf
    assert bound_density(t[:1], np.zeros((1, 3))) == np.inf


def test_figures_stated_too_large_are_lowered_for_a_walk_and_for_nothing_else() -> None:
    walk = made("normal").recording
    true = walk.imu.noise
    same, said = apply_measured_floor(walk, Settings())
    assert said == ()
    assert same.imu.noise == true
    tenfold = replace(true, gyro_noise_density=10.0 * true.gyro_noise_density)
    stated = replace(walk, imu=replace(walk.imu, noise=tenfold))
    found, (sentence,) = apply_measured_floor(stated, Settings())
    assert true.gyro_noise_density < found.imu.noise.gyro_noise_density < 2.0 * true.gyro_noise_density
    assert found.imu.noise.accel_noise_density == true.accel_noise_density
    assert (get_key(sentence), "gyro" in sentence) == ("noise.imu.quieter", True)
    assert apply_measured_floor(stated, parse_settings({"noise": {"mode": "stated"}})) == (stated, ())
    drive = replace(stated, platform="vehicle")
    assert apply_measured_floor(drive, Settings()) == (drive, ())


# ------------------------------------------------------------------------- offsets that the unit has taken off itself
def swaying(seed: int, bias: float) -> tuple[Array, Array, Array]:
    """Times, rates (N, 3), forces (N, 3): 12 s of a body that sways about its balance, two strides, the same again."""
    rng = np.random.default_rng(seed)
    T, n = 0.005, 12 * 200
    t = T * np.arange(1, 2 * n + 401)
    z = rng.standard_normal((len(t), 3))
    angle = lfilter([1e-3 * np.sqrt(2.0 * T / 0.7)], [1.0, T / 0.7 - 1.0], z, axis=0)
    angle = lfilter(np.full(60, 1.0 / 60.0), [1.0], angle, axis=0)
    rate = np.gradient(angle, T, axis=0) + bias * rng.standard_normal(3) + 2e-3 * rng.standard_normal(angle.shape)
    rate[n : n + 400, 1] += 3.0 * np.sin(0.05 * np.arange(400))
    up = np.array([0.0, 0.0, 9.81])
    return t, rate, up - np.cross(angle, up) + 0.03 * rng.standard_normal(angle.shape)


def corrected(t: Array, rate: Array) -> tuple[Array, Array]:
    """What a unit passes on that takes off its gyro's offset (rows, offsets), row by row as its program does."""
    out, taken, offset, rested = np.empty_like(rate), np.empty_like(rate), np.zeros(3), 5.0
    for i, raw in enumerate(rate):
        out[i] = raw - offset
        if np.abs(out[i]).max() > np.deg2rad(3.0):
            rested = 0.0
        elif rested < 5.0:
            rested += t[1] - t[0]
        else:
            offset = offset + 2.0 * np.pi * 0.02 * (t[1] - t[0]) * out[i]
        taken[i] = offset
    return out, taken


@pytest.mark.parametrize("seed", range(3))
def test_an_offset_that_the_unit_took_off_is_found_again(seed: int) -> None:
    t, rate, force = swaying(seed, 5e-3)
    rows, taken = corrected(t, rate)
    away = estimate_learnt_offset(Imu(t, rows, force)) - taken
    near = 2.0 * np.abs(np.diff(taken, axis=0)).max()  # to the row after which five seconds count as over
    assert np.abs(away).max() < near < 0.05 * np.abs(taken).max()


def test_whether_the_unit_corrects_its_offset_is_told_from_rests() -> None:
    """Never believed of one that does not, of biases as large as the sway and ten times; else told when it matters."""
    chance = 2.0 * np.log(100.0)
    plain, served = [], []
    for seed in range(10):
        for bias in (1e-3, 1e-2):
            t, rate, force = swaying(seed, bias)
            own, of_unit = Imu(t, rate, force), Imu(t, corrected(t, rate)[0], force)
            plain.append(compare_offsets(own, estimate_learnt_offset(own)))
            served.append(compare_offsets(of_unit, estimate_learnt_offset(of_unit)))
    assert max(plain) < chance
    assert min(served[1::2]) > chance


@pytest.mark.parametrize("name", ["xio_loops/long", "xio_loops/short"])
def test_a_unit_that_corrects_its_offset_is_found_out(shared_data: Path, name: str) -> None:
    """Both walks of one unit: the angle of the rests, less the tilt, is a line again; its own figure is 0.02 Hz."""
    walk = read(shared_data / f"{name}.toml")
    undone, (said,) = remove_onboard_offset(walk, Settings())
    assert get_key(said) == "imu.onboard_offset"
    offset = estimate_learnt_offset(walk.imu)
    np.testing.assert_array_equal(undone.imu.gyro, walk.imu.gyro + offset)
    by_rate = [compare_offsets(walk.imu, share * offset) for share in (0.25, 0.5, 1.0, 2.0, 4.0)]
    assert np.argmax(by_rate) in {1, 2}
    assert remove_onboard_offset(walk, parse_settings({"imu": {"onboard_offset": False}})) == (walk, ())
    assert remove_onboard_offset(replace(walk, platform="vehicle"), Settings())[1] == ()


def test_units_that_leave_their_offset_alone_are_left_alone(shared_data: Path) -> None:
    for path in sorted((shared_data / "gcp_walks").glob("*.toml")):
        walk = read(path)
        assert remove_onboard_offset(walk, Settings()) == (walk, ())
    parked = read(shared_data / "tokyo_20201105" / "recording.toml").crop(0.0, 600.0)
    assert compare_offsets(parked.imu, estimate_learnt_offset(parked.imu)) < -30.0


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
            "made up": add_coning(bridge_gaps(plain.imu)),
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
            assert not find_cut_peaks(imu.t, x[:, axis], least)
    samples = bridge_gaps(imu)
    assert restore_peaks(samples, np.eye(3)) == (samples, ())


def test_cut_peaks_are_put_back_and_doubted() -> None:
    """A gyro that ends at 85 % of the fastest swing, in axes turned against the body's: half the lost turn at least."""
    imu = made("normal", exact=True).recording.imu
    R_bs = ro.from_rph(np.array([0.3, -0.2, 0.5]))
    true = imu.gyro @ R_bs
    limit = 0.85 * np.abs(true[:, 0]).max()
    read_ = np.clip(true, -limit, limit)
    whole = bridge_gaps(replace(imu, gyro=true @ R_bs.T))
    cut = bridge_gaps(replace(imu, gyro=read_ @ R_bs.T))
    mended, notes = restore_peaks(cut, R_bs)
    lost, left = (np.sum(whole.gyro - x.gyro, axis=0) @ R_bs for x in (cut, mended))
    assert abs(lost[0]) > 1.0
    assert abs(left[0]) < 0.5 * abs(lost[0])
    doubted = mended.extra_gyro.any(axis=1)
    assert np.all(np.any(np.abs(read_[doubted]) > 0.97 * limit, axis=1))
    assert "imu.clipped" in map(get_key, notes)


def test_a_range_that_ends_softly_is_found_in_every_swing() -> None:
    """A gyro that gives way from 97 % of its range on: where one peak shows that, the others are looked at for it."""
    imu = made("normal", exact=True).recording.imu
    true, size = imu.gyro, np.abs(imu.gyro)
    limit = 0.78 * size[:, 0].max()
    bent = limit * (0.97 - 0.03 * np.expm1(-(size / limit - 0.97) / 0.05))
    read_ = np.where(size > 0.97 * limit, np.sign(true) * bent, true)
    mended, _ = restore_peaks(bridge_gaps(replace(imu, gyro=read_)), np.eye(3))
    cut = size[:, 0] > 1.05 * limit
    stride = np.cumsum(np.diff(cut.astype(int), prepend=0) > 0)[cut] - 1
    assert stride[-1] > 20
    lost, left = (np.bincount(stride, np.abs(true - x)[cut, 0]) for x in (read_, mended.gyro))
    assert np.median(left / lost) < 0.2  # of how much each peak lost
