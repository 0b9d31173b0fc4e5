"""Limits of axes, and the round values on them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from graphnav.rotation import Array


def ticks(lo: float, hi: float, count: int) -> tuple[Array, list[str]]:
    """Round values between lo and hi, about `count` of them, and their labels."""
    step = 10.0 ** math.floor(math.log10((hi - lo) / count))
    step *= next(m for m in (1, 2, 5, 10) if (hi - lo) / (step * m) <= count + 1e-9)
    values = np.arange(math.ceil(lo / step - 1e-9), math.floor(hi / step + 1e-9) + 1, dtype=float) * step
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    if digits > 4 or max(abs(lo), abs(hi)) >= 1e6:
        figures = math.ceil(math.log10(max(abs(lo), abs(hi)) / step)) + 1
        return values, [f"{v + 0.0:.{figures}g}" for v in values]
    return values, [f"{v + 0.0:.{digits}f}" for v in values]


def log_ticks(lo: float, hi: float) -> tuple[Array, list[str]]:
    """Ticks between the decimal logarithms lo and hi: decades, and the fewest of what lies between that make two."""
    every = max(1, math.ceil((hi - lo) / 6))
    decades = range(math.floor(lo), math.ceil(hi) + 1)
    values: list[float] = []
    for steps in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 5, 7), tuple(1 + k / 10 for k in range(90))):
        every_value = [m * 10.0**d for d in decades if d % every == 0 for m in steps]
        values = [v for v in every_value if lo - 1e-9 <= math.log10(v) <= hi + 1e-9]
        if len(values) >= 2:
            break
    return np.log10(values), [_power(v) for v in values]


def _power(value: float) -> str:
    """A number as it is, or a decade too long for that as a power of ten."""
    exponent = round(math.log10(value))
    if abs(exponent) < 4 or not math.isclose(value, 10.0**exponent):
        return f"{value:g}"
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def limits(values: Sequence[Array], floor: float = 0.0, symmetric: bool = False) -> tuple[float, float]:
    """Lowest and highest of all finite values with a margin; at least `floor` wide."""
    flat = np.concatenate([np.ravel(v) for v in values]) if values else np.zeros(0)
    flat = flat[np.isfinite(flat)]
    lo, hi = (float(flat.min()), float(flat.max())) if len(flat) else (0.0, 1.0)
    if symmetric:
        hi = max(abs(lo), abs(hi))
        lo = -hi
    margin = max(0.06 * (hi - lo), (floor - (hi - lo)) / 2, 1e-9 * max(abs(lo), abs(hi), 1e-3))
    return lo - margin, hi + margin
