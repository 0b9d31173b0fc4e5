"""Output of a running drive: the state at every IMU row, predicted from a keyframe, and settled states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphnav.constraints.base import SAME_TIME
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.dense import Dense
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.solution import make_trajectory
from graphnav.estimation.solvers.stages import Message
from graphnav.estimation.solvers.turning import add_curvature
from graphnav.estimation.solvers.window import SettledStates
from graphnav.imu.dynamics import SCALE, ImuFactors, convert_to_biases
from graphnav.imu.preintegration import NOISE_FIGURES, preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.online.sensors import Sensors


@dataclass(frozen=True)
class Live:
    """The current state: one state, the covariance of its error state, and the newest keyframe it is predicted from."""

    t: float
    state: States
    covariance: Array  # (15, 15)
    keyframe: float  # s


def live(newest: Message, T: float, frame: LocalFrame, sensors: Sensors, noise: NoiseModel) -> Live:
    """Predict the state at the newest IMU row from the message `newest` of the newest keyframe at T (s)."""
    now = sensors.imu.newest
    state, P = newest.state, newest.covariance
    if now > T + SAME_TIME:
        imu = sensors.make_recording(T - 1.0, now).imu
        factors = np.array([noise.get_factor(f"imu.{name}", 1.0) for name in NOISE_FIGURES])
        ends, differs = np.array([T, now]), bool(np.any(factors != 1.0))
        intervals = preintegrate(bridge_gaps(imu, T), imu, ends, state.ba[0], state.bg[0], differs)
        if differs:
            intervals = intervals.with_noise(factors)
        motion, one = ImuFactors(intervals, frame), slice(0, 1)
        scale = newest.get_value(SCALE) if SCALE in newest.columns else None
        ahead, by_both = motion.propagate(one, state, scale)
        F = np.zeros((DIM, len(P)))
        F[:, :DIM] = by_both[0, :, :DIM]
        if scale is not None:
            F[:, newest.columns[SCALE]] = by_both[0, :, DIM:]
        P = F @ P @ F.T + motion.compute_noise(one, state.R_nb)[0]
        state = ahead
    return Live(float(max(now, T)), state, add_curvature(P[None, :DIM, :DIM], state)[0], T)


def predict_since(
    newest: Message, T: float, frame: LocalFrame, sensors: Sensors, noise: NoiseModel
) -> tuple[Array, States, Array]:
    """Times (M,), states and covariances (M, 15, 15) at every IMU row since the newest keyframe at T (s).

    States are predicted through each row; covariances are interpolated linearly between both ends.
    """
    t = sensors.imu.t[sensors.imu.t > T + SAME_TIME].copy()
    if not len(t):
        return t, newest.state[:0], np.empty((0, DIM, DIM))
    now = live(newest, T, frame, sensors, noise)
    imu, start = sensors.make_recording(T - 1.0, now.t).imu, newest.state
    ba, bg = start.ba, start.bg
    if SCALE in newest.columns:
        scale, rows = newest.get_value(SCALE), imu.t > T
        mean = imu.accel[rows].mean(axis=0, keepdims=True) - ba, imu.gyro[rows].mean(axis=0, keepdims=True) - bg
        of_accel, of_gyro = convert_to_biases(scale, *mean)
        ba, bg = ba + of_accel, bg + of_gyro
    before = add_curvature(newest.covariance[None, :DIM, :DIM], start)[0]
    ends, both = np.array([T, now.t]), np.stack([before, now.covariance])
    states = States.stack([start, now.state])
    between = Dense(ends, states, both, bridge_gaps(imu), frame, ba, bg, np.zeros((2, len(ba))), both[1:])
    return t, *between(t)


def export(settled: SettledStates, rows: NDArray[np.bool_], frame: LocalFrame) -> Trajectory:
    """Settled rows (N,) as a trajectory.

    Raises
    ------
    FloatingPointError
        If a state is no number.
    """
    states = settled.states[rows]
    track = make_trajectory("online", frame, settled.t[rows], states, add_curvature(settled.covariance[rows], states))
    known = (track.llh, track.v, track.rph, track.sd_p, track.sd_v, track.sd_rph)
    if not all(x is None or np.isfinite(x).all() for x in known):
        raise FloatingPointError("states that are not finite")
    return track
