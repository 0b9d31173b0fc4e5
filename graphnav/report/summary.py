"""The first page of a report: whether position, velocity and attitude are usable, the inputs, and what was excluded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from graphnav.core.interpolation import pick_nearest
from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.estimation.names import name_rows
from graphnav.estimation.noise.spans import mask_times
from graphnav.estimation.solution import Solution
from graphnav.evaluation.against import find_antenna_lever_arm
from graphnav.evaluation.segments import compute_relative_errors, compute_rms
from graphnav.recording import Recording
from graphnav.report import page, wording
from graphnav.report.beside import select_fixes
from graphnav.report.consistency import summarise_record
from graphnav.report.pictures import ENU
from graphnav.report.satellites import tabulate_epochs
from graphnav.report.tables import Removed
from graphnav.report.wording import Quantity, join_words

if TYPE_CHECKING:
    from graphnav.evaluation.metrics import Errors

_MAX_LINES = 3  # exclusions listed
_SAYS = {
    "too small": ("bad", "sigma is too small"),
    "unclear": ("", "consistency of sigma is undecided: errors are correlated for too long"),
    "cautious": ("", "sigma is cautious"),
    "fits": ("good", "sigma is consistent"),
}
# constraints whose innovations or residuals judge a block where there is no truth
_SHOWS = {
    "position": ("gnss_position", "gnss_code"),
    "velocity": ("gnss_velocity", "gnss_doppler", "odometer", "nhc", "zero_velocity", "stance"),
    "attitude": (),
}


def tabulate_verdicts(solution: Solution, errors: Errors | None) -> Markup:
    """Accuracy of position, velocity and attitude, and whether the stated sigma is consistent."""
    from graphnav.evaluation.sigmas import find_separation

    found = _judge_by_records(solution) | ({} if errors is None else _judge_by_truth(errors))
    if (apart := find_separation(solution.separation)) is not None and "position" in found:
        # errors against a truth decide, except where filter and later measurements are this far apart
        kind, words = found["position"]
        kind = "bad" if errors is None else kind.replace("good", "")
        words += f"; forward filter and later measurements are {apart.size:.1f} sigma apart (rms, {apart.block})"
        found["position"] = kind, words
    nothing = ("", "there is nothing to assess it by")
    return page.verdicts(
        [(kind, block.capitalize(), words) for block in _SHOWS for kind, words in [found.get(block, nothing)]]
    )


def _judge_by_truth(errors: Errors) -> dict[str, tuple[str, str]]:
    from graphnav.evaluation.sigmas import PARTS, judge_sigmas, select_verdict

    # a truth may have no heights
    up = f", {wording.format_number(compute_rms(errors.p[:, 2]), 3)} m up" if np.isfinite(errors.p[:, 2]).any() else ""
    sizes = {
        "position": f"{wording.format_number(compute_rms(errors.horizontal), 3)} m rms horizontal{up}",
        "velocity": f"{wording.format_number(compute_rms(np.linalg.norm(errors.v, axis=1)), 3)} m/s rms",
        "attitude": f"{wording.format_number(compute_rms(np.degrees(errors.rph[:, :2])), 3)} deg rms roll and pitch, "
        f"{wording.format_number(compute_rms(np.degrees(errors.rph[:, 2])), 3)} deg heading",
    }
    every = judge_sigmas(errors)
    out = {}
    for block, size in sizes.items():
        own = [j for j in every if j.block in (block, PARTS.get(block))]
        for verdict, (kind, says) in _SAYS.items():  # the gravest first
            if some := select_verdict(own, verdict):
                part = "" if some[0].block == block else f"{some[0].block} "
                out[block] = kind, f"{size}; {says} ({part}errors are {some[0].size:.2f} sigma, rms)"
                break
    return out


def _judge_by_records(solution: Solution) -> dict[str, tuple[str, str]]:
    out = {}
    for block, kinds in _SHOWS.items():
        for kind in kinds:
            c = summarise_record(solution.records[kind]) if kind in solution.records else None
            if c is None or c.count - c.rejected < 10 or not np.isfinite(c.mean_nis):
                continue
            bad = c.mean_nis / c.dof > (1.5 if c.kind == "innovation" else 1.3)
            mark = "bad" if bad else "good" if c.kind == "innovation" else ""
            out[block] = mark, f"no truth; {name_rows(kind)}: {c.verdict}"
            break
    return out


def tabulate_sigmas(solution: Solution) -> list[Markup]:
    """The stated 1-sigma below which half, 95 % and all of the keyframes lie."""
    track = solution.trajectory(joint=False)
    rows: list[list[Any]] = []

    def add(words: str, unit: str, values: Array) -> None:
        values = values[np.isfinite(values)]
        if len(values):
            rows.append([f"{words} [{unit}]", *(float(np.quantile(values, q)) for q in (0.5, 0.95, 1.0))])

    for words, unit, sd in (("position", "m", track.sd_p), ("velocity", "m/s", track.sd_v)):
        if sd is not None:
            add(f"{words}, horizontal", unit, np.hypot(sd[:, 0], sd[:, 1]))
            add(f"{words}, up", unit, sd[:, 2])
    if track.sd_rph is not None:
        deg = np.degrees(track.sd_rph)
        add("roll, pitch", "deg", np.maximum(deg[:, 0], deg[:, 1]))
        add("heading", "deg", deg[:, 2])
    return [page.heading("Stated 1-sigma"), page.make_table(["of", "50 %", "95 %", "largest"], rows)] if rows else []


def tabulate_fixes(recording: Recording, solution: Solution, withheld: Removed) -> list[Markup]:
    """Fixes of each kind: number, excluded or used, longest gap, farthest; or epochs of raw observations."""
    fixes, nan = select_fixes(recording, solution), float("nan")
    raw = tabulate_epochs(solution)
    if raw:
        return [*raw, page.paragraph("Raw observations are used in place of the fixes.", "soft")]
    if fixes is None:
        return []
    gone = np.zeros(len(fixes.t), dtype=bool)
    for source, span in withheld:
        if source == "gnss":
            gone |= True if span is None else (fixes.t >= span[0]) & (fixes.t <= span[1])
    record = solution.records.get("gnss_position")
    at = _find_rows(fixes.t + recording.start, None if record is None else record.t)
    state = _find_rows(fixes.t + recording.start, solution.t)
    arm = find_antenna_lever_arm(recording, solution)
    assert arm is not None
    antenna = solution.states.p + solution.states.R_nb @ arm
    away = np.where(state >= 0, np.linalg.norm((fixes.enu - antenna[state])[:, :2], axis=1), nan)
    kinds = {**fixes.kinds, **({"all": np.ones(len(gone), bool)} if len(fixes.kinds) > 1 else {})}
    rows = []
    for kind, of_it in kinds.items():
        used = np.flatnonzero(of_it & ~gone & ~fixes.excluded & (at >= 0))
        cells: list[Any] = [
            kind,
            *(int(np.count_nonzero(of_it & mask)) for mask in (of_it, gone, fixes.excluded & ~gone)),
        ]
        largest, over, gap = nan, nan, nan
        if record is not None and len(used):
            # of the residual the part of an error that lasts is taken off; what a reader sees beside the path is not
            largest = float(np.nanmax(away[used]))
            over = float(np.nanmax(np.abs(record.residual / record.sigma)[at[used]]))
            gap = float(np.max(np.diff(fixes.t[used]), initial=0.0))
        rows.append([*cells, len(used), gap, largest, over, *_list_stated(recording, np.flatnonzero(of_it))])
    head = [
        "fixes",
        "count",
        "withheld",
        "excluded",
        "used",
        "longest gap [s]",
        "farthest [m]",
        "largest residual / sigma",
    ]
    head.append("stated sigma [m]")
    if recording.gnss is not None and recording.gnss.satellites is not None:
        head += ["satellites", "fewest"]
    out = [page.heading("Fixes"), page.make_table(head, rows)]
    out.append(
        page.paragraph(
            "Farthest: horizontally, from the estimated antenna. Residuals are over the sigma of the noise model.",
            "soft",
        )
    )
    if any(row[4] < row[1] - row[2] - row[3] for row in rows):
        out.append(page.paragraph("Of fixes that come more often than noise.spacing, the best one is used.", "soft"))
    return out


def _list_stated(recording: Recording, rows: Array) -> list[Any]:
    """Median horizontal sigma stated by the fixes (m) and, if stated, satellites: median and minimum."""
    gnss = recording.gnss
    assert gnss is not None
    out: list[Any] = [float(np.median(np.hypot(gnss.sd[rows, 0], gnss.sd[rows, 1])))]
    if gnss.satellites is not None:
        counts = gnss.satellites[rows]
        counts = counts[np.isfinite(counts)]
        out += [Quantity(f"{x:.0f}") for x in (np.median(counts), counts.min())] if len(counts) else ["-", "-"]
    return out


def tabulate_separation(solution: Solution) -> list[Markup]:
    """Forward filter minus the information after it, per axis: its size, and that over its own sigma."""
    if solution.separation is None:
        return []
    rows: list[list[Any]] = []
    for k, axis in enumerate(ENU):
        value, sigma = solution.separation.value[:, k], solution.separation.sigma[:, k]
        known = np.isfinite(value)
        if known.any():
            size = np.abs(value[known])
            rows.append(
                [axis, *(float(np.quantile(size, q)) for q in (0.5, 0.95, 1.0)), compute_rms(size / sigma[known])]
            )
    if not rows:
        return []
    note = "Forward filter minus the estimate from later measurements; over its sigma, about 1 where sigmas are true."
    head = ["axis", "50 % [m]", "95 % [m]", "largest [m]", "over sigma, rms"]
    return [page.heading("Combined separation"), page.make_table(head, rows), page.paragraph(note, "soft")]


def _find_rows(t: Array, of: Array | None) -> np.ndarray:
    """Row of `of` at each time, -1 where there is none within a millisecond."""
    if of is None or not len(of):
        return np.full(len(t), -1)
    k = pick_nearest(of, t)
    return np.where(np.abs(of[k] - t) <= 1e-3, k, -1)


def _format_span(begin: float, end: float) -> str:
    """When a span is, as displayed, s."""
    first, last = f"{begin:.1f}", f"{end:.1f}"
    return f"at {first}" if first == last else f"from {first} to {last}"


def describe_excluded(solution: Solution, start: float) -> list[Markup]:
    """What was excluded and why, in three lines: the largest spans, the rest together, what was down-weighted."""
    spans = sorted(solution.excluded, key=lambda p: -p.count)
    some = spans[:_MAX_LINES] if len(spans) <= _MAX_LINES else spans[: _MAX_LINES - 1]
    lines = [
        f"{name_rows(p.kind)}, {format_count(p.count, 'row')} {_format_span(p.t_start - start, p.t_end - start)} s: "
        f"{p.reason or 'faulty'}"
        for p in some
    ]
    if len(spans) > len(some):
        rest = spans[len(some) :]
        lines.append(
            f"{format_count(sum(int(p.count) for p in rest), 'row')} in {len(rest)} more spans: see the noise model"
        )
    less = [
        f"{count} of {name_rows(name)}"
        for name, record in solution.records.items()
        if (count := np.count_nonzero((record.weight > 0) & (record.weight < 0.5) & ~_mask_excluded(solution, name)))
    ]
    if less and len(lines) < _MAX_LINES:
        lines.append(f"less than half weight, because their residuals exceed what chance allows: {join_words(less)}")
    return [page.heading("Excluded"), page.bullets(lines or [Note("left_out.nothing", "Nothing was left out.")])]


def _mask_excluded(solution: Solution, name: str) -> Array:
    """Which rows of a constraint are in spans that the noise model excludes."""
    return mask_times(solution.records[name].t, solution.noise.excluded.get(name, ()))


def list_links(files: Sequence[str]) -> list[Markup]:
    """Links to the files beside the page."""
    return [page.links(files)] if files else []


def tabulate_relative_errors(errors: Mapping[str, Errors]) -> list[Markup]:
    """Relative errors by length of segment, where there is a truth."""
    rows = [
        [
            page.format_solver(name),
            Quantity(f"{r.length:g}"),
            r.count,
            r.rms,
            r.percent,
            r.p95,
            r.largest,
            r.heading_rms,
        ]
        for name, e in errors.items()
        for r in compute_relative_errors(e)
    ]
    head = ["solver", "segment [m]", "count", "RMS [m]", "% of length", "95 % [m]", "largest [m]", "heading RMS [deg]"]
    if not rows:
        return []
    return [page.heading("Relative error by segment length"), page.make_table(head, rows)]
