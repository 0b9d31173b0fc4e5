"""KML: the path as a line on the ground, its start and its end, for Google Earth and similar programs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from pathlib import Path

import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.recording.exporters import Add, require_geodetic
from graphnav.recording.exporters.digits import format_rows

_MAX_POINTS = 20000
_LEAST_SPACING = 0.05  # m, smallest distance between points
_SPARE_POINTS = 16  # ratio of the points kept to those wanted, until the length of the path is known

# The line is clamped to the ground: KML heights are above mean sea level, ours above the ellipsoid.
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


@contextmanager
def open_writer(path: Path, name: str = "") -> Iterator[Add]:
    """A KML file; its path is thinned by distance, so that stops need no points and turns keep their shape."""
    path_so_far = _Thinned()
    with path.open("w", encoding="utf-8") as file:

        def add(block: Trajectory, utc: Array | None = None) -> None:
            require_geodetic(block, path)
            path_so_far.add(block)

        yield add
        kept = path_so_far.list_rows()
        degrees = kept[:, 1:4] * np.array([np.rad2deg(1.0), np.rad2deg(1.0), 1.0])
        ends = "\n".join(
            _PLACEMARK.format(name=name, t=kept[k, 0], lat=degrees[k, 0], lon=degrees[k, 1], h=degrees[k, 2])
            for name, k in (("start", 0), ("end", -1))
        )
        line = format_rows(degrees[:, [1, 0, 2]], "%.9f,%.9f,%.3f")
        file.write(_DOCUMENT.format(name=escape(name or "trajectory", quote=False), line=line, ends=ends))


class _Thinned:
    """Points at nearly equal distances along a path that arrives in parts, including the first and the last.

    More points are kept than are wanted in the end, as their distance is known only then.
    """

    def __init__(self) -> None:
        self._frame: LocalFrame | None = None
        self._kept: list[Array] = []  # parts (n, 5): t, llh, distance so far
        self._last = np.empty((0, 3))  # frame of the path, in metres
        self._end = np.empty(5)

    def add(self, block: Trajectory) -> None:
        """Add a part."""
        self._frame = self._frame or LocalFrame(block.llh[0])
        p = self._frame.from_llh(block.llh)
        steps = np.linalg.norm(np.diff(np.concatenate([self._last if len(self._last) else p[:1], p]), axis=0), axis=1)
        begin = self._end[4] if len(self._last) else 0.0
        along = begin + np.cumsum(steps)
        new = np.column_stack([block.t, block.llh, along])
        self._last, self._end = p[-1:], new[-1]
        self._kept.append(new)
        if sum(map(len, self._kept)) > _SPARE_POINTS * _MAX_POINTS:
            spacing = along[-1] / (_SPARE_POINTS / 2 * _MAX_POINTS)
            self._kept = [self._mask_steps(np.concatenate(self._kept), spacing)]

    def list_rows(self) -> Array:
        """Times (s), llh (rad, m) and distance (m) of the points, (N, 5)."""
        kept = self._mask_steps(np.concatenate(self._kept), max(self._end[4] / _MAX_POINTS, _LEAST_SPACING))
        return kept if kept[-1, 0] == self._end[0] else np.concatenate([kept, self._end[None]])

    @staticmethod
    def _mask_steps(rows: Array, spacing: float) -> Array:
        _, first = np.unique(np.floor(rows[:, 4] / spacing), return_index=True)
        return np.asarray(rows[first])
