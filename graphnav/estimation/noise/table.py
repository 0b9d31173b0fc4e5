"""A noise model as a table: every variance component with what is stated, what is used, and how well it is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.constraints.dual_antenna import DualHeading, DualPitch
from graphnav.constraints.gnss import CLOCK_RATE, OFFSETS, STAMPS, VELOCITY_ERROR
from graphnav.constraints.lasting import LASTING, MULTIPATH, TIMES
from graphnav.constraints.odometer import ODOMETER_ERROR
from graphnav.constraints.vehicle import NHC_ERROR
from graphnav.core.state import SECONDS
from graphnav.estimation.names import name_rows
from graphnav.estimation.noise.model import NoiseModel, VarianceComponent
from graphnav.gnss.sigmas import REFLECTED
from graphnav.imu.dynamics import PRIORS
from graphnav.recording import FIX_TYPES, ImuNoise, Recording

_IMU_FIGURES = {
    "gyro_noise_density": ("gyro, noise density", "rad/s/sqrt(Hz)"),
    "accel_noise_density": ("accelerometer, noise density", "m/s^2/sqrt(Hz)"),
    "gyro_bias_walk": ("gyro, bias random walk", "rad/s/sqrt(s)"),
    "accel_bias_walk": ("accelerometer, bias random walk", "m/s^2/sqrt(s)"),
    "gyro_scale_sigma": ("gyro, scale errors", "1"),
    "accel_scale_sigma": ("accelerometer, scale errors", "1"),
}
_AXIS_SLICES = {"horizontal": slice(0, 2), "up": slice(2, 3)}


@dataclass(frozen=True)
class FigureRow:
    """A variance component beside what is stated."""

    group: str
    words: str  # description
    figure: VarianceComponent
    stated: float | None  # where it is one number: of an IMU, or the median sigma that fixes state
    used: float | None
    unit: str
    correlation_time: float | None  # s, of a Gauss-Markov process; None for white noise


def tabulate_figures(
    noise: NoiseModel, recording: Recording, slow_times: tuple[float, float], imu: ImuNoise | None = None
) -> tuple[FigureRow, ...]:
    """All figures of a noise model.

    Parameters
    ----------
    recording : as it was solved, with what it states.
    slow_times : s, correlation times of a fix's errors of minutes and of hours, of the settings.
    imu : what the factors of the IMU are relative to; what the recording states when None.
    """
    lasts = dict(zip(LASTING, (SECONDS, *slow_times, REFLECTED), strict=True))
    out = []
    for group, figure in noise.figures.items():
        source, *middle, axis = group.split(".")
        root = float(np.exp(0.5 * figure.log_factor))
        if source == "imu" or group in PRIORS:
            axis = PRIORS.get(group, axis)
            words, unit = _IMU_FIGURES[axis]
            stated = float(getattr(recording.imu.noise, axis))
            used = root * float(getattr(imu or recording.imu.noise, axis))
            out.append(FigureRow(group, words, figure, stated, used, unit, None))
            continue
        if group == STAMPS or group in OFFSETS:
            words = "fixes, stamp of each" if group == STAMPS else f"{OFFSETS[group]}, prior".replace("_", " ")
            unit = "s/s" if OFFSETS.get(group) == CLOCK_RATE else "s"
            out.append(FigureRow(group, words, figure, None, None, unit, None))
            continue
        time = next((part for part in middle if part in lasts), None)
        kind = next((part for part in middle if part not in lasts), None)
        # errors over minutes and hours have one unit, whatever the fix type
        sigma = _read_sigma(recording, source, None if time in LASTING[1:] else kind, axis)
        words = f"{name_rows(source)}{f' ({kind})' if kind else ''}, {axis}"
        words += ", white" if time is None else f", {MULTIPATH}" if time == MULTIPATH else f", lasting {time}"
        out.append(
            FigureRow(
                group,
                words,
                figure,
                sigma,
                None if sigma is None else root * sigma,
                {"gnss_position": "m", "gnss_velocity": "m/s"}.get(source, ""),
                None if time is None else noise.times.get(_find_process(source, time, kind), lasts[time]),
            )
        )
    return tuple(out)


def compute_whole_ratio(noise: NoiseModel, source: str, axis: str) -> float | None:
    """Sigma of the total error, white and time-correlated, over the stated one; None where unknown.

    Parameters
    ----------
    source : name of the constraint, with the type of the fixes where there are several.
    """
    times = [f"{source}.{axis}", *(f"{source}.{time}.{axis}" for time in TIMES)]
    known = [noise.figures[name].factor for name in times if name in noise.figures]
    return float(np.sqrt(sum(known))) if known else None


def _find_process(source: str, time: str, kind: str | None) -> str:
    """The parameter of a process."""
    if source == "gnss_position":
        return f"gnss_error_of_{time}{f'_{kind}' if kind else ''}"
    known = {"gnss_velocity": VELOCITY_ERROR, "nhc": NHC_ERROR, "odometer": ODOMETER_ERROR}
    known |= {kind.name: kind.name_lasting() for kind in (DualHeading, DualPitch)}
    return known.get(source, source)


def _read_sigma(recording: Recording, source: str, kind: str | None, axis: str) -> float | None:
    """Median of what fixes state."""
    gnss = recording.gnss
    if gnss is None or axis not in _AXIS_SLICES:
        return None
    sd = {"gnss_position": gnss.sd, "gnss_velocity": gnss.sd_v}.get(source)
    if sd is None:
        return None
    own = np.ones(len(gnss.t), dtype=bool)
    if kind is not None and gnss.type is not None:
        own = np.array([FIX_TYPES[int(k)] == kind for k in gnss.type], dtype=bool)
    some = sd[own][:, _AXIS_SLICES[axis]]
    some = some[np.isfinite(some)]
    return float(np.median(some)) if some.size else None
