"""Other drives made of real ones, with the errors of their sensors: for `do_no_harm.py --changed NAME`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import graphnav
from graphnav.core import rotation
from graphnav.core.earth import A, LocalFrame
from graphnav.core.rotation import Array
from graphnav.recording import Gnss, Odometer, Recording, take_rows

_HALF_TURN = np.array([-1.0, -1.0, 1.0])  # about the vehicle's up axis
_BLIND, _SPARSE = 20.0, 8.0  # s
_AVERAGED = 5  # rows of the IMU
_LATE, _JITTER = 0.3, 0.05  # s
_GYRO_NOISE, _ACCEL_NOISE = 2e-3, 0.03  # rad/s and m/s^2, of each row
_TURN, _LASTS = np.radians([0.0, 0.0, 30.0]), 2.0  # and s
_TILT = np.radians([35.0, 0.0, 0.0])
_COLD, _WARMS = (np.radians(0.2), 0.06), 100.0  # rad/s and m/s^2 of every axis at first, s
_OBD_RATE, _OBD_LATE, _OBD_HIGH = 2.0, 0.3, 1.02  # Hz, s
_WANDER, _WANDER_TIME = np.array([2.0, 2.0, 5.0]), 60.0  # m, s
_TUNNEL, _EDGE, _ASTRAY = 60.0, 5.0, 30.0  # s, s, m
_PARKED, _SETTLES, _AT_FIRST = 60.0, 15.0, 4.0  # s, s, stated sigmas
_BURST_EVERY, _BURST_LASTS, _BURST_OFF = 40.0, (1.0, 6.0), (10.0, 60.0)  # s, s, m
_DIGITS = np.array([np.radians(1e-5), np.radians(1e-5), 1.0])  # rad, rad, m
_ROUGH = 0.04  # m/s^2 and rad/s per 100, of a row, per m/s
_LOST, _STAMPS = 0.02, 0.003  # share of rows, s


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


def tilt_device(recording: Recording) -> Recording:
    """The drive with an IMU in a cradle that leans back; the axes are as stated."""
    return _rotated(recording, _TILT)


def warm_up(recording: Recording) -> Recording:
    """The drive with an IMU whose biases settle as it warms up."""
    imu = recording.imu
    cold = np.exp(-(imu.t - recording.start) / _WARMS)[:, None]
    return replace(recording, imu=replace(imu, gyro=imu.gyro + _COLD[0] * cold, accel=imu.accel + _COLD[1] * cold))


def read_obd(recording: Recording) -> Recording:
    """The drive with a speed as a diagnostic socket gives it: whole km/h, late, too high.

    Where there is no odometer, of a solution.
    """
    odometer = recording.odometer
    if odometer is None:
        solved = graphnav.run(recording, None, ("rts",), noise="stated")["rts"]
        forward = solved.states.R_nb[:, :, 1]
        odometer = Odometer(solved.t, np.einsum("ni,ni->n", forward, solved.states.v))
    t = np.arange(odometer.t[0], odometer.t[-1], 1.0 / _OBD_RATE)
    speed = np.round(np.abs(np.interp(t, odometer.t, odometer.speed)) * _OBD_HIGH * 3.6) / 3.6
    late = t + _OBD_LATE
    known = late < recording.end
    return replace(
        recording,
        odometer=Odometer(
            late[known], speed[known], odometer.lever_arm, scale_sigma=odometer.scale_sigma, signed=False
        ),
    )


def wander(recording: Recording) -> Recording:
    """The drive with fixes whose errors last: a receiver among trees, its sigma as before."""
    gnss = _gnss(recording)
    rng, steps = np.random.default_rng(7), np.exp(-np.diff(gnss.t, prepend=gnss.t[0]) / _WANDER_TIME)
    away = rng.normal(0.0, 1.0, gnss.llh.shape)
    for k in range(1, len(away)):
        away[k] = steps[k] * away[k - 1] + np.sqrt(1.0 - steps[k] ** 2) * away[k]
    return _moved(recording, away * _WANDER)


def drive_through_tunnel(recording: Recording) -> Recording:
    """The drive with a tunnel halfway: the last fixes before it and the first behind it go astray."""
    gnss = _gnss(recording)
    middle = 0.5 * (gnss.t[0] + gnss.t[-1])
    into, out = middle - 0.5 * _TUNNEL, middle + 0.5 * _TUNNEL
    share = np.clip(np.maximum(1.0 - (into - gnss.t) / _EDGE, 0.0) * (gnss.t <= into), 0.0, 1.0)
    share += np.clip(np.maximum(1.0 - (gnss.t - out) / _EDGE, 0.0) * (gnss.t >= out), 0.0, 1.0)
    moved = _moved(recording, share[:, None] * _ASTRAY * np.array([0.6, -0.8, 0.5]))
    return moved.without("gnss", (into - recording.start + 1e-3, out - recording.start - 1e-3))


def leave_garage(recording: Recording) -> Recording:
    """The drive out of a garage: no fix for a minute, and the first ones astray."""
    gnss = _gnss(recording)
    since = gnss.t - gnss.t[0] - _PARKED
    away = _AT_FIRST * gnss.sd * np.exp(-np.maximum(since, 0.0) / _SETTLES)[:, None] * np.array([0.8, 0.6, 1.0])
    return _moved(recording, away).without("gnss", (-np.inf, gnss.t[0] - recording.start + _PARKED))


def reflect(recording: Recording) -> Recording:
    """The drive between high buildings: now and then some fixes in a row are off, all in the same direction."""
    gnss, rng = _gnss(recording), np.random.default_rng(11)
    away, t = np.zeros(gnss.llh.shape), gnss.t[0] + rng.exponential(_BURST_EVERY)
    while t < gnss.t[-1]:
        lasts, size, course = rng.uniform(*_BURST_LASTS), rng.uniform(*_BURST_OFF), rng.uniform(-np.pi, np.pi)
        direction = np.array([np.sin(course), np.cos(course), rng.normal()])
        away[(gnss.t >= t) & (gnss.t < t + lasts)] = size * direction
        t += lasts + rng.exponential(_BURST_EVERY)
    return _moved(recording, away)


def round_fixes(recording: Recording) -> Recording:
    """The drive with fixes of few digits: 1e-5 deg and whole metres; their velocities and sigmas as before."""
    gnss = _gnss(recording)
    e, n, u = A * _DIGITS[1] * np.cos(gnss.llh[0, 0]), A * _DIGITS[0], _DIGITS[2]
    rounding = tuple((np.array([e, n, u]) / np.sqrt(12.0)).tolist())
    return replace(recording, gnss=replace(gnss, llh=np.round(gnss.llh / _DIGITS) * _DIGITS, rounding=rounding))


def hold_fixes(recording: Recording) -> Recording:
    """The drive logged at 10 Hz, with each fix repeated until the next, under the stamps of the log."""
    gnss = _gnss(recording)
    first = np.unique(np.floor(gnss.t - gnss.t[0]), return_index=True)[1]
    fixes = take_rows(gnss, np.isin(np.arange(len(gnss.t)), first))
    t = np.arange(fixes.t[0], gnss.t[-1], 0.1)
    held = np.searchsorted(fixes.t, t + 1e-6, side="right") - 1
    rows = {
        name: None if getattr(fixes, name) is None else getattr(fixes, name)[held]
        for name in ("llh", "sd", "v", "sd_v", "type", "satellites", "residual_rms")
    }
    return replace(recording, gnss=replace(fixes, t=t, **rows))


def shake(recording: Recording) -> Recording:
    """The drive on a rough road: an IMU that shakes with the speed."""
    imu, gnss, rng = recording.imu, _gnss(recording), np.random.default_rng(13)
    xyz = LocalFrame(gnss.llh[0]).from_llh(gnss.llh)
    speed = np.linalg.norm(np.gradient(xyz, gnss.t, axis=0), axis=1)
    size = _ROUGH * np.minimum(np.interp(imu.t, gnss.t, speed), 30.0)[:, None]
    gyro = imu.gyro + 0.01 * size * rng.normal(size=imu.gyro.shape)
    return replace(recording, imu=replace(imu, gyro=gyro, accel=imu.accel + size * rng.normal(size=imu.accel.shape)))


def lose_rows(recording: Recording) -> Recording:
    """The drive as a busy computer logs it: some rows of the IMU are lost, the others stamped as they came."""
    imu, rng = recording.imu, np.random.default_rng(17)
    kept = rng.random(len(imu.t)) >= _LOST
    jitter = np.minimum(_STAMPS, 0.4 * imu.period) * rng.uniform(-1.0, 1.0, kept.sum())
    return replace(recording, imu=replace(imu, t=imu.t[kept] + jitter, gyro=imu.gyro[kept], accel=imu.accel[kept]))


def _gnss(recording: Recording) -> Gnss:
    assert recording.gnss is not None
    return recording.gnss


def _moved(recording: Recording, away: Array) -> Recording:
    """With fixes that are (N, 3) m east, north, up of where they were."""
    gnss = _gnss(recording)
    frame = LocalFrame(gnss.llh[0])
    return replace(recording, gnss=replace(gnss, llh=frame.to_llh(frame.from_llh(gnss.llh) + away)))


def _rotated(recording: Recording, angle: Array) -> Recording:
    """With an IMU turned by a rotation vector, rad."""
    imu, R = recording.imu, rotation.exp(angle).T
    return replace(recording, imu=replace(imu, gyro=imu.gyro @ R.T, accel=imu.accel @ R.T))


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
    "tilted-imu": tilt_device,
    "warm-up": warm_up,
    "obd": read_obd,
    "wandering": wander,
    "tunnel": drive_through_tunnel,
    "garage": leave_garage,
    "reflections": reflect,
    "few-digits": round_fixes,
    "held-fixes": hold_fixes,
    "rough-road": shake,
    "lost-rows": lose_rows,
}
ELSEWHERE = "backwards", "phone"  # place or stamps are others: the drive as it was is no reference
