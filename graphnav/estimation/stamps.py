"""Stamps that are far off: rows of fixes are linearised about where the offsets of their stamps are estimated.

A fix whose stamp is off by d is predicted from the state at the stamp, with an acceleration that is linear in time
within `LINEAR_OFFSET` of it (`graphnav.constraints.gnss`). Farther away a vehicle's acceleration changes otherwise. So
where an offset is estimated farther than that from where the rows are linearised, the stamps are moved to the estimate,
that of the clocks' rate with it, and all is estimated again from there, a step of Gauss-Newton, until the estimate
stays within. Where the clocks of IMU and fixes disagree for certain (`graphnav.recording.checks.clock`), the first step
is what they disagree by. The stamps as they are remain a candidate: the likelier stands. Stamps are moved before wrong
measurements are searched for, as late fixes look wrong in every bend, and once more where the search has changed the
noise model.

A solution is on the clock of the IMU, and what it says of fixes is on theirs (`shift_to_own_clocks`).
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LINEAR_OFFSET
from graphnav.constraints.base import SAME_TIME, Constraint
from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET, VELOCITY_TIME_OFFSET, GnssPosition, GnssVelocity
from graphnav.constraints.odometer import ODOMETER_DELAY
from graphnav.core.interpolation import pick_nearest
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.timescales import shift_stamps, shift_stamps_back
from graphnav.detectors.base import NONE, mask_inside, merge_spans, subtract_spans
from graphnav.estimation.contradictions import Freed
from graphnav.estimation.noise.initial_points import BREAKDOWN
from graphnav.estimation.noise.model import NoiseModel, RowWeights, StampOffsets
from graphnav.estimation.noise.spans import Span
from graphnav.estimation.noise_search import Weigh
from graphnav.estimation.offsets import AS_STATED, is_offset_far, list_end_rows, move_stamps
from graphnav.estimation.preparation import Begun, Prepared
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ConstraintRecord, ExcludedSpan, ParameterEstimate, Solution
from graphnav.estimation.solvers.linearise import Points, shift
from graphnav.recording import Recording
from graphnav.recording.checks.clock import FAIR, ClockOffsets, is_certain

_OWN_STAMPS = GnssPosition.name, GnssVelocity.name
_SIGNIFICANT = 3.0  # sigmas
_MOVES = 3  # of moving the stamps
_A_PPM = 1e-6
_FASTEST = 6e-3  # s/s between two clocks: a ceramic resonator (5e-3) beside a crystal, and what an estimate is off

# a recording whose stamps are moved, by which rate (s/s), and what was begun with others, if anything -> its beginning
Begin = Callable[[Recording, float, Begun | None], Begun]
# what is begun, and whether evidence is wanted -> what its solvers share
Finish = Callable[[Begun, Weigh], Prepared]


@dataclass(frozen=True)
class _Candidate:
    """A recording with its stamps moved: begun, and finished where that was done."""

    offsets: StampOffsets
    begun: Begun
    prepared: Prepared | None = None

    @property
    def log_evidence(self) -> float:
        return self.begun.log_evidence if self.prepared is None else self.prepared.log_evidence

    @property
    def passes(self) -> Counter[str]:
        return self.begun.all_passes if self.prepared is None else self.prepared.passes

    def compare_evidence(self, other: _Candidate, apart: Array = NONE) -> float:
        """The logarithm of the evidence less that of another, both of as many measurements: with its stamps moved a fix
        may leave the span of the IMU, and a keyframe with what is assumed there goes with it.

        What is assumed within the spans `apart` (n, 2), s, counts for neither.
        """
        return self._weigh_common(other, apart) - other._weigh_common(self, apart)

    def _weigh_common(self, other: _Candidate, apart: Array) -> float:
        one, their = self.begun.found, other.begun.found
        assert one is not None
        assert their is not None
        theirs = {rows.name: other._list_stamps(their.base, rows) for rows in their.base.constraints}
        beyond: dict[str, tuple[Span, ...]] = {}
        for rows in one.base.constraints:
            t, same = self._list_stamps(one.base, rows), theirs.get(rows.name, np.empty(0))
            if rows.name in _OWN_STAMPS:
                off = np.abs(same[pick_nearest(same, t)] - t) if len(same) else np.full(len(t), np.inf)
                lacking = off > 10.0 * SAME_TIME  # both rounded
            else:  # at keyframes, of which any are alike
                ours = np.flatnonzero(~mask_inside(t, apart))
                fewer = min(int(np.count_nonzero(~mask_inside(same, apart))), len(ours))
                kept = ours[np.linspace(0.0, len(ours) - 1.0, fewer).round().astype(int)]
                lacking = ~np.isin(np.arange(len(t)), kept)
            if lacking.any():
                beyond[rows.name] = tuple((x, x) for x in one.base.t[rows.keyframe][lacking].tolist())
        return self.log_evidence - self.begun.weigh_measurements(beyond) if beyond else self.log_evidence

    def _list_stamps(self, problem: Problem, rows: Constraint) -> Array:
        """(N,) s, on their own clock, of fixes; of other rows the times of their keyframes."""
        t, by = problem.t[rows.keyframe], _list_by_constraint(self.offsets)
        if rows.name not in by:
            return t
        return np.asarray(shift_stamps_back(t, by[rows.name], self.offsets.rate, self.offsets.since))


def compare_evidence(one: Begun, other: Begun) -> float:
    """The logarithm of the evidence less that of another, both of the measurements that they have in common, without
    what is assumed where only one of them stands.
    """
    stops, others = one.built.detections.stationary, other.built.detections.stationary
    apart = np.concatenate([subtract_spans(stops, others), subtract_spans(others, stops)])
    return _Candidate(AS_STATED, one).compare_evidence(_Candidate(AS_STATED, other), merge_spans(apart))


# stamp offsets, and what was begun with others, if anything -> the recording with its stamps moved by these
_Move = Callable[[StampOffsets, Begun | None], _Candidate]


def may_move(recording: Recording, settings: Settings) -> bool:
    """Whether offsets of stamps are estimated."""
    gnss = recording.gnss
    known = settings.noise.mode == "stated" or not settings.gnss.time_offset_sigma > 0.0
    return gnss is not None and not known and not recording.is_tight(settings.raw_gnss.coupling)


def find_stamps(
    recording: Recording, plain: Begun, begin: Begin, finish: Finish, clock: ClockOffsets | None
) -> tuple[Recording, Prepared, StampOffsets]:
    """The recording with its stamps where their offsets are estimated, and what its solvers share.

    Parameters
    ----------
    plain : begun with the stamps as they are.
    clock : offsets between IMU and fixes that the recording shows before any estimation.
    """
    tried: dict[int, _Candidate] = {}

    def begin_moved(offsets: StampOffsets, before: Begun | None) -> _Candidate:
        begun = begin(move_stamps(recording, offsets), offsets.rate, before)
        return tried.setdefault(id(begun), _Candidate(offsets, begun))

    def solve(one: _Candidate, weigh: Weigh) -> _Candidate:
        tried[id(one.begun)] = one = replace(one, prepared=finish(one.begun, weigh))
        return one

    def solve_moved(offsets: StampOffsets, before: Begun | None) -> _Candidate:
        return solve(begin_moved(offsets, before), _accept_all)

    as_stated = tried[id(plain)] = _Candidate(AS_STATED, plain)
    early = _find(begin_moved, as_stated, None if clock is None else _guess_offsets(clock))
    try:
        found = solve(early, is_offset_far)
    except BREAKDOWN:
        if early is as_stated:
            raise
        found = solve(as_stated, is_offset_far)
    # wrong measurements may have hidden an offset, or been taken for one
    if found.log_evidence > found.begun.log_evidence + found.begun.gained_by_chance:
        found = _find(solve_moved, found)
    assert found.prepared is not None
    prepared = replace(found.prepared, passes=sum((one.passes for one in tried.values()), Counter()))
    return move_stamps(recording, found.offsets), prepared, found.offsets


def _find(move: _Move, plain: _Candidate, guess: StampOffsets | None = None) -> _Candidate:
    """What is likeliest, with its stamps as they are or moved until their offsets are estimated near where they are."""
    for first in (plain,) if guess is None else (guess, plain):
        with contextlib.suppress(*BREAKDOWN):  # with stamps that are farther off than before
            start = move(first, None) if isinstance(first, StampOffsets) else first
            found = _move_until_near(move, start)
            if found is not None and found is not plain and found.compare_evidence(plain) > 0.0:
                return found
    return plain


def _move_until_near(move: _Move, found: _Candidate) -> _Candidate | None:
    """Move the stamps until their offsets are estimated near where they are; None where that does not come about."""
    for _ in range(_MOVES):
        if (ahead := _estimate_offsets(found)) == found.offsets:
            return found
        found = move(ahead, found.begun)
    return found if _estimate_offsets(found) == found.offsets else None


def _accept_all(problem: Problem, points: Points) -> bool:
    return True


def _guess_offsets(clock: ClockOffsets) -> StampOffsets | None:
    """Offsets that the clocks of IMU and fixes show, where they are certain and far."""
    if clock.late is None and clock.apart is None:
        return None
    one = clock.by_velocity or clock.by_places
    known = one is not None and one.correlation >= FAIR and is_certain(one)
    velocities = one.lag if one is not None and known else 0.0
    between = 0.0 if clock.apart is None or clock.between is None else clock.between.lag
    odometer = velocities if clock.of_imu else 0.0
    guess = _join(StampOffsets(velocities + between, velocities, odometer))
    return guess if max(abs(guess.positions), abs(guess.velocities)) > LINEAR_OFFSET else None


def _join(offsets: StampOffsets) -> StampOffsets:
    """Offsets with one for positions and velocities where they hardly differ: each has keyframes of its own else."""
    near = abs(offsets.velocities - offsets.positions) <= LINEAR_OFFSET
    return replace(offsets, velocities=offsets.positions) if near else offsets


def _estimate_offsets(candidate: _Candidate) -> StampOffsets:
    """The offsets estimated, those that are far and significant; the others as they are."""
    at, known = candidate.offsets, (candidate.prepared or candidate.begun).estimate_parameters()
    if known is None:
        return at
    problem, values, P = known
    ends, new = list_end_rows(problem), {}
    for key, name in (("positions", TIME_OFFSET), ("velocities", VELOCITY_TIME_OFFSET)):
        if name in ends:
            rows = ends[name]
            sigma = np.sqrt(np.einsum("ij,jk,ik->i", rows, P, rows))
            if (np.abs(rows @ values) > np.maximum(LINEAR_OFFSET, _SIGNIFICANT * sigma)).any():
                new[key] = getattr(at, key) + float(rows[0] @ values)
    if not new:
        return at
    if CLOCK_RATE in problem.columns:
        rate = at.rate + float(values[shift(problem.columns[CLOCK_RATE])][0])
        new |= {"rate": rate, "since": problem.frame.epoch}
    ahead = replace(at, **new)
    return _join(ahead) if VELOCITY_TIME_OFFSET in ends else replace(ahead, velocities=ahead.positions)


def shift_to_imu_clock(noise: NoiseModel) -> NoiseModel:
    """A noise model as it is of the recording with its stamps moved."""
    return noise if noise.stamps == AS_STATED else _shift_noise(noise, shift_stamps)


def shift_to_own_clocks(solution: Solution, offsets: StampOffsets) -> Solution:
    """The solution with what it says of fixes and odometer on their own clocks, and the whole offsets of these."""
    if offsets == AS_STATED:
        return solution
    by = _list_by_constraint(offsets)

    def shift_back(t: Any, late: float) -> Any:
        return shift_stamps_back(t, late, offsets.rate, offsets.since)

    def shift_record(name: str, one: ConstraintRecord) -> ConstraintRecord:
        return replace(one, t=shift_back(one.t, by[name])) if name in by else one

    def shift_span(one: ExcludedSpan) -> ExcludedSpan:
        if one.kind not in by:
            return one
        begin, end = (shift_back(t, by[one.kind]) for t in (one.t_start, one.t_end))
        return replace(one, t_start=begin, t_end=end)

    whole = {
        TIME_OFFSET: offsets.positions, VELOCITY_TIME_OFFSET: offsets.velocities, CLOCK_RATE: offsets.rate,
        ODOMETER_DELAY: -offsets.odometer,
    }  # fmt: skip

    def shift_parameter(name: str, one: ParameterEstimate) -> ParameterEstimate:
        return replace(one, value=one.value + whole[name]) if name in whole else one

    return replace(
        solution,
        records={name: shift_record(name, one) for name, one in solution.records.items()},
        excluded=tuple(map(shift_span, solution.excluded)),
        parameters={name: shift_parameter(name, one) for name, one in solution.parameters.items()},
        noise=_shift_noise(replace(solution.noise, stamps=offsets), shift_stamps_back),
    )


def describe_stamps(offsets: StampOffsets, freed: Freed) -> tuple[str, ...]:
    """Notes on stamps that were moved, and on clocks that drift apart as none do.

    Parameters
    ----------
    freed : as of a noise model, with the rate that is left.
    """
    if offsets == AS_STATED:
        return ()
    by = f"{offsets.positions:+.2f} s"
    mend = f": add {offsets.positions:+.2f} to time_offset in [gnss]"
    if abs(offsets.rate) >= _A_PPM:
        by, mend = f"{by} where the drive begins and {offsets.rate / _A_PPM:+.0f} ppm of the time since", ""
    elif offsets.velocities != offsets.positions:
        by, mend = f"{by} (positions) and {offsets.velocities:+.2f} s (velocities)", ""
    elif offsets.odometer:  # it agrees with the fixes
        mend = f": add {-offsets.positions:+.2f} to time_offset in [imu]"
    sentence = f"stamps of the fixes moved by {by}, at which they agree with the IMU{mend}"
    moved = Note("gnss.stamps_moved", sentence)
    rate = offsets.rate + (freed[CLOCK_RATE].value[0] if CLOCK_RATE in freed else 0.0)
    if abs(rate) <= _FASTEST:
        return (moved,)
    words = (
        f"no clocks drift apart by {abs(rate) / _A_PPM:.0f} ppm, as those of IMU and fixes do here; one of them may "
        "have been set while it recorded: use what lies before or after (--start, --end)"
    )
    return moved, Note("doubt.clocks", f"The stamps cannot be trusted: {words}")


def _list_by_constraint(offsets: StampOffsets) -> dict[str, float]:
    return {GnssPosition.name: offsets.positions, GnssVelocity.name: offsets.velocities}


def _shift_noise(noise: NoiseModel, change: Callable[[Any, float, float, float], Any]) -> NoiseModel:
    by, stamps = _list_by_constraint(noise.stamps), noise.stamps

    def move(t: Array | float, name: str) -> Any:
        return change(t, by[name], stamps.rate, stamps.since) if name in by else t

    def move_spans(some: Mapping[str, tuple[Span, ...]]) -> dict[str, tuple[Span, ...]]:
        return {name: tuple((move(a, name), move(b, name)) for a, b in spans) for name, spans in some.items()}

    return replace(
        noise,
        weights={name: RowWeights(move(one.t, name), one.weight) for name, one in noise.weights.items()},
        excluded=move_spans(noise.excluded),
        rivals=tuple(replace(one, excluded=move_spans(one.excluded)) for one in noise.rivals),
        span_weights={
            name: tuple((move(a, name), move(b, name), weight) for a, b, weight in spans)
            for name, spans in noise.span_weights.items()
        },
    )
