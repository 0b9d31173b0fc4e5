"""u-blox logs: made frame by frame here, and read by RTKLIB as well."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_told, refused
from ubx_frames import MEASURED, TOW, WEEK_NUMBER, frame, rawx

from graphnav.core.errors import RecordingError
from graphnav.core.timescales import WEEK
from graphnav.gnss.load import read_rover
from graphnav.gnss.messages import Decoder
from graphnav.gnss.signals import name_satellite, number_satellite, number_signal
from graphnav.gnss.ubx import parse_ubx


def sfrbx(gnss: int, sv: int, words: list[int], channel: int = 9) -> bytes:
    head = struct.pack("<BBBBBBBB", gnss, sv, 0, channel, len(words), 0, 2, 0)
    return frame((0x02, 0x13), head + b"".join(struct.pack("<I", w) for w in words))


def put(bits: np.ndarray, at: int, n: int, value: int) -> None:
    bits[at : at + n] = [value >> n - 1 - i & 1 for i in range(n)]


def number(bits: np.ndarray) -> int:
    return int("".join(map(str, bits)), 2)


def lnav(rng: np.random.Generator, gnss: int, sv: int) -> bytes:
    """Subframes 1 to 3 of any content, of one issue, healthy, of times within the week."""
    out = b""
    for part in (1, 2, 3):
        data = rng.integers(0, 2, 240)
        put(data, 0, 8, 0x8B)
        put(data, 24, 17, int(TOW / 6) + part)
        put(data, 43, 3, part)
        if part == 1:
            put(data, 48, 10, WEEK_NUMBER % 1024)
            put(data, 64, 6, 0)
            put(data, 70, 2, 0)
            put(data, 168, 8, 77)
            put(data, 176, 16, int(TOW // 7200 * 7200 / 16))
        if part == 2:
            put(data, 48, 8, 77)
            put(data, 216, 16, int(TOW // 7200 * 7200 / 16))
        if part == 3:
            put(data, 216, 8, 77)
        out += sfrbx(gnss, sv, [number(data[24 * i : 24 * i + 24]) << 6 for i in range(10)])
    return out


def inav_words(rng: np.random.Generator, sv: int) -> list[np.ndarray]:
    """Words 0 to 5, 128 bits each, of one issue."""
    words = []
    for word in range(6):
        data = rng.integers(0, 2, 128)
        put(data, 0, 6, word)
        if word in (1, 2, 3, 4):
            put(data, 6, 10, 99)
        if word in (0, 5):
            put(data, 96 if word == 0 else 73, 12, WEEK_NUMBER - 1024)
            put(data, 108 if word == 0 else 85, 20, int(TOW))
        if word == 0:
            put(data, 6, 2, 2)
        if word == 1:
            put(data, 16, 14, int(TOW // 600 * 600 / 60))
        if word == 4:
            put(data, 16, 6, sv)
            put(data, 54, 14, int(TOW // 600 * 600 / 60))
        if word == 5:
            put(data, 67, 6, 0)
        words.append(data)
    return words


def inav(words: list[np.ndarray], sv: int) -> bytes:
    """Words in even and odd pages."""
    out = b""
    for data in words:
        bits = np.zeros(256, dtype=int)
        bits[2:114], bits[130:146], bits[128] = data[:112], data[112:], 1
        out += sfrbx(2, sv, [number(bits[32 * i : 32 * i + 32]) for i in range(8)])
    return out


def fnav_pages(rng: np.random.Generator, sv: int) -> list[np.ndarray]:
    """Pages 1 to 4, 244 bits each, of one issue."""
    pages = []
    for part in (1, 2, 3, 4):
        data = rng.integers(0, 2, 244)
        put(data, 0, 6, part)
        put(data, 12 if part == 1 else 6, 10, 99)
        if part == 1:
            put(data, 6, 6, sv)
            put(data, 22, 14, int(TOW // 600 * 600 / 60))
            put(data, 153, 2, 0)
        if part == 3:
            put(data, 160, 14, int(TOW // 600 * 600 / 60))
        pages.append(data)
    return pages


def d1(rng: np.random.Generator, sv: int) -> bytes:
    """Subframes 1 to 3, six seconds apart."""
    out = b""
    toe = int(TOW // 3600 * 3600 / 8)
    for part in (1, 2, 3):
        data = rng.integers(0, 2, 300)
        put(data, 15, 3, part)
        sow = int(TOW // 30 * 30) + 6 * part
        put(data, 18, 8, sow >> 12)
        put(data, 30, 12, sow & 0xFFF)
        if part == 1:
            put(data, 42, 1, 0)
            put(data, 60, 13, WEEK_NUMBER - 1356)
            put(data, 73, 9, toe >> 8)
            put(data, 90, 8, toe & 0xFF)
        if part == 2:
            put(data, 290, 2, toe >> 15)
        if part == 3:
            put(data, 42, 10, toe >> 5 & 0x3FF)
            put(data, 60, 5, toe & 0x1F)
        out += sfrbx(3, sv, [number(data[30 * i : 30 * i + 30]) for i in range(10)])
    return out


@pytest.fixture(scope="module")
def log() -> bytes:
    rng = np.random.default_rng(4)
    out = rawx(TOW)
    out += inav(inav_words(rng, 11), 11) + lnav(rng, 0, 7) + lnav(rng, 5, 2) + d1(rng, 23)
    return out + rawx(TOW + 0.2, 5200) + rawx(TOW + 0.4, 150, 0x03)


def test_measurements_are_named_and_slips_are_told_by_the_time_in_lock(log: bytes, tmp_path: Path) -> None:
    (tmp_path / "drive.ubx").write_bytes(b"$GNGGA,noise*00\r\n" + log)
    obs, nav = read_rover((tmp_path / "drive.ubx",))
    assert nav.satellites == {number_satellite(name) for name in ("G07", "J02", "E11", "C23")}
    assert obs.zero == WEEK * WEEK_NUMBER
    np.testing.assert_allclose(np.unique(obs.t), [TOW, TOW + 0.2, TOW + 0.4], atol=1e-9)
    for k, (_, _, _, satellite, signal) in enumerate(MEASURED):
        own = (obs.satellite == number_satellite(satellite)) & (obs.signal == number_signal(signal))
        np.testing.assert_allclose(obs.code[own], 2.2e7 + 1000.0 * k + TOW + np.array([0.0, 0.2, 0.4]), atol=1e-6)
        np.testing.assert_allclose(obs.doppler[own], -1234.5 + k)
        assert obs.cn0[own].tolist() == [40 + k] * 3
        assert obs.slip[own].tolist() == [False, False, True]
        assert obs.half[own].tolist() == [False, False, True]
    assert obs.channels == {number_satellite("R05"): 2}


def test_ephemerides_are_those_that_rtklib_decodes(log: bytes) -> None:
    rt = pytest.importorskip("pyrtklib")
    _, nav = parse_ubx(log, Path("drive.ubx"))
    raw = rt.raw_t()
    rt.init_raw(raw, rt.STRFMT_UBX)
    raw.time = rt.gpst2time(WEEK_NUMBER, TOW)
    for byte in log:
        rt.input_ubx(raw, byte)
    systems = {"G07": rt.SYS_GPS, "J02": rt.SYS_QZS, "E11": rt.SYS_GAL, "C23": rt.SYS_CMP}
    words = inav_words(np.random.default_rng(4), 11)  # RTKLIB's reader of pages takes none of these, its decoder does
    buffer = getattr(rt, "Arr1Dunsigned char")(96)
    for i, byte in enumerate(np.packbits(np.concatenate(words).astype(np.uint8))):
        buffer[i] = int(byte)
    more = rt.Arr1Ddouble(8), rt.Arr1Ddouble(8)
    galileo = rt.eph_t()
    rt.decode_gal_inav(buffer, galileo, *more)
    ours = {name_satellite(s): k for k, s in enumerate(nav.kepler["satellite"])}
    assert set(ours) == set(systems)
    for name, system in systems.items():
        sat = rt.satno(system, int(name[1:]) + (192 if name[0] == "J" else 0))
        theirs = galileo if name[0] == "E" else raw.nav.eph[sat - 1]
        one = {key: value[ours[name]] for key, value in nav.kepler.items()}
        for key, their in SAME.items():
            assert one[key] == pytest.approx(getattr(theirs, their), rel=1e-12), (name, key)
        assert one["root_a"] ** 2 == pytest.approx(theirs.A, rel=1e-12)
        np.testing.assert_allclose(one["clock"], [theirs.f0, theirs.f1, theirs.f2], rtol=1e-12)
        epoch = rt.gpst2time(WEEK_NUMBER, 0.0)
        assert one["toe"] - WEEK * WEEK_NUMBER == pytest.approx(rt.timediff(theirs.toe, epoch), abs=1e-6), name
        assert one["toc"] - WEEK * WEEK_NUMBER == pytest.approx(rt.timediff(theirs.toc, epoch), abs=1e-6), name
        for k, delay in enumerate(one["delay"]):
            assert np.isnan(delay) or delay == pytest.approx(theirs.tgd[k], rel=1e-12)


SAME = {
    "iode": "iode", "crs": "crs", "delta_n": "deln", "m0": "M0", "cuc": "cuc", "e": "e", "cus": "cus", "cic": "cic",
    "omega0": "OMG0", "cis": "cis", "i0": "i0", "crc": "crc", "omega": "omg", "omega_dot": "OMGd", "idot": "idot",
}  # fmt: skip


def test_fnav_is_what_rtklib_decodes_beside_an_inav_that_is_not_whole() -> None:
    rt = pytest.importorskip("pyrtklib")
    rng = np.random.default_rng(6)
    pages, words, decoder = fnav_pages(rng, 11), inav_words(rng, 11), Decoder()
    gps = WEEK * WEEK_NUMBER + TOW
    first = inav(words[:3], 11)
    size = len(first) // 3
    for k in range(3):
        decoder.add(first[k * size : (k + 1) * size][6:-2], gps)
    for data in pages:
        bits = np.concatenate([data, np.zeros(12, dtype=int)])
        page = bytearray(sfrbx(2, 11, [number(bits[32 * i : 32 * i + 32]) for i in range(8)])[6:-2])
        page[2] = 3  # E5a
        decoder.add(bytes(page), gps)
    ours = decoder.ephemerides.kepler
    assert ours["fnav"].tolist() == [1]
    buffer, theirs = getattr(rt, "Arr1Dunsigned char")(4 * 31), rt.eph_t()
    padded = np.concatenate([np.concatenate([data, np.zeros(4, dtype=int)]) for data in pages])
    for i, byte in enumerate(np.packbits(padded.astype(np.uint8))):
        buffer[i] = int(byte)
    assert rt.decode_gal_fnav(buffer, theirs, rt.Arr1Ddouble(8), rt.Arr1Ddouble(8)) == 1
    for key, their in SAME.items():
        assert ours[key][0] == pytest.approx(getattr(theirs, their), rel=1e-12), key
    assert ours["root_a"][0] ** 2 == pytest.approx(theirs.A, rel=1e-12)
    np.testing.assert_allclose(ours["clock"][0], [theirs.f0, theirs.f1, theirs.f2], rtol=1e-12)
    assert ours["delay"][0, 0] == pytest.approx(theirs.tgd[0], rel=1e-12)
    assert ours["toes"][0] == theirs.toes
    assert ours["toc"][0] - WEEK * WEEK_NUMBER == TOW // 600 * 600
    rest = inav(words[3:], 11)
    for k in range(3):
        decoder.add(rest[k * size : (k + 1) * size][6:-2], gps)
    assert decoder.ephemerides.kepler["fnav"].tolist() == [1, 0]


def test_d2_is_what_rtklib_decodes_whatever_page_comes_first() -> None:
    """Ten pages of a geostationary BeiDou satellite; pages of the round before are of another issue."""
    rt = pytest.importorskip("pyrtklib")
    rng, gps, toes = np.random.default_rng(7), WEEK * WEEK_NUMBER + TOW, 345600

    def put(page: np.ndarray, value: int, *parts: tuple[int, int]) -> None:
        text = f"{value:0{sum(n for _, n in parts)}b}"
        for at, n in parts:
            page[at : at + n], text = [int(x) for x in text[:n]], text[n:]

    def pages(begin: int) -> list[np.ndarray]:
        out = rng.integers(0, 2, (10, 300))
        for k, page in enumerate(out):
            put(page, 1, (15, 3))
            put(page, begin + 3 * k, (18, 8), (30, 12))
            put(page, k + 1, (42, 4))
        put(out[0], toes // 8, (77, 5), (90, 12))
        put(out[6], toes // 8, (80, 2), (90, 15))
        put(out[5], 1, (76, 1))  # an axis that is none of zero
        return list(out)

    before, whole = pages(345600), pages(345630)
    decoder = Decoder()
    for page in (*before[4:], *whole):
        decoder.add(sfrbx(3, 3, [number(page[30 * i : 30 * i + 30]) for i in range(10)])[6:-2], gps)
    ours = decoder.ephemerides.kepler
    assert len(ours["e"]) == 1
    buffer, theirs = getattr(rt, "Arr1Dunsigned char")(38 * 11), rt.eph_t()
    of_utc = np.zeros(300, dtype=int)  # which RTKLIB wants as well
    put(of_utc, 5, (15, 3))
    put(of_utc, 102, (43, 7))
    padded = np.concatenate([np.concatenate([page, np.zeros(4, dtype=int)]) for page in (*whole, of_utc)])
    for i, byte in enumerate(np.packbits(padded.astype(np.uint8))):
        buffer[i] = int(byte)
    assert rt.decode_bds_d2(buffer, theirs, rt.Arr1Ddouble(9)) == 1
    for key, their in SAME.items():
        assert ours[key][0] == pytest.approx(getattr(theirs, their), rel=1e-12), key
    assert ours["root_a"][0] ** 2 == pytest.approx(theirs.A, rel=1e-12)
    np.testing.assert_allclose(ours["clock"][0], [theirs.f0, theirs.f1, theirs.f2], rtol=1e-12)
    np.testing.assert_allclose(ours["delay"][0], [theirs.tgd[0], theirs.tgd[1]], rtol=1e-12)
    assert ours["toes"][0] == theirs.toes


def test_what_is_broken_or_cut_costs_only_itself(log: bytes, tmp_path: Path) -> None:
    whole, _ = parse_ubx(log, Path("drive.ubx"))
    spoiled = bytearray(log)
    spoiled[40] ^= 0xFF  # in the first epoch
    left, _ = parse_ubx(bytes(spoiled), Path("drive.ubx"))
    assert len(left) == len(whole) * 2 // 3
    cut, nav = parse_ubx(log[:-20], Path("drive.ubx"))
    assert len(cut) == len(whole) * 2 // 3
    assert len(nav.kepler["toe"]) == 4
    assert_told(cut.remarks, "raw.cut", "drive.ubx")
    with refused("raw.no_messages", RecordingError, "RXM-RAWX"):
        parse_ubx(frame((1, 7), bytes(92)), Path("drive.ubx"))


def test_glonass_strings_are_those_that_rtklib_decodes() -> None:
    rt = pytest.importorskip("pyrtklib")
    rng = np.random.default_rng(5)
    strings = []
    for part in (1, 2, 3, 4):
        data = rng.integers(0, 2, 128)
        put(data, 1, 4, part)
        if part == 2:
            put(data, 5, 3, 0)
            put(data, 9, 7, 27)
        strings.append(data)
    decoder = Decoder()
    gps = WEEK * WEEK_NUMBER + 2 * 86400.0 + 27 * 900.0 - 3 * 3600.0 + 500.0
    for data in strings:
        decoder.add(sfrbx(6, 5, [number(data[32 * i : 32 * i + 32]) for i in range(4)])[6:-2], gps)
    ours = decoder.ephemerides.glonass
    buffer = getattr(rt, "Arr1Dunsigned char")(40)
    for i, byte in enumerate(np.packbits(np.concatenate([x[:80] for x in strings]).astype(np.uint8))):
        buffer[i] = int(byte)
    theirs = rt.geph_t()
    rt.decode_glostr(buffer, theirs, rt.Arr1Ddouble(8))
    for key, their in (("p", "pos"), ("v", "vel"), ("a", "acc")):
        np.testing.assert_allclose(ours[key][0], [getattr(theirs, their)[i] for i in range(3)], rtol=1e-12)
    assert ours["clock"][0] == pytest.approx(-theirs.taun, rel=1e-12)
    assert ours["drift"][0] == pytest.approx(theirs.gamn, rel=1e-12)
    assert ours["channel"][0] == 2
    # quarter 27 of that day in Moscow, in GPS time by the 18 leap seconds of 2022
    assert ours["toe"][0] == gps - 500.0 + 18.0
