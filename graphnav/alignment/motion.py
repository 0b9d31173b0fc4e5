"""The first state from motion: a short smoothing problem over the first stretch in which the vehicle moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from graphnav import rotation
from graphnav.alignment.back import carried_back
from graphnav.alignment.first import Alignment, level, some
from graphnav.config import Settings
from graphnav.detectors.base import NONE, inside
from graphnav.earth import LocalFrame
from graphnav.errors import EstimationError
from graphnav.preintegration import prefix
from graphnav.problem import Problem, pose
from graphnav.recording import Gnss, Imu, Recording
from graphnav.rotation import Array
from graphnav.samples import bridge_gaps
from graphnav.solution import Solution
from graphnav.state import States

COURSE_SIGMA = np.radians(10.0)  # rad, a stated forward axis against the course: mounting, side slip
_DISTANCE = 50.0  # m of travel the short problem wants to see
_FIXES = 10  # and fixes
_JUMP = 6.0  # times what fixes usually are off their running median, or their sigma
_GOOD_FIT = 2.0  # squared sigmas per row below which no other start heading is tried

Smoother = Callable[[Problem, States], Solution]


def plausible(recording: Recording) -> Recording:
    """Without the fixes that lie far off the running median of five: they would be taken for motion."""
    gnss = recording.gnss
    if gnss is not None and not np.isfinite(gnss.llh).all():
        gnss = some(gnss, np.flatnonzero(np.isfinite(gnss.llh).all(axis=1)))
        recording = replace(recording, gnss=gnss)
    if gnss is None or len(gnss.t) < 5:
        return recording
    p = LocalFrame(gnss.llh[0]).from_llh(gnss.llh)[:, :2]
    off = np.linalg.norm(p - median_filter(p, size=(5, 1), mode="nearest"), axis=1)
    usual = np.maximum(np.median(off), np.linalg.norm(gnss.sd[:, :2], axis=1))
    return replace(recording, gnss=some(gnss, off <= _JUMP * usual))


def motion(recording: Recording, settings: Settings, stationary: Array = NONE) -> tuple[float, float] | None:
    """The stretch (s) to align over: from just before the first motion until enough of it was seen.

    What the fixes say of motion while a vehicle stands, `stationary` (N, 2) s, is none.
    """
    gnss = recording.gnss
    if gnss is None:
        return None
    used = (gnss.t >= recording.start) & (gnss.t <= recording.end)
    if np.count_nonzero(used) < 3:
        return None
    t, llh, sd = gnss.t[used], gnss.llh[used], gnss.sd[used]
    p = LocalFrame(llh[0]).from_llh(llh)
    noise = 5.0 * np.linalg.norm(np.median(sd[:, :2], axis=0))
    away = np.linalg.norm(p[:, :2] - p[0, :2], axis=1) > 3.0 + noise
    if recording.platform == "vehicle":
        away &= ~inside(t, stationary)
    if not away.any():
        return None
    first = int(np.argmax(away))
    begin = max(t[0], t[first] - 10.0)
    # along the track in steps longer than the noise, so that jitter at rest is not distance
    keep = np.arange(first, len(t))
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p[keep, :2], axis=0), axis=1))])
    enough = (travelled > _DISTANCE + noise) & (t[keep] > t[first] + settings.alignment.window)
    enough &= np.arange(len(keep)) >= _FIXES
    end = t[keep][np.argmax(enough)] if enough.any() else t[-1]
    return float(begin), float(end)


def in_motion(
    recording: Recording, settings: Settings, frame: LocalFrame, smooth: Smoother, span: tuple[float, float]
) -> Alignment:
    """The first state from the short problem over `span` (s), carried back to the first sample."""
    gnss, imu = recording.gnss, recording.imu
    assert gnss is not None
    begin, end = max(span[0], recording.start), span[1]
    part = replace(
        recording.crop(begin - recording.start, end - recording.start),
        gnss=_thinned(gnss, begin, end),
    )
    bias = _usual_rate(imu)
    rp = level(recording, begin)
    heading = _heading_of_accelerations(part, frame, rp, bias)
    best: Solution | None = None
    for quarter in (0, 2, 1, 3):
        rph = np.array([*rp, heading + 0.5 * np.pi * quarter])
        solution = _try(part, settings, frame, smooth, rph, bias)
        if best is None or solution.cost < best.cost:
            best = solution
        rows = sum(record.residual.size for record in best.records.values())
        if best.cost < 0.5 * _GOOD_FIT * rows:
            break
    if best is None or not np.isfinite(best.cost):
        raise EstimationError(
            f"'{recording.name}': no start attitude explains the GNSS fixes between {begin - recording.start:.0f} "
            f"and {end - recording.start:.0f} s; check the axes, the units and the time stamps"
        )
    R, P = best.states.R_nb[0], best.covariance[0][:3, :3]
    wide = settings.alignment.prior_inflation * np.sqrt(np.diag(P))
    J = rotation.rph_jacobian(rotation.to_rph(R))
    own = np.sqrt(np.diag(J @ P @ J.T))
    notes = [
        f"aligned over {begin - recording.start:.0f} to {end - recording.start:.0f} s: roll and pitch to "
        f"{np.degrees(own[:2].max()):.2g} deg, heading to {np.degrees(own[2]):.2g} deg"
    ]
    if recording.platform == "vehicle":
        R, wide[2], said = _with_course(best, R, wide[2])
        notes += said
    return carried_back(recording, settings, best, R, wide, own, begin, tuple(notes))


def _heading_of_accelerations(part: Recording, frame: LocalFrame, rp: Array, bias: Array) -> float:
    """Heading (rad) at the start of `part` by which levelled accelerations become those of the fixes.

    With both horizontal accelerations as complex numbers east + i north, fixes = z * felt + d by least squares;
    the argument of z is the turn from the heading-zero frame, d takes up tilt.
    """
    gnss = part.gnss
    assert gnss is not None
    t = gnss.t
    p = frame.from_llh(gnss.llh)
    v = gnss.v if gnss.v is not None and np.isfinite(gnss.v).all() else np.gradient(p, t, axis=0)
    change = np.diff(v, axis=0) / np.diff(t)[:, None]
    _, dV, _ = prefix(bridge_gaps(part.imu), part.start, t[1:], np.zeros(3), bias)
    felt = np.diff(dV @ rotation.from_rph(np.array([*rp, 0.0])).T, axis=0) / np.diff(t[1:])[:, None]
    a = felt[:, 0] + 1j * felt[:, 1]
    b = change[1:, 0] + 1j * change[1:, 1]
    z = np.vdot(a - a.mean(), b - b.mean())
    return float(-np.angle(z))


def _usual_rate(imu: Imu) -> Array:
    """Median turn rate, kept within what the sensor's turn-on bias can be, rad/s."""
    limit = 3.0 * imu.noise.gyro_bias_sigma
    return np.clip(np.median(imu.gyro, axis=0), -limit, limit)


def _thinned(gnss: Gnss, begin: float, end: float, spacing: float = 0.9) -> Gnss:
    """Fixes of a span at most about one a second: enough to align, and quick."""
    inside = np.flatnonzero((gnss.t >= begin) & (gnss.t <= end))
    keep, last = [], -np.inf
    for i in inside:
        if gnss.t[i] - last >= spacing:
            keep.append(i)
            last = gnss.t[i]
    return some(gnss, np.array(keep))


def _try(part: Recording, settings: Settings, frame: LocalFrame, smooth: Smoother, rph: Array, bias: Array) -> Solution:
    """Solve the short problem from one start attitude."""
    noise, gnss = part.imu.noise, part.gnss
    assert gnss is not None
    fixes = frame.from_llh(gnss.llh)
    R0 = rotation.from_rph(rph)
    start = States(R0[None], fixes[:1], np.zeros((1, 3)), np.zeros((1, 3)), bias[None])
    sigma = np.concatenate(
        [
            [0.3, 0.3, np.pi],
            [100.0] * 3,
            [50.0] * 3,
            [noise.accel_bias_sigma] * 3,
            [noise.gyro_bias_sigma] * 3,
        ]
    )
    # one bad fix or a burst must not decide the heading
    robust = settings.gnss.model_copy(
        update={"robust": "cauchy", "lever_arm_sigma": None, "time_offset_sigma": 0.0, "slow_share": 0.0}
    )
    # what the wheels say of the heading is brought in by `_with_course`
    problem = pose(part, settings.without_wheels().model_copy(update={"gnss": robust}), frame, start, sigma)
    dR, _, _ = prefix(problem.samples, problem.t[0], problem.t[1:], np.zeros(3), bias)
    t = problem.t
    p = np.stack([np.interp(t, gnss.t, fixes[:, k]) for k in range(3)], -1)
    v = np.gradient(p, t, axis=0)
    K = len(t)
    R = R0 @ np.concatenate([np.eye(3)[None], dR])
    return smooth(problem, States(R, p, v, np.zeros((K, 3)), np.tile(bias, (K, 1))))


def _with_course(solution: Solution, R: Array, sigma: float) -> tuple[Array, float, list[str]]:
    """Bring in that a vehicle's forward axis is its course, forwards or in reverse, to `COURSE_SIGMA`."""
    v = solution.states.v
    speed = np.linalg.norm(v[:, :2], axis=1)
    moving = speed > max(1.0, 0.5 * speed.max())
    forward = solution.states.R_nb[moving, :, 1]
    heading = np.arctan2(forward[:, 0], forward[:, 1])
    course = np.arctan2(v[moving, 0], v[moving, 1])
    off = rotation.wrap(course - heading)
    off = np.where(np.abs(off) > 0.5 * np.pi, rotation.wrap(off + np.pi), off)  # reverse
    mean = float(np.median(off))
    if abs(mean) > 3.0 * np.hypot(COURSE_SIGMA, sigma):
        return (
            R,
            sigma,
            [f"the body's forward axis is {abs(np.degrees(mean)):.0f} deg from the course: check the IMU's axes"],
        )
    gain = sigma**2 / (sigma**2 + COURSE_SIGMA**2)
    turn = rotation.exp(np.array([0.0, 0.0, -gain * mean]))  # heading is clockwise, rotation about up is not
    return turn @ R, float(np.sqrt(gain) * COURSE_SIGMA), []
