"""Every log format that graphnav reads, one module each; `read` selects the one that fits.

A new format is a new module in this package with a module-level ``FORMAT = Format(...)``.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from graphnav.core.complaints import suggest_nearest
from graphnav.core.errors import RecordingError
from graphnav.core.files import ARCHIVE, ZIP, exists, open_file
from graphnav.recording import Recording
from graphnav.recording.exporters import FORMATS as EXPORTED
from graphnav.recording.formats.registry import Format, Log, read_first_bytes
from graphnav.recording.formats.rounding import measure_rounding

__all__ = ["Format", "Log", "is_description", "list_formats", "load", "read"]

_DESCRIPTION = "graphnav-recording"  # contained in every recording.toml


def list_formats() -> dict[str, Format]:
    """All known formats by name; built-in names come first, so that `kitti` never means a folder."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    found = [m.FORMAT for m in modules if isinstance(getattr(m, "FORMAT", None), Format)]
    return {f.name: f for f in sorted(found, key=lambda f: (not f.builtin, f.name))}


def read(
    source: str | Path, topics: Sequence[str] = (), allow_outside: bool = False, name: str | None = None
) -> Recording:
    """Read a recording from a folder with recording.toml, such a .toml, a log of a known program, or a built-in name.

    Parameters
    ----------
    source
        A path, or a built-in name such as ``kitti``. A folder of that name is ``./kitti``.
    topics
        For a ROS bag: topics to use, each for the sensor of its type; the others are chosen automatically.
    allow_outside
        Whether files named in it may lie outside its folder.
    name
        The format; recognised from the content if None.

    Returns
    -------
    Recording
        In SI units, body axes right-forward-up and seconds on one clock.

    Raises
    ------
    RecordingError
        If the source does not exist, is of unknown format, or cannot be used, or if there is no format of that name.
    """
    chosen = _find_format(source, name)
    log = _load_topics(chosen, source, topics) if topics else None
    found = chosen.read(source, allow_outside) if log is None else log.make_recording(source)
    if found.gnss is None:
        return found
    return replace(found, gnss=replace(found.gnss, rounding=measure_rounding(found.gnss.llh)))


def load(source: str | Path, name: str | None = None, topics: Sequence[str] = (), allow_outside: bool = False) -> Log:
    """Read whatever a source contains: a whole recording or one sensor's log.

    Parameters
    ----------
    source
        A path, or a built-in name.
    name
        The format; recognised from the content if None.
    topics, allow_outside
        As for `read`.

    Returns
    -------
    Log
        The sensors in it, in SI units and body axes right-forward-up; None for the others.

    Raises
    ------
    RecordingError
        As `read`, and for a name that no format has.
    """
    chosen = _find_format(source, name)
    if topics:
        return _load_topics(chosen, source, topics)
    if chosen.load is not None:
        return chosen.load(source, allow_outside)
    r = chosen.read(source, allow_outside)
    return Log(
        r.name, r.imu, r.gnss, r.odometer, r.truth, r.platform, gps_zero=r.gps_zero, files=r.files, remarks=r.remarks,
        sensors=r.sensors,
    )  # fmt: skip


def _find_format(source: str | Path, name: str | None) -> Format:
    """The format of that name, or the first that recognises the source."""
    known = list_formats()
    if name is not None and name not in known:
        written = set(name.split(",")) <= set(EXPORTED)
        hint = f"--export {name} writes it" if written else suggest_nearest(name, list(known))
        raise RecordingError(f"--format {name}: no such format of logs; {hint}", key="log.format_unknown")
    exists(Path(source))
    chosen = known[name] if name else next((f for f in known.values() if f.recognises(source)), None)
    if chosen is None:
        raise _explain_unknown(source, known)
    if chosen.builtin and not chosen.recognises(source):
        raise RecordingError(
            f"--format {name}: is the name of a recording, and {source} is another", key="log.format_unknown"
        )
    return chosen


def _load_topics(chosen: Format, source: str | Path, topics: Sequence[str]) -> Log:
    """Read the log with these topics."""
    if chosen.choose is None:
        raise RecordingError(
            f"--topic {topics[0]}: {source} is no ROS bag; in a recording.toml set topic in the sensor's table",
            key="option.not_here",
        )
    return chosen.choose(source, topics)


def is_description(path: Path) -> bool:
    """Whether a file describes a recording, by the format that it begins with."""
    if not path.is_file():
        return False
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return _DESCRIPTION in file.read(4000)
    except OSError:
        return False


def _explain_unknown(source: str | Path, known: dict[str, Format]) -> RecordingError:
    """The reason why no format reads a source."""
    builtin = ", ".join(name for name, f in known.items() if f.builtin)
    path = Path(source)
    if path.is_dir():
        there = sorted(p.name for p in path.glob("*.toml") if is_description(p))
        hint = f"point at one of {', '.join(there)} in it" if there else f"graphnav init {path} -o {path} drafts one"
        return RecordingError(f"{path}: the folder holds no recording.toml; {hint}", key="recording.none")
    if path.exists():
        if path.is_file():
            with open_file(path):  # says so, if nobody may
                pass
        if path.suffix == ".csv" or path.name.endswith(".csv.gz"):
            return RecordingError(
                f"{path}: not a recording; point at its folder or its .toml file (graphnav init drafts one)",
                key="recording.none",
            )
        if path.is_file() and read_first_bytes(path)[:4] == ZIP:
            return RecordingError(f"{path}: {ARCHIVE}", key="file.archive")
        others = ", ".join(name for name, f in known.items() if f.load is not None)
        return RecordingError(
            f"{path}: not a recording; point at its folder or its .toml file, or at a log of a kind that is known "
            f"({others})",
            key="recording.none",
        )
    return RecordingError(f"{path}: no such file or folder (built-in recordings: {builtin})", key="file.missing")
