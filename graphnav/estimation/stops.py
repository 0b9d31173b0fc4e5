"""Every stop, or stance of a foot: the detectors that found it, and the rows that a solver built from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphnav.config.detectors import FUSED
from graphnav.constraints import list_constraints
from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.detectors.base import Detection, measure_overlap
from graphnav.estimation.solution import ConstraintRecord, Solution

DETECTIONS_HEAD = "start,end,detector,fired,rows"  # columns of detections.csv


@dataclass(frozen=True)
class Stop:
    """A span in which the platform is stationary."""

    start: float  # s
    end: float  # s
    fired: Mapping[str, float]  # share of it that each detector calls stationary; detectors that call none are omitted
    rows: Mapping[str, int]  # number of rows of each constraint that were used because of it

    def format_fired(self) -> str:
        """The detectors that found it, and the share that each found."""
        return ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in self.fired.items())

    def to_dict(self) -> dict[str, Any]:
        """The stop for JSON."""
        fired = {name: round(share, 3) for name, share in self.fired.items()}
        return {"start": round(self.start, 4), "end": round(self.end, 4), "fired": fired, "rows": dict(self.rows)}


def list_stops(found: Sequence[Detection], records: Mapping[str, ConstraintRecord] | None = None) -> tuple[Stop, ...]:
    """The stops in order.

    Parameters
    ----------
    found : by all detectors; those of one name are of pieces of the recording, and "fused" is what they come to.
    records : of a solver that used them; without, no rows are told.
    """
    spans = _collect_spans(found, FUSED)
    names = dict.fromkeys(d.name for d in found if d.name != FUSED)
    seconds = {name: measure_overlap(_collect_spans(found, name), spans) for name in names}
    made = {kind.name for kind in list_constraints() if kind.of_stops}
    used = {name: np.sort(record.t[record.weight > 0.0]) for name, record in (records or {}).items() if name in made}
    out = []
    for k, (start, end) in enumerate(spans):
        fired = {name: float(s[k] / (end - start)) for name, s in seconds.items() if s[k] > 0.0}
        within = {name: np.searchsorted(t, [start - SAME_TIME, end + SAME_TIME]) for name, t in used.items()}
        rows = {name: int(last - first) for name, (first, last) in within.items() if last > first}
        out.append(Stop(float(start), float(end), fired, rows))
    return tuple(out)


def list_solution_stops(solution: Solution) -> tuple[Stop, ...]:
    """The stops that a solver used, with its rows."""
    return list_stops(solution.detections, solution.records)


def format_detections(found: Sequence[Detection], records: Mapping[str, ConstraintRecord] | None = None) -> str:
    """The content of detections.csv: a row per interval and detector, the fused one last.

    The rows of fused stops state the share that each detector calls stationary, and the number of rows by constraint:
    "low_band_glrt:0.97 fft:0.41" and "zero_velocity:23 zero_rate:23".
    """
    rows = [f"{a:.4f},{b:.4f},{d.name},," for d in found if d.name != FUSED for a, b in d.intervals]
    for stop in list_stops(found, records):
        fired = " ".join(f"{name}:{share:.2f}" for name, share in stop.fired.items())
        used = " ".join(f"{name}:{count}" for name, count in stop.rows.items())
        rows.append(f"{stop.start:.4f},{stop.end:.4f},{FUSED},{fired},{used}")
    return "\n".join([DETECTIONS_HEAD, *rows]) + "\n"


def _collect_spans(found: Sequence[Detection], name: str) -> Array:
    """(M, 2) s, all intervals of one name."""
    return np.concatenate([np.empty((0, 2)), *(d.intervals for d in found if d.name == name)])
