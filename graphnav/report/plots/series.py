"""Quantities over time: values with 3 sigma, sigmas, errors in withheld spans."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array
from graphnav.report.plots.figure import Figure, Panel, Tinted, find_axis_limits

Shades = Mapping[str, Tinted]  # s from the start, by kind


@dataclass(frozen=True)
class Curve:
    """A quantity of k components over time, with its 1-sigma where known."""

    t: Array  # (N,) s from the recording's start
    value: Array  # (N, k)
    sigma: Array | None = None  # (N, k)

    def take(self, components: Sequence[int]) -> Curve:
        """Select components."""
        return Curve(self.t, self.value[:, components], None if self.sigma is None else self.sigma[:, components])


def plot_bands(
    series: Mapping[str, Curve], components: Sequence[str], unit: str | Sequence[str], end: float, *, spans: Shades,
    about_zero: bool = True, under: Callable[[Panel, int], None] | None = None,
) -> Figure:  # fmt: skip
    """One panel per component: the values, and 3 sigma about zero (errors) or about the value (biases).

    The bands of more than two series would hide each other; `plot_sigmas` shows those side by side.

    Parameters
    ----------
    unit : of all components, or of each.
    end : of the time axis, s.
    under : draws more into the panel of a component.
    """
    if len(series) > 2:
        series = {name: Curve(s.t, s.value) for name, s in series.items()}
    ylims = []
    for k in range(len(components)):
        extremes, always = [], []
        for s in series.values():
            extremes.append(s.value[:, k])
            always += [s.value[(s.t >= a) & (s.t <= b), k] for gone in spans.values() for a, b in gone]
            if s.sigma is not None:
                # the first seconds of a filter must not set the scale for the whole drive
                width = 3.0 * s.sigma[:, k]
                width = np.minimum(width, np.nanquantile(width, 0.97) if np.isfinite(width).any() else 0.0)
                centre = 0.0 if about_zero else s.value[:, k]
                extremes += [centre - width, centre + width]
        ylims.append(find_axis_limits(extremes, symmetric=about_zero, always=always))
    units = [unit] * len(components) if isinstance(unit, str) else unit
    titles = [f"{c} [{u}]" for c, u in zip(components, units, strict=True)]
    figure = Figure(titles, (0.0, end), ylims, units=units)
    for k, panel in enumerate(figure.panels):
        panel.shade(spans)
        for name, s in series.items():
            if s.sigma is not None:
                width = 3.0 * s.sigma[:, k]
                centre = np.zeros(len(s.t)) if about_zero else s.value[:, k]
                words, tint = ("3 sigma", 0.22) if len(series) == 1 else (f"{name} 3 sigma", 0.14)
                panel.draw_band(s.t, centre - width, centre + width, name, words, tint)
        if under is not None:
            under(panel, k)
        for name, s in series.items():
            panel.draw_line(s.t, s.value[:, k], name, name)
        if about_zero:
            panel.level(0.0, width=0.6)
    return figure


def plot_sigmas(
    series: Mapping[str, Curve], components: Sequence[str], unit: str, end: float, *, spans: Shades
) -> Figure:
    """One panel per component with the 1-sigma of every solver on a logarithmic axis (`value` holds the sigma)."""
    positive = {name: np.where(s.value > 0, s.value, np.nan) for name, s in series.items()}
    ylims = [
        find_axis_limits([np.log10(v[:, k]) for v in positive.values()], floor=0.5) for k in range(len(components))
    ]
    titles = [f"{component} [{unit}]" for component in components]
    figure = Figure(titles, (0.0, end), ylims, units=[unit] * len(components), log=True)
    for k, panel in enumerate(figure.panels):
        panel.shade(spans)
        for name, s in series.items():
            panel.draw_line(s.t, positive[name][:, k], name, name)
    return figure


def plot_span_zoom(series: Mapping[str, Curve], spans: Tinted, what: str = "withheld") -> Figure:
    """Horizontal error (m) over time in and around each span, one panel per span (`value` (N, 1))."""
    shown, xlims, ylims = [], [], []
    for a, b in spans:
        margin = 0.35 * (b - a)
        xlims.append((a - margin, b + margin))
        inside = {name: (s.t >= xlims[-1][0]) & (s.t <= xlims[-1][1]) for name, s in series.items()}
        shown.append({name: (s.t[inside[name]], s.value[inside[name], 0]) for name, s in series.items()})
        values = [y for _, y in shown[-1].values()]
        ylims.append((0.0, find_axis_limits(values, floor=1e-3, always=values)[1]))
    columns = 1 if len(shown) < 2 else 2
    titles = ["horizontal error [m]", *[""] * (len(shown) - 1)]
    figure = Figure(titles, xlims, ylims, units=["m"] * len(shown), height=150, apart=True, columns=columns)
    for panel, span, cut in zip(figure.panels, spans, shown, strict=True):
        panel.shade({what: [span]})
        for name, (t, y) in cut.items():
            if len(t):
                panel.draw_line(t, y, name, name, width=1.8)
    return figure
