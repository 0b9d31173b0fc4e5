"""What is drawn to damage a drive, and how large: errors of sensors, and habits that receivers and loggers have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from damage import moved

from graphnav.core.earth import LocalFrame
from graphnav.recording import Gnss, Imu, Odometer
from graphnav.recording.formats.rounding import measure_rounding

Rng = np.random.Generator


@dataclass(frozen=True)
class Fault:
    """One way for a sensor to go wrong, and how often a draw has it."""

    sensor: str
    chance: float
    damage: Callable[[Any, Rng], tuple[Any, str]]  # the sensor as it comes, and what was done to it


def spans(t: np.ndarray, rng: Rng, most: int, shortest: float, longest: float) -> list[tuple[float, float]]:
    """Up to `most` spans (s) within times t (N,)."""
    out = []
    for _ in range(int(rng.integers(1, most + 1))):
        length = float(np.exp(rng.uniform(np.log(shortest), np.log(longest))))
        begin = float(rng.uniform(t[0], max(t[-1] - length, t[0])))
        out.append((begin, begin + length))
    return out


def kept(gnss: Gnss, keep: np.ndarray) -> Gnss:
    """The fixes of a mask or of indices."""
    names = ("t", "llh", "sd", "v", "sd_v", "type", "satellites")
    return replace(gnss, **{name: value[keep] for name in names if (value := getattr(gnss, name)) is not None})


def wrong_sigmas(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    by = float(np.exp(rng.uniform(np.log(0.2), np.log(15.0))))
    sd_v = None if gnss.sd_v is None else gnss.sd_v * by
    return replace(gnss, sd=gnss.sd * by, sd_v=sd_v), f"sigmas x {by:.2f}"


def outliers(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    share, size = rng.uniform(0.01, 0.1), np.exp(rng.uniform(np.log(5.0), np.log(100.0)))
    wrong = rng.random(len(gnss.t)) < share
    by = size * wrong[:, None] * rng.standard_normal((len(gnss.t), 3))
    return moved(gnss, by), f"{100 * share:.0f} % off by {size:.0f} m"


def bursts(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    by, said = np.zeros((len(gnss.t), 3)), []
    for begin, end in spans(gnss.t, rng, 3, 3.0, 60.0):
        error = rng.standard_normal(3) * np.exp(rng.uniform(np.log(3.0), np.log(30.0)))
        inside = (gnss.t >= begin) & (gnss.t < end)
        ramp = (gnss.t[inside] - begin) / (end - begin) if rng.random() < 0.4 else np.ones(int(inside.sum()))
        by[inside] += ramp[:, None] * error
        said.append(f"{begin - gnss.t[0]:.0f}-{end - gnss.t[0]:.0f} s by {np.linalg.norm(error):.0f} m")
    return moved(gnss, by), "bursts " + ", ".join(said)


def canyons(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    """Errors that last for ten to thirty seconds, of which the sigmas know nothing."""
    by, said = np.zeros((len(gnss.t), 3)), []
    for begin, end in spans(gnss.t, rng, 3, 20.0, 90.0):
        inside = np.flatnonzero((gnss.t >= begin) & (gnss.t < end))
        tau, size = rng.uniform(10.0, 30.0), np.exp(rng.uniform(np.log(1.0), np.log(8.0)))
        error = size * rng.standard_normal(3)
        for k in inside:
            a = np.exp(-(gnss.t[k] - gnss.t[max(k - 1, 0)]) / tau)
            error = a * error + size * np.sqrt(1.0 - a * a) * rng.standard_normal(3)
            by[k] = error
        said.append(f"{begin - gnss.t[0]:.0f}-{end - gnss.t[0]:.0f} s of {size:.1f} m")
    return moved(gnss, by), "canyons " + ", ".join(said)


def outages(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    keep, some = np.ones(len(gnss.t), dtype=bool), spans(gnss.t, rng, 2, 15.0, 60.0)
    for begin, end in some:
        keep &= (gnss.t < begin) | (gnss.t > end)
    return kept(gnss, keep), "none " + ", ".join(f"{a - gnss.t[0]:.0f}-{b - gnss.t[0]:.0f} s" for a, b in some)


def late_stamps(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    late, jitter = rng.uniform(-0.1, 0.3), rng.choice([0.0, 0.2, 0.5])
    t = np.sort(gnss.t + late + rng.uniform(0.0, 1.0, len(gnss.t)) * jitter)
    return replace(gnss, t=t + np.arange(len(t)) * 1e-7), f"stamps late by {late:.2f} s and up to {jitter} more"


def step(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    """All fixes from one on are off alike, as where the base station changes."""
    begin = gnss.t[0] + rng.uniform(0.1, 0.9) * (gnss.t[-1] - gnss.t[0])
    size, error = float(np.exp(rng.uniform(np.log(0.5), np.log(20.0)))), rng.standard_normal(3)
    by = np.outer(gnss.t >= begin, size * error / np.linalg.norm(error))
    return moved(gnss, by), f"{size:.1f} m off from {begin - gnss.t[0]:.0f} s on"


def wrong_arm(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    by = rng.uniform(-0.8, 0.8, 3)
    return replace(gnss, lever_arm=gnss.lever_arm + by), f"lever arm off by {np.linalg.norm(by):.1f} m"


def worse_noise(imu: Imu, rng: Rng) -> tuple[Imu, str]:
    by, root = rng.uniform(2.0, 10.0), np.sqrt(1.0 / imu.period)
    gyro = imu.gyro + by * imu.noise.gyro_noise_density * root * rng.standard_normal(imu.gyro.shape)
    accel = imu.accel + by * imu.noise.accel_noise_density * root * rng.standard_normal(imu.accel.shape)
    return replace(imu, gyro=gyro, accel=accel), f"IMU noise x {by:.1f}"


def own_errors(imu: Imu, rng: Rng) -> tuple[Imu, str]:
    """Scale errors and misalignments of a consumer IMU."""
    of_gyro, of_accel = (np.eye(3) + 0.01 * rng.standard_normal((3, 3)) for _ in range(2))
    return replace(imu, gyro=imu.gyro @ of_gyro.T, accel=imu.accel @ of_accel.T), "IMU scale and axes 1 %"


def dead_zone(odometer: Odometer, rng: Rng) -> tuple[Odometer, str]:
    below = rng.uniform(0.5, 2.0)
    speed = np.where(np.abs(odometer.speed) < below, 0.0, odometer.speed)
    return replace(odometer, speed=speed, wheels=None, counted=None), f"wheels stand below {below:.1f} m/s"


def lag(odometer: Odometer, rng: Rng) -> tuple[Odometer, str]:
    late = rng.uniform(0.1, 0.6)
    return replace(odometer, t=odometer.t + late), f"wheels late by {late:.2f} s"


def slip(odometer: Odometer, rng: Rng) -> tuple[Odometer, str]:
    speed, some = odometer.speed.copy(), spans(odometer.t, rng, 3, 1.0, 15.0)
    for begin, end in some:
        speed[(odometer.t >= begin) & (odometer.t < end)] *= rng.uniform(0.5, 1.4)
    return replace(odometer, speed=speed, wheels=None, counted=None), f"wheels slip {len(some)} times"


def wrong_scale(odometer: Odometer, rng: Rng) -> tuple[Odometer, str]:
    by = 1.0 + rng.uniform(-0.06, 0.06)
    return replace(odometer, speed=by * odometer.speed, wheels=None, counted=None), f"wheels x {by:.3f}"


FAULTS = (
    Fault("gnss", 0.5, wrong_sigmas),
    Fault("gnss", 0.3, outliers),
    Fault("gnss", 0.4, bursts),
    Fault("gnss", 0.3, canyons),
    Fault("gnss", 0.2, wrong_arm),
    Fault("gnss", 0.25, late_stamps),
    Fault("gnss", 0.3, outages),
    Fault("imu", 0.25, worse_noise),
    Fault("imu", 0.25, own_errors),
    Fault("odometer", 0.3, dead_zone),
    Fault("odometer", 0.3, lag),
    Fault("odometer", 0.3, slip),
    Fault("odometer", 0.3, wrong_scale),
)


def rare(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    period = float(rng.choice([3.0, 5.0, 10.0]))
    turn = np.floor((gnss.t - gnss.t[0]) / period)
    return kept(gnss, np.flatnonzero(np.diff(turn, prepend=-1.0) > 0.0)), f"a fix every {period:.0f} s"


def interpolated(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    """Rows at a multiple of the receiver's own rate, on the lines between its fixes."""
    more, frame = int(rng.choice([4, 10])), LocalFrame(gnss.llh[0])
    t = np.interp(np.arange((len(gnss.t) - 1) * more + 1) / more, np.arange(len(gnss.t)), gnss.t)
    there = np.clip(np.searchsorted(gnss.t, t), 0, len(gnss.t) - 1)

    def line(x: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, gnss.t, column) for column in x.T], axis=-1)

    llh = frame.to_llh(line(frame.from_llh(gnss.llh)))
    out = replace(kept(gnss, there), t=t, llh=llh, rounding=(0.0, 0.0, 0.0))
    return out if gnss.v is None else replace(out, v=line(gnss.v)), f"rows interpolated, {more} a fix"


def rounded(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    digits = int(rng.choice([5, 6]))
    llh = np.column_stack([np.radians(np.round(np.degrees(gnss.llh[:, :2]), digits)), np.round(gnss.llh[:, 2], 0)])
    return replace(
        gnss, llh=llh, rounding=measure_rounding(llh)
    ), f"{digits} decimals of a degree, whole metres of height"


def low_pass(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    """A receiver that smooths its positions: they lag, most where the vehicle turns."""
    tau, frame = rng.uniform(0.3, 2.0), LocalFrame(gnss.llh[0])
    p = frame.from_llh(gnss.llh)
    for k in range(1, len(p)):
        a = np.exp(-(gnss.t[k] - gnss.t[k - 1]) / tau)
        p[k] = a * p[k - 1] + (1.0 - a) * p[k]
    return replace(gnss, llh=frame.to_llh(p), rounding=(0.0, 0.0, 0.0)), f"positions smoothed over {tau:.1f} s"


def static_hold(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    """Positions and velocities are held below a speed, as receivers do that expect to stand."""
    below, p = rng.uniform(0.3, 1.5), LocalFrame(gnss.llh[0]).from_llh(gnss.llh)
    speed = np.linalg.norm(np.gradient(p[:, :2], gnss.t, axis=0), axis=1)
    held = np.arange(len(p))
    for k in range(1, len(p)):
        held[k] = held[k - 1] if speed[k] < below else k
    v = None if gnss.v is None else np.where((speed < below)[:, None], 0.0, gnss.v)
    return replace(gnss, llh=gnss.llh[held], v=v), f"fixes held below {below:.1f} m/s"


def one_sigma(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    sd = float(rng.choice([0.5, 1.0, 3.0, 5.0]))
    sd_v = None if gnss.sd_v is None else np.full_like(gnss.sd_v, 0.1 * sd)
    return replace(gnss, sd=np.full_like(gnss.sd, sd), sd_v=sd_v), f"all sigmas {sd:.1f} m"


def drifting_clock(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    """A logger stamps fixes by another crystal than the IMU's."""
    rate = float(np.exp(rng.uniform(np.log(2e-5), np.log(1e-3))) * rng.choice([-1.0, 1.0]))
    return replace(gnss, t=gnss.t + rate * (gnss.t - gnss.t[0])), f"clocks drift apart by {1e6 * rate:.0f} ppm"


def level_velocity(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    if gnss.v is None:
        return gnss, "no velocity"
    return replace(gnss, v=gnss.v * [1.0, 1.0, 0.0]), "vertical velocity 0"


def slow_imu(imu: Imu, rng: Rng) -> tuple[Imu, str]:
    """Every n-th sample, not the mean of them, as loggers do."""
    step = max(1, round(0.04 / imu.period))
    return replace(imu, t=imu.t[::step], gyro=imu.gyro[::step], accel=imu.accel[::step]), f"one IMU row in {step}"


def coarse_imu(imu: Imu, rng: Rng) -> tuple[Imu, str]:
    gyro, accel = np.radians(rng.uniform(0.02, 0.1)), rng.uniform(0.01, 0.05)
    rows = replace(imu, gyro=np.round(imu.gyro / gyro) * gyro, accel=np.round(imu.accel / accel) * accel)
    return rows, f"IMU in steps of {np.degrees(gyro):.2f} deg/s and {accel:.2f} m/s^2"


def lost_samples(imu: Imu, rng: Rng) -> tuple[Imu, str]:
    keep, some = np.ones(len(imu.t), dtype=bool), spans(imu.t, rng, 5, 0.05, 1.0)
    for begin, end in some:
        keep &= (imu.t < begin) | (imu.t > end)
    return replace(imu, t=imu.t[keep], gyro=imu.gyro[keep], accel=imu.accel[keep]), f"{len(some)} gaps of IMU rows"


def jitter(imu: Imu, rng: Rng) -> tuple[Imu, str]:
    """Stamps on arrival at a computer."""
    size = rng.uniform(0.1, 0.4) * imu.period
    return replace(
        imu, t=np.sort(imu.t + rng.uniform(0.0, size, len(imu.t)))
    ), f"IMU stamps jitter by {1e3 * size:.1f} ms"


def ticks(odometer: Odometer, rng: Rng) -> tuple[Odometer, str]:
    step = rng.uniform(0.05, 0.3)
    speed = np.round(odometer.speed / step) * step
    return replace(odometer, speed=speed, wheels=None, counted=None), f"wheels in steps of {step:.2f} m/s"


HABITS = (
    Fault("gnss", 0.3, rare),
    Fault("gnss", 0.2, interpolated),
    Fault("gnss", 0.3, rounded),
    Fault("gnss", 0.2, low_pass),
    Fault("gnss", 0.3, static_hold),
    Fault("gnss", 0.4, one_sigma),
    Fault("gnss", 0.2, level_velocity),
    Fault("imu", 0.3, slow_imu),
    Fault("imu", 0.3, coarse_imu),
    Fault("imu", 0.2, lost_samples),
    Fault("imu", 0.2, jitter),
    Fault("odometer", 0.5, ticks),
    Fault("gnss", 0.3, drifting_clock),
)
FAMILIES = {"faults": FAULTS, "habits": HABITS, "steps": (Fault("gnss", 1.0, step),)}
