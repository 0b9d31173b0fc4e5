"""GPX 1.1 (topografix.com/GPX/1/1): one track of every row, for maps, watches and route planners.

The schema's order of elements is kept: ``ele`` before ``time``. Heights are above the ellipsoid, where GPX readers
expect them above mean sea level: the difference, the geoid's height, needs a model that is not here, and the track's
description says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.recording.exporters import Add, require_geodetic

_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="graphnav" xmlns="http://www.topografix.com/GPX/1/1">
<trk><name>{name}</name><desc>{about}</desc><trkseg>
"""
_TAIL = "</trkseg></trk>\n</gpx>\n"


@contextmanager
def writing(path: Path, name: str = "") -> Iterator[Add]:
    """A file, with times where UTC is known."""
    begun = False
    with path.open("w", encoding="utf-8") as file:

        def add(block: Trajectory, utc: Array | None = None) -> None:
            nonlocal begun
            require_geodetic(block, path)
            if not begun:
                times = "" if utc is not None else "; no times: the clock is not known"
                about = f"heights above the WGS-84 ellipsoid{times}"
                file.write(_HEAD.format(name=escape(name or "trajectory"), about=about))
                begun = True
            degrees = np.rad2deg(block.llh[:, :2])
            stamps = [""] * len(block) if utc is None else np.datetime_as_string(utc, unit="ms").tolist()
            for (lat, lon), h, stamp in zip(degrees.tolist(), block.llh[:, 2].tolist(), stamps, strict=True):
                time = f"<time>{stamp}Z</time>" if stamp else ""
                file.write(f'<trkpt lat="{lat:.10f}" lon="{lon:.10f}"><ele>{h:.4f}</ele>{time}</trkpt>\n')

        yield add
        file.write(_TAIL)
