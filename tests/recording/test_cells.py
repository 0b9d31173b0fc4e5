"""Cells that hold numbers otherwise, and what must be refused: in a draft as in a recording."""

from __future__ import annotations

from pathlib import Path

import logs
import numpy as np
import pytest
from helpers import refuse_command, refused

from graphnav.core.complaints import read_toml
from graphnav.core.errors import ConfigError, RecordingError
from graphnav.recording.draft import draft
from graphnav.recording.draft.cells import take_units_off
from graphnav.recording.draft.plain import read_plain
from graphnav.recording.formats.table import read_table

RECORDING, _ = logs.simulated(40.0)


def put(folder: Path, change: dict[tuple[int, int], str] | None = None) -> Path:
    """An IMU's and a receiver's table, cells (row, column) of the latter changed."""
    imu, gnss = RECORDING.imu, RECORDING.gnss
    rows = np.column_stack([imu.t, imu.gyro, imu.accel])
    (folder / "imu.csv").write_text(
        "t,gx,gy,gz,ax,ay,az\n" + "".join(",".join(f"{x:.9g}" for x in row) + "\n" for row in rows)
    )
    fixes = np.column_stack([gnss.t, np.degrees(gnss.llh[:, :2]), gnss.llh[:, 2], gnss.v])
    cells = [[f"{x:.12g}" for x in row] for row in fixes]
    for (row, column), text in (change or {}).items():
        cells[row][column] = text
    (folder / "gnss.csv").write_text("t,lat,lon,h,ve,vn,vu\n" + "".join(",".join(row) + "\n" for row in cells))
    return folder


def test_units_behind_numbers_go_into_the_names():
    cells = {
        "h": ["123.4 M", "", "-5 M"],
        "w": ["1 m", "2 km", "3 m"],
        "n": ["12S", "13S", "14S"],
        "t": ["1", "2", "3"],
    }
    out, notes = take_units_off(cells)
    assert out == {"h [M]": ["123.4", "", "-5"], "w": cells["w"], "n": cells["n"], "t": cells["t"]}
    assert len(notes) == 1


def test_heights_with_their_unit_are_read_and_a_recording_says_what_to_do(tmp_path):
    gnss = RECORDING.gnss
    put(tmp_path, {(k, 3): f"{gnss.llh[k, 2]:.3f} M" for k in range(len(gnss.t))})
    made = draft([tmp_path], tmp_path).made
    heights = next(iter(made.values()))["h [M]"]
    assert np.abs(heights - gnss.llh[:, 2]).max() < 6e-4
    with refused("table.cell", RecordingError, "line 2", "'h'", "units"):
        read_table(tmp_path / "gnss.csv", ("t", "h"))


@pytest.mark.parametrize("cell", ["1.#IND", "-1.#IND", "1.#QNAN", "-nan(ind)", "#N/A"])
def test_the_nan_of_windows_is_blank(tmp_path, cell):
    put(tmp_path, {(5, 4): cell})
    table = read_table(tmp_path / "gnss.csv", ("t", "ve", "vn"))
    assert np.flatnonzero(np.isnan(table["ve"])).tolist() == [5]
    assert not np.isnan(table["vn"]).any()


def test_an_infinite_velocity_is_refused_by_a_draft_as_by_a_recording(tmp_path, capsys):
    put(tmp_path, {(5, 4): "inf"})
    out = tmp_path / "out.toml"
    tables = '[imu]\nfile = "imu.csv"\n[gnss]\nfile = "gnss.csv"\n'
    (tmp_path / "recording.toml").write_text(f'format = "graphnav-recording/1"\nplatform = "vehicle"\n{tables}')
    for arguments in (("init", tmp_path, "-o", out), ("info", tmp_path)):
        assert "line 7, column 've'" in refuse_command(capsys, "table.not_finite", *arguments)
    assert not out.exists()


def test_a_leap_second_is_a_time(tmp_path):
    text = "t,lat,lon,h\n" + "".join(
        f"{stamp},45,10,100\n" for stamp in ("2016-12-31T23:59:59Z", "2016-12-31T23:59:60.5Z", "2017-01-01T00:00:01Z")
    )
    (tmp_path / "gps.csv").write_text(text)
    plain = read_plain(tmp_path / "gps.csv")
    assert np.array_equal(plain.columns["t"] - 1483228800.0, [-1.0, 0.5, 1.0])


def test_a_name_in_other_letters_and_a_header_in_another_order_are_told(tmp_path):
    put(tmp_path)
    (tmp_path / "gnss.csv").rename(tmp_path / "GNSS.CSV")
    with refused("file.missing", RecordingError, "there is GNSS.CSV"):
        read_table(tmp_path / "gnss.csv", ("t",))
    text = (tmp_path / "GNSS.CSV").read_text()
    (tmp_path / "two.csv").write_text(text + "t,lat,lon,h,vn,ve,vu\n" + text.partition("\n")[2])
    with refused("table.cell", RecordingError, "another order"):
        read_table(tmp_path / "two.csv", ("t", "ve"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[imu]\nx = 1\n[imu]\ny = 1\n", "line 3, column 5: not valid TOML: [imu] is there twice"),
        ("[imu.noise]\nx = 1\n[imu.noise]\ny = 1\n", "[imu.noise] is there twice"),
        ("x = 1\nx = 2\n", "the key is there twice"),
        ('file = "data\\imu.csv"\n', "write / in paths"),
    ],
)
def test_what_is_wrong_in_a_toml_is_said_plainly(tmp_path, text, said):
    (tmp_path / "x.toml").write_text(text)
    with refused("toml.syntax", ConfigError, said):
        read_toml(tmp_path / "x.toml", ConfigError)


def test_a_key_of_a_recording_among_settings_is_told(tmp_path, capsys):
    (tmp_path / "s.toml").write_text("[gnss]\nlever_arm = [0, 0, 1]\n")
    assert "recording.toml" in refuse_command(capsys, "key.unknown", "settings", "--config", tmp_path / "s.toml")
