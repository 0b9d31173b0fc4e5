"""Spans of measurements that no solver uses, and the errors in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.estimation.names import name_rows
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ExcludedSpan
from graphnav.estimation.solvers.passes import SmootherPass, record_residuals


def find_fault_spans(problem: Problem, smoothed: SmootherPass | None = None) -> tuple[ExcludedSpan, ...]:
    """The rows of weight 0, by constraint and ordered by time; with their errors if a smoothed solution is given."""
    out = []
    for rows in problem.constraints:
        lost = np.flatnonzero(rows.weight == 0.0) if rows.weight is not None else np.empty(0, dtype=int)
        if not len(lost):
            continue
        t = problem.t[rows.keyframe]
        off = None
        if smoothed is not None:
            record = record_residuals(problem, rows, smoothed)
            off = np.linalg.norm(record.residual, axis=1)
        for run in np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1):
            reason = ""
            if off is not None:
                reason = f"{np.median(off[run]):.2g} {rows.unit} from the solution without it"
                if len(run) > 1:
                    reason += f", {np.max(off[run]):.2g} at most"
            out.append(ExcludedSpan(rows.name, float(t[run[0]]), float(t[run[-1]]), len(run), reason))
    return tuple(out)


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
                    f"{name_rows(rows.name)}: {many} left out as faulty, {where} {begin:.1f} to "
                    f"{begin + longest.t_end - longest.t_start:.1f} s: {longest.reason}",
                )
            )
    return tuple(out)


def weigh_rows(problem: Problem, weights: Mapping[str, Array]) -> Problem:
    """A problem with its rows weighted, (N,) by constraint."""
    constraints = (replace(c, weight=weights[c.name]) if c.name in weights else c for c in problem.constraints)
    return replace(problem, constraints=tuple(constraints))
