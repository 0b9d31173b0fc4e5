"""Checks of a sensor's rows by its declaration: impossible values, and a summary of the others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from graphnav.core.findings import Finding, compute_period
from graphnav.recording import Recording, take_rows
from graphnav.sensors import Series

_ISOLATED = 0.01  # share of the rows; above it the cause is not in single rows
_SAME = 10.0  # s for which a working sensor does not repeat one number while others change


def screen_series(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The recording without values beyond the bounds of their sensors, and findings."""
    kept, findings = {}, []
    for name, series in recording.sensors.items():
        kept[name], found = _screen(series)
        findings += found
    return (replace(recording, sensors=kept) if kept else recording), findings


def _screen(series: Series) -> tuple[Series, list[Finding]]:
    sensor, before = series.sensor, np.isfinite(series.values)
    values = sensor.mask_outside_bounds(series.values)
    findings = []
    for column, there, left in zip(sensor.columns, before.T, np.isfinite(values).T, strict=True):
        lost = int(there.sum() - left.sum())
        if not lost:
            continue
        size, unit = next(iter(column.units.values())), next(iter(column.units))
        sentence = (
            f"[{sensor.name}]: {lost} of {int(there.sum())} values of {column.name} lie outside "
            f"{column.lowest / size:g} to {column.highest / size:g} {unit}"
        )
        needed = any(column.name in some for some in sensor.needs)
        if needed and lost > max(_ISOLATED * there.sum(), 1):
            hint = f"set units = {{ {column.name} = ... }}, one of {', '.join(column.units)}"
            findings.append(Finding("refused", f"{sentence}: if it is another unit, {hint}", f"{sensor.name}.unit"))
        else:
            findings.append(Finding("note", f"{sentence}: left out", f"{sensor.name}.bounds"))
    if not findings:
        return series, []
    return take_rows(replace(series, values=values), sensor.mask_usable(values)), findings


def describe_series(series: Series) -> dict[str, Any]:
    """Rows, rate, span and the least and largest value of each column, in the units of files."""
    facts: dict[str, Any] = {"rows": len(series)}
    if len(series) > 1:
        facts |= {"rate_hz": round(1.0 / compute_period(series.t), 3), "span_s": round(float(np.ptp(series.t)), 3)}
    for column in series.sensor.columns:
        unit, size = next(iter(column.units.items()))
        values = series[column.name] / size
        if np.isfinite(values).any():
            facts[f"{column.name}_{unit}"] = [float(f"{x:.6g}") for x in (np.nanmin(values), np.nanmax(values))]
    return facts


def check_series(recording: Recording) -> Iterator[Finding]:
    """Sensors on another clock, and sensors whose readings do not change while others do."""
    for name, series in recording.sensors.items():
        if not len(series):
            continue
        if series.t[-1] < recording.start or series.t[0] > recording.end:
            yield Finding(
                "warning",
                f"[{name}] has no row while the IMU runs: are they on one clock? time_offset moves its stamps",
                f"{name}.apart",
            )
        for some in series.sensor.needs:
            for column in some:
                values = series[column]
                known = np.isfinite(values)
                if known.sum() > 1 and np.ptp(series.t[known]) > _SAME and np.ptp(values[known]) == 0.0:
                    yield Finding("warning", f"[{name}]: {column} reads the same all the time", f"{name}.stuck")
