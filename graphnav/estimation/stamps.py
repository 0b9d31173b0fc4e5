"""Stamps that are far off: rows of fixes are linearised about where the offsets of their stamps are estimated.

A fix whose stamp is off by d is predicted from the state at the stamp, with an acceleration that is linear in time
within `LINEAR_OFFSET` of it (`graphnav.constraints.gnss`). Farther away a vehicle's acceleration changes otherwise. So
where an offset is estimated farther than that from where the rows are linearised, the stamps are moved to the estimate,
that of the clocks' rate with it, and all is estimated again from there, a step of Gauss-Newton, until the estimate
stays within, and the likelier stands. Where the clocks of IMU and fixes disagree for certain
(`graphnav.recording.checks.clock`), all is begun about what they disagree by, and moved to what is estimated there; the
stated stamps are tried only where that is near them. Stamps are moved before wrong measurements are searched for,
as late fixes look wrong in every bend, and once more where the search has changed the noise model.

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
from graphnav.constraints.base import SAME_TIME
from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET, VELOCITY_TIME_OFFSET, GnssPosition, GnssVelocity
from graphnav.constraints.odometer import ODOMETER_DELAY
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.timescales import shift_stamps, shift_stamps_back
from graphnav.estimation.contradictions import Freed
from graphnav.estimation.noise.model import NoiseModel, RowWeights, StampOffsets
from graphnav.estimation.noise.spans import Span
from graphnav.estimation.noise_search import Weigh
from graphnav.estimation.offsets import AS_STATED, is_offset_far, list_end_rows, move_stamps
from graphnav.estimation.preparation import Begun, Prepared
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import ConstraintRecord, ExcludedSpan, ParameterEstimate, Solution
from graphnav.estimation.solvers.breakdown import BREAKDOWN
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

    def compare_evidence(self, other: _Candidate) -> float:
        """The logarithm of the evidence of the fixes by all other measurements, less that of another candidate, both of
        the same fixes: with its stamps moved one may leave the span of the IMU. Other rows are at keyframes and, with
        these elsewhere, of another evidence: those of stops by tens of nats, whatever the stamps.
        """
        return self._weigh_fixes(other) - other._weigh_fixes(self)

    def _weigh_fixes(self, other: _Candidate) -> float:
        assert self.begun.found is not None
        gained = self.log_evidence - self.begun.found.estimate.log_evidence  # by what is free or left out
        of_fixes = self.begun.weigh_measurements(dict.fromkeys(_OWN_STAMPS, ((-np.inf, np.inf),)))
        within = 10.0 * SAME_TIME  # both rounded
        return gained + of_fixes - self.begun.weigh_lacking(self._list_stamps(), other._list_stamps(), within)

    def _list_stamps(self) -> dict[str, tuple[Array, Array]]:
        """(N,) s, stamps of fixes by constraint, on their own clock and that of the IMU."""
        assert self.begun.found is not None
        base, stamps, out = self.begun.found.base, self.offsets, dict[str, tuple[Array, Array]]()
        for rows in base.constraints:
            if (late := _list_by_constraint(stamps).get(rows.name)) is not None:
                t = base.t[rows.keyframe]
                out[rows.name] = np.asarray(shift_stamps_back(t, late, stamps.rate, stamps.since)), t
        return out


# stamp offsets, and what was begun with others, if anything -> the recording with its stamps moved by these
_Move = Callable[[StampOffsets, Begun | None], _Candidate]


def may_move(recording: Recording, settings: Settings) -> bool:
    """Whether offsets of stamps are estimated."""
    gnss = recording.gnss
    known = settings.noise.mode == "stated" or not settings.gnss.time_offset_sigma > 0.0
    return gnss is not None and not known and not recording.is_tight(settings.raw_gnss.coupling)


def find_stamps(
    recording: Recording, begin: Begin, finish: Finish, clock: ClockOffsets | None
) -> tuple[Recording, Begun, Prepared, StampOffsets]:
    """The recording with its stamps where their offsets are estimated, what was begun with it, and what its solvers
    share.

    Parameters
    ----------
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

    early = None if clock is None else _begin_about(begin_moved, _guess_offsets(clock))
    if early is None:
        early = _find(begin_moved, begin_moved(AS_STATED, None))
    try:
        found = solve(early, is_offset_far)
    except BREAKDOWN:
        if early.offsets == AS_STATED:
            raise
        found = solve(begin_moved(AS_STATED, None), is_offset_far)
    # wrong measurements may have hidden an offset, or been taken for one
    if found.log_evidence > found.begun.log_evidence + found.begun.gained_by_chance:
        found = _find(solve_moved, found)
    assert found.prepared is not None
    prepared = replace(found.prepared, passes=sum((one.passes for one in tried.values()), Counter()))
    return move_stamps(recording, found.offsets), found.begun, prepared, found.offsets


def _begin_about(move: _Move, guess: StampOffsets | None) -> _Candidate | None:
    """What is begun with stamps moved to where their offsets are estimated from a guess; None where these are near what
    is stated, or do not come about.
    """
    if guess is None:
        return None
    with contextlib.suppress(*BREAKDOWN):
        start = move(guess, None)
        ahead = _estimate_offsets(start, 0.0)  # what is left has the prior of a receiver's, not that of a guess
        found = _move_until_near(move, start if ahead == guess else move(ahead, start.begun))
        return found if found is not None and _is_far(found.offsets) else None
    return None


def _find(move: _Move, plain: _Candidate) -> _Candidate:
    """What is likeliest, with its stamps as they are or moved until their offsets are estimated near where they are."""
    with contextlib.suppress(*BREAKDOWN):  # with stamps that are farther off than before
        found = _move_until_near(move, plain)
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


def _is_far(offsets: StampOffsets) -> bool:
    return max(abs(offsets.positions), abs(offsets.velocities)) > LINEAR_OFFSET


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
    return guess if _is_far(guess) else None


def _join(offsets: StampOffsets) -> StampOffsets:
    """Offsets with one for positions and velocities where they hardly differ: each has keyframes of its own else."""
    near = abs(offsets.velocities - offsets.positions) <= LINEAR_OFFSET
    return replace(offsets, velocities=offsets.positions) if near else offsets


def _estimate_offsets(candidate: _Candidate, far: float = LINEAR_OFFSET) -> StampOffsets:
    """The offsets estimated, those that are significant and as far, s; the others as they are."""
    at, one = candidate.offsets, candidate.prepared
    known = candidate.begun.estimate_parameters(far) if one is None else one.estimate_parameters()
    if known is None:
        return at
    problem, values, P = known
    ends, new = list_end_rows(problem), {}
    for key, name in (("positions", TIME_OFFSET), ("velocities", VELOCITY_TIME_OFFSET)):
        if name in ends:
            rows = ends[name]
            sigma = np.sqrt(np.einsum("ij,jk,ik->i", rows, P, rows))
            if (np.abs(rows @ values) > np.maximum(far, _SIGNIFICANT * sigma)).any():
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
