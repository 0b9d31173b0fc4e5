"""Stated constants that the drive contradicts, and that are therefore estimated: the antenna's lever arm, delays of the
stamps of fixes and odometer, and equal rates of the clocks of IMU and fixes.

A wrong lever arm rotates with the vehicle and contradicts every turn. Two crystals drift apart by up to some 1e-4, so
that stamp errors grow throughout the drive. The test is one filter pass with all of these constants as parameters with
wide priors, and the noise model estimated with them as stated. Constants are freed one by one, each time the one with
the largest gain in evidence, as long as there is a gain and the constant differs from the stated value by more than
three sigmas; the others are kept. The numbers of a lever arm are of one measuring tape: if one is wrong, the others are
as uncertain as that. So they are freed together, with the size of their errors by maximum evidence as the 1-sigma of
their prior. With Lambda and eta the information matrix and vector of the measurements about the constants, and D the
diagonal matrix of the 1-sigmas of a prior (0 of what is known), the logarithm of the evidence is, up to a constant,

    -ln |I + D Lambda D| / 2 + (D eta)^T (I + D Lambda D)^-1 (D eta) / 2

because the problem is linear and Gaussian in them (MacKay 1992, "Bayesian interpolation"). Then everything is estimated
again, and the result is kept if the evidence of the measurements is no smaller than before.

A filter with an unknown lever arm before the first turn is worse than one with an error of a decimetre. So freed
constants are used as estimated from the whole drive, like the figures of the noise model, with a prior `_WIDER` times
as wide as their posterior sigma: the drive's information on them then counts a quarter too much.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc, chdtri

from graphnav.constraints.antenna_motion import LEVER_ARM, LINEAR_OFFSET
from graphnav.constraints.base import Constraint
from graphnav.constraints.gnss import (
    CLOCK_RATE,
    OFFSETS,
    TIME_OFFSET,
    VELOCITY_TIME_OFFSET,
    GnssPosition,
    GnssVelocity,
    free_constants,
)
from graphnav.constraints.odometer import ODOMETER_DELAY, OdometerSpeed
from graphnav.core.notes import Notes
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import NoiseEstimate
from graphnav.estimation.noise.model import FreedConstant, StampOffsets
from graphnav.estimation.offsets import move_stamps
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.passes import reuse_points
from graphnav.recording import Recording

_STAMPS = {TIME_OFFSET: "positions", VELOCITY_TIME_OFFSET: "velocities"}
Freed = Mapping[str, FreedConstant]  # by the parameter's name

# 1-sigma of a component before the drive. An arm, m: how large a car is. An offset, s: where stamps are moved instead.
# A rate, s/s: crystals are good to 1e-4, ceramic resonators to 5e-3
PRIOR_SIGMA = {
    LEVER_ARM: 2.0, TIME_OFFSET: LINEAR_OFFSET, VELOCITY_TIME_OFFSET: LINEAR_OFFSET, ODOMETER_DELAY: LINEAR_OFFSET,
    CLOCK_RATE: 1e-3,
}  # fmt: skip
_BY_CHANCE = chdtrc(1, 3.0**2)  # probability of three sigmas
_SIZES = np.geomspace(0.01, 1.0, 24)  # of errors of a constant of several numbers, in the 1-sigmas above
_WIDER = 2.0  # prior sigma of a freed constant, in sigmas of its estimate
_KNOWN = 5e-4  # share of that 1-sigma for a component that stays as stated


def free(problem: Problem, freed: Freed) -> Problem:
    """The problem with constants as parameters."""
    if not freed:
        return problem
    priors = {name: (np.array(one.value), np.array(one.sigma)) for name, one in freed.items()}

    def free_rows(rows: Constraint) -> Constraint:
        if isinstance(rows, OdometerSpeed) and ODOMETER_DELAY in priors:
            return rows.free_delay(*priors[ODOMETER_DELAY])
        return free_constants(rows, priors) if isinstance(rows, GnssPosition | GnssVelocity) else rows

    return replace(problem, constraints=tuple(map(free_rows, problem.constraints)))


def use_freed(recording: Recording, freed: Freed, since: float) -> Recording:
    """The recording with freed constants in place of what is stated.

    Parameters
    ----------
    since : stamp from which on the rate of the clocks is counted, s.
    """
    value = {name: one.value for name, one in freed.items()}
    late, of_velocities, rate = (value.get(name, (0.0,))[0] for name in (TIME_OFFSET, VELOCITY_TIME_OFFSET, CLOCK_RATE))
    delay = value.get(ODOMETER_DELAY, (0.0,))[0]
    moved = move_stamps(recording, StampOffsets(late, of_velocities, rate=rate, since=since, odometer=-delay))
    if moved.gnss is None or LEVER_ARM not in value:
        return moved
    return replace(moved, gnss=replace(moved.gnss, lever_arm=np.array(value[LEVER_ARM])))


def widen(problem: Problem, names: Collection[str]) -> dict[str, FreedConstant]:
    """The stated constants with wide priors, for the test.

    Parameters
    ----------
    names : constants to test. Excluded are all without fixes, exact offsets, and a lever arm or a delay of the odometer
        that has a prior already.
    """
    rows = next((rows for rows in problem.constraints if isinstance(rows, GnssPosition)), None)
    if rows is None:
        return {}
    stated: dict[str, Array] = {}
    if problem.recording.platform == "vehicle" and LEVER_ARM not in problem.parameters:
        stated[LEVER_ARM] = rows.lever_arm
    if ODOMETER_DELAY not in problem.parameters and any(isinstance(one, OdometerSpeed) for one in problem.constraints):
        stated[ODOMETER_DELAY] = np.zeros(1)
    stated |= {name: p.initial for name, p in problem.parameters.items() if name in OFFSETS.values()}
    if stated.keys() & OFFSETS.values():
        stated.setdefault(CLOCK_RATE, np.zeros(1))
    return {
        name: FreedConstant(tuple(one.tolist()), (PRIOR_SIGMA[name],) * len(one))
        for name, one in stated.items()
        if name in names
    }


def find_contradicted_constants(base: Problem, best: NoiseEstimate, freed: Freed, names: Collection[str]) -> Freed:
    """Estimates of the constants that the fixes contradict, with the sigmas of the priors to use.

    Parameters
    ----------
    base : with stated noise, and constants as stated.
    best : its noise model, and points of all keyframes near the solution.
    freed : constants that are parameters of `best`.
    names : constants to test.
    """
    asked = widen(base, names)
    if not asked:
        return {}
    change, P = _ask(base, best, freed, asked)
    some = select_contradicted(change, P, _stack(asked, "sigma"), _stack_stated(base, asked), _number(asked))
    found = _use(base, asked, change, P, some)
    return {name: one for name, one in found.items() if one.value != asked[name].value}


def update_freed(base: Problem, best: NoiseEstimate, freed: Freed) -> Freed:
    """The same constants as an estimate of the noise model has them.

    Parameters
    ----------
    base, best : as for `find_contradicted_constants`.
    """
    if not freed:
        return {}
    asked = widen(base, freed)
    return _use(base, asked, *_ask(base, best, freed, asked), mark_free(base, freed))


def mark_free(base: Problem, freed: Freed) -> Array:
    """Mask (k,) of the components of freed constants that are free."""
    return np.asarray(_stack(freed, "sigma") > _KNOWN * _stack(widen(base, freed), "sigma"))


def are_same(one: Freed, other: Freed, base: Problem) -> bool:
    """Whether the same components are free."""
    if not (one and other):
        return one == other
    return one.keys() == other.keys() and bool((mark_free(base, one) == mark_free(base, other)).all())


def _ask(base: Problem, best: NoiseEstimate, freed: Freed, asked: Freed) -> tuple[Array, Array]:
    """What a filter finds of constants beside what is stated (k,), and its covariance (k, k)."""
    problem, before = (apply_noise(one, best.noise) for one in (free(base, asked), free(base, freed)))
    forward = refilter(problem, reuse_points(best.points, before, problem), whole=False)
    at = np.concatenate([np.arange(problem.columns[name].start, problem.columns[name].stop) for name in asked])
    return forward.values[-1, at - DIM] - _stack(asked, "value"), forward.P[-1][np.ix_(at, at)]


def _use(base: Problem, asked: Freed, change: Array, P: Array, some: Array) -> dict[str, FreedConstant]:
    """Constants to be used with some components (k,) as found, the others as stated."""
    stated, prior = _stack(asked, "value"), _stack(asked, "sigma")
    used = _fit_prior(change, P, prior, some, _stack_stated(base, asked), _number(asked))
    off, left, _ = _change_prior(change, P, prior, used)
    sigma = np.where(some, np.minimum(_WIDER * np.sqrt(np.diagonal(left)), used), _KNOWN * prior)
    return _split(asked, np.where(some, stated + off, stated), sigma)


def _fit_prior(change: Array, P: Array, prior: Array, some: Array, known: Array, groups: Array) -> Array:
    """1-sigmas (k,) of the prior where some components are free; of several of one constant, that of the largest
    evidence.
    """
    used = np.where(some, prior, known)
    several = some & _are_several(groups)
    if not several.any():
        return used
    candidates = [np.where(several, size * prior, used) for size in _SIZES]
    return max(candidates, key=lambda one: _change_prior(change, P, prior, one)[2])


def _number(asked: Freed) -> Array:
    """(k,) the number of the constant that each component is of."""
    return np.repeat(np.arange(len(asked)), [len(one.value) for one in asked.values()])


def _are_several(groups: Array) -> Array:
    """(k,) whether a component is one of several of its constant."""
    return np.asarray(np.bincount(groups)[groups] > 1)


def select_contradicted(change: Array, P: Array, prior: Array, known: Array, groups: Array) -> Array:
    """Components (k,) that are better free than as stated, found group by group: each time the one with the largest
    gain in evidence, as long as it has one and is significant.

    Parameters
    ----------
    change : (k,) what the filter finds beside what is stated.
    P : (k, k) its covariance.
    prior : (k,) 1-sigmas that it was found with, of what is free.
    known : (k,) 1-sigmas of what is as stated, 0 where it is exact.
    groups : (k,) numbers of the constants that components are of.
    """
    some = np.zeros(len(change), dtype=bool)
    while not some.all():
        before = _fit_prior(change, P, prior, some, known, groups)
        gains: dict[int, float] = {}
        for group in np.unique(groups[~some]).tolist():
            own = groups == group
            used = _fit_prior(change, P, prior, some | own, known, groups)
            off, left, _ = _change_prior(change, P, prior, used)
            spread = left[np.ix_(own, own)] + np.diag(known[own] ** 2)
            squared = float(off[own] @ np.linalg.solve(spread, off[own]))
            if squared > float(chdtri(own.sum(), _BY_CHANCE)):
                gains[group] = compute_evidence_gain(change, P, prior, used, before)
        best = max(gains, key=lambda group: gains[group], default=None)
        if best is None or gains[best] <= 0.0:
            break
        some |= groups == best
    return some


def compute_evidence_gain(change: Array, P: Array, prior: Array, one: Array, other: Array) -> float:
    """Difference of the log evidence between two priors of the constants.

    Parameters
    ----------
    change : (k,) estimates minus stated values.
    P : (k, k) its covariance.
    prior : (k,) 1-sigmas that it was found with.
    one, other : (k,) 1-sigmas of the two priors, 0 for known components.
    """
    return _change_prior(change, P, prior, one)[2] - _change_prior(change, P, prior, other)[2]


def _change_prior(change: Array, P: Array, prior: Array, sigma: Array) -> tuple[Array, Array, float]:
    """Estimate (k,) and covariance (k, k) with another prior, and its log evidence up to a constant."""
    information = np.linalg.inv(P)
    of_measurements = information - np.diag(prior**-2.0)
    scaled = np.eye(len(P)) + sigma[:, None] * of_measurements * sigma
    covariance = sigma[:, None] * np.linalg.solve(scaled, np.diag(sigma))
    vector = information @ change
    log_evidence = 0.5 * float(vector @ covariance @ vector - np.linalg.slogdet(scaled)[1])
    return covariance @ vector, covariance, log_evidence


def compute_prior_cost(base: Problem, freed: Freed) -> float:
    """Excess of the evidence of an estimate, because the priors of freed constants are narrow and about their
    estimates, in place of the wide ones of the test.

    With P = Q / `_WIDER`^2 the posterior covariance and Q the prior in use: ln N(0; 0, P + Q) - ln N(m; 0, P + S).

    Parameters
    ----------
    base : with all as stated.
    """
    if not freed:
        return 0.0
    asked, some = widen(base, freed), mark_free(base, freed)
    used, prior = _stack(freed, "sigma"), _stack(asked, "sigma")
    change, groups = _stack(freed, "value") - _stack(asked, "value"), _number(asked)
    for group in np.unique(groups[_are_several(groups)]).tolist():  # with a prior as wide as the errors are
        own = groups == group
        prior[own] = np.maximum(used[own], np.sqrt(np.mean(change[own] ** 2)))
    used, prior, change = used[some], prior[some], change[some]
    told = (used / _WIDER) ** 2
    narrow, wide = told + used**2, told + prior**2
    return 0.5 * float(np.sum(np.log(wide / narrow) + change**2 / wide))


def describe_freed(freed: Freed, recording: Recording) -> tuple[str, ...]:
    """Notes on constants that are not used as stated."""
    notes = Notes()
    if recording.gnss is not None and LEVER_ARM in freed:
        arms = recording.gnss.lever_arm, freed[LEVER_ARM].value
        stated, found = (", ".join(f"{x:.2f}" for x in some) for some in arms)
        sentence = (
            f"antenna: the drive contradicts lever_arm in [gnss] as stated, [{stated}] m, and is solved with [{found}] "
            "m (right, forward, up of the IMU), as it finds it: measure it, or state what was found"
        )
        notes.add("gnss.lever_arm_used", sentence)
    late = [(words, freed[name].value[0]) for name, words in _STAMPS.items() if name in freed]
    if late:
        by = " and ".join(f"{seconds:+.3f} s ({words})" for words, seconds in late)
        sentence = (
            f"stamps of the fixes: the drive contradicts them and is solved with {by} added: add it to time_offset in "
            "[gnss]"
        )
        notes.add("gnss.time_offset_used", sentence)
    if ODOMETER_DELAY in freed:
        late_by = freed[ODOMETER_DELAY].value[0]
        sentence = (
            f"odometer: the drive contradicts its stamps and is solved with readings {late_by:.3f} s late: take it off "
            "them, or state delay_sigma in [odometer]"
        )
        notes.add("odometer.delay_used", sentence)
    if CLOCK_RATE in freed:
        ppm = freed[CLOCK_RATE].value[0] * 1e6
        sentence = (
            f"clocks of IMU and fixes drift apart: the IMU's gains {ppm:.0f} ppm on that of the fixes, as the drive "
            "finds it, and their stamps are corrected by it"
        )
        notes.add("gnss.clock_rate_used", sentence)
    return tuple(notes)


def _stack_stated(problem: Problem, asked: Freed) -> Array:
    """(n,) 1-sigmas as stated: a parameter's prior sigma, 0 for constants that are not parameters."""
    parameters = problem.parameters
    return np.concatenate(
        [parameters[name].sigma if name in parameters else np.zeros(len(one.value)) for name, one in asked.items()]
    )


def _stack(freed: Freed, of: str) -> Array:
    """(n,) values or sigmas of all, one after the other."""
    return np.concatenate([getattr(one, of) for one in freed.values()])


def _split(freed: Freed, value: Array, sigma: Array) -> dict[str, FreedConstant]:
    """The same constants with the values and sigmas (n,) of all, one after the other."""
    ends = np.cumsum([len(one.value) for one in freed.values()])[:-1]
    each = zip(freed, np.split(value, ends), np.split(sigma, ends), strict=True)
    return {name: FreedConstant(tuple(x.tolist()), tuple(s.tolist())) for name, x, s in each}
