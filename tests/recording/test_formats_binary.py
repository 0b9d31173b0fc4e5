"""u-blox UBX logs and ROS bags, made here frame by frame and message by message."""

from __future__ import annotations

import struct
from pathlib import Path

import logs
import numpy as np
import pytest
from helpers import assert_told, refused

from graphnav.core.errors import RecordingError
from graphnav.recording.draft import draft
from graphnav.recording.formats import load, read

RECORDING, _ = logs.simulated(60.0)
UNIX = 1646870382.0  # 9 March 2022, 23:59:42 UTC: midnight of GPS time


# ---- UBX, as in u-blox' interface description


def nav_pvt(t: float, llh, v, fix: int = 3, ok: int = 1) -> bytes:
    return logs.nav_pvt(logs.WEEK * 604800.0 + logs.TOW + t, llh, v, fix=fix, ok=ok)


def nav_hp(t: float, llh) -> bytes:
    ms = round((logs.TOW + t) * 1000)
    parts = [np.degrees(llh[1]) * 1e9, np.degrees(llh[0]) * 1e9, llh[2] * 1e4]
    whole = [round(p) for p in parts]
    low = [w % 100 if k < 2 else w % 10 for k, w in enumerate(whole)]
    high = [(w - x) // (100 if k < 2 else 10) for k, (w, x) in enumerate(zip(whole, low, strict=True))]
    payload = bytes(4) + struct.pack("<Iiiii", ms, high[0], high[1], high[2], high[2])
    return logs.frame(1, 0x14, payload + struct.pack("<bbbb", *low, 0) + struct.pack("<II", 140, 200))


def esf_meas(tag: int, values: dict[int, float]) -> bytes:
    scale = {14: 180 / np.pi * 4096, 13: 180 / np.pi * 4096, 5: 180 / np.pi * 4096, 11: 1000.0}
    words = [(kind << 24) | (round(x * scale.get(kind, 1024.0)) & 0xFFFFFF) for kind, x in values.items()]
    return logs.frame(0x10, 2, struct.pack("<IHH", tag, len(words) << 11, 0) + struct.pack(f"<{len(words)}I", *words))


def write_ubx(path: Path, esf: bool = True, hp: bool = True, delay: float = 0.1) -> Path:
    """The drive as a receiver would have written it: fixes `delay` s after their time, among its sensors' samples."""
    gnss, imu, odometer = RECORDING.gnss, RECORDING.imu, RECORDING.odometer
    messages = []
    for k, t in enumerate(gnss.t):
        messages.append((t + delay, nav_pvt(t, gnss.llh[k], gnss.v[k])))
        if hp:
            messages.append((t + delay + 1e-4, nav_hp(t, gnss.llh[k])))
    if esf:
        for t, w, f in zip(imu.t, imu.gyro, imu.accel, strict=True):
            tag = round(t * 1000) + 5_000_000
            messages.append((t, esf_meas(tag, dict(zip((14, 13, 5, 16, 17, 18), (*w, *f), strict=True)))))
        for t, speed in zip(odometer.t[::5], odometer.speed[::5], strict=True):
            messages.append((t + 1e-5, esf_meas(round(t * 1000) + 5_000_000, {11: speed})))
    messages.sort(key=lambda m: m[0])
    path.write_bytes(b"$GNTXT,01*00\r\n" + b"".join(m for _, m in messages))
    return path


def test_ubx_fixes_in_gps_time(tmp_path):
    log = load(write_ubx(tmp_path / "a.ubx", esf=False, hp=False))
    assert log.gps_zero == logs.WEEK * 604800.0
    assert log.gnss.t == pytest.approx(logs.TOW + RECORDING.gnss.t, abs=1e-3)
    assert np.degrees(log.gnss.llh[:, :2]) == pytest.approx(np.degrees(RECORDING.gnss.llh[:, :2]), abs=0.51e-7)
    assert log.gnss.llh[:, 2] == pytest.approx(RECORDING.gnss.llh[:, 2], abs=0.51e-3)
    assert log.gnss.v == pytest.approx(RECORDING.gnss.v, abs=0.51e-3)
    assert log.gnss.sd[0] == pytest.approx([0.028 / np.sqrt(2), 0.028 / np.sqrt(2), 0.030])
    assert log.gnss.sd_v[0] == pytest.approx(0.087 / np.sqrt(3))
    with refused("log.no_imu", RecordingError):
        read(tmp_path / "a.ubx")


def test_ubx_high_precision_positions_are_preferred(tmp_path):
    log = load(write_ubx(tmp_path / "a.ubx", esf=False))
    assert np.degrees(log.gnss.llh[:, :2]) == pytest.approx(np.degrees(RECORDING.gnss.llh[:, :2]), abs=0.6e-9)
    assert log.gnss.llh[:, 2] == pytest.approx(RECORDING.gnss.llh[:, 2], abs=0.6e-4)
    assert log.gnss.sd[0] == pytest.approx([0.014 / np.sqrt(2), 0.014 / np.sqrt(2), 0.020])


def test_ubx_sensors_are_put_on_the_clock_of_the_fixes(tmp_path):
    delay = 0.1
    recording = read(write_ubx(tmp_path / "a.ubx", delay=delay))
    n = len(recording.imu.t)
    assert n == len(RECORDING.imu.t)
    assert recording.imu.gyro == pytest.approx(RECORDING.imu.gyro, abs=np.radians(0.51 / 4096))
    assert recording.imu.accel == pytest.approx(RECORDING.imu.accel, abs=0.51 / 1024)
    # stamps are early by the delay of the fixes
    assert recording.imu.t == pytest.approx(logs.TOW + RECORDING.imu.t - delay, abs=0.021)
    assert_told(recording.remarks, "log.sensor_clock", "50 to 150 ms")
    assert recording.odometer.speed == pytest.approx(RECORDING.odometer.speed[::5], abs=0.51e-3)


def test_a_drafted_ubx_log_has_its_axes_found(tmp_path):
    write_ubx(tmp_path / "a.ubx")
    found = draft([tmp_path / "a.ubx"], tmp_path)
    assert 'axes = "RFU"' in found.text
    (tmp_path / "recording.toml").write_text(found.text)
    recording = read(tmp_path)
    shift = recording.imu.t[0] - recording.gnss.t[0]
    # so short a drive is not sure of a delay of a tenth of a second: the stamps stay, or are mended
    assert shift == pytest.approx(RECORDING.imu.t[0] - RECORDING.gnss.t[0], abs=0.1)


def test_broken_ubx_says_so(tmp_path):
    path = write_ubx(tmp_path / "a.ubx", esf=False, hp=False)
    data = bytearray(path.read_bytes())
    first = data.index(b"\xb5\x62")
    data[first + 30] ^= 0xFF  # a byte of the first payload: its checksum no longer fits
    path.write_bytes(bytes(data))
    assert len(load(path).gnss.t) == len(RECORDING.gnss.t) - 1
    path.write_bytes(b"$\x92\x80$GNX\xff" + np.random.default_rng(0).bytes(3000))
    with refused("log.no_messages", RecordingError, "a.ubx", "NAV-PVT", "ESF", "3008"):
        load(path, "ubx")
    path.write_bytes(b"".join(nav_pvt(t, RECORDING.gnss.llh[0], [0, 0, 0], fix=0, ok=0) for t in (0.0, 1.0)))
    with refused("log.no_messages", RecordingError, "a.ubx", "2 NAV-PVT"):
        load(path)


# ---- ROS


def ros_messages(store):
    """(time, topic, message) of the drive: an IMU in FLU, fixes with covariances, a velocity over ground."""
    types, header = store.types, logs.ros_header(store, UNIX)
    V, Q = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    Status = types["sensor_msgs/msg/NavSatStatus"]
    covariance = np.diag([1e-6, 1e-6, 1e-6]).ravel()
    flu = logs.FLU
    for t, w, f in zip(RECORDING.imu.t, RECORDING.imu.gyro @ flu.T, RECORDING.imu.accel @ flu.T, strict=True):
        yield (
            t,
            "/imu/data",
            types["sensor_msgs/msg/Imu"](
                header(t, "imu"), Q(0.0, 0.0, 0.0, 1.0), covariance, V(*w), covariance, V(*f), 4 * covariance
            ),
        )
    gnss = RECORDING.gnss
    for t, llh, sd, v in zip(gnss.t, gnss.llh, gnss.sd, gnss.v, strict=True):
        status = Status(2, 1)
        yield (
            t,
            "/gps/fix",
            types["sensor_msgs/msg/NavSatFix"](
                header(t, "gps"), status, *np.degrees(llh[:2]), llh[2], np.diag(sd**2).ravel(), 2
            ),
        )
        twist = types["geometry_msgs/msg/Twist"](V(*v), V(0.0, 0.0, 0.0))
        yield t, "/gps/vel", types["geometry_msgs/msg/TwistStamped"](header(t, "gps"), twist)


def wheel_messages(store):
    """The same drive with a wheel's speed as well, of which there are more messages than of the velocity."""
    yield from ros_messages(store)
    types, header = store.types, logs.ros_header(store, UNIX)
    V = types["geometry_msgs/msg/Vector3"]
    for t in RECORDING.imu.t[::2]:
        twist = types["geometry_msgs/msg/Twist"](V(7.0, 0.0, 0.0), V(0.0, 0.0, 0.0))
        yield t, "/wheel/twist", types["geometry_msgs/msg/TwistStamped"](header(t, "base_link"), twist)


def write_bag(path: Path, kind: str, messages=ros_messages) -> Path:
    return logs.write_bag(path, kind, messages, UNIX)


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap", "mcap file"])
def test_bags_of_every_kind_hold_the_drive(tmp_path, kind):
    path = write_bag(tmp_path / ("a.bag" if kind == "bag" else "a"), kind.split()[0])
    recording = read(next(path.glob("*.mcap")) if kind == "mcap file" else path)
    assert recording.imu.t == pytest.approx(UNIX + RECORDING.imu.t, abs=1e-6)
    assert recording.imu.gyro == pytest.approx(RECORDING.imu.gyro, abs=1e-12)
    assert recording.imu.accel == pytest.approx(RECORDING.imu.accel, abs=1e-12)
    assert recording.imu.noise.gyro_noise_density == pytest.approx(1e-3 * np.sqrt(0.02))
    assert recording.imu.noise.accel_noise_density == pytest.approx(2e-3 * np.sqrt(0.02))
    assert recording.gnss.llh == pytest.approx(RECORDING.gnss.llh, abs=1e-14)
    assert recording.gnss.sd == pytest.approx(RECORDING.gnss.sd)
    assert recording.gnss.v == pytest.approx(RECORDING.gnss.v)
    assert recording.gps_zero + UNIX == pytest.approx(logs.WEEK * 604800.0 + logs.TOW, abs=1e-6)


def test_a_bag_may_hold_both_a_velocity_over_ground_and_a_speed_of_the_wheels(tmp_path):
    recording = read(write_bag(tmp_path / "a", "db3", wheel_messages))
    assert recording.gnss.v == pytest.approx(RECORDING.gnss.v)
    assert recording.odometer.t == pytest.approx(UNIX + RECORDING.imu.t[::2], abs=1e-6)
    assert recording.odometer.speed == pytest.approx(7.0)


def test_a_broken_bag_is_one_plain_line(tmp_path):
    path = write_bag(tmp_path / "a.bag", "bag")
    path.write_bytes(path.read_bytes()[:5000])
    with refused("file.damaged", RecordingError, "a.bag"):
        read(path)
