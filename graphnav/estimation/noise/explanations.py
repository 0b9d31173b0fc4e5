"""Fault models of a span: each as a problem of its own, with the likelihood of the measurements."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtri, ndtri  # scipy.stats would take half a second to import

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint, Linearized
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter, States
from graphnav.estimation.faults.watch import FAULT_COST, LARGE, MINUTE, SIZES, is_large
from graphnav.estimation.noise.model import INTERVALS
from graphnav.estimation.noise.moments import compute_expected_squares, predict_errors
from graphnav.estimation.noise.outliers import compute_row_costs
from graphnav.estimation.noise.spans import Span, mask_times
from graphnav.estimation.noise.tails import CHANCE, get_tail_index, weigh_outlying
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import Comparison, refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import ForwardRecord, MomentPass, make_points, split_values
from graphnav.estimation.solvers.rts import smooth_moments
from graphnav.estimation.solvers.stack import Stack
from graphnav.recording import Recording

FIXES, WHEELS = ("gnss_position", "gnss_velocity"), ("nhc", "odometer")
Explanation = tuple[str, ...]  # the constraints whose rows are wrong by it
EXPLANATIONS: tuple[Explanation, ...] = ((), FIXES[:1], FIXES[1:], FIXES, WHEELS, INTERVALS)
ONE_SENSOR = FIXES[:1], FIXES[1:], WHEELS  # faulty as a whole in a span; other sensors may only have outliers there
_UNLIKELY = -float(ndtri(CHANCE))  # sigmas
_NEGLIGIBLE_SIGMA = 1e-9  # sigma of an error outside its span


@dataclass(frozen=True)
class _CommonError(Constraint):
    """Rows of a constraint with an unknown error in common within spans."""

    inner: Any = None
    error: str = ""
    since: Any = None  # (N,) s since the span began

    @property
    def name(self) -> str:  # type: ignore[override]
        return str(self.inner.name)

    @property
    def axes(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(self.inner.axes)

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)

    @classmethod
    def build(cls, scene: BuildContext) -> None:
        return None

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        unknown = parameters[self.error]  # (n, 2 m), at the beginning of the span and growth in a minute
        linear = self.inner.linearize(states, {k: v for k, v in parameters.items() if k != self.error}, rows)
        n, m = linear.residual.shape
        minutes = (self.since[rows] / MINUTE)[:, None]
        J = np.concatenate([np.broadcast_to(np.eye(m), (n, m, m)), minutes[..., None] * np.eye(m)], axis=-1)
        residual = linear.residual + unknown[:, :m] + minutes * unknown[:, m:]
        return Linearized(residual, linear.jacobians | {self.error: J}, linear.sigma)


def add_common_errors(
    problem: Problem, spans: list[Span], kinds: Explanation, grows: bool = True, size: float | None = None
) -> Problem:
    """The problem with one unknown error for each of some constraints in each span (s), which may grow linearly, of a
    size (1-sigma, in units of the rows) as large as faults get when None.
    """
    begins, wide = [float(problem.t[0]) - 1.0], [0.0]
    for a, b in spans:
        begins += [a, b + 2.0 * SAME_TIME]  # a node holds from this much before it
        wide += [1.0, 0.0]

    def add_error(rows: Constraint) -> Constraint:
        if rows.name not in kinds:
            return rows
        name, m = f"{rows.name}_fault", len(rows.axes)
        each = SIZES[rows.unit] if size is None else size
        sigma = np.maximum(np.outer(wide, np.repeat([each, each * grows], m)), _NEGLIGIBLE_SIGMA)
        own = Parameter(name, np.zeros(sigma.shape), sigma, rows.unit, begins=np.array(begins))
        t = problem.t[rows.keyframe]
        return _CommonError(
            keyframe=rows.keyframe,
            parameters=(*rows.parameters, own),
            weight=rows.weight,
            inner=rows,
            error=name,
            since=t - np.array(begins)[np.searchsorted(begins, t + SAME_TIME, side="right") - 1],
        )

    return replace(problem, constraints=tuple(add_error(rows) for rows in problem.constraints))


@dataclass(frozen=True)
class ErrorSizes:
    """How large the errors of single fixes are in M spans, by constraint, and what it costs that this was not known."""

    sigma: Mapping[str, Array]  # (M,) m or m/s
    cost: Mapping[str, Array]  # (M,) of the log-likelihood


def measure_sizes(base: Problem, problem: Problem, smoothed: MomentPass, spans: list[Span]) -> ErrorSizes:
    """Sizes of errors in spans by maximum likelihood, from those of a smoother that does not use the fix.

    With a prior of the logarithm of the size that is uniform between the sigma of the fixes and `SIZES`, the likelihood
    of n numbers integrates to its maximum times sqrt(pi / n) over the width of that prior (Laplace's approximation).
    White errors make fixes less accurate and not wrong. If changes from fix to fix agree with the inertial solution to
    `LARGE` sigmas, the error may as well be that of wheels. Both are given errors as large as faults get.

    Parameters
    ----------
    base, problem : with stated noise, and with the noise model.
    """
    known: dict[str, Array] = {c.name: c.sigma for c in base.constraints if c.name in FIXES}  # type: ignore[attr-defined]
    sigma: dict[str, Array] = {}
    cost: dict[str, Array] = {}
    for rows in problem.constraints:
        if rows.name not in FIXES:
            continue
        t, most = problem.t[rows.keyframe], SIZES[rows.unit]
        error, stated = predict_errors(rows, smoothed)
        sigma[rows.name], cost[rows.name] = np.full(len(spans), most), np.zeros(len(spans))
        for k, span in enumerate(spans):
            own = mask_times(t, [span])
            if own.sum() < 2 or are_white(error[own]):
                continue
            least = float(np.median(np.maximum(stated, known[rows.name])[own]))
            if np.sqrt(0.5 * np.mean(np.diff(error[own], axis=0) ** 2)) < LARGE * least:
                continue
            sigma[rows.name][k] = min(float(np.sqrt(np.mean(error[own] ** 2))), most)
            width = max(np.log(most / least), 1.0)
            cost[rows.name][k] = np.log(width * np.sqrt(error[own].size / np.pi))
    return ErrorSizes(sigma, cost)


def are_white(error: Array) -> bool:
    """Whether errors (N, m) in order are no more alike from one to the next than by chance.

    Of N white numbers the correlation at one step has a variance of 1 / N (Bartlett 1946).
    """
    squares = float(np.sum(error**2))
    alike = float(np.sum(error[1:] * error[:-1])) / squares if squares else 0.0
    return alike * np.sqrt(error[1:].size) <= _UNLIKELY


def add_own_errors(problem: Problem, spans: list[Span], kinds: Explanation, sizes: ErrorSizes) -> Problem:
    """The problem with an unknown error for each row of some constraints in the spans (s), as of a frozen receiver or
    among reflections.
    """

    def widen(rows: Constraint) -> Constraint:
        if rows.name not in kinds:
            return rows
        t = problem.t[rows.keyframe]
        sigma: Array = rows.sigma  # type: ignore[attr-defined]
        weight = np.ones(len(rows)) if rows.weight is None else rows.weight
        for span, size in zip(spans, sizes.sigma[rows.name], strict=True):
            wide = np.min(sigma / np.hypot(sigma, size), axis=1) ** 2
            weight = np.where(mask_times(t, [span]), np.minimum(weight, wide), weight)
        return replace(rows, weight=weight)

    return replace(problem, constraints=tuple(widen(rows) for rows in problem.constraints))


@dataclass(frozen=True)
class PriorCosts:
    """Negative log-probabilities, before the measurements are known."""

    explanations: Array  # (M, len(EXPLANATIONS)) of each in each span
    tails: Mapping[str, float]  # `NoiseModel.tails`


@dataclass
class _Model:
    """A model of all spans by one explanation."""

    kinds: Explanation
    problem: Problem  # without errors in common
    common: Explanation  # the constraints that have one
    likelihood: Array  # (M,) logarithm, of each span by it
    cost: Array  # (M,) negative log-probability beforehand

    @property
    def value(self) -> Array:
        """(M,) log-probability of each span by it, up to a constant."""
        return self.likelihood - self.cost


def compute_evidence(
    problem: Problem,
    about: Points,
    spans: list[Span],
    weighted: Mapping[Explanation, Problem],
    sizes: ErrorSizes,
    costs: PriorCosts,
    among: Collection[Explanation] = EXPLANATIONS,
    least: float = -np.inf,
) -> tuple[float, list[Explanation], int]:
    """Find the most probable explanation of each span, by the likelihood of the innovations.

    Measurements with an error in common may have outliers besides: where the innovations show that these could decide,
    their weights are found by a smoother with that error, by steps of expectation-maximisation, none of which lowers
    the log-probability (Lange, Little and Taylor 1989); not if all that they could gain would leave it below `least`.

    Spans are explained each by itself, up to the start of the next one. Where spans without a measurement between them
    have different explanations, the state at the second is not that of its model, so a filter with all that was chosen
    is compared with the likeliest single explanation of spans in succession.

    Parameters
    ----------
    problem : with its noise model and no fix left out.
    about : points of all keyframes.
    spans : s, first and last wrong fix, in order and apart.
    weighted : by explanation, the problem with the weights of rows and intervals that go with it.
    sizes : of errors that are of one fix each.
    among : explanations to evaluate besides that nothing is wrong.
    least : log-probability below which the decision does not matter.

    Returns
    -------
    float
        Log-probability of all measurements and the explanations, up to a constant.
    list of Explanation
        Of each span.
    int
        Filter passes.
    """
    trials, before = Trials(problem, about, spans), 0.0
    models: list[_Model] = []
    common: list[tuple[_Model, Array]] = []
    present = {rows.name for rows in problem.constraints}
    for j, kinds in enumerate(EXPLANATIONS):
        possible = present & set(kinds) if kinds == WHEELS else kinds == INTERVALS or present.issuperset(kinds)
        if not possible or (kinds and kinds not in among):
            continue
        base, cost = weighted.get(kinds, problem), costs.explanations[:, j]
        if not kinds or kinds == INTERVALS:
            likelihood = trials.filter(base).log_likelihood()
            models.append(_Model(kinds, base, (), trials.sum_spans(likelihood), cost))
            before = before if kinds else float(np.sum(likelihood[: trials.edges[0]]))
            continue
        stack = trials.filter(add_common_errors(base, spans, kinds), kinds)
        models.append(_Model(kinds, base, kinds, trials.sum_spans(stack.log_likelihood()), cost))
        common.append((models[-1], trials.sum_spans(_bound_gain(stack, kinds, costs.tails))))
        if set(kinds) <= set(FIXES):
            one = add_own_errors(base, spans, kinds, sizes)
            more = np.sum([sizes.cost[name] for name in kinds], axis=0)
            models.append(_Model(kinds, one, (), trials.sum_spans(trials.filter(one).log_likelihood()), cost + more))
    highest = np.max([one.value for one in models] + [model.value + gain for model, gain in common], axis=0)
    for model, gain in common if before + float(np.sum(highest)) > least else ():
        forward: ForwardRecord | None = None
        while np.any((gain > FAULT_COST) & (model.value + gain > np.max([one.value for one in models], axis=0))):
            forward = forward or trials.filter_about(model.problem, model.kinds)
            base, more = trials.weigh_outliers(model.problem, model.kinds, forward, costs.tails)
            forward = trials.filter_about(base, model.kinds)
            cost = costs.explanations[:, EXPLANATIONS.index(model.kinds)] + more
            likelihood = trials.sum_spans(forward.log_likelihood)
            previous, model = model, _Model(model.kinds, base, model.common, likelihood, cost)
            gain = np.subtract(model.value, previous.value, out=0.0 * gain, where=np.isfinite(model.value))  # ever less
            models.append(model)
    value, chosen = trials.choose(models)
    return before + value, chosen, trials.passes


class Trials:
    """Filters of a drive by several models with the same linearisation points, and how many passes were made.

    Parameters
    ----------
    problem, about, spans : as for `compute_evidence`.
    """

    def __init__(self, problem: Problem, about: Points, spans: list[Span]) -> None:
        self.edges = np.append(np.searchsorted(problem.t, [begin - SAME_TIME for begin, _ in spans]), len(problem.t))
        self.passes = 0
        self._problem, self._spans = problem, spans
        self._states, self._known = about.states, split_values(problem, about)
        self._comparison = Comparison(problem, about)

    def filter(self, problem: Problem, anew: Explanation = ()) -> Stack:
        """The innovations of a model; `anew` are the constraints of which the rows differ."""
        self.passes += 1
        return self._comparison.filter(problem, self._make_points(problem), anew)

    def sum_spans(self, each: Array) -> Array:
        """(M,) sums of what keyframes (K,) have, from the start of each span to the start of the next."""
        return np.array([float(np.sum(each[a:b])) for a, b in itertools.pairwise(self.edges)])

    def filter_about(self, problem: Problem, kinds: Explanation) -> ForwardRecord:
        """The filter of a problem with an error in common of some constraints, for a smoother."""
        self.passes += 1
        common = add_common_errors(problem, self._spans, kinds)
        return refilter(common, self._make_points(common), whole=False)

    def weigh_outliers(
        self, problem: Problem, kinds: Explanation, forward: ForwardRecord, tails: Mapping[str, float]
    ) -> tuple[Problem, Array]:
        """The problem with weights for outliers among rows of some constraints, and what these cost in each span (M,):
        infinite where the error in common of fixes is not large, which is no fault, however certain.

        `forward` : of `filter_about`.
        """
        common = add_common_errors(problem, self._spans, kinds)
        smoothed, weighted = smooth_moments(common, forward), []
        for rows, wrong in zip(problem.constraints, common.constraints, strict=True):
            if rows.name in kinds:
                t, m = problem.t[rows.keyframe], len(rows.axes)
                index = get_tail_index(tails, rows.name, m)
                squared = compute_expected_squares(smoothed.take_rows(wrong))
                weight = np.ones(len(rows)) if rows.weight is None else rows.weight
                weight = np.where(mask_times(t, self._spans), weigh_outlying(squared, m, index), weight)
                rows = replace(rows, weight=weight)
            weighted.append(rows)
        problem = replace(problem, constraints=tuple(weighted))
        each = compute_row_costs(problem, tails, without={rows.name for rows in problem.constraints} - set(kinds))
        cost = np.array([np.sum(each[mask_times(problem.t, [span])]) for span in self._spans])
        return problem, np.where(self._list_large(kinds, split_values(common, smoothed)), cost, np.inf)

    def _list_large(self, kinds: Explanation, values: Mapping[str, Array]) -> Array:
        """(M,) in which spans the error in common of fixes is large, by its values (K, 2 m); of wheels, in all."""
        fixes = [rows for rows in self._problem.constraints if rows.name in kinds and rows.fix_of]
        out = np.full(len(self._spans), not fixes)
        for k, (begin, end) in enumerate(self._spans):
            inside = mask_times(self._problem.t, [(begin, end)])
            speed = float(np.median(np.linalg.norm(self._states.v[inside], axis=1)))
            for rows in fixes:
                error, growth = np.split(values[f"{rows.name}_fault"][inside][0], 2)
                out[k] |= any(is_large(error + dt / MINUTE * growth, rows, speed) for dt in (0.0, end - begin))
        return out

    def choose(self, models: list[_Model]) -> tuple[float, list[Explanation]]:
        """The most probable explanation of each span, and the log-probability of all together, up to a constant."""
        values = np.array([one.value for one in models])
        each = [models[i] for i in np.argmax(values, axis=0)]
        chosen, runs = [one.kinds for one in each], self._list_runs()
        if INTERVALS in chosen or all(len(set(chosen[run])) == 1 for run in runs):
            return float(np.sum(np.max(values, axis=0))), chosen
        likelihood = self.filter(*self._combine(each)).log_likelihood()[self.edges[0] :]
        together = float(np.sum(likelihood)) - sum(float(one.cost[k]) for k, one in enumerate(each))
        alike = [models[int(np.argmax(values[:, run].sum(axis=1)))] for run in runs]
        single = sum(float(one.value[run].sum()) for one, run in zip(alike, runs, strict=True))
        if together >= single:
            return together, chosen
        return single, [one.kinds for one, run in zip(alike, runs, strict=True) for _ in each[run]]

    def _list_runs(self) -> list[slice]:
        """Spans in succession without a fix between one and the next."""
        fixes = [c.keyframe for c in self._problem.constraints if c.name in FIXES]
        t, spans = self._problem.t[np.unique(np.concatenate(fixes))], np.array(self._spans)
        begins = np.searchsorted(t, spans[:, 0] - SAME_TIME)
        ends = np.searchsorted(t, spans[:, 1] + SAME_TIME)
        first = np.flatnonzero(np.append(True, begins[1:] > ends[:-1]))
        return [slice(a, b) for a, b in itertools.pairwise([*first.tolist(), len(self._spans)])]

    def _combine(self, each: list[_Model]) -> tuple[Problem, Explanation]:
        """The problem with a model for each span, and the constraints that have errors in common."""
        weighted = []
        for i, rows in enumerate(self._problem.constraints):
            t = self._problem.t[rows.keyframe]
            weight = np.ones(len(rows)) if rows.weight is None else rows.weight.copy()
            for one, span in zip(each, self._spans, strict=True):
                other, inside = one.problem.constraints[i].weight, mask_times(t, [span])
                weight[inside] = 1.0 if other is None else other[inside]
            weighted.append(replace(rows, weight=weight))
        problem = replace(self._problem, constraints=tuple(weighted))
        names = tuple(dict.fromkeys(name for one in each for name in one.common))
        for name in names:
            own = [span for one, span in zip(each, self._spans, strict=True) if name in one.common]
            problem = add_common_errors(problem, own, (name,))
        return problem, names

    def _make_points(self, problem: Problem) -> Points:
        return make_points(problem, self._states, self._known)


def _bound_gain(stack: Stack, kinds: Explanation, tails: Mapping[str, float]) -> Array:
    """(K,) by which the log-probability rises at each keyframe if what exceeds the limit of chance is due to outliers.

    Of successive keyframes that exceed it, the first has the outlier, and the others may be what it did to the state:
    without it, they have the squares that are expected. Its density is that of tails instead of a Gaussian.
    """
    squared, count = stack.sum_squares()
    limit = chdtri(np.maximum(count, 1), CHANCE)
    gain = np.where(squared > limit, 0.5 * (squared - count), 0.0)
    places = {name: stack.places[name] for name in kinds if name in stack.places}
    measured = np.isin(np.arange(stack.K), np.concatenate([k[:, 0] for k, _ in places.values()]))
    least = min(get_tail_index(tails, name, p.shape[1]) + p.shape[1] for name, (_, p) in places.items())
    first = (gain > 0.0) & ~np.append(False, gain[:-1] > 0.0)
    own = np.maximum(0.5 * (squared - least - least * np.log(np.maximum(squared / least, 1.0))), 0.0)
    return np.where(first, np.where(measured, own, 0.0), gain)
