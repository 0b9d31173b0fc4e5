"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Source = Annotated[
    str, typer.Argument(metavar="RECORDING", help="A folder, a .toml in one, or a built-in name such as kitti.")
]
Out = Annotated[Path, typer.Option("-o", "--out", metavar="OUT", help="Folder to write into; made if need be.")]
Config = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Settings, TOML; or the summary.json of a run.")
]
Profile = Annotated[
    str | None, typer.Option("--profile", metavar="NAME", help="Settings for car, car+odometer or foot.")
]
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
Noise = Annotated[
    str | None,
    typer.Option(
        "--noise",
        metavar="stated|estimated|FILE",
        help="How good the sensors are: as stated, estimated, or as in a file or the summary.json of a run.",
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")]
Require = Annotated[
    list[str] | None,
    typer.Option(
        "--require", metavar="NAME<NUMBER", help="Leave with 3 unless it holds, as h_rms<0.5; may be repeated."
    ),
]
AllowOutside = Annotated[
    bool, typer.Option("--allow-outside", help="Read files that RECORDING names outside its own folder, too.")
]
