"""Values as plain JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def write_json(path: Path, values: Any) -> None:
    """Write plain JSON: arrays as lists, anything not finite as null."""
    path.write_text(format_json(values) + "\n", encoding="utf-8")


def format_json(values: Any) -> str:
    """Values as the text `write_json` writes: indented, lists of numbers or words on one line."""
    return _write_value(values, "\n")


# without indentation, the encoder written in C is used
_ENCODER = json.JSONEncoder(ensure_ascii=False, allow_nan=False)


def _write_value(value: Any, line: str) -> str:
    """A value as JSON; `line` is a line end with the indentation of the next line. A function of that is called."""
    deeper = line + "  "
    if callable(value):
        return str(value(line))
    if isinstance(value, Mapping):
        inner = [f"{_ENCODER.encode(str(key))}: {_write_value(one, deeper)}" for key, one in value.items()]
        return f"{{{deeper}{f',{deeper}'.join(inner)}{line}}}" if inner else "{}"
    if isinstance(value, np.ndarray | np.generic):
        plain = value.dtype.kind in "biuf" and bool(np.isfinite(value).all())
        value, dimensions = value.tolist(), value.ndim
        if plain and dimensions < 2:
            return _ENCODER.encode(value)
        if plain and dimensions == 2:  # one line per row, encoded together
            rows = _ENCODER.encode(value)[1:-1].replace("], [", f"],{deeper}[")
            return f"[{deeper}{rows}{line}]" if rows else "[]"
    if isinstance(value, Sequence) and not isinstance(value, str):
        try:
            if not any(isinstance(one, Mapping | np.ndarray | list | tuple) for one in value):
                return _ENCODER.encode(value)
        except (TypeError, ValueError):
            return f"[{', '.join(_write_value(one, deeper) for one in value)}]"
        return f"[{deeper}{f',{deeper}'.join(_write_value(one, deeper) for one in value)}{line}]"
    if isinstance(value, float) and not math.isfinite(value):
        return "null"
    return _ENCODER.encode(value if value is None or isinstance(value, str | int | float | bool) else str(value))
