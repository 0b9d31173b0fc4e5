"""A piece of a recording, solved with given settings: prepared once, for each solver the same."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.prior import InitialPrior
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import Note
from graphnav.core.progress import Progress, tell
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS
from graphnav.detectors import detect
from graphnav.estimation.building import start_sigma
from graphnav.estimation.dense import Dense
from graphnav.estimation.faults.excluded import describe_faults, find_fault_spans
from graphnav.estimation.noise.imu_floor import apply_measured_floor
from graphnav.estimation.noise.model import NoiseModel, StampOffsets
from graphnav.estimation.noise.unmeasured import describe_unmeasured
from graphnav.estimation.noise.words import describe_far
from graphnav.estimation.noise_search import Weigh
from graphnav.estimation.offsets import move_stamps
from graphnav.estimation.preparation import Begun, Prepared, begin_preparation, prepare
from graphnav.estimation.problem import Problem
from graphnav.estimation.relinearisation import CLEARLY_BETTER, step_ahead
from graphnav.estimation.remounting import describe_remountings, find_remountings, undo_remountings
from graphnav.estimation.separation import compute_separation
from graphnav.estimation.solution import Separation, Solution
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.passes import FilterPass, SmootherPass
from graphnav.estimation.solvers.rts import rts, smooth_backward
from graphnav.estimation.solvers.turning import add_curvature
from graphnav.estimation.stamps import (
    describe_stamps,
    find_stamps,
    may_move,
    shift_to_imu_clock,
    shift_to_own_clocks,
)
from graphnav.imu.repairs import repair_imu
from graphnav.recording import Recording
from graphnav.recording.checks.clock import ClockOffsets


def solve_piece(
    recording: Recording,
    frame: LocalFrame,
    solvers: tuple[str, ...],
    progress: Progress | None,
    clock: ClockOffsets | None,
    settings: Settings,
    noise: NoiseModel | None,
) -> dict[str, Solution]:
    """Solve a piece of a recording with each solver, on exactly the same information.

    Parameters
    ----------
    frame : the navigation frame of the whole recording.
    clock : offsets between IMU and fixes that the recording shows before any estimation.
    noise : used as it is; when None it is estimated, or stated, according to the settings.

    Returns
    -------
    dict
        A `Solution` by name of solver.

    Raises
    ------
    EstimationError
        If the piece does not determine a trajectory.
    """
    began = time.perf_counter()
    recording, repaired = repair_imu(recording, settings)
    recording, measured = apply_measured_floor(recording, settings)
    search = _Search(settings, frame, clock, noise, progress, time.perf_counter() - began)
    recording, found, stamps = search.find(recording)
    faults = find_fault_spans(found.problem, found.smoothed, found.noise.excluded)
    notes = (
        *found.start.notes,
        *repaired,
        *measured,
        *describe_remountings(found.noise.remountings, recording),
        *found.detections.notes,
        *describe_stamps(stamps, found.noise.freed),
        *found.notes,
        *describe_unmeasured(found.unmeasured, recording),
        *describe_faults(faults, found.problem),
        *describe_far(found.problem, found.smoothed),
    )
    problem, forward, smoothed, passes = _start_as_stated(found, progress)
    out = {"ekf": forward.solution}
    if "rts" in solvers:
        out["rts"] = rts(problem, forward, smoothed)
    apart = _separate(frame, problem, forward, smoothed)
    # a graph needs the memory itself
    forward, smoothed, found = forward.drop_covariances(), smoothed.drop_covariances(), found.drop_covariances()
    if "batch" in solvers:
        out["batch"] = _solve_batch(problem, found, out["ekf"].timings, progress)
    begin = found.aligned.state if found.diverged else None
    # modules are imported only where a run needs them, above all GTSAM
    if "incremental" in solvers:
        from graphnav.estimation.solvers.incremental import incremental

        out["incremental"] = incremental(problem, settings.solver.lag, progress, begin)
    if "isam2" in solvers:
        from graphnav.estimation.factor_graph.tree_window import isam2

        one = isam2(problem, settings.solver.isam2_lag or np.inf, progress, begin)
        out["isam2"] = one if settings.solver.isam2_lag else _tell_worse(one, problem, smoothed)
    timings = {"detection": search.detection, **found.timings}
    by_name = {
        name: replace(
            out[name],
            notes=(*notes, *out[name].notes),
            detections=found.detections.all,
            excluded=(*found.unmeasured.list_held(found.noise.spacing), *faults),
            noise=found.noise,
            passes=dict(passes),
            separation=apart,
            fixed=found.fixed.get(name, found.fixed.get("", out[name].fixed)),
            arcs=found.arcs.get(name, found.arcs[""]),
            timings={k: timings.get(k, 0.0) + out[name].timings.get(k, 0.0) for k in (*timings, *out[name].timings)},
        )
        for name in solvers
    }
    return {name: shift_to_own_clocks(_widen(one, found.spread), stamps) for name, one in by_name.items()}


class _Search:
    """The search for stamp offsets and for turns of the device, each step of which begins a preparation.

    Parameters
    ----------
    detection : s that detection has taken so far.
    """

    def __init__(
        self,
        settings: Settings,
        frame: LocalFrame,
        clock: ClockOffsets | None,
        noise: NoiseModel | None,
        progress: Progress | None,
        detection: float,
    ) -> None:
        self._settings, self._frame, self._clock, self._progress = settings, frame, clock, progress
        self._noise = noise
        self.detection = detection

    def find(self, recording: Recording) -> tuple[Recording, Prepared, StampOffsets]:
        """The recording with its stamps where their offsets are estimated and as of a device that was never turned,
        what its solvers share, and these offsets.
        """
        given = undo_remountings(recording, () if self._noise is None else self._noise.remountings)
        moved, begun, found, stamps = self._find_stamps(given)
        if self._noise is None:
            remountings = find_remountings(moved, partial(self._begin, rate=stamps.rate), begun)
            if remountings:
                moved, _, found, stamps = self._find_stamps(undo_remountings(given, remountings))
                found = replace(found, noise=replace(found.noise, remountings=remountings))
        return moved, found, stamps

    def _find_stamps(self, recording: Recording) -> tuple[Recording, Begun, Prepared, StampOffsets]:
        noise = self._noise
        if noise is None and may_move(recording, self._settings):
            return find_stamps(recording, self._begin, self._finish, self._clock)
        stamps = StampOffsets() if noise is None else noise.stamps
        recording = move_stamps(recording, stamps)
        begun = self._begin(recording, stamps.rate)
        return recording, begun, self._finish(begun), stamps

    def _begin(self, moved: Recording, rate: float, before: Begun | None = None) -> Begun:
        tell("detection")
        began = time.perf_counter()
        # evidences compare between the same rows: fixes a little closer together must not have fewer keyframes between
        keyframes = self._settings.keyframes
        keyframes = keyframes.model_copy(update={"rate": keyframes.rate / (1.0 + rate)})
        settings = self._settings.model_copy(update={"keyframes": keyframes})
        detected = detect(moved, settings)
        self.detection += time.perf_counter() - began
        noise = None if self._noise is None else shift_to_imu_clock(self._noise)
        return begin_preparation(moved, settings, self._frame, detected, noise, self._progress, before)

    def _finish(self, begun: Begun, weigh: Weigh | None = None) -> Prepared:
        return prepare(begun, self._progress, weigh)


def _start_as_stated(
    found: Prepared, progress: Progress | None
) -> tuple[Problem, FilterPass, SmootherPass, Counter[str]]:
    """The problem with the start that the user states, its filter and smoother, and the passes so far: those found,
    unless a filter from there diverges for a while.
    """
    problem, passes = found.problem, Counter(found.passes)
    if not found.diverged:
        return problem, found.forward, found.smoothed, passes
    prior = InitialPrior(keyframe=problem.prior.keyframe, mean=found.start.state, sigma=start_sigma(found.start)[None])
    problem = replace(problem, prior=prior)
    forward = ekf(problem, progress, found.aligned.opening)
    passes.update(filter=1, smoother=1)
    return problem, forward, smooth_backward(problem, forward, progress), passes


def _separate(frame: LocalFrame, problem: Problem, forward: FilterPass, smoothed: SmootherPass) -> Separation:
    place, causal = BLOCKS["p"], forward.solution
    return compute_separation(
        frame, problem.t, causal.states.p, causal.covariance[:, place, place],
        smoothed.states.p, smoothed.P[:, place, place],
    )  # fmt: skip


def _solve_batch(problem: Problem, found: Prepared, before: dict[str, float], progress: Progress | None) -> Solution:
    """The batch solution; its timings include those before it."""
    from graphnav.estimation.factor_graph.batch import batch

    began = time.perf_counter()
    near = found.ahead or step_ahead(problem, found.smoothed)
    solved = batch(problem, near.states, near.select_nodes(problem), progress=progress)
    seconds = solved.timings["batch"] + time.perf_counter() - began - sum(solved.timings.values())
    return replace(solved, timings={**before, **solved.timings, "batch": seconds})


def _tell_worse(one: Solution, problem: Problem, smoothed: SmootherPass) -> Solution:
    """An iSAM2 solution, with a note where it is in a worse optimum than the smoother's."""
    from graphnav.estimation.solvers.rows import compute_cost_at

    best = compute_cost_at(problem, smoothed)
    if one.cost is None or one.cost <= best + CLEARLY_BETTER:
        return one
    note = Note(
        "solver.worse_optimum",
        f"isam2 converged to a worse optimum than rts (half chi-square {one.cost:.0f}, not {best:.0f}): do not trust "
        "it",
    )
    return replace(one, notes=(note, *one.notes))


def _widen(solution: Solution, spread: Array | None) -> Solution:
    """The solution with what an unknown heading makes of its positions to second order, and what may be wrong."""
    P = add_curvature(solution.covariance, solution.states)
    P = P if spread is None else P + spread
    between = (one.widen(P) if isinstance(one, Dense) else one for one in solution.between)
    return replace(solution, covariance=P, between=tuple(between))
