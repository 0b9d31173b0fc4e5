"""Precise orbits and clocks: SP3-a, -c and -d (Hilla 2016) and RINEX clock files 2 to 3.04.

Positions between nodes are interpolated by the polynomial through the eleven nearest, rotated to the Earth-fixed frame
of the requested time (Schenewerk 2003); clocks are interpolated linearly, plus the relativistic effect that products
leave out, -2 r.v / c^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import GPS_EPOCH, count_leap_seconds
from graphnav.gnss.ephemeris import Placed, rotate_earth
from graphnav.gnss.files import Lines, count_days, parse_numbers, take_whole_lines, unpack_bytes
from graphnav.gnss.signals import SYSTEMS, C, Ids, number_satellite

_NODES = 11  # of the polynomial
_NEAREST, _FARTHEST = 6.4e3, 1e5  # km, of satellites from the Earth's centre
_ABSENT = 0.9  # s; a clock of 999999.999999 us is none
_LONGEST_CLOCK_GAP = 900.0  # s, longest step between nodes of a clock that is interpolated
_HALF_SPAN = 0.5  # s on either side, for velocities by central differences


@dataclass(frozen=True)
class Orbits:
    """Nodes by satellite; times in s since the GPS epoch."""

    orbit: dict[int, tuple[Array, Array]]  # t (n,) and positions (n, 3), m, of the centre of mass
    clock: dict[int, tuple[Array, Array]]  # t (n,) and s
    remarks: tuple[str, ...] = ()

    def place(self, satellite: Ids, t: Array, zero: float) -> Placed:
        """As `graphnav.gnss.ephemeris.Ephemerides.place`."""
        out = Placed.unknown(len(t))
        for one in np.unique(satellite):
            own = np.flatnonzero(satellite == one)
            if int(one) not in self.orbit or int(one) not in self.clock:
                continue
            nodes, clocks = self.orbit[int(one)], self.clock[int(one)]
            true = t[own]
            for _ in range(2):
                true = t[own] - np.nan_to_num(_interpolate_clocks(clocks, true, zero)[0])
            p = _interpolate_orbit(nodes, true, zero)
            ahead, behind = (_interpolate_orbit(nodes, true + h, zero) for h in (_HALF_SPAN, -_HALF_SPAN))
            v = (ahead - behind) / (2.0 * _HALF_SPAN)
            clock, drift = _interpolate_clocks(clocks, true, zero)
            out.p[own], out.v[own], out.drift[own] = p, v, drift
            out.clock[own] = clock - 2.0 * np.sum(p * v, axis=1) / C**2
        return out

    def compute_clock_noise(self) -> dict[int, tuple[float, float]]:
        """Interpolation error of each satellite's clock (m, 1-sigma midway between nodes), and the node spacing.

        Between nodes a clock is a random walk of variance q h over a spacing h (s): its second differences have the
        variance 2 q h, the midpoint of a linear interpolation q h / 4; q follows from their median magnitude.
        """
        out = {}
        for one, (t, clock) in self.clock.items():
            if len(t) > _NODES:
                size = 1.4826 * float(np.median(np.abs(np.diff(clock, 2))))
                out[one] = C * size / np.sqrt(8.0), float(np.median(np.diff(t)))
        return out


def read_precise(sp3: list[Path], clk: list[Path]) -> Orbits:
    """Read orbits and clocks; clocks of clock files take precedence over those of orbit files.

    Raises
    ------
    RecordingError
        If a file is not what it should be, naming the line.
    """
    said: list[str] = []
    t, satellite, p, clock = (np.concatenate(x) for x in zip(*(_read_sp3(path, said) for path in sp3), strict=True))
    orbit, clocks = {}, {}
    for one in np.unique(satellite):
        own = satellite == one
        whole = own & np.any(p != 0.0, axis=1)
        orbit[int(one)] = _drop_repeated(t[whole], p[whole])
        told = own & (np.abs(clock) < _ABSENT)
        if told.any():
            clocks[int(one)] = _drop_repeated(t[told], clock[told])
    if clk:
        begin, end = t.min(), t.max()
        t, satellite, clock = (np.concatenate(x) for x in zip(*(_read_clk(path, said) for path in clk), strict=True))
        if (apart := max(t.min() - end, begin - t.max())) > 0.0:
            raise RecordingError(
                f"{clk[0]}: its clocks are {apart / 86400.0:.1f} days from the orbits of {sp3[0].name}; they must be "
                "of the same day",
                key="raw.clock_day",
            )
        clocks |= {
            int(one): _drop_repeated(t[satellite == one], clock[satellite == one]) for one in np.unique(satellite)
        }
    if not clocks:
        raise RecordingError(
            f"{sp3[0]}: holds orbits without clocks; set clk in [raw_gnss] to a file of these", key="raw.no_clocks"
        )
    few = sorted(one for one, (t, _) in orbit.items() if len(t) < _NODES)
    remarks = (
        (
            Note(
                "raw_gnss.orbit_short",
                f"{format_count(len(few), 'satellite')} with fewer than {_NODES} nodes in {sp3[0].name}: no orbit",
            ),
        )
        if few
        else ()
    )
    return Orbits({k: x for k, x in orbit.items() if k not in few}, clocks, (*said, *remarks))


def _drop_repeated(t: Array, x: Array) -> tuple[Array, Array]:
    t, first = np.unique(t, return_index=True)
    return t, x[first]


def _read_sp3(path: Path, remarks: list[str]) -> tuple[Array, Ids, Array, Array]:
    """Times, satellites, positions (m) and clocks (s) of all position records."""
    data, ends = take_whole_lines(unpack_bytes(path), path.name, b"EOF")
    lines = Lines(data)
    remarks += ends
    head = lines.get_text(0)
    if head[:1] != "#" or head[1:2] not in "abcd":
        raise RecordingError(f"{path}: not an SP3 file; its first line begins '{head[:2]}'", key="file.kind")
    scale = next((lines.get_text(k)[9:12] for k in range(min(30, len(lines))) if lines.get_text(k)[:2] == "%c"), "GPS")
    first = lines.list_first_bytes()
    epoch = np.flatnonzero(first == ord("*"))
    own = np.flatnonzero(first == ord("P"))
    if not len(epoch) or not len(own):
        raise RecordingError(f"{path}: holds no positions", key="raw.no_positions")
    t = _read_stamps(lines, epoch, scale, path)
    try:
        value = parse_numbers(lines.take_block(own, 4, 60), 14)
        names = [bytes(x).decode() for x in lines.take_block(own, 1, 4)]
        ids = {name: _find_id(name) for name in set(names)}
    except ValueError:
        for k in own:
            try:
                parse_numbers(lines.take_block(np.array([k]), 4, 60), 14)
            except ValueError:
                text = lines.get_text(int(k))[:60]
                raise RecordingError(f"{path}, line {k + 1}: '{text}' is not a position", key="table.cell") from None
        raise RecordingError(f"{path}: names a satellite of an unknown system", key="raw.unknown_system") from None
    satellite = np.array([ids[name] for name in names], dtype=np.int16)
    of = np.searchsorted(epoch, own) - 1
    whole = np.isfinite(value[:, :3]).all(axis=1) & (of >= 0) & (satellite >= 0)
    away = float(np.median(np.linalg.norm(value[whole, :3], axis=1))) if whole.any() else 0.0
    if away and not _NEAREST < away < _FARTHEST:
        raise RecordingError(
            f"{path}: its satellites are {away:.3g} km from the Earth's centre, so its positions are not in km",
            key="raw.no_positions",
        )
    clock = np.nan_to_num(value[:, 3] * 1e-6, nan=1.0)
    return t[of[whole]], satellite[whole], value[whole, :3] * 1e3, clock[whole]


def _read_clk(path: Path, remarks: list[str]) -> tuple[Array, Ids, Array]:
    """Times, satellites and clocks (s) of all satellite records."""
    text, ends = take_whole_lines(unpack_bytes(path), path.name)
    remarks += ends
    if b"CLOCK" not in text[:8000] and b"RINEX VERSION" not in text[:200]:
        raise RecordingError(f"{path}: not a RINEX clock file", key="file.kind")
    scale = "GPS"
    for line in text[:20000].splitlines():
        if line.rstrip().endswith(b"TIME SYSTEM ID"):
            scale = line[:10].decode("latin-1").strip()[:3]
    rows = [line.split() for line in text.splitlines() if line.startswith(b"AS ")]
    rows = [row for row in rows if len(row) >= 10]
    if not rows:
        raise RecordingError(f"{path}: holds no clocks of satellites", key="raw.no_clocks")
    names = [row[1].decode("latin-1") for row in rows]
    try:
        table = np.array([[*row[2:8], row[9]] for row in rows]).astype(float)
        ids = {name: _find_id(name) for name in set(names)}
        t = _read_dates(table[:, :6], scale)
        if not np.isfinite(table).all():
            raise ValueError
    except ValueError:
        raise RecordingError(f"{path}: a record of a satellite's clock cannot be read", key="table.cell") from None
    if (typical := float(np.median(np.abs(table[:, 6])))) > _ABSENT:
        raise RecordingError(f"{path}: clocks of {typical:.3g}, which are not in s", key="raw.no_clocks")
    satellite = np.array([ids[name] for name in names], dtype=np.int16)
    return t[satellite >= 0], satellite[satellite >= 0], table[satellite >= 0, 6]


def _find_id(name: str) -> int:
    """The number of a satellite; -1 for names that are none, such as satellites in low Earth orbit."""
    if name[0].isalpha() and name[0] not in SYSTEMS:
        return -1
    return number_satellite(name if name[0] != " " else "G" + name[1:])


def _read_stamps(lines: Lines, which: NDArray[np.intp], scale: str, path: Path) -> Array:
    """(n,) s since the GPS epoch, from lines of a sign, a space and a date."""
    words = [lines.get_text(k)[3:].split()[:6] for k in which]
    try:
        return _read_dates(np.array(words, dtype=float), scale)
    except ValueError:
        for k, some in zip(which, words, strict=True):
            try:
                _read_dates(np.array([some], dtype=float), scale)
            except ValueError:
                text = " ".join(some)[:40]
                raise RecordingError(
                    f"{path}, line {k + 1}: '{text}' is not the date of an epoch", key="table.date"
                ) from None
        raise RecordingError(f"{path}: the date of an epoch cannot be read", key="table.date") from None


def _read_dates(fields: Array, scale: str) -> Array:
    """(n,) s since the GPS epoch of dates (n, 6); ValueError for an invalid one."""
    if fields.ndim != 2 or fields.shape[1] != 6:
        raise ValueError
    days, good = count_days(fields)
    if not good.all():
        raise ValueError
    ahead = count_leap_seconds(days) if scale in ("UTC", "GLO") else {"BDT": 14.0, "TAI": -19.0}.get(scale, 0.0)
    return np.asarray(
        (days - GPS_EPOCH) / np.timedelta64(1, "s") + fields[:, 3:] @ np.array([3600.0, 60.0, 1.0]) + ahead
    )


def _interpolate_orbit(nodes: tuple[Array, Array], t: Array, zero: float) -> Array:
    """(N, 3) positions at times t (N,), s since `zero`, in the Earth-fixed frame of these; NaN outside the nodes."""
    at, p = nodes[0] - zero, nodes[1]
    first = np.clip(np.searchsorted(at, t) - (_NODES + 1) // 2, 0, len(at) - _NODES)
    use = first[:, None] + np.arange(_NODES)
    x = at[use] - t[:, None]  # (N, nodes)
    span = x[:, -1] - x[:, 0]
    apart = x[:, :, None] - x[:, None, :]
    apart[:, np.arange(_NODES), np.arange(_NODES)] = 1.0
    exact = np.where(np.abs(x) < 1e-9, 1e-9, x)
    weight = np.prod(exact, axis=1)[:, None] / exact / np.prod(apart, axis=2)
    weight *= np.where(_NODES % 2 == 0, -1.0, 1.0)
    placed = rotate_earth(p[use].reshape(-1, 3), -x.ravel()).reshape(len(t), _NODES, 3)
    out = np.einsum("nk,nki->ni", weight, placed)
    typical = float(np.median(np.diff(at)))
    out[(t < at[0] - 1.0) | (t > at[-1] + 1.0) | (span > 2.0 * _NODES * typical)] = np.nan
    return np.asarray(out)


def _interpolate_clocks(clocks: tuple[Array, Array], t: Array, zero: float) -> tuple[Array, Array]:
    """Clocks and drifts (N,) by linear interpolation; NaN outside the nodes and in gaps."""
    at, value = clocks[0] - zero, clocks[1]
    if len(at) < 2:
        return np.full(len(t), np.nan), np.full(len(t), np.nan)
    k = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(at) - 2)
    step = at[k + 1] - at[k]
    drift = (value[k + 1] - value[k]) / step
    good = (t >= at[0] - 1.0) & (t <= at[-1] + 1.0) & (step <= _LONGEST_CLOCK_GAP)
    return np.where(good, value[k] + drift * (t - at[k]), np.nan), np.where(good, drift, np.nan)
