"""A filter that diverges from a rough start, where the estimate of the noise did not."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
from helpers import forget_residuals

import graphnav
from graphnav.app.scores import score
from graphnav.config import Settings
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import exp
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.estimation.pipeline import choose_origin
from graphnav.estimation.problem import build_problem
from graphnav.estimation.relinearisation import relinearise
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
    off = {}
    for points in (None, known):
        found = relinearise(problem, aligned, forward, smoothed, None, Counter(), points)
        off[points is known] = [np.max(np.abs(one.states.minus(known.states)[-1, :3])) for one in found[:2]]
    assert min(off[False]) > 1.0  # rad
    assert max(off[True]) < 0.01
