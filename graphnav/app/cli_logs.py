"""Commands that make or describe recordings: `convert`, `init`, `allan`, `simulate`. `cli` has the others."""

from __future__ import annotations

from pathlib import Path
from tomllib import loads
from typing import Annotated

import typer

from graphnav.app.cli_options import AllowOutside, Export, FormatOption, Json, Point, Quiet, Topic
from graphnav.app.talk import NOT_MET, fail, print_out, say, show_progress
from graphnav.core.errors import ConfigError, RecordingError
from graphnav.core.progress import tell

commands = typer.Typer()
Force = Annotated[bool, typer.Option("--force", help="Overwrite files that are there.")]


@commands.command(
    epilog="\b\nExamples:\n  graphnav convert dataset/kf-gins.yaml -o drive\n"
    "  graphnav convert out/trajectory.csv -o track.gpx --point antenna"
)
def convert(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="A known log, or a trajectory file.")],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="OUT", help="Folder to write; of a trajectory also a file.")
    ],
    format: FormatOption = None,
    export: Export = None,
    point: Point = None,
    rate: Annotated[
        float | None, typer.Option("--rate", metavar="HZ", help="Of a trajectory: interpolate to this rate.")
    ] = None,
    clock: Annotated[
        str | None,
        typer.Option(
            "--clock",
            metavar="TEXT",
            help="Of a trajectory: what t counts from: unix, 'gps week 2313', or the UTC date of t = 0.",
        ),
    ] = None,
    topic: Topic = None,
    force: Force = False,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Convert a log to a recording, or a trajectory to another format."""
    from graphnav.app import convert as conversion
    from graphnav.app.outputs import check_output_folder
    from graphnav.core.staging import resolve_final_path, stage_results

    if export is not None and format is not None:
        raise ConfigError(
            f"--format {format}: is for logs; the format of a trajectory is recognised from its content",
            key="option.not_here",
        )
    if export is not None or conversion.is_export(Path(source), out):
        conversion.check_rate(rate)
        alone = bool(out.suffix) and not out.is_dir()
        folder = check_output_folder(out.parent if alone else out)
        with show_progress(quiet, "convert"), stage_results(folder, [source]) as part:
            target = part / out.name if alone else part
            files, notes = conversion.export_file(source, target, export, point, rate, clock)
        files = resolve_final_path(files, part, folder)
        print_out(
            lambda: "\n".join([*(f"note: {note}" for note in notes), *(f"wrote {file}" for file in files)]),
            lambda: {"notes": notes, "files": files},
            quiet,
            json,
        )
        return
    for option, value in (("--point", point), ("--rate", rate), ("--clock", clock)):
        if value is not None:
            raise ConfigError(f"{option}: is for trajectories; a log keeps its own", key="option.not_here")
    folder = check_output_folder(out)
    with show_progress(quiet, "convert"):
        tell("reading")
        log, files = conversion.convert_log(source, folder, format, topic or (), force, allow_outside)
    print_out(
        lambda: conversion.log_text(log, files),
        lambda: {**conversion.log_values(log), "files": files},
        quiet,
        json,
    )


@commands.command(epilog="\b\nExample:\n  graphnav allan rest.csv -o out/allan")
def allan(
    log: Annotated[str, typer.Argument(metavar="LOG", help="A log at rest: CSV, a recording or a known log.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT", help="Folder to write into.")],
    start: Annotated[
        float | None, typer.Option("--start", metavar="S", help="Use the log from here on, s from its start.")
    ] = None,
    end: Annotated[
        float | None, typer.Option("--end", metavar="S", help="Use the log up to here, s from its start.")
    ] = None,
    format: FormatOption = None,
    topic: Topic = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Measure an IMU's noise figures from a log at rest.

    They are printed as lines for recording.toml; a page shows the Allan deviations.
    """
    from graphnav.app.outputs import check_output_folder
    from graphnav.core.errors import RecordingError
    from graphnav.core.staging import resolve_final_path, stage_results
    from graphnav.recording.allan import compute_allan
    from graphnav.recording.draft import read_imu_in_si
    from graphnav.recording.formats import load
    from graphnav.report import allan as pages

    folder = check_output_folder(out)
    with show_progress(quiet, "allan"):
        tell("reading")
        if format is None and log.endswith((".csv", ".csv.gz")):
            t, gyro, accel, units = read_imu_in_si(Path(log))
        else:
            imu = load(log, format, topic or (), allow_outside).imu
            if imu is None:
                raise RecordingError(f"{log}: holds no IMU", key="log.no_imu")
            t, gyro, accel, units = imu.t, imu.gyro, imu.accel, []
        since = t - t[0]
        part_asked = (since >= (start or 0.0)) & (since <= (since[-1] if end is None else end))
        if part_asked.sum() < 2:
            raise ConfigError(
                f"--start, --end: nothing of {log} lies between them; it runs to {since[-1]:.1f} s",
                key="log.span_empty",
            )
        tell("variances")
        try:
            result = compute_allan(t[part_asked], gyro[part_asked], accel[part_asked])
        except RecordingError as error:
            taken = f" ({'; '.join(units)})" if units and error.key == "allan.moves" else ""
            raise RecordingError(f"{log}: {error}{taken}", key=error.key) from None
        tell("writing")
        with stage_results(folder, [log]) as part:
            written = pages.write_allan(result, part)
    written = resolve_final_path(written, part, folder)
    lines = [
        f"{result.duration:.0f} s at rest, {result.rate:.4g} Hz",
        *(f"  {one}" for one in units),
        "",
        "[imu.noise]",
        *result.format_lines(),
        "",
    ]
    print_out(
        lambda: "\n".join([*lines, *(f"wrote {path}" for path in written)]),
        lambda: {
            "duration_s": result.duration,
            "rate_hz": result.rate,
            "units": units,
            "noise": loads("\n".join(result.format_lines())),
            "files": written,
        },
        quiet,
        json,
    )


@commands.command(epilog="\b\nExample:\n  graphnav init imu.csv ride.nmea -o recording.toml")
def init(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", help="CSV files, known logs, or a folder of them.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="The .toml to write, or its folder.")] = Path(
        "recording.toml"
    ),
    name: Annotated[
        str | None,
        typer.Option("--name", metavar="NAME", help="Name of the recording; default: that of FILE or of its folder."),
    ] = None,
    force: Force = False,
    topic: Topic = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Draft a recording.toml from logs, with the reason for each line.

    Columns, units, axes and clocks are told from the data; lines to look at are marked CHECK.
    """
    from graphnav.app.outputs import check_output_folder
    from graphnav.core.staging import stage_results
    from graphnav.recording.checks.overview import inspect
    from graphnav.recording.draft import draft
    from graphnav.recording.formats import read
    from graphnav.recording.formats.writer import write_csv

    out = out / "recording.toml" if out.is_dir() or not out.suffix else out
    if out.suffix != ".toml":
        raise ConfigError(f"-o {out}: name a .toml file, or a folder for recording.toml", key="output.name")
    if out.exists() and not force:
        raise ConfigError(f"-o {out}: is there already; name another file, or use --force", key="output.exists")
    folder = check_output_folder(out.parent)
    name = name or (out.stem if out.stem != "recording" else None)
    with show_progress(quiet, "init"):
        tell("reading")
        drafted = draft(logs, folder, name, topic or ())
        for made in drafted.made:
            if (folder / made).exists() and not force:
                raise ConfigError(
                    f"{folder / made}: is there already; use --force to write over it", key="output.exists"
                )
        with stage_results(folder) as part:
            for made, columns in drafted.made.items():
                write_csv(part / made, list(columns), list(columns.values()))
            (part / out.name).write_text(drafted.text, encoding="utf-8")
        tell("checking")
        open_question = None
        try:  # the logs are where the user says
            inspect(read(out, allow_outside=True)).refuse()
        except RecordingError as error:
            open_question = error
    files = [out, *(folder / made for made in drafted.made)]
    print_out(
        lambda: "\n".join(
            [*(f"  {line}" for line in drafted.decisions), f"wrote {out}; look at the lines marked CHECK"]
        ),
        lambda: {
            "decisions": drafted.decisions,
            "files": files,
            "refused": open_question and {"key": open_question.key, "sentence": str(open_question)},
        },
        quiet,
        json,
    )
    if open_question is not None:
        fail(f"{out} is written, but as it stands refused: {open_question}", NOT_MET, debug=False)
        raise typer.Exit(NOT_MET)


@commands.command(epilog="\b\nExample:\n  graphnav simulate urban -o out/urban --seed 1")
def simulate(
    scenario: Annotated[
        str | None, typer.Argument(metavar="SCENARIO", help="Name of the scenario; without one all are listed.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="Folder for the recording; made if it is not there."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="The same seed gives the same recording.")] = 0,
    option: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Set an option of the scenario (see --list); may be repeated."),
    ] = None,
    listing: Annotated[bool, typer.Option("--list", help="List the scenarios and their options.")] = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Simulate a drive or a walk: a recording with its truth."""
    from graphnav.app import outputs
    from graphnav.core.staging import resolve_final_path, stage_results
    from graphnav.simulation import describe_scenarios, parse_options
    from graphnav.simulation import simulate as simulated

    if listing or scenario is None:
        say(describe_scenarios())
        return
    if out is None:
        raise ConfigError("name the folder to write to: -o DIR", key="option.missing")
    folder = outputs.check_output_folder(out)
    options = parse_options(scenario, option or [])
    with show_progress(quiet, "simulate"):
        made = simulated(scenario, seed, **options)
        with stage_results(folder) as part:
            files = made.write(part)
    files = resolve_final_path(files, part, folder)
    print_out(
        lambda: "\n".join([made.format(), *(f"  {file}" for file in files)]),
        lambda: {"scenario": scenario, "seed": seed, "options": options, "stops": made.stops, "files": files},
        quiet,
        json,
    )
