"""Constants that are stated, the drive contradicts, and are then estimated: the antenna's lever arm, and that the
clocks of IMU and fixes run at one rate.

A wrong arm turns with the vehicle: it contradicts every bend, and every change of pitch and roll. Two crystals drift
apart by up to some 1e-4, and what stamps are off by then grows all along the drive. Whether either is so is asked of
one filter pass with both as parameters of wide priors, by the noise model that was estimated with them as stated.
Components that differ by more than three sigmas are freed, the others stay, and only if that has more evidence: with m
and P what the filter finds of the change, and S its prior,

    ln p(z | freed) - ln p(z | stated) = (m^T P^-1 m + ln |P| - ln |S|) / 2

as all is linear and Gaussian in it (MacKay 1992, "Bayesian interpolation"). Then all is estimated anew, which stands if
the evidence of the measurements is no smaller than before.

A filter that does not know the arm before the first bend is worse than one that has it wrong by a decimetre. So what
is freed is used as the whole drive finds it, like the figures of the noise model, with a prior `_WIDER` times as wide
as what is left of its uncertainty: what the drive says of it then counts for a quarter more than it should.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from graphnav.constraints.gnss import (
    CLOCK_RATE,
    LEVER_ARM,
    TIME_OFFSET,
    GnssPosition,
    GnssVelocity,
    free_constants,
)
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import NoiseEstimate
from graphnav.estimation.noise.model import FreedConstant
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import Points
from graphnav.estimation.solvers.passes import reuse_points
from graphnav.recording import Recording

Freed = Mapping[str, FreedConstant]  # by the parameter's name

# 1-sigma of a component before the drive. An arm, m: how large a car is. A rate, s/s: crystals are good to 1e-4,
# ceramic resonators to 5e-3
PRIOR_SIGMA = {LEVER_ARM: 2.0, CLOCK_RATE: 1e-3}
_SIGNIFICANT = 3.0  # sigmas
_WIDER = 2.0  # sigmas of the estimate, of the prior that it is used with
_KNOWN = 5e-4  # of that 1-sigma: what a component that stays as stated has


def free(problem: Problem, freed: Freed) -> Problem:
    """The problem with constants as parameters."""
    if not freed:
        return problem
    priors = {name: (np.array(one.value), np.array(one.sigma)) for name, one in freed.items()}
    rows = [
        free_constants(one, priors) if isinstance(one, GnssPosition | GnssVelocity) else one
        for one in problem.constraints
    ]
    return replace(problem, constraints=tuple(rows))


def widen(problem: Problem, names: Collection[str] = tuple(PRIOR_SIGMA)) -> dict[str, FreedConstant]:
    """Stated constants with the wide priors that they are asked about with.

    Parameters
    ----------
    names : of those to ask about; what the problem has no fixes for, or has as a parameter already, is not in it.
    """
    rows = next((rows for rows in problem.constraints if isinstance(rows, GnssPosition)), None)
    if rows is None:
        return {}
    stated: dict[str, Array] = {}
    if problem.recording.platform == "vehicle":
        stated[LEVER_ARM] = rows.lever_arm
    if TIME_OFFSET in problem.parameters:
        stated[CLOCK_RATE] = np.zeros(1)
    return {
        name: FreedConstant(tuple(one.tolist()), (PRIOR_SIGMA[name],) * len(one))
        for name, one in stated.items()
        if name in names and name not in problem.parameters
    }


def find_contradicted_constants(problem: Problem, about: Points, names: Collection[str]) -> dict[str, FreedConstant]:
    """What fixes show of the constants that they contradict, with the sigmas of the priors to use.

    Parameters
    ----------
    problem : with its noise model.
    about : points of all keyframes near the solution.
    names : of the constants to ask about.
    """
    asked = widen(problem, names)
    if not asked:
        return {}
    found, P = _estimate(free(problem, asked), problem, about, asked)
    stated, prior = _stack(asked, "value"), _stack(asked, "sigma")
    off = found - stated
    some = np.abs(off) > _SIGNIFICANT * np.sqrt(np.diagonal(P))
    if not some.any():
        return {}
    # given that the others, if any, are as stated
    gain = P[np.ix_(some, ~some)] @ np.linalg.inv(P[np.ix_(~some, ~some)])
    off[some] -= gain @ off[~some]
    off[~some] = 0.0
    P = P[np.ix_(some, some)] - gain @ P[np.ix_(~some, some)]
    if compute_evidence_gain(off[some], P, prior[some]) <= 0.0:
        return {}
    sigma = _KNOWN * prior
    sigma[some] = _WIDER * np.sqrt(np.diagonal(P))
    freed = _split(asked, stated + off, sigma)
    return {name: one for name, one in freed.items() if one.value != asked[name].value}


def compute_evidence_gain(change: Array, P: Array, prior: Array) -> float:
    """By how much the logarithm of the evidence rises where components of constants are free.

    Parameters
    ----------
    change : (k,) what the filter finds of them beside what is stated.
    P : (k, k) its covariance.
    prior : (k,) 1-sigma beforehand.
    """
    narrowed = np.linalg.slogdet(P)[1] - 2.0 * np.sum(np.log(prior))
    return 0.5 * float(change @ np.linalg.solve(P, change) + narrowed)


def compute_prior_cost(problem: Problem, freed: Freed) -> float:
    """By how much the evidence of an estimate is too large because the priors of freed constants are about what the
    drive finds of them, and narrow, in place of those that they are asked about with.

    With P = Q / `_WIDER`^2 what the data tell, Q the prior that is used: ln N(0; 0, P + Q) - ln N(m; 0, P + S).

    Parameters
    ----------
    problem : with all as stated.
    """
    asked = widen(problem, freed)
    used, prior = _stack(freed, "sigma"), _stack(asked, "sigma")
    some = used > _KNOWN * prior
    change, told = (_stack(freed, "value") - _stack(asked, "value"))[some], (used[some] / _WIDER) ** 2
    narrow, wide = told + used[some] ** 2, told + prior[some] ** 2
    return 0.5 * float(np.sum(np.log(wide / narrow) + change**2 / wide))


def narrow(base: Problem, found: NoiseEstimate, freed: Freed) -> dict[str, FreedConstant]:
    """The constants as an estimate has them, for the solvers.

    Parameters
    ----------
    base : as the noise model was estimated with, the constants freed.
    """
    problem = apply_noise(base, found.noise)
    value, P = _estimate(problem, problem, found.points, freed)
    least = _KNOWN * np.concatenate([np.full(len(one.value), PRIOR_SIGMA[name]) for name, one in freed.items()])
    known = _stack(freed, "sigma") <= least
    return _split(freed, value, np.where(known, least, _WIDER * np.sqrt(np.diagonal(P))))


def describe_freed(freed: Freed, recording: Recording) -> tuple[str, ...]:
    """Notes on constants that are not used as stated."""
    notes = []
    if recording.gnss is not None and LEVER_ARM in freed:
        arms = recording.gnss.lever_arm, freed[LEVER_ARM].value
        stated, found = (", ".join(f"{x:.2f}" for x in some) for some in arms)
        sentence = (
            f"antenna: the drive contradicts lever_arm in [gnss] as stated, [{stated}] m, and is solved with [{found}] "
            "m (right, forward, up of the IMU), as it finds it: measure it, or state what was found"
        )
        notes.append(Note("gnss.lever_arm_used", sentence))
    if CLOCK_RATE in freed:
        by = freed[CLOCK_RATE].value[0] * 1e6
        sentence = (
            f"clocks of IMU and fixes drift apart: the IMU's gains {by:.0f} ppm on that of the fixes, as the drive "
            "finds it, and their stamps are corrected by it"
        )
        notes.append(Note("gnss.clock_rate_used", sentence))
    return tuple(notes)


def _stack(freed: Freed, of: str) -> Array:
    """(n,) values or sigmas of all, one after the other."""
    return np.concatenate([getattr(one, of) for one in freed.values()])


def _split(freed: Freed, value: Array, sigma: Array) -> dict[str, FreedConstant]:
    """The same constants with the values and sigmas (n,) of all, one after the other."""
    ends = np.cumsum([len(one.value) for one in freed.values()])[:-1]
    each = zip(freed, np.split(value, ends), np.split(sigma, ends), strict=True)
    return {name: FreedConstant(tuple(x.tolist()), tuple(s.tolist())) for name, x, s in each}


def _estimate(problem: Problem, before: Problem, about: Points, freed: Freed) -> tuple[Array, Array]:
    """(n,) and covariance (n, n) of constants, filtered about points that are of another problem."""
    forward = refilter(problem, reuse_points(about, before, problem), whole=False)
    at = np.concatenate([np.arange(problem.columns[name].start, problem.columns[name].stop) for name in freed])
    return forward.values[-1, at - DIM], forward.P[-1][np.ix_(at, at)]
