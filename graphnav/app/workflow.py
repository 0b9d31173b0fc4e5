"""One run as the command line and scripts need it: read, withhold, solve, score. Prints and writes nothing.

`graphnav.app.outputs` writes what `run_request` returns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graphnav.app.checking import Checks, load_solvers
from graphnav.app.reading import AskedPart, ReadPart, begin_reading, measure_time
from graphnav.app.scores import Withheld, score
from graphnav.app.withholding import shift_spans, withhold
from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.base import SAME_TIME
from graphnav.core.beside import Beside, Later, begin_beside
from graphnav.core.errors import ConfigError, EstimationError, RecordingError
from graphnav.core.findings import Finding
from graphnav.core.interpolation import pick_nearest
from graphnav.core.memory import return_memory
from graphnav.core.notes import Note, Notes, format_count, get_key
from graphnav.core.progress import Progress, send_progress, tell
from graphnav.core.staging import keep_inputs
from graphnav.estimation.names import name_rows
from graphnav.estimation.noise.model import INTERVALS, NoiseModel, StampOffsets
from graphnav.estimation.solution import Solution
from graphnav.evaluation.against import Against, read_against, select_own
from graphnav.recording import ImuNoise, Recording
from graphnav.recording.exporters import check_names

if TYPE_CHECKING:
    from graphnav.evaluation.metrics import Metrics

_SOLVING = "preintegration"  # the stage at which a recording that cannot be solved is refused at the latest
LOOSE = "-loose"  # suffix of the name of a solution from fixes in place of raw observations


@dataclass(frozen=True)
class GivenNoise:
    """A noise model, and the file it was read from, if any."""

    model: NoiseModel
    file: Path | None = None


@dataclass(frozen=True)
class Request:
    """The options of a run; times in s from the recording's start."""

    source: str
    solvers: tuple[str, ...]
    settings: Settings = field(default_factory=Settings)
    withheld: tuple[Withheld, ...] = ()
    start: float | None = None
    end: float | None = None
    rate: float | None = None  # Hz of the output; None: at the keyframes
    options: Mapping[str, Any] = field(default_factory=dict)  # as given, for provenance
    noise: GivenNoise | None = None  # used as it is; otherwise the settings decide
    against: tuple[Against, ...] = ()  # trajectories of other programs to compare with
    topics: tuple[str, ...] = ()  # of a ROS bag, for `graphnav.recording.formats.read`
    format: str | None = None  # of a log, likewise
    allow_outside: bool = False  # likewise
    exported: tuple[str, ...] = ()  # additional output formats, for `point`
    point: str | None = None  # "antenna", "imu" or a lever arm
    judge_arms: bool = False  # check the signs of lever arms even if nothing is in doubt
    loose: bool = False  # also solve with fixes in place of raw observations
    folder: Path | None = None  # where results are to be written, with which names: no file that is read is one
    results: tuple[str, ...] = ()

    @property
    def part(self) -> AskedPart:
        """What is to be read."""
        return AskedPart(self.source, self.start, self.end, self.topics, self.format, self.allow_outside)

    def select_settings(self, name: str) -> Settings:
        """The settings of the solution of that name."""
        return couple_loosely(self.settings) if name.endswith(LOOSE) else self.settings


@dataclass(frozen=True)
class Outcome:
    """The result of a request.

    `recording` is the requested part with nothing withheld; `zero` (s) is the offset of its start from the start of the
    whole recording, from which all times for users are counted.
    """

    request: Request
    recording: Recording
    zero: float
    solutions: dict[str, Solution]
    metrics: dict[str, Metrics]  # empty where there is no truth
    against: str | None  # description of the truth of the metrics
    span_names: tuple[str, ...]  # what is missing in each of the spans of every metrics
    findings: tuple[str, ...]  # all notes on the recording and the comparison
    warnings: tuple[str, ...]  # those that make results worse
    timings: dict[str, float]  # s by stage, common to all solvers
    checks: tuple[Finding, ...] = ()  # findings of the checks of the recording, with keys and severities
    densities: ImuNoise | None = None  # the IMU densities that noise factors refer to, if not the stated ones
    alone: bool = False  # whether the files are written straight into the folder, as for a single solver

    @property
    def defects(self) -> tuple[str, ...]:
        """Findings that make the results wrong, whatever their sigmas."""
        return tuple(Note(f.key, f.sentence) for f in self.checks if f.severity == "unreliable")

    @property
    def used_withheld(self) -> tuple[Withheld, ...]:
        """The withheld spans, in s from the start of `recording`."""
        return shift_spans(self.request.withheld, self.zero)


def name_runs(solvers: tuple[str, ...], loose: bool) -> tuple[str, ...]:
    """The names of the solutions of some solvers."""
    return tuple(name for solver in solvers for name in ((solver, solver + LOOSE) if loose else (solver,)))


def couple_loosely(settings: Settings) -> Settings:
    """The settings with fixes in place of raw observations."""
    return settings.model_copy(update={"raw_gnss": settings.raw_gnss.model_copy(update={"coupling": "loose"})})


def parse_noise(text: str | None, settings: Settings) -> tuple[Settings, GivenNoise | None]:
    """Parse `--noise`: the settings with its mode, and the noise model of a file.

    Raises
    ------
    ConfigError
        If it is neither "stated" nor "estimated" nor a file that holds a noise model.
    """
    from graphnav.estimation.noise.files import MODES, read_noise_and_mode

    if text is None:
        return settings, None
    given = None
    mode = text
    if text not in MODES:
        if not Path(text).is_file():
            raise ConfigError(
                f"--noise {text}: no such file; write {', '.join(MODES)} or name the summary.json of a run",
                key="file.missing",
            )
        model, mode = read_noise_and_mode(text)
        given = GivenNoise(model, Path(text))
    return settings.model_copy(update={"noise": settings.noise.model_copy(update={"mode": mode})}), given


def run_request(
    request: Request, progress: Progress | None = None, reading: Beside[ReadPart] | Later[ReadPart] | None = None
) -> Outcome:
    """Read, check, withhold, solve and score; `reading` is of the request's part, where it was begun before.

    Raises
    ------
    GraphnavError
        In one plain sentence, for anything that cannot be used as it is.
    """
    with send_progress(progress):
        return _solve_request(request, progress, reading)


def _solve_request(
    request: Request, progress: Progress | None, reading: Beside[ReadPart] | Later[ReadPart] | None
) -> Outcome:
    from graphnav.recording.checks.stated import is_truth_apart

    tell("reading")
    reading = reading or begin_reading(request.part)
    load_solvers(request.solvers)  # which takes as long
    found = reading.get_result()
    zero, timings = found.zero, found.timings
    _check_results(request, found.recording)
    checks = Checks(found.recording, found.rows)
    recording, moved = found.rows[0], shift_spans(request.withheld, zero)
    used, notes = withhold(recording, moved, zero)
    if is_truth_apart(recording):
        recording = replace(recording, truth=None)

    from graphnav.report.doubts import list_doubts

    solutions = _run_solvers(request, used, checks, progress)
    known = checks.get_findings()
    timings["checks"] += checks.seconds
    if request.noise is not None:
        notes += list_unused_noise(request.noise.model, next(iter(solutions.values())))
    solutions = {
        name: replace(s, timings={**timings, **s.timings}, notes=(*notes, *s.notes)) for name, s in solutions.items()
    }
    findings = [f.sentence for f in known]
    known = _mitigate(known, solutions)
    look = partial(_find_wrong_arms, used, known, dict(solutions))
    looking = begin_beside(look) if request.judge_arms else Later(look)  # which takes a second
    solutions |= _read_others(request, recording, solutions)
    with measure_time(timings, "evaluation"):
        metrics, against, names, remarks = _compare(recording, used, solutions, moved)
    in_parts = any(len(one.between) > 1 for one in select_own(solutions).values())
    if in_parts:
        return_memory()
    findings += remarks
    errors = {name: one.errors for name, one in metrics.items() if one.errors is not None}
    if request.judge_arms or list_doubts(solutions, errors):
        known = (*looking.get_result(), *known)
        findings = [*(f.sentence for f in known), *findings]
    densities = _find_densities(used, request.settings, solutions)
    if in_parts:
        return_memory()
    return Outcome(
        request, recording, zero, solutions, metrics, against, names, tuple(dict.fromkeys(findings)),
        tuple(f.sentence for f in known if f.severity != "note"), timings, known, densities,
    )  # fmt: skip


def _check_results(request: Request, recording: Recording) -> None:
    """Refuse results that would replace what is read, and those that the recording does not have."""
    if request.folder is not None:
        targets = (request.folder / name for name in request.results)
        keep_inputs(request.folder, targets, (*recording.files, *(one.path for one in request.against)))
    check_names(request.exported, recording.gps_zero)
    if request.point == "antenna" and recording.gnss is None:
        raise ConfigError("--point antenna: the recording has no GNSS", key="option.point")


def _run_solvers(request: Request, used: Recording, checks: Checks, progress: Progress | None) -> dict[str, Solution]:
    """The solutions by name, once more from fixes if asked for.

    Raises
    ------
    RecordingError
        If the checks find that the recording cannot be solved, which comes before what goes wrong because of it.
    """
    from graphnav.estimation.pipeline import run

    model = None if request.noise is None else request.noise.model
    if request.loose and not used.is_tight(request.settings.raw_gnss.coupling):
        raise ConfigError(
            f"--loose: '{used.name}' has no raw observations that are used in place of fixes", key="option.not_here"
        )
    try:
        solutions = run(used, request.settings, request.solvers, checks.await_before(_SOLVING, progress), model)
    except Exception as error:
        known = checks.get_findings()
        if isinstance(error, EstimationError):
            raise _name_cause(error, known) from None
        raise
    checks.get_findings()
    if not request.loose:
        return solutions
    others = run(used, couple_loosely(request.settings), request.solvers, progress, model)
    solutions |= {name + LOOSE: replace(one, solver=name + LOOSE) for name, one in others.items()}
    return {name: solutions[name] for name in name_runs(request.solvers, True)}


def _compare(
    recording: Recording, used: Recording, solutions: Mapping[str, Solution], moved: tuple[Withheld, ...]
) -> tuple[dict[str, Metrics], str | None, tuple[str, ...], list[str]]:
    """The metrics of solutions, what they are against, what is missing in each of their spans, and remarks on them."""
    try:
        metrics, against, names = score(recording, used, solutions, moved)
    except RecordingError as error:
        if error.key != "truth.too_little":
            raise
        return {}, None, (), [Note(error.key, f"not compared with the truth: {error}")]
    remarks: list[str] = []
    for name, compared in metrics.items():
        for note in compared.notes:
            shared = all(note in other.notes for other in metrics.values())
            remarks.append(note if shared else Note(get_key(note), f"{name}: {note}"))
    return metrics, against, names, remarks


def _find_wrong_arms(
    used: Recording, known: tuple[Finding, ...], solutions: Mapping[str, Solution]
) -> tuple[Finding, ...]:
    """Lever arms that the drive contradicts, other than those that are not used as stated."""
    from graphnav.estimation.antenna import find_wrong_arms

    arms = find_wrong_arms(used, known, list(solutions.values())[-1].graphs)
    freed = any(LEVER_ARM in one.noise.freed for one in solutions.values())
    return tuple(f for f in arms if not (freed and f.key.startswith("gnss.")))


def _mitigate(findings: tuple[Finding, ...], solutions: Mapping[str, Solution]) -> tuple[Finding, ...]:
    """Findings; clocks that disagree make no result unreliable where the stamps were moved to what they disagree by."""
    if all(one.noise.stamps == StampOffsets() for one in select_own(solutions).values()):
        return findings
    return tuple(replace(f, severity="warning") if f.key == "imu.clock" else f for f in findings)


def _name_cause(error: EstimationError, findings: Sequence[Finding]) -> EstimationError:
    """The error with the gravest finding of the checks, as its likely cause."""
    grave = [f.sentence for f in findings if f.severity != "note"]
    return EstimationError(f"{error}; the likely cause: {grave[0]}", key=error.key) if grave else error


def _find_densities(recording: Recording, settings: Settings, solutions: Mapping[str, Solution]) -> ImuNoise | None:
    """Noise densities measured at rest, to which a walk's factors refer; None where they refer to the stated ones."""
    if recording.platform != "foot":
        return None
    if not any(group.startswith("imu.") for solution in solutions.values() for group in solution.noise.figures):
        return None
    from graphnav.estimation.noise.imu_floor import apply_measured_floor
    from graphnav.imu.repairs import repair_imu

    return apply_measured_floor(repair_imu(recording, settings)[0], settings)[0].imu.noise


def _read_others(request: Request, recording: Recording, solutions: Mapping[str, Solution]) -> dict[str, Solution]:
    """The trajectories of other programs, by the names of their files."""
    reference = list(solutions.values())[-1]
    out: dict[str, Solution] = {}
    for asked in request.against:
        taken = {*solutions, *out}
        name = next(n for n in (asked.path.stem, asked.path.name, str(asked.path)) if n not in taken)
        out[name] = read_against(asked, name, recording, reference)
    return out


def list_unused_noise(noise: NoiseModel, solution: Solution) -> list[str]:
    """Notes on the parts of a noise model that concern measurements which a solution does not have."""
    have = dict.fromkeys(INTERVALS, solution.t) | {name: record.t for name, record in solution.records.items()}
    named = {group.split(".")[0] for group in noise.figures} - {"imu"} | set(noise.weights) | set(noise.excluded)
    notes = Notes()
    for name in sorted(named - set(have)):
        figures = f"figures of {name_rows(name)}, which are not used for this recording"
        notes.add("noise.file.unused", f"noise model: {figures}")
    for name, some in noise.weights.items():
        if name in have and len(some.t):
            t = have[name]
            lost = int(np.sum(np.abs(t[pick_nearest(t, some.t)] - some.t) > SAME_TIME))
            if lost:
                notes.add(
                    "noise.file.rows",
                    f"noise model: {format_count(lost, 'weight')} of {len(some.t)} for {name_rows(name)} "
                    "without a row in this recording",
                )
    for name, spans in noise.excluded.items():
        lost = sum(not np.any((have[name] >= a) & (have[name] <= b)) for a, b in spans) if name in have else 0
        if lost:
            notes.add(
                "noise.file.spans",
                f"noise model: {format_count(lost, 'excluded span')} of {len(spans)} of {name_rows(name)} "
                "without a row in this recording",
            )
    return notes
