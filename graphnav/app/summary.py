"""The numbers of a run for programs and tables: summary.json, the comparison of solvers, noise figures, provenance."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

import graphnav
from graphnav.app.workflow import Outcome
from graphnav.core.files import hash_file
from graphnav.core.findings import Finding
from graphnav.core.memory import read_peak_memory_mb
from graphnav.core.notes import get_key
from graphnav.estimation.solution import Solution
from graphnav.estimation.stops import list_solution_stops
from graphnav.evaluation.against import find_antenna_lever_arm, select_own
from graphnav.evaluation.metrics import round_figure

if TYPE_CHECKING:
    from graphnav.estimation.noise.table import FigureRow


def summarise_solver(
    outcome: Outcome, name: str, seconds: Mapping[str, float], provenance: Mapping[str, Any]
) -> dict[str, Any]:
    """The content of summary.json; `seconds` are those of writing, by file."""
    from graphnav.evaluation.metrics import summarise
    from graphnav.report.doubts import find_departures, list_doubts

    solution, metrics = outcome.solutions[name], outcome.metrics.get(name)
    errors = None if metrics is None else summarise(metrics)
    spans = [] if errors is None else errors.pop("spans", [])
    notes = list(solution.notes) if errors is None else [*solution.notes, *errors.pop("notes", [])]
    nees = None
    if errors is not None:
        nees = {key: value for key, value in errors.items() if key.startswith("nees_")}
        errors = {key: value for key, value in errors.items() if key not in nees}
    doubts = list_doubts({name: solution}, {} if metrics is None or metrics.errors is None else {name: metrics.errors})
    contradicted = find_departures(outcome.solutions).get(name)  # which no solution holds by itself
    doubts = doubts if contradicted is None else (contradicted, *doubts)
    timings = {**solution.timings, "evaluation": outcome.timings["evaluation"], **seconds}
    unreliable = [Finding("unreliable", doubt, get_key(doubt)) for doubt in doubts]
    messages = dict.fromkeys([*unreliable, *outcome.checks, *(Finding("note", note, get_key(note)) for note in notes)])
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
            "each": [stop.to_dict() for stop in list_solution_stops(solution)],
        },
        "ambiguities": _count_ambiguities(solution),
        "iterations": solution.iterations,
        "passes": {"filter": 0, "smoother": 0, **solution.passes, "eliminations": solution.iterations},
        "noise": summarise_noise(outcome, solution),
        "doubts": list(doubts),
        "stopped": solution.stopped,
        "final_cost": solution.cost,
        "timings": {stage: round(seconds, 4) for stage, seconds in timings.items()},
        "peak_memory_mb": read_peak_memory_mb(),
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
        "antenna_lever_arm": find_antenna_lever_arm(outcome.recording, solution),
        "gps_zero": outcome.recording.gps_zero,
        "notes": list(dict.fromkeys(notes)),
        "remarks": list(outcome.findings),
        "checks": [f.to_dict() for f in outcome.checks],
        "messages": [f.to_dict() for f in messages],
        "settings": outcome.request.select_settings(solution.solver).model_dump(),
        "provenance": provenance,
    }


def _count_ambiguities(solution: Solution) -> dict[str, Any] | None:
    """Number of epochs with carriers against a base station that have integer and real-valued ambiguities."""
    epochs = len(solution.fixed)
    if not epochs:
        return None
    fixed = solution.fixed[:, 1] > 0.0
    first = float(solution.fixed[fixed, 0][0] - solution.t[0]) if fixed.any() else None
    return {"epochs": epochs, "fixed": int(fixed.sum()), "float": int((~fixed).sum()), "first_fix_s": first}


def list_noise_figures(outcome: Outcome, solution: Solution) -> tuple[FigureRow, ...]:
    """The figures of a solution's noise model beside the stated ones."""
    from graphnav.estimation.noise.table import tabulate_figures

    recording, settings = outcome.recording, outcome.request.settings
    for source, span in outcome.used_withheld:
        if source in recording.aiding:
            recording = recording.without(source, span)
    return tabulate_figures(solution.noise, recording, settings.gnss.slow_times, outcome.densities)


def summarise_noise(outcome: Outcome, solution: Solution) -> dict[str, Any]:
    """The noise model in the form that `graphnav.estimation.noise.files.read_noise` reads, with stated and used
    figures.
    """
    from graphnav.estimation.noise.files import list_noise

    values = list_noise(solution.noise, outcome.request.settings.noise.mode)
    if len(solution.between) > 1:
        values["pieces"] = len(solution.between)
    for row in list_noise_figures(outcome, solution):
        beside = {"stated": row.stated, "used": row.used, "unit": row.unit, "correlation_time": row.correlation_time}
        values["figures"][row.group] |= beside
    return values


def tabulate_comparison(outcome: Outcome, ours: bool = False) -> list[dict[str, Any]]:
    """One flat row per solver: errors where there is a truth, stated sigmas, seconds and iterations."""
    from graphnav.evaluation.metrics import tabulate

    measured = {row["solver"]: row for row in tabulate(outcome.metrics)}
    rows = []
    for name, solution in (select_own(outcome.solutions) if ours else outcome.solutions).items():
        row = measured.get(name, {"solver": name})
        row |= {key: round_figure(value) for key, value in compute_median_sigmas(solution).items()}
        row |= {
            "keyframes": len(solution.t),
            "iterations": solution.iterations,
            "final_cost": round_figure(solution.cost),
        }
        row["run_time_s"] = round_figure(sum(solution.timings.values()))
        for key in [k for k in row if k.startswith("span") and k.endswith(("_start_s", "_end_s"))]:
            row[key] = round(row[key] + outcome.zero, 6)
        rows.append(row)
    return rows


def compute_median_sigmas(solution: Solution) -> dict[str, float]:
    """Medians of a solution's stated sigmas: horizontal and up (m), heading (deg)."""
    track = solution.trajectory(joint=False)
    out = {}
    if track.sd_p is not None:
        out["sd_h_median_m"] = float(np.median(np.hypot(track.sd_p[:, 0], track.sd_p[:, 1])))
        out["sd_u_median_m"] = float(np.median(track.sd_p[:, 2]))
    if track.sd_rph is not None:
        out["sd_heading_median_deg"] = float(np.degrees(np.median(track.sd_rph[:, 2])))
    return out


def gather_provenance(outcome: Outcome) -> dict[str, Any]:
    """Versions, inputs (with their sha256), the source of the noise model, and the command line."""
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
        "inputs": {str(path): hash_file(path) for path in files},
        "options": dict(outcome.request.options),
    }
