"""Consistency of sigma: whitened residuals, NIS and NEES with their chi-square bands; use of constraints over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.sample_size import chi_square_quantile
from graphnav.estimation.solution import ConstraintRecord
from graphnav.report.plots.figure import Figure, Panel, find_axis_limits
from graphnav.report.plots.series import Curve, Shades

_CHI2 = "99 % of chi-square"


def plot_residuals(record: ConstraintRecord, start: float, end: float, solver: str = "", *, spans: Shades) -> Figure:
    """Whitened components over time between +-3, rejected ones marked; below, the NIS.

    Parameters
    ----------
    start : the recording's start on the record's clock, s; `end` of the time axis from there.
    solver : whose colour to draw in.
    """
    t = record.t - start
    white = record.residual / record.sigma
    m = white.shape[1]
    tops = [float(np.clip(np.nanmax(np.abs(white[:, k]), initial=3.5) * 1.06, 4.0, 12.0)) for k in range(m)]
    nis = record.nis
    # an epoch beyond this is in the outermost 1 % of the distribution
    lo, hi = chi_square_quantile(0.005, m), chi_square_quantile(0.995, m)
    bottom, top = math.log10(0.1 * lo), math.log10(max(10.0 * hi, min(np.nanmax(nis, initial=hi), 1000.0 * hi)))
    figure = Figure(
        [*(f"{axis}, residual / sigma" for axis in record.axes), "NIS"],
        (0.0, end),
        [*((-most, most) for most in tops), (bottom, top)],
        log=[*(False for _ in tops), True],
        height=74,
    )
    look = solver or "batch"
    *components, last = figure.panels
    for k, panel in enumerate(components):
        panel.shade(spans)
        # values beyond the panel are drawn at its edge, so that they are seen
        _plot_epochs(panel, t, np.clip(white[:, k], -0.98 * tops[k], 0.98 * tops[k]), record.weight, look)
        panel.level(-3.0, dash=True)
        panel.level(3.0, dash=True)
    last.shade(spans)
    last.draw_band(np.array([0.0, end]), np.full(2, lo), np.full(2, hi), "ink", _CHI2)
    _plot_epochs(last, t, np.clip(nis, 10.0**bottom, 10.0**top), record.weight, look)
    return figure


def _plot_epochs(panel: Panel, t: Array, y: Array, weight: Array, look: str) -> None:
    """Used, down-weighted and rejected epochs, each with its marker."""
    rejected = weight <= 1e-9
    reduced = ~rejected & (weight < 0.5)
    used = ~rejected & ~reduced
    for chosen, name, words, size in ((used, look, "used", 3.0), (reduced, "withheld", "weight < 0.5", 5.0)):
        if chosen.any():
            panel.draw_dots(t[chosen], y[chosen], name, words, size)
    if rejected.any():
        panel.draw_dots(t[rejected], y[rejected], "alert", "rejected", 8.0, "x")


def plot_nees(
    series: Mapping[str, Curve], names: Sequence[str], dofs: Sequence[int], end: float, *, spans: Shades
) -> Figure:
    """NEES per degree of freedom, one panel for each of `names`, with the middle 99 % of chi-square for one epoch.

    Parameters
    ----------
    series : per solver, `value` (N, k) the NEES itself, not yet divided.
    dofs : k degrees of freedom.
    """
    scaled = {key: np.where(s.value > 0, s.value / np.array(dofs, float), np.nan) for key, s in series.items()}
    edges = [(chi_square_quantile(0.005, dof) / dof, chi_square_quantile(0.995, dof) / dof) for dof in dofs]
    # errors cross zero: how close they come to it is without meaning
    ylims = []
    for k, (low, high) in enumerate(edges):
        values = [np.log10(np.maximum(v[:, k], 0.3 * low)) for v in scaled.values()]
        ylims.append(find_axis_limits([*values, np.log10([low, high])], always=[*values, np.log10([low, high])]))
    titles = [f"{name} NEES / {dof}" for name, dof in zip(names, dofs, strict=True)]
    figure = Figure(titles, (0.0, end), ylims, log=True)
    for k, panel in enumerate(figure.panels):
        panel.shade(spans)
        band = [np.full(2, e) for e in edges[k]]
        panel.draw_band(np.array([0.0, end]), band[0], band[1], "ink", _CHI2)
        panel.level(1.0, dash=True)
        for key, s in series.items():
            panel.draw_line(s.t, np.maximum(scaled[key][:, k], 10.0 ** panel.ylim[0]), key, key)
    return figure


def plot_timeline(
    records: Mapping[str, ConstraintRecord], start: float, end: float, solver: str = "", *, spans: Shades
) -> Figure:
    """A row per constraint: when it was used, down-weighted and rejected; `end` of the time axis from `start`."""
    count = max(len(records), 1)
    names = {float(count - 1 - k): name for k, name in enumerate(records)}
    figure = Figure([""], (0.0, end), [(-0.6, count - 0.4)], height=24 * count, names=names)
    (panel,) = figure.panels
    panel.shade(spans)
    for row, name in names.items():
        record = records[name]
        _plot_epochs(panel, record.t - start, np.full(len(record.t), row), record.weight, solver or "batch")
    return figure
