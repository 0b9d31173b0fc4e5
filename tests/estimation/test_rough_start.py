"""A filter that diverges from a rough start, where the estimate of the noise did not."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from helpers import forget_residuals
from test_noise_scenarios import draw_damaged

import graphnav
from graphnav.app.scores import score
from graphnav.config import Settings
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import exp
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.estimation.noise.files import read_noise, write_noise
from graphnav.estimation.pipeline import choose_origin
from graphnav.estimation.problem import build_problem
from graphnav.estimation.relinearisation import is_clearly_worse, linearise_known, relinearise
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.evaluation.metrics import summarise


def test_a_filter_that_diverges_begins_at_what_the_noise_model_was_estimated_with(shared_data: Path) -> None:
    """Single-point fixes among high houses, one a second, on a car that starts at walking pace."""
    whole = graphnav.load(shared_data / "tokyo_20201105" / "recording_spp.toml").crop(150.0, 300.0)
    whole = forget_residuals(whole)
    assert whole.gnss is not None
    drive = replace(whole, gnss=pick_fixes(whole.gnss, np.arange(0, len(whole.gnss.t), 5)))
    solutions = graphnav.run(drive, solvers=("ekf", "rts"))
    found = score(whole, drive, solutions, ())[0]
    assert solutions["ekf"].noise.figures
    for name in ("ekf", "rts"):
        assert summarise(found[name])["nees_p"] < 5.0
        assert summarise(found[name])["h_rms_m"] < 10.0


def test_a_filter_that_diverges_is_taken_to_the_optimum_that_another_estimate_found() -> None:
    """From a heading that is half a turn off, and stated as unknown, the filter ends far away; simulated."""
    recording, _ = oracle.drive(oracle.vehicle_path(duration=120, rate=50.0, seed=4), seed=2, odometer_rate=20.0)
    settings, frame = Settings(), LocalFrame(choose_origin(recording))
    stops = detect(recording, settings).stationary
    aligned = align(recording, settings, frame, stops)
    right = build_problem(recording, settings, frame, aligned.state, aligned.sigma, stops)
    known = smooth_backward(right, ekf(right, opening=aligned.until))
    sigma, around = aligned.sigma.copy(), exp(np.array([[0.0, 0.0, np.pi]]))
    sigma[2] = np.pi
    start = replace(aligned.state, R_nb=around @ aligned.state.R_nb)
    problem = build_problem(recording, settings, frame, start, sigma, stops)
    forward = ekf(problem, opening=aligned.until)
    smoothed = smooth_backward(problem, forward)
    plain = relinearise(problem, aligned, forward, smoothed, None, Counter())
    found = linearise_known(problem, aligned, known, None, Counter())
    off, near = ([np.max(np.abs(one.states.minus(known.states)[-1, :3])) for one in x[:2]] for x in (plain, found))
    assert min(off) > 1.0  # rad
    assert max(near) < 0.01
    assert is_clearly_worse(problem, plain[1], known)


def test_what_is_searched_for_is_found_again(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Circles with bursts of wrong fixes and an outage, whose filter ends elsewhere; and it repeated."""
    _, _, damaged = draw_damaged(shared_data, monkeypatch, 1, 189)
    settings = Settings()
    found = graphnav.run(damaged, settings, ("ekf", "rts"))
    noise = found["rts"].noise
    assert noise.searched
    kept = read_noise(write_noise(tmp_path / "noise.json", noise))
    again = graphnav.run(damaged, settings, ("ekf", "rts"), noise=kept)
    plain = graphnav.run(damaged, settings, ("rts",), noise=replace(kept, searched=False))["rts"]
    for name, one in found.items():
        np.testing.assert_array_equal(one.states.p, again[name].states.p)
    assert np.max(np.abs(plain.states.p - found["rts"].states.p)) > 0.1
