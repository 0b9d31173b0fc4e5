"""One module per output format, each with ``writing(path, name)``: a file to which trajectories are added in blocks.

`write_as` writes one format by name, `write_parts` any of them in one pass.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory

FORMATS = ("csv", "tum", "kml", "gpx", "nav", "nmea", "parquet")  # which are also the file suffixes


class Add(Protocol):
    """Adds rows to a file; `utc` (K,), datetime64, where the clock is known."""

    def __call__(self, block: Trajectory, utc: Array | None = None) -> None: ...


def write_parts(
    blocks: Iterable[Trajectory],
    targets: Mapping[str, Path],
    name: str = "",
    utc: Callable[[Array], Array] | None = None,
) -> None:
    """Write the successive parts of a trajectory in several formats at once, each to its path.

    Parameters
    ----------
    utc : function that converts times of the trajectory to UTC, where the clock is known.

    Raises
    ------
    RecordingError
        If a format cannot hold this trajectory.
    """
    # under a temporary name until it is complete: a failure leaves the earlier file
    parts = {path: path.with_name(f".{path.name}.part") for path in map(Path, targets.values())}
    try:
        with ExitStack() as stack:
            adders = []
            for kind, part in zip(targets, parts.values(), strict=True):
                module = import_module(f"graphnav.recording.exporters.{kind}")
                adders.append(stack.enter_context(module.open_writer(part, name)))
            pool = stack.enter_context(ThreadPoolExecutor(2))
            writing: list[Future[None]] = []
            for block in blocks:  # the next one is computed while one is written
                for one in writing:
                    one.result()
                stamps = None if utc is None else utc(block.t)
                writing = [pool.submit(add, block, stamps) for add in adders]
            for one in writing:
                one.result()
        for path, part in parts.items():
            os.replace(part, path)
    except RecordingError as error:
        sentence = str(error)
        for path, part in parts.items():
            sentence = sentence.replace(str(part), str(path))
        raise RecordingError(sentence, key=error.key) from None
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)


def check_names(names: Sequence[str], gps_zero: float | None) -> None:
    """Refuse, before solving, formats that a recording cannot be written in; `gps_zero` as in `Recording`.

    Raises
    ------
    RecordingError
        If a format needs what the recording does not have.
    """
    if "nmea" in names and gps_zero is None:
        raise RecordingError(
            "--export nmea: needs the time of day, and the zero of t is not known; set clock in recording.toml",
            key="export.time_of_day",
        )
    if "parquet" in names and find_spec("pyarrow") is None:
        raise RecordingError(
            "--export parquet: needs pyarrow; pip install -e '.[parquet]' in the clone", key="package.missing"
        )


def write_as(name: str, trajectory: Trajectory, path: Path, utc: Array | None = None) -> None:
    """Write a trajectory in one of the formats `FORMATS`.

    Parameters
    ----------
    name
        Name of the format.
    trajectory
        The trajectory.
    path
        The file, replaced if it exists.
    utc
        (K,) datetime64, where the clock is known.

    Raises
    ------
    RecordingError
        If the format cannot hold this trajectory.
    """
    write_parts([trajectory], {name: path}, trajectory.name, None if utc is None else lambda t: np.asarray(utc))


def require_geodetic(trajectory: Trajectory, path: Path) -> None:
    """Refuse a trajectory without a place on the Earth."""
    if trajectory.frame != "geodetic":
        raise RecordingError(
            f"{path}: a trajectory in a local frame has no latitude and longitude; write it as .tum",
            key="export.local_frame",
        )
