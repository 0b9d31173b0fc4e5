"""Whether errors agree with stated sigmas, where errors of one drive are correlated over seconds to minutes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.sample_size import chi_square_band, chi_square_quantile, effective_epochs
from graphnav.evaluation.metrics import Errors, over_sigmas

_TOO_SMALL, _CAUTIOUS = 1.5, 0.5  # error over sigma; what lies between is acceptable
_BY_CHANCE = 0.0027  # outside three standard deviations of a Gaussian


@dataclass(frozen=True)
class BlockVerdict:
    """The verdict on the sigmas of one block of errors."""

    block: str  # position, velocity, attitude or heading
    size: float  # error over sigma, rms
    inside: float  # share of epochs within the region that holds 99.7 % of a Gaussian's
    effective: float  # number of independent epochs that they are equivalent to
    verdict: str  # "too small", "unclear", "cautious" or "fits"


def judge_sigmas(errors: Errors) -> tuple[BlockVerdict, ...]:
    """Judge the sigmas of each block; blocks without errors or without sigmas are left out.

    A sigma is too small where errors are more than 1.5 times as large and chance (three standard deviations) does not
    explain it for as many independent epochs. Where it may, as for an error that hardly changes and so counts once, it
    is unclear.
    """
    p, v, rph = over_sigmas(errors)
    blocks = [("position", errors.nees_p, errors.dof_p, p), ("velocity", errors.nees_v, 3, v),
              ("attitude", errors.nees_rph, 3, rph)]  # fmt: skip
    if not np.isfinite(errors.nees_p).any():  # a covariance that is not invertible still has sigmas
        size = np.mean(errors.nees_axis[:, : errors.dof_p], axis=1)
        blocks[0] = ("position", size * errors.dof_p, errors.dof_p, p)
    if errors.nees_heading is not None:  # an average over three angles would hide a wrong one
        blocks.append(("heading", errors.nees_heading, 1, rph[:, 2:]))
    return tuple(_judge(name, x, dof, z) for name, x, dof, z in blocks if np.isfinite(x).any())


def _judge(block: str, nees: Array, dof: int, over_sigma: Array) -> BlockVerdict:
    known = np.isfinite(nees)
    nees, effective = nees[known], effective_epochs(over_sigma[known])
    size = float(np.sqrt(np.mean(nees) / dof))
    verdict = "fits"
    if size > _TOO_SMALL:
        verdict = "too small" if size**2 > chi_square_band(dof, effective, _BY_CHANCE)[1] else "unclear"
    elif size < _CAUTIOUS:
        verdict = "cautious"
    return BlockVerdict(
        block, size, float(np.mean(nees <= chi_square_quantile(1.0 - _BY_CHANCE, dof))), effective, verdict
    )
