"""What a run leaves on disk: trajectories, calibration, summary and report per solver, and the comparison."""

from __future__ import annotations

import math
import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import graphnav
from graphnav.app import stored
from graphnav.app.stored import attach_recording, sha256, write_outcome
from graphnav.app.workflow import Outcome, outages
from graphnav.core.errors import ConfigError, PartlyWrittenError
from graphnav.core.files import exists
from graphnav.core.findings import Finding
from graphnav.core.jsonable import peak_memory_mb, write_json
from graphnav.core.notes import key_of
from graphnav.core.timescales import gps_to_utc
from graphnav.estimation.solution import ParameterEstimate, Solution
from graphnav.estimation.stops import detections_text, stops_of_solution
from graphnav.evaluation.against import antenna_lever_arm, own_solutions

if TYPE_CHECKING:
    from graphnav.estimation.noise.table import FigureRow
    from graphnav.evaluation.metrics import Metrics
    from graphnav.report.page import Raw


FILES = (
    "trajectory.csv", "trajectory.kml", "trajectory.gpx", "trajectory.tum", "calibration.json", "detections.csv",
    "summary.json", "report.html", "comparison.csv", "comparison.html",
)  # fmt: skip


def output_folder(path: str | Path, files: Sequence[str] = (), folders: Sequence[str] = ()) -> Path:
    """`path`, sure to be a folder that can be written to or made; it is not made yet.

    Parameters
    ----------
    files, folders : what is to be written there: nothing of another kind may be in the way.

    Raises
    ------
    ConfigError
        If it cannot.
    """
    folder = Path(path)
    there = folder
    while not exists(there, ConfigError) and there != there.parent:
        there = there.parent
    if not there.is_dir():
        what = "is a file; name a folder to write into" if there == folder else f"cannot be made, {there} is a file"
        raise ConfigError(f"-o {folder}: {what}")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"-o {folder}: no permission to write into {there}")
    try:  # a file system that cannot be written to, a name that is too long or none: by trying
        (folder / max(FILES, key=len)).resolve().exists()
        os.rmdir(tempfile.mkdtemp(prefix=".graphnav-", dir=there))
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"-o {folder}: nothing can be written into {there} ({why})") from None
    for name in files:
        if (folder / name).is_dir():
            raise ConfigError(f"-o {folder}: {name} is a folder there, and a file of that name is to be written")
    for name in folders:
        if exists(folder / name, ConfigError) and not (folder / name).is_dir():
            raise ConfigError(f"-o {folder}: {name} is a file there, and a folder of that name is to be written")
    return folder


def write_run(outcome: Outcome, folder: Path, pages: bool = True) -> list[Path]:
    """Everything of the only solver of a run, straight into `folder`; returns the files to look at first.

    Without `pages` none is drawn; `draw_again` can do that later.
    """
    (name,) = own_solutions(outcome.solutions)
    provenance = _provenance(outcome)
    failed = write_solver(outcome, name, folder, provenance, pages=pages)
    write_outcome(outcome, provenance, folder / stored.NAME)
    _insist(failed)
    return [*([folder / "report.html"] if pages else []), folder / "trajectory.csv", folder / "summary.json"]


def write_comparison(outcome: Outcome, folder: Path, pages: bool = True) -> list[Path]:
    """Everything per solver under its own name, and the table and page that compare them; `pages` as in `write_run`."""
    from graphnav.evaluation.metrics import write_comparison_csv

    provenance = _provenance(outcome)
    detectors = None
    if pages:
        from graphnav.report import documents as report

        detectors = report.detector_pictures(outcome.recording, next(iter(outcome.solutions.values())))
    failed = []
    for name in own_solutions(outcome.solutions):
        failed += write_solver(outcome, name, folder / name, provenance, detectors, pages)
    write_comparison_csv(folder / "comparison.csv", comparison(outcome))
    if pages:
        failed += _attempt(lambda path: _draw_comparison(outcome, path.parent, provenance), folder / "comparison.html")
    write_outcome(outcome, provenance, folder / stored.NAME)
    _insist(failed)
    return [*([folder / "comparison.html"] if pages else []), folder / "comparison.csv"]


def remove_pages(folder: Path, solvers: Sequence[str] = ()) -> None:
    """Take away the pages of a run before, of which the results have been replaced without new ones."""
    for page in ("comparison.html", "report.html", *(f"{name}/report.html" for name in solvers)):
        (folder / page).unlink(missing_ok=True)


def draw_again(folder: Path, part: Path) -> list[Path]:
    """The pages of a run that was written into `folder`, drawn again into `part` without solving.

    Raises
    ------
    GraphnavError
        If there is none, or its recording has changed.
    """
    from graphnav.report import documents as report

    outcome, provenance = stored.read_outcome(folder / stored.NAME)
    outcome = attach_recording(outcome, provenance["inputs"])
    alone = not (folder / "comparison.csv").exists()
    detectors = report.detector_pictures(outcome.recording, next(iter(outcome.solutions.values())))
    files = []
    for name in own_solutions(outcome.solutions):
        place = part if alone else part / name
        place.mkdir(parents=True, exist_ok=True)
        _draw_solver(outcome, name, place, provenance, detectors)
        files.append(place / "report.html")
    if not alone:
        _draw_comparison(outcome, part, provenance)
        files = [part / "comparison.html", *files]
    return files


def _draw_comparison(outcome: Outcome, folder: Path, provenance: Mapping[str, Any]) -> None:
    from graphnav.evaluation.metrics import summary
    from graphnav.report import documents as report

    report.write_comparison(
        folder / "comparison.html",
        outcome.recording,
        outcome.solutions,
        settings=outcome.request.settings.model_dump(),
        metrics={name: summary(m) for name, m in outcome.metrics.items()},
        errors={name: m.errors for name, m in outcome.metrics.items() if m.errors is not None},
        withheld=outcome.used_withheld,
        outages=outages(outcome.recording),
        findings=_odd(outcome),
        provenance=provenance,
        noise=noise_rows(outcome, next(iter(outcome.solutions.values()))),
    )


def write_solver(
    outcome: Outcome,
    name: str,
    folder: Path,
    provenance: Mapping[str, Any],
    detectors: Sequence[Raw] | None = None,
    pages: bool = True,
) -> list[str]:
    """The files of one solver; a folder that holds older ones keeps none of them under the same names.

    Returns
    -------
    list of str
        What could not be written, and why: a picture that fails takes no number with it.
    """
    from graphnav.recording.exporters import write_parts

    solution = outcome.solutions[name]
    began = time.perf_counter()
    targets = {one: folder / f"trajectory.{one}" for one in ("csv", "kml", "tum", "gpx")}
    zero, title = outcome.recording.gps_zero, f"{outcome.recording.name}, {name}"
    folder.mkdir(parents=True, exist_ok=True)
    utc = None if zero is None else lambda t: gps_to_utc(t + zero)
    write_parts(solution.blocks(outcome.request.rate), targets, title, utc)
    write_json(folder / "calibration.json", {key: _calibration(p) for key, p in solution.parameters.items()})
    text = detections_text(solution.detections, solution.records)
    (folder / "detections.csv").write_text(text, encoding="utf-8")
    done = time.perf_counter()
    report = folder / "report.html"
    failed = _attempt(lambda _: _draw_solver(outcome, name, folder, provenance, detectors), report) if pages else []
    spent = {"writing": done - began, "report": time.perf_counter() - done}
    write_json(folder / "summary.json", solver_summary(outcome, name, spent, provenance))
    return failed


def _draw_solver(
    outcome: Outcome, name: str, folder: Path, provenance: Mapping[str, Any], detectors: Sequence[Raw] | None
) -> None:
    from graphnav.evaluation.metrics import summary
    from graphnav.report import documents as report

    solution, metrics = outcome.solutions[name], outcome.metrics.get(name)
    report.write_report(
        folder / "report.html",
        outcome.recording,
        solution,
        settings=outcome.request.settings.model_dump(),
        metrics=None if metrics is None else summary(metrics),
        errors=None if metrics is None else metrics.errors,
        withheld=outcome.used_withheld,
        outages=outages(outcome.recording),
        findings=_odd(outcome),
        provenance=provenance,
        detectors=detectors,
        noise=noise_rows(outcome, solution),
        beside=("trajectory.kml", "trajectory.gpx", "trajectory.csv"),
    )


def _attempt(write: Callable[[Path], object], path: Path) -> list[str]:
    """Write a file; what went wrong, if anything did, and then no file."""
    try:
        write(path)
    except Exception as error:
        path.unlink(missing_ok=True)
        return [f"{path.name} could not be written ({type(error).__name__}: {error})"]
    return []


def _insist(failed: Sequence[str]) -> None:
    if failed:
        raise PartlyWrittenError(f"{'; '.join(failed)}; all other files are there")


def solver_summary(
    outcome: Outcome, name: str, spent: Mapping[str, float], provenance: Mapping[str, Any]
) -> dict[str, Any]:
    """What summary.json holds; `spent` are the seconds of writing, which only the writer knows."""
    from graphnav.evaluation.metrics import summary
    from graphnav.report.sentences import doubts

    solution, metrics = outcome.solutions[name], outcome.metrics.get(name)
    errors = None if metrics is None else summary(metrics)
    spans = [] if errors is None else errors.pop("spans", [])
    notes = list(solution.notes) if errors is None else [*solution.notes, *errors.pop("notes", [])]
    nees = None
    if errors is not None:
        nees = {key: value for key, value in errors.items() if key.startswith("nees_")}
        errors = {key: value for key, value in errors.items() if key not in nees}
    doubted = doubts({name: solution}, {} if metrics is None or metrics.errors is None else {name: metrics.errors})
    timings = {**solution.timings, "evaluation": outcome.timings["evaluation"], **spent}
    said = [Finding("untrusted", doubt, key_of(doubt)) for doubt in doubted]
    messages = dict.fromkeys([*said, *outcome.checks, *(Finding("note", note, key_of(note)) for note in notes)])
    rejected = {key: int(np.sum(r.weight <= 1e-9)) for key, r in solution.records.items()}
    return {
        "solver": name,
        "recording": outcome.recording.name,
        "duration_s": round(outcome.recording.duration, 6),
        "keyframes": len(solution.t),
        "counts": solution.counts,
        "rejected": rejected,
        "stationary": {
            "stops": len(solution.stationary),
            "seconds": float(np.diff(solution.stationary).sum()),
            "each": [stop.values() for stop in stops_of_solution(solution)],
        },
        "ambiguities": _ambiguities(solution),
        "iterations": solution.iterations,
        "passes": {"filter": 0, "smoother": 0, **solution.passes, "eliminations": solution.iterations},
        "noise": noise_summary(outcome, solution),
        "doubts": list(doubted),
        "stopped": solution.stopped,
        "final_cost": solution.cost,
        "timings": {stage: round(seconds, 4) for stage, seconds in timings.items()},
        "peak_memory_mb": peak_memory_mb(),
        "against": outcome.against,
        "errors": errors,
        "spans": [
            {"missing": missing, **span, **{key: round(span[key] + outcome.zero, 6) for key in ("start_s", "end_s")}}
            for missing, span in zip(outcome.span_names, spans, strict=True)
        ],
        "nees": nees or None,
        "parameters": {
            key: {"value": p.value[-1], "sigma": p.sigma[-1], "unit": p.unit} for key, p in solution.parameters.items()
        },
        "antenna_lever_arm": antenna_lever_arm(outcome.recording, solution),
        "gps_zero": outcome.recording.gps_zero,
        "notes": list(dict.fromkeys(notes)),
        "remarks": list(outcome.findings),
        "checks": [f.values() for f in outcome.checks],
        "messages": [f.values() for f in messages],
        "settings": outcome.request.settings.model_dump(),
        "provenance": provenance,
    }


def _ambiguities(solution: Solution) -> dict[str, Any] | None:
    """Epochs with carriers against a base station: how many have integers and how many real numbers."""
    epochs = len(solution.fixed)
    if not epochs:
        return None
    fixed = solution.fixed[:, 1] > 0.0
    first = float(solution.fixed[fixed, 0][0] - solution.t[0]) if fixed.any() else None
    return {"epochs": epochs, "fixed": int(fixed.sum()), "float": int((~fixed).sum()), "first_fix_s": first}


def noise_rows(outcome: Outcome, solution: Solution) -> tuple[FigureRow, ...]:
    """The figures of a solution's noise model beside those stated."""
    from graphnav.estimation.noise.table import figure_rows

    recording, settings = outcome.recording, outcome.request.settings
    for source, span in outcome.used_withheld:
        if source in recording.aiding:
            recording = recording.without(source, span)
    imu = None
    if recording.platform == "foot" and any(group.startswith("imu.") for group in solution.noise.figures):
        # factors of a walk are relative to the densities of its rests
        from graphnav.estimation.noise.imu_floor import with_measured_floor
        from graphnav.imu.onboard_offset import without_onboard_offset

        imu = with_measured_floor(without_onboard_offset(recording, settings)[0], settings)[0].imu.noise
    return figure_rows(solution.noise, recording, settings.gnss.slow_times, imu)


def noise_summary(outcome: Outcome, solution: Solution) -> dict[str, Any]:
    """What `graphnav.estimation.noise.files.read_noise` reads, with what is stated and used beside each figure."""
    from graphnav.estimation.noise.files import noise_values

    values = noise_values(solution.noise, outcome.request.settings.noise.mode)
    if len(solution.between) > 1:
        values["pieces"] = len(solution.between)
    for row in noise_rows(outcome, solution):
        beside = {"stated": row.stated, "used": row.used, "unit": row.unit, "correlation_time": row.correlation_time}
        values["figures"][row.group] |= beside
    return values


def comparison(outcome: Outcome, ours: bool = False) -> list[dict[str, Any]]:
    """One flat row per solver: errors where there are any, stated sigmas, seconds and iterations."""
    from graphnav.evaluation.metrics import comparison_rows

    measured = {row["solver"]: row for row in comparison_rows(outcome.metrics)}
    rows = []
    for name, solution in (own_solutions(outcome.solutions) if ours else outcome.solutions).items():
        row = measured.get(name, {"solver": name})
        row |= {key: _round(value) for key, value in median_sigmas(solution).items()}
        row |= {"keyframes": len(solution.t), "iterations": solution.iterations, "final_cost": _round(solution.cost)}
        row["run_time_s"] = _round(sum(solution.timings.values()))
        for key in [k for k in row if k.startswith("span") and k.endswith(("_start_s", "_end_s"))]:
            row[key] = round(row[key] + outcome.zero, 6)
        rows.append(row)
    return rows


def median_sigmas(solution: Solution) -> dict[str, float]:
    """Medians of the sigmas a solution states of itself: horizontal and up (m), heading (deg)."""
    track = solution.trajectory()
    out = {}
    if track.sd_p is not None:
        out["sd_h_median_m"] = float(np.median(np.hypot(track.sd_p[:, 0], track.sd_p[:, 1])))
        out["sd_u_median_m"] = float(np.median(track.sd_p[:, 2]))
    if track.sd_rph is not None:
        out["sd_heading_median_deg"] = float(np.degrees(np.median(track.sd_rph[:, 2])))
    return out


def write_evaluation(folder: Path, values: Mapping[str, Any], metrics: Metrics) -> None:
    """evaluation.json, and errors.csv with a row per compared epoch where there are any."""
    from graphnav.recording.exporters.digits import rows_text

    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "evaluation.json", values)
    e = metrics.errors
    if e is None:
        return
    columns = [e.t[:, None], e.p, e.track, e.v, np.degrees(e.rph), e.sd_p]
    head = "t,east,north,up,along,across,ve,vn,vu,roll,pitch,heading,sd_e,sd_n,sd_u\n"
    body = rows_text(np.concatenate(columns, axis=1), "%.6f" + 14 * ",%.6g")
    (folder / "errors.csv").write_text(head + body, encoding="utf-8")


def _calibration(p: ParameterEstimate) -> dict[str, Any]:
    """A constant as its value, a slow parameter as its nodes."""
    nodes = slice(None) if len(p.t) > 1 else 0
    return {
        "unit": p.unit,
        **({"t": p.t} if len(p.t) > 1 else {}),
        "value": p.value[nodes],
        "sigma": p.sigma[nodes],
        "prior_sigma": p.prior_sigma,
        "seen_by_the_data": p.observable,
    }


def _odd(outcome: Outcome) -> list[str]:
    """What the report lists as odd."""
    lines = list(outcome.findings)
    if outcome.zero:
        lines.append(f"only a part is used: times here count from {outcome.zero:.3f} s after the recording's start")
    return lines


def _provenance(outcome: Outcome) -> dict[str, Any]:
    """Versions, what was read (with its sha256), where the noise model is from, and how the program was called."""
    given = outcome.request.noise
    files = [*outcome.recording.files, *([given.file] if given is not None and given.file is not None else [])]
    used: str = outcome.request.settings.noise.mode
    if given is not None:
        used = "given" if given.file is None else str(given.file)
    return {
        "graphnav": graphnav.__version__,
        "gtsam": version("gtsam"),
        "numpy": np.__version__,
        "scipy": version("scipy"),
        "python": platform.python_version(),
        "noise": used,
        "inputs": {str(path): sha256(path) for path in files},
        "options": dict(outcome.request.options),
    }


def _round(x: float) -> float | None:
    return float(f"{x:.5g}") if math.isfinite(x) else None
