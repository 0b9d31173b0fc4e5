"""Selection of the raw observations in use."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphnav.config import Settings
from graphnav.config.raw_gnss import RawGnssSettings
from graphnav.constraints.base import SAME_TIME
from graphnav.core.errors import ConfigError
from graphnav.core.interpolation import keep_apart
from graphnav.gnss.series import RawGnss, choose_primary
from graphnav.gnss.single_point import choose_coefficients, look
from graphnav.recording import Recording

EARLY = 0.05  # s by which an epoch may be early: stamps jitter


def select_observations(recording: Recording, settings: Settings) -> RawGnss | None:
    """Select the rows to use: one signal per satellite, strong enough, within the time of the IMU."""
    s, raw = settings.raw_gnss, recording.raw_gnss
    if raw is None or not recording.is_tight(s.coupling) or not len(raw):
        return None
    used = select_usable(raw, s)
    if raw.catalogue is None:  # a piece of a series also holds the previous epoch, for carrier-phase changes
        used &= (raw.t >= recording.start - SAME_TIME) & (raw.t <= recording.end + SAME_TIME)
    if s.period > 0.0 and used.any():
        used &= np.isin(raw.t, keep_apart(np.unique(raw.t[used]), s.period - EARLY))
    raw = raw.take(used)
    raw = raw.take(choose_primary(raw))
    return raw if len(raw) else None


def check_masks(recording: Recording, settings: Settings) -> None:
    """Check that the masks leave something of a recording's raw observations.

    Raises
    ------
    ConfigError
        If they do not: it would be solved as if there were no GNSS.
    """
    s, raw = settings.raw_gnss, recording.raw_gnss
    if raw is None or not recording.is_tight(s.coupling) or not len(raw):
        return
    placed = raw.take(np.isfinite(raw.p[:, 0]))
    elevation = look(placed, placed.antenna, choose_coefficients(placed)).elevation
    for key, unit, value, least in (
        ("cn0", "dB-Hz", placed.cn0, s.cn0),
        ("elevation", "deg", np.degrees(elevation), s.elevation),
    ):
        if len(value) and np.all(value < least):
            raise ConfigError(
                f"raw_gnss.{key} = {least:g} {unit} leaves no observation: the largest is {value.max():.0f}; lower it",
                key="raw_gnss.masks",
            )


def select_usable(raw: RawGnss, settings: RawGnssSettings) -> NDArray[np.bool_]:
    """(N,) mask of rows with a satellite position, strong enough and, with a base station, observed by it."""
    used = np.isfinite(raw.p[:, 0]) & np.isfinite(raw.clock) & ~(raw.cn0 < settings.cn0)
    return used & np.isfinite(raw.difference) if raw.differenced else used
