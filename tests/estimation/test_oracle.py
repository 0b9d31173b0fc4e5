"""Are the oracle's samples, frames and time stamps what they are said to be? Checked without graphnav's own maths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import oracle
import oracle_path
import pandas as pd
import pytest
from oracle import ExactPath
from oracle_path import Array
from pyins import strapdown, transform, util
from pyins.earth import RATE

pytestmark = pytest.mark.filterwarnings("ignore:The copy keyword")  # of pandas, about pyins

LATITUDES = (30.5, -45.0, 70.0)


@pytest.fixture(scope="module", params=LATITUDES)
def lap(request: pytest.FixtureRequest) -> ExactPath:
    return oracle.vehicle_path(180.0, lat=request.param)


def integrated(path: ExactPath) -> tuple[Array, Array, Array]:
    """Errors (position in ENU m, velocity m/s, attitude deg) of pyins's own strapdown fed with the samples."""
    readings = np.hstack([oracle_path.swap(path.gyro), oracle_path.swap(path.accel)]) * path.dt
    # pyins wants the sample before the first as well; the paths begin at rest, where it is the same
    imu = pd.DataFrame(np.vstack([readings[:1], readings]), index=path.t, columns=util.GYRO_COLS + util.ACCEL_COLS)
    truth = np.hstack([oracle_path.degrees(path.llh), oracle_path.swap(path.v), np.rad2deg(path.rph)])
    start = pd.Series(truth[0], index=util.TRAJECTORY_COLS, name=path.t[0])
    result = strapdown.Integrator(start).integrate(strapdown.compute_increments_from_imu(imu, "increment")).to_numpy()
    position = oracle_path.swap(transform.compute_lla_difference(result[:, :3], truth[:, :3]))
    attitude = np.mod(result[:, 6:9] - truth[:, 6:9] + 180.0, 360.0) - 180.0
    return position, oracle_path.swap(result[:, 3:6] - truth[:, 3:6]), attitude


def assert_reproduced(path: ExactPath, position_m: float) -> None:
    # pyins integrates positions with the trapezoid rule and the Earth at the start of each step, both of the order
    # of the 5-ms step, so it follows to micrometres a second; a wrong sign or frame is off by metres.
    position, velocity, attitude = integrated(path)
    assert np.abs(position).max() < position_m
    assert np.abs(velocity).max() < 1e-4
    assert np.abs(attitude).max() < 1e-6


def test_pyins_integrates_a_lap_back(lap: ExactPath) -> None:
    assert lap.speed.max() > 8.0
    assert_reproduced(lap, position_m=0.005)


def test_pyins_integrates_a_straight_drive_back() -> None:
    path = oracle.straight_path(5e3, rate=100.0)
    assert path.length == pytest.approx(5e3, abs=1.0)
    assert path.speed[-1] == pytest.approx(30.0, abs=1e-9)
    assert_reproduced(path, position_m=0.01)


def test_straight_drive_is_a_geodesic() -> None:
    path = oracle.straight_path(5e3, rate=100.0)
    moving = path.speed > 29.0
    # no turning about the vertical against the Earth: only the Earth's own rate is felt
    felt = path.gyro[moving[1:], 2]
    lat = path.llh[1:, 0][moving[1:]]
    assert np.abs(felt - RATE * np.sin(lat)).max() < 1e-9
    # and it neither climbs nor sinks
    assert np.abs(path.llh[:, 2] - path.llh[0, 2]).max() < 1e-9


def test_standing_vehicle_feels_gravity_and_earth_rate(lap: ExactPath) -> None:
    """At rest the sensors are the rows of the direction cosines, written out here from roll, pitch, heading."""
    assert np.all(lap.v[:500] == 0)
    lat, height = lap.llh[0, 0], lap.llh[0, 2]
    roll, pitch, heading = lap.rph[0]
    # WGS-84 (NIMA TR8350.2, eq. 4-1), with the first-order height term that pyins uses
    s2 = np.sin(lat) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - 0.00669437999014 * s2)
    gravity = surface * (1 - 2 * height / 6378137)
    # nose up: gravity's reaction has a forward part; right side down: a part to the left
    up = np.array([-np.cos(pitch) * np.sin(roll), np.sin(pitch), np.cos(pitch) * np.cos(roll)])
    np.testing.assert_allclose(lap.accel[:500], np.tile(gravity * up, (500, 1)), atol=2e-8)
    # north in body axes
    sr, cr, sp, cp, sh, ch = (f(a) for a in (roll, pitch, heading) for f in (np.sin, np.cos))
    north = np.array([-sh * cr + ch * sp * sr, ch * cp, -sh * sr - ch * sp * cr])
    expected = RATE * (np.cos(lat) * north + np.sin(lat) * up)
    np.testing.assert_allclose(lap.gyro[:500], np.tile(expected, (500, 1)), atol=1e-12)


def test_signs_of_driving() -> None:
    path = oracle.vehicle_path(180.0)
    speed, heading = path.speed, path.rph[:, 2]
    gain, turn = np.gradient(speed, path.dt)[1:], np.gradient(heading, path.dt)[1:]
    faster, right = gain > 1.0, turn > 0.2
    left = turn < -0.2
    assert faster.any()
    assert right.any() or left.any()
    # forward is y: accelerating pushes forward; heading is clockwise: turning right is a negative rate about up
    level_force = path.accel[:, 1] - 9.79 * np.sin(path.rph[1:, 1])
    assert np.all(level_force[faster] > 0.8)
    assert np.all(path.gyro[right, 2] < -0.15)
    assert np.all(path.gyro[left, 2] > 0.15)
    # towards the inside of a bend is +x when turning right
    assert np.all((path.accel[:, 0] * np.sign(turn))[(right | left) & (speed[1:] > 4.0)] > 0.0)


def test_a_row_is_the_mean_over_the_period_that_ends_at_its_time() -> None:
    """The turn between two times is in the row of the later one, not in a neighbour's."""
    path = oracle.vehicle_path(180.0, rate=50.0)
    # the heading's rate about the body's vertical; what roll and pitch rates add is small beside one period's change
    level = np.cos(path.rph[1:, 0]) * np.cos(path.rph[1:, 1])
    rate = -np.diff(path.rph[:, 2]) / path.dt * level
    felt = path.gyro[:, 2] - path.gyro[0, 2]

    def misfit(shift: int) -> float:
        return float(np.sqrt(np.mean((felt[100:-100] - rate[100 + shift : len(rate) - 100 + shift]) ** 2)))

    assert misfit(0) < 0.2 * min(misfit(-1), misfit(1))


def test_a_tiled_lap_is_one_long_exact_drive() -> None:
    lap = oracle.vehicle_path(120.0, rate=100.0)
    twice = lap.tiled(2)
    assert len(twice.gyro) == 2 * len(lap.gyro)
    assert len(twice.t) == len(twice.gyro) + 1
    np.testing.assert_allclose(np.diff(twice.t), lap.dt, atol=1e-9)
    assert np.abs(np.diff(twice.rph, axis=0)).max() < 0.02
    assert_reproduced(twice, position_m=0.02)


def test_only_a_closed_lap_can_be_tiled() -> None:
    with pytest.raises(oracle_path.NotTileable):
        oracle.straight_path(5e3, rate=100.0).tiled(2)


def test_antenna_and_axle_are_where_the_lever_arms_say(lap: ExactPath) -> None:
    t = lap.t[::37]
    lever = np.array(oracle.LEVER_ARM)
    llh, _, _ = lap.point(t, oracle.LEVER_ARM)
    apart = transform.lla_to_ecef(oracle_path.degrees(llh)) - transform.lla_to_ecef(oracle_path.degrees(lap.llh[::37]))
    np.testing.assert_allclose(np.linalg.norm(apart, axis=1), np.linalg.norm(lever), atol=1e-8)
    # standing at first, level to a few degrees: 1.2 m above, 0.5 m ahead
    up = llh[0, 2] - lap.llh[0, 2]
    assert up == pytest.approx(1.2, abs=0.06)
    # its velocity is the derivative of its position
    every, v_every, _ = lap.point(lap.t, oracle.LEVER_ARM)
    north, east = oracle_path.radii(every)
    slope = np.gradient(every, lap.dt, axis=0) * np.column_stack([east, north, np.ones_like(east)])[:, [1, 0, 2]]
    np.testing.assert_allclose(slope[1:-1, [1, 0, 2]], v_every[1:-1], atol=2e-5)


@pytest.mark.parametrize("phase", [0.0, 0.0023])
def test_the_axle_neither_slips_nor_jumps(lap: ExactPath, phase: float) -> None:
    t = lap.t[:-1:11] + phase
    forward = lap.point(t, oracle.AXLE)[2]
    assert np.abs(forward[:, [0, 2]]).max() < 5e-5
    assert forward[:, 1].min() > -1e-6


def test_points_between_samples_lie_on_the_path() -> None:
    fine = oracle.vehicle_path(120.0, rate=200.0)
    coarse = oracle.vehicle_path(120.0, rate=100.0)
    t = fine.t[1::2]
    (llh, v, v_b), (llh_between, v_between, v_b_between) = (p.point(t, oracle.LEVER_ARM) for p in (fine, coarse))
    apart = transform.compute_lla_difference(oracle_path.degrees(llh_between), oracle_path.degrees(llh))
    assert np.abs(apart).max() < 2e-5
    assert np.abs(v_between - v).max() < 2e-4
    assert np.abs(v_b_between - v_b).max() < 2e-4


def test_noise_has_the_stated_size() -> None:
    path = oracle.vehicle_path(180.0)
    noise = oracle.MEMS
    recording, truth = oracle.drive(path, imu_noise=noise, seed=5)
    assert truth.gyro_bias is not None
    assert truth.accel_bias is not None
    n = len(path.gyro)
    for measured, exact, bias, density, walk in (
        (recording.imu.gyro, path.gyro, truth.gyro_bias, noise.gyro_noise_density, noise.gyro_bias_walk),
        (recording.imu.accel, path.accel, truth.accel_bias, noise.accel_noise_density, noise.accel_bias_walk),
    ):
        white = measured - exact - bias[1:]
        # an estimated sigma of n normal numbers scatters by 1/sqrt(2 n): five of those, for each of three axes
        band = 5 / np.sqrt(2 * n)
        np.testing.assert_allclose(white.std(axis=0) / (density / np.sqrt(path.dt)), 1.0, atol=band)
        np.testing.assert_allclose(np.diff(bias[1:], axis=0).std(axis=0) / (walk * np.sqrt(path.dt)), 1.0, atol=band)
    short = oracle.vehicle_path(120.0, rate=20.0)
    turn_on = np.array([oracle.drive(short, seed=k)[1].gyro_bias[0] for k in range(100)]) / noise.gyro_bias_sigma
    assert turn_on.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * turn_on.size))


def test_without_noise_the_samples_are_the_exact_ones() -> None:
    path = oracle.vehicle_path(180.0)
    recording, truth = oracle.drive(path, imu_noise=None, gnss_exact=True, odometer_rate=20.0, odometer_scale=0.01)
    assert np.array_equal(recording.imu.gyro, path.gyro)
    assert np.array_equal(recording.imu.accel, path.accel)
    assert recording.gnss is not None
    assert np.array_equal(recording.gnss.llh, path.point(recording.gnss.t, oracle.LEVER_ARM)[0])
    assert recording.start == pytest.approx(truth.t[0], abs=1e-9)
    assert np.array_equal(recording.imu.t, truth.t[1:])


def test_fixes_and_wheel_speed() -> None:
    path = oracle.vehicle_path(180.0)
    recording, _ = oracle.drive(
        path, seed=2, gnss_rate=10.0, gnss_velocity_sd=(0.05, 0.05, 0.1), outages=((60.0, 80.0),), odometer_rate=20.0
    )
    gnss, odometer = recording.gnss, recording.odometer
    assert gnss is not None
    assert gnss.v is not None
    assert odometer is not None
    assert not np.any((gnss.t >= 60.0) & (gnss.t <= 80.0))
    llh, v, _ = path.point(gnss.t, oracle.LEVER_ARM)
    error = transform.compute_lla_difference(oracle_path.degrees(gnss.llh), oracle_path.degrees(llh))[:, [1, 0, 2]]
    band = 5 / np.sqrt(2 * len(gnss.t))
    np.testing.assert_allclose(error.std(axis=0) / oracle.RTK_SD, 1.0, atol=band)
    np.testing.assert_allclose((gnss.v - v).std(axis=0) / (0.05, 0.05, 0.1), 1.0, atol=band)
    true = path.point(odometer.t, oracle.AXLE)[2][:, 1]
    moving = true > 1.0
    assert np.sum(odometer.speed[moving]) / np.sum(true[moving]) == pytest.approx(1.01, abs=0.002)
    assert np.abs(odometer.speed[np.abs(true) < 1e-6]).max() < 1e-5


def test_each_sensor_has_its_own_errors() -> None:
    path = oracle.vehicle_path(180.0)
    first, again = oracle.drive(path, seed=3)[0], oracle.drive(path, seed=3, outages=((50.0, 60.0),))[0]
    other = oracle.drive(path, seed=4)[0]
    assert np.array_equal(first.imu.gyro, again.imu.gyro)
    assert not np.array_equal(first.imu.gyro, other.imu.gyro)
    assert first.gnss is not None
    assert again.gnss is not None
    kept = np.isin(first.gnss.t, again.gnss.t)
    assert np.array_equal(first.gnss.llh[kept], again.gnss.llh)


def test_outages_are_put_where_the_vehicle_moves() -> None:
    path = oracle.vehicle_path(600.0, 50.0)
    spans = oracle.moving_spans(path, 30.0, 2)
    assert len(spans) == 2
    assert spans[0][1] < spans[1][0]
    for start, end in spans:
        assert end - start == 30.0
        inside = (path.t >= start) & (path.t <= end)
        assert path.speed[inside].min() > 2.0


def test_the_shipped_drive_is_followed(shared_data: Path) -> None:
    path = oracle.oracle_truth_path(shared_data)
    assert_reproduced(path, position_m=0.005)
    table = np.genfromtxt(shared_data / "oracle_drive" / "truth.csv.gz", delimiter=",", names=True)
    file_lla = np.column_stack([table["lat"], table["lon"], table["h"]])
    apart = transform.compute_lla_difference(oracle_path.degrees(path.llh[::20]), file_lla)
    assert np.abs(apart).max() < 1e-4
    recording, _ = oracle.oracle_drive(shared_data, seed=1)
    assert recording.gnss is not None
    assert not np.any((recording.gnss.t > 415.0) & (recording.gnss.t < 475.0))
    # against the file's own samples (FRD), made by the same program from the unrounded path: they differ by the
    # shipped errors only, whose biases are stated as (310, -245, 395) deg/h and (1.8, -2.3, 1.4) mg
    shipped = np.genfromtxt(shared_data / "oracle_drive" / "imu.csv.gz", delimiter=",", names=True)
    readings = np.column_stack([shipped[c] for c in ("gx", "gy", "gz", "ax", "ay", "az")])
    n = min(len(readings), len(path.gyro))
    first = int(np.argmin(np.abs(shipped["t"] - path.t[1])))
    assert shipped["t"][first] == pytest.approx(path.t[1], abs=1e-6)
    exact = np.hstack([oracle_path.swap(path.gyro), oracle_path.swap(path.accel)])
    error = np.median(readings[first:n] - exact[: n - first], axis=0)
    np.testing.assert_allclose(np.rad2deg(error[:3]) * 3600, (310, -245, 395), atol=5.0)
    np.testing.assert_allclose(error[3:] / 9.80665e-3, (1.8, -2.3, 1.4), atol=0.5)
