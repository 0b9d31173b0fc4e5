"""The change of speed between stationary-looking spans, by the IMU.

A span in which nothing changes is a stop or a smooth cruise: an IMU by itself cannot distinguish them. But no vehicle
passes from one to the other without acceleration. The specific force between two such spans, levelled with the tilt
that the gyro measured, integrates to the difference of their speeds:

    dv = integral (f_y - f_y0 + g dpitch) dt,     dpitch = integral (omega_x - bias) dt

so that one known speed gives those of all linked spans, and where none is known the faster of two cannot be a stop. The
same integral decides whether a disturbance between two stops moved the vehicle or only shook it. Taken from one span
out to where a speed was last or next measured, it decides whether the span can be a stop at all: if it is, the integral
equals that speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array
from graphnav.detectors.windows import BlockMeans

_INNER = 1.5  # s of a span from which its mean force and rate are taken
LONGEST_LINK = 60.0  # s between spans over which a difference of speed is still informative
_LEAST_SIGMA = 0.02  # m/s, smallest 1-sigma of any such difference
_SIGMAS = 3.0
_G = 9.81  # m/s^2
_TURN_ON = 1.0e-4  # rad/s, by which a gyro's bias may differ from its mean over the spans
_CROSS_AXIS = 0.01  # share of the yaw that gyro scale factors and axis misalignments turn into tilt
_STRAIGHT_YAW = 0.3  # rad of yaw; beyond, accelerometer biases seen at first act along other axes
_MISALIGNED = 0.1  # rad, misalignment of the body's axes with the vehicle's


@dataclass(frozen=True)
class Link:
    """The change of speed from one stationary-looking span to the next."""

    change: float  # m/s, forward
    tolerance: float  # m/s, 3 sigma of the change; infinite where it is unknown
    peak: float  # m/s, largest horizontal speed between them if both are stops
    mean: float  # m/s, magnitude of the mean velocity between them if both are stops


_UNKNOWN_LINK = Link(0.0, float("inf"), float("inf"), float("inf"))


def link(b: BlockMeans, before: Array, after: Array) -> Link:
    """Change of speed between two spans, each (2,) s; unknown across a turn or a gap."""
    T = float(after[0] - before[1])
    i = int(np.searchsorted(b.t, max(before[0], before[1] - _INNER)))
    j = int(np.searchsorted(b.t, min(after[1], after[0] + _INNER)))
    n0, n1 = (int(k) - i for k in np.searchsorted(b.t, [before[1], after[0]]))
    if T > LONGEST_LINK or n0 < 3 or j - i - n1 < 3 or not b.whole[i + 1 : j].all():
        return _UNKNOWN_LINK
    rate = b.rate[i:j]
    bias = 0.5 * (rate[:n0].mean(axis=0) + rate[n1:].mean(axis=0))
    left, yaw = _level_force(b.force[i:j], rate - bias, n0, b.period)
    if np.abs(yaw).max() > _STRAIGHT_YAW:
        return _UNKNOWN_LINK
    if n1 <= n0:
        return Link(0.0, _SIGMAS * _LEAST_SIGMA, 0.0, 0.0)
    off = left[n1:].mean()
    left = left[n0:n1]
    v = left.sum() * b.period
    doubt = (
        0.5 * _G * _TURN_ON * T**2,
        _G * _CROSS_AXIS * float(np.abs(yaw[n0:n1]).sum()) * b.period,
        _MISALIGNED * float(np.abs(left.real).sum()) * b.period,
    )
    # what remains at the other end is due to biases and to tilt that the gyro did not measure
    share = np.linspace(0.0, 1.0, len(left))
    way = np.cumsum(left - share * off) * b.period
    way -= share * way[-1]
    tolerance = _SIGMAS * float(np.hypot(_LEAST_SIGMA, np.linalg.norm(doubt)))
    return Link(float(v.imag), tolerance, float(np.abs(way).max()), float(np.abs(way.mean())))


@dataclass(frozen=True)
class Outwards:
    """Speeds next to a span, integrated outwards from its end on the assumption that it is a stop."""

    way: int  # 1: onwards from its end, -1: backwards from its start
    t: Array  # (n,) s
    speed: Array  # (n,) m/s, horizontal
    tolerance: Array  # (n,) m/s, 3 sigma of it

    def find_between(self, first: float, last: float) -> NDArray[np.bool_] | None:
        """(n,) which rows lie between two times; None if none does, or if the rows do not reach so far."""
        there = (self.t >= first) & (self.t <= last)
        outer = last if self.way > 0 else first
        return there if there.any() and self.way * (self.t[-1] - outer) >= 0.0 else None


def find_speed_beside(b: BlockMeans, span: Array, way: int) -> Outwards | None:
    """Speeds next to a span (2,) s, if it is a stop, up to a gap or a turn; None where there are too few rows.

    Rate and force at rest are their means over the span, with the uncertainty given by their scatter in it.

    Parameters
    ----------
    way : 1 goes on from its end, -1 back from its start.
    """
    end, other = (float(x) for x in (span[::-1] if way > 0 else span))
    i, k, j = np.searchsorted(b.t, sorted((other, end, end + way * LONGEST_LINK)))
    torn = np.flatnonzero(~b.whole[i + 1 : j]) + i + 1
    outside = torn[torn >= k] if way > 0 else torn[torn <= k]
    if len(outside):
        i, j = (i, int(outside[0])) if way > 0 else (int(outside[-1]), j)
    n0 = int(k - i if way > 0 else j - k)
    if n0 < 3 or j - i <= n0:
        return None
    force, rate, t = b.force[i:j][::way], b.rate[i:j][::way], b.t[i:j][::way]
    left, yaw = _level_force(force, way * (rate - rate[:n0].mean(axis=0)), n0, b.period)
    n = int(np.argmax(np.append(np.abs(yaw[n0:]) > _STRAIGHT_YAW, True)))
    left, yaw, T = left[n0 : n0 + n], np.abs(yaw[n0 : n0 + n]), b.period * np.arange(1, n + 1)
    # densities of white noise by the scatter in the span, and the variance they leave in its means
    of_force, of_rate = (float(np.sqrt(x[:n0].var(axis=0).max() * b.period)) for x in (force, rate))
    known = 1.0 / (n0 * b.period)
    doubt = (
        np.full(n, _LEAST_SIGMA),
        0.5 * _G * T**2 * np.hypot(_TURN_ON, of_rate * np.sqrt(known)),
        _G * of_rate * np.sqrt(T**3 / 3.0),
        of_force * np.sqrt(T + T**2 * known),
        _G * _CROSS_AXIS * np.cumsum(yaw) * b.period,
        _MISALIGNED * np.cumsum(np.abs(left.real)) * b.period,
    )
    speed, tolerance = np.abs(np.cumsum(left)) * b.period, _SIGMAS * np.sqrt(np.sum(np.square(doubt), axis=0))
    return Outwards(way, t[n0 : n0 + n], speed, tolerance)


def find_end_of_rest(b: BlockMeans, span: Array, way: int, most: float, limit: float) -> float:
    """Time up to which the force, integrated outwards from one end of a stop, stays below a speed.

    Parameters
    ----------
    span : (2,) s, the stop.
    way : 1 goes on from its end, -1 back from its start.
    most : s to go; limit : m/s.
    """
    end = float(span[1] if way > 0 else span[0])
    inner = min(_INNER, float(span[1] - span[0]))
    i, k, j = np.searchsorted(b.t, sorted((end - way * inner, end, end + way * most)))
    n0 = int(k - i if way > 0 else j - k)
    if n0 < 3 or not b.whole[i + 1 : j].all():
        return end
    force, rate, t = b.force[i:j][::way], b.rate[i:j][::way], b.t[i:j][::way]
    # reversed in time, rates change their sign
    left, _ = _level_force(force, way * (rate - rate[:n0].mean(axis=0)), n0, b.period)
    speed = np.abs(np.cumsum(left[n0:]) * b.period)
    over = np.flatnonzero(speed > limit)
    last = n0 + (int(over[0]) if len(over) else len(speed)) - 1
    return float(t[last])


def _level_force(force: Array, omega: Array, still: int, period: float) -> tuple[NDArray[np.complex128], Array]:
    """Horizontal force (n,), right + i forward, without gravity and without its initial value; and the yaw.

    The first `still` rows are stationary; `omega` (n, 3) is without bias.
    """
    up = force[:still].mean(axis=0)
    g = float(np.linalg.norm(up))
    up = up / g
    forward = np.array([0.0, 1.0, 0.0]) - up[1] * up
    forward /= np.linalg.norm(forward)
    level = np.stack([np.cross(forward, up), forward], -1) @ np.array([1.0, 1.0j])
    yaw = np.cumsum(omega @ up) * period
    turned = np.exp(1j * yaw)
    # the tilt, summed in the initial axes and expressed in those of each row; up then leans by -tilt x up
    tilt = np.cumsum((omega @ level) * turned) * period / turned
    tilt -= tilt[:still].mean()
    return force @ level - 1j * g * tilt, yaw


def find_moving_by_chain(links: list[Link], known: Array) -> np.ndarray:
    """Which of M spans move, given the M - 1 links between them and the speeds that are known.

    Parameters
    ----------
    known : (M,) m/s, speed by another sensor, NaN where there is none.
    """
    M = len(known)
    out = np.nan_to_num(known) > 0.0
    groups = np.split(np.arange(M), [k + 1 for k, one in enumerate(links) if not np.isfinite(one.tolerance)])
    for group in groups:
        change = np.r_[0.0, np.cumsum([links[k].change for k in group[:-1]])]
        # errors are independent: variances add
        doubt = np.r_[0.0, np.cumsum([links[k].tolerance ** 2 for k in group[:-1]])]
        sure = np.flatnonzero(np.isfinite(known[group]))
        for m in range(len(group)):
            if np.isfinite(known[group[m]]):
                continue
            of = sure if len(sure) else np.arange(len(group))
            apart = np.sqrt(np.abs(doubt[m] - doubt[of]))
            speed = change[m] - change[of]
            if len(sure):
                nearest = int(np.argmin(apart))
                away = abs(known[group[of[nearest]]] + speed[nearest])
                out[group[m]] = away > max(apart[nearest], _SIGMAS * _LEAST_SIGMA)
            else:
                # without a known speed: a span that is faster than another one in the chain moves
                out[group[m]] = bool((speed > np.maximum(apart, _SIGMAS * _LEAST_SIGMA)).any())
    return out
