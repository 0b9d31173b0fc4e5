"""The program `graphnav`. Commands parse their options here; `workflow` and `outputs` do the work.

Nothing heavy is imported before a command runs, so that help appears at once.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

from graphnav import __version__
from graphnav.app import cli_fleet, cli_logs, cli_online, cli_solve
from graphnav.app.cli_options import (
    SEVERAL,
    AllowOutside,
    Config,
    End,
    Fire,
    FormatOption,
    Json,
    Out,
    ProfileOption,
    Quiet,
    Require,
    SourceArgument,
    Start,
    Topic,
    Without,
    choose_detectors,
    collect_withheld,
    pick_one,
)
from graphnav.app.talk import (
    BAD_INPUT,
    DEBUG,
    INTERNAL,
    INTERRUPTED,
    PIPE_CLOSED,
    Interrupted,
    fail,
    insist,
    print_out,
    say,
    show_progress,
)
from graphnav.core.complaints import rephrase
from graphnav.core.errors import GraphnavError
from graphnav.core.progress import tell

__all__ = ["DEBUG", "PIPE_CLOSED", "app", "main", "run"]

# before NumPy is imported; `graphnav.estimation.pipeline` limits threads for all other callers
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Before the settings are imported: the search for Pydantic plugins takes as long as that import.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

# Commands in the order of use: from a log to a result, then the others.
_ORDER = (
    "init", "info", "smooth", "compare", "report", "evaluate", "convert", "detect", "online", "fleet", "simulate",
    "allan", "settings",
)  # fmt: skip
# Other programs' names for --start and --end.
_SPAN_WORDS = ("window", "span", "from", "to", "begin", "stop", "duration", "crop", "trim", "time", "until")


class _InOrder(TyperGroup):
    """Lists its commands in the order of `_ORDER`."""

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted(super().list_commands(ctx), key=_ORDER.index)


app = typer.Typer(
    name="graphnav",
    cls=_InOrder,
    add_completion=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Smooths recorded drives and walks with a factor graph, beside an EKF and an RTS smoother.",
    epilog="\b\nExample:\n  graphnav compare kitti --without gnss:400-460 -o out",
)


@app.callback(invoke_without_command=True)
def _program(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        say(f"graphnav {__version__}")
        raise typer.Exit()
    if context.invoked_subcommand is None:
        say(context.get_help())
        raise typer.Exit(BAD_INPUT)


@app.command(context_settings=SEVERAL, epilog="\b\nExample:\n  graphnav info kitti")
def info(
    context: typer.Context,
    recording: SourceArgument,
    antenna: Annotated[
        bool, typer.Option("--antenna", help="Also estimate the antenna's lever arm from the drive.")
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Leave out the checks that solve the drive: axes, signs of lever arms.")
    ] = False,
    format: FormatOption = None,
    topic: Topic = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Check a recording: its contents, and errors in it.

    Clocks, units, axes and lever arms of the sensors are checked against each other. Leaves with 2 if the recording
    cannot be solved.
    """
    from graphnav.recording.checks.overview import inspect
    from graphnav.recording.formats import read

    with show_progress(quiet, "ekf" if antenna else "info"):
        tell("reading")
        whole = read(pick_one(context, recording), topic or (), allow_outside, format)
        tell("checks")
        found = inspect(whole)
        from graphnav.estimation.antenna import find_antenna, find_untold_arm, find_wrong_arms, find_wrong_axes

        drive = found.recording, found.findings
        more = (find_wrong_axes(*drive) or find_wrong_arms(*drive)) if found.trusted and not quick else []
        last = [find_antenna(whole).finding] if antenna else find_untold_arm(found.recording)
        found = replace(found, findings=(*more, *found.findings, *last))
    print_out(found.format, found.to_dict, quiet, json, lambda: found.list_defects("unreliable"))
    found.refuse()


@app.command(context_settings=SEVERAL, epilog="\b\nExample:\n  graphnav detect kitti -o out/kitti")
def detect(
    context: typer.Context,
    recording: SourceArgument,
    out: Out,
    config: Config = None,
    detectors: Fire = None,
    without: Without = None,
    start: Start = None,
    end: End = None,
    format: FormatOption = None,
    topic: Topic = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Detect stops of the vehicle.

    The intervals, the statistics of each detector and a page of figures are written.
    """
    from graphnav.app import outputs
    from graphnav.app.reading import AskedPart, read_part
    from graphnav.config import read_settings
    from graphnav.core.staging import resolve_final_path, stage_results
    from graphnav.detectors import detect as detected
    from graphnav.recording.plausibility.screening import screen_recording
    from graphnav.report import detections as detection_report

    withheld = collect_withheld(without, start, end)
    settings = choose_detectors(read_settings(config), detectors)
    folder = outputs.check_output_folder(out)
    with show_progress(quiet, "detect"):
        tell("reading")
        part = AskedPart(pick_one(context, recording), start, end, tuple(topic or ()), format, allow_outside)
        used, notes = screen_recording(read_part(part, withheld))
        tell("detection")
        found = detected(used, settings)
        found = replace(found, notes=(*notes, *found.notes))
        tell("writing")
        with stage_results(folder, used.files) as staged:
            files = detection_report.write_detections(used, found, staged)
    files = resolve_final_path(files, staged, folder)
    print_out(
        lambda: detection_report.format_found(used, found, files),
        lambda: {**detection_report.list_values(used, found), "files": files},
        quiet,
        json,
    )


@app.command(epilog="\b\nExample:\n  graphnav evaluate out/kitti/trajectory.csv truth.csv --require 'h_rms<0.5'")
def evaluate(
    trajectory: Annotated[Path, typer.Argument(metavar="TRAJECTORY", help="CSV, TUM, KF-GINS .nav or RTKLIB .pos.")],
    truth: Annotated[
        Path, typer.Argument(metavar="TRUTH", help="A file of the same formats, or a recording with a truth.")
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="OUT", help="Folder for evaluation.json and errors.csv.")
    ] = None,
    point: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Point that TRUTH is of: m right, forward, up of TRAJECTORY's; default: the same, or as a recording "
            "says.",
        ),
    ] = None,
    require: Require = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Compare a trajectory file with a truth.

    Both may be of graphnav or of another program.
    """
    from graphnav.app import outputs
    from graphnav.app.convert import parse_arm
    from graphnav.core.staging import stage_results
    from graphnav.evaluation import gates
    from graphnav.evaluation.evaluate import evaluate as compared
    from graphnav.evaluation.metrics import format_metrics, summarise, tabulate

    requirements = [gates.parse_requirement(one) for one in require or ()]
    arm = None if point is None else parse_arm(point, "--point")
    folder = None if out is None else outputs.check_output_folder(out)
    with show_progress(quiet, "evaluate"):
        tell("reading")
        metrics = compared(trajectory, truth, lever_arm=arm, allow_outside=allow_outside)
    values = {"trajectory": str(trajectory), "truth": str(truth), **summarise(metrics)}
    verdicts = gates.judge_all(requirements, tabulate({trajectory.stem: metrics}))
    if verdicts:
        values["requirements"] = gates.list_verdicts(verdicts)
    if folder is not None:
        with stage_results(folder) as part:
            outputs.write_evaluation(part, values, metrics)
    print_out(lambda: format_metrics(metrics) + gates.format_verdicts(verdicts), lambda: values, quiet, json)
    insist(verdicts)


@app.command(epilog="\b\nExample:\n  graphnav settings --profile car > settings.toml")
def settings(
    profile: ProfileOption = None,
    config: Config = None,
    json: Json = False,
) -> None:
    """Print all settings, as a file for --config.

    The defaults, or those of a profile, a file or an earlier run.
    """
    from graphnav.config import format_settings, read_settings

    found = read_settings(config, profile)
    print_out(lambda: format_settings(found), found.model_dump, False, json)


app.add_typer(cli_solve.commands)
app.add_typer(cli_logs.commands)
app.add_typer(cli_online.commands)
app.add_typer(cli_fleet.commands)


def main() -> None:
    """Run the program and exit: 0, or 2 for bad input or usage with one line that states the reason."""
    sys.exit(run(sys.argv[1:]))


@cache
def build_program() -> Callable[..., Any]:
    """The commands with their options, read off the signatures: a tenth of a second, once a process."""
    return get_command(app)


def run(arguments: list[str]) -> int:
    """Run the program on `arguments`; returns the exit code and raises nothing."""
    debug = bool(os.environ.get(DEBUG))
    if not debug:
        import warnings

        warnings.simplefilter("ignore")
    if empty := [k for k, word in enumerate(arguments) if not word or (word[:2] == "--" and word[-1] == "=")]:
        before = " ".join(arguments[: empty[0] + 1]).strip()
        return fail(f"{before}: an empty word follows; a variable of the shell that is not set?", BAD_INPUT, debug)
    try:
        code = build_program()(arguments, prog_name="graphnav", standalone_mode=False, obj=tuple(arguments))
    except GraphnavError as error:
        return fail(str(error), BAD_INPUT, debug)
    except Interrupted as error:
        return fail(str(error), INTERRUPTED, False)
    except (KeyboardInterrupt, typer.Abort) as error:
        if isinstance(error.__cause__, EOFError):  # which typer takes for an abort by the user
            return fail(_describe_internal_error(error.__cause__), INTERNAL, debug)
        code = INTERRUPTED
    except MemoryError:
        return fail("out of memory; use a shorter part (--start, --end)", INTERNAL, debug)
    except OSError as error:
        # modules turn the errors they expect into sentences; this is a full disk or similar
        return fail(f"{error.filename or 'input or output'}: {error.strerror or error}", BAD_INPUT, debug)
    except Exception as error:
        if hasattr(error, "format_message"):  # typer's own usage errors
            return fail(_describe_usage_error(error), BAD_INPUT, debug)
        if not _is_of_interrupt(error):
            return fail(_describe_internal_error(error), INTERNAL, debug)
        code = INTERRUPTED
    if code == INTERRUPTED:
        return fail("interrupted", INTERRUPTED, False)
    return code if isinstance(code, int) else 0


def _is_of_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C led to an error, as where it ends the import of compiled code."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _describe_usage_error(error: Any) -> str:
    """A usage error, and the command whose help says more."""
    context = getattr(error, "ctx", None)
    path = getattr(context, "command_path", "graphnav")
    options = {name for option in getattr(getattr(context, "command", None), "params", ()) for name in option.opts}
    unknown = str(getattr(error, "option_name", ""))
    if unknown.lstrip("-") in _SPAN_WORDS and {"--start", "--end"} <= options:
        return f"No such option: {unknown}; --start and --end choose a part of the recording; see {path} --help"
    return f"{rephrase(error.format_message().rstrip('.'))}; see {path} --help"


def _describe_internal_error(error: Exception) -> str:
    """An internal error, with the last line of graphnav that led to it."""
    frames = traceback.extract_tb(error.__traceback__)
    package = Path(__file__).parents[1]
    at = ([frame for frame in frames if package in Path(frame.filename).parents] or list(frames))[-1]
    return (
        f"internal error: {type(error).__name__}: {error} in {Path(at.filename).name}:{at.lineno}; "
        f"please report this with the command ({DEBUG}=1 shows a traceback)"
    )
