"""NovAtel's ASCII logs: counts of the IMU, best positions and velocities, and the receiver's INS solution as the truth.

Fields are those of the OEM7 Commands and Logs Reference Manual (docs.novatel.com/OEM7: RAWIMU, RAWIMUX, BESTPOS,
BESTGNSSVEL, INSPVA, INSPVAX, 32-bit CRC). Scale factors of the counts by the type of the IMU are those of its table
"Raw IMU Scale Factors", as NovAtel's own novatel_oem7_driver has them (oem7_imu.cpp).
"""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from sys import intern

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_number, read_bytes
from graphnav.core.findings import compute_period
from graphnav.core.interpolation import pick_nearest
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import WEEK, date_week_times
from graphnav.recording import Gnss, Imu, Truth, convert_fix_types
from graphnav.recording.formats.registry import Log, log_format, read_first_bytes
from graphnav.recording.formats.repair import DEFAULT_SD_V
from graphnav.sensors.tables import LATEST

_HEADER = re.compile(rb"[#%][A-Z][A-Z0-9]{3,}A,[^;\r\n]{4,200};")
_BEGIN = re.compile(rb"[#%](?=[A-Z]{3})")
_G, _DEG = 9.80665, np.pi / 180
_GRAVITY_WITHIN = (
    0.08  # relative; scale factors differ by a fifth or more, a drive's median force from g by a hundredth
)

# by the manual's number of the IMU's type: rad and m/s per count of an increment
_INCREMENTS = {
    **dict.fromkeys((1, 5, 11, 20, 27, 28), (2.0**-33, 2.0**-27 / 3.2808)),  # HG1700 AG11 and AG58, HG1900, HG1930
    **dict.fromkeys((4, 12), (2.0**-33, 2.0**-26 / 3.2808)),  # HG1700 AG17 and AG62
    8: (2.0**-19, 2.0**-14),  # LN200
    13: (0.1 * 2.0**-8 / 3600 * _DEG, 0.05 * 2.0**-15),  # iMAR FSAS
    **dict.fromkeys((16, 33), (0.1 / (3600 * 256), 0.05 * 2.0**-15)),  # KVH CPT and 1750
    **dict.fromkeys((26, 52), (1e-9, 2e-8)),  # ISA-100C, uIMU
    31: (720 * 2.0**-31 * _DEG, 200 * 2.0**-31),  # ADIS16488
    **dict.fromkeys((32, 56), (2.0**-21 * _DEG, 2.0**-22)),  # STIM300
    **dict.fromkeys((58, 68, 69), (2.0**-33, 2.0**-29)),  # HG4930
}
# and of those that count rates: rad/s and m/s2
_RATES = {
    **dict.fromkeys((41, 62), (0.008 * 2.0**-16 * _DEG, 0.2e-3 * 2.0**-16 * _G)),  # Epson G320
    61: (0.0151515 * 2.0**-16 * _DEG, 0.4e-3 * 2.0**-16 * _G),  # Epson G370
}
# solution types -> FIX_TYPES; those of the INS have "INS_" before them
_TYPES = {
    "L1_INT": 1, "WIDE_INT": 1, "NARROW_INT": 1, "RTK_DIRECT_INS": 1, "RTKFIXED": 1, "L1_FLOAT": 2, "NARROW_FLOAT": 2,
    "IONOFREE_FLOAT": 2, "RTKFLOAT": 2, "WAAS": 3, "SBAS": 3, "PSRDIFF": 4, "SINGLE": 5, "PSRSP": 5, "PPP": 6,
    "PPP_CONVERGING": 6, "PPP_BASIC": 6, "PPP_BASIC_CONVERGING": 6,
}  # fmt: skip
_NOT_MEASURED = {"NONE", "FIXEDPOS", "FIXEDHEIGHT", "PROPAGATED"}
_INS_SOLVED = {"INS_SOLUTION_GOOD", "INS_ALIGNMENT_COMPLETE", "INS_SOLUTION_FREE"}


@dataclass(frozen=True)
class _Kind:
    """Where the parts of a log are among its fields."""

    fields: int  # at least
    numbers: tuple[int, ...]
    words: tuple[int, ...] = ()
    date: int | None = None  # of week and seconds; None: they are in the header


_IMU, _IMU_X = _Kind(9, tuple(range(3, 9)), date=0), _Kind(11, (1, *range(5, 11)), (0,), date=2)
_POSITION = _Kind(21, (2, 3, 4, 5, 8, 7, 9, 14), (0, 1))  # lat, lon, height, undulation, sigmas east, north, up, used
_VELOCITY = _Kind(8, (2, 4, 5, 6), (0, 1))  # latency, speed, course, up
_INS = _Kind(12, tuple(range(2, 11)), (11,), date=0)
_KINDS = {
    "RAWIMU": _IMU, "RAWIMUS": _IMU, "RAWIMUX": _IMU_X, "RAWIMUSX": _IMU_X, "BESTPOS": _POSITION,
    "BESTGNSSPOS": _POSITION, "BESTVEL": _VELOCITY, "BESTGNSSVEL": _VELOCITY, "INSPVA": _INS, "INSPVAS": _INS,
    "INSPVAX": _Kind(23, (2, 3, 4, *range(6, 12), 5), (0,)),
}  # fmt: skip
_SHORT = {"RAWIMUS": "RAWIMU", "RAWIMUSX": "RAWIMUX", "INSPVAS": "INSPVA"}  # the same with a short header

_Row = tuple[float, tuple[str, ...], tuple[float, ...]]  # s since the GPS epoch, words, numbers


@dataclass
class _Content:
    """The logs that are used, by name and in the order of the file, and what else is in it."""

    rows: dict[str, list[_Row]] = field(default_factory=dict)
    others: Counter[str] = field(default_factory=Counter)
    broken: list[int] = field(default_factory=list)  # numbers of lines
    undated: int = 0
    lines: int = 0

    def take(self, name: str, choose: Callable[[tuple[str, ...]], bool]) -> tuple[Array, list[tuple[str, ...]], Array]:
        """Times (N,) in order, without repetitions, words, and numbers (N, k) of the rows whose words are chosen."""
        some = [row for row in self.rows.get(name, ()) if choose(row[1])]
        t, first = np.unique(np.array([row[0] for row in some]), return_index=True)
        numbers = np.array([some[k][2] for k in first]).reshape(len(t), len(_KINDS[name].numbers))
        return t, [some[k][1] for k in first], numbers


def recognises(path: Path) -> bool:
    """Whether one of the first lines is an ASCII log, with a long (#) or a short header (%)."""
    return _HEADER.search(read_first_bytes(path, 1 << 16)) is not None


def load(path: Path) -> Log:
    """Read the IMU, the fixes of the antenna, and the INS solution as the truth.

    Raises
    ------
    RecordingError
        If nothing of these is in it, or it is not known what a count of the IMU is.
    """
    content, remarks = _collect_rows(path), Notes()
    if content.broken:
        remarks.add(
            "log.broken_lines",
            f"{path.name}, line {content.broken[0]}: not a sound log (CRC or form); skipped {len(content.broken)} of "
            f"{format_count(content.lines, 'line')}",
        )
    if content.undated:
        remarks.add(
            "log.rows_left_out", f"{format_count(content.undated, 'log')} from before GPS time was known left out"
        )
    zero = 0.0
    if content.rows:
        zero = date_week_times(np.array([min(row[0] for rows in content.rows.values() for row in rows)]))[1]
    imu = _read_imu(path, content, zero, remarks)
    gnss = _read_gnss(content, zero, remarks)
    truth = _read_truth(content, zero, remarks)
    if imu is None and gnss is None and truth is None:
        there = ", ".join(name for name, _ in content.others.most_common(8))
        raise RecordingError(
            f"{path}: no RAWIMU, RAWIMUX, BESTPOS, BESTGNSSPOS, INSPVA or INSPVAX with data in it"
            f"{''.join(f'; {remark}' for remark in remarks)}{f'; not read: {there}' if there else ''}",
            key="log.no_messages",
        )
    remarks.add("log.clock", "clock: seconds of the GPS week")
    return Log(path.stem, imu, gnss, None, truth, gps_zero=zero, mount_known=False, remarks=tuple(remarks))


def _collect_rows(path: Path) -> _Content:
    """The logs of known names that are whole, and of a time that the receiver knew."""
    content = _Content()
    for number, raw in enumerate(read_bytes(path).splitlines(), 1):
        begin = _BEGIN.search(raw)
        if begin is None:  # other protocols, prompts and blank lines
            continue
        content.lines += 1
        try:
            name, row = _parse_line(raw[begin.end() :].strip())
        except (ValueError, IndexError, OverflowError):
            content.broken.append(number)
            continue
        if row is None:
            content.others[name] += 1
        elif not WEEK < row[0] < LATEST:
            content.undated += 1
        else:
            content.rows.setdefault(name, []).append(row)
    return content


def _parse_line(line: bytes) -> tuple[str, _Row | None]:
    """The name of a log, and what is used of it, if it is.

    Raises
    ------
    ValueError, IndexError
        If it is damaged.
    """
    text, _, crc = line.rpartition(b"*")
    # the register begins at 0 and is not inverted at the end, unlike zlib's
    if len(crc) != 8 or int(crc, 16) != zlib.crc32(text, 0xFFFFFFFF) ^ 0xFFFFFFFF:
        raise ValueError("CRC")
    head, _, rest = text.decode("ascii").partition(";")
    fields, body = head.split(","), rest.split(",")
    name = fields[0].removesuffix("A")
    kind = _KINDS.get(name)
    if kind is None:
        return name, None
    if len(body) < kind.fields:
        raise ValueError("fields")
    dated = fields[5 if len(fields) > 3 else 1 :] if kind.date is None else body[kind.date :]
    t = WEEK * int(dated[0]) + parse_number(dated[1])
    words = tuple(intern(body[k]) for k in kind.words)
    numbers = tuple(parse_number(body[k]) for k in kind.numbers)
    if not all(map(isfinite, numbers)):
        raise ValueError("number")
    return _SHORT.get(name, name), (t, words, numbers)


def _read_imu(path: Path, content: _Content, zero: float, remarks: Notes) -> Imu | None:
    """Rates and forces in the axes of the IMU's body.

    Raises
    ------
    RecordingError
        If it is not known what a count is.
    """
    name = "RAWIMUX" if "RAWIMUX" in content.rows else "RAWIMU"
    # of the information's bits (hexadecimal), 0 is an error of the IMU and 1 encryption
    t, _, numbers = content.take(name, lambda words: not words or words[0][-1:] in "048cC")
    if left := len(content.rows.get(name, ())) - len(t):
        remarks.add(
            "imu.rows_left_out", f"IMU: {format_count(left, 'row')} repeated, with an error or encrypted left out"
        )
    if not len(t) and (corrected := [name for name in content.others if "CORRIMU" in name]):
        remarks.add(
            "imu.without_gravity", f"IMU: {', '.join(corrected)} is without gravity, and not used; log RAWIMUSX"
        )
    if len(t) < 2:
        return None
    z, y, x, gz, gy, gx = numbers[:, -6:].T  # y with its sign turned
    gyro, accel = np.stack([gx, -gy, gz], -1), np.stack([x, -y, z], -1)
    rate = 1.0 / compute_period(t)
    known = {kind: (g * rate, a * rate) for kind, (g, a) in _INCREMENTS.items()} | _RATES
    counts = float(np.median(np.linalg.norm(accel, axis=1)))
    fitting = {kind: scale for kind, scale in known.items() if abs(counts * scale[1] / _G - 1.0) < _GRAVITY_WITHIN}
    if name == "RAWIMU" and len(set(fitting.values())) != 1:
        raise RecordingError(
            f"{path}: RAWIMU does not say of which IMU it is, and by gravity the counts of "
            f"{len(set(fitting.values())) or 'no'} known ones fit; log RAWIMUX or RAWIMUSX",
            key="imu.scale",
        )
    kind = int(numbers[0, 0]) if name == "RAWIMUX" else min(fitting)
    if kind not in known:
        raise RecordingError(
            f"{path}: the scale factors of IMU type {kind} are not known; write its rows in rad/s and m/s2 as a CSV "
            "file, by the table of scale factors in NovAtel's manual",
            key="imu.scale",
        )
    if kind not in fitting:
        raise RecordingError(
            f"{path}: {name} of IMU type {kind} at {rate:.4g} Hz: the median force is {counts * known[kind][1]:.3g} "
            "m/s2, not gravity: a part of the rows was not logged, or the type is another's",
            key="imu.scale",
        )
    scale = known[kind]
    remarks.add(
        "imu.read_as",
        f"IMU: {name}, a count {scale[0]:.5g} rad/s and {scale[1]:.5g} m/s2, as of IMU type {kind}"
        f"{'' if name == 'RAWIMUX' else ', by gravity'} at {rate:.4g} Hz; no noise figures in the log",
    )
    remarks.add("imu.axes_assumed", "IMU: its axes taken as right-forward-up")
    return Imu(t - zero, gyro * scale[0], accel * scale[1], noise_assumed=True)


def _is_solved(words: tuple[str, ...]) -> bool:
    return words[0] == "SOL_COMPUTED" and words[1] not in _NOT_MEASURED


def _choose(content: _Content, gnss_only: str, any_source: str) -> str:
    """The log without the INS if it has solutions, else the other."""
    return gnss_only if any(_is_solved(row[1]) for row in content.rows.get(gnss_only, ())) else any_source


def _read_gnss(content: _Content, zero: float, remarks: Notes) -> Gnss | None:
    """Fixes with their types, and velocities of the same times."""
    name = _choose(content, "BESTGNSSPOS", "BESTPOS")
    t, words, numbers = content.take(name, _is_solved)
    states = Counter(
        words[1] if words[0] == "SOL_COMPUTED" else words[0]
        for _, words, _ in content.rows.get(name, ())
        if not _is_solved(words)
    )
    if states:
        many = ", ".join(f"{n} {state}" for state, n in sorted(states.items()))
        remarks.add("gnss.unsolved", f"GNSS: {name} without a measured position left out: {many}")
    if not len(t):
        return None
    lat, lon, height, undulation = numbers[:, :4].T
    llh = np.stack([np.radians(lat), np.radians(lon), height + undulation], -1)
    v, latency = _read_velocities(content, t, remarks)
    types = np.array([_TYPES.get(kind.removeprefix("INS_"), 0) for _, kind in words])
    if any(kind.startswith("INS_") for _, kind in words):
        remarks.add(
            "gnss.dead_reckoning",
            "some fixes are of GNSS and INS combined: they already have the receiver's IMU in them; log BESTGNSSPOS",
        )
    remarks.add("gnss.height_read_as", "heights: above the ellipsoid, as height and undulation add up")
    remarks.add(
        "gnss.lever_arm_unknown", "GNSS: position of the antenna; its lever arm is not in the log and taken as zero"
    )
    sd_v = None if v is None else np.where(np.isnan(v), np.nan, np.array(DEFAULT_SD_V))
    return Gnss(
        t - zero, llh, numbers[:, 4:7], v, sd_v, type=convert_fix_types(types), satellites=numbers[:, 7],
        velocity_offset=-latency,
    )  # fmt: skip


def _read_velocities(content: _Content, t: Array, remarks: Notes) -> tuple[Array | None, float]:
    """East, north, up (N, 3) m/s at the times of the fixes, NaN where there is none, and how long before them these
    are of, s: an average since the last solution is of half of that time before.
    """
    name = _choose(content, "BESTGNSSVEL", "BESTVEL")
    at, _, numbers = content.take(name, _is_solved)
    if not len(at):
        return None, 0.0
    latency = Counter(numbers[:, 0].tolist()).most_common(1)[0][0]
    k = pick_nearest(at, t)
    there = (np.abs(at[k] - t) < 1e-3) & (numbers[k, 0] == latency)
    _, speed, course, up = numbers[k].T
    course = np.radians(course)
    v = np.where(there[:, None], np.stack([speed * np.sin(course), speed * np.cos(course), up], -1), np.nan)
    least = f"{DEFAULT_SD_V[0]:g} m/s a horizontal axis and {DEFAULT_SD_V[2]:g} m/s up"
    remarks.add(
        "gnss.velocity_read_as",
        f"velocity: {name}, of {latency:g} s before its stamps, with {there.sum()} of "
        f"{format_count(len(t), 'fix', 'fixes')}; it states no sigmas, {least} are assumed",
    )
    return (v, latency) if there.any() else (None, 0.0)


def _read_truth(content: _Content, zero: float, remarks: Notes) -> Truth | None:
    """The solution of the receiver's INS; its y axis points forward, so that its angles are graphnav's."""
    for name in ("INSPVA", "INSPVAX"):
        t, _, numbers = content.take(name, lambda words: words[0] in _INS_SOLVED)
        if len(t):
            break
    else:
        return None
    height = numbers[:, 2] + (numbers[:, 9] if name == "INSPVAX" else 0.0)  # INSPVA's is above the ellipsoid
    llh = np.column_stack([np.radians(numbers[:, :2]), height])
    remarks.add(
        "truth.smoothed",
        f"truth: {name}, of the same receiver and IMU, so errors against it at the fixes say little; withhold some",
    )
    return Truth(t - zero, llh, v=numbers[:, [4, 3, 5]], rph=np.radians(numbers[:, 6:9]))


FORMAT = log_format(
    "novatel",
    "NovAtel's ASCII logs: RAWIMU or RAWIMUX, BESTPOS, BESTVEL, INSPVA and the like",
    recognises,
    lambda path, _: load(path),
)
