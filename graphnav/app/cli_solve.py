"""Commands that solve, or draw a stored solution: `smooth`, `compare`, `report`. `graphnav.app.cli` has the others."""

from __future__ import annotations

from dataclasses import dataclass
from json import loads
from pathlib import Path
from typing import Annotated, Any

import typer

from graphnav.app.cli_options import (
    SEVERAL,
    AllowOutside,
    Config,
    End,
    Export,
    Fire,
    FormatOption,
    Json,
    NoiseOption,
    Out,
    Pages,
    Point,
    ProfileOption,
    Quiet,
    Rate,
    Require,
    SourceArgument,
    Start,
    Topic,
    Without,
    choose_detectors,
    choose_solver,
    choose_solvers,
    collect_withheld,
    pick_one,
)
from graphnav.app.talk import insist, print_out, show_progress
from graphnav.core.errors import ConfigError
from graphnav.core.memory import pause_collector
from graphnav.core.progress import tell

commands = typer.Typer()


@commands.command(context_settings=SEVERAL, epilog="\b\nExample:\n  graphnav smooth kitti -o out/kitti")
def smooth(
    context: typer.Context,
    recording: SourceArgument,
    out: Out,
    solver: Annotated[
        str, typer.Option("--solver", "--solvers", metavar="NAME", help="One of batch, incremental, isam2, rts, ekf.")
    ] = "batch",
    profile: ProfileOption = None,
    config: Config = None,
    noise: NoiseOption = None,
    detectors: Fire = None,
    without: Without = None,
    rate: Rate = None,
    start: Start = None,
    end: End = None,
    export: Export = None,
    point: Point = None,
    pages: Pages = True,
    require: Require = None,
    format: FormatOption = None,
    topic: Topic = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Estimate the trajectory of a recording with one solver.

    Position, velocity and attitude are written with their sigmas, and a report.
    """
    asked = _Options(
        pick_one(context, recording), out, profile, config, noise, detectors, without, rate, start, end, require,
        format, topic, allow_outside, quiet, json, pages,
    )  # fmt: skip
    _solve_and_write(asked, choose_solver(context, solver), True, export, point)


@commands.command(
    context_settings=SEVERAL, epilog="\b\nExample:\n  graphnav compare kitti --without gnss:400-460 -o out/kitti"
)
def compare(
    context: typer.Context,
    recording: SourceArgument,
    out: Out,
    solvers: Annotated[
        str,
        typer.Option(
            "--solvers",
            "--solver",
            metavar="NAMES",
            help="Some of ekf, rts, incremental, isam2, batch, with commas.",
        ),
    ] = "ekf,rts,batch",
    profile: ProfileOption = None,
    config: Config = None,
    noise: NoiseOption = None,
    detectors: Fire = None,
    without: Without = None,
    rate: Rate = None,
    start: Start = None,
    end: End = None,
    against: Annotated[
        list[Path] | None,
        typer.Option(
            "--against",
            metavar="FILE",
            help="Trajectory of another program to compare with: .nav, .pos, TUM or CSV; may be repeated.",
        ),
    ] = None,
    against_point: Annotated[
        list[str] | None,
        typer.Option(
            "--against-point",
            metavar="POINT",
            help="Point that a file of --against is of: imu (default), antenna or x,y,z; once for each.",
        ),
    ] = None,
    against_shift: Annotated[
        list[float] | None,
        typer.Option(
            "--against-shift",
            metavar="S",
            help="Seconds to add to the stamps of a file of --against; default: the difference of the clocks, if any, "
            "and a second or more where the speeds then agree; once for each.",
        ),
    ] = None,
    loose: Annotated[
        bool, typer.Option("--loose", help="Raw GNSS: also solve with its single-point fixes, as ekf-loose and so on.")
    ] = False,
    export: Export = None,
    point: Point = None,
    pages: Pages = True,
    require: Require = None,
    format: FormatOption = None,
    topic: Topic = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Solve a recording with several solvers and compare them.

    Errors are against the truth, or against the fixes that --without withholds.
    """
    asked = _Options(
        pick_one(context, recording), out, profile, config, noise, detectors, without, rate, start, end, require,
        format, topic, allow_outside, quiet, json, pages,
    )  # fmt: skip
    beside = _Beside(against or [], against_point or [], against_shift or [])
    for option, values in (("--against-point", beside.points), ("--against-shift", beside.shifts)):
        if values and len(values) != len(beside.files):
            raise ConfigError(
                f"{option} {values[-1]}: give one for each of the {len(beside.files)} files of --against",
                key="option.count",
            )
    _solve_and_write(asked, choose_solvers(context, solvers), False, export, point, beside, loose)


@commands.command(epilog="\b\nExample:\n  graphnav report out/kitti")
def report(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder that smooth or compare wrote.")],
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Draw the reports of a run again, without solving.

    After an update of graphnav, or after --no-report.
    """
    from graphnav.app import outputs
    from graphnav.core.staging import resolve_final_path, stage_results

    if not out.is_dir():
        what = "is a file" if out.exists() else "no such folder"
        raise ConfigError(f"{out}: {what}; name the folder that smooth or compare wrote", key="file.missing")
    if (out / "drives").is_dir():
        raise ConfigError(f"{out}: the results of a fleet; name a folder in {out / 'drives'}", key="results.none")
    with show_progress(quiet, "detect"):
        tell("reading")
        with stage_results(out) as part:
            files = outputs.draw_again(out, part)
    files = resolve_final_path(files, part, out)
    print_out(lambda: "\n".join(["look at", *(f"  {file}" for file in files)]), lambda: {"files": files}, quiet, json)


@dataclass(frozen=True)
class _Options:
    """The options that smooth and compare share."""

    recording: str
    out: Path
    profile: str | None
    config: Path | None
    noise: str | None
    detectors: str | None
    without: list[str] | None
    rate: float | None
    start: float | None
    end: float | None
    require: list[str] | None
    format: str | None
    topic: list[str] | None
    allow_outside: bool
    quiet: bool
    json: bool
    pages: bool


@dataclass(frozen=True)
class _Beside:
    """Other programs' trajectories to compare with: files, their point on the body, and s to add to their stamps."""

    files: list[Path]
    points: list[str]
    shifts: list[float]


def _solve_and_write(
    asked: _Options,
    chosen: tuple[str, ...],
    alone: bool,
    export: str | None = None,
    point: str | None = None,
    beside: _Beside | None = None,
    loose: bool = False,
) -> None:
    with pause_collector():
        from graphnav.app.reading import AskedPart, begin_reading
        from graphnav.core.beside import allow_second_process
        from graphnav.core.memory import keep_memory

    keep_memory()
    part = AskedPart(
        asked.recording, asked.start, asked.end, tuple(asked.topic or ()), asked.format, asked.allow_outside
    )
    with allow_second_process():
        reading = begin_reading(part)  # which takes as long as all that is loaded and asked from here on
    with pause_collector():
        from graphnav.app import convert, outputs, terminal, workflow
        from graphnav.app.summary import tabulate_comparison
        from graphnav.config import read_settings
        from graphnav.core.complaints import split_names
        from graphnav.core.staging import resolve_final_path, stage_results
        from graphnav.evaluation import gates
        from graphnav.recording.exporters import FORMATS

    withheld = collect_withheld(asked.without, asked.start, asked.end)
    convert.check_rate(asked.rate)
    names = workflow.name_runs(chosen, loose)
    requirements = [gates.parse_requirement(one, names) for one in asked.require or ()]
    given: dict[str, Any] = {
        "recording": asked.recording, "solver" if alone else "solvers": ",".join(chosen), "profile": asked.profile,
        "config": asked.config and str(asked.config), "noise": asked.noise, "detectors": asked.detectors,
        "without": asked.without, "rate": asked.rate, "start": asked.start, "end": asked.end, "format": asked.format,
        "topic": asked.topic,
        "against": (beside and [str(file) for file in beside.files]) or None, "loose": loose or None,
    }  # fmt: skip
    folder = outputs.check_output_folder(asked.out, outputs.FILES, () if alone else names)
    if point is not None and export is None:
        raise ConfigError(f"--point {point}: is of the files of --export; name some", key="option.not_here")
    exported = split_names(export, FORMATS, "--export", "format to write") if export is not None else ()
    convert.parse_point(point)
    against = []
    for k, file in enumerate(beside.files if beside is not None else ()):
        assert beside is not None
        if not file.is_file():
            what = "is a folder" if file.is_dir() else "no such file"
            raise ConfigError(f"--against {file}: {what}; name a trajectory file", key="file.missing")
        of = convert.parse_point(beside.points[k] if beside.points else None, "--against-point")
        against.append(workflow.Against(file, of, beside.shifts[k] if beside.shifts else None))
    settings = choose_detectors(read_settings(asked.config, asked.profile), asked.detectors)
    settings, noise = workflow.parse_noise(asked.noise, settings)
    request = workflow.Request(
        asked.recording, chosen, settings, withheld, asked.start, asked.end, asked.rate,
        {k: v for k, v in given.items() if v is not None}, noise, exported=exported, point=point,
        topics=tuple(asked.topic or ()), format=asked.format, allow_outside=asked.allow_outside, against=tuple(against),
        judge_arms=not alone, loose=loose, folder=folder, results=outputs.list_results(() if alone else names),
    )  # fmt: skip
    with show_progress(asked.quiet, *chosen) as progress, allow_second_process():
        outcome = workflow.run_request(request, progress, reading)
        tell("writing")
        inputs = (*outcome.recording.files, *(one.path for one in against))
        with stage_results(folder, inputs) as staged:
            files = (outputs.write_run if alone else outputs.write_comparison_files)(outcome, staged, asked.pages)
        files = resolve_final_path(files, staged, folder)
        if not asked.pages:
            outputs.remove_pages(folder, () if alone else names)
        if exported:  # separately, so that a failing file does not prevent the others
            with stage_results(folder, inputs) as staged:
                more = convert.export_run(outcome, staged, exported, point, alone)
            files += resolve_final_path(more, staged, folder)
    verdicts = gates.judge_all(requirements, tabulate_comparison(outcome, ours=True)) if requirements else []

    def make_json() -> dict[str, Any]:
        places = {name: folder if alone else folder / name for name in names}
        each = {name: loads((at / "summary.json").read_text(encoding="utf-8")) for name, at in places.items()}
        found = each[names[0]] if alone else {"recording": outcome.recording.name, "solvers": each}
        return {**found, "requirements": gates.list_verdicts(verdicts), "files": files}

    print_out(
        lambda: terminal.run_text(outcome, files) + gates.format_verdicts(verdicts), make_json, asked.quiet, asked.json,
        lambda: terminal.describe_doubts(outcome),
    )  # fmt: skip
    insist(verdicts)
