"""Error-free IMU readings of a foot, and the recording of a walk.

Walks are short: everything is in one east-north-up frame n at the start, with its own gravity vector at each place.
With the acceleration of the splines, as exact as their positions,

    f_b = R_nb^T (dv_n/dt + 2 Omega_n x v_n - g_n)                                    (Groves 2013, eq. 5.36 and 5.53)

and what a sample holds is an integral over its period, by Gauss's three-point rule between the splines' knots. A foot
turns by four degrees in a hundredth of a second about changing axes: means of rate and force over a period then lose
information (coning and sculling; Savage 1998). Inertial units with a fast processor instead output the constant rate
and force that lead from one attitude and velocity to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array, mv
from graphnav.recording import Recording
from graphnav.recording.formats.writing import round_recording
from graphnav.simulation.gait import GAIT_STEP, HEADING, PITCH, PLACE_CHANNELS, ROLL, Foot
from graphnav.simulation.inertial import SimulatedImu
from graphnav.simulation.kinematics import TrueMotion
from graphnav.simulation.result import Simulated, read_motion

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(3)
_SAMPLES_AT_ONCE = 1 << 13  # samples at a time


@dataclass(frozen=True)
class _FootMotion:
    """The IMU in n and in its own axes, at n times."""

    p: Array  # (n, 3) m
    v: Array  # (n, 3) m/s
    R_nb: Array  # (n, 3, 3)
    omega: Array  # (n, 3) rad/s over the Earth, b


def _move_foot(foot: Foot, R_fb: Array, t: Array) -> _FootMotion:
    x, dx = foot.spline(t), foot.spline.derivative()(t)
    R_nf = rotation.from_rph(x[:, [ROLL, PITCH, HEADING]])
    roll = x[:, ROLL]
    # each rate about the axis it turns: heading about down, pitch about the unrolled right, roll about forward
    omega = np.column_stack([dx[:, PITCH] * np.cos(roll), dx[:, ROLL], dx[:, PITCH] * np.sin(roll)])
    omega -= dx[:, [HEADING]] * R_nf[:, 2]
    return _FootMotion(x[:, PLACE_CHANNELS], dx[:, PLACE_CHANNELS], R_nf @ R_fb, omega @ R_fb)


def move_foot(
    foot: Foot, origin: tuple[float, float, float], R_fb: Array, rate: float, compensated: bool = False
) -> TrueMotion:
    """Walk from `origin` (deg, deg, m; the floor) with an IMU of `rate` Hz, rotated by R_fb against the foot.

    Samples are means over their periods; `compensated` ones are the constant rate and force that lead to the same
    attitude and velocity. Six minutes take a second.
    """
    frame = LocalFrame(np.array([np.deg2rad(origin[0]), np.deg2rad(origin[1]), origin[2]]))
    count = int(np.floor((foot.end - foot.start) * rate + 1e-6))
    dt = 1.0 / rate
    t = foot.start + np.arange(count + 1) * dt
    ends = _move_foot(foot, R_fb, t)
    parts = max(1, round(2.0 * dt / GAIT_STEP))  # share of a period: at most half a step of the spline
    nodes = ((np.arange(parts)[:, None] + 0.5 + 0.5 * _GAUSS_NODES) * dt / parts).ravel()
    weights = np.tile(0.5 * _GAUSS_WEIGHTS / parts, parts)
    acceleration = foot.spline.derivative(2)
    gyro, accel = np.empty((count, 3)), np.empty((count, 3))
    for a in range(0, count, _SAMPLES_AT_ONCE):
        rows = slice(a, min(a + _SAMPLES_AT_ONCE, count))
        inside = (t[:-1][rows, None] + nodes).ravel()
        felt = _move_foot(foot, R_fb, inside)
        to_body = np.swapaxes(felt.R_nb, -1, -2)
        coriolis = 2.0 * np.cross(frame.omega_n, felt.v)
        force = mv(to_body, acceleration(inside)[:, PLACE_CHANNELS] + coriolis - frame.gravity_n(felt.p))
        omega = felt.omega + to_body @ frame.omega_n
        if compensated:
            # attitudes against the first one of the period, in space
            back = np.swapaxes(ends.R_nb[rows], -1, -2)
            turned = rotation.exp(nodes[:, None] * frame.omega_n) @ felt.R_nb.reshape(-1, len(nodes), 3, 3)
            gained = mv(back[:, None] @ turned, force.reshape(-1, len(nodes), 3))
            phi = rotation.log(back @ rotation.exp(dt * frame.omega_n) @ ends.R_nb[1:][rows])
            gyro[rows] = phi * rate
            accel[rows] = mv(rotation.right_jacobian_inverse(-phi), np.einsum("kjc,j->kc", gained, weights))
        else:
            gyro[rows] = np.einsum("kjc,j->kc", omega.reshape(-1, len(nodes), 3), weights)
            accel[rows] = np.einsum("kjc,j->kc", force.reshape(-1, len(nodes), 3), weights)
    R_ln = frame.R_ln(ends.p)

    def compute_point(times: Array, lever_arm_b: Array) -> tuple[Array, Array]:
        """(llh, velocity in local ENU) of a point fixed to the IMU, at times within the walk, (M, 3) each."""
        felt = _move_foot(foot, R_fb, np.clip(np.asarray(times, dtype=float), t[0], t[-1]))
        arm = np.asarray(lever_arm_b, dtype=float)
        p = felt.p + felt.R_nb @ arm
        return frame.to_llh(p), mv(frame.R_ln(p), felt.v + mv(felt.R_nb, np.cross(felt.omega, arm)))

    llh = frame.to_llh(ends.p)
    return TrueMotion(t, llh, mv(R_ln, ends.v), R_ln @ ends.R_nb, ends.omega, gyro, accel, llh, compute_point)


def record_walk(
    name: str, seed: int, foot: Foot, *, origin: tuple[float, float, float], imu: SimulatedImu,
    mounting: tuple[float, float, float], exact: bool = False, compensated: bool = False,
    facts: dict[str, Any] | None = None,
) -> Simulated:  # fmt: skip
    """Simulate a walk and read the IMU, mounted with roll, pitch and heading (deg) against the shoe.

    The facts hold `stances` and `contacts`, (M, 2) s. `exact` leaves out the IMU's errors and keeps its stated
    figures.
    """
    motion = move_foot(foot, origin, rotation.from_rph(np.deg2rad(mounting)), imu.rate, compensated)
    readings, sampled, truth = read_motion(motion, imu, seed, exact, 100.0)
    recording = Recording(f"{name} (simulated, seed {seed})", "foot", readings, truth=sampled)
    known: dict[str, Any] = {"scenario": name, "seed": seed, "imu": imu.name, **(facts or {})}
    known["mounting_deg"] = dict(zip(("roll", "pitch", "heading"), mounting, strict=True))
    known["clipped_samples"] = {
        "gyro": int(np.sum(np.any(np.abs(motion.gyro) > imu.gyro.limit, axis=1))),
        "accel": int(np.sum(np.any(np.abs(motion.accel) > imu.accel.limit, axis=1))),
    }
    known["stances"], known["contacts"] = foot.stances.tolist(), foot.contacts.tolist()
    return Simulated(round_recording(recording), truth, foot.stances[[0, -1]], known, motion)
