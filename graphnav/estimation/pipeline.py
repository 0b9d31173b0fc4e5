"""From a recording to solutions: screened, split where necessary, each piece solved, and the solutions joined."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from graphnav.config import Settings
from graphnav.constraints import check_own as check_constraints
from graphnav.constraints.base import Constraint
from graphnav.constraints.raw_selection import check_masks
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import ConfigError, EstimationError, RecordingError
from graphnav.core.memory import return_memory
from graphnav.core.notes import Note, Notes
from graphnav.core.progress import Progress, send_progress
from graphnav.detectors import Detector
from graphnav.detectors import check_own as check_detectors
from graphnav.estimation.long_drives import OVERLAP, crop_solutions, share_covariances, split_drive
from graphnav.estimation.noise.files import MODES
from graphnav.estimation.noise.model import STATED, NoiseModel
from graphnav.estimation.piece import solve_piece
from graphnav.estimation.pieces import describe_span, split_pieces
from graphnav.estimation.solution import KNOWN, Solution, join_solutions
from graphnav.estimation.solvers.breakdown import explain_singular
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
                attempt = partial(solve_piece, part.recording, frame, solvers, progress, clock)
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
