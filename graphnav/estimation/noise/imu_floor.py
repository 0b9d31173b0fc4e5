"""A shoe-mounted IMU's white noise no larger than the quietest stretch of a walk shows it (`recording.densities`).

Drives are excluded: with a running engine a vehicle vibrates differently than at rest. So are walks in progress, whose
longest rest may be yet to come.
"""

from __future__ import annotations

from dataclasses import replace

from graphnav.config import Settings
from graphnav.core.notes import Note
from graphnav.recording import ImuNoise, Recording
from graphnav.recording.densities import bound_density

_WORDS = {"gyro_noise_density": "gyro", "accel_noise_density": "accelerometer"}
_DENSITY_UNITS = {"gyro_noise_density": "rad/s/sqrt(Hz)", "accel_noise_density": "m/s^2/sqrt(Hz)"}


def apply_measured_floor(recording: Recording, settings: Settings) -> tuple[Recording, tuple[str, ...]]:
    """A walk with noise densities no larger than its quietest stretch shows, and a sentence on those lowered.

    Other recordings, and figures to be taken as stated, are as they were.
    """
    imu = recording.imu
    if recording.platform != "foot" or settings.noise.mode == "stated":
        return recording, ()
    shown = {
        "gyro_noise_density": bound_density(imu.t, imu.gyro),
        "accel_noise_density": bound_density(imu.t, imu.accel),
    }
    lower = {name: density for name, density in shown.items() if density < getattr(imu.noise, name)}
    if not lower:
        return recording, ()
    figures = ", ".join(
        f"{_WORDS[name]} {density:.2g} instead of {getattr(imu.noise, name):.2g} {_DENSITY_UNITS[name]}"
        for name, density in lower.items()
    )
    noise: ImuNoise = replace(imu.noise, **lower)
    return replace(recording, imu=replace(imu, noise=noise)), (
        Note("noise.imu.quieter", f"at rest the IMU is quieter than stated: {figures}"),
    )
