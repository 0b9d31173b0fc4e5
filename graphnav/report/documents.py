"""report.html and comparison.html: the input, the results, their errors, and whether the sigmas are consistent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from graphnav.core.notes import Note, get_key
from graphnav.core.timescales import GPS_TO_UNIX, gps_to_utc
from graphnav.estimation.names import has_names, name_rows
from graphnav.estimation.solution import Solution
from graphnav.recording import Recording
from graphnav.report import page, pictures, summary, tables
from graphnav.report import sentences as words
from graphnav.report.beside import has_place
from graphnav.report.doubts import list_doubts
from graphnav.report.plots import PALETTE, Shades, Tinted
from graphnav.report.provenance import tabulate_provenance
from graphnav.report.satellites import make_satellite_parts
from graphnav.report.tables import Removed

if TYPE_CHECKING:
    from graphnav.estimation.noise.table import FigureRow
    from graphnav.evaluation.metrics import Errors

Sections = list[tuple[str, Sequence[Markup]]]


def write_report(
    path: str | Path,
    recording: Recording,
    solution: Solution,
    *,
    settings: Mapping[str, Any],
    metrics: Mapping[str, Any] | None = None,
    errors: Errors | None = None,
    withheld: Removed = (),
    outages: Tinted = (),
    findings: Sequence[str] = (),
    defects: Sequence[str] = (),
    contradicted: str | None = None,
    provenance: Mapping[str, Any] | None = None,
    detectors: Sequence[Markup] | None = None,
    noise: Sequence[FigureRow] = (),
    beside: Sequence[str] = (),
) -> Path:
    """One solver's report as one self-contained HTML file.

    Parameters
    ----------
    settings : resolved settings, nested plain values.
    metrics, errors : of `graphnav.evaluation.evaluate`, where there is a truth.
    withheld : (source, span), span in s from the recording's start or None for all of it.
    outages : s from the start, where the recording itself has no fixes.
    findings : sentences about the recording.
    defects : those that make the result wrong whatever its sigmas; the report begins with them.
    contradicted : a sentence if another solver of the same run contradicts this one; likewise.
    provenance : version, input hashes and the like, plain values; `options` are those of the command.
    detectors : of `draw_detectors`, for who writes several reports of one recording; drawn here if None.
    noise : figures of the noise model, of `graphnav.estimation.noise.table.tabulate_figures`.
    beside : names of files in the same folder to link to.
    """
    name, start, end = solution.solver, recording.start, recording.duration
    only, every = {name: solution}, {} if errors is None else {name: errors}
    spans = _list_shades(solution, start, withheld, outages)
    if detectors is None:
        detectors = draw_detectors(recording, solution)
    if not has_place(solution):  # nor the keyframes after it
        solution = replace(solution, separation=None)
    own, others = ({k: p for k, p in solution.parameters.items() if has_names(k) == of_it} for of_it in (True, False))
    sections: Sections = [
        ("Trajectory", _draw_paths(recording, only, spans)),
        (
            "Accuracy",
            [
                *tables.tabulate_all_accuracy(every, withheld, start, outages),
                *summary.tabulate_relative_errors(every),
                *tables.tabulate_metrics(metrics),
                *_make_gallery(pictures.draw_errors(every, start, end, spans)),
            ],
        ),
        ("Consistency of sigma", [*_describe_verdicts(only, every), *_draw_consistency(every, start, end, spans)]),
        (
            "Uncertainty",
            _make_gallery(
                [
                    *pictures.draw_sigmas({name: solution.trajectory(joint=False)}, start, end, spans),
                    *pictures.draw_separation(solution, start, end, spans),
                    *pictures.draw_quality(recording, solution, spans),
                ]
            ),
        ),
        (
            "Calibration",
            [
                *tables.tabulate_parameters(own),
                *_make_gallery(
                    [
                        *pictures.draw_biases(solution, start, end, spans),
                        *pictures.draw_parameters(own, name, start, end, spans),
                    ]
                ),
            ],
        ),
        (
            "Constraints",
            [
                *_make_gallery(pictures.draw_timeline(solution, recording, spans)),
                *tables.tabulate_constraints(solution),
                *tables.tabulate_rejected(solution, start),
                *_fold("Residuals of each", _make_gallery(pictures.record_pictures(solution, start, end, spans))),
            ],
        ),
        ("Satellites", make_satellite_parts(solution, start, end, spans)),
        (
            "Noise model",
            [
                *tables.tabulate_noise(noise, solution),
                *tables.tabulate_excluded(solution, start),
                *_fold(
                    "Noise processes, node by node",
                    [
                        *tables.tabulate_parameters(others),
                        *_make_gallery(pictures.draw_parameters(others, name, start, end, spans)),
                    ],
                ),
            ],
        ),
        (
            "Detectors",
            [
                *_make_gallery(detectors),
                *tables.tabulate_stops(solution, start, words.describe_deciding(recording, settings)),
            ],
        ),
        ("Findings", tables.list_findings(recording, findings)),
        ("Run", tables.tabulate_run(only)),
        ("Provenance", tabulate_provenance(settings, provenance)),
    ]
    lead = [
        *([] if contradicted is None else [page.paragraph(contradicted, "verdict bad")]),
        *_list_reasons(defects, only, every),
        page.paragraph(words.describe_run(recording, only, withheld, outages)),
        summary.tabulate_verdicts(solution, errors),
        *words.describe_closure(name, metrics),
        words.list_tiles(recording, only, every),
        *summary.list_links(beside),
        *summary.tabulate_fixes(recording, solution, withheld),
        page.columns([summary.tabulate_sigmas(solution), summary.tabulate_separation(solution)]),
        *summary.describe_excluded(solution, start),
    ]
    return _write_html(
        path, page.make_page(f"{recording.name}: {name}", lead, sections, _list_clocks(recording), _list_others(only))
    )


def write_comparison(
    path: str | Path,
    recording: Recording,
    solutions: Mapping[str, Solution],
    *,
    settings: Mapping[str, Any],
    metrics: Mapping[str, Mapping[str, Any]] | None = None,
    errors: Mapping[str, Errors] | None = None,
    withheld: Removed = (),
    outages: Tinted = (),
    findings: Sequence[str] = (),
    defects: Sequence[str] = (),
    provenance: Mapping[str, Any] | None = None,
    noise: Sequence[FigureRow] = (),
    beside: Sequence[str] = (),
) -> Path:
    """Several solvers on one recording as one self-contained HTML file; arguments as in `write_report`, per solver."""
    start, end = recording.start, recording.duration
    every, metrics_of = errors or {}, metrics or {}
    first = next(iter(solutions.values()))
    spans = _list_shades(first, start, withheld, outages)
    gone = tables.list_removed_spans(withheld)
    zooms = pictures.zoom_pictures(every, start, gone)
    if not gone:
        zooms = pictures.zoom_pictures(every, start, outages, "no GNSS")
    rows = [
        [
            name_rows(kind),
            page.format_solver(name),
            *tables.tabulate_record(tables.summarise_record(solution.records[kind])),
        ]
        for kind in dict.fromkeys(kind for s in solutions.values() for kind in s.records)
        for name, solution in solutions.items()
        if kind in solution.records
    ]
    measured = [table for name, values in metrics_of.items() for table in tables.tabulate_metrics(values, name)]
    tracks = {name: s.trajectory(joint=False) for name, s in solutions.items()}
    sections: Sections = [
        (
            "Accuracy",
            [
                *tables.tabulate_all_accuracy(every, withheld, start, outages),
                *summary.tabulate_relative_errors(every),
                *measured,
            ],
        ),
        ("Spans without GNSS" if not gone else "Withheld spans", _make_gallery(zooms)),
        ("Trajectory", _draw_paths(recording, solutions, spans)),
        ("Errors against truth", _make_gallery(pictures.draw_errors(every, start, end, spans))),
        ("Differences between solvers", _make_gallery(pictures.draw_differences(solutions, start, end, spans))),
        ("Consistency of sigma", _draw_consistency(every, start, end, spans)),
        ("Uncertainty", _make_gallery(pictures.draw_sigmas(tracks, start, end, spans))),
        ("Constraints", [page.make_table(["constraint", "solver", *tables.CONSISTENCY_HEAD], rows)] if rows else []),
        ("Noise model", [*tables.tabulate_noise(noise, first), *tables.tabulate_excluded(first, start)]),
        ("Findings", tables.list_findings(recording, findings)),
        ("Runs", tables.tabulate_run(solutions)),
        ("Provenance", tabulate_provenance(settings, provenance)),
    ]
    lead = [
        *_list_reasons(defects, solutions, every),
        page.paragraph(words.describe_run(recording, solutions, withheld, outages)),
        page.judged(_describe_verdicts(solutions, every)),
        *(note for name, values in metrics_of.items() for note in words.describe_closure(name, values)),
        words.list_tiles(recording, solutions, every),
        *summary.list_links(beside),
    ]
    html = page.make_page(
        f"{recording.name}: comparison", lead, sections, _list_clocks(recording), _list_others(solutions)
    )
    return _write_html(path, html)


def draw_detectors(recording: Recording, solution: Solution) -> list[Markup]:
    """The detectors' statistics, for `write_report`: the same for every solver of a recording."""
    return pictures.draw_detections(recording, solution.detections)


def _list_others(names: Iterable[str]) -> list[str]:
    """Those without a colour in the palette: other programs, and solvers that few use."""
    return [name for name in names if name not in PALETTE]


def _list_clocks(recording: Recording) -> list[page.TimeAxis]:
    """The recording's own clock, and GPS time and UTC where its zero is known."""
    out = [page.TimeAxis("time on the recording's clock [s]", recording.start)]
    if recording.gps_zero is not None:
        gps = recording.gps_zero + recording.start
        utc = (gps_to_utc(np.array([gps]))[0] - np.datetime64(0, "us")) / np.timedelta64(1, "s")
        out += [page.TimeAxis("UTC", float(utc), date=True), page.TimeAxis("GPS time", gps + GPS_TO_UNIX, date=True)]
    return out


def _list_shades(solution: Solution, start: float, withheld: Removed, outages: Tinted) -> Shades:
    """Spans of time to be tinted, s from the start, by kind."""
    excluded = [(part.t_start - start, part.t_end - start) for part in solution.excluded]
    gone = tables.list_removed_spans(withheld)
    return {"withheld": gone, "no GNSS": list(outages), "excluded": excluded}


def _list_reasons(
    defects: Sequence[str], solutions: Mapping[str, Solution], errors: Mapping[str, Errors]
) -> list[Markup]:
    """Reasons why the result cannot be trusted, if any."""
    found = [Note(get_key(one), f"This result cannot be trusted: {one}") for one in defects]
    return [page.paragraph(doubt, "verdict bad") for doubt in (*found, *list_doubts(solutions, errors))]


def _describe_verdicts(solutions: Mapping[str, Solution], errors: Mapping[str, Errors]) -> list[Markup]:
    """Per solver, whether its sigma is consistent with its errors."""
    if errors:
        return [words.describe_sigma(name, e) for name, e in errors.items()]
    # without truth, a filter's innovations test the common model better than any residuals
    filters = [s for s in solutions.values() if any(r.kind == "innovation" for r in s.records.values())]
    return [words.describe_sigma_without_truth(solution) for solution in filters or solutions.values()]


def _draw_paths(recording: Recording, solutions: Mapping[str, Solution], spans: Shades) -> list[Markup]:
    """Plan view, heights, and motion over time."""
    each = pictures.draw_trajectory(recording, solutions, spans), pictures.draw_profile(recording, solutions)
    return [*(page.gallery([one]) for one in each), *_make_gallery(pictures.draw_motion(recording, solutions, spans))]


def _draw_consistency(errors: Mapping[str, Errors], start: float, end: float, spans: Shades) -> list[Markup]:
    table = tables.tabulate_nees(errors)
    if not table:
        return []
    note = "Errors of one drive are correlated for seconds to minutes, so NEES scatters about 1 where sigma is true."
    return [*table, page.paragraph(note, "soft"), *_make_gallery(pictures.draw_nees(errors, start, end, spans))]


def _make_gallery(images: Sequence[Markup]) -> list[Markup]:
    return [page.gallery(images)] if images else []


def _fold(title: str, parts: Sequence[Markup]) -> list[Markup]:
    return [page.fold(title, parts)] if parts else []


def _write_html(path: str | Path, html: str) -> Path:
    path = Path(path)
    path.write_text(html, encoding="utf-8")
    return path
