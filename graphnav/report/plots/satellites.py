"""Raw GNSS: sky plot, satellites used over time, residuals by satellite and elevation, arcs of carriers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array
from graphnav.estimation.solution import CarrierArcs, ConstraintRecord
from graphnav.report.plots.figure import Figure, find_axis_limits, find_colour
from graphnav.report.plots.series import Shades
from graphnav.report.plots.thinning import BINS

HALF = 0.5  # weight of a row below which it counts as rejected
_SKY = 320  # pixels
_ROW_HEIGHT = 15  # pixels per satellite or signal
_PLENTY = 4 * BINS  # points of a scatter plot that are drawn without thinning
_RINGS = (0.0, 30.0, 60.0)  # deg of elevation
_NAME = (22.0, 8.0)  # deg of a sky plot that a satellite's name is wide and high
_BINS = np.arange(0.0, 90.1, 5.0)  # deg of elevation


def plot_sky(record: ConstraintRecord, solver: str) -> Figure:
    """Sky plot: the zenith in the middle, the horizon around, north up; rejected rows marked.

    Parameters
    ----------
    record : of rows of satellites.
    solver : whose colour to draw in.
    """
    off = 90.0 - np.degrees(record.elevation)
    x, y = off * np.sin(record.azimuth), off * np.cos(record.azimuth)
    figure = Figure([""], (-105.0, 105.0), [(-97.0, 97.0)], height=_SKY, x="", equal=True)
    (panel,) = figure.panels
    for name in figure.axes:
        figure.axes[name] |= {"visible": False}
    for ring in _RINGS:
        r = 90.0 - ring
        figure.shapes.append({
            "type": "circle", "xref": "x", "yref": "y", "x0": -r, "x1": r, "y0": -r, "y1": r, "layer": "below",
            "line": {"color": find_colour("grid"), "width": 1},
        })  # fmt: skip
        panel.write_words(0.0, r, "" if ring == 0.0 else f"{ring:.0f}°", "left", (2, -2), "ink")
    for words, at, align, shift in (
        ("N", (0.0, 90.0), "center", (0, 0)), ("E", (90.0, 0.0), "left", (3, -8)),
        ("S", (0.0, -90.0), "center", (0, -17)), ("W", (-90.0, 0.0), "right", (-3, -8)),
    ):  # fmt: skip
        panel.write_words(*at, words, align, shift, "ink")
    refused = record.weight < HALF
    if refused.any():  # below the others, as a rim of those: a satellite that stands still would hide under them
        own = _choose_rows(np.flatnonzero(refused))
        panel.draw_dots(x[own], y[own], "alert", "less than half weight", 5.0, t=record.t[own], path=True)
    named = [(_NAME[0] / 2, 90.0 - ring) for ring in _RINGS]  # middles of words
    for name in np.unique(record.satellite):
        own = np.flatnonzero(record.satellite == name)
        used = _choose_rows(own[~refused[own]], _PLENTY // 8)
        if len(used):
            panel.draw_dots(x[used], y[used], solver, "used", 3.0, t=record.t[used], path=True)
        at = float(x[own[-1]]), float(y[own[-1]])
        right, left = ((at[0] + side * _NAME[0] / 2, at[1]) for side in (1.0, -1.0))
        turned = _find_room(left, named) > _find_room(right, named)
        panel.write_words(*at, str(name), "right" if turned else "left", (-4 if turned else 4, -4))
        named.append(left if turned else right)
    return figure


def _find_room(place: tuple[float, float], named: list[tuple[float, float]]) -> float:
    """How far a name there is from the next of its line, deg, up to its own width."""
    return min([_NAME[0], *(abs(place[0] - x) for x, y in named if abs(place[1] - y) < _NAME[1])])


def plot_used_satellites(
    records: Mapping[str, ConstraintRecord], start: float, end: float, solver: str, *, spans: Shades
) -> Figure:
    """Numbers of satellites used and rejected at each epoch; a panel for each kind of row."""
    counts, ylims = [], []
    for record in records.values():
        t, of = np.unique(record.t, return_inverse=True)
        good = np.bincount(of, weights=record.weight >= HALF, minlength=len(t))
        counts.append((t - start, good, np.bincount(of, minlength=len(t)) - good))
        ylims.append((-0.5, float(np.max(np.bincount(of), initial=1)) * 1.08 + 0.5))
    figure = Figure([f"{kind}: rows of an epoch" for kind in records], (0.0, end), ylims)
    for panel, (t, good, refused) in zip(figure.panels, counts, strict=True):
        panel.shade(spans)
        panel.draw_line(t, good, solver, "used")
        panel.draw_line(t, refused, "alert", "less than half weight")
    return figure


def plot_satellite_rows(record: ConstraintRecord, start: float, end: float, solver: str, *, spans: Shades) -> Figure:
    """A line for each satellite: when its rows were used, and when rejected."""
    every = sorted(set(record.satellite.tolist()))
    figure, places = _plot_named_rows(every, (0.0, end), {"spans": spans})
    (panel,) = figure.panels
    refused = record.weight < HALF
    for name, row in places.items():
        own = record.satellite == name
        for some, look, words, size in (
            (own & ~refused, solver, "used", 3.0),
            (own & refused, "alert", "less than half weight", 5.0),
        ):
            if some.any():
                panel.draw_dots(record.t[some] - start, np.full(int(some.sum()), row), look, words, size)
    return figure


def plot_residuals_by_elevation(records: Mapping[str, ConstraintRecord], solver: str) -> Figure:
    """Every residual over its elevation, and by steps of it their RMS beside the stated sigma."""
    shown = [(kind, np.degrees(r.elevation), r, r.residual[:, 0]) for kind, r in records.items()]
    units = [r.unit for r in records.values()]
    ylims = [find_axis_limits([y[r.weight >= HALF]], symmetric=True) for _, _, r, y in shown]
    titles = [f"{kind} [{unit}]" for kind, unit in zip(records, units, strict=True)]
    figure = Figure(titles, (0.0, 90.0), ylims, units=units, x="elevation [deg]")
    for panel, (_, x, record, y) in zip(figure.panels, shown, strict=True):
        used = record.weight >= HALF
        bounded = np.clip(y, 0.98 * panel.ylim[0], 0.98 * panel.ylim[1])
        for some, look, words, size in ((used, solver, "used", 2.5), (~used, "alert", "less than half weight", 4.0)):
            rows = _choose_rows(np.flatnonzero(some))
            if len(rows):
                panel.draw_dots(x[rows], bounded[rows], look, words, size, alpha=0.4, path=True)
        middle, rms, sigma = _bin_by_elevation(x[used], y[used], record.sigma[used, 0])
        panel.draw_line(middle, rms, "truth", "RMS in steps of 5 deg", width=2.2)
        panel.draw_line(middle, sigma, "withheld", "their sigma", width=2.2, dash=True)
    return figure


def plot_residuals_by_satellite(kind: str, record: ConstraintRecord, solver: str) -> Figure:
    """For each satellite the median, the middle half and the middle 95 % of its residuals."""
    every = sorted(set(record.satellite.tolist()))
    y, used = record.residual[:, 0], record.weight >= HALF
    parts = {name: np.quantile(own, [0.025, 0.25, 0.5, 0.75, 0.975]) for name in every
             if len(own := y[used & (record.satellite == name)])}  # fmt: skip
    reach = find_axis_limits([np.concatenate([*parts.values(), np.zeros(1)])], symmetric=True)
    figure, places = _plot_named_rows(every, reach, {"x": f"{kind} [{record.unit}]"})
    (panel,) = figure.panels
    panel.draw_line(np.zeros(2), np.array(panel.ylim), "ink", width=0.8, quiet=True)
    gap = np.nan
    for a, b, width, words in ((0, 4, 1.5, "middle 95 %"), (1, 3, 5.0, "middle half")):
        lines = np.array([[q[a], places[n]] for n in parts for q in (parts[n], parts[n][[b] * 5], np.full(5, gap))])
        panel.draw_path(lines, solver, words, width=width)
    panel.draw_dots(
        np.array([q[2] for q in parts.values()]),
        np.array([places[n] for n in parts]),
        "truth",
        "median",
        6.0,
        path=True,
    )
    return figure


def plot_carrier_arcs(arcs: CarrierArcs, start: float, end: float, *, spans: Shades) -> Figure:
    """A line for each signal of a satellite: its arcs, with integer and with real-valued ambiguities."""
    figure, places = _plot_named_rows(sorted(set(arcs.name.tolist())), (0.0, end), {"spans": spans})
    (panel,) = figure.panels
    row = np.array([places[name] for name in arcs.name.tolist()])
    for some, look, words in ((~arcs.integer, "float", "real number"), (arcs.integer, "fixed", "integer")):
        if some.any():
            x = np.stack([arcs.begin[some], arcs.end[some], np.full(int(some.sum()), np.nan)], -1) - start
            panel.draw_path(np.stack([x.ravel(), np.repeat(row[some], 3)], -1), look, words, width=5.0)
    first = np.unique(np.stack([row, arcs.begin - start], -1), axis=0)
    panel.draw_dots(first[:, 1], first[:, 0], "truth", "begins", 3.0, "s", path=True)
    return figure


def _plot_named_rows(
    every: list[str], xlim: tuple[float, float], more: dict[str, Any]
) -> tuple[Figure, dict[str, float]]:
    """A panel with a line for each name, the first on top, and the positions of these."""
    places = {name: float(len(every) - 1 - k) for k, name in enumerate(every)}
    spans = more.pop("spans", {})
    figure = Figure(
        [""], xlim, [(-0.7, len(every) - 0.3)], height=max(_ROW_HEIGHT * len(every), 60),
        names={row: name for name, row in places.items()}, **more,
    )  # fmt: skip
    figure.panels[0].shade(spans)
    return figure, places


def _choose_rows(rows: NDArray[np.intp], most: int = _PLENTY) -> NDArray[np.intp]:
    """Evenly chosen rows of a scatter plot: it keeps its shape, which extremes alone would not."""
    return rows[:: -(-len(rows) // most) or 1]


def _bin_by_elevation(x: Array, y: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Middles (B,) of the steps of elevation that have rows, deg, RMS of these, and of their sigmas."""
    of = np.digitize(x, _BINS)
    steps = [of == k for k in np.unique(of) if np.count_nonzero(of == k) > 1]
    return (
        np.array([np.mean(x[some]) for some in steps]),
        np.array([np.sqrt(np.mean(y[some] ** 2)) for some in steps]),
        np.array([np.sqrt(np.mean(sigma[some] ** 2)) for some in steps]),
    )
