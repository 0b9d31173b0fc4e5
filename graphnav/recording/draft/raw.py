"""Raw observations among the logs of a draft: recognition by first bytes, and roles of rover and base."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from graphnav.core.earth import ecef_to_llh, enu_axes
from graphnav.core.errors import RecordingError
from graphnav.core.files import open_file
from graphnav.core.rotation import Array
from graphnav.core.timescales import UNIX, WEEK, gps_to_utc, parse_clock
from graphnav.gnss.files import unpack_bytes
from graphnav.gnss.load import Sources, load_raw, read_rover
from graphnav.gnss.series import Observations, RawGnss
from graphnav.gnss.signals import name_signal
from graphnav.gnss.single_point import SinglePoint
from graphnav.gnss.ubx import is_ubx
from graphnav.recording.draft.guesses import Guess

_PVT = b"\xb5\x62\x01\x07"
_PACKED = (".gz", ".z", ".zip", ".bz2")
_TABLE_ENDINGS = (".csv", ".tsv")
_HEAD_BYTES = 1 << 18  # number of first bytes by which a file is recognised
Llh = tuple[float, float, float]
_MOVED = 5.0  # sigmas of a single-point position from its median above which an antenna moves


@dataclass
class RawFiles:
    """Files by their key of [raw_gnss]; `observed` are rovers and bases."""

    observed: list[Path] = field(default_factory=list)
    placing: dict[str, list[Path]] = field(default_factory=dict)


@dataclass(frozen=True)
class RawFound:
    """Data for the draft of [raw_gnss]."""

    files: dict[str, tuple[Path, ...]]
    raw: RawGnss
    fixes: SinglePoint
    clock: Guess  # clock of the recording in the form of `parse_clock`; None where unknown, or known from the IMU's log
    dated: bool  # whether the times of the IMU are known
    base: tuple[Llh, str] | None  # position of the base, m in e, and the reason
    notes: tuple[str, ...]

    @property
    def begin(self) -> str:
        """The date of the first observation, UTC."""
        return _say(float(self.raw.t[0]) + self.raw.zero)

    @property
    def horizontal(self) -> tuple[Array, Array, Array | None]:
        """Times (n,), positions (n, 3) in rad, rad, m, and velocities (n, 2), or None, of single-point fixes."""
        good = np.isfinite(self.fixes.p[:, 0])
        llh = ecef_to_llh(self.fixes.p[good])
        v = np.einsum("nij,nj->ni", enu_axes(llh), self.fixes.v[good])[:, :2]
        return self.fixes.t[good], llh, v if np.isfinite(v).all() else None


def separate_raw(files: Sequence[Path]) -> tuple[RawFiles, list[Path]]:
    """Files of raw observations and of what places their satellites, and the rest."""
    out, rest = RawFiles(), []
    for path in files:
        kind, also = tell_kind(path)
        if kind == "observed":
            out.observed.append(path)
        elif kind:
            out.placing.setdefault(kind, []).append(path)
        if not kind or also:
            rest.append(path)
    return out, rest


def find_raw(files: RawFiles, t: Array, zero: float | None) -> RawFound | None:
    """Rover, base and clock; None without observations.

    Parameters
    ----------
    t : (N,) s, the stamps of the IMU.
    zero : s since the GPS epoch at t = 0, where the IMU's log says so.

    Raises
    ------
    RecordingError
        If the files do not tell which is the rover, or are not of the time of the IMU.
    """
    if not files.observed:
        return None
    held = {path: read_rover((path,)) for path in files.observed}
    every = {path: obs for path, (obs, _) in held.items()}
    clock = Guess(None, "")
    if zero is None:
        clock = _guess_clock(t, every)
        zero = None if clock.value is None else parse_clock(str(clock.value), float(t[0]))
    notes = []
    if zero is not None:
        there = {path: obs for path, obs in every.items() if _overlap(_find_span(obs), (t[0] + zero, t[-1] + zero))}
        if not there:
            path, (begin, end) = next((path, _find_span(obs)) for path, obs in every.items())
            raise RecordingError(
                f"{path}: its observations, {_say(begin)} to {_say(end)}, are not of the time of the IMU, "
                f"{_say(t[0] + zero)} to {_say(t[-1] + zero)}",
                key="draft.raw_time",
            )
        if left := [path.name for path in every if path not in there]:
            notes.append(f"left out: {', '.join(left)}: not of the time of the IMU")
        every = there
    placing = {key: tuple(some) for key, some in files.placing.items()}
    sent = tuple(path for path, (_, ephemerides) in held.items() if ephemerides is not None and ephemerides.satellites)
    every_nav = {**placing, "nav": (*placing.get("nav", ()), *sent)}
    rover, base = _choose_rover(every, every_nav)
    stands = None if base is None else _guess_base_place(base, every[base], every_nav)
    if not set(rover) & set(sent):
        placing = every_nav
    sources = Sources(
        rover=rover,
        base=() if base is None else (base,),
        base_position=None if stands is None else stands[0],
        **placing,  # type: ignore[arg-type]
    )
    raw, fixes, remarks = load_raw(sources, zero)
    own = {"rover": rover, "base": sources.base, **placing}
    signals = ", ".join(sorted({name_signal(int(s)) for s in np.unique(raw.signal)}))
    begin, end = (float(x) + raw.zero for x in raw.t[[0, -1]])
    notes.append(
        f"observations of {len(np.unique(raw.satellite))} satellites, {_say(begin)} to {_say(end)}; signals {signals}"
    )
    return RawFound(
        {k: x for k, x in own.items() if x}, raw, fixes, clock, zero is not None, stands, (*notes, *remarks)
    )


def write_raw(found: RawFound, folder: Path) -> list[tuple[str, str, str]]:
    """Keys, values and reasons of [raw_gnss] in a file in `folder`."""
    out = []
    for key, files in found.files.items():
        names = [Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix() for path in files]
        value = ", ".join('"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"' for name in names)
        alone = key == "rover" and "base" not in found.files
        out.append((key, value if len(names) == 1 else f"[{value}]", _ALONE if alone else _WHY[key]))
    if found.base is not None:
        (x, y, z), why = found.base
        out.append(("base_position", f"[{x:.4f}, {y:.4f}, {z:.4f}]", why))
    out.append(("lever_arm", "[0.0, 0.0, 0.0]", "CHECK: m, from the IMU to the antenna: right, forward, up"))
    return out


_ALONE = "raw observations"
_WHY = {
    "rover": "raw observations of the antenna that moves",
    "base": "observations of an antenna that stands",
    "nav": "ephemerides",
    "sp3": "precise orbits",
    "clk": "precise clocks",
    "antex": "antennas of satellites",
}


def tell_kind(path: Path) -> tuple[str | None, bool]:
    """The key of [raw_gnss] that a file belongs to, and whether it is a log of fixes as well."""
    name = path.name.lower()
    for packed in _PACKED:
        name = name.removesuffix(packed)
    if not path.is_file() or name.endswith(_TABLE_ENDINGS):
        return None, False
    try:
        with open_file(path, text=False) as file:
            data = file.read(_HEAD_BYTES)
        if data[:2] in (b"\x1f\x9d", b"PK", b"BZ"):
            data = unpack_bytes(path)
        if is_ubx(data):
            return "observed", _PVT in unpack_bytes(path)
    except RecordingError:  # reported where the file is read
        return None, False
    first = data[:200].partition(b"\n")[0].decode("latin-1")
    label, kind = first[60:].strip(), first[20:22].strip()[:1]  # five columns further on in clocks of version 3.04
    if "COMPACT RINEX FORMAT" in first:
        return "observed", False
    if label == "RINEX VERSION / TYPE":
        if kind == "O":
            return "observed", False
        return ("clk" if kind == "C" else "nav" if kind in "NGHELJ" else None), False
    if label == "ANTEX VERSION / SYST":
        return "antex", False
    return ("sp3" if len(first) > 50 and first[0] == "#" and first[1] in "abcd" and first[2] in "PV" else None), False


def _guess_clock(t: Array, every: dict[Path, Observations]) -> Guess:
    """Guess the date of the IMU's t = 0 from the times of the observations."""
    if t[0] > UNIX:
        return Guess("unix", "the stamps are dates of this century, s since 1970")
    for obs in every.values():
        begin, end = _find_span(obs)
        week = WEEK * np.floor(begin / WEEK)
        if _overlap((t[0] + week, t[-1] + week), (begin, end)):
            return Guess(f"gps week {round(week / WEEK)}", "the stamps are those of the observations, s of that week")
    return Guess(None, "")


def _choose_rover(
    every: dict[Path, Observations], placing: dict[str, tuple[Path, ...]]
) -> tuple[tuple[Path, ...], Path | None]:
    """Files of the rover, one after another, and that of the base."""
    paths = sorted(every, key=lambda path: _find_span(every[path]))
    spans = [_find_span(every[path]) for path in paths]
    if all(a[1] < b[0] for a, b in pairwise(spans)):
        return tuple(paths), None
    names = " and ".join(path.name for path in paths)
    moved = [_moves(path, placing) for path in paths] if len(paths) == 2 else []
    if sum(moved) != 1:
        why = f", and {'both' if all(moved) else 'neither'} of the antennas moved" if moved else ""
        raise RecordingError(
            f"{paths[0].parent}: {names} hold observations of the same time{why}; give init that of the rover alone, "
            'with the IMU\'s log and the ephemerides, and write base = "FILE" in [raw_gnss] for the other',
            key="draft.raw_roles",
        )
    rover = paths[moved.index(True)]
    return (rover,), paths[moved.index(False)]


def _moves(path: Path, placing: dict[str, tuple[Path, ...]]) -> bool:
    """Whether an antenna moves: a single-point position is farther from the median than its sigma allows."""
    fixes = _solve_alone(path, placing)
    good = np.isfinite(fixes.p[:, 0])
    away = np.linalg.norm(fixes.p[good] - np.median(fixes.p[good], axis=0), axis=1)
    sigma = np.sqrt(np.trace(fixes.covariance[good], axis1=1, axis2=2))
    return bool(np.percentile(away / sigma, 90.0) > _MOVED)


def _solve_alone(path: Path, placing: dict[str, tuple[Path, ...]]) -> SinglePoint:
    return load_raw(Sources(rover=(path,), **placing))[1]  # type: ignore[arg-type]


def _guess_base_place(path: Path, obs: Observations, placing: dict[str, tuple[Path, ...]]) -> tuple[Llh, str]:
    """Position of the base, m in e, and the reason."""
    x, y, z = np.nanmedian(_solve_alone(path, placing).p, axis=0).tolist()
    if obs.marker is None:
        return (x, y, z), "CHECK: m, Earth-centred; its header has none, this is its single-point position"
    off = float(np.linalg.norm(obs.marker - (x, y, z)))
    x, y, z = obs.marker.tolist()
    return (x, y, z), f"CHECK: m, Earth-centred; that of its header, {off:.1f} m from its single-point positions"


def _find_span(obs: Observations) -> tuple[float, float]:
    """s since the GPS epoch."""
    return float(obs.t.min()) + obs.zero, float(obs.t.max()) + obs.zero


def _overlap(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return max(one[0], other[0]) < min(one[1], other[1])


def _say(gps: float) -> str:
    return f"{gps_to_utc(np.array([gps]))[0].astype('datetime64[s]')}Z"
