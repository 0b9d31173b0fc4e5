"""Whether a drive contradicts the sizes that an IMU's scale errors are stated to have."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import NoiseEstimate
from graphnav.estimation.noise.moments import collect_process_moments
from graphnav.estimation.noise.tails import CHANCE
from graphnav.estimation.problem import Problem
from graphnav.imu.dynamics import PRIORS, SCALE


def are_scales_contradicted(base: Problem, found: NoiseEstimate) -> bool:
    """Whether the scale errors of gyro or accelerometer are larger or smaller than by chance.

    Their sum of squares A is chi-square with B degrees of freedom times the variance factor, whose estimate A / B gains
    (A - B - B ln(A / B)) / 2 of log-likelihood, half of a chi-square number with one degree of freedom by chance.

    What a scale error multiplies contains the noise of its interval: over n intervals it draws the estimate by n times
    its variance (errors in variables, Fuller 1987, section 1.1). Where that is a sigma of the prior or more, as of a
    platform that stands, the estimate tells nothing.

    Parameters
    ----------
    base : with stated noise.
    found : with the factors as they are.
    """
    used = apply_noise(base, found.noise)
    chain = next((chain for chain in used.chains if chain.parameter.name == SCALE), None)
    if chain is None:
        return False
    _, squares, freedom = collect_process_moments(used, chain, found.points, len(used.t))
    drawn = (len(used.t) - 1) * chain.sigma[0] * (1.0 - freedom[0])  # in sigmas of the prior
    groups, gains = np.where(drawn < 1.0, chain.parameter.noise_groups, ""), []
    for group in PRIORS:
        A, B = (max(float(np.sum(x[:, groups == group])), 1e-12) for x in (squares, freedom))
        gains.append(A - B - B * np.log(A / B))
    return max(gains) > float(chdtri(1, CHANCE))
