"""Impossible odometer readings: beyond any speed, after a jump of the clock, or with another scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from graphnav.core.findings import Finding, compute_period, find_runs
from graphnav.core.notes import format_count
from graphnav.core.running import run_median
from graphnav.recording import Odometer, Recording, take_rows
from graphnav.recording.checks.crosschecks import MIN_PAIRS
from graphnav.recording.checks.tracks import Track
from graphnav.recording.plausibility.fixes import FASTEST

_CLOCK_STEP = 1.0  # s, and ten periods: a silence of the odometer that may be a jump of its clock
_RADIUS_SPREAD = 0.1  # relative difference of tyre radii: wear, load, pressure, a spare wheel
_LEAST_SPEED = 5.0  # m/s, above which speeds are compared
_SHORTEST_SPAN = 10.0  # s; shorter ones are slip, or an error of a fix
_CLEAR_RATIO = 4.0  # ratio of the misfits of two clocks (white errors: one in thousands with 20 of them a side)
_SPEED_RATE = 10.0  # Hz needed for changes of speed


def screen_odometer(recording: Recording, track: Track | None) -> tuple[Recording, list[Finding]]:
    """The recording without impossible readings, and findings; `track` is the velocity by GNSS."""
    findings: list[Finding] = []
    for one in (_find_beyond, _find_stuck, _find_clock_jump, _find_other_scale):
        odometer = recording.odometer
        if odometer is None or len(odometer.t) < 2:
            break
        bad, finding = one(odometer, track, recording.start)
        if finding is None:
            continue
        findings.append(finding)
        recording = replace(recording, odometer=None if bad.all() else take_rows(odometer, ~bad))
    return recording, findings


def build_odometer_track(odometer: Odometer) -> Track | None:
    """The odometer's speed in the form of a GNSS track, for recordings without GNSS."""
    every = max(1, round(1.0 / (_SPEED_RATE * compute_period(odometer.t)))) if len(odometer.t) > 1 else 1
    t, speed = odometer.t[::every], odometer.speed[::every]
    if len(t) < 5:
        return None
    v = np.stack([np.zeros_like(speed), speed, np.zeros_like(speed)], -1)
    return Track(t, v, np.zeros(len(t)), float(np.median(np.diff(t))))


_Found = tuple[NDArray[np.bool_], Finding | None]


def _find_beyond(odometer: Odometer, track: Track | None, start: float) -> _Found:
    """Readings that no vehicle reaches."""
    bad = ~(np.abs(odometer.speed) <= FASTEST)
    if not bad.any():
        return bad, None
    k = int(np.flatnonzero(bad)[0])
    many = format_count(bad.sum(), "odometer reading")
    return bad, Finding(
        "warning",
        f"{many} beyond any vehicle's speed (the first {odometer.speed[k]:.4g} m/s at {odometer.t[k] - start:.2f} s "
        f"from the start; nothing on land is faster than {FASTEST:g} m/s): not used",
        "odometer.beyond",
    )


def _find_stuck(odometer: Odometer, track: Track | None, start: float) -> _Found:
    """All readings, where they are the same and the fixes are not as steady."""
    same = bool((odometer.speed == odometer.speed[0]).all())
    bad = np.full(len(odometer.t), same)
    if not same or track is None or len(track.t) < MIN_PAIRS or np.ptp(track.speed) < _LEAST_SPEED:
        return np.zeros_like(bad), None
    return bad, Finding(
        "warning",
        f"the odometer reads {odometer.speed[0]:.4g} m/s throughout while the fixes speed up or slow down: it is stuck "
        "or was not logged; not used",
        "odometer.constant",
    )


def _measure_misfit(odometer: Odometer, track: Track, rows: NDArray[np.bool_], later: float) -> float:
    """Mean deviation of the GNSS speed from that of `rows` of the odometer `later` s later, m/s; NaN for too few."""
    t, speed = odometer.t[rows] + later, odometer.speed[rows]
    if len(t) < 2:
        return float("nan")
    both = (track.t > t[0]) & (track.t < t[-1])
    if both.sum() < MIN_PAIRS:
        return float("nan")
    off = track.speed[both] - np.abs(np.interp(track.t[both], t, speed))
    return float(np.mean(np.minimum(np.abs(off), _LEAST_SPEED)))  # an outlying fix counts no more than that


def _find_clock_jump(odometer: Odometer, track: Track | None, start: float) -> _Found:
    """A false silence: the readings after it fit the GNSS speed if it is removed, and do not if it is kept."""
    t = odometer.t
    none = np.zeros(len(t), dtype=bool)
    if track is None:
        return none, None
    period = compute_period(t)
    step = np.diff(t)
    for k in np.flatnonzero(step > max(_CLOCK_STEP, 10.0 * period))[:20]:
        jump = float(step[k] - period)
        for after in (True, False):
            side = (t > t[k]) if after else (t <= t[k])
            shift = -jump if after else jump
            as_read, moved = _measure_misfit(odometer, track, side, 0.0), _measure_misfit(odometer, track, side, shift)
            other = _measure_misfit(odometer, track, ~side, 0.0)
            if moved * _CLEAR_RATIO < as_read and (np.isnan(other) or other * _CLEAR_RATIO < as_read):
                leap = ", the leap seconds between GPS time and UTC" if abs(jump - 18.0) < 0.5 else ""
                return side, Finding(
                    "warning",
                    f"the odometer's clock jumps by {jump:+.2f} s at {t[k] - start:.1f} s from the start{leap}: its "
                    f"speed fits the GNSS speed on one side of that only; what comes {'after' if after else 'before'} "
                    "it is not used",
                    "odometer.clock_jump",
                )
    return none, None


def _find_other_scale(odometer: Odometer, track: Track | None, start: float) -> _Found:
    """Spans in which the odometer's scale against GNSS differs from that elsewhere, where it is nearly 1."""
    t = odometer.t
    bad = np.zeros(len(t), dtype=bool)
    if track is None:
        return bad, None
    half = np.maximum(0.5 * track.width, compute_period(t))
    meant = np.r_[0.0, np.cumsum(0.5 * (odometer.speed[1:] + odometer.speed[:-1]) * np.diff(t))]
    read = np.abs(np.interp(track.t + half, t, meant) - np.interp(track.t - half, t, meant)) / (2.0 * half)
    k = np.clip(np.searchsorted(t, track.t), 1, len(t) - 1)
    there = (track.t - half > t[0]) & (track.t + half < t[-1]) & (t[k] - t[k - 1] < _CLOCK_STEP)
    at = np.flatnonzero(there & (track.speed > _LEAST_SPEED) & (read > 0.0))
    if len(at) < MIN_PAIRS:
        return bad, None
    off = np.log(read[at] / track.speed[at])
    seconds = max(1, round(_SHORTEST_SPAN / track.period))
    typical = run_median(off, min(seconds + 1 - seconds % 2, len(off)))
    right = np.abs(typical) < np.log1p(_RADIUS_SPREAD)
    if right.sum() * track.period < _SHORTEST_SPAN:
        return bad, None  # another unit, or another wheel, throughout
    own = float(np.median(off[right]))
    noise = float(np.median(np.abs(off[right] - own))) / 0.6745
    # two tyres, as large and as small as possible
    wrong = np.abs(typical - own) > max(np.log((1.0 + _RADIUS_SPREAD) / (1.0 - _RADIUS_SPREAD)), 6.0 * noise)
    spans: list[tuple[float, float, float]] = []
    for a, b in find_runs(wrong):
        begin, end = track.t[at[a]], track.t[at[b - 1]]
        factor = float(np.median(off[a:b]))
        # a scale is one factor; fixes among high buildings make speeds of all magnitudes
        scatter = float(np.median(np.abs(off[a:b] - factor))) / 0.6745
        if end - begin < _SHORTEST_SPAN - 2.0 * track.period or scatter > np.log1p(_RADIUS_SPREAD):
            continue
        # up to the adjacent right readings: what lies between is unknown
        low = track.t[at[a - 1]] if a > 0 else -np.inf
        high = track.t[at[b]] if b < len(at) else np.inf
        bad |= (t > low) & (t < high)
        spans.append((float(begin - start), float(end - start), float(np.exp(factor - own))))
    if not spans:
        return bad, None
    begin_s, end_s, times = max(spans, key=lambda span: span[1] - span[0])
    where = f"from {begin_s:.1f} to {end_s:.1f} s"
    if len(spans) > 1:
        where = f"in {len(spans)} spans, the longest {where}"
    return bad, Finding(
        "warning",
        f"the odometer reads {times:.2f} times what it reads elsewhere against the GNSS speed {where}: not used there",
        "odometer.other_scale",
    )
