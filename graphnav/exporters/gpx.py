"""GPX 1.1 (topografix.com/GPX/1/1): one track of every row, for maps, watches and route planners.

The schema's order of elements is kept: ``ele`` before ``time``. Heights are above the ellipsoid, where GPX readers
expect them above mean sea level: the difference, the geoid's height, needs a model that is not here, and the track's
description says so.
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from graphnav.exporters import require_geodetic
from graphnav.rotation import Array
from graphnav.trajectory import Trajectory

_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="graphnav" xmlns="http://www.topografix.com/GPX/1/1">
<trk><name>{name}</name><desc>{about}</desc><trkseg>
"""
_TAIL = "</trkseg></trk>\n</gpx>\n"


def write(trajectory: Trajectory, path: Path, utc: Array | None = None) -> None:
    """Write `trajectory` to `path`, with times where `utc` (K,), datetime64, is known."""
    require_geodetic(trajectory, path)
    about = "heights above the WGS-84 ellipsoid" + ("" if utc is not None else "; no times: the clock is not known")
    text = [_HEAD.format(name=escape(trajectory.name or "trajectory"), about=about)]
    degrees = np.rad2deg(trajectory.llh[:, :2])
    stamps = [""] * len(trajectory) if utc is None else np.datetime_as_string(utc, unit="ms").tolist()
    rows = zip(degrees.tolist(), trajectory.llh[:, 2].tolist(), stamps, strict=True)
    for (lat, lon), h, stamp in rows:
        time = f"<time>{stamp}Z</time>" if stamp else ""
        text.append(f'<trkpt lat="{lat:.10f}" lon="{lon:.10f}"><ele>{h:.4f}</ele>{time}</trkpt>\n')
    text.append(_TAIL)
    Path(path).write_text("".join(text), "utf-8")
