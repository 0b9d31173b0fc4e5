"""Other sets of fixes that may be wrong: compared with what is left out, and how likely each of them is.

Where fixes step from one place to another, either part of them may be wrong, and nothing that is measured tells which
(`graphnav.estimation.faults.segments`); or the IMU lost samples in between. So in the end the spans that are left out
and the disturbed intervals of the accelerometer divide the drive into segments, and all sets of these are compared by
the same figures, with what stands. The likeliest is left out. Sets that are not much less likely are its rivals:
evidence of less than 20 to 1 is not strong (Kass and Raftery 1995, "Bayes factors").

Sets have errors in common, and what stands may be likelier by outliers or by errors of each fix. Outliers tell nothing
of which part is right, so its complement is compared by errors in common of both. Where each fix of a span has an error
of its own, that is what is wrong with it, and no error of all others takes its place.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import chdtri

from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.estimation.faults.segments import compare_wrong_segments
from graphnav.estimation.faults.watch import FAULT_COST
from graphnav.estimation.noise.apply import apply_noise, select_weights
from graphnav.estimation.noise.decision import add_outliers, log_evidence
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.noise.explanations import FIXES, add_own_errors, measure_sizes
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, Rival
from graphnav.estimation.noise.moments import predict_errors
from graphnav.estimation.noise.outliers import compute_interval_cost, compute_row_costs
from graphnav.estimation.noise.spans import LeftOutErrors, Span, drop_within, join_adjacent, mask_times
from graphnav.estimation.noise.suspects import list_fix_times
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import MomentPass, reuse_points
from graphnav.estimation.solvers.rts import smooth_moments

_STRONG = 20.0  # odds
_ACCEL = "imu.accel_noise_density"
_JUMPS = 8  # disturbed intervals at most, at which fixes may step: sets of segments grow as the square of their number
_NEAR = 5  # fixes, the median of whose errors is what is not of one of them alone

_Spans = Mapping[str, tuple[Span, ...]]  # s, by constraint


@dataclass(frozen=True)
class _Weighed:
    """Sets of fixes that may be wrong, by which of them (`_mark`): the logarithm of the evidence, their spans, and
    whether their errors are large."""

    standing: bytes
    sets: dict[bytes, tuple[float, _Spans, bool]]
    passes: int  # of the filter

    def find_likeliest(self) -> bytes:
        """Of the sets whose errors are large, and what stands."""
        return max(self.sets, key=lambda one: self.sets[one][0] if self.sets[one][2] else -np.inf)


def is_complement(one: bytes, other: bytes) -> bool:
    """Whether a set has, of each kind of fixes of which some are in another, those that are not in that."""
    a, b = (np.frombuffer(some, dtype=bool).reshape(len(FIXES), -1) for some in (one, other))
    return bool(np.all((a ^ b) | ~np.any(a | b, axis=1, keepdims=True)))


def choose_likeliest(base: Problem, found: NoiseEstimate) -> NoiseEstimate:
    """The estimate, or one without other spans of fixes, if these are likelier wrong.

    Parameters
    ----------
    base : built with stated noise and the parts of its intervals' noise.
    found : as decided so far.
    """
    edges = _list_edges(base, found)
    if not edges:
        return found
    weighed = _weigh(base, found, edges)
    passes, likeliest = found.passes + Counter(filter=weighed.passes), weighed.find_likeliest()
    if likeliest != weighed.standing:
        before, spans, _ = weighed.sets[likeliest]
        start = exclude(found.noise, spans, list_fix_times(base))
        near = reuse_points(*found.get_linearisation(base), apply_noise(base, start))
        intervals = any(len(some.t) for name, some in start.weights.items() if name in INTERVALS)
        with contextlib.suppress(*BREAKDOWN):
            # those found are of more measurements, unless these contradicted each other
            known = replace(found, noise=start, points=_smooth(apply_noise(base, start), near), whole_evidence=before)
            other = estimate_noise(base, None, start, known.get_linearisation(base), intervals=intervals)
            again = _weigh(base, other, edges)
            passes = passes + other.passes + Counter(filter=1 + again.passes, smoother=1)
            evidence = again.sets[likeliest][0] if again.find_likeliest() == likeliest else -np.inf
            found = replace(other, whole_evidence=evidence) if evidence > before else known
    return replace(found, passes=passes)


def find_rivals(base: Problem, found: NoiseEstimate) -> tuple[tuple[Rival, ...], int]:
    """The rivals of what an estimate leaves out, the likeliest first, and filter passes.

    Parameters
    ----------
    base : built with stated noise and the parts of its intervals' noise.
    """
    edges = _list_edges(base, found)
    if not edges:
        return (), 0
    weighed = _weigh(base, found, edges)
    some = {
        key: one
        for key, one in weighed.sets.items()
        if one[2] or is_complement(key, weighed.standing)  # of which the errors are the same
    }
    most = max(evidence for evidence, _, _ in some.values())
    odds = {key: float(np.exp(evidence - most)) for key, (evidence, _, _) in some.items()}
    total = sum(odds.values())
    rivals = [
        Rival(odds[key] / total, spans)
        for key, (_, spans, _) in some.items()
        if key != weighed.standing and odds[key] * _STRONG > odds[weighed.standing]
    ]
    return tuple(sorted(rivals, key=lambda one: -one.probability)), weighed.passes


def exclude(noise: NoiseModel, spans: _Spans, t: Array) -> NoiseModel:
    """A noise model that excludes other spans of fixes, without the noise of intervals that would explain these.

    Parameters
    ----------
    spans : s, by constraint.
    t : (N,) s, of the fixes.
    """
    kept = {name: some for name, some in noise.excluded.items() if name not in FIXES}
    weighted = {name: some for name, some in noise.span_weights.items() if name not in FIXES}
    at = _list_ends(t, [span for some in spans.values() for span in some])
    return replace(_drop_jumps(noise, t, at), excluded=kept | dict(spans), span_weights=weighted, rivals=())


def _smooth(problem: Problem, about: Points) -> MomentPass:
    return smooth_moments(problem, refilter(problem, about, whole=False))


def _list_edges(base: Problem, found: NoiseEstimate) -> list[float]:
    """Where one segment ends and the next begins, s: at spans of fixes that are left out, and where the accelerometer
    is disturbed so much that the position may jump by the error of a fix. None without either."""
    fixes = [rows for rows in base.constraints if rows.name in FIXES]
    if not fixes:
        return []
    t = list_fix_times(base)
    at = _list_ends(t, [span for name in FIXES for span in found.noise.excluded.get(name, ())])
    if fixes[0].name == FIXES[0]:
        weight, T = select_weights(base.t[1:], found.noise, INTERVALS[1]), base.intervals.T
        density = base.imu_noise.accel_noise_density * np.sqrt(found.noise.get_factor(_ACCEL, 1.0))
        moved = density * np.sqrt(T**3 / (3.0 * weight))  # 1-sigma, of white noise that is integrated twice
        jumps = np.flatnonzero(moved > np.min(fixes[0].compute_typical_error()))
        most = jumps[np.argsort(-moved[jumps])[:_JUMPS]]
        at |= set(np.searchsorted(t, base.t[1:][most] - SAME_TIME).tolist())
    inner = sorted(at - {0, len(t)})
    return t[[0, *inner]].tolist() if inner else []


def _weigh(base: Problem, found: NoiseEstimate, edges: list[float]) -> _Weighed:
    """All sets of segments, by the figures of an estimate."""
    t = list_fix_times(base)
    noise = add_outliers(found, _measure_single_errors(base, found), []).noise  # among what is left out, there are none
    noise = _drop_jumps(exclude(noise, {}, t), t, np.searchsorted(t, edges).tolist())
    used = apply_noise(base, noise)
    likelihood, sets = compare_wrong_segments(used, found.carry_points(base, used), edges, FIXES)
    costs = float(np.sum(compute_row_costs(used, noise.tails))) + compute_interval_cost(noise.weights, len(base.t) - 1)
    least, standing = likelihood + found.log_prior - costs, _mark(t, found.noise.excluded)
    weighed: dict[bytes, tuple[float, _Spans, bool]] = {}
    for one in sets:
        key = _mark(t, one.spans)
        evidence, _, large = weighed.get(key, (-np.inf, {}, key == standing))
        spans = {name: tuple(join_adjacent(list(each), t)) for name, each in one.spans.items()}
        weighed[key] = float(np.logaddexp(evidence, least + one.log_odds)), spans, large or one.large
    spans = {name: each for name, each in found.noise.excluded.items() if name in FIXES and each}
    if not spans:
        weighed[standing] = found.log_evidence, spans, True  # with its disturbed intervals
        return _Weighed(standing, weighed, 1)
    alike = weighed[standing][0] if standing in weighed else -np.inf  # with an error in common in each span
    alike = max(alike, least + _weigh_own_errors(base, used, found, spans) - likelihood)
    # where wheels are left out as well, the evidence of all measurements is of more than that of the sets
    most = alike if any(noise.excluded.values()) else max(alike, log_evidence(base, found))
    for key, (evidence, each, large) in weighed.items():
        if is_complement(key, standing):  # whatever is more for what stands is of how its errors are modelled
            weighed[key] = evidence + most - alike, each, large
    weighed[standing] = most, spans, True
    return _Weighed(standing, weighed, 2)


def _weigh_own_errors(base: Problem, used: Problem, found: NoiseEstimate, spans: _Spans) -> float:
    """The log-likelihood of all measurements, less its costs, if each fix in the spans of an estimate has an error of
    its own: then the others cannot be wrong instead, by an error in common."""
    cost = 0.0
    for name, some in spans.items():
        sizes = measure_sizes(base, apply_noise(base, found.noise), found.points, list(some))
        used = add_own_errors(used, list(some), (name,), sizes)
        cost += float(np.sum(sizes.cost[name])) + FAULT_COST * len(some)
    return float(np.sum(refilter(used, found.carry_points(base, used), whole=False).log_likelihood)) - cost


def _mark(t: Array, spans: _Spans) -> bytes:
    """Which of the fixes at times t (N,), s, lie in spans, by constraint."""
    return b"".join(mask_times(t, spans.get(name, ())).tobytes() for name in FIXES)


def _list_ends(t: Array, spans: Sequence[Span]) -> set[int]:
    """Which of the fixes at times t (N,), s, are the first in a span, or behind one: N where none is."""
    begins, ends = (np.array([span[i] for span in spans]) for i in (0, 1))
    return {*np.searchsorted(t, begins - SAME_TIME).tolist(), *np.searchsorted(t, ends + SAME_TIME).tolist()}


def _drop_jumps(noise: NoiseModel, t: Array, at: Iterable[int]) -> NoiseModel:
    """The noise model with the usual noise in the intervals that end at fixes, of those at times t (N,), s, or since
    the fix before."""
    before = [(float(t[i - 1]) + 2.0 * SAME_TIME, float(t[i])) for i in at if 0 < i < len(t)]
    weights = {name: drop_within(some, before) if name in INTERVALS else some for name, some in noise.weights.items()}
    return replace(noise, weights=weights)


def _measure_single_errors(base: Problem, found: NoiseEstimate) -> LeftOutErrors:
    """Squares of what fixes are off besides those next to them."""
    out, used = {}, apply_noise(base, found.noise)
    for rows in used.constraints:
        if rows.name in FIXES:
            error, sigma = predict_errors(rows, found.points)
            alone = (error - median_filter(error, (_NEAR, 1), mode="nearest")) / sigma
            squared, m = np.sum(alone**2, axis=1), len(rows.axes)
            usual = float(np.median(squared)) / float(chdtri(m, 0.5))
            out[rows.name] = used.t[rows.keyframe], squared / max(usual, 1.0), m
    return out
