"""Options that several commands share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graphnav.core.errors import ConfigError
from graphnav.core.memory import pause_collector

if TYPE_CHECKING:
    from graphnav.app.reading import AskedPart
    from graphnav.config import Settings

SourceArgument = Annotated[
    str,
    typer.Argument(
        metavar="RECORDING", help="A folder with recording.toml, a .toml, a known log, or kitti (in the gtsam package)."
    ),
]
SEVERAL = {"allow_extra_args": True}  # `pick_one` reports several more clearly than the parser
FormatOption = Annotated[
    str | None, typer.Option("--format", metavar="NAME", help="Format of the log, where it is not recognised.")
]
Export = Annotated[
    str | None,
    typer.Option(
        "--export",
        metavar="NAMES",
        help="Formats to write the trajectory in: some of gpx, nav, nmea, csv, tum, kml, parquet, with commas.",
    ),
]
Point = Annotated[
    str | None,
    typer.Option(
        "--point",
        metavar="POINT",
        help="Point that --export writes: imu (default), antenna, or x,y,z: m right, forward, up of the IMU.",
    ),
]
Out = Annotated[
    Path, typer.Option("-o", "--out", metavar="OUT", help="Folder for the results; made if it is not there.")
]
Config = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="Settings file (TOML), or the summary.json of an earlier run."),
]
ProfileOption = Annotated[
    str | None, typer.Option("--profile", metavar="NAME", help="Settings for car, car+odometer or foot.")
]
Without = Annotated[
    list[str] | None,
    typer.Option(
        "--without",
        metavar="SOURCE[:FROM-TO]",
        help="Withhold gnss, odometer or another sensor, throughout or between two times in s from the start; "
        "may be repeated.",
    ),
]
Rate = Annotated[
    float | None, typer.Option("--rate", metavar="HZ", help="Output rate; default: one row for each keyframe.")
]
Pages = Annotated[
    bool, typer.Option("--report/--no-report", help="Draw the report now, or later with 'graphnav report OUT'.")
]
Start = Annotated[
    float | None, typer.Option("--start", metavar="S", help="Use the recording from here on, s from its start.")
]
End = Annotated[
    float | None, typer.Option("--end", metavar="S", help="Use the recording up to here, s from its start.")
]
NoiseOption = Annotated[
    str | None,
    typer.Option(
        "--noise",
        metavar="stated|estimated|FILE",
        help="Noise figures: as stated, estimated (default), or from a file or the summary.json of a run.",
    ),
]
Fire = Annotated[
    str | None,
    typer.Option(
        "--detectors",
        metavar="NAMES",
        help="Detectors of stops: fused (default), or some of fft, glrt, low_band_glrt, acceleration_variance, "
        "acceleration_magnitude, angular_rate_energy, with commas; any one of them is then enough.",
    ),
]
Topic = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="NAME", help="Topic of a ROS bag to use; may be repeated, once for each sensor."),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors and why a result cannot be trusted.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]
Require = Annotated[
    list[str] | None,
    typer.Option(
        "--require",
        metavar="NAME<NUMBER",
        help="Exit with code 3 unless this holds, such as h_rms<0.5; may be repeated.",
    ),
]
AllowOutside = Annotated[
    bool, typer.Option("--allow-outside", help="Also read files outside its own folder that RECORDING names.")
]


@dataclass(frozen=True)
class OtherTrajectories:
    """Other programs' trajectories to compare with: files, their point on the body, and s to add to their stamps."""

    files: list[Path]
    points: list[str]
    shifts: list[float]


@dataclass(frozen=True)
class RunOptions:
    """The options of smooth and compare, as they were typed."""

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
    export: str | None
    point: str | None
    solvers: tuple[str, ...]
    alone: bool  # whether the files are written straight into the folder, as for a single solver
    others: OtherTrajectories | None = None
    loose: bool = False

    @property
    def part(self) -> AskedPart:
        """What is to be read."""
        from graphnav.app.reading import AskedPart

        return AskedPart(self.recording, self.start, self.end, tuple(self.topic or ()), self.format, self.allow_outside)


def pick_one(context: typer.Context, recording: str) -> str:
    """The one recording requested.

    Raises
    ------
    ConfigError
        If several are.
    """
    if context.args:
        logs = " ".join([recording, *context.args])
        raise ConfigError(
            f"{logs}: one recording at a time; graphnav init {logs} -o recording.toml joins logs into one",
            key="recording.several",
        )
    return recording


def collect_withheld(without: list[str] | None, start: float | None, end: float | None) -> tuple[Any, ...]:
    """What is withheld; the requested span must not be empty."""
    from graphnav.app.withholding import parse_withheld

    for name, value in (("--start", start), ("--end", end)):
        if value is not None and value != value:
            raise ConfigError(f"{name} {value:g}: must be a number of seconds", key="option.value")
    if start is not None and end is not None and not start < end:
        raise ConfigError(f"--end {end:g}: must be later than --start {start:g}", key="option.value")
    return tuple(parse_withheld(one) for one in without or ())


def choose_detectors(settings: Settings, names: str | None) -> Settings:
    """The settings with the detectors of --detectors, unchanged without that option.

    Raises
    ------
    ConfigError
        If one is not known.
    """
    if names is None:
        return settings
    from typing import get_args

    from graphnav.config.detectors import FUSED, DetectorName
    from graphnav.core.complaints import split_names

    fire = split_names(names, get_args(DetectorName), "--detectors", "detector")
    if FUSED in fire and len(fire) > 1:
        raise ConfigError(
            f"--detectors {names}: '{FUSED}' has rules of its own: name it alone, or name detectors",
            key="detectors.fused_alone",
        )
    return settings.model_copy(update={"detectors": settings.detectors.model_copy(update={"fire": fire})})


def choose_solvers(context: typer.Context, names: str) -> tuple[str, ...]:
    """The solvers of a list with commas; an error names the option as it was typed.

    Raises
    ------
    ConfigError
        If one is not known, or there is none.
    """
    from graphnav.core.complaints import split_names

    with pause_collector():
        from graphnav.estimation.solution import KNOWN

    return split_names(names, KNOWN, _read_option_name(context), "solver")


def choose_solver(context: typer.Context, name: str) -> tuple[str, ...]:
    """The one solver that was named, by itself in a tuple.

    Raises
    ------
    ConfigError
        If it is not known, or several are named.
    """
    chosen = choose_solvers(context, name)
    if len(chosen) > 1:
        raise ConfigError(
            f"{_read_option_name(context)} {name}: {context.info_name} uses one; several are for graphnav compare",
            key="option.value",
        )
    return chosen


def _read_option_name(context: typer.Context) -> str:
    """The spelling of --solver that was typed last; --solver where none was."""
    given = [argument.partition("=")[0] for argument in context.obj or ()]
    return next((name for name in reversed(given) if name in ("--solver", "--solvers")), "--solver")
