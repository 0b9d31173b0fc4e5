"""Decision between fault models of spans of measurements, by their evidence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.estimation.faults.watch import FAULT_COST
from graphnav.estimation.noise.apply import apply_noise, apply_weights
from graphnav.estimation.noise.estimate import NoiseEstimate
from graphnav.estimation.noise.explanations import (
    EXPLANATIONS,
    FIXES,
    ONE_SENSOR,
    ROWS,
    WHEELS,
    Explanation,
    PriorCosts,
    compute_evidence,
    measure_sizes,
)
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, RowWeights
from graphnav.estimation.noise.outliers import (
    OUTLIER_COST,
    compute_latest_cost,
    compute_outlier_cost,
    count_reduced,
    count_rows,
)
from graphnav.estimation.noise.spans import Span, drop_within, extend_to_next_fix, join
from graphnav.estimation.problem import Problem

_BY_ROWS = INTERVALS, ROWS  # explanations by outliers, for which nothing is left out


@dataclass(frozen=True)
class Decision:
    """A noise model with what it leaves out, and the evidence of all measurements."""

    noise: NoiseModel
    log_evidence: float
    passes: Counter[str] = field(default_factory=Counter)
    estimate: NoiseEstimate | None = None  # with this noise, where nothing is left out but figures were estimated again
    rival: Decision | None = None  # the likeliest by spans as the tests found them, if this one is by segments


def explain(
    base: Problem,
    found: NoiseEstimate,
    spans: list[Span],
    among: Collection[Explanation] = EXPLANATIONS,
    least: float = -np.inf,
) -> Decision:
    """Choose the most probable fault model of each span.

    Parameters
    ----------
    found : the figures, and weights of rows.
    among : explanations to compare with that nothing is wrong.
    least : evidence that other decisions have; one that cannot reach it is not refined.
    """
    if not spans:
        return Decision(found.noise, found.log_evidence)
    noise = replace(found.noise, excluded={})
    reach = extend_to_next_fix(base, spans, FIXES)
    outside = {name: drop_within(some, reach if name in INTERVALS else spans) for name, some in noise.weights.items()}
    # weights inside the spans, by explanation: where one sensor is wrong, the others keep their outliers
    inside: dict[Explanation, dict[str, RowWeights]] = {
        kinds: {name: some for name, some in noise.weights.items() if name not in (*kinds, *INTERVALS)}
        for kinds in (*ONE_SENSOR, ROWS)
    }
    inside[INTERVALS] = {name: some for name, some in noise.weights.items() if name in INTERVALS}
    used = apply_noise(base, replace(noise, weights=outside))
    totals = count_rows(base)
    each = {name: compute_latest_cost(some, totals[name]) for name, some in noise.weights.items() if name in totals}
    outliers = {
        kinds: [
            sum(
                each[name] * (count_reduced(one) - count_reduced(drop_within(one, [within])))
                for name, one in some.items()
                if name in each
            )
            for within in (reach if kinds == INTERVALS else spans)
        ]
        for kinds, some in inside.items()
    }
    among = [kinds for kinds in among if kinds not in _BY_ROWS or any(outliers[kinds])]
    weighted: dict[Explanation, Problem] = {
        kinds: apply_weights(used, outside | inside[kinds]) for kinds in (*ONE_SENSOR, ROWS)
    }
    if INTERVALS in among:
        weighted[INTERVALS] = apply_noise(base, replace(noise, weights=outside | inside[INTERVALS]))
    sizes = measure_sizes(base, apply_noise(base, found.noise), found.points, spans)
    cost = np.zeros((len(spans), len(EXPLANATIONS)))
    cost[:, [bool(kinds) and kinds not in _BY_ROWS for kinds in EXPLANATIONS]] = FAULT_COST
    for kinds, more in outliers.items():
        some = np.array(more)
        cost[:, EXPLANATIONS.index(kinds)] += np.where((some > 0.0) | (kinds not in _BY_ROWS), some, np.inf)
    about, costs = found.carry_points(base, used), PriorCosts(cost, dict.fromkeys(totals, OUTLIER_COST) | each)
    rest = found.log_prior - compute_outlier_cost(outside, totals)
    evidence, chosen, passes = compute_evidence(used, about, spans, weighted, sizes, costs, among, least - rest)
    excluded: dict[str, tuple[Span, ...]] = {}
    dropped: dict[str, list[Span]] = {name: [] for name in noise.weights}
    for span, to_next, best in zip(spans, reach, chosen, strict=True):
        for name in noise.weights.keys() - inside.get(best, {}).keys():
            dropped[name].append(to_next if name in INTERVALS else span)
        if best not in _BY_ROWS:
            excluded |= {name: (*excluded.get(name, ()), span) for name in best}
    present = {rows.name for rows in base.constraints}
    excluded = {name: some for name, some in excluded.items() if name in present}
    weights = {name: drop_within(some, dropped[name]) for name, some in noise.weights.items()}
    noise = replace(noise, weights=weights, excluded=excluded)
    return Decision(noise, evidence + rest, Counter(filter=passes))


def list_explanations(noise: NoiseModel) -> set[Explanation]:
    """The explanations by which a noise model leaves spans out."""
    found = set[Explanation]()
    for span in {span for some in noise.excluded.values() for span in some}:
        names = {name for name, some in noise.excluded.items() if span in some}
        found.add(WHEELS if names & set(WHEELS) else tuple(name for name in FIXES if name in names))
    return found


def weigh_evidence(base: Problem, found: NoiseEstimate) -> NoiseEstimate:
    """The estimate with the evidence of all measurements, excluded ones included, and the passes that this takes."""
    if found.whole_evidence is not None:
        return found
    spans = join(span for some in found.noise.excluded.values() for span in some)
    whole = explain(base, found, spans, list_explanations(found.noise))
    return replace(found, whole_evidence=whole.log_evidence, passes=found.passes + whole.passes)


def log_evidence(base: Problem, found: NoiseEstimate) -> float:
    """The logarithm of the evidence that `weigh_evidence` finds."""
    evidence = weigh_evidence(base, found).whole_evidence
    assert evidence is not None
    return evidence
