"""Inspection of a recording before it is solved: what it contains, and what is unusual, in plain words.

Each check is a small function that returns findings, none where the data are insufficient. Impossible rows are sought
first (`graphnav.recording.plausibility.screening`), and the rest is checked without them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from graphnav.core.findings import SEVERITIES, Finding, compute_period
from graphnav.core.notes import get_key
from graphnav.core.rotation import Array
from graphnav.recording import Recording
from graphnav.recording.checks import crosschecks, tracks
from graphnav.recording.checks.aiding import (
    check_gnss_coverage,
    check_gnss_jumps,
    check_odometer,
    measure_common_time,
)
from graphnav.recording.checks.axes import (
    check_gyro_sign,
    check_gyro_tilt,
    check_imu_axes,
    check_sideways,
    check_yaw_scale,
    turns_against,
)
from graphnav.recording.checks.clock import measure_clock_offsets
from graphnav.recording.checks.crosschecks import Fit
from graphnav.recording.checks.facts import format_facts, list_facts
from graphnav.recording.checks.imu import (
    check_foot_rate,
    check_force_at_rest,
    check_gyro_unit,
    check_imu_time,
    check_noise_at_rest,
    check_repeats,
    check_saturation,
)
from graphnav.recording.checks.places import check_frozen, check_height_unit, check_mirroring, find_mirrored
from graphnav.recording.checks.raw import check_raw
from graphnav.recording.checks.series import check_series
from graphnav.recording.checks.stated import (
    check_fix_types,
    check_lever_arms,
    check_platform,
    check_rounding,
    check_stated_noise,
    check_truth,
    check_velocities,
)
from graphnav.recording.checks.tracks import Track
from graphnav.recording.plausibility.screening import Screened, refuse, screen

_REST_WINDOW = 1.0  # s


@dataclass(frozen=True)
class Inspection:
    """The result of `inspect`; `facts` are per sensor, name -> value in SI units unless the name states otherwise."""

    name: str
    platform: str
    facts: dict[str, dict[str, Any]]
    recording: Recording = field(repr=False)  # what was inspected, without impossible rows
    findings: tuple[Finding, ...] = field(default=())

    @property
    def warnings(self) -> tuple[str, ...]:
        """The sentences of the warnings and of more severe findings."""
        return tuple(f.sentence for f in self.findings if f.severity != "note")

    @property
    def trusted(self) -> bool:
        """Whether there is no finding because of which a result may be entirely wrong."""
        return not self.list_defects()

    def list_defects(self, *severities: str) -> list[str]:
        """A line for each finding because of which a result may be entirely wrong.

        Parameters
        ----------
        severities
            Of these alone: "unreliable", "refused"; both when none is named.

        Returns
        -------
        list of str
            Severity and sentence.
        """
        asked = severities or ("unreliable", "refused")
        return [f"{f.severity}: {f.sentence}" for f in self.findings if f.severity in asked]

    def refuse(self) -> None:
        """Raise an error if the recording cannot be solved.

        Raises
        ------
        RecordingError
            With the first refused finding's sentence.
        """
        refuse(self.recording, self.findings)

    def to_dict(self) -> dict[str, Any]:
        """The inspection for JSON.

        Returns
        -------
        dict
            Facts by sensor, and findings.
        """
        findings = [f.to_dict() for f in self.findings]
        return {"name": self.name, "platform": self.platform, **self.facts, "findings": findings}

    def format(self) -> str:
        """The inspection for a terminal.

        Returns
        -------
        str
            Several lines.
        """
        lines = [f"{self.name} ({self.platform})"]
        for sensor, facts in self.facts.items():
            lines.append(f"  {sensor:<9} {', '.join(format_facts(facts))}")
        for finding in self.findings:
            lines.append(f"  {finding.severity}: {finding.sentence}")
        return "\n".join(lines)


@dataclass(frozen=True)
class _Evidence:
    """What several checks judge by."""

    recording: Recording  # without impossible rows, and without sensors that are then empty
    known: frozenset[str]  # keys of what screening has found
    track: Track | None  # by the fixes, as they are
    overlap: bool  # whether fixes and IMU share some time
    rest: Array  # (N,) which rows of the IMU are at rest
    wrong: tuple[Finding, ...]  # of positions and velocities that contradict each other

    @property
    def vehicle(self) -> bool:
        """Whether this is no walk."""
        return self.recording.platform == "vehicle"


@dataclass(frozen=True)
class _Motion:
    """How a vehicle moves by its fixes, and how the IMU fits that."""

    track: Track
    yaw: Fit | None  # changes of course on the gyro
    forward: Fit | None  # changes of speed on the force


def inspect(recording: Recording, screened: Screened | None = None) -> Inspection:
    """Check a recording before solving.

    Parameters
    ----------
    recording
        As read.
    screened
        What `screen` makes of it, if that is known.

    Returns
    -------
    Inspection
        Facts by sensor, the recording without impossible rows, and findings: the most severe first, then in the
        order of the checks, beginning with the loader's remarks.
    """
    whole = screened or screen(recording)
    used, empty = _leave_out_empty(whole.recording)
    evidence = _gather_evidence(used, whole)
    motion = _fit_motion(evidence, whole)
    facts = list_facts(used, evidence.track)
    findings = [
        *(Finding("note", remark, get_key(remark) or "recording.remark") for remark in whole.recording.remarks),
        *whole.findings,
        *empty,
        *check_imu_time(recording.imu),  # rows left out have been reported already
        *_check_imu(evidence, facts["imu"]),
        *_check_fixes(evidence),
        *(check_raw(used.raw_gnss) if used.raw_gnss is not None and len(used.raw_gnss) else ()),
        *_check_motion(evidence, motion),
    ]
    if used.odometer is not None:
        findings += check_odometer(used, evidence.track if motion is None else motion.track, facts["odometer"])
    findings += check_series(used)
    if used.truth is not None:
        findings += check_truth(used)
    if any(f.severity != "note" for f in findings) and not used.has_keys:
        findings.append(
            Finding(
                "note",
                "keys in brackets belong in a recording.toml, which this log does not have: graphnav init "
                f"{used.source} drafts one",
                "recording.log",
            )
        )
    findings.sort(key=lambda f: SEVERITIES.index(f.severity))
    return Inspection(used.name, used.platform, facts, whole.recording, tuple(findings))


def _leave_out_empty(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The recording without sensors that hold no rows, and a warning for each."""
    empty = [name for name, sensor in recording.aiding.items() if not len(sensor.t)]
    for name in empty:
        recording = recording.without(name)
    words = "holds no rows in this part of the recording"
    return recording, [Finding("warning", f"[{name}] {words}", f"{name}.empty") for name in empty]


def _gather_evidence(recording: Recording, whole: Screened) -> _Evidence:
    gnss = recording.gnss
    overlap = gnss is not None and measure_common_time(recording) > 0
    track = tracks.compute_track(gnss) if gnss is not None else None
    wrong = find_mirrored(recording, list(check_velocities(gnss))) if gnss is not None else ()
    rest = _find_rest(recording, track if overlap else None)
    return _Evidence(recording, frozenset(f.key for f in whole.findings), track, overlap, rest, tuple(wrong))


def _fit_motion(evidence: _Evidence, whole: Screened) -> _Motion | None:
    """The motion by the fixes; None on foot, without fixes, or where the IMU cannot tell the vertical."""
    gnss, imu, track = evidence.recording.gnss, evidence.recording.imu, evidence.track
    upright = not evidence.known & {"imu.force_scale", "imu.dead_axis"}
    if not (evidence.vehicle and evidence.overlap and upright) or gnss is None or track is None:
        return None
    clock = whole.clock or measure_clock_offsets(imu, gnss)
    yaw = whole.yaw or crosschecks.fit_yaw_rate(imu, track)
    if any(f.key in ("gnss.velocity_axes", "gnss.velocity_unit") for f in evidence.wrong):
        # the comparison of such velocities with the IMU is meaningless
        track = tracks.compute_track(replace(gnss, v=None)) or track
        yaw = crosschecks.fit_yaw_rate(imu, track)
    return _Motion(track, yaw, clock.by_velocity if track.instant else clock.by_places)


def _check_imu(evidence: _Evidence, facts: dict[str, Any]) -> Iterator[Finding]:
    """Checks of the IMU by itself and at rest, and of stated figures; `facts` of the rest are added."""
    recording, imu, known = evidence.recording, evidence.recording.imu, evidence.known
    yield from check_repeats(imu, evidence.track if evidence.overlap else None)
    yield from check_saturation(imu)
    yield from check_foot_rate(recording)
    if "imu.gyro_unit" not in known:
        yield from check_gyro_unit(recording)
    yield from check_stated_noise(imu.noise)
    yield from check_lever_arms(recording)
    if "imu.force_scale" not in known:
        yield from check_platform(recording, evidence.track)
    if evidence.rest.any():
        facts["still_s"] = float(evidence.rest.sum() * compute_period(imu.t))
        yield from check_force_at_rest(recording, evidence.rest, facts)
        if evidence.vehicle:  # a standing person sways
            yield from check_noise_at_rest(imu, evidence.rest)


def _check_fixes(evidence: _Evidence) -> Iterator[Finding]:
    """Checks of the fixes by themselves."""
    recording, gnss = evidence.recording, evidence.recording.gnss
    if gnss is None:
        return
    yield from check_gnss_coverage(recording)
    yield from check_rounding(gnss)
    yield from check_frozen(recording)
    yield from check_fix_types(gnss)
    # against wrong velocities, or on another clock, every position would jump
    if evidence.overlap:
        yield from evidence.wrong or check_gnss_jumps(recording, evidence.track)


def _check_motion(evidence: _Evidence, motion: _Motion | None) -> Iterator[Finding]:
    """Checks of the IMU's axes, signs and scale, and of positions, against the drive."""
    recording, imu = evidence.recording, evidence.recording.imu
    # with wrong axes, or forces without gravity, the axes are not judged again
    turned = evidence.known & {"imu.forward_reversed", "imu.axes_turned", "imu.dead_axis", "imu.force_scale"}
    if motion is None:
        if evidence.vehicle and not turned:
            yield from check_imu_axes(imu, None, None)
        return
    track, yaw, forward = motion.track, motion.yaw, motion.forward
    turns_back = turns_against(yaw)
    turns_so = yaw is not None and yaw.correlation > 0.8 and not turns_back
    if not turns_so and (mirrored := list(check_mirroring(recording, track, turns_back))):
        yield from mirrored
    elif not turned:
        if turns_back:
            yield from check_gyro_sign(imu, track)
        else:
            wrong = list(check_imu_axes(imu, forward, track)) or list(check_sideways(imu, forward, track, yaw))
            yield from wrong or check_gyro_tilt(imu, track)
        if "imu.gyro_unit" not in evidence.known:
            yield from check_yaw_scale(yaw)
        yield from check_height_unit(recording, track, forward)


def _find_rest(recording: Recording, track: Track | None) -> Array:
    """IMU rows in quiet seconds: near the quietest part of the recording, and not moving where the speed is known."""
    imu = recording.imu
    period = compute_period(imu.t)
    n = max(5, round(_REST_WINDOW / period))
    blocks = len(imu.t) // n
    mask = np.zeros(len(imu.t), dtype=bool)
    if blocks < 3:
        return mask

    def measure_scatter(x: Array) -> Array:
        axes = np.ascontiguousarray(x[: blocks * n].T).reshape(3, blocks, n)
        return np.linalg.norm(axes.std(axis=-1), axis=0)

    force, rate = measure_scatter(imu.accel), measure_scatter(imu.gyro)
    quiet = (force < 4.0 * np.percentile(force, 2) + 0.02) & (rate < 4.0 * np.percentile(rate, 2) + 0.002)
    middle = imu.t[: blocks * n].reshape(blocks, n).mean(axis=1)
    if recording.odometer is not None:
        o = recording.odometer
        quiet &= np.abs(np.interp(middle, o.t, o.speed, left=np.inf, right=np.inf)) < 0.05
    elif track is not None:
        quiet &= np.interp(middle, track.t, track.speed, left=np.inf, right=np.inf) < 0.3
    else:  # with an IMU alone, stillness must be obvious
        quiet &= (force < 0.3) & (rate < 0.03)
    mask[: blocks * n] = np.repeat(quiet, n)
    return mask
