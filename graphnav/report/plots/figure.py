"""Figures in plotly's form: panels over one x axis.

Plain JSON that refers to colours as `var(--name)`, as the page's style sheet does; `page.js` inserts those of the
reader's light or dark page, and draws. Numbers are passed as little-endian 32-bit floats, which plotly reads directly.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from graphnav.core.rotation import Array
from graphnav.report.plots.colours import name_variable
from graphnav.report.plots.thinning import BINS, choose_rows, insert_breaks, thin

SHADES = {"withheld": "withheld", "no GNSS": "outage", "excluded": "alert", "stationary": "stop"}  # span -> colour
TIME_NAME = "time from the start [s]"
Tinted = Sequence[tuple[float, float]]
_PANEL, _GAP, _ABOVE, _BELOW, _LEFT, _RIGHT = 104, 30, 20, 42, 58, 10  # pixels
_SYMBOLS = {"o": "circle", "x": "x-thin", "s": "square", "^": "triangle-up", "D": "diamond"}


class Panel:
    """One y axis of a figure."""

    def __init__(self, figure: Figure, k: int, unit: str, xlim: tuple[float, float], ylim: tuple[float, float]) -> None:
        self.figure, self.unit, self.xlim, self.ylim = figure, unit, xlim, ylim
        self.axes = {"xaxis": figure.find_x(k), "yaxis": _make_axis("y", k)}

    def _add(self, label: str, trace: dict[str, Any], quiet: bool = False, at: str = "", path: bool = False) -> None:
        hover = {"hoverinfo": "skip"}
        if not quiet:
            place = ("%{x:.2f}, %{y:.2f} " if path else "%{y:.4~g} ") + self.unit
            hover = {"hovertemplate": f"{place.strip()}{at}<extra>{label}</extra>"}
        first = bool(label) and label not in self.figure.labels
        self.figure.labels.add(label)
        self.figure.data.append(
            {"type": "scatter", **self.axes, "name": label, "legendgroup": label, "showlegend": first, **hover, **trace}
        )

    def draw_line(
        self, x: Array, y: Array, name: str, label: str = "", width: float = 1.4, alpha: float = 1.0,
        dash: bool = False, quiet: bool = False,
    ) -> None:  # fmt: skip
        """A line over ascending x, interrupted where y is not finite or x has a gap."""
        x, y = insert_breaks(x, thin(x, y), y)
        look = {"color": find_colour(name), "width": width, "dash": "dash" if dash else "solid"}
        self._add(
            label,
            {"mode": "lines", "x": encode_numbers(x), "y": encode_numbers(y), "line": look, "opacity": alpha},
            quiet,
        )

    def level(self, y: float, **kw: Any) -> None:
        """A horizontal line at y."""
        self.draw_line(np.array(self.xlim), np.full(2, y), "ink", quiet=True, **{"width": 1.0, **kw})

    def draw_path(
        self, xy: Array, name: str, label: str, t: Array | None = None, width: float = 1.8, alpha: float = 1.0
    ) -> None:
        """A line through places (N, 2), reached at t."""
        rows = choose_rows(*xy.T)
        at: dict[str, Any] = {} if t is None else {"customdata": encode_numbers(t[rows])}
        look = {"color": find_colour(name), "width": width}
        places = {"x": encode_numbers(xy[rows, 0]), "y": encode_numbers(xy[rows, 1])}
        words = "<br>at %{customdata:.2f} s" if at else ""
        self._add(label, {"mode": "lines", "line": look, "opacity": alpha, **places, **at}, t is None, words, path=True)

    def draw_dots(
        self, x: Array, y: Array, name: str, label: str = "", size: float = 4.0, marker: str = "o",
        alpha: float = 1.0, t: Array | None = None, path: bool = False,
    ) -> None:  # fmt: skip
        """A marker (o, x, s, ^, D) at every row."""
        rows = choose_rows(x, y) if path else thin(x, y)
        look = {"color": find_colour(name), "size": size, "symbol": _SYMBOLS[marker], "opacity": alpha}
        if marker == "x":
            look["line"] = {"color": find_colour(name), "width": 2}
        at: dict[str, Any] = {} if t is None else {"customdata": encode_numbers(t[rows])}
        words = "<br>at %{customdata:.2f} s" if at else ""
        places = {"x": encode_numbers(x[rows]), "y": encode_numbers(y[rows])}
        self._add(label, {"mode": "markers", "marker": look, **places, **at}, at=words, path=path)

    def draw_band(self, x: Array, low: Array, high: Array, name: str, label: str = "", alpha: float = 0.18) -> None:
        """A tinted area between two lines, interrupted where x has a gap."""
        x, low, high = insert_breaks(x, thin(x, high - low, BINS // 2), low, high)
        parts = []
        for run in np.ma.clump_unmasked(np.ma.masked_invalid(low + high)):
            outline = np.concatenate([high[run], low[run][::-1]])
            parts += [[np.concatenate([x[run], x[run][::-1]]), outline], np.full((2, 1), np.nan)]
        if parts:
            both = np.concatenate([np.asarray(p) for p in parts[:-1]], axis=1)
            tint = f"{find_colour(name)}{round(255 * alpha):02x}"
            look = {"mode": "lines", "line": {"width": 0, "color": tint}, "fill": "toself", "fillcolor": tint}
            self._add(label, {"x": encode_numbers(both[0]), "y": encode_numbers(both[1]), **look}, quiet=True)

    def shade(self, spans: Mapping[str, Tinted]) -> None:
        """Tint whole spans of x, by kind (a key of `SHADES`)."""
        for what, every in spans.items():
            cut = [(max(a, self.xlim[0]), min(b, self.xlim[1])) for a, b in every]
            self.figure.shapes += [
                {"type": "rect", "xref": self.axes["xaxis"], "yref": f"{self.axes['yaxis']} domain", "x0": a, "x1": b,
                 "y0": 0, "y1": 1, "fillcolor": f"{find_colour(SHADES[what])}2b", "line": {"width": 0},
                 "layer": "below"}
                for a, b in cut if b > a
            ]  # fmt: skip
            if any(b > a for a, b in cut) and what not in self.figure.labels:
                look = {"symbol": "square", "size": 11, "color": find_colour(SHADES[what]), "opacity": 0.4}
                self._add(what, {"mode": "markers", "marker": look, "x": [None], "y": [None]}, quiet=True)

    def draw_map(self, x: Array, y: Array, values: Array) -> None:
        """Colours from dark to light for `values` (len(y), len(x)) at evenly spaced x and y."""
        low, high = float(np.min(values)), float(np.max(values))
        z = np.round(255.0 * (values - low) / max(high - low, 1e-12)).astype(np.uint8)
        packed = {
            "dtype": "u1",
            "bdata": base64.b64encode(z.tobytes()).decode(),
            "shape": f"{z.shape[0]}, {z.shape[1]}",
        }
        look = {
            "type": "heatmap",
            "colorscale": "Viridis",
            "showscale": False,
            "x": encode_numbers(x),
            "y": encode_numbers(y),
        }
        self._add("", {**look, "z": packed})

    def write_words(
        self, x: float, y: float, text: str, align: str = "left", shift: tuple[float, float] = (6, 0),
        name: str = "truth",
    ) -> None:  # fmt: skip
        """Text beside a place, shifted by pixels."""
        self.figure.annotations.append({
            "text": text, "xref": self.axes["xaxis"], "yref": self.axes["yaxis"], "x": x, "y": y, "xanchor": align,
            "yanchor": "bottom", "xshift": shift[0], "yshift": shift[1], "showarrow": False,
            "font": {"color": find_colour(name)},
        })  # fmt: skip


class Figure:
    """Panels one over the other, the first on top.

    Parameters
    ----------
    titles, ylims : of the panels; limits are decimal logarithms where `log`, and those of x where `x_log`.
    xlim : of all of them, or a list with that of each where they stand `apart`.
    height : of a panel, pixels.
    x : title of the x axis; a figure over `TIME_NAME` is zoomed together with all such figures of a page.
    names : instead of numbers on the y axis.
    """

    def __init__(
        self, titles: Sequence[str], xlim: Any, ylims: Sequence[tuple[float, float]], *, units: Sequence[str] = (),
        log: Sequence[bool] | bool = False, height: int = _PANEL, x: str = TIME_NAME, apart: bool = False,
        names: Mapping[float, str] | None = None, equal: bool = False, columns: int = 1, x_log: bool = False,
    ) -> None:  # fmt: skip
        count = len(titles)
        rows = -(-count // columns)
        self.apart, self.time = apart, x == TIME_NAME and not apart
        gap = _GAP + 16 * apart  # room for numbers under every panel
        inner = rows * height + (rows - 1) * gap
        self.height = _ABOVE + _BELOW + inner
        self.data: list[dict[str, Any]] = []
        self.labels: set[str] = set()
        self.shapes: list[dict[str, Any]] = []
        self.annotations: list[dict[str, Any]] = []
        self.axes: dict[str, Any] = {}
        self.panels = []
        lims = xlim if isinstance(xlim, list) else [xlim] * count
        for k, (title, ylim) in enumerate(zip(titles, ylims, strict=True)):
            row, column = divmod(k, columns)
            top = 1.0 - row * (height + gap) / inner
            across = [(column + 0.1 * (column > 0)) / columns, (column + 1 - 0.1 * (column < columns - 1)) / columns]
            panel = Panel(self, k, units[k] if units else "", lims[k], ylim)
            xname, yname = panel.axes["xaxis"], panel.axes["yaxis"]
            lowest = k + columns >= count
            # an axis shared by several panels belongs to the lowest of them
            self.axes[f"xaxis{xname[1:]}"] = {
                **_STYLE, "range": list(lims[k]), "domain": across, "anchor": yname, "nticks": 6 if columns == 1 else 4,
                "hoverformat": ".2f", "showline": True, **({"title": {"text": x, "standoff": 6}} if lowest else {}),
                **({"type": "log"} if x_log else {}),
            }  # fmt: skip
            logarithmic = log if isinstance(log, bool) else log[k]
            look = {**_STYLE, "range": list(ylim), "domain": [max(top - height / inner, 0.0), top], "anchor": xname}
            if logarithmic:
                look |= {"type": "log", "minorloglabels": "complete", "nticks": 3}
            if names is not None:
                look |= {"tickmode": "array", "tickvals": list(names), "ticktext": list(names.values()), "ticks": ""}
                look["automargin"] = True
            if equal:
                look |= {"scaleanchor": xname, "scaleratio": 1}
            self.axes[f"yaxis{yname[1:]}"] = {"nticks": 5, **look}
            if title.strip():
                self.annotations.append({
                    "text": title, "xref": "paper", "yref": "paper", "x": across[0], "y": top, "xanchor": "left",
                    "yanchor": "bottom", "showarrow": False,
                })  # fmt: skip
            self.panels.append(panel)

    def find_x(self, k: int) -> str:
        """The x axis of panel k: that of the first, unless panels stand apart."""
        return _make_axis("x", k if self.apart else 0)

    @property
    def json(self) -> dict[str, Any]:
        """`data` and `layout` for plotly; the width is the container's."""
        layout = {
            "autosize": True, "margin": {"l": _LEFT, "r": _RIGHT, "t": _ABOVE, "b": _BELOW},
            "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)",
            "font": {"family": 'system-ui, "Segoe UI", Roboto, sans-serif', "size": 11, "color": "var(--soft)"},
            "showlegend": False,  # the page has one, outside the figure
            "hovermode": "x" if self.time else "closest",
            "hoverlabel": {"bgcolor": "var(--card)", "bordercolor": "var(--edge)", "font": {"color": "var(--words)"}},
            "annotations": self.annotations, "shapes": self.shapes, **self.axes,
        }  # fmt: skip
        if self.time and len(self.panels) > 1:
            layout["hoversubplots"] = "axis"
        return {"data": self.data, "layout": layout}


_STYLE = {"zeroline": False, "gridcolor": "var(--grid)", "linecolor": "var(--ink)", "exponentformat": "none"}


def find_axis_limits(
    values: Sequence[Array], floor: float = 0.0, symmetric: bool = False, always: Sequence[Array] = ()
) -> tuple[float, float]:
    """Limits of an axis that single outliers do not set, at least `floor` wide.

    They include the middle 99 % of the values plus half as much again on either side, which are 5.2 sigma of a
    Gaussian, and all of `always`; values further out are seen by zooming out.
    """
    flat = np.concatenate([np.ravel(v) for v in values]) if values else np.zeros(0)
    flat = flat[np.isfinite(flat)]
    lo, hi = (float(flat.min()), float(flat.max())) if len(flat) else (0.0, 1.0)
    if len(flat) > 200:  # for fewer values, 1 % is less than two
        a, b = np.quantile(flat, [0.005, 0.995])
        if b > a:
            kept = [v[np.isfinite(v)] for v in always]
            lo = max(lo, min([a - 0.5 * (b - a), *(float(v.min()) for v in kept if len(v))]))
            hi = min(hi, max([b + 0.5 * (b - a), *(float(v.max()) for v in kept if len(v))]))
    if symmetric:
        hi = max(abs(lo), abs(hi))
        lo = -hi
    margin = max(0.06 * (hi - lo), (floor - (hi - lo)) / 2, 1e-9 * max(abs(lo), abs(hi), 1e-3))
    return lo - margin, hi + margin


def encode_numbers(values: Array) -> dict[str, str]:
    """A typed array in plotly's form."""
    return {"dtype": "f4", "bdata": base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode("ascii")}


def find_colour(name: str) -> str:
    """A colour of the page, by the name of a solver or another drawn object."""
    return f"var({name_variable(name)})"


def _make_axis(letter: str, k: int) -> str:
    return letter if k == 0 else f"{letter}{k + 1}"
