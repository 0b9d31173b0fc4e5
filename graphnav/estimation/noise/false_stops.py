"""Stops in which the platform moves, by the evidence of the other measurements.

A detector calls a span stationary because nothing in it changes, and neither does anything on a smooth road. Where no
sensor measures a speed that is certain by its stated error, the noise model tells more: with its figures, the
likelihood of the innovations is computed with zero velocity, and with an unknown velocity instead, which is constant in
body axes and has a prior as wide as errors of velocity get (`graphnav.estimation.faults.watch.SIZES`). Fixes in the
span itself do not count: those of a receiver at rest may wander. A false stop is beforehand as improbable as a fault.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.standstill import HeldPosition, ZeroRate, ZeroVelocity
from graphnav.core.rotation import Array
from graphnav.estimation.faults.watch import FAULT_COST
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import NoiseEstimate
from graphnav.estimation.noise.explanations import FIXES, Trials, add_common_errors
from graphnav.estimation.noise.model import INTERVALS
from graphnav.estimation.problem import Problem

_OF_STOPS = (ZeroVelocity.name,)
_MASKING = (*FIXES, *INTERVALS, ZeroVelocity.name, ZeroRate.name, HeldPosition.name)  # their weights hide a false stop


def find_false_stops(base: Problem, found: NoiseEstimate, stationary: Array) -> tuple[Array, int]:
    """Find the stationary spans in which the platform moves.

    Parameters
    ----------
    base : built with stated noise.
    found : estimated with all measurements.
    stationary : (M, 2) s, by which the problem was built.

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
    noise = found.robust or found.noise
    noise = replace(
        noise,
        weights={name: some for name, some in noise.weights.items() if name not in _MASKING},
        excluded=dict.fromkeys((*FIXES, HeldPosition.name), tuple(listed)),
    )
    used = apply_noise(base, noise)
    trials = Trials(used, found.carry_points(base, used), listed)
    moves = trials.sum_spans(trials.filter(add_common_errors(used, listed, _OF_STOPS), _OF_STOPS).log_likelihood())
    false: list[int] = []
    while True:
        some = add_common_errors(used, [listed[k] for k in false], _OF_STOPS) if false else used
        stands = trials.sum_spans(trials.filter(some, _OF_STOPS).log_likelihood())
        more = np.setdiff1d(np.flatnonzero(moves - stands > FAULT_COST), false)
        if not len(more):
            return spans[false], trials.passes
        false = sorted([*false, int(more[0])])  # later ones may be contradicted by what the first has done
