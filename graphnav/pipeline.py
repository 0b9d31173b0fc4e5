"""From a recording to solutions: cut where it must be, align, pose, solve with each solver."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from graphnav import faults, judgement
from graphnav.alignment import Alignment, align, with_known_heading
from graphnav.config import Settings
from graphnav.constraints.prior import InitialPrior
from graphnav.detectors import detect
from graphnav.earth import LocalFrame
from graphnav.errors import ConfigError, EstimationError
from graphnav.problem import Problem, pose
from graphnav.progress import Progress, listening, tell
from graphnav.recording import Recording
from graphnav.solution import Solution, joined
from graphnav.solvers.batch import batch
from graphnav.solvers.ekf import Filtered, Smoothed, backward, ekf, rts
from graphnav.solvers.incremental import incremental
from graphnav.solvers.isam import isam2

SOLVERS = ("ekf", "rts", "batch")  # that run when none is named
KNOWN = ("ekf", "rts", "incremental", "isam2", "batch")
_FAR = 0.5  # rad between the stated and the found start attitude
_REVIEWS = 2  # of where faults begin and end
_MOST = 0.5  # share of the fixes of a kind that can be wrong
_SHORTEST = 5.0  # s; a piece between two cuts that is shorter cannot be aligned


def run(
    recording: Recording,
    settings: Settings | None = None,
    solvers: tuple[str, ...] = SOLVERS,
    progress: Progress | None = None,
) -> dict[str, Solution]:
    """Solve a recording with several solvers on exactly the same information.

    Parameters
    ----------
    recording
        From `graphnav.load`.
    settings
        The defaults when None.
    solvers
        Out of "ekf", "rts", "incremental", "isam2", "batch".
    progress
        Called now and then with a stage and its share done, 0 to 1.

    Returns
    -------
    dict
        Solver name to `Solution`, in the order asked for.

    Raises
    ------
    EstimationError
        If the recording does not determine a trajectory.
    ConfigError
        If the settings' profile is of another platform.
    """
    settings = settings or Settings()
    with listening(progress):
        return _run(recording, settings, solvers, progress)


def _run(
    recording: Recording, settings: Settings, solvers: tuple[str, ...], progress: Progress | None
) -> dict[str, Solution]:
    unknown = [name for name in solvers if name not in KNOWN]
    if unknown:
        raise EstimationError(f"no solver '{unknown[0]}'; known: {', '.join(KNOWN)}")
    frame = LocalFrame(origin(recording))
    said = fitting(recording, settings)
    pieces, notes = _pieces(recording, settings)
    notes = [*said, *notes]
    found: list[dict[str, Solution]] = []
    for piece in pieces:
        try:
            # matrices here have thirty rows: threads for them cost more than the work, twenty times on a busy machine
            with threadpool_limits(limits=1, user_api="blas"):
                found.append(_solved(piece, settings, frame, solvers, progress))
        except EstimationError as error:
            if len(pieces) == 1:
                raise
            notes.append(f"{_span(recording, piece)} left out: {error}")
    if not found:
        raise EstimationError(f"'{recording.name}': no piece between its IMU gaps can be solved")
    return {name: joined([one[name] for one in found], tuple(notes)) for name in solvers}


def _solved(
    recording: Recording, settings: Settings, frame: LocalFrame, solvers: tuple[str, ...], progress: Progress | None
) -> dict[str, Solution]:
    """`_solve`, and once more without what covariances may not have the digits for."""
    try:
        return _solve(recording, settings, frame, solvers, progress)
    except (EstimationError, np.linalg.LinAlgError) as error:
        if not settings.standstill.held_position:
            raise
        still = settings.standstill.model_copy(update={"held_position": False})
        again = _solve(recording, settings.model_copy(update={"standstill": still}), frame, solvers, progress)
        note = f"places of stops are not held: with them, {error}"
        return {name: replace(one, notes=(note, *one.notes)) for name, one in again.items()}


def _solve(
    recording: Recording, settings: Settings, frame: LocalFrame, solvers: tuple[str, ...], progress: Progress | None
) -> dict[str, Solution]:
    began = time.perf_counter()
    tell("detection")
    found = detect(recording, settings)
    stationary = found.stationary
    detected = time.perf_counter()
    tell("alignment")
    aligned = align(
        recording, settings, frame, lambda problem, start: batch(problem, start, wanted=(0,), reintegrate=False)
    )
    after = time.perf_counter()
    stated = with_known_heading(aligned, settings)
    # A stated heading far from the one found sends the filter, and its linearisation with it, astray for a while. It
    # stays in the problem as its prior, but all else is judged, and the smoother sets out, from what was found.
    found_heading = aligned.motion is not None  # without motion heading zero is only a convention
    astray = found_heading and bool(np.linalg.norm(aligned.state.minus(stated.state)[0, :3]) > _FAR)

    spent: list[float] = []
    overruled = settings.gnss.faults == "off"  # most fixes contradict the filter, or nobody asks whether they do

    def posed(wrong: tuple[faults.Fault, ...] = ()) -> tuple[Problem, tuple[str, ...]]:
        tell("judgement")
        sensed, how, said = judged(recording, settings, frame, aligned, stationary, wrong, overruled)
        begin = aligned if astray else stated
        tell("preintegration")
        started = time.perf_counter()
        problem = pose(sensed, how, frame, begin.state, begin.sigma, stationary)
        spent.append(time.perf_counter() - started)
        return problem, said

    def watched(problem: Problem) -> tuple[Problem, Filtered]:
        nonlocal overruled
        forward = ekf(problem, progress, aligned.until, watch=True)
        found = faults.weighted(problem, forward.weights)
        if too_many := settings.gnss.faults != "on" and faults.share(found) > _MOST:
            found, overruled = faults.all_used(problem), True
        if too_many or forward.anew:
            forward = ekf(found, progress, aligned.until)
        return found, forward

    def reviewed(problem: Problem) -> tuple[Problem, Filtered, Smoothed, tuple[str, ...]]:
        problem, forward = watched(problem)
        raised: tuple[str, ...] = ()
        for again in range(_REVIEWS):
            before = faults.count(problem)
            if before:
                apart = faults.widened(problem)
                smoothed = backward(apart, ekf(apart, progress, aligned.until), progress)
                problem = faults.readmitted(problem, smoothed)
            else:
                smoothed = backward(problem, forward, progress)
            if not again:
                problem, raised = judgement.judge_speeds(problem, smoothed)
            if before:
                problem, forward = watched(problem)
            elif raised:
                forward = ekf(problem, progress, aligned.until)
            if faults.count(problem) == before:
                break
        if before or raised:
            smoothed = backward(problem, forward, progress)
        return problem, forward, smoothed, raised

    asked = overruled
    problem, said = posed()
    done = time.perf_counter()
    problem, forward, smoothed, raised = reviewed(problem)
    if overruled and not asked:
        # when most are wrong it is their sigmas that are
        other, says = posed()
        if says != said:
            said = says
            problem, forward, smoothed, raised = reviewed(other)
    if faults.count(problem):
        # what faults did to the states around them may have passed for noise of the IMU
        wrong = faults.spans(problem, noisy=True)
        other, says = posed(wrong)
        if judgement.calmer(other.recording.imu.noise, problem.recording.imu.noise):
            weights = {c.name: c.weight for c in problem.constraints if c.weight is not None}
            problem, said = faults.weighted(other, weights), says
            forward = ekf(problem, progress, aligned.until)
            problem, raised = judgement.judge_speeds(problem, backward(problem, forward, progress))
            forward = ekf(problem, progress, aligned.until) if raised else forward
            smoothed = backward(problem, forward, progress)
    said = (*said, *raised)
    timings = {
        "detection": detected - began,
        "alignment": after - detected,
        "judgement": done - after - spent[0],
        "preintegration": sum(spent),
        "smoother": time.perf_counter() - done - sum(spent[1:]) - forward.solution.timings["filter"],
    }
    wrong = faults.spans(problem, smoothed)
    said = (*said, *faults.notes(wrong, problem))
    start = smoothed
    if astray:
        prior = InitialPrior(keyframe=problem.prior.keyframe, mean=stated.state, sigma=stated.sigma[None])
        problem = replace(problem, prior=prior)
        forward = ekf(problem, progress, aligned.until)
        smoothed = backward(problem, forward, progress)
    out = {"ekf": forward.solution}
    if "rts" in solvers:
        out["rts"] = rts(problem, forward, smoothed)
    if "batch" in solvers:
        out["batch"] = batch(problem, start.states, start.nodes(problem), progress=progress)
        # what it took to get there is part of it
        out["batch"] = replace(out["batch"], timings={**forward.solution.timings, **out["batch"].timings})
    if "incremental" in solvers:
        begin = aligned.state if astray else None
        out["incremental"] = incremental(problem, settings.solver.lag, progress, begin).settled
    if "isam2" in solvers:
        out["isam2"] = isam2(problem, progress).settled
    return {
        name: replace(
            out[name],
            notes=(*stated.notes, *found.notes, *said, *out[name].notes),
            detections=found.all,
            excluded=wrong,
            timings={k: timings.get(k, 0.0) + out[name].timings.get(k, 0.0) for k in (*timings, *out[name].timings)},
        )
        for name in solvers
    }


def judged(
    recording: Recording,
    settings: Settings,
    frame: LocalFrame,
    aligned: Alignment,
    stationary: np.ndarray,
    wrong: tuple[faults.Fault, ...] = (),
    witnesses: bool = False,
) -> tuple[Recording, Settings, tuple[str, ...]]:
    """Recording and settings with the figures of IMU and fixes judged by the first part of the drive.

    Parameters
    ----------
    wrong : spans of fixes to judge without.
    witnesses : whether wheels may say that it is not the IMU that is noisy, but errors of the fixes that last.
    """
    gnss, stated = settings.gnss, recording.imu.noise
    if aligned.motion is None or not gnss.position:
        return recording, settings, ()
    free = settings.without_wheels()  # wheels are judged by what comes of this, so they have no say in it
    plain = free.model_copy(
        update={
            "gnss": gnss.model_copy(update={"sd_factor": 1.0, "slow_share": 0.0, "fast_time": 0.0, "adaptive": "off"})
        }
    )
    part = judgement.stretch(recording, aligned.motion)
    noise = stated
    weight: dict[str, np.ndarray] = {}

    def posed(how: Settings) -> Problem:
        noisy = replace(part, imu=replace(part.imu, noise=noise))
        problem = faults.weighted(pose(noisy, how, frame, aligned.state, aligned.sigma, stationary), weight)
        return faults.without(problem, wrong)

    def smoothed(how: Settings) -> tuple[Problem, Filtered, Smoothed]:
        problem = posed(how)
        forward = ekf(problem, opening=aligned.until)
        return problem, forward, backward(problem, forward)

    try:
        problem, forward, back = smoothed(plain)
        suspicious = judgement.suspicious(problem, back)
    except EstimationError:
        suspicious = True
    if suspicious:
        noise = judgement.noisiest(stated)
        weight = ekf(posed(plain), opening=aligned.until, watch=True).weights
        noise = stated
        problem, forward, back = smoothed(plain)
        weight = judgement.outliers(problem, back)
        problem, forward, back = smoothed(plain)
    fixes = judgement.judge_fixes(problem, back)
    lasting = None if fixes is None or gnss.fast_time == 0.0 else judgement.judge_lasting(problem, back)

    def improve(basis: Settings) -> None:
        """Raise the noise figures of the IMU as it asks for, in rounds."""
        nonlocal noise
        for _ in range(judgement.ROUNDS):
            imu = judgement.judge_imu(*smoothed(basis))
            better = imu.applied(noise, stated)
            if (noise == stated and not imu.clear) or imu.settled or better == noise:
                break
            noise = better

    if not settings.imu.as_stated and judgement.judge_imu(problem, forward, back).clear:
        # fixes that wander would pass for noise of the IMU: it is judged with their wandering in the problem
        improve(plain if fixes is None else fixes.applied(free))
        if noise != stated:
            problem, _, back = smoothed(plain)
            fixes = judgement.judge_fixes(problem, back)
    larger = fixes is not None and fixes.sd_factor > judgement.CLEARLY
    if (
        fixes is not None
        and lasting is not None
        and lasting.fast_time > 0.0
        and (larger or (witnesses and noise != stated))
    ):
        # the IMU may be that bad, or errors of the fixes last for seconds: wheels, without a say so far, are witnesses
        raised, part, weight = noise, judgement.stretch(recording, aligned.motion, judgement.LONG), {}
        try:
            problem, _, back = smoothed(fixes.applied(settings))
            against, chance = judgement.contradiction(problem, back)
            if larger or against > chance:
                noise = stated
                problem, _, back = smoothed(lasting.applied(settings))
                lasting = judgement.judge_lasting(problem, back)
                if not settings.imu.as_stated:
                    problem, _, back = smoothed(lasting.applied(free))
                    weight = judgement.outliers(problem, back)
                    improve(lasting.applied(free))
                    weight = {}
                problem, _, back = smoothed(lasting.applied(settings))
                agreed = judgement.contradiction(problem, back)[0] < against - chance
                if larger or (agreed and judgement.calmer(noise, raised)):
                    fixes, raised = lasting, noise
        except EstimationError:
            pass  # as it was judged before
        noise = raised
    recording = replace(recording, imu=replace(recording.imu, noise=noise))
    notes = judgement.imu_notes(stated, noise)
    if fixes is None:
        return recording, settings, notes
    return recording, fixes.applied(settings), (*notes, *fixes.notes)


def fitting(recording: Recording, settings: Settings) -> list[str]:
    """What the settings' profile asks for and the recording lacks, in sentences.

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
            f"profile '{profile}': but '{recording.name}' says platform = \"{recording.platform}\"; change one of them"
        )
    if profile == "car+odometer" and recording.odometer is None:
        return [f"profile '{profile}': there is no odometer in '{recording.name}', so it is solved without"]
    return []


def origin(recording: Recording) -> np.ndarray:
    """Origin of the navigation frame: the first fix, or 45 deg north at sea level without any."""
    gnss = recording.gnss
    if gnss is not None and len(gnss.t):
        inside = np.flatnonzero((gnss.t >= recording.start) & (gnss.t <= recording.end))
        return gnss.llh[inside[0] if len(inside) else 0]
    return np.array([np.pi / 4, 0.0, 0.0])


def _pieces(recording: Recording, settings: Settings) -> tuple[list[Recording], list[str]]:
    """The recording cut at IMU gaps too long to bridge, and a sentence for each cut."""
    t = recording.imu.t
    cuts = np.flatnonzero(np.diff(t) > settings.keyframes.bridge)
    if not len(cuts):
        return [recording], []
    notes = [
        f"IMU gap of {t[i + 1] - t[i]:.1f} s at {t[i] - recording.start:.1f} s: cut there, the parts are solved apart"
        for i in cuts
    ]
    edges = np.concatenate([[-1], cuts, [len(t) - 1]])
    pieces = []
    for lo, hi in itertools.pairwise(edges):
        begin, end = t[lo + 1] - recording.start, t[hi] - recording.start
        if end - begin < _SHORTEST:
            notes.append(f"{begin:.1f} to {end:.1f} s left out: too short between two gaps to be aligned")
        else:
            pieces.append(recording.crop(begin - 1e-9, end + 1e-9))
    return pieces, notes


def _span(recording: Recording, piece: Recording) -> str:
    return f"{piece.start - recording.start:.0f} to {piece.end - recording.start:.0f} s"
