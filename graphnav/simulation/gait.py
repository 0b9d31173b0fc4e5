"""Motion of a foot: rolling over the floor from heel to toes, then through the air to its next footprint.

On the floor a shoe is a convex body that rolls without slipping. With h(theta) the height of the IMU over the floor at
pitch theta (the support function of the sole as seen from the IMU), a turn by d theta carries the IMU forward by -h d
theta, about the point that touches. So heel strike, the slow rolling in mid stance, heel-off about the ball and
lift-off about the toes are one function of the pitch, and the IMU is never exactly at rest. In the air the footprint
under the foot slides to the next one while the pitch goes on, and a clearance is added.

Angles and timing follow gait laboratories (Perry and Burnfield, *Gait Analysis*, 2nd ed., ch. 3-4) and the
recordings with motion capture that graphnav is tried on: turn rates of 350 to 550 deg/s, 10 to 25 deg/s in mid
stance, where the IMU moves by 2 to 5 cm/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline, CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.special import logsumexp

from graphnav.core.rotation import Array
from graphnav.simulation.footsteps import Footprints
from graphnav.simulation.splines import list_centres, make_spline

GAIT_STEP = 0.005  # s between coefficients: a shock lasts some 15 ms
GAIT_DEGREE = 4  # force and turn acceleration are continuous
EAST, NORTH, UP, ROLL, PITCH, HEADING = range(6)  # channels: m, rad
PLACE_CHANNELS = slice(EAST, UP + 1)
_MUSCLE = 0.012  # s, the shortest time in which a turn rate can change
_SWING = 0.045  # s, over which the foot's height in the air is smoothed


@dataclass(frozen=True)
class Sole:
    """Points of a shoe that can touch the floor, (forward, up) of the IMU in m, from the heel's back to the tip."""

    points: tuple[tuple[float, float], ...] = (
        (-0.135, -0.080), (-0.105, -0.093), (0.100, -0.093), (0.140, -0.089), (0.180, -0.076),
    )  # fmt: skip
    ball: int = 2  # points about which a foot turns
    # m, over which the weight goes from one to the next: from landing to lift-off the pivot travels 16 cm, in motion
    # capture of real shoes 15
    softness: float = 0.006

    @cached_property
    def _height(self) -> CubicSpline:
        theta = np.deg2rad(np.arange(-110.0, 70.0, 0.1))
        forward, up = np.array(self.points).T
        depth = -(np.outer(np.sin(theta), forward) + np.outer(np.cos(theta), up))
        return CubicSpline(theta, self.softness * logsumexp(depth / self.softness, axis=1))

    def compute_height(self, pitch: Array) -> Array:
        """Of the IMU over the floor, m, with the shoe just touching it; pitch in rad, nose up positive."""
        return self._height(pitch)

    def compute_forward(self, pitch: Array) -> Array:
        """Of the IMU from the point of the floor under the ball of the flat shoe, m, when rolled to a pitch."""
        whole = self._height.antiderivative()
        return whole(0.0) - whole(pitch) - self.points[self.ball][0]


@dataclass(frozen=True)
class Style:
    """Height, distance and impact of a step; angles in deg."""

    strike_pitch: float
    off_pitch: float
    last_pitch: float  # the steepest, just after lift-off
    high_pitch: float  # the toes' highest, before the strike
    clearance: float  # m, at its highest
    landing: tuple[float, float]  # m/s, forward and down, stopped by the strike
    impact: float  # m/s^2, of the vibration after a strike
    give: float  # s, over which the shoe and soft tissue spread the strike
    swing_roll: float = 7.0
    swing_yaw: float = 4.0
    circumduction: float = 0.025  # m, outward
    jitter: float = 0.06  # 1-sigma of all of these, as a share

    @classmethod
    def of(cls, speed: float) -> Style:
        """The style at a walking speed, m/s."""
        v = float(np.clip(speed, 0.5, 2.2))
        hard = max(v - 1.2, 0.0)
        return cls(
            strike_pitch=11.0 + 7.0 * v, off_pitch=-(34.0 + 8.0 * v), last_pitch=-(48.0 + 10.0 * v),
            high_pitch=13.0 + 8.0 * v, clearance=0.028 + 0.004 * v,
            landing=(0.35 * v + 2.2 * hard, 0.3 * v + 1.8 * hard),
            impact=24.0 * v + 130.0 * hard, give=max(0.012 - 0.017 * hard, 0.003),
        )  # fmt: skip


@dataclass(frozen=True)
class Foot:
    """The IMU on a foot, as one spline of six channels; without the IMU's mounting angles."""

    spline: BSpline
    start: float  # s
    end: float
    contacts: Array  # (K, 2) s: heel strike to lift-off
    stances: Array  # (K, 2) s: the shoe flat on the floor, rolling slowly, until the heel lifts


# Shares of a stance's time and what the pitch is there, in deg: flat after the slap, heel off, rising on the ball.
_FLAT, _HEEL_OFF = 0.17, 0.58
_ROLLING_PITCH = ((_FLAT, 1.6), (0.38, -0.3), (_HEEL_OFF, -2.6), (0.74, -6.5), (0.88, -17.0))


def walk(steps: Footprints, style: Style, sole: Sole, end: float, rng: np.random.Generator) -> Foot:
    """The foot's motion from 0 to `end` s over its footprints.

    The first stance is rest until the heel lifts, the last is rest after the landing.
    """
    K = len(steps)
    t = list_centres(0.0, end, GAIT_STEP, GAIT_DEGREE)
    strike, off = steps.strike, steps.off
    vary = 1.0 + style.jitter * rng.standard_normal((K, 11))
    sway = np.deg2rad(0.03) * _draw_sway(len(t), rng)
    # a first and a last stance begin and end as the others do
    typical = float(np.median(off[1:-1] - strike[1:-1]))
    begins = np.where(np.arange(K) == 0, off - typical, strike)
    ends = np.where(np.arange(K) == K - 1, strike + typical, off)

    pitch = _make_pitch(t, steps, begins, ends, style, vary) + sway[:, 0]
    psi = _make_heading(t, steps, begins, style, vary)
    roll = _make_roll(t, steps, begins, style, vary) + sway[:, 1]

    # the stride in whose swing each time lies, and how far it is through it
    k = np.clip(np.searchsorted(off[:-1], t) - 1, 0, K - 2)
    took = strike[1:] - off[:-1]
    u = np.clip((t - off[k]) / took[k], 0.0, 1.0)
    ahead = np.diff(steps.place, axis=0)
    share, slope = _share_of_swing(u), u**6 - u**5  # the latter: of unit slope at its end, else nothing at both
    landing = style.landing[0] * vary[1:, 0] * took / np.maximum(np.linalg.norm(ahead, axis=1), 0.1)
    # the sole compresses by millimetres, which softens the end of the strike
    share = gaussian_filter1d(share + np.minimum(landing, 0.5)[k] * slope + k, style.give / GAIT_STEP) - k
    base = steps.place[k] + share[:, None] * ahead[k]
    h = sole.compute_height(pitch)
    aside = h * np.sin(roll) + style.circumduction * vary[k, 1] * np.sin(np.pi * u) ** 2
    along = sole.compute_forward(pitch)
    clearance = style.clearance * vary[k, 2] * 16.0 * u**2 * (1.0 - u) ** 2
    clearance -= style.landing[1] * vary[1:, 0][k] * took[k] * slope
    # in the air heel and toes need not touch the floor: the pitch changes smoothly
    air = np.clip(np.minimum(u / 0.35, (1.0 - u) / 0.3), 0.0, 1.0)
    air = air * air * (3.0 - 2.0 * air)
    up = h + air * (gaussian_filter1d(h, _SWING / GAIT_STEP) - h) + gaussian_filter1d(clearance, style.give / GAIT_STEP)
    east = base[:, 0] + along * np.sin(psi) + aside * np.cos(psi)
    north = base[:, 1] + along * np.cos(psi) - aside * np.sin(psi)
    x = np.column_stack([east, north, up, roll, pitch, psi]) + _make_ring(t, strike[1:], style, rng)
    stances = np.column_stack([begins + _FLAT * (ends - begins), begins + _HEEL_OFF * (ends - begins)])
    stances[0, 0], stances[-1, 1] = 0.0, end
    return Foot(make_spline(0.0, GAIT_STEP, x, GAIT_DEGREE), 0.0, end, np.column_stack([strike, off]), stances)


def _interpolate_stride(t: Array, knots: list[Array], values: list[Array]) -> Array:
    """A smooth curve through values (K, ...) at times (K, ...), each list in order of time within a stride."""
    at = np.concatenate([np.ravel(x) for x in knots])
    order = np.argsort(at, kind="stable")
    curve = PchipInterpolator(at[order], np.concatenate([np.ravel(x) for x in values])[order], extrapolate=False)
    out = curve(np.clip(t, at.min(), at.max()))
    return gaussian_filter1d(out, _MUSCLE / GAIT_STEP, mode="nearest")


def _make_pitch(t: Array, steps: Footprints, begins: Array, ends: Array, style: Style, vary: Array) -> Array:
    K, D = len(steps), ends - begins
    knots, values = [steps.strike[1:]], [style.strike_pitch * vary[1:, 3]]
    for share, value in _ROLLING_PITCH:
        # before it starts and after it ends to walk, the foot is flat
        rows = np.arange(K)[(1 if share < _HEEL_OFF else 0) : (K - 1 if share > _FLAT else K)]
        knots.append(begins[rows] + share * D[rows])
        values.append(np.where(rows == 0, min(value, -0.3), value) * vary[rows, 4])
    S = steps.strike[1:] - steps.off[:-1]
    for share, value, column in ((0.0, style.off_pitch, 5), (0.17, style.last_pitch, 6), (0.88, style.high_pitch, 7)):
        knots.append(steps.off[:-1] + share * S)
        values.append(value * vary[:-1, column])
    # at rest, level except for the compression of the sole
    knots += [np.array([-1.0, begins[0] + 0.35 * D[0]]), np.array([begins[-1] + 0.4 * D[-1], steps.off[-1] + 1.0])]
    values += [np.full(2, -0.3), np.full(2, -0.3)]
    return np.deg2rad(_interpolate_stride(t, knots, values))


def _make_heading(t: Array, steps: Footprints, begins: Array, style: Style, vary: Array) -> Array:
    """Turning on the floor with the heel's rising, the rest in the air with a little swing of the toes."""
    S = steps.strike[1:] - steps.off[:-1]
    D = steps.off - begins
    middle = 0.5 * (steps.leave[:-1] + steps.land[1:]) + np.deg2rad(style.swing_yaw) * (vary[:-1, 8] - 1.0) / 0.06
    knots = [steps.strike[1:], (begins + 0.35 * D)[:-1], steps.off[:-1], steps.off[:-1] + 0.45 * S]
    values = [steps.land[1:], steps.land[:-1], steps.leave[:-1], middle]
    knots += [np.array([-1.0, 0.0]), np.array([steps.strike[-1] + 0.1, steps.off[-1] + 1.0])]
    values += [np.full(2, steps.land[0]), np.full(2, steps.land[-1])]
    return _interpolate_stride(t, knots, values)


def _make_roll(t: Array, steps: Footprints, begins: Array, style: Style, vary: Array) -> Array:
    """On the outer edge at the strike, level on the floor, inward at lift-off, outward in the air."""
    S = steps.strike[1:] - steps.off[:-1]
    D = steps.off - begins
    rows = slice(0, -1)
    knots = [steps.strike[1:], (begins + 0.25 * D)[rows], (begins + 0.6 * D)[rows], steps.off[rows]]
    values = [3.0 * vary[1:, 9], 0.4 * (vary[rows, 10] - 1.0) / 0.06, 0.2 * vary[rows, 10], -3.0 * vary[rows, 9]]
    knots += [steps.off[:-1] + 0.45 * S, np.array([-1.0, 0.0]), np.array([steps.strike[-1] + 0.15, t[-1]])]
    values += [style.swing_roll * vary[:-1, 10], np.zeros(2), np.zeros(2)]
    return np.deg2rad(_interpolate_stride(t, knots, values))


# Bernstein coefficients of the slide's speed: it takes over from the rolling and has nearly ended before the strike
_SPEED_CURVE = np.array([0.0, 0.65, 1.05, 1.25, 1.45, 1.0, 0.0])


def _share_of_swing(u: Array) -> Array:
    """Share (n,) of the way between two footprints at shares u of the swing's time."""
    knots = np.repeat([0.0, 1.0], len(_SPEED_CURVE))
    return BSpline(knots, _SPEED_CURVE / _SPEED_CURVE.mean(), len(_SPEED_CURVE) - 1).antiderivative()(u)


def _make_ring(t: Array, strikes: Array, style: Style, rng: np.random.Generator) -> Array:
    """(J, 6) vibration after a strike: shoe, soft tissue and mount ring and decay within some 0.15 s.

    Displacements of `style.impact` and corresponding turns at a foot's size.
    """
    out = np.zeros((len(t), 6))
    share = np.array([0.5, 0.5, 0.8, 0.6, 0.8, 0.3])  # of the acceleration; m/s^2, and rad/s^2 over 0.1 m
    share[3:] /= 0.1
    for one in strikes:
        rows = slice(int(np.searchsorted(t, one)), int(np.searchsorted(t, one + 0.6)))
        since = t[rows, None] - one
        hz, fade = rng.uniform(13.0, 30.0, 6), rng.uniform(0.025, 0.05, 6)
        size = style.impact * share * np.exp(0.25 * rng.standard_normal(6)) * rng.choice([-1.0, 1.0], 6)
        omega = 2.0 * np.pi * hz
        out[rows] += size / omega**2 * np.exp(-since / fade) * np.sin(omega * since)
    return out


def _draw_sway(count: int, rng: np.random.Generator) -> Array:
    """(count, 2) of unit size: the sway of a standing person."""
    x = gaussian_filter1d(rng.standard_normal((count, 2)), 0.3 / GAIT_STEP, axis=0)
    return x / np.sqrt(np.mean(x**2, axis=0))
