"""The information that measurements have of variance components.

With x the logarithms of all factors, P the inverse covariance of the measurements y and V_i what component i adds to
that covariance, the log-likelihood L has

    dL / dx_i = (y^T P V_i P y - tr P V_i) / 2 = (A_i - B_i) / 2     -d2L / dx_i dx_j ~ y^T P V_i P V_j P y / 2

the second the average of the observed and the expected information (Gilmour, Thompson and Cullis, "Average information
REML", Biometrics 51 (1995); Johnson and Thompson, J. Dairy Science 78 (1995)). V_j P y are the smoothed disturbances of
component j, and with u_j the innovations of a filter which these disturb and nothing else, y^T P V_i P V_j P y is the
sum of u_i^T S^-1 u_j: one forward pass of vectors, whose gains the filter has left.

With the weights of rows in the tails of their density held, that is. They follow the variances: of a row beyond the
limit of its tails (`graphnav.estimation.noise.tails`), the weighted squares have the same sum a whatever the variances
are, and with a_i that of component i, -d2L / dx_i dx_j has a_i a_j / 2a less.

B / 2 is the information on a component that is all of the noise of its rows. One that is a small part of it has less by
that part, and what the rows tell of one component, others may explain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.noise.moments import Moments
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.disturbance import compare_disturbances
from graphnav.estimation.solvers.linearise import shift
from graphnav.estimation.solvers.passes import ForwardRecord, MomentPass
from graphnav.imu.preintegration import NOISE_FIGURES


def compute_information(
    problem: Problem, forward: ForwardRecord, smoothed: MomentPass, moments: Moments, names: Sequence[str]
) -> Array:
    """The average information (J, J) on the logarithms of variance components.

    Parameters
    ----------
    forward : linearised at given points throughout, and `smoothed` by it.
    moments : of `smoothed`.
    names : of the J components, those of the IMU first.
    """
    updates, number = forward.updates, {name: j for j, name in enumerate(names)}
    assert updates is not None
    n, M, D = updates.H.shape
    attitudes, common = forward.about.states.R_nb[: n - 1], np.zeros((n, DIM, len(NOISE_FIGURES)))
    common[1:] = problem.motion.compute_frames(slice(0, n - 1), attitudes) @ np.swapaxes(moments.imu.disturbance, 1, 2)
    driven, of_driven = np.zeros((n, D - DIM)), np.full(D - DIM, -1)
    for chain in problem.chains:
        if chain.parameter.noise_groups:
            at, k = problem.columns[chain.parameter.name], moments.processes[chain.parameter.name][0]
            driven[k, shift(at)] = chain.sigma[chain.node[k]] ** 2 * smoothed.r[k, at]
            of_driven[shift(at)] = [number.get(group, -1) for group in chain.parameter.noise_groups]
    errors, of_errors = np.zeros((n, M)), np.full((n, M), -1)
    for rows in problem.constraints:
        groups, index = rows.list_noise_groups()
        if groups:
            found = moments.rows[rows.name].error
            k, place = (one[: len(found)] for one in updates.places[rows.name])
            errors[k, place] = -found
            of_errors[k, place] = np.array([*(number.get(group, -1) for group in groups), -1])[index[: len(found)]]
    out = np.zeros((len(names), len(names)))
    compare_disturbances(
        (forward.F, forward.decay), updates.arrays, updates.blocks.arrays, common, driven, of_driven, errors,
        of_errors, out,
    )  # fmt: skip
    return 0.5 * out


def compute_tail_information(problem: Problem, moments: Moments, names: Sequence[str]) -> Array:
    """By how much -d2L / dx dx (J, J) is less than with the weights of rows in the tails held.

    Only of constraints whose variances are to fall: as they grow, rows come back out of the tails.
    """
    number, out = {name: j for j, name in enumerate(names)}, np.zeros((len(names), len(names)))
    for rows in problem.constraints:
        found = moments.rows.get(rows.name)
        if found is None or rows.weight is None or np.sum(found.A) > np.sum(found.B):
            continue
        weight, (groups, index) = rows.weight[: len(found.A)], rows.list_noise_groups()
        some = np.flatnonzero((weight > 0.0) & (weight < 1.0))
        a = np.zeros((len(some), len(names)))
        for i, group in enumerate(groups):
            a[:, number[group]] += np.sum(found.A[some], axis=1, where=index[some] == i)
        redundancy = np.min(found.B[some], axis=1, initial=1.0)
        out += 0.5 * (a * (redundancy / np.maximum(np.sum(a, axis=1), 1e-30))[:, None]).T @ a
    return out
