"""Values as plain JSON, and the most memory that this process ever held."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def peak_memory_mb() -> float:
    """The most memory this process ever held, MB of 2^20 bytes."""
    try:
        # where there is one: ru_maxrss of a process that was forked counts its parent's memory as well
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) / 1024.0, 1)
    except (OSError, ValueError):
        pass
    import resource  # not on Windows

    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(size / (1024.0**2 if sys.platform == "darwin" else 1024.0), 1)


def write_json(path: Path, values: Any) -> None:
    """Plain JSON: arrays as lists, whatever is not finite as null."""
    path.write_text(json_text(values) + "\n", encoding="utf-8")


def json_text(values: Any) -> str:
    """Values as indented JSON, as `write_json` writes them."""
    return json.dumps(_plain(values), indent=2, ensure_ascii=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, np.ndarray):
        plain = value.dtype.kind in "bi" or (value.dtype.kind == "f" and bool(np.isfinite(value).all()))
        return value.tolist() if plain else _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)
