"""The track from above and from the side, with the fixes by quality."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array
from graphnav.report.plots.figure import SHADES, Figure, Panel, Tinted, find_axis_limits, find_colour

_MARKED_STOPS = 60  # stops that are marked individually
_LABEL_WIDTH = 120.0  # pixels on a wide screen of a label on a phone
_WIDE, _HIGH = 1080.0, 560  # pixels of the map on a wide screen; narrower pages show more of the north


@dataclass(frozen=True)
class DrawnFixes:
    """GNSS fixes: times (M,) in s from the start, east, north, up (M, 3) in m, and which were excluded (M,).

    `kinds` are the rows (M,) bool of each kind of fix, by name: a type, or a stated accuracy.
    """

    t: Array
    enu: Array
    excluded: np.ndarray
    kinds: Mapping[str, np.ndarray]


# kind of a fix -> colour; further kinds take the next colours
FIX_COLOURS = {
    "fixed": "fixed", "float": "float", "ppp": "ppp", "differential": "differential", "sbas": "sbas",
    "single": "single", "unknown": "ink", "GNSS fix": "ink",
    "sigma below 0.1 m": "fixed", "sigma 0.1 to 1 m": "float", "sigma 1 m and more": "single",
}  # fmt: skip


def plot_trajectory(
    tracks: Mapping[str, tuple[Array, Array]],
    *,
    fixes: DrawnFixes | None = None,
    truth: Array | None = None,
    spans: Mapping[str, Tinted] | None = None,
    stops: Tinted = (),
    standing: str = "stop",
) -> Figure:
    """The track, to scale, north up.

    Parameters
    ----------
    tracks : per solver the times (N,) in s and east, north (N, 2) in m.
    truth : (L, 2) m
    spans : s, by what they are ("withheld", "no GNSS", "excluded"): underlaid on the first track.
    stops : s, marked where the first track was then; `standing` is what they are called.
    """
    parts = [np.zeros((0, 2)), *(en for _, en in tracks.values())]
    parts += [] if fixes is None else [fixes.enu[:, :2]]
    parts += [] if truth is None else [truth]
    both = np.concatenate(parts)
    both = both[np.isfinite(both).all(axis=1)]
    (west, east), (south, north) = (
        find_axis_limits([both[:, k]], floor=1.0, always=[en[:, k] for _, en in tracks.values()]) for k in (0, 1)
    )
    south -= 0.06 * (north - south)  # for the scale bar
    scale = max((east - west) / _WIDE, (north - south) / _HIGH)  # m per pixel, the same on both axes
    figure = Figure(["north [m]"], (west, east), [(south, north)], units=["m"], height=_HIGH, x="east [m]", equal=True)
    (panel,) = figure.panels
    if fixes is not None:
        draw_fixes(panel, fixes)
    if truth is not None and len(truth):
        panel.draw_path(truth, "truth", "truth", width=3.5, alpha=0.5)
    for number, (name, (t, en)) in enumerate(tracks.items()):
        if number == 0:
            _draw_spans(panel, t, en, spans or {})
        panel.draw_path(en, name, name, t)
        if number == 0:
            _draw_stops(panel, t, en, stops, standing)
    if tracks:
        _mark_ends(panel, next(iter(tracks.values()))[1], scale)
    _scale_bar(figure, panel)
    return figure


def plot_profile(lines: Mapping[str, tuple[Array, Array]], points: Mapping[str, tuple[Array, Array]]) -> Figure:
    """Heights (m) over the distance travelled (m): `lines` of solvers and truth, `points` of fixes by kind."""
    reach = max((float(x[-1]) for x, _ in lines.values() if len(x)), default=1.0)
    kilo, unit = (1e-3, "km") if reach >= 2000.0 else (1.0, "m")
    values = [y for _, y in (*lines.values(), *points.values())]
    ylim = find_axis_limits(values, floor=1.0, always=[y for name, (_, y) in lines.items() if name != "truth"])
    x = f"distance travelled [{unit}]"
    figure = Figure(["height [m]"], (0.0, kilo * max(reach, 1e-3)), [ylim], units=["m"], height=150, x=x)
    (panel,) = figure.panels
    for kind, (x_, y) in points.items():
        panel.draw_dots(kilo * x_, y, FIX_COLOURS.get(kind, "ink"), kind, 3.0, alpha=0.6)
    for name, (x_, y) in lines.items():
        panel.draw_path(np.column_stack([kilo * x_, y]), name, name)
    return figure


def draw_fixes(panel: Panel, fixes: DrawnFixes, k: int | None = None) -> None:
    """Each kind in its colour, excluded fixes as crosses: on a map, or component k over time."""
    x, y = (fixes.enu[:, 0], fixes.enu[:, 1]) if k is None else (fixes.t, fixes.enu[:, k])
    for kind, of_it in fixes.kinds.items():
        rows = of_it & ~fixes.excluded & np.isfinite(y)
        if rows.any():
            name = FIX_COLOURS.get(kind, "ink")
            size = 5.0 if k is None else 3.0
            panel.draw_dots(x[rows], y[rows], name, kind, size, alpha=0.6, t=fixes.t[rows], path=k is None)
    out = fixes.excluded & np.isfinite(y)
    if out.any():
        panel.draw_dots(x[out], y[out], "alert", "excluded fix", 7.0, "x", t=fixes.t[out], path=k is None)


def _draw_spans(panel: Panel, t: Array, en: Array, spans: Mapping[str, Tinted]) -> None:
    for what, every in spans.items():
        pieces = [(t > a) & (t < b) for a, b in every]
        gap = np.full((1, 2), np.nan)
        path = [part for piece in pieces if piece.any() for part in (en[piece], gap)]
        if path:
            panel.draw_path(np.concatenate(path), SHADES[what], what, width=8.0, alpha=0.5)


def _draw_stops(panel: Panel, t: Array, en: Array, stops: Tinted, standing: str) -> None:
    if not len(stops) or len(t) < 2:
        return
    begin, end = np.array(stops).T
    x, y = (np.interp(0.5 * (begin + end), t, en[:, k]) for k in (0, 1))
    panel.draw_dots(x, y, "stop", standing, 8.0 if len(stops) <= _MARKED_STOPS else 5.0, "D", t=begin, path=True)


def _mark_ends(panel: Panel, en: Array, scale: float) -> None:
    """Mark the start and end of the track, with labels on the side away from the track but inside the map."""
    west, east = panel.xlim
    edge = 0.12 * (east - west)  # room for labels on a phone
    together = bool(np.linalg.norm(en[-1] - en[0]) < 16.0 * scale)
    near = bool(np.linalg.norm(en[-1] - en[0]) < _LABEL_WIDTH * scale)
    lower = -int(en[-1, 1] < en[0, 1])  # the row whose label goes below, so that one does not cover the other
    few = max(1, len(en) // 30)
    for row, inner, marker, words in ((0, few, "^", "start"), (-1, max(-1 - few, -len(en)), "s", "end")):
        panel.draw_dots(en[[row], 0], en[[row], 1], "truth", "", 10.0, marker)
        x = en[row, 0]
        left = bool(x > east - edge or (x < en[min(inner, len(en) - 1), 0] and x > west + edge))
        if not (together and row == 0):
            words = "start and end" if together else words
            down = -18 if near and not together and row == lower else 0
            panel.write_words(
                float(x), float(en[row, 1]), words, "right" if left else "left", (-8 if left else 8, down)
            )


def _scale_bar(figure: Figure, panel: Panel) -> None:
    """A scale bar of a round number of metres at the lower edge of a map: about a fifth of its width.

    Both axes have the same scale, so a track that is tall and narrow lies in a map much wider than itself.
    """
    (west, east), (south, north) = panel.xlim, panel.ylim
    reach = max(east - west, 0.5 * (north - south))
    metres = 10.0 ** math.floor(math.log10(reach / 5))
    metres *= max(m for m in (1, 2, 5) if m * metres <= reach / 4)
    x = east - 0.01 * (east - west)
    figure.shapes.append({
        "type": "line", "xref": "x", "yref": "paper", "x0": x - metres, "x1": x, "y0": 0.02, "y1": 0.02,
        "line": {"color": find_colour("truth"), "width": 3.5},
    })  # fmt: skip
    words = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
    panel.write_words(x - metres / 2, 0.02, words, "center", (0, 2))
    figure.annotations[-1]["yref"] = "paper"
