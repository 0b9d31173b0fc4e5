"""What smooth and compare do once a recording is being read: ask for the run, write its results, and say what it found.

`graphnav.app.cli_solve` imports this late, for reading goes on beside.
"""

from __future__ import annotations

from json import loads
from pathlib import Path
from typing import Any

from graphnav.app import convert, outputs, terminal, workflow
from graphnav.app.cli_options import OtherTrajectories, RunOptions, choose_detectors, collect_withheld
from graphnav.app.reading import ReadPart
from graphnav.app.scores import Withheld
from graphnav.app.summary import tabulate_comparison
from graphnav.app.talk import insist, print_out, show_progress
from graphnav.config import read_settings
from graphnav.core.beside import Beside, Later, allow_second_process
from graphnav.core.complaints import split_names
from graphnav.core.errors import ConfigError
from graphnav.core.progress import tell
from graphnav.core.staging import resolve_final_path, stage_results
from graphnav.evaluation import gates
from graphnav.recording.exporters import FORMATS


def solve_and_write(asked: RunOptions, reading: Beside[ReadPart] | Later[ReadPart]) -> None:
    """Solve as the options say, write the results and print what was found.

    Raises
    ------
    GraphnavError
        In one plain sentence, for anything that cannot be used as it is.
    """
    withheld = collect_withheld(asked.without, asked.start, asked.end)
    convert.check_rate(asked.rate)
    names = workflow.name_runs(asked.solvers, asked.loose)
    requirements = [gates.parse_requirement(one, names) for one in asked.require or ()]
    request = _make_request(asked, withheld, () if asked.alone else names)
    with show_progress(asked.quiet, *asked.solvers) as progress, allow_second_process():
        outcome = workflow.run_request(request, progress, reading)
        tell("writing")
        files = _write_results(asked, outcome)
    verdicts = gates.judge_all(requirements, tabulate_comparison(outcome, ours=True)) if requirements else []

    def make_json() -> dict[str, Any]:
        found = _read_summaries(asked, outcome, names)
        return {**found, "requirements": gates.list_verdicts(verdicts), "files": files}

    print_out(
        lambda: terminal.run_text(outcome, files) + gates.format_verdicts(verdicts), make_json, asked.quiet, asked.json,
        lambda: terminal.describe_doubts(outcome),
    )  # fmt: skip
    insist(verdicts)


def _make_request(asked: RunOptions, withheld: tuple[Withheld, ...], folders: tuple[str, ...]) -> workflow.Request:
    """The run that the options ask for; `folders` are those of its solutions in OUT, if they have their own.

    Raises
    ------
    ConfigError
        For an option that cannot be used.
    """
    folder = outputs.check_output_folder(asked.out, outputs.FILES, folders)
    if asked.point is not None and asked.export is None:
        raise ConfigError(f"--point {asked.point}: is of the files of --export; name some", key="option.not_here")
    exported = () if asked.export is None else split_names(asked.export, FORMATS, "--export", "format to write")
    convert.parse_point(asked.point)
    against = () if asked.others is None else _parse_others(asked.others)
    settings = choose_detectors(read_settings(asked.config, asked.profile), asked.detectors)
    settings, noise = workflow.parse_noise(asked.noise, settings)
    return workflow.Request(
        asked.recording, asked.solvers, settings, withheld, asked.start, asked.end, asked.rate, _list_given(asked),
        noise, exported=exported, point=asked.point, topics=tuple(asked.topic or ()), format=asked.format,
        allow_outside=asked.allow_outside, against=against, judge_arms=not asked.alone, loose=asked.loose,
        folder=folder, results=outputs.list_results(folders),
    )  # fmt: skip


def _list_given(asked: RunOptions) -> dict[str, Any]:
    """The options that were given, by name, for provenance."""
    given = {
        "recording": asked.recording, "solver" if asked.alone else "solvers": ",".join(asked.solvers),
        "profile": asked.profile, "config": asked.config and str(asked.config), "noise": asked.noise,
        "detectors": asked.detectors, "without": asked.without, "rate": asked.rate, "start": asked.start,
        "end": asked.end, "format": asked.format, "topic": asked.topic,
        "against": (asked.others and [str(file) for file in asked.others.files]) or None, "loose": asked.loose or None,
    }  # fmt: skip
    return {name: value for name, value in given.items() if value is not None}


def _parse_others(others: OtherTrajectories) -> tuple[workflow.Against, ...]:
    against = []
    for k, file in enumerate(others.files):
        if not file.is_file():
            what = "is a folder" if file.is_dir() else "no such file"
            raise ConfigError(f"--against {file}: {what}; name a trajectory file", key="file.missing")
        of = convert.parse_point(others.points[k] if others.points else None, "--against-point")
        against.append(workflow.Against(file, of, others.shifts[k] if others.shifts else None))
    return tuple(against)


def _write_results(asked: RunOptions, outcome: workflow.Outcome) -> list[Path]:
    """Write the files of a run into its folder, and those of --export; where they are."""
    request = outcome.request
    assert request.folder is not None
    folder, inputs = request.folder, (*outcome.recording.files, *(one.path for one in request.against))
    with stage_results(folder, inputs) as staged:
        files = (outputs.write_run if asked.alone else outputs.write_comparison_files)(outcome, staged, asked.pages)
    files = resolve_final_path(files, staged, folder)
    if not asked.pages:
        outputs.remove_pages(folder, () if asked.alone else workflow.name_runs(asked.solvers, asked.loose))
    if request.exported:  # separately, so that a failing file does not prevent the others
        with stage_results(folder, inputs) as staged:
            more = convert.export_run(outcome, staged, request.exported, request.point, asked.alone)
        files += resolve_final_path(more, staged, folder)
    return files


def _read_summaries(asked: RunOptions, outcome: workflow.Outcome, names: tuple[str, ...]) -> dict[str, Any]:
    """What summary.json of each solution holds."""
    folder = outcome.request.folder
    assert folder is not None
    places = [folder] if asked.alone else [folder / name for name in names]
    each = [loads((place / "summary.json").read_text(encoding="utf-8")) for place in places]
    return (
        each[0]
        if asked.alone
        else {"recording": outcome.recording.name, "solvers": dict(zip(names, each, strict=True))}
    )
