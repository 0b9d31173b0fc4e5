"""u-blox UBX logs: positions of NAV-PVT (and NAV-HPPOSLLH), rates, forces and speed of ESF-MEAS or ESF-RAW.

Fields and scales are those of u-blox' interface descriptions: NAV-PVT in mm, mm/s and 1e-7 deg at iTOW (ms of the GPS
week); ESF data types 14, 13, 5 are gyro x, y, z (deg/s 2^-12), 16, 17, 18 accelerometer x, y, z (m/s2 2^-10), 11 speed
(mm/s), 24-bit two's complement. Frames are parsed by pyubx2.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import open_file
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import WEEK, utc_to_gps
from graphnav.recording import Gnss, Imu, Odometer, convert_fix_types
from graphnav.recording.formats.registry import Log, log_format, read_first_bytes

_SYNC = b"\xb5\x62"
_PVT, _HP, _MEAS, _RAW = (1, 7), (1, 0x14), (0x10, 2), (0x10, 3)
_GYRO, _ACCEL, _SPEED = (14, 13, 5), (16, 17, 18), 11
_SCALES = dict.fromkeys(_GYRO, np.pi / 180 * 2.0**-12) | dict.fromkeys(_ACCEL, 2.0**-10) | {_SPEED: 1e-3}
_TICKS = (1e-3, 39.0625e-6, 1e-6)  # s, ticks of the sensors' time tags in various receivers
_WRAP = 2.0**32


@dataclass
class _Content:
    """The contents of a log, in the order of its messages."""

    pvt: list[Any] = field(default_factory=list)
    precise: dict[int, Any] = field(default_factory=dict)  # NAV-HPPOSLLH by iTOW
    samples: dict[int, list[tuple[int, float]]] = field(default_factory=dict)  # data type -> (time tag, value)
    last_tag: list[tuple[int, int]] = field(default_factory=list)  # (number of the PVT, newest time tag before it)
    broken: int = 0


def recognises(path: Path) -> bool:
    """Whether there is a frame of one of the used messages in the first bytes, with or without NMEA between frames."""
    head = read_first_bytes(path, 1 << 18)
    return any(_SYNC + bytes(kind) in head for kind in (_PVT, _MEAS, _RAW))


def load(path: Path) -> Log:
    """Read fixes, and the receiver's own IMU and wheel speed if the log has them.

    Raises
    ------
    RecordingError
        If no position and no sensor is in it.
    """
    content = _collect_messages(path)
    remarks = Notes()
    if content.broken:
        remarks.add("log.broken_frames", f"{format_count(content.broken, 'broken frame')} skipped")
    fixes = [m for m in content.pvt if m.gnssFixOk and m.fixType in (3, 4)]
    if not fixes and not content.samples:
        what = (
            f"{format_count(len(content.pvt), 'NAV-PVT message')} without a fix"
            if content.pvt
            else "no NAV-PVT and no ESF messages"
        )
        raise RecordingError(f"{path}: {what} in {path.stat().st_size} bytes; nothing to use", key="log.no_messages")
    dated = [start for start in map(_find_week_start, fixes) if start is not None]
    zero = dated[0] if dated else None
    if fixes and zero is None:
        remarks.add("log.clock_unknown", "clock: no NAV-PVT has a date, so the GPS week is not known")
    gnss = _make_gnss(fixes, content, remarks) if fixes else None
    imu, odometer = _read_sensors(path, content, remarks)
    if zero is not None:
        remarks.add("log.clock", "clock: seconds of the GPS week (iTOW)")
    return Log(
        path.stem, imu, gnss, odometer, gps_zero=zero, remarks=tuple(remarks),
        mount_known=False,
    )  # fmt: skip


def _collect_messages(path: Path) -> _Content:
    import pyubx2

    content = _Content()
    tag: int | None = None
    with open_file(path, text=False) as stream:
        reader = pyubx2.UBXReader(stream, protfilter=pyubx2.UBX_PROTOCOL, quitonerror=0, parsing=0)
        while True:
            try:
                raw, _ = reader.read()
            except Exception:  # bytes between the frames that only resemble another protocol
                content.broken += 1
                continue
            if raw is None:
                break
            if len(raw) < 8:
                continue
            kind = (raw[2], raw[3])
            if kind not in (_PVT, _HP, _MEAS, _RAW):
                continue
            try:
                message = pyubx2.UBXReader.parse(raw)
            except Exception:  # pyubx2's own errors, and any that a frame of another version causes in it
                content.broken += 1
                continue
            if kind == _PVT:
                content.pvt.append(message)
                if tag is not None:
                    content.last_tag.append((len(content.pvt) - 1, tag))
            elif kind == _HP:
                content.precise[message.iTOW] = message
            else:
                tag = _add_message(content, message, kind == _RAW) or tag
    return content


def _add_message(content: _Content, message: Any, is_raw: bool) -> int | None:
    """Add the samples of one ESF message; returns its newest time tag."""
    tag = None if is_raw else int(message.timeTag)
    count = 0
    while True:
        count += 1
        if is_raw:
            data = getattr(message, f"data_{count:02d}", None)
            if data is None:
                return tag
            word = int.from_bytes(data, "little")
            kind, value = word >> 24 & 0x3F, word & 0xFFFFFF
            tag = int.from_bytes(getattr(message, f"sTag_{count:02d}"), "little")
        else:
            if not hasattr(message, f"dataField_{count:02d}"):
                return tag
            kind, value = getattr(message, f"dataType_{count:02d}"), getattr(message, f"dataField_{count:02d}")
        if kind in _SCALES:
            signed = value - (1 << 24) if value & 0x800000 else value
            assert tag is not None
            content.samples.setdefault(kind, []).append((tag, signed * _SCALES[kind]))


def _find_week_start(message: Any) -> float | None:
    """Beginning of the GPS week of a NAV-PVT, s since the GPS epoch; None without a date."""
    try:
        date = datetime.date(message.year, message.month, message.day)
    except ValueError:  # 0/0/0 while the receiver does not know the date
        return None
    if date.year < 1980:
        return None
    midnight = utc_to_gps(np.array([date], dtype="datetime64[us]"))[0]
    gps = midnight + message.hour * 3600 + message.min * 60 + message.second
    return float(WEEK * np.round((gps - message.iTOW * 1e-3) / WEEK))


def _unroll_tow(messages: list[Any]) -> Array:
    """Times of NAV-PVT messages in s, continuous over the end of a week."""
    return _unroll(np.array([m.iTOW for m in messages]) * 1e-3, WEEK)


def _unroll(x: Array, size: float) -> Array:
    """A counter that runs over at `size`, continuous."""
    return np.asarray(x + size * np.cumsum(np.diff(x, prepend=x[:1]) < -0.5 * size))


def _make_gnss(fixes: list[Any], content: _Content, remarks: Notes) -> Gnss:
    t = _unroll_tow(fixes)
    best = [content.precise.get(m.iTOW, m) for m in fixes]
    best = [m if p is not m and getattr(p, "invalidLlh", False) else p for p, m in zip(best, fixes, strict=True)]
    llh = np.array([[np.radians(m.lat), np.radians(m.lon), m.height * 1e-3] for m in best])
    accuracy = np.array([[p.hAcc, p.vAcc, m.sAcc] for p, m in zip(best, fixes, strict=True)]) * 1e-3
    sd = np.maximum(accuracy[:, [0, 0, 1]] / np.sqrt([2.0, 2.0, 1.0]), 1e-3)
    sd_v = np.maximum(np.repeat(accuracy[:, 2:], 3, 1) / np.sqrt(3.0), 1e-3)
    v = np.array([[m.velE, m.velN, -m.velD] for m in fixes]) * 1e-3
    order = np.unique(t, return_index=True)[1]
    remarks.add(
        "gnss.read_as",
        "GNSS: NAV-PVT, heights above the ellipsoid; sigmas hAcc/sqrt(2) east and north, vAcc up, sAcc/sqrt(3)",
    )
    if any(p is not m for p, m in zip(best, fixes, strict=True)):
        remarks.add(
            "gnss.position_read_as",
            "GNSS: positions are NAV-HPPOSLLH's, in tenths of a millimetre, where the log has them",
        )
    if any(m.fixType == 4 for m in fixes):
        remarks.add(
            "gnss.dead_reckoning",
            "some fixes are of GNSS and dead reckoning combined: they already have the receiver's IMU in them",
        )
    remarks.add(
        "gnss.lever_arm_unknown", "GNSS: position of the antenna; its lever arm is not in the log and taken as zero"
    )
    kinds = np.array([_classify_fix(m) for m in fixes])[order]
    used = np.array([float(m.numSV) for m in fixes])[order]
    return Gnss(t[order], llh[order], sd[order], v[order], sd_v[order], type=convert_fix_types(kinds), satellites=used)


def _classify_fix(message: Any) -> int:
    """Fix type of FIX_TYPES: by the carrier phases, then by the corrections; 0 for one that depends on an IMU."""
    if message.carrSoln in (1, 2):
        return 1 if message.carrSoln == 2 else 2
    return 0 if message.fixType == 4 else 4 if message.diffSoln else 5


def _read_sensors(path: Path, content: _Content, remarks: Notes) -> tuple[Imu | None, Odometer | None]:
    """The receiver's IMU and wheel speed, on the clock of the fixes if there are any."""
    series = {k: np.array(v, dtype=float).T for k, v in content.samples.items()}
    for one in series.values():
        one[0] = _unroll(one[0], _WRAP)
    there = [k for k in (*_GYRO, *_ACCEL) if k in series]
    if not series:
        return None, None
    tick, offset = _fit_clock(content, remarks)

    def unwrap_times(tags: Array) -> Array:
        return tags * tick + offset

    imu = None
    if len(there) == 6:
        base = np.unique(series[_GYRO[0]][0])
        columns = [np.interp(base, *_drop_repeated(series[k])) for k in (*_GYRO, *_ACCEL)]
        table = np.column_stack(columns)
        imu = Imu(unwrap_times(base), table[:, :3], table[:, 3:], noise_assumed=True)
        remarks.add("imu.read_as", "IMU: ESF rates and forces in the receiver's own axes; no noise figures in the log")
        remarks.add("imu.axes_assumed", "IMU: the receiver's axes taken as right-forward-up")
    elif there:
        remarks.add(
            "imu.axes_missing",
            f"IMU: only {len(there)} of its six axes are in the log ({path.name}), so it is not used",
        )
    odometer = None
    if _SPEED in series:
        tags, speed = _drop_repeated(series[_SPEED])
        odometer = Odometer(unwrap_times(tags), speed)
        remarks.add("odometer.read_as", "odometer: ESF speed")
        remarks.add("odometer.lever_arm_unknown", "odometer: its lever arm is not in the log and taken as zero")
    return imu, odometer


def _drop_repeated(series: Array) -> tuple[Array, Array]:
    """Time tags in order, without repetitions, and the values."""
    tags, first = np.unique(series[0], return_index=True)
    return tags, series[1][first]


def _fit_clock(content: _Content, remarks: Notes) -> tuple[float, float]:
    """Seconds per time tag, and GPS seconds of the week at tag 0, from the last tags before each fix."""
    if len(content.last_tag) < 2:
        remarks.add("log.sensor_clock_unknown", "clock of the sensors: their own time tags, taken as ms")
        return _TICKS[0], 0.0
    number, tags = np.array(content.last_tag, dtype=float).T
    tags = _unroll(tags, _WRAP)
    t = _unroll_tow(content.pvt)[number.astype(int)]
    slope = (t[-1] - t[0]) / max(tags[-1] - tags[0], 1.0)
    tick = min(_TICKS, key=lambda x: abs(np.log(max(slope, 1e-12) / x)))
    if abs(slope / tick - 1.0) > 0.01:
        tick = float(slope)
    remarks.add(
        "log.sensor_clock",
        f"clock of the sensors: time tags of {tick * 1e3:g} ms, set so that the newest tag before each NAV-PVT has its "
        "time; the receiver's delay, some 50 to 150 ms, is in the stamps: graphnav init finds it (time_offset)",
    )
    return tick, float(np.median(t - tick * tags))


FORMAT = log_format(
    "ubx",
    "u-blox UBX messages: NAV-PVT and, where present, ESF-MEAS or ESF-RAW",
    recognises,
    lambda path, _: load(path),
)
