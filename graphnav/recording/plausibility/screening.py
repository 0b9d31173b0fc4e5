"""Impossible rows are found before anything is solved: masked where the rest can be solved, otherwise refused.

`screen` processes a recording once. Single rows that no sensor can have read are removed, as if they had never been
logged, with a note; a sensor that is wrong throughout, so that every state would be, is a *refused* finding, which
`screen_recording` raises. Nothing is corrected by a guess.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graphnav.core.earth import STANDARD_GRAVITY, gravity
from graphnav.core.errors import RecordingError
from graphnav.core.findings import Finding, find_runs
from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.recording import Imu, Recording, take_rows
from graphnav.recording.checks import crosschecks, tracks
from graphnav.recording.checks.aiding import check_imu_clock, measure_common_time
from graphnav.recording.checks.axes import check_forward_sign, check_yaw_scale
from graphnav.recording.checks.clock import FAIR, ClockOffsets, measure_clock_offsets
from graphnav.recording.checks.crosschecks import Fit
from graphnav.recording.checks.series import screen_series
from graphnav.recording.checks.tilt import NEAR_FACTOR
from graphnav.recording.checks.tracks import Track
from graphnav.recording.formats.schema import FORCE
from graphnav.recording.formats.stamps import describe_packets, find_repeats, spread_packets
from graphnav.recording.plausibility import fixes as plausibility_gnss
from graphnav.recording.plausibility import odometer as plausibility_odometer
from graphnav.recording.plausibility.dead_axes import check_dead_axes
from graphnav.recording.plausibility.filled import describe_filled, find_filled
from graphnav.recording.plausibility.readings import find_contradicted

# Limits of readings: no accelerometer for vehicles or feet has a range beyond 100 g (those for crash tests have 200 g
# and more, and cannot tell gravity from their own offset), and no gyro for them one beyond 4000 deg/s.
ACCEL_RANGE = 1000.0  # m/s^2
GYRO_RANGE = 70.0  # rad/s
_ISOLATED = 0.01  # share of the rows; above it the cause is not in single rows
_QUIET_PERCENTILE = 10.0  # percentile of the turn rate up to which a foot stands and a vehicle moves calmly
_STEADY = 0.7  # of a force that scatters by 45 deg; of real drives 0.99 and more with gravity, at most 0.5 without
_UNIT_RATIO = 1.2  # ratio of the force found and that of a unit: a biased sensor among vibration
_NO_GRAVITY = "gravity seems to have been removed from the accelerometer; graphnav needs the raw force"
_UNIT_FINDINGS = (
    "imu.gyro_unit",
    "imu.force_scale",
)  # findings of `check_imu_scale`: single rows cannot be judged then


@dataclass(frozen=True)
class Screened:
    """A recording without impossible rows, and findings."""

    recording: Recording
    findings: tuple[Finding, ...] = ()
    clock: ClockOffsets | None = None  # clock offset of the IMU against the fixes, where it was measured
    yaw: Fit | None = None  # changes of course on the gyro, likewise


ScreenedRows = tuple[Recording, list[Finding], list[Finding], Track | None]  # as of `screen_rows`


def refuse(recording: Recording, findings: tuple[Finding, ...]) -> None:
    """Raise an error if a recording cannot be solved.

    Raises
    ------
    RecordingError
        With the first refused finding's sentence.
    """
    for finding in findings:
        if finding.severity == "refused":
            draft = "" if recording.has_keys else f" (graphnav init {recording.source} drafts a recording.toml)"
            raise RecordingError(f"'{recording.name}': {finding.sentence}{draft}", key=finding.key)


def screen_recording(recording: Recording) -> tuple[Recording, list[str]]:
    """The recording without impossible rows.

    Parameters
    ----------
    recording
        As read.

    Returns
    -------
    recording : Recording
        Without rows that no sensor can have read.
    notes : list of str
        A sentence with a key for each finding.

    Raises
    ------
    RecordingError
        If a sensor is wrong throughout.
    """
    found = screen(recording)
    return found.recording, state_findings(recording, found.findings)


def state_findings(recording: Recording, findings: tuple[Finding, ...]) -> list[str]:
    """A sentence with a key for each finding.

    Raises
    ------
    RecordingError
        If a sensor is wrong throughout.
    """
    refuse(recording, findings)
    return [Note(f.key, f.sentence) for f in findings]


def screen(recording: Recording, rows: ScreenedRows | None = None) -> Screened:
    """Screen a recording for impossible rows.

    Parameters
    ----------
    recording
        As read; one that was screened before is returned as it is, without findings.
    rows
        By `screen_rows`, where they are known.

    Returns
    -------
    Screened
        The recording without what cannot be right, and the findings.
    """
    if recording.screened:
        return Screened(recording)
    recording, of_imu, of_aiding, track = rows or screen_rows(recording)
    dead, clock = list(check_dead_axes(recording)), None
    yaw: Fit | None = None
    findings = [*of_imu, *dead, *of_aiding]
    wrong_unit = any(f.key in _UNIT_FINDINGS for f in of_imu)
    if recording.platform == "vehicle" and not dead and not wrong_unit:
        path = track
        if path is None and recording.odometer is not None:
            path = plausibility_odometer.build_odometer_track(recording.odometer)
        # stamps with varying delays have no clock offset
        if track is not None and not any(f.key == "gnss.stamped_on_arrival" for f in findings):
            assert recording.gnss is not None
            odometer = crosschecks.fit_odometer(recording.odometer, track) if recording.odometer is not None else None
            clock = replace(
                measure_clock_offsets(recording.imu, recording.gnss),
                by_odometer=None if odometer is None else odometer[0],
            )
            forward = clock.by_velocity if track.instant else clock.by_places
        else:
            forward = crosschecks.fit_forward(recording.imu, path) if path is not None else None
        findings += check_forward_sign(recording.imu, path, forward)
        yaw = None if track is None else crosschecks.fit_yaw_rate(recording.imu, track)
        findings += [finding for finding in check_yaw_scale(yaw) if finding.severity == "refused"]
        if clock is not None:
            findings += check_imu_clock(clock)
    return Screened(recording, tuple(findings), clock, yaw)


def screen_rows(recording: Recording) -> ScreenedRows:
    """The recording without impossible rows, findings on the IMU and on the others, and the track by the fixes."""
    imu, packets = spread_rows_read_at_once(recording.imu)
    recording = replace(recording, imu=imu)
    of_imu: list[Finding] = list(check_imu_scale(recording))
    if not of_imu:  # where a unit is wrong throughout, single rows cannot be judged
        imu, spikes = drop_spikes(recording.imu, recording.start)
        imu, filled = drop_filled(imu, recording.start)
        imu, contradicted = drop_contradicted(imu, recording.start, forces=recording.platform != "foot")
        recording, of_imu = replace(recording, imu=imu), [*packets, *spikes, *filled, *contradicted]
    recording, of_aiding = screen_series(replace(recording, screened=True))
    track = None
    if recording.gnss is not None and len(recording.gnss.t):
        recording, more = plausibility_gnss.screen_fixes(recording)
        of_aiding += more
        assert recording.gnss is not None
        track = tracks.compute_track(recording.gnss)
        if track is not None and measure_common_time(recording) <= 0:
            track = None
    if recording.odometer is not None and len(recording.odometer.t):
        recording, more = plausibility_odometer.screen_odometer(recording, track)
        of_aiding += more
    return recording, of_imu, of_aiding, track


def spread_rows_read_at_once(imu: Imu) -> tuple[Imu, list[Finding]]:
    """The IMU with rows evenly between the times at which a program read several at once, as readers of files do."""
    repeats = find_repeats({"gyro": imu.gyro, "accel": imu.accel, "t": imu.t})
    if (spread := spread_packets(imu.t, repeats)) is None:
        return imu, []
    return replace(imu, t=spread[0]), [Finding("note", describe_packets(spread[1]), "imu.packets")]


def check_imu_scale(recording: Recording) -> Iterator[Finding]:
    """A force at rest that is not gravity, and a turn rate that no sensor reads: units and scales."""
    imu = recording.imu
    wild = np.zeros(len(imu.t), dtype=bool)
    for x in imu.gyro.T:  # axis by axis, here and below: for a day each takes a hundred megabytes
        wild |= ~(np.abs(x) <= GYRO_RANGE)
    beyond = float(wild.mean())
    if beyond > _ISOLATED:
        yield Finding(
            "refused",
            f"the gyro reads more than {GYRO_RANGE:g} rad/s, which no sensor of a vehicle or a foot does, in "
            f'{100 * beyond:.0f} % of the rows: if it is deg/s, set units = {{ gyro = "deg/s" }} in [imu]',
            "imu.gyro_unit",
        )
    with np.errstate(over="ignore", invalid="ignore"):
        turn = np.zeros(len(imu.t))
        for x in imu.gyro.T:
            turn += (x - np.median(x)) ** 2
        np.sqrt(turn, out=turn)
        quiet = turn <= np.percentile(turn, _QUIET_PERCENTILE)
        f = float(np.median(np.linalg.norm(imu.accel[quiet], axis=1)))
    steady = float(np.linalg.norm(imu.accel[quiet].mean(axis=0))) / max(f, 1e-9)
    period = float(np.median(np.diff(imu.t))) if steady > _STEADY else None
    if (sentence := _find_scale(f, period)) is not None:
        sentence = _NO_GRAVITY if _lacks_gravity(recording, f, steady) else sentence
        g = STANDARD_GRAVITY if recording.gnss is None else _measure_gravity(recording)
        yield Finding(
            "refused",
            f"the specific force where it is calm is {f:.3g} m/s2 (median), not {g:.1f}: {sentence}",
            "imu.force_scale",
        )


def _lacks_gravity(recording: Recording, f: float, steady: float) -> bool:
    """Whether a force of f m/s^2 in calm is without gravity: it has no direction that stays (`steady`, the size of its
    mean over f, is small), or its scale is right otherwise, by the fixes' accelerations.
    """
    gnss, imu = recording.gnss, recording.imu
    if f > STANDARD_GRAVITY:
        return False
    if steady < _STEADY and recording.platform == "vehicle":
        return True
    if gnss is None or measure_common_time(recording) <= 0:
        return False
    track = tracks.compute_track(gnss) if (np.abs(imu.accel) < ACCEL_RANGE).all() else None
    fit = None if track is None else crosschecks.fit_force(imu, track)
    if fit is None or fit.correlation < FAIR:
        return False
    size = float(np.log(np.linalg.norm(fit.coefficients)))  # ratio of the true acceleration to the measured one
    return abs(size) < abs(size + np.log(f / STANDARD_GRAVITY))


def _measure_gravity(recording: Recording) -> float:
    """Gravity where most fixes are, m/s^2."""
    assert recording.gnss is not None
    there = recording.gnss.llh[np.isfinite(recording.gnss.llh).all(axis=1)]
    return float(gravity(*np.median(there, axis=0)[[0, 2]])) if len(there) else STANDARD_GRAVITY


def _find_scale(f: float, period: float | None) -> str | None:
    """The likely unit or scale of a force at rest that is not gravity; None if it is.

    A steady one over `period`, s, may be an increment of velocity.
    """
    g = STANDARD_GRAVITY
    if NEAR_FACTOR[0] < f / g < NEAR_FACTOR[1]:
        return None
    units = {g / size: f'the accelerometer seems to be in {name}: set units = {{ accel = "{name}" }}'
             for name, size in FORCE.items() if size > 0.0 and name != "m/s2"}  # fmt: skip
    units[g * FORCE["g"]] = "the accelerometer seems to be in m/s2 already: leave out units.accel"
    near = min(units, key=lambda value: abs(np.log(max(f, 1e-9) / value)))
    if 1.0 / _UNIT_RATIO < f / near < _UNIT_RATIO:
        return f"{units[near]} in [imu]"
    if period is not None and 1.0 / _UNIT_RATIO < f / (g * period) < _UNIT_RATIO:
        return (
            'these are increments of velocity, of a sample each: set units = { gyro = "rad", accel = "m/s" } in [imu]'
        )
    if f < g / FORCE["g"]:
        return _NO_GRAVITY
    step = round(float(np.log2(f / g))) if np.isfinite(f) else 0
    if step and 1.0 / _UNIT_RATIO < f / (g * 2.0**step) < _UNIT_RATIO:
        times = f"{2 ** abs(step)} times too {'large' if step > 0 else 'small'}"
        return (
            f"the accelerometer's scale is {times}, as of another full-scale range: no units.accel mends that, "
            f"multiply ax, ay and az by {2.0**-step:g} in the file"
        )
    return "the accelerometer's scale is wrong: look at units.accel in [imu] and at the range that was set"


def drop_spikes(imu: Imu, start: float) -> tuple[Imu, list[Finding]]:
    """The IMU without rows that no sensor can have read; the gaps are bridged."""
    gyro, accel = ~(np.abs(imu.gyro) <= GYRO_RANGE), ~(np.abs(imu.accel) <= ACCEL_RANGE)
    bad: NDArray[np.bool_] = np.asarray((gyro | accel).any(axis=1))
    if not bad.any():
        return imu, []
    k = int(np.flatnonzero(bad)[0])
    name, unit, values, wild, most = (
        ("accelerometer", "m/s2", imu.accel, accel, ACCEL_RANGE)
        if accel[k].any()
        else ("gyro", "rad/s", imu.gyro, gyro, GYRO_RANGE)
    )
    value = values[k][wild[k]][0]
    sentence = (
        f"{_list_rows(bad)} that no sensor can have read (the first, of the {name}, {value:.4g} {unit} at "
        f"{imu.t[k] - start:.2f} s from the start; {most:g} {unit} is beyond any range)"
    )
    if bad.mean() > _ISOLATED:
        return imu, [Finding("refused", f"{sentence}: more than can be bridged; look at the log", "imu.spike")]
    return take_rows(imu, ~bad), [Finding("warning", f"{sentence}: left out, as a gap", "imu.spike")]


def drop_filled(imu: Imu, start: float) -> tuple[Imu, list[Finding]]:
    """The IMU without rows that no sensor measured; the gaps are bridged."""
    filled, _ = find_filled(imu.t, _list_axes(imu, True))
    if not filled.any():
        return imu, []
    runs = find_runs(filled)
    longest, first = max((float(imu.t[b - 1] - imu.t[a]), float(imu.t[a])) for a, b in runs)
    where = f"{first - start:.1f} s"
    return take_rows(imu, ~filled), [describe_filled(int(filled.sum()), len(runs), longest, where)]


def drop_contradicted(imu: Imu, start: float, forces: bool) -> tuple[Imu, list[Finding]]:
    """The IMU without single rows that the rows before and after contradict; the gaps are bridged.

    With `forces`, also of the accelerometer: a hit on tyres and springs lasts for more than a row, unlike one on a
    foot, and no hit turns a body back and forth.
    """
    bad = find_contradicted(imu.t, _list_axes(imu, forces))
    if not bad.any():
        return imu, []
    first = float(imu.t[bad][0]) - start
    sentence = f"{_list_rows(bad)} contradicted by the rows before and after (first {first:.2f} s from the start)"
    return take_rows(imu, ~bad), [Finding("note", f"{sentence}: treated as a gap", "imu.contradicted")]


def _list_axes(imu: Imu, forces: bool) -> Iterator[Array]:
    """Readings (N,) along each axis of the gyro and, with `forces`, of the accelerometer, in the file's axes."""
    for values in (imu.gyro, imu.accel) if forces else (imu.gyro,):
        for axis in range(3):
            yield values @ imu.R_bs[:, axis]


def _list_rows(bad: NDArray[np.bool_]) -> str:
    return format_count(bad.sum(), "IMU row")
