"""What the pseudorange residuals of a single-point fix tell of its error.

Of n pseudoranges four determine position and clock, so nu = n - 4 check each other: with errors of variance s^2,
n rms^2 / s^2 is chi-square with nu degrees of freedom. Reflections make s differ from fix to fix, tenfold in a street,
and the error of the fix with it. The mean of s^2 that the residuals leave, with an inverse chi-square prior, is

    (s_0^2 + n rms^2) / (1 + nu)

The prior has the information of one redundant pseudorange (unit information), so that few satellites whose residuals
are small by chance are not trusted, and its s_0 is a consumer receiver's, 1 m. How large an error is beside s is for
the noise model to estimate.

Kass and Wasserman, "A reference Bayesian test for nested hypotheses and its relationship to the Schwarz criterion",
JASA 90 (1995).
"""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array

_UNKNOWNS = 4  # of a fix: position and clock; one more for each other system, which logs do not state
_USUAL = 1.0  # m, error of a pseudorange without reflections


def compute_range_sigma(rms: Array, satellites: Array | None) -> Array:
    """1-sigma of the pseudoranges of each fix, by their residuals.

    Parameters
    ----------
    rms : (N,) m, of the residuals, NaN where unknown.
    satellites : (N,) used; where unknown, one more than there are unknowns.

    Returns
    -------
    array
        (N,) m.
    """
    known = np.isfinite(rms) & (rms >= 0.0)
    n = np.full(len(rms), np.nan) if satellites is None else satellites
    n = np.where(n >= 0.0, n, _UNKNOWNS + 1.0)
    redundant = np.where(known, np.maximum(n - _UNKNOWNS, 0.0), 0.0)
    squares = np.where(known & (redundant > 0.0), n * np.nan_to_num(rms) ** 2, 0.0)
    return np.asarray(np.sqrt((_USUAL**2 + squares) / (1.0 + redundant)))
