"""Spans of measurements that are wrong, and the errors in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.estimation.names import name_rows
from graphnav.estimation.noise.spans import Span, mask_times
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ExcludedSpan
from graphnav.estimation.solvers.passes import SmootherPass, record_residuals


def find_fault_spans(
    problem: Problem, smoothed: SmootherPass | None = None, excluded: Mapping[str, Sequence[Span]] | None = None
) -> tuple[ExcludedSpan, ...]:
    """The rows of weight 0 and those of excluded spans, by constraint and ordered by time.

    Parameters
    ----------
    smoothed : the solution that their errors are told of, if they are to be.
    excluded : s, by constraint, spans of which the rows may be used with a weight.
    """
    out = []
    for rows in problem.constraints:
        if rows.weight is None:
            continue
        t = problem.t[rows.keyframe]
        lost = np.flatnonzero((rows.weight == 0.0) | mask_times(t, (excluded or {}).get(rows.name, ())))
        if not len(lost):
            continue
        off = None
        if smoothed is not None:
            record = record_residuals(problem, rows, smoothed)
            off = np.linalg.norm(record.residual, axis=1)
        weight = rows.weight[lost]
        for run in np.split(lost, np.flatnonzero((np.diff(lost) > 1) | (np.diff(weight) != 0.0)) + 1):
            factor = float(1.0 / np.sqrt(rows.weight[run[0]])) if rows.weight[run[0]] > 0.0 else np.inf
            reason = "" if off is None else _describe_errors(off[run], rows.unit, factor)
            out.append(ExcludedSpan(rows.name, float(t[run[0]]), float(t[run[-1]]), len(run), reason, factor))
    return tuple(out)


def _describe_errors(off: Array, unit: str, factor: float) -> str:
    """How far (N,) rows are off, and with what sigma they are used."""
    most = f", {np.max(off):.2g} at most" if len(off) > 1 else ""
    use = f"used with {factor:.2g} times the sigma" if np.isfinite(factor) else "not used"
    return f"{np.median(off):.2g} {unit} from the solution{most}; {use}"


def describe_faults(faults: tuple[ExcludedSpan, ...], problem: Problem) -> tuple[str, ...]:
    """A sentence for each kind of measurement with excluded rows."""
    out = []
    for rows in problem.constraints:
        own = [fault for fault in faults if fault.kind == rows.name]
        if own:
            longest = max(own, key=lambda f: f.t_end - f.t_start)
            begin = longest.t_start - problem.recording.start
            many = f"{format_count(sum(f.count for f in own), 'row')} of {len(rows)}"
            where = "from" if len(own) == 1 else f"in {len(own)} spans, the longest from"
            out.append(
                Note(
                    "gnss.excluded",
                    f"{name_rows(rows.name)}: {many} excluded as faulty, {where} {begin:.1f} to "
                    f"{begin + longest.t_end - longest.t_start:.1f} s: {longest.reason}",
                )
            )
    return tuple(out)


def weigh_rows(problem: Problem, weights: Mapping[str, Array]) -> Problem:
    """A problem with its rows weighted, (N,) by constraint."""
    constraints = (replace(c, weight=weights[c.name]) if c.name in weights else c for c in problem.constraints)
    return replace(problem, constraints=tuple(constraints))
