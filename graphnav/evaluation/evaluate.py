"""Errors of a trajectory against a truth: at the truth's epochs, at its point, in its axes.

`compute_errors` takes differences, `measure` reduces them to numbers, `summarise` and `format_metrics` present these;
`evaluate` does all of it for two files and `evaluate_recording` for a solution of a recording, with or without a truth
of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Note, Notes
from graphnav.core.rotation import Array
from graphnav.core.timescales import GPS_TO_UNIX, LEAP, compute_clock_offset, shift_stamps, shift_stamps_back
from graphnav.core.trajectory import Trajectory
from graphnav.evaluation.metrics import (
    COMPONENTS,
    Closure,
    Errors,
    Metrics,
    Nees,
    SpanErrors,
    Statistic,
    average_ensemble_nees,
    average_nees,
    chi_square_band,
    format_metrics,
    measure,
    summarise,
    tabulate,
    write_comparison_csv,
)
from graphnav.evaluation.scoring import MAX_GAP, compute_errors, list_ranges, measure_closure
from graphnav.recording import Recording
from graphnav.recording.formats.trajectories import WEEK, read_trajectory

__all__ = [
    "COMPONENTS",
    "AntennaCalibration",
    "Closure",
    "Errors",
    "Metrics",
    "Nees",
    "SpanErrors",
    "Statistic",
    "average_ensemble_nees",
    "average_nees",
    "chi_square_band",
    "compute_errors",
    "evaluate",
    "evaluate_recording",
    "find_truth",
    "format_metrics",
    "make_withheld_truth",
    "measure",
    "measure_closure",
    "summarise",
    "tabulate",
    "write_comparison_csv",
]  # fmt: skip


def find_truth(recording: Recording) -> tuple[Trajectory, Array | None] | None:
    """The recording's truth and the lever arm from the IMU to its point; None without truth, or for a closed loop.

    Raises
    ------
    RecordingError
        If the truth is of a sensor the recording lacks, so that its lever arm is unknown.
    """
    truth = recording.truth
    if truth is None or (truth.llh is None and truth.xyz is None):
        return None
    lever_arm = None
    if not isinstance(truth.of, str):
        lever_arm = np.array(truth.of)
    elif truth.of != "imu":
        sensor = getattr(recording, truth.of, None)
        if sensor is None:
            raise RecordingError(
                f"'{recording.name}': truth is of = \"{truth.of}\" but there is no [{truth.of}] to give its lever arm",
                key="truth.no_lever_arm",
            )
        lever_arm = sensor.lever_arm
    if truth.llh is not None:
        return Trajectory(truth.t, truth.llh, v=truth.v, rph=truth.rph, name="truth"), lever_arm
    assert truth.xyz is not None
    xyz = np.full((len(truth.t), 3), np.nan)
    xyz[:, : truth.xyz.shape[1]] = truth.xyz
    return Trajectory(truth.t, xyz, v=truth.v, rph=truth.rph, frame="local", name="truth"), lever_arm


@dataclass(frozen=True)
class AntennaCalibration:
    """The calibration of the antenna in each of the n pieces of the solution that is compared with withheld fixes."""

    clock_offset: Array = field(default_factory=lambda: np.zeros(1))  # (n,) s, to be added to the fixes' stamps
    lever_arm: Array | None = None  # (n, 3) m, right, forward, up; None: that of the recording
    # (n,) s/s, to be added to the fixes' stamps by the time since the recording's start
    clock_rate: Array = field(default_factory=lambda: np.zeros(1))
    begin: Array = field(default_factory=lambda: np.array([-np.inf]))  # (n,) s, of each piece, on the IMU's clock

    def find_pieces(self, t: Array) -> Array:
        """The piece of each time (N,), s, on the IMU's clock."""
        return np.maximum(np.searchsorted(self.begin, t, side="right") - 1, 0)

    def move_stamps(self, t: Array, since: float) -> Array:
        """Stamps (N,), s, of fixes on the IMU's clock, each as the piece has it in which it then lies; NaN in none."""
        out = np.full(len(t), np.nan)
        for k, (late, rate) in enumerate(zip(self.clock_offset, self.clock_rate, strict=True)):
            moved = shift_stamps(t, late, rate, since)
            out = np.where(self.find_pieces(moved) == k, moved, out)
        return out

    def move_back(self, t: Array, since: float) -> Array:
        """The inverse of `move_stamps`."""
        piece = self.find_pieces(t)
        return np.asarray(shift_stamps_back(t, self.clock_offset[piece], self.clock_rate[piece], since))


_AS_STATED = AntennaCalibration()


def make_withheld_truth(
    recording: Recording,
    source: str = "gnss",
    spans: Sequence[tuple[float, float] | None] = (None,),
    antenna: AntennaCalibration = _AS_STATED,
) -> tuple[Trajectory, Array]:
    """The fixes withheld in `spans` (s from the start; None: all) as the truth of those spans, with their lever arm.

    A withheld fix is treated like a used one: at its stamp on the IMU's clock, with the estimated lever arms.

    Parameters
    ----------
    recording
        The full recording, before `Recording.without`. The sigmas of the fixes are included, so that the NEES
        accounts for the error of this truth.
    source
        The withheld sensor; only "gnss" has positions.
    spans
        s from the recording's start, on the receiver's clock.
    antenna
        The antenna as estimated by the solution to be compared.

    Returns
    -------
    Trajectory, Array
        The fixes on the IMU's clock, and the lever arm (3,) of the recording or (n, 3) of the pieces, m.

    Raises
    ------
    RecordingError
        If the source has no positions, or no fix falls into the spans.
    """
    if source != "gnss" or recording.gnss is None:
        raise RecordingError(
            f"'{recording.name}': withheld '{source}' gives no positions to compare with", key="truth.no_positions"
        )
    gnss = recording.gnss
    t = gnss.t - recording.start
    mask = np.zeros(len(t), dtype=bool)
    for span in spans:
        mask |= np.ones_like(mask) if span is None else (t >= span[0]) & (t <= span[1])
    moved = antenna.move_stamps(gnss.t, recording.start)
    mask &= np.isfinite(gnss.llh).all(axis=1) & np.isfinite(moved)
    if not mask.any():
        raise RecordingError(
            f"'{recording.name}': no GNSS fix in the withheld spans to compare with", key="truth.no_withheld_fix"
        )
    notes = Notes([Note("truth.withheld_gnss", "the truth is the withheld GNSS itself")])
    if np.any(antenna.clock_offset) or np.any(antenna.clock_rate):
        notes.add("truth.clock_offset", "the stamps of the withheld fixes are moved as estimated")
    truth = Trajectory(
        moved[mask], gnss.llh[mask], sd_p=gnss.sd[mask],
        v=None if gnss.v is None else gnss.v[mask],
        sd_v=None if gnss.sd_v is None else gnss.sd_v[mask], name="withheld GNSS",
        notes=tuple(notes),
    )  # fmt: skip
    return truth, gnss.lever_arm if antenna.lever_arm is None else antenna.lever_arm


def evaluate_recording(
    trajectory: Trajectory,
    recording: Recording,
    *,
    withheld: Sequence[tuple[str, tuple[float, float] | None]] = (),
    max_gap: float = MAX_GAP,
    at: Array | None = None,
    antenna: AntennaCalibration = _AS_STATED,
) -> Metrics | None:
    """Metrics of a solution against the best available truth: the recording's own, a closed loop, or withheld GNSS.

    Parameters
    ----------
    trajectory
        The trajectory of the IMU.
    recording
        The full recording, with nothing withheld.
    withheld
        (source, span in s from the start or None) as given to `Recording.without`; each span of GNSS is scored by
        itself.
    max_gap
        s, longest gap between rows that is interpolated.
    at
        (N,) s, epochs to compare at; those of the sparser trajectory when None.
    antenna
        The antenna as estimated by the solution, for withheld fixes and a truth of the antenna.

    Returns
    -------
    Metrics or None
        None if there is no truth.

    Raises
    ------
    RecordingError
        If trajectory and truth have no common epoch.
    """
    gnss_spans = [span for source, span in withheld if source == "gnss"]
    spans = [span for span in gnss_spans if span is not None]
    found = find_truth(recording)
    if found is None and recording.truth is not None and recording.truth.closed_loop_sigma is not None:
        sigma = recording.truth.closed_loop_sigma
        note = Note("truth.closed_loop", f"the only truth is that the drive ends where it starts, to {sigma:g} m")
        return Metrics(trajectory.name, closure=measure_closure(trajectory), notes=(*trajectory.notes, note))
    clock = _AS_STATED
    if found is None and gnss_spans and recording.gnss is not None:
        found = make_withheld_truth(recording, "gnss", gnss_spans, antenna)
        clock = antenna
    if found is None:
        return None
    truth, lever_arm = found
    of_antenna = recording.truth is None or recording.truth.of == "gnss"
    if of_antenna and antenna.lever_arm is not None:
        lever_arm = antenna.lever_arm[antenna.find_pieces(trajectory.t)]
    alone = trajectory.frame == "local" or not recording.placed
    found_errors = compute_errors(trajectory, truth, lever_arm=lever_arm, max_gap=max_gap, at=at, from_start=alone)
    # spans are on the fixes' own clock, and so are the errors then
    found_errors = replace(found_errors, t=clock.move_back(found_errors.t, recording.start))
    return measure(found_errors, trajectory.name, spans, start=recording.start)


def evaluate(
    trajectory_path: str | Path,
    truth_path: str | Path,
    *,
    lever_arm: Array | None = None,
    spans: Sequence[tuple[float, float]] = (),
    max_gap: float = MAX_GAP,
    allow_outside: bool = False,
) -> Metrics:
    """Metrics of one file against another, each of any kind that `read_trajectory` reads.

    Parameters
    ----------
    trajectory_path
        The estimate.
    truth_path
        The truth, or a recording (a folder or a .toml), whose truth and lever arm are then used.
    lever_arm
        (3,) m from the estimate's point to the truth's, right, forward, up; that of the recording when None.
    spans
        s on the files' clock, each scored separately.
    max_gap
        s, longest gap between rows that is interpolated.
    allow_outside
        Whether files that a recording names may lie outside its folder.

    Returns
    -------
    Metrics
        Errors in the local east, north and up at the epochs of the sparser file.

    Raises
    ------
    RecordingError
        If a file cannot be read, or the two have no time in common; the message then states a possible shift.
    """
    trajectory_path, truth_path = Path(trajectory_path), Path(truth_path)
    trajectory = read_trajectory(trajectory_path)
    alone = None
    if truth_path.is_dir() or truth_path.suffix == ".toml":
        from graphnav.recording import formats

        recording = formats.read(truth_path, allow_outside=allow_outside)
        trajectory, notes = _put_on_clock(trajectory, recording.start, recording.end, recording.gps_zero)
        found = find_truth(recording)
        if found is None:
            metrics = evaluate_recording(trajectory, recording)
            if metrics is None:
                raise RecordingError(
                    f"{truth_path}: the recording has no [truth] to evaluate against", key="truth.none"
                )
            return replace(metrics, notes=(*notes, *metrics.notes))
        truth, arm = found
        alone = trajectory.frame == "local" or not recording.placed
        lever_arm = arm if lever_arm is None else lever_arm
    else:
        truth = read_trajectory(truth_path)
        trajectory, notes = _put_on_clock(trajectory, float(truth.t[0]), float(truth.t[-1]), truth.gps_zero)
    if trajectory.t[-1] < truth.t[0] or truth.t[-1] < trajectory.t[0]:
        raise RecordingError(
            f"{trajectory_path}: {list_ranges(trajectory, truth)}{_shift_hint(trajectory, truth)}",
            key="truth.no_overlap",
        )
    found_errors = compute_errors(trajectory, truth, lever_arm=lever_arm, max_gap=max_gap, from_start=alone)
    hint = _hint_at_leap(found_errors, trajectory, truth, lever_arm, max_gap)
    return measure(
        replace(found_errors, notes=(*notes, *found_errors.notes, *hint)),
        trajectory.name or trajectory_path.stem,
        spans,
    )


def _put_on_clock(
    trajectory: Trajectory, start: float, end: float, zero: float | None
) -> tuple[Trajectory, tuple[str, ...]]:
    """A trajectory on the clock of a truth from `start` to `end` (s), where both clocks are known and differ."""
    begin, last = float(trajectory.t[0]), float(trajectory.t[-1])
    known = compute_clock_offset(start, zero, begin, trajectory.gps_zero)
    if known is None or (begin <= end and last >= start) or begin + known.offset > end or last + known.offset < start:
        return trajectory, ()
    note = Note("against.clock", f"stamps shifted by {known.offset:+.0f} s: {known.words}")
    return replace(trajectory, t=trajectory.t + known.offset), (note,)


def _shift_hint(trajectory: Trajectory, truth: Trajectory) -> str:
    """'; ...' naming a common clock shift that would make the two overlap, if there is one."""
    middle = 0.5 * (truth.t[0] + truth.t[-1] - trajectory.t[0] - trajectory.t[-1])
    half = 0.5 * (truth.t[-1] - truth.t[0] + trajectory.t[-1] - trajectory.t[0])
    unix = GPS_TO_UNIX - LEAP
    known_shifts = [
        (LEAP, "one may be in UTC and the other in GPS time, 18 s ahead"),
        (WEEK * round(middle / WEEK), "one may count GPS seconds of the week and the other continuously"),
        (unix + WEEK * round((abs(middle) - unix) / WEEK), "one may be in Unix time and the other in GPS time"),
        (86400.0 * round(middle / 86400.0), "one may count seconds of the day"),
    ]
    for shift, sentence in known_shifts:
        if shift and abs(abs(middle) - abs(shift)) < half:
            return f"; {sentence} (shift by {np.copysign(shift, middle):+.0f} s)"
    if min(abs(trajectory.t[0]), abs(truth.t[0])) < 1.0:
        shift = truth.t[0] - trajectory.t[0]
        return f"; one may count from its own start (shift by {shift:+.3f} s)"
    return "; put both on one clock"


def _hint_at_leap(
    found: Errors, trajectory: Trajectory, truth: Trajectory, lever_arm: Array | None, max_gap: float
) -> tuple[str, ...]:
    """A note if a shift of 18 s would explain most of the error: UTC taken for GPS time or the reverse."""
    before = float(np.sqrt(np.nanmean(found.horizontal**2)))
    if before < 1.0:
        return ()
    for shift in (LEAP, -LEAP):
        try:
            moved = compute_errors(
                replace(trajectory, t=trajectory.t + shift), truth, lever_arm=lever_arm, max_gap=max_gap
            )
        except RecordingError:
            continue
        after = float(np.sqrt(np.nanmean(moved.horizontal**2)))
        if len(moved) > 0.5 * len(found) and after < 0.2 * before:
            return (
                Note(
                    "truth.leap_seconds",
                    f"shifted by {shift:+.0f} s the horizontal error would fall from {before:.2f} to {after:.2f} m "
                    "rms: "
                    "one file may be in UTC and the other in GPS time",
                ),
            )
    return ()
