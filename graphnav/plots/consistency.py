"""Whether sigma can be believed: whitened residuals, NIS and NEES with their chi-square bands; what was used when."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from graphnav.panels import LEFT, RIGHT, WIDTH, Drawing, Panel, limits
from graphnav.panels.drawing import BOTTOM, TITLE
from graphnav.plots.series import Series, Shades, time_limits
from graphnav.rotation import Array
from graphnav.solution import ConstraintRecord

_HISTOGRAM = 70.0  # points
_NAMES = 104.0  # points, room for the names of constraints


def chi2_quantile(probability: float, dof: float) -> float:
    """Where the chi-square distribution function is `probability` (scipy.stats would take 0.7 s to import)."""
    from scipy import special

    return float(special.chdtri(dof, 1.0 - probability))


def residuals(record: ConstraintRecord, start: float, solver: str = "", *, spans: Shades = None) -> Drawing:
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
    tops = [float(np.clip(np.nanmax(np.abs(white[:, k]), initial=3.5) * 1.06, 4.0, 12.0)) for k in range(m)]
    nis = record.nis
    # beyond this an epoch is in the outermost 1 % of the distribution
    lo, hi = chi2_quantile(0.005, m), chi2_quantile(0.995, m)
    bottom, top = math.log10(0.1 * lo), math.log10(max(10.0 * hi, min(np.nanmax(nis, initial=hi), 1000.0 * hi)))
    drawing = Drawing.stack(
        [*(f"{axis}, residual / sigma" for axis in record.axes), "NIS"],
        time_limits([Series(t, white)]),
        [*((-most, most) for most in tops), (bottom, top)],
        log=[*(False for _ in tops), True],
        height=60.0,
        below=_HISTOGRAM + TITLE + BOTTOM + 4.0,
    )
    look = solver or "batch"
    *components, last = drawing.panels
    for k, panel in enumerate(components):
        panel.shade(spans or {})
        # what lies beyond the panel is drawn at its edge: it must be seen
        _epochs(panel, t, np.clip(white[:, k], -0.98 * tops[k], 0.98 * tops[k]), record.weight, look)
        panel.level(-3.0)
        panel.level(3.0)
    last.shade(spans or {})
    edge = np.array(last.xlim)
    last.band(edge, np.full(2, lo), np.full(2, hi), "ink", label="99 % of chi-square", alpha=0.15)
    _epochs(last, t, np.clip(nis, 10.0**bottom, 10.0**top), record.weight, look)
    _histogram(drawing, nis[~rejected], m, look)
    return drawing


def _epochs(panel: Panel, t: Array, y: Array, weight: Array, look: str) -> None:
    """What was used, weakened and rejected, each in its look."""
    rejected = weight <= 1e-9
    reduced = ~rejected & (weight < 0.5)
    used = ~rejected & ~reduced
    for chosen, name, words, size in ((used, look, "used", 1.8), (reduced, "withheld", "weight < 0.5", 3.0)):
        if chosen.any():
            panel.dots(t[chosen], y[chosen], name, label=words, size=size, z=2.5 + 0.1 * size)
    if rejected.any():
        panel.marks(t[rejected], y[rejected], "alert", "x", label="rejected")


def _histogram(drawing: Drawing, nis: Array, m: int, look: str) -> None:
    """The share of epochs per bin beside the chi-square density with m degrees of freedom."""
    from scipy import special

    edges = np.linspace(0.0, max(chi2_quantile(0.999, m), 1e-6), 25)
    nis = nis[np.isfinite(nis)]
    density = np.histogram(nis, edges)[0] / max(len(nis), 1) / np.diff(edges)
    x = np.linspace(edges[-1] / 200, edges[-1], 120)
    expected = np.exp(special.xlogy(m / 2 - 1, x / 2) - x / 2 - special.gammaln(m / 2)) / 2
    # for one degree of freedom the density has no bound at 0, so the first bin's mean stands for it
    ceiling = 1.15 * max(density.max(), float(np.diff(special.gammainc(m / 2, edges / 2)).max() / edges[1]))
    box = (LEFT, BOTTOM, WIDTH - LEFT - RIGHT, _HISTOGRAM)
    panel = drawing.panel(
        box, (0.0, float(edges[-1])), (0.0, ceiling), xlabel="NIS", title="density", yticks=3, shared=False
    )
    steps = np.repeat(density, 2)
    panel.band(np.repeat(edges, 2)[1:-1], np.zeros(len(steps)), steps, look, label="measured NIS", alpha=0.45, way=True)
    panel.line(x, np.minimum(expected, ceiling), "truth", label="chi-square", size=1.3)


def nees(series: Mapping[str, Series], names: Sequence[str], dofs: Sequence[int], *, spans: Shades = None) -> Drawing:
    """NEES per degree of freedom, one panel for each of `names`, with the middle 99 % of chi-square for one epoch.

    Parameters
    ----------
    series : per solver, `value` (N, k) the NEES itself, not yet divided.
    dofs : k degrees of freedom.
    """
    scaled = {key: np.where(s.value > 0, s.value / np.array(dofs, float), np.nan) for key, s in series.items()}
    edges = [(chi2_quantile(0.005, dof) / dof, chi2_quantile(0.995, dof) / dof) for dof in dofs]
    # errors cross zero: how near to it they came is nothing to look at
    ylims = [
        limits([np.log10(np.maximum(v[:, k], 0.3 * edges[k][0])) for v in scaled.values()] + [np.log10(edges[k])])
        for k in range(len(names))
    ]
    drawing = Drawing.stack(
        [f"{name} NEES / {dof}" for name, dof in zip(names, dofs, strict=True)],
        time_limits(series.values()), ylims, log=True,
    )  # fmt: skip
    for k, panel in enumerate(drawing.panels):
        panel.shade(spans or {})
        across = np.array(panel.xlim)
        low, high = (np.full(2, e) for e in edges[k])
        panel.band(across, low, high, "ink", label="99 % of chi-square", alpha=0.15)
        panel.level(1.0)
        for key, s in series.items():
            panel.line(s.t, np.maximum(scaled[key][:, k], 10.0 ** panel.ylim[0]), key, label=key)
    return drawing


def timeline(
    records: Mapping[str, ConstraintRecord], start: float, end: float, solver: str = "", *, spans: Shades = None
) -> Drawing:
    """A row per constraint: when it was used, weakened and rejected; start and end on the records' clock, s."""
    count = max(len(records), 1)
    names = {float(count - 1 - k): name for k, name in enumerate(records)}
    drawing = Drawing.stack(
        [" "], (0.0, end - start), [(-0.6, count - 0.4)], height=20.0 * count, left=_NAMES, names=names
    )
    (panel,) = drawing.panels
    panel.shade(spans or {})
    for row, name in names.items():
        record = records[name]
        _epochs(panel, record.t - start, np.full(len(record.t), row), record.weight, solver or "batch")
    return drawing
