"""Things over time: values with 3 sigma, sigmas, errors in withheld spans."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphnav.panels import LEFT, RIGHT, WIDTH, Drawing, limits
from graphnav.panels.drawing import BOTTOM, Spans
from graphnav.rotation import Array

Shades = Mapping[str, Spans] | None  # s from the start, by what they are


@dataclass(frozen=True)
class Series:
    """Something of k components over time, with its 1-sigma where there is one."""

    t: Array  # (N,) s from the recording's start
    value: Array  # (N, k)
    sigma: Array | None = None  # (N, k)


def bands(
    series: Mapping[str, Series],
    components: Sequence[str],
    unit: str,
    *,
    spans: Shades = None,
    about_zero: bool = True,
) -> Drawing:
    """One panel per component: the values, and 3 sigma about zero (errors) or about the value (biases).

    The bands of more than two series would hide each other; `sigmas` shows those side by side.
    """
    if len(series) > 2:
        series = {name: Series(s.t, s.value) for name, s in series.items()}
    ylims = []
    for k in range(len(components)):
        extremes: list[Array] = []
        for s in series.values():
            extremes.append(s.value[:, k])
            if s.sigma is not None:
                # the first moments of a filter must not set the scale of the whole drive
                width = 3.0 * s.sigma[:, k]
                width = np.minimum(width, np.nanquantile(width, 0.97) if np.isfinite(width).any() else 0.0)
                centre = 0.0 if about_zero else s.value[:, k]
                extremes += [centre - width, centre + width]
        ylims.append(limits(extremes, symmetric=about_zero))
    drawing = Drawing.stack(
        [f"{c} [{unit}]" for c in components], time_limits(series.values()), ylims, units=[unit] * len(components)
    )
    for k, panel in enumerate(drawing.panels):
        panel.shade(spans or {})
        for name, s in series.items():
            if s.sigma is not None:
                width = 3.0 * s.sigma[:, k]
                centre = np.zeros(len(s.t)) if about_zero else s.value[:, k]
                words, tint = ("3 sigma", 0.22) if len(series) == 1 else (f"{name} 3 sigma", 0.12)
                panel.band(s.t, centre - width, centre + width, name, label=words, alpha=tint)
            panel.line(s.t, s.value[:, k], name, label=name)
        if about_zero:
            panel.level(0.0, dash=False, size=0.5, z=1.8)
    return drawing


def sigmas(series: Mapping[str, Series], components: Sequence[str], unit: str, *, spans: Shades = None) -> Drawing:
    """One panel per component with the 1-sigma of every solver on a logarithmic axis (`value` holds the sigma)."""
    positive = {name: np.where(s.value > 0, s.value, np.nan) for name, s in series.items()}
    ylims = [limits([np.log10(v[:, k]) for v in positive.values()], floor=0.5) for k in range(len(components))]
    titles = [f"{component} [{unit}]" for component in components]
    drawing = Drawing.stack(titles, time_limits(series.values()), ylims, units=[unit] * len(components), log=True)
    for k, panel in enumerate(drawing.panels):
        panel.shade(spans or {})
        for name, s in series.items():
            panel.line(s.t, positive[name][:, k], name, label=name)
    return drawing


def span_zoom(series: Mapping[str, Series], spans: Spans, unit: str = "m", what: str = "withheld") -> Drawing:
    """Horizontal error over time in and around each withheld span, one panel per span (`value` (N, 1))."""
    spans = list(spans)
    columns = 1 if len(spans) < 2 else 2
    rows = max(1, math.ceil(len(spans) / columns))
    panel_h = 110.0
    pitch = panel_h + 46
    drawing = Drawing(rows * pitch + 10.0)
    w = (WIDTH - LEFT - RIGHT - (columns - 1) * 34) / columns
    for number, (a, b) in enumerate(spans):
        row, column = divmod(number, columns)
        margin = 0.35 * (b - a)
        xlim = (a - margin, b + margin)
        cut = {
            name: (s.t[m], s.value[m, 0]) for name, s in series.items() for m in [(s.t >= xlim[0]) & (s.t <= xlim[1])]
        }
        panel = drawing.panel(
            (LEFT + column * (w + 34), (rows - 1 - row) * pitch + BOTTOM, w, panel_h),
            xlim,
            (0.0, limits([y for _, y in cut.values()], floor=1e-3)[1]),
            xlabel="time from the start [s]" if row == rows - 1 or number >= len(spans) - columns else "",
            title=f"horizontal error [{unit}]" if column == 0 else "",
            unit=unit,
            shared=False,
        )
        panel.shade({what: [(a, b)]})
        for name, (t, y) in cut.items():
            if len(t):
                panel.line(t, y, name, label=name, size=1.4)
    return drawing


def time_limits(series: Iterable[Series]) -> tuple[float, float]:
    """First and last time of all."""
    times = [s.t[[0, -1]] for s in series if len(s.t)]
    if not times:
        return 0.0, 1.0
    lo, hi = float(np.min(times)), float(np.max(times))
    return lo, max(hi, lo + 1e-3)
