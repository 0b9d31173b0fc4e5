"""GPX 1.1 (topografix.com/GPX/1/1): one track of all rows, for maps, watches and route planners.

The schema's order of elements is kept: ``ele`` before ``time``. Heights are above the ellipsoid, where GPX readers
expect them above mean sea level: the difference, the geoid's height, needs a model that graphnav does not have, and the
track's description says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from pathlib import Path

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.recording.exporters import Add, require_geodetic
from graphnav.recording.exporters.digits import encode_rows

_GPX_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="graphnav" xmlns="http://www.topografix.com/GPX/1/1">
<trk><name>{name}</name><desc>{about}</desc><trkseg>
"""
_TAIL = "</trkseg></trk>\n</gpx>\n"
_POINT = '<trkpt lat="%.10f" lon="%.10f"><ele>%.4f</ele></trkpt>'
_STAMPED = _POINT.replace("</trkpt>", "<time>%sZ</time></trkpt>")


@contextmanager
def open_writer(path: Path, name: str = "") -> Iterator[Add]:
    """A GPX file, with times where UTC is known."""
    started = False
    with path.open("wb") as file:

        def add(block: Trajectory, utc: Array | None = None) -> None:
            nonlocal started
            require_geodetic(block, path)
            if not started:
                times = "" if utc is not None else "; no times: the clock is not known"
                about = f"heights above the WGS-84 ellipsoid{times}"
                head = _GPX_HEAD.format(name=escape(name or "trajectory", quote=False), about=about)
                file.write(head.encode())
                started = True
            degrees = np.rad2deg(block.llh[:, :2])
            table = np.column_stack([degrees, block.llh[:, 2]])
            stamps = None if utc is None else np.datetime_as_string(utc, unit="ms").astype("S")
            file.write(encode_rows(table, _POINT if utc is None else _STAMPED, stamps))

        yield add
        file.write(_TAIL.encode())
