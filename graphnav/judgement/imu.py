"""The IMU against what a smoother says the process noise of every interval was.

With d the smoothed minus the predicted state at an interval's end and P-, P^s their covariances (de Jong and
Koopman's disturbance smoother),

    w = Q P-^-1 d        var w = Q P-^-1 (P- - P^s) P-^-1 Q

and the ratio of the two is a variance factor for rate noise, force noise and both bias walks (Koch, *Parameter
Estimation and Hypothesis Testing in Linear Models*, 3.6). Vibration, aliasing and temperature make real drives
several times noisier than a data sheet. Once one figure is clearly too small all four are estimated, in rounds,
because noise that one lacks looks like noise of its neighbours; none is set below what is stated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphnav.judgement.chance import CLEARLY, FEWEST, MOST_RAISED, SIGNIFICANT, independent, scatter, trimmed
from graphnav.problem import Problem
from graphnav.recording import ImuNoise
from graphnav.solvers.passes import Forward, Smoothed
from graphnav.state import DIM

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


def judge_imu(problem: Problem, forward: Forward, smoothed: Smoothed) -> ImuQuality:
    """Judge the IMU's noise figures by what the smoother says the noise of every interval was."""
    ahead = forward.predicted
    moved = np.concatenate([smoothed.states.minus(ahead.states), smoothed.values - ahead.values], axis=1)[1:]
    before, after = forward.P_predicted[1:], smoothed.P[1:]
    inverse = np.linalg.inv(before)
    pull = (inverse @ moved[..., None])[:, :DIM]
    gained = (inverse @ (before - after) @ inverse)[:, :DIM, :DIM]
    frames = problem.motion.frames(slice(None), forward.states.R_nb[:-1])
    Q = problem.intervals.covariance
    QL = Q @ np.swapaxes(frames, -1, -2)
    noise = (QL @ pull)[..., 0]
    variance = np.diagonal(QL @ gained @ np.swapaxes(QL, -1, -2), axis1=-2, axis2=-1)
    stated = np.diagonal(Q, axis1=-2, axis2=-1)
    factors, clear = {}, []
    for name, at in _FIGURES.items():
        seen = np.all(variance[:, at] > 1e-7 * stated[:, at], axis=1)  # elsewhere the data say nothing of it
        if np.count_nonzero(seen) < FEWEST:
            continue
        z = noise[seen, at] / np.sqrt(variance[seen, at])
        factors[name] = trimmed(z * z)
        if np.log(factors[name]) > SIGNIFICANT * scatter(independent(z)):
            clear.append(name)
    return ImuQuality(factors, tuple(clear))


def noisiest(noise: ImuNoise) -> ImuNoise:
    """The worst that an IMU will be judged to be: what contradicts even that is gross."""
    return replace(noise, **{name: MOST_RAISED * getattr(noise, name) for name in _FIGURES})


def exhausted(noise: ImuNoise, stated: ImuNoise) -> bool:
    """Whether a figure was raised as far as any is, and so does not explain what it was raised for."""
    return any(getattr(noise, name) >= (1.0 - 1e-9) * MOST_RAISED * getattr(stated, name) for name in _FIGURES)


def calmer(noise: ImuNoise, than: ImuNoise) -> bool:
    """Whether an IMU is clearly less noisy by some figure, and by none clearly more."""
    ratio = [getattr(noise, name) / getattr(than, name) for name in _FIGURES]
    return min(ratio) < 1.0 / CLEARLY and max(ratio) < CLEARLY


def imu_notes(stated: ImuNoise, used: ImuNoise) -> tuple[str, ...]:
    """A sentence on figures that were raised."""
    ratios = {words: getattr(used, name) / getattr(stated, name) for name, words in _WORDS.items()}
    up = [f"{words} {ratio:.1f}" for words, ratio in ratios.items() if ratio > 1.0]
    return (f"the IMU is noisier on this drive than stated; figures were multiplied: {', '.join(up)}",) if up else ()
