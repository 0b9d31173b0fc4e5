"""From a rover's files to its series, with times, positions and clocks from its own single-point solutions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graphnav.core import earth
from graphnav.core.errors import RecordingError
from graphnav.core.interpolation import pick_nearest
from graphnav.core.notes import Note, Notes, get_key
from graphnav.core.rotation import Array
from graphnav.core.timescales import gps_to_utc
from graphnav.gnss.antex import Antennas, read_antex
from graphnav.gnss.differential import add_differences
from graphnav.gnss.ephemeris import Ephemerides
from graphnav.gnss.files import unpack_bytes
from graphnav.gnss.placing import Corrected, place, restore_own_stamps
from graphnav.gnss.precise import Orbits, read_precise
from graphnav.gnss.rinex_nav import read_navigation
from graphnav.gnss.rinex_obs import parse_observations
from graphnav.gnss.series import Observations, RawGnss, choose_primary, drop_contradictory, join_files
from graphnav.gnss.signals import C, name_signal
from graphnav.gnss.single_point import SinglePoint, solve
from graphnav.gnss.ubx import is_ubx, parse_ubx

_ROUGH_EPOCHS = 50  # epochs from which an approximate position is computed
_BASE_OFF = 10.0  # largest offset of a base's single-point position from the stated one, in sigmas
_LARGEST_TYPICAL_CODE = 1e8  # m, of codes: twice the distance of the satellites
_LOST_KEYS = ("raw.impossible", "raw.no_ephemeris", "raw.no_ephemeris_then", "raw.unhealthy", "raw.no_channel")


@dataclass(frozen=True)
class Sources:
    """The files of a series."""

    rover: tuple[Path, ...]
    nav: tuple[Path, ...] = ()
    sp3: tuple[Path, ...] = ()
    clk: tuple[Path, ...] = ()
    antex: tuple[Path, ...] = ()
    base: tuple[Path, ...] = ()
    base_position: tuple[float, float, float] | None = None  # m in e; that of the file's header when None
    corrected: Corrected = field(default_factory=Corrected)
    nominal_stamps: bool = False
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def files(self) -> tuple[Path, ...]:
        """All of them."""
        return (*self.rover, *self.nav, *self.sp3, *self.clk, *self.antex, *self.base)


def read_rover(paths: tuple[Path, ...]) -> tuple[Observations, Ephemerides | None]:
    """Read the observations of one receiver from RINEX or UBX files, and the ephemerides in UBX files.

    Raises
    ------
    RecordingError
        If a file is neither, or cannot be read.
    """
    parts, sent = [], None
    for path in paths:
        data = unpack_bytes(path)
        if is_ubx(data):
            obs, found = parse_ubx(data, path)
            sent = found if sent is None else sent.join(found)
        else:
            obs = parse_observations(data, path)
        if data.remarks:  # that end is told once
            obs = replace(obs, remarks=(*(x for x in obs.remarks if get_key(x) != "raw.cut"), *data.remarks))
        parts.append(obs)
    return join_files(parts), sent


def load_raw(
    sources: Sources, zero: float | None = None, observations: Observations | None = None
) -> tuple[RawGnss, SinglePoint, tuple[str, ...]]:
    """The series on a clock with a zero (s since the GPS epoch), its single-point solutions, and remarks.

    Parameters
    ----------
    zero : that of the observations when None.
    observations : of the rover, where they are read already.

    Raises
    ------
    RecordingError
        If a file cannot be used, or the observations determine no position.
    """
    obs, sent = read_rover(sources.rover) if observations is None else (observations, None)
    nav = _read_ephemerides(sources.nav)
    if sent is not None and sent.satellites:
        nav = sent if nav is None else nav.join(sent)
    precise = read_precise(list(sources.sp3), list(sources.clk)) if sources.sp3 else None
    if nav is None and precise is None:
        raise RecordingError(
            f"{sources.rover[0]}: holds no ephemerides; they are in a RINEX navigation file of that day: set nav, or "
            "sp3, in [raw_gnss]",
            key="raw.no_ephemerides",
        )
    _check_dates(obs, nav, precise, sources)
    if zero is not None:
        obs = obs.move_to_clock(zero)
    rover, corrected = _locate_roughly(obs, nav, precise, sources.corrected), sources.corrected
    if sources.nominal_stamps:
        obs = restore_own_stamps(obs, precise or nav, rover, corrected)  # type: ignore[arg-type]
    raw, remarks = place(obs, nav, precise, rover, corrected)
    raw, contradictory = drop_contradictory(raw)
    antennas, ends = _read_antennas(sources.antex)
    remarks = (*remarks, *contradictory, *ends)
    raw = replace(
        raw, lever_arm=np.array(sources.lever_arm), precise=precise is not None, antennas=antennas if precise else {},
        clock_noise=precise.compute_clock_noise() if precise else {},
    )  # fmt: skip
    fixes = _solve_primary(raw, obs, remarks, sources.rover[0])
    notes = Notes([*obs.remarks, *remarks])
    if raw.klobuchar is None:
        notes.add(
            "raw.no_ionosphere",
            "no ionosphere coefficients in the navigation files: the delay at night is assumed, 5 ns at the zenith",
        )
    carriers = np.isfinite(raw.carrier)
    if half := int(np.sum(raw.half & carriers)):
        sentence = f"carriers that may be off by half a cycle: {half} of {int(carriers.sum())}; none of these is fixed"
        notes.add("raw.half_cycles", sentence)
    raw, fixes = _correct_times(raw, fixes)
    if sources.base:
        raw, more = _difference_by_base(raw, sources, nav, precise)
        notes += more
        one = choose_primary(raw) & np.isfinite(raw.difference)
        if one.any():
            better = raw.take(one)
            fixes = solve(replace(better, code=better.code + better.difference), differential=True)
    return raw, fixes, tuple(notes)


def _read_antennas(paths: Sequence[Path]) -> tuple[Antennas, list[str]]:
    """The satellites' antennas of ANTEX files, and remarks."""
    antennas: Antennas = {}
    remarks: list[str] = []
    for path in paths:
        some, ends = read_antex(path)
        antennas |= some
        remarks += ends
    return antennas, remarks


def _solve_primary(raw: RawGnss, obs: Observations, remarks: Sequence[str], path: Path) -> SinglePoint:
    """Single-point solutions by one signal of each satellite.

    Raises
    ------
    RecordingError
        If there is none, for a reason in `remarks` on the observations where they tell it, or if most codes disagree.
    """
    one = choose_primary(raw) & np.isfinite(raw.p[:, 0])
    if not one.any():
        raise RecordingError(
            f"{path}: none of its satellites has an ephemeris at its times", key="raw.no_ephemeris_then"
        )
    fixes = solve(raw.take(one))
    if not np.isfinite(fixes.p[:, 0]).any():
        left_out = "".join(f"; {note}" for note in (*obs.remarks, *remarks) if get_key(note) in _LOST_KEYS)
        for signal in np.unique(obs.signal).tolist():
            if (typical := float(np.nanmedian(obs.code[obs.signal == signal]))) > _LARGEST_TYPICAL_CODE:
                left_out += (
                    f"; codes {name_signal(signal)} of {typical:.3g} m are no ranges to satellites: see the header"
                )
        raise RecordingError(
            f"{path}: no epoch has enough satellites for a position{left_out}", key="raw.few_satellites"
        )
    _check_agreement(raw.take(one), fixes, path)
    return fixes


def _read_ephemerides(paths: tuple[Path, ...]) -> Ephemerides | None:
    """Read the ephemerides of navigation files and of UBX files."""
    logs = tuple(path for path in paths if is_ubx(unpack_bytes(path)))
    rinex = [path for path in paths if path not in logs]
    nav = read_navigation(rinex) if rinex else None
    sent = read_rover(logs)[1] if logs else None
    return nav if sent is None else sent if nav is None else nav.join(sent)


def _check_agreement(raw: RawGnss, fixes: SinglePoint, path: Path) -> None:
    """Check that most codes of an epoch agree on one position.

    Raises
    ------
    RecordingError
        If in most epochs they do not.
    """
    there = np.bincount(raw.epochs[1], minlength=len(fixes.t))
    share = float(np.median(fixes.satellites[np.isfinite(fixes.p[:, 0])] / there[np.isfinite(fixes.p[:, 0])]))
    if share < 0.5:
        why = (
            "its codes are not in metres, corrected or stamps in [raw_gnss] is not what they are"
            if path.name.endswith((".csv", ".csv.gz"))
            else "its stamps are not in the time system that its header says"
        )
        raise RecordingError(
            f"{path}: only {100.0 * share:.0f} % of an epoch's codes agree on one position: {why}, or the ephemerides "
            "are of other satellites",
            key="raw.contradictory",
        )


def _difference_by_base(
    raw: RawGnss, sources: Sources, nav: Ephemerides | None, precise: Orbits | None
) -> tuple[RawGnss, list[str]]:
    """The series with differences by the base station, and remarks."""
    obs = read_rover(sources.base)[0].move_to_clock(raw.zero)
    given = sources.base_position
    position = obs.marker if given is None else np.array(given)
    if position is None:
        raise RecordingError(
            f"{sources.base[0]}: states no position; set base_position in [raw_gnss]", key="raw.base_position"
        )
    if not 6e6 < np.linalg.norm(position) < 7e6:
        raise RecordingError(
            f"{sources.base[0]}: base_position is {np.linalg.norm(position) / 1e3:.0f} km from the Earth's centre; it "
            "is to be Earth-centred, x, y and z in m",
            key="raw.base_position",
        )
    apart = max(obs.t[0] - raw.t[-1], raw.t[0] - obs.t[-1])
    if apart > 0.0:
        away_by = f"{apart / 3600.0:.1f} h" if apart > 3600.0 else f"{apart:.3g} s"
        rover_day, base_day = (gps_to_utc(one.zero + one.t[0]).astype("datetime64[D]") for one in (raw, obs))
        raise RecordingError(
            f"{sources.base[0]} and {sources.rover[0].name}: the base's observations are of {base_day}, the rover's of "
            f"{rover_day}, {away_by} apart; both must be of the same time: is one of the dates wrong?",
            key="raw.base_time",
        )
    away = float(np.linalg.norm(np.median(raw.antenna, axis=0) - position))
    base, contradictory = drop_contradictory(place(obs, nav, precise, position)[0])
    one = base.take(choose_primary(base) & np.isfinite(base.p[:, 0]))
    if not len(one):
        raise RecordingError(
            f"{sources.base[0]}: none of its satellites has an ephemeris at its times", key="raw.no_ephemeris_then"
        )
    base_fixes = solve(one)
    off, sigma = _measure_base(sources.base[0], one, base_fixes, position)
    notes = Notes([*obs.remarks, *contradictory])
    if given is None:
        notes.add("raw.base_position", "the base's position is that of its header")
    base, _ = _correct_times(base, base_fixes)
    raw, others = add_differences(raw, base, position)
    raw = replace(raw, base_off=(tuple(off.tolist()), tuple(sigma.tolist())))
    sentence = f"codes are differences against a base {away / 1e3:.1f} km away"
    notes += [Note("raw.base", f"{sentence}, {np.linalg.norm(off):.1f} m from its own single-point positions"), *others]
    return raw, notes


def _measure_base(path: Path, base: RawGnss, fixes: SinglePoint, position: Array) -> tuple[Array, Array]:
    """Offset (3,) of a base's single-point position from its stated one, and its 1-sigma; m, ENU.

    The sigma is that of one epoch: most errors are correlated over a whole drive, so a median is hardly better.

    Raises
    ------
    RecordingError
        If they move, or are elsewhere.
    """
    good = np.isfinite(fixes.p[:, 0])
    if not good.any():
        raise RecordingError(f"{path}: no epoch has enough satellites for a position", key="raw.few_satellites")
    _check_agreement(base, fixes, path)
    away = (fixes.p[good] - position) @ earth.enu_axes(earth.ecef_to_llh(position)).T
    sigma = np.sqrt(np.median(np.diagonal(fixes.covariance[good], axis1=1, axis2=2), axis=0))
    low, off, high = np.percentile(away, [5.0, 50.0, 95.0], axis=0)
    if np.any(high - low > _BASE_OFF * sigma):
        raise RecordingError(
            f"{path}: its antenna moves, by {np.linalg.norm(high - low):.0f} m; a base stands: are rover and base "
            "swapped?",
            key="raw.base_moves",
        )
    if np.linalg.norm(off / sigma) > _BASE_OFF:
        raise RecordingError(
            f"{path}: its observations put the base {np.linalg.norm(off):.0f} m from its stated position; see "
            "base_position",
            key="raw.base_position",
        )
    return off, sigma


def _check_dates(obs: Observations, nav: Ephemerides | None, precise: Orbits | None, sources: Sources) -> None:
    """Check that observations and ephemerides are of the same days.

    Raises
    ------
    RecordingError
        If they are not.
    """
    begin, end = float(obs.t[0]) + obs.zero, float(obs.t[-1]) + obs.zero
    for file, times in (
        (sources.nav, [] if nav is None else [*nav.kepler["toe"], *nav.glonass["toe"]]),
        (sources.sp3, [] if precise is None else [x for t, _ in precise.orbit.values() for x in t[[0, -1]]]),
    ):
        if not len(times):
            continue
        low, high = float(np.min(times)), float(np.max(times))
        apart = max(low - end, begin - high)
        if apart > 6.0 * 3600.0 and not file:  # a log, whose ephemerides have no week of their own
            raise RecordingError(
                f"{sources.rover[0]}: its ephemerides are {apart / 86400.0:.1f} days from its observations: the times "
                "of its RXM-RAWX messages are wrong",
                key="raw.ephemeris_day",
            )
        if apart > 6.0 * 3600.0:
            raise RecordingError(
                f"{file[0]}: its ephemerides are {apart / 86400.0:.1f} days from the observations of "
                f"{sources.rover[0].name}; it must be of the same day",
                key="raw.ephemeris_day",
            )


def _locate_roughly(obs: Observations, nav: Ephemerides | None, precise: Orbits | None, corrected: Corrected) -> Array:
    """(3,) m in e, approximate position of the rover, from the codes of a few epochs."""
    epochs = np.unique(obs.t)
    few = obs.take(np.isin(obs.t, epochs[:: max(1, len(epochs) // _ROUGH_EPOCHS)]))
    start = np.zeros(3) if obs.marker is None else obs.marker
    raw, _ = place(few, nav, precise, start, corrected)
    raw = raw.take(choose_primary(raw) & np.isfinite(raw.p[:, 0]))
    if not len(raw):
        return start
    if obs.marker is None:  # under its satellites
        middle = raw.p.mean(axis=0)
        raw = replace(raw, place=tuple(6.37e6 * middle / np.linalg.norm(middle)))
    places = solve(raw, mask=-np.pi).p
    found = np.nanmedian(places, axis=0) if np.isfinite(places).any() else start
    return np.asarray(found)


def _correct_times(raw: RawGnss, fixes: SinglePoint) -> tuple[RawGnss, SinglePoint]:
    """Series and solutions at the true times of reception: the receiver's stamps less its clock error."""
    epochs, of = raw.epochs
    # not interpolated: a receiver's clock jumps by whole milliseconds
    clock = _take_nearest(epochs, fixes.t, fixes.clock)
    drift = _take_nearest(epochs, fixes.t, fixes.drift) if np.isfinite(fixes.drift).any() else np.zeros(len(epochs))
    true = epochs - clock / C
    fixes = replace(fixes, t=true[np.searchsorted(epochs, fixes.t)])
    good = np.isfinite(fixes.p[:, 0])
    antenna = np.stack([np.interp(true, fixes.t[good], fixes.p[good, i]) for i in range(3)], -1)
    order: NDArray[np.intp] = np.argsort(true[of], kind="stable")
    raw = replace(raw, t=true[of], antenna=antenna[of], receiver_clock=np.stack([clock, drift], -1)[of])
    return raw.take(order), fixes


def _take_nearest(t: Array, known: Array, value: Array) -> Array:
    """(N,) at times t the value of the nearest known time."""
    known, value = known[np.isfinite(value)], value[np.isfinite(value)]
    return np.asarray(value[pick_nearest(known, t)])
