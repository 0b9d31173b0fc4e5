"""KML: the path as a line on the ground, its start and its end, for Google Earth and the like."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from graphnav.earth import LocalFrame
from graphnav.exporters import require_geodetic
from graphnav.exporters.csv import rows_text
from graphnav.rotation import Array
from graphnav.trajectory import Trajectory

_MAX_POINTS = 20000
_SPACING = 0.05  # m, at least

# The line is clamped to the ground: KML heights are above mean sea level and ours above the ellipsoid.
_DOCUMENT = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document>
<name>{name}</name>
<Style id="path"><LineStyle><color>ff0055ff</color><width>3</width></LineStyle></Style>
<Placemark><name>{name}</name><styleUrl>#path</styleUrl>
<LineString><tessellate>1</tessellate><altitudeMode>clampToGround</altitudeMode>
<coordinates>
{line}</coordinates></LineString></Placemark>
{ends}
</Document>
</kml>
"""
_PLACEMARK = (
    "<Placemark><name>{name}</name><description>t = {t:.3f} s, height {h:.2f} m above the ellipsoid</description>"
    "<Point><coordinates>{lon:.9f},{lat:.9f},{h:.3f}</coordinates></Point></Placemark>"
)


def write(trajectory: Trajectory, path: Path) -> None:
    """Write `trajectory` to `path`, thinned by distance so that stops cost nothing and turns keep their shape."""
    require_geodetic(trajectory, path)
    degrees = trajectory.llh * np.array([np.rad2deg(1.0), np.rad2deg(1.0), 1.0])
    kept = degrees[thinned(trajectory.llh)]
    ends = "\n".join(
        _PLACEMARK.format(name=name, t=trajectory.t[k], lat=degrees[k, 0], lon=degrees[k, 1], h=degrees[k, 2])
        for name, k in (("start", 0), ("end", -1))
    )
    line = rows_text(kept[:, [1, 0, 2]], "%.9f,%.9f,%.3f")
    name = escape(trajectory.name or "trajectory")
    Path(path).write_text(_DOCUMENT.format(name=name, line=line, ends=ends), "utf-8")


def thinned(llh: Array) -> Array:
    """Indices of points a near-even distance apart along the path (K, 3), the first and the last among them."""
    p = LocalFrame(llh[0]).from_llh(llh)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    spacing = max(along[-1] / _MAX_POINTS, _SPACING)
    _, first = np.unique(np.floor(along / spacing), return_index=True)
    return np.unique(np.append(first, len(llh) - 1))
