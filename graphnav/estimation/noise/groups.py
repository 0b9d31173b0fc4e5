"""Names of the variance components and of the processes that a recording can have."""

from __future__ import annotations

from graphnav.constraints import list_constraints
from graphnav.constraints.dual_antenna import DualHeading, DualPitch
from graphnav.constraints.gnss import OFFSETS, STAMP_ERROR, STAMPS, VELOCITY_ERROR
from graphnav.constraints.lasting import ERRORS, LASTING, MULTIPATH_ERROR
from graphnav.constraints.odometer import ODOMETER_ERROR
from graphnav.constraints.raw_gnss import CODE_ERRORS, RATE_ERROR
from graphnav.constraints.vehicle import NHC_ERROR
from graphnav.imu.dynamics import PRIORS
from graphnav.imu.preintegration import NOISE_FIGURES
from graphnav.recording import FIX_TYPES


def list_groups() -> tuple[str, ...]:
    """Names of all variance components that a recording can have."""
    out = [*(f"imu.{name}" for name in NOISE_FIGURES), STAMPS, *OFFSETS, *PRIORS]
    for cls in list_constraints():
        axes = dict.fromkeys(cls.noise_axes)
        kinds = ["", *(f".{kind}" for kind in FIX_TYPES.values())] if cls.name == "gnss_position" else [""]
        out += [
            f"{cls.name}{kind}{time}.{axis}"
            for kind in kinds
            for time in ("", *(f".{t}" for t in LASTING))
            for axis in axes
        ]
    return tuple(out)


def list_all_processes() -> tuple[str, ...]:
    """Names of all processes that a recording can have."""
    typed = [f"{error}_{kind}" for error in ERRORS for kind in FIX_TYPES.values()]
    of_antennas = (kind.name_lasting() for kind in (DualHeading, DualPitch))
    others = VELOCITY_ERROR, *CODE_ERRORS, RATE_ERROR, STAMP_ERROR, NHC_ERROR, ODOMETER_ERROR
    return (*ERRORS, MULTIPATH_ERROR, *typed, *others, *of_antennas)
