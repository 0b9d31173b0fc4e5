"""The drawing basics under `graphnav.plots`: colours, thinning, and panels on a matplotlib figure.

A `Panel` places lines straight on a `matplotlib.figure.Figure` with its own transform, frame, grid and
ticks. Axes objects are not used: an Axes costs 20 ms to make and draw, almost all of it tick objects, and
a report has fifty panels. Nothing here touches pyplot, and matplotlib is imported at the first figure.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from graphnav.rotation import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito, "Color Universal Design" (2008): told apart with every common colour vision. The second
# colour of each is for dark pages.
PALETTE = {
    "ekf": ("#d55e00", "#f08a3c"),
    "rts": ("#cc79a7", "#e3a3c6"),
    "incremental": ("#009e73", "#27c79a"),
    "batch": ("#0072b2", "#55aef0"),
    "truth": ("#4a4a4b", "#d8d8d9"),
    "other": ("#8a7a00", "#d9cc4a"),
    "alert": ("#b3261e", "#ff8a80"),
    "withheld": ("#e69f00", "#e6a41a"),
    "ink": ("#6a6a6b", "#a9a9aa"),
    "grid": ("#c9c9ca", "#444445"),
}
WIDTH = 390.0  # points; near a phone's width, so that nothing shrinks there
FONT = 9.5
BINS = 450  # columns a line is thinned to: a little more than a panel has points


def colour(name: str) -> str:
    """Colour of a solver (or of another drawn thing) for light pages, `#rrggbb`."""
    return PALETTE.get(name, PALETTE["other"])[0]


def thin(t: Array, y: Array, bins: int = BINS) -> np.ndarray:
    """Indices (sorted) of the rows worth drawing: per column of pixels the first, last, lowest and highest.

    A line through them covers the same pixels as the line through all rows (Jugel et al., "M4: A
    Visualization-Oriented Time Series Data Aggregation", VLDB 2014). Rows where y is not finite break
    a line, so the first of each such run stays too.

    Parameters
    ----------
    t : (N,) not decreasing.
    y : (N,)
    """
    n = len(t)
    if n <= 4 * bins:
        return np.arange(n)
    finite = np.isfinite(y)
    span = float(t[-1] - t[0])
    column = np.minimum((t - t[0]) * (bins / span if span > 0 else 0.0), bins - 1).astype(int)
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    order = np.lexsort((np.where(finite, y, np.nan), column))  # NaN sorts behind the numbers of its column
    highest = starts + np.maximum(np.add.reduceat(finite.astype(int), starts), 1) - 1
    breaks = np.flatnonzero(~finite & np.concatenate([[True], finite[:-1]]))
    ends = np.append(starts[1:], n) - 1
    return np.unique(np.concatenate([starts, ends, order[starts], order[highest], breaks]))


def with_breaks(t: Array, rows: np.ndarray, *columns: Array) -> Any:
    """t and columns at the kept rows, with a NaN row in every long gap of t, where a line must not lead across.

    Long is more than 20 median steps and more than one hundredth of the whole.
    """
    steps = np.diff(t)
    long = np.flatnonzero(steps > max(20.0 * np.median(steps), (t[-1] - t[0]) / 100.0)) if len(t) > 2 else steps[:0]
    if not len(long):
        return tuple(c[rows] for c in (t, *columns))
    rows = np.union1d(rows, np.concatenate([long, long + 1]).astype(int))
    at = np.searchsorted(rows, long) + 1
    return (np.insert(t[rows], at, t[long.astype(int)]), *(np.insert(c[rows], at, np.nan) for c in columns))


def ticks(lo: float, hi: float, count: int) -> tuple[Array, list[str]]:
    """Round values between lo and hi, about `count` of them, and their labels."""
    step = 10.0 ** math.floor(math.log10((hi - lo) / count))
    step *= next(m for m in (1, 2, 5, 10) if (hi - lo) / (step * m) <= count + 1e-9)
    values = np.arange(math.ceil(lo / step - 1e-9), math.floor(hi / step + 1e-9) + 1, dtype=float) * step
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    if digits > 4 or max(abs(lo), abs(hi)) >= 1e6:
        figures = math.ceil(math.log10(max(abs(lo), abs(hi)) / step)) + 1
        return values, [f"{v + 0.0:.{figures}g}" for v in values]
    return values, [f"{v + 0.0:.{digits}f}" for v in values]


def log_ticks(lo: float, hi: float) -> tuple[Array, list[str]]:
    """Ticks between the decimal logarithms lo and hi: decades, with 2 and 5 where there are few."""
    steps = (1, 2, 5) if hi - lo < 2 else (1,)
    every = max(1, math.ceil((hi - lo) / 6))
    decades = range(math.floor(lo), math.ceil(hi) + 1)
    pairs = [(math.log10(m) + d, m * 10.0**d) for d in decades if d % every == 0 for m in steps]
    inside = [(x, v) for x, v in pairs if lo - 1e-9 <= x <= hi + 1e-9]
    return np.array([x for x, _ in inside]), [f"{v:g}" for _, v in inside]


def limits(values: Sequence[Array], floor: float = 0.0, symmetric: bool = False) -> tuple[float, float]:
    """Lowest and highest of all finite values with a margin; at least `floor` wide."""
    flat = np.concatenate([np.ravel(v) for v in values]) if values else np.zeros(0)
    flat = flat[np.isfinite(flat)]
    lo, hi = (float(flat.min()), float(flat.max())) if len(flat) else (0.0, 1.0)
    if symmetric:
        hi = max(abs(lo), abs(hi))
        lo = -hi
    margin = max(0.06 * (hi - lo), (floor - (hi - lo)) / 2, 1e-9 * max(abs(lo), abs(hi), 1e-3))
    return lo - margin, hi + margin


def load() -> None:
    """Import what drawing needs, which takes half a second: once, before anything that is done side by side."""
    import matplotlib.backends.backend_svg
    import matplotlib.figure  # noqa: F401


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """An empty transparent figure, points."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / 72.0, height / 72.0), dpi=100)
    figure.patch.set_visible(False)
    return figure


class Panel:
    """A framed rectangle of a figure with data coordinates.

    Parameters
    ----------
    box : left, bottom, width, height in points from the figure's lower left corner.
    xlim, ylim : data limits (decimal logarithms on y where `log`).
    """

    def __init__(
        self,
        figure: Figure,
        box: tuple[float, float, float, float],
        xlim: tuple[float, float],
        ylim: tuple[float, float],
        *,
        xlabel: str = "",
        ylabel: str = "",
        title: str = "",
        xlabels: bool = True,
        log: bool = False,
        yticks: int = 4,
    ) -> None:
        from matplotlib.transforms import Bbox, BboxTransformFrom, BboxTransformTo, TransformedBbox

        self.figure, self.box, self.xlim, self.ylim, self.log = figure, box, xlim, ylim, log
        width, height = (72.0 * v for v in figure.get_size_inches())
        x, y, w, h = box
        self._page = BboxTransformFrom(Bbox.from_bounds(0, 0, width, height)) + figure.transFigure
        frame = Bbox.from_bounds(x / width, y / height, w / width, h / height)
        self.transform = (
            BboxTransformFrom(Bbox([[xlim[0], ylim[0]], [xlim[1], ylim[1]]]))
            + BboxTransformTo(frame)
            + figure.transFigure
        )
        self._clip = TransformedBbox(Bbox.from_bounds(x, y, w, h), self._page)
        xs, xnames = ticks(*xlim, max(3, int(w / 52)))
        ys, ynames = log_ticks(*ylim) if log else ticks(*ylim, yticks)
        px = x + (xs - xlim[0]) / (xlim[1] - xlim[0]) * w
        py = y + (ys - ylim[0]) / (ylim[1] - ylim[0]) * h
        gx = np.concatenate([np.stack([px, px, px + np.nan], -1).ravel(), np.tile([x, x + w, np.nan], len(py))])
        gy = np.concatenate([np.tile([y, y + h, np.nan], len(px)), np.stack([py, py, py + np.nan], -1).ravel()])
        self._rule(gx, gy, "grid", 0.6, z=0.5)
        self._rule([x, x + w, x + w, x, x], [y, y, y + h, y + h, y], "ink", 0.7, z=4)
        for at, name in zip(py, ynames, strict=True):
            self.text(x - 4, at, name, ha="right", va="center_baseline")
        if xlabels:
            for at, name in zip(px, xnames, strict=True):
                self.text(at, y - 4, name, ha="center", va="top")
        if xlabel:
            self.text(x + w / 2, y - 17, xlabel, ha="center", va="top")
        if ylabel:
            self.text(x - 38, y + h / 2, ylabel, ha="center", va="center", rotation=90)
        if title:
            self.text(x, y + h + 4, title, ha="left", va="bottom", weight="bold")

    def _rule(self, x: Any, y: Any, name: str, lw: float, z: float) -> None:
        from matplotlib.lines import Line2D

        line = Line2D(x, y, color=colour(name), lw=lw, zorder=z, transform=self._page, label="_frame")
        self.figure.add_artist(line, clip=False)

    def text(self, x: float, y: float, words: str, *, name: str = "ink", size: float = FONT, **kw: Any) -> None:
        """Words at a place of the page, points."""
        self.figure.text(x, y, words, transform=self._page, color=colour(name), fontsize=size, parse_math=False, **kw)

    def _add(self, artist: Any) -> Any:
        artist.set_transform(self.transform)
        self.figure.add_artist(artist, clip=False)
        artist.set_clip_box(self._clip)
        return artist

    def line(self, x: Array, y: Array, name: str, *, label: str = "", lw: float = 1.1, **kw: Any) -> Any:
        """A line through every row given (thin first), broken where y is not finite."""
        from matplotlib.lines import Line2D

        kw = {"solid_joinstyle": "round", "zorder": 3, **kw}
        y = np.log10(y) if self.log else y
        return self._add(Line2D(x, y, color=colour(name), lw=lw, label=label or "_", **kw))

    def dots(self, x: Array, y: Array, name: str, *, label: str = "", size: float = 1.7, **kw: Any) -> Any:
        """A round dot at every row given: the rows of `get_path().vertices[::2]`."""
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path

        # strokes of no length with round ends: one path, where markers would be one element each
        path = Path(np.repeat(np.stack([x, y], -1), 2, axis=0), np.tile([Path.MOVETO, Path.LINETO], len(x)))
        path.should_simplify = False
        kw = {"zorder": 2.5, "capstyle": "round", **kw}
        return self._add(PathPatch(path, fc="none", ec=colour(name), lw=size, label=label or "_", **kw))

    def marks(self, x: Array, y: Array, name: str, marker: str, *, label: str = "", size: float = 4.5) -> Any:
        """A marker of matplotlib's at every row given; for few."""
        from matplotlib.lines import Line2D

        kw: dict[str, Any] = {"markersize": size, "markeredgewidth": 1.2 if marker == "x" else 0.0, "zorder": 5}
        return self._add(Line2D(x, y, color=colour(name), ls="none", marker=marker, label=label or "_", **kw))

    def band(self, x: Array, lo: Array, hi: Array, name: str, *, label: str = "", alpha: float = 0.2) -> Any:
        """A tinted area between two lines."""
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path

        ok = np.isfinite(lo) & np.isfinite(hi)
        runs = np.split(np.arange(len(x)), np.flatnonzero(np.diff(ok)) + 1)
        outlines = []
        for run in (r for r in runs if len(r) and ok[r[0]]):
            there, back = x[run], x[run[::-1]]
            edges = np.clip(np.concatenate([hi[run], lo[run[::-1]]]), *self.ylim)
            outlines.append(np.stack([np.concatenate([there, back]), edges], -1))
        if not outlines:
            return None
        path = Path.make_compound_path(*(Path(np.vstack([o, o[:1]]), closed=True) for o in outlines))
        return self._add(PathPatch(path, fc=colour(name), ec="none", alpha=alpha, zorder=1.5, label=label or "_"))

    def shade(self, spans: Sequence[tuple[float, float]]) -> None:
        """Tint whole spans of x: what was withheld there."""
        for a, b in spans:
            a, b = max(a, self.xlim[0]), min(b, self.xlim[1])
            if b > a:
                y = np.array(self.ylim)
                self.band(np.array([a, b]), y[[0, 0]], y[[1, 1]], "withheld", label="_span", alpha=0.16)


def legend(figure: Figure, entries: Sequence[tuple[str, str, str]], y: float, left: float = 46.0) -> None:
    """A row of (words, colour name, "line" | "dots" | "band" | "cross") at the height y, points."""
    from matplotlib.lines import Line2D
    from matplotlib.transforms import Bbox, BboxTransformFrom

    width, height = (72.0 * v for v in figure.get_size_inches())
    page = BboxTransformFrom(Bbox.from_bounds(0, 0, width, height)) + figure.transFigure
    looks: dict[str, dict[str, Any]] = {
        "line": {"lw": 2.0},
        "band": {"lw": 7.0, "alpha": 0.3, "solid_capstyle": "butt"},
        "dots": {"ls": "none", "marker": "o", "markersize": 3.5, "markeredgewidth": 0.0},
        "cross": {"ls": "none", "marker": "x", "markersize": 5.0, "markeredgewidth": 1.2},
    }
    widths = [16 + 5.3 * len(words) + 9 for words, _, _ in entries]
    x = max(4.0, min(left, width - sum(widths)))
    for (words, name, kind), step in zip(entries, widths, strict=True):
        at = [x, x + 12] if "ls" not in looks[kind] else [x + 6]
        line = Line2D(at, [y + 3] * len(at), color=colour(name), transform=page, label="_legend", **looks[kind])
        figure.add_artist(line, clip=False)
        figure.text(x + 16, y, words, transform=page, color=colour("ink"), fontsize=FONT, parse_math=False)
        x += step


_DROP = re.compile(r"<metadata>.*?</metadata>|<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<g id=\"patch_1\">\s*</g>", re.S)
_NUMBER = re.compile(r"(?<=\.\d\d)\d+")  # replaced by nothing: a template would be expanded match by match
_PATH = re.compile(r' d="[^"]*"')
_GROUP_ID = re.compile(r'<g id="[^"]*"')
_HEX = re.compile(r"#[0-9a-f]{6}\b")
_VARIABLE = {light: f"var(--{name})" for name, (light, _) in PALETTE.items()}


def svg(figure: Figure, words: str, key: str = "figure") -> str:
    """The figure as an SVG element to put into an HTML page that has `css_colours`.

    Parameters
    ----------
    words : what the picture shows, for those who cannot see it.
    key : a name that no other figure of the page has.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    out = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": key, "path.simplify_threshold": 0.2}):
        FigureCanvasSVG(figure).print_svg(out, metadata={"Date": None})
    text = out.getvalue().replace(" \nL ", " ")
    text = _GROUP_ID.sub("<g", _DROP.sub("", text))
    text = _PATH.sub(lambda m: _NUMBER.sub("", m.group()), text)  # paths only: labels keep their digits
    text = _HEX.sub(lambda m: _VARIABLE.get(m.group(), m.group()), text)
    start = text.index("<svg")
    box = re.search(r'viewBox="[^"]*"', text)
    head = f'<svg {box.group() if box else ""} role="img" aria-label="{escape(words)}">'
    return head + re.sub(r"\n\s*", "\n", text[text.index(">", start) + 1 :]).strip()


def css_colours() -> str:
    """CSS variables of the palette, for light pages and, where preferred, dark ones."""
    light, dark = ("".join(f"--{name}:{pair[i]};" for name, pair in PALETTE.items()) for i in (0, 1))
    return f":root{{{light}}}\n@media (prefers-color-scheme: dark){{:root{{{dark}}}}}"
