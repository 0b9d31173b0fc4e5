"""The HTML around figures and tables: one self-contained page, light or dark as the reader prefers.

Every function takes plain values and escapes them; only what `graphnav.panels` makes of drawings goes in as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from graphnav.panels import PALETTE, Drawing, css_colours, interactive, svg

_CSS = """
:root{color-scheme:light dark;--page:#ffffff;--card:#f6f7f9;--words:#1b1d20;--soft:#5b6068;--edge:#dfe2e6}
@media (prefers-color-scheme:dark){:root{--page:#141619;--card:#1d2024;--words:#e7e9ec;--soft:#a5abb4;--edge:#33383f}}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%;scroll-padding-top:3rem}
body{margin:0;background:var(--page);color:var(--words);font:16px/1.5 system-ui,"Segoe UI",Roboto,sans-serif}
main{max-width:1180px;margin:0 auto;padding:20px 16px 64px}
h1{font-size:1.6rem;line-height:1.2;margin:.2em 0 .4em;overflow-wrap:anywhere}
h2{font-size:1.25rem;margin:2.4em 0 .6em;padding-top:.8em;border-top:1px solid var(--edge)}
h3{font-size:1rem;margin:1.6em 0 .4em}
p{margin:.5em 0;max-width:75ch}
ul{margin:.4em 0;padding-left:1.3em;max-width:75ch}
li{margin:.25em 0;overflow-wrap:anywhere}
a{color:var(--batch)}
.soft,.note{color:var(--soft);font-size:.875rem}
nav{position:sticky;top:0;z-index:20;display:flex;gap:.2em 1.1em;font-size:.875rem;margin:1em -16px 0;padding:9px 16px;
background:var(--page);border-bottom:1px solid var(--edge);overflow-x:auto;white-space:nowrap;scrollbar-width:none}
nav a{color:var(--soft);text-decoration:none}
nav a:hover{color:var(--words);text-decoration:underline}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(138px,1fr));gap:8px;margin:1em 0}
.tile{background:var(--card);border:1px solid var(--edge);border-radius:8px;padding:9px 12px}
.tile b{display:block;font-size:1.25rem;font-variant-numeric:tabular-nums;line-height:1.3}
.tile span{color:var(--soft);font-size:.82rem;line-height:1.3;display:block}
.wide{overflow-x:auto;margin:.6em 0}
table{border-collapse:collapse;font-size:.875rem;font-variant-numeric:tabular-nums}
th,td{padding:5px 16px 5px 0;text-align:right;border-bottom:1px solid var(--edge);vertical-align:top}
th{color:var(--soft);font-weight:600;vertical-align:bottom}
th:first-child,td:first-child{text-align:left;white-space:nowrap}
.words{text-align:left!important;white-space:nowrap}
.words.long{min-width:19em;white-space:normal}
.pairs td:first-child{white-space:normal;overflow-wrap:anywhere;color:var(--soft)}
.pairs td{overflow-wrap:anywhere}
td.best{font-weight:700}
.figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,440px),1fr));gap:28px 32px;margin:1em 0}
.figures:has(>:nth-child(3)){grid-template-columns:repeat(auto-fit,minmax(min(100%,340px),1fr))}
figure{margin:0;min-width:0;max-width:640px}
figure.large,figure.map,figure:only-child{grid-column:1/-1;max-width:none}
figcaption{font-weight:600;font-size:.95rem;margin-bottom:2px}
.legend{display:flex;flex-wrap:wrap;gap:2px 14px;font-size:.82rem;color:var(--soft);margin:3px 0 6px}
.legend>*{display:inline-flex;align-items:center;gap:6px;font:inherit;color:inherit;background:none;border:0;
padding:2px 0}
.legend button{cursor:pointer}
.legend .off{opacity:.4;text-decoration:line-through}
.legend i{flex:none;width:15px;text-align:center;font-style:normal;font-size:.8rem;line-height:1}
.legend .line{height:3px;border-radius:2px}
.legend .band{height:11px;border-radius:2px;opacity:.4}
.legend .dots{width:7px;height:7px;border-radius:50%}
.plot{width:100%;position:relative;overflow:hidden;aspect-ratio:var(--w)/var(--h)}
@media (min-width:700px){
:is(.large,.map,figure:only-child)>.plot{aspect-ratio:auto;height:calc(1.4px*var(--h))}
figure.map>.plot{height:640px}
nav{flex-wrap:wrap}}
.plot svg{display:block;width:100%;height:100%}
.note{margin:4px 0 0}
.plot>svg text{font-size:10px;fill:var(--soft)}
.plot .modebar{left:auto!important;right:0!important;top:-1px!important}
.plot .modebar-group{background:none!important;padding-left:0!important}
.plot .modebar-btn path{fill:var(--ink)!important}
.plot .modebar-btn.active path{fill:var(--words)!important}
.verdict{border-left:4px solid var(--ink);background:var(--card);padding:9px 14px;border-radius:0 8px 8px 0;
margin:.8em 0}
.verdict.good{border-color:var(--incremental)} .verdict.bad{border-color:var(--alert)}
.solver{white-space:nowrap}
.solver i{display:inline-block;width:.8em;height:.8em;border-radius:2px;margin-right:.45em;vertical-align:-.05em}
details{margin:.8em 0} summary{cursor:pointer}
code,pre{font:.8125rem/1.45 ui-monospace,SFMono-Regular,Consolas,"DejaVu Sans Mono",monospace;overflow-wrap:anywhere}
td code{white-space:nowrap}
pre{background:var(--card);border:1px solid var(--edge);border-radius:8px;padding:10px 14px;margin:.6em 0;
overflow-x:auto;white-space:pre-wrap}
@media print{nav{display:none} h2{break-after:avoid} figure{break-inside:avoid}}
"""
_MARKS = {"x": "✕", "s": "■", "^": "▲", "D": "◆", "o": "●"}


class Raw(str):
    """HTML made here, not to be escaped again."""


def text(value: Any) -> str:
    """A value as escaped words; numbers with four significant digits."""
    if isinstance(value, Raw):
        return value
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value)
    return escape(str(value))


def number(value: float, digits: int = 4) -> str:
    """A number for people: `digits` significant digits, whole from a thousand on, '-' where there is none."""
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    size = abs(value)
    if size >= 1e7 or size < 1e-4:
        return f"{value:.{digits - 1}g}"
    places = max(0, digits - 1 - math.floor(math.log10(size)))
    return f"{value:.{min(places, digits)}f}"


def measured(value: float, sigma: float) -> str:
    """A value with as many places as its sigma gives sense to."""
    if not (math.isfinite(value) and math.isfinite(sigma)) or sigma <= 0:
        return number(value)
    places = 1 - math.floor(math.log10(sigma))
    return f"{value:.{max(places, 0)}f}" if places <= 8 else f"{value:.4g}"


def solver(name: str) -> Raw:
    """A solver's name with its colour."""
    key = name if name in PALETTE else "other"
    return Raw(f'<span class="solver"><i style="background:var(--{key})"></i>{escape(name)}</span>')


def table(head: Sequence[Any], rows: Iterable[Sequence[Any]], best: Sequence[int] = ()) -> Raw:
    """A table, words left and numbers right; in the columns `best` the smallest number is bold.

    A column in which no row has its number is left out.
    """
    rows = [list(row) for row in rows]
    missing = [bool(rows) and all(isinstance(r[k], float) and math.isnan(r[k]) for r in rows) for k in range(len(head))]
    kept = [k for k in range(len(head)) if not missing[k]]
    head, rows, best = (
        [head[k] for k in kept],
        [[r[k] for k in kept] for r in rows],
        [kept.index(k) for k in best if k in kept],
    )
    least = {
        k: min((row[k] for row in rows if isinstance(row[k], float) and math.isfinite(row[k])), default=None)
        for k in (best if len(rows) > 1 else ())
    }
    body = []
    for row in rows:
        cells = []
        for k, value in enumerate(row):
            kind = _words(value) if k else ""
            if k in least and value == least[k]:
                kind = ' class="best"'
            cells.append(f"<td{kind}>{text(value)}</td>")
        body.append(f"<tr>{''.join(cells)}</tr>")
    marks = [max((_words(row[k]) for row in rows), default="", key=len) if k else "" for k in range(len(head))]
    heads = "".join(f'<th scope="col"{mark}>{text(h)}</th>' for h, mark in zip(head, marks, strict=True))
    return Raw(f'<div class="wide"><table><thead><tr>{heads}</tr></thead><tbody>{"".join(body)}</tbody></table></div>')


def _words(value: Any) -> str:
    """The class attribute of a cell of words, wider for a sentence."""
    if isinstance(value, Raw) and value.startswith('<span class="solver"'):
        return ' class="words"'
    if not isinstance(value, str) or isinstance(value, Raw):
        return ""
    return ' class="words long"' if len(value) > 24 else ' class="words"'


def pairs(values: Mapping[str, Any]) -> Raw:
    """A table of two columns without a head."""
    rows = "".join(f'<tr><td>{text(k)}</td><td class="words">{text(v)}</td></tr>' for k, v in values.items())
    return Raw(f'<div class="wide pairs"><table><tbody>{rows}</tbody></table></div>')


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested mapping with dotted keys."""
    out: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            out.update(flat(value, f"{prefix}{key}."))
        else:
            out[f"{prefix}{key}"] = value
    return out


def tiles(values: Iterable[tuple[str, str]]) -> Raw:
    """The few numbers to see first: (number with unit, what it is)."""
    inner = "".join(f'<div class="tile"><b>{text(v)}</b><span>{text(k)}</span></div>' for v, k in values)
    return Raw(f'<div class="tiles">{inner}</div>')


def paragraph(words: str, kind: str = "") -> Raw:
    """A paragraph, of a CSS class if given."""
    mark = f' class="{kind}"' if kind else ""
    return Raw(f"<p{mark}>{text(words)}</p>")


def heading(words: str) -> Raw:
    """A heading inside a section."""
    return Raw(f"<h3>{text(words)}</h3>")


def bullets(lines: Iterable[str]) -> Raw:
    """A list of sentences."""
    return Raw("<ul>" + "".join(f"<li>{text(line)}</li>" for line in lines) + "</ul>")


def picture(drawing: Drawing, title: str, note: str = "", kind: str = "") -> Raw:
    """A drawing with its title above, its legend, and a note below.

    It is still until the page's script, where plotly is there, puts something to zoom and hover in its place.

    Parameters
    ----------
    kind : "large" takes the whole width, "map" all the room there is; empty shares the width with others.
    """
    live = interactive.library() is not None
    tag = 'button type="button"' if live else "span"
    legend = "".join(
        f"<{tag}>{_swatch(name, kind)}{text(words)}</{tag.split()[0]}>" for words, name, kind in drawing.legend
    )
    parts = [
        f"<figcaption>{text(title)}</figcaption>",
        f'<div class="legend">{legend}</div>' if legend else "",
        f'<div class="plot" style="--w:{drawing.width:.0f};--h:{drawing.height:.0f}">',
        svg(drawing, title),
        "</div>",
        f'<script type="application/json">{interactive.text(drawing)}</script>' if live else "",
        f'<p class="note">{text(note)}</p>' if note else "",
    ]
    mark = f' class="{kind}"' if kind else ""
    return Raw(f"<figure{mark}>{''.join(parts)}</figure>")


def _swatch(name: str, kind: str) -> str:
    shade = f"var(--{name if name in PALETTE else 'other'})"
    if kind in _MARKS:
        return f'<i style="color:{shade}">{_MARKS[kind]}</i>'
    return f'<i class="{kind}" style="background:{shade}"></i>'


def gallery(pictures: Iterable[Raw]) -> Raw:
    """Pictures, two beside each other where there is room."""
    return Raw(f'<div class="figures">{"".join(pictures)}</div>')


def and_list(parts: Sequence[str]) -> str:
    """a, b and c"""
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def code(words: str, key: str) -> Raw:
    """Words to copy as they are, in an element of the id `key`."""
    return Raw(f'<pre id="{key}">{escape(words)}</pre>')


def folded(title: str, content: str) -> Raw:
    """Content that opens on demand."""
    return Raw(f"<details><summary>{text(title)}</summary>{content}</details>")


def page(title: str, lead: Sequence[str], sections: Sequence[tuple[str, Sequence[str]]]) -> str:
    """The whole page.

    Parameters
    ----------
    lead : HTML between the title and the first section.
    sections : heading and HTML parts; sections without parts are left out.
    """
    sections = [(head, parts) for head, parts in sections if any(parts)]
    links = "".join(f'<a href="#s{k}">{escape(head)}</a>' for k, (head, _) in enumerate(sections))
    body = "".join(
        f'<section id="s{k}"><h2>{escape(head)}</h2>{"".join(parts)}</section>'
        for k, (head, parts) in enumerate(sections)
    )
    script = ""
    if '<script type="application/json">' in body:
        library = f'<script type="application/octet-stream" id="plotly-library">{interactive.library()}</script>'
        script = f"{library}<script>{interactive.SCRIPT}</script>"
    elif "<figure" in body:
        install = "pip install -e '.[plots]'"
        body += f'<p class="soft">The pictures can be zoomed where plotly is installed: {install}.</p>'
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{css_colours()}{_CSS}</style>\n</head>\n<body><main>\n"
        f"<h1>{escape(title)}</h1>\n{''.join(lead)}\n<nav>{links}</nav>\n{body}\n</main>{script}</body>\n</html>\n"
    )
