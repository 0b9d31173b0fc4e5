"""Observations of a rover and a base with a mistake in them: told by a key, and nothing that is good is lost."""

from __future__ import annotations

import gzip
import re
import shutil
import struct
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import refused
from ubx_frames import frame

from graphnav.config import Settings, parse_settings
from graphnav.constraints.raw_gnss import GnssCode
from graphnav.core.errors import RecordingError
from graphnav.core.notes import get_key
from graphnav.estimation.pipeline import run
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.precise import read_precise
from graphnav.gnss.series import RawGnss
from graphnav.gnss.signals import name_satellite, number_satellite, number_signal
from graphnav.recording import Recording
from graphnav.recording.checks.aiding import describe_gnss_apart
from graphnav.recording.checks.raw import check_raw
from graphnav.recording.formats import read

DRIVE = Path(__file__).resolve().parents[2] / "data" / "kamakura_rtk"
Change = Callable[[str], str]


@pytest.fixture
def changed(tmp_path: Path) -> Callable[..., Recording]:
    """Reads the drive with the text of a file changed."""

    def read_with(name: str, change: Change) -> Recording:
        folder = tmp_path / "drive"
        shutil.copytree(DRIVE, folder, dirs_exist_ok=True)
        if name.endswith(".toml"):
            (folder / name).write_text(change((folder / name).read_text()))
        else:
            (folder / name).write_bytes(
                gzip.compress(change(gzip.decompress((folder / name).read_bytes()).decode()).encode())
            )
        return read(folder)

    return read_with


@pytest.fixture(scope="module")
def whole() -> RawGnss:
    return raw_of(read(DRIVE))


def raw_of(recording: Recording) -> RawGnss:
    assert recording.raw_gnss is not None
    return recording.raw_gnss


def keys(recording: Recording) -> set[str]:
    return {get_key(remark) for remark in recording.remarks}


def by_row(raw: RawGnss) -> dict[tuple[int, int, int], tuple[float, float]]:
    """Code and carrier, with the base's part of the latter, of each epoch (to 10 ms), satellite and signal."""
    return {
        (round(t * 100), int(s), int(g)): (code, carrier)
        for t, s, g, code, carrier in zip(raw.t, raw.satellite, raw.signal, raw.code, raw.carrier, strict=True)
    }


def same_rows(raw: RawGnss, whole: RawGnss, lost: Callable[[tuple[int, int, int]], bool]) -> bool:
    """Whether all is there as it was but for what is lost."""
    one, other = by_row(raw), by_row(whole)
    left = {key: value for key, value in other.items() if not lost(key)}
    return one.keys() == left.keys() and np.array_equal(list(one.values()), list(left.values()), equal_nan=True)


def blocks(text: str) -> tuple[str, list[str]]:
    """Header, and epochs."""
    head, *epochs = re.split(r"^(?=> )", text, flags=re.MULTILINE)
    return head, epochs


def test_a_satellite_without_an_ephemeris_is_named_and_the_others_stay(changed, whole):
    def without(text: str) -> str:
        return re.sub(r"^G15 .*\n(?:    .*\n){7}", "", text, flags=re.MULTILINE)

    one, gone = changed("nav.gz", without), number_satellite("G15")
    assert "raw.no_ephemeris" in keys(one)
    raw, own = raw_of(one), raw_of(one).satellite == gone
    assert own.any()
    assert not np.isfinite(raw.p[own]).any()
    others, before = raw.take(~own), whole.take(whole.satellite != gone)
    np.testing.assert_array_equal(others.carrier, before.carrier)
    assert np.isfinite(others.carrier_difference).sum() == np.isfinite(before.carrier_difference).sum() > 0


def test_a_base_of_another_day_is_refused(changed):
    with refused("raw.base_time", RecordingError, "base.obs.gz", "24.0 h"):
        changed("base.obs.gz", lambda text: text.replace("> 2021 09 22", "> 2021 09 23"))


@pytest.mark.parametrize("mode", ["stated", "estimated"])
def test_a_satellite_whose_codes_are_grossly_wrong_costs_its_codes_alone(changed, mode):
    def spoil(text: str) -> str:
        return re.sub(
            r"^(G05)( *[\d.]+)", lambda m: f"{m[1]}{float(m[2][:11]) + 1000.0:14.3f}", text, flags=re.MULTILINE
        )

    recording = changed("rover.obs.gz", spoil)
    one = run(recording, parse_settings({"noise": {"mode": mode}}), ("rts",))["rts"]
    assert "gnss_code.gross" in {get_key(note) for note in one.notes}
    assert name_satellite(number_satellite("G05")) not in set(one.records["gnss_code"].satellite)
    assert one.fixed[:, 1].all()
    assert len(one.arcs.begin) < 70  # 60 without the mistake


@pytest.mark.parametrize(("weeks", "days", "key", "words"), [
    (1, 0, "raw.base_time", ["base.obs.gz", "2021-09-22", "rover.ubx", "2021-09-29"]),
    (0, 3, "raw.ephemeris_day", ["rover.ubx", "2.9 days"]),
])  # fmt: skip
def test_a_log_with_wrong_times_is_named(tmp_path, weeks, days, key, words):
    """Its ephemerides tell days from each other, but not weeks; the base has dates."""
    folder = tmp_path / "drive"
    shutil.copytree(DRIVE, folder)
    data, out, at = (folder / "rover.ubx").read_bytes(), b"", 0
    while at < len(data):
        end = at + 8 + int.from_bytes(data[at + 4 : at + 6], "little")
        kind, payload = (data[at + 2], data[at + 3]), data[at + 6 : end - 2]
        if kind == (0x02, 0x15):  # RXM-RAWX
            t, week = struct.unpack_from("<dH", payload)
            payload = struct.pack("<dH", t + 86400.0 * days, week + weeks) + payload[10:]
        out, at = out + frame(kind, payload), end
    (folder / "rover.ubx").write_bytes(out)
    with refused(key, RecordingError, *words):
        read(folder / "ubx.toml")


def test_a_base_that_ends_early_leaves_the_rovers_own_observations(changed, whole):
    one = raw_of(changed("base.obs.gz", lambda text: "".join([blocks(text)[0], *blocks(text)[1][:20]])))
    assert "raw_gnss.base_short" not in {f.key for f in check_raw(one)}  # codes of it are used for a minute more
    late = replace(one, difference=np.where(one.t < one.t[0] + 20.0, one.difference, np.nan))
    assert [f.severity for f in check_raw(late) if f.key == "raw_gnss.base_short"] == ["warning"]
    np.testing.assert_array_equal(one.carrier, whole.carrier)
    both = np.isfinite(one.carrier_difference)
    np.testing.assert_allclose(np.diff(one.carrier_difference[both][:40]), np.diff(whole.carrier_difference[both][:40]))
    assert one.t[both].max() < one.t[0] + 20.0


def test_a_wrong_week_is_told(changed):
    one = changed("recording.toml", lambda text: text.replace("2021-09-22T", "2021-09-29T"))
    assert describe_gnss_apart(one) is not None  # with which the program refuses
    for script in (one, replace(one, gnss=None)):
        with pytest.raises(RecordingError):
            run(script, solvers=("ekf",))
    assert GnssCode.epochs(one, Settings(), np.empty((0, 2))).size == 0


def test_epochs_that_are_there_twice_are_taken_once(changed, whole):
    def twice(text: str) -> str:
        head, epochs = blocks(text)
        return "".join([head, *epochs[:11], epochs[10], *epochs[11:]])

    for name in ("rover.obs.gz", "base.obs.gz"):
        one = changed(name, twice)
        assert "raw.twice" in keys(one)
        raw = raw_of(one)
        assert same_rows(raw, whole, lambda _: False)
        np.testing.assert_array_equal(raw.carrier_difference, whole.carrier_difference)
        np.testing.assert_array_equal(find_arcs(raw, base_arc=raw.base_arc).arc, arcs_of(whole))


def arcs_of(raw: RawGnss) -> np.ndarray:
    return find_arcs(raw, base_arc=raw.base_arc).arc


def test_a_file_that_is_cut_in_a_record_keeps_what_is_whole(changed, whole):
    def cut(text: str) -> str:
        head, epochs = blocks(text)
        return head + "".join(epochs[:30]) + epochs[30][:400]

    one = changed("rover.obs.gz", cut)
    assert "raw.cut" in keys(one)
    raw = raw_of(one)
    last = np.unique(whole.t)[30]
    before = raw.take(raw.t < last - 0.5)
    assert same_rows(before, whole.take(whole.t < last - 0.5), lambda _: False)
    base = changed("base.obs.gz", cut)
    assert "raw.cut" in keys(base)
    assert same_rows(raw_of(base), whole, lambda _: False)


@pytest.mark.parametrize("name", ["9Q", "5K", "1I"])
def test_signals_that_are_not_known_are_named_and_the_others_stay(changed, whole, name):
    """A band that GPS has not, and codes that it does not send on the bands that it has."""

    def unknown(text: str) -> str:
        return text.replace("C5Q L5Q", f"C{name} L{name}", 1).replace("S5Q", f"S{name}", 1)

    one = changed("rover.obs.gz", unknown)
    raw, signal = raw_of(one), number_signal("5Q")
    said = next(remark for remark in one.remarks if get_key(remark) == "raw.unknown_signals")
    assert f"G C{name}" in said
    lost = set(np.unique(whole.satellite[whole.signal == signal])) - set(np.unique(raw.satellite[raw.signal == signal]))
    assert lost
    assert same_rows(raw, whole, lambda key: key[1] in lost and key[2] == signal)


def test_satellites_of_systems_that_are_not_known_are_counted_and_the_others_stay(changed, whole):
    name, other = "E30", "X30"

    def unknown(text: str) -> str:
        return re.sub(rf"^{name}", other, text, flags=re.MULTILINE)

    rows = len(np.unique(whole.t[whole.satellite == number_satellite(name)]))
    one = changed("rover.obs.gz", unknown)
    said = next(remark for remark in one.remarks if get_key(remark) == "raw.unknown_systems")
    assert f"{rows} of X" in said
    assert not keys(one) & {"raw.cut", "raw.short_epochs"}
    assert same_rows(raw_of(one), whole, lambda key: key[1] == number_satellite(name))
    ephemeris = changed("nav.gz", unknown)
    assert "raw.unused_messages" in keys(ephemeris)
    assert "raw.broken_records" not in keys(ephemeris)
    raw = raw_of(ephemeris)
    np.testing.assert_array_equal(
        np.isfinite(raw.p[:, 0]), np.isfinite(whole.p[:, 0]) & (whole.satellite != number_satellite(name))
    )


def test_a_half_cycle_ends_its_own_arc_alone(changed, whole):
    """A flag on one carrier: its arc ends, its code and all others stay."""
    name = "E30"  # whose first signal is 1C, with its carrier in the second field

    def half(text: str) -> str:
        head, epochs = blocks(text)
        epochs[15] = re.sub(rf"^({name}.{{30}}).", r"\g<1>2", epochs[15], flags=re.MULTILINE)
        return head + "".join(epochs)

    recording = changed("rover.obs.gz", half)
    raw = raw_of(recording)
    assert "raw.half_cycles" in keys(recording)
    of = raw.satellite == number_satellite(name)
    assert same_rows(raw, whole, lambda _: False)
    assert raw.half.sum() == whole.half.sum() + 1
    arcs, before = arcs_of(raw), arcs_of(whole)
    own = of & (raw.signal == number_signal("1C"))
    np.testing.assert_array_equal(arcs[~own], before[~own])
    assert len(np.unique(arcs[own])) == len(np.unique(before[own])) + 2  # before, half a cycle open, and after


# ------------------------------------------------------------------------- of another place, time or kind than stated
def move_base(metres: float) -> Change:
    return lambda text: text.replace("-3959400.631", f"{-3959400.631 - metres:.3f}")


def test_a_base_that_is_elsewhere_is_refused_and_how_far_it_is_off_is_told(changed):
    for metres in (1000.0, 60.0):
        with refused("raw.base_position", RecordingError, "base.obs.gz", " m from"):
            changed("recording.toml", move_base(metres))
    raw = raw_of(changed("recording.toml", move_base(15.0)))
    off, sigma = np.linalg.norm(raw.base_off, axis=1)
    assert off == pytest.approx(15.0, abs=sigma)
    assert [f.severity for f in check_raw(raw) if f.key == "raw_gnss.base_off"] == ["unreliable"]


@pytest.mark.parametrize("name", ["kamakura_rtk", "tokyo_raw"])
def test_a_base_where_it_is_stated_to_be_is_believed(name):
    raw = raw_of(read(DRIVE.parent / name))
    assert len(raw.base_off) == 2
    assert "raw_gnss.base_off" not in {f.key for f in check_raw(raw)}


def test_a_rover_in_the_place_of_the_base_is_found_out(changed):
    def swap(text: str) -> str:
        return text.replace("rover.obs", "X").replace("base.obs", "rover.obs").replace("X", "base.obs")

    for position in (r"^$", r"base_position.*\n"):
        with refused("raw.base_moves", RecordingError, "rover.obs.gz"):
            changed("recording.toml", lambda text, own=position: re.sub(own, "", swap(text), flags=re.MULTILINE))


@pytest.mark.parametrize("every", [15, 30])
def test_codes_of_a_slow_base_are_used(changed, whole, every):
    raw = raw_of(changed("base.obs.gz", lambda text: "".join([blocks(text)[0], *blocks(text)[1][::every]])))
    both = np.isfinite(raw.difference) & np.isfinite(whole.difference) & (raw.t < raw.t[0] + 30.0)
    assert both.sum() > 0.9 * np.sum(np.isfinite(whole.difference) & (whole.t < whole.t[0] + 30.0))
    # noise of single codes of the base, and no more
    assert np.sqrt(np.mean((raw.difference - whole.difference)[both] ** 2)) < 0.5
    carriers = np.isfinite(raw.carrier_difference) & np.isfinite(whole.carrier_difference)
    assert carriers.any()


@pytest.mark.parametrize("scale", ["GLO", "BDT"])
@pytest.mark.parametrize("name", ["rover.obs.gz", "base.obs.gz"])
def test_a_time_system_that_is_not_that_of_the_stamps_is_found_out(changed, name, scale):
    with refused("raw.contradictory", RecordingError, name):
        changed(name, lambda text: text.replace("GPS         TIME OF FIRST", f"{scale}         TIME OF FIRST"))


def test_a_time_system_that_there_is_not_is_told_with_its_line(changed):
    with refused("rinex.header", RecordingError, "rover.obs.gz, line"):
        changed("rover.obs.gz", lambda text: text.replace("GPS         TIME OF FIRST", "XYZ         TIME OF FIRST"))


def test_a_header_that_takes_carriers_for_codes_is_told(changed):
    with refused("raw.few_satellites", RecordingError, "rover.obs.gz", "1C"):
        changed("rover.obs.gz", lambda text: text.replace("C1C L1C", "L1C C1C"))


def test_carriers_under_the_name_of_another_frequency_are_no_integers(changed):
    """That of L2 as L5: each epoch slips against the others, and nothing of it is fixed."""
    one = changed("rover.obs.gz", lambda text: text.replace("C2W L2W S2W", "C5X L5X S5X", 1))
    raw = raw_of(one)
    wrong = (raw.satellite < 100) & (raw.signal == number_signal("5X")) & np.isfinite(raw.carrier)
    arcs = find_arcs(raw, base_arc=raw.base_arc)
    assert len(np.unique(raw.t[wrong])) > 30
    assert sum(len(arcs.begins[k]) for k, name in enumerate(arcs.names) if name.startswith("G") and "5X" in name) > 60


def test_an_interval_that_changes_keeps_all_epochs(changed, whole):
    raw = raw_of(changed("rover.obs.gz", lambda t: "".join([blocks(t)[0], *blocks(t)[1][:20], *blocks(t)[1][20::5]])))
    kept = {round(t * 100) for t in raw.t}
    assert same_rows(raw, whole, lambda key: key[0] not in kept)
    assert len(np.unique(raw.t)) == 25


def test_observations_without_carriers_are_codes(changed):
    raw = raw_of(
        changed(
            "rover.obs.gz", lambda text: re.sub(r" L(?=\d[A-Z] )", " X", blocks(text)[0]) + "".join(blocks(text)[1])
        )
    )
    assert np.isfinite(raw.difference).any()
    assert not np.isfinite(raw.carrier).any()


def clocks(satellites: Iterable[str], day: str) -> str:
    """A clock file, all of them right to the microsecond."""
    head = f"{'     3.00           C':<60}RINEX VERSION / TYPE\n{'':60}END OF HEADER\n"
    return head + "".join(
        f"AS {one}  {day} 06 {minute:02d}  0.000000  1   {1e-6:.12E}\n" for one in satellites for minute in (25, 30, 35)
    )


def test_clocks_of_another_day_or_of_few_satellites(tmp_path, shared_data):
    """Satellites that a clock file lacks keep the clocks of the orbit file."""
    sp3 = shared_data / "cssrlib_2021_265" / "orbit.sp3.gz"
    (tmp_path / "a.clk").write_text(clocks(["G05", "G13"], "2021 09 21"))
    with refused("raw.clock_day", RecordingError, "a.clk", "orbit.sp3.gz"):
        read_precise([sp3], [tmp_path / "a.clk"])
    (tmp_path / "a.clk").write_text(clocks(["G05", "G13"], "2021 09 22"))
    found, plain = read_precise([sp3], [tmp_path / "a.clk"]), read_precise([sp3], [])
    assert {one for one in plain.clock if len(found.clock[one][0]) != len(plain.clock[one][0])} == {5, 13}


def test_orbits_and_ephemerides_of_another_day_or_constellation(changed, shared_data, tmp_path):
    slac = next((shared_data / "raw_gnss_slac_20210428").glob("*SP3.gz"))
    shutil.copytree(DRIVE, tmp_path / "drive", dirs_exist_ok=True)
    shutil.copy(slac, tmp_path / "drive" / "orbit.sp3.gz")
    with refused("raw.ephemeris_day", RecordingError, "orbit.sp3.gz"):
        changed("recording.toml", lambda text: text.replace('nav = "nav.gz"', 'nav = "nav.gz"\nsp3 = "orbit.sp3.gz"'))

    def only(system: str) -> Change:
        return lambda text: (
            "".join(re.split(r"(END OF HEADER.*\n)", text)[:2])
            + "".join(re.findall(rf"^{system}\d\d .*\n(?:    .*\n)*", text, flags=re.MULTILINE))
        )

    one = changed("nav.gz", only("J"))
    assert {"raw.no_ephemeris", "raw.base"} <= keys(one)
    assert "raw_gnss.few_satellites" in {finding.key for finding in check_raw(raw_of(one))}
    with refused("raw.no_ephemerides", RecordingError, "nav.gz"):
        changed("nav.gz", only("C"))


@pytest.mark.parametrize("crx", [False, True])
@pytest.mark.parametrize("name", ["rover.obs.gz", "base.obs.gz", "nav.gz"])
def test_of_a_compressed_file_that_is_cut_off_all_before_that_is_used(
    tmp_path: Path, whole: RawGnss, name: str, crx: bool
) -> None:
    folder = tmp_path / "drive"
    shutil.copytree(DRIVE, folder)
    packed = (folder / name).read_bytes()
    if crx and name != "nav.gz":
        hatanaka = pytest.importorskip("hatanaka")
        packed = gzip.compress(hatanaka.rnx2crx(gzip.decompress(packed)))
    (folder / name).write_bytes(packed[: int(0.7 * len(packed))])
    found = read(folder)
    raw, ends = raw_of(found), [note for note in found.remarks if get_key(note) == "raw.cut"]
    assert len(ends) == 1
    assert name in ends[0]
    if name == "rover.obs.gz":
        n = int(np.searchsorted(raw.t, raw.t[-1] - 1e-3))  # of the last epoch some satellites are lost
        assert 0.5 < n / len(whole) < 0.8
        np.testing.assert_array_equal(raw.code[:n], whole.code[:n])
        np.testing.assert_array_equal(raw.carrier[:n], whole.carrier[:n])
    elif name == "base.obs.gz":
        there, before = (np.isfinite(one.carrier_difference).sum() for one in (raw, whole))
        assert 0.5 < there / before < 0.99
    else:
        placed = np.isfinite(raw.p[:, 0])
        assert 0.5 < placed.mean() < 1.0
    (folder / name).write_bytes(packed + b"rubbish")
    again = read(folder)
    assert len([note for note in again.remarks if get_key(note) == "raw.cut" and name in note]) == 1
    np.testing.assert_array_equal(raw_of(again).code, whole.code)
    (folder / name).write_bytes(packed[:40])  # nothing of it can be unpacked
    with refused("file.damaged", RecordingError):
        read(folder)
