"""A drive of our own making: legs on a straight road, independent of graphnav.simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import signal

from graphnav.recording import Gnss, Imu, ImuNoise, Recording

NOISE = ImuNoise(gyro_noise_density=1.7e-5, accel_noise_density=5.9e-4)
MG = 9.80665e-3


def made(seed, legs, *, rate=200.0, engine=12.5, road=1.0, shakes=()):
    """(recording, t, speed): legs are (seconds, speed at their end); shakes are (start, seconds, m/s^2) at rest."""
    rng = np.random.default_rng(seed)
    n = int(sum(seconds for seconds, _ in legs) * rate)
    t = np.arange(1, n + 1) / rate
    knots = np.cumsum([0.0, *(seconds for seconds, _ in legs)])
    v = np.interp(t - 0.5 / rate, knots, [legs[0][1], *(speed for _, speed in legs)])
    soft = np.hanning(int(0.5 * rate) + 2)[1:-1]
    v = signal.convolve(np.pad(v, len(soft), mode="edge"), soft / soft.sum(), "same")[len(soft) : -len(soft)]
    accel, gyro = np.zeros((n, 3)), np.zeros((n, 3))
    accel[:, 1], accel[:, 2] = np.gradient(v, 1.0 / rate), 9.8

    def coloured(low, high, size):
        x = signal.lfilter(*signal.butter(2, [low, high], "bandpass", fs=rate), rng.standard_normal(n))
        return size * x / x.std()

    strength = road * np.sqrt(np.abs(v) / 14.0) * np.abs(v) / (np.abs(v) + 2.0)
    for axis, force, turn in ((0, 0.15, 0.8), (1, 0.12, 0.8), (2, 0.35, 0.3)):
        accel[:, axis] += strength * (coloured(0.8, 3.0, force) + coloured(5.0, 14.0, force))
        gyro[:, axis] += strength * np.radians(coloured(0.6, 3.0, turn))
    if engine:
        phase = 2.0 * np.pi * np.cumsum(np.where(v < 0.3, engine, 1.6 * engine + 1.2 * v)) / rate
        for axis, size in ((0, 0.4), (1, 0.7), (2, 1.0)):
            accel[:, axis] += 4.0 * MG * size * (np.sin(phase + axis) + 0.6 * np.sin(2.0 * phase + axis))
        gyro[:, 0] += np.radians(0.3) * np.sin(phase)
    for start, seconds, size in shakes:
        x = (t - start) / seconds
        inside = (x > 0.0) & (x < 1.0)
        # whole periods within a smooth envelope: it comes back to where it was
        wave = size * np.sin(2.0 * np.pi * x * round(1.5 * seconds)) * np.sin(np.pi * x) ** 2
        accel[inside, 0] += wave[inside]
        gyro[inside, 1] += np.radians(2.0) * wave[inside]
    accel += NOISE.accel_noise_density * np.sqrt(rate) * rng.standard_normal((n, 3)) + rng.normal(0.0, 0.02, 3)
    gyro += NOISE.gyro_noise_density * np.sqrt(rate) * rng.standard_normal((n, 3)) + rng.normal(0.0, 2e-3, 3)
    return Recording("made", "vehicle", Imu(t, gyro, accel, NOISE)), t, v


def with_gnss(recording, t, v, outage=(np.inf, np.inf)):
    """Fixes at 5 Hz on the way east, with velocities, but for an outage."""
    at = np.arange(t[0], t[-1], 0.2)
    at = at[(at < outage[0]) | (at > outage[1])]
    speed = np.interp(at, t, v)
    way = np.interp(at, t, np.cumsum(v) * (t[1] - t[0]))
    llh = np.column_stack([np.full(len(at), 0.6), 2.4 + way / (6378137.0 * np.cos(0.6)), np.zeros(len(at))])
    rng = np.random.default_rng(9)
    velocity = np.column_stack([speed, 0.0 * speed, 0.0 * speed]) + 0.03 * rng.standard_normal((len(at), 3))
    return replace(recording, gnss=Gnss(at, llh, np.full_like(llh, 0.02), velocity, np.full_like(llh, 0.03)))
