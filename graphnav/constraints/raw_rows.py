"""Satellite geometry at the positions of a drive, common to all constraints on raw observations."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from graphnav.config.raw_gnss import RawGnssSettings
from graphnav.constraints.base import BuildContext
from graphnav.constraints.lasting import find_fix_period, find_node_spacing
from graphnav.constraints.raw_selection import select_observations
from graphnav.core import earth
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter
from graphnav.gnss.ephemeris import rotate_earth
from graphnav.gnss.series import RawGnss, compute_medians
from graphnav.gnss.signals import C
from graphnav.gnss.single_point import Geometry, choose_coefficients, compute_stretch, look

CLOCK = "receiver_clock"
GROSS = 90.0  # m off the others, beyond which a code tells nothing: three sigmas of a signal's bias
_CLOCK_SIGMA = np.array([100.0, 10.0])  # m, m/s, about the single-point solution: uninformative


@dataclass(frozen=True)
class PreparedRows:
    """Data common to all kinds of rows, for the rows in use; computed once per scene."""

    raw: RawGnss
    keyframe: Array
    s_n: Array  # (N, 3) m, satellites
    v_n: Array  # (N, 3) m/s
    R_ln: Array  # (N, 3, 3)
    azimuth: Array  # (N,) rad, from north to the east
    elevation: Array  # (N,) rad
    known: Array  # (N,) m, range from the nominal antenna with atmospheric delays
    nominal: Array  # (N, 3) m
    ionosphere: Array  # (N,) m
    stretch: Array  # (N,)
    spacing: float  # s between nodes of slowly varying parameters
    gross: int = 0  # rows left out whose codes are grossly wrong

    @property
    def clock(self) -> Parameter:
        """Receiver clock, independent at every epoch."""
        epochs, first = np.unique(self.raw.t, return_index=True)
        sigma = np.tile(_CLOCK_SIGMA, (len(epochs), 1))
        return Parameter(CLOCK, self.raw.receiver_clock[first], sigma, "m, m/s", begins=epochs, reported=True)

    def take(self, which: NDArray[np.bool_]) -> PreparedRows:
        """Some of the rows."""
        own = {f.name: getattr(self, f.name)[which] for f in fields(self) if f.name not in ("raw", "spacing", "gross")}
        return replace(self, raw=self.raw.take(which), **own)


def prepare_every(scene: BuildContext) -> PreparedRows | None:
    """Prepare all rows in use; those of epochs without a keyframe have keyframe -1."""
    raw = select_observations(scene.recording, scene.settings)
    if raw is None:
        return None
    geometry = look(raw, raw.antenna, choose_coefficients(raw))
    used = geometry.elevation >= np.radians(scene.settings.raw_gnss.elevation)
    if not used.any():
        return None
    raw, geometry = raw.take(used), geometry.take(used)
    gross = measure_gross(raw, raw.code + raw.difference if raw.differenced else raw.code, geometry) != 0.0
    raw, geometry = raw.take(~gross), geometry.take(~gross)
    if not len(raw):
        return None
    frame = scene.frame
    return PreparedRows(
        raw=raw,
        keyframe=scene.find_keyframes(raw.t),
        s_n=(geometry.s - frame.r_e) @ frame.R_ne.T,
        v_n=rotate_earth(raw.v, geometry.distance / C) @ frame.R_ne.T,
        R_ln=earth.enu_axes(earth.ecef_to_llh(raw.antenna)) @ frame.R_ne.T,
        azimuth=geometry.azimuth,
        elevation=geometry.elevation,
        known=geometry.distance + geometry.ionosphere + geometry.troposphere,
        nominal=(raw.antenna - frame.r_e) @ frame.R_ne.T,
        ionosphere=geometry.ionosphere,
        stretch=compute_stretch(raw, geometry),
        spacing=find_node_spacing(scene.settings.gnss.slow_times, find_epoch_period(raw, scene.settings.raw_gnss)),
        gross=int(gross.sum()),
    )


def measure_gross(raw: RawGnss, code: Array, geometry: Geometry) -> Array:
    """(N,) m by which codes (N,) are off the others, where that is gross; 0 elsewhere.

    Parameters
    ----------
    geometry : at the single-point positions, which outlying codes do not move.
    """
    off = code + raw.clock - geometry.distance - geometry.troposphere - geometry.ionosphere
    off = off - compute_medians(raw.t, off)  # of the receiver's clock
    off = off - compute_medians(raw.satellite // 100 * 1000 + raw.signal, off)  # of the signals' biases
    return np.asarray(np.where(np.abs(off) > GROSS, off, 0.0))


def select_rows(every: PreparedRows | None) -> PreparedRows | None:
    """The rows of epochs that have keyframes."""
    if every is None or (every.keyframe >= 0).all():
        return every
    there = every.keyframe >= 0
    return every.take(there) if there.any() else None


def find_epoch_period(raw: RawGnss, settings: RawGnssSettings) -> float:
    """s between the epochs in use; from the catalogue for a piece of a series with too few epochs."""
    return find_fix_period(raw.epochs[0]) if raw.catalogue is None else max(raw.catalogue.period, settings.period)
