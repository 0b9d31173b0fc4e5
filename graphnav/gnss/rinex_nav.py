"""RINEX navigation files, versions 2, 3 and 4: broadcast ephemerides and ionosphere coefficients.

Fields are those of RINEX 2.11 (tables A4, A10), 3.05 (tables A6 to A14) and 4.01. Of version 4 the messages LNAV, INAV,
FNAV, D1, D2 and FDMA are read, which hold what the versions before it have.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_number
from graphnav.core.notes import Notes, format_count
from graphnav.core.timescales import GPS_EPOCH, WEEK, count_leap_seconds
from graphnav.gnss.ephemeris import Ephemerides, Glonass, Kepler
from graphnav.gnss.files import count_days, note_cut, unpack_bytes
from graphnav.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, NAVIC, QZSS, SBAS, SYSTEMS

_BDT = 14.0  # s, GPS minus BeiDou time
_BDT_WEEKS = 1356  # from the GPS to the BeiDou epoch
_RECORD_LINES = {GLONASS: 4, SBAS: 4}  # lines of a record by system; 8 for all others
_KNOWN_MESSAGES = {"LNAV", "INAV", "FNAV", "D1", "D2", "FDMA"}
_ROOTS = (2530.0, 8192.0)  # sqrt(m), of the semi-major axis: the range that IS-GPS-200N, table 20-III, gives it
_WEEKS = 6262  # of the GPS until 2100


@dataclass
class _Navigation:
    kepler: list[Kepler] = field(default_factory=list)
    glonass: list[Glonass] = field(default_factory=list)
    klobuchar: dict[str, list[float]] = field(default_factory=dict)
    skipped: dict[str, int] = field(default_factory=dict)
    broken: list[int] = field(default_factory=list)  # line numbers


def read_navigation(paths: list[Path]) -> Ephemerides:
    """Read all ephemerides of some files.

    Raises
    ------
    RecordingError
        If one is no RINEX navigation file, or none of them holds an ephemeris.
    """
    found = _Navigation()
    remarks = Notes()
    for path in paths:
        found.broken, found.skipped = [], {}
        remarks += _read(path, found)
        if found.broken:
            sentence = (
                f"{format_count(len(found.broken), 'unreadable record')} left out (the first at line {found.broken[0]})"
            )
            remarks.add("raw.broken_records", f"{path.name}: {sentence}")
        if found.skipped:
            names = ", ".join(f"{n} {name}" for name, n in sorted(found.skipped.items()))
            remarks.add("raw.unused_messages", f"{path.name}: messages that are not used: {names}")
    if not found.kepler and not found.glonass:
        raise RecordingError(f"{', '.join(str(p) for p in paths)}: no ephemeris in it", key="raw.no_ephemerides")
    coefficients = None
    if {"a", "b"} <= set(found.klobuchar):
        coefficients = np.array([found.klobuchar["a"], found.klobuchar["b"]])
    return Ephemerides.of(found.kepler, found.glonass, coefficients, tuple(remarks))


def _read(path: Path, found: _Navigation) -> tuple[str, ...]:
    """Read a file; returns remarks on where it ends."""
    data = unpack_bytes(path)
    lines = data.decode("latin-1").splitlines()
    try:
        version = float(lines[0][:9])
    except ValueError:
        raise RecordingError(f"{path}: not a RINEX file; its first line says no version", key="file.kind") from None
    kind = lines[0][20:21]
    if kind not in "NGH" or not 2.0 <= version < 5.0:
        raise RecordingError(
            f"{path}: a RINEX {version:g} file of type '{lines[0][20:40].strip()}', not of navigation", key="file.kind"
        )
    k = _read_header(lines, path, found)
    default = {"G": "R", "H": "S"}.get(kind, "G") if version < 3.0 else ""
    message = ""
    while k < len(lines):
        text = lines[k]
        if text.startswith(">"):  # version 4: type of the next record
            words = text[1:].split()
            message = words[2] if len(words) > 2 else ""
            if words[:1] != ["EPH"] or message not in _KNOWN_MESSAGES:
                end = next((j for j in range(k + 1, len(lines)) if lines[j].startswith(">")), len(lines))
                if (
                    words[:1] == ["ION"] and message == "LNAV" and words[1][:1] == "G"
                ):  # those of QZSS are for another region
                    _take_ionosphere(lines[k + 1 : end], found)
                elif words[:1] == ["EPH"]:
                    found.skipped[message] = found.skipped.get(message, 0) + 1
                k = end
                continue
            k += 1
            continue
        if not text.strip():
            k += 1
            continue
        name = (text[:3] if not default else default + text[:2]).replace(" ", "0")
        system = SYSTEMS.find(name[:1])
        count = _RECORD_LINES.get(system, 8)
        if system == GLONASS and version >= 3.05:
            count += k + 4 < len(lines) and lines[k + 4][:4] == "    " and bool(lines[k + 4].strip())
        if system < 0 and name[:1].isalpha() and name[1:].isdigit():
            reason = f"of the satellite system {name[0]}, which is not known"
            found.skipped[reason] = found.skipped.get(reason, 0) + 1
            k = _skip_record(lines, k)
            continue
        rest = lines[k + 1 : k + count]
        if k + count > len(lines) and all("   ".startswith(line[:3]) for line in rest) and (system >= 0 or not rest):
            return data.remarks or (note_cut(path.name, "record"),)
        if system < 0 or not name[1:].isdigit():
            found.broken.append(k + 1)
            k = _skip_record(lines, k)
            continue
        whole = len(rest) == count - 1 and all(line[:3] == "   " for line in rest)
        try:
            if not whole:
                raise ValueError
            at = 23 if not default else 22
            values = _parse_values([(text, at), *((line, at - 19) for line in rest)])
            _add(found, system, int(name[1:]), _parse_date(text, bool(default)), values, message)
        except (ValueError, IndexError):
            found.broken.append(k + 1)
        k = k + count if whole else _skip_record(lines, k)
    return data.remarks


def _skip_record(lines: list[str], k: int) -> int:
    """The line after that of k and those that continue it."""
    return next((j for j in range(k + 1, len(lines)) if lines[j][:3] != "   "), len(lines))


def _parse_values(rows: list[tuple[str, int]]) -> list[float]:
    """Clock terms of the first line, then four values per line; NaN for blanks."""
    out = []
    for number, (line, begin) in enumerate(rows):
        for i in range(3 if number == 0 else 4):
            text = line[begin + 19 * i : begin + 19 * (i + 1)].strip().replace("D", "E").replace("d", "e")
            out.append(parse_number(text) if text else np.nan)
    if np.isinf(out).any():
        raise ValueError
    return out


def _parse_date(text: str, short: bool) -> np.datetime64:
    fields = np.array([[parse_number(word) for word in (text[2:22] if short else text[3:23]).split()]])
    if fields.shape != (1, 6):
        raise ValueError
    if short:
        fields[:, 0] += 2000 if fields[0, 0] < 80 else 1900
    days, good = count_days(fields)
    if not good[0]:
        raise ValueError
    seconds = float(fields[0, 3:] @ (3600.0, 60.0, 1.0))
    return days[0].astype("datetime64[us]") + np.timedelta64(round(seconds * 1e6), "us")


def _add(found: _Navigation, system: int, number: int, date: np.datetime64, v: list[float], message: str) -> None:
    satellite = 100 * system + number
    clock = float((date - GPS_EPOCH) / np.timedelta64(1, "us")) * 1e-6
    if system in (GLONASS, SBAS):
        if system == SBAS:
            return
        ahead = float(count_leap_seconds(np.array([date]))[0])
        p, u, a = (np.array([v[3 + i], v[7 + i], v[11 + i]]) * 1e3 for i in range(3))
        if not np.isfinite([*p, *u, *a, v[0], v[1]]).all():
            raise ValueError
        channel = int(v[10])
        found.glonass.append(
            Glonass(
                satellite, 900.0 * np.round(clock / 900.0) + ahead, p, u, a, v[0], v[1],
                channel - 256 if channel > 128 else channel, v[6] == 0.0,
            )
        )  # fmt: skip
        return
    if system not in (GPS, GALILEO, BEIDOU, QZSS, NAVIC):
        return
    week, toes = v[21], v[11]
    toc, shift = clock, 0.0
    if system == BEIDOU:
        week, shift = week + _BDT_WEEKS, _BDT
    toe = WEEK * week + toes + shift
    toc += shift
    if not np.isfinite([*v[:20], week]).all() or not 0.0 <= v[8] < 1.0 or not 0.0 <= week < _WEEKS:
        raise ValueError
    if not _ROOTS[0] <= v[10] <= _ROOTS[1]:
        raise ValueError
    toe += WEEK * np.round((toc - toe) / WEEK)  # a week number that rolled over, or is that of the transmission
    source = int(v[20]) if np.isfinite(v[20]) else 0
    health = v[24] if np.isfinite(v[24]) else 0.0
    if system == QZSS:
        health = int(health) & 0xFE
    delay = [v[25], np.nan]
    if system in (GALILEO, BEIDOU):
        delay = [v[25], v[26]]
    fnav = system == GALILEO and (message == "FNAV" or (not message and bool(source & 0x102)))
    found.kepler.append(
        Kepler(
            satellite=satellite, toe=toe, toc=toc, clock=(v[0], v[1], v[2]), iode=v[3], crs=v[4], delta_n=v[5], m0=v[6],
            cuc=v[7], e=v[8], cus=v[9], root_a=v[10], toes=toes, cic=v[12], omega0=v[13], cis=v[14], i0=v[15],
            crc=v[16], omega=v[17], omega_dot=v[18], idot=v[19], accuracy=v[23] if v[23] > 0.0 else np.nan,
            healthy=health == 0.0, delay=(delay[0], delay[1]), fnav=fnav,
        )
    )  # fmt: skip


def _read_header(lines: list[str], path: Path, found: _Navigation) -> int:
    for k, line in enumerate(lines):
        label, body = line[60:].strip(), line[:60].replace("D", "E")
        try:
            if label == "ION ALPHA":
                found.klobuchar["a"] = _parse_coefficients(body[2:])
            elif label == "ION BETA":
                found.klobuchar["b"] = _parse_coefficients(body[2:])
            elif label == "IONOSPHERIC CORR" and line[:4] in ("GPSA", "GPSB"):
                found.klobuchar[line[3].lower()] = _parse_coefficients(body[5:])
        except ValueError:
            raise RecordingError(
                f"{path}, line {k + 1}: the header's '{label}' cannot be read", key="rinex.header"
            ) from None
        if label == "END OF HEADER":
            return k + 1
    raise RecordingError(f"{path}: the header has no END OF HEADER; the file is cut off", key="rinex.cut")


def _parse_coefficients(body: str) -> list[float]:
    """Four numbers of twelve columns each."""
    found = [parse_number(body[12 * i : 12 * (i + 1)]) for i in range(4)]
    if not np.isfinite(found).all():
        raise ValueError
    return found


def _take_ionosphere(lines: list[str], found: _Navigation) -> None:
    """Klobuchar coefficients of version 4, if complete."""
    if len(lines) < 3:
        return
    try:
        v = _parse_values([(lines[0], 23), (lines[1], 4), (lines[2], 4)])
    except ValueError:
        return
    if np.isfinite(v[:8]).all():
        found.klobuchar |= {"a": v[:4], "b": v[4:8]}
