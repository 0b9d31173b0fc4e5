"""What the pseudorange residuals of a single-point fix tell of its error.

Of n pseudoranges four determine position and clock, so nu = n - 4 check each other: with errors of variance s^2,
n rms^2 / s^2 is chi-square with nu degrees of freedom. Reflections make s differ from fix to fix, tenfold in a street,
and the error of the fix with it. With an inverse chi-square prior the residuals leave for s^2 the scale

    (s_0^2 + n rms^2) / (1 + nu)

The prior has the information of one redundant pseudorange (unit information), so that few satellites do not tell much,
and its s_0 is what a consumer receiver's pseudoranges are off by without reflections, 1 m. What exceeds s_0^2 is due to
these; how large the error of a fix is beside it is for the noise model to estimate.

Kass and Wasserman, "A reference Bayesian test for nested hypotheses and its relationship to the Schwarz criterion",
JASA 90 (1995).
"""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array

_UNKNOWNS = 4  # of a fix: position and clock; one more for each other system, which logs do not state
_USUAL = 1.0  # m, error of a pseudorange without reflections
_LEAST = 0.01  # m; a size of zero would have no logarithm


def compute_multipath_sigma(rms: Array, satellites: Array | None) -> Array:
    """1-sigma of the multipath in the pseudoranges of each fix, by their residuals.

    Parameters
    ----------
    rms : (N,) m, of the residuals, NaN where unknown.
    satellites : (N,) used; where unknown, one more than there are unknowns.

    Returns
    -------
    array
        (N,) m; as large as other errors where nothing checks the fix.
    """
    n = np.full(len(rms), np.nan) if satellites is None else satellites
    n = np.where(n >= 0.0, n, _UNKNOWNS + 1.0)
    redundant = np.maximum(n - _UNKNOWNS, 0.0)
    checked = np.isfinite(rms) & (rms >= 0.0) & (redundant > 0.0)
    whole = (_USUAL**2 + n * np.where(checked, rms, 0.0) ** 2) / (1.0 + redundant)
    return np.where(checked, np.sqrt(np.maximum(whole - _USUAL**2, _LEAST**2)), _USUAL)
