"""Measurements at the ends of excluded spans that are used again.

The tests date a fault by a few fixes, and a slow onset worse. Once its spans are left out, measurements at their ends
that agree with the rest are used again, if that increases the evidence: those that agree by themselves; and of a span
that outlasts the tests, those outside of the segments that are wrong together, because single errors do not date a slow
onset. Two right fixes in such a span contradict the error that the others have in common, and cost more evidence than
the fault may be worth beside another explanation. So at last each of its ends moves from fix to fix, for as long as the
evidence increases. Spans without a fix between them may have one error in common. What changes is decided once more, by
the figures that go with it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from graphnav.core.rotation import Array
from graphnav.estimation.faults.watch import FALSE_ALARM, PATIENCE
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.decision import (
    Decision,
    add_outliers,
    explain,
    list_explanations,
    log_evidence,
    weigh_evidence,
)
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.spans import Span, join, join_adjacent, list_distinct, move_end, trim
from graphnav.estimation.noise.suspects import date_segments, list_fix_times, predict_left_out
from graphnav.estimation.problem import Problem


def readmit(base: Problem, found: NoiseEstimate) -> NoiseEstimate:
    """The estimate with the ends of the spans that it leaves out where the evidence is largest."""
    spans = join(span for some in found.noise.excluded.values() for span in some)
    errors, passes = predict_left_out(apply_noise(base, found.noise), found), Counter(found.passes)
    t, outlast = list_fix_times(base), any(end - begin > PATIENCE for begin, end in spans)
    candidates = [spans, trim(spans, errors, FALSE_ALARM), join_adjacent(spans, t)]
    if outlast:
        candidates.append(date_segments(base, found, spans))
        passes.update(filter=1)
    candidates = list_distinct(*candidates)
    if len(candidates) == 1 and not outlast:
        return replace(found, passes=passes)
    among = list_explanations(found.noise)

    def decide(some: list[Span]) -> Decision:
        decision = explain(base, add_outliers(found, errors, some), some, among)
        passes.update(decision.passes)
        return decision

    decisions = [decide(some) for some in candidates]
    likeliest = int(np.argmax([one.log_evidence for one in decisions]))
    best = _move_ends(decide, candidates[likeliest], decisions[likeliest], t)
    if best is decisions[0]:
        return replace(found, passes=passes)
    again = weigh_evidence(base, estimate_noise(base, None, best.noise, found.get_linearisation(base)))
    passes.update(again.passes)
    if log_evidence(base, again) <= log_evidence(base, found):
        return replace(found, passes=passes)
    return readmit(base, replace(again, passes=passes))


def _move_ends(decide: Callable[[list[Span]], Decision], spans: list[Span], best: Decision, t: Array) -> Decision:
    """The likeliest decision, from one on spans, by moving the ends of those that outlast the tests along the fixes at
    times t (N,), s: inwards, and else outwards."""
    for i in (i for i, (begin, end) in enumerate(spans) if end - begin > PATIENCE):
        for side, inwards in ((0, 1), (1, -1)):
            for step in (inwards, -inwards):
                before = best
                while moved := move_end(spans, i, side, step, t):
                    other = decide(moved)
                    if other.log_evidence <= best.log_evidence:
                        break
                    spans, best = moved, other
                if best is not before:
                    break
    return best
