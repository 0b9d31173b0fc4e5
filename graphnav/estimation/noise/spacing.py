"""Thinning of fixes to one a second, where a receiver reports faster than its errors change.

A receiver's tracking loops and its own filter smooth over about a second: of ten fixes in one, nine repeat the error of
the first, smoothly. A white variance estimated from such fixes is far too small, and an IMU that does not follow their
smooth errors gets too large a noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.constraints.lasting import find_fix_period
from graphnav.core.rotation import Array
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.recording import Gnss, Recording


def space_fixes(recording: Recording, spacing: float) -> Recording:
    """A recording with the best fix, by stated sigma, of every `spacing` (s); as it is where fixes are not closer.

    The first among equals, so that a steady receiver's are evenly spaced. Where that one has no velocity and others
    have, the best velocity's fix is kept as well.
    """
    gnss = recording.gnss
    if gnss is None or len(gnss.t) < 2 or find_fix_period(gnss.t) > 0.5 * spacing:
        return recording
    return replace(
        recording, gnss=pick_fixes(gnss, select_best_fixes(gnss, np.floor((gnss.t - find_grid_start(gnss)) / spacing)))
    )


def find_grid_start(gnss: Gnss) -> float:
    """Where the grid of spans begins of which the fixes are the best, s: between two rows of a steady receiver."""
    return float(gnss.t[0] - 0.5 * find_fix_period(gnss.t))


def select_best_fixes(gnss: Gnss, which: Array) -> Array:
    """The rows that `space_fixes` keeps of each span; `which` (N,) is the span of each fix."""
    keep = _select_best(which, np.linalg.norm(gnss.sd, axis=1))
    if gnss.v is not None and gnss.sd_v is not None:
        moves = np.asarray(np.isfinite(gnss.v).all(axis=1))
        best = _select_best(which, np.where(moves, np.linalg.norm(gnss.sd_v, axis=1), np.inf))
        without = np.isin(which[best], which[keep[~moves[keep]]])
        keep = np.union1d(keep, best[without & moves[best]])
    return keep


def _select_best(which: Array, size: Array) -> Array:
    """The row of the least size of each group, the first of several, in order."""
    order = np.lexsort((size, which))  # stable: rows are in the order of time
    return np.sort(order[np.concatenate([[True], np.diff(which[order]) > 0])])
