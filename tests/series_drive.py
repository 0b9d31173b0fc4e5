"""Parts of a simulated drive whose truth is exact, and what sensors along it would read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from graphnav.config import parse_settings
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.online import Online, drop_rows, list_rows
from graphnav.recording import Recording, Truth
from graphnav.recording.formats import read
from graphnav.sensors import Series

# nothing but IMU, fixes and the sensor in question; figures as stated, which is what a test has time for
SETTINGS = parse_settings(
    {"vehicle": {"nhc": False, "odometer": False}, "noise": {"mode": "stated"}, "gnss": {"faults": "off"}}
)


ACCEL, GYRO = 0.05, 5e-3  # m/s^2 and rad/s per root of Hz: what a vibrating mount adds
OUTAGE = (15.0, 35.0)  # s from the start: such noise drifts by 2.6 m and by 1.3 deg over it


def shared_drive(shared_data: Path) -> Recording:
    """Forty seconds in motion with an outage; the IMU is made worse, and says so."""
    recording = read(shared_data / "oracle_drive" / "recording.toml").crop(95.0, 135.0)
    imu, rng = recording.imu, np.random.default_rng(6)
    root = np.sqrt(1.0 / np.median(np.diff(imu.t)))
    worse = replace(
        imu,
        gyro=imu.gyro + GYRO * root * rng.standard_normal(imu.gyro.shape),
        accel=imu.accel + ACCEL * root * rng.standard_normal(imu.accel.shape),
        noise=replace(imu.noise, gyro_noise_density=GYRO, accel_noise_density=ACCEL),
    )
    return replace(recording, imu=worse, odometer=None).without("gnss", OUTAGE)


def along_truth(recording: Recording, rate: float) -> tuple[Array, Truth]:
    """Times at a rate, and the truth interpolated there."""
    truth = recording.truth
    t = np.arange(recording.start + 1.0 / rate, recording.end, 1.0 / rate)

    def at(x: Array) -> Array:
        return np.column_stack([np.interp(t, truth.t, column) for column in x.T])

    return t, Truth(t, at(truth.llh), v=at(truth.v), rph=at(np.unwrap(truth.rph, axis=0)))


def with_series(recording: Recording, series: Series) -> Recording:
    return replace(recording, sensors={series.sensor.name: series})


def errors(track: Trajectory, recording: Recording) -> tuple[Array, Array]:
    """Errors of height (m) and heading (rad) in the outage."""
    truth = recording.truth
    inside = (track.t - recording.start > OUTAGE[0]) & (track.t - recording.start < OUTAGE[1])
    t = track.t[inside]
    up = track.llh[inside, 2] - np.interp(t, truth.t, truth.llh[:, 2])
    heading = track.rph[inside, 2] - np.interp(t, truth.t, np.unwrap(truth.rph[:, 2]))
    return up, (heading + np.pi) % (2.0 * np.pi) - np.pi


def smoothed_online(recording: Recording) -> list[Trajectory]:
    """What a replay settles."""
    online = Online(drop_rows(recording), SETTINGS)
    for row in list_rows(recording)[1]:
        online.add(row)
    online.finish()
    assert not online.failures, online.failures
    return online.settled()


def rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))
