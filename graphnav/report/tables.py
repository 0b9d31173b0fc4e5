"""The tables of `graphnav.report.documents`, each from plain data to HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from graphnav.core.notes import Note, get_key
from graphnav.core.rotation import Array
from graphnav.estimation.names import name_components, name_rows
from graphnav.estimation.noise.model import INTERVALS, TABULATED
from graphnav.estimation.solution import ParameterEstimate, Solution
from graphnav.estimation.stops import list_solution_stops
from graphnav.evaluation.against import select_own
from graphnav.evaluation.segments import compute_rms
from graphnav.recording import Recording
from graphnav.report import page, wording
from graphnav.report.consistency import CONSISTENCY_HEAD, compute_mean, summarise_record, tabulate_record
from graphnav.report.plots import Tinted
from graphnav.report.wording import Quantity, join_words

if TYPE_CHECKING:
    from graphnav.estimation.noise.table import FigureRow
    from graphnav.evaluation.metrics import Errors

_MAX_ROWS = 40  # rejected measurements and stops listed at most
_UNFOLDED_ROWS = 10  # excluded spans and stops shown; the others are folded
Removed = Sequence[tuple[str, tuple[float, float] | None]]


def list_removed_spans(withheld: Removed) -> list[tuple[float, float]]:
    """The spans in which a source was withheld, each once."""
    return list(dict.fromkeys(span for _, span in withheld if span is not None))


def tabulate_constraints(solution: Solution) -> list[Markup]:
    """Counts of everything used, and the consistency of each record."""
    out = []
    rows = [[name_rows(kind), *tabulate_record(summarise_record(record))] for kind, record in solution.records.items()]
    if rows:
        out.append(page.make_table(["constraint", *CONSISTENCY_HEAD], rows))
        kinds = {r.kind for r in solution.records.values()}
        note = "A Gaussian leaves 0.27 % outside 3 sigma. "
        if "innovation" in kinds:
            note += "The mean NIS of consistent innovations is the number of components. "
        if "residual" in kinds:
            note += "A fit takes up part of the noise: the mean NIS of its residuals lies below the components."
        out.append(page.paragraph(note, "soft"))
    if solution.counts:
        counted = join_words([f"{count} {name_rows(kind)}" for kind, count in solution.counts.items()])
        out.append(page.paragraph(f"Factors or updates by kind: {counted}.", "soft"))
    return out


def _find_largest(x: Array) -> float:
    x = np.abs(x[np.isfinite(x)])
    return float(x.max()) if x.size else float("nan")


COMPARED_SPAN = ("horizontal RMS [m]", "largest [m]", "at the end [m]", "largest, % of path", "up largest [m]",
                 "heading largest [deg]", "error / sigma, RMS")  # fmt: skip
COMPARED = ("horizontal RMS [m]", "horizontal largest [m]", "up RMS [m]", "speed RMS [m/s]", "roll, pitch RMS [deg]",
            "heading RMS [deg]", "error / sigma, RMS")  # fmt: skip


def tabulate_accuracy(errors: Errors) -> list[float]:
    """The numbers under `COMPARED`."""
    rph = np.degrees(errors.rph)
    return [
        compute_rms(errors.horizontal),
        _find_largest(errors.horizontal),
        compute_rms(errors.p[:, 2]),
        compute_rms(np.linalg.norm(errors.v, axis=1)),
        compute_rms(rph[:, :2]),
        compute_rms(rph[:, 2]),
        float(np.sqrt(compute_mean(errors.nees_axis))),
    ]


def tabulate_span(errors: Errors, span: tuple[float, float], start: float) -> list[float]:
    """The numbers under `COMPARED_SPAN`, over a span in seconds from the recording's start."""
    t = errors.t - start
    rows = np.flatnonzero((t >= span[0]) & (t <= span[1]))
    rows = rows[np.isfinite(errors.horizontal[rows])]
    if not len(rows):
        return [float("nan")] * len(COMPARED_SPAN)
    h = errors.horizontal[rows]
    travelled = float(errors.distance[rows[-1]] - errors.distance[rows[0]])
    return [
        compute_rms(h),
        _find_largest(h),
        float(h[-1]),
        100.0 * _find_largest(h) / travelled if travelled >= 1.0 else float("nan"),
        _find_largest(errors.p[rows, 2]),
        float(np.degrees(_find_largest(errors.rph[rows, 2]))),
        float(np.sqrt(compute_mean(errors.nees_axis[rows]))),
    ]


def tabulate_all_accuracy(
    errors: Mapping[str, Errors], withheld: Removed, start: float, outages: Tinted = ()
) -> list[Markup]:
    """A table of all solvers over the whole run, and one for each withheld span."""
    if not errors:
        return []
    rows = [[page.format_solver(name), *tabulate_accuracy(e)] for name, e in errors.items()]
    out = [page.heading("Whole recording"), page.make_table(["solver", *COMPARED], rows, best=range(1, 7))]
    gone = list_removed_spans(withheld)
    spans = [("Withheld", span) for span in gone]
    spans += [("No GNSS", (a, b)) for a, b in outages if not any(c < b and d > a for c, d in gone)]
    if len(errors) == 1 and spans:
        (only,) = errors.values()
        rows = [
            [Quantity(f"{a:.1f} to {b:.1f} s"), what, *tabulate_span(only, (a, b), start)] for what, (a, b) in spans
        ]
        return [
            *out,
            page.heading("Spans without a source"),
            page.make_table(["span", "what", *COMPARED_SPAN], rows),
            *_list_notes(errors),
        ]
    for what, (a, b) in spans:
        rows = [[page.format_solver(name), *tabulate_span(e, (a, b), start)] for name, e in errors.items()]
        out.append(page.heading(f"{what} {a:g} to {b:g} s" if what == "Withheld" else f"{what} {a:.1f} to {b:.1f} s"))
        out.append(page.make_table(["solver", *COMPARED_SPAN], rows, best=range(1, 7)))
    return [*out, *_list_notes(errors)]


def _list_notes(errors: Mapping[str, Errors]) -> list[Markup]:
    shared = [note for note in next(iter(errors.values())).notes if all(note in e.notes for e in errors.values())]
    notes = shared + [f"{name}: {note}" for name, e in errors.items() for note in e.notes if note not in shared]
    return [page.bullets(notes)] if notes else []


_OF_IMU = dict(zip(INTERVALS, ("gyro", "accelerometer"), strict=True))
NOISE_HEAD = ("figure", "stated", "used", "unit", "times stated sigma", "1-sigma", "correlation time [s]",
              "degrees of freedom", "prior")  # fmt: skip


def tabulate_noise(rows: Sequence[FigureRow], solution: Solution) -> list[Markup]:
    """The noise model, and the rows that are down-weighted."""
    noise = solution.noise
    if not rows and not noise.weights:
        return [page.paragraph(Note("noise.as_stated", "All noise figures are used as they are stated."))]
    out = []
    if rows:
        cells = [
            [
                row.words,
                float("nan") if row.stated is None else row.stated,
                float("nan") if row.used is None else row.used,
                row.unit or "-",
                float(np.exp(0.5 * row.figure.log_factor)),
                _format_range(row.figure.log_factor, row.figure.sigma),
                float("nan") if row.correlation_time is None else row.correlation_time,
                Quantity(f"{row.figure.freedom:.0f}"),
                _format_range(row.figure.prior, row.figure.prior_sigma),
            ]
            for row in rows
        ]
        out.append(page.make_table(NOISE_HEAD, cells))
        note = (
            "Stated figures of fixes are medians of their sigmas. The white part and the lasting parts add up as "
            "variances. A figure with few degrees of freedom is mostly its prior."
        )
        if len(solution.between) > 1:
            cut = f"The recording was cut into {len(solution.between)} pieces: these are the figures of the first."
            out.append(page.paragraph(Note("noise.of_first_piece", cut), "soft"))
        out.append(page.paragraph(note, "soft"))
    less = [
        f"Errors of {name} have tails as of a Student t distribution with "
        f"{wording.format_number(noise.tails.get(name, np.inf), 2)} degrees of freedom: less weight for "
        f"{np.count_nonzero(some.weight < 1.0)} of {len(solution.records[name].t)} rows; the least counts as "
        f"{wording.format_number(float(some.weight.min()), 2)} of one."
        for name, some in noise.weights.items()
        if len(some.t) and name in solution.records
    ]
    less += [
        f"Intervals between keyframes with more noise of the {_OF_IMU[name]} than chance allows once in a thousand "
        f"times: {len(some.t)} of {len(solution.t) - 1}; at most "
        f"{wording.format_number(float(np.sqrt(1.0 / some.weight.min())), 2)} times the usual noise."
        for name, some in noise.weights.items()
        if len(some.t) and name in _OF_IMU
    ]
    return [*out, page.bullets(less)] if less else out


def _format_range(log_factor: float, sigma: float) -> Quantity:
    """1-sigma range of a factor on sigma, from that of the logarithm of the factor on the variance."""
    if sigma <= 0.0:
        return Quantity("-")
    low, high = (wording.format_number(float(np.exp(0.5 * (log_factor + s * sigma))), 2) for s in (-1.0, 1.0))
    return Quantity(f"{low} to {high}")


def tabulate_excluded(solution: Solution, start: float) -> list[Markup]:
    """Measurements that the solver excluded, when and why."""
    parts = solution.excluded
    if not parts:
        return []
    rows = [
        [Quantity(f"{p.t_start - start:.1f} to {p.t_end - start:.1f} s"), p.kind, int(p.count), p.reason] for p in parts
    ]
    return [page.heading("What was excluded"), *_format_long_table(["when", "what", "rows", "why"], rows)]


def _format_long_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[Markup]:
    """A table whose later rows are folded."""
    out = [page.make_table(head, rows[:_UNFOLDED_ROWS])]
    if len(rows) > _UNFOLDED_ROWS:
        out.append(page.fold(f"{len(rows) - _UNFOLDED_ROWS} more", [page.make_table(head, rows[_UNFOLDED_ROWS:])]))
    return out


def tabulate_rejected(solution: Solution, start: float) -> list[Markup]:
    """Every rejected measurement with its time; the largest ones if there are many."""
    rows: list[tuple[float, list[Any]]] = []
    for kind, r in solution.records.items():
        white = np.abs(r.residual) / r.sigma
        for k in np.flatnonzero(r.weight <= 1e-9):
            worst = int(np.argmax(white[k]))
            size = f"{r.residual[k, worst]:+.3g} {r.unit}, {r.axes[worst]}"
            rows.append(
                (float(r.t[k]), [Quantity(f"{r.t[k] - start:.2f} s"), name_rows(kind), size, float(white[k, worst])])
            )
    if not rows:
        return []
    largest = sorted(rows, key=lambda row: -row[1][3])[:_MAX_ROWS]
    table = page.make_table(
        ["when", "constraint", "largest component", "over sigma"], [r for _, r in sorted(largest, key=lambda r: r[0])]
    )
    many = len(rows)
    words = f"{many} rejected measurement{'s' if many > 1 else ''}"
    if many > _MAX_ROWS:
        words += f", the {_MAX_ROWS} farthest off"
    return [page.fold(words, [table])]


def tabulate_nees(errors: Mapping[str, Errors]) -> list[Markup]:
    """Mean NEES per degree of freedom and the share of epochs inside the 95 % region, per solver."""
    from graphnav.evaluation.metrics import average_nees
    from graphnav.evaluation.sigmas import judge_sigmas

    rows = []
    says = {
        "too small": "sigma too small",
        "cautious": "sigma cautious",
        "unclear": "open: too few independent epochs",
        "fits": "fits",
    }
    for name, e in errors.items():
        verdicts = {one.block: one for one in judge_sigmas(e)}
        nees = {"position": (e.nees_p, e.dof_p), "velocity": (e.nees_v, 3), "attitude": (e.nees_rph, 3)}
        if e.dof_p == 3:
            nees["height"] = (e.nees_axis[:, 2], 1)
        if e.nees_heading is not None:
            nees["heading"] = (e.nees_heading, 1)
        for words, (values, dof) in nees.items():
            found = average_nees(values, dof)
            if found is not None:
                inside, one = Quantity(f"{100 * found.inside:.1f} %"), verdicts[words]
                worth = Quantity(f"{one.effective:.0f}")
                rows.append([page.format_solver(name), words, found.mean, inside, found.n, worth, says[one.verdict]])
    head = ["solver", "of", "mean NEES / dof", "epochs inside 95 %", "epochs", "worth independent", "what it says"]
    return [page.make_table(head, rows)] if rows else []


def tabulate_parameters(parameters: Mapping[str, ParameterEstimate]) -> list[Markup]:
    """Constant and slowly varying parameters: last value and sigma, and their priors."""
    rows = []
    for name, p in parameters.items():
        for k, one in enumerate(name_components(name, p.value.shape[1], p.unit)):
            value, sigma = one.scale * float(p.value[-1, k]), one.scale * float(p.sigma[-1, k])
            known = "yes" if p.observable[k] else "no: mostly the prior"
            before = one.scale * float(p.prior_sigma[k])
            shown = [wording.format_to_sigma(value, sigma), wording.format_to_sigma(sigma, sigma), before]
            rows.append([one.words, *shown, one.unit, known])
    head = ["parameter", "value", "sigma", "sigma before", "unit", "seen by the data"]
    return [page.make_table(head, rows)] if rows else []


def tabulate_run(solutions: Mapping[str, Solution]) -> list[Markup]:
    """Seconds by stage, iterations and cost, one column per solver; the reason why each stopped."""
    every, solutions = solutions, select_own(solutions)
    stages = list(dict.fromkeys(stage for s in solutions.values() for stage in s.timings))

    def format_seconds(solution: Solution, stage: str) -> Quantity | None:
        return Quantity(f"{solution.timings[stage]:.3f}") if stage in solution.timings else None

    rows: list[list[Any]] = [
        [f"{stage} [s]", *(format_seconds(s, stage) for s in solutions.values())] for stage in stages
    ]
    rows += [
        ["sum [s]", *(Quantity(f"{sum(s.timings.values()):.3f}") for s in solutions.values())],
        ["iterations", *(s.iterations for s in solutions.values())],
        ["cost", *(float(s.cost) for s in solutions.values())],
    ]
    several = len(solutions) > 1
    notes = [f"{name} stopped: {s.stopped}" for name, s in solutions.items() if s.stopped and several]
    own = {name: [note for note in s.notes if get_key(note) not in TABULATED] for name, s in every.items()}
    shared = [note for note in own[next(iter(solutions))] if all(note in own[name] for name in solutions)]
    theirs = [f"{name}: {note}" for name, some in own.items() for note in some if note not in shared]
    table = page.make_table(["stage", *(page.format_solver(name) for name in solutions)], rows)
    lines = [*notes, *shared, *theirs]
    return [page.columns([[table], [page.bullets(lines)]]) if lines else table]


def tabulate_metrics(metrics: Mapping[str, Any] | None, name: str = "") -> list[Markup]:
    """All measures of the evaluation, in folded tables."""
    if not metrics:
        return []
    plain = {key: value for key, value in metrics.items() if key not in ("spans", "notes")}
    inner = [
        page.pairs({k: v if v is None or isinstance(v, float) else str(v) for k, v in page.flatten(plain).items()})
    ]
    spans = metrics.get("spans")
    if isinstance(spans, Sequence) and spans and isinstance(spans[0], Mapping):
        inner.append(page.make_table(list(spans[0]), [[s.get(k) for k in spans[0]] for s in spans]))
    return [page.fold(f"All measures{' of ' if name else ''}{name}", inner)]


def tabulate_stops(solution: Solution, start: float, decided_by: str) -> list[Markup]:
    """Every stop: the share that each detector found, the number of rows by constraint, and which detectors decide."""
    stops = list_solution_stops(solution)
    if not stops:
        return []
    rows = [
        [
            Quantity(f"{stop.start - start:.2f} s"),
            Quantity(f"{stop.end - stop.start:.2f} s"),
            stop.format_fired(),
            ", ".join(f"{count} {name_rows(name)}" for name, count in stop.rows.items()) or "none",
        ]
        for stop in stops[:_MAX_ROWS]
    ]
    note = f"Decided by {decided_by}. Share: of the stop that a detector by itself calls stationary."
    if len(stops) > _MAX_ROWS:
        note += f" {len(stops) - _MAX_ROWS} more are in detections.csv."
    return [
        *_format_long_table(["stationary from", "for", "share by detector", "rows"], rows),
        page.paragraph(note, "soft"),
    ]


def list_findings(recording: Recording, findings: Sequence[str]) -> list[Markup]:
    """Findings on the recording, each listed once."""
    lines = list(dict.fromkeys([*recording.remarks, *findings]))
    if recording.imu.noise_assumed:
        lines.append("The recording states no IMU noise figures; consumer-grade ones were assumed.")
    return [page.bullets(lines)] if lines else [page.paragraph("Nothing unusual was found in the recording.")]
