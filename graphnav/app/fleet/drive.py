"""One drive of a fleet: solved, written, and summarised in a row; or the sentence that states why not."""

from __future__ import annotations

import hashlib
import json
import math
import time
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import graphnav
from graphnav.app import outputs
from graphnav.app.fleet.manifest import Task
from graphnav.app.reading import AskedPart, read_part
from graphnav.app.summary import compute_median_sigmas, summarise_solver
from graphnav.app.withholding import parse_withheld
from graphnav.app.workflow import Outcome, Request, parse_noise, run_request
from graphnav.config.files import parse_settings
from graphnav.core.errors import GraphnavError
from graphnav.core.files import check_regular, hash_file, parse_json, read_text
from graphnav.core.jsonable import write_json
from graphnav.core.memory import read_peak_memory_mb
from graphnav.core.staging import stage_results
from graphnav.estimation.noise.apply import select_weights
from graphnav.estimation.solution import Solution
from graphnav.recording import Recording

ROW_FILE = "drive.json"
DONE, REFUSED, FAILED, CRASHED, HUNG = "done", "refused", "failed", "crashed", "hung"
_FINAL = (DONE, REFUSED)  # statuses that the same program reproduces from the same input
_POINTS = 200  # points of a track on the map
FIRST_SPAN, AFTER_SPANS = 60.0, 30.0  # s without withheld spans at the start and at the end

FleetRow = dict[str, Any]


def solve_drive(task: Task) -> FleetRow:
    """Solve a drive and write its results, unless that is done already; returns its row in any case."""
    began = time.perf_counter()
    folder = Path(task.folder)
    row: FleetRow = {"drive": task.name, "status": FAILED, "source": task.source, "solver": task.solver}
    key = ""
    _forget_peak()
    try:
        key = hash_task(task)
        if not task.again and (there := read_row(folder, key)) is not None:
            return {**there, "drive": task.name, "source": task.source, "skipped": True}
        outcome = run_request(_make_request(task))
        with stage_results(folder, outcome.recording.files) as part:
            outputs.write_run(outcome, part, task.pages)
        if not task.pages:
            outputs.remove_pages(folder)
        row |= {"status": DONE, **_collect_figures(outcome)}
        row["report"] = str(Path("drives") / task.name / "report.html") if task.pages else None
    except GraphnavError as error:
        missing = error.key == "file.missing" and not Path(task.source).exists()
        row |= {"status": REFUSED, "error": f"{task.place}: {error}" if missing and task.place else str(error)}
    except MemoryError:
        row["error"] = "out of memory; raise --memory or solve a shorter part (start, end)"
    except OSError as error:
        row["error"] = f"{error.filename or 'input or output'}: {error.strerror or error}"
    except Exception as error:
        row["error"] = f"internal error: {type(error).__name__}: {error}"
    row |= {"time_s": round(time.perf_counter() - began, 3), "memory_mb": read_peak_memory_mb()}
    keep_row(folder, key, row)
    return row


def make_lost_row(task: Task, status: str, error: str, seconds: float) -> FleetRow:
    """The row of a drive whose process ended and so could not write one."""
    row: FleetRow = {"drive": task.name, "status": status, "source": task.source, "solver": task.solver, "error": error}
    row["time_s"] = round(seconds, 3)
    keep_row(Path(task.folder), "", row)
    return row


def keep_row(folder: Path, key: str, row: Mapping[str, Any]) -> None:
    """Write the row beside the drive's results; errors are ignored if the folder is not writable."""
    with suppress(GraphnavError), stage_results(folder) as part:
        write_json(part / ROW_FILE, {"key": key, "row": row})


def read_row(folder: Path, key: str | None = None) -> FleetRow | None:
    """The row of a drive that was solved earlier with the same key; with any key, if `key` is None."""
    try:
        values = parse_json(read_text(folder / ROW_FILE))
        row = values["row"]
        same = key is None or (values["key"] == key and row["status"] in _FINAL)
        return dict(row) if same else None
    except (GraphnavError, ValueError, KeyError, TypeError):
        return None


def hash_task(task: Task) -> str:
    """Hash of everything a result depends on: this version, all options, and every byte of input."""
    asked = {k: v for k, v in asdict(task).items() if k not in ("name", "source", "folder", "again", "place")}
    asked |= {"graphnav": graphnav.__version__, "noise": task.noise and hash_file(Path(task.noise))}
    asked["input"] = [(name, hash_file(path)) for name, path in _list_inputs(task.source)]
    return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()


def _list_inputs(source: str) -> Iterator[tuple[str, Path]]:
    """The input files of a recording, by their names in it; a built-in one has none."""
    path = Path(source)
    if path.is_dir():
        if not (path / "recording.toml").is_file():
            for file in sorted(one for one in path.rglob("*") if one.is_file()):
                yield str(file.relative_to(path)), file
            return
        path = path / "recording.toml"
    if not path.exists():
        return
    check_regular(path)
    yield path.name, path
    if path.suffix == ".toml":
        try:
            values = tomllib.loads(read_text(path))
        except (GraphnavError, tomllib.TOMLDecodeError, RecursionError):
            return  # reported when it is read
        for name in sorted({text for text in _list_texts(values) if len(text) < 255 and "\0" not in text}):
            if (path.parent / name).is_file():
                yield name, path.parent / name


def _list_texts(values: Any) -> Iterator[str]:
    if isinstance(values, str):
        yield values
    elif isinstance(values, Mapping | list):
        for one in values.values() if isinstance(values, Mapping) else values:
            yield from _list_texts(one)


def _make_request(task: Task) -> Request:
    """The request that `smooth` would make."""
    settings = parse_settings(task.settings)
    noise = parse_noise(task.noise, settings)[1] if task.noise else None
    withheld = tuple(parse_withheld(one) for one in task.without)
    if task.withhold is not None:
        part = read_part(AskedPart(task.source, task.start, task.end, allow_outside=task.allow_outside))
        withheld += tuple(("gnss", span) for span in choose_spans(part, task.withhold, task.start or 0.0))
    given = {"recording": task.source, "solver": task.solver, "fleet": True, "withhold": task.withhold}
    return Request(
        task.source, (task.solver,), settings, withheld, task.start, task.end, task.rate,
        {k: v for k, v in given.items() if v is not None}, noise, allow_outside=task.allow_outside,
    )  # fmt: skip


def choose_spans(recording: Recording, length: float, zero: float = 0.0) -> list[tuple[float, float]]:
    """Spans (s from the start of a recording of which this part begins at `zero`) whose fixes are withheld and scored.

    The first minute is kept, more than a span's length between two spans, so that each is an outage by itself, and half
    a minute at the end.
    """
    if recording.gnss is None:
        return []
    starts = np.arange(FIRST_SPAN, recording.duration - length - AFTER_SPANS + 1e-9, 2.0 * length + AFTER_SPANS)
    return [(float(zero + s), float(zero + s + length)) for s in starts]


def _collect_figures(outcome: Outcome) -> FleetRow:
    """The figures of a solved drive for its row."""
    ((name, solution),) = outcome.solutions.items()
    summary = summarise_solver(outcome, name, {}, {})
    measured: Mapping[str, Any] = {**(summary["errors"] or {}), **(summary["nees"] or {})}
    ends = [span["end_h_m"] for span in summary["spans"] if span.get("end_h_m") is not None]
    speed = np.linalg.norm(solution.states.v[:, :2], axis=1)
    doubts = [*summary["doubts"], *outcome.defects]
    return {
        "verdict": "doubtful" if doubts else "sound",
        "doubts": "; ".join(doubts) or None,
        "platform": outcome.recording.platform,
        "duration_s": round(outcome.recording.duration, 3),
        "distance_m": round(float(np.trapezoid(speed, solution.t)), 1),
        "keyframes": len(solution.t),
        "against": outcome.against,
        **{key: measured.get(key) for key in MEASURED},
        **{key: _round_figure(value) for key, value in compute_median_sigmas(solution).items()},
        "spans": len(ends),
        "span_end_h_median_m": _round_figure(float(np.median(ends))) if ends else None,
        "span_end_h_max_m": max(ends, default=None),
        "left_out": _measure_left_out(solution),
        "warnings": len(outcome.warnings),
        **{
            f"noise.{group}": _round_figure(figure.get("variance_factor"))
            for group, figure in summary["noise"]["figures"].items()
        },
        "placed": outcome.recording.placed,
        "track": _track(outcome, solution),
        "version": graphnav.__version__,
    }


MEASURED = (
    "h_rms_m",
    "h_p95_m",
    "h_max_m",
    "up_rms_m",
    "3d_rms_m",
    "heading_rms_deg",
    "nees_p",
    "nees_p_inside_95",
    "closure_h_m",
)


def _measure_left_out(solution: Solution) -> float | None:
    """The share of the fixes' information that is excluded."""
    fixes = solution.records.get("gnss_position")
    if fixes is None or not len(fixes.t):
        return None
    return round(1.0 - float(np.mean(select_weights(fixes.t, solution.noise, "gnss_position"))), 5)


def _track(outcome: Outcome, solution: Solution) -> list[list[float]] | None:
    """Longitudes and latitudes (deg) of a few points, if the recording has a place on the Earth."""
    if outcome.recording.gnss is None:
        return None
    few = np.unique(np.linspace(0, len(solution.t) - 1, _POINTS).round().astype(int))
    degrees = np.rad2deg(solution.frame.to_llh(solution.states.p[few])[:, [1, 0]])
    return [[round(float(x), 6) for x in point] for point in degrees]


def _round_figure(x: float | None) -> float | None:
    """Round to five digits, as in a summary."""
    return None if x is None or not math.isfinite(x) else float(f"{x:.5g}")


def _forget_peak() -> None:
    """Reset the peak memory counter, where the system permits."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
