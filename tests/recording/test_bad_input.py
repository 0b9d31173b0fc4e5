"""Broken recordings: every one gets a single plain line that says where, what and, where it can, how to mend it."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_told, refused

from graphnav.core.errors import RecordingError
from graphnav.recording.formats import read

TOML = """\
format = "graphnav-recording/1"
name = "small"
platform = "vehicle"

[imu]
file = "imu.csv"
axes = "RFU"

[imu.noise]
gyro_noise_density = 1e-4
accel_noise_density = 1e-3
gyro_bias_walk = 1e-6
accel_bias_walk = 1e-5
gyro_bias_sigma = 1e-3
accel_bias_sigma = 1e-2

[gnss]
file = "gnss.csv"
lever_arm = [0.1, 0.2, 0.3]

[odometer]
file = "odometer.csv"

[truth]
file = "truth.csv"
"""


def write_small(folder: Path) -> Path:
    """One second of a standing car: 100 IMU rows, 5 fixes, 10 speeds, 2 truth rows."""
    t = np.arange(1, 101) / 100
    _csv(folder / "imu.csv", "t,gx,gy,gz,ax,ay,az", [[x, 0.001, 0.002, 0.003, 0.1, 0.2, 9.8] for x in t])
    fixes = [[0.2 * k, 50.0, 100.0, 115.0, 0.5, 0.5, 1.0] for k in range(5)]
    _csv(folder / "gnss.csv", "t,lat,lon,h,sd_e,sd_n,sd_u", fixes)
    _csv(folder / "odometer.csv", "t,speed", [[0.1 * k, 0.0] for k in range(10)])
    _csv(folder / "truth.csv", "t,lat,lon,h", [[0.1, 50.0, 100.0, 115.0], [0.9, 50.0, 100.0, 115.0]])
    (folder / "recording.toml").write_text(TOML)
    return folder


def _csv(path: Path, header: str, rows: list[list[float]]) -> None:
    path.write_text("\n".join([header, *(",".join(f"{x:.6f}" for x in row) for row in rows)]) + "\n")


Break = Callable[[Path], None]


def toml(old: str, new: str) -> Break:
    """Replace text in recording.toml."""

    def change(folder: Path) -> None:
        text = (folder / "recording.toml").read_text()
        assert old in text
        (folder / "recording.toml").write_text(text.replace(old, new, 1))

    return change


def line(file: str, number: int, text: str | None) -> Break:
    """Put another text in one line of a file (1-based), or take the line out."""

    def change(folder: Path) -> None:
        lines = (folder / file).read_text().splitlines()
        lines[number - 1 : number] = [] if text is None else [text]
        (folder / file).write_text("\n".join(lines) + "\n")

    return change


def every(file: str, change_row: Callable[[list[float]], list[float]]) -> Break:
    """Change all data rows of a file."""

    def change(folder: Path) -> None:
        header, *rows = (folder / file).read_text().splitlines()
        _csv(folder / file, header, [change_row([float(x) for x in row.split(",")]) for row in rows])

    return change


def content(file: str, data: bytes) -> Break:
    """Replace a whole file."""

    def change(folder: Path) -> None:
        (folder / file).write_bytes(data)

    return change


def zipped(data: bytes) -> Break:
    """Make the IMU file a .csv.gz with these bytes."""

    def change(folder: Path) -> None:
        (folder / "imu.csv.gz").write_bytes(data)
        toml('"imu.csv"', '"imu.csv.gz"')(folder)

    return change


def both(*changes: Break) -> Break:
    """Several changes."""

    def change(folder: Path) -> None:
        for one in changes:
            one(folder)

    return change


def remove(file: str) -> Break:
    """Delete a file."""
    return lambda folder: (folder / file).unlink()


def shift_decimal(k: int, factor: float) -> Callable[[list[float]], list[float]]:
    """A row change: one column multiplied."""
    return lambda row: [x * factor if j == k else x for j, x in enumerate(row)]


IMU_HEADER = "t,gx,gy,gz,ax,ay,az"
GOOD_ROW = "0.01,0,0,0,0,0,9.8"
IN_DAYS = "\n".join([IMU_HEADER, *(f"45966.000000{k},0,0,0,0,0,9.8" for k in range(1, 10))]).encode()  # 0.0864 s apart

# what is broken: (how, the key of the error and the names that its line must hold)
BROKEN: dict[str, tuple[Break, tuple[str, ...]]] = {
    # files
    "empty file": (content("imu.csv", b""), ("file.empty", "imu.csv")),
    "only blank lines": (content("imu.csv", b"\n\n  \n"), ("file.empty", "imu.csv")),
    "header only": (content("imu.csv", b"t,gx,gy,gz,ax,ay,az\n"), ("file.no_rows", "imu.csv")),
    "binary file": (content("imu.csv", bytes(range(256)) * 20), ("file.binary", "imu.csv")),
    "not utf-8": (content("imu.csv", "t,gx,gy,gz,ax,ay,\xe4z\n".encode("latin-1")), ("file.text", "imu.csv", "line 1")),
    "no header": (line("imu.csv", 1, None), ("table.no_header", "imu.csv, line 1")),
    "semicolons": (
        content("imu.csv", b"t;gx;gy;gz;ax;ay;az\n1;2;3;4;5;6;7\n"),
        ("table.separator", "line 1"),
    ),
    "web page": (
        content("gnss.csv", b"<!DOCTYPE html>\n<html><body>404, gone</body>\n"),
        ("file.no_table", "gnss.csv"),
    ),
    "pointer of LFS": (
        content("gnss.csv", b"version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 12\n"),
        ("file.no_table", "gnss.csv", "git lfs pull"),
    ),
    "JSON": (content("gnss.csv", b'{"t": [1, 2], "lat": [3, 4]}\n'), ("file.no_table", "gnss.csv")),
    "gz that is none": (zipped(b"t,gx\n1,2\n"), ("file.gzip", "imu.csv.gz")),
    "gz cut off": (zipped(gzip.compress(b"t,gx,gy,gz,ax,ay,az\n" * 50)[:30]), ("file.damaged", "imu.csv.gz")),
    "gz without the name": (content("imu.csv", gzip.compress(b"t,gx\n")), ("file.gzip", "imu.csv")),
    "missing file": (remove("gnss.csv"), ("file.missing", "gnss.csv")),
    "missing file, zipped there": (
        toml('"gnss.csv"', '"imu.csv.gz"'),
        ("file.missing", "imu.csv.gz", "imu.csv"),
    ),
    "a folder as file": (toml('"gnss.csv"', '"."'), ("file.folder",)),
    # columns and cells
    "missing column": (
        line("imu.csv", 1, "t,gx,gy,gz,ax,ay,acc_z"),
        ("table.column", "'az'", "acc_z", "columns = { az"),
    ),
    "renamed column missing": (toml('axes = "RFU"', 'columns = { t = "time" }'), ("table.column", "imu.csv", "'time'")),
    "column twice": (line("imu.csv", 1, "t,gx,gx,gz,ax,ay,az"), ("table.column_twice", "imu.csv", "'gx'")),
    "non-numeric cell": (
        line("imu.csv", 7, "0.06,0,0,0,0,oops,9.8"),
        ("table.cell", "imu.csv, line 7", "'ay'", "'oops'"),
    ),
    "error of a spreadsheet": (
        line("imu.csv", 7, "0.06,0,0,0,0,#DIV/0!,9.8"),
        ("table.cell", "imu.csv, line 7", "'ay'", "'#DIV/0!'"),
    ),
    "decimal comma": (line("odometer.csv", 3, "0,1,0,5"), ("table.fields", "odometer.csv, line 3")),
    "short row": (line("imu.csv", 5, "0.04,0,0,0"), ("table.fields", "imu.csv, line 5")),
    "all rows short": (content("imu.csv", b"t,gx,gy,gz,ax,ay,az\n1,2\n3,4\n"), ("table.fields", "imu.csv, line 2")),
    "infinite value": (line("imu.csv", 9, "0.08,0,0,0,0,0,inf"), ("table.not_finite", "imu.csv, line 9", "'az'")),
    "infinite after comments": (
        both(line("imu.csv", 1, f"# made by hand\n\n{IMU_HEADER}"), line("imu.csv", 9, "0.06,0,-inf,0,0,0,9")),
        ("table.not_finite", "imu.csv, line 9", "'gy'"),
    ),
    "NaN everywhere": (every("imu.csv", lambda row: [row[0], *[float("nan")] * 6]), ("table.all_blank", "imu.csv")),
    "one row": (content("imu.csv", f"{IMU_HEADER}\n{GOOD_ROW}\n".encode()), ("table.few_rows", "imu.csv")),
    "one time": (every("imu.csv", lambda row: [3.0, *row[1:]]), ("table.times_repeated", "imu.csv", "'t'")),
    "fixes at one time": (every("gnss.csv", lambda row: [3.0, *row[1:]]), ("table.times_repeated", "gnss.csv", "'t'")),
    "a minus as in print": (line("imu.csv", 7, "0.06,0,0,0,0,\u22120.1,9.8"), ("table.cell", "line 7", "'ay'", "init")),
    "a thousand": (line("imu.csv", 7, "0.06,0,0,0,0,1'000.5,9.8"), ("table.cell", "line 7", "'ay'", "init")),
    "a zone": (
        line("imu.csv", 7, "2025-07-08 16:00:00 JST,0,0,0,0,0,9.8"),
        ("table.cell", "line 7", "'t'", "JST", "+09:00"),
    ),
    "time in ms": (every("imu.csv", shift_decimal(0, 1e3)), ("imu.time_unit", "imu.csv", 't = "ms"')),
    "time in us": (every("imu.csv", shift_decimal(0, 1e6)), ("imu.time_unit", "imu.csv", 't = "us"')),
    "time in days": (content("imu.csv", IN_DAYS), ("table.days", "imu.csv", 't = "d"')),
    # positions
    "lat and lon swapped": (
        both(line("gnss.csv", 1, "t,lon,lat,h,sd_e,sd_n,sd_u")),
        ("table.place", "gnss.csv, line 2", "'lat'"),
    ),
    "radians": (
        every("gnss.csv", lambda row: [row[0], row[1] / 57.3, row[2] / 57.3, *row[3:]]),
        ("table.radians", "gnss.csv", 'angle = "rad"'),
    ),
    "longitude": (line("gnss.csv", 4, "0.4,50,400,115,1,1,1"), ("table.place", "gnss.csv, line 4", "'lon'", "400")),
    "height in mm": (every("gnss.csv", shift_decimal(3, 1e3)), ("table.height", "gnss.csv, line 2", "'h'")),
    "negative sd in the file": (
        line("gnss.csv", 3, "0.2,50,100,115,1,-1,1"),
        ("table.sigma", "gnss.csv, line 3", "'sd_n'"),
    ),
    # recording.toml
    "toml syntax": (toml('platform = "vehicle"', "platform = vehicle"), ("toml.syntax", "recording.toml", "line 3")),
    "toml not text": (content("recording.toml", b"\xff\xfe\x00"), ("file.text", "recording.toml")),
    "wrong format": (
        toml("recording/1", "recording/2"),
        ("key.value", "recording.toml", "'format'", "graphnav-recording/1"),
    ),
    "no platform": (toml('platform = "vehicle"', ""), ("key.missing", "recording.toml", "'platform'")),
    "bad platform": (
        toml('"vehicle"', '"boat"'),
        ("key.value", "recording.toml", "'platform' = 'boat'", "'vehicle'", "'foot'"),
    ),
    "no imu": (toml("[imu]", "[imus]"), ("key.unknown", "recording.toml", "'imus'", "'imu'")),
    "no file": (toml('file = "gnss.csv"', ""), ("key.missing", "recording.toml", "'gnss.file'")),
    "unknown key": (toml("lever_arm", "leverarm"), ("key.unknown", "recording.toml", "'gnss.leverarm'", "'lever_arm'")),
    "unknown noise key": (
        toml("gyro_bias_walk", "gyro_walk"),
        ("key.unknown", "'imu.noise.gyro_walk'", "gyro_bias_walk"),
    ),
    "unknown column key": (
        toml('file = "gnss.csv"', 'file = "gnss.csv"\ncolumns = { latt = "lat" }'),
        ("key.value", "'gnss.columns'", "'latt'", "'lat'"),
    ),
    "wrong type": (toml('file = "gnss.csv"', "file = 7"), ("key.value", "recording.toml", "'gnss.file' = 7")),
    "number as text": (
        toml("gyro_bias_walk = 1e-6", 'gyro_bias_walk = "1e-6"'),
        ("key.value", "'imu.noise.gyro_bias_walk'"),
    ),
    "not a table": (toml("[truth]\nfile =", "truth ="), ("key.unknown", "recording.toml", "'odometer.truth'")),
    "negative noise": (
        toml("gyro_bias_walk = 1e-6", "gyro_bias_walk = -1e-6"),
        ("key.value", "'imu.noise.gyro_bias_walk'"),
    ),
    "zero noise": (toml("= 1e-3", "= 0.0"), ("key.value", "'imu.noise.accel_noise_density'")),
    "negative scale": (
        toml("gyro_bias_walk = 1e-6", "gyro_bias_walk = 1e-6\ngyro_scale_sigma = -0.1"),
        ("key.value", "'imu.noise.gyro_scale_sigma'"),
    ),
    "zero sd": (toml("lever_arm", "sd = [1.0, 0.0, 1.0]\nlever_arm"), ("key.value", "'gnss.sd'")),
    "two sd": (toml("lever_arm", "sd_v = [1.0, 1.0]\nlever_arm"), ("key.value", "'gnss.sd_v'")),
    "lever arm of two": (toml("[0.1, 0.2, 0.3]", "[0.1, 0.2]"), ("key.value", "'gnss.lever_arm'")),
    "lever arm of nan": (toml("[0.1, 0.2, 0.3]", "[0.1, 0.2, nan]"), ("key.value", "'gnss.lever_arm'")),
    "bad unit": (
        toml('axes = "RFU"', 'units = { gyro = "rpm" }'),
        ("key.value", "'imu.units.gyro' = 'rpm'", "'rad/s'", "'deg/s'"),
    ),
    "unknown unit key": (
        toml('axes = "RFU"', 'units = { gyros = "rad/s" }'),
        ("key.unknown", "'imu.units.gyros'", "'gyro'"),
    ),
    "offset of an age": (toml('axes = "RFU"', "time_offset = 1e18"), ("key.value", "line 7", "'imu.time_offset'")),
    "curly quotes": (toml('"RFU"', "\u201cRFU\u201d"), ("toml.syntax", "line 7", "quotes")),
    "file elsewhere": (
        toml('"gnss.csv"', '"/etc/gnss.csv"'),
        ("file.outside", "line 18", "'gnss.file' = '/etc/gnss.csv'"),
    ),
    "infinite offset": (toml('axes = "RFU"', "time_offset = inf"), ("key.value", "'imu.time_offset'")),
    # mounting
    "left-handed axes": (toml("RFU", "FRU"), ("key.value", "line 7", "'imu.axes' = 'FRU'", "FRD")),
    "axes garbage": (toml("RFU", "XYZ"), ("key.value", "'imu.axes' = 'XYZ'")),
    "axes repeat": (toml("RFU", "RLU"), ("key.value", "'imu.axes' = 'RLU'")),
    "axes too short": (toml("RFU", "RF"), ("key.value", "'imu.axes' = 'RF'")),
    "axes and forward": (
        toml('axes = "RFU"', 'axes = "RFU"\nforward = [0, 1, 0]\nup = [0, 0, 1]'),
        ("key.value", "'imu'"),
    ),
    "forward alone": (toml('axes = "RFU"', "forward = [0, 1, 0]"), ("key.value", "'imu'")),
    "forward along up": (
        toml('axes = "RFU"', "forward = [0, 0.1, 1]\nup = [0, 0, 1]"),
        ("key.value", "'imu'"),
    ),
    "zero up": (toml('axes = "RFU"', "forward = [0, 1, 0]\nup = [0, 0, 0]"), ("key.value", "'imu'")),
    # truth and keep
    "truth of unknown": (
        toml('file = "truth.csv"', 'file = "truth.csv"\nof = "camera"'),
        ("key.value", "'truth.of'", "'camera'"),
    ),
    "truth of nobody": (
        both(toml('[odometer]\nfile = "odometer.csv"', ""), toml('"truth.csv"', '"truth.csv"\nof = "odometer"')),
        ("key.value", "'odometer'", "[odometer]"),
    ),
    "truth of two kinds": (toml('"truth.csv"', '"truth.csv"\nclosed_loop_sigma = 0.1'), ("key.value", "'truth'")),
    "local truth without x": (
        toml('"truth.csv"', '"truth.csv"\nframe = "local"'),
        ("table.column", "truth.csv", "'x'"),
    ),
    "keep column missing": (
        toml('"truth.csv"', '"truth.csv"\nkeep = { column = "trust", at_least = 1 }'),
        ("table.column", "truth.csv", "'trust'"),
    ),
    "keep leaves nothing": (
        toml('"truth.csv"', '"truth.csv"\nkeep = { column = "h", at_least = 1000 }'),
        ("table.keep", "truth.csv"),
    ),
    "keep incomplete": (
        toml('"truth.csv"', '"truth.csv"\nkeep = { column = "h" }'),
        ("key.missing", "'truth.keep.at_least'"),
    ),
}


@pytest.mark.parametrize("case", BROKEN, ids=lambda name: name.replace(" ", "-"))
def test_a_broken_recording_gets_one_plain_line(tmp_path: Path, case: str) -> None:
    change, (key, *names) = BROKEN[case]
    change(write_small(tmp_path))
    with refused(key, RecordingError, *names) as caught:
        read(tmp_path)
    assert "Error" not in str(caught.value)


def test_the_unbroken_recording_loads_without_a_remark(tmp_path: Path) -> None:
    recording = read(write_small(tmp_path))
    assert recording.remarks == ()
    assert (len(recording.imu.t), len(recording.gnss.t), len(recording.odometer.t)) == (100, 5, 10)


def test_what_is_no_recording_says_what_to_point_at(tmp_path: Path) -> None:
    with refused("file.missing", RecordingError, "kitti"):
        read(tmp_path / "nowhere")
    with refused("recording.none", RecordingError, "recording.toml"):
        read(tmp_path)
    write_small(tmp_path)
    (tmp_path / "recording.toml").rename(tmp_path / "other.toml")
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    with refused("recording.none", RecordingError, "other.toml") as caught:
        read(tmp_path)
    assert "pyproject" not in str(caught.value)
    with refused("recording.none", RecordingError, "imu.csv"):
        read(tmp_path / "imu.csv")
    with refused("file.unreadable", RecordingError, "absent.toml"):
        read(tmp_path / "absent.toml")


# what is odd but safe to mend: (how, key of the remark and what it names, IMU rows left)
MENDED: dict[str, tuple[Break, tuple[str, ...], int]] = {
    "unsorted": (
        both(line("imu.csv", 3, "0.03,1,0,0,0,0,9"), line("imu.csv", 4, "0.02,2,0,0,0,0,9")),
        ("imu.rows_unordered", "1", "0.030"),
        100,
    ),
    "stamp in ms": (line("imu.csv", 50, "490,0,0,0,0,0,9.8"), ("imu.stamps_lone", "1 IMU row", "490"), 100),
    "repeated": (line("imu.csv", 4, "0.02,5,5,5,5,5,5"), ("imu.rows_repeated", "1", "0.020"), 99),
    "NaN row": (line("imu.csv", 4, "0.03,0,nan,0,0,0,9.8"), ("imu.rows_blank", "1", "0.030"), 99),
    "blank cell": (line("imu.csv", 4, "0.03,0,,0,0,0,9.8"), ("imu.rows_blank", "1", "0.030"), 99),
    "blank last cell": (line("imu.csv", 101, "1.00,0,0,0,0,0,"), ("imu.rows_blank", "1", "1.000"), 99),
    "blank time": (line("imu.csv", 4, ",0,0,0,0,0,9.8"), ("imu.rows_blank", "1"), 99),
    "blank fix": (line("gnss.csv", 3, "0.2,,,,,,"), ("gnss.rows_blank", "1"), 100),
    "fix at 0, 0": (line("gnss.csv", 3, "0.2,0,0,0,1,1,1"), ("gnss.nowhere", "1"), 100),
    "no noise": (toml(TOML[TOML.index("[imu.noise]") : TOML.index("[gnss]")], ""), ("imu.noise_assumed",), 100),
    "partial noise": (toml("gyro_bias_walk = 1e-6\n", ""), ("imu.noise_partly", "gyro_bias_walk"), 100),
    "no sd": (line("gnss.csv", 1, "t,lat,lon,h,a,b,c"), ("gnss_position.sigma_assumed", "3.3, 3.3, 6.6"), 100),
    "one sd": (line("gnss.csv", 1, "t,lat,lon,h,sd_e,b,c"), ("gnss_position.sigma_partly", "sd_e"), 100),
    "no sd_u": (line("gnss.csv", 1, "t,lat,lon,h,sd_e,sd_n,c"), ("gnss_position.sigma_partly", "sd_u", "twice"), 100),
    "blank sd": (line("gnss.csv", 3, "0.2,50,100,115,1,,1"), ("gnss_position.sigma_blank", "1 of 5"), 100),
    "no sd_v": (line("gnss.csv", 1, "t,lat,lon,h,ve,vn,vu"), ("gnss_velocity.sigma_assumed", "0.2, 0.2, 0.4"), 100),
    "two velocities": (line("gnss.csv", 1, "t,lat,lon,h,ve,vn,c"), ("gnss.velocity_partly", "ve, vn"), 100),
}  # fmt: skip


@pytest.mark.parametrize("case", MENDED, ids=lambda name: name.replace(" ", "-"))
def test_what_can_be_mended_safely_is_and_is_remarked_on(tmp_path: Path, case: str) -> None:
    change, remark, rows = MENDED[case]
    change(write_small(tmp_path))
    recording = read(tmp_path)
    assert_told(recording.remarks, *remark)
    assert len(recording.imu.t) == rows
    assert (np.diff(recording.imu.t) > 0).all()


def test_commas_in_quotes_and_marks_at_the_start_are_no_cells(tmp_path: Path) -> None:
    whole = read(write_small(tmp_path))
    header, *rows = (tmp_path / "imu.csv").read_text().splitlines()
    text = "\n".join([f'{header},"what, else"', *(f'{row},"a, b"' for row in rows)]) + "\n"
    (tmp_path / "imu.csv").write_bytes(b"\xef\xbb\xbf" * 2 + text.encode())
    quoted = read(tmp_path)
    assert quoted.remarks == ()
    assert np.array_equal(quoted.imu.gyro, whole.imu.gyro)
    assert np.array_equal(quoted.imu.t, whole.imu.t)


def test_sorting_keeps_rows_together_and_repeats_keep_the_first(tmp_path: Path) -> None:
    write_small(tmp_path)
    MENDED["unsorted"][0](tmp_path)
    assert np.array_equal(read(tmp_path).imu.gyro[:4, 0], [0.001, 2.0, 1.0, 0.001])
    write_small(tmp_path)
    MENDED["repeated"][0](tmp_path)
    assert np.array_equal(read(tmp_path).imu.gyro[:3, 0], [0.001, 0.001, 0.001])


def test_gaps_are_left_as_they_are(tmp_path: Path) -> None:
    write_small(tmp_path)
    lines = (tmp_path / "imu.csv").read_text().splitlines()
    (tmp_path / "imu.csv").write_text("\n".join(lines[:30] + lines[60:]) + "\n")
    recording = read(tmp_path)
    assert len(recording.imu.t) == 70
    assert recording.duration == pytest.approx(1.0)
