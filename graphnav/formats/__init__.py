"""Every log format graphnav reads, one module each; `read` finds the one that fits.

A new format is a new module in this package with a module-level ``FORMAT = Format(...)``.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

from graphnav.errors import RecordingError
from graphnav.formats.registry import Format
from graphnav.recording import Recording

__all__ = ["Format", "formats", "read"]


def formats() -> dict[str, Format]:
    """Every known format by name; built-in names come first, so that `kitti` never means a folder."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    found = [m.FORMAT for m in modules if isinstance(getattr(m, "FORMAT", None), Format)]
    return {f.name: f for f in sorted(found, key=lambda f: (not f.builtin, f.name))}


def read(source: str | Path) -> Recording:
    """A recording from a folder holding recording.toml, a .toml of that form, or a built-in name.

    Parameters
    ----------
    source
        A path, or a built-in name such as ``kitti``. A folder of that name is ``./kitti``.

    Raises
    ------
    RecordingError
        If nothing is there, if nothing knows how to read it, or if what is there cannot be used.
    """
    known = formats()
    for candidate in known.values():
        if candidate.recognises(source):
            return candidate.read(source)
    builtin = ", ".join(name for name, f in known.items() if f.builtin)
    path = Path(source)
    if path.is_dir():
        there = sorted(p.name for p in path.glob("*.toml"))
        hint = f"; point at one of {', '.join(there)} in it" if there else ""
        raise RecordingError(f"{path}: the folder holds no recording.toml{hint}")
    if path.exists():
        raise RecordingError(f"{path}: not a recording; point at its folder or its .toml file")
    raise RecordingError(f"{path}: no such file or folder (built-in recordings: {builtin})")
