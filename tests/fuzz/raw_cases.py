"""Files of raw GNSS observations, orbits and clocks, and what must hold of what is read from them."""

from __future__ import annotations

import gzip
import random
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import mutators
import numpy as np
from ubx_frames import rawx

from graphnav.core.timescales import gps_to_utc
from graphnav.gnss.load import Sources, load_raw
from graphnav.gnss.rinex_nav import read_navigation
from graphnav.gnss.rinex_obs import read_observations
from graphnav.gnss.series import Observations
from graphnav.gnss.signals import GPS, name_satellite

REAL = Path(__file__).resolve().parents[2] / "data" / "tokyo_raw"
_EPOCHS = 12
NAMES = ("three.obs", "two.obs", "a.nav", "a.sp3", "a.clk", "a.ubx")


@cache
def write_seeds(folder: Path) -> Path:
    """Twelve seconds of a receiver, and what places its satellites, in every form that is read."""
    folder.mkdir()
    lines = gzip.decompress((REAL / "base.obs.gz").read_bytes()).decode().splitlines(keepends=True)
    epochs = [k for k, line in enumerate(lines) if line.startswith(">")]
    (folder / "three.obs").write_text("".join(lines[: epochs[_EPOCHS]]))
    (folder / "a.nav").write_bytes(gzip.decompress((REAL / "nav.gz").read_bytes()))
    obs, nav = read_observations(folder / "three.obs"), read_navigation([folder / "a.nav"])
    obs = obs.take(obs.satellite // 100 == GPS)
    write_version_2(obs, folder / "two.obs")
    satellites = np.unique(obs.satellite)
    nodes = np.floor(obs.t[0] / 300.0) * 300.0 + 300.0 * np.arange(-6.0, 9.0)
    t, one = (np.ravel(x) for x in np.meshgrid(nodes, satellites, indexing="ij"))
    at = nav.place(one, t, obs.zero)
    known = np.isfinite(at.p[:, 0])
    write_orbits(t[known], one[known], at.p[known], at.clock[known], obs.zero, folder)
    (folder / "a.ubx").write_bytes(b"".join(rawx(300.0 + k) for k in range(4)))
    return folder


def date(t: float, zero: float, form: str) -> str:
    """Year, month, day, hour, minute and second of a GPS time."""
    whole, part = divmod(round((t + zero) * 1e7), 10**7)
    at = (np.datetime64("1980-01-06T00:00:00") + np.timedelta64(whole, "s")).item()
    return form.format(at.year, at.month, at.day, at.hour, at.minute, at.second + part * 1e-7)


def write_version_2(obs: Observations, path: Path) -> None:
    """A RINEX 2.11 file of GPS on L1."""
    said = [f"{'     2.11           OBSERVATION DATA    G (GPS)':<60}RINEX VERSION / TYPE",
            f"{'     3    C1    L1    D1':<60}# / TYPES OF OBSERV", f"{'':<60}END OF HEADER"]  # fmt: skip
    for t in np.unique(obs.t):
        own = np.flatnonzero(obs.t == t)
        names = "".join(name_satellite(one) for one in obs.satellite[own])
        begin = " " + date(float(t), obs.zero, "{:4d} {:2d} {:2d} {:2d} {:2d}{:11.7f}")[2:]
        said.append(f"{begin}  0{len(own):3d}{names}")
        for k in own:
            cells = (obs.code[k], obs.carrier[k], obs.doppler[k])
            said.append("".join(f"{x:14.3f}  " if np.isfinite(x) else " " * 16 for x in cells).rstrip())
    path.write_text("\n".join(said) + "\n")


def write_orbits(t: Any, satellite: Any, p: Any, clock: Any, zero: float, folder: Path) -> None:
    """An SP3-c file and a RINEX clock file."""
    orbits, clocks = ["#cP2020 11  5  5  0  0.00000000", "%c G  cc GPS ccc"], []
    for now in np.unique(t):
        orbits.append(date(float(now), zero, "*  {} {:2d} {:2d} {:2d} {:2d} {:11.8f}"))
        for k in np.flatnonzero(t == now):
            name = name_satellite(satellite[k])
            orbits.append(f"P{name}" + "".join(f"{x:14.6f}" for x in (*(p[k] * 1e-3), clock[k] * 1e6)))
            clocks.append(date(float(now), zero, f"AS {name}  {{}} {{}} {{}} {{}} {{}} {{:.6f}}  1 {clock[k]:.12e}"))
    (folder / "a.sp3").write_text("\n".join([*orbits, "EOF"]) + "\n")
    head = [f"{'     3.00           CLOCK DATA':<60}RINEX VERSION / TYPE", f"{'   GPS':<60}TIME SYSTEM ID"]
    (folder / "a.clk").write_text("\n".join([*head, f"{'':<60}END OF HEADER", *clocks]) + "\n")


def of_raw(folder: Path, chance: random.Random, seeds: Path, insist: Any, stand_in: Any) -> None:
    """One of the files that a position is made of is spoilt."""
    shutil.copytree(write_seeds(seeds / "raw-gnss"), folder / "raw")
    at = folder / "raw"
    name = chance.choice((*NAMES, "two.obs", "three.obs"))
    how = {"a.ubx": mutators.UBX}.get(name, mutators.COLUMNS)
    data = (at / name).read_bytes()
    for _ in range(chance.choice((1, 1, 2))):
        data = chance.choice(how)(data, chance) or b"\n"
    (at / name).write_bytes(data if chance.random() < 0.9 else mutators.packed(data, chance))
    rover = name if name in ("two.obs", "a.ubx") else "three.obs"
    precise = {"sp3": (at / "a.sp3",), "clk": (at / "a.clk",)} if name in ("a.sp3", "a.clk") else {}
    raw, fixes, _ = load_raw(Sources(rover=(at / rover,), nav=(at / "a.nav",), **precise))
    insist(bool(np.isfinite(raw.t).all() and (np.diff(raw.t) >= 0.0).all()), "times")
    for values in (raw.code, raw.p, fixes.p, fixes.covariance):
        insist(not np.isinf(values).any(), "values without end")
    good = np.isfinite(fixes.p[:, 0])
    insist(bool(np.isfinite(fixes.covariance[good]).all()), "sigmas")
    if name.endswith(".obs"):
        used = read_observations(at / name)
        stand_in(used.code[np.isfinite(used.code)], gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data)
        insist(bool(np.all(used.satellite >= 0)), "satellites")
        insist(abs(gps_to_utc(np.array([used.zero + used.t[0]]))[0].astype("datetime64[Y]").astype(int)) < 200, "date")
