"""Tables that are no CSV of numbers: fields apart by semicolons or tabs, decimal commas, dates in words."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import open_file, parse_number
from graphnav.core.rotation import Array
from graphnav.recording.draft.columns import match
from graphnav.recording.formats.text import text_lines

_START = 1 << 16  # bytes, in which the header is
_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(.*)")  # 08.07.2025; with slashes nobody knows
_OTHER_MARKS = re.compile(r"(\d{4})[/.](\d{1,2})[/.](\d{1,2})(.*)")  # 2025/07/08


@dataclass(frozen=True)
class Plain:
    """The columns of a table as numbers, by the file's names, and in words what was done to them."""

    columns: dict[str, Array]
    words: str
    dated: str | None  # the column that was dates: Unix time, s


def read_plain(path: Path) -> Plain | None:
    """A table whose fields, numbers or dates are written in another way than a CSV file's; None if they are not.

    Parameters
    ----------
    path : a .csv file.

    Returns
    -------
    Plain or None
        Columns that hold no numbers are left out, as is a table of no sensor whose rows differ in length; blanks are
        NaN. Dates without a zone are taken as UTC.

    Raises
    ------
    RecordingError
        If it cannot be read, or a row has more or fewer fields than the header, naming its line.
    """
    with open_file(path) as raw:
        start = raw.read(_START)
    if path.suffix == ".gz" or b"\0" in start:
        return None
    lines = _lines(start.decode("utf-8-sig", errors="replace").splitlines())
    if len(lines) < 3:
        return None
    mark = next((m for m in ("\t", ";") if m in lines[0][1]), ",")
    header, first = ([cell.strip().strip('"') for cell in line.split(mark)] for _, line in lines[:2])
    if mark == "," and not any(_date(cell) or _clock(cell) is not None for cell in first):
        return None
    lines = _lines(text_lines(path))
    rows = [[cell.strip().strip('"') for cell in line.split(mark)] for _, line in lines[1:]]
    wrong = next((k for k, row in enumerate(rows) if len(row) != len(header)), None)
    if wrong is not None and match(header, path.stem).sensor is None:
        return None  # notes, not numbers
    if wrong is not None:
        raise RecordingError(
            f"{path}, line {lines[wrong + 1][0]}: has {len(rows[wrong])} fields where the header has {len(header)}",
            key="table.fields",
        )
    cells = {name: [row[k] for row in rows] for k, name in enumerate(header)}
    done = [f"fields apart by {'a semicolon' if mark == ';' else 'a tab'}"] if mark != "," else []
    if mark != "," and any("," in cell for cell in first):
        done.append("decimal commas")
    columns = {name: x for name, some in cells.items() if (x := _numbers(some, mark != ",")) is not None}
    dated, said = _dates(cells, columns)
    return Plain(columns, ", ".join([*done, *said]), dated) if done or said else None


def _lines(text: list[str]) -> list[tuple[int, str]]:
    """Numbers and text of the lines that hold something."""
    return [(k, line) for k, line in enumerate(text, 1) if line.strip() and line.lstrip()[0] != "#"]


def _numbers(cells: list[str], commas: bool) -> Array | None:
    """A column as numbers, NaN where blank; None where it holds anything else."""
    try:
        return np.array([parse_number(c.replace(",", ".") if commas else c) if c else np.nan for c in cells])
    except ValueError:
        return None


def _dates(cells: dict[str, list[str]], columns: dict[str, Array]) -> tuple[str | None, list[str]]:
    """Turns the column of dates, or those of dates and times of day, into Unix time; its name, and words about it."""
    for name, some in cells.items():
        if name in columns or (begin := _date(some[0])) is None:
            continue
        own, days = name, some
        if begin.time() == time() and ":" not in some[0]:  # dates alone: the times of day stand beside them
            own = next((n for n, c in cells.items() if n not in columns and _clock(c[0]) is not None), "")
            if not own:
                continue
            days = [f"{day} {clock}" for day, clock in zip(some, cells[own], strict=True)]
        stamps = [_date(text) for text in days]
        if any(x is None for x in stamps):
            continue
        zone = stamps[0] is not None and stamps[0].tzinfo is not None
        utc = (x if x.tzinfo else x.replace(tzinfo=UTC) for x in stamps if x is not None)
        columns[own] = np.array([x.timestamp() for x in utc])
        why = "" if zone else "; CHECK: they state no zone and are taken as UTC"
        return own, [f"dates of '{own}' as Unix time in s{why}"]
    return None, []


def _date(text: str) -> datetime | None:
    """A date with or without a time of day; None if it is none."""
    if len(text) < 8 or not text[:1].isdigit() or not text.isascii():
        return None
    if found := _DAY_FIRST.fullmatch(text):
        day, month, year, rest = found.groups()
    elif found := _OTHER_MARKS.fullmatch(text):
        year, month, day, rest = found.groups()
    elif text[4:5] == "-":
        year, month, day, rest = text[:4], text[5:7], text[8:10], text[10:]
    else:
        return None
    try:
        start = date(int(year), int(month), int(day))
        if not rest.strip(" T"):
            return datetime.combine(start, time())
        return datetime.combine(start, time.fromisoformat(rest.strip(" T").replace(",", ".")))
    except ValueError:
        return None


def _clock(text: str) -> timedelta | None:
    """A time of day; None if it is none."""
    if text.count(":") != 2:
        return None
    try:
        own = time.fromisoformat(text.replace(",", "."))
    except ValueError:
        return None
    return timedelta(hours=own.hour, minutes=own.minute, seconds=own.second)
