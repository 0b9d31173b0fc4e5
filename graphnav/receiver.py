"""How good the fixes really are: what their residuals say against the sigmas they came with.

A smoothed inertial trajectory follows whatever the fixes do slowly and refuses what they do fast. So the
residuals of a plain solution show the fast part of the receiver's error. With f the ratio of their (median)
square to what the stated sigmas promise:

* f > 1: the stated sigmas are too small; they are multiplied by sqrt(f) (a variance factor, Teunissen,
  *Testing Theory*, ch. 5).
* f < 1: either the sigmas are too large or, far more often, the rest of the error changes slowly and has gone
  into the trajectory. Stated sigmas are meant to hold for the whole error, so the missing share 1 - f is taken
  to be slow. Read otherwise, a thousand fixes wrong alike would promise thirty times too much.

Medians, so that outliers and bad stretches do not decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from graphnav.config import Settings
from graphnav.constraints.gnss import GnssPosition
from graphnav.problem import Problem
from graphnav.recording import Recording
from graphnav.solution import Solution

FIXES = 600  # fixes the judgement is made on, from the first motion
_SIGNIFICANT = 3.0  # standard deviations of the estimate of f that f must differ from 1
_MOST = 0.98  # the largest share called slow


@dataclass(frozen=True)
class Judgement:
    """Factor on the stated position sigmas, share of the variance that is slow, and a sentence."""

    sd_factor: float
    slow_share: float
    note: str

    def applied(self, settings: Settings) -> Settings:
        """Settings with what the user left open filled in."""
        gnss = settings.gnss
        found = {
            "sd_factor": self.sd_factor if gnss.sd_factor is None else gnss.sd_factor,
            "slow_share": self.slow_share if gnss.slow_share is None else gnss.slow_share,
        }
        return settings.model_copy(update={"gnss": gnss.model_copy(update=found)})


def stretch(recording: Recording, begin: float) -> Recording:
    """The part of a recording to judge on: from its start to `FIXES` fixes after `begin` (s, its clock)."""
    gnss = recording.gnss
    assert gnss is not None
    later = gnss.t[gnss.t > begin]
    if len(later) <= FIXES:
        return recording
    return recording.crop(0.0, float(later[FIXES]) - recording.start)


def judge(problem: Problem, solution: Solution) -> Judgement | None:
    """Judge the fixes by a smoothed solution that took their sigmas as stated, all white.

    None when there are too few fixes to say anything.
    """
    rows = next((c for c in problem.constraints if isinstance(c, GnssPosition)), None)
    if rows is None or len(rows) < 30:
        return None
    residual = solution.records[rows.name].residual
    C = rows.R_ln
    P = C @ solution.covariance[rows.keyframe][:, 3:6, 3:6] @ np.swapaxes(C, -1, -2)
    # a residual is smaller than the error by what the trajectory took up of it
    left = 1.0 - np.diagonal(P, axis1=-2, axis2=-1) / rows.sigma**2
    usable = np.all(left > 0.2, axis=1)
    if np.count_nonzero(usable) < 30:
        return None
    squared = np.sum((residual / rows.sigma) ** 2 / np.maximum(left, 0.2), axis=1)[usable]
    f = float(np.median(squared)) / (2.0 * float(gammaincinv(1.5, 0.5)))
    # a chi-square median of n samples scatters by about 1.25 times the mean's sqrt(2/(3n))
    spread = 1.25 * np.sqrt(2.0 / (3.0 * len(squared)))
    if abs(np.log(f)) < _SIGNIFICANT * spread:
        return Judgement(1.0, 0.0, "")
    if f > 1.0:
        return Judgement(float(np.sqrt(f)), 0.0, f"the fixes scatter {np.sqrt(f):.1f} times as much as they state")
    share = min(1.0 - f, _MOST)
    return Judgement(
        1.0, share, f"only {100 * f:.0f} % of the fixes' stated variance is seen to be fast; the rest is taken as slow"
    )
