"""Stops that the other measurements contradict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import find_steady_motion

from graphnav import load
from graphnav.config import parse_settings
from graphnav.config.detectors import FUSED
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.detectors import Detections, detect
from graphnav.detectors.base import mask_inside, merge_spans
from graphnav.estimation import building, piece
from graphnav.estimation.noise.files import read_noise, write_noise
from graphnav.estimation.pipeline import run
from graphnav.recording import Recording
from graphnav.simulation import simulate

SETTINGS = parse_settings({"gnss": {"velocity": False}})


def claim_stops(monkeypatch: pytest.MonkeyPatch, claimed: Array) -> None:
    """Detectors that call some spans stationary, whatever the sensors say."""

    def claim(*given: object) -> Detections:
        found = detect(*given)
        spans = merge_spans(np.concatenate([found.stationary, claimed]))
        answers = (
            replace(d, intervals=spans, mask=mask_inside(d.t, spans)) if d.name == FUSED else d for d in found.all
        )
        return Detections(spans, tuple(answers), found.notes)

    for module in (piece, building):
        monkeypatch.setattr(module, "detect", claim)


def test_a_stop_at_speed_is_none(shared_data: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Fixes good to metres, no speed measured: the true stops stay, and the result is that without the false one."""
    recording = replace(load(shared_data / "tokyo_20201105" / "recording_spp.toml").crop(350.0, 550.0), odometer=None)
    true = run(recording, SETTINGS, ("rts",))["rts"]
    assert true.noise.false_stops == ()
    span = find_steady_motion(recording, 4.0, slowest=4.0)
    claim_stops(monkeypatch, span[None])
    found = run(recording, SETTINGS, ("rts",))["rts"]
    np.testing.assert_allclose(found.noise.false_stops, span[None])
    np.testing.assert_allclose(found.stationary, true.stationary)
    np.testing.assert_allclose(found.states.p[-1], true.states.p[-1], atol=0.1)
    kept = read_noise(write_noise(tmp_path / "noise.json", found.noise))
    again = run(recording, SETTINGS, ("rts",), noise=kept)["rts"]
    np.testing.assert_array_equal(again.states.p, found.states.p)


def displace(recording: Recording, begin: float, end: float) -> Recording:
    """Fixes 30 m east of where they were measured for a while."""
    gnss = recording.gnss
    assert gnss is not None
    frame, wrong = LocalFrame(gnss.llh[0]), (gnss.t >= begin) & (gnss.t <= end)
    east = np.outer(wrong, [30.0, 0.0, 0.0])
    return replace(recording, gnss=replace(gnss, llh=frame.to_llh(frame.from_llh(gnss.llh) + east)))


def test_wrong_fixes_beside_a_false_stop_are_told_apart(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fixes that are wrong from the middle of a true stop on; and the same with a false stop elsewhere."""
    recording = replace(load(shared_data / "oracle_drive" / "recording_spp.toml").crop(70.0, 185.0), odometer=None)
    span, (begin, end) = find_steady_motion(recording, 4.0, slowest=4.0), (141.0, 165.0)
    assert not begin - 20.0 < span[0] < end
    wrong = displace(recording, begin, end)
    found = run(wrong, SETTINGS, ("rts",))["rts"]
    claim_stops(monkeypatch, span[None])
    both = run(wrong, SETTINGS, ("rts",))["rts"]
    assert found.noise.false_stops == ()
    np.testing.assert_allclose(both.noise.false_stops, span[None])
    for one in (found, both):
        assert sum(b - a for a, b in one.noise.excluded["gnss_position"]) == pytest.approx(end - begin, abs=5.0)
    np.testing.assert_allclose(both.states.p, found.states.p, atol=0.1)


def test_a_drive_that_cannot_be_aligned_without_a_false_stop_keeps_it(
    shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = replace(load(shared_data / "tokyo_20201105" / "recording_spp.toml").crop(350.0, 500.0), odometer=None)
    claim_stops(monkeypatch, find_steady_motion(recording, 4.0, slowest=4.0)[None])

    tried = []

    def fail(*given: object) -> None:
        tried.append(given)
        raise EstimationError("no motion")

    monkeypatch.setattr(building.ProblemBuilder, "build_moving", fail)
    found = run(recording, SETTINGS, ("rts",))["rts"]
    assert tried
    assert found.noise.false_stops == ()
    assert found.noise.figures


def test_a_motorbike_that_rides_steadily_does_not_stand(shared_data: Path) -> None:
    """Two seconds at 8 m/s, as quiet as its stops might be, with fixes of which the stated sigma is 5 m."""
    recording = load(shared_data / "motorbike_dresden_20160809")
    claimed = detect(recording).stationary
    assert len(claimed) == 1
    solution = run(recording, None, ("rts",))["rts"]
    np.testing.assert_allclose(solution.noise.false_stops, claimed)
    assert len(solution.stationary) == 0
    at = (solution.t > claimed[0, 0]) & (solution.t < claimed[0, 1])
    assert np.linalg.norm(solution.states.v[at], axis=1).min() > 5.0


def test_an_engine_that_idles_for_long_does_not_move() -> None:
    """Simulated: sixteen minutes without GNSS, with lines of the engine that keyframes sample at almost one phase."""
    made = simulate("li2024", 0, engine_hz=12.49585, rate=50.0)
    begin, end = made.facts["stop_edges"][0]
    recording = replace(made.recording, truth=None)
    recording = recording.crop(begin - 147.0 - recording.start, end - recording.start)
    recording = recording.without("gnss", (begin - 0.5 - recording.start, end + 1.0 - recording.start))
    found = run(recording, solvers=("ekf",))["ekf"]
    assert found.noise.false_stops == ()
    inside = (found.t >= begin) & (found.t <= end)
    assert np.max(np.abs(found.states.p[inside] - found.states.p[inside][0])) < 0.03  # m, as the paper has it
