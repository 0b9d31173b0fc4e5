"""Drawings of trajectories, errors, biases, residuals and detections: data in, `graphnav.panels.Drawing` out.

Times are seconds from the recording's start, as on the command line. `drawing.savefig("way.png")` writes any format.
"""

from graphnav.plots.consistency import chi2_quantile, nees, residuals, timeline
from graphnav.plots.detections import detections
from graphnav.plots.series import Series, bands, sigmas, span_zoom
from graphnav.plots.way import Fixes, trajectory

__all__ = [
    "Fixes", "Series", "bands", "chi2_quantile", "detections", "nees", "residuals", "sigmas", "span_zoom", "timeline",
    "trajectory",
]  # fmt: skip
