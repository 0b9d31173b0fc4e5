"""Errors of a run against the best available truth, over all of it and over each span with withheld or missing data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET
from graphnav.core import rotation
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.solution import Solution, make_trajectory
from graphnav.evaluation.against import Foreign, drop_attitude, find_antenna_lever_arm, format_arm, select_own
from graphnav.evaluation.scoring import MAX_GAP, measure_spacing
from graphnav.recording import Recording

if TYPE_CHECKING:
    from graphnav.evaluation.evaluate import AntennaCalibration
    from graphnav.evaluation.metrics import Metrics

Span = tuple[float, float]
Withheld = tuple[str, Span | None]

_DENSEST, _MOST = 0.1, 5_000  # s between, and number of, the truth epochs that are solved for exactly
_MOST_TURNING = 20_000  # the same where a point at the end of a lever arm moves between them
_ENOUGH_KEYFRAMES = 1000  # number of keyframes that makes other epochs unnecessary
# s; between epochs that count as one, and between rows too close for anything to happen
_SAME, _BETWEEN_ROWS = 1e-4, 0.02
_SAME_POINT = 1e-3  # m
OUTAGE = 10.0  # s; a longer interval between fixes is scored as an outage


def find_outages(recording: Recording) -> list[Span]:
    """Spans of more than `OUTAGE` s without a fix, s from the start; both ends of the recording count too.

    Each lasts from the last fix to one period before the next: there is still no fix at its end.
    """
    if recording.gnss is None or not recording.placed:
        return []
    t = recording.gnss.t[np.isfinite(recording.gnss.llh).all(axis=1)] - recording.start
    t = t[(t >= 0.0) & (t <= recording.duration)]
    period = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    begin, end = np.concatenate([[0.0], t]), np.concatenate([t - period, [recording.duration]])
    return [(float(a), float(b)) for a, b in zip(begin, end, strict=True) if b - a > OUTAGE]


def score(
    recording: Recording, used: Recording, solutions: Mapping[str, Solution], withheld: tuple[Withheld, ...]
) -> tuple[dict[str, Metrics], str | None, tuple[str, ...]]:
    """Metrics per solver against the best available truth, a description of it, and what is missing in each of their
    spans.
    """
    from graphnav.evaluation.evaluate import evaluate_recording, find_truth, make_withheld_truth

    spans = [(f"without {source}", span) for source, span in withheld if span is not None]
    truth = recording.truth
    gnss_withheld = any(source == "gnss" for source, _ in withheld)
    if truth is not None and truth.closed_loop_sigma is not None:
        if any("closed_loop" in solution.records for solution in select_own(solutions).values()):
            return {}, None, ()  # data that was used cannot be the truth
        against, spans = "the start, where the loop ends", []
    elif truth is not None:
        against = "the recording's truth"
        taken = [span for _, span in spans]
        spans += [("no GNSS", s) for s in find_outages(recording) if not any(a < s[1] and b > s[0] for a, b in taken)]
    elif gnss_withheld and recording.gnss is not None:
        against = "the withheld GNSS fixes"
        spans = [(name, span) for name, span in spans if name == "without gnss"]
    else:
        return {}, None, ()
    # the evaluation scores each span of withheld GNSS by itself, whatever is missing in it
    asked: list[Withheld] = [("gnss", span) for _, span in spans]
    if truth is None and any(source == "gnss" and span is None for source, span in withheld):
        asked.append(("gnss", None))
    with_truth = find_truth(recording)
    found = {}
    for name, solution in solutions.items():
        antenna, compared = _read_antenna(solution, recording), with_truth
        if truth is None:
            compared = make_withheld_truth(recording, "gnss", [span for _, span in asked], antenna)
        reference, swings = np.empty(0), False
        if compared is not None:
            reference, arm = compared[0].t, compared[1]
            swings = compared[0].v is not None and arm is not None and bool(np.any(arm))
        at = _choose_epochs(solution, reference)
        wanted = (
            np.union1d(np.union1d(solution.t, at), _choose_times(reference, solution, _MOST_TURNING)) if swings else at
        )
        track = _score_at(solution, wanted, placed=used.placed)
        epochs = at if len(at) else None
        metrics = evaluate_recording(track, recording, withheld=asked, at=epochs, antenna=antenna)
        if metrics is None:
            return {}, None, ()
        if isinstance(solution, Foreign):
            metrics = drop_attitude(metrics) if solution.borrowed else metrics
            if truth is None or truth.of == "gnss":
                ours = list(select_own(solutions).values())
                metrics = replace(metrics, notes=(*metrics.notes, *_tell_arms(name, solution, ours, recording)))
        found[name] = metrics
    return found, against, tuple(name for name, _ in spans)


def _tell_arms(name: str, other: Foreign, ours: Sequence[Solution], recording: Recording) -> list[str]:
    """A note where another program's antenna is elsewhere on the body than ours."""
    own = find_antenna_lever_arm(recording, ours[-1]) if ours else None
    if own is None or other.lever_arm is None or np.allclose(own, other.lever_arm, rtol=0.0, atol=_SAME_POINT):
        return []
    words = f"[{format_arm(other.lever_arm)}] m as stated, ours at [{format_arm(own)}] m as found"
    return [Note("against.lever_arm", f"{name}: its antenna is at {words} (right, forward, up)")]


def _read_antenna(solution: Solution, recording: Recording) -> AntennaCalibration:
    """The estimates of the antenna, of each piece its last; as stated where there are none."""
    from graphnav.evaluation.evaluate import AntennaCalibration

    if isinstance(solution, Foreign):
        return AntennaCalibration(lever_arm=None if solution.lever_arm is None else solution.lever_arm[None])
    begin = np.array([-np.inf, *(piece.start for piece in solution.between[1:])])

    def collect(name: str, stated: Array) -> Array:
        out = np.tile(stated, (len(begin), 1))
        if (found := solution.parameters.get(name)) is not None:
            out[np.searchsorted(begin, found.t, side="right") - 1] = found.value  # the last of several stays
        return out

    arms = None if recording.gnss is None else collect(LEVER_ARM, recording.gnss.lever_arm)
    offset = collect(TIME_OFFSET, np.zeros(1))[:, 0]
    rate = collect(CLOCK_RATE, np.array([solution.noise.stamps.rate]))[:, 0]
    return AntennaCalibration(offset, arms, rate, begin)


def _choose_epochs(solution: Solution, truth: Array) -> Array:
    """Epochs to compare at: the keyframes where the truth has them and they are many, else (some of) the truth's.

    No others: interpolated between keyframes, a filter would use in an outage the fix after it. The same holds for
    another program's rows: of such a file and the truth the denser is interpolated.
    """
    truth = truth[np.isfinite(truth)]
    if len(truth) > 1:
        foreign = isinstance(solution, Foreign)
        own = solution.track.t if isinstance(solution, Foreign) else solution.t
        t = own[(own >= truth[0] - _SAME) & (own <= truth[-1] + _SAME)]
        k = np.clip(np.searchsorted(truth, t), 1, len(truth) - 1)
        before, after = t - truth[k - 1], truth[k] - t
        if foreign and len(t) and measure_spacing(own) >= measure_spacing(truth):
            return np.asarray(t[before + after <= MAX_GAP])
        there = (np.minimum(np.abs(before), np.abs(after)) <= _SAME) | (before + after <= _BETWEEN_ROWS)
        if not foreign and there.sum() >= max(_ENOUGH_KEYFRAMES, 0.8 * len(t)):
            return np.asarray(t[there])
    return _choose_times(truth, solution, _MOST)


def _choose_times(t: Array, solution: Solution, most: int) -> Array:
    """At most `most` of the times within a solution, none closer than `_DENSEST`."""
    spacing = max(_DENSEST, (solution.t[-1] - solution.t[0]) / most)
    _, apart = np.unique(np.floor(t / spacing), return_index=True)
    return np.asarray(t[apart])


def _score_at(solution: Solution, t: Array, placed: bool) -> Trajectory:
    """The solution at the times, or at all keyframes where these suffice; in metres of its frame if not `placed`."""
    if isinstance(solution, Foreign):
        track = solution.track_at(t)
        return track if placed else replace(track, llh=solution.frame.from_llh(track.llh), frame="local")
    times, states, covariance = solution.t, solution.states, solution.covariance
    if not np.isin(t, times).all():
        times, states, covariance = solution.at(np.union1d(times[[0, -1]], t))
    track = make_trajectory(solution.solver, solution.frame, times, states, covariance)
    if placed:
        return track
    return replace(track, llh=states.p, v=states.v, rph=rotation.to_rph(states.R_nb), frame="local")
