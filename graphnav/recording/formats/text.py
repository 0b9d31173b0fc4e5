"""Text files without column names: lines, and tables of numbers with errors that name the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_number, read_bytes
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array

NumberedLines = list[tuple[int, str]]  # line number in the file (from 1) and text


def split_lines(path: Path) -> list[str]:
    data = read_bytes(path)
    if b"\0" in data[:4096]:
        raise RecordingError(f"{path}: a binary file; expected text", key="file.binary")
    try:
        return data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: not a text file (it is not UTF-8)", key="file.text") from None


def parse_table(
    path: Path, rows: list[tuple[int, str]], names: list[str], delimiter: str | None, wanted: set[str] | None = None
) -> Array:
    """Numbers (K, n) of text rows, NaN for blanks and for columns not `wanted`, which may hold words.

    Errors name the line and the column.
    """
    lines = [line for _, line in rows]
    use = [k for k, name in enumerate(names) if wanted is None or name in wanted]
    whole = delimiter is None or all(line.count(delimiter) == len(names) - 1 for line in lines)
    if delimiter == "," and whole:
        lines = [
            _fill_blanks(line) if ",," in line or line.rstrip()[-1:] == "," or line[:1] == "," else line
            for line in lines
        ]
    try:
        if whole:
            loaded = np.loadtxt(lines, delimiter=delimiter, ndmin=2, comments=None, usecols=use if wanted else None)
            if loaded.shape[1] == len(use):
                table = np.full((len(rows), len(names)), np.nan)
                table[:, use] = loaded
                return table
    except ValueError:
        pass
    for number, line in rows:  # only to locate the error, which the fast parser does not
        fields = line.split(delimiter)
        if len(fields) != len(names):
            raise RecordingError(
                f"{path}, line {number}: {format_count(len(fields), 'field')} where {len(names)} were expected"
                f"{'; it is the last line: if it was cut off, take it out' if number == rows[-1][0] else ''}",
                key="table.fields",
            )
        for k in use:
            try:
                parse_number(fields[k].strip() or "nan")
            except ValueError:
                raise RecordingError(
                    f"{path}, line {number}, {names[k]}: '{fields[k].strip()[:40]}' is not a number", key="table.cell"
                ) from None
    raise RecordingError(f"{path}: cannot be read as a table of numbers", key="table.unreadable")


def _fill_blanks(line: str) -> str:
    return ",".join(field.strip() or "nan" for field in line.split(","))
