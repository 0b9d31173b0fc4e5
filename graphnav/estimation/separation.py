"""Combined separation: difference between the forward filter and the information after each keyframe.

A smoother combines, per axis, the filter's position x_f with that of all later measurements by themselves, x_b:

    x_s / P_s = x_f / P_f + x_b / P_b      1 / P_s = 1 / P_f + 1 / P_b      (Fraser and Potter 1969)

so x_b need not be filtered backward. What is compared,

    x_f - x_b = P_f (x_f - x_s) / (P_f - P_s)      with the variance      P_f + P_b = P_f^2 / (P_f - P_s)

has the size of its sigma where models and sigmas are right.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.estimation.solution import Separation

_REMOVED = (
    1e-4  # share of P_f that the later measurements must remove: a backward sigma a hundred times the forward one
)


def compute_separation(
    frame: LocalFrame, t: Array, forward: Array, P_f: Array, smoothed: Array, P_s: Array
) -> Separation:
    """The separation of positions at keyframes.

    Parameters
    ----------
    t : (K,) s.
    forward, smoothed : (K, 3) m in the navigation frame, of the filter and of the smoother.
    P_f, P_s : (K, 3, 3) m^2, their covariances.

    Returns
    -------
    Separation
        In the local east, north and up; NaN where later measurements carry hardly any information, as at the end.
    """
    R = frame.R_ln(smoothed)
    apart = np.einsum("kij,kj->ki", R, forward - smoothed)
    before, after = (np.einsum("kij,kjl,kil->ki", R, P, R) for P in (P_f, P_s))
    told = before - after
    told[told < _REMOVED * before] = np.nan
    return Separation(t, before * apart / told, before / np.sqrt(told))
