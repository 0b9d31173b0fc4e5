"""`graphnav init`: what it makes of logs whose truth is known, in any mount, unit, clock and spelling."""

from __future__ import annotations

import re
import shutil
import tomllib
from pathlib import Path

import logs
import numpy as np
import oracle
import pytest
from helpers import refuse_command, refused

from graphnav.app import cli
from graphnav.core.errors import RecordingError
from graphnav.core.rotation import exp
from graphnav.recording.checks.overview import inspect
from graphnav.recording.densities import estimate_density_in_motion, measure_densities
from graphnav.recording.draft import draft, guesses, motion
from graphnav.recording.draft.agreement import find_level_axes
from graphnav.recording.draft.logs import read_log
from graphnav.recording.formats import columns, read
from graphnav.recording.formats.axes import parse_axes_letters
from graphnav.simulation import simulate

DRIVE, _ = oracle.drive(
    oracle.vehicle_path(240.0, 50.0), seed=3, gnss_rate=5.0, gnss_velocity_sd=(0.05, 0.05, 0.1), odometer_rate=20.0
)


# ---- names


@pytest.mark.parametrize(
    ("header", "sensor", "found"),
    [
        ("t,gx,gy,gz,ax,ay,az", "imu", {"gx": "gx", "az": "az"}),
        ("Timestamp,GyroX,GyroY,GyroZ,AccX,AccY,AccZ", "imu", {"t": "Timestamp", "gy": "GyroY", "ax": "AccX"}),
        ("time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,acc_x_g,acc_y_g,acc_z_g", "imu", {"gz": "gyro_z_dps"}),
        (
            "%time,field.header.stamp,field.angular_velocity.x,field.angular_velocity.y,field.angular_velocity.z,"
            "field.linear_acceleration.x,field.linear_acceleration.y,field.linear_acceleration.z",
            "imu", {"t": "field.header.stamp", "gx": "field.angular_velocity.x", "az": "field.linear_acceleration.z"},
        ),
        (
            "Time (s),Gyroscope x (rad/s),Gyroscope y (rad/s),Gyroscope z (rad/s),Acceleration x (m/s^2),"
            "Acceleration y (m/s^2),Acceleration z (m/s^2)",
            "imu", {"t": "Time (s)", "gx": "Gyroscope x (rad/s)", "ay": "Acceleration y (m/s^2)"},
        ),
        ("timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z,f_x,f_y,f_z", "imu", {"ax": "f_x"}),
        ("time,seconds_elapsed,z,y,x", None, {"t": "seconds_elapsed"}),
        ("iTOW,lon,lat,height,hMSL,hAcc,vAcc,velN,velE,velD,gSpeed,headMot", "gnss",
         {"t": "iTOW", "h": "height", "ve": "velE", "vd": "velD", "sd_e": "hAcc", "sd_u": "vAcc", "course": "headMot"}),
        ("time,seconds_elapsed,latitude,longitude,altitude,speed,bearing,horizontalAccuracy,verticalAccuracy", "gnss",
         {"h": "altitude", "course": "bearing", "sd_n": "horizontalAccuracy", "sd_u": "verticalAccuracy"}),
        ("Time (s),Latitude (°),Longitude (°),Height (m),Velocity (m/s),Direction (°),Horizontal Accuracy (m)", "gnss",
         {"speed": "Velocity (m/s)", "course": "Direction (°)", "sd_e": "Horizontal Accuracy (m)"}),
        ("t_s,lat_deg,lon_deg,h_m,speed_mps,course_deg,epe_m,hdop", "gnss", {"h": "h_m", "course": "course_deg"}),
        ("timestamp,wheel_speed_kmh,gear", "odometer", {"speed": "wheel_speed_kmh"}),
        ("t,wheel_fl_kmh,wheel_fr_kmh,RearLeft,rr", "odometer", {"speed_fl": "wheel_fl_kmh", "speed_rl": "RearLeft"}),
        ("t_s,lat,lat_std,lon,alt,std_alt,ve,vn,vu,sd_v,speedAccuracy", "gnss",
         {"lat": "lat", "h": "alt", "sd_u": "sd_v", "sd_ve": "speedAccuracy"}),
        ("t_s,lat,lon,h,sd_e,sd_n,sd_u,ve,vn,vu,sd_v,hdop", "gnss", {"sd_u": "sd_u", "sd_vn": "sd_v", "speed": None}),
        ("week,sow,lat,lon,h,vn,ve,vd,std_n,std_e,std_d,std_vn,std_ve,std_vd", "gnss",
         {"sd_u": "std_d", "sd_vu": "std_vd"}),
        ("Zeit [s],Tacho (km/h)", "odometer", {"speed": "Tacho (km/h)"}),
        ("Zeit,Breitengrad,Längengrad,Höhe,Geschwindigkeit (km/h),Richtung", "gnss", {"course": "Richtung"}),
        ("time,temperature,pressure", "barometer", {"t": "time", "pressure": "pressure"}),
        ("time,temperature,humidity", None, {"t": "time"}),
    ],
)  # fmt: skip
def test_columns_are_found_by_meaning(header, sensor, found):
    match = columns.match_columns(header.split(","))
    assert match.sensor == sensor
    for ours, theirs in found.items():
        assert match.names.get(ours) == theirs


def test_bare_axes_are_told_apart_by_the_file_name():
    header = ["time", "seconds_elapsed", "z", "y", "x"]
    assert columns.match_columns(header, "Gyroscope").names["gx"] == "x"
    assert columns.match_columns(header, "TotalAcceleration").sensor == "accel"


@pytest.mark.parametrize(
    ("name", "plain", "unit"),
    [
        ("gyro_x_dps", "gyro_x", "dps"), ("Acceleration y (m/s²)", "acceleration_y", "m_s2"),
        ("rotationRateX(rad/s)", "rotation_rate_x", "rad_s"), ("lat", "lat", ""), ("s", "s", ""),
        ("acc_x[mg]", "acc_x", "mg"), ("speed_km_h", "speed", "km_h"),
    ],
)  # fmt: skip
def test_units_in_names(name, plain, unit):
    assert columns.split_unit(name) == (plain, unit)


# ---- sizes


@pytest.mark.parametrize(
    ("first", "step", "unit"),
    [(0.0, 0.01, "s"), (0.0, 10.0, "ms"), (5e5, 1e4, "us"), (0.0, 1e7, "ns"), (1.7e9, 0.01, "s"), (1.7e12, 10, "ms"),
     (1.7e18, 1e7, "ns"), (345600.0, 0.005, "s"), (345600000.0, 5.0, "ms")],
)  # fmt: skip
def test_time_units(first, step, unit):
    assert guesses.guess_time_unit(first + step * np.arange(100), None, imu=True).value == unit


def test_forces_without_gravity_and_raw_counts_are_refused():
    rng = np.random.default_rng(1)
    still = rng.normal(0, 0.3, (500, 3))
    with refused("draft.no_gravity", RecordingError, "a.csv"):
        guesses.guess_accel_unit(Path("a.csv"), still, "m/s2")
    with refused("draft.raw_counts", RecordingError, "a.csv"):
        guesses.guess_accel_unit(Path("a.csv"), still + np.array([0, 0, 16384.0]), None)
    assert guesses.guess_accel_unit(Path("a.csv"), still / 9.8 + [0, 0, 1.0], None).value == "g"


def test_a_foot_that_rarely_stands_has_the_unit_of_where_it_does():
    """A walk with twice gravity at the median, of a foot that stands for a fifth of each second."""
    rng, t = np.random.default_rng(5), np.arange(4000) / 200
    swing = 1.3 * np.stack([np.sin(9 * t), np.cos(11 * t), np.sin(13 * t)], axis=1) * (np.mod(t, 1.0) > 0.2)[:, None]
    accel = 9.8 * (swing + np.array([0.0, 0.0, 1.0])) + rng.normal(0.0, 0.05, (4000, 3))
    assert np.median(np.linalg.norm(accel, axis=1)) > 1.25 * 9.8
    assert guesses.guess_accel_unit(Path("a.csv"), accel, None).value == "m/s2"
    assert guesses.guess_accel_unit(Path("a.csv"), accel / 9.8, None).value == "g"


def test_rates_in_no_unit_are_refused_only_as_counts():
    """A few seconds of motion may agree with anything."""
    lag, rates = motion.Lag(2.3, -0.96, -1.8 + 0.0j), 0.02 * np.random.default_rng(3).normal(size=(500, 3))
    assert guesses.guess_gyro_unit(Path("a.csv"), rates, None, lag, vehicle=True).value == "rad/s"
    with refused("draft.raw_counts", RecordingError, "a.csv"):
        guesses.guess_gyro_unit(Path("a.csv"), np.round(1e4 * rates), None, motion.Lag(0.0, 0.96, 1e4 + 0.0j), True)


def test_white_noise_is_measured():
    rng = np.random.default_rng(2)
    t = np.arange(60000) / 100
    assert estimate_density_in_motion(t, rng.normal(0, 0.02, (60000, 3))) == pytest.approx(0.002, rel=0.25)


@pytest.mark.parametrize("rest", [0.0, 5.0])
def test_noise_of_a_walk_is_that_of_its_sensors_not_of_its_steps(rest):
    """Stances of half a second show it where nothing else does."""
    t = 0.005 * np.arange(1, 8001)
    swing = (t > rest) & (t % 1.1 > 0.5)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        steps = swing[:, None] * rng.normal(0.0, 3.0, (len(t), 3))
        gyro, accel = (s / np.sqrt(0.005) * rng.standard_normal((len(t), 3)) + steps for s in (5e-4, 2e-3))
        found = measure_densities(t, gyro, accel, walks=True)
        assert 0.9 < found["gyro_noise_density"] / 5e-4 < 2.0
        assert 0.9 < found["accel_noise_density"] / 2e-3 < 2.0
    assert measure_densities(t[:40], gyro[:40], accel[:40], walks=True) == {}  # too short


def test_a_walk_is_drafted_with_the_noise_of_its_sensors(tmp_path):
    made = simulate("gait", 1, duration=20.0)
    made.write(tmp_path / "walk")
    noise = tomllib.loads(draft([tmp_path / "walk" / "imu.csv.gz"], tmp_path).text)["imu"]["noise"]
    true = made.recording.imu.noise
    assert 1.0 < noise["gyro_noise_density"] / true.gyro_noise_density < 3.0
    assert 1.0 < noise["accel_noise_density"] / true.accel_noise_density < 3.0


# ---- motion


def test_lag_slope_and_angle_of_planar_vectors():
    rng = np.random.default_rng(4)
    t = np.arange(0, 300, motion.GRID)
    z = motion.compute_moving_mean(rng.normal(size=len(t))) + 1j * motion.compute_moving_mean(rng.normal(size=len(t)))
    late = 0.37
    y = np.interp(t - late, t, z)
    found = motion.find_lag(t, 2.0 * z * np.exp(1j * 0.6), t, y)
    assert found.seconds == pytest.approx(late, abs=0.01)
    assert found.correlation > 0.99
    assert found.slope == pytest.approx(2.0 * np.exp(1j * 0.6), rel=0.02)


def test_lag_of_clocks_that_have_nothing_in_common():
    rng = np.random.default_rng(5)
    t = np.arange(0, 600, motion.GRID)
    x = motion.compute_moving_mean(rng.normal(size=len(t)), 3.0)
    found = motion.find_lag(t, 57.3 * x, t[1000:5000] + 1.7e6, x[1000:5000], anywhere=True)
    assert found.seconds == pytest.approx(1.7e6, abs=0.02)
    assert found.slope == pytest.approx(57.3, rel=1e-3)


def test_level_axes_are_right_handed():
    for up in ([0, 0, 1.0], [0, -1.0, 0], [0.6, 0, 0.8]):
        first, second = find_level_axes(np.array(up))
        assert np.cross(first, second) == pytest.approx(up)


# ---- whole drafts


def write_logs(folder, letters="FLU", gyro=1.0, accel=1.0, time=1.0, gnss_late=0.0, speed=1.0, turn=None):
    """The drive as CSV files of a logger, in other axes and units."""
    folder.mkdir(exist_ok=True)
    R = parse_axes_letters(letters).T if turn is None else turn
    imu, gnss, odometer = DRIVE.imu, DRIVE.gnss, DRIVE.odometer
    table = np.column_stack([imu.t * time, imu.gyro @ R.T * gyro, imu.accel @ R.T * accel])
    head = "Timestamp,GyroX,GyroY,GyroZ,AccX,AccY,AccZ"
    np.savetxt(folder / "imu.csv", table, "%.9g", ",", header=head, comments="")
    table = np.column_stack(
        [gnss.t + gnss_late, np.degrees(gnss.llh[:, :2]), gnss.llh[:, 2], gnss.v * [1, 1, -1], gnss.sd[:, :1]]
    )
    head = "time,latitude,longitude,height,velE,velN,velD,hAcc"
    np.savetxt(folder / "gnss.csv", table, "%.10f", ",", header=head, comments="")
    table = np.column_stack([odometer.t, odometer.speed * speed])
    np.savetxt(folder / "wheel.csv", table, "%.6f", ",", header="time,wheel_speed", comments="")
    return [folder / name for name in ("imu.csv", "gnss.csv", "wheel.csv")]


def drafted(folder, paths):
    found = draft(paths, folder)
    (folder / "recording.toml").write_text(found.text)
    return found, read(folder)


@pytest.mark.parametrize("letters", ["RFU", "BRU", "DFR"])
def test_axes_are_found_in_any_mount(tmp_path, letters):
    found, recording = drafted(tmp_path, write_logs(tmp_path, letters))
    assert f'axes = "{letters}"' in found.text
    assert recording.imu.accel == pytest.approx(DRIVE.imu.accel, abs=1e-6)
    assert recording.imu.gyro == pytest.approx(DRIVE.imu.gyro, abs=1e-7)
    assert recording.gnss.v == pytest.approx(DRIVE.gnss.v, abs=1e-9)  # the file's is down
    assert "time_offset" not in found.text


def test_forces_that_point_down_leave_the_axes_to_be_found_but_for_their_sign(tmp_path):
    """So that what refuses them then names the one key that mends all."""
    found, recording = drafted(tmp_path, write_logs(tmp_path, "RFU", accel=-1.0))
    assert 'axes = "RBD"' in found.text
    assert [f.key for f in inspect(recording).findings if f.severity == "refused"] == ["gnss.mirrored"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: ["time [s],latitude [deg],longitude [deg],height [m]", *rows[1:]], None),
        (lambda rows: ["time_s,latitude_deg,longitude_deg,height_m", "[s],[deg],[deg],[m]", *rows[1:]], "units"),
        (lambda rows: [rows[0], *(row.replace("-", "\u2212") for row in rows[1:])], "minus"),
        (lambda rows: [rows[0], *(re.sub(r",(\d)(\d{3})\.", r",\1'\2.", row) for row in rows[1:])], "thousands"),
    ],
)
def test_numbers_and_units_in_other_spellings_are_the_same_fixes(change, words, tmp_path):
    rows = [f"{t:.1f},{-35.5 + 1e-6 * t:.9f},{-2.25 - 2e-6 * t:.9f},{1200 + 0.01 * t:.2f}" for t in range(300)]
    plain = ["time,latitude,longitude,height", *rows]
    found = []
    for name, lines in (("a.csv", plain), ("b.csv", change(plain))):
        (tmp_path / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
        found.append(read_log(tmp_path / name)["gnss"])
    assert {x: v.tolist() for x, v in found[0].values.items()} == {x: v.tolist() for x, v in found[1].values.items()}
    assert (found[1].plain is not None and words in found[1].plain.words) if words else found[1].plain is None


def test_dates_in_utc_by_name(tmp_path):
    rows = [f"2025-07-08 16:00:{t:02d} UTC,35.5,139.7,40.0" for t in range(60)]
    (tmp_path / "a.csv").write_text("\n".join(["time,lat,lon,h", *rows]) + "\n")
    source = read_log(tmp_path / "a.csv")["gnss"]
    assert source.t[0] == 1751990400.0
    assert "CHECK" not in source.plain.words


@pytest.mark.parametrize("data", [b"", bytes(range(256)) * 20, b"<!DOCTYPE html>\n<html>404, gone\n"])
def test_a_named_file_that_cannot_be_read_is_not_left_out(data, tmp_path):
    """Though the other logs make a drive."""
    imu, gnss, wheel = write_logs(tmp_path)
    gnss.write_bytes(data)
    with pytest.raises(RecordingError) as caught:
        draft([imu, gnss, wheel], tmp_path)
    assert str(caught.value).startswith(f"{gnss}: ")


def test_a_named_file_that_is_no_table_is_not_left_out_of_a_drive(tmp_path):
    """Else an IMU beside fixes that are not read would become a walk."""
    imu, *_ = write_logs(tmp_path)
    other = tmp_path / "inspva.log"
    other.write_text("<INSPVAX COM1 0 73.5 FINESTEERING 2130 345600.000\n< 35.6 139.7\n" * 9)
    with refused("draft.positions_unread", RecordingError, "inspva.log"):
        draft([imu, other], tmp_path)


def test_a_tilted_mount_gets_two_vectors(tmp_path):
    turn = exp(np.array([0.3, 0.2, 0.5]))
    found, recording = drafted(tmp_path, write_logs(tmp_path, turn=turn))
    assert "forward = [" in found.text
    error = recording.imu.R_bs @ turn  # body from body: nearly nothing
    # the mean force leans with the road and the driver's braking; the forward axis with the side slip
    assert np.degrees(np.arccos((np.trace(error) - 1) / 2)) < 3.0


def test_units_are_found_by_their_size_and_checked_by_the_fixes(tmp_path):
    paths = write_logs(tmp_path, gyro=180 / np.pi, accel=1 / 9.80665, time=1e6, speed=3.6)
    found, recording = drafted(tmp_path, paths)
    assert 'units = { t = "us", gyro = "deg/s", accel = "g" }' in found.text
    assert 'units = { speed = "km/h" }' in found.text
    assert recording.imu.gyro == pytest.approx(DRIVE.imu.gyro, abs=1e-7)
    assert recording.odometer.speed == pytest.approx(DRIVE.odometer.speed, abs=1e-5)


def test_late_fixes_are_seen(tmp_path):
    _, recording = drafted(tmp_path, write_logs(tmp_path, gnss_late=0.4))
    assert recording.gnss.t == pytest.approx(DRIVE.gnss.t, abs=0.03)


@pytest.mark.parametrize("name", ["alt_ft", "Altitude (ft)", "height[feet]"])
def test_heights_in_feet_by_the_name_of_their_column_are_read_as_metres(tmp_path, name):
    logs_there = write_logs(tmp_path)
    head, *rows = logs_there[1].read_text().splitlines()
    cells = [row.split(",") for row in rows]
    rows = [",".join([*c[:3], f"{float(c[3]) / 0.3048:.5f}", *c[4:]]) for c in cells]
    logs_there[1].write_text("\n".join([head.replace("height", name), *rows]) + "\n")
    _, recording = drafted(tmp_path, logs_there)
    np.testing.assert_allclose(recording.gnss.llh[:, 2], DRIVE.gnss.llh[:, 2], atol=1e-3)


def test_fixes_that_are_all_nowhere_are_no_fixes(tmp_path, capsys):
    imu, gnss, _ = write_logs(tmp_path)
    head, *rows = gnss.read_text().splitlines()
    gnss.write_text("\n".join([head, *(f"{r.split(',')[0]},0,0,{r.split(',', 3)[3]}" for r in rows)]) + "\n")
    refuse_command(capsys, "draft.no_fix", "init", str(imu), str(gnss), "-o", str(tmp_path / "a.toml"))


def test_clocks_that_have_nothing_in_common_are_brought_together(tmp_path):
    _, recording = drafted(tmp_path, write_logs(tmp_path, gnss_late=1.6e9))
    assert recording.gnss.t == pytest.approx(DRIVE.gnss.t, abs=0.03)


def test_a_phone_with_a_file_per_sensor(tmp_path, capsys):
    imu, gnss = DRIVE.imu, DRIVE.gnss
    ns = 1.6e18 + np.round(imu.t * 1e9)
    for name, values, shift in (("Gyroscope", imu.gyro, 0.0), ("TotalAcceleration", imu.accel, 0.004)):
        at = np.column_stack([np.interp(imu.t + shift, imu.t, x) for x in values.T])
        table = np.column_stack([ns, imu.t + shift, at[:, ::-1]])
        np.savetxt(tmp_path / f"{name}.csv", table, "%.9g", ",", header="time,seconds_elapsed,z,y,x", comments="")
    speed, course = np.hypot(*gnss.v[:, :2].T), np.degrees(np.arctan2(gnss.v[:, 0], gnss.v[:, 1])) % 360
    table = np.column_stack([gnss.t, np.degrees(gnss.llh[:, :2]), gnss.llh[:, 2], speed, course, gnss.sd[:, [0, 2]]])
    head = "seconds_elapsed,latitude,longitude,altitude,speed,bearing,horizontalAccuracy,verticalAccuracy"
    np.savetxt(tmp_path / "Location.csv", table, "%.10f", ",", header=head, comments="")
    files = [str(tmp_path / f"{n}.csv") for n in ("Gyroscope", "TotalAcceleration", "Location")]
    assert cli.run(["init", *files, "-o", str(tmp_path / "recording.toml")]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("joined_imu.csv.gz", "Gyroscope.csv", "TotalAcceleration.csv"))
    recording = read(tmp_path)
    assert recording.imu.gyro == pytest.approx(DRIVE.imu.gyro[1 : len(recording.imu.t) + 1], abs=1e-6)
    assert recording.gnss.v[:, :2] == pytest.approx(gnss.v[:, :2], abs=1e-6)
    refuse_command(capsys, "output.exists", "init", *files, "-o", tmp_path / "recording.toml")
    assert cli.run(["init", *files, "-o", str(tmp_path / "ride.toml"), "--force"]) == 0
    assert (recording.name, read(tmp_path / "ride.toml").name) == (tmp_path.name, "ride")


def test_logs_of_other_programs_are_joined(tmp_path):
    recording, truth = logs.simulated(100.0)
    logs.write_kf_gins(tmp_path, recording, truth)
    logs.write_nmea(tmp_path / "ride.nmea", recording)
    (whole := tmp_path / "whole").mkdir()
    assert "lever_arm = [0.3000, 0.5000, 1.2000]" in draft([tmp_path], whole).text  # the configuration's
    found = draft([tmp_path / "imu.txt", tmp_path / "ride.nmea"], tmp_path)
    (tmp_path / "recording.toml").write_text(found.text)
    read_back = read(tmp_path)
    assert read_back.imu.gyro == pytest.approx(recording.imu.gyro, abs=1e-9)
    assert read_back.gnss.t == pytest.approx(logs.TOW + recording.gnss.t, abs=0.03)


@pytest.mark.parametrize(
    ("text", "key", "names"),
    [
        ("time,temperature\n0,1\n1,2\n", "draft.no_columns", ("a.csv, line 1", "time, temperature")),
        ("t,lat,lon,h\n0,1,2,3\n1,1,2,3\n", "draft.no_imu", ("gnss",)),
        ("t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,x\n", "table.cell", ("a.csv, line 2", "'az'", "'x'")),
        ("t,gx,gy,gz,ax,ay,az\n0,,0,0,0,0,1\n", "table.few_rows", ("a.csv",)),
        ("1,2,3\n4,5,6\n", "table.no_header", ("a.csv, line 1",)),
    ],
)
def test_logs_that_cannot_be_drafted_say_why(tmp_path, text, key, names):
    (tmp_path / "a.csv").write_text(text)
    with refused(key, RecordingError, *names):
        draft([tmp_path / "a.csv"], tmp_path)


# ---- real logs, as they came


def test_a_folder_is_drafted_as_its_files_are(shared_data, tmp_path):
    """None of them is taken for what an earlier draft made, and what that made is none of them."""
    names = ("imu.csv.gz", "gnss.csv.gz")
    for name in names:
        shutil.copy(shared_data / "boulder_drive_20250708" / name, tmp_path / name)
    of_files = draft([tmp_path / name for name in names], tmp_path).text
    assert draft([tmp_path], tmp_path).text == of_files


@pytest.mark.parametrize(
    ("name", "axes", "gnss_offset"),
    [("tokyo_20201105", "RFU", 0.0), ("boulder_drive_20250708", "BRU", 0.2), ("dresden_car_20140326", "FLU", -0.55),
     ("comma_highway_20180802", "FRD", -0.13)],
)  # fmt: skip
def test_real_logs_get_the_axes_and_clocks_that_are_known(shared_data, tmp_path, name, axes, gnss_offset):
    folder = shared_data / name
    paths = [folder / file for file in ("imu.csv.gz", "gnss.csv.gz", "odo.csv.gz") if (folder / file).exists()]
    text = draft(paths, tmp_path).text
    (tmp_path / "recording.toml").write_text(text)
    found, known = read(tmp_path, allow_outside=True), read(folder)
    assert f'axes = "{axes}"' in text
    assert np.array_equal(found.imu.R_bs, known.imu.R_bs)
    raw = float(np.loadtxt(folder / "gnss.csv.gz", delimiter=",", skiprows=1, max_rows=1, usecols=0))
    assert found.gnss.t[0] - raw == pytest.approx(gnss_offset, abs=0.25)
    if known.odometer is not None:
        assert found.odometer.t[0] == pytest.approx(known.odometer.t[0], abs=0.06)


@pytest.mark.parametrize(
    ("name", "pressure", "unit"),
    [
        ("pressure", 1013.2, "hPa"),
        ("pressure", 650.0, "hPa"),
        ("baro", 100900.0, "Pa"),
        ("pressure", 98.7, "kPa"),
        ("pressure", 29.92, "inHg"),
        ("air_pressure_mbar", 990.0, "mbar"),
        ("pressure", 2.4, None),
        ("tire_pressure", 1013.2, None),
    ],
)
def test_the_pressure_of_the_air_in_its_units(name: str, pressure: float, unit: str | None, tmp_path: Path) -> None:
    imu, air = tmp_path / "imu.csv", tmp_path / "air.csv"
    t = np.arange(0.0, 20.0, 0.01)
    np.savetxt(imu, np.column_stack([t, np.tile([0.0, 0.0, 0.1, 0.0, 0.0, 9.81], (len(t), 1))]), "%.6g", ",",
               header="t,gx,gy,gz,ax,ay,az", comments="")  # fmt: skip
    np.savetxt(air, np.column_stack([t[::100], np.full(20, pressure)]), "%.6g", ",", header=f"t,{name}", comments="")
    made = tomllib.loads(draft([imu, air], tmp_path).text)
    assert made.get("barometer", {}).get("units", {}).get("pressure", "Pa") == (unit or "Pa")
    assert ("barometer" in made) == (unit is not None)


@pytest.mark.parametrize(("speed", "platform", "unit"), [(1.2, "foot", "rad/s"), (12.0, "vehicle", "deg/s")])
def test_fixes_that_walk_beside_a_shoes_imu_are_of_a_walk(shared_data, tmp_path, speed, platform, unit):
    """Rates of a swing are no deg/s then; nothing else that moves so slowly is shaken as much."""
    imu = read(shared_data / "openshoe_loops" / "run02.toml").imu
    rows = np.column_stack([imu.t, imu.gyro, imu.accel])
    np.savetxt(tmp_path / "imu.csv", rows, "%.9g", ",", header="t,gx,gy,gz,ax,ay,az", comments="")
    t = np.arange(1.0, 60.0)
    fixes = np.column_stack([t, 50.0 + speed * t / 111_200.0, np.full((len(t), 2), [8.0, 100.0])])
    np.savetxt(tmp_path / "gnss.csv", fixes, "%.9f", ",", header="t,lat,lon,h", comments="")
    found = tomllib.loads(draft([tmp_path], tmp_path).text)
    assert found["platform"] == platform
    assert found["imu"].get("units", {}).get("gyro", "rad/s") == unit
