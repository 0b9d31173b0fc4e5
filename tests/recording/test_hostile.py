"""Files that nobody meant well: each is one line and code 2, soon, in little memory, and reads nothing but its own."""

from __future__ import annotations

import contextlib
import gzip
import os
import resource
import signal
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import logs
import numpy as np
import pytest
from helpers import assert_told, refused
from logs import frame
from test_bad_input import TOML, content, line, toml, write_small
from test_formats_binary import nav_pvt

from graphnav.app import cli, convert, outputs
from graphnav.app.fleet.drive import solve_drive
from graphnav.app.fleet.manifest import Task
from graphnav.config import read_settings
from graphnav.core.errors import ConfigError, GraphnavError, RecordingError
from graphnav.core.files import MAX_FILE, MAX_LINE, open_file
from graphnav.estimation import pipeline
from graphnav.recording.formats import load, read
from graphnav.recording.formats.trajectories import read_trajectory
from graphnav.report import documents as report

TRAJECTORY = b"t,lat,lon,h\n" + b"".join(b"%d,30.0,114.0,20.0\n" % k for k in range(400))


@pytest.fixture(autouse=True)
def _soon_and_small() -> Iterator[None]:
    """What would wait for ever, or eat all memory, fails instead."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(30)
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30), hard))
    yield
    signal.alarm(0)
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def refuse_command(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The one line that a command is refused with."""
    assert cli.run([str(a) for a in arguments]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert len(said) < 2000
    return said


# ------------------------------------------------------------------------------------------------- no tracebacks
def test_every_flipped_bit_of_a_packed_trajectory_is_told(tmp_path: Path) -> None:
    packed, path = gzip.compress(TRAJECTORY, mtime=0), tmp_path / "x.csv.gz"
    for k in range(0, 8 * len(packed), 41):
        damaged = bytearray(packed)
        damaged[k // 8] ^= 1 << k % 8
        path.write_bytes(damaged)
        with contextlib.suppress(RecordingError):
            assert len(read_trajectory(path)) == 400


@pytest.mark.parametrize("date", [(0, 0, 0), (2022, 13, 9), (2022, 3, 32), (65535, 1, 1)])
def test_ubx_fixes_without_a_date(tmp_path: Path, date: tuple[int, int, int]) -> None:
    """The date of another fix will do; without any the week is not known, and the seconds of it are."""
    good = [nav_pvt(t, np.array([0.5, 2.0, 20.0]), (1.0, 2.0, 0.0)) for t in (0.0, 1.0, 2.0)]
    payload = bytearray(good[0][6:-2])
    struct.pack_into("<HBB", payload, 4, *date)
    bad = frame(1, 7, bytes(payload))
    path = tmp_path / "a.ubx"
    path.write_bytes(bad + good[1] + good[2])
    assert load(path).gps_zero == logs.WEEK * 604800.0
    path.write_bytes(bad)
    log = load(path)
    assert log.gps_zero is None
    assert log.gnss.t == pytest.approx([logs.TOW])


def test_ubx_positions_nowhere_are_left_out(tmp_path: Path) -> None:
    good = [nav_pvt(t, np.array([0.5, 2.0, 20.0]), (1.0, 2.0, 0.0)) for t in (0.0, 1.0, 2.0)]
    payload = bytearray(good[0][6:-2])
    struct.pack_into("<i", payload, 28, 2_140_000_000)
    path = tmp_path / "a.ubx"
    path.write_bytes(frame(1, 7, bytes(payload)) + good[1] + good[2])
    log = load(path)
    assert len(log.gnss.t) == 2
    assert_told(log.remarks, "gnss.rows_left_out", "214")
    path.write_bytes(frame(1, 7, bytes(payload)))
    with refused("table.none_sound", RecordingError, "214"):
        load(path)


@pytest.mark.parametrize("field", [2, 4, 8, 9, 11])
def test_nmea_fields_that_are_no_numbers(tmp_path: Path, field: int) -> None:
    """With the checksum right: latitude, longitude, HDOP, altitude, separation of the geoid."""
    path = logs.write_nmea(tmp_path / "a.nmea", logs.simulated(20.0)[0])
    whole = len(load(path).gnss.t)
    lines = path.read_text().splitlines(keepends=True)
    for k, damage in enumerate(("3x00.0000", "1_0.5", "\uff11", "9999.9", "nan", "1e999")):
        body = lines[3 * k][1:].split("*")[0].split(",")
        body[field] = damage
        lines[3 * k] = logs.sentence(",".join(body))
    path.write_text("".join(lines), encoding="utf-8")
    log = load(path)
    assert whole - 6 <= len(log.gnss.t) <= whole
    assert np.isfinite(log.gnss.llh).all()
    assert np.abs(np.degrees(log.gnss.llh[:, 0])).max() <= 90.0


def test_nmea_counts_of_satellites_that_are_none(tmp_path: Path) -> None:
    """More digits than a number has leave the count open and keep the fix; what is no number is no sentence."""
    path = logs.write_nmea(tmp_path / "a.nmea", logs.simulated(20.0)[0])
    whole = load(path).gnss
    lines = path.read_text().splitlines(keepends=True)
    damages = ("9" * 400, "1" * 5000, "1_0", "\uff11", "x")
    for k, damage in enumerate(damages):
        body = lines[3 * k][1:].split("*")[0].split(",")
        assert body[0].endswith("GGA")
        body[7] = damage
        lines[3 * k] = logs.sentence(",".join(body))
    path.write_text("".join(lines), encoding="utf-8")
    log = load(path)
    left_out = np.setdiff1d(whole.t, log.gnss.t)
    assert left_out == pytest.approx(whole.t[1:5])  # 5,000 digits are refused by the parser itself
    assert np.isnan(log.gnss.satellites[0])
    np.testing.assert_array_equal(log.gnss.satellites[1:], whole.satellites[5:])
    np.testing.assert_array_equal(log.gnss.llh, np.delete(whole.llh, range(1, 5), axis=0))


@pytest.mark.parametrize("kind", ["GGA", "GST", "RMC", "VTG", "ZDA"])
def test_nmea_sentences_that_end_early(tmp_path: Path, kind: str) -> None:
    path = logs.write_nmea(tmp_path / "a.nmea", logs.simulated(5.0)[0])
    whole = path.read_text()
    short = [logs.sentence(f"GN{kind},235959.00" + ",1" * n) for n in range(10)]
    path.write_text("".join(short) + whole + "".join(short))
    log = load(path)
    path.write_text(whole)
    assert np.isin(load(path).gnss.t, log.gnss.t).all()


@pytest.fixture
def kf_gins(tmp_path: Path) -> Path:
    return logs.write_kf_gins(tmp_path, *logs.simulated(5.0)) / "kf-gins.yaml"


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 8)}]\n" for k in range(1, 12)
)
YAML = {
    "lever arm of nan": ("antlever: [ 0.5", "antlever: [ .nan", "value", "antlever"),
    "lever arm of inf": ("antlever: [ 0.5", "antlever: [ .inf", "value", "antlever"),
    "lever arm of 400 digits": ("antlever: [ 0.5", "antlever: [ " + "1" * 400, "syntax", "antlever"),
    "tiny time": ("corrtime: 4.0", "corrtime: 1e-320", "value", "corrtime"),
    "400 digits": ("corrtime: 4.0", f"corrtime: {'9' * 400}", "syntax", "corrtime"),
    "hexadecimal": ("corrtime: 4.0", f"corrtime: 0x{'f' * 4000}", "syntax", "corrtime"),
    "100,000 digits": ("corrtime: 4.0", f"corrtime: {'9' * 100_000}", "syntax", "kf-gins.yaml"),
    "no such date": ("starttime: 345600", "starttime: 2022-13-45", "syntax", "kf-gins.yaml"),
    "deep": ("starttime: 345600", f"starttime: {'[' * 3000}{']' * 3000}", "syntax", "kf-gins.yaml"),
    "aliases": ("starttime: 345600", BOMB + "arw: *a11", "aliases", "line"),
    "merged aliases": ("starttime: 345600", "a: &a {x: 1}\nb: {<<: [*a, *a]}", "aliases", "line"),
    "no name of a file": ('imupath: "./dataset/imu.txt"', "imupath: [1, 2]", "value", "imupath"),
}


@pytest.mark.parametrize("case", YAML)
def test_yaml_that_cannot_be_used(kf_gins: Path, case: str) -> None:
    old, new, key, name = YAML[case]
    text = kf_gins.read_text()
    assert old in text
    kf_gins.write_text(text.replace(old, new, 1))
    with refused(f"yaml.{key}", RecordingError, name) as caught:
        load(kf_gins)
    assert len(str(caught.value)) < 1000


DESCRIPTIONS = {
    "deep": "a = " + "[" * 2000 + "]" * 2000,
    "deep tables": "[" + ".".join("a" * 3000) + "]\n",
    "deep keys": ".".join("a" * 3000) + " = 1\n",
    "5,000 digits": "a = " + "1" * 5000,
    "400 digits": TOML.replace("scale", "scale").replace("[odometer]\n", f"[odometer]\nscale_sigma = {'1' * 400}\n"),
    "null": TOML.replace('"imu.csv"', '"a\\u0000b"'),
    "long": TOML.replace('"imu.csv"', f'"{"x" * 100_000}"'),
    "long figure": TOML.replace("[gnss]", f'[imu.noise]\naccel_bias_sigma = "{"x" * 5000}"\n\n[gnss]'),
    "long key": TOML.replace("[gnss]", f"[imu.noise]\n{'x' * 5000} = 1\n\n[gnss]"),
    "folder of its own": TOML.replace('"imu.csv"', '"."'),
}


@pytest.mark.parametrize("case", DESCRIPTIONS)
def test_descriptions_that_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    write_small(tmp_path)
    (tmp_path / "recording.toml").write_text(DESCRIPTIONS[case])
    refuse_command(capsys, "info", tmp_path)
    with pytest.raises(RecordingError) as caught:
        read(tmp_path)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    "text",
    [
        f"[gnss]\ngate = {'1' * 400}",
        f"[solver]\nlag = {'1' * 400}",
        "a = " + "[" * 2000 + "]" * 2000,
        "[gnss]\nslow_times = [1e-320, inf]",
    ],
)
def test_settings_that_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    (tmp_path / "s.toml").write_text(text)
    refuse_command(capsys, "settings", "--config", tmp_path / "s.toml")


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"settings": {"solver": {"lag": ' + "1" * 5000 + "}}}", '{"noise": 7}']
)
def test_summaries_that_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    (tmp_path / "s.json").write_text(text)
    refuse_command(capsys, "settings", "--config", tmp_path / "s.json")
    refuse_command(capsys, "smooth", "kitti", "--noise", tmp_path / "s.json", "-o", tmp_path / "out")


def test_one_stamp_far_from_all_others(tmp_path: Path) -> None:
    """An odometer's reading can be missed; a stamp of any other sensor is told."""
    line("odometer.csv", 4, "-1e308,0.0")(write_small(tmp_path))
    recording = read(tmp_path)
    assert len(recording.odometer.t) == 9
    line("gnss.csv", 4, "1e300,50,100,115,1,1,1")(tmp_path)
    with refused("table.not_finite", RecordingError, "gnss.csv, line 4, column 't'"):
        read(tmp_path)


def test_sigmas_that_say_nothing(tmp_path: Path) -> None:
    for k in (3, 5):
        line("gnss.csv", k, f"{0.2 * (k - 2)},50,100,115,1e300,1,1")(write_small(tmp_path) if k == 3 else tmp_path)
    recording = read(tmp_path)
    assert len(recording.gnss.t) == 3
    assert recording.gnss.sd.max() == 1.0
    assert_told(recording.remarks, "gnss.sigma_vague")
    line("gnss.csv", 2, "0.0,50,100,115,1e-320,1,1")(tmp_path)
    with refused("table.sigma", RecordingError, "gnss.csv, line 2, column 'sd_e'"):
        read(tmp_path)


@pytest.mark.parametrize("cell", ["1_000", "\uff11\uff12", "0x10", "1e5_0", "\u0661"])
def test_numbers_are_what_every_program_reads_as_one(tmp_path: Path, cell: str) -> None:
    line("imu.csv", 7, f"0.06,0,0,0,0,{cell},9.8")(write_small(tmp_path))
    with refused("table.cell", RecordingError, "imu.csv, line 7, column 'ay'"):
        read(tmp_path)
    (tmp_path / "x.csv").write_text(f"t,lat,lon,h\n0,30,114,20\n1,30,114,{cell}\n", encoding="utf-8")
    with refused("table.cell", RecordingError, "x.csv, line 3, h"):
        read_trajectory(tmp_path / "x.csv")


@pytest.mark.parametrize(
    ("row", "key"),
    [
        ("1 inf 0 0 0 0 0 1", "place"),
        ("1 0 1e308 0 0 0 0 1", "place"),
        ("inf 0 0 0 0 0 0 1", "cell"),
        ("1 0 0 0 nan 0 0 1", "quaternion"),
        ("1e300 0 0 0 0 0 0 1", "cell"),
    ],
)
def test_tum_rows_that_are_nowhere(tmp_path: Path, row: str, key: str) -> None:
    (tmp_path / "x.tum").write_text(f"0 0 0 0 0 0 0 1\n{row}\n")
    with refused(f"table.{key}", RecordingError, "x.tum, line 2"):
        read_trajectory(tmp_path / "x.tum")


@pytest.mark.parametrize("name", ["x" * 100_000, "a\0b", "x/" * 3000])
def test_names_that_are_none(tmp_path: Path, name: str) -> None:
    for use in (load, read, read_trajectory, read_settings):
        with pytest.raises(GraphnavError) as caught:
            use(name)
        assert len(str(caught.value)) < 1000


def test_a_damaged_archive_is_the_projects_own_error(tmp_path: Path) -> None:
    path = logs.write_rtklib(tmp_path / "a.pos", logs.simulated(5.0)[0])
    packed = bytearray(gzip.compress(path.read_bytes()))
    packed[len(packed) // 2] ^= 0xFF
    (tmp_path / "imu.csv.gz").write_bytes(packed)
    toml('"imu.csv"', '"imu.csv.gz"')(write_small(tmp_path))
    (tmp_path / "imu.csv").unlink()
    with refused("file.damaged", RecordingError, "imu.csv.gz"):
        read(tmp_path)


def test_times_beyond_any_date(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.csv").write_text("t,lat,lon,h\n1e300,30,114,20\n2e300,30,114,20\n")
    refuse_command(capsys, "convert", tmp_path / "x.csv", "-o", tmp_path / "x.gpx")


def test_rows_shorter_than_the_header_are_told_whichever_columns_are_used(tmp_path: Path) -> None:
    """A header that ran into a row: its first names are whole, and what stands below them is not theirs for sure."""
    write_small(tmp_path)
    lines = (tmp_path / "truth.csv").read_text().splitlines()
    (tmp_path / "truth.csv").write_text("\n".join([f"{lines[0]},ve0.1,62.0", *lines[1:], ""]))
    with refused("table.fields", RecordingError, "truth.csv, line 2"):
        read(tmp_path)


@pytest.mark.parametrize("name", ["csv", "gpx", "kml", "nav", "nmea", "tum"])
def test_a_rate_that_leaves_no_row(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """No file without rows is written."""
    (tmp_path / "x.csv").write_text("t,lat,lon,h,roll,pitch,heading\n1,30,114,20,0,0,0\n2,30,114,20,0,0,0\n")
    out = tmp_path / f"y.{name}"
    assert "--rate" in refuse_command(
        capsys, "convert", tmp_path / "x.csv", "-o", out, "--rate", "1e-9", "--clock", "unix"
    )
    assert not out.exists()


# ----------------------------------------------------------------------------------------- no hangs, little memory
def test_pipes_and_devices_are_not_waited_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_small(tmp_path)
    (tmp_path / "gnss.csv").unlink()
    os.mkfifo(tmp_path / "gnss.csv")
    for arguments in (
        ("info", tmp_path),
        ("settings", "--config", tmp_path / "gnss.csv"),
        ("settings", "--config", "/dev/zero"),
        ("evaluate", tmp_path / "gnss.csv", tmp_path / "truth.csv"),
        ("evaluate", "/dev/zero", tmp_path / "truth.csv"),
        ("convert", tmp_path / "gnss.csv", "-o", tmp_path / "out"),
        ("convert", tmp_path / "gnss.csv", "-o", tmp_path / "out", "--format", "ubx"),
        ("init", tmp_path / "gnss.csv", "-o", tmp_path / "new.toml"),
        ("smooth", "kitti", "--noise", "/dev/zero", "-o", tmp_path / "out"),
    ):
        refuse_command(capsys, *arguments)


def test_a_line_that_never_ends(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A megabyte that unpacks to a line of a gigabyte."""
    packed = gzip.compress(b"0" * (1 << 24), 1)
    path = tmp_path / "x.csv.gz"
    path.write_bytes(gzip.compress(b"t,lat,lon,h\n") + packed * 64)
    assert "x.csv.gz" in refuse_command(capsys, "evaluate", path, path)
    write_small(tmp_path)
    toml('"imu.csv"', '"x.csv.gz"')(tmp_path)
    path.write_bytes(gzip.compress(b"t,gx,gy,gz,ax,ay,az\n") + packed * 64)
    assert "x.csv.gz" in refuse_command(capsys, "info", tmp_path)


def test_limits_can_be_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = b"t,lat,lon,h\n" + b"0,0,0,0\n" * (10 << 20)
    packed, path = gzip.compress(rows, 9), tmp_path / "x.csv.gz"
    path.write_bytes(packed)
    with refused("file.unpacks", RecordingError, MAX_FILE):
        read_trajectory(path)
    monkeypatch.setenv(MAX_FILE, "100")
    with open_file(path) as file:
        assert sum(len(block) for block in iter(lambda: file.read(1 << 20), b"")) == len(rows)
    monkeypatch.setenv(MAX_FILE, "10")
    with refused("file.large", RecordingError, MAX_FILE):
        read_trajectory(path)
    path = tmp_path / "x.csv"
    path.write_bytes(b"t,lat,lon,h," + b"x" * 300_000 + b"\n0,30,114,20,1\n")
    assert len(read_trajectory(path)) == 1
    monkeypatch.setenv(MAX_LINE, "100")
    with refused("file.line_long", RecordingError, MAX_LINE):
        read_trajectory(path)
    monkeypatch.setenv(MAX_LINE, "nothing")
    with refused("environment.value", ConfigError, MAX_LINE):
        read_trajectory(path)


# --------------------------------------------------------------------------------------------- nothing but its own
SECRET = "a secret of somebody else"


@pytest.fixture
def stranger(tmp_path: Path) -> Path:
    """A recording that was handed over, with a secret beside its folder."""
    (tmp_path / "secret.csv").write_text(f"{SECRET}\n1,2\n")
    (tmp_path / "drive").mkdir()
    return write_small(tmp_path / "drive")


@pytest.mark.parametrize("sensor", ["imu", "gnss", "odometer", "truth"])
@pytest.mark.parametrize("way", ["up", "absolute", "link"])
def test_a_recording_reads_below_its_own_folder(
    stranger: Path, capsys: pytest.CaptureFixture[str], sensor: str, way: str
) -> None:
    outside = stranger.parent / "secret.csv"
    name = {"up": "../secret.csv", "absolute": str(outside), "link": "link.csv"}[way]
    (stranger / "link.csv").symlink_to(outside)
    toml(f'"{sensor}.csv"', f'"{name}"')(stranger)
    assert SECRET not in refuse_command(capsys, "info", stranger)
    assert SECRET not in refuse_command(capsys, "smooth", stranger, "-o", stranger / "out")
    # one that is not there is told no differently
    toml(name, "../absent.csv")(stranger)
    there = refuse_command(capsys, "info", stranger)
    (stranger.parent / "absent.csv").write_text("t\n1\n")
    assert refuse_command(capsys, "info", stranger) == there


def test_outside_is_read_where_that_is_allowed(stranger: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (stranger / "gnss.csv").rename(stranger.parent / "gnss.csv")
    toml('"gnss.csv"', '"../gnss.csv"')(stranger)
    refuse_command(capsys, "info", stranger)
    assert cli.run(["info", str(stranger), "--allow-outside", "--quick"]) == 0
    assert len(read(stranger, allow_outside=True).gnss.t) == 5
    with pytest.raises(RecordingError):
        read(stranger)


def test_a_drive_of_a_fleet_takes_the_permission(tmp_path: Path, stranger: Path) -> None:
    (stranger / "gnss.csv").rename(stranger.parent / "gnss.csv")
    toml('"gnss.csv"', '"../gnss.csv"')(stranger)
    task = Task("drive", str(stranger), str(tmp_path / "out"), "ekf", {}, pages=False)
    refused_row, row = (solve_drive(replace(task, allow_outside=allowed)) for allowed in (False, True))
    assert refused_row["status"] == "refused"
    assert "gnss.file" in refused_row["error"]
    assert row["status"] == "done"


def test_a_configuration_reads_below_its_own_folder(kf_gins: Path) -> None:
    outside = kf_gins.parent.parent / f"{kf_gins.parent.name}-imu.txt"
    outside.write_text(f"{SECRET}\n")
    text = kf_gins.read_text()
    for name in (f"../{outside.name}", str(outside), outside.name):
        kf_gins.write_text(text.replace("./dataset/imu.txt", name))
        with pytest.raises(RecordingError) as caught:
            load(kf_gins)
        assert SECRET not in str(caught.value)
    kf_gins.write_text(text)
    (kf_gins.parent / "imu.txt").rename(kf_gins.parent / "moved.txt")
    (kf_gins.parent / "imu.txt").symlink_to(outside)
    with pytest.raises(RecordingError) as caught:
        load(kf_gins.parent)
    assert SECRET not in str(caught.value)


def test_words_of_a_file_do_not_steer_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line("imu.csv", 1, "t,gx,gy,gz,ax,ay,\x1b]0;owned\x07")(write_small(tmp_path))
    assert "\x1b" not in refuse_command(capsys, "info", tmp_path)
    write_small(tmp_path)
    toml('"small"', '"\\u001b]0;owned\\u0007"')(tmp_path)
    assert cli.run(["info", str(tmp_path), "--quick"]) == 0
    said = capsys.readouterr()
    assert "owned" in said.out
    assert "\x1b" not in said.out + said.err
    content("recording.toml", b'\x1b = "')(tmp_path)
    assert "\x1b" not in refuse_command(capsys, "info", tmp_path)


# --------------------------------------------------------------------------------------------- refused before the work
@pytest.fixture
def unsolved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Solving is a failure: what can be known before it is to be said before it."""

    def run(*_: object, **__: object) -> None:
        raise AssertionError("it was solved")

    monkeypatch.setattr(pipeline, "run", run)


@pytest.mark.usefixtures("unsolved")
def test_what_cannot_be_written_is_refused_before_solving(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out" / "report.html").mkdir(parents=True)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "ekf").write_text("")
    assert "report.html" in refuse_command(capsys, "smooth", "kitti", "-o", tmp_path / "out")
    assert "ekf" in refuse_command(capsys, "compare", "kitti", "-o", tmp_path / "taken")
    for out in ("/proc/out", "/dev/null/out", tmp_path / ("x" * 300), tmp_path / "a\0b"):
        refuse_command(capsys, "smooth", "kitti", "-o", out)
    clockless = tmp_path / "drive"
    clockless.mkdir()
    write_small(clockless)
    assert "nmea" in refuse_command(capsys, "smooth", clockless, "-o", tmp_path / "new", "--export", "gpx,nmea")
    toml('[gnss]\nfile = "gnss.csv"\nlever_arm = [0.1, 0.2, 0.3]\n', "")(clockless)
    assert "antenna" in refuse_command(
        capsys, "smooth", clockless, "-o", tmp_path / "new", "--export", "gpx", "--point", "antenna"
    )
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("what", ["export", "report", "run"])
def test_what_was_solved_is_kept_if_one_file_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    def failing(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    place = {"export": (convert, "write_parts"), "report": (report, "write_report"), "run": (outputs, "write_outcome")}
    monkeypatch.setattr(*place[what], failing)
    out = tmp_path / "out"
    out.mkdir()
    for name in ("report.html", "run.npz"):
        (out / name).write_text("of a run before")
    refuse_command(
        capsys, "smooth", "kitti", "--solver", "ekf", "--noise", "stated", "--end", "60", "-o", out, "--export", "csv"
    )
    there = {path.name for path in out.iterdir()}
    assert {"trajectory.csv", "trajectory.tum", "summary.json", "calibration.json"} <= there
    assert ("report.html" in there) == (what != "report")
    assert ("run.npz" in there) == (what != "run")
    assert all(path.read_bytes() != b"of a run before" for path in out.iterdir())
    assert len(read_trajectory(out / "trajectory.csv")) > 50


def test_a_rate_that_would_fill_the_memory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.csv").write_text("t,lat,lon,h\n0,30,114,20\n1e9,30,114,20\n")
    refuse_command(capsys, "convert", tmp_path / "x.csv", "-o", tmp_path / "x.gpx", "--rate", "1000")
