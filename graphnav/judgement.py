"""How good the sensors really are: what a smoothed first part of the drive says against the stated figures.

Two questions, both answered so that outliers and bad stretches do not decide, and acted on only where the answer
is clear (three standard deviations of what chance would do).

*Fixes.* A smoothed inertial trajectory follows what the fixes do slowly and refuses what they do fast, so its
residuals show the fast part of the receiver's error. With f the ratio of their square to what the stated sigmas
promise, by medians: f > 1, the sigmas are multiplied by sqrt(f) (a variance factor); f < 1, either they are too
large or, far more often, the rest of the error changes slowly and has gone into the trajectory. A stated sigma is
meant to hold for the whole error, so the missing share 1 - f is taken to be slow. Read otherwise, a thousand fixes
wrong alike would promise thirty times too much.

*IMU.* The smoother also says what the process noise of every interval was (de Jong and Koopman's disturbance
smoother). With d the smoothed minus the predicted state at its end and P-, P^s their covariances,

    w = Q P-^-1 d        var w = Q P-^-1 (P- - P^s) P-^-1 Q

and the ratio of the two is a variance factor for rate noise, force noise and both bias walks (Koch, *Parameter
Estimation and Hypothesis Testing in Linear Models*, 3.6). Vibration, aliasing and temperature make real drives
several times noisier than a data sheet. Once one figure is clearly too small all four are estimated, in rounds,
because noise that one lacks looks like noise of its neighbours; none is set below what is stated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtr, chdtri, gammaincinv, gammaln

from graphnav.config import Settings
from graphnav.constraints.base import Constraint, assemble, weighted_sigma
from graphnav.constraints.gnss import GnssPosition, GnssVelocity, period
from graphnav.constraints.vehicle import NonHolonomic, OdometerSpeed
from graphnav.problem import Problem
from graphnav.recording import ImuNoise, Recording
from graphnav.rotation import Array
from graphnav.solution import ConstraintRecord
from graphnav.solvers.batch import batch
from graphnav.solvers.ekf import Filtered, Smoothed, residual_record
from graphnav.state import DIM, States

Speed = NonHolonomic | OdometerSpeed | GnssVelocity
_WHEELS = (NonHolonomic, OdometerSpeed)
FIXES = 600  # fixes the judgement is made on, from the first motion
LONG = 600.0  # s, at least, where their errors may last
ROUNDS = 4
MOST_RAISED = 10.0  # an IMU ten times worse than stated is not the explanation: the fixes are, and are judged next
_SIGNIFICANT = 3.0  # standard deviations of the estimate of a factor that it must differ from 1
_OUTLIER = 6.0  # whitened norm of a fix that no Gaussian would have
CLEARLY = 1.3  # ratio of two figures of noise that makes a difference
_MOST = 0.98  # the largest share called slow
_TRIMMED = 0.01
_SLOW = 0.5  # share of the stated variance that is slow where nothing tells
_TAILS = (3.0, 5.0, 9.0, 20.0, 100.0)  # degrees of freedom that are tried
BLOCK = 10.0  # s
_FEWEST = 30  # fixes or intervals that say anything
_FIGURES = {
    "gyro_noise_density": slice(0, 3),
    "accel_noise_density": slice(6, 9),
    "accel_bias_walk": slice(9, 12),
    "gyro_bias_walk": slice(12, 15),
}
_WORDS = {
    "gyro_noise_density": "gyro noise",
    "accel_noise_density": "accelerometer noise",
    "accel_bias_walk": "accelerometer bias walk",
    "gyro_bias_walk": "gyro bias walk",
}


@dataclass(frozen=True)
class FixQuality:
    """Factor on the stated position sigmas, share of the variance that is slow, and for how long the rest lasts."""

    sd_factor: float = 1.0
    slow_share: float = 0.0
    fast_time: float = 0.0  # s
    up_factor: float | None = None  # that of heights; `sd_factor` when None
    robust_scale: float | None = None  # of Cauchy's kernel, what tails there are ask for

    def applied(self, settings: Settings) -> Settings:
        """Settings with what the user left open filled in."""
        gnss = settings.gnss
        found = {
            "sd_factor": self.sd_factor if gnss.sd_factor is None else gnss.sd_factor,
            "slow_share": self.slow_share if gnss.slow_share is None else gnss.slow_share,
            "up_factor": gnss.up_factor or (self.up_factor if gnss.sd_factor is None else None),
            "fast_time": self.fast_time if gnss.fast_time is None else gnss.fast_time,
        }
        if self.robust_scale is not None and "robust_scale" not in gnss.model_fields_set:
            found["robust_scale"] = self.robust_scale
        return settings.model_copy(update={"gnss": gnss.model_copy(update=found)})

    @property
    def notes(self) -> tuple[str, ...]:
        """What was found, in words."""
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
    return any(np.sqrt(_record(problem, rows, smoothed).nis.max(initial=0.0)) > _OUTLIER for rows in _kinds(problem))


def outliers(problem: Problem, smoothed: Smoothed) -> dict[str, Array]:
    """Weights (N,) of the fixes and their velocities, those that a batch solution with Cauchy's kernel leaves them.

    What one outlier does to the states around it would otherwise pass for noise of the IMU.
    """
    kinds = _kinds(problem)
    robust = {rows.name: replace(rows, weight=None, robust="cauchy") for rows in kinds}
    trial = replace(problem, constraints=tuple(robust.get(c.name, c) for c in problem.constraints))
    solved = batch(trial, smoothed.states, wanted=(), reintegrate=False)
    return {name: np.maximum(solved.records[name].weight, 1e-8) for name in robust}


def judge_fixes(problem: Problem, smoothed: Smoothed) -> FixQuality | None:
    """Judge the fixes by a smoothed solution that took their sigmas as stated, all white.

    None when there are too few to say anything.
    """
    rows = _fixes(problem)
    if rows is None or len(rows) < _FEWEST:
        return None
    rows = replace(rows, sigma=rows.stated)
    residual = _record(problem, rows, smoothed).residual
    C = rows.R_ln
    P = C @ smoothed.P[rows.keyframe][:, 3:6, 3:6] @ np.swapaxes(C, -1, -2)
    # a residual is smaller than the error by what the trajectory took up of it
    left = 1.0 - np.diagonal(P, axis1=-2, axis2=-1) / rows.sigma**2
    usable = np.all(left > 0.2, axis=1)
    if np.count_nonzero(usable) < _FEWEST:
        return None
    squared = np.sum((residual / rows.sigma) ** 2 / np.maximum(left, 0.2), axis=1)[usable]
    f = float(np.median(squared)) / _median(3)
    if abs(np.log(f)) < _SIGNIFICANT * _scatter(3.0 * len(squared)):
        return FixQuality()
    if f > 1.0:
        return FixQuality(sd_factor=float(np.sqrt(f)))
    return FixQuality(slow_share=min(1.0 - f, _MOST))


def judge_lasting(problem: Problem, smoothed: Smoothed) -> FixQuality:
    """Judge fixes whose errors last, by a smoothed solution that weighs them as such.

    For how long, the autocorrelation of residuals tells. Each is taken for no more than `_CLIPPED` times the usual, so
    that one stretch does not decide.
    """
    rows = _fixes(problem)
    assert rows is not None
    gnss = problem.settings.gnss
    factor = gnss.sd_factor or 1.0
    z = _record(problem, rows, smoothed).residual / rows.stated * [factor, factor, gnss.up_factor or factor]
    scale, nu = _student(z)
    psi = z / scale / (1.0 + np.sum((z / scale) ** 2, axis=1, keepdims=True) / nu)
    alike = z.size / _independent(psi)
    time = 0.5 * period(problem.t[rows.keyframe]) / np.arctanh(1.0 / alike) if alike > 1.0 else 0.0
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
        scale = np.median(np.abs(z), axis=0) / np.sqrt(_median(1))
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


def contradiction(problem: Problem, smoothed: Smoothed) -> tuple[float, float]:
    """How much wheels contradict a smoothed solution, and how much of that may be chance.

    Logarithms of the variance factors that their sums of residuals ask for, added up.
    """
    seen = [x for *_, x in _sums(problem, smoothed, _WHEELS) if len(x) >= _FEWEST]
    asked = sum(max(0.0, float(np.log(_trimmed(x)))) for x in seen)
    return asked, sum(_SIGNIFICANT * _scatter(len(x)) for x in seen)


def _sums(problem: Problem, smoothed: Smoothed, kinds: tuple[type[Any], ...]) -> Iterator[tuple[Speed, int, Array]]:
    """Constraint, axis and squared sums over blocks against their variances."""
    for rows in problem.constraints:
        if not isinstance(rows, kinds) or len(rows) < _FEWEST:
            continue
        at = rows.keyframe
        linear = rows.linearize(smoothed.states[at], _values_at(problem, smoothed, rows), slice(None))
        H = assemble(linear, problem.columns, smoothed.P.shape[-1])
        used = np.ones(len(rows), dtype=bool) if rows.weight is None else rows.weight > 0.0
        sigma = weighted_sigma(rows, linear.sigma)
        left = sigma**2 - np.einsum("nij,njk,nik->ni", H, smoothed.P[at], H, optimize=True)
        usable = used & np.all(left > 0.2 * sigma**2, axis=1)
        block = np.unique(np.floor(problem.t[at[usable]] / BLOCK), return_inverse=True)[1]
        for axis in range(len(rows.axes)):
            weight = 1.0 / sigma[usable, axis] ** 2
            total = np.bincount(block, weight * linear.residual[usable, axis])
            variance = np.bincount(block, weight**2 * left[usable, axis])
            yield rows, axis, total**2 / variance


def judge_speeds(problem: Problem, smoothed: Smoothed) -> tuple[Problem, tuple[str, ...]]:
    """The problem with the sigmas of wheels and of the receiver's velocities raised as residuals ask, and sentences.

    What matters is what errors add up to: camber, wind and load push a vehicle aside for many seconds, and reflections
    last. So the sums of whitened residuals over `BLOCK` s are judged, against what white noise of the sigmas used would
    sum up to.
    """
    raised: dict[str, Speed] = {}
    notes = []
    for rows, axis, squared in _sums(problem, smoothed, (*_WHEELS, GnssVelocity)):
        factor = np.ones(len(rows.axes))
        factor[axis] = raised_by(squared)
        if factor[axis] > 1.0:
            name = rows.axes[axis]
            notes.append(f"{rows.name}, {name}: its sigma was multiplied by {factor[axis]:.1f}, as residuals ask")
            before = raised.get(rows.name, rows)
            raised[rows.name] = replace(before, sigma=before.sigma * factor)
    return replace(problem, constraints=tuple(raised.get(c.name, c) for c in problem.constraints)), tuple(notes)


def raised_by(squared: Array) -> float:
    """Factor on a sigma that squared sums over blocks, against their variances, ask for; 1 where none is clear."""
    if len(squared) < _FEWEST:
        return 1.0
    f = _trimmed(squared)
    return min(float(np.sqrt(f)), MOST_RAISED) if np.log(f) > _SIGNIFICANT * _scatter(len(squared)) else 1.0


@dataclass(frozen=True)
class ImuQuality:
    """Variance factors for the IMU's noise figures, by their names in `ImuNoise`, and those clearly above 1."""

    factors: dict[str, float]
    clear: tuple[str, ...]

    @property
    def settled(self) -> bool:
        """Nothing left to change by a tenth."""
        return all(abs(np.log(f)) < 0.2 for f in self.factors.values())

    def applied(self, noise: ImuNoise, stated: ImuNoise) -> ImuNoise:
        """Figures multiplied, none below what is stated nor beyond `MOST_RAISED` times that."""
        found = {
            name: float(np.clip(getattr(noise, name) * np.sqrt(f), figure, MOST_RAISED * figure))
            for name, f in self.factors.items()
            for figure in [getattr(stated, name)]
        }
        return replace(noise, **found)


def judge_imu(problem: Problem, forward: Filtered, smoothed: Smoothed) -> ImuQuality:
    """Judge the IMU's noise figures by what the smoother says the noise of every interval was."""
    predicted = States.stack(forward.predicted)
    moved = np.concatenate([smoothed.states.minus(predicted), smoothed.values - forward.values_predicted], axis=1)[1:]
    before, after = forward.P_predicted[1:], smoothed.P[1:]
    inverse = np.linalg.inv(before)
    pull = (inverse @ moved[..., None])[:, :DIM]
    gained = (inverse @ (before - after) @ inverse)[:, :DIM, :DIM]
    frames = problem.motion.frames(slice(None), States.stack(forward.states[:-1]).R_nb)
    Q = problem.intervals.covariance
    QL = Q @ np.swapaxes(frames, -1, -2)
    noise = (QL @ pull)[..., 0]
    variance = np.diagonal(QL @ gained @ np.swapaxes(QL, -1, -2), axis1=-2, axis2=-1)
    stated = np.diagonal(Q, axis1=-2, axis2=-1)
    factors, clear = {}, []
    for name, at in _FIGURES.items():
        seen = np.all(variance[:, at] > 1e-7 * stated[:, at], axis=1)  # elsewhere the data say nothing of it
        if np.count_nonzero(seen) < _FEWEST:
            continue
        z = noise[seen, at] / np.sqrt(variance[seen, at])
        factors[name] = _trimmed(z * z)
        if np.log(factors[name]) > _SIGNIFICANT * _scatter(_independent(z)):
            clear.append(name)
    return ImuQuality(factors, tuple(clear))


def noisiest(noise: ImuNoise) -> ImuNoise:
    """The worst that an IMU will be judged to be: what contradicts even that is gross."""
    return replace(noise, **{name: MOST_RAISED * getattr(noise, name) for name in _FIGURES})


def calmer(noise: ImuNoise, than: ImuNoise) -> bool:
    """Whether an IMU is clearly less noisy by some figure, and by none clearly more."""
    ratio = [getattr(noise, name) / getattr(than, name) for name in _FIGURES]
    return min(ratio) < 1.0 / CLEARLY and max(ratio) < CLEARLY


def imu_notes(stated: ImuNoise, used: ImuNoise) -> tuple[str, ...]:
    """A sentence on figures that were raised."""
    ratios = {words: getattr(used, name) / getattr(stated, name) for name, words in _WORDS.items()}
    up = [f"{words} {ratio:.1f}" for words, ratio in ratios.items() if ratio > 1.0]
    return (f"the IMU is noisier on this drive than stated; figures were multiplied: {', '.join(up)}",) if up else ()


def _kinds(problem: Problem) -> list[Constraint]:
    return [c for c in problem.constraints if isinstance(c, GnssPosition | GnssVelocity)]


def _fixes(problem: Problem) -> GnssPosition | None:
    return next((c for c in problem.constraints if isinstance(c, GnssPosition)), None)


def _with(problem: Problem, rows: GnssPosition) -> tuple[Constraint, ...]:
    """The constraints with other rows for the fixes."""
    return tuple(rows if isinstance(c, GnssPosition) else c for c in problem.constraints)


def _record(problem: Problem, rows: Constraint, smoothed: Smoothed) -> ConstraintRecord:
    return residual_record(problem, rows, smoothed.states, _values(problem, smoothed))


def _values(problem: Problem, smoothed: Smoothed) -> dict[str, Array]:
    """(K, k) per parameter."""
    return {name: smoothed.values[:, at.start - DIM : at.stop - DIM] for name, at in problem.columns.items()}


def _values_at(problem: Problem, smoothed: Smoothed, rows: Constraint) -> dict[str, Array]:
    """(N, k) per parameter of some rows."""
    values = _values(problem, smoothed)
    return {p.name: values[p.name][rows.keyframe] for p in rows.parameters}


def _median(degrees: int) -> float:
    """Median of a chi-square variable."""
    return 2.0 * float(gammaincinv(0.5 * degrees, 0.5))


def _trimmed(squared: Array) -> float:
    """Mean of squared standard normals without the largest hundredth, over what it would be for a true sigma.

    Not the median: what noise adds up to over a minute is its mean square, bumps in the road included.
    """
    most = np.quantile(squared, 1.0 - _TRIMMED)
    kept = float(chdtr(3.0, chdtri(1.0, _TRIMMED))) / (
        1.0 - _TRIMMED
    )  # E[z^2 | z^2 < q] = P(chi2_3 < q) / P(chi2_1 < q)
    return float(np.mean(squared[squared <= most])) / kept


def _scatter(count: float) -> float:
    """Standard deviation of the logarithm of a median chi-square of `count` independent values.

    That of a mean, sqrt(2/n), times about 1.25 for a median; a trimmed mean lies between.
    """
    return 1.25 * float(np.sqrt(2.0 / max(count, 2.0)))


def _independent(z: Array) -> float:
    """How many independent values (N, m) time-correlated columns are worth."""
    total = 0.0
    for x in z.T:
        power, length = float(np.mean(x * x)), 1.0
        for lag in range(1, len(x) // 4):
            r = float(np.mean(x[lag:] * x[:-lag])) / power
            if r < 0.05:
                break
            length += 2.0 * r
        total += len(x) / length
    return total
