"""A filter that diverges from a rough start, where the estimate of the noise did not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers import forget_residuals

import graphnav
from graphnav.app.scores import score
from graphnav.estimation.alignment.first import pick_fixes
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
