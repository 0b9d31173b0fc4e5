"""What scripts rely on: JSON alone on stdout, exit codes, quality gates, profiles, whole files whatever stops a run."""

from __future__ import annotations

import gzip
import json
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from helpers import full_disk, refuse_command, refused, run_here

from graphnav import load, run
from graphnav.app import cli
from graphnav.app.terminal import StagePace
from graphnav.config import PROFILES, Settings, format_settings, parse_settings, read_settings
from graphnav.core import staging
from graphnav.core.errors import ConfigError, EstimationError
from graphnav.core.progress import send_progress, tell
from graphnav.estimation import pipeline
from graphnav.evaluation import gates

ROOT = Path(__file__).resolve().parents[1]
TOKYO = ROOT / "data" / "tokyo"
PROGRAM = Path(sys.executable).with_name("graphnav")


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """A minute without fixes, filter and smoother: (folder, what --json printed, the rest)."""
    out = tmp_path_factory.mktemp("tokyo")
    command = ["compare", TOKYO, "--without", "gnss:40-100", "--solvers", "ekf,batch", "--noise", "stated",
               "-o", out, "--json", "--require", "batch:h_rms<0.2", "--require", "span_max_h<0.6"]  # fmt: skip
    return out, run_here(*command)


# ---------------------------------------------------------------------------------------------------------------- JSON
def test_json_of_compare_is_what_the_files_hold(solved):
    out, run = solved
    values = json.loads(run.stdout)
    assert set(values["solvers"]) == {"ekf", "batch"}
    for solver, summary in values["solvers"].items():
        assert summary == json.loads((out / solver / "summary.json").read_text())
    assert [Path(file).exists() for file in values["files"]] == [True] * len(values["files"])


@pytest.mark.parametrize(
    ("arguments", "keys"),
    [
        (["info", TOKYO], {"name", "imu", "gnss", "odometer", "findings"}),
        (["detect", TOKYO, "-o", "out"], {"stationary", "seconds_by_detector", "files"}),
        (["convert", TOKYO, "-o", "out"], {"rows", "assumed", "files"}),
        (["init", TOKYO / "imu.csv.gz", TOKYO / "gnss.csv.gz", "-o", "r.toml"], {"decisions", "files"}),
        (["simulate", "gait", "--set", "duration=20", "-o", "out"], {"scenario", "stops", "files"}),
        (["settings", "--profile", "car"], {"profile", "gnss", "vehicle"}),
        (
            ["smooth", TOKYO, "--end", "60", "--solver", "ekf", "--noise", "stated", "-o", "out"],
            {"solver", "errors", "settings", "files"},
        ),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_json_alone_is_on_stdout(arguments, keys, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.run([*map(str, arguments), "--json"]) == 0
    printed = capsys.readouterr()
    assert keys <= set(json.loads(printed.out))
    assert printed.err == ""


@pytest.mark.parametrize("command", ["info", "detect", "convert", "simulate"])
def test_quiet_prints_nothing(command, tmp_path, capsys):
    subject = ["gait", "--set", "duration=20"] if command == "simulate" else [str(TOKYO)]
    out = [] if command == "info" else ["-o", str(tmp_path / "out")]
    assert cli.run([command, *subject, *out, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


# --------------------------------------------------------------------------------------------------------------- gates
def test_a_requirement_is_of_every_solver_or_of_one(solved):
    _, run = solved
    verdicts = {(v["require"], v["solver"]): v for v in json.loads(run.stdout)["requirements"]}
    errors = {name: s["errors"] for name, s in json.loads(run.stdout)["solvers"].items()}
    spans = {name: s["spans"] for name, s in json.loads(run.stdout)["solvers"].items()}
    assert set(verdicts) == {("batch:h_rms<0.2", "batch"), ("span_max_h<0.6", "ekf"), ("span_max_h<0.6", "batch")}
    met = [spans[name][0]["max_h_m"] < 0.6 for name in ("batch", "ekf")]
    assert verdicts["batch:h_rms<0.2", "batch"]["value"] == errors["batch"]["h_rms_m"] < 0.2
    assert verdicts["span_max_h<0.6", "ekf"]["value"] == spans["ekf"][0]["max_h_m"] > 0.6
    assert [verdicts[key]["met"] for key in sorted(verdicts)] == [True, *met]
    assert run.returncode == 3
    missed = f"graphnav: not met: ekf has span_max_h_m {spans['ekf'][0]['max_h_m']:g}, required span_max_h<0.6\n"
    assert run.stderr == missed


def test_a_requirement_that_is_met_or_cannot_be_known(solved, tmp_path, capsys):
    out, _ = solved
    trajectory = str(out / "batch" / "trajectory.csv")
    assert cli.run(["evaluate", trajectory, str(TOKYO), "--require", "h_rms<=0.2", "--require", "heading_rms<9"]) == 3
    printed = capsys.readouterr()
    assert "trajectory has h_rms_m" in printed.out
    assert printed.err == "graphnav: not met: trajectory has heading_rms_deg not known, required heading_rms<9\n"
    assert cli.run(["evaluate", trajectory, str(TOKYO), "--require", "h_rms<=0.2", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("h_rsm<0.5", "h_rms"),
        ("h_rms", "NAME<NUMBER"),
        ("h_rms=0.5", "NAME<NUMBER"),
        ("h_rms<half", "'half'"),
        ("rts:h_rms<1", "'rts'"),
        ("span2_maxh<1", "span_max_h"),
    ],
)
def test_a_requirement_that_says_nothing_is_refused_before_any_work(text, name, tmp_path, capsys):
    asked = ["smooth", TOKYO, "-o", tmp_path / "o", "--require", text]
    assert name in refuse_command(capsys, "option.requirement", *asked)
    assert not (tmp_path / "o").exists()


def test_names_of_requirements_are_those_of_the_comparison(solved):
    out, _ = solved
    header = (out / "comparison.csv").read_text().splitlines()[0].split(",")
    columns = {re.sub(r"^span\d+_", "span_", name) for name in header} - {"solver"}
    assert columns <= set(gates.list_names())


@pytest.mark.parametrize(("sign", "met"), [("<", False), ("<=", True), (">", False), (">=", True)])
def test_limits_themselves(sign, met):
    (verdict,) = gates.judge_all([gates.parse_requirement(f"h_rms{sign}0.5")], [{"solver": "batch", "h_rms_m": 0.5}])
    assert verdict.met is met


def test_a_requirement_on_spans_is_of_each_or_of_the_one_that_is_numbered():
    row = {"solver": "batch", "span1_max_h_m": 0.1, "span2_max_h_m": 0.9}

    def met(text):
        return all(v.met for v in gates.judge_all([gates.parse_requirement(text)], [row]))

    assert not met("span_max_h<0.5")
    assert met("span1_max_h<0.5")
    assert not met("span2_max_h<0.5")
    assert not met("span3_max_h<0.5")  # there is none


# ----------------------------------------------------------------------------------------------- settings and profiles
def test_a_profile_is_below_the_file_and_the_flag_above_its_profile(tmp_path):
    file = tmp_path / "s.toml"
    file.write_text('profile = "car+odometer"\n[vehicle]\nnhc = false\n')
    assert read_settings(file).vehicle.odometer
    assert not read_settings(file).vehicle.nhc
    flagged = read_settings(file, "car")
    assert (flagged.profile, flagged.vehicle.odometer, flagged.vehicle.nhc) == ("car", False, False)
    assert Settings(profile="car").vehicle.nhc
    assert not Settings(profile="foot").vehicle.nhc
    assert Settings().profile is None


@pytest.mark.parametrize("profile", [None, *PROFILES])
def test_settings_as_text_are_the_same_settings(profile):
    given = read_settings(None, profile)
    assert parse_settings(tomllib.loads(format_settings(given))) == given


def test_how_noise_is_found_can_be_said_in_a_word():
    drive = load(TOKYO).crop(0.0, 30.0)
    by_word = run(drive, solvers=("ekf",), noise="stated")["ekf"]
    by_setting = run(drive, Settings(noise={"mode": "stated"}), solvers=("ekf",))["ekf"]
    assert not by_word.noise.figures
    assert np.array_equal(by_word.states.p, by_setting.states.p)
    with pytest.raises(ConfigError) as refusal:
        run(drive, noise="states")
    assert refusal.value.key == "noise.mode"


def test_a_profile_of_another_platform_is_refused_and_a_missing_odometer_is_said(tmp_path, capsys):
    refuse_command(capsys, "profile.platform", "smooth", TOKYO, "--profile", "foot", "-o", tmp_path)
    options = ["--end", "60", "--solver", "ekf", "--noise", "stated", "-o", str(tmp_path / "o")]
    assert cli.run(["smooth", "kitti", "--profile", "car+odometer", *options]) == 0
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert "settings.no_odometer" in {message["key"] for message in summary["messages"]}


def test_a_run_can_be_repeated_with_the_settings_in_its_summary(tmp_path):
    options = ["--end", "40", "--solver", "ekf", "--noise", "stated", "--quiet"]
    assert cli.run(["smooth", str(TOKYO), "--profile", "car", *options, "-o", str(tmp_path / "a")]) == 0
    again = ["--config", str(tmp_path / "a" / "summary.json")]
    assert cli.run(["smooth", str(TOKYO), *again, *options, "-o", str(tmp_path / "b")]) == 0
    one, other = (json.loads((tmp_path / x / "summary.json").read_text()) for x in "ab")
    assert not any("odometer" in kind for kind in one["counts"])
    assert one["settings"] == other["settings"]
    assert one["final_cost"] == other["final_cost"]


@pytest.mark.parametrize(
    ("text", "key", "names"),
    [
        ("[keyframes]\n\nrat = 1", "key.unknown", ("line 3", "'keyframes.rat'", "'rate'")),
        ("[keyframes]\nrate = -1", "key.value", ("line 2", "'keyframes.rate' = -1", "Hz")),
        ("[keyframes]\nrate = true", "key.value", ("line 2", "keyframes.rate")),
        ("[solver]\nmax_iterations = false", "key.value", ("line 2", "max_iterations")),
        ("[vehicle]\nzero_velocity = false", "key.unknown", ("'zero_velocity'", "[standstill]")),
        ("[detectors.fft]\nstep = 0", "key.value", ("line 2", "'detectors.fft.step' = 0", "0.1")),
        ('profile = "bike"', "key.value", ("line 1", "'profile' = 'bike'", "'car'", "'car+odometer'", "'foot'")),
        ("[gnss]\ngate = inf", "key.value", ("'gnss.gate'", "'inf'", '"off"', '"on"', '"automatic"')),
        ("keyframes = 3", "key.table", ("line 1", "'keyframes'", "[keyframes]")),
        ("[keyframes]\nrate = ", "toml.syntax", ()),
    ],
)
def test_settings_that_cannot_be_are_named_with_line_value_and_unit(text, key, names, tmp_path):
    file = tmp_path / "settings.toml"
    file.write_text(text)
    with refused(key, ConfigError, *names) as caught:
        read_settings(file)
    assert str(caught.value).startswith(str(file))


# ------------------------------------------------------------------------------------------------- whole or not at all
def test_a_staged_folder_replaces_at_the_end_or_not_at_all(tmp_path):
    old = tmp_path / "out" / "a.txt"
    old.parent.mkdir()
    old.write_text("old")

    def stopped(folder, error):
        with staging.stage_results(folder) as part:
            (part / "a.txt").write_text("half")
            raise error

    with pytest.raises(KeyboardInterrupt):
        stopped(old.parent, KeyboardInterrupt())
    assert (old.read_text(), [p.name for p in old.parent.iterdir()]) == ("old", ["a.txt"])
    with staging.stage_results(old.parent) as part:
        (part / "sub").mkdir()
        (part / "a.txt").write_text("new")
        (part / "sub" / "b.txt").write_text("new")
        assert old.read_text() == "old"
    assert (old.read_text(), (old.parent / "sub" / "b.txt").read_text()) == ("new", "new")
    assert {p.name for p in old.parent.iterdir()} == {"a.txt", "sub"}
    with refused("output.cannot_write", ConfigError, "full"):
        stopped(tmp_path / "x" / "y", OSError("full"))
    assert not (tmp_path / "x").exists()


def test_what_is_read_is_not_replaced(tmp_path, capsys, monkeypatch):
    """A truth, a trajectory to compare with or to convert, of the name of a result, in the folder of the results.

    It is refused before anything is solved.
    """
    monkeypatch.setattr(pipeline, "run", lambda *_: pytest.fail("solved"))
    shutil.copytree(TOKYO, tmp_path, dirs_exist_ok=True)
    truth = tmp_path / "trajectory.csv"
    truth.write_bytes(gzip.decompress((tmp_path / "truth.csv.gz").read_bytes()))
    text = (tmp_path / "recording.toml").read_text()
    (tmp_path / "recording.toml").write_text(text.replace('"truth.csv.gz"', '"trajectory.csv"'))
    other = tmp_path / "out" / "ekf" / "trajectory.csv"
    other.parent.mkdir(parents=True)
    other.write_text("t,lat,lon,h\n" + "".join(f"{1580 + k},35.65,139.77,40\n" for k in range(60)))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    fast = ["--end", "20", "--noise", "stated"]
    for command in (
        ["smooth", tmp_path, *fast, "--solver", "ekf", "-o", tmp_path],
        ["compare", tmp_path, *fast, "--solvers", "ekf,rts", "--against", other, "-o", tmp_path / "out"],
        ["convert", truth, "-o", tmp_path, "--export", "csv"],
    ):
        assert "trajectory.csv" in refuse_command(capsys, "output.is_input", *command)
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_end_waits_for_what_must_not_be_cut(number):
    done = []

    def move():
        with staging.defer_interrupts():
            os.kill(os.getpid(), number)
            done.append("moved")
        done.append("more")

    before = signal.signal(number, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            move()
    finally:
        signal.signal(number, before)
    assert done == ["moved"]


@pytest.mark.parametrize("end", [30, 120])
def test_on_a_full_disk_are_the_new_results_or_the_older(tmp_path, end):
    """Of a short run all but the report and run.npz fit; of a longer one not even the trajectory."""
    smooth = ["smooth", "kitti", "--solver", "ekf", "--noise", "stated", "-o", str(tmp_path)]
    assert cli.run([*smooth, "--end", "20", "--quiet"]) == 0
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    command = [PROGRAM, *smooth, "--end", str(end)]
    run = subprocess.run(command, **full_disk(), capture_output=True, text=True, timeout=300)
    assert run.returncode == 2
    assert len(run.stderr.splitlines()) == 1
    after = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    if end == 30:
        assert set(before) - set(after) == {"report.html", "run.npz"}
        assert all(after[name] != before[name] for name in ("trajectory.csv", "summary.json"))
    else:
        assert after == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_end_is_one_line_and_leaves_nothing_half_done(tmp_path, number):
    """On a terminal, as soon as the bar is up."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as of what a shell runs in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    main, end = pty.openpty()
    command = [PROGRAM, "compare", "kitti", "-o", tmp_path / "out"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=end, stdin=subprocess.DEVNULL) as run:
        os.close(end)
        shown = b""
        while not shown:
            shown = os.read(main, 4096)
        run.send_signal(number)
        try:
            while more := os.read(main, 4096):
                shown += more
        except OSError:  # the other end is closed
            pass
        assert run.wait(timeout=60) == 130
        assert run.stdout.read() == b""
    os.close(main)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.decode())
    assert text.rstrip().splitlines()[-1] == "graphnav: interrupted"
    assert "Traceback" not in text
    assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------------------------------------ progress
def test_the_time_left_is_what_the_pace_says():
    pace = StagePace(("simulate",))
    assert pace.estimate_left(10.0) is None
    pace.reach("driving", 0.5)
    half = pace.done
    assert 0.4 < half < 0.5  # writing is still to come
    assert pace.estimate_left(10.0) == pytest.approx(10.0 * (1 - half) / half)
    pace.reach("driving", 0.1)  # a second pass
    assert pace.done == half
    pace.reach("writing imu.csv.gz", 1.0)
    assert pace.estimate_left(10.0) == 0.0
    pace.reach("something else", 0.0)
    assert pace.done == 1.0


def test_work_tells_whoever_listens():
    heard = []
    tell("nobody", 0.1)
    with send_progress(lambda stage, share: heard.append((stage, share))):
        tell("one", 0.5)
        with send_progress(None):
            tell("two")
    tell("nobody")
    assert heard == [("one", 0.5)]


def test_a_run_tells_its_stages_in_order():
    from graphnav import load, run

    heard = []
    run(load(TOKYO).crop(0.0, 60.0), solvers=("batch",), progress=lambda stage, share: heard.append(stage))
    found = list(dict.fromkeys(heard))
    wanted = [
        "detection", "alignment", "preintegration", "noise", "filter", "smoother", "batch", "covariances",
    ]  # fmt: skip
    assert found == wanted


# ------------------------------------------------------------------------------------------------------------- Python
def test_a_call_of_run_takes_one_name_and_says_what_it_cannot_take():
    recording = load(TOKYO).crop(0.0, 40.0)
    solution = run(recording, Settings(noise={"mode": "stated"}), "rts")["rts"]
    times, states, covariance = solution.at(np.array([recording.end + 10.0]))
    assert (len(times), len(states), covariance.shape) == (0, 0, (0, 15, 15))
    middle = solution.t[0] + 0.37 * (solution.t[-1] - solution.t[0])
    times, states, covariance = solution.at([recording.end, middle])  # in any order
    assert np.array_equal(times, [middle, recording.end])
    t, one, P = solution.at(middle)
    assert np.array_equal(t, times[:1])
    assert np.abs(one.p - states.p[:1]).max() < 1e-9
    assert np.abs(P / covariance[:1] - 1.0).max() < 1e-6
    with refused("option.value", EstimationError, "-1 Hz"):
        solution.trajectory(rate=-1.0)
    assert all(len(repr(what)) < 100 for what in (recording, solution, states, solution.trajectory()))
    with refused("run.argument", ConfigError, "Recording", "load"):
        run("data/tokyo")  # type: ignore[arg-type]
    with refused("run.argument", ConfigError, "Settings", "dict"):
        run(recording, {"gnss": {"robust": "cauchy"}})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("values", "key", "names"),
    [
        ({"gnsss": {}}, "key.unknown", ("'gnsss'", "'gnss'")),
        ({"gnss": {"robst": "cauchy"}}, "key.unknown", ("'gnss.robst'", "'robust'")),
        ({"keyframes": {"rate": -1}}, "key.value", ("'keyframes.rate' = -1", "Hz")),
    ],
)
def test_settings_made_in_python_are_refused_in_the_words_of_files(values, key, names):
    with refused(key, ConfigError, "Settings", *names) as caught:
        Settings(**values)
    assert len(str(caught.value).splitlines()) == 1
