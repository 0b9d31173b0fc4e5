"""What a noise model leaves out of a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.estimation.noise.explanations import FIXES
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.noise.spans import mask_times
from graphnav.recording import Recording


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
