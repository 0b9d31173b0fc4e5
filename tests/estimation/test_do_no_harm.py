"""scripts/do_no_harm.py: what it measures is what happened, and every bound can be broken."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import oracle
import pytest
from helpers import forget_residuals

import graphnav
from graphnav.core.earth import LocalFrame
from graphnav.estimation.solution import ExcludedSpan
from graphnav.evaluation.evaluate import evaluate_recording
from graphnav.evaluation.metrics import summarise

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture(scope="module")
def script():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPTS))
        yield importlib.import_module("do_no_harm")
        for name in ("do_no_harm", "harm_verdict", "drive_changes"):
            sys.modules.pop(name)


@pytest.fixture(scope="module")
def verdict(script):
    return sys.modules["harm_verdict"]


@pytest.fixture(scope="module")
def tokyo(script):
    return graphnav.load(script.DRIVES["tokyo_clone"].source)


# --------------------------------------------------------------------------------------------------------------- bounds
def made_up(changes=lambda row: {}):
    """Rows of two windows of one drive that break no bound, with changes."""
    rows = []
    for window in ("0-300", "50-350"):
        for variant, h, seconds in (("stated", 1.0, 2.0), ("estimated", 0.5, 4.0)):
            for solver in ("ekf", "rts", "batch"):
                row = {"drive": "d", "window": window, "sensors": "gnss", "variant": variant, "solver": solver}
                row |= {"simulated": False, "h": h, "up": h, "nees": 1.0, "fixes": 300, "seconds": seconds}
                row |= {"left_out": 3, "left_out_velocities": 0, "confirmed": 200, "confirmed_left_out": 2}
                rows.append({**row, **changes(row)})
    return rows


def only(new, **where):
    """Changes of the rows whose values are those given."""
    return lambda row: new if all(row[key] == value for key, value in where.items()) else {}


FIRST = {"window": "0-300", "variant": "estimated"}
BREAKS = {
    "worst": (only({"h": 1.31}, **FIRST, solver="rts"), "0-300 gnss rts, h"),
    "worst up": (only({"up": 1.31}, **FIRST, solver="ekf"), "0-300 gnss ekf, up"),
    "median": (only({"h": 0.95}, variant="estimated"), "6"),
    "confirmed": (only({"confirmed_left_out": 3}, **FIRST, solver="batch"), "0-300 gnss batch"),
    "smoother": (only({"h": 0.56, "up": 0.56}, variant="estimated", solver="batch"), "d gnss batch, h"),
    "time": (only({"seconds": 6.2}, variant="estimated"), "d gnss"),
    "solved": (only({"error": "lost"}, **FIRST, solver="ekf"), "lost"),
}


def test_nothing_is_broken_by_what_is_better(verdict):
    assert verdict.broken(made_up()) == []


@pytest.mark.parametrize("name", BREAKS)
def test_every_bound_can_be_broken(verdict, name):
    changes, said = BREAKS[name]
    rows = made_up(changes)
    found = verdict.broken(rows)
    assert any(said in str(one) for one in found if one.bound == name.split()[0])
    others = {one.bound for one in found} - {name.split()[0]}
    assert others <= ({"smoother"} if name.startswith("worst") else set())


@pytest.mark.parametrize(
    "changes",
    [
        lambda row: dict.fromkeys(("h", "up"), 0.02 if row["variant"] == "stated" else 0.049),
        lambda row: dict.fromkeys(("h", "up"), 0.02 if row["solver"] == "ekf" else 0.049),
        only({"error": "cannot be aligned"}, window="0-300"),
        only({"error": "cannot be aligned"}, window="0-300", variant="stated"),
    ],
    ids=["below the floor", "a smoother below the floor", "not solved either way", "not solved as stated"],
)  # fmt: skip
def test_what_is_not_counted(verdict, changes):
    rows = made_up(changes)
    assert verdict.broken(rows) == []
    assert bool(list(verdict.failures(rows))) is any("error" in row for row in rows)


def test_a_drive_that_is_simulated_has_no_say_in_the_median(verdict):
    equal = only({"h": 0.99}, variant="estimated")
    assert verdict.broken(made_up(lambda row: {**equal(row), "simulated": True})) == []


def test_errors_are_pooled_as_squares(verdict):
    rows = made_up(only({"h": 0.1, "up": 0.1}, **FIRST))
    lines = list(verdict.table(rows))
    assert len(lines) == 2 + 3
    named = dict(zip(verdict.COLUMNS, lines[2].strip("| ").split(" | "), strict=True))
    assert float(named["h s, m"]) == pytest.approx(1.0)
    assert float(named["h e, m"]) == pytest.approx(np.sqrt((0.1**2 + 0.5**2) / 2.0), abs=1e-3)
    assert float(named["worst h"]) == pytest.approx(0.5)
    assert float(named["median h"]) == pytest.approx(0.3)
    assert float(named["confirmed left out, %"]) == pytest.approx(1.0)
    assert float(named["time"]) == pytest.approx(2.0)


def test_an_older_run_beside_this_one(verdict):
    worse = made_up(only({"h": 2.0}, variant="estimated", solver="rts"))
    words = [line.split(" | ")[-1].strip(" |") for line in verdict.compared(made_up(), worse)][2:]
    assert words == ["same to 1 %", "better", "same to 1 %"]


# -------------------------------------------------------------------------------------------------------------- windows
def test_windows_lie_within_the_fixes_and_come_with_the_seed(script, tokyo):
    def found(count, seed, whole=False):
        options = SimpleNamespace(windows=count, seed=seed, whole=whole, length=script.WINDOW)
        return list(script.windows(tokyo, "somewhere/recording.toml", options))

    many = found(40, 1)
    assert found(20, 1) == many[: len(found(20, 1))]
    assert not {name for name, _ in many} & {name for name, _ in found(40, 2)}
    assert next(name for name, _ in found(20, 1, whole=True)) == "whole"
    for _, (start, end) in many:
        assert end - start == pytest.approx(0.5 * tokyo.duration, abs=0.2)
        assert tokyo.gnss.t[0] - tokyo.start - 0.1 <= start < end <= tokyo.duration + 0.1


def test_a_short_drive_is_solved_whole(script, tokyo):
    options = SimpleNamespace(windows=8, seed=1, whole=False, length=script.WINDOW)
    assert [name for name, _ in script.windows(tokyo.crop(0, 100), "x", options)] == ["whole"]


def test_a_share_is_drawn_cell_by_cell(script, tmp_path):
    def cells(*more):
        asked = ["-o", str(tmp_path / "x.json"), "--drives", "tokyo_clone", "--length", "30", "--no-whole", *more]
        jobs = script.plan(script.options_of(asked))
        assert [job.variant for job in jobs] == list(script.VARIANTS) * (len(jobs) // 2)
        return [(job.window, job.sensors) for job in jobs[::2]]

    everything, part = cells(), cells("--share", "0.25")
    assert len(everything) == 8 * 3
    assert len(part) == len(set(part)) == 6
    assert set(part) < set(everything)
    assert part == cells("--share", "0.25") != cells("--share", "0.25", "--seed", "2")


@pytest.mark.parametrize("doppler", [True, False])
@pytest.mark.parametrize("sensors", ["gnss", "+nhc", "+odometer"])
def test_settings_differ_in_what_the_cells_differ_in(script, sensors, doppler):
    stated, estimated = (script.settings_of(variant, sensors, doppler) for variant in script.VARIANTS)
    for one in (stated, estimated):
        assert one.gnss.velocity is doppler
        assert one.standstill.zero_velocity is one.standstill.held_position is (sensors != "gnss")
        assert (one.vehicle.nhc, one.vehicle.odometer) == (sensors != "gnss", sensors == "+odometer")
    assert stated != estimated
    defaults = graphnav.Settings()
    assert (estimated.imu, estimated.gnss.faults, estimated.noise) == (
        defaults.imu,
        defaults.gnss.faults,
        defaults.noise,
    )


# ------------------------------------------------------------------------------------------------------- fixes left out
def counts(script, recording, first, last, weight=None):
    """What is said of a solution without the fixes from first to last, found wrong or of no weight."""
    t = recording.gnss.t
    record = SimpleNamespace(t=t, weight=np.ones(len(t)) if weight is None else weight)
    fault = ExcludedSpan("gnss_position", t[first], t[last], last - first + 1)
    return script.left_out(recording, (fault,) if weight is None else (), record)


def test_fixes_that_the_truth_confirms_are_told_from_others(script, tokyo):
    good = counts(script, tokyo, 100, 119)
    assert good["left_out"] == 20
    assert good["fixes"] == len(tokyo.gnss.t)
    assert 15 <= good["confirmed_left_out"] <= 20
    p = LocalFrame(tokyo.gnss.llh[0])
    away = p.from_llh(tokyo.gnss.llh)
    away[100:120] += [1.0, 0.0, 0.0]  # twenty of their sigmas
    bad = counts(script, replace(tokyo, gnss=replace(tokyo.gnss, llh=p.to_llh(away))), 100, 119)
    assert bad["left_out"] == 20
    assert bad["confirmed_left_out"] == 0
    assert bad["confirmed"] == good["confirmed"] - good["confirmed_left_out"]


def test_fixes_that_only_one_solver_refuses_count_as_well(script, tokyo):
    weight = np.ones(len(tokyo.gnss.t))
    weight[50:55] = 0.0
    assert counts(script, tokyo, 0, 0, weight)["left_out"] == 5


def test_without_truth_nothing_is_confirmed(script, tokyo):
    said = counts(script, replace(tokyo, truth=None), 100, 119)
    assert said["left_out"] == 20
    assert said["confirmed"] is said["confirmed_left_out"] is None


# ----------------------------------------------------------------------------------------------------------- end to end
def test_a_window_of_a_real_drive(script, tmp_path, capsys, monkeypatch):
    path = tmp_path / "harm.json"
    arguments = ["-o", str(path), "--drives", "tokyo_clone", "--windows", "1", "--no-whole", "--length", "30"]
    code = script.main(arguments)
    rows = json.loads(path.read_text(encoding="utf-8"))
    assert len({row["window"] for row in rows}) == 1
    assert len(rows) == 3 * 2 * 3
    for row in rows:
        assert 0.001 < row["h"] < 1.0
        assert row["up"] > 0.0
        assert row["nees"] > 0.0
        assert row["seconds"] > 0.0
        assert row["confirmed"] > 100
        assert row["left_out"] <= row["fixes"]
    stated = [row for row in rows if row["variant"] == "stated"]
    assert all(row["left_out"] == 0 for row in stated)
    assert {row["h"] for row in stated}.isdisjoint(row["h"] for row in rows if row["variant"] == "estimated")
    assert code == int(bool(script.broken(rows)))
    first = capsys.readouterr().out

    monkeypatch.setattr(script, "solve", lambda job: pytest.fail("solved again"))
    assert script.main([*arguments, "--compare", str(path)]) == code
    again = capsys.readouterr().out
    assert first.splitlines()[:11] == again.splitlines()[:11]
    assert again.count("same to 1 %") == 9
    assert json.loads(path.read_text(encoding="utf-8")) == rows

    worse = [row | {"h": 10.0} if row["variant"] == "estimated" else row for row in rows]
    path.write_text(json.dumps(worse), encoding="utf-8")
    assert script.main(arguments) == 1
    assert f"tokyo_clone {rows[0]['window']} +nhc rts, h: " in capsys.readouterr().out


def test_without_truth_withheld_fixes_are_scored(script, shared_data, tmp_path):
    path = tmp_path / "harm.json"
    script.main(["-o", str(path), "--drives", "circles_2025", "--only", "stated", "--data", str(shared_data)])
    rows = json.loads(path.read_text(encoding="utf-8"))
    gnss = graphnav.load(shared_data / "car_circles_boston_20251119").gnss
    assert len(rows) == 2 * 3
    assert all(row["window"] == "whole" and row["variant"] == "stated" and row["h"] > 0.0 for row in rows)
    assert all(len(gnss.t) - 24 <= row["fixes"] <= len(gnss.t) - 18 for row in rows)  # less two spans of ten


def test_what_cannot_be_solved_is_a_row(script, tmp_path, monkeypatch, capsys):
    def fail(*arguments):
        raise graphnav.GraphnavError("no motion to align with")

    monkeypatch.setattr(graphnav, "run", fail)
    path = tmp_path / "harm.json"
    script.main(["-o", str(path), "--drives", "tokyo_clone", "--windows", "1", "--no-whole"])
    rows = json.loads(path.read_text(encoding="utf-8"))
    assert {row["error"] for row in rows} == {"no motion to align with"}
    text = capsys.readouterr().out
    assert text.count("no motion to align with") == 6
    assert "nan" not in text


def test_a_file_of_something_else_is_left_alone(script, tmp_path, capsys):
    path = tmp_path / "harm.json"
    path.write_text('{"a": 1}', encoding="utf-8")
    assert script.main(["-o", str(path), "--drives", "tokyo_clone"]) == 2
    assert "harm.json" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == '{"a": 1}'


# A 24th of the cells of three windows a drive, at half their length and by the seed: a quarter of a minute of processor
# time. Not the rover, whose 20 fixes a second take as long as all the rest, nor the clone, a part of the first.
SOME = ["--windows", "3", "--length", "150", "--no-whole", "--share", "0.04", "--drives", ",".join((
    "tokyo_no_doppler", "tokyo", "tokyo_spp", "boulder", "kitti", "comma", "dresden", "circles_2024", "circles_2025",
    "motorbike", "oracle", "oracle_spp",
))]  # fmt: skip


def test_estimated_noise_does_no_harm(script, verdict, shared_data, tmp_path):
    jobs = script.plan(script.options_of([*SOME, "--data", str(shared_data), "-o", str(tmp_path / "harm.json")]))
    rows = [row for job in jobs for row in script.solve(job)]
    found = [one for one in verdict.broken(rows) if one.bound != "time"]
    assert not found, "\n".join(map(str, found))


@pytest.mark.parametrize(("start", "sensors"), [(693.1, "+odometer"), (701.3, "gnss")])
def test_fixes_before_a_step_may_be_the_wrong_ones(script, shared_data, start, sensors):
    """Reflections move single-point fixes for ten seconds, slowly at first, until they step back to where they belong:
    those behind the step are right.
    """
    whole = forget_residuals(graphnav.load(str(shared_data / "tokyo_20201105" / "recording_spp.toml")))
    part = whole.crop(start, start + 100.0)
    part = part if sensors == "+odometer" else part.without("odometer")
    found = graphnav.run(part, script.settings_of("estimated", sensors), ("ekf",))["ekf"]
    counted = script.left_out(part, found.excluded, found.records["gnss_position"])
    assert counted["left_out"] > 0
    assert counted["confirmed_left_out"] <= 0.01 * counted["confirmed"]


def test_every_constant_is_changed_where_it_is_used(script) -> None:
    """scripts/constants.py: halved and doubled in every module that has it, and afterwards as it was."""
    constants = importlib.import_module("constants")
    for constant in constants.CONSTANTS:
        module = importlib.import_module(constant.module)
        usual = getattr(module, constant.name)
        for _, value in constant.values(usual):
            with constants.changed(constant, value):
                assert getattr(module, constant.name) == value != usual
        assert getattr(module, constant.name) is usual


# ------------------------------------------------------------------------------------------------------ changed drives
@pytest.fixture(scope="module")
def changes(script):
    return sys.modules["drive_changes"].CHANGES


@pytest.fixture(scope="module")
def drive():
    return oracle.drive(oracle.vehicle_path(duration=120, rate=100.0, seed=2), seed=1)[0]


def test_a_drive_that_is_turned_back_is_a_drive(changes, drive):
    """On the path of the truth, and the Earth turns the same way."""
    solved = graphnav.run(changes["backwards"](drive), solvers=("rts",), noise="stated")["rts"]
    forwards = graphnav.run(drive, solvers=("rts",), noise="stated")["rts"]
    errors = [
        evaluate_recording(one.trajectory(), what)
        for one, what in ((solved, changes["backwards"](drive)), (forwards, drive))
    ]
    back, usual = (summarise(one) for one in errors)
    assert back["h_rms_m"] < 1.5 * usual["h_rms_m"]
    assert back["heading_rms_deg"] < 3.0 * usual["heading_rms_deg"]
    assert back["nees_p"] < 2.0


def test_turned_back_twice_it_is_as_it_was(changes, drive):
    again = changes["backwards"](changes["backwards"](drive))
    assert again.imu.t == pytest.approx(drive.imu.t)
    np.testing.assert_allclose(again.imu.gyro, drive.imu.gyro, atol=2e-6)
    np.testing.assert_allclose(again.imu.accel, drive.imu.accel, atol=1e-4)
    np.testing.assert_allclose(again.gnss.llh, drive.gnss.llh)
    np.testing.assert_allclose(
        np.unwrap(again.truth.rph, axis=0) - np.unwrap(drive.truth.rph, axis=0),
        [[0, 0, 2 * np.pi]] * len(drive.truth.t),
        atol=1e-9,
    )


def test_wheels_and_arms_are_turned_back(changes, tokyo):
    back = changes["backwards"](tokyo)
    np.testing.assert_array_equal(back.odometer.speed, tokyo.odometer.speed[::-1])
    assert back.start + back.end - back.odometer.t[0] == pytest.approx(tokyo.odometer.t[-1])
    np.testing.assert_array_equal(back.gnss.lever_arm[:2], -tokyo.gnss.lever_arm[:2])
    np.testing.assert_array_equal(back.gnss.v, -tokyo.gnss.v[::-1])


def test_fewer_fixes_and_a_slower_imu(changes, drive):
    assert changes["blind-start"](drive).gnss.t[0] > drive.start + 20.0
    assert np.diff(changes["sparse-fixes"](drive).gnss.t) == pytest.approx(8.0)
    slow = changes["slow-imu"](drive).imu
    assert slow.period == pytest.approx(5.0 * drive.imu.period)
    np.testing.assert_allclose(slow.gyro[7], drive.imu.gyro[35:40].mean(axis=0))
    assert slow.t[7] == drive.imu.t[39]


def test_a_phone_stamps_fixes_late(changes, tokyo):
    logged = changes["phone"](tokyo)
    same = np.abs(logged.gnss.t[:, None] - 0.325 - tokyo.gnss.t).argmin(axis=1)
    np.testing.assert_array_equal(logged.gnss.llh, tokyo.gnss.llh[same])
    late = logged.gnss.t - tokyo.gnss.t[same]
    assert 0.3 <= late.min() < late.max() <= 0.35
    assert np.diff(logged.gnss.t).mean() == pytest.approx(1.0, abs=0.01)
    assert len(np.unique(logged.gnss.sd, axis=0)) == 1
    assert np.std(logged.imu.gyro - tokyo.imu.gyro) == pytest.approx(2e-3, rel=0.05)
