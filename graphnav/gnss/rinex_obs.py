"""RINEX observation files, versions 2.11, 3 and 4, read as whole arrays.

Lines are sorted by kind (epochs, satellites of each system), and the fields of all lines of a kind are parsed at once.
The formats: RINEX 2.11 (Gurtner and Estey 2007), 3.05 and 4.01 (IGS/RTCM). Observation types of version 2 are renamed
as in RTKLIB 2.4.3 (rinex.c, convcode).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_number
from graphnav.core.notes import Notes, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import GPS_EPOCH, WEEK, count_leap_seconds
from graphnav.gnss.files import Lines, count_days, find_moved_points, note_cut, parse_numbers, unpack_bytes
from graphnav.gnss.rinex_header import Header, check_types_stay, read_rinex_header
from graphnav.gnss.series import Observations, drop_repeated
from graphnav.gnss.signals import (
    BEIDOU,
    GLONASS,
    GPS,
    QZSS,
    SBAS,
    SYSTEMS,
    Ids,
    is_known_signal,
    number_satellite,
    number_signal,
)

_SYSTEM_OF = np.full(256, -1)
for _k, _letter in enumerate(SYSTEMS):
    _SYSTEM_OF[ord(_letter)] = _k
_KINDS = "CLDS"
_AUXILIARY = "IXT"  # the ionosphere's phase, the receiver's channel, the Doppler shift of Transit
_FIELD_WIDTH = 16  # of a field: value F14.3, loss of lock I1, strength I1


@dataclass
class _SatelliteLines:
    """Satellite lines: epoch, satellite, and the positions of their fields."""

    line: NDArray[np.intp]
    epoch: NDArray[np.intp]
    satellite: Ids


Cells = Callable[[NDArray[np.intp], int], NDArray[np.uint8]]  # reads a number of fields of given rows
_Body = tuple[Array, float, NDArray[np.intp], _SatelliteLines, Cells]  # stamps, their zero, flags of the epochs


def read_observations(path: Path) -> Observations:
    """Read the observations of a RINEX file.

    Raises
    ------
    RecordingError
        If it is no RINEX observation file, or a line of it cannot be read, naming the line.
    """
    return parse_observations(unpack_bytes(path), path)


def parse_observations(data: bytes, path: Path) -> Observations:
    """Parse the content of a RINEX file; `path` is only for messages."""
    lines = Lines(data)
    header = read_rinex_header(lines, path)
    check_types_stay(data, lines, header, path)
    remarks = Notes()
    stamp, zero, flag, rows, cells = (_read_version_2 if header.version < 3.0 else _read_version_3)(
        lines, header, path, remarks
    )
    if not len(rows.line):
        raise RecordingError(f"{path}: holds a header and no observations", key="file.no_rows")
    unknown: set[str] = set()
    parts = []
    for system, types in header.types.items():
        own = np.flatnonzero(rows.satellite // 100 == system)
        if not len(own):
            continue
        block = cells(own, len(types)).reshape(len(own), len(types), _FIELD_WIDTH)
        try:
            value = parse_numbers(block[:, :, :14].reshape(len(own), -1), 14)
            if find_moved_points(block[:, :, :14]).any():
                raise ValueError
        except ValueError:
            raise _refuse_field(rows, own, types, block[:, :, :14], path) from None
        value[value == 0.0] = np.nan  # absent (RINEX 2.11, table A2)
        lli = block[:, :, 14].astype(np.intp) - 48
        lli[(lli < 0) | (lli > 9)] = 0
        named = [_translate_name(name, system, header.version) for name in types]
        unknown |= {
            f"{SYSTEMS[system]} {name}"
            for name, there in zip(named, np.isfinite(value).T, strict=True)
            if there.any() and name[0] not in _AUXILIARY and not _is_known_type(system, name)
        }
        for signal in dict.fromkeys(name[1:] for name in named if is_known_signal(system, name[1:])):
            at = {kind: [k for k, name in enumerate(named) if name == kind + signal] for kind in _KINDS}
            one = {kind: _take_first(value[:, some]) for kind, some in at.items()}
            there = ~np.isnan(one["C"]) | ~np.isnan(one["L"])
            lost = lli[:, at["L"][0]] if at["L"] else np.zeros(len(own), dtype=np.intp)
            k = rows.epoch[own]
            parts.append(
                (
                    stamp[k][there], rows.satellite[own][there],
                    np.full(int(there.sum()), number_signal(signal), dtype=np.int16),
                    *(one[kind][there] for kind in _KINDS),
                    ((lost & 1 > 0) | (flag[k] == 1))[there], (lost & 2 > 0)[there],
                )
            )  # fmt: skip
    if not parts:
        raise RecordingError(f"{path}: no code or carrier of a known signal", key="rinex.no_signal")
    if bare := sorted({SYSTEMS[one] for one in np.unique(rows.satellite // 100) if not header.types.get(int(one))}):
        sentence = f"observations of {', '.join(bare)} left out: the header names no types of theirs"
        remarks.add("raw.no_types", f"{path.name}: {sentence}")
    if unknown:
        names = ", ".join(sorted(unknown))
        remarks.add("raw.unknown_signals", f"{path.name}: signals not known are left out: {names}")
    t, satellite, signal_of, code, carrier, doppler, cn0, slip, half = (
        np.concatenate(x) for x in zip(*parts, strict=True)
    )
    return drop_repeated(
        Observations(
            zero, t, satellite, signal_of, code, carrier, doppler, cn0, slip, half, np.full(len(t), np.nan),
            header.channels, header.marker, (str(path),), tuple(remarks),
        )
    )  # fmt: skip


def _is_known_type(system: int, name: str) -> bool:
    return name[0] in _KINDS and is_known_signal(system, name[1:])


def _translate_name(name: str, system: int, version: float) -> str:
    """A type by its name of version 3.05."""
    if version >= 3.0:
        if system == BEIDOU and name[1:] in (("1I", "1Q", "1X") if version < 3.035 else ("1I", "1Q")):
            return name[0] + "2" + name[2:]  # B1I until 3.03, and in files of programs that kept it; 1X is B1C since
        return name
    kind, band = ("C", name[1:]) if name[0] in "CP" else (name[0], name[1:])
    if name[0] == "P":
        attribute = "P" if system == GLONASS else "W"
    elif band == "1":
        attribute = "C" if system in (GPS, GLONASS, QZSS, SBAS) else "X"
    elif band == "2":
        # the carrier on L2 is that of P2, and C2 another code on it
        attribute = {GPS: "X" if kind == "C" else "W", GLONASS: "C" if kind == "C" else "P"}.get(system, "X")
    else:
        attribute = "X"
    return f"{kind}{band}{attribute}"


def _count_since_week(fields: Array, scale: str, used: NDArray[np.bool_]) -> tuple[Array, float]:
    """Seconds (n,) of the GPS week of the first used date (n, 6), and that week's start (s since the GPS epoch).

    Days and seconds are kept separate: in double precision, seconds since the epoch resolve 0.2 us only.
    """
    days, good = count_days(fields)
    hour, minute, second = np.where(good[:, None], fields, 0.0).T[3:]
    since = (days - GPS_EPOCH.astype("M8[D]")).astype(np.int64)
    week = int(since[used][0]) // 7
    ahead = 0.0
    if scale in ("GLO", "UTC"):
        ahead = float(count_leap_seconds(days[used][:1])[0])
    ahead += 14.0 if scale == "BDT" else 0.0
    return (since - 7 * week) * 86400.0 + hour * 3600.0 + minute * 60.0 + second + ahead, week * WEEK


def _read_version_3(lines: Lines, header: Header, path: Path, remarks: Notes) -> _Body:
    first = lines.list_first_bytes()
    first[: header.end] = 0
    epoch = np.flatnonzero(first == ord(">"))
    if not len(epoch):
        raise RecordingError(f"{path}: holds a header and no observations", key="file.no_rows")
    try:
        fields = _parse_calendar(lines, epoch, 2, 4)
        flag, count = parse_numbers(lines.take_block(epoch, 29, 35), 3).T
    except ValueError:
        raise _refuse_epoch(lines, epoch, path) from None
    bad = (flag < 0) | (count < 0) | (~count_days(fields)[1] & ~(flag > 1))
    if bad.any():
        raise _refuse_epoch(lines, epoch[bad], path)
    flag, count = np.nan_to_num(flag).astype(int), np.nan_to_num(count).astype(int)
    system = _SYSTEM_OF[first]
    own = np.flatnonzero((system >= 0) | _names_satellite(lines.take_block(np.arange(len(lines)), 0, 3)))
    of = np.searchsorted(epoch, own) - 1
    keep = (of >= 0) & (own - epoch[np.maximum(of, 0)] <= count[np.maximum(of, 0)]) & (flag[np.maximum(of, 0)] <= 1)
    own, of = own[keep], of[keep]
    _say_cut(epoch, of, flag, count, path, remarks)
    known = system[own] >= 0
    _say_unknown([chr(letter) for letter in first[own[~known]]], path, remarks)
    own, of = own[known], of[known]
    if len(own) and own[-1] == len(lines) - 1 and not lines.whole:
        own, of = own[:-1], of[:-1]  # its last field may be cut
    if not (flag <= 1).any():
        raise RecordingError(f"{path}: holds a header and no observations", key="file.no_rows")
    stamp, zero = _count_since_week(fields, header.scale, flag <= 1)
    try:
        number = parse_numbers(lines.take_block(own, 1, 3), 2)[:, 0]
    except ValueError:
        number = np.full(len(own), np.nan)
    wrong = ~(number >= 1)
    if wrong.any():
        k = own[wrong][0]
        raise RecordingError(
            f"{path}, line {k + 1}: '{lines.get_text(k)[:3]}' names no satellite", key="rinex.satellite"
        )
    satellite = (100 * system[own] + number).astype(np.int16)
    rows = _SatelliteLines(own, of, satellite)

    def read_cells(which: NDArray[np.intp], types: int) -> NDArray[np.uint8]:
        return lines.take_block(rows.line[which], 3, 3 + _FIELD_WIDTH * types)

    return stamp, zero, flag, rows, read_cells


def _take_first(value: Array) -> Array:
    """(n,) the first finite number of each row of (n, m), else NaN."""
    out = np.full(len(value), np.nan)
    for column in value.T[::-1]:
        out = np.where(np.isnan(column), out, column)
    return out


def _parse_calendar(lines: Lines, epoch: NDArray[np.intp], begin: int, year: int) -> Array:
    """(n, 6) date and time of epoch lines, year first."""
    n = len(epoch)
    whole = [parse_numbers(lines.take_block(epoch, begin, begin + year), year)]
    at = begin + year
    for _ in range(4):
        whole.append(parse_numbers(lines.take_block(epoch, at, at + 3), 3))
        at += 3
    whole.append(parse_numbers(lines.take_block(epoch, at, at + 11), 11))
    return np.concatenate(whole, axis=1).reshape(n, 6)


def _read_version_2(lines: Lines, header: Header, path: Path, remarks: Notes) -> _Body:
    types = len(next(iter(header.types.values())))
    each = -(-types // 5)  # lines of a satellite
    epochs: list[int] = []
    flags: list[int] = []
    first_line: list[int] = []
    of: list[int] = []
    satellite: list[int] = []
    unknown: list[str] = []
    k, cut = header.end, False
    while k < len(lines):
        text = lines.get_text(k)
        if not text.strip():
            k += 1
            continue
        try:
            flag, count = int(text[26:29] or 0), int(text[29:32])
        except ValueError:
            raise RecordingError(
                f"{path}, line {k + 1}: expected the line of an epoch, found '{text[:32]}'", key="rinex.epoch"
            ) from None
        if flag < 0 or count < 0:
            raise RecordingError(
                f"{path}, line {k + 1}: an epoch of {count} satellites with the flag {flag}", key="rinex.epoch"
            )
        if flag > 1:
            k += 1 + count
            continue
        more = max(1, -(-count // 12))
        names = "".join(lines.get_text(j)[32:68].ljust(36) for j in range(k, min(k + more, len(lines))))
        begin = k + more
        whole = min(count, max(0, (len(lines) - begin) // each))
        if whole < count or (begin + count * each == len(lines) and not lines.whole):
            cut = True
            whole = max(0, whole - (0 if lines.whole else int(whole == count)))
        for i in range(whole):
            name = names[3 * i : 3 * i + 3]
            number = SYSTEMS.find(name[:1] if name[:1].strip() else (header.system if header.system != "M" else "G"))
            try:
                one = number_satellite(SYSTEMS[max(number, 0)] + name[1:])
            except ValueError:
                raise RecordingError(
                    f"{path}, line {k + 1}: '{name}' names no satellite", key="rinex.satellite"
                ) from None
            if number >= 0:
                satellite.append(one)
                of.append(len(epochs))
                first_line.append(begin + i * each)
            else:
                unknown.append(name[0])
        epochs.append(k)
        flags.append(flag)
        k = begin + count * each
    _say_unknown(unknown, path, remarks)
    if cut:
        remarks.append(note_cut(path.name, "record"))
    epoch = np.array(epochs, dtype=np.intp)
    if not len(epoch):
        raise RecordingError(f"{path}: holds a header and no observations", key="file.no_rows")
    try:
        fields = _parse_calendar(lines, epoch, 0, 3)
    except ValueError:
        raise _refuse_epoch(lines, epoch, path, 0) from None
    fields[:, 0] += np.where(fields[:, 0] < 80, 2000, 1900)
    if (bad := ~count_days(fields)[1]).any():
        raise _refuse_epoch(lines, epoch[bad], path, 0)
    rows = _SatelliteLines(
        np.array(first_line, dtype=np.intp), np.array(of, dtype=np.intp), np.array(satellite, dtype=np.int16)
    )

    def read_cells(which: NDArray[np.intp], types: int) -> NDArray[np.uint8]:
        parts = [lines.take_block(rows.line[which] + j, 0, 5 * _FIELD_WIDTH) for j in range(each)]
        return np.concatenate(parts, axis=1)[:, : _FIELD_WIDTH * types]

    stamp, zero = _count_since_week(fields, header.scale, np.ones(len(epoch), dtype=bool))
    return stamp, zero, np.array(flags), rows, read_cells


def _say_cut(
    epoch: NDArray[np.intp], of: NDArray[np.intp], flag: NDArray[np.intp], count: NDArray[np.intp], path: Path,
    remarks: Notes,
) -> None:  # fmt: skip
    """Remarks about epochs with fewer lines of satellites than they announce."""
    short = np.flatnonzero((np.bincount(of, minlength=len(epoch)) < count) & (flag <= 1))
    if len(short) == 1 and short[0] == len(epoch) - 1:
        remarks.append(note_cut(path.name, "record"))
    elif len(short):
        some, line = format_count(len(short), "epoch"), epoch[short[0]] + 1
        sentence = f"{some} with fewer satellites than announced, the first at line {line}"
        remarks.add("raw.short_epochs", f"{path.name}: {sentence}")


def _names_satellite(name: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(n,) which names (n, 3) are a letter and a number, whatever the system."""
    letter, tens, ones = name.T
    digit = (ones >= ord("0")) & (ones <= ord("9"))
    ten = (tens == ord(" ")) | ((tens >= ord("0")) & (tens <= ord("9")))
    return np.asarray((letter >= ord("A")) & (letter <= ord("Z")) & ten & digit)


def _say_unknown(letters: list[str], path: Path, remarks: Notes) -> None:
    """A remark about observations of satellites of systems that are not known, by their letters."""
    if letters:
        some = ", ".join(f"{letters.count(one)} of {one}" for one in sorted(set(letters)))
        sentence = f"observations of satellite systems not known are left out: {some} (known: {', '.join(SYSTEMS)})"
        remarks.add("raw.unknown_systems", f"{path.name}: {sentence}")


def _refuse_epoch(lines: Lines, epoch: NDArray[np.intp], path: Path, begin: int = 2) -> RecordingError:
    """The error for the first invalid epoch line; dates begin at column `begin`, 0 in version 2 (two-digit years)."""
    end = begin + 27 if begin else 26
    for k in epoch:
        text = lines.get_text(k)
        try:
            date = np.array([[parse_number(word) for word in text[begin:end].split()]])
            date[:, 0] += 0 if begin else np.where(date[:, 0] < 80, 2000, 1900)
            flag, count = (int(text[at : at + 3].strip() or 0) for at in (end, end + 3))
            if date.shape == (1, 6) and count_days(date)[1].all() and min(flag, count) >= 0:
                continue
        except (ValueError, IndexError):
            pass
        return RecordingError(f"{path}, line {k + 1}: '{text[:35]}' is not the line of an epoch", key="rinex.epoch")
    return RecordingError(f"{path}: the line of an epoch cannot be read", key="rinex.epoch")


def _refuse_field(
    rows: _SatelliteLines, own: NDArray[np.intp], types: list[str], block: NDArray[np.uint8], path: Path
) -> RecordingError:
    """The error for the first field that is not a number, of the fields (n, m, 14) of some rows."""
    for k, cells, elsewhere in zip(own, block, find_moved_points(block), strict=True):
        for name, cell, wrong in zip(types, cells, elsewhere, strict=True):
            text = bytes(cell).decode("latin-1").strip()
            where = f"{path}, line {rows.line[k] + 1}, {name}: '{text}'"
            if wrong:
                return RecordingError(f"{where} does not stand in its columns", key="table.cell")
            try:
                if not np.isfinite(parse_number(text or "0")):
                    raise ValueError
            except ValueError:
                return RecordingError(f"{where} is not a number", key="table.cell")
    return RecordingError(f"{path}: a field is not a number", key="table.cell")
