"""The way from above."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from graphnav.panels import LEFT, RIGHT, WIDTH, Drawing, Panel
from graphnav.panels.drawing import BOTTOM, SHADES, Spans, scale_bar
from graphnav.rotation import Array

_FEW = 60  # stops that get a large mark each


@dataclass(frozen=True)
class Fixes:
    """GNSS fixes: times (M,) in s from the start, east and north (M, 2) in m, and which were excluded (M,)."""

    t: Array
    en: Array
    excluded: np.ndarray


def trajectory(
    tracks: Mapping[str, tuple[Array, Array]],
    *,
    fixes: Fixes | None = None,
    truth: Array | None = None,
    spans: Mapping[str, Spans] | None = None,
    stops: Spans = (),
    standing: str = "stop",
) -> Drawing:
    """Where it went, to scale, north up.

    Parameters
    ----------
    tracks : per solver the times (N,) in s and east, north (N, 2) in m.
    truth : (L, 2) m
    spans : s, by what they are ("withheld", "no GNSS", "excluded"): underlaid on the first track.
    stops : s, marked where the first track was then; `standing` is what they are called.
    """
    parts = [np.zeros((0, 2)), *(en for _, en in tracks.values())]
    parts += [] if fixes is None else [fixes.en]
    parts += [] if truth is None else [truth]
    both = np.concatenate(parts)
    both = both[np.isfinite(both).all(axis=1)]
    lo, hi = (both.min(axis=0), both.max(axis=0)) if len(both) else (np.zeros(2), np.ones(2))
    w = WIDTH - LEFT - RIGHT
    size = np.maximum(hi - lo, 1e-3) * 1.1
    h = float(np.clip(w * size[1] / size[0], 0.5 * w, 0.95 * w))
    scale = max(size[0] / w, size[1] / h)  # m per point, the same on both axes
    mid = (lo + hi) / 2
    drawing = Drawing(h + BOTTOM + 19.0)
    panel = drawing.panel(
        (LEFT, BOTTOM, w, h),
        (mid[0] - scale * w / 2, mid[0] + scale * w / 2),
        (mid[1] - scale * h / 2, mid[1] + scale * h / 2),
        title="north [m]",
        xlabel="east [m]",
        unit="m",
        yticks=max(3, int(h / 45)),
        equal=True,
    )
    if fixes is not None and len(fixes.t):
        _fixes(panel, fixes)
    if truth is not None and len(truth):
        panel.line(truth[:, 0], truth[:, 1], "truth", label="truth", size=2.6, alpha=0.5, z=2, way=True)
    for number, (name, (t, en)) in enumerate(tracks.items()):
        if number == 0:
            _underlaid(panel, t, en, spans or {})
            _stops(panel, t, en, stops, standing)
        panel.line(en[:, 0], en[:, 1], name, label=name, size=1.4, way=True, hover=t)
    if tracks:
        _ends(panel, next(iter(tracks.values()))[1], scale)
    scale_bar(panel)
    return drawing


def _fixes(panel: Panel, fixes: Fixes) -> None:
    kept = np.flatnonzero(~fixes.excluded)
    kept = kept[:: max(1, len(kept) // 1500)]
    en = fixes.en[kept]
    panel.dots(en[:, 0], en[:, 1], "ink", label="GNSS fix", alpha=0.45, z=1.2, way=True, hover=fixes.t[kept])
    out = fixes.excluded
    if out.any():
        x, y = fixes.en[out].T
        panel.marks(x, y, "alert", "x", label="excluded fix", way=True, hover=fixes.t[out])


def _underlaid(panel: Panel, t: Array, en: Array, spans: Mapping[str, Spans]) -> None:
    for what, every in spans.items():
        pieces = [(t > a) & (t < b) for a, b in every]
        pieces = [piece for piece in pieces if piece.any()]
        if pieces:
            row = np.full((1, 2), np.nan)
            way = np.concatenate([part for piece in pieces for part in (en[piece], row)])
            panel.line(way[:, 0], way[:, 1], SHADES[what], label=what, size=6.0, alpha=0.5, z=1.5, way=True, quiet=True)


def _stops(panel: Panel, t: Array, en: Array, stops: Spans, standing: str) -> None:
    if not len(stops) or len(t) < 2:
        return
    begin, end = np.array(stops).T
    x, y = (np.interp(0.5 * (begin + end), t, en[:, k]) for k in (0, 1))
    size = 5.0 if len(stops) <= _FEW else 3.0
    panel.marks(x, y, "stop", "D", label=standing, size=size, z=4.2, way=True, hover=begin)


def _ends(panel: Panel, en: Array, scale: float) -> None:
    """Where the track starts and ends, the words on the side where the track is not."""
    few = max(1, len(en) // 30)
    together = bool(np.linalg.norm(en[-1] - en[0]) < 16.0 * scale)
    _, _, w, h = panel.box
    for row, inner, marker, words in ((0, few, "^", "start"), (-1, -1 - few, "s", "end")):
        panel.marks(en[[row], 0], en[[row], 1], "truth", marker, size=6.5, quiet=True)
        away = en[row] - en[min(inner, len(en) - 1) if inner > 0 else max(inner, -len(en))]
        x, y = (en[row] - (panel.xlim[0], panel.ylim[0])) / scale
        right = x < 0.1 * w or (away[0] >= 0 and x < 0.88 * w)
        down = y > 0.05 * h and away[1] < 0
        if together and row == 0:
            continue
        words = "start and end" if together else words
        align, dx = ("left", 6) if right else ("right", -6)
        panel.label(float(en[row, 0]), float(en[row, 1]), words, align=align, dx=dx, dy=-13 if down else 3)
