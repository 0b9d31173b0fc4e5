"""Gyros whose unit corrects their offset at rest: detected from the rests, and undone.

Some units subtract an offset before they output a row, and learn it while they seem to rest. That of x-io (Fusion,
FusionOffset.c, MIT; common in small units) starts after 5 s below 3 deg/s on every axis and lets the offset follow the
output with a cut-off of 0.02 Hz,

    y = omega_raw - o,    do/dt = kappa y,    kappa = 2 pi 0.02 Hz

so at rest the rows decay with a time constant of 8 s, and the biases before and after differ by more than any data
sheet permits. As y is what was recorded, o is known except for a constant, and y + o has one bias.

Whether the unit did so is tested on the rests. In a rest, the integrated angle less the tilt shown by the force is a
straight line for a constant bias, and bends with the integral of o if the unit corrected it. The residual sums of
squares are compared as likelihoods of a regression: n ln of their ratio, for n independent values.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from graphnav.config import Settings
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.sample_size import compute_effective_size
from graphnav.recording import Imu, Recording

_AFTER = 5.0  # s of rest after which the correction starts
_RESTS = np.deg2rad(3.0)  # rad/s on every axis, below which the unit takes itself to be at rest
_KAPPA = 2.0 * np.pi * 0.02  # rad/s, kappa
_ANGLE_BLOCK = 0.25  # s over which angles are averaged
_SHORTEST_CORRECTION = 3.0  # s of correction in a rest, below which the bend is not significant
_ODDS = 100.0  # likelihood ratio above which the correction is undone


def remove_onboard_offset(recording: Recording, settings: Settings) -> tuple[Recording, tuple[str, ...]]:
    """A walk with the gyro rates before the unit's correction, and a note if there was one.

    Drives stay unchanged: on a straight road such a unit takes a slow turn for its offset, and must not be used.
    """
    if recording.platform != "foot" or not settings.imu.onboard_offset:
        return recording, ()
    imu = recording.imu
    offset = estimate_learnt_offset(imu)
    if compare_offsets(imu, offset) < 2.0 * np.log(_ODDS):
        return recording, ()
    most = 1e3 * float(np.abs(offset).max())
    note = Note(
        "imu.onboard_offset",
        f"the unit corrected its gyro's offset at rest, by up to {most:.1f} mrad/s: the correction is undone",
    )
    return replace(recording, imu=replace(imu, gyro=imu.gyro + offset)), (note,)


def estimate_learnt_offset(imu: Imu) -> Array:
    """(N, 3) rad/s, the offset that the unit subtracts beyond that at the start; a rest at the start is taken to have
    begun earlier.
    """
    active = np.zeros(len(imu.t), dtype=bool)
    for begin, end in _find_rests(imu):
        active[begin:end] = (begin == 0) | (imu.t[begin:end] > imu.t[begin] + _AFTER)
    return np.asarray(np.cumsum(imu.gyro * (_KAPPA * active * _find_periods(imu))[:, None], axis=0))


def compare_offsets(imu: Imu, offset: Array) -> float:
    """Twice the log likelihood ratio of the rows with `offset` (N, 3) subtracted by the unit against without."""
    T = _find_periods(imu)[:, None]
    angle, bent = np.cumsum(imu.gyro * T, axis=0), np.cumsum(offset * T, axis=0)
    total = 0.0
    for begin, end in _find_rests(imu):
        if np.count_nonzero(np.diff(offset[begin:end, 0])) * float(np.median(T)) < _SHORTEST_CORRECTION:
            continue
        first = np.flatnonzero(np.diff(((imu.t[begin:end] - imu.t[begin]) / _ANGLE_BLOCK).astype(int), prepend=-1))
        count = np.diff(np.append(first, end - begin))[:, None]
        t, force, phi, theta = (
            np.add.reduceat(x[begin:end], first, axis=0) / count for x in (imu.t[:, None], imu.accel, angle, bent)
        )
        mean = force.mean(axis=0)
        phi = phi + np.cross(mean, force - mean) / (mean @ mean)  # minus the tilt
        line = np.concatenate([np.ones_like(t), t - t.mean()], axis=1)
        straight, corrected = (x - line @ np.linalg.lstsq(line, x, rcond=None)[0] for x in (phi, phi + theta))
        # in the axes of the walk, not of the unit: force carries no information about the vertical, whose noise differs
        axes = np.linalg.svd(mean[None])[2].T
        for a, b in zip((straight @ axes).T, (corrected @ axes).T, strict=True):
            n = min(compute_effective_size(a[:, None]), compute_effective_size(b[:, None]))
            total += n * float(np.log((a @ a) / (b @ b)))
    return total


def _find_rests(imu: Imu) -> Iterator[tuple[int, int]]:
    """First row and the row after the last of each rest that is long enough for the unit's correction."""
    still = (np.abs(imu.gyro) < _RESTS).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    for begin, end in edges.reshape(-1, 2):
        if begin == 0 or imu.t[end - 1] - imu.t[begin] > _AFTER:
            yield int(begin), int(end)


def _find_periods(imu: Imu) -> Array:
    return np.diff(imu.t, prepend=imu.t[0])
