"""Uniform B-splines, of which every simulated motion consists.

Their coefficients are values of the desired function at the splines' centres. Where neighbouring coefficients are equal
the spline is exactly constant, so a stop is exact; the derivative and the integral are splines again, so motion, rate
and force are exactly consistent. De Boor, *A Practical Guide to Splines* (2001), ch. IX-XI.
"""

from __future__ import annotations

import zlib

import numpy as np
from scipy.interpolate import BSpline

from graphnav.core.rotation import Array


def list_centres(start: float, end: float, step: float, degree: int) -> Array:
    """The times (J,), s, at which the coefficients of a spline on [start, end] are taken."""
    count = int(np.ceil((end - start) / step - 1e-9)) + degree
    return start + (np.arange(count) - (degree - 1) / 2) * step


def make_spline(start: float, step: float, coefficients: Array, degree: int) -> BSpline:
    """The spline with coefficients (J, ...) at `centres(start, ..., step, degree)`."""
    knots = start + (np.arange(len(coefficients) + degree + 1) - degree) * step
    return BSpline(knots, np.asarray(coefficients, dtype=float), degree)


def make_random(seed: int, part: str) -> np.random.Generator:
    """The random numbers of one part of a simulation, independent of changes to other parts."""
    return np.random.default_rng([seed, zlib.crc32(part.encode())])
