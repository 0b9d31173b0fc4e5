"""A `Drawing` as an SVG element for a page that has `css_colours`: it follows the reader's light or dark colours.

Written straight, without matplotlib: importing that takes half a second, and a report draws twenty pictures.
"""

from __future__ import annotations

import base64
import struct
import zlib
from html import escape

import numpy as np

from graphnav.panels.colours import PALETTE
from graphnav.panels.drawing import Drawing, Item, Panel
from graphnav.panels.thinning import BINS
from graphnav.rotation import Array

_MARKS = {
    "x": "m-{0} -{0}l{1} {1}m0 -{1}l-{1} {1}",
    "s": "m-{0} -{0}h{1}v{1}h-{1}z",
    "^": "m0 -{0}l{0} {1}h-{1}z",
    "D": "m0 -{0}l{0} {0}l-{0} {0}l-{0} -{0}z",
}
# every 17th of the 256 colours of viridis (Smith and van der Walt 2015), which is nearly straight between them
_VIRIDIS = (
    "440154", "481a6c", "472f7d", "414487", "39568c", "31688e", "2a788e", "23888e",
    "1f988b", "22a884", "35b779", "54c568", "7ad151", "a5db36", "d2e21b", "fde725",
)  # fmt: skip


def svg(drawing: Drawing, words: str) -> str:
    """The drawing without its legend; `words` say what it shows to those who cannot see it."""
    head = f'<svg viewBox="0 0 {drawing.width:g} {drawing.height:g}" role="img" aria-label="{escape(words)}">'
    return head + "".join(_panel(panel, drawing.height) for panel in drawing.panels) + "</svg>"


def _panel(panel: Panel, height: float) -> str:
    x, y, w, h = panel.box
    top, bottom = height - y - h, height - y
    xs, xnames = panel.xticks
    ys, ynames = panel.yticks
    px, py = _across(panel, xs), _down(panel, ys)
    out = [f'<path d="{"".join(f"M{v:.1f} 0v{h:g}" for v in px)}{"".join(f"M0 {v:.1f}h{w:g}" for v in py)}"']
    out += [' stroke="var(--grid)" stroke-width=".7" fill="none"/>']
    out += [_item(item.thinned(BINS), panel) for item in sorted(panel.items, key=lambda item: item.z)]
    inner = f'<svg x="{x:g}" y="{top:g}" width="{w:g}" height="{h:g}">{"".join(out)}</svg>'
    rule = f'<path d="M{x:g} {bottom:g}h{w:g}" stroke="var(--ink)" stroke-width=".8"/>'
    text = [_text(x - 5, top + v, name, "end", ".34em") for v, name in zip(py, ynames, strict=True)]
    if panel.xlabels:
        text += [_text(x + v, bottom + 13, name, "middle") for v, name in zip(px, xnames, strict=True)]
    if panel.xlabel:
        text.append(_text(x + w / 2, bottom + 28, panel.xlabel, "middle"))
    if panel.title:
        text.append(_text(x, top - 6, panel.title))
    for label in panel.labels:
        at = float(_across(panel, np.array([label.x]))[0]), float(_down(panel, _log(panel, np.array([label.y])))[0])
        anchor = {"left": "start", "center": "middle", "right": "end"}[label.align]
        text.append(_text(x + at[0] + label.dx, top + at[1] - label.dy - 3, label.words, anchor, name=label.name))
    return inner + rule + "".join(text)


def _item(item: Item, panel: Panel) -> str:
    if item.kind == "map":
        return _map(item, panel)
    x, y = _across(panel, item.x), _down(panel, _log(panel, item.y))
    shade = _colour(item.name)
    faint = f' opacity="{item.alpha:g}"' if item.alpha < 1.0 else ""
    if item.kind == "band" and item.low is not None:
        low = _down(panel, _log(panel, item.low))
        # far outside nothing is to be seen, and some readers overflow
        y, low = (np.clip(v, -panel.box[3], 2.0 * panel.box[3]) for v in (y, low))
        runs = _runs(np.isfinite(y) & np.isfinite(low))
        outlines = [_way(np.r_[x[r], x[r][::-1]], np.r_[y[r], low[r][::-1]]) + "z" for r in runs]
        return f'<path d="{"".join(outlines)}" fill="{shade}"{faint}/>'
    if item.kind == "line":
        ok = np.isfinite(x) & np.isfinite(y)
        lines = "".join(_way(x[r], y[r]) for r in _runs(ok))
        dash = ' stroke-dasharray="4 3"' if item.dash else ""
        look = f'fill="none" stroke="{shade}" stroke-width="{item.size:g}" stroke-linejoin="round"{dash}{faint}'
        return f'<path d="{lines}" {look}/>'
    ok = np.isfinite(x) & np.isfinite(y)
    if item.kind == "dots" or item.marker == "o":
        # strokes of no length with round ends: one path, where circles would be one element each
        d = _formatted("M%.1f %.1fh0", x[ok], y[ok])
        return f'<path d="{d}" stroke="{shade}" stroke-width="{item.size:g}" stroke-linecap="round"{faint}/>'
    sign = _MARKS[item.marker].format(f"{item.size / 2:g}", f"{item.size:g}")
    look = f'fill="none" stroke="{shade}" stroke-width="1.2"' if item.marker == "x" else f'fill="{shade}"'
    return f'<path d="{_formatted(f"M%.1f %.1f{sign}", x[ok], y[ok])}" {look}{faint}/>'


def _map(item: Item, panel: Panel) -> str:
    assert item.values is not None
    low, high = float(np.min(item.values)), float(np.max(item.values))
    level = np.round(255.0 * (item.values - low) / max(high - low, 1e-12)).astype(np.uint8)
    left, right = _across(panel, item.x[[0, -1]])
    bottom, top = _down(panel, item.y[[0, -1]])
    data = base64.b64encode(_png(level[::-1])).decode("ascii")
    place = f'x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}"'
    return f'<image {place} preserveAspectRatio="none" href="data:image/png;base64,{data}"/>'


def _png(level: np.ndarray) -> bytes:
    """An image of (rows, columns) bytes in the colours of viridis (PNG specification, W3C 2003, clauses 5 and 11)."""
    anchors = np.array([list(bytes.fromhex(shade)) for shade in _VIRIDIS], dtype=float)
    at = np.linspace(0.0, len(anchors) - 1.0, 256)
    palette = np.column_stack([np.interp(at, np.arange(len(anchors)), anchors[:, k]) for k in range(3)])
    rows, columns = level.shape
    filtered = np.column_stack([np.zeros(rows, np.uint8), level]).tobytes()
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)),
        (b"PLTE", np.round(palette).astype(np.uint8).tobytes()),
        (b"IDAT", zlib.compress(filtered, 6)),
        (b"IEND", b""),
    )
    parts = [struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def _across(panel: Panel, x: Array) -> Array:
    lo, hi = panel.xlim
    return np.asarray((x - lo) * (panel.box[2] / (hi - lo)))


def _down(panel: Panel, y: Array) -> Array:
    """Points below the panel's upper edge of what stands on its axis (of logarithms where the axis is)."""
    lo, hi = panel.ylim
    return np.asarray((hi - y) * (panel.box[3] / (hi - lo)))


def _log(panel: Panel, y: Array) -> Array:
    return np.log10(y) if panel.log else y


def _runs(ok: np.ndarray) -> list[slice]:
    """Where True follows True."""
    edges = np.flatnonzero(np.diff(np.r_[False, ok, False].astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _way(x: Array, y: Array) -> str:
    return "M" + _formatted("%.1f %.1fL", x, y)[:-1]


def _formatted(form: str, x: Array, y: Array) -> str:
    return (form * len(x)) % tuple(np.column_stack([x, y]).ravel().tolist())


def _text(x: float, y: float, words: str, anchor: str = "start", dy: str = "", name: str = "") -> str:
    more = (f' dy="{dy}"' if dy else "") + (f' style="fill:{_colour(name)}"' if name else "")
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{more}>{escape(words)}</text>'


def _colour(name: str) -> str:
    return f"var(--{name if name in PALETTE else 'other'})"
