"""The header of a RINEX observation file, versions 2.11, 3 and 4."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from graphnav.core import earth
from graphnav.core.errors import RecordingError
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array
from graphnav.gnss.files import Lines
from graphnav.gnss.signals import GLONASS, SYSTEMS

# of time; RINEX 4.01, table 2, in which GLO and UTC count leap seconds
_SCALES = ("GPS", "GLO", "GAL", "BDT", "QZS", "IRN", "UTC")
_MOST_TYPES = 200  # of a system; RINEX 4.01 has some 80
_TYPES_LABEL = (b"SYS / # / OBS TYPES", b"# / TYPES OF OBSERV")  # of version 3, and of 2


@dataclass
class Header:
    """Contents of the header of an observation file."""

    version: float = 0.0
    system: str = "G"
    types: dict[int, list[str]] = field(default_factory=dict)  # by system, in the file's order: "C1C"
    scale: str = "GPS"  # of time
    marker: Array | None = None  # (3,) m in e, rough position of the antenna
    channels: dict[int, int] = field(default_factory=dict)
    end: int = 0  # number of lines


def read_rinex_header(lines: Lines, path: Path) -> Header:
    """Read the header, up to END OF HEADER."""
    out, system, announced, above = Header(), -1, dict[int, int](), np.zeros(3)
    for k in range(len(lines)):
        text = lines.get_text(k)
        label, body = text[60:].strip(), text[:60]
        try:
            if label == "RINEX VERSION / TYPE":
                out.version = float(body[:9])
                if body[20:21] != "O":
                    raise RecordingError(
                        f"{path}: a RINEX file of type '{body[20:40].strip()}', not of observations", key="file.kind"
                    )
                out.system = body[40:41].strip() or "G"
            elif label == "SYS / # / OBS TYPES":
                if body[0] != " ":
                    system = SYSTEMS.find(body[0])
                    out.types[system], announced[system] = [], int(body[3:6])
                out.types.setdefault(system, []).extend(body[6:].split())
            elif label == "# / TYPES OF OBSERV":
                if body[:6].strip():
                    announced[-2] = int(body[:6])
                out.types.setdefault(-2, []).extend(body[6:].split())
            elif label == "APPROX POSITION XYZ":
                place = np.array(body.split(), dtype=float)
                out.marker = place if len(place) == 3 and 6e6 < np.linalg.norm(place) < 7e6 else None
            elif label == "ANTENNA: DELTA H/E/N" and body.strip():
                height, east, north = (float(word) for word in body.split()[:3])
                above = np.array([east, north, height])
            elif label == "SYS / SCALE FACTOR" and int(body[2:6]) != 1:
                raise RecordingError(
                    f"{path}, line {k + 1}: observations multiplied by {int(body[2:6])} are not read; write the file "
                    "without SYS / SCALE FACTOR",
                    key="rinex.scale",
                )
            elif label == "TIME OF FIRST OBS":
                out.scale = body[48:51].strip() or ("GLO" if out.system == "R" else "GPS")
                if out.scale not in _SCALES:
                    raise ValueError
            elif label == "GLONASS SLOT / FRQ #":
                words = body[3:].split()
                out.channels |= {
                    100 * GLONASS + int(name[1:]): int(number)
                    for name, number in zip(words[::2], words[1::2], strict=False)
                    if name[:1] == "R"
                }
            elif label == "END OF HEADER":
                out.end = k + 1
                break
        except (ValueError, IndexError):
            raise RecordingError(
                f"{path}, line {k + 1}: the header's '{label}' cannot be read", key="rinex.header"
            ) from None
        if k == 0 and not out.version:
            break
    if not out.version:
        raise RecordingError(f"{path}: not a RINEX file; its first line says no version", key="file.kind")
    if not out.end:
        raise RecordingError(f"{path}: the header has no END OF HEADER; the file is cut off", key="rinex.cut")
    if not 2.0 <= out.version < 5.0:
        raise RecordingError(f"{path}: RINEX version {out.version:g}; 2.11, 3 and 4 are read", key="rinex.version")
    for one, number in announced.items():
        if one != -1 and number != len(out.types[one]):
            of = f" of {SYSTEMS[one]}" if one >= 0 else ""
            raise RecordingError(
                f"{path}: the header announces {format_count(number, 'type')} of observations{of} and names "
                f"{len(out.types[one])}: a line of it is missing or changed",
                key="rinex.types",
            )
    if out.marker is not None and np.isfinite(above).all():
        out.marker = out.marker + earth.enu_axes(earth.ecef_to_llh(out.marker)).T @ above
    if out.version < 3.0:
        both = out.types.pop(-2, [])
        out.types = dict.fromkeys(range(len(SYSTEMS)), both)
    out.types.pop(-1, None)
    if not any(out.types.values()):
        raise RecordingError(f"{path}: the header names no types of observations", key="rinex.no_types")
    if (most := max(map(len, out.types.values()))) > _MOST_TYPES:
        raise RecordingError(
            f"{path}: the header names {most} types of observations of a system, more than there are", key="rinex.types"
        )
    return out


def check_types_stay(data: bytes, lines: Lines, header: Header, path: Path) -> None:
    """Check that no header further on, of a file that was appended or in an event, names other types.

    Raises
    ------
    RecordingError
        If one does: the columns after it would be read as those of other types.
    """
    first = {lines.get_text(k).rstrip() for k in range(header.end)}
    at, label = (
        int(lines.start[header.end]) if header.end < len(lines) else len(data),
        _TYPES_LABEL[header.version < 3.0],
    )
    while (at := data.find(label, at)) >= 0:
        k = int(np.searchsorted(lines.start, at, side="right")) - 1
        if (text := lines.get_text(k).rstrip()) not in first and text[60:].encode("latin-1") == label:
            raise RecordingError(
                f"{path}, line {k + 1}: the types of observations change here; make two files of it, each with its "
                "header",
                key="rinex.types_change",
            )
        at += len(label)
