"""Sentences that users meet have keys, which reach scripts."""

from __future__ import annotations

import copy
import json
import pickle
import re

import logs

from graphnav.app import cli
from graphnav.app.stored import NAME, read_outcome
from graphnav.core.notes import Note, key_of

KEY = re.compile(r"[a-z_]+(\.[a-z_]+)+")


def test_a_note_keeps_its_key():
    note = Note("noise.outliers", "7 rows are outliers")
    for one in (note, copy.deepcopy(note), pickle.loads(pickle.dumps(note))):
        assert (one, one.key) == ("7 rows are outliers", "noise.outliers")
    assert json.dumps({"note": note}) == '{"note": "7 rows are outliers"}'
    assert key_of("a sentence") == ""


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
    kept, _ = read_outcome(out / NAME)
    notes = kept.solutions["rts"].notes
    assert [key_of(note) for note in notes] == [m["key"] for m in messages if m["sentence"] in notes]
