"""Sentences that users meet have keys, which reach scripts."""

from __future__ import annotations

import ast
import copy
import importlib.util
import json
import pickle
import re
from pathlib import Path

import logs
import pytest
from helpers import parse_code

from graphnav.app import cli
from graphnav.app.stored import RUN_FILE, read_outcome
from graphnav.constraints import list_constraints
from graphnav.core import errors
from graphnav.core.errors import RecordingError
from graphnav.core.notes import Note, get_key
from graphnav.recording.formats import load, read

ROOT = Path(__file__).resolve().parents[2]
KEY = re.compile(r"[a-z_]+(\.[a-z_]+)+")


def test_a_note_keeps_its_key():
    note = Note("noise.outliers", "7 rows are outliers")
    for one in (note, copy.deepcopy(note), pickle.loads(pickle.dumps(note))):
        assert (one, one.key) == ("7 rows are outliers", "noise.outliers")
    assert json.dumps({"note": note}) == '{"note": "7 rows are outliers"}'
    assert get_key("a sentence") == ""


def test_the_page_lists_every_key_of_the_code():
    spec = importlib.util.spec_from_file_location("note_keys", ROOT / "scripts" / "note_keys.py")
    note_keys = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(note_keys)
    assert (ROOT / "docs" / "keys.md").read_text(encoding="utf-8") == note_keys.page()


LOGS = {
    "kf-gins": lambda folder, recording, truth: logs.write_kf_gins(folder, recording, truth, odometer=True),
    "rtklib": lambda folder, recording, truth: logs.write_rtklib(folder / "a.pos", recording, "UTC"),
    "nmea": lambda folder, recording, truth: logs.write_nmea(folder / "a.nmea", recording, gst=False),
    "kitti-raw": logs.write_kitti,
    "novatel": lambda folder, recording, truth: logs.write_novatel(folder / "a.log", recording, truth),
    "gnsslogger": lambda folder, recording, truth: logs.write_gnsslogger(folder / "a.txt", recording),
}


@pytest.mark.parametrize("name", LOGS)
def test_what_a_loader_says_has_a_key_for_each_thing(name, tmp_path):
    """Two different sentences of a log never share one."""
    tmp_path.joinpath("log").mkdir()
    written = LOGS[name](tmp_path / "log", *logs.simulated(20.0))
    remarks = load(written).remarks
    keys = [get_key(remark) for remark in remarks]
    assert remarks
    assert [key for key in keys if not KEY.fullmatch(key)] == []
    assert len(set(keys)) == len(keys)


def test_what_is_repaired_of_a_recording_has_a_key_for_each_sensor(tmp_path):
    (tmp_path / "recording.toml").write_text(
        'format = "graphnav-recording/1"\nplatform = "vehicle"\n[imu]\nfile = "imu.csv"\n[gnss]\nfile = "gnss.csv"\n'
    )
    imu = [f"{k / 10:.1f},0,0,0,0,0,9.8" for k in range(1, 101)]
    imu[20:22] = imu[21], imu[20]
    imu[40] = "4.1,,0,0,0,0,9.8"
    imu.insert(60, imu[60])
    (tmp_path / "imu.csv").write_text("\n".join(["t,gx,gy,gz,ax,ay,az", *imu]) + "\n")
    gnss = [f"{k},48.0,11.0,500.0" for k in range(1, 10)]
    gnss[3:5] = ["4,0,0,0", "5,,11.0,500.0"]
    (tmp_path / "gnss.csv").write_text("\n".join(["t,lat,lon,h", *gnss]) + "\n")
    keys = [get_key(remark) for remark in read(tmp_path).remarks]
    assert len(set(keys)) == len(keys)
    assert set(keys) >= {
        *("imu.rows_blank", "imu.rows_unordered", "imu.rows_repeated", "imu.noise_assumed"),
        *("gnss.rows_blank", "gnss.nowhere", "gnss_position.sigma_assumed"),
    }


def test_all_that_a_run_says_has_a_key(tmp_path):
    """Of a drive with wrong stamps, blank rows and a gap; also where it was kept."""
    recording, truth = logs.simulated(40.0)
    log = logs.write_kf_gins(tmp_path / "drive", recording, truth)
    lines = (log / "imu.txt").read_text().splitlines()
    (log / "imu.txt").write_text("\n".join([*lines[:900], *lines[915:]]) + "\n")
    out = tmp_path / "out"
    assert cli.run(["smooth", str(log), "-o", str(out), "--solver", "rts", "--without", "gnss:30-31", "--quiet"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    messages = summary["messages"]
    assert {*summary["notes"], *summary["doubts"]} <= {m["sentence"] for m in messages}
    assert [m for m in messages if not KEY.fullmatch(m["key"])] == []
    assert {"alignment.motion", "imu.gaps_bridged", "noise.rows"} <= {m["key"] for m in messages}
    code = [kind.name for kind in list_constraints() if "_" in kind.name]
    assert [m["sentence"] for m in messages if any(name in m["sentence"] for name in code)] == []
    kept, _ = read_outcome(out / RUN_FILE)
    notes = kept.solutions["rts"].notes
    assert [get_key(note) for note in notes] == [m["key"] for m in messages if m["sentence"] in notes]


def test_an_error_keeps_its_key():
    error = RecordingError("a.csv: no column 't'", key="table.column")
    for one in (error, copy.copy(error), pickle.loads(pickle.dumps(error))):
        assert (str(one), one.key) == ("a.csv: no column 't'", "table.column")
    assert RecordingError(Note("key.unknown", "unknown key 'a'")).key == "key.unknown"


def test_every_error_of_the_code_has_a_key():
    """It is given one, or the sentence is a note or its own error's, which has."""
    kinds = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, Exception)}
    every = [
        (path.name, node)
        for path in (ROOT / "graphnav").rglob("*.py")
        for node in parse_code(path)
        if isinstance(node, ast.ClassDef | ast.Call)
    ]
    kinds |= {
        n.name for _, n in every if isinstance(n, ast.ClassDef) and {ast.unparse(base) for base in n.bases} & kinds
    }
    without = [
        f"{name}:{call.lineno}"
        for name, call in every
        if isinstance(call, ast.Call)
        and getattr(call.func, "id", "") in kinds
        and not any(keyword.arg == "key" for keyword in call.keywords)
        and not ast.unparse(call.args[0]).startswith("describe_invalid(")
    ]
    assert without == []
