"""RINEX observations and ephemerides as the log that a u-blox receiver would have written: RXM-RAWX and RXM-SFRBX.

    python scripts/encode_ubx.py data/kamakura_rtk/rover.obs.gz data/kamakura_rtk/nav.gz -o data/kamakura_rtk/rover.ubx

For trying out what reads such logs, where there is no log of the drive. Signals that u-blox has no number for are left
out; C/N0 is rounded to whole dB-Hz, Doppler shifts that were not measured are NaN, and a carrier is a second in lock at
its first epoch, because RINEX counts losses of lock alone. Navigation messages are GPS' and QZSS' LNAV, with GPS'
ionosphere, and Galileo's I/NAV, without parity and what no ephemeris holds.
"""

from __future__ import annotations

import argparse
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from graphnav.core.timescales import WEEK
from graphnav.gnss.ephemeris import Ephemerides
from graphnav.gnss.load import read_rover
from graphnav.gnss.rinex_nav import read_navigation
from graphnav.gnss.series import Observations
from graphnav.gnss.signals import GALILEO, GPS, QZSS, name_signal
from graphnav.gnss.ubx import SIGNALS

PI = 3.1415926535898  # of the interface descriptions
NUMBER = {GPS: 0, GALILEO: 2, QZSS: 5}  # gnssId
FRESH = 2.0 * 3600.0  # s from its time to which an ephemeris is sent
LONGEST = 64500  # ms that a time in lock is counted to
# first bit, number of bits, field, and its unit; of the parts of a message, without parity (see graphnav.gnss.messages)
LNAV = {
    1: [(160, 8, "delay0", 2.0**-31), (168, 8, "iode", 1.0), (176, 16, "toc", 16.0), (192, 8, "clock2", 2.0**-55),
        (200, 16, "clock1", 2.0**-43), (216, 22, "clock0", 2.0**-31)],
    2: [(48, 8, "iode", 1.0), (56, 16, "crs", 2.0**-5), (72, 16, "delta_n", 2.0**-43 * PI),
        (88, 32, "m0", 2.0**-31 * PI), (120, 16, "cuc", 2.0**-29), (136, 32, "e", 2.0**-33),
        (168, 16, "cus", 2.0**-29), (184, 32, "root_a", 2.0**-19), (216, 16, "toes", 16.0)],
    3: [(48, 16, "cic", 2.0**-29), (64, 32, "omega0", 2.0**-31 * PI), (96, 16, "cis", 2.0**-29),
        (112, 32, "i0", 2.0**-31 * PI), (144, 16, "crc", 2.0**-5), (160, 32, "omega", 2.0**-31 * PI),
        (192, 24, "omega_dot", 2.0**-43 * PI), (216, 8, "iode", 1.0), (224, 14, "idot", 2.0**-43 * PI)],
}  # fmt: skip
INAV = {
    1: [(6, 10, "iode", 1.0), (16, 14, "toes", 60.0), (30, 32, "m0", 2.0**-31 * PI), (62, 32, "e", 2.0**-33),
        (94, 32, "root_a", 2.0**-19)],
    2: [(6, 10, "iode", 1.0), (16, 32, "omega0", 2.0**-31 * PI), (48, 32, "i0", 2.0**-31 * PI),
        (80, 32, "omega", 2.0**-31 * PI), (112, 14, "idot", 2.0**-43 * PI)],
    3: [(6, 10, "iode", 1.0), (16, 24, "omega_dot", 2.0**-43 * PI), (40, 16, "delta_n", 2.0**-43 * PI),
        (56, 16, "cuc", 2.0**-29), (72, 16, "cus", 2.0**-29), (88, 16, "crc", 2.0**-5), (104, 16, "crs", 2.0**-5)],
    4: [(6, 10, "iode", 1.0), (16, 6, "number", 1.0), (22, 16, "cic", 2.0**-29), (38, 16, "cis", 2.0**-29),
        (54, 14, "toc", 60.0), (68, 31, "clock0", 2.0**-34), (99, 21, "clock1", 2.0**-46),
        (120, 6, "clock2", 2.0**-59)],
    5: [(47, 10, "delay0", 2.0**-32), (57, 10, "delay1", 2.0**-32)],
}  # fmt: skip
IONOSPHERE = [(56 + 8 * i, 8, f"ionosphere{i}", x) for i, x in enumerate(2.0 ** np.array(
    [-30, -27, -24, -24, 11, 14, 16, 16]))]  # fmt: skip


def frame(kind: int, payload: bytes) -> bytes:
    """A message of class RXM with its check sums."""
    body = bytes((0x02, kind)) + struct.pack("<H", len(payload)) + payload
    x = np.frombuffer(body, dtype=np.uint8).astype(int)
    sums = int(x.sum()) & 0xFF, int(x.cumsum().sum()) & 0xFF
    return b"\xb5\x62" + body + bytes(sums)


def put(size: int, *numbers: tuple[int, int, float]) -> int:
    """A string of bits with numbers at (first bit, number of bits), negative ones in two's complement."""
    out = 0
    for at, n, value in numbers:
        out |= (round(value) & (1 << n) - 1) << size - at - n
    return out


def scaled(parts: list[tuple[int, int, str, float]], one: dict[str, float]) -> list[tuple[int, int, float]]:
    """First bit, number of bits and value of each field."""
    return [(at, n, one[name] / unit) for at, n, name, unit in parts]


def send(satellite: int, words: list[int], signal: int = 0) -> bytes:
    """An RXM-SFRBX message."""
    head = struct.pack("<8B", NUMBER[satellite // 100], satellite % 100, signal, 0, len(words), 0, 2, 0)
    return frame(0x13, head + struct.pack(f"<{len(words)}I", *words))


def encode_lnav(satellite: int, part: int, sow: float, fields: list[tuple[int, int, float]]) -> bytes:
    """A subframe, sent at a second of the week."""
    bits = put(240, (0, 8, 0x8B), (24, 17, sow // 6), (43, 3, part), *fields)
    return send(satellite, [(bits >> 216 - 24 * i & 0xFFFFFF) << 6 for i in range(10)])


def encode_inav(satellite: int, number: int, fields: list[tuple[int, int, float]]) -> bytes:
    """A word, in an even and an odd page."""
    word = put(128, (0, 6, number), *fields)
    pages = put(256, (2, 112, word >> 16), (128, 1, 1), (130, 16, word & 0xFFFF))
    return send(satellite, [pages >> 224 - 32 * i & 0xFFFFFFFF for i in range(8)], signal=1)


def encode_ephemerides(nav: Ephemerides, gps: float) -> Iterator[bytes]:
    """The messages of the satellites that are healthy, sent at a time, s since the GPS epoch."""
    table, sow = nav.kepler, gps % WEEK
    for k, satellite in enumerate(table["satellite"].tolist()):
        system, old = satellite // 100, abs(table["toe"][k] - gps) > FRESH
        if system not in NUMBER or old or not table["healthy"][k] or table["fnav"][k]:
            continue
        one = {name: x[k] for name, x in table.items() if x.ndim == 1}
        one |= {f"{name}{i}": x for name in ("clock", "delay") for i, x in enumerate(table[name][k])}
        one |= {"toc": one["toc"] % WEEK, "number": satellite % 100}
        for part, fields in (INAV if system == GALILEO else LNAV).items():
            if system == GALILEO:
                yield encode_inav(satellite, part, scaled(fields, one))
            else:
                yield encode_lnav(satellite, part, sow, scaled(fields, one))
    if nav.klobuchar is not None:
        one = {f"ionosphere{i}": x for i, x in enumerate(nav.klobuchar.ravel())}
        page = [(48, 2, 1.0), (50, 6, 56.0), *scaled(IONOSPHERE, one)]
        yield encode_lnav(int(table["satellite"][table["satellite"] // 100 == GPS][0]), 4, sow, page)


def count_locks(obs: Observations) -> np.ndarray:
    """(N,) ms that each carrier has been in lock, as far as its flags tell."""
    epochs, of = np.unique(obs.t, return_inverse=True)
    out, last = np.zeros(len(obs), dtype=int), dict[tuple[int, int], int]()
    for i, key in enumerate(zip(obs.satellite.tolist(), obs.signal.tolist(), strict=True)):
        before = last.get(key, -1)
        if before >= 0 and of[before] == of[i] - 1 and not obs.slip[i]:
            out[i] = min(out[before] + round(1e3 * (epochs[of[i]] - epochs[of[before]])), LONGEST)
        last[key] = i
    return out


def encode_log(obs: Observations, nav: Ephemerides) -> bytes:
    """The whole log: the ephemerides come behind the first epoch."""
    numbers = {(gnss, name): number for (gnss, number), name in SIGNALS.items()}
    code, carrier = np.isfinite(obs.code), np.isfinite(obs.carrier)
    lock, out = count_locks(obs), b""
    for k, t in enumerate(np.unique(obs.t)):
        rows, many = b"", 0
        for i in np.flatnonzero(obs.t == t).tolist():
            satellite, name = int(obs.satellite[i]), name_signal(obs.signal[i])
            number = numbers.get((NUMBER.get(satellite // 100, -1), name))
            if number is None or not (code[i] or carrier[i]):
                continue
            status = 1 * code[i] + 2 * carrier[i] + 4 * (not obs.half[i])
            cn0 = 0 if np.isnan(obs.cn0[i]) else round(obs.cn0[i])
            values = np.nan_to_num([obs.code[i], obs.carrier[i]]).tolist()
            rows += struct.pack(
                "<ddf4BH6B", *values, obs.doppler[i], NUMBER[satellite // 100], satellite % 100, number, 0, lock[i],
                cn0, 0, 0, 0, int(status), 0,
            )  # fmt: skip
            many += 1
        gps = obs.zero + t
        out += frame(0x15, struct.pack("<dHb5B", gps % WEEK, int(gps // WEEK), 18, many, 1, 1, 0, 0) + rows)
        if not k:
            out += b"".join(encode_ephemerides(nav, gps))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("observations", type=Path)
    parser.add_argument("navigation", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    obs, _ = read_rover((given.observations,))
    given.output.write_bytes(encode_log(obs, read_navigation([given.navigation])))


if __name__ == "__main__":
    main()
