"""report.html and comparison.html: what was done on what, how good it is, and whether to believe the sigma."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graphnav import page
from graphnav import report_parts as parts
from graphnav.recording import Recording
from graphnav.report_parts import Spans
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
    spans: Spans = (),
    findings: Sequence[str] = (),
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """One solver's report as one self-contained HTML file.

    Parameters
    ----------
    settings : resolved settings, nested plain values.
    metrics, errors : of `graphnav.evaluation`, where there is a truth.
    spans : s from the recording's start, what was withheld: (start, end) or (source, start, end).
    findings : sentences about what was odd in the recording.
    provenance : version, input hashes and the like, plain values.
    """
    name, start, times = solution.solver, recording.start, parts.times_of(spans)
    every = {} if errors is None else {name: errors}
    html = page.page(
        f"{recording.name}: {name}",
        [
            page.paragraph(parts.what_was_done(recording, solution, spans)),
            parts.tiles(recording, {name: solution}, every),
        ],
        [
            ("Trajectory", [page.gallery([parts.trajectory_picture(recording, {name: solution}, times)])]),
            ("Accuracy", [*_accuracy(every, spans, start), *parts.metric_tables(metrics)]),
            ("Errors against truth", _gallery(parts.error_pictures(every, start, times))),
            ("Uncertainty", _gallery(parts.sigma_pictures({name: solution.trajectory()}, start, times))),
            ("Biases", _gallery(parts.bias_pictures(solution, start, times))),
            (
                "Constraints",
                [*parts.constraint_table(solution), *_gallery(parts.record_pictures(solution, start, times))],
            ),
            ("Calibration", parts.parameter_table(solution.parameters)),
            ("What was odd", parts.odd(recording, findings)),
            ("How it ran", parts.run_table({name: solution})),
            ("Provenance", parts.provenance_tables(settings, provenance)),
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
    spans: Spans = (),
    findings: Sequence[str] = (),
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """Several solvers on one recording as one self-contained HTML file; arguments as in `write_report`, per solver."""
    start, times = recording.start, parts.times_of(spans)
    every = errors or {}
    first = next(iter(solutions.values()))
    rows = [
        [kind, page.solver(name), *parts.consistency_row(parts.consistency(solution.records[kind]))]
        for kind in dict.fromkeys(kind for s in solutions.values() for kind in s.records)
        for name, solution in solutions.items()
        if kind in solution.records
    ]
    measured = [
        page.folded(f"All measures of {name}", page.pairs(page.flat(values)))
        for name, values in (metrics or {}).items()
        if values
    ]
    html = page.page(
        f"{recording.name}: comparison",
        [
            page.paragraph(parts.what_was_done(recording, first, spans, tuple(solutions))),
            parts.tiles(recording, solutions, every),
        ],
        [
            ("Accuracy", [*_accuracy(every, spans, start), *measured]),
            ("Withheld spans", _gallery(parts.zoom_pictures(every, start, times))),
            ("Trajectory", [page.gallery([parts.trajectory_picture(recording, solutions, times)])]),
            ("Errors against truth", _gallery(parts.error_pictures(every, start, times))),
            (
                "Uncertainty",
                _gallery(parts.sigma_pictures({n: s.trajectory() for n, s in solutions.items()}, start, times)),
            ),
            ("Constraints", [page.table(["constraint", "solver", *parts.CONSISTENCY_HEAD], rows)] if rows else []),
            ("What was odd", parts.odd(recording, findings)),
            ("How they ran", parts.run_table(solutions)),
            ("Provenance", parts.provenance_tables(settings, provenance)),
        ],
    )
    return _write(path, html)


def _accuracy(errors: Mapping[str, Errors], spans: Spans, start: float) -> list[str]:
    return [*(parts.believe(name, e) for name, e in errors.items()), *parts.accuracy_tables(errors, spans, start)]


def _gallery(pictures: Sequence[page.Raw]) -> list[str]:
    return [page.gallery(pictures)] if pictures else []


def _write(path: str | Path, html: str) -> Path:
    path = Path(path)
    path.write_text(html, encoding="utf-8")
    return path
