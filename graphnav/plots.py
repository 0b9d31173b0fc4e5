"""Figures of trajectories, errors, biases and residuals. Data in, `matplotlib.figure.Figure` out.

Times are seconds from the recording's start, as on the command line. `figure.savefig` writes any format;
`graphnav.panels.svg` makes one that follows a page's light or dark colours.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from graphnav.panels import BINS, WIDTH, Panel, legend, limits, new_figure, thin, with_breaks
from graphnav.rotation import Array
from graphnav.solution import ConstraintRecord

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Spans = Sequence[tuple[float, float]]
LEFT, RIGHT, TOP, BOTTOM, GAP = 50.0, 8.0, 20.0, 32.0, 9.0


@dataclass(frozen=True)
class Series:
    """Something of k components over time, with its 1-sigma where there is one."""

    t: Array  # (N,) s from the recording's start
    value: Array  # (N, k)
    sigma: Array | None = None  # (N, k)


def trajectory(
    tracks: Mapping[str, tuple[Array, Array]],
    *,
    fixes: Array | None = None,
    spans: Spans = (),
    truth: Array | None = None,
) -> Figure:
    """The way from above.

    Parameters
    ----------
    tracks : per solver the times (N,) and east, north (N, 2), m.
    fixes : (M, 2) m, GNSS positions, faint dots.
    spans : s, where fixes were withheld: underlaid on the first track.
    truth : (L, 2) m
    """
    parts = [en for _, en in tracks.values()] + [a for a in (fixes, truth) if a is not None]
    both = np.concatenate(parts) if parts else np.zeros((0, 2))
    both = both[np.isfinite(both).all(axis=1)]
    lo, hi = (both.min(axis=0), both.max(axis=0)) if len(both) else (np.zeros(2), np.ones(2))
    w = WIDTH - LEFT - RIGHT
    size = np.maximum(hi - lo, 1e-3) * 1.08
    h = float(np.clip(w * size[1] / size[0], 0.45 * w, 1.15 * w))
    scale = max(size[0] / w, size[1] / h)  # m per point, the same on both axes
    mid = (lo + hi) / 2
    figure = new_figure(h + BOTTOM + TOP)
    panel = Panel(
        figure,
        (LEFT, BOTTOM, w, h),
        (mid[0] - scale * w / 2, mid[0] + scale * w / 2),
        (mid[1] - scale * h / 2, mid[1] + scale * h / 2),
        xlabel="east [m]",
        ylabel="north [m]",
        yticks=max(3, int(h / 45)),
    )
    entries = []
    if fixes is not None and len(fixes):
        keep = np.arange(0, len(fixes), max(1, len(fixes) // 1500))
        panel.dots(fixes[keep, 0], fixes[keep, 1], "ink", label="fixes", size=2.0, alpha=0.45, zorder=1)
        entries.append(("GNSS", "ink", "dots"))
    if truth is not None and len(truth):
        rows = _thin_way(np.arange(len(truth), dtype=float), truth)
        panel.line(truth[rows, 0], truth[rows, 1], "truth", label="truth", lw=2.4, alpha=0.5, zorder=2)
        entries.append(("truth", "truth", "line"))
    for number, (name, (t, en)) in enumerate(tracks.items()):
        rows = _thin_way(t, en)
        if number == 0 and spans:
            inside = np.any([(t >= a) & (t <= b) for a, b in spans], axis=0)
            way = np.where(inside[:, None], en, np.nan)[np.union1d(rows, np.flatnonzero(np.diff(inside)) + 1)]
            panel.line(way[:, 0], way[:, 1], "withheld", label="withheld", lw=6.0, alpha=0.55, zorder=1.5)
        panel.line(en[rows, 0], en[rows, 1], name, label=name, lw=1.3)
        entries.append((name, name, "line"))
    if spans:
        entries.append(("withheld", "withheld", "band"))
    if tracks:
        _, en = next(iter(tracks.values()))
        few = max(1, len(en) // 30)
        for row, inner, marker, words in ((0, few, "^", "start"), (-1, -1 - few, "s", "end")):
            panel.marks(en[[row], 0], en[[row], 1], "truth", marker, label=words, size=6.5)
            # the words go to the side where the track does not
            away = en[row] - en[min(inner, len(en) - 1) if inner > 0 else max(inner, -len(en))]
            x, y = (en[row] - (panel.xlim[0], panel.ylim[0])) / scale
            right = x < 0.1 * w or (away[0] >= 0 and x < 0.88 * w)
            down = y > 0.05 * h and away[1] < 0
            at = (LEFT + x + (6 if right else -6), BOTTOM + y + (-11 if down else 4))
            panel.text(*at, words, name="truth", ha="left" if right else "right")
    _scale_bar(panel, scale, w)
    legend(figure, entries, h + BOTTOM + 7, LEFT)
    return figure


def _thin_way(t: Array, en: Array) -> np.ndarray:
    return np.union1d(thin(t, en[:, 0]), thin(t, en[:, 1]))


def _scale_bar(panel: Panel, scale: float, w: float) -> None:
    """A bar of a round number of metres, about a fifth of the width, in the lower right."""
    metres = 10.0 ** math.floor(math.log10(scale * w / 5))
    metres *= max(m for m in (1, 2, 5) if m * metres <= scale * w / 4)
    x1, y = panel.xlim[1] - 10 * scale, panel.ylim[0] + 9 * scale
    panel.line(np.array([x1 - metres, x1]), np.array([y, y]), "truth", label="scale", lw=2.5, zorder=4)
    words = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
    panel.text(LEFT + w - 10 - metres / scale / 2, BOTTOM + 13, words, name="truth", ha="center")


def bands(
    series: Mapping[str, Series],
    components: Sequence[str],
    unit: str,
    *,
    spans: Spans = (),
    about_zero: bool = True,
) -> Figure:
    """One panel per component: the values, and 3 sigma about zero (errors) or about the value (biases).

    The bands of more than two series would hide each other; `sigmas` shows those side by side.
    """
    if len(series) > 2:
        series = {name: Series(s.t, s.value) for name, s in series.items()}
    figure, boxes = _stack(len(components))
    xlim = _time_limits(series.values())
    for k, (box, component) in enumerate(zip(boxes, components, strict=True)):
        extremes: list[Array] = []
        for s in series.values():
            extremes.append(s.value[:, k])
            if s.sigma is not None:
                # the first moments of a filter must not set the scale of the whole drive
                width = 3.0 * s.sigma[:, k]
                width = np.minimum(width, np.nanquantile(width, 0.97) if np.isfinite(width).any() else 0.0)
                centre = 0.0 if about_zero else s.value[:, k]
                extremes += [centre - width, centre + width]
        panel = _time_panel(
            figure, box, xlim, limits(extremes, symmetric=about_zero), f"{component} [{unit}]", k, boxes
        )
        panel.shade(spans)
        for name, s in series.items():
            rows = thin(s.t, s.value[:, k])
            if s.sigma is not None:
                t, sigma, value = with_breaks(s.t, thin(s.t, s.sigma[:, k], BINS // 2), s.sigma[:, k], s.value[:, k])
                centre = 0.0 if about_zero else value
                tint = 0.22 if len(series) == 1 else 0.12
                panel.band(t, centre - 3 * sigma, centre + 3 * sigma, name, label=f"{name} 3 sigma", alpha=tint)
            x, y = with_breaks(s.t, rows, s.value[:, k])
            panel.line(x, y, name, label=name)
        if about_zero:
            panel.line(np.array(xlim), np.zeros(2), "ink", lw=0.5, label="_zero", zorder=1.8)
    entries = [(name, name, "line") for name in series]
    if any(s.sigma is not None for s in series.values()):
        entries.append(("3 sigma", next(iter(series)), "band"))
    _time_legend(figure, entries, spans)
    return figure


def sigmas(series: Mapping[str, Series], components: Sequence[str], unit: str, *, spans: Spans = ()) -> Figure:
    """One panel per component with the 1-sigma of every solver on a logarithmic axis (`value` holds the sigma)."""
    figure, boxes = _stack(len(components))
    xlim = _time_limits(series.values())
    for k, (box, component) in enumerate(zip(boxes, components, strict=True)):
        positive = {name: np.where(s.value[:, k] > 0, s.value[:, k], np.nan) for name, s in series.items()}
        lo, hi = limits([np.log10(v) for v in positive.values()], floor=0.5)
        panel = _time_panel(figure, box, xlim, (lo, hi), f"{component} [{unit}]", k, boxes, log=True)
        panel.shade(spans)
        for name, s in series.items():
            rows = thin(s.t, positive[name])
            x, y = with_breaks(s.t, rows, positive[name])
            panel.line(x, y, name, label=name)
    _time_legend(figure, [(name, name, "line") for name in series], spans)
    return figure


def residuals(name: str, record: ConstraintRecord, start: float, solver: str = "", *, spans: Spans = ()) -> Figure:
    """Whitened components over time between +-3, rejected ones marked; below, the NIS and its histogram.

    Parameters
    ----------
    start : the recording's start on the record's clock, s.
    solver : whose colour to draw in.
    """
    t = record.t - start
    white = record.residual / record.sigma
    m = white.shape[1]
    rejected = record.weight <= 1e-9
    reduced = ~rejected & (record.weight < 0.5)
    figure, boxes = _stack(m + 1, height=62.0)
    xlim = _time_limits([Series(t, white)])
    look = solver or "batch"
    for k in range(m):
        box = boxes[k]
        top = float(np.clip(np.nanmax(np.abs(white[:, k]), initial=3.5) * 1.06, 4.0, 12.0))
        panel = _time_panel(figure, box, xlim, (-top, top), record.axes[k], k, boxes)
        panel.shade(spans)
        # what lies beyond the panel is drawn at its edge: it must be seen
        y = np.clip(white[:, k], -0.98 * top, 0.98 * top)
        panel.dots(*_picked(t, y, ~rejected & ~reduced), look, label=record.axes[k])
        panel.dots(*_picked(t, y, reduced), "withheld", label="weight < 0.5", size=3.0, zorder=3)
        panel.marks(*_picked(t, y, rejected), "alert", "x", label="rejected")
        for level in (-3.0, 3.0):
            panel.line(np.array(xlim), np.full(2, level), "ink", label="_3", lw=0.8, ls=(0, (4, 3)))
    x, y0, w, h = boxes[m]
    nis = record.nis
    # beyond this an epoch is in the outermost 1 % of the distribution
    lo, hi = chi2_quantile(0.005, m), chi2_quantile(0.995, m)
    top = float(min(np.nanmax(nis, initial=hi) * 1.06, 4.0 * hi)) if len(nis) else 1.0
    share = 0.68
    panel = Panel(figure, (x, y0, w * share, h), xlim, (0.0, top), xlabel="time [s]", ylabel="NIS", yticks=3)
    panel.shade(spans)
    panel.band(np.array(xlim), np.full(2, lo), np.full(2, hi), "ink", label="99 %", alpha=0.15)
    y = np.minimum(nis, 0.98 * top)
    panel.dots(*_picked(t, y, ~rejected), look, label="nis")
    panel.marks(*_picked(t, y, rejected), "alert", "x", label="rejected")
    _histogram(figure, (x + w * share + 26, y0, w * (1 - share) - 26, h), nis[~rejected], m, look, top)
    entries = [(f"{name}, over sigma", look, "dots")]
    if reduced.any():
        entries.append(("weight < 0.5", "withheld", "dots"))
    if rejected.any():
        entries.append(("rejected", "alert", "cross"))
    _time_legend(figure, entries, spans)
    return figure


def chi2_quantile(probability: float, dof: float) -> float:
    """Where the chi-square distribution function is `probability` (scipy.stats would take 0.7 s to import)."""
    from scipy import special

    return float(special.chdtri(dof, 1.0 - probability))


def _histogram(
    figure: Figure, box: tuple[float, float, float, float], nis: Array, m: int, look: str, top: float
) -> None:
    """The share of epochs per bin beside the chi-square density with m degrees of freedom."""
    from scipy import special

    edges = np.linspace(0.0, max(chi2_quantile(0.999, m), 1e-6), 25)
    nis = nis[np.isfinite(nis)]
    density = np.histogram(nis, edges)[0] / max(len(nis), 1) / np.diff(edges)
    x = np.linspace(edges[-1] / 200, edges[-1], 120)
    expected = np.exp(special.xlogy(m / 2 - 1, x / 2) - x / 2 - special.gammaln(m / 2)) / 2
    # for one degree of freedom the density has no bound at 0, so the first bin's mean stands for it
    ceiling = 1.15 * max(density.max(), float(np.diff(special.gammainc(m / 2, edges / 2)).max() / edges[1]))
    panel = Panel(figure, box, (0.0, float(edges[-1])), (0.0, ceiling), xlabel="NIS", yticks=3)
    steps = np.repeat(density, 2)
    panel.band(np.repeat(edges, 2)[1:-1], np.zeros(len(steps)), steps, look, label="histogram", alpha=0.45)
    panel.line(x, expected, "truth", label="chi-square", lw=1.2)


def _picked(t: Array, y: Array, mask: np.ndarray) -> tuple[Array, Array]:
    t, y = t[mask], y[mask]
    rows = thin(t, y, 300)
    return t[rows], y[rows]


def span_zoom(series: Mapping[str, Series], spans: Spans, unit: str = "m") -> Figure:
    """Horizontal error over time in and around each withheld span, one panel per span (`value` (N, 1))."""
    spans = list(spans)
    columns = 1 if len(spans) < 2 else 2
    rows = max(1, math.ceil(len(spans) / columns))
    panel_h = 110.0
    pitch = panel_h + 46
    figure = new_figure(rows * pitch + TOP)
    w = (WIDTH - LEFT - RIGHT - (columns - 1) * 34) / columns
    for number, (a, b) in enumerate(spans):
        row, column = divmod(number, columns)
        box = (LEFT + column * (w + 34), (rows - 1 - row) * pitch + BOTTOM, w, panel_h)
        margin = 0.35 * (b - a)
        xlim = (a - margin, b + margin)
        cut = {
            name: (s.t[m], s.value[m, 0]) for name, s in series.items() for m in [(s.t >= xlim[0]) & (s.t <= xlim[1])]
        }
        top = limits([y for _, y in cut.values()], floor=1e-3)[1]
        panel = Panel(
            figure,
            box,
            xlim,
            (0.0, top),
            xlabel="time [s]",
            ylabel=f"horizontal error [{unit}]" if column == 0 else "",
        )
        panel.shade([(a, b)])
        for name, (t, y) in cut.items():
            if not len(t):
                continue
            keep = thin(t, y)
            x, y = with_breaks(t, keep, y)
            panel.line(x, y, name, label=name, lw=1.4)
    legend(figure, [(n, n, "line") for n in series] + [("withheld", "withheld", "band")], rows * pitch + 7, LEFT)
    return figure


def _stack(count: int, height: float = 84.0) -> tuple[Figure, list[tuple[float, float, float, float]]]:
    """A figure with `count` panels under each other, the first on top."""
    figure = new_figure(count * (height + GAP) - GAP + BOTTOM + TOP)
    w = WIDTH - LEFT - RIGHT
    return figure, [(LEFT, BOTTOM + (count - 1 - k) * (height + GAP), w, height) for k in range(count)]


def _time_limits(series: Iterable[Series]) -> tuple[float, float]:
    times = [s.t[[0, -1]] for s in series if len(s.t)]
    if not times:
        return 0.0, 1.0
    lo, hi = float(np.min(times)), float(np.max(times))
    return lo, max(hi, lo + 1e-3)


def _time_panel(
    figure: Figure,
    box: tuple[float, float, float, float],
    xlim: tuple[float, float],
    ylim: tuple[float, float],
    ylabel: str,
    k: int,
    boxes: Sequence[object],
    log: bool = False,
) -> Panel:
    last = k == len(boxes) - 1
    xlabel = "time [s]" if last else ""
    return Panel(figure, box, xlim, ylim, xlabel=xlabel, ylabel=ylabel, xlabels=last, log=log, yticks=5)


def _time_legend(figure: Figure, entries: list[tuple[str, str, str]], spans: Spans) -> None:
    if spans:
        entries = [*entries, ("withheld", "withheld", "band")]
    legend(figure, entries, 72.0 * figure.get_size_inches()[1] - TOP + 7, LEFT)
