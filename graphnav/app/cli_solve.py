"""Commands that solve, or draw a stored solution: `smooth`, `compare`, `report`. `graphnav.app.cli` has the others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
    OtherTrajectories,
    Out,
    Pages,
    Point,
    ProfileOption,
    Quiet,
    Rate,
    Require,
    RunOptions,
    SourceArgument,
    Start,
    Topic,
    Without,
    choose_solver,
    choose_solvers,
    pick_one,
)
from graphnav.app.talk import print_out, show_progress
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
    asked = RunOptions(
        pick_one(context, recording), out, profile, config, noise, detectors, without, rate, start, end, require,
        format, topic, allow_outside, quiet, json, pages, export, point, choose_solver(context, solver), True,
    )  # fmt: skip
    _solve_and_write(asked)


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
    one = pick_one(context, recording)
    others = OtherTrajectories(against or [], against_point or [], against_shift or [])
    for option, values in (("--against-point", others.points), ("--against-shift", others.shifts)):
        if values and len(values) != len(others.files):
            raise ConfigError(
                f"{option} {values[-1]}: give one for each of the {len(others.files)} files of --against",
                key="option.count",
            )
    asked = RunOptions(
        one, out, profile, config, noise, detectors, without, rate, start, end, require,
        format, topic, allow_outside, quiet, json, pages, export, point, choose_solvers(context, solvers), False,
        others, loose,
    )  # fmt: skip
    _solve_and_write(asked)


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


def _solve_and_write(asked: RunOptions) -> None:
    with pause_collector():
        from graphnav.app.reading import begin_reading
        from graphnav.core.beside import allow_second_process
        from graphnav.core.memory import keep_memory

    keep_memory()
    with allow_second_process():
        reading = begin_reading(asked.part)  # which takes as long as all that is loaded and asked from here on
    with pause_collector():
        from graphnav.app.solving import solve_and_write

    solve_and_write(asked, reading)
