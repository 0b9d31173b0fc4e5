"""`graphnav compare --loose`: raw observations and fixes of one recording side by side."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from helpers import refuse_command

from graphnav.app import cli

DATA = Path(__file__).resolve().parents[2] / "data"


def test_every_solver_is_there_with_either_coupling_and_its_own_settings(tmp_path):
    asked = ["compare", str(DATA / "tokyo_raw"), "--loose", "--solvers", "ekf,rts", "--noise", "stated"]
    asked += ["--end", "40", "--no-report", "--quiet", "--require", "rts-loose:h_rms<50", "-o", str(tmp_path)]
    assert cli.run(asked) == 0
    with (tmp_path / "comparison.csv").open(encoding="utf-8", newline="") as file:
        assert [row["solver"] for row in csv.DictReader(file)] == ["ekf", "ekf-loose", "rts", "rts-loose"]
    for solver in ("ekf", "rts"):
        tight, loose = (json.loads((tmp_path / n / "summary.json").read_text()) for n in (solver, f"{solver}-loose"))
        assert "gnss_code" in tight["counts"]
        assert "gnss_position" not in tight["counts"]
        assert "gnss_position" in loose["counts"]
        assert "gnss_code" not in loose["counts"]
        assert loose["settings"]["raw_gnss"]["coupling"] == "loose"
        assert tight["settings"]["raw_gnss"]["coupling"] == "automatic"


def test_without_raw_observations_it_is_refused(tmp_path, capsys):
    asked = ["compare", str(DATA / "tokyo"), "--loose", "--end", "30", "-o", str(tmp_path / "out")]
    refuse_command(capsys, "option.not_here", *asked)
    assert not (tmp_path / "out").exists()
