"""The program as people run it: exit codes, sentences, and the files with the columns and keys they are promised."""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from helpers import refuse_command, run_here

from graphnav import load
from graphnav.app import cli, stored, workflow
from graphnav.app.withholding import parse_withheld
from graphnav.estimation.noise.files import write_noise
from graphnav.estimation.noise.model import NoiseModel
from graphnav.report.plots.detections import select_drawn_rows
from graphnav.sensors.barometer import SENSOR as BAROMETER

PROGRAM = Path(sys.executable).with_name("graphnav")
SOLVERS = ("ekf", "rts", "batch")
TRAJECTORY_COLUMNS = (
    "t,lat,lon,h,ve,vn,vu,roll,pitch,heading,sd_e,sd_n,sd_u,sd_ve,sd_vn,sd_vu,sd_roll,sd_pitch,sd_heading,"
    "bgx,bgy,bgz,bax,bay,baz"
)
WITHHELD = (30.0, 45.0)  # s from the start, long before the drive's own outage
FILES = {
    "trajectory.csv", "trajectory.kml", "trajectory.gpx", "trajectory.tum", "calibration.json", "detections.csv",
    "summary.json", "report.html",
}  # fmt: skip


def program(*arguments):
    """Run the installed program in a process of its own, where that is the point."""
    words = [str(PROGRAM), *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, timeout=300)


def command(*arguments):
    """The same within this process, which has imported everything already: its exit code."""
    return cli.run([str(x) for x in arguments])


def rows(path):
    with Path(path).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def summary(folder):
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def benchmark():
    """scripts/benchmark.py, which writes drives of another simulator as recording folders."""
    path = Path(__file__).resolve().parents[2] / "scripts" / "benchmark.py"
    spec = importlib.util.spec_from_file_location("benchmark", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["benchmark"] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def drive(benchmark, tmp_path_factory):
    """240 s with 60 s without fixes, wheel speed and truth."""
    return benchmark.build(tmp_path_factory.mktemp("drives"), 240 / 3600)


@pytest.fixture(scope="session")
def compared(drive, tmp_path_factory):
    """One run of compare that several tests look at: (folder, exit code and what it printed)."""
    out = tmp_path_factory.mktemp("out") / "deep" / "compared"
    span = f"gnss:{WITHHELD[0]:g}-{WITHHELD[1]:g}"
    return out, run_here("compare", drive, "--without", span, "--without", "odometer", "--noise", "stated", "-o", out)


# ------------------------------------------------------------------------------------------------------------- compare
def test_compare_succeeds_and_says_where_to_look(compared):
    out, run = compared
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
    assert f"  {out / 'comparison.html'}" in run.stdout.splitlines()
    for solver in SOLVERS:
        assert any(line.split()[:1] == [solver] for line in run.stdout.splitlines())
    assert "detections.csv" in run.stdout


def test_compare_writes_what_it_promises(compared):
    out, _ = compared
    assert {p.name for p in out.iterdir()} == {*SOLVERS, "comparison.csv", "comparison.html", "run.npz"}
    for solver in SOLVERS:
        assert {p.name for p in (out / solver).iterdir()} == FILES
        assert (out / solver / "trajectory.csv").read_text().splitlines()[0] == TRAJECTORY_COLUMNS
        found = rows(out / solver / "detections.csv")
        assert [list(found[0]), found[-1]["detector"]] == [["start", "end", "detector", "fired", "rows"], "fused"]
        each = summary(out / solver)["stationary"]["each"]
        assert [row["fired"].split(":")[0] for row in found if row["fired"]] == [next(iter(s["fired"])) for s in each]
        for row, stop in zip([row for row in found if row["rows"]], each, strict=True):
            assert row["rows"] == " ".join(f"{name}:{count}" for name, count in stop["rows"].items())
            assert set(stop["rows"]) == {"zero_velocity", "zero_rate", "held_position"}
            assert stop["rows"]["held_position"] == stop["rows"]["zero_velocity"]
        assert "<html" in (out / solver / "report.html").read_text(encoding="utf-8")


def test_trajectory_has_a_full_row_for_every_keyframe(compared):
    out, _ = compared
    for solver in SOLVERS:
        table = rows(out / solver / "trajectory.csv")
        values = np.array([[float(x) for x in row.values()] for row in table])
        assert len(table) == summary(out / solver)["keyframes"]
        assert np.isfinite(values).all()
        assert (np.diff(values[:, 0]) > 0).all()


def test_summary_holds_its_keys_and_agrees_with_the_other_files(compared, drive):
    out, _ = compared
    for solver in SOLVERS:
        s = summary(out / solver)
        assert set(s) >= {
            "solver", "recording", "duration_s", "keyframes", "counts", "iterations", "stopped", "final_cost",
            "timings", "peak_memory_mb", "errors", "spans", "nees", "parameters", "notes", "remarks", "settings",
            "provenance",
        }  # fmt: skip
        assert s["solver"] == solver
        assert s["duration_s"] == pytest.approx(240.0, abs=1e-6)
        assert set(s["timings"]) >= {"reading", "alignment", "preintegration", "filter", "writing", "report"}
        assert s["peak_memory_mb"] > 50
        assert not any("odometer" in kind for kind in s["counts"])  # it was withheld
        files = {Path(path).name: digest for path, digest in s["provenance"]["inputs"].items()}
        for name in ("recording.toml", "imu.csv", "gnss.csv", "odometer.csv", "truth.csv"):
            assert files[name] == hashlib.sha256((drive / name).read_bytes()).hexdigest()
        assert s["provenance"]["options"]["without"] == ["gnss:30-45", "odometer"]
    assert summary(out / "batch")["iterations"] >= 1
    assert "covariances" in summary(out / "batch")["timings"]


def test_spans_are_the_withheld_one_and_the_outage_that_was_there(compared, drive):
    out, _ = compared
    t = np.array([float(row["t"]) for row in rows(drive / "gnss.csv")])
    start = float(rows(drive / "imu.csv")[0]["t"]) - 1 / 200
    last = t[np.argmax(np.diff(t))] - start
    spans = summary(out / "batch")["spans"]
    assert [s["missing"] for s in spans] == ["without gnss", "no GNSS"]
    assert (spans[0]["start_s"], spans[0]["end_s"]) == WITHHELD
    assert spans[1]["start_s"] == pytest.approx(last, abs=1e-4)
    assert spans[1]["end_s"] == pytest.approx(last + np.diff(t).max() - 1.0, abs=1e-4)
    for span in spans:
        assert 0 < span["end_h_m"] <= span["max_h_m"]


def test_comparison_csv_has_a_row_per_solver_with_the_numbers_of_the_summaries(compared):
    out, _ = compared
    table = rows(out / "comparison.csv")
    assert [row["solver"] for row in table] == list(SOLVERS)
    for row in table:
        s = summary(out / row["solver"])
        assert float(row["h_rms_m"]) == s["errors"]["h_rms_m"]
        assert float(row["span2_max_h_m"]) == s["spans"][1]["max_h_m"]
        assert float(row["run_time_s"]) > 0


def test_of_a_run_over_a_comparison_its_own_page_is_drawn_again(tmp_path):
    part = ["kitti", "-o", str(tmp_path), "--solver", "ekf", "--noise", "stated", "--end", "30", "--quiet"]
    assert cli.run(["compare", *part]) == 0
    assert cli.run(["smooth", *part]) == 0
    before = (tmp_path / "report.html").read_bytes()
    (tmp_path / "report.html").unlink()
    assert cli.run(["report", str(tmp_path), "--quiet"]) == 0
    assert (tmp_path / "report.html").read_bytes() == before


def test_the_pages_are_drawn_again_without_solving(compared, tmp_path, capsys):
    out = tmp_path / "again"
    shutil.copytree(compared[0], out)
    pages = ["comparison.html", *(f"{solver}/report.html" for solver in SOLVERS)]
    before = [(out / page).read_bytes() for page in pages]
    for page in pages:
        (out / page).unlink()
    assert cli.run(["report", str(out), "--quiet"]) == 0
    assert [(out / page).read_bytes() for page in pages] == before
    kept = np.load(out / "run.npz")["text"].tobytes().decode()
    arrays = {k: v for k, v in np.load(out / "run.npz").items() if k != "text"}
    outside = kept.replace('["ekf", {"class"', '["../../ekf", {"class"').encode()
    assert outside != kept.encode()
    damaged = bytearray((compared[0] / "run.npz").read_bytes())
    for k in range(1000, len(damaged), 997):
        damaged[k] ^= 1 << k % 8
    for text in (b"[1]", b"[" * 100_000, b"\xff", b"{}", outside):
        np.savez(out / "run.npz", text=np.frombuffer(text, dtype=np.uint8), **arrays)
        assert cli.run(["report", str(out)]) == 2
        said = capsys.readouterr().err
        assert "run.npz" in said
    assert "../../ekf" in said
    empty = {k: np.atleast_1d(v)[:0] for k, v in arrays.items()}
    np.savez(out / "run.npz", text=np.frombuffer(kept.encode(), dtype=np.uint8), **empty)  # which do not fit together
    assert cli.run(["report", str(out)]) == 2
    assert "run.npz" in capsys.readouterr().err
    for data in (b"PK", bytes(damaged)):
        (out / "run.npz").write_bytes(data)
        assert cli.run(["report", str(out)]) == 2
        assert "run.npz" in capsys.readouterr().err


def test_a_recording_is_kept_as_far_as_its_pages_show_it(drive):
    """The same rows are drawn of it, and its sensors are there."""
    whole = load(drive)
    height = BAROMETER.make_series(whole.gnss.t, {"height": whole.gnss.llh[:, 2]})
    whole = replace(whole, sensors={"barometer": height})
    arrays = []
    packed = json.dumps(stored._pack(stored._thin_recording(whole), arrays))
    kept = stored._unpack(json.loads(packed), arrays)
    assert len(kept.imu.t) < len(whole.imu.t)
    assert (kept.start, kept.end, kept.gps_zero) == (whole.start, whole.end, whole.gps_zero)
    for one in ("t", "gyro", "accel"):
        drawn = [getattr(r.imu, one)[select_drawn_rows(r.imu)] for r in (kept, whole)]
        assert np.array_equal(*drawn)
    assert np.array_equal(kept.gnss.llh, whole.gnss.llh)
    assert np.array_equal(kept.sensors["barometer"].values, height.values, equal_nan=True)


def test_solvers_differ_where_they_should(compared):
    """The same information, but only the filter has not seen the other side of the outage."""
    out, _ = compared
    worst = {solver: summary(out / solver)["spans"][1]["max_h_m"] for solver in SOLVERS}
    assert worst["batch"] < worst["ekf"]
    assert worst["rts"] < worst["ekf"]


# ------------------------------------------------------------------------------------------------------------ evaluate
def test_evaluate_finds_the_errors_that_subtraction_finds(compared, drive, tmp_path, capsys):
    """On a sphere of 6371 km, which at this latitude is wrong by less than 0.4 %."""
    out, _ = compared
    assert command("evaluate", out / "batch" / "trajectory.csv", drive, "--json", "-o", tmp_path / "e") == 0
    values = json.loads(capsys.readouterr().out)
    mine, true = (
        {round(float(row["t"]), 3): (float(row["lat"]), float(row["lon"])) for row in rows(path)}
        for path in (out / "batch" / "trajectory.csv", drive / "truth.csv")
    )
    assert values["n"] == len(mine)
    written = {round(float(row["t"]), 3): (float(row["east"]), float(row["north"])) for row in
               rows(tmp_path / "e" / "errors.csv")}  # fmt: skip
    both = sorted(set(mine) & set(true) & set(written))  # the ends of stops fall between the truth's rows
    assert len(both) > 150
    d = np.radians([np.subtract(mine[t], true[t]) for t in both]) * 6371e3
    off = np.array([written[t] for t in both])
    assert off[:, 1] == pytest.approx(d[:, 0], rel=5e-3, abs=1e-5)
    assert off[:, 0] == pytest.approx(d[:, 1] * np.cos(np.radians(30.5)), rel=5e-3, abs=1e-5)
    assert json.loads((tmp_path / "e" / "evaluation.json").read_text()) == values
    all_east = [east for east, _ in written.values()]
    assert np.sqrt(np.mean(np.square(all_east))) == pytest.approx(values["e_rms_m"], rel=1e-4)


def test_evaluate_prints_a_table_and_writes_nothing_unasked(compared, tmp_path, monkeypatch, capsys):
    out, _ = compared
    one = out / "batch" / "trajectory.csv"
    monkeypatch.chdir(tmp_path)
    assert command("evaluate", one, one) == 0
    assert "horizontal" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


# -------------------------------------------------------------------------------------------------------------- smooth
def test_smooth_a_part_of_a_real_drive_without_fixes_in_a_span(tmp_path):
    part = ["--start", 100, "--end", 220, "--without", "gnss:150-170", "--noise", "stated"]
    assert command("smooth", "kitti", *part, "-o", tmp_path, "--solver", "rts") == 0
    assert {p.name for p in tmp_path.iterdir()} == {*FILES, "run.npz"}
    s = summary(tmp_path)
    assert (s["solver"], s["against"]) == ("rts", "the withheld GNSS fixes")
    (span,) = s["spans"]
    assert (span["missing"], span["start_s"], span["end_s"]) == ("without gnss", 150.0, 170.0)
    assert s["errors"]["n"] == span["n"] == 20  # one fix a second
    t = [float(row["t"]) for row in rows(tmp_path / "trajectory.csv")]
    assert t[-1] - t[0] == pytest.approx(120.0, abs=1.0)


def test_quiet_is_silent_and_a_config_file_counts(drive, tmp_path, capfd):
    config = tmp_path / "settings.toml"
    config.write_text("[keyframes]\nrate = 2.0\n")
    quiet = ["--quiet", "--config", config, "--noise", "stated"]
    assert command("smooth", drive, *quiet, "--end", 120, "--solver", "ekf", "-o", tmp_path / "o") == 0
    assert capfd.readouterr() == ("", "")
    s = summary(tmp_path / "o")
    assert s["settings"]["keyframes"]["rate"] == 2.0
    assert s["keyframes"] == pytest.approx(240, abs=5)


def test_a_result_that_cannot_be_trusted_is_told_quiet_or_not(drive, tmp_path, capfd):
    """Sigmas a hundred times too small, and nothing estimated."""
    bold = tmp_path / "bold"
    shutil.copytree(drive, bold)
    fixes = rows(bold / "gnss.csv")
    small = [{k: str(0.01 * float(x)) if k.startswith("sd_") else x for k, x in row.items()} for row in fixes]
    lines = [",".join(row.values()) for row in small]
    (bold / "gnss.csv").write_text("\n".join([",".join(small[0]), *lines]) + "\n")
    asked = ["smooth", bold, "--noise", "stated", "--solver", "ekf", "--end", 120, "--no-report", "-o", tmp_path / "o"]
    assert command(*asked) == 0
    loud = capfd.readouterr()
    assert command(*asked, "--quiet") == 0
    quiet = capfd.readouterr()
    doubts = summary(tmp_path / "o")["doubts"]
    assert doubts
    assert (loud.err, quiet.out) == ("", "")
    told = [line.removeprefix("graphnav: ") for line in quiet.err.splitlines()]
    assert told == loud.out.splitlines()[: len(doubts)]


def test_rate_is_that_of_the_output(tmp_path):
    part = ["kitti", "--end", "60", "--noise", "stated", "--solver", "rts", "--quiet"]
    assert cli.run(["smooth", *part, "--rate", "20", "-o", str(tmp_path)]) == 0
    t = np.array([float(row["t"]) for row in rows(tmp_path / "trajectory.csv")])
    assert np.diff(t)[1:-1] == pytest.approx(0.05, abs=1e-5)  # both ends of the drive are there as well
    assert t[-1] - t[0] == pytest.approx(60.0, abs=0.1)
    assert summary(tmp_path)["keyframes"] < 100


def test_a_run_is_repeated_from_the_provenance_of_its_report_alone(drive, tmp_path, monkeypatch):
    config = tmp_path / "mine.toml"
    config.write_text('[noise]\nmode = "stated"\n[gnss]\nrobust = "huber"\n[keyframes]\nrate = 2.0\n', encoding="utf-8")
    part = ["--start", "10", "--end", "90", "--without", "gnss:40-60", "--without", "odometer", "--rate", "5"]
    assert command("smooth", drive, "--solver", "rts", *part, "--config", config, "-o", tmp_path / "out") == 0
    html = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    config.unlink()
    words, settings = (unescape(re.search(f'<pre id="{key}">(.*?)</pre>', html, re.S).group(1))
                       for key in ("command", "settings"))  # fmt: skip
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "settings.toml").write_text(settings, encoding="utf-8")
    name, *arguments = shlex.split(words)
    assert name == "graphnav"
    monkeypatch.chdir(elsewhere)
    assert command(*arguments) == 0
    track, again = (folder / "trajectory.csv" for folder in (tmp_path / "out", elsewhere / "again"))
    assert again.read_bytes() == track.read_bytes()
    # and that needed the settings: without them it is another trajectory
    assert command(*arguments[: arguments.index("--config")], "-o", "plain") == 0
    assert (elsewhere / "plain" / "trajectory.csv").read_bytes() != track.read_bytes()


@pytest.mark.skipif(sys.platform != "linux", reason="a second process is begun on Linux only")
def test_with_a_second_processor_the_results_are_the_same(tmp_path, monkeypatch):
    found = []
    for processors in (1, 2):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, n=processors: set(range(n)))
        out = tmp_path / str(processors)
        assert cli.run(["compare", "kitti", "--end", "60", "--quiet", "-o", str(out)]) == 0
        assert all((out / solver / "report.html").exists() for solver in SOLVERS)
        tracks = [(out / solver / "trajectory.csv").read_bytes() for solver in SOLVERS]
        noise = [summary(out / solver)["noise"] for solver in SOLVERS]
        found.append((tracks, noise, sorted(str(path.relative_to(out)) for path in out.rglob("*"))))
    assert found[0] == found[1]


def test_a_run_is_repeated_with_the_noise_model_of_its_summary(tmp_path):
    """Byte for byte, on a part of a real drive; and the noise model matters."""
    tokyo = Path(__file__).resolve().parents[2] / "data" / "tokyo"
    smooth = ["smooth", str(tokyo), "--end", "40", "--quiet"]
    given = str(tmp_path / "first" / "summary.json")
    assert cli.run([*smooth, "-o", str(tmp_path / "first")]) == 0
    assert cli.run([*smooth, "--noise", given, "-o", str(tmp_path / "again")]) == 0
    assert cli.run([*smooth, "--noise", "stated", "-o", str(tmp_path / "stated")]) == 0
    first, again, stated = ((tmp_path / name / "trajectory.csv").read_bytes() for name in ("first", "again", "stated"))
    assert again == first
    assert stated != first
    one, other, plain = (summary(tmp_path / name) for name in ("first", "again", "stated"))
    assert other["noise"] == one["noise"]
    assert (one["provenance"]["noise"], other["provenance"]["noise"]) == ("estimated", given)
    assert other["provenance"]["inputs"][given] == hashlib.sha256(Path(given).read_bytes()).hexdigest()
    assert (plain["provenance"]["noise"], plain["settings"]["noise"]["mode"]) == ("stated", "stated")
    assert plain["noise"]["figures"] == {}
    assert other["passes"]["filter"] < one["passes"]["filter"]
    assert one["passes"]["eliminations"] == one["iterations"] > 0
    # what was used is what is stated times the factor
    assert {"imu.gyro_noise_density", "gnss_position.up", "odometer.forward"} <= set(one["noise"]["figures"])
    for group, figure in one["noise"]["figures"].items():
        assert figure["variance_factor"] == pytest.approx(np.exp(figure["log_factor"]))
        if group.startswith(("imu", "gnss")) and group != "gnss_position.stamps":
            assert figure["used"] == pytest.approx(figure["stated"] * np.sqrt(figure["variance_factor"]))
    with (tokyo / "recording.toml").open("rb") as file:
        says = tomllib.load(file)["imu"]["noise"]["gyro_noise_density"]
    assert one["noise"]["figures"]["imu.gyro_noise_density"]["stated"] == says


def test_a_result_that_cannot_be_trusted_says_so_in_its_first_line(tmp_path, capsys):
    t = load("kitti").start
    write_noise(tmp_path / "noise.json", NoiseModel(excluded={"gnss_position": ((t + 30.0, t + 80.0),)}))
    kitti = ["smooth", "kitti", "--end", "90", "--solver", "ekf"]
    assert cli.run([*kitti, "--noise", str(tmp_path / "noise.json"), "-o", str(tmp_path / "o")]) == 0
    doubt = summary(tmp_path / "o")["doubts"][0][1:]
    assert doubt in capsys.readouterr().out.splitlines()[0]
    assert cli.run([*kitti, "-o", str(tmp_path / "p")]) == 0
    assert doubt not in capsys.readouterr().out
    s = summary(tmp_path / "p")
    assert s["doubts"] == []
    # and without a truth there is nothing that it was compared with
    assert (s["errors"], s["against"], s["spans"], s["nees"]) == (None, None, [], None)


# ---------------------------------------------------------------------------------------------------------------- info
def test_info_of_a_real_drive(capsys):
    assert command("info", "kitti") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("kitti (vehicle)")
    assert re.search(r"\b100\b", printed)


@pytest.mark.parametrize("how", [(), ("--json",), ("--quiet",)])
def test_info_shows_what_it_can_of_a_recording_that_is_refused(tmp_path, capsys, how):
    """And leaves with what `smooth` says of it, and its code."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for file in (Path(__file__).parents[2] / "data" / "tokyo").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    text = (folder / "recording.toml").read_text(encoding="utf-8")
    assert "[imu]\n" in text
    (folder / "recording.toml").write_text(
        text.replace("[imu]\n", '[imu]\nunits = { accel = "g" }\n', 1), encoding="utf-8"
    )
    assert command("smooth", folder, "-o", tmp_path / "o") == 2
    reason = capsys.readouterr().err
    assert command("info", folder, "--quick", *how) == 2
    printed = capsys.readouterr()
    assert printed.err == reason
    assert ("refused" in printed.out) == (how != ("--quiet",))


# ----------------------------------------------------------------------------------------------------------- bad input
BAD = {
    "no such recording": (["info", "nothing/here"], "file.missing", "nothing/here"),
    "unknown command": (["smoth", "kitti"], "", "smoth"),
    "unknown option": (["smooth", "kitti", "-o", "o", "--solvr", "ekf"], "", "--solvr"),
    "no output": (["smooth", "kitti"], "", "-o"),
    "output is a link to nothing": (["smooth", "kitti", "-o", "link/o"], "output.cannot_write", "-o link/o: "),
    "no number": (["smooth", "kitti", "-o", "o", "--start", "soon"], "", "--start"),
    "output is a file": (["smooth", "kitti", "-o", "file"], "output.cannot_write", "-o file: "),
    "output under a file": (["smooth", "kitti", "-o", "file/o"], "output.cannot_write", "-o file/o: "),
    "unknown solver": (
        ["smooth", "kitti", "-o", "o", "--solver", "lstm"],
        "option.unknown_name",
        "ekf, rts, incremental, isam2, batch",
    ),
    "two solvers": (["smooth", "kitti", "-o", "o", "--solver", "ekf,rts"], "option.value", "--solver ekf,rts"),
    "as typed": (["smooth", "kitti", "-o", "o", "--solvers", "lstm"], "option.unknown_name", "--solvers lstm"),
    "as typed, with =": (["compare", "kitti", "-o", "o", "--solver=lstm"], "option.unknown_name", "--solver lstm"),
    "unknown solver of a fleet": (
        ["fleet", ".", "-o", "o", "--solver", "lstm"],
        "option.unknown_name",
        "--solver lstm",
    ),
    "unknown among solvers": (["compare", "kitti", "-o", "o", "--solvers", "ekf,ukf"], "option.unknown_name", "'ukf'"),
    "no solvers": (["compare", "kitti", "-o", "o", "--solvers", ","], "option.no_name", "--solvers"),
    "unknown source": (["smooth", "kitti", "-o", "o", "--without", "gns:1-2"], "option.withheld", "'gnss'"),
    "half a span": (["smooth", "kitti", "-o", "o", "--without", "gnss:5"], "option.withheld", "gnss:600-660"),
    "words in a span": (["smooth", "kitti", "-o", "o", "--without", "gnss:a-b"], "option.withheld", "'a-b'"),
    "backward span": (["smooth", "kitti", "-o", "o", "--without", "gnss:9-5"], "option.withheld", "gnss:9-5"),
    "span outside": (["smooth", "kitti", "-o", "o", "--without", "gnss:900-960"], "option.span_outside", "'kitti'"),
    "no such sensor": (["smooth", "kitti", "-o", "o", "--without", "odometer"], "withhold.none", "'odometer'"),
    "end before start": (["smooth", "kitti", "-o", "o", "--start", "9", "--end", "5"], "option.value", "--end 5"),
    "start is no number": (["smooth", "kitti", "-o", "o", "--start", "nan"], "option.value", "--start nan"),
    "start after the end": (["smooth", "kitti", "-o", "o", "--start", "9999"], "option.span_outside", "--start 9999"),
    "no rate": (["smooth", "kitti", "-o", "o", "--rate", "0"], "option.value", "--rate 0"),
    "no config": (["smooth", "kitti", "-o", "o", "--config", "no.toml"], "file.unreadable", "no.toml"),
    "unknown noise": (["smooth", "kitti", "-o", "o", "--noise", "statd"], "file.missing", "--noise statd"),
    "unknown key": (["smooth", "kitti", "-o", "o", "--config", "bad.toml"], "key.unknown", "'rate'"),
    "two logs": (["info", "a.csv", "b.csv"], "recording.several", "graphnav init a.csv b.csv"),
    "empty": (["smooth", "kitti", "-o", ""], "", "smooth kitti -o: "),
    "empty, with =": (["smooth", "kitti", "--out="], "", "smooth kitti --out=: "),
    "no sensor": (["smooth", "kitti", "-o", "o", "--without", "400-460"], "option.withheld", "gnss:400-460"),
    "two formats": (
        ["convert", "file", "-o", "o", "--format", "nav", "--export", "gpx"],
        "option.not_here",
        "--format nav",
    ),
    "no trajectory yet": (
        ["convert", "kitti", "-o", "o", "--export", "gpx"],
        "trajectory.none",
        "graphnav smooth kitti",
    ),
    "what is written": (["smooth", "kitti", "-o", "o", "--format", "gpx"], "log.format_unknown", "--export gpx"),
    "another's name": (["info", "file", "--format", "kitti"], "log.format_unknown", "file"),
    "not a trajectory": (["evaluate", "file", "file"], "file.no_rows", "file"),
}


@pytest.mark.parametrize(("arguments", "key", "name"), BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_exit_code_2(arguments, key, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    Path("link").symlink_to("nothing")
    Path("bad.toml").write_text("[keyframes]\nrat = 1.0\n")
    assert name in refuse_command(capsys, key, *arguments)
    assert {p.name for p in tmp_path.iterdir()} == {"file", "link", "bad.toml"}  # nothing was written


@pytest.mark.parametrize("number", ["1e300", "1e-300", "[1e300, 1.0]"])
def test_numbers_of_settings_have_a_square_that_can_be_inverted(number, tmp_path, capsys):
    key = "slow_times" if "[" in number else "lever_arm_sigma"
    (tmp_path / "s.toml").write_text(f"[gnss]\n{key} = {number}\n")
    arguments = ["smooth", "kitti", "-o", str(tmp_path / "o"), "--config", str(tmp_path / "s.toml")]
    assert f"s.toml, line 2: 'gnss.{key}" in refuse_command(capsys, "key.value", *arguments)


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_service_may_have_closed_the_streams(closed):
    run = subprocess.run(["sh", "-c", f"'{PROGRAM}' info nothing-here {closed}"], capture_output=True, check=False)
    assert (run.returncode, run.stdout) == (2, b"")
    assert (run.stderr == b"") == ("2>&-" in closed)


def test_exit_code_and_sentence_of_the_installed_program():
    run = program("smooth", "nothing-here", "-o", os.devnull)
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr == f"graphnav: -o {os.devnull}: is a file; name a folder to write into\n"


def _raise_from(error: Exception, cause: BaseException) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (_raise_from(ImportError("initialization failed"), KeyboardInterrupt()), 130, "interrupted"),
        (TypeError("what\nis this"), 1, "internal error: TypeError: what is this in solving.py:"),
        (MemoryError(), 1, "out of memory"),
        (OSError(28, "No space left on device", "o/summary.json"), 2, "o/summary.json: No space left on device"),
    ],
    ids=["ctrl-c", "ctrl-c in an import", "internal", "memory", "disk full"],
)
def test_no_traceback_reaches_a_user(error, code, words, tmp_path, monkeypatch, capsys):
    def failing(*_):
        raise error

    monkeypatch.setattr(workflow, "run_request", failing)
    monkeypatch.delenv(cli.DEBUG, raising=False)
    assert cli.run(["smooth", "kitti", "-o", str(tmp_path / "o")]) == code
    printed = capsys.readouterr()
    assert printed.err.startswith("graphnav: ")
    assert words in printed.err
    assert printed.err.count("\n") == 1
    monkeypatch.setenv(cli.DEBUG, "1")
    assert cli.run(["smooth", "kitti", "-o", str(tmp_path / "o")]) == code
    shown = "Traceback" in capsys.readouterr().err
    assert shown == (code != 130)


def test_an_end_of_a_file_is_not_taken_for_ctrl_c(tmp_path, monkeypatch, capsys):
    def failing(*_):
        raise EOFError("cut short")

    monkeypatch.setattr(workflow, "run_request", failing)
    assert cli.run(["smooth", "kitti", "-o", str(tmp_path / "o")]) == 1
    assert "internal error: EOFError: cut short in solving.py:" in capsys.readouterr().err


def test_a_reader_that_stops_early_is_no_error():
    with subprocess.Popen([PROGRAM, "info", "kitti", "--quick"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        run.stdout.close()
        assert run.stderr.read() == b""
        assert run.wait(timeout=60) == cli.PIPE_CLOSED


# ---------------------------------------------------------------------------------------------------------------- help
@pytest.mark.parametrize("name", ["info", "smooth", "compare", "evaluate"])
@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_every_command_has_help_with_an_example(name, flag, capsys):
    assert command(name, flag) == 0
    printed = capsys.readouterr().out
    assert f"  graphnav {name} " in printed.split("Example:")[1]


def test_no_command_shows_help(capsys):
    assert cli.run([]) == 2
    assert "Commands:" in capsys.readouterr().out


# ------------------------------------------------------------------------------------------------------------- details
def test_spans_of_the_command_line():
    assert parse_withheld("gnss:600-660.5") == ("gnss", (600.0, 660.5))
    assert parse_withheld("odometer") == ("odometer", None)


@pytest.mark.parametrize(
    "words",
    [
        ("smooth", "--solver", "ekf", "--no-report", "--end", "20"),
        ("detect", "--end", "20"),
        ("convert",),
    ],
)
def test_every_command_that_writes_takes_the_permission(tmp_path: Path, words: tuple[str, ...]) -> None:
    folder = tmp_path / "drive"
    shutil.copytree(Path(__file__).resolve().parents[2] / "data" / "tokyo", folder)
    (folder / "imu.csv.gz").rename(tmp_path / "imu.csv.gz")
    described = folder / "recording.toml"
    described.write_text(described.read_text().replace('"imu.csv.gz"', '"../imu.csv.gz"'))
    name, *options = words
    given = [name, folder, "-o", tmp_path / "out", *options, "--quiet"]
    assert command(*given) == 2
    assert command(*given, "--allow-outside") == 0
