"""RTKLIB's solutions (.pos), as outsolheads and outsols of RTKLIB 2.4.3 and demo5 write them (solution.c).

Date and time, or week and seconds, in GPS time, UTC or JST; latitude, longitude (degrees, or degrees, minutes and
seconds) and height, Earth-centred x, y, z, or east, north, up of a base whose place the header states; Q, ns, standard
deviations, and with out-outvel velocities. A covariance is written as the root of its size, with its sign.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphnav.core.earth import LocalFrame, ecef_to_llh, enu_axes
from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes
from graphnav.core.rotation import Array
from graphnav.core.timescales import GPS_EPOCH, GPS_TO_UNIX, WEEK, date_week_times, unix_to_gps
from graphnav.recording.formats.text import NumberedLines, parse_table

_ZONES = {"UTC": 0.0, "JST": 9 * 3600.0}  # s ahead of UTC
_NUMBER = r"[-+]?\d+(?:\.\d*)?"
# the columns of a position, the letters of its axes in those of sigmas, and the order of east, north, up in them
_FORMS = {
    "latitude": (("latitude", "longitude", "height"), "neu", (1, 0, 2)),
    "x-ecef": (("x-ecef", "y-ecef", "z-ecef"), "xyz", (0, 1, 2)),
    "e-baseline": (("e-baseline", "n-baseline", "u-baseline"), "enu", (0, 1, 2)),
}


@dataclass(frozen=True)
class RtklibSolution:
    """The rows of a .pos file; missing columns are None."""

    t: Array  # (K,) s of the GPS week in which the first row lies
    gps_zero: float  # beginning of that week, s since the GPS epoch
    llh: Array  # (K, 3) rad, rad, m
    sd_p: Array | None  # (K, 3) m, east, north, up; so are the others
    v: Array | None  # (K, 3) m/s
    sd_v: Array | None  # (K, 3) m/s
    fix_type: Array | None  # (K,) Q
    satellites: Array | None  # (K,) ns
    notes: list[str]


def parse_solution(path: Path, head: list[str], rows: NumberedLines) -> RtklibSolution:
    """Parse the lines of a .pos file: its header, with %, and its rows.

    Raises
    ------
    RecordingError
        Naming the file, and the line and field where there is one, if it cannot be read as it is.
    """
    titles = next((line for line in reversed(head) if re.search(r"\bQ\b.*\bns\b", line) and "=" not in line), None)
    if titles is None:
        raise RecordingError(
            f"{path}: no RTKLIB line '%  GPST  latitude(deg) ...' that names the columns", key="rtklib.no_header"
        )
    if any("lat/lon/height=Tokyo" in line for line in head):
        raise RecordingError(
            f"{path}: coordinates on the Tokyo datum; write it again with out-datum=wgs84", key="rtklib.datum"
        )
    scale, *columns = [re.sub(r"\(.*", "", title) for title in re.split(r"[\s,]+", titles.strip("%, \t"))]
    form = next((form for form in _FORMS if form in columns), None)
    if form is None or not set(_FORMS[form][0]) <= set(columns):
        raise RecordingError(
            f"{path}: the RTKLIB header does not name latitude, longitude and height, x, y and z, or a baseline",
            key="rtklib.columns",
        )
    of_base = _parse_base(path, head) if form == "e-baseline" else None
    separator = "," if "," in rows[0][1] else None
    notes = Notes()
    if len(rows) > 1 and len(rows[-1][1].split(separator)) < len(rows[-2][1].split(separator)):
        sentence = f"{path.name} ends within a line, as after a loss of power: it is left out"
        notes.add("trajectory.cut", sentence)
        rows = rows[:-1]
    sexagesimal = form == "latitude" and "latitude(d'" in titles
    if sexagesimal:  # three numbers for each angle
        at = columns.index("latitude")
        columns[at : at + 2] = [name + part for name in columns[at : at + 2] for part in ("", "'", "''")]
    names = ["date", "time", *columns]
    dated = "/" in rows[0][1].split(separator)[0]
    gps, numeric = _parse_dates(path, rows, separator) if dated else (None, rows)
    table = parse_table(path, numeric, names, separator)
    if gps is None:
        gps = WEEK * table[:, 0] + table[:, 1]
    if scale in _ZONES:
        gps = unix_to_gps(gps + GPS_TO_UNIX - _ZONES[scale])
        sentence = f"{path.name}: times were in {scale}; the leap seconds of their date make them GPS time"
        notes.add("trajectory.time_scale", sentence)
    if any("lat/lon/height=WGS84/geodetic" in line for line in head):
        sentence = f"{path.name}: heights are above mean sea level, not above the ellipsoid"
        notes.add("trajectory.height", sentence)

    def take(*wanted: str) -> Array | None:
        return table[:, [names.index(n) for n in wanted]] if set(wanted) <= set(names) else None

    def take_one(name: str) -> Array | None:
        column = take(name)
        return None if column is None else column[:, 0]

    place, axes, order = _FORMS[form]
    position, v = take(*place), take(*(f"v{axis}" for axis in axes))
    assert position is not None
    sd_p, sd_v = (take(*(f"sd{of}{axis}" for axis in axes)) for of in ("", "v"))
    if form == "latitude":
        if sexagesimal:
            position = np.column_stack(
                [_parse_degrees(take(n, f"{n}'", f"{n}''")) for n in place[:2]] + [position[:, 2]]
            )
        llh = np.column_stack([np.radians(position[:, :2]), position[:, 2]])
        turns = None
    elif of_base is None:
        llh = ecef_to_llh(position)
        turns = enu_axes(llh)
    else:
        frame = LocalFrame(of_base)
        llh = frame.to_llh(position)
        turns = frame.R_ln(position)
    if turns is not None:  # into the east, north, up of the position itself
        pairs = [axes[k] + axes[(k + 1) % 3] for k in range(3)]
        sd_p, sd_v = (
            _turn_sigmas(turns, sd, take(*(f"sd{of}{pair}" for pair in pairs))) for of, sd in (("", sd_p), ("v", sd_v))
        )
        v = None if v is None else np.einsum("kij,kj->ki", turns, v)
    else:
        v, sd_p, sd_v = (None if x is None else x[:, order] for x in (v, sd_p, sd_v))
    if v is not None and sd_v is not None:
        none = (v == 0.0).all(1) & (sd_v == 0.0).all(1)  # without out-dynamics, and of epochs without Doppler
        v[none], sd_v[none] = np.nan, np.nan
    t, zero = date_week_times(gps)
    return RtklibSolution(t, zero, llh, sd_p, v, sd_v, take_one("Q"), take_one("ns"), notes)


def _parse_base(path: Path, head: list[str]) -> Array:
    """Latitude, longitude (rad) and height (m) of the base, (3,), by the header; its fields may touch each other."""
    line = next((line.partition(":")[2] for line in head if re.match(r"%\s*ref pos\b", line)), "")
    if found := re.fullmatch(rf"\s*({_NUMBER})\s*,?\s*({_NUMBER})\s*,?\s*({_NUMBER})\s*", line):
        lat, lon, h = (float(x) for x in found.groups())
    elif len(parts := re.findall(_NUMBER, line)) == 7:
        (lat, lon), h = _parse_degrees(np.array(parts[:6], dtype=float).reshape(2, 3)), float(parts[6])
    else:
        raise RecordingError(
            f"{path}: an RTKLIB solution as east-north-up baseline to a base station whose place the header does not "
            "give ('% ref pos'); write it again with out-solformat=llh",
            key="rtklib.baseline",
        )
    return np.array([np.radians(lat), np.radians(lon), h])


def _parse_degrees(parts: Array | None) -> Array:
    """Degrees from degrees, minutes and seconds (K, 3); the sign is that of the degrees, even of zero."""
    assert parts is not None
    return np.copysign(np.abs(parts[:, 0]) + parts[:, 1] / 60.0 + parts[:, 2] / 3600.0, parts[:, 0])


def _turn_sigmas(turns: Array, sd: Array | None, mixed: Array | None) -> Array | None:
    """Sigmas (K, 3) along the axes of rotations (K, 3, 3), from variances and the covariances 01, 12 and 20."""
    if sd is None:
        return None
    P = np.zeros((len(sd), 3, 3))
    P[:, range(3), range(3)] = sd**2
    if mixed is not None:
        P[:, [0, 1, 2], [1, 2, 0]] = P[:, [1, 2, 0], [0, 1, 2]] = np.copysign(mixed**2, mixed)
    return np.sqrt(np.maximum(np.einsum("kij,kjl,kil->ki", turns, P, turns), 0.0))


def _parse_dates(path: Path, rows: NumberedLines, separator: str | None) -> tuple[Array, NumberedLines]:
    """Seconds since the GPS epoch of dates and times, and the rows without these, so that they are numbers."""
    joint = separator or " "
    stamps, rest = [], []
    for number, line in rows:
        date, _, tail = line.strip().partition(" ")  # a space whatever the separator of the columns
        clock, _, tail = tail.strip().partition(joint)
        stamps.append(f"{date.replace('/', '-')}T{clock.strip()}")
        rest.append((number, f"0{joint}0{joint}{tail}"))
    try:
        when = np.array(stamps, dtype="datetime64[us]")
    except ValueError:
        for (number, _), stamp in zip(rows, stamps, strict=True):
            try:
                np.datetime64(stamp, "us")
            except ValueError:
                raise RecordingError(
                    f"{path}, line {number}: '{stamp.replace('T', ' ')[:60]}' is not a date and time", key="table.date"
                ) from None
        raise
    return (when - GPS_EPOCH) / np.timedelta64(1, "us") * 1e-6, rest
