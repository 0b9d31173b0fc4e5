"""Whether stated sigmas are borne out by errors, where the errors of one drive are alike for seconds to minutes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import gammaincinv  # scipy.stats would take a second to import

from graphnav.rotation import Array

if TYPE_CHECKING:
    from graphnav.metrics import Errors

_TOO_SMALL, _CAUTIOUS = 1.5, 0.5  # of error over sigma: what is between serves
_BY_CHANCE = 0.0027  # outside three standard deviations of a Gaussian


@dataclass(frozen=True)
class Judged:
    """What one block of errors says of its sigma."""

    block: str  # position, velocity, attitude or heading
    size: float  # error over sigma, rms
    inside: float  # share of epochs within the region that holds 99.7 % of a Gaussian's
    effective: float  # independent epochs that they are worth
    verdict: str  # "too small", "unclear", "cautious" or "fits"


def judge_sigmas(errors: Errors) -> tuple[Judged, ...]:
    """Block by block; those without errors or without sigmas are left out.

    Sigma is too small where errors are more than 1.5 times as large and chance does not do that (three standard
    deviations) to as many epochs as they are worth. Where it may, as an error that hardly changes is one only, it is
    unclear.
    """
    p, v, rph = over_sigmas(errors)
    blocks = [("position", errors.nees_p, errors.dof_p, p), ("velocity", errors.nees_v, 3, v),
              ("attitude", errors.nees_rph, 3, rph)]  # fmt: skip
    if not np.isfinite(errors.nees_p).any():  # a covariance that cannot be inverted still has sigmas
        size = np.mean(errors.nees_axis[:, : errors.dof_p], axis=1)
        blocks[0] = ("position", size * errors.dof_p, errors.dof_p, p)
    if errors.nees_heading is not None:  # three angles together hide one
        blocks.append(("heading", errors.nees_heading, 1, rph[:, 2:]))
    return tuple(_judged(name, x, dof, z) for name, x, dof, z in blocks if np.isfinite(x).any())


def _judged(block: str, nees: Array, dof: int, over_sigma: Array) -> Judged:
    known = np.isfinite(nees)
    nees, effective = nees[known], effective_epochs(over_sigma[known])
    size = float(np.sqrt(np.mean(nees) / dof))
    verdict = "fits"
    if size > _TOO_SMALL:
        verdict = "too small" if size**2 > chi_square_band(dof, effective, _BY_CHANCE)[1] else "unclear"
    elif size < _CAUTIOUS:
        verdict = "cautious"
    return Judged(block, size, float(np.mean(nees <= chi_square_quantile(1.0 - _BY_CHANCE, dof))), effective, verdict)


def over_sigmas(errors: Errors) -> tuple[Array, Array, Array]:
    """Errors of position, velocity, and roll, pitch, heading over their sigmas, (N, 3) each, NaN where unknown."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sign(errors.p) * np.sqrt(errors.nees_axis), errors.v / errors.sd_v, errors.rph / errors.sd_rph


def effective_epochs(x: Array) -> float:
    """How many independent epochs errors over their sigmas (N, k), in the order of time, are worth; at least one.

    In their mean square, that is: n over 1 + 2 sum r^2 of their autocorrelations r, as squares of Gaussians correlate
    by r^2 where these do by r, summed until r first vanishes (the initial positive sequence, Geyer, Statistical
    Science 7(4), 1992). No mean is taken off: an error that does not change at all is one epoch.
    """
    x = np.where(np.isfinite(x), x, 0.0)
    n, total = len(x), float(np.sum(x * x))
    if n < 2 or total == 0.0:
        return 1.0
    r = np.fft.irfft(np.sum(np.abs(np.fft.rfft(x, 2 * n, axis=0)) ** 2, axis=1))[:n] / total
    over = np.flatnonzero(r <= 0.0)
    r = r[1 : over[0] if len(over) else n]
    share = 1.0 - np.arange(1, len(r) + 1) / n  # of the pairs that there are: r holds it once, its square twice
    return float(n / (1.0 + 2.0 * float(np.sum(r**2 / share))))


def chi_square_band(dof: int, n: float, outside: float = 0.05) -> tuple[float, float]:
    """The two-sided band, 95 % unless told, of the mean of n independent chi-square values, per degree of freedom."""
    low, high = (chi_square_quantile(p, dof * n) / (dof * n) for p in (0.5 * outside, 1.0 - 0.5 * outside))
    return low, high


def chi_square_quantile(probability: float, dof: float) -> float:
    """Where the chi-square distribution function, the regularised incomplete gamma function, is `probability`."""
    return 2.0 * float(gammaincinv(0.5 * dof, probability))
