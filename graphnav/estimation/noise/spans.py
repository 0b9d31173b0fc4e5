"""Spans of time in which measurements are suspected: joined, compared, and trimmed to the wrong fixes in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from scipy.special import chdtri

from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.estimation.noise.model import RowWeights
from graphnav.estimation.noise.outliers import OUTLIER_COST
from graphnav.estimation.noise.tails import CHANCE
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ExcludedSpan

Span = tuple[float, float]  # s, first and last measurement in it
LeftOutErrors = Mapping[str, tuple[Array, Array, int]]  # by constraint: (N,) s, (N,) squared errors, degrees of freedom


def mask_times(t: Array, spans: Iterable[Span]) -> Array:
    """(N,) mask of times (N,) s in spans, ends included."""
    out = np.zeros(len(t), dtype=bool)
    for begin, end in spans:
        out |= (t >= begin - SAME_TIME) & (t <= end + SAME_TIME)
    return out


def drop_within(some: RowWeights, spans: Iterable[Span]) -> RowWeights:
    """The weights of the rows outside all spans."""
    keep = ~mask_times(some.t, spans)
    return RowWeights(some.t[keep], some.weight[keep])


def join(spans: Iterable[Span]) -> list[Span]:
    """Spans in order, those that overlap or touch as one."""
    out: list[Span] = []
    for begin, end in sorted(spans):
        if out and begin <= out[-1][1] + SAME_TIME:
            out[-1] = (out[-1][0], max(end, out[-1][1]))
        else:
            out.append((begin, end))
    return out


def join_adjacent(spans: list[Span], t: Array) -> list[Span]:
    """Spans with those as one that have none of the times t (N,), s, between them."""
    out: list[Span] = []
    for begin, end in spans:
        if out and not np.any((t > out[-1][1] + SAME_TIME) & (t < begin - SAME_TIME)):
            out[-1] = out[-1][0], end
        else:
            out.append((begin, end))
    return out


def join_faults(faults: Iterable[ExcludedSpan]) -> list[Span]:
    """Spans of several measurements; single ones are handled by their weights."""
    return join((fault.t_start, fault.t_end) for fault in faults if fault.count > 1)


def split_at_steps(spans: list[Span], t: Array, error: Array, sigma: Array, cost: float) -> list[Span]:
    """Spans cut at steps of the errors of fixes in them: each reflection has an error of its own.

    What errors change by without a step is taken from the median; between fixes that are further apart than others the
    prediction drifts for longer.

    Parameters
    ----------
    t : (N,) s
    error : (N, m) of fixes, predicted by a smoother that does not use them.
    sigma : (N, m) of the fixes.
    cost : negative log-probability of one more unknown error, which a step has to be worth.
    """
    out: list[Span] = []
    for begin, end in spans:
        own = mask_times(t, [(begin, end)])
        dt, variance = np.diff(t[own]), sigma[own] ** 2
        squared = np.sum(np.diff(error[own], axis=0) ** 2 / (variance[1:] + variance[:-1]), axis=1)
        if len(dt):
            usual = float(np.median(squared)) / float(chdtri(error.shape[1], 0.5))
            squared /= max(usual, 1.0) * np.maximum(dt / np.median(dt), 1.0) ** 2
        times, after = t[own], np.flatnonzero(0.5 * squared > cost) + 1
        out += zip([begin, *times[after].tolist()], [*times[after - 1].tolist(), end], strict=True)
    return out


def sum_lengths(spans: Iterable[Span]) -> float:
    """s"""
    return sum(end - begin for begin, end in spans)


def are_covered(spans: Iterable[Span], by: list[Span]) -> bool:
    """Whether each span lies within one of others."""
    return all(any(a <= begin and end <= b for a, b in by) for begin, end in spans)


def move_end(spans: list[Span], i: int, side: int, step: int, t: Array) -> list[Span]:
    """Spans with the begin (`side` 0) or the end (1) of one at a later measurement, of those at times t (N,), s.

    Empty where there is none, where it is in another span, or where none is left between begin and end.
    """
    at = int(np.searchsorted(t, spans[i][side] - SAME_TIME)) + step
    if not 0 <= at < len(t):
        return []
    moved = [*spans]
    moved[i] = (float(t[at]), spans[i][1]) if side == 0 else (spans[i][0], float(t[at]))
    begins, ends = np.array(moved).T
    return moved if np.all(begins <= ends) and np.all(begins[1:] > ends[:-1] + SAME_TIME) else []


def list_before(spans: list[Span], t: Array) -> list[Span]:
    """As long before each of some spans, as far as it overlaps none of them and has measurements at times t (N,), s."""
    ends = [-np.inf, *(end for _, end in spans[:-1])]
    before = ((t >= begin - (end - begin)) & (t > e) & (t < begin) for (begin, end), e in zip(spans, ends, strict=True))
    return [(float(t[some][0]), float(t[some][-1])) for some in before if some.any()]


def list_distinct(*candidates: list[Span]) -> list[list[Span]]:
    """Candidates without repetitions and without empty ones."""
    return [list(spans) for spans in dict.fromkeys(tuple(spans) for spans in candidates) if spans]


def extend_to_next_fix(problem: Problem, spans: list[Span], fixes: tuple[str, ...]) -> list[Span]:
    """Spans up to the first keyframe with a fix behind each: an error that begins in a span is corrected there."""
    rows = [c.keyframe for c in problem.constraints if c.name in fixes]
    t = np.append(np.unique(problem.t[np.concatenate(rows)]), problem.t[-1])
    return [(a, max(b, float(t[min(int(np.searchsorted(t, b + SAME_TIME)), len(t) - 1)]))) for a, b in spans]


def trim(spans: list[Span], errors: LeftOutErrors, chance: float = CHANCE) -> list[Span]:
    """Spans without the correct fixes at their ends.

    The tests run forward in time and leave out too much: they date a fault by one of a few onsets, and the fixes after
    it are tested with a filter biased by the fault. Of each span the part with the largest sum of scores is kept, where
    a fix scores half of what its squared error exceeds the limit by, at most the cost of a single outlier.

    Parameters
    ----------
    errors : of the fixes, predicted by a smoother that does not use them.
    chance : that a correct fix exceeds the limit.
    """
    all_t = [t for t, _, _ in errors.values()]
    t, number = np.unique(np.concatenate(all_t), return_inverse=True)
    score = np.full(len(t), -np.inf)
    each = [np.minimum(0.5 * (x - float(chdtri(m, chance))), OUTLIER_COST) for _, x, m in errors.values()]
    np.maximum.at(score, number, np.concatenate(each))  # a fix is wrong if its position or its velocity is
    parts = ((t[within], score[within]) for within in (mask_times(t, [span]) for span in spans))
    return [part for some, scores in parts if (part := _find_best_part(some, scores)) is not None]


def _find_best_part(t: Array, score: Array) -> Span | None:
    """First and last time of the part with the largest sum of scores (N,), if that is positive (Kadane's algorithm)."""
    before = np.concatenate([[0.0], np.cumsum(score)])
    least = np.minimum.accumulate(before)
    end = int(np.argmax(before - least))
    begin = int(np.argmin(before[: end + 1]))
    return (float(t[begin]), float(t[end - 1])) if end > begin else None
