"""Whether errors agree with stated sigmas, where errors of one drive are correlated over seconds to minutes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.sample_size import chi_square_band, chi_square_quantile, count_effective_epochs
from graphnav.estimation.solution import Separation
from graphnav.evaluation.metrics import Errors, scale_by_sigmas

_TOO_SMALL, _CAUTIOUS = 1.5, 0.5  # error over sigma; what lies between is acceptable
_FEWEST_EPOCHS = 10  # of a separation, to judge it
PARTS = {"position": "height", "attitude": "heading"}  # also tested separately
BY_CHANCE = 0.0027  # outside three standard deviations of a Gaussian


@dataclass(frozen=True)
class BlockVerdict:
    """The verdict on the sigmas of one block of errors."""

    block: str  # position, height, velocity, attitude or heading; of a separation east, north or up
    size: float  # error over sigma, rms
    inside: float  # share of epochs within the region that holds 99.7 % of a Gaussian's
    effective: float  # number of independent epochs that they are equivalent to
    verdict: str  # "too small", "unclear", "cautious" or "fits"
    rest: str = ""  # verdict of position without height, or of attitude without heading


_JUDGED: WeakKeyDictionary[Errors, tuple[BlockVerdict, ...]] = WeakKeyDictionary()  # each page asks several times


def judge_sigmas(errors: Errors) -> tuple[BlockVerdict, ...]:
    """Test the sigmas of each block; blocks without errors or without sigmas are left out.

    A sigma is too small where errors are more than 1.5 times as large and chance (three standard deviations) does not
    explain it for as many independent epochs. Where it may, as for an error that hardly changes and so counts once, it
    is unclear. Height and heading are also tested separately: an average over three axes would hide a wrong one.
    """
    if (known := _JUDGED.get(errors)) is not None:
        return known
    p, v, rph = scale_by_sigmas(errors)
    nees_p = errors.nees_p
    if not np.isfinite(nees_p).any():  # a covariance that is not invertible still has sigmas
        nees_p = np.sum(errors.nees_axis[:, : errors.dof_p], axis=1)
    out = []
    for block, nees, dof, z, nees_part in (
        ("position", nees_p, errors.dof_p, p, errors.nees_axis[:, 2] if errors.dof_p == 3 else None),
        ("velocity", errors.nees_v, 3, v, None),
        ("attitude", errors.nees_rph, 3, rph, errors.nees_heading),
    ):
        if not np.isfinite(nees).any():
            continue
        whole = _judge(block, nees, dof, z)
        if nees_part is None or not np.isfinite(nees_part).any():
            out.append(whole)
            continue
        level = np.sum(z[:, :2] ** 2, axis=1)
        rest = _judge(block, level, 2, z[:, :2]).verdict if np.isfinite(level).any() else ""
        out += [replace(whole, rest=rest), _judge(PARTS[block], nees_part, 1, z[:, 2:])]
    _JUDGED[errors] = tuple(out)
    return _JUDGED[errors]


def select_verdict(verdicts: Sequence[BlockVerdict], verdict: str) -> list[BlockVerdict]:
    """The blocks of a verdict; height stands for position, and heading for attitude, where the rest has another."""
    found = {j.block: j for j in verdicts if j.verdict == verdict}
    explained = {whole for whole, part in PARTS.items() if part in found and whole in found}
    return [j for j in found.values() if j.block not in explained or j.rest == verdict]


def find_separation(separation: Separation | None) -> BlockVerdict | None:
    """The axis on which forward filter and later measurements are farthest apart, in sigmas, if that is significant.

    Both have the same model. Where it is wrong, as with a clock that drifts, axes that are not as stated or errors of
    fixes that last, each side fits it to its own measurements, and only their difference shows it.
    """
    if separation is None:
        return None
    over = separation.value / separation.sigma
    axes = [
        _judge(axis, z**2, 1, z[:, None])
        for axis, z in zip(("east", "north", "up"), over.T, strict=True)
        if np.isfinite(z).sum() >= _FEWEST_EPOCHS
    ]
    return max((j for j in axes if j.verdict == "too small"), key=lambda j: j.size, default=None)


def _judge(block: str, nees: Array, dof: int, over_sigma: Array) -> BlockVerdict:
    known = np.isfinite(nees)
    nees, effective = nees[known], count_effective_epochs(over_sigma[known])
    size = float(np.sqrt(np.mean(nees) / dof))
    verdict = "fits"
    if size > _TOO_SMALL:
        verdict = "too small" if size**2 > chi_square_band(dof, effective, BY_CHANCE)[1] else "unclear"
    elif size < _CAUTIOUS:
        verdict = "cautious"
    return BlockVerdict(
        block, size, float(np.mean(nees <= chi_square_quantile(1.0 - BY_CHANCE, dof))), effective, verdict
    )
