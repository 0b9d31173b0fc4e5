"""The HTML around figures and tables: one self-contained page, light or dark as the reader prefers.

`parts.html` and `page.html` are its templates, which escape everything that is not markup. Figures are drawn by plotly
in the reader's browser: plotly's own script, 4.8 MB, and the data of all figures are compressed in the page (`page.js`
decompresses them).
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
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from graphnav.core.errors import ConfigError
from graphnav.report.plots import TIME_NAME, Figure, format_css, name_variable
from graphnav.report.wording import Quantity, format_value

_HERE = Path(__file__).parent
_ZLIB_LEVEL = 5  # of zlib: two thirds of the time of level 6, and less than a hundredth larger


_TEMPLATES = Environment(
    loader=FileSystemLoader(_HERE), autoescape=True, finalize=format_value, undefined=StrictUndefined, trim_blocks=True
)
_PARTS: Any = _TEMPLATES.get_template("parts.html").module
bullets, code, columns, digest, download, fold, gallery, heading, judged, links, pairs, paragraph, tiles, verdicts = (
    getattr(_PARTS, name) for name in (
        "bullets", "code", "columns", "digest", "download", "fold", "gallery", "heading", "judged", "links", "pairs",
        "paragraph", "tiles", "verdicts",
    )
)  # fmt: skip


def format_solver(name: str) -> Markup:
    """A solver's name in its colour."""
    return _PARTS.solver(name, name_variable(name))


def make_table(head: Sequence[Any], rows: Iterable[Sequence[Any]], best: Sequence[int] = ()) -> Markup:
    """A table, text left and numbers right; in the columns `best` what is the smallest number as displayed is bold.

    A column without any number is omitted.
    """
    rows = [list(row) for row in rows]
    known = [any(not isinstance(row[k], float) or not math.isnan(row[k]) for row in rows) for k in range(len(head))]
    columns = [k for k in range(len(head)) if known[k] or not rows]
    least = {
        k: min((row[k] for row in rows if isinstance(row[k], float) and math.isfinite(row[k])), default=None)
        for k in (best if len(rows) > 1 else ())
    }

    def choose_class(k: int, value: Any) -> str:
        is_least = (
            least.get(k) is not None and isinstance(value, float) and format_value(value) == format_value(least[k])
        )
        return "best" if is_least else _choose_class(value) if k else ""

    return _PARTS.table(
        [(head[k], max((_choose_class(row[k]) for row in rows), default="", key=len) if k else "") for k in columns],
        [[(row[k], choose_class(k, row[k])) for k in columns] for row in rows],
    )


def _choose_class(value: Any) -> str:
    """The class of a text cell, wider for a sentence."""
    if isinstance(value, Quantity) or not isinstance(value, str):
        return ""
    return "words long" if len(value) > 24 and not isinstance(value, Markup) else "words"


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested mapping with dotted keys."""
    out: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            out.update(flatten(value, f"{prefix}{key}."))
        else:
            out[f"{prefix}{key}"] = value
    return out


def place_picture(figure: Figure, title: str, note: str = "", kind: str = "") -> Markup:
    """A figure with its title above and a note below.

    Parameters
    ----------
    kind : "large" takes the whole width; empty shares the width with others.
    """
    return _PARTS.picture(figure, title, _compress(json.dumps(figure.json, separators=(",", ":")).encode()), note, kind)


@dataclass(frozen=True)
class TimeAxis:
    """A clock for the time axes of figures: its name and its reading at the start, s; with `date` since 1970."""

    words: str
    start: float
    date: bool = False


def make_page(
    title: str,
    lead: Sequence[Markup],
    sections: Sequence[tuple[str, Sequence[Markup]]],
    clocks: Sequence[TimeAxis] = (),
    others: Sequence[str] = (),
) -> str:
    """The whole page.

    Parameters
    ----------
    lead : between the title and the first section.
    sections : heading and parts; sections without parts are left out.
    clocks : to choose from, beside seconds from the start.
    others : names of other programs, each with a colour of its own.
    """
    sections = [(head, parts) for head, parts in sections if any(parts)]
    drawn = any("<figure" in part for _, parts in sections for part in parts)
    return _TEMPLATES.get_template("page.html").render(
        title=title, lead=lead, sections=sections, clocks=clocks, time=TIME_NAME,
        library=read_library() if drawn else None,
        style=Markup(format_css(others) + _read_asset("page.css")), script=Markup(_read_asset("page.js")),
    )  # fmt: skip


def _read_asset(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


@dataclass(frozen=True)
class Packed:
    """Compressed data in base64, and its uncompressed size."""

    size: int
    data: Markup


@lru_cache(maxsize=1)
def read_library() -> Packed:
    """Plotly's script, compressed once in a process.

    Raises
    ------
    ConfigError
        If plotly is not installed.
    """
    found = importlib.util.find_spec("plotly")
    if found is None or found.origin is None:
        raise ConfigError(
            "a page needs plotly, which is not installed; pip install -e . in the clone", key="package.missing"
        )
    return _compress((Path(found.origin).parent / "package_data" / "plotly.min.js").read_bytes())


def _compress(content: bytes) -> Packed:
    return Packed(len(content), Markup(base64.b64encode(zlib.compress(content, _ZLIB_LEVEL)).decode("ascii")))
