"""The heading of a stationary vehicle by two antennas: the direction of their baseline minus that in the vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.dual_antenna import SENSOR
from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.estimation.alignment.back import find_first_stop_end
from graphnav.estimation.alignment.first import level
from graphnav.recording import Recording

_FEWEST_READINGS = 3  # readings needed so that a single wrong one does not affect the median


@dataclass(frozen=True)
class BaselineHeading:
    """The heading at the start by two antennas."""

    heading: float  # rad
    sigma: float  # rad
    until: float  # s, the last reading used


def measure_baseline_heading(
    recording: Recording, settings: Settings, stationary: Array | None
) -> BaselineHeading | None:
    """The heading of a vehicle that is stationary at the start, by the readings of two antennas there.

    Errors of readings are correlated over seconds (multipath), and all contain that of the mounting: their mean is no
    better than one.

    Parameters
    ----------
    stationary : (N, 2) s, intervals in which it stands; None: unknown, and it may stand throughout.

    Returns
    -------
    BaselineHeading or None
        None where it does not stand, or where fewer than three readings can be used.
    """
    series = recording.sensors.get(SENSOR.name)
    if recording.platform != "vehicle" or series is None or not settings.get_sensor(SENSOR.name).use:
        return None
    begin = recording.start
    end = recording.end if stationary is None else find_first_stop_end(recording, stationary)
    rows = (series.t >= begin - SAME_TIME) & (series.t <= end + SAME_TIME) & np.isfinite(series["heading"])
    if end <= begin or np.count_nonzero(rows) < _FEWEST_READINGS:
        return None
    of_level = rotation.from_rph(np.array([*level(recording, begin), 0.0])) @ np.array(series.figures.baseline)
    heading = rotation.wrap(series["heading"][rows] - np.arctan2(of_level[0], of_level[1]))
    middle = np.angle(np.mean(np.exp(1j * heading)))
    one = np.median(series.get_sigma("heading", np.radians(series.figures.sigma))[rows])
    return BaselineHeading(
        float(middle + np.median(rotation.wrap(heading - middle))),
        float(np.hypot(one, np.radians(series.figures.baseline_sigma))),
        float(series.t[rows][-1]),
    )
