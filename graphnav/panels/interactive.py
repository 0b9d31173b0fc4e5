"""A `Drawing` as a plotly figure, and plotly's own script to put into a page.

Figures are plain JSON that refers to colours as `var(--name)`, as the page's style sheet does; `SCRIPT` puts in those
of the reader's light or dark page. Numbers go as little-endian 32-bit floats, which plotly reads as they are. The
library itself goes deflated: 2.0 MB instead of 4.8, unpacked by the browser.
"""

from __future__ import annotations

import base64
import importlib.util
import json
import zlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.panels.colours import PALETTE
from graphnav.panels.drawing import BOTTOM, RIGHT, TITLE, Drawing, Item, Panel
from graphnav.rotation import Array

_SYMBOLS = {"o": "circle", "x": "x-thin", "s": "square", "^": "triangle-up", "D": "diamond"}

# Draws what comes into sight in the place of its still picture, again when the colours change, and lets the legend's
# buttons hide things. Where anything fails the still pictures stay.
SCRIPT = """
(async () => {
const words = id => document.getElementById(id).textContent;
const packed = Uint8Array.from(atob(words("plotly-library")), c => c.charCodeAt(0));
const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
const library = document.createElement("script");
library.textContent = await new Response(unpacked).text();
document.head.append(library);
const touch = matchMedia("(pointer: coarse)").matches, dark = matchMedia("(prefers-color-scheme: dark)");
const config = {responsive: true, displaylogo: false, displayModeBar: touch ? true : "hover",
  modeBarButtons: [["zoom2d", "pan2d", "resetScale2d"]]};
const draw = place => {
  const style = getComputedStyle(document.documentElement);
  const figure = JSON.parse(place.parentNode.querySelector("[type='application/json']").textContent.replace(
    /var\\((--[\\w-]+)\\)/g, (_, name) => style.getPropertyValue(name).trim()));
  figure.layout.dragmode = touch ? false : "zoom";
  return Plotly.react(place, figure.data, figure.layout, config);
};
const seen = new IntersectionObserver(all => all.filter(one => one.isIntersecting).forEach(({target}) => {
  seen.unobserve(target);
  target.replaceChildren();
  draw(target);
}), {rootMargin: "200px"});
document.querySelectorAll(".plot").forEach(place => seen.observe(place));
dark.addEventListener("change", () => document.querySelectorAll(".js-plotly-plot").forEach(draw));
document.addEventListener("click", event => {
  const button = event.target.closest(".legend button"), place = button?.closest("figure").querySelector(".plot");
  if (!place?.data) return;
  const rows = [...place.data.keys()].filter(k => place.data[k].legendgroup === button.lastChild.data);
  if (rows.length) Plotly.restyle(place, {visible: !button.classList.toggle("off")}, rows);
});
})();
"""


@lru_cache(maxsize=1)
def library() -> str | None:
    """plotly.min.js, deflated, as base64; None where plotly is not installed."""
    found = importlib.util.find_spec("plotly")
    for folder in [] if found is None else found.submodule_search_locations or []:
        path = Path(folder) / "package_data" / "plotly.min.js"
        if path.is_file():
            return base64.b64encode(zlib.compress(path.read_bytes(), 5)).decode("ascii")
    return None


def text(drawing: Drawing) -> str:
    """The figure as JSON that can stand inside an HTML script element."""
    return json.dumps(figure(drawing), separators=(",", ":")).replace("</", "<\\/")


def figure(drawing: Drawing) -> dict[str, Any]:
    """`data` and `layout` as plotly takes them; the size is the container's."""
    left = min(panel.box[0] for panel in drawing.panels)
    top = 2.0 + (TITLE if any(panel.title for panel in drawing.panels) else 0.0)
    inner = drawing.width - left - RIGHT, drawing.height - BOTTOM - top
    layout: dict[str, Any] = {
        "autosize": True,
        "margin": {"l": left, "r": RIGHT, "t": top, "b": BOTTOM},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": 'system-ui, "Segoe UI", Roboto, sans-serif', "size": 11, "color": "var(--soft)"},
        "showlegend": False,
        "hovermode": "closest",
        "hoverlabel": {"bgcolor": "var(--card)", "bordercolor": "var(--edge)", "font": {"color": "var(--words)"}},
        "annotations": [],
    }
    shared = [k for k, panel in enumerate(drawing.panels) if panel.shared]
    if len(shared) > 1:
        layout |= {"hovermode": "x", "hoversubplots": "axis"}
    data: list[dict[str, Any]] = []
    for k, panel in enumerate(drawing.panels):
        x, y = _axis("x", shared[0] if panel.shared else k), _axis("y", k)
        box = panel.box
        across = [(box[0] - left) / inner[0], min((box[0] - left + box[2]) / inner[0], 1.0)]
        up = [max((box[1] - BOTTOM) / inner[1], 0.0), min((box[1] - BOTTOM + box[3]) / inner[1], 1.0)]
        # an axis that several panels share belongs to the lowest of them
        layout[f"xaxis{x[1:]}"] = {
            **_look(panel.xlim), "domain": across, "anchor": y, "nticks": 6,
            "title": {"text": panel.xlabel, "standoff": 6}, "hoverformat": ".2f", "showline": True,
        }  # fmt: skip
        layout[f"yaxis{y[1:]}"] = {**_look(panel.ylim), "domain": up, "anchor": x, "nticks": 5, **_special(panel, x)}
        for item in sorted(panel.items, key=lambda i: i.z):
            data.append(_trace(item, panel, x, y))
        if panel.title:
            layout["annotations"].append({
                "text": panel.title, "xref": "paper", "yref": "paper", "x": across[0], "y": up[1], "xanchor": "left",
                "yanchor": "bottom", "showarrow": False,
            })  # fmt: skip
        layout["annotations"] += [
            {
                "text": label.words, "xref": x, "yref": y, "x": label.x,
                "y": label.y, "xanchor": label.align, "yanchor": "bottom", "xshift": label.dx, "yshift": label.dy,
                "showarrow": False, "font": {"color": _colour(label.name)},
            }
            for label in panel.labels
        ]  # fmt: skip
    return {"data": data, "layout": layout}


def _axis(letter: str, k: int) -> str:
    return letter if k == 0 else f"{letter}{k + 1}"


def _look(limits: tuple[float, float]) -> dict[str, Any]:
    return {
        "range": list(limits), "zeroline": False, "gridcolor": "var(--grid)", "linecolor": "var(--ink)",
        "exponentformat": "none",
    }  # fmt: skip


def _special(panel: Panel, x: str) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if panel.log:
        values, words = panel.yticks
        out |= {"type": "log", "tickmode": "array", "tickvals": [10.0**v for v in values], "ticktext": list(words)}
    if panel.names is not None:
        out |= {"tickmode": "array", "tickvals": list(panel.names), "ticktext": list(panel.names.values())}
    if panel.equal:
        out |= {"scaleanchor": x, "scaleratio": 1}
    return out


def _trace(item: Item, panel: Panel, x: str, y: str) -> dict[str, Any]:
    shade = _colour(item.name)
    out: dict[str, Any] = {"xaxis": x, "yaxis": y, "legendgroup": item.label, "name": item.label}
    if item.kind == "map":
        assert item.values is not None
        low, high = float(np.min(item.values)), float(np.max(item.values))
        z = np.round(255.0 * (item.values - low) / max(high - low, 1e-12)).astype(np.uint8)
        packed = {
            "dtype": "u1",
            "bdata": base64.b64encode(z.tobytes()).decode(),
            "shape": f"{z.shape[0]}, {z.shape[1]}",
        }
        return out | {
            "type": "heatmap", "x": _numbers(item.x), "y": _numbers(item.y), "z": packed, "colorscale": "Viridis",
            "showscale": False, "hovertemplate": f"%{{y:.2f}} {panel.unit}<extra></extra>",
        }  # fmt: skip
    out |= {"type": "scatter", "opacity": item.alpha, "zorder": round(10 * item.z)}
    if item.kind == "band" and item.low is not None:
        outline = _outline(item.x, item.low, item.y)
        return out | {
            "x": _numbers(outline[0]), "y": _numbers(outline[1]), "mode": "lines", "line": {"width": 0},
            "fill": "toself", "fillcolor": _tint(item.name, item.alpha), "opacity": 1.0, "hoverinfo": "skip",
        }  # fmt: skip
    out |= {"x": _numbers(item.x), "y": _numbers(item.y)}
    if item.kind == "line":
        width = round(1.25 * item.size, 2)
        out |= {"mode": "lines", "line": {"color": shade, "width": width, "dash": "dash" if item.dash else "solid"}}
    else:
        size = {"dots": 2.0 * item.size, "marks": 1.6 * item.size}[item.kind]
        marker = {"color": shade, "size": round(size, 2), "symbol": _SYMBOLS[item.marker]}
        if item.marker == "x":
            marker["line"] = {"color": shade, "width": 2}
        out |= {"mode": "markers", "marker": marker}
    if item.quiet:
        return out | {"hoverinfo": "skip"}
    place = f"%{{y:.4~g}} {panel.unit}".rstrip()
    if item.way:
        place = "%{x:.2f}, %{y:.2f}" + f" {panel.unit}".rstrip()
    if item.hover is not None:
        out["customdata"] = _numbers(item.hover)
        place += "<br>at %{customdata:.2f} s"
    return out | {"hovertemplate": f"{place}<extra>{item.label}</extra>"}


def _outline(x: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Closed outlines of a band, one for each run without a break, with NaN between."""
    ok = np.isfinite(low) & np.isfinite(high)
    runs = np.split(np.arange(len(x)), np.flatnonzero(np.diff(ok)) + 1)
    parts = []
    for run in (r for r in runs if len(r) and ok[r[0]]):
        there = np.concatenate([x[run], x[run[::-1]]])
        parts.append(np.stack([there, np.concatenate([high[run], low[run[::-1]]])]))
        parts.append(np.full((2, 1), np.nan))
    both = np.concatenate(parts[:-1], axis=1) if parts else np.zeros((2, 0))
    return both[0], both[1]


def _numbers(values: Array) -> dict[str, str]:
    return {"dtype": "f4", "bdata": base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode("ascii")}


def _colour(name: str) -> str:
    return f"var(--{name if name in PALETTE else 'other'})"


def _tint(name: str, alpha: float) -> str:
    return f"{_colour(name)}{round(255 * alpha):02x}"
