"""Figures of trajectories, errors, biases, residuals and detections: data in, `Figure` out, for plotly to draw.

Times are seconds from the recording's start, as on the command line.
"""

from graphnav.report.plots.colours import PALETTE, format_css, name_variable
from graphnav.report.plots.consistency import plot_nees, plot_residuals, plot_timeline
from graphnav.report.plots.detections import plot_detections
from graphnav.report.plots.figure import SHADES, TIME_NAME, Figure, Panel, Tinted, find_axis_limits
from graphnav.report.plots.paths import FIX_COLOURS, DrawnFixes, plot_profile, plot_trajectory
from graphnav.report.plots.series import Curve, Shades, plot_bands, plot_sigmas, plot_span_zoom
from graphnav.report.plots.thinning import BINS, choose_rows, insert_breaks, thin

__all__ = [
    "BINS",
    "FIX_COLOURS",
    "PALETTE",
    "SHADES",
    "TIME_NAME",
    "Curve",
    "DrawnFixes",
    "Figure",
    "Panel",
    "Shades",
    "Tinted",
    "choose_rows",
    "find_axis_limits",
    "format_css",
    "insert_breaks",
    "name_variable",
    "plot_bands",
    "plot_detections",
    "plot_nees",
    "plot_profile",
    "plot_residuals",
    "plot_sigmas",
    "plot_span_zoom",
    "plot_timeline",
    "plot_trajectory",
    "thin",
]  # fmt: skip
