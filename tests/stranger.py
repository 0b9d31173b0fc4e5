"""Logs as strangers have them, made of real drives: a phone's folder, a receiver's .ubx beside an IMU, a ROS 2 bag."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import logs
import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array, exp
from graphnav.core.timescales import unix_to_gps
from graphnav.core.trajectory import Trajectory
from graphnav.recording import Gnss, Recording, Truth
from graphnav.recording.formats import read
from graphnav.recording.formats.axes import parse_axes_letters
from graphnav.sensors.barometer import compute_standard_pressure

UNIX = 1751990400.0  # s, 8 July 2025, 16:00 UTC, a second after the start of every cut
G = 9.80665


@dataclass(frozen=True)
class Cut:
    """A part of a real drive: s since its start, at most one fix a second."""

    recording: Recording
    reference: Array  # (M, 4) s, rad, rad, m of the antenna

    @property
    def unix(self) -> Array:
        """Unix times of the IMU's rows, s."""
        return UNIX + self.recording.imu.t


def cuts(folder: Path, spans: list[tuple[float, float]]) -> list[Cut]:
    """Parts of a drive of `shared/data`, s from its start; its truth is the reference."""
    whole = read(folder)
    assert whole.truth is not None
    return [_cut(whole.crop(*span), whole.truth) for span in spans]


def _cut(part: Recording, truth: Truth) -> Cut:
    zero, gnss = part.start, part.gnss
    second = np.floor(gnss.t - zero)
    first = np.concatenate([[True], np.diff(second) > 0]) & (gnss.t > zero) & np.isfinite(gnss.v).all(1)
    gnss = Gnss(gnss.t[first] - zero, gnss.llh[first], gnss.sd[first], gnss.v[first])
    there = (truth.t > part.start) & (truth.t < part.end)
    reference = np.column_stack([truth.t - zero, truth.llh])[there]
    return Cut(Recording("cut", "vehicle", replace(part.imu, t=part.imu.t - zero), gnss), reference)


def errors(track: Trajectory, reference: Array) -> Array:
    """Horizontal distances (K,) m of a trajectory in s of the cut from the reference at the same times."""
    frame = LocalFrame(reference[0, 1:])
    k, j = np.nonzero(np.abs(track.t[:, None] - reference[None, :, 0]) < 0.005)
    return np.linalg.norm((frame.from_llh(track.llh[k]) - frame.from_llh(reference[j, 1:]))[:, :2], axis=1)


def fix_errors(folder: Path, drive: Cut) -> Array:
    """The same of the fixes that `write_phone` wrote."""
    rows = np.genfromtxt(folder / "Location.csv", delimiter=",", names=True)[1:]
    llh = np.column_stack([np.radians(rows["latitude"]), np.radians(rows["longitude"]), rows["altitude"]])
    return errors(Trajectory(rows["seconds_elapsed"], llh), drive.reference)


def _write(path: Path, header: str, columns: list, decimals: int = 7) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header.split(","))
        for row in zip(*columns, strict=True):
            writer.writerow([x if isinstance(x, str | int) else f"{x:.{decimals}f}" for x in row])


def write_phone(folder: Path, drive: Cut, total: bool = True) -> Path:
    """An export of the app Sensor Logger: one file a sensor, z,y,x, the phone tilted in its holder, a cached fix."""
    folder.mkdir(parents=True, exist_ok=True)
    mount = exp(np.radians([-55.0, 8.0, 3.0]))  # from the body to the phone's axes
    imu, gnss = drive.recording.imu, drive.recording.gnss
    rng = np.random.default_rng(5)
    gyro, force = imu.gyro @ mount.T, imu.accel @ mount.T
    down = np.cumsum(force, axis=0) / np.arange(1, len(force) + 1)[:, None]  # of the phone's own filter
    down = G * down / np.linalg.norm(down, axis=1, keepdims=True)

    def stamps(t: Array) -> list:
        return [[round(x) for x in (UNIX + t) * 1e9], t]

    t = imu.t
    three = "time,seconds_elapsed,z,y,x"
    _write(folder / "Accelerometer.csv", three, [*stamps(t), *(force - down).T[::-1]])
    _write(folder / "Gravity.csv", three, [*stamps(t), *down.T[::-1]])
    if total:
        at = np.column_stack([np.interp(t + 0.002, t, x) for x in force.T])
        _write(folder / "TotalAcceleration.csv", three, [*stamps(t + 0.002), *at.T[::-1]])
    _write(folder / "Gyroscope.csv", three, [*stamps(t), *gyro.T[::-1]])
    _write(folder / "Magnetometer.csv", three, [*stamps(t[::4]), *(30 * down[::4]).T[::-1]])
    _write(
        folder / "Orientation.csv",
        "time,seconds_elapsed,qz,qy,qx,qw,roll,pitch,yaw",
        [*stamps(t), *np.zeros((7, len(t)))],
    )
    slow = t[::100]
    wind = 0.2 * np.random.default_rng(6).normal(size=len(slow))  # m
    pressure = compute_standard_pressure(np.interp(slow, gnss.t, gnss.llh[:, 2]) + wind) / 100.0  # hPa
    _write(
        folder / "Barometer.csv",
        "time,seconds_elapsed,relativeAltitude,pressure",
        [*stamps(slow), np.zeros(len(slow)), pressure],
    )
    (folder / "Annotation.csv").write_text("time,seconds_elapsed,text,millisecond_press_duration\n")
    (folder / "Metadata.csv").write_text(
        "version,device name,recording time,platform\n3,iPhone 14 Pro,2025-07-08_16-00-00,ios\n"
    )
    t, llh, v = gnss.t, gnss.llh.copy(), gnss.v
    noise = np.zeros((len(t), 3))
    for k in range(1, len(t)):  # errors that last, as of a phone
        noise[k] = 0.95 * noise[k - 1] + 0.3 * rng.normal(size=3) * [1.0, 1.0, 2.0]
    frame = LocalFrame(llh[0])
    llh = frame.to_llh(frame.from_llh(llh) + noise)
    speed, course = np.hypot(v[:, 0], v[:, 1]), np.degrees(np.arctan2(v[:, 0], v[:, 1])) % 360
    rows = np.column_stack([t, np.degrees(llh[:, :2]), llh[:, 2], speed, course])
    rows = np.vstack([[-1200.0, *(rows[0, 1:3] + 0.01), *rows[0, 3:]], rows])  # where the phone was 20 min before
    head = "time,seconds_elapsed,bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,"
    head += "speed,bearing,altitude,longitude,latitude"
    n = len(rows)
    columns = [*stamps(rows[:, 0]), np.full(n, 10.0), np.full(n, 0.5), np.full(n, 3.0), np.full(n, 2.0)]
    _write(folder / "Location.csv", head, [*columns, rows[:, 4], rows[:, 5], rows[:, 3], rows[:, 2], rows[:, 1]], 9)
    return folder


def write_receiver(folder: Path, drive: Cut) -> Path:
    """A receiver's fixes as .ubx, and an IMU in deg/s, g and Unix ms, x forward, y left."""
    folder.mkdir(parents=True, exist_ok=True)
    imu, gnss = drive.recording.imu, drive.recording.gnss
    R = parse_axes_letters("FLU").T
    columns = [[round(1e3 * x) for x in drive.unix], *np.degrees(imu.gyro @ R.T).T, *(imu.accel @ R.T / G).T]
    _write(folder / "imu.csv", "timestamp,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z", columns)
    gps = float(unix_to_gps(np.array([UNIX]))[0])
    fixes = zip(gnss.t, gnss.llh, gnss.v, strict=True)
    frames = [logs.nav_pvt(gps + t, llh, v, (0.07, 0.1, 0.2)) for t, llh, v in fixes]
    (folder / "rover.ubx").write_bytes(b"".join(frames))
    return folder


def write_spreadsheet(folder: Path, drive: Cut) -> Path:
    """As a spreadsheet saves it east of the Rhine: semicolons, decimal commas, units in the header, dates in words."""
    folder.mkdir(parents=True, exist_ok=True)
    imu, gnss = drive.recording.imu, drive.recording.gnss

    def write(name: str, header: str, t: Array, columns: list, decimals: int) -> None:
        days = [f"{datetime.fromtimestamp(UNIX + x, UTC):%d.%m.%Y %H:%M:%S.%f}"[:-3] for x in t]
        rows = [";".join([day, *(f"{x:.{decimals}f}" for x in row)]) for day, *row in zip(days, *columns, strict=True)]
        (folder / name).write_text("\n".join([header, *rows]).replace(".", ",") + "\n", encoding="utf-8")
        text = (folder / name).read_text(encoding="utf-8")
        (folder / name).write_text(re.sub(r"(?m)^(\d\d),(\d\d),(\d{4}) ", r"\1.\2.\3 ", text), encoding="utf-8")

    header = "Zeit;Acc X [g];Acc Y [g];Acc Z [g];Gyro X [°/s];Gyro Y [°/s];Gyro Z [°/s]"
    write("imu.csv", header, imu.t, [*(imu.accel / G).T, *np.degrees(imu.gyro).T], 6)
    speed, course = np.hypot(*gnss.v[:, :2].T), np.degrees(np.arctan2(gnss.v[:, 0], gnss.v[:, 1])) % 360
    place = [*np.degrees(gnss.llh[:, :2]).T, gnss.llh[:, 2]]
    header = "Zeit;Breite;Länge;Höhe [m];Geschwindigkeit [km/h];Kurs [°]"
    write("gps.csv", header, gnss.t, [*place, 3.6 * speed, course], 8)
    return folder


Columns = tuple[str, list[list[str]]]  # the header, and the cells of each row


def tables(drive: Cut, unix: float = UNIX) -> tuple[Columns, Columns]:
    """The IMU's and the fixes' tables, as text, with the Unix time in s."""
    imu, gnss = drive.recording.imu, drive.recording.gnss
    rows = np.column_stack([unix + imu.t, imu.gyro, imu.accel])
    places = np.column_stack([unix + gnss.t, np.degrees(gnss.llh[:, :2]), gnss.llh[:, 2]])
    return (
        ("t,gx,gy,gz,ax,ay,az", [[f"{x:.8f}" for x in row] for row in rows]),
        ("t,lat,lon,h", [[f"{x:.8f}" for x in row] for row in places]),
    )


def write_tables(folder: Path, *both: Columns, mark: str = ",", end: bytes = b"\n") -> Path:
    """`imu.csv` and `gnss.csv`; `end` is what is there behind the last line."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, (header, rows) in zip(("imu.csv", "gnss.csv"), both, strict=True):
        lines = [header.replace(",", mark), *(mark.join(row) for row in rows)]
        (folder / name).write_bytes("\n".join(lines).encode() + end)
    return folder


def write_one_file(folder: Path, drive: Cut) -> Path:
    """A logger's one file: a row for each sample of the IMU, in which the last fix stands until there is another."""
    folder.mkdir(parents=True, exist_ok=True)
    imu, gnss = drive.recording.imu, drive.recording.gnss
    k = np.searchsorted(gnss.t, imu.t + 1e-6) - 1
    there = k >= 0
    last = np.column_stack([np.degrees(gnss.llh[:, :2]), gnss.llh[:, 2]])[k[there]]
    columns = [[f"{1e3 * x:.0f}" for x in drive.unix[there]], *(imu.accel[there] / G).T, *np.degrees(imu.gyro[there]).T]
    header = "timestamp(ms),ax(g),ay(g),az(g),gx(dps),gy(dps),gz(dps),latitude,longitude,altitude(m)"
    _write(folder / "log.csv", header, [*columns, *last.T], 8)
    return folder


def write_bag(folder: Path, drive: Cut) -> Path:
    """A ROS 2 bag: an IMU forward-left-up, that of a camera which has more messages and looks down, and fixes."""
    return logs.write_bag(folder, "db3", lambda store: _messages(store, drive), UNIX)


def _messages(store, drive: Cut):
    types, header = store.types, logs.ros_header(store, UNIX)
    V, Q = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    Imu, Fix, Status = (types[f"sensor_msgs/msg/{name}"] for name in ("Imu", "NavSatFix", "NavSatStatus"))
    imu, gnss = drive.recording.imu, drive.recording.gnss
    rng, none = np.random.default_rng(7), np.full(9, 0.0)
    camera = np.repeat(imu.t[1:], 2) - np.tile([0.5 * np.median(np.diff(imu.t)), 0.0], len(imu.t) - 1)
    for name, R, t, noise in (
        ("/imu/data", parse_axes_letters("FLU").T, imu.t, (0.0, 0.0)),
        ("/camera/imu", parse_axes_letters("RDF").T, camera, (0.02, 0.3)),
    ):
        near = np.searchsorted(imu.t, t - 1e-6)
        gyro = imu.gyro[near] @ R.T + noise[0] * rng.normal(size=(len(t), 3))
        force = imu.accel[near] @ R.T + noise[1] * rng.normal(size=(len(t), 3))
        for time, w, f in zip(t, gyro, force, strict=True):
            yield time, name, Imu(header(time, name), Q(0.0, 0.0, 0.0, 1.0), none, V(*w), none, V(*f), none)
    for t, llh, sd in zip(gnss.t, gnss.llh, gnss.sd, strict=True):
        place = (*np.degrees(llh[:2]), llh[2])
        yield t, "/gps/fix", Fix(header(t, "gps"), Status(0, 1), *place, np.diag(sd**2).ravel(), 2)
