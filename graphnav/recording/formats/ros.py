"""ROS 1 and ROS 2 bags and MCAP files: sensor_msgs/Imu, NavSatFix, and velocities of geometry_msgs and nav_msgs.

Units and axes are those of the message definitions and of REP 103 and 145: rad/s, m/s2 with gravity, body
forward-left-up, NavSatFix in degrees and metres above the ellipsoid with a covariance in east-north-up. Stamps are
those of the headers. Read by rosbags, without ROS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.complaints import suggest_nearest
from graphnav.core.errors import RecordingError
from graphnav.core.interpolation import pick_nearest
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import unix_to_gps
from graphnav.recording import Gnss, Imu, ImuNoise, Odometer, convert_fix_types
from graphnav.recording.formats.axes import parse_axes_letters
from graphnav.recording.formats.registry import Log, log_format
from graphnav.recording.formats.repair import DEFAULT_SD, DEFAULT_SD_V

_IMU, _FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
_TWISTS = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped", "nav_msgs/msg/Odometry")
_SENSORS = {"imu": "imu", "fix": "gnss", "wheel": "odometer"}  # whose topic a recording.toml may state
_STATUS = {0: 5, 1: 3, 2: 4}  # of a NavSatFix: unaugmented, of satellites, of a base (carrier phases or not)
_UNIX = 1e9  # s; stamps above are dates
_SIDEWAYS = 0.2  # a body moves forward; a velocity with a larger second component is in east-north-up


@dataclass
class _Topic:
    """Rows of one topic."""

    name: str
    kind: str
    t: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)


def recognises(path: Path) -> bool:
    """Whether this is a bag: .bag, .mcap, .db3, or a folder with metadata.yaml."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and any(p.suffix in (".db3", ".mcap") for p in path.iterdir())
    return path.suffix in (".bag", ".mcap", ".db3") and path.is_file()


def load(path: Path, wanted: Sequence[str] = ()) -> Log:
    """Read the IMU, fixes and speed of the topics `wanted`, otherwise of those with the most messages.

    Raises
    ------
    RecordingError
        If the bag cannot be read or holds none of these.
    """
    remarks = Notes()
    topics, others = _read_topics(path)
    if not topics:
        kinds = ", ".join(sorted(others)[:6]) or "nothing"
        raise RecordingError(
            f"{path}: no Imu, NavSatFix, TwistStamped or Odometry messages in it (there are: {kinds})",
            key="log.no_messages",
        )
    for name in wanted:
        if name not in (known := [t.name for t in topics]):
            raise RecordingError(
                f"{path}: no topic '{name}' that can be used; {suggest_nearest(name, known)}", key="log.topic_unknown"
            )
    ranked: dict[str, list[_Topic]] = {}
    for topic in sorted(topics, key=lambda t: (t.name not in wanted, -len(t.rows))):
        ranked.setdefault(_find_role(topic), []).append(topic)
    for found in ranked.values():
        if len(found) > 1:
            left = ", ".join(t.name for t in found[1:])
            why = "as was asked" if found[0].name in wanted else "having the most messages"
            remarks.add("log.topic", f"{found[0].name} is used, {why}; not {left}")
    imu = _make_imu(ranked["imu"][0], remarks) if "imu" in ranked else None
    gnss = _make_gnss(ranked["fix"][0], remarks) if "fix" in ranked else None
    if "velocity" in ranked:
        gnss = _add_velocity(ranked["velocity"][0], gnss, remarks)
    odometer = _read_wheel(ranked["wheel"][0], remarks) if "wheel" in ranked else None
    first = float(next(s.t[0] for s in (imu, gnss, odometer) if s is not None))
    zero = float(unix_to_gps(np.array([first]))[0] - first) if first > _UNIX else None
    remarks.add(
        "log.clock", "clock: the stamps in the headers" + (", Unix time" if zero is not None else ", of no known epoch")
    )
    name = path.stem if path.is_file() else path.resolve().name
    return Log(
        name, imu, gnss, odometer, gps_zero=zero,
        remarks=tuple(remarks), mount_known=False,
        topics={_SENSORS[role]: tuple(t.name for t in found) for role, found in ranked.items() if role in _SENSORS},
    )  # fmt: skip


def _find_role(topic: _Topic) -> str:
    """What a topic holds: imu, fix, velocity over ground, or the speed of a wheel or body."""
    if topic.kind not in _TWISTS:
        return "imu" if topic.kind == _IMU else "fix"
    v = np.array(topic.rows, dtype=float)
    speed = np.hypot(v[:, 0], v[:, 1])
    moving = speed > 1.0
    across = np.median(np.abs(v[moving, 1]) / speed[moving]) if moving.any() else 0.0
    return "wheel" if topic.kind == _TWISTS[2] or across <= _SIDEWAYS else "velocity"


def _read_topics(path: Path) -> tuple[list[_Topic], set[str]]:
    """The usable topics with their rows, and the types of the others."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    topics: dict[str, _Topic] = {}
    others = set()
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            wanted = [c for c in reader.connections if c.msgtype in (_IMU, _FIX, *_TWISTS)]
            others = {c.msgtype for c in reader.connections} - {c.msgtype for c in wanted}
            for connection, _, raw in reader.messages(connections=wanted):
                message: Any = reader.deserialize(raw, connection.msgtype)
                topic = topics.setdefault(connection.topic, _Topic(connection.topic, connection.msgtype))
                topic.t.append(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)
                topic.rows.append(_read_row(message, connection.msgtype))
    except Exception as error:  # a damaged bag fails in whatever library reads its storage
        raise RecordingError(
            f"{path}: cannot be read as a ROS bag ({' '.join(str(error).split())[:200]})", key="file.damaged"
        ) from None
    return [t for t in topics.values() if t.rows], others


def _read_row(message: Any, kind: str) -> list[float]:
    if kind == _IMU:
        w, f = message.angular_velocity, message.linear_acceleration
        white = (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0])
        return [w.x, w.y, w.z, f.x, f.y, f.z, *white]
    if kind == _FIX:
        known = message.position_covariance_type > 0
        variance = [message.position_covariance[k] if known else np.nan for k in (0, 4, 8)]
        return [message.latitude, message.longitude, message.altitude, *variance, message.status.status]
    twist = message.twist if kind == _TWISTS[0] else message.twist.twist
    return [twist.linear.x, twist.linear.y, twist.linear.z]


def _build_table(topic: _Topic) -> tuple[Array, Array]:
    """Times and rows ordered by time, each time once."""
    t, rows = np.array(topic.t), np.array(topic.rows, dtype=float)
    t, first = np.unique(t, return_index=True)
    return t, rows[first]


def _make_imu(topic: _Topic, remarks: Notes) -> Imu | None:
    t, rows = _build_table(topic)
    good = np.isfinite(rows[:, :6]).all(-1)
    if good.sum() < 2:
        remarks.add("imu.topic_not_used", f"{topic.name}: fewer than two usable messages, so it is not used")
        return None
    t, rows = t[good], rows[good]
    R_bs = parse_axes_letters("FLU")
    remarks.add("imu.read_as", f"IMU: {topic.name}, rad/s and m/s2 with gravity")
    remarks.add("imu.axes_assumed", "IMU: axes taken as forward-left-up (REP 103)")
    white = np.median(rows[:, 6:], axis=0)
    noise, assumed = ImuNoise(), True
    if (white > 0).all():
        period = float(np.median(np.diff(t)))
        density = np.sqrt(white * period)
        noise = ImuNoise(gyro_noise_density=float(density[0]), accel_noise_density=float(density[1]))
        assumed = False
        remarks.add(
            "imu.noise_read_as",
            "noise densities: from the messages' covariances and the period; biases as of a consumer IMU",
        )
    return Imu(t, rows[:, :3] @ R_bs.T, rows[:, 3:6] @ R_bs.T, noise, R_bs, assumed)


def _make_gnss(topic: _Topic, remarks: Notes) -> Gnss | None:
    t, rows = _build_table(topic)
    good = np.isfinite(rows[:, :3]).all(-1) & (rows[:, 6] >= 0) & (rows[:, :2] != 0).any(-1)
    if not good.any():
        remarks.add("gnss.topic_not_used", f"{topic.name}: no message has a fix, so it is not used")
        return None
    if not good.all():
        remarks.add(
            "gnss.rows_left_out", f"{topic.name}: {format_count(np.sum(~good), 'message')} without a fix left out"
        )
    t, rows = t[good], rows[good]
    known = (rows[:, 3:6] > 0).all(-1)
    sd = np.where(known[:, None], np.sqrt(np.abs(np.nan_to_num(rows[:, 3:6]))), DEFAULT_SD)
    if not known.all():
        remarks.add(
            "gnss.sigma_assumed",
            f"{topic.name}: sigmas of 3.3, 3.3, 6.6 m for "
            f"{format_count(np.sum(~known), 'fix', 'fixes')} without a covariance",
        )
    remarks.add("gnss.read_as", f"GNSS: {topic.name}; heights above the ellipsoid")
    remarks.add("gnss.lever_arm_unknown", "GNSS: the antenna's lever arm is not in the log and taken as zero")
    # many drivers always write 0: without any other status it carries no information
    kinds = convert_fix_types(rows[:, 6], _STATUS) if rows[:, 6].any() else None
    return Gnss(t, np.column_stack([np.radians(rows[:, :2]), rows[:, 2]]), sd, type=kinds)


def _read_wheel(topic: _Topic, remarks: Notes) -> Odometer:
    t, rows = _build_table(topic)
    good = np.isfinite(rows).all(-1)
    remarks.add("odometer.read_as", f"odometer: {topic.name}, linear.x as forward speed in m/s")
    remarks.add("odometer.lever_arm_unknown", "odometer: its lever arm is not in the log and taken as zero")
    return Odometer(t[good], rows[good, 0])


def _add_velocity(topic: _Topic, gnss: Gnss | None, remarks: Notes) -> Gnss | None:
    """The fixes with a velocity over ground."""
    if gnss is None:
        remarks.add(
            "gnss.velocity_not_used",
            f"{topic.name} looks like a velocity over ground, but there are no fixes: not used",
        )
        return None
    t, rows = _build_table(topic)
    good = np.isfinite(rows).all(-1)
    t, rows = t[good], rows[good]
    near = pick_nearest(t, gnss.t)
    same = np.abs(t[near] - gnss.t) < 0.05
    v = np.where(same[:, None], rows[near], np.nan)
    sd_v = np.where(same[:, None], DEFAULT_SD_V, np.nan)
    remarks.add(
        "gnss.velocity_read_as",
        f"velocity: {topic.name}, taken as east-north-up because it points sideways as well; at {np.sum(same)} of "
        f"{len(gnss.t)} fixes, sigmas of 0.2, 0.2, 0.4 m/s",
    )
    return replace(gnss, v=v, sd_v=sd_v)


FORMAT = log_format("ros", "ROS 1 or ROS 2 bags and MCAP files", recognises, lambda path, _: load(path), load)
