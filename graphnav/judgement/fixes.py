"""Fixes against a smoothed trajectory: a factor on their sigmas, what of their errors is slow, and what lasts.

A smoothed inertial trajectory follows what the fixes do slowly and refuses what they do fast, so its residuals show
the fast part of the receiver's error. With f the ratio of their square to what the stated sigmas promise, by medians:
f > 1, the sigmas are multiplied by sqrt(f) (a variance factor); f < 1, either they are too large or, far more often,
the rest of the error changes slowly and has gone into the trajectory. A stated sigma is meant to hold for the whole
error, so the missing share 1 - f is taken to be slow. Read otherwise, a thousand fixes wrong alike would promise
thirty times too much. Where fixes are of several types (`graphnav.judgement.types`) all this is asked of each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import gammaln

from graphnav.config import Settings
from graphnav.config.gnss import of_type
from graphnav.constraints.base import Constraint
from graphnav.constraints.gnss import GnssPosition, GnssVelocity, period
from graphnav.judgement.chance import CLEARLY, FEWEST, SIGNIFICANT, independent, median, scatter
from graphnav.judgement.residuals import record
from graphnav.judgement.types import apart, factors
from graphnav.problem import Problem
from graphnav.recording import FIX_TYPES, Recording
from graphnav.rotation import Array
from graphnav.solvers.batch import batch
from graphnav.solvers.passes import Smoothed

FIXES = 600  # fixes the judgement is made on, from the first motion
LONG = 600.0  # s, at least, where their errors may last
_OUTLIER = 6.0  # whitened norm of a fix that no Gaussian would have
_MOST = 0.98  # the largest share called slow
_SLOW = 0.5  # share of the stated variance that is slow where nothing tells
_TAILS = (3.0, 5.0, 9.0, 20.0, 100.0)  # degrees of freedom that are tried


@dataclass(frozen=True)
class FixQuality:
    """Factor on the stated position sigmas, share of the variance that is slow, and for how long the rest lasts."""

    sd_factor: float = 1.0
    slow_share: float = 0.0
    fast_time: float = 0.0  # s
    up_factor: float | None = None  # that of heights; `sd_factor` when None
    robust_scale: float | None = None  # of Cauchy's kernel, what tails there are ask for
    types: Mapping[str, FixQuality] = field(default_factory=dict)  # the same of each, where types differ
    count: int = 0  # of the fixes that a type's figures are told from

    def applied(self, settings: Settings) -> Settings:
        """Settings with what the user left open filled in."""
        gnss = settings.gnss
        factor = self._of("sd_factor")
        if isinstance(gnss.sd_factor, Mapping):  # perhaps for some types alone
            factor = {name: of_type(factor, name, 1.0) for name in FIX_TYPES.values()} | gnss.sd_factor
        elif gnss.sd_factor is not None:
            factor = gnss.sd_factor
        found = {
            "sd_factor": factor,
            "slow_share": self._of("slow_share") if gnss.slow_share is None else gnss.slow_share,
            "up_factor": gnss.up_factor or (self._of("up_factor") if gnss.sd_factor is None else None),
            "fast_time": self._of("fast_time") if gnss.fast_time is None else gnss.fast_time,
        }
        scale = self._of("robust_scale")
        if scale is not None and "robust_scale" not in gnss.model_fields_set:
            if isinstance(scale, Mapping) and gnss.robust != "automatic":
                scale = {**dict.fromkeys(FIX_TYPES.values(), gnss.robust_scale), **scale}
            found["robust_scale"] = scale
        return settings.model_copy(update={"gnss": gnss.model_copy(update=found)})

    def _of(self, key: str) -> Any:
        """A figure, or that of every type that has one, by name; None where none has."""
        if not self.types:
            return getattr(self, key)
        return {name: x for name, one in self.types.items() if (x := getattr(one, key)) is not None} or None

    @property
    def worst(self) -> float:
        """The largest factor, of any type."""
        return max((one.sd_factor for one in self.types.values()), default=self.sd_factor)

    @property
    def lasts(self) -> bool:
        """Whether errors last, of fixes of any type."""
        return any(one.fast_time > 0.0 for one in (self, *self.types.values()))

    @property
    def notes(self) -> tuple[str, ...]:
        """What was found, in words."""
        if self.types:
            return tuple(
                f"{name} fixes: {one._words}, told from {one.count}" for name, one in self.types.items() if one.count
            )
        if self.fast_time > 0.0:
            up = self.sd_factor if self.up_factor is None else self.up_factor
            larger = (
                f", and {self.sd_factor:.1f} times (up {up:.1f}) as large as stated"
                if max(self.sd_factor, up) > 1
                else ""
            )
            return (
                f"errors of the fixes last (multipath), {self.fast_time:.2g} s{larger}: they are weighed accordingly",
            )
        if self.sd_factor > 1.0:
            return (f"the fixes scatter {self.sd_factor:.1f} times as much as they state: their sigmas were raised",)
        if self.slow_share > 0.0:
            fast = 100 * (1 - self.slow_share)
            return (f"{fast:.0f} % of the fixes' stated variance is seen to be fast; the rest is taken to be slow",)
        return ()

    @property
    def _words(self) -> str:
        """What was found of a type."""
        if self.fast_time > 0.0:
            return f"sigmas x {self.sd_factor:.1f} (up {self.up_factor:.1f}), errors last {self.fast_time:.2g} s"
        if self.slow_share > 0.0:
            return f"{100 * (1 - self.slow_share):.0f} % of the stated variance is fast, the rest slow"
        return f"sigmas x {self.sd_factor:.1f}" if self.sd_factor > 1.0 else "as stated"


def stretch(recording: Recording, begin: float, least: float = 0.0) -> Recording:
    """The part of a recording to judge on: from its start to `FIXES` fixes after `begin` (s, its clock).

    For a time of `least` s after that in any case, where there is so much.
    """
    gnss = recording.gnss
    assert gnss is not None
    later = gnss.t[gnss.t > begin]
    if len(later) <= FIXES:
        return recording
    return recording.crop(0.0, max(float(later[FIXES]), begin + least) - recording.start)


def suspicious(problem: Problem, smoothed: Smoothed) -> bool:
    """Whether there are outliers among the fixes."""
    return any(np.sqrt(record(problem, rows, smoothed).nis.max(initial=0.0)) > _OUTLIER for rows in _kinds(problem))


def outliers(problem: Problem, smoothed: Smoothed) -> dict[str, Array]:
    """Weights (N,) of the fixes and their velocities, those that a batch solution with Cauchy's kernel leaves them.

    What one outlier does to the states around it would otherwise pass for noise of the IMU.
    """
    kinds = _kinds(problem)
    robust = {rows.name: replace(rows, weight=None, robust="cauchy") for rows in kinds}
    trial = replace(problem, constraints=tuple(robust.get(c.name, c) for c in problem.constraints))
    solved = batch(trial, smoothed.states, wanted=(), reintegrate=False)
    return {name: np.maximum(solved.records[name].weight, 1e-8) for name in robust}


def judge_fixes(problem: Problem, smoothed: Smoothed, together: bool = False) -> FixQuality | None:
    """Judge the fixes by a smoothed solution that took their errors as white; each type apart if they differ.

    Sigmas may have been multiplied already, by type; what is found is of those stated. None when there are too few to
    say anything.

    Parameters
    ----------
    together : all types alike in any case.
    """
    rows = _fixes(problem)
    if rows is None or len(rows) < FEWEST:
        return None
    rows = replace(rows, sigma=rows.stated)
    residual = record(problem, rows, smoothed).residual
    C = rows.R_ln
    P = C @ smoothed.P[rows.keyframe][:, 3:6, 3:6] @ np.swapaxes(C, -1, -2)
    # a residual is smaller than the error by what the trajectory took up of it
    left = 1.0 - np.diagonal(P, axis1=-2, axis2=-1) / rows.sigma**2
    usable = np.all(left > 0.2, axis=1)
    if np.count_nonzero(usable) < FEWEST:
        return None
    z = residual / rows.sigma * _of_rows(problem.settings.gnss.sd_factor, rows)
    squared = np.sum(z**2 / np.maximum(left, 0.2), axis=1)[usable]
    if rows.type is not None and not together:
        kinds = rows.type[usable]
        drawn = apart(factors(z[usable], squared, kinds))
        if drawn is not None:
            count = {name: int(np.count_nonzero(kinds == kind)) for kind, name in FIX_TYPES.items()}
            types = {name: replace(_quality(np.exp(x), sd), count=count[name]) for name, (x, sd) in drawn.items()}
            return FixQuality(types=types)
    return _quality(float(np.median(squared)) / median(3), scatter(3.0 * len(squared)))


def _of_rows(value: float | Mapping[str, float] | None, rows: GnssPosition) -> float | Array:
    """A setting that may be by type, 1 where it is unset: one number, or (N, 1)."""
    if rows.type is None or not isinstance(value, Mapping):
        return of_type(value, FIX_TYPES[0], 1.0)
    return np.array([of_type(value, name, 1.0) for name in FIX_TYPES.values()])[rows.type][:, None]


def _quality(f: float, sd: float) -> FixQuality:
    """What a variance factor says where it is clear; `sd` is that of its logarithm."""
    if abs(np.log(f)) < SIGNIFICANT * sd:
        return FixQuality()
    if f > 1.0:
        return FixQuality(sd_factor=float(np.sqrt(f)))
    return FixQuality(slow_share=min(1.0 - f, _MOST))


def judge_lasting(problem: Problem, smoothed: Smoothed, fixes: FixQuality) -> FixQuality:
    """Judge fixes whose errors last, by a smoothed solution that weighs them as such.

    Where `fixes`, what they are as white ones, differ by type, only types clearly worse than stated are judged.
    """
    rows = _fixes(problem)
    assert rows is not None
    gnss = problem.settings.gnss
    factor = np.broadcast_to(_of_rows(gnss.sd_factor, rows), (len(rows), 1))
    up = factor if gnss.up_factor is None else _of_rows(gnss.up_factor, rows) * np.ones_like(factor)
    z = record(problem, rows, smoothed).residual / rows.stated * np.hstack([factor, factor, up])
    t = problem.t[rows.keyframe]
    if not fixes.types or rows.type is None:
        return _lasting(z, t)
    types = dict(fixes.types)
    for kind, name in FIX_TYPES.items():
        own = rows.type == kind
        if types[name].sd_factor > CLEARLY and np.count_nonzero(own) >= FEWEST:
            found = _lasting(z[own], t[own])
            types[name] = replace(found, count=types[name].count) if found.fast_time > 0.0 else types[name]
    return FixQuality(types=types)


def _lasting(z: Array, t: Array) -> FixQuality:
    """Of residuals (N, 3) against what is stated, at times t (N,).

    For how long, their autocorrelation tells. Each is taken for no more than the tails of its distribution allow, so
    that one stretch does not decide.
    """
    scale, nu = _student(z)
    psi = z / scale / (1.0 + np.sum((z / scale) ** 2, axis=1, keepdims=True) / nu)
    alike = z.size / independent(psi)
    time = 0.5 * period(t) / np.arctanh(1.0 / alike) if alike > 1.0 else 0.0
    fast = scale**2 * nu / (nu + 3.0)
    total = fast + _SLOW
    return FixQuality(
        float(np.sqrt(total[0])),
        _SLOW / float(total[0]),
        float(time),
        float(np.sqrt(total[2])),
        float(np.sqrt(nu + 3.0)),
    )


def _student(z: Array) -> tuple[Array, float]:
    """Scale (3,) of rows z (N, 3), one for both horizontal axes, and degrees of freedom of Student's t, most likely.

    Their variance is not below what is left of the stated one: a sigma is meant to hold for the whole error.

    By expectation and maximisation (Lange, Little and Taylor 1989, "Robust statistical modeling using the t
    distribution") for some degrees of freedom each.
    """
    best, found = -np.inf, (np.ones(3), np.inf)
    for nu in _TAILS:
        scale = np.median(np.abs(z), axis=0) / np.sqrt(median(1))
        for _ in range(30):
            weight = (nu + 3.0) / (nu + np.sum((z / scale) ** 2, axis=1, keepdims=True))
            variance = np.mean(weight * z * z, axis=0)
            variance[:2] = np.mean(variance[:2])
            scale = np.sqrt(np.maximum(variance, _SLOW * (nu + 3.0) / nu))
        s = np.sum((z / scale) ** 2, axis=1)
        likelihood = gammaln(0.5 * (nu + 3.0)) - gammaln(0.5 * nu) - 1.5 * np.log(nu) - np.sum(np.log(scale))
        likelihood -= 0.5 * (nu + 3.0) * float(np.mean(np.log1p(s / nu)))
        if likelihood > best:
            best, found = likelihood, (scale, nu)
    return found


def _kinds(problem: Problem) -> list[Constraint]:
    return [c for c in problem.constraints if isinstance(c, GnssPosition | GnssVelocity)]


def _fixes(problem: Problem) -> GnssPosition | None:
    return next((c for c in problem.constraints if isinstance(c, GnssPosition)), None)
