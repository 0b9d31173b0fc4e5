"""Robust kernels as weights of iteratively re-weighted least squares.

With s the whitened norm of a whole measurement (not of one axis) and k its scale, a kernel replaces
s^2/2 by rho(s) and the solver weighs the rows by w = rho'(s)/s. Forms as in Zhang, "Parameter estimation
techniques" (1997), table 1, and Barron, "A general and adaptive robust loss function" (2019). "gnc" is truncated
least squares, reached from a convex cost by graduated non-convexity (Yang, Antonante, Tzoumas and Carlone 2020).
"""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array

REDESCENDING = ("geman-mcclure", "tukey", "welsch", "gnc")


def soften(kernel: str) -> str:
    """What stands for a kernel where nothing given up can be taken back: such as never quite gives up."""
    return "cauchy" if kernel in REDESCENDING else kernel


def weigh_squares(kernel: str, s: Array, k: float | Array, mu: float = np.inf) -> tuple[Array, Array]:
    """w(s) and rho(s) for whitened norms s (N,) and a scale k, or scales (N,).

    `mu` is of "gnc": 0 is convex, infinity truncated least squares.

    Raises
    ------
    ValueError
        For a kernel that does not exist.
    """
    x = (s / k) ** 2
    if kernel == "none":
        return np.ones_like(s), 0.5 * s * s
    if kernel == "huber":
        far = s > k
        w = np.where(far, k / np.maximum(s, 1e-300), 1.0)
        return w, np.where(far, k * s - 0.5 * k * k, 0.5 * s * s)
    if kernel == "cauchy":
        return 1.0 / (1.0 + x), 0.5 * k * k * np.log1p(x)
    if kernel == "geman-mcclure":
        return 1.0 / (1.0 + x) ** 2, 0.5 * k * k * x / (1.0 + x)
    if kernel == "tukey":
        inside = np.maximum(0.0, 1.0 - x)
        return inside**2, k * k / 6.0 * (1.0 - inside**3)
    if kernel == "welsch":
        return np.exp(-x), 0.5 * k * k * -np.expm1(-x)
    if kernel == "gnc":  # eq. 14 of Yang et al. and their eq. 6, the surrogate of truncated least squares
        low, high = (1.0, 1.0) if np.isinf(mu) else (mu / (mu + 1.0), (mu + 1.0) / mu)
        bent = 0.0 if np.isinf(mu) else np.sqrt(mu * (mu + 1.0))
        between = 0.0 if np.isinf(mu) else bent * k / np.maximum(s, 1e-300) - mu
        slope = 0.0 if np.isinf(mu) else k * s * bent - 0.5 * mu * (k * k + s * s)
        w = np.where(x <= low, 1.0, np.where(x >= high, 0.0, between))
        return w, np.where(x <= low, 0.5 * s * s, np.where(x >= high, 0.5 * k * k, slope))
    raise ValueError(f"no robust kernel '{kernel}'")
