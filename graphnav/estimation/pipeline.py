"""From a recording to solutions: split where necessary, align, build the problem, solve with each solver."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from graphnav.config import Settings
from graphnav.constraints import check_own as check_constraints
from graphnav.constraints.base import Constraint
from graphnav.constraints.prior import InitialPrior
from graphnav.constraints.raw_selection import check_masks
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import ConfigError, EstimationError, RecordingError
from graphnav.core.memory import return_memory
from graphnav.core.notes import Note, Notes
from graphnav.core.progress import Progress, send_progress, tell
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS
from graphnav.detectors import Detector, detect
from graphnav.detectors import check_own as check_detectors
from graphnav.estimation.building import start_sigma
from graphnav.estimation.dense import Dense
from graphnav.estimation.faults.excluded import describe_faults, find_fault_spans
from graphnav.estimation.long_drives import OVERLAP, crop_solutions, share_covariances, split_drive
from graphnav.estimation.noise.files import MODES
from graphnav.estimation.noise.imu_floor import apply_measured_floor
from graphnav.estimation.noise.model import STATED, NoiseModel, StampOffsets
from graphnav.estimation.noise.unmeasured import describe_unmeasured
from graphnav.estimation.noise.words import describe_far
from graphnav.estimation.noise_search import Weigh
from graphnav.estimation.offsets import move_stamps
from graphnav.estimation.pieces import describe_span, split_pieces
from graphnav.estimation.preparation import Begun, Prepared, begin_preparation, prepare
from graphnav.estimation.relinearisation import CLEARLY_BETTER, step_ahead
from graphnav.estimation.remounting import describe_remountings, find_remountings, undo_remountings
from graphnav.estimation.separation import compute_separation
from graphnav.estimation.solution import KNOWN, Solution, join_solutions
from graphnav.estimation.solvers.breakdown import explain_singular
from graphnav.estimation.solvers.ekf import ekf
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
from graphnav.recording import Own, Recording
from graphnav.recording.checks.aiding import describe_gnss_apart
from graphnav.recording.checks.clock import ClockOffsets
from graphnav.recording.plausibility.screening import screen, state_findings

SOLVERS = ("ekf", "rts", "batch")  # run when none is named

Attempt = Callable[[Settings, NoiseModel | None], dict[str, Solution]]  # to solve with these


def run(
    recording: Recording,
    settings: Settings | None = None,
    solvers: Sequence[str] | str = SOLVERS,
    progress: Progress | None = None,
    noise: NoiseModel | Literal["stated", "estimated"] | None = None,
    constraints: Sequence[type[Constraint]] = (),
    detectors: Sequence[type[Detector]] = (),
) -> dict[str, Solution]:
    """Solve a recording with several solvers on exactly the same information.

    Parameters
    ----------
    recording
        The recording, as `graphnav.load` returns it.
    settings
        All settings; the defaults when None.
    solvers
        Names of solvers, or of one: "ekf", "rts", "incremental", "isam2", "batch".
    progress
        Function called with a stage and the share of it that is done, 0 to 1.
    noise
        Noise model of the sensors, or how it is found; when None, as `settings.noise.mode` sets.
    constraints, detectors
        Additional classes of a script.

    Returns
    -------
    dict
        A `Solution` by name of solver, in the order of `solvers`.

    Raises
    ------
    RecordingError
        If a sensor is wrong throughout, or GNSS and IMU share no time.
    EstimationError
        If the recording does not determine a trajectory.
    ConfigError
        If the settings' profile is of another platform, they leave no raw observation, a class of a script is not
        complete, or an argument is none of these.
    """
    settings = settings or Settings()
    for given, kind, maker in ((recording, Recording, "load"), (settings, Settings, "read_settings or Settings")):
        if not isinstance(given, kind):
            raise ConfigError(
                f"run: a {type(given).__name__} is no {kind.__name__}; graphnav.{maker} makes one", key="run.argument"
            )
    solvers = (solvers,) if isinstance(solvers, str) else tuple(solvers)
    if noise is not None and not isinstance(noise, NoiseModel):
        if noise not in MODES:
            raise ConfigError(f"noise={noise!r}: give a NoiseModel or one of {', '.join(MODES)}", key="noise.mode")
        settings = settings.model_copy(update={"noise": settings.noise.model_copy(update={"mode": noise})})
        noise = None
    recording = add_own(recording, constraints, detectors)
    screened = screen(recording)
    recording, found = screened.recording, state_findings(recording, screened.findings)
    if (apart := describe_gnss_apart(recording)) is not None:  # it would be solved as if there were no GNSS
        raise RecordingError(f"'{recording.name}': {apart}", key="gnss.apart")
    check_masks(recording, settings)
    with send_progress(progress):
        solutions = _run(recording, settings, solvers, progress, noise, screened.clock)
    return {name: replace(one, notes=(*found, *one.notes)) for name, one in solutions.items()}


def add_own(
    recording: Recording, constraints: Sequence[type[Constraint]] = (), detectors: Sequence[type[Detector]] = ()
) -> Recording:
    """The recording, or the setup of a live source, with the constraints and detectors of a script added.

    Raises
    ------
    ConfigError
        If one of them is not complete, or has a name that is taken.
    """
    if not constraints and not detectors:
        return recording
    own = Own(check_constraints(constraints), check_detectors(detectors))
    return replace(recording, own=own)


def _run(
    recording: Recording,
    settings: Settings,
    solvers: tuple[str, ...],
    progress: Progress | None,
    noise: NoiseModel | None,
    clock: ClockOffsets | None,
) -> dict[str, Solution]:
    unknown = [name for name in solvers if name not in KNOWN]
    if unknown:
        raise EstimationError(f"no solver '{unknown[0]}'; known: {', '.join(KNOWN)}", key="solver.unknown")
    frame = LocalFrame(choose_origin(recording), recording.start)
    pieces, cuts = split_pieces(recording, settings)
    notes = Notes([*check_profile(recording, settings), *cuts])
    found: list[dict[str, Solution]] = []
    parts = [share for piece in pieces for share in split_drive(piece, settings)]
    if len(parts) > 1:
        return_memory()
    if len(parts) > len(pieces):
        sentence = f"too long to be solved at once: solved in {len(parts)} parts that overlap by {OVERLAP:.0f} s"
        notes.add("pieces.parts", sentence)
    for part in parts:
        try:
            # matrices here have thirty rows: threading costs more than the work, twenty times as much on a busy machine
            with threadpool_limits(limits=1, user_api="blas"):
                attempt = partial(_solve, part.recording, frame, solvers, progress, clock)
                solved = _solve_with_retry(attempt, settings, noise)
            found.append(crop_solutions(solved, part))
            del solved
            if len(parts) > 1:
                return_memory()
        except EstimationError as error:
            if len(parts) == 1:
                raise
            notes.add("pieces.left_out", f"{describe_span(recording, part.recording)} left out: {error}")
    if not found:
        raise EstimationError(
            f"'{recording.name}': no piece between its IMU gaps can be solved", key="pieces.none_solved"
        )
    joined = {}
    for name in dict.fromkeys(solvers):
        joined[name] = share_covariances(join_solutions([one.pop(name) for one in found], tuple(notes)))
        if len(parts) > 1:
            return_memory()
    return joined


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # breakdowns raise errors
def _solve_with_retry(attempt: Attempt, settings: Settings, noise: NoiseModel | None) -> dict[str, Solution]:
    """An attempt; where a filter breaks down numerically, again with a simpler model or stated noise."""
    try:
        return attempt(settings, noise)
    except (EstimationError, np.linalg.LinAlgError) as error:
        if isinstance(error, EstimationError) and error.key != "solver.breakdown":
            raise
        for other, model, reason in _simplify(settings, noise):
            try:
                again = attempt(other, model)
            except (EstimationError, np.linalg.LinAlgError):
                continue
            note = Note(reason.key, f"{reason}: {error}")
            return {name: replace(one, notes=(note, *one.notes)) for name, one in again.items()}
        if isinstance(error, EstimationError):
            raise
        raise explain_singular(error) from None


def _simplify(settings: Settings, noise: NoiseModel | None) -> Iterator[tuple[Settings, NoiseModel | None, Note]]:
    """Settings and noise models that demand less numerical precision of a covariance, with notes."""
    still = settings.standstill.model_copy(update={"held_position": False})
    if settings.standstill.held_position:
        settings = settings.model_copy(update={"standstill": still})
        yield (
            settings,
            noise,
            Note("standstill.not_held", "the position at stops is not held: the solver failed with it"),
        )
    if noise is None and settings.noise.mode != "stated":
        yield (
            settings,
            STATED,
            Note("noise.not_estimated", "noise as stated and no fix left out: estimating the noise failed"),
        )


def _solve(
    recording: Recording,
    frame: LocalFrame,
    solvers: tuple[str, ...],
    progress: Progress | None,
    clock: ClockOffsets | None,
    settings: Settings,
    noise: NoiseModel | None,
) -> dict[str, Solution]:
    began = time.perf_counter()
    recording, undone = repair_imu(recording, settings)
    recording, shown = apply_measured_floor(recording, settings)
    detection = time.perf_counter() - began

    def begin_moved(moved: Recording, rate: float, before: Begun | None = None) -> Begun:
        nonlocal detection
        tell("detection")
        began = time.perf_counter()
        # evidences compare between the same rows: fixes a little closer together must not have fewer keyframes between
        keyframes = settings.keyframes.model_copy(update={"rate": settings.keyframes.rate / (1.0 + rate)})
        own = settings.model_copy(update={"keyframes": keyframes})
        detected = detect(moved, own)
        detection += time.perf_counter() - began
        given = None if noise is None else shift_to_imu_clock(noise)
        return begin_preparation(moved, own, frame, detected, given, progress, before)

    def finish(begun: Begun, weigh: Weigh) -> Prepared:
        return prepare(begun, progress, weigh)

    def find(recording: Recording) -> tuple[Recording, Begun, Prepared, StampOffsets]:
        if noise is None and may_move(recording, settings):
            return find_stamps(recording, begin_moved, finish, clock)
        stamps = StampOffsets() if noise is None else noise.stamps
        recording = move_stamps(recording, stamps)
        begun = begin_moved(recording, stamps.rate)
        return recording, begun, prepare(begun, progress), stamps

    remountings = () if noise is None else noise.remountings
    given = undo_remountings(recording, remountings)
    recording, begun, found, stamps = find(given)
    if noise is None:
        remountings = find_remountings(recording, partial(begin_moved, rate=stamps.rate), begun)
        if remountings:
            recording, begun, found, stamps = find(undo_remountings(given, remountings))
            found = replace(found, noise=replace(found.noise, remountings=remountings))
    problem, forward, smoothed = found.problem, found.forward, found.smoothed
    faults = find_fault_spans(problem, smoothed, found.noise.excluded)
    notes = (
        *found.start.notes,
        *undone,
        *shown,
        *describe_remountings(remountings, recording),
        *found.detections.notes,
        *describe_stamps(stamps, found.noise.freed),
        *found.notes,
        *describe_unmeasured(found.unmeasured, recording),
        *describe_faults(faults, problem),
    )
    notes = (*notes, *describe_far(problem, smoothed))
    passes = Counter(found.passes)
    if found.diverged:
        prior = InitialPrior(
            keyframe=problem.prior.keyframe, mean=found.start.state, sigma=start_sigma(found.start)[None]
        )
        problem = replace(problem, prior=prior)
        forward = ekf(problem, progress, found.aligned.opening)
        smoothed = smooth_backward(problem, forward, progress)
        passes.update(filter=1, smoother=1)
    out = {"ekf": forward.solution}
    if "rts" in solvers:
        out["rts"] = rts(problem, forward, smoothed)
    place = BLOCKS["p"]
    apart = compute_separation(
        frame, problem.t, forward.solution.states.p, forward.solution.covariance[:, place, place],
        smoothed.states.p, smoothed.P[:, place, place],
    )  # fmt: skip
    # a graph needs the memory itself
    forward, smoothed = forward.drop_covariances(), smoothed.drop_covariances()
    found = replace(found, forward=found.forward.drop_covariances(), smoothed=found.smoothed.drop_covariances())
    # modules are imported only where a run needs them, above all GTSAM
    if "batch" in solvers:
        from graphnav.estimation.factor_graph.batch import batch

        began = time.perf_counter()
        near = found.ahead or step_ahead(problem, found.smoothed)
        solved = batch(problem, near.states, near.select_nodes(problem), progress=progress)
        seconds = {"batch": solved.timings["batch"] + time.perf_counter() - began - sum(solved.timings.values())}
        # includes the attempts before
        out["batch"] = replace(solved, timings={**forward.solution.timings, **solved.timings, **seconds})
    begin = found.aligned.state if found.diverged else None
    if "incremental" in solvers:
        from graphnav.estimation.solvers.incremental import incremental

        out["incremental"] = incremental(problem, settings.solver.lag, progress, begin)
    if "isam2" in solvers:
        from graphnav.estimation.factor_graph.tree_window import isam2
        from graphnav.estimation.solvers.rows import compute_cost_at

        out["isam2"] = one = isam2(problem, settings.solver.isam2_lag or np.inf, progress, begin)
        best = compute_cost_at(problem, smoothed)
        if not settings.solver.isam2_lag and one.cost is not None and one.cost > best + CLEARLY_BETTER:
            note = Note(
                "solver.worse_optimum",
                f"isam2 converged to a worse optimum than rts (half chi-square {one.cost:.0f}, not {best:.0f}): do not "
                "trust it",
            )
            out["isam2"] = replace(one, notes=(note, *one.notes))
    timings = {"detection": detection, **found.timings}
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


def _widen(solution: Solution, spread: Array | None) -> Solution:
    """The solution with what an unknown heading makes of its positions to second order, and what may be wrong."""
    P = add_curvature(solution.covariance, solution.states)
    P = P if spread is None else P + spread
    between = (one.widen(P) if isinstance(one, Dense) else one for one in solution.between)
    return replace(solution, covariance=P, between=tuple(between))


def check_profile(recording: Recording, settings: Settings) -> list[str]:
    """Notes on what the settings' profile requires and the recording lacks.

    Raises
    ------
    ConfigError
        If the profile is of another platform.
    """
    profile = settings.profile
    if profile is None:
        return []
    if (profile == "foot") != (recording.platform == "foot"):
        raise ConfigError(
            f"profile '{profile}': but '{recording.name}' says platform = \"{recording.platform}\"; change one of them",
            key="profile.platform",
        )
    if profile == "car+odometer" and recording.odometer is None:
        return [
            Note(
                "settings.no_odometer",
                f"profile '{profile}': there is no odometer in '{recording.name}', so it is solved without",
            )
        ]
    return []


def choose_origin(recording: Recording) -> np.ndarray:
    """Origin of the navigation frame: the first fix, or 45 deg north at sea level without any."""
    gnss = recording.gnss
    if gnss is not None and len(gnss.t):
        inside = np.flatnonzero((gnss.t >= recording.start) & (gnss.t <= recording.end))
        return gnss.llh[inside[0] if len(inside) else 0]
    return np.array([np.pi / 4, 0.0, 0.0])
