"""States between keyframes, at any rate: the IMU's samples integrated from the keyframe before.

A filter's state between keyframes is that prediction. A smoother knows the next keyframe too; the difference between
prediction and that keyframe is distributed over the interval so that position, velocity and attitude remain consistent:
that of position is the cubic that starts at zero and ends with the differences of position and velocity, that of
velocity its derivative, attitude and biases are linear.

Covariances are interpolated linearly: a filter's to that of the prediction of the next keyframe, a smoother's to that
of the next keyframe. To a smoother's, what white noise of the IMU adds between the ends comes on top, alike along all
axes (the bridges of a Wiener process and of an integrated one): with s the fraction of an interval of length T, q_v and
q_theta the variances that it has added at its end

    theta: q_theta s (1 - s)      v: q_v s (1 - s) (1 - 3 s (1 - s))     p: q_v T^2 (s (1 - s))^3 / 3
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, DIM, States, split_covariance
from graphnav.estimation.problem import Problem
from graphnav.imu.dynamics import EarthMotion, convert_to_biases
from graphnav.imu.preintegration import integrate_within
from graphnav.imu.samples import Samples


def list_times(start: float, end: float, rate: float) -> Array:
    """Multiples of 1/rate between two times (s), and both ends.

    Raises
    ------
    EstimationError
        If the rate is not above zero.
    """
    if not 0.0 < rate < np.inf:
        raise EstimationError(f"a rate of {rate:g} Hz: it must be above zero", key="option.value")
    steps = np.arange(np.ceil(start * rate), np.floor(end * rate) + 1) / rate
    inner = steps[(steps > start + 1e-6) & (steps < end - 1e-6)]
    return np.concatenate([[start], inner, [end]])


@dataclass(frozen=True)
class AtKeyframes:
    """Data for states between the keyframes of one piece of a recording."""

    t: Array  # (K,) s
    states: States
    covariance: Array  # (K, 15, 15)

    @property
    def start(self) -> float:
        """First keyframe, s."""
        return float(self.t[0])

    @property
    def end(self) -> float:
        """Last keyframe, s."""
        return float(self.t[-1])

    def list_times(self, rate: float) -> Array:
        """Multiples of 1/rate on the recording's clock, and both ends."""
        return list_times(self.start, self.end, rate)


@dataclass(frozen=True)
class Dense(AtKeyframes):
    """Callable for `Solution.between`."""

    samples: Samples
    frame: LocalFrame
    ba: Array  # (K-1, 3) biases, scale errors included, of each interval
    bg: Array  # (K-1, 3)
    white: Array  # (2, K-1) q_theta, q_v
    ahead: Array | None = None  # (K-1, 15, 15) of a filter: predicted at the end of each interval

    def widen(self, covariance: Array) -> Dense:
        """The same with covariances (K, 15, 15), and what they are more in between as well."""
        ahead = None if self.ahead is None else self.ahead + (covariance - self.covariance)[1:]
        return replace(self, covariance=covariance, ahead=ahead)

    def __call__(self, t: Array) -> tuple[States, Array]:
        """States and covariances (M, 15, 15) at ascending times from `start` to `end`."""
        k, s = self._locate(t)
        P, after, w = self.covariance.take(k, axis=0), self._end.take(k, axis=0), s[:, None, None]
        P *= 1.0 - w
        after *= w
        P += after
        if self.ahead is not None:
            own = _is_end(s)
            P[own] = self.covariance[k[own] + 1]
        for name, more in self._add_white(k, s).items():
            at = np.arange(*BLOCKS[name].indices(DIM))
            P[:, at, at] += more[:, None]
        return self._reach(t, k, s), P

    def interpolate_blocks(self, t: Array) -> tuple[States, dict[str, Array]]:
        """The same with covariances (6, M) of position, velocity and attitude each by itself."""
        k, s = self._locate(t)
        apart = {name: own.take(k, axis=1) + s * change.take(k, axis=1) for name, (own, change) in self._apart.items()}
        if self.ahead is not None:
            exact = np.flatnonzero(_is_end(s))
            for name, (own, _) in self._apart.items():
                apart[name][:, exact] = own[:, k[exact] + 1]
        for name, more in self._add_white(k, s).items():
            apart[name][:3] += more
        return self._reach(t, k, s), apart

    def _add_white(self, k: Array, s: Array) -> dict[str, Array]:
        """Variances (M,) of position, velocity and attitude that a smoother has between its keyframes."""
        if self.ahead is not None:
            return {}
        turn, gain = self.white.take(k, axis=1)
        T, b = np.diff(self.t)[k], s * (1.0 - s)
        return {"theta": turn * b, "v": gain * b * (1.0 - 3.0 * b), "p": gain * T**2 * b**3 / 3.0}

    @property
    def _end(self) -> Array:
        """(K-1, 15, 15) that covariances are interpolated to."""
        return self.covariance[1:] if self.ahead is None else self.ahead

    @cached_property
    def _apart(self) -> dict[str, tuple[Array, Array]]:
        own, end = split_covariance(self.covariance), split_covariance(self._end)
        return {block: (one, end[block] - one[:, :-1]) for block, one in own.items()}

    def _locate(self, t: Array) -> tuple[Array, Array]:
        """The keyframe before each time, and the elapsed fraction of the interval after it."""
        k = np.clip(np.searchsorted(self.t, t, side="left") - 1, 0, len(self.t) - 2)
        return k, (t - self.t[k]) / np.diff(self.t)[k]

    def _reach(self, t: Array, k: Array, s: Array) -> States:
        begin = int(np.searchsorted(t, self.t[0], side="right"))  # of the times behind the first keyframe
        first, t, k, s = self.states[k[:begin]], t[begin:], k[begin:], s[begin:]
        if not len(t):
            return first
        reached = self._smooth_between(t, k, s) if self.ahead is None else self._filter_between(t, k, s)
        return States.stack([first, reached]) if begin else reached

    def _filter_between(self, t: Array, k: Array, s: Array) -> States:
        reached = self._predict(t)
        exact = np.flatnonzero(_is_end(s))
        for name in States.__dataclass_fields__:
            getattr(reached, name)[exact] = getattr(self.states, name)[k[exact] + 1]
        return reached

    def _smooth_between(self, t: Array, k: Array, s: Array) -> States:
        # predicted as well: the end of every interval that contains a time, for the difference there
        touched, interval = np.unique(k, return_inverse=True)
        ends = self.t[touched + 1]
        targets = np.sort(np.concatenate([t, ends]), kind="stable")  # nearly sorted already
        ahead = self._predict(targets)
        miss = self.states[touched + 1].minus(ahead[np.searchsorted(targets, ends)])
        T = ends - self.t[touched]
        return ahead[np.searchsorted(targets, t)].plus(_distribute(miss[interval], s[:, None], T[interval, None]))

    def _predict(self, t: Array) -> States:
        """Prediction from the keyframe before each time."""
        k = np.searchsorted(self.t, t, side="left") - 1
        # only for the intervals needed, so that few times cost little
        first, last = int(k[0]), int(k[-1]) + 1
        samples, used = self.samples.select_between(self.t[first], self.t[last]), slice(first, last)
        dR, dV, dP = integrate_within(samples, self.t[first : last + 1], t, self.ba[used], self.bg[used])
        return EarthMotion(t - self.t[k], self.frame).reach(slice(None), self.states[used], dR, dP, dV, k - first)


def _distribute(miss: Array, s: Array, T: Array) -> Array:
    """The share (M, 15) of a difference at the fraction s of intervals of length T."""
    out = miss * s
    p, v = miss[:, 3:6], miss[:, 6:9]
    out[:, 3:6] = p * (3 * s**2 - 2 * s**3) + v * T * (s**3 - s**2)
    out[:, 6:9] = p * (6 * s - 6 * s**2) / T + v * (3 * s**2 - 2 * s)
    return out


def _is_end(s: Array) -> Array:
    """Of fractions of intervals: which are at the next keyframe."""
    return np.isclose(s, 1.0, rtol=0.0, atol=1e-9)


def make_dense(
    problem: Problem, states: States, covariance: Array, scale: Array | None, ahead: Array | None = None
) -> Dense:
    """Make the states between keyframes of a solution; `scale` is (k,) or, for a filter, (K, k) as of each keyframe.

    `ahead` as of `Dense`.
    """
    ba, bg = states.ba[:-1], states.bg[:-1]
    if scale is not None:
        scale = np.broadcast_to(scale, (len(states), scale.shape[-1]))[:-1]
        of_accel, of_gyro = convert_to_biases(scale, *problem.intervals.inputs)
        ba, bg = ba + of_accel, bg + of_gyro
    noise = np.diagonal(problem.intervals.covariance, axis1=1, axis2=2)
    white = np.stack([noise[:, BLOCKS[name]].mean(axis=1) for name in ("theta", "v")])
    return Dense(problem.t, states, covariance, problem.samples, problem.frame, ba, bg, white, ahead)
