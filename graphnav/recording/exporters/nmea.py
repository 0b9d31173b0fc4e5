"""NMEA 0183: GGA, RMC and, where sigmas are known, GST for every row, as a receiver would send them.

Fields that a smoothed trajectory does not have (satellites, HDOP, geoid) are empty, as the standard permits; the
altitude field holds the height above the ellipsoid with a geoid separation of 0, so that their sum is right.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.recording.exporters import Add, require_geodetic

_KNOTS = 3600 / 1852


@contextmanager
def open_writer(path: Path, name: str = "") -> Iterator[Add]:
    """An NMEA file; every sentence begins with the time of day, so UTC is needed."""
    with path.open("w", encoding="ascii", newline="") as file:

        def add(block: Trajectory, utc: Array | None = None) -> None:
            require_geodetic(block, path)
            if utc is None:
                raise RecordingError(
                    f"{path}: NMEA needs the time of day, and the zero of t is not known; give --clock",
                    key="export.time_of_day",
                )
            file.write("".join(_write_sentences(block, utc)))

        yield add


def _write_sentences(trajectory: Trajectory, utc: Array) -> list[str]:
    day = utc.astype("datetime64[D]")
    of_day = (utc - day) / np.timedelta64(1, "us") * 1e-6
    dates = [f"{d[8:10]}{d[5:7]}{d[2:4]}" for d in np.datetime_as_string(day).tolist()]
    latitude, longitude = _write_angles(trajectory.llh[:, 0], 2, "NS"), _write_angles(trajectory.llh[:, 1], 3, "EW")
    motion = _write_motion(trajectory)
    text = []
    for k, seconds in enumerate(of_day.tolist()):
        clock, place = _write_clock(seconds), f"{latitude[k]},{longitude[k]}"
        text.append(format_sentence(f"GNGGA,{clock},{place},1,,,{trajectory.llh[k, 2]:.4f},M,0.0,M,,"))
        text.append(format_sentence(f"GNRMC,{clock},A,{place},{motion[k]},{dates[k]},,,A"))
        if trajectory.sd_p is not None and np.isfinite(trajectory.sd_p[k]).all():
            east, north, up = trajectory.sd_p[k].tolist()
            text.append(format_sentence(f"GNGST,{clock},,,,,{north:.4f},{east:.4f},{up:.4f}"))
    return text


def format_sentence(body: str) -> str:
    """A sentence with its checksum, the exclusive or of all characters, and its line end."""
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n"


def _write_clock(seconds: float) -> str:
    ms = round(seconds * 1000)
    return f"{ms // 3600000:02d}{ms // 60000 % 60:02d}{ms // 1000 % 60:02d}.{ms % 1000:03d}"


def _write_angles(radians: Array, width: int, signs: str) -> list[str]:
    """Degrees and minutes with seven decimals, 0.2 mm, and the hemisphere."""
    minutes = np.round(np.abs(np.rad2deg(radians)) * 60.0, 7)
    whole = np.floor(minutes / 60.0)
    rest = minutes - 60.0 * whole
    return [
        f"{int(d):0{width}d}{m:010.7f},{signs[0] if r >= 0 else signs[1]}"
        for d, m, r in zip(whole, rest, radians, strict=True)
    ]


def _write_motion(trajectory: Trajectory) -> list[str]:
    """Speed over ground in knots and course in degrees, blank where they are not known."""
    if trajectory.v is None:
        return [","] * len(trajectory)
    speed = np.hypot(trajectory.v[:, 0], trajectory.v[:, 1]) * _KNOTS
    course = np.mod(np.degrees(np.arctan2(trajectory.v[:, 0], trajectory.v[:, 1])), 360.0)
    return [f"{s:.4f},{c:.3f}" if np.isfinite(s) else "," for s, c in zip(speed.tolist(), course.tolist(), strict=True)]
