"""Fixes that a logger has filled in while it wrote no measurements, as it did with the rows of the IMU.

They lie on the chord, the straight line between the places of the antenna at both ends of the gap, and cut the curve
that the vehicle drove in between. With e their errors, predicted by a smoother that uses none of them, S the covariance
of e, and d the way from the smoothed path to the chord, the measured ones have e ~ N(0, c S) and the filled ones
e ~ N(d, c S). Of all n numbers in gaps together, with the c that is likeliest for each, since the stated sigmas may be
wrong, the log-likelihoods differ by

    n / 2 ln(sum e^T S^-1 e / sum (e - d)^T S^-1 (e - d))
"""

from __future__ import annotations

import numpy as np

from graphnav.constraints.gnss import GnssPosition
from graphnav.core.rotation import Array, mv
from graphnav.core.state import DIM
from graphnav.estimation.dense import make_dense
from graphnav.estimation.faults.excluded import weigh_rows
from graphnav.estimation.noise.explanations import FIXES
from graphnav.estimation.noise.outliers import OUTLIER_COST
from graphnav.estimation.noise.spans import mask_times
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.rts import smooth_backward

_INSIDE = 1e-6  # s from the rows of the IMU at the ends of a gap


def find_filled_gaps(problem: Problem, opening: float | None) -> tuple[Array, int]:
    """Gaps of the IMU in which fixes are on the chord, if that is likelier than that they were measured.

    Parameters
    ----------
    problem : with stated noise.
    opening : as for `graphnav.estimation.solvers.ekf.ekf`.

    Returns
    -------
    array
        (g, 2) s, all gaps that have fixes, or none.
    int
        Passes of filter and smoother.

    Raises
    ------
    EstimationError
        If the filter breaks down.
    """
    none = np.empty((0, 2))
    rows = next((c for c in problem.constraints if isinstance(c, GnssPosition)), None)
    if rows is None:
        return none, 0
    t, gaps = problem.t[rows.keyframe], np.add(problem.samples.bridged, [_INSIDE, -_INSIDE])
    gaps = gaps[(gaps[:, 0] > problem.t[0]) & (gaps[:, 1] < problem.t[-1])]
    gaps = gaps[np.searchsorted(t, gaps[:, 1]) > np.searchsorted(t, gaps[:, 0])]
    if not len(gaps):
        return none, 0
    spans = [(float(begin), float(end)) for begin, end in gaps]
    inside = {c.name: mask_times(problem.t[c.keyframe], spans) for c in problem.constraints if c.name in FIXES}
    used = weigh_rows(problem, {name: np.where(some, 0.0, 1.0) for name, some in inside.items()})
    smoothed = smooth_backward(used, ekf(used, opening=opening))
    own = np.flatnonzero(inside[rows.name])
    one = smoothed.take_rows(rows, used.columns)
    S = (one.covariance + one.sigma[:, :, None] ** 2 * np.eye(3))[own]
    begin, end = gaps[np.searchsorted(gaps[:, 0], t[own]) - 1].T
    times, index = np.unique(np.concatenate([begin, t[own], end]), return_inverse=True)
    states, _ = make_dense(used, smoothed.states, smoothed.P[:, :DIM, :DIM], None)(times)
    first, path, last = np.split((states.p + mv(states.R_nb, rows.lever_arm))[index], 3)
    chord = first + ((t[own] - begin) / (end - begin))[:, None] * (last - first)
    e, d = rows.p_n[own] - path, chord - path
    measured, filled = (float(np.sum(x * np.linalg.solve(S, x[..., None])[..., 0])) for x in (e, e - d))
    likelier = 0.5 * e.size * float(np.log(measured / filled)) > OUTLIER_COST
    return (gaps if likelier else none), 1
