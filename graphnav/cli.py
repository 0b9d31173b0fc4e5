"""The program `graphnav`. Commands read their options here; `graphnav.workflow` and `graphnav.outputs` do the work.

Nothing heavy is imported before a command runs, so that help comes at once.
"""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any

import typer

from graphnav import __version__, cli_logs
from graphnav.errors import ConfigError, GraphnavError

# Before NumPy is imported: see `graphnav.pipeline`, which limits threads for those who do not come this way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

BAD_INPUT, INTERNAL, INTERRUPTED, PIPE_CLOSED = 2, 1, 130, 141
DEBUG = "GRAPHNAV_DEBUG"  # set, a traceback is shown

app = typer.Typer(
    name="graphnav",
    add_completion=False,
    rich_markup_mode=None,
    help="Smooths recorded drives with a factor graph, beside the Kalman filter it replaces.",
    epilog="\b\nExample:\n  graphnav compare kitti --without gnss:400-460 -o out",
)

Source = Annotated[
    str, typer.Argument(metavar="RECORDING", help="A folder, a .toml in one, or a built-in name such as kitti.")
]
Out = Annotated[Path, typer.Option("-o", "--out", metavar="OUT", help="Folder to write into; made if need be.")]
Config = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="Settings, TOML.")]
Without = Annotated[
    list[str] | None,
    typer.Option(
        "--without",
        metavar="SOURCE[:FROM-TO]",
        help="Withhold gnss or odometer, in a span in s from the start or throughout; may be repeated.",
    ),
]
Rate = Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Output rate; default: at the keyframes.")]
Start = Annotated[float | None, typer.Option("--start", metavar="S", help="Begin at, s from the recording's start.")]
End = Annotated[float | None, typer.Option("--end", metavar="S", help="End at, s from the recording's start.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]


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
def info(recording: Source) -> None:
    """Check a recording and say what it holds: sensors, rates, gaps, distance, stops, and what is odd."""
    from graphnav.checks import inspect
    from graphnav.formats import read

    say(inspect(read(recording)).text())


@app.command(epilog="\b\nExample:\n  graphnav smooth kitti -o out/kitti")
def smooth(
    recording: Source,
    out: Out,
    solver: Annotated[
        str, typer.Option("--solver", metavar="NAME", help="batch, incremental, isam2, rts or ekf.")
    ] = "batch",
    config: Config = None,
    without: Without = None,
    rate: Rate = None,
    start: Start = None,
    end: End = None,
    quiet: Quiet = False,
    export: Annotated[
        str | None, typer.Option("--export", metavar="NAMES", help="More formats: some of gpx,nav,nmea,csv,tum,kml.")
    ] = None,
    point: Annotated[
        str | None, typer.Option("--point", metavar="POINT", help="Of --export: imu, antenna or x,y,z (m; RFU).")
    ] = None,
) -> None:
    """Estimate the trajectory of a recording, with its uncertainty, and write it with a report."""
    _solve((solver,), "--solver", out, recording, config, without, rate, start, end, quiet, export, point)


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
    config: Config = None,
    without: Without = None,
    rate: Rate = None,
    start: Start = None,
    end: End = None,
    quiet: Quiet = False,
) -> None:
    """Put the same recording through several solvers and compare them, against the truth where there is one."""
    names = tuple(name.strip() for name in solvers.split(",") if name.strip())
    _solve(names, "--solvers", out, recording, config, without, rate, start, end, quiet)


@app.command(epilog="\b\nExample:\n  graphnav detect kitti -o out/kitti")
def detect(
    recording: Source,
    out: Out,
    config: Config = None,
    without: Without = None,
    start: Start = None,
    end: End = None,
    quiet: Quiet = False,
) -> None:
    """Find where the vehicle stands, and write the intervals, the statistics they come from and a picture."""
    from graphnav import detection_report, outputs, workflow
    from graphnav.config import Settings, read_settings
    from graphnav.detectors import detect as detected

    withheld = tuple(workflow.parse_withheld(one) for one in without or ())
    if start is not None and end is not None and not start < end:
        raise ConfigError(f"--end {end:g}: must be later than --start {start:g}")
    settings = Settings() if config is None else read_settings(config)
    folder = outputs.output_folder(out)
    used = workflow.read_part(recording, start, end, withheld)
    found = detected(used, settings)
    files = detection_report.write(used, found, folder)
    if not quiet:
        say(detection_report.text(used, found, files))


@app.command(epilog="\b\nExample:\n  graphnav evaluate out/kitti/trajectory.csv truth.csv --json")
def evaluate(
    trajectory: Annotated[Path, typer.Argument(metavar="TRAJECTORY", help="CSV, TUM, KF-GINS .nav or RTKLIB .pos.")],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH", help="The same kinds, or a recording with a truth.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="OUT", help="Folder for evaluation.json and errors.csv.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Compare any trajectory file with any truth file, ours or another program's."""
    from graphnav import outputs
    from graphnav.evaluation import evaluate as compared
    from graphnav.metrics import summary, text

    folder = None if out is None else outputs.output_folder(out)
    metrics = compared(trajectory, truth)
    values = {"trajectory": str(trajectory), "truth": str(truth), **summary(metrics)}
    if folder is not None:
        outputs.write_evaluation(folder, values, metrics)
    say(outputs.json_text(values) if json else text(metrics))


@app.command(epilog="\b\nExample:\n  graphnav simulate urban -o out/urban --seed 1")
def simulate(
    scenario: Annotated[str | None, typer.Argument(metavar="SCENARIO", help="Its name; none lists them.")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Folder for the recording; made if need be.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="The same seed gives the same recording.")] = 0,
    option: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="An option of the scenario; may be repeated. See --list."),
    ] = None,
    listing: Annotated[bool, typer.Option("--list", help="List the scenarios and their options.")] = False,
) -> None:
    """Make a recording with truth: a simulated drive, with the errors of simulated sensors."""
    from graphnav import outputs
    from graphnav.simulation import catalogue, options_from
    from graphnav.simulation import simulate as simulated

    if listing or scenario is None:
        say(catalogue())
        return
    if out is None:
        raise ConfigError("say where to write the recording: -o DIR")
    folder = outputs.output_folder(out)
    made = simulated(scenario, seed, **options_from(scenario, option or []))
    files = made.write(folder)
    say("\n".join([made.text(), *(f"  {file}" for file in files)]))


cli_logs.register(app, lambda text: say(text))


def _solve(
    solvers: tuple[str, ...],
    option: str,
    out: Path,
    recording: str,
    config: Path | None,
    without: list[str] | None,
    rate: float | None,
    start: float | None,
    end: float | None,
    quiet: bool,
    export: str | None = None,
    point: str | None = None,
) -> None:
    from graphnav import convert, outputs, terminal, workflow
    from graphnav.config import Settings, read_settings

    withheld = tuple(workflow.parse_withheld(one) for one in without or ())
    if start is not None and end is not None and not start < end:
        raise ConfigError(f"--end {end:g}: must be later than --start {start:g}")
    if rate is not None and not 0.0 < rate <= 10_000.0:
        raise ConfigError(f"--rate {rate:g}: must be above 0 and at most 10000 Hz")
    settings = Settings() if config is None else read_settings(config)
    chosen = workflow.known_solvers(solvers, option)
    given: dict[str, Any] = {
        "recording": recording, option.lstrip("-"): ",".join(chosen), "config": config and str(config),
        "without": without, "rate": rate, "start": start, "end": end,
    }  # fmt: skip
    folder = outputs.output_folder(out)
    if point is not None and export is None:
        raise ConfigError(f"--point {point}: is of the files of --export; name some")
    exported = convert.parse_names(export, "--export") if export is not None else ()
    convert.parse_point(point)
    request = workflow.Request(
        recording, chosen, settings, withheld, start, end, rate, {k: v for k, v in given.items() if v is not None}
    )
    with terminal.progress_bar(quiet) as progress:
        outcome = workflow.run_request(request, progress)
        if progress is not None:
            progress("writing", 0.0)
        write = outputs.write_run if option == "--solver" else outputs.write_comparison
        files = write(outcome, folder)
        files += convert.export_run(outcome, folder, exported, point) if exported else []
    if not quiet:
        say(terminal.run_text(outcome, files))


def say(text: str) -> None:
    """Print to stdout; whoever reads may stop early."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # what is still in the buffer would fail again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(PIPE_CLOSED) from None


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
        return _fail(str(error), BAD_INPUT, debug)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except MemoryError:
        return _fail("out of memory; use a shorter part (--start, --end)", INTERNAL, debug)
    except OSError as error:
        # files are read and written by modules that turn what they expect into sentences; this is a full disk or so
        return _fail(f"{error.filename or 'input or output'}: {error.strerror or error}", BAD_INPUT, debug)
    except Exception as error:
        if hasattr(error, "format_message"):  # typer's own: a usage error
            return _fail(_usage(error), BAD_INPUT, debug)
        return _fail(_internal(error), INTERNAL, debug)
    if code == INTERRUPTED:
        return _fail("interrupted", INTERRUPTED, False)
    return code if isinstance(code, int) else 0


def _fail(reason: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"graphnav: {' '.join(reason.split())}", file=sys.stderr)
    return code


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


if __name__ == "__main__":
    main()
