"""Names, for people, of constraints' rows and of the numbers of a calibration, by the names in code and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from graphnav.constraints import list_constraints
from graphnav.imu.dynamics import SCALE, TERMS, VEHICLE_TERMS

# the rows of constraints whose own names say too little
_ROWS = {
    "gnss_position": "GNSS positions", "gnss_velocity": "GNSS velocities", "gnss_code": "GNSS codes",
    "gnss_doppler": "Doppler shifts", "gnss_carrier": "carriers between epochs", "gnss_phase": "carrier phases",
    "gnss_integers": "integers of carriers", "gnss_ppp_code": "codes of two signals",
    "gnss_ppp_carrier": "carriers of two signals", "gnss_antenna_clone": "antenna at the epoch before",
    "nhc": "non-holonomic constraint", "stance": "stances", "foot_lateral": "sideways speed of the foot",
    "barometer": "barometric heights", "dual_antenna_heading": "heading of two antennas",
    "dual_antenna_pitch": "pitch of two antennas", "zero_velocity": "zero velocity at stops",
    "zero_rate": "zero rate at stops", "held_position": "held position at stops",
}  # fmt: skip
_AXIS_NAMES = ("right", "forward", "up")
_TO_DEG = 57.29577951308232


@dataclass(frozen=True)
class Component:
    """One number of a parameter: its name and how it is displayed."""

    words: str
    unit: str
    scale: float = 1.0  # from the parameter's own unit


def _name_terms(sensor: str, terms: Sequence[tuple[int, int]]) -> list[Component]:
    """Of terms of the matrix of a triad of the IMU."""
    return [
        Component(f"{sensor} scale error, {_AXIS_NAMES[i]}", "ppm", 1e6)
        if i == j
        else Component(f"{sensor} misalignment, {_AXIS_NAMES[i]} from {_AXIS_NAMES[j]}", "mrad", 1e3)
        for i, j in terms
    ]


def _name_axes(words: str) -> list[Component]:
    return [Component(f"{words}, {axis}", "m") for axis in _AXIS_NAMES]


# The parameters of a calibration; all others belong to the noise of the measurements.
_NAMED = {
    "mounting": [Component("mounting, pitch", "deg", _TO_DEG), Component("mounting, heading", "deg", _TO_DEG)],
    "gnss_lever_arm": _name_axes("antenna lever arm"),
    "axle": [Component("axle without side slip, ahead of the stated one", "m")],
    "gnss_time_offset": [Component("stamps of the positions, to add", "ms", 1e3)],
    "gnss_velocity_time_offset": [Component("stamps of the GNSS velocities, to add", "ms", 1e3)],
    "gnss_clock_rate": [Component("clock of the IMU, fast by", "ppm", 1e6)],
    "odometer_delay": [Component("delay of the odometer", "ms", 1e3)],
    "odometer_scale": [Component("odometer scale error", "%", 100.0)],
    "slip_squat": [
        Component("side slip by lateral acceleration", "deg per m/s²", _TO_DEG),
        Component("squat by forward acceleration", "deg per m/s²", _TO_DEG),
    ],
    "pivot": _name_axes("pivot of the foot"),
    "pivot_travel": [
        Component("travel of the pivot, right", "m"),
        Component("travel of the pivot, forward", "m"),
    ],
    "foot_axis": [
        Component("foot's sideways axis, forward part", "deg", _TO_DEG),
        Component("foot's sideways axis, upward part", "deg", _TO_DEG),
    ],
}


def name_rows(name: str) -> str:
    """The rows of a constraint."""
    return _ROWS.get(name, name.replace("_", " "))


def has_names(name: str) -> bool:
    """Whether a parameter belongs to the calibration and its numbers have names."""
    return name in _NAMED or name == SCALE or name in _collect_names()


@cache
def _collect_names() -> dict[str, list[Component]]:
    """The names that constraints give their own parameters."""
    return {name: [Component(*one) for one in each] for kind in list_constraints() for name, each in kind.words.items()}


def name_components(name: str, size: int, unit: str) -> list[Component]:
    """One per number of a parameter; those without a name are numbered."""
    sensors = zip(("gyro", "accelerometer"), (TERMS, TERMS) if size == 2 * len(TERMS) else VEHICLE_TERMS, strict=True)
    of_imu = [one for sensor, terms in sensors for one in _name_terms(sensor, terms)] if name == SCALE else []
    known = of_imu or (_NAMED | _collect_names()).get(name, [])
    if len(known) == size:
        return known
    if size == 1:
        return [Component(name, unit or "-")]
    axes = ("east", "north", "up") if name.startswith("gnss_") and size == 3 else range(size)
    return [Component(f"{name} [{axis}]", unit or "-") for axis in axes]
