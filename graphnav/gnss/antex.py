"""Satellite antennas from ANTEX 1.4 files: phase centre offsets and variations relative to the centre of mass."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.timescales import GPS_EPOCH
from graphnav.gnss.files import count_days, take_whole_lines, unpack_bytes
from graphnav.gnss.signals import SYSTEMS, C, Ids, number_satellite

_UNLIMITED = 1e12  # s


@dataclass(frozen=True)
class SatelliteAntenna:
    """Phase centre of one satellite over a span of validity, by frequency band."""

    begin: float  # s since the GPS epoch
    end: float
    offset: dict[int, Array]  # (3,) m, in the satellite's axes
    variation: dict[int, Array] = field(default_factory=dict)  # (M,) m, longer, at nadir angles of 0, 1, 2, ... deg


Antennas = dict[int, tuple[SatelliteAntenna, ...]]


def read_antex(path: Path) -> tuple[Antennas, tuple[str, ...]]:
    """Read the satellite antennas of an ANTEX file; remarks say where it ends if it is cut off.

    Raises
    ------
    RecordingError
        If it is not an ANTEX file, or a field cannot be read, naming the line.
    """
    data, ends = take_whole_lines(unpack_bytes(path), path.name, b"END OF ANTENNA")
    lines = data.decode("latin-1").splitlines()
    if not lines or "ANTEX VERSION" not in lines[0]:
        raise RecordingError(f"{path}: not an ANTEX file; its first line names no version", key="file.kind")
    out: dict[int, list[SatelliteAntenna]] = {}
    name, band, angles = "", 0, np.zeros(2)
    one = SatelliteAntenna(-_UNLIMITED, _UNLIMITED, {})
    for number, line in enumerate(lines, 1):
        label = line[60:].strip() if line[:8] != "   NOAZI" else "NOAZI"
        try:
            if label == "TYPE / SERIAL NO":  # not every antenna is preceded by a START OF ANTENNA line
                name, band, one = line[20:23].strip(), 0, SatelliteAntenna(-_UNLIMITED, _UNLIMITED, {})
            elif label == "VALID FROM":
                one = replace(one, begin=_parse_date(line))
            elif label == "VALID UNTIL":
                one = replace(one, end=_parse_date(line))
            elif label == "ZEN1 / ZEN2 / DZEN":
                angles = np.array([line[2:8], line[14:20]], dtype=float)
            elif label in ("START OF FREQUENCY", "START OF FREQ RMS"):  # the sigmas have lines with the same labels
                band = int(line[4:6]) if label == "START OF FREQUENCY" else 0
            elif label == "NORTH / EAST / UP" and band:
                one.offset[band] = 1e-3 * np.array([line[0:10], line[10:20], line[20:30]], dtype=float)
            elif label == "NOAZI" and band:
                one.variation[band] = _parse_variation(line, *angles)
            elif label == "END OF ANTENNA" and len(name) == 3 and name[0] in SYSTEMS and name[1:].isdigit():
                out.setdefault(number_satellite(name), []).append(one)
        except ValueError:
            raise RecordingError(
                f"{path}, line {number}: '{line[:60].strip()}' cannot be read as {label}", key="table.cell"
            ) from None
    if not out:
        raise RecordingError(f"{path}: holds no antennas of satellites", key="raw.no_antennas")
    return {one: tuple(many) for one, many in out.items()}, ends


def compute_antenna_paths(
    antennas: Antennas, satellite: Ids, frequencies: Array, bands: Array, gps: Array, axes: Array, e: Array
) -> Array:
    """(N,) m, extra path of a two-signal combination from the phase centres, over the centre of mass; NaN if unknown.

    Parameters
    ----------
    frequencies : (N, 2) Hz.
    bands : (N, 2) of RINEX.
    gps : (N,) s since the GPS epoch.
    axes : (N, 3, 3) of the satellites, rows.
    e : (N, 3) unit vectors from the receiver to the satellites.
    """
    out = np.full(len(satellite), np.nan)
    toward = np.einsum("nij,nj->ni", axes, e)
    nadir = np.degrees(np.arccos(np.clip(-toward[:, 2], -1.0, 1.0)))
    alpha = frequencies[:, 0] ** 2 / (frequencies[:, 0] ** 2 - frequencies[:, 1] ** 2)
    for one, many in antennas.items():
        for antenna in many:
            own = (satellite == one) & (gps >= antenna.begin) & (gps <= antenna.end)
            for both in np.unique(bands[own], axis=0):
                if not antenna.offset.keys() >= set(both.tolist()):
                    continue
                some = np.flatnonzero(own & np.all(bands == both, axis=1))
                ways = []
                for band in both.tolist():
                    varied = antenna.variation.get(band, np.zeros(1))
                    ways.append(
                        toward[some] @ antenna.offset[band] + np.interp(nadir[some], np.arange(len(varied)), varied)
                    )
                out[some] = alpha[some] * ways[0] - (alpha[some] - 1.0) * ways[1]
    return out


def compute_satellite_axes(place: Array, sun: Array) -> Array:
    """(N, 3, 3) body axes x, y, z (rows) of satellites at (N, 3), m in e, in nominal yaw-steering attitude."""
    z = -place / np.linalg.norm(place, axis=1)[:, None]
    to = sun - place
    y = np.cross(z, to)
    y /= np.linalg.norm(y, axis=1)[:, None]
    return np.stack([np.cross(y, z), y, z], axis=1)


def compute_wind_up(satellite: Ids, epoch: Array, axes: Array, e: Array, enu: Array) -> Array:
    """(N,) cycles of phase wind-up (Wu et al. 1993), continuous for each satellite.

    Rotation of the receiver's antenna is left out: it is common to all satellites and absorbed by the clock.

    Parameters
    ----------
    epoch : (N,) s.
    axes : (N, 3, 3) of the satellites, rows.
    e : (N, 3) unit vectors from the antenna to the satellites.
    enu : (N, 3, 3) east, north, up at the antenna, rows.
    """
    k = -e
    x, y = axes[:, 0], axes[:, 1]
    north, west = enu[:, 1], -enu[:, 0]
    sent = x - k * np.sum(k * x, axis=1)[:, None] - np.cross(k, y)
    received = north - k * np.sum(k * north, axis=1)[:, None] + np.cross(k, west)
    cosine = np.sum(sent * received, axis=1) / np.linalg.norm(sent, axis=1) / np.linalg.norm(received, axis=1)
    cycles = np.arccos(np.clip(cosine, -1.0, 1.0)) / (2.0 * np.pi)
    cycles *= np.sign(np.sum(k * np.cross(sent, received), axis=1))
    for one in np.unique(satellite):
        own = np.flatnonzero(satellite == one)
        own = own[np.argsort(epoch[own], kind="stable")]
        cycles[own] = np.unwrap(cycles[own], period=1.0)
    return cycles


def compute_shapiro_delay(satellite: Array, antenna: Array) -> Array:
    """(N,) m, relativistic path range correction (Shapiro delay; IERS Conventions 2010, equation 11.17)."""
    r, s = np.linalg.norm(antenna, axis=1), np.linalg.norm(satellite, axis=1)
    between = np.linalg.norm(satellite - antenna, axis=1)
    return np.asarray(2.0 * 3.986004418e14 / C**2 * np.log((r + s + between) / (r + s - between)))


def _parse_date(line: str) -> float:
    fields = np.array([line[:43].split()[:6]], dtype=float)
    days, good = count_days(fields)
    if not good.all():
        raise ValueError
    return float((days[0] - GPS_EPOCH) / np.timedelta64(1, "s")) + float(fields[0, 3:] @ np.array([3600.0, 60.0, 1.0]))


def _parse_variation(line: str, begin: float, step: float) -> Array:
    """(M,) m at whole degrees, interpolated from values (mm) at a given spacing in degrees."""
    values = np.array([line[i : i + 8] for i in range(8, len(line.rstrip()), 8)], dtype=float)
    at = begin + step * np.arange(len(values))
    if not (step > 0.0 and len(at) and at[-1] <= 90.0 and np.isfinite(values).all()):
        raise ValueError
    return 1e-3 * np.interp(np.arange(np.ceil(at[-1]) + 1.0), at, values)
