"""Types of fixes: every reader fills them by its own numbers, and what cuts or writes a recording keeps them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import logs
import numpy as np
import pytest
from helpers import refused, same_recording
from test_bad_input import write_small
from test_draft import DRIVE, drafted, write_logs
from test_formats_binary import nav_pvt, write_bag

from graphnav.app import convert
from graphnav.core.errors import RecordingError
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.recording import Recording
from graphnav.recording.checks.overview import inspect
from graphnav.recording.formats import load, read
from graphnav.recording.formats.writing import round_recording, write_folder

RECORDING, _ = logs.simulated()


def typed(folder: Path, cells: str = "1 2  4 5", unit: str = "", column: str = "type") -> Path:
    """A recording of five fixes with these types, which are kept apart by spaces."""
    write_small(folder)
    head, *rows = (folder / "gnss.csv").read_text().splitlines()
    cells = [f"{row},{cell}" for row, cell in zip(rows, cells.split(" "), strict=True)]
    (folder / "gnss.csv").write_text("\n".join([f"{head},{column}", *cells]) + "\n")
    toml = (folder / "recording.toml").read_text()
    renamed = "" if column == "type" else f'columns = {{ type = "{column}" }}\n'
    (folder / "recording.toml").write_text(toml.replace("[gnss]\n", f"[gnss]\n{renamed}{unit}"))
    return folder


def test_a_column_of_types_is_read_and_blanks_are_unknown(tmp_path):
    assert read(write_small(tmp_path)).gnss.type is None
    gnss = read(typed(tmp_path)).gnss
    assert gnss.type.tolist() == [1, 2, 0, 4, 5]
    assert gnss.types == {"unknown": 1, "fixed": 1, "float": 1, "differential": 1, "single": 1}
    assert read(typed(tmp_path, column="q")).gnss.type.tolist() == [1, 2, 0, 4, 5]
    assert read(typed(tmp_path, "    ")).gnss.type is None  # blank throughout


def test_qualities_of_gga_are_turned_into_types(tmp_path):
    gnss = read(typed(tmp_path, "4 5 1 2 9", 'units = { type = "nmea" }\n')).gnss
    assert gnss.type.tolist() == [1, 2, 5, 4, 3]


@pytest.mark.parametrize(
    ("cells", "unit", "key", "names"),
    [
        ("1 1 7 1 1", "", "gnss.type", ("gnss.csv, line 4", "'type'", "1 fixed, 2 float, 3 sbas, 4 diff")),
        ("1 1.5 1 1 1", "", "gnss.type", ("line 3", "'type'", "1.5")),
        ("1 1 1 fix 1", "", "table.cell", ("line 5", "'type'", "'fix'")),
        ("4 6 4 4 4", 'units = { type = "nmea" }\n', "gnss.type", ("line 3", "'type'", "1 single, 2 diff")),
        ("4 5 4 4 4", 'units = { type = "gga" }\n', "key.value", ("'gnss.units.type'",)),
    ],
)
def test_what_is_no_type_is_one_plain_line(tmp_path, cells, unit, key, names):
    with refused(key, RecordingError, *names):
        read(typed(tmp_path, cells, unit))


def with_types(recording: Recording) -> Recording:
    """The recording with types that change from fix to fix."""
    n = len(recording.gnss.t)
    return replace(recording, gnss=replace(recording.gnss, type=np.arange(n) % 7))


def test_types_go_with_their_fixes(tmp_path):
    recording = with_types(RECORDING)
    gnss, t = recording.gnss, recording.gnss.t - recording.start
    assert recording.crop(5.0, 20.0).gnss.type.tolist() == gnss.type[(t >= 5.0) & (t <= 20.0)].tolist()
    assert recording.without("gnss", (5.0, 20.0)).gnss.type.tolist() == gnss.type[(t < 5.0) | (t > 20.0)].tolist()
    assert pick_fixes(gnss, np.array([3, 1])).type.tolist() == [3, 1]
    assert np.array_equal(round_recording(recording).gnss.type, gnss.type)
    write_folder(replace(recording, truth=None), tmp_path / "a")
    _, files = convert.convert_log(str(tmp_path / "a"), tmp_path / "b", None)
    found = read(files[0])
    assert np.array_equal(found.gnss.type, gnss.type)
    same_recording(found, read(tmp_path / "a"))


def test_nmea_qualities(tmp_path):
    path = logs.write_nmea(tmp_path / "a.nmea", RECORDING)
    assert set(load(path).gnss.types) == {"fixed"}
    kinds = ["1", "2", "5", "9", "6", "3"]
    lines = path.read_text().splitlines(True)
    gga = [k for k, line in enumerate(lines) if "GGA" in line]
    for k, quality in zip(gga, kinds, strict=False):
        lines[k] = logs.sentence(lines[k][1:].split("*")[0].replace(",4,12,", f",{quality},12,"))
    path.write_text("".join(lines))
    gnss = load(path).gnss
    assert gnss.type[:6].tolist() == [5, 4, 2, 3, 0, 1]  # 6 is no fix, 3 of no known type
    assert gnss.sd[:3, 0] == pytest.approx(RECORDING.gnss.sd[:3, 0])


def test_rtklib_qualities(tmp_path):
    path = logs.write_rtklib(tmp_path / "a.pos", RECORDING)
    lines = path.read_text().splitlines(True)
    for k, q in zip(range(3, 8), "25467", strict=True):
        lines[k] = lines[k].replace("   1  20 ", f"   {q}  20 ")
    path.write_text("".join(lines))
    gnss = load(path).gnss
    assert gnss.type[:6].tolist() == [2, 5, 4, 6, 0, 1]
    assert gnss.types["fixed"] == len(gnss.t) - 5


def test_ubx_flags(tmp_path):
    path, gnss = tmp_path / "a.ubx", RECORDING.gnss
    # gnssFixOk, diffSoln, carrSoln of the flags; 4: with dead reckoning
    flags = [(3, 1), (3, 3), (3, 1 | 1 << 6), (3, 3 | 2 << 6), (4, 3), (4, 1 | 2 << 6)]
    path.write_bytes(b"".join(nav_pvt(gnss.t[k], gnss.llh[k], gnss.v[k], fix, ok) for k, (fix, ok) in enumerate(flags)))
    assert load(path).gnss.type.tolist() == [5, 4, 2, 1, 0, 1]


def test_ros_status_of_a_base_is_differential(tmp_path):
    gnss = read(write_bag(tmp_path / "a.bag", "bag")).gnss
    assert set(gnss.types) == {"differential"}


def test_info_counts_them():
    recording = with_types(RECORDING)
    inspection = inspect(recording)
    assert inspection.to_dict()["gnss"]["types"] == recording.gnss.types
    assert sum(recording.gnss.types.values()) == len(recording.gnss.t)
    assert re.search(rf"\bfixed {recording.gnss.types['fixed']}\b", inspection.format())
    assert "types" not in inspect(RECORDING).facts["gnss"]


@pytest.mark.parametrize(
    ("name", "numbers", "unit"),
    [
        ("Q", (1, 2, 5), 'type = "Q"'),
        ("fixType", (1, 2, 5), 'type = "fixType"'),
        ("gps_qual", (4, 5, 1), 'units = { type = "nmea" }'),
        ("fixType", (3, 4, 5), None),  # whose, nobody can say
    ],
)
def test_a_draft_names_a_column_whose_meaning_is_plain(tmp_path, name, numbers, unit):
    paths = write_logs(tmp_path)
    head, *rows = paths[1].read_text().splitlines()
    kind = np.arange(len(rows)) * 3 // len(rows)
    sd = np.array([0.01, 0.3, 2.0])[kind]
    said = np.array(numbers)[kind]
    rows = [f"{row.rpartition(',')[0]},{s},{k}" for row, s, k in zip(rows, sd, said, strict=True)]
    paths[1].write_text("\n".join([f"{head},{name}", *rows]) + "\n")
    found, recording = drafted(tmp_path, paths)
    if unit is None:
        assert recording.gnss.type is None
        assert any(f"'{name}'" in decision for decision in found.decisions)
    else:
        assert unit in found.text
        assert np.array_equal(recording.gnss.type, np.array([1, 2, 5])[kind])
    assert len(recording.gnss.t) == len(DRIVE.gnss.t)
