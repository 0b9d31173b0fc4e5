"""A drawing as data: panels in points, and in each what is to be seen in it, every row of it.

Thinning, colours of the page and everything else that depends on the medium is left to `still` and `interactive`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from graphnav.panels.thinning import chosen_rows, thin, with_breaks
from graphnav.panels.ticks import log_ticks, ticks
from graphnav.rotation import Array

WIDTH = 370.0  # points; a phone's width, so that words are as large there as they are meant to be
LEFT, RIGHT, BOTTOM, TITLE = 50.0, 8.0, 36.0, 17.0  # margins, and the room above a panel for its title
SHADES = {"withheld": "withheld", "no GNSS": "outage", "excluded": "alert", "stands": "stop"}  # span -> colour

Spans = Sequence[tuple[float, float]]
Box = tuple[float, float, float, float]
FINE = 700  # columns everything is thinned to at once: what zooming in can still show
Kind = Literal["line", "dots", "marks", "band", "map"]


@dataclass(frozen=True)
class Item:
    """Something drawn. A band lies between `low` and `y`, the colours of a map are `values` at x and y."""

    kind: Kind
    x: Array  # (N,)
    y: Array  # (N,)
    name: str = "ink"  # of the colour
    label: str = ""  # for the legend; none if empty
    low: Array | None = None  # (N,)
    values: Array | None = None  # (len(y), len(x))
    hover: Array | None = None  # (N,) s, what is said of a row of a way besides its place
    size: float = 1.1  # width of a line, diameter of a dot, points
    alpha: float = 1.0
    dash: bool = False
    marker: str = "o"
    z: float = 3.0
    way: bool = False  # x is not time: extremes of both coordinates are kept
    quiet: bool = False  # nothing to hover over

    def thinned(self, bins: int, breaks: bool = False) -> Item:
        """With the rows that a panel `bins` columns wide can show; `breaks`: and a NaN row where no line may lead."""
        if self.kind == "map" or (self.kind == "band" and self.way):
            return self
        if self.kind == "band" and self.low is not None:
            rows = thin(self.x, self.y - self.low, bins // 2)
            columns = self.x, self.low, self.y
            x, low, y = with_breaks(self.x, rows, *columns[1:]) if breaks else (c[rows] for c in columns)
            return replace(self, x=x, y=y, low=low)
        rows = chosen_rows(self.x, self.y, bins) if self.way else thin(self.x, self.y, bins)
        if breaks and self.kind == "line" and not self.way:
            x, y = with_breaks(self.x, rows, self.y)
            return replace(self, x=x, y=y)
        return replace(self, x=self.x[rows], y=self.y[rows], hover=None if self.hover is None else self.hover[rows])


@dataclass(frozen=True)
class Label:
    """Words beside a place of a panel, moved by (dx, dy) points."""

    x: float
    y: float
    words: str
    name: str = "truth"
    align: Literal["left", "center", "right"] = "left"
    dx: float = 0.0
    dy: float = 0.0


class Panel:
    """A framed rectangle with data coordinates.

    Parameters
    ----------
    box : left, bottom, width, height in points from the drawing's lower left corner.
    xlim, ylim : data limits (decimal logarithms on y where `log`).
    unit : of y, for hovering.
    shared : its x is the x of all such panels of the drawing.
    """

    def __init__(
        self,
        box: Box,
        xlim: tuple[float, float],
        ylim: tuple[float, float],
        *,
        xlabel: str = "",
        title: str = "",
        unit: str = "",
        xlabels: bool = True,
        log: bool = False,
        yticks: int = 4,
        names: Mapping[float, str] | None = None,
        equal: bool = False,
        shared: bool = True,
    ) -> None:
        self.box, self.xlim, self.ylim, self.xlabel, self.title, self.unit = box, xlim, ylim, xlabel, title, unit
        self.xlabels, self.log, self.names, self.equal, self.shared = xlabels, log, names, equal, shared
        self.xticks = ticks(*xlim, max(3, int(box[2] / 58)))
        self.yticks = log_ticks(*ylim) if log else ticks(*ylim, yticks)
        if names is not None:
            self.yticks = np.array(list(names), dtype=float), list(names.values())
        self.items: list[Item] = []
        self.labels: list[Label] = []

    def _add(self, item: Item) -> None:
        self.items.append(item.thinned(FINE, breaks=True))

    def line(self, x: Array, y: Array, name: str, **kw: Any) -> None:
        """A line, broken where y is not finite or x leaps."""
        self._add(Item("line", x, y, name, **kw))

    def dots(self, x: Array, y: Array, name: str, **kw: Any) -> None:
        """A round dot at every row."""
        self._add(Item("dots", x, y, name, **{"size": 2.0, "z": 2.5, **kw}))

    def marks(self, x: Array, y: Array, name: str, marker: str, **kw: Any) -> None:
        """A marker (o, x, s, ^, D) at every row; for few."""
        self._add(Item("marks", x, y, name, marker=marker, **{"size": 5.0, "z": 5.0, **kw}))

    def band(self, x: Array, low: Array, high: Array, name: str, **kw: Any) -> None:
        """A tinted area between two lines."""
        self._add(Item("band", x, high, name, low=low, **{"alpha": 0.2, "z": 1.5, **kw}))

    def map(self, x: Array, y: Array, values: Array) -> None:
        """Colours from dark to light for `values` (len(y), len(x)) at evenly spaced x and y."""
        self._add(Item("map", x, y, values=values, z=1.0))

    def level(self, y: float, name: str = "ink", **kw: Any) -> None:
        """A dashed line across at y."""
        self.line(np.array(self.xlim), np.full(2, y), name, **{"dash": True, "size": 0.9, "quiet": True, **kw})

    def label(self, x: float, y: float, words: str, **kw: Any) -> None:
        """Words beside a place."""
        self.labels.append(Label(x, y, words, **kw))

    def shade(self, spans: Mapping[str, Spans]) -> None:
        """Tint whole spans of x, by what they are (a key of `SHADES`)."""
        low, high = (10.0**v if self.log else v for v in self.ylim)
        for what, every in spans.items():
            cut = np.array([(max(a, self.xlim[0]), min(b, self.xlim[1])) for a, b in every]).reshape(-1, 2)
            cut = cut[cut[:, 1] > cut[:, 0]]
            if len(cut):
                x = np.column_stack([cut, cut[:, 1]]).ravel()
                edge = np.tile([1.0, 1.0, np.nan], len(cut))
                self.band(x, low * edge, high * edge, SHADES[what], label=what, alpha=0.17, z=1.0, way=True)


class Drawing:
    """Panels on a page of `width` x `height` points."""

    def __init__(self, height: float, width: float = WIDTH) -> None:
        self.width, self.height = width, height
        self.panels: list[Panel] = []

    def panel(self, *args: Any, **kw: Any) -> Panel:
        """A new `Panel`; arguments as there."""
        self.panels.append(Panel(*args, **kw))
        return self.panels[-1]

    @classmethod
    def stack(
        cls,
        titles: Sequence[str],
        xlim: tuple[float, float],
        ylims: Sequence[tuple[float, float]],
        *,
        height: float = 84.0,
        width: float = WIDTH,
        left: float = LEFT,
        below: float = 0.0,
        xlabel: str = "time from the start [s]",
        units: Sequence[str] = (),
        log: bool | Sequence[bool] = False,
        **kw: Any,
    ) -> Drawing:
        """Panels over one x axis, the first on top; `below` points stay free under the last."""
        count, pitch = len(titles), height + (TITLE if any(titles) else 4.0) + 6.0
        drawing = cls(below + count * pitch - 6.0 + BOTTOM + 2.0, width)
        for k, (title, ylim) in enumerate(zip(titles, ylims, strict=True)):
            box = (left, below + BOTTOM + (count - 1 - k) * pitch, width - left - RIGHT, height)
            last = k == count - 1
            drawing.panel(
                box, xlim, ylim, title=title, unit=units[k] if units else "", xlabel=xlabel if last else "",
                xlabels=last, log=log if isinstance(log, bool) else log[k], **kw,
            )  # fmt: skip
        return drawing

    @property
    def legend(self) -> list[tuple[str, str, str]]:
        """(words, colour, kind) of everything labelled, each once, tinted areas last; a mark is its own kind."""
        items = [item for panel in self.panels for item in panel.items if item.label]
        items.sort(key=lambda item: (item.label in SHADES) + (item.kind == "band"))
        every: dict[str, tuple[str, str, str]] = {}
        for item in items:
            every.setdefault(item.label, (item.label, item.name, item.marker if item.kind == "marks" else item.kind))
        return list(every.values())

    def savefig(self, path: str | Path, **kw: Any) -> None:
        """Write it with its legend, in the format of the file's name; further arguments as matplotlib's."""
        from graphnav.panels import still

        still.figure(self).savefig(path, **kw)


def scale_bar(panel: Panel) -> None:
    """A bar of a round number of metres, about a fifth of the width, in the lower right of a map."""
    scale = (panel.xlim[1] - panel.xlim[0]) / panel.box[2]  # m per point
    metres = 10.0 ** math.floor(math.log10(scale * panel.box[2] / 5))
    metres *= max(m for m in (1, 2, 5) if m * metres <= scale * panel.box[2] / 4)
    x, y = panel.xlim[1] - 10 * scale, panel.ylim[0] + 9 * scale
    panel.line(np.array([x - metres, x]), np.array([y, y]), "truth", size=2.5, z=4, quiet=True, way=True)
    words = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
    panel.label(x - metres / 2, y, words, align="center", dy=4)
