"""Drives without a single fix: IMU and wheels from a start in motion, and from one at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphnav import load, run
from graphnav.app.scores import score
from graphnav.app.workflow import Request, run_request
from graphnav.config import Settings
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import get_key
from graphnav.estimation.alignment import align
from graphnav.evaluation.metrics import summarise
from graphnav.recording import Recording


@pytest.fixture(scope="module")
def moving(shared_data: Path) -> Recording:
    """47 s at 17 m/s and less, in an outage of the single-point fixes."""
    part = load(shared_data / "tokyo_20201105" / "recording_spp.toml").crop(1216.0, 1263.0)
    assert part.gnss is not None
    assert not part.placed
    return part


def test_a_start_in_motion_has_the_speed_of_the_wheels(moving: Recording) -> None:
    solutions = run(moving, solvers=("rts", "batch"))
    found = {name: summarise(one) for name, one in score(moving, moving, solutions, ())[0].items()}
    way = float(np.linalg.norm(np.diff(solutions["batch"].states.p[:, :2], axis=0), axis=1).sum())
    assert way > 300.0
    for name, one in found.items():
        assert one["h_rms_m"] < 0.005 * way, name
        assert one["nees_p"] < 5.0, name


def test_no_rows_of_fixes_are_as_no_fixes(moving: Recording) -> None:
    errors = []
    for used in (moving, moving.without("gnss")):
        errors.append(summarise(score(moving, used, run(used, solvers=("rts",)), ())[0]["rts"])["h_rms_m"])
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)


def test_a_speed_that_nothing_measures_is_unknown(moving: Recording) -> None:
    blind = moving.without("gnss").without("odometer")
    found = align(blind, Settings(), LocalFrame(np.zeros(3)))
    assert "alignment.speed_unknown" in map(get_key, found.notes)
    assert np.all(found.sigma[6:9] > 17.0)


def test_a_result_whose_truth_stands_still_is_kept(shared_data: Path) -> None:
    """No heading can be fitted to it."""
    source = str(shared_data / "tokyo_20201105")
    outcome = run_request(Request(source, ("ekf",), withheld=(("gnss", None),), end=20.0))
    assert "truth.too_little" in map(get_key, outcome.findings)
    assert not outcome.metrics
    found = outcome.solutions["ekf"]
    assert np.linalg.norm(found.states.p[:, :2], axis=1).max() < 0.05
