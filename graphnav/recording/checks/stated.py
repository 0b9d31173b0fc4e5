"""Checks of stated figures, and of positions, velocities and truth against each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.findings import Finding
from graphnav.core.rotation import Array
from graphnav.core.timescales import LEAP
from graphnav.recording import Gnss, ImuNoise, Recording, Truth
from graphnav.recording.checks import crosschecks, tracks
from graphnav.recording.checks.imu import is_shaken_as_a_foot
from graphnav.recording.checks.tracks import Track

_LONGEST_ARM = 15.0  # m; no lever arm on a road vehicle is that long
_RUN = 8.0  # m/s, above any walking speed
# SI figures that no IMU has (a phone's are a tenth or less), and the data-sheet unit that was probably meant
_IMPOSSIBLE = {
    "gyro_noise_density": (0.02, "rad/s/sqrt(Hz)", "deg/sqrt(h)"),
    "accel_noise_density": (0.5, "m/s2/sqrt(Hz)", "ug/sqrt(Hz)"),
    "gyro_bias_sigma": (0.5, "rad/s", "deg/h"),
    "accel_bias_sigma": (5.0, "m/s2", "mg"),
}
_SPEEDS = {1 / 3.6: "km/h", 0.44704: "mph", 1852 / 3600: "knots", 3.6: "m/s already"}
_MENDED = 0.3  # ratio of the discrepancies with and without a change below which that change explains them


def check_stated_noise(noise: ImuNoise) -> Iterator[Finding]:
    """Noise figures entered in a data sheet's unit."""
    for key, (limit, unit, meant) in _IMPOSSIBLE.items():
        value = float(getattr(noise, key))
        if value > limit:
            yield Finding(
                "warning",
                f'{key} = {value:g} {unit} is more than any IMU has; if it is {meant}, write "{value:g} {meant}"',
                "imu.noise_unit",
            )


def check_lever_arms(recording: Recording) -> Iterator[Finding]:
    """Lever arms in another unit than metres."""
    for name in ("gnss", "odometer"):
        sensor = getattr(recording, name)
        table = "raw_gnss" if name == "gnss" and sensor is not None and sensor.derived else name
        if sensor is not None and (length := float(np.linalg.norm(sensor.lever_arm))) > _LONGEST_ARM:
            yield Finding(
                "warning",
                f"the lever arm in [{table}] is {length:.3g} m long: it is to be in metres",
                f"{name}.lever_arm_unit",
            )


def moves_as_a_foot(speed: Array) -> bool:
    """Whether speeds of fixes (N,) m/s are those of a walk or run."""
    speed = speed[np.isfinite(speed)]
    return bool(len(speed)) and float(np.percentile(speed, 95.0)) <= _RUN


def check_platform(recording: Recording, track: Track | None) -> Iterator[Finding]:
    """A vehicle's log with the platform "foot", or a foot's with the platform "vehicle"."""
    slow = track is None or moves_as_a_foot(track.speed)
    if recording.platform == "foot" and track is not None and not slow:
        speed = float(np.percentile(track.speed, 95.0))
        yield Finding(
            "warning",
            f'the fixes move at {speed:.3g} m/s, too fast for a foot: if it is a car, set platform = "vehicle"',
            "recording.platform",
        )
    shaken = recording.platform == "vehicle" and slow and recording.odometer is None
    if shaken and is_shaken_as_a_foot(recording.imu.t, recording.imu.accel):
        yield Finding(
            "warning",
            "the force departs from gravity by more than that from step to step, as on a shoe: if it is on a foot, set "
            'platform = "foot"',
            "recording.platform",
        )


def check_rounding(gnss: Gnss) -> Iterator[Finding]:
    """Positions with fewer digits than their sigma requires."""
    steps, sd = np.sqrt(12.0) * np.array(gnss.rounding), np.median(gnss.sd, axis=0)
    for what, step, size in (
        ("positions", np.max(steps[:2]), np.mean(sd[:2])),
        ("heights", steps[2], sd[2]),
    ):
        if step > 3.0 * size:
            yield Finding(
                "warning",
                f"{what} are rounded to {step:.2g} m, and their 1-sigma is {size:.2g} m: log more digits; until then "
                f"{step / np.sqrt(12.0):.2g} m are added to it, in quadrature",
                "gnss.rounded",
            )


def check_fix_types(gnss: Gnss) -> Iterator[Finding]:
    """Fix types in the numbers of GGA's quality, which differ from RTKLIB's."""
    if gnss.type is None or not gnss.type_assumed:
        return
    from graphnav.recording.draft.guesses import guess_fix_numbers

    if (guess := guess_fix_numbers(gnss.type, gnss.sd[:, 0])).value == "nmea":
        sentence = (
            f'types of the fixes look like GGA\'s qualities: {guess.why}; set units = {{ type = "nmea" }} in [gnss]'
        )
        yield Finding("warning", sentence, "gnss.type_numbers")


def check_velocities(gnss: Gnss) -> Iterator[Finding]:
    """Velocities whose axes, signs or unit disagree with the positions."""
    if gnss.v is None or len(gnss.t) < 10:
        return
    p, v, m = tracks.compute_local_positions(gnss), gnss.v, max(1, round(1.0 / float(np.median(np.diff(gnss.t)))))
    dt = gnss.t[m:] - gnss.t[:-m]
    moved = p[m:] - p[:-m]
    # by the trapezoidal rule over all rows between, which follows changes of speed
    steps = 0.5 * (v[1:] + v[:-1]) * np.diff(gnss.t)[:, None]
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(np.nan_to_num(steps), axis=0)])
    stated = total[m:] - total[:-m]
    holes = np.concatenate([[0], np.cumsum(np.isnan(steps).any(axis=1))])
    real = (dt < 1.5 * max(1.0, float(np.median(dt)))) & (holes[m:] == holes[:-m])
    size = np.hypot(moved[:, 0], moved[:, 1])
    moving = real & (size > 2.0) & (size < 60.0 * dt)
    if moving.sum() >= crosschecks.MIN_PAIRS:
        other = exchange_lat_lon(gnss)
        if other is not None:
            q = tracks.compute_local_positions(other)
            off, mended = (
                float(np.median(np.linalg.norm((x[m:] - x[:-m] - stated)[moving, :2], axis=1))) for x in (p, q)
            )
            if mended < _MENDED * off:
                yield describe_exchange("the velocities")
                return
        yield from _compute_horizontal(moved[moving, :2], stated[moving, :2])
    climb, meant = moved[real, 2], stated[real, 2]
    if len(climb) >= crosschecks.MIN_PAIRS and climb.std() > 0.0 and meant.std() > 0.0:
        alike = float(np.corrcoef(climb, meant)[0, 1])
        if alike < -0.6:
            yield Finding(
                "warning",
                f"the upward velocity goes down where the heights go up (correlation {alike:.2f}): if it is downward, "
                "name its column vd",
                "gnss.velocity_down",
            )


def exchange_lat_lon(gnss: Gnss) -> Gnss | None:
    """The fixes with latitude and longitude exchanged; None where that is no valid place."""
    llh = gnss.llh[:, [1, 0, 2]]
    return replace(gnss, llh=llh) if np.nanmax(np.abs(llh[:, 0])) < 0.5 * np.pi else None


def describe_exchange(sensor: str) -> Finding:
    """The finding that they are exchanged, by `sensor`."""
    return Finding(
        "refused",
        f"latitude and longitude are exchanged: exchanged back, the positions agree with {sensor}; exchange the names "
        "in columns of [gnss]",
        "gnss.lat_lon",
    )


def describe_mirroring(which: str, sensor: str, else_: str = "") -> Finding:
    """The finding that positions have the wrong sign, by `sensor`; `else_` is what mirrors them as well."""
    return Finding(
        "refused",
        f"{which} the wrong sign, by {sensor}: south and west are negative; negate the column in the file{else_}",
        "gnss.mirrored",
    )


def _compute_horizontal(moved: Array, stated: Array) -> Iterator[Finding]:
    """Find the change of velocities (N, 2) that makes them agree with displacements (N, 2), where they disagree."""

    def miss(change: Array) -> float:
        return float(np.median(np.linalg.norm(moved - stated @ change.T, axis=1)))

    changes: list[tuple[Array, str]] = [
        (np.array([[0.0, 1.0], [1.0, 0.0]]), "east and north velocity are exchanged: exchange the names in columns"),
        (np.diag([-1.0, 1.0]), "the east velocity is reversed: negate it in the file"),
        (np.diag([1.0, -1.0]), "the north velocity is reversed: negate it in the file"),
        (-np.eye(2), "the velocities are reversed: negate them in the file"),
    ]
    turned = len(changes)  # the others are of units
    for factor, unit in _SPEEDS.items():
        hint = f'set units = {{ speed = "{unit}" }}' if factor < 1.0 else "leave out units.speed"
        changes.append((factor * np.eye(2), f"the velocities are in {unit}: {hint} in [gnss]"))
    misses = [miss(change) for change, _ in changes]
    best = int(np.argmin(misses))
    if misses[best] < 0.3 * miss(np.eye(2)) and misses[best] < 0.2 * float(np.median(np.linalg.norm(moved, axis=1))):
        sentence = f"by the positions {changes[best][1]}"
        if best < turned:
            yield Finding("warning", sentence, "gnss.velocity_axes")
        else:
            yield Finding("warning", sentence, "gnss.velocity_unit")


def check_truth(recording: Recording) -> Iterator[Finding]:
    """A truth of another time, clock or place."""
    truth, gnss = recording.truth, recording.gnss
    if truth is None or truth.closed_loop_sigma is not None or not len(truth.t):
        return
    if is_truth_apart(recording):
        yield Finding(
            "warning",
            f"the truth ({truth.t[0]:.3f} to {truth.t[-1]:.3f} s) and the IMU ({recording.start:.3f} to "
            f"{recording.end:.3f} s) do not overlap in time: is it of another day, or on another clock (time_offset in "
            "[truth])? It is not used",
            "truth.clock",
        )
        return
    if truth.llh is None or gnss is None:
        return
    frame = LocalFrame(truth.llh[0])
    true, fixes = frame.from_llh(truth.llh)[:, :2], frame.from_llh(gnss.llh)[:, :2]
    off = _measure_median_distance(truth, true, gnss, fixes, 0.0)
    if off is None:
        return
    shifted = {
        shift: found
        for shift in (-LEAP, LEAP)
        if (found := _measure_median_distance(truth, true, gnss, fixes, shift)) is not None
    }
    best = min(shifted, key=lambda shift: shifted[shift], default=0.0)
    if shifted and off > 5.0 and shifted[best] < 0.2 * off:
        yield Finding(
            "warning",
            f"the truth fits the fixes {best:+.0f} s later, the leap seconds between GPS time and UTC: add {best:+.0f} "
            "to time_offset in [truth]",
            "truth.leap_seconds",
        )
    elif off > 100.0 + 10.0 * float(np.median(gnss.sd[:, :2])):
        metres = ', or in metres (name the columns x and y, set frame = "local")' if off > 1e6 else ""
        yield Finding(
            "warning", f"the truth lies {off / 1e3:.3g} km from the fixes: is it of this drive{metres}?", "truth.far"
        )


def is_truth_apart(recording: Recording) -> bool:
    """Whether the truth shares no time with the IMU."""
    if recording.truth is None or not len(recording.truth.t):
        return False
    t = recording.truth.t
    return bool(t[-1] < recording.start or t[0] > recording.end)


def _measure_median_distance(truth: Truth, true: Array, gnss: Gnss, fixes: Array, shift: float) -> float | None:
    """Median horizontal distance (m) between fixes and a truth shifted by `shift` s; None where too few are close in
    time.
    """
    t = truth.t + shift
    k = np.clip(np.searchsorted(t, gnss.t), 1, len(t) - 1)
    near = (gnss.t >= t[k - 1]) & (gnss.t <= t[k]) & (t[k] - t[k - 1] < 3.0)
    if near.sum() < crosschecks.MIN_PAIRS:
        return None
    at = np.stack([np.interp(gnss.t[near], t, true[:, axis]) for axis in (0, 1)], -1)
    return float(np.median(np.linalg.norm(at - fixes[near], axis=1)))
