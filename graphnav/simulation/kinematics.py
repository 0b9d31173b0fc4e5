"""Error-free IMU readings of a moving vehicle, and its position.

With V_b the velocity of the IMU over the Earth in its own axes, omega_b its rate and Omega_b the Earth's, the
specific force is

    f_b = dV_b/dt + (omega_b + Omega_b) x V_b - g_b                     (Groves 2013, eq. 5.18 and 5.53, in body axes)

so the mean over a period is the difference of V_b at its ends, plus a mean of products, which Lobatto's four-point
rule gives (Abramowitz and Stegun 25.4.32, error of the order dt^6): nothing is differentiated numerically.
The rate is the Euler angles' rate plus the turning of the local level and of the Earth.

The path is that of the rear axle on the road's plane. The sprung body moves against it by a `Shake`, by
displacements of the IMU and by turns about it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from graphnav.core import rotation
from graphnav.core.earth import E2, EARTH_RATE, A, ecef_to_llh, enu_axes, gravity, llh_to_ecef
from graphnav.core.progress import tell
from graphnav.core.rotation import Array
from graphnav.simulation.motion import BANK, HEADING, SLIP, SLOPE, SPEED, Path
from graphnav.simulation.vibration import PITCH, ROLL, Shake

_SAMPLES_AT_ONCE = 1 << 15  # samples at a time: these stay in the processor's cache
_LOBATTO_NODES = np.array(
    [0.0, 0.5 - 0.5 / np.sqrt(5.0), 0.5 + 0.5 / np.sqrt(5.0)]
)  # the fourth is the next one's first
_LOBATTO_WEIGHTS = np.array([1.0, 5.0, 5.0, 1.0]) / 12.0


@dataclass(frozen=True)
class Mount:
    """Mounting of the IMU on the vehicle: m in vehicle axes (RFU), deg."""

    above_axle: tuple[float, float, float] = (0.0, 1.2, 0.9)  # from the middle of the rear axle to the IMU
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)  # roll, pitch, heading of the IMU against the vehicle

    @property
    def R_vb(self) -> Array:
        """Vehicle axes from the IMU's, (3, 3)."""
        return rotation.from_rph(np.deg2rad(self.angles))

    @property
    def axle_lever_arm(self) -> Array:
        """From the IMU to the rear axle in the IMU's axes, m."""
        return -self.R_vb.T @ np.array(self.above_axle)


@dataclass(frozen=True)
class TrueMotion:
    """The IMU's true motion at N + 1 times and its N error-free samples, one for each period between them."""

    t: Array  # (N + 1,) s
    llh: Array  # (N + 1, 3) rad, rad, m, of the IMU
    v: Array  # (N + 1, 3) m/s, local ENU
    R_lb: Array  # (N + 1, 3, 3)
    omega_eb: Array  # (N + 1, 3) rad/s, over the Earth, in the IMU's axes
    gyro: Array  # (N, 3) rad/s, mean over the period that ends at t[1:]
    accel: Array  # (N, 3) m/s^2
    axle_llh: Array = field(repr=False)  # (N + 1, 3) path of the rear axle
    point: Callable[[Array, Array], tuple[Array, Array]] = field(repr=False)

    @property
    def rph(self) -> Array:
        """(N + 1, 3) roll, pitch, heading of the IMU, rad."""
        return rotation.to_rph(self.R_lb)


@dataclass(frozen=True)
class _AxleMotion:
    """The motion at some times except the position, in local ENU at the axle (l) and vehicle axes (v)."""

    v_axle: Array  # (n, 3) l
    R_base: Array  # (n, 3, 3) l from the road's axes
    euler_base: Array  # (n, 3) rate of the road's axes against l, in those axes
    arm: Array  # (n, 3) axle to IMU, road's axes
    arm_rate: Array
    R_lv: Array  # (n, 3, 3) l from the sprung body's axes
    euler: Array  # (n, 3) rate of the body against l, in body axes


def _derive_axle_motion(path: Path, shake: Shake, mount: Mount, t: Array) -> _AxleMotion:
    x = path.spline(np.clip(t, path.start, path.end))
    dx = path.spline.derivative()(np.clip(t, path.start, path.end))
    base, d_base = x[:, [BANK, SLOPE, HEADING]], dx[:, [BANK, SLOPE, HEADING]]
    shaken, d_shaken = shake(t)
    body, d_body = base.copy(), d_base.copy()
    for k, channel in enumerate((ROLL, PITCH)):
        body[:, k] += shaken[:, channel]
        d_body[:, k] += d_shaken[:, channel]
    R_base = rotation.from_rph(base)
    speed, slip = x[:, SPEED], x[:, SLIP]
    # in a right-hand bend the tyres deform to the left
    v_road = np.column_stack([-speed * np.sin(slip), speed * np.cos(slip), np.zeros(len(t))])
    return _AxleMotion(
        rotation.mv(R_base, v_road), R_base, _turn_rate(base, d_base), np.array(mount.above_axle) + shaken[:, :3],
        d_shaken[:, :3], rotation.from_rph(body), _turn_rate(body, d_body),
    )  # fmt: skip


def _turn_rate(rph: Array, rate: Array) -> Array:
    """Turn rate against the local level in the turned axes, (n, 3), from angles and their rates (n, 3).

    R = Rz(-heading) Rx(pitch) Ry(roll), each rate about the axis it turns.
    """
    sr, cr, sp, cp = np.sin(rph[:, 0]), np.cos(rph[:, 0]), np.sin(rph[:, 1]), np.cos(rph[:, 1])
    roll, pitch, heading = rate.T
    return np.column_stack([pitch * cr + heading * cp * sr, roll - heading * sp, pitch * sr - heading * cp * cr])


def _compute_radii(lat: Array, h: Array) -> tuple[Array, Array]:
    """(metres per radian along the meridian, radius of the prime vertical), with the height in them."""
    w = 1.0 - E2 * np.sin(lat) ** 2
    return A * (1.0 - E2) / w**1.5 + h, A / np.sqrt(w) + h


def _level(felt: _AxleMotion, lat: Array, h: Array) -> tuple[Array, Array, Array, Array, Array]:
    """(V in l, V in v, turn over the Earth in v, Earth's rate in v, gravity in v), each (n, 3)."""
    north, east = _compute_radii(lat, h)
    ve, vn = felt.v_axle[:, 0], felt.v_axle[:, 1]
    transport = np.column_stack([-vn / north, ve / east, ve * np.tan(lat) / east])
    earth = EARTH_RATE * np.column_stack([np.zeros_like(lat), np.cos(lat), np.sin(lat)])
    to_base, to_body = np.swapaxes(felt.R_base, -1, -2), np.swapaxes(felt.R_lv, -1, -2)
    omega_base = felt.euler_base + rotation.mv(to_base, transport)
    V_l = felt.v_axle + rotation.mv(felt.R_base, np.cross(omega_base, felt.arm) + felt.arm_rate)
    arm_l = rotation.mv(felt.R_base, felt.arm)
    # up at the IMU, which stands a lever arm away from the axle
    up = np.column_stack([arm_l[:, 0] / east, arm_l[:, 1] / north, np.ones_like(lat)])
    g_l = -gravity(lat, h + arm_l[:, 2])[:, None] * up
    omega = felt.euler + rotation.mv(to_body, transport)
    return V_l, rotation.mv(to_body, V_l), omega, rotation.mv(to_body, earth), rotation.mv(to_body, g_l)


def move_vehicle(path: Path, origin: tuple[float, float, float], mount: Mount, shake: Shake, rate: float) -> TrueMotion:
    """Drive `path` from `origin` (deg, deg, m; where the rear axle starts) with an IMU of `rate` Hz.

    Two hours at 200 Hz take some fifteen seconds.
    """
    count = int(np.floor((path.end - path.start) * rate + 1e-6))
    t = path.start + np.arange(count + 1) / rate
    axle = np.empty((count + 1, 3))
    axle[0] = np.deg2rad(origin[0]), np.deg2rad(origin[1]), origin[2]
    V = np.empty((count + 1, 3))
    R = np.empty((count + 1, 3, 3))
    omega_eb, arm = np.empty((count + 1, 3)), np.empty((count + 1, 3))
    gyro, accel = np.empty((count, 3)), np.empty((count, 3))
    for a in range(0, count, _SAMPLES_AT_ONCE):
        tell("driving", a / count)
        b = min(a + _SAMPLES_AT_ONCE, count)
        n = b - a
        nodes = np.append((t[a:b, None] + _LOBATTO_NODES / rate).ravel(), t[b])
        felt = _derive_axle_motion(path, shake, mount, nodes)
        axle[a + 1 : b + 1] = _travel(axle[a], _compute_means(felt.v_axle), 1.0 / rate)
        # between two samples the place hardly changes: the deviation from a straight line is 1e-5 m
        place = axle[a:b, None] + _LOBATTO_NODES[:, None] * (axle[a + 1 : b + 1] - axle[a:b])[:, None]
        place = np.concatenate([place.reshape(-1, 3), axle[b : b + 1]])
        V_l, V_v, omega, earth, g = _level(felt, place[:, 0], place[:, 2])
        gyro[a:b] = _compute_means(omega + earth)
        accel[a:b] = np.diff(V_v[::3], axis=0) * rate + _compute_means(np.cross(omega + 2.0 * earth, V_v) - g)
        rows = slice(a, b + 1)
        V[rows], R[rows], omega_eb[rows] = V_l[::3], felt.R_lv[::3], omega[::3]
        arm[rows] = rotation.mv(felt.R_base[::3], felt.arm[::3])
        assert len(V_l) == 3 * n + 1
    R_vb = mount.R_vb
    llh, v, R_lb = np.empty_like(axle), np.empty_like(axle), np.empty_like(R)
    for a in range(0, count + 1, _SAMPLES_AT_ONCE):
        rows = slice(a, a + _SAMPLES_AT_ONCE)
        llh[rows], turn = _move_points(axle[rows], arm[rows])
        v[rows], R_lb[rows] = rotation.mv(turn, V[rows]), turn @ R[rows] @ R_vb

    def compute_point(times: Array, lever_arm_b: Array) -> tuple[Array, Array]:
        """(llh, velocity in local ENU) of a point fixed to the IMU, at times within the drive, (M, 3) each."""
        times = np.clip(np.asarray(times, dtype=float), t[0], t[-1])
        felt = _derive_axle_motion(path, shake, mount, times)
        k = np.clip(((times - t[0]) * rate).astype(int), 0, count - 1)
        u = ((times - t[k]) * rate)[:, None]
        # cubic Hermite through the axle's places and their rates
        d0, d1 = (_place_rate(axle[j], _derive_axle_motion(path, shake, mount, t[j]).v_axle) / rate for j in (k, k + 1))
        change = axle[k + 1] - axle[k]
        place = axle[k] + u * (d0 + u * (3 * change - 2 * d0 - d1 + u * (d0 + d1 - 2 * change)))
        V_l, _, omega, _, _ = _level(felt, place[:, 0], place[:, 2])
        lever = R_vb @ np.asarray(lever_arm_b, dtype=float)
        offset = rotation.mv(felt.R_base, felt.arm) + felt.R_lv @ lever
        llh, turn = _move_points(place, offset)
        return llh, rotation.mv(turn, V_l + rotation.mv(felt.R_lv, np.cross(omega, lever)))

    return TrueMotion(t, llh, v, R_lb, omega_eb @ R_vb, gyro @ R_vb, accel @ R_vb, axle, compute_point)


def _compute_means(x: Array) -> Array:
    """Means (n, 3) over n periods of values (3 n + 1, 3) at their Lobatto nodes."""
    inner = _LOBATTO_WEIGHTS[1] * (x[1::3] + x[2::3])
    return inner + _LOBATTO_WEIGHTS[0] * (x[:-1:3] + x[3::3])


def _place_rate(llh: Array, v: Array) -> Array:
    north, east = _compute_radii(llh[:, 0], llh[:, 2])
    return np.column_stack([v[:, 1] / north, v[:, 0] / (east * np.cos(llh[:, 0])), v[:, 2]])


def _travel(start: Array, v: Array, dt: float) -> Array:
    """llh (n, 3) at the ends of n periods with mean velocities v, by fixed-point iteration on the radii (each gains
    1e-5).
    """
    llh = np.tile(start, (len(v) + 1, 1))
    for _ in range(3):
        step = _place_rate(0.5 * (llh[:-1] + llh[1:]), v) * dt
        llh[1:] = start + np.cumsum(step, axis=0)
    return llh[1:]


def _move_points(llh: Array, offset_l: Array) -> tuple[Array, Array]:
    """Points moved by vectors in their local ENU: (llh (n, 3), new local ENU from the old (n, 3, 3))."""
    R_le = enu_axes(llh)
    moved = ecef_to_llh(llh_to_ecef(llh) + rotation.mv(np.swapaxes(R_le, -1, -2), offset_l))
    return moved, enu_axes(moved) @ np.swapaxes(R_le, -1, -2)
