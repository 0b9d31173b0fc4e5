"""Figures of trajectories, errors, biases, residuals and detections: data in, `Figure` out, for plotly to draw.

Times are seconds from the recording's start, as on the command line.
"""

from graphnav.report.plots.colours import PALETTE, css_colours, variable
from graphnav.report.plots.consistency import nees, residuals, timeline
from graphnav.report.plots.detections import detections
from graphnav.report.plots.figure import SHADES, TIME, Figure, Panel, Spans, limits
from graphnav.report.plots.paths import FIX_COLOURS, DrawnFixes, profile, trajectory
from graphnav.report.plots.series import Curve, Shades, bands, sigmas, span_zoom
from graphnav.report.plots.thinning import BINS, choose_rows, thin, with_breaks

__all__ = [
    "BINS",
    "FIX_COLOURS",
    "PALETTE",
    "SHADES",
    "TIME",
    "Curve",
    "DrawnFixes",
    "Figure",
    "Panel",
    "Shades",
    "Spans",
    "bands",
    "choose_rows",
    "css_colours",
    "detections",
    "limits",
    "nees",
    "profile",
    "residuals",
    "sigmas",
    "span_zoom",
    "thin",
    "timeline",
    "trajectory",
    "variable",
    "with_breaks",
]  # fmt: skip
