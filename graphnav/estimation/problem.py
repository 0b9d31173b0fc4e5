"""Keyframes, the intervals between them and the constraint rows on them; independent of solvers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from graphnav.config import Settings
from graphnav.constraints import list_kinds
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint
from graphnav.constraints.prior import InitialPrior
from graphnav.core.earth import LocalFrame
from graphnav.core.findings import describe_gaps
from graphnav.core.interpolation import keep_apart
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, Parameter, States
from graphnav.imu.clipping import restore_peaks
from graphnav.imu.dynamics import ImuFactors, make_scale_parameter
from graphnav.imu.preintegration import Intervals, list_unknown, preintegrate, preintegrate_unknown
from graphnav.imu.samples import Samples, bridge_gaps
from graphnav.imu.unresolved import add_coning, add_unresolved_motion
from graphnav.recording import ImuNoise, Recording
from graphnav.recording.odometer import MeanSpeed


@dataclass(frozen=True)
class ParameterChain:
    """A parameter and its nodes: one for a constant; a time-varying one has the next at the first keyframe after its
    spacing.

    From node to node: value - mean -> decay (value - mean) + white noise of `sigma`.
    """

    parameter: Parameter
    t: Array  # (n,) s
    node: Array  # (K,) int, the node valid at each keyframe
    steps: Array  # int, the keyframes at which the next node begins
    mean: Array  # (n, k)
    sigma: Array  # (n, k): of the first node, and of the process noise before each other node
    decay: Array  # (n,), that of the first is unused


@dataclass(frozen=True)
class Problem:
    """Everything a solver needs."""

    recording: Recording
    settings: Settings
    frame: LocalFrame
    t: Array  # (K,) keyframe times, s
    samples: Samples
    intervals: Intervals
    motion: ImuFactors
    prior: InitialPrior
    constraints: tuple[Constraint, ...]
    notes: tuple[str, ...] = ()
    imu_noise: ImuNoise = field(default_factory=ImuNoise)  # in use; intervals are integrated with it
    interval_factors: Array | None = None  # (K-1, 4) factors on the variances of `NOISE_FIGURES`; ones when None

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """The parameters estimated beside the states, by name."""
        of_imu = make_scale_parameter(self.imu_noise, self.recording.platform)
        return {p.name: p for p in (*of_imu, *(p for rows in self.constraints for p in rows.parameters))}

    @cached_property
    def chains(self) -> tuple[ParameterChain, ...]:
        """The parameters with their nodes."""
        return _build_chains(self.parameters.values(), self.t)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Columns of each parameter in an augmented error state, after the fifteen of the states."""
        out, at = {}, DIM
        for chain in self.chains:
            width = chain.parameter.size
            out[chain.parameter.name] = slice(at, at + width)
            at += width
        return out

    def complete(self, recording: Recording, typical: Array | None = None) -> Problem:
        """Add the constraints that depend on later rows, from a recording that extends far enough.

        `typical` as for `build_problem`.
        """
        scene = BuildContext(
            recording, self.settings, self.frame, self.t, np.empty((0, 2)), self.intervals, typical_sigmas=typical
        )
        rows = (*self.constraints, *_build_constraints(scene, True))
        return replace(self, recording=recording, constraints=tuple(sorted(rows, key=lambda c: c.name)))

    def reintegrate(self, ba: Array, bg: Array) -> Problem:
        """The problem with its intervals integrated again about better biases, (K-1, 3) each."""
        imu = replace(self.recording.imu, noise=self.imu_noise)
        intervals = preintegrate(self.samples, imu, self.t, ba, bg, self.interval_factors is not None)
        if self.interval_factors is not None:
            intervals = intervals.with_noise(self.interval_factors).without_parts()
        known = self.intervals
        intervals = replace(intervals, rate_noise=known.rate_noise, force_noise=known.force_noise)
        return replace(self, intervals=intervals, motion=ImuFactors(intervals, self.frame))

    def with_input_noise(self, states: States, scale: Array | None) -> Problem:
        """The problem with scale errors of the IMU that multiply what it measured less the noise that K states show.

        Its noise is in the residuals too. Were they multiplied with it, its squares would count as evidence of a scale
        error: errors in variables (Fuller 1987, section 1.1), which matter where the platform hardly moves.
        """
        if scale is None:
            return self
        intervals = self.intervals.with_input_noise(self.motion.compute_residual(states, scale[:-1]))
        return replace(self, intervals=intervals, motion=ImuFactors(intervals, self.frame))


@dataclass(frozen=True)
class SolvedProblem:
    """A problem and the values of a solution of it."""

    problem: Problem
    states: States
    values: dict[str, Array]  # (nodes, k) per parameter

    def __call__(self) -> tuple[Any, Any]:
        """The graph of `Solution.to_gtsam`, and its values."""
        from graphnav.estimation.factor_graph.nonlinear import make_graph  # which needs GTSAM

        return make_graph(self.problem, self.states, self.values)


def build_problem(
    recording: Recording,
    settings: Settings,
    frame: LocalFrame,
    start: States,
    sigma: Array,
    stationary: Array | None = None,
    times: Array | None = None,
    speed: MeanSpeed | None = None,
    typical: Array | None = None,
    known: Mapping[float, ImuFactors] | None = None,
    highest: Array | None = None,
    complete: bool = True,
    parts_of_noise: bool = False,
) -> Problem:
    """Build the estimation problem of a recording.

    Parameters
    ----------
    start : one state at the start of the recording: mean of the prior and where biases are expected.
    sigma : (15,) 1-sigma of the prior.
    stationary : (M, 2) spans in which the platform stands still, s; none when None.
    times : (K,) keyframes, s, where they are given: measurements at other times are left out.
    speed : of the odometer, where it is known already.
    typical : (M, 3) m, the unit of the slow errors of the recording's fixes, where it is known already.
    known : intervals between keyframes that were integrated before, by their end times.
    highest : highest readings of the IMU at other times, as of `graphnav.imu.clipping.find_highest`.
    complete : False leaves out the constraints that depend on later rows, for `Problem.complete`.
    parts_of_noise : keep what each noise figure contributes to the intervals' covariances, for
    `graphnav.estimation.noise`.
    """
    stops = limit_to_samples(stationary, recording, times)
    if times is None:
        wanted = [cls.epochs(recording, settings, stops) for cls in list_kinds(recording)]
        epochs = np.concatenate([*wanted, np.empty(0)])
        times = choose_keyframes(recording.start, recording.end, epochs, settings.keyframes.rate)
    t = times
    before = {end: one.intervals for end, one in (known or {}).items()}
    samples = bridge_gaps(recording.imu, float(t[min(list_unknown(t, before), default=-1)]))
    remarks: tuple[str, ...] = ()
    if recording.platform == "foot":
        samples, remarks = restore_peaks(samples, recording.imu.R_bs, highest)
        samples = add_unresolved_motion(samples, recording.imu.noise)
        samples = add_coning(samples) if settings.imu.coning else samples
    motion = known.get(float(t[1])) if known and len(t) == 2 else None
    if motion is None or motion.intervals.t0[0] != t[0]:
        intervals = preintegrate_unknown(samples, recording.imu, t, start.ba[0], start.bg[0], before, parts_of_noise)
        motion = ImuFactors(intervals, frame)
    intervals = motion.intervals
    scene = BuildContext(recording, settings, frame, t, stops, intervals, speed, typical)
    built = _build_constraints(scene, None if complete else False)
    prior = InitialPrior(keyframe=np.zeros(1, dtype=int), mean=start, sigma=np.asarray(sigma)[None])
    return Problem(
        recording=recording,
        settings=settings,
        frame=frame,
        t=t,
        samples=samples,
        intervals=intervals,
        motion=motion,
        prior=prior,
        constraints=built,
        notes=(*_describe_samples(samples, recording), *remarks, *(note for rows in built for note in rows.notes)),
        imu_noise=recording.imu.noise,
    )


def _build_constraints(scene: BuildContext, ahead: bool | None) -> tuple[Constraint, ...]:
    """Build the constraints: those that depend on later rows, those that do not, or all (None)."""
    classes = (cls for cls in list_kinds(scene.recording) if ahead is None or cls.looks_ahead == ahead)
    rows = tuple(rows for cls in classes if (rows := cls.build(scene)) is not None and len(rows))
    return tuple(_note_differences(one) if type(one).linearize is Constraint.linearize else one for one in rows)


def _note_differences(rows: Constraint) -> Constraint:
    sentence = f"{rows.name}: has no Jacobians; they are computed numerically, which takes longer"
    return replace(rows, notes=(*rows.notes, Note("constraint.differences", sentence)))


def choose_keyframes(start: float, end: float, epochs: Array, rate: float) -> Array:
    """Keyframes at both ends, at every epoch between, and in between at least at `rate`."""
    inside = epochs[(epochs > start + SAME_TIME) & (epochs < end - SAME_TIME)]
    fixed = np.unique(np.concatenate([[start], inside, [end]]))
    fixed = fixed[np.concatenate([[True], np.diff(fixed) > SAME_TIME])]
    parts = np.maximum(1, np.ceil(np.diff(fixed) * rate - 1e-6).astype(int))
    step = np.repeat(np.diff(fixed) / parts, parts)
    within = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(np.repeat(fixed[:-1], parts) + within * step, fixed[-1])


def limit_to_samples(stationary: Array | None, recording: Recording, keyframes: Array | None = None) -> Array:
    """The parts of stationary spans that a recording covers, (M, 2), limited to IMU samples and to known keyframes."""
    if stationary is None or not len(stationary):
        return np.empty((0, 2))
    begin, end = recording.start, recording.end
    stationary = stationary[(stationary[:, 1] > begin - SAME_TIME) & (stationary[:, 0] < end + SAME_TIME)]
    if not len(stationary):
        return np.empty((0, 2))
    t = np.concatenate([[begin], recording.imu.t])
    if keyframes is not None:  # spans that end at these end at no sample
        t = np.unique(np.concatenate([t, keyframes]))
    first = np.searchsorted(t, stationary[:, 0] - SAME_TIME)
    last = np.searchsorted(t, stationary[:, 1] + SAME_TIME, side="right") - 1
    kept = last > first
    return np.stack([t[first[kept]], t[last[kept]]], -1)


def _build_chains(parameters: Iterable[Parameter], t: Array) -> tuple[ParameterChain, ...]:
    chains, keyframes = [], t.tobytes()
    for p in parameters:
        if p.begins is not None:
            nodes, mean, sigma, decay = p.begins, p.initial, p.sigma, np.zeros(len(p.begins))
            node, steps = _find_nodes(nodes, t)
        else:
            nodes, node, steps = _place_nodes(keyframes, np.inf if p.constant else p.spacing)
            ahead, added = p.step(nodes[:-1], nodes[1:])
            mean = np.tile(p.initial, (len(nodes), 1))
            sigma, decay = np.concatenate([p.sigma[None], added]), np.concatenate([[0.0], ahead])
        chains.append(ParameterChain(p, nodes, node, steps, mean, sigma, decay))
    return tuple(chains)


@lru_cache(maxsize=16)  # a noise model's passes build the same chains repeatedly
def _place_nodes(keyframes: bytes, spacing: float) -> tuple[Array, Array, Array]:
    t = np.frombuffer(keyframes)
    nodes = keep_apart(t, spacing - SAME_TIME)
    return nodes, *_find_nodes(nodes, t)


def _find_nodes(nodes: Array, t: Array) -> tuple[Array, Array]:
    """The node valid at each of the keyframes t (K,), and those at which the next one begins."""
    node = np.maximum(np.searchsorted(nodes, t + SAME_TIME, side="right") - 1, 0)
    return node, np.flatnonzero(np.diff(node)) + 1


def _describe_samples(samples: Samples, recording: Recording) -> tuple[str, ...]:
    if not len(samples.bridged):
        return ()
    begin, end = samples.bridged.T
    sentence = (
        f"{describe_gaps('the IMU', end - begin, begin - recording.start)}: filled by the parts of the recording that "
        "are most like what is beside them, with their scatter as its noise"
    )
    return (Note("imu.gaps_bridged", sentence),)
