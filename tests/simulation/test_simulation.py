"""Simulated drives: exact by two other programs' mechanisations and by closed forms, errors of the stated sizes."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import oracle_path
import pandas as pd
import pytest
from helpers import Array, refused, truth_states
from pyins import sim, strapdown, transform, util

from graphnav.app.cli import run as command
from graphnav.core import rotation as ro
from graphnav.core.earth import EARTH_RATE, MG, LocalFrame, gravity, llh_to_ecef
from graphnav.core.errors import ConfigError
from graphnav.core.state import States
from graphnav.imu.dynamics import ImuFactors as Mechanisation
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Imu, Odometer
from graphnav.recording.checks.overview import inspect
from graphnav.recording.formats import read
from graphnav.recording.formats.writing import write_folder
from graphnav.simulation import Simulated, list_scenarios, parse_options, simulate
from graphnav.simulation.aiding import GnssModel, OdometerModel, SimulatedFault
from graphnav.simulation.inertial import EG370N, MIMU, Triad, make_accelerometer, make_gyroscope
from graphnav.simulation.kinematics import Mount, TrueMotion, move_vehicle
from graphnav.simulation.motion import HEADING, SLIP, SPEED, Manoeuvre, make_path
from graphnav.simulation.passengers import Boarding, simulate_movement
from graphnav.simulation.scenarios.li2024 import TABLE_4
from graphnav.simulation.vibration import Shake, simulate_road_noise

pytestmark = pytest.mark.filterwarnings("ignore:The copy keyword")  # of pandas, about pyins

DEG = np.pi / 180.0
ORIGIN = (30.5, 114.3, 20.0)
WAY = [
    Manoeuvre(10.0, 0.0), Manoeuvre(8.0, 12.0, 0.0, 0.04), Manoeuvre(12.0, 12.0, 100.0, -0.03, 2.0),
    Manoeuvre(10.0, 15.0, -60.0), Manoeuvre(6.0, 0.0), Manoeuvre(8.0, 0.0), Manoeuvre(3.0, -1.5),
    Manoeuvre(8.0, -1.5, 40.0), Manoeuvre(2.0, 0.0), Manoeuvre(5.0, 0.0),
]  # fmt: skip
ASKEW = Mount(above_axle=(0.3, 1.2, 0.8), angles=(1.0, -2.0, 3.0))
SHORT = {
    "li2024": {"short": True, "odometer": True}, "zhu2020": {}, "urban": {"duration": 300.0},
    "electric": {"duration": 260.0, "barometer": True, "antennas": True},
    "motorway": {"duration": 300.0}, "crawl": {"jam": 120.0}, "ushaq": {"stops_every": 20.0, "rate": 20.0},
}  # fmt: skip


@lru_cache(maxsize=16)
def made(name: str, seed: int = 0, **options: float) -> Simulated:
    return simulate(name, seed, **{**SHORT[name], **options})


@lru_cache(maxsize=4)
def smooth(lat: float = 30.5, rate: float = 200.0, slip: float = 0.0) -> TrueMotion:
    """A drive with nothing that shakes."""
    path = make_path(WAY, heading=62.0, slip_per_accel=slip)
    return move_vehicle(path, (lat, *ORIGIN[1:]), ASKEW, Shake(), rate)


# ------------------------------------------------------------------------------------------------------- exactness
@pytest.mark.parametrize(("name", "seconds", "attitude_deg"), [("li2024", 600, 5e-6), ("urban", 300, 3e-5)])
def test_free_inertial_by_graphnav(name: str, seconds: int, attitude_deg: float) -> None:
    """Engine, road, springs, passengers and all: from the exact first state the exact samples lead to the truth.

    Samples of 100 Hz say less of what an engine does near 50 Hz (coning within a sample) than those of 200 Hz.
    """
    made_here = made(name, exact=True)
    motion = made_here.motion
    assert motion is not None
    imu = Imu(motion.t[1:], motion.gyro, motion.accel, made_here.recording.imu.noise)
    recording = replace(made_here.recording, imu=imu)
    t = motion.t[0] + np.arange(seconds + 1.0)
    frame, zero = LocalFrame(motion.llh[0]), np.zeros(3)
    mechanisation = Mechanisation(preintegrate(bridge_gaps(imu), recording.imu, t, zero, zero), frame)
    chain = [truth_states(made_here.truth, t[:1], frame)]
    for k in range(seconds):
        chain.append(mechanisation.propagate(slice(k, k + 1), chain[-1])[0])
    end, true = States.stack(chain), truth_states(made_here.truth, t, frame)
    assert np.abs(true.p).max() > 500.0
    assert np.abs(end.p - true.p).max() < 0.03
    assert np.abs(ro.log(np.swapaxes(true.R_nb, -1, -2) @ end.R_nb)).max() < attitude_deg * DEG


def pyins_readings(motion: TrueMotion) -> pd.DataFrame:
    readings = np.hstack([oracle_path.swap(motion.gyro), oracle_path.swap(motion.accel)]) / 200.0
    return pd.DataFrame(np.vstack([readings[:1], readings]), index=motion.t, columns=util.GYRO_COLS + util.ACCEL_COLS)


@pytest.mark.parametrize("lat", [30.5, -45.0, 70.0])
def test_free_inertial_by_pyins(lat: float) -> None:
    motion = smooth(lat)
    truth = np.hstack([oracle_path.degrees(motion.llh), oracle_path.swap(motion.v), np.rad2deg(motion.rph)])
    start = pd.Series(truth[0], index=util.TRAJECTORY_COLS, name=motion.t[0])
    increments = strapdown.compute_increments_from_imu(pyins_readings(motion), "increment")
    result = strapdown.Integrator(start).integrate(increments).to_numpy()
    assert np.abs(transform.compute_lla_difference(result[:, :3], truth[:, :3])).max() < 2e-3
    assert np.abs(result[:, 3:6] - truth[:, 3:6]).max() < 1e-4
    assert np.abs((result[:, 6:9] - truth[:, 6:9] + 180.0) % 360.0 - 180.0).max() < 1e-6


@pytest.mark.parametrize("lat", [30.5, -45.0, 70.0])
def test_samples_are_those_pyins_makes_of_the_same_path(lat: float) -> None:
    """python-ins splines the true places and attitudes and differentiates; here nothing was differentiated."""
    motion = smooth(lat)
    rph = np.unwrap(motion.rph, axis=0)
    truth, imu = sim.generate_imu(
        motion.t, oracle_path.degrees(motion.llh), np.rad2deg(rph), oracle_path.swap(motion.v), "increment"
    )
    theirs = imu.to_numpy()[1:] * 200.0
    inside = slice(400, -400)  # the ends of a spline are free
    assert np.abs(truth.to_numpy()[:, :3] - oracle_path.degrees(motion.llh)).max() < 1e-9
    assert np.abs(oracle_path.swap(theirs[:, :3]) - motion.gyro)[inside].max() < 2e-7
    assert np.abs(oracle_path.swap(theirs[:, 3:]) - motion.accel)[inside].max() < 2e-4
    assert np.abs(np.mean((oracle_path.swap(theirs[:, 3:]) - motion.accel)[inside], axis=0)).max() < 1e-6


def test_rates_are_the_turning_of_the_true_attitude_in_space() -> None:
    motion = made("li2024", exact=True).motion
    assert motion is not None
    frame = LocalFrame(motion.llh[0])
    R_nl = np.swapaxes(frame.R_ln(frame.from_llh(motion.llh)), -1, -2)
    R_in = ro.exp((motion.t - motion.t[0])[:, None] * frame.omega_n)
    R_ib = R_in @ R_nl @ motion.R_lb
    mean = ro.log(np.swapaxes(R_ib[:-1], -1, -2) @ R_ib[1:]) * 200.0
    # the mean of a rate that turns is not quite the rotation: coning, 1e-6 of what is there
    assert np.abs(mean - motion.gyro).max() < 5e-6
    assert np.abs(np.mean(mean - motion.gyro, axis=0)).max() < 1e-9


def test_place_is_the_integral_of_the_velocity() -> None:
    motion = made("li2024", exact=True).motion
    assert motion is not None
    frame = LocalFrame(motion.llh[0])
    p = frame.from_llh(motion.llh)
    v = np.einsum("kji,kj->ki", frame.R_ln(p), motion.v)
    # Euler-Maclaurin: the trapezoids' error is that of the velocity's slopes at both ends, at a standstill none
    moved = np.cumsum(0.5 * (v[1:] + v[:-1]), axis=0) / 200.0
    assert np.abs(moved - (p[1:] - p[0])).max() < 2e-3


def test_standing_it_feels_gravity_and_the_earth() -> None:
    motion = smooth()
    still = slice(200, 1900)
    lat, h = motion.llh[200, 0], motion.llh[200, 2]
    R = motion.R_lb[200]
    np.testing.assert_allclose(motion.accel[still], np.tile(gravity(lat, h) * R[2], (1700, 1)), atol=1e-8)
    earth = EARTH_RATE * R.T @ [0.0, np.cos(lat), np.sin(lat)]
    np.testing.assert_allclose(motion.gyro[still], np.tile(earth, (1700, 1)), atol=1e-12)
    # mounted with roll 1, pitch -2 and heading 3 deg on a level vehicle facing 62 deg; the level of the IMU, a lever
    # arm from the axle, differs from the axle's by 2e-7
    np.testing.assert_allclose(motion.rph[200], np.array([1.0, -2.0, 65.0]) * DEG, atol=3e-7)


def test_rate_of_sampling_does_not_matter() -> None:
    slow, fast = smooth(), smooth(rate=400.0)
    np.testing.assert_allclose(fast.llh[::2, :2], slow.llh[:, :2], atol=1e-15)
    np.testing.assert_allclose(fast.accel.reshape(-1, 2, 3).mean(axis=1), slow.accel, atol=1e-6)
    np.testing.assert_allclose(fast.gyro.reshape(-1, 2, 3).mean(axis=1), slow.gyro, atol=1e-10)


# --------------------------------------------------------------------------------------------------- vehicle motion
def test_axle_moves_where_the_vehicle_points() -> None:
    motion, path = smooth(), make_path(WAY, heading=62.0)
    t = np.linspace(0.1, motion.t[-1] - 0.1, 997)
    llh, v = motion.point(t, ASKEW.axle_lever_arm)
    R_lv = ro.from_rph(path.spline(t)[:, [3, 2, 1]])
    forward = np.einsum("kji,kj->ki", R_lv, v)
    np.testing.assert_allclose(forward, np.column_stack([0 * t, path.compute_speed(t), 0 * t]), atol=1e-8)
    assert np.abs(llh_to_ecef(llh) - llh_to_ecef(np.column_stack(
        [np.interp(t, motion.t, motion.axle_llh[:, k]) for k in range(3)]))).max() < 2e-5  # fmt: skip


def test_side_slip_is_outward_and_as_stated() -> None:
    path = make_path(WAY, heading=62.0, slip_per_accel=0.005)
    motion = move_vehicle(path, ORIGIN, ASKEW, Shake(), 100.0)
    t = np.array([24.0, 35.0])  # to the right, to the left
    _, v = motion.point(t, ASKEW.axle_lever_arm)
    x = path.spline(t)
    side = np.einsum("kji,kj->ki", ro.from_rph(x[:, [3, 2, 1]]), v)[:, 0]
    accel = x[:, SPEED] * path.spline.derivative()(t)[:, HEADING]
    assert accel[0] > 1.0
    assert accel[1] < -1.0
    np.testing.assert_allclose(side, -x[:, SPEED] * 0.005 * accel, rtol=0.03)
    np.testing.assert_allclose(side, -x[:, SPEED] * np.sin(x[:, SLIP]), atol=1e-9)


def test_body_leans_outward_and_dives() -> None:
    made_here = made("urban", exact=True)
    motion = made_here.motion
    assert motion is not None
    rate = 100.0
    low = np.ones(100) / 100.0
    speed = np.linalg.norm(motion.v, axis=1)
    braking = np.convolve(np.gradient(speed, 1 / rate), low, "same")
    right = np.convolve(np.append(0.0, -motion.gyro[:, 2]) * speed, low, "same")
    roll = np.convolve(motion.rph[:, 0] - 2 * np.pi * (motion.rph[:, 0] > np.pi), low, "same")
    inner = slice(500, -6000)  # before it backs into its place
    slope = np.polyfit(right[inner], roll[inner] / DEG, 1)[0]
    assert slope == pytest.approx(-0.35, abs=0.06)
    assert np.ptp(braking[inner]) > 2.0


def test_li2024_stands_when_it_should() -> None:
    made_here = made("li2024")
    long = [span for span in made_here.stops.tolist() if span in made_here.facts["stop_edges"]]
    assert len(long) == 3
    assert np.diff(made_here.facts["stop_edges"]).ravel().tolist() == [60.0, 120.0, 90.0]
    odometer = made_here.recording.odometer
    assert odometer is not None
    for a, b in made_here.stops:
        inside = (odometer.t > a + 0.03) & (odometer.t < b - 0.03)
        assert np.all(odometer.speed[inside] == 0.0)
        just_outside = (np.abs(odometer.t - b) < 1.5) & (odometer.t > b + 0.5)
        assert np.all(odometer.speed[just_outside] != 0.0)


def test_timetable_of_table_2() -> None:
    from graphnav.simulation.scenarios import li2024

    assert (np.diff(li2024.STOPS)[::2]).tolist() == [966.0, 1321.0, 1212.0]
    assert li2024.END - li2024.START == 6925.0


def test_backing_up_is_a_negative_speed() -> None:
    made_here = made("urban", odometer=True)
    odometer, motion = made_here.recording.odometer, made_here.motion
    assert odometer is not None
    assert motion is not None
    t = odometer.t[odometer.speed < -0.9]
    assert len(t) > 20
    _, v = motion.point(t, np.zeros(3))
    forward = np.einsum("ki,ki->k", v, ro.from_rph(np.column_stack([0 * t, 0 * t, heading_at(motion, t)]))[:, :, 1])
    assert np.all(forward < -0.5)


def heading_at(motion: TrueMotion, t: Array) -> Array:
    return np.interp(t, motion.t, np.unwrap(motion.rph[:, 2]))


@pytest.mark.parametrize(
    ("plan", "key"),
    [
        ([Manoeuvre(1.0, 2.0), Manoeuvre(1.0, -2.0)], "manoeuvre.direction"),
        ([Manoeuvre(5.0, 0.0, 30.0)], "manoeuvre.on_the_spot"),
        ([Manoeuvre(0.0, 1.0)], "manoeuvre.time"),
    ],
)
def test_impossible_manoeuvres(plan: list[Manoeuvre], key: str) -> None:
    with refused(key, ConfigError):
        make_path(plan)


# -------------------------------------------------------------------------------------------------------- vibration
@pytest.mark.parametrize("hz", [12.49585, 39.0])
def test_idling_lines_are_read_as_table_4_has_them(hz: float) -> None:
    """By least squares on the samples of the second stop, in vehicle axes."""
    made_here = made("li2024", engine_hz=hz, passengers=False)
    imu = made_here.recording.imu
    a, b = made_here.facts["stop_edges"][1]
    inside = (imu.t > a + 15.0) & (imu.t <= b - 5.0)
    R_vb = Mount(angles=(0.3, -0.4, 0.5)).R_vb
    force, turn = imu.accel[inside] @ R_vb.T / MG, imu.gyro[inside] @ R_vb.T / DEG
    t, span = imu.t[inside], b - a - 20.0
    fine = np.linspace(hz - 1.0 / span, hz + 1.0 / span, 41)
    power = [abs(np.exp(-2j * np.pi * f * t) @ (force[:, 2] - force[:, 2].mean())) for f in fine]
    assert fine[int(np.argmax(power))] == pytest.approx(hz, abs=0.1 / span)
    columns = np.column_stack([g(2 * np.pi * k * hz * t) for k in (0.5, 1.0, 2.0) for g in (np.sin, np.cos)])
    fit = np.linalg.lstsq(np.column_stack([columns, 0 * t + 1]), np.column_stack([force, turn[:, 0]]), rcond=None)[0]
    size = np.hypot(fit[0:6:2], fit[1:6:2])
    idle = TABLE_4[1]
    np.testing.assert_allclose(size[1:, 1:3], np.array(idle.accel_mg)[1:, 1:], rtol=0.03)
    np.testing.assert_allclose(size[:, 3], idle.pitch_rate_deg_s, atol=0.001)


def test_without_an_engine_there_is_no_line() -> None:
    quiet = made("li2024", engine=False, passengers=False)
    loud = made("li2024", engine_hz=12.49585, passengers=False)
    a, b = quiet.facts["stop_edges"][0]
    sizes = []
    for one in (quiet, loud):
        imu = one.recording.imu
        inside = (imu.t > a + 10.0) & (imu.t < b)
        sizes.append(imu.accel[inside, 2].std() / MG)
    white = EG370N.accel.noise * np.sqrt(200.0) / MG
    assert sizes[0] == pytest.approx(white, rel=0.03)
    assert sizes[1] > 4.0


def test_road_dies_with_the_speed() -> None:
    def rms(speed: float) -> Array:
        path = make_path([Manoeuvre(5.0, speed), Manoeuvre(300.0, speed)])
        t = np.arange(10.0, 300.0, 0.002)
        rate = simulate_road_noise(path, np.random.default_rng(0))(t)[1]
        return np.std(np.diff(rate, axis=0) / 0.002, axis=0)

    # at 14 m/s the sizes of the modes, times v / (v + 2), less what the splines leave out above 10 Hz
    np.testing.assert_allclose(rms(14.0)[:3], np.array([0.156, 0.156, 0.43]) * 14.0 / 16.0, rtol=0.2)
    np.testing.assert_allclose(rms(3.5) / rms(14.0), 0.5 * (3.5 / 5.5) / (14.0 / 16.0), rtol=1e-6)
    assert np.all(rms(0.2) < 0.015 * rms(14.0))


def test_a_passenger_sinks_the_body_and_only_that() -> None:
    path = make_path([Manoeuvre(40.0, 0.0)])
    shake = Shake((simulate_movement(path, [Boarding(10.0)], (0.0, 0.0, 1.2), np.random.default_rng(0)),))
    motion = move_vehicle(path, ORIGIN, Mount((0.0, 1.3, 1.5)), shake, 200.0)
    assert motion.llh[-1, 2] - motion.llh[0, 2] == pytest.approx(-0.0075, abs=2e-4)
    rph = ro.wrap(motion.rph[-1] - motion.rph[0])
    np.testing.assert_allclose(rph, [0.0070, -0.0022, 0.0], atol=1e-5)  # right side and nose down
    assert np.abs(motion.v[-1]).max() < 1e-4
    # the force, integrated twice, gives that movement: nothing but the true path is in it
    up = np.einsum("kj,kj->k", motion.R_lb[1:, 2], motion.accel) - gravity(motion.llh[0, 0], motion.llh[0, 2])
    height = np.cumsum(np.cumsum(up)) / 200.0**2
    assert np.abs(height - (motion.llh[1:, 2] - motion.llh[0, 2])).max() < 1e-3
    assert np.ptp(motion.llh[:, 2]) < 0.02


# ------------------------------------------------------------------------------------------------------- IMU errors
def allan(x: Array, n: int) -> float:
    """Allan deviation of samples (N, 3) for clusters of n, over all axes."""
    means = x[: len(x) // n * n].reshape(-1, n, 3).mean(axis=1)
    return float(np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2)))


def still(triad: Triad, hours: float, rate: float = 20.0, seed: int = 1) -> Array:
    return triad.read(np.zeros((round(3600 * hours * rate), 3)), rate, np.random.default_rng(seed))[0]


@pytest.mark.parametrize("triad", [EG370N.gyro, MIMU.accel, make_gyroscope(0.3, 100.0)])
def test_allan_deviation_at_a_second_is_the_noise_density(triad: Triad) -> None:
    assert allan(still(triad, 1.0), 20) == pytest.approx(triad.noise, rel=0.03)


def test_instability_has_the_allan_deviation_of_a_gauss_markov_process() -> None:
    """IEEE Std 952-1997, eq. C.16, over the whole range of times."""
    triad = replace(make_gyroscope(0.0, 0.0, instability_deg_h=5.0), correlation_time=20.0)
    x = still(triad, 12.0)
    for seconds in (2.0, 20.0, 38.0, 200.0):
        r = seconds / 20.0
        expected = triad.instability * np.sqrt(2.0 / r**2 * (r - 1.5 + 2.0 * np.exp(-r) - 0.5 * np.exp(-2.0 * r)))
        assert allan(x, round(20 * seconds)) == pytest.approx(expected, rel=0.06)


def test_random_walk_has_its_allan_deviation() -> None:
    triad = make_gyroscope(0.0, 0.0, rrw_deg_h_sqrt_h=30.0)
    assert triad.walk == pytest.approx(30.0 / 3600.0 * DEG / 60.0)
    assert allan(still(triad, 6.0), 200) == pytest.approx(triad.walk * np.sqrt(10.0 / 3.0), rel=0.06)


def test_turn_on_bias_scale_and_misalignment_have_their_sizes() -> None:
    triad = Triad(0.0, bias=0.2, scale=1e-3, misalignment=2e-3)
    base, along = [], []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        out, bias = triad.read(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), 1.0, rng)
        np.testing.assert_allclose(out[0], bias[0])
        base.append(bias[0])
        along.append(out[1] - out[0] - [1.0, 0.0, 0.0])
    assert np.std(base) == pytest.approx(0.2, rel=0.06)
    np.testing.assert_allclose(np.std(along, axis=0), [1e-3, 2e-3, 2e-3], rtol=0.1)


def test_range_and_last_digit() -> None:
    triad = make_accelerometer(0.0, 0.0, range_g=2.0, step_mg=1.0)
    out, _ = triad.read(np.array([[30.0, -30.0, 5.0004]]), 1.0, np.random.default_rng(0))
    assert out[0, :2].tolist() == pytest.approx([2000 * MG, -2000 * MG])
    assert out[0, 2] / MG == pytest.approx(round(out[0, 2] / MG), abs=1e-9)
    assert abs(out[0, 2] - 5.0004) <= 0.5 * MG


def test_recording_states_what_was_put_in() -> None:
    noise = made("li2024").recording.imu.noise
    assert noise.gyro_noise_density == pytest.approx(0.06 * DEG / 60.0)
    assert noise.accel_noise_density == pytest.approx(0.06 * MG)
    assert noise.gyro_bias_sigma == pytest.approx(360.0 * DEG / 3600.0)
    made_here, motion = made("li2024"), made("li2024").motion
    assert motion is not None
    left = made_here.recording.imu.gyro - motion.gyro - made_here.truth.gyro_bias[1:]
    assert np.std(left) == pytest.approx(noise.gyro_noise_density * np.sqrt(200.0), rel=0.01)


# ------------------------------------------------------------------------------------------------- GNSS and odometer
def enu_errors(motion: TrueMotion, model: GnssModel, seed: int = 0) -> tuple[Array, Array, Array]:
    fixes = model.read(motion, seed)
    llh, v = motion.point(fixes.t, fixes.lever_arm)
    frame = LocalFrame(llh[0])
    assert fixes.v is not None
    return fixes.t, frame.from_llh(fixes.llh) - frame.from_llh(llh), fixes.v - v


def test_gnss_errors_have_their_sizes_and_times() -> None:
    path = make_path([Manoeuvre(4000.0, 0.0)])
    motion = move_vehicle(path, ORIGIN, Mount(), Shake(), 5.0)
    model = GnssModel(white=(0.5, 0.6, 0.9), slow=(1.0, 1.0, 2.0), slow_time=5.0, velocity=(0.1, 0.1, 0.2), phase=0.3)
    t, e, dv = enu_errors(motion, model)
    assert t[0] == pytest.approx(0.3)
    np.testing.assert_allclose(e.std(axis=0), model.read(motion, 0).sd[0], rtol=0.08)
    np.testing.assert_allclose(dv.std(axis=0), (0.1, 0.1, 0.2), rtol=0.05)
    after = np.mean(e[5:] * e[:-5], axis=0) / np.array(model.slow) ** 2
    np.testing.assert_allclose(after, np.exp(-1.0), atol=0.12)
    lost = replace(model, outages=((100.0, 200.0),), dropouts=0.1).read(motion, 0)
    assert not np.any((lost.t >= 100.0) & (lost.t <= 200.0))
    assert len(lost.t) == pytest.approx(0.9 * 3900, rel=0.03)
    kept = np.isin(t, lost.t)
    np.testing.assert_array_equal(model.read(motion, 0).llh[kept], lost.llh)


def test_gnss_faults() -> None:
    motion = smooth(rate=200.0)
    model = GnssModel(white=(0.01, 0.01, 0.01), rate=10.0)
    t, e, dv = enu_errors(motion, replace(model, faults=(SimulatedFault(20.0, 30.0, growth=(1.0, 0.5, 0.0)),)))
    inside = (t >= 20.0) & (t <= 30.0)
    np.testing.assert_allclose(e[inside, 0], t[inside] - 20.0, atol=0.06)
    np.testing.assert_allclose(e[inside, 1], 0.5 * (t[inside] - 20.0), atol=0.06)
    assert np.abs(e[~inside]).max() < 0.06
    _, e, dv = enu_errors(motion, replace(model, faults=(SimulatedFault(20.0, 30.0, noise=100.0),)))
    assert e[inside].std() == pytest.approx(1.0, rel=0.2)
    assert dv[~inside].std() < 0.1


def test_odometer_readings() -> None:
    path = make_path(WAY, heading=62.0)
    mount = Mount()
    model = OdometerModel(rate=50.0, scale=0.02, white=0.0)
    odometer, scale = model.read(path, mount, 3)
    assert scale != 0.0
    np.testing.assert_allclose(odometer.speed, (1.0 + scale) * path.compute_speed(odometer.t), atol=2e-3)
    late, _ = replace(model, delay=0.1).read(path, mount, 3)
    np.testing.assert_allclose(late.speed, (1.0 + scale) * path.compute_speed(late.t - 0.1), atol=2e-3)
    unsigned, _ = replace(model, signed=False).read(path, mount, 3)
    np.testing.assert_array_equal(unsigned.speed, np.abs(odometer.speed))
    broken, _ = replace(model, stuck=((20.0, 25.0),), unplugged=((30.0, 35.0),)).read(path, mount, 3)
    assert np.all(broken.speed[(broken.t >= 20.0) & (broken.t <= 25.0)] == 0.0)
    assert not np.any((broken.t >= 30.0) & (broken.t <= 35.0))
    noisy, _ = replace(model, white=0.1).read(path, mount, 3)
    moving = path.compute_speed(noisy.t) != 0.0
    assert (noisy.speed - odometer.speed)[moving].std() == pytest.approx(0.1, rel=0.06)
    assert np.all(noisy.speed[~moving] == odometer.speed[~moving])


def test_wheel_pulses_are_whole_and_none_is_lost() -> None:
    path = make_path(WAY, heading=62.0)
    model = OdometerModel(rate=25.0, scale=0.0, white=0.0, pulse=0.04)
    odometer, _ = model.read(path, Mount(), 0)
    counts = odometer.speed / 25.0 / 0.04
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    total = path.compute_distance(np.array([path.end + 1.0]))[0]
    assert abs(np.sum(odometer.speed) / 25.0 - total) <= 0.04


# -------------------------------------------------------------------------------------------------------- scenarios
@pytest.mark.parametrize("name", sorted(SHORT))
def test_the_folder_holds_the_recording(name: str, tmp_path: Path) -> None:
    made_here = made(name)
    files = made_here.write(tmp_path / name)
    assert all(file.is_file() for file in files)
    again, recording = read(tmp_path / name), made_here.recording
    assert "simulated" in again.name
    for key in ("imu", "gnss", "odometer", "truth"):
        mine, theirs = getattr(recording, key), getattr(again, key)
        assert (mine is None) == (theirs is None)
        for field, value in () if mine is None else mine.__dict__.items():
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(value, getattr(theirs, field), err_msg=f"{key}.{field}")
            else:
                assert getattr(theirs, field) == value, f"{key}.{field}"
    facts = json.loads((tmp_path / name / "simulated.json").read_text())
    assert facts["simulated"] is True
    np.testing.assert_allclose(facts["stops"], made_here.stops)
    assert again.sensors.keys() == recording.sensors.keys()
    for sensor, series in recording.sensors.items():
        np.testing.assert_array_equal(again.sensors[sensor].t, series.t)
        np.testing.assert_allclose(again.sensors[sensor].values, series.values, rtol=1e-12, atol=1e-12)
        assert again.sensors[sensor].figures == series.figures


def test_counts_and_wheels_are_written_too(tmp_path: Path) -> None:
    t = np.arange(1.0, 60.0, 0.5)
    way = 0.25 * np.round(4.0 * t)
    odometer = Odometer(
        t, 0 * t + 1.0, counted=way, pulse=0.25, wheels=np.column_stack([0.9 + 0 * t] * 4), signed=False
    )
    write_folder(replace(made("zhu2020").recording, odometer=odometer), tmp_path)
    again = read(tmp_path).odometer
    assert again is not None
    np.testing.assert_allclose(np.diff(again.counted), np.diff(way), atol=1e-9)
    assert (again.pulse, again.signed) == (0.25, False)
    np.testing.assert_array_equal(again.wheels, odometer.wheels)


@pytest.mark.parametrize("name", sorted(set(SHORT) - {"li2024"}))
def test_nothing_odd_is_found_in_it(name: str) -> None:
    assert inspect(made(name).recording).warnings == ()


def test_idling_is_the_only_thing_odd_in_li2024() -> None:
    """Half a period of a line of 0.4 deg/s is in every second: the check takes it for noise, as it should."""
    found = inspect(made("li2024").recording).warnings
    assert len(found) == 1
    assert found[0].startswith("gyro_noise_density")
    assert inspect(made("li2024", engine=False, passengers=False).recording).warnings == ()


def test_every_scenario_is_tested() -> None:
    assert set(list_scenarios()) == set(SHORT) | {"gait", "ren2021"}  # walks: test_gait.py


def test_seeds() -> None:
    one, same, other = (
        simulate("zhu2020", 5, after_s=30.0),
        simulate("zhu2020", 5, after_s=30.0),
        made("zhu2020", 6, after_s=30.0),
    )
    np.testing.assert_array_equal(one.recording.imu.accel, same.recording.imu.accel)
    assert one.recording.gnss is not None
    assert same.recording.gnss is not None
    np.testing.assert_array_equal(one.recording.gnss.llh, same.recording.gnss.llh)
    assert one.facts == same.facts
    assert one.facts["mounting_deg"] != other.facts["mounting_deg"]
    # each part draws from its own numbers: another odometer leaves the IMU and the way as they were
    changed = simulate("zhu2020", 5, after_s=30.0, odometer_scale=0.03)
    np.testing.assert_array_equal(one.recording.imu.gyro, changed.recording.imu.gyro)


def test_ushaq_faults_do_what_they_say() -> None:
    clean, wild, growing, gone = (made("ushaq", fault=f) for f in ("none", "noise", "growing", "outage"))
    gnss = clean.recording.gnss
    assert gnss is not None
    inside = ((gnss.t >= 1080) & (gnss.t <= 1500)) | ((gnss.t >= 2580) & (gnss.t <= 2820))
    frame = LocalFrame(gnss.llh[0])
    for one, size in ((wild, 25e2), (growing, 150.0)):
        assert one.recording.gnss is not None
        off = frame.from_llh(one.recording.gnss.llh) - frame.from_llh(gnss.llh)
        assert np.all(off[~inside] == 0.0)
        assert off[inside, 0].std() == pytest.approx(size, rel=0.5)
    assert gone.recording.gnss is not None
    np.testing.assert_array_equal(gone.recording.gnss.t, gnss.t[~inside])
    spans = clean.stops[1:-1]
    assert len(spans) == 2
    np.testing.assert_allclose(np.diff(spans).ravel(), 60.0, atol=0.3)
    assert np.linalg.norm(frame.from_llh(clean.truth.llh[0]) - frame.from_llh(clean.truth.llh[-1])) < 20.0


@pytest.mark.parametrize(
    ("name", "options", "key", "says"),
    [
        ("zhu2002", {}, "unknown", "'zhu2020'"),
        ("zhu2020", {"gnss": 3.0}, "option", "'gnss_s'"),
        ("zhu2020", {"gnss_s": 3.0}, "value", "gnss_s"),
        ("zhu2020", {"unplugged": 1}, "value", "unplugged = 1"),
        ("li2024", {"engine_hz": float("nan")}, "value", "engine_hz = nan"),
        ("li2024", {"engine_hz": 200.0}, "value", "engine_hz = 200"),
        ("urban", {"gnss": "ppp"}, "value", "'ppp'"),
        ("ushaq", {"fault": "odd"}, "value", "'odd'"),
    ],
)
def test_bad_options_are_refused(name: str, options: dict[str, object], key: str, says: str) -> None:
    with refused(f"simulation.{key}", ConfigError, says):
        simulate(name, 0, **options)


def test_options_from_the_command_line() -> None:
    assert parse_options("urban", ["gnss=single", "duration=300", "odometer=false"]) == {
        "gnss": "single", "duration": 300, "odometer": False,
    }  # fmt: skip
    for bad in ("duration", "duration=soon", "=3"):
        with refused("option.value", ConfigError, "--set"):
            parse_options("urban", [bad])


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(["simulate"]) == 0
    listed = capsys.readouterr().out
    assert all(f"{name} " in listed for name in SHORT)
    arguments = ["simulate", "zhu2020", "--seed", "7", "--set", "after_s=30", "-o", str(tmp_path / "a")]
    assert command(arguments) == 0
    assert "zhu2020 (simulated, seed 7)" in capsys.readouterr().out
    assert command(["info", str(tmp_path / "a")]) == 0
    assert "warning" not in capsys.readouterr().out
    assert command(["simulate", "zhu2020"]) == 2
    assert "-o DIR" in capsys.readouterr().err
    assert command(["simulate", "zhu", "-o", str(tmp_path / "b")]) == 2
    assert not (tmp_path / "b").exists()
