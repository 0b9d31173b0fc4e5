"""Drives made by somebody else's simulator: recordings in memory, with their exact truth.

The motion and its error-free inertial samples come from `oracle_path`, that is from python-ins; this module adds
sensor errors of exactly the stated sizes, fixes, and wheel speed.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from oracle_path import AXLE, Array, ExactPath, llh_rate, oracle_truth_path, straight_path, vehicle_path, winding_path

from graphnav.core.trajectory import Trajectory
from graphnav.recording import Gnss, Imu, ImuNoise, Odometer, Recording, Truth

__all__ = [
    "AXLE", "LEVER_ARM", "MEMS", "RTK_SD", "SPP_SD", "ExactPath", "drive", "llh_rate", "moving_spans", "oracle_drive",
    "oracle_truth_path", "straight_path", "vehicle_path", "winding_path",
]  # fmt: skip

# The figures stated in the recording.toml of the shipped oracle drive.
MEMS = ImuNoise(
    gyro_noise_density=1.7453e-05,
    accel_noise_density=5.8840e-04,
    gyro_bias_walk=3.6293e-07,
    accel_bias_walk=1.1012e-05,
    gyro_bias_sigma=2.0e-3,
    accel_bias_sigma=3.0e-2,
)
LEVER_ARM = (0.3, 0.5, 1.2)  # m, RFU, IMU to antenna
RTK_SD, SPP_SD = (0.02, 0.02, 0.04), (2.5, 2.5, 4.0)  # m, east, north, up


def drive(
    path: ExactPath,
    *,
    imu_noise: ImuNoise | None = MEMS,
    seed: int = 0,
    gnss_rate: float = 1.0,
    gnss_phase: float = 0.0,
    gnss_sd: tuple[float, float, float] = RTK_SD,
    gnss_velocity_sd: tuple[float, float, float] | None = None,
    gnss_exact: bool = False,
    outages: tuple[tuple[float, float], ...] = (),
    lever_arm: tuple[float, float, float] = LEVER_ARM,
    odometer_rate: float | None = None,
    odometer_sd: float = 0.05,
    odometer_scale: float = 0.01,
) -> tuple[Recording, Trajectory]:
    """A recording of `path` and its truth at every sample time, start included (biases included, RFU).

    Sensor errors have exactly the stated densities: white noise of density / sqrt(dt), a turn-on bias, a random walk
    of it. ``imu_noise=None`` gives perfect samples under the stated figures of `MEMS`. White GNSS errors of the
    stated sigmas; ``gnss_exact`` leaves them out and keeps the sigmas. `outages` are closed spans in path time, s;
    `gnss_phase` s shifts the fixes off the samples' times. The odometer, where it has a rate, reads ``1 +
    odometer_scale`` times the speed, with noise only while it turns. Every sensor has its own random stream, so that
    changing one leaves the others' errors as they were.
    """
    imu_rng, gnss_rng, odometer_rng = (np.random.default_rng([seed, k]) for k in (11, 12, 13))
    count = len(path.gyro)
    b_g, b_a, gyro, accel = np.zeros((count, 3)), np.zeros((count, 3)), path.gyro, path.accel
    if imu_noise is not None:
        n = imu_noise
        b_g, gyro = _disturbed(gyro, n.gyro_noise_density, n.gyro_bias_walk, n.gyro_bias_sigma, path.dt, imu_rng)
        b_a, accel = _disturbed(accel, n.accel_noise_density, n.accel_bias_walk, n.accel_bias_sigma, path.dt, imu_rng)

    t0, t1 = path.t[0], path.t[-1]
    t = t0 + gnss_phase + np.arange(int((t1 - t0 - gnss_phase) * gnss_rate + 1e-6) + 1) / gnss_rate
    llh, v, _ = path.point(t, lever_arm)
    errors = gnss_rng.standard_normal((len(t), 6)) * (0.0 if gnss_exact else 1.0)
    sd = np.tile(np.asarray(gnss_sd, dtype=float), (len(t), 1))
    llh = llh + llh_rate(llh, errors[:, :3] * sd)
    sd_v = None if gnss_velocity_sd is None else np.tile(np.asarray(gnss_velocity_sd, dtype=float), (len(t), 1))
    seen = ~np.any([(t >= a) & (t <= b) for a, b in outages], axis=0) if outages else np.full(len(t), True)
    gnss = Gnss(
        t=t[seen],
        llh=llh[seen],
        sd=sd[seen],
        v=None if sd_v is None else (v + errors[:, 3:] * sd_v)[seen],
        sd_v=None if sd_v is None else sd_v[seen],
        lever_arm=np.array(lever_arm),
    )

    odometer = None
    if odometer_rate is not None:
        t = t0 + np.arange(int((t1 - t0) * odometer_rate + 1e-6) + 1) / odometer_rate
        forward = path.point(t, AXLE)[2][:, 1]
        noise = odometer_sd * odometer_rng.standard_normal(len(t)) * (np.abs(forward) > 1e-3)
        odometer = Odometer(t, forward * (1 + odometer_scale) + noise, np.array(AXLE), scale_sigma=0.02)

    tenth = slice(None, None, max(1, round(0.1 / path.dt)))
    rph = np.column_stack([path.rph[:, :2], np.mod(path.rph[:, 2], 2 * np.pi)])
    recording = Recording(
        name=f"{path.name}, seed {seed}",
        platform="vehicle",
        imu=Imu(path.t[1:], gyro, accel, imu_noise or MEMS),
        gnss=gnss,
        odometer=odometer,
        truth=Truth(t=path.t[tenth], llh=path.llh[tenth], v=path.v[tenth], rph=rph[tenth]),
    )
    truth = Trajectory(
        t=path.t,
        llh=path.llh,
        v=path.v,
        rph=rph,
        gyro_bias=np.vstack([b_g[:1], b_g]),
        accel_bias=np.vstack([b_a[:1], b_a]),
        name="truth",
    )
    return recording, truth


def _disturbed(
    exact: Array, density: float, walk: float, turn_on: float, dt: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """(bias, exact + bias + white noise), (N, 3) each."""
    bias = turn_on * rng.standard_normal(3) + np.cumsum(walk * np.sqrt(dt) * rng.standard_normal(exact.shape), axis=0)
    return bias, exact + bias + density / np.sqrt(dt) * rng.standard_normal(exact.shape)


def oracle_drive(
    shared_data: Path, seed: int, *, rtk: bool = True, odometer: bool = True, rate: float = 200.0
) -> tuple[Recording, Trajectory]:
    """The shipped oracle drive's path, stated noise and outage with fresh errors; half a second for a seed.

    ``rtk=False`` gives white errors of single-point size (the shipped ones are correlated in time, which no white
    sigma describes, so they cannot serve a consistency test).
    """
    path = oracle_truth_path(shared_data, rate)
    spans = json.loads((Path(shared_data) / "oracle_drive" / "outages.json").read_text())["outages"]
    return drive(
        path,
        seed=seed,
        gnss_sd=RTK_SD if rtk else SPP_SD,
        outages=tuple((a, b) for a, b in spans),
        odometer_rate=20.0 if odometer else None,
    )


def moving_spans(path: ExactPath, length: float, count: int, slowest: float = 3.0) -> tuple[tuple[float, float], ...]:
    """`count` spans of `length` s spread over the path in which the vehicle keeps moving, for outages."""
    step = round(1.0 / path.dt)
    fast = (path.speed[::step] > slowest).astype(int)
    size = round(length)
    share = np.convolve(fast, np.ones(size), "valid") / size  # of each span that starts at a whole second
    spans = []
    for part in np.array_split(np.arange(len(share)), count):
        inside = part[(part > 60) & (part < part[-1] - size)]
        start = inside[np.argmax(share[inside])]
        spans.append((float(path.t[0] + start + 0.5), float(path.t[0] + start + 0.5 + length)))
    return tuple(spans)
