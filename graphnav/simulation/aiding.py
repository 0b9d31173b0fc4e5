"""GNSS fixes and wheel speeds with realistic errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.earth import E2, A
from graphnav.core.rotation import Array
from graphnav.recording import Gnss, Odometer
from graphnav.simulation.kinematics import Mount, TrueMotion
from graphnav.simulation.motion import SLIP, Path
from graphnav.simulation.splines import make_random
from graphnav.simulation.vibration import draw_gauss_markov

Span = tuple[float, float]
Three = tuple[float, float, float]


@dataclass(frozen=True)
class SimulatedFault:
    """A span in which fixes go wrong while their stated sigmas stay unchanged: times are the motion's, s."""

    start: float
    end: float
    noise: float = 1.0  # factor on the white errors of position and velocity
    growth: Three = (0.0, 0.0, 0.0)  # m/s east, north, up: rate of a growing position error
    velocity: Three = (0.0, 0.0, 0.0)  # m/s added to the velocity


@dataclass(frozen=True)
class GnssModel:
    """Position and velocity of an antenna: white errors, slow (Gauss-Markov) errors, gaps and faults.

    The sigma stated with each fix is that of both errors together.
    """

    white: Three = (0.01, 0.01, 0.02)  # m, east, north, up
    slow: Three = (0.0, 0.0, 0.0)
    slow_time: float = 120.0  # s
    velocity: Three | None = (0.03, 0.03, 0.05)  # m/s; None: no velocities
    rate: float = 1.0  # Hz
    phase: float = 0.0  # s by which fixes follow whole periods
    lever_arm: Three = (0.0, 0.5, 0.1)  # m, IMU to antenna, IMU's axes
    outages: tuple[Span, ...] = ()
    dropouts: float = 0.0  # share of single fixes that are missing
    faults: tuple[SimulatedFault, ...] = ()

    def read(self, motion: TrueMotion, seed: int) -> Gnss:
        """Simulate the fixes of a drive."""
        t0, t1 = motion.t[0], motion.t[-1]
        t = t0 + self.phase + np.arange(int((t1 - t0 - self.phase) * self.rate + 1e-6) + 1) / self.rate
        llh, v = motion.point(t, np.array(self.lever_arm))
        white, speed = make_random(seed, "gnss").standard_normal((2, len(t), 3))
        slow = draw_gauss_markov(len(t), 1.0 / (self.rate * self.slow_time), make_random(seed, "gnss slow"), 3)
        gain = np.ones(len(t))
        error = slow * self.slow
        wrong = np.zeros((len(t), 3))
        for fault in self.faults:
            inside = (t >= fault.start) & (t <= fault.end)
            gain[inside] *= fault.noise
            error[inside] += (t[inside] - fault.start)[:, None] * fault.growth
            wrong[inside] += fault.velocity
        error += gain[:, None] * white * self.white
        velocity = None if self.velocity is None else v + wrong + gain[:, None] * speed * self.velocity
        kept = make_random(seed, "gnss dropouts").random(len(t)) >= self.dropouts
        for a, b in self.outages:
            kept &= ~((t >= a) & (t <= b))
        sd = np.tile(np.hypot(self.white, self.slow), (len(t), 1))
        return Gnss(
            t[kept],
            displace(llh, error)[kept],
            sd[kept],
            None if velocity is None else velocity[kept],
            None if self.velocity is None else np.tile(self.velocity, (len(t), 1))[kept],
            np.array(self.lever_arm),
        )


def displace(llh: Array, enu: Array) -> Array:
    """Places (n, 3) displaced by metres east, north, up."""
    w = 1.0 - E2 * np.sin(llh[:, 0]) ** 2
    north, east = A * (1.0 - E2) / w**1.5 + llh[:, 2], A / np.sqrt(w) + llh[:, 2]
    return llh + np.column_stack([enu[:, 1] / north, enu[:, 0] / (east * np.cos(llh[:, 0])), enu[:, 2]])


@dataclass(frozen=True)
class OdometerModel:
    """Wheel speed: a reading is the mean over one period around its time (minus the delay)."""

    rate: float = 20.0  # Hz, 10 to 100
    scale: float = 0.01  # 1-sigma of the scale error
    white: float = 0.03  # m/s, while the wheels turn
    pulse: float = 0.0  # m per pulse; 0: not counted in pulses
    delay: float = 0.0  # s by which readings come late; a recording states it as the 1-sigma of its stamps
    signed: bool = True
    stuck: tuple[Span, ...] = ()  # reads zero regardless of the wheels
    unplugged: tuple[Span, ...] = ()  # no readings

    def read(self, path: Path, mount: Mount, seed: int) -> tuple[Odometer, float]:
        """Simulate the readings of a drive; returns also their scale error."""
        rng = make_random(seed, "odometer")
        scale = self.scale * rng.standard_normal()
        t = path.start + np.arange(int((path.end - path.start) * self.rate + 1e-6) + 1) / self.rate
        half = 0.5 / self.rate
        edges = np.append(t - half, t[-1] + half) - self.delay
        # a wheel rolls along the vehicle, the axle moves along its course
        way = path.compute_distance(edges) * (1.0 + scale)
        if self.pulse:
            way = np.floor(way / self.pulse + rng.random()) * self.pulse
        speed = np.diff(way) * self.rate * np.cos(path.sample(SLIP, t - self.delay))
        turning = path.compute_speed(t - self.delay) != 0.0
        speed = speed + np.where(turning, self.white * rng.standard_normal(len(t)), 0.0)
        if not self.signed:
            speed = np.abs(speed)
        for a, b in self.stuck:
            speed[(t >= a) & (t <= b)] = 0.0
        kept = np.ones(len(t), dtype=bool)
        for a, b in self.unplugged:
            kept &= ~((t >= a) & (t <= b))
        # a recording states its scale uncertainty; even an exact scale changes with tyre wear
        stated = max(self.scale, 0.001)
        readings = Odometer(
            t[kept], speed[kept], mount.axle_lever_arm, stated, signed=self.signed, delay_sigma=self.delay
        )
        return readings, float(scale)
