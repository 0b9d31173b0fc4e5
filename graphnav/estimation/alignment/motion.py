"""The first state from motion: a short smoothing problem over the first span in which the vehicle moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.raw_phase import GnssPhase
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.running import run_median
from graphnav.core.state import States
from graphnav.detectors.base import NONE, mask_inside
from graphnav.estimation.alignment.back import carry_back
from graphnav.estimation.alignment.course import COURSE_SIGMA, use_course
from graphnav.estimation.alignment.first import Alignment, level, pick_fixes
from graphnav.estimation.alignment.scale import measure_scale, widen_sigmas
from graphnav.estimation.alignment.travel import average_across, integrate_yaw, measure_travel
from graphnav.estimation.fixing import split_carriers
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import STATED
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solution import Solution
from graphnav.imu.preintegration import integrate_prefix
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Gnss, Imu, Recording
from graphnav.recording.plausibility.fixes import GRIP

# rad, to which the fixes must determine the direction of travel: better than the other contributions
_DIRECTION = 0.5 * COURSE_SIGMA
_WANTED_FIXES = 10  # fixes that the short problem should contain
FEWEST_FIXES = 5  # of three numbers each, without which it cannot determine the fifteen of a state
_FEWEST_FOR_ACCELERATION = 3  # fixes without which there is no acceleration
_MOVING_SIGMAS = 5.0  # sigmas of travel that count as motion: noise reaches them once in 270 000 fixes, exp(-5^2/2)
_LEAD_TIME = 10.0  # s of the span before the motion
_MAX_ROUNDS = 10  # of headings tried and sigmas measured; few need more than two
_OUTLYING = 6.0  # multiple of the typical deviation of fixes from their running median, or of their sigma
_VAGUE = 10.0  # multiple of the sigma of those around: a hundredth of their weight
# rad, of the initial headings that are tried, relative to the first guess
_HEADINGS_TRIED = (0.0, 0.5 * np.pi, 1.5 * np.pi, np.pi)
_UNLIKELY = 14.0  # difference of log-likelihoods at a ratio of one in a million: -ln 1e-6


class _End(Exception):
    """Raised to end a solution early: its heading leads nowhere, or to another solution."""

    def __init__(self, known: Solution | None = None) -> None:
        self.known = known


def drop_implausible(recording: Recording) -> Recording:
    """Drop the fixes that would be taken for motion, far off the running median of five, or would hide it.

    From one much vaguer than those around it no distance is measured: a receiver's first, or one marked so. The first
    and the last are compared with the line through the medians beside them, from which a vehicle may accelerate.
    """
    gnss = recording.gnss
    if gnss is not None and not np.isfinite(gnss.llh).all():
        gnss = pick_fixes(gnss, np.flatnonzero(np.isfinite(gnss.llh).all(axis=1)))
        recording = replace(recording, gnss=gnss)
    if gnss is None or len(gnss.t) < 5:
        return recording
    gnss = pick_fixes(gnss, np.flatnonzero(average_across(gnss.sd) <= _VAGUE * _find_usual(average_across(gnss.sd))))
    p = LocalFrame(gnss.llh[0]).from_llh(gnss.llh)[:, :2]
    middle = run_median(p, 5)
    off = np.linalg.norm(p - middle, axis=1)
    for end, near, far in ((0, 2, 4), (-1, -3, -5)):  # there the median is the fix itself
        dt = gnss.t[end] - gnss.t[[near, far]]
        line = middle[near] + (middle[far] - middle[near]) * dt[0] / (dt[0] - dt[1])
        off[end] = max(0.0, float(np.linalg.norm(p[end] - line)) - 0.5 * GRIP * abs(dt[0] * dt[1]))
    typical = np.maximum(np.median(off), np.linalg.norm(gnss.sd[:, :2], axis=1))
    return replace(recording, gnss=pick_fixes(gnss, off <= _OUTLYING * typical))


def _find_usual(sd: Array) -> Array:
    """The median (N,) of the sigmas `sd` (N,) about each, of as many at the ends."""
    size = min(_WANTED_FIXES, len(sd))
    medians = np.median(np.lib.stride_tricks.sliding_window_view(sd, size), axis=1)
    return np.asarray(medians[np.clip(np.arange(len(sd)) - size // 2, 0, len(medians) - 1)])


def find_motion_span(
    recording: Recording, settings: Settings, stationary: Array = NONE, wanted: int = _WANTED_FIXES
) -> tuple[float, float] | None:
    """The span (s) to align over: from just before the first motion until there has been enough of it.

    The platform moves where it is farther away than errors of the fixes explain, over ground or in its own axes
    (`graphnav.estimation.alignment.travel`); there is enough motion once these errors leave little doubt about the
    direction, after `wanted` fixes at least. Apparent motion of the fixes while a vehicle is stationary, `stationary`
    (N, 2) s, does not count.
    """
    gnss = recording.gnss
    if gnss is None:
        return None
    used = (gnss.t >= recording.start) & (gnss.t <= recording.end)
    if np.count_nonzero(used) < _FEWEST_FOR_ACCELERATION:
        return None
    gnss = _thin(gnss, recording.start, recording.end)
    if len(gnss.t) < _FEWEST_FOR_ACCELERATION:
        return None
    t, p = gnss.t, LocalFrame(gnss.llh[0]).from_llh(gnss.llh)[:, :2]
    if recording.platform == "vehicle":
        yaw, still = integrate_yaw(recording.imu, t, _estimate_rate(recording.imu)), mask_inside(t, stationary)
    else:  # a foot turns about every axis
        yaw, still = np.zeros(len(t)), np.zeros(len(t), dtype=bool)
    sd = average_across(gnss.sd)
    way = measure_travel(p, sd, yaw, still)
    away = np.maximum(way.times_sigma, measure_travel(p, sd, np.zeros(len(t)), still).times_sigma) > _MOVING_SIGMAS
    if not away.any():
        return None
    first = int(np.argmax(away))
    enough = (way.times_sigma > 1.0 / np.tan(_DIRECTION)) & (t > t[first] + settings.alignment.window)
    enough &= np.arange(len(t)) >= first + wanted
    last = int(np.argmax(enough)) if enough.any() else len(t) - 1
    # at the speed that followed, it took a while to get that far
    speed = np.abs(way.D[last] - way.D[first]) / max(t[last] - t[first], 1.0)
    under_way = np.abs(way.D[first]) / speed if speed > 0.0 else np.inf
    begin = min(t[first] - _LEAD_TIME - under_way, t[max(last - _FEWEST_FOR_ACCELERATION + 1, 0)])
    return float(max(t[0], np.round(begin, 3))), float(t[last])  # rounding errors of D must not count


def align_in_motion(
    recording: Recording,
    settings: Settings,
    frame: LocalFrame,
    span: tuple[float, float],
    stationary: Array = NONE,
    before: Alignment | None = None,
) -> Alignment:
    """The first state from the short problem over `span` (s), carried back to the first sample.

    The platform stands in the intervals `stationary` (N, 2) s. `before` is the alignment of nearly the same recording:
    the headings that it found are tried, and no others.
    """
    gnss, imu = recording.gnss, recording.imu
    assert gnss is not None
    begin, end = max(span[0], recording.start), span[1]
    part = replace(
        recording.crop(begin - recording.start, end - recording.start),
        gnss=_thin(gnss, begin, end),
    )
    bias = _estimate_rate(imu)
    rp = level(recording, begin)
    heading = _fit_heading(part, frame, rp, bias)
    headings = [heading + turn for turn in _HEADINGS_TRIED]
    if before is not None and before.motion is not None and before.headings:
        turned = integrate_yaw(imu, np.sort([before.motion, begin]), bias)[1]
        headings = [known - turned if begin > before.motion else known + turned for known in before.headings]
    problem, widened = _build_short(part, settings, frame, np.array([*rp, heading]), bias), STATED
    for _ in range(_MAX_ROUNDS):
        used = apply_noise(problem, widened)
        tried = _try(used, rp, [_guess_start(used, rp, one) for one in headings])
        if not tried:
            raise EstimationError(
                f"'{recording.name}': no initial attitude explains the GNSS fixes between "
                f"{begin - recording.start:.0f} and {end - recording.start:.0f} s; check the axes, the units and the "
                "time stamps",
                key="alignment.not_explained",
            )
        best = min(tried, key=lambda one: one.cost)
        more = measure_scale(used, best)
        if not more:
            break
        widened = widen_sigmas(widened, more)
    R, P = best.states.R_nb[0], best.covariance[0][:3, :3]
    wide = settings.alignment.prior_inflation * np.sqrt(np.diag(P))
    J = rotation.rph_jacobian(rotation.to_rph(R))
    own = np.sqrt(np.diag(J @ P @ J.T))
    notes: tuple[str, ...] = ()
    if recording.platform == "vehicle":
        assert part.gnss is not None
        course = use_course(tried, part.gnss, own[2], wide[2])
        R = rotation.exp(np.array([0.0, 0.0, -course.turn])) @ R  # heading is clockwise, rotation about up is not
        own[2], wide[2], notes = course.own, course.wide, course.notes
    notes = (
        Note(
            "alignment.motion",
            f"aligned over {begin - recording.start:.0f} to {end - recording.start:.0f} s: roll and pitch to "
            f"{np.degrees(own[:2].max()):.2g} deg, heading to {np.degrees(own[2]):.2g} deg",
        ),
        *notes,
    )
    found = carry_back(recording, settings, best, R, wide, own, begin, stationary, notes)
    # what was still moving at the limit of iterations is no minimum
    minima = {id(one): one for one in tried if one.iterations < settings.solver.max_iterations}.values()
    return replace(found, headings=tuple(float(rotation.to_rph(one.states.R_nb[0])[2]) for one in minima))


def _fit_heading(part: Recording, frame: LocalFrame, rp: Array, bias: Array) -> float:
    """Heading (rad) at the start of `part` that maps levelled accelerations to those of the fixes.

    With both horizontal accelerations as complex numbers east + i north, fixes = z * measured + d by least squares; the
    argument of z is the rotation from the frame of zero heading, d absorbs tilt.
    """
    gnss = part.gnss
    assert gnss is not None
    t = gnss.t
    p = frame.from_llh(gnss.llh)
    v = gnss.v if gnss.v is not None and np.isfinite(gnss.v).all() else np.gradient(p, t, axis=0)
    change = np.diff(v, axis=0) / np.diff(t)[:, None]
    _, dV, _ = integrate_prefix(bridge_gaps(part.imu), part.start, t[1:], np.zeros(3), bias)
    felt = np.diff(dV @ rotation.from_rph(np.array([*rp, 0.0])).T, axis=0) / np.diff(t[1:])[:, None]
    a = felt[:, 0] + 1j * felt[:, 1]
    b = change[1:, 0] + 1j * change[1:, 1]
    z = np.vdot(a - a.mean(), b - b.mean())
    return float(-np.angle(z))


def _estimate_rate(imu: Imu) -> Array:
    """Median turn rate, limited to the sensor's turn-on bias, rad/s."""
    limit = 3.0 * imu.noise.gyro_bias_sigma
    return np.clip(np.median(imu.gyro, axis=0), -limit, limit)


def _thin(gnss: Gnss, begin: float, end: float, spacing: float = 0.9) -> Gnss:
    """Fixes of a span, about one a second at most: enough to align, and fast."""
    there = np.flatnonzero((gnss.t >= begin) & (gnss.t <= end))
    keep, last = [], -np.inf
    for i in there:
        if gnss.t[i] - last >= spacing:
            keep.append(i)
            last = gnss.t[i]
    return pick_fixes(gnss, np.array(keep))


def _try(problem: Problem, rp: Array, starts: Sequence[States]) -> list[Solution]:
    """Solutions of the short problem from each of the starts, levelled by the IMU beforehand.

    Headings that point elsewhere mostly lead to the same minimum, and are that solution as soon as they are within a
    sigma of it. Or they move slowly along a saddle, and are abandoned where the likelihood they can still reach is
    negligible beside the best; `worth` successive fixes are worth one in the worst case, over a span with one turn
    (`graphnav.estimation.alignment.course`).
    """
    gnss = problem.recording.gnss
    assert gnss is not None
    worth = max(1.0, len(gnss.t) / (2.0 * np.pi))
    tried: list[Solution] = []

    def watch(states: States, cost: float, gain: float, slow: bool) -> None:
        if slow and cost - gain > min((one.cost for one in tried), default=np.inf) + _UNLIKELY * worth:
            raise _End
        for one in tried:
            if gain < 0.5 and cost - gain > one.cost and _is_within_a_sigma(states, one):
                raise _End(one)

    for start in starts:
        try:
            found: Solution | None = _solve_from(problem, rp, start, watch)
        except _End as end:
            found = end.known
        if found is not None and np.isfinite(found.cost):
            tried.append(found)
    return tried


def _is_within_a_sigma(states: States, solution: Solution) -> bool:
    """Whether the first of the states agrees with that of a solution to within a sigma."""
    e = states[:1].minus(solution.states[:1])[0]
    return float(e @ np.linalg.solve(solution.covariance[0], e)) < 1.0


def _build_short(part: Recording, settings: Settings, frame: LocalFrame, rph: Array, bias: Array) -> Problem:
    """Build the short problem with an initial attitude as the mean of its prior."""
    noise, gnss = part.imu.noise, part.gnss
    assert gnss is not None
    fixes = frame.from_llh(gnss.llh[:1])
    start = States(rotation.from_rph(rph)[None], fixes, np.zeros((1, 3)), np.zeros((1, 3)), bias[None])
    sigma = np.concatenate(
        [
            [0.3, 0.3, np.pi],
            [100.0] * 3,
            [50.0] * 3,
            [noise.accel_bias_sigma] * 3,
            [noise.gyro_bias_sigma] * 3,
        ]
    )
    # an outlying fix or a burst must not decide the heading
    robust = settings.gnss.model_copy(update={"robust": "cauchy", "lever_arm_sigma": None, "time_offset_sigma": 0.0})
    # the information of the wheels on the heading is added by `use_course`
    problem = build_problem(part, settings.without_wheels().model_copy(update={"gnss": robust}), frame, start, sigma)
    return split_carriers(problem, GnssPhase)[0]


def _guess_start(problem: Problem, rp: Array, heading: float) -> States:
    """States by the fixes, turned by the gyro from one initial attitude."""
    gnss, mean, t = problem.recording.gnss, problem.prior.mean, problem.t
    assert gnss is not None
    assert mean is not None
    R0, fixes, bias = rotation.from_rph(np.array([*rp, heading])), problem.frame.from_llh(gnss.llh), mean.bg[0]
    dR, _, _ = integrate_prefix(problem.samples, t[0], t[1:], np.zeros(3), bias)
    p = np.stack([np.interp(t, gnss.t, fixes[:, k]) for k in range(3)], -1)
    v = np.gradient(p, t, axis=0)
    K = len(t)
    R = R0 @ np.concatenate([np.eye(3)[None], dR])
    return States(R, p, v, np.zeros((K, 3)), np.tile(bias, (K, 1)))


def _solve_from(
    problem: Problem, rp: Array, start: States, watch: Callable[[States, float, float, bool], None]
) -> Solution:
    """Solve the short problem from a start, with its heading and the level attitude in the prior."""
    from graphnav.estimation.factor_graph.batch import batch  # imports GTSAM, which a recording at rest does not need

    mean = problem.prior.mean
    assert mean is not None
    R0 = rotation.from_rph(np.array([*rp, rotation.to_rph(start.R_nb[0])[2]]))
    problem = replace(problem, prior=replace(problem.prior, mean=replace(mean, R_nb=R0[None])))
    return batch(problem, start, wanted=(0,), reintegrate=False, watch=watch)
