"""Checks of positions against the IMU: mirrored, exchanged, or heights in another unit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from graphnav.core.earth import STANDARD_GRAVITY
from graphnav.core.findings import Finding, compute_period
from graphnav.core.rotation import Array
from graphnav.recording import Gnss, Imu, Recording
from graphnav.recording.checks import crosschecks, tilt, tracks
from graphnav.recording.checks.axes import describe_reversal
from graphnav.recording.checks.clock import CLEAR, FAIR
from graphnav.recording.checks.crosschecks import Fit
from graphnav.recording.checks.stated import describe_exchange, describe_mirroring, exchange_lat_lon
from graphnav.recording.checks.tracks import Track, compute_local_positions
from graphnav.recording.formats.schema import FOOT

_SLOPE_SPAN, _SLOPES = 8.0, 6  # s over which a slope is taken: the force is then known to a tenth of a per cent
_TURNING_RADIUS = 5.0  # m, of the smallest cars
_SCALE = np.sqrt(2.0)  # the middle between right and twice as large, the smallest factor between units
_FEET = 0.3  # relative deviation from 0.3048 that the noise of both permits: a ratio of 1 is three times as far off


def check_mirroring(recording: Recording, track: Track, turns_back: bool) -> Iterator[Finding]:
    """A course that turns opposite to the gyro, as positions are mirrored by an exchange or a sign.

    Exchanged positions are also stretched, one way by the cosine of the latitude: their course agrees better with the
    gyro after the exchange if they were exchanged, and worse if only a sign is wrong, or nothing. Positions computed
    from raw observations are neither; theirs are of another time.
    """
    gnss = recording.gnss
    computed = gnss is not None and gnss.derived
    other = exchange_lat_lon(gnss) if gnss is not None and not computed else None
    yaw, as_read = (_fit_course(recording.imu, some) for some in (other, gnss))
    better = as_read is None or (yaw is not None and yaw.correlation > as_read.correlation)
    if yaw is not None and better and yaw.correlation > 0.8 and abs(yaw.coefficients[0] - 1.0) < 0.2:
        yield describe_exchange("the turns of the gyro")
    elif as_read is not None and as_read.correlation > 0.8 and as_read.coefficients[0] > 0.0:
        return  # the positions turn as the gyro does: what does not are their velocities
    elif (  # the gyro agrees with the force, whose up is that of the stated axes
        turns_back and crosschecks.find_up(recording.imu)[2] > 0.0 and tilt.measure_sideways(recording.imu, track) > 0.0
    ):
        by = "the turns of the gyro and the force in curves"
        if computed:
            yield Finding(
                "refused",
                f"the raw observations are not of the time of the IMU, by {by}: clock, or time_offset in [raw_gnss], "
                "is off by seconds",
                "raw_gnss.clock",
            )
        else:
            or_else = f"; if the places are right, {describe_reversal(recording.imu)}"
            yield describe_mirroring("latitudes or longitudes have", by, or_else)


def _fit_course(imu: Imu, gnss: Gnss | None) -> Fit | None:
    """The course by positions alone, fitted to the gyro."""
    course = tracks.compute_track(replace(gnss, v=None)) if gnss is not None else None
    return crosschecks.fit_yaw_rate(imu, course) if course is not None else None


def check_frozen(recording: Recording) -> Iterator[Finding]:
    """Fixes that stay where no vehicle can, while wheels or the fixes' own velocities drive.

    A car that drives a full turn of its smallest circle leaves any smaller one.
    """
    gnss, odometer = recording.gnss, recording.odometer
    if gnss is None or len(gnss.t) < crosschecks.MIN_PAIRS or recording.platform != "vehicle":
        return
    p = compute_local_positions(gnss)[:, :2]
    away = np.linalg.norm(p - np.median(p, axis=0), axis=1)
    within = float(np.max(away))
    sd = np.hypot(*gnss.sd[:, :2].T)
    if within > _TURNING_RADIUS or np.sqrt(np.mean(away**2)) > 3.0 * np.median(sd):
        return
    if odometer is not None and len(odometer.t) > 1:
        who, t, speed = "the odometer drives", odometer.t, np.abs(odometer.speed)
    elif gnss.v is not None:
        known = np.isfinite(gnss.v).all(axis=1)
        who, t, speed = "their velocities drive", gnss.t[known], np.hypot(*gnss.v[known, :2].T)
    else:
        return
    step, speed = np.diff(t), np.minimum(speed[1:], speed[:-1])
    sure = (step < 5.0 * max(compute_period(t), 1.0)) & (t[1:] > gnss.t[0]) & (t[:-1] < gnss.t[-1])
    sure &= speed > crosschecks.MIN_SPEED  # above the noise of a stationary receiver
    driven = float(np.sum((speed * step)[sure]))
    if driven > 2.0 * np.pi * _TURNING_RADIUS:
        yield Finding(
            "unreliable",
            f"the fixes stay within {within:.2g} m while {who} {driven:.0f} m: frozen, or of another unit than degrees",
            "gnss.frozen",
        )


def check_height_unit(recording: Recording, track: Track, forward: Fit | None) -> Iterator[Finding]:
    """Heights in feet, which climb 3.28 times as much as the slopes that the IMU measures, or in another unit."""
    if forward is None or forward.correlation < FAIR or recording.gnss is None:
        return
    ahead = forward.coefficients / np.linalg.norm(forward.coefficients)
    found = fit_climb(recording.imu, track, recording.gnss, ahead)
    if found is None:
        return
    correlation, ratio = found
    climbs = f"the heights climb {1.0 / ratio:.2g} times as much as the slopes that the IMU measures (correlation "
    climbs += f"{correlation:.2f})"
    if correlation > CLEAR and abs(ratio / FOOT - 1.0) < _FEET:
        hint = 'they are in feet; set units = { height = "ft" } in [gnss]'
        yield Finding("warning", f"{climbs}: {hint}", "gnss.feet")
    # whichever of the two has the noise that makes the correlation less than one
    elif correlation > CLEAR and abs(np.log(ratio)) + np.log(correlation) > np.log(_SCALE):
        yield Finding("warning", f"{climbs}: look at their unit and column", "gnss.height_scale")


def fit_climb(imu: Imu, track: Track, gnss: Gnss, forward: Array) -> tuple[float, float] | None:
    """Slopes by the force along `forward` (3,), corrected for acceleration, against those of the heights, over
    `_SLOPE_SPAN`.

    Their correlation, and the ratio of their magnitudes: neither has less noise than the other. None where the drive is
    too short. A span mostly without fixes has no slope of its own.
    """
    p = tracks.compute_local_positions(gnss)
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(p[:, :2], axis=0).T))])
    pull = np.concatenate([[0.0], np.cumsum(imu.accel[1:] @ forward * np.diff(imu.t))])
    a = np.arange(max(track.t[0], imu.t[0]), min(track.t[-1], imu.t[-1]) - _SLOPE_SPAN, _SLOPE_SPAN)

    def change(t: Array, x: Array) -> Array:
        return np.asarray(np.interp(a + _SLOPE_SPAN, t, x) - np.interp(a, t, x))

    far = change(gnss.t, distance)
    late = gnss.t[1:][np.diff(gnss.t) > 0.5 * _SLOPE_SPAN]  # the ends of gaps
    early = gnss.t[:-1][np.diff(gnss.t) > 0.5 * _SLOPE_SPAN]
    whole = np.searchsorted(late, a, side="right") == np.searchsorted(early, a + _SLOPE_SPAN)
    moving = (far > crosschecks.MIN_SPEED * _SLOPE_SPAN) & whole
    felt = (change(imu.t, pull) - change(track.t, track.speed))[moving] / (_SLOPE_SPAN * STANDARD_GRAVITY)
    climbed = change(gnss.t, p[:, 2])[moving] / far[moving]
    if len(felt) < _SLOPES or not felt.std() or not climbed.std():
        return None
    return float(np.corrcoef(felt, climbed)[0, 1]), float(felt.std() / climbed.std())


def find_mirrored(recording: Recording, wrong: Sequence[Finding]) -> list[Finding]:
    """The finding `wrong` on velocities, or that the positions are mirrored, where the gyro agrees with the
    velocities.
    """
    gnss = recording.gnss
    if gnss is None or gnss.v is None or recording.platform != "vehicle":
        return list(wrong)
    if not any(f.key == "gnss.velocity_axes" for f in wrong):
        return list(wrong)
    courses = [tracks.compute_track(one) for one in (gnss, replace(gnss, v=None))]
    fits = [crosschecks.fit_yaw_rate(recording.imu, course) for course in courses if course is not None]
    by_velocity, by_places = (
        [fit.coefficients[0] if fit is not None and fit.correlation > 0.8 else 0.0 for fit in fits]
        if len(fits) == 2
        else (0.0, 0.0)
    )
    moved = np.gradient(tracks.compute_local_positions(gnss)[:, :2], gnss.t, axis=0)
    east, north = np.nansum(moved * gnss.v[:, :2], axis=0) < 0.0
    if by_velocity > 0.0 > by_places and east != north:
        which = "longitudes" if east else "latitudes"
        return [describe_mirroring(f"the {which} have", "the velocities and the turns of the gyro")]
    return list(wrong)
