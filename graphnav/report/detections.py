"""Output of `graphnav detect`: detections.csv, statistics.csv.gz, detections.html, a summary."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.interpolation import pick_nearest
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array
from graphnav.detectors import Detections
from graphnav.estimation.stops import format_detections, list_stops
from graphnav.recording import Recording
from graphnav.recording.exporters.digits import format_rows
from graphnav.report import page
from graphnav.report import pictures as report_pictures
from graphnav.report.wording import Quantity

_MAX_STOPS = 30  # stops listed at most


def write_detections(recording: Recording, found: Detections, folder: Path) -> list[Path]:
    """Write all files; times are on the recording's clock, as in trajectory.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    intervals, statistics = (folder / n for n in ("detections.csv", "statistics.csv.gz"))
    intervals.write_text(format_detections(found.all), encoding="utf-8")
    # no name and no time in the header, so that the same recording gives the same bytes
    with statistics.open("wb") as raw, gzip.GzipFile("", "wb", 5, raw, mtime=0) as file:
        file.write(format_statistics(found).encode())
    html = folder / "detections.html"
    html.write_text(_make_page(recording, found), encoding="utf-8")
    return [html, intervals, statistics]


def _make_page(recording: Recording, found: Detections) -> str:
    spans = found.stationary - recording.start
    rows = [
        [*(Quantity(f"{seconds:.2f} s") for seconds in (a, b, b - a)), stop.format_fired()]
        for (a, b), stop in zip(spans, list_stops(found.all), strict=True)
    ]
    lead = [page.paragraph(line) for line in _list_figures(recording, found)]
    sections = [
        ("Statistics", [page.gallery(report_pictures.draw_detections(recording, found.all))]),
        ("Stationary intervals", [page.make_table(["from", "to", "for", "share by detector"], rows)] if rows else []),
        ("Notes", [page.bullets(found.notes)] if found.notes else []),
    ]
    return page.make_page(f"{recording.name}: detectors", lead, sections)


def format_statistics(found: Detections) -> str:
    """Every detector's statistic, threshold and mask at the windows of the first; blank where there is none."""
    detections = [d for d in found.all if len(d.t)]
    if not detections:
        return "t\n"
    t = max(detections, key=lambda d: len(d.t)).t
    head, columns = ["t"], [t]
    for d in detections:
        k, near = _find_nearest(d.t, t)
        threshold = np.broadcast_to(d.threshold, d.t.shape)
        for values in (d.statistic, threshold, d.mask.astype(float)):
            columns.append(np.where(near, values[k], np.nan))
        head += [d.name, f"{d.name}_threshold", f"{d.name}_stationary"]
    form = ",".join(["%.4f", *["%.5g", "%.5g", "%.0f"] * len(detections)])
    return ",".join(head) + "\n" + format_rows(np.stack(columns, -1), form)


def _find_nearest(of: Array, t: Array) -> tuple[np.ndarray, np.ndarray]:
    """Row of `of` nearest to each time, and whether it is within half of its own spacing."""
    if len(of) == 1:
        return np.zeros(len(t), dtype=int), np.abs(t - of[0]) < 1.0
    k = pick_nearest(of, t)
    return k, np.abs(of[k] - t) <= 0.51 * float(np.median(np.diff(of))) + 1e-6


def list_values(recording: Recording, found: Detections) -> dict[str, Any]:
    """The detections for JSON; times are on the recording's clock, as in detections.csv."""
    return {
        "recording": recording.name,
        "duration_s": recording.duration,
        "stationary": found.stationary,
        "stops": [{key: x for key, x in stop.to_dict().items() if key != "rows"} for stop in list_stops(found.all)],
        "seconds_by_detector": {d.name: float(np.diff(d.intervals).sum()) for d in found.all},
        "notes": found.notes,
    }


def format_found(recording: Recording, found: Detections, files: list[Path]) -> str:
    """Stops, seconds, the idle line or why there is none, and the files written."""
    spans = found.stationary - recording.start
    first, stops, each = _list_figures(recording, found)
    lines = [first, f"  {stops}"]
    lines += [f"    {a:9.2f} - {b:9.2f}  {b - a:8.2f} s" for a, b in spans[:_MAX_STOPS]]
    if len(spans) > _MAX_STOPS:
        lines.append(f"    ... and {len(spans) - _MAX_STOPS} more in detections.csv")
    lines.append(f"  {each}")
    lines += [f"  note: {note}" for note in found.notes]
    return "\n".join([*lines, "", "look at", *(f"  {file}" for file in files)])


def _list_figures(recording: Recording, found: Detections) -> tuple[str, str, str]:
    """What was examined, the stationary share, and the notes of each detector."""
    spans = found.stationary
    seconds = float(np.diff(spans).sum()) if len(spans) else 0.0
    many = format_count(len(spans), "stop")
    share = f" ({100.0 * seconds / recording.duration:.1f} %)" if seconds else ""
    each = [f"{d.name} {float(np.diff(d.intervals).sum()) if len(d.intervals) else 0.0:.1f}" for d in found.all]
    return (
        f"{recording.name} ({recording.platform}): {recording.duration:.1f} s",
        f"{many}, {seconds:.1f} s in total{share}",
        f"seconds by detector: {', '.join(each)}" if each else "no detector has run",
    )
