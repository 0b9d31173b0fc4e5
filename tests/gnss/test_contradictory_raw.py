"""Raw observations that contradict their own header, each other or the IMU: told by a key, and what is good is used."""

from __future__ import annotations

import gzip
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_told, refused
from ubx_frames import frame, rawx

from graphnav.config import Settings
from graphnav.core import earth
from graphnav.core.errors import ConfigError, RecordingError
from graphnav.core.notes import get_key
from graphnav.estimation.pipeline import run
from graphnav.gnss.load import read_rover
from graphnav.gnss.rinex_obs import parse_observations
from graphnav.gnss.series import RawGnss, join_files
from graphnav.gnss.signals import SYSTEMS, number_satellite
from graphnav.recording import Recording
from graphnav.recording.checks.overview import inspect
from graphnav.recording.formats import read

DRIVE = Path(__file__).resolve().parents[2] / "data" / "kamakura_rtk"
Change = Callable[[str], str]
TYPES = "E   12 C1C L1C S1C C5Q L5Q S5Q C7Q L7Q S7Q C8Q L8Q S8Q      SYS / # / OBS TYPES "
BASE = ("-3959400.631", "3385704.533", "3667523.111")  # m, its antenna's place


@pytest.fixture(scope="module")
def observed() -> str:
    return gzip.decompress((DRIVE / "rover.obs.gz").read_bytes()).decode()


@pytest.fixture
def changed(tmp_path: Path) -> Callable[..., Recording]:
    """Reads the drive with the texts of some files changed."""

    def read_with(**changes: Change) -> Recording:
        folder = tmp_path / "drive"
        shutil.copytree(DRIVE, folder, dirs_exist_ok=True)
        for name, change in changes.items():
            path = folder / (f"{name}.toml" if name == "recording" else f"{name}.obs.gz")
            packed = path.suffix == ".gz"
            text = gzip.decompress(path.read_bytes()).decode() if packed else path.read_text()
            new = change(text)
            assert new != text
            path.write_bytes(gzip.compress(new.encode())) if packed else path.write_text(new)
        return read(folder)

    return read_with


def raw_of(recording: Recording) -> RawGnss:
    assert recording.raw_gnss is not None
    return recording.raw_gnss


def parsed(text: str):
    return parse_observations(text.encode(), Path("drive.obs"))


def in_epochs(text: str, pattern: str, by: str | Callable[[re.Match[str]], str]) -> str:
    """Replace a pattern in what follows the header."""
    head, label, body = text.partition("END OF HEADER")
    return head + label + re.sub(pattern, by, body, flags=re.MULTILINE)


# ------------------------------------------------------------------------------------------- by the header
def test_types_that_change_in_an_event_or_a_second_header_are_told_with_their_line(observed):
    head, epochs = observed.split("> ", 1)[0], re.split(r"^(?=> )", observed, flags=re.MULTILINE)[1:]
    other = TYPES.replace("C1C L1C S1C C5Q L5Q S5Q", "C5Q L5Q S5Q C1C L1C S1C")
    event = f"> 2021 09 22 06 31 05.0000000  4  1\n{other}\n"
    for more in (event, head.replace(TYPES, other)):
        line = (head + "".join(epochs[:15]) + more[: more.index(other)]).count("\n") + 1
        with refused("rinex.types_change", RecordingError, f"line {line}"):
            parsed(head + "".join(epochs[:15]) + more + "".join(epochs[15:]))
    again = parsed(head + "".join(epochs[:15]) + head + "".join(epochs[15:]))  # files of one receiver, appended
    np.testing.assert_array_equal(again.code, parsed(observed).code)


def test_types_of_a_version_2_file_that_change_are_told(observed):
    lines = [f"{'     2.11           OBSERVATION DATA    G (GPS)':<60}RINEX VERSION / TYPE",
             f"{'     2    C1    L1':<60}# / TYPES OF OBSERV", f"{'':<60}END OF HEADER",
             " 20 11  5  5 14 42.0000000  0  1G05", "  21000000.125   110000000.250",
             " 20 11  5  5 14 43.0000000  4  1", f"{'     2    L1    C1':<60}# / TYPES OF OBSERV",
             " 20 11  5  5 14 43.0000000  0  1G05", " 110000000.250    21000000.125"]  # fmt: skip
    with refused("rinex.types_change", RecordingError, "line 7"):
        parsed("\n".join(lines) + "\n")
    assert len(parsed("\n".join(lines[:5]) + "\n")) == 1


def test_a_header_that_lost_types_is_refused(observed):
    for old, new in ((" S5Q                                                  SYS / # / OBS TYPES ", None),
                     ("E   12 C1C L1C S1C C5Q", "E   12 C1C L1C     C5Q")):  # fmt: skip
        text = observed.replace(f"      {old}\n", "") if new is None else observed.replace(old, new)
        with refused("rinex.types", RecordingError, "1"):
            parsed(text)


def test_observations_of_a_system_that_the_header_lacks_are_told(observed):
    found = parsed(observed.replace(TYPES, TYPES.replace("SYS", "COM")))
    assert_told(found.remarks, "raw.no_types", "drive.obs", " E ")
    others = parsed(observed)
    np.testing.assert_array_equal(found.code, others.code[others.satellite // 100 != SYSTEMS.index("E")])


def test_observations_that_are_multiplied_are_refused(observed):
    scaled = f"{'G   10  2 L1C L2W':<60}SYS / SCALE FACTOR\n"
    with refused("rinex.scale", RecordingError, "line 2", "10"):
        parsed(observed.replace("\n", "\n" + scaled, 1))
    assert len(parsed(observed.replace("\n", "\n" + scaled.replace("  10", "   1"), 1))) == len(parsed(observed))


def test_an_antenna_is_as_far_from_its_mark_as_the_header_says(changed):
    """1.5 m above the mark, 0.2 m east, 0.1 m north of it: the position of the base is its antenna's."""
    antenna = np.array(BASE, dtype=float)
    axes = earth.enu_axes(earth.ecef_to_llh(antenna))
    mark = antenna - np.array([0.2, 0.1, 1.5]) @ axes

    def write_mark(text: str) -> str:
        text = re.sub(r".{60}APPROX", f"{''.join(f'{x:14.4f}' for x in mark):<60}APPROX", text, count=1)
        return re.sub(
            r".{60}ANTENNA: D", f"{''.join(f'{x:14.4f}' for x in (1.5, 0.2, 0.1)):<60}ANTENNA: D", text, count=1
        )

    found = raw_of(changed(base=write_mark, recording=lambda text: re.sub(r"base_position.*\n", "", text)))
    stated = raw_of(read(DRIVE))
    np.testing.assert_allclose(found.carrier_difference, stated.carrier_difference, atol=2e-4)


def test_a_header_may_leave_the_antennas_offset_blank(observed):
    blank = re.sub(r".{60}ANTENNA: D", f"{'':60}ANTENNA: D", observed, count=1)
    np.testing.assert_array_equal(parsed(blank).marker, parsed(observed).marker)


def test_a_base_position_that_is_no_place_on_the_ground_is_told(changed):
    with refused("raw.base_position", RecordingError, "base.obs.gz", "0 km"):
        changed(recording=lambda text: text.replace("[" + ", ".join(BASE) + "]", "[35.3, 139.5, 60.0]"))


# ------------------------------------------------------------------------------------------- by each other
def test_a_satellite_twice_in_an_epoch_with_other_values_is_left_out(observed):
    found, whole = parsed(in_epochs(observed, "^G13", "G15")), parsed(observed)
    assert_told(found.remarks, "raw.twice_unlike")
    g13, g15 = number_satellite("G13"), number_satellite("G15")
    both = np.isin(whole.satellite, (g13, g15))
    twice = {(t, s) for t, s in zip(whole.t[both], whole.signal[both], strict=True)
             if np.sum((whole.t == t) & (whole.signal == s) & both) == 2}  # fmt: skip
    left = {(t, s) for t, s in zip(found.t[found.satellite == g15], found.signal[found.satellite == g15], strict=True)}
    assert twice
    assert not twice & left
    assert (found.satellite // 100 == 2).sum() == (whole.satellite // 100 == 2).sum()


def test_files_of_two_receivers_are_no_rover(observed):
    obs = [read_rover((DRIVE / name,))[0] for name in ("rover.obs.gz", "base.obs.gz")]
    with refused("raw.two_receivers", RecordingError, "rover.obs.gz", "base.obs.gz"):
        join_files(obs)
    assert len(join_files([obs[0], obs[0]])) == len(obs[0])


def test_carriers_of_another_sign_or_unit_are_left_out_and_codes_are_used(changed):
    whole = raw_of(read(DRIVE))
    for by in (lambda m: f"{-float(m[1]):14.3f}{m[2]}", lambda m: f"{0.19 * float(m[1]):14.3f}{m[2]}"):
        recording = changed(rover=lambda text, by=by: in_epochs(text, r"(?<=^.{19})(.{10}\.\d{3})(0\d)", by))
        assert_told(recording.remarks, "raw.unlike_codes", "rover.obs.gz", "GPS 1C", "Galileo 1C")
        raw = raw_of(recording)
        first = np.isin(raw.signal, whole.signal[whole.signal // 100 == 1])
        assert not np.isfinite(raw.carrier[first & np.isin(raw.satellite // 100, (0, 2))]).any()
        np.testing.assert_array_equal(np.isfinite(raw.carrier[~first]), np.isfinite(whole.carrier[~first]))
        np.testing.assert_array_equal(raw.code, whole.code)


def test_doppler_shifts_of_another_sign_are_left_out(tmp_path):
    shutil.copytree(DRIVE.parent / "tokyo_raw", tmp_path, dirs_exist_ok=True)
    path = tmp_path / "rover.csv.gz"
    names, *rows = gzip.decompress(path.read_bytes()).decode().splitlines()
    k, cells = names.split(",").index("doppler_range_rate_mps"), [row.split(",") for row in rows]
    turned = [",".join([*c[:k], str(-float(c[k])) if c[k] else "", *c[k + 1 :]]) for c in cells]
    path.write_bytes(gzip.compress("\n".join([names, *turned, ""]).encode()))
    recording = read(tmp_path)
    assert_told(recording.remarks, "raw.unlike_codes", "rover.csv.gz", "-1.00")
    assert not np.isfinite(raw_of(recording).range_rate).any()
    assert "raw.unlike_codes" not in {get_key(note) for note in read(DRIVE.parent / "tokyo_raw").remarks}


def test_strengths_in_nine_classes_mask_nothing(changed):
    def classify(text: str) -> str:
        return in_epochs(text, r"(?<=\s)(\d\d)\.(\d{3})(?=\s)", lambda m: f" {int(m[1]) // 6}.000")

    recording = changed(rover=classify)
    assert_told(recording.remarks, "raw.strength_unit", "rover.obs.gz", "9")
    assert not np.isfinite(raw_of(recording).cn0).any()
    done = run(recording, Settings(noise={"mode": "stated"}), solvers=("rts",))["rts"]
    assert done.records["gnss_code"].t.size > 400
    assert np.mean(done.fixed[:, 1] > 0.0) > 0.9


def test_a_code_a_kilometre_off_leaves_the_integers(changed):
    """The others tell that it is: its arcs begin where the other satellites put them."""

    def shift(text: str) -> str:
        return in_epochs(text, r"^(G15  )(\d{8})", lambda m: m[1] + str(int(m[2]) + 1000))

    done = run(changed(rover=shift), solvers=("rts",))["rts"]
    assert np.mean(done.fixed[:, 1] > 0.0) > 0.9


def test_messages_without_measurements_are_no_missing_messages(tmp_path):
    def cut(announced: int) -> bytes:
        payload = bytearray(rawx(300.0)[6:-2])
        payload[11] = announced
        return frame((0x02, 0x15), bytes(payload))

    for announced, key, said in ((0, "raw.no_measurements", "RXM-RAWX"), (200, "raw.no_messages", "1 broken")):
        (tmp_path / "a.ubx").write_bytes(cut(announced))
        with refused(key, RecordingError, "a.ubx", said):
            read_rover((tmp_path / "a.ubx",))


def test_measurements_of_satellites_that_there_are_not_are_left_out(tmp_path):
    for row, gnss, sv in ((0, 0, 207), (0, 1, 5), (2, 2, 200)):
        payload = bytearray(rawx(300.0)[6:-2])
        payload[16 + 32 * row + 20 : 16 + 32 * row + 22] = bytes((gnss, sv))
        (tmp_path / "a.ubx").write_bytes(
            b"".join([frame((0x02, 0x15), bytes(payload))] + [rawx(301.0 + k) for k in range(3)])
        )
        obs = read_rover((tmp_path / "a.ubx",))[0]
        assert_told(obs.remarks, "raw.unknown_signals", "a.ubx")
        assert set(obs.satellite.tolist()) == {number_satellite(x) for x in ("G07", "E11", "C23", "J02", "R05")}


# ------------------------------------------------------------------------------------------- by the IMU, and the masks
def test_a_clock_that_is_seconds_off_is_no_sign_of_a_latitude(changed):
    """Of a drive too short to find the 18 leap seconds in, half of which is common to both."""
    recording = changed(recording=lambda text: text.replace('nav = "nav.gz"', 'nav = "nav.gz"\ntime_offset = 18.0'))
    severities = {f.key: f.severity for f in inspect(recording).findings}
    assert severities.get("raw_gnss.clock") == "refused"
    assert "gnss.mirrored" not in severities


@pytest.mark.parametrize(("key", "value"), [("cn0", 90.0), ("elevation", 89.0)])
def test_masks_that_leave_nothing_are_refused(key, value):
    with refused("raw_gnss.masks", ConfigError, key, f"{value:g}"):
        run(read(DRIVE), Settings(raw_gnss={key: value}), solvers=("ekf",))
