"""Fixes of a receiver that reports faster than its errors change, one of a second.

A receiver's tracking loops and its own filter smooth over about a second (Kaplan and Hegarty 2017, section 8.6; carrier
smoothing lasts longer still): of ten fixes in one, nine repeat the error of the first, smoothly. A white variance that
is told by such fixes is far too small, and an IMU that does not follow their smooth errors is called worse than it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.alignment.first import some
from graphnav.constraints.gnss import period
from graphnav.recording import Recording


def space_fixes(recording: Recording, spacing: float) -> Recording:
    """A recording with the best fix, by stated sigma, of every `spacing` (s); as it is where fixes are not closer.

    The fix nearest to the beginning among equals, so that a steady receiver's are evenly spaced.
    """
    gnss = recording.gnss
    if gnss is None or len(gnss.t) < 2 or period(gnss.t) > 0.5 * spacing:
        return recording
    which = np.floor((gnss.t - gnss.t[0] + 0.5 * period(gnss.t)) / spacing).astype(int)
    size = np.linalg.norm(np.where(np.isfinite(gnss.llh), gnss.sd, np.inf), axis=1)
    order = np.lexsort((gnss.t, size, which))
    first = np.concatenate([[True], np.diff(which[order]) > 0])
    return replace(recording, gnss=some(gnss, np.sort(order[first])))
