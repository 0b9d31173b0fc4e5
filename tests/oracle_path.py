"""Motion with error-free inertial samples, both from `pyins.sim.generate_imu`, somebody else's simulator.

python-ins (import name pyins, N. Mayorov, MIT licence) knows nothing of graphnav: its Earth, frames and splines are
its own, so agreement with drives from here is evidence about graphnav. No frame or Earth code of graphnav is used
here for the same reason.

Conventions turned here, once: pyins has NED and FRD axes, degrees, and increments over the period that ends at a
row's time, its first row a duplicate; graphnav has ENU and RFU, radians, and means over that same period. pyins
takes gravity off with height at the sphere's rate 2 h/A; the fuller formula differs by 2e-8 m/s^2 per metre of
height, so the paths stay within some 50 m of the ellipsoid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyins import earth, sim, transform, util
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]

AXLE = (0.15, -0.9, -0.65)  # m, RFU, IMU to the point that does not slip sideways


class NotTileable(ValueError):
    """A path that does not end as it begins."""


@dataclass(frozen=True)
class ExactPath:
    """The IMU's exact motion at N + 1 times and its N error-free samples, one for each period between them."""

    t: Array  # (N + 1,) s
    llh: Array  # (N + 1, 3) rad, rad, m
    v: Array  # (N + 1, 3) m/s, local ENU
    rph: Array  # (N + 1, 3) rad, heading not wrapped
    gyro: Array  # (N, 3) rad/s, RFU, mean over the period that ends at t[1:]
    accel: Array  # (N, 3) m/s^2
    name: str = ""

    @property
    def dt(self) -> float:
        """The sample period, s."""
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    @property
    def speed(self) -> Array:
        """(N + 1,) m/s over ground."""
        return np.hypot(self.v[:, 0], self.v[:, 1])

    @property
    def length(self) -> float:
        """Metres driven."""
        return float(np.sum(0.5 * (self.speed[1:] + self.speed[:-1])) * self.dt)

    def tiled(self, count: int) -> ExactPath:
        """The path driven `count` times. Only for a lap: its last state must be its first.

        The samples repeat exactly, because on a rotating Earth they depend on the motion and not on the time of day.
        """
        turn = self.rph[-1] - self.rph[0]
        if np.abs(self.v[[0, -1]]).max() > 1e-9 or np.abs(self.llh[-1] - self.llh[0]).max() > 1e-12:
            raise NotTileable("only a closed lap that stands at both ends can be tiled")
        if np.abs(np.sin(turn / 2)).max() > 1e-9:
            raise NotTileable("only a lap that ends in its first attitude can be tiled")

        def rows(a: Array) -> Array:
            return np.concatenate([a[:1], np.tile(a[1:], (count, 1))])

        t = self.t[0] + self.dt * np.arange(count * len(self.gyro) + 1)
        llh, v, rph = rows(self.llh), rows(self.v), rows(self.rph)
        rph[1:] += np.repeat(np.arange(count), len(self.gyro))[:, None] * turn  # the heading goes on turning
        return ExactPath(t, llh, v, rph, np.tile(self.gyro, (count, 1)), np.tile(self.accel, (count, 1)), self.name)

    def point(self, t: Array, lever_arm: tuple[float, float, float]) -> tuple[Array, Array, Array]:
        """(llh, velocity in local ENU, velocity in RFU) of a point of the body at times within the path, (M, 3) each.

        Exact at the samples' own times; between them interpolated, by some 1e-6 m and 1e-5 m/s.
        """
        t = np.asarray(t, dtype=float)
        i = np.clip(((t - self.t[0]) / self.dt + 1e-6).astype(int), 0, len(self.t) - 2)
        s = ((t - self.t[i]) / self.dt)[:, None]
        s = np.where(np.abs(s - np.round(s)) < 1e-6, np.round(s), s)
        llh0, llh1, v0, v1 = self.llh[i], self.llh[i + 1], self.v[i], self.v[i + 1]
        # cubic Hermite in latitude, longitude and height; linear in velocity and attitude
        d0, d1 = llh_rate(llh0, v0) * self.dt, llh_rate(llh1, v1) * self.dt
        change = llh1 - llh0
        llh = llh0 + s * (d0 + s * (3 * change - 2 * d0 - d1 + s * (d0 + d1 - 2 * change)))
        v, rph = v0 + s * (v1 - v0), self.rph[i] + s * (self.rph[i + 1] - self.rph[i])
        R = R_lb(rph)
        # rate relative to the Earth: the samples are means, so each belongs to the middle of its period
        u = np.clip((t - self.t[0]) / self.dt - 0.5, 0, len(self.gyro) - 1)
        j = np.minimum(u.astype(int), len(self.gyro) - 2)
        omega_ib = self.gyro[j] + (u - j)[:, None] * (self.gyro[j + 1] - self.gyro[j])
        lat = llh[:, 0]
        earth_l = earth.RATE * np.stack([np.zeros_like(lat), np.cos(lat), np.sin(lat)], -1)
        omega_eb = omega_ib - np.einsum("kji,kj->ki", R, earth_l)
        lever = np.broadcast_to(lever_arm, omega_eb.shape)
        v_point = v + util.mv_prod(R, np.cross(omega_eb, lever))
        p_l = util.mv_prod(R, lever)
        return _moved(llh, _mv_el(llh, p_l)), v_point, np.einsum("kji,kj->ki", R, v_point)


# ---------------------------------------------------------------------------------------------------------- frames
def R_lb(rph: Array) -> Array:
    """ENU from RFU, from pyins's NED from FRD: both swap the first two axes and turn the third."""
    R = transform.mat_from_rph(np.rad2deg(rph))[:, [1, 0, 2]][:, :, [1, 0, 2]]
    R[:, 2, :] *= -1
    R[:, :, 2] *= -1
    return R


def swap(a: Array) -> Array:
    """NED <-> ENU, FRD <-> RFU."""
    return a[:, [1, 0, 2]] * (1.0, 1.0, -1.0)


def degrees(llh: Array) -> Array:
    return np.column_stack([np.rad2deg(llh[:, :2]), llh[:, 2]])


def radii(llh: Array) -> tuple[Array, Array]:
    """(metres per radian of latitude, of longitude)."""
    north, _, east = earth.principal_radii(np.rad2deg(llh[:, 0]), llh[:, 2])
    return north, east


def llh_rate(llh: Array, v: Array) -> Array:
    north, east = radii(llh)
    return np.column_stack([v[:, 1] / north, v[:, 0] / east, v[:, 2]])


def _mv_el(llh: Array, a_l: Array) -> Array:
    """Local ENU vectors in ECEF."""
    d = degrees(llh)
    return util.mv_prod(transform.mat_en_from_ll(d[:, 0], d[:, 1]), swap(a_l))


def _moved(llh: Array, offset_e: Array) -> Array:
    """Points moved by ECEF vectors (a few metres), by Newton steps on pyins's own ellipsoid."""
    start = degrees(llh)
    target, lla = transform.lla_to_ecef(start) + offset_e, start
    R_en = transform.mat_en_from_ll(start[:, 0], start[:, 1])
    for _ in range(3):  # each step leaves 1e-7 of what was missing
        lla = transform.perturb_lla(lla, util.mv_prod(R_en, target - transform.lla_to_ecef(lla), True))
    return np.column_stack([np.deg2rad(lla[:, :2]), lla[:, 2]])


# ----------------------------------------------------------------------------------------------------------- paths
def _exact(t: Array, llh: Array, v: Array, rph: Array, name: str) -> ExactPath:
    """Have pyins make the samples; its returned trajectory is the truth."""
    truth, imu = sim.generate_imu(t, degrees(llh), np.rad2deg(rph), swap(v), "increment")
    period = np.diff(t)[:, None]
    values, rows = imu.to_numpy()[1:], truth.to_numpy()
    return ExactPath(
        t=t,
        llh=np.column_stack([np.deg2rad(rows[:, 0:2]), rows[:, 2]]),
        v=swap(rows[:, 3:6]),
        rph=np.deg2rad(rows[:, 6:9]),
        gyro=swap(values[:, 0:3] / period),
        accel=swap(values[:, 3:6] / period),
        name=name,
    )


def _from_axle(t: Array, llh: Array, v: Array, rph: Array, name: str) -> ExactPath:
    """The path of an IMU mounted so that the given motion is that of the point `AXLE`."""
    p_e = -_mv_el(llh, util.mv_prod(R_lb(rph), np.broadcast_to(AXLE, rph.shape)))
    v_e = _mv_el(llh, v) + CubicSpline(t, p_e).derivative()(t)
    moved = _moved(llh, p_e)
    d = degrees(moved)
    v_l = swap(util.mv_prod(transform.mat_en_from_ll(d[:, 0], d[:, 1]), v_e, True))
    # derivatives of rounded numbers are not quite zero where the vehicle stands
    still = np.abs(v).max(axis=1) == 0
    v_l[still & (np.abs(v_l).max(axis=1) < 1e-9)] = 0.0
    return _exact(t, moved, v_l, rph, name)


def _smoothstep(t: Array, knots: list[tuple[float, float, float]], column: int, start: float) -> Array:
    """Values that step from knot to knot with three continuous derivatives (the septic smoothstep)."""
    durations = np.array([k[0] for k in knots])
    ends = np.concatenate([[0.0], np.cumsum(durations)])
    values = np.concatenate([[start], [k[column] for k in knots]])
    i = np.clip(np.searchsorted(ends, t, side="right") - 1, 0, len(knots) - 1)
    s = np.clip((t - ends[i]) / durations[i], 0.0, 1.0)
    return values[i] + (values[i + 1] - values[i]) * s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)


def _city(half: float, rng: np.random.Generator) -> list[tuple[float, float, float]]:
    """(duration, speed, heading) at the ends of manoeuvres filling `half` s, standing at both, turned by pi."""
    stand = min(15.0, half / 6)
    knots, used, v, psi = [(stand, 0.0, 0.0)], stand, 0.0, 0.0

    def add(duration: float, speed: float, heading: float) -> None:
        nonlocal used, v, psi
        knots.append((duration, speed, heading))
        used, v, psi = used + duration, speed, heading

    ending = 6.0 + 16.0 + 6.0 + 3.0  # slow down, last turn, brake, stand
    while half - used - ending > 55.0:
        fast = rng.uniform(9.0, 20.0)
        add(max(4.0, abs(fast - v) / 1.2), fast, psi)
        add(rng.uniform(10.0, 20.0), fast, psi + rng.uniform(-0.5, 0.5))
        add(6.0, 6.0, psi)
        add(8.0, 6.0, psi + rng.choice([-1.0, 1.0]) * rng.uniform(1.2, 1.8))
        if rng.random() < 0.35 and half - used - ending > 30.0:
            add(5.0, 0.0, psi)
            add(rng.uniform(5.0, 15.0), 0.0, psi)
    rest = half - used - ending
    if rest > 15.0:
        add(9.0, 12.0, psi)
        add(rest - 9.0, 12.0, psi + 0.02 * rest)
    add(6.0, 6.0, psi)
    add(16.0, 6.0, np.pi + 2 * np.pi * np.round((psi - np.pi) / (2 * np.pi)))
    add(6.0, 0.0, psi)
    add(half - used, 0.0, psi)
    return knots


@lru_cache(maxsize=12)
def vehicle_path(
    duration: float = 600.0,
    rate: float = 200.0,
    lat: float = 30.5,
    lon: float = 114.3,
    height: float = 20.0,
    heading: float = 62.0,
    seed: int = 0,
) -> ExactPath:
    """A closed lap through a town: stops, bends, corners, slopes to 5 %, up to 20 m/s; `lat` to `heading` in degrees.

    It stands at both ends in the same state, so it can be `tiled`. The second half is the first, driven in the
    opposite direction of the compass, so that the lap closes. The rear axle (`AXLE`) moves exactly along the body's
    forward axis; the body leans in bends (0.2 deg per m/s^2) on a road that falls 1 deg to the right.
    """
    if duration < 120.0:
        raise ValueError("a lap takes at least 120 s; crop the recording for less")
    count = round(duration * rate)
    if count % 2:
        raise ValueError("the two halves of a lap need a whole number of samples each")
    knots = _city(duration / 2, np.random.default_rng([seed, 1]))
    knots += [(d, v, psi + knots[-1][2]) for d, v, psi in knots]
    t = np.arange(count + 1) / rate
    speed, psi = _smoothstep(t, knots, 1, 0.0), np.deg2rad(heading) + _smoothstep(t, knots, 2, 0.0)

    def integral(f: Array) -> Array:
        return CubicSpline(t, f).antiderivative()(t)

    # The lap closes in a flat map whose metres are true at the start only; true velocities come from its derivative.
    s, de, dn = integral(speed), speed * np.sin(psi), speed * np.cos(psi)
    start = np.array([[np.deg2rad(lat), np.deg2rad(lon), height]])
    north0, east0 = (float(r[0]) for r in radii(start))
    waves = [(a, 2 * np.pi * max(1, round(s[-1] / w)) / s[-1]) for a, w in ((6.0, 1500.0), (1.5, 400.0), (0.1, 80.0))]
    grade = sum(a * k * np.cos(k * s) for a, k in waves)
    h = height + sum(a * np.sin(k * s) for a, k in waves)
    e, n = integral(de), integral(dn)
    e[-1] = n[-1] = 0.0  # what rounding left, < 1e-9 m
    llh = np.column_stack([start[0, 0] + n / north0, start[0, 1] + e / east0, h])
    llh[-1] = llh[0]
    north, east = radii(llh)
    v = np.column_stack([de * east / east0, dn * north / north0, speed * grade])
    # heading and pitch of the direction of motion, defined at a standstill too
    along_e, along_n = np.sin(psi) * east / east0, np.cos(psi) * north / north0
    true_heading = psi + np.mod(np.arctan2(along_e, along_n) - psi + np.pi, 2 * np.pi) - np.pi
    pitch = np.arctan2(grade, np.hypot(along_e, along_n))
    pitch[-1] = pitch[0]
    sideways = speed * CubicSpline(t, psi).derivative()(t)  # m/s^2, to the right
    roll = np.deg2rad(1.0) - np.deg2rad(0.2) * sideways
    return _from_axle(t, llh, v, np.column_stack([roll, pitch, true_heading]), f"lap of {duration:g} s at {lat:g} deg")


def _travelled(t: Array, start: Array, v: Array) -> Array:
    """llh (K, 3) from a start (3,) and velocities in the local ENU: three fixed-point steps on the radii."""
    llh = np.tile(start, (len(t), 1))
    for _ in range(4):
        llh = start + CubicSpline(t, llh_rate(llh, v)).antiderivative()(t)
    return llh


@lru_cache(maxsize=2)
def straight_path(
    length_m: float = 100e3,
    speed: float = 30.0,
    heading: float = 45.0,
    rate: float = 200.0,
    lat: float = 45.0,
    lon: float = 7.0,
    height: float = 20.0,
    stand: float = 30.0,
) -> ExactPath:
    """A geodesic at one height: standing, 30 s of acceleration, then one speed until `length_m` are behind."""
    gain = 30.0
    count = int(np.ceil((stand + gain + (length_m - 0.5 * gain * speed) / speed) * rate))
    t = np.arange(count + 1) / rate
    along = _smoothstep(t, [(stand, 0.0, 0.0), (gain, speed, 0.0), (t[-1], speed, 0.0)], 1, 0.0)
    start = np.array([np.deg2rad(lat), np.deg2rad(lon), height])
    psi = np.full(len(t), np.deg2rad(heading))
    # a geodesic turns against north by the meridians' convergence: d psi = d lon sin(lat)
    for _ in range(5):
        v = np.column_stack([along * np.sin(psi), along * np.cos(psi), np.zeros_like(t)])
        llh = _travelled(t, start, v)
        turn = llh_rate(llh, v)[:, 1] * np.sin(llh[:, 0])
        psi = np.deg2rad(heading) + CubicSpline(t, turn).antiderivative()(t)
    v = np.column_stack([along * np.sin(psi), along * np.cos(psi), np.zeros_like(t)])
    rph = np.column_stack([np.zeros_like(t), np.zeros_like(t), psi])
    return _exact(t, _travelled(t, start, v), v, rph, f"{length_m / 1e3:g} km straight")


@lru_cache(maxsize=12)
def winding_path(
    duration: float, speed: float, seed: int = 0, turn: float | None = None, rate: float = 50.0
) -> ExactPath:
    """A level way at one speed (m/s) after 5 s of standing, from any heading: bends at random, or a steady turn, rad/s.

    No axle: the IMU itself moves along the body's forward axis.
    """
    rng = np.random.default_rng([seed, 7])
    t = np.arange(round(duration * rate) + 1) / rate
    psi = first = rng.uniform(-np.pi, np.pi)
    knots = [(5.0, 0.0, psi), (3.0, speed, psi)]
    for _ in range(int(duration // 15.0)):
        psi += rng.uniform(-1.2, 1.2)
        knots += [(10.0, speed, psi), (5.0, speed, psi)]
    along = _smoothstep(t, knots, 1, 0.0)
    psi = first + np.maximum(t - 5.0, 0.0) * turn if turn is not None else _smoothstep(t, knots, 2, first)
    v = np.column_stack([along * np.sin(psi), along * np.cos(psi), np.zeros_like(t)])
    rph = np.column_stack([np.zeros_like(t), np.zeros_like(t), psi])
    start = np.array([np.deg2rad(45.0), np.deg2rad(7.0), 20.0])
    return _exact(t, _travelled(t, start, v), v, rph, f"{duration:g} s at {speed:g} m/s")


@lru_cache(maxsize=1)
def oracle_truth_path(shared_data: Path, rate: float = 200.0) -> ExactPath:
    """The motion of the shipped oracle drive (truth.csv.gz, 10 Hz), splined, with new error-free samples.

    Its velocities are splined and integrated from its first position, because the file's rounded heights would
    shake the vehicle; what comes out is within a centimetre of the file and is the truth from here on.
    """
    table = np.genfromtxt(Path(shared_data) / "oracle_drive" / "truth.csv.gz", delimiter=",", names=True)
    t0 = table["t"]
    v0 = np.column_stack([table[c] for c in ("ve", "vn", "vu")])
    rph0 = np.unwrap(np.deg2rad(np.column_stack([table[c] for c in ("roll", "pitch", "heading")])), axis=0)
    t = t0[0] + np.arange(int((t0[-1] - t0[0]) * rate + 1e-6) + 1) / rate
    v, rph = CubicSpline(t0, v0)(t), CubicSpline(t0, rph0)(t)
    start = np.array([np.deg2rad(table["lat"][0]), np.deg2rad(table["lon"][0]), table["h"][0]])
    return _exact(t, _travelled(t, start, v), v, rph, "the oracle drive's path")
