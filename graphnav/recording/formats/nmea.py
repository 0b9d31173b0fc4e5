"""NMEA 0183 sentences of any receiver: GGA positions, GST sigmas, RMC and VTG speed and course, ZDA and RMC dates.

Sentences with the same time of day make one fix. Parsed and checked by pynmeagps; the standard does not require
checksums of them, so those of a file without any are not.
"""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_number, read_bytes
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import count_leap_seconds, date_week_times, utc_to_gps
from graphnav.recording import Gnss, convert_fix_types
from graphnav.recording.formats import novatel, ubx
from graphnav.recording.formats.courses import compute_horizontal_velocity
from graphnav.recording.formats.registry import Log, log_format, read_first_bytes
from graphnav.recording.formats.repair import DEFAULT_SD, DEFAULT_SD_V, NMEA_TYPES

KNOTS = 1852 / 3600  # m/s
KMH = 1 / 3.6
_DAY = 86400.0
_SENTENCE = re.compile(rb"(?:^|[\s>\])|:])\$(?!P)[A-Za-z]{5},")
_CHECKSUM = re.compile(rb"\*[0-9A-Fa-f]{2}\s*$", re.MULTILINE)
# 1-sigma (m, one horizontal axis) by GGA's quality, multiplied by HDOP, where there is no GST: user range errors of
# the standard service and of corrections of the code; fixed and float carrier phases as receivers state them
_BY_QUALITY = {1: 2.5, 2: 1.0, 4: 0.02, 5: 0.4}


_NOT_MEASURED = (6, 7, 8)  # GGA's quality: dead reckoning, manual input, simulator


@dataclass
class _Epoch:
    """The data of the sentences of one time; angles in degrees."""

    time: float  # s of the UTC day
    line: int
    gga: Any = None
    gst: Any = None
    speed: float | None = None  # m/s
    course: float | None = None  # deg
    date: datetime.date | None = None


def recognises(path: Path) -> bool:
    """Whether one of the first lines holds a sentence ($, talker and type, a comma) and the file is not mainly UBX or
    NovAtel's.

    A logger may have put the time before it.
    """
    if ubx.recognises(path) or novatel.recognises(path):
        return False
    lines = read_first_bytes(path).splitlines()[:20]
    return any(_SENTENCE.search(line) for line in lines)


def load(path: Path) -> Log:
    """Fixes of the antenna.

    Raises
    ------
    RecordingError
        If no sentence gives a position, naming the first line that is no sentence, if any.
    """
    remarks = Notes()
    data = read_bytes(path)
    checked = _CHECKSUM.search(data) is not None
    if not checked:
        remarks.add("log.no_checksums", "no sentence has a checksum: all are taken as they are")
    epochs, broken, lines = _collect_epochs(data, checked)
    if broken:
        remarks.add(
            "log.broken_lines",
            f"{path.name}, line {broken[0]}: not a sound sentence (checksum or form); skipped {len(broken)} of "
            f"{format_count(lines, 'line')}",
        )
    ggas = [e for e in epochs if e.gga is not None]
    fixes = [e for e in ggas if e.gga.quality not in (0, *_NOT_MEASURED) and e.gga.lat != ""]
    if not fixes:
        raise RecordingError(_explain_no_fix(path, ggas, broken), key="log.no_positions")
    simulated = sum(e.gga is not None and e.gga.quality in _NOT_MEASURED for e in epochs)
    if simulated:
        remarks.add(
            "gnss.not_measured",
            f"{format_count(simulated, 'GGA position')} by dead reckoning, manual input or a simulator left out",
        )
    t, zero = _date_fixes(epochs, fixes, remarks)
    separation = np.array([_parse_field(e.gga.sep) for e in fixes])
    height = np.array([_parse_field(e.gga.alt) for e in fixes])
    if np.isnan(separation).any():
        remarks.add(
            "gnss.height_above_sea",
            "GGA without the geoid's height: heights are above mean sea level there, not above the ellipsoid",
        )
    else:
        remarks.add(
            "gnss.height_read_as", "heights: above the ellipsoid, as GGA's altitude and geoid separation add up"
        )
    llh = np.stack(
        [
            np.radians([_parse_field(e.gga.lat) for e in fixes]),
            np.radians([_parse_field(e.gga.lon) for e in fixes]),
            height + np.nan_to_num(separation),
        ],
        -1,
    )
    sd = _read_sigmas(fixes, remarks)
    v, sd_v = _read_velocities(fixes, remarks)
    order = np.argsort(t, kind="stable")
    order = order[np.concatenate([[True], np.diff(t[order]) > 0]) & np.isfinite(llh[order]).all(-1)]
    if not len(order):
        raise RecordingError(f"{path}: no GGA sentence has a height beside its position", key="log.no_positions")
    if len(order) < len(t):
        remarks.add(
            "gnss.rows_left_out",
            f"left out {format_count(len(t) - len(order), 'fix', 'fixes')} without a height or with another's time",
        )
    kinds = convert_fix_types(np.array([e.gga.quality for e in fixes])[order], NMEA_TYPES)
    v, sd_v = (None if x is None else x[order] for x in (v, sd_v))
    satellites = np.array([_parse_field(e.gga.numSV) for e in fixes])[order]
    gnss = Gnss(t[order], llh[order], sd[order], v, sd_v, type=kinds, satellites=satellites)
    remarks.add(
        "gnss.lever_arm_unknown", "GNSS: position of the antenna; its lever arm is not in the log and taken as zero"
    )
    return Log(path.stem, gnss=gnss, gps_zero=zero, remarks=tuple(remarks))


def _explain_no_fix(path: Path, ggas: list[_Epoch], broken: list[int]) -> str:
    """Why no sentence gives a position."""
    if ggas:
        not_measured = sum(e.gga.quality in _NOT_MEASURED for e in ggas)
        words = f"{path}: none of its {format_count(len(ggas), 'GGA sentence')} has a measured position"
        return words + (f" ({not_measured} by dead reckoning, manual input or a simulator)" if not_measured else "")
    at = f", line {broken[0]}: not a sound sentence (checksum or form), and" if broken else ":"
    return f"{path}{at} no GGA sentence, which gives position and height, with a right checksum is in it"


def _collect_epochs(data: bytes, checked: bool) -> tuple[list[_Epoch], list[int], int]:
    """Epochs in the order of the file, the numbers of invalid lines, and the number of non-empty lines.

    Checksums must be there and right if they are to be `checked`.
    """
    import pynmeagps

    epochs: list[_Epoch] = []
    broken: list[int] = []
    count = 0
    for number, raw in enumerate(data.splitlines(), 1):
        start = raw.find(b"$")
        if start < 0:
            count += bool(raw.strip())
            broken += [number] if raw.strip() else []
            continue
        count += 1
        kind = raw[start + 3 : start + 6]
        if kind not in (b"GGA", b"GST", b"RMC", b"VTG", b"ZDA"):
            continue
        if b"_" in raw[start:] or not raw[start:].isascii():  # which Python's int and float accept as digits
            broken.append(number)
            continue
        try:
            own = b"" if checked else b"*%02X" % reduce(xor, raw[start + 1 :].strip())  # which the parser requires
            message = pynmeagps.NMEAReader.parse(raw[start:].strip() + own + b"\r\n")
        except Exception:  # the parser's own errors and any that a truncated line causes in it
            broken.append(number)
            continue
        time = getattr(message, "time", None)
        if isinstance(time, datetime.time):
            seconds = time.hour * 3600 + time.minute * 60 + time.second + time.microsecond * 1e-6
            if not epochs or epochs[-1].time != seconds:
                epochs.append(_Epoch(seconds, number))
        elif kind != b"VTG" or not epochs:
            continue
        try:
            _add_sentence(epochs[-1], kind, message)
        except (AttributeError, TypeError, ValueError):  # no number, or a missing field, despite a correct checksum
            broken.append(number)
    return epochs, broken, count


def _add_sentence(epoch: _Epoch, kind: bytes, message: Any) -> None:
    if kind == b"GGA":
        for value in (message.lat, message.lon, message.alt, message.sep, message.HDOP):
            _parse_field(value)
        if message.lat != "" and (message.NS not in ("N", "S") or message.EW not in ("E", "W")):
            raise ValueError("no hemisphere")
        epoch.gga = message
    elif kind == b"GST":
        for value in (message.stdLong, message.stdLat, message.stdAlt):
            _parse_field(value)
        epoch.gst = message
    elif kind == b"RMC":
        if message.status == "A" and message.spd != "":
            epoch.speed, epoch.course = _parse_field(message.spd) * KNOTS, _parse_field(message.cog)
        epoch.date = message.date if isinstance(message.date, datetime.date) else None
    elif kind == b"ZDA":
        try:
            date = datetime.date(int(message.year), int(message.month), int(message.day))
            epoch.date = date if date.year >= 1980 else None  # before GPS existed
        except (TypeError, ValueError):
            epoch.date = None
    elif epoch.speed is None and (message.sogk != "" or message.sogn != ""):
        epoch.speed = _parse_field(message.sogk) * KMH if message.sogk != "" else _parse_field(message.sogn) * KNOTS
        epoch.course = _parse_field(message.cogt)


def _parse_field(value: Any) -> float:
    if value in ("", None):
        return float("nan")
    try:
        return parse_number(value) if isinstance(value, str) else float(value)
    except OverflowError:  # an integer of hundreds of digits
        return float("nan")


def _date_fixes(epochs: list[_Epoch], fixes: list[_Epoch], remarks: Notes) -> tuple[Array, float | None]:
    """GPS seconds of week of the fixes and where the week begins; a step back by half a day starts the next day."""
    days, day, before = {}, 0, epochs[0].time
    for e in epochs:
        day += e.time < before - 0.5 * _DAY
        days[e.line], before = day, e.time
    dated = next((e for e in epochs if e.date is not None), None)
    of_day = np.array([e.time + _DAY * days[e.line] for e in fixes])
    if dated is None or dated.date is None:
        remarks.add(
            "log.clock_unknown",
            "clock: seconds of the UTC day; no RMC or ZDA sentence gives a date, so it is not GPS time",
        )
        return of_day, None
    midnight = np.datetime64(dated.date, "us") - np.timedelta64(days[dated.line], "D")
    utc = midnight + (of_day * 1e6).round().astype("timedelta64[us]")
    t, zero = date_week_times(utc_to_gps(utc))
    ahead = int(count_leap_seconds(utc)[0])
    remarks.add(
        "log.clock",
        f"clock: UTC turned into GPS time ({ahead} leap seconds in {dated.date.year}), seconds of the GPS week",
    )
    return t, zero


def _read_sigmas(fixes: list[_Epoch], remarks: Notes) -> Array:
    sd = np.full((len(fixes), 3), np.nan)
    for k, e in enumerate(fixes):
        if e.gst is not None:
            sd[k] = [_parse_field(e.gst.stdLong), _parse_field(e.gst.stdLat), _parse_field(e.gst.stdAlt)]
    without = ~(sd > 0).all(-1)
    if not without.any():
        remarks.add("gnss.sigma_read_as", "position sigmas: from GST")
        return sd
    for k in np.flatnonzero(without).tolist():
        e = fixes[k].gga
        hdop = _parse_field(e.HDOP)
        axis = _BY_QUALITY.get(e.quality, DEFAULT_SD[0]) * (hdop if hdop > 0 else 1.0)
        sd[k] = axis, axis, 2.0 * axis
    remarks.add(
        "gnss.sigma_of_hdop",
        f"fixes without GST: {without.sum()} of {len(fixes)}; their sigmas are GGA's HDOP times 2.5 m (autonomous), "
        "1 m (differential), 0.4 m (float) or 0.02 m (fixed), twice that in height",
    )
    return sd


def _read_velocities(fixes: list[_Epoch], remarks: Notes) -> tuple[Array | None, Array | None]:
    speed = np.array([np.nan if e.speed is None else e.speed for e in fixes])
    course = np.radians([np.nan if e.course is None else e.course for e in fixes])
    if np.isnan(speed).all():
        return None, None
    v, sd_v, sentence = compute_horizontal_velocity(speed, course, np.array(DEFAULT_SD_V))
    remarks.add("gnss.velocity_of_course", sentence)
    return v, sd_v


FORMAT = log_format("nmea", "NMEA 0183 sentences of a receiver", recognises, lambda path, _: load(path))
