"""Looks a recording over before it is solved: what it holds, and what in it is odd, in plain words.

Each check is a small function that yields findings; it says nothing where the data do not tell.
Nothing is changed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from graphnav import crosschecks
from graphnav.crosschecks import Fit, Track
from graphnav.earth import gravity
from graphnav.recording import Imu, Recording
from graphnav.rotation import Array

STANDARD_GRAVITY = 9.80665  # m/s^2, where the place is unknown
_REST_WINDOW = 1.0  # s


@dataclass(frozen=True)
class Finding:
    """One thing worth knowing: a warning if results suffer from it, else a note."""

    severity: Literal["note", "warning"]
    sentence: str


@dataclass(frozen=True)
class Inspection:
    """What `inspect` found; `facts` are per sensor, name -> value in SI units unless the name says otherwise."""

    name: str
    platform: str
    facts: dict[str, dict[str, Any]]
    findings: tuple[Finding, ...] = field(default=())

    @property
    def warnings(self) -> tuple[str, ...]:
        """The sentences of the warnings."""
        return tuple(f.sentence for f in self.findings if f.severity == "warning")

    def text(self) -> str:
        """A summary of several lines for people."""
        lines = [f"{self.name} ({self.platform})"]
        for sensor, facts in self.facts.items():
            shown = ", ".join(f"{name.replace('_', ' ')} {_show(value)}" for name, value in facts.items())
            lines.append(f"  {sensor:<9} {shown}")
        for finding in self.findings:
            lines.append(f"  {finding.severity}: {finding.sentence}")
        return "\n".join(lines)


def _show(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def inspect(recording: Recording) -> Inspection:
    """Check a recording; see the module's head.

    Findings are in order of the checks, remarks of the loader first.
    """
    findings = [Finding("note", remark) for remark in recording.remarks]
    facts: dict[str, dict[str, Any]] = {"imu": _imu_facts(recording)}
    vehicle = recording.platform == "vehicle"
    overlap = recording.gnss is not None and len(recording.gnss.t) and _overlap(recording) > 0
    track = crosschecks.track(recording.gnss) if recording.gnss is not None else None
    rest = _at_rest(recording, track if overlap else None)
    findings += _imu_time(recording.imu)
    findings += _repeats(recording.imu)
    findings += _saturation(recording.imu)
    findings += _units(recording)
    if rest.any():
        facts["imu"]["still_s"] = float(rest.sum() * _period(recording.imu.t))
        findings += _force_at_rest(recording, rest, facts["imu"])
        findings += _noise_at_rest(recording.imu, rest)
    if recording.gnss is not None:
        facts["gnss"] = _gnss_facts(recording, track)
        findings += _gnss_coverage(recording)
        findings += _gnss_jumps(recording, track)
    if vehicle and overlap and track is not None:
        forward, yaw = crosschecks.forward_fit(recording.imu, track), crosschecks.yaw_fit(recording.imu, track)
        findings += _clock(forward)
        findings += _axes(recording.imu, forward)
        findings += _yaw_scale(yaw)
    elif vehicle:
        findings += _axes(recording.imu, None)
    if recording.odometer is not None:
        facts["odometer"] = _sensor_facts(recording.odometer.t)
        facts["odometer"]["max_speed_mps"] = float(np.abs(recording.odometer.speed).max())
        findings += _odometer(recording, track, facts["odometer"])
    if recording.truth is not None:
        facts["truth"] = {"rows": len(recording.truth.t), "of": recording.truth.of}
        if recording.truth.closed_loop_sigma:
            facts["truth"] = {"closed_loop_sigma_m": recording.truth.closed_loop_sigma}
    return Inspection(recording.name, recording.platform, facts, tuple(findings))


def _period(t: Array) -> float:
    return float(np.median(np.diff(t))) if len(t) > 1 else float("nan")


def _sensor_facts(t: Array) -> dict[str, Any]:
    return {"rows": len(t), "rate_hz": round(1.0 / _period(t), 3), "span_s": round(float(t[-1] - t[0]), 3)}


def _imu_facts(recording: Recording) -> dict[str, Any]:
    facts = _sensor_facts(recording.imu.t)
    facts["duration_s"] = round(recording.duration, 3)
    step = np.diff(recording.imu.t)
    facts["gaps"] = int((step > _gap_limit(recording.imu.t)).sum())
    facts["longest_step_s"] = round(float(step.max()), 4)
    return facts


def _gap_limit(t: Array) -> float:
    return 2.5 * _period(t)


def _overlap(recording: Recording) -> float:
    t = recording.gnss.t  # type: ignore[union-attr]
    return float(min(t[-1], recording.end) - max(t[0], recording.start))


def _gnss_facts(recording: Recording, track: Track | None) -> dict[str, Any]:
    gnss = recording.gnss
    assert gnss is not None
    if not len(gnss.t):
        return {"rows": 0}
    facts = {"rows": 1} if len(gnss.t) == 1 else _sensor_facts(gnss.t)
    facts["velocities"] = 0 if gnss.v is None else int((~np.isnan(gnss.v[:, 0])).sum())
    if track is not None:
        dt = np.diff(track.t)
        near = dt < 5 * max(1.0, track.period)
        usable = track.speed < 100.0
        speed = track.speed
        distance = np.sum((0.5 * (speed[1:] + speed[:-1]) * dt)[near])
        facts["distance_m"] = round(float(distance), 1)
        facts["max_speed_mps"] = round(float(np.percentile(speed[usable], 99.9)), 2) if usable.any() else float("nan")
        stopped = _runs(speed < 0.3)
        stops = [(a, b) for a, b in stopped if track.t[b - 1] - track.t[a] >= 2.0]
        facts["stops"] = len(stops)
        facts["stopped_s"] = round(float(sum(track.t[b - 1] - track.t[a] for a, b in stops)), 1)
    return facts


def _runs(mask: Array) -> list[tuple[int, int]]:
    """[start, end) of every run of True."""
    edges = np.flatnonzero(np.diff(np.r_[0, mask.astype(np.int8), 0]))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _at_rest(recording: Recording, track: Track | None) -> Array:
    """IMU rows that lie in quiet seconds; quiet is near the quietest part, and not moving where speed is known."""
    imu = recording.imu
    period = _period(imu.t)
    n = max(5, round(_REST_WINDOW / period))
    blocks = len(imu.t) // n
    mask = np.zeros(len(imu.t), dtype=bool)
    if blocks < 3:
        return mask

    def scatter(x: Array) -> Array:
        return np.linalg.norm(x[: blocks * n].reshape(blocks, n, 3).std(axis=1), axis=-1)

    force, rate = scatter(imu.accel), scatter(imu.gyro)
    quiet = (force < 4.0 * np.percentile(force, 2) + 0.02) & (rate < 4.0 * np.percentile(rate, 2) + 0.002)
    middle = imu.t[: blocks * n].reshape(blocks, n).mean(axis=1)
    if recording.odometer is not None:
        o = recording.odometer
        quiet &= np.abs(np.interp(middle, o.t, o.speed, left=np.inf, right=np.inf)) < 0.05
    elif track is not None:
        quiet &= np.interp(middle, track.t, track.speed, left=np.inf, right=np.inf) < 0.3
    else:  # nothing but the IMU: stillness must be plain
        quiet &= (force < 0.3) & (rate < 0.03)
    mask[: blocks * n] = np.repeat(quiet, n)
    return mask


def _imu_time(imu: Imu) -> Iterator[Finding]:
    step, period = np.diff(imu.t), _period(imu.t)
    gaps = np.flatnonzero(step > _gap_limit(imu.t))
    if len(gaps):
        worst = gaps[np.argmax(step[gaps])]
        severity: Literal["note", "warning"] = "warning" if step[worst] > 0.2 else "note"
        count = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
        after = imu.t[worst] - imu.t[0]
        yield Finding(severity, f"{count} in the IMU, the longest {step[worst]:.3f} s at {after:.1f} s from the start")
    uneven = float((np.abs(step - period) > 0.25 * period).mean())
    if uneven > 0.05:
        yield Finding(
            "note",
            f"IMU stamps are uneven: {100 * uneven:.0f} % of the steps differ by over 25 % from {1e3 * period:.4g} ms",
        )


def _repeats(imu: Imu) -> Iterator[Finding]:
    same = (np.diff(imu.gyro, axis=0) == 0).all(1) & (np.diff(imu.accel, axis=0) == 0).all(1)
    if same.mean() > 0.002:
        yield Finding("note", f"{same.sum()} IMU rows ({100 * same.mean():.1f} %) repeat the values of the row before")
    stuck = max((b - a for a, b in _runs(same)), default=0) * _period(imu.t)
    if stuck > 0.5:
        yield Finding("warning", f"the IMU repeats one value for {stuck:.1f} s: it was stuck or its log was filled")


def _saturation(imu: Imu) -> Iterator[Finding]:
    # in the file's axes: a tilted mount would spread a clipped axis over three
    for what, values, smallest, unit in (("gyro", imu.gyro, 0.5, "rad/s"), ("accelerometer", imu.accel, 5.0, "m/s2")):
        x = values @ imu.R_bs
        for axis in range(3):
            for sign in (1.0, -1.0):
                signed = sign * x[:, axis]
                top = signed.max()
                if top < smallest or top < 3.0 * signed.std():
                    continue
                runs = [b - a for a, b in _runs(signed > top - 1e-6 * top) if b - a >= 3]
                if len(runs) >= 2 or max(runs, default=0) >= 5:
                    yield Finding(
                        "warning",
                        f"{what} {'xyz'[axis]} (file axes) is saturated: {sum(runs)} rows stay at {sign * top:.4g} {unit}",
                    )


def _units(recording: Recording) -> Iterator[Finding]:
    f = float(np.median(np.linalg.norm(recording.imu.accel, axis=1)))
    guesses = (
        (0.8, 1.2, 'the accelerometer seems to be in g: say units = { accel = "g" }'),
        (85.0, 110.0, "the accelerometer seems to be in m/s2 already: leave out units.accel"),
        (800.0, 1200.0, "the accelerometer seems to be in thousandths of g: turn it into m/s2 or g"),
        (0.0, 0.8, "gravity seems to have been removed from the accelerometer; graphnav needs the raw force"),
    )
    for low, high, sentence in guesses:
        if low <= f < high:
            yield Finding("warning", f"the force has a median of {f:.3g} m/s2, not 9.8: {sentence}")
    rate = float(np.percentile(np.abs(recording.imu.gyro).max(axis=1), 99.0))
    if rate > (4.0 if recording.platform == "vehicle" else 35.0):  # 35 rad/s = 2000 deg/s, the usual full scale
        yield Finding(
            "warning",
            f'the gyro reaches {rate:.3g} rad/s, too fast for a {recording.platform}: if it is deg/s, say units = {{ gyro = "deg/s" }}',
        )


def _force_at_rest(recording: Recording, rest: Array, facts: dict[str, Any]) -> Iterator[Finding]:
    f = float(np.linalg.norm(recording.imu.accel[rest].mean(axis=0)))
    if recording.platform == "foot":  # every stance has another attitude
        f = float(np.linalg.norm(recording.imu.accel[rest], axis=1).mean())
    place, g = "standard", STANDARD_GRAVITY
    if recording.gnss is not None and len(recording.gnss.t):
        place, g = "local", float(gravity(*recording.gnss.llh[0, [0, 2]]))
    facts["force_at_rest_mps2"] = round(f, 4)
    facts[f"{place}_gravity_mps2"] = round(g, 4)
    off = f / g - 1.0
    if 0.008 < abs(off) < 0.15:
        sigma = recording.imu.noise.accel_bias_sigma
        covered = "" if abs(f - g) < 3 * sigma else f"; accel_bias_sigma = {sigma:g} does not cover that"
        yield Finding(
            "note" if not covered else "warning",
            f"at rest the force is {f:.3f} m/s2 where gravity is {g:.3f} ({100 * off:+.1f} %){covered}",
        )


def _noise_at_rest(imu: Imu, rest: Array) -> Iterator[Finding]:
    """Allan deviation at 1 s, which for white noise is its density (IEEE Std 952-1997, annex C)."""
    n = max(5, round(1.0 / _period(imu.t)))
    for what, x, stated in (
        ("gyro_noise_density", imu.gyro, imu.noise.gyro_noise_density),
        ("accel_noise_density", imu.accel, imu.noise.accel_noise_density),
    ):
        steps = []
        for a, b in _runs(rest):
            means = x[a : a + (b - a) // n * n].reshape(-1, n, 3).mean(axis=1)
            steps.append(np.diff(means, axis=0))
        steps = np.concatenate(steps)
        if len(steps) < 10:
            continue
        # the quartile, not the mean: a start or a door between two seconds must not count
        allan = float(np.max(np.median(np.abs(steps), axis=0))) / 0.6745 / np.sqrt(2.0)
        if allan > 4.0 * stated:
            yield Finding(
                "warning", f"{what} = {stated:.2g} is small: at rest the noise is {allan:.2g} (Allan deviation at 1 s)"
            )


def _gnss_coverage(recording: Recording) -> Iterator[Finding]:
    gnss = recording.gnss
    assert gnss is not None
    if not len(gnss.t):
        yield Finding("warning", "no GNSS fix")
        return
    if _overlap(recording) <= 0:
        yield Finding(
            "warning",
            f"GNSS ({gnss.t[0]:.3f} to {gnss.t[-1]:.3f} s) and IMU ({recording.start:.3f} to {recording.end:.3f} s) do not "
            f"overlap in time; if their clocks differ, say time_offset in [gnss] "
            f"({recording.start - gnss.t[0]:.3f} would start both together)",
        )
        return
    for late, what in ((gnss.t[0] - recording.start, "starts"), (recording.end - gnss.t[-1], "ends")):
        if late > 5.0:
            yield Finding("note", f"GNSS {what} {late:.1f} s {'after' if what == 'starts' else 'before'} the IMU")
    if len(gnss.t) < 3:
        return
    step = np.diff(gnss.t)
    inside = (gnss.t[1:] > recording.start) & (gnss.t[:-1] < recording.end)
    gaps = np.flatnonzero((step > max(3.5 * _period(gnss.t), 1.5)) & inside)
    if len(gaps):
        worst = gaps[np.argmax(step[gaps])]
        count = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
        at = gnss.t[worst] - recording.start
        yield Finding("note", f"{count} in GNSS, the longest {step[worst]:.1f} s at {at:.1f} s from the start")


def _gnss_jumps(recording: Recording, track: Track | None) -> Iterator[Finding]:
    """Fixes that no motion explains: a step against the velocities, or two accelerations no car has."""
    gnss = recording.gnss
    assert gnss is not None
    if track is None or len(gnss.t) < 5:
        return
    p, dt = crosschecks.local_positions(gnss)[:, :2], np.diff(gnss.t)
    sd = np.hypot(gnss.sd[:, 0], gnss.sd[:, 1])
    near = dt < 3.5 * track.period
    if gnss.v is not None and not track.width.any():
        v = np.stack([np.interp(gnss.t, track.t, track.v[:, k]) for k in (0, 1)], -1)
        off = np.diff(p, axis=0) - 0.5 * (v[1:] + v[:-1]) * dt[:, None]
        near &= (track.speed.max() < 100.0) | near
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
        count = "1 jump" if len(bad) == 1 else f"{len(bad)} jumps"
        at = gnss.t[worst + 1] - recording.start
        yield Finding(
            "warning",
            f"{count} in GNSS position that the motion and the sigmas do not explain, the largest {size[worst]:.1f} m "
            f"at {at:.1f} s from the start; a robust kernel or a gate is advisable",
        )


def _clock(forward: Fit | None) -> Iterator[Finding]:
    # 4 sigma, because the sigma comes from four parts only; a course leads or lags with the lever arm, so it is not asked
    if forward is None or forward.correlation < 0.6 or abs(forward.lag) < 0.05 + 4.0 * forward.spread:
        return
    lag = forward.lag
    leap = ", the leap seconds between GPS time and UTC" if abs(abs(lag) - 18.0) < 0.5 else ""
    yield Finding(
        "warning",
        f"IMU stamps are {'late' if lag > 0 else 'early'} against GNSS by {abs(lag):.2f} s{leap} (forward force against "
        f"speed, +-{max(forward.spread, 0.01):.2f} s): add {-lag:+.2f} to time_offset in [imu]",
    )


def _axes(imu: Imu, forward: Fit | None) -> Iterator[Finding]:
    up = crosschecks.up_of(imu)
    if up[2] > 0.8 and (forward is None or forward.correlation < 0.7):
        return
    if forward is None or forward.correlation < 0.7:
        yield Finding("warning", f"the mean force points {_direction(up)}, not up: are the axes right?")
        return
    ahead = forward.coefficients / np.linalg.norm(forward.coefficients)
    if up[2] > 0.8 and ahead[1] > 0.7:
        return
    letters = _letters(imu.R_bs, ahead, up)
    hint = f'; axes = "{letters}" would agree' if letters else ""
    yield Finding(
        "warning",
        f"the axes contradict the drive: forward by the GNSS speed is {_direction(ahead)}, up by gravity is "
        f"{_direction(up)} in the axes stated{hint}",
    )


def _direction(v: Array) -> str:
    names = (("left", "right"), ("backward", "forward"), ("down", "up"))
    k = int(np.argmax(np.abs(v)))
    return names[k][int(v[k] > 0)]


def _letters(R_bs: Array, forward: Array, up: Array) -> str | None:
    """The three letters under which `forward` and `up` (body axes as loaded) would be so; None if none clearly does."""
    f, u = R_bs.T @ forward, R_bs.T @ up  # in the file's axes
    if np.abs(f).max() < 0.8 or np.abs(u).max() < 0.8 or np.argmax(np.abs(f)) == np.argmax(np.abs(u)):
        return None
    unit = [np.sign(x) * (np.abs(x) == np.abs(x).max()) for x in (f, u)]
    rows = np.stack([np.cross(*unit), *unit])  # right, forward, up
    return "".join(
        "LBD"[k] if rows[k, axis] < 0 else "RFU"[k] for axis in range(3) for k in [np.argmax(np.abs(rows[:, axis]))]
    )


def _yaw_scale(yaw: Fit | None) -> Iterator[Finding]:
    if yaw is None or abs(yaw.correlation) < 0.8:
        return
    scale = float(yaw.coefficients[0])
    if scale < 0:
        yield Finding(
            "warning",
            "the gyro turns against the GNSS course: the sign of the gyro or of the accelerometer is reversed in the file",
        )
    scale = abs(scale)
    if 40.0 < scale < 80.0:
        yield Finding(
            "warning",
            "the gyro is 57 times too small for the GNSS course: it is in rad/s already, leave out units.gyro",
        )
    elif 1 / 80.0 < scale < 1 / 40.0:
        yield Finding("warning", 'the gyro is 57 times too large for the GNSS course: say units = { gyro = "deg/s" }')
    elif abs(scale - 1.0) > 0.1:
        yield Finding("warning", f"the course turns {scale:.2f} times as much as the gyro about the vertical")


def _odometer(recording: Recording, track: Track | None, facts: dict[str, Any]) -> Iterator[Finding]:
    odometer = recording.odometer
    assert odometer is not None
    if min(odometer.t[-1], recording.end) <= max(odometer.t[0], recording.start):
        yield Finding("warning", "odometer and IMU do not overlap in time")
        return
    found = crosschecks.odometer_fit(odometer, track) if track is not None else None
    if found is None:
        return
    fit, scale = found
    if fit.correlation < 0.9:
        return
    facts["true_over_recorded"] = round(scale, 4)
    facts["late_by_s"] = round(fit.lag, 3)
    units = {1 / 3.6: "km/h", 0.44704: "mph", 1852 / 3600: "knots", 3.6: "m/s already: leave out units.speed"}
    for factor, unit in units.items():
        if abs(scale / factor - 1.0) < 0.06:
            say = (
                f'the odometer is in {unit}: say units = {{ speed = "{unit}" }}'
                if factor < 1
                else f"the odometer is in {unit}"
            )
            yield Finding("warning", f"GNSS speed is {scale:.3f} times the odometer's: {say}")
            break
    else:
        if scale < 0:
            yield Finding("warning", f"the odometer's sign is reversed (GNSS speed is {scale:.3f} times it)")
        elif abs(scale - 1.0) > max(2.0 * odometer.scale_sigma, 0.02):
            yield Finding(
                "warning",
                f"GNSS speed is {scale:.3f} times the odometer's, which scale_sigma = {odometer.scale_sigma:g} does not cover",
            )
    if abs(fit.lag) > 0.1 + 4.0 * fit.spread:
        yield Finding(
            "warning",
            f"odometer stamps are {'late' if fit.lag > 0 else 'early'} against GNSS by {abs(fit.lag):.2f} s: "
            f"add {-fit.lag:+.2f} to time_offset in [odometer]",
        )
