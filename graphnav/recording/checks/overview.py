"""Inspection of a recording before it is solved: what it contains, and what is unusual, in plain words.

Each check is a small function that returns findings, none where the data are insufficient. Impossible rows are sought
first (`graphnav.recording.plausibility.screening`), and the rest is checked without them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from graphnav.core.findings import SEVERITIES, Finding, compute_period, find_gap_limit, find_runs
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
from graphnav.recording.checks.raw import check_raw, describe_raw
from graphnav.recording.checks.series import check_series, describe_series
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
            lines.append(f"  {sensor:<9} {', '.join(_format_numbers(facts))}")
        for finding in self.findings:
            lines.append(f"  {finding.severity}: {finding.sentence}")
        return "\n".join(lines)


_VALUE_UNITS = {"hz": "Hz", "s": "s", "m": "m", "mps": "m/s", "mps2": "m/s2", "dbhz": "dB-Hz"}


def _format_numbers(facts: dict[str, Any]) -> Iterator[str]:
    """Each fact with its name, of which words that the name before begins with too are not repeated."""
    before = ""
    for name, value in facts.items():
        words, said = name.split("_"), before.split("_")
        common = next((k for k, (a, b) in enumerate(zip(words[:-1], said, strict=False)) if a != b), len(words) - 1)
        yield _format_number("_".join(words[min(common, len(words) - 1) :]) if len(said) > 1 else name, value)
        before = name


def _format_number(name: str, value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(_format_number(*one) for one in value.items())
    words = name.split("_")
    unit = _VALUE_UNITS.get(words[-1], "") if len(words) > 1 else ""
    number = f"{value:.6g}" if isinstance(value, float) else str(value)
    return f"{' '.join(words[:-1] if unit else words)} {number} {unit}".rstrip()


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
    stamps, whole = recording.imu, screened or screen(recording)
    recording = whole.recording
    findings = [Finding("note", remark, get_key(remark) or "recording.remark") for remark in recording.remarks]
    findings += whole.findings
    for name, sensor in recording.aiding.items():
        if not len(sensor.t):
            findings.append(
                Finding("warning", f"[{name}] holds no rows in this part of the recording", f"{name}.empty")
            )
            recording = recording.without(name)
    known = {f.key for f in whole.findings}
    facts: dict[str, dict[str, Any]] = {"imu": _describe_imu(recording)}
    vehicle = recording.platform == "vehicle"
    overlap = recording.gnss is not None and measure_common_time(recording) > 0
    track = tracks.compute_track(recording.gnss) if recording.gnss is not None else None
    rest = _find_rest(recording, track if overlap else None)
    findings += check_imu_time(stamps)  # rows left out have been reported already
    findings += check_repeats(recording.imu, track if overlap else None)
    findings += check_saturation(recording.imu)
    findings += check_foot_rate(recording)
    if "imu.gyro_unit" not in known:
        findings += check_gyro_unit(recording)
    findings += check_stated_noise(recording.imu.noise)
    findings += check_lever_arms(recording)
    findings += [] if "imu.force_scale" in known else check_platform(recording, track)
    if rest.any():
        facts["imu"]["still_s"] = float(rest.sum() * compute_period(recording.imu.t))
        findings += check_force_at_rest(recording, rest, facts["imu"])
        if vehicle:  # a standing person sways
            findings += check_noise_at_rest(recording.imu, rest)
    if recording.gnss is not None:
        facts["gnss"] = _describe_gnss(recording, track)
        findings += check_gnss_coverage(recording)
        findings += check_rounding(recording.gnss)
        findings += check_frozen(recording)
        findings += check_fix_types(recording.gnss)
        wrong = find_mirrored(recording, list(check_velocities(recording.gnss)))
        if overlap or not wrong:
            # against wrong velocities, or on another clock, every position would jump
            findings += wrong or (check_gnss_jumps(recording, track) if overlap else ())
    if recording.raw_gnss is not None and len(recording.raw_gnss):
        facts["raw_gnss"] = describe_raw(recording.raw_gnss)
        findings += check_raw(recording.raw_gnss)
    # with wrong axes, or forces without gravity, this test does not apply
    turned = known & {"imu.forward_reversed", "imu.axes_turned", "imu.dead_axis", "imu.force_scale"}
    # otherwise the turn rate about the vertical is unknown as well
    upright = not known & {"imu.force_scale", "imu.dead_axis"}
    if vehicle and overlap and track is not None and recording.gnss is not None and upright:
        clock = whole.clock or measure_clock_offsets(recording.imu, recording.gnss)
        yaw = whole.yaw or crosschecks.fit_yaw_rate(recording.imu, track)
        if any(
            f.key in ("gnss.velocity_axes", "gnss.velocity_unit") for f in wrong
        ):  # their comparison with the IMU is meaningless
            track = tracks.compute_track(replace(recording.gnss, v=None)) or track
            yaw = crosschecks.fit_yaw_rate(recording.imu, track)
        forward = clock.by_velocity if track.instant else clock.by_places
        turns_back = turns_against(yaw)
        turns_so = yaw is not None and yaw.correlation > 0.8 and not turns_back
        if not turns_so and (mirrored := list(check_mirroring(recording, track, turns_back))):
            findings += mirrored
        elif not turned:
            if turns_back:
                findings += check_gyro_sign(recording.imu, track)
            else:
                wrong = list(check_imu_axes(recording.imu, forward, track))
                wrong = wrong or list(check_sideways(recording.imu, forward, track, yaw))
                findings += wrong or check_gyro_tilt(recording.imu, track)
            findings += [] if "imu.gyro_unit" in known else check_yaw_scale(yaw)
            findings += check_height_unit(recording, track, forward)
    elif vehicle and not turned:
        findings += check_imu_axes(recording.imu, None, None)
    if recording.odometer is not None:
        facts["odometer"] = _describe_sensors(recording.odometer.t)
        step, speed = np.diff(recording.odometer.t), np.abs(recording.odometer.speed)
        facts["odometer"]["distance_m"] = round(float(np.sum(0.5 * (speed[1:] + speed[:-1]) * step)), 1)
        facts["odometer"]["max_speed_mps"] = float(np.abs(recording.odometer.speed).max())
        findings += check_odometer(recording, track, facts["odometer"])
    facts |= {name: describe_series(series) for name, series in recording.sensors.items()}
    findings += check_series(recording)
    if recording.truth is not None:
        facts["truth"] = {"rows": len(recording.truth.t), "of": str(recording.truth.of)}
        if recording.truth.closed_loop_sigma:
            facts["truth"] = {"closed_loop_sigma_m": recording.truth.closed_loop_sigma}
        findings += check_truth(recording)
    if any(f.severity != "note" for f in findings) and not recording.has_keys:
        findings.append(
            Finding(
                "note",
                "keys in brackets belong in a recording.toml, which this log does not have: graphnav init "
                f"{recording.source} drafts one",
                "recording.log",
            )
        )
    findings.sort(key=lambda f: SEVERITIES.index(f.severity))
    return Inspection(recording.name, recording.platform, facts, whole.recording, tuple(findings))


def _describe_sensors(t: Array) -> dict[str, Any]:
    return {"rows": len(t), "rate_hz": round(1.0 / compute_period(t), 3), "span_s": round(float(t[-1] - t[0]), 3)}


def _describe_imu(recording: Recording) -> dict[str, Any]:
    facts = _describe_sensors(recording.imu.t)
    facts["duration_s"] = round(recording.duration, 3)
    step = np.diff(recording.imu.t)
    facts["gaps"] = int((step > find_gap_limit(recording.imu.t)).sum())
    facts["longest_step_s"] = round(float(step.max()), 4)
    return facts


def _describe_gnss(recording: Recording, track: Track | None) -> dict[str, Any]:
    gnss = recording.gnss
    assert gnss is not None
    facts: dict[str, Any] = {"rows": 1} if len(gnss.t) == 1 else _describe_sensors(gnss.t)
    facts["velocities"] = 0 if gnss.v is None else int((~np.isnan(gnss.v[:, 0])).sum())
    if gnss.types:
        facts["types"] = gnss.types
    if track is not None:
        dt = np.diff(track.t)
        near = dt < 5 * max(1.0, track.period)
        usable = track.speed < 100.0
        speed = track.speed
        distance = np.sum((0.5 * (speed[1:] + speed[:-1]) * dt)[near])
        facts["distance_m"] = round(float(distance), 1)
        facts["max_speed_mps"] = round(float(np.percentile(speed[usable], 99.9)), 2) if usable.any() else float("nan")
        stopped = find_runs(speed < 0.3)
        stops = [(a, b) for a, b in stopped if track.t[b - 1] - track.t[a] >= 2.0]
        facts["stops"] = len(stops)
        facts["stopped_s"] = round(float(sum(track.t[b - 1] - track.t[a] for a, b in stops)), 1)
    return facts


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
