"""The rows of a fleet as CSV and Parquet, and their totals."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.app.fleet.drive import DONE, MEASURED, Row
from graphnav.core.rotation import Array

COLUMNS = (
    "drive", "status", "verdict", "error", "doubts", "platform", "solver", "duration_s", "distance_m", "keyframes",
    "against", *MEASURED, "sd_h_median_m", "sd_u_median_m", "sd_heading_median_deg", "spans", "span_end_h_median_m",
    "span_end_h_max_m", "left_out", "warnings", "time_s", "memory_mb", "source", "report", "version",
)  # fmt: skip
_TEXTS = (
    "drive",
    "status",
    "verdict",
    "error",
    "doubts",
    "platform",
    "solver",
    "against",
    "source",
    "report",
    "version",
)
_BADNESS = ("span_end_h_median_m", "h_rms_m", "sd_h_median_m")


def columns_of(rows: Sequence[Row]) -> list[str]:
    """`COLUMNS`, plus one for the factor of each noise figure that any drive has."""
    return [*COLUMNS, *sorted({key for row in rows for key in row if key.startswith("noise.")})]


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """One line per drive; unknown values are blank."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns_of(rows), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    path.write_text(text.getvalue(), encoding="utf-8")


def write_parquet(rows: Sequence[Row], path: Path) -> bool:
    """Write the same as Parquet if pyarrow is installed; returns whether it is."""
    if find_spec("pyarrow") is None:
        return False
    import pyarrow as pa
    import pyarrow.parquet as pq

    def column(name: str) -> Any:
        values = [row.get(name) for row in rows]
        if name in _TEXTS:
            return pa.array(values, pa.string())
        return pa.array([None if value is None else float(value) for value in values], pa.float64())

    names = columns_of(rows)
    pq.write_table(pa.table({name: column(name) for name in names}), path, compression="zstd")
    return True


def worst_first(rows: Sequence[Row]) -> list[Row]:
    """Drives without a result first, then those with a doubtful result, then the rest, each ordered by error."""

    def badness(row: Row) -> tuple[bool, bool, float]:
        off = next((float(row[key]) for key in _BADNESS if row.get(key) is not None), 0.0)
        return row["status"] == DONE, row.get("verdict") != "doubtful", -off

    return sorted(rows, key=badness)


def numbers(rows: Sequence[Row], key: str) -> Array:
    """The finite values of a column."""
    return np.array([float(row[key]) for row in rows if row.get(key) is not None])


def totals(rows: Sequence[Row]) -> dict[str, Any]:
    """The totals of a fleet."""
    status, solved = Counter(row["status"] for row in rows), [row for row in rows if row["status"] == DONE]
    return {
        "drives": len(rows),
        "status": dict(status),
        "doubtful": sum(row.get("verdict") == "doubtful" for row in rows),
        "hours": round(float(numbers(solved, "duration_s").sum()) / 3600.0, 4),
        "km": round(float(numbers(solved, "distance_m").sum()) / 1000.0, 3),
        "processor_s": round(float(numbers(rows, "time_s").sum()), 1),
        "memory_mb": float(numbers(rows, "memory_mb").max(initial=0.0)),
        "medians": {key: float(np.median(x)) for key in (*MEASURED, *_BADNESS) if len(x := numbers(rows, key))},
    }


def text(rows: Sequence[Row], most: int = 10) -> str:
    """The totals, and the failed drives, for a terminal."""
    found = totals(rows)
    said = ", ".join(f"{count} {status}" for status, count in found["status"].items())
    lines = [
        f"{found['drives']} drives, {found['hours']:.2f} h, {found['km']:.1f} km: {said}; {found['doubtful']} doubtful"
    ]
    lines += [f"  median {key:<22}{value:10.4g}" for key, value in found["medians"].items()]
    lost = [row for row in rows if row["status"] != DONE]
    lines += [f"  {row['drive']}: {row['status']}: {row.get('error')}" for row in lost[:most]]
    return "\n".join([*lines, *([f"  and {len(lost) - most} more"] if len(lost) > most else [])])
