"""Sensors beside IMU, GNSS and odometer; one file each, with a module-level ``SENSOR = Sensor(...)``.

A script adds its own sensor with `register`, before it reads the recording.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from graphnav.core.errors import RecordingError
from graphnav.sensors.base import Column, Sensor, Series

__all__ = ["Column", "Sensor", "Series", "register", "registered"]

# keys of recording.toml
_TAKEN = {"imu", "gnss", "raw_gnss", "odometer", "truth", "name", "platform", "format", "clock"}
_own: dict[str, Sensor] = {}


@cache
def _find() -> dict[str, Sensor]:
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    sensors = [m.SENSOR for m in modules if isinstance(getattr(m, "SENSOR", None), Sensor)]
    return {s.name: s for s in sorted(sensors, key=lambda s: s.name)}


def list_sensors() -> dict[str, Sensor]:
    """All known sensors by name."""
    return _find() | _own


def register(sensor: Sensor) -> Sensor:
    """Add a sensor, so that recordings, settings and the line protocol may name it; returns it.

    Raises
    ------
    RecordingError
        If something else has that name.
    """
    if sensor.name in _TAKEN or sensor.name in _find():
        raise RecordingError(
            f"sensor '{sensor.name}': graphnav has one of that name; choose another", key="sensor.name_taken"
        )
    _own[sensor.name] = sensor
    return sensor
