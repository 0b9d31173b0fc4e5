"""Which segments of a drive have wrong fixes: all sets of them, compared by one pass of the filter.

The tests (`graphnav.estimation.faults.watch`) tell when fixes begin to disagree with everything else. A filter follows
an error that lasts, so the end of a fault looks like the beginning of another, and either of the segments between may
be the wrong one. Within a segment, the fixes of a kind have an unknown error b that stays and one that grows. The
innovations of a linear filter respond to all of them by G b, and are otherwise white, so that with

    score s = sum G^T S^-1 nu      info I = sum G^T S^-1 G

over the whole drive, and W the prior sizes of errors, the evidence of a set A of wrong segments, beside none, is

    s_A^T (W^-2 + I_A)^-1 s_A / 2 - ln |1 + W I_A W| / 2

(Willsky and Jones 1976 for G; MacKay 1992, "Bayesian interpolation"). A run of segments may have one error in common:
columns of G are then summed. Sets are found by forward selection, the likeliest few of each size; each choice leaves
the others what is left of s and I when its errors are known as well as they are. An error that is not large
(`watch.LARGE`) is no fault, however certain.

Which part is right. That all fixes of one part are off by an error that stays is as likely, whatever is measured, as
that all others are off by its opposite: nothing but fixes tells where a vehicle is. Then the prior alone decides. Let
faults last longer than L with the probability S(L). One that is in progress at the start and goes on for L is as
probable beforehand as one that begins later and has not ended after L: both are proportional to S(L) (a renewal process
in its steady state; Cox 1962, "Renewal theory"). Faults end at rates that differ, as those of reflections and those of
a base station; with a Gamma distribution of the rate, S(L) = (1 + L / s)^-a. Here a = 2, the least whole number by
which their mean duration s / (a - 1) is finite, and that is a minute (`watch.MINUTE`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphnav.constraints.base import Constraint
from graphnav.core.compiled import compile_once
from graphnav.core.rotation import Array
from graphnav.estimation.faults.likelihood_ratio import respond
from graphnav.estimation.faults.watch import FAULT_COST, MINUTE, SIZES, is_large
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import ForwardRecord
from graphnav.estimation.solvers.recursion import move_columns

_TOGETHER = 128  # rows whose squares are summed at once
_BEAM = 8  # sets of segments that are followed: the likeliest single one need not be among the likeliest two


@dataclass(frozen=True)
class _Set:
    """A set of wrong runs, and what is left of score and info of the other runs when its errors are known so far."""

    chosen: frozenset[tuple[int, int]]  # number of each run and of the kinds of fixes that are wrong in it
    log_odds: float  # beside nothing being wrong
    runs: Array  # (J,) that share no segment with it
    score: Array  # (J, C)
    info: Array  # (J, C, C)
    taken: tuple[Array, ...]  # (M+1, C, c) of each choice: X X^T is what it took of the info of sums before segments


class _Runs:
    """All runs of consecutive segments, each with one error in common; C numbers of all kinds.

    Parameters
    ----------
    begins : (M,) s, of the segments.
    units : of each kind of fixes.
    m : numbers of a fix.
    score, info : (M, C) and (M, C, M, C) of the errors of all segments.
    end : s, of the last segment, where it may be wrong too, an error may stay without growing, and long faults are less
        probable. Else it is of no run: an error of which the end is not seen may as well be a step to what is right.
    """

    def __init__(
        self, begins: Array, units: list[str], m: int, score: Array, info: Array, end: float | None = None
    ) -> None:
        first, last = np.triu_indices(len(begins) - (end is None))
        self.first, self.behind, C = first, last + 1, 2 * m * len(units)
        # an error b that stays and one g that grows by the minute since a run began, by those since the first segment
        minutes = (begins[first] - begins[0]) / MINUTE
        size = np.concatenate([np.full(2 * m, SIZES[unit]) for unit in units])
        self.shift = np.zeros((len(first), C, C))
        self.shift[:] = np.diag(size)
        for one in range(0, C, 2 * m):
            for i in range(one, one + m):
                self.shift[:, i, i + m] = -minutes * size[i + m]
        each = [np.arange(2 * m * i, 2 * m * (i + 1)) for i in range(len(units))]
        self.kinds = [np.arange(C), *each] if len(units) > 1 else each
        self.cost, self.to_end = np.full(len(first), FAULT_COST), end is not None
        if end is not None:
            self.kinds += [own[own % (2 * m) < m] for own in self.kinds]
            self.cost += 2.0 * np.log1p((np.append(begins, end)[self.behind] - begins[first]) / MINUTE)
        # sums over the segments before each: a run has the difference of two
        self.score = _sum_before(score)
        self.info = np.ascontiguousarray(np.swapaxes(_sum_before(np.swapaxes(_sum_before(info), 0, 2)), 0, 2))

    def begin(self) -> _Set:
        """The empty set."""
        lo, hi, back, I = self.first, self.behind, np.swapaxes(self.shift, 1, 2), self.info
        some = I[hi, :, hi] - I[hi, :, lo] - I[lo, :, hi] + I[lo, :, lo]
        score = (back @ (self.score[hi] - self.score[lo])[..., None])[..., 0]
        return _Set(frozenset(), 0.0, np.arange(len(lo)), score, back @ some @ self.shift, ())

    def list_better(self, one: _Set) -> list[tuple[float, int, int]]:
        """The likeliest of those that share no segment with a set and increase its odds: increase, run, kind."""
        out = []
        for number, kind in enumerate(self.kinds):
            gain = compute_gains(one.score[:, kind], one.info[:, kind[:, None], kind]) - self.cost[one.runs]
            out += [(float(gain[i]), int(one.runs[i]), number) for i in np.argsort(-gain)[:_BEAM] if gain[i] > 0.0]
        return sorted(out, reverse=True)[:_BEAM]

    def add(self, one: _Set, gain: float, j: int, kind: int) -> _Set:
        """A set with another run."""
        lo, hi, own, (at,) = self.first[j], self.behind[j], self.kinds[kind], np.flatnonzero(one.runs == j)
        U = self.shift[j][:, own]
        beside = (self.info[:, :, hi] - self.info[:, :, lo]) @ U
        for X in one.taken:
            beside -= X @ ((X[hi] - X[lo]).T @ U)
        root = np.linalg.cholesky(np.eye(len(own)) + U.T @ (beside[hi] - beside[lo]))
        taken, white = beside @ np.linalg.inv(root).T, np.linalg.solve(root, one.score[at, own])
        free = (self.behind[one.runs] <= lo) | (self.first[one.runs] >= hi)
        runs = one.runs[free]
        V = np.swapaxes(self.shift[runs], 1, 2) @ (taken[self.behind[runs]] - taken[self.first[runs]])
        score, info = one.score[free] - V @ white, one.info[free] - V @ np.swapaxes(V, 1, 2)
        return _Set(one.chosen | {(j, kind)}, one.log_odds + gain, runs, score, info, (*one.taken, taken))

    def estimate(self, chosen: Sequence[tuple[int, int]]) -> list[Array]:
        """The errors (C,) of each of some runs together, since the run began."""
        parts = []
        for j, kind in chosen:
            U = np.zeros((*self.score.shape, len(self.kinds[kind])))
            U[self.behind[j]] = self.shift[j][:, self.kinds[kind]]
            U[self.first[j]] = -U[self.behind[j]]
            parts.append(U.reshape(self.score.size, -1))
        U = np.concatenate(parts, axis=1)
        info, score = self.info.reshape(len(U), -1), self.score.reshape(-1)
        x = np.linalg.solve(np.eye(U.shape[1]) + U.T @ info @ U, U.T @ score)
        out = []
        for j, kind in chosen:
            own, x = x[: len(self.kinds[kind])], x[len(self.kinds[kind]) :]
            out.append(np.zeros(self.score.shape[1]))
            out[-1][self.kinds[kind]] = own * np.diagonal(self.shift[j])[self.kinds[kind]]
        return out


@dataclass(frozen=True)
class WrongSegments:
    """Segments of fixes that may be wrong together."""

    log_odds: float  # beside nothing being wrong
    spans: Mapping[str, tuple[tuple[float, float], ...]]  # by constraint: first and last fix of each run, s
    large: bool  # whether the error of each is


def find_wrong_segments(
    problem: Problem, about: Points, edges: Sequence[float], names: Collection[str]
) -> list[tuple[float, float]]:
    """The segments of fixes that are wrong by the evidence: first and last fix of each run of them, s.

    Parameters
    ----------
    problem : with its noise model.
    about : points of all keyframes to linearise at.
    edges : s, in order: where one segment ends and the next begins. The last one lasts to the end.
    names : of the constraints that may be wrong, each in some of the segments.
    """
    fixes = [rows for rows in problem.constraints if rows.name in names]
    begins, m = np.array(edges), len(fixes[0].axes)
    responses = _respond(problem, refilter(problem, about, whole=False), fixes, begins)
    runs = _Runs(begins, [rows.unit for rows in fixes], m, *responses)
    best = max(_list_likeliest(runs), key=lambda one: one.log_odds)
    return [
        (first, last) for _, first, last, large in _describe_runs(problem, about, fixes, begins, runs, best) if large
    ]


def compare_wrong_segments(
    problem: Problem, about: Points, edges: Sequence[float], names: Collection[str]
) -> tuple[float, list[WrongSegments]]:
    """The log-likelihood of all measurements if no fix is wrong, and the likeliest sets of wrong segments, each of one,
    two and more runs: those that last to the end as well, and with errors that stay or grow.

    Parameters
    ----------
    problem, about, edges, names : as for `find_wrong_segments`; the first edge at the first fix.
    """
    fixes = [rows for rows in problem.constraints if rows.name in names]
    begins, m, forward = np.array(edges), len(fixes[0].axes), refilter(problem, about, whole=False)
    responses = _respond(problem, forward, fixes, begins)
    runs = _Runs(begins, [rows.unit for rows in fixes], m, *responses, float(problem.t[-1]))
    out = []
    for one in _list_likeliest(runs):
        spans, each = dict[str, tuple[tuple[float, float], ...]](), True
        for wrong, first, last, large in _describe_runs(problem, about, fixes, begins, runs, one):
            spans |= {name: (*spans.get(name, ()), (first, last)) for name in wrong}
            each &= large
        out.append(WrongSegments(one.log_odds, spans, each))
    return float(np.sum(forward.log_likelihood)), out


def _list_likeliest(runs: _Runs) -> list[_Set]:
    """The empty set and the likeliest sets of each size, by forward selection."""
    out = beam = [runs.begin()]
    while beam:
        more: dict[frozenset[tuple[int, int]], tuple[float, _Set, tuple[float, int, int]]] = {}
        for one in beam:
            for added in runs.list_better(one):
                more.setdefault(one.chosen | {added[1:]}, (one.log_odds + added[0], one, added))
        likeliest = sorted(more.values(), key=lambda some: -some[0])[:_BEAM]
        beam = [runs.add(one, *added) for _, one, added in likeliest]
        out = [*out, *beam]
    return out


def _describe_runs(
    problem: Problem, about: Points, fixes: list[Constraint], begins: Array, runs: _Runs, one: _Set
) -> list[tuple[list[str], float, float, bool]]:
    """Of each run of a set: the constraints that are wrong, first and last fix (s), and whether its error is large."""
    t, m = problem.t[np.unique(np.concatenate([rows.keyframe for rows in fixes]))], len(fixes[0].axes)
    ordered = sorted(one.chosen, key=lambda run: int(runs.first[run[0]]))
    bounds, out = np.append(begins, np.inf), []
    for (j, kind), error in zip(ordered, runs.estimate(ordered) if ordered else [], strict=True):
        own = t[(t >= begins[runs.first[j]]) & (t < bounds[runs.behind[j]])]
        driven = t if runs.to_end else own  # an error is as large in one part as its opposite in all others
        speed = float(np.median(np.linalg.norm(about.states.v[np.isin(problem.t, driven)], axis=1)))
        places = {rows.name: 2 * m * i for i, rows in enumerate(fixes)}
        large = any(
            is_large(error[at : at + m] + grown * error[at + m : at + 2 * m], rows, speed)
            for rows, at in zip(fixes, places.values(), strict=True)
            for grown in (0.0, (own[-1] - own[0]) / MINUTE)
        )
        wrong = [name for name, at in places.items() if at in runs.kinds[kind]]
        out.append((wrong, float(own[0]), float(own[-1]), large))
    return out


@compile_once
def compute_gains(score: Array, info: Array) -> Array:
    """(J,) logarithms of the evidence of errors of unit prior beside none, by score (J, c) and info (J, c, c)."""
    J, c = score.shape
    out, root, white = np.zeros(J), np.empty((c, c)), np.empty(c)
    for j in range(J):
        for i in range(c):
            for h in range(i + 1):
                x = info[j, i, h]
                for g in range(h):
                    x -= root[i, g] * root[h, g]
                root[i, h] = np.sqrt(1.0 + x) if h == i else x / root[h, h]
            x = score[j, i]
            for h in range(i):
                x -= root[i, h] * white[h]
            white[i] = x / root[i, i]
            out[j] += 0.5 * white[i] * white[i] - np.log(root[i, i])
    return out


def _sum_before(x: Array) -> Array:
    """Sums of what is before each place of the first axis, and of all."""
    out = np.zeros((len(x) + 1, *x.shape[1:]))
    np.cumsum(x, axis=0, out=out[1:])
    return out


def _respond(problem: Problem, forward: ForwardRecord, fixes: list[Constraint], begins: Array) -> tuple[Array, Array]:
    """Score (M, C) and info (M, C, M, C) of all segments' errors, growing ones by the minute since the first began.

    X <- F X from one keyframe to the next, G = U - H X and X <- X + K G at each update.
    """
    updates, m = forward.updates, len(fixes[0].axes)
    assert updates is not None
    n, numbers, D = updates.H.shape
    C = 2 * m * len(fixes)
    column, minutes = np.full((n, numbers), -1), np.zeros((n, numbers))
    for i, rows in enumerate(fixes):
        of, place = updates.places[rows.name]
        t = problem.t[of[:, 0]]
        segment = np.searchsorted(begins, t, side="right") - 1
        own = segment >= 0
        column[of[own], place[own]] = (C * segment[own] + 2 * m * i)[:, None] + np.arange(m)
        minutes[of[own], place[own]] = ((t[own] - begins[0]) / MINUTE)[:, None]
    every = C * len(begins)
    X, score, info = np.zeros((D, 0)), np.zeros(every), np.zeros((every, every))
    blocks, met = updates.blocks, np.maximum(column.max(axis=1) // C + 1, 0) * C
    whitened, count = np.zeros((_TOGETHER + numbers, every)), 0
    for k in range(n):
        if X.shape[1]:
            X = move_columns(forward.F[k - 1], forward.decay[k - 1], X)
        if met[k] > X.shape[1]:  # columns of segments that have not begun are zero still
            X = np.pad(X, ((0, 0), (0, met[k] - X.shape[1])))
        known = X.shape[1]
        for b in range(blocks.first[k], blocks.first[k + 1]) if known else ():
            if not updates.taken[b]:
                continue
            at = k, slice(blocks.begin[b], blocks.end[b])
            some = np.flatnonzero(column[at] >= 0)
            G = np.zeros((len(column[at]), known))
            G[some, column[at][some]] = 1.0
            G[some, column[at][some] + m] = minutes[at][some]
            respond(updates.H[at], updates.Kt[at], X, G)
            score[:known] += G.T @ updates.w[at]
            whitened[count : count + len(G), :known] = np.linalg.cholesky(updates.inverse[*at, at[1]]).T @ G
            count += len(G)
            if count >= _TOGETHER:
                info[:known, :known] += whitened[:count, :known].T @ whitened[:count, :known]
                count = 0
    info += whitened[:count].T @ whitened[:count]
    return score.reshape(-1, C), info.reshape(len(begins), C, -1, C)
