"""Errors of a trajectory reduced to numbers: a dictionary, a table for the terminal, a comparison.

NEES is e' P^-1 e, chi-square with as many degrees of freedom as e has where the covariance is true
(Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 5.4).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.sample_size import chi_square_band, chi_square_quantile, count_effective_epochs


@dataclass(frozen=True, eq=False)
class Errors:
    """Estimate minus truth at N common epochs; NaN where either lacks the quantity."""

    t: Array  # (N,) s
    p: Array  # (N, 3) m, east, north, up at the point
    track: Array  # (N, 2) m, along the truth's direction of travel and to the right of it; NaN when slow
    v: Array  # (N, 3) m/s, local ENU
    rph: Array  # (N, 3) rad, roll, pitch, heading, in [-pi, pi)
    sd_p: Array  # (N, 3) m, the estimate's own sigma at the compared point
    sd_v: Array  # (N, 3) m/s
    sd_rph: Array  # (N, 3) rad
    nees_p: Array  # (N,) dof_p degrees of freedom; the truth's sigma, if it has one, is added
    nees_axis: Array  # (N, 3) one degree of freedom each: east, north, up
    nees_v: Array  # (N,) 3 degrees of freedom
    nees_rph: Array  # (N,) 3 degrees of freedom, of the rotation between estimate and truth
    distance: Array  # (N,) m, horizontal, travelled by the truth since its first scored epoch
    dof_p: int = 3  # 2 for a truth without height
    epochs: int = 0  # number of epochs, scored or not
    notes: tuple[str, ...] = ()
    nees_heading: Array | None = None  # (N,) 1 degree of freedom

    def __len__(self) -> int:
        return len(self.t)

    @property
    def horizontal(self) -> Array:
        """(N,) m."""
        return np.hypot(self.p[:, 0], self.p[:, 1])


@dataclass(frozen=True)
class Statistic:
    """Statistics of one component over the epochs that have it; `p95` and `max` are of its magnitude."""

    rms: float
    p95: float
    max: float
    mean: float
    n: int


@dataclass(frozen=True)
class Nees:
    """Average NEES per degree of freedom: 1 where the covariance is true.

    `low` and `high` hold the average 95 % of the time if the n epochs are independent. Errors of one
    drive are correlated over seconds to minutes, so a true covariance leaves this band often: `band` is that
    of as many epochs as they are worth; sharper are independent runs (`average_ensemble_nees`). `inside` is the share
    of epochs within the 95 % region of one epoch; its expectation, 0.95, does not need independence.
    """

    mean: float
    dof: int
    n: int
    low: float
    high: float
    inside: float
    effective: float  # number of independent epochs that the n are equivalent to


@dataclass(frozen=True)
class SpanErrors:
    """Errors in a span of time, such as an outage; the drift is that of the largest horizontal error."""

    start: float  # s, as requested
    end: float  # s
    n: int
    distance: float  # m, distance travelled in it
    end_h: float  # m, at its last epoch
    end_3d: float  # m
    max_h: float  # m
    max_up: float  # m
    drift: float  # m/s, max_h over the span's length
    drift_percent: float  # % of the distance
    nees: float  # mean position NEES per degree of freedom


@dataclass(frozen=True)
class Closure:
    """End minus start of a loop that ends where it began."""

    horizontal: float  # m
    vertical: float  # m, signed
    distance: float  # m
    percent: float  # horizontal, of distance


@dataclass(frozen=True)
class Metrics:
    """All numbers that `summarise` and `format_metrics` present; `errors` is kept for plots."""

    name: str
    n: int = 0
    epochs: int = 0
    duration: float = 0.0  # s
    distance: float = 0.0  # m
    components: dict[str, Statistic] = field(default_factory=dict)
    nees: dict[str, Nees] = field(default_factory=dict)
    spans: tuple[SpanErrors, ...] = ()
    closure: Closure | None = None
    notes: tuple[str, ...] = ()
    errors: Errors | None = field(default=None, repr=False, compare=False)


# key in `components` -> (name for people, unit in keys, unit in tables)
COMPONENTS = {
    "e": ("east", "m", "m"),
    "n": ("north", "m", "m"),
    "up": ("up", "m", "m"),
    "h": ("horizontal", "m", "m"),
    "3d": ("3-D", "m", "m"),
    "along": ("along track", "m", "m"),
    "across": ("across track", "m", "m"),
    "ve": ("velocity east", "mps", "m/s"),
    "vn": ("velocity north", "mps", "m/s"),
    "vu": ("velocity up", "mps", "m/s"),
    "roll": ("roll", "deg", "deg"),
    "pitch": ("pitch", "deg", "deg"),
    "heading": ("heading", "deg", "deg"),
}
# of a span: key -> field of `SpanErrors`
_SPAN_FIELDS = {
    "distance_m": "distance", "end_h_m": "end_h", "end_3d_m": "end_3d", "max_h_m": "max_h", "max_up_m": "max_up",
    "drift_mps": "drift", "drift_percent": "drift_percent", "nees_p": "nees",
}  # fmt: skip
_NEES = {"p": "position", "e": "east", "n": "north", "up": "up", "v": "velocity", "rph": "attitude"}


def measure(
    errors: Errors, name: str = "", spans: Sequence[tuple[float, float]] = (), *, start: float = 0.0
) -> Metrics:
    """Statistics of errors over all epochs and in each of `spans` (from, to in s after `start`)."""
    deg = np.rad2deg(errors.rph)
    series = {
        "e": errors.p[:, 0], "n": errors.p[:, 1], "up": errors.p[:, 2], "h": errors.horizontal,
        "3d": np.linalg.norm(errors.p, axis=1), "along": errors.track[:, 0], "across": errors.track[:, 1],
        "ve": errors.v[:, 0], "vn": errors.v[:, 1], "vu": errors.v[:, 2],
        "roll": deg[:, 0], "pitch": deg[:, 1], "heading": deg[:, 2],
    }  # fmt: skip
    p, v, rph = scale_by_sigmas(errors)
    values = {
        "p": (errors.nees_p, errors.dof_p, p), "e": (errors.nees_axis[:, 0], 1, p[:, :1]),
        "n": (errors.nees_axis[:, 1], 1, p[:, 1:2]), "up": (errors.nees_axis[:, 2], 1, p[:, 2:]),
        "v": (errors.nees_v, 3, v), "rph": (errors.nees_rph, 3, rph),
    }  # fmt: skip
    return Metrics(
        name=name,
        n=len(errors),
        epochs=errors.epochs,
        duration=float(errors.t[-1] - errors.t[0]) if len(errors) else 0.0,
        distance=float(errors.distance[-1]) if len(errors) else 0.0,
        components={key: found for key, x in series.items() if (found := summarise_component(x)) is not None},
        nees={key: mean for key, (x, dof, z) in values.items() if (mean := average_nees(x, dof, z)) is not None},
        spans=tuple(_measure_span(errors, a, b, start) for a, b in spans),
        notes=errors.notes,
        errors=errors,
    )


def summarise_component(x: Array) -> Statistic | None:
    """Statistics of the finite values of `x` (N,); None if there are none. The 95 % point is interpolated linearly."""
    x = x[np.isfinite(x)]
    if not len(x):
        return None
    size = np.abs(x)
    return Statistic(
        rms=float(np.sqrt(np.mean(x * x))),
        p95=float(np.percentile(size, 95)),
        max=float(size.max()),
        mean=float(x.mean()),
        n=len(x),
    )


def average_nees(x: Array, dof: int, over_sigma: Array | None = None) -> Nees | None:
    """Average per degree of freedom of NEES values (N,) with its 95 % band for independent epochs.

    `over_sigma`, (N, k), are the errors over their sigmas, by which epochs are alike; without them all count.
    """
    known = np.isfinite(x)
    x = x[known]
    if not len(x):
        return None
    effective = float(len(x)) if over_sigma is None else count_effective_epochs(over_sigma[known])
    low, high = chi_square_band(dof, len(x))
    inside = float(np.mean(x <= chi_square_quantile(0.95, dof)))
    return Nees(float(x.mean()) / dof, dof, len(x), low, high, inside, effective)


def average_ensemble_nees(runs: Sequence[Errors], block: str = "p") -> tuple[Array, Array, float, float]:
    """NEES averaged over independent runs at each epoch they share: the test that needs no independence in time.

    Returns the epochs (T,), the average per degree of freedom (T,), and the 95 % band for this many runs.
    `block` is "p", "v" or "rph".
    """
    stamps = [np.round(run.t * 1e6).astype(np.int64) for run in runs]
    shared = stamps[0]
    for stamp in stamps[1:]:
        shared = np.intersect1d(shared, stamp)
    dof = min(run.dof_p for run in runs) if block == "p" else 3
    rows = [getattr(run, f"nees_{block}")[np.searchsorted(s, shared)] for run, s in zip(runs, stamps, strict=True)]
    low, high = chi_square_band(dof, len(runs))
    return (
        np.asarray(shared * 1e-6, dtype=np.float64),
        np.asarray(np.mean(rows, axis=0) / dof, dtype=np.float64),
        low,
        high,
    )


def _measure_span(errors: Errors, start: float, end: float, origin: float) -> SpanErrors:
    t = errors.t - origin
    inside = np.flatnonzero((t >= start) & (t <= end) & np.isfinite(errors.horizontal))
    if not len(inside):
        return SpanErrors(start, end, 0, *[math.nan] * 8)
    h, p, last = errors.horizontal[inside], errors.p[inside], inside[-1]
    distance = float(errors.distance[last] - errors.distance[inside[0]])
    nees = errors.nees_p[inside]
    nees = nees[np.isfinite(nees)]
    return SpanErrors(
        start=start,
        end=end,
        n=len(inside),
        distance=distance,
        end_h=float(h[-1]),
        end_3d=float(np.linalg.norm(p[-1])),
        max_h=float(h.max()),
        max_up=float(np.abs(p[:, 2]).max()),
        drift=float(h.max() / (end - start)) if end > start else math.nan,
        drift_percent=float(100.0 * h.max() / distance) if distance > 0 else math.nan,
        nees=float(nees.mean() / errors.dof_p) if len(nees) else math.nan,
    )


def summarise(metrics: Metrics) -> dict[str, Any]:
    """The metrics as a dictionary for JSON: five significant digits, units in the keys, None where unknown."""
    out: dict[str, Any] = {
        "n": metrics.n,
        "epochs": metrics.epochs,
        "duration_s": round_figure(metrics.duration),
        "distance_m": round_figure(metrics.distance),
    }
    for key, s in metrics.components.items():
        unit = COMPONENTS[key][1]
        out |= {f"{key}_{what}_{unit}": round_figure(getattr(s, what)) for what in ("rms", "p95", "max", "mean")}
    for key, nees in metrics.nees.items():
        out[f"nees_{key}"] = round_figure(nees.mean)
        out[f"nees_{key}_inside_95"] = round_figure(nees.inside)
        out[f"nees_{key}_band_if_independent"] = [round_figure(nees.low), round_figure(nees.high)]
        out[f"nees_{key}_band"] = [round_figure(x) for x in chi_square_band(nees.dof, nees.effective)]
    if metrics.closure is not None:
        c = metrics.closure
        out |= {
            "closure_h_m": round_figure(c.horizontal),
            "closure_up_m": round_figure(c.vertical),
            "closure_distance_m": round_figure(c.distance),
            "closure_percent": round_figure(c.percent),
        }
    if metrics.spans:
        out["spans"] = [
            {"start_s": s.start, "end_s": s.end, "n": s.n}
            | {name: round_figure(getattr(s, field)) for name, field in _SPAN_FIELDS.items()}
            for s in metrics.spans
        ]
    if metrics.notes:
        out["notes"] = list(metrics.notes)
    return out


def format_metrics(metrics: Metrics) -> str:
    """The metrics as an aligned table for the terminal."""
    lines = []
    if metrics.n:
        lines.append(f"{metrics.n} of {metrics.epochs} epochs, {metrics.duration:.1f} s, {metrics.distance:.1f} m")
        lines.append(f"{'':<16}{'rms':>10}{'95 %':>10}{'max':>10}{'mean':>10}")
        for key, s in metrics.components.items():
            name, _, unit = COMPONENTS[key]
            numbers = "".join(f"{_format_short(x):>10}" for x in (s.rms, s.p95, s.max, s.mean))
            lines.append(f"{name:<16}{numbers}  {unit}")
    if metrics.nees:
        lines.append(f"{'NEES per dof':<16}{'mean':>10}{'in 95 %':>10}   1 and 95 % where the sigmas are true")
        for key, nees in metrics.nees.items():
            lines.append(f"{_NEES[key]:<16}{_format_short(nees.mean):>10}{100 * nees.inside:>9.1f}%")
    if metrics.spans:
        titles = ("end hor.", "end 3-D", "max hor.", "max up", "m/s", "% dist.", "NEES")
        lines.append(f"{'span (s)':<16}" + "".join(f"{title:>10}" for title in titles))
        for span in metrics.spans:
            row = (span.end_h, span.end_3d, span.max_h, span.max_up, span.drift, span.drift_percent, span.nees)
            lines.append(f"{f'{span.start:.1f}-{span.end:.1f}':<16}" + "".join(f"{_format_short(x):>10}" for x in row))
    if metrics.closure is not None:
        c = metrics.closure
        lines.append(
            f"closure: horizontal {_format_short(c.horizontal)} m, up {_format_short(c.vertical)} m, "
            f"{_format_short(c.percent)} % of {c.distance:.1f} m"
        )
    lines += [f"note: {note}" for note in metrics.notes]
    return "\n".join(lines)


def tabulate(results: Mapping[str, Metrics]) -> list[dict[str, Any]]:
    """One flat row per solver: `solver`, the numbers of `summarise`, and span1_..., span2_... for the spans.

    All rows have the same keys in the same order; None where a solver lacks one.
    """
    rows = []
    for solver, metrics in results.items():
        row: dict[str, Any] = {"solver": solver}
        for key, value in summarise(metrics).items():
            if key == "spans":
                for k, span in enumerate(value, 1):
                    row |= {f"span{k}_{name}": number for name, number in span.items()}
            elif key != "notes" and not key.endswith(("_band_if_independent", "_band")):
                row[key] = value
        rows.append(row)
    keys = list(dict.fromkeys(key for row in rows for key in row))
    return [{key: row.get(key) for key in keys} for row in rows]


def write_comparison_csv(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of `tabulate`, possibly with more columns; a missing value is blank."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, keys, lineterminator="\n")
        writer.writeheader()
        writer.writerows(dict(row) for row in rows)


def round_figure(x: float) -> float | None:
    """Five significant digits, None for no number."""
    return float(f"{x:.5g}") if math.isfinite(x) else None


def _format_short(x: float) -> str:
    """Four significant digits, without an exponent in the common range."""
    if not math.isfinite(x):
        return "-"
    size = abs(x)
    return f"{x:.0f}" if size >= 1000 else f"{x:.4f}" if size < 1 else f"{x:.{3 - int(math.log10(size))}f}"


def scale_by_sigmas(errors: Errors) -> tuple[Array, Array, Array]:
    """Errors of position, velocity, and roll, pitch, heading over their sigmas, (N, 3) each, NaN where unknown."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sign(errors.p) * np.sqrt(errors.nees_axis), errors.v / errors.sd_v, errors.rph / errors.sd_rph
