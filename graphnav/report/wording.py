"""Numbers and lists as text, without anything that draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any


def format_value(value: Any) -> Any:
    """A value as text; numbers with four significant digits."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return format_number(value) if isinstance(value, float) else value


def format_number(value: float, digits: int = 4) -> str:
    """A number for people: `digits` significant digits, whole from a thousand on, '-' where there is none.

    Below one, four decimals of an error in m are enough; below a hundredth one digit less than `digits`, at least two.
    """
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    size = abs(value)
    if size >= 1e7 or size < 1e-2:
        return f"{value:.{max(digits - 1, 2)}g}"
    places = max(0, digits - 1 - math.floor(math.log10(size)))
    return f"{value:.{min(places, max(digits, 3))}f}"


class Quantity(str):
    """A number and its unit, if any, as displayed: right-aligned in a table."""


def format_to_sigma(value: float, sigma: float) -> Quantity:
    """A value with as many decimals as its sigma justifies."""
    if not (math.isfinite(value) and math.isfinite(sigma)) or sigma <= 0:
        return Quantity(format_number(value))
    places = max(1 - math.floor(math.log10(sigma)), 0)
    return Quantity(f"{round(value, places) + 0.0:.{places}f}" if places <= 8 else f"{value:.4g}")  # without -0


def join_words(parts: Sequence[str]) -> str:
    """a, b and c"""
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]
