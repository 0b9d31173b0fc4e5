"""One module per output format, each with ``write(trajectory, path)``; `write_all` writes them all."""

from __future__ import annotations

from pathlib import Path

from graphnav.errors import RecordingError
from graphnav.trajectory import Trajectory


def write_all(trajectory: Trajectory, folder: Path) -> None:
    """Write trajectory.csv, trajectory.kml and trajectory.tum into `folder`, which is made if need be.

    Raises
    ------
    RecordingError
        If the trajectory is in a local frame, or has no attitude (which TUM cannot leave out).
    """
    from graphnav.exporters import csv, kml, tum

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    csv.write(trajectory, folder / "trajectory.csv")
    kml.write(trajectory, folder / "trajectory.kml")
    tum.write(trajectory, folder / "trajectory.tum")


def require_geodetic(trajectory: Trajectory, path: Path) -> None:
    """Refuse a trajectory whose place on Earth is not known."""
    if trajectory.frame != "geodetic":
        raise RecordingError(f"{path}: a trajectory in a local frame has no latitude and longitude; write it as .tum")
