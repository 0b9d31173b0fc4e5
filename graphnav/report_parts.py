"""The tables and pictures that `graphnav.report` puts together, each from plain data to HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from graphnav import page, plots
from graphnav.page import Raw
from graphnav.panels import svg
from graphnav.plots import Series
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solution import ConstraintRecord, ParameterEstimate, Solution
from graphnav.trajectory import Trajectory

if TYPE_CHECKING:
    from graphnav.metrics import Errors

ENU = ("east", "north", "up")
RPH = ("roll", "pitch", "heading")
XYZ = ("x right", "y forward", "z up")
DEG_H = float(np.degrees(3600.0))
Spans = Sequence[tuple[float, float] | tuple[str, float, float]]


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
        if self.count - self.rejected < 10:
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
    return Consistency(
        count=len(record.t),
        rejected=int(np.sum(~used)),
        reduced=int(np.sum(used & (record.weight < 0.5))),
        mean_nis=float(np.nanmean(record.nis[used])) if used.any() else float("nan"),
        dof=record.residual.shape[1],
        outside=float(np.mean(white > 3.0)) if used.any() else float("nan"),
        kind=record.kind,
    )


CONSISTENCY_HEAD = ("used", "rejected", "weight < 0.5", "mean NIS", "of", "outside 3 sigma", "what it says")


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
            note += "The mean NIS of honest innovations is the number of components (column 'of'). "
        if "residual" in kinds:
            note += "A fit takes up part of the noise, so the mean NIS of its residuals lies below that number."
        out.append(page.paragraph(note, "soft"))
    if solution.counts:
        counted = page.and_list([f"{count} {kind}" for kind, count in solution.counts.items()])
        out.append(page.paragraph(f"Factors or updates by kind: {counted}."))
    return out


def times_of(spans: Spans) -> list[tuple[float, float]]:
    return [(float(s[-2]), float(s[-1])) for s in spans]


def what_was_done(recording: Recording, solution: Solution, spans: Spans, solvers: Sequence[str] = ()) -> str:
    """The run in two or three sentences."""
    imu = recording.imu
    rate = 1.0 / float(np.median(np.diff(imu.t)))
    parts = [f"{len(imu.t)} IMU rows at {rate:.4g} Hz"]
    if recording.gnss is not None:
        parts.append(f"{len(recording.gnss.t)} GNSS fixes")
    if recording.odometer is not None:
        parts.append(f"{len(recording.odometer.t)} odometer rows")
    who = "The solvers " + ", ".join(solvers) if solvers else f"The {solution.solver} solver"
    words = (
        f"{who} estimated the trajectory of the {recording.platform} recording '{recording.name}' "
        f"({recording.duration:.1f} s) from {page.and_list(parts)}, at {len(solution.t)} keyframes."
    )
    if spans:
        listed = [f"{s[0] if len(s) == 3 else 'gnss'} {s[-2]:g} to {s[-1]:g} s" for s in spans]
        words += f" Withheld: {page.and_list(listed)}, counted from the start."
    if not solvers and solution.stopped:
        words += f" {solution.stopped[0].upper()}{solution.stopped[1:].rstrip('.')}."
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


def _mean(x: Array) -> float:
    x = x[np.isfinite(x)]
    return float(np.mean(x)) if x.size else float("nan")


def error_series(errors: Errors, start: float) -> dict[str, Series]:
    """Errors as things to draw: position (m), velocity (m/s), attitude (deg), where there are any."""
    t = errors.t - start
    deg = float(np.degrees(1.0))
    out = {}
    for kind, value, sigma, scale in (
        ("position", errors.p, errors.sd_p, 1.0),
        ("velocity", errors.v, errors.sd_v, 1.0),
        ("attitude", errors.rph, errors.sd_rph, deg),
    ):
        if np.isfinite(value).any():
            out[kind] = Series(t, scale * value, scale * sigma if np.isfinite(sigma).any() else None)
    return out


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


COMPARED = ("horizontal RMS [m]", "horizontal largest [m]", "up RMS [m]", "speed RMS [m/s]", "roll, pitch RMS [deg]",
            "heading RMS [deg]", "error / sigma, RMS")  # fmt: skip


def accuracy_row(errors: Errors, span: tuple[float, float] | None, start: float) -> list[float]:
    """The numbers under `COMPARED`, over a span in seconds from the start or over everything."""
    out = [float("nan")] * len(COMPARED)
    for kind, s in error_series(errors, start).items():
        rows = np.ones(len(s.t), bool) if span is None else (s.t >= span[0]) & (s.t <= span[1])
        x = s.value[rows]
        if kind == "position":
            horizontal = np.hypot(x[:, 0], x[:, 1])
            out[0], out[2] = _rms(horizontal), _rms(x[:, 2])
            out[1] = float(np.nanmax(horizontal)) if np.isfinite(horizontal).any() else float("nan")
            out[6] = float(np.sqrt(_mean(errors.nees_axis[rows])))
        elif kind == "velocity":
            out[3] = _rms(np.linalg.norm(x, axis=1))
        else:
            out[4], out[5] = _rms(x[:, :2]), _rms(x[:, 2])
    return out


def accuracy_tables(errors: Mapping[str, Errors], spans: Spans, start: float) -> list[Raw]:
    """A table of all solvers over everything, and one for each withheld span."""
    if not errors:
        return []
    out = []
    wanted: list[tuple[str, tuple[float, float] | None]] = [("Whole recording", None)]
    wanted += [(f"Withheld {a:g} to {b:g} s", (a, b)) for a, b in times_of(spans)]
    for words, span in wanted:
        rows = [[page.solver(name), *accuracy_row(e, span, start)] for name, e in errors.items()]
        out += [Raw(f"<h3>{page.text(words)}</h3>"), page.table(["solver", *COMPARED], rows, best=range(1, 7))]
    return out


def trajectory_picture(
    recording: Recording, solutions: Mapping[str, Solution], spans: list[tuple[float, float]]
) -> Raw:
    """The way from above."""
    start = recording.start
    frame = next(iter(solutions.values())).frame
    fixes = truth = None
    if recording.gnss is not None:
        fixes = frame.from_llh(recording.gnss.llh)[:, :2]
    if recording.truth is not None and recording.truth.llh is not None:
        truth = frame.from_llh(recording.truth.llh)[:, :2]
    tracks = {name: (s.t - start, s.states.p[:, :2]) for name, s in solutions.items()}
    figure = plots.trajectory(tracks, fixes=fixes, truth=truth, spans=spans)
    lat, lon = np.degrees(frame.origin[:2])
    return page.picture(
        svg(figure, "trajectory from above", "way"),
        f"From above; origin at latitude {lat:.6f}, longitude {lon:.6f} deg.",
    )


def error_pictures(errors: Mapping[str, Errors], start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """Position, velocity and attitude errors with 3 sigma."""
    series = {name: error_series(e, start) for name, e in errors.items()}
    out = []
    for kind, parts, unit in (("position", ENU, "m"), ("velocity", ENU, "m/s"), ("attitude", RPH, "deg")):
        chosen = {name: s[kind] for name, s in series.items() if kind in s}
        if chosen:
            figure = plots.bands(chosen, parts, unit, spans=spans)
            out.append(
                page.picture(svg(figure, f"{kind} errors", f"e-{kind}"), f"{kind.capitalize()}: error and 3 sigma.")
            )
    return out


def sigma_pictures(tracks: Mapping[str, Trajectory], start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """What the solvers themselves say of their uncertainty."""
    out = []
    wanted = (("position", "sd_p", ENU, "m", 1.0), ("attitude", "sd_rph", RPH, "deg", float(np.degrees(1.0))))
    for kind, key, parts, unit, scale in wanted:
        series = {
            name: Series(track.t - start, getattr(track, key) * scale)
            for name, track in tracks.items()
            if getattr(track, key) is not None
        }
        if series:
            figure = plots.sigmas(series, parts, unit, spans=spans)
            out.append(
                page.picture(svg(figure, f"{kind} sigma", f"sd-{kind}"), f"{kind.capitalize()}: 1 sigma as stated.")
            )
    return out


def bias_pictures(solution: Solution, start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """Gyro and accelerometer biases with 3 sigma."""
    sd = np.sqrt(np.maximum(np.diagonal(solution.covariance, axis1=1, axis2=2), 0.0))
    t = solution.t - start
    out = []
    for words, value, sigma, unit, scale in (
        ("Gyro bias", solution.states.bg, sd[:, 12:15], "deg/h", DEG_H),
        ("Accelerometer bias", solution.states.ba, sd[:, 9:12], "mm/s²", 1000.0),
    ):
        series = {solution.solver: Series(t, value * scale, sigma * scale)}
        figure = plots.bands(series, XYZ, unit, spans=spans, about_zero=False)
        out.append(page.picture(svg(figure, words, words.split()[0].lower()), f"{words} and 3 sigma."))
    return out


def zoom_pictures(errors: Mapping[str, Errors], start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """Horizontal error in and around each withheld span."""
    if not spans or not errors:
        return []
    series = {}
    for name, e in errors.items():
        s = error_series(e, start)["position"]
        series[name] = Series(s.t, np.hypot(s.value[:, 0], s.value[:, 1])[:, None])
    figure = plots.span_zoom(series, spans)
    return [
        page.picture(
            svg(figure, "horizontal error in withheld spans", "zoom"),
            "Horizontal error in and around each withheld span.",
        )
    ]


def record_pictures(solution: Solution, start: float, spans: list[tuple[float, float]]) -> list[Raw]:
    """Whitened residuals and NIS of every constraint."""
    out = []
    for kind, record in solution.records.items():
        if not len(record.t):
            continue
        figure = plots.residuals(kind, record, start, solution.solver, spans=spans)
        words = f"{kind}: {record.kind}s over their sigma"
        caption = (
            f"{words}, dashed at 3. NIS with the middle 99 % of the chi-square distribution with "
            f"{record.residual.shape[1]} degrees of freedom, and its histogram beside the density."
        )
        out.append(page.picture(svg(figure, words, f"r-{kind}"), caption))
    return out


def parameter_table(parameters: Mapping[str, ParameterEstimate]) -> list[Raw]:
    """What was estimated once or slowly: last value and sigma, and what was known before."""
    rows = [
        [
            name if p.value.shape[1] == 1 else f"{name} [{k}]",
            page.Raw(page.measured(float(p.value[-1, k]), float(p.sigma[-1, k]))),
            float(p.sigma[-1, k]),
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


def metric_tables(metrics: Mapping[str, Any] | None) -> list[Raw]:
    """Whatever the evaluation measured, as a table that opens on demand."""
    return [page.folded("All measures", page.pairs(page.flat(metrics)))] if metrics else []


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
