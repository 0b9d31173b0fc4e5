"""The rows of a fleet as CSV and Parquet, and their totals."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.app.fleet.drive import AFTER_SPANS, DONE, FIRST_SPAN, MEASURED, FleetRow
from graphnav.core.notes import format_count
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
MEDIANS = {
    "span_end_h_median_m": "horizontal error at the end of a withheld span (m)",
    "h_rms_m": "horizontal error, rms (m)",
    "h_p95_m": "horizontal error, 95 % (m)",
    "h_max_m": "horizontal error, largest (m)",
    "up_rms_m": "height error, rms (m)",
    "3d_rms_m": "position error in space, rms (m)",
    "heading_rms_deg": "heading error, rms (deg)",
    "closure_h_m": "horizontal gap between end and start (m)",
    "nees_p": "NEES of the position, 1 where the sigmas are true",
    "nees_p_inside_95": "share of the positions within their 95 % regions",
    "sd_h_median_m": "horizontal sigma (m)",
}
_MOST_LOST = 10  # failed drives listed
_BADNESS = ("span_end_h_median_m", "h_rms_m", "sd_h_median_m")


def list_columns(rows: Sequence[FleetRow]) -> list[str]:
    """`COLUMNS`, plus one for the factor of each noise figure that any drive has."""
    return [*COLUMNS, *sorted({key for row in rows for key in row if key.startswith("noise.")})]


def write_fleet_csv(rows: Sequence[FleetRow], path: Path) -> None:
    """One line per drive; unknown values are blank."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list_columns(rows), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    path.write_text(text.getvalue(), encoding="utf-8")


def write_parquet(rows: Sequence[FleetRow], path: Path) -> bool:
    """Write the same as Parquet if pyarrow is installed; returns whether it is."""
    if find_spec("pyarrow") is None:
        return False
    import pyarrow as pa
    import pyarrow.parquet as pq

    def make_column(name: str) -> Any:
        values = [row.get(name) for row in rows]
        if name in _TEXTS:
            return pa.array(values, pa.string())
        return pa.array([None if value is None else float(value) for value in values], pa.float64())

    names = list_columns(rows)
    pq.write_table(pa.table({name: make_column(name) for name in names}), path, compression="zstd")
    return True


def sort_by_error(rows: Sequence[FleetRow]) -> list[FleetRow]:
    """Drives without a result first, then those with a doubtful result, then the rest, each ordered by error."""

    def rank(row: FleetRow) -> tuple[bool, bool, float]:
        off = next((float(row[key]) for key in _BADNESS if row.get(key) is not None), 0.0)
        return row["status"] == DONE, row.get("verdict") != "doubtful", -off

    return sorted(rows, key=rank)


def collect_numbers(rows: Sequence[FleetRow], key: str) -> Array:
    """The finite values of a column."""
    return np.array([float(row[key]) for row in rows if row.get(key) is not None])


def compute_totals(rows: Sequence[FleetRow]) -> dict[str, Any]:
    """The totals of a fleet."""
    status, solved = Counter(row["status"] for row in rows), [row for row in rows if row["status"] == DONE]
    return {
        "drives": len(rows),
        "status": dict(status),
        "doubtful": sum(row.get("verdict") == "doubtful" for row in rows),
        "hours": round(float(collect_numbers(solved, "duration_s").sum()) / 3600.0, 4),
        "km": round(float(collect_numbers(solved, "distance_m").sum()) / 1000.0, 3),
        "processor_s": round(float(collect_numbers(rows, "time_s").sum()), 1),
        "memory_mb": float(collect_numbers(rows, "memory_mb").max(initial=0.0)),
        "medians": {key: float(np.median(x)) for key in MEDIANS if len(x := collect_numbers(rows, key))},
    }


def describe_totals(found: Mapping[str, Any]) -> str:
    """The first line about a fleet."""
    statuses = ", ".join(f"{count} {status}" for status, count in found["status"].items())
    drives = format_count(found["drives"], "drive")
    return f"{drives}, {found['hours']:.2f} h, {found['km']:.1f} km: {statuses}; {found['doubtful']} doubtful"


def describe_unscored(rows: Sequence[FleetRow], withhold: float) -> str:
    """A line about the drives in which no span of `withhold` s could be withheld, "" if there are none."""
    solved = [row for row in rows if row["status"] == DONE]
    least = FIRST_SPAN + withhold + AFTER_SPANS
    count = sum(not row.get("placed") or row["duration_s"] < least for row in solved)
    if not count:
        return ""
    of = f"{count} of {format_count(len(solved), 'solved drive')}"
    return f"\nnothing withheld by --withhold {withhold:g} in {of}: no GNSS, or shorter than {least:g} s"


def format_totals(rows: Sequence[FleetRow]) -> str:
    """The totals, and the failed drives, for a terminal."""
    found = compute_totals(rows)
    lines = [describe_totals(found)]
    if found["medians"]:
        lines.append("medians of the drives:")
    lines += [f"  {MEDIANS[key]:<54}{value:10.4g}" for key, value in found["medians"].items()]
    lost = [row for row in rows if row["status"] != DONE]
    lines += [f"  {row['drive']}: {row['status']}: {row.get('error')}" for row in lost[:_MOST_LOST]]
    return "\n".join([*lines, *([f"  and {len(lost) - _MOST_LOST} more"] if len(lost) > _MOST_LOST else [])])
