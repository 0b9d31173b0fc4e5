"""Files of raw GNSS observations that nobody meant well: refused in one sentence with the line, soon, whole."""

from __future__ import annotations

import gzip
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_told, refused

sys.path.append(str(Path(__file__).resolve().parents[1] / "fuzz"))
import raw_cases

from graphnav.core.errors import RecordingError
from graphnav.gnss.columns import make_observations
from graphnav.gnss.precise import read_precise
from graphnav.gnss.rinex_nav import read_navigation
from graphnav.gnss.rinex_obs import read_observations
from graphnav.recording.formats import read


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return raw_cases.write_seeds(tmp_path_factory.mktemp("raw") / "seeds")


@pytest.fixture(autouse=True)
def _soon() -> Iterator[None]:
    """What would go on for ever fails instead."""
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(30)
    yield
    signal.alarm(0)


def edited(path: Path, out: Path, number: int, begin: int, new: str) -> Path:
    """A file in which some columns of a line (both from 0) are others."""
    lines = path.read_text().split("\n")
    line = lines[number].ljust(begin + len(new))
    lines[number] = line[:begin] + new + line[begin + len(new) :]
    out.write_text("\n".join(lines))
    return out


EPOCHS = {  # columns of the line of an epoch of version 2, and of version 3 from another column on
    "month 13": (3, " 13"), "month 0": (3, "  0"), "February 30": (3, "  2 30"), "day -9": (6, " -9"),
    "hour nan": (9, "nan"), "minute 99": (12, " 99"), "second inf": (15, "        inf"), "flag -1": (26, " -1"),
    "count -1": (29, " -1"), "event of count -1": (26, "  4 -1"), "count nan": (29, "nan"),
}  # fmt: skip


@pytest.mark.parametrize("case", EPOCHS)
@pytest.mark.parametrize("name", ["two.obs", "three.obs"])
def test_lines_of_epochs_that_are_none(seeds: Path, tmp_path: Path, name: str, case: str) -> None:
    """The last epoch but one, so that others before it are right."""
    lines = (seeds / name).read_text().split("\n")
    number = [k for k, line in enumerate(lines) if re.match(r"> \d{4} | \d\d ", line)][-2]
    begin, new = EPOCHS[case]
    path = edited(seeds / name, tmp_path / name, number, begin + 3 * (name == "three.obs"), new)
    with refused("rinex.epoch", RecordingError, f"{name}, line {number + 1}"):
        read_observations(path)


@pytest.mark.parametrize("field", ["nan", "inf", "1_0", "1e5000", "\xb2"])
def test_fields_that_are_no_numbers(seeds: Path, tmp_path: Path, field: str) -> None:
    for name, number, begin in (("two.obs", 4, 0), ("three.obs", 21, 3)):
        path = edited(seeds / name, tmp_path / name, number, begin, field.rjust(14))
        with refused("table.cell", RecordingError, f"line {number + 1}, C1"):
            read_observations(path)


@pytest.mark.parametrize("shift", [-3, -2, -1, 1, 2, 3])
def test_a_line_that_lost_characters_is_not_read_in_parts(seeds: Path, tmp_path: Path, shift: int) -> None:
    lines = (seeds / "three.obs").read_text().split("\n")
    lines[22] = lines[22][:3] + (lines[22][3 - shift :] if shift < 0 else "0" * shift + lines[22][3:])
    (tmp_path / "a.obs").write_text("\n".join(lines))
    with refused("table.cell", RecordingError, "line 23, C1C"):
        read_observations(tmp_path / "a.obs")


def test_an_epoch_without_satellites_is_passed_over(seeds: Path, tmp_path: Path) -> None:
    lines = (seeds / "two.obs").read_text().split("\n")
    (tmp_path / "a.obs").write_text("\n".join([*lines[:3], lines[3][:29] + "  0", *lines[3:]]))
    assert len(read_observations(tmp_path / "a.obs")) == len(read_observations(seeds / "two.obs"))


@pytest.mark.parametrize("name", ["G-1", "G00", "G1e", "G.5", "G_1", "G 0"])
def test_names_that_no_satellite_has(seeds: Path, tmp_path: Path, name: str) -> None:
    for file, number, begin in (("two.obs", 3, 32), ("three.obs", 20, 0)):
        path = edited(seeds / file, tmp_path / file, number, begin, name)
        with refused("rinex.satellite", RecordingError, f"line {number + 1}: '{name}'"):
            read_observations(path)


def test_headers_that_begin_in_the_middle_or_never_end(seeds: Path, tmp_path: Path) -> None:
    text, path = (seeds / "three.obs").read_text(), tmp_path / "a.obs"
    path.write_text(text.replace("G    4 C1C", "     4 C1C", 1))
    assert not np.any(read_observations(path).satellite < 100)  # types of no system are of none
    more = f"{'      ' + ' C1C' * 13:<60}SYS / # / OBS TYPES\n"
    path.write_text(text.replace("J    4 C1C", more * 20 + "J    4 C1C", 1))
    with refused("rinex.types", RecordingError):
        read_observations(path)


def test_codes_that_nothing_can_have_measured_are_left_out(seeds: Path, tmp_path: Path) -> None:
    whole = read_observations(seeds / "three.obs")
    path = edited(seeds / "three.obs", tmp_path / "a.obs", 21, 3, "9999999999.999")
    found = read_observations(path)
    assert np.count_nonzero(np.isfinite(found.code)) == np.count_nonzero(np.isfinite(whole.code)) - 1
    assert_told(found.remarks, "raw.impossible")


NAVIGATION = {
    "month": (0, 8, " 13"), "second": (0, 20, "inf"), "clock": (0, 23, "inf".rjust(19)),
    "ellipse": (2, 23, "1".rjust(19)), "axis": (2, 61, "1D9".rjust(19)), "below ground": (2, 61, "2000.".rjust(19)),
    "week": (5, 42, "1e300".rjust(19)),
}  # fmt: skip


@pytest.mark.parametrize("case", NAVIGATION)
def test_ephemerides_that_cannot_be_are_left_out_and_told(seeds: Path, tmp_path: Path, case: str) -> None:
    first = next(k for k, line in enumerate((seeds / "a.nav").read_text().split("\n")) if line.startswith("G"))
    whole, (row, begin, new) = read_navigation([seeds / "a.nav"]), NAVIGATION[case]
    found = read_navigation([edited(seeds / "a.nav", tmp_path / "a.nav", first + row, begin, new)])
    assert len(found.kepler["toe"]) == len(whole.kepler["toe"]) - 1
    assert_told(found.remarks, "raw.broken_records", f"line {first + 1}")


@pytest.mark.parametrize(("begin", "new"), [(3, "9e99"), (3, " nan"), (7, " 13"), (7, " 2 30")])
def test_dates_of_orbits_that_are_none(seeds: Path, tmp_path: Path, begin: int, new: str) -> None:
    number = [k for k, line in enumerate((seeds / "a.sp3").read_text().split("\n")) if line.startswith("*")][3]
    with refused("table.date", RecordingError, f"a.sp3, line {number + 1}"):
        read_precise([edited(seeds / "a.sp3", tmp_path / "a.sp3", number, begin, new)], [])


def test_clocks_that_are_none(seeds: Path, tmp_path: Path) -> None:
    text = (seeds / "a.clk").read_text()
    for old, new in (("2020 11", "2020 13"), ("2020 11", " inf 11"), ("  1 ", "  1 inf"), ("AS G", "AS G_")):
        (tmp_path / "a.clk").write_text(text.replace(old, new, 1))
        with refused("table.cell", RecordingError, "a.clk"):
            read_precise([seeds / "a.sp3"], [tmp_path / "a.clk"])
    (tmp_path / "a.clk").write_text(text.replace("AS G05", "AS L05"))  # of a satellite that itself is a receiver
    assert 5 in read_precise([seeds / "a.sp3"], []).clock
    assert {one // 100 for one in read_precise([seeds / "a.sp3"], [tmp_path / "a.clk"]).clock} == {0}


def test_orbits_without_clocks_or_in_another_unit_are_told(seeds: Path, tmp_path: Path) -> None:
    text, clocks = (seeds / "a.sp3").read_text(), (seeds / "a.clk").read_text()
    position = re.compile(r"^(P...)(.{42})(.{14})", flags=re.MULTILINE)
    for by, what in (
        (lambda m: m[1] + m[2] + " 999999.999999", "clk"),
        (lambda m: m[1] + "".join(f"{1e-3 * float(m[2][k : k + 14]):14.6f}" for k in (0, 14, 28)) + m[3], "km"),
    ):
        (tmp_path / "a.sp3").write_text(position.sub(by, text))
        with refused("raw.no_clocks" if what == "clk" else "raw.no_positions", RecordingError, "a.sp3", what):
            read_precise([tmp_path / "a.sp3"], [])
    (tmp_path / "a.clk").write_text(re.sub(r"(\d)[eE]([+-]\d\d)$", r"\1E+03", clocks, flags=re.MULTILINE))
    with refused("raw.no_clocks", RecordingError, "a.clk"):
        read_precise([seeds / "a.sp3"], [tmp_path / "a.clk"])


def test_a_record_that_lost_a_line_is_counted_once(seeds: Path, tmp_path: Path) -> None:
    lines = (seeds / "a.nav").read_text().split("\n")
    first = next(k for k, line in enumerate(lines) if line.startswith("G"))
    (tmp_path / "a.nav").write_text("\n".join([*lines[: first + 2], *lines[first + 3 :]]))
    found = read_navigation([tmp_path / "a.nav"])
    assert len(found.kepler["toe"]) == len(read_navigation([seeds / "a.nav"]).kepler["toe"]) - 1
    assert_told(found.remarks, "raw.broken_records", "1 unreadable", f"line {first + 1}")


def test_satellites_of_a_table_have_whole_numbers() -> None:
    prn = np.array([5.0, 5.5, -1.0, 0.0, 1e9, np.nan, 32.0])
    found = make_observations({"t": np.arange(7.0), "prn": prn, "code": np.full(7, 2e7)}, 0.0, "a.csv")
    assert found.satellite.tolist() == [5, 32]
    assert_told(found.remarks, "raw.rows_left_out", "a.csv", "5")


# ------------------------------------------------------------------------------------------- limits and paths
DESCRIPTION = """format = "graphnav-recording/1"
platform = "vehicle"
clock = "gps week 2130"
[imu]
file = "imu.csv"
axes = "RFU"
[raw_gnss]
"""


def test_a_recording_reads_raw_files_below_its_own_folder(seeds: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.obs"
    secret.write_text("a secret of somebody else\n")
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "imu.csv").write_text(
        "t,gx,gy,gz,ax,ay,az\n" + "".join(f"{0.01 * k:.2f},0,0,0,0,0,9.8\n" for k in range(9))
    )
    for key in ("rover", "nav", "sp3", "base"):
        for name in ("../secret.obs", str(secret), "link.obs"):
            (tmp_path / "drive" / "link.obs").unlink(missing_ok=True)
            (tmp_path / "drive" / "link.obs").symlink_to(secret)
            names = "".join(f'{k} = "{x}"\n' for k, x in ({"rover": "own.obs"} | {key: name}).items())
            (tmp_path / "drive" / "recording.toml").write_text(DESCRIPTION + names)
            with refused("file.outside", RecordingError) as caught:
                read(tmp_path / "drive")
            assert "a secret" not in str(caught.value)


def test_raw_files_are_read_within_limits(seeds: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.obs"
    path.write_bytes(gzip.compress((seeds / "three.obs").read_bytes() + bytes(1 << 25), 9))
    with refused("file.unpacks", RecordingError):
        read_observations(path)
    path.unlink()
    os.mkfifo(path)
    for use in (read_observations, lambda p: read_navigation([p]), lambda p: read_precise([p], [])):
        with refused("file.pipe", RecordingError):
            use(path)
