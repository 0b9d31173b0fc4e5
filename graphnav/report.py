"""report.html and comparison.html: what was done on what, how good it is, and whether to believe the sigma."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graphnav import page
from graphnav import report_pictures as pictures
from graphnav import report_tables as tables
from graphnav.recording import Recording
from graphnav.report_tables import Withheld
from graphnav.solution import Solution

if TYPE_CHECKING:
    from graphnav.metrics import Errors


def write_report(
    path: str | Path,
    recording: Recording,
    solution: Solution,
    *,
    settings: Mapping[str, Any],
    metrics: Mapping[str, Any] | None = None,
    errors: Errors | None = None,
    withheld: Withheld = (),
    findings: Sequence[str] = (),
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """One solver's report as one self-contained HTML file.

    Parameters
    ----------
    settings : resolved settings, nested plain values.
    metrics, errors : of `graphnav.evaluation`, where there is a truth.
    withheld : (source, span), span in s from the recording's start or None for all of it.
    findings : sentences about what was odd in the recording.
    provenance : version, input hashes and the like, plain values.
    """
    name, start, times = solution.solver, recording.start, tables.times_of(withheld)
    every = {} if errors is None else {name: errors}
    metrics_of = {} if metrics is None else {name: metrics}
    html = page.page(
        f"{recording.name}: {name}",
        [
            page.paragraph(tables.what_was_done(recording, {name: solution}, withheld)),
            tables.tiles(recording, {name: solution}, every),
        ],
        [
            ("Trajectory", [page.gallery([pictures.trajectory_picture(recording, {name: solution}, times)])]),
            ("Accuracy", [*_accuracy(every, metrics_of, withheld, start), *tables.metric_tables(metrics)]),
            ("Errors against truth", _gallery(pictures.error_pictures(every, start, times))),
            ("Uncertainty", _gallery(pictures.sigma_pictures({name: solution.trajectory()}, start, times))),
            ("Biases", _gallery(pictures.bias_pictures(solution, start, times))),
            (
                "Constraints",
                [*tables.constraint_table(solution), *_gallery(pictures.record_pictures(solution, start, times))],
            ),
            ("Calibration", tables.parameter_table(solution.parameters)),
            ("What was odd", tables.odd(recording, findings)),
            ("How it ran", tables.run_table({name: solution})),
            ("Provenance", tables.provenance_tables(settings, provenance)),
        ],
    )
    return _write(path, html)


def write_comparison(
    path: str | Path,
    recording: Recording,
    solutions: Mapping[str, Solution],
    *,
    settings: Mapping[str, Any],
    metrics: Mapping[str, Mapping[str, Any]] | None = None,
    errors: Mapping[str, Errors] | None = None,
    withheld: Withheld = (),
    findings: Sequence[str] = (),
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """Several solvers on one recording as one self-contained HTML file; arguments as in `write_report`, per solver."""
    start, times = recording.start, tables.times_of(withheld)
    every, metrics_of = errors or {}, metrics or {}
    rows = [
        [kind, page.solver(name), *tables.consistency_row(tables.consistency(solution.records[kind]))]
        for kind in dict.fromkeys(kind for s in solutions.values() for kind in s.records)
        for name, solution in solutions.items()
        if kind in solution.records
    ]
    measured = [table for name, values in metrics_of.items() for table in tables.metric_tables(values, name)]
    html = page.page(
        f"{recording.name}: comparison",
        [
            page.paragraph(tables.what_was_done(recording, solutions, withheld)),
            tables.tiles(recording, solutions, every),
        ],
        [
            ("Accuracy", [*_accuracy(every, metrics_of, withheld, start), *measured]),
            ("Withheld spans", _gallery(pictures.zoom_pictures(every, start, times))),
            ("Trajectory", [page.gallery([pictures.trajectory_picture(recording, solutions, times)])]),
            ("Errors against truth", _gallery(pictures.error_pictures(every, start, times))),
            (
                "Uncertainty",
                _gallery(pictures.sigma_pictures({n: s.trajectory() for n, s in solutions.items()}, start, times)),
            ),
            ("Constraints", [page.table(["constraint", "solver", *tables.CONSISTENCY_HEAD], rows)] if rows else []),
            ("What was odd", tables.odd(recording, findings)),
            ("How they ran", tables.run_table(solutions)),
            ("Provenance", tables.provenance_tables(settings, provenance)),
        ],
    )
    return _write(path, html)


def _accuracy(
    errors: Mapping[str, Errors], metrics: Mapping[str, Mapping[str, Any]], withheld: Withheld, start: float
) -> list[str]:
    return [
        *(tables.believe(name, e) for name, e in errors.items()),
        *(note for name, values in metrics.items() for note in tables.closure_note(name, values)),
        *tables.accuracy_tables(errors, withheld, start),
    ]


def _gallery(images: Sequence[page.Raw]) -> list[str]:
    return [page.gallery(images)] if images else []


def _write(path: str | Path, html: str) -> Path:
    path = Path(path)
    path.write_text(html, encoding="utf-8")
    return path
