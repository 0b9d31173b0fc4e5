"""The HTML around figures and tables: one self-contained page, light or dark as the reader prefers.

Every function takes plain values and escapes them. Figures are drawn by plotly in the reader's browser: plotly's own
script, 4.8 MB, and the data of all figures go into the page deflated (`page.js` unpacks them).
"""

from __future__ import annotations

import base64
import importlib.util
import json
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from pathlib import Path
from typing import Any

from graphnav.report.plots import PALETTE, TIME, Figure, css_colours

_HERE = Path(__file__).parent
_PACKED = "application/octet-stream"
_LEVEL = 5  # two thirds of the time of level 6, less than a hundredth larger


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


def format_measured(value: float, sigma: float) -> str:
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


def picture(figure: Figure, title: str, note: str = "", kind: str = "") -> Raw:
    """A figure with its title above and a note below.

    Parameters
    ----------
    kind : "large" takes the whole width; empty shares the width with others.
    """
    data = json.dumps(figure.json, separators=(",", ":")).encode()
    time = " data-time" if figure.time else ""
    parts = [
        f"<figcaption>{text(title)}</figcaption>",
        f'<div class="plot" role="img" aria-label="{escape(title)}"{time} style="height:{figure.height}px"></div>',
        _pack(data),
        f'<p class="note">{text(note)}</p>' if note else "",
    ]
    mark = f' class="{kind}"' if kind else ""
    return Raw(f"<figure{mark}>{''.join(parts)}</figure>")


def gallery(pictures: Iterable[Raw]) -> Raw:
    """Pictures, two beside each other where there is room."""
    return Raw(f'<div class="figures">{"".join(pictures)}</div>')


def columns(parts: Iterable[str]) -> Raw:
    """Parts beside each other where there is room."""
    return Raw(f'<div class="columns">{"".join(f"<div>{part}</div>" for part in parts)}</div>')


def and_list(parts: Sequence[str]) -> str:
    """a, b and c"""
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def code(words: str, key: str) -> Raw:
    """Words to copy as they are, in an element of the id `key`."""
    return Raw(f'<pre id="{key}">{escape(words)}</pre>')


def fold(title: str, content: str) -> Raw:
    """Content that opens on demand."""
    return Raw(f"<details><summary>{text(title)}</summary>{content}</details>")


@dataclass(frozen=True)
class TimeAxis:
    """A clock that figures over time can be read on: what it is called, and what it reads at the start, s.

    `date`: the seconds are of a day of the calendar, since 1970.
    """

    words: str
    start: float
    date: bool = False


def page(
    title: str, lead: Sequence[str], sections: Sequence[tuple[str, Sequence[str]]], clocks: Sequence[TimeAxis] = ()
) -> str:
    """The whole page.

    Parameters
    ----------
    lead : HTML between the title and the first section.
    sections : heading and HTML parts; sections without parts are left out.
    clocks : to choose from, beside seconds from the start.
    """
    sections = [(head, parts) for head, parts in sections if any(parts)]
    choice = "".join(
        f'<option value="{one.start!r}"{" data-date" if one.date else ""}>{text(one.words)}</option>' for one in clocks
    )
    if choice:
        choice = f'<select id="clock" aria-label="time axis"><option value="">{TIME}</option>{choice}</select>'
    links = choice + "".join(f'<a href="#s{k}">{escape(head)}</a>' for k, (head, _) in enumerate(sections))
    body = "".join(
        f'<section id="s{k}"><h2>{escape(head)}</h2>{"".join(parts)}</section>'
        for k, (head, parts) in enumerate(sections)
    )
    script = ""
    if "<figure" in body:
        script = _library()
        script += f"<script>{(_HERE / 'page.js').read_text(encoding='utf-8')}</script>"
        body = f'<noscript><p class="soft">The figures need scripts, which are off.</p></noscript>{body}'
    style = css_colours() + (_HERE / "page.css").read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body><main>\n"
        f"<h1>{escape(title)}</h1>\n{''.join(lead)}\n<nav>{links}</nav>\n{body}\n</main>{script}</body>\n</html>\n"
    )


@lru_cache(maxsize=1)
def _library() -> str:
    found = importlib.util.find_spec("plotly")
    if found is None or found.origin is None:
        raise ModuleNotFoundError("plotly is not installed")
    return _pack((Path(found.origin).parent / "package_data" / "plotly.min.js").read_bytes(), "plotly-library")


def _pack(content: bytes, key: str = "") -> str:
    """An element that holds something deflated, for `page.js` to unpack."""
    mark = f' id="{key}"' if key else ""
    packed = base64.b64encode(zlib.compress(content, _LEVEL)).decode("ascii")
    return f'<script type="{_PACKED}"{mark} data-size="{len(content)}">{packed}</script>'
