"""Observations of a rover and a base with a mistake in them: told by a key, and nothing that is good is lost."""

from __future__ import annotations

import gzip
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import refused

from graphnav.config import Settings
from graphnav.constraints.raw_gnss import GnssCode
from graphnav.core.errors import RecordingError
from graphnav.core.notes import get_key
from graphnav.estimation.pipeline import run
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.series import RawGnss
from graphnav.gnss.signals import number_satellite, number_signal
from graphnav.recording import Recording
from graphnav.recording.checks.aiding import describe_gnss_apart
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


def test_a_base_that_ends_early_leaves_the_rovers_own_observations(changed, whole):
    one = raw_of(changed("base.obs.gz", lambda text: "".join([blocks(text)[0], *blocks(text)[1][:20]])))
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
