"""Noise figures of an IMU from a log at rest, by the Allan variance.

The overlapping estimate (IEEE Std 952-1997, annex C; Riley, *Handbook of Frequency Stability Analysis*, NIST SP 1065,
section 5.2.4) and the model of its annex C: angle random walk N, bias instability B and rate random walk K add up as

    sigma^2(tau) = N^2 / tau + B^2 (2 / pi) ln 2 + K^2 tau / 3

and are fitted together, none below zero, each point weighted by how well its variance is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array

PER_DECADE = 12  # averaging times
_FEWEST_PERIODS = 9  # periods of the longest averaging time that the log must contain
_SHORTEST_LOG = 60.0  # s, shortest log that is accepted
_INSTABILITY_FACTOR = 2.0 / np.pi * np.log(2.0)
_MEANS_OF = 1.0  # s, over which means are taken to detect motion
_MOVING_RATE, _MOVING_FORCE = (
    np.radians(1.0),
    0.1,
)  # rad/s, m/s^2: deviation from the median above which the log is not at rest


@dataclass(frozen=True)
class AllanFigures:
    """Figures of one sensor per axis (3,): of a gyro in rad/s/sqrt(Hz), rad/s, rad/s/sqrt(s); of an accelerometer with
    m/s^2.
    """

    white: Array  # N, angle or velocity random walk
    instability: Array  # B
    walk: Array  # K, 0 where the log is too short to show it
    floor: Array  # s, averaging time at the lowest deviation


@dataclass(frozen=True)
class Allan:
    """Allan deviations of the six axes, and the figures fitted to them."""

    tau: Array  # (M,) s
    gyro: Array  # (M, 3) rad/s
    accel: Array  # (M, 3) m/s^2
    gyro_noise: AllanFigures
    accel_noise: AllanFigures
    duration: float  # s
    rate: float  # Hz

    def format_lines(self) -> list[str]:
        """The lines for [imu.noise]: root mean squares over the axes."""
        out = []
        for name, noise, unit in (("gyro", self.gyro_noise, "rad/s"), ("accel", self.accel_noise, "m/s2")):
            out.append(_format_line(f"{name}_noise_density", _compute_rms(noise.white), f"{unit}/sqrt(Hz)"))
            walk, why = _compute_rms(noise.walk), "rate random walk"
            if walk == 0.0:
                walk, why = (
                    _compute_rms(noise.instability / np.sqrt(noise.floor)),
                    "bias instability over the root of its time",
                )
            out.append(_format_line(f"{name}_bias_walk", walk, f"{unit}/sqrt(s): {why}"))
        return out


def compute_allan(t: Array, gyro: Array, accel: Array) -> Allan:
    """Allan deviations and figures of a log at rest: t (N,) s, gyro (N, 3) rad/s, accel (N, 3) m/s^2.

    Raises
    ------
    RecordingError
        If the log moves, has gaps, or is too short.
    """
    period = float(np.median(np.diff(t)))
    gap = np.flatnonzero(np.diff(t) > 1.5 * period)
    if len(gap):
        raise RecordingError(
            f"{format_count(len(gap), 'gap')}, the first of {t[gap[0] + 1] - t[gap[0]]:.3f} s "
            f"at {t[gap[0]] - t[0]:.1f} s: an Allan variance needs a log without any; "
            "choose a part with --start and --end",
            key="allan.gaps",
        )
    duration = len(t) * period
    if duration < _SHORTEST_LOG:
        raise RecordingError(
            f"{duration:.0f} s are too short; an hour at rest is better, a minute the least", key="allan.short"
        )
    moving = find_motion(t, gyro, accel)
    if moving is not None:
        raise RecordingError(
            f"the log moves, first at {moving:.0f} s: an Allan variance is of an IMU at rest; choose a part with "
            "--start and --end",
            key="allan.moves",
        )
    m = list_averaging(len(t))
    tau = m * period
    devs = [compute_deviations(x, period, m) for x in (gyro, accel)]
    noises = [_fit_figures(tau, d, len(t)) for d in devs]
    return Allan(tau, devs[0], devs[1], noises[0], noises[1], duration, 1.0 / period)


def find_motion(t: Array, gyro: Array, accel: Array) -> float | None:
    """The first time (s from the start) at which a mean over a second deviates from the log's median; None at rest."""
    n = max(round(_MEANS_OF / float(np.median(np.diff(t)))), 1)
    for samples, limit in ((gyro, _MOVING_RATE), (accel, _MOVING_FORCE)):
        means = samples[: len(samples) // n * n].reshape(-1, n, 3).mean(1)
        far = np.flatnonzero((np.abs(means - np.median(means, axis=0)) > limit).any(-1))
        if len(far):
            return float(t[far[0] * n] - t[0])
    return None


def list_averaging(count: int) -> Array:
    """Numbers of samples to average over, even on a logarithmic scale, up to a ninth of the log."""
    most = max(count // _FEWEST_PERIODS, 1)
    steps = np.logspace(0.0, np.log10(most), max(int(PER_DECADE * np.log10(most)), 1) + 1)
    return np.unique(np.round(steps).astype(int))


def compute_deviations(x: Array, period: float, m: Array) -> Array:
    """Overlapping Allan deviations (M, k) of samples (N, k) at averaging times of `m` (M,) samples."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x - x.mean(0), axis=0)]) * period
    out = np.empty((len(m), x.shape[1]))
    for row, n in enumerate(m.tolist()):
        second = total[2 * n :] - 2.0 * total[n:-n] + total[: -2 * n]
        out[row] = np.sqrt(0.5 * np.mean(second**2, axis=0)) / (n * period)
    return out


def _fit_figures(tau: Array, deviation: Array, count: int) -> AllanFigures:
    """N, B and K of each axis."""
    from scipy.optimize import nnls

    # relative sigma of a variance from as many independent differences as the log contains
    weight = np.sqrt(np.maximum(count * tau[0] / tau / 2.0 - 1.0, 0.5))
    terms = np.stack([1.0 / tau, np.full(len(tau), _INSTABILITY_FACTOR), tau / 3.0], -1)
    out = []
    for variance in (deviation**2).T:
        scaled = terms * (weight / variance)[:, None]
        size = np.linalg.norm(scaled, axis=0)
        found, _ = nnls(scaled / size, weight)
        out.append(np.sqrt(found / size))
    white, instability, walk = np.array(out).T
    return AllanFigures(white, instability, walk, tau[np.argmin(deviation, axis=0)])


def _compute_rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def _format_line(key: str, value: float, unit: str) -> str:
    return f"{key} = {value:.3g}".ljust(36) + f"# {unit}"
