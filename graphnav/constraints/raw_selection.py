"""Which raw observations are used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphnav.config import Settings
from graphnav.config.raw_gnss import RawGnssSettings
from graphnav.constraints.base import SAME_TIME
from graphnav.core.rotation import Array
from graphnav.gnss.series import RawGnss, choose_primary
from graphnav.recording import Recording

EARLY = 0.05  # s by which an epoch may come before the next is due: stamps jitter


def select_observations(recording: Recording, settings: Settings) -> RawGnss | None:
    """The rows to be used: of one signal for each satellite, strong enough, where the IMU is."""
    s, raw = settings.raw_gnss, recording.raw_gnss
    if raw is None or not recording.is_tight(s.coupling) or not len(raw):
        return None
    used = select_usable(raw, s)
    if raw.catalogue is None:  # a piece of a series has the epoch before it as well, from which carriers change
        used &= (raw.t >= recording.start - SAME_TIME) & (raw.t <= recording.end + SAME_TIME)
    if s.period > 0.0 and used.any():
        used &= np.isin(raw.t, _thin_times(np.unique(raw.t[used]), s.period))
    raw = raw.take(used)
    raw = raw.take(choose_primary(raw))
    return raw if len(raw) else None


def select_usable(raw: RawGnss, settings: RawGnssSettings) -> NDArray[np.bool_]:
    """(N,) which rows are placed, strong enough and, with a base station, seen by it."""
    used = np.isfinite(raw.p[:, 0]) & np.isfinite(raw.clock) & ~(raw.cn0 < settings.cn0)
    return used & np.isfinite(raw.difference) if raw.differenced else used


def _thin_times(t: Array, least: float) -> Array:
    """Those of some times that are so far apart at least."""
    out = [float(t[0])]
    for x in t.tolist():
        if x - out[-1] >= least - EARLY:
            out.append(x)
    return np.array(out)
