"""What a noise model leaves out of a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.estimation.noise.apply import select_weights
from graphnav.estimation.noise.explanations import FIXES
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.noise.spans import mask_times
from graphnav.estimation.noise.tails import relate_to_gaussian
from graphnav.estimation.problem import Problem
from graphnav.recording import Recording


def compute_excluded_share(problem: Problem, noise: NoiseModel) -> float:
    """Share of the information of the positions that a noise model leaves out."""
    rows = next((c for c in problem.constraints if c.name == FIXES[0]), None)
    if rows is None:
        return 0.0
    weight = select_weights(problem.t[rows.keyframe], noise, rows.name)
    return 1.0 - float(np.mean(relate_to_gaussian(weight, len(rows.axes), noise.tails.get(rows.name))))


def drop_excluded(recording: Recording, noise: NoiseModel) -> Recording:
    """The recording without the fixes in the excluded spans of a noise model."""
    gnss = recording.gnss
    assert gnss is not None
    p, v = (
        mask_times(t, noise.excluded.get(name, ()))[:, None]
        for name, t in zip(FIXES, (gnss.t, gnss.velocity_t), strict=True)
    )
    gnss = replace(gnss, llh=np.where(p, np.nan, gnss.llh), v=None if gnss.v is None else np.where(v, np.nan, gnss.v))
    return replace(recording, gnss=gnss)
