"""A noise model in words and numbers that people read."""

from __future__ import annotations

import numpy as np

from graphnav.constraints.gnss import STAMP_ERROR, GnssPosition
from graphnav.constraints.vehicle import MOUNTING
from graphnav.core.notes import Note, format_count
from graphnav.estimation.names import name_components, name_rows
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, RowWeights
from graphnav.estimation.noise.tails import relate_to_gaussian
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.linearise import Points, shift
from graphnav.imu.dynamics import make_scale_parameter
from graphnav.recording.checks.axes import write_letters

_NAMES = {
    "imu.gyro_noise_density": "gyro noise",
    "imu.accel_noise_density": "accelerometer noise",
    "imu.gyro_bias_walk": "gyro bias walk",
    "imu.accel_bias_walk": "accelerometer bias walk",
    "prior.gyro_scale": "gyro scale errors",
    "prior.accel_scale": "accelerometer scale errors",
}

_IMU_WHITE = dict(zip(INTERVALS, ("gyro noise", "accelerometer noise"), strict=True))
_FAR = 5.0  # prior sigmas, beyond chance
_ALONG = 0.75  # share of the squared speed along the axes of a vehicle with wheels: 30 deg of side slip, in the mean


def describe_far(problem: Problem, smoothed: Points) -> tuple[str, ...]:
    """Sentences on parameters whose estimates are implausibly far from their stated values."""
    out = []
    of_imu = make_scale_parameter(problem.recording.imu.noise, problem.recording.platform)
    scales = {p.name: p.sigma for p in of_imu}  # as stated, whatever the noise model makes of it
    for chain in problem.chains:
        p = chain.parameter
        if p.correlation_time is not None:  # an error, whose size is estimated
            continue
        value = smoothed.values[0, shift(problem.columns[p.name])]  # where the prior is of one that walks as well
        stated, sigma = chain.mean[0], scales.get(p.name, chain.sigma[0])
        away = np.abs(value - stated) / sigma
        k = int(np.argmax(away))
        if p.name == MOUNTING and (turned := describe_turned_axes(problem, smoothed)) is not None:
            out.append(Note("doubt.axes", f"The attitude cannot be trusted: {turned}"))
        elif away[k] > _FAR:
            shown = name_components(p.name, p.size, p.unit)[k]
            found, given, sd = (float(f"{shown.scale * x:.2g}") for x in (value[k], stated[k], sigma[k]))
            out.append(
                Note(
                    "noise.far_from_stated",
                    f"{shown.words}: estimated {found:g} {shown.unit}, stated {given:g} +- {sd:g}, "
                    f"{away[k]:.0f} sigmas apart: the stated value is wrong, or another error is absorbed by it",
                )
            )
    return tuple(out)


def describe_turned_axes(problem: Problem, smoothed: Points) -> str | None:
    """A sentence on axes of the IMU by which the vehicle would not travel forwards; None where the mounting is near."""
    chain = next((chain for chain in problem.chains if chain.parameter.name == MOUNTING), None)
    if chain is None:
        return None
    value = smoothed.values[0, shift(problem.columns[MOUNTING])]
    away = np.abs(value - chain.mean[0]) / chain.sigma[0]
    k = int(np.argmax(away))
    if away[k] <= _FAR or abs(value[k]) <= 0.25 * np.pi:
        return None
    (a, b), states = value, smoothed.states
    up = np.array([0.0, np.sin(a), np.cos(a)])
    ahead = np.array([-np.sin(b), np.cos(b) * np.cos(a), -np.cos(b) * np.sin(a)])
    forward = np.einsum("i,kji,kj->k", ahead, states.R_nb, states.v)
    if np.sum(forward**2) < _ALONG * np.sum(states.v**2):  # nothing with wheels: a boat that drifts
        return None
    if np.sum(forward) < 0.0:  # which no sideways velocity tells
        ahead = -ahead
    letters = write_letters(problem.recording.imu.R_bs, ahead, up)
    hint = f' (axes = "{letters}" would agree)' if letters else ""
    off = np.degrees(np.arccos(np.clip(ahead[1], -1.0, 1.0)))
    return f"the IMU's axes are {off:.0f} deg from those of a vehicle that travels forwards; check axes in [imu]{hint}"


def describe_noise(noise: NoiseModel, problem: Problem) -> tuple[str, ...]:
    """Sentences on the figures used, beside those stated; none where all is as stated."""
    out = []
    imu = [
        f"{words} {np.sqrt(noise.figures[name].factor):.2g}" for name, words in _NAMES.items() if name in noise.figures
    ]
    if imu:
        out.append(Note("noise.imu", f"noise model, IMU: stated figures multiplied by: {', '.join(imu)}"))
    of_imu = [(name, noise.weights[name]) for name in INTERVALS if name in noise.weights]
    more = [f"{_IMU_WHITE[name]} in {len(some.t)}" for name, some in of_imu if len(some.t)]
    if more:
        most = np.sqrt(1.0 / min(float(np.min(some.weight)) for _, some in of_imu if len(some.t)))
        sentence = f"larger {' and '.join(more)} of {len(problem.t) - 1} intervals between keyframes"
        out.append(Note("noise.imu.outliers", f"noise model, IMU: {sentence}, up to {most:.2g} times the usual"))
    for rows in problem.constraints:
        names = [g for g in rows.list_noise_groups()[0] if g in noise.figures]
        errors = [
            p for p in rows.parameters if p.noise_groups and p.correlation_time is not None and p.name != STAMP_ERROR
        ]
        if not names:
            continue
        parts = [f"{g.removeprefix(rows.name + '.')} {np.sqrt(noise.figures[g].factor):.2g}" for g in names]
        for p in errors:
            sizes = dict.fromkeys(p.noise_groups)
            each = ", ".join(f"{g.rsplit('.', 1)[-1]} {np.sqrt(noise.get_factor(g, 0.0)):.2g}" for g in sizes)
            out_time = f"{float(f'{p.correlation_time:.2g}'):g} s"
            parts.append(f"Gauss-Markov with {out_time}: {each}")
        stamps = next((p for p in rows.parameters if p.name == STAMP_ERROR), None)
        if stamps is not None and rows.name == GnssPosition.name:
            parts.append(f"stamp of each fix {stamps.sigma[0]:.2g} s")
        if rows.name in noise.tails:
            parts.append(f"tail index {noise.tails[rows.name]:.2g}")
        out.append(
            Note("noise.rows", f"noise model, {name_rows(rows.name)}: white part in stated sigmas: {'; '.join(parts)}")
        )
        some = noise.weights.get(rows.name)
        less = 0 if some is None else _count_outliers(some, len(rows.axes), noise.tails.get(rows.name))
        if less:
            out.append(
                Note(
                    "noise.outliers",
                    f"{name_rows(rows.name)}: {format_count(less, 'outlier')} among {len(rows)} rows, down-weighted",
                )
            )
    return tuple(out)


def _count_outliers(some: RowWeights, m: int, index: float | None) -> int:
    return int(np.count_nonzero(relate_to_gaussian(some.weight, m, index) < 1.0))
