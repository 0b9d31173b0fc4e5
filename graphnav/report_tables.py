"""The tables and sentences that `graphnav.report` puts together, each from plain data to HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from graphnav import page
from graphnav.page import Raw
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solution import ConstraintRecord, ParameterEstimate, Solution

if TYPE_CHECKING:
    from graphnav.metrics import Errors

Withheld = Sequence[tuple[str, tuple[float, float] | None]]


@dataclass(frozen=True)
class Consistency:
    """How one constraint's residuals compare with their sigma."""

    count: int
    rejected: int
    reduced: int
    mean_nis: float  # of what was not rejected
    dof: int
    outside: float  # share of components beyond 3 sigma, of what was not rejected
    kind: str

    @property
    def verdict(self) -> str:
        """One sentence: can sigma be believed?"""
        if self.count - self.rejected < 10 or not np.isfinite(self.mean_nis):
            return "too few to judge"
        ratio = self.mean_nis / self.dof
        if self.kind == "residual":
            # a fit takes up part of the noise, so a smoother's residuals are below their sigma, never above
            if ratio > 1.3:
                return "residuals larger than sigma allows: sigma is too small, or something is unmodelled"
            return "residuals within their sigma"
        if ratio > 1.5:
            return "innovations larger than predicted: the filter is overconfident"
        if ratio < 0.5:
            return "innovations smaller than predicted: sigma is wider than it need be"
        return "innovations as large as predicted: sigma can be believed"


def consistency(record: ConstraintRecord) -> Consistency:
    """Summarise a record."""
    used = record.weight > 1e-9
    white = np.abs(record.residual[used] / record.sigma[used])
    white = white[np.isfinite(white)]
    return Consistency(
        count=len(record.t),
        rejected=int(np.sum(~used)),
        reduced=int(np.sum(used & (record.weight < 0.5))),
        mean_nis=_mean(record.nis[used]),
        dof=record.residual.shape[1],
        outside=_mean((white > 3.0).astype(float)),
        kind=record.kind,
    )


CONSISTENCY_HEAD = ("used", "rejected", "weight < 0.5", "mean NIS", "components", "outside 3 sigma", "what it says")


def consistency_row(c: Consistency) -> list[Any]:
    """The cells under `CONSISTENCY_HEAD`."""
    outside = f"{100 * c.outside:.2f} %" if np.isfinite(c.outside) else "-"
    return [c.count - c.rejected, c.rejected, c.reduced, float(c.mean_nis), c.dof, Raw(outside), c.verdict]


def constraint_table(solution: Solution) -> list[Raw]:
    """Counts of everything used, and the consistency of what left a record."""
    out = []
    rows = [[kind, *consistency_row(consistency(record))] for kind, record in solution.records.items()]
    if rows:
        out.append(page.table(["constraint", *CONSISTENCY_HEAD], rows))
        kinds = {r.kind for r in solution.records.values()}
        note = "A Gaussian leaves 0.27 % outside 3 sigma. "
        if "innovation" in kinds:
            note += "The mean NIS of honest innovations is the number of components. "
        if "residual" in kinds:
            note += "A fit takes up part of the noise: the mean NIS of its residuals lies below the components."
        out.append(page.paragraph(note, "soft"))
    if solution.counts:
        counted = page.and_list([f"{count} {kind}" for kind, count in solution.counts.items()])
        out.append(page.paragraph(f"Factors or updates by kind: {counted}."))
    return out


def times_of(withheld: Withheld) -> list[tuple[float, float]]:
    """The spans of time that something was withheld in, each once."""
    return list(dict.fromkeys(span for _, span in withheld if span is not None))


def what_was_done(recording: Recording, solutions: Mapping[str, Solution], withheld: Withheld) -> str:
    """The run in two or three sentences."""
    used = recording
    for source, span in withheld:
        if getattr(used, source, None) is not None:
            used = used.without(source, span)
    rate = 1.0 / float(np.median(np.diff(used.imu.t)))
    sources = [f"{len(used.imu.t)} IMU rows at {rate:.4g} Hz"]
    if used.gnss is not None:
        sources.append(f"{len(used.gnss.t)} GNSS fixes")
    if used.odometer is not None:
        sources.append(f"{len(used.odometer.t)} odometer rows")
    solution = next(iter(solutions.values()))
    several = len(solutions) > 1
    who = f"The solvers {page.and_list(list(solutions))}" if several else f"The {solution.solver} solver"
    words = (
        f"{who} estimated the trajectory of the {recording.platform} recording '{recording.name}' "
        f"({recording.duration:.1f} s) from {page.and_list(sources)}, at {len(solution.t)} keyframes."
    )
    if withheld:
        listed = [f"{source} {span[0]:g} to {span[1]:g} s" if span else f"all of {source}" for source, span in withheld]
        words += f" Withheld: {page.and_list(listed)} (seconds from the start)."
    if not several and solution.stopped:
        words += f" How it ended: {solution.stopped.rstrip('.')}."
    return words


def tiles(recording: Recording, solutions: Mapping[str, Solution], errors: Mapping[str, Errors]) -> Raw:
    """The few numbers to see first."""
    states = next(iter(solutions.values())).states
    way = float(np.linalg.norm(np.diff(states.p, axis=0), axis=1).sum())
    out = [
        (f"{recording.duration:.1f} s", "duration"),
        (f"{way / 1000:.2f} km" if way >= 1000 else f"{way:.1f} m", "distance"),
    ]
    several = len(solutions) > 1
    for name, solution in solutions.items():
        if name in errors:
            value = f"{page.number(_rms(errors[name].horizontal), 3)} m"
            out.append((value, f"horizontal error, RMS{', ' + name if several else ''}"))
        else:
            sd = solution.trajectory().sd_p
            if sd is not None:
                value = f"{page.number(float(np.median(np.hypot(sd[:, 0], sd[:, 1]))), 3)} m"
                out.append((value, f"horizontal sigma, median{', ' + name if several else ''}"))
    if not several:
        seconds = sum(next(iter(solutions.values())).timings.values())
        out.append((f"{seconds:.2f} s", "run time"))
    return page.tiles(out)


def _rms(x: Array) -> float:
    return float(np.sqrt(_mean(x * x)))


def _largest(x: Array) -> float:
    x = np.abs(x[np.isfinite(x)])
    return float(x.max()) if x.size else float("nan")


def _mean(x: Array) -> float:
    x = x[np.isfinite(x)]
    return float(np.mean(x)) if x.size else float("nan")


def believe(name: str, errors: Errors) -> Raw:
    """One sentence that compares position errors with their sigma (and the truth's own, where it states one)."""
    square = errors.nees_axis[np.isfinite(errors.nees_axis)]
    if not len(square):
        return page.paragraph(f"{name}: no epoch has both an error and a sigma, so sigma cannot be judged.", "verdict")
    size, inside = float(np.sqrt(np.mean(square))), float(np.mean(square <= 9.0))
    measured = (
        f"position errors are {size:.2f} times their sigma (RMS), {100 * inside:.1f} % of them within 3 sigma "
        "(a Gaussian: 1 and 99.7 %)"
    )
    if size > 1.5:
        return page.paragraph(
            f"{name}: the stated sigma is too small: {measured}. Errors of the truth itself count here as well.",
            "verdict bad",
        )
    if size < 0.5:
        return page.paragraph(f"{name}: the stated sigma is cautious: {measured}.", "verdict")
    return page.paragraph(f"{name}: the stated sigma can be believed: {measured}.", "verdict good")


COMPARED_SPAN = ("horizontal RMS [m]", "largest [m]", "at the end [m]", "largest, % of way", "up largest [m]",
                 "heading largest [deg]", "error / sigma, RMS")  # fmt: skip
COMPARED = ("horizontal RMS [m]", "horizontal largest [m]", "up RMS [m]", "speed RMS [m/s]", "roll, pitch RMS [deg]",
            "heading RMS [deg]", "error / sigma, RMS")  # fmt: skip


def accuracy_row(errors: Errors) -> list[float]:
    """The numbers under `COMPARED`."""
    rph = np.degrees(errors.rph)
    return [
        _rms(errors.horizontal),
        _largest(errors.horizontal),
        _rms(errors.p[:, 2]),
        _rms(np.linalg.norm(errors.v, axis=1)),
        _rms(rph[:, :2]),
        _rms(rph[:, 2]),
        float(np.sqrt(_mean(errors.nees_axis))),
    ]


def span_row(errors: Errors, span: tuple[float, float], start: float) -> list[float]:
    """The numbers under `COMPARED_SPAN`, over a span in seconds from the recording's start."""
    t = errors.t - start
    rows = np.flatnonzero((t >= span[0]) & (t <= span[1]))
    rows = rows[np.isfinite(errors.horizontal[rows])]
    if not len(rows):
        return [float("nan")] * len(COMPARED_SPAN)
    h = errors.horizontal[rows]
    way = float(errors.distance[rows[-1]] - errors.distance[rows[0]])
    return [
        _rms(h),
        _largest(h),
        float(h[-1]),
        100.0 * _largest(h) / way if way > 0 else float("nan"),
        _largest(errors.p[rows, 2]),
        float(np.degrees(_largest(errors.rph[rows, 2]))),
        float(np.sqrt(_mean(errors.nees_axis[rows]))),
    ]


def accuracy_tables(errors: Mapping[str, Errors], withheld: Withheld, start: float) -> list[Raw]:
    """A table of all solvers over everything, and one for each withheld span."""
    if not errors:
        return []
    rows = [[page.solver(name), *accuracy_row(e)] for name, e in errors.items()]
    out = [page.heading("Whole recording"), page.table(["solver", *COMPARED], rows, best=range(1, 7))]
    spans = times_of(withheld)
    if len(errors) == 1 and spans:
        (only,) = errors.values()
        rows = [[Raw(f"{a:g} to {b:g} s"), *span_row(only, (a, b), start)] for a, b in spans]
        out += [page.heading("Withheld spans"), page.table(["span", *COMPARED_SPAN], rows)]
        spans = []
    for span in spans:
        rows = [[page.solver(name), *span_row(e, span, start)] for name, e in errors.items()]
        out.append(page.heading(f"Withheld {span[0]:g} to {span[1]:g} s"))
        out.append(page.table(["solver", *COMPARED_SPAN], rows, best=range(1, 7)))
    notes = list(dict.fromkeys(note for e in errors.values() for note in e.notes))
    return [*out, page.bullets(notes)] if notes else out


def closure_note(name: str, metrics: Mapping[str, Any] | None) -> list[Raw]:
    """How far from the start a loop ended, where that is the truth."""
    if not metrics or metrics.get("closure_h_m") is None:
        return []
    h, up, way, share = (page.text(metrics.get(f"closure_{k}")) for k in ("h_m", "up_m", "distance_m", "percent"))
    words = f"the loop of {way} m closes to {h} m horizontally ({share} % of the way) and {up} m in height."
    return [page.paragraph(Raw(f"{page.text(name)}: {words}"), "verdict")]


def parameter_table(parameters: Mapping[str, ParameterEstimate]) -> list[Raw]:
    """What was estimated once or slowly: last value and sigma, and what was known before."""
    rows = [
        [
            name if p.value.shape[1] == 1 else f"{name} [{k}]",
            Raw(page.measured(float(p.value[-1, k]), float(p.sigma[-1, k]))),
            Raw(page.measured(float(p.sigma[-1, k]), float(p.sigma[-1, k]))),
            float(p.prior_sigma[k]),
            p.unit or "-",
            len(p.t),
            "yes" if p.observable[k] else "no: mostly the prior",
        ]
        for name, p in parameters.items()
        for k in range(p.value.shape[1])
    ]
    head = ["parameter", "value", "sigma", "sigma before", "unit", "nodes", "seen by the data"]
    return [page.table(head, rows)] if rows else []


def run_table(solutions: Mapping[str, Solution]) -> list[Raw]:
    """Seconds by stage, iterations and cost."""
    stages = list(dict.fromkeys(stage for s in solutions.values() for stage in s.timings))
    rows = [
        [
            page.solver(name),
            s.iterations,
            float(s.cost),
            *(Raw(f"{s.timings[k]:.3f}") if k in s.timings else None for k in stages),
            Raw(f"{sum(s.timings.values()):.3f}"),
            s.stopped or "-",
        ]
        for name, s in solutions.items()
    ]
    head = ["solver", "iterations", "cost", *(f"{k} [s]" for k in stages), "sum [s]", "stopped because"]
    notes = [f"{name}: {note}" if len(solutions) > 1 else note for name, s in solutions.items() for note in s.notes]
    return [page.table(head, rows), page.bullets(notes) if notes else Raw("")]


def metric_tables(metrics: Mapping[str, Any] | None, name: str = "") -> list[Raw]:
    """Whatever the evaluation measured, as tables that open on demand."""
    if not metrics:
        return []
    plain = {key: value for key, value in metrics.items() if key not in ("spans", "notes")}
    inner = page.pairs({k: v if v is None or isinstance(v, float) else str(v) for k, v in page.flat(plain).items()})
    spans = metrics.get("spans")
    if isinstance(spans, Sequence) and spans and isinstance(spans[0], Mapping):
        inner = Raw(inner + page.table(list(spans[0]), [[s.get(k) for k in spans[0]] for s in spans]))
    return [page.folded(f"All measures{' of ' if name else ''}{name}", inner)]


def odd(recording: Recording, findings: Sequence[str]) -> list[Raw]:
    """What was odd in the recording, each said once."""
    lines = list(dict.fromkeys([*recording.remarks, *findings]))
    if recording.imu.noise_assumed:
        lines.append("The recording states no IMU noise figures; consumer-grade ones were assumed.")
    return [page.bullets(lines)] if lines else [page.paragraph("Nothing odd was found in the recording.")]


def provenance_tables(settings: Mapping[str, Any], provenance: Mapping[str, Any] | None) -> list[Raw]:
    """Version and inputs, then every setting as it was resolved."""
    out = [page.pairs(page.flat(provenance))] if provenance else []
    if settings:
        out.append(page.folded("Settings as resolved", page.pairs({k: str(v) for k, v in page.flat(settings).items()})))
    return out
