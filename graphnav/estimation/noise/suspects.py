"""Spans of fixes that are suspected, and how they are dated; `graphnav.estimation.noise.exclusion` decides on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.estimation.faults.excluded import find_fault_spans, weigh_rows
from graphnav.estimation.faults.segments import find_wrong_segments
from graphnav.estimation.faults.watch import FAULT_COST, PATIENCE, SIZES
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import NoiseEstimate
from graphnav.estimation.noise.explanations import FIXES
from graphnav.estimation.noise.model import INTERVALS, NoiseModel
from graphnav.estimation.noise.moments import collect_row_moments, predict_errors
from graphnav.estimation.noise.spans import (
    LeftOutErrors,
    Span,
    are_covered,
    join,
    join_faults,
    split_at_steps,
)
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import refilter

_STEPS = 8  # fixes by which the ends of spans are varied


def find_suspects(base: Problem, noise: NoiseModel, found: NoiseEstimate) -> list[Span]:
    """Spans (s) in which the tests find fixes in disagreement with everything else.

    Parameters
    ----------
    noise : by which the tests are made; its figures need not be those found.
    found : with the points to linearise at.
    """
    # weights of fixes and of IMU intervals may hide a fault from the tests
    kept = {name: some for name, some in noise.weights.items() if name not in (*FIXES, *INTERVALS)}
    tested = apply_noise(base, replace(noise, weights=kept))
    weights = refilter(tested, found.carry_points(base, tested), watch=True, whole=False).weights
    return join_faults(find_fault_spans(weigh_rows(tested, weights)))


def find_segments(base: Problem, found: NoiseEstimate, suspected: list[Span]) -> tuple[list[Span], int]:
    """Wrong segments, of those into which the ends of suspected spans divide the drive, and filter passes that it took.

    None unless some of them are in none of these spans.
    """
    within = join(suspected)
    if len(within) < 2:
        return [], 0
    t = list_fix_times(base)
    behind = np.searchsorted(t, [end + SAME_TIME for _, end in suspected])
    edges = sorted({*(begin for begin, _ in suspected), *t[behind[behind < len(t)]].tolist()})
    used = apply_noise(base, replace(found.noise, excluded={}))
    segments = find_wrong_segments(used, found.carry_points(base, used), edges, FIXES)
    return [] if are_covered(segments, within) else segments, 1


def date_segments(base: Problem, found: NoiseEstimate, spans: list[Span]) -> list[Span]:
    """Wrong segments near some spans, dated to the fix: the errors of a drift date its onset together.

    Parameters
    ----------
    found : without the spans.
    """
    t, edges = list_fix_times(base), set[int]()
    for begin, end in spans:
        steps = _STEPS if end - begin > PATIENCE else 0  # a short one is left out whole
        for at in np.searchsorted(t, [begin - SAME_TIME, end + SAME_TIME]).tolist():
            edges |= set(range(max(at - steps, 0), min(at + steps + 1, len(t))))
    used = apply_noise(base, replace(found.noise, excluded={}))
    return find_wrong_segments(used, found.carry_points(base, used), t[sorted(edges)].tolist(), FIXES)


def predict_left_out(problem: Problem, found: NoiseEstimate) -> LeftOutErrors:
    """Squared errors of all fixes, each predicted without itself."""
    fixes = (rows for rows in problem.constraints if rows.name in FIXES)
    return {
        c.name: (problem.t[c.keyframe], collect_row_moments(c, found.points.take_rows(c)).left_out, len(c.axes))
        for c in fixes
    }


def cut_at_steps(spans: list[Span], decided: NoiseModel, problem: Problem, found: NoiseEstimate) -> list[Span]:
    """Spans cut where the errors of positions have steps, if as a whole they are decided to be wrong."""
    rows = next((c for c in problem.constraints if c.name == FIXES[0]), None)
    wrong = decided.excluded.get(FIXES[0], ())
    if rows is None or not wrong:
        return spans
    error, sigma = predict_errors(rows, found.points)
    cost = float(np.median(np.sum(np.log1p(SIZES[rows.unit] / sigma), axis=1)) + FAULT_COST)
    cut = split_at_steps([span for span in spans if span in wrong], problem.t[rows.keyframe], error, sigma, cost)
    return sorted([*cut, *(span for span in spans if span not in wrong)])


def list_fix_times(base: Problem) -> Array:
    """(N,) s, in order."""
    return base.t[np.unique(np.concatenate([c.keyframe for c in base.constraints if c.name in FIXES]))]
