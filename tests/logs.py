"""Small logs in other programs' forms, made of a simulated drive; each maker follows the form's own description.

The drive is `oracle.vehicle_path`, with exact samples and fixes, so that what is read can be compared with it.
"""

from __future__ import annotations

import datetime
import struct
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import oracle

from graphnav.core.timescales import gps_to_utc
from graphnav.core.trajectory import Trajectory
from graphnav.recording import Recording

WEEK, TOW = 2200, 345600.0  # Thursday, 10 March 2022, 0:00 GPS time
UTC_MIDNIGHT = datetime.datetime(2022, 3, 9, 23, 59, 42)  # the same, 18 leap seconds behind
FLU, FRD = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # of RFU
LEVER_ARM = (0.3, 0.5, 1.2)  # RFU


def simulated(seconds: float = 40.0) -> tuple[Recording, Trajectory]:
    """10 s into a drive at 50 Hz with exact IMU rows, fixes with velocities, and a wheel, and its whole truth."""
    recording, truth = oracle.drive(
        oracle.vehicle_path(120.0, 50.0), imu_noise=None, gnss_exact=True, gnss_velocity_sd=(0.05, 0.05, 0.1),
        lever_arm=LEVER_ARM, odometer_rate=50.0, odometer_sd=0.0, odometer_scale=0.0,
    )  # fmt: skip
    return recording.crop(10.0, 10.0 + seconds), truth


def write_kf_gins(folder: Path, recording: Recording, truth: Trajectory, odometer: bool = False) -> Path:
    """IMU increments and fixes in the columns of KF-GINS' README, the truth as .nav, and a configuration."""
    imu, gnss = recording.imu, recording.gnss
    assert gnss is not None
    folder.mkdir(parents=True, exist_ok=True)
    dt = np.diff(imu.t, prepend=imu.t[0] - np.median(np.diff(imu.t)))[:, None]
    columns = [TOW + imu.t[:, None], imu.gyro @ FRD.T * dt, imu.accel @ FRD.T * dt]
    if odometer:
        assert recording.odometer is not None
        columns.append(np.interp(imu.t, recording.odometer.t, recording.odometer.speed)[:, None])
    np.savetxt(folder / "imu.txt", np.hstack(columns), fmt="%.15g")
    fixes = [TOW + gnss.t, np.degrees(gnss.llh[:, 0]), np.degrees(gnss.llh[:, 1]), gnss.llh[:, 2]]
    np.savetxt(folder / "gnss.txt", np.column_stack([*fixes, gnss.sd[:, [1, 0, 2]]]), fmt="%.13f")
    v, rph = truth.v, np.degrees(truth.rph)
    rows = [np.full(len(truth), WEEK), TOW + truth.t, np.degrees(truth.llh[:, :2]), truth.llh[:, 2]]
    table = np.column_stack([*rows, v[:, 1], v[:, 0], -v[:, 2], rph])
    np.savetxt(folder / "truth.nav", table, fmt="%.12f")
    right, forward, up = gnss.lever_arm
    (folder / "kf-gins.yaml").write_text(
        f'imupath: "./dataset/imu.txt"\ngnsspath: "./dataset/gnss.txt"\noutputpath: "./dataset"\nimudatalen: 7\n'
        "starttime: 345600\nendtime: -1\ninitpos: [ 30.0, 114.0, 20.0 ]\ninitgyrbias: [ 0, 0, 0 ]\n"
        "imunoise:\n  arw: [0.1, 0.1, 0.1]\n  vrw: [0.2, 0.2, 0.2]\n  gbstd: [25.0, 25.0, 25.0]\n"
        "  abstd: [200.0, 200.0, 200.0]\n  gsstd: [300.0, 300.0, 300.0]\n  asstd: [300.0, 300.0, 300.0]\n"
        f"  corrtime: 4.0\nantlever: [ {forward}, {right}, {-up} ]\n"
    )
    return folder


def write_rtklib(path: Path, recording: Recording, scale: str = "GPST") -> Path:
    """A .pos file as RTKLIB 2.4.3 writes it with velocities, in GPST or UTC."""
    gnss = recording.gnss
    assert gnss is not None
    start = UTC_MIDNIGHT if scale == "UTC" else datetime.datetime(2022, 3, 10)
    lines = [
        "% program   : RTKPOST ver.2.4.3",
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)",
        f"%  {scale}                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
        "  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio    vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu"
        "    sdvne    sdveu    sdvun",
    ]
    for k, t in enumerate(gnss.t):
        stamp = (start + datetime.timedelta(seconds=float(t))).strftime("%Y/%m/%d %H:%M:%S.%f")[:-3]
        lat, lon = np.degrees(gnss.llh[k, :2])
        (e, n, u), (ve, vn, vu), (se, sn, su) = gnss.sd[k], gnss.v[k], gnss.sd_v[k]
        lines.append(
            f"{stamp}   {lat:.11f} {lon:.11f} {gnss.llh[k, 2]:.12f}   1  20 {n} {e} {u} 0 0 0 0.00 99.9 "
            f"{vn:.7f} {ve:.7f} {vu:.7f} {sn} {se} {su} 0 0 0"
        )
    path.write_text("\n".join(lines) + "\n")
    return path


def write_kitti(folder: Path, recording: Recording, truth: Trajectory) -> Path:
    """A drive in the form of the KITTI raw data: 30 numbers a file, stamps in a file of their own."""
    data = folder / "2011_09_30_drive_0099_extract" / "oxts" / "data"
    data.mkdir(parents=True)
    start = datetime.datetime(2011, 9, 30, 12, 40, 59)
    stamps = []
    gyro, accel = recording.imu.gyro @ FLU.T, recording.imu.accel @ FLU.T
    at = np.searchsorted(truth.t, recording.imu.t - 1e-9)
    for k, i in enumerate(at):
        roll, pitch, heading = truth.rph[i]
        ve, vn, vu = truth.v[i]
        lat, lon = np.degrees(truth.llh[i, :2])
        numbers = [lat, lon, truth.llh[i, 2], roll, -pitch, np.pi / 2 - heading, vn, ve, 0.0, 0.0, vu, *accel[k]]
        numbers += [0.0] * 3 + [*gyro[k]] + [0.0] * 3 + [0.05, 0.02, 4, 8, 4, 4, 0]
        (data / f"{k:010d}.txt").write_text(" ".join(repr(float(x)) for x in numbers))
        stamp = start + datetime.timedelta(seconds=float(recording.imu.t[k]))
        stamps.append(stamp.strftime("%Y-%m-%d %H:%M:%S.%f") + "000")
    (data.parent / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    return data.parent.parent


def sentence(body: str) -> str:
    """An NMEA sentence with its checksum."""
    return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n"


def write_nmea(path: Path, recording: Recording, gst: bool = True) -> Path:
    """GGA, GST and RMC of every fix; the geoid 40 m above the ellipsoid."""
    gnss = recording.gnss
    text = ""
    for k, t in enumerate(gnss.t):
        stamp = UTC_MIDNIGHT + datetime.timedelta(seconds=float(t))
        clock = stamp.strftime("%H%M%S.%f")[:-4]
        place = ""
        for value, width, signs in ((gnss.llh[k, 0], 2, "NS"), (gnss.llh[k, 1], 3, "EW")):
            minutes = abs(np.degrees(value)) * 60
            place += f"{int(minutes // 60):0{width}d}{minutes % 60:010.7f},{signs[0 if value >= 0 else 1]},"
        text += sentence(f"GNGGA,{clock},{place}4,12,0.80,{gnss.llh[k, 2] - 40.0:.3f},M,40.0,M,1.0,0000")
        if gst:
            e, n, u = gnss.sd[k]
            text += sentence(f"GNGST,{clock},0.1,,,,{n},{e},{u}")
        speed, course = np.hypot(*gnss.v[k, :2]), np.degrees(np.arctan2(gnss.v[k, 0], gnss.v[k, 1])) % 360
        where = place.rstrip(",")
        text += sentence(f"GNRMC,{clock},A,{where},{speed * 3600 / 1852:.4f},{course:.4f},{stamp:%d%m%y},,,D")
    path.write_text(text)
    return path


def frame(kind: int, number: int, payload: bytes) -> bytes:
    """A UBX frame, as in u-blox' interface description."""
    body = bytes([kind, number]) + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes([a, b])


def nav_pvt(gps: float, llh, v, accuracy=(0.028, 0.030, 0.087), fix: int = 3, ok: int = 1) -> bytes:
    """NAV-PVT at a GPS time (s since its epoch); accuracies hAcc, vAcc (m), sAcc (m/s)."""
    ms = round(gps * 1000)
    date = str(gps_to_utc(np.array([ms / 1000]))[0])
    year, month, day = (int(x) for x in date[:10].split("-"))
    hour, minute, second = int(date[11:13]), int(date[14:16]), int(date[17:19])
    lat, lon = np.degrees(llh[:2])
    payload = struct.pack(
        "<IHBBBBBBIiBBBB", ms % 604800000, year, month, day, hour, minute, second, 7, 30, 0, fix, ok, 0, 18
    )
    payload += struct.pack("<ii", round(lon * 1e7), round(lat * 1e7))
    horizontal, vertical, speed = (round(1000 * x) for x in accuracy)
    payload += struct.pack("<iiII", round(llh[2] * 1000), round(llh[2] * 1000) - 40000, horizontal, vertical)
    ve, vn, vu = np.round(np.array(v) * 1000).astype(int).tolist()
    payload += struct.pack("<iiiiiII", vn, ve, -vu, 0, 0, speed, 0) + bytes(24)
    return frame(1, 7, payload)


def ros_header(store, unix: float) -> Callable[[float, str], object]:
    """header(t, frame) of messages stamped `t` s after a Unix time."""
    types = store.types
    Header, Time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    ros1 = "seq" in Header.__dataclass_fields__

    def header(t: float, name: str) -> object:
        stamp = Time(int(unix + t), round((unix + t) % 1 * 1e9) % 10**9)
        return Header(0, stamp, name) if ros1 else Header(stamp, name)

    return header


def write_bag(path: Path, kind: str, messages, unix: float) -> Path:
    """A bag of `messages(store)`, which gives (time, topic, message); kind bag (ROS 1), db3 or mcap."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if kind == "bag" else Writer(path, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for t, topic, message in messages(store):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            serialise = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
            writer.write(connections[topic], round((unix + t) * 1e9), serialise(message, message.__msgtype__))
    return path


def novatel(name: str, body: str, t: float) -> str:
    """An ASCII log of NovAtel's with its CRC, by the bit-wise algorithm of the manual; short headers have a %."""
    short = name in ("RAWIMUSA", "RAWIMUSXA", "INSPVASA")
    stamp = f"{WEEK},{TOW + t:.3f}"
    head = f"{name},{stamp}" if short else f"{name},COM1,0,60.0,FINESTEERING,{stamp},02000020,0dc5,16809"
    crc = 0
    for byte in f"{head};{body}".encode():
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return f"{'%' if short else '#'}{head};{body}*{crc:08x}\r\n"


def write_novatel(
    path: Path, recording: Recording, truth: Trajectory, imu: str = "RAWIMUSXA", kind: int = 26, latency: float = 0.0,
    counts: tuple[float, float] = (1e-9, 2e-8),
) -> Path:  # fmt: skip
    """Counts of the IMU (of `counts` rad and m/s, by default of an ISA-100C, type 26), BESTPOS, BESTVEL and INSPVA."""
    gnss, dt = recording.gnss, float(np.median(np.diff(recording.imu.t)))
    lines = []
    for t, gyro, accel in zip(recording.imu.t, recording.imu.gyro, recording.imu.accel, strict=True):
        rate, force = (np.round(x * dt / one).astype(int) for x, one in zip((gyro, accel), counts, strict=True))
        some = (force[2], -force[1], force[0], rate[2], -rate[1], rate[0])
        body = f"{WEEK},{TOW + t:.6f},00170705,{','.join(map(str, some))}"
        lines.append((t, novatel(imu, f"00,{kind},{body}" if "X" in imu else body, t)))
    for k, t in enumerate(gnss.t):
        lat, lon = np.degrees(gnss.llh[k, :2])
        (e, n, u), (ve, vn, vu) = gnss.sd[k], gnss.v[k]
        place = f"{lat:.11f},{lon:.11f},{gnss.llh[k, 2] - 40.0:.4f},40.0000,WGS84,{n},{e},{u}"
        body = f'SOL_COMPUTED,NARROW_INT,{place},"0",1.000,0.000,18,15,15,12,00,00,00,01'
        course = np.degrees(np.arctan2(ve, vn)) % 360
        speed = f"SOL_COMPUTED,NARROW_INT,{latency:.3f},1.000,{np.hypot(ve, vn):.6f},{course:.6f},{vu:.6f},0.0"
        lines += [(t, novatel("BESTPOSA", body, t)), (t, novatel("BESTVELA", speed, t))]
    for k in np.flatnonzero((truth.t >= recording.start) & (truth.t <= recording.end)):
        lat, lon = np.degrees(truth.llh[k, :2])
        (ve, vn, vu), (roll, pitch, heading) = truth.v[k], np.degrees(truth.rph[k])
        body = f"{WEEK},{TOW + truth.t[k]:.9f},{lat:.11f},{lon:.11f},{truth.llh[k, 2]:.4f},{vn:.6f},{ve:.6f},{vu:.6f},"
        body += f"{roll:.9f},{pitch:.9f},{heading % 360:.9f},INS_SOLUTION_GOOD"
        lines.append((truth.t[k], novatel("INSPVASA", body, truth.t[k])))
    path.write_text("".join(line for _, line in sorted(lines, key=lambda one: one[0])))
    return path


def write_gnsslogger(path: Path, recording: Recording, boot: float = 65_000.0) -> Path:
    """A GnssLogger's text: rates and forces at times of their own, in stamps since boot, and fixes in UTC."""
    imu, gnss = recording.imu, recording.gnss
    unix = (UTC_MIDNIGHT - datetime.datetime(1970, 1, 1)).total_seconds()
    drift, between = (0.01, -0.02, 0.003), imu.t[:-1] + 0.3 * np.diff(imu.t)
    forces = np.stack([np.interp(between, imu.t, imu.accel[:, k]) for k in range(3)], -1)
    rows = [(t, f"UncalGyro,{stamp(unix + t)},{(boot + t) * 1e9:.0f},{join(x + drift)},{join(drift)}")
            for t, x in zip(imu.t, imu.gyro, strict=True)]  # fmt: skip
    rows += [(t, f"UncalAccel,{stamp(unix + t)},{(boot + t) * 1e9:.0f},{join(x)},0.0,0.0,0.0")
             for t, x in zip(between, forces, strict=True)]  # fmt: skip
    for k, t in enumerate(gnss.t):
        lat, lon = np.degrees(gnss.llh[k, :2])
        speed, course = np.hypot(*gnss.v[k, :2]), np.degrees(np.arctan2(gnss.v[k, 0], gnss.v[k, 1])) % 360
        fix = f"{lat:.10f},{lon:.10f},{gnss.llh[k, 2]:.6f},{speed:.6f},{1.51 * gnss.sd[k, 0]},{course:.6f}"
        rest = f"{stamp(unix + t)},0.1,,{(boot + t) * 1e9:.0f},{gnss.sd[k, 2]},0"
        rows += [(t, f"Fix,GPS,{fix},{rest}"), (t, f"Fix,NLP,{fix},{rest}"), (t, f"Raw,{stamp(unix + t)},1,18")]
    header = (
        "# Version: v3.1.0.4 Platform: 13\n#\n# Raw,utcTimeMillis,TimeNanos,LeapSecond\n#\n# Fix,Provider,"
        "LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,BearingDegrees,UnixTimeMillis,SpeedAccuracyMps,"
        "BearingAccuracyDegrees,elapsedRealtimeNanos,VerticalAccuracyMeters,MockLocation\n"
    )
    path.write_text(header + "".join(f"{row}\n" for _, row in sorted(rows, key=lambda one: one[0])))
    return path


def stamp(unix: float) -> str:
    """Milliseconds of Unix time."""
    return f"{unix * 1e3:.0f}"


def join(numbers) -> str:
    return ",".join(repr(float(x)) for x in numbers)
