"""A stated lever arm of the antenna that the drive contradicts, and the one that is used instead.

A wrong arm turns with the vehicle: it contradicts every bend, and every change of pitch and roll. Whether it does is
asked of one filter pass with the arm as a parameter of a very wide prior, by the noise model that was estimated with
the arm as stated. Components that differ by more than three sigmas are freed, the others stay, and only if that has
more evidence: with m and P what the filter finds of the change, and S its prior,

    ln p(z | freed) - ln p(z | stated) = (m^T P^-1 m + ln |P| - ln |S|) / 2

as all is linear and Gaussian in it (MacKay 1992, "Bayesian interpolation"). Then all is estimated anew, which stands if
the evidence of the measurements is no smaller than before.

A filter that does not know the arm before the first bend is worse than one that has it wrong by a decimetre. So the arm
is used as the whole drive finds it, like the figures of the noise model, with a prior `_WIDER` times as wide as what is
left of its uncertainty: what the drive says of the arm then counts for a quarter more than it should.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.constraints.gnss import LEVER_ARM, GnssPosition, GnssVelocity, free_lever_arm
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import NoiseEstimate
from graphnav.estimation.noise.model import LeverArm
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points, shift
from graphnav.estimation.solvers.passes import reuse_points
from graphnav.recording import Recording

ARM_SIGMA = 2.0  # m, 1-sigma of a component before the drive: how large a car is
_SIGNIFICANT = 3.0  # sigmas
_WIDER = 2.0  # sigmas of the estimate, of the prior that it is used with
_KNOWN_SIGMA = 1e-3  # m, 1-sigma of a component that stays as stated


def free_arm(problem: Problem, arm: LeverArm | None) -> Problem:
    """The problem with the antenna's lever arm as a parameter; the same where there is none to be estimated."""
    if arm is None:
        return problem
    value, sigma = np.array(arm.value), np.array(arm.sigma)
    rows = [
        free_lever_arm(one, value, sigma) if isinstance(one, GnssPosition | GnssVelocity) else one
        for one in problem.constraints
    ]
    return replace(problem, constraints=tuple(rows))


def find_contradicted_arm(problem: Problem, about: Points) -> LeverArm | None:
    """The lever arm that fixes show where they contradict the stated one, with the sigmas of its prior.

    Parameters
    ----------
    problem : with its noise model.
    about : points of all keyframes near the solution.
    """
    stated = get_stated_arm(problem)
    if stated is None or problem.recording.platform != "vehicle" or LEVER_ARM in problem.parameters:
        return None
    found, P = _estimate_arm(free_arm(problem, LeverArm(tuple(stated), (ARM_SIGMA,) * 3)), problem, about)
    off = found - stated
    some = np.abs(off) > _SIGNIFICANT * np.sqrt(np.diagonal(P))
    if not some.any():
        return None
    # given that the others, if any, are as stated
    gain = P[np.ix_(some, ~some)] @ np.linalg.inv(P[np.ix_(~some, ~some)])
    off[some] -= gain @ off[~some]
    off[~some] = 0.0
    P = P[np.ix_(some, some)] - gain @ P[np.ix_(~some, some)]
    if compute_evidence_gain(off[some], P) <= 0.0:
        return None
    sigma = np.full(3, _KNOWN_SIGMA)
    sigma[some] = _WIDER * np.sqrt(np.diagonal(P))
    return LeverArm(tuple((stated + off).tolist()), tuple(sigma.tolist()))


def compute_evidence_gain(change: Array, P: Array) -> float:
    """By how much the logarithm of the evidence rises where components of an arm are free.

    Parameters
    ----------
    change : (k,) m, what the filter finds of them beside the stated arm, from a prior of `ARM_SIGMA`.
    P : (k, k) m^2, its covariance.
    """
    narrowed = np.linalg.slogdet(P)[1] - 2.0 * len(P) * np.log(ARM_SIGMA)
    return 0.5 * float(change @ np.linalg.solve(P, change) + narrowed)


def narrow_arm(base: Problem, found: NoiseEstimate, arm: LeverArm) -> LeverArm:
    """The arm as an estimate has it, for the solvers.

    Parameters
    ----------
    base : as the noise model was estimated with, the arm freed.
    """
    problem = apply_noise(base, found.noise)
    value, P = _estimate_arm(problem, problem, found.points)
    sigma = np.where(np.array(arm.sigma) > _KNOWN_SIGMA, _WIDER * np.sqrt(np.diagonal(P)), _KNOWN_SIGMA)
    return LeverArm(tuple(value.tolist()), tuple(sigma.tolist()))


def describe_arm(arm: LeverArm | None, recording: Recording) -> tuple[str, ...]:
    """A note on a lever arm that is not used as stated."""
    if arm is None or recording.gnss is None:
        return ()
    stated, found = (", ".join(f"{x:.2f}" for x in some) for some in (recording.gnss.lever_arm, arm.value))
    sentence = (
        f"antenna: the drive contradicts lever_arm in [gnss] as stated, [{stated}] m, and is solved with [{found}] m "
        "(right, forward, up of the IMU), as it finds it: measure it, or state what was found"
    )
    return (Note("gnss.lever_arm_used", sentence),)


def get_stated_arm(problem: Problem) -> Array | None:
    """(3,) m, of the rows of positions; None without any."""
    return next((rows.lever_arm for rows in problem.constraints if isinstance(rows, GnssPosition)), None)


def _estimate_arm(problem: Problem, before: Problem, about: Points) -> tuple[Array, Array]:
    """(3,) m and covariance (3, 3) of the arm, filtered about points that are of another problem."""
    forward = refilter(problem, reuse_points(about, before, problem), whole=False)
    at = problem.columns[LEVER_ARM]
    return forward.values[-1, shift(at)].copy(), forward.P[-1, at, at].copy()
