"""IMU stamps that scatter about a regular clock: found by the signals, and replaced by the clock's times.

Many units sample regularly, but their rows are stamped when a program has read them. The stamps are then the sampling
times plus a delay of its own for each row, and an integral over a stride or a bend gets the wrong durations. Other
units sample when a program asks them: their sampling times scatter themselves, and the stamps are right. Stamps alone
cannot tell which; the signals can. At the right times they are smoother: a row is predicted better by the cubic
through its two neighbours on either side. Stamps are replaced where their scatter adds more to the integrals than the
sensors' own noise.

The clock is a straight line through the stamps near each row, as crystals and timers wander. Its length is the one of
several that best predicts a stamp from others, not too near: rows that wait for one another are late together.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from graphnav.config import Settings
from graphnav.core.findings import compute_period, find_gap_limit
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.sample_size import compute_effective_size
from graphnav.recording import Imu, Recording

_LEAST_SCATTER = 1e-3  # of a period, which adds nothing: most stamps need no closer look
_LENGTHS = (0.3, 1.0, 3.0, 10.0)  # s, of the line
_MEMORY = 0.1  # s: rows that wait for one another are late together
_OUTLYING = 8.0  # median absolute deviations of a step beyond which rows are lost
_BESIDE = 20  # rows on either side of a long step, whose medians tell whether rows are lost in it
_SIGNIFICANT = 3.0  # 1-sigma of the mean gain
_NEIGHBOURS = np.array([-2, -1, 1, 2])


def use_regular_stamps(recording: Recording, settings: Settings) -> tuple[Recording, tuple[str, ...]]:
    """The recording with the times of a regular clock where the IMU's signals show that it has one, and a note then."""
    imu = recording.imu
    regular = find_regular_times(imu.t) if settings.imu.regular_stamps else None
    if regular is None or not _exceeds_noise(imu, regular):
        return recording, ()
    significance = compare_times(imu, regular)
    if significance < _SIGNIFICANT:
        return recording, ()
    scatter = float(np.std(imu.t - regular))
    note = Note(
        "imu.regular_stamps",
        f"IMU stamps scatter by {1e3 * scatter:.2g} ms about a regular clock, at whose times the signals are smoother "
        f"({significance:.0f} sigma): these are used",
    )
    return replace(recording, imu=replace(imu, t=regular)), (note,)


def find_regular_times(t: Array) -> Array | None:
    """Times (N,) of a clock without the scatter of stamps (N,), s; None where they hardly scatter, or are too few."""
    if len(t) <= _BESIDE:
        return None
    step, period = np.diff(t), float(np.median(t[_BESIDE:] - t[:-_BESIDE])) / _BESIDE
    spread = float(np.median(np.abs(step - period)))
    if spread < _LEAST_SCATTER * period:
        return None
    long = np.flatnonzero(step > max(find_gap_limit(t), period + _OUTLYING * spread))
    cuts = [k + 1 for k in long.tolist() if _are_lost(t, k, period)]
    pieces = [slice(a, b) for a, b in itertools.pairwise([0, *cuts, len(t)])]
    period = float(np.delete(step, np.array(cuts, dtype=int) - 1).mean())
    best = min((_fit_clock(t, pieces, length, period) for length in _LENGTHS), key=lambda one: one[1])[0]
    return best if np.all(np.diff(best) > 0.0) else None


def _exceeds_noise(imu: Imu, regular: Array) -> bool:
    """Whether the scatter of stamps adds more to an integral than the white noise of a sensor does.

    An integral changes by a row's scatter times the difference of this row and the next.
    """
    scatter, period = float(np.var(imu.t - regular)), compute_period(regular)
    densities = imu.noise.gyro_noise_density, imu.noise.accel_noise_density
    return any(
        scatter * float(np.mean(np.diff(rows, axis=0) ** 2)) > density**2 * period
        for rows, density in zip((imu.gyro, imu.accel), densities, strict=True)
    )


def _are_lost(t: Array, k: int, period: float) -> bool:
    """Whether rows are lost after row k: those behind are late as well, and not it alone."""
    before, behind = t[max(k + 1 - _BESIDE, 0) : k + 1], t[k + 1 : k + 1 + _BESIDE]
    late = np.median(behind - period * np.arange(1, len(behind) + 1))
    return bool(late - np.median(before - period * np.arange(1 - len(before), 1)) > 0.5 * period)


def _fit_clock(t: Array, pieces: list[slice], length: float, period: float) -> tuple[Array, float]:
    """Times on lines of so many seconds (s), and the sum of squares by which they predict stamps from those farther
    than `_MEMORY`.
    """
    from scipy.signal import savgol_filter  # few recordings need it, and the import takes long

    out, left, fits = t.copy(), 0.0, False
    for piece in pieces:
        n = piece.stop - piece.start
        long, short = (min(round(T / period) // 2, (n - 1) // 2) * 2 + 1 for T in (length, _MEMORY))
        if long <= max(short, len(_NEIGHBOURS)):
            continue
        beside = t[piece] - period * np.arange(n)
        fitted, near = (savgol_filter(beside, w, 1) if w > 1 else beside for w in (long, short))
        out[piece] += fitted - beside
        fits = True
        left += float(np.sum((beside - (long * fitted - short * near) / (long - short)) ** 2))
    return out, left if fits else np.inf


def compare_times(imu: Imu, regular: Array) -> float:
    """How many sigma the rows are smoother at regular times (N,) than at their stamps.

    The squares of residuals of both have Cauchy's logarithm, so that impacts do not decide.
    """
    rows = np.hstack([imu.gyro, imu.accel])
    inside = np.arange(2, len(imu.t) - 2)
    near = np.abs(np.diff(imu.t) - compute_period(imu.t)) < find_gap_limit(imu.t)
    inside = inside[near[inside - 2] & near[inside - 1] & near[inside] & near[inside + 1]]
    if len(inside) < 2:
        return 0.0
    stamped, clocked = (_predict_rows(t, rows, inside) for t in (imu.t, regular))
    scale = np.median(np.abs(stamped), axis=0)
    moving = scale > 0.0  # an axis that reads the same tells nothing
    stamped, clocked = stamped[:, moving] / scale[moving], clocked[:, moving] / scale[moving]
    gain = np.sum(np.log1p(stamped**2) - np.log1p(clocked**2), axis=1)
    mean, spread = float(gain.mean()), float(gain.std())
    return mean / spread * float(np.sqrt(compute_effective_size(gain[:, None] - mean))) if spread > 0.0 else 0.0


def _predict_rows(t: Array, rows: Array, at: Array) -> Array:
    """(n, 6) errors of rows as their neighbours predict them at times t, over their sigma where noise is white."""
    away = t[at[:, None] + _NEIGHBOURS] - t[at, None]
    weight = np.ones(away.shape)
    for i in range(len(_NEIGHBOURS)):
        for j in range(len(_NEIGHBOURS)):
            if i != j:
                weight[:, i] *= away[:, j] / (away[:, j] - away[:, i])
    predicted = np.einsum("ni,nic->nc", weight, rows[at[:, None] + _NEIGHBOURS])
    error: Array = (rows[at] - predicted) / np.sqrt(1.0 + np.sum(weight**2, axis=1))[:, None]
    return error
