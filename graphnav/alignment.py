"""The first state of a drive: attitude, velocity, position and biases at the first IMU sample, with sigmas.

A short smoothing problem, posed and solved with the same parts as the whole drive, over the first stretch in
which the vehicle moves. Levelling (the mean specific force points up) and the median turn rate (a vehicle
mostly goes straight or stands) start it, and the heading that turns the felt accelerations into those of the
fixes. If that does not explain the fixes, the three headings 90 degrees apart from it are tried and the best
wins, so neither "it drives forward" nor a standing start is assumed. From there the gyro carries the attitude
back to the first sample.

What the short problem learned, the long one will learn again from the same data. So the result enters as the
point to start from, with a prior `prior_inflation` times wider than its own sigma: information counts once. Only
what the fixes do not contain, that a vehicle's forward axis is roughly its course, enters at its own worth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from graphnav import rotation
from graphnav.config import Settings
from graphnav.detectors import detect
from graphnav.earth import LocalFrame
from graphnav.errors import EstimationError
from graphnav.preintegration import bridge_gaps, prefix
from graphnav.problem import Problem, pose
from graphnav.recording import Gnss, Imu, Recording
from graphnav.rotation import Array
from graphnav.solution import Solution
from graphnav.state import States

COURSE_SIGMA = np.radians(10.0)  # rad, a stated forward axis against the course: mounting, side slip
_DISTANCE = 50.0  # m of travel the short problem wants to see
_FIXES = 10  # and fixes
_AT_ONCE = 0.05  # s from the start within which a foot that stands is found
_WALKING = 3.0  # m/s, 1-sigma of the start velocity of a foot in the air
_BASE = 5.0  # s between fixes that tell the first velocity
_JUMP = 6.0  # times what fixes usually are off their running median, or their sigma
_GOOD_FIT = 2.0  # squared sigmas per row below which no other start heading is tried

Smoother = Callable[[Problem, States], Solution]


@dataclass(frozen=True)
class Alignment:
    """The prior of the first keyframe: one state, 15 sigmas, and what was done in words."""

    state: States
    sigma: Array  # (15,) of the prior
    own_sigma: Array  # (3,) rad, of roll, pitch, heading as the alignment itself believes them
    notes: tuple[str, ...]
    motion: float | None = None  # s, about when the vehicle first moves; None when it never does
    until: float | None = None  # s, the end of the stretch it was found from, None when without motion

    @property
    def rph(self) -> Array:
        """Roll, pitch, heading, rad."""
        return rotation.to_rph(self.state.R_nb[0])


def align(recording: Recording, settings: Settings, frame: LocalFrame, smooth: Smoother) -> Alignment:
    """Find the first state of a recording.

    Parameters
    ----------
    smooth : solves a posed problem from start states; handed in because solvers stand behind this room.

    Raises
    ------
    EstimationError
        If nothing in the recording can give an attitude.
    """
    recording = _plausible(recording)
    span = _motion(recording, settings)
    if span is None:
        return _at_rest(recording, settings, frame)
    return replace(_in_motion(recording, settings, frame, smooth, span), motion=span[0], until=span[1])


def ready(recording: Recording, settings: Settings) -> bool:
    """Whether the fixes so far show all the motion that an alignment wants to see."""
    span = _motion(_plausible(recording), settings)
    return span is not None and recording.gnss is not None and span[1] < recording.gnss.t[-1]


def with_known_heading(found: Alignment, settings: Settings) -> Alignment:
    """The alignment with the start heading the user states, where there is one."""
    known = settings.alignment.heading
    if known is None:
        return found
    rph = found.rph
    rph[2] = np.radians(known)
    sigma = found.sigma.copy()
    sigma[2] = np.radians(settings.alignment.heading_sigma)
    return replace(
        found,
        state=replace(found.state, R_nb=rotation.from_rph(rph)[None]),
        sigma=sigma,
        notes=(
            *found.notes,
            f"start heading stated: {known:g} deg, 1-sigma {settings.alignment.heading_sigma:g} deg "
            f"(found: {np.degrees(found.rph[2]):.1f} deg)",
        ),
    )


def _plausible(recording: Recording) -> Recording:
    """Without the fixes that lie far off the running median of five: they would be taken for motion."""
    gnss = recording.gnss
    if gnss is None or len(gnss.t) < 5:
        return recording
    p = LocalFrame(gnss.llh[0]).from_llh(gnss.llh)[:, :2]
    off = np.linalg.norm(p - median_filter(p, size=(5, 1), mode="nearest"), axis=1)
    usual = np.maximum(np.median(off), np.linalg.norm(gnss.sd[:, :2], axis=1))
    return replace(recording, gnss=_some(gnss, off <= _JUMP * usual))


def _motion(recording: Recording, settings: Settings) -> tuple[float, float] | None:
    """The stretch (s) to align over: from just before the first motion until enough of it was seen."""
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


def _level(recording: Recording, begin: float, seconds: float = 1.0) -> Array:
    """(roll, pitch) from the mean specific force after `begin`, rad."""
    imu = recording.imu
    f = imu.accel[(imu.t > begin) & (imu.t <= begin + seconds)]
    f = (f if len(f) else imu.accel[:1]).mean(axis=0)
    return np.array([np.arctan2(-f[0], f[2]), np.arctan2(f[1], np.hypot(f[0], f[2]))])


def _usual_rate(imu: Imu) -> Array:
    """Median turn rate, kept within what the sensor's turn-on bias can be, rad/s."""
    limit = 3.0 * imu.noise.gyro_bias_sigma
    return np.clip(np.median(imu.gyro, axis=0), -limit, limit)


def _at_rest(recording: Recording, settings: Settings, frame: LocalFrame) -> Alignment:
    """Level only; the heading stays unknown."""
    noise, gnss = recording.imu.noise, recording.gnss
    begin, seconds = _standing(recording, settings)
    R = rotation.from_rph(np.array([*_level(recording, begin, seconds), 0.0]))
    tilt, sd_v = noise.accel_bias_sigma / 9.8 + np.radians(1.0), 0.5
    bias, sd_bias = np.zeros(3), noise.gyro_bias_sigma
    if settings.alignment.gyro_bias is not None:
        bias, sd_bias = np.array(settings.alignment.gyro_bias), settings.alignment.gyro_bias_sigma
    if begin > recording.start:
        dR, _, _ = prefix(bridge_gaps(recording.imu), recording.start, np.array([begin]), np.zeros(3), bias)
        R = R @ dR[0].T
        R = rotation.from_rph(rotation.to_rph(R) * [1.0, 1.0, 0.0])
        tilt, sd_v = np.hypot(tilt, sd_bias * (begin - recording.start)), _WALKING
    own = np.array([tilt, tilt, np.pi])
    if gnss is None or not len(gnss.t):
        # without fixes the first pose defines the frame: position and heading are exact by definition
        p, sd_p, sd_heading = np.zeros(3), np.full(3, 1e-3), 1e-4
        note = "no GNSS: levelled at the start, position and heading count from zero there"
    else:
        p = frame.from_llh(gnss.llh[0]) - R @ gnss.lever_arm
        sd_p, sd_heading = 10.0 * gnss.sd[0] + 1.0, np.pi
        note = "no motion in the GNSS fixes: levelled at the start, heading unknown"
    state = States(
        R[None],
        p[None],
        np.zeros((1, 3)),
        np.zeros((1, 3)),
        bias[None],
    )
    sigma = np.concatenate(
        [
            [settings.alignment.prior_inflation * tilt] * 2,
            [sd_heading],
            sd_p,
            [sd_v] * 3,
            [noise.accel_bias_sigma] * 3,
            [sd_bias] * 3,
        ]
    )
    return Alignment(state, sigma, own, (note,))


def _standing(recording: Recording, settings: Settings) -> tuple[float, float]:
    """From when (s), and for how long, to level: from the start, or for a foot that starts in the air its first stance.

    Of a stance the middle half is used.
    """
    if recording.platform == "foot":
        spans = detect(recording, settings).stationary
        if len(spans) and spans[0, 0] > recording.start + _AT_ONCE:
            length = float(spans[0, 1] - spans[0, 0])
            return float(spans[0, 0]) + 0.25 * length, min(1.0, 0.5 * length)
    return recording.start, 1.0


def _in_motion(
    recording: Recording, settings: Settings, frame: LocalFrame, smooth: Smoother, span: tuple[float, float]
) -> Alignment:
    gnss, imu = recording.gnss, recording.imu
    assert gnss is not None
    begin, end = max(span[0], recording.start), span[1]
    part = replace(
        recording.crop(begin - recording.start, end - recording.start),
        gnss=_thinned(gnss, begin, end),
    )
    bias = _usual_rate(imu)
    rp = _level(recording, begin)
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
    return _carried_back(recording, settings, best, R, wide, own, begin, tuple(notes))


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


def _thinned(gnss: Gnss, begin: float, end: float, spacing: float = 0.9) -> Gnss:
    """Fixes of a span at most about one a second: enough to align, and quick."""
    inside = np.flatnonzero((gnss.t >= begin) & (gnss.t <= end))
    keep, last = [], -np.inf
    for i in inside:
        if gnss.t[i] - last >= spacing:
            keep.append(i)
            last = gnss.t[i]
    return _some(gnss, np.array(keep))


def _some(gnss: Gnss, rows: Array) -> Gnss:
    """Fixes picked by index or mask."""
    pick = {"t": gnss.t[rows], "llh": gnss.llh[rows], "sd": gnss.sd[rows]}
    if gnss.v is not None and gnss.sd_v is not None:
        pick |= {"v": gnss.v[rows], "sd_v": gnss.sd_v[rows]}
    return replace(gnss, **pick)


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


def _carried_back(
    recording: Recording,
    settings: Settings,
    solution: Solution,
    R: Array,
    wide: Array,
    own: Array,
    begin: float,
    notes: tuple[str, ...],
) -> Alignment:
    """From the start of the short problem to the first sample of the recording."""
    imu, noise = recording.imu, recording.imu.noise
    bg, ba = solution.states.bg[0], solution.states.ba[0]
    p, v = solution.states.p[0], solution.states.v[0]
    sd = np.sqrt(np.diag(solution.covariance[0]))
    sd_bg = sd[12:15]
    sd_p, sd_v = np.full(3, 1.0) + 10.0 * sd[3:6], np.full(3, 0.5) + 10.0 * sd[6:9]
    if begin - recording.start > 0.05:
        still = _stands_until(imu, recording.start, begin)
        stood, back = still - recording.start, begin - still
        drift = np.zeros(3)
        if back > 0.05:
            dR, dV, dP = prefix(bridge_gaps(imu), still, np.array([begin]), ba, bg)
            R = rotation.exp(solution.frame.omega_n * back) @ R @ dR[0].T  # the Earth turned meanwhile
            g = solution.frame.gravity_n(p)
            v0 = v - g * back - R @ dV[0]
            p = p - v0 * back - 0.5 * g * back**2 - R @ dP[0]
            v = v0
            drift = sd_bg * back
            tilt = 9.8 * float(np.max(wide[:2] + drift[:2])) + float(np.max(sd[9:12]))
            sd_v, sd_p = sd_v + tilt * back, sd_p + sd_v * back + 0.5 * tilt * back**2
            notes = (*notes, f"carried back {back:.1f} s by the gyro to the first sample")
        if stood > 0.0:
            rest = imu.t <= still
            bg = imu.gyro[rest].mean(axis=0) - solution.frame.omega_n @ R
            v, sd_v = np.zeros(3), np.minimum(sd_v, 0.5)
            drift = np.hypot(drift, noise.gyro_noise_density * np.sqrt(stood))
            notes = (*notes, f"stands for the first {stood:.0f} s; the attitude is that of the first motion")
            sd_bg = np.full(3, noise.gyro_noise_density / np.sqrt(stood) + noise.gyro_bias_walk * np.sqrt(stood))
        p, sd_p, v, sd_v = _by_first_fixes(recording, solution.frame, R, (p, sd_p, v, sd_v))
        wide = np.hypot(wide, settings.alignment.prior_inflation * drift)
        own = np.hypot(own, np.abs(rotation.rph_jacobian(rotation.to_rph(R))) @ drift)
    sigma = np.concatenate(
        [wide, sd_p, sd_v, [noise.accel_bias_sigma] * 3, np.maximum(noise.gyro_bias_sigma, 5.0 * sd_bg)]
    )
    state = States(R[None], p[None], v[None], ba[None], bg[None])
    return Alignment(state, np.minimum(sigma, np.r_[[np.pi] * 3, [1e6] * 12]), own, notes)


def _stands_until(imu: Imu, start: float, end: float) -> float:
    """How long nothing but vibration is in the samples from the start: one-second means hardly differ. `start` if not.

    The last second before the first that differs is left out as well: something may have begun in it.
    """
    rows = imu.t <= end
    blocks = max(1, int(end - start))
    size = np.count_nonzero(rows) // blocks
    if size < 2 or blocks < 2:
        return start
    force = imu.accel[rows][: size * blocks].reshape(blocks, size, 3).mean(axis=1)
    rate = imu.gyro[rows][: size * blocks].reshape(blocks, size, 3).mean(axis=1)
    moves = np.any((_range(force) > 0.25) | (_range(rate) > 0.02), axis=1)
    if not moves.any():
        return end
    stood = int(np.argmax(moves)) - 1
    return float(imu.t[size * stood - 1]) if stood >= 2 else start


def _range(x: Array) -> Array:
    """(N, k) highest less lowest so far."""
    return np.maximum.accumulate(x, axis=0) - np.minimum.accumulate(x, axis=0)


def _by_first_fixes(
    recording: Recording, frame: LocalFrame, R: Array, found: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Position and velocity at the start, each with its sigma: as found, or by the first fixes where these know more.

    Inertial sensors lose the place within a minute or so; fixes from before the first motion are still there.
    """
    p, sd_p, v, sd_v = found
    gnss = recording.gnss
    assert gnss is not None
    inside = np.flatnonzero((gnss.t >= recording.start - 0.5) & np.isfinite(gnss.llh).all(axis=1))
    i, later = inside[0], inside[gnss.t[inside] >= gnss.t[inside[0]] + _BASE]
    fix = frame.from_llh(gnss.llh[i]) - R @ gnss.lever_arm
    v_fix, sd_v_fix = v, np.full(3, np.inf)
    if len(later):
        j, dt = later[0], float(gnss.t[later[0]] - gnss.t[i])
        v_fix = (frame.from_llh(gnss.llh[j]) - frame.from_llh(gnss.llh[i])) / dt
        sd_v_fix = 3.0 * np.hypot(gnss.sd[i], gnss.sd[j]) / dt + 2.0 * dt  # the speed may change meanwhile, 2 m/s^2
    if np.linalg.norm(sd_v_fix) < np.linalg.norm(sd_v):
        v, sd_v = v_fix, sd_v_fix
    away = abs(float(gnss.t[i]) - recording.start)
    sd_fix = 1.0 + 10.0 * gnss.sd[i] + (np.linalg.norm(v) + sd_v) * away
    if np.linalg.norm(sd_fix) < np.linalg.norm(sd_p):
        p, sd_p = fix - v * (gnss.t[i] - recording.start), sd_fix
    return p, sd_p, v, sd_v
