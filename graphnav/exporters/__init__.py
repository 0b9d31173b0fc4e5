"""One module per output format, each with ``write(trajectory, path)``, and those that need it with the UTC of the rows.

`write_all` writes what every run leaves, `write_as` one format by name.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from graphnav.errors import RecordingError
from graphnav.rotation import Array
from graphnav.trajectory import Trajectory

NAMES = ("csv", "tum", "kml", "gpx", "nav", "nmea")  # which are the suffixes of the files too


def write_all(trajectory: Trajectory, folder: Path) -> None:
    """Write trajectory.csv, trajectory.kml and trajectory.tum into `folder`, which is made if need be.

    Raises
    ------
    RecordingError
        If the trajectory is in a local frame, or has no attitude (which TUM cannot leave out).
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("csv", "kml", "tum"):
        write_as(name, trajectory, folder / f"trajectory.{name}")


def check_names(names: Sequence[str], gps_zero: float | None) -> None:
    """Refuse formats that a recording cannot be written in, before it is solved; `gps_zero` as `Recording` has it.

    Raises
    ------
    RecordingError
        Saying what is missing.
    """
    if "nmea" in names and gps_zero is None:
        raise RecordingError(
            "--export nmea: needs the time of day, and what t counts from is not known; say clock in recording.toml"
        )


def write_as(name: str, trajectory: Trajectory, path: Path, utc: Array | None = None) -> None:
    """Write one of `NAMES`; `utc` (K,), datetime64, where the clock is known.

    Raises
    ------
    RecordingError
        If the format cannot hold this trajectory.
    """
    from graphnav.exporters import csv, gpx, kml, nav, nmea, tum

    plain = {"csv": csv.write, "kml": kml.write, "tum": tum.write}
    timed = {"gpx": gpx.write, "nav": nav.write, "nmea": nmea.write}
    if name in timed:
        timed[name](trajectory, path, utc)
    else:
        plain[name](trajectory, path)


def require_geodetic(trajectory: Trajectory, path: Path) -> None:
    """Refuse a trajectory whose place on Earth is not known."""
    if trajectory.frame != "geodetic":
        raise RecordingError(f"{path}: a trajectory in a local frame has no latitude and longitude; write it as .tum")
