"""Stops of a running drive that the other measurements contradict."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import at_rate, find_steady_motion

from graphnav import load
from graphnav.config import Settings, parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import get_key
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.detectors import Detections, detect, find_stops
from graphnav.detectors.base import NONE, merge_spans
from graphnav.online import Online, drop_rows, list_rows, looks, noise_estimation, start
from graphnav.recording import Recording

HOW = parse_settings({"gnss": {"velocity": False}, "solver": {"lag": 60.0}})
EVERY = 600  # rows between checkpoints


def claim_stops(monkeypatch: pytest.MonkeyPatch, claimed: Array) -> None:
    """Detectors that call some spans stationary, whatever the sensors say."""

    def claim(recording: Recording, settings: Settings) -> Detections:
        found, inside = detect(recording, settings), claimed[claimed[:, 1] < recording.end]
        return replace(found, stationary=merge_spans(np.concatenate([found.stationary, inside])))

    def claim_between(recording: Recording, how: Settings, since: float, until: float, *known: object) -> Array | None:
        found, inside = find_stops(recording, how, since, until, *known), np.clip(claimed, since, until)
        inside = inside[inside[:, 1] > inside[:, 0]]
        if not len(inside):
            return found
        return merge_spans(np.concatenate([NONE if found is None else found, inside]))

    for module in (start, noise_estimation):
        monkeypatch.setattr(module, "detect", claim)
    monkeypatch.setattr(looks, "find_stops", claim_between)


def play(recording: Recording, checkpoints: bool = False) -> tuple[Online, list[Trajectory]]:
    online, parts = Online(drop_rows(recording), HOW), []
    for k, row in enumerate(list_rows(recording)[1]):
        online.add(row)
        parts += online.settled()
        if checkpoints and k % EVERY == 0:
            online = pickle.loads(pickle.dumps(online))
    online.finish()
    assert not online.failures
    return online, parts + online.settled()


@pytest.fixture(scope="module")
def recording(shared_data: Path) -> Recording:
    """Fixes good to metres and no speed measured."""
    whole = load(shared_data / "oracle_drive" / "recording_spp.toml")
    return at_rate(replace(whole.crop(50.0, 250.0), odometer=None), 25.0)


@pytest.fixture(scope="module")
def true(recording: Recording) -> list[Trajectory]:
    """As it is with the true stops."""
    online, parts = play(recording)
    assert online.tracker is not None
    assert online.tracker.noise.false_stops == ()
    return parts


@pytest.mark.parametrize("begin", [0.0, 80.0], ids=["while aligning", "later"])
def test_a_stop_at_speed_is_taken_back_before_anything_settles_by_it(
    recording: Recording, true: list[Trajectory], monkeypatch: pytest.MonkeyPatch, begin: float
) -> None:
    """The result is that without the claim, and the same from checkpoints."""
    span = find_steady_motion(recording.crop(begin, begin + 80.0), 4.0, slowest=4.0)
    claim_stops(monkeypatch, span[None])
    online, found = play(recording)
    assert online.tracker is not None
    false = np.array(online.tracker.noise.false_stops)
    np.testing.assert_allclose([false[0, 0], false[-1, 1]], span, atol=1.0)
    assert np.all(false[1:, 0] - false[:-1, 1] < 1.0)
    assert "detectors.contradicted" in map(get_key, online.notes)
    frame = LocalFrame(true[0].llh[0])
    a, b = (np.concatenate([frame.from_llh(track.llh) for track in some]) for some in (true, found))
    sd = np.concatenate([track.sd_p for track in true if track.sd_p is not None])
    assert np.max(np.abs(a - b) / sd) < 0.5
    if begin:
        _, same = play(recording, checkpoints=True)
        a, b = (np.concatenate([track.llh for track in some]) for some in (found, same))
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("step", [1.3, 1.8])
def test_a_step_of_the_fixes_at_a_true_stop_does_not_take_it_back(shared_data: Path, step: float) -> None:
    """As of wrongly fixed integers: much larger than the errors of the fixes, no larger than they are stated to be."""
    part = at_rate(load(shared_data / "oracle_drive" / "recording.toml").crop(160.0, 312.0), 25.0)
    assert part.gnss is not None
    frame, sd = LocalFrame(part.gnss.llh[0]), 10.0 * part.gnss.sd
    moved = frame.from_llh(part.gnss.llh) + step * np.array([-0.7, 0.7, -1.4]) * sd * (part.gnss.t > 291.5)[:, None]
    online, _ = play(replace(part, gnss=replace(part.gnss, llh=frame.to_llh(moved), sd=sd)))
    assert online.tracker is not None
    assert np.any((online.tracker.stops[:, 0] < 296.0) & (online.tracker.stops[:, 1] > 305.0))  # from 293 on
    assert online.tracker.noise.false_stops == ()
