"""Other drives made of real ones, with the errors of their sensors: for `do_no_harm.py --changed NAME`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import graphnav
from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.recording import Recording, take_rows

_HALF_TURN = np.array([-1.0, -1.0, 1.0])  # about the vehicle's up axis
_BLIND, _SPARSE = 20.0, 8.0  # s
_AVERAGED = 5  # rows of the IMU
_LATE, _JITTER = 0.3, 0.05  # s
_GYRO_NOISE, _ACCEL_NOISE = 2e-3, 0.03  # rad/s and m/s^2, of each row
_TURN, _LASTS = np.radians([0.0, 0.0, 30.0]), 2.0  # and s


def turn_back(recording: Recording) -> Recording:
    """The drive that leads back along its path, with time reversed, the vehicle facing the way it then goes.

    Accelerations stay as they are, velocities and turn rates change their signs. What the Earth's rotation adds to the
    IMU does not: that is corrected by attitude and velocity of a solution with stated noise. Raw observations and other
    sensors are left out.
    """
    solved = graphnav.run(recording, None, ("rts",), noise="stated")["rts"]
    imu, gnss, odometer, truth = recording.imu, recording.gnss, recording.odometer, recording.truth
    end = recording.start + recording.end
    states = solved.at(np.clip(imu.t - 0.5 * imu.period, solved.t[0], solved.t[-1]))[1]
    R_bn, coriolis = np.swapaxes(states.R_nb, -1, -2), np.cross(2.0 * solved.frame.omega_n, states.v)
    gyro = -imu.gyro + 2.0 * R_bn @ solved.frame.omega_n
    accel = imu.accel - 2.0 * (R_bn @ coriolis[..., None])[..., 0]
    before = np.concatenate([[recording.start], imu.t[:-1]])  # where each row's period begins
    turned: dict[str, Any] = {
        "imu": replace(
            imu,
            t=end - before[::-1],
            gyro=_turn(gyro),
            accel=_turn(accel),
            R_bs=_HALF_TURN[:, None] * imu.R_bs,
        )
    }
    if gnss is not None:
        names = "llh", "sd", "sd_v", "type", "satellites", "residual_rms"
        turned["gnss"] = replace(
            gnss,
            t=end - gnss.t[::-1],
            v=None if gnss.v is None else -gnss.v[::-1],
            lever_arm=_HALF_TURN * gnss.lever_arm,
            velocity_offset=-gnss.velocity_offset,
            **{name: _reverse(getattr(gnss, name)) for name in names},
        )
    if odometer is not None:
        counted, wheels = odometer.counted, odometer.wheels
        turned["odometer"] = replace(
            odometer,
            t=end - odometer.t[::-1],
            speed=odometer.speed[::-1],
            lever_arm=_HALF_TURN * odometer.lever_arm,
            counted=None if counted is None else (counted[-1] - counted)[::-1],
            wheels=None if wheels is None else wheels[::-1, ::-1],  # front left and rear right change places
        )
    if truth is not None:
        turned["truth"] = replace(
            truth,
            t=end - truth.t[::-1],
            llh=_reverse(truth.llh),
            v=None if truth.v is None else -truth.v[::-1],
            rph=None if truth.rph is None else truth.rph[::-1] * _HALF_TURN + [0.0, 0.0, np.pi],
            of=truth.of if isinstance(truth.of, str) else tuple(_HALF_TURN * truth.of),
        )
    return replace(recording, **turned, raw_gnss=None, sensors={})


def withhold_start(recording: Recording) -> Recording:
    """The drive without its first fixes: a receiver that still searches, or a car park without a sky."""
    return recording.without("gnss", (-np.inf, _BLIND))


def thin_fixes(recording: Recording) -> Recording:
    """The drive with few fixes."""
    gnss = recording.gnss
    assert gnss is not None
    first = np.unique(np.floor((gnss.t - gnss.t[0]) / _SPARSE), return_index=True)[1]
    return replace(recording, gnss=take_rows(gnss, np.isin(np.arange(len(gnss.t)), first)))


def average_imu(recording: Recording) -> Recording:
    """The drive with an IMU of a low rate, each row the mean of several."""
    imu = recording.imu
    n = len(imu.t) // _AVERAGED * _AVERAGED
    t = imu.t[:n].reshape(-1, _AVERAGED)
    gyro, accel = (x[:n].reshape(-1, _AVERAGED, 3).mean(axis=1) for x in (imu.gyro, imu.accel))
    whole = t[:, -1] - t[:, 0] < _AVERAGED * imu.period  # without a gap
    return replace(recording, imu=replace(imu, t=t[whole, -1], gyro=gyro[whole], accel=accel[whole]))


def log_as_phone(recording: Recording) -> Recording:
    """The drive as a phone logs it: fixes stamped late, each otherwise, one a second, without velocities, and with one
    sigma for all, twice as large in height; beside an IMU with more noise.
    """
    imu, gnss, rng = recording.imu, recording.gnss, np.random.default_rng(5)
    assert gnss is not None
    t = gnss.t + _LATE + rng.uniform(0.0, _JITTER, len(gnss.t))
    sd = np.tile(np.median(gnss.sd[:, 0]) * np.array([1.0, 1.0, 2.0]), (len(t), 1))
    first = np.unique(np.floor(t - t[0]), return_index=True)[1]
    fixes = take_rows(replace(gnss, t=t, sd=sd, v=None, sd_v=None), np.isin(np.arange(len(t)), first))
    gyro = imu.gyro + rng.normal(0.0, _GYRO_NOISE, imu.gyro.shape)
    accel = imu.accel + rng.normal(0.0, _ACCEL_NOISE, imu.accel.shape)
    return replace(recording, gnss=fixes, imu=replace(imu, gyro=gyro, accel=accel))


def turn_device(recording: Recording) -> Recording:
    """The drive with an IMU that is turned in its holder halfway, and keeps its biases (of a solution)."""
    imu = recording.imu
    solved = graphnav.run(recording, None, ("rts",), noise="stated")["rts"]
    bg, ba = (np.median(getattr(solved.states, name), axis=0) for name in ("bg", "ba"))
    share = np.clip((imu.t - 0.5 * (recording.start + recording.end)) / _LASTS, 0.0, 1.0)
    R = np.swapaxes(rotation.exp(share[:, None] * _TURN), -1, -2)
    own = np.diff(share, prepend=0.0) / np.diff(imu.t, prepend=recording.start)
    gyro, accel = ((R @ x[..., None])[..., 0] for x in (imu.gyro - bg, imu.accel - ba))
    return replace(recording, imu=replace(imu, gyro=gyro + bg + own[:, None] * _TURN, accel=accel + ba))


def _reverse(rows: Array | None) -> Array | None:
    return None if rows is None else rows[::-1]


def _turn(rows: Array) -> Array:
    """Vectors (N, 3) of the vehicle's axes in those of one turned by half a turn, in reverse order."""
    return np.ascontiguousarray(rows[::-1] * _HALF_TURN)


CHANGES: dict[str, Callable[[Recording], Recording]] = {
    "backwards": turn_back,
    "blind-start": withhold_start,
    "sparse-fixes": thin_fixes,
    "slow-imu": average_imu,
    "phone": log_as_phone,
    "turned-imu": turn_device,
}
