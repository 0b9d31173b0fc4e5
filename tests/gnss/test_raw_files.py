"""Files as archives and receivers give them: packed ones, navigation of every version, antennas of satellites."""

from __future__ import annotations

import bz2
import gzip
import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_told

from graphnav.core.errors import RecordingError
from graphnav.core.notes import get_key
from graphnav.gnss.antex import SatelliteAntenna, compute_antenna_paths, read_antex
from graphnav.gnss.channels import find_channels
from graphnav.gnss.ephemeris import Ephemerides
from graphnav.gnss.load import Sources, load_raw
from graphnav.gnss.ppp import choose_second_signals
from graphnav.gnss.precise import read_precise
from graphnav.gnss.rinex_nav import read_navigation
from graphnav.gnss.rinex_obs import read_observations
from graphnav.gnss.series import Observations
from graphnav.gnss.signals import GLONASS, C, find_frequencies, number_satellite, number_signal

DATA = Path(__file__).resolve().parents[2] / "data"
KAMAKURA = DATA / "kamakura_rtk"
BASE_NAV = Path("tokyo_20201105") / "raw" / "base.nav.gz"


@pytest.fixture(scope="module")
def rt():
    return pytest.importorskip("pyrtklib")


# --------------------------------------------------------------------------------------------------- packed
def _zip(data: bytes) -> bytes:
    out = BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        file.writestr("one.rnx", data)
    return out.getvalue()


def _compress(data: bytes) -> bytes:
    return pytest.importorskip("ncompress").compress(data)  # type: ignore[no-any-return]


def _hatanaka(data: bytes) -> bytes:
    return pytest.importorskip("hatanaka").rnx2crx(data)  # type: ignore[no-any-return]


PACKED: dict[str, Callable[[bytes], bytes]] = {
    "rnx.Z": _compress,
    "crx": _hatanaka,
    "21d": _hatanaka,
    "crx.Z": lambda data: _compress(_hatanaka(data)),
    "21d.Z": lambda data: _compress(_hatanaka(data)),
    "crx.gz": lambda data: gzip.compress(_hatanaka(data)),
    "crx.bz2": lambda data: bz2.compress(_hatanaka(data)),
    "zip": _zip,
}


@pytest.mark.parametrize("kind", PACKED)
def test_observations_are_the_same_however_they_are_packed(tmp_path: Path, kind: str) -> None:
    plain = gzip.decompress((KAMAKURA / "rover.obs.gz").read_bytes())
    (tmp_path / "one.rnx").write_bytes(plain)
    (tmp_path / f"one.{kind}").write_bytes(PACKED[kind](plain))
    whole, found = (read_observations(tmp_path / name) for name in ("one.rnx", f"one.{kind}"))
    for name in ("t", "satellite", "signal", "code", "carrier", "doppler", "cn0", "slip", "half"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name), name)


def test_orbits_clocks_and_ephemerides_are_read_from_compress(tmp_path: Path, shared_data: Path) -> None:
    slac = shared_data / "raw_gnss_slac_20210428"
    paths = {}
    for name in ("COD0MGXFIN_20211180000_01D_05M_ORB.SP3", "COD0MGXFIN_20211180000_01D_30S_CLK.CLK", "brdc1180.21n"):
        paths[name[-3:]] = tmp_path / f"{name}.Z"
        paths[name[-3:]].write_bytes(_compress(gzip.decompress((slac / f"{name}.gz").read_bytes())))
    found = read_precise([paths["SP3"]], [paths["CLK"]])
    whole = read_precise([next(slac.glob("*SP3.gz"))], [next(slac.glob("*CLK.gz"))])
    assert found.orbit.keys() == whole.orbit.keys()
    assert found.clock.keys() == whole.clock.keys()
    same(read_navigation([paths["21n"]]), read_navigation([slac / "brdc1180.21n.gz"]))


def test_what_was_cut_while_packed_is_told(tmp_path: Path) -> None:
    plain = gzip.decompress((KAMAKURA / "rover.obs.gz").read_bytes())
    whole = read_observations(KAMAKURA / "rover.obs.gz")
    packed = PACKED["crx.Z"](plain)
    (tmp_path / "one.crx.Z").write_bytes(packed[: len(packed) // 2])
    try:
        found = read_observations(tmp_path / "one.crx.Z")
    except RecordingError as error:
        assert error.key == "file.damaged"  # noqa: PT017
    else:
        assert 0 < len(found) < len(whole)
        np.testing.assert_array_equal(found.code, whole.code[: len(found)])


Nodes = dict[int, tuple[np.ndarray, np.ndarray]]


def are_nodes_of(found: Nodes, whole: Nodes) -> bool:
    """Whether nodes are the first of those of the whole file."""
    pairs = ((x, y) for one, many in found.items() for x, y in zip(many, whole[one], strict=True))
    return all(np.array_equal(x, y[: len(x)]) for x, y in pairs)


@pytest.mark.parametrize(
    ("kind", "record", "before"), [("SP3", rb"\nPG05", 15), ("SP3", rb"\n\* ", 14), ("CLK", rb"\nAS G05", 15)]
)
def test_of_precise_products_cut_in_a_record_all_before_it_is_used(
    shared_data: Path, tmp_path: Path, kind: str, record: bytes, before: int
) -> None:
    """Cut everywhere in the fifteenth record: `before` are the nodes of the satellite in front of it."""
    slac = shared_data / "raw_gnss_slac_20210428"
    sp3, path, g04, g05 = next(slac.glob("*SP3.gz")), tmp_path / f"cut.{kind}", *map(number_satellite, ("G04", "G05"))
    text = gzip.decompress(next(slac.glob(f"*{kind}.gz")).read_bytes())
    whole = read_precise([sp3], list(slac.glob("*CLK.gz")) if kind == "CLK" else [])
    assert "raw.cut" not in {get_key(note) for note in whole.remarks}
    begin = [m.start() + 1 for m in re.finditer(record, text)][14]
    for at in range(begin + 1, text.find(b"\n", begin), 3):
        path.write_bytes(text[:at])
        found = read_precise([path], []) if kind == "SP3" else read_precise([sp3], [path])
        assert [get_key(note) for note in found.remarks].count("raw.cut") == 1
        nodes = found.orbit if kind == "SP3" else found.clock
        assert [len(nodes[one][0]) for one in (g04, g05)] == [before, 14]
        assert are_nodes_of(found.orbit, whole.orbit)
        assert are_nodes_of(found.clock, whole.clock)


# ----------------------------------------------------------------------------------------------- navigation
def same(found: Ephemerides, whole: Ephemerides) -> None:
    """Whether all numbers of two collections are the same."""
    for one, other in ((found.kepler, whole.kepler), (found.glonass, whole.glonass)):
        for name in one:
            np.testing.assert_array_equal(one[name], other[name], name)
    np.testing.assert_array_equal(found.klobuchar, whole.klobuchar)


@pytest.mark.parametrize("name", ["raw_gnss_slac_20210428/brdc1180.21n.gz", "ucr_riverside_20200712/nav.gz"])
def test_of_ephemerides_cut_in_a_record_all_before_it_are_used(shared_data: Path, tmp_path: Path, name: str) -> None:
    text = gzip.decompress((shared_data / name).read_bytes())
    begins = [m.start() for m in re.finditer(rb"^(?! {3}).", text.partition(b"END OF HEADER")[2], flags=re.MULTILINE)]
    begin, end = (text.find(b"END OF HEADER") + 13 + begins[k] for k in (40, 41))
    path = tmp_path / "nav"
    path.write_bytes(text[:begin])
    before = read_navigation([path])
    for at in range(begin + 2, text.rfind(b"\n", 0, end - 1), 23):
        path.write_bytes(text[:at])
        found = read_navigation([path])
        assert [get_key(note) for note in found.remarks] == ["raw.cut"]
        same(found, before)


def list_records(text: str) -> Iterator[list[str]]:
    """The records of a file of version 3, each as its lines, satellites as G05."""
    body = text.partition("END OF HEADER")[2].split("\n", 1)[1]
    for match in re.finditer(r"^[GRECJ][ \d]\d .*\n(?:    .*\n)*", body, flags=re.MULTILINE):
        first, *rest = match.group().splitlines()
        yield [first[:3].replace(" ", "0") + first[3:], *rest]


def number(x: float) -> str:
    return f"{x:19.12E}"


def write_version_4(text: str) -> str:
    """A file of version 3 as one of version 4, among messages that are not of orbits or not read."""
    out = [f"{'     4.01           N: GNSS NAV DATA    M: MIXED':<60}RINEX VERSION / TYPE", f"{'':60}END OF HEADER"]
    when = "    2020 11 05 05 00 00"
    for name, few in (("G01 LNAV", 1.0), ("J02 LNAV", 3.0), ("C21 D1D2", 4.0)):
        v = [few * x for x in (1e-8, 2e-8, -6e-8, -1e-7, 9e4, 5e4, -2e5, -3e5)]
        rows = [when + "".join(map(number, v[:3])), *("    " + "".join(map(number, x)) for x in (v[3:7], v[7:]))]
        out += [f"> ION {name}", *rows]
    out += ["> ION E11 IFNV", when + number(40.0) + number(0.05) + number(0.01), "    " + number(0.0)]
    for row in list_records(text):
        system = row[0][0]
        source = 0 if system != "E" else int(float(row[5][23:42].replace("D", "E")))
        kind = {"R": "FDMA", "C": "D1", "E": "FNAV" if source & 0x102 else "INAV"}.get(system, "LNAV")
        sto = [f"> STO {row[0][:3]} {kind}", f"{when} GPUT{'':18}UTC(USNO)", "    " + number(2e5) + number(9e-10)]
        eop = [f"> EOP {row[0][:3]} {kind}", when + 3 * number(1e-1), *2 * ["    " + 4 * number(1e-3)]]
        other = [f"> EPH {row[0][:3]} CNAV", *row, "    " + number(0.0)] if system == "G" else []
        more = ["    " + 4 * number(0.0)] if system == "R" else []
        out += [*sto, f"> EPH {row[0][:3]} {kind}", *row, *more, *eop, *other]
    return "\n".join(out) + "\n"


def write_version_2(text: str, system: str) -> str:
    """The records of one system of a file of version 3 as one of version 2."""
    kind = "GLONASS NAV DATA" if system == "R" else "N: GPS NAV DATA"
    out = [f"{f'     2.10           {kind}':<60}RINEX VERSION / TYPE", f"{'':60}END OF HEADER"]
    for row in list_records(text):
        if row[0][0] != system:
            continue
        y, mon, d, h, m, s = map(int, row[0][4:23].split())
        first = f"{int(row[0][1:3]):2d} {y % 100:02d} {mon:2d} {d:2d} {h:2d} {m:2d}{float(s):5.1f}{row[0][23:]}"
        out += [line.replace("E", "D") for line in (first, *(line[1:] for line in row[1:]))]
    return "\n".join(out) + "\n"


def test_version_4_holds_what_version_3_does(tmp_path: Path, shared_data: Path) -> None:
    path = tmp_path / "four.rnx"
    for source in (KAMAKURA / "nav.gz", shared_data / BASE_NAV):
        whole = read_navigation([source])
        path.write_text(write_version_4(gzip.decompress(source.read_bytes()).decode()))
        found = read_navigation([path])
        assert found.klobuchar is not None
        assert found.klobuchar[:, 0].tolist() == pytest.approx([1e-8, 9e4])
        same(found, Ephemerides(whole.kepler, whole.glonass, found.klobuchar))
        assert_told(found.remarks, "raw.unused_messages", "CNAV")
        t = whole.kepler["toe"] + 600.0 - whole.kepler["toe"][0]
        places = (one.place(whole.kepler["satellite"], t, whole.kepler["toe"][0]) for one in (found, whole))
        np.testing.assert_array_equal(*(one.p for one in places))


def test_version_2_holds_what_version_3_does(tmp_path: Path, shared_data: Path) -> None:
    text = gzip.decompress((shared_data / BASE_NAV).read_bytes()).decode()
    (tmp_path / "two.20n").write_text(write_version_2(text, "G"))
    (tmp_path / "two.20g").write_text(write_version_2(text, "R"))
    found, whole = (
        read_navigation([tmp_path / "two.20n", tmp_path / "two.20g"]),
        read_navigation([shared_data / BASE_NAV]),
    )
    own = whole.kepler["satellite"] < 100
    kepler = {name: value[own] for name, value in whole.kepler.items()}
    same(found, Ephemerides(kepler, whole.glonass))


def test_glonass_of_version_2_is_where_rtklib_has_it(rt, tmp_path: Path, shared_data: Path) -> None:
    """A centimetre and a tenth of a nanosecond are asked for; the channels are those of the carriers."""
    path = tmp_path / "two.20g"
    path.write_text(write_version_2(gzip.decompress((shared_data / BASE_NAV).read_bytes()).decode(), "R"))
    ours, theirs = read_navigation([path]), rt.nav_t()
    rt.readrnx(str(path), 1, "", rt.obs_t(), theirs, rt.sta_t())
    rs, dts, var, zero = rt.Arr1Ddouble(3), rt.Arr1Ddouble(2), rt.Arr1Ddouble(1), 2130 * 604800.0
    assert theirs.ng == len(ours.glonass["toe"])
    healthy = [k for k in range(theirs.ng) if theirs.geph[k].svh == 0]
    assert len(healthy) > 20
    for k in healthy:
        one = theirs.geph[k]
        name = np.array([100 * GLONASS + one.sat - rt.satno(rt.SYS_GLO, 1) + 1], dtype=np.int16)
        for ahead in (-890.0, -61.0, 0.0, 60.0, 450.0, 890.0):
            at = rt.timeadd(one.toe, ahead)
            rt.geph2pos(at, one, rs, dts, var)
            sent = rt.timediff(at, rt.gpst2time(2130, 0.0)) + dts[0]
            found = ours.place(name, np.array([sent]), zero)
            assert found.p[0] == pytest.approx([rs[i] for i in range(3)], abs=1e-3)
            assert found.clock[0] == pytest.approx(dts[0], abs=1e-12)
        for signal, code in (("1C", rt.CODE_L1C), ("2P", rt.CODE_L2P)):
            ids = np.array([number_signal(signal)], dtype=np.int16)
            hertz = find_frequencies(name, ids, ours.channels)[0]
            assert hertz == pytest.approx(rt.sat2freq(one.sat, code, theirs), abs=1e-3)


# --------------------------------------------------------------------------------------------------- antennas
def antenna(
    name: str, bands: dict[str, tuple[float, ...]], begin: str = "", end: str = "", started: bool = True
) -> str:
    """A block as those of the IGS: by azimuth too, and with sigmas."""
    out = [f"{'':60}START OF ANTENNA"] if started else []
    out += [f"{'BLOCK IIR-B':20}{name:20}{'G047':10}{'2003-058A':10}TYPE / SERIAL NO",
            f"{'':40}{'0    29-JAN-17':20}METH / BY / # / DATE", f"{'     5.0':60}DAZI",
            f"{'     0.0  14.0   2.0':60}ZEN1 / ZEN2 / DZEN", f"{len(bands):6d}{'':54}# OF FREQUENCIES"]  # fmt: skip
    out += [f"{date:60}VALID {word}" for date, word in ((begin, "FROM"), (end, "UNTIL")) if date]
    for kind in ("FREQUENCY", "FREQ RMS"):
        for band, (x, y, z, *varied) in bands.items():
            shrink = 1.0 if kind == "FREQUENCY" else 0.01
            out += [
                f"   {band:57}START OF {kind}",
                f"{f'{shrink * x:10.2f}{shrink * y:10.2f}{shrink * z:10.2f}':60}NORTH / EAST / UP",
            ]
            out.append("   NOAZI" + "".join(f"{shrink * v:8.2f}" for v in varied))
            out += [f"{a:8.1f}" + "".join(f"{9.0 * v:8.2f}" for v in varied) for a in (0.0, 180.0, 360.0)]
            out.append(f"   {band:57}END OF {kind}")
    return "\n".join([*out, f"{'':60}END OF ANTENNA"]) + "\n"


HEAD = f"{'     1.4            M':60}ANTEX VERSION / SYST\n{'A':60}PCV TYPE / REFANT\n{'':60}END OF HEADER\n"
PATTERN = (10.7, 10.1, 8.1, 4.6, 0.5, -3.8, -7.5, 9.7)
BANDS = {"G01": (12.45, -0.38, 2220.16, *PATTERN), "G02": (-7.2, 0.5, 1700.4, *(-0.5 * v for v in PATTERN))}
SECOND = {"G01": (2.0, 3.0, 2300.0, *PATTERN), "G02": (2.0, 3.0, 1800.0, *PATTERN)}
JUNE, LATER = "  2021     6    30    23    59   59.9999999", "  2021     7     1     0     0    0.0000000"


@pytest.fixture
def antex(tmp_path: Path) -> Path:
    """A number of two satellites one after the other, one of Galileo whose start is not said, a receiver's."""
    path = tmp_path / "igs.atx"
    blocks = (antenna("G22", BANDS, "  2003    12    21     0     0    0.0000000", JUNE), antenna("G22", SECOND, LATER),
              antenna("E13", {"E01": SECOND["G02"], "E05": SECOND["G01"]}, LATER, started=False),
              antenna("", BANDS))  # fmt: skip
    path.write_text(HEAD + "".join(blocks))
    return path


def test_antennas_are_those_that_rtklib_reads(rt, antex: Path) -> None:
    pcvs, ours = rt.pcvs_t(), read_antex(antex)[0]
    assert rt.readpcv(str(antex), pcvs)
    theirs = [pcvs.pcv[k] for k in range(pcvs.n) if pcvs.pcv[k].sat]
    assert len(theirs) == 3
    assert {s: len(some) for s, some in ours.items()} == {number_satellite("G22"): 2, number_satellite("E13"): 1}
    first, second = ours[number_satellite("G22")]
    for one, other in zip((first, second), theirs[:2], strict=True):
        for i, band in enumerate((1, 2)):
            np.testing.assert_allclose(one.offset[band], [other.off[i, j] for j in range(3)], atol=1e-12)
            np.testing.assert_allclose(one.variation[band][::2], [other.var[i, j] for j in range(8)], atol=1e-12)
    assert (first.end, second.begin) == pytest.approx((1309132799.9999999, 1309132800.0), abs=1e-6)


def test_sigmas_are_no_offsets_and_satellites_have_their_own(antex: Path) -> None:
    first, second = read_antex(antex)[0][number_satellite("G22")]
    np.testing.assert_allclose(first.offset[1], [0.01245, -0.00038, 2.22016])
    np.testing.assert_allclose(first.variation[1][::2], 1e-3 * np.array(PATTERN), atol=1e-15)
    np.testing.assert_allclose(first.variation[1][1], 0.0104)
    np.testing.assert_allclose(second.offset[2], [0.002, 0.003, 1.8])
    np.testing.assert_allclose(read_antex(antex)[0][number_satellite("E13")][0].offset[5], [0.002, 0.003, 2.3])


def test_antennas_before_one_that_is_cut_are_used(antex: Path) -> None:
    text, (whole, ends) = antex.read_bytes(), read_antex(antex)
    assert not ends
    first, last = (text.rfind(b"END OF ANTENNA", 0, k) for k in (text.find(b"E13"), len(text)))
    for at in range(first + 20, last + 13, 11):
        if text[:at].rstrip().endswith(b"END OF ANTENNA"):
            continue  # as whole as any
        antex.write_bytes(text[:at])
        found, ends = read_antex(antex)
        assert [get_key(note) for note in ends] == ["raw.cut"]
        assert [len(found[number_satellite("G22")]), len(found)] == [
            2,
            1 + (b"END OF ANTENNA" in text[first + 14 : at]),
        ]
        for one, many in found.items():
            for own, other in zip(many, whole[one], strict=True):
                assert own.begin == other.begin
                assert all(np.array_equal(own.variation[band], other.variation[band]) for band in other.variation)


def test_ways_are_by_the_angle_off_the_nadir(antex: Path) -> None:
    """A satellite whose axes are those of the frame, seen from where its z axis points to, and 7 deg off."""
    angle = np.radians([0.0, 7.0, 7.0])
    e = -np.stack([np.sin(angle), np.zeros(3), np.cos(angle)], axis=-1)
    axes, g22 = np.tile(np.eye(3), (3, 1, 1)), np.full(3, number_satellite("G22"), dtype=np.int16)
    hertz, bands = np.tile([1575.42e6, 1227.6e6], (3, 1)), np.tile([1, 2], (3, 1))
    found = compute_antenna_paths(read_antex(antex)[0], g22, hertz, bands, np.array([1.3e9, 1.3e9, 1.31e9]), axes, e)
    alpha = 1575.42**2 / (1575.42**2 - 1227.6**2)

    def way(band: dict[str, tuple[float, ...]], at: float, varied: float, other: float) -> float:
        (x, _, z), (u, _, w) = (1e-3 * np.array(band[name][:3]) for name in ("G01", "G02"))
        first, second = (-a * np.sin(at) - b * np.cos(at) for a, b in ((x, z), (u, w)))
        return alpha * (first + varied) - (alpha - 1.0) * (second + other)

    mean = 0.5e-3 * (PATTERN[3] + PATTERN[4])
    expected = [way(BANDS, 0.0, 1e-3 * PATTERN[0], -0.5e-3 * PATTERN[0]), way(BANDS, angle[1], mean, -0.5 * mean),
                way(SECOND, angle[1], mean, mean)]  # fmt: skip
    np.testing.assert_allclose(found, expected, atol=1e-12)
    bands[1, 1] = 5
    found = compute_antenna_paths(read_antex(antex)[0], g22, hertz, bands, np.full(3, 1.3e9), axes, e)
    assert np.isnan(found).tolist() == [False, True, False]


@pytest.mark.parametrize("channel", [-7, 0, 6])
def test_channels_are_told_by_codes_and_carriers_while_the_range_changes(channel):
    """By both signals, through an arc that ends and a slip; not by some seconds, in which noise moves codes as much."""
    rng, t = np.random.default_rng(channel + 7), np.arange(0.0, 300.0)
    parts = []
    for name in ("1C", "2P"):
        frequency = find_frequencies(
            *(np.array([x], dtype=np.int16) for x in (105, number_signal(name))), {105: channel}
        )
        way = 2e7 + 400.0 * t + 0.05 * t**2 + 1e3 * np.sin(0.1 * t)  # the receiver's clock wanders
        carrier = way * frequency / C + np.where(t < 100.0, 7e5, np.where(t < 200.0, -3e6, -3e6 + 1.0))
        parts.append((way + rng.normal(0.0, 1.0, len(t)), carrier, number_signal(name)))
    n, none = 2 * len(t), np.full(2 * len(t), np.nan)
    slip = np.tile(t == 100.0, 2)
    obs = Observations(
        0.0, np.tile(t, 2), np.full(n, 105, dtype=np.int16), np.repeat([p[2] for p in parts], len(t)).astype(np.int16),
        np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]), none, none, slip,
        np.zeros(n, dtype=bool), none,
    )  # fmt: skip
    assert find_channels(obs) == {105: channel}
    assert find_channels(obs.take(obs.t < 5.0)) == {}


def test_glonass_is_combined_where_its_antennas_are_known(shared_data):
    """Channels are found without a navigation file of GLONASS; offsets of metres are not in an ambiguity."""
    folder = shared_data / "raw_gnss_slac_20210428"
    precise = {"sp3": tuple(folder.glob("*ORB.SP3.gz")), "clk": tuple(folder.glob("*CLK.CLK.gz"))}
    raw, _, notes = load_raw(Sources((folder / "slac1180.21o.gz",), (folder / "brdc1180.21n.gz",), **precise))
    assert "raw.channels_found" in map(get_key, notes)
    systems = {one // 100 for one in choose_second_signals(raw)}
    assert GLONASS not in systems
    known = {number_satellite("R09"): (SatelliteAntenna(-np.inf, np.inf, {1: np.zeros(3), 2: np.zeros(3)}),)}
    more = choose_second_signals(replace(raw, antennas=known))
    assert more.keys() - choose_second_signals(raw).keys() == known.keys()
