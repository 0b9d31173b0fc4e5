"""Commands about logs: `convert`, `init` and `allan`. `graphnav.cli` puts them on the program."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from graphnav.errors import ConfigError


def register(app: typer.Typer, say: Callable[[str], None]) -> None:
    """Add the commands to the program; `say` prints."""

    @app.command(
        epilog="\b\nExamples:\n  graphnav convert dataset/kf-gins.yaml -o drive\n"
        "  graphnav convert out/trajectory.csv -o track.gpx --point antenna"
    )
    def convert(
        source: Annotated[str, typer.Argument(metavar="SOURCE", help="Another program's log, or a trajectory file.")],
        out: Annotated[
            Path, typer.Option("-o", "--out", metavar="OUT", help="Folder; for a trajectory, a file will do.")
        ],
        format: Annotated[
            str | None,
            typer.Option("--format", metavar="NAME", help="What the log is, or what to write a trajectory as."),
        ] = None,
        point: Annotated[
            str | None, typer.Option("--point", metavar="POINT", help="Trajectory: imu, antenna or x,y,z (m; RFU).")
        ] = None,
        rate: Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Trajectory: interpolate to.")] = None,
        clock: Annotated[
            str | None,
            typer.Option("--clock", metavar="TEXT", help="Trajectory: unix, 'gps week 2313' or a UTC date of t = 0."),
        ] = None,
    ) -> None:
        """Turn another program's log into a recording folder, or a trajectory into gpx, nav, nmea, tum, kml or csv."""
        from graphnav import convert as conversion
        from graphnav.outputs import output_folder

        if conversion.is_export(Path(source), out, format):
            if rate is not None and not 0.0 < rate <= 10_000.0:
                raise ConfigError(f"--rate {rate:g}: must be above 0 and at most 10000 Hz")
            output_folder(out.parent if out.suffix else out)
            _, files, notes = conversion.export_file(Path(source), out, format, point, rate, clock)
            say("\n".join([*(f"note: {note}" for note in notes), *(f"wrote {file}" for file in files)]))
            return
        for option, value in (("--point", point), ("--rate", rate), ("--clock", clock)):
            if value is not None:
                raise ConfigError(f"{option}: is for trajectories; a log keeps its own")
        log, files = conversion.convert_log(source, output_folder(out), format)
        say(conversion.log_text(log, files))

    @app.command(epilog="\b\nExample:\n  graphnav allan rest.csv -o out/allan")
    def allan(
        log: Annotated[str, typer.Argument(metavar="LOG", help="A log at rest: CSV, a recording or a known log.")],
        out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT", help="Folder to write into.")],
        start: Annotated[float | None, typer.Option("--start", metavar="S", help="Begin at, s from its start.")] = None,
        end: Annotated[float | None, typer.Option("--end", metavar="S", help="End at, s from its start.")] = None,
    ) -> None:
        """Measure the noise figures of an IMU from a log at rest, and print them as lines for recording.toml."""
        from graphnav.allan import allan_of, files
        from graphnav.draft import imu_of
        from graphnav.errors import RecordingError
        from graphnav.formats import load
        from graphnav.outputs import output_folder

        folder = output_folder(out)
        if log.endswith((".csv", ".csv.gz")):
            t, gyro, accel = imu_of(Path(log))
        else:
            imu = load(log).imu
            if imu is None:
                raise RecordingError(f"{log}: holds no IMU")
            t, gyro, accel = imu.t, imu.gyro, imu.accel
        since = t - t[0]
        part = (since >= (start or 0.0)) & (since <= (since[-1] if end is None else end))
        if part.sum() < 2:
            raise ConfigError(f"--start, --end: nothing of {log} lies between them; it runs to {since[-1]:.1f} s")
        try:
            result = allan_of(t[part], gyro[part], accel[part])
        except RecordingError as error:
            raise RecordingError(f"{log}: {error}") from None
        written = files.write(result, folder)
        lines = [f"{result.duration:.0f} s at rest, {result.rate:.4g} Hz", "", "[imu.noise]", *result.lines(), ""]
        say("\n".join([*lines, *(f"wrote {path}" for path in written)]))

    @app.command(epilog="\b\nExample:\n  graphnav init imu.csv ride.nmea -o recording.toml")
    def init(
        logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="CSV files, or logs of a known kind.")],
        out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="The .toml to write.")] = Path(
            "recording.toml"
        ),
        name: Annotated[str | None, typer.Option("--name", help="Of the recording; default: its folder's.")] = None,
        force: Annotated[bool, typer.Option("--force", help="Write over a file that is there.")] = False,
    ) -> None:
        """Draft a recording.toml from logs: columns, units, axes and clocks as they seem to be, and why."""
        from graphnav.draft import draft
        from graphnav.formats.writer import write_csv
        from graphnav.outputs import output_folder

        out = out / "recording.toml" if out.is_dir() else out
        if out.suffix != ".toml":
            raise ConfigError(f"-o {out}: name a .toml file, or a folder for recording.toml")
        if out.exists() and not force:
            raise ConfigError(f"-o {out}: is there already; name another file, or say --force")
        folder = output_folder(out.parent)
        drafted = draft(logs, folder, name)
        folder.mkdir(parents=True, exist_ok=True)
        for made, columns in drafted.made.items():
            if (folder / made).exists() and not force:
                raise ConfigError(f"{folder / made}: is there already; say --force to write over it")
            write_csv(folder / made, list(columns), list(columns.values()))
        out.write_text(drafted.text, encoding="utf-8")
        say("\n".join([*(f"  {line}" for line in drafted.decisions), f"wrote {out}; look at the lines marked CHECK"]))
