"""Satellites and signals as numbers, their RINEX names and their frequencies.

A satellite is 100 times the place of its system in `SYSTEMS` plus its RINEX number (G05: 5, E11: 211); a signal is 100
times its band plus the letter of its attribute, A = 0 (1C: 102). RINEX 3.05, tables 4 to 10.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array

Ids = NDArray[np.int16]

C = 299792458.0  # m/s
SYSTEMS = "GRECJIS"
SYSTEM_NAMES = ("GPS", "GLONASS", "Galileo", "BeiDou", "QZSS", "NavIC", "SBAS")
GPS, GLONASS, GALILEO, BEIDOU, QZSS, NAVIC, SBAS = range(7)
_MHZ: dict[int, dict[int, float]] = {
    GPS: {1: 1575.42, 2: 1227.60, 5: 1176.45},
    GLONASS: {1: 1602.0, 2: 1246.0, 3: 1202.025, 4: 1600.995, 6: 1248.06},
    GALILEO: {1: 1575.42, 5: 1176.45, 6: 1278.75, 7: 1207.14, 8: 1191.795},
    BEIDOU: {1: 1575.42, 2: 1561.098, 5: 1176.45, 6: 1268.52, 7: 1207.14, 8: 1191.795},
    QZSS: {1: 1575.42, 2: 1227.60, 5: 1176.45, 6: 1278.75},
    NAVIC: {1: 1575.42, 5: 1176.45, 9: 2492.028},
    SBAS: {1: 1575.42, 5: 1176.45},
}
_ATTRIBUTES: dict[int, dict[int, str]] = {  # of the codes on each band, RINEX 4.01, tables 11 to 17
    GPS: {1: "CSLXPWYMNR", 2: "CDSLXPWYMNR", 5: "IQX"},
    GLONASS: {1: "CP", 2: "CP", 3: "IQX", 4: "ABX", 6: "ABX"},
    GALILEO: {1: "ABCXZ", 5: "IQX", 6: "ABCXZ", 7: "IQX", 8: "IQX"},
    BEIDOU: {1: "DPXASLZN", 2: "IQX", 5: "DPX", 6: "IQXADPZ", 7: "IQXDPZ", 8: "DPX"},
    QZSS: {1: "CESLXZB", 2: "SLX", 5: "IQXDPZ", 6: "SLXEZ"},
    NAVIC: {1: "DPX", 5: "ABCX", 9: "ABCX"},
    SBAS: {1: "C", 5: "IQX"},
}
_STEP = {1: 0.5625, 2: 0.4375}  # MHz from channel to channel of GLONASS
L1 = 1575.42e6  # Hz


def number_satellite(name: str) -> int:
    """The number of a satellite's RINEX name, "G05" or "G 5".

    Raises
    ------
    ValueError
        If it is none.
    """
    number = name[1:3].strip()
    if not (number.isascii() and number.isdigit() and int(number)):
        raise ValueError(f"'{name}' names no satellite")
    if name[0] not in SYSTEMS:
        raise ValueError(f"'{name}' is of no satellite system that is known")
    return 100 * SYSTEMS.index(name[0]) + int(number)


def name_satellite(satellite: int) -> str:
    """RINEX name of a satellite."""
    return f"{SYSTEMS[int(satellite) // 100]}{int(satellite) % 100:02d}"


def find_system(satellite: Ids) -> Ids:
    """(N,) place in `SYSTEMS` of each satellite."""
    return satellite // 100


def number_signal(name: str) -> int:
    """The number of a signal's name, band and attribute: "1C"."""
    return 100 * int(name[0]) + ord(name[1]) - ord("A")


def name_signal(signal: int) -> str:
    """RINEX name of a signal, without the kind of observation: "1C"."""
    return f"{int(signal) // 100}{chr(int(signal) % 100 + ord('A'))}"


def is_known_signal(system: int, name: str) -> bool:
    """Whether a system's satellites send a signal of that name, band and attribute: "1C"."""
    return len(name) == 2 and name[0].isdecimal() and name[1] in _ATTRIBUTES[system].get(int(name[0]), "")


def find_frequencies(satellite: Ids, signal: Ids, channels: Mapping[int, int] | None = None) -> Array:
    """(N,) carrier frequencies, Hz; NaN where the signal is unknown, or a GLONASS satellite's channel.

    Parameters
    ----------
    channels : frequency channel, -7 to 6, by GLONASS satellite.
    """
    table = np.full((len(SYSTEMS), 10), np.nan)
    for system, bands in _MHZ.items():
        for number, mhz in bands.items():
            table[system, number] = mhz * 1e6
    band = np.asarray(signal) // 100
    out = np.asarray(table[find_system(satellite), band])
    divided = (find_system(satellite) == GLONASS) & (band <= 2)
    if np.any(divided):
        known = np.full(100, np.nan)
        for one, channel in (channels or {}).items():
            known[one % 100] = channel
        step = np.where(band == 1, _STEP[1], _STEP[2]) * 1e6
        out = np.where(divided, out + step * known[satellite % 100], out)
    return out
