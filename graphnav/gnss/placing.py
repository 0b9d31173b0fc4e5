"""Satellite states for a rover's observations: the series with satellites placed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphnav.core.notes import Notes
from graphnav.core.rotation import Array
from graphnav.gnss.channels import find_channels
from graphnav.gnss.ephemeris import Ephemerides, Placed, rotate_earth
from graphnav.gnss.precise import Orbits
from graphnav.gnss.series import Observations, RawGnss, compute_medians
from graphnav.gnss.signals import C, name_satellite

_FLIGHT = 0.075  # s, flight time of a signal from a medium Earth orbit
_TICK = 1e-3  # s, within which receivers steer their clocks


@dataclass(frozen=True)
class Corrected:
    """Corrections already applied to the codes of a file."""

    clock: bool = False  # of satellite clocks, with group delays
    troposphere: bool = False


def place(
    obs: Observations,
    nav: Ephemerides | None,
    precise: Orbits | None,
    rover: Array,
    corrected: Corrected = Corrected(),
) -> tuple[RawGnss, tuple[str, ...]]:
    """Compute satellite positions, velocities and clocks; remarks name satellites that have none.

    Parameters
    ----------
    obs : on the target clock, with the receiver's own stamps.
    nav : broadcast ephemerides; with `precise` only for group delays and ionosphere.
    rover : (3,) m in e, within kilometres of the rover.
    """
    if nav is not None and nav.channels:
        obs = replace(obs, channels={**nav.channels, **obs.channels})
    found_channels = find_channels(obs) if precise is not None else {}
    obs = replace(obs, channels={**obs.channels, **found_channels})
    frequency = obs.frequency
    # one time of transmission for all signals of a satellite: codes differ by metres, in which it moves 0.1 mm
    told = np.flatnonzero(np.isfinite(obs.code))  # in order of time and satellite
    new = np.concatenate([[True], (np.diff(obs.t[told]) != 0.0) | (np.diff(obs.satellite[told]) != 0)])
    rows, of = told[new[: len(told)]], np.cumsum(new[: len(told)]) - 1
    sent = obs.t[rows] - obs.code[rows] / C
    source = precise if precise is not None else nav
    assert source is not None
    if corrected.clock:  # the satellite clock is already removed from the code: its time of transmission is GPS time
        found = source.place(obs.satellite[rows], sent, obs.zero)
        sent = sent + np.nan_to_num(found.clock)
    found = source.place(obs.satellite[rows], sent, obs.zero)
    placed = Placed.unknown(len(obs))
    for name in ("p", "v", "clock", "drift"):
        getattr(placed, name)[told] = getattr(found, name)[of]
    delay = np.zeros(len(obs))
    if nav is not None:
        delay = nav.compute_delay(obs.satellite, obs.signal, frequency, obs.t, obs.zero)
    clock = np.where(np.isfinite(placed.clock), 0.0, np.nan) if corrected.clock else C * (placed.clock - delay)
    clock[np.isnan(frequency)] = np.nan  # needed for the ionospheric delay
    remarks = Notes([*(nav.remarks if nav is not None else ()), *(precise.remarks if precise is not None else ())])
    lost = {int(s) for s in np.unique(obs.satellite[told[np.isnan(placed.p[told, 0])]])}
    lost_all = sorted(s for s in lost if not np.isfinite(placed.p[(obs.satellite == s), 0]).any())
    ill = sorted(set(lost_all) & (nav.unhealthy if nav is not None and precise is None else set()))
    without = [s for s in lost_all if s not in ill]
    mute = sorted({int(x) for x in np.unique(obs.satellite[np.isnan(frequency)])} - lost)
    if found_channels:
        names = ", ".join(f"{name_satellite(one)} {channel}" for one, channel in found_channels.items())
        remarks.add("raw.channels_found", f"GLONASS channels by the change of codes with carriers: {names}")
    if mute:
        names = ", ".join(name_satellite(x) for x in mute)
        sentence = (
            f"no frequency channel for {names}: their observations are not used; a GLONASS navigation file has it"
        )
        remarks.add("raw.no_channel", sentence)
    if without:
        names = ", ".join(name_satellite(s) for s in without)
        remarks.add("raw.no_ephemeris", f"no ephemeris for {names}: their observations are not used")
    if ill:
        names = ", ".join(name_satellite(s) for s in ill)
        remarks.add("raw.unhealthy", f"marked unhealthy in the navigation data, not used: {names}")
    partly = sorted(lost - set(lost_all))
    if partly:
        names = ", ".join(name_satellite(s) for s in partly)
        sentence = f"no ephemeris close enough in time for some observations of {names}"
        remarks.add("raw.no_ephemeris_then", sentence)
    raw = RawGnss(
        t=obs.t, satellite=obs.satellite, signal=obs.signal, code=obs.code, carrier=obs.carrier,
        range_rate=-obs.doppler * C / frequency, cn0=obs.cn0, slip=obs.slip, half=obs.half, frequency=frequency,
        p=placed.p, v=placed.v, clock=clock, drift=C * placed.drift, difference=np.full(len(obs), np.nan),
        zero=obs.zero, place=(float(rover[0]), float(rover[1]), float(rover[2])),
        klobuchar=None if nav is None or nav.klobuchar is None else tuple(map(tuple, nav.klobuchar.tolist())),
        troposphere=corrected.troposphere, lock=obs.lock, files=obs.files,
    )  # fmt: skip
    return raw, tuple(remarks)


def restore_own_stamps(
    obs: Observations, source: Ephemerides | Orbits, rover: Array, corrected: Corrected = Corrected()
) -> Observations:
    """Restore the receiver's own stamps from nominal epochs.

    A receiver adjusts its clock by whole milliseconds and measures within half a millisecond of the nominal epoch;
    codes refer to its own stamp. So the whole milliseconds are those of its clock error, which the codes determine.
    """
    found = source.place(obs.satellite, obs.t - _FLIGHT, obs.zero)
    away = np.linalg.norm(rotate_earth(found.p, np.full(len(obs), _FLIGHT)) - rover, axis=1)
    error = (obs.code - away) / C + (0.0 if corrected.clock else found.clock)
    off = compute_medians(obs.t, error)
    return replace(obs, t=obs.t + _TICK * np.round(np.nan_to_num(off) / _TICK))
