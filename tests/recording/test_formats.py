"""Other programs' logs: what is read is what was driven, and bad input says which file and line."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import logs
import numpy as np
import pytest
from helpers import assert_told, refused, same_recording
from test_bad_input import write_small

from graphnav.app import convert
from graphnav.core.errors import ConfigError, RecordingError
from graphnav.core.timescales import count_leap_seconds, format_clock, gps_to_utc, parse_clock, unix_to_gps, utc_to_gps
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.recording.formats import load, read
from graphnav.recording.formats.writer import convert_to_degrees, write_recording

RECORDING, TRUTH = logs.simulated()


# ---- clocks


def test_leap_seconds_and_gps_time_of_known_dates():
    # GPS week 2200 began on 6 March 2022, 0:00 GPS time, 18 s before midnight UTC
    t = utc_to_gps(np.array(["2022-03-05T23:59:42", "1980-01-06T00:00:00"], "datetime64[us]"))
    assert t.tolist() == [2200 * 604800.0, 0.0]
    assert unix_to_gps(np.array([1646524782.0])).tolist() == [2200 * 604800.0]
    dates = np.array(["2016-12-31T23:59:59", "2017-01-01", "2005-06-01", "1999-08-22"], "datetime64[us]")
    assert count_leap_seconds(dates).tolist() == [17, 18, 13, 13]
    back = gps_to_utc(utc_to_gps(dates))
    assert (back == dates).all()


@pytest.mark.parametrize("words", ["gps week 2200", "2024-05-01T12:00:00.000000Z"])
def test_clock_words_there_and_back(words):
    assert format_clock(parse_clock(words, 0.0)) == words


def test_unix_clock_takes_the_leap_seconds_of_its_time():
    assert parse_clock("unix", 1646524782.0) + 1646524782.0 == 2200 * 604800.0
    assert format_clock(parse_clock("unix", 1646524782.0)) == "unix"
    with pytest.raises(ValueError, match='"unix"'):  # the words there are
        parse_clock("week 2200", 0.0)


# ---- KF-GINS and OB_GINS


@pytest.fixture
def kf_gins(tmp_path):
    return logs.write_kf_gins(tmp_path / "dataset", RECORDING, TRUTH)


def test_kf_gins_increments_become_rates_with_its_noise_lever_arm_and_truth(kf_gins):
    found = read(kf_gins / "kf-gins.yaml")
    assert found.imu.t == pytest.approx(logs.TOW + RECORDING.imu.t, abs=1e-9)
    assert found.imu.gyro == pytest.approx(RECORDING.imu.gyro, abs=1e-9)
    assert found.imu.accel == pytest.approx(RECORDING.imu.accel, abs=1e-7)
    assert found.gnss.llh == pytest.approx(RECORDING.gnss.llh, abs=1e-12)
    assert found.gnss.sd == pytest.approx(RECORDING.gnss.sd)
    assert found.gnss.lever_arm == pytest.approx(logs.LEVER_ARM)
    noise = found.imu.noise
    assert noise.gyro_noise_density == pytest.approx(2.90888e-5, rel=1e-5)  # 0.1 deg/sqrt(h)
    assert noise.accel_noise_density == pytest.approx(0.2 / 60)
    assert noise.gyro_bias_sigma == pytest.approx(1.21203e-4, rel=1e-5)  # 25 deg/h
    assert noise.accel_bias_sigma == pytest.approx(2e-3)  # 200 mGal
    assert noise.gyro_bias_walk == pytest.approx(1.21203e-4 * np.sqrt(2 / 14400), rel=1e-5)
    assert noise.gyro_scale_sigma == pytest.approx(3e-4)
    assert not found.imu.noise_assumed
    assert found.truth.rph == pytest.approx(TRUTH.rph, abs=1e-9)
    assert found.truth.v == pytest.approx(TRUTH.v, abs=1e-9)
    assert found.gps_zero == logs.WEEK * 604800.0  # the truth's first column
    assert_told(found.remarks, "log.span_not_used", "starttime")


def test_kf_gins_folder_finds_its_configuration_and_binary_rows_are_the_same(kf_gins):
    found = read(kf_gins)
    table = np.loadtxt(kf_gins / "imu.txt")
    table.astype("<f8").tofile(kf_gins / "imu.bin")
    (kf_gins / "imu.txt").unlink()
    config = kf_gins / "kf-gins.yaml"
    config.write_text(config.read_text().replace("imu.txt", "imu.bin"))
    assert np.array_equal(read(kf_gins).imu.gyro, found.imu.gyro)


def test_kf_gins_files_without_a_configuration(kf_gins):
    (kf_gins / "kf-gins.yaml").unlink()
    found = read(kf_gins)
    assert found.imu.noise_assumed
    assert not found.gnss.lever_arm.any()
    assert_told(found.remarks, "log.no_configuration")
    alone = load(kf_gins / "gnss.txt")
    assert alone.imu is None
    with refused("log.no_imu", RecordingError, "gnss.txt", "graphnav init"):
        read(kf_gins / "gnss.txt")


def test_ob_gins_names_its_keys_otherwise_and_has_a_wheel(tmp_path):
    folder = logs.write_kf_gins(tmp_path / "dataset", RECORDING, TRUTH, odometer=True)
    text = (folder / "kf-gins.yaml").read_text()
    text = text.replace("imupath", "imufile").replace("gnsspath", "gnssfile").replace("imunoise", "imumodel")
    text = text.replace("[0.1, 0.1, 0.1]", "0.1").replace("[0.2, 0.2, 0.2]", "0.2")
    (folder / "kf-gins.yaml").unlink()
    (folder / "ob_gins.yaml").write_text(text + "odolever: [ -0.64, -0.628, 2.122 ]\nbodyangle: [ 0, -0.30, -1.09 ]\n")
    found = read(folder / "ob_gins.yaml")
    assert found.odometer.speed == pytest.approx(RECORDING.odometer.speed, abs=1e-9)
    assert found.odometer.lever_arm == pytest.approx([-0.628, -0.64, -2.122])
    assert found.imu.noise.gyro_noise_density == pytest.approx(2.90888e-5, rel=1e-5)
    assert_told(found.remarks, "log.body_angle_not_used", "bodyangle")


def test_kf_gins_increments_after_a_gap_are_those_of_one_period(kf_gins):
    lines = (kf_gins / "imu.txt").read_text().splitlines()
    (kf_gins / "imu.txt").write_text("\n".join(lines[:100] + lines[150:]) + "\n")
    found = read(kf_gins)
    assert found.imu.accel[100] == pytest.approx(RECORDING.imu.accel[150], abs=1e-7)
    assert_told(found.remarks, "imu.increments_after_gap", "1")


@pytest.mark.parametrize(
    ("file", "old", "new", "key", "names"),
    [
        ("kf-gins.yaml", "imu.txt", "absent.txt", "file.missing", ["imupath", "dataset/absent.txt"]),
        ("kf-gins.yaml", "arw: [0.1, 0.1, 0.1]", "arw: fast", "yaml.value", ["arw", "'fast'"]),
        ("kf-gins.yaml", "corrtime: 4.0", "corr: 4.0", "yaml.value", ["corrtime"]),
        ("kf-gins.yaml", "imunoise:", "noise:", "yaml.table", ["imunoise"]),
        ("kf-gins.yaml", "antlever: [", "antlever: [ 1,", "yaml.value", ["antlever"]),
        ("kf-gins.yaml", "endtime: -1", "endtime: [", "yaml.syntax", ["line "]),
        ("imu.txt", "345610.02 ", "345610.02 x", "table.cell", ["line 2", "dtheta_x", "'x"]),
        ("imu.txt", "345610.04 ", "345610.01 ", "table.time_order", ["345610.01"]),
        ("gnss.txt", "345611.0", "345611.0 1.0", "table.fields", ["line 2"]),
    ],
)  # fmt: skip
def test_bad_kf_gins_input_says_where(kf_gins, file, old, new, key, names):
    text = (kf_gins / file).read_text()
    assert old in text
    (kf_gins / file).write_text(text.replace(old, new, 1))
    with refused(key, RecordingError, file, *names):
        read(kf_gins / "kf-gins.yaml")


# ---- RTKLIB


@pytest.mark.parametrize("scale", ["GPST", "UTC"])
def test_rtklib_fixes_in_gps_time_with_velocities(tmp_path, scale):
    log = load(logs.write_rtklib(tmp_path / "a.pos", RECORDING, scale))
    assert log.gps_zero == logs.WEEK * 604800.0
    assert log.gnss.t == pytest.approx(logs.TOW + RECORDING.gnss.t, abs=1e-6)
    assert log.gnss.llh == pytest.approx(RECORDING.gnss.llh, abs=1e-10)
    assert log.gnss.v == pytest.approx(RECORDING.gnss.v, abs=1e-6)
    assert log.gnss.sd == pytest.approx(RECORDING.gnss.sd)
    assert log.gnss.sd_v == pytest.approx(RECORDING.gnss.sd_v)


# ---- KITTI


def test_kitti_raw_folder(tmp_path):
    recording, truth = logs.simulated(12.0)
    folder = logs.write_kitti(tmp_path, recording, truth)
    for source in (folder, folder / "oxts", tmp_path):
        found = read(source)
    assert found.imu.gyro == pytest.approx(recording.imu.gyro, abs=1e-12)
    assert found.imu.accel == pytest.approx(recording.imu.accel, abs=1e-12)
    assert found.imu.t - found.imu.t[0] == pytest.approx(recording.imu.t - recording.imu.t[0], abs=1e-5)
    at = np.searchsorted(truth.t, recording.imu.t - 1e-9)
    assert found.truth.rph == pytest.approx(truth.rph[at], abs=1e-12)
    assert found.truth.v == pytest.approx(truth.v[at], abs=1e-12)
    assert len(found.gnss.t) == 13
    assert np.diff(found.gnss.t) == pytest.approx(1.0, abs=1e-6)
    assert found.gnss.sd == pytest.approx(0.05)


def test_bad_kitti_input_says_where(tmp_path):
    recording, truth = logs.simulated(2.0)
    folder = logs.write_kitti(tmp_path, recording, truth) / "oxts"
    row = folder / "data" / "0000000007.txt"
    good = row.read_text()
    row.write_text(good.replace(" 0.05 ", " high ", 1))
    with refused("table.cell", RecordingError, "0000000007.txt, line 1", "'high'"):
        read(folder)
    row.write_text(good.rsplit(" ", 2)[0])
    with refused("table.fields", RecordingError, "0000000007.txt, line 1", "28", "30"):
        read(folder)
    row.unlink()
    with refused("log.files_missing", RecordingError, "101", "100"):
        read(folder)
    stamps = (folder / "timestamps.txt").read_text()
    (folder / "timestamps.txt").write_text(stamps.replace("2011-09-30 12:41:09.0", "yesterday", 1))
    with refused("table.date", RecordingError, "timestamps.txt, line 1", "'yesterday"):
        read(folder)


# ---- NMEA


def test_nmea_epochs_are_put_together(tmp_path):
    log = load(logs.write_nmea(tmp_path / "a.nmea", RECORDING))
    assert log.gps_zero == logs.WEEK * 604800.0
    # the drive begins 18 s before midnight UTC: the date turns on the way
    assert log.gnss.t == pytest.approx(logs.TOW + RECORDING.gnss.t, abs=1e-6)
    assert log.gnss.llh[:, :2] == pytest.approx(RECORDING.gnss.llh[:, :2], abs=3e-11)
    assert log.gnss.llh[:, 2] == pytest.approx(RECORDING.gnss.llh[:, 2], abs=6e-4)
    assert log.gnss.sd == pytest.approx(RECORDING.gnss.sd)
    assert log.gnss.v[:, :2] == pytest.approx(RECORDING.gnss.v[:, :2], abs=1e-4)
    assert (log.gnss.v[:, 2] == 0).all()
    assert (log.gnss.sd_v[:, 2] >= 0.4).all()


def test_nmea_without_gst_or_date_says_what_is_assumed(tmp_path):
    path = logs.write_nmea(tmp_path / "a.nmea", RECORDING, gst=False)
    log = load(path)
    assert log.gnss.sd[:, 0] == pytest.approx(0.02 * 0.8)  # fixed, HDOP 0.8
    assert_told(log.remarks, "gnss.sigma_of_hdop")
    path.write_text("".join(line for line in path.read_text().splitlines(True) if "RMC" not in line))
    log = load(path)
    assert log.gps_zero is None
    assert log.gnss.v is None
    assert log.gnss.t == pytest.approx(86382.0 + RECORDING.gnss.t, abs=1e-6)
    assert_told(log.remarks, "log.clock_unknown")


def test_broken_nmea_lines_are_skipped_and_named(tmp_path):
    path = logs.write_nmea(tmp_path / "a.nmea", RECORDING)
    lines = path.read_text().splitlines(True)
    lines[3] = lines[3].replace(",4,12,", ",4,13,")  # GGA of the second fix: its checksum no longer fits
    lines.insert(1, "\x00\x7fnoise\n")
    path.write_text("".join(lines))
    log = load(path)
    assert len(log.gnss.t) == len(RECORDING.gnss.t) - 1
    assert_told(log.remarks, "log.broken_lines", "line 2")
    path.write_text("".join(line.replace("*", "*0") for line in lines))
    with refused("log.no_positions", RecordingError, "a.nmea, line 1", "GGA"):
        load(path)


def test_nmea_without_any_checksum_is_read_as_that_with_them(tmp_path):
    path = logs.write_nmea(tmp_path / "a.nmea", RECORDING)
    log, text = load(path), path.read_text()
    path.write_text(re.sub(r"\*..\n", "\r\n", text)[:-30])  # the last sentence, an RMC, is cut off
    bare = load(path)
    assert np.array_equal(bare.gnss.t, log.gnss.t)
    assert np.array_equal(bare.gnss.llh, log.gnss.llh)
    assert np.array_equal(bare.gnss.v[:-1], log.gnss.v[:-1])
    assert np.isnan(bare.gnss.v[-1]).all()
    assert_told(bare.remarks, "log.no_checksums")
    path.write_text(text.replace("*", "", 1))  # one of many is missing: damage
    assert len(load(path).gnss.t) == len(log.gnss.t) - 1


@pytest.mark.parametrize(
    ("gga", "said"),
    [
        ("$GPGGA,125106,3854.5087,N,07726.4523,W,8,10,2.0,268.8,M,-33.9,M,,*7F", "1 by dead reckoning"),
        ("$GPGGA,001901.00,,,,,0,00,99.99,,,,,,*6F", "1 GGA sentence"),
        ("$GPGGA,112257.00,3844.24011,N,00908.43828,W,1,03,10.5,,,,,,*72", "height"),
    ],
)
def test_nmea_without_a_measured_position_says_why(tmp_path, gga, said):
    path = tmp_path / "a.nmea"
    path.write_text(f"{gga}\r\n")
    with refused("log.no_positions", RecordingError, "a.nmea", said):
        load(path)


# ---- a recording.toml that names other programs' logs


def test_a_recording_may_name_logs_of_other_programs(tmp_path, kf_gins):
    logs.write_nmea(kf_gins / "ride.nmea", RECORDING)
    (kf_gins / "recording.toml").write_text(
        'format = "graphnav-recording/1"\nplatform = "vehicle"\n[imu]\nfile = "imu.txt"\n'
        '[gnss]\nfile = "ride.nmea"\nlever_arm = [0.1, 0.2, 0.3]\ntime_offset = 0.5\nsd = [1.0, 2.0, 3.0]\n'
        '[truth]\nfile = "truth.nav"\n'
    )
    found = read(kf_gins)
    assert found.imu.gyro == pytest.approx(RECORDING.imu.gyro, abs=1e-9)
    assert found.gnss.t == pytest.approx(logs.TOW + 0.5 + RECORDING.gnss.t, abs=1e-6)
    assert found.gps_zero == logs.WEEK * 604800.0 - 0.5  # the fixes' clock, as it was shifted
    assert found.gnss.lever_arm.tolist() == [0.1, 0.2, 0.3]
    assert found.gnss.sd[0].tolist() == [1.0, 2.0, 3.0]
    assert found.truth.rph == pytest.approx(TRUTH.rph, abs=1e-9)
    text = (kf_gins / "recording.toml").read_text()
    (kf_gins / "recording.toml").write_text(text.replace('"ride.nmea"', '"ride.nmea"\ncolumns = { t = "time" }'))
    with refused("key.not_here", RecordingError, "'gnss.columns'"):
        read(kf_gins)
    (kf_gins / "recording.toml").write_text(text.replace("ride.nmea", "imu.txt"))
    with refused("log.no_sensor", RecordingError, "'gnss.file'", "imu.txt"):
        read(kf_gins)


# ---- writing a recording


def test_degrees_are_those_the_radians_came_from():
    rng = np.random.default_rng(5)
    for digits in (7, 9, 11):
        written = np.round(rng.uniform(-180, 180, 2000), digits)
        assert np.array_equal(convert_to_degrees(written * (np.pi / 180)), written)
    anything = rng.uniform(-np.pi, np.pi, 2000)
    assert np.abs(convert_to_degrees(anything) * (np.pi / 180) - anything).max() <= 4.5e-16


def test_converted_logs_read_back_the_same(tmp_path, kf_gins):
    for source in (kf_gins, "kitti"):
        _, files = convert.convert_log(str(source), tmp_path / "out", None)
        assert files[0].name == "recording.toml"
        # the built-in drive's positions were metres, which no degrees hit on the last bit
        same_recording(read(tmp_path / "out"), read(source), angle=4.5e-16 if source == "kitti" else 0.0)
        shutil.rmtree(tmp_path / "out")


def test_clock_and_blank_values_survive(tmp_path):
    log = load(logs.write_nmea(tmp_path / "a.nmea", RECORDING))
    v = log.gnss.v.copy()
    v[3] = np.nan
    log = replace(log, imu=replace(RECORDING.imu, t=RECORDING.imu.t + logs.TOW), gnss=replace(log.gnss, v=v))
    write_recording(log, tmp_path / "out")
    found = read(tmp_path / "out")
    assert found.gps_zero == logs.WEEK * 604800.0
    assert np.isnan(found.gnss.v[3]).all()
    assert np.array_equal(found.gnss.v[4:], v[4:])
    assert 'clock = "gps week 2200"' in (tmp_path / "out" / "recording.toml").read_text()


def test_a_log_without_imu_becomes_a_folder_that_says_what_is_missing(tmp_path):
    log, _ = convert.convert_log(str(logs.write_nmea(tmp_path / "a.nmea", RECORDING)), tmp_path / "out", None)
    assert log.imu is None
    assert "IMU" in convert.log_text(log, [])
    with refused("file.missing", RecordingError, "imu.csv"):
        read(tmp_path / "out")


def test_a_recording_is_not_written_over_itself(tmp_path, kf_gins):
    convert.convert_log(str(kf_gins), tmp_path / "out", None)
    with refused("output.is_input", ConfigError):
        convert.convert_log(str(tmp_path / "out"), tmp_path / "out", None)


def test_another_recording_is_not_written_over_unasked(tmp_path, kf_gins):
    out, described = tmp_path / "out", tmp_path / "out" / "recording.toml"
    convert.convert_log(str(kf_gins), out, None)
    convert.convert_log(str(kf_gins), out, None)
    described.write_text(described.read_text() + "# measured by hand\n")
    before = {file: file.read_bytes() for file in out.iterdir()}
    with refused("output.exists", ConfigError, "recording.toml"):
        convert.convert_log("kitti", out, None)
    assert {file: file.read_bytes() for file in out.iterdir()} == before
    convert.convert_log("kitti", out, None, force=True)
    assert "by hand" not in described.read_text()


def test_unknown_formats_and_files_say_what_is_known(tmp_path):
    (tmp_path / "a.txt").write_text("hello\n")
    with refused("recording.none", RecordingError, "a.txt", "kf-gins"):
        load(tmp_path / "a.txt")
    with refused("log.format_unknown", RecordingError, "--format nmae", "'nmea'"):
        load(tmp_path / "a.txt", "nmae")
    with refused("log.no_positions", RecordingError, "a.txt, line 1"):
        load(tmp_path / "a.txt", "nmea")


def test_real_recordings_convert_unchanged(shared_data, tmp_path):
    for name in (
        "tokyo_20201105",
        "comma_highway_20180802",
        "openshoe_loops/run02.toml",
        "pyshoe_vicon/2018-02-09-11-32-01.toml",
    ):
        convert.convert_log(str(shared_data / name), tmp_path / name, None)
        same_recording(read(tmp_path / name), read(shared_data / name))


@pytest.fixture(scope="module")
def cut_sources(tmp_path_factory):
    """A log of every text form."""
    folder = tmp_path_factory.mktemp("whole")
    logs.write_kf_gins(folder / "kf", RECORDING, TRUTH)
    return [
        folder / "kf" / "imu.txt", folder / "kf" / "gnss.txt", folder / "kf" / "kf-gins.yaml",
        logs.write_rtklib(folder / "a.pos", RECORDING), logs.write_nmea(folder / "a.nmea", RECORDING),
        logs.write_novatel(folder / "a.log", RECORDING, TRUTH), logs.write_gnsslogger(folder / "a.txt", RECORDING),
    ]  # fmt: skip


@pytest.mark.parametrize("share", [0.0, 0.013, 0.31, 0.777, 0.99])
@pytest.mark.parametrize("which", range(7), ids=["imu", "gnss", "yaml", "pos", "nmea", "novatel", "gnsslogger"])
def test_a_file_that_is_cut_off_is_read_to_there_or_refused_in_a_line(cut_sources, tmp_path, which, share):
    whole = cut_sources[which]
    path = shutil.copytree(whole.parent, tmp_path / "cut") / whole.name
    data = whole.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    name = ("kf-gins", "kf-gins", "kf-gins", "rtklib", "nmea", "novatel", "gnsslogger")[which]
    log, refusal = None, ""
    try:
        log = load(path, name)
    except RecordingError as error:
        refusal = str(error)
    if log is None:
        assert path.name in refusal
        assert "\n" not in refusal
    else:
        sensor = log.imu if which in (0, 5, 6) else log.gnss
        assert 0 < len(sensor.t) <= len(RECORDING.imu.t)


def test_satellites_are_read_and_kept(tmp_path):
    recording, _ = logs.simulated(20.0)
    fixes = zip(recording.gnss.t, recording.gnss.llh, recording.gnss.v, strict=True)
    ubx = tmp_path / "a.ubx"
    ubx.write_bytes(b"".join(logs.nav_pvt(logs.WEEK * 604800.0 + logs.TOW + t, llh, v) for t, llh, v in fixes))
    kept = []
    for path, many in (
        (logs.write_nmea(tmp_path / "a.nmea", recording), 12), (logs.write_rtklib(tmp_path / "a.pos", recording), 20),
        (ubx, 18),
    ):  # fmt: skip
        log = load(path)
        assert (log.gnss.satellites == many).all(), path
        kept.append(replace(log, imu=replace(recording.imu, t=logs.TOW + recording.imu.t)))
    write_recording(kept[0], tmp_path / "out")
    assert (read(tmp_path / "out").gnss.satellites == 12).all()
    part = read(tmp_path / "out").crop(5.0, 10.0).gnss
    assert len(part.satellites) == len(part.t) > 3


def test_residuals_are_read_and_kept(tmp_path):
    """Under the names that they have, blanks as unknown; in a part of the recording, and written again."""
    folder = write_small(tmp_path)
    rows = (folder / "gnss.csv").read_text().splitlines()
    more = ["nsat,resid_rms_m", "9,0.75", ",", "12,21.5", "4,0", "11,"]
    (folder / "gnss.csv").write_text("\n".join(f"{row},{x}" for row, x in zip(rows, more, strict=True)) + "\n")
    recording = read(folder)
    gnss = recording.gnss
    np.testing.assert_array_equal(gnss.residual_rms, [0.75, np.nan, 21.5, 0.0, np.nan])
    np.testing.assert_array_equal(gnss.satellites, [9.0, np.nan, 12.0, 4.0, 11.0])
    np.testing.assert_array_equal(recording.crop(0.3, 0.7).gnss.residual_rms, [21.5, 0.0])
    assert (pick_fixes(gnss, np.array([2])).residual_rms == [21.5]).all()
    write_recording(recording, tmp_path / "out")
    again = read(tmp_path / "out").gnss
    np.testing.assert_array_equal(again.residual_rms, gnss.residual_rms)
    np.testing.assert_array_equal(again.satellites, gnss.satellites)


@pytest.mark.parametrize("value", ["-0.5", "much", "1e999"])
def test_residuals_that_are_none_are_one_line(tmp_path, value):
    folder = write_small(tmp_path)
    rows = (folder / "gnss.csv").read_text().splitlines()
    rows = [f"{rows[0]},resid_rms_m", *(f"{row},0.8" for row in rows[1:3]), f"{rows[3]},{value}"]
    (folder / "gnss.csv").write_text("\n".join(rows) + "\n")
    with pytest.raises(RecordingError) as refusal:
        read(folder)
    said = str(refusal.value)
    assert "\n" not in said
    assert all(word in said for word in ("gnss.csv", "line 4", "resid_rms_m"))
