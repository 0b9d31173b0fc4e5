"""Checks of GNSS and odometer, and of the IMU against them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from graphnav.config.gnss import GnssSettings
from graphnav.core.findings import Finding, compute_period, describe_gaps
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array
from graphnav.core.timescales import NEAR, WEEK, compute_clock_offset
from graphnav.recording import Imu, Odometer, Recording
from graphnav.recording import odometer as wheels
from graphnav.recording.checks import crosschecks, tracks
from graphnav.recording.checks.clock import FAIR, ODOMETER_AGREES, ClockOffsets
from graphnav.recording.checks.tracks import Track
from graphnav.recording.odometer.faults import FROZEN, GAP, STUCK, WILD
from graphnav.sensors.tables import TIME_UNITS

_CERTAIN_SIGMAS = 4.0  # sigmas
_MIN_SPEED = 5.0  # m/s, above which wheel speeds are compared
_SELDOM = 10.0  # s between fixes; no receiver on a drive is set to a longer period


def measure_common_time(recording: Recording) -> float:
    """How long fixes and IMU overlap, s; below zero if they do not, or only by stamps in another unit."""
    assert recording.gnss is not None
    t = recording.gnss.t
    if _describe_large_steps(t, recording) is not None:
        return -1.0
    return float(min(t[-1], recording.end) - max(t[0], recording.start))


def describe_gnss_apart(recording: Recording) -> str | None:
    """A finding that GNSS and IMU share no time, with a likely remedy; None if they do."""
    gnss, raw = recording.gnss, recording.raw_gnss
    own = gnss is not None and not gnss.derived  # computed by a receiver, not from raw observations
    t = raw.t if raw is not None and not own else gnss.t if gnss is not None else np.empty(0)
    if not len(t):
        return None
    if min(t[-1], recording.end) >= max(t[0], recording.start):
        return _describe_large_steps(t, recording) if own else None
    offset = recording.start - t[0]
    apart = (
        f"GNSS ({t[0]:.3f} to {t[-1]:.3f} s) and IMU ({recording.start:.3f} to {recording.end:.3f} s) do not "
        "overlap in time"
    )
    if not own:  # from raw observations, which carry the date
        weeks = round(offset / WEEK)
        near = f", {abs(weeks)} week(s) too {'late' if weeks > 0 else 'early'}" if weeks else ""
        return f"{apart}: the observations' times are GPS time, so clock, the date of the IMU's t = 0, is wrong{near}"
    known = compute_clock_offset(recording.start, recording.gps_zero, float(t[0]), None)
    if (unit := _guess_stamp_unit(t, recording)) is not None:
        return f'{apart}: the stamps of the fixes are in {unit}; set units = {{ t = "{unit}" }} in [gnss]'
    left = t[0] + known.offset - recording.start if known is not None else np.inf
    if known is not None and abs(left) < NEAR:
        return (
            f"{apart}: {known.words}; set time_offset = {known.offset:.0f} in [gnss], with which "
            f"GNSS starts {abs(left):.2f} s {'after' if left > 0 else 'before'} the IMU"
        )
    hours = round(offset / 1800.0) / 2.0
    local = (
        f"; {abs(hours):g} h apart, one may be in local time" if hours and abs(offset - 3600.0 * hours) < 60.0 else ""
    )
    return f"{apart}; if their clocks differ, set time_offset in [gnss] ({offset:.3f} would start both together){local}"


def _describe_large_steps(t: Array, recording: Recording) -> str | None:
    """Report that most fixes lie outside the IMU's time, but within it with stamps in another unit; else None."""
    unit = _guess_stamp_unit(t, recording)
    outside = float(np.mean((t < recording.start) | (t > recording.end)))
    if unit is None or outside < 0.5 or len(t) < 2 or not np.median(np.diff(t)) > _SELDOM:
        return None
    return (
        f"{100 * outside:.0f} % of the fixes lie outside the time of the IMU ({recording.start:.3f} to "
        f"{recording.end:.3f} s), and within it if their stamps are in {unit}: "
        f'set units = {{ t = "{unit}" }} in [gnss]'
    )


def _guess_stamp_unit(t: Array, recording: Recording) -> str | None:
    """The unit of stamps with which they would lie within the recording, if they do not in s."""
    for unit, scale in TIME_UNITS.items():
        inside = (scale * t > recording.start) & (scale * t < recording.end)
        if unit != "s" and inside.mean() > 0.5:
            return unit
    return None


def check_gnss_coverage(recording: Recording) -> Iterator[Finding]:
    gnss = recording.gnss
    assert gnss is not None
    if (sentence := describe_gnss_apart(recording)) is not None:
        yield Finding("warning", sentence, "gnss.clock")
        return
    inside = int(np.sum((gnss.t >= recording.start) & (gnss.t <= recording.end)))
    if inside < 0.5 * len(gnss.t):
        yield Finding(
            "warning",
            f"the IMU covers {inside} of {format_count(len(gnss.t), 'fix', 'fixes')} "
            f"({recording.start:.3f} to {recording.end:.3f} s of "
            f"{gnss.t[0]:.3f} to {gnss.t[-1]:.3f} s): the rest is not used; is its file whole?",
            "gnss.beyond_imu",
        )
    for late, what in ((gnss.t[0] - recording.start, "starts"), (recording.end - gnss.t[-1], "ends")):
        if late > 5.0:
            yield Finding(
                "note", f"GNSS {what} {late:.1f} s {'after' if what == 'starts' else 'before'} the IMU", "gnss.span"
            )
    if len(gnss.t) < 3:
        return
    step = np.diff(gnss.t)
    there = (gnss.t[1:] > recording.start) & (gnss.t[:-1] < recording.end)
    gaps = np.flatnonzero((step > max(3.5 * compute_period(gnss.t), 1.5)) & there)
    if len(gaps):
        yield Finding("note", describe_gaps("GNSS", step[gaps], gnss.t[gaps] - recording.start), "gnss.gap")


def check_gnss_jumps(recording: Recording, track: Track | None) -> Iterator[Finding]:
    """Fixes that no motion explains: a step against the velocities, or an impossible acceleration."""
    gnss = recording.gnss
    assert gnss is not None
    if track is None or len(gnss.t) < 5:
        return
    p, dt = tracks.compute_local_positions(gnss)[:, :2], np.diff(gnss.t)
    sd = np.hypot(gnss.sd[:, 0], gnss.sd[:, 1])
    near = dt < 3.5 * track.period
    if gnss.v is not None and not track.width.any():
        v = np.stack([np.interp(gnss.t, track.t, track.v[:, k]) for k in (0, 1)], -1)
        off = np.diff(p, axis=0) - 0.5 * (v[1:] + v[:-1]) * dt[:, None]
        size = np.linalg.norm(off, axis=1)
        limit = 1.0 + 5.0 * np.hypot(sd[1:], sd[:-1]) + 3.0 * dt
    else:
        off = p[2:] - p[1:-1] - (p[1:-1] - p[:-2]) * (dt[1:] / dt[:-1])[:, None]
        size = np.r_[0.0, np.linalg.norm(off, axis=1)]
        near &= np.r_[False, near[:-1]]
        limit = 1.0 + 12.0 * sd[1:] + 10.0 * dt * dt
    bad = np.flatnonzero(near & (size > limit))
    if len(bad):
        worst = bad[np.argmax(size[bad])]
        count = format_count(len(bad), "jump")
        at = gnss.t[worst + 1] - recording.start
        yield Finding(
            "warning",
            f"{count} in GNSS position that the motion and the sigmas do not explain, the largest {size[worst]:.1f} m "
            f"at {at:.1f} s from the start; an estimated noise model down-weights them, otherwise a robust kernel does",
            "gnss.jump",
        )


def check_imu_clock(clock: ClockOffsets) -> Iterator[Finding]:
    """The clock of the IMU by GNSS speed, and by the positions alone, whose stamps differ in some receivers.

    Offsets beyond the permitted error of the fixes' stamps distort what is solved with the stamps as they are. The
    course, which leads or lags with the lever arm, is not used.
    """
    if clock.apart is not None:
        yield Finding(
            "note",
            f"the stamps of GNSS positions and velocities are {clock.apart:.2f} s apart, so one of them is wrong: a "
            "time offset of each is estimated",
            "gnss.two_clocks",
        )
    forward = clock.late
    if forward is None:
        return
    lag = forward.lag
    leap = ", the leap seconds between GPS time and UTC" if abs(abs(lag) - 18.0) < 0.5 else ""
    certain = abs(lag) - 4.0 * forward.spread > _CERTAIN_SIGMAS * GnssSettings().time_offset_sigma
    of_fixes = clock.of_imu is False
    mend = f"{lag:+.2f} to time_offset in [gnss]" if of_fixes else f"{-lag:+.2f} to time_offset in [imu]"
    yield Finding(
        "unreliable" if certain else "warning",
        f"IMU stamps are {'late' if lag > 0 else 'early'} against GNSS by {abs(lag):.2f} s{leap} (forward force "
        f"against speed, +-{max(forward.spread, 0.01):.2f} s): add {mend}",
        "imu.clock",
    )


_FAULT_WORDS = {
    GAP: "gives no readings",
    STUCK: "is stuck at zero",
    FROZEN: "is frozen",
    WILD: "reads against the motion",
}
_COARSE = 0.1  # m/s, a resolution that is reported
_WHEEL = 0.02  # relative difference of a wheel that is reported: worn tyres differ by half of it
_WHEELS = ("front left", "front right", "rear left", "rear right")


def check_odometer_readings(recording: Recording, facts: dict[str, Any]) -> Iterator[Finding]:
    """Checks of the odometer's readings by themselves, and of the IMU against them."""
    odometer = recording.odometer
    assert odometer is not None
    step = wheels.find_quantum(odometer.speed)
    facts["sigma_mps"] = round(wheels.estimate_reading_sigma(odometer), 4)
    if step > 0.0:
        facts["step_mps"] = round(step, 5)
    if odometer.pulse:
        facts["pulse_m"] = odometer.pulse
    elif step > _COARSE:
        yield Finding("note", f"the odometer reads in steps of {step:.3g} m/s", "odometer.steps")
    if not odometer.signed:
        yield Finding("note", "the odometer never reads below zero: taken as unsigned", "odometer.unsigned")
    found = wheels.find_wrong_readings(odometer, recording.imu)
    for reason in dict.fromkeys(found.reasons):
        spans = found.spans[[r == reason for r in found.reasons]]
        longest = spans[np.argmax(spans[:, 1] - spans[:, 0])]
        size, at = longest[1] - longest[0], longest[0] - recording.start
        where = f"for {size:.2f} s at {at:.1f} s from the start"
        if len(spans) > 1:
            where = f"in {len(spans)} spans, the longest of {size:.2f} s at {at:.1f} s from the start"
        yield Finding(
            "note" if reason == GAP else "warning",
            f"the odometer {_FAULT_WORDS[reason]} {where}: not used there",
            f"odometer.{reason.replace(' ', '_')}",
        )
    if odometer.wheels is not None:
        yield from _compare_wheels(odometer, recording.imu)


def _compare_wheels(odometer: Odometer, imu: Imu) -> Iterator[Finding]:
    """A wheel that is faster or slower than the others on straight road."""
    assert odometer.wheels is not None
    turn = imu.gyro @ crosschecks.find_up(imu)
    turn = np.abs(np.interp(odometer.t, imu.t, turn - np.median(turn)))
    # a turn rate of 0.02 rad/s changes a wheel's speed by 0.02 m/s relative to the middle
    straight = (np.abs(odometer.speed) > _MIN_SPEED) & (turn < 0.02)
    there = ~np.isnan(odometer.wheels).all(axis=0)
    speeds = odometer.wheels[straight][:, there]
    speeds = speeds[~np.isnan(speeds).any(axis=1)]
    if there.sum() < 2 or len(speeds) < crosschecks.MIN_PAIRS:
        return
    share = np.median(speeds / np.median(speeds, axis=1)[:, None], axis=0)
    for name, ratio in zip(np.array(_WHEELS)[there], share, strict=True):
        if abs(ratio - 1.0) > _WHEEL:
            more = "faster" if ratio > 1.0 else "slower"
            yield Finding(
                "warning",
                f"the {name} wheel is {100 * abs(ratio - 1):.1f} % {more} than the others when driving straight: "
                "set use in [odometer], to leave its axle out",
                "odometer.wheel",
            )


def check_odometer(recording: Recording, track: Track | None, facts: dict[str, Any]) -> Iterator[Finding]:
    odometer = recording.odometer
    assert odometer is not None
    if min(odometer.t[-1], recording.end) <= max(odometer.t[0], recording.start):
        unit = _guess_stamp_unit(odometer.t, recording)
        hint = f'; its stamps are in {unit}: set units = {{ t = "{unit}" }} in [odometer]' if unit else ""
        yield Finding("warning", f"odometer and IMU do not overlap in time{hint}", "odometer.clock")
        return
    yield from check_odometer_readings(recording, facts)
    found = crosschecks.fit_odometer(odometer, track) if track is not None else None
    if found is None:
        return
    fit, scale = found
    if fit.correlation < ODOMETER_AGREES:
        return
    facts["true_over_recorded"] = round(scale, 4)
    facts["late_by_s"] = round(fit.lag, 3)
    units = {1 / 3.6: "km/h", 0.44704: "mph", 1852 / 3600: "knots", 3.6: "m/s already: leave out units.speed"}
    for factor, unit in units.items():
        if abs(scale / factor - 1.0) < 0.06:
            say = (
                f'the odometer is in {unit}: set units = {{ speed = "{unit}" }}'
                if factor < 1
                else f"the odometer is in {unit}"
            )
            yield Finding("warning", f"GNSS speed is {scale:.3f} times the odometer's: {say}", "odometer.unit")
            break
    else:
        if scale < 0:
            yield Finding(
                "warning", f"the odometer's sign is reversed (GNSS speed is {scale:.3f} times it)", "odometer.sign"
            )
        elif abs(scale - 1.0) > max(2.0 * odometer.scale_sigma, 0.02):
            yield Finding(
                "warning",
                f"GNSS speed is {scale:.3f} times the odometer's, "
                f"which scale_sigma = {odometer.scale_sigma:g} does not cover",
                "odometer.scale",
            )
    if abs(fit.lag) > 0.1 + 4.0 * fit.spread:
        own = crosschecks.fit_forward(recording.imu, tracks.compute_odometer_track(odometer))
        right = own is not None and own.correlation > FAIR and abs(own.lag) < 0.5 * abs(fit.lag)  # by the IMU
        yield Finding(
            "warning",
            f"odometer stamps are {'late' if fit.lag > 0 else 'early'} against GNSS by {abs(fit.lag):.2f} s"
            + (
                f", and the IMU agrees with the odometer: add {fit.lag:+.2f} to time_offset in [gnss], once for both"
                if right
                else f": add {-fit.lag:+.2f} to time_offset in [odometer]"
            ),
            "odometer.late",
        )
