"""The program `graphnav`. Commands read their options here; `graphnav.workflow` and `graphnav.outputs` do the work.

Nothing heavy is imported before a command runs, so that help comes at once.
"""

from __future__ import annotations

import os
import sys
import traceback
from dataclasses import dataclass, replace
from json import loads
from pathlib import Path
from typing import Annotated, Any

import typer

from graphnav import __version__, cli_logs
from graphnav.cli_options import (
    AllowOutside,
    Config,
    End,
    Json,
    Noise,
    Out,
    Profile,
    Quiet,
    Rate,
    Require,
    Source,
    Start,
    Without,
)
from graphnav.errors import ConfigError, GraphnavError
from graphnav.files import outside_allowed
from graphnav.progress import tell
from graphnav.talk import BAD_INPUT, DEBUG, INTERNAL, INTERRUPTED, PIPE_CLOSED, bar, fail, insist, say, show

__all__ = ["DEBUG", "PIPE_CLOSED", "app", "main", "run"]

# Before NumPy is imported: see `graphnav.pipeline`, which limits threads for those who do not come this way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

app = typer.Typer(
    name="graphnav",
    add_completion=False,
    rich_markup_mode=None,
    help="Smooths recorded drives with a factor graph, beside the Kalman filter it replaces.",
    epilog="\b\nExample:\n  graphnav compare kitti --without gnss:400-460 -o out",
)


@app.callback(invoke_without_command=True)
def _program(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    if version:
        say(f"graphnav {__version__}")
        raise typer.Exit()
    if context.invoked_subcommand is None:
        say(context.get_help())
        raise typer.Exit(BAD_INPUT)


@app.command(epilog="\b\nExample:\n  graphnav info kitti")
def info(
    recording: Source,
    antenna: Annotated[
        bool, typer.Option("--antenna", help="Also find the antenna from the drive, and compare with its lever arm.")
    ] = False,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Check a recording and say what it holds: sensors, rates, gaps, distance, stops, and what is odd."""
    from graphnav.checks import inspect
    from graphnav.formats import read

    with bar(quiet, "ekf" if antenna else "info"):
        tell("reading")
        whole = read(recording, allow_outside)
        tell("checks")
        found = inspect(whole)
        if antenna:
            from graphnav.lever_arm import find_antenna

            found = replace(found, findings=(*found.findings, find_antenna(whole).finding))
    show(found.text, found.values, quiet, json)


@app.command(epilog="\b\nExample:\n  graphnav smooth kitti -o out/kitti")
def smooth(
    recording: Source,
    out: Out,
    solver: Annotated[
        str, typer.Option("--solver", metavar="NAME", help="batch, incremental, isam2, rts or ekf.")
    ] = "batch",
    profile: Profile = None,
    config: Config = None,
    noise: Noise = None,
    without: Without = None,
    rate: Rate = None,
    start: Start = None,
    end: End = None,
    export: Annotated[
        str | None, typer.Option("--export", metavar="NAMES", help="More formats: some of gpx,nav,nmea,csv,tum,kml.")
    ] = None,
    point: Annotated[
        str | None, typer.Option("--point", metavar="POINT", help="Of --export: imu, antenna or x,y,z (m; RFU).")
    ] = None,
    require: Require = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Estimate the trajectory of a recording, with its uncertainty, and write it with a report."""
    asked = _Asked(recording, out, profile, config, noise, without, rate, start, end, require, quiet, json)
    with outside_allowed(allow_outside):
        _solve(asked, solver, "--solver", export, point)


@app.command(epilog="\b\nExample:\n  graphnav compare kitti --without gnss:400-460 -o out/kitti")
def compare(
    recording: Source,
    out: Out,
    solvers: Annotated[
        str,
        typer.Option(
            "--solvers", metavar="NAMES", help="Some of ekf, rts, incremental, isam2, batch, with commas between."
        ),
    ] = "ekf,rts,batch",
    profile: Profile = None,
    config: Config = None,
    noise: Noise = None,
    without: Without = None,
    rate: Rate = None,
    start: Start = None,
    end: End = None,
    require: Require = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Put the same recording through several solvers and compare them, against the truth where there is one."""
    asked = _Asked(recording, out, profile, config, noise, without, rate, start, end, require, quiet, json)
    with outside_allowed(allow_outside):
        _solve(asked, solvers, "--solvers")


@app.command(epilog="\b\nExample:\n  graphnav detect kitti -o out/kitti")
def detect(
    recording: Source,
    out: Out,
    config: Config = None,
    without: Without = None,
    start: Start = None,
    end: End = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Find where the vehicle stands, and write the intervals, the statistics they come from and a picture."""
    from graphnav import detection_report, outputs, workflow
    from graphnav.config import read_settings
    from graphnav.detectors import detect as detected
    from graphnav.plausibility import screened
    from graphnav.staging import moved, staged

    withheld = _withheld(without, start, end)
    settings = read_settings(config)
    folder = outputs.output_folder(out)
    with bar(quiet, "detect"), outside_allowed(allow_outside):
        tell("reading")
        used, said = screened(workflow.read_part(recording, start, end, withheld))
        tell("detection")
        found = detected(used, settings)
        found = replace(found, notes=(*said, *found.notes))
        tell("writing")
        with staged(folder) as part:
            files = detection_report.write(used, found, part)
    files = moved(files, part, folder)
    show(
        lambda: detection_report.text(used, found, files),
        lambda: {**detection_report.values(used, found), "files": files},
        quiet,
        json,
    )


@app.command(epilog="\b\nExample:\n  graphnav evaluate out/kitti/trajectory.csv truth.csv --require 'h_rms<0.5'")
def evaluate(
    trajectory: Annotated[Path, typer.Argument(metavar="TRAJECTORY", help="CSV, TUM, KF-GINS .nav or RTKLIB .pos.")],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH", help="The same kinds, or a recording with a truth.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="OUT", help="Folder for evaluation.json and errors.csv.")
    ] = None,
    require: Require = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Compare any trajectory file with any truth file, ours or another program's."""
    from graphnav import gates, outputs
    from graphnav.evaluation import evaluate as compared
    from graphnav.metrics import comparison_rows, summary, text
    from graphnav.staging import staged

    requirements = [gates.parse_requirement(one) for one in require or ()]
    folder = None if out is None else outputs.output_folder(out)
    with bar(quiet, "evaluate"), outside_allowed(allow_outside):
        tell("reading")
        metrics = compared(trajectory, truth)
    values = {"trajectory": str(trajectory), "truth": str(truth), **summary(metrics)}
    verdicts = gates.judge(requirements, comparison_rows({trajectory.stem: metrics}))
    if verdicts:
        values["requirements"] = gates.values(verdicts)
    if folder is not None:
        with staged(folder) as part:
            outputs.write_evaluation(part, values, metrics)
    show(lambda: text(metrics) + gates.text(verdicts), lambda: values, quiet, json)
    insist(verdicts)


@app.command(epilog="\b\nExample:\n  graphnav settings --profile car > settings.toml")
def settings(
    profile: Profile = None,
    config: Config = None,
    json: Json = False,
) -> None:
    """Print all settings as a file for --config: the defaults, a profile's, or those that a file or a run comes to."""
    from graphnav.config import read_settings, settings_text

    found = read_settings(config, profile)
    show(lambda: settings_text(found), found.model_dump, False, json)


app.add_typer(cli_logs.commands)


@dataclass(frozen=True)
class _Asked:
    """The options that smooth and compare share."""

    recording: str
    out: Path
    profile: str | None
    config: Path | None
    noise: str | None
    without: list[str] | None
    rate: float | None
    start: float | None
    end: float | None
    require: list[str] | None
    quiet: bool
    json: bool


def _solve(asked: _Asked, solvers: str, option: str, export: str | None = None, point: str | None = None) -> None:
    from graphnav import convert, gates, outputs, pipeline, terminal, workflow
    from graphnav.complaints import listed
    from graphnav.config import read_settings
    from graphnav.exporters import NAMES
    from graphnav.staging import moved, staged

    withheld = _withheld(asked.without, asked.start, asked.end)
    convert.check_rate(asked.rate)
    chosen, alone = listed(solvers, pipeline.KNOWN, option, "solver"), option == "--solver"
    if alone and len(chosen) > 1:
        raise ConfigError(f"--solver {solvers}: smooth uses one; several are for graphnav compare")
    requirements = [gates.parse_requirement(one, chosen) for one in asked.require or ()]
    given: dict[str, Any] = {
        "recording": asked.recording, option.lstrip("-"): ",".join(chosen), "profile": asked.profile,
        "config": asked.config and str(asked.config), "noise": asked.noise, "without": asked.without,
        "rate": asked.rate, "start": asked.start, "end": asked.end,
    }  # fmt: skip
    if point is not None and export is None:
        raise ConfigError(f"--point {point}: is of the files of --export; name some")
    exported = listed(export, NAMES, "--export", "format to write") if export is not None else ()
    folder = outputs.output_folder(asked.out, outputs.FILES, () if alone else chosen)
    convert.parse_point(point)
    settings, noise = workflow.parse_noise(asked.noise, read_settings(asked.config, asked.profile))
    request = workflow.Request(
        asked.recording, chosen, settings, withheld, asked.start, asked.end, asked.rate,
        {k: v for k, v in given.items() if v is not None}, noise, exported, point,
    )  # fmt: skip
    with bar(asked.quiet, *chosen) as progress:
        outcome = workflow.run_request(request, progress)
        tell("writing")
        with staged(folder) as part:
            files = (outputs.write_run if alone else outputs.write_comparison)(outcome, part)
        files = moved(files, part, folder)
        if exported:  # by itself, so that one that fails takes nothing with it
            with staged(folder) as part:
                more = convert.export_run(outcome, part, exported, point)
            files += moved(more, part, folder)
    verdicts = gates.judge(requirements, outputs.comparison(outcome)) if requirements else []

    def values() -> dict[str, Any]:
        places = {name: folder if alone else folder / name for name in chosen}
        each = {name: loads((at / "summary.json").read_text(encoding="utf-8")) for name, at in places.items()}
        found = each[chosen[0]] if alone else {"recording": outcome.recording.name, "solvers": each}
        return {**found, "requirements": gates.values(verdicts), "files": files}

    show(lambda: terminal.run_text(outcome, files) + gates.text(verdicts), values, asked.quiet, asked.json)
    insist(verdicts)


def _withheld(without: list[str] | None, start: float | None, end: float | None) -> tuple[Any, ...]:
    """What is withheld; the span asked for must not be empty."""
    from graphnav import workflow

    if start is not None and end is not None and not start < end:
        raise ConfigError(f"--end {end:g}: must be later than --start {start:g}")
    return tuple(workflow.parse_withheld(one) for one in without or ())


def main() -> None:
    """Run the program and leave with its exit code: 0, or 2 for bad input or usage with one line that says why."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run the program on `arguments`; returns the exit code and lets no traceback through."""
    debug = bool(os.environ.get(DEBUG))
    if not debug:
        import warnings

        warnings.simplefilter("ignore")
    try:
        code = app(arguments, prog_name="graphnav", standalone_mode=False)
    except GraphnavError as error:
        return fail(str(error), BAD_INPUT, debug)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except MemoryError:
        return fail("out of memory; use a shorter part (--start, --end)", INTERNAL, debug)
    except OSError as error:
        # files are read and written by modules that turn what they expect into sentences; this is a full disk or so
        return fail(f"{error.filename or 'input or output'}: {error.strerror or error}", BAD_INPUT, debug)
    except Exception as error:
        if hasattr(error, "format_message"):  # typer's own: a usage error
            return fail(_usage(error), BAD_INPUT, debug)
        return fail(_internal(error), INTERNAL, debug)
    if code == INTERRUPTED:
        return fail("interrupted", INTERRUPTED, False)
    return code if isinstance(code, int) else 0


def _usage(error: Any) -> str:
    """A usage error, and the command whose help says more."""
    path = getattr(getattr(error, "ctx", None), "command_path", "graphnav")
    return f"{error.format_message().rstrip('.')}; see {path} --help"


def _internal(error: Exception) -> str:
    """The error and the last line of graphnav that led to it."""
    frames = traceback.extract_tb(error.__traceback__)
    package = Path(__file__).parent
    at = ([frame for frame in frames if package in Path(frame.filename).parents] or list(frames))[-1]
    return (
        f"internal error: {type(error).__name__}: {error} in {Path(at.filename).name}:{at.lineno}; "
        f"please report this with the command ({DEBUG}=1 shows a traceback)"
    )
