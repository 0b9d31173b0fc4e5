"""The command `fleet`: many recordings at once. `graphnav.app.cli` has the other commands."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graphnav.app.cli_options import (
    AllowOutside,
    Config,
    End,
    Json,
    NoiseOption,
    Out,
    Pages,
    ProfileOption,
    Quiet,
    Rate,
    Start,
    Without,
    choose_solver,
)
from graphnav.app.talk import NOT_MET, Interrupted, print_out, say, warn
from graphnav.core.errors import ConfigError
from graphnav.core.notes import format_count

if TYPE_CHECKING:
    from graphnav.app.fleet.drive import FleetRow
    from graphnav.app.fleet.manifest import Task
    from graphnav.app.fleet.workers import Limits

commands = typer.Typer()


@commands.command(epilog="\b\nExample:\n  graphnav fleet drives -o out --solver rts --withhold 60")
def fleet(
    context: typer.Context,
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A folder of recordings, or a manifest .csv or .toml.")
    ],
    out: Out,
    solver: Annotated[
        str, typer.Option("--solver", "--solvers", metavar="NAME", help="One of batch, incremental, isam2, rts, ekf.")
    ] = "batch",
    profile: ProfileOption = None,
    config: Config = None,
    noise: NoiseOption = None,
    withhold: Annotated[
        float | None,
        typer.Option("--withhold", metavar="S", help="Withhold GNSS for S seconds, repeatedly, and score these spans."),
    ] = None,
    without: Without = None,
    rate: Rate = None,
    start: Start = None,
    end: End = None,
    processes: Annotated[
        int | None,
        typer.Option("--processes", metavar="N", min=1, help="Drives solved at once; default: one for each processor."),
    ] = None,
    limit: Annotated[
        float, typer.Option("--limit", metavar="S", min=1.0, help="Longest time for one drive, s; it is ended then.")
    ] = 3600.0,
    memory: Annotated[
        float | None,
        typer.Option(
            "--memory", metavar="MB", min=1.0, help="Most memory for one drive; default: its share of the machine's."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Address of a Dask cluster that sees the same files."),
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Solve all drives anew, also those that are done.")] = False,
    pages: Pages = True,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Solve many recordings and tabulate the results.

    Each is solved as smooth would. The same command goes on after an interruption. Leaves with 3 if some drives have no
    result, with 2 if none has.
    """
    from graphnav.app import convert, outputs
    from graphnav.app.fleet import manifest, tables, workers

    convert.check_rate(rate)
    if withhold is not None and not withhold > 0.0:
        raise ConfigError(f"--withhold {withhold:g}: must be a number of seconds above 0", key="option.value")
    asked = manifest.DriveOptions(
        choose_solver(context, solver)[0],
        profile,
        None if config is None else str(config),
        None,
        noise and _resolve_noise(noise),
        " ".join(without or ()) or None,
        start,
        end,
    )
    known: dict[Any, Any] = {}
    # so that errors of the command line are not reported for a line of the manifest
    manifest.resolve_options(asked, known)
    folder = outputs.check_output_folder(out, ("fleet.csv", "fleet.parquet", "fleet.html"), ("drives",)).resolve()
    drives = manifest.read_drives(source.resolve(), asked, allow_outside)
    tasks = [
        manifest.build_task(
            drive, folder, known, withhold=withhold, rate=rate, pages=pages, again=again, allow_outside=allow_outside
        )
        for drive in drives
    ]
    limits = workers.Limits(limit, memory)
    rows = _solve_all(tasks, processes, limits, scheduler, say_each=not (quiet or json))
    files = _write_results(rows, folder, source.name)
    lacking = "" if withhold is None else tables.describe_unscored(rows, withhold)
    lacking += "" if len(files) > 2 else "\nno fleet.parquet: pyarrow is not installed"
    print_out(
        lambda: "\n".join([tables.format_totals(rows) + lacking, "look at", *(f"  {file}" for file in files)]),
        lambda: {
            **tables.compute_totals(rows),
            "rows": [{k: v for k, v in r.items() if k != "track"} for r in rows],
            "files": files,
        },
        quiet,
        json,
        lambda: [f"{row['drive']}: {row.get('doubts') or _format_drive(row)}" for row in _select_wrong(rows)],
    )
    _insist_on_results(rows, source, folder)


def _solve_all(
    tasks: Sequence[Task], processes: int | None, limits: Limits, scheduler: str | None, say_each: bool
) -> list[FleetRow]:
    """A row for each drive, solved here or on a cluster; without its track beyond what the page draws.

    Raises
    ------
    Interrupted
        On Ctrl-C.
    """
    from graphnav.app.fleet import page, workers

    if scheduler is not None:
        found = workers.solve_on_cluster(tasks, scheduler, limits)
    else:
        count = processes or _count_processors()
        memory = limits.memory_mb or workers.share_of_memory(count)
        found = workers.solve_here(tasks, count, replace(limits, memory_mb=memory))
    done: dict[str, FleetRow] = {}
    try:
        for row in found:
            done[row["drive"]] = row if len(done) < page.DRAWN else {**row, "track": None}
            if say_each:
                say(f"[{len(done)}/{len(tasks)}] {row['drive']}: {_format_drive(row)}")
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted after {len(done)} of {len(tasks)} drives; the same command continues") from None
    return [done[task.name] for task in tasks]


def _write_results(rows: list[FleetRow], folder: Path, name: str) -> list[Path]:
    """The page and the tables of a fleet, and where they are; no Parquet without pyarrow."""
    from graphnav.app.fleet import page, tables
    from graphnav.core.staging import resolve_final_path, stage_results

    with stage_results(folder) as part:
        tables.write_fleet_csv(rows, part / "fleet.csv")
        files = [part / "fleet.csv"]
        if tables.write_parquet(rows, part / "fleet.parquet"):
            files.append(part / "fleet.parquet")
        page.write_page(rows, part / "fleet.html", f"{name}: {format_count(len(rows), 'drive')}")
        files.insert(0, part / "fleet.html")
    return resolve_final_path(files, part, folder)


def _insist_on_results(rows: list[FleetRow], source: Path, folder: Path) -> None:
    """Say how many drives have no result, and leave so."""
    from graphnav.app.fleet.drive import DONE

    lost = sum(row["status"] != DONE for row in rows)
    if lost == len(rows):
        raise ConfigError(
            f"{source}: none of {format_count(lost, 'drive')} could be solved; {folder / 'fleet.csv'} says why",
            key="fleet.none_solved",
        )
    if lost:
        warn(
            [f"{source}: {lost} of {format_count(len(rows), 'drive')} have no result; {folder / 'fleet.csv'} says why"]
        )
        raise typer.Exit(NOT_MET)


def _count_processors() -> int:
    """Number of processors that this process may use, where the system states it."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _resolve_noise(noise: str) -> str:
    return str(Path(noise).resolve()) if Path(noise).is_file() else noise


def _select_wrong(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The drives without a result, and those whose result cannot be trusted."""
    return [row for row in rows if row.get("verdict") != "sound"]


def _format_drive(row: dict[str, Any]) -> str:
    """One line about a drive."""
    if row["status"] != "done":
        return f"{row['status']}: {row.get('error')}"
    return f"{row.get('verdict')}, {row['time_s']:.1f} s" + (", done before" if row.get("skipped") else "")
