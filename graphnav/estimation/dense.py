"""States between keyframes, at any rate: the IMU's samples integrated from the keyframe before.

A filter's state between keyframes is that prediction. A smoother knows the next keyframe too; the difference between
prediction and that keyframe is distributed over the interval so that position, velocity and attitude remain consistent:
that of position is the cubic that starts at zero and ends with the differences of position and velocity, that of
velocity its derivative, attitude and biases are linear. Covariances are interpolated linearly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.problem import Problem
from graphnav.imu.dynamics import EarthMotion, as_biases
from graphnav.imu.preintegration import within
from graphnav.imu.samples import Samples


def times_between(start: float, end: float, rate: float) -> Array:
    """Multiples of 1/rate between two times (s), and both ends."""
    steps = np.arange(np.ceil(start * rate), np.floor(end * rate) + 1) / rate
    inner = steps[(steps > start + 1e-6) & (steps < end - 1e-6)]
    return np.concatenate([[start], inner, [end]])


@dataclass(frozen=True)
class Dense:
    """Callable for `Solution.between`."""

    samples: Samples
    frame: LocalFrame
    t: Array  # (K,)
    states: States
    covariance: Array  # (K, 15, 15)
    ba: Array  # (K-1, 3) biases with scale errors, as each interval saw them
    bg: Array  # (K-1, 3)
    smooth: bool

    @property
    def start(self) -> float:
        """First keyframe, s."""
        return float(self.t[0])

    @property
    def end(self) -> float:
        """Last keyframe, s."""
        return float(self.t[-1])

    def times(self, rate: float) -> Array:
        """Multiples of 1/rate on the recording's clock, and both ends."""
        return times_between(self.start, self.end, rate)

    def __call__(self, t: Array, size: int = DIM) -> tuple[States, Array]:
        """States and covariances (M, size, size), of the first error components, at ascending times from `start` to
        `end`.
        """
        k = np.clip(np.searchsorted(self.t, t, side="left") - 1, 0, len(self.t) - 2)
        T = np.diff(self.t)[k]
        s = (t - self.t[k]) / T
        # every time is predicted from its keyframe, and so is the end of every interval that contains one, for the
        # difference
        touched = np.unique(k)
        ends = self.t[touched + 1] if self.smooth else self.t[:0]
        targets = np.unique(np.concatenate([t[t > self.t[0]], ends]))
        ahead = self._predict(targets)
        states = self.states[k]
        moved = t > self.t[0]
        at = np.searchsorted(targets, t[moved])
        reached = ahead[at]
        if self.smooth:
            predicted = ahead[np.searchsorted(targets, ends)]
            miss = self.states[touched + 1].minus(predicted)[np.searchsorted(touched, k[moved])]
            reached = reached.plus(_distribute(miss, s[moved, None], T[moved, None]))
        else:
            exact = np.isclose(s[moved], 1.0, rtol=0.0, atol=1e-9)
            reached = _choose(exact, self.states[k[moved] + 1], reached)
        states = _choose(moved, _scatter(reached, moved, states), states)
        w = s[:, None, None]
        before, after = self.covariance[k, :size, :size], self.covariance[k + 1, :size, :size]
        return states, (1.0 - w) * before + w * after

    def _predict(self, t: Array) -> States:
        """Prediction from the keyframe before each time."""
        k = np.searchsorted(self.t, t, side="left") - 1
        if not len(t):
            return self.states[k]
        # only of the intervals needed, so that few times cost little
        first, last = int(k[0]), int(k[-1]) + 1
        samples, used = self.samples.between(self.t[first], self.t[last]), slice(first, last)
        dR, dV, dP = within(samples, self.t[first : last + 1], t, self.ba[used], self.bg[used])
        return EarthMotion(t - self.t[k], self.frame).reach(slice(None), self.states[k], dR, dP, dV)


def _distribute(miss: Array, s: Array, T: Array) -> Array:
    """The share (M, 15) of a difference at the fraction s of intervals of length T."""
    out = miss * s
    p, v = miss[:, 3:6], miss[:, 6:9]
    out[:, 3:6] = p * (3 * s**2 - 2 * s**3) + v * T * (s**3 - s**2)
    out[:, 6:9] = p * (6 * s - 6 * s**2) / T + v * (3 * s**2 - 2 * s)
    return out


def _choose(mask: Array, yes: States, no: States) -> States:
    """Rows of one struct or the other."""
    return States(
        np.where(mask[:, None, None], yes.R_nb, no.R_nb),
        *(np.where(mask[:, None], getattr(yes, f), getattr(no, f)) for f in ("p", "v", "ba", "bg")),
    )


def _scatter(rows: States, mask: Array, like: States) -> States:
    """`rows` where `mask` is true; elsewhere those of `like`."""
    out = like[np.arange(len(like))]
    for name in ("R_nb", "p", "v", "ba", "bg"):
        getattr(out, name)[mask] = getattr(rows, name)
    return out


def dense(problem: Problem, states: States, covariance: Array, scale: Array | None, smooth: bool) -> Dense:
    """Make the states between keyframes of a solution; `scale` is (k,) or, for a filter, (K, k) as of each keyframe."""
    ba, bg = states.ba[:-1], states.bg[:-1]
    if scale is not None:
        scale = np.broadcast_to(scale, (len(states), scale.shape[-1]))[:-1]
        of_accel, of_gyro = as_biases(scale, problem.intervals.force, problem.intervals.rate)
        ba, bg = ba + of_accel, bg + of_gyro
    return Dense(problem.samples, problem.frame, problem.t, states, covariance, ba, bg, smooth)
