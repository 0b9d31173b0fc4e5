"""One page for a fleet: totals, distributions of its figures, maps, and its drives, worst first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from graphnav.app.fleet.drive import DONE, FleetRow
from graphnav.app.fleet.tables import collect_numbers, compute_totals, describe_totals, sort_by_error
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array

_MAX_DRIVES = 1000  # drives in the page's table; the files contain all
DRAWN = 2000  # tracks on the maps, of the drives that were solved first
_MAP_DISTANCE = 0.5  # deg; tracks further apart go on different maps
_MAPS = 12
_HISTOGRAMS = {
    "span_end_h_median_m": "Horizontal error at the end of a withheld span, median of a drive (m)",
    "h_rms_m": "Horizontal error, RMS of a drive (m)",
    "nees_p": "NEES of the position, per degree of freedom; 1 where the sigmas are true",
    "sd_h_median_m": "Horizontal sigma, median of a drive (m)",
    "left_out": "Share of the fixes that is left out",
    "time_s": "Time (s)",
    "memory_mb": "Most memory (MB)",
}
_TABLE_COLUMNS = {
    "status": "status", "verdict": "verdict", "duration_s": "s", "distance_m": "m", "h_rms_m": "h RMS, m",
    "span_end_h_median_m": "span end, m", "nees_p": "NEES", "sd_h_median_m": "sigma h, m", "left_out": "left out",
    "time_s": "time, s", "memory_mb": "MB",
}  # fmt: skip
_CSS = """
:root{color-scheme:light dark;--page:#fff;--words:#1b1d20;--soft:#5b6068;--edge:#dfe2e6;--ink:#2060c0;--bad:#c03030}
@media (prefers-color-scheme:dark){:root{--page:#141619;--words:#e7e9ec;--soft:#a5abb4;--edge:#33383f;--ink:#6aa0ff;
--bad:#ff7a70}}
body{margin:0 auto;padding:20px 16px 64px;max-width:1180px;background:var(--page);color:var(--words);
font:16px/1.5 system-ui,"Segoe UI",Roboto,sans-serif}
h1{font-size:1.6rem}h2{font-size:1.25rem;margin-top:2em}figure{margin:0}
figcaption,.soft{color:var(--soft);font-size:.875rem}
.figures{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,340px),1fr));gap:24px}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.875rem;font-variant-numeric:tabular-nums}
th,td{padding:5px 14px 5px 0;text-align:right;border-bottom:1px solid var(--edge);vertical-align:top}
th:first-child,td:first-child,td.words,th.words{text-align:left}td.words{min-width:18em}
svg{width:100%;height:auto;display:block}svg text{fill:var(--soft);font-size:11px}
.bar{fill:var(--ink)}.track{fill:none;stroke:var(--ink);stroke-width:1.5}.bad{color:var(--bad);stroke:var(--bad)}
a{color:var(--ink)}
"""


def write_page(rows: Sequence[FleetRow], path: Path, title: str) -> None:
    """Write the page; it links to the reports beside it."""
    lead = f"{describe_totals(compute_totals(rows))}."
    spread = [
        _draw_histogram(collect_numbers(rows, key), label)
        for key, label in _HISTOGRAMS.items()
        if len(collect_numbers(rows, key)) > 1
    ]
    parts = [
        f"<h1>{escape(title)}</h1><p>{escape(lead)}</p>",
        f'<h2>How figures are spread</h2><div class="figures">{"".join(spread)}</div>' if spread else "",
        _draw_maps(rows),
        "<h2>Drives, worst first</h2>" + _format_table(sort_by_error(rows)),
    ]
    body = "".join(parts)
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    path.write_text(
        f'<!DOCTYPE html><html lang="en"><head>{head}<style>{_CSS}</style></head><body>{body}</body></html>\n',
        encoding="utf-8",
    )


def _format_table(rows: Sequence[FleetRow]) -> str:
    lines = []
    for row in rows[:_MAX_DRIVES]:
        name = escape(str(row["drive"]))
        if row.get("report"):
            name = f'<a href="{escape(str(row["report"]))}">{name}</a>'
        cells = "".join(f"<td>{escape(_format_cell(row.get(key)))}</td>" for key in _TABLE_COLUMNS)
        why = escape(str(row.get("error") or row.get("doubts") or ""))
        kind = "" if row["status"] == DONE else ' class="bad"'
        lines.append(f'<tr><td>{name}</td>{cells}<td class="words"><span{kind}>{why}</span></td></tr>')
    head = "".join(f"<th>{escape(label)}</th>" for label in _TABLE_COLUMNS.values())
    more = f'<p class="soft">and {len(rows) - _MAX_DRIVES} more in fleet.csv</p>' if len(rows) > _MAX_DRIVES else ""
    return (
        f'<div class="wide"><table><thead><tr><th>drive</th>{head}<th class="words">why</th></tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>{more}"
    )


def _format_cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


def _draw_histogram(x: Array, label: str) -> str:
    """A histogram with logarithmic bins where values span more than a decade, otherwise even ones."""
    if x.min() == x.max():
        return f"<figure><figcaption>{escape(label)}: {x[0]:.4g} of all</figcaption></figure>"
    log = bool(x.min() > 0.0 and x.max() > 10.0 * x.min())
    at = np.log10(x) if log else x
    count, edges = np.histogram(at, bins=min(40, max(8, math.ceil(2.0 * len(x) ** (1 / 3)))))  # Rice's rule
    width, height, foot = 340.0, 140.0, 18.0
    step = width / len(count)
    bars = "".join(
        f'<rect class="bar" x="{k * step:.1f}" y="{height * (1 - n / count.max()):.1f}" width="{max(step - 1, 1):.1f}" '
        f'height="{height * n / count.max():.1f}"><title>{n}: {_label(a, log)} to {_label(b, log)}</title></rect>'
        for k, (n, a, b) in enumerate(zip(count.tolist(), edges, edges[1:], strict=False))
    )
    ends = (
        f'<text x="0" y="{height + 13}">{_label(edges[0], log)}</text>'
        f'<text x="{width}" y="{height + 13}" text-anchor="end">{_label(edges[-1], log)}</text>'
    )
    about = f"{label}: median {np.median(x):.4g}, 95 % below {np.quantile(x, 0.95):.4g}{', log scale' if log else ''}"
    box = f'viewBox="0 0 {width:g} {height + foot:g}" role="img" aria-label="{escape(about)}"'
    return f"<figure><svg {box}>{bars}{ends}</svg><figcaption>{escape(about)}</figcaption></figure>"


def _label(value: float, log: bool) -> str:
    return f"{10.0**value if log else value:.3g}"


def _draw_maps(rows: Sequence[FleetRow]) -> str:
    """All tracks, those close to each other on one map."""
    placed = [(np.array(row["track"], dtype=float), row) for row in rows if row.get("track")]
    groups: list[list[tuple[Array, FleetRow]]] = []
    for track, row in placed[:DRAWN]:
        near = next((g for g in groups if np.abs(g[0][0][0] - track[0]).max() < _MAP_DISTANCE), None)
        if near is None:
            groups.append([(track, row)])
        else:
            near.append((track, row))
    groups.sort(key=len, reverse=True)
    if not groups:
        return ""
    figures = "".join(_draw_map(group) for group in groups[:_MAPS])
    left = sum(bool(row.get("placed")) for row in rows) - sum(map(len, groups[:_MAPS]))
    more = f'<p class="soft">{left} more tracks are not drawn.</p>' if left > 0 else ""
    return f'<h2>Where they drove</h2><div class="figures">{figures}</div>{more}'


def _draw_map(group: Sequence[tuple[Array, FleetRow]]) -> str:
    points = np.concatenate([track for track, _ in group])
    low, high = points.min(0), points.max(0)
    shrink = math.cos(math.radians(float(points[:, 1].mean())))
    size = max((high[0] - low[0]) * shrink, high[1] - low[1], 1e-5)
    width = 340.0
    scale = (width - 10.0) / size
    tall = (high[1] - low[1]) * scale + 10.0
    lines = []
    for track, row in group:
        x, y = (track[:, 0] - low[0]) * shrink * scale + 5.0, (high[1] - track[:, 1]) * scale + 5.0
        corners = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
        kind = "track bad" if row.get("verdict") == "doubtful" else "track"
        line = f'<polyline class="{kind}" points="{corners}"><title>{escape(str(row["drive"]))}</title></polyline>'
        lines.append(f'<a href="{escape(str(row["report"]))}">{line}</a>' if row.get("report") else line)
    km = size * 111.2
    across = f"{km:.3g} km" if km >= 1.0 else f"{1e3 * km:.3g} m"
    tracks = format_count(len(group), "track")
    about = f"{tracks} about {low[1]:.3f}, {low[0]:.3f} deg; {across} across; doubtful ones red"
    return (
        f'<figure><svg viewBox="0 0 {width:g} {max(tall, 40.0):.1f}" role="img" aria-label="{escape(about)}">'
        f"{''.join(lines)}</svg><figcaption>{escape(about)}</figcaption></figure>"
    )
