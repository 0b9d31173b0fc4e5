"""Measurements at the ends of excluded spans that are used again.

The tests date a fault by a few fixes, and a slow onset worse. Once its spans are left out, measurements at their ends
that agree by themselves with the rest are used again, if that increases the evidence. Spans without a fix between them
may have one error in common. What changes is decided once more, by the figures that go with it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from graphnav.estimation.faults.watch import FALSE_ALARM
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.decision import (
    add_outliers,
    explain,
    list_explanations,
    log_evidence,
    weigh_evidence,
)
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.spans import join, join_adjacent, list_distinct, trim
from graphnav.estimation.noise.suspects import list_fix_times, predict_left_out
from graphnav.estimation.problem import Problem


def readmit(base: Problem, found: NoiseEstimate) -> NoiseEstimate:
    """The estimate with the ends of the spans that it leaves out where the evidence is largest."""
    spans = join(span for some in found.noise.excluded.values() for span in some)
    errors, passes = predict_left_out(apply_noise(base, found.noise), found), Counter(found.passes)
    candidates = list_distinct(spans, trim(spans, errors, FALSE_ALARM), join_adjacent(spans, list_fix_times(base)))
    if len(candidates) == 1:
        return found
    among = list_explanations(found.noise)
    decisions = [explain(base, add_outliers(found, errors, some), some, among) for some in candidates]
    passes.update(sum((one.passes for one in decisions), Counter[str]()))
    best = max(decisions, key=lambda one: one.log_evidence)
    if best is decisions[0]:
        return replace(found, passes=passes)
    again = weigh_evidence(base, estimate_noise(base, None, best.noise, found.get_linearisation(base)))
    passes.update(again.passes)
    if log_evidence(base, again) <= log_evidence(base, found):
        return replace(found, passes=passes)
    return readmit(base, replace(again, passes=passes))
