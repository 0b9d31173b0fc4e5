"""Trajectories of other programs beside our solutions: on the recording's clock, on the Earth, at the IMU.

A file may count time from any zero. It is put on the recording's clock by what is known of both clocks (GPS week, Unix
time, UTC), otherwise by its own start. A time shift found from the speeds is applied if it exceeds a second (leap
seconds, another start), and only reported if it is less, for then it is an error of the other program.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import RecordingError
from graphnav.core.interpolation import fit_yaw, interpolate, place_on_earth
from graphnav.core.notes import Note, Notes, format_count, get_key
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.core.timescales import LEAP, NEAR, compute_clock_offset
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.solution import Solution
from graphnav.evaluation.conventions import find_other_axes, require_right_handed
from graphnav.evaluation.metrics import Metrics
from graphnav.recording import Gnss, Recording
from graphnav.recording.checks import crosschecks, tracks
from graphnav.recording.checks.clock import CLEAR
from graphnav.recording.checks.tracks import Track
from graphnav.recording.formats.trajectories import read_trajectory

_ARM = "gnss_lever_arm"  # parameter of a solution
_MAX_GAP = 3.0  # s; wider gaps of a trajectory are not filled
_APPLIED = 1.0  # s; a larger shift is one of the clock
_FEWEST_COMMON = 10  # rows in common, at least
_MATTERS, _SIGNIFICANT = 0.02, 3.0  # s and sigmas; a smaller shift is not reported, or may be chance
_FARTHEST = 10_000.0  # m; frames of other datums, and diverging filters, are closer than that to the start
_CHORD = 10.0  # s; over so long a chord the noise of positions does not hide distance and direction
_LEAST_SPEED = 1.0  # m/s
# share of the squared chords, and of the variance of their lengths, that two trajectories of one drive have in common
_COMMON_SHARE = 0.5
_MENDED = 0.3  # ratio of the discrepancies with and without another point below which that point explains them
_SPEED_STEP = 0.1  # s, between speeds of our solution


@dataclass(frozen=True)
class Against:
    """A trajectory file to compare with: its point on the body, and s to add to its stamps (None: to be found)."""

    path: Path
    point: str | Array = "imu"  # "imu", "antenna", or a lever arm (3,) m, RFU
    shift: float | None = None


@dataclass(frozen=True)
class Foreign(Solution):
    """Another program's trajectory with the interface of a solution: states and the sigmas it states, nothing else."""

    track: Trajectory = field(default_factory=lambda: Trajectory(np.empty(0), np.empty((0, 3))))
    # whether the attitude is borrowed from our solution to refer points of the body, and not its own
    borrowed: bool = False
    # (3,) m from the IMU to its antenna, RFU: by which a file of the antenna was moved, else as stated
    lever_arm: Array | None = None

    def trajectory(self, rate: float | None = None, joint: bool = True) -> Trajectory:
        """The trajectory at the keyframes of the solution beside it, or at `rate` (Hz), with what it states."""
        t = self.t if rate is None else np.arange(self.track.t[0], self.track.t[-1], 1.0 / rate)
        track = self.track_at(t)
        return replace(track, rph=None, sd_rph=None) if self.borrowed else track

    def track_at(self, t: Array) -> Trajectory:
        """The trajectory at those times (M,) at which it can be interpolated."""
        return interpolate(self.track, t, max_gap=_MAX_GAP)[0]

    def at(self, t: ArrayLike) -> tuple[Array, States, Array]:
        """Times, states (NaN where unknown) and covariances (NaN) at those of the times that it covers."""
        track = self.track_at(np.sort(np.atleast_1d(np.asarray(t, dtype=float))))
        return track.t, _build_states(self.frame, track), np.full((len(track), DIM, DIM), np.nan)


def select_own(solutions: Mapping[str, Solution]) -> dict[str, Solution]:
    """The solutions that are not from other programs."""
    return {name: s for name, s in solutions.items() if not isinstance(s, Foreign)}


def find_antenna_lever_arm(recording: Recording, solution: Solution) -> Array | None:
    """Lever arm from the IMU to the antenna, m, RFU: as estimated, else as stated; None without GNSS.

    Parts of a long drive have an estimate each, of the same antenna: the mean, weighted by their variances.
    """
    if recording.gnss is None:
        return None
    if (estimated := solution.parameters.get(_ARM)) is None:
        return recording.gnss.lever_arm
    return np.average(estimated.value, axis=0, weights=np.maximum(estimated.sigma, 1e-9) ** -2.0)


def read_against(asked: Against, name: str, recording: Recording, reference: Solution) -> Foreign:
    """Read a trajectory file and put it beside `reference`, a solution of `recording`.

    Raises
    ------
    RecordingError
        If it cannot be read, shares no time with the recording, or its point is the antenna and there is no GNSS.
    """
    track = read_trajectory(asked.path)
    notes = Notes(track.notes)
    track = _put_on_clock(asked, track, recording, reference, notes)
    if track.frame == "local":
        track = _place_on_ours(asked.path, track, reference, notes)
    ours = find_antenna_lever_arm(recording, reference)
    lever_arm = None if recording.gnss is None else recording.gnss.lever_arm
    arm = asked.point
    if isinstance(arm, str) and arm == "antenna":
        if ours is None:
            raise RecordingError(
                f"{asked.path}: is to be of the antenna, and '{recording.name}' has no GNSS", key="against.no_gnss"
            )
        arm = lever_arm = ours
    elif isinstance(arm, str):
        arm = np.zeros(3)
    _require_same_drive(asked, track, recording, reference)
    borrowed = track.rph is None
    if borrowed:
        track = _borrow_attitude(track, reference)
        notes.add(
            "against.no_attitude",
            f"{asked.path.name}: has no attitude; that of {reference.solver} places its lever arm",
        )
    elif recording.truth is None or recording.truth.rph is None:  # else it is compared with that
        notes += _compare_axes(asked.path, track, reference)
    if np.any(arm):
        track = interpolate(track, track.t, max_gap=_MAX_GAP, lever_arm=-arm)[0]
        notes.add(
            "against.point", f"{asked.path.name}: moved to the IMU from [{format_arm(arm)}] m (right, forward, up)"
        )
    notes += _find_other_point(asked.path, track, arm, ours, reference)
    track = replace(track, name=name)
    _, known = interpolate(track, reference.t, max_gap=_MAX_GAP)
    t = reference.t[known]
    states = _build_states(reference.frame, interpolate(track, t, max_gap=_MAX_GAP)[0])
    unknown = np.full((len(t), DIM, DIM), np.nan)
    return Foreign(
        name, reference.frame, t, states, unknown,
        notes=tuple(notes), track=track, borrowed=borrowed, lever_arm=lever_arm,
    )  # fmt: skip


def _take_inside(track: Trajectory, reference: Solution) -> Trajectory:
    """The rows of a trajectory between the first and the last of a solution."""
    return track.take((track.t >= reference.t[0]) & (track.t <= reference.t[-1]))


def _put_on_clock(
    asked: Against, track: Trajectory, recording: Recording, reference: Solution, notes: Notes
) -> Trajectory:
    """The trajectory on the recording's clock, as asked or as its stamps and speeds show.

    Raises
    ------
    RecordingError
        If it shares no time with the recording.
    """
    if asked.shift is not None:
        track = replace(track, t=track.t + asked.shift)
        notes.add("against.shift", f"{asked.path.name}: stamps shifted by {asked.shift:+g} s, as asked")
    else:
        shift, words = _shift(asked.path, track, recording, reference)
        track = replace(track, t=track.t + shift)
        notes += words
    common = len(_take_inside(track, reference))
    if common < _FEWEST_COMMON:
        raise RecordingError(
            f"{asked.path}: {format_count(common, 'row')} in common with "
            f"'{recording.name}': its time runs from {track.t[0]:.3f} to {track.t[-1]:.3f} s, the "
            f"recording's from {reference.t[0]:.3f} to {reference.t[-1]:.3f} s; --against-shift says what to add",
            key="against.no_overlap",
        )
    return track


def _place_on_ours(path: Path, track: Trajectory, reference: Solution, notes: Notes) -> Trajectory:
    """A trajectory in metres of a frame of its own, turned and moved onto ours."""
    inside = _take_inside(track, reference)
    p = reference.at(inside.t)[1].p
    require_right_handed(str(path), inside.llh, p)
    yaw, offset = fit_yaw(inside.llh, p)
    notes.add("against.frame", f"{path.name}: metres in a local frame, rotated by {np.degrees(yaw):.1f} deg onto ours")
    return place_on_earth(track, reference.frame, yaw, offset)


def _compare_axes(path: Path, track: Trajectory, reference: Solution) -> list[Note]:
    """That the axes of a trajectory's attitude are other than ours, if they are."""
    inside = _take_inside(track, reference)
    states, R_lb = reference.at(inside.t)[1], inside.R_lb
    assert R_lb is not None
    other = find_other_axes(R_lb, reference.frame.R_ln(states.p) @ states.R_nb)
    return [Note(get_key(one), f"{path.name}: {one}") for one in other]


def _shift(path: Path, track: Trajectory, recording: Recording, reference: Solution) -> tuple[float, Notes]:
    """s to add to the stamps of a trajectory, and the reason."""
    known = compute_clock_offset(recording.start, recording.gps_zero, float(track.t[0]), track.gps_zero)
    notes, on_a_clock = Notes(), True
    if track.t[-1] > recording.start and track.t[0] < recording.end:
        shift = 0.0
    elif known is not None and abs(track.t[0] + known.offset - recording.start) < NEAR:
        shift = known.offset
        notes.add("against.clock", f"{path.name}: stamps shifted by {shift:+.0f} s: {known.words}")
    elif abs(track.t[0]) < NEAR:
        shift, on_a_clock = recording.start - float(track.t[0]), False
        why = "they are counted from the start of the file"
        notes.add("against.clock", f"{path.name}: stamps shifted by {shift:+.3f} s: {why}")
    else:
        return 0.0, notes  # given by the caller
    late = _measure_delay(replace(track, t=track.t + shift), reference)
    if late is None:
        return shift, notes
    if abs(late) < _APPLIED and on_a_clock:
        word = "early" if late > 0.0 else "late"
        notes.add("against.late", f"{path.name}: by its speed {abs(late):.3f} s {word} against ours; not corrected")
        return shift, notes
    leap = ""
    if abs(abs(late) - LEAP) < 0.1:
        late, leap = float(np.copysign(LEAP, late)), ": the leap seconds between UTC and GPS time"
    by = f"{'another ' if shift else ''}{late:+.3f} s"
    notes.add("against.late", f"{path.name}: stamps shifted by {by}, where its speed agrees with ours{leap}")
    return shift + late, notes


def _require_same_drive(asked: Against, track: Trajectory, recording: Recording, reference: Solution) -> None:
    """Refuse a trajectory that is elsewhere all the time, or moves differently at the common times.

    Raises
    ------
    RecordingError
        If it is of another drive, or on another clock.
    """
    inside = _take_inside(track, reference)
    if track.frame == "geodetic":
        apart = np.linalg.norm(reference.frame.from_llh(inside.llh) - reference.at(inside.t)[1].p, axis=1)
        if np.nanmin(apart) > _FARTHEST:
            raise RecordingError(
                f"{asked.path}: lies {np.nanmin(apart) / 1e3:.0f} km or more from '{recording.name}': it is of another "
                "drive, or its latitudes and longitudes are wrong, or in rad",
                key="against.elsewhere",
            )
    if asked.shift is not None:
        return  # as requested
    if _moves_otherwise(inside, reference):
        raise RecordingError(
            f"{asked.path}: moves differently from '{recording.name}' at their common times: it is of another "
            "drive, or on another clock; --against-shift says what to add to its times",
            key="against.other_drive",
        )


def _moves_otherwise(track: Trajectory, reference: Solution) -> bool:
    """Whether both directions and speeds of a trajectory on the Earth differ from ours; False where there are too few
    rows.
    """
    k = np.searchsorted(track.t, track.t + _CHORD)
    first = np.flatnonzero(k < len(track))
    last = k[first]
    whole = track.t[last] - track.t[first] < _CHORD + _MAX_GAP
    first, last = first[whole], last[whole]
    if len(first) < _FEWEST_COMMON:
        return False
    theirs = reference.frame.from_llh(track.llh)[:, :2]
    ours = reference.at(track.t)[1].p[:, :2]
    a, b = (p[last] - p[first] for p in (theirs, ours))
    way_a, way_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    moving = np.maximum(way_a, way_b) > _LEAST_SPEED * _CHORD
    if moving.sum() < _FEWEST_COMMON or np.ptp(track.t[first[moving]]) < 3.0 * _CHORD:
        return False
    unlike = np.sum((a - b) ** 2, axis=1)[moving] / (way_a**2 + way_b**2)[moving]
    if np.median(unlike) < _COMMON_SHARE:
        return False
    lengths = (way_a[moving], way_b[moving])
    return min(x.std() for x in lengths) > 0.0 and float(np.corrcoef(*lengths)[0, 1]) < np.sqrt(_COMMON_SHARE)


def _find_other_point(
    path: Path, track: Trajectory, arm: Array, antenna: Array | None, reference: Solution
) -> list[Note]:
    """The other point of the body that a trajectory refers to, if that explains its discrepancies.

    A discrepancy that turns with the body is a lever arm; one that does not is due to another datum, and is ignored.
    """
    inside = _take_inside(track, reference)
    states = reference.at(inside.t)[1]
    off = reference.frame.from_llh(inside.llh) - states.p

    def miss(other: Array) -> float:
        left = (off - states.R_nb @ (other - arm))[:, :2]
        # a stationary vehicle adds little
        return float(np.mean(np.linalg.norm(left - np.median(left, axis=0), axis=1)))

    points = {f"[{format_arm(-arm)}] m, the arm with the other signs": -arm, "the IMU": np.zeros(3)}
    if antenna is not None:
        points["the antenna"] = antenna
        points[f"[{format_arm(-antenna)}] m, the antenna's arm with the other signs"] = -antenna
    misses = {name: miss(point) for name, point in points.items()}
    best = min(misses, key=lambda name: misses[name])
    if not misses[best] < _MENDED * miss(arm):
        return []
    return [
        Note(
            "against.other_point",
            f"{path.name}: {misses[best]:.2f} m from ours if taken as the trajectory of {best}, "
            f"{miss(arm):.2f} m as stated: look at --against-point, or at lever_arm in [gnss]",
        )
    ]


def format_arm(arm: Array) -> str:
    """A lever arm (3,), m, to the centimetre."""
    return ", ".join(f"{x:.2f}" for x in arm)


def _measure_delay(track: Trajectory, reference: Solution) -> float | None:
    """Delay of the speeds in `reference`, s; None where it is ambiguous or within its own error."""
    llh = track.llh if track.frame == "geodetic" else reference.frame.to_llh(np.nan_to_num(track.llh))
    places = tracks.compute_track(Gnss(track.t, llh, np.ones((len(track), 3))))
    # between its keyframes too, where speeds do not change linearly
    t, states, _ = reference.at(np.arange(reference.t[0], reference.t[-1], _SPEED_STEP))
    ours = Track(t, states.v, np.zeros(len(t)), _SPEED_STEP)
    fit = crosschecks.fit_velocity(ours, places) if places is not None else None
    if fit is None or fit.correlation <= CLEAR or abs(fit.lag) < max(_MATTERS, _SIGNIFICANT * fit.spread):
        return None
    return fit.lag


def _borrow_attitude(track: Trajectory, reference: Solution) -> Trajectory:
    """The part of a trajectory that a solution covers, with the attitude of that solution."""
    inside = _take_inside(track, reference)
    states = reference.at(inside.t)[1]
    return replace(inside, rph=rotation.to_rph(reference.frame.R_ln(states.p) @ states.R_nb))


def drop_attitude(metrics: Metrics) -> Metrics:
    """The metrics of a trajectory with borrowed attitude, without those of the attitude."""
    errors = metrics.errors
    if errors is not None:
        none = np.full_like(errors.rph, np.nan)
        errors = replace(errors, rph=none, sd_rph=none, nees_rph=none[:, 0], nees_heading=None)
    components = {name: one for name, one in metrics.components.items() if name not in ("roll", "pitch", "heading")}
    nees = {name: one for name, one in metrics.nees.items() if name not in ("rph", "heading")}
    return replace(metrics, components=components, nees=nees, errors=errors)


def _build_states(frame: LocalFrame, track: Trajectory) -> States:
    """A trajectory on the Earth as states in a navigation frame, NaN for missing quantities."""
    p = frame.from_llh(track.llh)
    R_nl = np.swapaxes(frame.R_ln(p), -1, -2)
    unknown = np.full(p.shape, np.nan)
    R_lb = track.R_lb
    R_nb = np.full((len(p), 3, 3), np.nan) if R_lb is None else R_nl @ R_lb
    v = unknown if track.v is None else np.einsum("kij,kj->ki", R_nl, track.v)
    return States(R_nb, p, v, unknown, unknown)
