"""What the sensors of a recording hold, in numbers: names -> values in SI units unless the name states otherwise."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from graphnav.core.findings import compute_period, find_gap_limit, find_runs
from graphnav.core.rotation import Array
from graphnav.recording import Gnss, Odometer, Recording
from graphnav.recording.checks.raw import describe_raw
from graphnav.recording.checks.series import describe_series
from graphnav.recording.checks.tracks import Track


def list_facts(recording: Recording, track: Track | None) -> dict[str, dict[str, Any]]:
    """What each sensor of a recording holds, by its name; `track` is that of the fixes."""
    facts = {"imu": _describe_imu(recording)}
    if recording.gnss is not None:
        facts["gnss"] = _describe_gnss(recording.gnss, track)
    if recording.raw_gnss is not None and len(recording.raw_gnss):
        facts["raw_gnss"] = describe_raw(recording.raw_gnss)
    if recording.odometer is not None:
        facts["odometer"] = _describe_odometer(recording.odometer)
    facts |= {name: describe_series(series) for name, series in recording.sensors.items()}
    if (truth := recording.truth) is not None:
        sigma = truth.closed_loop_sigma
        facts["truth"] = {"closed_loop_sigma_m": sigma} if sigma else {"rows": len(truth.t), "of": str(truth.of)}
    return facts


def _describe_sensors(t: Array) -> dict[str, Any]:
    return {"rows": len(t), "rate_hz": round(1.0 / compute_period(t), 3), "span_s": round(float(t[-1] - t[0]), 3)}


def _describe_imu(recording: Recording) -> dict[str, Any]:
    facts = _describe_sensors(recording.imu.t)
    facts["duration_s"] = round(recording.duration, 3)
    step = np.diff(recording.imu.t)
    facts["gaps"] = int((step > find_gap_limit(recording.imu.t)).sum())
    facts["longest_step_s"] = round(float(step.max()), 4)
    return facts


def _describe_gnss(gnss: Gnss, track: Track | None) -> dict[str, Any]:
    facts: dict[str, Any] = {"rows": 1} if len(gnss.t) == 1 else _describe_sensors(gnss.t)
    facts["velocities"] = 0 if gnss.v is None else int((~np.isnan(gnss.v[:, 0])).sum())
    if gnss.types:
        facts["types"] = gnss.types
    if track is not None:
        dt = np.diff(track.t)
        near = dt < 5 * max(1.0, track.period)
        usable = track.speed < 100.0
        speed = track.speed
        distance = np.sum((0.5 * (speed[1:] + speed[:-1]) * dt)[near])
        facts["distance_m"] = round(float(distance), 1)
        facts["max_speed_mps"] = round(float(np.percentile(speed[usable], 99.9)), 2) if usable.any() else float("nan")
        stopped = find_runs(speed < 0.3)
        stops = [(a, b) for a, b in stopped if track.t[b - 1] - track.t[a] >= 2.0]
        facts["stops"] = len(stops)
        facts["stopped_s"] = round(float(sum(track.t[b - 1] - track.t[a] for a, b in stops)), 1)
    return facts


def _describe_odometer(odometer: Odometer) -> dict[str, Any]:
    step, speed = np.diff(odometer.t), np.abs(odometer.speed)
    distance = float(np.sum(0.5 * (speed[1:] + speed[:-1]) * step))
    return {
        **_describe_sensors(odometer.t),
        "distance_m": round(distance, 1),
        "max_speed_mps": float(speed.max()),
    }


_VALUE_UNITS = {"hz": "Hz", "s": "s", "m": "m", "mps": "m/s", "mps2": "m/s2", "dbhz": "dB-Hz"}


def format_facts(facts: dict[str, Any]) -> Iterator[str]:
    """Each fact with its name, of which words that the name before begins with too are not repeated."""
    before = ""
    for name, value in facts.items():
        words, said = name.split("_"), before.split("_")
        common = next((k for k, (a, b) in enumerate(zip(words[:-1], said, strict=False)) if a != b), len(words) - 1)
        yield _format_number("_".join(words[min(common, len(words) - 1) :]) if len(said) > 1 else name, value)
        before = name


def _format_number(name: str, value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(_format_number(*one) for one in value.items())
    words = name.split("_")
    unit = _VALUE_UNITS.get(words[-1], "") if len(words) > 1 else ""
    number = f"{value:.6g}" if isinstance(value, float) else str(value)
    return f"{' '.join(words[:-1] if unit else words)} {number} {unit}".rstrip()
