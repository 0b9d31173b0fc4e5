"""Constraints of wheels, an assumption, where it does not hold."""

from __future__ import annotations

from pathlib import Path

import pytest

from graphnav import load
from graphnav.config import Settings
from graphnav.core.earth import LocalFrame
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.noise.components import Components
from graphnav.estimation.noise.estimate import estimate_noise
from graphnav.estimation.pipeline import choose_origin
from graphnav.estimation.problem import build_problem


def test_a_motorbike_that_leans_is_believed(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Begun loose, the constraints lead to an optimum that is no less likely than begun as stated."""
    recording, settings = load(shared_data / "motorbike_dresden_20160809"), Settings()
    frame, stops = LocalFrame(choose_origin(recording), recording.start), detect(recording, settings).stationary
    aligned = align(recording, settings, frame, stops)
    base = build_problem(recording, settings, frame, aligned.state, aligned.sigma, stops, parts_of_noise=True)
    loose = estimate_noise(base, aligned.until)
    monkeypatch.setattr(Components, "doubt_wheels", lambda *_: None)
    tight = estimate_noise(base, aligned.until)
    assert loose.log_evidence > tight.log_evidence - loose.gained_by_chance
