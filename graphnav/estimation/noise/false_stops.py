"""Stops in which the platform moves, by the evidence of the other measurements.

A detector calls a span stationary because nothing in it changes, and neither does anything on a smooth road. Where no
sensor measures a speed that is certain by its stated error, the noise model tells more: with its figures, the
likelihood of the innovations is computed with zero velocity, and with an unknown velocity instead, which is constant in
body axes and has a prior as wide as errors of velocity get (`graphnav.estimation.faults.watch.SIZES`). Fixes in the
span itself do not count: those of a receiver at rest may wander. Nor does a velocity of the stated sigma of the zero:
an idling engine shakes the IMU at the same phase in every keyframe, or nearly, which in a long stop adds up to a
distance. A false stop is beforehand as improbable as a fault.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.standstill import HeldPosition, ZeroVelocity
from graphnav.core.rotation import Array
from graphnav.detectors.base import NONE, merge_spans
from graphnav.estimation.faults.excluded import weigh_rows
from graphnav.estimation.faults.watch import FAULT_COST
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.explanations import FIXES, Trials, add_common_errors
from graphnav.estimation.noise.model import INTERVALS, NoiseModel
from graphnav.estimation.noise.outliers import compute_row_costs
from graphnav.estimation.noise.spans import drop_within, join
from graphnav.estimation.noise.tails import relate_to_gaussian
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import reuse_points

Found = TypeVar("Found")

_OF_STOPS = (ZeroVelocity.name,)


def find_false_stops(
    base: Problem, noise: NoiseModel, near: tuple[Points, Problem], stationary: Array
) -> tuple[Array, int]:
    """Find the stationary spans in which the platform moves.

    Parameters
    ----------
    base : built with stated noise and these spans, and with the constants that are free.
    noise : of it, with what it leaves out.
    near : smoothed points of all keyframes, and the problem that they are of.
    stationary : (M, 2) s

    Returns
    -------
    array
        (n, 2) s, those of the spans in which a constant velocity is the likelier.
    int
        Filter passes.
    """
    rows = next((c for c in base.constraints if c.name == ZeroVelocity.name), None)
    if rows is None:
        return np.empty((0, 2)), 0
    t = base.t[rows.keyframe]
    first, behind = np.searchsorted(t, stationary[:, 0] - SAME_TIME), np.searchsorted(t, stationary[:, 1] + SAME_TIME)
    spans = stationary[behind > first]
    listed = [(float(begin), float(end)) for begin, end in spans]
    excluded = {name: list(some) for name, some in noise.excluded.items()}
    for name in (*FIXES, HeldPosition.name):
        excluded[name] = join([*excluded.get(name, ()), *listed])
    # disturbed intervals may hide a false stop, and so may tails that are as long as rows of false stops make them
    weights = {name: drop_within(w, listed) if name in INTERVALS else w for name, w in noise.weights.items()}
    if rows.name in weights:
        w = weights[rows.name]
        shorter = relate_to_gaussian(w.weight, len(rows.axes), noise.tails.get(rows.name))
        weights[rows.name] = replace(w, weight=shorter)
    tails = {name: index for name, index in noise.tails.items() if name != rows.name}
    noise = replace(
        noise, weights=weights, tails=tails, excluded={name: tuple(some) for name, some in excluded.items()}
    )
    used = apply_noise(base, noise)
    trials = Trials(used, reuse_points(*near, used), listed)
    costs = compute_row_costs(used, noise.tails)
    stands = trials.sum_spans(trials.filter(used).log_likelihood() - costs)
    size = float(np.median(rows.sigma))  # type: ignore[attr-defined]
    shaken = add_common_errors(used, listed, _OF_STOPS, grows=False, size=size)
    stands = np.maximum(stands, trials.sum_spans(trials.filter(shaken, _OF_STOPS).log_likelihood() - costs))
    free = add_common_errors(weigh_rows(used, {rows.name: np.ones(len(rows))}), listed, _OF_STOPS, grows=False)
    costs = compute_row_costs(used, noise.tails, without=_OF_STOPS)
    moves = trials.sum_spans(trials.filter(free, _OF_STOPS).log_likelihood() - costs)
    return spans[moves - stands > FAULT_COST], trials.passes


def leave_out_false_stops(
    found: Found, judge: Callable[[Found], Array], estimate: Callable[[Found, Array], Found], false: Array = NONE
) -> tuple[Found, Array]:
    """Estimate anew without the stops in which the platform moves, until there are none.

    A false stop leads the solution astray, so that later ones may be contradicted though they are true: the first are
    left out, twice as many each time.

    Parameters
    ----------
    found : with all of them, but some `false` ones (n, 2), s.
    judge : the false stops (n, 2) of an estimate, s.
    estimate : one without the false stops (n, 2) so far, from the one before.

    Returns
    -------
    Found
        The last estimate that did not break down.
    array
        (n, 2) s, the stops that it is without.
    """
    first = 1
    with contextlib.suppress(*BREAKDOWN):
        while len(wrong := judge(found)):
            without = merge_spans(np.concatenate([false, wrong[:first]]))
            found, false, first = estimate(found, without), without, 2 * first
    return found, false


def unite_stops(*parts: Array | Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Spans (M, 2), s, of several sets, in order and apart, as `NoiseModel.false_stops` has them."""
    spans = merge_spans(np.concatenate([np.reshape(np.asarray(one, dtype=float), (-1, 2)) for one in parts]))
    return tuple((float(begin), float(end)) for begin, end in spans)
