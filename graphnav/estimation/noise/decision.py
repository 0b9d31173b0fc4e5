"""Decision between fault models of spans of measurements, by their evidence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.estimation.faults.watch import FAULT_COST
from graphnav.estimation.noise.apply import apply_noise, apply_weights
from graphnav.estimation.noise.estimate import NoiseEstimate
from graphnav.estimation.noise.explanations import (
    EXPLANATIONS,
    FIXES,
    ONE_SENSOR,
    WHEELS,
    Explanation,
    PriorCosts,
    compute_evidence,
    measure_sizes,
)
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, RowWeights
from graphnav.estimation.noise.outliers import (
    compute_interval_cost,
    compute_latest_cost,
    compute_row_costs,
    count_reduced,
)
from graphnav.estimation.noise.spans import LeftOutErrors, Span, drop_within, extend_to_next_fix, join, mask_times
from graphnav.estimation.noise.tails import get_tail_index, weigh_outlying
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import refilter


@dataclass(frozen=True)
class Decision:
    """A noise model with what it leaves out, and the evidence of all measurements."""

    noise: NoiseModel
    log_evidence: float
    passes: Counter[str] = field(default_factory=Counter)
    estimate: NoiseEstimate | None = None  # without what is suspected, by whose figures it is; with this noise, where
    # nothing is left out


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
    # weights inside the spans, by explanation: where one sensor is wrong, the others keep theirs
    inside: dict[Explanation, dict[str, RowWeights]] = {
        kinds: {name: some for name, some in noise.weights.items() if name not in (*kinds, *INTERVALS)}
        for kinds in ((), *ONE_SENSOR, FIXES)
    }
    used = apply_noise(base, replace(noise, weights=outside))
    weighted = {kinds: apply_weights(used, outside | some) for kinds, some in inside.items()}
    within = [mask_times(base.t, [span]) for span in spans]
    disturbed = np.zeros(len(spans))  # cost of disturbed intervals
    for name in INTERVALS:
        if (some := noise.weights.get(name)) is not None:
            latest = compute_latest_cost(some, len(base.t) - 1)
            disturbed += [latest * (count_reduced(some) - count_reduced(drop_within(some, [span]))) for span in reach]
    among = [kinds for kinds in among if kinds != INTERVALS or disturbed.any()]
    cost = np.empty((len(spans), len(EXPLANATIONS)))
    for j, kinds in enumerate(EXPLANATIONS):
        by_rows = () if kinds == INTERVALS else kinds  # a sensor that is wrong has an error of its own instead of tails
        each = compute_row_costs(weighted[by_rows], noise.tails, without=by_rows)
        cost[:, j] = [np.sum(each[span]) for span in within]
        cost[:, j] += np.where(disturbed > 0.0, disturbed, np.inf) if kinds == INTERVALS else FAULT_COST * bool(kinds)
    inside[INTERVALS] = dict(noise.weights)
    if INTERVALS in among:
        weighted[INTERVALS] = apply_noise(base, noise)
    sizes = measure_sizes(base, apply_noise(base, found.noise), found.points, spans)
    about, costs = found.carry_points(base, used), PriorCosts(cost, noise.tails)
    anywhere = np.any(within, axis=0)
    rest = found.log_prior - float(np.sum(compute_row_costs(used, noise.tails)[~anywhere]))
    rest -= compute_interval_cost(outside, len(base.t) - 1)
    evidence, chosen, passes = compute_evidence(used, about, spans, weighted, sizes, costs, among, least - rest)
    excluded: dict[str, tuple[Span, ...]] = {}
    dropped: dict[str, list[Span]] = {name: [] for name in noise.weights}
    for span, to_next, best in zip(spans, reach, chosen, strict=True):
        for name in noise.weights.keys() - inside[best].keys():
            dropped[name].append(to_next if name in INTERVALS else span)
        if best != INTERVALS:
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


def weigh_rest(base: Problem, found: NoiseEstimate, excluded: Mapping[str, tuple[Span, ...]]) -> float:
    """The logarithm of the evidence of the measurements outside some spans, by the figures found."""
    noise = replace(found.noise, excluded=excluded)
    used = apply_noise(base, noise)
    forward = refilter(used, found.carry_points(base, used), whole=False)
    costs = float(np.sum(compute_row_costs(used, noise.tails))) + compute_interval_cost(noise.weights, len(used.t) - 1)
    return float(np.sum(forward.log_likelihood)) + found.log_prior - costs


def add_outliers(found: NoiseEstimate, errors: LeftOutErrors, spans: list[Span]) -> NoiseEstimate:
    """The estimate with weights for fixes in spans, and for all that it leaves out, so that each may be an outlier: a
    single one behind a fault, used as if it were Gaussian, would cost more evidence than the fault.
    """
    weights = dict(found.noise.weights)
    for name, (t, squared, m) in errors.items():
        asked = [*spans, *found.noise.excluded.get(name, ())]
        weight = weigh_outlying(squared, m, get_tail_index(found.noise.tails, name, m))
        kept = drop_within(weights.get(name, RowWeights(np.empty(0), np.empty(0))), asked)
        inside = mask_times(t, asked) & np.isin(t, t[weight < 1.0])  # with all rows of their times
        both, of_both = np.concatenate([kept.t, t[inside]]), np.concatenate([kept.weight, weight[inside]])
        order = np.argsort(both, kind="stable")
        weights[name] = RowWeights(both[order], of_both[order])
    return replace(found, noise=replace(found.noise, weights=weights))
