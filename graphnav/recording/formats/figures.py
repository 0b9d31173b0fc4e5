"""Noise figures as data sheets print them: "0.15 deg/sqrt(h)", "7 deg/h", "60 ug/sqrt(Hz)", "300 ppm".

A figure is a number and a unit. Each key accepts the units of its quantity; a number alone is in SI.
"""

from __future__ import annotations

import math
import re
from typing import Any

_DEG, _G, _H = math.pi / 180.0, 9.80665, 3600.0
_TIME = {"s": 1.0, "min": 60.0, "h": _H}
_ANGLE = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": _DEG, "mdeg": 1e-3 * _DEG}
_RATE_UNITS = {f"{a}/{t}": x / y for a, x in _ANGLE.items() for t, y in _TIME.items()}
_RATE_UNITS |= {"dps": _DEG, "mdps": 1e-3 * _DEG, "dph": _DEG / _H}
_SPEED_UNITS = {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "m/h": 1.0 / _H}
_FORCE = {"m/s2": 1.0, "mm/s2": 1e-3, "g": _G, "mg": 1e-3 * _G, "ug": 1e-6 * _G, "gal": 1e-2, "mgal": 1e-5}


def _list_per_root(units: dict[str, float], roots: dict[str, float]) -> dict[str, float]:
    return {f"{u}/sqrt({r})": x / math.sqrt(y) for u, x in units.items() for r, y in roots.items()}


# a rate per root of frequency is a rate times a root of time: deg/s/sqrt(Hz) = deg/sqrt(s)
_HZ = {"hz": 1.0}
_GYRO_NOISE = _list_per_root(_RATE_UNITS, _HZ) | _list_per_root(_ANGLE, _TIME)
_ACCEL_NOISE = _list_per_root(_FORCE, _HZ) | _list_per_root(_SPEED_UNITS, _TIME)
# the same dimension written in two ways: rad/s/sqrt(s), as here, and rad/s2/sqrt(Hz), as in Kalibr
_GYRO_WALK = _list_per_root(_RATE_UNITS, _TIME) | _list_per_root({"rad/s2": 1.0, "deg/s2": _DEG}, _HZ)
_ACCEL_WALK = _list_per_root(_FORCE, _TIME) | _list_per_root({"m/s3": 1.0}, _HZ)
_RATIO = {"%": 1e-2, "ppm": 1e-6}

FIGURE_UNITS: dict[str, dict[str, float]] = {
    "gyro_noise_density": _GYRO_NOISE,
    "accel_noise_density": _ACCEL_NOISE,
    "gyro_bias_walk": _GYRO_WALK,
    "accel_bias_walk": _ACCEL_WALK,
    "gyro_bias_sigma": _RATE_UNITS,
    "accel_bias_sigma": _FORCE,
    "gyro_scale_sigma": _RATIO,
    "accel_scale_sigma": _RATIO,
}
EXAMPLES = {
    "gyro_noise_density": "0.15 deg/sqrt(h)",
    "accel_noise_density": "60 ug/sqrt(Hz)",
    "gyro_bias_walk": "2 deg/h/sqrt(h)",
    "accel_bias_walk": "20 ug/sqrt(h)",
    "gyro_bias_sigma": "7 deg/h",
    "accel_bias_sigma": "5 mg",
    "gyro_scale_sigma": "300 ppm",
    "accel_scale_sigma": "0.1 %",
}
_FIGURE_PATTERN = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d.].*?)\s*")


def parse_figure(key: str, value: Any) -> Any:
    """Convert a figure to SI: numbers unchanged, text by its unit. Anything else is left for the caller to refuse.

    Raises
    ------
    ValueError
        With a sentence that says what would be understood.
    """
    if not isinstance(value, str):
        return value
    found = _FIGURE_PATTERN.fullmatch(value)
    if found is None:
        raise ValueError(f"'{value}' is not a number and a unit, such as \"{EXAMPLES[key]}\"")
    number, unit = found.groups()
    factor = FIGURE_UNITS[key].get(_normalise_unit(unit))
    if factor is None:
        other = [
            name
            for name, units in FIGURE_UNITS.items()
            if _normalise_unit(unit) in units and name.split("_")[0] == key.split("_")[0]
        ]
        hint = f"; that is a unit of {other[0]}" if other else ""
        raise ValueError(
            f"'{unit}' is not a unit of {key}{hint}; write it as in \"{EXAMPLES[key]}\", or a number in SI"
        )
    return float(number) * factor


def _normalise_unit(unit: str) -> str:
    """Normalise a unit: lower case, no blanks, ASCII."""
    text = unit.lower().replace(" ", "").replace("·", "").replace("*", "")
    for old, new in (
        ("°", "deg"),
        ("º", "deg"),
        ("µ", "u"),
        ("μ", "u"),
        ("²", "2"),
        ("³", "3"),
        ("^", ""),
        ("√", "sqrt"),
    ):
        text = text.replace(old, new)
    text = re.sub(r"(?<!sq)rt(?=\(|hz)", "sqrt", re.sub(r"m/s/s(?![a-z])", "m/s2", text))
    text = re.sub(r"sqrt([a-z]+)", r"sqrt(\1)", text)
    text = re.sub(r"\b(hours?|hrs?)\b", "h", text)
    return re.sub(r"\b(sec(onds?)?)\b", "s", text)
