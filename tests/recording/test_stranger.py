"""Logs that nobody prepared, from nothing to a right result; and every known kind of log through `smooth`."""

from __future__ import annotations

import gzip
import json
import os
import re
import zipfile
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import logs
import numpy as np
import pytest
import stranger
from helpers import refuse_command
from test_formats_binary import write_bag, write_ubx

from graphnav.app import cli
from graphnav.app.talk import NOT_MET
from graphnav.core.notes import get_key
from graphnav.core.timescales import compute_clock_offset
from graphnav.recording.checks.overview import inspect
from graphnav.recording.densities import estimate_density_in_motion
from graphnav.recording.draft import draft
from graphnav.recording.draft.plain import read_plain
from graphnav.recording.formats import read
from graphnav.recording.formats.trajectories import read_trajectory
from graphnav.sensors.barometer import compute_standard_height

RECORDING, TRUTH = logs.simulated(60.0)
UNIX = stranger.UNIX
FAST = ("--solver", "ekf", "--noise", "stated", "--quiet")


def run(*arguments) -> None:
    """Run a command that must succeed."""
    assert cli.run([str(a) for a in arguments]) == 0


@pytest.fixture(scope="module")
def tokyo(shared_data):
    """(a part with a turn, another, a short one): of a real drive, with a fix a second and an RTK reference."""
    return stranger.cuts(shared_data / "tokyo_20201105", [(600.0, 720.0), (1200.0, 1320.0), (600.0, 660.0)])


def errors(drive: stranger.Cut, out: Path, name: str = "trajectory.csv") -> np.ndarray:
    track = read_trajectory(out / name)
    return stranger.errors(replace(track, t=track.t - stranger.UNIX), drive.reference)


def rms(x) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


# ---- three logs, from nothing


@pytest.mark.parametrize("total", [True, False])
def test_the_folder_of_a_phone(tokyo, tmp_path, capsys, total):
    """No edit: files of no sensor left out, gravity where it belongs, the date kept, the cached fix dropped."""
    drive = tokyo[0]
    folder = stranger.write_phone(tmp_path / "ride", drive, total)
    run("init", folder, "-o", folder, "--json")
    decisions = " ".join(json.loads(capsys.readouterr().out)["decisions"])
    for name in (
        "Magnetometer.csv",
        "Annotation.csv",
        "Metadata.csv",
        "Orientation.csv",
        "Gravity.csv",
    ):
        assert name in decisions
    recording = read(folder)
    assert recording.imu.t[0] == pytest.approx(stranger.UNIX + drive.recording.imu.t[0], abs=0.1)
    assert recording.gps_zero is not None
    air = recording.sensors["barometer"]
    height = np.interp(air.t - stranger.UNIX, drive.recording.gnss.t, drive.recording.gnss.llh[:, 2])
    assert rms(compute_standard_height(air) - height) < 0.3  # m, of which 0.2 are wind
    imu = drive.recording.imu
    force = np.interp(recording.imu.t - stranger.UNIX, imu.t, np.linalg.norm(imu.accel, axis=1))
    assert rms(np.linalg.norm(recording.imu.accel, axis=1) - force) < 0.1  # m/s2; between rows 2 ms apart
    if not total:
        return  # the forces are the same
    run("smooth", folder, "-o", tmp_path / "out", "--solver", "rts", "--quiet")
    checks = json.loads((tmp_path / "out" / "summary.json").read_text())["checks"]
    assert "gnss.cached" in [check["key"] for check in checks]
    assert rms(errors(drive, tmp_path / "out")) < rms(stranger.fix_errors(folder, drive))


@pytest.mark.parametrize("span", [(0.0, 120.0), (360.0, 480.0), (600.0, 780.0)])
def test_turns_that_agree_by_chance_shift_no_clock(shared_data, tmp_path, span):
    """Few turns, wrong velocities in some fixes: another turn fits better than the right one."""
    (drive,) = stranger.cuts(shared_data / "tokyo_20201105", [span])
    folder = stranger.write_phone(tmp_path / "ride", drive)
    run("init", folder, "-o", folder, "--quiet")
    assert read(folder).gnss.t[-1] == pytest.approx(stranger.UNIX + drive.recording.gnss.t[-1], abs=1.0)


def test_heights_of_a_phone_that_wander_are_not_said_to_be_in_another_unit(shared_data, tmp_path):
    (drive,) = stranger.cuts(shared_data / "tokyo_20201105", [(420.0, 600.0)])
    folder = stranger.write_phone(tmp_path / "ride", drive)
    run("init", folder, "-o", folder, "--quiet")
    found = inspect(read(folder)).findings
    assert not {"gnss.feet", "gnss.height_scale"} & {one.key for one in found}


def test_a_phone_that_has_no_fix_for_a_while(tokyo, tmp_path):
    """Its accuracies, speeds and courses are -1 then."""
    folder = stranger.write_phone(tmp_path / "ride", tokyo[0])
    head, *rows = (folder / "Location.csv").read_text().splitlines()
    names = head.split(",")
    for k in (1, 2, 3, 60, 61):
        cells = dict(zip(names, rows[k].split(","), strict=True))
        unknown = ["speed", "bearing", "speedAccuracy", "bearingAccuracy"]
        unknown += ["horizontalAccuracy", "verticalAccuracy"] if k != 60 else []
        rows[k] = ",".join((cells | dict.fromkeys(unknown, "-1.0")).values())
    (folder / "Location.csv").write_text("\n".join([head, *rows]) + "\n")
    run("init", folder, "-o", folder, "--quiet")
    gnss = read(folder).gnss
    assert len(gnss.t) == len(rows) - 4  # those of unknown place
    assert np.isnan(gnss.v).any(1).sum() == 1
    assert np.nanmedian(gnss.sd_v[:, :2]) == 0.5  # speedAccuracy


def test_a_receiver_beside_an_imu_in_other_units(tokyo, tmp_path, capsys):
    """No edit: deg/s, g and Unix milliseconds beside the GPS week of a .ubx."""
    drive = tokyo[1]
    folder = stranger.write_receiver(tmp_path / "rover", drive)
    run("init", folder, "-o", folder, "--quiet")
    assert 'units = { t = "ms", gyro = "deg/s", accel = "g" }' in (folder / "recording.toml").read_text()
    recording = read(folder)
    assert recording.gnss.t == pytest.approx(stranger.UNIX + drive.recording.gnss.t, abs=0.06)
    # the truth is of the antenna, whose place beside the IMU nobody knows
    run("smooth", folder, "-o", tmp_path / "out", "--solver", "rts", "--export", "csv", "--point", "antenna", "--quiet")
    assert rms(errors(drive, tmp_path / "out", "antenna.csv")) < 0.1


def test_a_phone_whose_forces_point_down_is_refused_until_its_unit_says_so(tokyo, tmp_path, capsys):
    """It mirrors the drive as a lost sign of the longitudes does; one fix a second, some velocities wrong."""
    drive = tokyo[1]
    (header, rows), _ = stranger.tables(drive)
    down = [[*row[:4], *(f"{-float(x):.8f}" for x in row[4:])] for row in rows]
    gnss, v = drive.recording.gnss, drive.recording.gnss.v
    moves = np.column_stack([np.hypot(*v[:, :2].T), np.degrees(np.arctan2(v[:, 0], v[:, 1])) % 360.0])
    fixes = [[f"{UNIX + t:.3f}", *(f"{x:.9f}" for x in (*np.degrees(llh[:2]), llh[2], *move))]
             for t, llh, move in zip(gnss.t, gnss.llh, moves, strict=True)]  # fmt: skip
    stranger.write_tables(tmp_path, (header, down), ("t,lat,lon,h,speed,course", fixes))
    assert cli.run(["init", str(tmp_path), "-o", str(tmp_path)]) == NOT_MET
    (refused,) = [f for f in inspect(read(tmp_path)).findings if f.severity == "refused"]
    assert refused.key == "gnss.mirrored"
    toml = tmp_path / "recording.toml"
    axes = re.search(r'and (axes = "[A-Z]{3}")', refused.sentence)[1]
    text = re.sub(r'axes = "[A-Z]{3}"', 'units = { accel = "-m/s2" }\n' + axes, toml.read_text())
    toml.write_text(text)
    run("smooth", tmp_path, "-o", tmp_path / "out", *FAST)
    assert rms(errors(drive, tmp_path / "out")) < 1.0


def test_a_motorbike_with_such_a_phone_gets_the_axes_that_are_right(shared_data):
    """A real one, that leans: nothing tells whether fixes or forces are mirrored, so both are named."""
    recording = read(shared_data / "motorbike_dresden_20160809")
    turned = np.diag([1.0, -1.0, -1.0])  # as drafted from forces that point down
    imu = replace(recording.imu, gyro=recording.imu.gyro @ turned, accel=-recording.imu.accel @ turned,
                  R_bs=turned @ recording.imu.R_bs)  # fmt: skip
    (found,) = [f for f in inspect(replace(recording, imu=imu)).findings if f.key == "imu.gyro_sign"]
    assert re.search(r'axes = "([A-Z]{3})"', found.sentence)[1] == "LBU"


def test_the_tables_of_a_spreadsheet(tokyo, tmp_path):
    """No edit: semicolons, decimal commas, German names, degrees, g, km/h, and dates, of which init makes CSV files."""
    drive = tokyo[1]
    folder = stranger.write_spreadsheet(tmp_path / "ride", drive)
    for _ in range(2):  # the second time what the first has made is there
        run("init", folder, "-o", folder, "--force", "--quiet")
        recording = read(folder)
        assert recording.imu.t == pytest.approx(drive.unix, abs=1e-3)
        assert recording.imu.gyro == pytest.approx(drive.recording.imu.gyro, abs=1e-6)
        assert recording.imu.accel == pytest.approx(drive.recording.imu.accel, abs=1e-4)
        assert np.degrees(recording.gnss.llh) == pytest.approx(np.degrees(drive.recording.gnss.llh), abs=1e-5)
        assert recording.gnss.v[:, :2] == pytest.approx(drive.recording.gnss.v[:, :2], abs=1e-3)


def test_a_fix_that_stands_in_every_row_of_the_imu_counts_once(tokyo, tmp_path):
    drive = tokyo[1]
    folder = stranger.write_one_file(tmp_path / "log", drive)
    run("init", folder, "-o", folder, "--quiet")
    recording, gnss = read(folder), drive.recording.gnss
    late = recording.gnss.t[:, None] - stranger.UNIX - gnss.t
    assert np.abs(late).min(axis=1).max() < 0.03  # a sample of the IMU; no shift of half a second
    place = np.column_stack([np.degrees(gnss.llh[:, :2]), gnss.llh[:, 2]])
    differ = 1 + np.sum((np.diff(np.round(place, 8), axis=0) != 0.0).any(axis=1))
    assert len(recording.gnss.t) == differ  # some repeat the one before at a stop


def test_stamps_in_no_order_and_names_that_state_another_unit_are_read_by_their_steps(tokyo, tmp_path):
    """Rows of the IMU shuffled; nanoseconds, of a date and since the start, in a column called t_s."""
    drive = tokyo[2]
    (head, rows), fixes = stranger.tables(drive, unix=1000.0)
    shuffled = [rows[k] for k in np.random.default_rng(2).permutation(len(rows))]
    folder = stranger.write_tables(tmp_path / "shuffled", (head, shuffled), fixes)
    run("init", folder, "-o", folder, "--quiet")
    assert read(folder).imu.t == pytest.approx(1000.0 + drive.recording.imu.t, abs=1e-6)
    for name, zero in (("date", 1.7e9), ("boot", 12.0)):
        both = [
            (head.replace("t,", "t_s,", 1), [[f"{(float(t) - 1000.0 + zero) * 1e9:.0f}", *rest] for t, *rest in rows])
            for head, rows in stranger.tables(drive, unix=1000.0)
        ]
        folder = stranger.write_tables(tmp_path / name, *both)
        run("init", folder, "-o", folder, "--quiet")
        assert read(folder).imu.t == pytest.approx(zero + drive.recording.imu.t, abs=1e-5)


def test_an_imu_that_reads_the_same_throughout_is_refused(tokyo, tmp_path, capsys):
    (head, rows), fixes = stranger.tables(tokyo[0])
    frozen = [[t, *rows[0][1:]] for t, *_ in rows]
    folder = stranger.write_tables(tmp_path, (head, frozen), fixes)
    assert cli.run(["init", str(folder), "-o", str(folder), "--quiet"]) == NOT_MET
    capsys.readouterr()
    refuse_command(capsys, "imu.frozen", "smooth", folder, "-o", tmp_path / "out", "--quiet")


def test_links_that_lead_nowhere_are_no_logs(tokyo, tmp_path):
    folder = stranger.write_tables(tmp_path, *stranger.tables(tokyo[2]))
    (folder / "old.csv").symlink_to(tmp_path / "none.csv")
    run("init", folder, "-o", folder, "--quiet")
    assert len(read(folder).imu.t) == len(tokyo[2].recording.imu.t)


def test_folders_in_a_folder_are_named(tokyo, tmp_path, capsys):
    """They are not looked into, where an export of a phone may have its parts."""
    stranger.write_tables(tmp_path / "ride" / "part 1", *stranger.tables(tokyo[2]))
    assert "part 1" in refuse_command(capsys, "draft.no_log", "init", tmp_path / "ride", "-o", tmp_path / "out")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_log_that_nobody_may_read_is_not_said_to_be_no_recording(tmp_path, capsys):
    (tmp_path / "imu.csv").write_text("t,gx,gy,gz,ax,ay,az\n")
    (tmp_path / "imu.csv").chmod(0)
    refuse_command(capsys, "file.unreadable", "info", tmp_path / "imu.csv")


def test_a_zip_is_to_be_unpacked(tmp_path, capsys):
    with zipfile.ZipFile(tmp_path / "ride.zip", "w") as archive:
        archive.writestr("imu.csv", "t,gx,gy,gz,ax,ay,az\n")
    for command in ("init", "info", "smooth"):
        more = [] if command == "info" else ["-o", tmp_path / "out"]
        refuse_command(capsys, "file.archive", command, tmp_path / "ride.zip", *more)


def _wrapped(period: float, first: float, form: str = "{:.6f}"):
    """Stamps of a clock that begins at `first` and restarts at 0 after `period`."""
    return lambda t: [form.format((first + t) % period)]


def _week(t: float) -> list[str]:
    week, second = divmod(2374 * 604800.0 - 30.0 + t, 604800.0)
    return [f"{week:.0f}", f"{second:.6f}"]


@pytest.mark.parametrize(
    ("stamp", "names", "first"),
    [
        (_wrapped(86400.0, 86370.0), "t", 86370.0),
        (_week, "GPSWeek,GPSTime", 604770.0),
        (_week, "week,tow", 604770.0),
        (lambda t: _wrapped(2.0**32, 2.0**32 - 3e7, "{:.0f}")(1e6 * t), "micros", 4264.967296),
        (lambda t: [f"{UNIX + t // 1:.0f}", f"{t % 1 * 1e9:.0f}"], "stamp.sec,stamp.nanosec", UNIX),
        (lambda t: [f'"{1e3 * (600 + t):,.1f}"'], "time ms", 600.0),
    ],
    ids=["day", "week", "tow", "32 bits", "nanoseconds", "thousands"],
)
def test_clocks_that_start_again_and_stamps_in_two_columns(tokyo, tmp_path, stamp, names, first):
    drive = tokyo[2]
    (_, imu), (_, fixes) = stranger.tables(drive, 0.0)
    both = [
        (header.replace("t,", f"{names},", 1), [[*stamp(float(t)), *rest] for t, *rest in rows])
        for header, rows in (("t,gx,gy,gz,ax,ay,az", imu), ("t,lat,lon,h", fixes))
    ]
    folder = stranger.write_tables(tmp_path / "log", *both)
    run("init", folder, "-o", folder, "--quiet")
    recording = read(folder)
    assert recording.imu.t - first == pytest.approx(drive.recording.imu.t, abs=1e-4)
    assert recording.gnss.t - first == pytest.approx(drive.recording.gnss.t, abs=1e-4)
    if names.startswith(("GPS", "week")):
        assert recording.gps_zero == 2373 * 604800.0


def test_a_folder_of_what_loggers_leave_there(tokyo, tmp_path, capsys):
    """NMEA with a terminal's times before it, a packed table with semicolons, axes in brackets; the rest is named."""
    drive = tokyo[2]
    (_, rows), _ = stranger.tables(drive, 0.0)
    text = "\n".join(["t;gyro(x);gyro(y);gyro(z);accel(x);accel(y);accel(z)", *(";".join(row) for row in rows)])
    gps = replace(drive.recording.gnss, t=drive.recording.gnss.t + logs.TOW)
    path = logs.write_nmea(tmp_path / "a.txt", replace(drive.recording, gnss=gps))
    sentences = path.read_text()
    path.write_text(
        "".join(f"[16:00:01] {line}\n" for line in sentences.splitlines()) + "[16:00:09] $GNGG" + "\0" * 900
    )
    (tmp_path / "imu.csv.gz").write_bytes(gzip.compress(text.replace(".", ",").encode()))
    (tmp_path / "ride.gpx").write_text("<gpx/>")
    run("init", tmp_path, "-o", tmp_path)
    assert "ride.gpx" in capsys.readouterr().out
    recording = read(tmp_path)
    assert recording.imu.gyro == pytest.approx(drive.recording.imu.gyro, abs=1e-6)
    assert len(recording.gnss.t) == len(drive.recording.gnss.t)


def test_a_second_of_a_drive_is_drafted(tokyo, tmp_path):
    (imu_header, imu), (header, fixes) = stranger.tables(tokyo[2])
    folder = stranger.write_tables(
        tmp_path / "log", (imu_header, imu[:30]), (header.replace("t,", "t_utc,", 1), fixes[:2])
    )
    run("init", folder, "-o", folder, "--quiet")
    recording = read(folder)
    assert (len(recording.imu.t), len(recording.gnss.t)) == (30, 2)


def test_dates_in_ms_are_told_by_their_size(tokyo, tmp_path, capsys):
    imu, (header, fixes) = stranger.tables(tokyo[2])
    folder = stranger.write_tables(tmp_path / "log", imu, (header, [[f"{1e3 * float(t):.0f}", *x] for t, *x in fixes]))
    text = '[imu]\nfile = "imu.csv"\n[gnss]\nfile = "gnss.csv"\nsd = [1.0, 1.0, 2.0]\n'
    (folder / "recording.toml").write_text(f'format = "graphnav-recording/1"\nplatform = "vehicle"\n{text}')
    assert 'units = { t = "ms" }' in refuse_command(capsys, "table.not_finite", "info", folder)


def test_one_velocity_is_no_course(tokyo, tmp_path):
    imu, (header, rows) = stranger.tables(tokyo[2])
    some = [[*row, *(("1.0", "2.0", "0.0") if k == 20 else ("", "", ""))] for k, row in enumerate(rows)]
    folder = stranger.write_tables(tmp_path / "log", imu, (f"{header},ve,vn,vu", some))
    run("init", folder, "-o", folder, "--quiet")
    assert np.isfinite(read(folder).gnss.v).all(1).sum() == 1


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ('t,x\n"600,020",0.5\n"1,600,040",1.5\n', [[600020.0, 1600040.0], [0.5, 1.5]]),
        ('t,x\n"600,020",5\n"600,040",6\n', [[600020.0, 600040.0], [5.0, 6.0]]),
        ("t;x\n600.020,5;-0,25\n600.040,5;1,5\n", [[600020.5, 600040.5], [-0.25, 1.5]]),
        ("t;x\n600,020;5\n600,040;6\n", [[600.02, 600.04], [5.0, 6.0]]),
        ("t;x\n1'600'020;1.5\n1'600'040;2.5\n", [[1600020.0, 1600040.0], [1.5, 2.5]]),
        ("t;x\n600\u00a0020,5;1,5\n600\u00a0040,5;2,5\n", [[600020.5, 600040.5], [1.5, 2.5]]),
    ],
)
def test_marks_between_thousands_are_no_decimal_marks(tmp_path, text, numbers):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    assert [x.tolist() for x in read_plain(tmp_path / "a.csv").columns.values()] == numbers


@pytest.mark.parametrize("end", [b"\n12.5,0.", b"\n12.5" + bytes(5000), b"\n" + bytes(5000), b""])
def test_a_log_that_a_loss_of_power_ended_is_read_to_there(tokyo, tmp_path, end):
    drive = tokyo[2]
    folder = stranger.write_tables(tmp_path / "log", *stranger.tables(drive), end=end)
    run("init", folder, "-o", folder, "--quiet")
    for made in folder.glob("*-*.csv.gz"):  # the file itself, as a description by hand has it
        made.unlink()
    text = (folder / "recording.toml").read_text()
    (folder / "recording.toml").write_text(
        text.replace("imu-imu.csv.gz", "imu.csv").replace("gnss-gnss.csv.gz", "gnss.csv")
    )
    recording = read(folder)
    assert len(recording.imu.t) == len(drive.recording.imu.t)
    assert len(recording.gnss.t) == len(drive.recording.gnss.t)
    assert {"imu.cut", "gnss.cut"} <= set(map(get_key, recording.remarks)) or end == b""


@pytest.mark.parametrize("count", [3, 300])  # within a cell, over several
def test_zeros_in_the_middle_of_a_log_are_named(tokyo, tmp_path, capsys, count):
    folder = stranger.write_tables(tmp_path / "log", *stranger.tables(tokyo[2]))
    data = (folder / "imu.csv").read_bytes()
    half = data.index(b".", len(data) // 2) + 1
    (folder / "imu.csv").write_bytes(data[:half] + bytes(count) + data[half + count :])
    assert "imu.csv, line " in refuse_command(capsys, "table.fields", "init", folder, "-o", folder)


def test_places_that_are_none_are_no_fixes(tokyo, tmp_path):
    drive = tokyo[2]
    imu, (header, rows) = stranger.tables(drive)
    none = [[t, *(["-9999"] * 3)] if k % 7 == 3 else [t, *rest] for k, (t, *rest) in enumerate(rows)]
    folder = stranger.write_tables(tmp_path / "none", imu, (header, none))
    run("init", folder, "-o", folder, "--quiet")
    assert len(read(folder).gnss.t) == sum(row[1] != "-9999" for row in none)


def test_stamps_that_are_no_times_and_files_that_are_not_read_are_named(tokyo, tmp_path, capsys):
    imu, fixes = stranger.tables(tokyo[2])
    folder = stranger.write_tables(tmp_path / "one", (imu[0], [["1.751990e9", *rest] for _, *rest in imu[1]]), fixes)
    assert "imu.csv, column 't'" in refuse_command(capsys, "table.times_repeated", "init", folder, "-o", folder)
    stranger.write_tables(folder, (imu[0].replace("t,", "tick tock,", 1), imu[1]), fixes)
    assert "tick tock" in refuse_command(capsys, "draft.no_imu", "init", folder, "-o", folder)
    stranger.write_tables(folder, (imu[0], [["a while ago;", *rest] for _, *rest in imu[1]]), fixes)
    assert "imu.csv" in refuse_command(capsys, "table.cell", "init", folder, "-o", folder)
    (folder / "imu.csv").rename(folder / "imu.parquet")
    assert "imu.parquet" in refuse_command(capsys, "draft.no_imu", "init", folder, "-o", folder)


@pytest.mark.parametrize(
    ("text", "unix"),
    [
        ("2025-07-09T01:00:00.040+09:00", 1751990400.04),
        ("2025-07-08T16:00:00Z", 1751990400.0),
        ("2025-07-08 16:00:00.5", 1751990400.5),
        ("08.07.2025 16:00:00,25", 1751990400.25),
        ("2025/7/8 16:00:00", 1751990400.0),
        ("08-Jul-2025 16:00:00.250", 1751990400.25),
        ("20250708T160000.250Z", 1751990400.25),
    ],
)
def test_dates_are_unix_time(tmp_path, text, unix):
    (tmp_path / "a.csv").write_text(f"time;x\n{text};1,5\n{text};2,5\n;3,5\n")
    found = read_plain(tmp_path / "a.csv")
    assert found.columns["time"] == pytest.approx([unix, unix, np.nan], abs=1e-6, nan_ok=True)
    assert found.columns["x"].tolist() == [1.5, 2.5, 3.5]


def test_words_with_dates_do_not_stop_a_draft_and_what_is_no_table_is_named(tokyo, tmp_path, capsys):
    folder = stranger.write_spreadsheet(tmp_path / "ride", tokyo[1])
    (folder / "notes.csv").write_text("time,text\n2025-07-08T16:00:00Z,a turn\n2025-07-08T16:00:09Z,left, then right\n")
    run("init", folder, "-o", folder, "--quiet")
    before = read(folder).imu
    (folder / "imu.csv").write_bytes((folder / "imu.csv").read_text("utf-8").encode("utf-16"))
    run("init", folder, "-o", folder, "--force", "--quiet")
    assert np.array_equal(read(folder).imu.accel, before.accel)
    (folder / "imu.csv").write_bytes(bytes(range(256)) * 50)
    said = refuse_command(capsys, "draft.no_imu", "init", folder, "-o", folder, "--force", "--quiet")
    assert "imu.csv" in said


def test_a_table_of_numbers_is_left_as_it_is(tmp_path):
    for text in ("t,x\n1,2\n2,3\n", "t,x\n1,\n2,3\n", "t\n1\n2\n", "a,b\nword,1\nother,2\n", ""):
        (tmp_path / "a.csv").write_text(text)
        assert read_plain(tmp_path / "a.csv") is None


def test_a_bag_with_two_imus(tokyo, tmp_path, capsys):
    """One choice: which of the two; by key or flag, and known by name."""
    drive = tokyo[2]
    bag = stranger.write_bag(tmp_path / "bag", drive)
    assert 'topic = "/camera/imu"' in draft([bag], tmp_path).text  # it has more messages
    run("init", bag, "-o", tmp_path / "bag.toml", "--topic", "/imu/data", "--quiet")
    assert 'axes = "FLU"' in (tmp_path / "bag.toml").read_text()
    by_key, by_flag = read(tmp_path / "bag.toml"), read(bag, ["/imu/data"])
    assert np.array_equal(by_key.imu.gyro, by_flag.imu.gyro)
    assert by_key.imu.t == pytest.approx(stranger.UNIX + drive.recording.imu.t, abs=1e-5)
    run("smooth", tmp_path / "bag.toml", "-o", tmp_path / "out", *FAST)
    assert rms(errors(drive, tmp_path / "out")) < 0.1
    assert by_flag.imu.noise_assumed  # without covariances: measured where a recording is made of it
    run("convert", bag, "-o", tmp_path / "converted", "--topic", "/imu/data", "--quiet")
    noise = read(tmp_path / "converted").imu.noise
    for stated, x in ((noise.gyro_noise_density, by_flag.imu.gyro), (noise.accel_noise_density, by_flag.imu.accel)):
        assert stated == pytest.approx(estimate_density_in_motion(by_flag.imu.t, x), rel=0.05)
    capsys.readouterr()  # doubts about a minute's sigmas
    assert "/imu/data" in refuse_command(capsys, "log.topic_unknown", "info", bag, "--topic", "/imu/dat")


# ---- every kind of log


def _bag(kind):
    return lambda folder: write_bag(folder / ("a.bag" if kind == "bag" else "a"), kind)


def _joined(write):
    """A log of fixes beside an IMU as CSV, through init."""

    def make(folder: Path) -> Path:
        imu = RECORDING.imu
        table = np.column_stack([logs.TOW + imu.t, imu.gyro, imu.accel])
        np.savetxt(folder / "imu.csv", table, "%.9f", ",", header="t,gx,gy,gz,ax,ay,az", comments="")
        run("init", folder / "imu.csv", write(folder), "-o", folder / "recording.toml", "--quiet")
        return folder

    return make


@pytest.mark.parametrize(
    "make",
    [
        lambda folder: logs.write_kf_gins(folder / "drive", RECORDING, TRUTH),
        lambda folder: logs.write_kitti(folder, RECORDING, TRUTH),
        lambda folder: write_ubx(folder / "a.ubx"),
        _joined(lambda folder: logs.write_nmea(folder / "a.nmea", RECORDING)),
        _joined(lambda folder: logs.write_rtklib(folder / "a.pos", RECORDING)),
        _bag("bag"), _bag("db3"),
    ],
    ids=["kf-gins", "kitti-raw", "ubx", "nmea", "rtklib", "ros 1", "ros 2"],
)  # fmt: skip
def test_every_kind_of_log_is_solved(tmp_path, make):
    source = make(tmp_path)
    run("smooth", source, "-o", tmp_path / "out", *FAST)
    track = read_trajectory(tmp_path / "out" / "trajectory.csv")
    # exact fixes 0.9 m above and half a metre ahead of the IMU, whose lever arm few of the logs hold
    frame = np.array([1.0, np.cos(TRUTH.llh[0, 0])]) * 6.37e6
    nearest = np.abs(TRUTH.llh[:, None, :2] - track.llh[None, ::5, :2]) * frame
    assert np.linalg.norm(nearest, axis=-1).min(0).max() < 1.5
    inputs = json.loads((tmp_path / "out" / "summary.json").read_text())["provenance"]["inputs"]
    assert inputs
    assert all(len(digest) == 64 for digest in inputs.values())


# ---- what is behind


def test_a_topic_of_what_is_no_bag_is_one_line(tmp_path, capsys):
    path = logs.write_rtklib(tmp_path / "a.pos", RECORDING)
    assert "--topic /a" in refuse_command(
        capsys, "option.not_here", "convert", path, "-o", tmp_path / "out", "--topic", "/a"
    )
    logs.write_kf_gins(tmp_path, RECORDING, TRUTH)
    text = 'format = "graphnav-recording/1"\nplatform = "vehicle"\n[imu]\nfile = "imu.txt"\ntopic = "/a"\n'
    (tmp_path / "recording.toml").write_text(text)
    assert "imu.topic" in refuse_command(capsys, "key.not_here", "info", tmp_path)


@pytest.mark.parametrize(
    ("t", "zero", "u", "other", "offset"),
    [
        # 10 March 2022, 0:00:00 GPS time: week 2200, 345600 s; 18 s earlier in UTC
        (1646870382.0, None, 345600.0, None, 1646870382.0 - 345600.0),
        (345600.0, None, 1646870382.0, None, 345600.0 - 1646870382.0),
        (1646870382.0, None, 345600.0, 2200 * 604800.0, 1646870382.0 - 345600.0),
        (345600.0, 2200 * 604800.0, 0.0, 2200 * 604800.0 + 345600.0, 345600.0),
        (1646870382.0, None, 1646870382.5, None, None), (0.0, None, 345600.0, None, None),
    ],
)  # fmt: skip
def test_what_lies_between_clocks_that_are_known(t, zero, u, other, offset):
    found = compute_clock_offset(t, zero, u, other)
    assert (found and found.offset) == (None if offset is None else pytest.approx(offset, abs=1e-6))


def test_advice_is_for_the_log_at_hand(tmp_path):
    """Numbers of types are a matter of CSV files, and keys of a recording.toml."""
    bag = write_bag(tmp_path / "a", "db3")
    found = inspect(replace(read(bag), imu=replace(RECORDING.imu, t=read(bag).imu.t, accel=-RECORDING.imu.accel)))
    assert "recording.log" in [f.key for f in found.findings]
    assert not any("type = " in f.sentence for f in found.findings)  # a key of recording.toml


# ---- tables as loggers write them

ROWS = ["16:00:00.5", "16:00:00.7", "16:00:01.0"]
NOON, UNIX_DAY = 57600.5, 1751932800.0


@pytest.mark.parametrize(
    ("text", "t"),
    [
        ("time  x\n" + "\n".join(f"{row}   1.5" for row in ROWS), NOON),
        ("# time x\n" + "\n".join(f"{row} 1.5" for row in ROWS), NOON),
        ("% a log\n% time x\n" + "\n% again\n".join(f"{row} 1.5" for row in ROWS), NOON),
        ("time\tx\n" + "\n".join(f"{row}\t1.5".replace(".", ",") for row in ROWS), NOON),
        ("time;x;\n" + "\n".join(f"{row};1,5;" for row in ROWS), NOON),
        ("time;x\n" + "\n".join(f"{row};1,5;" for row in ROWS), NOON),
        ("time;x\ns;m\n" + "\n".join(f"{row};1,5" for row in ROWS), NOON),
        ("time,x\n" + "\n".join(f'"{row}","1,5"' for row in ROWS), NOON),
        ("time,x\n" + "\n".join(f"0{row[1:].replace('6', '4', 1)} PM, 1.5" for row in ROWS), NOON),
        ("time,x\n" + "\n".join(f"{row.replace('.', ':')}00,1.5" for row in ROWS), NOON),
        ("Logger 3\nDate: 08.07.2025\n\ntime;x\n" + "\n".join(f"{row};1,5" for row in ROWS), UNIX_DAY + NOON),
        ("time x\n" + "\n".join(f"2025-07-08 {row} 1.5" for row in ROWS), UNIX_DAY + NOON),
        ("date|time|x\n" + "\n".join(f"2025/7/8|{row}|1.5" for row in ROWS), UNIX_DAY + NOON),
        ("time,x\n" + "\n".join(f"07/13/2025 {row},1.5" for row in ROWS), UNIX_DAY + 5 * 86400.0 + NOON),
        ("time,x\n" + "\n".join(f"07/08/2025 {row},1.5" for row in ROWS), NOON),  # of which month nobody knows
        ("zeit;größe\n" + "\n".join(f"{row};1,5" for row in ROWS), NOON),
    ],
)
def test_tables_of_loggers_are_read(tmp_path, text, t):
    (tmp_path / "a.txt").write_text(text + "\n", encoding="cp1252")
    found = read_plain(tmp_path / "a.txt")
    named = {name.partition(" ")[0]: x for name, x in found.columns.items()}
    assert named.pop((found.dated or found.daily).partition(" ")[0]) == pytest.approx(
        t + np.array([0.0, 0.2, 0.5]), abs=1e-6
    )
    assert [x.tolist() for name, x in named.items() if name not in ("", "time", "date")] == [[1.5] * 3]
    assert (found.dated is None) == (t == NOON)


def test_times_of_day_go_on_after_midnight_and_take_the_date_of_another_log(tokyo, tmp_path):
    drive = tokyo[1]
    late = drive.unix + 7.5 * 3600.0 + 1740.0  # midnight comes a minute later
    imu, gnss = drive.recording.imu, drive.recording.gnss

    def clock(x: float, form: str) -> str:
        return f"{datetime.fromtimestamp(round(x, 3), UTC):{form}}"[:-3]

    rows = [
        " ".join([clock(x, "%H%M%S.%f"), *map(repr, [*w, *f])])
        for x, w, f in zip(late, imu.gyro.tolist(), imu.accel.tolist(), strict=True)
    ]
    (tmp_path / "imu.txt").write_text("time gx gy gz ax ay az\n" + "\n".join(rows) + "\n")
    at = gnss.t + late[0] - imu.t[0]
    places = np.column_stack([np.degrees(gnss.llh[:, :2]), gnss.llh[:, 2]]).tolist()
    rows = [";".join([clock(x, "%d.%m.%Y %H:%M:%S.%f"), *map(repr, row)]) for x, row in zip(at, places, strict=True)]
    (tmp_path / "gps.txt").write_text("time;lat;lon;h\n" + "\n".join(rows) + "\n")
    run("init", tmp_path, "-o", tmp_path, "--quiet")
    recording = read(tmp_path)
    assert recording.imu.t == pytest.approx(late, abs=2e-3)
    assert recording.gnss.t == pytest.approx(at, abs=2e-3)


def test_what_a_description_states_is_not_said_to_be_assumed(tokyo, tmp_path):
    stranger.write_bag(tmp_path / "bag", tokyo[0])
    text = 'format = "graphnav-recording/1"\nplatform = "vehicle"\n'
    text += '[imu]\nfile = "bag"\ntopic = "/imu/data"\n'
    assumed = {"imu.axes_assumed", "gnss.lever_arm_unknown"}
    for imu, gnss, said in (("", "", assumed), ('axes = "FLU"\n', "lever_arm = [0.0, 0.0, 0.9]\n", set())):
        (tmp_path / "a.toml").write_text(f'{text}{imu}[gnss]\nfile = "bag"\n{gnss}')
        assert {get_key(r) for r in read(tmp_path / "a.toml").remarks} & assumed == said
