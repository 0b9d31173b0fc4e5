"""A device that is turned in its holder in mid-drive: found by the drive, and undone.

The gyro shows a turn that the course does not, and afterwards the wheels roll another way in the device's axes. For
each keyframe the device's attitude, as found or by the gyro alone, and the course make its mounting; where the means of
some keyframes before and after differ by more than anywhere else, the device may have been turned. How the mounting
goes from one to the other, row by row, says when. There the rows of the IMU are left out, as it measured another motion
than the vehicle's, and are filled in as those of any gap; those after it are turned back, so that arms and axes stay
those of the beginning. Biases begin anew: they belong to the device, and so do errors of its axes that gravity made
look like biases.

Whether it was turned, and not the vehicle in a way that no wheels allow, the evidence of the measurements decides: with
the rows turned back it must be larger by what a fault must be certain by.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from graphnav.constraints.vehicle import NHC_ERROR, NonHolonomic
from graphnav.core import rotation
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.estimation.faults.watch import FAULT_COST
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import Remounting
from graphnav.estimation.preparation import Begun
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.breakdown import BREAKDOWN
from graphnav.estimation.solvers.linearise import Points, linearise, shift
from graphnav.imu.preintegration import multiply_up
from graphnav.recording import Imu, Recording, take_rows

_MEANS = 10, 30  # moving keyframes whose mean is the mounting before or after
_MOVING = 0.3, 1.0  # of the usual speed, and m/s: slower than both, the course is uncertain
_OUTSTANDING = 2.0  # how many times larger than any other a change is that is looked into
_LEAST = np.deg2rad(3.0)  # as slip in a turn may seem
_BEGUN, _DONE = 0.2, 0.8  # shares of the turn by which its times are found
_BEYOND = 0.75  # of the time between these, before and after: the rest, and slow ends
_SIGMAS = 3.0  # that a turn is larger than
_LONGEST = 4.0  # s that it takes
_MOSTLY = 0.5  # of the change: what comes about in that time, what the estimate shows, what two measures share
_RATE = 0.5  # s beside it in which the vehicle's turn rate is measured
_MEDIAN = 1.538  # of the length of a vector of three standard normal numbers
_SEARCHED = 10.0  # s about the keyframes between which it is
_BESIDE = 60.0  # s before and after in which the wheels tell its angle
_SETTLED = np.deg2rad(0.1)
_STEPS = 5  # of Gauss-Newton for the angle
_MOST = 4  # of a drive

_Begin = Callable[..., Begun]  # a recording, and `before`: what was begun with another turn


def undo_remountings(recording: Recording, remountings: tuple[Remounting, ...]) -> Recording:
    """The recording as of a device that was never turned.

    Parameters
    ----------
    remountings : in the order in which they were found.

    Returns
    -------
    Recording
        Without rows of the IMU while it was turned.
    """
    for one in remountings:
        if not recording.start < one.end < recording.end:  # of another piece
            continue
        imu = recording.imu
        after = (imu.t > one.end)[:, None]
        R = rotation.exp(np.array(one.rotation))
        gyro, accel = (np.where(after, x @ R.T, x) for x in (imu.gyro, imu.accel))
        whole = replace(imu, gyro=gyro, accel=accel, remounted=(*imu.remounted, one.end))
        recording = replace(recording, imu=take_rows(whole, (imu.t <= one.begin) | (imu.t > one.end)))
    return recording


def find_remountings(recording: Recording, begin: _Begin, begun: Begun) -> tuple[Remounting, ...]:
    """When the device was turned in its holder, and how: one after the other, of the recording without those before.

    Parameters
    ----------
    begin : begins the preparation of a recording.
    begun : that of this one.
    """
    found: tuple[Remounting, ...] = ()
    while len(found) < _MOST:
        best, limit = begun, FAULT_COST
        for one in _find_changes(begun):
            with contextlib.suppress(*BREAKDOWN):
                fitted, other = _fit(recording, begin, found, one)
                likelier = _is_turn(fitted) and _weigh_common(other, best) - _weigh_common(best, other) > limit
                kept, left = (other, best) if likelier else (best, other)
                kept.passes.update(left.all_passes)
                if likelier:
                    last, best, limit = fitted, other, 0.0
        if best is begun:
            break
        found, begun = (*found, last), best
    return found


def _is_turn(one: Remounting) -> bool:
    """Whether it turns: a gyro that errs for a moment does not, and its rows are those of a disturbed interval."""
    return bool(np.linalg.norm(one.rotation) > max(_LEAST, _SIGMAS * one.sigma))


def _weigh_common(one: Begun, other: Begun) -> float:
    """The logarithm of the evidence of the rows that another problem has as well: both stand at other times."""
    assert one.found is not None
    assert other.found is not None
    problems = one.found.base, other.found.base
    ours, theirs = ({c.name: (x.t[c.keyframe],) * 2 for c in x.constraints} for x in problems)
    return one.log_evidence - one.weigh_lacking(ours, theirs)


def _fit(
    recording: Recording, begin: _Begin, found: tuple[Remounting, ...], one: Remounting
) -> tuple[Remounting, Begun]:
    """The turn by which the wheels roll the same way before and after; or one as small as is none."""
    other = begin(undo_remountings(recording, (*found, one)))
    for _ in range(_STEPS):
        left = _measure_rest(other, one)
        if np.linalg.norm(left) < _SETTLED:
            break
        R = rotation.exp(left) @ rotation.exp(np.array(one.rotation))
        ahead = replace(one, rotation=tuple(rotation.log(R).tolist()))
        if not _is_turn(ahead):
            return ahead, other
        more = begin(undo_remountings(recording, (*found, ahead)), before=other)
        gained = more.log_evidence - other.log_evidence
        if gained > 0.0:
            one, other = ahead, more
        if gained < other.gained_by_chance:
            break
    return one, other


def _find_changes(begun: Begun) -> tuple[Remounting, ...]:
    """The change of the mounting that stands out, if any: by the gyro then, and by the mountings before and after."""
    if begun.found is None or not any(isinstance(c, NonHolonomic) for c in begun.found.base.constraints):
        return ()
    problem, states = begun.found.base, begun.found.estimate.points.states
    speed = np.linalg.norm(states.v, axis=1)
    usual, surely = _MOVING
    moving = np.flatnonzero(speed > min(usual * np.median(speed[speed >= np.median(speed)]), surely))
    t, v = problem.t[moving], states.v[moving]
    by_gyro = _turn_by_gyro(problem, states)
    mountings = _relate(v, states.R_nb[moving]), _relate(v, by_gyro[moving])
    outstanding, best, largest = max(
        (_find_largest(one, n) for one in mountings for n in _MEANS if len(one) > 4 * n + 1),
        default=(0.0, 0, 0.0),
    )
    if outstanding < _OUTSTANDING or largest < _LEAST:
        return ()
    n = _MEANS[0]
    (_, as_found), (before, rotation_vector) = (_compare_means(one, best, n) for one in mountings)
    imu, bias = begun.recording.imu, np.median(states.bg, axis=0)
    rows = np.flatnonzero((imu.t > max(t[best - 1] - _SEARCHED, problem.t[0])) & (imu.t <= t[best] + _SEARCHED))
    times, at = imu.t[rows], int(np.searchsorted(problem.t, imu.t[rows[0]], side="right")) - 1
    steps = rotation.exp((imu.gyro[rows] - bias) * np.diff(times, prepend=problem.t[at])[:, None])
    R_nb = by_gyro[at] @ multiply_up(steps[:, None])[1:, 0]
    course = np.stack([np.interp(times, t, x) for x in v.T], -1)
    done = rotation.log(before.T @ _relate(course, R_nb)) @ rotation_vector / (rotation_vector @ rotation_vector)
    if (span := _find_span(times, done)) is None:
        return ()
    ends = np.searchsorted(problem.t, span).clip(0, len(problem.t) - 1)
    by, found = (some[ends[0]].T @ some[ends[1]] for some in (by_gyro, states.R_nb))
    # the change that the estimate shows, with what it takes for an error of the gyro meanwhile: nearly none where the
    # gyro's bias changes for longer
    if np.linalg.norm(rotation.log(by @ found.T @ rotation.exp(as_found))) < _MOSTLY * np.linalg.norm(rotation_vector):
        return ()
    by_rows = _turn_by_rows(imu, bias, times, R_nb, span, rotation_vector)
    if np.linalg.norm(by_rows) < _LEAST:  # as where a vehicle backs out: its course changes, and no gyro says so
        return ()
    angle, k = _measure_changes(mountings[1], n)
    sigma = float(np.median(angle[np.abs(k - best) > n])) / _MEDIAN
    apart = rotation.log(rotation.exp(-by_rows) @ rotation.exp(rotation_vector))
    mostly = np.linalg.norm(apart) < _MOSTLY * np.linalg.norm(rotation_vector)  # or else the vehicle turned as well
    vectors = (by_rows, rotation_vector) if mostly else (rotation_vector,)
    return tuple(Remounting(*span, tuple(one.tolist()), sigma) for one in vectors)


def _find_span(times: Array, done: Array) -> tuple[float, float] | None:
    """When the device was turned, s, by the share of it that was done at each of some times; None if not at once."""
    behind = np.minimum(np.searchsorted(times, times + _LONGEST), len(times) - 1)
    first = int(np.argmax(done[behind] - done))
    whole = done[behind[first]] - done[first]
    if whole < _MOSTLY:
        return None
    part = slice(first, behind[first] + 1)
    begin, end = (float(times[part][np.argmax(done[part] - done[first] > share * whole)]) for share in (_BEGUN, _DONE))
    beyond = _BEYOND * (end - begin)
    return begin - beyond, end + beyond


def _turn_by_rows(imu: Imu, bias: Array, times: Array, R_nb: Array, span: tuple[float, float], near: Array) -> Array:
    """The rotation vector (3,) of a change by what the gyro turned within a span (s), less what the vehicle turned: at
    the mean of its rates beside it, where the device was turned by about `near`.
    """
    begin, end = (min(int(np.searchsorted(times, t)), len(times) - 1) for t in span)
    rates = []
    for some in (imu.t <= span[0]) & (imu.t > span[0] - _RATE), (imu.t > span[1]) & (imu.t <= span[1] + _RATE):
        rates.append(imu.gyro[some].mean(axis=0) - bias if some.any() else np.zeros(3))
    turned = 0.5 * (rates[0] + rotation.exp(near) @ rates[1]) * (times[end] - times[begin])
    return rotation.log(rotation.exp(-turned) @ R_nb[begin].T @ R_nb[end])


def _measure_changes(mounting: Array, n: int) -> tuple[Array, Array]:
    """Angles (m,), rad, between the means of n mountings (N, 3, 3) before and from each of some on, and these (m,)."""
    sums = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(mounting, axis=0)])
    k = np.arange(n, len(mounting) - n + 1)
    before, after = _project(sums[k] - sums[k - n]), _project(sums[k + n] - sums[k])
    return np.linalg.norm(rotation.log(np.swapaxes(before, -1, -2) @ after), axis=1), k


def _compare_means(mounting: Array, best: int, n: int) -> tuple[Array, Array]:
    """The mean (3, 3) of n mountings before one, and the rotation vector (3,), rad, to that of n from there on."""
    before, after = (_project(some.sum(axis=0)) for some in (mounting[best - n : best], mounting[best : best + n]))
    return before, rotation.log(before.T @ after)


def _find_largest(mounting: Array, n: int) -> tuple[float, int, float]:
    """How many times the largest change is larger than any that has nothing in common with it, where it is, and its
    angle, rad.
    """
    angle, k = _measure_changes(mounting, n)
    best = int(angle.argmax())
    others = angle[np.abs(k - k[best]) > n]
    return float(angle[best] / others.max()), int(k[best]), float(angle[best])


def _turn_by_gyro(problem: Problem, states: States) -> Array:
    """(K, 3, 3) attitudes at the keyframes from the first on by the gyro alone, with one bias; over gaps, as found."""
    intervals = problem.intervals
    more = (intervals.theta_bg @ (np.median(states.bg, axis=0) - intervals.bg)[..., None])[..., 0]
    turned, found = intervals.dR @ rotation.exp(more), np.swapaxes(states.R_nb[:-1], -1, -2) @ states.R_nb[1:]
    begin, end = problem.samples.bridged.T[:, :, None]
    lost = ((intervals.t0 < end) & (intervals.t1 > begin)).any(axis=0)
    return np.asarray(states.R_nb[0] @ multiply_up(np.where(lost[:, None, None], found, turned)[:, None])[:, 0])


def _relate(v: Array, R_nb: Array) -> Array:
    """(n, 3, 3) from the device's axes to right, forward and up along a course: velocities (n, 3)."""
    forward = v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-9)
    return np.stack([right, forward, np.cross(right, forward)], axis=-2) @ R_nb


def _project(sums: Array) -> Array:
    """The rotations (n, 3, 3) nearest to sums of some."""
    U, _, Vt = np.linalg.svd(sums)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]  # no reflection
    return np.asarray(U @ Vt)


def _measure_rest(begun: Begun, one: Remounting) -> Array:
    """(3,) rad by which the wheels roll another way after than before, about right, forward (unknown: 0) and up."""
    assert begun.found is not None
    found = begun.found.estimate
    problem = apply_noise(begun.found.base, found.noise)
    rows = next(c for c in problem.constraints if isinstance(c, NonHolonomic))
    points = Points(found.points.states, found.points.values.copy())
    if NHC_ERROR in problem.columns:  # which hides it
        points.values[:, shift(problem.columns[NHC_ERROR])] = 0.0
    t = problem.t[rows.keyframe]
    before, after = t <= one.begin, t > one.end + 1.0  # of a second, that their means are of
    sides = []
    for near in (before & (t > one.begin - _BESIDE), after & (t < one.end + _BESIDE)):
        which = np.flatnonzero(near)
        off = linearise(rows, points, problem.columns, which).residual
        states = points.states[rows.keyframe[which]]
        speed = (states.R_nb[:, :, 1] * states.v).sum(axis=1)
        sides.append(speed @ off / max(float(speed @ speed), 1e-9))
    right, up = sides[1] - sides[0]
    return np.array([-up, 0.0, right])


def describe_remountings(remountings: tuple[Remounting, ...], recording: Recording) -> tuple[str, ...]:
    """Notes on a device that was turned in its holder."""
    return tuple(
        Note(
            "imu.remounted",
            f"the IMU was turned in its holder, by {np.degrees(np.linalg.norm(one.rotation)):.0f} +- "
            f"{np.degrees(one.sigma):.1g} deg, within {one.begin - recording.start:.1f} to "
            f"{one.end - recording.start:.1f} s: what it measured after that is turned back, what it did then not "
            "used; fasten it",
        )
        for one in remountings
    )
