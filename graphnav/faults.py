"""Spans of fixes that are wrong: looked at again from both sides, and the problem without them.

The filter finds faults as they happen (`graphnav.solvers.watch`); what it can know at a time is not all. It finds late
what grows, and may refuse good fixes for a while after a fault, because it has drifted. With the whole drive smoothed
without a fault and its surroundings, their residuals r are predictions from both sides: a window of n of them with
mean m has

    T = m^T (R / n + H P H^T)^-1 m

chi-square without a fault; H P H^T counts in full, as if the state's error were the same all along. From both ends of
a fault inwards fixes are used again, as far as no window of them disagrees.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from graphnav.constraints.base import SAME_TIME, Constraint, Linearized, assemble
from graphnav.constraints.gnss import GnssPosition, GnssVelocity
from graphnav.problem import Problem
from graphnav.recording import Recording
from graphnav.rotation import Array
from graphnav.solution import Fault
from graphnav.solvers import adaptive
from graphnav.solvers.passes import Smoothed, shift

_EDGE = 60.0  # s; farther from a fault a smoother without GNSS could not tell right from wrong
_DISAGREES = 1e-3  # chance of T by which a window next to a fault is taken for a part of it


def spans(problem: Problem, smoothed: Smoothed | None = None, noisy: bool = False) -> tuple[Fault, ...]:
    """The rows of weight 0, by constraint and in order of time; with a smoothed solution, what is wrong with them.

    With `noisy` all whose weight is less than 1.
    """
    out = []
    for rows in problem.constraints:
        if rows.weight is None:
            continue
        lost = np.flatnonzero(rows.weight < 1.0 if noisy else rows.weight == 0.0)
        if not len(lost):
            continue
        t = problem.t[rows.keyframe]
        off = None if smoothed is None else np.linalg.norm(_linear(problem, rows, smoothed, lost).residual, axis=1)
        for run in np.split(np.arange(len(lost)), np.flatnonzero(np.diff(lost) > 1) + 1):
            reason = ""
            if off is not None:
                reason = f"{np.median(off[run]):.2g} {rows.unit} from where everything else puts it"
                if len(run) > 1:
                    reason += f", {np.max(off[run]):.2g} at most"
            first, last = lost[run[0]], lost[run[-1]]
            out.append(Fault(rows.name, float(t[first]), float(t[last]), len(run), reason))
    return tuple(out)


def notes(faults: tuple[Fault, ...], problem: Problem) -> tuple[str, ...]:
    """A sentence for each kind of fix that some are left out of."""
    out = []
    for rows in problem.constraints:
        own = [fault for fault in faults if fault.kind == rows.name]
        if own:
            longest = max(own, key=lambda f: f.t_end - f.t_start)
            begin = longest.t_start - problem.recording.start
            out.append(
                f"{rows.name}: {sum(f.count for f in own)} of {len(rows)} are wrong and left out, in {len(own)} spans; "
                f"the longest, from {begin:.1f} s for {longest.t_end - longest.t_start:.1f} s, is {longest.reason}"
            )
        noisy = np.empty(0) if rows.weight is None else rows.weight[(rows.weight > 0.0) & (rows.weight < 1.0)]
        if len(noisy):
            usual, most = np.median(noisy) ** -0.5, np.min(noisy) ** -0.5
            out.append(
                f"{rows.name}: {len(noisy)} of {len(rows)} scatter {usual:.0f} times as much as they state (median; "
                f"{most:.0f} at most) and have less say for it"
            )
    return tuple(out)


def weighted(problem: Problem, weights: dict[str, Array]) -> Problem:
    """A problem with its rows weighted, (N,) by constraint."""
    constraints = (replace(c, weight=weights[c.name]) if c.name in weights else c for c in problem.constraints)
    return replace(problem, constraints=tuple(constraints))


def without(problem: Problem, faults: Iterable[Fault]) -> Problem:
    """The problem with the rows inside faults given no weight."""
    weights = {}
    for rows in problem.constraints:
        own = [fault for fault in faults if fault.kind == rows.name]
        if own:
            t = problem.t[rows.keyframe]
            weights[rows.name] = np.ones(len(rows)) if rows.weight is None else rows.weight.copy()
            for fault in own:
                weights[rows.name][(t >= fault.t_start - SAME_TIME) & (t <= fault.t_end + SAME_TIME)] = 0.0
    return weighted(problem, weights)


def doubted(recording: Recording, problem: Problem) -> Recording:
    """The recording with fixes as a problem weighs them: without those left out, the sigmas of others larger."""
    gnss = recording.gnss
    assert gnss is not None
    weight = {"gnss_position": np.ones(len(gnss.t)), "gnss_velocity": np.ones(len(gnss.t))}
    for rows in problem.constraints:
        if rows.name in weight and rows.weight is not None:
            t = problem.t[rows.keyframe]
            at = np.clip(np.searchsorted(gnss.t, t - SAME_TIME), 0, len(gnss.t) - 1)
            same = np.abs(gnss.t[at] - t) <= SAME_TIME
            weight[rows.name][at[same]] = rows.weight[same]
    p, v = weight["gnss_position"][:, None], weight["gnss_velocity"][:, None]
    with np.errstate(divide="ignore"):
        gnss = replace(
            gnss,
            llh=np.where(p > 0.0, gnss.llh, np.nan),
            sd=gnss.sd / np.sqrt(p),
            v=None if gnss.v is None else np.where(v > 0.0, gnss.v, np.nan),
            sd_v=None if gnss.sd_v is None else gnss.sd_v / np.sqrt(v),
        )
    return replace(recording, gnss=gnss)


def all_used(problem: Problem) -> Problem:
    """The problem with nothing left out."""
    return weighted(problem, {c.name: np.ones(len(c)) for c in problem.constraints if c.weight is not None})


def widened(problem: Problem) -> Problem:
    """The problem with as much again left out on either side of every fault, at most `_EDGE`.

    A fault that grows is found late, and what the filter used of it before would hide it from a smoother.
    """
    t = {rows.name: problem.t[rows.keyframe] for rows in problem.constraints}
    return without(problem, [_wider(fault, t[fault.kind]) for fault in spans(problem)])


def _wider(fault: Fault, t: Array) -> Fault:
    """A fault with its surroundings, but with no more than half of all there is of a kind, at times t, on a side."""
    more = min(fault.t_end - fault.t_start, _EDGE)
    before, after = 0.5 * float(fault.t_start - t[0]), 0.5 * float(t[-1] - fault.t_end)
    return replace(fault, t_start=fault.t_start - min(more, before), t_end=fault.t_end + min(more, after))


def count(problem: Problem) -> int:
    """How many rows are left out, or have less say."""
    return sum(int(np.sum(c.weight < 1.0)) for c in problem.constraints if c.weight is not None)


def said(problem: Problem) -> float:
    """How many fixes have a say, noisier ones less of it."""
    return sum(
        float(len(c) if c.weight is None else np.sum(c.weight))
        for c in problem.constraints
        if isinstance(c, GnssPosition | GnssVelocity)
    )


def share(problem: Problem) -> float:
    """The largest share of a kind that is left out."""
    return max((float(np.mean(c.weight == 0.0)) for c in problem.constraints if c.weight is not None), default=0.0)


def readmitted(problem: Problem, smoothed: Smoothed) -> Problem:
    """The problem with better edges of its faults, by a smoothed solution of the `widened` one.

    Towards every fault, and on into it, fixes are used as far as no window of them disagrees with its prediction. Where
    fixes are to be noisier than stated they have the noise that is seen from both sides.
    """
    better = {}
    for rows in problem.constraints:
        if rows.weight is None or not np.any(rows.weight < 1.0):
            continue
        f = _noise(problem, rows, smoothed)
        weight, t = np.where(rows.weight > 0.0, 1.0 / f, 0.0), problem.t[rows.keyframe]
        agree, doubted = np.zeros(len(rows), dtype=bool), rows.weight == 0.0
        if not rows.watched:  # left out by a gate
            better[rows.name] = weight
            continue
        for fault in (fault for fault in spans(problem) if fault.kind == rows.name):
            wide, own = _wider(fault, t), (t >= fault.t_start - SAME_TIME) & (t <= fault.t_end + SAME_TIME)
            left, right = (t >= wide.t_start) & (t <= fault.t_end), (t >= fault.t_start) & (t <= wide.t_end)
            for side, step in ((left, 1), (right, -1)):
                if step > 0 and own[0]:
                    continue  # before the first fix there is only what was believed for its sake
                inwards = np.flatnonzero(side & (own | (rows.weight > 0.0)))[::step]
                doubted[inwards] = True
                agree[inwards[: _agreeing(problem, rows, smoothed, inwards, f)]] = True
        weight[doubted] = np.where(agree, 1.0 / f, 0.0)[doubted]
        better[rows.name] = weight
    return weighted(problem, better)


def _noise(problem: Problem, rows: Constraint, smoothed: Smoothed) -> Array:
    """(N,) factors on the variances of fixes, 1 where they are as stated."""
    if rows.adaptive == "off":
        return np.ones(len(rows))
    linear, HPH = _predicted(problem, rows, smoothed, np.arange(len(rows)))
    predicted = np.diagonal(HPH, axis1=-2, axis2=-1)
    return adaptive.factors(linear.residual, linear.sigma, predicted, always=rows.adaptive == "on")


def _predicted(problem: Problem, rows: Constraint, smoothed: Smoothed, which: Array) -> tuple[Linearized, Array]:
    """Some rows at a smoothed solution, and its part (n, m, m) in the covariance of their residuals."""
    linear = _linear(problem, rows, smoothed, which)
    H = assemble(linear, problem.columns, smoothed.P.shape[-1])
    return linear, H @ smoothed.P[rows.keyframe[which]] @ np.swapaxes(H, -1, -2)


def _agreeing(problem: Problem, rows: Constraint, smoothed: Smoothed, which: Array, f: Array) -> int:
    """How many rows from the first of `which` on agree with what they were predicted to be, f (N,) times as noisy."""
    linear, HPH = _predicted(problem, rows, smoothed, which)
    m = linear.residual.shape[1]
    R = (f[which, None] * linear.sigma**2)[..., None] * np.eye(m)
    limit, end, n = float(chdtri(m, _DISAGREES)), len(which), 1
    sums = [np.cumsum(np.concatenate([np.zeros((1, *x.shape[1:])), x]), axis=0) for x in (linear.residual, R, HPH)]
    while n <= end:
        first = np.arange(end - n + 1)
        mean, noise, drift = ((s[first + n] - s[first]) / n for s in sums)
        T = np.sum(mean * np.linalg.solve(noise / n + drift, mean[..., None])[..., 0], axis=1)
        disagree = first[limit < T]
        if len(disagree):
            end = int(disagree[0]) + n - 1
        n *= 2
    return end


def _linear(problem: Problem, rows: Constraint, smoothed: Smoothed, which: Array) -> Linearized:
    at = rows.keyframe[which]
    values = {p.name: smoothed.values[at][:, shift(problem.columns[p.name])] for p in rows.parameters}
    return rows.linearize(smoothed.states[at], values, which)
