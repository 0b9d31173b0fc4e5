"""Tools to make mistakes on a real recording and to see what graphnav says; tests/mistakes_made.py lists them."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from helpers import full_disk

from graphnav.app import cli
from graphnav.core.notes import Note, get_key

ROOT = Path(__file__).resolve().parents[1]

Array = np.ndarray
Table = dict[str, Array]  # the columns of a CSV file by name


HEAD = """\
# What can go wrong

Mistakes that the tests make on `data/tokyo`, and the [key](keys.md) of what `graphnav info` finds; the first finding
may be the cause of the others. A note changes nothing; a warning makes results worse; an unreliable one may be wrong
whatever its sigmas say; what is refused is not solved.
"""
_AND, _ERROR = "; ", "error"


@dataclass(frozen=True)
class Mistake:
    """What was done, how it is done here, and what graphnav must say of it."""

    what: str
    make: Callable[[Path], None]
    wants: tuple[str, ...]  # fragments of the line, written by hand
    command: tuple[str, ...] = ("info", "drive", "--quick")
    error: bool = False  # else it is a warning or a note, for the recording can be used


# ---- tools
def table(folder: Path, name: str) -> Table:
    """The columns of a sensor's file."""
    return {key: column.copy() for key, column in _parsed((folder / f"{name}.csv.gz").read_bytes()).items()}


@lru_cache(maxsize=4)
def _parsed(packed: bytes) -> Table:
    header, *rows = gzip.decompress(packed).decode().splitlines()
    return dict(zip(header.split(","), np.genfromtxt(rows, delimiter=",").T, strict=True))


def write(folder: Path, name: str, columns: Table, separator: str = ",") -> None:
    """Write a sensor's file."""
    rows = [separator.join(map(repr, row)) for row in np.column_stack(list(columns.values())).tolist()]
    text = "\n".join([separator.join(columns), *rows]).replace("nan", "") + "\n"
    (folder / f"{name}.csv.gz").write_bytes(gzip.compress(text.encode(), 1))


def change(name: str, how: Callable[[Table], Table | None]) -> Callable[[Path], None]:
    """Change the numbers of a sensor."""

    def make(folder: Path) -> None:
        columns = table(folder, name)
        write(folder, name, how(columns) or columns)

    return make


def scaled(name: str, columns: str, factor: float) -> Callable[[Path], None]:
    """Multiply columns."""
    return change(name, lambda c: {k: v * factor if k in columns.split() else v for k, v in c.items()})


def swapped(name: str, one: str, other: str) -> Callable[[Path], None]:
    """Exchange two columns."""
    return change(name, lambda c: {k: c[{one: other, other: one}.get(k, k)] for k in c})


def toml(old: str, new: str) -> Callable[[Path], None]:
    """Replace text of recording.toml."""

    def make(folder: Path) -> None:
        text = (folder / "recording.toml").read_text()
        assert old in text, old
        (folder / "recording.toml").write_text(text.replace(old, new, 1))

    return make


def text(name: str, how: Callable[[str], str | bytes]) -> Callable[[Path], None]:
    """Change the text of a sensor's file, which is then no longer compressed."""

    def make(folder: Path) -> None:
        packed = folder / f"{name}.csv.gz"
        plain = how(gzip.decompress(packed.read_bytes()).decode())
        (folder / f"{name}.csv").write_bytes(plain.encode() if isinstance(plain, str) else plain)
        packed.unlink()
        toml(f'"{name}.csv.gz"', f'"{name}.csv"')(folder)

    return make


def both(*makers: Callable[[Path], None]) -> Callable[[Path], None]:
    """Several changes."""

    def make(folder: Path) -> None:
        for one in makers:
            one(folder)

    return make


def settings(content: str) -> Callable[[Path], None]:
    """A settings file beside the recording."""
    return lambda folder: (folder.parent / "settings.toml").write_text(content) and None


def nothing(folder: Path) -> None:
    """The mistake is in the command."""


def made(mistake: Mistake, room: Path) -> tuple[int, list[str]]:
    """Make the mistake in `room`; the exit code, and the lines that speak of something wrong."""
    folder = room / "drive"
    folder.mkdir()
    for file in (ROOT / "data" / "tokyo").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    mistake.make(folder)
    command = mistake.command
    if command[0] == "info":  # for the keys
        command = (*command, "--json")
    code, out, err = run(command, room, full="no space" in mistake.what)
    if code and not out:
        return code, err.splitlines()
    found = json.loads(out)["findings"] if command[0] == "info" else []
    return code, [Note(one["key"], f"{one['severity']}: {one['sentence']}") for one in found]


def run(command: tuple[str, ...], room: Path, full: bool = False) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of the program in a folder, on a disk that is `full` after 20 kB."""
    if full:
        program = [sys.executable, "-m", "graphnav", *command]
        done = subprocess.run(program, cwd=room, **full_disk(), capture_output=True, text=True, timeout=300)
        return done.returncode, done.stdout, done.stderr
    out, err = io.StringIO(), io.StringIO()
    with contextlib.chdir(room), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.run(list(command))
    return code, out.getvalue(), err.getvalue()


def said(mistake: Mistake, lines: list[str]) -> list[str]:
    """Those of the lines that speak of the mistake: that hold all that is wanted."""
    return [line for line in lines if all(want in line for want in mistake.wants)]


def finding(mistake: Mistake, lines: list[str]) -> str:
    """Severity and key of what is said, as the page has it."""
    (line, *_) = said(mistake, lines) or lines or [""]
    return f"{line.split(': ')[0]} `{key}`" if (key := get_key(line)) else _ERROR


def page(rows: dict[str, dict[str, list[str]]]) -> str:
    """docs/mistakes.md, of the mistakes by section and finding."""
    text = HEAD
    for head, some in rows.items():
        some = {found: every for found, every in some.items() if found != _ERROR}
        if not some:
            continue
        lines = [f"- {found}: {_AND.join(every)}" for found, every in some.items()]
        text += "\n".join([f"\n## {head}\n", *lines]) + "\n"
    return text


def listed(text: str) -> dict[str, str]:
    """The finding of each mistake on the page, which leaves out errors: they say themselves what to do."""
    rows = re.findall(r"^- (\w+ `[\w.]+`): (.*)$", text.removeprefix(HEAD), re.MULTILINE)
    return {what: found for found, every in rows for what in every.split(_AND)}
