"""A `Drawing` as a matplotlib figure, to write in any format, and as an SVG element of a page.

Lines are placed straight on a `matplotlib.figure.Figure`, as what a drawing says is in points already. Nothing here
touches pyplot, and matplotlib is imported at the first figure.
"""

from __future__ import annotations

import io
import re
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from graphnav.panels.colours import PALETTE, colour
from graphnav.panels.drawing import LEFT, Drawing, Item, Panel
from graphnav.panels.thinning import BINS
from graphnav.rotation import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FONT = 10.0
_LEGEND_ROW = 15.0
_NAMES = {pair[0]: name for name, pair in PALETTE.items()}  # of light pages' colours, each its own


def svg(drawing: Drawing, words: str) -> str:
    """The drawing without its legend, as an element of a page that has `css_colours`.

    It follows the reader's light or dark colours and the page's font; `words` say what it shows to those who
    cannot see it.
    """
    import matplotlib

    out = io.StringIO()
    # the page has many drawings, and the names in each must be its own
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": words}):
        figure(drawing, legend=False).savefig(out, format="svg", transparent=True)
    body = out.getvalue()
    body = body[body.index("</defs>") + len("</defs>") :]  # the head has a date, and a style for the whole page
    body = re.sub(r' style="[^"]*"', lambda m: re.sub(r"#[0-9a-f]{6}", lambda c: f"var(--{_NAMES[c[0]]})", m[0]), body)
    body = re.sub(r' d="[^"]*"', lambda m: re.sub(r"(?<=\.\d\d)\d+", "", m[0].replace(" \n", "")), body)
    body = re.sub(r'font-family: [^;]*; | transform="rotate\(-0 [^"]*"| id="[a-z0-9]+_\d+"|\n *', "", body)
    head = f'viewBox="0 0 {drawing.width:g} {drawing.height:g}" role="img" aria-label="{escape(words)}"'
    return f'<svg {head} stroke-linejoin="round">{body}'


def figure(drawing: Drawing, legend: bool = True) -> Figure:
    """The drawing on a matplotlib figure, its legend on top."""
    from matplotlib.figure import Figure

    rows = _legend_rows(drawing) if legend else []
    height = drawing.height + _LEGEND_ROW * len(rows)
    out = Figure(figsize=(drawing.width / 72.0, height / 72.0), dpi=100)
    for panel in drawing.panels:
        _Canvas(out, panel).draw()
    for k, row in enumerate(rows):
        _legend(out, row, height - _LEGEND_ROW * (k + 1) + 3)
    return out


class _Canvas:
    """One panel on a figure."""

    def __init__(self, figure: Figure, panel: Panel) -> None:
        from matplotlib.transforms import Bbox, BboxTransformFrom, BboxTransformTo, TransformedBbox

        self.figure, self.panel = figure, panel
        width, height = (72.0 * v for v in figure.get_size_inches())
        x, y, w, h = panel.box
        self.page = BboxTransformFrom(Bbox.from_bounds(0, 0, width, height)) + figure.transFigure
        frame = Bbox.from_bounds(x / width, y / height, w / width, h / height)
        (x0, x1), (y0, y1) = panel.xlim, panel.ylim
        self.data = BboxTransformFrom(Bbox([[x0, y0], [x1, y1]])) + BboxTransformTo(frame) + figure.transFigure
        self.clip = TransformedBbox(Bbox.from_bounds(x, y, w, h), self.page)

    def draw(self) -> None:
        panel, (x, y, w, h) = self.panel, self.panel.box
        xs, xnames = panel.xticks
        ys, ynames = panel.yticks
        px, py = self._place(xs, 0), self._place(ys, 1)
        gx = np.concatenate([np.stack([px, px, px + np.nan], -1).ravel(), np.tile([x, x + w, np.nan], len(py))])
        gy = np.concatenate([np.tile([y, y + h, np.nan], len(px)), np.stack([py, py, py + np.nan], -1).ravel()])
        self._rule(gx, gy, "grid", 0.6, z=0.5)
        self._rule([x, x + w], [y, y], "ink", 0.8, z=4)
        for at, name in zip(py, ynames, strict=True):
            self.text(x - 5, at, name, ha="right", va="center_baseline")
        if panel.xlabels:
            for at, name in zip(px, xnames, strict=True):
                self.text(at, y - 5, name, ha="center", va="top")
        if panel.xlabel:
            self.text(x + w / 2, y - 19, panel.xlabel, ha="center", va="top")
        if panel.title:
            self.text(x, y + h + 5, panel.title, ha="left", va="bottom")
        for item in panel.items:
            self._item(item.thinned(BINS))
        for label in panel.labels:
            at = float(self._place(np.array([label.x]), 0)[0]), float(self._place(np.array([label.y]), 1)[0])
            self.text(at[0] + label.dx, at[1] + label.dy, label.words, name=label.name, ha=label.align)

    def _place(self, values: Array, axis: int) -> Array:
        """Points on the page of values on the x or y axis (of logarithms where the axis is)."""
        lo, hi = (self.panel.xlim, self.panel.ylim)[axis]
        return np.asarray(self.panel.box[axis] + (values - lo) / (hi - lo) * self.panel.box[2 + axis])

    def _item(self, item: Item) -> None:
        from matplotlib.lines import Line2D

        y = np.log10(item.y) if self.panel.log else item.y
        shown: dict[str, Any] = {"color": colour(item.name), "label": item.label or "_", "alpha": item.alpha}
        if item.kind == "band" and item.low is not None:
            low = np.log10(item.low) if self.panel.log else item.low
            self._area(item.x, low, y, item.name, item.label or "_", item.alpha, item.z)
        elif item.kind == "map":
            self._map(item)
        elif item.kind == "dots":
            self._dots(item, y)
        elif item.kind == "marks":
            edge = 1.2 if item.marker == "x" else 0.0
            look: dict[str, Any] = {"marker": item.marker, "markersize": item.size, "markeredgewidth": edge}
            self._add(Line2D(item.x, y, ls="none", zorder=item.z, **look, **shown))
        else:
            style: Any = (0, (4, 3)) if item.dash else "-"
            self._add(Line2D(item.x, y, lw=item.size, ls=style, zorder=item.z, solid_joinstyle="round", **shown))

    def _dots(self, item: Item, y: Array) -> None:
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path

        # strokes of no length with round ends: one path, where markers would be one element each
        codes = np.tile([Path.MOVETO, Path.LINETO], len(item.x))
        path = Path(np.repeat(np.stack([item.x, y], -1), 2, axis=0), codes)
        path.should_simplify = False
        kw: dict[str, Any] = {"lw": item.size, "alpha": item.alpha, "zorder": item.z, "capstyle": "round"}
        self._add(PathPatch(path, fc="none", ec=colour(item.name), label=item.label or "_", **kw))

    def _area(self, x: Array, low: Array, high: Array, name: str, label: str, alpha: float, z: float) -> None:
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path

        ok = np.isfinite(low) & np.isfinite(high)
        runs = np.split(np.arange(len(x)), np.flatnonzero(np.diff(ok)) + 1)
        outlines = []
        for run in (r for r in runs if len(r) and ok[r[0]]):
            there, back = x[run], x[run[::-1]]
            edges = np.clip(np.concatenate([high[run], low[run[::-1]]]), *self.panel.ylim)
            outlines.append(np.stack([np.concatenate([there, back]), edges], -1))
        if outlines:
            path = Path.make_compound_path(*(Path(np.vstack([o, o[:1]]), closed=True) for o in outlines))
            self._add(PathPatch(path, fc=colour(name), ec="none", alpha=alpha, zorder=z, label=label))

    def _map(self, item: Item) -> None:
        from matplotlib.image import BboxImage
        from matplotlib.transforms import Bbox, TransformedBbox

        assert item.values is not None
        box = Bbox([[item.x[0], item.y[0]], [item.x[-1], item.y[-1]]])
        image = BboxImage(
            TransformedBbox(box, self.data), cmap="viridis", origin="lower", interpolation="nearest", zorder=item.z
        )
        image.set_data(item.values)
        self.figure.add_artist(image, clip=False)

    def _rule(self, x: Any, y: Any, name: str, lw: float, z: float) -> None:
        from matplotlib.lines import Line2D

        line = Line2D(x, y, color=colour(name), lw=lw, zorder=z, transform=self.page, label="_frame")
        self.figure.add_artist(line, clip=False)

    def text(self, x: float, y: float, words: str, *, name: str = "ink", **kw: Any) -> None:
        """Words at a place of the page, points."""
        self.figure.text(x, y, words, transform=self.page, color=colour(name), fontsize=FONT, parse_math=False, **kw)

    def _add(self, artist: Any) -> None:
        artist.set_transform(self.data)
        self.figure.add_artist(artist, clip=False)
        artist.set_clip_box(self.clip)


def _legend_rows(drawing: Drawing) -> list[list[tuple[str, str, str]]]:
    """The legend's entries in rows that fit the width."""
    rows: list[list[tuple[str, str, str]]] = []
    used = drawing.width
    for entry in drawing.legend:
        wide = _entry_width(entry[0])
        if used + wide > drawing.width - 8.0:
            rows.append([])
            used = LEFT
        rows[-1].append(entry)
        used += wide
    return rows


def _entry_width(words: str) -> float:
    return 16 + 0.56 * FONT * len(words) + 9


def _legend(figure: Figure, entries: list[tuple[str, str, str]], y: float) -> None:
    """A row of legend at the height y, points."""
    from matplotlib.lines import Line2D
    from matplotlib.transforms import Bbox, BboxTransformFrom

    width, height = (72.0 * v for v in figure.get_size_inches())
    page = BboxTransformFrom(Bbox.from_bounds(0, 0, width, height)) + figure.transFigure
    looks: dict[str, dict[str, Any]] = {
        "line": {"lw": 2.0},
        "band": {"lw": 7.0, "alpha": 0.3, "solid_capstyle": "butt"},
        "dots": {"ls": "none", "marker": "o", "markersize": 3.5, "markeredgewidth": 0.0},
    }
    x = LEFT
    for words, name, kind in entries:
        edge = 1.2 if kind == "x" else 0.0
        look = looks.get(kind, {"ls": "none", "marker": kind, "markersize": 5.0, "markeredgewidth": edge})
        at = [x + 6] if "ls" in look else [x, x + 12]
        line = Line2D(at, [y + 3] * len(at), color=colour(name), transform=page, label="_legend", **look)
        figure.add_artist(line, clip=False)
        figure.text(x + 16, y, words, transform=page, color=colour("ink"), fontsize=FONT, parse_math=False)
        x += _entry_width(words)
